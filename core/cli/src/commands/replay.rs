//! The data of archived products once more, with progress on stderr.

use crate::args::{BATCH_ROWS, Global};
use crate::failure::Failure;
use crate::progress::Meter;
use dragfree_archive::Written;
use dragfree_engine::chain::Recordings;
use dragfree_workflow::calibrate::Progress;
use dragfree_workflow::{Pass, Replay, WorkflowError};

/// Does a job on products.
pub(super) fn with_meter<T>(
    products: &[Written],
    global: &Global,
    job: impl FnOnce(&Replay<'_>, &mut dyn FnMut(Pass, usize, Progress)) -> Result<T, WorkflowError>,
) -> Result<T, Failure> {
    let registry = super::registry(global)?;
    let threads = super::threads(global);
    let (registry, batch_rows) = (&registry, BATCH_ROWS as usize);
    let replay = Replay { registry, products, threads, batch_rows, recordings: Recordings::default() };
    let mut shown: Option<(Pass, usize, Meter)> = None;
    let mut progress = |pass: Pass, product: usize, progress: Progress| {
        if shown.as_ref().is_none_or(|(of, number, _)| (*of, *number) != (pass, product)) {
            shown = Some((pass, product, Meter::new(name(pass), global)));
        }
        if let Some((.., meter)) = &mut shown {
            meter.show(&progress);
        }
    };
    Ok(job(&replay, &mut progress)?)
}

fn name(pass: Pass) -> &'static str {
    match pass {
        Pass::Residuals => "compare",
        Pass::Transients => "look",
        Pass::Candidates => "diagnose",
        Pass::Likelihood => "decide",
        Pass::Experiment => "next",
    }
}
