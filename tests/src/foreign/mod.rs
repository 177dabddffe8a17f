//! Telemetry by an independent producer: its own simulator, controllers and encoder.
//!
//! Written from `telemetry.proto` and the MCAP specification alone, without code of the simulator plugin, the physics
//! crate or the engine's encoder, so that it does not share their errors.

mod file;
mod spacecraft;
mod wire;

pub use file::{Container, write};
pub use spacecraft::{Flight, HEAT_LAG_S, Hidden, Loops, Record, fly};
