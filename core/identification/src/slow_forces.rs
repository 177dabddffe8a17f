//! Slow forces that no effect explains: random walks of acceleration, one for each way in which a force enters the
//! channels ([`dragfree_estimation::random_walk`]).

use dragfree_estimation::random_walk::{BandSpectra, held_directions, significant_powers};
use dragfree_schema::{NoiseProcess, NoiseResponse, NoiseShape, NoiseTerm};
use nalgebra::DVector;

use crate::candidates::Candidate;
use crate::driven::Driven;
use crate::scores::{CandidateScorer, Fit};
use crate::slow_samples::BesideWalk;
use dragfree_estimation::decimate::SLOW_HZ;
use dragfree_estimation::sigma::{NoiseError, NoiseModel};

/// Frequency at which the spectral density of a random walk is stated, Hz.
const STATED_HZ: f64 = 1e-3;

/// Random walks of acceleration beside the declared noise, with the powers that the residuals of a fit have.
pub fn slow_forces(scorer: &CandidateScorer<'_>, fit: &Fit, declared: &[NoiseProcess]) -> Vec<NoiseProcess> {
    let channels = &scorer.candidate_set.channels;
    let directions = held_directions(declared, channels);
    let plan = scorer.plan();
    let measured = scorer.residual_psd(fit);
    let mut levels = scorer.levels(fit, &measured);
    levels.fit();
    let observations = scorer.total.weights.observations(plan);
    let bands: Vec<BandSpectra<'_>> = (0..plan.bands.len())
        .filter(|b| observations[*b] > 0.0 && plan.frequency_hz(plan.bands[*b]) < SLOW_HZ)
        .map(|b| BandSpectra {
            hz: plan.frequency_hz(plan.bands[b]),
            observations: observations[b],
            modelled: &levels.modelled()[b],
            measured: &measured[b],
        })
        .collect();
    let gains: Vec<&DVector<f64>> = directions.iter().map(|(_, g)| g).collect();
    let powers = significant_powers(&bands, &gains, scorer.settings.level_delta_chi2);
    directions
        .iter()
        .zip(powers)
        .filter(|(_, power)| *power > 0.0)
        .map(|((name, direction), power)| NoiseProcess {
            name: format!("slow force beside {name}"),
            unit: "m s-2".to_owned(),
            spectrum: Some(NoiseShape {
                terms: vec![NoiseTerm { asd: power.sqrt() / STATED_HZ, corner_hz: STATED_HZ, exponent: 2 }],
            }),
            response: NoiseResponse::Held,
            enters: channels.iter().zip(direction.iter()).map(|(c, g)| (c.clone(), vec![*g])).collect(),
            ..NoiseProcess::default()
        })
        .collect()
}

/// Slow forces without those that one of `candidates`, or one of the `driven` ones, explains better. Each of the driven
/// ones comes with the response of the place where it acts; they are the best of so many functions that were `tried`.
/// A random walk whose power is made to fit takes what drifts evenly, and beside it the cause that acts would explain
/// next to nothing.
///
/// # Errors
/// The declared noise and the slow forces contradict each other.
pub fn not_explained(
    scorer: &CandidateScorer<'_>,
    fit: &Fit,
    slow: &[NoiseProcess],
    declared: &[NoiseProcess],
    candidates: &[Candidate],
    (driven, tried): (&[(Driven, DVector<f64>)], f64),
) -> Result<Vec<NoiseProcess>, NoiseError> {
    let (set, gathered) = (scorer.candidate_set, scorer.gathered);
    let candidates: Vec<&Candidate> =
        candidates.iter().filter(|c| !c.transient && c.is_slow(&gathered.columns)).collect();
    let mut left = Vec::new();
    for (k, force) in slow.iter().enumerate() {
        let gain = |channel: &String| force.enters.get(channel).map_or(0.0, |gains| gains[0]);
        let along = DVector::from_iterator(set.channels.len(), set.channels.iter().map(gain));
        let others = slow.iter().enumerate().filter(|(i, _)| *i != k).map(|(_, other)| other);
        let noise: Vec<NoiseProcess> = declared.iter().chain(others).cloned().collect();
        let noise = NoiseModel::new(&noise, &set.channels, 1.0 / gathered.rate_hz)?;
        let is_explained = |beside: BesideWalk| {
            let causes: Vec<_> = candidates.iter().map(|c| beside.acting(c)).filter(|all| !all.is_empty()).collect();
            let level = &gathered.housekeeping.level;
            let driven: Vec<_> = driven.iter().flat_map(|(d, response)| d.acting(response, &beside, level)).collect();
            beside.is_explained_by_one_of(&causes, causes.len() as f64) || beside.is_explained_by_one_of(&driven, tried)
        };
        if !gathered.slow.beside_a_walk(&along, &fit.added, &noise).is_some_and(is_explained) {
            left.push(force.clone());
        }
    }
    Ok(left)
}
