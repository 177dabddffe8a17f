//! Stage `es-akf`: an extended-state adaptive Kalman filter (the paper's Section IV) of one test mass or of several
//! together, generic in the model's effects.
//!
//! It knows no effect and no mission: a test mass is whatever has a column `NAME.u_orf_m_s2.x`, and a coefficient with
//! responses on `NAME.accel.x|y|z` becomes a state of that test mass's filter, or, where the model fixes it, a known
//! acceleration.
//!
//! # σ
//! The paper reports `P_end`. That is here `p_end_sigma` in the quality block. The σ of the product is made of the
//! covariance that the gains really used would have under the mission's noise ([`filter`]), averaged like the value,
//! stretched by the rms of the worst readout's innovations against that same noise when they are larger. It holds for
//! noise of the shape that the mission file gives, at that level or above; `tests/campaign.rs` measures that. Noise of
//! another shape at low frequency hardly shows in innovations of one step: the comparison with the batch solution is
//! for that.

mod adapter;
pub mod definite;
pub mod design;
pub mod filter;
pub mod kernel;
pub mod model;
pub mod octaves;
pub mod shaping;
pub mod tracker;

pub use adapter::EsAkf;

dragfree_sdk::export_plugin!(stages: [EsAkf]);
