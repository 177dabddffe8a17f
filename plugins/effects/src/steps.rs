//! Even pushes at the steps of a column.

use std::collections::VecDeque;

use crate::common::rows_between;

/// The last values of a column, and from them what is given at its steps: a step of height h at an epoch gives h evenly over the
/// `n` rows from that epoch on, so that the mean of row k is `(u_k − u_{k−n})/(n Δt)`.
///
/// A column that lacks values has its last one; before the first, NaN, and at the first it has always been so. Rows that are left
/// out altogether are rows without a value.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Steps {
    /// The newest last; one more than the longest push, full from the first value on.
    values: VecDeque<f64>,
    longest: usize,
    dt_s: f64,
    /// Time of the last row, Unix ns; 0 before the first.
    last_ns: i64,
}

impl Steps {
    /// For pushes over at most `longest` rows.
    pub(crate) fn new(longest: usize, dt_s: f64) -> Self {
        let longest = longest.max(1);
        Self { values: VecDeque::from(vec![f64::NAN; longest + 1]), longest, dt_s, last_ns: 0 }
    }

    /// The next row.
    pub(crate) fn push(&mut self, now_ns: i64, value: f64) {
        let held = self.values[self.longest];
        if held.is_nan() {
            if value.is_finite() {
                self.values.iter_mut().for_each(|v| *v = value);
            }
        } else {
            let left_out = rows_between(self.last_ns, now_ns, self.dt_s).min(self.longest as u64);
            for _ in 0..left_out {
                self.turn(held);
            }
            self.turn(if value.is_finite() { value } else { held });
        }
        self.last_ns = now_ns;
    }

    fn turn(&mut self, value: f64) {
        self.values.pop_front();
        self.values.push_back(value);
    }

    /// Mean over the last row of what is given over `rows` rows, s⁻¹.
    pub(crate) fn mean(&self, rows: usize) -> f64 {
        let rows = rows.clamp(1, self.longest);
        (self.values[self.longest] - self.values[self.longest - rows]) / (rows as f64 * self.dt_s)
    }

    /// Number of [`Self::state`]'s numbers.
    pub(crate) fn state_len(&self) -> usize {
        self.longest + 2
    }

    /// All that the next rows depend on.
    pub(crate) fn state(&self) -> impl Iterator<Item = f64> {
        // Bits carry a whole number through, whatever its size.
        self.values.iter().copied().chain([f64::from_bits(self.last_ns.cast_unsigned())])
    }

    /// Takes back what [`Self::state`] gave, [`Self::state_len`] numbers.
    pub(crate) fn set_state(&mut self, state: &[f64]) {
        if let Some((last_ns, values)) = state.split_last() {
            self.values = values.iter().copied().collect();
            self.last_ns = last_ns.to_bits().cast_signed();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const DT_S: f64 = 0.1;

    fn run(steps: &mut Steps, first: i64, values: &[f64], rows: usize) -> Vec<f64> {
        let of = |(k, x): (usize, &f64)| {
            steps.push(100_000_000 * (first + k as i64), *x);
            steps.mean(rows)
        };
        values.iter().enumerate().map(of).collect()
    }

    /// A flag that is up for a while: what it gives it takes back, evenly, and nothing before.
    #[test]
    fn what_a_rise_gives_a_fall_takes_back() {
        let values: Vec<f64> = (0..100).map(|k| f64::from(u8::from((20..60).contains(&k)))).collect();
        let given = run(&mut Steps::new(30, DT_S), 0, &values, 10);
        for (k, got) in given.iter().enumerate() {
            let want = if (20..30).contains(&k) {
                1.0
            } else if (60..70).contains(&k) {
                -1.0
            } else {
                0.0
            };
            assert!((got - want).abs() < 1e-12, "row {k}: {got}");
        }
    }

    #[test]
    fn a_column_that_begins_high_has_not_just_risen() {
        let given = run(&mut Steps::new(5, DT_S), 0, &[f64::NAN, 1.0, 1.0, f64::NAN, 1.0], 3);
        assert!(given[0].is_nan());
        assert_eq!(given[1..], [0.0; 4]);
    }

    /// A push that began before a gap goes on in it, and rows left out are rows without a value.
    #[test]
    fn a_gap_takes_time() {
        let values = [0.0, 1.0, f64::NAN, f64::NAN, f64::NAN, 1.0, 1.0];
        let whole = run(&mut Steps::new(8, DT_S), 0, &values, 5);
        let mut steps = Steps::new(8, DT_S);
        let mut jumped = run(&mut steps, 0, &values[..2], 5);
        jumped.extend(run(&mut steps, 5, &values[5..], 5));
        assert_eq!(jumped, [&whole[..2], &whole[5..]].concat());
        assert_eq!(whole[5..], [2.0, 0.0]);
    }

    proptest! {
        #[test]
        fn neither_pieces_nor_saved_states_change_a_bit(
            values in prop::collection::vec(prop_oneof![4 => -3.0..3.0, 1 => Just(f64::NAN)], 1..200),
            cut in 0.0..1.0_f64,
        ) {
            let cut = (cut * values.len() as f64) as usize;
            let whole = run(&mut Steps::new(20, DT_S), 0, &values, 7);
            let mut first = Steps::new(20, DT_S);
            let mut parts = run(&mut first, 0, &values[..cut], 7);
            let state: Vec<f64> = first.state().collect();
            prop_assert_eq!(state.len(), first.state_len());
            let mut second = Steps::new(20, DT_S);
            second.set_state(&state);
            parts.extend(run(&mut second, cut as i64, &values[cut..], 7));
            let bits = |x: &[f64]| x.iter().map(|x| x.to_bits()).collect::<Vec<_>>();
            prop_assert_eq!(bits(&whole), bits(&parts));
        }
    }
}
