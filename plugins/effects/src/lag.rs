//! First-order lags of one column, several at once.

use crate::common::rows_between;

/// A lag forgives a missing input for as long as itself, and for this long at least, s.
const LEAST_PATIENCE_S: f64 = 60.0;
/// Rows computed between two hand-overs.
const PIECE: usize = 256;

/// `N` first-order lags `τ_j ẏ_j = u − y_j` of one input, each exact for an input that holds from epoch to epoch:
///
/// `mean_k = u_k + (y_k − u_k)(1 − e^{−Δt/τ})τ/Δt`, `y_{k+1} = u_k + (y_k − u_k)e^{−Δt/τ}`.
///
/// What is given is the mean over `[t_k, t_{k+1})`. A column that is interpolated between its packets is so read half a sample
/// late, 0.05 s of lags of half a minute and more.
///
/// **What is missing.** Before the first value, NaN. A lag starts settled at its first value. Where values are missing, the last
/// one holds for as long as the lag (a minute at least): what such a stretch leaves out is still mostly in the lag. Beyond, NaN;
/// when values come back, the lag starts anew, settled at the first of them.
#[derive(Clone, Debug, PartialEq)]
pub struct Lags<const N: usize> {
    left: [f64; N],
    mean: [f64; N],
    /// Rows for which a missing input is forgiven.
    patience: [u64; N],
    dt_s: f64,
    /// `y`, the unit of the input.
    y: [f64; N],
    /// The last value of the input; NaN before the first.
    held: f64,
    /// Rows since.
    missing: u64,
    /// Time of the last row, Unix ns; 0 before the first.
    last_ns: i64,
}

impl<const N: usize> Lags<N> {
    /// Lags of the time constants `lag_s`, s; a lag of 0 is the input itself.
    #[must_use]
    pub fn new(lag_s: [f64; N], dt_s: f64) -> Self {
        let x = lag_s.map(|lag| if lag > 0.0 { dt_s / lag } else { f64::INFINITY });
        Self {
            left: x.map(|x| (-x).exp()),
            mean: x.map(|x| if x.is_finite() { -(-x).exp_m1() / x } else { 0.0 }),
            patience: lag_s.map(|lag| (lag.max(LEAST_PATIENCE_S) / dt_s).ceil() as u64),
            dt_s,
            y: [0.0; N],
            held: f64::NAN,
            missing: 0,
            last_ns: 0,
        }
    }

    /// Rows of the input; `give(j, means)` is called with lag `j`'s means, piece by piece.
    pub fn push(&mut self, time_ns: &[i64], input: &[f64], mut give: impl FnMut(usize, &[f64])) {
        let mut rows = [[0.0; N]; PIECE];
        let mut column = [0.0; PIECE];
        for (times, values) in time_ns.chunks(PIECE).zip(input.chunks(PIECE)) {
            let n = values.len();
            self.piece(times, values, &mut rows[..n]);
            for j in 0..N {
                for (to, row) in column[..n].iter_mut().zip(&rows[..n]) {
                    *to = row[j];
                }
                give(j, &column[..n]);
            }
        }
    }

    fn piece(&mut self, time_ns: &[i64], input: &[f64], rows: &mut [[f64; N]]) {
        let step_ns = (self.dt_s * 1.5e9) as i64;
        let mut y = self.y;
        for ((&now_ns, &u), row) in time_ns.iter().zip(input).zip(rows) {
            if u.is_finite() && self.missing == 0 && now_ns - self.last_ns < step_ns {
                for j in 0..N {
                    let above = y[j] - u;
                    row[j] = u + above * self.mean[j];
                    y[j] = u + above * self.left[j];
                }
                self.held = u;
            } else {
                self.y = y;
                self.uneven_row(now_ns, u, row);
                y = self.y;
            }
            self.last_ns = now_ns;
        }
        self.y = y;
    }

    /// A row that does not follow a row with a value, or has none.
    #[cold]
    fn uneven_row(&mut self, now_ns: i64, u: f64, row: &mut [f64; N]) {
        for _ in
            0..rows_between(self.last_ns, now_ns, self.dt_s).min(self.patience.iter().copied().max().unwrap_or(0) + 1)
        {
            self.missing += 1;
            self.settle(self.held);
        }
        if u.is_finite() {
            for j in 0..N {
                if self.held.is_nan() || self.missing > self.patience[j] {
                    self.y[j] = u;
                }
                row[j] = u + (self.y[j] - u) * self.mean[j];
            }
            (self.held, self.missing) = (u, 0);
        } else {
            self.missing = self.missing.saturating_add(1);
            for j in 0..N {
                let known = self.missing <= self.patience[j];
                row[j] = if known { self.held + (self.y[j] - self.held) * self.mean[j] } else { f64::NAN };
            }
        }
        self.settle(self.held);
    }

    /// The lags moved on over a sample in which `u` holds.
    fn settle(&mut self, u: f64) {
        for j in 0..N {
            self.y[j] = u + (self.y[j] - u) * self.left[j];
        }
    }

    /// Number of [`Self::state`]'s numbers.
    pub const STATE: usize = N + 3;

    /// All that the next rows depend on.
    pub fn state(&self) -> impl Iterator<Item = f64> {
        // Bits carry whole numbers through, whatever their size.
        let whole = [self.missing, self.last_ns.cast_unsigned()].map(f64::from_bits);
        self.y.into_iter().chain([self.held]).chain(whole)
    }

    /// Takes back what [`Self::state`] gave, [`Self::STATE`] numbers.
    pub fn set_state(&mut self, state: &[f64]) {
        if let Some((y, [held, missing, last_ns])) = state.split_at_checked(N) {
            self.y.copy_from_slice(y);
            self.held = *held;
            (self.missing, self.last_ns) = (missing.to_bits(), last_ns.to_bits().cast_signed());
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
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

    /// Bit by bit, so that NaN equals NaN.
    fn bits<const N: usize>(columns: &[Vec<f64>; N]) -> Vec<Vec<u64>> {
        columns.iter().map(|c| c.iter().map(|x| x.to_bits()).collect()).collect()
    }

    /// The equation itself, by Heun's method in many steps a sample, knows nothing of exponentials.
    #[test]
    fn the_means_are_those_of_the_differential_equation() {
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
    fn a_missing_input_holds_for_a_lag_and_then_the_lag_starts_anew() {
        let (short, long) = (60.0, 200.0);
        let mut input = vec![f64::NAN; 3];
        input.extend(vec![1.0; 10]);
        input.extend(vec![f64::NAN; 1000]);
        input.extend(vec![5.0; 10]);
        let [a, b] = run(&mut Lags::new([short, long], DT_S), &times(input.len()), &input);
        assert!(a[..3].iter().chain(&b[..3]).all(|x| x.is_nan()), "nothing is known before the first value");
        assert!(a[3..13].iter().all(|x| *x == 1.0), "it starts settled");
        // 600 rows are forgiven to the short lag, and all 1000 to the long one.
        assert!(a[13..613].iter().all(|x| *x == 1.0) && a[613..1013].iter().all(|x| x.is_nan()));
        assert!(b[13..1013].iter().all(|x| *x == 1.0));
        assert_eq!(a[1013], 5.0, "anew, settled");
        let expected = 5.0 - 4.0 * (1.0 - (-DT_S / long).exp()) * long / DT_S;
        assert!((b[1013] - expected).abs() < 1e-12, "it went on: {}", b[1013]);
    }

    /// Rows that are left out altogether are rows without a value.
    #[test]
    fn a_jump_of_time_is_a_gap() {
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
        /// Pieces of any length, with the state saved and taken back between them, give the same bits.
        #[test]
        fn neither_pieces_nor_saved_states_change_a_bit(
            input in prop::collection::vec(prop_oneof![4 => -3.0..3.0, 1 => Just(f64::NAN)], 1..900),
            cut in 0.0..1.0_f64,
        ) {
            let cut = (cut * input.len() as f64) as usize;
            let time_ns = times(input.len());
            let whole = run(&mut Lags::new([0.5, 33.0], DT_S), &time_ns, &input);
            let mut first = Lags::new([0.5, 33.0], DT_S);
            let [mut a, mut b] = run(&mut first, &time_ns[..cut], &input[..cut]);
            let state: Vec<f64> = first.state().collect();
            prop_assert_eq!(state.len(), Lags::<2>::STATE);
            let mut second = Lags::new([0.5, 33.0], DT_S);
            second.set_state(&state);
            let [c, d] = run(&mut second, &time_ns[cut..], &input[cut..]);
            a.extend(c);
            b.extend(d);
            prop_assert_eq!(bits(&whole), bits(&[a, b]));
        }
    }
}
