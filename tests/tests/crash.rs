//! Every write of a writing command fails in turn, or the program is killed there: nothing that was committed is lost,
//! nothing is half visible, nothing is left after the next command.

use dragfree_tests::{archived, dragfree, expect, fixture, json, root, simulate};
use serde_json::Value;
use std::io::{BufRead as _, BufReader};
use std::os::unix::process::ExitStatusExt as _;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::sync::OnceLock;
use std::time::Instant;
use tempfile::TempDir;

const FIRST: &str = "COM1B_2035-01-01_SC1_01_0001";

const ENOSPC: i32 = 28;
const EINTR: i32 = 4;
const EIO: i32 = 5;
const EROFS: i32 = 30;
const EDQUOT: i32 = 122;
/// In place of an error, the program is killed.
const KILL: i32 = 0;

struct Bench {
    dir: TempDir,
    telemetry: PathBuf,
    preloaded: PathBuf,
    /// Digest of the product that every undisturbed run gives.
    digest: String,
}

/// An archive with one product, and the library that makes writes fail.
fn bench() -> &'static Bench {
    static BENCH: OnceLock<Bench> = OnceLock::new();
    BENCH.get_or_init(|| {
        let dir = tempfile::tempdir().expect("a temporary folder");
        let telemetry = simulate(dir.path(), &["--hours", "0.05"]).remove(0);
        let library = dir.path().join("libfailing_writes.so");
        let compiler = std::env::var_os("CC").unwrap_or_else(|| "cc".into());
        let mut compile = Command::new(compiler);
        compile.args(["-std=gnu11", "-Wall", "-Wextra", "-Werror", "-shared", "-fPIC"]);
        compile.arg(root().join("tests/c/failing_writes.c")).arg("-o").arg(&library).arg("-ldl");
        expect(&mut compile, 0);
        let product = json(run(dir.path(), &telemetry).arg("--json"), 0);
        let digest = product["sha256"].as_str().expect("a digest").to_owned();
        Bench { dir, telemetry, preloaded: library, digest }
    })
}

fn run(folder: &Path, telemetry: &Path) -> Command {
    let mut command = dragfree(folder);
    command.arg("run").arg(fixture("pipelines/science-mode.toml")).arg(telemetry);
    command.arg("--archive").arg(folder.join("archive"));
    command
}

/// A copy of the archive with one product; links stay links.
fn copy() -> TempDir {
    let dir = tempfile::tempdir().expect("a temporary folder");
    expect(Command::new("cp").arg("-a").arg(bench().dir.path().join("archive")).arg(dir.path()), 0);
    dir
}

/// A failure: the number of the call, what comes of it, and whether it stays so.
#[derive(Clone, Copy, Debug)]
struct Failure {
    at: u32,
    errno: i32,
    stays: bool,
}

fn disturbed(mut command: Command, folder: &Path, failure: Failure) -> Output {
    command.env("LD_PRELOAD", &bench().preloaded).env("FAIL_UNDER", folder.join("archive"));
    command.env("FAIL_AT", failure.at.to_string()).env("FAIL_ERRNO", failure.errno.to_string());
    command.env("FAIL_ON", u8::from(failure.stays).to_string()).env("FAIL_COUNT", folder.join("count"));
    command.output().expect("the program runs")
}

fn listed(folder: &Path) -> Vec<String> {
    let list = json(dragfree(folder).args(["products", "list", "--json"]), 0);
    assert_eq!(list["problems"], serde_json::json!([]), "{list:#}");
    let ids =
        list["products"].as_array().expect("products").iter().map(|p| p["id"].as_str().expect("an id").to_owned());
    ids.collect()
}

/// Nothing lost, nothing half visible, nothing left; returns the ids.
fn sound(folder: &Path, what: &dyn std::fmt::Debug) -> Vec<String> {
    let ids = listed(folder);
    assert!(ids.contains(&FIRST.to_owned()), "{what:?}: a committed product is lost: {ids:?}");
    let verified = json(dragfree(folder).args(["products", "verify", "--json"]), 0);
    assert_eq!(verified["broken"], serde_json::json!([]), "{what:?}");
    let left: Vec<String> =
        archived(&folder.join("archive")).into_iter().filter(|name| name.starts_with("staging/")).collect();
    assert!(left.is_empty(), "{what:?}: {left:?}");
    for (number, id) in ids.iter().enumerate() {
        assert!(id.ends_with(&format!("_{:04}", number + 1)), "{what:?}: a gap in {ids:?}");
    }
    ids
}

/// Makes every write of a command fail in turn; returns how many there were. `committed` counts what the command adds
/// to; it is given the products.
fn every_write(
    command: impl Fn(&Path) -> Command,
    committed: impl Fn(&Path, &[String]) -> usize,
    errno: i32,
    stays: bool,
) -> u32 {
    let untouched = copy();
    let before = committed(untouched.path(), &listed(untouched.path()));
    for at in 1.. {
        let folder = copy();
        let failure = Failure { at, errno, stays };
        let output = disturbed(command(folder.path()), folder.path(), failure);
        let ids = sound(folder.path(), &failure);
        let after = committed(folder.path(), &ids);
        assert!(after == before || after == before + 1, "{failure:?}");
        let told = String::from_utf8_lossy(&output.stderr).into_owned();
        if output.status.signal() != Some(9) {
            assert_eq!(output.status.success(), after > before, "{failure:?}: {:?} {told}", output.status);
            let calls = std::fs::read_to_string(folder.path().join("count")).expect("a count");
            if calls.parse::<u32>().expect("a number") < at {
                return at - 1;
            }
        }
        // The next run is as if nothing had been.
        if at % 8 == 1 {
            let product = json(run(folder.path(), &bench().telemetry).arg("--json"), 0);
            assert_eq!(product["sha256"], bench().digest, "{failure:?}");
            assert_eq!(listed(folder.path()).len(), ids.len() + 1, "{failure:?}");
        }
    }
    unreachable!("the loop ends behind the last write")
}

fn sets(folder: &Path, _: &[String]) -> usize {
    let sets: Value = json(dragfree(folder).args(["products", "sets", "list", "--json"]), 0);
    sets["sets"].as_array().expect("sets").len()
}

fn certify(folder: &Path) -> Command {
    let mut command = dragfree(folder);
    command.args(["products", "certify", FIRST, "--from", "2035-01-01", "--until", "2035-02-01", "--into", "ops"]);
    command.arg("--archive").arg(folder.join("archive"));
    command
}

/// Counts of writes, so that a library that is not preloaded is noticed.
#[test]
fn every_write_of_certify_fails_in_turn() {
    let errors = [(ENOSPC, true), (EIO, false), (EINTR, false), (EROFS, true), (EDQUOT, false), (KILL, false)];
    for (errno, stays) in errors {
        let writes = every_write(certify, sets, errno, stays);
        assert!(writes > 15, "{writes} writes with error {errno}");
    }
}

#[test]
fn every_write_of_withdraw_fails_in_turn() {
    let withdraw = |folder: &Path| {
        let mut command = dragfree(folder);
        command.args(["products", "withdraw", FIRST, "--reason", "a test", "--archive"]).arg(folder.join("archive"));
        command
    };
    let withdrawn = |folder: &Path, _: &[String]| {
        let list = json(dragfree(folder).args(["products", "list", "--json"]), 0);
        list["products"].as_array().expect("products").iter().filter(|p| !p["withdrawn"].is_null()).count()
    };
    for (errno, stays) in [(ENOSPC, true), (EINTR, false), (KILL, false)] {
        let writes = every_write(withdraw, withdrawn, errno, stays);
        assert!(writes > 10, "{writes} writes with error {errno}");
    }
}

#[test]
fn every_write_of_run_fails_in_turn() {
    for (errno, stays) in [(ENOSPC, true), (KILL, false)] {
        let products = |_: &Path, ids: &[String]| ids.len();
        let writes = every_write(|folder| run(folder, &bench().telemetry), products, errno, stays);
        assert!(writes > 40, "{writes} writes with error {errno}");
    }
}

/// SIGKILL, SIGTERM, SIGINT and SIGHUP at instants all over a run.
#[test]
fn a_signal_at_any_instant_loses_nothing() {
    const SIGNALS: [&str; 4] = ["KILL", "TERM", "INT", "HUP"];
    const KILLS: u32 = 36;
    let folder = copy();
    let started = Instant::now();
    expect(&mut run(folder.path(), &bench().telemetry), 0);
    let whole = started.elapsed();
    let mut ended = 0;
    for kill in 0..KILLS {
        let mut command = run(folder.path(), &bench().telemetry);
        let mut child = command.stdout(Stdio::null()).stderr(Stdio::null()).spawn().expect("runs");
        std::thread::sleep(whole * kill / KILLS);
        let signal = SIGNALS[kill as usize % SIGNALS.len()];
        // One that has ended already is past being killed.
        let _ = Command::new("kill").arg(format!("-{signal}")).arg(child.id().to_string()).output();
        ended += u32::from(child.wait().expect("it ends").success());
        sound(folder.path(), &(signal, kill));
    }
    let ids = sound(folder.path(), &"all kills");
    assert!(ids.len() as u32 >= 2 + ended, "whoever said that it was done has archived its product");
    assert!(ended < KILLS, "some were killed");
}

/// `nohup` starts a program with SIGHUP ignored; a handler would take that back.
#[test]
fn a_program_that_is_to_outlive_its_terminal_does() {
    let folder = copy();
    let command = run(folder.path(), &bench().telemetry);
    // The line tells that the shell ignores the signal: one that came earlier would end the shell itself.
    let script = "trap '' HUP; echo ignored; exec \"$@\" > /dev/null";
    let mut shell = Command::new("sh");
    shell.args(["-c", script, "sh"]).arg(command.get_program()).args(command.get_args());
    let mut child = shell.stdout(Stdio::piped()).stderr(Stdio::null()).spawn().expect("runs");
    let mut line = String::new();
    BufReader::new(child.stdout.take().expect("a pipe")).read_line(&mut line).expect("a line");
    assert_eq!(line, "ignored\n");
    while child.try_wait().expect("a child").is_none() {
        let _ = Command::new("kill").arg("-HUP").arg(child.id().to_string()).output(); // it may just have ended
        std::thread::sleep(std::time::Duration::from_millis(20));
    }
    assert!(child.wait().expect("it ended").success());
}

#[test]
fn eight_programs_at_once_get_a_revision_each() {
    const PROGRAMS: usize = 8;
    let folder = copy();
    let mut children: Vec<_> = (0..PROGRAMS)
        .map(|_| run(folder.path(), &bench().telemetry).arg("-q").stdout(Stdio::null()).spawn().expect("runs"))
        .collect();
    for child in &mut children {
        assert!(child.wait().expect("it ends").success());
    }
    assert_eq!(sound(folder.path(), &"eight programs").len(), 1 + PROGRAMS);
    let list = json(dragfree(folder.path()).args(["products", "list", "--json"]), 0);
    for product in list["products"].as_array().expect("products") {
        assert_eq!(product["sha256"], bench().digest);
    }
}
