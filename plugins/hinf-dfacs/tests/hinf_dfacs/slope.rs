//! The crux of the calibration: the truth regressed on `α̂` has slope one.
//!
//! First without chance: the loop and the stage are linear, so impulses through both give every transfer function and
//! with them the slope itself, `Re ∫S_αα̂ / ∫S_α̂α̂`. By chance alone a slope has the variance
//! `∫S_e S_α̂ / (2T (∫S_α̂)²)`, `S_e` being the error's spectrum: to show 0.2 % at four standard deviations a
//! Hann-weighted record would have to be six days long for 0.1 to 1 Hz, seven months for 10 to 100 mHz and fourteen for
//! 1 to 10 mHz. Then with chance, on a record of 29 hours, at five standard deviations.

use crate::common::{AttitudeLoop, DT_S, RATE_HZ, late, levels, mission, run, settings, stage};
use dragfree_hinf_dfacs::reconstruction::AngularAcceleration::{self, Commanded, SecondDifference, Smoother};
use dragfree_hinf_dfacs::smoother::residual_psd;
use dragfree_physics::mission::Mission;
use nalgebra::Vector3;
use rand::SeedableRng;
use rand_distr::{Distribution, StandardNormal};
use rand_xoshiro::Xoshiro256PlusPlus;
use realfft::num_complex::Complex64;
use std::f64::consts::TAU;

pub(crate) const DECADES: [[f64; 2]; 4] = [[1e-3, 1e-2], [1e-2, 1e-1], [1e-1, 1.0], [1.0, 4.9]];

/// Truth and `α̂`, axis by axis, from an impulse of torque (inputs 0 to 2) or of readout error (3 to 5).
pub(crate) struct Response {
    pub(crate) truth: [Vec<f64>; 3],
    pub(crate) estimate: [Vec<f64>; 3],
}

/// The covariances settle for over an hour on zeros; then the impulse, in the middle of nowhere of a block.
fn response(flown: &Mission, told: &Mission, method: AngularAcceleration, input: usize) -> Response {
    const QUIET: usize = 40_321;
    const AFTER: usize = 1 << 16;
    let mut body = AttitudeLoop::new(flown);
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
    let rows = run(&mut stage(told, &settings(method)), &epochs);
    let estimate = std::array::from_fn(|i| {
        // The second difference lacks two epochs at the ends.
        rows.iter().map(|row| if row.values[i].is_finite() { row.values[i] } else { 0.0 }).collect()
    });
    Response { truth, estimate }
}

/// Truth against `α̂` in a decade, about an axis.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Against {
    pub(crate) slope: f64,
    /// Part of the truth's power that `α̂` explains: `|∫S_αα̂|² / (∫S_αα ∫S_α̂α̂)`.
    pub(crate) coherence: f64,
}

/// `α̂` carries information where it explains at least a tenth of the truth's power.
const INFORMED: f64 = 0.1;

/// Slope of the truth on `α̂` per decade and axis, exactly, of noise of the mission `flown` through a stage that is
/// told `told`. The controllers are the same.
fn against(flown: &Mission, told: &Mission, method: AngularAcceleration) -> [[Against; 3]; 4] {
    let responses: Vec<_> = (0..6).map(|input| response(flown, told, method, input)).collect();
    of_responses(flown, &responses)
}

pub(crate) fn of_responses(flown: &Mission, responses: &[Response]) -> [[Against; 3]; 4] {
    let [torque, _] = levels(flown);
    let sensing = flown.noise.dws_long_arm.as_ref().expect("the fixture has it").shape();
    DECADES.map(|[low, high]| {
        const POINTS: usize = 24;
        let (mut cross, mut auto, mut power) = ([0.0; 3], [0.0; 3], [0.0; 3]);
        for point in 0..POINTS {
            let f = low * (high / low).powf((point as f64 + 0.5) / POINTS as f64);
            let phase: Vec<_> = (0..responses[0].truth[0].len())
                .map(|k| Complex64::cis(-TAU * (f * DT_S * k as f64).fract()))
                .collect();
            let spectrum = |x: &[f64]| x.iter().zip(&phase).map(|(x, p)| p * x).sum::<Complex64>();
            for (input, response) in responses.iter().enumerate() {
                let level = if input < 3 { torque / 1e-14 } else { sensing.psd(f) / 1e-18 };
                for i in 0..3 {
                    let [a, e] = [spectrum(&response.truth[i]), spectrum(&response.estimate[i])];
                    // Points are even in ln f.
                    cross[i] += level * f * (a * e.conj()).re;
                    auto[i] += level * f * e.norm_sqr();
                    power[i] += level * f * a.norm_sqr();
                }
            }
        }
        std::array::from_fn(|i| Against {
            slope: cross[i] / auto[i],
            coherence: cross[i] * cross[i] / (auto[i] * power[i]),
        })
    })
}

/// The mission with another noise of the wavefront sensing, under the same controllers.
fn sensing(asd_rad_rthz: f64, corner_hz: f64) -> Mission {
    let mut mission = mission();
    let noise = mission.noise.dws_long_arm.as_mut().expect("the fixture has it");
    (noise.asd_rad_rthz, noise.corner_hz) = (asd_rad_rthz, corner_hz);
    mission
}

/// Decades and axes in which `α̂` carries information, and of those the ones whose slope is more than 0.2 % from one.
fn judged(flown: &Mission, told: &Mission) -> (usize, Vec<String>) {
    let found = against(flown, told, Smoother);
    let informed = || {
        DECADES
            .iter()
            .zip(&found)
            .flat_map(|(d, a)| a.iter().map(move |a| (d, a)))
            .filter(|(_, a)| a.coherence > INFORMED)
    };
    let off = informed().filter(|(_, a)| (a.slope - 1.0).abs() > 2e-3).map(|(d, a)| format!("{a:?} in {d:?} Hz"));
    (informed().count(), off.collect())
}

/// The default noise, the quieter regime, sensing ten times and ten thousand times noisier, and a rise below 20 mHz:
/// under each `α̂` carries information in every decade, if only what the loop makes of the sensing's noise.
#[test]
fn truth_on_smoothed_acceleration_has_slope_one() {
    for (asd, corner_hz) in [(5e-10, 2e-3), (2.09e-10, 2e-3), (5e-9, 2e-3), (5e-6, 2e-3), (5e-10, 2e-2)] {
        let mission = sensing(asd, corner_hz);
        let (informed, off) = judged(&mission, &mission);
        assert!(informed == 12 && off.is_empty(), "{asd:e} rad/√Hz, corner {corner_hz} Hz: {informed} {off:#?}");
    }
}

/// The twin: of a rise below 20 mHz a smoother that is not told takes the sensing's noise for motion.
#[test]
fn a_smoother_without_colour_is_biased() {
    let (_, off) = judged(&sensing(5e-10, 2e-2), &sensing(5e-10, 0.0));
    assert!(off.len() >= 3, "{off:#?}");
}

/// Thrusters that act late, and the twin that is not told.
#[test]
fn late_thrusters_need_to_be_told() {
    let late = late(mission());
    let (informed, off) = judged(&late, &late);
    assert!(informed == 12 && off.is_empty(), "{informed} {off:#?}");
    let responses: Vec<_> = (0..6).map(|input| response(&late, &mission(), Smoother, input)).collect();
    let untold = of_responses(&late, &responses);
    assert!(untold[1].iter().all(|a| (a.slope - 1.0).abs() > 5e-3), "10 to 100 mHz: {:?}", untold[1]);
}

/// The trap of physics.md §4, first way: the second difference is mostly noise of the sensing.
#[test]
fn second_difference_attenuates() {
    let found = against(&mission(), &mission(), SecondDifference);
    assert!(found[2].iter().all(|a| a.slope < 0.1), "0.1 to 1 Hz: {:?}", found[2]);
    assert!(found[3].iter().all(|a| a.slope < 0.01), "above 1 Hz: {:?}", found[3]);
}

/// The trap, second way: the command answers the very disturbance that it leaves out.
#[test]
fn commanded_torque_alone_is_biased() {
    let found = against(&mission(), &mission(), Commanded);
    assert!(found[1].iter().all(|a| (a.slope - 1.0).abs() > 0.1), "10 to 100 mHz: {:?}", found[1]);
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
