//! Effect `impulse`: something short at a known time, or, for a candidate, at a time that the host finds; or at every step of a
//! flag of the telemetry.
//!
//! | instance | cause | coefficients | course |
//! |---|---|---|---|
//! | `sc.x\|y\|z` | micrometeoroid (Thorpe et al., ApJ 883, 53) | momentum, N s, and angular momentum x, y, z, N m s | within one sample |
//! | `tmN.x\|y\|z` | glitch on a test mass (arXiv:2205.11938) | momentum, N s | `(e^{−t/τ1} − e^{−t/τ2})/(τ1 − τ2)`, `decay_s` = τ1, `rise_s` = τ2 |
//! | `sc.phi\|theta\|psi` | antenna that starts or stops | angular momentum, N m s | even over `pulse_s` |
//!
//! What moves aboard takes angular momentum when it starts and gives it back when it stops, and telemetry has a flag of it: with
//! `flag`, the course comes at every step of that column, as much of it as the step is high, against the axis where it falls. Each
//! single one may be too faint to find; all together are one coefficient.
//!
//! The regressor is the mean over each sample, s⁻¹, of a course whose integral is one. A momentum p on the spacecraft leaves the
//! test masses behind, `−T_S^{O_i} p/m_S` (eq:TM_SC_relative_acceleration); the arm of a hit is not known, so its angular
//! momentum `L = r × p` has coefficients of its own, `J_S⁻¹ L` in the attitude (eq:SC_attitude_dynamics). What the turn does to
//! the test masses through the offset is in `α̂`, which follows the attitude within its smoothing. A momentum on a test mass
//! pushes it, `p/m_m`.
//!
//! **Range** ±1e-3 N s and N m s on the spacecraft (LISA Pathfinder: 0.2 to 230 µN s), ±1e-7 N s on a test mass. **Sign**: along
//! the axis of SRF or ORF. **Confounders.** A hit's momentum and a glitch of both test masses; an outlier of the attitude; the
//! rise of a glitch and its time.

use dragfree_physics::mission::Mission;
use dragfree_sdk::prelude::*;
use serde_json::json;

use crate::common::{
    AXES, Place, SLOW_HZ, axis_of, behind_spacecraft, channel_of, housekeeping, loaded, manifest, mission, named,
    on_channels, response, saved, tm_of, turning,
};
use crate::steps::Steps;

const SPACECRAFT_MAX: f64 = 1e-3;
const TEST_MASS_MAX: f64 = 1e-7;
/// What a candidate tries for a glitch: decay, s, in steps of 2: two exponentials of √2 times another's decay share 97 % of
/// their power.
const DECAYS_S: [f64; 9] = [1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0, 128.0, 256.0];
/// Rise over decay.
const RISES: [f64; 2] = [0.0, 0.25];
/// A kernel ends when a hundredth of its momentum is left, and of one that ends nothing is.
const KEPT: f64 = 0.99;
/// Lengths that a candidate tries for a turn of the spacecraft, s; 0 is one sample.
const PULSES_S: [f64; 2] = [0.0, 10.0];
/// Lengths that it tries for the steps of a flag, s. What two of them share lies below the shorter one's inverse, where most of
/// what tells them lies, and the truth between two is a mixture.
const FLAG_PULSES_S: [f64; 5] = [1.0, 3.0, 10.0, 30.0, 100.0];
/// From this length on nothing above [`SLOW_HZ`] is worth looking at: the first zero of the course is at a fifth of it.
const SLOW_PULSE_S: f64 = 100.0;
const STATE: &[u8; 8] = b"impulse1";

/// How a momentum is given over time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Course {
    /// Within the sample in which it begins.
    AtOnce,
    /// Evenly over so many seconds.
    Even(f64),
    /// A glitch, s.
    Glitch {
        /// Slower time constant.
        decay_s: f64,
        /// Faster one, 0 for a sudden start.
        rise_s: f64,
    },
}

impl Course {
    /// The part that has been given `t` seconds after the beginning.
    #[must_use]
    pub(crate) fn given(self, t: f64) -> f64 {
        match self {
            _ if t <= 0.0 => 0.0,
            Self::AtOnce => 1.0,
            Self::Even(length_s) => (t / length_s).min(1.0),
            Self::Glitch { decay_s, rise_s } if (decay_s - rise_s).abs() < 1e-6 * decay_s => {
                1.0 - (1.0 + t / decay_s) * (-t / decay_s).exp()
            }
            Self::Glitch { decay_s, rise_s } => {
                let left = |tau: f64| if tau > 0.0 { tau * (-t / tau).exp() } else { 0.0 };
                1.0 - (left(decay_s) - left(rise_s)) / (decay_s - rise_s)
            }
        }
    }

    /// Mean over the sample of `dt_s` that begins `since_s` after the course, s⁻¹.
    #[must_use]
    pub(crate) fn mean(self, since_s: f64, dt_s: f64) -> f64 {
        (self.given(since_s + dt_s) - self.given(since_s)) / dt_s
    }

    /// Means from the sample in which it begins, to six digits.
    fn kernel(self, dt_s: f64) -> Vec<f64> {
        let kept = if matches!(self, Self::Glitch { .. }) { KEPT } else { 1.0 - 1e-9 };
        let mut kernel = Vec::new();
        while self.given(kernel.len() as f64 * dt_s) < kept {
            let mean = self.mean(kernel.len() as f64 * dt_s, dt_s);
            kernel.push(format!("{mean:.5e}").parse().unwrap_or(mean));
        }
        kernel
    }
}

/// Where it acts.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Kind {
    Hit,
    Glitch,
    Turn,
}

/// The effect.
#[derive(Debug)]
pub(crate) struct Impulse {
    instance: String,
    kind: Kind,
    mission: Mission,
    candidate: bool,
    at_ns: i64,
    decay_s: f64,
    rise_s: f64,
    pulse_s: f64,
    flag: String,
    out: Option<Out>,
    steps: Vec<FlagSteps>,
}

/// The courses at the steps of one flag.
#[derive(Debug)]
struct FlagSteps {
    flag: In,
    steps: Steps,
    /// Length of each, rows, and where it is written.
    out: Vec<(usize, Out)>,
}

impl Impulse {
    fn name(&self) -> String {
        format!("impulse:{}", self.instance)
    }

    fn course(&self) -> Course {
        match self.kind {
            Kind::Glitch => {
                Course::Glitch { decay_s: self.decay_s.max(self.rise_s), rise_s: self.rise_s.min(self.decay_s) }
            }
            Kind::Turn => even(self.pulse_s),
            Kind::Hit => Course::AtOnce,
        }
    }

    /// Each coefficient with its name, unit, range, and what it does through a course.
    fn parts(&self, available: &Available, course: &Place) -> Result<Vec<(Coefficient, Vec<Response>)>, PluginError> {
        let coefficient = |part: &str, unit: &str, max: f64| Coefficient {
            name: format!("impulse.{}{part}", self.instance),
            unit: unit.to_owned(),
            lower: -max,
            upper: max,
            prior_sigma: max / 3.0,
            ..Coefficient::default()
        };
        let on = |responses| on_channels(available, &self.name(), responses);
        let turn = |part: &str, axis: usize| -> Result<_, PluginError> {
            Ok((coefficient(part, "N m s", SPACECRAFT_MAX), on(turning(&self.mission, axis, course))?))
        };
        Ok(match self.kind {
            Kind::Glitch => {
                let mass_kg = self.mission.test_mass(tm_of(&self.instance), "the effect impulse")?.mass_kg;
                let pushed = on(vec![response(channel_of(&self.instance), course, 1.0 / mass_kg)])?;
                vec![(coefficient("", "N s", TEST_MASS_MAX), pushed)]
            }
            Kind::Turn => {
                let axis = ["sc.phi", "sc.theta", "sc.psi"].iter().position(|i| *i == self.instance);
                vec![turn("", axis.unwrap_or(0))?]
            }
            Kind::Hit => {
                let behind = on(behind_spacecraft(&self.mission, axis_of(&self.instance), course))?;
                let mut parts = vec![(coefficient(".momentum", "N s", SPACECRAFT_MAX), behind)];
                // Without attitude channels there is no arm to see.
                if available.of_kind("channel").any(|c| c.name.starts_with("sc.alpha.")) {
                    for (axis, letter) in AXES.iter().enumerate() {
                        parts.push(turn(&format!(".angular_{letter}"), axis)?);
                    }
                }
                parts
            }
        })
    }

    /// Where the courses at the steps of a flag stand, for pulses of these lengths, s.
    fn at_steps(
        &mut self,
        flag: &Column,
        pulses_s: &[f64],
        available: &Available,
        link: &mut EffectLink<'_, '_>,
    ) -> Result<Vec<Place>, PluginError> {
        let (mut places, mut out) = (Vec::new(), Vec::new());
        for pulse_s in pulses_s {
            let name = format!("steps({},{pulse_s})", flag.name);
            let (table, written) = if *pulse_s >= SLOW_PULSE_S {
                link.slow_series(available, &name, "s-1", SLOW_HZ)?
            } else {
                link.shared_series(available, &name, "s-1", "")?
            };
            let rows = (pulse_s / self.mission.dt_s()).round().max(1.0) as usize;
            out.extend(written.map(|written| (rows, written)));
            places.push((table, name));
        }
        if let Some(longest) = out.iter().map(|(rows, _)| *rows).max() {
            let flag = link.read(&Want::of(flag))?;
            self.steps.push(FlagSteps { flag, steps: Steps::new(longest, self.mission.dt_s()), out });
        }
        Ok(places)
    }

    fn link_to_flag(&mut self, available: &Available, link: &mut EffectLink<'_, '_>) -> Result<(), PluginError> {
        if self.kind != Kind::Turn {
            return Err(PluginError::error(format!(
                "effect {}: its parameter `flag` is for what turns the spacecraft, sc.phi, sc.theta or sc.psi; give `at_ns`",
                self.name()
            )));
        }
        let flag = named(available, &self.name(), "flag", &self.flag, FLAG_UNIT)?;
        let pulse_s = self.pulse_s;
        let places = self.at_steps(flag, &[pulse_s], available, link)?;
        for (mut coefficient, responses) in self.parts(available, &places[0])? {
            (coefficient.responses, coefficient.shape) = (responses, at_flag(flag, pulse_s));
            link.coefficient(&coefficient)?;
        }
        Ok(())
    }

    /// The forms of a turn at the steps of every column without a unit.
    fn flags(&mut self, available: &Available, link: &mut EffectLink<'_, '_>) -> Result<Vec<Variant>, PluginError> {
        let mut variants = Vec::new();
        for flag in housekeeping(available, FLAG_UNIT) {
            let places = self.at_steps(flag, &FLAG_PULSES_S, available, link)?;
            for (place, pulse_s) in places.iter().zip(FLAG_PULSES_S) {
                for (_, responses) in self.parts(available, place)? {
                    variants.push(Variant { shape: at_flag(flag, pulse_s), responses, ..Variant::default() });
                }
            }
        }
        Ok(variants)
    }

    /// The courses that a candidate tries, with the parameters that name them.
    fn courses(&self) -> Vec<(Course, Shape)> {
        match self.kind {
            Kind::Hit => vec![(Course::AtOnce, Shape::new())],
            Kind::Turn => {
                let shape = |pulse_s: f64| Shape::from([("pulse_s".to_owned(), json!(pulse_s))]);
                PULSES_S.iter().map(|s| (even(*s), shape(*s))).collect()
            }
            Kind::Glitch => {
                let each = DECAYS_S.iter().flat_map(|decay_s| RISES.iter().map(move |rise| (*decay_s, rise * decay_s)));
                each.map(|(decay_s, rise_s)| {
                    let shape = [("decay_s".to_owned(), json!(decay_s)), ("rise_s".to_owned(), json!(rise_s))];
                    (Course::Glitch { decay_s, rise_s }, shape.into())
                })
                .collect()
            }
        }
    }
}

/// A flag has no unit.
const FLAG_UNIT: &str = "1";

fn at_flag(flag: &Column, pulse_s: f64) -> Shape {
    [("flag".to_owned(), json!(flag.name)), ("pulse_s".to_owned(), json!(pulse_s))].into()
}

fn even(pulse_s: f64) -> Course {
    if pulse_s > 0.0 { Course::Even(pulse_s) } else { Course::AtOnce }
}

impl Effect for Impulse {
    const MANIFEST: Manifest = manifest(
        "impulse",
        "A hit, a glitch or a turn at one time",
        &[
            Parameter::i64("at_ns", "ns", 0, 0..=i64::MAX, "Unix time at which it begins"),
            Parameter::f64("decay_s", "s", 60.0, 1e-2..=1e5, "tmN: decay of a glitch"),
            Parameter::f64("rise_s", "s", 0.0, 0.0..=1e5, "tmN: its rise; 0 for a sudden start"),
            Parameter::f64(
                "pulse_s",
                "s",
                0.0,
                0.0..=1e4,
                "sc.phi, theta, psi: how long the torque acts; 0 for one sample",
            ),
            Parameter::text(
                "flag",
                "",
                &[],
                "sc.phi, theta, psi: column at each step of which it acts, hk.NAME in 1, in place of one time",
            ),
        ],
        &["sc.x", "sc.y", "sc.z", "sc.phi", "sc.theta", "sc.psi", "tm1.x", "tm1.y", "tm1.z", "tm2.x", "tm2.y", "tm2.z"],
        &[],
    );

    fn new(setup: &Setup) -> Result<Self, PluginError> {
        let instance = setup.instance().to_owned();
        let last = instance.rsplit('.').next().unwrap_or_default();
        let kind = match (tm_of(&instance), AXES.contains(&last)) {
            ("sc", true) => Kind::Hit,
            ("sc", false) => Kind::Turn,
            _ => Kind::Glitch,
        };
        Ok(Self {
            kind,
            mission: mission(setup)?,
            candidate: setup.candidate(),
            at_ns: setup.i64("at_ns")?,
            decay_s: setup.f64("decay_s")?,
            rise_s: setup.f64("rise_s")?,
            pulse_s: setup.f64("pulse_s")?,
            flag: setup.text("flag")?,
            out: None,
            steps: Vec::new(),
            instance,
        })
    }

    fn link(&mut self, available: &Available, link: &mut EffectLink<'_, '_>) -> Result<(), PluginError> {
        if self.candidate {
            let dt_s = self.mission.dt_s();
            let variants = if self.kind == Kind::Turn { self.flags(available, link)? } else { Vec::new() };
            for (mut coefficient, responses) in self.parts(available, &Place::default())? {
                let channels: Vec<(String, f64)> = responses.into_iter().map(|r| (r.channel, r.factor)).collect();
                let transient = |(course, shape): (Course, Shape)| Transient {
                    shape,
                    kernel: course.kernel(dt_s),
                    channels: channels.clone(),
                };
                coefficient.transients = self.courses().into_iter().map(transient).collect();
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
                "effect {}: neither its parameter `at_ns`, the Unix time at which it begins, nor `flag`, a column at the steps of which it \
                 acts, is given; `dragfree diagnose` finds them",
                self.name()
            )));
        }
        let out = link.series("course", "s-1", "")?;
        self.out = Some(out);
        // The time of the rows alone would do, but rows come with a column.
        if let Some(channel) = available.of_kind("channel").next() {
            link.read(&Want::of(channel))?;
        }
        let mut shape = Shape::from([("at_ns".to_owned(), json!(self.at_ns))]);
        match self.course() {
            Course::Glitch { decay_s, rise_s } => {
                shape.extend([("decay_s".to_owned(), json!(decay_s)), ("rise_s".to_owned(), json!(rise_s))]);
            }
            Course::AtOnce | Course::Even(_) if self.kind == Kind::Turn => {
                shape.insert("pulse_s".to_owned(), json!(self.pulse_s));
            }
            Course::AtOnce | Course::Even(_) => {}
        }
        for (mut coefficient, responses) in self.parts(available, &(link.table(), "course".to_owned()))? {
            (coefficient.responses, coefficient.shape) = (responses, shape.clone());
            link.coefficient(&coefficient)?;
        }
        Ok(())
    }

    fn process(&mut self, input: &Inputs<'_>, output: &mut Outputs) -> Result<(), PluginError> {
        for FlagSteps { flag, steps, out } in &mut self.steps {
            for (now_ns, value) in input.time_ns().iter().zip(input.f64(*flag)) {
                steps.push(*now_ns, *value);
                out.iter().for_each(|(rows, out)| output.f64(*out).push(steps.mean(*rows)));
            }
        }
        let Some(out) = self.out else { return Ok(()) };
        let (course, dt_s) = (self.course(), self.mission.dt_s());
        let means = input.time_ns().iter().map(|now_ns| course.mean((now_ns - self.at_ns) as f64 * 1e-9, dt_s));
        output.f64(out).extend(means);
        Ok(())
    }

    fn save(&self) -> Result<Vec<u8>, PluginError> {
        Ok(saved(STATE, self.steps.iter().flat_map(|s| s.steps.state())))
    }

    fn load(&mut self, state: &[u8]) -> Result<(), PluginError> {
        let counts: Vec<usize> = self.steps.iter().map(|s| s.steps.state_len()).collect();
        let numbers = loaded(STATE, &self.name(), counts.iter().sum(), state)?;
        let mut rest = numbers.as_slice();
        for (FlagSteps { steps, .. }, count) in self.steps.iter_mut().zip(counts) {
            let (own, others) = rest.split_at(count);
            steps.set_state(own);
            rest = others;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const COURSES: [Course; 5] = [
        Course::AtOnce,
        Course::Even(1.25),
        Course::Glitch { decay_s: 3.0, rise_s: 0.0 },
        Course::Glitch { decay_s: 3.0, rise_s: 0.7 },
        Course::Glitch { decay_s: 2.0, rise_s: 2.0 },
    ];

    /// Wherever in a sample it begins, the samples add up to the whole momentum, and no sample before has any of it.
    #[test]
    fn a_course_gives_its_whole_momentum_and_nothing_before() {
        for course in COURSES {
            for offset in [0.0, 0.03, 0.0999] {
                let mean = |k: i32| course.mean(0.1 * f64::from(k) - offset, 0.1);
                let whole: f64 = (-5..1000).map(|k| mean(k) * 0.1).sum();
                assert!((whole - 1.0).abs() < 1e-9, "{course:?}: {whole}");
                assert!((-5..0).all(|k| mean(k) == 0.0) && mean(0) > 0.0);
            }
        }
    }

    /// The printed density, summed by the midpoint rule.
    #[test]
    fn a_glitch_has_the_printed_shape() {
        let (decay_s, rise_s) = (3.0, 0.7);
        let density = |t: f64| ((-t / decay_s).exp() - (-t / rise_s).exp()) / (decay_s - rise_s);
        let course = Course::Glitch { decay_s, rise_s };
        for k in 0..80 {
            let since = 0.1 * f64::from(k);
            let mean = (0..100).map(|i| density(since + 1e-3 * (f64::from(i) + 0.5))).sum::<f64>() / 100.0;
            assert!((course.mean(since, 0.1) - mean).abs() < 1e-6, "{since}");
        }
    }

    #[test]
    fn a_kernel_keeps_all_but_a_hundredth() {
        for course in COURSES {
            let kernel = course.kernel(0.1);
            let kept: f64 = kernel.iter().sum::<f64>() * 0.1;
            assert!((0.989..=1.001).contains(&kept), "{course:?}: {kept}");
        }
        assert_eq!(Course::AtOnce.kernel(0.1), [10.0]);
        assert_eq!(even(10.0).kernel(0.1).len(), 100);
    }
}
