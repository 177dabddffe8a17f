//! Tests of the stage, in one program.

mod border;
mod command_consistency;
mod common;
mod correlation;
mod noise;
mod on_demand;
mod posterior;
mod prediction;
mod slope;
mod stream;
