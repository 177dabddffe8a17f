//! Simulated effects that the model contains: both solutions recover the size, and the offsets stay right.
//!
//! Truth and model share no code: the former acts on states inside the loop, the latter uses telemetry. Six hours of
//! the default mission, seed 1, chosen before the first run; sizes exceed 8σ.
//!
//! **False alarms**: everything is required within 4σ (6e-5 each); with coefficients, six offsets and two solutions
//! below 1.2e-3 per test.

use dragfree_tests::{coefficient, dragfree, fixture, json, simulate};
use serde_json::Value;

const SIGMAS: f64 = 4.0;
/// Minimum significance for the test to detect a wrong sign or factor.
const SIGNIFICANCE: f64 = 8.0;

/// The offsets of the paper's Table tab:com_calibration_results, m.
const OFFSETS_M: [(&str, f64); 6] = [
    ("com-offset.tm1.x", 0.090_866_025_403_784_44),
    ("com-offset.tm1.y", 0.155_384_572_681_198_96),
    ("com-offset.tm1.z", 0.0),
    ("com-offset.tm2.x", 0.090_866_025_403_784_44),
    ("com-offset.tm2.y", -0.155_384_572_681_198_96),
    ("com-offset.tm2.z", 0.0),
];

/// Six hours with effects, calibrated by a model that has offsets and these effects.
fn calibrated(effects: &[(&str, &str, f64)]) -> Value {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let asked: Vec<String> = effects.iter().map(|(id, instance, size)| format!("{id}:{instance}={size}")).collect();
    let mut arguments = vec!["--hours", "6", "--seed", "1"];
    asked.iter().for_each(|one| arguments.extend(["--effect", one]));
    let files = simulate(dir.path(), &arguments);
    let mut model = "[model]\nrevision = \"1\"\n".to_owned();
    let offsets = [("com-offset", "tm1"), ("com-offset", "tm2")];
    for (id, instance) in offsets.into_iter().chain(effects.iter().map(|(id, instance, _)| (*id, *instance))) {
        model += &format!("[[effect]]\nid = \"{id}\"\ninstance = \"{instance}\"\nestimate = true\n");
    }
    let path = dir.path().join("model.toml");
    std::fs::write(&path, model).expect("writable");
    let mut command = dragfree(dir.path());
    command.arg("run").arg(fixture("pipelines/science-mode.toml")).args(&files).arg("--model").arg(&path);
    json(command.args(["--archive", "archive", "--json"]), 0)
}

/// Asserts that both methods recover the sizes, agree, and give the right offsets.
fn recovers(effects: &[(&str, &str, f64)], by: &[&str]) {
    let product = calibrated(effects);
    let mut report = String::new();
    let mut sound = true;
    let mut within = |name: &str, truth: f64, solution: &str, least: f64| {
        let (value, sigma) = coefficient(&product, name, solution);
        let good = sigma > 0.0 && (value - truth).abs() <= SIGMAS * sigma && truth.abs() >= least * sigma;
        sound &= good;
        report += &format!(
            "{name} by {solution}: {value:.5} ± {sigma:.5}, truth {truth:.5}{}\n",
            if good { "" } else { " !" }
        );
        (value, sigma)
    };
    for (id, instance, size) in effects {
        let name = format!("{id}.{instance}");
        let found: Vec<(f64, f64)> = by.iter().map(|solution| within(&name, *size, solution, SIGNIFICANCE)).collect();
        if let [(a, sa), (b, sb)] = found[..] {
            assert!((a - b).abs() <= SIGMAS * sa.hypot(sb), "{name}: {a} ± {sa} and {b} ± {sb}");
        }
    }
    for (name, truth_m) in OFFSETS_M {
        for solution in ["qp", "es-akf"] {
            within(name, truth_m, solution, 0.0);
        }
    }
    assert!(sound, "\n{report}{}", product["quality"]["notes"]);
    assert_ne!(product["verdict"], "disagree", "\n{report}{}", product["quality"]["notes"]);
}

const BOTH: [&str; 2] = ["qp", "es-akf"];

#[test]
fn crosstalk_of_electrodes_and_of_a_readout_is_recovered() {
    recovers(&[("es-crosstalk", "tm1.z-x", 0.03), ("is-crosstalk", "tm2.y-z", 0.15)], &BOTH);
}

#[test]
fn a_thruster_tilt_is_recovered() {
    recovers(&[("mps-tilt", "sc.x", 0.05)], &BOTH);
}

/// Visible in the attitude channels, which the filter does not use.
#[test]
fn an_attitude_delay_is_recovered() {
    recovers(&[("time-offset", "dws", 0.09)], &["qp"]);
}
