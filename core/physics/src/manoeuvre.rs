//! Manoeuvres: a sine that is commanded beside the control law, and the response of the closed loop to it.
//!
//! The sine is added to the command of the control law, so the loop answers it: `c = S m`, with `m` the manoeuvre, `S`
//! the sensitivity at the input of the plant and `c` the command that acts and is telemetered.

use nalgebra::Vector3;
use std::collections::VecDeque;
use std::f64::consts::TAU;

use crate::control::ControlLaw;
use crate::decoupling::LinearPlant;
use crate::lag::Lag;
use crate::mission::{ANGLES, AXES, Actuators, Control, Mission, MissionError, SPACECRAFT};
use crate::signals::{Command, Readout};

/// An actuator along or about one axis.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Input {
    /// Test mass whose electrodes act, in the order of names; the thrusters act where there is none.
    test_mass: Option<usize>,
    /// Torque in place of force.
    turns: bool,
    /// Axis: of SRF for the thrusters, of ORF for electrodes.
    axis: usize,
}

impl Input {
    /// Thrust and torque of the thrusters, and the electrodes' forces along the suspended axes.
    pub fn all(mission: &Mission) -> Vec<Self> {
        let thrusters = [false, true].into_iter().flat_map(|turns| (0..3).map(move |axis| (None, turns, axis)));
        let suspended =
            mission.test_mass.values().enumerate().flat_map(|(i, tm)| {
                (0..3).filter(|axis| !tm.is_drag_free(*axis)).map(move |axis| (Some(i), false, axis))
            });
        thrusters.chain(suspended).map(|(test_mass, turns, axis)| Self { test_mass, turns, axis }).collect()
    }

    /// The input of a name: `sc.x` is thrust, `sc.phi` torque of the thrusters, `NAME.y` force and `NAME.theta` torque
    /// of the electrodes of a test mass.
    fn of(name: &str, mission: &Mission) -> Option<Self> {
        let (place, axis) = name.split_once('.')?;
        let test_mass =
            if place == SPACECRAFT { None } else { Some(mission.test_mass.keys().position(|k| k == place)?) };
        let along = |names: [&str; 3]| names.iter().position(|own| *own == axis);
        let (turns, axis) = along(AXES).map(|axis| (false, axis)).or_else(|| Some((true, along(ANGLES)?)))?;
        let input = Self { test_mass, turns, axis };
        let pushed = test_mass.is_none() || turns || Self::all(mission).contains(&input);
        pushed.then_some(input)
    }

    /// Its name, see [`Manoeuvre::parse`].
    pub fn name(self, mission: &Mission) -> String {
        let place = self.test_mass.and_then(|i| mission.test_mass.keys().nth(i)).map_or(SPACECRAFT, String::as_str);
        format!("{place}.{}", if self.turns { ANGLES[self.axis] } else { AXES[self.axis] })
    }

    /// Unit of its command.
    pub fn unit(self) -> &'static str {
        if self.turns { "N m" } else { "N" }
    }

    /// Largest command, N or N m.
    pub fn limit(self, limits: &Actuators) -> f64 {
        match (self.test_mass, self.turns) {
            (None, false) => limits.thrust_limit_n,
            (None, true) => limits.torque_limit_nm,
            (Some(_), false) => limits.electrostatic_force_limit_n,
            (Some(_), true) => limits.electrostatic_torque_limit_nm,
        }
    }

    /// Adds a number, N or N m, to a command.
    pub fn add(self, value: f64, command: &mut Command) {
        let vector: &mut Vector3<f64> = match (self.test_mass, self.turns) {
            (None, false) => &mut command.mps_force_srf_n,
            (None, true) => &mut command.mps_torque_srf_nm,
            (Some(i), false) => &mut command.tm[i].force_orf_n,
            (Some(i), true) => &mut command.tm[i].torque_orf_nm,
        };
        vector[self.axis] += value;
    }
}

/// Why a manoeuvre was refused.
#[expect(missing_docs, reason = "the messages name the fields")]
#[derive(Debug, thiserror::Error)]
pub enum ManoeuvreError {
    /// The text does not have the form of a manoeuvre.
    #[error(
        "manoeuvre {0}: not of the form INPUT=AMPLITUDE,frequency_hz=F,from_s=A,until_s=B, as \
         sc.x=1e-7,frequency_hz=0.01,from_s=3600,until_s=5400"
    )]
    Form(String),
    /// There is no such actuator.
    #[error("manoeuvre {text}: there is no actuator {name}; there are {has}, and torques NAME.phi, .theta, .psi")]
    Input { text: String, name: String, has: String },
    /// A number is out of range.
    #[error("manoeuvre {text}: {what} = {value:e} must be {must}")]
    Value { text: String, what: &'static str, value: f64, must: String },
}

/// A sine of force or torque, beside what the control law commands.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Manoeuvre {
    /// Where it acts.
    pub input: Input,
    /// Amplitude, N or N m.
    pub amplitude: f64,
    /// Frequency, Hz.
    pub frequency_hz: f64,
    /// Begin, s after the first epoch; the sine has phase zero then.
    pub from_s: f64,
    /// End, s.
    pub until_s: f64,
}

impl Manoeuvre {
    /// Reads `sc.x=1e-7,frequency_hz=0.01,from_s=3600,until_s=5400`.
    ///
    /// # Errors
    /// [`ManoeuvreError`]: a name is unknown, the amplitude is beyond the actuator, a time or frequency is impossible.
    pub fn parse(text: &str, mission: &Mission) -> Result<Self, ManoeuvreError> {
        let form = || ManoeuvreError::Form(text.to_owned());
        let number = |value: &str| value.trim().parse::<f64>().ok().filter(|x| x.is_finite()).ok_or_else(form);
        let mut parts = text.split(',').map(|part| part.split_once('=').map(|(name, value)| (name.trim(), value)));
        let (name, amplitude) = parts.next().flatten().ok_or_else(form)?;
        let amplitude = number(amplitude)?;
        let mut given = [None; 3];
        for part in parts {
            let (key, value) = part.ok_or_else(form)?;
            let at = ["frequency_hz", "from_s", "until_s"].iter().position(|own| *own == key).ok_or_else(form)?;
            given[at] = Some(number(value)?);
        }
        let [Some(frequency_hz), Some(from_s), Some(until_s)] = given else { return Err(form()) };
        let input = Input::of(name, mission).ok_or_else(|| {
            let has: Vec<String> = Input::all(mission).into_iter().map(|input| input.name(mission)).collect();
            ManoeuvreError::Input { text: text.to_owned(), name: name.to_owned(), has: has.join(", ") }
        })?;
        let all = Self { input, amplitude, frequency_hz, from_s, until_s };
        all.check(text, mission)?;
        Ok(all)
    }

    fn check(&self, text: &str, mission: &Mission) -> Result<(), ManoeuvreError> {
        let refuse = |what, value, must| Err(ManoeuvreError::Value { text: text.to_owned(), what, value, must });
        let limit = mission.actuators.as_ref().map_or(f64::INFINITY, |limits| self.input.limit(limits));
        if self.amplitude.abs() > limit {
            return refuse(
                "AMPLITUDE",
                self.amplitude,
                format!("at most {limit:e} {}, see [actuators]", self.input.unit()),
            );
        }
        let nyquist_hz = 0.5 * mission.mission.sample_rate_hz;
        if !(self.frequency_hz > 0.0 && self.frequency_hz < nyquist_hz) {
            return refuse("frequency_hz", self.frequency_hz, format!("above zero and below {nyquist_hz}"));
        }
        if self.from_s < 0.0 {
            return refuse("from_s", self.from_s, "zero or later".to_owned());
        }
        if self.until_s <= self.from_s {
            return refuse("until_s", self.until_s, format!("later than from_s = {}", self.from_s));
        }
        Ok(())
    }

    /// Adds its command over the sample that begins `elapsed_s` after the first epoch.
    pub fn add(&self, elapsed_s: f64, command: &mut Command) {
        if (self.from_s..self.until_s).contains(&elapsed_s) {
            let phase = TAU * self.frequency_hz * (elapsed_s - self.from_s);
            self.input.add(self.amplitude * phase.sin(), command);
        }
    }
}

/// Delay and lag of the thrusters between a command and what acts.
struct SlowThrusters {
    lag: Lag,
    y: [f64; 6],
    /// Commands within the delay, oldest first.
    waiting: VecDeque<[f64; 6]>,
}

impl SlowThrusters {
    fn new(mission: &Mission) -> Option<Self> {
        let slow = mission.thrusters.as_ref().filter(|t| t.lag_s > 0.0 || t.delay_s > 0.0)?;
        let lag = Lag::new(slow.lag_s, slow.delay_s, mission.dt_s());
        Some(Self { waiting: std::iter::repeat_n([0.0; 6], lag.samples() + 1).collect(), y: [0.0; 6], lag })
    }

    fn act(&mut self, command: &mut Command) {
        let vectors = [&command.mps_force_srf_n, &command.mps_torque_srf_nm];
        let mut commanded = [0.0; 6];
        commanded.iter_mut().zip(vectors.into_iter().flatten()).for_each(|(to, x)| *to = *x);
        self.waiting.push_back(commanded);
        let (older, newer) = (self.waiting[0], self.waiting[1]);
        let acting: [f64; 6] = std::array::from_fn(|i| self.lag.step(&mut self.y[i], older[i], newer[i]));
        self.waiting.pop_front();
        command.mps_force_srf_n = Vector3::from_column_slice(&acting[..3]);
        command.mps_torque_srf_nm = Vector3::from_column_slice(&acting[3..]);
    }
}

/// The closed loop without noise: the control law of a mission on the linear plant of its nominal masses, offsets and
/// stiffness. It begins at rest. Actuators have no limits here, so that the response is proportional to the manoeuvre.
pub struct LinearLoop {
    law: ControlLaw,
    plant: LinearPlant,
    thrusters: Option<SlowThrusters>,
    dt_s: f64,
    /// Displacements and angles of the channels, and their rates.
    position: Vec<f64>,
    rate: Vec<f64>,
    readout: Readout,
}

impl LinearLoop {
    /// The loop of a mission.
    ///
    /// # Errors
    /// [`MissionError`] when the mission has no control law.
    pub fn new(mission: &Mission) -> Result<Self, MissionError> {
        let law = ControlLaw::new(&Mission { actuators: None, ..mission.clone() })?;
        // The test masses feel the lever whether or not the allocation knows of it.
        let control = mission.control.clone().unwrap_or_default();
        let control = Some(Control { lever_feed_forward: true, ..control });
        let plant = LinearPlant::new(&Mission { control, ..mission.clone() })?;
        let channels = plant.channels();
        Ok(Self {
            law,
            plant,
            thrusters: SlowThrusters::new(mission),
            dt_s: mission.dt_s(),
            position: vec![0.0; channels],
            rate: vec![0.0; channels],
            readout: Readout::zero(mission.test_mass.len()),
        })
    }

    /// Commands a manoeuvre over the next sample. Gives the readout at its begin and the whole command.
    pub fn step(&mut self, manoeuvre: &Command) -> (Readout, Command) {
        let readout = self.readout;
        let mut command = self.law.step(&readout);
        command.mps_force_srf_n += manoeuvre.mps_force_srf_n;
        command.mps_torque_srf_nm += manoeuvre.mps_torque_srf_nm;
        for (own, more) in command.tm.iter_mut().zip(&manoeuvre.tm) {
            own.force_orf_n += more.force_orf_n;
            own.torque_orf_nm += more.torque_orf_nm;
        }
        let mut acting = command;
        if let Some(thrusters) = &mut self.thrusters {
            thrusters.act(&mut acting);
        }
        self.advance(&acting);
        (readout, command)
    }

    /// Constant accelerations over a sample.
    fn advance(&mut self, acting: &Command) {
        let mut by_stiffness = vec![0.0; self.position.len()];
        self.plant.take_stiffness_off(&self.readout, &mut by_stiffness);
        let accelerations = self.plant.accelerations(acting);
        for (i, (pushed, pulled)) in accelerations.iter().zip(&by_stiffness).enumerate() {
            let a = pushed - pulled;
            self.position[i] += (self.rate[i] + 0.5 * a * self.dt_s) * self.dt_s;
            self.rate[i] += a * self.dt_s;
        }
        let vector = |v: &[f64]| Vector3::from_column_slice(v);
        self.readout.sc_crf_rad = vector(&self.position[..3]);
        for (tm, own) in self.readout.tm.iter_mut().zip(self.position[3..].chunks_exact(6)) {
            tm.r_orf_m = vector(&own[..3]);
            tm.att_orf_rad = vector(&own[3..]);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::control_design::design;
    use crate::testing::taiji;

    #[test]
    fn a_manoeuvre_is_read_and_refused_by_name_limit_and_time() {
        let mission = taiji();
        let read = |text: &str| Manoeuvre::parse(text, &mission);
        let m = read("tm2.y=1e-10,frequency_hz=0.01,from_s=100,until_s=300").unwrap();
        assert_eq!((m.input.name(&mission), m.input.unit()), ("tm2.y".to_owned(), "N"));
        assert_eq!((m.amplitude, m.frequency_hz, m.from_s, m.until_s), (1e-10, 0.01, 100.0, 300.0));
        for (text, why) in [
            ("sc.x", "not of the form"),
            ("sc.x=1e-5,frequency_hz=0.01,from_s=0", "not of the form"),
            ("sc.x=1e-5,hz=0.01,from_s=0,until_s=1", "not of the form"),
            ("tm1.x=1e-10,frequency_hz=0.01,from_s=0,until_s=1", "no actuator tm1.x"),
            ("sc.x=2e-3,frequency_hz=0.01,from_s=0,until_s=1", "at most 1e-3 N"),
            ("sc.x=1e-5,frequency_hz=5,from_s=0,until_s=1", "below 5"),
            ("sc.x=1e-5,frequency_hz=0.01,from_s=-1,until_s=1", "zero or later"),
            ("sc.x=1e-5,frequency_hz=0.01,from_s=5,until_s=5", "later than from_s"),
        ] {
            let error = read(text).unwrap_err().to_string();
            assert!(error.contains(why), "{error}");
        }
    }

    #[test]
    fn a_sine_is_added_between_its_times_alone() {
        let mission = taiji();
        let m = Manoeuvre::parse("sc.psi=1e-6,frequency_hz=0.025,from_s=10,until_s=50", &mission).unwrap();
        let at = |elapsed_s: f64| {
            let mut command = Command::zero(2);
            m.add(elapsed_s, &mut command);
            command.mps_torque_srf_nm.z
        };
        assert_eq!((at(9.9), at(50.0)), (0.0, 0.0));
        // A quarter of a period after its begin.
        assert!((at(20.0) - 1e-6).abs() < 1e-18 && at(10.0) == 0.0);
    }

    /// Amplitude of the last periods of a signal at a frequency, by projection.
    fn amplitude(signal: &[f64], frequency_hz: f64, dt_s: f64) -> f64 {
        let period = (1.0 / (frequency_hz * dt_s)).round() as usize;
        let from = signal.len() - 4 * period;
        let sum = |f: fn(f64) -> f64| -> f64 {
            (from..signal.len()).map(|k| signal[k] * f(TAU * frequency_hz * k as f64 * dt_s)).sum()
        };
        2.0 / (4 * period) as f64 * sum(f64::sin).hypot(sum(f64::cos))
    }

    /// A torque about φ turns the spacecraft by `S(f) (J⁻¹)_xx M/(2πf)²`, below and above the bandwidth, with the
    /// sensitivity S of the design, which the frequency response of the sampled loop gives.
    #[test]
    fn the_closed_loop_answers_with_its_sensitivity() {
        let mission = taiji();
        let channel = design(&mission).unwrap();
        let channel = channel.channels.iter().find(|c| c.name == "sc.phi").unwrap();
        for frequency_hz in [0.01, 0.1, 0.5] {
            let (input, m) = (Input::of("sc.phi", &mission).unwrap(), 1e-7);
            let sine = Manoeuvre { input, amplitude: m, frequency_hz, from_s: 0.0, until_s: f64::MAX };
            let mut the_loop = LinearLoop::new(&mission).unwrap();
            let dt_s = mission.dt_s();
            let samples = (2000.0 / dt_s) as usize;
            let turned: Vec<f64> = (0..samples)
                .map(|k| {
                    let mut command = Command::zero(2);
                    sine.add(k as f64 * dt_s, &mut command);
                    the_loop.step(&command).0.sc_crf_rad.x
                })
                .collect();
            let free = mission.spacecraft.inertia_inverse()[(0, 0)] * m / (TAU * frequency_hz).powi(2);
            let want = free * channel.sensitivity(frequency_hz).norm();
            let got = amplitude(&turned, frequency_hz, dt_s);
            assert!((got / want - 1.0).abs() < 0.01, "{frequency_hz} Hz: {got:e}, expected {want:e}");
        }
    }
}
