//! Compiled plugins of border version 1 go on working: `tests/data/abi-v1/README.md`.
//!
//! The libraries are x86_64 Linux code, so nothing here is compiled elsewhere.
#![cfg(all(target_arch = "x86_64", target_os = "linux"))]

use dragfree_tests::calibration::{Run, of_pipeline};
use dragfree_tests::recording::Recording;
use dragfree_tests::{coefficient, dragfree, fixture, json, root, simulate};
use serde_json::Value;
use std::path::{Path, PathBuf};

/// Size and SHA-256 of what was committed: a rebuilt library would test the present SDK in place of version 1.
const LIBRARIES: [(&str, &str); 2] = [
    ("libv1_c.so", "c880c7030aba021cfd8b51360e721175d66d8b0b4b12d647870c50237add98a1"),
    ("libv1_rust.so", "0e5766244cc6d9efe07c3247a69bed3a2965df47d943b89ebcc3363894a10252"),
];

fn folder() -> PathBuf {
    root().join("tests/data/abi-v1")
}

#[test]
fn the_libraries_are_the_ones_of_version_1() {
    for (name, sha256) in LIBRARIES {
        let mut command = dragfree(Path::new("/"));
        let list = json(command.args(["plugins", "list", "--json", "--plugin-dir"]).arg(folder()), 0);
        let plugins = list["plugins"].as_array().expect("plugins");
        let of_library = |p: &&Value| p["path"].as_str().is_some_and(|path| path.ends_with(name));
        let found: Vec<_> = plugins.iter().filter(of_library).collect();
        assert_eq!(found.len(), 2, "{name}: a stage and an effect: {list:#}");
        for plugin in found {
            assert_eq!(plugin["sha256"], sha256, "{name} was rebuilt; restore it from the history of this file");
        }
    }
}

#[test]
fn a_version_1_manifest_is_read() {
    let mut inspect = dragfree(Path::new("/"));
    inspect.args(["plugins", "inspect", "v1-rust-scale", "--json", "--plugin-dir"]).arg(folder());
    let manifest = &json(&mut inspect, 0)["manifest"];
    let factor = &manifest["parameters"][0];
    assert_eq!((&factor["name"], &factor["type"], &factor["default"]), (&"factor".into(), &"f64".into(), &2.0.into()));
    assert_eq!((&factor["minimum"], &factor["maximum"]), (&(-1e3).into(), &1e3.into()));
}

#[test]
fn version_1_plugins_pass_the_validator() {
    for (name, _) in LIBRARIES {
        let mut validate = dragfree(Path::new("/"));
        let result = json(validate.args(["plugins", "validate", "--json"]).arg(folder().join(name)), 0);
        assert_eq!(result["passed"], true, "{result:#}");
        assert_eq!(result["plugins"].as_array().map(Vec::len), Some(2), "{result:#}");
    }
}

/// A pipeline of the science-mode stages and these two, the Rust stage behind both estimators so that it reads their
/// reports.
fn pipeline(folder: &Path) -> PathBuf {
    let mission = fixture("missions/taiji.toml").display().to_string();
    let stage = |plugin: &str, parameters: &str| format!("[[stage]]\nplugin = \"{plugin}\"\n{parameters}\n");
    let text = [
        format!("[pipeline]\nname = \"v1\"\nmission = '{mission}'\nmodel = 'model.toml'\n"),
        stage("preprocess", ""),
        stage("v1-c-scale", "parameters = { factor = 3.0 }"),
        stage("hinf-dfacs", ""),
        "[[stage]]\neffects = true\n".to_owned(),
        stage("es-akf", ""),
        stage("qp-check", ""),
        stage("v1-rust-scale", "parameters = { factor = -4.0 }"),
    ];
    let path = folder.join("pipeline.toml");
    std::fs::write(&path, text.concat()).expect("writable");
    path
}

/// Runs the pipeline with the offsets and one effect more.
fn calibrated(folder: &Path, file: &Path, id: &str, instance: &str, parameters: &str) -> Run {
    let effect = |id: &str, instance: &str| format!("[[effect]]\nid = \"{id}\"\ninstance = \"{instance}\"\n");
    let effects = [effect("com-offset", "tm1"), effect("com-offset", "tm2"), effect(id, instance)].concat();
    std::fs::write(folder.join("model.toml"), format!("[model]\nrevision = \"1\"\n{effects}{parameters}\n"))
        .expect("writable");
    let mut command = of_pipeline(folder, &pipeline(folder));
    let run = Run::of(command.arg(file).arg("--plugin-dir").arg(self::folder()));
    assert!(matches!(run.code, Some(0 | 4)), "{}", run.stderr);
    run
}

/// A gradient of 8e-9 m s⁻² K⁻¹ on 1.96 kg is simulated: the effect in Rust finds the force within 3σ and at more than
/// 10σ (false-alarm rate 0.3 %). The stage in Rust wrote its factor times the readout of the file, and read every
/// earlier report.
#[test]
fn a_version_1_plugin_in_rust_computes_what_it_did() {
    const SIZE_N_K: f64 = 8e-9 * 1.96;
    let dir = tempfile::tempdir().expect("a temporary folder");
    let dir = dir.path();
    let file = simulate(dir, &["--hours", "2", "--seed", "1", "--effect", "thermal:tm1.x=8e-9,lag_s=0"]).remove(0);
    let channels = "parameters = { channel = \"hk.eh1_xp_temperature_k\", reference = \"hk.eh1_xm_temperature_k\" }";
    let run = calibrated(dir, &file, "v1-rust-force", "tm1.x", channels);
    let (force, sigma) = coefficient(&run.product, "v1-rust-force.tm1.x", "qp");
    assert!((force - SIZE_N_K).abs() < 3.0 * sigma && force > 10.0 * sigma, "{force:e} ± {sigma:e} for {SIZE_N_K:e}");

    let recording = Recording::read(&file);
    let readouts = recording.messages().iter().filter(|message| &*message.topic == "/is");
    let readouts: Vec<f64> = readouts.map(|message| message.double(&[1, 1, 2]).unwrap_or(0.0)).collect();
    assert_eq!((readouts.len(), run.count("v1-rust-scale", "rows")), (72_000, 72_000));
    let said = &run.product["quality"]["stages"]["v1-rust-scale"];
    let expected: f64 = readouts.iter().map(|x| -4.0 * x).sum();
    let sum = said["sum_m"].as_f64().unwrap_or(f64::NAN);
    assert!((sum / expected - 1.0).abs() < 1e-12, "{sum:e} for {expected:e}");
    assert!(run.notes().contains("v1-rust-scale was here"), "{}", run.notes());
    let earlier = ["preprocess", "v1-c-scale", "hinf-dfacs", "es-akf", "qp-check"];
    assert_eq!(said["earlier_plugins"], serde_json::json!(earlier));
    let known = run.product["coefficients"].as_array().map_or(0, Vec::len);
    assert_eq!(said["earlier_coefficients"], known, "every estimate of the stages before it");
}

/// The flown gain is right, so the estimate by the effect in C lies within 5σ of zero (false-alarm rate 6e-7).
#[test]
fn a_version_1_plugin_in_c_computes_what_it_did() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let file = simulate(dir.path(), &["--hours", "0.5", "--seed", "11"]).remove(0);
    let run = calibrated(dir.path(), &file, "v1-c-es-gain", "tm1", "");
    let (gain, sigma) = coefficient(&run.product, "v1-c-es-gain.tm1.y", "qp");
    assert!(sigma > 0.0 && sigma < 0.3 && gain.abs() < 5.0 * sigma, "{gain} ± {sigma}");
    assert_eq!(run.count("v1-c-scale", "rows"), 18_000);
}
