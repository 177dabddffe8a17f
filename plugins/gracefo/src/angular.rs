//! What a measured angular acceleration says of the true one: `E[α | measured α]`.
//!
//! An offset fitted to `α + n` is pulled towards zero by `S_α/(S_α + S_n)` (errors in variables); fitted to
//! `α̂ = E[α | α + n]` it is not, because what α̂ lacks has nothing to do with α̂. Per axis, α̂ is a symmetric (zero-phase)
//! Wiener filter of what was measured: `S_n` is the mission's, `S_m` comes from the very samples that are filtered, a
//! [`BLOCK`] at a time. A spectrum from other times would not do: in a calibration manoeuvre after quiet hours the
//! filter of the quiet hours would give nearly nothing, and the offset would come out many times too large.
//!
//! `W = max(0, 1 − S_n/S_m)` changes from bin to bin faster than a short filter can. The filter is the exact solution
//! for its length (Wiener–Hopf): then `⟨α̂ (α − α̂)⟩ = 0` whatever its resolution.
//!
//! What remains, by theory: from K averages per bin, the slope is short by about `⟨S_n²/S_m⟩ / (K ⟨S_α²/S_m⟩)`, a hundredth
//! where signal and noise are equal. Axes are filtered one by one: where the angular accelerations about two axes go
//! together *and* are small against their noise, each could still tell of the other, and some bias is left.

use std::collections::VecDeque;

use dragfree_physics::noise::NoiseShape;
use dragfree_physics::spectrum::{SpectrumError, welch};
use nalgebra::{DMatrix, DVector};
use serde::{Deserialize, Serialize};

/// Samples of a spectrum's segment.
const SEGMENT: usize = 512;

/// Samples before and after that the filter sees: a row this near to a gap, or to an end of the data, has no value.
pub const REACH: usize = 128;

/// Samples that share a filter, 27 minutes at 10 Hz.
pub const BLOCK: usize = 16_384;

/// Fewest samples that give a spectrum: seven segments. A shorter stretch between two gaps stays as measured.
pub const FEWEST: usize = 2_048;

/// Longest run of missing samples over which the filter sees a straight line. The missing rows stay missing.
pub const BRIDGED: usize = 3;

/// Most rows that are held back: the lag.
pub const MOST_PENDING: usize = BLOCK + FEWEST + BRIDGED;

/// Lowest bin that the spectrum's straight lines leave as it is.
const LOWEST: usize = 2;

/// Variance of `(1, 2, 1)/4` over neighbouring Hann bins, whose powers go together by 4/9 and 1/36, against one bin.
const SMOOTHED: f64 = 0.6;

/// A bin whose excess over the noise is less than so many standard deviations holds no signal: noise alone would
/// otherwise pass the filter wherever it happens to be strong.
const SIGNIFICANT: f64 = 2.0;

/// Bins of a band in which the measured spectrum may show that the mission overstates its noise, and by how many
/// standard deviations it must.
const BAND: usize = 16;
const OVERSTATED: f64 = 4.0;

/// One epoch.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Row {
    /// Epoch, ns of the tables' time scale.
    pub time_ns: i64,
    /// Angular acceleration, SRF, rad s⁻²; none when any axis is missing.
    pub alpha_srf_rad_s2: Option<[f64; 3]>,
    /// Angular rate, SRF, rad s⁻¹; it only travels along.
    pub omega_srf_rad_s: Option<[f64; 3]>,
}

/// What became of the rows.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Counts {
    /// Rows with `E[α | measured α]`.
    pub filtered: u64,
    /// Rows as measured, in stretches too short for a spectrum.
    pub as_measured: u64,
    /// Rows too near to a gap.
    pub near_gap: u64,
}

/// What must survive a checkpoint.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct State {
    /// Rows since the last gap: first those of the block before that the filter still sees, then those to come.
    rows: VecDeque<Row>,
    /// How many of them are given already.
    given: usize,
    /// Missing samples at the end.
    missing: usize,
    /// Mean of the stretch's first block per axis, rad s⁻²: the instrument's bias, which no filter shall change.
    level: Option<[f64; 3]>,
    counts: Counts,
}

/// The filter. Its answers depend on the rows alone.
#[derive(Debug)]
pub struct Wiener {
    noise: NoiseShape,
    rate_hz: f64,
    step_ns: i64,
    state: State,
}

impl Wiener {
    /// For samples `step_ns` apart with the noise `noise`, rad s⁻².
    #[must_use]
    pub fn new(noise: NoiseShape, step_ns: i64) -> Self {
        Self { noise, rate_hz: 1e9 / step_ns as f64, step_ns, state: State::default() }
    }

    /// Takes the next epoch's row, and hands on those that are ready, in order.
    ///
    /// # Errors
    /// [`SpectrumError::Transform`].
    pub fn next(&mut self, row: Row, give: &mut impl FnMut(Row)) -> Result<(), SpectrumError> {
        let s = &mut self.state;
        // A grid that follows a clock slightly too fast moves its epochs by a part of a step every few minutes, while the samples
        // go on evenly. Only more than half a step is a gap.
        if s.rows
            .back()
            .is_some_and(|before| (row.time_ns - before.time_ns - self.step_ns).abs() > self.step_ns / 2 + 1)
        {
            self.finish(give)?;
        }
        let s = &mut self.state;
        if s.rows.is_empty() && row.alpha_srf_rad_s2.is_none() {
            give(row);
            return Ok(());
        }
        s.rows.push_back(row);
        s.missing = if row.alpha_srf_rad_s2.is_some() { 0 } else { s.missing + 1 };
        if s.missing > BRIDGED {
            self.finish(give)
        } else if s.rows.len() - s.given - s.missing >= BLOCK + FEWEST {
            self.block(BLOCK, give)
        } else {
            Ok(())
        }
    }

    /// There is nothing more, or a gap: hands on what was held back.
    ///
    /// # Errors
    /// [`SpectrumError::Transform`].
    pub fn finish(&mut self, give: &mut impl FnMut(Row)) -> Result<(), SpectrumError> {
        let s = &mut self.state;
        let gap = s.rows.split_off(s.rows.len() - s.missing);
        let pending = s.rows.len() - s.given;
        if pending >= FEWEST {
            self.block(pending, give)?;
        } else {
            // Only a whole stretch can be so short: a block is not given before as many rows follow it.
            let rows = s.rows.drain(s.given..);
            rows.for_each(|row| {
                s.counts.as_measured += u64::from(row.alpha_srf_rad_s2.is_some());
                give(row);
            });
        }
        gap.into_iter().for_each(give);
        self.state = State { counts: self.state.counts, ..State::default() };
        Ok(())
    }

    /// What became of the rows so far.
    #[must_use]
    pub fn counts(&self) -> Counts {
        self.state.counts
    }

    /// The state as bytes.
    ///
    /// # Errors
    /// None that a state of numbers could meet.
    pub fn save(&self) -> Result<serde_json::Value, serde_json::Error> {
        serde_json::to_value(&self.state)
    }

    /// Takes a state back.
    ///
    /// # Errors
    /// The value is no state of a filter.
    pub fn load(&mut self, state: serde_json::Value) -> Result<(), serde_json::Error> {
        self.state = serde_json::from_value(state)?;
        Ok(())
    }

    /// Gives the first `count` pending rows, all filtered by their own spectrum.
    fn block(&mut self, count: usize, give: &mut impl FnMut(Row)) -> Result<(), SpectrumError> {
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
                let inside = k >= REACH && k + REACH < s.rows.len();
                row.alpha_srf_rad_s2 = inside.then(|| [0, 1, 2].map(|i| level[i] + filtered(&columns[i], &taps[i], k)));
                *(if inside { &mut s.counts.filtered } else { &mut s.counts.near_gap }) += 1;
            }
            give(row);
        }
        let seen = block.end - REACH.min(block.end);
        s.rows.drain(..seen);
        s.given = block.end - seen;
        Ok(())
    }
}

/// Per axis, the rows' values with straight lines over what is missing.
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
    // What the filter still sees of the block before may begin with a missing sample.
    for k in 0..known.first().copied().unwrap_or(0) {
        for (i, column) in columns.iter_mut().enumerate() {
            column[k] = value(known[0], i);
        }
    }
    columns
}

/// `Σ h_|j| x_{k+j}`.
fn filtered(x: &[f64], taps: &[f64], k: usize) -> f64 {
    let pairs = taps.iter().enumerate().skip(1).map(|(j, h)| h * (x[k - j] + x[k + j]));
    taps[0] * x[k] + pairs.sum::<f64>()
}

/// The symmetric filter `h_0 … h_REACH` that gives the mean of the signal in `x`, given `x` and its noise:
/// `Σ_j h_|j| R_m(k−j) = R_α(k)` for `|k| ≤ REACH`, the autocorrelations from `S_m` and `W S_m`.
fn wiener(x: &[f64], noise: &NoiseShape, rate_hz: f64) -> Result<Vec<f64>, SpectrumError> {
    let spectrum = welch(x, rate_hz, SEGMENT)?;
    let last = spectrum.psd.len() - 1;
    let bin_hz = spectrum.frequency_hz[1];
    // No noise is larger than what was measured, whatever the mission says.
    let overstated = (LOWEST..last).step_by(BAND).filter_map(|k| {
        let ratio = spectrum.ratio((k as f64 - 0.5) * bin_hz..((k + BAND) as f64 - 0.5) * bin_hz, |f| noise.psd(f))?;
        (ratio.value < 1.0 - OVERSTATED * ratio.sigma).then_some(ratio.value)
    });
    let share = overstated.fold(1.0, f64::min);
    // Below the lowest bin the spectrum is not known, and Nyquist's bin is half of one.
    let inside = |k: usize| k.clamp(LOWEST, last - 1);
    let threshold = 1.0 + SIGNIFICANT * (2.0 * SMOOTHED / spectrum.dof()).sqrt();
    let (mut measured, mut signal) = (Vec::with_capacity(last + 1), Vec::with_capacity(last + 1));
    for k in (0..=last).map(inside) {
        let smooth = 0.25 * (spectrum.psd[inside(k - 1)] + spectrum.psd[inside(k + 1)]) + 0.5 * spectrum.psd[k];
        let noise = share * noise.psd(spectrum.frequency_hz[k]);
        measured.push(smooth);
        signal.push(if smooth > threshold * noise { smooth - noise } else { 0.0 });
    }
    // What is far below the loudest bin is told apart no more, and constant data have no spectrum at all.
    let loudest = measured.iter().copied().fold(0.0, f64::max);
    measured.iter_mut().for_each(|s| *s = s.max(1e-12 * loudest));
    let cosines: Vec<f64> = (0..SEGMENT).map(|i| (std::f64::consts::TAU * i as f64 / SEGMENT as f64).cos()).collect();
    let correlation = |psd: &[f64], lag: usize| {
        let ends = psd[0] + psd[last] * cosines[last * lag % SEGMENT];
        ends + 2.0 * (1..last).map(|k| psd[k] * cosines[k * lag % SEGMENT]).sum::<f64>()
    };
    let r: Vec<f64> = (0..=2 * REACH).map(|lag| correlation(&measured, lag)).collect();
    let right = DVector::from_fn(REACH + 1, |k, _| correlation(&signal, k));
    let left = DMatrix::from_fn(REACH + 1, REACH + 1, |k, j| if j == 0 { r[k] } else { r[k.abs_diff(j)] + r[k + j] });
    Ok(left.lu().solve(&right).map_or_else(|| vec![0.0; REACH + 1], |h| h.as_slice().to_vec()))
}
