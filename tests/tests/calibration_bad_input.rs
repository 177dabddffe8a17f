//! Bad input and the calibration: what is missing or wrong is left out and counted, and what is left gives the right offsets.
//!
//! All tests change copies of the same six hours (seed 1). Every product's coefficients must lie within 3σ of the truth: with the
//! noise of one seed that is one draw of twelve correlated numbers, so a right program fails with probability 3.2 % at
//! most (union bound), whatever the number of tests. That a wrong offset would be seen is the last test's business.

use dragfree_tests::recording::{Message, Recording};
use dragfree_tests::{coefficient, dragfree, fixture, simulate};
use serde_json::Value;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;
use tempfile::TempDir;

const SECOND_NS: u64 = 1_000_000_000;
const EPOCHS: u64 = 216_000;

/// The offsets of the paper's Table tab:com_calibration_results, m.
const TRUTH_M: [(&str, f64); 6] = [
    ("com-offset.tm1.x", 0.090_866_025_403_784_44),
    ("com-offset.tm1.y", 0.155_384_572_681_198_96),
    ("com-offset.tm1.z", 0.0),
    ("com-offset.tm2.x", 0.090_866_025_403_784_44),
    ("com-offset.tm2.y", -0.155_384_572_681_198_96),
    ("com-offset.tm2.z", 0.0),
];

/// Six hours of telemetry, made once.
fn sound() -> &'static (TempDir, PathBuf, Recording) {
    static SOUND: OnceLock<(TempDir, PathBuf, Recording)> = OnceLock::new();
    SOUND.get_or_init(|| {
        let dir = tempfile::tempdir().expect("a temporary folder");
        let file = simulate(dir.path(), &["--hours", "6", "--seed", "1"]).remove(0);
        let recording = Recording::read(&file);
        (dir, file, recording)
    })
}

/// What came of a run.
struct Run {
    code: Option<i32>,
    stderr: String,
    product: Value,
}

impl Run {
    fn count(&self, stage: &str, what: &str) -> u64 {
        self.product["quality"]["counts"][stage][what].as_u64().unwrap_or(0)
    }

    fn used(&self) -> u64 {
        self.product["epochs_used"].as_u64().expect("a count")
    }

    fn rejected(&self) -> u64 {
        self.product["epochs_rejected"].as_u64().expect("a count")
    }

    fn notes(&self) -> String {
        self.product["quality"]["notes"].to_string()
    }
}

/// A run of science mode over `files` with the mission and the model given.
fn run(folder: &Path, files: &[PathBuf], mission: Option<&Path>, model: Option<&Path>) -> Run {
    let mut command = dragfree(folder);
    command.arg("run").arg(fixture("pipelines/science-mode.toml")).args(files).args(["--archive", "archive", "--json"]);
    for (option, path) in [("--mission", mission), ("--model", model)] {
        if let Some(path) = path {
            command.arg(option).arg(path);
        }
    }
    let output = command.output().expect("the program runs");
    let stderr = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.code().is_some() && !stderr.contains("panicked"), "{stderr}");
    Run { code: output.status.code(), stderr, product: serde_json::from_slice(&output.stdout).unwrap_or(Value::Null) }
}

/// A run over the six hours as `change` leaves them.
fn run_changed(change: impl FnMut(Message) -> Option<Message>) -> Run {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let file = dir.path().join("changed.mcap");
    sound().2.write(&file, change);
    run(dir.path(), &[file], None, None)
}

/// The mission file with a text replaced.
fn mission(folder: &Path, from: &str, to: &str) -> PathBuf {
    let text = std::fs::read_to_string(fixture("missions/taiji.toml")).expect("readable");
    assert!(text.contains(from), "{from}");
    let path = folder.join("mission.toml");
    std::fs::write(&path, text.replace(from, to)).expect("writable");
    path
}

/// Whether a message lies in a stretch of the six hours, s.
fn within(message: &Message, from_s: u64, until_s: u64) -> bool {
    let start = sound().2.start_ns();
    (start + from_s * SECOND_NS..start + until_s * SECOND_NS).contains(&message.log_time)
}

fn is(message: &Message, topic: &str) -> bool {
    *message.topic == *topic
}

/// Errors over σ of all coefficients that have a σ.
fn pulls(product: &Value) -> Vec<(String, f64)> {
    let all = TRUTH_M.iter().flat_map(|(name, truth)| ["es-akf", "qp"].map(|solution| (name, truth, solution)));
    let of = |(name, truth, solution): (&&str, &f64, &str)| {
        let (value, sigma) = coefficient(product, name, solution);
        (format!("{name} by {solution}"), (value - truth) / sigma)
    };
    all.map(|(name, truth, solution)| of((name, truth, solution))).collect()
}

fn assert_right(run: &Run) {
    for (name, pull) in pulls(&run.product) {
        assert!(pull.abs() <= 3.0, "{name} is {pull:.2}σ from the truth\n{}", run.notes());
    }
}

/// The product of the telemetry as it is.
fn reference() -> &'static Run {
    static REFERENCE: OnceLock<Run> = OnceLock::new();
    REFERENCE.get_or_init(|| {
        let dir = tempfile::tempdir().expect("a temporary folder");
        run(dir.path(), &[sound().1.clone()], None, None)
    })
}

/// Runs without an intact third of the day are right and wider, never narrower.
fn assert_wider(run: &Run, factor: std::ops::RangeInclusive<f64>) {
    for name in ["com-offset.tm1.y", "com-offset.tm1.z", "com-offset.tm2.y", "com-offset.tm2.z"] {
        let ratio = coefficient(&run.product, name, "qp").1 / coefficient(&reference().product, name, "qp").1;
        assert!(factor.contains(&ratio), "{name}: σ grew by {ratio}, not within {factor:?}");
    }
}

#[test]
fn sound_telemetry_is_the_measure() {
    assert_eq!(reference().code, Some(0), "{}", reference().stderr);
    assert_eq!((reference().used(), reference().rejected()), (EPOCHS, 0));
    assert_right(reference());
}

#[test]
fn gaps_of_seconds_minutes_and_hours_are_left_out() {
    const GAPS_S: [(u64, u64); 5] = [(1_000, 1_003), (2_000, 2_001), (4_000, 4_060), (5_000, 5_300), (9_000, 16_200)];
    let run = run_changed(|m| (!GAPS_S.iter().any(|(from, until)| within(&m, *from, *until))).then_some(m));
    assert_eq!(run.code, Some(0), "{}", run.stderr);
    let lost: u64 = GAPS_S.iter().map(|(from, until)| (until - from) * 10).sum();
    assert_eq!((run.used(), run.rejected()), (EPOCHS - lost, lost));
    assert!(run.notes().contains("7200.0 s from 2035-01-01T02:30:00"), "{}", run.notes());
    assert_right(&run);
    // 65 % of the epochs are left: σ grows by 1.24, and by more for what the edges of stretches cost.
    assert_wider(&run, 1.15..=2.2);
}

/// Without one instrument for two of six hours the epochs of those hours are lost to whoever needs it; σ grows by √(6/4).
#[test]
fn an_instrument_that_is_silent_for_hours_costs_those_hours() {
    for topic in ["/ifo", "/is"] {
        let run = run_changed(|m| (!(is(&m, topic) && within(&m, 7_200, 14_400))).then_some(m));
        assert_eq!(run.code, Some(0), "{topic}: {}", run.stderr);
        let table = &topic[1..];
        assert_eq!(run.count("preprocess", &format!("{table}.missing_epochs")), 72_000);
        let said = format!("{table}: no sample at 72000 of 216000 epochs");
        assert!(run.notes().contains(&said), "{}", run.notes());
        assert_eq!(run.rejected(), if topic == "/is" { 72_000 } else { 0 }, "x has two instruments, y and z have one");
        assert_right(&run);
        assert_wider(&run, 1.15..=1.5);
    }
}

/// Where nobody knows the attitude nobody knows the angular acceleration: it is left out, not replaced by the commanded torque,
/// which would pull x by centimetres.
#[test]
fn an_attitude_that_is_silent_for_hours_is_not_made_of_commands() {
    let run = run_changed(|m| (!(is(&m, "/dws") && within(&m, 7_200, 14_400))).then_some(m));
    assert_eq!((run.code, &run.product["verdict"]), (Some(0), &Value::from("agree")), "{} {}", run.stderr, run.notes());
    assert_eq!((run.used(), run.rejected()), (EPOCHS - 72_000, 72_000));
    assert_eq!(run.count("hinf-dfacs", "attitude_missing"), 72_000);
    assert_right(&run);
    assert_wider(&run, 1.15..=1.5);
}

/// A model of the first test mass alone.
fn model_of_tm1(folder: &Path) -> PathBuf {
    let path = folder.join("model.toml");
    let effect = "[[effect]]\nid = \"com-offset\"\ninstance = \"tm1\"\n";
    std::fs::write(&path, format!("[model]\nrevision = \"1\"\n{effect}")).expect("writable");
    path
}

/// Right offsets of the first test mass, and none of the second. Without the survey x is hardly seen, so `agree` and `weak` are both
/// right words, `disagree` is not.
fn assert_tm1_is_right(run: &Run) {
    assert_eq!(run.code, Some(0), "{} {}", run.stderr, run.notes());
    for (name, truth) in &TRUTH_M[..3] {
        for solution in ["es-akf", "qp"] {
            let (value, sigma) = coefficient(&run.product, name, solution);
            let pull = (value - truth) / sigma;
            assert!(pull.abs() <= 3.0, "{name} by {solution} is {pull:.2}σ from the truth\n{}", run.notes());
            assert!(name.ends_with('x') || sigma < 2e-3, "{name} by {solution}: {sigma}");
        }
    }
    let all = run.product["coefficients"].to_string();
    assert!(!all.contains("com-offset.tm2"), "{all}");
}

#[test]
fn a_model_of_one_test_mass_is_right_beside_data_of_both() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let model = model_of_tm1(dir.path());
    assert_tm1_is_right(&run(dir.path(), std::slice::from_ref(&sound().1), None, Some(&model)));
}

#[test]
fn a_test_mass_without_any_data_does_not_take_the_other_with_it() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let file = dir.path().join("changed.mcap");
    sound().2.write(&file, |mut m| {
        match &*m.topic {
            "/is" | "/ifo" | "/dws" => m.remove(2),
            "/command" => m.remove(4),
            _ => {}
        }
        Some(m)
    });
    let model = model_of_tm1(dir.path());
    assert_tm1_is_right(&run(dir.path(), &[file], None, Some(&model)));
}

/// Commands that were not sent down are rebuilt by the control law, to 1e-9: the offsets are those of the whole telemetry.
#[test]
fn commands_missing_for_hours_are_rebuilt_and_said_to_be() {
    let run = run_changed(|m| (!(is(&m, "/command") && within(&m, 7_200, 14_400))).then_some(m));
    assert_eq!(run.code, Some(0), "{}", run.stderr);
    assert_eq!(run.count("hinf-dfacs", "commands_replayed"), 72_000);
    assert_eq!(run.count("hinf-dfacs", "commands_telemetered"), EPOCHS - 72_000);
    assert_eq!(run.product["commands"], "telemetered");
    assert!(run.notes().contains("commands of 72000 of 216000 epochs were not telemetered"), "{}", run.notes());
    assert!(run.notes().contains("command: no sample at 72000 of 216000 epochs"), "{}", run.notes());
    assert_near(&run, 1e-3);
}

/// Before the replayed law has settled there is nothing to rebuild commands from: those epochs are not used.
#[test]
fn commands_missing_from_the_start_are_not_invented() {
    let run = run_changed(|m| (!(is(&m, "/command") && within(&m, 0, 3_600))).then_some(m));
    assert_eq!(run.code, Some(0), "{}", run.stderr);
    assert_eq!(run.count("hinf-dfacs", "commands_missing"), 36_000);
    assert_eq!(run.count("hinf-dfacs", "commands_replayed"), 0);
    assert_right(&run);
    // Five of six hours are left: √(6/5).
    assert_wider(&run, 1.0..=1.3);
}

/// The coefficients are those of the sound telemetry to a part of σ.
fn assert_near(run: &Run, part_of_sigma: f64) {
    for (name, _) in TRUTH_M {
        for solution in ["es-akf", "qp"] {
            let (value, sigma) = coefficient(&run.product, name, solution);
            let (sound, _) = coefficient(&reference().product, name, solution);
            let moved = (value - sound).abs() / sigma;
            assert!(moved <= part_of_sigma, "{name} by {solution} moved by {moved:.1e}σ\n{}", run.notes());
        }
    }
}

#[test]
fn status_flags_take_values_out_and_are_counted() {
    let run = run_changed(|mut m| {
        if is(&m, "/is") && within(&m, 3_000, 3_600) {
            m.set_number(&[1, 3], 1);
        }
        if is(&m, "/ifo") && within(&m, 6_000, 6_300) {
            m.set_number(&[2, 2], 2);
        }
        Some(m)
    });
    assert_eq!(run.code, Some(0), "{}", run.stderr);
    // Three displacements and three angles of one test mass; one displacement.
    assert_eq!(run.count("preprocess", "is.status_values"), 6 * 6_000);
    assert_eq!(run.count("preprocess", "ifo.status_values"), 3_000);
    assert_eq!((run.used(), run.rejected()), (EPOCHS, 0), "the other test mass goes on");
    assert!(run.notes().contains("is: values left out: 36000 under a status flag"), "{}", run.notes());
    assert_right(&run);
}

/// A readout at its limit says the same number again and again, or one that no test mass can have.
#[test]
fn saturated_readouts_are_left_out_and_counted() {
    let run = run_changed(|mut m| {
        if is(&m, "/is") && within(&m, 3_000, 3_600) {
            m.set_double(&[1, 1, 2], 5e-6);
        }
        if is(&m, "/ifo") && within(&m, 12_000, 12_030) {
            m.set_double(&[2, 1], 1.0);
        }
        Some(m)
    });
    assert_eq!(run.code, Some(0), "{}", run.stderr);
    assert_eq!(run.count("preprocess", "is.stuck_values"), 6_000);
    assert_eq!(run.count("preprocess", "ifo.limit_values"), 300);
    assert_eq!(run.rejected(), 0, "the other test mass goes on");
    assert!(run.notes().contains("6000 repeated exactly"), "{}", run.notes());
    assert!(run.notes().contains("300 beyond [limits] of the mission file"), "{}", run.notes());
    assert_right(&run);
}

/// Outliers of 20 standard deviations of a sample in one of a thousand samples of one channel.
fn outliers(topic: &str, path: &[u64], sample_sigma: f64, sigmas: f64) -> (Run, u64) {
    let (mut k, mut put) = (0u64, 0);
    let run = run_changed(|mut m| {
        if is(&m, topic) {
            k += 1;
            // Knuth's multiplier scatters them.
            if k.wrapping_mul(6_364_136_223_846_793_005) >> 33 < (1 << 31) / 1000 {
                let value = m.double(path).expect("sent");
                m.set_double(path, value + sigmas * sample_sigma * if k % 2 == 0 { 1.0 } else { -1.0 });
                put += 1;
            }
        }
        Some(m)
    });
    (run, put)
}

/// White readout noise of one-sided ASD `a` at 10 Hz has the standard deviation `a √5` per sample; 20 of them make 16 standard
/// deviations of a second difference. They are removed, counted, and bridged in the channels: the offsets and their σ stay as they are.
#[test]
fn outliers_in_one_of_a_thousand_samples_do_no_harm() {
    for (topic, path, asd) in [
        ("/is", &[1, 1, 2][..], 1.8e-9),
        ("/is", &[2, 1, 3], 1.8e-9),
        ("/ifo", &[1, 1], 1.42e-12),
        ("/dws", &[3, 3], 5e-10),
    ] {
        let (run, put) = outliers(topic, path, asd * 5f64.sqrt(), 20.0);
        assert!((150..300).contains(&put), "{put}");
        assert!(matches!(run.code, Some(0)), "{topic}: {} {}", run.stderr, run.notes());
        assert_right(&run);
        assert_wider(&run, 0.95..=1.1);
        let counted = run.count("preprocess", &format!("{}.outlier_values", &topic[1..]));
        // The lines before and after must agree to five standard deviations of a sample, of which slopes from two samples take up to
        // three by noise alone and the attitude's jitter some more: not every outlier is proved one.
        assert!(counted >= put * 4 / 5 && counted <= put, "{topic}: {counted} of {put} were counted");
    }
}

#[test]
fn constant_data_are_not_data() {
    for (topic, paths) in [("/dws", &[[3, 1], [3, 2], [3, 3]][..]), ("/is", &[[1, 1], [2, 1]])] {
        let run = run_changed(|mut m| {
            if is(&m, topic) {
                for path in paths {
                    let deeper: Vec<Vec<u64>> = if topic == "/is" {
                        (1..=3).map(|axis| [&path[..], &[axis]].concat()).collect()
                    } else {
                        vec![path.to_vec()]
                    };
                    deeper.iter().for_each(|path| m.set_double(path, 1e-9));
                }
            }
            Some(m)
        });
        assert_eq!(run.code, Some(3), "{topic}: {} {}", run.stderr, run.notes());
        assert_eq!((run.used(), run.rejected()), (0, EPOCHS));
        assert!(run.notes().contains("not one of 216000 epochs has all mandatory channels"), "{}", run.notes());
        assert_eq!(run.product["verdict"], "weak");
        let unseen = run.product["weak_directions"].to_string();
        for (name, _) in TRUTH_M {
            assert!(unseen.contains(name), "{unseen}");
        }
    }
}

/// A drawing that is off by 15 mm within the box costs nothing.
#[test]
fn a_nominal_offset_far_away_within_its_box_does_no_harm() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let mission = mission(dir.path(), NOMINAL_TM1, "offset_nominal_srf_m = [0.0, 0.195, 0.0] ");
    let run = run(dir.path(), std::slice::from_ref(&sound().1), Some(&mission), None);
    assert_eq!((run.code, &run.product["verdict"]), (Some(0), &Value::from("agree")), "{} {}", run.stderr, run.notes());
    assert_right(&run);
    // It stands in the noise model alone, where a few per cent of Σ move the QP by parts of σ.
    for (name, _) in TRUTH_M {
        let (value, sigma) = coefficient(&run.product, name, "qp");
        let (sound, _) = coefficient(&reference().product, name, "qp");
        assert!((value - sound).abs() < 0.2 * sigma, "{name}: {value} against {sound} ± {sigma}");
    }
}

const NOMINAL_TM1: &str = "offset_nominal_srf_m = [0.0, 0.18, 0.0] ";

/// A box that does not hold the truth is contradicted by name.
#[test]
fn a_box_beside_the_truth_is_contradicted() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let mission = mission(dir.path(), NOMINAL_TM1, "offset_nominal_srf_m = [0.0, 0.205, 0.0] ");
    let run = run(dir.path(), std::slice::from_ref(&sound().1), Some(&mission), None);
    assert_eq!(
        (run.code, &run.product["verdict"]),
        (Some(4), &Value::from("disagree")),
        "{} {}",
        run.stderr,
        run.notes()
    );
    assert!(run.notes().contains("com-box.tm1.y contradicts the data"), "{}", run.notes());
}

/// Nonsense is refused by key before a byte of telemetry is read.
#[test]
fn nonsense_in_mission_and_model_is_refused_by_key() {
    let prior = |line: &str| format!("estimate = true\n[effect.prior.x]\n{line}");
    let model = |line: &str| ("models/com-offset.toml", "--model", "estimate = true".to_owned(), prior(line));
    let mission = |from: &str, to: &str| ("missions/taiji.toml", "--mission", from.to_owned(), to.to_owned());
    let tolerance = "baseline_tolerance_m = 2e-5";
    for ((file, option, from, to), said) in [
        (model("sigma = -1e-3"), "prior.x"),
        (model("sigma = 0.0"), "prior.x"),
        (model("sigma = nan"), "prior.x"),
        (model("value = inf"), "prior.x"),
        (model("lower = 0.1\nupper = 0.1"), "prior.x: the range from 0.1 to 0.1 m is empty"),
        (model("lower = 0.2"), "prior.x: the range from 0.2"),
        (model("mean = 0.1"), "mean"),
        (mission("offset_box_srf_m = [0.02, 0.02, 0.02]", "offset_box_srf_m = [0.02, 0.0, 0.02]"), "offset_box_srf_m"),
        (
            mission("offset_box_srf_m = [0.02, 0.02, 0.02]", "offset_box_srf_m = [0.02, -0.02, 0.02]"),
            "offset_box_srf_m",
        ),
        (mission(tolerance, "baseline_tolerance_m = 0.0"), "baseline_tolerance_m"),
        (mission(tolerance, "baseline_tolerance_m = -2e-5"), "baseline_tolerance_m"),
        (mission("baseline_srf_m = [0.0, 0.36, 0.0]", "baseline_srf_m = [0.0, 0.36]"), "housing.baseline_srf_m"),
        (mission("baseline_srf_m = [0.0, 0.36, 0.0]", "baseline_srf_m = [0.0, nan, 0.0]"), "housing.baseline_srf_m"),
        (mission(tolerance, ""), "housing: missing field `baseline_tolerance_m`"),
        (mission("baseline_tolerance_m", "baseline_tolerance_mm"), "housing.baseline_tolerance_mm: unknown field"),
        // Not positive definite: a principal moment below zero.
        (
            mission("[800.0, 13.0, 10.0], [13.0, 800.0, 12.0]", "[800.0, 900.0, 10.0], [900.0, 800.0, 12.0]"),
            "inertia_srf_kg_m2",
        ),
    ] {
        let dir = tempfile::tempdir().expect("a temporary folder");
        let text = std::fs::read_to_string(fixture(file)).expect("readable");
        assert!(text.contains(&from), "{from}");
        std::fs::write(dir.path().join("changed.toml"), text.replacen(&from, &to, 1)).expect("writable");
        let mut command = dragfree(dir.path());
        command.arg("run").arg(fixture("pipelines/science-mode.toml")).arg(&sound().1);
        let output = command.args(["--archive", "archive", option, "changed.toml"]).output().expect("runs");
        let stderr = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(1), "{to}: {stderr}");
        assert!(stderr.contains(said) && !stderr.contains("panicked"), "{to} should say {said}: {stderr}");
        assert!(!dir.path().join("archive").join("COM1B_2035-01-01_SC1_01_0001.toml").exists());
    }
}

/// The twin of every test here: offsets 5 mm beside the truth are not within 3σ.
#[test]
fn offsets_beside_the_truth_are_seen() {
    let far = TRUTH_M.iter().filter(|(name, _)| !name.ends_with('x'));
    for (name, truth) in far {
        for solution in ["es-akf", "qp"] {
            let (value, sigma) = coefficient(&reference().product, name, solution);
            assert!((value - truth - 5e-3).abs() > 3.0 * sigma, "{name} by {solution}: {value} ± {sigma}");
        }
    }
}
