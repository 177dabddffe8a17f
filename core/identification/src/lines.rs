//! Search for lines: forces and torques at one frequency, at every frequency of the whole run.
//!
//! With residuals r(f) of a tapered stretch, their declared Σ(f) and the channels' response d to a place, the power
//! that a line at f may have is `s = |dᵀΣ⁻¹r|²/(dᵀΣ⁻¹d)`: exponential with a mean of one where there is none. Levels of
//! noise are not as declared, so it is taken over its local mean, from the median of the frequencies around. Between
//! two bins of the transform it is that of their difference over √2, which a line half a bin from both raises: of a
//! line anywhere at least three quarters of the power are found.

use std::f64::consts::{LN_2, TAU};
use std::ops::Range;
use std::sync::Arc;

use nalgebra::{DMatrix, DVector};
use realfft::RealFftPlanner;
use realfft::num_complex::Complex64;
use serde::{Deserialize, Serialize};

/// Longest stretch of a search: what comes after is searched by itself, so memory does not grow.
const LONGEST: usize = 1 << 20;
/// Shortest.
const SHORTEST: usize = 2048;
/// Periods that a stretch must hold.
const PERIODS: usize = 20;
/// Values, two in a bin, on either side that give the local mean.
const AROUND: usize = 256;
/// Ratio of frequencies within which the declared noise is taken as constant.
const RATIO: f64 = 1.02;
/// Bins nearer than this to a higher peak are part of it: beyond, the taper leaves 2e-6 of its power.
const NEAR: usize = 20;
/// Part of a stretch at each end that the taper brings to zero: it costs 8 % of the power of a line, a Hann window a
/// third, and leaves nothing of the fast noise among the slow frequencies.
const TAPERED: f64 = 0.1;
/// Lines of one search that are kept.
const MOST: usize = 3;
/// A place with at least this part of the power of the best may be the cause.
const RIVAL: f64 = 0.5;

/// A place where a line may act.
#[derive(Clone, Debug, PartialEq)]
pub struct Place {
    /// Effect.
    pub effect: String,
    /// Instance.
    pub instance: String,
    /// Channels and factors.
    pub channels: Vec<(usize, f64)>,
}

/// A line that was found.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Line {
    /// Effect.
    pub effect: String,
    /// Instance.
    pub instance: String,
    /// Frequency, Hz.
    pub frequency_hz: f64,
    /// Power over the mean of the noise.
    pub power: f64,
}

/// Lines of some data.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Lines {
    /// The loudest first; at each frequency the places that may be the cause.
    pub found: Vec<Line>,
    /// Frequencies and places that were tried.
    pub tried: f64,
}

impl Lines {
    /// Adds those of other data; of a place the loudest line is kept.
    pub fn add(&mut self, other: &Self) {
        self.tried += other.tried;
        self.found.extend(other.found.iter().cloned());
        self.found.sort_by(|a, b| b.power.total_cmp(&a.power));
        let mut seen = Vec::new();
        self.found.retain(|line| {
            let new = !seen.contains(&(line.effect.clone(), line.instance.clone()));
            seen.push((line.effect.clone(), line.instance.clone()));
            new
        });
    }
}

/// A search.
pub struct LineSearch {
    places: Vec<Place>,
    /// Channels × base columns.
    residual: DMatrix<f64>,
    inverse: Arc<dyn Fn(f64) -> DMatrix<f64> + Send + Sync>,
    step_ns: i64,
    first_ns: i64,
    /// Residuals of each channel, zero in gaps.
    samples: Vec<Vec<f64>>,
    measured: Vec<bool>,
    lines: Lines,
}

impl LineSearch {
    /// Of these places; `residual` makes residuals of the first columns, `inverse` is Σ⁻¹ at a frequency.
    pub fn new(
        places: Vec<Place>,
        residual: DMatrix<f64>,
        inverse: Arc<dyn Fn(f64) -> DMatrix<f64> + Send + Sync>,
        step_ns: i64,
    ) -> Self {
        let samples = vec![Vec::new(); residual.nrows()];
        let lines = Lines::default();
        Self { places, residual, inverse, step_ns, first_ns: 0, samples, measured: Vec::new(), lines }
    }

    /// Of no place.
    pub fn nowhere() -> Self {
        Self::new(Vec::new(), DMatrix::zeros(0, 0), Arc::new(|_| DMatrix::zeros(0, 0)), 1)
    }

    /// Rows without a gap among them.
    pub fn push(&mut self, first_ns: i64, columns: &[&[f64]]) {
        if self.places.is_empty() {
            return;
        }
        let rows = columns.first().map_or(0, |c| c.len());
        if self.measured.is_empty() {
            self.first_ns = first_ns;
        }
        let mut at = ((first_ns - self.first_ns + self.step_ns / 2) / self.step_ns).max(0) as usize;
        if at + rows > LONGEST {
            self.search();
            (self.first_ns, at) = (first_ns, 0);
        }
        self.measured.resize(at, false);
        self.measured.resize(at + rows, true);
        for (samples, factors) in self.samples.iter_mut().zip(self.residual.row_iter()) {
            samples.resize(at, 0.0);
            samples.resize(at + rows, 0.0);
            for (factor, column) in factors.iter().zip(columns).filter(|(factor, _)| **factor != 0.0) {
                samples[at..].iter_mut().zip(*column).for_each(|(to, x)| *to += factor * x);
            }
        }
    }

    /// What was found.
    pub fn finish(mut self) -> Lines {
        self.search();
        self.lines
    }

    /// Searches what has come and forgets it.
    fn search(&mut self) {
        let n = self.measured.len();
        if n >= SHORTEST {
            self.taper();
            let found = self.peaks();
            self.lines.add(&found);
        }
        self.measured.clear();
        self.samples.iter_mut().for_each(Vec::clear);
    }

    /// Takes means and slopes off and brings the ends to zero along a cosine (Tukey's window).
    fn taper(&mut self) {
        let n = self.measured.len() as f64;
        let time = |k: usize| (k as f64 + 0.5) / n - 0.5;
        let counted = || self.measured.iter().enumerate().filter(|(_, m)| **m).map(|(k, _)| (k, time(k)));
        let (s0, s1, s2) = counted().fold((0.0, 0.0, 0.0), |(a, b, c), (_, t)| (a + 1.0, b + t, c + t * t));
        for samples in &mut self.samples {
            let (x0, x1) = counted().fold((0.0, 0.0), |(a, b), (k, t)| (a + samples[k], b + samples[k] * t));
            let determinant = s0 * s2 - s1 * s1;
            let slope = if determinant > 0.0 { (s0 * x1 - s1 * x0) / determinant } else { 0.0 };
            let mean = (x0 - slope * s1) / s0.max(1.0);
            for (k, (x, measured)) in samples.iter_mut().zip(&self.measured).enumerate() {
                let from_end = (0.5 - time(k).abs()) / TAPERED;
                let window = if from_end < 1.0 { 0.5 - 0.5 * (0.5 * TAU * from_end).cos() } else { 1.0 };
                *x = if *measured { window * (*x - mean - slope * time(k)) } else { 0.0 };
            }
        }
    }

    fn peaks(&self) -> Lines {
        let n = self.measured.len();
        let transform = RealFftPlanner::<f64>::new().plan_fft_forward(n);
        let spectrum = |samples: &Vec<f64>| {
            let (mut input, mut output) = (samples.clone(), transform.make_output_vec());
            transform.process(&mut input, &mut output).ok().map(|()| output)
        };
        let Some(spectra) = self.samples.iter().map(spectrum).collect::<Option<Vec<Vec<Complex64>>>>() else {
            return Lines::default();
        };
        let bins = PERIODS..n / 2;
        let tried = (2 * bins.len() * self.places.len()) as f64;
        // An exponential number is beyond this once in all that is tried.
        let least = tried.ln();
        let mut powers: Vec<(usize, f64, f64)> = Vec::new();
        for (p, place) in self.places.iter().enumerate() {
            let own = self.normalised(place, &spectra, bins.clone()).into_iter().enumerate();
            let at = |k: usize| bins.start as f64 + 0.5 * k as f64;
            powers.extend(own.map(|(k, s)| (p, at(k), s)).filter(|(.., s)| *s > least));
        }
        powers.sort_by(|a, b| b.2.total_cmp(&a.2));
        let mut peaks: Vec<(f64, f64)> = Vec::new();
        let mut found: Vec<Line> = Vec::new();
        for (p, bin, power) in powers {
            let place = &self.places[p];
            let same = |(other, _): &&(f64, f64)| (bin - other).abs() <= NEAR as f64;
            let peak = peaks.iter().find(same).copied();
            let wanted = match peak {
                Some((_, highest)) => power > RIVAL * highest,
                None => peaks.len() < MOST,
            };
            if !wanted {
                continue;
            }
            if peak.is_none() {
                peaks.push((bin, power));
            }
            if found.iter().all(|line| (&line.effect, &line.instance) != (&place.effect, &place.instance)) {
                let frequency_hz = self.refined(place, bin);
                found.push(Line {
                    effect: place.effect.clone(),
                    instance: place.instance.clone(),
                    frequency_hz,
                    power,
                });
            }
        }
        Lines { found, tried }
    }

    fn hz(&self, bin: f64) -> f64 {
        bin * 1e9 / (self.step_ns as f64 * self.measured.len() as f64)
    }

    /// `dᵀΣ⁻¹` over the root of `dᵀΣ⁻¹d` at a frequency.
    fn weights(&self, place: &Place, hz: f64) -> Vec<f64> {
        let inverse = (self.inverse)(hz);
        let mut d = DVector::zeros(inverse.nrows());
        place.channels.iter().for_each(|(channel, factor)| d[*channel] += factor);
        let w = &inverse * &d;
        let scale = d.dot(&w);
        w.iter().map(|x| if scale > 0.0 { x / scale.sqrt() } else { 0.0 }).collect()
    }

    /// Powers over the local mean, of every bin and of the frequency half a bin after it.
    fn normalised(&self, place: &Place, spectra: &[Vec<Complex64>], bins: Range<usize>) -> Vec<f64> {
        let mut all = Vec::with_capacity(2 * bins.len());
        let mut first = bins.start;
        while first < bins.end {
            let last = ((first as f64 * RATIO) as usize + 1).min(bins.end);
            let weights = self.weights(place, self.hz((first + last) as f64 / 2.0));
            let at = |bin: usize| -> Complex64 { weights.iter().zip(spectra).map(|(w, r)| r[bin] * *w).sum() };
            let mut own = at(first);
            for bin in first..last {
                let next = at(bin + 1);
                all.extend([own.norm_sqr(), 0.5 * (own - next).norm_sqr()]);
                own = next;
            }
            first = last;
        }
        let parts: Vec<(usize, f64)> = (0..all.len()).step_by(AROUND).map(|k| (k, mean_around(&all, k))).collect();
        let mut part = parts.iter().peekable();
        let mut mean = 1.0;
        for (k, power) in all.iter_mut().enumerate() {
            if let Some((_, next)) = part.next_if(|(start, _)| *start == k) {
                mean = *next;
            }
            *power /= mean;
        }
        all
    }

    /// The frequency near a bin at which the power is largest, Hz.
    fn refined(&self, place: &Place, bin: f64) -> f64 {
        let weights = self.weights(place, self.hz(bin));
        let n = self.measured.len();
        let combined: Vec<f64> =
            (0..n).map(|k| weights.iter().zip(&self.samples).map(|(w, r)| w * r[k]).sum()).collect();
        let power = |at: f64| {
            let turn = Complex64::from_polar(1.0, -TAU * at / n as f64);
            let mut phase = Complex64::new(1.0, 0.0);
            let mut sum = Complex64::default();
            for x in &combined {
                sum += phase * *x;
                phase *= turn;
            }
            sum.norm_sqr()
        };
        // Golden section: the main lobe has one maximum.
        let ratio = 0.5 * (5.0_f64.sqrt() - 1.0);
        let (mut low, mut high) = (bin - 0.5, bin + 0.5);
        while high - low > 1e-3 {
            let (a, b) = (high - ratio * (high - low), low + ratio * (high - low));
            if power(a) > power(b) { high = b } else { low = a }
        }
        self.hz(0.5 * (low + high))
    }
}

/// Mean of exponential numbers around a place, from their median.
fn mean_around(all: &[f64], first: usize) -> f64 {
    let middle = first + AROUND / 2;
    let range = middle.saturating_sub(AROUND)..(middle + AROUND).min(all.len());
    let mut around = all[range].to_vec();
    let half = around.len() / 2;
    let (_, median, _) = around.select_nth_unstable_by(half, f64::total_cmp);
    (*median / LN_2).max(f64::MIN_POSITIVE)
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;
    use rand_distr::{Distribution, StandardNormal};
    use rand_xoshiro::Xoshiro256PlusPlus;

    const N: usize = 20_000;

    fn lines(amplitude: f64, hz: f64, seed: u64) -> Lines {
        let mut noise = Xoshiro256PlusPlus::seed_from_u64(seed);
        let places =
            (0..2).map(|c| Place { effect: "line".to_owned(), instance: format!("c{c}"), channels: vec![(c, 1.0)] });
        let inverse = Arc::new(|_: f64| DMatrix::identity(2, 2));
        let mut search = LineSearch::new(places.collect(), DMatrix::identity(2, 2), inverse, 100_000_000);
        let columns: Vec<Vec<f64>> = (0..2)
            .map(|c| {
                let line = |k: usize| if c == 1 { amplitude * (TAU * hz * 0.1 * k as f64).cos() } else { 0.0 };
                let value = |k: usize| {
                    let w: f64 = StandardNormal.sample(&mut noise);
                    3.0 + w + line(k)
                };
                (0..N).map(value).collect()
            })
            .collect();
        for first in (0..N).step_by(4096) {
            // A gap of a hundred rows at the start of each part.
            let rows = (first + 100).min(N)..(first + 4096).min(N);
            let part: Vec<&[f64]> = columns.iter().map(|c| &c[rows.clone()]).collect();
            search.push(1_000_000_000_000 + 100_000_000 * rows.start as i64, &part);
        }
        search.finish()
    }

    /// A line of 9σ is the loudest that is found, in its channel, at its frequency to four σ of it, wherever it lies
    /// between two bins. Its power is 9²/2 less 7 % by the taper and at most a quarter: the root, whose σ is 0.7, is
    /// above that of the threshold by 2.9σ at least (false alarm below 1e-2 in all).
    #[test]
    fn a_line_is_found_with_its_frequency_beside_gaps() {
        // χ² of an amplitude A in n samples of unit noise is n A²/2; σ of its frequency is √3/(9π) bins.
        let amplitude = (2.0 * 81.0 / N as f64).sqrt();
        let bin_hz = 10.0 / N as f64;
        for seed in 0..16 {
            let hz = 0.123_456 + seed as f64 / 16.0 * bin_hz;
            let found = lines(amplitude, hz, seed + 1).found;
            assert_eq!(found[0].instance, "c1");
            assert!((found[0].frequency_hz - hz).abs() < 0.3 * bin_hz, "{found:?} {hz}");
        }
    }

    /// Of the power of a line of 30σ, 450, more is found on average of sixteen places between two bins than what is
    /// left at the worst of them, 0.93 by the taper times 0.745. A Hann window and bins alone leave 0.60 on average.
    #[test]
    fn more_than_two_thirds_of_the_power_of_a_line_are_found() {
        let amplitude = (2.0 * 900.0 / N as f64).sqrt();
        let of = |seed: u64| lines(amplitude, 0.123_456 + seed as f64 / 1.6 / N as f64, seed + 1).found[0].power;
        let mean = (0..16).map(of).sum::<f64>() / 16.0;
        let measured = 1.0 - 100.0 / 4096.0;
        assert!(mean > 0.93 * 0.745 * 450.0 * measured, "{mean}");
    }

    /// Without a line one is found once in a search on average; the decision is the likelihood's.
    #[test]
    fn noise_alone_has_about_one_peak() {
        let peaks: usize = (1..41).map(|seed| lines(0.0, 0.1, seed).found.len()).sum();
        // Poisson, mean below 40 as neighbours are one peak and at most three are kept: P(> 70) < 1e-5.
        assert!((4..70).contains(&peaks), "{peaks}");
    }
}
