//! The closed loop as a whole: it holds the requirement table, its channels are decoupled, its steps converge.

use dragfree_physics::attitude::rotation_vector;
use dragfree_physics::control::{ControlLaw, Readout};
use dragfree_physics::mission::{Control, Mission};
use dragfree_physics::spectrum::welch;
use dragfree_sim::plant::{Loads, Outside, Plant, State};
use dragfree_sim::simulator::{Settings, Simulator};
use nalgebra::{Matrix3, Vector3};

fn taiji() -> Mission {
    let value: serde_json::Value = toml::from_str(include_str!("../../fixtures/missions/taiji.toml")).unwrap();
    Mission::from_json(&value.to_string()).unwrap()
}

fn settings(seed: u64) -> Settings {
    Settings {
        seed,
        start_ns: 2_051_222_400_000_000_000,
        settle_s: 600.0,
        com_offset_srf_m: Vector3::new(0.001, 0.0, 0.0),
        stiffness_error: 0.2,
        effects: Vec::new(),
    }
}

const CHANNELS: [&str; 15] = dragfree_physics::mission::CHANNELS;

/// True states of the fifteen channels, hours of them at 10 Hz.
fn states(mission: &Mission, hours: usize) -> Vec<Vec<f64>> {
    let mut simulator = Simulator::new(mission, settings(1)).unwrap();
    let mut out = vec![Vec::new(); 15];
    for _ in 0..hours * 36_000 {
        let y = simulator.state();
        let [a, b] = &y.tm;
        let vectors = [
            y.sc_crf_rad(),
            a.r_orf_m,
            rotation_vector(&a.q_mrf_from_orf),
            b.r_orf_m,
            rotation_vector(&b.q_mrf_from_orf),
        ];
        for (series, value) in out.iter_mut().zip(vectors.iter().flat_map(|v| v.iter())) {
            series.push(*value);
        }
        simulator.step().unwrap();
    }
    out
}

/// tab:state_precision_requirements, PSD.
fn requirement(mission: &Mission, channel: &str, f_hz: f64) -> f64 {
    let r = mission.requirements.as_ref().unwrap();
    let corner = (1.0 + (r.corner_hz / f_hz).powi(4)).sqrt();
    let asd = match channel.split_once('.').unwrap() {
        ("sc", _) => r.sc_attitude_rad_rthz * corner,
        (_, "x") => r.tm_x_m_rthz,
        (_, "y" | "z") => r.tm_yz_m_rthz,
        (_, "phi") => r.tm_phi_rad_rthz * corner,
        _ => r.tm_theta_psi_rad_rthz * corner,
    };
    asd * asd
}

/// Bands from 1.5 mHz to 1 Hz. Below, four hours have too few segments; the design's own test goes down to 0.1 mHz.
const BANDS_HZ: [(f64, f64); 7] =
    [(1.5e-3, 3e-3), (3e-3, 6e-3), (6e-3, 1.2e-2), (1.2e-2, 3e-2), (3e-2, 0.1), (0.1, 0.3), (0.3, 1.0)];

/// Largest `measured/requirement`, in PSD, and its band's relative scatter.
fn worst(mission: &Mission, channel: &str, series: &[f64]) -> (f64, f64) {
    let spectrum = welch(series, 10.0, 20_000).unwrap();
    let ratios = BANDS_HZ.map(|(lo, hi)| spectrum.ratio(lo..hi, |f| requirement(mission, channel, f)).unwrap());
    ratios.iter().map(|r| (r.value, r.sigma)).fold((0.0, 0.0), |a, b| if b.0 > a.0 { b } else { a })
}

/// Four hours of true states against the table, band means of Welch's PSD. All channels but one stay below even when the
/// estimate lies 4 standard deviations low (confidence 0.99997 a band). The roll `φ` of the test masses is read with
/// 1.5e-7 rad/√Hz against a requirement of 2e-7: it uses the table up, and is only asked not to exceed it significantly.
#[test]
fn four_hours_meet_the_requirement_table() {
    let mission = taiji();
    for (channel, series) in CHANNELS.iter().zip(states(&mission, 4)) {
        let (ratio, sigma) = worst(&mission, channel, &series);
        let bound =
            if channel.ends_with("phi") && !channel.starts_with("sc") { 1.0 + 4.0 * sigma } else { 1.0 - 4.0 * sigma };
        assert!(ratio < bound.max(0.3), "{channel}: {ratio} of the requirement, scatter {sigma}");
    }
}

/// The same judgement finds thrusters ten times too noisy.
#[test]
fn noisy_thrusters_break_the_table() {
    let mut mission = taiji();
    let designed = dragfree_physics::control_design::design(&mission).unwrap().controllers();
    mission.control = Some(Control { delay_samples: 1, lever_feed_forward: true, channel: designed });
    mission.noise.thruster_force.as_mut().unwrap().asd_n_rthz *= 10.0;
    let series = states(&mission, 1);
    assert!(worst(&mission, "tm1.x", &series[3]).0 > 1.5);
}

/// One channel's controller moves that channel and no other: the control law's `B_v` and `A_v` are those of the exact
/// equations of motion, signs included.
#[test]
fn channels_are_decoupled_in_the_exact_plant() {
    let mut mission = taiji();
    mission.control = Some(Control { delay_samples: 0, lever_feed_forward: true, channel: Default::default() });
    mission.actuators = None;
    let ones = [[Matrix3::from_element(1.0); 3]; 2];
    let plant = Plant::new(&mission, &Vector3::zeros(), &ones).unwrap();
    let outside = Outside {
        omega_crf_rad_s: Vector3::zeros(),
        alpha_crf_rad_s2: Vector3::zeros(),
        gradient_orf_s2: [Matrix3::zeros(); 2],
    };
    for j in 0..15 {
        let mut p = [Vector3::zeros(); 5];
        p[j / 3][j % 3] = 1e-9;
        let mut y = State::at_rest(&p[0], &[(p[1], p[2]), (p[3], p[4])], &plant, &outside);
        let mut readout = Readout { sc_crf_rad: p[0], ..Readout::default() };
        for i in 0..2 {
            (readout.tm[i].r_orf_m, readout.tm[i].att_orf_rad) = (p[1 + 2 * i], p[2 + 2 * i]);
        }
        let command = ControlLaw::new(&mission).unwrap().step(&readout);
        let mut loads = Loads {
            force_srf_n: command.mps_force_srf_n,
            torque_srf_nm: command.mps_torque_srf_nm,
            ..Loads::default()
        };
        for i in 0..2 {
            loads.tm[i].force_orf_n = command.tm[i].force_orf_n;
            loads.tm[i].torque_orf_nm = command.tm[i].torque_orf_nm;
        }
        let before = y;
        plant.step(&mut y, &loads, &outside, 0.1);
        let change = |f: &dyn Fn(&State) -> Vector3<f64>| (f(&y) - f(&before)) * 10.0;
        let alpha = change(&|y| y.omega_srf_rad_s);
        let mut found = vec![alpha];
        for i in 0..2 {
            found.push(change(&|y| y.tm[i].v_orf_m_s));
            found.push(change(&|y| y.tm[i].omega_mrf_rad_s) - plant.tm[i].dcm_orf_from_srf * alpha);
        }
        let found: Vec<f64> = found.iter().flat_map(|v| v.iter().copied()).collect();
        assert!(found[j] < -1e-12, "{}: {} answers the wrong way", CHANNELS[j], found[j]);
        for (i, other) in found.iter().enumerate().filter(|(i, _)| *i != j) {
            assert!(other.abs() < 1e-6 * found[j].abs(), "{} moves {}: {other}", CHANNELS[j], CHANNELS[i]);
        }
    }
}
