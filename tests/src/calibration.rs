//! Calibrations of simulated telemetry: run, result and truth.

use crate::{dragfree, fixture, simulate};
use serde_json::Value;
use std::path::{Path, PathBuf};
use std::process::Command;

/// The offsets of the paper's Table tab:com_calibration_results, m.
pub const TRUTH_M: [(&str, f64); 6] = [
    ("com-offset.tm1.x", 0.090_866_025_403_784_44),
    ("com-offset.tm1.y", 0.155_384_572_681_198_96),
    ("com-offset.tm1.z", 0.0),
    ("com-offset.tm2.x", 0.090_866_025_403_784_44),
    ("com-offset.tm2.y", -0.155_384_572_681_198_96),
    ("com-offset.tm2.z", 0.0),
];

/// `dragfree run` of the science-mode pipeline in `folder`, into the archive `archive` there, with JSON output.
#[must_use]
pub fn science_mode(folder: &Path) -> Command {
    of_pipeline(folder, &fixture("pipelines/science-mode.toml"))
}

/// The same with another pipeline.
#[must_use]
pub fn of_pipeline(folder: &Path, pipeline: &Path) -> Command {
    let mut command = dragfree(folder);
    command.arg("run").arg(pipeline).args(["--archive", "archive", "--json"]);
    command
}

/// `dragfree diagnose` of a product of the archive `archive` in `folder`, as JSON.
///
/// # Panics
/// It fails, the exit code does not tell its verdict, or it calls a model sufficient beside a candidate beyond the
/// corrected bound.
#[must_use]
pub fn diagnose(folder: &Path, product: &Value) -> Value {
    let id = product["id"].as_str().expect("an id");
    let output = dragfree(folder).args(["diagnose", id, "--archive", "archive", "--json", "-q"]).output();
    let output = output.expect("the program runs");
    let d: Value = serde_json::from_slice(&output.stdout)
        .unwrap_or_else(|e| panic!("{e}: {}", String::from_utf8_lossy(&output.stderr)));
    let sufficient = d["verdict"] == "sufficient";
    assert_eq!(output.status.code(), Some(if sufficient { 0 } else { 4 }), "{}", d["verdict"]);
    let all = d["candidates"].as_array().expect("candidates");
    let bound = d["false_alarm_rate"].as_f64();
    for c in all.iter().filter(|c| c["p_value"].as_f64() < bound && c["accepted"] == false) {
        assert!(!sufficient && c["refused"].is_string(), "{c:#}");
    }
    assert!(!(sufficient && product["verdict"] == "disagree"), "{d:#}");
    d
}

/// Simulates without keeping the truth, and calibrates.
///
/// # Panics
/// A program fails.
#[must_use]
pub fn calibrated(folder: &Path, arguments: &[&str]) -> Value {
    let file = simulate(folder, arguments).remove(0);
    std::fs::remove_dir_all(folder.join("truth")).expect("removable");
    let run = science_mode(folder).arg(&file).output().expect("runs");
    serde_json::from_slice(&run.stdout).expect("a product as JSON")
}

/// Simulates, calibrates and diagnoses.
///
/// # Panics
/// As [`diagnose`].
#[must_use]
pub fn diagnosis(arguments: &[&str]) -> Value {
    let folder = tempfile::tempdir().expect("a temporary folder");
    diagnose(folder.path(), &calibrated(folder.path(), arguments))
}

/// Accepted candidates.
///
/// # Panics
/// There is no list of them.
#[must_use]
pub fn accepted(d: &Value) -> Vec<String> {
    let name = |c: &Value| format!("{}:{}", c["effect"].as_str().unwrap_or("?"), c["instance"].as_str().unwrap_or("?"));
    d["candidates"].as_array().expect("a list").iter().filter(|c| c["accepted"] == true).map(name).collect()
}

/// The only accepted candidate, with its value within 4σ of `truth` (false alarm 6e-5).
///
/// # Panics
/// Another is accepted too, or the value is further off.
#[must_use]
pub fn named_alone(d: &Value, truth: f64) -> String {
    let found = accepted(d);
    let [one] = &found[..] else { panic!("{found:?}: {:#}", d["candidates"]) };
    let first = &d["candidates"][0];
    let (value, sigma) = (first["value"].as_f64().expect("a value"), first["sigma"].as_f64().expect("a sigma"));
    assert!((value - truth).abs() < 4.0 * sigma && sigma < 0.25 * truth.abs(), "{one} {value} ± {sigma}");
    one.clone()
}

/// A readout scale or an electrode gain of 5 % along y, which confound each other, in so many hours of seed 31: one is
/// named alone, the other is its confounder.
///
/// # Panics
/// It is otherwise.
pub fn scale_or_gain(hours: &str, effect: &str) {
    let pair = ["is-scale:tm2.y", "es-gain:tm2.y"];
    let d = diagnosis(&["--hours", hours, "--seed", "31", "--effect", &format!("{effect}=0.05")]);
    let named = named_alone(&d, 0.05);
    let confounders: Vec<_> = d["candidates"][0]["confounders"].as_array().expect("a list").iter().collect();
    let other = pair.iter().find(|name| **name != named);
    assert!(pair.contains(&&*named) && confounders.iter().any(|c| other == c.as_str().as_ref()), "{d:#}");
}

/// The bundled mission with changed texts, in `folder`.
///
/// # Panics
/// A text to be changed is not there.
#[must_use]
pub fn changed_mission(folder: &Path, name: &str, changes: &[(&str, &str)]) -> PathBuf {
    let mut text = std::fs::read_to_string(fixture("missions/taiji.toml")).expect("readable");
    for (from, to) in changes {
        assert!(text.contains(from), "{from}");
        text = text.replacen(from, to, 1);
    }
    let path = folder.join(name);
    std::fs::write(&path, text).expect("writable");
    path
}

/// Result of a run.
pub struct Run {
    /// Exit code.
    pub code: Option<i32>,
    /// Standard error.
    pub stderr: String,
    /// The product, or null.
    pub product: Value,
}

impl Run {
    /// Runs `command`.
    ///
    /// # Panics
    /// The program does not start, or panics.
    pub fn of(command: &mut Command) -> Self {
        let output = command.output().expect("the program runs");
        let stderr = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(output.status.code().is_some() && !stderr.contains("panicked"), "{command:?}: {stderr}");
        let product = serde_json::from_slice(&output.stdout).unwrap_or(Value::Null);
        Self { code: output.status.code(), stderr, product }
    }

    /// Asserts exit code and verdict.
    ///
    /// # Panics
    /// They are others.
    pub fn assert_ended(&self, code: i32, verdict: &str) {
        let found = (self.code, &self.product["verdict"]);
        assert_eq!(found, (Some(code), &Value::from(verdict)), "{} {}", self.stderr, self.notes());
    }

    /// A count of a stage; 0 if absent.
    #[must_use]
    pub fn count(&self, stage: &str, what: &str) -> u64 {
        self.product["quality"]["counts"][stage][what].as_u64().unwrap_or(0)
    }

    /// Epochs used, and rejected.
    ///
    /// # Panics
    /// There is no product.
    #[must_use]
    pub fn epochs(&self) -> (u64, u64) {
        let count = |key: &str| self.product[key].as_u64().unwrap_or_else(|| panic!("no {key}: {}", self.stderr));
        (count("epochs_used"), count("epochs_rejected"))
    }

    /// The notes of the product.
    #[must_use]
    pub fn notes(&self) -> String {
        self.product["quality"]["notes"].to_string()
    }
}
