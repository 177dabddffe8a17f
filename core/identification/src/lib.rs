//! Model identification: where a model fails, which effect is missing from it, and how sure that is.
//!
//! Data are read twice. The first pass runs a matched filter for every [`transient`] template. The second sums, in
//! [`gram`], the cross-spectra of channels, of the model's series and of those of every candidate, among them
//! [`waveform`]s that begin where a transient was detected, and, in [`coherence`], those of housekeeping with the
//! residuals. Everything else works on these sums: [`scores`] tests the candidates, `dragfree_estimation::levels` the
//! noise levels, [`diagnosis`] selects, and [`compare`] tests the residuals of the model as it is. No module knows an
//! effect by name.

pub mod candidates;
pub mod coherence;
pub mod compare;
pub mod decimate;
pub mod diagnosis;
pub mod distributions;
pub mod gram;
pub mod innovations;
pub mod record;
pub mod scores;
pub mod screen;
pub mod slow_forces;
pub mod transient;
pub mod waveform;
