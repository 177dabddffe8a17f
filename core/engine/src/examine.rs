//! A second pass over the data of a product: its inputs go through its chain once more, up to and with the effects, and
//! the columns that the caller chooses come back to it.

use std::collections::BTreeMap;
use std::ops::Range;
use std::path::Path;

use crate::EngineError;
use crate::border::Kind;
use crate::chain::{Chain, Recording, Recordings, Sink};
use crate::config::{EffectEntry, Mission, Model, Node};
use crate::feed::{Feed, SourceFeed, Summary};
use crate::registry::Registry;
use crate::run::{Progress, RunOptions, Setup};
use crate::sources::Sources;
use crate::stop;
use crate::table::{Chunk, TableSpec};
use dragfree_archive::product::{Input, Product};

/// Puts other values into the rows of a feed, as they would be in another experiment. Times stay.
pub type Altering<'a> = &'a dyn Fn(&[TableSpec], &mut Chunk);

/// Which data are examined, and how.
pub struct Examination<'a> {
    /// The product.
    pub product: &'a Product,
    /// Where its inputs are now.
    pub sources: &'a Sources,
    /// Effects that are tried beside those of the model.
    pub candidates: Vec<EffectEntry>,
    /// Effects that are tried in the one form that their parameters say.
    pub chosen: Vec<EffectEntry>,
    /// What is asked of stages by name beside what the effects need, such as [`dragfree_schema::PREDICTION_NEED`].
    pub needs: &'a [&'static str],
    /// Coefficients of the model that start at another value than the model file's, by name.
    pub values: &'a BTreeMap<String, f64>,
    /// Rows as they would be in another experiment; as they are where there is none.
    pub altered: Option<Altering<'a>>,
    /// Where what the stages make is kept for later passes over the same data, and read once it is.
    pub recordings: Option<&'a Recordings>,
    /// Threads; results do not depend on them.
    pub threads: usize,
    /// Most rows in one call; results do not depend on it.
    pub batch_rows: usize,
}

/// A consumer of columns, with the indices of those that it wants in [`Chain::columns`].
pub type Wanted<C> = (C, Vec<usize>);

/// Every instance of every installed effect that is not in the model of a product, on its mission; beside one at a
/// time or a frequency another one. An effect without a list of instances is left out.
///
/// # Errors
/// The mission or the model file cannot be read.
pub fn candidates(registry: &Registry, sources: &Sources) -> Result<Vec<EffectEntry>, EngineError> {
    let (mission, model) = (Mission::load(&sources.mission)?, Model::load(&sources.model)?);
    let mut all = Vec::new();
    for found in registry.plugins().filter(|p| p.info.kind == Kind::Effect) {
        let manifest = &found.info.manifest;
        let taken = |instance: &String| model.effects.iter().any(|e| e.id == manifest.id && e.instance == *instance);
        for instance in manifest.instances_on(&mission.value) {
            let others = (2..).take_while(|_| manifest.repeats()).map(|k| format!("{instance}-{k}"));
            let free = std::iter::once(instance.clone()).chain(others).find(|name| !taken(name));
            all.extend(free.map(|name| EffectEntry::new(&manifest.id, &name)));
        }
    }
    Ok(all)
}

/// Whether an effect has a parameter: with [`dragfree_schema::AT_NS`] what it does happens once, at a time that the
/// host finds; with [`dragfree_schema::FREQUENCY_HZ`] it acts at one frequency; with `fine` its candidate can be tried
/// about one shape in fine steps.
pub fn has_parameter(registry: &Registry, effect: &str, name: &str) -> bool {
    let found = registry.find(Kind::Effect, effect);
    found.is_ok_and(|f| f.info.manifest.parameters.iter().any(|p| p.name == name))
}

/// Carries the data of a product through its chain. `link` sees the linked chain before a row is read; what it makes
/// takes the rows of the columns that it wants ([`Sink::tapped`]). Gives that back, and the candidates that could not
/// be linked, with the reason.
///
/// # Errors
/// An input has changed since the product was made, is gone, or a plugin fails; or `link` refuses.
pub fn examine<C: Sink, E: From<EngineError>>(
    registry: &Registry,
    what: &Examination<'_>,
    link: impl FnOnce(&Chain) -> Result<Wanted<C>, E>,
    progress: &mut dyn FnMut(Progress),
) -> Result<(C, Vec<(String, String)>), E> {
    let sources = what.sources;
    let options = RunOptions {
        pipeline: sources.pipeline.clone(),
        files: sources.telemetry.clone(),
        mission: Some(sources.mission.clone()),
        model: Some(sources.model.clone()),
        from_ns: sources.from_ns,
        until_ns: sources.until_ns,
        run_in_ns: sources.run_in_ns,
        threads: what.threads,
        batch_rows: what.batch_rows,
        ..RunOptions::default()
    };
    let mut setup = Setup::load(&options)?;
    let same = |input: &Input, path: &Path| named(what.product, input, path);
    setup.inputs().iter().try_for_each(|(input, path)| same(input, path))?;
    setup.model.candidates.clone_from(&what.candidates);
    setup.model.chosen.clone_from(&what.chosen);
    setup.model.needs = what.needs.iter().map(|need| (*need).to_owned()).collect();
    if what.recordings.is_some() {
        // What any effect may ask for, so that later passes with other effects find it.
        let effects = registry.plugins().filter(|p| p.info.kind == Kind::Effect);
        setup.model.needs.extend(effects.flat_map(|p| p.info.manifest.needs.clone()));
    }
    for (name, value) in what.values {
        let short = name.rsplit('.').next().unwrap_or_default();
        for entry in setup.model.effects.iter_mut().filter(|e| e.owns(name)) {
            entry.prior.entry(short.to_owned()).or_default().value = Some(*value);
        }
    }
    let nodes = &mut setup.pipeline.nodes;
    nodes.truncate(nodes.iter().position(|n| *n == Node::Effects).map_or(nodes.len(), |i| i + 1));
    let mut feed: Box<dyn Feed + '_> = setup.feed(registry, None)?;
    feed.inputs()?.iter().zip(&sources.telemetry).try_for_each(|(input, path)| same(input, path))?;
    if let Some(alter) = what.altered {
        feed = Box::new(Altered { feed, alter });
    }
    let mut chain = setup.link(registry, feed.tables())?;
    let (mut consumer, columns) = link(&chain)?;
    chain.tap(&columns).map_err(EngineError::from)?;
    let recordings = what.recordings.filter(|_| what.altered.is_none());
    let made_by = chain.made_by(&data_of(what));
    let recording = recordings.and_then(|all| all.find(&made_by, &chain));
    if let Some(recording) = recording {
        tracing::debug!("rows are read from what an earlier pass has kept");
        play(&mut chain, &recording, &mut consumer, progress)?;
        chain.finish(&mut consumer).map_err(EngineError::from)?;
    } else {
        recordings.iter().for_each(|all| chain.record(made_by.clone(), all));
        setup.carry(feed.as_mut(), &mut chain, &mut consumer, progress)?;
        chain.finish(&mut consumer).map_err(EngineError::from)?;
        recordings.iter().for_each(|all| chain.recorded(all));
    }
    feed.unchanged()?;
    Ok((consumer, chain.not_tried))
}

/// Which data go into a chain.
fn data_of(what: &Examination<'_>) -> String {
    let Sources { telemetry, from_ns, until_ns, run_in_ns, .. } = what.sources;
    format!("{} {telemetry:?} {from_ns:?} {until_ns:?} {run_in_ns}", what.product.id())
}

/// Carries the rows of a recording into the effects and to the host.
fn play(
    chain: &mut Chain,
    recording: &Recording,
    consumer: &mut dyn Sink,
    progress: &mut dyn FnMut(Progress),
) -> Result<(), EngineError> {
    let ends = |block: &[i64]| block.first().copied().zip(block.last().copied());
    let blocks: Vec<(i64, i64)> = recording.blocks().filter_map(ends).collect();
    let (Some((first_ns, _)), end_ns) = (blocks.first().copied(), blocks.last().map(|(_, last)| *last)) else {
        return Ok(());
    };
    let wanted = chain.silence_stages(recording);
    for (block, (_, until_ns)) in blocks.into_iter().enumerate() {
        chain.play(recording, block, &wanted, consumer)?;
        progress(Progress { until_ns, first_ns, end_ns });
        stop::check()?;
    }
    Ok(())
}

/// A feed with other values.
struct Altered<'a> {
    feed: Box<dyn Feed + 'a>,
    alter: Altering<'a>,
}

impl Feed for Altered<'_> {
    fn tables(&self) -> &[TableSpec] {
        self.feed.tables()
    }

    fn next(&mut self) -> Result<Option<Chunk>, EngineError> {
        let mut chunk = self.feed.next()?;
        if let Some(chunk) = &mut chunk {
            (self.alter)(self.feed.tables(), chunk);
        }
        Ok(chunk)
    }

    fn span_ns(&self) -> Option<Range<i64>> {
        self.feed.span_ns()
    }

    fn inputs(&mut self) -> Result<Vec<Input>, EngineError> {
        self.feed.inputs()
    }

    fn unchanged(&self) -> Result<(), EngineError> {
        self.feed.unchanged()
    }

    fn summary(&mut self) -> Result<Summary, EngineError> {
        self.feed.summary()
    }

    fn source(&self) -> Option<&SourceFeed> {
        self.feed.source()
    }
}

/// An input is one that the product names.
fn named(product: &Product, input: &Input, path: &Path) -> Result<(), EngineError> {
    if product.inputs.iter().any(|of_product| of_product.sha256 == input.sha256) {
        return Ok(());
    }
    Err(EngineError::Changed { path: path.to_owned(), product: product.id().to_owned() })
}
