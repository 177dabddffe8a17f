//! Model identification: where a model fails, which effect is missing from it, and how sure that is.
//!
//! Data are read twice. The first pass runs a matched filter for every [`transient`] template. The second sums, in
//! [`gram`], the cross-spectra of channels, of the model's series and of those of every candidate, among them
//! [`waveform`]s that begin where a transient was detected, and, in [`coherence`], those of housekeeping with the
//! residuals; it keeps [`slow_samples`] of all of them. On these sums [`screen`] chooses the form of each candidate,
//! by the scores of [`scores`] or, where it is slow, over the whole run; [`driven`] finds functions of housekeeping
//! that the residuals follow, [`slow_forces`] measures unknown slow forces, and [`compare`] tests the residuals of the
//! model as it is. Further passes filter the channels: by their [`innovations`] the likelihood decides what is named,
//! and [`diagnosis`] is the answer. No module knows an effect by name.

pub mod candidates;
pub mod coherence;
pub mod columns;
pub mod compare;
pub mod diagnosis;
pub mod distributions;
pub mod driven;
pub mod gram;
pub mod innovations;
pub mod lines;
pub mod quadratic;
pub mod record;
pub mod scores;
pub mod screen;
pub mod slow_forces;
pub mod slow_samples;
pub mod transient;
pub mod waveform;
