//! Data and settings for which a filter is consistent but its offsets are biased. The verdict must be `disagree` for
//! them and must not be without them.
//!
//! Seeds are 1, 2 and 3, without tuning; each test states its false-alarm rate.

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

/// A spacecraft with ten times the angular excitation, whose six hours determine the offsets better than weeks of the
/// default one.
fn restless() -> &'static (TempDir, Vec<PathBuf>) {
    static FILES: OnceLock<(TempDir, Vec<PathBuf>)> = OnceLock::new();
    FILES.get_or_init(|| {
        let dir = tempfile::tempdir().expect("a temporary folder");
        simulated(&changed_mission(dir.path(), "restless.toml", &[(TORQUE, LOUD_TORQUE)]))
    })
}

/// Residual and σ of a constraint, m.
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

/// Without a bias: per seed a contradiction has a probability below 6 × 0.27 % (two solutions) + 0.1 % (survey) + 6 ×
/// 0.01 % (box), 5.3 % for three seeds.
#[test]
fn right_solutions_do_not_disagree() {
    for file in default_files() {
        let run = run(file, &fixture("missions/taiji.toml"), "", &[], &[]);
        run.assert_ended(0, "agree");
    }
}

/// Feedback makes thruster noise part of the command. Used as angular acceleration, the command biases `b_x` by
/// centimetres, and the filter's innovations do not show it.
#[test]
fn commanded_torque_as_angular_acceleration_gives_a_disagreement() {
    for file in default_files() {
        let run = run(file, &fixture("missions/taiji.toml"), COMMANDED, &[], &[]);
        run.assert_ended(4, "disagree");
        // The bias is present: NIS is consistent, and the error is centimetres.
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

/// Torque noise about z that doubles halfway through a day. The weights of the angular acceleration follow it: every
/// offset of the batch solution within 4σ (18 numbers, 0.1 %). With the weights of the mission file for the whole day
/// it is wrong by 4σ and more, and the residuals of the attitude and of the test masses are coherent.
#[test]
fn the_angular_acceleration_follows_torque_noise_that_doubles_halfway() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let mission = fixture("missions/taiji.toml");
    for seed in SEEDS {
        let folder = dir.path().join(seed);
        let mut command = dragfree(dir.path());
        command.arg("simulate").arg(&mission).arg("--out").arg(&folder).args(["--hours", "24", "--seed", seed]);
        dragfree_tests::expect(command.args(["--effect", "torque-noise:sc.z=2,from_s=43200"]), 0);
        let file = folder.join("SC1_2035-01-01.mcap");
        let followed = run(&file, &mission, "", &[], &[]);
        followed.assert_ended(0, "agree");
        for (name, true_m) in TRUTH_M {
            let (value_m, sigma_m) = coefficient(&followed.product, name, "qp");
            assert!((value_m - true_m).abs() < 4.0 * sigma_m, "seed {seed}, {name}: {value_m} ± {sigma_m}, {true_m}");
        }
        let trusting = run(&file, &mission, "measure_noise = false", &[], &[]);
        trusting.assert_ended(4, "disagree");
        assert!(trusting.notes().contains("the torque noise changes"), "{}", trusting.notes());
    }
}

/// The disagreement is detected without the filter, without the survey, and without both.
#[test]
fn the_disagreement_needs_neither_filter_nor_survey() {
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

/// The second difference of the attitude as angular acceleration: errors in variables attenuate the offset to 1 %.
#[test]
fn a_second_difference_as_angular_acceleration_gives_a_disagreement() {
    let parameters = "angular_acceleration = \"second-difference\"";
    for file in default_files() {
        let run = run(file, &fixture("missions/taiji.toml"), parameters, &[], &[]);
        run.assert_ended(4, "disagree");
        assert!(run.notes().contains("baseline.y: the data alone put it"), "{}", run.notes());
    }
}

/// A survey error of a millimetre along z, where the data are accurate. The reported residual is the millimetre within
/// 3σ (three draws: false alarm 0.8 %).
#[test]
fn a_survey_error_of_a_millimetre_is_detected() {
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
        // Six standard deviations, as claimed for the power of this test.
        assert!(sigma_m < 1e-3 / 6.0, "{sigma_m}");
    }
}

/// Without a survey, 45 minutes do not determine x of either test mass; the verdict names it.
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
        // Observable combinations are not called weak: y is known to 3 mm.
        assert!(!weak.contains(".y") && !weak.contains(".z"), "{weak}");
    }
}

/// Without rotation the offsets are unobservable: σ stays at the prior's.
#[test]
fn a_spacecraft_without_rotation_is_weak_everywhere() {
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
    // Six unknowns, three of which the survey ties to the other three.
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
