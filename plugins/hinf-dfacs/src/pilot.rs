//! The first stretch of a run, held back until it has told the levels of the noise.
//!
//! `α̂` weighs the attitude's sensing against the thrusters' torque. With a weight that is not that of the data it is biased:
//! thrusters believed three times as noisy as they are cost 14 mm of `b_x` in six hours at a σ of 0.9 mm. So the second difference
//! of the attitude against the known torques, whose spectrum is `a cos² + b (4 sin²/dt²)²`, is measured before anything is
//! reconstructed; a level that is plainly not the mission file's takes its place.

use dragfree_physics::levels::{self, Bin};
use dragfree_physics::spectrum::welch;
use nalgebra::Vector3;

use crate::reconstruction::Row;

/// Length of the stretch, s.
const LENGTH_S: f64 = 3276.8;

/// Length of a segment of its spectrum, s.
const SEGMENT_S: f64 = 204.8;

/// Slower than this the colour of the sensing and slow torques have their say.
const LOWEST_HZ: f64 = 0.01;

/// A power has to differ by more than this (natural logarithm) from the mission file's to replace it. The level of the torque rests
/// on some 14 bins of 31 segments below 0.08 Hz, so that chance alone moves it by 0.05.
const PLAINLY: f64 = 0.25;

/// Powers of the noise over those of the mission file.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Scale {
    /// Torque of the thrusters about each axis of SRF.
    pub torque: Vector3<f64>,
    /// Long-arm wavefront sensing.
    pub sensing: f64,
}

impl Scale {
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

/// Measures the levels from the rows of the stretch, made with any weight: the channels do not depend on it. `held` and `readout` are
/// the one-sided PSDs of the mission file, rad² s⁻⁴/Hz per axis of SRF and rad²/Hz. Nominal where the longest run without a hole is
/// shorter than eight segments.
#[must_use]
pub fn measure(rows: &[Row], rate_hz: f64, held: &Vector3<f64>, readout: f64) -> Scale {
    let whole = |row: &Row| row.attitude_channels().iter().all(|x| x.is_finite());
    let runs = rows.chunk_by(|a, b| whole(a) == whole(b)).filter(|run| whole(&run[0]));
    let longest = runs.max_by_key(|run| run.len()).unwrap_or_default();
    let segment = (SEGMENT_S * rate_hz).round() as usize;
    if longest.len() < 8 * segment {
        return Scale::nominal();
    }
    let found: Vec<(f64, f64)> = (0..3)
        .filter_map(|axis| {
            let channel: Vec<f64> = longest.iter().map(|row| row.attitude_channels()[axis]).collect();
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
    let plain = |ratio: f64| if ratio.ln().abs() > PLAINLY { ratio } else { 1.0 };
    match found.as_slice() {
        [x, y, z] => Scale { torque: Vector3::new(x.0, y.0, z.0).map(plain), sensing: plain((x.1 * y.1 * z.1).cbrt()) },
        _ => Scale::nominal(),
    }
}
