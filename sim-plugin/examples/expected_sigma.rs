//! One standard deviation of every effect's SIZE after so many hours of the bundled mission, for the table in
//! `src/hidden.rs`: `expected_sigma HOURS [EFFECT]`.
//!
//! The time is simulated twice with the same random numbers, without an effect and with a small one. The difference of
//! the nine residual channels is the effect's regressor, the controller's answer taken out by the commands. The Fisher
//! information of it under the mission's noise, after the six offsets (with the surveyed baseline) and a constant and a
//! slope per channel are fitted, gives σ. For an excess of noise it is that of the spectra.

#![allow(clippy::print_stdout, reason = "it prints a table")]

use dragfree_physics::mission::Mission;
use dragfree_sim::effects::{EffectRequest, catalogue};
use dragfree_sim::simulator::{Epoch, Settings, Simulator};
use nalgebra::{Complex, DMatrix, DVector, Matrix3, SMatrix, Vector3};
use realfft::RealFftPlanner;
use std::f64::consts::TAU;

const DT_S: f64 = 0.1;
const CHANNELS: usize = 9;
type Channels = SMatrix<Complex<f64>, CHANNELS, CHANNELS>;

fn mission() -> Mission {
    let text = include_str!("../../fixtures/missions/taiji.toml");
    let value: serde_json::Value = toml::from_str(text).expect("the fixture is TOML");
    Mission::from_json(&value.to_string()).expect("the fixture is a mission")
}

struct Known {
    dcm: [Matrix3<f64>; 2],
    offset: [Vector3<f64>; 2],
    inverse: Matrix3<f64>,
}

const SC_KG: f64 = 1500.0;
const TM_KG: f64 = 1.96;

impl Known {
    fn new(mission: &Mission) -> Self {
        let section = |name: &str| mission.test_mass(name, "the example").expect("both test masses");
        Self {
            dcm: ["tm1", "tm2"].map(|name| section(name).dcm_orf_from_srf()),
            offset: ["tm1", "tm2"].map(|name| Vector3::from(section(name).offset_nominal_srf_m)),
            inverse: mission.spacecraft.inertia_inverse(),
        }
    }

    /// Known accelerations over a sample: both test masses, then the spacecraft's angular one.
    fn known(&self, e: &Epoch) -> [Vector3<f64>; 3] {
        let c = &e.command;
        let (mut force, mut torque) = (c.mps_force_srf_n, c.mps_torque_srf_nm);
        for i in 0..2 {
            let f = self.dcm[i].tr_mul(&c.tm[i].force_orf_n);
            force -= f;
            torque -= self.dcm[i].tr_mul(&c.tm[i].torque_orf_nm) + self.offset[i].cross(&f);
        }
        let tm = |i: usize| {
            let euler = e.truth.alpha_srf_rad_s2.cross(&self.offset[i]);
            c.tm[i].force_orf_n / TM_KG - self.dcm[i] * (force / SC_KG + euler)
        };
        [tm(0), tm(1), self.inverse * torque]
    }
}

/// Readouts, known accelerations and `α` of an epoch.
#[derive(Clone, Copy)]
struct Sample {
    shown: [Vector3<f64>; 3],
    known: [Vector3<f64>; 3],
    alpha: Vector3<f64>,
}

fn names(mission: &Mission) -> Vec<String> {
    mission.test_mass.keys().cloned().collect()
}

/// Nine residual channels, and with them `α` as the offsets' regressors need it.
fn residuals(mission: &Mission, samples: usize, effect: Option<&str>) -> (Vec<Vec<f64>>, Vec<Vector3<f64>>) {
    let settings = Settings {
        seed: 1,
        start_ns: 2_051_222_400_000_000_000,
        settle_s: 600.0,
        com_offset_srf_m: Vector3::new(0.001, 0.0, 0.0),
        stiffness_error: 0.2,
        manoeuvres: Vec::new(),
        effects: effect.iter().map(|text| EffectRequest::parse(text, &names(mission)).expect("an effect")).collect(),
    };
    let known = Known::new(mission);
    let mut simulator = Simulator::new(mission, settings).expect("the fixture flies");
    let mut out = vec![Vec::new(); CHANNELS];
    let mut alphas = Vec::with_capacity(samples);
    let mut past: Option<[Sample; 2]> = None;
    let mut last: Option<Sample> = None;
    for _ in 0..samples + 2 {
        let e = simulator.step().expect("the loop holds");
        let m = &e.measured;
        let r = |i: usize| m.tm[i].best().r_orf_m;
        let now =
            Sample { shown: [r(0), r(1), m.dws_sc_crf_rad], known: known.known(&e), alpha: e.truth.alpha_srf_rad_s2 };
        if let Some([a, b]) = &past {
            for c in 0..3 {
                let second = (now.shown[c] - b.shown[c] * 2.0 + a.shown[c]) / (DT_S * DT_S);
                let z = second - (a.known[c] + b.known[c]) * 0.5;
                (0..3).for_each(|i| out[3 * c + i].push(z[i]));
            }
            alphas.push((a.alpha + b.alpha) * 0.5);
        }
        past = last.map(|l| [l, now]);
        last = Some(now);
    }
    (out, alphas)
}

/// Spectrum of a series without mean and slope, tapered over a tenth of it at each end.
fn transform(x: &[f64], planner: &mut RealFftPlanner<f64>) -> Vec<Complex<f64>> {
    let n = x.len();
    let middle = (n as f64 - 1.0) / 2.0;
    let mean = x.iter().sum::<f64>() / n as f64;
    let slope = x.iter().enumerate().map(|(i, x)| (i as f64 - middle) * x).sum::<f64>()
        / (0..n).map(|i| (i as f64 - middle).powi(2)).sum::<f64>();
    let edge = n / 10;
    let taper = |i: usize| {
        let near = i.min(n - 1 - i);
        if near < edge { 0.5 - 0.5 * (std::f64::consts::PI * near as f64 / edge as f64).cos() } else { 1.0 }
    };
    let mut input: Vec<f64> =
        x.iter().enumerate().map(|(i, x)| (x - mean - slope * (i as f64 - middle)) * taper(i) * DT_S).collect();
    let fft = planner.plan_fft_forward(n);
    let mut output = fft.make_output_vec();
    fft.process(&mut input, &mut output).expect("lengths agree");
    output
}

/// One-sided PSD of the nine channels, and the part of one source in it.
struct Model {
    known: Known,
    seconds: f64,
}

impl Model {
    /// Unit columns: what a force (N) and torque (N m) of the thrusters do to the channels.
    fn thrusters(&self, torque: bool, axis: usize) -> SMatrix<f64, CHANNELS, 1> {
        let mut column = SMatrix::<f64, CHANNELS, 1>::zeros();
        let unit = Vector3::from_fn(|i, _| f64::from(i == axis));
        if torque {
            column.fixed_rows_mut::<3>(6).copy_from(&(self.known.inverse * unit));
        } else {
            for i in 0..2 {
                column.fixed_rows_mut::<3>(3 * i).copy_from(&(self.known.dcm[i] * unit / -SC_KG));
            }
        }
        column
    }

    fn psd(&self, f: f64) -> SMatrix<f64, CHANNELS, CHANNELS> {
        let d4 = ((TAU * f * DT_S / 2.0).sin() * 2.0 / DT_S).powi(4);
        let mut s = SMatrix::<f64, CHANNELS, CHANNELS>::zeros();
        let stray = |i: usize| {
            let acceleration = 9e-30 * (1.0 + (4e-4 / f).powi(2));
            let electric = (2e-14 / TM_KG).powi(2) * (1.0 + (1e-3 / f).powi(2));
            acceleration + if i.is_multiple_of(3) { 0.0 } else { electric }
        };
        for i in 0..6_usize {
            let readout = if i.is_multiple_of(3) {
                1.42e-12_f64.powi(2) * (1.0 + (2e-3 / f).powi(4))
            } else {
                1.8e-9_f64.powi(2) * (1.0 + (1e-3 / f).powi(2))
            };
            s[(i, i)] += readout * d4 + stray(i);
        }
        let dws = 5e-10_f64.powi(2) * (1.0 + (2e-3 / f).powi(4)) * d4;
        for i in 0..3 {
            s[(6 + i, 6 + i)] += dws;
            // What wavefront sensing and commanded torque together leave unknown of α.
            let torque = self.thrusters(true, i) * 1e-7;
            let force = self.thrusters(false, i) * 1e-7;
            s += torque * torque.transpose() + force * force.transpose();
            let unknown = 1.0 / (1.0 / dws.max(1e-300) + 1.0 / (1e-7_f64 / 800.0).powi(2));
            let unit = Vector3::from_fn(|j, _| f64::from(i == j));
            let mut lever = SMatrix::<f64, CHANNELS, 1>::zeros();
            for tm in 0..2 {
                lever.fixed_rows_mut::<3>(3 * tm).copy_from(&(self.known.dcm[tm] * unit.cross(&self.known.offset[tm])));
            }
            s += lever * lever.transpose() * unknown;
        }
        s
    }

    /// σ of `k` of an excess whose PSD is `k²` times one source's, at `k = 1`.
    fn excess(&self, part: impl Fn(f64) -> SMatrix<f64, CHANNELS, CHANNELS>) -> f64 {
        let step = 1.0 / self.seconds;
        // A thousand frequencies stand for all, evenly spread: white sources tell most at the top.
        let (count, mut information) = (1000, 0.0);
        for j in 0..count {
            let f = 5.0 * (f64::from(j) + 0.5) / f64::from(count);
            let ratio = self.psd(f).try_inverse().expect("noise is positive") * part(f);
            information += (ratio * ratio).trace() * 5.0 / f64::from(count) / step;
        }
        0.5 / information.sqrt()
    }
}

fn main() {
    let mut arguments = std::env::args().skip(1);
    let hours: f64 = arguments.next().and_then(|text| text.parse().ok()).unwrap_or(24.0);
    let only = arguments.next();
    let samples = (hours * 3600.0 / DT_S) as usize;
    let mission = mission();
    let model = Model { known: Known::new(&mission), seconds: hours * 3600.0 };
    let mut planner = RealFftPlanner::new();
    let (plain, alphas) = residuals(&mission, samples, None);
    let n = plain[0].len();
    let frequency = |k: usize| k as f64 / (n as f64 * DT_S);
    let inverse: Vec<Channels> = (1..n / 2)
        .map(|k| {
            let s = model.psd(frequency(k)).try_inverse().expect("noise is positive");
            s.map(|x| Complex::new(4.0 * x / (n as f64 * DT_S), 0.0))
        })
        .collect();
    // Offsets: three common to both housings, three of the difference, SRF.
    let offsets: Vec<Vec<Vec<Complex<f64>>>> = (0..6)
        .map(|p| {
            let unit = Vector3::from_fn(|i, _| f64::from(i == p % 3));
            let mut columns = vec![vec![0.0; n]; CHANNELS];
            for (k, alpha) in alphas.iter().enumerate() {
                for tm in 0..2 {
                    let sign = if p >= 3 && tm == 1 { -1.0 } else { 1.0 };
                    let a = model.known.dcm[tm] * -alpha.cross(&unit) * sign;
                    (0..3).for_each(|i| columns[3 * tm + i][k] = a[i]);
                }
            }
            columns.iter().map(|c| transform(c, &mut planner)).collect()
        })
        .collect();
    let product = |a: &[Vec<Complex<f64>>], b: &[Vec<Complex<f64>>]| -> f64 {
        let mut sum = 0.0;
        for (k, inverse) in (1..n / 2).zip(&inverse) {
            for i in 0..CHANNELS {
                let weighted: Complex<f64> = (0..CHANNELS).map(|j| inverse[(i, j)] * b[j][k]).sum();
                sum += (a[i][k].conj() * weighted).re;
            }
        }
        sum
    };
    let mut nuisance = DMatrix::<f64>::from_fn(6, 6, |i, j| product(&offsets[i], &offsets[j]));
    // The survey: 2e-5 m, halved as the difference is counted from the middle.
    (3..6).for_each(|i| nuisance[(i, i)] += 1e-5_f64.powi(-2));
    let solved = nuisance.clone().cholesky().expect("offsets are seen");
    let sigma_b: Vec<String> = (0..3).map(|i| format!("{:.2e}", solved.inverse()[(i, i)].sqrt())).collect();
    println!("offset, m: {}", sigma_b.join(" "));

    let shapes = |id: &str, place: &str| -> Vec<(String, f64)> {
        let text = |rest: &str| format!("{id}:{place}={rest}");
        match id {
            "com-offset" | "tilt-to-length" => vec![(text("1e-4"), 1e-4)],
            "stiffness" => vec![(text("1e-8"), 1e-8)],
            "cross-stiffness" => vec![(text("1e-8"), 1e-8)],
            "offset-drift" => {
                vec![(text("1e-9"), 1e-9), (text("0,kappa_m_k=1e-5"), 1e-5), (text("0,beta_m_kg=1e-3"), 1e-3)]
            }
            "opening-angle" => vec![(text("1e-3"), 1e-3)],
            "thermal" => [60.0, 480.0, 3000.0].map(|lag| (text(&format!("1e-12,lag_s={lag}")), 1e-12)).to_vec(),
            "magnetic" => vec![(text("-1e-5"), 1e-5), (text("0,moment_a_m2=1e-9"), 1e-9)],
            "charge" => vec![(text("1e-2"), 1e-2)],
            "current-force" | "product-force" => vec![(text("1e-14"), 1e-14)],
            "slosh" => [0.005, 0.012, 0.03, 0.08, 0.2].map(|f0| (text(&format!("0.01,f0_hz={f0}")), 0.01)).to_vec(),
            "impulse" => vec![(text(&format!("1e-8,at_s={}", 1800.0 * hours)), 1e-8)],
            "mps-noise" | "torque-noise" | "is-noise" | "mps-correlation" => vec![],
            "time-offset" => vec![(text("0.01"), 0.01)],
            _ => vec![(text("0.01"), 0.01)],
        }
    };
    for kind in catalogue().filter(|kind| only.as_ref().map_or(kind.id != "com-offset", |id| id == kind.id)) {
        for place in (kind.places)(mission.test_mass.len()) {
            for (effect, size) in shapes(kind.id, &place.name(&names(&mission))) {
                let (z, _) = residuals(&mission, samples, Some(&effect));
                let change: Vec<Vec<Complex<f64>>> = z
                    .iter()
                    .zip(&plain)
                    .map(|(a, b)| {
                        let difference: Vec<f64> = a.iter().zip(b).map(|(a, b)| (a - b) / size).collect();
                        transform(&difference, &mut planner)
                    })
                    .collect();
                let cross = DVector::from_fn(6, |i, _| product(&offsets[i], &change));
                let own = product(&change, &change);
                let left = own - cross.dot(&solved.solve(&cross));
                println!("{effect:45} σ = {:9.2e}   alone {:9.2e}", left.max(0.0).powf(-0.5), own.powf(-0.5));
            }
        }
        let part = |column: SMatrix<f64, CHANNELS, 1>| column * column.transpose() * 1e-14;
        for axis in 0..3 {
            match kind.id {
                "mps-noise" | "torque-noise" => {
                    let column = model.thrusters(kind.id == "torque-noise", axis);
                    println!("{}: axis {axis}: σ of k = {:.2e}", kind.id, model.excess(|_| part(column)));
                }
                "is-noise" if axis > 0 => {
                    let sigma = model.excess(|f| {
                        let mut s = SMatrix::<f64, CHANNELS, CHANNELS>::zeros();
                        let d4 = ((TAU * f * DT_S / 2.0).sin() * 2.0 / DT_S).powi(4);
                        s[(axis, axis)] = 1.8e-9_f64.powi(2) * (1.0 + (1e-3 / f).powi(2)) * d4;
                        s
                    });
                    println!("is-noise: axis {axis}: σ of k = {sigma:.2e}");
                }
                _ => {}
            }
        }
    }
}
