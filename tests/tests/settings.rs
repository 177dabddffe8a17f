//! Thresholds in a pipeline file's table `[settings]`: stages decide by them, a product stores them, and `compare`
//! takes them from there.

use dragfree_tests::{dragfree, expect, fixture, json, simulate};
use serde_json::Value;
use std::path::Path;

/// Calibrates with the bundled chain and these settings; what `run` prints.
fn calibrate(folder: &Path, telemetry: &Path, settings: &str, code: i32) -> Value {
    let bundled = std::fs::read_to_string(fixture("pipelines/science-mode.toml")).expect("a pipeline");
    let pipeline = bundled.replace("\"../", &format!("\"{}/", fixture("").display())) + "\n[settings]\n" + settings;
    std::fs::write(folder.join("pipeline.toml"), pipeline).expect("writable");
    let mut run = dragfree(folder);
    run.args(["run", "pipeline.toml"]).arg(telemetry).args(["--archive", "archive", "--json", "-q"]);
    json(&mut run, code)
}

fn stored(folder: &Path, product: &Value) -> toml::Table {
    let path = folder.join(product["path"].as_str().expect("a path"));
    let product: toml::Table = std::fs::read_to_string(path).expect("a product").parse().expect("TOML");
    product["settings"].as_table().expect("settings").clone()
}

/// Half an hour has one segment of the length that a comparison needs four of, and its two solutions agree within 3σ:
/// with other thresholds a comparison is made, and the same values disagree.
#[test]
fn thresholds_of_a_pipeline_are_used_and_stored() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let folder = dir.path();
    let telemetry = simulate(folder, &["--hours", "0.5", "--seed", "3"]).remove(0);
    let compare = |product: &Value| {
        let id = product["id"].as_str().expect("an id");
        dragfree(folder).args(["compare", id, "--archive", "archive", "-q"]).output().expect("runs")
    };

    let default = calibrate(folder, &telemetry, "", 0);
    assert_eq!(stored(folder, &default)["agreement_sigmas"].as_float(), Some(3.0));
    let told = compare(&default);
    assert!(told.status.code() == Some(1) && String::from_utf8_lossy(&told.stderr).contains("at least 4 × 1638 s"));

    let other = calibrate(folder, &telemetry, "agreement_sigmas = 1e-3\nmin_segments = 0.25\n", 4);
    assert_eq!((&default["verdict"], &other["verdict"]), (&Value::from("agree"), &Value::from("disagree")));
    let settings = stored(folder, &other);
    assert_eq!(settings["agreement_sigmas"].as_float(), Some(1e-3));
    assert_eq!(settings["false_alarm"].as_float(), Some(0.01), "the others are stored too");
    let told = compare(&other);
    assert!(matches!(told.status.code(), Some(0 | 4)), "{told:?}");
}

#[test]
fn a_setting_that_does_not_exist_or_is_no_size_is_refused() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    for (settings, words) in [
        ("agreement_sigma = 3.0", &["no `agreement_sigma`", "agreement_sigmas"][..]),
        ("agreement_sigmas = -3", &["agreement_sigmas = -3", "above zero"]),
        ("agreement_sigmas = \"three\"", &["agreement_sigmas = \"three\"", "above zero"]),
        ("max_added = 1.5", &["max_added"]),
    ] {
        let path = dir.path().join("pipeline.toml");
        let text = "[pipeline]\nname = \"p\"\n[[stage]]\nplugin = \"preprocess\"\n[settings]\n".to_owned() + settings;
        std::fs::write(&path, text).expect("writable");
        let mut check = dragfree(dir.path());
        check.args(["config", "check"]).arg(&path).args(["--mission", "taiji"]);
        let told = String::from_utf8_lossy(&expect(&mut check, 1).stderr).into_owned();
        assert!(words.iter().all(|word| told.contains(word)), "{settings}: {told}");
    }
}
