//! Kalman predictor of displacements normal to the optical plane, where no interferometer shows the unmodelled force.
//!
//! Along s_3 the acceleration is `û + Φ b + d`, and `d`, chiefly thruster noise, is common to all test masses.
//! Regressors of a readout error must not contain the noise of the sample that they explain. They are made of the
//! displacement that the past predicts; Methods, "Readout errors normal to the optical plane".
//!
//! The state of a test mass is `(r, v Δt)`; readouts are white, and so are accelerations, held over a sample.

use dragfree_physics::frames::skew;
use dragfree_physics::mission::Mission;
use dragfree_physics::thrust_noise::ThrustNoise;
use dragfree_sdk::prelude::*;
use nalgebra::{DMatrix, DVector, Matrix3};

use crate::columns::{Body, InputColumn, latest_column};

/// Axis of ORF along s_3.
const Z: usize = 2;
/// Time constants of the slowest mode until the prediction no longer depends on its start, e⁻¹⁵ of which is left.
const SETTLING: f64 = 15.0;
/// Doublings of the Riccati recursion: 2^24 samples, far longer than any time constant of the predictor.
const DOUBLINGS: usize = 24;

/// Readout of a test mass along s_3 with its known acceleration.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct PredictedAxis {
    pub(crate) readout: InputColumn,
    /// Columns and factors that add up to `û + Φ b` with the mission's offset, m s⁻².
    pub(crate) known: Vec<(InputColumn, f64)>,
}

/// Noise of the readouts along s_3 of several test masses.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct AxisNoise {
    /// Covariance of the accelerations over a sample, times Δt⁴, m².
    acceleration_m2: DMatrix<f64>,
    /// Variances of the readouts, m².
    readout_m2: DVector<f64>,
}

/// Acceleration of the displacement along s_3 that the past predicts of a test mass.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct PredictedAcceleration {
    pub(crate) name: String,
    /// The test masses that are predicted together.
    pub(crate) axes: Vec<PredictedAxis>,
    /// Predictor gain, two rows per test mass.
    gain: DMatrix<f64>,
    /// Index of the test mass.
    tm: usize,
    dt_s: f64,
}

/// The test masses whose displacement along s_3 the inertial sensor reads, and the noise of these readouts.
#[derive(Clone, Debug)]
pub(crate) struct Normal {
    pub(crate) tms: Vec<Body>,
    axes: Vec<PredictedAxis>,
    noise: AxisNoise,
    dt_s: f64,
}

impl AxisNoise {
    /// Accelerations by force and torque noise of the thrusters, sunlight, electrodes and stray forces.
    ///
    /// The torque noise that α̂ does not contain acts through the offset, with the spectrum of Methods, "Angular
    /// acceleration", at the frequency where the force noise moves a test mass by as much as the readout's noise.
    fn of(mission: &Mission, tms: &[Body], by: &'static str) -> Result<Self, PluginError> {
        let (noise, n) = (&mission.noise, tms.len());
        let thrust = ThrustNoise::of(mission).filter(|t| !t.force_shape.terms.is_empty());
        let thrust = Mission::need(&thrust, "noise.thruster_force", by)?;
        let inverse = mission.spacecraft.inertia_inverse();
        let sunlight = noise.solar_pressure.as_ref().map_or(0.0, |p| p.shape().white_psd());
        let (mut force, mut alpha) = (DMatrix::zeros(n, 3), DMatrix::zeros(n, 3));
        let mut readout_psd = DVector::zeros(n);
        for (i, tm) in tms.iter().enumerate() {
            let dcm = tm.section.dcm_orf_from_srf();
            let lever = skew(&tm.section.offset_nominal_orf_m()) * dcm;
            let lever =
                lever - dcm * thrust.force_per_torque * mission.spacecraft.inertia() / mission.spacecraft.mass_kg;
            force.row_mut(i).copy_from(&(dcm.row(Z) / mission.spacecraft.mass_kg));
            alpha.row_mut(i).copy_from(&lever.row(Z));
            let (table, readout) = mission.displacement_noise(&tm.section, Z);
            let readout = readout.ok_or_else(|| {
                PluginError::error(format!("{by}: the mission file has no table [noise.{table}]; add it"))
            })?;
            readout_psd[i] = readout.shape().white_psd();
        }
        let force_psd = thrust.force_given_torque * thrust.force_shape.white_psd() + Matrix3::identity() * sunlight;
        let mut psd = &force * force_psd * force.transpose();
        let square_rad2_s2 = (psd[(0, 0)] / readout_psd[0]).sqrt();
        let torque = inverse * thrust.torque * inverse.transpose() * thrust.torque_shape.white_psd();
        let unknown = match &noise.dws_long_arm {
            Some(sensing) => {
                let sensed = Matrix3::identity() * (sensing.shape().white_psd() * square_rad2_s2.powi(2));
                (sensed + torque).try_inverse().map_or(torque, |sum| sensed * sum * torque)
            }
            None => torque,
        };
        psd += &alpha * unknown * alpha.transpose();
        for (i, tm) in tms.iter().enumerate() {
            let electrodes = noise.electrostatic_force.as_ref().map_or(0.0, |f| f.shape().white_psd());
            let stray = noise.test_mass_acceleration.as_ref().map_or(0.0, |a| a.shape().white_psd());
            psd[(i, i)] += electrodes / tm.section.mass_kg.powi(2) + stray;
        }
        let dt_s = mission.dt_s();
        Ok(Self { acceleration_m2: psd * (0.5 * dt_s.powi(3)), readout_m2: readout_psd * (0.5 / dt_s) })
    }

    /// Gain of the stationary predictor, two rows per test mass; `None` if there is none.
    fn gain(&self) -> Option<DMatrix<f64>> {
        let n = self.readout_m2.len();
        let step = DMatrix::from_row_slice(2, 2, &[1.0, 1.0, 0.0, 1.0]);
        let held = DMatrix::from_row_slice(2, 2, &[0.25, 0.5, 0.5, 1.0]);
        let transition = DMatrix::identity(n, n).kronecker(&step);
        let measured = DMatrix::<f64>::identity(n, n).kronecker(&DMatrix::from_row_slice(1, 2, &[1.0, 0.0]));
        // Displacements in units of the first readout's σ.
        let unit_m2 = self.readout_m2[0];
        let readout = DMatrix::from_diagonal(&(&self.readout_m2 / unit_m2));
        let information = measured.transpose() * readout.clone().try_inverse()? * &measured;
        // Structure-preserving doubling (Anderson 1978): p is the covariance after 2^k samples.
        let (mut a, mut g) = (transition.transpose(), information);
        let mut p = (&self.acceleration_m2 / unit_m2).kronecker(&held);
        let unit = DMatrix::identity(2 * n, 2 * n);
        for _ in 0..DOUBLINGS {
            let inverse = (&unit + &g * &p).try_inverse()?;
            let next = &p + a.transpose() * &p * &inverse * &a;
            g += &a * &inverse * &g * a.transpose();
            a = &a * &inverse * &a;
            p = (&next + next.transpose()) * 0.5;
        }
        let innovation = &measured * &p * measured.transpose() + readout;
        let gain = &transition * &p * measured.transpose() * innovation.try_inverse()?;
        gain.iter().all(|x| x.is_finite()).then_some(gain)
    }
}

impl Normal {
    /// # Errors
    /// The mission file lacks noise of the thrusters or of the readout.
    pub(crate) fn of(available: &Available, mission: &Mission, by: &'static str) -> Result<Self, PluginError> {
        let by_sensor = |tm: &Body| {
            let readout = latest_column(available, &InputColumn::displacement(tm, Z).name);
            readout.is_some_and(|c| c.attribute("noise").starts_with("is_"))
        };
        let tms: Vec<Body> = Body::all(mission).into_iter().filter(by_sensor).collect();
        if tms.is_empty() {
            return Err(PluginError::error(format!(
                "{by}: no inertial sensor reads a displacement along s_3; remove the effect from the model"
            )));
        }
        let axis = |tm: &Body| {
            let (t, b) = (tm.section.dcm_orf_from_srf(), tm.section.offset_nominal_orf_m());
            // (−α × b)_z = α_y b_x − α_x b_y in ORF.
            let coupled = (0..3).map(|j| (InputColumn::alpha(j), t[(1, j)] * b.x - t[(0, j)] * b.y));
            let known = [(InputColumn::known_accel(tm, Z), 1.0)].into_iter().chain(coupled);
            PredictedAxis {
                readout: InputColumn::displacement(tm, Z),
                known: known.filter(|(_, factor)| *factor != 0.0).collect(),
            }
        };
        let axes = tms.iter().map(axis).collect();
        Ok(Self { noise: AxisNoise::of(mission, &tms, by)?, axes, tms, dt_s: mission.dt_s() })
    }

    /// Index of a test mass.
    ///
    /// # Errors
    /// The inertial sensor does not read it.
    pub(crate) fn place(&self, tm: &Body, by: &'static str) -> Result<usize, PluginError> {
        self.tms.iter().position(|other| other.name == tm.name).ok_or_else(|| {
            PluginError::error(format!(
                "{by}: the inertial sensor does not read {} along s_3; remove the effect from the model",
                tm.name
            ))
        })
    }

    /// The acceleration that the past predicts of a test mass.
    ///
    /// # Errors
    /// The noise has no stationary predictor.
    pub(crate) fn predicted(&self, tm: usize, by: &str) -> Result<PredictedAcceleration, PluginError> {
        let gain = self.noise.gain().ok_or_else(|| {
            PluginError::error(format!(
                "{by}: the mission file's noise of thrusters and readouts along s_3 has no stationary Kalman predictor; give both \
                 tables of noise, or remove the effect from the model"
            ))
        })?;
        let name = format!("predicted({}.accel.z)", self.tms[tm].name);
        Ok(PredictedAcceleration { name, axes: self.axes.clone(), gain, tm, dt_s: self.dt_s })
    }
}

/// Computes a [`PredictedAcceleration`] over the rows of the data.
#[derive(Clone, Debug)]
pub(crate) struct Predictor {
    gain: DMatrix<f64>,
    tm: usize,
    dt_s: f64,
    /// Rows after a start in which the prediction depends on the unknown initial rate and force.
    settling_rows: u64,
    rows: u64,
    /// Predicted displacement and rate times Δt of each test mass; NaN before the first readouts.
    state: Vec<f64>,
    last_ns: Option<i64>,
    /// Change of the predicted displacement over the row before, m.
    last_change_m: f64,
    /// The second difference before this one, m.
    last_difference_m: f64,
}

impl Predictor {
    pub(crate) fn new(series: &PredictedAcceleration) -> Self {
        let axes = series.axes.len();
        // The rate gain of a double integrator is the square of its bandwidth, in samples.
        let slowest = (0..axes).map(|i| series.gain[(2 * i + 1, i)]).fold(f64::INFINITY, f64::min);
        Self {
            gain: series.gain.clone(),
            tm: series.tm,
            dt_s: series.dt_s,
            settling_rows: (SETTLING / slowest.max(f64::MIN_POSITIVE).sqrt()).ceil() as u64,
            rows: 0,
            state: vec![f64::NAN; 2 * axes],
            last_ns: None,
            last_change_m: 0.0,
            last_difference_m: 0.0,
        }
    }

    /// Value of the next row from readouts, m, and known accelerations, m s⁻². It is zero while the predictor settles;
    /// from then on its double integral is the change of the predicted displacement.
    pub(crate) fn next(&mut self, now_ns: i64, readout_m: &[f64], known_m_s2: &[f64]) -> f64 {
        let follows = self.last_ns.is_some_and(|t| ((now_ns - t) as f64 * 1e-9 - self.dt_s).abs() < 0.5 * self.dt_s);
        self.last_ns = Some(now_ns);
        if !follows || self.state.iter().any(|x| !x.is_finite()) {
            (self.rows, self.last_change_m, self.last_difference_m) = (0, 0.0, 0.0);
            for (state, readout) in self.state.chunks_exact_mut(2).zip(readout_m) {
                state.copy_from_slice(&[*readout, 0.0]);
            }
        }
        // A missing readout corrects nothing.
        let innovation = DVector::from_fn(readout_m.len(), |i, _| {
            let e = readout_m[i] - self.state[2 * i];
            if e.is_finite() { e } else { 0.0 }
        });
        let correction = &self.gain * innovation;
        let before = self.state[2 * self.tm];
        for (i, known) in known_m_s2.iter().enumerate() {
            let (push, v) = (known * self.dt_s * self.dt_s, self.state[2 * i + 1]);
            self.state[2 * i] += v + 0.5 * push + correction[2 * i];
            self.state[2 * i + 1] += push + correction[2 * i + 1];
        }
        let change = self.state[2 * self.tm] - before;
        self.rows += 1;
        if self.rows < self.settling_rows && change.is_finite() {
            return 0.0;
        }
        let difference = change - self.last_change_m;
        // This extrapolation undoes the estimators' average of two samples up to a second difference.
        let value = (1.5 * difference - 0.5 * self.last_difference_m) / (self.dt_s * self.dt_s);
        (self.last_change_m, self.last_difference_m) = (change, difference);
        value
    }

    pub(crate) fn save_or_load(&mut self, state: &mut State<'_>) -> Result<(), PluginError> {
        state.f64s(&mut self.state)?;
        state.u64(&mut self.rows)?;
        state.option(&mut self.last_ns, State::i64)?;
        state.f64(&mut self.last_change_m)?;
        Ok(state.f64(&mut self.last_difference_m)?)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use dragfree_physics::process::normal;
    use rand::SeedableRng;
    use rand_xoshiro::Xoshiro256PlusPlus;

    const DT_S: f64 = 0.1;

    /// Displacement and rate gain of the α-β filter of one target with random acceleration, predicted by one sample:
    /// Kalata, IEEE Trans. Aerosp. Electron. Syst. 20, 174 (1984), with his tracking index.
    fn kalata(index: f64) -> [f64; 2] {
        let r = 0.25 * (4.0 + index - (8.0 * index + index * index).sqrt());
        let alpha = 1.0 - r * r;
        let beta = 2.0 * (2.0 - alpha) - 4.0 * (1.0 - alpha).sqrt();
        [alpha + beta, beta]
    }

    /// Noise of `n` readouts with σ = 1 m of test masses that one acceleration moves, and of each one's own.
    fn noise(n: usize, common_m: f64, own_m: f64) -> AxisNoise {
        let one = DMatrix::from_element(n, n, common_m * common_m);
        let own = DMatrix::identity(n, n) * (own_m * own_m);
        AxisNoise { acceleration_m2: one + own, readout_m2: DVector::from_element(n, 1.0) }
    }

    #[test]
    fn the_gain_of_one_test_mass_is_that_of_an_alpha_beta_filter() {
        for index in [1e-4, 1e-2, 0.3] {
            let gain = noise(1, index, 0.0).gain().unwrap();
            for (got, want) in gain.iter().zip(kalata(index)) {
                assert!((got / want - 1.0).abs() < 1e-6, "{index}: {got} against {want}");
            }
        }
    }

    /// The mean of two readouts has half the variance: the tracking index is √2 times as large.
    #[test]
    fn two_test_masses_show_a_common_acceleration_together() {
        let gain = noise(2, 1e-3, 1e-6).gain().unwrap();
        let want = kalata(1e-3 * 2.0f64.sqrt());
        for row in 0..4 {
            let both = gain[(row, 0)] + gain[(row, 1)];
            assert!((both / want[row % 2] - 1.0).abs() < 1e-3, "{both} against {}", want[row % 2]);
        }
    }

    fn series(noise: &AxisNoise, tm: usize) -> PredictedAcceleration {
        let column = || InputColumn { name: String::new(), unit: "", frame: String::new() };
        let axis = || PredictedAxis { readout: column(), known: Vec::new() };
        let axes = (0..noise.readout_m2.len()).map(|_| axis()).collect();
        PredictedAcceleration { name: String::new(), axes, gain: noise.gain().unwrap(), tm, dt_s: DT_S }
    }

    /// Two test masses under one white acceleration, held by a controller that sees their readouts, of which the first
    /// shows `1 + scale`. Regression of the readouts' difference on a displacement: the predicted one, integrated from
    /// the series, and the readout itself.
    fn regressed(scale: f64, seed: u64) -> [f64; 2] {
        const ROWS: usize = 60_000;
        let model = noise(2, 2e-3, 1e-6);
        let mut predictor = Predictor::new(&series(&model, 0));
        let mut rng = Xoshiro256PlusPlus::seed_from_u64(seed);
        let (mut r, mut v, mut command) = (0.0f64, 0.0f64, 0.0);
        // The series before, and the integrated displacement at this row and the one before.
        let (mut last, mut predicted, mut before) = (0.0, 0.0, 0.0);
        let mut sums = [[0.0; 5]; 2];
        for row in 0..ROWS {
            let shown = [(1.0 + scale) * r + normal(&mut rng), r + normal(&mut rng)];
            if row > 5000 {
                for (sum, x) in sums.iter_mut().zip([predicted, shown[0]]) {
                    let y = shown[0] - shown[1];
                    for (sum, term) in sum.iter_mut().zip([1.0, x, y, x * x, x * y]) {
                        *sum += term;
                    }
                }
            }
            let known = command / (DT_S * DT_S);
            let value = predictor.next(row as i64 * 100_000_000, &shown, &[known; 2]);
            let next = 2.0 * predicted - before + 0.5 * (value + last) * DT_S * DT_S;
            (before, predicted, last) = (predicted, next, value);
            let push = command + 2e-3 * normal(&mut rng);
            r += v + 0.5 * push;
            v += push;
            // Acts in the next sample. The rate is the predictor's, as a controller's would be.
            let (r_hat, v_hat) = (predictor.state[2], predictor.state[3]);
            command = -1e-3 * r_hat - 0.05 * v_hat;
        }
        sums.map(|[n, x, y, xx, xy]| (xy - x * y / n) / (xx - x * x / n))
    }

    /// σ of the slope is √2/(√55,000 σ_x) with σ_x near 1: 0.006, and the mean of sixteen is within 4σ of the truth
    /// (false alarm 6e-5). A regressor with the readout's own noise is off by more than ten times that bound.
    #[test]
    fn a_scale_along_an_axis_without_interferometer_is_unbiased() {
        for scale in [0.0, 0.02] {
            let slopes: Vec<[f64; 2]> = (1..=16).map(|seed| regressed(scale, seed)).collect();
            let mean = |i: usize| slopes.iter().map(|s| s[i]).sum::<f64>() / 16.0;
            let scatter = (slopes.iter().map(|s| (s[0] - mean(0)).powi(2)).sum::<f64>() / 15.0).sqrt();
            assert!(scatter < 0.02, "{scatter}");
            assert!((mean(0) - scale).abs() < 4.0 * scatter / 4.0, "{scale}: {} ± {}", mean(0), scatter / 4.0);
            assert!((mean(1) - scale).abs() > 40.0 * scatter / 4.0, "{scale}: {}", mean(1));
        }
    }

    #[test]
    fn a_gap_starts_the_prediction_again() {
        let model = noise(1, 0.3, 0.0);
        let mut predictor = Predictor::new(&series(&model, 0));
        let settled = |p: &mut Predictor, first: i64| {
            (0..200).find(|k| p.next((first + k) * 100_000_000, &[(*k as f64).sin()], &[0.0]) != 0.0)
        };
        let rows = settled(&mut predictor, 0);
        assert!(rows.is_some_and(|rows| rows > 10), "{rows:?}");
        assert_eq!(settled(&mut predictor, 1000), rows);
        // An unknown acceleration makes its row unknown, and the next readout starts the prediction again.
        assert!(predictor.next(200_000_000_000, &[0.0], &[f64::NAN]).is_nan());
        assert_eq!(predictor.next(200_100_000_000, &[0.0], &[0.0]), 0.0);
        assert!(predictor.state.iter().all(|x| x.is_finite()));
    }
}
