//! Which effect is missing from the model of some products.
//!
//! The data are read twice: transients must be detected before they are compared with lasting effects. They are read a
//! third time if the shape of a candidate can be refined.

use std::collections::BTreeMap;

use dragfree_engine::examine::has_parameter;
use dragfree_engine::run::Progress;
use dragfree_identification::diagnosis::{self, Diagnosis, Found, RefinementRequest};
use dragfree_identification::record::Record;
use dragfree_identification::scores::CandidateScorer;
use dragfree_identification::transient::Detection;
use dragfree_schema::Settings;

use crate::WorkflowError;
use crate::replay::{FINE, Pass, Replay, What, sum};

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
/// [`WorkflowError`]: an input has changed, the products do not belong together, or there is too little data.
pub fn diagnose(
    replay: &Replay<'_>,
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
    if requests.is_empty() {
        return Ok(first);
    }
    let mut tried = first.diagnosis.forms;
    tried.retain(|effect, _| requests.iter().any(|request| request.effect == *effect));
    // Sums are large, and these are made again.
    drop(first.record);
    pass(&requests, &tried)
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
            shape: serde_json::Map::new(),
            at_ns: 1_000_000_000 * at_s,
            significance: 10.0,
        };
        let seen = [20_000, 21_800, 24_000, 5_000].map(detection);
        // The third rings beside the second, which rings beside the first.
        let times: Vec<i64> = unexplained(seen.iter(), &[], 3600.0).iter().map(|h| h.at_ns / 1_000_000_000).collect();
        assert_eq!(times, [20_000, 5_000]);
    }
}
