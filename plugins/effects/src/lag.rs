//! Banks of first-order lags of one column.

use dragfree_sdk::state::{State, StateError};

use crate::common::skipped_rows;

/// Time over which the last input is held where values are missing, at least, s.
const MIN_HOLD_S: f64 = 60.0;
/// Rows computed between two calls of `emit`.
const CHUNK_ROWS: usize = 256;

/// `N` first-order lags `τ_j ẏ_j = u − y_j` of one input, discretised exactly for an input held over each sample:
///
/// `mean_k = u_k + (y_k − u_k)(1 − e^{−Δt/τ})τ/Δt`, `y_{k+1} = u_k + (y_k − u_k)e^{−Δt/τ}`.
///
/// The output is the mean over `[t_k, t_{k+1})`. An interpolated column is thus read half a sample late.
///
/// **Missing values.** NaN before the first value; a lag starts settled at it. Over missing values the last one is held
/// for `max(τ, 60 s)`. Beyond that the output is NaN and the lag restarts, settled at the next value.
#[derive(Clone, Debug, PartialEq)]
pub struct Lags<const N: usize> {
    decay: [f64; N],
    mean_gain: [f64; N],
    /// Rows over which a missing input is held.
    max_missing: [u64; N],
    dt_s: f64,
    /// State `y`, in the unit of the input.
    y: [f64; N],
    /// Last value of the input; NaN before the first.
    last_input: f64,
    /// Rows since the last value.
    missing: u64,
    /// Time of the last row, Unix ns; 0 before the first.
    last_ns: i64,
}

impl<const N: usize> Lags<N> {
    /// Lags with time constants `lag_s` and sample interval `dt_s`, s; a lag of 0 returns the input.
    pub fn new(lag_s: [f64; N], dt_s: f64) -> Self {
        let x = lag_s.map(|lag| if lag > 0.0 { dt_s / lag } else { f64::INFINITY });
        Self {
            decay: x.map(|x| (-x).exp()),
            mean_gain: x.map(|x| if x.is_finite() { -(-x).exp_m1() / x } else { 0.0 }),
            max_missing: lag_s.map(|lag| (lag.max(MIN_HOLD_S) / dt_s).ceil() as u64),
            dt_s,
            y: [0.0; N],
            last_input: f64::NAN,
            missing: 0,
            last_ns: 0,
        }
    }

    /// Processes rows of the input; calls `emit(j, means)` with the output of lag `j`, chunk by chunk.
    pub fn push(&mut self, time_ns: &[i64], input: &[f64], mut emit: impl FnMut(usize, &[f64])) {
        let mut rows = [[0.0; N]; CHUNK_ROWS];
        let mut column = [0.0; CHUNK_ROWS];
        for (times, values) in time_ns.chunks(CHUNK_ROWS).zip(input.chunks(CHUNK_ROWS)) {
            let n = values.len();
            self.advance_chunk(times, values, &mut rows[..n]);
            for j in 0..N {
                for (to, row) in column[..n].iter_mut().zip(&rows[..n]) {
                    *to = row[j];
                }
                emit(j, &column[..n]);
            }
        }
    }

    fn advance_chunk(&mut self, time_ns: &[i64], input: &[f64], rows: &mut [[f64; N]]) {
        let step_ns = (self.dt_s * 1.5e9) as i64;
        let mut y = self.y;
        for ((&now_ns, &u), row) in time_ns.iter().zip(input).zip(rows) {
            if u.is_finite() && self.missing == 0 && now_ns - self.last_ns < step_ns {
                for j in 0..N {
                    let difference = y[j] - u;
                    row[j] = u + difference * self.mean_gain[j];
                    y[j] = u + difference * self.decay[j];
                }
                self.last_input = u;
            } else {
                self.y = y;
                self.advance_row(now_ns, u, row);
                y = self.y;
            }
            self.last_ns = now_ns;
        }
        self.y = y;
    }

    /// Processes a row that has no value, or follows a gap or a missing value.
    #[cold]
    fn advance_row(&mut self, now_ns: i64, u: f64, row: &mut [f64; N]) {
        for _ in 0..skipped_rows(self.last_ns, now_ns, self.dt_s)
            .min(self.max_missing.iter().copied().max().unwrap_or(0) + 1)
        {
            self.missing += 1;
            self.advance(self.last_input);
        }
        if u.is_finite() {
            for j in 0..N {
                if self.last_input.is_nan() || self.missing > self.max_missing[j] {
                    self.y[j] = u;
                }
                row[j] = u + (self.y[j] - u) * self.mean_gain[j];
            }
            (self.last_input, self.missing) = (u, 0);
        } else {
            self.missing = self.missing.saturating_add(1);
            for j in 0..N {
                let known = self.missing <= self.max_missing[j];
                row[j] =
                    if known { self.last_input + (self.y[j] - self.last_input) * self.mean_gain[j] } else { f64::NAN };
            }
        }
        self.advance(self.last_input);
    }

    /// Advances the lags by a sample with input `u`.
    fn advance(&mut self, u: f64) {
        for j in 0..N {
            self.y[j] = u + (self.y[j] - u) * self.decay[j];
        }
    }

    /// Visits all that the next rows depend on.
    ///
    /// # Errors
    /// The state ends.
    pub fn visit(&mut self, state: &mut State<'_>) -> Result<(), StateError> {
        state.f64s(&mut self.y)?;
        state.f64(&mut self.last_input)?;
        state.u64(&mut self.missing)?;
        state.i64(&mut self.last_ns)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use dragfree_sdk::state;
    use proptest::prelude::*;

    const DT_S: f64 = 0.1;

    fn times(rows: usize) -> Vec<i64> {
        (0..rows as i64).map(|k| 2_000_000_000_000_000_000 + k * 100_000_000).collect()
    }

    fn run<const N: usize>(lags: &mut Lags<N>, time_ns: &[i64], input: &[f64]) -> [Vec<f64>; N] {
        let mut out = std::array::from_fn(|_| Vec::new());
        lags.push(time_ns, input, |j, rows| out[j].extend_from_slice(rows));
        out
    }

    /// Bits, so that NaN equals NaN.
    fn bits<const N: usize>(columns: &[Vec<f64>; N]) -> Vec<Vec<u64>> {
        columns.iter().map(|c| c.iter().map(|x| x.to_bits()).collect()).collect()
    }

    /// Reference: Heun's method on the differential equation, without exponentials.
    #[test]
    fn outputs_are_means_of_the_differential_equation() {
        let lag_s = [0.03, 0.4, 7.0];
        let input: Vec<f64> = (0..40).map(|k| if k < 5 { 2.0 } else { (0.3 * f64::from(k)).sin() }).collect();
        let got = run(&mut Lags::new(lag_s, DT_S), &times(40), &input);
        for (j, tau) in lag_s.into_iter().enumerate() {
            let (mut y, steps) = (input[0], 20_000);
            let h = DT_S / f64::from(steps);
            for (k, u) in input.iter().enumerate() {
                let mut integral = 0.0;
                for _ in 0..steps {
                    let slope = (u - y) / tau;
                    let next = y + h * 0.5 * (slope + (u - y - h * slope) / tau);
                    integral += 0.5 * h * (y + next);
                    y = next;
                }
                assert!((got[j][k] - integral / DT_S).abs() < 1e-6, "τ = {tau}, row {k}");
            }
        }
        assert_eq!(run(&mut Lags::new([0.0], DT_S), &times(40), &input)[0], input, "no lag is the input itself");
    }

    #[test]
    fn a_missing_input_is_held_for_one_time_constant_then_the_lag_restarts() {
        let (short, long) = (60.0, 200.0);
        let mut input = vec![f64::NAN; 3];
        input.extend(vec![1.0; 10]);
        input.extend(vec![f64::NAN; 1000]);
        input.extend(vec![5.0; 10]);
        let [a, b] = run(&mut Lags::new([short, long], DT_S), &times(input.len()), &input);
        assert!(a[..3].iter().chain(&b[..3]).all(|x| x.is_nan()), "nothing is known before the first value");
        assert!(a[3..13].iter().all(|x| *x == 1.0), "it starts settled");
        // The short lag holds 600 rows, the long one all 1000.
        assert!(a[13..613].iter().all(|x| *x == 1.0) && a[613..1013].iter().all(|x| x.is_nan()));
        assert!(b[13..1013].iter().all(|x| *x == 1.0));
        assert_eq!(a[1013], 5.0, "anew, settled");
        let expected = 5.0 - 4.0 * (1.0 - (-DT_S / long).exp()) * long / DT_S;
        assert!((b[1013] - expected).abs() < 1e-12, "it went on: {}", b[1013]);
    }

    /// Absent rows are equivalent to rows without a value.
    #[test]
    fn absent_rows_are_missing_values() {
        let all = times(3000);
        for left_out in [5, 700, 2500] {
            let mut input: Vec<f64> = (0..3000).map(|k| (0.01 * f64::from(k)).cos()).collect();
            let jumped: Vec<i64> = all[..100].iter().chain(&all[100 + left_out..]).copied().collect();
            let values: Vec<f64> = input[..100].iter().chain(&input[100 + left_out..]).copied().collect();
            input[100..100 + left_out].fill(f64::NAN);
            let [mut whole] = run(&mut Lags::new([90.0], DT_S), &all, &input);
            whole.drain(100..100 + left_out);
            assert_eq!(bits(&run(&mut Lags::new([90.0], DT_S), &jumped, &values)), bits(&[whole]), "{left_out} rows");
        }
    }

    proptest! {
        /// Splitting the rows and saving the state in between leaves the output bit by bit the same.
        #[test]
        fn chunks_and_saved_states_do_not_change_the_output(
            input in prop::collection::vec(prop_oneof![4 => -3.0..3.0, 1 => Just(f64::NAN)], 1..900),
            cut in 0.0..1.0_f64,
        ) {
            let cut = (cut * input.len() as f64) as usize;
            let time_ns = times(input.len());
            let whole = run(&mut Lags::new([0.5, 33.0], DT_S), &time_ns, &input);
            let mut first = Lags::new([0.5, 33.0], DT_S);
            let [mut a, mut b] = run(&mut first, &time_ns[..cut], &input[..cut]);
            let saved = state::save("lags", 1, |state| first.visit(state)).expect("saved");
            let mut second = Lags::new([0.5, 33.0], DT_S);
            state::load("lags", 1, &saved, |state| second.visit(state)).expect("its own state");
            let [c, d] = run(&mut second, &time_ns[cut..], &input[cut..]);
            a.extend(c);
            b.extend(d);
            prop_assert_eq!(bits(&whole), bits(&[a, b]));
        }
    }
}
