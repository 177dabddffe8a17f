//! Stage `es-akf`: one extended-state adaptive Kalman filter per test mass (the paper's Section IV), generic in the
//! model's effects.

pub mod definite;
pub mod filter;
pub mod kernel;
pub mod model;
pub mod shaping;
pub mod state;
