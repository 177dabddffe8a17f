//! The verdict: the model is sufficient, named effects are missing, or something remains that no candidate explains.
//!
//! Forward selection: the candidate with the smallest corrected p-value is added, and all others are scored again
//! beside it.

use dragfree_estimation::levels::{Level, Levels};
use dragfree_estimation::spectra::FIRST_BIN;
use dragfree_estimation::verdict::chi2_per_dof_at;
use dragfree_schema::Settings;
use serde::Serialize;
use serde_json::{Map, Value, json};
use std::collections::BTreeMap;

use crate::candidates::Candidate;
use crate::coherence::Coherence;
use crate::distributions::{corrected, ln_chi2_above, normal_tails};
use crate::gram::LONG;
use crate::scores::{CandidateScorer, Fit, IdentificationError, Scored, WithoutExcess};

/// Standard normal quantile of a one-sided 95 % limit.
pub const LIMIT_QUANTILE: f64 = 1.645;

/// Why a candidate has no result.
const UNOBSERVABLE: &str =
    "unobservable in these data: its series do not change in them, or the model contains the same already";

/// A candidate and its evidence.
#[derive(Clone, Debug, Serialize)]
pub struct Found {
    /// Effect.
    pub effect: String,
    /// Instance.
    pub instance: String,
    /// Coefficient with the largest value over σ.
    pub coefficient: String,
    /// Its value, in `unit`.
    pub value: f64,
    /// σ of it.
    pub sigma: f64,
    /// Unit.
    pub unit: String,
    /// Values of the shape parameters.
    pub shape: Map<String, Value>,
    /// Every coefficient of the effect: name, value, σ, unit.
    pub coefficients: Vec<Value>,
    /// Fall of χ².
    pub delta_chi2: f64,
    /// p-value, corrected for everything tried: every effect has the same part of the false-alarm rate, whatever its
    /// forms.
    pub p_value: f64,
    /// Its decimal logarithm, finite where the p-value underflows; the list is sorted by it.
    pub log10_p_value: f64,
    /// Change of the Bayesian information criterion, negative in favour of the effect.
    pub delta_bic: f64,
    /// Whether the value lies inside its physical range.
    pub in_range: bool,
    /// Fall of χ² of each half of the data at the values fitted to the other; none where there is one half.
    pub held_out_delta_chi2: Option<[f64; 2]>,
    /// p-value of the difference of the halves' values; none where there is one half.
    pub held_out_p_value: Option<f64>,
    /// χ²/dof without it.
    pub chi2_per_dof_before: f64,
    /// χ²/dof with it.
    pub chi2_per_dof_after: f64,
    /// Bias of each coefficient of the model that is a length while this is missing, m.
    pub offset_shift_m: BTreeMap<String, f64>,
    /// The same in σ of the coefficient.
    pub offset_shift_sigma: BTreeMap<String, f64>,
    /// Channels on which it acts.
    pub channels: Vec<String>,
    /// Candidates and coefficients that the data cannot tell from it.
    pub confounders: Vec<String>,
    /// Whether it is part of the answer.
    pub accepted: bool,
    /// Why it is no part of the answer although its p-value is below the false-alarm rate.
    pub refused: Option<String>,
    /// Whether it was selected by the likelihood ratio over an excess of power.
    #[serde(skip)]
    pub of_excess: bool,
    /// Whether it is a level of noise that drives an estimate which enters the channels.
    #[serde(skip)]
    pub drives_estimate: bool,
}

impl Found {
    /// As a level that is told and is no cause.
    pub fn level(&self) -> OtherLevel {
        let (effect, instance) = (self.effect.clone(), self.instance.clone());
        OtherLevel { effect, instance, value: self.value, sigma: self.sigma }
    }

    /// The same with the evidence of a ratio of likelihoods.
    fn with_delta_chi2(self, delta_chi2: f64, fit: &Fit, scored: &Scored, trials: &Trials) -> Self {
        let (dof, data) = (scored.candidate.parts.len() as f64, fit.estimate.quality.dof);
        let (p_value, log10_p_value) = trials.p_value(family(&scored.candidate), delta_chi2, dof);
        let delta_bic = dof * data.ln() - delta_chi2;
        let chi2_per_dof_after = self.chi2_per_dof_before - delta_chi2 / data;
        Self { delta_chi2, p_value, log10_p_value, delta_bic, chi2_per_dof_after, ..self }
    }
}

/// The upper limit of a coefficient that is not detected.
#[derive(Clone, Debug, Serialize)]
pub struct Limit {
    /// Effect.
    pub effect: String,
    /// Instance.
    pub instance: String,
    /// Coefficient.
    pub coefficient: String,
    /// 95 % upper limit on its size.
    pub limit_95: f64,
    /// σ of it from these data.
    pub sigma: f64,
    /// Unit.
    pub unit: String,
    /// Form for which it holds.
    pub shape: Map<String, Value>,
}

/// Evidence that no candidate explains.
#[derive(Clone, Debug, Serialize)]
pub struct Unexplained {
    /// Channels with an excess.
    pub channels: Vec<String>,
    /// Lowest and highest frequency of it, Hz.
    pub band_hz: [f64; 2],
    /// `broadband`, `transient` or `drift`.
    pub kind: String,
    /// Measured over modelled power, at its worst.
    pub ratio: f64,
    /// Whether there is more power than modelled; otherwise the evidence is coherence alone.
    pub power: bool,
    /// Housekeeping that is coherent with it, each in its best form, the smallest p-value first.
    pub coherent_with: Vec<String>,
    /// The same with numbers.
    #[serde(rename = "witnesses")]
    pub coherences: Vec<Coherence>,
}

/// A level of noise other than declared.
#[derive(Clone, Debug, Serialize)]
pub struct OtherLevel {
    /// Effect that would state it.
    pub effect: String,
    /// Instance.
    pub instance: String,
    /// Amplitude over the declared one.
    pub value: f64,
    /// σ of it.
    pub sigma: f64,
}

/// The answer.
#[derive(Clone, Debug, Serialize)]
pub struct Diagnosis {
    /// `sufficient`, `missing` or `unexplained`.
    pub verdict: String,
    /// What decided: `spectra` or `innovations`.
    pub decided_by: String,
    /// False-alarm rate.
    pub false_alarm_rate: f64,
    /// Forms and levels of effects that were tried; transient templates were tried at every time besides.
    pub tried: usize,
    /// Candidates, the accepted ones first, then the best of the rest.
    pub candidates: Vec<Found>,
    /// Limits of what is not detected.
    pub upper_limits: Vec<Limit>,
    /// Evidence that no candidate explains.
    pub unexplained: Option<Unexplained>,
    /// Why the model is not called sufficient although neither a candidate was accepted nor an excess was found.
    pub reasons: Vec<String>,
    /// Levels of noise other than declared, certain, and within the tolerance of a mission file.
    pub levels: Vec<OtherLevel>,
    /// Transients that were detected.
    pub transients: Vec<Value>,
    /// What could not be tried, and why.
    pub not_tried: Vec<(String, String)>,
    /// Candidates that stand out beside the model alone, in their best forms, to be tried again on a finer grid of
    /// shapes.
    #[serde(skip)]
    pub refinement_requests: Vec<RefinementRequest>,
    /// Forms that were tried, per effect, in this pass and before.
    #[serde(skip)]
    pub forms: BTreeMap<String, usize>,
    /// Every instance of every effect in its best form: those that were accepted, and the others beside them.
    #[serde(skip)]
    pub best_forms: Vec<Candidate>,
}

/// A candidate that is to be tried again on a finer grid of shapes about this one.
#[derive(Clone, Debug, PartialEq)]
pub struct RefinementRequest {
    /// Effect.
    pub effect: String,
    /// Instance.
    pub instance: String,
    /// Values of the shape parameters.
    pub shape: Map<String, Value>,
}

/// Numbers of trials for the correction of p-values. Every effect, and the search for transients, has the same part of
/// [`Settings::false_alarm`]; an effect's part is shared by all its forms (weighted Bonferroni; the weights are fixed
/// before the data are seen).
///
/// With equal weights of all forms, an effect of one form would pay for the ten thousand pairs of thermometers and lags
/// of another.
pub struct Trials {
    /// Trials per family: forms and levels of an effect, and those of the transient search.
    forms: BTreeMap<String, f64>,
}

/// The family of all transients.
pub const TRANSIENT: &str = "transient search";

/// Family whose part of the false-alarm rate a candidate uses.
fn family(c: &Candidate) -> &str {
    if c.transient { TRANSIENT } else { &c.effect }
}

impl Trials {
    /// Of the forms that were tried, per effect, and of the levels and transients of `scorer`.
    pub fn new(scorer: &CandidateScorer<'_>, forms: &BTreeMap<String, usize>) -> Self {
        let mut forms: BTreeMap<String, f64> = forms.iter().map(|(e, n)| (e.clone(), *n as f64)).collect();
        for c in scorer.candidate_set.coefficients.iter().filter(|c| !c.noise.is_empty()) {
            *forms.entry(c.effect.clone()).or_default() += 1.0;
        }
        let search = scorer.gathered.transients.tried;
        if search > 0.0 {
            forms.insert(TRANSIENT.to_owned(), search);
        }
        Self { forms }
    }

    /// Forms and levels of all effects.
    fn total(&self) -> usize {
        self.forms.iter().filter(|(family, _)| *family != TRANSIENT).map(|(_, n)| n).sum::<f64>() as usize
    }

    /// Trials of a family, one at least.
    pub fn of(&self, family: &str) -> f64 {
        self.forms.get(family).copied().unwrap_or(1.0).max(1.0)
    }

    /// Corrected p-value, and its decimal logarithm, of a fall of χ² in a family.
    pub fn p_value(&self, family: &str, chi2: f64, dof: f64) -> (f64, f64) {
        let trials = self.forms.len() as f64 * self.of(family);
        let ln_p = ln_chi2_above(chi2, dof);
        let p = corrected(ln_p.exp(), trials);
        (p, if ln_p > -30.0 { p.log10() } else { (ln_p + trials.ln()) / std::f64::consts::LN_10 })
    }
}

/// Diagnoses the sums. `tried_before` are the numbers of forms, per effect, of an earlier pass that chose forms of this
/// one.
///
/// # Errors
/// [`IdentificationError`]: too little data, or a model that cannot be fitted.
pub fn diagnose(
    scorer: &CandidateScorer<'_>,
    tried_before: &BTreeMap<String, usize>,
) -> Result<Diagnosis, IdentificationError> {
    let settings = scorer.settings;
    scorer.require("diagnosis", short_segments(scorer))?;
    let mut fit = scorer.fit(&[])?;
    let mut accepted: Vec<Found> = Vec::new();
    let loudest = {
        let measured = scorer.residual_psd(&fit);
        unexplained(scorer, &scorer.levels(&fit, &scorer.total, &measured)).map_or(0.0, |u| u.ratio)
    };
    let first = scorer.rank(&fit);
    let mut forms = first.tried;
    tried_before.iter().for_each(|(effect, n)| *forms.entry(effect.clone()).or_default() += n);
    let trials = Trials::new(scorer, &forms);
    let mut ranked = first.all;
    let mut requests = refinement_requests(settings, &trials, &ranked);
    // As often as effects may be added: two that each stand in for the other must not alternate for ever.
    let mut removed = 0;
    let mut others: Vec<Found> = loop {
        sort_by_p_value(&trials, &mut ranked);
        let mut evaluated: Vec<(Found, Candidate)> = ranked
            .iter()
            .take(settings.max_evaluated)
            .map(|scored| (evaluate(scorer, &fit, scored, &ranked, &trials), scored.candidate.clone()))
            .collect();
        for (f, candidate) in &mut evaluated {
            // Only on the refined grid: on a coarse one the wrong colour costs more likelihood than the regressor
            // explains.
            let finely = tried_before.contains_key(&candidate.effect);
            let stands_out = f.p_value < settings.false_alarm && f.in_range && accepted.len() < settings.max_added;
            // The likelihood chooses the shape. The evidence remains the score, as for effects that filter no noise.
            let chosen = if finely && stands_out { scorer.coloured(&fit, candidate)? } else { None };
            if let Some(form) = chosen {
                f.shape.clone_from(&form.parts[0].1.shape);
                *candidate = form;
            }
        }
        if accepted.len() < settings.max_added {
            let of_excess = candidates_of_excess(scorer, &fit, &trials)?.into_iter().map(|found| (found, false));
            let beside = candidates_beside_levels(scorer, &fit, &trials)?.into_iter().map(|found| (found, true));
            for ((f, candidate), beside_levels) in of_excess.chain(beside) {
                let of = |w: &(Found, Candidate)| (&w.0.effect, &w.0.instance) == (&f.effect, &f.instance);
                // What is named under the fitted levels has its shape from there: beside an excess the declared ones
                // weigh the wrong bands.
                let named = |w: &Found| beside_levels && w.p_value < settings.false_alarm;
                let stays = |w: &Found| named(w) || w.log10_p_value <= f.log10_p_value;
                match evaluated.iter().position(of) {
                    Some(i) if stays(&evaluated[i].0) => {}
                    Some(i) => evaluated[i] = (f, candidate),
                    None => evaluated.push((f, candidate)),
                }
            }
            evaluated.sort_by(|a, b| a.0.log10_p_value.total_cmp(&b.0.log10_p_value));
        }
        for (f, _) in &mut evaluated {
            f.refused = refusal(settings, f, accepted.len());
        }
        let good = |(f, _): &(Found, Candidate)| f.p_value < settings.false_alarm && f.refused.is_none();
        let Some(best) = evaluated.iter().position(good) else {
            break evaluated.into_iter().map(|(f, _)| f).collect();
        };
        let mut added = fit.added.clone();
        added.push(evaluated[best].1.clone());
        fit = scorer.fit(&added)?;
        let before = std::mem::replace(&mut ranked, scorer.rank(&fit).all);
        let mut f = Found { accepted: true, ..evaluated[best].0.clone() };
        if !f.of_excess {
            f.confounders.extend(equally_good(settings, &f, &before, &ranked));
            f.confounders.sort();
            f.confounders.dedup();
        }
        accepted.push(f);
        // What stood in for the one just accepted is not needed beside it.
        if removed < settings.max_added
            && let Some(needless) = needless(scorer, &fit, &trials)?
        {
            removed += 1;
            accepted.remove(needless);
            added.remove(needless);
            fit = scorer.fit(&added)?;
            ranked = scorer.rank(&fit).all;
        }
        // With the excess explained, Σ has changed: all accepted values are estimated again.
        estimate_again(scorer, &fit, &mut accepted);
    };

    let (mut extra, unexplained) = loop {
        let measured = scorer.residual_psd(&fit);
        let mut levels = scorer.levels(&fit, &scorer.total, &measured);
        let extra = noise_levels(scorer, &fit, &mut levels, &trials);
        let unexplained = unexplained(scorer, &levels);
        let ((excess, _), plain) = (levels.excess_bands(), levels.plain_inverses());
        let both = accepted.iter().zip(&fit.added);
        let part = |candidate: &Candidate| scorer.part_in(&fit, &plain, candidate, &excess);
        // A small remainder of the largest excess is what the grid of forms cannot represent.
        let loud = unexplained.as_ref().filter(|u| !u.power || u.ratio > settings.excess_remainder * loudest);
        let doubt = |(i, (f, c)): (usize, (&Found, &Candidate))| Some((i, doubt(settings, f, part(c), &extra, loud)?));
        let Some((doubtful, refused)) = both.enumerate().find_map(doubt) else {
            break (extra, unexplained);
        };
        others.insert(0, Found { accepted: false, refused: Some(refused), ..accepted.remove(doubtful) });
        let mut added = fit.added.clone();
        added.remove(doubtful);
        fit = scorer.fit(&added)?;
        ranked = scorer.rank(&fit).all;
        estimate_again(scorer, &fit, &mut accepted);
    };
    let tolerated = |f: &Found| f.p_value < settings.false_alarm && !f.accepted && f.refused.is_none();
    let levels = extra.iter().filter(|f| tolerated(f)).map(Found::level).collect();
    extra.retain(|f| !tolerated(f));
    // Noise levels stand behind the accepted effects and before the rest.
    extra.sort_by(|a, b| b.accepted.cmp(&a.accepted).then(a.log10_p_value.total_cmp(&b.log10_p_value)));
    let louder: Vec<Found> = extra.iter().filter(|f| f.accepted).cloned().collect();
    let mut candidates: Vec<Found> = accepted.into_iter().chain(louder).collect();
    candidates.sort_by(|a, b| a.log10_p_value.total_cmp(&b.log10_p_value));
    let missing = !candidates.is_empty();
    candidates.extend(others);
    candidates.extend(extra.into_iter().filter(|f| !f.accepted));

    let refused = |f: &Found| {
        let reason = f.refused.as_ref()?;
        Some(format!("{}:{} would lower χ² by {:.0}, and is refused: {reason}", f.effect, f.instance, f.delta_chi2))
    };
    let reasons: Vec<String> = if missing { Vec::new() } else { candidates.iter().filter_map(refused).collect() };
    let verdict = match (missing, unexplained.is_some() || !reasons.is_empty()) {
        (true, _) => "missing",
        (false, true) => "unexplained",
        (false, false) => "sufficient",
    };
    // The shape beside all accepted effects is better than the one beside the model alone.
    for request in &mut requests {
        let found = candidates.iter().find(|f| (&f.effect, &f.instance) == (&request.effect, &request.instance));
        request.shape = found.map_or_else(|| request.shape.clone(), |f| f.shape.clone());
    }
    let upper_limits = limits(scorer, &ranked, &candidates);
    let others = ranked.iter().map(|scored| scored.candidate.clone());
    let best_forms = fit.added.iter().cloned().chain(others).collect();
    Ok(Diagnosis {
        verdict: verdict.to_owned(),
        decided_by: "spectra".to_owned(),
        false_alarm_rate: settings.false_alarm,
        tried: trials.total(),
        candidates,
        upper_limits,
        unexplained,
        reasons,
        levels,
        transients: transients(scorer),
        refinement_requests: requests,
        forms,
        best_forms,
        not_tried: first.unobservable.into_iter().map(|name| (name, UNOBSERVABLE.to_owned())).collect(),
    })
}

/// What the model with `added` leaves unexplained, with the levels of the noise fitted.
///
/// # Errors
/// [`IdentificationError`]: the model cannot be fitted.
pub fn remaining(
    scorer: &CandidateScorer<'_>,
    added: &[Candidate],
) -> Result<Option<Unexplained>, IdentificationError> {
    let fit = scorer.fit(added)?;
    let measured = scorer.residual_psd(&fit);
    let mut levels = scorer.levels(&fit, &scorer.total, &measured);
    levels.fit();
    Ok(unexplained(scorer, &levels))
}

/// Effective number of independent short segments, from the observations in their lowest octave. A single band is too
/// narrow: a bin of a short segment spans many bands of the long ones, and counts in one of them.
fn short_segments(scorer: &CandidateScorer<'_>) -> f64 {
    let plan = scorer.plan();
    let octave = LONG * FIRST_BIN..2 * LONG * FIRST_BIN;
    let bands =
        plan.bands.iter().zip(scorer.total.weights.observations(plan)).filter(|(b, _)| octave.contains(&b.first));
    let (bins, observations) = bands.fold((0, 0.0), |(bins, sum), (b, n)| (bins + b.bins(), sum + n));
    observations * LONG as f64 / bins.max(1) as f64
}

/// Candidates that may explain an excess of power, by the ratio of likelihoods, each with the Σ of its own residuals.
///
/// A score under the Σ that has absorbed the excess is at most the few observations in it; under the Σ that has not,
/// whatever follows the excess by chance scores thousands. n observations whose power falls to a part x have the
/// log-likelihood ratio n log 1/x, where Bartlett's correction leaves n − (p + 2)/2 of them for p coefficients.
fn candidates_of_excess(
    scorer: &CandidateScorer<'_>,
    fit: &Fit,
    trials: &Trials,
) -> Result<Vec<(Found, Candidate)>, IdentificationError> {
    let settings = scorer.settings;
    let Some(WithoutExcess { plain, bands, observations }) = scorer.without_excess(fit) else { return Ok(Vec::new()) };
    let before = scorer.deviance(fit, &bands, &fit.added)?;
    let mut ranked = scorer.rank(&plain).all;
    sort_by_p_value(trials, &mut ranked);
    let mut out = Vec::new();
    for scored in ranked.iter().filter(|s| s.in_range).take(settings.max_excess_candidates) {
        let mut added = fit.added.clone();
        added.push(scored.candidate.clone());
        let dof = scored.candidate.parts.len() as f64;
        let kept = (1.0 - 0.5 * (dof + 2.0) / observations).max(0.0);
        // n log 1/x is at most n (1/x − 1), the fall of χ² under the Σ that has not absorbed the excess.
        let ratio = (before - scorer.deviance(fit, &bands, &added)?).clamp(0.0, scored.delta_chi2.max(0.0));
        let delta_chi2 = ratio * kept;
        let f = evaluate(scorer, &plain, scored, &ranked, trials).with_delta_chi2(delta_chi2, fit, scored, trials);
        out.push((Found { of_excess: true, ..f }, scored.candidate.clone()));
    }
    Ok(out)
}

/// Candidates that stand out under the declared levels of the noise, by the ratio of likelihoods with the levels fitted
/// beside each: a level that was adopted before a gain in the loop has absorbed part of it.
fn candidates_beside_levels(
    scorer: &CandidateScorer<'_>,
    fit: &Fit,
    trials: &Trials,
) -> Result<Vec<(Found, Candidate)>, IdentificationError> {
    let settings = scorer.settings;
    let Some((declared, bands)) = scorer.with_declared_levels(fit) else { return Ok(Vec::new()) };
    let mut ranked = scorer.rank(&declared).all;
    sort_by_p_value(trials, &mut ranked);
    let before = scorer.profile_deviance(&fit.added, &bands)?;
    let mut out = Vec::new();
    for scored in ranked.iter().filter(|s| s.in_range && !s.candidate.transient).take(settings.max_excess_candidates) {
        let f = evaluate(scorer, &declared, scored, &ranked, trials);
        if f.p_value >= settings.false_alarm {
            break;
        }
        let added = [&fit.added[..], std::slice::from_ref(&scored.candidate)].concat();
        let delta_chi2 = (before - scorer.profile_deviance(&added, &bands)?).max(0.0);
        out.push((f.with_delta_chi2(delta_chi2, fit, scored, trials), scored.candidate.clone()));
    }
    Ok(out)
}

/// An effect added before the last one whose evidence beside all others is within the bound.
fn needless(scorer: &CandidateScorer<'_>, fit: &Fit, trials: &Trials) -> Result<Option<usize>, IdentificationError> {
    let earlier = fit.added.len().saturating_sub(1);
    for (i, candidate) in fit.added[..earlier].iter().enumerate().filter(|(_, c)| !c.transient) {
        let mut others = fit.added.clone();
        others.remove(i);
        let without = scorer.fit(&others)?;
        let ranked = scorer.rank(&without).all;
        let same =
            |s: &&Scored| (&s.candidate.effect, &s.candidate.instance) == (&candidate.effect, &candidate.instance);
        let alone = ranked.iter().find(same).map(|scored| evaluate(scorer, &without, scored, &ranked, trials));
        let of = |(f, _): &(Found, Candidate)| (&f.effect, &f.instance) == (&candidate.effect, &candidate.instance);
        let by_likelihood = candidates_beside_levels(scorer, &without, trials)?.into_iter();
        let by_excess = candidates_of_excess(scorer, &without, trials)?.into_iter();
        let all = alone.into_iter().chain(by_likelihood.chain(by_excess).filter(of).map(|(f, _)| f));
        if all.map(|f| f.p_value).fold(1.0, f64::min) >= scorer.settings.false_alarm {
            return Ok(Some(i));
        }
    }
    Ok(None)
}

/// Why a candidate beyond the corrected bound is not accepted beside `accepted` others.
fn refusal(settings: &Settings, f: &Found, accepted: usize) -> Option<String> {
    if f.p_value >= settings.false_alarm {
        None
    } else if !f.in_range {
        Some("its best value lies outside its physical range".to_owned())
    } else if let Some(p) = f.held_out_p_value.filter(|p| *p <= settings.halves_p_value) {
        Some(format!("the two halves of the data give different values (p = {p:.1e}), and a lasting cause is constant"))
    } else if accepted >= settings.max_added {
        Some(format!("{accepted} effects are accepted before it, as many as the settings allow"))
    } else {
        None
    }
}

/// Why an accepted effect contradicts the rest of the answer.
///
/// - It was selected by an excess of power, or has `part` > ½ of its information in the bands of one, and an excess or
///   a coherence with housekeeping remains in its channels: it correlates with the cause and is not the cause.
/// - It moves the offset, and its fall of χ² is below [`Settings::level_trace`] of that of a level of noise that drives
///   an estimate (see there). It should be tried again with that level in the model.
fn doubt(
    settings: &Settings,
    f: &Found,
    part: f64,
    extra: &[Found],
    unexplained: Option<&Unexplained>,
) -> Option<String> {
    // For an effect selected by an excess, a remaining coherence is as much evidence as remaining power.
    let remains = |u: &&Unexplained| (u.power || f.of_excess) && f.channels.iter().any(|c| u.channels.contains(c));
    let louder = |e: &&Found| e.accepted && e.drives_estimate && f.delta_chi2 < settings.level_trace * e.delta_chi2;
    let moves = f.offset_shift_sigma.values().any(|sigmas| sigmas.abs() > settings.moves_offset_sigmas);
    if let Some(u) = unexplained.filter(|_| f.of_excess || part > 0.5).filter(remains) {
        return Some(format!("with it {} still show what no effect explains", u.channels.join(", ")));
    }
    let level = extra.iter().find(louder).filter(|_| moves)?;
    let (effect, instance) = (&level.effect, &level.instance);
    Some(format!("it may be a trace of {effect}:{instance}; add that to the model and diagnose again"))
}

/// Sorts by corrected p-value, the smallest first.
fn sort_by_p_value(trials: &Trials, ranked: &mut [Scored]) {
    let p_value = |s: &Scored| trials.p_value(family(&s.candidate), s.delta_chi2, s.candidate.parts.len() as f64).1;
    ranked.sort_by(|a, b| p_value(a).total_cmp(&p_value(b)));
}

/// Candidates that stand out beside the model alone.
fn refinement_requests(settings: &Settings, trials: &Trials, ranked: &[Scored]) -> Vec<RefinementRequest> {
    let p_value = |s: &Scored| trials.p_value(family(&s.candidate), s.delta_chi2, s.candidate.parts.len() as f64).0;
    let request = |s: &Scored| RefinementRequest {
        effect: s.candidate.effect.clone(),
        instance: s.candidate.instance.clone(),
        shape: s.candidate.parts[0].1.shape.clone(),
    };
    ranked.iter().filter(|s| !s.candidate.transient && p_value(s) < settings.false_alarm).map(request).collect()
}

/// Candidates that explained as much as `chosen` before it was added, and nothing beside it: equally good explanations.
fn equally_good(settings: &Settings, chosen: &Found, before: &[Scored], beside: &[Scored]) -> Vec<String> {
    let worth = |all: &[Scored], name: &str| {
        all.iter().find(|s| !s.candidate.transient && s.candidate.name() == name).map_or(0.0, |s| s.delta_chi2)
    };
    let names = before.iter().filter(|s| s.in_range && !s.candidate.transient).map(|s| s.candidate.name());
    let own = format!("{}:{}", chosen.effect, chosen.instance);
    names
        .filter(|name| *name != own)
        .filter(|name| {
            worth(before, name) > chosen.delta_chi2 - settings.equally_good_chi2
                && worth(beside, name) < settings.equally_good_chi2
        })
        .collect()
}

/// A candidate as it stands beside a fit.
fn evaluate(scorer: &CandidateScorer<'_>, fit: &Fit, scored: &Scored, ranked: &[Scored], trials: &Trials) -> Found {
    let parts = &scored.candidate.parts;
    let covariance = scored.information.clone().try_inverse();
    let sigma = |j: usize| covariance.as_ref().map_or(f64::INFINITY, |c| c[(j, j)].max(0.0).sqrt());
    let values: Vec<(f64, f64)> = (0..parts.len()).map(|j| (scored.value[j], sigma(j))).collect();
    let name = |j: usize| scorer.candidate_set.coefficients[parts[j].0].name.clone();
    let lead = leading(&values);
    let dof = parts.len() as f64;
    let halves = scorer.held_out(fit, &scored.candidate);
    let quality = &fit.estimate.quality;
    let (p_value, log10_p_value) = trials.p_value(family(&scored.candidate), scored.delta_chi2, dof);
    let (mut offset_shift_m, mut offset_shift_sigma) = (BTreeMap::new(), BTreeMap::new());
    for (k, i) in fit.estimate.free.iter().enumerate() {
        let Some(c) = scorer.candidate_set.coefficients[..scorer.candidate_set.model()].get(*i) else { continue };
        if c.forms[0].unit == "m" {
            let own = fit.estimate.covariance.as_ref().map_or(f64::INFINITY, |c| c[(k, k)].sqrt());
            offset_shift_m.insert(c.name.clone(), scored.shift[k]);
            offset_shift_sigma.insert(c.name.clone(), scored.shift[k] / own);
        }
    }
    let mut channels: Vec<String> =
        parts.iter().flat_map(|(_, f)| &f.terms).map(|t| scorer.candidate_set.channels[t.channel].clone()).collect();
    channels.sort();
    channels.dedup();
    Found {
        effect: scored.candidate.effect.clone(),
        instance: scored.candidate.instance.clone(),
        coefficient: name(lead),
        value: values[lead].0,
        sigma: values[lead].1,
        unit: parts[lead].1.unit.clone(),
        shape: parts[lead].1.shape.clone(),
        coefficients: (0..parts.len())
            .map(|j| json!({ "name": name(j), "value": values[j].0, "sigma": values[j].1, "unit": parts[j].1.unit }))
            .collect(),
        delta_chi2: scored.delta_chi2,
        p_value,
        log10_p_value,
        delta_bic: dof * quality.dof.ln() - scored.delta_chi2,
        in_range: scored.in_range,
        held_out_delta_chi2: halves.map(|h| h.gains),
        held_out_p_value: halves.map(|h| ln_chi2_above(h.difference_chi2, dof).exp()),
        chi2_per_dof_before: quality.chi2_per_dof,
        chi2_per_dof_after: quality.chi2_per_dof - scored.delta_chi2 / quality.dof,
        offset_shift_m,
        offset_shift_sigma,
        channels,
        confounders: scorer.confounders(fit, scored, ranked),
        accepted: false,
        refused: None,
        of_excess: false,
        drives_estimate: false,
    }
}

/// Index of the largest value over σ.
fn leading(values: &[(f64, f64)]) -> usize {
    let size = |i: &usize| (values[*i].0 / values[*i].1).abs();
    (0..values.len()).max_by(|a, b| size(a).total_cmp(&size(b))).unwrap_or(0)
}

/// The accepted effects as the fit of all of them has them.
fn estimate_again(scorer: &CandidateScorer<'_>, fit: &Fit, found: &mut [Found]) {
    let mut at = scorer.candidate_set.model();
    let sigma = |i: usize| {
        let k = fit.estimate.free.iter().position(|f| *f == i)?;
        fit.estimate.covariance.as_ref().map(|c| c[(k, k)].sqrt())
    };
    for (f, added) in found.iter_mut().zip(&fit.added) {
        let own = at..at + added.parts.len();
        at = own.end;
        // The fit has no window correction for transients.
        if added.transient {
            continue;
        }
        let values: Vec<(f64, f64)> = own.map(|i| (fit.estimate.theta[i], sigma(i).unwrap_or(f64::INFINITY))).collect();
        let lead = leading(&values);
        let name = |j: usize| scorer.candidate_set.coefficients[added.parts[j].0].name.clone();
        (f.value, f.sigma) = values[lead];
        (f.coefficient, f.unit) = (name(lead), added.parts[lead].1.unit.clone());
        f.coefficients = (0..values.len())
            .map(|j| {
                json!({ "name": name(j), "value": values[j].0, "sigma": values[j].1, "unit": added.parts[j].1.unit })
            })
            .collect();
    }
}

/// Noise levels by forward selection: those that matter are accepted, and `levels` takes them over.
fn noise_levels(scorer: &CandidateScorer<'_>, fit: &Fit, levels: &mut Levels<'_>, trials: &Trials) -> Vec<Found> {
    let settings = scorer.settings;
    let residuals = scorer.residual_psd_of_sets(fit);
    let halves = [0, 1].map(|set| scorer.levels(fit, &scorer.gathered.sets[set], &residuals[set]));
    let asked: Vec<usize> = (0..scorer.candidate_set.coefficients.len())
        .filter(|i| !scorer.candidate_set.coefficients[*i].noise.is_empty())
        .collect();
    let mut left = asked;
    let mut out = Vec::new();
    loop {
        let measured: Vec<(usize, Level)> = left
            .iter()
            .filter_map(|i| Some((*i, levels.level(&scorer.candidate_set.coefficients[*i].noise)?)))
            .collect();
        let best = measured.into_iter().max_by(|a, b| a.1.delta_chi2.total_cmp(&b.1.delta_chi2));
        let Some((i, level)) = best else { return out };
        let c = &scorer.candidate_set.coefficients[i];
        // A level that the model states is in Σ already; what is measured is relative to it.
        let stated = if c.candidate { 1.0 } else { c.initial };
        let (value, sigma) = (stated * level.value, stated * level.sigma);
        let (p_value, log10_p_value) = trials.p_value(&c.effect, level.delta_chi2, 1.0);
        // A transient raises one half of the data, noise both: equal within chance, or each by half of the rise at
        // least.
        let (differ, steady) = match halves.each_ref().map(|half| half.level(&c.noise)) {
            [Some(a), Some(b)] => {
                let difference = (a.value - b.value).abs() / a.sigma.hypot(b.sigma);
                let chance = Some(normal_tails(difference)).filter(|_| difference.is_finite());
                let shows = |half: &Level| (half.value - 1.0) / (level.value - 1.0) > 0.5;
                (chance, chance.is_none_or(|p| p > settings.halves_p_value) || shows(&a) && shows(&b))
            }
            _ => (None, true),
        };
        let matters =
            p_value < settings.false_alarm && steady && (level.value.ln()).abs() > settings.level_tolerance.ln_1p();
        if p_value < settings.false_alarm {
            levels.take(&level);
        }
        out.push(Found {
            effect: c.effect.clone(),
            instance: c.instance.clone(),
            coefficient: c.name.clone(),
            value,
            sigma,
            unit: "1".to_owned(),
            shape: Map::new(),
            coefficients: vec![json!({ "name": c.name, "value": value, "sigma": sigma, "unit": "1" })],
            delta_chi2: level.delta_chi2,
            p_value,
            log10_p_value,
            delta_bic: (scorer.total.weights.segments as f64).ln() - level.delta_chi2,
            in_range: true,
            held_out_delta_chi2: None,
            held_out_p_value: differ,
            chi2_per_dof_before: f64::NAN,
            chi2_per_dof_after: f64::NAN,
            offset_shift_m: BTreeMap::new(),
            offset_shift_sigma: BTreeMap::new(),
            channels: levels
                .channels_of(&c.noise)
                .into_iter()
                .map(|i| scorer.candidate_set.channels[i].clone())
                .collect(),
            confounders: Vec::new(),
            accepted: matters,
            refused: (p_value < settings.false_alarm && !steady).then(|| {
                format!("the two halves of the data have different levels (p = {:.1e})", differ.unwrap_or(0.0))
            }),
            of_excess: false,
            drives_estimate: scorer.noise.is_estimated(&c.noise),
        });
        left.retain(|j| *j != i);
        if p_value >= settings.false_alarm {
            return out;
        }
    }
}

/// Transients that are certain; the candidates decide on their cause.
fn transients(scorer: &CandidateScorer<'_>) -> Vec<Value> {
    scorer.gathered.transients.certain(scorer.settings.false_alarm).map(|h| json!(h)).collect()
}

fn limits(scorer: &CandidateScorer<'_>, rest: &[Scored], named: &[Found]) -> Vec<Limit> {
    let mut out = Vec::new();
    for s in rest {
        let accepted =
            |f: &Found| f.accepted && (&f.effect, &f.instance) == (&s.candidate.effect, &s.candidate.instance);
        if s.candidate.transient || named.iter().any(accepted) {
            continue;
        }
        let Some(covariance) = s.information.clone().try_inverse() else { continue };
        for (j, (i, form)) in s.candidate.parts.iter().enumerate() {
            let sigma = covariance[(j, j)].max(0.0).sqrt();
            out.push(Limit {
                effect: s.candidate.effect.clone(),
                instance: s.candidate.instance.clone(),
                coefficient: scorer.candidate_set.coefficients[*i].name.clone(),
                limit_95: s.value[j].abs() + LIMIT_QUANTILE * sigma,
                sigma,
                unit: form.unit.clone(),
                shape: form.shape.clone(),
            });
        }
    }
    out
}

/// Power beyond the modelled noise, channel by channel in thirds of a decade, and housekeeping that is coherent with
/// the residuals. Either is evidence of an unknown cause; a slow force shows in the coherence long before it shows in
/// the power.
fn unexplained(scorer: &CandidateScorer<'_>, levels: &Levels<'_>) -> Option<Unexplained> {
    let settings = scorer.settings;
    let plan = scorer.plan();
    let channels = &scorer.candidate_set.channels;
    let mut loud: Vec<(usize, [f64; 2], f64)> = Vec::new();
    for (bands, n, ratios) in levels.excesses() {
        let hz = |b: usize| plan.frequency_hz(plan.bands[b]);
        let certain = chi2_per_dof_at(2.0 * n, settings.excess_sigmas);
        let above = |(_, ratio): &(usize, f64)| n > 0.0 && *ratio > certain.max(settings.excess_ratio);
        let found = ratios.into_iter().enumerate().filter(above);
        loud.extend(found.map(|(c, ratio)| (c, [hz(bands.start), hz(bands.end - 1)], ratio)));
    }
    let all = scorer.gathered.housekeeping.coherences(channels);
    let significant: Vec<Coherence> = all
        .into_iter()
        .filter(|w| corrected(ln_chi2_above(w.statistic, w.dof).exp(), w.trials) < settings.coherence_false_alarm)
        .collect();
    let power = !loud.is_empty();
    if !power {
        // A driver that explains a part x of the power raises it by 1/(1 − x).
        let of = |w: &Coherence| channels.iter().position(|c| *c == w.channel);
        let best = significant.iter().find(|w| w.explained > settings.coherence_min_explained)?;
        loud.push((of(best)?, best.band_hz, (1.0 - best.explained.clamp(0.0, 0.999)).recip()));
    }
    let (_, band_hz, ratio) = *loud.iter().max_by(|a, b| a.2.total_cmp(&b.2))?;
    let mut names: Vec<String> = loud.iter().map(|(c, _, _)| channels[*c].clone()).collect();
    names.sort();
    names.dedup();
    let kind = if scorer.gathered.transients.detections.iter().any(|h| h.significance > 10.0) {
        "transient"
    } else if band_hz[1] < settings.drift_hz {
        "drift"
    } else {
        "broadband"
    };
    // A housekeeping channel, its derivative and its square are one hint.
    let mut hints: Vec<&Coherence> = Vec::new();
    for w in significant.iter().filter(|w| names.contains(&w.channel)) {
        if hints.len() < 10 && hints.iter().all(|hint| hint.of != w.of) {
            hints.push(w);
        }
    }
    let coherent_with = hints.into_iter().map(|w| w.driver.clone()).collect();
    Some(Unexplained {
        channels: names,
        band_hz,
        kind: kind.to_owned(),
        ratio,
        power,
        coherent_with,
        coherences: significant.into_iter().take(20).collect(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Over all forms of all effects together the false-alarm rate is the stated one, and an effect with ten thousand
    /// forms has the same part of it as one with a single form.
    #[test]
    fn every_effect_has_the_same_part_of_the_false_alarms() {
        let forms = BTreeMap::from([("many".to_owned(), 10_000.0), ("one".to_owned(), 1.0)]);
        let trials = Trials { forms };
        for (effect, n) in [("many", 10_000.0), ("one", 1.0)] {
            // The χ² at which this effect alone has half the false-alarm rate.
            let mut chi2 = 0.0;
            while trials.p_value(effect, chi2, 1.0).0 > Settings::default().false_alarm {
                chi2 += 0.01;
            }
            let alone = 1.0 - (1.0 - ln_chi2_above(chi2, 1.0).exp()).powf(n);
            assert!((alone / (0.5 * Settings::default().false_alarm) - 1.0).abs() < 0.02, "{effect}: {alone}");
        }
        assert!(trials.p_value("one", 20.0, 1.0).1 < trials.p_value("many", 25.0, 1.0).1);
    }

    fn found(channels: &[&str], shift: f64, accepted: bool) -> Found {
        Found {
            effect: "e".to_owned(),
            instance: "i".to_owned(),
            coefficient: "e.i".to_owned(),
            value: 1.0,
            sigma: 0.1,
            unit: "1".to_owned(),
            shape: Map::new(),
            coefficients: Vec::new(),
            delta_chi2: 100.0,
            p_value: 1e-9,
            log10_p_value: -9.0,
            delta_bic: -90.0,
            in_range: true,
            held_out_delta_chi2: None,
            held_out_p_value: None,
            chi2_per_dof_before: 1.0,
            chi2_per_dof_after: 1.0,
            offset_shift_m: BTreeMap::new(),
            offset_shift_sigma: BTreeMap::from([("com-offset.tm1.y".to_owned(), shift)]),
            channels: channels.iter().map(|c| (*c).to_owned()).collect(),
            confounders: Vec::new(),
            accepted,
            refused: None,
            of_excess: false,
            drives_estimate: false,
        }
    }

    #[test]
    fn what_leaves_the_excess_or_follows_a_wrong_noise_is_doubtful() {
        let excess = |channel: &str, power| Unexplained {
            channels: vec![channel.to_owned()],
            band_hz: [1e-4, 2e-4],
            kind: "drift".to_owned(),
            ratio: 9.0,
            power,
            coherent_with: Vec::new(),
            coherences: Vec::new(),
        };
        let slow = found(&["tm1.accel.x"], 0.0, true);
        for (part, left, doubtful) in [
            (0.9, Some(excess("tm1.accel.x", true)), true),
            (0.1, Some(excess("tm1.accel.x", true)), false),
            (0.9, Some(excess("tm2.accel.z", true)), false),
            (0.9, Some(excess("tm1.accel.x", false)), false),
            (0.9, None, false),
        ] {
            assert_eq!(
                doubt(&Settings::default(), &slow, part, &[], left.as_ref()).is_some(),
                doubtful,
                "{part} {left:?}"
            );
        }
        let of_excess = Found { of_excess: true, ..found(&["tm1.accel.x"], 0.0, true) };
        assert!(doubt(&Settings::default(), &of_excess, 0.1, &[], Some(&excess("tm1.accel.x", true))).is_some());
        assert!(doubt(&Settings::default(), &of_excess, 0.1, &[], Some(&excess("tm1.accel.x", false))).is_some());
        assert!(doubt(&Settings::default(), &of_excess, 0.1, &[], Some(&excess("tm2.accel.z", true))).is_none());
        assert!(doubt(&Settings::default(), &of_excess, 0.1, &[], None).is_none());
        let (gain, still) = (found(&["tm1.accel.y"], 12.0, true), found(&["tm1.accel.y"], 1.0, true));
        let level = |drives_estimate, accepted, times: f64| {
            let delta_chi2 = times * gain.delta_chi2;
            [Found { delta_chi2, drives_estimate, ..found(&["sc.alpha.z"], 0.0, accepted) }]
        };
        let torque = level(true, true, 100.0);
        let doubtful = |f: &Found, extra: &[Found]| doubt(&Settings::default(), f, 0.0, extra, None).is_some();
        assert!(doubtful(&gain, &torque) && !doubtful(&still, &torque));
        // A cause with a tenth of the level's χ² is no trace of it.
        assert!(!doubtful(&gain, &level(true, true, 10.0)));
        assert!(!doubtful(&gain, &level(true, false, 100.0)));
        assert!(!doubtful(&gain, &level(false, true, 100.0)));
    }
}
