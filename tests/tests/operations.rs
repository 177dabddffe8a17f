//! Days that run themselves: a late day, a doubled one, one in pieces, a corrected one, a killed program, and at the
//! end a certified set and every product made again.

use dragfree_tests::recording::{Message, Recording};
use dragfree_tests::{dragfree, expect, json, root};
use serde_json::{Value, json};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};
use tempfile::TempDir;

/// A mission as `init` writes it, with an hour of telemetry on either side of two midnights, in `vault`; of the third
/// day there are five hours in `vault/whole.mcap`.
struct Mission {
    dir: TempDir,
}

const HOUR_NS: u64 = 3_600_000_000_000;

impl Mission {
    fn new() -> Self {
        let dir = tempfile::tempdir().expect("a temporary folder");
        let mission = Self { dir };
        expect(dragfree(mission.path()).args(["init", "."]), 0);
        for (start, hours, seed) in [("2035-01-01T23:00:00Z", "2", "1"), ("2035-01-03T19:00:00Z", "6", "2")] {
            let arguments = ["--out", "vault", "--start", start, "--hours", hours, "--seed", seed];
            expect(dragfree(mission.path()).args(["simulate", "mission.toml"]).args(arguments), 0);
        }
        let whole = mission.path().join("vault/whole.mcap");
        std::fs::rename(mission.vault(3), &whole).expect("moved");
        let recording = Recording::read(&whole);
        let last_hour = recording.start_ns() + 4 * HOUR_NS;
        recording.write(&mission.vault(3), |m| (last_hour <= m.log_time).then_some(m));
        std::fs::create_dir(mission.path().join("telemetry")).expect("a folder");
        mission
    }

    fn path(&self) -> &Path {
        self.dir.path()
    }

    fn vault(&self, day: u32) -> PathBuf {
        self.path().join(format!("vault/SC1_2035-01-0{day}.mcap"))
    }

    fn inbox(&self, name: &str) -> PathBuf {
        self.path().join("telemetry").join(name)
    }

    fn arrives(&self, day: u32, name: &str) {
        std::fs::copy(self.vault(day), self.inbox(name)).expect("copied");
    }

    fn catch_up(&self) -> Command {
        let mut command = dragfree(self.path());
        command.args(["catch-up", "--json"]);
        command
    }

    /// Runs `catch-up`; days of January and the products that they got.
    fn ran(&self) -> Vec<(u32, String)> {
        let output = self.catch_up().output().expect("runs");
        assert!(matches!(output.status.code(), Some(0 | 4)), "{}", String::from_utf8_lossy(&output.stderr));
        let told: Value = serde_json::from_slice(&output.stdout).expect("JSON");
        let day = |d: &Value| {
            let number = d["day"].as_str().expect("a day")[8..].parse().expect("a number");
            (number, d["product"].as_str().expect("a product")[24..].to_owned())
        };
        told["days"].as_array().expect("days").iter().map(day).collect()
    }

    fn product(&self, id: &str) -> Value {
        json(dragfree(self.path()).args(["products", "show", id, "--json"]), 0)
    }
}

/// Days with the revisions of their products.
fn days(all: &[(u32, &str)]) -> Vec<(u32, String)> {
    all.iter().map(|(day, revision)| (*day, (*revision).to_owned())).collect()
}

#[test]
fn a_week_of_trials_ends_in_a_certified_set() {
    let mission = Mission::new();
    for day in [2, 3, 4] {
        mission.arrives(day, &format!("day{day}.mcap"));
    }
    assert_eq!(mission.ran(), days(&[(2, "0001"), (3, "0001"), (4, "0001")]));
    assert_eq!(mission.ran(), [], "nothing is left to do");

    // A day that comes late is run, and the day whose run-in it is. No other day changes.
    mission.arrives(1, "late.mcap");
    let dry = json(dragfree(mission.path()).args(["catch-up", "--dry-run", "--json"]), 0);
    assert_eq!(dry["days"][0]["reasons"], json!(["it has no product"]));
    let stale = json(dragfree(mission.path()).args(["products", "stale", "--json"]), 0);
    assert_eq!(stale["days"].as_array().map(Vec::len), Some(1));
    assert_eq!(stale["days"][0]["product"], "COM1B_2035-01-02_SC1_01_0001");
    assert_eq!(mission.ran(), days(&[(1, "0001"), (2, "0002")]));
    let second = mission.product("COM1B_2035-01-02_SC1_01_0002");
    assert_eq!(second["start_time_epoch_ns"], 2_051_308_800_000_000_000_i64, "the run-in is no part of the product");
    assert_eq!(second["epochs_used"], 36_000);

    // The same file twice is one file.
    mission.arrives(3, "again.mcap");
    assert_eq!(mission.ran(), []);

    // A day in six overlapping pieces, one of them backwards in time, is the same day.
    let whole = mission.product("2035-01-04");
    let recording = Recording::read(&mission.vault(4));
    let all = recording.messages();
    std::fs::remove_file(mission.inbox("day4.mcap")).expect("removed");
    for piece in 0..6 {
        let (from, until) = (all.len() * piece / 6, (all.len() * (piece + 1) / 6 + all.len() / 20).min(all.len()));
        let mut messages: Vec<Message> = all[from..until].to_vec();
        if piece == 2 {
            messages.reverse();
        }
        recording.write_all(&mission.inbox(&format!("dump{}.mcap", (piece * 5) % 6)), messages);
    }
    assert_eq!(mission.ran(), days(&[(4, "0002")]));
    let pieced = mission.product("2035-01-04");
    assert_eq!(pieced["coefficients"], whole["coefficients"]);
    assert_eq!(pieced["epochs_used"], whole["epochs_used"]);

    // A corrected file that begins earlier and has a gap of three hours: its day, and the day whose run-in it is.
    let recording = Recording::read(&mission.path().join("vault/whole.mcap"));
    let (gap, end) = (recording.start_ns() + HOUR_NS, recording.start_ns() + 4 * HOUR_NS);
    recording.write(&mission.inbox("day3.mcap"), |m| (m.log_time < gap || end <= m.log_time).then_some(m));
    std::fs::remove_file(mission.inbox("again.mcap")).expect("removed");
    assert_eq!(mission.ran(), days(&[(3, "0002"), (4, "0003")]));
    let gapped = mission.product("2035-01-03");
    assert_eq!((&gapped["epochs_used"], &gapped["verdict"]), (&json!(72_000), &json!("agree")));

    // A file that is none stops no day.
    std::fs::write(mission.inbox("broken.mcap"), "not telemetry").expect("written");
    let told = json(&mut mission.catch_up(), 0);
    assert_eq!(told["days"], json!([]));
    assert!(told["strangers"][0]["path"].as_str().is_some_and(|path| path.ends_with("broken.mcap")), "{told:#}");

    // A program that is killed in the middle leaves the rest to the next.
    expect(dragfree(mission.path()).args(["model", "add", "model.toml", "stiffness:tm1.x"]), 0);
    let events = || {
        let all = dragfree_tests::archived(&mission.path().join("archive"));
        all.iter().filter(|name| name.ends_with(".json") && name.starts_with("000")).count()
    };
    let before = events();
    let mut child = mission.catch_up().stdout(Stdio::null()).stderr(Stdio::null()).spawn().expect("runs");
    let since = Instant::now();
    while events() == before && since.elapsed() < Duration::from_secs(120) {
        std::thread::sleep(Duration::from_millis(5));
    }
    child.kill().expect("killed");
    child.wait().expect("ended");
    let rest = mission.ran();
    assert!((1..=3).contains(&rest.len()), "{rest:?}");
    assert_eq!(mission.ran(), []);
    let list = json(dragfree(mission.path()).args(["products", "list", "--json"]), 0);
    assert_eq!(list["problems"], json!([]));
    let latest = |day: u32| -> Value {
        let all = list["products"].as_array().expect("products");
        let of = |p: &&Value| p["latest"] == true && p["day"] == format!("2035-01-0{day}");
        all.iter().find(of).cloned().unwrap_or_default()
    };
    for day in 1..=4 {
        assert_eq!(latest(day)["stream"], "RPRO", "another model: {:#}", latest(day));
    }

    // What holds when.
    for day in 1..=4 {
        let (from, until) = (format!("2035-01-0{day}"), format!("2035-01-0{}", day + 1));
        let id = latest(day)["id"].as_str().expect("an id").to_owned();
        let window = ["--from", &from, "--until", &until, "--into", "ops"];
        expect(dragfree(mission.path()).args(["products", "certify", &id]).args(window), 0);
    }
    expect(dragfree(mission.path()).args(["products", "sets", "publish", "ops"]), 0);
    let at = json(dragfree(mission.path()).args(["at", "2035-01-03T12:00Z", "--json"]), 0);
    assert_eq!(at["calibrations"][0]["id"], latest(3)["id"]);
    expect(dragfree(mission.path()).args(["at", "2035-01-05"]), 1);

    // Every product again, from a copy of the archive alone and the telemetry in other places.
    let other = tempfile::tempdir().expect("a temporary folder");
    expect(Command::new("cp").arg("-r").arg(mission.path().join("archive")).arg(other.path()), 0);
    for folder in ["vault", "telemetry"] {
        let to = other.path().join("tapes");
        std::fs::create_dir_all(&to).expect("a folder");
        std::fs::rename(mission.path().join(folder), to.join(folder)).expect("moved");
    }
    let tapes = other.path().join("tapes");
    for product in list["products"].as_array().expect("products") {
        let id = product["id"].as_str().expect("an id");
        let mut rebuild = dragfree(other.path());
        rebuild.args(["products", "rebuild", id, "--json", "--inputs"]).arg(&tapes);
        let rebuilt = json(&mut rebuild, 0);
        assert_eq!((&rebuilt["same"], &rebuilt["same_state"]), (&json!(true), &json!(true)), "{id}: {rebuilt:#}");
    }
}

/// Waits until a program does nothing for some looks at the inbox: that it looks must not be news to it. A look takes
/// some hundredths of a second, and eight of them would follow each other here.
fn rests(id: u32) {
    let ticks = || {
        let stat = std::fs::read_to_string(format!("/proc/{id}/stat")).expect("it runs");
        let fields: Vec<&str> = stat.rsplit(')').next().unwrap_or_default().split_whitespace().collect();
        [11, 12].map(|k| fields[k].parse::<u64>().expect("a number")).iter().sum::<u64>()
    };
    let since = Instant::now();
    loop {
        let before = ticks();
        std::thread::sleep(Duration::from_secs(4));
        if ticks() - before <= 5 {
            return;
        }
        assert!(since.elapsed() < Duration::from_secs(60), "it looks and looks");
    }
}

#[test]
fn two_programs_never_run_days_of_one_archive() {
    let mission = Mission::new();
    mission.arrives(2, "a.mcap");
    let mut watch = dragfree(mission.path());
    let mut child = watch.args(["watch", "--settle-s", "0.5"]).stdout(Stdio::piped()).spawn().expect("runs");
    let product = mission.path().join("archive/COM1B_2035-01-02_SC1_01_0001.toml");
    let wait = |path: &Path| {
        let since = Instant::now();
        while !path.exists() {
            assert!(since.elapsed() < Duration::from_secs(120), "no {}", path.display());
            std::thread::sleep(Duration::from_millis(20));
        }
    };
    wait(&product);
    let refused = expect(&mut mission.catch_up(), 1);
    assert!(String::from_utf8_lossy(&refused.stderr).contains("another dragfree runs days"));
    // What comes in while it watches is run too.
    mission.arrives(3, "b.mcap");
    wait(&mission.path().join("archive/COM1B_2035-01-03_SC1_01_0001.toml"));
    rests(child.id());
    expect(Command::new("kill").arg("-TERM").arg(child.id().to_string()), 0);
    assert!(child.wait().expect("it ends").success());
    assert_eq!(mission.ran(), [], "everything was done");
}

#[test]
fn a_command_of_the_operators_is_run_for_a_loss_of_data() {
    let mission = Mission::new();
    let ops = mission.path().join("mission-ops.toml");
    let text = std::fs::read_to_string(&ops).expect("readable");
    let command = "on_data_loss = \"echo $DRAGFREE_PRODUCT $DRAGFREE_DAY > told\"\n";
    std::fs::write(&ops, text.replace("run_in_hours", &format!("{command}run_in_hours"))).expect("writable");
    let bytes = std::fs::read(mission.vault(2)).expect("readable");
    std::fs::write(mission.inbox("cut.mcap"), &bytes[..bytes.len() / 2]).expect("written");
    let output = mission.catch_up().output().expect("runs");
    assert_eq!(output.status.code(), Some(3), "{}", String::from_utf8_lossy(&output.stderr));
    let told = std::fs::read_to_string(mission.path().join("told")).expect("the command was run");
    assert_eq!(told.trim(), "COM1B_2035-01-02_SC1_01_0001 2035-01-02");
    // A single time of 1980 makes no days of the years since.
    let recording = Recording::read(&mission.vault(3));
    let mut messages = recording.messages().to_vec();
    let middle = messages.len() / 2;
    messages[middle].log_time = 316_000_000_000_000_000;
    recording.write_all(&mission.inbox("stray.mcap"), messages);
    let dry = json(dragfree(mission.path()).args(["catch-up", "--dry-run", "--json"]), 0);
    let due: Vec<&Value> = dry["days"].as_array().expect("days").iter().map(|day| &day["day"]).collect();
    assert_eq!(due, ["2035-01-03"]);
    // One that fails stops no other day, nor the commands of others.
    let failing = "on_data_loss = \"echo $DRAGFREE_DAY >> all; false\"\n";
    std::fs::write(&ops, text.replace("run_in_hours", &format!("{failing}run_in_hours"))).expect("writable");
    for day in [3, 4] {
        let bytes = std::fs::read(mission.vault(day)).expect("readable");
        std::fs::write(mission.inbox(&format!("cut{day}.mcap")), &bytes[..bytes.len() / 2]).expect("written");
    }
    let told = json(&mut mission.catch_up(), 1);
    let failed = |day: usize| told["days"][day]["commands_failed"][0].as_str().unwrap_or_default().to_owned();
    assert!(failed(0).contains("exit status: 1") && failed(1).contains("exit status: 1"), "{told:#}");
    let all = std::fs::read_to_string(mission.path().join("all")).expect("the command was run");
    assert_eq!(all, "2035-01-03\n2035-01-04\n");
    // From elsewhere, the file of operations names the archive; beside --archive it would be a second answer.
    let elsewhere = tempfile::tempdir().expect("a temporary folder");
    let list = || {
        let mut command = dragfree(elsewhere.path());
        command.args(["products", "list", "--json", "--ops"]).arg(&ops);
        command
    };
    assert_eq!(json(&mut list(), 0)["products"][0]["id"], "COM1B_2035-01-02_SC1_01_0001");
    expect(list().args(["--archive", "archive"]), 2);
    expect(dragfree(elsewhere.path()).args(["products", "list"]), 1);
}

/// The same inputs give the product that was withdrawn, so that no day is due; asked for by name it is run. A test is
/// no product of the day.
#[test]
fn a_withdrawn_product_is_made_again_only_when_asked_for_and_a_test_is_no_day() {
    let mission = Mission::new();
    mission.arrives(4, "day4.mcap");
    let mut test = dragfree(mission.path());
    let run = ["run", "pipeline.toml", "telemetry/day4.mcap", "--stream", "test", "--archive", "archive", "-q"];
    let ran = test.args(run).output().expect("runs");
    assert!(matches!(ran.status.code(), Some(0 | 4)), "{}", String::from_utf8_lossy(&ran.stderr));
    assert_eq!(mission.ran(), days(&[(4, "0002")]));
    let withdraw = ["products", "withdraw", "COM1B_2035-01-04_SC1_01_0002", "--reason", "wrong survey"];
    expect(dragfree(mission.path()).args(withdraw), 0);
    assert_eq!(mission.ran(), []);
    let day = dragfree(mission.path()).args(["day", "2035-01-04", "-q"]).output().expect("runs");
    assert!(matches!(day.status.code(), Some(0 | 4)), "{}", String::from_utf8_lossy(&day.stderr));
    assert_eq!(mission.product("2035-01-04")["id"], "COM1B_2035-01-04_SC1_01_0003");
}

/// Files of a source plugin do not say which days they cover.
#[test]
fn days_of_a_source_plugin_are_refused_with_what_to_do() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    expect(dragfree(dir.path()).args(["init", "."]), 0);
    let pipeline = dir.path().join("pipeline.toml");
    let text = std::fs::read_to_string(&pipeline).expect("readable");
    std::fs::write(&pipeline, format!("{text}\n[source]\nplugin = \"gracefo\"\n")).expect("writable");
    for command in [&["catch-up"][..], &["day", "2035-01-01"], &["products", "stale"]] {
        let refused = expect(dragfree(dir.path()).args(command), 1);
        let said = String::from_utf8_lossy(&refused.stderr).into_owned();
        for words in ["mission-ops.toml", "the source gracefo", "dragfree run"] {
            assert!(said.contains(words), "{command:?}: {said}");
        }
    }
}

/// The unit of systemd in the guide, followed to the letter in a folder that stands for the root of a machine: the
/// command that it starts calibrates what comes in, and the signal that it stops with ends it well, in time.
#[test]
fn the_service_of_the_guide_runs_from_the_page_alone() {
    let page = std::fs::read_to_string(root().join("ops-guide/src/operations.md")).expect("the page");
    let unit = page.split("```ini\n").nth(1).and_then(|rest| rest.split("```").next()).expect("a unit");
    let setting = |key: &str| -> &str {
        let line = unit.lines().find_map(|line| line.strip_prefix(key)?.strip_prefix('='));
        line.unwrap_or_else(|| panic!("the unit has no {key}"))
    };
    let machine = tempfile::tempdir().expect("a temporary folder");
    let within = |path: &str| machine.path().join(path.trim_start_matches('/'));
    let mut words = setting("ExecStart").split(' ');
    let program = within(words.next().expect("a program"));
    std::fs::create_dir_all(program.parent().expect("a folder")).expect("a folder");
    std::os::unix::fs::symlink(dragfree_tests::built().join("dragfree"), &program).expect("linked");
    let folder = within(setting("WorkingDirectory"));
    expect(dragfree(machine.path()).arg("init").arg(&folder), 0);
    let arguments: Vec<PathBuf> =
        words.map(|word| if word.starts_with('/') { within(word) } else { word.into() }).collect();
    assert!(arguments.iter().filter(|a| a.is_absolute()).all(|path| path.exists()), "{arguments:?}");
    std::fs::create_dir(folder.join("telemetry")).expect("a folder");
    let mut child = Command::new(&program)
        .args(&arguments)
        .current_dir(&folder)
        .env_clear()
        .stdout(Stdio::null())
        .stderr(Stdio::piped())
        .spawn()
        .expect("the service starts");
    let simulate = ["--out", "telemetry", "--hours", "0.2", "-q"];
    expect(dragfree(&folder).args(["simulate", "mission.toml"]).args(simulate), 0);
    let product = folder.join("archive/COM1B_2035-01-01_SC1_01_0001.toml");
    let since = Instant::now();
    while !product.exists() {
        assert!(since.elapsed() < Duration::from_secs(120), "no {}", product.display());
        assert!(child.try_wait().expect("a process").is_none(), "the service has ended");
        std::thread::sleep(Duration::from_millis(20));
    }
    let signal = setting("KillSignal").trim_start_matches("SIG");
    expect(Command::new("kill").arg(format!("-{signal}")).arg(child.id().to_string()), 0);
    let since = Instant::now();
    assert!(child.wait().expect("it ends").success());
    let patience: u64 = setting("TimeoutStopSec").parse().expect("seconds");
    assert!(since.elapsed() < Duration::from_secs(patience));
}
