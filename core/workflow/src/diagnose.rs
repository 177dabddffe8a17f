//! Which effect is missing from the model of some products.
//!
//! The data are read twice: transients must be detected before they are compared with lasting effects. They are read a
//! third time if the shape of a candidate can be refined.

use std::collections::{BTreeMap, BTreeSet};

use dragfree_engine::config::EffectEntry;
use dragfree_engine::examine::has_parameter;
use dragfree_engine::run::Progress;
use dragfree_identification::candidates::Candidate;
use dragfree_identification::diagnosis::{
    self, Diagnosis, Found, LIMIT_QUANTILE, Limit, RefinementRequest, TRANSIENT, Trials,
};
use dragfree_identification::innovations::decision::Fitted;
use dragfree_identification::record::Record;
use dragfree_identification::scores::CandidateScorer;
use dragfree_identification::transient::Detection;
use dragfree_schema::Settings;
use serde_json::{Map, json};

use crate::WorkflowError;
use crate::likelihood::{self, Decided, Judge, Meaning};
use crate::replay::{AT_NS, FINE, Pass, Replay, What, sum};

/// What decides which effect is missing.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Decision {
    /// Scores of the spectra, under rules for halves of the data and for excesses of power.
    Spectra,
    /// The likelihood of the innovations, among the forms that the spectra have chosen.
    Innovations,
}

/// A diagnosis and the sums that it rests on.
pub struct Diagnosed {
    /// Sums.
    pub record: Record,
    /// What they say.
    pub diagnosis: Diagnosis,
    /// Thresholds.
    pub settings: Settings,
}

/// Diagnoses the data of products of one model. `progress` is told the pass and the number of the product.
///
/// # Errors
/// [`WorkflowError`]: an input has changed, the products do not belong together, there is too little data, or the
/// likelihood is asked for and a stage declares noise that cannot be filtered.
pub fn diagnose(
    replay: &Replay<'_>,
    decision: Decision,
    progress: &mut dyn FnMut(Pass, usize, Progress),
) -> Result<Diagnosed, WorkflowError> {
    let settings = replay.settings()?;
    let found = sum(replay, settings, What::Transients, progress)?.gathered.transients;
    let detected: Vec<Detection> =
        found.certain(settings.transient_p_value).take(settings.max_transients).cloned().collect();
    let mut pass = |requests: &[RefinementRequest], tried_before: &BTreeMap<String, usize>| {
        let mut record = sum(replay, settings, What::Candidates(&detected, requests), progress)?;
        record.gathered.transients = found.clone();
        let noise = record.noise_model()?;
        let scorer = CandidateScorer::new(&record.candidate_set, &record.gathered, &noise, settings);
        let mut diagnosis = diagnosis::diagnose(&scorer, tried_before)?;
        diagnosis.not_tried.extend(record.not_tried.iter().cloned());
        contradict(&mut diagnosis, replay);
        Ok::<_, WorkflowError>(Diagnosed { record, diagnosis, settings: settings.clone() })
    };
    let first = pass(&[], &BTreeMap::new())?;
    let mut requests = first.diagnosis.refinement_requests.clone();
    requests.retain(|request| has_parameter(replay.registry, &request.effect, FINE));
    let by_spectra = if requests.is_empty() {
        first
    } else {
        let mut tried = first.diagnosis.forms;
        tried.retain(|effect, _| requests.iter().any(|request| request.effect == *effect));
        // Sums are large, and these are made again.
        drop(first.record);
        pass(&requests, &tried)?
    };
    match decision {
        Decision::Spectra => Ok(by_spectra),
        Decision::Innovations => by_innovations(replay, by_spectra, progress),
    }
}

/// Corrected p-values of the effects of a replay.
struct Evidence<'a> {
    trials: Trials,
    /// Probability from which another explanation is named beside the chosen one.
    least: f64,
    replay: &'a Replay<'a>,
}

impl Evidence<'_> {
    /// What acts once was searched for at every time.
    fn family<'b>(&self, effect: &'b str) -> &'b str {
        if has_parameter(self.replay.registry, effect, AT_NS) { TRANSIENT } else { effect }
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

/// Decides by the likelihood of the innovations among the best forms that the spectra have found.
fn by_innovations(
    replay: &Replay<'_>,
    by_spectra: Diagnosed,
    progress: &mut dyn FnMut(Pass, usize, Progress),
) -> Result<Diagnosed, WorkflowError> {
    let Diagnosed { record, diagnosis, settings } = by_spectra;
    let noise = record.noise_model()?;
    let scorer = CandidateScorer::new(&record.candidate_set, &record.gathered, &noise, &settings);
    let trials = Trials::new(&scorer, &diagnosis.forms);
    let evidence = Evidence { trials, least: settings.false_alarm, replay };
    let mut forms: Vec<Candidate> = Vec::new();
    for candidate in &diagnosis.best_forms {
        let same = |c: &Candidate| (&c.effect, &c.instance) == (&candidate.effect, &candidate.instance);
        if !forms.iter().any(same) {
            forms.push(candidate.clone());
        }
    }
    let chosen: Vec<EffectEntry> = forms.iter().map(entry).collect();
    let fit = scorer.fit(&[])?;
    let model = &record.candidate_set.coefficients[..record.candidate_set.model()];
    let mut start: BTreeMap<String, f64> =
        model.iter().zip(fit.estimate.theta.iter()).map(|(c, value)| (c.name.clone(), *value)).collect();
    // A start alone: beside a large effect that is not taken off, everything else is seen wrong in the first pass.
    let by_spectra = diagnosis.candidates.iter().filter(|f| f.accepted).flat_map(|f| &f.coefficients);
    start.extend(by_spectra.filter_map(|c| Some((c["name"].as_str()?.to_owned(), c["value"].as_f64()?))));
    let decided = likelihood::decide(replay, &settings, &chosen, start, &evidence, progress)?;
    let is_named = |c: &&Candidate| {
        let named = decided.selection.chosen.iter().map(|f| &decided.candidates[f.candidate]);
        named.into_iter().any(|(effect, instance, _)| (effect, instance) == (&c.effect, &c.instance))
    };
    let added: Vec<Candidate> = forms.iter().filter(is_named).cloned().collect();
    let unexplained = diagnosis::remaining(&scorer, &added)?;
    let mut named: Vec<Found> =
        decided.selection.chosen.iter().map(|f| found(&decided, f, &forms, &evidence, true)).collect();
    let mut levels = Vec::new();
    for f in louder(&decided, &record, &evidence) {
        let certain = f.p_value < settings.false_alarm;
        let beyond = f.value.ln().abs() > settings.level_tolerance.ln_1p();
        match (certain, beyond) {
            (true, true) => named.push(Found { accepted: true, ..f }),
            (true, false) => levels.push(f.level()),
            (false, _) => {}
        }
    }
    named.sort_by(|a, b| a.log10_p_value.total_cmp(&b.log10_p_value));
    let mut others: Vec<Found> =
        decided.selection.rest.iter().map(|f| found(&decided, f, &forms, &evidence, false)).collect();
    others.sort_by(|a, b| a.log10_p_value.total_cmp(&b.log10_p_value));
    let upper_limits = decided.selection.rest.iter().flat_map(|f| limits(&decided, f, &forms)).collect();
    others.truncate(settings.max_evaluated);
    let verdict = match (named.is_empty(), unexplained.is_some()) {
        (false, _) => "missing",
        (true, true) => "unexplained",
        (true, false) => "sufficient",
    };
    named.extend(others);
    let mut not_tried = diagnosis.not_tried;
    not_tried.extend(decided.not_tried.iter().cloned());
    let diagnosis = Diagnosis {
        verdict: verdict.to_owned(),
        decided_by: "innovations".to_owned(),
        candidates: named,
        upper_limits,
        unexplained,
        reasons: Vec::new(),
        levels,
        not_tried,
        ..diagnosis
    };
    let mut diagnosed = Diagnosed { record, diagnosis, settings };
    contradict(&mut diagnosed.diagnosis, replay);
    Ok(diagnosed)
}

/// A model's entry that makes a candidate in its form.
fn entry(candidate: &Candidate) -> EffectEntry {
    let mut entry = EffectEntry::new(&candidate.effect, &candidate.instance);
    let shape = candidate.parts.iter().flat_map(|(_, form)| &form.shape);
    entry.parameters = shape.filter_map(|(k, v)| Some((k.clone(), toml::Value::try_from(v).ok()?))).collect();
    entry
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

fn found(decided: &Decided, fitted: &Fitted, forms: &[Candidate], evidence: &Evidence<'_>, accepted: bool) -> Found {
    let (effect, instance, own) = &decided.candidates[fitted.candidate];
    let (values, lead) = leading(fitted);
    let form = forms.iter().find(|c| (&c.effect, &c.instance) == (effect, instance));
    let dof = own.len() as f64;
    let (p_value, log10_p_value) = evidence.trials.p_value(evidence.family(effect), fitted.gain, dof);
    let (mut offset_shift_m, mut offset_shift_sigma) = (BTreeMap::new(), BTreeMap::new());
    let named: Vec<usize> = decided.selection.chosen.iter().map(|f| f.candidate).collect();
    let without: Vec<usize> = named.iter().copied().filter(|c| *c != fitted.candidate).collect();
    let with: Vec<usize> = without.iter().copied().chain([fitted.candidate]).collect();
    let [(with, _), (without, sigma)] = [with, without].map(|set| decided.quadratic.solution(&set));
    for (i, (name, meaning)) in decided.parameters.iter().enumerate() {
        if matches!(meaning, Meaning::Coefficient(c) if !c.candidate && c.unit == "m") {
            offset_shift_m.insert(name.clone(), without[i] - with[i]);
            offset_shift_sigma.insert(name.clone(), (without[i] - with[i]) / sigma[i]);
        }
    }
    let channels: BTreeSet<&String> =
        own.iter().filter_map(|i| decided.channels.get(&decided.parameters[*i].0)).flatten().collect();
    let confounder = |(c, _): &(usize, f64)| format!("{}:{}", decided.candidates[*c].0, decided.candidates[*c].1);
    let before = decided.chi2 / decided.numbers;
    let (name, unit) = coefficient(decided, own[lead]);
    Found {
        effect: effect.clone(),
        instance: instance.clone(),
        coefficient: name.to_owned(),
        value: values[lead].0,
        sigma: values[lead].1,
        unit: unit.to_owned(),
        shape: form.map(|c| c.parts[0].1.shape.clone()).unwrap_or_default(),
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
        in_range: fitted.values.iter().zip(&fitted.free).all(|(a, b)| a == b),
        held_out_delta_chi2: None,
        held_out_p_value: None,
        chi2_per_dof_before: if accepted { before + fitted.gain / decided.numbers } else { before },
        chi2_per_dof_after: if accepted { before } else { before - fitted.gain / decided.numbers },
        offset_shift_m,
        offset_shift_sigma,
        channels: channels.into_iter().cloned().collect(),
        confounders: fitted.alternatives.iter().filter(|(_, p)| *p > evidence.least).map(confounder).collect(),
        accepted,
        refused: (!accepted && p_value < evidence.least).then(|| {
            "it may be what the form of a named effect leaves, or as many effects as the settings allow are named"
                .to_owned()
        }),
        of_excess: false,
        drives_estimate: false,
    }
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
            held_out_delta_chi2: None,
            held_out_p_value: None,
            chi2_per_dof_before: before + gain / decided.numbers,
            chi2_per_dof_after: before,
            offset_shift_m: BTreeMap::new(),
            offset_shift_sigma: BTreeMap::new(),
            channels: channels_of(record, &c.noise),
            confounders: Vec::new(),
            accepted: false,
            refused: None,
            of_excess: false,
            drives_estimate: false,
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

fn limits(decided: &Decided, fitted: &Fitted, forms: &[Candidate]) -> Vec<Limit> {
    let (effect, instance, own) = &decided.candidates[fitted.candidate];
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
