//! Replay, links between plugins, checkpoints, model files and products; no terminal, no clock.

pub mod border;
pub mod chain;
pub mod config;
pub mod product;
pub mod registry;
pub mod replay;
pub mod table;
pub mod telemetry;
