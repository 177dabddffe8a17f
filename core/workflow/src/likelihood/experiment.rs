//! What other data would tell: the information of the parameters of a decision in rows as they would be, by blocks of
//! time.

use dragfree_engine::chain::Chain;
use dragfree_engine::config::EffectEntry;
use dragfree_engine::examine::{Altering, Examination, examine};
use dragfree_engine::run::Progress;
use dragfree_engine::sources::Sources;
use dragfree_schema::{NoiseProcess, PREDICTION_NEED};
use nalgebra::DMatrix;

use super::pass::{At, Filtered};
use super::{Decided, Meaning, Means, Point};
use crate::WorkflowError;
use crate::replay::{Pass, Replay, noise_levels};

/// Where the passes of a diagnosis have ended.
pub(crate) struct Settled {
    pub(crate) decided: Decided,
    /// Forms of the candidates.
    pub(crate) chosen: Vec<EffectEntry>,
    /// Slow forces beside the declared noise.
    pub(crate) slow: Vec<NoiseProcess>,
    pub(crate) point: Point,
}

/// An experiment on the rows of one product.
pub(crate) struct Experiment<'a> {
    /// Number of the product.
    pub(crate) number: usize,
    /// Its inputs, with the time that is wanted.
    pub(crate) sources: &'a Sources,
    /// Rows as they would be, of which the series count and no innovation; as they are where there is none.
    pub(crate) altered: Option<Altering<'a>>,
    /// Means of the series, where the rows are altered: those of another pass over such rows.
    pub(crate) means: Option<&'a Means>,
    /// Length of a block, s.
    pub(crate) block_s: f64,
}

/// Information of all parameters of a decision in a block of time.
pub(crate) struct InBlock {
    /// Begin of the block, Unix ns.
    pub(crate) first_ns: i64,
    pub(crate) information: DMatrix<f64>,
    /// Samples in which squares count for the levels of the noise.
    pub(crate) settled: f64,
}

/// The information in an experiment, and the means of its series. A parameter without series there has none.
///
/// # Errors
/// As a replay.
pub(crate) fn information(
    replay: &Replay<'_>,
    end: &Settled,
    chosen: &[EffectEntry],
    experiment: &Experiment<'_>,
    progress: &mut dyn FnMut(Pass, usize, Progress),
) -> Result<(Vec<InBlock>, Means), WorkflowError> {
    let settings = replay.settings()?;
    let levels = noise_levels(replay.products);
    let number = experiment.number;
    let product = &replay.products.get(number).ok_or(WorkflowError::NoProduct)?.product;
    let examination = Examination {
        product,
        sources: experiment.sources,
        candidates: Vec::new(),
        chosen: chosen.to_vec(),
        needs: &[PREDICTION_NEED],
        values: &levels,
        altered: experiment.altered,
        recordings: Some(&replay.recordings),
        threads: replay.threads,
        batch_rows: replay.batch_rows,
    };
    let point = match experiment.altered {
        None => end.point.clone(),
        // Constants and starts are those of other rows.
        Some(_) => Point {
            values: end.point.values.clone(),
            levels: end.point.levels.clone(),
            means: experiment.means.map(|means| vec![means.clone(); number + 1]).unwrap_or_default(),
            ..Point::default()
        },
    };
    let block_s = Some(experiment.block_s);
    let data = experiment.altered.is_none();
    let at =
        At { point: &point, slow: &end.slow, opening: false, number, block_s, data, search: false, waveforms: &[] };
    let link = |chain: &Chain| Filtered::link(chain, at, settings, replay.threads);
    let (filtered, _) = examine(replay.registry, &examination, link, &mut |p| progress(Pass::Experiment, number, p))?;
    let means = filtered.means();
    Ok((by_block(filtered, &end.decided), means))
}

/// The blocks of a pass, by the parameters of a decision.
fn by_block(filtered: Filtered, decided: &Decided) -> Vec<InBlock> {
    let Filtered { parameters, innovations, .. } = filtered;
    let place = |(name, _): &(String, Meaning)| decided.parameters.iter().position(|(own, _)| own == name);
    let places: Vec<Option<usize>> = parameters.iter().map(place).collect();
    let all = decided.parameters.len();
    let block = |block: dragfree_identification::innovations::filter::Block| {
        let mut information = DMatrix::zeros(all, all);
        let mut packed = block.information.iter();
        for (j, b) in places.iter().enumerate() {
            for (a, x) in places[..=j].iter().zip(&mut packed) {
                if let (Some(a), Some(b)) = (a, b) {
                    information[(*a, *b)] = *x;
                    information[(*b, *a)] = *x;
                }
            }
        }
        InBlock { first_ns: block.first_ns, information, settled: block.settled as f64 }
    };
    innovations.finish().blocks.into_iter().map(block).collect()
}
