//! From rows to segments: gaps respected, memory bounded, nothing depending on where a batch ends.

use std::borrow::Cow;

use crate::spectra::{Plan, SHORTEST};

/// Takes what a [`Segmenter`] cuts.
pub trait Cuts {
    /// Lengths of segments.
    fn plan(&self) -> &Plan;

    /// A segment of the `taper`-th length, one slice per column, the first sample at `first_ns`; `overlaps` when the
    /// segment before it has the same length and shares its first half.
    fn segment(&mut self, taper: usize, first_ns: i64, columns: &[&[f64]], overlaps: bool);

    /// Every sample of a run once, as it comes, of all columns; before the segment that it completes.
    fn rows(&mut self, _first_ns: i64, _columns: &[&[f64]]) {}

    /// Every sample once, in fixed portions, whatever the batches.
    fn samples(&mut self, _first_ns: i64, _columns: &[&[f64]]) {}

    /// A segment of full length and its samples have been given.
    fn between(&mut self) {}

    /// A run that has ended before it gave a segment of full length, all of its samples.
    fn short_run(&mut self, _first_ns: i64, _columns: &[&[f64]]) {}

    /// A run has ended: its last samples, less than a segment of full length, whatever shorter ones there were or come.
    fn tail(&mut self, _first_ns: i64, _columns: &[&[f64]]) {}

    /// The run of samples has ended.
    fn gap(&mut self) {}
}

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
    /// The current run's samples that a future segment may still need, per column that segments have.
    pub run: Vec<Vec<f64>>,
    /// Whether the current run has given a segment.
    pub run_has_segment: bool,
    /// Time of its last sample, ns.
    pub run_end_ns: i64,
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
                run_end_ns: 0,
                rows: 0,
                valid: 0,
                covered: 0,
                missing: vec![0; n],
            },
        }
    }

    /// The same with the first `columns` in its segments alone; the others are handed on as they come ([`Cuts::rows`])
    /// and never kept.
    pub fn of_first(mut self, columns: usize) -> Self {
        self.state.run.truncate(columns);
        self
    }

    /// Adds rows: `columns[j][k]` is column j at `time_ns[k]`, NaN where there is no value. `to` takes the segments.
    pub fn cut(&mut self, time_ns: &[i64], columns: &[&[f64]], to: &mut impl Cuts) {
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
            let whole = all_finite(column) && (!self.averaged[j] || self.state.previous[j].is_finite());
            let averaged = self.average(j, column);
            if !whole {
                usable.iter_mut().zip(averaged.iter()).for_each(|(ok, x)| *ok &= x.is_finite());
                self.state.missing[j] += column.iter().filter(|x| !x.is_finite()).count() as u64;
            }
            values.push(averaged);
        }
        let mut k = 0;
        while k < rows {
            let ok = usable[k];
            let end = k + usable[k..].iter().take_while(|u| **u == ok).count();
            if ok {
                self.extend(time_ns, &values, k, end, to);
                self.state.valid += (end - k) as u64;
            } else {
                self.cut_end(to);
            }
            k = end;
        }
        self.state.rows += rows as u64;
        self.state.last_ns = time_ns.last().copied().or(self.state.last_ns);
    }

    fn average<'a>(&mut self, j: usize, column: &'a [f64]) -> Cow<'a, [f64]> {
        let mut previous = self.state.previous[j];
        self.state.previous[j] = column.last().copied().unwrap_or(previous);
        if !self.averaged[j] {
            return Cow::Borrowed(column);
        }
        column.iter().map(|x| 0.5 * (std::mem::replace(&mut previous, *x) + x)).collect()
    }

    fn extend(&mut self, time_ns: &[i64], values: &[Cow<'_, [f64]>], first: usize, end: usize, to: &mut impl Cuts) {
        let mut k = first;
        while k < end {
            let take = (self.length - self.state.samples()).min(end - k);
            let rows: Vec<&[f64]> = values.iter().map(|c| &c[k..k + take]).collect();
            to.rows(time_ns[k], &rows);
            for (run, column) in self.state.run.iter_mut().zip(values) {
                run.reserve_exact(self.length - run.len());
                run.extend_from_slice(&column[k..k + take]);
            }
            k += take;
            self.state.run_end_ns = time_ns[k - 1];
            if self.state.samples() == self.length {
                let segment: Vec<&[f64]> = self.state.run.iter().map(Vec::as_slice).collect();
                to.segment(0, self.time_of(0), &segment, self.state.run_has_segment);
                let hop = self.length / 2;
                let new = if self.state.run_has_segment { hop } else { 0 };
                let samples: Vec<&[f64]> = segment.iter().map(|c| &c[new..]).collect();
                to.samples(self.time_of(new), &samples);
                to.between();
                self.state.covered += if self.state.run_has_segment { hop } else { self.length } as u64;
                self.state.run_has_segment = true;
                for run in &mut self.state.run {
                    run.drain(..hop);
                }
            }
        }
    }

    /// Time of a sample of the run, ns.
    fn time_of(&self, sample: usize) -> i64 {
        self.state.run_end_ns - self.step_ns * (self.state.samples() as i64 - 1 - sample as i64)
    }

    /// Ends the run: what no segment of full length covers is cut into shorter ones, as long as they fit.
    pub fn cut_end(&mut self, to: &mut impl Cuts) {
        let samples = self.state.samples();
        let lengths: Vec<usize> = to.plan().lengths().collect();
        // The first half of what is kept belongs to the last segment.
        let mut at = if self.state.run_has_segment { self.length / 2 } else { 0 };
        if at < samples {
            let rest: Vec<&[f64]> = self.state.run.iter().map(|c| &c[at..]).collect();
            to.samples(self.time_of(at), &rest);
        }
        if samples > 0 {
            let kept: Vec<&[f64]> = self.state.run.iter().map(Vec::as_slice).collect();
            if at == 0 {
                to.short_run(self.time_of(0), &kept);
            }
            to.tail(self.time_of(0), &kept);
        }
        to.gap();
        let shortest = lengths.last().copied();
        for (taper, length) in lengths.into_iter().enumerate() {
            let mut overlaps = false;
            // One segment alone keeps half of its information, two that overlap two thirds, and shorter ones do as
            // well.
            if at + length + length / 2 > samples && Some(length) != shortest {
                continue;
            }
            while at + length <= samples {
                let segment: Vec<&[f64]> = self.state.run.iter().map(|c| &c[at..at + length]).collect();
                to.segment(taper, self.time_of(at), &segment, overlaps);
                self.state.covered += if overlaps { length / 2 } else { length } as u64;
                overlaps = true;
                at += length / 2;
            }
            at += if overlaps { length / 2 } else { 0 };
        }
        self.state.run.iter_mut().for_each(Vec::clear);
        self.state.run_has_segment = false;
    }
}

impl State {
    /// Samples of the run.
    fn samples(&self) -> usize {
        self.run.first().map_or(0, Vec::len)
    }
}

/// Whether there is a value everywhere; without an early end, so that it is done several at a time.
pub fn all_finite(column: &[f64]) -> bool {
    column.iter().fold(true, |all, x| all & x.is_finite())
}

/// The longest length up to `samples` that is divisible by 4 and has small prime factors, for a fast transform; at
/// least [`SHORTEST`].
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
