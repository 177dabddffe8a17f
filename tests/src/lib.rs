//! Shared by the whole-program tests: the built program, its plugins, the repository's fixtures.

pub mod browser;
pub mod calibration;
pub mod foreign;
pub mod recording;

use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::sync::{Mutex, OnceLock, PoisonError};

/// The repository.
#[must_use]
pub fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap_or(Path::new("."))
}

/// A file under `fixtures/`.
#[must_use]
pub fn fixture(path: &str) -> PathBuf {
    root().join("fixtures").join(path)
}

/// Folder of the program and its plugins, built once per test program so that no test uses a stale build.
///
/// # Panics
/// The workspace does not build.
pub fn built() -> &'static Path {
    static FOLDER: OnceLock<PathBuf> = OnceLock::new();
    FOLDER.get_or_init(|| {
        let exe = std::env::current_exe().expect("a test program has a path");
        let folder = exe.parent().and_then(Path::parent).expect("target/PROFILE/deps/test").to_owned();
        let cargo = std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into());
        let mut build = Command::new(cargo);
        build.current_dir(root()).args(["build", "--quiet", "--workspace", "--lib", "--bins", "--example", "clumsy"]);
        if folder.file_name().is_some_and(|name| name == "release") {
            build.arg("--release");
        }
        if let Some(target) = folder.parent() {
            build.arg("--target-dir").arg(target);
        }
        let status = build.status().expect("cargo runs");
        assert!(status.success(), "the workspace does not build");
        folder
    })
}

/// The program, restricted to the built plugins, with `folder` as its working directory.
#[must_use]
pub fn dragfree(folder: &Path) -> Command {
    let mut command = Command::new(built().join(format!("dragfree{}", std::env::consts::EXE_SUFFIX)));
    command.current_dir(folder).env_remove("DRAGFREE_PLUGIN_PATH").env("NO_COLOR", "1");
    command.env("XDG_CACHE_HOME", folder);
    command
}

/// Installs Debian `packages` where one of the `programs` is missing, one after the other: two at once are refused.
/// Gives what the script said.
///
/// # Panics
/// The script cannot be started.
#[must_use]
pub fn install(programs: &[&str], packages: &[&str]) -> Output {
    static ONE_AT_A_TIME: Mutex<()> = Mutex::new(());
    let _turn = ONE_AT_A_TIME.lock().unwrap_or_else(PoisonError::into_inner);
    let script = root().join("tests/install.sh");
    let output = Command::new(script).args(programs).arg("--").args(packages).output();
    output.expect("the script that installs what tests need")
}

/// Runs a command, asserts its exit code, and returns its output.
///
/// # Panics
/// The exit code differs.
pub fn expect(command: &mut Command, code: i32) -> Output {
    let output = command.output().unwrap_or_else(|e| panic!("{command:?}: {e}"));
    assert_eq!(
        output.status.code(),
        Some(code),
        "{command:?}\n--- stdout\n{}\n--- stderr\n{}",
        String::from_utf8_lossy(&output.stdout),
        String::from_utf8_lossy(&output.stderr)
    );
    output
}

/// Runs a command, asserts its exit code, and parses its output as JSON.
///
/// # Panics
/// The exit code differs, or the output is not JSON.
pub fn json(command: &mut Command, code: i32) -> serde_json::Value {
    let output = expect(command, code);
    serde_json::from_slice(&output.stdout)
        .unwrap_or_else(|e| panic!("{command:?}: {e}\n{}", String::from_utf8_lossy(&output.stdout)))
}

/// Compiles a plugin written in C into `folder` and returns its path.
///
/// # Panics
/// There is no C compiler, or the source does not compile without warnings.
pub fn compile_plugin(folder: &Path, source: &str, name: &str, defines: &[&str]) -> PathBuf {
    let library = folder.join(format!("{}{name}{}", std::env::consts::DLL_PREFIX, std::env::consts::DLL_SUFFIX));
    let compiler = std::env::var_os("CC").unwrap_or_else(|| "cc".into());
    let mut command = Command::new(compiler);
    command.args(["-std=c11", "-Wall", "-Wextra", "-Werror", "-shared", "-fPIC", "-fvisibility=hidden"]);
    command.args(defines).arg("-I").arg(root().join("core/abi/include"));
    command.arg(root().join("tests/c").join(source)).arg("-o").arg(&library).arg("-lm");
    expect(&mut command, 0);
    library
}

/// What an archive holds: names of products and of what lies beside them, contents, leftovers of writers. The files
/// that an empty archive has are left out.
pub fn archived(archive: &Path) -> Vec<String> {
    let names = |folder: &Path| -> Vec<String> {
        let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
        entries.map(|e| e.file_name().to_string_lossy().into_owned()).collect()
    };
    let own = ["objects", "journal", "staging", "catalogue.sqlite"];
    let mut all: Vec<String> = names(archive).into_iter().filter(|name| !own.contains(&name.as_str())).collect();
    for folder in ["objects", "staging"] {
        all.extend(names(&archive.join(folder)).into_iter().map(|name| format!("{folder}/{name}")));
    }
    let is_event = |name: &String| name.starts_with(|c: char| c.is_ascii_digit());
    all.extend(names(&archive.join("journal")).into_iter().filter(is_event));
    all.sort();
    all
}

/// Simulated telemetry of the bundled mission: the files in `folder`, oldest first.
///
/// # Panics
/// The simulation fails.
#[must_use]
pub fn simulate(folder: &Path, arguments: &[&str]) -> Vec<PathBuf> {
    let mut command = dragfree(folder);
    command.arg("simulate").arg(fixture("missions/taiji.toml")).arg("--out").arg(folder).args(arguments);
    expect(&mut command, 0);
    let mut files: Vec<PathBuf> = std::fs::read_dir(folder)
        .expect("the folder was made")
        .flatten()
        .map(|entry| entry.path())
        .filter(|path| path.extension().is_some_and(|e| e == "mcap"))
        .collect();
    files.sort();
    assert!(!files.is_empty(), "a simulation writes telemetry");
    files
}

/// A coefficient of a product's JSON: value and σ.
///
/// # Panics
/// The product has no such coefficient.
#[must_use]
pub fn coefficient(product: &serde_json::Value, name: &str, solution: &str) -> (f64, f64) {
    let all = product["coefficients"].as_array().expect("coefficients");
    let one = all.iter().find(|c| c["name"] == name && c["solution"] == solution);
    let one = one.unwrap_or_else(|| panic!("no {name} by {solution} in {all:?}"));
    (one["value"].as_f64().unwrap_or(f64::NAN), one["sigma"].as_f64().unwrap_or(f64::NAN))
}

/// Copies the SDK's example plugin `clumsy` into `folder`. Its own folder may hold earlier builds too.
///
/// # Panics
/// The example was not built.
pub fn example_plugin(folder: &Path) {
    let library = format!("{}clumsy{}", std::env::consts::DLL_PREFIX, std::env::consts::DLL_SUFFIX);
    std::fs::copy(built().join("examples").join(&library), folder.join(&library)).expect("the example is built");
}
