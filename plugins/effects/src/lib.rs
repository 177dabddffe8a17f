//! The bundled effects, a module each.
//!
//! An effect turns telemetry into regressors, the acceleration that a physical cause adds to a channel per unit of its
//! coefficient; see ARCHITECTURE.md.

pub mod com_offset;
pub mod formula;
pub mod lag;

mod actuators;
#[cfg(test)]
mod bench;
mod common;
mod correlation;
mod geometry;
mod impulse;
mod linear;
mod noise;
mod readout;
mod slosh;
mod steps;
mod stiffness;
mod stray;
mod sunlight;
mod thermal;

pub use com_offset::ComOffset;

use actuators::{EsCrosstalk, EsGain, MpsGain, MpsTilt, TorqueGain};
use correlation::MpsCorrelation;
use formula::Formula;
use geometry::{OffsetDrift, OpeningAngle};
use impulse::Impulse;
use noise::{IsNoise, MpsNoise, TorqueNoise};
use readout::{IsCrosstalk, IsScale, TiltToLength, TimeOffset};
use slosh::Slosh;
use stiffness::{CrossStiffness, Stiffness};
use stray::{Charge, Magnetic};
use sunlight::SolarPressure;
use thermal::Thermal;

dragfree_sdk::export_plugin!(effects: [
    Charge,
    ComOffset,
    CrossStiffness,
    EsCrosstalk,
    EsGain,
    Formula,
    Impulse,
    IsCrosstalk,
    IsNoise,
    IsScale,
    Magnetic,
    MpsCorrelation,
    MpsGain,
    MpsNoise,
    MpsTilt,
    OffsetDrift,
    OpeningAngle,
    Slosh,
    SolarPressure,
    Stiffness,
    Thermal,
    TiltToLength,
    TimeOffset,
    TorqueGain,
    TorqueNoise,
]);
