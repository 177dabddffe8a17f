//! Campaigns: what workers make apart is what a single machine makes, whatever is killed on the way.

#![allow(clippy::print_stdout, reason = "a skipped test says so")]

use dragfree_tests::{archived, built, dragfree, expect, install, json, root};
use serde_json::Value;
use std::collections::BTreeMap;
use std::os::unix::process::{CommandExt as _, ExitStatusExt as _};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::sync::OnceLock;
use std::time::{Duration, Instant};
use tempfile::TempDir;

const DAYS: &str = "2035-01-01..2035-01-09";

/// A mission and a campaign that simulates nine days of half an hour.
struct Campaign(TempDir);

impl Campaign {
    fn new() -> Self {
        let dir = tempfile::tempdir().expect("a temporary folder");
        expect(dragfree(dir.path()).args(["init", "."]), 0);
        let ops = dir.path().join("mission-ops.toml");
        let text = std::fs::read_to_string(&ops).expect("read").replace("run_in_hours = 1.0", "run_in_hours = 0.0");
        std::fs::write(&ops, text).expect("written");
        let spec =
            format!("[campaign]\nops = \"mission-ops.toml\"\ndays = \"{DAYS}\"\n\n[simulate]\nseed = 2\nhours = 0.5\n");
        std::fs::write(dir.path().join("spec.toml"), spec).expect("written");
        Self(dir)
    }

    fn path(&self) -> &Path {
        self.0.path()
    }

    fn command(&self, arguments: &[&str]) -> Command {
        let mut command = dragfree(self.path());
        command.arg("campaign").args(arguments);
        command
    }

    /// The tasks, in the order of the plan.
    fn plan(&self) -> Vec<Value> {
        let planned = json(self.command(&["plan", "spec.toml", "--out", "camp"]).arg("--json"), 0);
        planned["tasks"].as_array().expect("tasks").clone()
    }

    fn refusal(&self, arguments: &[&str]) -> String {
        let output = self.command(arguments).output().expect("runs");
        assert_eq!(output.status.code(), Some(1), "{}", String::from_utf8_lossy(&output.stdout));
        String::from_utf8_lossy(&output.stderr).split_whitespace().collect::<Vec<_>>().join(" ")
    }

    /// Digests of all products, that of all days together among them, by their ids.
    fn digests(&self) -> BTreeMap<String, String> {
        let joint = dragfree(self.path()).args(["joint", DAYS, "-q"]).output().expect("runs");
        assert!(matches!(joint.status.code(), Some(0 | 4)), "{}", String::from_utf8_lossy(&joint.stderr));
        let list = json(dragfree(self.path()).args(["products", "list", "--json"]), 0);
        assert_eq!(list["problems"], serde_json::json!([]));
        let of = |product: &Value| {
            let id = product["id"].as_str().expect("an id").to_owned();
            let shown = json(dragfree(self.path()).args(["products", "show", &id, "--json"]), 0);
            (id, shown["sha256"].as_str().expect("a digest").to_owned())
        };
        list["products"].as_array().expect("products").iter().map(of).collect()
    }

    fn commit(&self) -> Value {
        json(self.command(&["commit", "camp"]).arg("--json"), 0)
    }

    fn results(&self) -> usize {
        std::fs::read_dir(self.path().join("camp/results")).map_or(0, Iterator::count)
    }
}

fn kind(task: &Value) -> &str {
    task["kind"].as_str().expect("a kind")
}

fn id(task: &Value) -> &str {
    task["id"].as_str().expect("an id")
}

/// What one process after the other makes, in the order of the plan.
fn serial() -> &'static BTreeMap<String, String> {
    static SERIAL: OnceLock<BTreeMap<String, String>> = OnceLock::new();
    SERIAL.get_or_init(|| {
        let campaign = Campaign::new();
        for task in campaign.plan() {
            let done = json(campaign.command(&["task", "camp", id(&task)]).arg("--json"), 0);
            assert_eq!((&done["new"], done["failed"].is_null()), (&Value::Bool(true), true), "{done}");
        }
        campaign.commit();
        let digests = campaign.digests();
        assert_eq!(digests.len(), 10, "nine days and all together: {digests:?}");
        digests
    })
}

/// Several processes at once, days in another order: the same digests. A plan made again has the same ids, a task done
/// again is not done; a commit once more takes nothing over.
#[test]
fn processes_at_once_make_what_one_makes() {
    let campaign = Campaign::new();
    let tasks = campaign.plan();
    let same: Vec<Value> = campaign.plan().iter().map(|task| task["id"].clone()).collect();
    assert_eq!(same, tasks.iter().map(|task| task["id"].clone()).collect::<Vec<_>>());
    // The plan backwards, but for sums, which read what comes before.
    let plan = campaign.path().join("camp/plan.jsonl");
    let text = std::fs::read_to_string(&plan).expect("a plan");
    let (days, sums): (Vec<&str>, Vec<&str>) = text.lines().partition(|line| line.contains("\"kind\":\"flight\""));
    let shuffled: Vec<&str> = days.into_iter().rev().chain(sums).collect();
    std::fs::write(&plan, shuffled.join("\n") + "\n").expect("written");

    let status = json(&mut campaign.command(&["run", "camp", "--local", "3", "--json"]), 0);
    assert_eq!(status["kinds"]["days"], serde_json::json!([9, 9]), "{status}");
    let committed = campaign.commit();
    assert_eq!(committed["products"].as_array().map(Vec::len), Some(9));
    assert_eq!(&campaign.digests(), serial());
    let again = json(&mut campaign.command(&["task", "camp", "--number", "1", "--json"]), 0);
    assert_eq!(again["new"], false);
    assert_eq!(campaign.commit()["products"], serde_json::json!([]));
    // What the workers have added is used: nothing is kept beside it but the nodes of other lengths.
    let verified = json(dragfree(campaign.path()).args(["products", "verify", "--json"]), 0);
    assert_eq!(verified["broken"], serde_json::json!([]));
}

/// A plan of telemetry that is there gives the products that `catch-up` gives.
#[test]
fn days_of_the_inbox_are_those_of_catch_up() {
    let (single, many) = (Campaign::new(), Campaign::new());
    for day in 1..=3 {
        let start = format!("2035-01-{day:02}");
        let arguments = ["--out", "telemetry", "--start", &start, "--hours", "0.5", "--seed", "7"];
        expect(dragfree(single.path()).args(["simulate", "mission.toml"]).args(arguments), 0);
    }
    std::fs::remove_dir_all(single.path().join("telemetry/truth")).expect("removed");
    expect(Command::new("cp").arg("-a").arg(single.path().join("telemetry")).arg(many.path()), 0);
    expect(dragfree(single.path()).args(["catch-up", "-q"]), 0);

    let spec = many.path().join("spec.toml");
    let text = std::fs::read_to_string(&spec).expect("read");
    std::fs::write(&spec, text.split("[simulate]").next().expect("a part")).expect("written");
    assert_eq!(many.plan().iter().filter(|task| kind(task) == "day").count(), 3);
    // A day whose telemetry is away fails and is told; it is tried again. A result that cannot be read gives way.
    let (there, away) = (many.path().join("telemetry/SC1_2035-01-02.mcap"), many.path().join("away.mcap"));
    std::fs::rename(&there, &away).expect("moved");
    let status = json(&mut many.command(&["run", "camp", "--json"]), 1);
    assert_eq!((&status["kinds"]["days"], &status["failed"][0][0]), (&serde_json::json!([2, 3]), &"2035-01-02".into()));
    std::fs::rename(&away, &there).expect("moved");
    let first = many.path().join("camp").join(many.plan()[0]["output"].as_str().expect("a folder"));
    std::fs::write(first.join("result.json"), "bad").expect("written");
    json(&mut many.command(&["run", "camp", "--json"]), 0);
    many.commit();
    assert_eq!(many.digests(), single.digests());
    let due = json(dragfree(many.path()).args(["catch-up", "--dry-run", "--json"]), 0);
    assert_eq!(due["days"], serde_json::json!([]), "nothing is left to do");
}

/// What a worker may not do is refused: another model than planned, a result that is missing or damaged. Nothing is
/// taken over then.
#[test]
fn what_does_not_fit_is_refused_and_nothing_taken_over() {
    let campaign = Campaign::new();
    let tasks = campaign.plan();
    let (day, sums) = (id(&tasks[0]), id(tasks.last().expect("a task")));
    let early = campaign.refusal(&["task", "camp", sums]);
    assert!(early.contains("needs the result of"), "{early}");
    expect(&mut campaign.command(&["task", "camp", day]), 0);
    let missing = campaign.refusal(&["commit", "camp"]);
    assert!(missing.contains("1 of") && missing.contains("2035-01-02"), "{missing}");

    let model = campaign.path().join("model.toml");
    let text = std::fs::read_to_string(&model).expect("read");
    std::fs::write(&model, format!("{text}\n# another\n")).expect("written");
    let other = campaign.refusal(&["task", "camp", id(&tasks[1])]);
    assert!(other.contains("another program, or other plugins"), "{other}");
    std::fs::write(&model, text).expect("written");

    json(&mut campaign.command(&["run", "camp", "--json"]), 0);
    let product = archived(&campaign.path().join("camp/results").join(day).join("archive"))
        .into_iter()
        .find(|name| name.ends_with(".neq.json"))
        .expect("sums of the day");
    let path = campaign.path().join("camp/results").join(day).join("archive").join(product);
    let mut content = std::fs::read(&path).expect("read");
    content[99] ^= 1;
    std::fs::write(&path, content).expect("written"); // the object, too: it is a link
    let damaged = campaign.refusal(&["commit", "camp"]);
    assert!(damaged.contains("digest"), "{damaged}");
    let empty = json(dragfree(campaign.path()).args(["products", "list", "--json"]), 0);
    assert_eq!(empty["products"], serde_json::json!([]));
    assert!(campaign.refusal(&["task", "camp", "0000"]).contains("no task 0000"));
    let spec = campaign.path().join("spec.toml");
    let text = std::fs::read_to_string(&spec).expect("read");
    std::fs::write(&spec, text.replace("hours = 0.5", "hours = 25")).expect("written");
    assert!(campaign.refusal(&["plan", "spec.toml", "--out", "other"]).contains("at most 24"));
    assert!(!campaign.path().join("other").exists(), "a plan that failed leaves nothing");
}

/// Slurm on this machine: a controller and a node, in a folder of their own.
struct Slurm {
    folder: TempDir,
    daemons: Vec<Group>,
}

impl Slurm {
    fn start() -> Self {
        let said = install(&["slurmctld", "slurmd", "sbatch"], &["slurmctld", "slurmd", "slurm-client"]);
        assert!(said.status.success(), "tests/install.sh failed: {}", String::from_utf8_lossy(&said.stderr));
        let folder = tempfile::tempdir().expect("a temporary folder");
        let ask = |program: &str, argument: &str| {
            let output = expect(Command::new(program).arg(argument), 0);
            String::from_utf8(output.stdout).expect("text").trim().to_owned()
        };
        let port = || std::net::TcpListener::bind("127.0.0.1:0").expect("a port");
        let ports = [port(), port()].map(|listener| listener.local_addr().expect("a port").port().to_string());
        let text = std::fs::read_to_string(root().join("tests/slurm/slurm.conf")).expect("a configuration");
        let text = text.replace("FOLDER", folder.path().to_str().expect("text")).replace("USER", &ask("id", "-un"));
        let text = text.replace("HOST", ask("uname", "-n").split('.').next().expect("a name"));
        let text = text.replace("PORT_OF_CONTROLLER", &ports[0]).replace("PORT_OF_NODE", &ports[1]);
        std::fs::write(folder.path().join("slurm.conf"), text).expect("written");
        let mut slurm = Self { folder, daemons: Vec::new() };
        for (program, arguments) in [("slurmctld", vec!["-D", "-i"]), ("slurmd", vec!["-D"])] {
            let mut daemon = slurm.command(program);
            // Users other than root do not have it on their path.
            daemon.env("PATH", path_with(&[Path::new("/usr/sbin")])).args(arguments);
            let log = slurm.folder.path().join(program).with_extension("log");
            slurm.daemons.push(Group::start(daemon.arg("-L").arg(log)));
        }
        wait("a node that takes jobs", || {
            let idle = slurm.command("sinfo").args(["--noheader", "--format=%T"]).output();
            idle.is_ok_and(|output| output.stdout == b"idle\n") || slurm.ended()
        });
        slurm
    }

    /// Never, but with what the daemons say.
    fn ended(&self) -> bool {
        let log = |name: &str| std::fs::read_to_string(self.folder.path().join(name)).unwrap_or_default();
        let told = [log("slurmctld.log"), log("slurmd.log")].concat();
        assert!(!told.contains("fatal: "), "{told}");
        false
    }

    fn command(&self, program: &str) -> Command {
        let mut command = Command::new(program);
        command.env("SLURM_CONF", self.folder.path().join("slurm.conf"));
        command
    }

    fn wait_until_idle(&self) {
        for _ in 0..3 {
            let since = Instant::now();
            while since.elapsed() < Duration::from_secs(50) {
                if expect(self.command("squeue").arg("--noheader"), 0).stdout.is_empty() {
                    return;
                }
                std::thread::sleep(Duration::from_millis(100));
            }
        }
        let queue = expect(&mut self.command("squeue"), 0);
        panic!("still there: {}", String::from_utf8_lossy(&queue.stdout));
    }
}

impl Drop for Slurm {
    fn drop(&mut self) {
        // Tasks are no children of the daemons.
        let _ = self.command("scancel").args(["--partition", "all"]).status();
        self.daemons.iter_mut().rev().for_each(Group::kill);
    }
}

/// Stands before the program: the first one that does the third line of the plan is killed at work.
const KILLED_ONCE: &str = r#"#!/bin/sh
case "$*" in
*"--number 3")
    if mkdir killed; then
        PROGRAM "$@" &
        until [ -n "$(ls camp/scratch)" ]; do :; done
        kill -KILL $!
        exit 1
    fi
    ;;
esac
exec PROGRAM "$@"
"#;

/// Slurm itself, with arrays of at most four tasks. A task is killed at work and another one cancelled: the sums that
/// need them fail and nothing hangs. The script does what is left when it is started again, and no more: the archive is
/// that of one machine.
#[test]
fn arrays_of_slurm_make_what_one_machine_makes() {
    use std::os::unix::fs::PermissionsExt as _;
    let slurm = Slurm::start();
    let campaign = Campaign::new();
    let tasks = campaign.plan();
    assert_eq!(tasks.len(), 14, "nine days, and sums of three levels");
    let bin = campaign.path().join("it's a folder");
    std::fs::create_dir(&bin).expect("a folder");
    let script = KILLED_ONCE.replace("PROGRAM", built().join("dragfree").to_str().expect("text"));
    std::fs::write(bin.join("dragfree"), script).expect("written");
    std::fs::set_permissions(bin.join("dragfree"), std::fs::Permissions::from_mode(0o755)).expect("a program");
    let submit = || {
        let mut script = slurm.command(root().join("campaigns/slurm_array.sh").to_str().expect("text"));
        script.current_dir(campaign.path()).env("PATH", path_with(&[&bin])).args(["camp", "--comment", "a test"]);
        String::from_utf8(expect(&mut script, 0).stdout).expect("text")
    };
    let told = submit();
    expect(slurm.command("scancel").arg("1_4"), 0);
    let lines: Vec<&str> = told.lines().collect();
    assert_eq!(lines[0], "job 1: tasks 1-4 from line 0 of the plan");
    let rest = ["1-4 from line 4", "1 from line 8", "1-2 from line 9", "1-2 from line 11", "1 from line 13"];
    assert!(lines[1..].iter().zip(rest).all(|(line, part)| line.contains(part)) && lines.len() == 6, "{told}");
    slurm.wait_until_idle();
    let status = json(campaign.command(&["status", "camp"]).arg("--json"), 0);
    assert_eq!(status["kinds"]["days"], serde_json::json!([7, 9]), "{status}");
    assert!(campaign.refusal(&["commit", "camp"]).contains("have a result"));

    let told = submit();
    assert!(told.lines().next().is_some_and(|line| line.ends_with(": tasks 1-2 from line 2 of the plan")), "{told}");
    slurm.wait_until_idle();
    assert_eq!(submit(), "every task has a result\n");
    assert_eq!(campaign.results(), tasks.len());
    campaign.commit();
    assert_eq!(&campaign.digests(), serial());
}

/// `PATH` with folders before it.
fn path_with(folders: &[&Path]) -> std::ffi::OsString {
    let own = std::env::var_os("PATH").unwrap_or_default();
    let folders = folders.iter().map(|folder| folder.to_path_buf());
    std::env::join_paths(folders.chain(std::env::split_paths(&own))).expect("a path")
}

/// The library that ends a program at a write.
fn preloaded() -> &'static Path {
    static LIBRARY: OnceLock<(TempDir, PathBuf)> = OnceLock::new();
    let made = LIBRARY.get_or_init(|| {
        let dir = tempfile::tempdir().expect("a temporary folder");
        let library = dir.path().join("libfailing_writes.so");
        let mut compile = Command::new(std::env::var_os("CC").unwrap_or_else(|| "cc".into()));
        compile.args(["-std=gnu11", "-shared", "-fPIC"]).arg(root().join("tests/c/failing_writes.c"));
        expect(compile.arg("-o").arg(&library).arg("-ldl"), 0);
        (dir, library)
    });
    &made.1
}

/// Does a task that is killed at a write; gives the number of writes where it was not.
fn killed(campaign: &Campaign, task: &str, at: u32) -> (Output, u32) {
    let count = campaign.path().join("count");
    let mut command = campaign.command(&["task", "camp", task]);
    command.env("LD_PRELOAD", preloaded()).env("FAIL_UNDER", campaign.path().join("camp"));
    command.env("FAIL_AT", at.to_string()).env("FAIL_ERRNO", "0").env("FAIL_COUNT", &count);
    let output = command.output().expect("runs");
    let calls = std::fs::read_to_string(&count).ok().and_then(|text| text.parse().ok()).unwrap_or(0);
    (output, calls)
}

/// A worker that is killed at each of its writes in turn, while it adds sums and at the last fifteen writes of a day,
/// the rename among them, leaves nothing half done: the next one does the task, and the archive is the same.
#[test]
fn a_worker_killed_at_any_write_changes_nothing() {
    let campaign = Campaign::new();
    let tasks = campaign.plan();
    let mut kills = 0;
    for task in &tasks {
        if kind(task) == "flight" && id(task) == id(&tasks[0]) {
            let (whole, calls) = killed(&campaign, id(task), u32::MAX);
            assert!(whole.status.success() && calls > 15, "{calls}");
            std::fs::remove_dir_all(campaign.path().join("camp").join(task["output"].as_str().expect("a folder")))
                .expect("removed");
            for at in calls - 15..=calls {
                let before = campaign.results();
                let (output, _) = killed(&campaign, id(task), at);
                assert_eq!(output.status.signal(), Some(9), "{at} of {calls}: {output:?}");
                kills += 1;
                if campaign.results() > before {
                    break; // killed after the rename: the task is done
                }
            }
        } else if kind(task) == "sums" && kills < 40 {
            for at in 1.. {
                let (output, _) = killed(&campaign, id(task), at);
                if output.status.signal() != Some(9) || campaign.results() == tasks.len() {
                    break;
                }
                kills += 1;
                let path = campaign.path().join("camp").join(task["output"].as_str().expect("a folder"));
                if path.exists() {
                    break;
                }
            }
        }
        json(campaign.command(&["task", "camp", id(task)]).arg("--json"), 0);
    }
    assert!(kills > 20, "{kills}");
    let committed = campaign.commit();
    assert!(committed["cleared"].as_u64().is_some_and(|n| n > 0), "{committed}");
    assert_eq!(std::fs::read_dir(campaign.path().join("camp/scratch")).expect("a folder").count(), 0);
    assert_eq!(&campaign.digests(), serial());
}

const PACKAGES: [&str; 2] = ["dask==2026.8.0", "distributed==2026.8.0"];

/// A Python with Dask; `None`, with a message, if unavailable.
fn python() -> Option<PathBuf> {
    let folder = built().join("python-dask");
    let python = folder.join("bin/python");
    let ready = || Command::new(&python).args(["-c", "import distributed"]).output().is_ok_and(|o| o.status.success());
    if ready() {
        return Some(python);
    }
    if !Command::new("python3").args(["-m", "venv"]).arg(&folder).output().is_ok_and(|o| o.status.success()) {
        println!("skipped: no python3 with venv on this machine");
        return None;
    }
    let mut install = Command::new(&python);
    install.args(["-m", "pip", "install", "--quiet", "--disable-pip-version-check"]).args(PACKAGES);
    let output = install.output().expect("pip runs");
    if ready() {
        return Some(python);
    }
    println!("skipped: pip cannot install {PACKAGES:?}: {}", String::from_utf8_lossy(&output.stderr));
    None
}

/// A process with all that it starts, killed when it is dropped.
struct Group(Child);

impl Group {
    fn start(command: &mut Command) -> Self {
        command.process_group(0).stdout(Stdio::null()).stderr(Stdio::null());
        Self(command.spawn().expect("starts"))
    }

    fn kill(&mut self) {
        let _ = Command::new("kill").args(["-KILL", "--", &format!("-{}", self.0.id())]).stderr(Stdio::null()).status();
        let _ = self.0.wait();
    }
}

impl Drop for Group {
    fn drop(&mut self) {
        self.kill();
    }
}

/// Waits for something, for a minute at most.
fn wait(what: &str, mut there: impl FnMut() -> bool) {
    let since = Instant::now();
    while !there() {
        assert!(since.elapsed() < Duration::from_secs(60), "{what} in a minute");
        std::thread::sleep(Duration::from_millis(20));
    }
}

/// A real scheduler with two workers, and two clients that submit one plan at once. A worker is killed while it is at a
/// task, then the scheduler. Another cluster does what is left: the archive is that of one machine.
#[test]
fn dask_makes_what_one_machine_makes_whatever_is_killed() {
    let Some(python) = python() else { return };
    let campaign = Campaign::new();
    let tasks = campaign.plan();
    let path = path_with(&[built()]);
    let start = |arguments: &[&str]| {
        Group::start(Command::new(&python).current_dir(campaign.path()).env("PATH", &path).args(arguments))
    };
    let module = |name: &str, more: &[&str]| {
        start(&[&["-m", name, "--scheduler-file", "scheduler.json", "--no-dashboard"], more].concat())
    };
    let mut scheduler = module("distributed.cli.dask_scheduler", &["--port", "0"]);
    let file = campaign.path().join("scheduler.json");
    let address = || -> Option<String> {
        let value: Value = serde_json::from_slice(&std::fs::read(&file).ok()?).ok()?;
        Some(value["address"].as_str()?.to_owned())
    };
    wait("a scheduler", || address().is_some());
    let address = address().expect("an address");
    let worker = || module("distributed.cli.dask_worker", &["--nthreads", "1", "--no-nanny"]);
    let mut workers = [worker(), worker()];
    let driver = root().join("campaigns/dask_driver.py");
    let driver = driver.to_str().expect("a path");
    let mut clients = [0, 1].map(|_| start(&[driver, "camp", "--scheduler", &address]));

    wait("a result", || campaign.results() >= 1);
    wait("a task at work", || {
        std::fs::read_dir(campaign.path().join("camp/scratch")).is_ok_and(|mut all| all.next().is_some())
    });
    workers[0].kill();
    wait("results of the other worker", || campaign.results() >= 3);
    scheduler.kill();
    workers.iter_mut().chain(&mut clients).for_each(Group::kill);
    let before = campaign.results();
    assert!(before < tasks.len(), "the scheduler was killed too late to prove anything");

    let mut last = Command::new(&python);
    last.current_dir(campaign.path()).env("PATH", &path).args([driver, "camp", "--commit"]);
    expect(&mut last, 0);
    assert_eq!(&campaign.digests(), serial());
    assert_eq!(std::fs::read_dir(campaign.path().join("camp/scratch")).expect("a folder").count(), 0);
}
