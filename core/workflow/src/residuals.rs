//! Where a product's model fails, from the normal equations by band that lie beside it: what each channel leaves in
//! each band, over the noise that the mission declares. No telemetry is read, so there are no hours, which
//! [`crate::compare`] has.

use std::ops::Range;

use dragfree_archive::Archive;
use dragfree_engine::EngineError;
use dragfree_estimation::normal::residual_spectra;
use dragfree_estimation::sigma::{BandNoise, NoiseModel};
use dragfree_estimation::stored::Stored;
use dragfree_identification::distributions::{chi2_per_dof_quantile, corrected, two_sided};
use nalgebra::DVector;
use serde::Serialize;

use crate::WorkflowError;

/// Probability outside of the bounds that are drawn.
pub(crate) const OUTSIDE: f64 = 0.05;

/// Width of a group of bands, decades: a map of four decades is looked at in one piece.
const GROUP_DECADES: f64 = 1.0 / 6.0;

/// Residuals of a product by channel and band.
#[derive(Clone, Debug, Serialize)]
pub struct Residuals {
    /// Product.
    pub product: String,
    /// First and last frequency of each band, Hz.
    pub bands_hz: Vec<[f64; 2]>,
    /// The same of groups of neighbouring bands.
    pub groups_hz: Vec<[f64; 2]>,
    /// Probability with which each channel of a sound model has a band that counts as failing.
    pub false_alarm: f64,
    /// Channels.
    pub channels: Vec<Channel>,
}

/// A channel.
#[derive(Clone, Debug, Serialize)]
pub struct Channel {
    /// `accel.x` of a test mass, for one.
    pub name: String,
    /// Bands.
    pub bands: Vec<Band>,
    /// Groups of bands; one fails with any of its bands.
    pub groups: Vec<Band>,
}

/// A channel in a band, or in a group of them.
#[derive(Clone, Debug, Serialize)]
pub struct Band {
    /// Root of the mean one-sided power spectral density of the residual, unit of the channel/√Hz.
    pub measured_asd: f64,
    /// The same of the declared noise.
    pub modelled_asd: f64,
    /// Measured over modelled power; none where the band has no data.
    pub ratio: Option<f64>,
    /// Between which it lies with 95 % where the model is right.
    pub bounds: [f64; 2],
    /// Whether chance is no explanation, all bands of the channel considered.
    pub fails: bool,
}

/// The residuals of a product at its adopted values.
///
/// # Errors
/// There is no such product, it keeps no normal equations, or these are damaged.
pub fn residuals(archive: &Archive, id: &str) -> Result<Residuals, WorkflowError> {
    let product = archive.document(id).map_err(EngineError::from)?;
    let text = archive.read_file(id, "neq.json").map_err(EngineError::from)?;
    let path = archive.path_of(id).with_extension("neq.json");
    let refuse = |what: String| WorkflowError::Reference { path: path.clone(), what };
    let stored = Stored::of_equations(&text).map_err(|e| refuse(e.to_string()))?;
    let adopted = product.result.adopted();
    let value = |name: &String| adopted.iter().find(|c| c.name == *name).map(|c| c.value);
    let declared = |name: &String| stored.declared.coefficients.iter().find(|c| c.name == *name).map(|c| c.initial);
    let theta = stored.layout.coefficients.iter().map(|name| value(name).or_else(|| declared(name)).unwrap_or(0.0));
    let theta = DVector::from_iterator(stored.layout.coefficients.len(), theta);
    let plan = stored.plan();
    let model = NoiseModel::new(&stored.declared.noise, &stored.layout.channels, 1.0 / plan.rate_hz)?;
    let noise = BandNoise::new(&model, &plan);
    let measured = residual_spectra(&stored.spectra, &stored.layout, &theta);
    let observations = stored.spectra.observations(&plan);
    let false_alarm = product.settings.false_alarm;
    let groups = groups(&stored.bands_hz);
    let tried = (plan.bands.len() + groups.len()) as f64;
    let band = |channel: usize, range: Range<usize>| {
        let of = |f: &dyn Fn(usize) -> f64| range.clone().map(f).sum::<f64>();
        let psd = |b: usize| measured[b][(channel, channel)];
        let model = |b: usize| stored.spectra.expected[b] * noise.mean(b)[(channel, channel)];
        let (expected, known) = (of(&|b| stored.spectra.expected[b]), of(&|b| observations[b]));
        let power = |b: usize| if observations[b] > 0.0 { observations[b] * psd(b) / model(b) } else { 0.0 };
        let dof = 2.0 * known;
        let ratio = (expected > 0.0 && dof > 0.0).then(|| of(&power) / known);
        let fails = fails(ratio, dof, tried, false_alarm);
        let quantile = |p| if dof > 0.0 { chi2_per_dof_quantile(p, dof) } else { 1.0 };
        let root = |f: &dyn Fn(usize) -> f64| (of(f) / expected).max(0.0).sqrt();
        Band {
            measured_asd: root(&psd),
            modelled_asd: root(&model),
            ratio,
            bounds: [0.5 * OUTSIDE, 1.0 - 0.5 * OUTSIDE].map(quantile),
            fails,
        }
    };
    let channels = stored.layout.channels.iter().enumerate().map(|(c, name)| {
        let bands: Vec<Band> = (0..plan.bands.len()).map(|b| band(c, b..b + 1)).collect();
        // A line is lost in a wide group: one of its bands is enough.
        let group = |range: &Range<usize>| {
            let whole = band(c, range.clone());
            Band { fails: whole.fails || bands[range.clone()].iter().any(|b| b.fails), ..whole }
        };
        Channel { name: name.clone(), groups: groups.iter().map(group).collect(), bands }
    });
    let ends = |range: &Range<usize>| [stored.bands_hz[range.start][0], stored.bands_hz[range.end - 1][1]];
    Ok(Residuals {
        product: id.to_owned(),
        channels: channels.collect(),
        groups_hz: groups.iter().map(ends).collect(),
        bands_hz: stored.bands_hz.clone(),
        false_alarm,
    })
}

/// Whether chance is no explanation of a ratio of powers, of so many that are looked at.
pub(crate) fn fails(ratio: Option<f64>, dof: f64, tried: f64, false_alarm: f64) -> bool {
    ratio.is_some_and(|r| corrected(two_sided(r, dof), tried) < false_alarm)
}

/// Neighbouring bands, together [`GROUP_DECADES`] wide at least.
pub(crate) fn groups(bands_hz: &[[f64; 2]]) -> Vec<Range<usize>> {
    let mut all: Vec<Range<usize>> = Vec::new();
    for (b, [low, _]) in bands_hz.iter().enumerate() {
        match all.last_mut() {
            Some(last) if (low / bands_hz[last.start][0]).log10() < GROUP_DECADES => last.end = b + 1,
            _ => all.push(b..b + 1),
        }
    }
    all
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_band_is_in_one_group() {
        let bands: Vec<[f64; 2]> = (1..200).map(|k| [f64::from(k), f64::from(k) + 0.9]).collect();
        let groups = groups(&bands);
        let all: Vec<usize> = groups.iter().cloned().flatten().collect();
        assert_eq!(all, (0..199).collect::<Vec<_>>());
        // A sixth of a decade is a factor of 1.47: 1, 2, 3 to 4, 5 to 7, 8 to 11.
        assert_eq!(groups[..5], [0..1, 1..2, 2..4, 4..7, 7..11], "{groups:?}");
        assert!(groups.len() < 16, "{groups:?}");
    }
}
