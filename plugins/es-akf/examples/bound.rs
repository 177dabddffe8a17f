//! How well the best estimator could know the offset of one test mass alone, without a survey: the information bound.
//!
//! ```sh
//! cargo run --release -p dragfree-es-akf --example bound -- [MISSION.toml]
//! ```
//!
//! The independent check of the bound in `validation/src/bound.rs`, with which it shares no code and which makes the
//! report: here the design's own sensitivities and one test mass, there a loop put together from its parts and both;
//! tables of the guide's page on the filter come from here.
//!
//! Nothing of the filter is used. With one-sided spectra, `N = 2T ∫ Σ_k P_k(f) M_kᵀ S(f)⁻¹ M_k df`: `P_k` of the known
//! angular acceleration about axis `k` of SRF in closed loop, `M_k b = b × e_k`, `S` of what hides it in the
//! acceleration of the test mass (forces, readouts differenced twice, and the angular acceleration that nobody can
//! know).

#![allow(clippy::print_stdout, reason = "it prints a table")]

use dragfree_physics::control_design::{Design, design};
use dragfree_physics::frames::skew;
use dragfree_physics::mission::{Control, Mission};
use dragfree_physics::noise::NoiseShape;
use dragfree_physics::thrust_noise::ThrustNoise;
use nalgebra::{Matrix3, Vector3};
use std::f64::consts::TAU;

const DAY_S: f64 = 86_400.0;
/// Below, readout noise leaves nothing.
const LOWEST_HZ: f64 = 1e-5;
const GRID: usize = 4000;

/// σ of the offset in ORF after `duration_s`, m.
fn bound(mission: &Mission, design: &Design, test_mass: &str, duration_s: f64) -> Vector3<f64> {
    let tm = mission.test_mass(test_mass, "the example").expect("a test mass");
    let (dcm, dt_s, noise) = (tm.dcm_orf_from_srf(), mission.dt_s(), &mission.noise);
    let x = noise.ifo_x.as_ref().or(noise.is_x.as_ref());
    let readout = [x, noise.is_y.as_ref(), noise.is_z.as_ref()].map(|n| n.expect("a readout").shape());
    let shape = |n: Option<NoiseShape>| n.unwrap_or_default();
    let stray = shape(noise.test_mass_acceleration.as_ref().map(|n| n.shape()));
    let electrodes = shape(noise.electrostatic_force.as_ref().map(|n| n.shape()));
    let sunlight = shape(noise.solar_pressure.as_ref().map(|n| n.shape()));
    let thrust = ThrustNoise::of(mission).expect("thrust noise");
    let lever = skew(&tm.offset_nominal_orf_m()) * dcm;

    let highest_hz = 0.5 / dt_s * (1.0 - 1e-4);
    let ratio = (highest_hz / LOWEST_HZ).powf(1.0 / GRID as f64);
    let mut information = Matrix3::zeros();
    for i in 0..GRID {
        let f = LOWEST_HZ * ratio.powf(i as f64 + 0.5);
        let width_hz = f * (ratio.sqrt() - 1.0 / ratio.sqrt());
        let phase = TAU * f * dt_s;
        // The second difference of a readout over the mean of two steps' accelerations.
        let differenced = (2.0 - 2.0 * phase.cos()) / (dt_s * dt_s) / (0.5 * phase).cos();
        let mut known = [0.0; 3];
        let mut hidden = Matrix3::zeros();
        for (k, channel) in design.channels.iter().take(3).enumerate() {
            let torque = channel.model.disturbance.psd(f);
            let seen = channel.model.readout.psd(f) * differenced * differenced;
            let unknown = torque * seen / (torque + seen);
            let moves = channel.sensitivity(f).norm_sqr() * torque + channel.complementary(f).norm_sqr() * seen;
            known[k] = (moves - unknown).max(0.0);
            hidden[(k, k)] = unknown;
        }
        let forces = stray.psd(f) + sunlight.psd(f) / mission.spacecraft.mass_kg.powi(2);
        let lateral = electrodes.psd(f) / tm.mass_kg.powi(2);
        let left = thrust.force_given_torque * (thrust.force_shape.psd(f) / mission.spacecraft.mass_kg.powi(2));
        let of_readout = Vector3::from_fn(|i, _| readout[i].psd(f) * differenced * differenced);
        let on_axes = Vector3::new(forces, forces + lateral, forces + lateral) + of_readout;
        let hides =
            Matrix3::from_diagonal(&on_axes) + dcm * left * dcm.transpose() + lever * hidden * lever.transpose();
        let weight = hides.try_inverse().expect("noise on every axis");
        for (k, known) in known.iter().enumerate() {
            let m = -skew(&dcm.column(k).into_owned());
            information += m.transpose() * weight * m * (2.0 * duration_s * known * width_hz);
        }
    }
    information.try_inverse().expect("all three are seen").diagonal().map(f64::sqrt)
}

fn row(label: &str, mission: &Mission) {
    let design = design(mission).expect("a design");
    print!("{label:44}");
    for days in [1.0, 25.0] {
        for name in ["tm1", "tm2"] {
            let s = bound(mission, &design, name, days * DAY_S) * 1e3;
            print!(" {:7.3} {:6.4} {:6.4} |", s.x, s.y, s.z);
        }
    }
    println!();
}

fn main() {
    let path = std::env::args().nth(1).unwrap_or_else(|| "fixtures/missions/taiji.toml".to_owned());
    let text = std::fs::read_to_string(&path).expect("a mission file");
    let value: toml::Value = toml::from_str(&text).expect("TOML");
    let mission = Mission::from_json(&serde_json::to_string(&value).expect("JSON")).expect("a mission");
    println!("sigma in mm, x y z in ORF: tm1 and tm2 after 1 day | tm1 and tm2 after 25 days");
    row("as in the file", &mission);
    for factor in [0.5, 0.75, 1.0, 1.25] {
        let mut changed = mission.clone();
        let control = changed.control.take().unwrap_or_default();
        changed.control = Some(Control { attitude_bandwidth_factor: factor, ..control });
        row(&format!("attitude_bandwidth_factor = {factor}"), &changed);
    }
    for dws in [2.09e-10, 1e-9, 2e-9, 5e-9] {
        let mut changed = mission.clone();
        changed.noise.dws_long_arm.as_mut().expect("wavefront sensing").asd_rad_rthz = dws;
        row(&format!("dws_long_arm.asd_rad_rthz = {dws:e}"), &changed);
    }
    for torque in [1e-8, 3e-8, 3e-7, 1e-6] {
        let mut changed = mission.clone();
        changed.noise.thruster_torque.as_mut().expect("thrusters").asd_nm_rthz = torque;
        row(&format!("thruster_torque.asd_nm_rthz = {torque:e}"), &changed);
    }
    for force in [5e-8, 2e-7, 5e-7] {
        let mut changed = mission.clone();
        changed.noise.thruster_force.as_mut().expect("thrusters").asd_n_rthz = force;
        row(&format!("thruster_force.asd_n_rthz = {force:e}"), &changed);
    }
}
