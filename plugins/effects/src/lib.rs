//! The bundled effects, a module each.
//!
//! An effect turns telemetry into regressors, the acceleration that a physical cause adds to a channel per unit of its
//! coefficient; see ARCHITECTURE.md.

pub mod com_offset;

mod actuators;
#[cfg(test)]
mod bench;
mod geometry;
mod linear;
mod readout;
mod stiffness;
mod sunlight;

pub use com_offset::ComOffset;

use actuators::{EsCrosstalk, EsGain, MpsGain, MpsTilt, TorqueGain};
use geometry::{OffsetDrift, OpeningAngle};
use readout::{IsCrosstalk, IsScale, TiltToLength, TimeOffset};
use stiffness::{CrossStiffness, Stiffness};
use sunlight::SolarPressure;

dragfree_sdk::export_plugin!(effects: [
    ComOffset,
    CrossStiffness,
    EsCrosstalk,
    EsGain,
    IsCrosstalk,
    IsScale,
    MpsGain,
    MpsTilt,
    OffsetDrift,
    OpeningAngle,
    SolarPressure,
    Stiffness,
    TiltToLength,
    TimeOffset,
    TorqueGain,
]);
