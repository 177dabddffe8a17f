//! Welch's estimate of a power spectral density, with its sampling distribution.

use realfft::RealFftPlanner;
use std::f64::consts::TAU;

/// Correlation of neighbouring Hann segments at 50 % overlap: the squared overlap integral of the window, (1/6)².
const SEGMENT_CORRELATION: f64 = 1.0 / 36.0;
/// Variance of a mean of many neighbouring Hann bins, against independent ones: 1 + 2 (4/9 + 1/36).
const BIN_CORRELATION: f64 = 1.0 + 2.0 * (4.0 / 9.0 + 1.0 / 36.0);

/// Why a series has no spectrum.
#[derive(Debug, thiserror::Error)]
#[expect(missing_docs, reason = "the messages name the fields")]
pub enum SpectrumError {
    /// Too few samples, or a segment too short for a window.
    #[error("{samples} samples hold no segment of {segment}; a segment needs 8 samples, the series one segment")]
    TooShort { samples: usize, segment: usize },
    /// The transform refused.
    #[error("Fourier transform of a segment: {0}")]
    Transform(String),
}

/// A one-sided power spectral density.
#[derive(Clone, Debug)]
pub struct Spectrum {
    /// Frequencies of the bins from zero to Nyquist, Hz.
    pub frequency_hz: Vec<f64>,
    /// One-sided PSD, unit²/Hz.
    pub psd: Vec<f64>,
    /// Segments averaged.
    pub segments: usize,
}

/// A band's mean of PSD over model.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ratio {
    /// The mean; 1 where the model holds.
    pub value: f64,
    /// Its standard deviation where the model holds.
    pub sigma: f64,
}

impl Spectrum {
    /// Degrees of freedom of one bin away from zero and Nyquist: `psd·dof/truth` follows χ² with as many.
    pub fn dof(&self) -> f64 {
        let k = self.segments as f64;
        2.0 * k / (1.0 + 2.0 * SEGMENT_CORRELATION * (k - 1.0) / k)
    }

    /// Inverse of the relative variance of a bin, for sums over many neighbouring bins, which are correlated.
    pub fn bin_weight(&self) -> f64 {
        self.dof() / (2.0 * BIN_CORRELATION)
    }

    /// Mean of `psd/model` over the bins in `band_hz`, and its expected scatter; `None` when the band holds no bin.
    pub fn ratio(&self, band_hz: std::ops::Range<f64>, model: impl Fn(f64) -> f64) -> Option<Ratio> {
        let inside = self.frequency_hz.iter().zip(&self.psd).filter(|(f, _)| band_hz.contains(f));
        let ratios: Vec<f64> = inside.map(|(f, p)| p / model(*f)).collect();
        let n = ratios.len() as f64;
        let correlation = BIN_CORRELATION.min(n);
        (n > 0.0).then(|| Ratio {
            value: ratios.iter().sum::<f64>() / n,
            sigma: (2.0 / self.dof() * correlation / n).sqrt(),
        })
    }
}

/// Welch's method: Hann windows of `segment` samples with 50 % overlap, mean and slope taken off each.
///
/// # Errors
/// [`SpectrumError::TooShort`].
pub fn welch(x: &[f64], rate_hz: f64, segment: usize) -> Result<Spectrum, SpectrumError> {
    if segment < 8 || x.len() < segment {
        return Err(SpectrumError::TooShort { samples: x.len(), segment });
    }
    let window: Vec<f64> = (0..segment).map(|i| 0.5 - 0.5 * (TAU * i as f64 / segment as f64).cos()).collect();
    let power: f64 = window.iter().map(|w| w * w).sum();
    let fft = RealFftPlanner::new().plan_fft_forward(segment);
    let (mut input, mut output) = (fft.make_input_vec(), fft.make_output_vec());
    let mut psd = vec![0.0; output.len()];
    let mut segments = 0;
    for start in (0..=x.len() - segment).step_by(segment / 2) {
        windowed(&x[start..start + segment], &window, &mut input);
        fft.process(&mut input, &mut output).map_err(|e| SpectrumError::Transform(e.to_string()))?;
        for (sum, y) in psd.iter_mut().zip(&output) {
            *sum += y.norm_sqr();
        }
        segments += 1;
    }
    let last = psd.len() - 1;
    for (i, p) in psd.iter_mut().enumerate() {
        // Zero and (for even lengths) Nyquist have no negative frequency.
        let sides = if i == 0 || (i == last && segment.is_multiple_of(2)) { 1.0 } else { 2.0 };
        *p *= sides / (rate_hz * power * f64::from(segments));
    }
    let frequency_hz = (0..psd.len()).map(|i| i as f64 * rate_hz / segment as f64).collect();
    Ok(Spectrum { frequency_hz, psd, segments: segments as usize })
}

/// Subtracts the straight line of the *windowed* least-squares fit from a segment, and applies the window. The slope of
/// an unweighted fit is dominated by the ends, where a second difference of readout noise exceeds the lowest bins.
fn windowed(x: &[f64], window: &[f64], out: &mut [f64]) {
    let middle = 0.5 * x.len() as f64;
    let (mut weight, mut sum, mut first, mut moment) = (0.0, 0.0, 0.0, 0.0);
    for (i, (v, w)) in x.iter().zip(window).enumerate() {
        let (t, w) = (i as f64 - middle, w * w);
        weight += w;
        sum += w * v;
        first += w * t * v;
        moment += w * t * t;
    }
    // The window is even about the middle, so constant and slope are orthogonal.
    let (mean, slope) = (sum / weight, first / moment);
    for (i, (o, (v, w))) in out.iter_mut().zip(x.iter().zip(window)).enumerate() {
        *o = (v - mean - slope * (i as f64 - middle)) * w;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::process::normal;
    use rand::SeedableRng;
    use rand_xoshiro::Xoshiro256PlusPlus;

    /// A line of amplitude A holds A²/2, whatever window.
    #[test]
    fn a_line_keeps_its_power() {
        let x: Vec<f64> = (0..4096).map(|i| 3.0 * (TAU * 1.25 * f64::from(i) / 10.0).sin()).collect();
        let s = welch(&x, 10.0, 1024).unwrap();
        let power: f64 = s.psd.iter().sum::<f64>() * 10.0 / 1024.0;
        assert!((power / 4.5 - 1.0).abs() < 1e-3, "{power}");
    }

    /// Mean and scatter of white noise against theory: the mean over all bins of 40 series within 4.5σ (false alarm
    /// 7e-6), the scatter of one bin's estimate within 5 of its own standard deviations.
    #[test]
    fn scatter_is_what_theory_says() {
        let mut rng = Xoshiro256PlusPlus::seed_from_u64(11);
        let mut sum = 0.0;
        let mut square = 0.0;
        let (runs, mut bins) = (40, 0.0);
        let mut dof = 0.0;
        for _ in 0..runs {
            let x: Vec<f64> = (0..8192).map(|_| normal(&mut rng)).collect();
            let s = welch(&x, 10.0, 512).unwrap();
            dof = s.dof();
            // Variance 1 at 10 Hz is a one-sided PSD of 0.2; every third bin is nearly independent.
            for p in s.psd[2..s.psd.len() - 2].iter().step_by(3) {
                sum += p / 0.2;
                square += (p / 0.2 - 1.0).powi(2);
                bins += 1.0;
            }
        }
        let sigma = (2.0 / dof).sqrt();
        let z = (sum / bins - 1.0) / (sigma / f64::sqrt(bins));
        assert!(z.abs() < 4.5, "mean off by {z} sigma");
        let z = (square / bins / (sigma * sigma) - 1.0) / (2.0 / bins * (1.0 + 6.0 / dof)).sqrt();
        assert!(z.abs() < 5.0, "scatter off by {z} sigma with {dof} degrees of freedom");
    }

    #[test]
    fn a_short_series_is_refused() {
        assert!(welch(&[0.0; 10], 10.0, 16).is_err() && welch(&[0.0; 10], 10.0, 4).is_err());
    }
}
