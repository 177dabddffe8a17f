//! Fixed-lag disturbance smoother: the angular acceleration given all wavefront sensing and all commands.
//!
//! The attitude obeys `θ̈ = α_known + β + w` with white `w` (thrusters), constant over a sample, and a slow random walk
//! `β` (unmodelled torque). Per principal axis a Kalman filter runs on `x = [θ, ω, β]`, and the adjoint recursion of
//! Koopman's disturbance smoother (Biometrika 80, 1993; Durbin & Koopman, sections 4.4 and 4.5) runs backward over a
//! fixed lag. The result `E[β + w | data]` is an unbiased regressor. Commands add no information, as they are functions
//! of past readouts.
//!
//! The principal axes are the eigenvectors of the symmetric `J⁻¹ S_M J⁻ᵀ`; sensing is equal about all axes, so the
//! three axes decouple exactly.
//!
//! Coloured sensing noise needs no additional states. Terms of exponent 4 and 2 are white noise integrated twice and
//! once, so `z = θ + n` is a double integrator with more noise. The filter runs on `z` and its rate, and the adjoint
//! recursion separates `w` from `n` by their increments. Without leakage this is the exact posterior.

use dragfree_physics::noise::NoiseShape;
use dragfree_sdk::state::{State, StateError};
use nalgebra::{Matrix3, Vector3};
use std::f64::consts::TAU;

/// Frequency at which the spectrum of `β` equals the white one. It is far below the frequency at which the smoother
/// relies on commands, so `β` matters only at the ends of a record, where it absorbs a constant torque.
const DRIFT_CORNER_HZ: f64 = 1e-4;
/// Prior standard deviations of attitude (rad), rate (rad/s) and `β` (rad/s²), far wider than in science mode.
const PRIOR: [f64; 3] = [1e-2, 1e-4, 1e-6];
/// Lag in time constants of the filter; the neglected part of `w` is `e⁻²⁰`.
const LAG_TIME_CONSTANTS: f64 = 20.0;
/// Longest lag, s, which bounds memory when sensing is very noisy: 40 MB at 10 Hz.
const MAX_LAG_S: f64 = 3600.0;

/// Largest prediction variance, relative to that of a readout, for which an innovation enters the noise statistics. It
/// excludes the time after a missing command.
const MAX_PREDICTED_VARIANCE: f64 = 1e3;

/// Three numbers, one for each principal axis.
type Axes = [f64; 3];

/// The model of one spacecraft, in its principal axes.
#[derive(Clone, Debug)]
pub struct Model {
    dt_s: f64,
    /// Columns are the principal axes in SRF.
    srf_from_principal: Matrix3<f64>,
    /// Variance of a sample's mean disturbance, rad² s⁻⁴.
    disturbance_variance: Axes,
    /// Variance of the step of `β` from one sample to the next, rad² s⁻⁴.
    drift_variance: Axes,
    /// Variance of the white part of a readout, rad².
    readout_variance: f64,
    /// Covariance per sample of coloured readout noise in `z` and its rate, `zz`, `zω`, `ωω`; rad², rad² s⁻¹, rad² s⁻².
    coloured_noise: [f64; 3],
    /// Time constant of the filter, samples.
    memory: f64,
    lag: usize,
}

impl Model {
    /// Builds the model from the one-sided PSD of the angular acceleration by the torque noise, `J⁻¹ S_M J⁻ᵀ` (SRF,
    /// rad² s⁻⁴/Hz), the noise of the attitude readout per axis (rad), and the sample interval. Of the readout's terms
    /// those of exponent 0, 2 and 4 are in the model.
    pub fn new(disturbance_psd: &Matrix3<f64>, readout: &NoiseShape, dt_s: f64) -> Self {
        let eigen = disturbance_psd.symmetric_eigen();
        // A one-sided PSD S, sampled at f_s, has the variance S f_s/2.
        let per_sample = 0.5 / dt_s;
        let disturbance_psd: Axes = std::array::from_fn(|i| eigen.eigenvalues[i]);
        let drift_step = TAU * DRIFT_CORNER_HZ * dt_s;
        // S_2 and S_4 of the coloured part's one-sided PSD, S_2/ω² + S_4/ω⁴; its driving noises have half of them.
        let coefficient = |exponent: u32| -> f64 {
            let terms = readout.coloured().filter(|t| t.exponent == exponent);
            terms.map(|t| t.asd.powi(2) * (TAU * t.corner_hz).powi(exponent.cast_signed())).sum()
        };
        let (s2, s4) = (coefficient(2), coefficient(4));
        let slowest = disturbance_psd.iter().copied().fold(f64::INFINITY, f64::min);
        let decay = decay_rad_s(s2 / readout.white_psd(), (slowest + s4) / readout.white_psd());
        // If sensing is very accurate the filter has no memory, but the smoother still needs a few samples.
        let lag = (LAG_TIME_CONSTANTS / (decay * dt_s)).max(16.0).min((MAX_LAG_S / dt_s).max(16.0));
        Self {
            dt_s,
            srf_from_principal: eigen.eigenvectors,
            disturbance_variance: disturbance_psd.map(|s| s * per_sample),
            drift_variance: disturbance_psd.map(|s| s * per_sample * drift_step * drift_step),
            readout_variance: readout.white_psd() * per_sample,
            coloured_noise: [0.5 * (s2 * dt_s + s4 * dt_s.powi(3) / 3.0), 0.25 * s4 * dt_s.powi(2), 0.5 * s4 * dt_s],
            memory: 1.0 / (decay * dt_s),
            lag: lag.ceil() as usize,
        }
    }

    /// Time constant of the filter, samples; readouts within it carry the information on `w`.
    pub fn memory(&self) -> f64 {
        self.memory
    }

    /// Lag of the smoother, samples.
    pub fn lag(&self) -> usize {
        self.lag
    }
}

/// Decay of the slowest pole of the filter, rad/s: the roots of `1 + a/ω² + b/ω⁴`, `s⁴ − a s² + b`, in the left half
/// plane.
fn decay_rad_s(a: f64, b: f64) -> f64 {
    let discriminant = 0.25 * a * a - b;
    if discriminant < 0.0 { (0.5 * b.sqrt() + 0.25 * a).sqrt() } else { (b / (0.5 * a + discriminant.sqrt())).sqrt() }
}

/// One-sided PSD at `frequency_hz` of the error of the smoothed angular acceleration about one principal axis, averaged
/// over two samples as by a second difference, `(e_{k−1} + e_k)/2`; rad² s⁻⁴/Hz.
///
/// `R = S_w − W S_w`, `W = S_w/(S_w + g S_n)`, with `S_w = cos²(πfΔt) disturbance_psd`, `g = (2 sin(πfΔt)/Δt)⁴`. In
/// SRF the same holds with matrices, `S_w = cos² J⁻¹ S_M J⁻ᵀ` and `W = S_w (S_w + g S_n 1)⁻¹`.
pub fn residual_psd(frequency_hz: f64, disturbance_psd: f64, readout_psd: f64, dt_s: f64) -> f64 {
    let (s, c) = (0.5 * TAU * frequency_hz * dt_s).sin_cos();
    let disturbance = c * c * disturbance_psd;
    let readout = (2.0 * s / dt_s).powi(4) * readout_psd;
    disturbance * readout / (disturbance + readout)
}

/// Smoothed quantities of one epoch, SRF.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Smoothed {
    /// `E[β + w]`, mean over `[t_k, t_{k+1})`, rad s⁻².
    pub disturbance_rad_s2: Vector3<f64>,
    /// Its part `E[w]`, by thruster noise.
    pub noise_rad_s2: Vector3<f64>,
    /// `E[ω]` relative to CRF at `t_k`, rad s⁻¹, including the rate of the coloured sensing noise.
    pub omega_crf_rad_s: Vector3<f64>,
}

/// Quantities of one epoch for the backward recursion, for three axes.
#[derive(Clone, Copy, Debug, Default)]
struct Step {
    /// Predicted ω and β.
    predicted: [Axes; 2],
    /// Rows ω and β of the predicted covariance: ωθ, ωω, ωβ, βθ, ββ.
    covariance: [Axes; 5],
    /// Gain `K` of the update.
    gain: [Axes; 3],
    /// Innovation over its variance; zero, as the gain, without a readout.
    weighted_innovation: Axes,
    /// Variance of the mean disturbance over the sample that follows, rad² s⁻⁴.
    disturbance_variance: Axes,
    /// Whether attitude and rate are reset after this epoch because the command is unknown.
    reset: bool,
}

/// Output of the filter at one epoch.
#[derive(Clone, Copy, Debug)]
struct Filtered {
    /// Predicted ω and β.
    predicted: [Axes; 2],
    /// Innovation over its variance; zero without a readout.
    weighted_innovation: Axes,
}

/// An additional angular acceleration over one interval, SRF.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Perturbation {
    /// Held over `[t_k, t_{k+1})`, rad s⁻².
    pub held_rad_s2: Vector3<f64>,
    /// Step of the angular velocity at `t_k`, rad s⁻¹.
    pub kick_rad_s: Vector3<f64>,
}

/// State of [`Smoother::response`]: predicted θ, ω, β at the oldest waiting epoch.
#[derive(Clone, Debug, Default)]
pub struct ResponseState {
    mean: [Axes; 3],
}

impl ResponseState {
    pub(crate) fn visit(&mut self, state: &mut State<'_>) -> Result<(), StateError> {
        state.f64s(self.mean.as_flattened_mut())
    }
}

/// Score test for the gain of the known accelerations.
///
/// Innovations are uncorrelated with all earlier commands, whatever the control law. A command that did not act as
/// stated appears in the innovations as the filter's response to it. The products are martingale differences, so their
/// sum over the root of their sum of squares is a standard normal deviate.
#[derive(Clone, Debug, Default)]
struct CommandConsistency {
    /// Change of predicted θ, ω, β per unit of relative gain error.
    response: [Axes; 3],
    products: Axes,
    squares: Axes,
}

impl CommandConsistency {
    fn update(&mut self, axis: usize, innovation: f64, gain: [f64; 3], informed: bool) {
        let theta = self.response[0][axis];
        for (state, k) in gain.into_iter().enumerate() {
            self.response[state][axis] -= k * theta;
        }
        if informed {
            let product = innovation * theta;
            self.products[axis] += product;
            self.squares[axis] += product * product;
        }
    }

    fn advance(&mut self, axis: usize, known: f64, dt: f64) {
        let accel = self.response[2][axis] + known;
        self.response[0][axis] += dt * self.response[1][axis] + 0.5 * dt * dt * accel;
        self.response[1][axis] += dt * accel;
    }
}

/// The smoother. Call [`Self::update`] and then [`Self::advance`] for each epoch.
#[derive(Clone, Debug)]
pub struct Smoother {
    model: Model,
    /// θ, ω, β.
    mean: [Axes; 3],
    /// θθ, θω, θβ, ωω, ωβ, ββ.
    covariance: [Axes; 6],
    steps: Vec<Step>,
    innovation_squares: Axes,
    innovations: u64,
    command_consistency: CommandConsistency,
}

impl Smoother {
    /// Starts from the prior.
    pub fn new(model: Model) -> Self {
        let [theta, omega, beta] = PRIOR.map(|sigma| [sigma * sigma; 3]);
        let zero = [0.0; 3];
        Self {
            model,
            mean: [zero; 3],
            covariance: [theta, zero, zero, omega, zero, beta],
            steps: Vec::new(),
            innovation_squares: zero,
            innovations: 0,
            command_consistency: CommandConsistency::default(),
        }
    }

    /// From now on the levels of noise are those of another model. Principal axes and lag stay: those of the other
    /// model turn by the part of the torque noise that is common to two axes.
    pub fn set_levels(&mut self, other: &Model) {
        let turn = self.model.srf_from_principal.tr_mul(&other.srf_from_principal);
        let along = |variance: &Axes| {
            let turned = turn * Matrix3::from_diagonal(&Vector3::from(*variance)) * turn.transpose();
            std::array::from_fn(|i| turned[(i, i)])
        };
        self.model.disturbance_variance = along(&other.disturbance_variance);
        self.model.drift_variance = along(&other.drift_variance);
        self.model.readout_variance = other.readout_variance;
        self.model.coloured_noise = other.coloured_noise;
    }

    /// The model.
    pub fn model(&self) -> &Model {
        &self.model
    }

    /// Updates with the attitude relative to CRF at `t_k` (SRF, rad), `None` if missing, and returns the filtered ω
    /// relative to CRF (SRF, rad s⁻¹).
    pub fn update(&mut self, attitude_rad: Option<&Vector3<f64>>) -> Vector3<f64> {
        let [p00, p01, p02, p11, p12, p22] = self.covariance;
        let mut step =
            Step { predicted: [self.mean[1], self.mean[2]], covariance: [p01, p11, p12, p02, p22], ..Step::default() };
        if let Some(attitude) = attitude_rad {
            let y = self.model.srf_from_principal.tr_mul(attitude);
            let noise = self.model.readout_variance;
            let informed = p00.iter().all(|p| *p < MAX_PREDICTED_VARIANCE * noise);
            for i in 0..3 {
                let variance = p00[i] + noise;
                let innovation = y[i] - self.mean[0][i];
                let gain = [p00[i] / variance, p01[i] / variance, p02[i] / variance];
                for (state, k) in gain.into_iter().enumerate() {
                    self.mean[state][i] += k * innovation;
                    step.gain[state][i] = k;
                }
                step.weighted_innovation[i] = innovation / variance;
                // The first row as noise times gain avoids cancellation after a wide prior.
                self.covariance[0][i] = noise * gain[0];
                self.covariance[1][i] = noise * gain[1];
                self.covariance[2][i] = noise * gain[2];
                self.covariance[3][i] = p11[i] - gain[1] * p01[i];
                self.covariance[4][i] = p12[i] - gain[1] * p02[i];
                self.covariance[5][i] = p22[i] - gain[2] * p02[i];
                self.command_consistency.update(i, innovation, gain, informed);
                if informed {
                    self.innovation_squares[i] += innovation * step.weighted_innovation[i];
                }
            }
            self.innovations += u64::from(informed);
        }
        self.steps.push(step);
        self.model.srf_from_principal * Vector3::from(self.mean[1])
    }

    /// Predicts to `t_{k+1}` with the known part of `θ̈` over `[t_k, t_{k+1})` (SRF, rad s⁻²); `None` if the command
    /// is unknown, which resets attitude and rate to the prior.
    pub fn advance(&mut self, known_rad_s2: Option<&Vector3<f64>>) {
        let (dt, half) = (self.model.dt_s, 0.5 * self.model.dt_s * self.model.dt_s);
        let [zz, zw, ww] = self.model.coloured_noise;
        let [p00, p01, p02, p11, p12, p22] = self.covariance;
        if let Some(step) = self.steps.last_mut() {
            step.disturbance_variance = self.model.disturbance_variance;
            step.reset = known_rad_s2.is_none();
        }
        let Some(known) = known_rad_s2 else {
            self.command_consistency.response = Default::default();
            let zero = [0.0; 3];
            let drifted = std::array::from_fn(|i| p22[i] + self.model.drift_variance[i]);
            self.mean = [zero, zero, self.mean[2]];
            self.covariance = [[PRIOR[0].powi(2); 3], zero, zero, [PRIOR[1].powi(2); 3], zero, drifted];
            return;
        };
        let known = self.model.srf_from_principal.tr_mul(known);
        for i in 0..3 {
            self.command_consistency.advance(i, known[i], dt);
            let accel = self.mean[2][i] + known[i];
            self.mean[0][i] += dt * self.mean[1][i] + half * accel;
            self.mean[1][i] += dt * accel;
            let q = self.model.disturbance_variance[i];
            let theta_theta = p00[i] + dt * p01[i] + half * p02[i];
            let theta_omega = p01[i] + dt * p11[i] + half * p12[i];
            let theta_beta = p02[i] + dt * p12[i] + half * p22[i];
            let omega_omega = p11[i] + dt * p12[i];
            let omega_beta = p12[i] + dt * p22[i];
            self.covariance[0][i] = theta_theta + dt * theta_omega + half * theta_beta + (q * half * half + zz);
            self.covariance[1][i] = theta_omega + dt * theta_beta + (q * half * dt + zw);
            self.covariance[2][i] = theta_beta;
            self.covariance[3][i] = omega_omega + dt * omega_beta + (q * dt * dt + ww);
            self.covariance[4][i] = omega_beta;
            self.covariance[5][i] = p22[i] + self.model.drift_variance[i];
        }
    }

    /// Number of epochs that wait for later data. [`Self::smooth`] the first half whenever it reaches twice the lag:
    /// blocks then count from the first epoch, so results do not depend on batches.
    pub fn waiting(&self) -> usize {
        self.steps.len()
    }

    /// Smooths and removes the `count` oldest waiting epochs.
    pub fn smooth(&mut self, count: usize) -> Vec<Smoothed> {
        let out = self.smoothed(count);
        self.release(count);
        out
    }

    /// Smoothed values of the `count` oldest waiting epochs, given all data so far.
    pub fn smoothed(&self, count: usize) -> Vec<Smoothed> {
        self.backward(count, |k| {
            let step = &self.steps[k];
            Filtered { predicted: step.predicted, weighted_innovation: step.weighted_innovation }
        })
    }

    /// Removes the `count` oldest waiting epochs.
    pub fn release(&mut self, count: usize) {
        self.steps.drain(..count.min(self.steps.len()));
    }

    /// Change of [`Self::smoothed`] for the `count` oldest waiting epochs due to an additional known acceleration,
    /// `perturbation(k)` for waiting epoch `k`. `state` advances by `count` epochs from the oldest waiting one.
    ///
    /// The smoother is linear, and its gains depend only on which epochs have data, so this is its response to that
    /// acceleration with zero attitude.
    pub fn response(
        &self,
        state: &mut ResponseState,
        count: usize,
        perturbation: impl Fn(usize) -> Perturbation,
    ) -> Vec<Smoothed> {
        let (dt, half) = (self.model.dt_s, 0.5 * self.model.dt_s * self.model.dt_s);
        let principal = |v: &Vector3<f64>| self.model.srf_from_principal.tr_mul(v);
        let mut mean = state.mean;
        let mut filtered = Vec::with_capacity(self.steps.len());
        for (k, step) in self.steps.iter().enumerate() {
            if k == count {
                state.mean = mean;
            }
            let mut now = Filtered { predicted: [mean[1], mean[2]], weighted_innovation: [0.0; 3] };
            let added = perturbation(k);
            let (kick, held) = (principal(&added.kick_rad_s), principal(&added.held_rad_s2));
            for i in 0..3 {
                let (theta, gain) = (mean[0][i], step.gain.map(|k| k[i]));
                // The innovation, −θ, over its variance F, from K_ω = P_ωθ/F. P_ωθ is zero only after a start, as is θ.
                let omega_theta = step.covariance[0][i];
                if omega_theta != 0.0 {
                    now.weighted_innovation[i] = -theta * (gain[1] / omega_theta);
                }
                for (state, k) in gain.into_iter().enumerate() {
                    mean[state][i] -= k * theta;
                }
                let accel = mean[2][i] + held[i];
                let omega = mean[1][i] + kick[i];
                mean[0][i] += dt * omega + half * accel;
                mean[1][i] = omega + dt * accel;
            }
            if step.reset {
                mean = [[0.0; 3], [0.0; 3], mean[2]];
            }
            filtered.push(now);
        }
        if count >= self.steps.len() {
            state.mean = mean;
        }
        self.backward(count, |k| filtered[k])
    }

    /// Adjoint recursion over all waiting epochs; returns the `count` oldest.
    fn backward(&self, count: usize, filtered: impl Fn(usize) -> Filtered) -> Vec<Smoothed> {
        let (dt, half) = (self.model.dt_s, 0.5 * self.model.dt_s * self.model.dt_s);
        let count = count.min(self.steps.len());
        let srf = |v: Axes| self.model.srf_from_principal * Vector3::from(v);
        let zero = Vector3::zeros();
        let mut out = vec![Smoothed { disturbance_rad_s2: zero, noise_rad_s2: zero, omega_crf_rad_s: zero }; count];
        let mut adjoint = [[0.0; 3]; 3];
        for (k, step) in self.steps.iter().enumerate().rev() {
            let Filtered { predicted, weighted_innovation } = filtered(k);
            let mut noise = [0.0; 3];
            for i in 0..3 {
                let [r0, r1, r2] = [adjoint[0][i], adjoint[1][i], adjoint[2][i]];
                let by_accel = half * r0 + dt * r1;
                noise[i] = step.disturbance_variance[i] * by_accel;
                // s = Aᵀ r, then r ← s − Hᵀ K·s + Hᵀ v/F.
                let [s0, s1, s2] = if step.reset { [0.0, 0.0, r2] } else { [r0, dt * r0 + r1, by_accel + r2] };
                let corrected = step.gain[0][i] * s0 + step.gain[1][i] * s1 + step.gain[2][i] * s2;
                adjoint[0][i] = s0 - corrected + weighted_innovation[i];
                adjoint[1][i] = s1;
                adjoint[2][i] = s2;
            }
            if k < count {
                let [wt, ww, wb, bt, bb] = step.covariance;
                let [s0, s1, s2] = adjoint;
                let beta = |i: usize| predicted[1][i] + bt[i] * s0[i] + wb[i] * s1[i] + bb[i] * s2[i];
                let omega = |i: usize| predicted[0][i] + wt[i] * s0[i] + ww[i] * s1[i] + wb[i] * s2[i];
                out[k] = Smoothed {
                    disturbance_rad_s2: srf(std::array::from_fn(|i| beta(i) + noise[i])),
                    noise_rad_s2: srf(noise),
                    omega_crf_rad_s: srf(std::array::from_fn(omega)),
                };
            }
        }
        out
    }

    /// Normalised innovation squared per principal axis: 1 if torque and sensing noise are as in the mission file.
    /// `None` before any readout.
    pub fn innovation_ratio(&self) -> Option<[f64; 3]> {
        (self.innovations > 0).then(|| self.innovation_squares.map(|s| s / self.innovations as f64))
    }

    /// Score of the gain of the known accelerations per principal axis, a standard normal deviate if they acted as
    /// stated. `None` before enough readouts.
    pub fn inconsistency_sigma(&self) -> Option<[f64; 3]> {
        let test = &self.command_consistency;
        let z = std::array::from_fn(|i| test.products[i] / test.squares[i].sqrt());
        z.iter().all(|z: &f64| z.is_finite()).then_some(z)
    }

    pub(crate) fn visit(&mut self, state: &mut State<'_>) -> Result<(), StateError> {
        let test = &mut self.command_consistency;
        state.f64s(test.response.as_flattened_mut())?;
        state.f64s(test.products.iter_mut().chain(&mut test.squares))?;
        state.f64s(self.mean.as_flattened_mut())?;
        state.f64s(self.covariance.as_flattened_mut())?;
        state.f64s(&mut self.innovation_squares)?;
        state.u64(&mut self.innovations)?;
        state.list(&mut self.steps, |state, step| {
            state.f64s(step.predicted.as_flattened_mut())?;
            state.f64s(step.covariance.as_flattened_mut())?;
            state.f64s(step.gain.as_flattened_mut())?;
            state.f64s(&mut step.weighted_innovation)?;
            state.f64s(&mut step.disturbance_variance)?;
            state.flag(&mut step.reset)
        })?;
        if self.steps.len() > 2 * self.model.lag { Err(StateError::Content("a number of epochs")) } else { Ok(()) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Levels of a model whose principal axes are others: the variance along each axis that stays.
    #[test]
    fn other_levels_are_taken_along_the_axes_that_stay() {
        let sensing = NoiseShape::white(1e-9);
        let psd = |x: f64, xy: f64, yz: f64| Matrix3::new(x, xy, 0.0, xy, 2.0, yz, 0.0, yz, 3.0) * 1e-20;
        let (own, other) = (psd(1.0, 0.3, 0.2), psd(4.0, -0.5, 0.7));
        let mut smoother = Smoother::new(Model::new(&own, &sensing, 0.1));
        let axes = smoother.model.srf_from_principal;
        for (levels, matrix) in [(Model::new(&other, &sensing, 0.1), other), (Model::new(&own, &sensing, 0.1), own)] {
            smoother.set_levels(&levels);
            let along = axes.transpose() * matrix * axes * (0.5 / 0.1);
            for i in 0..3 {
                let found = smoother.model.disturbance_variance[i];
                assert!((found - along[(i, i)]).abs() < 1e-12 * found, "axis {i}: {found} {along}");
            }
        }
    }
}
