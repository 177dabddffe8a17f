//! Cross-spectral sums of one segment length: what the data leave behind once a segment has been read.
//!
//! `G_b = Σ_segments Σ_{bins of band b} Re(x* xᵀ)` over the columns x = (channels, series), scaled so that a channel's diagonal is
//! its one-sided PSD times the number of bins and segments. A regressor is a series times a factor in a channel: series that
//! several regressors share are transformed once. `N`, `c` and `zᵀΣ⁻¹z` of the design's §6 are linear in `G_b` for **any** real Σ
//! that is smooth across a band, so Σ can be refined, and a model changed, without reading the data again. Sums add over
//! segments, days and files. The same sums are kept for blocks of time, at most [`MAX_BLOCKS`] of them, so that what the data
//! scatter can be compared with what Σ promises, and memory does not grow with the length of a run.

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
}

impl Layout {
    /// Channels and series together.
    #[must_use]
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
}

impl Band {
    /// Number of bins.
    #[must_use]
    pub fn bins(self) -> usize {
        self.end - self.first
    }
}

/// The main lobe of a Hann window is two bins wide on either side: a segment's constant and slope, which are removed, and what
/// is left of a slower drift stay below this bin.
pub const FIRST_BIN: usize = 3;

/// Bins up to this fraction of their frequency are weighed alike, by the mean of Σ over them. A PSD in f⁴ changes by ±12 % across,
/// and a wrong weight costs information only in second order: half a per cent.
const RELATIVE_WIDTH: f64 = 1.0 / 16.0;

/// Blocks of time that are kept apart. When there would be more, each becomes twice as long.
pub const MAX_BLOCKS: usize = 25;

/// Length of a block at first, ns: an hour, or two segments where these are longer than half an hour.
const FIRST_BLOCK_NS: i64 = 3_600_000_000_000;

/// Everything that depends on the length of a segment: window, transform, bands.
pub struct Plan {
    /// Samples of a segment; even.
    pub length: usize,
    /// Samples per second.
    pub rate_hz: f64,
    /// Bands from [`FIRST_BIN`] to the last bin below Nyquist.
    pub bands: Vec<Band>,
    window: Vec<f64>,
    fft: Arc<dyn RealToComplex<f64>>,
    /// `Σ w²`, `Σ w⁴` and `Σ w²(t) w²(t + L/2)`.
    window_sums: [f64; 3],
    /// `Σ w² (t − L/2)²`.
    window_moment: f64,
}

impl Plan {
    /// Periodic Hann window and bands for segments of `length` samples.
    #[must_use]
    pub fn new(length: usize, rate_hz: f64) -> Self {
        let window: Vec<f64> =
            (0..length).map(|t| 0.5 - 0.5 * (std::f64::consts::TAU * t as f64 / length as f64).cos()).collect();
        let squared: Vec<f64> = window.iter().map(|w| w * w).collect();
        let window_sums = [
            squared.iter().sum(),
            squared.iter().map(|w| w * w).sum(),
            squared.iter().zip(&squared[length / 2..]).map(|(a, b)| a * b).sum(),
        ];
        let window_moment = squared.iter().enumerate().map(|(t, w)| w * (t as f64 - length as f64 / 2.0).powi(2)).sum();
        let nyquist = length / 2;
        let mut bands = Vec::new();
        let mut first = FIRST_BIN;
        while first < nyquist {
            let width = ((first as f64 * RELATIVE_WIDTH) as usize).max(1);
            let end = (first + width).min(nyquist);
            bands.push(Band { first, end });
            first = end;
        }
        let fft = RealFftPlanner::new().plan_fft_forward(length);
        Self { length, rate_hz, bands, window, fft, window_sums, window_moment }
    }

    /// Frequency of the middle of a band, Hz.
    #[must_use]
    pub fn frequency_hz(&self, band: Band) -> f64 {
        self.bin_hz(0.5 * (band.first + band.end - 1) as f64)
    }

    /// Frequency of a bin, Hz.
    #[must_use]
    pub fn bin_hz(&self, bin: f64) -> f64 {
        bin * self.rate_hz / self.length as f64
    }

    /// Samples between the starts of two segments: half a segment.
    #[must_use]
    pub fn hop(&self) -> usize {
        self.length / 2
    }

    /// Expectation of a channel's diagonal of `G` over its one-sided PSD, per bin and segment.
    #[must_use]
    pub fn expected_per_bin(&self) -> f64 {
        2.0 * self.window_sums[0] / self.length as f64
    }

    fn first_block_ns(&self) -> i64 {
        FIRST_BLOCK_NS.max((2e9 * self.length as f64 / self.rate_hz) as i64)
    }
}

/// Cross-spectra added over segments.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Spectra {
    /// `G_b`, packed lower triangles, band after band.
    pub packed: Vec<f64>,
    /// Segments added.
    pub segments: u64,
    /// Pairs of them that overlap.
    pub overlaps: u64,
}

impl Spectra {
    fn zero(plan: &Plan, layout: &Layout) -> Self {
        Self { packed: vec![0.0; plan.bands.len() * triangle(layout.columns())], segments: 0, overlaps: 0 }
    }

    fn add(&mut self, other: &Self) {
        self.packed.iter_mut().zip(&other.packed).for_each(|(a, b)| *a += b);
        self.segments += other.segments;
        self.overlaps += other.overlaps;
    }

    /// `Σ_t g(t)` and `Σ_t g²(t)` with `g(t) = Σ_segments w²(t)`: the weight with which a sample entered.
    ///
    /// Estimates from weighted sums have covariance `N⁻¹ Σg²/Σg`; one Hann segment keeps 0.514 of the information, segments
    /// that overlap by half 0.947.
    #[must_use]
    pub fn weights(&self, plan: &Plan) -> (f64, f64) {
        let [w2, w4, cross] = plan.window_sums;
        (self.segments as f64 * w2, self.segments as f64 * w4 + 2.0 * self.overlaps as f64 * cross)
    }

    /// The lower triangle of band `b`, row after row.
    #[must_use]
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
    /// Spectra of its segments; pairs that overlap across its ends are not counted.
    pub spectra: Spectra,
    /// Whether its first segment overlaps the one before it, in the block before.
    pub overlaps_before: bool,
}

/// The sums of one segment length: over all time, and block by block.
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
    #[must_use]
    pub fn new(plan: &Plan, layout: &Layout) -> Self {
        Self { total: Spectra::zero(plan, layout), block_ns: plan.first_block_ns(), blocks: Vec::new() }
    }

    /// Adds the sums of other segments, of the same plan and layout, none of them twice.
    pub fn add(&mut self, other: &Self) {
        self.total.add(&other.total);
        let mut other = other.clone();
        while self.block_ns != other.block_ns {
            if self.block_ns < other.block_ns { self.coarsen() } else { other.coarsen() }
        }
        self.blocks.append(&mut other.blocks);
        self.blocks.sort_by_key(|b| b.number);
        self.merge_equal();
        while self.blocks.len() > MAX_BLOCKS {
            self.coarsen();
        }
    }

    /// The block that a segment belongs to whose middle lies at `middle_ns`.
    fn block(&mut self, plan: &Plan, columns: usize, middle_ns: i64, overlaps: bool) -> &mut Block {
        let known = |s: &Self| s.blocks.last().is_some_and(|b| b.number == middle_ns.div_euclid(s.block_ns));
        while !known(self) && self.blocks.len() >= MAX_BLOCKS {
            self.coarsen();
        }
        if !known(self) {
            let packed = vec![0.0; plan.bands.len() * triangle(columns)];
            self.blocks.push(Block {
                number: middle_ns.div_euclid(self.block_ns),
                spectra: Spectra { packed, segments: 0, overlaps: 0 },
                overlaps_before: overlaps,
            });
        }
        let last = self.blocks.len() - 1;
        &mut self.blocks[last]
    }

    /// Blocks of twice the length.
    fn coarsen(&mut self) {
        self.block_ns *= 2;
        self.blocks.iter_mut().for_each(|b| b.number = b.number.div_euclid(2));
        self.merge_equal();
    }

    fn merge_equal(&mut self) {
        let mut merged: Vec<Block> = Vec::with_capacity(self.blocks.len());
        for block in self.blocks.drain(..) {
            match merged.last_mut() {
                Some(last) if last.number == block.number => {
                    last.spectra.add(&block.spectra);
                    last.spectra.overlaps += u64::from(block.overlaps_before);
                }
                _ => merged.push(block),
            }
        }
        self.blocks = merged;
    }
}

/// Entries of the lower triangle of a square of `n` rows.
#[must_use]
pub fn triangle(n: usize) -> usize {
    n * (n + 1) / 2
}

/// Turns segments into cross-spectra; owns the scratch space.
pub struct Analyser {
    plan: Plan,
    columns: usize,
    /// `sqrt(4/(f_s L))`.
    scale: f64,
    time: Vec<f64>,
    spectrum: Vec<Complex64>,
    scratch: Vec<Complex64>,
    /// Per column: real and imaginary part of each used bin, scaled.
    scaled: Vec<Vec<f64>>,
}

impl Analyser {
    /// An analyser of segments with the columns of `layout`.
    #[must_use]
    pub fn new(plan: Plan, layout: &Layout) -> Self {
        let bins = plan.length / 2 - FIRST_BIN;
        let columns = layout.columns();
        Self {
            scale: (4.0 / (plan.rate_hz * plan.length as f64)).sqrt(),
            time: plan.fft.make_input_vec(),
            spectrum: plan.fft.make_output_vec(),
            scratch: plan.fft.make_scratch_vec(),
            scaled: vec![vec![0.0; 2 * bins]; columns],
            columns,
            plan,
        }
    }

    /// What depends on the length.
    #[must_use]
    pub fn plan(&self) -> &Plan {
        &self.plan
    }

    /// Adds one segment, a slice of `length` samples per column, the first at `first_ns`; `overlaps` when the segment before it
    /// shares its first half.
    pub fn add(&mut self, first_ns: i64, columns: &[&[f64]], overlaps: bool, sums: &mut Sums) {
        for (j, samples) in columns.iter().enumerate() {
            self.transform(j, samples);
        }
        let middle_ns = first_ns + (0.5e9 * self.plan.length as f64 / self.plan.rate_hz) as i64;
        let total = &mut sums.total;
        total.segments += 1;
        total.overlaps += u64::from(overlaps);
        let mut total = std::mem::take(&mut total.packed);
        let block = sums.block(&self.plan, self.columns, middle_ns, overlaps);
        block.spectra.overlaps += u64::from(overlaps && block.spectra.segments > 0);
        block.spectra.segments += 1;
        let mut entry = total.iter_mut().zip(&mut block.spectra.packed);
        for band in &self.plan.bands {
            let range = 2 * (band.first - FIRST_BIN)..2 * (band.end - FIRST_BIN);
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

    fn transform(&mut self, column: usize, samples: &[f64]) {
        // The straight line that fits the *windowed* samples best. A fit to the bare samples would take its slope from the ends,
        // where a second difference of readout noise is a hundred times louder than the lowest bins.
        let middle = (samples.len() / 2) as f64;
        let (mut sum, mut moment) = (0.0, 0.0);
        for (t, (x, w)) in samples.iter().zip(&self.plan.window).enumerate() {
            sum += w * w * x;
            moment += w * w * (t as f64 - middle) * x;
        }
        let (mean, slope) = (sum / self.plan.window_sums[0], moment / self.plan.window_moment);
        for (t, ((out, x), w)) in self.time.iter_mut().zip(samples).zip(&self.plan.window).enumerate() {
            *out = (x - mean - slope * (t as f64 - middle)) * w;
        }
        // The lengths are those that the plan was made for, the only thing that it refuses.
        let done = self.plan.fft.process_with_scratch(&mut self.time, &mut self.spectrum, &mut self.scratch);
        debug_assert!(done.is_ok());
        let used = &self.spectrum[FIRST_BIN..self.plan.length / 2];
        for (pair, x) in self.scaled[column].chunks_exact_mut(2).zip(used) {
            pair[0] = x.re * self.scale;
            pair[1] = x.im * self.scale;
        }
    }
}

/// Scalar product in eight fixed lanes, so that it vectorises and never depends on how it was compiled in.
fn dot(a: &[f64], b: &[f64]) -> f64 {
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
        let efficiency = |segments: u64, overlaps: u64| {
            let (g, g2) = Spectra { packed: vec![], segments, overlaps }.weights(&plan);
            g * g / g2 / (plan.hop() as f64 * (segments + 1) as f64)
        };
        assert!((efficiency(1, 0) - 18.0 / 35.0).abs() < 1e-9);
        assert!((efficiency(1_000_000, 999_999) - 0.947).abs() < 1e-3);
    }

    /// A sinusoid's power, by Parseval: `Σ_t w² x²` over the variance of white noise of unit PSD.
    #[test]
    fn sums_are_the_power_over_unit_noise() {
        let (rate, length) = (10.0, 1000);
        let mut analyser = Analyser::new(Plan::new(length, rate), &layout(1));
        let mut sums = Sums::new(analyser.plan(), &layout(1));
        let x: Vec<f64> = (0..length).map(|t| 2.0 * (0.7 * t as f64).sin() + 5.0 + 0.01 * t as f64).collect();
        analyser.add(0, &[&x], false, &mut sums);
        let total: f64 = sums.total.packed.iter().sum();
        // Variance of white noise of one-sided PSD 1 at rate f_s is f_s/2; Σ w² sin² = (3/8) L / 2.
        let want = 0.375 * length as f64 * 0.5 * 4.0 / (rate / 2.0);
        assert!((total / want - 1.0).abs() < 1e-3, "{total} against {want}");
    }

    /// Blocks add up to the total, pairs across their ends apart, however often they were joined; and never become many.
    #[test]
    fn blocks_are_the_total_in_parts() {
        let mut analyser = Analyser::new(Plan::new(16, 1.0), &layout(1));
        let mut sums = Sums::new(analyser.plan(), &layout(1));
        let x: Vec<f64> = (0..16).map(|t| f64::from(t * t % 7)).collect();
        for k in 0..30_000i64 {
            analyser.add(k * 8_000_000_000, &[&x], k > 0, &mut sums);
            assert!(sums.blocks.len() <= MAX_BLOCKS);
        }
        assert!(sums.blocks.len() > MAX_BLOCKS / 2 - 1, "{}", sums.blocks.len());
        let of = |f: fn(&Block) -> u64| sums.blocks.iter().map(f).sum::<u64>();
        assert_eq!(of(|b| b.spectra.segments), 30_000);
        assert_eq!(of(|b| b.spectra.overlaps + u64::from(b.overlaps_before)), sums.total.overlaps);
        let power: f64 = sums.blocks.iter().flat_map(|b| &b.spectra.packed).sum();
        let total: f64 = sums.total.packed.iter().sum();
        assert!((power / total - 1.0).abs() < 1e-12);
    }

    /// Two halves of a record, with the tail carried from one to the other, add up to the whole, whichever comes first and
    /// whatever the length of their blocks.
    #[test]
    fn sums_of_parts_add_up() {
        let plan = || Plan::new(16, 1.0);
        let mut analyser = Analyser::new(plan(), &layout(1));
        let segment = |k: i64| -> Vec<f64> { (0..16).map(|t| ((8 * k + t) as f64).sin()).collect() };
        let mut whole = Sums::new(analyser.plan(), &layout(1));
        let (mut first, mut second) = (whole.clone(), whole.clone());
        for k in 0..15_000i64 {
            analyser.add(k * 8_000_000_000, &[&segment(k)], k > 0, &mut whole);
            let part = if k < 14_000 { &mut first } else { &mut second };
            analyser.add(k * 8_000_000_000, &[&segment(k)], k > 0, part);
        }
        assert!(first.block_ns > second.block_ns);
        for (a, b) in [(&first, &second), (&second, &first)] {
            let mut sum = a.clone();
            sum.add(b);
            assert_eq!((sum.total.segments, sum.total.overlaps), (15_000, 14_999));
            assert_eq!((sum.block_ns, sum.blocks.len()), (whole.block_ns, whole.blocks.len()));
            for (a, b) in sum.blocks.iter().zip(&whole.blocks) {
                assert_eq!(
                    (a.number, a.spectra.segments, a.spectra.overlaps),
                    (b.number, b.spectra.segments, b.spectra.overlaps)
                );
            }
            let apart = sum.total.packed.iter().zip(&whole.total.packed).map(|(a, b)| (a / b - 1.0).abs());
            assert!(apart.fold(0.0, f64::max) < 1e-12);
        }
    }
}
