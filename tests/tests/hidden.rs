//! `--effect`, `--hidden` and `reveal` in a user's workflow.

use dragfree_tests::{dragfree, expect, fixture, json};
use serde_json::Value;
use std::collections::BTreeMap;
use std::path::Path;
use std::process::Command;

fn simulate(folder: &Path, out: &str, more: &[&str]) -> Command {
    let mut command = dragfree(folder);
    command.arg("simulate").arg(fixture("missions/taiji.toml")).args(["--out", out, "--json"]);
    // Ten minutes on either side of midnight: two files.
    command.args(["--start", "2035-01-01T23:50:00Z", "--hours", "0.3"]).args(more);
    command
}

type Map = BTreeMap<String, String>;

/// The file's own metadata, and that of each channel by topic.
fn metadata(path: &Path) -> (Map, BTreeMap<String, Map>) {
    let bytes = std::fs::read(path).expect("telemetry");
    let (mut header, mut channels) = (Map::new(), BTreeMap::new());
    for record in mcap::read::LinearReader::new(&bytes).expect("an MCAP file") {
        match record.expect("a record") {
            mcap::records::Record::Metadata(m) if m.name == "dragfree" => header = m.metadata,
            mcap::records::Record::Channel(c) => drop(channels.insert(c.topic, c.metadata)),
            _ => {}
        }
    }
    (header, channels)
}

fn files(made: &Value) -> Vec<String> {
    made["files"].as_array().expect("files").iter().map(|f| f.as_str().expect("a path").to_owned()).collect()
}

/// Telemetry of a hidden effect contains only the digest of the sealed file, in each day's file.
#[test]
fn telemetry_contains_only_the_digest_of_the_truth() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let plain = json(&mut simulate(dir.path(), "plain", &[]), 0);
    let hidden = json(&mut simulate(dir.path(), "hidden", &["--hidden", "3"]), 0);
    assert!(plain["sealed_file"].is_null(), "{plain}");
    let sealed = hidden["sealed_file"].as_str().expect("a sealed file");
    assert_eq!((files(&plain).len(), files(&hidden).len()), (2, 2));
    assert_eq!(hidden["truth_files"].as_array().map(Vec::len), Some(2), "the ordinary truth is there too");

    let opened = json(dragfree(dir.path()).args(["reveal", sealed, "--json"]), 0);
    for (a, b) in files(&plain).iter().zip(files(&hidden)) {
        let (mut a, mut b) = (metadata(&dir.path().join(a)), metadata(&dir.path().join(b)));
        assert_eq!(b.0.remove("sealed_sha256").as_deref(), opened["sha256"].as_str());
        // Channel records appear in the order of first messages.
        assert_eq!(a.0, b.0);
        assert!(a.1.len() > 50 && a.1.remove("/is").is_some() && b.1.remove("/is").is_some());
        assert_eq!(a.1, b.1);
    }
    assert_eq!(opened["telemetry"].as_array().map(Vec::len), Some(2), "{opened}");
    assert_eq!(opened["content"]["hidden_seed"], 3);
    let text = std::fs::read_to_string(dir.path().join(sealed)).expect("a sealed file");
    for effect in opened["content"]["effects"].as_array().expect("effects") {
        assert!(!text.contains(effect["effect"].as_str().expect("an id")), "{text}");
    }

    // The same seeds give the same file, other noise another; existing files are not overwritten.
    let again = json(&mut simulate(dir.path(), "again", &["--hidden", "3"]), 0);
    let bytes =
        |made: &Value| std::fs::read(dir.path().join(made["sealed_file"].as_str().expect("a path"))).expect("read");
    assert_eq!(bytes(&hidden), bytes(&again));
    let other = json(&mut simulate(dir.path(), "other", &["--hidden", "3", "--seed", "2"]), 0);
    assert_ne!(bytes(&hidden), bytes(&other));
}

#[test]
fn a_changed_sealed_file_is_reported() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let made = json(&mut simulate(dir.path(), "out", &["--hidden", "5"]), 0);
    let sealed = dir.path().join(made["sealed_file"].as_str().expect("a path"));
    let shown = expect(dragfree(dir.path()).arg("reveal").arg(&sealed), 0);
    let shown = String::from_utf8_lossy(&shown.stdout).into_owned();
    assert!(shown.contains("agrees with 2 telemetry files") && shown.contains("com-offset.tm1.x"), "{shown}");
    assert!(shown.lines().all(|line| line.chars().count() <= 80), "{shown}");

    let text = std::fs::read_to_string(&sealed).expect("a sealed file");
    // A change of one letter changes the digest.
    std::fs::write(&sealed, text.replace("hides", "hid")).expect("writable");
    let refused = expect(dragfree(dir.path()).arg("reveal").arg(&sealed), 1);
    let refused = String::from_utf8_lossy(&refused.stderr).into_owned();
    assert!(refused.contains("SHA-256") && refused.contains("it was changed"), "{refused}");
    let plain = json(&mut simulate(dir.path(), "plain", &[]), 0);
    let mut other = dragfree(dir.path());
    other.arg("reveal").arg(&sealed).args(["--telemetry", files(&plain)[0].as_str()]);
    let refused = String::from_utf8_lossy(&expect(&mut other, 1).stderr).into_owned();
    assert!(refused.contains("names no sealed file"), "{refused}");
}

/// The help and the simulator's message name the same effects.
#[test]
fn the_help_lists_the_effects_of_the_simulator() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let help = expect(dragfree(dir.path()).args(["simulate", "--help"]), 0);
    let help = String::from_utf8_lossy(&help.stdout).into_owned();
    let list = help.split("Effects, and where").nth(1).expect("a list");
    let refused = expect(&mut simulate(dir.path(), "out", &["--effect", "help:me=0"]), 1);
    let refused = String::from_utf8_lossy(&refused.stderr).into_owned();
    let ids = refused.split("there are ").nth(1).and_then(|rest| rest.split(';').next()).unwrap_or_default();
    let ids: Vec<&str> = ids.split(", ").collect();
    assert!(ids.len() > 20, "{refused}");
    for id in &ids {
        assert!(list.contains(&format!(" {id}:")), "{id} is not in the help: {list}");
    }
    // As many as in the help, apart from its examples.
    let named = list.split("Some have").next().unwrap_or_default();
    let entries =
        named.split_whitespace().filter(|word| word.contains(':') && word.contains(|c: char| c.is_lowercase()));
    let entries = entries.filter(|word| !word.ends_with(':')).count();
    assert_eq!(entries, ids.len(), "{named}");
}
