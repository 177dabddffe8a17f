//! Coefficients of command regressors. The regression must condition on the same past data as the controller, or the
//! gain estimate is biased; both solutions must agree.

use dragfree_tests::calibration::{Run, of_pipeline};
use dragfree_tests::{coefficient, dragfree, expect, fixture};
use std::path::PathBuf;
use std::sync::OnceLock;
use tempfile::TempDir;

const HIDDEN: [(&str, f64); 3] = [("es-gain:tm1.y", 0.1), ("mps-gain:sc.y", 0.06), ("es-gain:tm2.z", 0.0)];

/// Telemetry and a model in a temporary folder.
type Prepared = (TempDir, PathBuf, PathBuf);

/// Six hours with the gains of [`HIDDEN`], and a model that estimates all of them; simulated once for all tests.
fn telemetry_and_model() -> &'static Prepared {
    static PREPARED: OnceLock<Prepared> = OnceLock::new();
    PREPARED.get_or_init(|| {
        let dir = tempfile::tempdir().expect("a temporary folder");
        let mut simulate = dragfree(dir.path());
        simulate.arg("simulate").arg(fixture("missions/taiji.toml"));
        simulate.args(["--out", "sc", "--hours", "6", "--seed", "21"]);
        let model = dir.path().join("model.toml");
        std::fs::copy(fixture("models/com-offset.toml"), &model).expect("writable");
        for (effect, value) in HIDDEN {
            if value != 0.0 {
                simulate.args(["--effect", &format!("{effect}={value}")]);
            }
            expect(dragfree(dir.path()).args(["model", "add"]).arg(&model).arg(effect), 0);
        }
        expect(&mut simulate, 0);
        let file = dir.path().join("sc/SC1_2035-01-01.mcap");
        (dir, file, model)
    })
}

/// Science mode with parameters of es-akf.
fn run(parameters: &str) -> Run {
    let (_, file, model) = telemetry_and_model();
    let dir = tempfile::tempdir().expect("a temporary folder");
    let text = std::fs::read_to_string(fixture("pipelines/science-mode.toml")).expect("readable");
    let stage = "plugin = \"es-akf\"";
    assert!(text.contains(stage));
    let text = text
        .replace("../", &format!("{}/", fixture("").display()))
        .replace(stage, &format!("{stage}\nparameters = {{ {parameters} }}"));
    let pipeline = dir.path().join("pipeline.toml");
    std::fs::write(&pipeline, text).expect("writable");
    Run::of(of_pipeline(dir.path(), &pipeline).arg(file).arg("--model").arg(model))
}

fn name(effect: &str) -> String {
    effect.replacen(':', ".", 1)
}

/// Three gains of two solutions within 4σ: false alarm 1 in 2600. Verdict: nine differences at 3σ and the survey, at
/// most 2.6 %.
#[test]
fn gains_are_right_in_both_solutions() {
    let together = run("");
    together.assert_ended(0, "agree");
    assert_eq!(together.product["quality"]["stages"]["es-akf"]["tm1"]["followed"], serde_json::json!(["tm1", "tm2"]));
    for (effect, truth) in HIDDEN {
        for solution in ["es-akf", "qp"] {
            let (value, sigma) = coefficient(&together.product, &name(effect), solution);
            assert!((value - truth).abs() < 4.0 * sigma, "{effect} by {solution}: {value} ± {sigma} for {truth}");
            // σ of 1 % for y and 2.5 % along z, which no interferometer reads.
            assert!(sigma < 0.03, "{effect} by {solution}: ± {sigma}");
        }
    }
}

/// Negative control: a filter per test mass biases the same gains, and the verdict reports it.
#[test]
fn separate_filters_per_test_mass_are_biased() {
    let apart = run("follow = \"each\"");
    apart.assert_ended(4, "disagree");
    for (effect, truth) in HIDDEN {
        let (value, sigma) = coefficient(&apart.product, &name(effect), "es-akf");
        assert!((value - truth).abs() > 8.0 * sigma, "{effect}: {value} ± {sigma} for {truth}");
    }
}
