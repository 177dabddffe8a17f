//! The design of the controllers when a mission file brings none: one H-infinity problem per channel, from the
//! requirement table and the noise model (eqs W1_weight and W3_weight).
//!
//! **The problem.** After the decoupling a channel is `p̈ = u_d + F_u d`, read out as `p + F_y n`; `B` is what the
//! table allows `p`. With `G` the plant as the computer sees it,
//!
//! ```text
//! [ p/B      ]   [ G S F_u/B    −T F_y/B   ] [ d ]
//! [ W_2 u/.. ] = [ −W_2 T ..    −W_2 S K.. ] [ n ]
//! ```
//!
//! so the first row is `[W_1 S, −W_3 T]` with `W_1 = G F_u/B` and `W_3 = F_y/B`: its norm below one means that
//! independent disturbance and readout noise together keep the table, at every frequency. (The paper prints
//! `W_3 = P F_y/B`; readout noise reaches `p` through `T` alone.) The second row is the control effort, `W_2`.
//! Because the disturbance enters where the control does, the integrators of `G` are reached from `d` and seen in
//! `p/B`; they need no shift off the axis for the Riccati equations, and the controller does not cancel them.
//!
//! **Sampling is exact.** `G` is the double integrator with a hold and the loop's delay, in the variable `w` of
//! `z = (1 + w dt/2)/(1 − w dt/2)`: `G(w) = (1 − w dt/2)/w² · ((1 − w dt/2)/(1 + w dt/2))^delay`. The norm is the same
//! on both sides of that map, so what is proved of the synthesis holds for the sampled loop that flies, up to Nyquist.
//!
//! **Weights** are rational bounds of first order at most ([`Lag`]), never below the mission's own functions of
//! frequency, and flat below about 3 mHz, so that the controller forgets its past within the hour that a replay has to
//! settle. Units of time and amplitude are scaled by the expected bandwidth and by `B`.

use nalgebra::{Complex, DMatrix, Matrix3, RowVector3, Vector3};
use std::collections::BTreeMap;
use std::f64::consts::{PI, TAU};

use crate::hinf::{GeneralizedPlant, HinfError, Synthesis, bounded_real, norm};
use crate::lti::{LtiError, StateSpace, sections_response};
use crate::mission::{ANGLES, AXES, ChannelController, Mission, MissionError, SPACECRAFT};
use crate::noise::{NoiseShape, NoiseTerm};
use crate::schur::eigenvalues;

type C64 = Complex<f64>;

const NEEDED_BY: &str = "the control design";

/// The table's band, Hz.
const BAND_HZ: (f64, f64) = (1e-4, 1.0);
/// Below this frequency an unattainable requirement is reported and does not fail the design, Hz.
const RELAXED_BELOW_HZ: f64 = 1e-3;
/// Largest share of a requirement that readout noise may take in the weight `W_3`; `T` is never exactly 1.
const LARGEST_SHARE: f64 = 0.9;
/// Poles of the weights, rad/s. The controller's slowest pole is about half of it, and forgets within an hour.
const WEIGHT_POLE_RAD_S: f64 = 2e-2;
/// A weight whose largest value is below this is constant, which saves a slow state.
const LARGEST_FLAT: f64 = 0.7;
/// Smallest ratio of `W_3` at high frequency to its value at low frequency; it bounds the peak of `T`.
const LEAST_FALL: f64 = 0.6;
/// Ratios of disturbance over requirement to the square of the expected bandwidth, tried in turn. A well damped loop
/// needs about a tenth; a smaller ratio gives a faster loop.
const HEADROOM: [f64; 3] = [1.0 / 12.0, 1.0 / 24.0, 1.0 / 48.0];
/// γ below which no further headroom is tried.
const GOOD_GAMMA: f64 = 0.96;
/// Smallest expected bandwidth, rad/s, for channels with little disturbance.
const SLOWEST_RAD_S: f64 = 2e-2;
/// Largest product of bandwidth and delay (half a hold and the loop's samples).
const LARGEST_DELAY_ANGLE: f64 = 0.5;
/// Largest number of states for the delay in the synthesis; a longer delay is an all-pass of this order.
const MOST_DELAY_STATES: u32 = 3;
/// Bounds `min(factor γ, γ^exponent)` above the optimal γ at which the central controller is taken. At the optimum the
/// controller is ill-conditioned. If the norm of the sampled loop exceeds that of the synthesis, because roots are too
/// close to each other, the next bound is tried; each is below one if γ is.
const BACK_OFF: [(f64, f64); 4] = [(1.1, 0.5), (1.2, 0.25), (1.5, 0.1), (2.0, 0.05)];
/// Accepted ratio of the norm of the sampled loop to that of the synthesis.
const SAMPLED_AS_PROVED: f64 = 1.01;
/// Relative tolerance of γ.
const GAMMA_TOLERANCE: f64 = 1e-5;
/// Ratio of a certificate's bound to the norm.
const CERTIFICATE_MARGIN: f64 = 1.001;
/// Remaining part of the initial state that defines `forget_time_s`.
const FORGOTTEN: f64 = 1e-9;
/// Points of the frequency grids.
const GRID: usize = 3000;

/// Why a mission has no design: which channel, which weight, where, and what to change.
#[expect(missing_docs, reason = "the messages name the fields")]
#[derive(Debug, thiserror::Error)]
pub enum DesignError {
    /// The mission file lacks something.
    #[error(transparent)]
    Mission(#[from] MissionError),
    /// Readout noise alone exceeds the requirement where the disturbance has to be suppressed.
    #[error(
        "control design, channel {channel}: requirement {requirement} is too greedy at {frequency_hz:.3e} Hz: \
         1/|W1|² + 1/|W3|² < 1 there, since the readout's noise alone is {noise_ratio:.3} times the requirement and the \
         disturbance without control {disturbance_ratio:.3e} times; the best that any controller gives is \
         {best_ratio:.3} times. Relax the requirement or choose a quieter readout"
    )]
    OutOfReach {
        channel: String,
        requirement: &'static str,
        frequency_hz: f64,
        noise_ratio: f64,
        disturbance_ratio: f64,
        best_ratio: f64,
    },
    /// The γ-iteration ends above one.
    #[error(
        "control design, channel {channel}: weight {weight} is too greedy at {frequency_hz:.3e} Hz: the best γ is \
         {gamma:.3}, above 1 (requirement {requirement}, loop of {loop_delay_s} s delay). Relax the requirement, \
         reduce noise or disturbance, or sample faster"
    )]
    TooGreedy {
        channel: String,
        weight: &'static str,
        frequency_hz: f64,
        gamma: f64,
        requirement: &'static str,
        loop_delay_s: f64,
    },
    /// The synthesis itself failed.
    #[error("control design, channel {channel}: {source}")]
    Synthesis { channel: String, source: HinfError },
    /// The sampled loop exceeds a bound of the design.
    #[error(
        "control design, channel {channel}: the sampled loop breaks its bound at {frequency_hz:.3e} Hz, {what} = \
         {value:.4}; a shorter delay or a faster sample rate helps"
    )]
    NotKept { channel: String, what: &'static str, frequency_hz: f64, value: f64 },
}

impl From<DesignError> for MissionError {
    fn from(error: DesignError) -> Self {
        match error {
            DesignError::Mission(error) => error,
            other => Self::Design(Box::new(other)),
        }
    }
}

/// A weight of at most first order, `|W|² = (high² ω² + low² p²)/(ω² + p²)`: `low` far below its pole, `high` above.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Lag {
    /// Magnitude at low frequency.
    pub low: f64,
    /// Magnitude at high frequency; equal to `low` for a constant.
    pub high: f64,
    /// Pole, rad/s.
    pub pole_rad_s: f64,
}

impl Lag {
    /// A constant.
    pub fn flat(value: f64) -> Self {
        Self { low: value, high: value, pole_rad_s: WEIGHT_POLE_RAD_S }
    }

    /// A small lag above the given points (frequency in rad/s, magnitude), its `high` no less than `least_high` of its
    /// `low`. Lifting `low` by some per cent over the largest point lets the fall begin; the least `low · high` is
    /// kept.
    fn above(points: &[(f64, f64)], least_high: impl Fn(f64) -> f64) -> Self {
        let largest = points.iter().map(|p| p.1).fold(0.0, f64::max);
        let p = WEIGHT_POLE_RAD_S;
        let candidate = |lift: usize| {
            let low = largest * (1.0 + 0.0025 * lift as f64);
            let needed = |(w, m): &(f64, f64)| (m * m * (w * w + p * p) - low * low * p * p) / (w * w);
            let high = points.iter().map(needed).fold(0.0, f64::max).sqrt().max(least_high(low));
            Self { low, high, pole_rad_s: p }
        };
        let best = (0..20).map(candidate).min_by(|a, b| (a.low * a.high).total_cmp(&(b.low * b.high)));
        let flat = Self::flat(largest.max(least_high(largest)));
        // A fall of less than a tenth does not justify a state.
        best.filter(|lag| largest >= LARGEST_FLAT && lag.high < LARGEST_SHARE * lag.low).unwrap_or(flat)
    }

    /// Magnitude at a frequency in rad/s.
    pub fn magnitude(&self, omega: f64) -> f64 {
        let p = self.pole_rad_s;
        // `hypot` does not overflow.
        (self.high * omega).hypot(self.low * p) / omega.hypot(p)
    }

    fn is_flat(&self) -> bool {
        self.low == self.high
    }

    /// `W(s)/high` in units of time of `1/bandwidth`.
    fn system(&self, bandwidth: f64) -> StateSpace {
        if self.is_flat() {
            return StateSpace::gain(DMatrix::from_element(1, 1, 1.0));
        }
        let p = self.pole_rad_s / bandwidth;
        StateSpace::quotient(&[1.0, p * self.low / self.high], &[1.0, p])
    }
}

/// Requirement of a channel.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Requirement {
    /// Key in the mission file.
    pub key: &'static str,
    /// ASD above the corner, m/√Hz or rad/√Hz.
    pub asd: f64,
    /// Corner of `sqrt(1 + (corner/f)⁴)` (`f_s`, `f_r`), Hz; zero without it.
    pub corner_hz: f64,
}

impl Requirement {
    /// Allowed ASD at a frequency, m/√Hz or rad/√Hz.
    pub fn asd_at(&self, f_hz: f64) -> f64 {
        self.asd * (1.0 + (self.corner_hz / f_hz).powi(4)).sqrt()
    }
}

/// Disturbance, readout noise and requirement of one degree of freedom.
#[derive(Clone, Debug, PartialEq)]
pub struct ChannelModel {
    /// Name, one of [`Mission::channels`].
    pub name: String,
    /// `B`.
    pub requirement: Requirement,
    /// `F_u`: acceleration that disturbs the channel, m s⁻² or rad s⁻².
    pub disturbance: NoiseShape,
    /// `F_y`: noise of the readout, m or rad.
    pub readout: NoiseShape,
    /// Bandwidth relative to what the requirement needs.
    pub bandwidth_factor: f64,
}

impl ChannelModel {
    /// `F_u/B` at a frequency, s⁻².
    fn disturbance_ratio(&self, f_hz: f64) -> f64 {
        self.disturbance.psd(f_hz).sqrt() / self.requirement.asd_at(f_hz)
    }

    /// `F_y/B` at a frequency: `W_3` before it is bounded by a rational function.
    fn readout_ratio(&self, f_hz: f64) -> f64 {
        self.readout.psd(f_hz).sqrt() / self.requirement.asd_at(f_hz)
    }
}

/// How the loop is sampled.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Sampling {
    dt_s: f64,
    delay_samples: u32,
}

impl Sampling {
    fn of(mission: &Mission) -> Self {
        Self { dt_s: mission.dt_s(), delay_samples: mission.control.as_ref().map_or(1, |c| c.delay_samples) }
    }

    /// Half a hold and the delay, s.
    fn delay_s(self) -> f64 {
        (0.5 + f64::from(self.delay_samples)) * self.dt_s
    }

    fn nyquist_hz(self) -> f64 {
        0.5 / self.dt_s
    }

    fn z(self, f_hz: f64) -> C64 {
        C64::from_polar(1.0, TAU * f_hz * self.dt_s)
    }

    /// Frequency in the variable `w` of a frequency of the sampled loop, rad/s.
    fn warped(self, f_hz: f64) -> f64 {
        (PI * f_hz * self.dt_s).tan() * 2.0 / self.dt_s
    }

    /// `G` without delay: position per held acceleration, s².
    fn held_integrators(self, f_hz: f64) -> C64 {
        // (z + 1)/(z − 1)² dt²/2 = (1 − iwdt/2)/(iw)².
        let w = self.warped(f_hz);
        C64::new(-1.0, 0.5 * w * self.dt_s) / (w * w)
    }

    /// From `low_hz` to `high_hz`, evenly in the logarithm, inside the open band up to Nyquist.
    fn grid(self, low_hz: f64, high_hz: f64) -> impl Iterator<Item = f64> {
        let high = high_hz.min(self.nyquist_hz() * (1.0 - 1e-6));
        let ratio = high / low_hz;
        (0..GRID).map(move |i| low_hz * ratio.powf(i as f64 / (GRID - 1) as f64))
    }
}

/// The weights of one channel.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Weights {
    /// Bound of `F_u/B`, s⁻².
    pub disturbance: Lag,
    /// Bound of `F_y/B`.
    pub readout: Lag,
    /// `W_2` over `W_3`, s².
    pub effort_s2: f64,
    sampling: Sampling,
}

impl Weights {
    /// `|W_1| = |G F_u/B|` at a frequency in Hz: the design keeps `|S| ≤ 1/|W_1|`.
    pub fn w1(&self, f_hz: f64) -> f64 {
        self.sampling.held_integrators(f_hz).norm() * self.disturbance.magnitude(self.sampling.warped(f_hz))
    }

    /// `|W_2|`, s², at a frequency in Hz: the design keeps `|K S| ≤ 1/|W_2|`.
    pub fn w2(&self, f_hz: f64) -> f64 {
        self.effort_s2 * self.w3(f_hz)
    }

    /// `|W_3| = |F_y/B|` at a frequency in Hz: the design keeps `|T| ≤ 1/|W_3|`.
    pub fn w3(&self, f_hz: f64) -> f64 {
        self.readout.magnitude(self.sampling.warped(f_hz))
    }
}

/// A band in which the flown loop exceeds the table because readout noise alone takes more than nine tenths of it: with
/// `S + T = 1` no controller makes `|S|² |W_1|² + |T|² |W_3|²` smaller than `1/(|W_1|⁻² + |W_3|⁻²)`. A `best_ratio`
/// above one is a requirement that no controller can meet.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Unattainable {
    /// Key of the requirement in the mission file.
    pub requirement: &'static str,
    /// Lowest frequency of the band, Hz.
    pub from_hz: f64,
    /// Highest frequency of the band at which the flown loop exceeds the requirement, Hz.
    pub to_hz: f64,
    /// Frequency of the largest excess, Hz.
    pub worst_hz: f64,
    /// Predicted ASD over the requirement there.
    pub predicted_ratio: f64,
    /// Smallest possible ASD over the requirement there.
    pub best_ratio: f64,
}

impl std::fmt::Display for Unattainable {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(
            f,
            "{} from {:.3e} to {:.3e} Hz: {:.3} times the requirement at {:.3e} Hz, where no controller gives less \
             than {:.3} times",
            self.requirement, self.from_hz, self.to_hz, self.predicted_ratio, self.worst_hz, self.best_ratio
        )
    }
}

/// Controller of one channel, with margins and certificates of its loop.
#[derive(Clone, Debug)]
pub struct ChannelDesign {
    /// Channel, one of [`Mission::channels`].
    pub name: String,
    /// Smallest γ of the synthesis.
    pub gamma: f64,
    /// `‖F_l(P, K)‖∞` of the controller that flies, from its sampled coefficients, by the Hamiltonian test.
    pub gamma_flown: f64,
    /// States of the controller.
    pub order: usize,
    /// Largest `|S| |W_1|` from 1e-5 Hz to Nyquist.
    pub max_s_w1: f64,
    /// Largest `|T| |W_3|` from 1e-5 Hz to Nyquist.
    pub max_t_w3: f64,
    /// Largest predicted ASD over requirement in the table's band, where readout noise alone leaves a tenth of it.
    pub max_asd_ratio: f64,
    /// Highest frequency at which the open loop has unit gain, rad/s.
    pub crossover_rad_s: f64,
    /// Smallest factor of gain, up or down, that makes the loop unstable, dB.
    pub gain_margin_db: f64,
    /// Phase margin, degrees.
    pub phase_margin_deg: f64,
    /// Additional delay that makes the loop unstable, s.
    pub delay_margin_s: f64,
    /// Distance of the open loop from −1, `1/max|S|`.
    pub modulus_margin: f64,
    /// Bounded Real Lemma of the flown loop at 1.001 of its norm: largest eigenvalue of the inequality's left side over
    /// its largest in size; negative.
    pub lmi_max_eigenvalue: f64,
    /// Time after which `FORGOTTEN` of the controller's initial state remains, s.
    pub forget_time_s: f64,
    /// Acceleration per displacement at zero frequency, s⁻²: a static load `a` leaves `a/static_stiffness_s2`.
    pub static_stiffness_s2: f64,
    /// The controller that flies.
    pub controller: ChannelController,
    /// The weights.
    pub weights: Weights,
    /// Band in which the requirement is unattainable, if any.
    pub unattainable: Option<Unattainable>,
    /// Disturbance, readout noise and requirement.
    pub model: ChannelModel,
    /// The generalized plant of the synthesis, `(d, n, u) → (p/B, effort, −y)`, in the scaled variable
    /// `w/bandwidth`.
    pub plant: GeneralizedPlant,
    /// Unit of the scaled frequency, rad/s.
    pub bandwidth_rad_s: f64,
    sampling: Sampling,
}

/// The whole design.
#[derive(Clone, Debug)]
pub struct Design {
    /// In the order of [`Mission::channels`].
    pub channels: Vec<ChannelDesign>,
}

impl Design {
    /// The controllers by channel, as `[control.channel]` holds them.
    pub fn controllers(&self) -> BTreeMap<String, ChannelController> {
        self.channels.iter().map(|c| (c.name.clone(), c.controller.clone())).collect()
    }
}

/// Designs all channels; channels of equal weights share one synthesis.
///
/// # Errors
/// [`DesignError`] names the channel, the weight and the frequency that stand in the way, or the missing section.
pub fn design(mission: &Mission) -> Result<Design, DesignError> {
    let sampling = Sampling::of(mission);
    let mut channels: Vec<ChannelDesign> = Vec::new();
    for name in mission.channels() {
        let model = channel_model(mission, &name)?;
        let twin = channels.iter().find(|c| ChannelModel { name: name.clone(), ..c.model.clone() } == model);
        channels.push(match twin {
            Some(twin) => ChannelDesign { name, model, ..twin.clone() },
            None => design_channel(model, sampling)?,
        });
    }
    Ok(Design { channels })
}

/// A shape times a factor.
fn scaled(shape: &NoiseShape, factor: f64) -> impl Iterator<Item = NoiseTerm> + '_ {
    shape.terms.iter().map(move |t| NoiseTerm { asd: t.asd * factor, ..*t })
}

/// Requirement and noise of one channel.
///
/// Thrusters and sunlight disturb every channel, through the spacecraft's acceleration and, at a test mass, through
/// `α × b` at the nominal offset; electrodes and stray accelerations disturb a test mass directly. Gains are the
/// lengths of the rows that take three independent axes to this one.
fn channel_model(mission: &Mission, name: &str) -> Result<ChannelModel, DesignError> {
    let n = &mission.noise;
    macro_rules! shape {
        ($key:ident) => {
            Mission::need(&n.$key, concat!("noise.", stringify!($key)), NEEDED_BY)?.shape()
        };
    }
    let r = Mission::need(&mission.requirements, "requirements", NEEDED_BY)?;
    let (body, freedom) = name.split_once('.').unwrap_or((name, ""));
    let is_angle = ANGLES.contains(&freedom);
    let axis = AXES.iter().chain(&ANGLES).position(|f| *f == freedom).unwrap_or_default() % 3;
    let requirement = |key, asd, corner_hz| Requirement { key, asd, corner_hz };
    let (requirement, readout) = if body == SPACECRAFT {
        let key = "requirements.sc_attitude_rad_rthz";
        (requirement(key, r.sc_attitude_rad_rthz, r.corner_hz), shape!(dws_long_arm))
    } else {
        let tm = mission.test_mass(body, NEEDED_BY)?;
        let requirement = match (is_angle, axis) {
            (false, 0) => requirement("requirements.tm_x_m_rthz", r.tm_x_m_rthz, 0.0),
            (false, _) => requirement("requirements.tm_yz_m_rthz", r.tm_yz_m_rthz, 0.0),
            (true, 0) => requirement("requirements.tm_phi_rad_rthz", r.tm_phi_rad_rthz, r.corner_hz),
            (true, _) => requirement("requirements.tm_theta_psi_rad_rthz", r.tm_theta_psi_rad_rthz, r.corner_hz),
        };
        let readout = if !is_angle {
            let (key, noise) = mission.displacement_noise(tm, axis);
            Mission::need(&noise, &format!("noise.{key}"), NEEDED_BY)?.shape()
        } else if axis > 0 && tm.has_interferometer(0) {
            shape!(dws_local)
        } else {
            shape!(is_angle)
        };
        (requirement, readout)
    };
    // Rows that take torque and force, SRF, to this channel's acceleration.
    let inverse = mission.spacecraft.inertia_inverse();
    let row = |m: &Matrix3<f64>| m.row(axis).into_owned();
    let (torque, force): (RowVector3<f64>, RowVector3<f64>);
    let mut terms: Vec<NoiseTerm> = Vec::new();
    if body == SPACECRAFT {
        (torque, force) = (row(&inverse), RowVector3::zeros());
    } else {
        let tm = mission.test_mass(body, NEEDED_BY)?;
        let dcm = tm.dcm_orf_from_srf();
        if is_angle {
            (torque, force) = (row(&(dcm * inverse)), RowVector3::zeros());
            let own = row(&tm.inertia_inverse(body, NEEDED_BY)?);
            terms.extend(scaled(&shape!(electrostatic_torque), own.norm()));
        } else {
            let lever = dcm * Vector3::from(tm.offset_nominal_srf_m).cross_matrix() * inverse;
            (torque, force) = (row(&lever), row(&dcm) / mission.spacecraft.mass_kg);
            if !tm.is_drag_free(axis) {
                terms.extend(scaled(&shape!(electrostatic_force), 1.0 / tm.mass_kg));
            }
            terms.extend(n.test_mass_acceleration.iter().flat_map(|t| t.shape().terms));
        }
    }
    terms.extend(scaled(&shape!(thruster_force), force.norm()));
    terms.extend(scaled(&shape!(thruster_torque), torque.norm()));
    if let (Some(noise), Some(sun)) = (&n.solar_pressure, &mission.solar_pressure) {
        // Worst case over the direction of the Sun, which turns with the orbit.
        let arm = Vector3::from(sun.arm_srf_m);
        terms.extend(scaled(&noise.shape(), force.norm() + torque.norm() * arm.norm()));
    }
    terms.retain(|t| t.asd > 0.0);
    let control = mission.control.as_ref().filter(|_| body == SPACECRAFT);
    let bandwidth_factor = control.map_or(1.0, |c| c.attitude_bandwidth_factor);
    Ok(ChannelModel {
        name: name.to_owned(),
        requirement,
        disturbance: NoiseShape { terms },
        readout,
        bandwidth_factor,
    })
}

/// `a n/√(a² + n²)`: the smallest ASD over requirement that `S + T = 1` allows, for `a = |W_1|` and `n = |W_3|`.
fn best_ratio(disturbance: f64, noise: f64) -> f64 {
    if disturbance == 0.0 || noise == 0.0 { 0.0 } else { 1.0 / (1.0 / disturbance).hypot(1.0 / noise) }
}

/// Refuses a channel whose requirement is below what `S + T = 1` allows, above the relaxed band.
fn must_be_in_reach(model: &ChannelModel, sampling: Sampling) -> Result<(), DesignError> {
    let at = |f: f64| (f, sampling.held_integrators(f).norm() * model.disturbance_ratio(f), model.readout_ratio(f));
    let worst = sampling
        .grid(RELAXED_BELOW_HZ, BAND_HZ.1)
        .map(at)
        .max_by(|(_, a, n), (_, b, m)| best_ratio(*a, *n).total_cmp(&best_ratio(*b, *m)));
    match worst {
        Some((frequency_hz, disturbance_ratio, noise_ratio)) if best_ratio(disturbance_ratio, noise_ratio) > 1.0 => {
            Err(DesignError::OutOfReach {
                channel: model.name.clone(),
                requirement: model.requirement.key,
                frequency_hz,
                noise_ratio,
                disturbance_ratio,
                best_ratio: best_ratio(disturbance_ratio, noise_ratio),
            })
        }
        _ => Ok(()),
    }
}

/// A dimensionless synthesis problem with its scales.
#[derive(Clone)]
struct Problem {
    plant: GeneralizedPlant,
    weights: Weights,
    bandwidth_rad_s: f64,
    /// Half a sample in scaled time.
    half_step: f64,
    /// `u_d/p` per scaled controller gain, s⁻².
    control_unit_s2: f64,
}

impl Problem {
    /// Weights of a channel, and the generalized plant. `headroom` is the scaled disturbance over the square of the
    /// bandwidth, `W_2 W_3` at high frequency its square: the plant between the weights then has unit gain at the
    /// expected bandwidth.
    fn new(model: &ChannelModel, sampling: Sampling, headroom: f64) -> Self {
        let points = |ratio: &dyn Fn(f64) -> f64, cap: f64| -> Vec<(f64, f64)> {
            sampling.grid(BAND_HZ.0, BAND_HZ.1).map(|f| (sampling.warped(f), ratio(f).min(cap))).collect()
        };
        let disturbed = points(&|f| model.disturbance_ratio(f), f64::INFINITY);
        // A disturbance that falls steeply lets the weight fall as far as it likes: not below half of what is there.
        let fastest_point = disturbed.last().map_or(0.0, |(_, magnitude)| *magnitude);
        let mut disturbance = Lag::above(&disturbed, |_| 0.5 * fastest_point);
        let headroom = headroom / model.bandwidth_factor.powi(2);
        let fastest = LARGEST_DELAY_ANGLE / sampling.delay_s();
        let headroom = headroom.max(disturbance.high / fastest.powi(2));
        let bandwidth = (disturbance.high / headroom).sqrt();
        if bandwidth < SLOWEST_RAD_S {
            let raise = (SLOWEST_RAD_S / bandwidth).powi(2);
            disturbance = Lag { low: disturbance.low * raise, high: disturbance.high * raise, ..disturbance };
        }
        let bandwidth = bandwidth.max(SLOWEST_RAD_S);
        let readout =
            Lag::above(&points(&|f| model.readout_ratio(f), LARGEST_SHARE), |low| (LEAST_FALL * low).max(headroom));
        let effort = headroom * headroom / readout.high;
        let weights = Weights { disturbance, readout, effort_s2: effort / disturbance.high, sampling };
        let half_step = 0.5 * sampling.dt_s * bandwidth;
        let delay = delay_line(sampling.delay_samples, MOST_DELAY_STATES, half_step);
        let plant = generalized(&weights, bandwidth, &delay);
        Self { plant, weights, bandwidth_rad_s: bandwidth, half_step, control_unit_s2: disturbance.high }
    }

    /// The controller as sections at the mission's rate: `u = K (−y)` of the scaled problem is `u_d = −gain H(z) p`.
    fn sampled(&self, controller: &StateSpace) -> Result<ChannelController, LtiError> {
        let cascade = controller.sections(self.half_step)?;
        Ok(ChannelController { gain_s2: cascade.gain * self.control_unit_s2, sections: cascade.sections })
    }

    /// `F_l(P, K)` of the sampled controller, with the exact delay of the loop.
    fn flown(&self, controller: &ChannelController) -> Result<StateSpace, HinfError> {
        let gain = controller.gain_s2 / self.control_unit_s2;
        let system = StateSpace::from_sections(&controller.sections, gain, self.half_step);
        let samples = self.weights.sampling.delay_samples;
        let delay = delay_line(samples, samples, self.half_step);
        let plant =
            GeneralizedPlant { system: generalized(&self.weights, self.bandwidth_rad_s, &delay).system, ..self.plant };
        plant.closed(&system)
    }
}

/// A delay `((1 − hs)/(1 + hs))^samples`, or an all-pass of the same delay with `most_states` states.
fn delay_line(samples: u32, most_states: u32, half_step: f64) -> StateSpace {
    let states = samples.min(most_states);
    let h = half_step * f64::from(samples) / f64::from(states.max(1));
    let one = StateSpace::quotient(&[-h, 1.0], &[h, 1.0]);
    (0..states).fold(StateSpace::gain(DMatrix::from_element(1, 1, 1.0)), |line, _| line.then(&one))
}

/// `(d, n, u) → (p/B, W_2 u/W_3, −(p/B + W_3 n))` in the scaled variable `s = w/bandwidth`, all weights in place.
fn generalized(weights: &Weights, bandwidth: f64, delay: &StateSpace) -> GeneralizedPlant {
    let shaping = weights.disturbance.system(bandwidth);
    let noise = weights.readout.system(bandwidth);
    let half_step = 0.5 * weights.sampling.dt_s * bandwidth;
    // p/B = headroom (1 − hs)/s² · acceleration/F_u.
    let headroom = weights.disturbance.high / (bandwidth * bandwidth);
    let (k, m, r) = (delay.order(), shaping.order(), noise.order());
    let n = 2 + k + m + r;
    let (mut a, mut b) = (DMatrix::zeros(n, n), DMatrix::zeros(n, 3));
    let (mut c, mut d) = (DMatrix::zeros(3, n), DMatrix::zeros(3, 3));
    a[(0, 1)] = 1.0;
    // The integrators' inputs: ẋ_1 ∋ −h v, ẋ_2 ∋ v, with v = shaped disturbance + delayed control.
    for (at, system, input) in [(2, delay, 2), (2 + k, &shaping, 0)] {
        let q = system.order();
        a.view_mut((at, at), (q, q)).copy_from(&system.a);
        b.view_mut((at, input), (q, 1)).copy_from(&system.b);
        for (row, factor) in [(0, -half_step), (1, 1.0)] {
            a.view_mut((row, at), (1, q)).copy_from(&(&system.c * factor));
            b[(row, input)] = system.d[(0, 0)] * factor;
        }
    }
    let at = 2 + k + m;
    a.view_mut((at, at), (r, r)).copy_from(&noise.a);
    b.view_mut((at, 1), (r, 1)).copy_from(&noise.b);
    c[(0, 0)] = headroom;
    d[(1, 2)] = weights.effort_s2 * weights.disturbance.high;
    c[(2, 0)] = -headroom;
    c.view_mut((2, at), (1, r)).copy_from(&(&noise.c * -weights.readout.high));
    d[(2, 1)] = -weights.readout.high * noise.d[(0, 0)];
    GeneralizedPlant { system: StateSpace { a, b, c, d }, measurements: 1, controls: 1 }
}

/// One channel: weights, synthesis, the sampled controller, and its certificates.
fn design_channel(model: ChannelModel, sampling: Sampling) -> Result<ChannelDesign, DesignError> {
    must_be_in_reach(&model, sampling)?;
    let failed = |source| DesignError::Synthesis { channel: model.name.clone(), source };
    let (problem, synthesis, gamma) = best_problem(&model, sampling).map_err(failed)?;
    let Flown { central, controller, closed, gamma_flown } = sample(&problem, &synthesis, gamma).map_err(failed)?;
    let flown = Loop { model: &model, sampling, controller: &controller };
    if gamma >= 1.0 {
        return Err(flown.too_greedy(&problem.weights, gamma));
    }
    let lemma = bounded_real(&closed, CERTIFICATE_MARGIN * gamma_flown).map_err(failed)?;
    let bounds = flown.bounds(&problem.weights)?;
    let (max_asd_ratio, unattainable) = flown.table()?;
    let margins = flown.margins();
    Ok(ChannelDesign {
        name: model.name.clone(),
        gamma,
        gamma_flown,
        order: central.order(),
        max_s_w1: bounds.0,
        max_t_w3: bounds.1,
        max_asd_ratio,
        crossover_rad_s: margins.crossover_rad_s,
        gain_margin_db: margins.gain_db,
        phase_margin_deg: margins.phase_deg,
        delay_margin_s: margins.delay_s,
        modulus_margin: margins.modulus,
        lmi_max_eigenvalue: lemma.largest_eigenvalue,
        forget_time_s: forget_time(&controller, sampling.dt_s),
        static_stiffness_s2: controller.gain_s2,
        weights: problem.weights,
        unattainable,
        plant: problem.plant,
        bandwidth_rad_s: problem.bandwidth_rad_s,
        controller,
        sampling,
        model,
    })
}

/// A controller as it flies.
struct Flown {
    central: StateSpace,
    controller: ChannelController,
    closed: StateSpace,
    gamma_flown: f64,
}

/// The first attempt whose figure of merit is good, or the one with the smallest.
fn first_good<O: Copy, T>(
    options: &[O],
    good: impl Fn(f64) -> bool,
    attempt: impl Fn(O) -> Result<(f64, T), HinfError>,
) -> Result<(f64, T), HinfError> {
    let mut best = attempt(options[0])?;
    for option in &options[1..] {
        if good(best.0) {
            break;
        }
        let next = attempt(*option)?;
        if next.0 < best.0 {
            best = next;
        }
    }
    Ok(best)
}

/// The central controller nearest to the optimum whose sampled loop keeps the norm of the synthesis, or the best.
fn sample(problem: &Problem, synthesis: &Synthesis, gamma: f64) -> Result<Flown, HinfError> {
    let attempt = |(factor, exponent): (f64, f64)| {
        let bound = if gamma < 1.0 { (factor * gamma).min(gamma.powf(exponent)) } else { factor * gamma };
        let central = synthesis.controller(bound)?;
        let controller = problem.sampled(&central)?;
        let closed = problem.flown(&controller)?;
        let gamma_flown = norm(&closed, GAMMA_TOLERANCE).map_or(f64::INFINITY, |n| n.value);
        Ok((gamma_flown / bound, Flown { central, controller, closed, gamma_flown }))
    };
    first_good(&BACK_OFF, |excess| excess <= SAMPLED_AS_PROVED, attempt).map(|(_, flown)| flown)
}

/// The first headroom whose γ is good, or the best of all.
fn best_problem(model: &ChannelModel, sampling: Sampling) -> Result<(Problem, Synthesis, f64), HinfError> {
    let try_one = |headroom: f64| {
        let problem = Problem::new(model, sampling, headroom);
        let synthesis = Synthesis::new(&problem.plant)?;
        let gamma = synthesis.optimum(GAMMA_TOLERANCE)?.gamma;
        Ok((gamma, (problem, synthesis)))
    };
    let (gamma, (problem, synthesis)) = first_good(&HEADROOM, |gamma| gamma < GOOD_GAMMA, try_one)?;
    Ok((problem, synthesis, gamma))
}

/// Time after which the slowest pole of a controller has decayed to [`FORGOTTEN`], s.
fn forget_time(controller: &ChannelController, dt_s: f64) -> f64 {
    let radius = |[_, _, _, a1, a2]: &[f64; 5]| {
        let square = C64::from(a1 * a1 - 4.0 * a2).sqrt();
        ((square - *a1) * 0.5).norm().max(((square + *a1) * 0.5).norm())
    };
    let slowest = controller.sections.iter().map(radius).fold(0.0, f64::max);
    FORGOTTEN.ln() / slowest.ln() * dt_s
}

/// Spectral radius of a channel's sampled loop with hold and delay: below one if the loop is stable, one for the double
/// integrator without a controller. `None` if the eigenvalues cannot be found.
pub fn growth_per_sample(controller: &ChannelController, delay_samples: u32, dt_s: f64) -> Option<f64> {
    let delay = delay_samples as usize;
    let order = 2 + delay + 2 * controller.sections.len();
    // States: position, velocity, delayed commands (the next to act first), sections. One column per unit state.
    let columns = (0..order).map(|unit| {
        let now: Vec<f64> = (0..order).map(|i| f64::from(u8::from(i == unit))).collect();
        let mut next = vec![0.0; order];
        let mut x = now[0];
        for (i, [b0, b1, b2, a1, a2]) in controller.sections.iter().enumerate() {
            let at = 2 + delay + 2 * i;
            let out = b0 * x + now[at];
            (next[at], next[at + 1]) = (b1 * x - a1 * out + now[at + 1], b2 * x - a2 * out);
            x = out;
        }
        let command = -controller.gain_s2 * x;
        let mut waiting: Vec<f64> = now[2..2 + delay].to_vec();
        waiting.push(command);
        next[2..2 + delay].copy_from_slice(&waiting[1..]);
        next[0] = now[0] + dt_s * now[1] + 0.5 * dt_s * dt_s * waiting[0];
        next[1] = now[1] + dt_s * waiting[0];
        next
    });
    let matrix = DMatrix::from_vec(order, order, columns.flatten().collect());
    let largest = eigenvalues(&matrix)?.iter().map(|z| z.norm()).fold(0.0, f64::max);
    largest.is_finite().then_some(largest)
}

/// The sampled loop of one channel.
#[derive(Clone, Copy)]
struct Loop<'a> {
    model: &'a ChannelModel,
    sampling: Sampling,
    controller: &'a ChannelController,
}

/// Margins of a loop.
struct Margins {
    crossover_rad_s: f64,
    gain_db: f64,
    phase_deg: f64,
    delay_s: f64,
    modulus: f64,
}

impl Loop<'_> {
    /// Open loop `K G` with the delay.
    fn open(&self, f_hz: f64) -> C64 {
        let z = self.sampling.z(f_hz);
        let delay = z.powi(-self.sampling.delay_samples.cast_signed());
        sections_response(&self.controller.sections, z)
            * self.sampling.held_integrators(f_hz)
            * delay
            * self.controller.gain_s2
    }

    fn sensitivity(&self, f_hz: f64) -> C64 {
        (self.open(f_hz) + 1.0).inv()
    }

    fn complementary(&self, f_hz: f64) -> C64 {
        let open = self.open(f_hz);
        open / (open + 1.0)
    }

    /// `|S| |W_1|` and `|T| |W_3|`.
    fn weighted(&self, weights: &Weights, f_hz: f64) -> (f64, f64) {
        (self.sensitivity(f_hz).norm() * weights.w1(f_hz), self.complementary(f_hz).norm() * weights.w3(f_hz))
    }

    /// ASD of the disturbance without control over the requirement.
    fn uncontrolled(&self, f_hz: f64) -> f64 {
        self.sampling.held_integrators(f_hz).norm() * self.model.disturbance_ratio(f_hz)
    }

    /// ASDs over the requirement: disturbance's part and readout noise's part.
    fn shares(&self, f_hz: f64) -> (f64, f64) {
        let disturbance = self.uncontrolled(f_hz);
        (self.sensitivity(f_hz).norm() * disturbance, self.complementary(f_hz).norm() * self.model.readout_ratio(f_hz))
    }

    /// Largest `|S| |W_1|` and `|T| |W_3|`.
    fn bounds(&self, weights: &Weights) -> Result<(f64, f64), DesignError> {
        let (mut s, mut t) = ((0.0, 0.0), (0.0, 0.0));
        for f in self.sampling.grid(0.1 * BAND_HZ.0, f64::INFINITY) {
            let values = self.weighted(weights, f);
            s = if values.0 > s.0 { (values.0, f) } else { s };
            t = if values.1 > t.0 { (values.1, f) } else { t };
        }
        for (what, (value, frequency_hz)) in [("|S| |W1|", s), ("|T| |W3|", t)] {
            if value > 1.0 {
                return Err(DesignError::NotKept { channel: self.model.name.clone(), what, frequency_hz, value });
            }
        }
        Ok((s.0, t.0))
    }

    /// Largest predicted ASD over requirement where it is attainable, and the band where it is not.
    fn table(&self) -> Result<(f64, Option<Unattainable>), DesignError> {
        let mut largest: f64 = 0.0;
        let mut missed: Option<Unattainable> = None;
        for f in self.sampling.grid(BAND_HZ.0, BAND_HZ.1) {
            let (disturbance, noise) = self.shares(f);
            let ratio = disturbance.hypot(noise);
            let readout = self.model.readout_ratio(f);
            let best = best_ratio(self.uncontrolled(f), readout);
            let promised = readout <= LARGEST_SHARE;
            if promised {
                largest = largest.max(ratio);
            }
            if ratio <= 1.0 {
                continue;
            }
            // W_3 is capped where readout noise alone exceeds its share, and guarantees nothing there.
            if promised {
                let (what, channel) = ("predicted ASD over requirement", self.model.name.clone());
                return Err(DesignError::NotKept { channel, what, frequency_hz: f, value: ratio });
            }
            let band = missed.get_or_insert(Unattainable {
                requirement: self.model.requirement.key,
                from_hz: f,
                to_hz: f,
                worst_hz: f,
                predicted_ratio: ratio,
                best_ratio: best,
            });
            band.to_hz = f;
            if ratio > band.predicted_ratio {
                (band.worst_hz, band.predicted_ratio, band.best_ratio) = (f, ratio, best);
            }
        }
        Ok((largest, missed))
    }

    /// Margins from the open loop on a grid, crossings by linear interpolation.
    fn margins(&self) -> Margins {
        let points: Vec<(f64, C64)> =
            self.sampling.grid(0.1 * BAND_HZ.0, f64::INFINITY).map(|f| (f, self.open(f))).collect();
        let modulus = points.iter().map(|(_, l)| (l + 1.0).norm()).fold(f64::INFINITY, f64::min);
        let (mut crossover_hz, mut phase, mut delay, mut gain_db) = (0.0_f64, PI, f64::INFINITY, f64::INFINITY);
        for pair in points.windows(2) {
            let [(f, l), (g, m)] = [pair[0], pair[1]];
            let between = |x: f64, y: f64| x / (x - y);
            let (x, y) = (l.norm().ln(), m.norm().ln());
            if (x > 0.0) != (y > 0.0) {
                let part = between(x, y);
                let at_hz = f + part * (g - f);
                // Angle from −1; delay turns the loop towards −1 if positive.
                let angle = (-(l + (m - l) * part)).arg();
                crossover_hz = crossover_hz.max(at_hz);
                phase = phase.min(angle.abs());
                delay = delay.min(angle.rem_euclid(TAU) / (TAU * at_hz));
            }
            if (l.im > 0.0) != (m.im > 0.0) {
                let real = l.re + between(l.im, m.im) * (m.re - l.re);
                if real < 0.0 {
                    gain_db = gain_db.min((20.0 * real.abs().log10()).abs());
                }
            }
        }
        Margins { crossover_rad_s: TAU * crossover_hz, gain_db, phase_deg: phase.to_degrees(), delay_s: delay, modulus }
    }

    /// Error of a channel whose smallest γ is above one, with the limiting frequency and weight.
    fn too_greedy(&self, weights: &Weights, gamma: f64) -> DesignError {
        let worst = self.sampling.grid(BAND_HZ.0, f64::INFINITY).map(|f| (f, self.weighted(weights, f)));
        let (frequency_hz, (s, t)) = worst
            .max_by(|(_, (a, b)), (_, (c, d))| a.hypot(*b).total_cmp(&c.hypot(*d)))
            .unwrap_or((BAND_HZ.0, (0.0, 0.0)));
        DesignError::TooGreedy {
            channel: self.model.name.clone(),
            weight: if s > t { "W1" } else { "W3" },
            frequency_hz,
            gamma,
            requirement: self.model.requirement.key,
            loop_delay_s: self.sampling.delay_s(),
        }
    }
}

impl ChannelDesign {
    fn flown(&self) -> Loop<'_> {
        Loop { model: &self.model, sampling: self.sampling, controller: &self.controller }
    }

    /// Sensitivity `S = 1/(1 + GK)` of the flown loop, hold and delay included, at a frequency below Nyquist, Hz.
    pub fn sensitivity(&self, f_hz: f64) -> C64 {
        self.flown().sensitivity(f_hz)
    }

    /// Complementary sensitivity `T = GK/(1 + GK)` of the flown loop at a frequency below Nyquist, Hz.
    pub fn complementary(&self, f_hz: f64) -> C64 {
        self.flown().complementary(f_hz)
    }

    /// Open loop `GK` of the flown loop at a frequency below Nyquist, Hz.
    pub fn open_loop(&self, f_hz: f64) -> C64 {
        self.flown().open(f_hz)
    }

    /// Predicted ASD of the channel's true state at a frequency below Nyquist, m/√Hz or rad/√Hz: disturbance through
    /// `G S` and readout noise through `T`.
    pub fn predicted_asd(&self, f_hz: f64) -> f64 {
        let (disturbance, noise) = self.flown().shares(f_hz);
        disturbance.hypot(noise) * self.required_asd(f_hz)
    }

    /// What the table allows at a frequency, m/√Hz or rad/√Hz.
    pub fn required_asd(&self, f_hz: f64) -> f64 {
        self.model.requirement.asd_at(f_hz)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::taiji;

    fn problem(c: &ChannelDesign) -> Problem {
        Problem {
            plant: c.plant.clone(),
            weights: c.weights,
            bandwidth_rad_s: c.bandwidth_rad_s,
            half_step: 0.5 * c.sampling.dt_s * c.bandwidth_rad_s,
            control_unit_s2: c.weights.disturbance.high,
        }
    }

    fn assert_kept(c: &ChannelDesign, context: &str) {
        let name = format!("{}, {context}", c.name);
        assert!(c.gamma < 1.0 && c.gamma_flown < 1.0, "{name}: gamma {}, flown {}", c.gamma, c.gamma_flown);
        assert!(c.max_s_w1 < 1.0 && c.max_t_w3 < 1.0, "{name}: {} {}", c.max_s_w1, c.max_t_w3);
        assert!(c.max_asd_ratio < 1.0, "{name}: {} of the requirement", c.max_asd_ratio);
        assert!(c.lmi_max_eigenvalue < 0.0, "{name}: {}", c.lmi_max_eigenvalue);
        assert!(c.forget_time_s < 3600.0, "{name}: {} s", c.forget_time_s);
    }

    /// The designed loops die out, as fast as their margins say they should; the same ones with the sign of feedback
    /// turned, or with a gain beyond the margin, grow; without a controller a channel drifts.
    #[test]
    fn growth_tells_stable_loops_from_others() {
        let mission = taiji();
        let growth = |c: &ChannelController| growth_per_sample(c, 1, mission.dt_s()).unwrap();
        for c in design(&mission).unwrap().channels {
            assert!(growth(&c.controller) < 1.0, "{}", c.name);
            let scaled = |by: f64| ChannelController { gain_s2: by * c.controller.gain_s2, ..c.controller.clone() };
            assert!(growth(&scaled(-1.0)) > 1.0, "{}", c.name);
            let margin = 10_f64.powf(c.gain_margin_db / 20.0);
            let (inside, outside) = ([1.0 / margin * 1.02, margin / 1.02], [1.0 / margin / 1.02, margin * 1.02]);
            assert!(inside.iter().all(|by| growth(&scaled(*by)) < 1.0), "{}: {margin}", c.name);
            assert!(outside.iter().any(|by| growth(&scaled(*by)) > 1.0), "{}: {margin}", c.name);
            assert!((growth(&scaled(0.0)) - 1.0).abs() < 1e-6);
        }
    }

    /// Every bound of every channel of the default mission, on the controllers that fly.
    #[test]
    fn default_mission_keeps_every_bound() {
        for c in design(&taiji()).unwrap().channels {
            assert_kept(&c, "default");
            assert!(c.modulus_margin > 0.5 && c.phase_margin_deg > 40.0 && c.gain_margin_db > 10.0, "{}", c.name);
            assert!(c.delay_margin_s > 1.0, "{}: {} s", c.name, c.delay_margin_s);
            assert!(c.order <= 6 && c.controller.sections.len() <= 2, "{}", c.name);
            // A static load of 1e-9 m/s² moves no test mass by more than 0.1 µm.
            assert!(c.name.ends_with("phi") || c.static_stiffness_s2 > 1e-2, "{}", c.name);
        }
    }

    /// The only requirements out of reach are y and z, below the frequency at which the capacitive readout's
    /// `1.8e-9 sqrt(1 + (1 mHz/f)²)` crosses 1e-8: 0.183 mHz.
    #[test]
    fn what_the_table_asks_beyond_physics_is_named() {
        let crossing_hz = 1e-3 / ((1e-8_f64 / 1.8e-9).powi(2) - 1.0).sqrt();
        for c in design(&taiji()).unwrap().channels {
            let lateral = c.name.ends_with(".y") || c.name.ends_with(".z");
            assert_eq!(c.unattainable.is_some(), lateral, "{}", c.name);
            let Some(band) = c.unattainable else { continue };
            assert_eq!(band.requirement, "requirements.tm_yz_m_rthz");
            assert!((band.from_hz / 1e-4 - 1.0).abs() < 1e-9);
            assert!(band.to_hz > 0.99 * crossing_hz && band.to_hz < 1.04 * crossing_hz, "{}", band.to_hz);
            assert!(band.predicted_ratio < 1.02 * band.best_ratio, "{band}");
        }
    }

    /// Rates and delays that a mission may have: the same table is kept.
    #[test]
    fn other_sample_rates_and_delays_keep_the_table() {
        for (rate_hz, delay_samples) in
            [(1.0, 0), (1.0, 1), (2.0, 1), (4.0, 2), (10.0, 0), (10.0, 3), (10.0, 6), (50.0, 1), (50.0, 5)]
        {
            let mut mission = taiji();
            mission.mission.sample_rate_hz = rate_hz;
            mission.control.as_mut().unwrap().delay_samples = delay_samples;
            for c in design(&mission).unwrap().channels {
                assert_kept(&c, &format!("{rate_hz} Hz, {delay_samples} samples"));
                assert!(c.modulus_margin > 0.35, "{} at {rate_hz} Hz: {}", c.name, c.modulus_margin);
            }
        }
    }

    /// `W_1` and `W_3` come from the table: a changed requirement gives another controller, a faster one where less is
    /// allowed.
    #[test]
    fn a_changed_requirement_gives_another_controller() {
        let channel = |mission: &Mission| design(mission).unwrap().channels[3].clone();
        let before = channel(&taiji());
        let mut mission = taiji();
        mission.requirements.as_mut().unwrap().tm_x_m_rthz /= 3.0;
        let after = channel(&mission);
        let ratio = after.weights.w1(1e-2) / before.weights.w1(1e-2);
        assert!((ratio - 3.0).abs() < 1e-9, "{ratio}");
        assert!(after.crossover_rad_s > 1.4 * before.crossover_rad_s, "{}", after.crossover_rad_s);
        // The disturbance's share of a three times smaller requirement may not grow by as much.
        assert!(after.predicted_asd(1e-2) < before.predicted_asd(1e-2) / 1.5);
    }

    /// A readout that is noisier than the requirement, and a loop that is too slow for it: refused by name.
    #[test]
    fn greedy_requirements_are_refused_by_name() {
        let mut mission = taiji();
        mission.requirements.as_mut().unwrap().tm_yz_m_rthz = 1e-9;
        let error = design(&mission).unwrap_err();
        let DesignError::OutOfReach { channel, requirement, frequency_hz, noise_ratio, best_ratio, .. } = &error else {
            panic!("{error}")
        };
        assert_eq!((channel.as_str(), *requirement), ("tm1.y", "requirements.tm_yz_m_rthz"));
        let exact = 1.8 * 2.0_f64.sqrt();
        assert!(
            (frequency_hz / 1e-3 - 1.0).abs() < 1e-6 && (noise_ratio / exact - 1.0).abs() < 1e-6 && *best_ratio > 2.5
        );
        assert!(
            error.to_string().contains("noise alone is 2.546 times") && error.to_string().contains("1.000e-3 Hz"),
            "{error}"
        );

        // Noise that falls steeply: a design, or a refusal in numbers.
        for (corner_hz, exponent) in [(1.5e-3, 4), (1.7e-3, 4), (1.8e-3, 4), (4e-2, 2), (1e-3, 6)] {
            let mut mission = taiji();
            let force = mission.noise.thruster_force.as_mut().unwrap();
            (force.corner_hz, force.exponent) = (corner_hz, exponent);
            let said = design(&mission).map_or_else(|error| error.to_string(), |_| String::new());
            assert!(!said.contains("NaN"), "{corner_hz}: {said}");
        }

        let mut mission = taiji();
        mission.mission.sample_rate_hz = 1.0;
        mission.requirements.as_mut().unwrap().tm_x_m_rthz = 1e-10;
        let error = design(&mission).unwrap_err();
        let DesignError::TooGreedy { channel, weight, gamma, frequency_hz, .. } = &error else { panic!("{error}") };
        assert_eq!((channel.as_str(), *weight), ("tm1.x", "W1"));
        assert!(*gamma > 1.0 && (1e-4..0.5).contains(frequency_hz), "{error}");
    }

    #[test]
    fn a_missing_noise_is_named() {
        let mut mission = taiji();
        mission.noise.dws_local = None;
        let error: MissionError = design(&mission).unwrap_err().into();
        assert!(error.to_string().contains("[noise.dws_local]"), "{error}");
    }

    /// The true state of a simulated loop that is driven by a sine of readout noise, or of disturbance: amplitude in
    /// the steady state. Shares nothing with the frequency responses of the design.
    fn steady_amplitude(c: &ChannelDesign, f_hz: f64, noise: f64, disturbance: f64) -> f64 {
        let (dt, delay) = (c.sampling.dt_s, c.sampling.delay_samples as usize);
        let mut states = vec![[0.0; 2]; c.controller.sections.len()];
        let mut waiting = std::collections::VecDeque::from(vec![0.0; delay]);
        let (mut p, mut v, mut quadratures) = (0.0, 0.0, [0.0; 2]);
        let period = (1.0 / (f_hz * dt)).round() as usize;
        let settle = (2.0 * c.forget_time_s / dt / period as f64).ceil() as usize * period + 2 * period;
        for k in 0..settle + period {
            let phase = TAU * k as f64 / period as f64;
            if k >= settle {
                quadratures[0] += p * phase.cos() * 2.0 / period as f64;
                quadratures[1] += p * phase.sin() * 2.0 / period as f64;
            }
            let mut x = p + noise * phase.cos();
            for ([b0, b1, b2, a1, a2], s) in c.controller.sections.iter().zip(&mut states) {
                let out = b0 * x + s[0];
                *s = [b1 * x - a1 * out + s[1], b2 * x - a2 * out];
                x = out;
            }
            waiting.push_back(-c.controller.gain_s2 * x);
            let a = waiting.pop_front().unwrap() + disturbance * phase.cos();
            p += dt * v + 0.5 * dt * dt * a;
            v += dt * a;
        }
        quadratures[0].hypot(quadratures[1])
    }

    /// The paper's `W_3 = P F_y/B` corrected: readout noise of the mission's size reaches the state through `T` alone,
    /// so `|W_3| = F_y/B`, and disturbance through `G S`, so `|W_1| = |G| F_u/B`. In the time domain, against what the
    /// weights say; with the plant in `W_3` they would be apart by `|G|`, 25 to 2500 here.
    #[test]
    fn readout_noise_reaches_the_state_through_t_alone() {
        for c in &design(&taiji()).unwrap().channels[3..7] {
            for f_hz in [1.0 / 320.0, 1.0 / 32.0] {
                let required = c.required_asd(f_hz);
                let noise = c.model.readout.psd(f_hz).sqrt();
                let amplitude = steady_amplitude(c, f_hz, noise, 0.0);
                let predicted = c.complementary(f_hz).norm() * noise;
                assert!((amplitude / predicted - 1.0).abs() < 1e-6, "{}: {amplitude} for {predicted}", c.name);
                // The weight is a bound, within the factor that its flat or first-order shape costs (x: a floor).
                let from_weight = c.complementary(f_hz).norm() * c.weights.w3(f_hz) * required;
                assert!(amplitude <= from_weight, "{}: W3 is too small", c.name);
                // x is read five hundred times better than it needs: its W3 is flat, at what 0.1 mHz asks.
                let slack = if c.name.ends_with('x') { 500.0 } else { 4.0 };
                assert!(amplitude > from_weight / slack, "{}: W3 is too large", c.name);

                let disturbance = c.model.disturbance.psd(f_hz).sqrt();
                let amplitude = steady_amplitude(c, f_hz, 0.0, disturbance);
                let from_weight = c.sensitivity(f_hz).norm() * c.weights.w1(f_hz) * required;
                assert!(amplitude <= from_weight * (1.0 + 1e-6), "{}: W1 is too small", c.name);
                assert!(amplitude > 0.9 * from_weight, "{}: W1 is too large: {amplitude} {from_weight}", c.name);
            }
        }
    }

    /// Margins mean what they say: the gain margin brings a closed-loop pole to the axis, and the certificate of one
    /// controller is none for another that breaks the bound.
    #[test]
    fn margins_and_certificates_have_power() {
        for c in &design(&taiji()).unwrap().channels[..7] {
            let closed = |factor: f64| {
                let controller = ChannelController { gain_s2: c.controller.gain_s2 * factor, ..c.controller.clone() };
                problem(c).flown(&controller).unwrap()
            };
            let stable = |factor: f64| closed(factor).poles().unwrap().iter().all(|p| p.re < 0.0);
            let factor = 10.0_f64.powf(c.gain_margin_db / 20.0);
            let margin = |by: f64| stable(by * factor) && stable(1.0 / (by * factor));
            assert!(margin(0.99) && !margin(1.01), "{}: {} dB", c.name, c.gain_margin_db);
            let peak = (0..4000).map(|i| c.sensitivity(1e-4 * 5e4_f64.powf(f64::from(i) / 4001.0)).norm());
            assert!((peak.fold(0.0, f64::max) * c.modulus_margin - 1.0).abs() < 1e-3, "{}", c.name);
            let bound = CERTIFICATE_MARGIN * c.gamma_flown;
            let lemma = bounded_real(&closed(1.0), bound).unwrap();
            assert!(norm(&closed(0.6), 1e-4).unwrap().value > bound, "{}", c.name);
            assert!(lemma.largest_eigenvalue_for(&closed(0.6)) > 0.0, "{}", c.name);
        }
    }

    proptest::proptest! {
        #![proptest_config(proptest::prelude::ProptestConfig { cases: 24, max_shrink_iters: 20, ..Default::default() })]
        /// Any requirement and noise within a factor of ten, any rate from 1 to 50 Hz: a design that keeps everything,
        /// or a refusal that physics confirms.
        #[test]
        fn weights_follow_any_mission(
            requirements in proptest::array::uniform5(-1.0..1.0_f64),
            noises in proptest::array::uniform6(-1.0..1.0_f64),
            rate in 0.0..1.7_f64,
            delay_samples in 0..4_u32,
        ) {
            let factor = |x: f64| 10.0_f64.powf(x);
            let mut m = taiji();
            m.mission.sample_rate_hz = factor(rate);
            m.control.as_mut().unwrap().delay_samples = delay_samples;
            let r = m.requirements.as_mut().unwrap();
            let fields = [&mut r.tm_x_m_rthz, &mut r.tm_yz_m_rthz, &mut r.sc_attitude_rad_rthz, &mut r.tm_phi_rad_rthz, &mut r.tm_theta_psi_rad_rthz];
            fields.into_iter().zip(requirements).for_each(|(field, x)| *field *= factor(x));
            let n = &mut m.noise;
            n.thruster_force.as_mut().unwrap().asd_n_rthz *= factor(noises[0]);
            n.thruster_torque.as_mut().unwrap().asd_nm_rthz *= factor(noises[1]);
            n.ifo_x.as_mut().unwrap().asd_m_rthz *= factor(noises[2]);
            n.is_y.as_mut().unwrap().asd_m_rthz *= factor(noises[3]);
            n.is_angle.as_mut().unwrap().asd_rad_rthz *= factor(noises[4]);
            n.dws_local.as_mut().unwrap().asd_rad_rthz *= factor(noises[5]);
            let sampling = Sampling::of(&m);
            for name in m.channels() {
                match design_channel(channel_model(&m, &name).unwrap(), sampling) {
                    Ok(c) => {
                        assert_kept(&c, "random mission");
                        if let Some(band) = c.unattainable {
                            // What W_1 and the capped W_3 promise there, and that nothing else than readout noise is
                            // the cause.
                            let readout = c.model.readout_ratio(band.worst_hz);
                            let promised = 1.0_f64.hypot(readout / LARGEST_SHARE);
                            proptest::prop_assert!(readout > LARGEST_SHARE && band.predicted_ratio < promised, "{}", band);
                        }
                        proptest::prop_assert!(c.modulus_margin > 0.3, "{}: {}", name, c.modulus_margin);
                    }
                    Err(DesignError::OutOfReach { best_ratio, frequency_hz, .. }) => {
                        proptest::prop_assert!(best_ratio > 1.0 && frequency_hz >= RELAXED_BELOW_HZ * 0.999);
                    }
                    Err(DesignError::TooGreedy { gamma, .. }) => proptest::prop_assert!(gamma >= 1.0),
                    Err(other) => return Err(proptest::test_runner::TestCaseError::fail(other.to_string())),
                }
            }
        }
    }
}
