//! The verdict: is the model sufficient, what is missing, or is there something that nothing explains.

use dragfree_estimation::estimate::EstimateError;
use dragfree_estimation::levels::{Level, Levels};
use dragfree_estimation::spectra::FIRST_BIN;
use dragfree_estimation::verdict::chi2_per_dof_at;
use serde::Serialize;
use serde_json::{Map, Value, json};
use std::collections::BTreeMap;

use crate::candidates::Candidate;
use crate::coherence::Coherence;
use crate::distributions::{corrected, ln_chi2_above, normal_tails};
use crate::gram::LONG;
use crate::scores::{CandidateScorer, Fit, Scored, WithoutExcess};

/// Chance of naming an effect when none is hidden.
pub const FALSE_ALARM: f64 = 0.01;

/// What moves the offset is doubtful below this part of what a level of torque noise is worth.
const BESIDE_A_LEVEL: f64 = 0.02;

/// A mission file knows its noise to this: a level within it is none that is missing.
const LEVEL_TOLERANCE: f64 = 0.15;

/// A cause whose halves differ so that chance gives it more rarely is none: what is true at one time is true at another.
const HALVES_DIFFER: f64 = 1e-3;

/// Rounds of adding the best effect.
const MOST_ADDED: usize = 4;

/// Candidates that are weighed in full in each round.
const LISTED: usize = 12;

/// Candidates whose likelihood is tried where there is an excess.
const EXPLAINING: usize = 6;

/// Independent segments of full length below which nothing is said.
const LEAST_SEGMENTS: f64 = 4.0;

/// Standard normal quantile of a one-sided 95 % limit.
const LIMIT_QUANTILE: f64 = 1.645;

/// An excess is looked at when the power of a third of a decade is above the modelled by this.
const EXCESS: f64 = 1.25;

/// And so certainly: 3.4e-6 each, over nine channels and fourteen thirds of decades, plain and partial, 1e-3 together.
const EXCESS_SIGMA: f64 = 4.5;

/// Chance that any driver passes for a witness when none is: a part of [`FALSE_ALARM`], the most of which is left to effects.
const COHERENCE_ALARM: f64 = 1e-3;

/// Where there is no excess of power, a witness that explains no more than this part of a channel's power, in the band that says most, is
/// no sign of something unexplained. In a day a few per cent are certain, and a thruster's current goes with the residuals by as much
/// without driving them: it follows a command, which is made of the readouts that the residuals are made of.
const LEAST_EXPLAINED: f64 = 0.1;

/// Why a candidate has no number.
const UNOBSERVABLE: &str =
    "these data say nothing of it: what it is made of does not change in them, or the model has the same already";

/// What moves the offset by so many σ is no longer told from it.
const MOVES_OFFSET: f64 = 3.0;

/// Explanations whose χ² differ by less than this are not told apart: 1 % of χ² with one degree of freedom.
const AS_GOOD: f64 = 6.63;

/// Part of an excess that an explanation may leave.
const REMAINS: f64 = 1e-3;

/// What lies wholly below this is a drift: slower than an hour.
const DRIFT_HZ: f64 = 1.0 / 3600.0;

/// Why there is no diagnosis.
#[derive(Debug, thiserror::Error)]
pub enum DiagnosisError {
    /// Nothing can be fitted.
    #[error(transparent)]
    Estimate(#[from] EstimateError),
    /// Too little data.
    #[error(
        "a diagnosis needs at least {LEAST_SEGMENTS} segments of {segment_s:.0} s without a gap, and there are {segments:.1}: give more telemetry, \
         or several products"
    )]
    TooShort {
        /// Segments there are.
        segments: f64,
        /// Their length.
        segment_s: f64,
    },
}

/// An effect that explains something.
#[derive(Clone, Debug, Serialize)]
pub struct Found {
    /// Effect.
    pub effect: String,
    /// Instance.
    pub instance: String,
    /// Coefficient that stands out most.
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
    /// By how much χ² falls.
    pub delta_chi2: f64,
    /// Chance of as much when nothing is there, corrected for everything tried: every effect has the same part of the false alarms,
    /// whatever its forms.
    pub p_value: f64,
    /// Its decimal logarithm, where the chance itself is too small for a number; what the list is sorted by.
    pub log10_p_value: f64,
    /// Change of the Bayesian information criterion, negative in favour of the effect.
    pub delta_bic: f64,
    /// Whether the value lies inside its physical range.
    pub in_range: bool,
    /// By how much χ² of each half of the data falls with the value that the other gives; none where there is one half.
    pub held_out_delta_chi2: Option<[f64; 2]>,
    /// Chance that the halves' values differ as much if both are right; none where there is one half.
    pub held_out_p_value: Option<f64>,
    /// χ²/dof without it, under the noise that is left with it.
    pub chi2_per_dof_before: f64,
    /// χ²/dof with it.
    pub chi2_per_dof_after: f64,
    /// By how much the lack of it moves each coefficient of the model that is a length, m.
    pub offset_shift_m: BTreeMap<String, f64>,
    /// The same in σ of the coefficient.
    pub offset_shift_sigma: BTreeMap<String, f64>,
    /// Where it acts.
    pub channels: Vec<String>,
    /// What the data cannot tell from it.
    pub confounders: Vec<String>,
    /// Whether it is part of the answer, or only the next on the list.
    pub accepted: bool,
    /// Whether it was weighed by what it explains of an excess of power.
    #[serde(skip)]
    of_excess: bool,
}

/// What cannot be seen.
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
    /// σ that these data have for it.
    pub sigma: f64,
    /// Unit.
    pub unit: String,
    /// Form for which it holds.
    pub shape: Map<String, Value>,
}

/// What is left over.
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
    /// Whether there is more power than modelled; otherwise it is known by its coherence alone.
    pub power: bool,
    /// Housekeeping that is coherent with it, each in its best form: first what chance gives most rarely.
    pub coherent_with: Vec<String>,
    /// The same with numbers.
    #[serde(rename = "witnesses")]
    pub coherences: Vec<Coherence>,
}

/// The answer.
#[derive(Clone, Debug, Serialize)]
pub struct Diagnosis {
    /// `sufficient`, `missing` or `unexplained`.
    pub verdict: String,
    /// Chance of a false alarm.
    pub false_alarm_rate: f64,
    /// Forms and levels of effects that were tried; transient templates were tried at every time besides.
    pub tried: usize,
    /// What explains the data, the best first; those that are accepted stand before the rest.
    pub candidates: Vec<Found>,
    /// Limits of what is not seen.
    pub upper_limits: Vec<Limit>,
    /// What nobody explains.
    pub unexplained: Option<Unexplained>,
    /// What happened once.
    pub transients: Vec<Value>,
    /// What could not be tried, and why.
    pub not_tried: Vec<(String, String)>,
    /// Places that stand out beside the model alone, in their best forms: worth a finer look.
    #[serde(skip)]
    pub refinement_requests: Vec<RefinementRequest>,
    /// Forms that were tried, per effect, this time and before.
    #[serde(skip)]
    pub forms: BTreeMap<String, usize>,
}

/// An effect at a place, in a form.
#[derive(Clone, Debug, PartialEq)]
pub struct RefinementRequest {
    /// Effect.
    pub effect: String,
    /// Instance.
    pub instance: String,
    /// Values of the shape parameters.
    pub shape: Map<String, Value>,
}

/// How often chance had its say. Every effect has the same part of [`FALSE_ALARM`], and so has the search of transients; an
/// effect's part is shared by all forms in all places that were tried of it (Bonferroni, with weights that are fixed before the data are seen).
///
/// Were all forms alike, an effect of one form would pay for the ten thousand pairs of thermometers and lags of another.
struct Trials {
    /// Forms and levels per effect, and trials of the search.
    forms: BTreeMap<String, f64>,
}

/// The search of what happens transient, among the effects.
const TRANSIENT: &str = "transient search";

/// Whose part of the false alarms it is.
fn family(c: &Candidate) -> &str {
    if c.transient { TRANSIENT } else { &c.effect }
}

impl Trials {
    fn new(scorer: &CandidateScorer<'_>, forms: &BTreeMap<String, usize>) -> Self {
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

    /// The chance, and its decimal logarithm, that an effect is worth so much without being there.
    fn chance(&self, family: &str, chi2: f64, dof: f64) -> (f64, f64) {
        let trials = self.forms.len() as f64 * self.forms.get(family).copied().unwrap_or(1.0).max(1.0);
        let ln_p = ln_chi2_above(chi2, dof);
        let p = corrected(ln_p.exp(), trials);
        (p, if ln_p > -30.0 { p.log10() } else { (ln_p + trials.ln()) / std::f64::consts::LN_10 })
    }
}

/// Diagnoses the sums; `tried_before` are forms of effects, by which some of those that are tried now were chosen.
///
/// # Errors
/// [`DiagnosisError`]: too little data, or a model that cannot be fitted.
pub fn diagnose(
    scorer: &CandidateScorer<'_>,
    tried_before: &BTreeMap<String, usize>,
) -> Result<Diagnosis, DiagnosisError> {
    let segment_s = scorer.gathered.length as f64 / scorer.gathered.rate_hz;
    let segments = short_segments(scorer);
    if segments < LEAST_SEGMENTS {
        return Err(DiagnosisError::TooShort { segments, segment_s });
    }
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
    let mut requests = refinement_requests(&trials, &ranked);
    let mut others: Vec<Found> = loop {
        likeliest_first(&trials, &mut ranked);
        let mut weighed: Vec<(Found, Candidate)> = ranked
            .iter()
            .take(LISTED)
            .map(|scored| (weigh(scorer, &fit, scored, &ranked, &trials), scored.candidate.clone()))
            .collect();
        for (f, candidate) in &mut weighed {
            // On a coarse grid of shapes the peak of a wrong colour costs more than all that it explains.
            let finely = tried_before.contains_key(&candidate.effect);
            let stands_out = f.p_value < FALSE_ALARM && f.in_range && accepted.len() < MOST_ADDED;
            // The likelihood chooses among its shapes alone: what it is worth beside what colours nothing is told by scores.
            let chosen = if finely && stands_out { scorer.coloured(&fit, candidate)? } else { None };
            if let Some(form) = chosen {
                f.shape.clone_from(&form.parts[0].1.shape);
                *candidate = form;
            }
        }
        if accepted.len() < MOST_ADDED {
            for (f, candidate) in of_the_excess(scorer, &fit, &trials)? {
                let of = |w: &(Found, Candidate)| (&w.0.effect, &w.0.instance) == (&f.effect, &f.instance);
                match weighed.iter().position(of) {
                    Some(i) if weighed[i].0.log10_p_value <= f.log10_p_value => {}
                    Some(i) => weighed[i] = (f, candidate),
                    None => weighed.push((f, candidate)),
                }
            }
            weighed.sort_by(|a, b| a.0.log10_p_value.total_cmp(&b.0.log10_p_value));
        }
        let helps = |f: &Found| f.held_out_p_value.is_none_or(|p| p > HALVES_DIFFER);
        let good = |(f, _): &(Found, Candidate)| f.p_value < FALSE_ALARM && f.in_range && helps(f);
        let Some(best) = weighed.iter().position(good).filter(|_| accepted.len() < MOST_ADDED) else {
            break weighed.into_iter().map(|(f, _)| f).collect();
        };
        let mut added = fit.added.clone();
        added.push(weighed[best].1.clone());
        fit = scorer.fit(&added)?;
        let before = std::mem::replace(&mut ranked, scorer.rank(&fit).all);
        let mut f = Found { accepted: true, ..weighed[best].0.clone() };
        if !f.of_excess {
            f.confounders.extend(as_good(&f, &before, &ranked));
            f.confounders.sort();
            f.confounders.dedup();
        }
        accepted.push(f);
        // What is found is measured again with Σ as it is without the excess.
        refresh(scorer, &fit, &mut accepted);
    };

    let (mut extra, unexplained) = loop {
        let measured = scorer.residual_psd(&fit);
        let mut levels = scorer.levels(&fit, &scorer.total, &measured);
        let extra = noise_levels(scorer, &fit, &mut levels, &trials);
        let unexplained = unexplained(scorer, &levels);
        let ((excess, _), plain) = (levels.excess_bands(), levels.plain_inverses());
        let mut both = accepted.iter().zip(&fit.added);
        let part = |candidate: &Candidate| scorer.part_in(&fit, &plain, candidate, &excess);
        // What is left of an excess a thousand times as large is what the forms that were tried are beside the true one.
        let loud = unexplained.as_ref().filter(|u| !u.power || u.ratio > REMAINS * loudest);
        let Some(doubtful) = both.position(|(f, c)| is_doubtful(f, part(c), &extra, loud)) else {
            break (extra, unexplained);
        };
        others.insert(0, Found { accepted: false, ..accepted.remove(doubtful) });
        let mut added = fit.added.clone();
        added.remove(doubtful);
        fit = scorer.fit(&added)?;
        ranked = scorer.rank(&fit).all;
        refresh(scorer, &fit, &mut accepted);
    };
    // Noise is weighed apart: levels stand behind the effects that are accepted and before the rest.
    extra.sort_by(|a, b| b.accepted.cmp(&a.accepted).then(a.log10_p_value.total_cmp(&b.log10_p_value)));
    let louder: Vec<Found> = extra.iter().filter(|f| f.accepted).cloned().collect();
    let mut candidates: Vec<Found> = accepted.into_iter().chain(louder).collect();
    candidates.sort_by(|a, b| a.log10_p_value.total_cmp(&b.log10_p_value));
    let missing = !candidates.is_empty();
    candidates.extend(others);
    candidates.extend(extra.into_iter().filter(|f| !f.accepted));

    let verdict = match (missing, &unexplained) {
        (true, _) => "missing",
        (false, Some(_)) => "unexplained",
        (false, None) => "sufficient",
    };
    // A shape is told best beside what else was found, or else came next.
    for request in &mut requests {
        let found = candidates.iter().find(|f| (&f.effect, &f.instance) == (&request.effect, &request.instance));
        request.shape = found.map_or_else(|| request.shape.clone(), |f| f.shape.clone());
    }
    let upper_limits = limits(scorer, &ranked, &candidates);
    Ok(Diagnosis {
        verdict: verdict.to_owned(),
        false_alarm_rate: FALSE_ALARM,
        tried: trials.total(),
        candidates,
        upper_limits,
        unexplained,
        transients: transients(scorer),
        refinement_requests: requests,
        forms,
        not_tried: first.unobservable.into_iter().map(|name| (name, UNOBSERVABLE.to_owned())).collect(),
    })
}

/// Independent short segments that would know as much of the lowest octave of short segments. One band is too narrow to tell: a bin
/// of a short segment serves many bands of the long ones, and counts in one of them.
fn short_segments(scorer: &CandidateScorer<'_>) -> f64 {
    let plan = scorer.plan();
    let octave = LONG * FIRST_BIN..2 * LONG * FIRST_BIN;
    let bands =
        plan.bands.iter().zip(scorer.total.weights.observations(plan)).filter(|(b, _)| octave.contains(&b.first));
    let (bins, observations) = bands.fold((0, 0.0), |(bins, sum), (b, n)| (bins + b.bins(), sum + n));
    observations * LONG as f64 / bins.max(1) as f64
}

/// Where Σ had to take up an excess, the candidates that may explain it, weighed by the likelihood with a Σ of their own.
///
/// Under the Σ that has taken it up, nothing that acts in a few bins can be worth more than those bins, however exactly it explains
/// them; under the Σ that has not, whatever follows the excess by chance is worth thousands. The ratio of the likelihoods, each at the
/// Σ that its own residuals have, is neither: n observations whose power falls to a part x are worth n log 1/x, by Bartlett's correction
/// n − (p + 2)/2 of them for p coefficients.
fn of_the_excess(
    scorer: &CandidateScorer<'_>,
    fit: &Fit,
    trials: &Trials,
) -> Result<Vec<(Found, Candidate)>, DiagnosisError> {
    let Some(WithoutExcess { plain, bands, observations }) = scorer.without_excess(fit) else { return Ok(Vec::new()) };
    let before = scorer.deviance(fit, &bands, &fit.added)?;
    let mut ranked = scorer.rank(&plain).all;
    likeliest_first(trials, &mut ranked);
    let mut out = Vec::new();
    for scored in ranked.iter().filter(|s| s.in_range).take(EXPLAINING) {
        let mut added = fit.added.clone();
        added.push(scored.candidate.clone());
        let dof = scored.candidate.parts.len() as f64;
        let kept = (1.0 - 0.5 * (dof + 2.0) / observations).max(0.0);
        // n log 1/x is at most n (1/x − 1), the fall of χ² under the Σ without the excess; beyond that, something else has changed.
        let ratio = (before - scorer.deviance(fit, &bands, &added)?).clamp(0.0, scored.delta_chi2.max(0.0));
        let delta_chi2 = ratio * kept;
        let (p_value, log10_p_value) = trials.chance(family(&scored.candidate), delta_chi2, dof);
        let f = weigh(scorer, &plain, scored, &ranked, trials);
        let delta_bic = dof * fit.estimate.quality.dof.ln() - delta_chi2;
        let chi2_per_dof_after = f.chi2_per_dof_before - delta_chi2 / fit.estimate.quality.dof;
        let f = Found { delta_chi2, p_value, log10_p_value, delta_bic, chi2_per_dof_after, of_excess: true, ..f };
        out.push((f, scored.candidate.clone()));
    }
    Ok(out)
}

/// Whether what was accepted does not stand beside the rest of the answer.
///
/// - What was weighed by what it explains of an excess, or would be known by what it does where there is one, `part` of its
///   information, while an excess, or something that housekeeping is coherent with, remains in the channels where it acts: it follows
///   what is there, as much else does that is slow, and does not explain it. A magnetometer sees the current whose square heats a test mass's housing.
/// - What moves the offset and is little beside a level of noise that turns the spacecraft, worth less than [`BESIDE_A_LEVEL`] of it: what
///   α̂ does not know of such a torque is known to first order, and a resonance of 2 % followed torques three times as loud (41 of χ² to
///   27,000). It is to be asked again when the model has the level.
fn is_doubtful(f: &Found, part: f64, extra: &[Found], unexplained: Option<&Unexplained>) -> bool {
    // Housekeeping that is coherent with what is left says as much of what was chosen for an excess.
    let remains = |u: &Unexplained| (u.power || f.of_excess) && f.channels.iter().any(|c| u.channels.contains(c));
    let turned = |e: &Found| {
        e.accepted
            && e.channels.iter().any(|c| c.starts_with("sc.alpha."))
            && f.delta_chi2 < BESIDE_A_LEVEL * e.delta_chi2
    };
    let moves = f.offset_shift_sigma.values().any(|sigmas| sigmas.abs() > MOVES_OFFSET);
    (f.of_excess || part > 0.5) && unexplained.is_some_and(remains) || moves && extra.iter().any(turned)
}

/// Sorted by the chance of what each is worth, the smallest first.
fn likeliest_first(trials: &Trials, ranked: &mut [Scored]) {
    let chance = |s: &Scored| trials.chance(family(&s.candidate), s.delta_chi2, s.candidate.parts.len() as f64).1;
    ranked.sort_by(|a, b| chance(a).total_cmp(&chance(b)));
}

/// Places that stand out by themselves.
fn refinement_requests(trials: &Trials, ranked: &[Scored]) -> Vec<RefinementRequest> {
    let chance = |s: &Scored| trials.chance(family(&s.candidate), s.delta_chi2, s.candidate.parts.len() as f64).0;
    let request = |s: &Scored| RefinementRequest {
        effect: s.candidate.effect.clone(),
        instance: s.candidate.instance.clone(),
        shape: s.candidate.parts[0].1.shape.clone(),
    };
    ranked.iter().filter(|s| !s.candidate.transient && chance(s) < FALSE_ALARM).map(request).collect()
}

/// What explained as much as a candidate before that was there, and nothing beside it: as good an explanation, whatever its shape.
fn as_good(chosen: &Found, before: &[Scored], beside: &[Scored]) -> Vec<String> {
    let worth = |all: &[Scored], name: &str| {
        all.iter().find(|s| !s.candidate.transient && s.candidate.name() == name).map_or(0.0, |s| s.delta_chi2)
    };
    let names = before.iter().filter(|s| s.in_range && !s.candidate.transient).map(|s| s.candidate.name());
    let own = format!("{}:{}", chosen.effect, chosen.instance);
    names
        .filter(|name| *name != own)
        .filter(|name| worth(before, name) > chosen.delta_chi2 - AS_GOOD && worth(beside, name) < AS_GOOD)
        .collect()
}

/// A candidate as it stands beside a fit.
fn weigh(scorer: &CandidateScorer<'_>, fit: &Fit, scored: &Scored, ranked: &[Scored], trials: &Trials) -> Found {
    let parts = &scored.candidate.parts;
    let covariance = scored.information.clone().try_inverse();
    let sigma = |j: usize| covariance.as_ref().map_or(f64::INFINITY, |c| c[(j, j)].max(0.0).sqrt());
    let values: Vec<(f64, f64)> = (0..parts.len()).map(|j| (scored.value[j], sigma(j))).collect();
    let name = |j: usize| scorer.candidate_set.coefficients[parts[j].0].name.clone();
    let lead = leading(&values);
    let dof = parts.len() as f64;
    let halves = scorer.held_out(fit, &scored.candidate);
    let quality = &fit.estimate.quality;
    let (p_value, log10_p_value) = trials.chance(family(&scored.candidate), scored.delta_chi2, dof);
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
        of_excess: false,
    }
}

/// The coefficient that stands out most.
fn leading(values: &[(f64, f64)]) -> usize {
    let size = |i: &usize| (values[*i].0 / values[*i].1).abs();
    (0..values.len()).max_by(|a, b| size(a).total_cmp(&size(b))).unwrap_or(0)
}

/// The accepted effects as the fit of all of them has them.
fn refresh(scorer: &CandidateScorer<'_>, fit: &Fit, found: &mut [Found]) {
    let mut at = scorer.candidate_set.model();
    let sigma = |i: usize| {
        let k = fit.estimate.free.iter().position(|f| *f == i)?;
        fit.estimate.covariance.as_ref().map(|c| c[(k, k)].sqrt())
    };
    for (f, added) in found.iter_mut().zip(&fit.added) {
        let own = at..at + added.parts.len();
        at = own.end;
        // Of what is over soon the fit does not know how much a window has left.
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

/// Levels of noise one after the other, the best first; those that matter are accepted and taken over.
fn noise_levels(scorer: &CandidateScorer<'_>, fit: &Fit, levels: &mut Levels<'_>, trials: &Trials) -> Vec<Found> {
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
        let (p_value, log10_p_value) = trials.chance(&c.effect, level.delta_chi2, 1.0);
        // A transient makes one half of the data louder, noise both: as much within chance, or each by half of it at least.
        let (differ, steady) = match halves.each_ref().map(|half| half.level(&c.noise)) {
            [Some(a), Some(b)] => {
                let difference = (a.value - b.value).abs() / a.sigma.hypot(b.sigma);
                let chance = Some(normal_tails(difference)).filter(|_| difference.is_finite());
                let shows = |half: &Level| (half.value - 1.0) / (level.value - 1.0) > 0.5;
                (chance, chance.is_none_or(|p| p > HALVES_DIFFER) || shows(&a) && shows(&b))
            }
            _ => (None, true),
        };
        let matters = p_value < FALSE_ALARM && steady && (level.value.ln()).abs() > LEVEL_TOLERANCE.ln_1p();
        if p_value < FALSE_ALARM {
            levels.take(&level);
        }
        out.push(Found {
            effect: c.effect.clone(),
            instance: c.instance.clone(),
            coefficient: c.name.clone(),
            value: level.value,
            sigma: level.sigma,
            unit: "1".to_owned(),
            shape: Map::new(),
            coefficients: vec![json!({ "name": c.name, "value": level.value, "sigma": level.sigma, "unit": "1" })],
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
            of_excess: false,
        });
        left.retain(|j| *j != i);
        if p_value >= FALSE_ALARM {
            return out;
        }
    }
}

/// Times at which something happened that no chance gives; what it was is for the candidates to say.
fn transients(scorer: &CandidateScorer<'_>) -> Vec<Value> {
    scorer.gathered.transients.certain(FALSE_ALARM).map(|h| json!(h)).collect()
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

/// Power beyond the modelled noise, channel by channel in thirds of a decade, and what of the telemetry is coherent with what is
/// left over: either is a sign of something that no effect explains, and a slow force shows by the second long before the first.
fn unexplained(scorer: &CandidateScorer<'_>, levels: &Levels<'_>) -> Option<Unexplained> {
    let plan = scorer.plan();
    let channels = &scorer.candidate_set.channels;
    let mut loud: Vec<(usize, [f64; 2], f64)> = Vec::new();
    for (bands, n, ratios) in levels.excesses() {
        let hz = |b: usize| plan.frequency_hz(plan.bands[b]);
        let certain = chi2_per_dof_at(2.0 * n, EXCESS_SIGMA);
        let above = |(_, ratio): &(usize, f64)| n > 0.0 && *ratio > certain.max(EXCESS);
        let found = ratios.into_iter().enumerate().filter(above);
        loud.extend(found.map(|(c, ratio)| (c, [hz(bands.start), hz(bands.end - 1)], ratio)));
    }
    let all = scorer.gathered.housekeeping.coherences(channels);
    let significant: Vec<Coherence> = all
        .into_iter()
        .filter(|w| corrected(ln_chi2_above(w.statistic, w.dof).exp(), w.trials) < COHERENCE_ALARM)
        .collect();
    let power = !loud.is_empty();
    if !power {
        // What explains a part of the power leaves the rest: so much more there is than without it.
        let of = |w: &Coherence| channels.iter().position(|c| *c == w.channel);
        let best = significant.iter().find(|w| w.explained > LEAST_EXPLAINED)?;
        loud.push((of(best)?, best.band_hz, (1.0 - best.explained.clamp(0.0, 0.999)).recip()));
    }
    let (_, band_hz, ratio) = *loud.iter().max_by(|a, b| a.2.total_cmp(&b.2))?;
    let mut names: Vec<String> = loud.iter().map(|(c, _, _)| channels[*c].clone()).collect();
    names.sort();
    names.dedup();
    let kind = if scorer.gathered.transients.detections.iter().any(|h| h.significance > 10.0) {
        "transient"
    } else if band_hz[1] < DRIFT_HZ {
        "drift"
    } else {
        "broadband"
    };
    // The same housekeeping, its derivative and its square are one hint.
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

    /// Chances of normal deviates: over all forms of all effects together a false alarm is as likely as is said, and the one effect
    /// with ten thousand forms takes no more of it than the one with a single form.
    #[test]
    fn every_effect_has_the_same_part_of_the_false_alarms() {
        let forms = BTreeMap::from([("many".to_owned(), 10_000.0), ("one".to_owned(), 1.0)]);
        let trials = Trials { forms };
        for (effect, n) in [("many", 10_000.0), ("one", 1.0)] {
            // The χ² at which this effect alone is falsely named with a chance of half a per cent.
            let mut chi2 = 0.0;
            while trials.chance(effect, chi2, 1.0).0 > FALSE_ALARM {
                chi2 += 0.01;
            }
            let alone = 1.0 - (1.0 - ln_chi2_above(chi2, 1.0).exp()).powf(n);
            assert!((alone / (0.5 * FALSE_ALARM) - 1.0).abs() < 0.02, "{effect}: {alone}");
        }
        assert!(trials.chance("one", 20.0, 1.0).1 < trials.chance("many", 25.0, 1.0).1);
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
            of_excess: false,
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
            assert_eq!(is_doubtful(&slow, part, &[], left.as_ref()), doubtful, "{part} {left:?}");
        }
        let of_excess = Found { of_excess: true, ..found(&["tm1.accel.x"], 0.0, true) };
        assert!(is_doubtful(&of_excess, 0.1, &[], Some(&excess("tm1.accel.x", true))));
        assert!(is_doubtful(&of_excess, 0.1, &[], Some(&excess("tm1.accel.x", false))));
        assert!(!is_doubtful(&of_excess, 0.1, &[], Some(&excess("tm2.accel.z", true))));
        assert!(!is_doubtful(&of_excess, 0.1, &[], None));
        let (gain, still) = (found(&["tm1.accel.y"], 12.0, true), found(&["tm1.accel.y"], 1.0, true));
        let level = |channel: &str, accepted, times: f64| {
            [Found { delta_chi2: times * gain.delta_chi2, ..found(&[channel], 0.0, accepted) }]
        };
        let torque = level("sc.alpha.z", true, 100.0);
        assert!(is_doubtful(&gain, 0.0, &torque, None) && !is_doubtful(&still, 0.0, &torque, None));
        // A cause that is worth a tenth of the level is no trace of it.
        assert!(!is_doubtful(&gain, 0.0, &level("sc.alpha.z", true, 10.0), None));
        assert!(!is_doubtful(&gain, 0.0, &level("sc.alpha.z", false, 100.0), None));
        assert!(!is_doubtful(&gain, 0.0, &level("tm1.accel.y", true, 100.0), None));
    }
}
