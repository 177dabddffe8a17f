//! Unusable housekeeping and candidates: each is reported, and the rest of the diagnosis is unaffected.

use dragfree_tests::calibration::{diagnose, science_mode};
use dragfree_tests::recording::Recording;
use dragfree_tests::{dragfree, expect, simulate};
use serde_json::Value;
use std::path::Path;

/// Length of the telemetry, h.
const HOURS: f64 = 3.0;

/// Calibrates a file with a model, by default the pipeline's, and diagnoses the product.
fn diagnosed(folder: &Path, telemetry: &Path, model: Option<&Path>) -> Value {
    let mut run = science_mode(folder);
    run.arg(telemetry);
    if let Some(model) = model {
        run.arg("--model").arg(model);
    }
    let product: Value = serde_json::from_slice(&run.output().expect("runs").stdout).expect("a product as JSON");
    diagnose(folder, &product)
}

/// One channel has a gap of an hour, another is stuck, a third has every sixth packet. The gap is reported, the stuck
/// channel has no form, the slow one is used, nothing is accepted (false alarm 1 %), and all numbers are finite.
#[test]
fn housekeeping_with_gaps_stuck_or_slow() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let hours = HOURS.to_string();
    let file = simulate(folder.path(), &["--hours", &hours, "--seed", "21"]).remove(0);
    std::fs::remove_dir_all(folder.path().join("truth")).expect("removable");
    let recording = Recording::read(&file);
    let start_ns = recording.start_ns();
    let mut packets = 0_u32;
    let mut hanging = None;
    recording.write(&file, |mut message| match &*message.topic {
        "/hk/eh1_xp_temperature_k" => {
            let hour = message.log_time.saturating_sub(start_ns) / 3_600_000_000_000;
            (hour != 1).then_some(message)
        }
        "/hk/antenna_move_flag" => {
            let data = hanging.get_or_insert_with(|| message.data.clone());
            message.data.clone_from(data);
            Some(message)
        }
        "/hk/tm1_charge_c" => {
            packets += 1;
            (packets % 6 == 1).then_some(message)
        }
        _ => Some(message),
    });
    let d = diagnosed(folder.path(), &file, None);
    assert_eq!(d["verdict"], "sufficient", "{:#}", d["candidates"][0]);
    let gap = d["not_tried"]
        .as_array()
        .expect("a list")
        .iter()
        .find(|pair| pair[0].as_str().is_some_and(|name| name.contains("eh1_xp_temperature_k")));
    let gap = gap.expect("the gap is told")[1].as_str().expect("a sentence");
    assert!(gap.contains("no value in") && gap.contains("left out"), "{gap}");
    // All other temperatures are used, and the slow charge.
    let limits = d["upper_limits"].as_array().expect("limits");
    let of = |effect: &str| limits.iter().filter(|l| l["effect"] == effect).collect::<Vec<_>>();
    let uses = |l: &Value, column: &str| l["shape"].as_object().is_some_and(|s| s.values().any(|v| v == column));
    let thermal = of("thermal");
    // A lag that is longer than the gap of an hour bridges it.
    let bridged = |l: &Value| l["shape"]["lag_s"].as_f64() > Some(3600.0);
    let usable = thermal.iter().all(|l| !uses(l, "hk.eh1_xp_temperature_k") || bridged(l));
    assert!(!thermal.is_empty() && usable, "{thermal:#?}");
    assert_eq!(of("charge").len(), 2);
    // A constant flag has no steps.
    assert!(of("impulse").iter().all(|l| !uses(l, "hk.antenna_move_flag")), "{:?}", of("impulse"));
    for l in limits {
        assert!(l["limit_95"].is_f64() && l["sigma"].is_f64(), "{l}");
    }
}

/// The model contains a candidate's series under another name but for a thousandth of its power: the second gain of
/// that electrode is not accepted, its σ shows the collinearity, and the other test mass's gain is unaffected.
#[test]
fn a_candidate_collinear_with_the_model() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let hours = HOURS.to_string();
    let file = simulate(folder.path(), &["--hours", &hours, "--seed", "22"]).remove(0);
    std::fs::remove_dir_all(folder.path().join("truth")).expect("removable");
    let model = folder.path().join("model.toml");
    let offsets = ["tm1", "tm2"].map(|tm| format!("[[effect]]\nid = \"com-offset\"\ninstance = \"{tm}\"\n")).concat();
    let formula =
        "acts_on = \"tm2.force.y\"\nexpression = \"command.tm2.force.y\"\nunit = \"1\"\nrange = [-0.5, 0.5]\n";
    let mine = format!("[[effect]]\nid = \"formula\"\ninstance = \"mine\"\n[effect.parameters]\n{formula}");
    std::fs::write(&model, format!("[model]\nrevision = \"1\"\n{offsets}{mine}")).expect("writable");
    let d = diagnosed(folder.path(), &file, Some(&model));
    assert!(d["candidates"].as_array().expect("a list").iter().all(|c| c["accepted"] == false));
    let limits = d["upper_limits"].as_array().expect("limits");
    let sigma = |at: &str| {
        let own = limits.iter().find(|l| l["effect"] == "es-gain" && l["instance"] == at);
        own.and_then(|l| l["sigma"].as_f64())
    };
    let (same, other) = (sigma("tm2.y"), sigma("tm1.y").expect("the other gain has a limit"));
    assert!(same.is_none_or(|sigma| sigma > 10.0 * other), "{same:?} and {other}");
}

/// What the stages make is kept in a file from pass to pass. The answer is the same, to the last digit, where there
/// is no room for it, with gaps in the telemetry and whatever the sizes of batches.
#[test]
fn a_diagnosis_without_room_for_its_rows_says_the_same() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let at = folder.path();
    let file = simulate(at, &["--hours", "2", "--seed", "23", "--effect", "mps-gain:sc.y=0.2"]).remove(0);
    let recording = Recording::read(&file);
    let start_ns = recording.start_ns();
    recording.write(&file, |message| {
        let second = message.log_time.saturating_sub(start_ns) / 1_000_000_000;
        (!(3000..3100).contains(&second)).then_some(message)
    });
    let product = science_mode(at).arg(&file).output().expect("runs").stdout;
    let product: Value = serde_json::from_slice(&product).expect("a product as JSON");
    let id = product["id"].as_str().expect("an id");
    let told = |temporary: &Path, log: &str, threads: &str| {
        let mut command = dragfree(at);
        command.args(["diagnose", id, "--archive", "archive", "--json", "-q", "--log-json", log, "--threads", threads]);
        let answer = expect(command.env("TMPDIR", temporary), 4).stdout;
        let log = std::fs::read_to_string(at.join(log)).expect("a log");
        (answer, log.matches("an earlier pass has kept").count())
    };
    let (kept, reads) = told(&std::env::temp_dir(), "kept.jsonl", "2");
    let (again, no_reads) = told(&at.join("nowhere"), "again.jsonl", "1");
    assert!(reads >= 4 && no_reads == 0, "{reads} passes read what was kept, and {no_reads} where there is no room");
    assert!(kept == again, "{}", String::from_utf8_lossy(&kept));
}
