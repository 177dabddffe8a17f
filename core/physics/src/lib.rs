//! Frames, rigid bodies, noise shapes, linear systems and whitening for a drag-free spacecraft.
//!
//! Everything is SI. Names carry frame and unit; `dcm_a_from_b` takes components in B to components in A
//! (the paper's `T_B^A`).

pub mod attitude;
pub mod control;
pub mod control_design;
pub mod decoupling;
pub mod few;
pub mod frames;
pub mod hinf;
pub mod lag;
pub mod levels;
pub mod lti;
pub mod manoeuvre;
pub mod mission;
pub mod noise;
pub mod process;
mod ranges;
pub mod riccati;
pub mod schur;
pub mod signals;
pub mod spectrum;
#[cfg(test)]
mod testing;
pub mod thrust_noise;
