//! Decimation of slow series: a cascade of five running means (CIC filter), of which every M-th value is kept.
//!
//! The response is `(sin πfM/r / M sin πf/r)⁵` at r samples per second. Aliases into the lowest frequencies are weaker
//! by `(fM/r)⁵`; the second difference of readout noise is 1e8 times louder where they come from. All columns pass the
//! same filter, which keeps their regressions; spectra are divided by the response.

use nalgebra::{DVector, DVectorView};

/// Slow series have nothing above this frequency.
pub const SLOW_HZ: f64 = 0.05;

/// Running means in a row.
const ORDER: i32 = 5;

/// Response of a decimator.
#[derive(Clone, Copy, Debug)]
pub struct Response {
    factor: f64,
}

impl Response {
    /// Of a decimator that keeps every `factor`-th sample.
    pub fn of(factor: usize) -> Self {
        Self { factor: factor as f64 }
    }

    /// At a frequency in cycles per sample that comes in.
    pub fn at(self, cycles: f64) -> f64 {
        let angle = std::f64::consts::PI * cycles;
        if angle == 0.0 { 1.0 } else { ((self.factor * angle).sin() / (self.factor * angle.sin())).powi(ORDER) }
    }
}

/// Keeps every `factor`-th sample of filtered columns.
#[derive(Clone, Debug)]
pub struct Decimator {
    factor: usize,
    kernel: DVector<f64>,
    step_ns: i64,
    threads: usize,
    /// What must survive a checkpoint.
    pub state: State,
}

/// Samples that outputs to come still need.
#[derive(Clone, Debug, PartialEq)]
pub struct State {
    /// Per column, fewer than the filter is long.
    pub pending: Vec<Vec<f64>>,
    /// Time of the first, ns.
    pub first_ns: i64,
}

/// Samples of all columns that are worth a thread.
const WORTH_A_THREAD: usize = 1 << 16;

impl Decimator {
    /// For `columns` columns with a sample every `step_ns`, shared among `threads`.
    pub fn new(factor: usize, columns: usize, step_ns: i64, threads: usize) -> Self {
        let mean = vec![1.0 / factor as f64; factor];
        let convolved = |kernel: Vec<f64>| {
            let mut out = vec![0.0; kernel.len() + factor - 1];
            kernel.iter().enumerate().for_each(|(i, a)| mean.iter().enumerate().for_each(|(j, b)| out[i + j] += a * b));
            out
        };
        let kernel = (0..ORDER).fold(vec![1.0], |kernel, _| convolved(kernel));
        let state = State { pending: vec![Vec::new(); columns], first_ns: 0 };
        Self { factor, kernel: kernel.into(), step_ns, threads, state }
    }

    /// Nanoseconds between samples that are kept.
    pub fn step_ns(&self) -> i64 {
        self.step_ns * self.factor as i64
    }

    /// Its response.
    pub fn response(&self) -> Response {
        Response::of(self.factor)
    }

    /// Samples that one output is made of.
    pub fn length(&self) -> usize {
        self.kernel.len()
    }

    /// More samples of the run; what is kept, at the times of the middle of what it was made of.
    pub fn push(&mut self, first_ns: i64, columns: &[&[f64]]) -> (Vec<i64>, Vec<Vec<f64>>) {
        if self.state.pending.first().is_none_or(Vec::is_empty) {
            self.state.first_ns = first_ns;
        }
        let length = self.kernel.len();
        let new = columns.first().map_or(0, |c| c.len());
        let samples = self.state.pending.first().map_or(0, Vec::len) + new;
        let kept = if samples < length { 0 } else { (samples - length) / self.factor + 1 };
        let middle_ns = self.state.first_ns + (length as i64 - 1) * self.step_ns / 2;
        let times = (0..kept as i64).map(|m| middle_ns + m * self.step_ns()).collect();
        let (kernel, factor) = (&self.kernel, self.factor);
        let filter = |pending: &mut Vec<f64>, samples: &[f64]| {
            pending.extend_from_slice(samples);
            let at = |m: usize| kernel.dot(&DVectorView::from_slice(&pending[m * factor..], length));
            let out = (0..kept).map(at).collect();
            pending.drain(..kept * factor);
            out
        };
        let mut thinned = vec![Vec::new(); columns.len()];
        let threads = if new * columns.len() < WORTH_A_THREAD { 1 } else { self.threads };
        let each = columns.len().div_ceil(threads).max(1);
        let shares = thinned.chunks_mut(each).zip(self.state.pending.chunks_mut(each)).zip(columns.chunks(each));
        std::thread::scope(|scope| {
            for (k, ((out, pending), columns)) in shares.enumerate() {
                let work = move || {
                    let columns = out.iter_mut().zip(pending).zip(columns);
                    columns.for_each(|((out, pending), samples)| *out = filter(pending, samples));
                };
                if k + 1 < threads {
                    scope.spawn(work);
                } else {
                    work();
                }
            }
        });
        self.state.first_ns += kept as i64 * self.step_ns();
        (times, thinned)
    }

    /// The run has ended.
    pub fn gap(&mut self) {
        self.state.pending.iter_mut().for_each(Vec::clear);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A wave below the new Nyquist frequency keeps its phase and loses what the response says, whatever the portions;
    /// one that would fold to a low frequency is gone; a gap forgets.
    #[test]
    fn slow_waves_pass_and_fast_ones_do_not_fold() {
        let wave = |cycles: f64| -> Vec<f64> {
            (0..40_000).map(|k| (std::f64::consts::TAU * cycles * f64::from(k) + 0.3).cos()).collect()
        };
        let (slow, fast) = (wave(2e-4), wave(1.0 / 32.0 + 2e-4));
        for portion in [40_000, 777, 8] {
            let mut decimator = Decimator::new(32, 2, 100_000_000, 2);
            let (mut times, mut values) = (Vec::new(), [Vec::new(), Vec::new()]);
            for at in (0..40_000).step_by(portion) {
                let end = (at + portion).min(40_000);
                let (t, v) = decimator.push(1_000 + at as i64 * 100_000_000, &[&slow[at..end], &fast[at..end]]);
                times.extend(t);
                v.into_iter().zip(&mut values).for_each(|(v, all)| all.extend(v));
            }
            // Five means of 32 need 156 samples, and one in 32 is kept.
            assert_eq!(times.len(), (40_000 - 156) / 32 + 1);
            assert_eq!((times[0], times[1] - times[0]), (1_000 + 7_750_000_000, 3_200_000_000));
            let gain = decimator.response().at(2e-4);
            for (m, (t, x)) in times.iter().zip(&values[0]).enumerate() {
                let cycles = 2e-4 * (t - 1_000) as f64 / 1e8;
                let expected = gain * (std::f64::consts::TAU * cycles + 0.3).cos();
                assert!((x - expected).abs() < 1e-9, "{m}: {x} {expected}");
            }
            // (2e-4 · 32)⁵ = 1.1e-11.
            assert!(values[1].iter().all(|x| x.abs() < 2e-11));
            decimator.gap();
            assert!(decimator.push(0, &[&slow[..155], &fast[..155]]).0.is_empty());
        }
    }
}
