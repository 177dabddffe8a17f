//! Levels of torque and attitude noise, measured in the first stretch of a run.
//!
//! `α̂` weighs the attitude's sensing against the thrusters' torque, and a wrong weight biases it. So the second
//! difference of the attitude against the known torques, whose spectrum is `a cos² + b (4 sin²/dt²)²`, is measured
//! before anything is reconstructed. A level that differs significantly from the mission file's replaces it.

use dragfree_physics::levels::{self, Bin};
use dragfree_physics::spectrum::welch;
use nalgebra::Vector3;

/// Length of the stretch, s.
const LENGTH_S: f64 = 3276.8;

/// Length of a segment of its spectrum, s.
const SEGMENT_S: f64 = 204.8;

/// Below this frequency coloured sensing noise and slow torques are no longer negligible.
const LOWEST_HZ: f64 = 0.01;

/// Least difference of a power from the mission file's, natural logarithm, at which it replaces that: five standard
/// deviations of the measured torque level, which rests on some 14 bins of 31 segments.
const SIGNIFICANT_LOG_RATIO: f64 = 0.25;

/// Powers of the noise over those of the mission file.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct NoiseScale {
    /// Torque of the thrusters about each axis of SRF.
    pub torque: Vector3<f64>,
    /// Long-arm wavefront sensing.
    pub sensing: f64,
}

impl NoiseScale {
    /// As the mission file has it.
    #[must_use]
    pub fn nominal() -> Self {
        Self { torque: Vector3::repeat(1.0), sensing: 1.0 }
    }
}

/// Epochs of the stretch.
#[must_use]
pub fn length(rate_hz: f64) -> usize {
    (LENGTH_S * rate_hz).round() as usize
}

/// Measures the levels from the attitude channels of the stretch, SRF, rad s⁻², which do not depend on the weight.
/// `held` and `readout` are the one-sided PSDs of the mission file, rad² s⁻⁴/Hz per axis of SRF and rad²/Hz. Nominal
/// where the longest run without a hole is shorter than eight segments.
#[must_use]
pub fn measure(channels: &[[f64; 3]], rate_hz: f64, held: &Vector3<f64>, readout: f64) -> NoiseScale {
    let whole = |row: &[f64; 3]| row.iter().all(|x| x.is_finite());
    let runs = channels.chunk_by(|a, b| whole(a) == whole(b)).filter(|run| whole(&run[0]));
    let longest = runs.max_by_key(|run| run.len()).unwrap_or_default();
    let segment = (SEGMENT_S * rate_hz).round() as usize;
    if longest.len() < 8 * segment {
        return NoiseScale::nominal();
    }
    let found: Vec<(f64, f64)> = (0..3)
        .filter_map(|axis| {
            let channel: Vec<f64> = longest.iter().map(|row| row[axis]).collect();
            let spectrum = welch(&channel, rate_hz, segment).ok()?;
            let bins: Vec<Bin> = spectrum
                .frequency_hz
                .iter()
                .zip(&spectrum.psd)
                .filter(|(f, _)| (LOWEST_HZ..0.49 * rate_hz).contains(*f))
                .map(|(f, s)| Bin { frequency_hz: *f, psd: *s, weight: 1.0 })
                .collect();
            let measured = levels::fit(&bins, 1.0 / rate_hz)?;
            Some((measured.held / held[axis], measured.readout / readout))
        })
        .collect();
    let significant = |ratio: f64| if ratio.ln().abs() > SIGNIFICANT_LOG_RATIO { ratio } else { 1.0 };
    match found.as_slice() {
        [x, y, z] => NoiseScale {
            torque: Vector3::new(x.0, y.0, z.0).map(significant),
            sensing: significant((x.1 * y.1 * z.1).cbrt()),
        },
        _ => NoiseScale::nominal(),
    }
}
