//! One calibration: a pipeline over telemetry, into a product of the archive.

pub use dragfree_engine::run::{CheckReport, CheckedNode, Progress, RunOptions as Options, check, run as calibrate};
