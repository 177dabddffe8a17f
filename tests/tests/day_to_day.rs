//! A state carried over midnight gives the results of one long run, and unfitting states are refused.

use dragfree_tests::{built, coefficient, dragfree, fixture, json, simulate};
use serde_json::Value;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::OnceLock;
use std::time::Duration;
use tempfile::TempDir;

struct Telemetry {
    _dir: TempDir,
    /// Three hours before midnight and three hours after it.
    days: [PathBuf; 2],
    /// Product of one run over both.
    long: Value,
}

fn telemetry() -> &'static Telemetry {
    static TELEMETRY: OnceLock<Telemetry> = OnceLock::new();
    TELEMETRY.get_or_init(|| {
        let dir = tempfile::tempdir().expect("a temporary folder");
        let files = simulate(dir.path(), &["--start", "2035-01-01T21:00:00Z", "--hours", "6", "--seed", "1"]);
        let days: [PathBuf; 2] = files.try_into().expect("one file a day");
        let mut command = run(dir.path(), &[]);
        let long = json(command.args(&days), 0);
        Telemetry { _dir: dir, days, long }
    })
}

fn run(folder: &Path, arguments: &[&str]) -> Command {
    with_program(dragfree(folder), arguments)
}

fn with_program(mut program: Command, arguments: &[&str]) -> Command {
    program.arg("run").arg(fixture("pipelines/science-mode.toml")).args(["--archive", "archive", "--json"]);
    program.args(arguments);
    program
}

/// The first day, its state in `state`.
fn first_day(folder: &Path) -> Value {
    json(run(folder, &["--save-state", "state"]).arg(&telemetry().days[0]), 0)
}

/// Every value, σ and covariance to 1e-12 of its size.
fn assert_same(product: &Value, long: &Value) {
    let coefficients = long["coefficients"].as_array().expect("coefficients");
    assert_eq!(coefficients.len(), 18, "six by three solutions");
    let close = |a: &Value, b: &Value, what: &str| {
        let (a, b) = (a.as_f64().expect("a number"), b.as_f64().expect("a number"));
        assert!((a - b).abs() <= 1e-12 * b.abs(), "{what}: {a:e} day by day, {b:e} in one run");
    };
    for (a, b) in product["coefficients"].as_array().expect("coefficients").iter().zip(coefficients) {
        assert_eq!((&a["name"], &a["solution"]), (&b["name"], &b["solution"]));
        close(&a["value"], &b["value"], &b["name"].to_string());
        close(&a["sigma"], &b["sigma"], &b["name"].to_string());
    }
    for solution in ["es-akf", "qp", "adopted"] {
        let rows = |p: &Value| -> Vec<Value> {
            let rows = p["covariance"][solution].as_array().expect("a matrix").iter();
            rows.flat_map(|row| row.as_array().expect("a row").clone()).collect()
        };
        let (a, b) = (rows(product), rows(long));
        assert_eq!((a.len(), b.len()), (36, 36), "{solution}");
        a.iter().zip(&b).for_each(|(a, b)| close(a, b, solution));
    }
    for key in ["verdict", "epochs_used", "epochs_rejected"] {
        assert_eq!(product[key], long[key], "{key}");
    }
    for key in ["chi2_per_dof", "nis"] {
        close(&product[key], &long[key], key);
    }
}

#[test]
fn two_days_with_a_state_equal_one_long_run() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let first = first_day(dir.path());
    let second = json(run(dir.path(), &["--load-state", "state"]).arg(&telemetry().days[1]), 0);
    assert_same(&second, &telemetry().long);
    assert_eq!(first["day"], "2035-01-01");
    assert_eq!(second["day"], "2035-01-02");
    // Negative control: either day alone gives another result.
    let alone = json(run(dir.path(), &[]).arg(&telemetry().days[1]), 0);
    for product in [&first, &alone] {
        let of = |p: &Value| coefficient(p, "com-offset.tm1.y", "qp").1;
        assert!(of(product) > 1.2 * of(&telemetry().long), "half of the data: σ grows by √2");
    }
}

/// One state file, loaded and saved every day, with all files at hand as arguments.
#[test]
fn one_state_file_serves_every_day_and_old_files_are_ignored() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    first_day(dir.path());
    let mut second = run(dir.path(), &["--load-state", "state", "--save-state", "state"]);
    assert_same(&json(second.args(&telemetry().days), 0), &telemetry().long);
    // No new data is an error, not an empty product.
    let output = run(dir.path(), &["--load-state", "state"]).args(&telemetry().days).output().expect("runs");
    assert_eq!(output.status.code(), Some(1), "{}", String::from_utf8_lossy(&output.stderr));
    assert_eq!(products(dir.path()), 2);
}

fn products(folder: &Path) -> usize {
    let entries = std::fs::read_dir(folder.join("archive")).into_iter().flatten().flatten();
    entries.filter(|e| e.path().extension().is_some_and(|x| x == "toml")).count()
}

/// After a kill at any time the second day can be run again: the state is yesterday's or today's, complete, and today's
/// only once the product is archived.
#[test]
fn an_interrupted_day_can_be_run_again() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    first_day(dir.path());
    let yesterday = std::fs::read(dir.path().join("state")).expect("a state");
    for pause_ms in [5, 100, 300, 1000, 3000] {
        let mut second = run(dir.path(), &["--load-state", "state", "--save-state", "state"]);
        let mut child = second.arg(&telemetry().days[1]).stdout(Stdio::null()).spawn().expect("runs");
        std::thread::sleep(Duration::from_millis(pause_ms));
        child.kill().expect("it can be killed");
        child.wait().expect("it ends");
        if std::fs::read(dir.path().join("state")).expect("a state") != yesterday {
            assert!(products(dir.path()) >= 2, "today's state without today's product");
            std::fs::write(dir.path().join("state"), &yesterday).expect("writable");
        }
    }
    let second =
        json(run(dir.path(), &["--load-state", "state", "--save-state", "state"]).arg(&telemetry().days[1]), 0);
    assert_same(&second, &telemetry().long);
}

/// The second day must be refused with a sentence that has these words, and leave nothing.
fn assert_refused(folder: &Path, mut second: Command, words: &[&str]) {
    let before = products(folder);
    let output = second.arg(&telemetry().days[1]).output().expect("runs");
    let stderr = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{stderr}");
    assert!(words.iter().all(|w| stderr.contains(w)) && !stderr.contains("panicked"), "{words:?}: {stderr}");
    assert_eq!(products(folder), before);
}

#[test]
fn a_damaged_state_is_refused() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    first_day(dir.path());
    let sound = std::fs::read(dir.path().join("state")).expect("a state");
    let damage = |name: &str, bytes: &[u8], word: &str| {
        std::fs::write(dir.path().join(name), bytes).expect("writable");
        assert_refused(dir.path(), run(dir.path(), &["--load-state", name]), &[word]);
    };
    for at in [20, sound.len() / 3, sound.len() - 40] {
        let mut bytes = sound.clone();
        bytes[at] ^= 0x10;
        damage("flipped", &bytes, "digest");
    }
    damage("cut", &sound[..sound.len() * 9 / 10], "digest");
    damage("longer", &[&sound[..], b"more"].concat(), "digest");
    damage("empty", b"", "too short");
    damage("older", &[b"DFSTATE2", &sound[8..]].concat(), "older version of the program");
    damage("other", &std::fs::read(fixture("missions/taiji.toml")).expect("readable"), "no state");
    assert_refused(dir.path(), run(dir.path(), &["--load-state", "nowhere"]), &["nowhere"]);
}

/// A state belongs to its mission, model and plugins; the error names what differs.
#[test]
fn a_state_of_another_mission_model_or_plugin_is_refused() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    first_day(dir.path());
    let changed = |name: &str, file: &str, from: &str, to: &str| {
        let text = std::fs::read_to_string(fixture(file)).expect("readable");
        assert!(text.contains(from), "{from}");
        std::fs::write(dir.path().join(name), text.replacen(from, to, 1)).expect("writable");
    };
    changed("mission.toml", "missions/taiji.toml", "baseline_tolerance_m = 2e-5", "baseline_tolerance_m = 3e-5");
    let second = run(dir.path(), &["--load-state", "state", "--mission", "mission.toml"]);
    assert_refused(dir.path(), second, &["mission", "replay from the start"]);

    changed(
        "model.toml",
        "models/com-offset.toml",
        "estimate = true",
        "estimate = true\n[effect.prior.x]\nsigma = 1e-3",
    );
    let second = run(dir.path(), &["--load-state", "state", "--model", "model.toml"]);
    assert_refused(dir.path(), second, &["model", "replay from the start"]);

    // A rebuilt plugin: bytes appended to a library change its digest only.
    let programs = dir.path().join("programs");
    std::fs::create_dir(&programs).expect("writable");
    let wanted =
        |name: &str| name.starts_with(std::env::consts::DLL_PREFIX) && name.ends_with(std::env::consts::DLL_SUFFIX);
    for entry in std::fs::read_dir(built()).expect("the build's folder").flatten() {
        let name = entry.file_name().to_string_lossy().into_owned();
        let is_program = name == format!("dragfree{}", std::env::consts::EXE_SUFFIX);
        if is_program || wanted(&name) && !name.ends_with(".rlib") {
            std::fs::copy(entry.path(), programs.join(&name)).expect("copied");
        }
    }
    let library = format!("{}dragfree_es_akf{}", std::env::consts::DLL_PREFIX, std::env::consts::DLL_SUFFIX);
    let mut bytes = std::fs::read(programs.join(&library)).expect("a library");
    bytes.push(0);
    std::fs::write(programs.join(&library), bytes).expect("writable");
    let mut program = Command::new(programs.join(format!("dragfree{}", std::env::consts::EXE_SUFFIX)));
    program.current_dir(dir.path()).env_remove("DRAGFREE_PLUGIN_PATH").env("NO_COLOR", "1");
    let second = with_program(program, &["--load-state", "state"]);
    assert_refused(dir.path(), second, &["another build of plugin es-akf", "replay from the start"]);
}

/// A missing day is a gap: the carried state gives the same as one run over both days.
#[test]
fn a_missing_day_is_a_gap() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let day = |name: &str, start: &str, seed: &str| {
        let folder = dir.path().join(name);
        std::fs::create_dir(&folder).expect("writable");
        simulate(&folder, &["--start", start, "--hours", "3", "--seed", seed]).remove(0)
    };
    let (first, third) = (day("first", "2035-01-01T06:00:00Z", "2"), day("third", "2035-01-03T06:00:00Z", "3"));
    let long = json(run(dir.path(), &[]).args([&first, &third]), 0);
    json(run(dir.path(), &["--save-state", "state"]).arg(&first), 0);
    let carried = json(run(dir.path(), &["--load-state", "state"]).arg(&third), 0);
    assert_same(&carried, &long);
    let counts = &long["quality"]["counts"]["preprocess"];
    assert_eq!(counts["grid.cut_gaps"], 1, "{counts}");
    assert_eq!(long["epochs_used"], 216_000);
    let notes = long["quality"]["notes"].to_string();
    assert!(notes.contains("omitted from the grid, the longest 162000.1 s"), "{notes}");
    assert_eq!(long["verdict"], "agree", "{notes}");
}
