//! Telemetry of another producer runs with a mission file alone: other controllers, other noise, offsets a few
//! millimetres off the nominal, housekeeping never seen before, with and without `/command`.

use dragfree_tests::foreign::{Container, Flight, Loops, Record, fly, write};
use dragfree_tests::{coefficient, dragfree, fixture};
use serde_json::Value;
use std::fmt::Write;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

/// Another spacecraft than the default mission's in every number that may differ. The seed was set before the first run.
const FLIGHT: Flight = Flight {
    seconds: 6.0 * 3600.0,
    seed: 1,
    shift_srf_m: [2.1e-3, -1.4e-3, 0.9e-3],
    thrust_n: 0.8e-7,
    torque_nm: 1.2e-7,
    ifo_m: 3e-12,
    is_m: 2.4e-9,
    dws_rad: 3e-10,
    sunlight_n: 6.3513e-5,
    loops: Loops { attitude: 0.4, x: 0.45, y: 0.2, z: 0.25 },
};

/// Not on a full second: 2035-03-07T03:20:00.034567890Z.
const START_NS: u64 = 2_056_850_400_034_567_890;

const USUAL: Container = Container { chunks: true, zstd: true, summary: true, command: true, ephemeris: true };

fn records() -> &'static [Record] {
    static RECORDS: OnceLock<Vec<Record>> = OnceLock::new();
    RECORDS.get_or_init(|| fly(&FLIGHT))
}

/// The default mission with the noise of this flight; `controllers` adds those that flew.
fn mission(folder: &Path, controllers: bool) -> PathBuf {
    let mut text = std::fs::read_to_string(fixture("missions/taiji.toml")).expect("readable");
    for (table, key, value) in [
        ("thruster_force", "asd_n_rthz", FLIGHT.thrust_n),
        ("thruster_torque", "asd_nm_rthz", FLIGHT.torque_nm),
        ("ifo_x", "asd_m_rthz", FLIGHT.ifo_m),
        ("is_y", "asd_m_rthz", FLIGHT.is_m),
        ("is_z", "asd_m_rthz", FLIGHT.is_m),
        ("dws_long_arm", "asd_rad_rthz", FLIGHT.dws_rad),
    ] {
        let at = text.find(&format!("[noise.{table}]")).expect("a table");
        let key_at = at + text[at..].find(key).expect("a key");
        let end = key_at + text[key_at..].find('\n').expect("a line");
        text.replace_range(key_at..end, &format!("{key} = {value:e}"));
    }
    if controllers {
        // This controller knows neither stiffness nor sunlight.
        for (from, to) in [("[solar_pressure]", "[requirements]"), ("[control]", "[actuators]")] {
            let (start, end) = (text.find(from).expect("a table"), text.find(to).expect("a table"));
            text.replace_range(start..end, "");
        }
        text = text.lines().filter(|l| !l.starts_with("stiffness_")).fold(String::new(), |all, l| all + l + "\n");
        // Nor a limit of the electrodes, nor what turning the spacecraft does to the test masses.
        text = text.replace("electrostatic_force_limit_n = 5e-9", "electrostatic_force_limit_n = 1e-6");
        text.push_str("\n[control]\ndelay_samples = 0\nlever_feed_forward = false\n");
        let (w, loops) = (FLIGHT.loops, |w: f64| Loops::section(w));
        let channels = [("sc.phi", w.attitude), ("sc.theta", w.attitude), ("sc.psi", w.attitude)].into_iter();
        let of = |tm: &'static str| [(tm, "x", w.x), (tm, "y", w.y), (tm, "z", w.z)];
        let masses = of("tm1").into_iter().chain(of("tm2")).map(|(tm, axis, w)| (format!("{tm}.{axis}"), w));
        for (name, w) in channels.map(|(n, w)| (n.to_owned(), w)).chain(masses) {
            let (gain, section) = loops(w);
            writeln!(text, "[control.channel.\"{name}\"]\ngain_s2 = {gain:?}\nsections = [{section:?}]").expect("text");
        }
        for name in ["tm1", "tm2"].iter().flat_map(|tm| ["phi", "theta", "psi"].map(|a| format!("{tm}.{a}"))) {
            writeln!(text, "[control.channel.\"{name}\"]\ngain_s2 = 0.0\nsections = []").expect("text");
        }
    }
    let path = folder.join("mission.toml");
    std::fs::write(&path, text).expect("writable");
    path
}

struct Run {
    code: Option<i32>,
    stderr: String,
    product: Value,
}

fn run(container: Container, records: &[Record], mission: impl FnOnce(&Path) -> PathBuf) -> Run {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let file = dir.path().join("foreign.mcap");
    write(&file, records, START_NS, container);
    let mission = mission(dir.path());
    let mut command = dragfree(dir.path());
    command.arg("run").arg(fixture("pipelines/science-mode.toml")).arg(&file).arg("--mission").arg(mission);
    let output = command.args(["--archive", "archive", "--json"]).output().expect("the program runs");
    let stderr = String::from_utf8_lossy(&output.stderr).into_owned();
    let product = serde_json::from_slice(&output.stdout).unwrap_or(Value::Null);
    Run { code: output.status.code(), stderr, product }
}

/// Pulls of the coefficients that six hours determine, in σ: y and z of both solutions, x of the QP.
fn pulls(product: &Value, truth: &Flight) -> Vec<(String, f64)> {
    let mut all = Vec::new();
    for i in 0..2 {
        let truth = truth.offset_orf_m(i);
        for (axis, truth) in ["x", "y", "z"].iter().zip(truth) {
            for solution in ["es-akf", "qp"] {
                if *axis == "x" && solution == "es-akf" {
                    continue;
                }
                let name = format!("com-offset.tm{}.{axis}", i + 1);
                let (value, sigma) = coefficient(product, &name, solution);
                assert!(sigma > 0.0 && sigma < 5e-3, "{name} by {solution}: σ = {sigma} m");
                all.push((format!("{name} by {solution}"), (value - truth) / sigma));
            }
        }
    }
    all
}

/// Ten pulls within 3σ: a false alarm in 2.7 % at most (union bound).
fn assert_within_three_sigma(product: &Value) {
    for (name, pull) in pulls(product, &FLIGHT) {
        assert!(pull.abs() <= 3.0, "{name} is {pull:.2}σ from the truth");
    }
}

#[test]
fn telemetry_of_another_producer_needs_a_mission_file_alone() {
    let run = run(USUAL, records(), |dir| mission(dir, false));
    assert_eq!(run.code, Some(0), "{} {}", run.stderr, run.product);
    assert_eq!(run.product["commands"], "telemetered");
    assert_eq!(run.product["epochs_used"], 216_000, "{}", run.product["quality"]);
    assert_within_three_sigma(&run.product);
}

/// The twin: against offsets on the other side of the drawings the same pulls are far outside.
#[test]
fn mirrored_offsets_are_not_within_three_sigma() {
    let run = run(USUAL, records(), |dir| mission(dir, false));
    let mirrored = Flight { shift_srf_m: FLIGHT.shift_srf_m.map(|x| -x), ..FLIGHT };
    let pulls = pulls(&run.product, &mirrored);
    assert!(pulls.iter().any(|(_, pull)| pull.abs() > 3.0), "{pulls:?}");
}

/// Noise levels in the mission file that are not those of the flight: the QP measures its own.
#[test]
fn a_mission_file_with_other_noise_levels_still_gives_honest_errors() {
    let run = run(USUAL, records(), |_| fixture("missions/taiji.toml"));
    assert!(matches!(run.code, Some(0 | 4)), "{}", run.stderr);
    for (name, pull) in pulls(&run.product, &FLIGHT).into_iter().filter(|(name, _)| name.ends_with("qp")) {
        assert!(pull.abs() <= 4.0, "{name} is {pull:.2}σ from the truth (a false alarm in 4e-4 of six)");
    }
}

#[test]
fn commands_that_are_not_telemetered_are_rebuilt_by_the_controllers_of_the_mission_file() {
    let container = Container { command: false, ..USUAL };
    let run = run(container, records(), |dir| mission(dir, true));
    assert_eq!(run.code, Some(0), "{} {}", run.stderr, run.product);
    assert_eq!(run.product["commands"], "reconstructed");
    assert_within_three_sigma(&run.product);
}

/// Another controller flew than the one in the mission file: the two solutions contradict each other, and it is said.
#[test]
fn commands_rebuilt_by_the_wrong_controller_are_noticed() {
    let container = Container { command: false, ..USUAL };
    let run = run(container, records(), |_| fixture("missions/taiji.toml"));
    assert_eq!(run.code, Some(4), "{}", run.stderr);
    assert_eq!(run.product["commands"], "reconstructed");
    assert_eq!(run.product["verdict"], "disagree", "{}", run.product);
}

/// However the file is laid out, the same bytes of telemetry give the same result.
#[test]
fn the_container_does_not_matter() {
    let hour = &records()[..36_000];
    let reference = run(USUAL, hour, |dir| mission(dir, false)).product["coefficients"].clone();
    assert!(reference.is_array());
    for container in [
        Container { zstd: false, ..USUAL },
        Container { chunks: false, ..USUAL },
        Container { summary: false, ..USUAL },
        Container { chunks: false, summary: false, ..USUAL },
    ] {
        let run = run(container, hour, |dir| mission(dir, false));
        assert!(matches!(run.code, Some(0 | 4)), "{container:?}: {}", run.stderr);
        assert_eq!(run.product["coefficients"], reference, "{container:?}");
    }
}

#[test]
fn without_an_ephemeris_the_run_goes_on() {
    let run = run(Container { ephemeris: false, ..USUAL }, records(), |dir| mission(dir, false));
    assert_eq!(run.code, Some(0), "{} {}", run.stderr, run.product);
    assert_within_three_sigma(&run.product);
}
