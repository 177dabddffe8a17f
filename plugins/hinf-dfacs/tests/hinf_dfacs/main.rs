//! Tests of the stage, in one program.

mod border;
mod common;
mod posterior;
mod slope;
mod stream;
