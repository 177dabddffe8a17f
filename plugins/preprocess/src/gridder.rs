//! Turns irregular tables into one uniform table.
//!
//! Every decision depends on the telemetry alone, not on batch boundaries: a row is processed when all rows that can
//! influence it have arrived. In order:
//! 1. [`Series`] checks and cleans the rows of each table.
//! 2. The first ten minutes determine the reference table and the slow tables.
//! 3. The reference defines the epochs ([`Epochs`]); samples of the other fast tables are assigned to them.
//! 4. Stuck samples and outliers are blanked in blocks of [`BLOCK`] rows.
//! 5. Slow tables are interpolated to the epochs, and the rows are emitted.

use crate::clock::{Epochs, Place, Rate};
use crate::layout::{Mandatory, TableSpec};
use crate::outliers::{self, BLOCK, MARGIN};
use crate::series::{LATEST_NS, Reason, Series, Tally, Window};
use dragfree_physics::mission::MOST_TEST_MASSES;
use dragfree_sdk::state::{State, StateError};

/// Duration of telemetry from which rates are measured, before and after the first mandatory row.
const RATE_WINDOW_NS: i64 = 600_000_000_000;

/// Number of samples that must agree on a new phase before a clock jump is declared.
const PHASE_SAMPLES: usize = 20;

/// Blank rows inserted before a gap too long to fill, s, so that later stages reset their memory.
const MAX_BLANK_S: f64 = 600.0;

/// Emitted rows kept for the outlier test of the rows that follow.
const HISTORY: i64 = MARGIN as i64;

/// Maximum number of waiting rows, and of rows per call. It bounds memory when a long gap becomes rows at once.
pub(crate) const MAX_ROWS: i64 = 65_536;

/// Settings.
#[derive(Clone, Debug)]
pub(crate) struct Config {
    /// Rate of the grid, Hz.
    pub(crate) rate_hz: f64,
    /// Threshold of the outlier test in standard deviations of the second difference; 0 for none.
    pub(crate) outlier_sigma: f64,
    /// Number of equal consecutive samples that count as stuck; 0 disables the test.
    pub(crate) stuck_samples: u32,
    /// Number of its own intervals over which a slow table is interpolated, and held after its last row.
    pub(crate) hold_intervals: f64,
    /// Longest gap that is filled with blank rows, s.
    pub(crate) max_gap_s: f64,
    /// Epochs before this time belong to no product and are not counted, Unix ns.
    pub(crate) counted_from_ns: i64,
}

/// Destination of the rows.
pub(crate) trait Sink {
    /// Epochs, Unix ns.
    fn times(&mut self) -> &mut Vec<i64>;
    /// Values of a column of a table.
    fn column(&mut self, table: usize, column: usize) -> &mut Vec<f64>;
    /// Age of the latest row of a table at each epoch, s, if requested.
    fn age(&mut self, table: usize) -> Option<&mut Vec<f64>>;
}

/// Run of equal samples of one column.
#[derive(Clone, Copy, Debug, Default)]
struct Run {
    bits: u64,
    length: u32,
    /// Whether the column has been nonzero. One that is zero throughout is not stuck: producers leave zero what they do
    /// not measure.
    moved: bool,
}

/// A table whose samples are assigned to epochs.
#[derive(Clone, Debug)]
struct Fast {
    /// Phase of the samples after the epochs, ns; `None` before the first sample.
    phase_ns: Option<i64>,
    /// Row of the last sample assigned.
    last_row: i64,
    /// Whether `last_row` is blank because of a second sample or a clock jump.
    crowded: bool,
    /// Number of rows with a sample.
    filled: u64,
    /// Values of the waiting rows, per column.
    cells: Vec<Window<f64>>,
    runs: Vec<Run>,
}

/// Treatment of a table.
#[derive(Clone, Debug)]
enum Class {
    Fast(Fast),
    /// Interpolated; interval, ns.
    Slow(i64),
}

/// Consecutive unusable epochs.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct EpochRun {
    pub(crate) rows: u64,
    pub(crate) from_ns: i64,
}

/// Counts for the report.
#[derive(Clone, Debug, Default)]
pub(crate) struct Summary {
    pub(crate) used: u64,
    pub(crate) rejected: u64,
    /// Epochs before those of the product.
    early: u64,
    pub(crate) longest: EpochRun,
    current: EpochRun,
    /// Gaps too long to fill: number, and the longest with its start, ns.
    pub(crate) cut_gaps: u64,
    pub(crate) longest_cut_ns: i64,
    pub(crate) longest_cut_from_ns: i64,
    /// Jumps of the reference's clock: number, and time of the first.
    pub(crate) rephased: u64,
    pub(crate) first_rephased_ns: i64,
}

/// Properties of a table, for the report.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct TableSummary {
    pub(crate) name: String,
    pub(crate) interval_s: Option<f64>,
    pub(crate) interpolated: bool,
    pub(crate) phase_s: Option<f64>,
    pub(crate) missing: Option<u64>,
    pub(crate) absent: Vec<String>,
}

/// Builds the grid.
#[derive(Clone, Debug)]
pub(crate) struct Gridder {
    config: Config,
    pub(crate) tables: Vec<Series>,
    classes: Vec<Class>,
    /// Median interval in the first ten minutes, ns; 0 if unknown.
    intervals: Vec<i64>,
    /// Index of the reference table, once it is known.
    reference: Option<usize>,
    epochs: Epochs,
    /// All telemetry rows before this time have arrived, Unix ns.
    complete_ns: i64,
    /// Time of the first row of a mandatory table.
    first_ns: Option<i64>,
    /// Time of the last processed row of the reference, Unix ns.
    last_reference_ns: i64,
    /// First row of `cells`; rows count from 0.
    base: i64,
    /// Numbers of rows created, checked for stuck samples, checked for outliers, and emitted.
    rows: i64,
    stuck_checked: i64,
    outliers_checked: i64,
    emitted: i64,
    pub(crate) summary: Summary,
    scratch: Vec<f64>,
    mask: Vec<u64>,
}

impl Gridder {
    pub(crate) fn new(config: Config, specs: Vec<TableSpec>) -> Self {
        let rate = Rate::new(config.rate_hz);
        let count = specs.len();
        Self {
            config,
            tables: specs.into_iter().map(Series::new).collect(),
            classes: Vec::new(),
            intervals: vec![0; count],
            reference: None,
            epochs: Epochs::new(rate),
            complete_ns: 0,
            first_ns: None,
            last_reference_ns: 0,
            base: 0,
            rows: 0,
            stuck_checked: 0,
            outliers_checked: 0,
            emitted: 0,
            summary: Summary::default(),
            scratch: Vec::new(),
            mask: Vec::new(),
        }
    }

    /// Adds rows of a table in telemetry order.
    pub(crate) fn take(&mut self, table: usize, times: &[i64], columns: &[&[f64]]) {
        self.tables[table].take(times, columns);
    }

    /// Emits the rows that are ready, at most [`MAX_ROWS`]. All rows before `complete_ns` have been added.
    pub(crate) fn advance(&mut self, complete_ns: i64, sink: &mut impl Sink) {
        // At the end of the data hosts pass a time beyond all rows; a later day may still add rows.
        let complete_ns = if complete_ns < LATEST_NS { complete_ns } else { self.after_last_row() };
        self.complete_ns = self.complete_ns.max(complete_ns);
        let first = self.emitted;
        while self.step(false, first + MAX_ROWS, sink) {}
    }

    fn after_last_row(&self) -> i64 {
        self.tables.iter().filter_map(|t| t.times.as_slice().last()).max().map_or(0, |last| last + 1)
    }

    /// Ends the data: emits the remaining rows.
    pub(crate) fn flush(&mut self, sink: &mut impl Sink) {
        self.complete_ns = self.complete_ns.max(self.after_last_row());
        while self.step(true, i64::MAX, sink) {}
        // The grid ends with the reference, so no later row gets an epoch.
        for (series, class) in self.tables.iter_mut().zip(&self.classes) {
            if matches!(class, Class::Fast(_)) {
                let rest = series.times.len();
                series.tally.add(Reason::Outside, rest as u64);
                series.drop_front(rest);
            }
        }
    }

    /// Advances every step once; true if another call may emit more rows.
    fn step(&mut self, flush: bool, most: i64, sink: &mut impl Sink) -> bool {
        if !self.measure_rates(flush) {
            return false;
        }
        let rows = self.rows;
        let (mut settled_ns, blocked) = self.place_reference(flush);
        for table in 0..self.tables.len() {
            if Some(table) != self.reference {
                settled_ns = settled_ns.min(self.place_samples(table, flush));
            }
        }
        // Block boundaries must not depend on the number of waiting rows.
        self.clean(settled_ns, flush && !blocked);
        let emitted = self.emitted;
        self.emit(most, flush, sink);
        self.emitted < most && (self.emitted > emitted || self.rows > rows)
    }

    // ---- 2. rates and reference ----

    /// Determines rates and the reference table; false while telemetry is insufficient.
    fn measure_rates(&mut self, flush: bool) -> bool {
        if self.reference.is_some() {
            return true;
        }
        let mandatory = |t: &&Series| t.spec.mandatory;
        let first = self.tables.iter().filter(mandatory).filter_map(|t| t.times.as_slice().first()).min();
        self.first_ns = self.first_ns.or(first.copied());
        let Some(first_ns) = self.first_ns else {
            self.drop_early_rows(self.complete_ns);
            return false;
        };
        if !flush && self.complete_ns < first_ns.saturating_add(RATE_WINDOW_NS) {
            return false;
        }
        self.drop_early_rows(first_ns);
        let end_ns = first_ns.saturating_add(RATE_WINDOW_NS);
        let period_ns = self.epochs.rate.part_ns(1.0);
        self.intervals = self.tables.iter().map(|t| median_interval(t.times.as_slice(), end_ns)).collect();
        self.classes = (0..self.tables.len()).map(|t| self.class_of(t, period_ns)).collect();
        // The densest mandatory table; the first of those whose intervals agree within 10 %.
        let mut best: Option<(usize, i64)> = None;
        for (t, series) in self.tables.iter().enumerate().filter(|(_, t)| t.spec.mandatory) {
            let interval = if self.intervals[t] > 0 { self.intervals[t] } else { i64::MAX / 10 };
            let begun = series.times.as_slice().first().is_some_and(|time| *time < end_ns);
            if begun && best.is_none_or(|(_, b)| interval < b / 10 * 9) {
                best = Some((t, interval));
            }
        }
        self.reference = best.map(|(t, _)| t);
        self.reference.is_some()
    }

    fn class_of(&self, table: usize, period_ns: i64) -> Class {
        let spec = &self.tables[table].spec;
        let stated_ns = spec.stated_rate_hz.map(|rate| (1e9 / rate) as i64);
        // Housekeeping with fewer than three rows in that time is slower than it can tell.
        let usual_ns = match () {
            () if spec.never_interpolated => period_ns,
            () if spec.name == "ephemeris" => 60_000_000_000,
            () => RATE_WINDOW_NS,
        };
        let interval_ns = match self.intervals[table] {
            0 => stated_ns.unwrap_or(usual_ns),
            measured => measured,
        };
        // Housekeeping at the grid's rate or above, with 5 % margin for jitter, has a value in every epoch.
        if spec.never_interpolated || interval_ns <= period_ns / 20 * 21 {
            Class::Fast(Fast::new(spec.columns.len()))
        } else {
            Class::Slow(interval_ns)
        }
    }

    /// Drops rows long before the first epoch.
    fn drop_early_rows(&mut self, first_ns: i64) {
        for series in &mut self.tables {
            let early = series.times.as_slice().partition_point(|t| *t < first_ns.saturating_sub(RATE_WINDOW_NS));
            series.tally.add(Reason::Outside, early as u64);
            series.drop_front(early);
        }
    }

    // ---- 3. epochs and samples ----

    /// Assigns the reference's samples and creates rows for them. Returns the time up to which that is final, and
    /// whether the limit of waiting rows was reached.
    fn place_reference(&mut self, flush: bool) -> (i64, bool) {
        let Some(reference) = self.reference else { return (0, false) };
        let rate = self.epochs.rate;
        let agree_ns = rate.offset_ns(PHASE_SAMPLES as i64);
        let off_limit_ns = rate.part_ns(0.25);
        let mut placed: Vec<i64> = Vec::new();
        let mut used = 0;
        let mut blocked = false;
        while let Some(&time) = self.tables[reference].times.as_slice().get(used) {
            if time >= self.complete_ns {
                break;
            }
            let ready = flush || self.complete_ns >= time.saturating_add(agree_ns);
            if !self.epochs.begun() || (time - self.last_reference_ns) as f64 > self.config.max_gap_s * 1e9 {
                if !ready {
                    break;
                }
                self.begin_segment(reference, used, time);
            }
            let (mut row, off_ns) = self.epochs.newest(time);
            let mut off_phase = false;
            if off_ns.abs() > off_limit_ns {
                if !ready {
                    break;
                }
                if let Some(phase) = self.agreed_phase(reference, used, time) {
                    // The last row of the old phase, half to one and a half intervals back, is blanked.
                    let (last, _) = self.epochs.newest(time - rate.part_ns(1.0));
                    let last = last.max(self.rows - 1);
                    if !self.make_rows(last + 1) {
                        blocked = true;
                        break;
                    }
                    self.grow_cells();
                    self.copy_samples(reference, &placed, used - placed.len());
                    placed.clear();
                    self.blank_row(last);
                    // Epochs must advance by half an interval: a clock that jumps back loses its first sample.
                    let lost = time + phase - self.epochs.time_ns(last) < rate.part_ns(0.55);
                    let origin = time + phase + if lost { rate.offset_ns(1) } else { 0 };
                    self.epochs.begin(last + 1, origin);
                    self.tables[reference].tally.add(Reason::ClockJump, 1);
                    if self.summary.rephased == 0 {
                        self.summary.first_rephased_ns = time;
                    }
                    self.summary.rephased += 1;
                    row = if lost { -1 } else { last + 1 };
                } else {
                    off_phase = true;
                }
            }
            if !self.make_rows(row + 1) {
                blocked = true;
                break;
            }
            self.tables[reference].tally.add(Reason::OffPhase, u64::from(off_phase));
            self.last_reference_ns = time;
            placed.push(row);
            used += 1;
        }
        self.grow_cells();
        self.copy_samples(reference, &placed, used - placed.len());
        let waiting = self.tables[reference].times.as_slice().get(used).copied();
        self.tables[reference].drop_front(used);
        (waiting.unwrap_or(self.complete_ns).min(self.complete_ns), blocked)
    }

    /// Begins the first segment, or one after a gap too long to fill.
    fn begin_segment(&mut self, reference: usize, at: usize, time: i64) {
        let rate = self.epochs.rate;
        let phase = rate.phase(time, self.following(reference, at, time));
        if self.epochs.begun() {
            let gap_ns = time - self.last_reference_ns;
            self.summary.cut_gaps += 1;
            if gap_ns > self.summary.longest_cut_ns {
                self.summary.longest_cut_ns = gap_ns;
                self.summary.longest_cut_from_ns = self.last_reference_ns;
            }
            // The phase may be another: epochs must advance by half an interval at least.
            let latest_ns = time + phase - rate.part_ns(0.5);
            let blank = self.blank_rows_before_cut();
            let before = |count: &i64| self.epochs.time_ns(self.rows + count - 1) <= latest_ns;
            self.rows += (1..=blank).rev().find(before).unwrap_or(1);
        }
        self.epochs.begin(self.rows, time + phase);
        self.last_reference_ns = time;
    }

    /// Number of blank rows before a gap too long to fill.
    fn blank_rows_before_cut(&self) -> i64 {
        ((MAX_BLANK_S.min(self.config.max_gap_s) * self.config.rate_hz) as i64).max(1)
    }

    /// Times of the table within the span in which samples must agree on a phase.
    fn following(&self, table: usize, at: usize, time: i64) -> &[i64] {
        let times = &self.tables[table].times.as_slice()[at..];
        let end_ns = time.saturating_add(self.epochs.rate.offset_ns(PHASE_SAMPLES as i64));
        &times[..times.partition_point(|t| *t < end_ns)]
    }

    /// Median phase of the samples from `time` on relative to `time`, if they agree within an eighth of a period.
    fn agreed_phase(&self, table: usize, at: usize, time: i64) -> Option<i64> {
        let rate = self.epochs.rate;
        let times = self.following(table, at, time);
        let limit = rate.part_ns(0.125);
        let agree = times.len() >= PHASE_SAMPLES / 2 && times.iter().all(|t| rate.wrap(t - time).abs() <= limit);
        agree.then(|| rate.phase(time, times))
    }

    /// Creates rows up to `rows`, whose cells [`Self::grow_cells`] adds; false if the limit of waiting rows is reached.
    fn make_rows(&mut self, rows: i64) -> bool {
        let most = self.emitted + MAX_ROWS;
        if self.rows < rows {
            self.rows = rows.min(most).max(self.rows);
        }
        self.rows >= rows
    }

    /// Adds blank cells for new rows.
    fn grow_cells(&mut self) {
        let length = (self.rows - self.base) as usize;
        for class in &mut self.classes {
            if let Class::Fast(fast) = class {
                for cells in &mut fast.cells {
                    cells.grow(length - cells.len(), f64::NAN);
                }
            }
        }
    }

    /// Blanks a row of every fast table before a jump of the reference's clock.
    fn blank_row(&mut self, row: i64) {
        for table in 0..self.tables.len() {
            self.blank(table, row);
        }
    }

    fn blank(&mut self, table: usize, row: i64) {
        let at = row - self.base;
        if let (Class::Fast(fast), true) = (&mut self.classes[table], at >= 0)
            && fast.last_row == row
            && !fast.crowded
        {
            for cells in &mut fast.cells {
                cells.as_mut_slice()[at as usize] = f64::NAN;
            }
            fast.crowded = true;
            fast.filled -= 1;
            self.tables[table].tally.rows_placed -= 1;
            self.tables[table].tally.add(Reason::BeforeJump, 1);
        }
    }

    /// Assigns another table's samples to existing rows. Returns the time up to which that is final.
    fn place_samples(&mut self, table: usize, flush: bool) -> i64 {
        let Class::Fast(fast) = &self.classes[table] else { return i64::MAX };
        let mut phase_ns = fast.phase_ns;
        let rate = self.epochs.rate;
        let agree_ns = rate.offset_ns(PHASE_SAMPLES as i64);
        let off_limit_ns = rate.part_ns(0.25);
        // Epochs before this time are final.
        let reference_next = self.reference.and_then(|r| self.tables[r].times.as_slice().first().copied());
        let final_ns = reference_next.unwrap_or(self.complete_ns).min(self.complete_ns) - rate.part_ns(1.0);
        let long_gap = (final_ns - self.last_reference_ns) as f64 > self.config.max_gap_s * 1e9;
        let mut placed: Vec<i64> = Vec::new();
        let mut used = 0;
        while let Some(&time) = self.tables[table].times.as_slice().get(used) {
            if !flush && time >= final_ns || time >= self.complete_ns {
                break;
            }
            let ready = flush || self.complete_ns >= time.saturating_add(agree_ns);
            if phase_ns.is_none()
                && let Place::Row(row) = self.epochs.place(time)
            {
                if !ready {
                    break;
                }
                phase_ns = Some(rate.phase(self.epochs.time_ns(row), self.following(table, used, time)));
            }
            let phase = phase_ns.unwrap_or(0);
            let mut place = self.epochs.place(time - phase);
            if let Place::Row(row) = place {
                if row >= self.rows {
                    if !long_gap || row < self.rows + self.blank_rows_before_cut() {
                        break;
                    }
                    place = Place::Nowhere;
                } else {
                    let off_ns = time - phase - self.epochs.time_ns(row);
                    if off_ns.abs() > off_limit_ns {
                        if !ready {
                            break;
                        }
                        if let Some(change) = self.agreed_phase(table, used, time) {
                            self.copy_samples(table, &placed, used - placed.len());
                            placed.clear();
                            self.tables[table].tally.add(Reason::ClockJump, 1);
                            let new = rate.wrap(time + change - self.epochs.time_ns(row));
                            phase_ns = Some(new);
                            place = self.epochs.place(time - new);
                            if let Place::Row(row) = place {
                                self.blank(table, row - 1);
                                if row >= self.rows {
                                    break;
                                }
                            }
                        } else {
                            self.tables[table].tally.add(Reason::OffPhase, 1);
                        }
                    }
                }
            }
            placed.push(if let Place::Row(row) = place { row } else { -1 });
            used += 1;
        }
        self.copy_samples(table, &placed, used - placed.len());
        if let Class::Fast(fast) = &mut self.classes[table] {
            fast.phase_ns = phase_ns;
        }
        let series = &mut self.tables[table];
        let waiting = series.times.as_slice().get(used).copied();
        series.drop_front(used);
        waiting.unwrap_or(final_ns).min(final_ns)
    }

    /// Copies samples, from the `from`-th waiting one on, into the cells of their rows.
    fn copy_samples(&mut self, table: usize, rows: &[i64], from: usize) {
        let Class::Fast(fast) = &mut self.classes[table] else { return };
        let series = &mut self.tables[table];
        let mut one_per_row = rows.first().is_none_or(|r| *r > fast.last_row && *r >= self.emitted);
        one_per_row &= rows.windows(2).all(|w| w[0] < w[1]);
        let base = self.base;
        if one_per_row {
            for (cells, source) in fast.cells.iter_mut().zip(&series.columns) {
                let cells = cells.as_mut_slice();
                let source = &source.as_slice()[from..from + rows.len()];
                for (row, v) in rows.iter().zip(source) {
                    cells[(row - base) as usize] = *v;
                }
            }
            if let Some(last) = rows.last() {
                (fast.last_row, fast.crowded) = (*last, false);
            }
            fast.filled += rows.len() as u64;
            series.tally.rows_placed += rows.len() as u64;
            return;
        }
        for (k, row) in rows.iter().enumerate() {
            if *row < self.emitted || *row < fast.last_row {
                series.tally.add(Reason::Outside, 1);
            } else if *row == fast.last_row && series.spec.never_interpolated {
                // Two samples for one epoch: the clock slipped, and neither is used.
                series.tally.add(Reason::Crowded, if fast.crowded { 1 } else { 2 });
                if !fast.crowded {
                    fast.crowded = true;
                    fast.filled -= 1;
                    series.tally.rows_placed -= 1;
                }
                fast.cells.iter_mut().for_each(|c| c.as_mut_slice()[(row - base) as usize] = f64::NAN);
            } else {
                // Of housekeeping faster than the grid the last value of an epoch stands.
                for (cells, source) in fast.cells.iter_mut().zip(&series.columns) {
                    cells.as_mut_slice()[(row - base) as usize] = source.as_slice()[from + k];
                }
                fast.filled += u64::from(*row != fast.last_row);
                (fast.last_row, fast.crowded) = (*row, false);
                series.tally.rows_placed += 1;
            }
        }
    }

    // ---- 4. stuck and outlying samples ----

    /// Blanks stuck samples in all final rows, and outliers in complete blocks of them.
    fn clean(&mut self, settled_ns: i64, flush: bool) {
        let mut settled = self.rows;
        if !flush {
            let limit = settled_ns.saturating_sub(self.epochs.rate.part_ns(3.0));
            let earlier = self.stuck_checked;
            while settled > earlier && self.epochs.time_ns(settled - 1) >= limit {
                settled = match self.epochs.place(limit) {
                    // Direct lookup if the last segment reaches back far enough.
                    Place::Row(row) if row < settled - 1 && self.epochs.time_ns(row) < limit => row + 1,
                    _ => settled - 1,
                };
            }
        }
        self.remove_stuck(settled);
        let margin = MARGIN as i64 + i64::from(self.config.stuck_samples);
        while self.outliers_checked < self.stuck_checked {
            let end = (self.outliers_checked + BLOCK as i64).min(self.stuck_checked);
            if !flush && self.outliers_checked + BLOCK as i64 + margin > self.stuck_checked {
                break;
            }
            self.remove_outliers(self.outliers_checked, end);
            self.outliers_checked = end;
        }
    }

    /// Blanks stuck samples up to row `end`.
    fn remove_stuck(&mut self, end: i64) {
        let stuck = self.config.stuck_samples;
        let (from, to) =
            ((self.stuck_checked - self.base) as usize, (end.max(self.stuck_checked) - self.base) as usize);
        for (class, series) in self.classes.iter_mut().zip(&mut self.tables) {
            let Class::Fast(fast) = class else { continue };
            for (c, spec) in series.spec.columns.iter().enumerate() {
                if !spec.instrument || stuck == 0 {
                    continue;
                }
                let mut run = fast.runs[c];
                let cells = fast.cells[c].as_mut_slice();
                let mut blanked = 0;
                for k in from..to {
                    let v = cells[k];
                    if v.to_bits() != run.bits || v.is_nan() {
                        run.bits = v.to_bits();
                        run.length = u32::from(!v.is_nan());
                        run.moved |= v.abs() > 0.0;
                        continue;
                    }
                    run.length = (run.length + 1).min(stuck + 1);
                    if run.length < stuck || !run.moved {
                        continue;
                    }
                    let start = if run.length == stuck { (k + 1).saturating_sub(stuck as usize) } else { k };
                    cells[start..=k].fill(f64::NAN);
                    blanked += k + 1 - start;
                }
                fast.runs[c] = run;
                series.tally.add(Reason::Stuck, blanked as u64);
            }
        }
        self.stuck_checked = self.stuck_checked.max(end);
    }

    fn remove_outliers(&mut self, from: i64, to: i64) {
        let sigma = self.config.outlier_sigma;
        if sigma <= 0.0 {
            return;
        }
        let low = (from - HISTORY).max(self.base);
        let high = (to + HISTORY).min(self.stuck_checked);
        let window = (low - self.base) as usize..(high - self.base) as usize;
        let (from, to) = ((from - low) as usize, (to - low) as usize);
        for (class, series) in self.classes.iter_mut().zip(&mut self.tables) {
            let Class::Fast(fast) = class else { continue };
            for (c, _) in series.spec.columns.iter().enumerate().filter(|(_, spec)| spec.readout) {
                let x = &mut fast.cells[c].as_mut_slice()[window.clone()];
                let removed = outliers::remove(x, from, to, sigma, &mut self.scratch);
                series.tally.add(Reason::Outlier, removed);
            }
        }
    }

    // ---- 5. output ----

    /// Time after an epoch up to which slow tables must have arrived before the epoch is emitted, ns.
    fn look_ahead_ns(&self) -> i64 {
        let slow =
            self.classes.iter().filter_map(|c| if let Class::Slow(interval) = c { Some(*interval) } else { None });
        slow.map(|interval| max_interval_ns(interval, self.config.hold_intervals)).max().unwrap_or(0)
    }

    fn emit(&mut self, most: i64, flush: bool, sink: &mut impl Sink) {
        let mut end = self.outliers_checked.min(most);
        if !flush {
            let limit = self.complete_ns.saturating_sub(self.look_ahead_ns());
            while end > self.emitted && self.epochs.time_ns(end - 1) >= limit {
                end = match self.epochs.place(limit) {
                    Place::Row(row) if row < end - 1 && self.epochs.time_ns(row) < limit => row + 1,
                    _ => end - 1,
                };
            }
        }
        if end <= self.emitted {
            return;
        }
        let first = sink.times().len();
        sink.times().extend((self.emitted..end).map(|row| self.epochs.time_ns(row)));
        let times: Vec<i64> = sink.times()[first..].to_vec();
        let window = (self.emitted - self.base) as usize..(end - self.base) as usize;
        self.summarise(&times, window.clone());
        for table in 0..self.tables.len() {
            match &self.classes[table] {
                Class::Fast(fast) => {
                    for (c, cells) in fast.cells.iter().enumerate() {
                        sink.column(table, c).extend_from_slice(&cells.as_slice()[window.clone()]);
                    }
                    if let (Some(age), Some(cells)) = (sink.age(table), fast.cells.first()) {
                        let there = |v: &f64| if v.is_nan() { f64::NAN } else { 0.0 };
                        age.extend(cells.as_slice()[window.clone()].iter().map(there));
                    }
                }
                Class::Slow(interval) => {
                    let interval = *interval;
                    self.interpolate(table, interval, &times, sink);
                }
            }
        }
        self.emitted = end;
        let keep = (end - HISTORY).max(self.base);
        let drop = (keep - self.base) as usize;
        for class in &mut self.classes {
            if let Class::Fast(fast) = class {
                fast.cells.iter_mut().for_each(|c| c.drop_front(drop));
            }
        }
        self.base = keep;
        self.epochs.forget_before(keep);
    }

    /// Linear interpolation between rows of a slow table within the hold time; after the last row its value for the
    /// hold time, then NaN. Flags are held. The error over an interval T is at most `max|ẍ| T²/8`, which is negligible
    /// for orbits and directions at one packet per minute.
    fn interpolate(&mut self, table: usize, interval_ns: i64, epochs: &[i64], sink: &mut impl Sink) {
        let series = &mut self.tables[table];
        let times = series.times.as_slice();
        let max_interval = max_interval_ns(interval_ns, self.config.hold_intervals);
        let hold = (interval_ns as f64 * self.config.hold_intervals) as i64;
        // Row of the table before each epoch, with the weight of the next row; `None` beyond the hold time.
        let mut at = 0;
        let mut weights: Vec<Option<(usize, f64)>> = Vec::with_capacity(epochs.len());
        for &epoch in epochs {
            while times.get(at + 1).is_some_and(|t| *t <= epoch) {
                at += 1;
            }
            weights.push(match (times.get(at), times.get(at + 1)) {
                (Some(&t0), Some(&t1)) if t0 <= epoch && t1 - t0 <= max_interval => {
                    Some((at, (epoch - t0) as f64 / (t1 - t0) as f64))
                }
                (Some(&t0), _) if t0 <= epoch && epoch - t0 <= hold => Some((at, 0.0)),
                _ => None,
            });
        }
        for (c, spec) in series.spec.columns.iter().enumerate() {
            let values = series.columns[c].as_slice();
            sink.column(table, c).extend(weights.iter().map(|w| match *w {
                None => f64::NAN,
                Some((at, weight)) if weight > 0.0 && !spec.flag => values[at] + (values[at + 1] - values[at]) * weight,
                Some((at, _)) => values[at],
            }));
        }
        if let Some(age) = sink.age(table) {
            let since = |(epoch, w): (&i64, &Option<(usize, f64)>)| {
                w.map_or(f64::NAN, |(at, _)| (epoch - times[at]) as f64 * 1e-9)
            };
            age.extend(epochs.iter().zip(&weights).map(since));
        }
        series.tally.rows_placed += at as u64;
        series.drop_front(at);
    }

    /// Counts usable epochs: those with all common mandatory columns, and with all of at least one test mass.
    fn summarise(&mut self, times: &[i64], window: std::ops::Range<usize>) {
        // Bits: one for the common columns, and two per test mass, for x by either readout and for its other columns.
        const COMMON: u64 = 1 << (2 * MOST_TEST_MASSES);
        let (one, each) = (|tm: u8| 1u64 << tm, |tm: u8| 1u64 << (MOST_TEST_MASSES as u8 + tm));
        self.mask.clear();
        self.mask.resize(times.len(), (0..MOST_TEST_MASSES as u8).map(each).fold(COMMON, |all, bit| all | bit));
        let mut wanted = [0; MOST_TEST_MASSES];
        for (t, series) in self.tables.iter().enumerate() {
            let slow = Window::default();
            for (c, spec) in series.spec.columns.iter().enumerate() {
                if spec.mandatory == Mandatory::No {
                    continue;
                }
                let cells = if let Class::Fast(fast) = &self.classes[t] { &fast.cells[c] } else { &slow };
                let Some(cells) = cells.as_slice().get(window.clone()) else { continue };
                for (mask, v) in self.mask.iter_mut().zip(cells) {
                    let there = !v.is_nan();
                    match spec.mandatory {
                        Mandatory::OneOf(tm) => *mask |= if there { one(tm) } else { 0 },
                        Mandatory::EachOf(tm) => *mask &= if there { u64::MAX } else { !each(tm) },
                        _ => *mask &= if there { u64::MAX } else { !COMMON },
                    }
                }
                match spec.mandatory {
                    Mandatory::OneOf(tm) => wanted[usize::from(tm)] |= one(tm),
                    Mandatory::EachOf(tm) => wanted[usize::from(tm)] |= each(tm),
                    _ => {}
                }
            }
        }
        let whole = |mask: u64| {
            let mut masses = wanted.iter().filter(|w| **w != 0).peekable();
            mask & COMMON != 0 && (masses.peek().is_none() || masses.any(|w| mask & w == *w))
        };
        let summary = &mut self.summary;
        for (mask, time) in self.mask.iter().zip(times) {
            if *time < self.config.counted_from_ns {
                summary.early += 1;
                continue;
            }
            if whole(*mask) {
                summary.used += 1;
                summary.current.rows = 0;
                continue;
            }
            summary.rejected += 1;
            if summary.current.rows == 0 {
                summary.current.from_ns = *time;
            }
            summary.current.rows += 1;
            if summary.current.rows > summary.longest.rows {
                summary.longest = summary.current;
            }
        }
    }

    // ---- report and state ----

    /// Properties of each table, for the report.
    pub(crate) fn table_summaries(&self) -> Vec<TableSummary> {
        let emitted = self.summary.early + self.summary.used + self.summary.rejected;
        let describe = |(t, series): (usize, &Series)| {
            let fast = if let Some(Class::Fast(fast)) = self.classes.get(t) { Some(fast) } else { None };
            let absent = fast.map_or_else(Vec::new, |fast| {
                let still = |c: &usize| series.spec.columns[*c].instrument && !fast.runs[*c].moved && fast.filled > 0;
                let name = |c: usize| series.spec.columns[c].name.clone();
                (0..fast.runs.len()).filter(still).map(name).collect()
            });
            TableSummary {
                name: series.spec.name.clone(),
                interval_s: (self.intervals[t] > 0).then(|| self.intervals[t] as f64 * 1e-9),
                interpolated: matches!(self.classes.get(t), Some(Class::Slow(_))),
                phase_s: fast.and_then(|f| f.phase_ns).map(|p| p as f64 * 1e-9),
                missing: fast.map(|f| emitted.saturating_sub(f.filled)),
                absent,
            }
        };
        self.tables.iter().enumerate().map(describe).collect()
    }

    /// Name of the reference table.
    pub(crate) fn reference_name(&self) -> Option<&str> {
        self.reference.map(|r| self.tables[r].spec.name.as_str())
    }

    /// Resets the counts after a report.
    pub(crate) fn reset_counts(&mut self) {
        self.summary = Summary::default();
        for (t, series) in self.tables.iter_mut().enumerate() {
            series.tally = Tally::default();
            if let Some(Class::Fast(fast)) = self.classes.get_mut(t) {
                fast.filled = 0;
            }
        }
    }

    /// Saves the whole state, or restores it into a new gridder.
    pub(crate) fn visit(&mut self, state: &mut State<'_>) -> Result<(), StateError> {
        state.same("set of tables or parameters", &self.fingerprint())?;
        self.tables.iter_mut().try_for_each(|table| table.visit(state))?;
        state.i64_list(&mut self.intervals)?;
        let classes = state.count(self.classes.len())?;
        if self.intervals.len() != self.tables.len() || (classes != 0 && classes != self.tables.len()) {
            return Err(StateError::Content("tables"));
        }
        if state.is_loading() {
            self.classes =
                self.tables[..classes].iter().map(|t| Class::Fast(Fast::new(t.spec.columns.len()))).collect();
        }
        for class in &mut self.classes {
            let mut interval = if let Class::Slow(interval) = class { Some(*interval) } else { None };
            state.option(&mut interval, State::i64)?;
            match (interval, &mut *class) {
                (Some(interval), _) if interval <= 0 => return Err(StateError::Content("an interval")),
                (Some(interval), _) => *class = Class::Slow(interval),
                (None, Class::Fast(fast)) => fast.visit(state)?,
                (None, Class::Slow(_)) => return Err(StateError::Content("a kind of table")),
            }
        }
        state.option(&mut self.reference, State::usize)?;
        if self.reference.is_some_and(|r| r >= classes) {
            return Err(StateError::Content("a reference table"));
        }
        self.epochs.visit(state)?;
        state.option(&mut self.first_ns, State::i64)?;
        for counter in [
            &mut self.complete_ns,
            &mut self.last_reference_ns,
            &mut self.base,
            &mut self.rows,
            &mut self.stuck_checked,
            &mut self.outliers_checked,
            &mut self.emitted,
        ] {
            state.i64(counter)?;
        }
        self.summary.visit(state)?;
        let ordered = [0, self.base, self.emitted, self.outliers_checked, self.stuck_checked, self.rows].is_sorted();
        let waiting = (self.rows - self.base) as usize;
        let whole = |class: &Class| match class {
            Class::Fast(fast) => fast.cells.iter().all(|c| c.len() == waiting),
            Class::Slow(_) => true,
        };
        if !ordered || !self.classes.iter().all(whole) || (self.reference.is_none() && self.rows > 0) {
            return Err(StateError::Content("rows that do not fit together"));
        }
        Ok(())
    }

    /// Settings and columns that must be equal for a state to fit.
    fn fingerprint(&self) -> String {
        let c = &self.config;
        let mut text =
            format!("{} {} {} {} {}", c.rate_hz, c.outlier_sigma, c.stuck_samples, c.hold_intervals, c.max_gap_s);
        for t in &self.tables {
            text.push_str(&format!("\n{}:", t.spec.name));
            t.spec.columns.iter().for_each(|c| text.push_str(&format!(" {}", c.name)));
        }
        text
    }
}

/// Longest interval of a slow table that is interpolated, ns: the hold time plus 10 % for jitter.
fn max_interval_ns(interval_ns: i64, hold_intervals: f64) -> i64 {
    (interval_ns as f64 * hold_intervals * 1.1) as i64
}

/// Median interval of the times before `end_ns`; 0 with fewer than three times.
fn median_interval(times: &[i64], end_ns: i64) -> i64 {
    let times = &times[..times.partition_point(|t| *t < end_ns)];
    let mut intervals: Vec<i64> = times.windows(2).map(|w| w[1] - w[0]).collect();
    if intervals.len() < 2 {
        return 0;
    }
    let middle = (intervals.len() - 1) / 2;
    *intervals.select_nth_unstable(middle).1
}

impl Fast {
    fn new(columns: usize) -> Self {
        Self {
            phase_ns: None,
            last_row: -1,
            crowded: false,
            filled: 0,
            cells: vec![Window::default(); columns],
            runs: vec![Run::default(); columns],
        }
    }

    fn visit(&mut self, state: &mut State<'_>) -> Result<(), StateError> {
        state.option(&mut self.phase_ns, State::i64)?;
        state.i64(&mut self.last_row)?;
        state.flag(&mut self.crowded)?;
        state.u64(&mut self.filled)?;
        for (cells, run) in self.cells.iter_mut().zip(&mut self.runs) {
            cells.visit(state, State::f64_list)?;
            state.u64(&mut run.bits)?;
            state.u32(&mut run.length)?;
            state.flag(&mut run.moved)?;
        }
        Ok(())
    }
}

impl Summary {
    fn visit(&mut self, state: &mut State<'_>) -> Result<(), StateError> {
        for count in [&mut self.used, &mut self.rejected, &mut self.early, &mut self.cut_gaps, &mut self.rephased] {
            state.u64(count)?;
        }
        for run in [&mut self.longest, &mut self.current] {
            state.u64(&mut run.rows)?;
            state.i64(&mut run.from_ns)?;
        }
        for time_ns in [&mut self.longest_cut_ns, &mut self.longest_cut_from_ns, &mut self.first_rephased_ns] {
            state.i64(time_ns)?;
        }
        Ok(())
    }
}
