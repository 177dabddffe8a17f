//! Every recursive solution takes part in the verdict, whatever stage brings it.

use dragfree_tests::calibration::{Run, TRUTH_M, of_pipeline};
use dragfree_tests::{compile_plugin, fixture, simulate};
use serde_json::Value;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;
use tempfile::TempDir;

const NAME: &str = "com-offset.tm1.y";
const SIGMA_M: f64 = 1e-3;

/// Two hours of telemetry, made once.
fn telemetry() -> &'static Path {
    static FILE: OnceLock<(TempDir, PathBuf)> = OnceLock::new();
    let (_, file) = FILE.get_or_init(|| {
        let dir = tempfile::tempdir().expect("a temporary folder");
        let file = simulate(dir.path(), &["--hours", "2", "--seed", "5"]).remove(0);
        (dir, file)
    });
    file
}

/// Science mode with a stage in C whose recursive solution is `off_m` away from the truth; `without` es-akf or with it.
fn run(off_m: f64, without_es_akf: bool) -> Run {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let (_, truth_m) = TRUTH_M.into_iter().find(|(name, _)| *name == NAME).expect("a truth");
    let defines = [format!("-DOFFSET_M={}", truth_m + off_m), format!("-DSIGMA_M={SIGMA_M}")];
    compile_plugin(dir.path(), "recursive_solution.c", "recursive_solution", &defines.each_ref().map(String::as_str));
    let text = std::fs::read_to_string(fixture("pipelines/science-mode.toml")).expect("readable");
    let filter = "[[stage]]\nplugin = \"es-akf\"\n";
    assert!(text.contains(filter));
    let stages = format!("{}[[stage]]\nplugin = \"c-recursive\"\n", if without_es_akf { "" } else { filter });
    let text = text.replace("../", &format!("{}/", fixture("").display())).replace(filter, &stages);
    let pipeline = dir.path().join("pipeline.toml");
    std::fs::write(&pipeline, text).expect("writable");
    let mut command = of_pipeline(dir.path(), &pipeline);
    command.arg(telemetry()).arg("--plugin-dir").arg(dir.path()).arg("--plugin-dir").arg(dragfree_tests::built());
    Run::of(&mut command)
}

/// The recursive solutions with which the batch solution was compared in [`NAME`].
fn compared(run: &Run) -> Vec<&str> {
    let all = run.product["quality"]["stages"]["qp-check"]["differences"].as_array().expect("a list");
    all.iter().filter(|d| d["name"] == NAME).map(|d| d["recursive"].as_str().expect("a name")).collect()
}

/// Seven differences at 3σ and the survey: a false alarm in 2 % of seeds at most.
#[test]
fn a_right_recursive_solution_agrees() {
    let both = run(0.0, false);
    both.assert_ended(0, "agree");
    assert_eq!(compared(&both), ["c-recursive", "es-akf"]);
    let roles: Vec<(&Value, &Value)> = both.product["coefficients"]
        .as_array()
        .into_iter()
        .flatten()
        .filter(|c| c["name"] == NAME)
        .map(|c| (&c["solution"], &c["role"]))
        .collect();
    for expected in [("es-akf", "recursive"), ("c-recursive", "recursive"), ("qp", "batch"), ("adopted", "adopted")] {
        assert!(roles.contains(&(&expected.0.into(), &expected.1.into())), "{expected:?} among {roles:?}");
    }
    let alone = run(0.0, true);
    alone.assert_ended(0, "agree");
    assert_eq!(compared(&alone), ["c-recursive"]);
}

/// Five centimetres off, tens of σ: the verdict names the solution, and not es-akf.
#[test]
fn a_wrong_recursive_solution_disagrees_by_name() {
    let wrong = run(0.05, false);
    wrong.assert_ended(4, "disagree");
    let notes = wrong.notes();
    assert!(notes.contains(&format!("{NAME}: qp − c-recursive")) && !notes.contains("qp − es-akf"), "{notes}");
}
