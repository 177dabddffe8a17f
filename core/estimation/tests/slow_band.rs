//! The slow bands: a coefficient whose series has nothing in the bins of ordinary segments is found with the σ that its
//! information allows, whatever else is slow, and no gain in the loop is moved.
//!
//! Two channels see one loud force and a quiet one each, drawn here sample by sample. The bound is that of Cramér and
//! Rao for white noise in the time domain, with no code of the crate.

use dragfree_estimation::collected::Collected;
use dragfree_estimation::estimate::{Estimate, Method, Observed, Refinement, Unknown, estimate_with};
use dragfree_estimation::segments::Segmenter;
use dragfree_estimation::sigma::{BandNoise, NoiseModel};
use dragfree_estimation::spectra::{Analyser, Layout, Plan, Regressor};
use dragfree_schema::{NoiseProcess, NoiseResponse, NoiseShape, Settings};
use rand::SeedableRng;
use rand_distr::{Distribution, StandardNormal};
use rand_xoshiro::Xoshiro256PlusPlus;

/// Nine hours, eight long segments.
const ROWS: usize = 1 << 15;
/// An hour, less than a long segment.
const HOUR: usize = 3600;
/// Samples of an ordinary segment at 1 Hz. Its first bin is at 12 mHz, a long segment's at 0.5 mHz.
const LENGTH: usize = 256;
/// Amplitude spectral densities of the force on both channels, of that on each, and of a readout, per √Hz.
const BOTH: f64 = 1e-10;
const EACH: f64 = 1e-12;
const READOUT: f64 = 1e-12;
const TRUTH: f64 = 3e-14;

fn declared() -> Vec<NoiseProcess> {
    let process = |name: &str, asd: f64, response, enters: [f64; 2]| NoiseProcess {
        name: name.to_owned(),
        spectrum: Some(NoiseShape::white(asd)),
        response,
        components: vec![name.to_owned()],
        enters: [("a".to_owned(), vec![enters[0]]), ("b".to_owned(), vec![enters[1]])].into(),
        ..NoiseProcess::default()
    };
    let mut all = vec![process("both", BOTH, NoiseResponse::Held, [1.0, 1.0])];
    for (name, enters) in [("a", [1.0, 0.0]), ("b", [0.0, 1.0])] {
        all.push(process(name, EACH, NoiseResponse::Held, enters));
        all.push(process(&format!("readout {name}"), READOUT, NoiseResponse::Differenced, enters));
    }
    all
}

/// Heat that comes and goes every 12 and 22 minutes.
fn slow(t: usize) -> f64 {
    let wave = |period_s: f64, phase: f64| (std::f64::consts::TAU * t as f64 / period_s + phase).sin();
    wave(700.0, 0.3) + wave(1300.0, 1.1)
}

/// What else there is.
#[derive(Clone, Copy)]
struct Scene {
    rows: usize,
    /// Root of the power at 1 Hz of a random walk of the force on channel a: it is as loud as the rest at this many Hz
    /// times [`EACH`].
    walk_hz: f64,
    /// Whether the force on both is answered by a command.
    in_loop: bool,
}

const QUIET: Scene = Scene { rows: ROWS, walk_hz: 0.0, in_loop: false };

/// Channels a and b, the slow series, and a command where there is a loop.
fn data(seed: u64, scene: Scene) -> Vec<Vec<f64>> {
    let mut rng = Xoshiro256PlusPlus::seed_from_u64(seed);
    // White noise of one-sided density S at 1 Hz has the variance S/2.
    let mut white = |asd: f64| -> Vec<f64> {
        (0..scene.rows + 2)
            .map(|_| asd * 0.5_f64.sqrt() * <StandardNormal as Distribution<f64>>::sample(&StandardNormal, &mut rng))
            .collect()
    };
    let (both, mut own) = (white(BOTH), [white(EACH), white(EACH)]);
    let readouts = [white(READOUT), white(READOUT)];
    // Steps of power S f_w² (2π)² make a density of S (f_w/f)².
    let steps = white(EACH * scene.walk_hz * std::f64::consts::TAU);
    let mut walk = 0.0;
    for (x, step) in own[0].iter_mut().zip(&steps) {
        walk += step;
        *x += walk;
    }
    let channel = |c: usize| -> Vec<f64> {
        let held = |k: usize| both[k] + own[c][k] + if c == 0 { TRUTH * slow(k) } else { 0.0 };
        let readout = &readouts[c];
        (0..scene.rows)
            .map(|k| 0.5 * (held(k) + held(k + 1)) + readout[k + 2] - 2.0 * readout[k + 1] + readout[k])
            .collect()
    };
    // Row k is the mean over samples k and k + 1; the segmenter averages a series with its predecessor.
    let mut all = vec![channel(0), channel(1), (1..=scene.rows).map(slow).collect()];
    if scene.in_loop {
        // Answers the past force below some 0.1 Hz.
        let mut command = 0.0;
        all.push(
            (0..scene.rows)
                .map(|k| {
                    command += 0.5 * (-both[k] - command);
                    command
                })
                .collect(),
        );
    }
    all
}

fn layout(in_loop: bool) -> Layout {
    let regressor = |coefficient, channel, in_loop| Regressor {
        coefficient,
        channel,
        series: coefficient,
        factor: 1.0,
        times: None,
        in_loop,
    };
    let names = |names: &[&str]| names.iter().map(|n| (*n).to_owned()).collect::<Vec<_>>();
    let mut regressors = vec![regressor(0, 0, false)];
    if in_loop {
        regressors.extend([regressor(1, 0, true), regressor(1, 1, true)]);
    }
    let coefficients = names(if in_loop { &["heat", "gain"] } else { &["heat"] });
    Layout { channels: names(&["a", "b"]), series: coefficients.clone(), regressors, coefficients }
}

fn solve(columns: &[Vec<f64>], plan: fn() -> Plan, refinements: usize, settings: &Settings) -> Estimate {
    let in_loop = columns.len() > 3;
    let layout = layout(in_loop);
    let mut analyser = Analyser::new(plan(), &layout);
    let mut collected = Collected::new(analyser.plan(), &layout, None);
    let mut segmenter = Segmenter::new(LENGTH, 1_000_000_000, vec![false, false, true, true][..columns.len()].to_vec());
    let times: Vec<i64> = (0..columns[0].len() as i64).map(|k| 1_000_000_000 * k).collect();
    let slices: Vec<&[f64]> = columns.iter().map(Vec::as_slice).collect();
    segmenter.push(&times, &slices, &mut analyser, &mut collected);
    segmenter.end_run(&mut analyser, &mut collected);
    let unknown = |name: &String| Unknown {
        name: name.clone(),
        unit: "1".to_owned(),
        lower: if name == "heat" { -1e-11 } else { -1.0 },
        upper: if name == "heat" { 1e-11 } else { 1.0 },
        initial: 0.0,
        prior_sigma: f64::INFINITY,
        estimate: true,
        colours: None,
    };
    let unknowns: Vec<Unknown> = layout.coefficients.iter().map(unknown).collect();
    let model = NoiseModel::new(&declared(), &layout.channels, 1.0).expect("a noise model");
    let plan = analyser.plan();
    let observed = Observed { layout: &layout, plan, sums: &collected.all(plan), prediction: None };
    let refinement = if in_loop { Refinement::Levels } else { Refinement::Bands };
    let method = Method { refinements, refinement, settings };
    estimate_with(&observed, &BandNoise::new(&model, plan), &unknowns, &[], &method).expect("a solution")
}

fn with_slow_bands() -> Plan {
    Plan::with_slow_bands(LENGTH, 1.0)
}

fn without() -> Plan {
    Plan::new(LENGTH, 1.0)
}

fn sigma(e: &Estimate, k: usize) -> f64 {
    e.covariance.as_ref().expect("a covariance")[(k, k)].sqrt()
}

/// Squared pulls of the slow coefficient over seeds, and the mean of its σ.
fn campaign(seeds: u64, scene: Scene, refinements: usize, settings: &Settings) -> (f64, f64) {
    let (mut squares, mut mean) = (0.0, 0.0);
    for seed in 0..seeds {
        let e = solve(&data(seed, scene), with_slow_bands, refinements, settings);
        squares += ((e.theta[0] - TRUTH) / sigma(&e, 0)).powi(2);
        mean += sigma(&e, 0) / seeds as f64;
    }
    (squares, mean)
}

/// Bounds of χ² of `n` degrees of freedom with a false alarm of 1e-4 on either side (Wilson and Hilferty).
fn is_chi2(squares: f64, n: u64) -> bool {
    let v = 2.0 / (9.0 * n as f64);
    let bound = |z: f64| n as f64 * (1.0 - v + z * v.sqrt()).powi(3);
    (bound(-3.72)..bound(3.72)).contains(&squares)
}

/// Of white noise of density S, `2 Σ φ² Δt/S` is the information; of two channels that share a loud force, what is on
/// one is weighed against the other, `1/S = (Σ⁻¹)_aa`.
fn cramer_rao_bound() -> f64 {
    let energy: f64 = (0..ROWS).map(|k| (0.5 * (slow(k) + slow(k + 1))).powi(2)).sum();
    let (both, each) = (BOTH * BOTH, EACH * EACH);
    let inverse = (both + each) / ((both + each).powi(2) - both * both);
    (2.0 * energy * inverse).sqrt().recip()
}

/// With the declared noise σ is the bound but for the ends of the run and of the taper, 10 %; where noise is measured,
/// its uncertainty costs up to 10 % more (Wishart, eight observations or more of two channels). χ² of 100 runs has a
/// false alarm of 2e-4. Without slow bands σ is more than fifty times the bound.
#[test]
fn a_slow_coefficient_has_the_sigma_of_its_information() {
    let (settings, bound) = (Settings::default(), cramer_rao_bound());
    for (refinements, widest) in [(0, 1.12), (3, 1.2)] {
        let (squares, mean) = campaign(100, QUIET, refinements, &settings);
        assert!(is_chi2(squares, 100), "{squares}");
        assert!((1.0..widest).contains(&(mean / bound)), "{mean:e} against {bound:e}");
    }
    let twin = sigma(&solve(&data(0, QUIET), without, 3, &settings), 0);
    assert!(twin > 50.0 * bound, "{twin:e} against {bound:e}");
}

/// Beside an unknown slow force σ covers, over nine hours and over one; with the declared noise it does not, nor, in a
/// run too short for more than one band of Σ, without a random walk.
#[test]
fn an_unknown_slow_force_widens_sigma() {
    let settings = Settings::default();
    let without_walks = Settings { level_delta_chi2: f64::INFINITY, ..Settings::default() };
    for (rows, seeds) in [(ROWS, 50), (HOUR, 200)] {
        let scene = Scene { rows, walk_hz: 6e-3, ..QUIET };
        let (squares, _) = campaign(seeds, scene, 3, &settings);
        assert!(is_chi2(squares, seeds), "{squares} of {seeds}");
        let (as_declared, _) = campaign(seeds, scene, 0, &settings);
        assert!(as_declared > 10.0 * seeds as f64, "{as_declared} of {seeds}");
        let (flat, _) = campaign(seeds, scene, 3, &without_walks);
        assert!(rows > HOUR || !is_chi2(flat, seeds), "{flat} of {seeds}");
    }
}

/// A command answers the force on both channels. Its gain is that of ordinary segments alone, but for the part of a
/// thousandth of σ that the other coefficient moves it by, and this one is found as without a loop.
#[test]
fn a_gain_in_the_loop_is_not_estimated_from_slow_bands() {
    let (settings, scene) = (Settings::default(), Scene { in_loop: true, ..QUIET });
    let mut squares = 0.0;
    for seed in 0..50 {
        let columns = data(seed, scene);
        let plans: [fn() -> Plan; 2] = [with_slow_bands, without];
        let [slow, ordinary] = plans.map(|plan| solve(&columns, plan, 3, &settings));
        assert!((slow.theta[1] - ordinary.theta[1]).abs() < 1e-3 * sigma(&ordinary, 1));
        assert!((sigma(&slow, 1) / sigma(&ordinary, 1) - 1.0).abs() < 1e-3);
        assert!(sigma(&slow, 0) < 1.3 * cramer_rao_bound());
        squares += ((slow.theta[0] - TRUTH) / sigma(&slow, 0)).powi(2);
    }
    assert!(is_chi2(squares, 50), "{squares}");
}
