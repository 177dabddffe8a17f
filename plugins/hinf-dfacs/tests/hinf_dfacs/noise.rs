//! The declared noise, as the estimators model it.

use dragfree_estimation::sigma::NoiseModel;
use dragfree_hinf_dfacs::noise::{declared, declared_for_prediction};
use dragfree_physics::mission::Mission;
use dragfree_sdk::prelude::{NoiseProcess, NoiseResponse};
use nalgebra::{DMatrix, Matrix3, Vector3};

use crate::correlation::layout;

fn taiji() -> Mission {
    let text = include_str!("../../../../fixtures/missions/taiji.toml");
    let value: serde_json::Value = toml::from_str(text).expect("the fixture is TOML");
    Mission::from_json(&value.to_string()).expect("the fixture is a mission")
}

const NINE: [&str; 9] = [
    "tm1.accel.x",
    "tm1.accel.y",
    "tm1.accel.z",
    "tm2.accel.x",
    "tm2.accel.y",
    "tm2.accel.z",
    "sc.alpha.x",
    "sc.alpha.y",
    "sc.alpha.z",
];

fn model(mission: &Mission) -> NoiseModel {
    NoiseModel::new(&declared(mission, &[["ifo_x", "is_y", "is_z"]; 2]), &NINE, 0.1).expect("a model")
}

/// At 10 mHz thrust noise is 6.7e-11 m s⁻²/√Hz on every axis; the two masses see it through the angle of 60° between
/// them.
#[test]
fn thrust_is_common_to_both_test_masses() {
    let s = model(&taiji()).psd(0.01);
    let thrust = (1e-7f64 / 1500.0).powi(2);
    assert!((s[(0, 0)] / thrust - 1.0).abs() < 0.03);
    assert!((s[(0, 3)] / thrust - 0.5).abs() < 0.03);
    assert!((s[(2, 5)] / thrust - 1.0).abs() < 0.03);
}

/// The null space of the thrust's three columns has three dimensions, in which only readout, electrostatic force and
/// stray acceleration are left.
#[test]
fn null_combinations_do_not_see_the_thrust() {
    let s = model(&taiji()).psd(0.01).view((0, 0), (6, 6)).clone_owned();
    let eigen = s.symmetric_eigenvalues();
    let mut values: Vec<f64> = eigen.iter().copied().collect();
    values.sort_by(f64::total_cmp);
    let readout = 1.8e-9 * (std::f64::consts::TAU * 0.01).powi(2);
    assert!(values[2] < 3.0 * readout.powi(2), "{values:?}");
    assert!(values[3] > 1e2 * values[2]);
}

/// What a process adds to Σ is what Σ gains when the mission file says a little more of it: for a torque in the
/// attitude's channels and, through what α̂ does not know, in the test masses'. By differences of two noise models, for
/// every process.
#[test]
fn a_process_is_what_sigma_gains_by_a_little_more_of_it() {
    let more = 1e-6_f64;
    let louder = |table: &dyn Fn(&mut Mission)| {
        let mut mission = taiji();
        table(&mut mission);
        model(&mission)
    };
    let factor = (1.0 + more).sqrt();
    let torque = louder(&|m| m.noise.thruster_torque.as_mut().expect("there").asd_nm_rthz *= factor);
    let force = louder(&|m| m.noise.thruster_force.as_mut().expect("there").asd_n_rthz *= factor);
    let base = model(&taiji());
    for f in [1e-3, 0.03, 0.08, 0.3, 2.0] {
        for (louder, process) in [(&torque, "thruster_torque"), (&force, "thruster_force")] {
            let gained = (louder.psd(f) - base.psd(f)) / more;
            let parts = ["x", "y", "z"].map(|a| base.process_psd(&format!("{process}:sc.{a}"), f).expect("there"));
            let sum = &parts[0] + &parts[1] + &parts[2];
            let scale = |i: usize, j: usize| (base.psd(f)[(i, i)] * base.psd(f)[(j, j)]).sqrt();
            for i in 0..9 {
                for j in 0..9 {
                    let error = (gained[(i, j)] - sum[(i, j)]).abs();
                    assert!(error < 1e-5 * scale(i, j), "{process} at {f} Hz, {i} {j}: {error:e}");
                }
            }
            // At 0.3 Hz α̂ does not know the torque, and Σ of x shows it.
            assert!(process == "thruster_force" || f != 0.3 || sum[(0, 0)] > 0.01 * base.psd(f)[(0, 0)], "{sum}");
        }
    }
}

#[test]
fn the_attitude_stands_apart_from_the_test_masses() {
    let model = model(&taiji());
    let s = model.psd(0.05);
    for i in 0..6 {
        for j in 6..9 {
            assert_eq!(s[(i, j)], 0.0);
        }
    }
    assert!(model.unknown.is_empty() && model.residual().iter().all(|r| *r));
}

/// Where the inertial sensor reads x, its noise is declared and not the interferometer's.
#[test]
fn the_noise_of_x_is_that_of_the_instrument_that_reads_it() {
    let mission = taiji();
    let at_1_hz = |noise_x: [&str; 2]| {
        let model =
            NoiseModel::new(&declared(&mission, &noise_x.map(|x| [x, "is_y", "is_z"])), &NINE, 0.1).expect("a model");
        [0, 3].map(|i| model.process_psd(["readout:tm1.x", "", "", "readout:tm2.x"][i], 1.0).expect("there")[(i, i)])
    };
    let [first, second] = at_1_hz(["ifo_x", "is_x"]);
    let asd =
        |noise: &Option<dragfree_physics::mission::DisplacementNoise>| noise.as_ref().expect("there").shape().psd(1.0);
    let ratio = asd(&mission.noise.is_x) / asd(&mission.noise.ifo_x);
    assert!((second / first / ratio - 1.0).abs() < 1e-12, "{second:e} {first:e}");
}

/// `T_S^{O_i}` of the paper's benches at ±30°.
fn orf_from_srf(tm: usize) -> Matrix3<f64> {
    let (sin, cos) = [30.0_f64, -30.0][tm].to_radians().sin_cos();
    Matrix3::new(cos, sin, 0.0, -sin, cos, 0.0, 0.0, 0.0, 1.0)
}

/// Sum over processes of `M C Mᵀ` in the nine channels, with the PSD at 1 Hz.
fn in_the_nine(processes: &[&NoiseProcess]) -> DMatrix<f64> {
    let mut sum = DMatrix::zeros(9, 9);
    for process in processes {
        let gains = DMatrix::from_fn(9, 3, |i, j| process.enters.get(NINE[i]).map_or(0.0, |row| row[j]));
        let covariance = process.covariance.as_ref();
        let covariance = DMatrix::from_fn(3, 3, |i, j| covariance.map_or(f64::from(u8::from(i == j)), |c| c[i][j]));
        sum += &gains * covariance * gains.transpose() * process.spectrum.as_ref().expect("known").psd(1.0);
    }
    sum
}

fn named<'a>(all: &'a [NoiseProcess], name: &str) -> &'a NoiseProcess {
    all.iter().find(|p| p.name == name).unwrap_or_else(|| panic!("no {name}"))
}

/// Reference: each thruster's wrench as the channels see it, `−T d/m_S` and `J_S⁻¹(r × d)`. Force and torque of one
/// thruster are one noise.
#[test]
fn for_prediction_the_noise_of_a_layout_is_the_sum_over_its_thrusters() {
    let mission = Mission { thrusters: Some(layout()), ..taiji() };
    let all = declared_for_prediction(&mission, &[["ifo_x", "is_y", "is_z"]; 2]);
    let torque = named(&all, "thruster_torque");
    assert!(torque.estimate.is_none() && torque.enters.len() == 9 && torque.response == NoiseResponse::Held);
    let inverse = mission.spacecraft.inertia().try_inverse().expect("an inertia");
    let mut want = DMatrix::zeros(9, 9);
    for unit in layout().unit {
        let push = Vector3::from(unit.direction_srf).normalize() * unit.asd_n_rthz;
        let turn = inverse * Vector3::from(unit.position_srf_m).cross(&push);
        let pushed = [0, 1].map(|tm| orf_from_srf(tm) * push / -mission.spacecraft.mass_kg);
        let seen = DMatrix::from_fn(9, 1, |i, _| [pushed[0], pushed[1], turn][i / 3][i % 3]);
        want += &seen * seen.transpose();
    }
    let got = in_the_nine(&[torque, named(&all, "thruster_force")]);
    let scale = |i: usize, j: usize| (want[(i, i)] * want[(j, j)]).sqrt();
    let largest = |got: &DMatrix<f64>| {
        let error = |(i, j): (usize, usize)| (got[(i, j)] - want[(i, j)]).abs() / scale(i, j);
        (0..9).flat_map(|i| (0..9).map(move |j| (i, j))).map(error).fold(0.0, f64::max)
    };
    assert!(largest(&got) < 1e-9, "{:e}", largest(&got));
    // The twin: without the force that comes with the torque.
    let mut apart = torque.clone();
    apart.enters.retain(|channel, _| channel.starts_with("sc.alpha."));
    assert!(largest(&in_the_nine(&[&apart, named(&all, "thruster_force")])) > 0.1);
}

/// Noise per axis: the torque enters the attitude alone, by `J_S⁻¹`, and all else is as without prediction.
#[test]
fn for_prediction_the_torque_of_axes_enters_the_attitude_alone() {
    let mission = taiji();
    let readouts = [["ifo_x", "is_y", "is_z"]; 2];
    let (all, usual) = (declared_for_prediction(&mission, &readouts), declared(&mission, &readouts));
    let torque = named(&all, "thruster_torque");
    let inverse = mission.spacecraft.inertia().try_inverse().expect("an inertia");
    assert!(torque.estimate.is_none());
    assert_eq!(torque.enters.keys().collect::<Vec<_>>(), ["sc.alpha.x", "sc.alpha.y", "sc.alpha.z"]);
    for (i, axis) in ["x", "y", "z"].iter().enumerate() {
        let row = &torque.enters[&format!("sc.alpha.{axis}")];
        assert!((0..3).all(|j| (row[j] - inverse[(i, j)]).abs() < 1e-15), "{axis}: {row:?}");
    }
    let without = |all: &[NoiseProcess]| -> Vec<NoiseProcess> {
        all.iter().filter(|p| p.name != "thruster_torque").cloned().collect()
    };
    assert_eq!(without(&all), without(&usual));
    assert!(named(&usual, "thruster_torque").estimate.is_some());
}
