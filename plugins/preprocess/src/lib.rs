//! Stage `preprocess`: every irregular table of the telemetry onto one uniform grid of epochs.
//!
//! A value that cannot be trusted becomes NaN and is counted by table and reason; nothing is dropped in silence and no
//! instrument is interpolated. [`Preprocess`] is the stage; the parts are
//! `series` (guards and cleans a table's rows), `clock` (epochs and phases), `outliers` (the robust test), `layout`
//! (what columns mean) and `gridder` (the order of it all).
//!
//! Two clocks that disagree are never reconciled by interpolation:
//! * samples within half an interval of their epoch, after the table's constant phase is taken off, are its samples;
//! * when twenty samples agree on another phase, the clock has jumped: the row before is blank and, if it was the
//!   reference's clock, the epochs go on with the new phase;
//! * at another rate than the mission's (9.7 Hz), samples and epochs slip past each other: an epoch without a sample,
//!   or with two, is blank.

mod bytes;
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
