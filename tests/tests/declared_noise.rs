//! A stage that the workspace did not build makes channels of its own and declares their noise; `qp-check` weighs them
//! by it.

use dragfree_tests::{coefficient, compile_plugin, dragfree, expect, fixture, json, simulate};
use serde_json::Value;
use std::f64::consts::PI;
use std::process::Command;

/// What the stage in C makes: own noise of x, common acceleration, readout of y, known series (ASD), gain of the
/// series.
const OWN: f64 = 3e-10;
const COMMON: f64 = 4e-10;
const READOUT: f64 = 1e-12;
const SERIES: f64 = 1e-9;
const GAIN: f64 = 2.0;
const DT_S: f64 = 0.1;
const DURATION_S: f64 = 1800.0;

/// Standard deviations at which a test fails: a false alarm in 6e-5.
const SIGMAS: f64 = 4.0;

/// Half an hour of epochs, and the stage with these parameters; the telemetry gives nothing but its times.
fn run(parameters: &str) -> (tempfile::TempDir, Command) {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let folder = dir.path();
    compile_plugin(folder, "noise_stage.c", "noise_stage", &[]);
    let telemetry = simulate(folder, &["--hours", "0.5", "--seed", "3"]).remove(0);
    let pipeline = format!(
        "[pipeline]\nname = \"gauge\"\nmission = '{}'\nmodel = 'model.toml'\n[[stage]]\nplugin = \"preprocess\"\n[[stage]]\n\
         plugin = \"c-gauge\"\nparameters = {{ {parameters} }}\n[[stage]]\neffects = true\n[[stage]]\nplugin = \"qp-check\"\n\
         parameters = {{ segment_s = 102.4 }}\n",
        fixture("missions/taiji.toml").display()
    );
    std::fs::write(folder.join("pipeline.toml"), pipeline).expect("writable");
    let model = "[model]\nrevision = \"1\"\n[[effect]]\nid = \"c-gauge-gain\"\n";
    std::fs::write(folder.join("model.toml"), model).expect("writable");
    let mut command = dragfree(folder);
    command.args(["run", "pipeline.toml"]).arg(telemetry).args(["--archive", "archive", "--json", "--plugin-dir"]);
    command.arg(folder);
    (dir, command)
}

/// Amplitude of the residuals over the declared one, and the degrees of freedom behind it.
fn measured_over_declared(product: &Value, channel: &str) -> (f64, f64) {
    let channels = product["quality"]["stages"]["qp-check"]["channels"].as_array().expect("channels");
    let one = channels.iter().find(|c| c["channel"] == channel).unwrap_or_else(|| panic!("no {channel}: {product}"));
    let number = |key: &str| one[key].as_f64().expect("a number");
    (number("measured_over_modelled"), number("dof"))
}

/// The mean over frequencies up to Nyquist, by the midpoint rule.
fn mean(of: impl Fn(f64) -> f64) -> f64 {
    let n = 10_000;
    (0..n).map(|k| of(0.5 / DT_S * (f64::from(k) + 0.5) / f64::from(n))).sum::<f64>() / f64::from(n)
}

/// Power of the common acceleration and of the readout at a frequency, as channels see them: cos² and (4 sin²/dt²)².
fn common_and_readout(hz: f64) -> [f64; 2] {
    let (sin, cos) = (PI * hz * DT_S).sin_cos();
    [(COMMON * cos).powi(2), (READOUT * 4.0 * sin * sin / (DT_S * DT_S)).powi(2)]
}

/// True power of a channel of the stage at a frequency.
fn power(channel: &str, hz: f64) -> f64 {
    let [common, readout] = common_and_readout(hz);
    if channel == "gauge.x" { OWN.powi(2) + common } else { 0.64 * common + readout }
}

/// Largest relative error of a measured power that noise alone makes: the bins of a band are added up with their own
/// powers, at worst all in one band, where the variance is `Σ S² / (Σ S)²` in place of that of χ².
fn largest_error(channel: &str, dof: f64) -> f64 {
    let scatter = mean(|hz| power(channel, hz).powi(2)).sqrt() / mean(|hz| power(channel, hz));
    SIGMAS * scatter * (2.0 / dof).sqrt()
}

/// χ² against the declared noise is that of its degrees of freedom, of each channel and of both together; the gain is
/// found, with the σ that the Fisher information gives when y tells of the common noise in x.
#[test]
fn a_stage_in_c_is_weighed_by_the_noise_that_it_declares() {
    let (_dir, mut command) = run("");
    let product = json(&mut command, 0);
    let dof = product["quality"]["stages"]["qp-check"]["dof"].as_f64().expect("dof");
    let chi2 = product["quality"]["chi2_per_dof"].as_f64().expect("χ²");
    assert!(dof > 20_000.0 && (chi2 - 1.0).abs() < SIGMAS * (2.0 / dof).sqrt(), "χ²/dof {chi2} on {dof}");
    for channel in ["gauge.x", "gauge.y"] {
        let (ratio, dof) = measured_over_declared(&product, channel);
        assert!((ratio.powi(2) - 1.0).abs() < largest_error(channel, dof), "{channel}: {ratio} on {dof}");
    }
    let information = |y_is_used: f64| {
        let per_hz = |hz: f64| {
            let [common, readout] = common_and_readout(hz);
            let told = y_is_used * (0.8 * common).powi(2) / (0.64 * common + readout);
            SERIES.powi(2) / (OWN.powi(2) + common - told)
        };
        2.0 * DURATION_S * mean(per_hz) * 0.5 / DT_S
    };
    let (value, sigma) = coefficient(&product, "c-gauge-gain.x", "qp");
    let (best, alone) = (information(1.0).powf(-0.5), information(0.0).powf(-0.5));
    assert!(alone > 1.2 * best, "y is worth something: {alone} {best}");
    assert!((sigma / best - 1.0).abs() < 0.08, "σ {sigma}, information bound {best}");
    assert!((value - GAIN).abs() < SIGMAS * sigma, "{value} ± {sigma}");
    let (value, sigma) = coefficient(&product, "c-gauge-gain.y", "qp");
    assert!((value - GAIN).abs() < SIGMAS * sigma, "{value} ± {sigma}");
}

/// Twin: x's own noise is declared twice too loud. The measured amplitude over the declared one says so, and χ² with
/// it.
#[test]
fn a_level_that_is_declared_wrong_is_seen() {
    let (_dir, mut command) = run("level = 2.0");
    let product = json(&mut command, 0);
    let (ratio, dof) = measured_over_declared(&product, "gauge.x");
    let expected = mean(|hz| {
        let common = common_and_readout(hz)[0];
        (OWN.powi(2) + common) / (4.0 * OWN.powi(2) + common)
    });
    let bound = largest_error("gauge.x", dof);
    assert!((ratio.powi(2) / expected - 1.0).abs() < bound, "{ratio}, {}", expected.sqrt());
    let (other, dof) = measured_over_declared(&product, "gauge.y");
    assert!((other.powi(2) - 1.0).abs() < largest_error("gauge.y", dof), "{other}");
    let chi2 = product["quality"]["chi2_per_dof"].as_f64().expect("χ²");
    assert!(chi2 < 0.8, "{chi2}");
}

#[test]
fn a_declaration_that_cannot_be_used_is_refused_with_the_name_of_the_plugin() {
    for (fault, words) in [
        ("channel", &["gauge:own", "gauge.w"][..]),
        ("number", &["gauge.x", "out of range"][..]),
        ("size", &["gauge:common", "gauge.y"][..]),
    ] {
        let (dir, mut command) = run(&format!("fault = \"{fault}\""));
        let stderr = String::from_utf8_lossy(&expect(&mut command, 1).stderr).into_owned();
        for word in words.iter().chain(&["c-gauge"]) {
            assert!(stderr.contains(word), "{fault} should name {word}: {stderr}");
        }
        assert!(!dir.path().join("archive").exists(), "a failed run leaves nothing");
    }
}
