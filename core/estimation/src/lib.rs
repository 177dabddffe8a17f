//! Estimation of coefficients from channels and regressors by the normal equations of §6 of the design.
//!
//! Segments of the channels and regressors become cross-spectral sums ([`spectra`]); Σ(f) starts as the declared noise
//! ([`sigma`]) and is re-measured from the residuals (`refine`); the normal equations ([`normal`]) are solved under the
//! survey and the physical ranges ([`qp`]); [`verdict`] says what the solution is worth. No module knows an effect by
//! name.

pub mod colour;
pub mod estimate;
pub mod free_levels;
pub mod levels;
pub mod normal;
pub mod prediction;
pub mod qp;
mod refine;
pub mod segments;
pub mod sigma;
pub mod spectra;
pub mod state;
pub mod stored;
pub mod verdict;

pub use refine::SigmaError;
