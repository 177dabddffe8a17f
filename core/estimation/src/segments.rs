//! From rows to segments: gaps respected, memory bounded, nothing depending on where a batch ends.

use crate::spectra::{Analyser, Layout, Sums};

/// Collects rows into runs without a gap and hands whole segments on.
#[derive(Clone, Debug, PartialEq)]
pub struct Segmenter {
    /// Samples of a segment.
    length: usize,
    /// Nanoseconds between rows.
    step_ns: i64,
    /// Which columns are averaged with their predecessor, `(φ_{k−1}+φ_k)/2`.
    averaged: Vec<bool>,
    /// What the segmenter remembers between two batches.
    pub state: State,
}

/// What must survive a checkpoint.
#[derive(Clone, Debug, PartialEq)]
pub struct State {
    /// Time of the last row, ns.
    pub last_ns: Option<i64>,
    /// Last raw value of each column.
    pub previous: Vec<f64>,
    /// The current run's samples that a future segment may still need, per column.
    pub run: Vec<Vec<f64>>,
    /// Whether the current run has given a segment.
    pub run_has_segment: bool,
    /// The longest run so far, kept while there is no segment at all.
    pub longest: Vec<Vec<f64>>,
    /// Rows seen.
    pub rows: u64,
    /// Rows in which every column had a value.
    pub valid: u64,
    /// Rows that a segment covers.
    pub covered: u64,
    /// Rows without a value, per column.
    pub missing: Vec<u64>,
}

impl Segmenter {
    /// `averaged` has one flag per column.
    #[must_use]
    pub fn new(length: usize, step_ns: i64, averaged: Vec<bool>) -> Self {
        let n = averaged.len();
        Self {
            length,
            step_ns,
            averaged,
            state: State {
                last_ns: None,
                previous: vec![f64::NAN; n],
                run: vec![Vec::new(); n],
                run_has_segment: false,
                longest: vec![Vec::new(); n],
                rows: 0,
                valid: 0,
                covered: 0,
                missing: vec![0; n],
            },
        }
    }

    /// Adds rows: `columns[j][k]` is column j at `time_ns[k]`, NaN where there is no value.
    pub fn push(&mut self, time_ns: &[i64], columns: &[&[f64]], analyser: &mut Analyser, sums: &mut Sums) {
        let rows = time_ns.len();
        let mut usable = vec![true; rows];
        for (k, t) in time_ns.iter().enumerate() {
            // After a jump of the clock the row before is not the predecessor.
            let last = if k == 0 { self.state.last_ns } else { Some(time_ns[k - 1]) };
            // Epochs of a rate that does not divide 1e9 are rounded to whole nanoseconds.
            usable[k] = last.is_none_or(|last| (t - last - self.step_ns).abs() <= 1);
        }
        let mut values = Vec::with_capacity(columns.len());
        for (j, column) in columns.iter().enumerate() {
            let averaged = self.average(j, column);
            for (ok, x) in usable.iter_mut().zip(&averaged) {
                *ok &= x.is_finite();
            }
            self.state.missing[j] += column.iter().filter(|x| !x.is_finite()).count() as u64;
            values.push(averaged);
        }
        let mut k = 0;
        while k < rows {
            let ok = usable[k];
            let end = k + usable[k..].iter().take_while(|u| **u == ok).count();
            if ok {
                self.extend(time_ns, &values, k, end, analyser, sums);
                self.state.valid += (end - k) as u64;
            } else {
                self.end_run(sums);
            }
            k = end;
        }
        self.state.rows += rows as u64;
        self.state.last_ns = time_ns.last().copied().or(self.state.last_ns);
    }

    fn average(&mut self, j: usize, column: &[f64]) -> Vec<f64> {
        let mut previous = self.state.previous[j];
        self.state.previous[j] = column.last().copied().unwrap_or(previous);
        if !self.averaged[j] {
            return column.to_vec();
        }
        column.iter().map(|x| 0.5 * (std::mem::replace(&mut previous, *x) + x)).collect()
    }

    fn extend(
        &mut self,
        time_ns: &[i64],
        values: &[Vec<f64>],
        first: usize,
        end: usize,
        analyser: &mut Analyser,
        sums: &mut Sums,
    ) {
        let mut k = first;
        while k < end {
            let take = (self.length - self.state.run.first().map_or(0, Vec::len)).min(end - k);
            for (run, column) in self.state.run.iter_mut().zip(values) {
                run.extend_from_slice(&column[k..k + take]);
            }
            k += take;
            if self.state.run.first().is_some_and(|r| r.len() == self.length) {
                let segment: Vec<&[f64]> = self.state.run.iter().map(Vec::as_slice).collect();
                let first_ns = time_ns[k - 1] - self.step_ns * (self.length as i64 - 1);
                analyser.add(first_ns, &segment, self.state.run_has_segment, sums);
                let hop = self.length / 2;
                self.state.covered += if self.state.run_has_segment { hop } else { self.length } as u64;
                self.state.run_has_segment = true;
                for run in &mut self.state.run {
                    run.drain(..hop);
                }
            }
        }
    }

    fn end_run(&mut self, sums: &Sums) {
        let state = &mut self.state;
        let len = |run: &[Vec<f64>]| run.first().map_or(0, Vec::len);
        if sums.total.segments == 0 && len(&state.run) > len(&state.longest) {
            std::mem::swap(&mut state.run, &mut state.longest);
        }
        state.run.iter_mut().for_each(Vec::clear);
        if sums.total.segments > 0 {
            state.longest.iter_mut().for_each(Vec::clear);
        }
        state.run_has_segment = false;
    }

    /// When no run was as long as a segment: the longest of them, to be cut into shorter segments.
    pub fn longest_run(&mut self, sums: &Sums) -> &[Vec<f64>] {
        self.end_run(sums);
        &self.state.longest
    }
}

/// The longest length up to `samples` that is divisible by 4 and has small prime factors, for a fast transform; at least
/// [`SHORTEST`].
#[must_use]
pub fn longest_length(samples: usize) -> usize {
    let smooth = |n: &usize| {
        let mut m = *n;
        for p in [2, 3, 5] {
            while m.is_multiple_of(p) {
                m /= p;
            }
        }
        m == 1 && n.is_multiple_of(4)
    };
    (SHORTEST..=samples).rev().find(smooth).unwrap_or(SHORTEST)
}

/// Below this a segment has hardly a bin above the window's main lobe.
pub const SHORTEST: usize = 16;

/// The longest length of which `samples` hold three half-overlapping segments; none when there is none.
#[must_use]
pub fn shorter_length(samples: usize) -> Option<usize> {
    (samples >= 2 * SHORTEST).then(|| longest_length(samples / 2))
}

/// Cuts one run into segments of the analyser's length; times count from its start.
#[must_use]
pub fn cut(run: &[Vec<f64>], layout: &Layout, analyser: &mut Analyser) -> Sums {
    let mut sums = Sums::new(analyser.plan(), layout);
    let (length, hop) = (analyser.plan().length, analyser.plan().hop());
    let samples = run.first().map_or(0, Vec::len);
    let mut first = 0;
    while first + length <= samples {
        let segment: Vec<&[f64]> = run.iter().map(|c| &c[first..first + length]).collect();
        let first_ns = (1e9 * first as f64 / analyser.plan().rate_hz) as i64;
        analyser.add(first_ns, &segment, first > 0, &mut sums);
        first += hop;
    }
    sums
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::spectra::Plan;

    fn layout() -> Layout {
        Layout {
            channels: vec!["a".into(), "b".into()],
            series: vec!["s".into()],
            regressors: vec![],
            coefficients: vec![],
        }
    }

    fn run(length: usize, batch: usize, columns: &[Vec<f64>], times: &[i64]) -> (Sums, State) {
        let mut analyser = Analyser::new(Plan::new(length, 10.0), &layout());
        let mut sums = Sums::new(analyser.plan(), &layout());
        let mut segmenter = Segmenter::new(length, 100, vec![false, false, true]);
        for first in (0..times.len()).step_by(batch) {
            let end = (first + batch).min(times.len());
            let part: Vec<&[f64]> = columns.iter().map(|c| &c[first..end]).collect();
            segmenter.push(&times[first..end], &part, &mut analyser, &mut sums);
        }
        segmenter.end_run(&sums);
        (sums, segmenter.state)
    }

    fn noise(n: usize, seed: u64) -> Vec<f64> {
        let mut x = seed;
        (0..n)
            .map(|_| {
                x = x.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
                (x >> 11) as f64 / (1u64 << 53) as f64 - 0.5
            })
            .collect()
    }

    #[test]
    fn the_size_of_a_batch_changes_no_bit() {
        let mut columns: Vec<Vec<f64>> = (1..4).map(|s| noise(1000, s)).collect();
        columns[1][333] = f64::NAN;
        let times: Vec<i64> = (0..1000).map(|k| 100 * (k + i64::from(k > 600))).collect();
        let whole = run(64, 1000, &columns, &times);
        for batch in [1, 7, 64, 777] {
            let parts = run(64, batch, &columns, &times);
            assert_eq!(parts.0, whole.0);
            assert_eq!(
                (parts.1.valid, parts.1.covered, parts.1.missing.clone()),
                (997, whole.1.covered, vec![0, 1, 0])
            );
        }
    }

    /// Runs 1..333, 334..601 and 602..1000 (the average needs a predecessor): each starts its own segments.
    #[test]
    fn a_segment_never_spans_a_gap() {
        let mut columns: Vec<Vec<f64>> = (1..4).map(|s| noise(1000, s)).collect();
        columns[1][333] = f64::NAN;
        let times: Vec<i64> = (0..1000).map(|k| 100 * (k + i64::from(k > 600))).collect();
        let (sums, state) = run(64, 100, &columns, &times);
        let segments = |samples: u64| (samples - 64) / 32 + 1;
        let want = [332, 267, 398].map(segments);
        assert_eq!(sums.total.segments, want.iter().sum::<u64>());
        assert_eq!(sums.total.overlaps, want.iter().map(|n| n - 1).sum::<u64>());
        assert_eq!(state.covered, want.iter().map(|n| 32 * (n + 1)).sum::<u64>());
    }

    #[test]
    fn a_regressor_is_averaged_with_its_predecessor() {
        let columns = [vec![0.0; 8], vec![0.0; 8], (0..8).map(f64::from).collect()];
        let times: Vec<i64> = (0..8).map(|k| 100 * k).collect();
        let (_, state) = run(64, 3, &columns, &times);
        assert_eq!(state.longest[2], [0.5, 1.5, 2.5, 3.5, 4.5, 5.5, 6.5]);
    }

    #[test]
    fn shorter_lengths_hold_three_segments() {
        assert_eq!(shorter_length(100), Some(48));
        assert_eq!(shorter_length(16383), Some(8100));
        assert_eq!(shorter_length(31), None);
        for n in 32..2000 {
            assert!(shorter_length(n).is_some_and(|l| 2 * l <= n && l % 4 == 0));
        }
    }
}
