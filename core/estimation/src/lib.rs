//! Estimation of coefficients from channels and regressors by the normal equations of §6 of the design.
//!
//! Segments of the channels and regressors become cross-spectral sums ([`spectra`], [`collected`]), with longer ones of
//! decimated samples for what is slow (`slow_band`). Σ(f) starts as the declared noise ([`sigma`]) and is re-measured
//! from the residuals (`refine`), beside random walks of unknown slow forces ([`random_walk`]). The normal equations
//! ([`normal`]) are solved under the survey and the physical ranges ([`qp`]); [`verdict`] says what the solution is
//! worth. Residuals over time ([`residual_means`]) are for eyes. No module knows an effect by name.

pub mod collected;
pub mod colour;
pub mod decimate;
pub mod estimate;
pub mod free_levels;
pub mod joint;
pub mod levels;
pub mod moments;
pub mod normal;
pub mod prediction;
pub mod qp;
pub mod random_walk;
mod refine;
pub mod residual_means;
pub mod segments;
pub mod sigma;
mod slow_band;
pub mod spectra;
pub mod state;
pub mod stored;
pub mod verdict;

pub use refine::SigmaError;
