//! Stage `es-akf`: one extended-state adaptive Kalman filter per test mass (the paper's Section IV), generic in the
//! model's effects.
//!
//! It knows no effect: whatever column says that it is the regressor of a coefficient on `tmN.accel.x|y|z` becomes a
//! state of test mass N's filter, or, for a coefficient that the model fixes, a known acceleration.
//!
//! # σ
//! The paper reports `P_end`. That is here `p_end_sigma` in the quality block. The σ of the product is made of the
//! covariance that the gains really used would have under the mission's noise ([`filter`]), averaged like the value,
//! stretched by the rms of the worst readout's innovations against that same noise when they are larger. It holds for
//! noise of the shape that the mission file gives, at that level or above; `tests/campaign.rs` measures that. Noise of
//! another shape at low frequency hardly shows in innovations of one step: that is what the cross-check is for.

mod adapter;
pub mod akf;
pub mod definite;
pub mod design;
pub mod filter;
pub mod kernel;
pub mod model;
pub mod octaves;
pub mod shaping;
pub mod state;
pub mod tracker;

pub use adapter::EsAkf;
pub use akf::Akf;

dragfree_sdk::export_plugin!(stages: [EsAkf]);
