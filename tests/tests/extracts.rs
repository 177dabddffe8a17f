//! Several days diagnosed from what each day's diagnosis has kept, without telemetry.

use std::path::{Path, PathBuf};
use std::process::Command;

use dragfree_tests::calibration::science_mode;
use dragfree_tests::{dragfree, expect, json, simulate};
use serde_json::Value;

/// Hidden in the first three days: a part of the thrust along y that the commands lack, 4σ of one day of two hours.
const GAIN: f64 = 0.055;
/// The same in the fourth.
const ANOTHER: f64 = -0.09;

fn diagnose(folder: &Path) -> Command {
    let mut command = dragfree(folder);
    command.arg("diagnose");
    command
}

/// Calibrates four days and keeps their extracts. Returns the telemetry.
fn calibrated(folder: &Path) -> Vec<PathBuf> {
    let mut files = Vec::new();
    for (day, gain) in (1..).zip([GAIN, GAIN, GAIN, ANOTHER]) {
        let (start, seed) = (format!("2035-01-{day:02}"), format!("{}", 60 + day));
        let effect = format!("mps-gain:sc.y={gain}");
        let arguments = ["--hours", "2", "--start", &start, "--seed", &seed, "--effect", &effect];
        let file = simulate(folder, &arguments).pop().expect("a file");
        std::fs::remove_dir_all(folder.join("truth")).expect("removable");
        // A run with a large gain missing disagrees with itself.
        let run = science_mode(folder).arg(&file).output().expect("runs");
        assert!(matches!(run.status.code(), Some(0 | 4)), "{}", String::from_utf8_lossy(&run.stderr));
        let kept = diagnose(folder).args([&start, "--keep-extract", "--json"]).output().expect("runs");
        assert!(matches!(kept.status.code(), Some(0 | 4)), "{}", String::from_utf8_lossy(&kept.stderr));
        files.push(file);
    }
    files
}

fn gain(diagnosis: &Value) -> Option<&Value> {
    diagnosis["candidates"].as_array()?.iter().find(|f| f["effect"] == "mps-gain" && f["instance"] == "sc.y")
}

/// What three days of two hours say together, from their extracts alone, is what their telemetry says in one diagnosis:
/// the gain is named, alone, within 0.2σ and with the same σ to 3 %. The two differ in where each day is linear and in
/// its levels of noise. The size is within 4σ of the truth (false alarm 6e-5), and the days agree; with the fourth,
/// where it is 10σ away, they do not.
#[test]
fn days_together_from_their_extracts_say_what_their_telemetry_says() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let files = calibrated(folder.path());
    let days = "2035-01-01..2035-01-03";
    let read = json(diagnose(folder.path()).args([days, "--json"]), 4);
    for file in files {
        std::fs::remove_file(file).expect("removable");
    }
    let added = json(diagnose(folder.path()).args([days, "--extracts", "--json"]), 4);
    let [a, b] = [&read, &added].map(|d| gain(d).unwrap_or_else(|| panic!("{d:#}")));
    for found in [a, b] {
        assert_eq!(found["accepted"], true, "{found:#}");
    }
    let of = |found: &Value, key: &str| found[key].as_f64().expect("a number");
    let sigma = of(a, "sigma");
    assert!((of(b, "value") - of(a, "value")).abs() < 0.2 * sigma, "{a:#} {b:#}");
    assert!((of(b, "sigma") / sigma - 1.0).abs() < 0.03, "{a:#} {b:#}");
    assert!((of(b, "value") - GAIN).abs() < 4.0 * of(b, "sigma"), "{b:#}");
    assert_eq!(b["by_product"].as_array().map(Vec::len), Some(3));
    for p_value in [&b["constancy"], &added["agreement"], &read["agreement"]].map(|c| of(c, "p_value")) {
        assert!(p_value > 1e-4, "{added:#}");
    }
    let named = added["candidates"].as_array().expect("candidates").iter().filter(|f| f["accepted"] == true);
    assert_eq!(named.count(), 1, "{added:#}");
    let listed = expect(dragfree(folder.path()).args(["products", "list"]), 0);
    assert!(!String::from_utf8_lossy(&listed.stdout).contains("extract"), "an extract is no leftover");
    let with_another = json(diagnose(folder.path()).args(["2035-01-01..2035-01-04", "--extracts", "--json"]), 4);
    assert!(of(&with_another["agreement"], "p_value") < 1e-6, "{with_another:#}");
    let reasons = with_another["reasons"].to_string();
    assert!(reasons.contains("do not agree"), "{reasons}");
    refused(folder.path());
}

/// What cannot be added is refused, with the command that makes it again.
fn refused(folder: &Path) {
    let archive = folder.join("archive");
    let name = |day: u32| format!("COM1B_2035-01-0{day}_SC1_01_0001");
    let path = |day: u32| archive.join(name(day) + ".extract.json");
    let says = |what: &str| {
        let out = diagnose(folder).args(["2035-01-01..2035-01-02", "--extracts"]).output().expect("runs");
        let text = String::from_utf8_lossy(&out.stderr).into_owned();
        assert_eq!(out.status.code(), Some(1), "{text}");
        let next = format!("dragfree diagnose {} --keep-extract", name(2));
        assert!(text.contains(what) && text.contains(&next), "{text}");
    };
    let sound = std::fs::read(path(2)).expect("readable");
    std::fs::copy(path(1), path(2)).expect("copied");
    says("is damaged");
    std::fs::write(path(2), &sound[..sound.len() / 2]).expect("written");
    says("is damaged");
    // The product itself is whole, so that its extract can be made again.
    expect(dragfree(folder).args(["products", "show", &name(2)]), 0);
    let list = json(dragfree(folder).args(["products", "list", "--json"]), 0);
    assert!(list["problems"][0]["path"].as_str().is_some_and(|path| path.ends_with(".extract.json")), "{list:#}");
    assert_eq!(list["products"].as_array().map(Vec::len), Some(4));
    std::fs::write(path(2), &sound).expect("written");
    assert_eq!(json(dragfree(folder).args(["products", "list", "--json"]), 0)["problems"], serde_json::json!([]));
    let folders = std::fs::read_dir(archive.join("objects")).expect("objects").flatten();
    let objects = folders.flat_map(|f| std::fs::read_dir(f.path()).expect("a folder").flatten().map(|e| e.path()));
    let object = objects.into_iter().find(|object| std::fs::read(object).is_ok_and(|content| content == sound));
    std::fs::remove_file(object.expect("a content of the archive")).expect("removable");
    says("No such file");
    let out = diagnose(folder).args(["2035-01-01..2035-01-02", "--keep-extract"]).output().expect("runs");
    assert_eq!(out.status.code(), Some(1));
    assert!(String::from_utf8_lossy(&out.stderr).contains("one product"), "{out:?}");
}
