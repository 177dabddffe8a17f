//! Levels of noise that a model leaves free: estimated beside the coefficients, by the likelihood of the residuals.
//!
//! Coefficients at fixed levels and levels at fixed coefficients are solved for in turn, each time with Σ made anew
//! from the declarations at the levels found, until no level moves by more than a small part of its σ.

use std::collections::BTreeSet;

use dragfree_schema::{Coefficient, NoiseLevels, NoiseProcess};
use nalgebra::{Cholesky, DMatrix};

use crate::estimate::{Bound, Estimate, EstimateError, Method, Observed, Unknown, colours, estimate_with};
use crate::levels::{Level, Levels};
use crate::normal::residual_spectra;
use crate::sigma::{BandNoise, NoiseModel};
use crate::spectra::Spectra;

/// Most rounds: the step from one to the next falls by the part of the noise's power that a coefficient can take up.
const ROUNDS: usize = 4;

/// Part of its σ below which the step of a level is negligible.
const NEGLIGIBLE_STEP: f64 = 0.05;

/// A solution and the levels that belong to it.
pub struct WithLevels {
    /// Coefficients; the Σ that they are weighed by is at the levels.
    pub estimate: Estimate,
    /// The free levels, in the order in which they were asked for, over the declared amplitudes.
    pub levels: Vec<Level>,
    /// The declared noise at these levels.
    pub noise: Vec<NoiseProcess>,
}

/// Solves for all coefficients that are estimated, the levels of noise among them that the channels show; `declared`
/// has these at their initial values.
///
/// # Errors
/// [`EstimateError`] as [`estimate_with`].
pub fn solve(
    observed: &Observed<'_>,
    declared: &[NoiseProcess],
    coefficients: &[Coefficient],
    bounds: &[Bound],
    method: &Method<'_>,
) -> Result<WithLevels, EstimateError> {
    let model = NoiseModel::new(declared, &observed.layout.channels, 1.0 / observed.plan.rate_hz)?;
    let is_level = |c: &Coefficient| c.estimate && model.process_names().any(|name| name == c.noise);
    let free: Vec<Coefficient> = coefficients.iter().filter(|c| is_level(c)).cloned().collect();
    let others = |c: &Coefficient| Unknown { estimate: c.estimate && !is_level(c), ..Unknown::of(c) };
    let unknowns: Vec<Unknown> = coefficients.iter().map(others).collect();
    if free.is_empty() {
        let noise = BandNoise::new(&model, observed.plan);
        let estimate = estimate_with(observed, &noise, &unknowns, bounds, method)?;
        return Ok(WithLevels { estimate, levels: Vec::new(), noise: declared.to_vec() });
    }
    estimate_with_levels(observed, declared, &free, &unknowns, bounds, method)
}

/// Solves for the coefficients and for `free` levels of noise. `declared` has them at their initial values; a level
/// that its channels do not show is left out.
///
/// # Errors
/// [`EstimateError`] as [`estimate_with`].
pub fn estimate_with_levels(
    observed: &Observed<'_>,
    declared: &[NoiseProcess],
    free: &[Coefficient],
    unknowns: &[Unknown],
    bounds: &[Bound],
    method: &Method<'_>,
) -> Result<WithLevels, EstimateError> {
    let (layout, plan, spectra) = (observed.layout, observed.plan, &observed.sums.total);
    let mut free = free.to_vec();
    // Of several levels of one component the data see the product alone, and the first one moves.
    let mut seen = BTreeSet::new();
    free.retain(|c| seen.insert(c.noise.clone()));
    let mut noise = declared.to_vec();
    let mut levels: Vec<Level> = Vec::new();
    for round in 0..=ROUNDS {
        let model = NoiseModel::new(&noise, &layout.channels, 1.0 / plan.rate_hz)?;
        let solved = estimate_with(observed, &BandNoise::new(&model, plan), unknowns, bounds, method)?;
        let residual = residual_spectra(spectra, layout, &solved.theta);
        let expected = spectra.expected.iter().map(|e| e.max(f64::MIN_POSITIVE));
        let measured: Vec<DMatrix<f64>> = residual.iter().zip(expected).map(|(r, e)| r / e).collect();
        let names: Vec<&str> = free.iter().map(|c| c.noise.as_str()).collect();
        // A slow force that nobody models is no level of the noise.
        let weights = spectra.weights_of(plan.ordinary_bands());
        let mut steps = Levels::new(&model, plan, &weights, &measured, method.settings)
            .coloured(plan, &colours(unknowns, &solved.theta));
        let steps = steps.fit_jointly(&names);
        let moves = |s: &Level| (s.value - 1.0).abs() > NEGLIGIBLE_STEP * s.sigma;
        if round == ROUNDS || !steps.iter().any(moves) {
            // The σ of a step is that of a level over the one that Σ has.
            let at = |s: Level| Some((free.iter().find(|c| c.noise == s.process)?.initial, s));
            levels.extend(steps.into_iter().filter_map(at).map(|(initial, s)| Level {
                value: initial,
                sigma: initial * s.sigma,
                ..s
            }));
            return Ok(WithLevels { estimate: solved, levels, noise });
        }
        let mut changes = Vec::new();
        for c in &mut free {
            let step = steps.iter().find(|s| s.process == c.noise).map_or(1.0, |s| s.value);
            let to = (c.initial * step).clamp(c.lower.max(f64::MIN_POSITIVE), c.upper);
            changes.push(Coefficient { initial: to / c.initial, ..c.clone() });
            c.initial = to;
        }
        NoiseLevels::of(&changes).apply(&mut noise).map_err(crate::sigma::NoiseError::of)?;
    }
    unreachable!("the last round returns")
}

/// `Σ 2n log det Σ` over the bands of the sums, n complex observations a band: with χ² it is `−2 log` of the likelihood
/// up to a constant of the data. `None` where a Σ is singular.
pub fn log_determinant(noise: &BandNoise<'_>, spectra: &Spectra) -> Option<f64> {
    let of = |sigma: &DMatrix<f64>| Some(2.0 * Cholesky::new(sigma.clone())?.l().diagonal().map(f64::ln).sum());
    noise.mean.iter().zip(spectra.counted()).filter(|(_, n)| *n > 0.0).map(|(sigma, n)| Some(n * of(sigma)?)).sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::estimate::Refinement;
    use crate::spectra::{Layout, Plan, Sums};
    use dragfree_schema::{NoiseResponse, NoiseShape, Settings};

    /// Two channels with a readout noise each and a force that both see.
    fn declared() -> Vec<NoiseProcess> {
        let process = |name: &str, asd: f64, response, enters: &[(&str, f64)]| NoiseProcess {
            name: name.to_owned(),
            spectrum: Some(NoiseShape::white(asd)),
            response,
            components: vec![name.to_owned()],
            enters: enters.iter().map(|(channel, gain)| ((*channel).to_owned(), vec![*gain])).collect(),
            ..NoiseProcess::default()
        };
        vec![
            process("force", 1e-10, NoiseResponse::Held, &[("a", 1.0), ("b", -1.0)]),
            process("readout:a", 1e-12, NoiseResponse::Differenced, &[("a", 1.0)]),
            process("readout:b", 2e-12, NoiseResponse::Differenced, &[("b", 1.0)]),
        ]
    }

    fn level(component: &str, initial: f64) -> Coefficient {
        let (lower, upper) = (0.2, 20.0);
        let (name, noise) = (format!("level.{component}"), component.to_owned());
        Coefficient { name, noise, initial, lower, upper, ..Coefficient::default() }
    }

    fn at(levels: &[(&str, f64)]) -> Vec<NoiseProcess> {
        let mut noise = declared();
        let levels: Vec<Coefficient> = levels.iter().map(|(component, k)| level(component, *k)).collect();
        NoiseLevels::of(&levels).apply(&mut noise).expect("components");
        noise
    }

    /// Sums whose spectra are exactly Σ of the noise in the middle of each band, where levels are fitted. Means over
    /// the bins of a band differ from it, and would move a level here by 0.06σ.
    fn sums(noise: &[NoiseProcess], plan: &Plan, layout: &Layout) -> Sums {
        let model = NoiseModel::new(noise, &layout.channels, 1.0 / plan.rate_hz).expect("a model");
        let sigma: Vec<DMatrix<f64>> = plan.bands.iter().map(|b| model.psd(plan.frequency_hz(*b))).collect();
        let mut sums = Sums::new(plan, layout);
        (0..20).for_each(|k| sums.total.count_segment(plan, 0, k > 0));
        let packed = sigma
            .iter()
            .zip(&sums.total.expected)
            .flat_map(|(s, expected)| [s[(0, 0)], s[(1, 0)], s[(1, 1)]].map(|x| x * expected));
        sums.total.packed = packed.collect();
        sums
    }

    /// Two free levels are found from data at 1.5 and 0.7 times the declared amplitudes, wherever they start, and Σ of
    /// the result is that of the data: χ²/dof is one. A third one that is free and right stays.
    #[test]
    fn free_levels_are_those_of_the_data() {
        let (plan, settings) = (Plan::new(4096, 10.0), Settings::default());
        let layout = Layout {
            channels: vec!["a".to_owned(), "b".to_owned()],
            series: Vec::new(),
            regressors: Vec::new(),
            coefficients: Vec::new(),
        };
        let truth = [("force", 1.5), ("readout:a", 0.7), ("readout:b", 1.0)];
        let sums = sums(&at(&truth), &plan, &layout);
        let observed = Observed { layout: &layout, plan: &plan, sums: &sums, prediction: None };
        for (refinement, start) in [(Refinement::Bands, 1.0), (Refinement::Levels, 1.0), (Refinement::Levels, 3.0)] {
            let method = Method { refinements: 3, refinement, settings: &settings };
            let free: Vec<Coefficient> = truth.iter().map(|(component, _)| level(component, start)).collect();
            let starts: Vec<(&str, f64)> = truth.iter().map(|(component, _)| (*component, start)).collect();
            let found = estimate_with_levels(&observed, &at(&starts), &free, &[], &[], &method).expect("a solution");
            for ((component, k), level) in truth.iter().zip(&found.levels) {
                assert!(
                    level.process == *component && (level.value - k).abs() < NEGLIGIBLE_STEP * level.sigma,
                    "{level:?}"
                );
                assert!(level.sigma > 0.0 && level.sigma < 0.05 * k, "{level:?}");
            }
            let ratio = found.estimate.quality.chi2_per_dof_modelled_sigma;
            assert!((ratio - 1.0).abs() < 1e-3, "{ratio}");
        }
    }

    /// A process k times as loud adds `2n log k²` to each band, with n as everywhere else.
    #[test]
    fn the_determinant_counts_observations() {
        let plan = Plan::new(4096, 10.0);
        let layout = Layout {
            channels: vec!["a".to_owned()],
            series: Vec::new(),
            regressors: Vec::new(),
            coefficients: Vec::new(),
        };
        let mut spectra = Sums::new(&plan, &layout).total;
        (0..20).for_each(|k| spectra.count_segment(&plan, 0, k > 0));
        let of = |k: f64| {
            let own = at(&[("readout:a", k)]).swap_remove(1);
            let model = NoiseModel::new(&[own], &layout.channels, 0.1).expect("a model");
            log_determinant(&BandNoise::new(&model, &plan), &spectra).expect("regular")
        };
        let observations: f64 = spectra.observations(&plan).iter().sum();
        let expected = 2.0 * observations * 4.0_f64.ln();
        assert!(((of(2.0) - of(1.0)) / expected - 1.0).abs() < 1e-3, "{} {expected}", of(2.0) - of(1.0));
    }
}
