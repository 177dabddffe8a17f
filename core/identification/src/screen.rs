//! The screen: the form in which each candidate is tried.
//!
//! A candidate with a shape (a lag, a resonance, a time) has up to thousands of forms. The spectra choose one of them
//! beside the effects that are named so far; whether the candidate is named, the likelihood of the innovations decides.

use std::collections::BTreeMap;

use dragfree_estimation::spectra::{FIRST_BIN, LONG};
use serde_json::{Map, Value};

use crate::candidates::{Candidate, Coefficient};
use crate::diagnosis::{Trials, family};
use crate::scores::{CandidateScorer, Fit, IdentificationError, Scored, WithoutExcess};

/// Every candidate in the form that the spectra choose.
#[derive(Clone, Debug)]
pub struct Screened {
    /// One form of each instance of each effect, the most significant first.
    pub forms: Vec<Candidate>,
    /// Forms that were tried, per effect.
    pub tried: BTreeMap<String, usize>,
    /// Instances without information in these data.
    pub unobservable: Vec<String>,
    /// Candidates that stand out, to be tried again on a finer grid of shapes.
    pub requests: Vec<RefinementRequest>,
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

/// Chooses the form of each candidate beside `named` effects; that of a named one beside the others. A candidate that
/// is not significant beside them, and could replace one of them, has the form that it would have in its place: beside
/// the effect that has taken what it explains nothing is left to choose a form by, and the likelihood compares the two.
///
/// # Errors
/// [`IdentificationError`]: too little data, or a model that cannot be fitted.
pub fn screen(scorer: &CandidateScorer<'_>, named: &[Candidate]) -> Result<Screened, IdentificationError> {
    scorer.require("diagnosis", 1.0, segments(scorer))?;
    let fit = scorer.fit(named)?;
    let ranked = scorer.rank(&fit);
    let trials = Trials::new(scorer, &ranked.tried);
    let stands_out = |s: &&Scored| !s.candidate.transient && trials.p_value_of(s).0 < scorer.settings.false_alarm;
    let request = |s: &Scored| RefinementRequest {
        effect: s.candidate.effect.clone(),
        instance: s.candidate.instance.clone(),
        shape: s.candidate.parts[0].1.shape.clone(),
    };
    let requests = ranked.all.iter().filter(stands_out).map(request).collect();
    let place = |c: &Candidate| (c.transient, c.name());
    let certain = ranked.all.iter().filter(|s| trials.p_value_of(s).0 < scorer.settings.false_alarm);
    let significant: Vec<(bool, String)> = certain.map(|s| place(&s.candidate)).collect();
    let mut rivals: Vec<Scored> = Vec::new();
    let mut forms = refined(scorer, &fit, ranked.all, &trials)?;
    for (i, candidate) in named.iter().enumerate() {
        let mut others = named.to_vec();
        others.remove(i);
        let without = scorer.fit(&others)?;
        let own = |c: &Coefficient| (&c.effect, &c.instance) == (&candidate.effect, &candidate.instance);
        let own = scorer.rank_where(&without, own).all;
        rivals.extend(rivals_of(scorer, &without, candidate, &own)?);
        let form = refined(scorer, &without, own, &trials)?.into_iter().next();
        forms.insert(i, form.unwrap_or_else(|| candidate.clone()));
    }
    rivals.sort_by(|a, b| a.delta_chi2.total_cmp(&b.delta_chi2));
    // The best one comes last and stays.
    for rival in rivals {
        let own = place(&rival.candidate);
        if significant.contains(&own) {
            continue;
        }
        if let Some(form) = forms.iter_mut().filter(|f| !named.contains(f)).find(|f| place(f) == own) {
            *form = rival.candidate;
        }
    }
    Ok(Screened { forms, tried: ranked.tried, unobservable: ranked.unobservable, requests })
}

/// The candidates with a shape that could replace `named`, in the forms that they would have in its place, from the fit
/// `without` it and its `own` scores there. Such a rival explains the greater part of what `named` explains, and leaves
/// it the smaller part. Of transients, which last for minutes, all are.
fn rivals_of(
    scorer: &CandidateScorer<'_>,
    without: &Fit,
    named: &Candidate,
    own: &[Scored],
) -> Result<Vec<Scored>, IdentificationError> {
    let is_own = |c: &Coefficient| (&c.effect, &c.instance) == (&named.effect, &named.instance);
    let shaped = |c: &Coefficient| c.transient == named.transient && (c.transient || c.forms.len() > 1) && !is_own(c);
    let mut rivals = scorer.rank_where(without, shaped).all;
    if named.transient {
        return Ok(rivals);
    }
    let explained = |own: &[Scored]| own.iter().find(|s| !s.candidate.transient).map_or(0.0, |s| s.delta_chi2);
    let greater_part = 0.5 * explained(own);
    rivals.retain(|r| r.delta_chi2 > greater_part);
    let mut left = Vec::new();
    for rival in rivals {
        let beside = scorer.fit(&[&without.added[..], std::slice::from_ref(&rival.candidate)].concat())?;
        if explained(&scorer.rank_where(&beside, is_own).all) < greater_part {
            left.push(rival);
        }
    }
    Ok(left)
}

/// Leaves out of the requests of a screen beside nothing what its most significant candidate explains: of a cause that
/// is no resonance, resonances stand out too, and no finer form of theirs is asked for.
///
/// # Errors
/// A model that cannot be fitted.
pub fn retain_unexplained(
    scorer: &CandidateScorer<'_>,
    screened: &Screened,
    requests: &mut Vec<RefinementRequest>,
) -> Result<(), IdentificationError> {
    let Some(best) = screened.forms.first().filter(|_| !requests.is_empty()) else { return Ok(()) };
    let of = |request: &RefinementRequest, c: (&String, &String)| (&request.effect, &request.instance) == c;
    let fit = scorer.fit(std::slice::from_ref(best))?;
    let trials = Trials::new(scorer, &screened.tried);
    let asked = |c: &Coefficient| !c.transient && requests.iter().any(|r| of(r, (&c.effect, &c.instance)));
    let mut left = scorer.rank_where(&fit, asked).all;
    left.retain(|s| trials.p_value_of(s).0 < scorer.settings.false_alarm);
    requests.retain(|request| {
        let is = |c: &Candidate| !c.transient && of(request, (&c.effect, &c.instance));
        is(best) || left.iter().any(|s| is(&s.candidate))
    });
    Ok(())
}

/// Effective number of independent short segments, from the observations in their lowest octave. A single band is too
/// narrow: a bin of a short segment spans many bands of the long ones, and counts in one of them.
fn segments(scorer: &CandidateScorer<'_>) -> f64 {
    let plan = scorer.plan();
    let octave = LONG * FIRST_BIN..2 * LONG * FIRST_BIN;
    let bands =
        plan.bands.iter().zip(scorer.total.weights.observations(plan)).filter(|(b, _)| octave.contains(&b.first));
    let (bins, observations) = bands.fold((0, 0.0), |(bins, sum), (b, n)| (bins + b.bins(), sum + n));
    observations * LONG as f64 / bins.max(1) as f64
}

/// The ranked candidates, one form per instance, with the two cases in which the score chooses badly: where Σ has
/// absorbed an excess of power, the form that explains more of it is taken, and a candidate that filters a noise has
/// the form of the highest likelihood.
fn refined(
    scorer: &CandidateScorer<'_>,
    fit: &Fit,
    mut ranked: Vec<Scored>,
    trials: &Trials,
) -> Result<Vec<Candidate>, IdentificationError> {
    let by_p_value = |all: &mut Vec<Scored>| {
        all.sort_by(|a, b| trials.p_value_of(a).1.total_cmp(&trials.p_value_of(b).1));
        // Of an instance that may act once and may last, the more significant of the two.
        let mut seen = Vec::new();
        all.retain(|s| {
            let new = !seen.contains(&s.candidate.name());
            seen.push(s.candidate.name());
            new
        });
    };
    by_p_value(&mut ranked);
    let mut forms: Vec<Candidate> = ranked.into_iter().map(|s| s.candidate).collect();
    if let Some(WithoutExcess { plain, bands, .. }) = scorer.without_excess(fit) {
        let of_ranked = |c: &Coefficient| forms.iter().any(|f| (&f.effect, &f.instance) == (&c.effect, &c.instance));
        let mut of_excess = scorer.rank_where(&plain, of_ranked).all;
        by_p_value(&mut of_excess);
        for scored in of_excess.into_iter().take(scorer.settings.max_excess_candidates) {
            let Some(at) = forms.iter().position(|f| f.name() == scored.candidate.name()) else { continue };
            if forms[at] == scored.candidate {
                continue;
            }
            let deviance = |form: &Candidate| {
                let added = [&fit.added[..], std::slice::from_ref(form)].concat();
                scorer.deviance(fit, &bands, &added)
            };
            if deviance(&scored.candidate)? < deviance(&forms[at])? {
                forms[at] = scored.candidate;
            }
        }
    }
    // What is slow shows most below the lowest band of the spectra.
    let of_forms = |place: &Vec<usize>| {
        let first = &scorer.candidate_set.coefficients[place[0]];
        forms.iter().any(|f| (&f.effect, &f.instance) == (&first.effect, &first.instance))
    };
    let places: Vec<Vec<usize>> = scorer.candidate_set.places().into_iter().filter(of_forms).collect();
    let fast = scorer.gathered.columns.fast;
    for slow in scorer.gathered.slow.forms_of(&places, scorer.candidate_set, fast, &fit.added, scorer.noise) {
        if let Some(form) = forms.iter_mut().find(|f| !f.transient && f.name() == slow.name()) {
            *form = slow;
        }
    }
    for form in &mut forms {
        if let Some(likelier) = scorer.coloured(fit, form)? {
            *form = likelier;
        }
    }
    Ok(forms)
}

impl Trials {
    /// Corrected p-value of a score, and its decimal logarithm.
    fn p_value_of(&self, s: &Scored) -> (f64, f64) {
        self.p_value(family(&s.candidate), s.delta_chi2, s.candidate.parts.len() as f64)
    }
}
