//! Noise processes of the channels by the mission file, for the estimators (Methods, "Noise covariance").
//!
//! A force on the spacecraft is one vector process in the channels of all test masses. The part of the force noise
//! predicted from the torque (see [`ThrustNoise`]) belongs to the known acceleration; the rest is noise. Torque noise
//! enters the attitude channels. The error of α̂ enters the test masses' channels through the nominal offset.
//!
//! In prediction mode nothing is estimated: `û` lacks the force correlated with torque noise, so that torque noise
//! enters the test masses' channels by that force. Its action through the offset is left to the host, which knows it
//! from the attribute `unpredicted` of the offset's regressors.

use std::collections::BTreeMap;

use dragfree_physics::frames::skew;
use dragfree_physics::mission::{Mission, TestMass};
use dragfree_physics::thrust_noise::ThrustNoise;
use dragfree_sdk::prelude::{NoiseEstimate, NoiseProcess, NoiseResponse, NoiseShape};
use nalgebra::{DMatrix, Matrix3};

const AXES: [&str; 3] = ["x", "y", "z"];

/// Gains of a process by channel, one for each component.
type Gains = BTreeMap<String, Vec<f64>>;

/// All noise processes in the channels `TM.accel.AXIS`, m s⁻², and `sc.alpha.AXIS`, rad s⁻². `readouts` names, per
/// test mass, the noise tables of the instruments that read its x, y and z, such as `ifo_x` or `is_x`.
pub fn declared(mission: &Mission, readouts: &[[&str; 3]]) -> Vec<NoiseProcess> {
    processes(mission, readouts, false)
}

/// As [`declared`], in prediction mode.
pub fn declared_for_prediction(mission: &Mission, readouts: &[[&str; 3]]) -> Vec<NoiseProcess> {
    processes(mission, readouts, true)
}

fn processes(mission: &Mission, readouts: &[[&str; 3]], prediction: bool) -> Vec<NoiseProcess> {
    let thrusters = ThrustNoise::of(mission);
    let mut per_force = DMatrix::zeros(3 * mission.test_mass.len(), 3);
    let mut per_alpha = per_force.clone();
    let mut per_torque = per_force.clone();
    for (i, tm) in mission.test_mass.values().enumerate() {
        let dcm = tm.dcm_orf_from_srf();
        per_force.rows_mut(3 * i, 3).copy_from(&(dcm / -mission.spacecraft.mass_kg));
        per_alpha.rows_mut(3 * i, 3).copy_from(&(skew(&tm.offset_nominal_orf_m()) * dcm));
    }
    if let Some(thrusters) = &thrusters {
        per_torque = &per_force * to_dynamic(&thrusters.force_per_torque);
        per_alpha += &per_force * to_dynamic(&(thrusters.force_per_torque * mission.spacecraft.inertia()));
    }
    let gains = |m: &DMatrix<f64>| -> Gains {
        let channels = mission.test_mass.keys().flat_map(|tm| AXES.map(|axis| format!("{tm}.accel.{axis}")));
        channels.zip(m.row_iter().map(|row| row.iter().copied().collect())).collect()
    };

    let mut all = Vec::new();
    if let Some(thrusters) = &thrusters {
        all.push(NoiseProcess {
            components: AXES.map(|axis| format!("thruster_force:sc.{axis}")).to_vec(),
            covariance: Some(rows(&thrusters.force_given_torque)),
            ..process("thruster_force", "N", thrusters.force_shape.clone(), NoiseResponse::Held, gains(&per_force))
        });
    }
    if let Some(pressure) = &mission.noise.solar_pressure {
        all.push(process("solar_pressure", "N", pressure.shape(), NoiseResponse::Held, gains(&per_force)));
    }
    for ((name, tm), readouts) in mission.test_mass.iter().zip(readouts) {
        all.extend(of_test_mass(mission, name, tm, readouts));
    }
    for axis in AXES {
        if let Some(sensing) = &mission.noise.dws_long_arm {
            let (name, gains) = (format!("dws_long_arm:sc.{axis}"), one_gain(&format!("sc.alpha.{axis}"), 1.0));
            all.push(NoiseProcess {
                components: vec![name.clone()],
                ..process(&name, "rad", sensing.shape(), NoiseResponse::Differenced, gains)
            });
        }
    }
    let inverse_inertia = mission.spacecraft.inertia().try_inverse().unwrap_or_else(Matrix3::zeros);
    if let Some(thrusters) = thrusters.filter(|t| t.torque_shape.psd(1.0) > 0.0) {
        let attitude = AXES.iter().zip(rows(&inverse_inertia));
        let mut enters: Gains = attitude.map(|(axis, row)| (format!("sc.alpha.{axis}"), row)).collect();
        if prediction {
            enters.extend(gains(&per_torque).into_iter().filter(|(_, row)| row.iter().any(|gain| *gain != 0.0)));
        }
        all.push(NoiseProcess {
            components: AXES.map(|axis| format!("thruster_torque:sc.{axis}")).to_vec(),
            covariance: Some(rows(&thrusters.torque)),
            estimate: (!prediction).then(|| NoiseEstimate {
                matrix: rows(&inverse_inertia),
                readout: mission.noise.dws_long_arm.as_ref().map(|n| n.shape()),
                readout_response: NoiseResponse::Differenced,
                enters: gains(&per_alpha),
            }),
            ..process("thruster_torque", "N m", thrusters.torque_shape, NoiseResponse::Held, enters)
        });
    }
    all
}

/// Processes of single axes of a test mass: readout, electrostatic force, stray acceleration.
fn of_test_mass(mission: &Mission, name: &str, tm: &TestMass, readouts: &[&str; 3]) -> Vec<NoiseProcess> {
    let noise = &mission.noise;
    let mut all = Vec::new();
    for (axis, readout) in readouts.iter().enumerate() {
        let (axis_name, channel) = (format!("{name}.{}", AXES[axis]), format!("{name}.accel.{}", AXES[axis]));
        if let Some(readout) = noise.displacement(readout) {
            let label = format!("readout:{axis_name}");
            all.push(NoiseProcess {
                components: vec![label.clone()],
                ..process(&label, "m", readout.shape(), NoiseResponse::Differenced, one_gain(&channel, 1.0))
            });
        }
        if let Some(force) = noise.electrostatic_force.as_ref().filter(|_| !tm.is_drag_free(axis)) {
            let (label, gain) = (format!("electrostatic_force:{axis_name}"), tm.mass_kg.recip());
            all.push(process(&label, "N", force.shape(), NoiseResponse::Held, one_gain(&channel, gain)));
        }
        if let Some(stray) = &noise.test_mass_acceleration {
            let label = format!("test_mass_acceleration:{axis_name}");
            all.push(process(&label, "m s-2", stray.shape(), NoiseResponse::Held, one_gain(&channel, 1.0)));
        }
    }
    all
}

fn process(name: &str, unit: &str, spectrum: NoiseShape, response: NoiseResponse, enters: Gains) -> NoiseProcess {
    NoiseProcess {
        name: name.to_owned(),
        unit: unit.to_owned(),
        spectrum: Some(spectrum),
        response,
        enters,
        ..NoiseProcess::default()
    }
}

fn one_gain(channel: &str, gain: f64) -> Gains {
    [(channel.to_owned(), vec![gain])].into()
}

fn rows(m: &Matrix3<f64>) -> Vec<Vec<f64>> {
    m.row_iter().map(|row| row.iter().copied().collect()).collect()
}

fn to_dynamic(m: &Matrix3<f64>) -> DMatrix<f64> {
    DMatrix::from_column_slice(3, 3, m.as_slice())
}
