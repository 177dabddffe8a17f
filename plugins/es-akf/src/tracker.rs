//! Test masses over time: the filter, the mean over its last hour, the rows for the archive.

use std::collections::VecDeque;
use std::ops::Range;

use dragfree_sdk::state::{State, StateError};

use crate::filter::{Drive, Filter, Settings};
use crate::model::Model;
use crate::octaves::Octaves;

/// The paper's value is the mean of the estimate over the last hour, s.
const AVERAGE_S: f64 = 3600.0;
/// A run shorter than six hours averages its last sixth instead.
const AVERAGE_PART: u64 = 6;
/// Resolution of the averaging window, s.
const BIN_S: f64 = 10.0;

/// Input columns, all of one length.
#[derive(Clone, Debug)]
pub struct Rows<'a> {
    /// Measured displacement at `t_k`, axis by axis, m.
    pub readout_m: Vec<&'a [f64]>,
    /// `û`, mean over `[t_k, t_{k+1})`, axis by axis, m/s².
    pub u_m_s2: Vec<&'a [f64]>,
    /// What the coefficients add.
    pub regressors: Vec<Regressor<&'a [f64]>>,
}

/// What a coefficient adds to the acceleration along an axis: `coefficient · times · factor · column`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Regressor<C> {
    /// The coefficient.
    pub coefficient: Factor,
    /// The other coefficient of a product, or one.
    pub times: Factor,
    /// Constant factor.
    pub factor: f64,
    /// Axis of the filter.
    pub axis: usize,
    /// Column.
    pub column: C,
}

impl<C: Copy> Regressor<C> {
    /// The same with another way to the column.
    pub fn map<D>(&self, to: impl FnOnce(C) -> D) -> Regressor<D> {
        let Self { coefficient, times, factor, axis, column } = *self;
        Regressor { coefficient, times, factor, axis, column: to(column) }
    }
}

/// What a regressor is multiplied with.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Factor {
    /// The estimate of the filter's coefficient of this index.
    Estimated(usize),
    /// A value that the model fixes.
    Fixed(f64),
}

/// A row for the archive.
#[derive(Clone, Debug, PartialEq)]
pub struct Snapshot {
    /// Index of the row of the batch at which it was taken.
    pub row: usize,
    /// Estimate of the displacement, ORF, m.
    pub displacement_m: Vec<f64>,
    /// Estimates of the coefficients.
    pub value: Vec<f64>,
    /// Their σ for the gains in use and the mission's noise.
    pub sigma: Vec<f64>,
    /// Mean NIS per degree of freedom since the row before, NaN where nothing was measured.
    pub nis: f64,
    /// Mean innovation of each readout since the row before, over its σ where innovations are white and the mission's
    /// noise is right; NaN where nothing was measured.
    pub innovation: Vec<f64>,
}

/// Estimates summed over `BIN_S`, and their covariance at its start.
#[derive(Clone, Debug, Default, PartialEq)]
struct Bin {
    epochs: u64,
    sum: Vec<f64>,
    covariance: Vec<f64>,
}

/// The mean over the end of a run.
#[derive(Clone, Debug, PartialEq)]
pub struct Average {
    /// How much of the end was averaged, s.
    pub span_s: f64,
    /// Mean estimate per coefficient.
    pub value: Vec<f64>,
    /// Mean covariance over the span, row-major, for the gains in use and the mission's noise. The error of a mean is
    /// no larger than the mean error: `Cov(mean) ≤ mean(Cov)`, nearly equal as errors within an hour are correlated.
    pub covariance: Vec<f64>,
}

/// A filter over time, whatever its dimensions.
pub trait Follower: std::fmt::Debug + Send + Sync {
    /// Processes rows `range` of a batch; returns the rows for the archive.
    fn process(&mut self, rows: &Rows<'_>, range: Range<usize>) -> Vec<Snapshot>;

    /// Skips epochs without rows.
    fn skip(&mut self, epochs: u64);

    /// The mean over the last hour, or over the last sixth of a run shorter than six hours; in bins of ten seconds, the
    /// newest one perhaps not full. `None` before the first epoch.
    fn result(&self) -> Option<Average>;

    /// Factor on σ: the rms of the worst readout's innovations over what the mission's noise predicts, at least one, as
    /// small innovations do not prove small errors.
    fn stretch(&self) -> f64;

    /// Counts and consistency since the start.
    fn summary(&self) -> Summary;

    /// Visits all that the next row depends on.
    ///
    /// # Errors
    /// [`StateError`] when the state is that of a filter of other dimensions.
    fn state(&mut self, state: &mut State<'_>) -> Result<(), StateError>;
}

/// Most states that a filter can have.
pub const MAX_STATES: usize = 96;

/// The filter of a model at the capacity that its axes and states need, with a row for the archive every `snapshot_s`;
/// `None` for more than [`MAX_STATES`] states or more than three test masses.
///
/// Code is made for each pair of sizes, so that the compiler unrolls and vectorises the covariance passes.
pub fn follow(model: Model, settings: Settings, snapshot_s: f64) -> Option<Box<dyn Follower>> {
    let with = match (model.axes(), model.states()) {
        (3, ..=16) => boxed::<16, 3>,
        (3, 17..=24) => boxed::<24, 3>,
        (3, 25..=32) => boxed::<32, 3>,
        (3, 33..=48) => boxed::<48, 3>,
        (3, 49..=64) => boxed::<64, 3>,
        (3, 65..=MAX_STATES) => boxed::<96, 3>,
        (6, ..=32) => boxed::<32, 6>,
        (6, 33..=48) => boxed::<48, 6>,
        (6, 49..=64) => boxed::<64, 6>,
        (6, 65..=MAX_STATES) => boxed::<96, 6>,
        (9, ..=48) => boxed::<48, 9>,
        (9, 49..=64) => boxed::<64, 9>,
        (9, 65..=MAX_STATES) => boxed::<96, 9>,
        _ => return None,
    };
    Some(with(model, settings, snapshot_s))
}

fn boxed<const N: usize, const D: usize>(model: Model, settings: Settings, snapshot_s: f64) -> Box<dyn Follower> {
    Box::new(Tracker::new(Filter::<N, D>::new(model, settings), snapshot_s))
}

/// What a filter says at the end.
#[derive(Clone, Debug)]
pub struct Summary {
    /// States of its model.
    pub states: usize,
    /// Counts by their names in the report.
    pub counts: [(&'static str, u64); 7],
    /// Sum of the NIS over [`Summary::readouts`].
    pub nis_sum: f64,
    /// Mean NIS per degree of freedom.
    pub nis: Option<f64>,
    /// Axis by axis.
    pub readouts: Vec<Readout>,
    /// σ of the coefficients as the recursion has it.
    pub recursion_sigma: Vec<f64>,
}

/// One readout's innovations.
#[derive(Clone, Copy, Debug)]
pub struct Readout {
    /// How many were used after the warm-up.
    pub used: u64,
    /// Mean square over what the mission's noise predicts.
    pub design_nis: Option<f64>,
    /// The same octave by octave.
    pub octaves: Octaves,
}

/// A filter over time.
#[derive(Clone, Debug)]
pub struct Tracker<const N: usize, const D: usize = 3> {
    filter: Filter<N, D>,
    dt_s: f64,
    snapshot_epochs: u64,
    bins: VecDeque<Bin>,
    /// Statistics at the last snapshot.
    reported: Reported<D>,
}

/// What the last snapshot has told of.
#[derive(Clone, Copy, Debug)]
struct Reported<const D: usize> {
    nis_sum: f64,
    whitened_sum: [f64; D],
    readouts: [u64; D],
}

impl<const N: usize, const D: usize> Tracker<N, D> {
    /// A filter before its first epoch, with a row for the archive every `snapshot_s`.
    pub fn new(filter: Filter<N, D>, snapshot_s: f64) -> Self {
        let dt_s = filter.model().dt_s;
        let snapshot_epochs = ((snapshot_s / dt_s).round() as u64).max(1);
        let reported = Reported { nis_sum: 0.0, whitened_sum: [0.0; D], readouts: [0; D] };
        Self { filter, dt_s, snapshot_epochs, bins: VecDeque::new(), reported }
    }

    /// The filter.
    pub fn filter(&self) -> &Filter<N, D> {
        &self.filter
    }

    fn bin_epochs(&self) -> u64 {
        ((BIN_S / self.dt_s).round() as u64).max(1)
    }

    fn average(&mut self) {
        let bin_epochs = self.bin_epochs();
        if self.bins.back().is_none_or(|b| b.epochs == bin_epochs) {
            let m = self.filter.coefficients().len();
            let covariance = (0..m * m).map(|i| self.filter.coefficient_covariance(i / m, i % m)).collect();
            self.bins.push_back(Bin { epochs: 0, sum: vec![0.0; m], covariance });
            if self.bins.len() > self.whole_window() {
                self.bins.pop_front();
            }
        }
        if let Some(bin) = self.bins.back_mut() {
            bin.epochs += 1;
            for (sum, x) in bin.sum.iter_mut().zip(self.filter.coefficients()) {
                *sum += x;
            }
        }
    }

    /// Bins in the window of a long run.
    fn whole_window(&self) -> usize {
        (AVERAGE_S / (self.bin_epochs() as f64 * self.dt_s)).round() as usize
    }

    fn snapshot(&mut self, row: usize) -> Snapshot {
        let s = self.filter.statistics();
        let (now, last) =
            (Reported { nis_sum: s.nis_sum, whitened_sum: s.whitened_sum, readouts: s.readouts }, self.reported);
        let used: [u64; D] = std::array::from_fn(|i| now.readouts[i].saturating_sub(last.readouts[i]));
        // NaN where there was none: 0/0.
        let nis = (now.nis_sum - last.nis_sum) / used.iter().sum::<u64>() as f64;
        let innovation = |i: usize| (now.whitened_sum[i] - last.whitened_sum[i]) / (used[i] as f64).sqrt();
        let innovation = (0..D).map(innovation).collect();
        self.reported = now;
        let value = self.filter.coefficients().to_vec();
        let sigma = (0..value.len()).map(|i| self.filter.coefficient_covariance(i, i).sqrt()).collect();
        Snapshot { row, displacement_m: self.filter.displacement_m().to_vec(), value, sigma, nis, innovation }
    }
}

impl<const N: usize, const D: usize> Follower for Tracker<N, D> {
    fn process(&mut self, rows: &Rows<'_>, range: Range<usize>) -> Vec<Snapshot> {
        let mut snapshots = Vec::new();
        let mut phi = vec![[0.0; D]; self.filter.coefficients().len()];
        for k in range {
            let mut u: [f64; D] = std::array::from_fn(|axis| rows.u_m_s2[axis][k]);
            phi.iter_mut().for_each(|p| *p = [0.0; D]);
            for r in &rows.regressors {
                // A product is linear in its coefficient at the other's estimate of this epoch.
                let times = match r.times {
                    Factor::Estimated(j) => self.filter.coefficients()[j],
                    Factor::Fixed(value) => value,
                };
                let added = times * r.factor * r.column[k];
                match r.coefficient {
                    Factor::Estimated(j) => phi[j][r.axis] += added,
                    Factor::Fixed(value) => u[r.axis] += value * added,
                }
            }
            let readout: [f64; D] = std::array::from_fn(|axis| rows.readout_m[axis][k]);
            self.filter.step(readout, Drive { acceleration_m_s2: u, regressors: &phi });
            self.average();
            if self.filter.statistics().epochs.is_multiple_of(self.snapshot_epochs) {
                snapshots.push(self.snapshot(k));
            }
        }
        snapshots
    }

    fn skip(&mut self, epochs: u64) {
        self.filter.skip(epochs);
    }

    fn result(&self) -> Option<Average> {
        let m = self.filter.coefficients().len();
        let wanted = self.filter.statistics().epochs / AVERAGE_PART / self.bin_epochs();
        let wanted = usize::try_from(wanted).unwrap_or(usize::MAX).clamp(1, self.whole_window());
        let newest = self.bins.iter().rev().take(wanted);
        let epochs: u64 = newest.clone().map(|b| b.epochs).sum();
        if epochs == 0 {
            return None;
        }
        let mut average =
            Average { span_s: epochs as f64 * self.dt_s, value: vec![0.0; m], covariance: vec![0.0; m * m] };
        for bin in newest {
            for (mean, sum) in average.value.iter_mut().zip(&bin.sum) {
                *mean += sum / epochs as f64;
            }
            for (mean, c) in average.covariance.iter_mut().zip(&bin.covariance) {
                *mean += c * bin.epochs as f64 / epochs as f64;
            }
        }
        Some(average)
    }

    fn stretch(&self) -> f64 {
        self.filter.statistics().design_nis().into_iter().flatten().fold(1.0, f64::max).sqrt()
    }

    fn summary(&self) -> Summary {
        let (filter, s) = (&self.filter, self.filter.statistics());
        let readouts = s.readouts.iter().zip(s.design_nis()).zip(s.octaves);
        Summary {
            states: filter.model().states(),
            counts: [
                ("updates", s.updates),
                ("predictions_only", s.predictions),
                ("rejected_readouts", s.rejected),
                ("reacquisitions", s.reacquisitions),
                ("repairs_of_q", s.repairs_q),
                ("repairs_of_p", s.repairs_p),
                ("resets", s.resets),
            ],
            nis_sum: s.nis_sum,
            nis: s.nis(),
            readouts: readouts
                .map(|((used, design_nis), octaves)| Readout { used: *used, design_nis, octaves })
                .collect(),
            recursion_sigma: (0..filter.coefficients().len())
                .map(|j| filter.recursion_covariance(j, j).sqrt())
                .collect(),
        }
    }

    fn state(&mut self, state: &mut State<'_>) -> Result<(), StateError> {
        self.filter.visit(state)?;
        let m = self.filter.coefficients().len();
        state.queue(&mut self.bins, |state, bin| {
            bin.sum.resize(m, 0.0);
            bin.covariance.resize(m * m, 0.0);
            state.u64(&mut bin.epochs)?;
            state.f64s(&mut bin.sum)?;
            state.f64s(&mut bin.covariance)
        })?;
        if self.bins.len() > self.whole_window() {
            return Err(StateError::Content("a count of averages"));
        }
        state.f64(&mut self.reported.nis_sum)?;
        state.f64s(&mut self.reported.whitened_sum)?;
        self.reported.readouts.iter_mut().try_for_each(|n| state.u64(n))
    }
}
