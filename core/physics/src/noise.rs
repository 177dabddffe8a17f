//! Noise shapes: power spectral densities as sums of power-law terms, and lines.

pub use dragfree_schema::{NoiseShape, NoiseTerm};

/// A line of a spectrum: a sine of random phase.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct NoiseLine {
    /// Amplitude, unit.
    pub amplitude: f64,
    /// Frequency, Hz.
    pub frequency_hz: f64,
}
