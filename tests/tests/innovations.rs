//! `dragfree diagnose --decide-by innovations` on simulated telemetry.

use dragfree_tests::calibration::science_mode;
use dragfree_tests::{dragfree, expect, simulate};
use serde_json::Value;

/// Simulates without keeping the truth, calibrates and diagnoses.
fn diagnosis(arguments: &[&str]) -> Value {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let file = simulate(folder.path(), arguments).remove(0);
    std::fs::remove_dir_all(folder.path().join("truth")).expect("removable");
    let run = science_mode(folder.path()).arg(&file).output().expect("runs");
    let product: Value = serde_json::from_slice(&run.stdout).expect("a product as JSON");
    let id = product["id"].as_str().expect("an id");
    let mut command = dragfree(folder.path());
    command.args(["diagnose", id, "--archive", "archive", "--json", "-q", "--decide-by", "innovations"]);
    let output = command.output().expect("the program runs");
    let d: Value = serde_json::from_slice(&output.stdout)
        .unwrap_or_else(|e| panic!("{e}: {}", String::from_utf8_lossy(&output.stderr)));
    assert_eq!(d["decided_by"], "innovations");
    assert_eq!(output.status.code(), Some(if d["verdict"] == "sufficient" { 0 } else { 4 }), "{}", d["verdict"]);
    d
}

/// The only accepted candidate, with its value within 4σ of `truth` (false alarm 6e-5), and its confounders.
fn named_alone(d: &Value, truth: f64) -> (String, String) {
    let all = d["candidates"].as_array().expect("a list").iter().filter(|c| c["accepted"] == true).collect::<Vec<_>>();
    let [one] = all[..] else { panic!("{all:#?}") };
    let (value, sigma) = (one["value"].as_f64().expect("a value"), one["sigma"].as_f64().expect("a sigma"));
    assert!((value - truth).abs() < 4.0 * sigma && sigma < 0.25 * truth.abs(), "{value} ± {sigma}");
    let name = format!("{}:{}", one["effect"].as_str().unwrap_or("?"), one["instance"].as_str().unwrap_or("?"));
    (name, one["confounders"].to_string())
}

/// Nothing hidden, nothing named (false alarm 1 %), every gain with a limit above zero.
#[test]
fn a_sufficient_model_is_called_sufficient() {
    let d = diagnosis(&["--hours", "3", "--seed", "11"]);
    assert_eq!(d["verdict"], "sufficient", "{:#} {:#}", d["candidates"][0], d["unexplained"]);
    let limits = d["upper_limits"].as_array().expect("limits");
    let gains = limits.iter().filter(|l| l["effect"] == "es-gain");
    assert_eq!(gains.filter(|l| l["limit_95"].as_f64().is_some_and(|x| x > 0.0 && x <= 0.6)).count(), 4);
}

/// A gain of the thrusters, in the loop, alone and with its size.
#[test]
fn a_gain_in_the_loop_is_named_alone() {
    let d = diagnosis(&["--hours", "6", "--seed", "77", "--effect", "mps-gain:sc.y=0.1"]);
    assert_eq!(named_alone(&d, 0.1).0, "mps-gain:sc.y");
}

/// A scale of a readout is confounded with the gain of the electrodes along y, and with nothing of the other test mass.
#[test]
fn a_scale_is_named_with_its_confounder() {
    let d = diagnosis(&["--hours", "7", "--seed", "31", "--effect", "is-scale:tm2.y=0.05"]);
    let (name, confounders) = named_alone(&d, 0.05);
    let pair = ["is-scale:tm2.y", "es-gain:tm2.y"];
    let other = pair.iter().find(|other| **other != name).expect("two names");
    assert!(pair.contains(&&*name) && confounders.contains(other) && !confounders.contains("tm1"), "{confounders}");
}

/// A slosh filters the thrusters' noise: alone, with the size that its filter gives.
#[test]
fn an_effect_that_filters_noise_is_named_alone() {
    let d = diagnosis(&["--hours", "3", "--seed", "15", "--effect", "slosh:sc.y=0.05,f0_hz=0.065,zeta=0.02"]);
    // The slug's mass relative to the rest.
    assert_eq!(named_alone(&d, 0.05 / 0.95).0, "slosh:sc.y");
}

/// Torques twice as loud as declared: a level, and no effect beside it.
#[test]
fn a_louder_noise_is_named_alone() {
    let d = diagnosis(&["--hours", "3", "--seed", "16", "--effect", "torque-noise:sc.z=2"]);
    assert_eq!(named_alone(&d, 2.0).0, "torque-noise:sc.z");
}

/// An input of another judge is a mistake of the command line.
#[test]
fn another_judge_is_refused() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let refused = expect(dragfree(folder.path()).args(["diagnose", "X", "--decide-by", "lots"]), 2);
    let said = String::from_utf8_lossy(&refused.stderr);
    assert!(said.contains("innovations") && said.contains("spectra"), "{said}");
}
