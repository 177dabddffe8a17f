//! Σ from the residuals: telemetry whose noise is not the declared one must not be weighed by the declaration.
//!
//! After Vitale et al. (arXiv:1404.4792): solve, measure the residuals' spectrum, solve again. In the coordinates in
//! which the model says "white with unit variance" (`L⁻¹r`, `LLᵀ = Σ_model`), the residuals' measured covariance Ŵ of a
//! band about 1/7 wide would be 1 if the model were right. Σ becomes `L W̃ Lᵀ` with
//!
//! `W̃ = (n+ν₀)/(n+ν₀−p) · (n Ŵ + ν₀ diag Ŵ)/(n + ν₀)`
//!
//! * levels are measured, correlations shrunk towards the model's, with `ν₀ = 2p` pseudo-observations against n
//!   measured ones: positive definite always, however short the data;
//! * the model's shape inside the band stays, so a steep spectrum is no trouble;
//! * the first factor makes the inverse unbiased (complex Wishart with n + ν₀ observations), or a Σ fitted to few data
//!   would look too well known; the expectation of χ² shrinks by the same factor;
//! * channels that the model does not connect stay unconnected. Were the attitude channels allowed to correlate with
//!   the test masses', their measured coherence would *be* the offset's signal, because α̂ is made of them, and Σ would
//!   eat it.

use nalgebra::{Cholesky, DMatrix, DVector};
use std::ops::Range;

use crate::sigma::BandNoise;
use crate::spectra::{Plan, Spectra};

/// A band in which Σ is refined is at least this wide, last frequency over first.
const RATIO: f64 = 1.15;

/// … and holds at least this many complex observations per channel of the largest group.
const OBSERVATIONS_PER_CHANNEL: f64 = 4.0;

/// Pseudo-observations per channel with which measured correlations are shrunk.
const SHRINKAGE: f64 = 2.0;

/// Σ as the model has it, and the bands in which it may move.
pub(crate) struct Whitening {
    /// Cholesky factor of the model's Σ, its mean over the band, per band of the sums.
    factors: Vec<DMatrix<f64>>,
    /// Diagonal of that Σ, per band of the sums.
    variances: Vec<DVector<f64>>,
    /// Group of each channel: channels that the model connects.
    group: Vec<usize>,
    /// Whether a channel is the residual of a known motion.
    residual: Vec<bool>,
    /// Channels in the group of each channel.
    group_size: Vec<f64>,
    /// Ranges of bands of the sums, none with slow and other bands together.
    coarse: Vec<Range<usize>>,
    /// Bands below those of ordinary segments.
    slow_bands: usize,
    /// Expected diagonal of the residuals' sums over Σ, per band.
    expected: Vec<f64>,
    /// What makes information of the sums, per band.
    kept: Vec<f64>,
    /// Complex observations, per coarse band.
    observations: Vec<f64>,
    /// Complex observations, per band.
    observations_per_band: Vec<f64>,
}

/// Why Σ cannot be used.
#[derive(Debug, thiserror::Error)]
#[expect(missing_docs, reason = "the messages name the fields")]
pub enum SigmaError {
    /// Two channels measure the same without noise of their own.
    #[error(
        "the modelled noise of the channels is not positive definite at {frequency_hz:.3e} Hz: some combination of channels has no \
         noise at all; the stage that makes the channels must declare a noise for each readout, from the mission file's [noise]"
    )]
    Singular { frequency_hz: f64 },
}

impl Whitening {
    pub(crate) fn new(noise: &BandNoise<'_>, plan: &Plan, spectra: &Spectra) -> Result<Self, SigmaError> {
        let mut factors = Vec::with_capacity(plan.bands.len());
        let mut variances = Vec::with_capacity(plan.bands.len());
        for (band, sigma) in plan.bands.iter().zip(&noise.mean) {
            variances.push(sigma.diagonal());
            let frequency_hz = plan.frequency_hz(*band);
            factors.push(Cholesky::new(sigma.clone()).ok_or(SigmaError::Singular { frequency_hz })?.unpack());
        }
        let group = noise.model.groups();
        let group_size: Vec<f64> = group.iter().map(|g| group.iter().filter(|h| *h == g).count() as f64).collect();
        let per_band = spectra.observations(plan);
        let needed = OBSERVATIONS_PER_CHANNEL * group_size.iter().fold(0.0, |a: f64, b| a.max(*b));
        let observed = |range: &Range<usize>| per_band[range.clone()].iter().sum::<f64>();
        let slow = wide_bands(plan, 0..plan.slow_bands, needed, observed);
        let coarse: Vec<Range<usize>> =
            slow.into_iter().chain(wide_bands(plan, plan.ordinary_bands(), needed, observed)).collect();
        Ok(Self {
            factors,
            variances,
            group,
            residual: noise.model.residual().to_vec(),
            group_size,
            observations: coarse.iter().map(observed).collect(),
            coarse,
            slow_bands: plan.slow_bands,
            observations_per_band: per_band,
            expected: spectra.expected.clone(),
            kept: spectra.kept(),
        })
    }

    /// `Σ⁻¹` of the model, per band.
    pub(crate) fn model_inverses(&self) -> Vec<DMatrix<f64>> {
        self.factors.iter().map(inverse_of_square).collect()
    }

    /// `(L W̃ Lᵀ)⁻¹` per band.
    pub(crate) fn refined_inverses(&self, residuals: &[DMatrix<f64>]) -> Vec<DMatrix<f64>> {
        let mut out = Vec::with_capacity(self.factors.len());
        for (range, n) in self.coarse.iter().zip(&self.observations) {
            let measured = self.whitened(residuals, range);
            let shrunk = DMatrix::from_fn(measured.nrows(), measured.ncols(), |i, j| {
                let p = self.group_size[i];
                let correction = Self::wishart(*n, p);
                match (i == j, self.group[i] == self.group[j]) {
                    (true, _) => correction * measured[(i, j)],
                    (_, true) => correction * measured[(i, j)] * n / (n + SHRINKAGE * p),
                    _ => 0.0,
                }
            });
            // Positive definite but for channels without a trace of signal, which keep the model.
            let inner = Cholesky::new(shrunk).map(|c| c.unpack());
            out.extend(self.factors[range.clone()].iter().map(|l| match &inner {
                Some(w) => inverse_of_square(&(l * w)),
                None => inverse_of_square(l),
            }));
        }
        out
    }

    /// `Σ 2n log det Ŵ` over the refined bands, Ŵ within groups alone: of n complex Gaussian observations the
    /// likelihood at its best Σ is `|Ŵ|^−n` but for constants.
    pub(crate) fn deviance(&self, residuals: &[DMatrix<f64>]) -> f64 {
        let mut sum = 0.0;
        for (range, n) in self.coarse.iter().zip(&self.observations) {
            let w = self.whitened(residuals, range);
            let within =
                DMatrix::from_fn(
                    w.nrows(),
                    w.ncols(),
                    |i, j| {
                        if self.group[i] == self.group[j] { w[(i, j)] } else { 0.0 }
                    },
                );
            sum += 2.0 * n * Cholesky::new(within).map_or(0.0, |c| 2.0 * c.l().diagonal().map(f64::ln).sum());
        }
        sum
    }

    /// Factor by which a level fitted to n observations of p channels is widened.
    fn wishart(n: f64, p: f64) -> f64 {
        let total = n + SHRINKAGE * p;
        total / (total - p)
    }

    /// Measured covariance of the model-whitened residuals over a range of bands; 1 when the model is right.
    fn whitened(&self, residuals: &[DMatrix<f64>], range: &Range<usize>) -> DMatrix<f64> {
        let n = self.group.len();
        let mut sum = DMatrix::zeros(n, n);
        for b in range.clone() {
            // L is lower triangular with a positive diagonal: the solves cannot fail.
            let half = self.factors[b].solve_lower_triangular(&residuals[b]).unwrap_or_else(|| residuals[b].clone());
            let whole = self.factors[b].solve_lower_triangular(&half.transpose()).unwrap_or(half);
            sum += 0.5 * (&whole + whole.transpose());
        }
        sum / self.expected[range.clone()].iter().sum::<f64>()
    }

    /// `Σ rᴴ Σ⁻¹ r` and its expectation, overall and for each channel alone; `refined` when Σ was fitted to the
    /// residuals.
    pub(crate) fn chi2(&self, residuals: &[DMatrix<f64>], inverses: &[DMatrix<f64>], refined: bool) -> Chi2 {
        let n = self.group.len();
        let mut chi2 = Chi2 { sum: 0.0, expected: 0.0, channel: vec![(0.0, 0.0); n] };
        for (range, observations) in self.coarse.iter().zip(&self.observations) {
            for b in range.clone() {
                chi2.sum += self.kept[b] * residuals[b].dot(&inverses[b]);
                let sigma = inverses[b].clone().try_inverse();
                for c in 0..n {
                    let kept = if refined { 1.0 / Self::wishart(*observations, self.group_size[c]) } else { 1.0 };
                    let expected = self.kept[b] * self.expected[b] * kept;
                    chi2.expected += expected;
                    let variance = sigma.as_ref().map_or(f64::NAN, |s| s[(c, c)]);
                    chi2.channel[c].0 += self.kept[b] * residuals[b][(c, c)] / variance;
                    chi2.channel[c].1 += expected;
                }
            }
        }
        chi2
    }

    /// Expectation of `Σ rᴴ Σ⁻¹ r` in one band when Σ is right, and its degrees of freedom.
    pub(crate) fn expected_chi2(&self, band: usize) -> (f64, f64) {
        let expected = self.expected[band] * self.group.len() as f64;
        (expected, expected * self.kept[band])
    }

    /// Whether residuals that the model does not connect are as unrelated as it says, above the slow bands, where what
    /// pushes and turns need be no noise: for each pair of groups the sum of `2n ρ²` over pairs of channels and refined
    /// bands, ρ the real coherence of the residuals, χ² of as many degrees of freedom when it is so.
    pub(crate) fn between_groups(&self, residuals: &[DMatrix<f64>]) -> (f64, f64) {
        let (mut sum, mut dof) = (0.0, 0.0);
        for (range, n) in self.coarse.iter().zip(&self.observations).filter(|(r, _)| r.start >= self.slow_bands) {
            let w = self.whitened(residuals, range);
            for i in 0..self.group.len() {
                let apart = |j: &usize| self.group[i] != self.group[*j] && self.residual[i] && self.residual[*j];
                for j in (0..i).filter(apart) {
                    let rho2 = w[(i, j)].powi(2) / (w[(i, i)] * w[(j, j)]);
                    // Of n complex observations the square of the real coherence has the mean 1/(2n+1) … 1/(2n).
                    sum += 2.0 * n * rho2;
                    dof += 1.0;
                }
            }
        }
        (sum, dof)
    }

    /// Complex observations in a range of bands.
    pub(crate) fn observations(&self, range: Range<usize>) -> f64 {
        self.observations_per_band[range].iter().sum()
    }

    /// Measured over modelled power of each channel in a range of bands.
    pub(crate) fn power_ratio(&self, residuals: &[DMatrix<f64>], range: Range<usize>) -> Vec<f64> {
        let expected: f64 = self.expected[range.clone()].iter().sum();
        (0..self.group.len())
            .map(|c| range.clone().map(|b| residuals[b][(c, c)] / self.variances[b][c]).sum::<f64>() / expected)
            .collect()
    }
}

/// Bands in which Σ may move: neighbouring ones of a range together, until they are wide and hold what is needed.
fn wide_bands(
    plan: &Plan,
    bands: Range<usize>,
    needed: f64,
    observed: impl Fn(&Range<usize>) -> f64,
) -> Vec<Range<usize>> {
    let mut coarse = Vec::new();
    let mut start = bands.start;
    for end in bands.start + 1..=bands.end {
        let wide = plan.bands[end - 1].end as f64 >= RATIO * plan.bands[start].first as f64;
        if wide && observed(&(start..end)) >= needed {
            coarse.push(start..end);
            start = end;
        }
    }
    if start < bands.end {
        let first = coarse.pop().map_or(bands.start, |last: Range<usize>| last.start);
        coarse.push(first..bands.end);
    }
    coarse
}

/// `χ²` as summed, with its expectation.
#[derive(Clone, Debug)]
pub(crate) struct Chi2 {
    pub(crate) sum: f64,
    pub(crate) expected: f64,
    /// The same per channel alone.
    pub(crate) channel: Vec<(f64, f64)>,
}

/// `(A Aᵀ)⁻¹` for a lower triangular A with a positive diagonal.
fn inverse_of_square(a: &DMatrix<f64>) -> DMatrix<f64> {
    let identity = DMatrix::identity(a.nrows(), a.nrows());
    let inverse = a.solve_lower_triangular(&identity).unwrap_or(identity);
    inverse.transpose() * inverse
}
