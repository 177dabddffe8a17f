//! Plugins that break every rule: each ends in a sentence that names the plugin and what it did, in time, with failure,
//! and leaves nothing in the archive. The plugin is `tests/c/hostile_plugin.c`.
#![cfg(target_os = "linux")]

use dragfree_tests::{archived, compile_plugin, dragfree, expect, fixture, json, simulate};
use std::collections::BTreeMap;
use std::io::{BufRead as _, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::sync::{Mutex, OnceLock};
use std::time::{Duration, Instant};
use tempfile::TempDir;

/// Phases in which the host calls a plugin that it has opened; `release` is that of an array.
const CALLS: [&str; 9] = ["create", "link", "activate", "process", "release", "flush", "report", "save", "destroy"];
/// Time that a plugin that hangs has, s.
const LIMIT_S: &str = "1";
/// Time in which every run must have ended.
const LONGEST: Duration = Duration::from_secs(60);

/// How a run must end.
#[derive(Clone, Copy, Debug, PartialEq)]
enum End {
    /// By exit code 1.
    Failure,
    /// By a signal: the last words name the plugin.
    Signal,
    /// Well: what the plugin did is told, and does no harm.
    Success,
}
use End::{Failure, Signal, Success};

/// A way to misbehave, a part of what must be said of it, and the end.
type Case = (String, &'static str, End);

/// What can be done in any call.
fn in_every_call() -> Vec<Case> {
    let mut cases = Vec::new();
    for call in CALLS {
        let ways = [
            ("exit", "ended the program", Failure),
            ("exit_at_once", "ended the program", Failure),
            ("quick_exit", "ended the program", Failure),
            ("exit_in_a_thread", "ended the program", Failure),
            ("hang", "did not come back within 1 s", Failure),
            ("segv", "crashed: SIGSEGV", Signal),
            ("segv_in_a_thread", "crashed: SIGSEGV", Signal),
            ("abort", "crashed: SIGABRT", Signal),
            ("trap", "crashed: SIG", Signal),
            ("rounding", "floating-point control word", if call == "destroy" { Success } else { Failure }),
        ];
        cases.extend(ways.map(|(way, said, end)| (format!("{call}_{way}"), said, end)));
    }
    for (way, said, end) in [
        ("process_spin", "did not come back within 1 s", Failure),
        ("process_stack", "crashed: SIGSEGV", Signal),
        ("process_flush_to_zero", "floating-point control word", Failure),
    ] {
        cases.push((way.to_owned(), said, end));
    }
    for call in ["create", "link", "activate", "process", "flush", "report", "save"] {
        for (way, said) in [
            ("error", "does not want to"),
            ("fatal", "does not want to"),
            ("silent", "failed without a word"),
            ("status", "status 99 does not exist"),
            ("negative_status", "does not exist"),
            ("endless_message", "mmmm"),
            ("binary_message", "\\u{1b}[2J"),
        ] {
            cases.push((format!("{call}_{way}"), said, Failure));
        }
    }
    cases
}

/// What a library can do where it is opened: it is refused, and the program goes on without it.
fn where_it_is_opened() -> Vec<Case> {
    let mut cases = Vec::new();
    for place in ["open", "manifest", "factory"] {
        for (way, said) in [
            ("exit", "ended the process"),
            ("exit_at_once", "ended the process"),
            ("quick_exit", "ended the process"),
            ("hang", "was not open after 1 s"),
            ("segv", "crashed: signal 11"),
            ("abort", "crashed: signal 6"),
            ("rounding", "floating-point control word"),
        ] {
            cases.push((format!("{place}_{way}"), said, Failure));
        }
    }
    for (way, said) in [
        ("manifest_null", "is null"),
        ("manifest_empty", "EOF"),
        ("manifest_no_json", "EOF"),
        ("manifest_array", "invalid"),
        ("manifest_deep", "manifest 0"),
        ("manifest_huge", "a text of more than"),
        ("manifest_empty_id", "has an empty id"),
        ("manifest_wrong_type", "invalid type"),
        ("factory_crowded", "4294967295 stages"),
        ("factory_empty", "holds no source, stage or effect"),
        ("factory_no_manifest", "without `manifest`"),
        ("factory_misaligned", "misaligned"),
    ] {
        cases.push((way.to_owned(), said, Failure));
    }
    cases
}

/// Rules of single calls.
fn of_single_calls() -> Vec<Case> {
    let table = "output table";
    let column = "output column";
    [
        ("manifest_no_utf8", "no stage `hostile`"),
        ("factory_no_create", "a factory without `create`"),
        ("create_null_path", "no path"),
        ("create_null_place", "no place"),
        ("create_null_context", "no context"),
        ("create_nothing", "without `link` or `destroy`"),
        ("create_no_link", "without `link` or `destroy`"),
        ("create_no_destroy", "without `link` or `destroy`"),
        ("create_no_process", "must have this function"),
        ("link_null_wanted", "no column"),
        ("link_null_slot", "gave no slot"),
        ("link_nameless", "a column without a name"),
        ("link_unknown", "is.tm1.r_orf_m.w"),
        ("link_unit", "`mm`"),
        ("link_frame", "`CRF`"),
        ("link_rate", "rate in Hz"),
        ("link_long_wanted", "a text of more than 256 bytes"),
        ("link_null_column", "no column"),
        ("link_no_table", "without a table or a name"),
        ("link_no_name", "without a table or a name"),
        ("link_long_name", "a text of more than 256 bytes"),
        ("link_long_unit", "a text of more than 256 bytes"),
        ("link_nan_rate", "at a rate of NaN"),
        ("link_infinite_rate", "at a rate of inf"),
        ("link_negative_rate", "at a rate of -1"),
        ("link_existing_table", "exists already"),
        ("link_existing_column", "exists already"),
        ("link_attributes", "attributes of column hostile.y"),
        ("link_deep_attributes", "attributes of column hostile.y"),
        ("link_huge_attributes", "a text of more than"),
        ("link_noise", "noise_processes"),
        ("link_coefficient", "is no effect"),
        ("link_constraint", "is no effect"),
        ("link_many", "more than 4096 columns"),
        ("link_twice", "exists already"),
        ("link_two_rates", "at 1 Hz"),
        ("process_huge_length", table),
        ("process_largest_length", table),
        ("process_negative_length", table),
        ("process_longer", column),
        ("process_offset", column),
        ("process_huge_offset", table),
        ("process_largest_offset", table),
        ("process_negative_offset", table),
        ("process_child_huge_offset", column),
        ("process_child_largest_offset", column),
        ("process_child_negative_offset", column),
        ("process_child_shorter", column),
        ("process_child_negative_length", column),
        ("process_child_nulls", column),
        ("process_child_text", column),
        ("process_child_no_buffers", column),
        ("process_child_no_values", column),
        ("process_child_dictionary", column),
        ("process_child_buffers_misaligned", column),
        ("process_child_missing", column),
        ("process_child_misaligned", column),
        ("process_children_none", table),
        ("process_children_misaligned", table),
        ("process_children_fewer", table),
        ("process_children_more", table),
        ("process_children_many", table),
        ("process_children_negative", table),
        ("process_buffers", table),
        ("process_nulls", table),
        ("process_dictionary", table),
        ("process_no_release", "without a release function"),
        ("process_backwards", "run backwards"),
        ("process_equal_times", "run backwards"),
        ("process_far_past", "run backwards"),
        ("flush_discard", "nothing to discard"),
        ("report_huge_length", "writes more than"),
        ("report_half_length", "writes more than"),
        ("report_from_nowhere", "bytes from nowhere"),
        ("report_endless", "writes more than"),
        ("report_no_json", "no JSON"),
        ("report_empty", "no JSON"),
        ("report_array", "must be a JSON object"),
        ("report_deep", "no JSON"),
        ("report_wrong_type", "key `nis`"),
        ("report_negative_count", "key `epochs_used`"),
        ("report_escape", "suffix"),
        ("report_overwrites", "exists already"),
        ("report_same_twice", "exists already"),
        ("save_huge_length", "writes more than"),
        ("save_endless", "writes more than"),
    ]
    .map(|(way, said)| (way.to_owned(), said, Failure))
    .into_iter()
    .chain([("link_log".to_owned(), "logged more than 1000 lines", Success)])
    .collect()
}

/// What a plugin that is not trusted must not reach.
const REACHES: [&str; 12] = [
    "process_reads",
    "process_lists",
    "process_writes",
    "process_connects",
    "process_speaks",
    "process_starts",
    "process_signals",
    "process_takes_memory",
    "process_raises_limits",
    "process_forks",
    "process_reaches_by_a_thread",
    "process_touches",
];

/// Where the plugin runs.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Place {
    /// In the program's own process.
    Here,
    /// In a process of its own, as the folder's `plugins.lock` asks.
    Apart,
}
use Place::{Apart, Here};

impl Place {
    fn folder(self) -> PathBuf {
        bench().dir.path().join(if self == Here { "plugins" } else { "apart" })
    }

    /// How a case must end there, from how it must end in the program's own process.
    fn case(self, (way, said, end): Case) -> Case {
        if self == Here {
            return (way, said, end);
        }
        let said = match said {
            "ended the program" => "ended the process",
            // 6 where Rust's handler knows the page below the stack, and aborts; 11 where it does not.
            "crashed: SIGSEGV" if way.ends_with("_stack") => "crashed: signal",
            "crashed: SIGSEGV" => "crashed: signal 11",
            "crashed: SIGABRT" => "crashed: signal 6",
            "crashed: SIG" => "crashed: signal",
            "was not open after 1 s" => "did not come back within 1 s",
            said => said,
        };
        // What it does at its end meets a product that is made.
        let end = if way.starts_with("destroy_") || end == Success { Success } else { Failure };
        (way, said, end)
    }
}

/// Six minutes of telemetry and the plugin, once.
struct Bench {
    dir: TempDir,
    telemetry: PathBuf,
}

fn bench() -> &'static Bench {
    static BENCH: OnceLock<Bench> = OnceLock::new();
    BENCH.get_or_init(|| {
        let dir = tempfile::tempdir().expect("a temporary folder");
        let telemetry = simulate(dir.path(), &["--hours", "0.1"]).remove(0);
        let plugins = dir.path().join("plugins");
        std::fs::create_dir(&plugins).expect("writable");
        let library = compile_plugin(&plugins, "hostile_plugin.c", "hostile", &[]);
        let apart = dir.path().join("apart");
        std::fs::create_dir(&apart).expect("writable");
        std::fs::copy(library, apart.join("libhostile.so")).expect("copied");
        std::fs::write(apart.join("plugins.lock"), "isolate = true\n").expect("writable");
        let mission = fixture("missions/taiji.toml").display().to_string();
        let text = format!(
            "[pipeline]\nname = \"test\"\nmission = '{mission}'\nmodel = 'model.toml'\n\
             [[stage]]\nplugin = \"preprocess\"\n[[stage]]\nplugin = \"hostile\"\n"
        );
        std::fs::write(dir.path().join("pipeline.toml"), text).expect("writable");
        std::fs::write(dir.path().join("model.toml"), "[model]\nrevision = \"0\"\n").expect("writable");
        Bench { dir, telemetry }
    })
}

fn run(way: &str, place: Place, folder: &Path) -> Command {
    let Bench { dir, telemetry } = bench();
    let mut command = dragfree(folder);
    command.arg("run").arg(dir.path().join("pipeline.toml")).arg(telemetry).args(["--archive", "archive", "--json"]);
    command.args(["--save-state", "state", "--plugin-dir"]).arg(place.folder());
    if way.ends_with("_hang") || way.ends_with("_spin") {
        command.args(["--plugin-time-limit", LIMIT_S]);
    }
    command.env("HOSTILE", way).env("LD_LIBRARY_PATH", way);
    command
}

/// What is wrong with how a way has ended; none where all is as it must be.
fn fault(way: &str, place: Place, said: &str, end: End) -> Option<String> {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let begun = Instant::now();
    let Output { status, stdout, stderr } = run(way, place, folder.path()).output().expect("the program runs");
    let (took, stderr) = (begun.elapsed(), String::from_utf8_lossy(&stderr).into_owned());
    let code = match end {
        Failure => Some(1),
        Signal => None,
        Success => Some(0),
    };
    let wrong = |what: String| Some(format!("{way}: {what}; stderr: {stderr}"));
    if status.code() != code {
        return wrong(format!("ended by {status}"));
    }
    if !stderr.contains(said) || !stderr.contains("hostile") {
        return wrong(format!("should name the plugin and say {said:?}"));
    }
    if stderr.contains('\u{1b}') || stderr.contains('\u{7}') {
        return wrong("lets the plugin speak to the terminal".to_owned());
    }
    if took > LONGEST {
        return wrong(format!("took {took:?}"));
    }
    let archive = folder.path().join("archive");
    if end == Success {
        return serde_json::from_slice::<serde_json::Value>(&stdout).err().and_then(|e| wrong(e.to_string()));
    }
    if !stdout.is_empty() {
        return wrong(format!("writes {} bytes to stdout", stdout.len()));
    }
    if folder.path().join("state").exists() {
        return wrong("left a state".to_owned());
    }
    if !archived(&archive).is_empty() {
        // What was killed is cleared by the next command.
        expect(dragfree(folder.path()).args(["products", "list", "--json"]), 0);
    }
    let left = archived(&archive);
    if left.is_empty() { None } else { wrong(format!("left {left:?}")) }
}

fn check_all(cases: Vec<Case>, place: Place) {
    let cases: Vec<Case> = cases.into_iter().map(|case| place.case(case)).collect();
    let count = cases.len();
    bench();
    let names: BTreeMap<&String, ()> = cases.iter().map(|(way, ..)| (way, ())).collect();
    assert_eq!(names.len(), count, "each way once");
    let (cases, faults) = (Mutex::new(cases), Mutex::new(Vec::new()));
    std::thread::scope(|scope| {
        for _ in 0..2 {
            scope.spawn(|| {
                loop {
                    let Some((way, said, end)) = cases.lock().expect("no panic").pop() else { break };
                    faults.lock().expect("no panic").extend(fault(&way, place, said, end));
                }
            });
        }
    });
    let faults = faults.into_inner().expect("no panic");
    assert!(faults.is_empty(), "{} of {count}:\n{}", faults.len(), faults.join("\n\n"));
}

/// The twin of every test here: the same plugin goes through where it keeps the rules.
#[test]
fn the_plugin_that_keeps_the_rules_goes_through() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let product = json(&mut run("nothing", Here, folder.path()), 0);
    assert_eq!(product["id"], "COM1B_2035-01-01_SC1_01_0001");
    assert!(folder.path().join("state").is_file());
}

/// Constructors that ended the program made it a success, and one that hung stopped every command.
#[test]
fn a_library_that_misbehaves_where_it_is_opened_is_refused() {
    check_all(where_it_is_opened(), Here);
}

#[test]
fn a_plugin_that_ends_crashes_or_hangs_in_a_call_is_named() {
    check_all(in_every_call(), Here);
}

#[test]
fn a_plugin_that_breaks_a_rule_of_a_call_is_named() {
    check_all(of_single_calls(), Here);
}

#[test]
fn a_hostile_plugin_in_a_process_of_its_own_stops_nobody() {
    check_all(where_it_is_opened().into_iter().chain(in_every_call()).chain(of_single_calls()).collect(), Apart);
}

/// In the program's own process it reaches all of it, in one of its own nothing, and the run goes on.
#[test]
fn a_process_of_its_own_reaches_no_file_connection_or_process() {
    for way in REACHES {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let output = run(way, Here, folder.path()).output().expect("the program runs");
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(output.status.code() == Some(1) && said.contains("reaches what it must not"), "{way}: {said}");
        let escaped = folder.path().join("escaped");
        assert_eq!(escaped.exists(), ["process_writes", "process_reaches_by_a_thread"].contains(&way));
        let _ = std::fs::remove_file(&escaped); // there or not
        json(&mut run(way, Apart, folder.path()), 0);
        assert!(!escaped.exists());
    }
}

/// Whoever waits for the plugin is gone: it must not stay for ever.
#[test]
fn a_process_of_its_own_ends_with_the_program() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let mut command = run("process_wait", Apart, folder.path());
    command.stdout(std::process::Stdio::null());
    let mut program = command.stderr(std::process::Stdio::piped()).spawn().expect("the program runs");
    // It hangs in a call: the end of the socket, which it would see between two calls, is not enough.
    let mut said = BufReader::new(program.stderr.take().expect("piped")).lines().map_while(Result::ok);
    assert!(said.any(|line| line.contains("it waits")), "the plugin was not called");
    // Of all its threads.
    let children_of = |pid: u32| -> Vec<String> {
        let tasks = std::fs::read_dir(format!("/proc/{pid}/task")).expect("a running program").flatten();
        let read = |task: std::fs::DirEntry| std::fs::read_to_string(task.path().join("children")).unwrap_or_default();
        tasks.flat_map(|task| read(task).split_whitespace().map(str::to_owned).collect::<Vec<_>>()).collect()
    };
    let begun = Instant::now();
    // One that has ended and that nobody has asked about has the state Z.
    let alive = |pid: &String| {
        let stat = std::fs::read_to_string(Path::new("/proc").join(pid).join("stat"));
        stat.is_ok_and(|stat| !stat.contains(") Z "))
    };
    let children = children_of(program.id());
    assert!(children.iter().any(&alive), "{children:?}");
    program.kill().expect("it runs");
    program.wait().expect("it ends");
    while children.iter().any(&alive) {
        assert!(begun.elapsed() < LONGEST, "{children:?} are still there");
        std::thread::sleep(Duration::from_millis(50));
    }
}

/// A run that its terminal stops for longer than the limit goes on afterwards.
#[test]
fn a_program_that_was_stopped_is_not_taken_for_one_that_hangs() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let mut command = run("nothing", Here, folder.path());
    command.args(["--plugin-time-limit", LIMIT_S]).stdout(std::process::Stdio::null());
    let mut child = command.spawn().expect("the program runs");
    let staging = folder.path().join("archive/staging");
    while !std::fs::read_dir(&staging).is_ok_and(|mut entries| entries.next().is_some()) {
        std::thread::sleep(Duration::from_millis(1));
    }
    let signal = |name: &str| expect(Command::new("kill").arg(name).arg(child.id().to_string()), 0);
    signal("-STOP");
    std::thread::sleep(Duration::from_millis(2500));
    signal("-CONT");
    assert!(child.wait().expect("it ends").success());
}

/// A library that nobody uses may not end or delay other commands.
#[test]
fn other_plugins_are_found_beside_a_hostile_library() {
    let plugins = bench().dir.path().join("plugins");
    for way in ["open_exit", "open_hang", "manifest_segv"] {
        let mut list = dragfree(bench().dir.path());
        list.args(["plugins", "list", "--json", "--plugin-time-limit", LIMIT_S, "--plugin-dir"]).arg(&plugins);
        let list = json(list.env("HOSTILE", way), 0);
        let found = list["plugins"].as_array().expect("plugins");
        assert!(found.iter().any(|p| p["id"] == "es-akf"), "{way}: {list:#}");
        assert!(list["refused"].to_string().contains("libhostile.so"), "{way}: {list:#}");
    }
}

/// The validator let these pass: a run cannot tell them, or tells them late.
#[test]
fn the_validator_finds_what_a_run_cannot() {
    let library = bench().dir.path().join("plugins/libhostile.so");
    for (way, said) in [("process_writes_inputs", "writes into the rows that it is given"), ("nothing", "")] {
        let mut validate = dragfree(bench().dir.path());
        validate.args(["plugins", "validate", "--json"]).arg(&library).env("HOSTILE", way);
        let output = validate.output().expect("the program runs");
        let text = String::from_utf8_lossy(&output.stdout);
        assert!(text.contains(said), "{way}: {text}");
        let writes = text.contains("writes into the rows");
        assert_eq!(writes, way != "nothing", "{way}: {text}");
    }
}

/// A locked library was hashed by its path and then opened by its path: 23 of 300 swaps in between loaded another.
#[test]
fn a_locked_library_is_the_one_that_was_hashed() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let library = compile_plugin(dir.path(), "hostile_plugin.c", "hostile", &[]);
    let mut list = dragfree(dir.path());
    list.args(["plugins", "list", "--json", "--plugin-dir"]).arg(dir.path());
    let before = json(&mut list, 0);
    let found = before["plugins"].as_array().expect("plugins");
    let sha256 = &found.iter().find(|p| p["id"] == "hostile").expect("it is listed")["sha256"];
    let sha256 = sha256.as_str().expect("a digest");
    let lock = format!("[sha256]\n\"libhostile.so\" = \"{sha256}\"\n");
    std::fs::write(dir.path().join("plugins.lock"), lock).expect("writable");
    // Another library under the same name, put there and back as fast as the file system can.
    let (sound, other) = (dir.path().join("sound"), dir.path().join("other"));
    std::fs::copy(&library, &sound).expect("copied");
    let unlocked = compile_plugin(dir.path(), "c_plugins.c", "c_plugins", &[]);
    std::fs::rename(unlocked, &other).expect("renamed");
    let done = std::sync::atomic::AtomicBool::new(false);
    std::thread::scope(|scope| {
        scope.spawn(|| {
            while !done.load(std::sync::atomic::Ordering::Relaxed) {
                for from in [&other, &sound] {
                    let beside = dir.path().join("beside");
                    let _ = std::fs::hard_link(from, &beside);
                    let _ = std::fs::rename(&beside, &library);
                }
            }
        });
        for _ in 0..60 {
            let list = json(&mut list, 0);
            assert!(!list.to_string().contains("c-scale"), "the unlocked library was opened: {list:#}");
        }
        done.store(true, std::sync::atomic::Ordering::Relaxed);
    });
}

#[test]
fn a_folder_that_everybody_may_change_is_refused() {
    use std::os::unix::fs::PermissionsExt as _;
    let dir = tempfile::tempdir().expect("a temporary folder");
    compile_plugin(dir.path(), "hostile_plugin.c", "hostile", &[]);
    std::fs::set_permissions(dir.path(), std::fs::Permissions::from_mode(0o777)).expect("chmod");
    let mut list = dragfree(bench().dir.path());
    let list = json(list.args(["plugins", "list", "--json", "--plugin-dir"]).arg(dir.path()), 0);
    assert!(list["refused"].to_string().contains("its folder"), "{list:#}");
}
