//! Epochs of the grid, and the phase of a table's samples relative to them.
//!
//! The grid is a chain of segments, each `origin + round(k · 1e9 / rate)`. A segment begins with the reference table
//! (the densest mandatory one), where its clock jumps, and after a gap too long to fill. The reference's samples thus
//! lie on their epochs within their jitter. The row before a jump is blank, so that no difference of rows spans it.

use std::collections::VecDeque;

use dragfree_sdk::state::{State, StateError};

/// Rate of the grid.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Rate {
    period_ns: f64,
    half_ns: i64,
    /// The period if it is a whole number of nanoseconds.
    whole_ns: Option<i64>,
}

impl Rate {
    pub(crate) fn new(rate_hz: f64) -> Self {
        let period_ns = 1e9 / rate_hz;
        let whole = period_ns.round();
        // For rates such as 10 or 0.3 the rounding error of 1e9/rate is at most one unit.
        let whole_ns = ((period_ns - whole).abs() <= whole * f64::EPSILON && whole >= 1.0).then_some(whole as i64);
        Self { period_ns, half_ns: (period_ns / 2.0).round() as i64, whole_ns }
    }

    /// `round(k · 1e9 / rate)`, ns.
    pub(crate) fn offset_ns(&self, k: i64) -> i64 {
        self.whole_ns.map_or_else(|| (k as f64 * self.period_ns).round() as i64, |p| k * p)
    }

    /// Index `k` with the nearest offset.
    pub(crate) fn nearest(&self, offset_ns: i64) -> i64 {
        match self.whole_ns {
            Some(p) => (offset_ns + p / 2).div_euclid(p),
            None => (offset_ns as f64 / self.period_ns).round() as i64,
        }
    }

    /// Fraction of the period, ns.
    pub(crate) fn part_ns(&self, part: f64) -> i64 {
        (part * self.period_ns).round() as i64
    }

    /// Distance to the nearest whole number of periods, within half a period.
    pub(crate) fn wrap(&self, offset_ns: i64) -> i64 {
        offset_ns - self.offset_ns(self.nearest(offset_ns))
    }

    /// Median phase of `times` against `origin`, ns, within half a period; 0 without times.
    pub(crate) fn phase(&self, origin: i64, times: &[i64]) -> i64 {
        let Some(first) = times.first() else { return 0 };
        // Phases relative to the first do not wrap near the data, so their median is unambiguous.
        let mut offsets: Vec<i64> = times.iter().map(|t| self.wrap(t - first)).collect();
        let middle = (offsets.len() - 1) / 2;
        self.wrap(first - origin + *offsets.select_nth_unstable(middle).1)
    }
}

/// A stretch of epochs with one phase.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
struct Segment {
    first_row: i64,
    origin_ns: i64,
}

/// Assignment of a time to the grid.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Place {
    /// Row, possibly later than the last row so far.
    Row(i64),
    /// No row: before the grid, between two segments, or on the blank row before a segment.
    Nowhere,
}

/// Epochs of the rows in use.
#[derive(Clone, Debug)]
pub(crate) struct Epochs {
    pub(crate) rate: Rate,
    segments: VecDeque<Segment>,
}

impl Epochs {
    pub(crate) fn new(rate: Rate) -> Self {
        Self { rate, segments: VecDeque::new() }
    }

    pub(crate) fn begun(&self) -> bool {
        !self.segments.is_empty()
    }

    /// Begins a segment at a row.
    pub(crate) fn begin(&mut self, first_row: i64, origin_ns: i64) {
        self.segments.push_back(Segment { first_row, origin_ns });
    }

    /// Epoch of a row, Unix ns.
    pub(crate) fn time_ns(&self, row: i64) -> i64 {
        let found = self.segments.iter().rev().find(|s| s.first_row <= row).or(self.segments.front());
        found.map_or(i64::MAX, |s| s.origin_ns + self.rate.offset_ns(row - s.first_row))
    }

    /// Row whose epoch is nearest to `time_ns`.
    pub(crate) fn place(&self, time_ns: i64) -> Place {
        let mut end = i64::MAX;
        for segment in self.segments.iter().rev() {
            if time_ns >= segment.origin_ns - self.rate.half_ns {
                let row = segment.first_row + self.rate.nearest(time_ns - segment.origin_ns).max(0);
                return if row < end { Place::Row(row) } else { Place::Nowhere };
            }
            // The last row before a segment is blank.
            end = segment.first_row - 1;
        }
        Place::Nowhere
    }

    /// Row of a time in the newest segment, and the distance from its epoch, ns.
    pub(crate) fn newest(&self, time_ns: i64) -> (i64, i64) {
        self.segments.back().map_or((0, 0), |s| {
            let k = self.rate.nearest(time_ns - s.origin_ns).max(0);
            (s.first_row + k, time_ns - s.origin_ns - self.rate.offset_ns(k))
        })
    }

    /// Drops segments that end before `row`.
    pub(crate) fn forget_before(&mut self, row: i64) {
        while self.segments.get(1).is_some_and(|s| s.first_row <= row) {
            self.segments.pop_front();
        }
    }

    pub(crate) fn visit(&mut self, state: &mut State<'_>) -> Result<(), StateError> {
        state.queue(&mut self.segments, |state, segment| {
            state.i64(&mut segment.first_row)?;
            state.i64(&mut segment.origin_ns)
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn epochs_do_not_accumulate_rounding() {
        let ten = Rate::new(10.0);
        assert_eq!(ten.offset_ns(864_000 * 365 * 50), 86_400 * 365 * 50 * 1_000_000_000);
        let three = Rate::new(3.0);
        for k in [1, 2, 3, 1000, 30_000_000] {
            assert_eq!(three.offset_ns(k), (k as f64 * 1e9 / 3.0).round() as i64);
            assert_eq!(three.nearest(three.offset_ns(k) + 150_000_000), k);
        }
        // Every third epoch of 3 Hz is a whole second, without drift.
        assert_eq!(three.offset_ns(3 * 86_400), 86_400 * 1_000_000_000);
    }

    #[test]
    fn a_phase_near_half_a_period_keeps_its_sign() {
        let ten = Rate::new(10.0);
        let times: Vec<i64> = (0..21).map(|k| 49_000_000 + k * 100_000_000 + (k % 3 - 1) * 2_000_000).collect();
        assert_eq!(ten.phase(0, &times), 49_000_000);
    }

    #[test]
    fn no_row_lies_between_two_segments() {
        let mut epochs = Epochs::new(Rate::new(10.0));
        epochs.begin(0, 1_000_000_000);
        epochs.begin(5, 1_540_000_000);
        assert_eq!(epochs.place(900_000_000), Place::Nowhere);
        assert_eq!(epochs.place(1_040_000_000), Place::Row(0));
        assert_eq!(epochs.place(1_300_000_000), Place::Row(3));
        assert_eq!(epochs.place(1_400_000_000), Place::Nowhere);
        assert_eq!(epochs.place(1_470_000_000), Place::Nowhere);
        assert_eq!(epochs.place(1_500_000_000), Place::Row(5));
        assert_eq!(epochs.time_ns(4), 1_400_000_000);
        assert_eq!(epochs.time_ns(6), 1_640_000_000);
    }
}
