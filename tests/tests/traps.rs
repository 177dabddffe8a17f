//! Traps: telemetry or settings that look perfect to a filter and give wrong offsets. The verdict must not fall for them, and must
//! not cry wolf without them.
//!
//! Seeds are 1, 2 and 3. Nothing is tuned to them: what the tests ask of each is stated with its false-alarm rate.

use dragfree_tests::calibration::{Run, TRUTH_M, changed_mission, of_pipeline};
use dragfree_tests::{coefficient, dragfree, fixture};
use std::path::{Path, PathBuf};
use std::sync::OnceLock;
use tempfile::TempDir;

const SEEDS: [&str; 3] = ["1", "2", "3"];

fn simulated(mission: &Path) -> (TempDir, Vec<PathBuf>) {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let files = SEEDS.map(|seed| {
        let folder = dir.path().join(seed);
        let mut command = dragfree(dir.path());
        command.arg("simulate").arg(mission).arg("--out").arg(&folder).args(["--hours", "6", "--seed", seed]);
        dragfree_tests::expect(&mut command, 0);
        folder.join("SC1_2035-01-01.mcap")
    });
    (dir, files.to_vec())
}

/// Six hours of the default mission, one file a seed.
fn default_files() -> &'static [PathBuf] {
    static FILES: OnceLock<(TempDir, Vec<PathBuf>)> = OnceLock::new();
    &FILES.get_or_init(|| simulated(&fixture("missions/taiji.toml"))).1
}

const TORQUE: &str = "asd_nm_rthz = 1e-7 ";
const LOUD_TORQUE: &str = "asd_nm_rthz = 1e-6 ";
const SURVEY: &str = "baseline_srf_m = [0.0, 0.36, 0.0] ";

/// A spacecraft ten times as restless: its attitude says more of the offsets in six hours than the default one's in weeks.
fn restless() -> &'static (TempDir, Vec<PathBuf>) {
    static FILES: OnceLock<(TempDir, Vec<PathBuf>)> = OnceLock::new();
    FILES.get_or_init(|| {
        let dir = tempfile::tempdir().expect("a temporary folder");
        simulated(&changed_mission(dir.path(), "restless.toml", &[(TORQUE, LOUD_TORQUE)]))
    })
}

/// What the data say of a constraint: distance and σ, m.
fn pull(run: &Run, constraint: &str) -> (f64, f64) {
    let all = &run.product["quality"]["stages"]["qp-check"]["constraints"];
    let one = all.as_array().into_iter().flatten().find(|c| c["constraint"] == constraint);
    let one = one.unwrap_or_else(|| panic!("no {constraint} in {all}"));
    (one["distance"].as_f64().expect("a number"), one["sigma"].as_f64().expect("a number"))
}

/// A run of the stages of science mode, with parameters of hinf-dfacs and without the stages in `without`.
fn run(file: &Path, mission: &Path, parameters: &str, without: &[&str], arguments: &[&str]) -> Run {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let mut text = std::fs::read_to_string(fixture("pipelines/science-mode.toml")).expect("readable");
    text = text.replace("../", &format!("{}/", fixture("").display()));
    text =
        text.replace("plugin = \"hinf-dfacs\"", &format!("plugin = \"hinf-dfacs\"\nparameters = {{ {parameters} }}"));
    for stage in without {
        text = text.replace(&format!("[[stage]]\nplugin = \"{stage}\"\n"), "");
    }
    let pipeline = dir.path().join("pipeline.toml");
    std::fs::write(&pipeline, text).expect("writable");
    Run::of(of_pipeline(dir.path(), &pipeline).arg(file).arg("--mission").arg(mission).args(arguments))
}

const COMMANDED: &str = "angular_acceleration = \"commanded\"";

/// Without a trap: a contradiction is a false alarm with probability below 6 × 0.27 % (two solutions) + 0.1 % (survey) +
/// 6 × 0.01 % (box) per seed, 5.3 % for the three.
#[test]
fn sound_days_are_not_contradicted() {
    for file in default_files() {
        let run = run(file, &fixture("missions/taiji.toml"), "", &[], &[]);
        run.assert_ended(0, "agree");
    }
}

/// The paper's loop makes the thrusters' noise a part of the command: taken for the angular acceleration it pulls `b_x` of either
/// test mass by centimetres, and the innovations of the filter show nothing of it.
#[test]
fn a_commanded_torque_taken_for_the_angular_acceleration_is_a_disagreement() {
    for file in default_files() {
        let run = run(file, &fixture("missions/taiji.toml"), COMMANDED, &[], &[]);
        run.assert_ended(4, "disagree");
        // The trap is there: the filter is pleased, and wrong by centimetres.
        let nis = run.product["nis"].as_f64().expect("a number");
        assert!((nis - 1.0).abs() < 0.02, "{nis}");
        let (x_m, sigma_m) = coefficient(&run.product, "com-offset.tm1.x", "es-akf");
        assert!((x_m - TRUTH_M[0].1).abs() > 0.03, "{x_m} ± {sigma_m}");
        let notes = run.notes();
        for words in ["the survey contradicts the data", "baseline.y: the data alone put it", "multiplier", "coherent"]
        {
            assert!(notes.contains(words), "{words}: {notes}");
        }
        let (distance_m, sigma_m) = pull(&run, "baseline.y");
        assert!(distance_m.abs() > 8.0 * sigma_m && distance_m.abs() > 0.05, "{distance_m} ± {sigma_m}");
    }
}

/// The verdict hangs neither on the filter nor on the survey: the trap is seen with one of them missing, and with both.
#[test]
fn the_trap_is_seen_without_filter_and_without_survey() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let no_survey =
        changed_mission(dir.path(), "m.toml", &[("[housing]", ""), (SURVEY, "# "), ("baseline_tolerance_m", "# ")]);
    let file = &default_files()[0];
    for (mission, without) in
        [(&fixture("missions/taiji.toml"), &["es-akf"][..]), (&no_survey, &[]), (&no_survey, &["es-akf"])]
    {
        let trapped = run(file, mission, COMMANDED, without, &[]);
        assert_eq!(trapped.code, Some(4), "{without:?} {}: {} {}", mission.display(), trapped.stderr, trapped.notes());
        let sound = run(file, mission, "", without, &[]);
        assert_eq!(sound.code, Some(0), "{without:?} {}: {} {}", mission.display(), sound.stderr, sound.notes());
    }
}

/// The attitude's second difference as angular acceleration: errors in variables, 1 % of the offset is left.
#[test]
fn a_second_difference_taken_for_the_angular_acceleration_is_a_disagreement() {
    let parameters = "angular_acceleration = \"second-difference\"";
    for file in default_files() {
        let run = run(file, &fixture("missions/taiji.toml"), parameters, &[], &[]);
        run.assert_ended(4, "disagree");
        assert!(run.notes().contains("baseline.y: the data alone put it"), "{}", run.notes());
    }
}

/// A survey that is wrong by a millimetre along z, where the data are sharp enough to know. The distance that the product
/// tells is the millimetre within 3σ (three draws: a false alarm in 0.8 %).
#[test]
fn a_survey_wrong_by_a_millimetre_is_noticed() {
    let (dir, files) = restless();
    let right = changed_mission(dir.path(), "right.toml", &[(TORQUE, LOUD_TORQUE)]);
    let wrong = changed_mission(
        dir.path(),
        "wrong.toml",
        &[(TORQUE, LOUD_TORQUE), (SURVEY, "baseline_srf_m = [0.0, 0.36, 0.001] ")],
    );
    for file in files {
        // The right survey: no row beyond 3σ, a false alarm in 3 × 0.27 % per seed.
        let sound = run(file, &right, "", &[], &[]);
        assert_eq!(sound.code, Some(0), "{} {}", sound.stderr, sound.notes());
        assert!(!sound.notes().contains("baseline"), "{}", sound.notes());

        let run = run(file, &wrong, "", &[], &[]);
        let notes = run.notes();
        run.assert_ended(4, "disagree");
        assert!(notes.contains("baseline.z: the data alone put it") && notes.contains("multiplier"), "{notes}");
        let (distance_m, sigma_m) = pull(&run, "baseline.z");
        assert!((distance_m + 1e-3).abs() <= 3.0 * sigma_m, "{distance_m} ± {sigma_m}");
        // Six standard deviations: below, the test would lack the power that it claims.
        assert!(sigma_m < 1e-3 / 6.0, "{sigma_m}");
    }
}

/// Three quarters of an hour without a survey: x of both test masses is not seen, and it is said so by name.
#[test]
fn a_short_record_without_a_survey_is_weak_in_named_directions() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let no_survey =
        changed_mission(dir.path(), "m.toml", &[("[housing]", ""), (SURVEY, "# "), ("baseline_tolerance_m", "# ")]);
    for file in default_files() {
        let run = run(file, &no_survey, "", &[], &["--until", "2035-01-01T00:45:00Z"]);
        run.assert_ended(0, "weak");
        let weak = run.product["weak_directions"].to_string();
        for name in ["com-offset.tm1.x", "com-offset.tm2.x", "is not seen", "against a range of"] {
            assert!(weak.contains(name), "{weak}");
        }
        // The combinations that are seen are not called weak: y is known to 3 mm.
        assert!(!weak.contains(".y") && !weak.contains(".z"), "{weak}");
    }
}

/// A spacecraft that does not turn says nothing of its centre of mass: σ stays at what the drawings leave, nothing is invented.
#[test]
fn a_spacecraft_that_does_not_turn_is_weak_everywhere() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let quiet = changed_mission(
        dir.path(),
        "quiet.toml",
        &[(TORQUE, "asd_nm_rthz = 1e-10 "), ("asd_rad_rthz = 5e-10", "asd_rad_rthz = 5e-12")],
    );
    let folder = dir.path().join("sim");
    let mut command = dragfree(dir.path());
    command.arg("simulate").arg(&quiet).arg("--out").arg(&folder).args(["--hours", "2", "--seed", "1"]);
    dragfree_tests::expect(&mut command, 0);
    let run = run(&folder.join("SC1_2035-01-01.mcap"), &quiet, "", &[], &[]);
    run.assert_ended(0, "weak");
    let weak = run.product["weak_directions"].as_array().expect("directions");
    // Six unknowns, of which the survey ties three to the other three.
    assert_eq!(weak.len(), 3, "{weak:?}");
    for (name, half_range_m) in [("x", 0.0273), ("y", 0.0273), ("z", 0.02)] {
        for tm in ["tm1", "tm2"] {
            let name = format!("com-offset.{tm}.{name}");
            assert!(run.product["weak_directions"].to_string().contains(&name), "{name}: {weak:?}");
            let (_, sigma_m) = coefficient(&run.product, &name, "es-akf");
            assert!(sigma_m > 0.95 * half_range_m, "{name}: {sigma_m}");
            let (_, sigma_m) = coefficient(&run.product, &name, "qp");
            assert!(sigma_m > 0.01 / 3f64.sqrt(), "{name}: {sigma_m}");
        }
    }
}
