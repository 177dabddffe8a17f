//! Plugins built outside the workspace: a stage and an effect in C, and plugins that misbehave.

use dragfree_tests::{coefficient, compile_plugin, dragfree, example_plugin, expect, fixture, json, simulate};
use std::path::{Path, PathBuf};
use std::sync::OnceLock;
use tempfile::TempDir;

/// Half an hour of telemetry, simulated once.
fn telemetry() -> &'static Path {
    static FILE: OnceLock<(TempDir, PathBuf)> = OnceLock::new();
    let (_, file) = FILE.get_or_init(|| {
        let dir = tempfile::tempdir().expect("a temporary folder");
        let file = simulate(dir.path(), &["--hours", "0.5", "--seed", "11"]).remove(0);
        (dir, file)
    });
    file
}

/// A pipeline of `preprocess` and one more stage.
fn pipeline(folder: &Path, stage: &str) -> PathBuf {
    let path = folder.join("pipeline.toml");
    let text = format!(
        "[pipeline]\nname = \"test\"\nmission = '{}'\nmodel = 'model.toml'\n[[stage]]\nplugin = \"preprocess\"\n[[stage]]\n{stage}\n",
        fixture("missions/taiji.toml").display()
    );
    std::fs::write(&path, text).expect("writable");
    std::fs::write(folder.join("model.toml"), "[model]\nrevision = \"0\"\n").expect("writable");
    path
}

fn run(folder: &Path, pipeline: &Path) -> std::process::Command {
    let mut command = dragfree(folder);
    command
        .arg("run")
        .arg(pipeline)
        .arg(telemetry())
        .args(["--archive", "archive", "--json", "--plugin-dir"])
        .arg(folder);
    command.arg("--plugin-dir").arg(dragfree_tests::built());
    command
}

#[test]
fn a_stage_in_c_runs_in_a_pipeline() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    compile_plugin(dir.path(), "c_plugins.c", "c_plugins", &[]);
    let pipeline = pipeline(dir.path(), "plugin = \"c-scale\"\nparameters = { factor = 3.0 }");
    let product = json(&mut run(dir.path(), &pipeline), 0);
    assert_eq!(product["quality"]["counts"]["c-scale"]["rows"], 18_000, "{product}");
}

/// The QP estimates the coefficient of an effect in C beside the offsets. The flown gain is right, so the estimate lies
/// within 5σ of zero (false alarm 6e-7), with σ below the prior's.
#[test]
fn an_effect_in_c_is_estimated() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    compile_plugin(dir.path(), "c_plugins.c", "c_plugins", &[]);
    let model = dir.path().join("gain.toml");
    let effects = [("com-offset", "tm1"), ("com-offset", "tm2"), ("c-es-gain", "tm1")];
    let entries: String =
        effects.iter().map(|(id, i)| format!("[[effect]]\nid = \"{id}\"\ninstance = \"{i}\"\n")).collect();
    std::fs::write(&model, format!("[model]\nrevision = \"2\"\nparent = \"1\"\n{entries}")).expect("writable");
    let mut command = run(dir.path(), &fixture("pipelines/science-mode.toml"));
    let output = command.arg("--model").arg(&model).output().expect("the program runs");
    assert!(matches!(output.status.code(), Some(0 | 4)), "{}", String::from_utf8_lossy(&output.stderr));
    let product: serde_json::Value = serde_json::from_slice(&output.stdout).expect("JSON");
    let (value, sigma) = coefficient(&product, "c-es-gain.tm1.y", "qp");
    assert!(sigma > 0.0 && sigma.is_finite() && value.abs() < 5.0 * sigma, "{value} ± {sigma}");
    assert_eq!(product["model"]["effects"], serde_json::json!(["com-offset", "c-es-gain"]));
}

/// Compiles and runs a plugin that misbehaves in one way; returns exit code and message.
fn misbehaving(way: u32) -> (Option<i32>, String) {
    let dir = tempfile::tempdir().expect("a temporary folder");
    compile_plugin(dir.path(), "bad_plugins.c", "bad", &[&format!("-DBAD={way}")]);
    let pipeline = pipeline(dir.path(), "plugin = \"bad\"");
    // One plugin runs at a time, so that it alone is named.
    let output = run(dir.path(), &pipeline).args(["--threads", "1"]).output().expect("the program runs");
    let left = dragfree_tests::archived(&dir.path().join("archive"));
    assert!(output.status.code() != Some(1) || left.is_empty(), "a failed run leaves nothing: {left:?}");
    (output.status.code(), String::from_utf8_lossy(&output.stderr).into_owned())
}

#[test]
fn every_misbehaviour_is_reported_without_a_crash() {
    for (way, said) in [
        (1, "ABI version 2"),
        (2, "the third batch is too much"),
        (4, "is.tm1.r_orf_m.w"),
        (5, "`mm`"),
        (6, "floating-point control word"),
        (7, "rows where the table has"),
        (8, "never comes to life"),
        (9, "manifest 0"),
        (10, "the third batch is fatal"),
        (12, "plugin bad: report: broke the rules of plugin.h: key `nis`: invalid type: string \"good\""),
        (13, "declares that the noise process `shot:bad` enters `bad.y`, which is no channel"),
    ] {
        let (code, stderr) = misbehaving(way);
        assert_eq!(code, Some(1), "way {way}: {stderr}");
        assert!(stderr.contains(said), "way {way} should say {said}: {stderr}");
    }
}

/// A Rust plugin that panics at each call: the host reports it and leaves nothing in the archive.
#[test]
fn a_panic_does_not_cross_the_plugin_interface() {
    for place in ["new", "link", "process", "flush", "report"] {
        let dir = tempfile::tempdir().expect("a temporary folder");
        let pipeline = pipeline(dir.path(), &format!("plugin = \"clumsy\"\nparameters = {{ panic_in = \"{place}\" }}"));
        example_plugin(dir.path());
        let output = expect(&mut run(dir.path(), &pipeline), 1);
        let stderr = String::from_utf8_lossy(&output.stderr);
        assert!(stderr.contains(&format!("clumsy in {place}")) && stderr.contains("panicked"), "{stderr}");
        assert!(!stderr.contains("RUST_BACKTRACE"), "the panic is told by the host alone: {stderr}");
    }
}

#[test]
fn a_plugin_without_a_panic_goes_through() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let pipeline = pipeline(dir.path(), "plugin = \"clumsy\"");
    example_plugin(dir.path());
    let product = json(&mut run(dir.path(), &pipeline), 0);
    assert_eq!(product["quality"]["counts"]["clumsy"]["rows"], 18_000, "{product}");
}

/// An unknown key or NaN in the report of an early stage must not fail a later stage.
#[test]
fn an_unexpected_report_of_a_stage_does_not_fail_later_ones() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    compile_plugin(dir.path(), "bad_plugins.c", "bad", &["-DBAD=11"]);
    example_plugin(dir.path());
    let pipeline = pipeline(dir.path(), "plugin = \"bad\"\n[[stage]]\nplugin = \"clumsy\"");
    let product = json(&mut run(dir.path(), &pipeline), 0);
    let notes = product["quality"]["notes"].as_array().expect("notes");
    for note in [
        "bad: wrote NaN or infinity, which JSON does not have; read as null",
        "bad: unknown key \"shade\" left out",
        "bad: 1 entries of the covariance of \"mine\" are no numbers",
    ] {
        assert!(notes.iter().any(|n| n == note), "{note} among {notes:?}");
    }
    assert_eq!(product["quality"]["counts"]["clumsy"]["reports"], 2, "preprocess and bad, {product}");
}

/// What a plugin prints goes to stderr, through its own library or the descriptor; stdout holds the product alone.
#[test]
fn what_a_plugin_prints_is_no_result() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    compile_plugin(dir.path(), "bad_plugins.c", "bad", &["-DBAD=21"]);
    let pipeline = pipeline(dir.path(), "plugin = \"bad\"");
    let output = expect(&mut run(dir.path(), &pipeline), 0);
    let product: serde_json::Value = serde_json::from_slice(&output.stdout).expect("stdout is one JSON value");
    assert_eq!(product["id"], "COM1B_2035-01-01_SC1_01_0001");
    let stderr = String::from_utf8_lossy(&output.stderr);
    for said in ["a plugin prints to stdout", "a plugin writes to descriptor 1"] {
        assert!(stderr.contains(said), "{said}: {stderr}");
    }
}

/// A crash ends the program by its signal, and the last words name the plugin.
#[cfg(unix)]
#[test]
fn a_crash_names_the_plugin() {
    for (way, said) in [
        (22, "plugin bad: process: crashed: SIGSEGV"),
        (23, "plugin bad: process: crashed: SIGABRT"),
        (24, "while these plugins ran: bad: crashed: SIGABRT"),
    ] {
        let (code, stderr) = misbehaving(way);
        assert_eq!(code, None, "way {way}: {stderr}");
        assert!(stderr.contains(said), "way {way} should say {said}: {stderr}");
    }
}

#[test]
fn a_plugin_that_hangs_is_stopped_by_the_validator() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let library = compile_plugin(dir.path(), "bad_plugins.c", "bad", &["-DBAD=25"]);
    let begun = std::time::Instant::now();
    let mut command = dragfree(dir.path());
    let result = json(command.args(["plugins", "validate", "--json", "--time-limit", "1.5"]).arg(&library), 1);
    assert!(begun.elapsed().as_secs_f64() < 30.0, "one check was waited for, and not its default of a minute");
    let checks = result["plugins"][0]["checks"].as_array().expect("checks");
    let last = checks.last().expect("a check");
    assert_eq!((checks.len(), &last["check"], &last["passed"]), (2, &"create".into(), &false.into()), "{result:#}");
    assert!(last["detail"].as_str().is_some_and(|detail| detail.contains("after 1.5 s")), "{last}");
}

/// Two files of one id: the error names both, wherever the plugin is needed.
#[test]
fn one_id_in_two_libraries_is_an_error() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    compile_plugin(dir.path(), "bad_plugins.c", "bad", &["-DBAD=21"]);
    compile_plugin(dir.path(), "bad_plugins.c", "worse", &["-DBAD=2"]);
    let pipeline = pipeline(dir.path(), "plugin = \"bad\"");
    let told = expect(&mut run(dir.path(), &pipeline), 1);
    let told = String::from_utf8_lossy(&told.stderr).into_owned();
    let list = json(dragfree(dir.path()).args(["plugins", "list", "--json", "--plugin-dir"]).arg(dir.path()), 1);
    for text in [told, list["error"].to_string()] {
        assert!(text.contains("libbad.so") && text.contains("libworse.so"), "{text}");
    }
}

#[test]
fn a_message_names_its_plugin_once() {
    let (code, stderr) = misbehaving(26);
    assert_eq!(code, Some(1));
    assert!(stderr.contains("plugin bad: process: told twice"), "{stderr}");
}

#[test]
fn a_discarded_batch_is_counted_as_lost() {
    let (code, stderr) = misbehaving(3);
    assert_eq!(code, Some(3), "{stderr}");
}

#[test]
fn a_file_that_is_not_a_plugin_is_listed_with_the_reason() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let library = dir.path().join(format!("libnothing{}", std::env::consts::DLL_SUFFIX));
    std::fs::write(&library, "this is no library").expect("writable");
    let mut command = dragfree(dir.path());
    let list = json(command.args(["plugins", "list", "--json", "--plugin-dir"]).arg(dir.path()), 0);
    assert!(list.to_string().contains("libnothing"), "{list}");
    assert!(list.to_string().contains("no shared library"), "{list}");
}

#[cfg(unix)]
#[test]
fn a_world_writable_plugin_is_refused() {
    use std::os::unix::fs::PermissionsExt;
    let dir = tempfile::tempdir().expect("a temporary folder");
    let library = compile_plugin(dir.path(), "c_plugins.c", "c_plugins", &[]);
    std::fs::set_permissions(&library, std::fs::Permissions::from_mode(0o777)).expect("chmod");
    let pipeline = pipeline(dir.path(), "plugin = \"c-scale\"");
    let output = expect(&mut run(dir.path(), &pipeline), 1);
    assert!(String::from_utf8_lossy(&output.stderr).contains("c-scale"));
    let list = json(dragfree(dir.path()).args(["plugins", "list", "--json", "--plugin-dir"]).arg(dir.path()), 0);
    assert!(list.to_string().contains("chmod o-w"), "{list}");
}

#[test]
fn a_locked_folder_loads_only_what_is_locked() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    compile_plugin(dir.path(), "c_plugins.c", "c_plugins", &[]);
    std::fs::write(dir.path().join("plugins.lock"), "[sha256]\n\"libother.so\" = \"00\"\n").expect("writable");
    let list = json(dragfree(dir.path()).args(["plugins", "list", "--json", "--plugin-dir"]).arg(dir.path()), 0);
    assert!(list.to_string().contains("not listed in"), "{list}");
}

/// A list takes the digest of a library from the list before while the library looks the same, unless somebody else may
/// have written that; other commands hash what they open.
#[cfg(unix)]
#[test]
fn a_list_hashes_a_library_once_and_another_command_each_time() {
    use std::os::unix::fs::PermissionsExt;
    let dir = tempfile::tempdir().expect("a temporary folder");
    let dir = dir.path();
    let library = compile_plugin(dir, "c_plugins.c", "c_plugins", &[]);
    std::thread::sleep(std::time::Duration::from_millis(1200)); // what is written within a second may change unseen
    let digest = || {
        let list = json(dragfree(dir).args(["plugins", "list", "--json", "--plugin-dir"]).arg(dir), 0);
        let plugins = list["plugins"].as_array().expect("plugins").clone();
        let own = plugins.iter().find(|p| p["id"] == "c-scale").expect("c-scale").clone();
        own["sha256"].as_str().expect("a digest").to_owned()
    };
    let sha256 = || {
        let inspected = ["plugins", "inspect", "c-scale", "--json", "--plugin-dir"];
        json(dragfree(dir).args(inspected).arg(dir), 0)["sha256"].as_str().expect("a digest").to_owned()
    };
    let file = dir.join("dragfree/libraries.json");
    let first = sha256();
    assert_eq!(digest(), first);
    let wrong = "0".repeat(64);
    let text = std::fs::read_to_string(&file).expect("digests are kept").replace(&first, &wrong);
    let put = |mode: u32| {
        std::fs::write(&file, &text).expect("written");
        std::fs::set_permissions(&file, std::fs::Permissions::from_mode(mode)).expect("chmod");
    };
    put(0o600);
    assert_eq!(digest(), wrong, "it was not read again");
    assert_ne!(sha256(), wrong, "only a list believes it");
    put(0o622);
    assert_eq!(digest(), sha256(), "others may have written it");
    put(0o600);
    let mut bytes = std::fs::read(&library).expect("readable");
    bytes.push(0);
    std::fs::write(&library, bytes).expect("written");
    assert_ne!(sha256(), first);
    assert_eq!(digest(), sha256(), "the library has changed");
}

/// With a key a folder loads only what a lock names that was signed with it; unsigned, signed by another, changed since
/// it was signed, without digests, and without a lock nothing of the folder is opened. The key may stand in a file, in
/// its text, or in the environment.
#[test]
fn with_a_key_a_folder_loads_only_what_its_owner_has_signed() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let dir = dir.path();
    let library = compile_plugin(dir, "c_plugins.c", "c_plugins", &[]);
    let keys = minisign::KeyPair::generate_unencrypted_keypair().expect("keys");
    let others = minisign::KeyPair::generate_unencrypted_keypair().expect("keys");
    let key = dir.join("mission.pub");
    std::fs::write(&key, keys.pk.to_box().expect("a box").into_string()).expect("written");
    let (lock, signature) = (dir.join("plugins.lock"), dir.join("plugins.lock.minisig"));
    let sign = |keys: &minisign::KeyPair, text: &str| {
        std::fs::write(&lock, text).expect("written");
        let signed = minisign::sign(Some(&keys.pk), &keys.sk, text.as_bytes(), None, None).expect("signed");
        std::fs::write(&signature, signed.into_string()).expect("written");
    };
    let listed = |command: &mut std::process::Command| {
        json(command.args(["plugins", "list", "--json", "--plugin-dir"]).arg(dir), 0)
    };
    let with = |key: &str| listed(dragfree(dir).args(["--plugin-key", key]));
    let by_file = || with(&key.display().to_string());
    let found = |list: &serde_json::Value| list["plugins"].to_string().contains("\"c-scale\"");
    let refused = |why: &str| {
        let list = by_file();
        assert!(!found(&list) && list["refused"].to_string().contains(why), "{why}: {list:#}");
    };
    refused("plugins.lock cannot be read");
    let all = listed(&mut dragfree(dir))["plugins"].take();
    let own = all.as_array().expect("plugins").iter().find(|p| p["id"] == "c-scale").expect("it is listed");
    let sha256 = own["sha256"].as_str().expect("a digest");
    let name = library.file_name().expect("a name").to_string_lossy().into_owned();
    let text = format!("[sha256]\n{name:?} = \"{sha256}\"\n");
    std::fs::write(&lock, &text).expect("written");
    refused("plugins.lock.minisig cannot be read");
    sign(&others, &text);
    refused("is not signed with the key that was given");
    sign(&keys, "isolate = true\n");
    refused("has no [sha256]");
    sign(&keys, &text);
    std::fs::write(&lock, format!("{text}\"libother.so\" = \"00\"\n")).expect("written");
    refused("is not signed with the key that was given");
    std::fs::write(&lock, &text).expect("written");
    assert!(found(&by_file()) && found(&with(&keys.pk.to_base64())));
    let by = by_file()["plugins"][0]["vouched_by"].take();
    assert_eq!(by, format!("plugins.lock, signed with {}", keys.pk.to_base64()));
    assert!(own["vouched_by"].is_null(), "{own:#}");
    let of_environment = listed(dragfree(dir).env("DRAGFREE_PLUGIN_KEY", &key));
    assert!(found(&of_environment));
    // What the program brings along is in a folder without a signed lock.
    assert!(!of_environment["plugins"].to_string().contains("\"es-akf\""), "{of_environment:#}");
    let output = expect(dragfree(dir).args(["plugins", "list", "--plugin-key", "nothing"]), 1);
    assert!(String::from_utf8_lossy(&output.stderr).contains("is no public key of minisign"), "{output:?}");
}

/// What a run of a day's chain leaves: series, sums and the state for tomorrow. `isolate` stands in every stage and
/// effect.
#[cfg(target_os = "linux")]
fn science_mode(isolate: bool, folder: &Path) -> Vec<Vec<u8>> {
    let isolated = |text: String, key: &str| {
        let lines = text.lines().map(|line| match line.starts_with(key) && isolate {
            true => format!("{line}\nisolate = true\n"),
            false => format!("{line}\n"),
        });
        lines.collect::<String>()
    };
    let read = |path: &str| std::fs::read_to_string(fixture(path)).expect("a fixture");
    let (pipeline, model) = (folder.join("pipeline.toml"), folder.join("model.toml"));
    let text = read("pipelines/science-mode.toml").replace("../models/com-offset.toml", "model.toml");
    let text = text.replace("../missions/taiji.toml", &fixture("missions/taiji.toml").display().to_string());
    std::fs::write(&pipeline, isolated(text, "plugin = ")).expect("writable");
    std::fs::write(&model, isolated(read("models/com-offset.toml"), "id = ")).expect("writable");
    let mut command = dragfree(folder);
    command.arg("run").arg(&pipeline).arg(telemetry()).args(["--archive", "archive", "--save-state", "state", "-v"]);
    let output = command.arg("--json").output().expect("the program runs");
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{said}");
    let product: serde_json::Value = serde_json::from_slice(&output.stdout).expect("JSON");
    let id = product["id"].as_str().expect("an id");
    let files = [".mcap", ".neq.json"].map(|end| folder.join("archive").join(format!("{id}{end}")));
    files.iter().chain([&folder.join("state")]).map(|path| std::fs::read(path).expect("written")).collect()
}

#[cfg(target_os = "linux")]
#[test]
fn a_run_in_processes_of_their_own_is_the_same_to_the_last_bit() {
    let [here, apart] = [false, true].map(|isolate| {
        let folder = tempfile::tempdir().expect("a temporary folder");
        science_mode(isolate, folder.path())
    });
    let same: Vec<bool> = here.iter().zip(&apart).map(|(a, b)| a == b).collect();
    assert_eq!(same, [true; 3], "series, sums, state");
}
