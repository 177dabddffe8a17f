//! The answer of a diagnosis: the model is sufficient, named effects are missing, or something remains that no
//! candidate explains.

use dragfree_estimation::levels::Levels;
use dragfree_estimation::verdict::chi2_per_dof_at;
use dragfree_schema::Settings;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};
use std::collections::BTreeMap;

use crate::candidates::Candidate;
use crate::coherence::Coherence;
use crate::distributions::{corrected, ln_chi2_above};
use crate::scores::{CandidateScorer, IdentificationError};
use crate::transient::{Detection, Transients, is_one_transient};

/// Standard normal quantile of a one-sided 95 % limit.
pub const LIMIT_QUANTILE: f64 = 1.645;

/// Why a candidate has no result.
pub const UNOBSERVABLE: &str =
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
    /// σ of those of them that were fitted, in their units.
    pub shape_sigma: BTreeMap<String, f64>,
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
    /// What it takes to tell it from each confounder that is an effect.
    pub separations: Vec<Separation>,
    /// Whether it is part of the answer.
    pub accepted: bool,
    /// Why it is no part of the answer although its p-value is below the false-alarm rate.
    pub refused: Option<String>,
    /// What each product alone says of `coefficient`, where there are several and the effect is part of the answer.
    pub by_product: Vec<OfProduct>,
    /// Whether these agree.
    pub constancy: Option<Constancy>,
}

/// What it takes to tell an effect from another, if the effect acts with the size that was found.
#[derive(Clone, Debug, Serialize)]
pub struct Separation {
    /// The other, `EFFECT:INSTANCE`.
    pub from: String,
    /// By how much χ² is expected to be higher with the other in its place, in these data.
    pub chi2: f64,
    /// Length of data like these, over that of these, at which this is 25: five σ.
    pub times_the_data: f64,
}

impl Separation {
    /// From what these data tell; `from` is the other.
    pub fn new(from: String, chi2: f64) -> Self {
        Self { from, chi2, times_the_data: SEPARATED_CHI2 / chi2.max(f64::MIN_POSITIVE) }
    }
}

/// χ² at which two effects count as told apart: five σ.
pub const SEPARATED_CHI2: f64 = 25.0;

/// What one product says of a coefficient.
#[derive(Clone, Debug, Serialize)]
pub struct OfProduct {
    /// Product.
    pub product: String,
    /// Value of the coefficient.
    pub value: f64,
    /// σ of it.
    pub sigma: f64,
}

/// Whether coefficients are the same in all products: the weighted sum of squares about the weighted mean.
#[derive(Clone, Debug, Serialize)]
pub struct Constancy {
    /// Sum of squares.
    pub chi2: f64,
    /// Degrees of freedom.
    pub dof: usize,
    /// Probability of no less by chance.
    pub p_value: f64,
}

impl Constancy {
    /// Of independent values; `None` where fewer than two have any information.
    pub fn of(values: &[OfProduct]) -> Option<Self> {
        let known: Vec<(f64, f64)> =
            values.iter().filter(|v| v.sigma > 0.0).map(|v| (v.value, v.sigma.powi(-2))).collect();
        if known.len() < 2 {
            return None;
        }
        let mean = known.iter().map(|(x, w)| x * w).sum::<f64>() / known.iter().map(|(_, w)| w).sum::<f64>();
        let chi2 = known.iter().map(|(x, w)| w * (x - mean).powi(2)).sum::<f64>();
        Some(Self::new(chi2, known.len() - 1))
    }

    /// Of a sum of squares.
    pub fn new(chi2: f64, dof: usize) -> Self {
        Self { chi2, dof, p_value: ln_chi2_above(chi2, dof as f64).exp() }
    }
}

impl Found {
    /// As a level that is told and is no cause.
    pub fn level(&self) -> OtherLevel {
        let (effect, instance) = (self.effect.clone(), self.instance.clone());
        OtherLevel { effect, instance, value: self.value, sigma: self.sigma }
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
    /// `broadband`, `transient`, `drift`, or `driven` where a function of housekeeping explains it.
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

/// A coefficient, or a level of noise, that changes through the data.
#[derive(Clone, Debug, Serialize)]
pub struct Drift {
    /// Coefficient, or component of the noise.
    pub coefficient: String,
    /// Unit of it; 1 for a level, as a factor.
    pub unit: String,
    /// Value in the middle of the first ten minutes, if it changes at a constant rate.
    pub at_start: f64,
    /// The same of the last ten minutes.
    pub at_end: f64,
    /// Change per day; of a level that of its logarithm.
    pub per_day: f64,
    /// σ of it.
    pub sigma_per_day: f64,
    /// By how much χ² falls with the rate, the value fitted with it and without it.
    pub delta_chi2: f64,
    /// p-value, corrected for all coefficients and levels that were tried.
    pub p_value: f64,
    /// Others whose change explains as much.
    pub confounders: Vec<String>,
}

/// An offset of the model beside what is named.
#[derive(Clone, Debug, Serialize)]
pub struct Offset {
    /// Coefficient.
    pub coefficient: String,
    /// Value, m.
    pub value_m: f64,
    /// σ if nothing acts but the model and what is named, m.
    pub sigma_m: f64,
    /// σ if every lasting effect that is installed may act with what is known of it before any data, as far as these
    /// data allow, m.
    pub sigma_with_undetected_m: f64,
    /// The effect that by itself raises σ most; none where no other is installed.
    pub most_from: Option<String>,
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
    /// False-alarm rate.
    pub false_alarm_rate: f64,
    /// Forms and levels of effects that were tried; besides, transients were tried at every time, lines at every
    /// frequency, and a drift of every coefficient.
    pub tried: usize,
    /// Candidates, the accepted ones first, then the best of the rest.
    pub candidates: Vec<Found>,
    /// Limits of what is not detected.
    pub upper_limits: Vec<Limit>,
    /// Evidence that no candidate explains.
    pub unexplained: Option<Unexplained>,
    /// Formulas that would explain it, as a model states them.
    pub formulas: Vec<Found>,
    /// Coefficients and levels that are not the same through the data.
    pub drifts: Vec<Drift>,
    /// Offsets of the model.
    pub offsets: Vec<Offset>,
    /// Whether several products agree beside what is named, in all coefficients at once; none of one product.
    pub agreement: Option<Constancy>,
    /// Why the model is not called sufficient although neither a candidate was accepted nor an excess was found.
    pub reasons: Vec<String>,
    /// Levels of noise other than declared, certain, and within the tolerance of a mission file.
    pub levels: Vec<OtherLevel>,
    /// Transients that were detected.
    pub transients: Vec<Value>,
    /// What could not be tried, and why.
    pub not_tried: Vec<(String, String)>,
}

/// Numbers of trials for the correction of p-values. Every effect, and the search for transients, has the same part of
/// [`dragfree_schema::Settings::false_alarm`]; an effect's part is shared by all its forms (weighted Bonferroni; the
/// weights are fixed before the data are seen).
///
/// With equal weights of all forms, an effect of one form would pay for the ten thousand pairs of thermometers and lags
/// of another.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Trials {
    /// Trials per family: forms and levels of an effect, and those of the transient search.
    forms: BTreeMap<String, f64>,
}

/// The family of all transients.
pub const TRANSIENT: &str = "transient search";

/// The family of all lines.
pub const LINE: &str = "line search";

/// The family of all coefficients and levels that may change at a constant rate.
pub const DRIFT: &str = "drift";

/// Families that search without forms.
const SEARCHES: [&str; 3] = [TRANSIENT, LINE, DRIFT];

/// Family whose part of the false-alarm rate a candidate uses.
pub(crate) fn family(c: &Candidate) -> &str {
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
        let lines = scorer.gathered.lines.tried;
        if lines > 0.0 {
            forms.insert(LINE.to_owned(), lines);
        }
        // A coefficient that states a level stands for the component of the noise.
        let lasting = scorer.candidate_set.coefficients.iter().filter(|c| !c.transient);
        forms.insert(DRIFT.to_owned(), lasting.count() as f64);
        Self { forms }
    }

    /// Adds those of other data: what acts once or at one frequency was searched for there as well.
    pub fn add(&mut self, other: &Self) {
        for (family, trials) in &other.forms {
            let own = self.forms.entry(family.clone()).or_default();
            *own = if [TRANSIENT, LINE].contains(&family.as_str()) { *own + trials } else { own.max(*trials) };
        }
    }

    /// Forms and levels of all effects.
    pub fn total(&self) -> usize {
        self.forms.iter().filter(|(family, _)| !SEARCHES.contains(&family.as_str())).map(|(_, n)| n).sum::<f64>()
            as usize
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
    let mut levels = scorer.levels(&fit, &measured);
    levels.fit();
    let before = if added.is_empty() { measured.clone() } else { scorer.residual_psd(&scorer.fit(&[])?) };
    let plan = scorer.plan();
    // Housekeeping was compared with the residuals of the model: what was added since may have explained it.
    let explained = |w: &Coherence| {
        let Some(c) = scorer.candidate_set.channels.iter().position(|name| *name == w.channel) else { return false };
        let bands = plan.bands.iter().zip(before.iter().zip(&measured));
        is_explained(w, bands.map(|(band, (before, after))| (plan.frequency_hz(*band), before[(c, c)], after[(c, c)])))
    };
    let has_transient = leaves_a_transient(&scorer.gathered.transients, added, scorer.settings);
    Ok(unexplained(scorer, &levels, &explained, has_transient))
}

/// Whether half of the coherent power of housekeeping is gone from a channel, by its power in bands before and after
/// something was added to the model: frequency, before, after. Bands without an observation, as short data have them
/// at the lowest frequencies, say nothing.
fn is_explained(w: &Coherence, bands: impl Iterator<Item = (f64, f64, f64)>) -> bool {
    let inside = bands.filter(|(hz, before, _)| (w.band_hz[0]..=w.band_hz[1]).contains(hz) && *before > 0.0);
    let left: Vec<f64> = inside.map(|(_, before, after)| after / before).collect();
    left.iter().sum::<f64>() < (1.0 - 0.5 * w.explained) * left.len() as f64
}

/// Whether a transient is certain that none of what was added is.
fn leaves_a_transient(transients: &Transients, added: &[Candidate], settings: &Settings) -> bool {
    let times: Vec<i64> = added.iter().filter_map(Candidate::at_ns).collect();
    let is_new = |d: &Detection| times.iter().all(|t| !is_one_transient(*t, d.at_ns, settings.same_transient_s));
    transients.certain(settings.false_alarm).any(is_new)
}

/// Power beyond the modelled noise, channel by channel in thirds of a decade, and housekeeping that is coherent with
/// the residuals. Either is evidence of an unknown cause; a slow force shows in the coherence long before it shows in
/// the power. What is `explained` since is no coherence any more. `has_transient` says that one is certain and in no
/// model.
fn unexplained(
    scorer: &CandidateScorer<'_>,
    levels: &Levels<'_>,
    explained: &dyn Fn(&Coherence) -> bool,
    has_transient: bool,
) -> Option<Unexplained> {
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
    let significant: Vec<Coherence> =
        all.into_iter().filter(|w| !explained(w)).filter(|w| w.p_value() < settings.coherence_false_alarm).collect();
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
    let kind = if has_transient {
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
    use crate::candidates::Form;
    use serde_json::json;

    /// Two values differ by a normal variable of their common σ: χ² is its square, p that of two sides.
    #[test]
    fn two_values_agree_as_their_difference_says() {
        let value = |value, sigma| OfProduct { product: String::new(), value, sigma };
        let c = Constancy::of(&[value(1.0, 0.3), value(2.0, 0.4)]).expect("two values");
        assert!((c.chi2 - 4.0).abs() < 1e-12 && c.dof == 1, "{c:?}");
        assert!((c.p_value - 0.045_500_263_896_358).abs() < 1e-12, "{c:?}");
        assert!(Constancy::of(&[value(1.0, 0.3), value(0.0, 0.0)]).is_none(), "one has no information");
    }

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

    /// A coherence of which nearly all is gone is explained, also where every second band has no observation; one of
    /// which nothing is gone is not, nor one in whose band there is no observation.
    #[test]
    fn bands_without_observations_do_not_hide_what_explains_a_coherence() {
        let coherence = Coherence {
            driver: "hk/t".to_owned(),
            of: vec!["hk/t".to_owned()],
            channel: "a".to_owned(),
            statistic: 50.0,
            dof: 10.0,
            trials: 1.0,
            explained: 0.6,
            band_hz: [1e-4, 1e-3],
        };
        let bands =
            |after: f64| (1..10).map(move |k| (1e-4 * f64::from(k), f64::from(k % 2), f64::from(k % 2) * after));
        assert!(is_explained(&coherence, bands(0.4)) && !is_explained(&coherence, bands(1.0)));
        assert!(!is_explained(&coherence, [(5e-4, 0.0, 0.0)].into_iter()));
    }

    /// A certain transient is left unless it is one of what was added; one that may be chance is none.
    #[test]
    fn a_transient_that_is_named_is_not_left() {
        let detection = |significance| Detection {
            effect: "impulse".to_owned(),
            instance: "sc.x".to_owned(),
            coefficient: "impulse.sc.x".to_owned(),
            unit: "N s".to_owned(),
            shape: Map::new(),
            at_ns: 5_000_000_000_000,
            significance,
        };
        let added = |at_ns: i64| {
            let shape = Map::from_iter([("at_ns".to_owned(), json!(at_ns))]);
            let (unit, terms) = ("N s".to_owned(), Vec::new());
            let form = Form { shape, unit, lower: None, upper: None, terms, colours: None };
            let (effect, instance) = ("impulse".to_owned(), "tm1.x".to_owned());
            [Candidate { effect, instance, transient: true, parts: vec![(0, form)] }]
        };
        let (settings, hour_ns) = (Settings::default(), 3_600_000_000_000);
        let left = |significance, added: &[Candidate]| {
            let all = Transients { detections: vec![detection(significance)], tried: 1e4 };
            leaves_a_transient(&all, added, &settings)
        };
        assert!(left(20.0, &[]) && !left(4.0, &[]));
        assert!(!left(20.0, &added(5_000_000_000_000)) && left(20.0, &added(5_000_000_000_000 + 2 * hour_ns)));
    }
}
