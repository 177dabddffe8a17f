//! Effects of the environment, end to end: a calibration whose model contains the simulated effect recovers size and
//! offset.

use dragfree_tests::{coefficient, dragfree, fixture, json, simulate};
use serde_json::Value;
use std::fmt::Write;
use std::path::Path;
use tempfile::TempDir;

/// The offsets of the paper's Table tab:com_calibration_results, m, of the axes that six hours show.
const OFFSETS_M: [(&str, f64); 4] = [
    ("com-offset.tm1.y", 0.155_384_572_681_198_96),
    ("com-offset.tm1.z", 0.0),
    ("com-offset.tm2.y", -0.155_384_572_681_198_96),
    ("com-offset.tm2.z", 0.0),
];

/// One effect of a model: id, instance, lines of its parameters.
type Entry<'a> = (&'a str, &'a str, &'a str);

fn model(folder: &Path, effects: &[Entry<'_>]) -> std::path::PathBuf {
    let mut text = std::fs::read_to_string(fixture("models/com-offset.toml")).expect("the fixture is there");
    for (id, instance, parameters) in effects {
        let _ =
            write!(text, "\n[[effect]]\nid = \"{id}\"\ninstance = \"{instance}\"\n[effect.parameters]\n{parameters}\n");
    }
    let path = folder.join("model.toml");
    std::fs::write(&path, text).expect("writable");
    path
}

/// Product of six hours (seed 5, chosen before the first run) with effects in the truth and effects in the model.
fn calibrated(truth: &[&str], effects: &[Entry<'_>]) -> Value {
    let dir: TempDir = tempfile::tempdir().expect("a temporary folder");
    let mut arguments = vec!["--hours", "6", "--seed", "5"];
    truth.iter().for_each(|effect| arguments.extend(["--effect", effect]));
    let file = simulate(dir.path(), &arguments).remove(0);
    // Segments of 1.75 hours: slow causes lie below the lowest bins of the default segments.
    let text = std::fs::read_to_string(fixture("pipelines/science-mode.toml")).expect("readable");
    let text = text.replace("../", &format!("{}/", fixture("").display()));
    let long = "plugin = \"qp-check\"\nparameters = { segment_s = 6553.6 }";
    let pipeline = dir.path().join("pipeline.toml");
    std::fs::write(&pipeline, text.replace("plugin = \"qp-check\"", long)).expect("writable");
    let mut run = dragfree(dir.path());
    run.arg("run").arg(pipeline).arg(file).args(["--archive", "archive", "--json"]);
    json(run.arg("--model").arg(model(dir.path(), effects)), 0)
}

/// Within 4σ of the truth (false alarm 6e-5 each); the size is such that a wrong sign is 16σ and a missing effect 8σ
/// off.
fn found(product: &Value, name: &str, truth: f64) {
    let (value, sigma) = coefficient(product, name, "qp");
    let pull = (value - truth) / sigma;
    assert!(pull.abs() <= 4.0, "{name}: {value:e} ± {sigma:e}, {pull:.2}σ from {truth:e}");
    assert!(truth.abs() > 8.0 * sigma, "{name}: {truth:e} is not seen with ±{sigma:e}");
}

fn offsets_found(product: &Value) {
    for (name, truth_m) in OFFSETS_M {
        for solution in ["es-akf", "qp"] {
            let (value, sigma) = coefficient(product, name, solution);
            let pull = (value - truth_m) / sigma;
            assert!(pull.abs() <= 4.0, "{name} by {solution}: {value} ± {sigma} m, {pull:.2}σ from the truth");
        }
    }
}

/// Thermal force on one test mass, charge on the other.
#[test]
fn thermal_and_charge_coefficients_are_recovered() {
    let product = calibrated(
        &["thermal:tm1.x=8e-10,lag_s=480", "charge:tm2=0.5"],
        &[
            (
                "thermal",
                "tm1.x",
                "plus = \"hk.eh1_xp_temperature_k\"\nminus = \"hk.eh1_xm_temperature_k\"\nlag_s = 480.0",
            ),
            ("charge", "tm2", "charge = \"hk.tm2_charge_c\""),
        ],
    );
    found(&product, "thermal.tm1.x", 8e-10);
    found(&product, "charge.tm2", 0.5);
    offsets_found(&product);
}

/// Slosh, and a force that no bundled effect covers, by a formula. The slug is 3 % of the spacecraft, 3/97 of the rest;
/// its resonance with the spacecraft free is higher by 1/√0.97.
#[test]
fn slosh_and_formula_coefficients_are_recovered() {
    let formula = "acts_on = \"tm1.accel.y\"\nexpression = \"lag(hk.battery_current_a ^ 2, 50)\"\nunit = \"m s-2 A-2\"\n\
                   range = [-5e-12, 5e-12]";
    let raised = 0.97_f64.sqrt();
    let slosh = format!("f0_hz = {}\nzeta = {}", 0.2 / raised, 0.05 / raised);
    let product = calibrated(
        &["slosh:sc.y=0.03,f0_hz=0.2,zeta=0.05", "current-force:tm1.y=5e-13,lag_s=50"],
        &[("slosh", "sc.y", &slosh), ("formula", "battery", formula)],
    );
    found(&product, "slosh.sc.y", 0.03 / 0.97);
    found(&product, "formula.battery", 5e-13);
    offsets_found(&product);
}
