//! Output of `dragfree design`.

use dragfree_tests::{dragfree, expect, fixture, json};
use serde_json::Value;
use std::path::{Path, PathBuf};

fn design(mission: &Path, code: i32) -> Value {
    let mut command = dragfree(mission.parent().expect("a folder"));
    json(command.arg("design").arg(mission).arg("--json"), code)
}

/// The paper's spacecraft with one line of its mission file replaced.
fn changed(folder: &Path, from: &str, to: &str) -> PathBuf {
    let text = std::fs::read_to_string(fixture("missions/taiji.toml")).expect("the fixture is there");
    assert_eq!(text.matches(from).count(), 1, "{from}");
    let path = folder.join("mission.toml");
    std::fs::write(&path, text.replace(from, to)).expect("writable");
    path
}

fn number(value: &Value, key: &str) -> f64 {
    value[key].as_f64().unwrap_or_else(|| panic!("{key} of {value}"))
}

/// Every bound on all fifteen channels, from the program's output.
#[test]
fn the_default_mission_meets_every_bound() {
    let report = design(&fixture("missions/taiji.toml"), 0);
    let channels = report["channels"].as_array().expect("channels");
    assert_eq!(channels.len(), 15);
    for c in channels {
        assert!(number(c, "gamma") < 1.0 && number(c, "max_S_W1") < 1.0 && number(c, "max_T_W3") < 1.0, "{c}");
        assert!(number(c, "lmi_max_eigenvalue") < 0.0 && number(c, "order") >= 2.0, "{c}");
        assert!(number(c, "gain_margin_db") > 6.0 && number(c, "phase_margin_deg") > 30.0, "{c}");
        assert!(number(c, "delay_margin_s") > 0.0, "{c}");
    }
    assert!(number(&report, "allocation_residual") < 1e-12);
}

/// Another requirement changes its controller and no other channel.
#[test]
fn a_changed_requirement_gives_another_controller() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let usual = design(&fixture("missions/taiji.toml"), 0);
    let relaxed = design(&changed(dir.path(), "tm_x_m_rthz = 2.5e-9", "tm_x_m_rthz = 5e-9"), 0);
    let crossover = |report: &Value, channel: usize| number(&report["channels"][channel], "crossover_hz");
    assert_eq!(usual["channels"][3]["name"], "tm1.x");
    assert!(crossover(&relaxed, 3) < 0.9 * crossover(&usual, 3));
    for channel in [0, 1, 2, 4, 5, 6] {
        assert_eq!(usual["channels"][channel], relaxed["channels"][channel]);
    }
}

/// An infeasible requirement is refused with its name and a frequency.
#[test]
fn an_infeasible_requirement_is_named() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let mission = changed(dir.path(), "tm_phi_rad_rthz = 2e-7", "tm_phi_rad_rthz = 1e-7");
    let output = expect(dragfree(dir.path()).arg("design").arg(&mission), 1);
    let error = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(error.contains("tm_phi_rad_rthz") && error.contains("Hz"), "{error}");
}

/// Frozen controllers fly as designed ones: equal telemetry but for the header.
#[test]
fn frozen_controllers_are_the_designed_ones() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let frozen = dir.path().join("control.toml");
    let mut command = dragfree(dir.path());
    command.arg("design").arg(fixture("missions/taiji.toml")).arg("--freeze").arg(&frozen);
    expect(command.arg("--pictures").arg(dir.path().join("pictures")), 0);
    let text = std::fs::read_to_string(fixture("missions/taiji.toml")).expect("the fixture is there");
    let (head, rest) = text.split_once("[control]").expect("the fixture has it");
    let tail = &rest[rest.find("\n[").expect("a section follows")..];
    let control = std::fs::read_to_string(&frozen).expect("it was written");
    let mission = dir.path().join("mission.toml");
    std::fs::write(&mission, format!("{head}{control}{tail}")).expect("writable");
    let telemetry = |mission: &Path, name: &str| {
        let out = dir.path().join(name);
        let mut command = dragfree(dir.path());
        expect(command.arg("simulate").arg(mission).arg("--out").arg(&out).args(["--hours", "0.1"]), 0);
        std::fs::read(out.join("SC1_2035-01-01.mcap")).expect("a day's file")
    };
    assert!(telemetry(&mission, "frozen") == telemetry(&fixture("missions/taiji.toml"), "designed"));
    for name in ["sensitivity.svg", "prediction.svg"] {
        let picture = std::fs::read_to_string(dir.path().join("pictures").join(name)).expect("a picture");
        assert!(picture.contains("tm1.x") && picture.contains("</svg>"), "{name}");
    }
}
