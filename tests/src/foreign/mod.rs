//! Telemetry by another producer: its own simulator, its own controllers, its own bytes.
//!
//! Written from `telemetry.proto` and the MCAP specification alone, sharing no code with the simulator plugin, the
//! physics crate or the engine's encoder: what those have wrong, this has not.

mod file;
mod spacecraft;
mod wire;

pub use file::{Container, write};
pub use spacecraft::{Flight, HEAT_LAG_S, Hidden, Loops, Record, fly};
