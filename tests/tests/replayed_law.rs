//! The control law replayed from telemetry, compared with the flown one.

use dragfree_tests::{dragfree, fixture, json, simulate};
use serde_json::Value;
use std::path::Path;

/// The science pipeline with a settling time longer than the law's memory.
fn pipeline(folder: &Path) -> std::path::PathBuf {
    let text = std::fs::read_to_string(fixture("pipelines/science-mode.toml")).expect("the fixture is there");
    let fixtures = fixture("");
    let text = text
        .replace("../", &format!("{}/", fixtures.display()))
        .replace("plugin = \"hinf-dfacs\"", "plugin = \"hinf-dfacs\"\nparameters = { warm_up_s = 4800.0 }");
    let path = folder.join("pipeline.toml");
    std::fs::write(&path, text).expect("writable");
    path
}

fn run(folder: &Path, files: &[std::path::PathBuf], mission: Option<&Path>, code: i32) -> Value {
    let mut command = dragfree(folder);
    command.arg("run").arg(pipeline(folder)).args(files).args(["--archive", "archive", "--json"]);
    if let Some(mission) = mission {
        command.arg("--mission").arg(mission);
    }
    json(&mut command, code)
}

fn notes(product: &Value) -> String {
    product["quality"]["notes"].to_string()
}

/// The replay starts from zero and reads telemetry through `preprocess`; after its memory it equals the flown commands
/// to 1e-9 in each of six vectors.
#[test]
fn rebuilt_commands_equal_the_flown_ones() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let files = simulate(dir.path(), &["--hours", "2"]);
    let product = run(dir.path(), &files, None, 0);
    let replay = &product["quality"]["stages"]["hinf-dfacs"]["command_replay"];
    assert!(replay["samples"].as_u64().is_some_and(|n| n >= 20_000), "{}", product["quality"]);
    for (vector, flown) in replay["rms_flown"].as_object().expect("six vectors") {
        let part = |key: &str| replay[key][vector].as_f64().expect("a number") / flown.as_f64().expect("a number");
        let distance = part("rms_distance").hypot(part("mean_distance"));
        assert!(distance < 1e-9, "{vector}: {distance} of the flown command");
    }
    assert!(!notes(&product).contains("another controller"), "{}", notes(&product));
}
