//! The bundled effects, one module per physical cause.
//!
//! An effect turns telemetry into regressors: the acceleration that a cause adds to a channel per unit of its
//! coefficient. Derivations are in the guide, chapter "Methods"; labels `eq:...` are those of the reference paper.

pub mod com_offset;
pub mod formula;
pub mod lag;

mod actuators;
mod columns;
mod common;
mod correlation;
mod electromagnetic;
mod geometry;
mod impulse;
mod line;
mod linear;
mod noise;
mod prediction;
mod readout;
mod slosh;
mod step_pulses;
mod stiffness;
mod sunlight;
#[cfg(test)]
mod test_spacecraft;
mod thermal;
mod torque;

pub use com_offset::ComOffset;

use actuators::{EsCrosstalk, EsGain, MpsGain, MpsTilt, TorqueGain};
use correlation::MpsCorrelation;
use electromagnetic::{Charge, Magnetic};
use formula::Formula;
use geometry::{OffsetDrift, OpeningAngle};
use impulse::Impulse;
use line::Line;
use linear::Linear;
use noise::{IsNoise, MpsNoise, TorqueNoise};
use readout::{IsCrosstalk, IsScale, TiltToLength, TimeOffset};
use slosh::Slosh;
use stiffness::{CrossStiffness, Stiffness};
use sunlight::SolarPressure;
use thermal::Thermal;

dragfree_sdk::export_plugin!(effects: [
    Charge,
    ComOffset,
    Linear<CrossStiffness>,
    Linear<EsCrosstalk>,
    Linear<EsGain>,
    Formula,
    Impulse,
    Linear<IsCrosstalk>,
    IsNoise,
    Linear<IsScale>,
    Line,
    Magnetic,
    MpsCorrelation,
    Linear<MpsGain>,
    MpsNoise,
    Linear<MpsTilt>,
    Linear<OffsetDrift>,
    Linear<OpeningAngle>,
    Slosh,
    Linear<SolarPressure>,
    Linear<Stiffness>,
    Thermal,
    Linear<TiltToLength>,
    Linear<TimeOffset>,
    Linear<TorqueGain>,
    TorqueNoise,
]);
