//! Many days together: a step at an event, sums that do not depend on who added them, days that cannot be added, the
//! trend, and what becomes of it when a day is run again.

use dragfree_tests::{dragfree, expect, json};
use serde_json::Value;
use std::path::{Path, PathBuf};
use std::sync::LazyLock;
use tempfile::TempDir;

/// Days of January with telemetry, two hours each; the third is missing.
const DAYS: [u32; 7] = [1, 2, 4, 5, 6, 7, 8];

/// The first day after a mass trim, which moves the centre of mass against the housings by 18 mm along x of SRF.
const TRIMMED: u32 = 5;

/// The same in the frames of the test masses, m: their x axes lie 30° to either side of x of SRF.
const STEPS_M: [(&str, f64); 6] = [
    ("com-offset.tm1.x", 15.588_457_268_119_896e-3),
    ("com-offset.tm1.y", -9e-3),
    ("com-offset.tm1.z", 0.0),
    ("com-offset.tm2.x", 15.588_457_268_119_896e-3),
    ("com-offset.tm2.y", 9e-3),
    ("com-offset.tm2.z", 0.0),
];

const EVENTS: &str = "\
- soe_event: MTEA
  time: 2035-01-05 00:00:00 UTC
  comments: mass trim
  data: {X_trim: 0.018}
";

/// A mission with the products of all days.
static FLOWN: LazyLock<TempDir> = LazyLock::new(|| {
    let dir = tempfile::tempdir().expect("a temporary folder");
    expect(dragfree(dir.path()).args(["init", "."]), 0);
    std::fs::create_dir(dir.path().join("telemetry")).expect("a folder");
    for day in DAYS {
        let offset = if day < TRIMMED { "com-offset:sc.x=0" } else { "com-offset:sc.x=0.018" };
        // The loop settles in the hour before midnight, of which the file is left out.
        let start =
            format!("{}T23:00:00Z", if day == 1 { "2034-12-31".into() } else { format!("2035-01-{:02}", day - 1) });
        let (out, seed) = (format!("vault{day}"), (40 + day).to_string());
        let arguments = ["--out", &out, "--start", &start, "--hours", "3", "--seed", &seed, "--effect", offset];
        expect(dragfree(dir.path()).args(["simulate", "mission.toml"]).args(arguments), 0);
        let name = format!("SC1_2035-01-{day:02}.mcap");
        std::fs::rename(dir.path().join(&out).join(&name), dir.path().join("telemetry").join(&name)).expect("moved");
    }
    expect(dragfree(dir.path()).args(["catch-up", "-q"]), 0);
    std::fs::write(dir.path().join("log.yaml"), EVENTS).expect("written");
    dir
});

/// A copy of a mission that one test has for itself.
struct Mission(TempDir);

impl Mission {
    fn flown() -> Self {
        let dir = tempfile::tempdir().expect("a temporary folder");
        copy(FLOWN.path(), dir.path());
        Self(dir)
    }

    fn path(&self) -> &Path {
        self.0.path()
    }

    fn json(&self, arguments: &str, code: i32) -> Value {
        json(dragfree(self.path()).args(arguments.split(' ')).arg("--json"), code)
    }

    /// The calibration of all days with the trim.
    fn joint(&self) -> Value {
        self.json("joint 2035-01-01..2035-01-08 --events log.yaml --step MTEA=com-offset --constant", 0)
    }

    /// Digest of the newest calibration of many days.
    fn digest(&self) -> String {
        let id = self.joint()["product"].as_str().expect("a product").to_owned();
        self.json(&format!("products show {id}"), 0)["sha256"].as_str().expect("a digest").to_owned()
    }

    /// What a command says that fails.
    fn refusal(&self, arguments: &str) -> String {
        let output = dragfree(self.path()).args(arguments.split(' ')).output().expect("runs");
        assert_eq!(output.status.code(), Some(1), "{}", String::from_utf8_lossy(&output.stdout));
        String::from_utf8_lossy(&output.stderr).split_whitespace().collect::<Vec<_>>().join(" ")
    }
}

fn copy(from: &Path, to: &Path) {
    std::fs::create_dir_all(to).expect("a folder");
    for entry in std::fs::read_dir(from).expect("a folder") {
        let entry = entry.expect("an entry");
        let target = to.join(entry.file_name());
        if entry.path().is_dir() {
            copy(&entry.path(), &target);
        } else {
            std::fs::copy(entry.path(), target).expect("copied");
        }
    }
}

fn number(value: &Value) -> f64 {
    value.as_f64().unwrap_or_else(|| panic!("a number, not {value}"))
}

fn sums(mission: &Mission) -> Vec<PathBuf> {
    let folder = std::fs::read_dir(mission.path().join("archive/sums")).expect("kept sums");
    folder.map(|entry| entry.expect("an entry").path()).collect()
}

/// 18 of 20 pulls of independent values lie below 2; a single one beyond 4.5 comes once in 150 000.
#[test]
fn a_step_comes_back_and_holds_from_its_time_on() {
    let mission = Mission::flown();
    let joint = mission.joint();
    assert_eq!(joint["days"].as_array().map(Vec::len), Some(DAYS.len()));
    assert_eq!(joint["missing"], serde_json::json!(["2035-01-03"]));
    for ((name, truth), c) in STEPS_M.iter().zip(joint["coefficients"].as_array().expect("coefficients")) {
        assert_eq!(c["name"], *name);
        let step = &c["steps"][0];
        let pull = (number(&step["value"]) - truth) / number(&step["sigma"]);
        assert!(pull.abs() < 4.5, "{name}: {step}, true {truth}");
        // A step of more than 10σ is seen. One of 9 mm has 8σ, one of zero is reported once in 100 for all six.
        assert!(truth.abs() < 1e-2 || step["seen"] == true, "{name}: {step}");
        assert!(c["rate"].is_null(), "{c}");
    }

    // Made once, it is not made again; it is made of the days, and they know.
    assert_eq!((&joint["new"], &mission.joint()["new"]), (&Value::Bool(true), &Value::Bool(false)));
    let id = joint["product"].as_str().expect("a product");
    assert_eq!(id, "COM2_2035-01-01_SC1_01_0001");
    let lineage = mission.json("products lineage COM1B_2035-01-02_SC1_01_0001", 0);
    assert_eq!(lineage["entered"], serde_json::json!([id]));
    let rebuilt = mission.json(&format!("products rebuild {id}"), 0);
    assert_eq!(rebuilt["same"], true, "{rebuilt}");
    assert_eq!(mission.json("products verify", 0)["broken"], serde_json::json!([]));
    // Its table of days, damaged, comes out again.
    let shown = mission.json(&format!("products show {id}"), 0);
    let attached = shown["attachments"].as_array().expect("files").iter().find(|a| a["suffix"] == "days.json");
    let sha256 = attached.expect("a table")["sha256"].as_str().expect("a digest").to_owned();
    let object = mission.path().join("archive/objects").join(&sha256[..2]).join(&sha256[2..]);
    std::fs::write(&object, "{}").expect("written");
    assert_eq!(mission.json(&format!("products rebuild {id}"), 0)["mended"], serde_json::json!(["days.json"]));
    assert_eq!(mission.json("products verify", 0)["broken"], serde_json::json!([]));
    // A day is still found by its day.
    assert_eq!(mission.json("products show 2035-01-01", 0)["id"], "COM1B_2035-01-01_SC1_01_0001");

    // What holds at a time has the step from the event on, and the covariance of both.
    let window = ["--from", "2035-01-01", "--until", "2035-01-09", "--into", "ops"];
    expect(dragfree(mission.path()).args(["products", "certify", id]).args(window), 0);
    let at = |time: &str| mission.json(&format!("at {time}"), 0)["calibrations"][0].clone();
    let (before, after) = (at("2035-01-04T23:59:59Z"), at("2035-01-05T00:00:00Z"));
    for (k, c) in joint["coefficients"].as_array().expect("coefficients").iter().enumerate() {
        let value = |at: &Value| number(&at["coefficients"][k]["value"]);
        let (own, step) = (number(&c["value"]), number(&c["steps"][0]["value"]));
        assert_eq!(after["coefficients"][k]["name"], c["name"]);
        assert!((value(&after) - own).abs() < 1e-15 && (value(&after) - value(&before) - step).abs() < 1e-15);
        for at in [&before, &after] {
            let sigma = number(&at["coefficients"][k]["sigma"]);
            assert!((number(&at["covariance"][k][k]).sqrt() / sigma - 1.0).abs() < 1e-12);
        }
        // Three days before it, four after it.
        let sigma = |at: &Value| number(&at["coefficients"][k]["sigma"]);
        assert!(sigma(&before) > 1.05 * sigma(&after), "{before} {after}");
    }
}

/// A calibration of many days has no data of its own, which commands that need some say. As VCM1B it has its rates. Two
/// of them are compared on a screen of 80 columns.
#[test]
fn a_calibration_of_many_days_is_not_taken_for_one_of_a_day() {
    let mission = Mission::flown();
    let constant = mission.joint()["product"].as_str().expect("a product").to_owned();
    for command in ["ladder", "compare", "diagnose"] {
        let refused = mission.refusal(&format!("{command} {constant}"));
        assert!(refused.contains("one calibration of many days, with no data of its own"), "{command}: {refused}");
        assert!(refused.contains(&format!("`dragfree products lineage {constant}`")), "{command}: {refused}");
    }
    let ask = "joint 2035-01-01..2035-01-08 --events log.yaml --step MTEA=com-offset";
    let drifting = mission.json(ask, 0)["product"].as_str().expect("a product").to_owned();
    let vcm1b = |id: &str| {
        let told = expect(dragfree(mission.path()).args(["products", "export", id, "--format", "vcm1b"]), 0);
        String::from_utf8(told.stdout).expect("text")
    };
    let text = vcm1b(&drifting);
    let header: serde_yaml_ng::Value =
        serde_yaml_ng::from_str(text.split("# End").next().expect("a header")).expect("YAML");
    let attributes = &header["header"]["non-standard_attributes"];
    let product = mission.json(&format!("products show {drifting}"), 0);
    for (at, axis) in ["x", "y", "z"].iter().enumerate() {
        let (value, sigma) = dragfree_tests::coefficient(&product, &format!("com-offset.tm2.{axis}.rate"), "joint");
        assert_eq!(attributes["rate_tm2_m_s"][at].as_f64(), Some(value), "{text}");
        assert_eq!(attributes["sigma_rate_tm2_m_s"][at].as_f64(), Some(sigma), "{text}");
    }
    assert!(attributes["comment"].as_str().is_some_and(|c| c.contains("hold at epoch_of_values")), "{text}");
    assert!(!vcm1b(&constant).contains("rate_") && !vcm1b("COM1B_2035-01-01_SC1_01_0001").contains("comment: \"the"));
    let told = expect(dragfree(mission.path()).args(["products", "diff", &constant, &drifting]), 0);
    let told = String::from_utf8(told.stdout).expect("text");
    assert!(told.contains("com-offset.tm1.x.step.2035-01-05T00:00:00\n"), "{told}");
    assert!(told.lines().all(|line| line.chars().count() <= 80), "{told}");
}

/// Without the event the days are not the same.
#[test]
fn a_step_that_nobody_declares_makes_days_disagree() {
    let mission = Mission::flown();
    let joint = mission.json("joint 2035-01-01..2035-01-08 --constant --dry-run", 4);
    assert!(number(&joint["same"]["p"]) < 1e-6, "{}", joint["same"]);
    assert!(joint["product"].is_null());
    let same = mission.json("joint 2035-01-05..2035-01-08 --dry-run", 0);
    assert!(number(&same["same"]["p"]) > 1e-3, "{}", same["same"]);
}

/// Whoever adds, in whatever order: the digest is that of the whole.
#[test]
fn sums_do_not_depend_on_who_adds_them_and_when() {
    let whole = Mission::flown();
    let digest = whole.digest();

    let backwards = Mission::flown();
    std::fs::remove_dir_all(backwards.path().join("archive")).expect("removed");
    for day in DAYS.iter().rev() {
        expect(dragfree(backwards.path()).args(["day", &format!("2035-01-{day:02}"), "-q"]), 0);
        // Sums of fewer days are kept on the way.
        let early = dragfree(backwards.path()).args(["joint", "2035-01-01..2035-01-08", "-q"]).output().expect("runs");
        assert!(matches!(early.status.code(), Some(0 | 4)));
    }
    assert_eq!(backwards.digest(), digest);

    let kept = sums(&whole);
    assert!(kept.len() >= DAYS.len(), "{kept:?}");
    for path in &kept {
        let mut content = std::fs::read(path).expect("read");
        let middle = content.len() / 2;
        content[middle] ^= 1;
        std::fs::write(path, content).expect("written");
    }
    assert_eq!(whole.digest(), digest, "a flipped bit is noticed");
    std::fs::remove_dir_all(whole.path().join("archive/sums")).expect("removed");
    assert_eq!(whole.digest(), digest, "sums may be deleted");
    for path in sums(&whole) {
        std::fs::write(path, "").expect("written");
    }
    assert_eq!(whole.digest(), digest, "a file that was cut off is noticed");
}

/// A day in which a coefficient steps belongs to neither side. Scales of time differ by less than a minute.
#[test]
fn a_day_with_an_event_in_it_is_left_out() {
    let mission = Mission::flown();
    let write = |time: &str| {
        let text = EVENTS.replace("2035-01-05 00:00:00 UTC", time);
        std::fs::write(mission.path().join("log.yaml"), text).expect("written");
    };
    let ask = "joint 2035-01-01..2035-01-08 --events log.yaml --step MTEA=com-offset --dry-run";
    write("2035-01-05 01:00:00 UTC");
    let joint = mission.json(ask, 0);
    assert_eq!(joint["left_out"][0]["day"], "2035-01-05");
    assert_eq!(joint["days"].as_array().map(Vec::len), Some(DAYS.len() - 1));
    let reason = joint["left_out"][0]["reason"].as_str().expect("a sentence");
    assert!(reason.contains("MTEA at 2035-01-05 01:00:00 UTC"), "{reason}");
    // The telemetry is in UTC.
    write("2035-01-05 00:00:00 UTC");
    assert_eq!(mission.json(ask, 0)["left_out"], serde_json::json!([]));
    write("2035-01-05 00:00:00 GPS");
    assert_eq!(mission.json(ask, 0)["left_out"][0]["day"], "2035-01-05");
    // No day before it: no step, and a sentence.
    write("2035-01-01 00:00:00 UTC");
    let ran = dragfree(mission.path()).args(ask.split(' ')).arg("--json").output().expect("runs");
    let joint: Value = serde_json::from_slice(&ran.stdout).expect("JSON");
    assert!(joint["notes"].to_string().contains("both sides"), "{}", joint["notes"]);
    // What an event names itself stands in place of what its kind changes; a name that is none is told.
    let named = |what: &str| {
        let text = EVENTS.replace("  data:", &format!("  changes: [{what}]\n  data:"));
        std::fs::write(mission.path().join("log.yaml"), text).expect("written");
        let ran = dragfree(mission.path()).args(ask.split(' ')).arg("--json").output().expect("runs");
        serde_json::from_slice::<Value>(&ran.stdout).expect("JSON")
    };
    let steps = |joint: &Value| -> Vec<bool> {
        let all = joint["coefficients"].as_array().expect("coefficients");
        all.iter().map(|c| c["steps"].as_array().is_some_and(|steps| !steps.is_empty())).collect()
    };
    assert_eq!(steps(&named("com-offset.tm1")), [true, true, true, false, false, false]);
    let nothing = named("com-offset.tm3");
    assert_eq!(steps(&nothing), [false; 6]);
    assert!(nothing["notes"].to_string().contains("com-offset.tm3, which no coefficient"), "{}", nothing["notes"]);
    write("a Friday");
    assert!(mission.refusal(ask).contains("log.yaml: at line 1, the time \"a Friday\""));
}

/// Sums of different make are refused by the day that differs, and in what.
#[test]
fn days_of_different_make_are_refused_by_name() {
    let mission = Mission::flown();
    let ask = "joint 2035-01-05..2035-01-08 --dry-run";
    let nobody = mission.refusal("joint 2036-01-01..2036-02-01");
    assert!(nobody.contains("no day has a product"), "{nobody}");
    let reversed = dragfree(mission.path()).args(["joint", "2035-02-01..2035-01-01"]).output().expect("runs");
    assert_eq!(reversed.status.code(), Some(2));

    let model = std::fs::read_to_string(mission.path().join("model.toml")).expect("read");
    expect(dragfree(mission.path()).args(["model", "add", "model.toml", "mps-gain:sc.y"]), 0);
    let ran = dragfree(mission.path()).args(["day", "2035-01-07", "-q"]).output().expect("runs");
    assert!(matches!(ran.status.code(), Some(0 | 4)), "{}", String::from_utf8_lossy(&ran.stderr));
    let other = mission.refusal(ask);
    assert!(other.contains("COM1B_2035-01-07_SC1_01_0002") && other.contains("channels or effects"), "{other}");
    assert!(other.contains("COM1B_2035-01-05_SC1_01_0001"), "{other}");
    std::fs::write(mission.path().join("model.toml"), model).expect("written");

    // A damaged file of sums, by its digest, where none are kept that were made of it.
    std::fs::remove_dir_all(mission.path().join("archive/sums")).expect("removed");
    let product = mission.json("products show COM1B_2035-01-06_SC1_01_0001", 0);
    let attached = product["attachments"].as_array().expect("files").iter().find(|a| a["suffix"] == "neq.json");
    let sha256 = attached.expect("sums")["sha256"].as_str().expect("a digest").to_owned();
    let sums = mission.path().join("archive/objects").join(&sha256[..2]).join(&sha256[2..]);
    let mut content = std::fs::read(&sums).expect("read");
    content[100] ^= 1;
    std::fs::write(&sums, content).expect("written");
    let damaged = mission.refusal("joint 2035-01-05..2035-01-06 --dry-run");
    assert!(damaged.contains(&sha256), "{damaged}");
}

/// Values over days: the trim alarms until it is declared, a missing day does.
#[test]
fn the_trend_alarms_at_a_step_until_it_is_declared() {
    let mission = Mission::flown();
    let alerts = |trend: &Value, of: &str| -> Vec<String> {
        let all = trend["alerts"].as_array().expect("alerts").iter().filter(|a| a["coefficient"] == of);
        all.map(|a| a["day"].as_str().expect("a day").to_owned()).collect()
    };
    let trend = mission.json("trend 2035-01-01..2035-01-08", 4);
    assert!(alerts(&trend, "com-offset.tm1.x").contains(&"2035-01-05".to_owned()), "{}", trend["alerts"]);
    let missing = trend["alerts"].as_array().expect("alerts").iter().find(|a| a["day"] == "2035-01-03");
    assert!(missing.is_some_and(|a| a["what"].as_str().is_some_and(|w| w.starts_with("no product"))));

    let declared = "trend 2035-01-01..2035-01-08 --events log.yaml --step MTEA=com-offset";
    let trend = mission.json(&format!("{declared} --csv t.csv --picture t.svg"), 4);
    assert!(alerts(&trend, "com-offset.tm1.x").is_empty(), "{}", trend["alerts"]);
    let csv = std::fs::read_to_string(mission.path().join("t.csv")).expect("a table");
    assert_eq!(csv.lines().count(), 1 + DAYS.len() * STEPS_M.len());
    assert!(csv.lines().all(|line| line.split(',').count() == 11), "{csv}");
    let svg = std::fs::read_to_string(mission.path().join("t.svg")).expect("a picture");
    assert!(svg.starts_with("<svg") && svg.contains("com-offset.tm2.z") && svg.contains("event"));
}

/// A day that is run again makes the calibration of many days stale, and only it is told.
#[test]
fn a_new_product_of_a_day_makes_the_calibration_stale() {
    let mission = Mission::flown();
    mission.joint();
    assert_eq!(mission.json("products stale", 0)["many_days"], serde_json::json!([]));
    // The same result once more changes nothing.
    expect(dragfree(mission.path()).args(["day", "2035-01-06", "-q"]), 0);
    assert_eq!(mission.json("products stale", 0)["many_days"], serde_json::json!([]));
    assert_eq!(mission.joint()["new"], false);
    let other = mission.path().join("telemetry/SC1_2035-01-08.mcap");
    expect(
        dragfree(mission.path())
            .args(["run", "pipeline.toml", "--mission", "mission.toml", "--model", "model.toml"])
            .args(["--from", "2035-01-08T00:30:00Z", "--stream", "oper"])
            .arg(other),
        0,
    );
    expect(
        dragfree(mission.path()).args(["products", "withdraw", "COM1B_2035-01-02_SC1_01_0001", "--reason", "a test"]),
        0,
    );
    let stale = mission.json("products stale", 0);
    assert_eq!(stale["many_days"][0]["product"], "COM2_2035-01-01_SC1_01_0001");
    let reasons = stale["many_days"][0]["reasons"].to_string();
    assert!(reasons.contains("COM1B_2035-01-08_SC1_01_0002 is new"), "{reasons}");
    assert!(reasons.contains("COM1B_2035-01-02_SC1_01 has no product"), "{reasons}");
    assert_eq!(stale["many_days"][0]["reasons"].as_array().map(Vec::len), Some(2), "{reasons}");
    // Another time has its own; the file of events of the mission changes.
    mission.json("joint 2035-01-05..2035-01-07", 0);
    assert_eq!(mission.json("products stale", 0)["many_days"].as_array().map(Vec::len), Some(1));
    std::fs::write(mission.path().join("events.yaml"), "# nothing happened\n[]\n").expect("written");
    let stale = mission.json("products stale", 0);
    assert_eq!(stale["many_days"][1]["product"], "COM2_2035-01-05_SC1_01_0001");
    assert_eq!(stale["many_days"][1]["reasons"], serde_json::json!(["the events of events.yaml are others now"]));
    let again = mission.joint();
    assert_eq!(again["product"], "COM2_2035-01-01_SC1_01_0002");
    assert_eq!(again["days"].as_array().map(Vec::len), Some(DAYS.len() - 1));
}
