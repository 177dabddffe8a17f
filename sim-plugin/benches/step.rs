//! One epoch of the loop, whole and by its shares: noise, control law, equations of motion. What is left of the whole
//! is readout, surroundings and book-keeping.

use criterion::{Criterion, criterion_group, criterion_main};
use dragfree_physics::control::ControlLaw;
use dragfree_physics::mission::Mission;
use dragfree_sim::orbit::Constellation;
use dragfree_sim::plant::{Loads, Outside, State};
use dragfree_sim::sensors::Noises;
use dragfree_sim::simulator::{Settings, Simulator};
use nalgebra::Vector3;
use rand::SeedableRng;
use rand_xoshiro::Xoshiro256PlusPlus;
use std::hint::black_box;
use std::io::Write as _;
use std::time::{Duration, Instant};

const START_NS: i64 = 2_051_222_400_000_000_000;

fn mission() -> Mission {
    let text = include_str!("../../fixtures/missions/taiji.toml");
    let value: serde_json::Value = toml::from_str(text).expect("the fixture is TOML");
    Mission::from_json(&value.to_string()).expect("the fixture is a mission")
}

fn simulator() -> Simulator {
    let settings = Settings {
        seed: 1,
        start_ns: START_NS,
        settle_s: 60.0,
        com_offset_srf_m: Vector3::new(0.001, 0.0, 0.0),
        stiffness_error: 0.2,
        manoeuvres: Vec::new(),
        effects: Vec::new(),
    };
    Simulator::new(&mission(), settings).expect("the fixture flies")
}

/// One epoch of each share.
struct Shares {
    parts: Vec<Part>,
}

type Part = (&'static str, Box<dyn FnMut()>);

impl Shares {
    fn new() -> Self {
        let mission = mission();
        let mut whole = simulator();
        let plant = whole.plant().clone();
        let environment = whole.constellation().at(START_NS).expect("the start lies in the ephemeris");
        let outside = Outside {
            omega_crf_rad_s: environment.omega_crf_rad_s,
            alpha_crf_rad_s2: environment.alpha_crf_rad_s2,
            gradient_orf_s2: [environment.gradient_crf_s2; 2].into(),
        };
        let loads = Loads { torque_srf_nm: Vector3::new(1e-9, -1e-9, 2e-9), ..Loads::zero(2) };
        let mut state = State::at_rest(&Vector3::zeros(), &[Default::default(); 2], &plant, &outside);
        let mut noises = Noises::new(&mission).expect("the fixture has noise");
        let mut rng = Xoshiro256PlusPlus::seed_from_u64(1);
        noises.start(&mut rng);
        let still = state;
        let readout = noises.measure(&state, &mut rng).readout(Some(Vector3::new(0.9, 0.1, -0.4)));
        let mut law = ControlLaw::new(&mission).expect("the fixture has a controller");
        let parts: [Part; 4] = [
            (
                "whole epoch",
                Box::new(move || {
                    black_box(whole.step().expect("the loop holds"));
                }),
            ),
            (
                "equations of motion",
                Box::new(move || {
                    black_box(plant.step(black_box(&mut state), black_box(&loads), black_box(&outside), 0.1));
                }),
            ),
            (
                "noise and readout",
                Box::new(move || {
                    black_box(noises.measure(black_box(&still), &mut rng));
                }),
            ),
            (
                "control law",
                Box::new(move || {
                    black_box(law.step(black_box(&readout)));
                }),
            ),
        ];
        Self { parts: parts.into() }
    }

    /// Best time of one epoch of every part, ns, taken in turns: on a busy machine all see the same neighbours.
    fn measure(&mut self) -> Vec<f64> {
        const EPOCHS: u32 = 20_000;
        let mut best = vec![Duration::MAX; self.parts.len()];
        for _ in 0..100 {
            for ((_, part), best) in self.parts.iter_mut().zip(&mut best) {
                let start = Instant::now();
                (0..EPOCHS).for_each(|_| part());
                *best = start.elapsed().min(*best);
            }
        }
        best.iter().map(|b| b.as_secs_f64() * 1e9 / f64::from(EPOCHS)).collect()
    }
}

fn bench(c: &mut Criterion) {
    let mut shares = Shares::new();
    let times = shares.measure();
    let table = shares
        .parts
        .iter()
        .zip(&times)
        .map(|((name, _), ns)| format!("{name:24} {ns:7.0} {:6.1} % {:9.0}\n", 100.0 * ns / times[0], 1e8 / ns));
    let title = "best of 100: ns an epoch, share of the whole, times real time at 10 Hz\n".to_owned();
    let table: String = std::iter::once(title).chain(table).collect();
    std::io::stdout().write_all(table.as_bytes()).expect("a place to print to");
    for (name, part) in &mut shares.parts {
        c.bench_function(name, |b| b.iter(&mut *part));
    }
    let mission = mission();
    c.bench_function("orbits, once a run", |b| b.iter(|| Constellation::new(black_box(&mission))));
    let constellation = Constellation::new(&mission).expect("the epoch lies in the ephemeris");
    // A day and a half after a node.
    let time_ns = START_NS + 129_600_000_000_000;
    c.bench_function("surroundings, once a minute", |b| b.iter(|| constellation.at(black_box(time_ns))));
}

criterion_group!(benches, bench);
criterion_main!(benches);
