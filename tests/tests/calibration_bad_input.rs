//! Bad input and the calibration: missing or invalid data are excluded and counted, and the offsets stay right.
//!
//! All tests change copies of the same six hours (seed 1). Coefficients must lie within 3σ of the truth: one draw of
//! twelve correlated numbers, which fails with a probability of at most 3.2 % (union bound), whatever the number of
//! tests. The last test checks that a wrong offset is detected.

use dragfree_tests::calibration::{Run, TRUTH_M, changed_mission, science_mode};
use dragfree_tests::recording::{Message, Recording};
use dragfree_tests::{coefficient, fixture, simulate};
use rand::SeedableRng as _;
use rand_distr::{Distribution as _, StandardNormal};
use rand_xoshiro::Xoshiro256PlusPlus;
use serde_json::Value;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;
use tempfile::TempDir;

const SECOND_NS: u64 = 1_000_000_000;
const EPOCHS: u64 = 216_000;

/// Six hours of telemetry, simulated once.
fn sound() -> &'static (TempDir, PathBuf, Recording) {
    static SOUND: OnceLock<(TempDir, PathBuf, Recording)> = OnceLock::new();
    SOUND.get_or_init(|| {
        let dir = tempfile::tempdir().expect("a temporary folder");
        let file = simulate(dir.path(), &["--hours", "6", "--seed", "1"]).remove(0);
        let recording = Recording::read(&file);
        (dir, file, recording)
    })
}

/// A run of science mode over `files` with the mission and the model given.
fn run(folder: &Path, files: &[PathBuf], mission: Option<&Path>, model: Option<&Path>) -> Run {
    let mut command = science_mode(folder);
    command.args(files);
    for (option, path) in [("--mission", mission), ("--model", model)] {
        if let Some(path) = path {
            command.arg(option).arg(path);
        }
    }
    Run::of(&mut command)
}

/// A run over the six hours changed by `change`.
fn run_changed(change: impl FnMut(Message) -> Option<Message>) -> Run {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let file = dir.path().join("changed.mcap");
    sound().2.write(&file, change);
    run(dir.path(), &[file], None, None)
}

/// Whether a message lies in an interval of the six hours, s.
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

/// The product of the unchanged telemetry.
fn reference() -> &'static Run {
    static REFERENCE: OnceLock<Run> = OnceLock::new();
    REFERENCE.get_or_init(|| {
        let dir = tempfile::tempdir().expect("a temporary folder");
        run(dir.path(), &[sound().1.clone()], None, None)
    })
}

/// Runs that lack a third of the data are right, with larger σ.
fn assert_wider(run: &Run, factor: std::ops::RangeInclusive<f64>) {
    for name in ["com-offset.tm1.y", "com-offset.tm1.z", "com-offset.tm2.y", "com-offset.tm2.z"] {
        let ratio = coefficient(&run.product, name, "qp").1 / coefficient(&reference().product, name, "qp").1;
        assert!(factor.contains(&ratio), "{name}: σ grew by {ratio}, not within {factor:?}");
    }
}

#[test]
fn sound_telemetry_is_the_measure() {
    assert_eq!(reference().code, Some(0), "{}", reference().stderr);
    assert_eq!(reference().epochs(), (EPOCHS, 0));
    assert_right(reference());
}

#[test]
fn gaps_of_seconds_minutes_and_hours_are_excluded() {
    const GAPS_S: [(u64, u64); 5] = [(1_000, 1_003), (2_000, 2_001), (4_000, 4_060), (5_000, 5_300), (9_000, 16_200)];
    let run = run_changed(|m| (!GAPS_S.iter().any(|(from, until)| within(&m, *from, *until))).then_some(m));
    assert_eq!(run.code, Some(0), "{}", run.stderr);
    let lost: u64 = GAPS_S.iter().map(|(from, until)| (until - from) * 10).sum();
    assert_eq!(run.epochs(), (EPOCHS - lost, lost));
    assert!(run.notes().contains("7200.0 s from 2035-01-01T02:30:00"), "{}", run.notes());
    assert_right(&run);
    // 65 % of the epochs remain: σ grows by 1.24, and more for the edges of intervals.
    assert_wider(&run, 1.15..=2.2);
}

/// An instrument that is missing for two of six hours loses those epochs; σ grows by √(6/4).
#[test]
fn a_missing_instrument_loses_its_epochs() {
    for topic in ["/ifo", "/is"] {
        let run = run_changed(|m| (!(is(&m, topic) && within(&m, 7_200, 14_400))).then_some(m));
        assert_eq!(run.code, Some(0), "{topic}: {}", run.stderr);
        let table = &topic[1..];
        assert_eq!(run.count("preprocess", &format!("{table}.missing_epochs")), 72_000);
        let said = format!("{table}: no sample at 72000 of 216000 epochs");
        assert!(run.notes().contains(&said), "{}", run.notes());
        assert_eq!(run.epochs().1, if topic == "/is" { 72_000 } else { 0 }, "x has two instruments, y and z have one");
        assert_right(&run);
        assert_wider(&run, 1.15..=1.5);
    }
}

/// Without attitude the angular acceleration is unknown; the commanded torque in its place would bias x by centimetres.
#[test]
fn a_missing_attitude_is_not_replaced_by_commands() {
    let run = run_changed(|m| (!(is(&m, "/dws") && within(&m, 7_200, 14_400))).then_some(m));
    run.assert_ended(0, "agree");
    assert_eq!(run.epochs(), (EPOCHS - 72_000, 72_000));
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

/// Right offsets of the first test mass, none of the second. Without the survey x is hardly observable, so `agree` and
/// `weak` are both acceptable.
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
fn a_model_of_one_test_mass_is_right_with_data_of_both() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let model = model_of_tm1(dir.path());
    assert_tm1_is_right(&run(dir.path(), std::slice::from_ref(&sound().1), None, Some(&model)));
}

#[test]
fn a_test_mass_without_data_does_not_affect_the_other() {
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

/// Missing commands are rebuilt from the control law to 1e-9: the offsets equal those of the whole telemetry.
#[test]
fn missing_commands_are_rebuilt_and_reported() {
    let run = run_changed(|m| (!(is(&m, "/command") && within(&m, 7_200, 14_400))).then_some(m));
    assert_eq!(run.code, Some(0), "{}", run.stderr);
    assert_eq!(run.count("hinf-dfacs", "commands_replayed"), 72_000);
    assert_eq!(run.count("hinf-dfacs", "commands_telemetered"), EPOCHS - 72_000);
    assert_eq!(run.product["commands"], "telemetered");
    assert!(run.notes().contains("commands of 72000 of 216000 epochs were not telemetered"), "{}", run.notes());
    assert!(run.notes().contains("command: no sample at 72000 of 216000 epochs"), "{}", run.notes());
    assert_near(&run, 1e-3);
}

/// Commands cannot be rebuilt before the replayed law has settled; those epochs are not used.
#[test]
fn commands_missing_from_the_start_are_not_rebuilt() {
    let run = run_changed(|m| (!(is(&m, "/command") && within(&m, 0, 3_600))).then_some(m));
    assert_eq!(run.code, Some(0), "{}", run.stderr);
    assert_eq!(run.count("hinf-dfacs", "commands_missing"), 36_000);
    assert_eq!(run.count("hinf-dfacs", "commands_replayed"), 0);
    assert_right(&run);
    // Five of six hours remain: √(6/5).
    assert_wider(&run, 1.0..=1.3);
}

/// The coefficients equal those of the unchanged telemetry within a fraction of σ.
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
fn flagged_values_are_excluded_and_counted() {
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
    assert_eq!(run.epochs(), (EPOCHS, 0), "the other test mass goes on");
    assert!(run.notes().contains("is: invalid values: 36000 under a status flag"), "{}", run.notes());
    assert_right(&run);
}

/// A saturated readout repeats a number, or exceeds the displacement of any test mass.
#[test]
fn saturated_readouts_are_excluded_and_counted() {
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
    assert_eq!(run.epochs().1, 0, "the other test mass goes on");
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
            // Knuth's multiplicative hash scatters them.
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

/// Expected detection rate of single outliers of `sigmas` standard deviations in white noise at the default
/// `outlier_sigma` of ten, by the three conditions of `preprocess::outliers`, sampled directly. The second difference
/// has √6 σ.
fn found_in_white_noise(sigmas: f64) -> f64 {
    const DRAWS: u32 = 40_000;
    const AT: usize = 12;
    let mut rng = Xoshiro256PlusPlus::seed_from_u64(1);
    let found = (0..DRAWS).filter(|_| {
        let mut x: [f64; 25] = std::array::from_fn(|_| StandardNormal.sample(&mut rng));
        x[AT] += sigmas;
        let chord = 0.5 * (x[AT + 1] - x[AT - 1]);
        let deviation = (x[AT] - 0.5 * (x[AT + 1] + x[AT - 1])).abs();
        let slopes = [x[AT - 1] - x[AT - 2], x[AT + 2] - x[AT + 1]];
        let around = (AT - 10..AT - 1).chain(AT + 2..AT + 11);
        let mut around: Vec<f64> = around.map(|k| (x[k + 1] - 2.0 * x[k] + x[k - 1]).abs()).collect();
        around.sort_by(f64::total_cmp);
        // The median of |x| is 0.6745 for a standard normal x.
        let local = around[around.len() / 2] / 0.6745;
        deviation > 5.0 * 6f64.sqrt().max(local) && slopes.iter().all(|s| (s - chord).abs() <= deviation / 4.0)
    });
    found.count() as f64 / f64::from(DRAWS)
}

/// White readout noise of one-sided ASD `a` at 10 Hz has σ = `a √5` per sample; 20σ make 16 standard deviations of a
/// second difference. They are removed, counted and bridged; the offsets stay.
#[test]
fn outliers_in_one_of_a_thousand_samples_do_no_harm() {
    let promised = found_in_white_noise(20.0);
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
        let (n, scatter) = (put as f64, 3.9 * (put as f64 * promised * (1.0 - promised)).sqrt());
        let allowed = n * (promised - 0.005) - scatter..=(n * promised + scatter).min(n);
        assert!(
            allowed.contains(&(counted as f64)),
            "{topic}: {counted} of {put} were counted, not within {allowed:?}"
        );
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
        assert_eq!(run.epochs(), (0, EPOCHS));
        assert!(run.notes().contains("none of 216000 epochs has all mandatory channels"), "{}", run.notes());
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
    let mission =
        changed_mission(dir.path(), "mission.toml", &[(NOMINAL_TM1, "offset_nominal_srf_m = [0.0, 0.195, 0.0] ")]);
    let run = run(dir.path(), std::slice::from_ref(&sound().1), Some(&mission), None);
    run.assert_ended(0, "agree");
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
    let mission =
        changed_mission(dir.path(), "mission.toml", &[(NOMINAL_TM1, "offset_nominal_srf_m = [0.0, 0.205, 0.0] ")]);
    let run = run(dir.path(), std::slice::from_ref(&sound().1), Some(&mission), None);
    run.assert_ended(4, "disagree");
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
        let run = Run::of(science_mode(dir.path()).arg(&sound().1).args([option, "changed.toml"]));
        assert_eq!(run.code, Some(1), "{to}: {}", run.stderr);
        assert!(run.stderr.contains(said), "{to} should say {said}: {}", run.stderr);
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
