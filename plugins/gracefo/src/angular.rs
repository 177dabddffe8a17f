//! Conditional mean `E[α | measured α]` of the angular acceleration; Methods, "Measured angular acceleration".
//!
//! An offset fitted to `α + n` is attenuated by `S_α/(S_α + S_n)` (errors in variables); fitted to the conditional mean
//! it is not. Per axis the conditional mean is a symmetric (zero-phase) Wiener filter, solved exactly for its length
//! (Wiener–Hopf). `S_n` is the mission's. The measured spectrum comes from the samples that are filtered, one [`BLOCK`]
//! at a time, so that a manoeuvre is not filtered with the spectrum of quiet hours.
//!
//! Limits: the spectrum's own error makes the slope slightly too small, and axes are filtered separately, which leaves
//! a bias if angular accelerations about two axes are correlated and small against the noise.

use std::collections::VecDeque;

use dragfree_physics::noise::NoiseShape;
use dragfree_physics::spectrum::{SpectrumError, welch};
use nalgebra::{DMatrix, DVector};
use serde::{Deserialize, Serialize};

/// Samples per segment of the spectrum.
const SEGMENT: usize = 512;

/// Half length of the filter, samples. Rows closer to a gap or to an end of the data have no value.
pub const HALF_LENGTH: usize = 128;

/// Samples that share one filter, 27 minutes at 10 Hz.
pub const BLOCK: usize = 16_384;

/// Minimum number of samples for a spectrum, seven segments. Shorter intervals between gaps stay as measured.
pub const MIN_SAMPLES: usize = 2_048;

/// Longest run of missing samples that is bridged by a straight line. The rows themselves stay missing.
pub const MAX_BRIDGED: usize = 3;

/// Maximum number of rows held back: the lag.
pub const MAX_PENDING: usize = BLOCK + MIN_SAMPLES + MAX_BRIDGED;

/// Lowest bin not affected by detrending.
const LOWEST_BIN: usize = 2;

/// Variance of `(1, 2, 1)/4` over Hann bins, whose powers have correlations 4/9 and 1/36, relative to one bin.
const SMOOTHING_VARIANCE: f64 = 0.6;

/// Excess over the noise, in standard deviations, below which a bin counts as noise. Without it, noise peaks would
/// pass.
const MIN_EXCESS_SIGMA: f64 = 2.0;

/// Bins per band, and significance in standard deviations, of the test whether the mission overstates the noise.
const BAND: usize = 16;
const OVERSTATED_SIGMA: f64 = 4.0;

/// One epoch.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Row {
    /// Epoch, ns of the tables' time scale.
    pub time_ns: i64,
    /// Angular acceleration, SRF, rad s⁻²; `None` if any axis is missing.
    pub alpha_srf_rad_s2: Option<[f64; 3]>,
    /// Angular rate, SRF, rad s⁻¹, passed through.
    pub omega_srf_rad_s: Option<[f64; 3]>,
}

/// Numbers of rows by treatment.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Counts {
    /// Rows with `E[α | measured α]`.
    pub filtered: u64,
    /// Rows as measured, in intervals too short for a spectrum.
    pub as_measured: u64,
    /// Rows too close to a gap.
    pub near_gap: u64,
}

/// State of a checkpoint.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct State {
    /// Rows since the last gap: those of the previous block within reach of the filter, then the pending ones.
    rows: VecDeque<Row>,
    /// Number of them that are emitted.
    given: usize,
    /// Number of missing samples at the end.
    missing: usize,
    /// Mean of the interval's first block per axis, rad s⁻²: the instrument's bias, which is not filtered.
    level: Option<[f64; 3]>,
    counts: Counts,
}

/// The filter. Its output depends on the rows alone, not on batches.
#[derive(Debug)]
pub struct Wiener {
    noise: NoiseShape,
    rate_hz: f64,
    step_ns: i64,
    state: State,
}

impl Wiener {
    /// A filter for samples `step_ns` apart and the noise spectrum `noise`, (rad s⁻²)²/Hz.
    pub fn new(noise: NoiseShape, step_ns: i64) -> Self {
        Self { noise, rate_hz: 1e9 / step_ns as f64, step_ns, state: State::default() }
    }

    /// Adds the next epoch and emits the rows that are ready, in order.
    ///
    /// # Errors
    /// [`SpectrumError::Transform`].
    pub fn next(&mut self, row: Row, emit: &mut impl FnMut(Row)) -> Result<(), SpectrumError> {
        let s = &mut self.state;
        // A grid that follows a fast clock shifts its epochs by part of a step while samples stay even, so only more
        // than half a step is a gap.
        if s.rows
            .back()
            .is_some_and(|before| (row.time_ns - before.time_ns - self.step_ns).abs() > self.step_ns / 2 + 1)
        {
            self.finish(emit)?;
        }
        let s = &mut self.state;
        if s.rows.is_empty() && row.alpha_srf_rad_s2.is_none() {
            emit(row);
            return Ok(());
        }
        s.rows.push_back(row);
        s.missing = if row.alpha_srf_rad_s2.is_some() { 0 } else { s.missing + 1 };
        if s.missing > MAX_BRIDGED {
            self.finish(emit)
        } else if s.rows.len() - s.given - s.missing >= BLOCK + MIN_SAMPLES {
            self.block(BLOCK, emit)
        } else {
            Ok(())
        }
    }

    /// Emits the rows held back, at the end of the data or at a gap.
    ///
    /// # Errors
    /// [`SpectrumError::Transform`].
    pub fn finish(&mut self, emit: &mut impl FnMut(Row)) -> Result<(), SpectrumError> {
        let s = &mut self.state;
        let gap = s.rows.split_off(s.rows.len() - s.missing);
        let pending = s.rows.len() - s.given;
        if pending >= MIN_SAMPLES {
            self.block(pending, emit)?;
        } else {
            // Only a complete interval can be this short, as a block is emitted only when as many rows follow.
            let rows = s.rows.drain(s.given..);
            rows.for_each(|row| {
                s.counts.as_measured += u64::from(row.alpha_srf_rad_s2.is_some());
                emit(row);
            });
        }
        gap.into_iter().for_each(emit);
        self.state = State { counts: self.state.counts, ..State::default() };
        Ok(())
    }

    /// Numbers of rows so far.
    pub fn counts(&self) -> Counts {
        self.state.counts
    }

    /// Visits the whole state.
    ///
    /// # Errors
    /// What is loaded is no state of a filter.
    pub fn visit(&mut self, state: &mut dragfree_sdk::state::State<'_>) -> Result<(), dragfree_sdk::state::StateError> {
        state.document(&mut self.state)
    }

    /// Emits the first `count` pending rows, filtered with their own spectrum.
    fn block(&mut self, count: usize, emit: &mut impl FnMut(Row)) -> Result<(), SpectrumError> {
        let s = &mut self.state;
        let mut columns = bridged(&s.rows);
        let block = s.given..s.given + count;
        let level = *s
            .level
            .get_or_insert_with(|| [0, 1, 2].map(|i| columns[i][block.clone()].iter().sum::<f64>() / count as f64));
        let mut taps = Vec::with_capacity(3);
        for (column, level) in columns.iter_mut().zip(level) {
            column.iter_mut().for_each(|x| *x -= level);
            taps.push(wiener(&column[block.clone()], &self.noise, self.rate_hz)?);
        }
        for k in block.clone() {
            let mut row = s.rows[k];
            if row.alpha_srf_rad_s2.is_some() {
                let inside = k >= HALF_LENGTH && k + HALF_LENGTH < s.rows.len();
                row.alpha_srf_rad_s2 = inside.then(|| [0, 1, 2].map(|i| level[i] + filtered(&columns[i], &taps[i], k)));
                *(if inside { &mut s.counts.filtered } else { &mut s.counts.near_gap }) += 1;
            }
            emit(row);
        }
        let seen = block.end - HALF_LENGTH.min(block.end);
        s.rows.drain(..seen);
        s.given = block.end - seen;
        Ok(())
    }
}

/// Values per axis, with straight lines over missing samples.
fn bridged(rows: &VecDeque<Row>) -> [Vec<f64>; 3] {
    let known: Vec<usize> = (0..rows.len()).filter(|k| rows[*k].alpha_srf_rad_s2.is_some()).collect();
    let value = |k: usize, i: usize| rows[k].alpha_srf_rad_s2.map_or(0.0, |a| a[i]);
    let mut columns = [0, 1, 2].map(|i| (0..rows.len()).map(|k| value(k, i)).collect::<Vec<f64>>());
    for pair in known.windows(2) {
        let (before, after) = (pair[0], pair[1]);
        for k in before + 1..after {
            let part = (k - before) as f64 / (after - before) as f64;
            for column in &mut columns {
                column[k] = column[before] + part * (column[after] - column[before]);
            }
        }
    }
    // The rows kept from the previous block may begin with a missing sample.
    for k in 0..known.first().copied().unwrap_or(0) {
        for (i, column) in columns.iter_mut().enumerate() {
            column[k] = value(known[0], i);
        }
    }
    columns
}

/// Filter output `Σ h_|j| x_{k+j}`.
fn filtered(x: &[f64], taps: &[f64], k: usize) -> f64 {
    let pairs = taps.iter().enumerate().skip(1).map(|(j, h)| h * (x[k - j] + x[k + j]));
    taps[0] * x[k] + pairs.sum::<f64>()
}

/// Taps `h_0 … h_HALF_LENGTH` of the symmetric filter for the mean of the signal in `x`: the solution of
/// `Σ_j h_|j| R_m(k−j) = R_α(k)`, `|k| ≤ HALF_LENGTH`, with autocorrelations from `S_m` and `W S_m`.
fn wiener(x: &[f64], noise: &NoiseShape, rate_hz: f64) -> Result<Vec<f64>, SpectrumError> {
    let spectrum = welch(x, rate_hz, SEGMENT)?;
    let last = spectrum.psd.len() - 1;
    let bin_hz = spectrum.frequency_hz[1];
    // The noise cannot exceed the measured spectrum: scale an overstated one.
    let overstated = (LOWEST_BIN..last).step_by(BAND).filter_map(|k| {
        let ratio = spectrum.ratio((k as f64 - 0.5) * bin_hz..((k + BAND) as f64 - 0.5) * bin_hz, |f| noise.psd(f))?;
        (ratio.value < 1.0 - OVERSTATED_SIGMA * ratio.sigma).then_some(ratio.value)
    });
    let share = overstated.fold(1.0, f64::min);
    // The spectrum is unknown below the lowest bin, and Nyquist's bin has half the width.
    let inside = |k: usize| k.clamp(LOWEST_BIN, last - 1);
    let threshold = 1.0 + MIN_EXCESS_SIGMA * (2.0 * SMOOTHING_VARIANCE / spectrum.dof()).sqrt();
    let (mut measured, mut signal) = (Vec::with_capacity(last + 1), Vec::with_capacity(last + 1));
    for k in (0..=last).map(inside) {
        let smooth = 0.25 * (spectrum.psd[inside(k - 1)] + spectrum.psd[inside(k + 1)]) + 0.5 * spectrum.psd[k];
        let noise = share * noise.psd(spectrum.frequency_hz[k]);
        measured.push(smooth);
        signal.push(if smooth > threshold * noise { smooth - noise } else { 0.0 });
    }
    // A floor relative to the largest bin keeps the system solvable; constant data have no spectrum.
    let loudest = measured.iter().copied().fold(0.0, f64::max);
    measured.iter_mut().for_each(|s| *s = s.max(1e-12 * loudest));
    let cosines: Vec<f64> = (0..SEGMENT).map(|i| (std::f64::consts::TAU * i as f64 / SEGMENT as f64).cos()).collect();
    let correlation = |psd: &[f64], lag: usize| {
        let ends = psd[0] + psd[last] * cosines[last * lag % SEGMENT];
        ends + 2.0 * (1..last).map(|k| psd[k] * cosines[k * lag % SEGMENT]).sum::<f64>()
    };
    let r: Vec<f64> = (0..=2 * HALF_LENGTH).map(|lag| correlation(&measured, lag)).collect();
    let right = DVector::from_fn(HALF_LENGTH + 1, |k, _| correlation(&signal, k));
    let left =
        DMatrix::from_fn(
            HALF_LENGTH + 1,
            HALF_LENGTH + 1,
            |k, j| if j == 0 { r[k] } else { r[k.abs_diff(j)] + r[k + j] },
        );
    Ok(left.lu().solve(&right).map_or_else(|| vec![0.0; HALF_LENGTH + 1], |h| h.as_slice().to_vec()))
}
