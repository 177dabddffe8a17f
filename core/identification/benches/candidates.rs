//! Cost of a hundred candidates: the sums of six hours at 10 Hz on two threads, and all of them ranked from these sums.

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use dragfree_estimation::segments::Segmenter;
use dragfree_estimation::sigma::NoiseModel;
use dragfree_hinf_dfacs::noise::declared;
use dragfree_identification::candidates::{CandidateSet, Coefficient, Form, Term};
use dragfree_identification::coherence::HousekeepingCoherence;
use dragfree_identification::columns::Columns;
use dragfree_identification::gram::{GramAccumulator, GramSums};
use dragfree_identification::lines::LineSearch;
use dragfree_identification::scores::CandidateScorer;
use dragfree_identification::transient::Search;
use dragfree_physics::mission::Mission;
use dragfree_schema::Settings;
use nalgebra::DMatrix;
use rand::SeedableRng;
use rand_distr::{Distribution, StandardNormal};
use rand_xoshiro::Xoshiro256PlusPlus;
use realfft::RealFftPlanner;
use realfft::num_complex::Complex64;
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
/// Series of two offsets.
const MODEL: usize = 18;
const CANDIDATES: usize = 100;
/// As many of them are slow as among the bundled effects.
const SLOW: usize = 60;
const ROWS: usize = 216_000;
/// Rows in one call, as in a replay.
const BATCH: usize = 4096;
const LENGTH: usize = 16_384;
const RATE_HZ: f64 = 10.0;

fn candidate_set() -> CandidateSet {
    let coefficient = |name: String, candidate: bool, terms: Vec<Term>| Coefficient {
        effect: name.clone(),
        instance: String::new(),
        name,
        initial: 0.0,
        prior_sigma: None,
        estimate: !candidate,
        candidate,
        transient: false,
        forms: vec![Form {
            shape: serde_json::Map::new(),
            unit: "1".to_owned(),
            lower: None,
            upper: None,
            terms,
            colours: None,
        }],
        noise: String::new(),
    };
    let term = |channel: usize, column: usize| Term { channel, column, factor: 1.0, times: None };
    let offset = |i: usize| {
        let terms = (0..3).map(|axis| term(3 * (i / 3) + axis, CHANNELS.len() + 3 * i + axis)).collect();
        coefficient(format!("offset {i}"), false, terms)
    };
    let candidate = |i: usize| {
        let column = CHANNELS.len() + MODEL + i;
        coefficient(format!("candidate {i}"), true, vec![term(i % CHANNELS.len(), column)])
    };
    CandidateSet {
        channels: CHANNELS.map(str::to_owned).to_vec(),
        coefficients: (0..MODEL / 3).map(offset).chain((0..CANDIDATES).map(candidate)).collect(),
        rules: Vec::new(),
    }
}

/// Channels with the noise that the mission has, so that no level is looked for longer than on clean telemetry.
fn channels_of(noise: &NoiseModel, white: &mut impl FnMut() -> f64) -> Vec<Vec<f64>> {
    let inverse = RealFftPlanner::<f64>::new().plan_fft_inverse(ROWS);
    let mut spectra = vec![inverse.make_input_vec(); CHANNELS.len()];
    for k in 1..ROWS / 2 {
        let psd = noise.psd(k as f64 * RATE_HZ / ROWS as f64);
        let factor = psd.cholesky().expect("positive definite").unpack();
        let draws: Vec<[f64; 2]> = CHANNELS.iter().map(|_| [white(), white()]).collect();
        // E|X|² = S/(2 T) for a one-sided S over a time T, and the inverse transform sums both signs.
        let scale = (0.25 * RATE_HZ / ROWS as f64).sqrt();
        for (i, spectrum) in spectra.iter_mut().enumerate() {
            let part = |p: usize| scale * (0..=i).map(|j| factor[(i, j)] * draws[j][p]).sum::<f64>();
            spectrum[k] = Complex64::new(part(0), part(1));
        }
    }
    let mut samples = |mut spectrum: Vec<Complex64>| {
        let mut time = inverse.make_output_vec();
        inverse.process(&mut spectrum, &mut time).expect("lengths of the plan");
        time
    };
    spectra.into_iter().map(&mut samples).collect()
}

fn gathered(columns: &[Vec<f64>], threads: usize) -> GramSums {
    let base = CHANNELS.len() + MODEL;
    let of = Columns {
        names: (0..columns.len()).map(|i| i.to_string()).collect(),
        tables: vec![String::new(); columns.len()],
        channels: CHANNELS.len(),
        base,
        fast: base + CANDIDATES - SLOW,
        energy: Vec::new(),
        housekeeping_units: Vec::new(),
    };
    let residual = DMatrix::from_fn(CHANNELS.len(), base, |i, j| f64::from(u8::from(i == j)));
    let search = Search::new(Vec::new(), residual.clone(), Vec::new());
    let averaged = (0..columns.len()).map(|j| j >= CHANNELS.len()).collect();
    let mut segmenter = Segmenter::new(LENGTH, (1e9 / RATE_HZ) as i64, averaged).of_first(of.fast);
    let coherence =
        |plan: &_| HousekeepingCoherence::new(Vec::new(), Vec::new(), plan, residual, Vec::new(), Vec::new());
    let mut gatherer = GramAccumulator::new(of, LENGTH, RATE_HZ, threads, coherence, search, LineSearch::nowhere());
    for first in (0..ROWS).step_by(BATCH) {
        let rows = first..(first + BATCH).min(ROWS);
        let times: Vec<i64> = rows.clone().map(|k| (1e9 / RATE_HZ) as i64 * k as i64).collect();
        let slices: Vec<&[f64]> = columns.iter().map(|c| &c[rows.clone()]).collect();
        segmenter.cut(&times, &slices, &mut gatherer);
    }
    segmenter.cut_end(&mut gatherer);
    gatherer.finish()
}

fn bench(criterion: &mut Criterion) {
    let text = include_str!("../../../fixtures/missions/taiji.toml");
    let value: serde_json::Value = toml::from_str(text).expect("the fixture is TOML");
    let mission = Mission::from_json(&value.to_string()).expect("the fixture is a mission");
    let noise = NoiseModel::new(&declared(&mission, &[["ifo_x", "is_y", "is_z"]; 2]), &CHANNELS, 1.0 / RATE_HZ)
        .expect("a noise model");
    let mut rng = Xoshiro256PlusPlus::seed_from_u64(1);
    let mut white = || -> f64 { StandardNormal.sample(&mut rng) };
    let mut columns = channels_of(&noise, &mut white);
    columns.extend((0..MODEL + CANDIDATES).map(|_| (0..ROWS).map(|_| 1e-9 * white()).collect()));

    let mut group = criterion.benchmark_group("100 candidates");
    group.sample_size(10).throughput(Throughput::Elements(ROWS as u64));
    group.bench_function("sums of six hours", |b| b.iter(|| gathered(black_box(&columns), 2)));
    group.finish();

    let (candidate_set, sums, settings) = (candidate_set(), gathered(&columns, 2), Settings::default());
    let scorer = CandidateScorer::new(&candidate_set, &sums, &noise, &settings);
    let fit = scorer.fit(&[]).expect("a solution");
    let mut group = criterion.benchmark_group("100 candidates");
    group.sample_size(10);
    group.bench_function("fit and rank", |b| {
        b.iter(|| scorer.rank(&scorer.fit(&[]).expect("a solution")).all.len());
    });
    group.bench_function("rank", |b| b.iter(|| black_box(scorer.rank(black_box(&fit))).all.len()));
    group.finish();
}

criterion_group!(benches, bench);
criterion_main!(benches);
