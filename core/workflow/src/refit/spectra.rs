//! Residual spectra of the products of a fit, with the model alone and with the effects that are on.

use dragfree_identification::distributions::chi2_per_dof_quantile;
use nalgebra::DVector;

use super::solving::{Solving, effects_of};
use super::{Day, On, Spectra};
use crate::extract::ByBand;
use crate::residuals::{Band, Channel, OUTSIDE, Residuals, fails};

/// Power by channel and group of bands.
type Power = Vec<Vec<f64>>;

/// What is the same of all channels in each group of bands.
#[derive(Clone, Copy)]
struct Groups<'a> {
    observations: &'a [f64],
    /// Between which 95 of 100 ratios lie.
    bounds: &'a [[f64; 2]],
}

impl Solving<'_> {
    /// None where the extract of a product does not tell its spectra.
    pub(super) fn spectra(&self, on: &[On]) -> Option<Spectra> {
        let days: Vec<(&Day, &ByBand)> =
            self.fitted.iter().map(|day| Some((*day, &**day.by_band.as_ref()?))).collect::<Option<_>>()?;
        let (_, first) = *days.first()?;
        if days.iter().any(|(_, other)| !other.adds_to(first)) {
            return None;
        }
        let mut observations = vec![0.0; first.groups_hz.len()];
        for (_, day) in &days {
            observations.iter_mut().zip(&day.observations).for_each(|(sum, x)| *sum += x);
        }
        let power = |on: &[On]| summed(&days, &self.quadratic.values(&effects_of(on)));
        let (before, now) = (power(&[]), power(on));
        let louder: Power = (0..first.channels.len()).map(|c| self.louder(first, on, c)).collect();
        let as_it_is = vec![vec![1.0; observations.len()]; first.channels.len()];
        let chi2 = |power: &Power, louder: &Power, c: usize| -> f64 {
            let of = |g: usize| 2.0 * (power[c][g] / louder[c][g] + observations[g] * louder[c][g].ln());
            (0..observations.len()).map(of).sum()
        };
        let fall = |c| chi2(&before, &as_it_is, c) - chi2(&now, &louder, c);
        let quantile = |p: f64, dof: f64| if dof > 0.0 { chi2_per_dof_quantile(p, dof) } else { 1.0 };
        // The same for all channels, and dear.
        let bounds: Vec<[f64; 2]> =
            observations.iter().map(|x| [0.5 * OUTSIDE, 1.0 - 0.5 * OUTSIDE].map(|p| quantile(p, 2.0 * x))).collect();
        let groups = Groups { observations: &observations, bounds: &bounds };
        let residuals = |power: &Power, louder: &Power| self.residuals(first, groups, power, louder);
        Some(Spectra {
            fall: (0..first.channels.len()).map(fall).collect(),
            before: residuals(&before, &as_it_is),
            now: residuals(&now, &louder),
        })
    }

    /// Power of the noise of a channel over what the products state, with the levels that are on.
    fn louder(&self, first: &ByBand, on: &[On], channel: usize) -> Vec<f64> {
        let levels = on.iter().filter_map(|o| self.level(*o));
        let mut all = vec![1.0; first.groups_hz.len()];
        for level in levels {
            let Some(part) = first.levels.get(&level.coefficient).and_then(|by| by.get(channel)) else { continue };
            let more = (2.0 * level.ln).exp() - 1.0;
            all.iter_mut().zip(part).for_each(|(sum, part)| *sum += more * f64::from(*part));
        }
        all.iter().map(|x| x.max(f64::MIN_POSITIVE)).collect()
    }

    fn residuals(&self, first: &ByBand, groups: Groups<'_>, power: &Power, louder: &Power) -> Residuals {
        let Groups { observations, bounds } = groups;
        let false_alarm = self.basis.settings.false_alarm;
        let band = |c: usize, g: usize| {
            let (known, dof) = (observations[g], 2.0 * observations[g]);
            let ratio = (known > 0.0).then(|| power[c][g] / known / louder[c][g]);
            let modelled_asd = first.modelled_asd[c][g] * louder[c][g].sqrt();
            Band {
                measured_asd: modelled_asd * ratio.unwrap_or(0.0).max(0.0).sqrt(),
                modelled_asd,
                ratio,
                bounds: bounds[g],
                fails: fails(ratio, dof, observations.len() as f64, false_alarm),
            }
        };
        let channel = |(c, name): (usize, &String)| {
            let groups: Vec<Band> = (0..observations.len()).map(|g| band(c, g)).collect();
            Channel { name: name.clone(), bands: groups.clone(), groups }
        };
        Residuals {
            product: self.fitted.iter().map(|day| day.product.as_str()).collect::<Vec<_>>().join(", "),
            bands_hz: first.groups_hz.clone(),
            groups_hz: first.groups_hz.clone(),
            false_alarm,
            channels: first.channels.iter().enumerate().map(channel).collect(),
        }
    }
}

/// The power of all days at these values of all coefficients.
fn summed(days: &[(&Day, &ByBand)], values: &DVector<f64>) -> Power {
    let mut sum: Power = Vec::new();
    for (day, by_band) in days {
        let mut own = vec![0.0; by_band.about.len()];
        day.kept.iter().zip(&day.places).for_each(|(kept, place)| own[*kept] = values[*place]);
        let power = by_band.power(|i| own[i]);
        if sum.is_empty() {
            sum = power;
        } else {
            sum.iter_mut().flatten().zip(power.iter().flatten()).for_each(|(sum, x)| *sum += x);
        }
    }
    sum
}
