//! Replay of the control law on telemetered readouts, to replace missing commands and to check telemetered ones.

use std::collections::VecDeque;

use dragfree_physics::control::{ControlLaw, PerTestMass, Readout, TestMassReadout};
use dragfree_physics::few::Few;
use dragfree_physics::mission::{MOST_TEST_MASSES, Mission};
use dragfree_sdk::state::{State, StateError};
use nalgebra::Vector3;

/// A command: force and torque of the thrusters, then force and torque on each test mass, axis by axis, N and N m.
pub type CommandNumbers = Few<f64, { 6 + 6 * MOST_TEST_MASSES }>;
/// A readout in the order of [`Mission::channels`], m and rad.
pub type ReadoutNumbers = Few<f64, { 3 + 6 * MOST_TEST_MASSES }>;

/// Name, unit and frame of each vector of a command.
pub fn command_vectors(mission: &Mission) -> Vec<(String, &'static str, String)> {
    let thrusters = [("mps_force_srf_n", "N"), ("mps_torque_srf_nm", "N m")];
    let mut all: Vec<_> = thrusters.map(|(name, unit)| (name.to_owned(), unit, "SRF".to_owned())).into();
    for name in mission.test_mass.keys() {
        for (what, unit) in [("force_orf_n", "N"), ("torque_orf_nm", "N m")] {
            all.push((format!("{name}.{what}"), unit, mission.frame(name)));
        }
    }
    all
}

/// Range of a test mass's force and torque in a command.
pub(crate) fn electrodes_of(test_mass: usize) -> std::ops::Range<usize> {
    6 + 6 * test_mass..12 + 6 * test_mass
}

/// Longest hold of a missing readout, s. Then the replay restarts, as the controller on board had other data.
const MAX_HOLD_S: f64 = 1.0;
/// Largest rms difference of replayed and telemetered commands of the same law, relative to the rms change of the
/// telemetered command from one sample to the next. That change comes from readout noise, which the same law with the
/// same readout reproduces exactly. A wrong command acts like a push: a tenth of that change on the spacecraft is what
/// the interferometers hardly see.
const SAME_LAW_RATIO: f64 = 0.1;
/// Samples to compare before a replayed command may replace a missing one.
const MIN_COMPARED: u64 = 1000;

/// Last valid readout of each channel.
#[derive(Clone, Debug)]
pub(crate) struct LastReadout {
    values: ReadoutNumbers,
    /// Samples since each readout; the maximum before the first.
    ages: Vec<u32>,
}

impl LastReadout {
    pub(crate) fn new(channels: usize) -> Self {
        Self { values: ReadoutNumbers::from_fn(channels, |_| 0.0), ages: vec![u32::MAX; channels] }
    }

    pub(crate) fn update(&mut self, readout: &ReadoutNumbers) {
        for ((value, age), readout) in self.values.iter_mut().zip(&mut self.ages).zip(readout) {
            if readout.is_finite() {
                *value = *readout;
                *age = 0;
            } else {
                *age = age.saturating_add(1);
            }
        }
    }

    fn largest_age(&self) -> u32 {
        self.ages.iter().copied().fold(0, u32::max)
    }

    fn vector(&self, first: usize) -> Vector3<f64> {
        Vector3::from_column_slice(&self.values[first..first + 3])
    }

    /// Readouts of the test masses; zero before the first.
    pub(crate) fn test_masses(&self) -> PerTestMass<TestMassReadout> {
        let at = (3..self.values.len()).step_by(6);
        at.map(|i| TestMassReadout { r_orf_m: self.vector(i), att_orf_rad: self.vector(i + 3) }).collect()
    }

    pub(crate) fn visit(&mut self, state: &mut State<'_>) -> Result<(), StateError> {
        state.f64s(self.values.iter_mut())?;
        self.ages.iter_mut().try_for_each(|age| state.u32(age))
    }
}

/// Deviation of telemetered ("flown") from replayed commands about their mean difference: the states of integrators are
/// not telemetered and cause a constant difference.
#[derive(Clone, Debug)]
pub struct Comparison {
    samples: u64,
    /// Since the last restart.
    samples_of_mean: u64,
    mean: CommandNumbers,
    squares: CommandNumbers,
    flown_squares: CommandNumbers,
    changes: u64,
    change_squares: CommandNumbers,
    previous: Option<CommandNumbers>,
}

impl Comparison {
    fn new(numbers: usize) -> Self {
        let zero = CommandNumbers::from_fn(numbers, |_| 0.0);
        let (mean, squares, flown_squares, change_squares) = (zero, zero, zero, zero);
        let (samples, samples_of_mean, changes, previous) = (0, 0, 0, None);
        Self { samples, samples_of_mean, mean, squares, flown_squares, changes, change_squares, previous }
    }

    fn add(&mut self, telemetered: &CommandNumbers, replayed: &CommandNumbers) {
        self.samples += 1;
        self.samples_of_mean += 1;
        for i in 0..telemetered.len() {
            let difference = telemetered[i] - replayed[i];
            let deviation = difference - self.mean[i];
            self.mean[i] += deviation / self.samples_of_mean as f64;
            self.squares[i] += deviation * (difference - self.mean[i]);
            self.flown_squares[i] += telemetered[i] * telemetered[i];
        }
        if let Some(previous) = self.previous.replace(*telemetered) {
            self.changes += 1;
            for i in 0..telemetered.len() {
                self.change_squares[i] += (telemetered[i] - previous[i]).powi(2);
            }
        }
    }

    fn restart(&mut self) {
        self.samples_of_mean = 0;
        self.mean.fill(0.0);
        self.previous = None;
    }

    /// Number of samples compared.
    pub fn samples(&self) -> u64 {
        self.samples
    }

    /// Rms magnitude of the difference of each of [`command_vectors`] about its mean, N or N m.
    pub fn rms_distance(&self) -> Vec<f64> {
        rms(&self.squares, self.samples)
    }

    /// Magnitude of the mean difference of each of [`command_vectors`] since the last restart, N or N m: the effect of
    /// unknown integrator states.
    pub fn mean_distance(&self) -> Vec<f64> {
        self.mean.chunks_exact(3).map(|m| m.iter().map(|m| m * m).sum::<f64>().sqrt()).collect()
    }

    /// Rms magnitude of each vector of the telemetered command, N or N m.
    pub fn rms_flown(&self) -> Vec<f64> {
        rms(&self.flown_squares, self.samples)
    }

    /// Rms magnitude of its change from one sample to the next, N or N m.
    pub fn rms_change(&self) -> Vec<f64> {
        rms(&self.change_squares, self.changes)
    }

    /// False if readout noise cannot explain the difference, so that another controller flew.
    pub fn same_law(&self) -> bool {
        self.rms_distance().iter().zip(self.rms_change()).all(|(distance, change)| *distance <= SAME_LAW_RATIO * change)
    }

    fn visit(&mut self, state: &mut State<'_>) -> Result<(), StateError> {
        state.u64(&mut self.samples)?;
        state.u64(&mut self.samples_of_mean)?;
        for numbers in [&mut self.mean, &mut self.squares, &mut self.flown_squares] {
            state.f64s(numbers.iter_mut())?;
        }
        state.u64(&mut self.changes)?;
        state.f64s(self.change_squares.iter_mut())?;
        let numbers = self.mean.len();
        state.option(&mut self.previous, |state, command| visit_command(state, numbers, command))
    }
}

/// Visits a command of `numbers` values.
pub(crate) fn visit_command(
    state: &mut State<'_>,
    numbers: usize,
    command: &mut CommandNumbers,
) -> Result<(), StateError> {
    if state.is_loading() {
        *command = CommandNumbers::from_fn(numbers, |_| 0.0);
    }
    state.f64s(command.iter_mut())
}

fn rms(squares: &CommandNumbers, samples: u64) -> Vec<f64> {
    let mean = |squares: &[f64]| (squares.iter().sum::<f64>() / samples as f64).sqrt();
    squares.chunks_exact(3).map(|squares| if samples == 0 { 0.0 } else { mean(squares) }).collect()
}

/// Replay of one control law.
pub(crate) struct Replay {
    law: ControlLaw,
    /// The law's state before any readout.
    initial_state: Vec<f64>,
    /// Whether no commands are telemetered at all, so that the law is used without a comparison.
    unverified: bool,
    warm_up_samples: u64,
    max_hold_samples: u32,
    /// Since the last restart.
    samples: u64,
    /// Whether each of the last readouts was whole that no command comes from yet, the oldest first.
    not_used_yet: VecDeque<bool>,
    /// Since the last one with a missing readout, which the controller on board had, of those that commands come from.
    samples_with_readouts: u32,
    /// Last telemetered minus replayed command, the effect of unknown integrator states.
    offset: Option<CommandNumbers>,
    comparison: Comparison,
}

impl Replay {
    /// `delay_samples` lie between a readout and the command that comes from it.
    pub(crate) fn new(
        law: ControlLaw,
        delay_samples: usize,
        numbers: usize,
        unverified: bool,
        warm_up_s: f64,
        rate_hz: f64,
    ) -> Self {
        Self {
            not_used_yet: vec![true; delay_samples].into(),
            initial_state: law.state(),
            law,
            unverified,
            warm_up_samples: (warm_up_s * rate_hz).ceil() as u64,
            max_hold_samples: (MAX_HOLD_S * rate_hz).ceil() as u32,
            samples: 0,
            samples_with_readouts: 0,
            offset: None,
            comparison: Comparison::new(numbers),
        }
    }

    /// Runs the law for one sample. Returns the command that replaces a missing one; `None` until the law has settled
    /// and is known to be the flown one.
    pub(crate) fn step(
        &mut self,
        readout: &LastReadout,
        sun_srf: Option<Vector3<f64>>,
        telemetered: Option<&CommandNumbers>,
    ) -> Result<Option<CommandNumbers>, StateError> {
        self.not_used_yet.push_back(readout.largest_age() == 0);
        let whole = self.not_used_yet.pop_front().unwrap_or(true);
        self.samples_with_readouts = if whole { self.samples_with_readouts.saturating_add(1) } else { 0 };
        if readout.largest_age() > self.max_hold_samples {
            if self.samples > 0 {
                self.law.set_state(&self.initial_state).map_err(|_| StateError::Content("a control law"))?;
                self.samples = 0;
                self.offset = None;
                self.comparison.restart();
            }
            return Ok(None);
        }
        let readout = Readout { sc_crf_rad: readout.vector(0), tm: readout.test_masses(), sun_srf };
        let mut replayed: CommandNumbers = self.law.step(&readout).numbers().collect();
        self.samples += 1;
        if self.samples <= self.warm_up_samples {
            return Ok(None);
        }
        // For a while after a readout that was lost to us, the controller on board knew more.
        let informed = self.samples_with_readouts > self.max_hold_samples;
        let Some(telemetered) = telemetered else {
            // A difference across the gap is not a change within one sample.
            self.comparison.previous = None;
            let verified = self.comparison.samples >= MIN_COMPARED && self.comparison.same_law();
            let usable = self.unverified || verified && informed;
            let offset = if self.unverified { Some(replayed.map(|_| 0.0)) } else { self.offset };
            return Ok(offset.filter(|_| usable).map(|offset| {
                replayed.iter_mut().zip(&offset).for_each(|(replayed, offset)| *replayed += offset);
                replayed
            }));
        };
        if informed {
            self.offset = Some(CommandNumbers::from_fn(telemetered.len(), |i| telemetered[i] - replayed[i]));
            self.comparison.add(telemetered, &replayed);
        } else {
            self.comparison.previous = None;
        }
        Ok(None)
    }

    pub(crate) fn comparison(&self) -> &Comparison {
        &self.comparison
    }

    pub(crate) fn visit(&mut self, state: &mut State<'_>) -> Result<(), StateError> {
        let mut law = self.law.state();
        state.f64s(&mut law)?;
        self.law.set_state(&law).map_err(|_| StateError::Content("a control law"))?;
        state.u64(&mut self.samples)?;
        state.u32(&mut self.samples_with_readouts)?;
        self.not_used_yet.iter_mut().try_for_each(|whole| state.flag(whole))?;
        let numbers = self.comparison.mean.len();
        state.option(&mut self.offset, |state, command| visit_command(state, numbers, command))?;
        self.comparison.visit(state)
    }
}
