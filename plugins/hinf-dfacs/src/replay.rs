//! The commands that the control law would have given: a stand-in where none were telemetered, a check where they were.

use dragfree_physics::control::{Command, ControlLaw, Readout, TestMassCommand, TestMassReadout};
use nalgebra::Vector3;

use crate::state::{Reader, StateError, Writer};

/// A command as numbers: the six vectors of [`COMMAND_VECTORS`], axis by axis.
pub type CommandNumbers = [f64; 18];
/// A readout as numbers, in the order of [`dragfree_physics::mission::CHANNELS`].
pub type ReadoutNumbers = [f64; 15];

/// Name, unit and frame of the six vectors of a command.
pub const COMMAND_VECTORS: [(&str, &str, &str); 6] = [
    ("mps_force_srf_n", "N", "SRF"),
    ("mps_torque_srf_nm", "N m", "SRF"),
    ("tm1.force_orf_n", "N", "ORF_1"),
    ("tm1.torque_orf_nm", "N m", "ORF_1"),
    ("tm2.force_orf_n", "N", "ORF_2"),
    ("tm2.torque_orf_nm", "N m", "ORF_2"),
];

/// A readout missing for longer than this stops the replay: the flown controller saw what we did not.
const LONGEST_HOLD_S: f64 = 1.0;
/// The replayed law is another than the flown one when their commands lie further apart than this part of the flown
/// command's rms change from one sample to the next. Fresh readout noise makes that change, and the same law fed with
/// the same readout repeats it exactly.
const SAME_LAW: f64 = 0.5;
/// Samples to compare before the replay may stand in for a lost command.
const PROOF_SAMPLES: u64 = 1000;

pub(crate) fn command_from(numbers: &CommandNumbers) -> Command {
    let at = |i: usize| Vector3::from_column_slice(&numbers[3 * i..3 * i + 3]);
    let tm = |i: usize| TestMassCommand { force_orf_n: at(i), torque_orf_nm: at(i + 1) };
    Command { mps_force_srf_n: at(0), mps_torque_srf_nm: at(1), tm: [tm(2), tm(4)] }
}

fn numbers_of(command: &Command) -> CommandNumbers {
    let [a, b] = &command.tm;
    let vectors = [
        command.mps_force_srf_n,
        command.mps_torque_srf_nm,
        a.force_orf_n,
        a.torque_orf_nm,
        b.force_orf_n,
        b.torque_orf_nm,
    ];
    std::array::from_fn(|i| vectors[i / 3][i % 3])
}

/// The last valid readout, channel by channel.
#[derive(Clone, Debug)]
pub(crate) struct Held {
    values: ReadoutNumbers,
    /// Samples since it was read; the maximum before the first.
    ages: [u32; 15],
}

impl Held {
    pub(crate) fn new() -> Self {
        Self { values: [0.0; 15], ages: [u32::MAX; 15] }
    }

    pub(crate) fn take(&mut self, readout: &ReadoutNumbers) {
        for i in 0..15 {
            if readout[i].is_finite() {
                self.values[i] = readout[i];
                self.ages[i] = 0;
            } else {
                self.ages[i] = self.ages[i].saturating_add(1);
            }
        }
    }

    fn oldest(&self) -> u32 {
        self.ages.iter().copied().fold(0, u32::max)
    }

    fn vector(&self, first: usize) -> Vector3<f64> {
        Vector3::from_column_slice(&self.values[first..first + 3])
    }

    /// Both test masses; zero before the first readout.
    pub(crate) fn test_masses(&self) -> [TestMassReadout; 2] {
        [3, 9].map(|i| TestMassReadout { r_orf_m: self.vector(i), att_orf_rad: self.vector(i + 3) })
    }

    pub(crate) fn save(&self, out: &mut Writer) {
        out.numbers(&self.values);
        for age in self.ages {
            out.count(u64::from(age));
        }
    }

    pub(crate) fn load(&mut self, state: &mut Reader<'_>) -> Result<(), StateError> {
        state.numbers(&mut self.values)?;
        for age in &mut self.ages {
            *age = u32::try_from(state.count()?).unwrap_or(u32::MAX);
        }
        Ok(())
    }
}

/// How far the replayed commands are from the flown ones, vector by vector, about their mean difference: an integrator
/// whose state nobody telemetered differs by a constant.
#[derive(Clone, Debug, Default)]
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
    fn take(&mut self, flown: &CommandNumbers, replayed: &CommandNumbers) {
        self.samples += 1;
        self.samples_of_mean += 1;
        for i in 0..18 {
            let difference = flown[i] - replayed[i];
            let step = difference - self.mean[i];
            self.mean[i] += step / self.samples_of_mean as f64;
            self.squares[i] += step * (difference - self.mean[i]);
            self.flown_squares[i] += flown[i] * flown[i];
        }
        if let Some(previous) = self.previous.replace(*flown) {
            self.changes += 1;
            for i in 0..18 {
                self.change_squares[i] += (flown[i] - previous[i]).powi(2);
            }
        }
    }

    fn restart(&mut self) {
        self.samples_of_mean = 0;
        self.mean = CommandNumbers::default();
        self.previous = None;
    }

    /// Samples compared.
    #[must_use]
    pub fn samples(&self) -> u64 {
        self.samples
    }

    /// Root mean square length of the difference of each of [`COMMAND_VECTORS`], N or N m.
    #[must_use]
    pub fn rms_distance(&self) -> [f64; 6] {
        rms(&self.squares, self.samples)
    }

    /// Length of the mean difference of each of [`COMMAND_VECTORS`] since the last restart, N or N m: what a constant in the
    /// flown controllers' integrators amounts to.
    #[must_use]
    pub fn mean_distance(&self) -> [f64; 6] {
        std::array::from_fn(|i| self.mean[3 * i..3 * i + 3].iter().map(|m| m * m).sum::<f64>().sqrt())
    }

    /// Root mean square length of the flown command, N or N m.
    #[must_use]
    pub fn rms_flown(&self) -> [f64; 6] {
        rms(&self.flown_squares, self.samples)
    }

    /// Root mean square length of the flown command's change from one sample to the next, N or N m.
    #[must_use]
    pub fn rms_change(&self) -> [f64; 6] {
        rms(&self.change_squares, self.changes)
    }

    /// False when readout noise cannot explain the distance: another controller flew.
    #[must_use]
    pub fn same_law(&self) -> bool {
        self.rms_distance().iter().zip(self.rms_change()).all(|(distance, change)| *distance <= SAME_LAW * change)
    }

    fn save(&self, out: &mut Writer) {
        out.count(self.samples);
        out.count(self.samples_of_mean);
        out.numbers(&self.mean);
        out.numbers(&self.squares);
        out.numbers(&self.flown_squares);
        out.count(self.changes);
        out.numbers(&self.change_squares);
        out.optional(self.previous.as_ref().map(<[f64; 18]>::as_slice));
    }

    fn load(&mut self, state: &mut Reader<'_>) -> Result<(), StateError> {
        self.samples = state.count()?;
        self.samples_of_mean = state.count()?;
        state.numbers(&mut self.mean)?;
        state.numbers(&mut self.squares)?;
        state.numbers(&mut self.flown_squares)?;
        self.changes = state.count()?;
        state.numbers(&mut self.change_squares)?;
        self.previous = state.optional()?;
        Ok(())
    }
}

fn rms(squares: &CommandNumbers, samples: u64) -> [f64; 6] {
    std::array::from_fn(|i| match samples {
        0 => 0.0,
        n => (squares[3 * i..3 * i + 3].iter().sum::<f64>() / n as f64).sqrt(),
    })
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
    pub(crate) fn new(law: ControlLaw, alone: bool, warm_up_s: f64, rate_hz: f64) -> Self {
        Self {
            fresh: law.state(),
            law,
            alone,
            warm_up_samples: (warm_up_s * rate_hz).ceil() as u64,
            longest_hold_samples: (LONGEST_HOLD_S * rate_hz).ceil() as u32,
            samples: 0,
            offset: None,
            comparison: Comparison::default(),
        }
    }

    /// One sample. Gives the command that stands in where none was flown, `None` as long as the law is not settled, or
    /// not known to be the one that flies.
    pub(crate) fn step(
        &mut self,
        held: &Held,
        sun_srf: Option<Vector3<f64>>,
        flown: Option<&CommandNumbers>,
    ) -> Result<Option<CommandNumbers>, StateError> {
        if held.oldest() > self.longest_hold_samples {
            if self.samples > 0 {
                self.law.set_state(&self.fresh)?;
                self.samples = 0;
                self.offset = None;
                self.comparison.restart();
            }
            return Ok(None);
        }
        let readout = Readout { sc_crf_rad: held.vector(0), tm: held.test_masses(), sun_srf };
        let mut replayed = numbers_of(&self.law.step(&readout));
        self.samples += 1;
        if self.samples <= self.warm_up_samples {
            return Ok(None);
        }
        let Some(flown) = flown else {
            // A change across the gap is not the noise of one sample.
            self.comparison.previous = None;
            let proven = self.alone || (self.comparison.samples >= PROOF_SAMPLES && self.comparison.same_law());
            let offset = if self.alone { Some([0.0; 18]) } else { self.offset };
            return Ok(offset.filter(|_| proven).map(|offset| {
                for i in 0..18 {
                    replayed[i] += offset[i];
                }
                replayed
            }));
        };
        self.offset = Some(std::array::from_fn(|i| flown[i] - replayed[i]));
        self.comparison.take(flown, &replayed);
        Ok(None)
    }

    pub(crate) fn comparison(&self) -> &Comparison {
        &self.comparison
    }

    pub(crate) fn save(&self, out: &mut Writer) {
        out.numbers(&self.law.state());
        out.count(self.samples);
        out.optional(self.offset.as_ref().map(<[f64; 18]>::as_slice));
        self.comparison.save(out);
    }

    pub(crate) fn load(&mut self, state: &mut Reader<'_>) -> Result<(), StateError> {
        let mut law = self.fresh.clone();
        state.numbers(&mut law)?;
        self.law.set_state(&law)?;
        self.samples = state.count()?;
        self.offset = state.optional()?;
        self.comparison.load(state)
    }
}
