//! Cross-spectral sums of one segment length: what the data leave behind once a segment has been read.
//!
//! `G_b = Σ_segments Σ_{bins of band b} Re(x* xᵀ)` over the columns x = (channels, series), scaled so that a channel's
//! diagonal is its one-sided PSD times the number of bins and segments. A regressor is a series times a factor in a
//! channel: series that several regressors share are transformed once. `N`, `c` and `zᵀΣ⁻¹z` of the design's §6 are
//! linear in `G_b` for **any** real Σ that is smooth across a band, so Σ can be refined, and a model changed, without
//! reading the data again. Sums add over segments, days and files. The same sums are kept for blocks of time, at most
//! [`MAX_BLOCKS`] of them, so that what the data scatter can be compared with what Σ promises, and memory does not grow
//! with the length of a run.

use std::ops::Range;
use std::sync::Arc;

use realfft::num_complex::Complex64;
use realfft::{RealFftPlanner, RealToComplex};
use serde::{Deserialize, Serialize};

/// What the columns of the sums are: channels first, then series; and how regressors are made of series.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Layout {
    /// Names of the channels.
    pub channels: Vec<String>,
    /// Names of the series, in the order in which they follow the channels.
    pub series: Vec<String>,
    /// Regressors.
    pub regressors: Vec<Regressor>,
    /// Names of the coefficients that the regressors refer to.
    pub coefficients: Vec<String>,
}

/// The response of a channel to a coefficient: `factor` times a series.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Regressor {
    /// Index of the coefficient.
    pub coefficient: usize,
    /// Index of the channel.
    pub channel: usize,
    /// Index of the series.
    pub series: usize,
    /// Unit of the channel per unit of the series and of the coefficient.
    pub factor: f64,
    /// Index of another coefficient whose value multiplies the response too.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub times: Option<usize>,
    /// Whether the series is made of commands, which answer the noise of the channels.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub in_loop: bool,
}

impl Layout {
    /// The same with products of two coefficients made linear: the second one has its value in `theta`.
    pub fn linear_at(&self, theta: &[f64]) -> Self {
        let mut linear = self.clone();
        for r in &mut linear.regressors {
            r.factor *= r.times.take().map_or(1.0, |other| theta[other]);
        }
        linear
    }

    /// Coefficients that act through series made of commands.
    pub fn in_loop(&self) -> Vec<usize> {
        let acts = |i: &usize| self.regressors.iter().any(|r| r.in_loop && r.coefficient == *i);
        (0..self.coefficients.len()).filter(acts).collect()
    }

    /// Channels and series together.
    pub fn columns(&self) -> usize {
        self.channels.len() + self.series.len()
    }
}

/// A band of neighbouring bins, `first..end`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Band {
    /// First bin.
    pub first: usize,
    /// One past the last bin.
    pub end: usize,
    /// Samples of the segments whose bins these are.
    pub of: usize,
}

impl Band {
    /// Number of bins.
    pub fn bins(self) -> usize {
        self.end - self.first
    }
}

/// The main lobe of a Hann window is two bins wide on either side: a segment's constant and slope, which are removed,
/// and what is left of a slower drift stay below this bin.
pub const FIRST_BIN: usize = 3;

/// The first bin of a plan for what is slow ([`Plan::slow`]). A periodic Hann window has a constant in bins −1 to 1
/// alone, so the second is free of what a constant leaves; the removed slope takes 0.155 of the power of white noise
/// there, most of its odd part, and less than 0.016 in any bin above.
pub const FIRST_SLOW_BIN: usize = 2;

/// Long segments, for what is slow, are so many times as long as the others.
pub const LONG: usize = 16;

/// What the removed straight line leaves of white noise in [`FIRST_SLOW_BIN`].
const LEFT_IN_SLOW_BIN: f64 = 0.845;

/// Bins up to this fraction of their frequency are weighed alike, by the mean of Σ over them. A PSD in f⁴ changes by
/// ±12 % across, and a wrong weight costs information only in second order: half a per cent.
const RELATIVE_WIDTH: f64 = 1.0 / 16.0;

/// Blocks of time that are kept apart. When there would be more, each becomes twice as long.
pub const MAX_BLOCKS: usize = 25;

/// Length of a block at first, ns: an hour, or two segments where these are longer than half an hour.
const FIRST_BLOCK_NS: i64 = 3_600_000_000_000;

/// Shortest segment: below this there is hardly a bin above the window's main lobe.
pub const SHORTEST: usize = 16;

/// Bands, and the segments whose bins fall into them: of the full length, and of its halves down to [`SHORTEST`] for
/// what gaps leave over. A short segment has no bins in the lowest bands and counts in the others.
#[derive(Clone)]
pub struct Plan {
    /// Samples of the longest segment, divisible by four.
    pub length: usize,
    /// Samples per second.
    pub rate_hz: f64,
    /// Bands from the first bin to the last below Nyquist, in bins of the longest segment.
    pub bands: Vec<Band>,
    /// The first bin that counts of any segment, with which spectra begin.
    pub first_bin: usize,
    /// Bands below the first bin of these segments, which stand before the others and have bins of [`LONG`] times as
    /// long ones.
    pub slow_bands: usize,
    /// Samples of the segments whose bins the other bands are told in.
    bins_of: usize,
    /// The longest segment first.
    tapers: Vec<Taper>,
}

/// A length of segment.
#[derive(Clone)]
struct Taper {
    length: usize,
    /// The first of its bins that counts.
    first_bin: usize,
    window: Vec<f64>,
    fft: Arc<dyn RealToComplex<f64>>,
    /// `Σ w²`, `Σ w⁴` and `Σ w²(t) w²(t + L/2)`.
    window_sums: [f64; 3],
    /// `Σ w² (t − L/2)²`.
    window_moment: f64,
    /// Its bins in each band of the plan.
    bins: Vec<Range<usize>>,
    /// The part of each band's time and bandwidth that its bins stand for.
    part: Vec<f64>,
}

impl Taper {
    /// Periodic Hann window of a segment, its bins from the first in the bands of a plan of segments of another length.
    fn new(length: usize, first_bin: usize, bands: &[Band]) -> Self {
        let window: Vec<f64> =
            (0..length).map(|t| 0.5 - 0.5 * (std::f64::consts::TAU * t as f64 / length as f64).cos()).collect();
        let squared: Vec<f64> = window.iter().map(|w| w * w).collect();
        let bins: Vec<Range<usize>> =
            bands.iter().map(|b| bins_between(b.first..b.end, b.of, length, first_bin)).collect();
        let part = |(b, own): (&Band, &Range<usize>)| (own.len() * b.of) as f64 / (length * b.bins()) as f64;
        Self {
            part: bands.iter().zip(&bins).map(part).collect(),
            bins,
            window_sums: [
                squared.iter().sum(),
                squared.iter().map(|w| w * w).sum(),
                squared.iter().zip(&squared[length / 2..]).map(|(a, b)| a * b).sum(),
            ],
            window_moment: squared.iter().enumerate().map(|(t, w)| w * (t as f64 - length as f64 / 2.0).powi(2)).sum(),
            fft: RealFftPlanner::new().plan_fft_forward(length),
            window,
            length,
            first_bin,
        }
    }
}

/// Bins of segments of `length` samples whose frequencies lie between bins of segments of another length, from
/// `first_bin` on.
fn bins_between(bins: Range<usize>, of: usize, length: usize, first_bin: usize) -> Range<usize> {
    let own = |bin: usize| (bin * length).div_ceil(of);
    let first = own(bins.start).max(first_bin);
    first..own(bins.end).max(first)
}

/// Bands of neighbouring bins from the first to the last below Nyquist, of segments of `length` samples.
fn bands_from(first_bin: usize, length: usize) -> Vec<Band> {
    let nyquist = length / 2;
    let mut bands = Vec::new();
    let mut first = first_bin;
    while first < nyquist {
        let width = ((first as f64 * RELATIVE_WIDTH) as usize).max(1);
        let end = (first + width).min(nyquist);
        bands.push(Band { first, end, of: length });
        first = end;
    }
    bands
}

impl Plan {
    /// Segments of `length` samples, divisible by four, and of its halves.
    pub fn new(length: usize, rate_hz: f64) -> Self {
        Self::from_bin(FIRST_BIN, length, length, rate_hz)
    }

    /// As [`Self::new`]; segments longer than `ordinary` samples, which are there for what is slow, count from
    /// [`FIRST_SLOW_BIN`] on.
    pub fn slow(length: usize, ordinary: usize, rate_hz: f64) -> Self {
        Self::from_bin(FIRST_SLOW_BIN, length, ordinary, rate_hz)
    }

    /// As [`Self::new`], with bands for what is slower, from [`FIRST_SLOW_BIN`] of segments [`LONG`] times as long to
    /// half an ordinary bin below [`FIRST_BIN`], where that bin begins.
    pub fn with_slow_bands(length: usize, rate_hz: f64) -> Self {
        let mut bands = bands_from(FIRST_SLOW_BIN, LONG * length);
        bands.retain(|b| b.end <= LONG * FIRST_BIN - LONG / 2);
        let slow_bands = bands.len();
        bands.extend(bands_from(FIRST_BIN, length));
        Self { slow_bands, ..Self::of_bands(bands, FIRST_BIN, length, length, rate_hz) }
    }

    fn from_bin(first_bin: usize, length: usize, ordinary: usize, rate_hz: f64) -> Self {
        Self::of_bands(bands_from(first_bin, length), first_bin, length, ordinary, rate_hz)
    }

    fn of_bands(bands: Vec<Band>, first_bin: usize, length: usize, ordinary: usize, rate_hz: f64) -> Self {
        let halves = std::iter::successors(Some(length), |l| l.is_multiple_of(8).then_some(l / 2));
        let lengths = halves.take_while(|l| *l == length || *l >= SHORTEST);
        let first = |l: usize| if l > ordinary { first_bin } else { FIRST_BIN };
        let tapers = lengths.map(|l| Taper::new(l, first(l), &bands)).collect();
        Self { tapers, length, rate_hz, bands, first_bin, slow_bands: 0, bins_of: length }
    }

    /// For one segment of another length, between half the longest and the longest: the bands of this plan that half
    /// the longest has no bins in.
    pub fn between_halves(&self, length: usize) -> Self {
        let out_of_reach = |b: &&Band| b.first < 2 * self.first_bin;
        let bands: Vec<Band> = self.bands.iter().take_while(out_of_reach).copied().collect();
        let tapers = vec![Taper::new(length, self.first_bin, &bands)];
        let Self { rate_hz, first_bin, bins_of, .. } = *self;
        Self { tapers, length, rate_hz, bands, first_bin, slow_bands: 0, bins_of }
    }

    /// Bins of segments of the `taper`-th length that lie between bins of the longest, in the bands of this plan alone.
    pub fn bins_between(&self, taper: usize, bins: Range<usize>) -> Range<usize> {
        let end = self.bands.last().map_or(0, |b| b.end);
        let taper = &self.tapers[taper];
        bins_between(bins.start.min(end)..bins.end.min(end), self.bins_of, taper.length, taper.first_bin)
    }

    /// Lengths of segments, the longest first.
    pub fn lengths(&self) -> impl Iterator<Item = usize> {
        self.tapers.iter().map(|t| t.length)
    }

    /// Bins of each band in segments of the `taper`-th length.
    pub fn bins(&self, taper: usize) -> &[Range<usize>] {
        &self.tapers[taper].bins
    }

    /// Frequency of the middle of a band, Hz.
    pub fn frequency_hz(&self, band: Band) -> f64 {
        self.hz(band, 0.5 * (band.first + band.end - 1) as f64)
    }

    /// Frequency of a bin of the segments whose bins a band has, Hz.
    pub fn hz(&self, band: Band, bin: f64) -> f64 {
        bin * self.rate_hz / band.of as f64
    }

    /// Frequency of a bin of the longest segment, Hz.
    pub fn bin_hz(&self, bin: f64) -> f64 {
        bin * self.rate_hz / self.bins_of as f64
    }

    /// Bands that segments of the longest length and shorter ones have bins in: all but the slow ones.
    pub fn ordinary_bands(&self) -> Range<usize> {
        self.slow_bands..self.bands.len()
    }

    fn first_block_ns(&self) -> i64 {
        FIRST_BLOCK_NS.max((2e9 * self.length as f64 / self.rate_hz) as i64)
    }
}

/// Cross-spectra added over segments.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Spectra {
    /// `G_b`, packed lower triangles, band after band.
    pub packed: Vec<f64>,
    /// Per band, the expectation of a channel's diagonal of `G` over its one-sided PSD.
    pub expected: Vec<f64>,
    /// Per band, `Σ_t g(t)` with `g(t) = Σ_segments w²(t)`: the weight with which a sample entered.
    pub weight: Vec<f64>,
    /// Per band, `Σ_t g²(t)`.
    pub weight_squared: Vec<f64>,
    /// Segments added, of all lengths.
    pub segments: u64,
}

impl Spectra {
    /// Nothing added yet.
    pub fn zero(bands: usize, columns: usize) -> Self {
        Self {
            packed: vec![0.0; bands * triangle(columns)],
            expected: vec![0.0; bands],
            weight: vec![0.0; bands],
            weight_squared: vec![0.0; bands],
            segments: 0,
        }
    }

    /// The weights alone, of some bands, as if the others had not been seen.
    pub fn weights_of(&self, bands: Range<usize>) -> Self {
        let of = |x: &[f64]| (0..x.len()).map(|b| if bands.contains(&b) { x[b] } else { 0.0 }).collect();
        Self {
            packed: Vec::new(),
            expected: of(&self.expected),
            weight: of(&self.weight),
            weight_squared: of(&self.weight_squared),
            segments: self.segments,
        }
    }

    /// Takes the sums of the first bands from elsewhere.
    pub fn replace_first(&mut self, bands: usize, other: &Self) {
        let entries = bands * (self.packed.len() / self.expected.len().max(1));
        self.packed[..entries].copy_from_slice(&other.packed[..entries]);
        for (own, other) in [
            (&mut self.expected, &other.expected),
            (&mut self.weight, &other.weight),
            (&mut self.weight_squared, &other.weight_squared),
        ] {
            own[..bands].copy_from_slice(&other[..bands]);
        }
    }

    /// Adds the spectra of other segments.
    pub fn add(&mut self, other: &Self) {
        for (a, b) in [
            (&mut self.packed, &other.packed),
            (&mut self.expected, &other.expected),
            (&mut self.weight, &other.weight),
            (&mut self.weight_squared, &other.weight_squared),
        ] {
            a.iter_mut().zip(b).for_each(|(a, b)| *a += b);
        }
        self.segments += other.segments;
    }

    /// Counts a segment of the `taper`-th length, and its overlap with the one before it.
    pub fn count_segment(&mut self, plan: &Plan, taper: usize, overlaps: bool) {
        self.count_bands(plan, taper, overlaps, 0..plan.bands.len());
        self.segments += 1;
    }

    /// As [`Self::count_segment`], for a segment that is one of several looks at the same time and serves these bands
    /// alone; it does not count as a segment.
    pub fn count_bands(&mut self, plan: &Plan, taper: usize, overlaps: bool, bands: Range<usize>) {
        let taper = &plan.tapers[taper];
        let [w2, w4, _] = taper.window_sums;
        for b in bands.clone() {
            let part = taper.part[b];
            let slow = if taper.bins[b].contains(&FIRST_SLOW_BIN) { 1.0 - LEFT_IN_SLOW_BIN } else { 0.0 };
            self.expected[b] += (taper.bins[b].len() as f64 - slow) * 2.0 * w2 / taper.length as f64;
            self.weight[b] += w2 * part;
            self.weight_squared[b] += w4 * part;
        }
        if overlaps {
            self.count_overlap(taper, bands);
        }
    }

    fn count_overlap(&mut self, taper: &Taper, bands: Range<usize>) {
        let [_, _, cross] = taper.window_sums;
        bands.for_each(|b| self.weight_squared[b] += 2.0 * cross * taper.part[b]);
    }

    /// What χ² with the declared Σ counts per band and channel: the observations expected, times the part that is kept.
    pub fn counted(&self) -> impl Iterator<Item = f64> {
        self.kept().into_iter().zip(&self.expected).map(|(kept, expected)| kept * expected)
    }

    /// Per band `Σg/Σg²`: sums times this are information, their inverse a covariance. One Hann segment keeps 0.514 of
    /// the information of its samples, segments that overlap by half 0.947. Zero where no segment reaches.
    pub fn kept(&self) -> Vec<f64> {
        let pairs = self.weight.iter().zip(&self.weight_squared);
        pairs.map(|(g, g2)| if *g2 > 0.0 { g / g2 } else { 0.0 }).collect()
    }

    /// As [`Self::kept`], with every band worth the same time, that of the highest one: sums times this are the means
    /// of the spectra times one time.
    ///
    /// Where commands are regressors, the score of a gain inside the loop has another expectation in every band and
    /// only their sum over all bands is zero (see [`crate::levels`]). Bands that stand for less time than others, as
    /// the lowest ones do at the ends of a run, would bias it.
    pub fn equal_time_weights(&self) -> Vec<f64> {
        let time = self.kept().last().zip(self.weight.last()).map_or(0.0, |(kept, weight)| kept * weight);
        self.weight.iter().map(|g| if *g > 0.0 { time / g } else { 0.0 }).collect()
    }

    /// Per band, complex observations: half the samples that would know as much, times the band's part of all
    /// frequencies.
    pub fn observations(&self, plan: &Plan) -> Vec<f64> {
        let kept = self.kept();
        plan.bands
            .iter()
            .enumerate()
            .map(|(b, band)| self.weight[b] * kept[b] * band.bins() as f64 / band.of as f64)
            .collect()
    }

    /// The lower triangle of band `b`, row after row.
    pub fn band(&self, b: usize, columns: usize) -> &[f64] {
        let n = triangle(columns);
        &self.packed[b * n..(b + 1) * n]
    }
}

/// The spectra of the segments whose middle lies in one stretch of time.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Block {
    /// Number of the block: its start over its length.
    pub number: i64,
    /// Spectra of its segments; an overlap across its start is not counted.
    pub spectra: Spectra,
    /// The index of the length of its first segment, where that overlaps the last of the block before.
    pub overlaps_before: Option<usize>,
}

/// The sums over all time, and block by block.
#[derive(Clone, Debug, PartialEq)]
pub struct Sums {
    /// All segments.
    pub total: Spectra,
    /// Length of a block, ns.
    pub block_ns: i64,
    /// Blocks with segments, in order of time.
    pub blocks: Vec<Block>,
}

impl Sums {
    /// Nothing added yet.
    pub fn new(plan: &Plan, layout: &Layout) -> Self {
        let total = Spectra::zero(plan.bands.len(), layout.columns());
        Self { total, block_ns: plan.first_block_ns(), blocks: Vec::new() }
    }

    /// Adds the sums of other segments, of the same plan and layout, none of them twice.
    pub fn add(&mut self, plan: &Plan, other: &Self) {
        self.total.add(&other.total);
        let mut other = other.clone();
        while self.block_ns != other.block_ns {
            if self.block_ns < other.block_ns { self.coarsen(plan) } else { other.coarsen(plan) }
        }
        self.blocks.append(&mut other.blocks);
        self.blocks.sort_by_key(|b| b.number);
        self.merge_equal(plan);
        while self.blocks.len() > MAX_BLOCKS {
            self.coarsen(plan);
        }
    }

    /// The block of a segment whose middle lies at `middle_ns`, and whether it was there before.
    fn block(&mut self, plan: &Plan, columns: usize, middle_ns: i64) -> (&mut Block, bool) {
        let known = |s: &Self| s.blocks.last().is_some_and(|b| b.number == middle_ns.div_euclid(s.block_ns));
        while !known(self) && self.blocks.len() >= MAX_BLOCKS {
            self.coarsen(plan);
        }
        let was_there = known(self);
        if !was_there {
            let spectra = Spectra::zero(plan.bands.len(), columns);
            let number = middle_ns.div_euclid(self.block_ns);
            self.blocks.push(Block { number, spectra, overlaps_before: None });
        }
        let last = self.blocks.len() - 1;
        (&mut self.blocks[last], was_there)
    }

    /// Blocks of twice the length.
    fn coarsen(&mut self, plan: &Plan) {
        self.block_ns *= 2;
        self.blocks.iter_mut().for_each(|b| b.number = b.number.div_euclid(2));
        self.merge_equal(plan);
    }

    fn merge_equal(&mut self, plan: &Plan) {
        let mut merged: Vec<Block> = Vec::with_capacity(self.blocks.len());
        for block in self.blocks.drain(..) {
            match merged.last_mut() {
                Some(last) if last.number == block.number => {
                    last.spectra.add(&block.spectra);
                    if let Some(taper) = block.overlaps_before {
                        last.spectra.count_overlap(&plan.tapers[taper], 0..plan.bands.len());
                    }
                }
                _ => merged.push(block),
            }
        }
        self.blocks = merged;
    }
}

/// Entries of the lower triangle of a square of `n` rows.
pub fn triangle(n: usize) -> usize {
    n * (n + 1) / 2
}

/// Turns samples into spectra; owns the scratch space.
#[derive(Clone)]
pub struct Transformer {
    time: Vec<f64>,
    spectrum: Vec<Complex64>,
    scratch: Vec<Complex64>,
}

impl Transformer {
    /// For the segments of a plan.
    pub fn new(plan: &Plan) -> Self {
        let scratch = plan.tapers.iter().map(|t| t.fft.get_scratch_len()).max().unwrap_or(0);
        Self {
            time: vec![0.0; plan.length],
            spectrum: vec![Complex64::default(); plan.length / 2 + 1],
            scratch: vec![Complex64::default(); scratch],
        }
    }

    /// Spectrum of a segment of the `taper`-th length without its constant and slope, under its window: real and
    /// imaginary part of each bin from the plan's first to the last below Nyquist, so scaled that the sum of their
    /// squares is the one-sided PSD.
    pub fn transform(&mut self, plan: &Plan, taper: usize, samples: &[f64], out: &mut [f64]) {
        let segment = &plan.tapers[taper];
        let (time, spectrum) = (&mut self.time[..segment.length], &mut self.spectrum[..=segment.length / 2]);
        // The straight line that fits the *windowed* samples best. A fit to the bare samples would take its slope from
        // the ends, where a second difference of readout noise is a hundred times louder than the lowest bins.
        let middle = (samples.len() / 2) as f64;
        let (sum, moment) = sum_and_moment(samples, &segment.window, middle);
        let (mean, slope) = (sum / segment.window_sums[0], moment / segment.window_moment);
        for (t, ((out, x), w)) in time.iter_mut().zip(samples).zip(&segment.window).enumerate() {
            *out = (x - mean - slope * (t as f64 - middle)) * w;
        }
        // The lengths are those that the plan was made for, the only thing that it refuses.
        let needed = segment.fft.get_scratch_len();
        self.scratch.resize(self.scratch.len().max(needed), Complex64::default());
        let scratch = &mut self.scratch[..needed];
        let done = segment.fft.process_with_scratch(time, spectrum, scratch);
        debug_assert!(done.is_ok());
        let scale = (4.0 / (plan.rate_hz * segment.length as f64)).sqrt();
        let used = spectrum.get(plan.first_bin..segment.length / 2).unwrap_or_default();
        for (pair, x) in out.chunks_exact_mut(2).zip(used) {
            pair[0] = x.re * scale;
            pair[1] = x.im * scale;
        }
    }
}

/// Sums side by side: a single one would wait for each of its additions.
const SIDE_BY_SIDE: usize = 8;

/// `Σ w² x` and `Σ w² (t − middle) x` of as many samples as the window has.
fn sum_and_moment(samples: &[f64], window: &[f64], middle: f64) -> (f64, f64) {
    let (mut sums, mut moments) = ([0.0; SIDE_BY_SIDE], [0.0; SIDE_BY_SIDE]);
    let (whole, rest) = samples.as_chunks::<SIDE_BY_SIDE>();
    let (windows, rest_of_window) = window.as_chunks::<SIDE_BY_SIDE>();
    let mut add = |k: usize, t: f64, x: f64, w: f64| {
        let weighted = w * w * x;
        sums[k] += weighted;
        moments[k] += (t - middle) * weighted;
    };
    for (chunk, (x, w)) in whole.iter().zip(windows).enumerate() {
        let first = (chunk * SIDE_BY_SIDE) as f64;
        (0..SIDE_BY_SIDE).for_each(|k| add(k, first + k as f64, x[k], w[k]));
    }
    let first = (whole.len() * SIDE_BY_SIDE) as f64;
    rest.iter().zip(rest_of_window).enumerate().for_each(|(k, (x, w))| add(k, first + k as f64, *x, *w));
    (sums.iter().sum(), moments.iter().sum())
}

/// Turns segments into cross-spectra.
pub struct Analyser {
    plan: Plan,
    columns: usize,
    transformer: Transformer,
    /// Per column: real and imaginary part of each bin from the plan's first, scaled.
    scaled: Vec<Vec<f64>>,
}

impl Analyser {
    /// An analyser of segments with the columns of `layout`.
    pub fn new(plan: Plan, layout: &Layout) -> Self {
        let columns = layout.columns();
        Self { transformer: Transformer::new(&plan), scaled: vec![vec![0.0; plan.length]; columns], columns, plan }
    }

    /// Bands and lengths.
    pub fn plan(&self) -> &Plan {
        &self.plan
    }

    /// Adds one segment, one slice per column, of the `taper`-th length, the first sample at `first_ns`; `overlaps`
    /// when the segment before it has the same length and shares its first half.
    pub fn add(&mut self, taper: usize, first_ns: i64, columns: &[&[f64]], overlaps: bool, sums: &mut Sums) {
        for (j, samples) in columns.iter().enumerate() {
            self.transformer.transform(&self.plan, taper, samples, &mut self.scaled[j]);
        }
        let segment = &self.plan.tapers[taper];
        let middle_ns = first_ns + (0.5e9 * segment.length as f64 / self.plan.rate_hz) as i64;
        sums.total.count_segment(&self.plan, taper, overlaps);
        let mut total = std::mem::take(&mut sums.total.packed);
        let (block, was_there) = sums.block(&self.plan, self.columns, middle_ns);
        block.spectra.count_segment(&self.plan, taper, overlaps && was_there);
        if overlaps && !was_there {
            block.overlaps_before = Some(taper);
        }
        let mut entry = total.iter_mut().zip(&mut block.spectra.packed);
        for bins in &segment.bins {
            let first = self.plan.first_bin;
            let range = 2 * (bins.start - first)..2 * (bins.end - first);
            for i in 0..self.columns {
                let a = &self.scaled[i][range.clone()];
                for (b, (g, h)) in self.scaled[..=i].iter().zip(&mut entry) {
                    let product = dot(a, &b[range.clone()]);
                    *g += product;
                    *h += product;
                }
            }
        }
        sums.total.packed = total;
    }
}

/// Scalar product in eight fixed lanes, so that it vectorises and never depends on how it was compiled in.
pub(crate) fn dot(a: &[f64], b: &[f64]) -> f64 {
    let mut lanes = [0.0; 8];
    let (a8, b8) = (a.chunks_exact(8), b.chunks_exact(8));
    let rest: f64 = a8.remainder().iter().zip(b8.remainder()).map(|(x, y)| x * y).sum();
    for (x, y) in a8.zip(b8) {
        for l in 0..8 {
            lanes[l] += x[l] * y[l];
        }
    }
    lanes.iter().sum::<f64>() + rest
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bands_cover_every_bin_once() {
        for length in [16, 48, 100, 1024, 16384] {
            let plan = Plan::new(length, 10.0);
            let mut next = FIRST_BIN;
            for band in &plan.bands {
                assert_eq!(band.first, next);
                assert!(band.bins() >= 1);
                next = band.end;
            }
            assert_eq!(next, length / 2);
        }
    }

    /// Bins of long segments go on where those of the others end: at 2.5 bins of these.
    #[test]
    fn slow_bands_end_where_the_others_begin() {
        for length in [16, 48, 100, 1024, 16384] {
            let (plan, ordinary) = (Plan::with_slow_bands(length, 10.0), Plan::new(length, 10.0));
            assert_eq!(plan.bands[plan.ordinary_bands()], ordinary.bands);
            let mut next = FIRST_SLOW_BIN;
            for band in &plan.bands[..plan.slow_bands] {
                assert_eq!((band.first, band.of), (next, 16 * length));
                next = band.end;
            }
            assert_eq!(next, 40);
            for taper in &plan.tapers {
                assert!(taper.bins[..plan.slow_bands].iter().all(Range::is_empty));
            }
        }
    }

    fn layout(channels: usize) -> Layout {
        Layout {
            channels: (0..channels).map(|c| format!("c{c}")).collect(),
            series: vec![],
            regressors: vec![],
            coefficients: vec![],
        }
    }

    /// Harris 1978: one Hann segment keeps 18/35 = 0.514 of the samples' information; with 50 % overlap 0.947.
    #[test]
    fn information_kept_by_the_taper() {
        let plan = Plan::new(4096, 10.0);
        let efficiency = |segments: usize| {
            let mut spectra = Spectra::zero(plan.bands.len(), 0);
            (0..segments).for_each(|k| spectra.count_segment(&plan, 0, k > 0));
            let samples = (plan.length / 2 * (segments + 1)) as f64;
            spectra.weight[0] * spectra.kept()[0] / samples
        };
        assert!((efficiency(1) - 18.0 / 35.0).abs() < 1e-9);
        assert!((efficiency(10_000) - 0.947).abs() < 1e-3);
    }

    /// White noise of unit PSD, by the response to each of its samples: every bin of a segment has what `count_bands`
    /// promises of it, the lowest one of a slow plan too.
    #[test]
    fn every_bin_has_the_power_that_is_promised() {
        let (length, rate_hz) = (256, 2.0);
        let plan = Plan::slow(length, length / 16, rate_hz);
        let mut weights = Spectra::zero(plan.bands.len(), 0);
        weights.count_segment(&plan, 0, false);
        let mut transformer = Transformer::new(&plan);
        let mut power = vec![0.0; plan.bands.len()];
        let mut spectrum = vec![0.0; 2 * (length / 2 - FIRST_SLOW_BIN)];
        for t in 0..length {
            let impulse: Vec<f64> = (0..length).map(|k| f64::from(u8::from(k == t))).collect();
            transformer.transform(&plan, 0, &impulse, &mut spectrum);
            for (power, bins) in power.iter_mut().zip(plan.bins(0)) {
                let rows = 2 * (bins.start - FIRST_SLOW_BIN)..2 * (bins.end - FIRST_SLOW_BIN);
                // The variance of white noise of unit one-sided PSD is half its rate.
                *power += 0.5 * rate_hz * spectrum[rows].iter().map(|x| x * x).sum::<f64>();
            }
        }
        assert_eq!(plan.bands[0], Band { first: 2, end: 3, of: length });
        for (b, (power, expected)) in power.iter().zip(&weights.expected).enumerate() {
            // A straight line leaves 1.016 in bin 3.
            let tolerance = if plan.bands[b].first == 3 { 0.017 } else { 1e-3 };
            assert!((power / expected - 1.0).abs() < tolerance, "band {b}: {power} against {expected}");
        }
    }

    /// A segment of another length has the bins that half the longest lacks, each in the band of its frequency, and no
    /// other.
    #[test]
    fn a_run_between_two_lengths_reaches_below_the_shorter() {
        let plan = Plan::slow(16_384, 1024, 10.0);
        for length in [8196, 10_000, 13_500, 16_380] {
            let between = plan.between_halves(length);
            let reach = plan.bins(1).iter().position(|bins| !bins.is_empty()).unwrap();
            assert!(between.bands.len() <= reach + 1);
            for (bins, band) in between.bins(0).iter().zip(&between.bands) {
                for k in bins.clone() {
                    let at = (k * 16_384) as f64 / length as f64;
                    assert!(band.first as f64 <= at && at < band.end as f64, "{length}: bin {k} in {band:?}");
                }
            }
            assert_eq!(between.bins(0)[0].start, FIRST_SLOW_BIN);
            assert!((between.bin_hz(3.0) - plan.bin_hz(3.0)).abs() < 1e-15);
        }
    }

    /// Each length puts every bin of its own into one band, that of its frequency.
    #[test]
    fn short_segments_share_the_bands() {
        let plan = Plan::new(16_384, 10.0);
        assert_eq!(plan.lengths().last(), Some(SHORTEST));
        for taper in &plan.tapers {
            let mut next = FIRST_BIN;
            let ratio = plan.length / taper.length;
            for (band, bins) in plan.bands.iter().zip(&taper.bins) {
                for k in bins.clone() {
                    assert!((band.first..band.end).contains(&(k * ratio)));
                    assert_eq!(k, next);
                    next += 1;
                }
            }
            assert_eq!(next, taper.length / 2);
        }
    }

    /// A sinusoid's power, by Parseval: `Σ_t w² x²` over the variance of white noise of unit PSD.
    #[test]
    fn sums_are_the_power_over_unit_noise() {
        let (rate, length) = (10.0, 1000);
        let mut analyser = Analyser::new(Plan::new(length, rate), &layout(1));
        let mut sums = Sums::new(analyser.plan(), &layout(1));
        let x: Vec<f64> = (0..length).map(|t| 2.0 * (0.7 * t as f64).sin() + 5.0 + 0.01 * t as f64).collect();
        analyser.add(0, 0, &[&x], false, &mut sums);
        let total: f64 = sums.total.packed.iter().sum();
        // Variance of white noise of one-sided PSD 1 at rate f_s is f_s/2; Σ w² sin² = (3/8) L / 2.
        let want = 0.375 * length as f64 * 0.5 * 4.0 / (rate / 2.0);
        assert!((total / want - 1.0).abs() < 1e-3, "{total} against {want}");
    }

    /// Blocks add up to the total, overlaps across their ends apart, however often they were joined; and never become
    /// many.
    #[test]
    fn blocks_are_the_total_in_parts() {
        let mut analyser = Analyser::new(Plan::new(16, 1.0), &layout(1));
        let mut sums = Sums::new(analyser.plan(), &layout(1));
        let x: Vec<f64> = (0..16).map(|t| f64::from(t * t % 7)).collect();
        for k in 0..30_000i64 {
            analyser.add(0, k * 8_000_000_000, &[&x], k > 0, &mut sums);
            assert!(sums.blocks.len() <= MAX_BLOCKS);
        }
        assert!(sums.blocks.len() > MAX_BLOCKS / 2 - 1, "{}", sums.blocks.len());
        assert_eq!(sums.blocks.iter().map(|b| b.spectra.segments).sum::<u64>(), 30_000);
        let of = |f: fn(&Block) -> f64| sums.blocks.iter().map(f).sum::<f64>();
        let power = of(|b| b.spectra.packed.iter().sum());
        let total: f64 = sums.total.packed.iter().sum();
        assert!((power / total - 1.0).abs() < 1e-12);
        let across = 2.0 * analyser.plan.tapers[0].window_sums[2] * (sums.blocks.len() - 1) as f64;
        let squares = of(|b| b.spectra.weight_squared[0]) + across;
        assert!((squares / sums.total.weight_squared[0] - 1.0).abs() < 1e-12);
    }

    /// Two halves of a record, with the tail carried from one to the other, add up to the whole, whichever comes first
    /// and whatever the length of their blocks.
    #[test]
    fn sums_of_parts_add_up() {
        let mut analyser = Analyser::new(Plan::new(16, 1.0), &layout(1));
        let segment = |k: i64| -> Vec<f64> { (0..16).map(|t| ((8 * k + t) as f64).sin()).collect() };
        let mut whole = Sums::new(analyser.plan(), &layout(1));
        let (mut first, mut second) = (whole.clone(), whole.clone());
        for k in 0..15_000i64 {
            analyser.add(0, k * 8_000_000_000, &[&segment(k)], k > 0, &mut whole);
            let part = if k < 14_000 { &mut first } else { &mut second };
            analyser.add(0, k * 8_000_000_000, &[&segment(k)], k > 0, part);
        }
        assert!(first.block_ns > second.block_ns);
        for (a, b) in [(&first, &second), (&second, &first)] {
            let mut sum = a.clone();
            sum.add(analyser.plan(), b);
            assert_eq!(
                (sum.total.segments, sum.block_ns, sum.blocks.len()),
                (15_000, whole.block_ns, whole.blocks.len())
            );
            for (a, b) in sum.blocks.iter().zip(&whole.blocks) {
                assert_eq!((a.number, a.spectra.segments), (b.number, b.spectra.segments));
                assert!((a.spectra.kept()[0] / b.spectra.kept()[0] - 1.0).abs() < 1e-12);
            }
            let apart = sum.total.packed.iter().zip(&whole.total.packed).map(|(a, b)| (a / b - 1.0).abs());
            assert!(apart.fold(0.0, f64::max) < 1e-12);
        }
    }
}
