//! What surrounds a command: log lines, hints, checks before the work, what is left after a failure.

use dragfree_tests::calibration::science_mode;
use dragfree_tests::{built, dragfree, expect, fixture, json, simulate};
use serde_json::Value;
use std::path::{Path, PathBuf};
use std::process::Command;

fn telemetry(folder: &Path) -> PathBuf {
    let telemetry = folder.join("telemetry");
    std::fs::create_dir(&telemetry).expect("writable");
    simulate(&telemetry, &["--hours", "0.5", "--seed", "3"]).remove(0)
}

fn stderr(command: &mut Command, code: i32) -> String {
    String::from_utf8_lossy(&expect(command, code).stderr).into_owned()
}

#[test]
fn log_lines_tell_what_runs() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let dir = dir.path();
    let file = telemetry(dir);
    let run = |flags: &[&str]| {
        let output = science_mode(dir).arg(&file).args(flags).output().expect("runs");
        assert!(matches!(output.status.code(), Some(0 | 4)), "{}", String::from_utf8_lossy(&output.stderr));
        String::from_utf8_lossy(&output.stderr).into_owned()
    };
    assert_eq!(run(&[]), "", "nothing is told where all is well");
    let told = run(&["-v"]);
    assert!(told.contains("INFO linked pipeline=\"science-mode\" mission=\"Taiji\" model=\"1\""), "{told}");
    assert!(told.contains("INFO archived id=\"COM1B_2035-01-01_SC1_01_0002\"") && !told.contains("DEBUG"), "{told}");
    let told = run(&["-vv"]);
    assert!(told.contains("DEBUG") && told.contains("plugin=\"es-akf\""), "{told}");
    let log = dir.join("log.jsonl");
    assert_eq!(run(&["--log-json", log.to_str().expect("text")]), "", "the file does not make the screen louder");
    let text = std::fs::read_to_string(&log).expect("a log");
    let lines: Vec<Value> = text.lines().map(|line| serde_json::from_str(line).expect("JSON")).collect();
    for (level, message) in [("DEBUG", "opened"), ("INFO", "linked"), ("INFO", "archived")] {
        let found = |line: &&Value| line["level"] == level && line["fields"]["message"] == message;
        let line = lines.iter().find(found).unwrap_or_else(|| panic!("no {level} {message}: {text}"));
        assert!(line["timestamp"].as_str().is_some_and(|time| time.ends_with('Z')), "{line}");
    }
    let nowhere = dir.join("no/such/folder/log.jsonl");
    let mut refused = dragfree(dir);
    let told = stderr(refused.args(["plugins", "list", "--log-json"]).arg(&nowhere), 1);
    assert!(told.contains("cannot write the log"), "{told}");
}

/// Compared with what `df` prints; what other programs write meanwhile is far below a hundredth of a disk.
#[cfg(target_os = "linux")]
#[test]
fn the_space_of_the_archive_is_told() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let dir = dir.path();
    let mut check = dragfree(dir);
    check.args(["config", "check"]).arg(fixture("pipelines/science-mode.toml")).args([
        "--archive",
        "not/yet",
        "--json",
    ]);
    let told = json(&mut check, 0)["free_bytes"].as_f64().expect("a number");
    let df = expect(Command::new("df").args(["--output=avail", "-B1"]).arg(dir), 0);
    let df = String::from_utf8_lossy(&df.stdout).lines().nth(1).and_then(|line| line.trim().parse::<f64>().ok());
    let df = df.expect("df tells a number");
    assert!((told / df - 1.0).abs() < 0.01, "{told} where df tells {df}");
}

/// A state that cannot be put in its place is an error before the day is read, and leaves nothing in the archive.
#[test]
fn a_state_that_cannot_be_saved_leaves_no_product() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let dir = dir.path();
    let file = telemetry(dir);
    std::fs::create_dir(dir.join("day.state")).expect("writable");
    let told = stderr(science_mode(dir).arg(&file).args(["--save-state", "day.state"]), 1);
    assert!(told.contains("cannot write the state day.state"), "{told}");
    assert!(!dir.join("archive").exists(), "nothing was begun");
}

#[test]
fn a_suggested_command_finds_the_same_archive_and_plugins() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let dir = dir.path();
    let file = telemetry(dir);
    let plugins = dir.join("my plugins");
    std::fs::create_dir(&plugins).expect("writable");
    let mut run = dragfree(dir);
    run.arg("run").arg(fixture("pipelines/science-mode.toml")).arg(&file).args([
        "--archive",
        "my archive",
        "--plugin-dir",
    ]);
    let output = run.arg(&plugins).output().expect("runs");
    let screen = String::from_utf8_lossy(&output.stdout).into_owned();
    let next = screen.lines().find_map(|line| line.strip_prefix("next      ")).unwrap_or_else(|| panic!("{screen}"));
    assert!(next.contains("--archive 'my archive' --plugin-dir '"), "{next}");
    let path = std::env::join_paths([built(), Path::new("/usr/bin"), Path::new("/bin")]).expect("a path");
    expect(Command::new("sh").current_dir(dir).env("PATH", path).args(["-c", next]), 0);
    std::fs::copy(fixture("models/com-offset.toml"), dir.join("m.toml")).expect("copied");
    let mut add = dragfree(dir);
    let screen = expect(add.args(["model", "add", "m.toml", "es-gain:tm1.y", "--plugin-dir"]).arg(&plugins), 0);
    let screen = String::from_utf8_lossy(&screen.stdout).into_owned();
    let next = screen.lines().find_map(|line| line.strip_prefix("next      ")).unwrap_or_else(|| panic!("{screen}"));
    assert!(next.ends_with(&format!("--model m.toml --plugin-dir '{}'", plugins.display())), "{next}");
}

/// What a run would refuse is refused when it is added, and the model stays as it was.
#[test]
fn an_effect_is_asked_before_it_is_added() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let dir = dir.path();
    let before = std::fs::read(fixture("models/com-offset.toml")).expect("readable");
    std::fs::write(dir.join("m.toml"), &before).expect("written");
    for (words, said) in [
        (&["es-gain:tm1.y", "--prior-sigma", "w=0.1"][..], "no coefficient `w`; it has y"),
        (
            &[
                "formula:tm1.x",
                "--set",
                "expression=nosuchfunction(",
                "--set",
                "unit=N",
                "--set",
                "acts_on=tm1.force.x",
            ][..],
            "formula",
        ),
        (&["thermal:tm1.x", "--set", "lag_s=long"][..], "lag_s"),
    ] {
        let told = stderr(dragfree(dir).args(["model", "add", "m.toml"]).args(words), 1);
        assert!(told.contains(said), "{words:?}: {told}");
        assert_eq!(std::fs::read(dir.join("m.toml")).expect("readable"), before, "{words:?}");
    }
    expect(dragfree(dir).args(["model", "add", "m.toml", "es-gain:tm1.y", "--prior-sigma", "y=0.1"]), 0);
}

/// `1` is the unit of a number in files; people are spared it.
#[test]
fn the_unit_of_a_number_is_not_told() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    dragfree_tests::compile_plugin(dir.path(), "c_plugins.c", "c_plugins", &[]);
    let mut inspect = dragfree(dir.path());
    let screen = expect(inspect.args(["plugins", "inspect", "c-scale", "--plugin-dir"]).arg(dir.path()), 0);
    let screen = String::from_utf8_lossy(&screen.stdout).into_owned();
    assert!(screen.lines().any(|line| line == "factor  f64"), "{screen}");
}
