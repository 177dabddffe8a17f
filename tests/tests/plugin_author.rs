//! A plugin author's workflow: a skeleton is written, built, validated, and run in a model on simulated telemetry.

use dragfree_tests::calibration::{Run, of_pipeline, science_mode};
use dragfree_tests::{built, coefficient, compile_plugin, dragfree, expect, fixture, json, root, simulate};
use serde_json::Value;
use std::path::{Path, PathBuf};
use std::process::Command;

/// Writes a skeleton and builds it offline, with cargo and this workspace's lock file into a persistent target folder,
/// or with make. Returns the library.
fn skeleton(folder: &Path, name: &str, kind: &str, language: &str) -> PathBuf {
    let out = folder.join(name);
    let mut new = dragfree(folder);
    new.args(["plugins", "new", name, "--kind", kind, "--lang", language, "--json", "--out"]).arg(&out);
    let made = json(&mut new, 0);
    let readme = std::fs::read_to_string(out.join("README.md")).expect("a README");
    assert!(
        readme.contains("dragfree plugins validate") && readme.contains(&format!("{kind} for `dragfree`")),
        "{readme}"
    );
    assert!(made["files"].as_array().is_some_and(|files| files.len() >= 4), "{made}");
    for file in made["files"].as_array().expect("files") {
        let text = std::fs::read_to_string(file.as_str().expect("a path")).expect("a text");
        assert!(!text.contains("{{"), "{file} has a place that was not filled in");
    }
    let library = format!("lib{}.so", name.replace('-', "_"));
    if language == "c" {
        expect(Command::new("make").current_dir(&out).env("CFLAGS", "-O2 -Werror"), 0);
        return out.join(library);
    }
    assert!(readme.contains(&root().join("core/sdk").display().to_string()), "it says where its SDK is: {readme}");
    std::fs::copy(root().join("Cargo.lock"), out.join("Cargo.lock")).expect("a lock file");
    let target = built().parent().expect("a target folder").join("skeletons");
    let cargo = std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into());
    let mut build = Command::new(cargo);
    build.current_dir(&out).args(["build", "--quiet", "--release", "--offline", "--target-dir"]).arg(&target);
    let told = expect(build.env("RUSTFLAGS", "-D warnings"), 0);
    assert!(told.stderr.is_empty(), "{}", String::from_utf8_lossy(&told.stderr));
    let kept = out.join(&library);
    std::fs::copy(target.join("release").join(&library), &kept).expect("the library is there");
    kept
}

/// Telemetry in a new folder.
fn simulated(folder: &Path, arguments: &[&str]) -> Vec<PathBuf> {
    std::fs::create_dir(folder).expect("writable");
    simulate(folder, arguments)
}

/// Result of `validate` for a library.
fn validated(folder: &Path, library: &Path, more: &[&str]) -> Value {
    let mut command = dragfree(folder);
    let output = command.args(["plugins", "validate", "--json"]).arg(library).args(more).output().expect("runs");
    let result: Value = serde_json::from_slice(&output.stdout)
        .unwrap_or_else(|e| panic!("{e}: {}", String::from_utf8_lossy(&output.stderr)));
    assert_eq!(output.status.code(), Some(i32::from(result["passed"] != true)), "{result}");
    result
}

fn assert_passes(folder: &Path, library: &Path, checks: usize) {
    let result = validated(folder, library, &[]);
    assert_eq!(result["passed"], true, "{result:#}");
    for plugin in result["plugins"].as_array().expect("plugins") {
        assert_eq!(plugin["checks"].as_array().map(Vec::len), Some(checks), "{plugin:#}");
    }
}

/// Failed checks with their messages.
fn failures(result: &Value) -> Vec<(String, String)> {
    let checks =
        result["plugins"].as_array().into_iter().flatten().flat_map(|p| p["checks"].as_array().into_iter().flatten());
    let failed = checks.filter(|c| c["passed"] != true);
    let text = |value: &Value| value.as_str().expect("a text").to_owned();
    failed.map(|c| (text(&c["check"]), text(&c["detail"]))).collect()
}

/// Skeletons of every kind in both languages build and pass.
#[test]
fn every_skeleton_builds_and_passes_the_validator() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    for language in ["c", "rust"] {
        for kind in ["effect", "stage", "source"] {
            let library = skeleton(dir.path(), &format!("my-{kind}-{language}"), kind, language);
            assert_passes(dir.path(), &library, 9);
        }
    }
    let effect = dir.path().join("my-effect-c/libmy_effect_c.so");
    let other = validated(dir.path(), &effect, &["--set", "channel=hk.bus_voltage_v"]);
    assert_eq!(other["passed"], true, "{other:#}");
    let misspelt = failures(&validated(dir.path(), &effect, &["--set", "chanel=hk.bus_voltage_v"]));
    assert!(misspelt.iter().any(|(_, detail)| detail.contains("`chanel` is no parameter")), "{misspelt:?}");
    // The third command of the README: into a model.
    std::fs::copy(fixture("models/com-offset.toml"), dir.path().join("my-effect-c/model.toml")).expect("copied");
    let readme = std::fs::read_to_string(dir.path().join("my-effect-c/README.md")).expect("a README");
    let add = readme.lines().find(|line| line.starts_with("dragfree model add")).expect("the third command");
    let words: Vec<&str> = add.split_whitespace().skip(1).collect();
    expect(dragfree(&dir.path().join("my-effect-c")).args(words), 0);
    let model = std::fs::read_to_string(dir.path().join("my-effect-c/model.toml")).expect("a model");
    assert!(model.contains("my-effect-c") && model.contains("hk.battery_current_a"), "{model}");
    // The stage runs in a chain, and existing files are not overwritten.
    let dir = dir.path();
    let text = format!(
        "[pipeline]\nname = \"test\"\nmission = '{}'\nmodel = 'model.toml'\n[[stage]]\nplugin = \"preprocess\"\n[[stage]]\nplugin = \"my-stage-c\"\n[[stage]]\nplugin = \"my-stage-rust\"\n",
        fixture("missions/taiji.toml").display()
    );
    std::fs::write(dir.join("pipeline.toml"), text).expect("writable");
    std::fs::write(dir.join("model.toml"), "[model]\nrevision = \"0\"\n").expect("writable");
    let files = simulated(&dir.join("telemetry"), &["--hours", "0.1", "--seed", "1"]);
    let mut command = of_pipeline(dir, &dir.join("pipeline.toml"));
    for plugin in ["my-stage-c", "my-stage-rust"] {
        command.arg("--plugin-dir").arg(dir.join(plugin));
    }
    let run = Run::of(command.args(&files));
    assert_eq!(run.code, Some(0), "{}", run.stderr);
    assert_eq!((run.count("my-stage-c", "rows"), run.count("my-stage-rust", "rows")), (3600, 3600));
    let mut again = dragfree(dir);
    again.args(["plugins", "new", "my-stage-c", "--kind", "stage", "--lang", "c"]);
    let refused = expect(&mut again, 1);
    assert!(String::from_utf8_lossy(&refused.stderr).contains("not empty"));
}

/// The bundled plugins pass the validator.
#[test]
fn the_bundled_plugins_pass_the_validator() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    for id in ["com-offset", "preprocess", "hinf-dfacs", "es-akf", "qp-check", "sim"] {
        assert_passes(dir.path(), Path::new(id), 9);
    }
}

/// Each misbehaviour is found by its check, and none ends the program.
#[test]
fn misbehaviour_is_found_and_a_crash_is_a_result() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    for (define, check, said) in [
        ("CRASH", "values", "crashed: signal"),
        ("BATCH", "batches", "in place of"),
        ("REPLAY", "replay", "the second time"),
        ("STATE", "state", "resumed from its state"),
        ("GARBAGE", "garbage", "took 1 bytes for a state"),
        ("INFINITE", "values", "infinite"),
        ("NAMELESS", "link", "must be called faulty.tm1"),
        ("UNITLESS", "manifest", "has no unit"),
        ("EXITS", "create", "ended the process"),
    ] {
        let folder = dir.path().join(define);
        std::fs::create_dir(&folder).expect("writable");
        let library = compile_plugin(&folder, "faulty_effect.c", "faulty", &[&format!("-DFAULT_{define}")]);
        let found = failures(&validated(&folder, &library, &[]));
        assert!(found.iter().any(|(c, detail)| c == check && detail.contains(said)), "{define}: {found:?}");
    }
    let library = compile_plugin(dir.path(), "faulty_effect.c", "sound", &[]);
    assert_passes(dir.path(), &library, 9);
    let nothing = dir.path().join("nothing.so");
    std::fs::write(&nothing, "no library").expect("writable");
    let found = failures(&validated(dir.path(), &nothing, &[]));
    assert!(found[0].1.contains("no shared library"), "{found:?}");
}

/// A thermal force of 8e-9 m s⁻² per kelvin along x: either skeleton finds 1.96 kg times that within 3σ and above 10σ,
/// and zero within 3σ without it. False alarm 0.5 %.
#[test]
fn a_simulated_force_is_found_by_a_skeleton() {
    const SIZE_M_S2_K: f64 = 8e-9;
    const MASS_KG: f64 = 1.96;
    let dir = tempfile::tempdir().expect("a temporary folder");
    let dir = dir.path();
    skeleton(dir, "felt-rust", "effect", "rust");
    skeleton(dir, "felt-c", "effect", "c");
    let hours = ["--hours", "2", "--seed", "1"];
    let effect = format!("thermal:tm1.x={SIZE_M_S2_K},lag_s=0");
    let with = simulated(&dir.join("with"), &[&hours[..], &["--effect", &effect]].concat()).remove(0);
    let without = simulated(&dir.join("without"), &hours).remove(0);
    for id in ["felt-rust", "felt-c"] {
        let model = dir.join(format!("{id}.toml"));
        let entry = |id: &str, instance: &str| format!("[[effect]]\nid = \"{id}\"\ninstance = \"{instance}\"\n");
        let text = [
            "[model]\nrevision = \"2\"\n".to_owned(),
            entry("com-offset", "tm1"),
            entry("com-offset", "tm2"),
            entry(id, "tm1.x"),
            "parameters = { channel = \"hk.eh1_xp_temperature_k\", reference = \"hk.eh1_xm_temperature_k\" }\n"
                .to_owned(),
        ];
        std::fs::write(&model, text.concat()).expect("writable");
        let size = |file: &Path| {
            let mut command = science_mode(dir);
            command.arg(file).arg("--model").arg(&model).arg("--plugin-dir").arg(dir.join(id));
            let run = Run::of(&mut command);
            assert!(matches!(run.code, Some(0 | 4)), "{}", run.stderr);
            coefficient(&run.product, &format!("{id}.tm1.x"), "qp")
        };
        let (value, sigma) = size(&with);
        let want = SIZE_M_S2_K * MASS_KG;
        assert!((value - want).abs() <= 3.0 * sigma, "{id}: {value:e} ± {sigma:e} N/K for {want:e}");
        assert!(value > 10.0 * sigma, "{id}: {value:e} ± {sigma:e} N/K");
        let (value, sigma) = size(&without);
        assert!(value.abs() <= 3.0 * sigma, "{id}: {value:e} ± {sigma:e} N/K where there is nothing");
    }
}
