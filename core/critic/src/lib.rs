//! Criticism of a model: where it fails, which effect is missing, how sure that is (the design's `effects.md`).
//!
//! Data are read twice. [`transient`] looks for what happens once; then [`gather`] sums the cross-spectra of channels, of the model's
//! series and of those of every candidate, courses that begin where something was found ([`course`]) among them, and [`witness`] asks
//! every channel of housekeeping. From the sums alone [`rank`] tries the
//! candidates, `dragfree_estimation::levels` the noise, and [`diagnosis`] says what is missing; [`compare`] says where the
//! model fails. No module knows an effect by name.

pub mod chance;
pub mod compare;
pub mod course;
pub mod decimate;
pub mod diagnosis;
pub mod gather;
pub mod question;
pub mod rank;
pub mod record;
pub mod transient;
pub mod witness;
