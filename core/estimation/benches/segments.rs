//! Cost of an epoch: nine channels, two offsets (eighteen regressors), segments of 16384 samples; and of one solution.

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use dragfree_estimation::collected::Collected;
use dragfree_estimation::estimate::{Observed, Unknown, estimate};
use dragfree_estimation::prediction::Prediction;
use dragfree_estimation::segments::Segmenter;
use dragfree_estimation::sigma::NoiseModel;
use dragfree_estimation::spectra::{Analyser, Layout, Plan, Regressor};
use dragfree_hinf_dfacs::noise::declared;
use dragfree_physics::mission::Mission;
use rand::SeedableRng;
use rand_distr::{Distribution, StandardNormal};
use rand_xoshiro::Xoshiro256PlusPlus;
use std::hint::black_box;

const CHANNELS: [&str; 9] = [
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
const ROWS: usize = 131_072;

fn bench(criterion: &mut Criterion) {
    let text = include_str!("../../../fixtures/missions/taiji.toml");
    let value: serde_json::Value = toml::from_str(text).expect("the fixture is TOML");
    let mission = Mission::from_json(&value.to_string()).expect("the fixture is a mission");
    let model =
        NoiseModel::new(&declared(&mission, &[["ifo_x", "is_y", "is_z"]; 2]), &CHANNELS, 0.1).expect("a noise model");
    let regressors = (0..18)
        .map(|series| {
            let coefficient = series / 3;
            Regressor {
                coefficient,
                channel: 3 * (coefficient / 3) + series % 3,
                series,
                factor: 1.0,
                times: None,
                in_loop: false,
            }
        })
        .collect();
    let names = |n: usize| (0..n).map(|i| i.to_string()).collect();
    let channels = CHANNELS.map(str::to_owned).to_vec();
    let layout = Layout { channels, series: names(18), regressors, coefficients: names(6) };
    let mut rng = Xoshiro256PlusPlus::seed_from_u64(1);
    let columns: Vec<Vec<f64>> = (0..layout.columns())
        .map(|_| {
            (0..ROWS).map(|_| 1e-9 * <StandardNormal as Distribution<f64>>::sample(&StandardNormal, &mut rng)).collect()
        })
        .collect();
    let slices: Vec<&[f64]> = columns.iter().map(Vec::as_slice).collect();
    let times: Vec<i64> = (0..ROWS as i64).map(|k| 100_000_000 * k).collect();
    let mut analyser = Analyser::new(Plan::new(16_384, 10.0), &layout);
    let run = |analyser: &mut Analyser| {
        let prediction = Prediction::new(&model, &[true; 9], &layout, analyser.plan());
        let mut collected = Collected::new(analyser.plan(), &layout, prediction);
        let mut segmenter = Segmenter::new(16_384, 100_000_000, (0..27).map(|j| j >= 9).collect());
        segmenter.push(&times, &slices, analyser, &mut collected);
        collected
    };

    let mut group = criterion.benchmark_group("estimation");
    group.sample_size(10).throughput(Throughput::Elements(ROWS as u64));
    group.bench_function("epochs", |b| b.iter(|| run(black_box(&mut analyser))));
    group.finish();

    let collected = run(&mut analyser);
    let unknowns: Vec<Unknown> = (0..6)
        .map(|i| Unknown {
            name: format!("b{i}"),
            unit: "m".into(),
            lower: -0.3,
            upper: 0.3,
            initial: 0.0,
            prior_sigma: 0.02,
            estimate: true,
            colours: None,
        })
        .collect();
    criterion.bench_function("estimation/solution", |b| {
        let (plan, prediction) = (analyser.plan(), collected.prediction.as_ref());
        let observed = Observed { layout: &layout, plan, sums: &collected.sums, prediction };
        b.iter(|| estimate(black_box(&observed), &model, &unknowns, &[], 3));
    });
}

criterion_group!(benches, bench);
criterion_main!(benches);
