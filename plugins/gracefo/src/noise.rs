//! The noise in an accelerometer's channels, declared from the mission file for the stages that weigh them.

use std::collections::BTreeMap;

use dragfree_physics::frames::skew;
use dragfree_physics::mission::{Noise, TestMass};
use dragfree_sdk::prelude::{NoiseProcess, NoiseResponse, NoiseShape};
use nalgebra::Matrix3;

const AXES: [&str; 3] = ["x", "y", "z"];

/// Noise of the channels `NAME.accel.AXIS`, measured as they are. The non-gravitational acceleration, which no effect
/// models, is a process of unknown spectrum: what a model leaves in these channels is not noise alone.
///
/// The measured α enters with the whole noise of its instrument, through the lever of the nominal offset. Where
/// `E[α | measured α]` is used, less of it remains; how much depends on the telemetry, and the residuals tell.
pub(crate) fn declared(noise: &Noise, name: &str, tm: &TestMass) -> Vec<NoiseProcess> {
    let channel = |axis: &str| format!("{name}.accel.{axis}");
    let process = |name: &str, unit: &str, spectrum: Option<NoiseShape>, enters| NoiseProcess {
        name: name.to_owned(),
        unit: unit.to_owned(),
        spectrum,
        response: NoiseResponse::Direct,
        enters,
        ..NoiseProcess::default()
    };
    let vector = |gains: Matrix3<f64>| -> BTreeMap<String, Vec<f64>> {
        let rows = gains.row_iter().map(|row| row.iter().copied().collect());
        AXES.map(channel).into_iter().zip(rows).collect()
    };
    let mut all = vec![process("non_gravitational_acceleration", "m s-2", None, vector(Matrix3::identity()))];
    if let Some(linear) = &noise.accelerometer_linear {
        all.extend(AXES.map(|axis| {
            let name = format!("accelerometer_linear:{name}.{axis}");
            process(&name, "m s-2", Some(linear.shape()), [(channel(axis), vec![1.0])].into())
        }));
    }
    if let Some(angular) = &noise.accelerometer_angular {
        let lever = skew(&tm.offset_nominal_orf_m()) * tm.dcm_orf_from_srf();
        all.push(process("accelerometer_angular", "rad s-2", Some(angular.shape()), vector(lever)));
    }
    all
}
