//! The dependency rules of ARCHITECTURE.md, checked against `cargo metadata`.

use serde_json::Value;
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::process::Command;

/// The packages of the workspace, as cargo knows them.
fn packages() -> Vec<Value> {
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
    metadata["packages"].as_array().expect("packages").clone()
}

fn dependencies() -> BTreeMap<String, BTreeSet<String>> {
    packages()
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
        "dragfree-abi" | "dragfree-schema" | "dragfree-chart" | "dragfree-score" | "xtask" => &[],
        "dragfree-physics" | "dragfree-archive" => &["dragfree-schema"],
        "dragfree-sdk" => &["dragfree-abi", "dragfree-schema"],
        "dragfree-engine" => &["dragfree-abi", "dragfree-archive", "dragfree-schema"],
        "dragfree" => &[
            "dragfree-archive",
            "dragfree-engine",
            "dragfree-physics",
            "dragfree-chart",
            "dragfree-identification",
            "dragfree-pages",
            "dragfree-workflow",
            "dragfree-score",
        ],
        // Pages show what the workflow answers: types of archive and engine are in its arguments and answers.
        "dragfree-pages" => &["dragfree-archive", "dragfree-chart", "dragfree-engine", "dragfree-workflow"],
        // The tests hold the independent producer of telemetry; the numerical crates are timed beside other packages.
        "dragfree-validation" => &[
            "dragfree-engine",
            "dragfree-physics",
            "dragfree-chart",
            "dragfree-tests",
            "dragfree-es-akf",
            "dragfree-estimation",
            "dragfree-identification",
        ],
        "dragfree-estimation" => &["dragfree-physics", "dragfree-schema"],
        "dragfree-identification" => &["dragfree-schema", "dragfree-estimation"],
        "dragfree-workflow" => &[
            "dragfree-archive",
            "dragfree-schema",
            "dragfree-physics",
            "dragfree-engine",
            "dragfree-estimation",
            "dragfree-identification",
        ],
        "dragfree-tests" => &["dragfree-schema"],
        "dragfree-fuzz" => &["dragfree-archive", "dragfree-engine", "dragfree-physics"],
        "dragfree-qp-check" => &["dragfree-sdk", "dragfree-estimation"],
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

/// Files of the tree with one of these extensions, without what is built and without the test data.
fn sources(extensions: &[&str]) -> Vec<PathBuf> {
    let (mut folders, mut found) = (vec![dragfree_tests::root().to_owned()], Vec::new());
    while let Some(folder) = folders.pop() {
        for path in std::fs::read_dir(&folder).expect("a folder").flatten().map(|entry| entry.path()) {
            let name = path.file_name().and_then(|name| name.to_str()).unwrap_or_default();
            if path.is_dir() && !name.starts_with('.') && !["target", "data"].contains(&name) {
                folders.push(path);
            } else if path.extension().and_then(|e| e.to_str()).is_some_and(|e| extensions.contains(&e)) {
                found.push(path);
            }
        }
    }
    found
}

/// Numbers of the lines of comment that are wider than code may be.
fn wide_comments(text: &str) -> Vec<usize> {
    let comment = |line: &str| ["//", "/*", "*"].iter().any(|mark| line.trim_start().starts_with(mark));
    let wide = text.lines().enumerate().filter(|(_, line)| line.chars().count() > 120 && comment(line));
    wide.map(|(n, _)| n + 1).collect()
}

#[test]
fn no_comment_is_wider_than_the_code() {
    let files = sources(&["rs", "c", "h"]);
    assert!(files.len() > 250, "the files were read: {}", files.len());
    let of = |path: &PathBuf| {
        let lines = wide_comments(&std::fs::read_to_string(path).expect("text"));
        lines.into_iter().map(|n| format!("{}:{n}", path.display())).collect::<Vec<_>>()
    };
    assert_eq!(files.iter().flat_map(of).collect::<Vec<_>>(), Vec::<String>::new());
    let line = format!("    /// {}", "µ".repeat(112));
    assert_eq!(wide_comments(&format!("{line}\n{line}µ\nlet text = \"{line}{line}\";\n")), [2]);
}

/// Every package with its features, as built with these kinds of dependencies.
fn features(kinds: &str) -> BTreeSet<String> {
    let cargo = std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into());
    let mut tree = Command::new(cargo);
    tree.current_dir(dragfree_tests::root()).args(["tree", "--workspace", "--offline", "--prefix", "none"]);
    let tree = dragfree_tests::expect(tree.args(["--no-dedupe", "--format", "{p} {f}", "--edges", kinds]), 0);
    let lines = String::from_utf8(tree.stdout).expect("text");
    lines.lines().map(str::to_owned).collect()
}

/// A dependency of tests that turns on another feature of a shared crate makes `cargo test` compile everything above
/// that crate again.
#[test]
fn tests_do_not_change_the_features_of_the_program() {
    let (program, tests) = (features("normal,build"), features("normal,build,dev"));
    assert!(program.len() > 100 && tests.len() > program.len(), "{} {}", program.len(), tests.len());
    assert_eq!(program.difference(&tests).collect::<Vec<_>>(), Vec::<&String>::new());
}

/// What cargo is told not to test has no test: a crate without documentation tests has no example in its comments, one
/// without tests of its own has none.
#[test]
fn nothing_that_is_not_run_looks_like_a_test() {
    let (mut without_examples, mut without_tests) = (0, 0);
    for package in packages() {
        let name = package["name"].as_str().expect("a name");
        let library = |target: &&Value| target["kind"].to_string().contains("lib");
        let Some(library) = package["targets"].as_array().expect("targets").iter().find(library) else { continue };
        let source = Path::new(library["src_path"].as_str().expect("a path")).parent().expect("a folder");
        let text: String = files_below(source).iter().map(|p| std::fs::read_to_string(p).expect("text")).collect();
        assert_eq!(
            library["doctest"] == true,
            has_example(&text),
            "{name}: `doctest` of its [lib] against its comments"
        );
        let has_tests = text.contains("#[test]") || text.contains("proptest!");
        assert_eq!(library["test"] == true, has_tests, "{name}: `test` of its [lib] against its modules");
        without_examples += usize::from(library["doctest"] == false);
        without_tests += usize::from(library["test"] == false);
    }
    assert!(without_examples > 10 && without_tests > 3, "{without_examples} {without_tests}");
    assert!(has_example("/// ```\n/// a();\n/// ```\n") && has_example("//! ```no_run\n//! a();\n//! ```\n"));
    assert!(!has_example("/// ```text\n/// a\n/// ```\nlet fence = \"```\";\n"));
}

/// Whether a comment of documentation has a block that rustdoc takes for Rust.
fn has_example(text: &str) -> bool {
    let comment = |line: &str| {
        let line = line.trim_start();
        let rest = line.strip_prefix("///").or_else(|| line.strip_prefix("//!"))?;
        rest.trim().strip_prefix("```").map(str::to_owned)
    };
    let opening = text.lines().filter_map(comment).step_by(2);
    let other = ["text", "toml", "yaml", "json", "sh", "c", "math"];
    opening.into_iter().any(|language| !other.contains(&language.as_str()))
}

/// Rust files of a folder and those inside of it.
fn files_below(folder: &Path) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(folder).expect("a folder").flatten().map(|entry| entry.path());
    let of = |path: PathBuf| if path.is_dir() { files_below(&path) } else { vec![path] };
    entries.flat_map(of).filter(|path| path.extension().is_some_and(|e| e == "rs")).collect()
}

/// A file of tests that is no module of `programs.rs` or `long.rs` and no binary of its own would never run.
#[test]
fn every_file_of_whole_program_tests_is_run() {
    let folder = dragfree_tests::root().join("tests");
    let list = |name: &str| std::fs::read_to_string(folder.join("tests").join(name)).expect("the list");
    let modules = list("programs.rs") + &list("long.rs");
    let manifest = std::fs::read_to_string(folder.join("Cargo.toml")).expect("a manifest");
    let mut seen = 0;
    for path in std::fs::read_dir(folder.join("tests")).expect("a folder").flatten().map(|entry| entry.path()) {
        let name = path.file_stem().expect("a name").to_string_lossy().into_owned();
        let as_module = modules.lines().filter(|line| *line == format!("mod {name};")).count();
        let as_binary = usize::from(manifest.contains(&format!("[[test]]\nname = \"{name}\"\n")));
        let times = as_module + as_binary;
        assert_eq!(times, 1, "{name}: once in programs.rs or long.rs of tests/tests, or in tests/Cargo.toml");
        seen += 1;
    }
    assert!(seen > 30, "{seen}");
}

/// Simulator and effects share no code, so that one would reveal an error of the other.
#[test]
fn the_simulator_shares_no_code_with_the_effects() {
    let found = dependencies();
    assert!(found.contains_key("dragfree-sim") && found.contains_key("dragfree-effects"), "{:?}", found.keys());
    assert!(!found["dragfree-sim"].contains("dragfree-effects") && !found["dragfree-effects"].contains("dragfree-sim"));
}

/// Words that only missions, the plugins that own them, tests and documents may know: plugins and effects by their ids,
/// test masses, channels, noise tables of the mission file.
const OWNED_BY_OTHERS: [&str; 15] = [
    "com-offset",
    "es-gain",
    "thermal",
    "es-akf",
    "qp-check",
    "hinf-dfacs",
    "gracefo",
    "tm1",
    "tm2",
    "sc.alpha",
    ".accel.",
    "ifo_x",
    "dws_long_arm",
    "thruster_",
    "readout:",
];

/// Files that name some of them as a document does: help and suggested commands, the bundled files and the demo that
/// runs them, and the made-up columns in front of which `plugins validate` sets a plugin.
const EXAMPLES: [&str; 5] = [
    "core/engine/src/validate/stand.rs",
    "core/cli/src/args.rs",
    "core/cli/src/bundled.rs",
    "core/cli/src/commands/demo.rs",
    "core/cli/src/commands/new_plugin.rs",
];

/// Words of the list in the string literals of a file, tests and comments apart: line, word.
fn words_of_others(text: &str) -> Vec<(usize, &'static str)> {
    let code = text.split("#[cfg(test)]").next().unwrap_or_default();
    let literals = code.lines().enumerate().filter(|(_, line)| !line.trim_start().starts_with("//"));
    let literals =
        literals.flat_map(|(n, line)| line.split('"').skip(1).step_by(2).map(move |literal| (n + 1, literal)));
    literals
        .flat_map(|(n, literal)| OWNED_BY_OTHERS.into_iter().filter(|w| literal.contains(w)).map(move |w| (n, w)))
        .collect()
}

#[test]
fn the_core_names_no_plugin_channel_or_test_mass() {
    let mut folders = [
        "abi",
        "schema",
        "sdk",
        "archive",
        "engine",
        "estimation",
        "identification",
        "workflow",
        "chart",
        "pages",
        "cli",
    ]
    .map(|c| dragfree_tests::root().join("core").join(c).join("src"))
    .to_vec();
    let (mut seen, mut found, mut still) = (0, Vec::new(), BTreeSet::new());
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(&folder).expect("a folder").flatten() {
            let path = entry.path();
            if path.is_dir() {
                folders.push(path);
            } else if path.extension().is_some_and(|e| e == "rs") && path.file_name().is_some_and(|n| n != "tests.rs") {
                seen += 1;
                let name = path.strip_prefix(dragfree_tests::root()).expect("inside").display().to_string();
                let words = words_of_others(&std::fs::read_to_string(&path).expect("text"));
                if EXAMPLES.contains(&name.as_str()) && !words.is_empty() {
                    still.insert(name);
                } else {
                    found.extend(words.into_iter().map(|(line, word)| format!("{name}:{line}: {word}")));
                }
            }
        }
    }
    assert!(seen > 80, "the files were read: {seen}");
    assert_eq!(found, Vec::<String>::new());
    assert_eq!(still, EXAMPLES.map(str::to_owned).into(), "files that no longer need their exception");
}

#[test]
fn a_word_of_others_is_seen_in_a_literal_alone() {
    let text = "// \"tm1\"\nlet tm1 = f(\"a\", \"tm2.accel.x\");\n#[cfg(test)]\nlet x = \"tm1\";\n";
    assert_eq!(words_of_others(text), [(2, "tm2"), (2, ".accel.")]);
}

/// Σ is made of what stages declare: the estimation reads no mission file.
#[test]
fn the_estimation_knows_no_mission() {
    for entry in std::fs::read_dir(dragfree_tests::root().join("core/estimation/src")).expect("a folder").flatten() {
        let text = std::fs::read_to_string(entry.path()).expect("text");
        assert!(!text.contains("mission::"), "{}", entry.path().display());
    }
}

/// The modules of a crate, by their path below its root, with their text: without tests and comments.
fn modules(source: &Path) -> BTreeMap<Vec<String>, String> {
    let mut modules = BTreeMap::new();
    let mut folders = vec![source.to_owned()];
    while let Some(folder) = folders.pop() {
        for path in std::fs::read_dir(&folder).expect("a folder").flatten().map(|entry| entry.path()) {
            if path.is_dir() {
                folders.push(path);
            } else if path.extension().is_some_and(|e| e == "rs") && !path.ends_with("tests.rs") {
                let text = std::fs::read_to_string(&path).expect("text");
                let code = text.split("#[cfg(test)]").next().unwrap_or_default();
                let lines = code.lines().filter(|line| !line.trim_start().starts_with("//"));
                let below = path.with_extension("");
                let names = below.strip_prefix(source).expect("below").iter().map(|n| n.to_string_lossy().into_owned());
                let own = names.filter(|name| !["mod", "lib", "main"].contains(&name.as_str())).collect();
                modules.insert(own, lines.collect::<Vec<_>>().join("\n"));
            }
        }
    }
    modules
}

/// The paths of an import: `a::{b, c::{d}}` are `a::b` and `a::c::d`.
fn expanded(import: &str) -> Vec<String> {
    let Some((prefix, group)) = import.split_once('{') else { return vec![import.to_owned()] };
    let (mut depth, mut parts) = (0, vec![String::new()]);
    for c in group.strip_suffix('}').unwrap_or(group).chars() {
        depth += i32::from(c == '{') - i32::from(c == '}');
        match c {
            ',' if depth == 0 => parts.push(String::new()),
            c => parts.last_mut().expect("a part").push(c),
        }
    }
    parts.iter().filter(|part| !part.is_empty()).flat_map(|part| expanded(&format!("{prefix}{part}"))).collect()
}

/// Modules of its own crate that a module names by `crate::` or `super::`.
fn imports(own: &[String], text: &str, modules: &BTreeMap<Vec<String>, String>) -> BTreeSet<Vec<String>> {
    let mut found = BTreeSet::new();
    let starts = ["crate::", "super::"].into_iter().flat_map(|word| text.match_indices(word));
    for (start, _) in starts.filter(|(i, _)| !text[..*i].ends_with(|c: char| c.is_alphanumeric() || "_:".contains(c))) {
        let is_use = text[..start].trim_end().ends_with("use");
        let end = |c: char| if is_use { c == ';' } else { !(c.is_alphanumeric() || "_:".contains(c)) };
        let import: String = text[start..].split(end).next().unwrap_or_default().split_whitespace().collect();
        for path in expanded(&import) {
            let mut names: Vec<String> = path.split("::").map(str::to_owned).collect();
            let up = names.iter().take_while(|name| *name == "super").count();
            let base = if up > 0 { own[..own.len().saturating_sub(up)].to_vec() } else { Vec::new() };
            names.drain(..up.max(1));
            let mut module = [base, names].concat();
            while !module.is_empty() && !modules.contains_key(&module) {
                module.pop();
            }
            if !module.is_empty() && module != own {
                found.insert(module);
            }
        }
    }
    found
}

/// Pairs of modules that import each other, at whatever distance.
fn circles(modules: &BTreeMap<Vec<String>, String>) -> Vec<String> {
    let direct: BTreeMap<&Vec<String>, BTreeSet<Vec<String>>> =
        modules.iter().map(|(own, text)| (own, imports(own, text, modules))).collect();
    let reached = |from: &Vec<String>| {
        let (mut seen, mut next) = (BTreeSet::new(), vec![from.clone()]);
        while let Some(module) = next.pop() {
            next.extend(direct[&module].iter().filter(|to| seen.insert((*to).clone())).cloned());
        }
        seen
    };
    let reach: BTreeMap<&Vec<String>, BTreeSet<Vec<String>>> = modules.keys().map(|m| (m, reached(m))).collect();
    let mutual = |(a, b): (&Vec<String>, &Vec<String>)| a < b && reach[a].contains(b) && reach[b].contains(a);
    let pairs = modules.keys().flat_map(|a| modules.keys().map(move |b| (a, b)));
    pairs.filter(|pair| mutual(*pair)).map(|(a, b)| format!("{} <-> {}", a.join("::"), b.join("::"))).collect()
}

#[test]
fn no_modules_import_each_other_in_a_circle() {
    let root = dragfree_tests::root();
    let below = |folder: &str| std::fs::read_dir(root.join(folder)).expect("a folder").flatten().map(|e| e.path());
    let crates = below("core").chain(below("plugins")).chain(["sim-plugin", "validation"].map(|name| root.join(name)));
    let crates: Vec<_> = crates.filter(|folder| folder.join("src").is_dir()).collect();
    assert!(crates.len() > 10, "the crates were read");
    let of = |folder: &PathBuf| {
        circles(&modules(&folder.join("src")))
            .into_iter()
            .map(|pair| format!("{}: {pair}", folder.display()))
            .collect::<Vec<_>>()
    };
    assert_eq!(crates.iter().flat_map(of).collect::<Vec<_>>(), Vec::<String>::new());
}

#[test]
fn a_circle_of_modules_is_seen() {
    let module = |name: &str, text: &str| (vec![name.to_owned()], text.to_owned());
    let three = |last: &str| {
        BTreeMap::from([
            module("a", "use crate::{\n    b::{B, D},\n    d,\n};"),
            module("b", "fn f() { super::c::g() }"),
            module("c", last),
            module("d", ""),
        ])
    };
    assert_eq!(circles(&three("use crate::d::D;")), Vec::<String>::new());
    assert_eq!(circles(&three("use crate::a::A;")), ["a <-> b", "a <-> c", "b <-> c"]);
}
