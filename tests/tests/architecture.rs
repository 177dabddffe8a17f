//! The dependency rules of ARCHITECTURE.md, checked against `cargo metadata`.

use serde_json::Value;
use std::collections::{BTreeMap, BTreeSet};
use std::process::Command;

fn dependencies() -> BTreeMap<String, BTreeSet<String>> {
    let cargo = std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into());
    let output = dragfree_tests::expect(
        Command::new(cargo).current_dir(dragfree_tests::root()).args([
            "metadata",
            "--no-deps",
            "--format-version",
            "1",
            "--offline",
        ]),
        0,
    );
    let metadata: Value = serde_json::from_slice(&output.stdout).expect("cargo prints JSON");
    let packages = metadata["packages"].as_array().expect("packages");
    packages
        .iter()
        .map(|p| {
            let normal = p["dependencies"].as_array().expect("dependencies").iter().filter(|d| d["kind"].is_null());
            let names = normal.filter_map(|d| d["name"].as_str()).map(str::to_owned).collect();
            (p["name"].as_str().expect("a name").to_owned(), names)
        })
        .collect()
}

/// Workspace crates that a workspace crate may depend on.
fn allowed(crate_name: &str) -> &'static [&'static str] {
    match crate_name {
        "dragfree-abi" | "dragfree-schema" | "dragfree-chart" | "dragfree-score" => &[],
        "dragfree-physics" => &["dragfree-schema"],
        "dragfree-sdk" | "dragfree-engine" => &["dragfree-abi", "dragfree-schema"],
        "dragfree" => &[
            "dragfree-engine",
            "dragfree-physics",
            "dragfree-chart",
            "dragfree-identification",
            "dragfree-estimation",
            "dragfree-score",
        ],
        "dragfree-validation" => &["dragfree-engine", "dragfree-physics", "dragfree-chart"],
        "dragfree-estimation" => &["dragfree-physics", "dragfree-schema"],
        "dragfree-identification" => &["dragfree-physics", "dragfree-estimation"],
        "dragfree-critic-stage" => {
            &["dragfree-sdk", "dragfree-physics", "dragfree-estimation", "dragfree-identification"]
        }
        "dragfree-tests" => &["dragfree-engine"],
        "dragfree-qp-check" => &["dragfree-sdk", "dragfree-physics", "dragfree-estimation"],
        _ => &["dragfree-sdk", "dragfree-physics"],
    }
}

fn forbidden_dependencies(dependencies: &BTreeMap<String, BTreeSet<String>>) -> Vec<String> {
    let ours = |name: &&String| dependencies.contains_key(*name);
    dependencies
        .iter()
        .flat_map(|(from, to)| {
            to.iter()
                .filter(ours)
                .filter(|to| !allowed(from).contains(&to.as_str()))
                .map(move |to| format!("{from} -> {to}"))
        })
        .collect()
}

#[test]
fn dependencies_follow_the_architecture() {
    let found = dependencies();
    assert!(found.len() >= 15, "the workspace has its crates: {:?}", found.keys());
    assert_eq!(forbidden_dependencies(&found), Vec::<String>::new());
    assert!(found["dragfree-abi"].is_empty(), "the border depends on nothing");
}

#[test]
fn a_forbidden_dependency_is_detected() {
    let mut broken = dependencies();
    broken.get_mut("dragfree-engine").expect("the engine").insert("dragfree-physics".to_owned());
    broken.get_mut("dragfree-es-akf").expect("a plugin").insert("dragfree-engine".to_owned());
    assert_eq!(
        forbidden_dependencies(&broken),
        ["dragfree-engine -> dragfree-physics", "dragfree-es-akf -> dragfree-engine"]
    );
}

/// Simulator and effects share no code, so that one would reveal an error of the other.
#[test]
fn the_simulator_shares_no_code_with_the_effects() {
    let found = dependencies();
    assert!(found.contains_key("dragfree-sim") && found.contains_key("dragfree-effects"), "{:?}", found.keys());
    assert!(!found["dragfree-sim"].contains("dragfree-effects") && !found["dragfree-effects"].contains("dragfree-sim"));
}

/// The engine never knows a plugin or an effect by name.
#[test]
fn the_engine_names_no_plugin() {
    let names = ["com-offset", "es-gain", "thermal", "es-akf", "qp-check", "hinf-dfacs", "preprocess", "gracefo"];
    let mut folders = vec![dragfree_tests::root().join("core/engine/src")];
    let mut seen = 0;
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(&folder).expect("a folder").flatten() {
            let path = entry.path();
            if path.is_dir() {
                folders.push(path);
            } else if path.extension().is_some_and(|e| e == "rs") && path.file_name().is_some_and(|n| n != "tests.rs") {
                seen += 1;
                let text = std::fs::read_to_string(&path).expect("text");
                let code = text.split("#[cfg(test)]").next().unwrap_or_default();
                for (i, line) in code.lines().enumerate().filter(|(_, l)| !l.trim_start().starts_with("//")) {
                    assert!(
                        !names.iter().any(|n| line.contains(&format!("\"{n}"))),
                        "{}:{}: {line}",
                        path.display(),
                        i + 1
                    );
                }
            }
        }
    }
    assert!(seen > 10, "the engine's files were read");
}
