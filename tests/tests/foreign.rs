//! Telemetry of another producer runs with a mission file alone: other controllers, other noise, offsets a few
//! millimetres off the nominal, housekeeping never seen before, with and without `/command`.

use dragfree_tests::calibration::{diagnose, science_mode};
use dragfree_tests::foreign::{
    Blow, Container, Draw, Flight, Gain, HEAT_LAG_S, Heat, Hidden, Line, Loops, PERIOD_NS, Record, Recorder,
    Spacecraft, Start, fly, write,
};
use dragfree_tests::{coefficient, dragfree, fixture};
use serde_json::Value;
use std::fmt::Write;
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

/// A spacecraft that differs from the default mission in every number. The seed was set before the first run.
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
    hidden: Hidden::NONE,
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
        // This controller has no stiffness and sunlight compensation.
        for (from, to) in [("[solar_pressure]", "[requirements]"), ("[control]", "[actuators]")] {
            let (start, end) = (text.find(from).expect("a table"), text.find(to).expect("a table"));
            text.replace_range(start..end, "");
        }
        text = text.lines().filter(|l| !l.starts_with("stiffness_")).fold(String::new(), |all, l| all + l + "\n");
        // Nor limits of the electrodes and compensation of rotation.
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

/// Ten pulls within 3σ: false alarm at most 2.7 % (union bound).
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

/// Negative control: against mirrored offsets the same pulls are far outside.
#[test]
fn mirrored_offsets_are_not_within_three_sigma() {
    let run = run(USUAL, records(), |dir| mission(dir, false));
    let mirrored = Flight { shift_srf_m: FLIGHT.shift_srf_m.map(|x| -x), ..FLIGHT };
    let pulls = pulls(&run.product, &mirrored);
    assert!(pulls.iter().any(|(_, pull)| pull.abs() > 3.0), "{pulls:?}");
}

/// With wrong noise levels in the mission file the QP measures its own.
#[test]
fn wrong_noise_levels_in_the_mission_file_give_right_errors() {
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

/// The mission file has another controller than the flown one: the verdict is a disagreement.
#[test]
fn commands_rebuilt_by_a_wrong_controller_are_detected() {
    let container = Container { command: false, ..USUAL };
    let run = run(container, records(), |_| fixture("missions/taiji.toml"));
    assert_eq!(run.code, Some(4), "{}", run.stderr);
    assert_eq!(run.product["commands"], "reconstructed");
    assert_eq!(run.product["verdict"], "disagree", "{}", run.product);
}

/// The layout of the file does not change the result.
#[test]
fn results_do_not_depend_on_the_file_layout() {
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
fn a_run_works_without_an_ephemeris() {
    let run = run(Container { ephemeris: false, ..USUAL }, records(), |dir| mission(dir, false));
    assert_eq!(run.code, Some(0), "{} {}", run.stderr, run.product);
    assert_within_three_sigma(&run.product);
}

/// Diagnosis of six hours with a hidden effect.
fn diagnosed(hidden: Hidden) -> Value {
    diagnosed_without(hidden, 0..0)
}

/// The same where some samples were not received.
fn diagnosed_without(hidden: Hidden, lost: Range<usize>) -> Value {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let product = calibrated(dir.path(), &Flight { hidden, seed: 2, ..FLIGHT }, START_NS, lost);
    diagnose(dir.path(), &product)
}

/// The product of a flight from a time on, of which some samples were not received.
fn calibrated(folder: &Path, flight: &Flight, start_ns: u64, lost: Range<usize>) -> Value {
    let file = folder.join(format!("foreign-{start_ns}.mcap"));
    let mut recorder = Recorder::create(&file, USUAL, false).expect("the folder is writable");
    for (k, r) in fly(flight).iter().enumerate().filter(|(k, _)| !lost.contains(k)) {
        recorder.sample(k, start_ns + k as u64 * PERIOD_NS, r).expect("the file is writable");
    }
    recorder.finish().expect("the file is writable");
    let mut command = dragfree(folder);
    command.arg("run").arg(fixture("pipelines/science-mode.toml")).arg(&file);
    let run = command.arg("--mission").arg(mission(folder, false)).args(["--archive", "archive", "--json"]).output();
    let run = run.expect("the program runs");
    serde_json::from_slice(&run.stdout).unwrap_or_else(|_| panic!("{}", String::from_utf8_lossy(&run.stderr)))
}

/// Name of the single accepted candidate, and the error of its only coefficient in σ.
fn found(d: &Value, truth: f64) -> (String, Value, f64) {
    let all: Vec<&Value> =
        d["candidates"].as_array().expect("a list").iter().filter(|c| c["accepted"] == true).collect();
    assert_eq!(all.len(), 1, "{} {:#} {:#}", d["verdict"], d["candidates"], d["unexplained"]);
    let [value, sigma] = ["value", "sigma"].map(|key| all[0][key].as_f64().expect("a number"));
    let name = format!("{}:{}", all[0]["effect"].as_str().unwrap_or(""), all[0]["instance"].as_str().unwrap_or(""));
    (name, all[0].clone(), (value - truth) / sigma)
}

/// Without a hidden effect nothing is named (false alarm 1 %).
#[test]
fn another_producers_right_model_is_sufficient() {
    let d = diagnosed(Hidden::NONE);
    assert_eq!(d["verdict"], "sufficient", "{:#}", d["candidates"][0]);
}

/// Effects of the other producer: named alone, with instance and size within 4σ (6e-5 each).
#[test]
fn another_producers_hidden_gain_and_crosstalk_are_found() {
    let mut aside = Hidden::NONE;
    aside.electrodes[1][0][1] = 0.03;
    for (name, truth, hidden) in [
        ("mps-gain:sc.y", 0.1, Hidden { thrust_gain: [0.0, 0.1, 0.0], ..Hidden::NONE }),
        ("es-crosstalk:tm2.y-x", 0.03, aside),
    ] {
        let (accepted, candidate, pull) = found(&diagnosed(hidden), truth);
        assert!(accepted == name && pull.abs() < 4.0, "{pull} {candidate:#}");
    }
}

/// Ten minutes without any telemetry are no gap of one candidate's commands: all are tried, and the gain is named
/// within 4σ.
#[test]
fn a_gap_of_all_telemetry_leaves_every_candidate() {
    let d = diagnosed_without(Hidden { thrust_gain: [0.0, 0.1, 0.0], ..Hidden::NONE }, 80_000..86_000);
    let not_tried = d["not_tried"].to_string();
    assert!(!not_tried.contains("has gaps"), "{not_tried}");
    let (accepted, candidate, pull) = found(&d, 0.1);
    assert!(accepted == "mps-gain:sc.y" && pull.abs() < 4.0, "{pull} {candidate:#}");
}

/// Two days of two hours each with a thruster gain: where it is the same the days agree (false alarm 1e-4), where it
/// is not they do not, each day within 4σ of its own.
#[test]
fn a_cause_that_is_not_the_same_every_day_is_told() {
    const DAY_NS: u64 = 86_400_000_000_000;
    for gains in [[0.2, 0.2], [0.3, 0.05]] {
        let dir = tempfile::tempdir().expect("a temporary folder");
        for (day, gain) in (0..).zip(gains) {
            let hidden = Hidden { thrust_gain: [0.0, gain, 0.0], ..Hidden::NONE };
            let flight = Flight { hidden, seconds: 7200.0, seed: 3 + day, ..FLIGHT };
            calibrated(dir.path(), &flight, START_NS + day * DAY_NS, 0..0);
        }
        let run = dragfree(dir.path()).args(["diagnose", "2035-03-07..2035-03-08", "--json", "-q"]).output();
        let run = run.expect("the program runs");
        assert_eq!(run.status.code(), Some(4), "{}", String::from_utf8_lossy(&run.stderr));
        let d: Value = serde_json::from_slice(&run.stdout).expect("JSON");
        let candidates = d["candidates"].as_array().expect("a list");
        let gain = candidates.iter().find(|c| c["coefficient"] == "mps-gain.sc.y").expect("the gain");
        assert!(gain["accepted"] == true, "{gain:#}");
        let by_product = gain["by_product"].as_array().expect("a list");
        assert_eq!(by_product.len(), 2, "{gain:#}");
        for (own, truth) in by_product.iter().zip(gains) {
            let [value, sigma] = ["value", "sigma"].map(|key| own[key].as_f64().expect("a number"));
            assert!((value - truth).abs() < 4.0 * sigma, "{own:#}");
        }
        let p = gain["constancy"]["p_value"].as_f64().expect("a number");
        assert!(if gains[0] == gains[1] { p > 1e-4 } else { p < 1e-4 }, "{gains:?} {gain:#}");
    }
}

/// A thruster gain from −0.2 to 0.2 in the six hours, none on average: told with its rate within 4σ (6e-5), and the
/// model is not called sufficient.
#[test]
fn another_producers_drifting_gain_is_told_with_its_rate() {
    let hidden = Hidden { thrust_gain: [0.0, -0.2, 0.0], thrust_gain_per_day: [0.0, 1.6, 0.0], ..Hidden::NONE };
    let d = diagnosed(hidden);
    assert_ne!(d["verdict"], "sufficient", "{:#}", d["drifts"]);
    let drift = &d["drifts"][0];
    let [rate, sigma] = ["per_day", "sigma_per_day"].map(|key| drift[key].as_f64().expect("a number"));
    assert!(drift["coefficient"] == "mps-gain.sc.y" && (rate - 1.6).abs() < 4.0 * sigma, "{drift:#}");
    assert!(sigma < 0.4, "{drift:#}");
}

/// A readout scale of 1.1: accepted, or listed as a confounder of the electrode gain along the same axis.
#[test]
fn another_producers_readout_scale_is_found_or_listed_as_a_confounder() {
    let mut hidden = Hidden::NONE;
    hidden.shown[0][1][1] = 0.1;
    let (accepted, candidate, pull) = found(&diagnosed(hidden), 0.1);
    let beside = candidate["confounders"].as_array().is_some_and(|c| c.iter().any(|name| name == "is-scale:tm1.y"));
    assert!(
        accepted == "is-scale:tm1.y" && pull.abs() < 4.0 || accepted == "es-gain:tm1.y" && beside,
        "{pull} {candidate:#}"
    );
}

/// A thermal force, with thermometers of unknown names: the right pair, the lag within a third.
#[test]
fn another_producers_thermal_force_is_found_with_its_thermometers() {
    let truth = 2e-11;
    let heat = Some(Heat { test_mass: 0, axis: 0, per_k: truth, lag_s: HEAT_LAG_S });
    let (accepted, candidate, pull) = found(&diagnosed(Hidden { heat, ..Hidden::NONE }), truth);
    assert!(accepted == "thermal:tm1.x" && pull.abs() < 4.0, "{pull} {candidate:#}");
    let shape = &candidate["shape"];
    assert_eq!((&shape["plus"], &shape["minus"]), (&"hk.housing_a_left_k".into(), &"hk.housing_a_right_k".into()));
    let lag_s = shape["lag_s"].as_f64().expect("a lag");
    assert!((lag_s / HEAT_LAG_S - 1.0).abs() < 0.34, "{lag_s}");
}

/// An impulse: within a second of its time, with its momentum.
#[test]
fn another_producers_impulse_is_found_with_its_time_and_momentum() {
    let (at_s, momentum) = (2.2 * 3600.0, 2e-6);
    let blow = Some(Blow { test_mass: None, axis: 0, at_s, momentum_n_s: momentum, decay_s: 0.0 });
    let (accepted, candidate, pull) = found(&diagnosed(Hidden { blow, ..Hidden::NONE }), momentum);
    assert!(accepted == "impulse:sc.x" && pull.abs() < 4.0, "{pull} {candidate:#}");
    let at_ns = candidate["shape"]["at_ns"].as_i64().expect("a time");
    let late_s = (at_ns - START_NS as i64) as f64 * 1e-9 - at_s;
    assert!(late_s.abs() < 1.0, "{late_s} s");
}

/// A line in the thrust: on its axis, at its frequency to a tenth of 1/T, with its amplitude. With it in the model
/// nothing is missing, while a second one there is searched.
#[test]
fn another_producers_line_in_the_thrust_is_found_with_its_frequency_and_amplitude() {
    let (hz, force_n) = (0.012_345, 8e-9);
    let line = Some(Line { axis: 1, force_n, hz });
    let dir = tempfile::tempdir().expect("a temporary folder");
    let flight = Flight { hidden: Hidden { line, ..Hidden::NONE }, seed: 2, ..FLIGHT };
    let answer = diagnose(dir.path(), &calibrated(dir.path(), &flight, START_NS, 0..0));
    let (accepted, candidate, _) = found(&answer, force_n);
    assert_eq!(accepted, "line:sc.y", "{candidate:#}");
    let frequency_hz = candidate["shape"]["frequency_hz"].as_f64().expect("a frequency");
    assert!((frequency_hz - hz).abs() < 0.1 / FLIGHT.seconds, "{frequency_hz}");
    let parts: Vec<(f64, f64)> = (candidate["coefficients"].as_array().expect("two amplitudes").iter())
        .map(|c| (c["value"].as_f64().expect("a number"), c["sigma"].as_f64().expect("a number")))
        .collect();
    let amplitude_n = parts.iter().map(|(value, _)| value * value).sum::<f64>().sqrt();
    let sigma_n = parts.iter().map(|(_, sigma)| sigma * sigma).sum::<f64>().sqrt() / 2.0_f64.sqrt();
    assert!((amplitude_n - force_n).abs() < 4.0 * sigma_n, "{amplitude_n} ± {sigma_n}");

    std::fs::write(dir.path().join("d.json"), answer.to_string()).expect("writable");
    std::fs::copy(fixture("models/com-offset.toml"), dir.path().join("m.toml")).expect("copied");
    let add = dragfree(dir.path()).args(["model", "add", "m.toml", "--from", "d.json"]).output().expect("runs");
    assert!(add.status.success(), "{}", String::from_utf8_lossy(&add.stderr));
    let mut run = science_mode(dir.path());
    run.arg(format!("foreign-{START_NS}.mcap")).arg("--mission").arg(mission(dir.path(), false));
    let run = run.args(["--model", "m.toml"]).output().expect("runs");
    let product = serde_json::from_slice(&run.stdout).unwrap_or_else(|_| panic!("{run:?}"));
    let after = diagnose(dir.path(), &product);
    assert_eq!(after["verdict"], "sufficient", "{:#} {}", after["candidates"][0], after["reasons"]);
}

/// Telemetry of a flight with the power system and the magnetometer.
fn telemetered(folder: &Path, flight: &Flight) -> PathBuf {
    let file = folder.join("foreign.mcap");
    let mut recorder = Recorder::create(&file, USUAL, true).expect("the folder is writable");
    for (k, r) in fly(flight).iter().enumerate() {
        recorder.sample(k, START_NS + k as u64 * PERIOD_NS, r).expect("the file is writable");
    }
    recorder.finish().expect("the file is writable");
    file
}

/// Calibrates telemetry with a model, or the part of it that `more` says.
fn run_with(folder: &Path, model: &str, more: &[&str]) -> Value {
    let mut run = science_mode(folder);
    run.arg("foreign.mcap").arg("--mission").arg(mission(folder, false)).args(["--model", model]).args(more);
    let run = run.output().expect("the program runs");
    serde_json::from_slice(&run.stdout).unwrap_or_else(|_| panic!("{}", String::from_utf8_lossy(&run.stderr)))
}

/// Diagnoses six hours with power system and magnetometer.
fn with_power(folder: &Path, hidden: Hidden) -> Value {
    telemetered(folder, &Flight { hidden, seed: 5, ..FLIGHT });
    std::fs::copy(fixture("models/com-offset.toml"), folder.join("m.toml")).expect("copied");
    diagnose(folder, &run_with(folder, "m.toml", &[]))
}

/// The only formula of an answer in which nothing else is named, where it acts, and the error of its value in σ.
fn formula(d: &Value, truth: f64) -> (Value, String, String, f64) {
    assert_eq!(d["verdict"], "unexplained", "{:#}", d["candidates"]);
    formula_beside(d, truth)
}

/// The same beside whatever else is named.
fn formula_beside(d: &Value, truth: f64) -> (Value, String, String, f64) {
    let [formula] = &d["formulas"].as_array().expect("a list")[..] else { panic!("{:#}", d["formulas"]) };
    let text = |key: &str| formula["shape"][key].as_str().expect("a text").to_owned();
    let [value, sigma] = ["value", "sigma"].map(|key| formula[key].as_f64().expect("a number"));
    (formula.clone(), text("acts_on"), text("expression"), (value - truth) / sigma)
}

/// With the housekeeping of the power system and the magnetometer and nothing hidden, nothing is named (false alarm
/// 1 %), although products with commands and forces on the spacecraft are tried.
#[test]
fn housekeeping_and_commands_together_raise_no_false_alarm() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let d = with_power(dir.path(), Hidden::NONE);
    assert_eq!(d["verdict"], "sufficient", "{:#} {:#}", d["candidates"][0], d["formulas"]);
    assert_eq!(d["formulas"], serde_json::json!([]));
}

/// A force by the square of one component of the field along one axis: the formula is that, with its size within 4σ
/// (false alarm 6e-5), whichever component and wherever it acts.
#[test]
fn a_force_by_the_square_of_the_field_along_one_axis_is_told() {
    for (place, acts_on, component, name) in
        [((0, 1), "tm1.accel.y", 0, "hk.boom_bx_t^2"), ((1, 0), "tm2.accel.x", 2, "hk.boom_bz_t^2")]
    {
        let mut sizes = [0.0; 3];
        sizes[component] = 2.0;
        let dir = tempfile::tempdir().expect("a temporary folder");
        let d = with_power(dir.path(), Hidden { field_squared: Some((place.0, place.1, sizes)), ..Hidden::NONE });
        let (found, on, expression, pull) = formula(&d, 2.0);
        assert!(on == acts_on && expression.starts_with(name) && pull.abs() < 4.0, "{pull} {found:#}");
    }
}

/// Two hours with one bump of a force that no effect covers, by the product of two housekeeping values (seed 805 of the
/// campaign): no force is named, and formulas are given. `magnetic` was named with formulas beside it, one of three
/// series that made the bump together, and read the series of a formula where its own had stood.
#[test]
fn a_part_of_an_unknown_force_is_not_named() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let draw = Draw::new(100_805, 2.0, false);
    assert_eq!(draw.acted[0].effect, "current-by-panel");
    let files = draw.record(dir.path()).expect("the folder is writable");
    let bundled = std::fs::read_to_string(fixture("missions/taiji.toml")).expect("the bundled mission");
    let mission = dir.path().join("mission.toml");
    std::fs::write(&mission, draw.mission(&bundled).expect("its tables")).expect("the folder is writable");
    let mut command = dragfree(dir.path());
    command.arg("run").arg(fixture("pipelines/science-mode.toml")).args(&files);
    let run = command.arg("--mission").arg(mission).args(["--archive", "archive", "--json"]).output();
    let run = run.expect("the program runs");
    let product =
        serde_json::from_slice(&run.stdout).unwrap_or_else(|_| panic!("{}", String::from_utf8_lossy(&run.stderr)));
    let d = diagnose(dir.path(), &product);
    let named = d["candidates"].as_array().into_iter().flatten().filter(|c| c["accepted"] == true);
    let forces: Vec<&Value> = named.filter(|c| !c["effect"].as_str().is_some_and(|e| e.ends_with("-noise"))).collect();
    assert!(forces.is_empty(), "{forces:#?}");
    assert!(!d["formulas"].as_array().is_none_or(Vec::is_empty) && !d["unexplained"].is_null(), "{d:#}");
}

/// A force on the spacecraft by the bus current, which all channels of the test masses show: the formula acts on the
/// spacecraft, with its size within 4σ, also where the force is fifty times the noise.
#[test]
fn a_driven_force_on_the_spacecraft_is_told_as_one() {
    for n_per_a in [5e-8, 1e-6] {
        let dir = tempfile::tempdir().expect("a temporary folder");
        let d = with_power(dir.path(), Hidden { current_on_spacecraft: Some((0, n_per_a)), ..Hidden::NONE });
        let (found, on, expression, pull) = formula(&d, n_per_a);
        let told = on == "sc.force.x" && expression.starts_with("hk.bus_current_a - ");
        assert!(told && pull.abs() < 4.0, "{pull} {found:#}");
    }
}

/// Fall of χ² on the six later hours by an effect whose size is fitted to the six earlier ones; `model` is a copy of
/// the model without it.
fn held_out_fall(folder: &Path, model: &str, add: &[&str]) -> f64 {
    let split = "2035-03-07T09:20:00Z";
    let command = |arguments: &[&str]| {
        let output = dragfree(folder).args(arguments).output().expect("the program runs");
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        output.stdout
    };
    let mut ladder = [Vec::new(), Vec::new()];
    std::fs::copy(fixture("models/com-offset.toml"), folder.join(model)).expect("copied");
    for step in 0..2 {
        if step == 1 {
            command(&[&["model", "add", model][..], add].concat());
        }
        let fitted = run_with(folder, model, &["--until", split]);
        let id = fitted["id"].as_str().expect("an id");
        let fixed = format!("fixed-{step}-{model}");
        let fix =
            ["model", "fix", model, "--from", id, "--keep", "com-offset", "--archive", "archive", "--out", &fixed];
        command(&fix);
        let held = run_with(folder, &fixed, &["--from", split]);
        ladder[0].push(id.to_owned());
        ladder[1].push(held["id"].as_str().expect("an id").to_owned());
    }
    let [fitted, held] = &ladder;
    let mut arguments = vec!["ladder", &fitted[0], &fitted[1], "--held-out", &held[0], &held[1]];
    arguments.extend(["--archive", "archive", "--json"]);
    let answer: Value = serde_json::from_slice(&command(&arguments)).expect("JSON");
    answer["revisions"][1]["held_out"]["fall"]["delta_chi2"].as_f64().unwrap_or_else(|| panic!("{answer:#}"))
}

/// A gain of the thrusters along z that follows the temperature of the panel: the formula is the product of the two,
/// not a force that follows the temperature, with its size within 4σ (false alarm 6e-5). On six later hours it lowers
/// χ² to within 10 % of the model that knew. The twin, the temperature alone, does not.
#[test]
fn a_gain_that_follows_housekeeping_is_told_as_a_product_with_the_command() {
    let gain = Gain { test_mass: None, axis: 2, per_k: 0.2 };
    let hidden = Hidden { gain_by_panel: Some(gain), ..Hidden::NONE };
    let dir = tempfile::tempdir().expect("a temporary folder");
    telemetered(dir.path(), &Flight { hidden, seed: 5, seconds: 12.0 * 3600.0, ..FLIGHT });
    std::fs::copy(fixture("models/com-offset.toml"), dir.path().join("m.toml")).expect("copied");
    let d = diagnose(dir.path(), &run_with(dir.path(), "m.toml", &["--until", "2035-03-07T09:20:00Z"]));
    let (found, on, expression, pull) = formula_beside(&d, gain.per_k);
    let about_k = expression.strip_prefix("(hk.panel_k - ").and_then(|e| e.strip_suffix(") * used.mps_force_srf_n.z"));
    let about_k: f64 = about_k.and_then(|k| k.parse().ok()).unwrap_or_else(|| panic!("{found:#}"));
    assert!(on == "sc.force.z" && pull.abs() < 4.0, "{pull} {found:#}");
    // At the temperature about which the formula is written the gain is not zero, and may be named by itself.
    for c in d["candidates"].as_array().expect("a list").iter().filter(|c| c["accepted"] == true) {
        let [value, sigma] = ["value", "sigma"].map(|key| c[key].as_f64().expect("a number"));
        let right = (value - gain.per_k * (about_k - 310.0)).abs() < 4.0 * sigma;
        assert!(c["coefficient"] == "mps-gain.sc.z" && right, "{c:#}");
    }

    std::fs::write(dir.path().join("d.json"), d.to_string()).expect("writable");
    let name = format!("formula:{}", found["instance"].as_str().expect("a name"));
    let proposed = held_out_fall(dir.path(), "proposed.toml", &[&name, "--from", "d.json"]);
    let with = |expression: &str, unit: &str, range: &str| {
        let set = ["acts_on=sc.force.z", expression, unit, range];
        let set: Vec<&str> = set.into_iter().flat_map(|set| ["--set", set]).collect();
        held_out_fall(dir.path(), &format!("{}.toml", unit.len()), &[&["formula:panel"][..], &set].concat())
    };
    let knew = with("expression=(hk.panel_k - 310) * command.mps_force.z", "unit=K-1", "range=-0.3,0.3");
    let alone = with("expression=hk.panel_k - 310", "unit=N K-1", "range=-3e-6,3e-6");
    assert!((proposed / knew - 1.0).abs() < 0.1, "{proposed} of {knew}");
    assert!(alone < 0.9 * knew, "{alone} of {knew}: the twin would pass");
}

/// Largest displacement along an axis that is read, m, and attitude error, rad, of samples.
fn largest(records: impl Iterator<Item = Record>) -> (f64, f64) {
    records.fold((0.0, 0.0), |(r, angle), record| {
        let shown = record.ifo_x_m.into_iter().chain(record.is_r_m.into_iter().flatten());
        let turned = record.dws_sc_rad.into_iter().map(f64::abs).fold(angle, f64::max);
        (shown.map(f64::abs).fold(r, f64::max), turned)
    })
}

/// Flights with everything that a seed draws, hidden effects among it, stay where their noise holds them: for an hour
/// for many seeds, for a day for some.
#[test]
fn drawn_loops_are_stable() {
    let hours = (1..=60).map(|seed| (seed, 1.0)).chain((1..=3).map(|seed| (seed, 24.0)));
    for (seed, hours) in hours {
        let Draw { mut flight, variation, .. } = Draw::new(seed, hours, false);
        flight.hidden.blow = None;
        // Half an hour is many time constants of the slowest loop.
        let (r, angle) = largest(Spacecraft::new(&flight, &variation).skip(18_000));
        assert!(r < 3e-7 && angle < 3e-8, "seed {seed}, {hours} h: {r:e} m, {angle:e} rad, {:?}", flight.loops);
    }
}

/// Clean sets of different seeds differ in their controllers, by up to a factor of three, and in half of them the noise
/// is what the mission file declares.
#[test]
fn drawn_flights_differ() {
    let all: Vec<Draw> = (1..=200).map(|seed| Draw::new(seed, 6.0, true)).collect();
    assert!(all.iter().all(|d| d.acted.is_empty() && d.flight.hidden == Hidden::NONE));
    for (a, b) in all.iter().zip(&all[1..]) {
        assert_ne!(a.flight.loops, b.flight.loops);
    }
    let axes: [fn(&Draw) -> f64; 4] =
        [|d| d.variation.attitude[1], |d| d.flight.loops.x, |d| d.flight.loops.y, |d| d.flight.loops.z];
    for of in axes {
        let (low, high) = all.iter().map(of).fold((f64::MAX, 0.0_f64), |(a, b), w| (a.min(w), b.max(w)));
        assert!((2.7..3.1).contains(&(high / low)), "{low} to {high}");
    }
    let exact = all.iter().filter(|d| d.true_levels(0.0).is_empty() && d.deviation == [1.0; 5]).count();
    let holed = all.iter().filter(|d| !d.gaps_s.is_empty()).count();
    let settled = all.iter().filter(|d| d.variation.start == Start::SETTLED).count();
    assert!((72..=128).contains(&exact) && (72..=128).contains(&settled), "{exact} {settled}");
    assert!((40..=94).contains(&holed), "{holed}");
    assert_eq!(Draw::new(7, 6.0, true), Draw::new(7, 6.0, true));
}
