//! Stage `qp-check`: the check of the filter by another method on the same data; the mathematics are those of
//! `dragfree-estimation`.

mod stage;

pub use stage::QpCheck;

dragfree_sdk::export_plugin!(stages: [QpCheck]);
