//! The commands of the README and of the operators' book run as they stand there.

use dragfree_tests::{built, root};
use std::path::{Path, PathBuf};
use std::process::Command;

/// A line that a test can run: the reader's own builds of this repository are not.
fn is_run(command: &str) -> bool {
    ["dragfree ", "make "].iter().any(|start| command.starts_with(start)) || command.contains("/dragfree demo")
}

/// The command that the tests of the release run, from an unpacked one.
const DEMO: &str = "dragfree demo";

/// Lines of the `sh` blocks of a page that call `dragfree`, in order.
fn commands(page: &Path) -> Vec<String> {
    let text = std::fs::read_to_string(page).unwrap_or_else(|e| panic!("{}: {e}", page.display()));
    let mut inside = false;
    let mut found = Vec::new();
    for line in text.lines() {
        match line.trim() {
            "```sh" => inside = true,
            "```" => inside = false,
            command if inside && is_run(command) => {
                // The reader has just built the program; here it is on the path.
                let command = command.rsplit("&& ").next().unwrap_or(command);
                found.push(command.replace("./target/release/dragfree", "dragfree"));
            }
            _ => {}
        }
    }
    found
}

fn pages() -> Vec<PathBuf> {
    let book = root().join("ops-guide/src");
    let summary = std::fs::read_to_string(book.join("SUMMARY.md")).expect("a summary");
    let chapters = summary.split("](").skip(1).filter_map(|rest| rest.split(')').next()).map(|name| book.join(name));
    std::iter::once(root().join("README.md")).chain(chapters).collect()
}

/// Every picture that a page shows is there.
#[test]
fn every_picture_of_the_guide_is_there() {
    let mut shown = 0;
    for page in pages() {
        let text = std::fs::read_to_string(&page).expect("readable");
        for name in text.split("](pictures/").skip(1).filter_map(|rest| rest.split(')').next()) {
            let picture = page.with_file_name("pictures").join(name);
            assert!(picture.is_file(), "{}: {}", page.display(), picture.display());
            shown += 1;
        }
    }
    assert!(shown >= 3, "the closed loop has its pictures");
}

/// The reader begins in an empty folder with the program on the path: what a command reads, an earlier one made.
#[test]
fn every_command_of_the_guide_runs() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let path = std::env::join_paths(
        std::iter::once(built().to_owned()).chain(std::env::split_paths(&std::env::var_os("PATH").unwrap_or_default())),
    )
    .expect("a path");
    let all: Vec<(PathBuf, String)> =
        pages().into_iter().flat_map(|page| commands(&page).into_iter().map(move |c| (page.clone(), c))).collect();
    assert_eq!(all.iter().filter(|(_, command)| command == DEMO).count(), 2, "README and first chapter");
    let mut run = 0;
    for (page, command) in all.iter().filter(|(_, command)| command != DEMO) {
        let mut shell = Command::new("sh");
        shell.current_dir(dir.path()).args(["-c", command]).env("PATH", &path).env("NO_COLOR", "1");
        let output = shell.output().expect("sh runs");
        // Some of the data are short: a weak or inconsistent result is a result.
        assert!(
            matches!(output.status.code(), Some(0 | 4)),
            "{}: {command}\n{}{}",
            page.display(),
            String::from_utf8_lossy(&output.stdout),
            String::from_utf8_lossy(&output.stderr)
        );
        run += 1;
    }
    assert!(run >= 8, "the pages were read: {run} commands");
}

/// The guide's table of effects has every effect that comes with the program.
#[test]
fn the_guide_names_every_effect() {
    let listed = Command::new(built().join("dragfree")).args(["plugins", "list", "--json"]).output().expect("runs");
    let listed: serde_json::Value = serde_json::from_slice(&listed.stdout).expect("JSON");
    let ids = listed["plugins"].as_array().expect("plugins").iter().filter(|plugin| plugin["kind"] == "effect");
    let ids: Vec<&str> = ids.filter_map(|plugin| plugin["id"].as_str()).collect();
    assert!(ids.len() > 20, "{ids:?}");
    let page = std::fs::read_to_string(root().join("ops-guide/src/model.md")).expect("the page");
    let missing: Vec<&&str> = ids.iter().filter(|id| !page.contains(&format!("`{id}`"))).collect();
    assert!(missing.is_empty(), "model.md does not name {missing:?}");
}
