//! Telemetry by an independent producer: its own simulator, controllers and encoder.
//!
//! Written from `telemetry.proto` and the MCAP specification alone, without code of the simulator plugin, the physics
//! crate or the engine's encoder, so that it does not share their errors.

mod draw;
mod file;
mod spacecraft;
mod wire;

pub use draw::{Acted, Draw, KINDS, Levels};
pub use file::{Container, PERIOD_NS, Recorder, write};
pub use spacecraft::{
    Blow, Flight, Gain, HEAT_LAG_S, Heat, Hidden, Line, Loops, Matrix, Record, Spacecraft, Start, Variation, fly,
};
