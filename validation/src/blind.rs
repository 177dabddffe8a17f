//! The blind campaign: telemetry with effects that a seed alone has drawn, diagnosed, and scored when the seal is opened.
//!
//! Each seed goes the way of a user: `simulate --hidden`, `run`, `diagnose`, then `reveal`. The folder with the sealed truth is moved
//! away before anything reads the telemetry.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::ops::RangeInclusive;
use std::path::Path;
use std::sync::Mutex;
use std::time::Instant;

use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::campaign::{CampaignError, Meter, note, work};
use crate::program::{Chain, Program, root};
use crate::records::{Keyed, Results};

/// Hidden seeds up to this one served to develop the method, and count in no campaign.
pub const DEVELOPED_ON: u32 = 100;

/// Significance from which an effect should be found.
const PLAIN: f64 = 8.0;

/// One seed.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Blind {
    /// Length and kind of the data.
    pub configuration: String,
    /// Seed of what is hidden and of the noise.
    pub seed: u32,
    /// Digest of the plugins' libraries, twelve hexadecimal digits.
    pub build: String,
    /// Seconds that the diagnosis took.
    pub diagnosis_s: f64,
    /// What `reveal` says of it.
    pub score: Value,
}

impl Keyed for Blind {
    fn key(&self) -> (String, u32) {
        (self.configuration.clone(), self.seed)
    }

    fn build(&self) -> &str {
        &self.build
    }
}

/// Runs the seeds that are not in `results` yet, so many at once.
///
/// # Errors
/// [`CampaignError`]; what was done by then is on disk, and the next call goes on.
pub fn blind(
    program: &Program,
    seeds: RangeInclusive<u32>,
    hours: f64,
    at_once: usize,
    results: &Path,
    scratch: &Path,
) -> Result<(), CampaignError> {
    let build = program.digest()?;
    let configuration = format!("hidden-{hours}h");
    let (results, dropped) = Results::<Blind>::open(results, &build)?;
    if dropped > 0 {
        note(&format!("{dropped} results of another build are dropped and measured again"));
    }
    let left: Vec<u32> = seeds.filter(|seed| !results.has(&configuration, *seed)).collect();
    let meter = Meter::new(left.len() as f64);
    let results = Mutex::new(results);
    let chain = Chain { pipeline: root().join("fixtures/pipelines/science-mode.toml"), ..Chain::default() };
    work(left, at_once, |seed| {
        let folder = scratch.join(format!("blind-{seed}"));
        let io = |e: std::io::Error| CampaignError::File { path: folder.clone(), reason: e.to_string() };
        if folder.exists() {
            std::fs::remove_dir_all(&folder).map_err(io)?;
        }
        std::fs::create_dir_all(&folder).map_err(io)?;
        let hidden = program.hide(&root().join("fixtures/missions/taiji.toml"), &folder, seed, hours)?;
        let archive = folder.join("archive");
        let product = program.run(&chain, &hidden.files, &archive)?;
        let start = Instant::now();
        let diagnosis = program.diagnose(&product, &archive)?;
        let diagnosis_s = (start.elapsed().as_secs_f64() * 10.0).round() / 10.0;
        let answer = folder.join("diagnosis.json");
        std::fs::write(&answer, diagnosis.to_string()).map_err(io)?;
        let score = program.reveal(&hidden, &answer)?;
        let line = Blind {
            configuration: configuration.clone(),
            seed,
            build: build.clone(),
            diagnosis_s,
            score: score.clone(),
        };
        if let Ok(mut results) = results.lock() {
            results.append(line)?;
        }
        std::fs::remove_dir_all(&folder).map_err(io)?;
        meter.say(1.0, &format!("seed {seed}: {} ({diagnosis_s} s)", score["verdict"].as_str().unwrap_or("?")));
        Ok(())
    })?;
    match results.into_inner() {
        Ok(results) => {
            note(&summary(&results.lines));
            Ok(results.sort(&[&configuration])?)
        }
        Err(_) => Ok(()),
    }
}

/// The numbers of a campaign, as text.
#[must_use]
pub fn summary(lines: &[Blind]) -> String {
    let mut verdicts: BTreeMap<&str, usize> = BTreeMap::new();
    let mut kinds: BTreeMap<String, (usize, usize, BTreeMap<String, usize>)> = BTreeMap::new();
    let (mut clean, mut alarms) = (0, 0);
    for line in lines {
        let score = &line.score;
        *verdicts.entry(score["verdict"].as_str().unwrap_or("?")).or_default() += 1;
        let effects = score["effects"].as_array().map_or(&[][..], Vec::as_slice);
        if effects.is_empty() {
            clean += 1;
            alarms += usize::from(score["correct"] != true);
        }
        let [effect] = effects else { continue };
        let significance = effect["expected_significance"].as_f64().unwrap_or(0.0);
        let kind = kinds.entry(effect["effect"].as_str().unwrap_or("?").to_owned()).or_default();
        if significance >= PLAIN {
            kind.0 += 1;
            kind.1 += usize::from(score["correct"] == true || score["verdict"] == "confounded");
        }
        let said = match score["accepted"].get(0).and_then(Value::as_str) {
            Some(name) => name.split(':').next().unwrap_or(name),
            None => score["diagnosis_verdict"].as_str().unwrap_or("?"),
        };
        *kind.2.entry(said.to_owned()).or_default() += 1;
    }
    let mut text = format!("{} sets; {clean} with nothing hidden, {alarms} false alarms among them\n", lines.len());
    for (verdict, n) in verdicts {
        let _ = writeln!(text, "  {verdict:<12} {n}");
    }
    let _ = writeln!(text, "one effect: kind, right or confounded of those above {PLAIN}σ, and what was said");
    for (kind, (plain, right, said)) in kinds {
        let said: Vec<String> = said.into_iter().map(|(name, n)| format!("{name} {n}")).collect();
        let _ = writeln!(text, "  {kind:<16} {right}/{plain}  {}", said.join(", "));
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    fn line(seed: u32, score: Value) -> Blind {
        Blind { configuration: "hidden-6h".to_owned(), seed, build: "b".to_owned(), diagnosis_s: 1.0, score }
    }

    #[test]
    fn a_summary_counts_what_was_right() {
        let one = |significance: f64| json!([{ "effect": "es-gain", "expected_significance": significance }]);
        let right = json!({ "verdict": "right", "correct": true, "effects": one(9.0), "accepted": ["es-gain:tm1.y"] });
        let missed = json!({ "verdict": "missed", "correct": false, "effects": one(8.5), "accepted": [],
            "diagnosis_verdict": "sufficient" });
        let faint = json!({ "verdict": "missed", "correct": false, "effects": one(3.0), "accepted": [],
            "diagnosis_verdict": "sufficient" });
        let alarm = json!({ "verdict": "false alarm", "correct": false, "effects": [], "accepted": ["slosh:sc.x"] });
        let text = summary(&[line(101, right), line(102, missed), line(103, faint), line(104, alarm)]);
        assert!(text.contains("4 sets; 1 with nothing hidden, 1 false alarms"), "{text}");
        assert!(text.contains("es-gain          1/2  es-gain 1, sufficient 2"), "{text}");
    }
}
