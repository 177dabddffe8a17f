//! Replay, links between plugins, checkpoints, model files and products; no terminal, no clock.

pub mod table;
