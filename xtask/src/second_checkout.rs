//! Whether another checkout makes every product again: sources cloned into another folder, built there with crates that
//! lie elsewhere, and a copy of an archive whose telemetry has moved.

use crate::Failure;
use crate::dist::{ROOT, Workspace, cargo, output};
use serde_json::Value;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::process::Command;

const MODEL: &str = "model.toml";

/// What the first checkout makes. Day 2 is calibrated with two revisions of a model, day 3 once more in two pieces.
const STORY: [&[&str]; 12] = [
    &["init", "."],
    &["simulate", "mission.toml", "--out", "telemetry", "--start", "2035-01-01", "--seed", "1"],
    &["simulate", "mission.toml", "--out", "telemetry", "--start", "2035-01-02", "--seed", "2"],
    &["simulate", "mission.toml", "--out", "telemetry", "--start", "2035-01-03", "--seed", "3"],
    &["simulate", "mission.toml", "--out", "telemetry", "--start", "2035-01-04", "--seed", "4"],
    &["catch-up"],
    &["joint", "2035-01-01..2035-01-04"],
    &["products", "certify", "2035-01-01", "--from", "2035-01-01", "--until", "2035-02-01", "--into", "ops"],
    &["model", "add", MODEL, "stiffness:tm1.x"],
    &["run", "pipeline.toml", "telemetry/SC1_2035-01-02.mcap"],
    &[
        "run",
        "pipeline.toml",
        "telemetry/SC1_2035-01-03.mcap",
        "--until",
        "2035-01-03T00:20:00Z",
        "--save-state",
        "state",
    ],
    &["run", "pipeline.toml", "telemetry/SC1_2035-01-03.mcap", "--load-state", "state", "--stream", "oper", "--final"],
];

/// Does all of it in `folder`, a new one, and tells what came of it: an error where a library or a product differs.
pub(crate) fn try_it(folder: &Path, hours: &str) -> Result<String, Failure> {
    let root = Path::new(ROOT).canonicalize()?;
    let changed = output(Command::new("git").current_dir(&root).args(["status", "--porcelain"]))?;
    if !changed.is_empty() {
        return Err("a clone has what is committed alone: commit first what has changed here".into());
    }
    std::fs::create_dir(folder).map_err(|error| format!("{}: {error}", folder.display()))?;
    let folder = folder.canonicalize()?;
    let workspace = Workspace::read(&root)?;
    let target = workspace.target.to_str().ok_or("the target folder's path is no text")?;
    cargo(&root, &["build", "--quiet", "--release", "--workspace", "--lib", "--bins", "--target-dir", target])?;
    let first = workspace.target.join("release");
    let second = build_elsewhere(&root, &folder)?;

    let mut told = String::new();
    let mut differs = false;
    for library in workspace.plugins() {
        let name = format!("{}{library}{}", std::env::consts::DLL_PREFIX, std::env::consts::DLL_SUFFIX);
        let same = std::fs::read(first.join(&name))? == std::fs::read(second.join(&name))?;
        differs |= !same;
        writeln!(told, "{:<9} {name}", if same { "same" } else { "differs" })?;
    }
    let archive = copied_archive(&first, &folder, hours)?;
    let program = second.join(format!("dragfree{}", std::env::consts::EXE_SUFFIX));
    let ask = |arguments: &[&str]| -> Result<Value, Failure> {
        let mut command = Command::new(&program);
        command.current_dir(&archive).env_remove("DRAGFREE_PLUGIN_PATH").args(["--quiet", "--json"]).args(arguments);
        let answer = command.output()?;
        serde_json::from_slice(&answer.stdout)
            .map_err(|_| format!("{command:?}: {}", String::from_utf8_lossy(&answer.stderr)).into())
    };
    let list = ask(&["products", "list"])?;
    for product in list["products"].as_array().ok_or("no list of products")? {
        let id = product["id"].as_str().ok_or("a product without an id")?;
        let rebuilt = ask(&["products", "rebuild", id, "--inputs", "tapes"])?;
        let same = rebuilt["same"] == true && rebuilt["same_state"] != false;
        differs |= !same;
        writeln!(told, "{:<9} {id}", if same { "same" } else { "differs" })?;
    }
    if differs { Err(told.into()) } else { Ok(told) }
}

/// Builds a clone whose path, target folder and folder of crates are others; gives the folder of what was built.
fn build_elsewhere(root: &Path, folder: &Path) -> Result<PathBuf, Failure> {
    let clone = folder.join("a checkout of somebody else");
    output(Command::new("git").args(["clone", "--quiet"]).arg(root).arg(&clone))?;
    let crates = folder.join("home of somebody else/cargo");
    std::fs::create_dir_all(&crates)?;
    for entry in std::fs::read_dir(cargo_home()?)?.flatten() {
        std::os::unix::fs::symlink(entry.path(), crates.join(entry.file_name()))?;
    }
    let mut build = Command::new(std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into()));
    build.current_dir(&clone).env("CARGO_HOME", &crates).env_remove("CARGO_TARGET_DIR");
    output(build.args(["build", "--quiet", "--release"]))?;
    Ok(clone.join("target/release"))
}

fn cargo_home() -> Result<PathBuf, Failure> {
    let home = || std::env::home_dir().map(|home| home.join(".cargo"));
    Ok(std::env::var_os("CARGO_HOME").map(PathBuf::from).or_else(home).ok_or("there is no CARGO_HOME")?)
}

/// An archive that the first checkout makes, in a folder with its telemetry under other names; nothing else is left.
fn copied_archive(first: &Path, folder: &Path, hours: &str) -> Result<PathBuf, Failure> {
    let (made, copy) = (folder.join("mission"), folder.join("copy"));
    std::fs::create_dir(&made)?;
    std::fs::create_dir_all(copy.join("tapes"))?;
    let program = first.join(format!("dragfree{}", std::env::consts::EXE_SUFFIX));
    for arguments in STORY {
        let mut command = Command::new(&program);
        command.current_dir(&made).env_remove("DRAGFREE_PLUGIN_PATH").arg("--quiet").args(arguments);
        match arguments[0] {
            "simulate" => command.args(["--hours", hours]),
            "run" => command.args(["--model", MODEL, "--archive", "archive"]),
            _ => &mut command,
        };
        let done = command.output()?;
        // Short data say little: 4 is a verdict other than `agree`.
        if !matches!(done.status.code(), Some(0 | 4)) {
            return Err(format!("{command:?}: {}", String::from_utf8_lossy(&done.stderr)).into());
        }
        // What is true of the telemetry is not for the inbox.
        if arguments[0] == "simulate" && made.join("telemetry/truth").exists() {
            std::fs::remove_dir_all(made.join("telemetry/truth"))?;
        }
    }
    output(Command::new("cp").arg("-a").arg(made.join("archive")).arg(&copy))?;
    for (number, entry) in std::fs::read_dir(made.join("telemetry"))?.flatten().enumerate() {
        if entry.path().extension().is_some_and(|e| e == "mcap") {
            std::fs::rename(entry.path(), copy.join(format!("tapes/tape-{number}.mcap")))?;
        }
    }
    std::fs::remove_dir_all(&made)?;
    Ok(copy)
}
