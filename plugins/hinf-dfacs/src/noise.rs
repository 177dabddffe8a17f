//! Noise of the channels, declared from the mission file for the estimators.
//!
//! A force on the spacecraft is one vector process that enters the channels of all test masses. The part of the force
//! noise that is predicted from the torque (see [`ThrustNoise`]) is in the known acceleration; the rest is noise. The
//! attitude channels contain the torque noise. The error of α̂, the minimum-variance estimate of the angular
//! acceleration, enters the test masses' channels through the lever of the nominal offset.

use std::collections::BTreeMap;

use dragfree_physics::frames::skew;
use dragfree_physics::mission::{Mission, TestMass};
use dragfree_physics::thrust_noise::ThrustNoise;
use dragfree_sdk::prelude::{NoiseEstimate, NoiseProcess, NoiseResponse, NoiseShape};
use nalgebra::{DMatrix, Matrix3};

const AXES: [&str; 3] = ["x", "y", "z"];

type Rows = BTreeMap<String, Vec<f64>>;

/// Every noise process in the channels `TM.accel.AXIS` and `sc.alpha.AXIS`. `readouts` names, per test mass, the noise
/// tables of the instruments that read its x, y and z, such as `ifo_x` or `is_x`.
pub fn declared(mission: &Mission, readouts: &[[&str; 3]]) -> Vec<NoiseProcess> {
    let thrusters = ThrustNoise::of(mission);
    let mut thrust = DMatrix::zeros(3 * mission.test_mass.len(), 3);
    let mut lever = thrust.clone();
    for (i, tm) in mission.test_mass.values().enumerate() {
        let dcm = tm.dcm_orf_from_srf();
        thrust.rows_mut(3 * i, 3).copy_from(&(dcm / -mission.spacecraft.mass_kg));
        lever.rows_mut(3 * i, 3).copy_from(&(skew(&tm.offset_nominal_orf_m()) * dcm));
    }
    if let Some(thrusters) = &thrusters {
        lever += &thrust * dynamic(&(thrusters.force_per_torque * mission.spacecraft.inertia()));
    }
    let masses: Vec<&str> = mission.test_mass.keys().map(String::as_str).collect();
    let enters = |m: &DMatrix<f64>| -> Rows {
        let channels = masses.iter().flat_map(|tm| AXES.map(|axis| format!("{tm}.accel.{axis}")));
        channels.zip(m.row_iter().map(|row| row.iter().copied().collect())).collect()
    };

    let mut all = Vec::new();
    if let Some(thrusters) = &thrusters {
        all.push(NoiseProcess {
            components: AXES.map(|axis| format!("thruster_force:sc.{axis}")).to_vec(),
            covariance: Some(rows(&thrusters.force_given_torque)),
            ..process("thruster_force", "N", thrusters.force_shape.clone(), NoiseResponse::Held, enters(&thrust))
        });
    }
    if let Some(pressure) = &mission.noise.solar_pressure {
        all.push(process("solar_pressure", "N", pressure.shape(), NoiseResponse::Held, enters(&thrust)));
    }
    for ((name, tm), readouts) in mission.test_mass.iter().zip(readouts) {
        all.extend(of_test_mass(mission, name, tm, readouts));
    }
    for axis in AXES {
        if let Some(sensing) = &mission.noise.dws_long_arm {
            let (name, enters) = (format!("dws_long_arm:sc.{axis}"), single(&format!("sc.alpha.{axis}"), 1.0));
            all.push(process(&name, "rad", sensing.shape(), NoiseResponse::Differenced, enters));
        }
    }
    let inverse_inertia = mission.spacecraft.inertia().try_inverse().unwrap_or_else(Matrix3::zeros);
    if let Some(thrusters) = thrusters.filter(|t| t.torque_shape.psd(1.0) > 0.0) {
        let attitude = AXES.iter().zip(rows(&inverse_inertia));
        all.push(NoiseProcess {
            components: AXES.map(|axis| format!("thruster_torque:sc.{axis}")).to_vec(),
            covariance: Some(rows(&thrusters.torque)),
            estimate: Some(NoiseEstimate {
                matrix: rows(&inverse_inertia),
                readout: mission.noise.dws_long_arm.as_ref().map(|n| n.shape()),
                readout_response: NoiseResponse::Differenced,
                enters: enters(&lever),
            }),
            ..process(
                "thruster_torque",
                "N m",
                thrusters.torque_shape,
                NoiseResponse::Held,
                attitude.map(|(axis, row)| (format!("sc.alpha.{axis}"), row)).collect(),
            )
        });
    }
    all
}

/// Processes of single axes of a test mass: readout, electrostatic force, stray acceleration.
fn of_test_mass(mission: &Mission, name: &str, tm: &TestMass, readouts: &[&str; 3]) -> Vec<NoiseProcess> {
    let noise = &mission.noise;
    let mut all = Vec::new();
    for (axis, readout) in readouts.iter().enumerate() {
        let (place, channel) = (format!("{name}.{}", AXES[axis]), format!("{name}.accel.{}", AXES[axis]));
        if let Some(readout) = noise.displacement(readout) {
            let label = format!("readout:{place}");
            all.push(NoiseProcess {
                components: vec![label.clone()],
                ..process(&label, "m", readout.shape(), NoiseResponse::Differenced, single(&channel, 1.0))
            });
        }
        if let Some(force) = noise.electrostatic_force.as_ref().filter(|_| !tm.is_drag_free(axis)) {
            let (label, gain) = (format!("electrostatic_force:{place}"), tm.mass_kg.recip());
            all.push(process(&label, "N", force.shape(), NoiseResponse::Held, single(&channel, gain)));
        }
        if let Some(stray) = &noise.test_mass_acceleration {
            let label = format!("test_mass_acceleration:{place}");
            all.push(process(&label, "m s-2", stray.shape(), NoiseResponse::Held, single(&channel, 1.0)));
        }
    }
    all
}

fn process(name: &str, unit: &str, spectrum: NoiseShape, response: NoiseResponse, enters: Rows) -> NoiseProcess {
    NoiseProcess {
        name: name.to_owned(),
        unit: unit.to_owned(),
        spectrum: Some(spectrum),
        response,
        enters,
        ..NoiseProcess::default()
    }
}

fn single(channel: &str, gain: f64) -> Rows {
    [(channel.to_owned(), vec![gain])].into()
}

fn rows(m: &Matrix3<f64>) -> Vec<Vec<f64>> {
    m.row_iter().map(|row| row.iter().copied().collect()).collect()
}

fn dynamic(m: &Matrix3<f64>) -> DMatrix<f64> {
    DMatrix::from_column_slice(3, 3, m.as_slice())
}
