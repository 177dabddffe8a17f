//! `dragfree compare` on telemetry whose hidden cause no input of the program contains.

use dragfree_tests::calibration::science_mode;
use dragfree_tests::{dragfree, simulate};
use serde_json::Value;
use std::path::Path;

const PRODUCT: &str = "COM1B_2035-01-01_SC1_01_0001";

/// Simulates and calibrates three hours in `folder`.
fn calibrate(folder: &Path, arguments: &[&str]) {
    let file = simulate(folder, &[&["--hours", "3"], arguments].concat()).remove(0);
    // The truth is removed before the telemetry is read.
    std::fs::remove_dir_all(folder.join("truth")).expect("removable");
    let run = science_mode(folder).arg(&file).output().expect("runs");
    assert!(matches!(run.status.code(), Some(0 | 4)), "{}", String::from_utf8_lossy(&run.stderr));
}

fn compare(folder: &Path, arguments: &[&str], code: i32) -> String {
    let mut command = dragfree(folder);
    command.args(["compare", PRODUCT, "--archive", "archive", "-q"]).args(arguments);
    String::from_utf8(dragfree_tests::expect(&mut command, code).stdout).expect("UTF-8")
}

fn channels(comparison: &Value) -> &Vec<Value> {
    comparison["channels"].as_array().expect("channels")
}

/// Names of failed tests.
fn failing(comparison: &Value) -> Vec<&str> {
    let fails = channels(comparison).iter().filter(|c| c["passes"] == false);
    fails.map(|c| c["name"].as_str().expect("a name")).collect()
}

/// The page is self-contained: no script, no link but the name space of SVG, no file; a picture per question.
fn self_contained(page: &str) {
    assert!(page.starts_with("<!DOCTYPE html>") && page.trim_end().ends_with("</html>"));
    for forbidden in ["<script", "<link", "<img", "<iframe", "@import", "url(", "src=", "<?xml"] {
        assert!(!page.contains(forbidden), "{forbidden}");
    }
    let grammar = "xmlns=\"http://www.w3.org/2000/svg\"";
    assert_eq!(page.matches("http").count(), page.matches(grammar).count());
    assert_eq!((page.matches("<svg").count(), page.matches("</svg>").count()), (5, 5));
    for name in ["tm1.accel.y", "common.sc.y", "null.sc.y"] {
        // The table, and one panel a picture.
        assert!(page.matches(name).count() >= 5, "{name}");
    }
    for tag in ["table", "h2", "p", "td", "tr", "div", "g", "html", "body", "head", "style", "title"] {
        let (opened, closed) = (format!("<{tag}"), format!("</{tag}>"));
        let is_tag = |rest: &&str| rest.starts_with([' ', '>']);
        let opened = page.split(&opened).skip(1).filter(is_tag).count();
        // HTML lets cells of a table end where the next begins.
        assert!(tag == "td" || opened == page.matches(&closed).count(), "<{tag}>: {opened}");
    }
}

/// Without a hidden effect everything passes (false alarm 1 %), and each channel's power equals the mission's noise
/// within its uncertainty.
#[test]
fn a_right_model_passes_in_every_channel() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    calibrate(dir.path(), &["--seed", "11"]);
    let c: Value = serde_json::from_str(&compare(dir.path(), &["--json"], 0)).expect("JSON");
    assert_eq!((&c["verdict"], failing(&c)), (&"passes".into(), vec![]));
    assert_eq!(channels(&c).len(), 15);
    for channel in channels(&c) {
        let (ratio, dof) = (channel["chi2_per_dof"].as_f64().expect("a ratio"), channel["dof"].as_f64().expect("dof"));
        assert!((ratio - 1.0).abs() < 5.0 * (2.0 / dof).sqrt() && dof > 9e4, "{} {ratio} {dof}", channel["name"]);
        assert_eq!(channel["tests"].as_array().expect("tests").len(), 5);
        // Of 128 ratios 6 ± 2.5 are expected outside their 95 % intervals; 18 is nearly 5σ.
        let inside = |i: usize| {
            let r = channel["measured_psd"][i].as_f64()? / channel["predicted_psd"][i].as_f64()?;
            let [low, high] = [0, 1].map(|k| channel["interval_95"][i][k].as_f64());
            Some((low?..=high?).contains(&r))
        };
        let bands = channel["frequency_hz"].as_array().expect("frequencies").len();
        let outside = (0..bands).filter(|i| inside(*i) == Some(false)).count();
        assert!(outside <= 18, "{}: {outside} of {bands}", channel["name"]);
    }
    assert_eq!(c["hours_ns"].as_array().expect("hours").len(), 3);
    assert_eq!(c["nis"]["passes"], true);
    // False alarms: 1 % for each of the two families of tests.
    let innovations = c["innovations"].as_array().expect("innovations");
    assert!(innovations.len() == 6 && innovations.iter().all(|i| i["passes"] == true), "{innovations:#?}");
    assert_eq!(c["together"], Value::Array(Vec::new()));
    let screen = compare(dir.path(), &[], 0);
    assert!(screen.lines().all(|line| line.chars().count() <= 80), "{screen}");
}

/// Thrusters 30 % too weak along y: the channels of y and the common combination fail; attitude, x, z, the null
/// combinations and the filter's statistics pass.
#[test]
fn a_wrong_spacecraft_force_fails_except_in_null_combinations() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    calibrate(dir.path(), &["--seed", "12", "--effect", "mps-gain:sc.y=-0.3"]);
    let c: Value = serde_json::from_str(&compare(dir.path(), &["--json"], 4)).expect("JSON");
    let failing = failing(&c);
    for name in ["tm1.accel.y", "tm2.accel.y", "common.sc.y"] {
        assert!(failing.contains(&name), "{failing:?}");
    }
    let innocent = ["tm1.accel.z", "tm2.accel.z", "sc.alpha", "common.sc.x", "common.sc.z", "null"];
    assert!(!failing.iter().any(|name| innocent.iter().any(|i| name.starts_with(i))), "{failing:?}");
    let y = channels(&c).iter().find(|c| c["name"] == "common.sc.y").expect("there");
    assert!(y["unexplained"].as_f64() > Some(0.1));
    assert_eq!(c["nis"]["passes"], true);
    let screen = compare(dir.path(), &["--page", "page.html"], 4);
    self_contained(&std::fs::read_to_string(dir.path().join("page.html")).expect("a page"));
    assert!(screen.contains("no pass") && screen.contains("the null combinations pass"), "{screen}");
    assert!(screen.lines().all(|line| line.chars().count() <= 80), "{screen}");
}

/// A readout with 1.5 times its noise is no force on the spacecraft, so the null combinations fail.
#[test]
fn a_noisy_readout_fails_in_the_null_combinations() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    calibrate(dir.path(), &["--seed", "13", "--effect", "is-noise:tm2.z=1.5"]);
    let c: Value = serde_json::from_str(&compare(dir.path(), &["--json"], 4)).expect("JSON");
    let failing = failing(&c);
    assert!(failing.contains(&"tm2.accel.z") && failing.contains(&"null.sc.z"), "{failing:?}");
    assert!(!failing.iter().any(|name| name.starts_with("tm1") || name.ends_with('x')), "{failing:?}");
    let coloured = c["innovations"].as_array().expect("innovations").iter().filter(|i| i["passes"] == false);
    assert_eq!(coloured.map(|i| i["readout"].as_str()).collect::<Vec<_>>(), [Some("tm2.z")]);
    // Only the level fails.
    let z = channels(&c).iter().find(|c| c["name"] == "tm2.accel.z").expect("there");
    let [ratio, fitted] = ["chi2_per_dof", "chi2_per_dof_fitted_levels"].map(|k| z[k].as_f64().expect("a ratio"));
    assert!(ratio > 1.5 && (fitted - 1.0).abs() < 0.03, "{ratio} {fitted}");
}

/// Half an hour is too little: an error, not a result.
#[test]
fn a_comparison_of_too_little_data_is_refused() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let file = simulate(dir.path(), &["--hours", "0.75", "--seed", "1"]).remove(0);
    science_mode(dir.path()).arg(&file).output().expect("runs");
    let mut command = dragfree(dir.path());
    let output = command.args(["compare", PRODUCT, "--archive", "archive"]).output().expect("runs");
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.code() == Some(1) && said.contains("a comparison needs at least"), "{said}");
}
