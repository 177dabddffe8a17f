//! Effect `impulse`: a transient at a known time, at a time that the host searches, or at every step of a telemetry
//! flag.
//!
//! | instance | cause | coefficients | pulse |
//! |---|---|---|---|
//! | `sc.x\|y\|z` | micrometeoroid hit (ApJ 883, 53) | momentum, N s; angular momentum, N m s | one sample |
//! | `tmN.x\|y\|z` | glitch (arXiv:2205.11938) | momentum, N s | `(e^{−t/τ1} − e^{−t/τ2})/(τ1 − τ2)` |
//! | `sc.phi\|theta\|psi` | antenna that starts or stops | angular momentum, N m s | rectangle of `pulse_s` |
//!
//! The parameters `decay_s` and `rise_s` are τ1 and τ2. `tm1.z-2` is a second transient at `tm1.z`.
//!
//! With `flag`, a pulse proportional to the height of each step of that column occurs at the step: a moving part takes
//! up angular momentum when it starts and returns it when it stops. All steps share one coefficient.
//!
//! The regressor is the mean over each sample, s⁻¹, of a pulse of integral one. A momentum p on the spacecraft gives
//! `−T_S^{O_i} p/m_S` (eq:TM_SC_relative_acceleration). The lever arm of a hit is unknown, so its angular momentum L
//! has coefficients of its own, `J_S⁻¹ L` in the attitude (eq:SC_attitude_dynamics); on a test mass it acts through the
//! offset, by way of `α̂` or, where that is what is commanded, by responses of its own. A momentum on a test mass gives
//! `p/m_m`.
//!
//! **Range**: ±1e-3 N s and N m s on the spacecraft (LISA Pathfinder: 0.2 to 230 µN s), ±2e-4 N s on a test mass.
//! **Sign**: along the axis of SRF or ORF. **Confounders**: a hit and simultaneous glitches; an outlier of the
//! attitude; rise and time of a glitch.

use dragfree_physics::mission::Mission;
use dragfree_sdk::place_and_number;
use dragfree_sdk::prelude::*;
use serde_json::json;

use crate::common::{
    AXES, SLOW_HZ, SeriesRef, accel_channel_of, axis_of, find_housekeeping, housekeeping_in, keep_available, manifest,
    mission, response, responses_to_spacecraft_force, symmetric, tm_of,
};
use crate::step_pulses::StepPulses;
use crate::torque::responses_to_spacecraft_torque;

const MAX_SPACECRAFT: f64 = 1e-3;
const MAX_TEST_MASS: f64 = 2e-4;
/// Three times the σ that a glitch has before any data: those that were seen are far smaller than what could be.
const USUAL_TEST_MASS: f64 = 1e-7;
/// Decay times of candidate glitches, s. Exponentials a factor √2 apart share 97 % of their power.
const DECAYS_S: [f64; 9] = [1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0, 128.0, 256.0];
/// Rise times of candidate glitches, relative to the decay.
const RISE_RATIOS: [f64; 2] = [0.0, 0.25];
/// Fraction of the momentum at which the kernel of a glitch ends.
const KERNEL_FRACTION: f64 = 0.99;
/// Pulse lengths of a candidate torque, s; 0 is one sample.
const PULSES_S: [f64; 2] = [0.0, 10.0];
/// Pulse lengths of a candidate torque at the steps of a flag, s. Mixtures of neighbours cover lengths in between.
const FLAG_PULSES_S: [f64; 5] = [1.0, 3.0, 10.0, 30.0, 100.0];
/// Pulse length from which the series may be stored at [`SLOW_HZ`]: the first zero of its spectrum is at a fifth of
/// that.
const SLOW_PULSE_S: f64 = 100.0;

/// Time course of a transferred momentum.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Pulse {
    /// Within the sample in which it begins.
    OneSample,
    /// Constant over this many seconds.
    Rectangular(f64),
    /// Difference of two exponentials, s.
    Glitch {
        /// Slower time constant.
        decay_s: f64,
        /// Faster time constant, 0 for a sudden start.
        rise_s: f64,
    },
}

impl Pulse {
    /// Fraction delivered `t` seconds after the beginning.
    pub(crate) fn delivered(self, t: f64) -> f64 {
        match self {
            _ if t <= 0.0 => 0.0,
            Self::OneSample => 1.0,
            Self::Rectangular(length_s) => (t / length_s).min(1.0),
            Self::Glitch { decay_s, rise_s } if (decay_s - rise_s).abs() < 1e-6 * decay_s => {
                1.0 - (1.0 + t / decay_s) * (-t / decay_s).exp()
            }
            Self::Glitch { decay_s, rise_s } => {
                let left = |tau: f64| if tau > 0.0 { tau * (-t / tau).exp() } else { 0.0 };
                1.0 - (left(decay_s) - left(rise_s)) / (decay_s - rise_s)
            }
        }
    }

    /// Mean rate over the sample of `dt_s` that begins `since_s` after the pulse's beginning, s⁻¹.
    pub(crate) fn mean(self, since_s: f64, dt_s: f64) -> f64 {
        (self.delivered(since_s + dt_s) - self.delivered(since_s)) / dt_s
    }

    /// Mean rates from the sample in which the pulse begins, rounded to six digits.
    fn kernel(self, dt_s: f64) -> Vec<f64> {
        let kept = if matches!(self, Self::Glitch { .. }) { KERNEL_FRACTION } else { 1.0 - 1e-9 };
        let mut kernel = Vec::new();
        while self.delivered(kernel.len() as f64 * dt_s) < kept {
            let mean = self.mean(kernel.len() as f64 * dt_s, dt_s);
            kernel.push(format!("{mean:.5e}").parse().unwrap_or(mean));
        }
        kernel
    }
}

/// Physical cause, by the instance.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Cause {
    Hit,
    Glitch,
    Torque,
}

/// The effect.
#[derive(Debug)]
pub(crate) struct Impulse {
    instance: String,
    cause: Cause,
    mission: Mission,
    candidate: bool,
    at_ns: i64,
    pulse: Pulse,
    pulse_s: f64,
    flag: String,
    out: Option<Out>,
    flag_pulses: Vec<FlagPulses>,
}

/// Pulses at the steps of one flag.
#[derive(Debug)]
struct FlagPulses {
    flag: In,
    pulses: StepPulses,
    /// Output columns, with their pulse lengths in rows.
    out: Vec<(usize, Out)>,
}

impl Impulse {
    fn name(&self) -> String {
        format!("impulse:{}", self.instance)
    }

    /// Coefficients, each with its responses to the pulse.
    fn coefficients(
        &self,
        available: &Available,
        pulse: &SeriesRef,
    ) -> Result<Vec<(Coefficient, Vec<Response>)>, PluginError> {
        let coefficient =
            |part: &str, unit: &str, max: f64| symmetric(format!("impulse.{}{part}", self.instance), unit, max);
        let on = |responses| keep_available(available, &self.name(), responses);
        let turn = |part: &str, axis: usize| -> Result<_, PluginError> {
            Ok((
                coefficient(part, "N m s", MAX_SPACECRAFT),
                on(responses_to_spacecraft_torque(available, &self.mission, axis, pulse))?,
            ))
        };
        let (place, _) = place_and_number(&self.instance);
        Ok(match self.cause {
            Cause::Glitch => {
                let mass_kg = self.mission.test_mass(tm_of(place), "the effect impulse")?.mass_kg;
                let pushed = on(vec![response(accel_channel_of(place), pulse, 1.0 / mass_kg)])?;
                let usual = coefficient("", "N s", USUAL_TEST_MASS);
                vec![(Coefficient { lower: -MAX_TEST_MASS, upper: MAX_TEST_MASS, ..usual }, pushed)]
            }
            Cause::Torque => {
                let axis = ["sc.phi", "sc.theta", "sc.psi"].iter().position(|i| *i == place);
                vec![turn("", axis.unwrap_or(0))?]
            }
            Cause::Hit => {
                let behind = on(responses_to_spacecraft_force(&self.mission, axis_of(place), pulse))?;
                let mut coefficients = vec![(coefficient(".momentum", "N s", MAX_SPACECRAFT), behind)];
                // Without attitude channels the angular momentum is unobservable.
                if available.of_kind("channel").any(|c| c.name.starts_with("sc.alpha.")) {
                    for (axis, letter) in AXES.iter().enumerate() {
                        coefficients.push(turn(&format!(".angular_{letter}"), axis)?);
                    }
                }
                coefficients
            }
        })
    }

    /// Series of the pulses at the steps of a flag, one per pulse length, s.
    fn link_flag_pulses(
        &mut self,
        flag: &Column,
        pulses_s: &[f64],
        available: &Available,
        link: &mut EffectLink<'_, '_>,
    ) -> Result<Vec<SeriesRef>, PluginError> {
        let (mut places, mut out) = (Vec::new(), Vec::new());
        for pulse_s in pulses_s {
            let name = format!("steps({},{pulse_s})", flag.name);
            let (table, out_column) = if *pulse_s >= SLOW_PULSE_S {
                link.slow_series(available, &name, "s-1", SLOW_HZ)?
            } else {
                link.shared_series(available, &name, "s-1", "")?
            };
            let rows = (pulse_s / self.mission.dt_s()).round().max(1.0) as usize;
            out.extend(out_column.map(|out_column| (rows, out_column)));
            places.push((table, name));
        }
        if let Some(longest) = out.iter().map(|(rows, _)| *rows).max() {
            let flag = link.read(&Want::of(flag))?;
            self.flag_pulses.push(FlagPulses { flag, pulses: StepPulses::new(longest, self.mission.dt_s()), out });
        }
        Ok(places)
    }

    fn link_to_flag(&mut self, available: &Available, link: &mut EffectLink<'_, '_>) -> Result<(), PluginError> {
        if self.cause != Cause::Torque {
            return Err(PluginError::error(format!(
                "effect {}: parameter `flag` applies to the instances sc.phi, sc.theta and sc.psi; set `at_ns` instead",
                self.name()
            )));
        }
        let flag = find_housekeeping(available, &self.name(), "flag", &self.flag, FLAG_UNIT)?;
        let pulse_s = self.pulse_s;
        let places = self.link_flag_pulses(flag, &[pulse_s], available, link)?;
        for (mut coefficient, responses) in self.coefficients(available, &places[0])? {
            (coefficient.responses, coefficient.shape) = (responses, flag_shape(flag, pulse_s));
            link.coefficient(&coefficient)?;
        }
        Ok(())
    }

    /// Variants of a torque at the steps of each column without a unit.
    fn flag_variants(
        &mut self,
        available: &Available,
        link: &mut EffectLink<'_, '_>,
    ) -> Result<Vec<Variant>, PluginError> {
        let mut variants = Vec::new();
        for flag in housekeeping_in(available, FLAG_UNIT) {
            let places = self.link_flag_pulses(flag, &FLAG_PULSES_S, available, link)?;
            for (place, pulse_s) in places.iter().zip(FLAG_PULSES_S) {
                for (_, responses) in self.coefficients(available, place)? {
                    variants.push(Variant { shape: flag_shape(flag, pulse_s), responses, ..Variant::default() });
                }
            }
        }
        Ok(variants)
    }

    /// Pulses of a candidate, with their shape parameters.
    fn candidate_pulses(&self) -> Vec<(Pulse, Shape)> {
        match self.cause {
            Cause::Hit => vec![(Pulse::OneSample, Shape::new())],
            Cause::Torque => {
                let shape = |pulse_s: f64| Shape::from([("pulse_s".to_owned(), json!(pulse_s))]);
                PULSES_S.iter().map(|s| (rectangular(*s), shape(*s))).collect()
            }
            Cause::Glitch => {
                let each =
                    DECAYS_S.iter().flat_map(|decay_s| RISE_RATIOS.iter().map(move |rise| (*decay_s, rise * decay_s)));
                each.map(|(decay_s, rise_s)| {
                    let shape = [("decay_s".to_owned(), json!(decay_s)), ("rise_s".to_owned(), json!(rise_s))];
                    (Pulse::Glitch { decay_s, rise_s }, shape.into())
                })
                .collect()
            }
        }
    }
}

/// Unit of a flag column.
const FLAG_UNIT: &str = "1";

fn flag_shape(flag: &Column, pulse_s: f64) -> Shape {
    [("flag".to_owned(), json!(flag.name)), ("pulse_s".to_owned(), json!(pulse_s))].into()
}

fn rectangular(pulse_s: f64) -> Pulse {
    if pulse_s > 0.0 { Pulse::Rectangular(pulse_s) } else { Pulse::OneSample }
}

impl Effect for Impulse {
    const MANIFEST: Manifest = manifest(
        "impulse",
        "Transient momentum: a hit, a glitch or an angular momentum",
        &[
            Parameter::i64("at_ns", "ns", 0, 0..=i64::MAX, "Unix time at which it begins"),
            Parameter::f64("decay_s", "s", 60.0, 1e-2..=1e5, "tmN: decay time of a glitch"),
            Parameter::f64("rise_s", "s", 0.0, 0.0..=1e5, "tmN: rise time of a glitch; 0 for a sudden start"),
            Parameter::f64(
                "pulse_s",
                "s",
                0.0,
                0.0..=1e4,
                "sc.phi, theta, psi: duration of the torque; 0 for one sample",
            ),
            Parameter::text(
                "flag",
                "",
                &[],
                "sc.phi, theta, psi: column hk.NAME in 1 at whose steps it acts, in place of `at_ns`",
            ),
        ],
        &["sc.x", "sc.y", "sc.z", "sc.phi", "sc.theta", "sc.psi", "{test_mass}.x", "{test_mass}.y", "{test_mass}.z"],
        &[],
    );

    fn new(setup: &Setup) -> Result<Self, PluginError> {
        let instance = setup.instance().to_owned();
        let last = place_and_number(&instance).0.rsplit('.').next().unwrap_or_default();
        let cause = match (tm_of(&instance), AXES.contains(&last)) {
            ("sc", true) => Cause::Hit,
            ("sc", false) => Cause::Torque,
            _ => Cause::Glitch,
        };
        let (decay_s, rise_s, pulse_s) = (setup.f64("decay_s")?, setup.f64("rise_s")?, setup.f64("pulse_s")?);
        Ok(Self {
            cause,
            mission: mission(setup)?,
            candidate: setup.candidate(),
            at_ns: setup.i64("at_ns")?,
            pulse: match cause {
                Cause::Glitch => Pulse::Glitch { decay_s: decay_s.max(rise_s), rise_s: rise_s.min(decay_s) },
                Cause::Torque => rectangular(pulse_s),
                Cause::Hit => Pulse::OneSample,
            },
            pulse_s,
            flag: setup.text("flag")?,
            out: None,
            flag_pulses: Vec::new(),
            instance,
        })
    }

    fn link(&mut self, available: &Available, link: &mut EffectLink<'_, '_>) -> Result<(), PluginError> {
        if self.candidate {
            let dt_s = self.mission.dt_s();
            let variants = if self.cause == Cause::Torque { self.flag_variants(available, link)? } else { Vec::new() };
            for (mut coefficient, responses) in self.coefficients(available, &SeriesRef::default())? {
                let channels: Vec<(String, f64)> = responses.into_iter().map(|r| (r.channel, r.factor)).collect();
                let transient = |(pulse, shape): (Pulse, Shape)| Transient {
                    shape,
                    kernel: pulse.kernel(dt_s),
                    channels: channels.clone(),
                };
                coefficient.transients = self.candidate_pulses().into_iter().map(transient).collect();
                coefficient.variants.clone_from(&variants);
                link.coefficient(&coefficient)?;
            }
            return Ok(());
        }
        if !self.flag.is_empty() {
            return self.link_to_flag(available, link);
        }
        if self.at_ns == 0 {
            return Err(PluginError::error(format!(
                "effect {}: set parameter `at_ns`, the Unix time in ns at which it begins, or `flag`, the column whose steps it \
                 follows; `dragfree diagnose` finds both",
                self.name()
            )));
        }
        let out = link.series("course", "s-1", "")?;
        self.out = Some(out);
        // Requests a column because a table without columns has no rows.
        if let Some(channel) = available.of_kind("channel").next() {
            link.read(&Want::of(channel))?;
        }
        let mut shape = Shape::from([("at_ns".to_owned(), json!(self.at_ns))]);
        match self.pulse {
            Pulse::Glitch { decay_s, rise_s } => {
                shape.extend([("decay_s".to_owned(), json!(decay_s)), ("rise_s".to_owned(), json!(rise_s))]);
            }
            Pulse::OneSample | Pulse::Rectangular(_) if self.cause == Cause::Torque => {
                shape.insert("pulse_s".to_owned(), json!(self.pulse_s));
            }
            Pulse::OneSample | Pulse::Rectangular(_) => {}
        }
        for (mut coefficient, responses) in self.coefficients(available, &(link.table(), "course".to_owned()))? {
            (coefficient.responses, coefficient.shape) = (responses, shape.clone());
            link.coefficient(&coefficient)?;
        }
        Ok(())
    }

    fn process(&mut self, input: &Inputs<'_>, output: &mut Outputs) -> Result<(), PluginError> {
        for FlagPulses { flag, pulses, out } in &mut self.flag_pulses {
            for (now_ns, value) in input.time_ns().iter().zip(input.f64(*flag)) {
                pulses.push(*now_ns, *value);
                out.iter().for_each(|(rows, out)| output.f64(*out).push(pulses.mean(*rows)));
            }
        }
        let Some(out) = self.out else { return Ok(()) };
        let (pulse, dt_s) = (self.pulse, self.mission.dt_s());
        let means = input.time_ns().iter().map(|now_ns| pulse.mean((now_ns - self.at_ns) as f64 * 1e-9, dt_s));
        output.f64(out).extend(means);
        Ok(())
    }

    fn state(&mut self, state: &mut State<'_>) -> Result<(), PluginError> {
        Ok(self.flag_pulses.iter_mut().try_for_each(|s| s.pulses.visit(state))?)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const PULSES: [Pulse; 5] = [
        Pulse::OneSample,
        Pulse::Rectangular(1.25),
        Pulse::Glitch { decay_s: 3.0, rise_s: 0.0 },
        Pulse::Glitch { decay_s: 3.0, rise_s: 0.7 },
        Pulse::Glitch { decay_s: 2.0, rise_s: 2.0 },
    ];

    /// Independent of the phase of the beginning within a sample.
    #[test]
    fn a_pulse_delivers_its_whole_momentum_and_none_before() {
        for pulse in PULSES {
            for offset in [0.0, 0.03, 0.0999] {
                let mean = |k: i32| pulse.mean(0.1 * f64::from(k) - offset, 0.1);
                let whole: f64 = (-5..1000).map(|k| mean(k) * 0.1).sum();
                assert!((whole - 1.0).abs() < 1e-9, "{pulse:?}: {whole}");
                assert!((-5..0).all(|k| mean(k) == 0.0) && mean(0) > 0.0);
            }
        }
    }

    /// Reference: midpoint rule over the density.
    #[test]
    fn a_glitch_is_a_difference_of_exponentials() {
        let (decay_s, rise_s) = (3.0, 0.7);
        let density = |t: f64| ((-t / decay_s).exp() - (-t / rise_s).exp()) / (decay_s - rise_s);
        let pulse = Pulse::Glitch { decay_s, rise_s };
        for k in 0..80 {
            let since = 0.1 * f64::from(k);
            let mean = (0..100).map(|i| density(since + 1e-3 * (f64::from(i) + 0.5))).sum::<f64>() / 100.0;
            assert!((pulse.mean(since, 0.1) - mean).abs() < 1e-6, "{since}");
        }
    }

    #[test]
    fn a_kernel_contains_99_per_cent() {
        for pulse in PULSES {
            let kernel = pulse.kernel(0.1);
            let kept: f64 = kernel.iter().sum::<f64>() * 0.1;
            assert!((0.989..=1.001).contains(&kept), "{pulse:?}: {kept}");
        }
        assert_eq!(Pulse::OneSample.kernel(0.1), [10.0]);
        assert_eq!(rectangular(10.0).kernel(0.1).len(), 100);
    }
}
