//! One epoch of the loop: the equations of motion alone, and with noise, readout and control.

use criterion::{Criterion, criterion_group, criterion_main};
use dragfree_physics::mission::Mission;
use dragfree_sim::imperfection::Imperfections;
use dragfree_sim::orbit::Environment;
use dragfree_sim::plant::{Loads, Outside, State};
use dragfree_sim::simulator::{Settings, Simulator};
use nalgebra::Vector3;
use std::hint::black_box;

fn simulator() -> Simulator {
    let text = include_str!("../../fixtures/missions/taiji.toml");
    let value: serde_json::Value = toml::from_str(text).expect("the fixture is TOML");
    let mission = Mission::from_json(&value.to_string()).expect("the fixture is a mission");
    let settings = Settings {
        seed: 1,
        start_ns: 2_051_222_400_000_000_000,
        settle_s: 60.0,
        com_offset_srf_m: Vector3::new(0.001, 0.0, 0.0),
        stiffness_error: 0.2,
        imperfections: Imperfections::default(),
    };
    Simulator::new(&mission, settings).expect("the fixture flies")
}

fn bench(c: &mut Criterion) {
    let mut running = simulator();
    let plant = running.plant().clone();
    let environment = Environment::at(2_051_222_400_000_000_000);
    let outside = Outside {
        omega_crf_rad_s: environment.omega_crf_rad_s,
        alpha_crf_rad_s2: environment.alpha_crf_rad_s2,
        gradient_orf_s2: [environment.gradient_crf_s2; 2],
    };
    let loads = Loads { torque_srf_nm: Vector3::new(1e-9, -1e-9, 2e-9), ..Loads::default() };
    let mut state = State::at_rest(&Vector3::zeros(), &Default::default(), &plant, &outside);
    c.bench_function("equations of motion, one sample", |b| {
        b.iter(|| plant.step(black_box(&mut state), black_box(&loads), black_box(&outside), 0.1));
    });
    c.bench_function("closed loop, one sample", |b| b.iter(|| running.step().expect("the loop holds")));
}

criterion_group!(benches, bench);
criterion_main!(benches);
