use std::collections::BTreeMap;

use dragfree_schema::{Colour, NoiseProcess, NoiseResponse, NoiseShape, NoiseTerm};
use nalgebra::{Cholesky, DMatrix, DVector};
use rand::{RngExt as _, SeedableRng as _};
use rand_xoshiro::Xoshiro256PlusPlus as StdRng;

use super::decision::{Candidate, Evidence, Prior, Quadratic, disagreement};
use super::filter::{FREE, Innovations, POWERS, Parameter, Passed, Setup, Sums};
use super::predictor::Predictor;
use super::state_space::{NoisePoint, NoiseStates};
use crate::transient::{Template, Transients};

const DT_S: f64 = 0.1;
const STEP_NS: i64 = 100_000_000;
/// Force beside the torque, in the same unit.
const FORCE: f64 = 1.0;

fn process(name: &str, response: NoiseResponse, terms: &[(f64, f64, u32)], enters: &[(&str, &[f64])]) -> NoiseProcess {
    let term = |(asd, corner_hz, exponent): &(f64, f64, u32)| NoiseTerm {
        asd: *asd,
        corner_hz: *corner_hz,
        exponent: *exponent,
    };
    let size = enters[0].1.len();
    NoiseProcess {
        name: name.to_owned(),
        response,
        spectrum: Some(NoiseShape { terms: terms.iter().map(term).collect() }),
        enters: enters.iter().map(|(c, gains)| ((*c).to_owned(), gains.to_vec())).collect(),
        components: (0..size).map(|k| format!("{name}:{k}")).collect(),
        ..NoiseProcess::default()
    }
}

fn channels() -> Vec<String> {
    ["a", "b"].map(str::to_owned).to_vec()
}

/// A force that both channels see, correlated with another, and a readout of each.
fn declared() -> Vec<NoiseProcess> {
    let force = process("force", NoiseResponse::Held, &[(2.0, 1.0, 0)], &[("a", &[1.0, 0.2]), ("b", &[0.5, -1.0])]);
    vec![
        NoiseProcess { covariance: Some(vec![vec![1.0, 0.3], vec![0.3, 2.0]]), ..force },
        process("first", NoiseResponse::Differenced, &[(0.05, 1.0, 0), (0.05, 0.3, 2)], &[("a", &[1.0])]),
        process("second", NoiseResponse::Differenced, &[(0.02, 1.0, 0), (0.02, 0.5, 4)], &[("b", &[1.0])]),
    ]
}

fn normal(random: &mut StdRng) -> f64 {
    let (u, v): (f64, f64) = (random.random(), random.random());
    (-2.0 * (1.0 - u).ln()).sqrt() * (std::f64::consts::TAU * v).cos()
}

/// Covariances of the channels between samples `lag` apart, from the definitions: means of two held accelerations,
/// second differences of readouts, and summed white noise among the readouts.
fn autocovariance(point: &NoisePoint, lag: usize) -> DMatrix<f64> {
    let known = DMatrix::identity(2, 2) + &point.unpredicted;
    let levels = |k: usize| point.levels[k];
    let force = DMatrix::from_row_slice(
        2,
        2,
        &[levels(0) * levels(0), 0.3 * levels(0) * levels(1), 0.3 * levels(0) * levels(1), 2.0 * levels(1) * levels(1)],
    ) * (4.0 / (2.0 * DT_S));
    let enters = DMatrix::from_row_slice(2, 2, &[1.0, 0.2, 0.5, -1.0]);
    // In powers of the delay.
    let mean = [&known * &enters * 0.5, &known * &enters * 0.5];
    let slope = &point.unpredicted_slope * &enters * (0.5 / DT_S);
    let force_gains = [&mean[0] + &slope, mean[1].clone(), -slope];
    let mut sum = DMatrix::zeros(2, 2);
    for l in 0..3 - lag.min(3) {
        sum += &force_gains[l + lag] * &force * force_gains[l].transpose();
    }
    let average = |i: usize, gains: [f64; 3], variance: f64, sum: &mut DMatrix<f64>| {
        for l in 0..3 - lag.min(3) {
            sum[(i, i)] += gains[l + lag] * gains[l] * variance;
        }
    };
    let per = DT_S.powi(-2);
    let second = [per, -2.0 * per, per];
    let step = |corner: f64| std::f64::consts::TAU * corner * DT_S;
    let white = |asd: f64, level: usize| (asd * levels(level)).powi(2) / (2.0 * DT_S);
    average(0, second, white(0.05, 2), &mut sum);
    average(0, [per, -per, 0.0], white(0.05, 2) * step(0.3).powi(2), &mut sum);
    average(1, second, white(0.02, 3), &mut sum);
    average(1, [per, 0.0, 0.0], white(0.02, 3) * step(0.5).powi(4), &mut sum);
    sum
}

fn system() -> NoiseStates {
    NoiseStates::new(&declared(), &channels(), DT_S, &[], &[]).expect("a system")
}

fn some_point(system: &NoiseStates) -> NoisePoint {
    let mut point = system.declared_point();
    point.levels = vec![1.1, 0.9, 1.2, 0.8];
    point.unpredicted[(0, 1)] = 0.3;
    point.unpredicted[(1, 1)] = -0.2;
    point.unpredicted_slope[(1, 0)] = 0.04;
    point
}

/// Innovations are the data whitened by the Cholesky factor of the covariance of all samples, once the start is over,
/// and the determinant of their covariance is the part of a sample in that of all.
#[test]
fn innovations_equal_those_of_the_covariance_of_all_samples() {
    let system = system();
    let point = some_point(&system);
    let predictor = Predictor::new(&system, &system.driving(&point)).expect("a predictor");
    let samples = 300;
    let covariance = DMatrix::from_fn(2 * samples, 2 * samples, |i, j| {
        let ((s, a), (t, b)) = ((i / 2, i % 2), (j / 2, j % 2));
        if s >= t { autocovariance(&point, s - t)[(a, b)] } else { autocovariance(&point, t - s)[(b, a)] }
    });
    let factor = Cholesky::new(covariance).expect("positive").l();
    let mut random = StdRng::seed_from_u64(1);
    let white = DVector::from_fn(2 * samples, |_, _| normal(&mut random));
    let data = &factor * &white;
    let mut state = DVector::zeros(system.transition.nrows());
    let mut worst = 0.0_f64;
    for t in 0..samples {
        let z = DVector::from_fn(2, |i, _| data[2 * t + i] / system.unit[i]);
        let e = z - &system.output * &state;
        state = &system.transition * state + &predictor.gain * &e;
        let whitened = &predictor.whitening * e;
        if t > 150 {
            worst = worst.max((whitened[0] - white[2 * t]).abs()).max((whitened[1] - white[2 * t + 1]).abs());
        }
    }
    assert!(worst < 1e-6, "{worst:e}");
    let of_channel = |i: usize| 2.0 * (factor[(2 * 250 + i, 2 * 250 + i)] / system.unit[i]).ln();
    assert!((predictor.ln_det() - of_channel(0) - of_channel(1)).abs() < 1e-9);
}

/// A pass over `data` (rows of channels) with the series.
fn pass(
    system: &NoiseStates,
    point: &NoisePoint,
    parameters: Vec<Parameter>,
    data: &[[f64; 2]],
    series: &[Vec<f64>],
    threads: usize,
) -> Sums {
    blocks(system, point, parameters, data, series, threads, None).total()
}

/// The same by blocks.
fn blocks(
    system: &NoiseStates,
    point: &NoisePoint,
    parameters: Vec<Parameter>,
    data: &[[f64; 2]],
    series: &[Vec<f64>],
    threads: usize,
    block: Option<u64>,
) -> Passed {
    let predictor = Predictor::new(system, &system.driving(point)).expect("a predictor");
    let count = series.first().map_or(0, Vec::len);
    let setup = Setup {
        system,
        predictor: &predictor,
        known: Vec::new(),
        parameters,
        starts: Vec::new(),
        series: count,
        averaged: false,
        step_ns: STEP_NS,
        block,
        threads,
    };
    let mut innovations = Innovations::new(setup);
    for (t, z) in data.iter().enumerate() {
        innovations.push(t as i64 * STEP_NS, z, series.get(t).map_or(&[], Vec::as_slice));
    }
    innovations.finish()
}

/// `log L` of the innovations that a pass sums.
fn log_likelihood(system: &NoiseStates, point: &NoisePoint, data: &[[f64; 2]]) -> f64 {
    let sums = pass(system, point, Vec::new(), data, &[], 1);
    -0.5 * (sums.ln_det + sums.chi2)
}

fn noise(samples: usize, seed: u64) -> Vec<[f64; 2]> {
    let mut random = StdRng::seed_from_u64(seed);
    (0..samples).map(|_| [30.0 * normal(&mut random), 20.0 * normal(&mut random)]).collect()
}

fn moved(system: &NoiseStates, point: &NoisePoint, parameter: usize, by: f64) -> NoisePoint {
    let mut point = point.clone();
    match parameter {
        0..4 => point.levels[parameter] *= by.exp(),
        4 => point.unpredicted[(0, 1)] += by,
        5 => point.unpredicted[(1, 0)] += by,
        6 => point.unpredicted_slope[(0, 0)] += by,
        _ => point.filtered[parameter - 7] += by,
    }
    assert_eq!(point.levels.len(), system.components.len());
    point
}

fn change(system: &NoiseStates, point: &NoisePoint, parameter: usize) -> Parameter {
    let h = 1e-4;
    let filter = parameter.checked_sub(7).filter(|k| point.filtered[*k] == 0.0);
    let extended = filter.map_or_else(|| system.clone(), |k| system.extended(k));
    let at = |by: f64| extended.driving(&moved(system, point, parameter, by));
    let driving = (at(h) - at(-h)) / (2.0 * h);
    let predictor = Predictor::new(system, &system.driving(point)).expect("a predictor");
    Parameter { responses: Vec::new(), change: Some(predictor.change(&extended, &driving)), ..Parameter::default() }
}

/// A resonance of each component of the force.
fn colours() -> Vec<Colour> {
    let colour = |(process, hz): (&str, f64)| {
        let omega = std::f64::consts::TAU * hz;
        let denominator = vec![omega * omega, 0.1 * omega, 1.0];
        Colour { process: process.to_owned(), numerator: vec![0.0, 0.0, 1.0], denominator }
    };
    [("force:0", 0.5), ("force:1", 0.8)].map(colour).to_vec()
}

/// The system and the point of [`some_point`] with effects that filter the force.
fn filtered(coefficients: [f64; 2]) -> (NoiseStates, NoisePoint) {
    let system = NoiseStates::new(&declared(), &channels(), DT_S, &colours(), &coefficients).expect("a system");
    let point = NoisePoint { filtered: coefficients.to_vec(), ..some_point(&system) };
    (system, point)
}

/// The score of levels and of everything else that changes the noise is the slope of the likelihood, on data that have
/// another covariance than the model, so that no part of it is zero: also of filters, at zero, where the system has no
/// states for them, and elsewhere. The start is fitted and its squares are left out, 64 samples of 20,000: 0.3 %.
#[test]
fn scores_of_the_noise_are_slopes_of_the_likelihood() {
    let data = noise(20_000, 2);
    for coefficients in [[0.0, 0.0], [0.2, 0.0], [-0.1, 0.3]] {
        let (system, point) = filtered(coefficients);
        let parameters: Vec<Parameter> = (0..9).map(|k| change(&system, &point, k)).collect();
        let sums = pass(&system, &point, parameters, &data, &[], 1);
        let h = 1e-4;
        for k in 0..9 {
            let at = |by: f64| {
                let moved = moved(&system, &point, k, by);
                let (system, _) = filtered([moved.filtered[0], moved.filtered[1]]);
                log_likelihood(&system, &moved, &data)
            };
            let slope = (at(h) - at(-h)) / (2.0 * h);
            assert!(
                (sums.score[k] / slope - 1.0).abs() < 5e-3,
                "{coefficients:?} {k}: {} against {slope}",
                sums.score[k]
            );
        }
    }
}

/// A filter at zero has states of its own beside the system: the sums are those of one that is in the system with a
/// coefficient that is next to nothing.
#[test]
fn a_filter_at_zero_is_the_limit_of_one_in_the_system() {
    let data = noise(3000, 3);
    let sums = |coefficients: [f64; 2]| {
        let (system, point) = filtered(coefficients);
        let parameters: Vec<Parameter> = (0..9).map(|k| change(&system, &point, k)).collect();
        (system.transition.nrows(), pass(&system, &point, parameters, &data, &[], 1))
    };
    // Third order each: the resonance and the mean of two samples.
    let ((states, zero), (more, near)) = (sums([0.0, 0.2]), sums([1e-9, 0.2]));
    assert_eq!((states, more), (4 + 3, 4 + 6));
    for i in 0..9 {
        let size = |j: usize| (zero.information[(i, i)] * zero.information[(j, j)]).sqrt();
        assert!((zero.score[i] / near.score[i] - 1.0).abs() < 1e-7, "{i}: {} {}", zero.score[i], near.score[i]);
        for j in 0..9 {
            let off = zero.information[(i, j)] - near.information[(i, j)];
            assert!(off.abs() < 1e-7 * size(j), "{i} {j}: {off}");
        }
    }
}

/// The information of levels is the variance of their score over draws of the noise (200 draws: 10 % of a variance).
#[test]
fn the_information_is_the_variance_of_the_score() {
    let system = system();
    let point = some_point(&system);
    let predictor = Predictor::new(&system, &system.driving(&point)).expect("a predictor");
    let parameters: Vec<Parameter> = (0..7).map(|k| change(&system, &point, k)).collect();
    let (mut squares, mut information) = ([0.0; 7], [0.0; 7]);
    let draws = 200;
    for seed in 0..draws {
        let data = drawn(&system, &predictor, 1500, 100 + seed);
        let sums = pass(&system, &point, parameters.clone(), &data, &[], 1);
        for k in 0..7 {
            squares[k] += sums.score[k].powi(2) / draws as f64;
            information[k] += sums.information[(k, k)] / draws as f64;
        }
    }
    for k in 0..7 {
        let ratio = squares[k] / information[k];
        // Four standard deviations of a variance from 200 draws.
        assert!((ratio - 1.0).abs() < 0.4, "{k}: {ratio}");
    }
}

/// Channels that a predictor's own innovations make.
fn drawn(system: &NoiseStates, predictor: &Predictor, samples: usize, seed: u64) -> Vec<[f64; 2]> {
    let mut random = StdRng::seed_from_u64(seed);
    let root = Cholesky::new(predictor.innovation.clone()).expect("positive").l();
    let mut state = DVector::zeros(system.transition.nrows());
    let mut out = Vec::with_capacity(samples);
    for _ in 0..samples {
        let e = &root * DVector::from_fn(2, |_, _| normal(&mut random));
        let z = &system.output * &state + &e;
        state = &system.transition * state + &predictor.gain * e;
        out.push([z[0] * system.unit[0], z[1] * system.unit[1]]);
    }
    out
}

/// An effect that filters noise: what the channels see of a component is `1 + c H` times as much, at any frequency.
#[test]
fn a_filtered_component_has_the_spectrum_of_its_filter() {
    let (omega, damping) = (std::f64::consts::TAU * 0.5, 0.1);
    let colour = Colour {
        process: "force:0".to_owned(),
        numerator: vec![0.0, 0.0, 1.0],
        denominator: vec![omega * omega, damping * omega, 1.0],
    };
    let alone = process("force", NoiseResponse::Held, &[(2.0, 1.0, 0)], &[("a", &[1.0])]);
    let readout = process("first", NoiseResponse::Differenced, &[(1e-4, 1.0, 0)], &[("a", &[1.0])]);
    let one = ["a".to_owned()];
    let system = NoiseStates::new(&[alone, readout], &one, DT_S, &[colour], &[0.3]).expect("a system");
    let spectrum = |coefficient: f64, hz: f64| {
        let mut point = system.declared_point();
        point.filtered = vec![coefficient];
        point.levels[1] = 1e-6;
        let driving = system.driving(&point);
        // One-sided density from the transfer function of the driving noise to the channel.
        type C = nalgebra::Complex<f64>;
        let n = system.transition.nrows();
        let z = C::from_polar(1.0, std::f64::consts::TAU * hz * DT_S);
        let resolvent =
            DMatrix::from_fn(n, n, |i, j| C::from(-system.transition[(i, j)]) + if i == j { z } else { C::default() });
        let output = system.output.map(C::from);
        let states = output * resolvent.try_inverse().expect("no pole on the circle");
        let row = DVector::from_fn(n + 1, |i, _| if i == 0 { C::from(1.0) } else { states[(0, i - 1)] });
        let driving = driving.map(C::from);
        (row.transpose() * driving * row.map(|x| x.conj()))[(0, 0)].re * 2.0 * DT_S * system.unit[0].powi(2)
    };
    for hz in [0.05, 0.3, 0.5, 0.7, 2.0] {
        // The bilinear transform bends frequencies.
        let bent = 2.0 / DT_S * (std::f64::consts::PI * hz * DT_S).tan();
        let s = nalgebra::Complex::new(0.0, bent);
        let h = s * s / (s * s + s * damping * omega + omega * omega);
        let expected = (nalgebra::Complex::from(1.0) + h * 0.3).norm_sqr();
        let measured = spectrum(0.3, hz) / spectrum(0.0, hz);
        assert!((measured / expected - 1.0).abs() < 1e-6, "{hz}: {measured} against {expected}");
    }
    // Without the filter it is that of a held force, the mean of two samples.
    let expected = 4.0 * (std::f64::consts::PI * 0.3 * DT_S).cos().powi(2);
    assert!((spectrum(0.0, 0.3) / expected - 1.0).abs() < 1e-6);
}

/// Coloured terms have their spectrum between the least frequency and a tenth of the sampling rate.
#[test]
fn coloured_terms_have_their_spectra() {
    for (response, exponent) in [(NoiseResponse::Held, 2), (NoiseResponse::Held, 4), (NoiseResponse::Differenced, 6)] {
        let terms = [(1e-9, 1.0, 0), (3.0, 0.01, exponent)];
        let noise = process("n", response, &terms, &[("a", &[1.0])]);
        let system = NoiseStates::new(&[noise], &["a".to_owned()], DT_S, &[], &[]).expect("a system");
        let driving = system.driving(&system.declared_point());
        type C = nalgebra::Complex<f64>;
        for hz in [1e-3, 1e-2, 0.1] {
            let n = system.transition.nrows();
            let z = C::from_polar(1.0, std::f64::consts::TAU * hz * DT_S);
            let resolvent = DMatrix::from_fn(n, n, |i, j| {
                C::from(-system.transition[(i, j)]) + if i == j { z } else { C::default() }
            });
            let states = system.output.map(C::from) * resolvent.try_inverse().expect("no pole on the circle");
            let row = DVector::from_fn(n + 1, |i, _| if i == 0 { C::from(1.0) } else { states[(0, i - 1)] });
            let psd = (row.transpose() * driving.map(C::from) * row.map(|x| x.conj()))[(0, 0)].re
                * 2.0
                * DT_S
                * system.unit[0].powi(2);
            let mut expected = 9.0 * (0.01 / hz).powi(exponent.cast_signed());
            if response == NoiseResponse::Differenced {
                expected *= (std::f64::consts::TAU * hz).powi(4);
            }
            assert!((psd / expected - 1.0).abs() < 0.01, "{response:?} {exponent} {hz}: {}", psd / expected);
        }
    }
}

/// A double integrator under feedback by its noisy readout. A gain of the command is regressed on the command, which is
/// made of the same noise: its score has mean zero and the variance of its information, 1 % to fail by chance (χ² of
/// 200 runs). The twin with the command of one sample later has a mean far from zero.
#[test]
fn commands_in_the_loop_do_not_bias_a_gain() {
    let force = process("force", NoiseResponse::Held, &[(1.0, 1.0, 0)], &[("a", &[1.0])]);
    let readout = process("first", NoiseResponse::Differenced, &[(0.5, 1.0, 0)], &[("a", &[1.0])]);
    let system = NoiseStates::new(&[force, readout], &["a".to_owned()], DT_S, &[], &[]).expect("a system");
    let predictor = Predictor::new(&system, &system.driving(&system.declared_point())).expect("a predictor");
    let (force_sigma, readout_sigma) = ((1.0 / (2.0 * DT_S)).sqrt(), 0.5 * (1.0 / (2.0 * DT_S)).sqrt());
    let runs = 200;
    let [mut score, mut squares, mut information, mut wrong, mut wrong_information] = [0.0; 5];
    for seed in 0..runs {
        let mut random = StdRng::seed_from_u64(900 + seed);
        let samples = 2000;
        let (mut x, mut v, mut last) = (0.0, 0.0, 0.0);
        let (mut readouts, mut commands) = (Vec::new(), Vec::new());
        for _ in 0..samples {
            let read = x + readout_sigma * normal(&mut random);
            let command = -read - 1.5 * (read - last) / DT_S * 0.3;
            last = read;
            readouts.push(read);
            commands.push(command);
            let a = command + force_sigma * normal(&mut random);
            x += v * DT_S + 0.5 * a * DT_S * DT_S;
            v += a * DT_S;
        }
        let sums = |later: usize| {
            let setup = Setup {
                system: &system,
                predictor: &predictor,
                known: vec![(0, 0, 1.0)],
                parameters: vec![Parameter { responses: vec![(0, 1, 1.0)], ..Parameter::default() }],
                starts: Vec::new(),
                series: 2,
                averaged: true,
                step_ns: STEP_NS,
                block: None,
                threads: 1,
            };
            let mut innovations = Innovations::new(setup);
            for t in 1..samples - 2 {
                let z = (readouts[t + 1] - 2.0 * readouts[t] + readouts[t - 1]) / (DT_S * DT_S);
                innovations.push(t as i64 * STEP_NS, &[z], &[commands[t], commands[t + later]]);
            }
            innovations.finish().total()
        };
        let (causal, acausal) = (sums(0), sums(1));
        score += causal.score[0];
        squares += causal.score[0].powi(2);
        information += causal.information[(0, 0)];
        wrong += acausal.score[0];
        wrong_information += acausal.information[(0, 0)];
    }
    // 2.58 σ of a sum of 200, and the 99 % interval of χ² with 200 degrees of freedom. Not the mean of score over root
    // information: both are made of the same noise.
    let pull = score / information.sqrt();
    assert!(pull.abs() < 2.58, "{pull}");
    let chi2 = runs as f64 * squares / information;
    assert!((152.2..255.3).contains(&chi2), "{chi2}");
    assert!(wrong.abs() / wrong_information.sqrt() > 20.0, "{wrong}");
}

/// An angle has two readouts: one is a channel, a command on another body follows the other. In the channel `a` the
/// angle shows beside a force; the command may, and does not. Where the innovations of the angle's channel `b` are
/// weighed for it, the command foretells them, and its score has a mean of many σ; where they are not it has none, 1 %
/// to fail by chance.
#[test]
fn a_command_that_follows_another_readout_is_not_weighed_where_it_foretells() {
    let force = process("force", NoiseResponse::Held, &[(FORCE, 1.0, 0)], &[("a", &[1.0])]);
    let torque = process("torque", NoiseResponse::Held, &[(1.0, 1.0, 0)], &[("a", &[1.0]), ("b", &[1.0])]);
    let first = process("first", NoiseResponse::Differenced, &[(0.01, 1.0, 0)], &[("a", &[1.0])]);
    let second = process("second", NoiseResponse::Differenced, &[(0.5, 1.0, 0)], &[("b", &[1.0])]);
    let system = NoiseStates::new(&[force, torque, first, second], &channels(), DT_S, &[], &[]).expect("a system");
    let predictor = Predictor::new(&system, &system.driving(&system.declared_point())).expect("a predictor");
    let white = |asd: f64, random: &mut StdRng| asd * (1.0 / (2.0 * DT_S)).sqrt() * normal(random);
    let mut score = [0.0; 2];
    let mut information = [0.0; 2];
    for seed in 0..100 {
        let mut random = StdRng::seed_from_u64(1900 + seed);
        let samples = 3000;
        let mut states = [(0.0, 0.0); 2];
        let (mut readouts, mut commands) = (Vec::new(), Vec::new());
        let mut command = 0.0;
        for _ in 0..samples {
            let read = [states[0].0 + white(0.01, &mut random), states[1].0 + white(0.5, &mut random)];
            command = 0.9 * command + 0.1 * (states[1].0 + white(0.5, &mut random));
            let angular = white(1.0, &mut random);
            let turned = angular - read[1] - states[1].1;
            for ((x, v), a) in states.iter_mut().zip([turned + white(FORCE, &mut random), turned]) {
                *x += *v * DT_S + 0.5 * a * DT_S * DT_S;
                *v += a * DT_S;
            }
            readouts.push(read);
            commands.push([command, turned - angular]);
        }
        for (k, not_weighed) in [Vec::new(), vec![1]].into_iter().enumerate() {
            let mut innovations = Innovations::new(Setup {
                system: &system,
                predictor: &predictor,
                known: vec![(0, 1, 1.0), (1, 1, 1.0)],
                parameters: vec![Parameter { responses: vec![(0, 0, 1.0)], not_weighed, ..Parameter::default() }],
                starts: Vec::new(),
                series: 2,
                averaged: true,
                step_ns: STEP_NS,
                block: None,
                threads: 1,
            });
            for t in 1..samples - 1 {
                let z =
                    [0, 1].map(|c| (readouts[t + 1][c] - 2.0 * readouts[t][c] + readouts[t - 1][c]) / (DT_S * DT_S));
                innovations.push(t as i64 * STEP_NS, &z, &commands[t]);
            }
            let sums = innovations.finish().total();
            score[k] += sums.score[0];
            information[k] += sums.information[(0, 0)];
        }
    }
    let pulls = [0, 1].map(|k| score[k] / information[k].sqrt());
    assert!(pulls[0].abs() > 5.0 && pulls[1].abs() < 2.58, "{pulls:?}");
}

/// Sum of squares of the innovations of a Kalman filter whose covariance follows the data, a gap included. What moving
/// averages contribute is free at the start and after the gap, as in a pass.
fn kalman_chi2(system: &NoiseStates, point: &NoisePoint, data: &[[f64; 2]]) -> f64 {
    let driving = system.driving(point);
    let predictor = Predictor::new(system, &driving).expect("a predictor");
    let (f, c, n) = (&system.transition, &system.output, 2 * system.channels());
    let (r, q) = (driving.view((0, 0), (2, 2)), driving.view_range(2.., 2..));
    let cross = driving.view_range(2.., ..2);
    let free = |mut p: DMatrix<f64>| {
        let mut own = p.view_mut((0, 0), (n, n));
        own += predictor.known_of_the_start(system) * FREE;
        p
    };
    let mut p = free(predictor.covariance.clone());
    let mut state = DVector::zeros(f.nrows());
    let (mut chi2, mut fresh) = (0.0, true);
    for z in data {
        if !z[0].is_finite() {
            (p, state, fresh) = (f * &p * f.transpose() + q, f * state, false);
            continue;
        }
        if !std::mem::replace(&mut fresh, true) {
            p = free(p);
        }
        let e = DVector::from_fn(2, |i, _| z[i] / system.unit[i]) - c * &state;
        let inverse = (c * &p * c.transpose() + r).try_inverse().expect("positive");
        chi2 += e.dot(&(&inverse * &e));
        let gain = (f * &p * c.transpose() + cross) * &inverse;
        state = f * state + &gain * e;
        p = f * &p * f.transpose() + q - (f * &p * c.transpose() + cross) * gain.transpose();
    }
    chi2
}

/// After a gap the steady predictor, with what it does not know of the slow states fitted out, has the sums of a Kalman
/// filter whose covariance follows the data: of noise, and of a step after the gap, of which a slow force that has
/// moved on takes most. Where it is let go on as if there were no gap, the step has many times the information.
#[test]
fn a_gap_has_the_sums_of_a_filter_whose_covariance_follows_the_data() {
    let walks = [
        process("walk", NoiseResponse::Held, &[(0.5, 0.1, 2)], &[("a", &[1.0])]),
        process("slope", NoiseResponse::Held, &[(0.5, 0.05, 2), (0.5, 0.05, 4)], &[("b", &[1.0])]),
    ];
    let declared: Vec<NoiseProcess> = declared().into_iter().chain(walks).collect();
    let system = NoiseStates::new(&declared, &channels(), DT_S, &[], &[]).expect("a system");
    let mut point = some_point(&system);
    point.levels.resize(system.components.len(), 1.0);
    // What the first gap leaves unknown is not known after the second, which is one sample long.
    let with_gaps = |mut data: Vec<[f64; 2]>| {
        data[400..900].fill([f64::NAN; 2]);
        data[920] = [f64::NAN; 2];
        data
    };
    let step = (0..1300).map(|t| if t < 900 { [0.0; 2] } else { [20.0, 30.0] }).collect();
    for data in [with_gaps(noise(1300, 7)), with_gaps(step)] {
        let want = kalman_chi2(&system, &point, &data);
        for block in [None, Some(300)] {
            let found = blocks(&system, &point, Vec::new(), &data, &[], 1, block).total().chi2;
            assert!((found / want - 1.0).abs() < 1e-4, "{found} against {want}");
        }
    }
}

/// Threads change no digit, and a gap makes two stretches of one pass.
#[test]
fn results_do_not_depend_on_threads_and_a_gap_separates_two_stretches() {
    let system = system();
    let point = some_point(&system);
    let data = noise(3000, 5);
    let series: Vec<Vec<f64>> = noise(3000, 6).into_iter().map(|x| x.to_vec()).collect();
    let own = |k: usize| Parameter {
        responses: vec![(k % 2, (k / 2) % (2 + POWERS), 1.0 + k as f64)],
        change: None,
        ..Parameter::default()
    };
    let parameters: Vec<Parameter> = (0..45).map(own).chain((0..4).map(|k| change(&system, &point, k))).collect();
    let one = pass(&system, &point, parameters.clone(), &data, &series, 1);
    let three = pass(&system, &point, parameters.clone(), &data, &series, 3);
    assert_eq!(one.information, three.information);
    assert_eq!(one.score, three.score);
    let mut gappy = data.clone();
    gappy[1500][1] = f64::NAN;
    let with_gap = pass(&system, &point, parameters.clone(), &gappy, &series, 2);
    assert_eq!((one.samples, with_gap.samples), (3000, 2999));
    // Two stretches are as good as two passes.
    let first = pass(&system, &point, parameters.clone(), &data[..1500], &series, 1);
    let second = pass(&system, &point, parameters, &data[1501..], &series[1501..], 1);
    // Powers of time, responses of parameters 4, 5, 6, 7, …, count from the first row of all.
    for k in [0, 1, 2, 3, 45, 46, 47, 48] {
        let sum = first.score[k] + second.score[k];
        assert!((with_gap.score[k] / sum - 1.0).abs() < 1e-9, "{k}: {} against {sum}", with_gap.score[k]);
    }
}

/// A regressor's score and information are those of the covariance of all samples, the start included.
#[test]
fn scores_equal_those_of_the_covariance_of_all_samples() {
    let system = system();
    let point = some_point(&system);
    let samples = 60;
    let covariance = DMatrix::from_fn(2 * samples, 2 * samples, |i, j| {
        let ((s, a), (t, b)) = ((i / 2, i % 2), (j / 2, j % 2));
        if s >= t { autocovariance(&point, s - t)[(a, b)] } else { autocovariance(&point, t - s)[(b, a)] }
    });
    // The start is free: its states reach the first two samples.
    let predictor = Predictor::new(&system, &system.driving(&point)).expect("a predictor");
    let more = predictor.known_of_the_start(&system) * (FREE - 1.0);
    let first = DMatrix::from_fn(4, 4, |i, j| more[(i, j)] * system.unit[i % 2] * system.unit[j % 2]);
    let mut covariance = covariance;
    let mut free = covariance.view_mut((0, 0), (4, 4));
    free += first;
    let inverse = Cholesky::new(covariance).expect("positive").inverse();
    let data = noise(samples, 8);
    let series: Vec<Vec<f64>> = noise(samples, 9).into_iter().map(|x| x.to_vec()).collect();
    let parameters = vec![
        Parameter { responses: vec![(0, 0, 2.0), (1, 1, -1.0)], ..Parameter::default() },
        Parameter { responses: vec![(1, 0, 0.5)], ..Parameter::default() },
    ];
    let sums = pass(&system, &point, parameters, &data, &series, 1);
    let z = DVector::from_iterator(2 * samples, data.iter().flatten().copied());
    let column =
        |of: &dyn Fn(&[f64]) -> [f64; 2]| DVector::from_iterator(2 * samples, series.iter().flat_map(|s| of(s)));
    let columns = [column(&|s| [2.0 * s[0], -s[1]]), column(&|s| [0.0, 0.5 * s[0]])];
    for (k, own) in columns.iter().enumerate() {
        let score = own.dot(&(&inverse * &z));
        assert!((sums.score[k] / score - 1.0).abs() < 1e-6, "{k}: {} against {score}", sums.score[k]);
        for (l, other) in columns.iter().enumerate() {
            let information = own.dot(&(&inverse * other));
            assert!((sums.information[(k, l)] / information - 1.0).abs() < 1e-6, "{k} {l}");
        }
    }
    let chi2 = z.dot(&(&inverse * &z));
    assert!((sums.chi2 / chi2 - 1.0).abs() < 1e-6, "{} against {chi2}", sums.chi2);
}

/// What two sums of the same numbers in another order may differ by, in units of their size.
fn equal(a: &Sums, b: &Sums) {
    assert_eq!((a.samples, a.numbers), (b.samples, b.numbers));
    assert!((a.chi2 / b.chi2 - 1.0).abs() < 1e-12, "{} against {}", a.chi2, b.chi2);
    assert!((&a.squares - &b.squares).amax() < 1e-12 * a.squares.amax());
    for i in 0..a.score.len() {
        let size = |j: usize| (a.information[(i, i)] * a.information[(j, j)]).sqrt();
        let most = 1e-12 * (a.information[(i, i)] * a.chi2).sqrt();
        assert!((a.score[i] - b.score[i]).abs() < most, "{i}: {} against {}", a.score[i], b.score[i]);
        for j in 0..a.score.len() {
            let (own, other) = (a.information[(i, j)], b.information[(i, j)]);
            assert!((own - other).abs() < 1e-12 * size(j), "{i} {j}: {own} against {other}");
        }
    }
}

/// Blocks are cut by time, a gap does not move them, and each has what its rows add given all before: the blocks up to
/// any one are a pass that ends with it, also where a block ends in the middle of a start.
#[test]
fn blocks_are_what_their_rows_add() {
    let slow = process("slow", NoiseResponse::Held, &[(2.0, 0.05, 2)], &[("a", &[1.0]), ("b", &[-0.5])]);
    let declared: Vec<NoiseProcess> = declared().into_iter().chain([slow]).collect();
    let system = NoiseStates::new(&declared, &channels(), DT_S, &[], &[]).expect("a system");
    let point = system.declared_point();
    let predictor = Predictor::new(&system, &system.driving(&point)).expect("a predictor");
    let mut data = drawn(&system, &predictor, 3000, 21);
    // A stretch begins 8 samples before a block ends, and a gap goes over the whole fourth block.
    data[990][0] = f64::NAN;
    data[1400..2100].fill([f64::NAN; 2]);
    let series: Vec<Vec<f64>> = noise(3000, 22).into_iter().map(|x| x.to_vec()).collect();
    let own = |k: usize| Parameter {
        responses: vec![(k % 2, (k / 2) % (2 + POWERS), 1.0 + k as f64)],
        change: None,
        ..Parameter::default()
    };
    let levels = |k: usize| {
        let at = |by: f64| {
            let mut point = point.clone();
            point.levels[k] *= 1.0 + by;
            system.driving(&point)
        };
        let change = predictor.change(&system, &((at(0.1) - at(-0.1)) / 0.2));
        Parameter { responses: Vec::new(), change: Some(change), ..Parameter::default() }
    };
    let parameters: Vec<Parameter> = (0..20).map(own).chain((0..4).map(levels)).chain((20..45).map(own)).collect();
    let cut = |samples: usize, block: Option<u64>, threads: usize| {
        blocks(&system, &point, parameters.clone(), &data[..samples], &series, threads, block)
    };
    let all = cut(3000, Some(499), 1);
    let first = |number: i64| number * 499 * STEP_NS;
    assert_eq!(all.blocks.iter().map(|b| b.first_ns).collect::<Vec<_>>(), [0, 1, 2, 4, 5, 6].map(first));
    assert_eq!(all.blocks.iter().map(|b| b.samples).collect::<Vec<_>>(), [499, 498, 402, 395, 499, 6]);
    equal(&cut(3000, None, 1).total(), &all.total());
    let mut sums = Sums::zeros(parameters.len(), 2);
    for (block, end) in all.blocks.iter().zip([499, 998, 1497, 2495, 2994]) {
        sums.add(block);
        equal(&cut(end, None, 1).total(), &sums);
    }
    let threads = cut(3000, Some(499), 3);
    for (one, three) in all.blocks.iter().zip(&threads.blocks) {
        assert_eq!((&one.information, &one.score), (&three.information, &three.score));
        assert_eq!((one.chi2, &one.squares), (three.chi2, &three.squares));
    }
    assert_eq!(all.starts.len(), 3);
    for (one, whole) in all.starts.iter().zip(&cut(3000, None, 1).starts) {
        assert!((&one.state - &whole.state).amax() < 1e-9 * whole.state.amax(), "{} {}", one.state, whole.state);
        assert!((&one.slope - &whole.slope).amax() < 1e-9 * whole.slope.amax());
    }
}

fn quadratic(information: DMatrix<f64>, truth: &[f64], candidates: Vec<Candidate>) -> Quadratic {
    let score: Vec<f64> = (&information * DVector::from_column_slice(truth)).iter().copied().collect();
    let sums = Sums { information, score, ..Sums::zeros(truth.len(), 1) };
    Quadratic::new(&sums, &vec![0.0; truth.len()], &[(vec![(0, 1.0)], Prior { mean: 0.0, sigma: 1e6 })], candidates)
}

fn candidate(parameter: usize) -> Candidate {
    Candidate {
        parameters: vec![parameter],
        lower: vec![-0.3],
        upper: vec![0.3],
        prior_sigma: vec![0.1],
        ln_prior: 0.0,
        shaped: false,
    }
}

/// A gain of 13.8 is at the bound.
fn evidence(most: usize) -> Evidence<'static> {
    Evidence { log10_p: &|_, gain| 1.0 - gain / 4.6, bound: -2.0, most, remainder: 1e-3, range: 13.8 }
}

/// What a grid of forms leaves of a strong effect names no other; beside one without a form the same counts.
#[test]
fn a_small_remainder_of_a_formed_effect_is_no_evidence() {
    let information = DMatrix::from_diagonal(&DVector::from_vec(vec![1.0, 1e8, 1e4]));
    for (shaped, named) in [(true, vec![0]), (false, vec![0, 1])] {
        let own = vec![Candidate { shaped, ..candidate(1) }, candidate(2)];
        // Gains of 4e6 and of 400.
        let selection = quadratic(information.clone(), &[0.0, 0.2, 0.2], own).select(&evidence(3));
        assert_eq!(selection.chosen.iter().map(|c| c.candidate).collect::<Vec<_>>(), named);
    }
}

/// Two causes are found beside a nuisance with which both correlate, and a third that looks like their sum is not.
#[test]
fn a_stand_in_is_exchanged_for_the_causes() {
    let base = DMatrix::from_row_slice(
        6,
        4,
        &[
            1.0, 0.5, 0.4, 0.0, 1.0, -0.2, 0.9, 0.0, 1.0, 0.8, -0.7, 0.0, 1.0, -0.9, 0.1, 0.0, 1.0, 0.3, 0.3, 0.0, 1.0,
            0.1, -0.8, 0.0,
        ],
    );
    let mut rows = base.clone() * 200.0;
    for i in 0..6 {
        rows[(i, 3)] = 0.7 * (rows[(i, 1)] + rows[(i, 2)]) + if i % 2 == 0 { 30.0 } else { -30.0 };
    }
    let information = rows.transpose() * rows;
    let quadratic = quadratic(information, &[5.0, 0.1, 0.12, 0.0], vec![candidate(1), candidate(2), candidate(3)]);
    let selection = quadratic.select(&evidence(3));
    let chosen: Vec<usize> = selection.chosen.iter().map(|c| c.candidate).collect();
    assert_eq!(chosen, [0, 1]);
    assert!((selection.chosen[0].values[0] - 0.1).abs() < 1e-9 && (selection.values[0] - 5.0).abs() < 1e-6);
    assert!(selection.rest.iter().all(|c| c.gain < 1e-6));
}

/// One of two candidates with a correlation of ρ acts: the other explains ρ² of it, and four times the data tell
/// four times as much.
#[test]
fn the_separation_of_two_is_what_one_leaves_of_the_other() {
    for (length, rho) in [(1.0, 0.0), (1.0, 0.8), (4.0, 0.8)] {
        let n = 1e4 * length;
        let information = DMatrix::from_row_slice(3, 3, &[1.0, 0.0, 0.0, 0.0, n, rho * n, 0.0, rho * n, n]);
        let own = quadratic(information, &[0.0, 0.2, 0.0], vec![candidate(1), candidate(2)]);
        let expected = 0.04 * n * (1.0 - rho * rho);
        assert!((own.separation(0, 1, &[0]) / expected - 1.0).abs() < 1e-9);
    }
}

/// Data in two stretches with a constant, a cause and another that looks a little like it: what the other leaves of
/// the cause by least squares over both, as a sum of squares in each stretch.
#[test]
fn a_contrast_is_the_part_of_a_stretch_in_the_separation() {
    let rows = 40;
    let cause = |t: usize| (0.7 * t as f64).sin();
    let other = |t: usize| 0.5 * cause(t) + (0.3 * t as f64).cos() * if t < rows / 2 { 1.0 } else { 3.0 };
    let design = DMatrix::from_fn(rows, 3, |t, k| 100.0 * [1.0, cause(t), other(t)][k]);
    let stretch = |from: usize| design.rows(from, rows / 2).into_owned();
    let stretches = [stretch(0), stretch(rows / 2)];
    let informations = stretches.each_ref().map(|rows| rows.tr_mul(rows));
    let truth = [3.0, 0.2, 0.0];
    let own = quadratic(&informations[0] + &informations[1], &truth, vec![candidate(1), candidate(2)]);

    let acts = design.column(1) * truth[1];
    let rivals = design.select_columns(&[0, 2]);
    let fitted = rivals.clone().svd(true, true).solve(&acts, 1e-12).expect("two columns");
    let left = acts - rivals * fitted;
    let weights = own.contrast(0, 1, &[0]);
    let mut sum = 0.0;
    for (k, information) in informations.iter().enumerate() {
        let expected = left.rows(k * rows / 2, rows / 2).norm_squared();
        let part = weights.dot(&(information * &weights));
        assert!((part / expected - 1.0).abs() < 1e-6, "stretch {k}: {part} for {expected}");
        sum += part;
    }
    assert!((sum / own.separation(0, 1, &[0]) - 1.0).abs() < 1e-6);
}

/// Outside of its range a value explains only what its best value inside explains, and data that want a value far
/// outside name nothing; equals share the probability.
#[test]
fn ranges_bound_the_gain_and_equals_are_alternatives() {
    let information = DMatrix::from_row_slice(3, 3, &[1.0, 0.0, 0.0, 0.0, 1e4, 0.999 * 1e4, 0.0, 0.999 * 1e4, 1e4]);
    let both = || vec![candidate(1), candidate(2)];
    let alike = quadratic(information.clone(), &[0.0, 0.2, 0.0], both());
    let selection = alike.select(&evidence(2));
    assert_eq!((selection.chosen.len(), selection.chosen[0].candidate), (1, 0));
    // Scores of 2000 and 1998 under a prior of σ = 0.1: ½ (0.1 · 2000)²/(1 + 0.1² · 1e4), and the same of 1998.
    let other = (0.5 * (199.8_f64.powi(2) - 200.0_f64.powi(2)) / 101.0).exp();
    assert!((selection.chosen[0].alternatives[0].1 - other / (1.0 + other)).abs() < 1e-9);
    let far = quadratic(information, &[0.0, 2.0, 0.0], both());
    let selection = far.select(&evidence(1));
    assert!(selection.chosen.is_empty());
    let own = &selection.rest[0];
    assert_eq!((own.candidate, own.values[0]), (0, 0.3));
    assert!((own.beyond - (1e4 * 4.0 - own.gain)).abs() < 1e-6 && (own.free[0] - 2.0).abs() < 1e-9);
    assert!((own.gain - (2.0 * 1e4 * 2.0 * 0.3 - 1e4 * 0.09)).abs() < 1e-6, "{}", own.gain);
}

/// One of two wants a value outside of its range, by much: it alone is said to, not what acts inside of its own beside
/// it, nor what is held by the first.
#[test]
fn a_value_outside_its_range_refuses_no_other() {
    let mut information = DMatrix::from_diagonal(&DVector::from_vec(vec![1.0, 1e4, 1e4]));
    (information[(1, 2)], information[(2, 1)]) = (3e3, 3e3);
    let q = quadratic(information, &[0.0, 0.5, 0.1], vec![candidate(1), candidate(2)]);
    let [outside, inside] = [0, 1].map(|c| q.beside(c, &[0, 1]));
    assert_eq!(inside.beyond, 0.0);
    // By 0.2 beyond the end, with what the other leaves of the information.
    assert!((outside.beyond - 0.04 * (1e4 - 9e6 / 1e4)).abs() < 1e-6, "{}", outside.beyond);
    assert_eq!(q.select(&evidence(2)).chosen.iter().map(|c| c.candidate).collect::<Vec<_>>(), [1]);
}

/// Of two that are much alike the data want the first outside of its range: the second explains less in its place, and
/// stands in for it. Inside its range the first is what is chosen, and a third that is like neither stands for itself.
#[test]
fn what_is_like_a_value_outside_its_range_stands_in_for_it() {
    let (n, rho) = (1e4, 0.7);
    let mut information = DMatrix::identity(4, 4);
    let rows = [n, rho * n, 0.0, rho * n, n, 0.0, 0.0, 0.0, n];
    information.view_mut((1, 1), (3, 3)).copy_from(&DMatrix::from_row_slice(3, 3, &rows));
    let all = || (1..4).map(candidate).collect();
    let (range, more) = (14.0, 1e3_f64.ln());
    let far = quadratic(information.clone(), &[0.0, 0.4, 0.0, 0.2], all());
    let set: Vec<usize> = far.select(&evidence(2)).chosen.iter().map(|f| f.candidate).collect();
    assert_eq!(set, [1, 2]);
    let outside = far.stands_in_for(1, &set, range, more).expect("the first explains more");
    assert!(outside.candidate == 0 && (outside.free[0] - 0.4).abs() < 1e-9);
    assert!(far.stands_in_for(2, &set, range, more).is_none());
    let near = quadratic(information, &[0.0, 0.2, 0.0, 0.2], all());
    let set: Vec<usize> = near.select(&evidence(2)).chosen.iter().map(|f| f.candidate).collect();
    assert_eq!(set, [0, 2]);
    assert!(set.iter().all(|c| near.stands_in_for(*c, &set, range, more).is_none()));
    // Where a range has no end, nothing is outside of it.
    assert!(far.stands_in_for(1, &[1, 2], f64::INFINITY, more).is_none());
}

/// What acts has a correlation of ρ with a level of the noise, which is fitted beside everything: of its χ² 1 − ρ² is
/// left. Compared with the level in its place it explains all of it, as if the level had been a candidate from the
/// start, and the level ρ². A third candidate that explains nothing is no alternative.
#[test]
fn a_level_of_the_base_is_compared_with_what_acts_in_its_place() {
    let (n, rho) = (1e4, 0.99);
    let rows = [n, rho * n, 0.0, rho * n, n, 0.0, 0.0, 0.0, n];
    let mut information = DMatrix::identity(4, 4);
    information.view_mut((1, 1), (3, 3)).copy_from(&DMatrix::from_row_slice(3, 3, &rows));
    let truth = [0.0, 0.0, 0.1, 0.0];
    let own = quadratic(information.clone(), &truth, vec![candidate(2), candidate(3)]);
    let all = 0.01 * n;
    let is = |x: f64, expected: f64| (x - expected).abs() < 1e-6 * all;
    assert!(is(own.beside(0, &[]).gain, all * (1.0 - rho * rho)));
    let compared = own.with_candidate(candidate(1));
    let from_the_start = quadratic(information, &truth, vec![candidate(2), candidate(3), candidate(1)]);
    for quadratic in [&compared, &from_the_start] {
        assert!(is(quadratic.beside(0, &[]).gain, all) && is(quadratic.beside(2, &[]).gain, all * rho * rho));
        let level = quadratic.with_alternatives(2, &[2], &[0, 1]);
        let names: Vec<usize> = level.alternatives.iter().map(|(c, _)| *c).collect();
        assert_eq!(names, [0]);
        assert!(is(quadratic.separation(2, 0, &[2]), all * rho * rho * (1.0 - rho * rho)));
    }
}

#[test]
fn noise_that_cannot_be_filtered_is_refused_with_its_name() {
    let unknown = NoiseProcess { spectrum: None, ..declared().remove(1) };
    let refused = |declared: &[NoiseProcess]| {
        NoiseStates::new(declared, &channels(), DT_S, &[], &[]).map(|_| ()).expect_err("refused").0
    };
    assert!(refused(&[unknown]).contains("`first`"));
    assert!(refused(&declared()[1..2]).contains("b is declared"));
    let mut estimated = declared();
    estimated[0].estimate = Some(dragfree_schema::NoiseEstimate {
        matrix: vec![vec![1.0, 0.0]],
        enters: BTreeMap::from([("a".to_owned(), vec![1.0])]),
        ..dragfree_schema::NoiseEstimate::default()
    });
    assert!(refused(&estimated).contains("estimate"));
}

/// Three data with three coefficients, of which each lacks one. Where all have the same values the disagreement is χ²
/// of 2 + 2 + 2 − 3 = 3: its mean over 1000 draws is 3 ± 0.08, four of which either way are false once in 16000. Where
/// one has another value, by d with information n against N of the others, it is higher by `d² n N/(n + N)`.
#[test]
fn data_disagree_by_chi_squared() {
    let mut random = StdRng::seed_from_u64(5);
    let mut mean = |other: f64| {
        let mut sum = 0.0;
        for _ in 0..1000 {
            let data: Vec<_> = (0..3)
                .map(|lacks| {
                    // 40 numbers of variance one, without any response to one of the coefficients.
                    let design = DMatrix::from_fn(40, 3, |i, j| {
                        let known = if j == lacks { 0.0 } else { 1.0 };
                        known * f64::from(u8::from(i % 3 == j || (i / 4) % 2 == j))
                    });
                    let truth = DVector::from_column_slice(&[1.0, -2.0, if lacks == 0 { 0.5 + other } else { 0.5 }]);
                    let noise = DVector::from_fn(40, |_, _| normal(&mut random));
                    let numbers: DVector<f64> = &design * truth + noise;
                    (design.transpose() * &design, design.transpose() * numbers)
                })
                .collect();
            let (chi2, dof) = disagreement(&data, 120.0);
            assert_eq!(dof, 3);
            sum += chi2 / 1000.0;
        }
        sum
    };
    let agreeing = mean(0.0);
    assert!((agreeing - 3.0).abs() < 0.32, "{agreeing}");
    assert!(mean(2.0) > 10.0);
}

/// The rate of a gain has the information and the score of a series of its own, the gain's times the time, as finely as
/// blocks resolve time: here 40 of them. About another instant too. What a rate of another series has differs.
#[test]
fn a_rate_has_the_sums_of_a_series_that_grows_with_time() {
    let system = system();
    let predictor = Predictor::new(&system, &system.driving(&system.declared_point())).expect("a predictor");
    let mut random = StdRng::seed_from_u64(77);
    let own = |series: usize| Parameter { responses: vec![(0, series, 1.0)], ..Parameter::default() };
    let mut innovations = Innovations::new(Setup {
        system: &system,
        predictor: &predictor,
        known: Vec::new(),
        parameters: vec![own(0), own(1)],
        starts: Vec::new(),
        series: 2,
        averaged: true,
        step_ns: STEP_NS,
        block: Some(100),
        threads: 1,
    });
    let days = |samples: f64| samples * DT_S / 86_400.0;
    for (k, z) in noise(4000, 5).iter().enumerate() {
        let x = normal(&mut random);
        innovations.push(k as i64 * STEP_NS, z, &[x, x * days(k as f64)]);
    }
    let passed = innovations.finish();
    let (sums, moments) = (passed.total(), passed.moments());
    for about in [0, 2000] {
        let moments = moments.about(&sums, about * STEP_NS);
        let shift = days(about as f64);
        let [one, both, rate] = [(0, 0), (0, 1), (1, 1)].map(|at| sums.information[at]);
        let (once, twice) = (both - shift * one, rate - 2.0 * shift * both + shift * shift * one);
        let score = sums.score[1] - shift * sums.score[0];
        let size = (one * rate).sqrt();
        assert!((moments.once[(0, 0)] - once).abs() < 0.01 * size, "{} {once}", moments.once[(0, 0)]);
        assert!((moments.twice[(0, 0)] / twice - 1.0).abs() < 0.01, "{} {twice}", moments.twice[(0, 0)]);
        assert!((moments.score[0] - score).abs() < 0.1 * rate.sqrt(), "{} {score}", moments.score[0]);
        assert!((moments.twice[(1, 1)] / twice - 1.0).abs() > 0.5);
    }
}

/// A template of one unit in the first channel for some samples.
fn template(samples: usize) -> Template {
    Template {
        effect: "event".to_owned(),
        instance: format!("of{samples}"),
        coefficient: "event.here".to_owned(),
        unit: "1".to_owned(),
        shape: serde_json::Map::new(),
        kernel: vec![1.0; samples],
        channels: vec![(0, 1.0, false)],
    }
}

/// What a search near the ends of stretches of data finds, and where it has looked, with events of so many samples: at,
/// size. A stretch is so many samples, and ten are missing behind it.
fn searched(
    stretches: &[usize],
    (events, length): (&[(usize, f64)], usize),
    templates: Vec<Template>,
    threads: usize,
) -> (Transients, Vec<std::ops::Range<i64>>) {
    let system = system();
    let predictor = Predictor::new(&system, &system.driving(&system.declared_point())).expect("a predictor");
    let mut data = drawn(&system, &predictor, stretches.iter().sum(), 3);
    for (at, size) in events {
        data.iter_mut().skip(*at).take(length).for_each(|z| z[0] += size);
    }
    let mut pass = Innovations::new(Setup {
        system: &system,
        predictor: &predictor,
        known: Vec::new(),
        parameters: Vec::new(),
        starts: Vec::new(),
        series: 0,
        averaged: false,
        step_ns: STEP_NS,
        block: None,
        threads,
    })
    .with_search(templates);
    let (mut ends, mut gap) = (stretches.iter().scan(0, |sum, n| Some(std::mem::replace(sum, *sum + n) + n)), 0);
    let mut end = ends.next();
    for (k, z) in data.iter().enumerate() {
        if Some(k) == end {
            (gap, end) = (gap + 10, ends.next());
        }
        pass.push((k as i64 + gap) * STEP_NS, z, &[]);
    }
    pass.transients()
}

/// A transient near either end of the data is found at its sample with the significance of least squares (within 4σ,
/// false alarm 1e-4); without one there is none, and one in the middle is left to the search by spectra.
#[test]
fn transients_near_both_ends_are_found_at_their_times() {
    let samples = 80_000;
    let found = |events: &[(usize, f64)]| searched(&[samples], (events, 5), vec![template(5)], 1).0.detections;
    assert!(found(&[]).is_empty());
    let size = 400.0;
    let significance = |at: usize| {
        let [found] = &found(&[(at, size)])[..] else { panic!("at {at}") };
        assert_eq!(found.at_ns, at as i64 * STEP_NS);
        found.significance
    };
    let all: Vec<f64> = [20, 3000, samples - 3000, samples - 20].map(significance).to_vec();
    assert!(all.iter().all(|x| *x > 8.0 && (x - all[1]).abs() < 4.0), "{all:?}");
    assert!(found(&[(samples / 2, size)]).is_empty());
    // Two in one window are found at their times, with the significance of each alone (within 4σ of their difference).
    let two = found(&[(3000, size), (12_000, 2.0 * size)]);
    let times: Vec<i64> = two.iter().map(|d| d.at_ns / STEP_NS).collect();
    assert_eq!(times, [12_000, 3000]);
    assert!((two[1].significance - all[1]).abs() < 4.0, "{}", two[1].significance);
    // So is one beside a ten times larger one that begins inside of the data, which the spectra find.
    let beside = found(&[(3000, size), (28_000, 10.0 * size)]);
    let [one] = &beside[..] else { panic!("{beside:?}") };
    assert!(one.at_ns == 3000 * STEP_NS && (one.significance - all[1]).abs() < 4.0, "{}", one.significance);
}

/// What lasts for 20 minutes fits its own template at later times too, by the part of it that is common. Taken off with
/// its size it is found once.
#[test]
fn a_long_transient_near_an_end_is_found_once() {
    let length = 12_000;
    let found = searched(&[80_000], (&[(2000, 20.0)], length), vec![template(length)], 1).0.detections;
    let [one] = &found[..] else { panic!("{found:?}") };
    assert!(one.at_ns.abs_diff(2000 * STEP_NS) < 100 * STEP_NS as u64 && one.significance > 20.0, "{one:?}");
}

/// Beside many gaps no more windows are kept than the first and the last ones, and what is found in them is the same to
/// the last bit with any number of threads.
#[test]
fn the_search_beside_many_gaps_has_a_limit_and_one_result() {
    let (stretches, events) = ([34_000; 12], [(1000, 400.0), (34_000 * 12 - 1000, 400.0)]);
    let templates: Vec<Template> = [1, 2, 3, 5, 8, 13, 21].map(template).to_vec();
    let (found, windows) = searched(&stretches, (&events, 5), templates.clone(), 1);
    assert!(windows.len() <= 16 && windows.len() > 8, "{}", windows.len());
    assert_eq!(found.detections.iter().filter(|d| d.instance == "of5").count(), 2, "{:?}", found.detections);
    assert_eq!((found, windows), searched(&stretches, (&events, 5), templates, 3));
}

/// Errors of an offset, where another effect acts beside it with a size from what is known of it. Of 4000 draws the
/// mean square over what is expected, of the value where the effect may act and of the value where it is taken to be
/// absent, is one within 4σ (6e-5); over the variance where it is taken to be absent it is far above one.
#[test]
fn an_offset_has_the_errors_that_an_undetected_effect_makes() {
    let information = DMatrix::from_row_slice(2, 2, &[4.0, 5.0, 5.0, 9.0]);
    let prior_sigma = 0.5;
    let root = Cholesky::new(information.clone()).expect("positive").l();
    let mut random = StdRng::seed_from_u64(8);
    let other = Candidate { prior_sigma: vec![prior_sigma], ..candidate(1) };
    let draws = 4000;
    let [mut errors, mut expected, mut absent, mut joint, mut joint_expected] = [0.0; 5];
    for _ in 0..draws {
        let truth = DVector::from_vec(vec![3.0, prior_sigma * normal(&mut random)]);
        let score = &information * truth + &root * DVector::from_fn(2, |_, _| normal(&mut random));
        let mut sums = Sums::zeros(2, 1);
        (sums.information, sums.score) = (information.clone(), score.as_slice().to_vec());
        let quadratic = Quadratic::new(&sums, &[0.0; 2], &[], vec![other.clone()]);
        let (values, sigma) = quadratic.solution(&[]);
        let (with, with_sigma) = quadratic.solution_with(&[], &[0]);
        errors += (values[0] - 3.0).powi(2);
        expected += with_sigma[0].powi(2) + (with[0] - values[0]).powi(2);
        absent += sigma[0].powi(2);
        joint += (with[0] - 3.0).powi(2);
        joint_expected += with_sigma[0].powi(2);
        let (same, same_sigma) = quadratic.solution_with(&[], &[]);
        assert!((same_sigma[0] - sigma[0]).abs() < 1e-12 && (same[0] - values[0]).abs() < 1e-12);
    }
    let four_sigma = 4.0 * (2.0 / f64::from(draws)).sqrt();
    for ratio in [errors / expected, joint / joint_expected] {
        assert!((ratio - 1.0).abs() < four_sigma, "{ratio}");
    }
    assert!(errors / absent > 2.0, "{errors} {absent}");
}
