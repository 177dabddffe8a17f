//! The likelihood of the channels by their innovations: what each sample adds to what the past predicts.
//!
//! Direct identification in closed loop by prediction errors (Ljung, System Identification, 2nd ed., section 13.4): a
//! command depends on nothing that comes after it, so what an effect adds to a sample, by what is known before it, is
//! independent of the innovation, whatever controller flies. [`state_space`] makes a linear system of the declared
//! noise, [`predictor`] its steady Kalman predictor and how that changes with every parameter of the noise, [`filter`]
//! the sums of one pass over the data, and [`decision`] what follows from them.

pub mod decision;
mod ends;
pub mod filter;
mod lanes;
pub mod predictor;
pub mod state_space;

#[cfg(test)]
mod tests;
