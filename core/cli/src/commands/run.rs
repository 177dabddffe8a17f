//! `dragfree run` and `dragfree config check`.

use super::{Done, INCONSISTENT};
use crate::args::{BATCH_ROWS, Chain, Global, Run, RunStream};
use crate::failure::Failure;
use crate::progress::Meter;
use crate::screen;
use crate::text::Paint;
use dragfree_archive::Written;
use dragfree_archive::product::{self, Product, Status, Stream};
use dragfree_workflow::calibrate::{Options, calibrate, check};
use std::fmt::Write as _;
use std::path::Path;
use std::time::SystemTime;

/// Done, but data were lost.
const DATA_LOSS: u8 = 3;

pub(super) fn execute(command: &Run, global: &Global, paint: Paint) -> Result<Done, Failure> {
    let outcome = archive(command, global)?;
    let code = code(&outcome.product);
    if global.json {
        return Ok(Done { code, ..Done::json(&product::to_json(&outcome.product, &outcome.path)) });
    }
    let mut text = screen::product(&outcome.product, &outcome.path, paint);
    let _ = writeln!(text, "next      {}", next(&outcome.product, &command.chain.archive.folder()?, global));
    Ok(Done { text, code })
}

/// Runs the pipeline and archives the product.
pub(super) fn archive(command: &Run, global: &Global) -> Result<Written, Failure> {
    let registry = super::registry(global)?;
    let options = Options {
        from_ns: command.from,
        until_ns: command.until,
        batch_rows: command.batch_rows as usize,
        state_in: command.load_state.clone(),
        state_out: command.save_state.clone(),
        stream: match command.stream {
            RunStream::Oper => Stream::Oper,
            RunStream::Rpro => Stream::Rpro,
            RunStream::Test => Stream::Test,
        },
        status: if command.is_final { Status::Final } else { Status::Quicklook },
        ..options(&command.chain, global)?
    };
    let mut meter = Meter::new("run", global);
    Ok(calibrate(&registry, &options, &mut |progress| meter.show(&progress))?)
}

/// `dragfree config check`: links as a run would.
pub(super) fn config_check(chain: &Chain, global: &Global) -> Result<Done, Failure> {
    let report = check(&super::registry(global)?, &options(chain, global)?)?;
    if global.json {
        return Ok(Done::json(&serde_json::to_value(&report)?));
    }
    Ok(Done::new(screen::check(&report)))
}

fn options(chain: &Chain, global: &Global) -> Result<Options, Failure> {
    Ok(Options {
        pipeline: chain.pipeline.clone(),
        files: chain.files.clone(),
        mission: chain.mission.clone(),
        model: chain.model.clone(),
        archive: chain.archive.folder()?,
        threads: super::threads(global),
        batch_rows: BATCH_ROWS as usize,
        created: SystemTime::now().into(),
        software: super::SOFTWARE.to_owned(),
        ..Options::default()
    })
}

/// An inconsistent model weighs more than lost data: the values themselves are in doubt.
pub(super) fn code(product: &Product) -> u8 {
    match (product.quality.inconsistent, product.quality.data_loss) {
        (true, _) => INCONSISTENT,
        (false, true) => DATA_LOSS,
        (false, false) => 0,
    }
}

/// The command that shows the product again.
pub(super) fn next(product: &Product, archive: &Path, global: &Global) -> String {
    format!("dragfree products show {}{}", product.id(), super::repeated(Some(archive), global))
}
