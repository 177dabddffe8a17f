//! Files that change while a run reads them: a product names the bytes that it was made of, or there is none.

use dragfree_tests::{archived, dragfree, fixture, simulate};
use serde_json::Value;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::time::Duration;
use tempfile::TempDir;

/// A folder with three hours of telemetry and a mission file of its own.
fn bench() -> (TempDir, PathBuf, PathBuf) {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let telemetry = simulate(dir.path(), &["--hours", "3", "--seed", "41"]).remove(0);
    let mission = dir.path().join("mission.toml");
    std::fs::copy(fixture("missions/taiji.toml"), &mission).expect("copied");
    (dir, telemetry, mission)
}

/// Runs science mode, with `change` when every file was opened and the first rows are read.
fn changed(folder: &Path, telemetry: &Path, mission: &Path, change: impl FnOnce()) -> Output {
    let mut command: Command = dragfree(folder);
    command.arg("run").arg(fixture("pipelines/science-mode.toml")).arg(telemetry).arg("--mission").arg(mission);
    command.args(["--archive", "archive", "--json"]).stdout(Stdio::piped()).stderr(Stdio::piped());
    let staging = folder.join("archive/staging");
    let begun = || std::fs::read_dir(&staging).is_ok_and(|mut entries| entries.next().is_some());
    let child = command.spawn().expect("the program runs");
    while !begun() {
        std::thread::sleep(Duration::from_millis(1));
    }
    change();
    child.wait_with_output().expect("it ends")
}

/// Telemetry that was replaced gave rows of two files, under the digest of the second.
#[test]
fn telemetry_that_changes_during_a_run_refuses_the_product() {
    let (dir, telemetry, mission) = bench();
    let bytes = std::fs::read(&telemetry).expect("readable");
    let beside = dir.path().join("beside");
    let replace = || {
        std::fs::write(&beside, &bytes).expect("writable");
        std::fs::rename(&beside, &telemetry).expect("renamed");
    };
    let rewrite = || std::fs::write(&telemetry, &bytes).expect("writable");
    let changes: [&dyn Fn(); 2] = [&replace, &rewrite];
    for change in changes {
        let output = changed(dir.path(), &telemetry, &mission, change);
        let stderr = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(1), "{stderr}");
        assert!(stderr.contains("was changed while it was read"), "{stderr}");
        assert_eq!(archived(&dir.path().join("archive")), Vec::<String>::new());
    }
    let output = changed(dir.path(), &telemetry, &mission, || ());
    assert_eq!(output.status.code(), Some(0), "unchanged, it goes through");
}

/// A mission edited during a run was cited with a digest that was not used.
#[test]
fn a_mission_edited_during_a_run_is_named_as_it_was_read() {
    let (dir, telemetry, mission) = bench();
    let text = std::fs::read_to_string(&mission).expect("readable");
    let edited = text.replacen("mass_kg = 1500.0", "mass_kg = 1501.0", 1);
    assert_ne!(text, edited);
    let output = changed(dir.path(), &telemetry, &mission, || std::fs::write(&mission, &edited).expect("writable"));
    assert_eq!(output.status.code(), Some(0), "{}", String::from_utf8_lossy(&output.stderr));
    let product: Value = serde_json::from_slice(&output.stdout).expect("JSON");
    let inputs = product["inputs"].as_array().expect("inputs");
    let named = inputs.iter().find(|input| input["role"] == "mission").expect("a mission");
    std::fs::write(&mission, &text).expect("writable");
    let sum = Command::new("sha256sum").arg(&mission).output().expect("sha256sum runs");
    let sum = String::from_utf8_lossy(&sum.stdout).into_owned();
    assert!(named["sha256"].as_str().is_some_and(|sha256| sum.starts_with(sha256)), "{named} {sum}");
}
