//! Synthetic channels with known offsets: is the solution unbiased, does its σ cover the truth, and does that fail when
//! Σ is wrong?
//!
//! The data are made here from white processes sample by sample, with no code of the crate but the mission file: torque
//! and thrust noise, readouts differenced twice, and α̂ as the Wiener estimate from the attitude channel, in the
//! frequency domain.

use dragfree_estimation::collected::Collected;
use dragfree_estimation::estimate::{Bound, Estimate, Observed, Unknown, estimate};
use dragfree_estimation::prediction::Prediction;
use dragfree_estimation::segments::Segmenter;
use dragfree_estimation::sigma::NoiseModel;
use dragfree_estimation::spectra::{Analyser, Layout, Plan, Regressor, Sums};
use dragfree_estimation::state;
use dragfree_estimation::stored::{Declared, Stored};
use dragfree_hinf_dfacs::noise::declared;
use dragfree_physics::frames::dcm_turned_about_z;
use dragfree_physics::mission::Mission;
use dragfree_schema::Coefficient;
use dragfree_schema::state::{State, load, save};
use nalgebra::{DMatrix, DVector, Matrix3, Vector3};
use rand::SeedableRng;
use rand_distr::{Distribution, StandardNormal};
use rand_xoshiro::Xoshiro256PlusPlus;
use realfft::RealFftPlanner;
use realfft::num_complex::Complex64;

const RATE_HZ: f64 = 10.0;
const DT_S: f64 = 0.1;
const ROWS: usize = 32_768;
const LENGTH: usize = 4096;
/// What is simulated.
#[derive(Clone, Copy)]
struct Scene {
    rows: usize,
    /// Factor on every noise but the torque's.
    loud: f64,
    /// Attitude noise whose second difference is commanded.
    shaken_rad_rthz: f64,
}

/// 55 minutes with the noise of the mission file, in a loop.
const LOOP: Scene = Scene { rows: ROWS, loud: 1.0, shaken_rad_rthz: 1e-10 };
/// The same with the disturbances alone: α is small, and thrust noise is what hides its effect.
const DRIFTING: Scene = Scene { shaken_rad_rthz: 0.0, ..LOOP };
const OFFSETS_SRF_M: [[f64; 3]; 2] = [[0.001, 0.1804, -0.0007], [0.001, -0.1796, -0.0007]];

/// The fixture with white noises, so that samples can be drawn one by one.
fn mission() -> Mission {
    let value: serde_json::Value =
        toml::from_str(include_str!("../../../fixtures/missions/taiji.toml")).expect("the fixture is TOML");
    let mut m = Mission::from_json(&value.to_string()).expect("the fixture is a mission");
    let n = &mut m.noise;
    for shape in [&mut n.ifo_x, &mut n.is_y, &mut n.is_z].into_iter().flatten() {
        shape.exponent = 0;
    }
    n.dws_long_arm.iter_mut().for_each(|s| s.exponent = 0);
    n.electrostatic_force.iter_mut().for_each(|s| s.exponent = 0);
    n.test_mass_acceleration.iter_mut().for_each(|s| s.exponent = 0);
    n.solar_pressure = None;
    m
}

fn dcm(mass: usize) -> Matrix3<f64> {
    dcm_turned_about_z([1.0, -1.0][mass] * std::f64::consts::FRAC_PI_6)
}

fn truth() -> DVector<f64> {
    DVector::from_iterator(
        6,
        (0..2).flat_map(|i| (dcm(i) * Vector3::from(OFFSETS_SRF_M[i])).iter().copied().collect::<Vec<_>>()),
    )
}

/// Columns as the stage gets them: six channels of the test masses, three of the attitude, eighteen regressors.
fn data(seed: u64, scene: Scene) -> Vec<Vec<f64>> {
    let Scene { rows, loud, shaken_rad_rthz } = scene;
    let m = mission();
    let mut rng = Xoshiro256PlusPlus::seed_from_u64(seed);
    // Samples of white noise of one-sided ASD a at rate f_s have σ = a sqrt(f_s/2).
    let mut white = |asd: f64, n: usize| -> Vec<f64> {
        (0..n)
            .map(|_| {
                asd * (RATE_HZ / 2.0).sqrt() * <StandardNormal as Distribution<f64>>::sample(&StandardNormal, &mut rng)
            })
            .collect()
    };
    let mut three = |asd: f64, n: usize| [white(asd, n), white(asd, n), white(asd, n)];
    let inverse_inertia = m.spacecraft.inertia().try_inverse().expect("an inertia");
    let torque = three(1e-7, rows + 1);
    let force = three(1e-7 * loud, rows + 1);
    let attitude = three(5e-10 * loud, rows + 2);
    let disturbance: Vec<Vector3<f64>> =
        (0..=rows).map(|k| inverse_inertia * Vector3::new(torque[0][k], torque[1][k], torque[2][k])).collect();
    // The attitude controller's commands are known: no attitude channel sees them, the offsets do. A loop answers the
    // noise of its readout, so they rise with frequency, and `b_x`, which only the noisy y and z channels see there, is
    // worst known.
    let shaken = three(shaken_rad_rthz, rows + 3);
    let command: Vec<Vector3<f64>> = (0..=rows)
        .map(|k| Vector3::from_fn(|i, _| (shaken[i][k + 2] - 2.0 * shaken[i][k + 1] + shaken[i][k]) / (DT_S * DT_S)))
        .collect();
    let alpha: Vec<Vector3<f64>> = disturbance.iter().zip(&command).map(|(d, c)| d + c).collect();
    // Row k stands for epoch k+1: mean of [k, k+1) and [k+1, k+2).
    let mean = |x: &dyn Fn(usize) -> f64, k: usize| 0.5 * (x(k) + x(k + 1));
    let second = |x: &[f64], k: usize| (x[k + 2] - 2.0 * x[k + 1] + x[k]) / (DT_S * DT_S);
    let sc: Vec<Vec<f64>> = (0..3)
        .map(|i| (0..rows).map(|k| mean(&|k| disturbance[k][i], k) + second(&attitude[i], k)).collect())
        .collect();

    let mut channels = Vec::new();
    for mass in 0..2 {
        let t = dcm(mass);
        let b = t * Vector3::from(OFFSETS_SRF_M[mass]);
        let held: Vec<Vector3<f64>> = (0..=rows)
            .map(|k| {
                -(t * Vector3::new(force[0][k], force[1][k], force[2][k])) / m.spacecraft.mass_kg
                    - (t * alpha[k]).cross(&b)
            })
            .collect();
        for (axis, asd) in [1.42e-12, 1.8e-9, 1.8e-9].into_iter().enumerate() {
            let readout = white(asd * loud, rows + 2);
            let force_asd = if axis == 0 { 0.0 } else { 2e-14 / 1.96 };
            let own = white(loud * f64::hypot(force_asd, 3e-15), rows + 1);
            channels.push(
                (0..rows).map(|k| mean(&|k| held[k][axis] + own[k], k) + second(&readout, k)).collect::<Vec<f64>>(),
            );
        }
    }
    let estimated = wiener(&sc, &inverse_inertia, 1e-7, 5e-10 * loud);
    let mut regressors = Vec::new();
    for mass in 0..2 {
        // −[α×], of the mean over [t_k, t_k+1).
        let local: Vec<Vector3<f64>> =
            (0..rows).map(|k| dcm(mass) * (Vector3::from_fn(|i, _| estimated[i][k]) + command[k + 1])).collect();
        for coefficient in 0..3 {
            let unit = Vector3::ith(coefficient, 1.0);
            for axis in 0..3 {
                regressors.push(local.iter().map(|a| -a.cross(&unit)[axis]).collect::<Vec<f64>>());
            }
        }
    }
    channels.into_iter().chain(sc).chain(regressors).collect()
}

/// `E[α | attitude channels]`, circular in time: `S_α h* (|h|² S_α + |d|² S_n)⁻¹ sc`, with h the mean of two samples
/// and d the second difference. Row k holds the α of `[t_k, t_k+1)`, the later of the two that channel k averages.
fn wiener(sc: &[Vec<f64>], inverse_inertia: &Matrix3<f64>, torque_asd: f64, attitude_asd: f64) -> Vec<Vec<f64>> {
    let n = sc[0].len();
    let mut planner = RealFftPlanner::new();
    let (forward, inverse) = (planner.plan_fft_forward(n), planner.plan_fft_inverse(n));
    let mut spectra: Vec<Vec<Complex64>> = sc
        .iter()
        .map(|x| {
            let mut out = forward.make_output_vec();
            forward.process(&mut x.clone(), &mut out).expect("lengths agree");
            out
        })
        .collect();
    let sa = inverse_inertia * inverse_inertia.transpose() * torque_asd.powi(2);
    for k in 0..=n / 2 {
        let w = std::f64::consts::TAU * k as f64 / n as f64;
        let h = (Complex64::new(1.0, 0.0) + Complex64::from_polar(1.0, -w)) * 0.5;
        let d = 4.0 * (0.5 * w).sin().powi(2) / (DT_S * DT_S);
        let total = sa * h.norm_sqr() + Matrix3::identity() * (d * attitude_asd).powi(2);
        let gain = sa * total.try_inverse().expect("positive definite");
        let x = [spectra[0][k], spectra[1][k], spectra[2][k]];
        for i in 0..3 {
            let sum: Complex64 = (0..3).map(|j| x[j] * gain[(i, j)]).sum();
            spectra[i][k] =
                if k == 0 || 2 * k == n { Complex64::new((sum * h.conj()).re, 0.0) } else { sum * h.conj() };
        }
    }
    spectra
        .into_iter()
        .map(|mut s| {
            let mut out = inverse.make_output_vec();
            inverse.process(&mut s, &mut out).expect("lengths agree");
            out.iter().map(|x| x / n as f64).collect()
        })
        .collect()
}

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

fn layout() -> Layout {
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
    Layout { channels: CHANNELS.map(str::to_owned).to_vec(), series: names(18), regressors, coefficients: names(6) }
}

fn unknowns(half_range: f64) -> Vec<Unknown> {
    (0..6)
        .map(|i| Unknown {
            name: format!("com-offset.tm{}.{}", i / 3 + 1, ["x", "y", "z"][i % 3]),
            unit: "m".into(),
            lower: truth()[i] - half_range,
            upper: truth()[i] + half_range,
            initial: 0.0,
            prior_sigma: f64::INFINITY,
            estimate: true,
            colours: None,
        })
        .collect()
}

/// `T_O1^S b_1 − T_O2^S b_2` within 20 µm of the truth.
fn baseline() -> Vec<Bound> {
    (0..3)
        .map(|axis| {
            let terms: Vec<(usize, f64)> =
                (0..6).map(|i| (i, [1.0, -1.0][i / 3] * dcm(i / 3).transpose()[(axis, i % 3)])).collect();
            let value: f64 = terms.iter().map(|(i, w)| w * truth()[*i]).sum();
            Bound { name: format!("baseline.{axis}"), survey: true, terms, lower: value - 2e-5, upper: value + 2e-5 }
        })
        .collect()
}

/// The noise of the mission as the stage that makes the channels declares it.
fn noise_model(mission: &Mission) -> NoiseModel {
    NoiseModel::new(&declared(mission, &[["ifo_x", "is_y", "is_z"]; 2]), &CHANNELS, DT_S).expect("a noise model")
}

fn sums(columns: &[Vec<f64>], mission: &Mission) -> (Sums, Plan, NoiseModel) {
    let model = noise_model(mission);
    let collected = collect(columns, None);
    (collected.sums, Plan::new(LENGTH, RATE_HZ), model)
}

fn collect(columns: &[Vec<f64>], prediction: Option<Prediction>) -> Collected {
    let mut analyser = Analyser::new(Plan::new(LENGTH, RATE_HZ), &layout());
    let mut collected = Collected::new(analyser.plan(), &layout(), prediction);
    let averaged = (0..27).map(|j| j >= 9).collect();
    let mut segmenter = Segmenter::new(LENGTH, 100_000_000, averaged);
    let times: Vec<i64> = (0..columns[0].len() as i64).map(|k| 100_000_000 * k).collect();
    let slices: Vec<&[f64]> = columns.iter().map(Vec::as_slice).collect();
    segmenter.push(&times, &slices, &mut analyser, &mut collected);
    segmenter.end_run(&mut analyser, &mut collected);
    collected
}

fn solve(columns: &[Vec<f64>], mission: &Mission, bounds: &[Bound], half_range: f64, refinements: usize) -> Estimate {
    let (sums, plan, model) = sums(columns, mission);
    estimate(
        &Observed { layout: &layout(), plan: &plan, sums: &sums, prediction: None },
        &model,
        &unknowns(half_range),
        bounds,
        refinements,
    )
    .expect("a solution")
}

/// Sums over runs of a campaign, of the quantities `rows · θ`.
struct Campaign {
    runs: f64,
    rows: DMatrix<f64>,
    /// `eᵀ C⁻¹ e` summed, e the error of the quantities.
    nees: f64,
    /// Sum of errors in σ, per quantity.
    drift: DVector<f64>,
    /// Errors within 1 σ and 1.96 σ.
    within: [f64; 2],
    /// Mean over the runs.
    chi2_per_dof: f64,
}

impl Campaign {
    fn run(
        runs: u64,
        scene: Scene,
        mission: &Mission,
        refinements: usize,
        rows: DMatrix<f64>,
        bounds: &[Bound],
    ) -> Self {
        let n = rows.nrows();
        let mut c =
            Self { runs: runs as f64, rows, nees: 0.0, drift: DVector::zeros(n), within: [0.0; 2], chi2_per_dof: 0.0 };
        for seed in 0..runs {
            let e = solve(&data(seed, scene), mission, bounds, 50.0, refinements);
            let covariance = &c.rows * e.covariance.expect("a covariance") * c.rows.transpose();
            let error = &c.rows * (&e.theta - truth());
            c.nees += error.dot(&(covariance.clone().try_inverse().expect("definite") * &error));
            for i in 0..n {
                let sigmas = error[i] / covariance[(i, i)].sqrt();
                c.drift[i] += sigmas;
                c.within[0] += f64::from(sigmas.abs() < 1.0);
                c.within[1] += f64::from(sigmas.abs() < 1.96);
            }
            c.chi2_per_dof += e.quality.chi2_per_dof / runs as f64;
        }
        c
    }

    /// The six offsets by data alone.
    fn of_offsets(runs: u64, scene: Scene, mission: &Mission, refinements: usize) -> Self {
        Self::run(runs, scene, mission, refinements, DMatrix::identity(6, 6), &[])
    }

    /// The centre of mass, SRF: what the survey leaves open.
    fn of_centre(runs: u64, scene: Scene, mission: &Mission, refinements: usize) -> Self {
        let mut rows = DMatrix::zeros(3, 6);
        rows.view_mut((0, 0), (3, 3)).copy_from(&(dcm(0).transpose() * 0.5));
        rows.view_mut((0, 3), (3, 3)).copy_from(&(dcm(1).transpose() * 0.5));
        Self::run(runs, scene, mission, refinements, rows, &baseline())
    }

    fn nees_per_dof(&self) -> f64 {
        self.nees / self.rows.nrows() as f64 / self.runs
    }

    /// NEES inside the central 1 − 1e-4 of χ².
    fn consistent(&self) -> bool {
        let v = 2.0 / (9.0 * self.rows.nrows() as f64 * self.runs);
        let bound = |z: f64| (1.0 - v + z * v.sqrt()).powi(3);
        (bound(-3.89)..=bound(3.89)).contains(&self.nees_per_dof())
    }
}

/// 60 runs of 55 minutes. False alarms: NEES 1e-4, means of six coefficients 1e-4, both coverages 1e-4 each.
#[test]
fn values_are_unbiased_and_sigmas_cover() {
    let c = Campaign::of_offsets(60, LOOP, &mission(), 3);
    assert!(c.consistent(), "NEES/dof {}", c.nees_per_dof());
    for i in 0..6 {
        assert!(c.drift[i].abs() < 4.3 * c.runs.sqrt(), "coefficient {i}: mean error {} σ", c.drift[i] / c.runs);
    }
    for (within, p) in c.within.iter().zip([0.6827, 0.95]) {
        let n = 6.0 * c.runs;
        assert!((within - n * p).abs() < 3.89 * (n * p * (1.0 - p)).sqrt(), "{within} of {n} inside the {p} interval");
    }
}

/// The model of the noise is that of the data: without any refinement χ²/dof is 1 to 0.1 % and σ covers.
#[test]
fn the_modelled_sigma_is_that_of_the_data() {
    let c = Campaign::of_offsets(20, LOOP, &mission(), 0);
    // 20 runs, each of 2.6e5 degrees of freedom: σ of the mean is 6e-4; bound 5σ.
    assert!((c.chi2_per_dof - 1.0).abs() < 3e-3, "{}", c.chi2_per_dof);
    assert!(c.consistent(), "NEES/dof {}", c.nees_per_dof());
}

/// Twin: thrust noise of the right level on every channel, but taken as independent. The centre of mass then looks
/// better known than it is, since two test masses moved by one force count as two witnesses; re-measured, Σ knows.
#[test]
fn without_the_common_thrust_the_sigmas_are_wrong() {
    let mut independent = mission();
    independent.noise.thruster_force = None;
    independent.noise.test_mass_acceleration.iter_mut().for_each(|s| s.asd_m_s2_rthz = 1e-7 / 1500.0);
    let wrong = Campaign::of_centre(30, DRIFTING, &independent, 0);
    let mended = Campaign::of_centre(30, DRIFTING, &independent, 3);
    let right = Campaign::of_centre(30, DRIFTING, &mission(), 3);
    assert!(!wrong.consistent(), "NEES/dof {}", wrong.nees_per_dof());
    assert!(mended.consistent(), "NEES/dof {}", mended.nees_per_dof());
    assert!(right.consistent(), "NEES/dof {}", right.nees_per_dof());
}

/// Twin: data with half the noise of the mission file. Unrefined, the σ are twice too large; refined they cover.
#[test]
fn noise_unlike_the_mission_file_is_remeasured() {
    let quiet = Scene { loud: 0.5, ..LOOP };
    let unrefined = Campaign::of_offsets(20, quiet, &mission(), 0);
    assert!(!unrefined.consistent() && unrefined.chi2_per_dof < 0.6, "NEES/dof {}", unrefined.nees_per_dof());
    let refined = Campaign::of_offsets(20, quiet, &mission(), 3);
    assert!(refined.consistent(), "NEES/dof {}", refined.nees_per_dof());
    assert!((refined.chi2_per_dof - 1.0).abs() < 0.02);
}

/// With `b_1 = b_1(s) , b_2 = b_2(s)` for one common unknown s in SRF, the information is `HᵀNH`: what a survey without
/// any tolerance is worth. Ours has 20 µm, far below what the data say.
#[test]
fn the_baseline_sharpens_as_the_information_bound_says() {
    let columns = data(7, LOOP);
    let free = solve(&columns, &mission(), &[], 0.5, 3);
    let held = solve(&columns, &mission(), &baseline(), 0.5, 3);
    let n = &held.normal;
    let information = DMatrix::from_fn(6, 6, |i, j| n.normal[i][j]);
    let mut h = DMatrix::zeros(6, 3);
    h.view_mut((0, 0), (3, 3)).copy_from(&dcm(0));
    h.view_mut((3, 0), (3, 3)).copy_from(&dcm(1));
    let bound = &h * (h.transpose() * information * &h).try_inverse().expect("definite") * h.transpose();
    let inflation = held.quality.chi2_per_dof.max(1.0);
    let (held_c, free_c) =
        (held.covariance.as_ref().expect("a covariance"), free.covariance.as_ref().expect("a covariance"));
    for i in 0..6 {
        let want = (bound[(i, i)] * inflation).sqrt();
        assert!(
            (held_c[(i, i)].sqrt() / want - 1.0).abs() < 0.01,
            "coefficient {i}: {} against {want}",
            held_c[(i, i)].sqrt()
        );
        assert!((held.theta[i] - truth()[i]).abs() < 5.0 * want);
    }
    for x in [0, 3] {
        assert!(held_c[(x, x)].sqrt() < 0.1 * free_c[(x, x)].sqrt());
    }
    assert!(held.active.iter().all(|a| a.name.starts_with("baseline") && a.multiplier > 0.0));
    assert!(held.active.iter().any(|a| a.name == "baseline.0"), "{:?}", held.active);
}

/// In a range of ±2 cm, 55 minutes do not see the `x` of the masses, and the report says so; the survey lifts that.
#[test]
fn weak_directions_are_named_until_the_survey_lifts_them() {
    let columns = data(8, LOOP);
    let alone = solve(&columns, &mission(), &[], 0.02, 3);
    assert!(!alone.weak.is_empty());
    assert!(alone.weak[0].sentence.contains("com-offset.tm1.x"), "{}", alone.weak[0].sentence);
    assert!(solve(&columns, &mission(), &baseline(), 0.02, 3).weak.is_empty());
}

/// What the tapers let a run know of coefficient 1, against another run of the same length: nothing of the second run's
/// values is used.
struct Promise {
    /// `σ/σ_whole`.
    growth: f64,
    /// Standard deviation of the ratio that is measured.
    scatter: f64,
}

/// `N_b` of each band is the whole run's, with the modelled Σ; with holes it shrinks as the band's observations do,
/// which [`Spectra::observations`](dragfree_estimation::spectra::Spectra::observations) has from the tapers alone.
///
/// Scatter: a band's share `p_b` of the information on the coefficient is measured from n_b complex observations, its
/// excitation and its noise each to `1/√n_b`. Of the whole run's observations those beside the holes are a part, so the
/// ratio scatters by what the part does not share: `½ √(2 Σ p_b² (1/n_b − 1/n_b,whole))`.
fn promised(whole: &[Vec<f64>], holed: &[Vec<f64>]) -> Promise {
    const COEFFICIENT: usize = 1;
    let (sums_whole, plan, model) = sums(whole, &mission());
    let (columns, channels, layout) = (layout().columns(), CHANNELS.len(), layout());
    let kept = sums_whole.total.kept();
    let bands: Vec<DMatrix<f64>> = plan
        .bands
        .iter()
        .enumerate()
        .map(|(b, band)| {
            let psd = (band.first..band.end).map(|k| model.psd(plan.bin_hz(k as f64)));
            let sigma = psd.fold(DMatrix::zeros(channels, channels), |sum, s| sum + s) / band.bins() as f64;
            let inverse = sigma.try_inverse().expect("noise on every channel");
            let packed = sums_whole.total.band(b, columns);
            let mut information = DMatrix::zeros(6, 6);
            for (k, l) in layout.regressors.iter().flat_map(|k| layout.regressors.iter().map(move |l| (k, l))) {
                let (high, low) = (channels + k.series.max(l.series), channels + k.series.min(l.series));
                let cross = packed[high * (high + 1) / 2 + low];
                information[(k.coefficient, l.coefficient)] += kept[b] * inverse[(k.channel, l.channel)] * cross;
            }
            information
        })
        .collect();
    let n_whole = sums_whole.total.observations(&plan);
    let n_holed = sums(holed, &mission()).0.total.observations(&plan);
    let covariance = |part: &dyn Fn(usize) -> f64| {
        let sum = bands.iter().enumerate().fold(DMatrix::zeros(6, 6), |sum, (b, band)| sum + band * part(b));
        sum.try_inverse().expect("all is seen")
    };
    let (all, left) = (covariance(&|_| 1.0), covariance(&|b| n_holed[b] / n_whole[b]));
    let variance = left[(COEFFICIENT, COEFFICIENT)];
    // The combination of channels and bands that the coefficient is read from.
    let v = left.column(COEFFICIENT) / variance;
    let unshared: f64 = bands
        .iter()
        .enumerate()
        .filter(|(b, _)| n_holed[*b] > 0.0)
        .map(|(b, band)| {
            let share = v.dot(&(band * &v)) * n_holed[b] / n_whole[b] * variance;
            share * share * (1.0 / n_holed[b] - 1.0 / n_whole[b])
        })
        .sum();
    let growth = (variance / all[(COEFFICIENT, COEFFICIENT)]).sqrt();
    Promise { growth, scatter: 0.5 * growth * (2.0 * unshared).sqrt() }
}

/// A hole, a missing value, and in another run a missing value every 1200 epochs, so that no segment of full length
/// fits: σ grows as the tapers say of the epochs that are left, within four standard deviations, and still covers.
#[test]
fn gaps_cost_their_epochs_and_little_else() {
    let sigma = |e: &Estimate, i: usize| e.covariance.as_ref().expect("a covariance")[(i, i)].sqrt();
    let solve = |columns: &[Vec<f64>]| solve(columns, &mission(), &[], 50.0, 3);
    let nees = |e: &Estimate| {
        let error = &e.theta - truth();
        error.dot(&(e.covariance.clone().expect("a covariance").try_inverse().expect("definite") * &error))
    };
    let whole = data(9, LOOP);
    let mut holed = whole.clone();
    holed[4][9000..11_000].fill(f64::NAN);
    holed[20][20_000] = f64::NAN;
    let e = solve(&holed);
    let (growth, promise) = (sigma(&e, 1) / sigma(&solve(&whole), 1), promised(&whole, &holed));
    // 2002 of 32767 epochs are gone, and of six ends of runs half a segment of up to 4096 is tapered away, 0.4 of it:
    // 1.07 or so, and more than for the epochs alone, 1.03.
    assert!((1.03..1.13).contains(&promise.growth), "{}", promise.growth);
    assert!(
        (growth - promise.growth).abs() < 4.0 * promise.scatter,
        "{growth} for {} ± {}",
        promise.growth,
        promise.scatter
    );
    // P(χ²_6 > 27.9) = 1e-4.
    assert!(nees(&e) < 27.9, "{}", nees(&e));

    let runs = 20;
    let (mut sum, mut excess, mut scatter) = (0.0, 0.0, 0.0);
    for seed in 1..=runs {
        let whole = data(seed, LOOP);
        let mut holed = whole.clone();
        (0..ROWS).step_by(1200).for_each(|k| holed[4][k] = f64::NAN);
        let (e, promise) = (solve(&holed), promised(&whole, &holed));
        // 1199 epochs hold segments of 512: 0.514 of the first and the last half segment, what two that overlap keep of
        // the rest.
        assert!((1.05..1.30).contains(&promise.growth), "{}", promise.growth);
        excess += sigma(&e, 1) / sigma(&solve(&whole), 1) / promise.growth - 1.0;
        scatter += (promise.scatter / promise.growth).powi(2);
        sum += nees(&e);
    }
    assert!(excess.abs() < 4.0 * scatter.sqrt(), "{} ± {} a run", excess / 20.0, scatter.sqrt() / 20.0);
    // χ² of 120 degrees of freedom at 1e-4 on either side.
    assert!((71.0..186.0).contains(&sum), "{sum}");
}

/// Ten seconds, two segments: σ is that of an hour by the square root of the time, and a little more because half a
/// taper is lost and Σ is known badly; the errors of sixty runs are as large as it says.
#[test]
fn ten_seconds_know_what_their_samples_know() {
    let sigma = |e: &Estimate, i: usize| e.covariance.as_ref().expect("a covariance")[(i, i)].sqrt();
    let hour = solve(&data(10, LOOP), &mission(), &[], 50.0, 3);
    let (mut pulls, mut growth, runs) = ([0.0; 6], [0.0; 6], 60u32);
    for seed in 1..=u64::from(runs) {
        let columns = data(seed, Scene { rows: 100, ..LOOP });
        let e = solve(&columns, &mission(), &[], 50.0, 3);
        assert_eq!(e.normal.segments, 2);
        for i in 0..6 {
            growth[i] += sigma(&e, i) / sigma(&hour, i) / f64::from(runs);
            pulls[i] += ((e.theta[i] - truth()[i]) / sigma(&e, i)).powi(2);
        }
    }
    // χ² of 60 degrees of freedom at 1e-5 on either side.
    assert!(pulls.iter().all(|p| (25.0..116.0).contains(p)), "{pulls:?}");
    // 18.1 for the time, 21.6 with tapers that keep 0.667 instead of 0.947; what x knows comes from below 0.1 Hz.
    assert!([1, 2, 4, 5].iter().all(|i| (18.1..26.0).contains(&growth[*i])), "{growth:?}");
    assert!([0, 3].iter().all(|i| growth[*i] > 100.0), "{growth:?}");
}

/// A range that an effect states twice, for the coefficient and as a constraint, is known once.
#[test]
fn a_range_that_is_stated_twice_is_known_once() {
    let (sums, plan, model) = sums(&data(10, DRIFTING), &mission());
    let half_range = 1e-4;
    let again: Vec<Bound> = unknowns(half_range)
        .iter()
        .enumerate()
        .map(|(i, u)| Bound {
            name: "again".into(),
            survey: false,
            terms: vec![(i, 1.0)],
            lower: u.lower,
            upper: u.upper,
        })
        .collect();
    let solve = |bounds: &[Bound]| {
        let e = estimate(
            &Observed { layout: &layout(), plan: &plan, sums: &sums, prediction: None },
            &model,
            &unknowns(half_range),
            bounds,
            3,
        )
        .expect("a solution");
        e.covariance.expect("a covariance")
    };
    let (once, twice) = (solve(&[]), solve(&again));
    for i in 0..6 {
        assert!((once[(i, i)] / twice[(i, i)] - 1.0).abs() < 0.02, "{} against {}", once[(i, i)], twice[(i, i)]);
    }
}

/// The χ² of the survey against the data is one, and grows with a survey that is wrong: by 3σ of the data in `z`,
/// noticed with the row's name and a multiplier, in four of five runs of twenty (P(χ²_3 > 16.27) = 1e-3, and 0.43 at a
/// distance of 16 of χ²).
#[test]
fn a_survey_that_the_data_contradict_is_noticed() {
    let runs = 20;
    let (mut right, mut wrong, mut wrong_z) = (0.0, 0.0, 0.0);
    let mut shift = 0.0;
    for seed in 1..=runs {
        let (sums, plan, model) = sums(&data(seed, LOOP), &mission());
        let solve = |bounds: &[Bound]| {
            estimate(
                &Observed { layout: &layout(), plan: &plan, sums: &sums, prediction: None },
                &model,
                &unknowns(0.5),
                bounds,
                3,
            )
            .expect("a solution")
        };
        let honest = solve(&baseline());
        right += honest.survey_chi2.0;
        let z = honest.pulls.iter().find(|p| p.constraint == "baseline.2").expect("the row");
        shift = 4.0 * z.sigma;
        let mut bounds = baseline();
        (bounds[2].lower, bounds[2].upper) = (bounds[2].lower + shift, bounds[2].upper + shift);
        let e = solve(&bounds);
        wrong += e.survey_chi2.0;
        let z = e.pulls.iter().find(|p| p.constraint == "baseline.2").expect("the row");
        wrong_z += z.distance;
        assert!(z.multiplier > 0.0 && z.survey && z.unit == "m");
    }
    // χ² of 60 degrees of freedom at 1e-4; wrong by 4σ it has 16 more in each run, with 2·sqrt(60 + 2·320) of scatter.
    assert!((27.0..108.0).contains(&right), "{right}");
    assert!((wrong - 380.0).abs() < 4.0 * 53.0, "{wrong}");
    // Mean of twenty distances, each to within a quarter of the shift.
    assert!((wrong_z / 20.0 / -shift - 1.0).abs() < 4.0 * 0.25 / 20f64.sqrt(), "{wrong_z}");
}

/// What the blocks scatter is what N promises; half an hour of noise three times as loud in a day of eight hours is
/// not.
#[test]
fn the_scatter_of_blocks_measures_the_information() {
    let scene = Scene { rows: 8 * 36_000, ..LOOP };
    let columns = data(1, scene);
    let solve = |columns: &[Vec<f64>]| solve(columns, &mission(), &[], 0.5, 3).scatter.expect("eight blocks");
    let quiet = solve(&columns);
    assert_eq!(quiet.blocks, 8);
    // χ²_7 at 1e-4 for each of six.
    assert!(quiet.ratio.iter().all(|r| (0.2..quiet.upper).contains(r)), "{quiet:?}");
    let loud = data(2, Scene { loud: 10.0, ..scene });
    let mixed: Vec<Vec<f64>> = columns
        .iter()
        .zip(&loud)
        .map(|(a, b)| {
            a[..36_000 * 5]
                .iter()
                .chain(&b[36_000 * 5..36_000 * 5 + 18_000])
                .chain(&a[36_000 * 5 + 18_000..])
                .copied()
                .collect()
        })
        .collect();
    let uneven = solve(&mixed);
    assert!(uneven.ratio.iter().copied().fold(0.0, f64::max) > 1.5, "{uneven:?}");
}

/// The fit in the time domain: unbiased, with a σ that covers, no better than the other by more than chance, and as
/// good a witness when the noise is not that of the mission file. False alarms: 1e-4 for each sum.
#[test]
fn the_prediction_error_fit_finds_the_same_offsets() {
    let run = |seed: u64, scene: Scene| {
        // The Wiener estimate is circular in time, and wrong near the ends, which no taper hides here.
        let longer = data(seed, Scene { rows: scene.rows + 2000, ..scene });
        let columns: Vec<Vec<f64>> = longer.iter().map(|c| c[1000..c.len() - 1000].to_vec()).collect();
        let plan = Plan::new(LENGTH, RATE_HZ);
        let model = noise_model(&mission());
        let collected = collect(&columns, Prediction::new(&model, &[true; 9], &layout(), &plan));
        let prediction = collected.prediction.as_ref();
        let observed = Observed { layout: &layout(), plan: &plan, sums: &collected.all(&plan), prediction };
        let e = estimate(&observed, &model, &unknowns(50.0), &[], 3).expect("a solution");
        let check = e.prediction.clone().expect("an hour");
        (e, check)
    };
    for (scene, seeds) in [(LOOP, 1..=20), (Scene { loud: 3.0, ..LOOP }, 101..=110)] {
        let runs = seeds.clone().count() as f64;
        let (mut squares, mut sums, mut apart) = ([0.0; 6], [0.0; 6], 0.0f64);
        for seed in seeds {
            let (e, check) = run(seed, scene);
            for i in 0..6 {
                let z = (check.value[i] - truth()[i]) / check.sigma[i];
                squares[i] += z * z;
                sums[i] += z;
                let other = e.covariance.as_ref().expect("a covariance")[(i, i)].sqrt();
                apart = apart.max((check.value[i] - e.theta[i]).abs() / check.sigma[i].hypot(other));
            }
        }
        // χ² of as many degrees of freedom as runs, by its mean and scatter at 3.9σ and what its skewness adds.
        assert!(squares.iter().all(|s| *s < runs + 3.9 * (2.0 * runs).sqrt() + 10.0), "{squares:?}");
        assert!(sums.iter().all(|s| s.abs() < 4.3 * runs.sqrt()), "{sums:?}");
        assert!(apart < 3.0, "{apart}");
    }
}

/// Two days, the second with the state of the first: what each has stored, stacked, gives the answer of one run over
/// both, and so does the second run itself; to 1e-12 of the value, σ alike.
#[test]
fn daily_sums_stacked_are_one_long_run() {
    let columns = data(11, LOOP);
    let plan = || Plan::new(LENGTH, RATE_HZ);
    let model = noise_model(&mission());
    let prediction = || Prediction::new(&model, &[true; 9], &layout(), &plan());
    let begin = || {
        let segmenter = Segmenter::new(LENGTH, 100_000_000, (0..27).map(|j| j >= 9).collect());
        (segmenter, Collected::new(&plan(), &layout(), prediction()), Analyser::new(plan(), &layout()))
    };
    let feed = |range: std::ops::Range<usize>, run: &mut (Segmenter, Collected, Analyser)| {
        let times: Vec<i64> = range.clone().map(|k| 100_000_000 * k as i64).collect();
        let slices: Vec<&[f64]> = columns.iter().map(|c| &c[range.clone()]).collect();
        run.0.push(&times, &slices, &mut run.2, &mut run.1);
    };
    let solve = |sums: &Sums| {
        let observed = Observed { layout: &layout(), plan: &plan(), sums, prediction: None };
        estimate(&observed, &model, &unknowns(0.5), &baseline(), 3).expect("a solution")
    };
    let midnight = 17_777;
    let mut long = begin();
    feed(0..ROWS, &mut long);
    let mut first = begin();
    feed(0..midnight, &mut first);
    let visit = |state: &mut State<'_>, run: &mut (Segmenter, Collected, Analyser)| {
        state::visit(state, "two days", &mut run.0.state, &mut run.1, &plan())
    };
    let bytes = save("mine", 1, |state| visit(state, &mut first)).expect("a state");
    let mut second = begin();
    load("mine", 1, &bytes, |state| visit(state, &mut second)).expect("our own state");
    feed(midnight..ROWS, &mut second);

    let want = solve(&long.1.all(&plan()));
    let named = |name: &String| Coefficient { name: name.clone(), ..Coefficient::default() };
    let coefficients: Vec<Coefficient> = layout().coefficients.iter().map(named).collect();
    let declared = Declared { coefficients, ..Declared::default() };
    let stored = [&first.1, &second.1].map(|c| Stored::new(&layout(), &plan(), declared.clone(), &c.sums.total));
    let text = stored.map(|s| serde_json::to_string(&s).expect("JSON"));
    let days: Vec<Stored> = text.iter().map(|t| serde_json::from_str(t).expect("our own")).collect();
    let (_, _, stacked) = Stored::stack(&days).expect("two days");
    for got in [solve(&stacked), solve(&second.1.all(&plan()))] {
        assert_eq!(got.normal.segments, want.normal.segments);
        let (a, b) = (got.covariance.expect("a covariance"), want.covariance.as_ref().expect("a covariance"));
        for i in 0..6 {
            // The solver stops at 1e-9 of its objective, far below a millionth of σ.
            assert!((got.theta[i] - want.theta[i]).abs() < 1e-6 * b[(i, i)].sqrt());
            assert!((a[(i, i)] / b[(i, i)] - 1.0).abs() < 1e-9);
        }
        for (a, b) in got.normal.normal.iter().flatten().zip(want.normal.normal.iter().flatten()) {
            assert!((a - b).abs() <= 1e-12 * (want.normal.normal[0][0] + b.abs()), "{a} against {b}");
        }
    }
}
