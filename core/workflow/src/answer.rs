//! What a decision means to its reader: effects with values, limits, levels of noise, each with what it cannot be told
//! from.

use std::collections::{BTreeMap, BTreeSet};

use dragfree_archive::Written;
use dragfree_engine::config::EffectEntry;
use dragfree_identification::candidates;
use dragfree_identification::diagnosis::{
    Constancy, Diagnosis, Drift, Found, LIMIT_QUANTILE, Limit, OfProduct, Offset, OtherLevel, Separation, Trials,
};
use dragfree_identification::innovations::decision::{Candidate, Fitted, Quadratic};
use dragfree_identification::record::Record;
use dragfree_schema::Settings;
use serde::{Deserialize, Serialize};
use serde_json::json;

use crate::likelihood::{Decided, Judge, LEVEL_PRIOR, Meaning, Place};
use crate::proposals::Proposal;
use crate::words::after_a_number;

/// Corrected p-values of the effects of some products.
pub(crate) struct Evidence<'a> {
    pub(crate) trials: Trials,
    /// Probability from which another explanation is named beside the chosen one.
    pub(crate) least: f64,
    pub(crate) products: &'a [Written],
    /// Formulas among the candidates.
    pub(crate) proposals: Vec<Proposal>,
}

impl Evidence<'_> {
    /// A model's entry that makes a candidate in its form.
    pub(crate) fn entry(&self, candidate: &candidates::Candidate) -> EffectEntry {
        if let Some(proposal) = self.proposal(&candidate.effect, &candidate.instance) {
            return proposal.entry.clone();
        }
        let mut entry = EffectEntry::new(&candidate.effect, &candidate.instance);
        let shape = candidate.parts.iter().flat_map(|(_, form)| &form.shape);
        entry.parameters = shape.filter_map(|(k, v)| Some((k.clone(), toml::Value::try_from(v).ok()?))).collect();
        entry
    }

    /// The formula of a candidate that is one.
    pub(crate) fn proposal(&self, effect: &str, instance: &str) -> Option<&Proposal> {
        self.proposals.iter().find(|p| (p.entry.id.as_str(), p.entry.instance.as_str()) == (effect, instance))
    }

    /// What a candidate is called: a formula by its words.
    fn name_of(&self, place: &Place) -> String {
        self.proposal(&place.effect, &place.instance).map_or_else(|| place.name(), |p| p.words.clone())
    }
}

impl Judge for Evidence<'_> {
    fn log10_p(&self, family: &str, gain: f64, dof: usize) -> f64 {
        self.trials.p_value(family, gain, dof as f64).1
    }

    fn ln_prior(&self, effect: &str, instance: &str, family: &str) -> f64 {
        let of_proposal = self.proposal(effect, instance).map_or(0.0, |p| p.ln_weight);
        of_proposal - self.trials.of(family).ln()
    }
}

/// Values and σ of a candidate's coefficients; index of the largest over its σ.
fn leading(fitted: &Fitted) -> (Vec<(f64, f64)>, usize) {
    let sigma = |k: usize| fitted.covariance[(k, k)].max(0.0).sqrt();
    let values: Vec<(f64, f64)> = fitted.values.iter().enumerate().map(|(k, value)| (*value, sigma(k))).collect();
    let size = |k: &usize| (values[*k].0 / values[*k].1).abs();
    let lead = (0..values.len()).max_by(|a, b| size(a).total_cmp(&size(b))).unwrap_or(0);
    (values, lead)
}

fn coefficient(decided: &Decided, parameter: usize) -> (&str, &str) {
    match &decided.parameters[parameter] {
        (name, Meaning::Coefficient(c)) => (name, &c.unit),
        (name, _) => (name, "1"),
    }
}

/// An effect with its evidence; `accepted` where it is part of the answer.
pub(crate) fn found(
    settings: &Settings,
    decided: &Decided,
    fitted: &Fitted,
    evidence: &Evidence<'_>,
    accepted: bool,
) -> Found {
    let place = &decided.candidates[fitted.candidate];
    let (effect, instance, own) = (&place.effect, &place.instance, &place.parameters);
    let (values, lead) = leading(fitted);
    let dof = own.len() as f64;
    let (p_value, log10_p_value) = evidence.trials.p_value(place.family(), fitted.gain, dof);
    let (mut offset_shift_m, mut offset_shift_sigma) = (BTreeMap::new(), BTreeMap::new());
    let named: Vec<usize> = decided.selection.chosen.iter().map(|f| f.candidate).collect();
    let without: Vec<usize> = named.iter().copied().filter(|c| *c != fitted.candidate).collect();
    let with: Vec<usize> = without.iter().copied().chain([fitted.candidate]).collect();
    let by_product = if accepted { by_product(decided, &with, own[lead], evidence.products) } else { Vec::new() };
    let [(with, _), (without, sigma)] = [with, without].map(|set| decided.quadratic.solution(&set));
    for (i, (name, meaning)) in decided.parameters.iter().enumerate() {
        if matches!(meaning, Meaning::Coefficient(c) if !c.candidate && c.unit == "m") {
            offset_shift_m.insert(name.clone(), without[i] - with[i]);
            offset_shift_sigma.insert(name.clone(), (without[i] - with[i]) / sigma[i]);
        }
    }
    let channels: BTreeSet<&String> =
        own.iter().filter_map(|i| decided.channels.get(&decided.parameters[*i].0)).flatten().collect();
    let rivals: Vec<usize> = fitted.alternatives.iter().filter(|(_, p)| *p > evidence.least).map(|(c, _)| *c).collect();
    let name_of = |c: &usize| evidence.name_of(&decided.candidates[*c]);
    let set = &named;
    let separation = |c: &usize| Separation::new(name_of(c), decided.quadratic.separation(fitted.candidate, *c, set));
    let separations: Vec<Separation> = rivals.iter().map(separation).collect();
    let before = decided.chi2 / decided.numbers;
    let (name, unit) = coefficient(decided, own[lead]);
    Found {
        effect: effect.clone(),
        instance: instance.clone(),
        coefficient: name.to_owned(),
        value: values[lead].0,
        sigma: values[lead].1,
        unit: unit.to_owned(),
        shape: match evidence.proposal(effect, instance) {
            Some(p) => p.entry.parameters.iter().map(|(k, value)| (k.clone(), json!(value))).collect(),
            None => place.shape.clone().into_iter().collect(),
        },
        shape_sigma: decided.shape_sigma(place),
        coefficients: own
            .iter()
            .zip(&values)
            .map(|(i, (value, sigma))| {
                let (name, unit) = coefficient(decided, *i);
                json!({ "name": name, "value": value, "sigma": sigma, "unit": unit })
            })
            .collect(),
        delta_chi2: fitted.gain,
        p_value,
        log10_p_value,
        delta_bic: dof * decided.numbers.ln() - fitted.gain,
        in_range: own.iter().zip(&fitted.values).all(|(i, value)| match &decided.parameters[*i].1 {
            Meaning::Coefficient(c) => c.lower < *value && *value < c.upper,
            Meaning::Level | Meaning::Power | Meaning::Number(_) => true,
        }),
        chi2_per_dof_before: if accepted { before + fitted.gain / decided.numbers } else { before },
        chi2_per_dof_after: if accepted { before } else { before - fitted.gain / decided.numbers },
        offset_shift_m,
        offset_shift_sigma,
        channels: channels.into_iter().cloned().collect(),
        confounders: rivals.iter().map(name_of).collect(),
        separations,
        accepted,
        refused: (!accepted && p_value < evidence.least).then(|| {
            if fitted.beyond > settings.range_sigmas.powi(2) {
                "its best value lies outside its physical range".to_owned()
            } else {
                "it may be what the form of a named effect leaves, or as many effects as the settings allow are named"
                    .to_owned()
            }
        }),
        constancy: Constancy::of(&by_product),
        by_product,
    }
}

/// Name of a candidate, and the most significant of its values without ranges, with σ and unit.
pub(crate) fn a_value(fitted: &Fitted, decided: &Decided, evidence: &Evidence<'_>) -> (String, String) {
    let place = &decided.candidates[fitted.candidate];
    let (values, lead) = leading(&Fitted { values: fitted.free.clone(), ..fitted.clone() });
    let (_, unit) = coefficient(decided, place.parameters[lead]);
    let (value, sigma) = values[lead];
    (evidence.name_of(place), format!("{value:.2e} ± {sigma:.1e}{}", after_a_number(unit)))
}

/// Gives a named effect the form and the values that it has where the numbers in its form are fitted.
pub(crate) fn fit_form(named: &mut Found, fitted: &Decided, evidence: &Evidence<'_>, settings: &Settings) {
    let is_it = |f: &&Fitted| {
        let place = &fitted.candidates[f.candidate];
        (&place.effect, &place.instance) == (&named.effect, &named.instance)
    };
    if let Some(f) = fitted.selection.chosen.iter().find(is_it) {
        let own = found(settings, fitted, f, evidence, true);
        named.coefficient = own.coefficient;
        (named.value, named.sigma, named.unit) = (own.value, own.sigma, own.unit);
        (named.shape, named.shape_sigma) = (own.shape, own.shape_sigma);
        (named.coefficients, named.in_range) = (own.coefficients, own.in_range);
        (named.offset_shift_m, named.offset_shift_sigma) = (own.offset_shift_m, own.offset_shift_sigma);
    }
}

/// What each product alone says of a parameter, with a set of candidates.
fn by_product(decided: &Decided, set: &[usize], parameter: usize, products: &[Written]) -> Vec<OfProduct> {
    let of = |(quadratic, written): (&Quadratic, &Written)| {
        let (values, sigma) = quadratic.solution(set);
        OfProduct { product: written.product.id().to_owned(), value: values[parameter], sigma: sigma[parameter] }
    };
    decided.data_of_products().iter().zip(products).map(of).collect()
}

/// Limits of a candidate's coefficients; none of a formula, which the data themselves have written.
pub(crate) fn limits(decided: &Decided, fitted: &Fitted, evidence: &Evidence<'_>) -> Vec<Limit> {
    let place = &decided.candidates[fitted.candidate];
    if evidence.proposal(&place.effect, &place.instance).is_some() {
        return Vec::new();
    }
    let limit = |(k, i): (usize, &usize)| {
        let sigma = fitted.covariance[(k, k)].max(0.0).sqrt();
        let (name, unit) = coefficient(decided, *i);
        Limit {
            effect: place.effect.clone(),
            instance: place.instance.clone(),
            coefficient: name.to_owned(),
            limit_95: fitted.free[k].abs() + LIMIT_QUANTILE * sigma,
            sigma,
            unit: unit.to_owned(),
            shape: place.shape.clone().into_iter().collect(),
        }
    };
    place.parameters.iter().enumerate().map(limit).collect()
}

/// The level of a component of the noise that an effect could state, as some data have it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct NoiseLevel {
    pub(crate) effect: String,
    pub(crate) instance: String,
    pub(crate) coefficient: String,
    /// Amplitude in the model, over the declared one.
    pub(crate) stated: f64,
    /// Natural logarithm of the amplitude over that of the model.
    pub(crate) ln: f64,
    /// σ of it.
    pub(crate) sigma: f64,
    /// Channels that it enters.
    pub(crate) channels: Vec<String>,
    /// What explains as much with the level as the model states it; none where the level is not certain.
    #[serde(default)]
    pub(crate) rivals: Option<Vec<Rival>>,
}

impl NoiseLevel {
    /// Fall of χ² with the level free.
    pub(crate) fn gain(&self) -> f64 {
        (self.ln / self.sigma).powi(2)
    }
}

/// An effect that explains as much as a level of noise in its place.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Rival {
    /// `EFFECT:INSTANCE`.
    pub(crate) name: String,
    /// Logarithm of its probability over that of the level.
    pub(crate) ln_odds: f64,
    /// By how much χ² is expected to be higher with it in the place of the level, in these data.
    pub(crate) chi2: f64,
}

/// Levels of noise that effects could state, as the likelihood has them.
pub(crate) fn noise_levels(
    decided: &Decided,
    record: &Record,
    evidence: &Evidence<'_>,
    settings: &Settings,
) -> Vec<NoiseLevel> {
    let all = record.candidate_set.coefficients.iter().filter(|c| !c.noise.is_empty());
    all.filter_map(|c| {
        let i = decided.parameters.iter().position(|(name, m)| *name == c.noise && matches!(m, Meaning::Level))?;
        let level = NoiseLevel {
            effect: c.effect.clone(),
            instance: c.instance.clone(),
            coefficient: c.name.clone(),
            // A level that the model states is in the noise already; what is measured is relative to it.
            stated: if c.candidate { 1.0 } else { c.initial },
            ln: decided.selection.values[i],
            sigma: decided.selection.sigma[i],
            channels: channels_of(record, &c.noise),
            rivals: None,
        };
        let certain = evidence.trials.p_value(&level.effect, level.gain(), 1.0).0 < settings.false_alarm;
        let rivals = certain.then(|| rivals(decided, &level, i, evidence));
        Some(NoiseLevel { rivals, ..level })
    })
    .collect()
}

/// The rivals of a level on several days: those that it has on all of them; evidence adds.
pub(crate) fn rivals_of_all(days: &[&[Rival]]) -> Vec<Rival> {
    let [first, others @ ..] = days else { return Vec::new() };
    let of = |rival: &Rival| {
        let mut all = rival.clone();
        for day in others {
            let Rival { ln_odds, chi2, .. } = day.iter().find(|r| r.name == rival.name)?;
            (all.ln_odds, all.chi2) = (all.ln_odds + ln_odds, all.chi2 + chi2);
        }
        Some(all)
    };
    first.iter().filter_map(of).collect()
}

/// What explains as much as a level in its place. The likelihood fits every level beside every candidate, so that a
/// candidate which acts on the power of the noise, such as a gain in the loop, has lost its evidence to the level when
/// both are asked for: it is compared with the level held as the model states it.
fn rivals(decided: &Decided, level: &NoiseLevel, parameter: usize, evidence: &Evidence<'_>) -> Vec<Rival> {
    let ln_prior = evidence.ln_prior(&level.effect, &level.instance, &level.effect);
    let own = decided.candidates.len();
    let prior_sigma = vec![LEVEL_PRIOR];
    let quadratic = decided.quadratic.with_candidate(Candidate { ln_prior, prior_sigma, ..Candidate::free(parameter) });
    let set: Vec<usize> = decided.selection.chosen.iter().map(|f| f.candidate).chain([own]).collect();
    let others: Vec<usize> = decided.selection.rest.iter().map(|f| f.candidate).collect();
    let fitted = quadratic.with_alternatives(own, &set, &others);
    let rival = |(c, probability): &(usize, f64)| Rival {
        name: evidence.name_of(&decided.candidates[*c]),
        ln_odds: (probability / fitted.probability).ln(),
        chi2: quadratic.separation(own, *c, &set),
    };
    fitted.alternatives.iter().map(rival).collect()
}

/// Levels as what may be missing. `chi2` is that of the whitened innovations, of so many numbers.
fn louder(levels: &[NoiseLevel], chi2: f64, numbers: f64, evidence: &Evidence<'_>) -> Vec<Found> {
    let found = |level: &NoiseLevel| {
        let value = level.ln.exp() * level.stated;
        let gain = level.gain();
        let (p_value, log10_p_value) = evidence.trials.p_value(&level.effect, gain, 1.0);
        let sigma = level.sigma * value;
        let before = chi2 / numbers;
        let name = level.coefficient.clone();
        let rivals = || level.rivals.iter().flatten();
        let odds = 1.0 + rivals().map(|r| r.ln_odds.exp()).sum::<f64>();
        let rivals = || rivals().filter(|r| r.ln_odds.exp() > evidence.least * odds);
        Found {
            effect: level.effect.clone(),
            instance: level.instance.clone(),
            coefficients: vec![json!({ "name": name, "value": value, "sigma": sigma, "unit": "1" })],
            coefficient: name,
            value,
            sigma,
            unit: "1".to_owned(),
            shape: serde_json::Map::new(),
            shape_sigma: BTreeMap::new(),
            delta_chi2: gain,
            p_value,
            log10_p_value,
            delta_bic: numbers.ln() - gain,
            in_range: true,
            chi2_per_dof_before: before + gain / numbers,
            chi2_per_dof_after: before,
            offset_shift_m: BTreeMap::new(),
            offset_shift_sigma: BTreeMap::new(),
            channels: level.channels.clone(),
            confounders: rivals().map(|r| r.name.clone()).collect(),
            separations: rivals().map(|r| Separation::new(r.name.clone(), r.chi2)).collect(),
            accepted: false,
            refused: None,
            by_product: Vec::new(),
            constancy: None,
        }
    };
    levels.iter().map(found).collect()
}

/// Puts levels of noise beyond the tolerance of a mission file among what is named, and sorts by significance; returns
/// the levels that are certain and within it.
pub(crate) fn with_levels(
    named: &mut Vec<Found>,
    levels: &[NoiseLevel],
    decided: &Decided,
    evidence: &Evidence<'_>,
    settings: &Settings,
) -> Vec<OtherLevel> {
    let mut within = Vec::new();
    for (level, f) in levels.iter().zip(louder(levels, decided.chi2, decided.numbers, evidence)) {
        // Over the level that the model states, which a mission file may have wrong by as much.
        let is_beyond = level.ln.abs() > settings.level_tolerance.ln_1p();
        match (f.p_value < settings.false_alarm, is_beyond) {
            (true, true) => named.push(Found { accepted: true, ..f }),
            (true, false) => within.push(f.level()),
            (false, _) => {}
        }
    }
    named.sort_by(|a, b| a.log10_p_value.total_cmp(&b.log10_p_value));
    within
}

/// Channels that a component of noise enters.
fn channels_of(record: &Record, component: &str) -> Vec<String> {
    let all = record.noise.iter().filter(|p| p.components.iter().any(|name| name == component));
    all.flat_map(|p| {
        let k = p.components.iter().position(|name| name == component).unwrap_or(0);
        p.enters.iter().filter(move |(_, gains)| gains[k] != 0.0).map(|(channel, _)| channel.clone())
    })
    .collect()
}

/// What is missing, by what is named and whether something is left.
pub(crate) fn verdict(named: &[Found], left: bool) -> &'static str {
    match (named.is_empty(), left) {
        (false, _) => "missing",
        (true, true) => "unexplained",
        (true, false) => "sufficient",
    }
}

/// Offsets of the model beside the candidates `named`, with σ if nothing undetected acts, and if every lasting effect
/// that is installed may.
pub(crate) fn offsets(decided: &Decided, evidence: &Evidence<'_>, named: &[usize]) -> Vec<Offset> {
    let lasts = |c: &usize| {
        let place = &decided.candidates[*c];
        let proposed = evidence.proposal(&place.effect, &place.instance).is_some();
        !named.contains(c) && !proposed && place.family() == place.effect
    };
    let others: Vec<usize> = (0..decided.candidates.len()).filter(lasts).collect();
    let (values, sigma_of_noise) = decided.quadratic.solution(named);
    // About the value that is given: what the others would move it by in these data counts too.
    let with = |others: &[usize]| {
        let (moved, sigma) = decided.quadratic.solution_with(named, others);
        (moved - &values).zip_map(&sigma, f64::hypot)
    };
    let sigma = with(&others);
    let alone: Vec<_> = others.iter().map(|c| (c, with(&[*c]))).collect();
    let offset = |(i, (name, meaning)): (usize, &(String, Meaning))| {
        let is_offset = matches!(meaning, Meaning::Coefficient(c) if !c.candidate && c.unit == "m");
        let most = || alone.iter().max_by(|a, b| a.1[i].total_cmp(&b.1[i]));
        is_offset.then(|| Offset {
            most_from: most().map(|(c, _)| decided.candidates[**c].name()),
            coefficient: name.clone(),
            value_m: values[i],
            sigma_m: sigma_of_noise[i],
            sigma_with_undetected_m: sigma[i],
        })
    };
    decided.parameters.iter().enumerate().filter_map(offset).collect()
}

/// Why a drift leaves a model insufficient: none for a level of noise within the tolerance of a mission file.
pub(crate) fn drifting(drift: &Drift, settings: &Settings, decided: &Decided) -> Option<String> {
    let Drift { coefficient, unit, at_start, at_end, delta_chi2, p_value, confounders, .. } = drift;
    let is_level = decided.parameters.iter().any(|(name, m)| name == coefficient && matches!(m, Meaning::Level));
    if is_level && (at_end / at_start).ln().abs() < settings.level_tolerance.ln_1p() {
        return None;
    }
    let unit = after_a_number(unit);
    let what = if is_level { format!("the level of {coefficient}") } else { coefficient.clone() };
    let others = match &confounders[..] {
        [] => String::new(),
        all => format!("; as well it may be {} that changes", all.join(" or ")),
    };
    Some(format!(
        "{what} is not the same through the data: from {at_start:.3e} at their start to {at_end:.3e}{unit} \
         at their end lowers χ² by {delta_chi2:.0} more than one value does (p = {p_value:.1e}){others}; a model has \
         one value for a run: run shorter parts"
    ))
}

/// Why several products do not agree, if they do not.
pub(crate) fn apart(agreement: Option<&Constancy>, settings: &Settings) -> Option<String> {
    let Constancy { chi2, dof, p_value } = agreement.filter(|a| a.p_value < settings.false_alarm)?;
    Some(format!(
        "the products do not agree beside what is named (χ² {chi2:.0} of {dof}, p = {p_value:.1e}): something is not the same \
         in all of them; diagnose them one by one"
    ))
}

/// A model whose two solutions disagree is not sufficient, whatever the candidates say.
pub(crate) fn contradict(diagnosis: &mut Diagnosis, products: &[Written]) {
    let disagree = products.iter().filter(|p| p.product.result.verdict.as_deref() == Some("disagree"));
    let names: Vec<String> = disagree.map(|p| p.product.id().to_string()).collect();
    if diagnosis.verdict == "sufficient" && !names.is_empty() {
        diagnosis.verdict = "unexplained".to_owned();
        diagnosis.reasons.push(format!("the recursive and the batch solution of {} disagree", names.join(", ")));
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use crate::likelihood::joined;

    /// One form of one effect.
    pub(crate) fn one_trial() -> Trials {
        serde_json::from_value(json!({ "forms": { "effect": 1.0 } })).expect("trials")
    }

    /// A level is told where it is certain, and named where it is farther from what the model states than a mission
    /// file may be wrong: 1.53 is not beside a stated 1.5, and 1 is beside a stated 1.2.
    #[test]
    fn a_level_is_named_by_its_distance_from_what_the_model_states() {
        let level = |name: &str, stated: f64, value: f64, sigma| NoiseLevel {
            effect: name.to_owned(),
            instance: "sc".to_owned(),
            coefficient: name.to_owned(),
            stated,
            ln: (value / stated).ln(),
            sigma,
            channels: Vec::new(),
            rivals: None,
        };
        let all = [
            level("stated", 1.5, 1.53, 0.003),
            level("wrong", 1.2, 1.0, 0.003),
            level("louder", 1.0, 1.2, 0.003),
            level("uncertain", 1.0, 1.3, 0.3),
        ];
        let settings = Settings::default();
        let evidence =
            Evidence { trials: one_trial(), least: settings.false_alarm, products: &[], proposals: Vec::new() };
        let decided = joined(Vec::new(), &settings, &evidence, Vec::new());
        let mut named = Vec::new();
        let within = with_levels(&mut named, &all, &decided, &evidence, &settings);
        let mut names: Vec<&str> = named.iter().map(|f| f.effect.as_str()).collect();
        names.sort_unstable();
        assert_eq!((names, within.len(), within[0].effect.as_str()), (vec!["louder", "wrong"], 1, "stated"));
    }

    /// What explains a level on several days is what does on each of them; evidence adds.
    #[test]
    fn rivals_of_several_days_are_those_of_each() {
        let rival = |name: &str, ln_odds: f64| Rival { name: name.to_owned(), ln_odds, chi2: 1.0 };
        let days = [vec![rival("a", -1.0), rival("b", -2.0)], vec![rival("b", 0.5)]];
        let all = rivals_of_all(&days.each_ref().map(Vec::as_slice));
        assert_eq!(all, [Rival { chi2: 2.0, ..rival("b", -1.5) }]);
        assert!(rivals_of_all(&[&days[0], &[]]).is_empty());
    }
}
