//! Rectangular pulses at the steps of a column.

use std::collections::VecDeque;

use dragfree_sdk::state::{State, StateError};

use crate::common::skipped_rows;

/// Recent values of a column, which give a rectangular pulse at each of its steps: a step of height h gives h evenly
/// over the next `n` rows. The sum of all pulses in row k is `(u_k − u_{k−n})/(n Δt)`.
///
/// A missing value is replaced by the last one. Before the first value the output is NaN; the first value is no step.
/// Absent rows count as rows without a value.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct StepPulses {
    /// `max_rows + 1` values, newest last.
    values: VecDeque<f64>,
    max_rows: usize,
    dt_s: f64,
    /// Time of the last row, Unix ns; 0 before the first.
    last_ns: i64,
}

impl StepPulses {
    /// Pulses of at most `max_rows` rows.
    pub(crate) fn new(max_rows: usize, dt_s: f64) -> Self {
        let max_rows = max_rows.max(1);
        Self { values: VecDeque::from(vec![f64::NAN; max_rows + 1]), max_rows, dt_s, last_ns: 0 }
    }

    /// Adds a row.
    pub(crate) fn push(&mut self, now_ns: i64, value: f64) {
        let last = self.values[self.max_rows];
        if last.is_nan() {
            if value.is_finite() {
                self.values.iter_mut().for_each(|v| *v = value);
            }
        } else {
            let skipped = skipped_rows(self.last_ns, now_ns, self.dt_s).min(self.max_rows as u64);
            for _ in 0..skipped {
                self.shift(last);
            }
            self.shift(if value.is_finite() { value } else { last });
        }
        self.last_ns = now_ns;
    }

    fn shift(&mut self, value: f64) {
        self.values.pop_front();
        self.values.push_back(value);
    }

    /// Mean over the newest row of pulses `rows` long, s⁻¹ times the unit of the column.
    pub(crate) fn mean(&self, rows: usize) -> f64 {
        let rows = rows.clamp(1, self.max_rows);
        (self.values[self.max_rows] - self.values[self.max_rows - rows]) / (rows as f64 * self.dt_s)
    }

    /// Visits all that the next rows depend on.
    ///
    /// # Errors
    /// The state ends.
    pub(crate) fn visit(&mut self, state: &mut State<'_>) -> Result<(), StateError> {
        state.f64s(&mut self.values)?;
        state.i64(&mut self.last_ns)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use dragfree_sdk::state;
    use proptest::prelude::*;

    const DT_S: f64 = 0.1;

    fn run(steps: &mut StepPulses, first: i64, values: &[f64], rows: usize) -> Vec<f64> {
        let of = |(k, x): (usize, &f64)| {
            steps.push(100_000_000 * (first + k as i64), *x);
            steps.mean(rows)
        };
        values.iter().enumerate().map(of).collect()
    }

    /// A flag set from row 20 to 60.
    #[test]
    fn a_rise_and_a_fall_give_opposite_pulses() {
        let values: Vec<f64> = (0..100).map(|k| f64::from(u8::from((20..60).contains(&k)))).collect();
        let given = run(&mut StepPulses::new(30, DT_S), 0, &values, 10);
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
    fn the_first_value_is_no_step() {
        let given = run(&mut StepPulses::new(5, DT_S), 0, &[f64::NAN, 1.0, 1.0, f64::NAN, 1.0], 3);
        assert!(given[0].is_nan());
        assert_eq!(given[1..], [0.0; 4]);
    }

    /// A pulse continues over a gap, and absent rows count.
    #[test]
    fn absent_rows_are_missing_values() {
        let values = [0.0, 1.0, f64::NAN, f64::NAN, f64::NAN, 1.0, 1.0];
        let whole = run(&mut StepPulses::new(8, DT_S), 0, &values, 5);
        let mut steps = StepPulses::new(8, DT_S);
        let mut jumped = run(&mut steps, 0, &values[..2], 5);
        jumped.extend(run(&mut steps, 5, &values[5..], 5));
        assert_eq!(jumped, [&whole[..2], &whole[5..]].concat());
        assert_eq!(whole[5..], [2.0, 0.0]);
    }

    proptest! {
        #[test]
        fn chunks_and_saved_states_do_not_change_the_output(
            values in prop::collection::vec(prop_oneof![4 => -3.0..3.0, 1 => Just(f64::NAN)], 1..200),
            cut in 0.0..1.0_f64,
        ) {
            let cut = (cut * values.len() as f64) as usize;
            let whole = run(&mut StepPulses::new(20, DT_S), 0, &values, 7);
            let mut first = StepPulses::new(20, DT_S);
            let mut parts = run(&mut first, 0, &values[..cut], 7);
            let saved = state::save("steps", 1, |state| first.visit(state)).expect("saved");
            let mut second = StepPulses::new(20, DT_S);
            state::load("steps", 1, &saved, |state| second.visit(state)).expect("its own state");
            parts.extend(run(&mut second, cut as i64, &values[cut..], 7));
            let bits = |x: &[f64]| x.iter().map(|x| x.to_bits()).collect::<Vec<_>>();
            prop_assert_eq!(bits(&whole), bits(&parts));
        }
    }
}
