//! One run: a pipeline over a feed, into a product.

use chrono::{DateTime, Utc};
use dragfree_schema::{Coefficient, Report};
use serde_json::{Map, Value};
use std::io;
use std::ops::Range;
use std::path::{Path, PathBuf};

use crate::EngineError;
use crate::border::PluginInfo;
use crate::chain::{self, Carry, Chain, ChainNode, Sink};
use crate::config::{Mission, Model, Pipeline, read};
use crate::draft::Draft;
use crate::feed::{Feed, FileFeed, SourceFeed, SourceOptions};
use crate::registry::Registry;
use crate::series::Series;
use crate::stop;
use crate::table::{Chunk, TableSpec};
use crate::telemetry::{FileHeader, interface_tables};
use dragfree_archive::files::{IoContext as _, IoError, folder_of, sha256, sync_folder};
use dragfree_archive::product::{self, Loss, NoiseLevel, Stage, Status, Stream};
use dragfree_archive::{InputPlace, MadeOf, ProductWriter, Window, Written};

/// What to run.
#[derive(Clone, Debug, Default)]
pub struct RunOptions {
    /// Pipeline file.
    pub pipeline: PathBuf,
    /// Telemetry files, or the files of the pipeline's source.
    pub files: Vec<PathBuf>,
    /// Mission file in place of the pipeline's.
    pub mission: Option<PathBuf>,
    /// Model file in place of the pipeline's.
    pub model: Option<PathBuf>,
    /// Folder of the products.
    pub archive: PathBuf,
    /// First time wanted, Unix ns.
    pub from_ns: Option<i64>,
    /// End of the time wanted, exclusive, Unix ns.
    pub until_ns: Option<i64>,
    /// Data before `from_ns` that only settle the stages before the estimators, ns.
    pub run_in_ns: i64,
    /// Threads; results do not depend on them.
    pub threads: usize,
    /// Most rows in one call of a plugin; results do not depend on it.
    pub batch_rows: usize,
    /// State of an earlier run to go on from.
    pub state_in: Option<PathBuf>,
    /// Where to keep the state for the next run.
    pub state_out: Option<PathBuf>,
    /// Why the product is made.
    pub stream: Stream,
    /// How final it is.
    pub status: Status,
    /// When the product is made; the engine has no clock.
    pub created: DateTime<Utc>,
    /// Version of the program.
    pub software: String,
}

impl RunOptions {
    /// Where the data that settle the stages end and those of the product begin.
    fn run_in_until_ns(&self) -> Option<i64> {
        self.from_ns.filter(|_| self.run_in_ns > 0)
    }
}

/// How far a run has come.
#[derive(Clone, Copy, Debug)]
pub struct Progress {
    /// Everything before this time is done, Unix ns.
    pub until_ns: i64,
    /// First time, Unix ns.
    pub first_ns: i64,
    /// End, Unix ns, where it is known.
    pub end_ns: Option<i64>,
}

/// What a check found.
#[derive(Clone, Debug, serde::Serialize)]
pub struct CheckReport {
    /// Pipeline.
    pub pipeline: String,
    /// Mission.
    pub mission: String,
    /// Model revision.
    pub model: String,
    /// Plugins in order, with what each reads and writes.
    pub nodes: Vec<CheckedNode>,
    /// Coefficients that will be estimated.
    pub coefficients: Vec<String>,
    /// Free space where the product will go, bytes; none where it cannot be told.
    pub free_bytes: Option<u64>,
}

/// A plugin as linked.
#[derive(Clone, Debug, serde::Serialize)]
pub struct CheckedNode {
    /// Id, with the instance of an effect.
    pub name: String,
    /// Version.
    pub version: String,
    /// Columns that it reads, `table:column`.
    pub reads: Vec<String>,
    /// Columns that it writes, `table:column`.
    pub writes: Vec<String>,
}

/// The options of a run and its files, read.
pub(crate) struct Setup<'a> {
    pub(crate) options: &'a RunOptions,
    pub(crate) pipeline: Pipeline,
    pub(crate) mission: Mission,
    pub(crate) model: Model,
    /// Role, file and text of what was read once, so that what is archived is what was used.
    texts: [(&'static str, PathBuf, String); 3],
}

impl<'a> Setup<'a> {
    pub(crate) fn load(options: &'a RunOptions) -> Result<Self, EngineError> {
        let text = read(&options.pipeline)?;
        let pipeline = Pipeline::parse(&options.pipeline, &text)?;
        let choose = |given: &Option<PathBuf>, own: &Option<PathBuf>, what: &'static str| {
            let path = given.clone().or_else(|| own.clone());
            let path = path.ok_or(EngineError::NotNamed { what, pipeline: options.pipeline.clone() })?;
            let text = read(&path)?;
            Ok::<_, EngineError>((what, path, text))
        };
        let mission = choose(&options.mission, &pipeline.mission, "mission")?;
        let model = choose(&options.model, &pipeline.model, "model")?;
        Ok(Self {
            mission: Mission::parse(&mission.1, &mission.2)?,
            model: Model::parse(&model.1, &model.2)?,
            texts: [("pipeline", options.pipeline.clone(), text), mission, model],
            options,
            pipeline,
        })
    }

    /// Opens the feed for the window of the options, from `resume_ns` on.
    pub(crate) fn feed(&self, registry: &Registry, resume_ns: Option<i64>) -> Result<Box<dyn Feed>, EngineError> {
        let options = self.options;
        let from_ns = options.from_ns.map(|from| from.saturating_sub(options.run_in_ns));
        let (start, end) = (from_ns.max(resume_ns), options.until_ns);
        let window: Option<Range<i64>> =
            (start.is_some() || end.is_some()).then(|| start.unwrap_or(i64::MIN)..end.unwrap_or(i64::MAX));
        match &self.pipeline.source {
            Some((id, parameters)) => {
                let source = SourceOptions {
                    given_in: options.pipeline.display().to_string(),
                    parameters,
                    files: &options.files,
                    window_ns: window,
                    rows: options.batch_rows,
                };
                Ok(Box::new(SourceFeed::open(registry, id, &self.mission, &source)?))
            }
            None if options.files.is_empty() => Err(EngineError::NoFiles { pipeline: options.pipeline.clone() }),
            None => {
                let run_in = options.run_in_until_ns();
                Ok(Box::new(FileFeed::open(&options.files, window, run_in, options.threads, &self.mission)?))
            }
        }
    }

    /// The files that were read once, with their paths.
    pub(crate) fn inputs(&self) -> Vec<(product::Input, PathBuf)> {
        let input =
            |(role, path, text): &(&'static str, PathBuf, String)| (named(role, path, text.as_bytes()), path.clone());
        self.texts.iter().map(input).collect()
    }

    pub(crate) fn link(&self, registry: &Registry, tables: &[TableSpec]) -> Result<Chain, EngineError> {
        let run_in_until_ns = self.options.run_in_until_ns();
        let Self { options: RunOptions { batch_rows, threads, .. }, .. } = *self;
        let carry = Carry { batch_rows: *batch_rows, threads: *threads, run_in_until_ns };
        Ok(chain::build(registry, &self.pipeline, &self.mission, &self.model, tables, carry)?)
    }

    /// Carries every row of the feed into the chain.
    pub(crate) fn carry(
        &self,
        feed: &mut dyn Feed,
        chain: &mut Chain,
        sink: &mut dyn Sink,
        progress: &mut dyn FnMut(Progress),
    ) -> Result<Covered, EngineError> {
        let end_ns = feed.span_ns().map(|span| span.end).filter(|end| *end != i64::MAX);
        let from_ns = self.options.run_in_until_ns().unwrap_or(i64::MIN);
        let mut carried = Carried::default();
        while let Some(chunk) = feed.next()? {
            carried.add(&chunk, from_ns);
            if let Some(Covered { first_ns, last_ns }) = carried.covered() {
                progress(Progress { until_ns: last_ns, first_ns, end_ns });
            }
            chain.feed(chunk, sink)?;
            stop::check()?;
        }
        // What waits now waits for rows to come, however the feed was cut: so it can be saved.
        chain.settle(sink)?;
        carried.covered().ok_or_else(|| EngineError::NoRows { files: self.options.files.clone() })
    }
}

/// Links a pipeline over its feed without reading a row.
///
/// # Errors
/// Whatever would keep the run from starting.
pub fn check(registry: &Registry, options: &RunOptions) -> Result<CheckReport, EngineError> {
    let setup = Setup::load(options)?;
    let tables = match (&setup.pipeline.source, options.files.is_empty()) {
        (None, true) => interface_tables(),
        _ => setup.feed(registry, None)?.tables().to_vec(),
    };
    let chain = setup.link(registry, &tables)?;
    let checked = |n: &ChainNode| CheckedNode {
        name: n.name().to_owned(),
        version: n.info.manifest.version.clone(),
        reads: n.reads.clone(),
        writes: n.writes.iter().flat_map(|t| &t.columns).map(|c| format!("{}:{}", c.table, c.name)).collect(),
    };
    Ok(CheckReport {
        pipeline: setup.pipeline.name,
        mission: setup.mission.name,
        model: setup.model.identity().0,
        nodes: chain.nodes.iter().map(checked).collect(),
        coefficients: chain.coefficients.iter().filter(|c| c.estimate).map(|c| c.name.clone()).collect(),
        free_bytes: free_bytes(&options.archive),
    })
}

/// Runs a pipeline and archives its product.
///
/// # Errors
/// [`EngineError`] says what, where and why; nothing is left in the archive then.
pub fn run(
    registry: &Registry,
    options: &RunOptions,
    progress: &mut dyn FnMut(Progress),
) -> Result<Written, EngineError> {
    let setup = Setup::load(options)?;
    let next_state = options.state_out.as_deref().map(NextState::begin).transpose()?;
    let state = options.state_in.as_ref().map(|path| std::fs::read(path).at("read the state", path)).transpose()?;
    let resume_ns = state.as_ref().map(|s| chain::resumes_at_ns(s)).transpose()?;
    let mut feed = setup.feed(registry, resume_ns)?;
    let mut chain = setup.link(registry, feed.tables())?;
    log(&setup, &chain);
    if let Some(state) = &state {
        chain.load(state)?;
    }
    let mut writer = ProductWriter::begin(&options.archive)?;
    let from_ns = options.run_in_until_ns().unwrap_or(i64::MIN);
    let mut series = Series::create(&chain, &mut writer, &header_of(&setup), from_ns)?;
    let mut teller = writer.teller(&format!("{} {}", setup.pipeline.product, setup.mission.spacecraft));
    let mut told = |done: Progress| {
        teller.tell(done.first_ns, done.until_ns, done.end_ns);
        progress(done);
    };
    let covered = setup.carry(feed.as_mut(), &mut chain, &mut series, &mut told)?;
    // Saved before the flush, because the next day continues within the lags.
    let left = match chain.save() {
        Ok(left) => Some(left),
        // Nobody asked for it: a plugin that cannot be saved is no reason to lose the day.
        Err(error) if next_state.is_none() => {
            tracing::warn!("the archive gets no state for the next day: {error}");
            None
        }
        Err(error) => return Err(error.into()),
    };
    let next_state = next_state.zip(left.as_ref()).map(|(next, left)| next.write(left)).transpose()?;
    chain.finish(&mut series)?;
    let reports = chain.reports()?;
    series.finish()?;
    let draft = draft(&setup, &chain, feed.as_mut(), (state.as_deref(), reports), &covered)?;
    // Before the commit: a plugin that fails in its end is a failed run, and a failed run archives nothing.
    drop(chain);
    drop(feed);
    tracing::debug!(epochs_from_ns = covered.first_ns, epochs_to_ns = covered.last_ns, "every stage has reported");
    for (role, path, text) in &setup.texts {
        writer.keep(role, &name_of(path), text.as_bytes())?;
    }
    if let (Some(path), Some(state)) = (&options.state_in, &state) {
        writer.keep("state_in", &name_of(path), state)?;
    }
    if let Some(left) = &left {
        writer.keep("state_out", "state", left)?;
    }
    let written = draft.commit(writer, made_of(&setup, &draft))?;
    tracing::info!(id = written.product.id(), path = %written.path.display(), "archived");
    // The state last: after a kill in between, the day can be run again, and the archive has the state too.
    next_state.map_or(Ok(()), NextState::place)?;
    Ok(written)
}

/// What the file of time series says of itself.
fn header_of(setup: &Setup<'_>) -> FileHeader {
    FileHeader {
        time_scale: "UTC".to_owned(),
        mission: setup.mission.name.clone(),
        spacecraft: setup.mission.spacecraft.clone(),
        producer: "dragfree".to_owned(),
        version: setup.options.software.clone(),
        ..FileHeader::default()
    }
}

/// Logs the linked chain.
fn log(setup: &Setup<'_>, chain: &Chain) {
    let coefficients = chain.coefficients.iter().filter(|c| c.estimate).count();
    tracing::info!(
        pipeline = setup.pipeline.name,
        mission = setup.mission.name,
        model = setup.model.identity().0,
        plugins = chain.nodes.len(),
        coefficients,
        files = setup.options.files.len(),
        "linked"
    );
    for node in &chain.nodes {
        let written: usize = node.writes.iter().map(|table| table.columns.len()).sum();
        let version = &node.info.manifest.version;
        tracing::debug!(plugin = node.name(), %version, columns_read = node.reads.len(), columns_written = written, "linked");
    }
}

/// The time of the rows that went into the chain.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Covered {
    first_ns: i64,
    last_ns: i64,
}

/// Rows of each table that went into the chain: how many, and their time.
#[derive(Default)]
struct Carried(Vec<(usize, Option<Covered>)>);

impl Carried {
    /// Adds the rows from `from_ns` on of a chunk.
    fn add(&mut self, chunk: &Chunk, from_ns: i64) {
        self.0.resize(chunk.batches.len(), (0, None));
        for ((rows, covered), batch) in self.0.iter_mut().zip(&chunk.batches) {
            let times = &batch.time_ns[batch.time_ns.partition_point(|time| *time < from_ns)..];
            let (Some(&first_ns), Some(&last_ns)) = (times.first(), times.last()) else { continue };
            *rows += times.len();
            covered.get_or_insert(Covered { first_ns, last_ns }).last_ns = last_ns;
        }
    }

    /// The time of the densest table: slow ones may begin long before, and housekeeping goes on after an instrument.
    fn covered(&self) -> Option<Covered> {
        self.0.iter().max_by_key(|(rows, _)| *rows)?.1
    }
}

/// The state for the next day, written beside its place and renamed: a kill leaves the old state or the new one.
struct NextState<'a> {
    path: &'a Path,
    file: tempfile::NamedTempFile,
}

impl<'a> NextState<'a> {
    /// Opens the file, so that a place that cannot be written is refused before the day is read.
    fn begin(path: &'a Path) -> Result<Self, IoError> {
        let open = || {
            if path.is_dir() {
                return Err(io::ErrorKind::IsADirectory.into());
            }
            std::fs::create_dir_all(folder_of(path))?;
            tempfile::NamedTempFile::new_in(folder_of(path))
        };
        Ok(Self { path, file: open().at("write the state", path)? })
    }

    fn write(mut self, bytes: &[u8]) -> Result<Self, EngineError> {
        let written = io::Write::write_all(&mut self.file, bytes).and_then(|()| self.file.as_file().sync_all());
        written.at("write the state", self.path)?;
        Ok(self)
    }

    fn place(self) -> Result<(), EngineError> {
        self.file.persist(self.path).map_err(|e| e.error).at("write the state", self.path)?;
        // The state is in its place; only a power failure could still take the rename back.
        if let Err(error) = sync_folder(folder_of(self.path)) {
            tracing::warn!("the folder {} cannot be flushed to disk: {error}", folder_of(self.path).display());
        }
        Ok(())
    }
}

/// Bytes left for this user where the archive is, or will be: in the nearest folder that exists.
#[cfg(unix)]
fn free_bytes(archive: &Path) -> Option<u64> {
    let archive = std::path::absolute(archive).ok()?;
    let space = rustix::fs::statvfs(archive.ancestors().find(|folder| folder.is_dir())?).ok()?;
    Some(space.f_bavail.saturating_mul(space.f_frsize))
}

#[cfg(not(unix))]
fn free_bytes(_archive: &Path) -> Option<u64> {
    None
}

/// A plugin that ran, as a product names it.
fn stage(info: &PluginInfo, instance: &str, library_sha256: &str, parameters: &Map<String, Value>) -> Stage {
    Stage {
        plugin: info.manifest.id.clone(),
        instance: instance.to_owned(),
        kind: info.kind.to_string(),
        version: info.manifest.version.clone(),
        abi: dragfree_abi::ABI_VERSION.to_string(),
        library_sha256: library_sha256.to_owned(),
        parameters_sha256: sha256(Value::Object(parameters.clone()).to_string()),
    }
}

/// Levels of noise that the effects of the model state.
fn noise_levels(chain: &Chain) -> Vec<NoiseLevel> {
    let stated = chain.coefficients.iter().filter(|c| !c.noise.is_empty() && !c.candidate);
    let level =
        |c: &Coefficient| NoiseLevel { coefficient: c.name.clone(), component: c.noise.clone(), value: c.initial };
    stated.map(level).collect()
}

fn draft(
    setup: &Setup<'_>,
    chain: &Chain,
    feed: &mut dyn Feed,
    (state, reports): (Option<&[u8]>, Vec<Report>),
    covered: &Covered,
) -> Result<Draft, EngineError> {
    let inputs = inputs(setup, feed, state)?;
    let mut replay = feed.summary()?;
    let source = feed.source().map(|s| stage(&s.found.info, "", &s.found.opened.sha256, &s.parameters));
    let nodes = chain.nodes.iter().map(|n| {
        let instance = n.name().split_once(':').map_or("", |(_, instance)| instance);
        stage(&n.info, instance, &n.sha256, &n.parameters)
    });
    let history = source.into_iter().chain(nodes).collect();
    replay.losses.extend(chain.nodes.iter().filter(|n| n.discarded_rows > 0).map(|n| Loss {
        kind: "discarded_rows".to_owned(),
        count: n.discarded_rows,
        detail: format!("plugin {} discarded batches; its log says why", n.name()),
    }));
    let mut effects: Vec<String> = setup.model.effects.iter().map(|e| e.id.clone()).collect();
    effects.dedup();
    let (revision, parent) = setup.model.identity();
    if setup.model.edited_by_hand() {
        replay.notes.push(format!(
            "the model file was edited by hand since revision {} was made; `dragfree model commit` makes a revision of it",
            setup.model.revision
        ));
    }
    Ok(Draft {
        pipeline: setup.pipeline.name.clone(),
        product: setup.pipeline.product.clone(),
        release: setup.pipeline.release,
        mission: setup.mission.name.clone(),
        spacecraft: setup.mission.spacecraft.clone(),
        first_ns: covered.first_ns,
        last_ns: covered.last_ns,
        inputs,
        history,
        model: product::Model {
            revision,
            parent,
            fixed_from: setup.model.fixed_from.clone(),
            effects,
            noise_levels: noise_levels(chain),
        },
        software: setup.options.software.clone(),
        reports: replay.report.take().into_iter().chain(reports).collect(),
        replay,
        settings: setup.pipeline.settings.clone(),
        stream: setup.options.stream,
        status: setup.options.status,
        created: setup.options.created,
    })
}

/// Name of a file without its folder, so that a product does not depend on where it was made.
fn name_of(path: &Path) -> String {
    path.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default()
}

/// Where the inputs of a run lay, and what was asked for.
fn made_of(setup: &Setup<'_>, draft: &Draft) -> MadeOf {
    let options = setup.options;
    let telemetry = draft.inputs.iter().filter(|input| input.role == "telemetry").zip(&options.files);
    let place = |(input, path): (&product::Input, &PathBuf)| InputPlace {
        sha256: input.sha256.clone(),
        path: std::path::absolute(path).unwrap_or_else(|_| path.clone()),
    };
    let window = Window { from_ns: options.from_ns, until_ns: options.until_ns };
    MadeOf { places: telemetry.map(place).collect(), window, run_in_ns: options.run_in_ns }
}

/// A file that was read once.
fn named(role: &str, path: &Path, content: &[u8]) -> product::Input {
    let (role, name) = (role.to_owned(), name_of(path));
    product::Input { role, name, size: content.len() as u64, sha256: sha256(content) }
}

/// Every file that a run read. Of the files of a source plugin only those that the command line names are known.
fn inputs(setup: &Setup<'_>, feed: &mut dyn Feed, state: Option<&[u8]>) -> Result<Vec<product::Input>, EngineError> {
    let mut inputs = feed.inputs()?;
    inputs.extend(setup.inputs().into_iter().map(|(input, _)| input));
    let state = setup.options.state_in.iter().zip(state);
    inputs.extend(state.map(|(path, bytes)| named("state", path, bytes)));
    Ok(inputs)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::table::Batch;

    #[test]
    fn a_product_covers_the_time_of_its_densest_table() {
        let batch = |times: &[i64]| Batch { time_ns: times.to_vec(), ..Batch::empty(0) };
        let chunk = |dense: &[i64], slow: &[i64]| Chunk {
            batches: vec![batch(dense), batch(slow)],
            complete_until_ns: i64::MAX,
        };
        let mut carried = Carried::default();
        for (dense, slow) in [(&[][..], &[1, 9][..]), (&[10, 11, 12, 13], &[11]), (&[14, 15], &[]), (&[], &[90])] {
            carried.add(&chunk(dense, slow), 0);
        }
        assert_eq!(carried.covered(), Some(Covered { first_ns: 10, last_ns: 15 }));

        let mut after_run_in = Carried::default();
        after_run_in.add(&chunk(&[1, 2], &[3]), 5);
        assert_eq!(after_run_in.covered(), None);
        after_run_in.add(&chunk(&[4, 6, 7], &[5]), 5);
        assert_eq!(after_run_in.covered(), Some(Covered { first_ns: 6, last_ns: 7 }));
    }
}
