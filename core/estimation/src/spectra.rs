//! Cross-spectral sums of one segment length: what the data leave behind once a segment has been read.
//!
//! `G_b = Σ_segments Σ_{bins of band b} Re(x* xᵀ)` over the columns x = (channels, regressors), every column divided by the
//! modelled amplitude of its channel at that bin. `N`, `c` and `zᵀΣ⁻¹z` of the design's §6 are linear in `G_b` for **any** real
//! Σ that is smooth across a band, so Σ can be refined, and a model changed, without reading the data again. Sums add over
//! segments and days and do not grow with them.

use std::sync::Arc;

use realfft::num_complex::Complex64;
use realfft::{RealFftPlanner, RealToComplex};

/// Which channel each column of the sums belongs to: channels first, then regressors.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Layout {
    /// Names of the channels.
    pub channels: Vec<String>,
    /// Regressor columns, in the order in which they follow the channels.
    pub regressors: Vec<Regressor>,
    /// Number of coefficients that the regressors refer to.
    pub coefficients: usize,
}

/// One regressor column: the response of a channel to a coefficient.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Regressor {
    /// Index of the coefficient.
    pub coefficient: usize,
    /// Index of the channel.
    pub channel: usize,
}

impl Layout {
    /// Channels and regressors together.
    #[must_use]
    pub fn columns(&self) -> usize {
        self.channels.len() + self.regressors.len()
    }

    /// Channel of a column.
    #[must_use]
    pub fn channel_of(&self, column: usize) -> usize {
        column.checked_sub(self.channels.len()).map_or(column, |r| self.regressors[r].channel)
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

/// Bands up to this fraction of their frequency are treated as one: a PSD in f⁴, itself divided out by the model, changes by
/// less than a few per cent across, and a wrong weight costs information only in second order.
const RELATIVE_WIDTH: f64 = 1.0 / 64.0;

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

    /// Expectation of a channel's diagonal of `G`, per bin and segment, when the model is right.
    #[must_use]
    pub fn expected_per_bin(&self) -> f64 {
        2.0 * self.window_sums[0] / self.length as f64
    }
}

/// The sums of one segment length, with the amplitudes that its columns were divided by.
#[derive(Clone, Debug, PartialEq)]
pub struct Sums {
    /// `G_b`, packed lower triangles, band after band.
    pub packed: Vec<f64>,
    /// Segments added.
    pub segments: u64,
    /// Pairs of segments that overlap.
    pub overlaps: u64,
}

impl Sums {
    /// Nothing added yet.
    #[must_use]
    pub fn new(plan: &Plan, layout: &Layout) -> Self {
        Self { packed: vec![0.0; plan.bands.len() * triangle(layout.columns())], segments: 0, overlaps: 0 }
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

/// Entries of the lower triangle of a square of `n` rows.
#[must_use]
pub fn triangle(n: usize) -> usize {
    n * (n + 1) / 2
}

/// Turns segments into cross-spectra; owns the scratch space.
pub struct Analyser {
    plan: Plan,
    columns: usize,
    /// Per channel and bin from [`FIRST_BIN`]: `sqrt(4/(f_s L) / S(f))`.
    weight: Vec<Vec<f64>>,
    channel_of: Vec<usize>,
    time: Vec<f64>,
    spectrum: Vec<Complex64>,
    scratch: Vec<Complex64>,
    /// Per column: real and imaginary part of each used bin, weighted.
    weighted: Vec<Vec<f64>>,
}

impl Analyser {
    /// `psd(f)` is the modelled one-sided PSD of every channel, its unit squared per Hz.
    #[must_use]
    pub fn new(plan: Plan, layout: &Layout, psd: impl Fn(f64) -> Vec<f64>) -> Self {
        let bins = FIRST_BIN..plan.length / 2;
        let norm = 4.0 / (plan.rate_hz * plan.length as f64);
        let mut weight = vec![Vec::with_capacity(bins.len()); layout.channels.len()];
        for k in bins.clone() {
            for (weight, psd) in weight.iter_mut().zip(psd(plan.bin_hz(k as f64))) {
                weight.push((norm / psd).sqrt());
            }
        }
        let columns = layout.columns();
        Self {
            weight,
            channel_of: (0..columns).map(|j| layout.channel_of(j)).collect(),
            time: plan.fft.make_input_vec(),
            spectrum: plan.fft.make_output_vec(),
            scratch: plan.fft.make_scratch_vec(),
            weighted: vec![vec![0.0; 2 * bins.len()]; columns],
            columns,
            plan,
        }
    }

    /// What depends on the length.
    #[must_use]
    pub fn plan(&self) -> &Plan {
        &self.plan
    }

    /// Adds one segment, a slice of `length` samples per column; `overlaps` when the segment before it shares its first half.
    pub fn add(&mut self, columns: &[&[f64]], overlaps: bool, sums: &mut Sums) {
        for (j, samples) in columns.iter().enumerate() {
            self.transform(j, samples);
        }
        for (band, g) in self.plan.bands.iter().zip(sums.packed.chunks_exact_mut(triangle(self.columns))) {
            let range = 2 * (band.first - FIRST_BIN)..2 * (band.end - FIRST_BIN);
            let mut entry = g.iter_mut();
            for i in 0..self.columns {
                let a = &self.weighted[i][range.clone()];
                for (b, g) in self.weighted[..=i].iter().zip(&mut entry) {
                    *g += dot(a, &b[range.clone()]);
                }
            }
        }
        sums.segments += 1;
        sums.overlaps += u64::from(overlaps);
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
        let weight = &self.weight[self.channel_of[column]];
        for ((pair, x), w) in self.weighted[column].chunks_exact_mut(2).zip(used).zip(weight) {
            pair[0] = x.re * w;
            pair[1] = x.im * w;
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

    /// Harris 1978: one Hann segment keeps 18/35 = 0.514 of the samples' information; with 50 % overlap 0.947.
    #[test]
    fn information_kept_by_the_taper() {
        let plan = Plan::new(4096, 10.0);
        let efficiency = |segments: u64, overlaps: u64| {
            let (g, g2) = Sums { packed: vec![], segments, overlaps }.weights(&plan);
            g * g / g2 / (plan.hop() as f64 * (segments + 1) as f64)
        };
        assert!((efficiency(1, 0) - 18.0 / 35.0).abs() < 1e-9);
        assert!((efficiency(1_000_000, 999_999) - 0.947).abs() < 1e-3);
    }

    /// A sinusoid's power, by Parseval: `Σ_t w² x²` over the noise variance of white noise of the given PSD.
    #[test]
    fn sums_are_the_weighted_power_over_the_noise() {
        let (rate, length, psd) = (10.0, 1000, 0.3);
        let layout = Layout { channels: vec!["c".into()], regressors: vec![], coefficients: 0 };
        let mut analyser = Analyser::new(Plan::new(length, rate), &layout, |_| vec![psd]);
        let mut sums = Sums::new(analyser.plan(), &layout);
        let x: Vec<f64> = (0..length).map(|t| 2.0 * (0.7 * t as f64).sin() + 5.0 + 0.01 * t as f64).collect();
        analyser.add(&[&x], false, &mut sums);
        let total: f64 = sums.packed.iter().sum();
        // Variance of white noise of one-sided PSD S at rate f_s is S f_s / 2; Σ w² sin² = (3/8) L / 2.
        let want = 0.375 * length as f64 * 0.5 * 4.0 / (psd * rate / 2.0);
        assert!((total / want - 1.0).abs() < 1e-3, "{total} against {want}");
    }
}
