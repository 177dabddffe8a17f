//! Tests of the stage, in one program.

mod asked;
mod border;
mod common;
mod correlation;
mod noise;
mod obedience;
mod posterior;
mod slope;
mod stream;
