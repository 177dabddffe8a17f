//! The commands that the control law would have given: a stand-in where none were telemetered, a check where they were.

use dragfree_physics::control::{ControlLaw, PerTestMass, Readout, TestMassReadout};
use dragfree_physics::few::Few;
use dragfree_physics::mission::{MOST_TEST_MASSES, Mission};
use dragfree_sdk::state::{State, StateError};
use nalgebra::Vector3;

/// A command as numbers: thrust and torque of the thrusters, then force and torque on each test mass, axis by axis.
pub type CommandNumbers = Few<f64, { 6 + 6 * MOST_TEST_MASSES }>;
/// A readout as numbers, in the order of [`Mission::channels`].
pub type ReadoutNumbers = Few<f64, { 3 + 6 * MOST_TEST_MASSES }>;

/// Name, unit and frame of the vectors of a command.
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

/// The numbers of a command that belong to a test mass.
pub(crate) fn electrodes_of(test_mass: usize) -> std::ops::Range<usize> {
    6 + 6 * test_mass..12 + 6 * test_mass
}

/// A readout missing for longer than this stops the replay: the telemetered controller saw other data.
const LONGEST_HOLD_S: f64 = 1.0;
/// The replayed law is another than the telemetered one when their commands lie further apart than this part of the
/// telemetered command's rms change from one sample to the next. Fresh readout noise makes that change, and the same
/// law fed with the same readout repeats it exactly.
const SAME_LAW: f64 = 0.5;
/// Samples to compare before the replay may stand in for a lost command.
const PROOF_SAMPLES: u64 = 1000;

/// The last valid readout, channel by channel.
#[derive(Clone, Debug)]
pub(crate) struct Held {
    values: ReadoutNumbers,
    /// Samples since it was read; the maximum before the first.
    ages: Vec<u32>,
}

impl Held {
    pub(crate) fn new(channels: usize) -> Self {
        Self { values: ReadoutNumbers::from_fn(channels, |_| 0.0), ages: vec![u32::MAX; channels] }
    }

    pub(crate) fn take(&mut self, readout: &ReadoutNumbers) {
        for ((value, age), readout) in self.values.iter_mut().zip(&mut self.ages).zip(readout) {
            if readout.is_finite() {
                *value = *readout;
                *age = 0;
            } else {
                *age = age.saturating_add(1);
            }
        }
    }

    fn oldest(&self) -> u32 {
        self.ages.iter().copied().fold(0, u32::max)
    }

    fn vector(&self, first: usize) -> Vector3<f64> {
        Vector3::from_column_slice(&self.values[first..first + 3])
    }

    /// The test masses; zero before the first readout.
    pub(crate) fn test_masses(&self) -> PerTestMass<TestMassReadout> {
        let at = (3..self.values.len()).step_by(6);
        at.map(|i| TestMassReadout { r_orf_m: self.vector(i), att_orf_rad: self.vector(i + 3) }).collect()
    }

    pub(crate) fn visit(&mut self, state: &mut State<'_>) -> Result<(), StateError> {
        state.f64s(self.values.iter_mut())?;
        self.ages.iter_mut().try_for_each(|age| state.u32(age))
    }
}

/// How far the replayed commands are from the telemetered ones, vector by vector, about their mean difference: an
/// integrator whose state is not telemetered differs by a constant.
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

    fn take(&mut self, telemetered: &CommandNumbers, replayed: &CommandNumbers) {
        self.samples += 1;
        self.samples_of_mean += 1;
        for i in 0..telemetered.len() {
            let difference = telemetered[i] - replayed[i];
            let step = difference - self.mean[i];
            self.mean[i] += step / self.samples_of_mean as f64;
            self.squares[i] += step * (difference - self.mean[i]);
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

    /// Samples compared.
    pub fn samples(&self) -> u64 {
        self.samples
    }

    /// Root mean square length of the difference of each of [`command_vectors`], N or N m.
    pub fn rms_distance(&self) -> Vec<f64> {
        rms(&self.squares, self.samples)
    }

    /// Length of the mean difference of each of [`command_vectors`] since the last restart, N or N m: what a constant
    /// in the telemetered controllers' integrators amounts to.
    pub fn mean_distance(&self) -> Vec<f64> {
        self.mean.chunks_exact(3).map(|m| m.iter().map(|m| m * m).sum::<f64>().sqrt()).collect()
    }

    /// Root mean square length of the telemetered command, N or N m.
    pub fn rms_flown(&self) -> Vec<f64> {
        rms(&self.flown_squares, self.samples)
    }

    /// Root mean square length of the telemetered command's change from one sample to the next, N or N m.
    pub fn rms_change(&self) -> Vec<f64> {
        rms(&self.change_squares, self.changes)
    }

    /// False when readout noise cannot explain the distance: another controller flew.
    pub fn same_law(&self) -> bool {
        self.rms_distance().iter().zip(self.rms_change()).all(|(distance, change)| *distance <= SAME_LAW * change)
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

/// A command of so many numbers.
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

/// The running replay.
pub(crate) struct Replay {
    law: ControlLaw,
    /// The law's state before any readout.
    fresh: Vec<f64>,
    /// No command was telemetered at all, so the law stands in unproven.
    alone: bool,
    warm_up_samples: u64,
    longest_hold_samples: u32,
    /// Since the last restart.
    samples: u64,
    /// Flown minus replayed when both were last there: what the integrators' unknown states amount to.
    offset: Option<CommandNumbers>,
    comparison: Comparison,
}

impl Replay {
    pub(crate) fn new(law: ControlLaw, numbers: usize, alone: bool, warm_up_s: f64, rate_hz: f64) -> Self {
        Self {
            fresh: law.state(),
            law,
            alone,
            warm_up_samples: (warm_up_s * rate_hz).ceil() as u64,
            longest_hold_samples: (LONGEST_HOLD_S * rate_hz).ceil() as u32,
            samples: 0,
            offset: None,
            comparison: Comparison::new(numbers),
        }
    }

    /// One sample. Gives the command that stands in where none was telemetered, `None` as long as the law is not
    /// settled, or not known to be the one that flies.
    pub(crate) fn step(
        &mut self,
        held: &Held,
        sun_srf: Option<Vector3<f64>>,
        telemetered: Option<&CommandNumbers>,
    ) -> Result<Option<CommandNumbers>, StateError> {
        if held.oldest() > self.longest_hold_samples {
            if self.samples > 0 {
                self.law.set_state(&self.fresh).map_err(|_| StateError::Content("a control law"))?;
                self.samples = 0;
                self.offset = None;
                self.comparison.restart();
            }
            return Ok(None);
        }
        let readout = Readout { sc_crf_rad: held.vector(0), tm: held.test_masses(), sun_srf };
        let mut replayed: CommandNumbers = self.law.step(&readout).numbers().collect();
        self.samples += 1;
        if self.samples <= self.warm_up_samples {
            return Ok(None);
        }
        let Some(telemetered) = telemetered else {
            // A change across the gap is not the noise of one sample.
            self.comparison.previous = None;
            let proven = self.alone || (self.comparison.samples >= PROOF_SAMPLES && self.comparison.same_law());
            let offset = if self.alone { Some(replayed.map(|_| 0.0)) } else { self.offset };
            return Ok(offset.filter(|_| proven).map(|offset| {
                replayed.iter_mut().zip(&offset).for_each(|(replayed, offset)| *replayed += offset);
                replayed
            }));
        };
        self.offset = Some(CommandNumbers::from_fn(telemetered.len(), |i| telemetered[i] - replayed[i]));
        self.comparison.take(telemetered, &replayed);
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
        let numbers = self.comparison.mean.len();
        state.option(&mut self.offset, |state, command| visit_command(state, numbers, command))?;
        self.comparison.visit(state)
    }
}
