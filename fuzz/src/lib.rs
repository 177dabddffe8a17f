//! Damaged and hostile inputs for every reader, on a stable compiler: sound inputs of a corpus are changed by mutators
//! that a number determines, so that each input can be made again from its number.

pub mod mutate;
pub mod round;
pub mod targets;
