//! Stage `hinf-dfacs`: known specific force `û_i`, unbiased angular acceleration `α̂`, angular velocity `ω̂`, and the
//! channels of the test masses and the attitude (paper, Section IV; ARCHITECTURE.md, table `reconstruction`).

mod bridge;
pub mod known;
pub mod noise;
pub mod noise_calibration;
pub mod on_demand;
mod plugin;
pub mod reconstruction;
pub mod replay;
pub mod smoother;
mod thruster_response;

pub use plugin::HinfDfacs;

dragfree_sdk::export_plugin!(stages: [HinfDfacs]);
