//! Time per epoch of the whole stage behind the border, replay of the control law included.

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use dragfree_hinf_dfacs::noise_calibration::NoiseScale;
use dragfree_hinf_dfacs::on_demand::Needs;
use dragfree_hinf_dfacs::reconstruction::{AngularAcceleration, Epoch, Reconstruction, Settings};
use dragfree_physics::mission::Mission;
use nalgebra::Vector3;
use std::hint::black_box;

fn stage(criterion: &mut Criterion) {
    let text = include_str!("../../../fixtures/missions/taiji.toml");
    let value: serde_json::Value = toml::from_str(text).expect("the fixture is TOML");
    let mission = Mission::from_json(&value.to_string()).expect("the fixture is a mission");
    const EPOCHS: u64 = 4096;
    let mut group = criterion.benchmark_group("hinf-dfacs");
    group.throughput(Throughput::Elements(EPOCHS));
    let everything = Needs { commands: true, torque_response: true, dws_delay_response: true, prediction: false };
    for (name, replay, needs) in [
        ("with replay", true, Needs::default()),
        ("without replay", false, Needs::default()),
        ("without replay, every column on demand", false, everything),
    ] {
        let settings = Settings {
            rate_hz: 10.0,
            angular_acceleration: AngularAcceleration::Smoother,
            commands: true,
            sun: true,
            replay,
            warm_up_s: 600.0,
            scale: NoiseScale::nominal(),
            needs,
        };
        let mut reconstruction = Reconstruction::new(&mission, &settings).expect("the fixture is complete");
        let mut rows = Vec::new();
        let mut k = 0_i64;
        group.bench_function(name, |b| {
            b.iter(|| {
                for _ in 0..EPOCHS {
                    let wiggle = (k % 97) as f64 * 1e-11;
                    let epoch = Epoch {
                        time_ns: k * 100_000_000,
                        readout: [wiggle; 15].into(),
                        command: [wiggle; 18].into(),
                        sun_srf: Vector3::x(),
                        ephemeris_age_s: f64::NAN,
                        omega_crf_rad_s: Vector3::z() * 2e-7,
                        alpha_crf_rad_s2: Vector3::zeros(),
                    };
                    k += 1;
                    reconstruction.push(black_box(&epoch), &mut rows).expect("the law takes its own state");
                }
                black_box(&rows);
                rows.clear();
            });
        });
    }
}

criterion_group!(benches, stage);
criterion_main!(benches);
