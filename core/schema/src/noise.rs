//! Noise in the channels, as the stage that makes them declares it.

use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// Key of a column's attributes under which a stage declares a list of [`NoiseProcess`]es with it. The host takes the
/// list out of the attributes and hands it on as [`crate::Model::noise`].
pub const NOISE_ATTRIBUTE: &str = "noise_processes";

/// Key of a column's attributes in a chain that predicts ([`crate::PREDICTION_NEED`]): the column is the known part of
/// a quantity, and the value says what the unknown part is, as the text of a JSON object of gains by channel,
/// `{"sc.alpha.x":1.0}`.
///
/// The unknown part is the sum over the channels of gain times the unknown acceleration in the channel: what the noise
/// processes with the response [`NoiseResponse::Held`] put into it, without readout noise. A column without this
/// attribute and without [`UNPREDICTED_SLOPE_ATTRIBUTE`] is known completely.
pub const UNPREDICTED_ATTRIBUTE: &str = "unpredicted";

/// As [`UNPREDICTED_ATTRIBUTE`], for the known part of a rate of change: the gain multiplies the backward difference of
/// the unknown acceleration over a sampling interval, divided by the interval.
pub const UNPREDICTED_SLOPE_ATTRIBUTE: &str = "unpredicted_slope";

/// Key of a column's attributes in a chain that predicts: channels, as the text of a JSON array of names, of whose next
/// readout the column knows more than the past of all channels, because it follows readouts that are no channels.
/// Torques on a test mass follow the angles between it and the spacecraft, which the attitude channels have not read.
/// The innovations of these channels are not independent of the column, and are not weighed for what acts by it.
pub const AHEAD_ATTRIBUTE: &str = "ahead_of";

/// A noise process: a stationary random signal of one or several components, and how it enters the channels.
///
/// With M the gains of the components in the channels (`enters`) and C their covariance over the spectrum, it adds
/// `M C Mᵀ` times its one-sided power spectral density times the power response to the channels' cross-spectral matrix.
/// Two processes are independent. A stage that makes several processes which are not declares one with several
/// components.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "json-schema", derive(schemars::JsonSchema))]
pub struct NoiseProcess {
    /// Name, unique in a chain, `thruster_force`.
    pub name: String,
    /// SI unit of the process, `N`, `m`, `m s-2`.
    pub unit: String,
    /// One-sided power spectral density, a sum of terms; null where it is not known. What enters a channel with an
    /// unknown spectrum is not weighed, and what a model leaves in the channel is then not tested against the other
    /// processes.
    #[serde(default)]
    pub spectrum: Option<NoiseShape>,
    /// How the channels see it.
    pub response: NoiseResponse,
    /// Per channel, the gain of each component: the channel's acceleration (for `differenced`: its displacement or
    /// angle) per unit of the process.
    #[serde(default)]
    pub enters: BTreeMap<String, Vec<f64>>,
    /// Covariance of the components over the spectrum, by rows, symmetric; without it they are independent, each with
    /// the spectrum itself.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub covariance: Option<Vec<Vec<f64>>>,
    /// Names of the components whose level may be measured in place of the declared one, and by which coefficients
    /// refer to them in `noise` and `colours`: `thruster_force:sc.x`. Empty for a process whose level is certain.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub components: Vec<String>,
    /// An estimate of what the process drives, whose error enters channels too.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub estimate: Option<NoiseEstimate>,
}

/// A minimum-variance estimate of quantities `q = matrix · components` from their readout `q + n`.
///
/// A stage that uses the estimate in place of q leaves its error in the channels: with `S_q` the spectrum of q and
/// `S_n` that of the readout's noise, `S_n (S_q + S_n)⁻¹ S_q`. It is orthogonal to the readout, so it is independent of
/// the channels that the process enters by itself.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "json-schema", derive(schemars::JsonSchema))]
pub struct NoiseEstimate {
    /// Quantities by rows, components by columns.
    pub matrix: Vec<Vec<f64>>,
    /// Spectrum of the readout's noise, one and the same and independent for each quantity; null where nothing is read.
    #[serde(default)]
    pub readout: Option<NoiseShape>,
    /// How the readout is seen beside the quantities.
    pub readout_response: NoiseResponse,
    /// Per channel, the gain of the error of each quantity.
    pub enters: BTreeMap<String, Vec<f64>>,
}

impl NoiseProcess {
    /// Number of components.
    pub fn size(&self) -> usize {
        let of_channels = self.enters.values().next().map(Vec::len);
        of_channels.or_else(|| self.estimate.as_ref()?.matrix.first().map(Vec::len)).unwrap_or(0)
    }

    /// Channels that it enters, by itself or through an estimate.
    pub fn channels(&self) -> impl Iterator<Item = &str> {
        self.enters.keys().chain(self.estimate.iter().flat_map(|e| e.enters.keys())).map(String::as_str)
    }

    /// Whether numbers and sizes make sense.
    ///
    /// # Errors
    /// A sentence that names what does not.
    pub fn check(&self) -> Result<(), String> {
        if self.name.is_empty() {
            return Err("it has no name".to_owned());
        }
        let size = self.size();
        if size == 0 {
            return Err("it enters no channel".to_owned());
        }
        check_gains("enters", &self.enters, size)?;
        if !self.components.is_empty() && self.components.len() != size {
            return Err(format!("it has {size} components and {} names of components", self.components.len()));
        }
        if let Some(covariance) = &self.covariance {
            check_matrix("covariance", covariance, size)?;
            let symmetric = || (0..size).all(|i| (0..i).all(|j| covariance[i][j] == covariance[j][i]));
            if covariance.len() != size || !symmetric() || (0..size).any(|i| covariance[i][i] < 0.0) {
                return Err(format!(
                    "the covariance is no covariance of {size} components: symmetric, variances not negative"
                ));
            }
        }
        if let Some(estimate) = &self.estimate {
            check_matrix("estimate.matrix", &estimate.matrix, size)?;
            check_gains("estimate.enters", &estimate.enters, estimate.matrix.len())?;
            estimate.readout.as_ref().map_or(Ok(()), check_spectrum)?;
        }
        self.spectrum.as_ref().map_or(Ok(()), check_spectrum)
    }
}

fn check_gains(key: &str, gains: &BTreeMap<String, Vec<f64>>, size: usize) -> Result<(), String> {
    for (channel, row) in gains {
        if row.len() != size {
            return Err(format!("{key}: {channel} has {} gains where there are {size} components", row.len()));
        }
        if let Some(gain) = row.iter().find(|gain| !gain.is_finite()) {
            return Err(format!("{key}: {channel} has the gain {gain}"));
        }
    }
    Ok(())
}

fn check_matrix(key: &str, rows: &[Vec<f64>], columns: usize) -> Result<(), String> {
    let sound = rows.iter().all(|row| row.len() == columns && row.iter().all(|x| x.is_finite()));
    if sound && !rows.is_empty() {
        Ok(())
    } else {
        Err(format!("{key}: it must have rows of {columns} finite numbers"))
    }
}

fn check_spectrum(shape: &NoiseShape) -> Result<(), String> {
    let sound = |t: &&NoiseTerm| {
        let corner = t.corner_hz.is_finite() && (t.corner_hz > 0.0 || t.exponent == 0);
        t.asd.is_finite() && t.asd >= 0.0 && corner && t.exponent.is_multiple_of(2)
    };
    match shape.terms.iter().find(|t| !sound(t)) {
        Some(t) => Err(format!(
            "the term asd = {}, corner_hz = {}, exponent = {}; an asd is not negative, a corner positive, an exponent even",
            t.asd, t.corner_hz, t.exponent
        )),
        None => Ok(()),
    }
}

/// How a channel sees a noise process; `dt` is the sampling interval.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "json-schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "kebab-case")]
pub enum NoiseResponse {
    /// An acceleration held over each sample, seen through the mean of two: power response cos²(π f dt).
    Held,
    /// The readout of a displacement, differenced twice: power response (4 sin²(π f dt)/dt²)².
    Differenced,
    /// Measured as it is: power response 1.
    #[default]
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
    pub fn white(asd: f64) -> Self {
        Self { terms: vec![NoiseTerm { asd, corner_hz: 1.0, exponent: 0 }] }
    }

    /// `a·sqrt(1+(corner/f)^exponent)`, unit/√Hz.
    pub fn with_corner(asd: f64, corner_hz: f64, exponent: u32) -> Self {
        let mut shape = Self::white(asd);
        if exponent > 0 && corner_hz > 0.0 {
            shape.terms.push(NoiseTerm { asd, corner_hz, exponent });
        }
        shape
    }

    /// One-sided PSD at `frequency_hz` > 0, unit²/Hz.
    pub fn psd(&self, frequency_hz: f64) -> f64 {
        self.terms.iter().map(|t| t.asd * t.asd * (t.corner_hz / frequency_hz).powi(t.exponent.cast_signed())).sum()
    }

    /// White part of the one-sided PSD, unit²/Hz.
    pub fn white_psd(&self) -> f64 {
        self.terms.iter().filter(|t| t.exponent == 0).map(|t| t.asd * t.asd).sum()
    }

    /// The terms that are not white.
    pub fn coloured(&self) -> impl Iterator<Item = &NoiseTerm> {
        self.terms.iter().filter(|t| t.exponent > 0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn process() -> NoiseProcess {
        let text = r#"{"name":"n","unit":"N","response":"held","spectrum":[{"asd":1.0,"corner_hz":0.0,"exponent":0}],
            "enters":{"a":[1.0,2.0]},"covariance":[[2.0,1.0],[1.0,3.0]],"components":["n:1","n:2"],
            "estimate":{"matrix":[[1.0,0.0]],"readout_response":"differenced","enters":{"b":[0.5]}}}"#;
        serde_json::from_str(text).expect("a declaration")
    }

    #[test]
    fn a_sound_declaration_passes_and_names_all_its_channels() {
        assert_eq!(process().check(), Ok(()));
        assert_eq!((process().size(), process().channels().collect::<Vec<_>>()), (2, vec!["a", "b"]));
        let text = serde_json::to_string(&process()).expect("JSON");
        assert_eq!(serde_json::from_str::<NoiseProcess>(&text).expect("our own"), process());
    }

    #[test]
    fn every_contradiction_is_named() {
        let refused = |word: &str, change: fn(&mut NoiseProcess)| {
            let mut wrong = process();
            change(&mut wrong);
            let sentence = wrong.check().expect_err(word);
            assert!(sentence.contains(word), "{word}: {sentence}");
        };
        refused("name", |p| p.name.clear());
        refused("no channel", |p| (p.enters, p.estimate) = (BTreeMap::new(), None));
        refused("NaN", |p| p.enters = [("a".to_owned(), vec![1.0, f64::NAN])].into());
        refused("3 gains", |p| drop(p.enters.insert("c".to_owned(), vec![1.0; 3])));
        refused("1 names", |p| p.components.truncate(1));
        refused("covariance", |p| p.covariance = Some(vec![vec![1.0, 0.5], vec![0.0, 1.0]]));
        refused("covariance", |p| p.covariance = Some(vec![vec![1.0, 0.0]]));
        refused("estimate.matrix", |p| p.estimate.iter_mut().for_each(|e| e.matrix[0].truncate(1)));
        refused("estimate.enters", |p| p.estimate.iter_mut().for_each(|e| e.matrix.push(vec![0.0; 2])));
        refused("corner", |p| p.spectrum.iter_mut().for_each(|s| s.terms[0].exponent = 2));
        refused("asd", |p| p.spectrum.iter_mut().for_each(|s| s.terms[0].asd = f64::INFINITY));
    }
}
