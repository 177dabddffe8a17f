//! The crux of the calibration: the truth regressed on `α̂` has slope one.
//!
//! First without chance: the loop and the stage are linear, so impulses through both give every transfer function and
//! with them the slope itself, `Re ∫S_αα̂ / ∫S_α̂α̂`. By chance alone a slope has the variance `∫S_e S_α̂ / (2T (∫S_α̂)²)`,
//! `S_e` being the error's spectrum: to show 0.2 % at four standard deviations a Hann-weighted record would have to be
//! six days long for 0.1 to 1 Hz, seven months for 10 to 100 mHz and fourteen for 1 to 10 mHz.
//! Then with chance, on a record of 29 hours, at five standard deviations.

use crate::common::{AttitudeLoop, DT_S, RATE_HZ, levels, mission, run, settings, stage};
use dragfree_hinf_dfacs::reconstruction::AngularAcceleration::{self, Commanded, SecondDifference, Smoother};
use dragfree_hinf_dfacs::smoother::residual_psd;
use dragfree_physics::mission::Mission;
use nalgebra::Vector3;
use rand::SeedableRng;
use rand_distr::{Distribution, StandardNormal};
use rand_xoshiro::Xoshiro256PlusPlus;
use realfft::num_complex::Complex64;
use std::f64::consts::TAU;

const DECADES: [[f64; 2]; 4] = [[1e-3, 1e-2], [1e-2, 1e-1], [1e-1, 1.0], [1.0, 4.9]];

/// Truth and `α̂`, axis by axis, from an impulse of torque (inputs 0 to 2) or of readout error (3 to 5).
struct Response {
    truth: [Vec<f64>; 3],
    estimate: [Vec<f64>; 3],
}

/// The covariances settle for over an hour on zeros; then the impulse, in the middle of nowhere of a block.
fn response(mission: &Mission, method: AngularAcceleration, input: usize) -> Response {
    const QUIET: usize = 40_321;
    const AFTER: usize = 1 << 16;
    let mut body = AttitudeLoop::new(mission);
    let mut epochs = Vec::with_capacity(QUIET + AFTER);
    let mut truth = [Vec::new(), Vec::new(), Vec::new()];
    for k in 0..QUIET + AFTER {
        let mut inputs = [Vector3::zeros(), Vector3::zeros()];
        if k == QUIET {
            inputs[input / 3][input % 3] = [1e-7, 1e-9][input / 3];
        }
        let (epoch, alpha) = body.step(&inputs[0], &inputs[1]);
        epochs.push(epoch);
        for i in 0..3 {
            truth[i].push(alpha[i]);
        }
    }
    let rows = run(&mut stage(mission, &settings(method)), &epochs);
    let estimate = std::array::from_fn(|i| {
        // The second difference lacks two epochs at the ends.
        rows.iter().map(|row| if row.values[i].is_finite() { row.values[i] } else { 0.0 }).collect()
    });
    Response { truth, estimate }
}

/// Slope of the truth on `α̂` per decade and axis, exactly.
fn slopes(mission: &Mission, method: AngularAcceleration) -> [[f64; 3]; 4] {
    let [torque, sensing] = levels(mission);
    let responses: Vec<_> = (0..6).map(|input| response(mission, method, input)).collect();
    DECADES.map(|[low, high]| {
        const POINTS: usize = 24;
        let mut cross = [0.0; 3];
        let mut auto = [0.0; 3];
        for point in 0..POINTS {
            let f = low * (high / low).powf((point as f64 + 0.5) / POINTS as f64);
            let phase: Vec<_> = (0..responses[0].truth[0].len())
                .map(|k| Complex64::cis(-TAU * (f * DT_S * k as f64).fract()))
                .collect();
            let spectrum = |x: &[f64]| x.iter().zip(&phase).map(|(x, p)| p * x).sum::<Complex64>();
            for (input, response) in responses.iter().enumerate() {
                let level = if input < 3 { torque / 1e-14 } else { sensing / 1e-18 };
                for i in 0..3 {
                    let [a, e] = [spectrum(&response.truth[i]), spectrum(&response.estimate[i])];
                    // Points are even in ln f.
                    cross[i] += level * f * (a * e.conj()).re;
                    auto[i] += level * f * e.norm_sqr();
                }
            }
        }
        std::array::from_fn(|i| cross[i] / auto[i])
    })
}

#[test]
fn truth_on_smoothed_acceleration_has_slope_one_in_every_decade() {
    let slopes = slopes(&mission(), Smoother);
    for (decade, slopes) in DECADES.iter().zip(slopes) {
        for slope in slopes {
            assert!((slope - 1.0).abs() < 2e-3, "slope {slope} in {decade:?} Hz");
        }
    }
}

/// The trap of physics.md §4, first way: the second difference is mostly noise of the sensing.
#[test]
fn second_difference_attenuates() {
    let slopes = slopes(&mission(), SecondDifference);
    assert!(slopes[2].iter().all(|s| *s < 0.1), "0.1 to 1 Hz: {:?}", slopes[2]);
    assert!(slopes[3].iter().all(|s| *s < 0.01), "above 1 Hz: {:?}", slopes[3]);
}

/// The trap, second way: the command answers the very disturbance that it leaves out.
#[test]
fn commanded_torque_alone_is_biased() {
    let slopes = slopes(&mission(), Commanded);
    assert!(slopes[1].iter().all(|s| (s - 1.0).abs() > 0.1), "10 to 100 mHz: {:?}", slopes[1]);
}

/// The rise of the sensing's noise below 2 mHz is not in the smoother's model. Where it doubles the noise and beyond,
/// the smoother's weight of the sensing differs from the optimum by less than a millionth.
#[test]
fn coloured_sensing_noise_needs_no_model() {
    let mission = mission();
    let [torque, sensing] = levels(&mission);
    let shape = mission.noise.dws_long_arm.as_ref().expect("the fixture has it").shape();
    let disturbance = torque / 800.0_f64.powi(2);
    for k in 0..400 {
        let f = 1e-5 * 10_f64.powf(f64::from(k) / 100.0);
        let shortfall = |readout| residual_psd(f, disturbance, readout, DT_S) / disturbance;
        let difference = shortfall(shape.psd(f)) - shortfall(sensing);
        assert!((0.0..1e-6).contains(&difference), "{difference} at {f} Hz");
    }
}

/// Hann-weighted spectra of a record, one-sided PSD of each bin.
fn spectrum(x: &[f64]) -> Vec<Complex64> {
    let n = x.len();
    let window: Vec<f64> = (0..n).map(|k| 0.5 - 0.5 * (TAU * k as f64 / n as f64).cos()).collect();
    let scale = (2.0 * DT_S / window.iter().map(|w| w * w).sum::<f64>()).sqrt();
    let mut weighted: Vec<f64> = x.iter().zip(&window).map(|(x, w)| x * w * scale).collect();
    let fft = realfft::RealFftPlanner::new().plan_fft_forward(n);
    let mut out = fft.make_output_vec();
    fft.process(&mut weighted, &mut out).expect("the lengths fit");
    out
}

/// Neighbouring bins of a Hann window belong together: a sum over many varies by this much more than independent ones.
const HANN: f64 = 35.0 / 18.0;

struct Record {
    truth: Vec<Vec<Complex64>>,
    estimate: Vec<Vec<Complex64>>,
    hz_per_bin: f64,
}

fn record(method: AngularAcceleration, seed: u64) -> Record {
    const SAMPLES: usize = 1 << 20;
    const EDGE: usize = 5_000;
    let mission = mission();
    let [torque, sensing] = levels(&mission).map(|psd| (0.5 * psd * RATE_HZ).sqrt());
    let mut random = Xoshiro256PlusPlus::seed_from_u64(seed);
    let mut gauss = |sigma: f64| {
        let mut draw = || {
            let x: f64 = StandardNormal.sample(&mut random);
            sigma * x
        };
        Vector3::new(draw(), draw(), draw())
    };
    let mut body = AttitudeLoop::new(&mission);
    let mut stage = stage(&mission, &settings(method));
    let (mut rows, mut truth) = (Vec::new(), Vec::new());
    for _ in 0..SAMPLES + 2 * EDGE {
        let (epoch, alpha) = body.step(&gauss(torque), &gauss(sensing));
        truth.push(alpha);
        stage.push(&epoch, &mut rows).expect("the law takes its own state");
    }
    stage.finish(&mut rows);
    let inside = EDGE..EDGE + SAMPLES;
    let axis = |i: usize| {
        let truth: Vec<f64> = truth[inside.clone()].iter().map(|v| v[i]).collect();
        let estimate: Vec<f64> = rows[inside.clone()].iter().map(|r| r.values[i]).collect();
        (spectrum(&truth), spectrum(&estimate))
    };
    let (truth, estimate) = (0..3).map(axis).unzip();
    Record { truth, estimate, hz_per_bin: RATE_HZ / SAMPLES as f64 }
}

/// Predicted PSD of `α − α̂` about an axis of SRF: the smoother's residual without the mean over two samples.
fn predicted(mission: &Mission, axis: usize, f: f64) -> f64 {
    let [torque, sensing] = levels(mission);
    let eigen = mission.spacecraft.inertia().symmetric_eigen();
    let c = (0.5 * TAU * f * DT_S).cos();
    let principal = |j: usize| residual_psd(f, torque / eigen.eigenvalues[j].powi(2), sensing, DT_S) / (c * c);
    (0..3).map(|j| eigen.eigenvectors[(axis, j)].powi(2) * principal(j)).sum()
}

/// Slope and error power over the prediction, each with its standard deviation from sampling theory.
struct Band {
    slope: [f64; 2],
    power: [f64; 2],
}

fn band(record: &Record, axis: usize, [low, high]: [f64; 2]) -> Band {
    let mission = mission();
    let (mut cross, mut auto, mut spread, mut power, mut bins) = (0.0, 0.0, 0.0, 0.0, 0.0);
    for k in (low / record.hz_per_bin) as usize..(high / record.hz_per_bin) as usize {
        let (a, e) = (record.truth[axis][k], record.estimate[axis][k]);
        let residual = predicted(&mission, axis, k as f64 * record.hz_per_bin);
        cross += (a * e.conj()).re;
        auto += e.norm_sqr();
        spread += 0.5 * residual * e.norm_sqr();
        power += (a - e).norm_sqr() / residual;
        bins += 1.0;
    }
    Band { slope: [cross / auto, (HANN * spread).sqrt() / auto], power: [power / bins, (HANN / bins).sqrt()] }
}

/// Twelve slopes and twelve powers at five standard deviations: a false alarm in 70,000 seeds.
#[test]
fn a_day_of_noise_agrees_with_theory() {
    let record = record(Smoother, 20);
    for decade in DECADES {
        for axis in 0..3 {
            let Band { slope, power } = band(&record, axis, decade);
            assert!((slope[0] - 1.0).abs() < 5.0 * slope[1], "slope {slope:?} in {decade:?} Hz, axis {axis}");
            assert!((power[0] - 1.0).abs() < 5.0 * power[1], "error {power:?} in {decade:?} Hz, axis {axis}");
        }
    }
}

/// The same test fails for both naive ways, in slope and in power.
#[test]
fn a_day_of_noise_refutes_the_naive_ways() {
    for (method, decade) in [(Commanded, DECADES[1]), (SecondDifference, DECADES[2])] {
        let record = record(method, 21);
        for axis in 0..3 {
            let Band { slope, power } = band(&record, axis, decade);
            assert!((slope[0] - 1.0).abs() > 10.0 * slope[1], "{method:?}: slope {slope:?}, axis {axis}");
            assert!(power[0] - 1.0 > 10.0 * power[1], "{method:?}: error {power:?}, axis {axis}");
        }
    }
}
