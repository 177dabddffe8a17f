//! Which effect is missing from the model of some products.
//!
//! The data are read for transients, for the spectra of all candidates, which choose the form of each, a third time if
//! a shape can be refined, and then until the likelihood of the innovations, which decides, has settled.

use std::collections::{BTreeMap, BTreeSet};

use dragfree_engine::config::EffectEntry;
use dragfree_engine::examine::{FREQUENCY_HZ, has_parameter};
use dragfree_engine::product::Written;
use dragfree_engine::run::Progress;
use dragfree_estimation::decimate::SLOW_HZ;
use dragfree_identification::candidates::Candidate;
use dragfree_identification::diagnosis::{
    self, Constancy, Diagnosis, Found, LIMIT_QUANTILE, LINE, Limit, OfProduct, Separation, TRANSIENT, Trials,
    UNOBSERVABLE, Unexplained,
};
use dragfree_identification::innovations::decision::{Fitted, Quadratic};
use dragfree_identification::lines::Line;
use dragfree_identification::record::Record;
use dragfree_identification::scores::CandidateScorer;
use dragfree_identification::screen::{RefinementRequest, Screened, screen};
use dragfree_identification::slow_forces::slow_forces;
use dragfree_identification::transient::Detection;
use dragfree_schema::Settings;
use serde_json::{Map, json};

use crate::WorkflowError;
use crate::likelihood::{Decided, Judge, Meaning, PASSES, Point, moved, one_pass, step};
use crate::proposals::{FORMULA, Proposal, proposals};
use crate::replay::{AT_NS, FINE, Pass, Replay, What, sum};

/// A diagnosis and the sums that chose the forms of the candidates.
pub struct Diagnosed {
    /// Sums.
    pub record: Record,
    /// What is missing.
    pub diagnosis: Diagnosis,
    /// Thresholds.
    pub settings: Settings,
}

/// Diagnoses the data of products of one model. `progress` is told the pass and the number of the product.
///
/// # Errors
/// [`WorkflowError`]: an input has changed, the products do not belong together, there is too little data, or a stage
/// declares noise that cannot be filtered.
pub fn diagnose(
    replay: &Replay<'_>,
    progress: &mut dyn FnMut(Pass, usize, Progress),
) -> Result<Diagnosed, WorkflowError> {
    let settings = replay.settings()?;
    let searched = sum(replay, settings, What::Transients, progress)?.gathered;
    let (found, lines) = (searched.transients, searched.lines);
    let of_lines: Vec<EffectEntry> = lines.found.iter().map(entry_of).collect();
    let detected: Vec<Detection> =
        found.certain(settings.transient_p_value).take(settings.max_transients).cloned().collect();
    let mut gather = |requests: &[RefinementRequest], proposals: &[Proposal]| {
        let proposed = proposals.iter().map(|p| p.entry.clone());
        let entries: Vec<EffectEntry> = of_lines.iter().cloned().chain(proposed).collect();
        let mut record = sum(replay, settings, What::Candidates(&detected, requests, &entries), progress)?;
        record.gathered.transients = found.clone();
        record.gathered.lines = lines.clone();
        let noise = record.noise_model()?;
        let screened = {
            let scorer = CandidateScorer::new(&record.candidate_set, &record.gathered, &noise, settings);
            screen(&scorer, &[])?
        };
        Ok::<_, WorkflowError>((record, noise, screened))
    };
    let (mut record, mut noise, mut screened) = gather(&[], &[])?;
    let mut tried = screened.tried.clone();
    let mut requests = screened.requests.clone();
    requests.retain(|request| has_parameter(replay.registry, &request.effect, FINE));
    let (proposals, formulas) = proposals(replay, &record)?;
    if !requests.is_empty() || !proposals.is_empty() {
        tried.retain(|effect, _| requests.iter().any(|request| request.effect == *effect));
        // Sums are large, and these are made again.
        drop(record);
        (record, noise, screened) = gather(&requests, &proposals)?;
        for (effect, forms) in &screened.tried {
            *tried.entry(effect.clone()).or_default() += forms;
        }
    }
    tried.insert(FORMULA.to_owned(), formulas);
    tried.retain(|effect, _| !has_parameter(replay.registry, effect, FREQUENCY_HZ));
    let scorer = CandidateScorer::new(&record.candidate_set, &record.gathered, &noise, settings);
    let evidence = Evidence { trials: Trials::new(&scorer, &tried), least: settings.false_alarm, replay, proposals };
    let mut diagnosis = decide(settings, &record, &scorer, screened, &evidence, progress)?;
    contradict(&mut diagnosis, replay);
    Ok(Diagnosed { diagnosis, settings: settings.clone(), record })
}

/// A model's entry of a line.
fn entry_of(line: &Line) -> EffectEntry {
    let mut entry = EffectEntry::new(&line.effect, &line.instance);
    entry.parameters.insert(FREQUENCY_HZ.to_owned(), toml::Value::from(line.frequency_hz));
    entry
}

/// Decides by the likelihood of the innovations among the forms that the spectra choose, beside the effects that are
/// named so far: passes until nothing moves.
fn decide(
    settings: &Settings,
    record: &Record,
    scorer: &CandidateScorer<'_>,
    mut screened: Screened,
    evidence: &Evidence<'_>,
    progress: &mut dyn FnMut(Pass, usize, Progress),
) -> Result<Diagnosis, WorkflowError> {
    let fit = scorer.fit(&[])?;
    let model = &record.candidate_set.coefficients[..record.candidate_set.model()];
    let start = model.iter().zip(fit.estimate.theta.iter()).map(|(c, value)| (c.name.clone(), *value)).collect();
    let mut point = Point::at(start);
    // A glitch is no slow force, although it has its power.
    let seen = unexplained(scorer.gathered.transients.certain(settings.false_alarm), &[], settings.same_transient_s);
    let events = |c: &&Candidate| {
        let of = |d: &&Detection| (&d.effect, &d.instance) == (&c.effect, &c.instance);
        c.transient && seen.iter().any(of)
    };
    let events: Vec<Candidate> = screened.forms.iter().filter(events).cloned().collect();
    let mut slow = slow_forces(scorer, &scorer.fit(&events)?, &record.noise);
    let mut named: Vec<Candidate> = Vec::new();
    // A pass that fits constants beside what is named comes first, at the start and after a form has changed: they are
    // 1e5 σ away, and a filter would take them for noise.
    let (mut opening, mut passes) = (true, 0);
    let (decided, screened, moving) = loop {
        let chosen: Vec<EffectEntry> = screened.forms.iter().map(|form| evidence.entry(form)).collect();
        let decided = one_pass(evidence.replay, &chosen, &slow, opening, &point, evidence, progress)?;
        let next = step(&point, &decided);
        if opening {
            opening = false;
            point = next;
            continue;
        }
        passes += 1;
        let now = named_forms(&decided, &screened.forms);
        let mut moving = moved(&point, &next, &decided);
        if now != named {
            moving.extend(differences(&now, &named));
        }
        point = next;
        if passes > 1 && moving.is_empty() || passes == PASSES {
            break (decided, screened, moving);
        }
        if now != named {
            let beside = screen(scorer, &now)?;
            // A form that has changed is named in its new form, of which the spectra alone know a value.
            named = named_forms(&decided, &beside.forms);
            let fit = scorer.fit(&named)?;
            let values = &fit.estimate.theta.as_slice()[record.candidate_set.model()..];
            let parts = named.iter().flat_map(|c| c.parts.iter().map(move |(index, _)| (c, *index)));
            for ((_, index), value) in parts.zip(values).filter(|((c, _), _)| !now.contains(c)) {
                // Its mean is another, and constants are far away again.
                opening = true;
                point.values.insert(record.candidate_set.coefficients[index].name.clone(), *value);
            }
            slow = slow_forces(scorer, &fit, &record.noise);
            screened = Screened { forms: beside.forms, ..screened };
        }
    };
    answer(settings, record, scorer, &decided, &screened, evidence, &moving)
}

/// Names of the effects that are in one of two lists in a form in which they are not in the other.
fn differences(a: &[Candidate], b: &[Candidate]) -> BTreeSet<String> {
    let only = |of: &[Candidate], other: &[Candidate]| -> Vec<String> {
        of.iter().filter(|c| !other.contains(c)).map(Candidate::name).collect()
    };
    only(a, b).into_iter().chain(only(b, a)).collect()
}

/// The named effects among some forms.
fn named_forms(decided: &Decided, forms: &[Candidate]) -> Vec<Candidate> {
    let named = |c: &&Candidate| {
        let mut all = decided.selection.chosen.iter().map(|f| &decided.candidates[f.candidate]);
        all.any(|(effect, instance, _)| (effect, instance) == (&c.effect, &c.instance))
    };
    let mut all: Vec<Candidate> = forms.iter().filter(named).cloned().collect();
    all.sort_by_key(Candidate::name);
    all
}

/// Corrected p-values of the effects of a replay.
struct Evidence<'a> {
    trials: Trials,
    /// Probability from which another explanation is named beside the chosen one.
    least: f64,
    replay: &'a Replay<'a>,
    /// Formulas among the candidates.
    proposals: Vec<Proposal>,
}

impl Evidence<'_> {
    /// A model's entry that makes a candidate in its form.
    fn entry(&self, candidate: &Candidate) -> EffectEntry {
        if let Some(proposal) = self.proposal(&candidate.effect, &candidate.instance) {
            return proposal.entry.clone();
        }
        let mut entry = EffectEntry::new(&candidate.effect, &candidate.instance);
        let shape = candidate.parts.iter().flat_map(|(_, form)| &form.shape);
        entry.parameters = shape.filter_map(|(k, v)| Some((k.clone(), toml::Value::try_from(v).ok()?))).collect();
        entry
    }

    /// The formula of a candidate that is one.
    fn proposal(&self, effect: &str, instance: &str) -> Option<&Proposal> {
        self.proposals.iter().find(|p| (p.entry.id.as_str(), p.entry.instance.as_str()) == (effect, instance))
    }

    /// What acts once was searched for at every time, and what acts at one frequency at every frequency.
    fn family<'b>(&self, effect: &'b str) -> &'b str {
        let has = |name| has_parameter(self.replay.registry, effect, name);
        match (has(AT_NS), has(FREQUENCY_HZ)) {
            (true, _) => TRANSIENT,
            (_, true) => LINE,
            _ => effect,
        }
    }
}

impl Judge for Evidence<'_> {
    fn log10_p(&self, effect: &str, gain: f64, dof: usize) -> f64 {
        self.trials.p_value(self.family(effect), gain, dof as f64).1
    }

    fn ln_prior(&self, effect: &str) -> f64 {
        -self.trials.of(self.family(effect)).ln()
    }
}

/// The answer that the last pass gives.
fn answer(
    settings: &Settings,
    record: &Record,
    scorer: &CandidateScorer<'_>,
    decided: &Decided,
    screened: &Screened,
    evidence: &Evidence<'_>,
    moving: &BTreeSet<String>,
) -> Result<Diagnosis, WorkflowError> {
    let forms = &screened.forms;
    let unexplained = diagnosis::remaining(scorer, &named_forms(decided, forms))?;
    let mut named: Vec<Found> =
        decided.selection.chosen.iter().map(|f| found(settings, decided, f, forms, evidence, true)).collect();
    let mut others: Vec<Found> =
        decided.selection.rest.iter().map(|f| found(settings, decided, f, forms, evidence, false)).collect();
    let is_formula = |f: &Found| evidence.proposal(&f.effect, &f.instance).is_some();
    let formulas: Vec<Found> = named.extract_if(.., |f| is_formula(f)).collect();
    others.retain(|f| !is_formula(f));
    // A small remainder of what was there without them is what the grid of forms cannot represent.
    let before = diagnosis::remaining(scorer, &[])?.map_or(0.0, |u| u.ratio);
    let loud = unexplained.as_ref().filter(|u| u.ratio > settings.excess_remainder * before);
    let doubtful = follows_an_excess(scorer, &named_forms(decided, forms), loud)?;
    for f in named.extract_if(.., |f| doubtful.contains(&(f.effect.clone(), f.instance.clone()))) {
        let channels = unexplained.as_ref().map_or_else(String::new, |u| u.channels.join(", "));
        let refused = Some(format!("with it {channels} still show what no effect explains"));
        others.push(Found { accepted: false, refused, ..f });
    }
    let unexplained = followed(unexplained, &formulas, evidence, scorer);
    let mut levels = Vec::new();
    for f in louder(decided, record, evidence) {
        let certain = f.p_value < settings.false_alarm;
        let beyond = f.value.ln().abs() > settings.level_tolerance.ln_1p();
        match (certain, beyond) {
            (true, true) => named.push(Found { accepted: true, ..f }),
            (true, false) => levels.push(f.level()),
            (false, _) => {}
        }
    }
    named.sort_by(|a, b| a.log10_p_value.total_cmp(&b.log10_p_value));
    others.sort_by(|a, b| a.log10_p_value.total_cmp(&b.log10_p_value));
    let refused = |f: &Found| {
        let reason = f.refused.as_ref()?;
        Some(format!("{}:{} would lower χ² by {:.0}, and is refused: {reason}", f.effect, f.instance, f.delta_chi2))
    };
    let mut reasons: Vec<String> =
        if named.is_empty() { others.iter().filter_map(refused).collect() } else { Vec::new() };
    if !moving.is_empty() {
        let names: Vec<&str> = moving.iter().map(String::as_str).collect();
        reasons.push(format!("the likelihood is not settled after {PASSES} passes: {} still move", names.join(", ")));
    }
    let verdict = match (named.is_empty(), unexplained.is_some() || !reasons.is_empty()) {
        (false, _) => "missing",
        (true, true) => "unexplained",
        (true, false) => "sufficient",
    };
    others.truncate(settings.max_evaluated);
    named.extend(others);
    let beside_constants = decided.selection.unobservable.iter().map(|c| &decided.candidates[*c]);
    let beside_constants = beside_constants.map(|(effect, instance, _)| format!("{effect}:{instance}"));
    let unobservable = screened.unobservable.iter().cloned().chain(beside_constants);
    let unobservable = unobservable.map(|name| (name, UNOBSERVABLE.to_owned()));
    Ok(Diagnosis {
        verdict: verdict.to_owned(),
        false_alarm_rate: settings.false_alarm,
        tried: evidence.trials.total(),
        candidates: named,
        upper_limits: decided.selection.rest.iter().flat_map(|f| limits(decided, f, forms, evidence)).collect(),
        unexplained,
        formulas,
        reasons,
        levels,
        transients: scorer.gathered.transients.certain(settings.false_alarm).map(|h| json!(h)).collect(),
        not_tried: unobservable
            .chain(record.not_tried.iter().cloned())
            .chain(decided.not_tried.iter().cloned())
            .collect(),
    })
}

/// What is unexplained, with the drivers of the proposed formulas first among what is coherent with it.
fn followed(
    unexplained: Option<Unexplained>,
    formulas: &[Found],
    evidence: &Evidence<'_>,
    scorer: &CandidateScorer<'_>,
) -> Option<Unexplained> {
    if formulas.is_empty() {
        return unexplained;
    }
    let mut u = unexplained.unwrap_or_else(|| {
        let plan = scorer.plan();
        let lowest_hz = plan.bands.first().map_or(0.0, |band| plan.frequency_hz(*band));
        Unexplained {
            channels: Vec::new(),
            band_hz: [lowest_hz, SLOW_HZ],
            kind: "driven".to_owned(),
            ratio: 1.0,
            power: false,
            coherent_with: Vec::new(),
            coherences: Vec::new(),
        }
    });
    // The chosen ones first, then what the data cannot tell from them, as likely first.
    let own = formulas.iter().filter_map(|f| evidence.proposal(&f.effect, &f.instance));
    let words = formulas.iter().flat_map(|f| &f.confounders);
    let others = words.filter_map(|words| evidence.proposals.iter().find(|p| p.words == *words));
    let drivers: Vec<String> = own.chain(others).map(|p| p.driver.clone()).collect();
    let before = std::mem::take(&mut u.coherent_with);
    for driver in drivers.into_iter().chain(before) {
        if !u.coherent_with.contains(&driver) {
            u.coherent_with.push(driver);
        }
    }
    u.channels.extend(formulas.iter().flat_map(|f| f.channels.clone()));
    u.channels.sort();
    u.channels.dedup();
    Some(u)
}

/// Named effects that act where more power than the noise is left with them, in the bands that say most about them:
/// they follow the cause of that power, and are not it.
fn follows_an_excess(
    scorer: &CandidateScorer<'_>,
    named: &[Candidate],
    unexplained: Option<&Unexplained>,
) -> Result<Vec<(String, String)>, WorkflowError> {
    let Some(u) = unexplained.filter(|u| u.power) else { return Ok(Vec::new()) };
    let fit = scorer.fit(named)?;
    let Some(excess) = scorer.without_excess(&fit) else { return Ok(Vec::new()) };
    let acts = |c: &&Candidate| {
        let channels = &scorer.candidate_set.channels;
        let mut own = c.parts.iter().flat_map(|(_, form)| &form.terms).map(|t| &channels[t.channel]);
        own.any(|channel| u.channels.contains(channel))
    };
    let mostly = |c: &&Candidate| scorer.part_in(&excess.plain, c, &excess.bands) > 0.5;
    let all = named.iter().filter(|c| !c.transient).filter(acts).filter(mostly);
    Ok(all.map(|c| (c.effect.clone(), c.instance.clone())).collect())
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

fn found(
    settings: &Settings,
    decided: &Decided,
    fitted: &Fitted,
    forms: &[Candidate],
    evidence: &Evidence<'_>,
    accepted: bool,
) -> Found {
    let (effect, instance, own) = &decided.candidates[fitted.candidate];
    let (values, lead) = leading(fitted);
    let form = forms.iter().find(|c| (&c.effect, &c.instance) == (effect, instance));
    let dof = own.len() as f64;
    let (p_value, log10_p_value) = evidence.trials.p_value(evidence.family(effect), fitted.gain, dof);
    let (mut offset_shift_m, mut offset_shift_sigma) = (BTreeMap::new(), BTreeMap::new());
    let named: Vec<usize> = decided.selection.chosen.iter().map(|f| f.candidate).collect();
    let without: Vec<usize> = named.iter().copied().filter(|c| *c != fitted.candidate).collect();
    let with: Vec<usize> = without.iter().copied().chain([fitted.candidate]).collect();
    let by_product =
        if accepted { by_product(decided, &with, own[lead], evidence.replay.products) } else { Vec::new() };
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
    let name_of = |c: &usize| {
        let (effect, instance, _) = &decided.candidates[*c];
        evidence.proposal(effect, instance).map_or_else(|| format!("{effect}:{instance}"), |p| p.words.clone())
    };
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
        shape: match (evidence.proposal(effect, instance), form) {
            (Some(p), _) => p.entry.parameters.iter().map(|(k, value)| (k.clone(), json!(value))).collect(),
            (None, Some(form)) => form.parts[0].1.shape.clone(),
            (None, None) => Map::new(),
        },
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
            Meaning::Level | Meaning::Power => true,
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

/// What each product alone says of a parameter, with a set of candidates.
fn by_product(decided: &Decided, set: &[usize], parameter: usize, products: &[Written]) -> Vec<OfProduct> {
    let of = |(quadratic, written): (&Quadratic, &Written)| {
        let (values, sigma) = quadratic.solution(set);
        OfProduct { product: written.product.id().to_owned(), value: values[parameter], sigma: sigma[parameter] }
    };
    decided.by_product.iter().zip(products).map(of).collect()
}

/// Levels of noise that effects could state, as the likelihood has them.
fn louder(decided: &Decided, record: &Record, evidence: &Evidence<'_>) -> Vec<Found> {
    let all = record.candidate_set.coefficients.iter().filter(|c| !c.noise.is_empty());
    all.filter_map(|c| {
        let i = decided.parameters.iter().position(|(name, m)| *name == c.noise && matches!(m, Meaning::Level))?;
        let (ln, relative) = (decided.selection.values[i], decided.selection.sigma[i]);
        // A level that the model states is in the noise already; what is measured is relative to it.
        let value = ln.exp() * if c.candidate { 1.0 } else { c.initial };
        let gain = (ln / relative).powi(2);
        let (p_value, log10_p_value) = evidence.trials.p_value(&c.effect, gain, 1.0);
        let sigma = relative * value;
        let before = decided.chi2 / decided.numbers;
        Some(Found {
            effect: c.effect.clone(),
            instance: c.instance.clone(),
            coefficient: c.name.clone(),
            value,
            sigma,
            unit: "1".to_owned(),
            shape: Map::new(),
            coefficients: vec![json!({ "name": c.name, "value": value, "sigma": sigma, "unit": "1" })],
            delta_chi2: gain,
            p_value,
            log10_p_value,
            delta_bic: decided.numbers.ln() - gain,
            in_range: true,
            chi2_per_dof_before: before + gain / decided.numbers,
            chi2_per_dof_after: before,
            offset_shift_m: BTreeMap::new(),
            offset_shift_sigma: BTreeMap::new(),
            channels: channels_of(record, &c.noise),
            confounders: Vec::new(),
            separations: Vec::new(),
            accepted: false,
            refused: None,
            by_product: Vec::new(),
            constancy: None,
        })
    })
    .collect()
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

/// Limits of a candidate's coefficients; none of a formula, which the data themselves have written.
fn limits(decided: &Decided, fitted: &Fitted, forms: &[Candidate], evidence: &Evidence<'_>) -> Vec<Limit> {
    let (effect, instance, own) = &decided.candidates[fitted.candidate];
    if evidence.proposal(effect, instance).is_some() {
        return Vec::new();
    }
    let form = forms.iter().find(|c| (&c.effect, &c.instance) == (effect, instance));
    let limit = |(k, i): (usize, &usize)| {
        let sigma = fitted.covariance[(k, k)].max(0.0).sqrt();
        let (name, unit) = coefficient(decided, *i);
        Limit {
            effect: effect.clone(),
            instance: instance.clone(),
            coefficient: name.to_owned(),
            limit_95: fitted.free[k].abs() + LIMIT_QUANTILE * sigma,
            sigma,
            unit: unit.to_owned(),
            shape: form.map(|c| c.parts[0].1.shape.clone()).unwrap_or_default(),
        }
    };
    own.iter().enumerate().map(limit).collect()
}

/// A model whose two solutions disagree is not sufficient, whatever the candidates say.
fn contradict(diagnosis: &mut Diagnosis, replay: &Replay<'_>) {
    let disagree = replay.products.iter().filter(|p| p.product.result.verdict.as_deref() == Some("disagree"));
    let names: Vec<String> = disagree.map(|p| p.product.id().to_string()).collect();
    if diagnosis.verdict == "sufficient" && !names.is_empty() {
        diagnosis.verdict = "unexplained".to_owned();
        diagnosis.reasons.push(format!("the recursive and the batch solution of {} disagree", names.join(", ")));
    }
}

impl Diagnosed {
    /// Detected transients that no accepted candidate explains, by decreasing significance; of close ones the first.
    pub fn unexplained_transients(&self) -> Vec<&Detection> {
        let seen = self.record.gathered.transients.certain(self.diagnosis.false_alarm_rate);
        unexplained(seen, &self.diagnosis.candidates, self.settings.same_transient_s)
    }
}

fn unexplained<'a>(seen: impl Iterator<Item = &'a Detection>, candidates: &[Found], same_s: f64) -> Vec<&'a Detection> {
    let same_ns = (1e9 * same_s) as i64;
    let accepted = candidates.iter().filter(|f| f.accepted);
    let mut told: Vec<i64> = accepted.filter_map(|f| f.shape.get("at_ns")?.as_i64()).collect();
    let mut is_new = |detection: &&Detection| {
        let new = told.iter().all(|at_ns| (at_ns - detection.at_ns).abs() > same_ns);
        told.push(detection.at_ns);
        new
    };
    seen.filter(|detection| is_new(detection)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_rings_beside_something_louder_is_not_told_again() {
        let detection = |at_s: i64| Detection {
            effect: "impulse".to_owned(),
            instance: "tm1.x".to_owned(),
            coefficient: "impulse.tm1.x".to_owned(),
            unit: "N s".to_owned(),
            shape: Map::new(),
            at_ns: 1_000_000_000 * at_s,
            significance: 10.0,
        };
        let seen = [20_000, 21_800, 24_000, 5_000].map(detection);
        // The third rings beside the second, which rings beside the first.
        let times: Vec<i64> = unexplained(seen.iter(), &[], 3600.0).iter().map(|h| h.at_ns / 1_000_000_000).collect();
        assert_eq!(times, [20_000, 5_000]);
    }
}
