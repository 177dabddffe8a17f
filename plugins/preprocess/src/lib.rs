//! Stage `preprocess`: brings every irregular table of the telemetry onto one uniform grid of epochs.
//!
//! An invalid value becomes NaN and is counted by table and reason; no instrument is interpolated. [`Preprocess`] is
//! the stage. `series` checks and cleans a table's rows, `clock` holds epochs and phases, `outliers` the robust test,
//! `layout` the meaning of columns, `gridder` the sequence of steps.
//!
//! Samples are assigned to epochs without interpolation:
//! * A sample within half an interval of an epoch, after removal of the table's constant phase, belongs to it.
//! * If twenty samples agree on another phase, the clock has jumped. The row before the jump is blank. If it is the
//!   reference's clock, the epochs continue with the new phase.
//! * At a rate other than the mission's, samples slip against the epochs: an epoch with no sample, or two, is blank.

mod clock;
mod gridder;
mod layout;
mod outliers;
mod series;
mod stage;
#[cfg(test)]
mod testing;
#[cfg(test)]
mod tests;

pub use stage::Preprocess;

dragfree_sdk::export_plugin!(stages: [Preprocess]);
