//! Levels of torque noise and attitude readout noise, measured in every interval of a run.
//!
//! `α̂` combines attitude readouts and commanded torques, and is biased by wrong weights. The levels are therefore
//! fitted to the spectrum of the attitude channels, `a cos² + b (4 sin²/dt²)²`, before the reconstruction. A level that
//! differs significantly from the mission file's replaces it. What an interval says acts from its end on, so that after
//! a change the weights are wrong for less than two of them.

use dragfree_physics::levels::{self, Bin};
use dragfree_physics::spectrum::welch;
use dragfree_sdk::state::{State, StateError};
use nalgebra::Vector3;

/// Length of an interval, s.
const LENGTH_S: f64 = 3276.8;

/// Length of a segment of its spectrum, s.
const SEGMENT_S: f64 = 204.8;

/// Lowest frequency of the fit, Hz; below, coloured sensing noise and slow torques are not negligible.
const LOWEST_HZ: f64 = 0.01;

/// A measured level is used where its logarithm differs from that of the stated one by this many σ: by chance once in
/// 150 days, with a hundred levels measured in a day.
const SIGNIFICANT_SIGMAS: f64 = 4.0;

/// Noise power relative to the mission file.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct NoiseScale {
    /// Thruster torque about each axis of SRF.
    pub torque: Vector3<f64>,
    /// Long-arm wavefront sensing.
    pub sensing: f64,
}

impl NoiseScale {
    /// The levels of the mission file.
    pub fn nominal() -> Self {
        Self { torque: Vector3::repeat(1.0), sensing: 1.0 }
    }

    pub(crate) fn visit(&mut self, state: &mut State<'_>) -> Result<(), StateError> {
        state.f64s(self.torque.iter_mut().chain([&mut self.sensing]))?;
        let sound = self.torque.iter().chain([&self.sensing]).all(|x| x.is_finite() && *x > 0.0);
        if sound { Ok(()) } else { Err(StateError::Content("a noise level")) }
    }
}

impl Default for NoiseScale {
    fn default() -> Self {
        Self::nominal()
    }
}

/// Number of epochs in an interval.
pub fn length(rate_hz: f64) -> usize {
    (LENGTH_S * rate_hz).round() as usize
}

/// Measures the levels from the attitude channels, SRF, rad s⁻², which do not depend on the smoother's weights. `held`
/// and `readout` are one-sided PSDs by the mission file, of the angular acceleration about each axis of SRF,
/// rad² s⁻⁴/Hz, and of the attitude readout, rad²/Hz. Nominal if no eight segments are free of gaps.
pub fn measure(channels: &[[f64; 3]], rate_hz: f64, held: &Vector3<f64>, readout: f64) -> NoiseScale {
    let complete = |row: &[f64; 3]| row.iter().all(|x| x.is_finite());
    let runs = channels.chunk_by(|a, b| complete(a) == complete(b)).filter(|run| complete(&run[0]));
    let longest = runs.max_by_key(|run| run.len()).unwrap_or_default();
    let segment = (SEGMENT_S * rate_hz).round() as usize;
    if longest.len() < 8 * segment {
        return NoiseScale::nominal();
    }
    let measured: Vec<[Level; 2]> = (0..3)
        .filter_map(|axis| {
            let channel: Vec<f64> = longest.iter().map(|row| row[axis]).collect();
            let spectrum = welch(&channel, rate_hz, segment).ok()?;
            let weight = spectrum.bin_weight();
            let bins: Vec<Bin> = spectrum
                .frequency_hz
                .iter()
                .zip(&spectrum.psd)
                .filter(|(f, _)| (LOWEST_HZ..0.49 * rate_hz).contains(*f))
                .map(|(f, s)| Bin { frequency_hz: *f, psd: *s, weight })
                .collect();
            let fitted = levels::fit(&bins, 1.0 / rate_hz)?;
            let ratios = [fitted.levels.held / held[axis], fitted.levels.readout / readout];
            Some([0, 1].map(|i| Level { log: ratios[i].ln(), sigma: fitted.sigma[i] }))
        })
        .collect();
    match measured.as_slice() {
        [x, y, z] => NoiseScale {
            torque: Vector3::new(x[0], y[0], z[0]).map(Level::if_significant),
            sensing: Level::mean(&[x[1], y[1], z[1]]).if_significant(),
        },
        _ => NoiseScale::nominal(),
    }
}

/// A measured level over the stated one.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Level {
    /// Natural logarithm.
    log: f64,
    sigma: f64,
}

impl Level {
    /// The mean of independent measurements of one level.
    fn mean(of: &[Self; 3]) -> Self {
        let weight = |level: &Self| level.sigma.powi(-2);
        let sum: f64 = of.iter().map(weight).sum();
        Self { log: of.iter().map(|level| weight(level) * level.log).sum::<f64>() / sum, sigma: sum.powf(-0.5) }
    }

    /// The ratio of powers, one where it may be chance.
    fn if_significant(self) -> f64 {
        if self.log.abs() > SIGNIFICANT_SIGMAS * self.sigma { self.log.exp() } else { 1.0 }
    }
}
