//! Commands that were not telemetered are rebuilt by a control law: is it the one that flew?

use dragfree_hinf_dfacs::reconstruction::AngularAcceleration::Smoother;
use dragfree_hinf_dfacs::reconstruction::{Epoch, Settings};
use dragfree_physics::mission::{Control, Mission};
use dragfree_physics::process::normal;
use nalgebra::Vector3;
use rand::SeedableRng;
use rand_xoshiro::Xoshiro256PlusPlus;

use crate::common::{AttitudeLoop, RATE_HZ, levels, mission, run, settings, stage, unknown};

/// Telemetry of a noisy attitude loop; its commands are left out.
fn telemetry(flying: &Mission, seed: u64, epochs: usize) -> Vec<Epoch> {
    let mut rng = Xoshiro256PlusPlus::seed_from_u64(seed);
    let [torque, sensing] = levels(flying).map(|psd| (0.5 * RATE_HZ * psd).sqrt());
    let mut attitude = AttitudeLoop::new(flying);
    let mut gauss = |sigma: f64| Vector3::from_fn(|_, _| sigma * normal(&mut rng));
    let steps = (0..epochs).map(|_| attitude.step(&gauss(torque), &gauss(sensing)).0);
    steps.map(|epoch| Epoch { command: unknown(), ..epoch }).collect()
}

/// Correlation of the innovations with the rebuilt commands, σ, after an hour.
fn inconsistency(flying: &Mission, file: &Mission, seed: u64) -> [f64; 3] {
    let mut stage = stage(file, &Settings { commands: false, replay: true, ..settings(Smoother) });
    run(&mut stage, &telemetry(flying, seed, 36_000));
    stage.inconsistency_sigma().expect("an hour is enough")
}

/// The controllers of the default design with other gains.
fn with_gains(scale: f64) -> Mission {
    let mut mission = mission();
    let design = dragfree_physics::control_design::design(&mission).expect("the fixture is complete");
    let mut channel = design.controllers();
    for controller in channel.values_mut() {
        controller.gain_s2 *= scale;
    }
    mission.control = Some(Control { channel, ..Control::default() });
    mission
}

/// Thirty standard normal deviates: Σz² within its 1e-4 and 1 − 1e-4 quantiles of χ² with 30 degrees of freedom.
#[test]
fn the_law_that_flew_is_not_suspected() {
    let mission = mission();
    let squares: f64 = (0..10).flat_map(|seed| inconsistency(&mission, &mission, seed)).map(|z| z * z).sum();
    assert!((8.3..68.0).contains(&squares), "{squares}");
}

/// The twin: gains 25 % off, either way, are seen within an hour, about some axis at least.
#[test]
fn a_wrong_controller_file_is_noticed() {
    for scale in [0.8, 1.25] {
        let z = inconsistency(&with_gains(scale), &mission(), 1);
        assert!(z.iter().any(|z| z.abs() > 5.0), "gains {scale}: {z:?}");
    }
}
