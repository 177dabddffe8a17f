//! Rows of one telemetry table before they reach the grid: checks, cleaning, counts.

use crate::layout::TableSpec;
use dragfree_sdk::state::{State, StateError};

/// A vector that is drained at the front in amortised constant time.
#[derive(Clone, Debug, Default)]
pub(crate) struct Window<T> {
    data: Vec<T>,
    head: usize,
}

impl<T: Copy> Window<T> {
    /// Saves or restores the remaining values with `list`.
    pub(crate) fn visit<'s>(
        &mut self,
        state: &mut State<'s>,
        list: impl FnOnce(&mut State<'s>, &mut Vec<T>) -> Result<(), StateError>,
    ) -> Result<(), StateError> {
        self.data.drain(..std::mem::take(&mut self.head));
        list(state, &mut self.data)
    }
    pub(crate) fn as_slice(&self) -> &[T] {
        &self.data[self.head..]
    }
    pub(crate) fn as_mut_slice(&mut self) -> &mut [T] {
        &mut self.data[self.head..]
    }
    pub(crate) fn len(&self) -> usize {
        self.data.len() - self.head
    }
    pub(crate) fn push(&mut self, value: T) {
        self.data.push(value);
    }
    pub(crate) fn extend(&mut self, values: impl Iterator<Item = T>) {
        self.data.extend(values);
    }
    pub(crate) fn grow(&mut self, count: usize, value: T) {
        self.data.resize(self.data.len() + count, value);
    }
    pub(crate) fn pop(&mut self) {
        if self.len() > 0 {
            self.data.pop();
        }
    }
    pub(crate) fn drop_front(&mut self, count: usize) {
        self.head += count;
        if self.head >= 4096 && 2 * self.head >= self.data.len() {
            self.data.drain(..self.head);
            self.head = 0;
        }
    }
}

/// Reason why a row or a value is not on the grid, or a finding that is only counted.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Reason {
    /// Row: same time and values as the one before.
    Duplicate,
    /// Row: same time, other values; both rows are dropped.
    Conflicting,
    /// Row: earlier than the row before it.
    Late,
    /// Row: a time before 1970 or after 2116.
    BadTime,
    /// Row: two rows of a table belong to one epoch; both are dropped, so that the slip shows as a gap.
    Crowded,
    /// Row: before the first epoch, after the last, or in a gap that the grid omits.
    Outside,
    /// Row: last epoch before the table's clock jumped; dropped, so that no difference spans the jump.
    BeforeJump,
    /// Row: placed, but more than a quarter of an interval from its epoch.
    OffPhase,
    /// Value: covered by a status flag.
    Status,
    /// Value: NaN.
    NotANumber,
    /// Value: infinite.
    Infinite,
    /// Value: beyond the mission's limits.
    Limit,
    /// Value: repeated exactly.
    Stuck,
    /// Value: outlier, see `outliers`.
    Outlier,
    /// The table's clock jumped.
    ClockJump,
}

/// Number of reasons.
const REASONS: usize = 15;

impl Reason {
    pub(crate) const ALL: [(Self, &'static str); REASONS] = [
        (Self::Duplicate, "duplicate_rows"),
        (Self::Conflicting, "conflicting_rows"),
        (Self::Late, "late_rows"),
        (Self::BadTime, "bad_time_rows"),
        (Self::Crowded, "crowded_rows"),
        (Self::Outside, "outside_rows"),
        (Self::BeforeJump, "before_jump_rows"),
        (Self::OffPhase, "off_phase_rows"),
        (Self::Status, "status_values"),
        (Self::NotANumber, "nan_values"),
        (Self::Infinite, "infinite_values"),
        (Self::Limit, "limit_values"),
        (Self::Stuck, "stuck_values"),
        (Self::Outlier, "outlier_values"),
        (Self::ClockJump, "clock_jumps"),
    ];

    /// Reasons that mean corrupted data rather than normal operation.
    pub(crate) const LOSSES: [Self; 5] = [Self::Conflicting, Self::Late, Self::BadTime, Self::Crowded, Self::Infinite];
}

/// Counts by [`Reason`], with rows received and placed.
#[derive(Clone, Debug, Default)]
pub(crate) struct Tally {
    counts: [u64; REASONS],
    /// Rows received.
    pub(crate) rows_in: u64,
    /// Rows on the grid, or held for interpolation.
    pub(crate) rows_placed: u64,
}

impl Tally {
    pub(crate) fn add(&mut self, reason: Reason, count: u64) {
        self.counts[reason as usize] += count;
    }
    pub(crate) fn get(&self, reason: Reason) -> u64 {
        self.counts[reason as usize]
    }
    fn visit(&mut self, state: &mut State<'_>) -> Result<(), StateError> {
        self.counts.iter_mut().try_for_each(|count| state.u64(count))?;
        state.u64(&mut self.rows_in)?;
        state.u64(&mut self.rows_placed)
    }
}

/// Upper bound of valid times; it keeps every difference within an i64.
pub(crate) const LATEST_NS: i64 = 1 << 62;

/// Rows of one table that wait for assignment to epochs.
#[derive(Clone, Debug)]
pub(crate) struct Series {
    pub(crate) spec: TableSpec,
    pub(crate) times: Window<i64>,
    pub(crate) columns: Vec<Window<f64>>,
    pub(crate) tally: Tally,
    /// Time of the last row accepted, or dropped as conflicting.
    last_time: Option<i64>,
    /// Whether the row of `last_time` was dropped as conflicting.
    conflicting: bool,
}

impl Series {
    pub(crate) fn new(spec: TableSpec) -> Self {
        let columns = vec![Window::default(); spec.columns.len()];
        Self { spec, times: Window::default(), columns, tally: Tally::default(), last_time: None, conflicting: false }
    }

    /// Adds rows in telemetry order: `times`, Unix ns, and one slice per column.
    pub(crate) fn take(&mut self, times: &[i64], columns: &[&[f64]]) {
        self.tally.rows_in += times.len() as u64;
        let mut last = self.last_time.unwrap_or(-1);
        let ordered = times.iter().all(|&t| std::mem::replace(&mut last, t) < t) && last < LATEST_NS;
        let flagged = self.spec.status.iter().any(|rule| columns[rule.status].iter().any(|s| *s != 0.0));
        if ordered && !flagged {
            self.times.extend(times.iter().copied());
            for (c, source) in columns.iter().enumerate() {
                self.take_column(c, source);
            }
            if let Some(t) = times.last() {
                self.last_time = Some(*t);
                self.conflicting = false;
            }
        } else {
            for (i, t) in times.iter().enumerate() {
                let row: Vec<f64> = columns.iter().map(|c| c[i]).collect();
                self.take_row(*t, &row);
            }
        }
    }

    fn take_column(&mut self, c: usize, source: &[f64]) {
        let limit = self.spec.columns[c].limit;
        let tally = &mut self.tally;
        self.columns[c].extend(source.iter().map(|&v| if v.abs() <= limit { v } else { refuse(v, tally) }));
    }

    fn take_row(&mut self, t: i64, row: &[f64]) {
        if !(0..LATEST_NS).contains(&t) {
            return self.tally.add(Reason::BadTime, 1);
        }
        match self.last_time {
            Some(last) if t < last => return self.tally.add(Reason::Late, 1),
            Some(last) if t == last => return self.push_same_time(t, row),
            _ => {}
        }
        let mut tally = std::mem::take(&mut self.tally);
        let clean = self.clean(row, &mut tally);
        self.tally = tally;
        self.times.push(t);
        for (column, v) in self.columns.iter_mut().zip(clean) {
            column.push(v);
        }
        self.last_time = Some(t);
        self.conflicting = false;
    }

    /// Handles a row with the time of the row before.
    fn push_same_time(&mut self, t: i64, row: &[f64]) {
        if self.conflicting {
            return self.tally.add(Reason::Conflicting, 1);
        }
        if self.times.as_slice().last() != Some(&t) {
            // The first row is on the grid already; possible only if the host violates `complete_until_ns`.
            return self.tally.add(Reason::Late, 1);
        }
        let clean = self.clean(row, &mut Tally::default());
        let same = |c: &Window<f64>, v: f64| c.as_slice().last().is_some_and(|x| x.to_bits() == v.to_bits());
        if self.columns.iter().zip(clean).all(|(c, v)| same(c, v)) {
            self.tally.add(Reason::Duplicate, 1);
        } else {
            self.times.pop();
            self.columns.iter_mut().for_each(Window::pop);
            self.conflicting = true;
            self.tally.add(Reason::Conflicting, 2);
        }
    }

    /// The row with invalid values replaced by NaN.
    fn clean(&self, row: &[f64], tally: &mut Tally) -> Vec<f64> {
        let mut flagged = vec![false; row.len()];
        for rule in &self.spec.status {
            if rule.raised(row[rule.status]) {
                rule.covers.iter().for_each(|c| flagged[*c] = true);
            }
        }
        row.iter()
            .enumerate()
            .map(|(c, &v)| {
                if flagged[c] {
                    tally.add(Reason::Status, 1);
                    f64::NAN
                } else if v.abs() <= self.spec.columns[c].limit {
                    v
                } else {
                    refuse(v, tally)
                }
            })
            .collect()
    }

    /// Drops the first `count` rows.
    pub(crate) fn drop_front(&mut self, count: usize) {
        self.times.drop_front(count);
        self.columns.iter_mut().for_each(|c| c.drop_front(count));
    }

    pub(crate) fn visit(&mut self, state: &mut State<'_>) -> Result<(), StateError> {
        self.times.visit(state, State::i64_list)?;
        self.columns.iter_mut().try_for_each(|column| column.visit(state, State::f64_list))?;
        if self.columns.iter().any(|c| c.len() != self.times.len()) {
            return Err(StateError::Content("columns of another length than their times"));
        }
        self.tally.visit(state)?;
        state.option(&mut self.last_time, State::i64)?;
        state.flag(&mut self.conflicting)
    }
}

#[cold]
fn refuse(v: f64, tally: &mut Tally) -> f64 {
    let reason = if v.is_nan() {
        Reason::NotANumber
    } else if v.is_infinite() {
        Reason::Infinite
    } else {
        Reason::Limit
    };
    tally.add(reason, 1);
    f64::NAN
}
