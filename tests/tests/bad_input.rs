//! Bad input: an error or a counted warning, no loss of good data, no panic.

use dragfree_tests::recording::{Message, Recording};
use dragfree_tests::{dragfree, fixture, json, simulate};
use serde_json::Value;
use std::path::{Path, PathBuf};
use std::process::Output;
use std::sync::OnceLock;
use tempfile::TempDir;

const SECOND_NS: u64 = 1_000_000_000;

/// Three hours of telemetry, simulated once.
fn telemetry() -> &'static Path {
    static FILE: OnceLock<(TempDir, PathBuf)> = OnceLock::new();
    let (_, file) = FILE.get_or_init(|| {
        let dir = tempfile::tempdir().expect("a temporary folder");
        let file = simulate(dir.path(), &["--hours", "3", "--seed", "21"]).remove(0);
        (dir, file)
    });
    file
}

fn recording() -> &'static Recording {
    static RECORDING: OnceLock<Recording> = OnceLock::new();
    RECORDING.get_or_init(|| Recording::read(telemetry()))
}

/// Copies the telemetry through `change`.
fn rewrite(to: &Path, change: impl FnOnce(Vec<Message>) -> Vec<Message>) {
    recording().write_all(to, change(recording().messages().to_vec()));
}

struct Run {
    dir: TempDir,
    output: Output,
}

impl Run {
    fn code(&self) -> Option<i32> {
        self.output.status.code()
    }

    fn stderr(&self) -> String {
        String::from_utf8_lossy(&self.output.stderr).into_owned()
    }

    fn product(&self) -> Value {
        serde_json::from_slice(&self.output.stdout).unwrap_or_else(|e| panic!("{e}: {}", self.stderr()))
    }

    fn count(&self, stage: &str, what: &str) -> u64 {
        let product = self.product();
        let counts = &product["quality"]["counts"][stage];
        counts[what].as_u64().unwrap_or_else(|| panic!("no {stage}.{what} in {}", product["quality"]["counts"]))
    }

    fn archived(&self) -> usize {
        let entries = std::fs::read_dir(self.dir.path().join("archive")).into_iter().flatten().flatten();
        entries.filter(|e| e.path().extension().is_some_and(|x| x == "toml")).count()
    }
}

/// Runs science mode over files that `make` writes into a folder.
fn run(make: impl FnOnce(&Path) -> Vec<PathBuf>) -> Run {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let files = make(dir.path());
    let mut command = dragfree(dir.path());
    command.arg("run").arg(fixture("pipelines/science-mode.toml")).args(&files).args([
        "--archive",
        "archive",
        "--json",
    ]);
    let output = command.output().expect("the program runs");
    let run = Run { dir, output };
    assert!(!run.stderr().contains("panicked"), "{}", run.stderr());
    assert!(run.code().is_some(), "killed by a signal: {}", run.stderr());
    run
}

fn run_changed(change: impl FnOnce(Vec<Message>) -> Vec<Message>) -> Run {
    run(|dir| {
        let file = dir.join("changed.mcap");
        rewrite(&file, change);
        vec![file]
    })
}

/// The product of telemetry that nothing is wrong with.
fn reference() -> &'static Value {
    static REFERENCE: OnceLock<Value> = OnceLock::new();
    REFERENCE.get_or_init(|| {
        let run = run_changed(|messages| messages);
        assert_eq!(run.code(), Some(0), "{}", run.stderr());
        assert_eq!(run.archived(), 1);
        run.product()
    })
}

#[test]
fn unchanged_telemetry_is_the_reference() {
    let product = reference();
    assert_eq!(
        product["epochs_used"].as_u64().zip(product["epochs_rejected"].as_u64()),
        Some((108_000, 0)),
        "{product}"
    );
}

#[test]
fn a_truncated_file_gives_its_intact_chunks() {
    let run = run(|dir| {
        let bytes = std::fs::read(telemetry()).expect("readable");
        let file = dir.join("cut.mcap");
        std::fs::write(&file, &bytes[..bytes.len() * 7 / 10]).expect("writable");
        vec![file]
    });
    assert_eq!(run.code(), Some(3), "{}", run.stderr());
    assert_eq!(run.archived(), 1);
    assert_eq!(run.count("replay", "truncated_files"), 1);
    let used = run.product()["epochs_used"].as_u64().expect("a count");
    assert!((60_000..80_000).contains(&used), "seven tenths of 108,000, less a chunk: {used}");
}

#[test]
fn flipped_bits_lose_one_chunk() {
    let run = run(|dir| {
        let mut bytes = std::fs::read(telemetry()).expect("readable");
        let summary = mcap::Summary::read(&bytes).expect("an MCAP file").expect("a summary");
        let chunk = &summary.chunk_indexes[summary.chunk_indexes.len() / 2];
        let middle = usize::try_from(chunk.chunk_start_offset + chunk.chunk_length / 2).expect("a place in the file");
        for byte in &mut bytes[middle..middle + 8] {
            *byte ^= 0x55;
        }
        let file = dir.join("flipped.mcap");
        std::fs::write(&file, bytes).expect("writable");
        vec![file]
    });
    assert_eq!(run.code(), Some(3), "{}", run.stderr());
    assert_eq!(run.count("replay", "corrupt_chunks"), 1);
    let used = run.product()["epochs_used"].as_u64().expect("a count");
    assert!(used > 80_000, "one chunk of about 1 MiB: {used}");
}

#[test]
fn a_missing_topic_is_named() {
    for topic in ["is", "dws"] {
        let run = run_changed(|m| m.into_iter().filter(|m| *m.topic != *format!("/{topic}")).collect());
        assert_eq!(run.code(), Some(1), "{topic}");
        assert!(run.stderr().contains(topic), "{}", run.stderr());
        assert_eq!(run.archived(), 0);
    }
}

/// Telemetry at 1 Hz under a mission of 10 Hz: "36,000 epochs used", every adopted value null, and exit code 0.
#[test]
fn a_run_that_adopts_nothing_is_a_loss() {
    let run = run_changed(|messages| {
        let start = messages[0].log_time;
        messages.into_iter().filter(|m| (m.log_time - start).is_multiple_of(SECOND_NS)).collect()
    });
    assert_eq!(run.code(), Some(3), "{}", run.stderr());
    let product = run.product();
    let adopted = product["coefficients"].as_array().expect("coefficients").iter().filter(|c| c["role"] == "adopted");
    assert!(adopted.clone().count() == 6 && adopted.clone().all(|c| c["value"].is_null()), "{product}");
    let losses = product["losses"].as_array().expect("losses");
    assert!(losses.iter().any(|l| l["kind"] == "values_not_adopted" && l["count"] == 6), "{losses:?}");
}

/// Replaces the doubles of a message by NaN: all fields of `InertialSensors` but status.
fn poison(message: &mut Message) {
    // Wire: tm1 { r_orf_m { x y z } … }: tags and lengths, then 9 = field 1, fixed64.
    let mut i = 0;
    while i + 9 <= message.data.len() {
        if matches!(message.data[i], 0x09 | 0x11 | 0x19) {
            message.data[i + 1..i + 9].copy_from_slice(&f64::NAN.to_le_bytes());
            i += 9;
        } else {
            i += 1;
        }
    }
}

#[test]
fn nan_is_rejected_epoch_by_epoch_and_counted() {
    let run = run_changed(|mut messages| {
        messages.iter_mut().filter(|m| &*m.topic == "/is").skip(5_000).step_by(1_000).take(20).for_each(poison);
        messages
    });
    assert!(matches!(run.code(), Some(0 | 3)), "{}", run.stderr());
    let product = run.product();
    assert_eq!(product["epochs_rejected"].as_u64(), Some(20), "{product}");
}

#[test]
fn a_gap_of_an_hour_rejects_its_epochs() {
    let run = run_changed(|messages| {
        let start = messages[0].log_time + 3_000 * SECOND_NS;
        messages.into_iter().filter(|m| !(start..start + 3_600 * SECOND_NS).contains(&m.log_time)).collect()
    });
    assert!(matches!(run.code(), Some(0 | 3)), "{}", run.stderr());
    let product = run.product();
    assert_eq!(product["epochs_used"].as_u64(), Some(72_000), "{product}");
    assert_eq!(product["epochs_rejected"].as_u64(), Some(36_000), "{product}");
}

#[test]
fn duplicates_change_nothing() {
    let doubled = run_changed(|m| m.into_iter().flat_map(|m| [m.clone(), m]).collect());
    assert_eq!(doubled.code(), Some(0), "{}", doubled.stderr());
    assert!(doubled.count("replay", "duplicate_messages") >= 4 * 108_000);
    assert_eq!(doubled.product()["coefficients"], reference()["coefficients"]);
}

#[test]
fn overlapping_files_in_any_order_are_merged() {
    let parts = run(|dir| {
        let cut = |m: &[Message], a: u64, b: u64| {
            let t0 = m[0].log_time;
            m.iter().filter(|m| (t0 + a * SECOND_NS..t0 + b * SECOND_NS).contains(&m.log_time)).cloned().collect()
        };
        let (late, early) = (dir.join("a.mcap"), dir.join("b.mcap"));
        rewrite(&late, |m| cut(&m, 5_000, 20_000));
        rewrite(&early, |m| cut(&m, 0, 6_000));
        vec![late, early]
    });
    assert_eq!(parts.code(), Some(0), "{}", parts.stderr());
    assert_eq!(parts.product()["coefficients"], reference()["coefficients"]);
}

#[test]
fn an_unsorted_file_is_sorted() {
    let shuffled = run_changed(|mut messages| {
        // Neighbouring messages swap within windows of seconds.
        for block in messages.chunks_mut(200) {
            block.reverse();
        }
        messages
    });
    assert_eq!(shuffled.code(), Some(0), "{}", shuffled.stderr());
    assert_eq!(shuffled.product()["coefficients"], reference()["coefficients"]);
}

#[test]
fn empty_and_foreign_files_are_reported() {
    for (content, said) in [(&b""[..], "empty"), (b"this is no telemetry at all, but a text\n", "MCAP")] {
        let run = run(|dir| {
            let file = dir.join("strange.mcap");
            std::fs::write(&file, content).expect("writable");
            vec![file]
        });
        assert_eq!(run.code(), Some(1));
        assert!(run.stderr().contains("strange.mcap") && run.stderr().contains(said), "{}", run.stderr());
        assert_eq!(run.archived(), 0);
    }
}

#[test]
fn a_wrong_mission_file_is_refused_with_its_key() {
    let taiji = std::fs::read_to_string(fixture("missions/taiji.toml")).expect("readable");
    for (from, to, said) in [
        ("mass_kg = 1500.0", "mass_kg = 1500.0\ncolour = 3", "colour"),
        ("mass_kg = 1500.0", "mass_g = 1.5e6", "mass_g"),
        ("mass_kg = 1500.0", "mass_kg = 0.0", "mass_kg"),
        ("mass_kg = 1500.0", "mass_kg = \"heavy\"", "heavy"),
        ("[800.0, 13.0, 10.0]", "[800.0, 14.0, 10.0]", "symmetric"),
        ("asd_n_rthz = 1e-7 ", "asd_n_rthz = -1e-7 ", "asd_n_rthz"),
        ("asd_n_rthz = 1e-7 ", "asd_m_s2_rthz = 1e-7 ", "asd_m_s2_rthz"),
    ] {
        assert!(taiji.contains(from), "{from}");
        let dir = tempfile::tempdir().expect("a temporary folder");
        let mission = dir.path().join("mission.toml");
        std::fs::write(&mission, taiji.replacen(from, to, 1)).expect("writable");
        let mut command = dragfree(dir.path());
        command.arg("run").arg(fixture("pipelines/science-mode.toml")).arg(telemetry());
        let output = command.args(["--archive", "archive", "--mission"]).arg(&mission).output().expect("runs");
        let stderr = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(1), "{to}: {stderr}");
        assert!(stderr.contains(said), "{to} should say {said}: {stderr}");
    }
}

#[test]
fn telemetry_of_another_spacecraft_is_refused() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let taiji = std::fs::read_to_string(fixture("missions/taiji.toml")).expect("readable");
    let mission = dir.path().join("mission.toml");
    std::fs::write(&mission, taiji.replacen("\"SC1\"", "\"SC2\"", 1)).expect("writable");
    let mut command = dragfree(dir.path());
    command.arg("run").arg(fixture("pipelines/science-mode.toml")).arg(telemetry()).arg("--mission").arg(&mission);
    let output = command.args(["--archive", "archive"]).output().expect("runs");
    let stderr = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{stderr}");
    assert!(stderr.contains("SC1") && stderr.contains("SC2"), "{stderr}");
}

#[test]
fn a_time_window_selects_data_or_reports_that_none_are_left() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let base = |arguments: &[&str]| {
        let mut command = dragfree(dir.path());
        command.arg("run").arg(fixture("pipelines/science-mode.toml")).arg(telemetry()).args([
            "--archive",
            "archive",
            "--json",
        ]);
        command.args(arguments);
        command
    };
    let product = json(&mut base(&["--from", "2035-01-01T01:00:00Z", "--until", "2035-01-01T02:30:00Z"]), 0);
    assert_eq!(product["epochs_used"].as_u64(), Some(54_000), "{product}");
    let output = base(&["--from", "2036-01-01"]).output().expect("runs");
    assert_eq!(output.status.code(), Some(1));
}
