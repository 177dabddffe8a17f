//! Noise in the channels, as the stage that makes them declares it.

use serde::{Deserialize, Serialize};

/// Key of a column's attributes under which a stage declares a list of [`NoiseProcess`]es with it. The host takes the list out of
/// the attributes and hands it on as [`crate::Model::noise`].
pub const NOISE_ATTRIBUTE: &str = "noise_processes";

/// A noise process: a stationary random signal and how it enters the channels.
///
/// A channel's part of it is `weight` times the process, seen through `response`; processes of different names are
/// independent. The cross-spectral matrix of a process is its one-sided power spectral density, times `w wᵀ` of the weights `w`,
/// times the power response.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "json-schema", derive(schemars::JsonSchema))]
pub struct NoiseProcess {
    /// Name, unique in a chain, `thruster_force:sc.x`; coefficients refer to it by `noise` and `colours`.
    pub name: String,
    /// SI unit of the process, `N`, `m`, `m s-2`.
    pub unit: String,
    /// One-sided power spectral density, a sum of terms.
    pub spectrum: NoiseShape,
    /// Channels with their weights: the channel's acceleration (for `differenced`: its displacement or angle) per unit of the process.
    pub enters: Vec<(String, f64)>,
    /// How the channels see it.
    pub response: NoiseResponse,
}

impl NoiseProcess {
    /// Whether the numbers make sense.
    ///
    /// # Errors
    /// A sentence that names what does not.
    pub fn check(&self) -> Result<(), String> {
        if self.name.is_empty() {
            return Err("it has no name".to_owned());
        }
        if self.enters.is_empty() {
            return Err("it enters no channel".to_owned());
        }
        if let Some((channel, weight)) = self.enters.iter().find(|(_, weight)| !weight.is_finite()) {
            return Err(format!("it enters {channel} with the weight {weight}"));
        }
        let sound = |t: &&NoiseTerm| {
            let powers = t.asd.is_finite() && t.asd >= 0.0 && t.exponent.is_multiple_of(2);
            powers && t.corner_hz.is_finite() && t.corner_hz > 0.0
        };
        match self.spectrum.terms.iter().find(|t| !sound(t)) {
            Some(t) => Err(format!(
                "the term asd = {}, corner_hz = {}, exponent = {}; an asd is not negative, a corner positive, an exponent even",
                t.asd, t.corner_hz, t.exponent
            )),
            None => Ok(()),
        }
    }
}

/// How a channel sees a noise process; `dt` is the sampling interval.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "json-schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "kebab-case")]
pub enum NoiseResponse {
    /// An acceleration held over each sample, seen through the mean of two: power response cos²(π f dt).
    Held,
    /// The readout of a displacement, differenced twice: power response (4 sin²(π f dt)/dt²)².
    Differenced,
    /// Measured as it is: power response 1.
    Direct,
}

/// One term of a one-sided power spectral density, `asd² (corner/f)^exponent`; `exponent = 0` is white.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "json-schema", derive(schemars::JsonSchema))]
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

/// A one-sided power spectral density as a sum of independent terms, unit²/Hz.
///
/// `a·sqrt(1+(f0/f)^p)` is the sum of white noise of ASD `a` and a term of exponent `p`, exactly: the two are
/// independent, so a filter needs no correlation between process and readout noise.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "json-schema", derive(schemars::JsonSchema))]
#[serde(transparent)]
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
