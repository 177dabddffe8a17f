//! Noise shapes: power spectral densities as sums of power-law terms.

use serde::{Deserialize, Serialize};

/// One term of a one-sided power spectral density, `asd² (corner/f)^exponent`; `exponent = 0` is white.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct NoiseTerm {
    /// Amplitude spectral density at the corner, unit/√Hz.
    pub asd: f64,
    /// Corner frequency, Hz.
    pub corner_hz: f64,
    /// Even exponent of the power spectral density: 0 white, 2 one state, 4 two states, and so on.
    pub exponent: u32,
}

impl NoiseTerm {
    /// States of a shaping filter of this term.
    #[must_use]
    pub fn states(&self) -> usize {
        self.exponent as usize / 2
    }
}

/// A line of a spectrum: a sine of random phase.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct NoiseLine {
    /// Amplitude, unit.
    pub amplitude: f64,
    /// Frequency, Hz.
    pub frequency_hz: f64,
}

/// A one-sided power spectral density as a sum of independent terms, unit²/Hz.
///
/// `a·sqrt(1+(f0/f)^p)` is the sum of white noise of ASD `a` and a term of exponent `p`, exactly: the two are
/// independent, so a filter needs no correlation between process and readout noise.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct NoiseShape {
    /// The terms that add up.
    pub terms: Vec<NoiseTerm>,
}

impl NoiseShape {
    /// White noise of the given ASD, unit/√Hz.
    #[must_use]
    pub fn white(asd: f64) -> Self {
        Self { terms: vec![NoiseTerm { asd, corner_hz: 1.0, exponent: 0 }] }
    }

    /// `a·sqrt(1+(corner/f)^exponent)`, unit/√Hz.
    #[must_use]
    pub fn with_corner(asd: f64, corner_hz: f64, exponent: u32) -> Self {
        let mut shape = Self::white(asd);
        if exponent > 0 && corner_hz > 0.0 {
            shape.terms.push(NoiseTerm { asd, corner_hz, exponent });
        }
        shape
    }

    /// One-sided PSD at `frequency_hz` > 0, unit²/Hz.
    #[must_use]
    pub fn psd(&self, frequency_hz: f64) -> f64 {
        self.terms.iter().map(|t| t.asd * t.asd * (t.corner_hz / frequency_hz).powi(t.exponent.cast_signed())).sum()
    }

    /// White part of the one-sided PSD, unit²/Hz.
    #[must_use]
    pub fn white_psd(&self) -> f64 {
        self.terms.iter().filter(|t| t.exponent == 0).map(|t| t.asd * t.asd).sum()
    }

    /// The terms that are not white.
    pub fn coloured(&self) -> impl Iterator<Item = &NoiseTerm> {
        self.terms.iter().filter(|t| t.exponent > 0)
    }
}
