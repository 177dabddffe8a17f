//! The data of archived products once more, through the chains that made them, into sums.

use std::collections::BTreeMap;

use dragfree_archive::Written;
use dragfree_engine::chain::{Chain, Recordings};
use dragfree_engine::config::EffectEntry;
use dragfree_engine::examine::{Examination, candidates, examine, has_parameter};
use dragfree_engine::registry::Registry;
use dragfree_engine::run::Progress;
use dragfree_engine::sources::Sources;
use dragfree_identification::record::Record;
use dragfree_identification::screen::RefinementRequest;
use dragfree_identification::transient::Detection;
use dragfree_schema::{AT_NS, FREQUENCY_HZ, Settings};

use crate::sums::{ColumnSums, Request};
use crate::{ManyDays, WorkflowError};

/// Parameter of an effect whose candidate can be tried about one shape in fine steps.
pub(crate) const FINE: &str = "fine";

/// Which data are replayed, and how.
pub struct Replay<'a> {
    /// Plugins.
    pub registry: &'a Registry,
    /// Products of one model.
    pub products: &'a [Written],
    /// Threads; results do not depend on them.
    pub threads: usize,
    /// Most rows in one call of a plugin; results do not depend on it.
    pub batch_rows: usize,
    /// What the stages before the effects have made in earlier passes.
    pub recordings: Recordings,
}

impl Replay<'_> {
    /// Thresholds: those of the first product.
    pub(crate) fn settings(&self) -> Result<&Settings, WorkflowError> {
        Ok(&self.products.first().ok_or(WorkflowError::NoProduct)?.product.settings)
    }
}

/// What a pass over the data is for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Pass {
    /// Residuals of the model.
    Residuals,
    /// Matched filters for transients.
    Transients,
    /// Sums of all candidates.
    Candidates,
    /// Innovations of the channels.
    Likelihood,
    /// What other data would tell.
    Experiment,
}

/// What is summed.
#[derive(Clone, Copy)]
pub(crate) enum What<'a> {
    /// The model alone.
    Model,
    /// Nothing but transients and lines.
    Transients,
    /// Every candidate.
    Candidates(&'a Forms<'a>),
}

/// Forms in which candidates are tried.
#[derive(Clone, Copy)]
pub(crate) struct Forms<'a> {
    /// Transients at these times.
    pub(crate) detected: &'a [Detection],
    /// In fine steps about these shapes what can be tried so.
    pub(crate) requests: &'a [RefinementRequest],
    /// These effects in the form that they state.
    pub(crate) chosen: &'a [EffectEntry],
    /// Effects that say how a driven force enters the channels ([`Request::probes`]).
    pub(crate) probes: &'a [EffectEntry],
}

impl What<'_> {
    fn pass(self) -> Pass {
        match self {
            Self::Model => Pass::Residuals,
            Self::Transients => Pass::Transients,
            Self::Candidates(_) => Pass::Candidates,
        }
    }
}

/// Levels of noise of the model of some products, by coefficient: where the products estimate one, the mean of their
/// estimates weighted by 1/σ², as all of them are weighed by one Σ.
pub(crate) fn noise_levels(products: &[Written]) -> BTreeMap<String, f64> {
    let products = || products.iter().map(|p| &p.product);
    let stated = products().flat_map(|p| &p.model.noise_levels);
    let mut all: BTreeMap<String, f64> = stated.map(|level| (level.coefficient.clone(), level.value)).collect();
    for (name, level) in &mut all {
        let estimates = products().flat_map(|p| p.result.adopted()).filter(|c| c.name == *name);
        let known = estimates.filter(|c| c.value > 0.0 && c.sigma > 0.0 && c.sigma.is_finite());
        let weighted = known.map(|c| (c.sigma.powi(-2) * c.value, c.sigma.powi(-2)));
        let (sum, weight) = weighted.fold((0.0, 0.0), |(sum, weight), (x, w)| (sum + x, weight + w));
        if weight > 0.0 {
            *level = sum / weight;
        }
    }
    all
}

/// Sums of the data of all products. `progress` is told the pass and the number of the product.
pub(crate) fn sum(
    replay: &Replay<'_>,
    settings: &Settings,
    what: What<'_>,
    progress: &mut dyn FnMut(Pass, usize, Progress),
) -> Result<Record, WorkflowError> {
    let Replay { registry, products, threads, batch_rows, .. } = *replay;
    ManyDays::refuse(products.iter().map(|w| &w.product))?;
    let levels = noise_levels(products);
    let mut whole: Option<Record> = None;
    for (number, Written { product, path }) in products.iter().enumerate() {
        let sources = Sources::of(path)?;
        let equations = path.with_extension("neq.json");
        let mut all = candidates(registry, &sources)?;
        match what {
            What::Model => all.clear(),
            What::Transients => {
                all.retain(|e| [AT_NS, FREQUENCY_HZ].iter().any(|name| has_parameter(registry, &e.id, name)));
            }
            What::Candidates(forms) => {
                all.retain(|e| !has_parameter(registry, &e.id, FREQUENCY_HZ));
                for request in forms.requests {
                    let of = |e: &&mut EffectEntry| (&e.id, &e.instance) == (&request.effect, &request.instance);
                    for entry in all.iter_mut().filter(of) {
                        let value = |v| toml::Value::try_from(v).ok();
                        let shape = request.shape.iter().filter_map(|(k, v)| Some((k.clone(), value(v)?)));
                        entry.parameters = shape.collect();
                        entry.parameters.insert(FINE.to_owned(), toml::Value::Integer(1));
                    }
                }
            }
        }
        let forms = if let What::Candidates(forms) = what { Some(forms) } else { None };
        let probes = forms.map_or(&[][..], |forms| forms.probes);
        let request = Request {
            only_transients: matches!(what, What::Transients),
            detected: forms.map(|forms| forms.detected),
            reference: equations.is_file().then_some(equations.as_path()),
            probes,
            levels: whole.as_ref().map_or(&[][..], |whole| whole.gathered.housekeeping.levels()),
            threads,
        };
        let examination = Examination {
            product,
            sources: &sources,
            candidates: all,
            chosen: forms.map_or_else(Vec::new, |forms| [forms.chosen, probes].concat()),
            needs: &[],
            values: &levels,
            altered: None,
            recordings: (!matches!(what, What::Model)).then_some(&replay.recordings),
            threads,
            batch_rows,
        };
        let link = |chain: &Chain| ColumnSums::link(&request, chain, settings);
        let (sums, not_tried) = examine(registry, &examination, link, &mut |p| progress(what.pass(), number, p))?;
        let mut record = sums.record();
        let is_probe = |name: &String| probes.iter().any(|p| *name == format!("{}:{}", p.id, p.instance));
        record.not_tried.extend(not_tried.into_iter().filter(|(name, _)| !is_probe(name)));
        match &mut whole {
            Some(sum) => sum.add(&record)?,
            None => whole = Some(record),
        }
    }
    whole.ok_or(WorkflowError::NoProduct)
}
