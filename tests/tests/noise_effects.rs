//! Levels of noise in a model: what `diagnose` names, `model add` puts into the model file and the next run uses, for Σ
//! of the batch solution, the recursive filters, `compare` and `diagnose`. The hidden levels stand in no input.

use dragfree_tests::calibration::{Run, diagnose, science_mode};
use dragfree_tests::{coefficient, dragfree, expect, fixture, json, simulate};
use serde_json::Value;
use std::path::Path;

/// Standard deviations at which a test fails: a false alarm of 6e-5.
const SIGMAS: f64 = 4.0;

/// The bundled model, with further entries.
fn model(folder: &Path, name: &str, entries: &str) {
    let bundled = std::fs::read_to_string(fixture("models/com-offset.toml")).expect("readable");
    std::fs::write(folder.join(name), bundled + entries).expect("writable");
}

/// A level that the model fixes.
fn fixed(effect: &str, instance: &str, value: f64) -> String {
    let axis = instance.rsplit('.').next().expect("an axis");
    format!(
        "\n[[effect]]\nid = \"{effect}\"\ninstance = \"{instance}\"\nestimate = false\nprior.{axis}.value = {value:?}\n"
    )
}

fn calibrated(folder: &Path, telemetry: &Path, model: &str, more: &[&str]) -> Value {
    let mut command = science_mode(folder);
    Run::of(command.arg(telemetry).args(["--model", model]).args(more)).product
}

fn number(value: &Value) -> f64 {
    value.as_f64().unwrap_or(f64::NAN)
}

/// χ²/dof with the declared Σ, and its standard deviation where Σ is right.
fn chi2(product: &Value) -> (f64, f64) {
    let observations = number(&product["quality"]["stages"]["qp-check"]["observations"]);
    (number(&product["quality"]["chi2_per_dof"]), (2.0 / observations).sqrt())
}

/// The same of the mean normalised innovation squared, six readouts an update.
fn nis(product: &Value) -> (f64, f64) {
    let updates = number(&product["quality"]["counts"]["es-akf"]["updates"]);
    (number(&product["quality"]["nis"]), (2.0 / (3.0 * updates)).sqrt())
}

fn is_one((ratio, sigma): (f64, f64)) -> bool {
    (ratio - 1.0).abs() < SIGMAS * sigma
}

/// Force noise of the thrusters along y 1.5 times as loud as declared: the diagnosis names it, its entry makes χ² and
/// NIS one, the model is sufficient and its prediction agrees with what is measured. Each bound has the false-alarm
/// rate of [`SIGMAS`] or, of `diagnose` and `compare`, 1 %. Without the entry, and with one that states the declared
/// level, every bound is exceeded.
#[test]
fn a_diagnosed_level_closes_the_loop() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let folder = dir.path();
    let telemetry = simulate(folder, &["--hours", "3", "--seed", "21", "--effect", "mps-noise:sc.y=1.5"]).remove(0);
    model(folder, "model.toml", "");
    let before = calibrated(folder, &telemetry, "model.toml", &[]);
    assert!(!is_one(chi2(&before)) && !is_one(nis(&before)), "{:?} {:?}", chi2(&before), nis(&before));
    let d = diagnose(folder, &before);
    let first = &d["candidates"][0];
    assert_eq!(
        (&d["verdict"], &first["effect"], &first["instance"]),
        (&"missing".into(), &"mps-noise".into(), &"sc.y".into())
    );

    let compare = |product: &Value, code| {
        let id = product["id"].as_str().expect("an id");
        json(dragfree(folder).args(["compare", id, "--archive", "archive", "--json", "-q"]), code)
    };
    assert_eq!(compare(&before, 4)["verdict"], "fails");

    std::fs::write(folder.join("d.json"), d.to_string()).expect("writable");
    expect(dragfree(folder).args(["model", "add", "model.toml", "--from", "d.json"]), 0);
    let after = calibrated(folder, &telemetry, "model.toml", &[]);
    let used = &after["model"]["noise_levels"][0];
    assert_eq!((&used["component"], &used["value"]), (&"thruster_force:sc.y".into(), &first["value"]), "{used}");
    assert!(is_one(chi2(&after)) && is_one(nis(&after)), "{:?} {:?}", chi2(&after), nis(&after));
    let (level, sigma) = coefficient(&after, "mps-noise.sc.y", "adopted");
    assert!((level - 1.5).abs() < SIGMAS * sigma && sigma < 0.015, "{level} ± {sigma}");

    let d = diagnose(folder, &after);
    let levels = d["candidates"].as_array().expect("a list").iter().filter(|c| c["effect"] == "mps-noise");
    assert!(d["verdict"] == "sufficient" && levels.clone().all(|c| c["accepted"] == false), "{:#}", d["candidates"][0]);
    assert_eq!(compare(&after, 0)["verdict"], "passes");

    // What falls is −2 log of the likelihood, as in the diagnosis, which weighs bands a little differently.
    let rungs = ladder(folder, &[&before, &after], &[]);
    let fall = number(&rungs[1]["fall"]["delta_chi2"]) / number(&first["delta_chi2"]);
    assert!((fall - 1.0).abs() < 0.05, "{fall}");

    // Twins: the declared level is no entry, and an entry that scales nothing is refused.
    model(folder, "declared.toml", &fixed("mps-noise", "sc.y", 1.0));
    let declared = calibrated(folder, &telemetry, "declared.toml", &[]);
    assert_eq!((chi2(&declared), nis(&declared)), (chi2(&before), nis(&before)));
    model(folder, "none.toml", &fixed("mps-noise", "sc.y", 0.0));
    let refused = Run::of(science_mode(folder).arg(&telemetry).args(["--model", "none.toml"]));
    assert!(refused.code == Some(1) && refused.stderr.contains("mps-noise.sc.y = 0"), "{}", refused.stderr);
}

/// Revisions of a ladder.
fn ladder(folder: &Path, products: &[&Value], more: &[&str]) -> Vec<Value> {
    let ids = products.iter().map(|p| p["id"].as_str().expect("an id"));
    let mut command = dragfree(folder);
    command.arg("ladder").args(ids).args(["--archive", "archive", "--json"]).args(more);
    json(&mut command, 0)["revisions"].as_array().expect("revisions").clone()
}

/// Quantiles of χ² with 18 degrees of freedom, six components of the offsets over three seeds, at 0.0001 and 0.9999.
const NEES_BOUNDS: (f64, f64) = (3.555, 49.190);

/// Capacitive readouts three times as loud as declared. Without the levels the recursive filter stretches all of its σ
/// by what the readouts show, and its NEES is too small. With them NIS and χ² are right at the rate of [`SIGMAS`], and
/// the NEES lies inside bounds of a false-alarm rate of 2e-4, though below its mean: the filter stays cautious. A
/// mission file that declares the same noise makes the same Σ: its rung is as much better than the first as that of the
/// levels, though it has another name.
#[test]
fn levels_of_readouts_make_errors_consistent() {
    let instances = ["tm1.y", "tm1.z", "tm2.y", "tm2.z"];
    let hidden: Vec<String> = instances.iter().map(|i| format!("is-noise:{i}=3")).collect();
    let entries: String = instances.iter().map(|i| fixed("is-noise", i, 3.0)).collect();
    let mut nees = [0.0; 2];
    for seed in ["101", "102", "103"] {
        let dir = tempfile::tempdir().expect("a temporary folder");
        let folder = dir.path();
        let effects = hidden.iter().flat_map(|effect| ["--effect", effect]);
        let arguments: Vec<&str> = ["--hours", "2", "--seed", seed].into_iter().chain(effects).collect();
        let telemetry = simulate(folder, &arguments).remove(0);
        model(folder, "plain.toml", "");
        model(folder, "levels.toml", &entries);
        let text = std::fs::read_to_string(folder.join("levels.toml")).expect("readable");
        let child = text.replacen("revision = \"1\"", "revision = \"levels\"\nparent = \"1\"", 1);
        std::fs::write(folder.join("levels.toml"), child).expect("writable");
        let plain = calibrated(folder, &telemetry, "plain.toml", &[]);
        let levels = calibrated(folder, &telemetry, "levels.toml", &[]);
        assert!(chi2(&plain).0 > 4.0 && nis(&plain).0 > 4.0, "{:?} {:?}", chi2(&plain), nis(&plain));
        assert!(is_one(chi2(&levels)) && is_one(nis(&levels)), "{:?} {:?}", chi2(&levels), nis(&levels));

        let truth = folder.join("truth").join(telemetry.file_name().expect("a name"));
        let rungs = ladder(folder, &[&plain, &levels], &["--truth", truth.to_str().expect("UTF-8")]);
        for (sum, rung) in nees.iter_mut().zip(&rungs) {
            let all = rung["nees"].as_array().expect("solutions");
            let filter = all.iter().find(|n| n["solution"] == "es-akf").expect("a filter");
            *sum += number(&filter["per_dof"]) * number(&filter["dof"]);
        }
        if seed != "101" {
            continue;
        }
        let mission = std::fs::read_to_string(fixture("missions/taiji.toml")).expect("readable");
        let louder =
            mission.replace("asd_m_rthz = 1.8e-9", "asd_m_rthz = 5.4e-9").replacen("\"Taiji\"", "\"Louder\"", 1);
        assert!(louder.matches("5.4e-9").count() == 3 && louder.contains("\"Louder\""), "the fixture has changed");
        std::fs::write(folder.join("louder.toml"), louder).expect("writable");
        let declared = calibrated(folder, &telemetry, "plain.toml", &["--mission", "louder.toml"]);
        let across = ladder(folder, &[&plain, &declared], &[]);
        assert_eq!((&across[0]["revision"], &across[1]["revision"]), (&"1@taiji".into(), &"1@louder".into()));
        let [by_mission, by_levels] = [&across, &rungs].map(|r| number(&r[1]["fall"]["delta_chi2"]));
        assert!(by_levels > 1e6 && (by_mission / by_levels - 1.0).abs() < 1e-9, "{by_mission} {by_levels}");
    }
    let (least, most) = NEES_BOUNDS;
    assert!(nees[0] < least && (least..most).contains(&nees[1]), "{nees:?}");
}
