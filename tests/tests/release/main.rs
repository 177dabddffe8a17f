//! The release archive, unpacked into an empty folder and used without this repository: no file of it is on a path that
//! is given, the environment is cleared and HOME is new.
#![cfg(target_os = "linux")]

mod story;

use dragfree_tests::{built, expect, json, root};
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::OnceLock;

/// An unpacked release and a user's empty folder.
struct Release {
    _dir: tempfile::TempDir,
    top: PathBuf,
    home: PathBuf,
    package: PathBuf,
}

/// Release archive and package, made once.
fn made() -> &'static [PathBuf; 2] {
    static MADE: OnceLock<(tempfile::TempDir, [PathBuf; 2])> = OnceLock::new();
    let (_, files) = MADE.get_or_init(|| {
        let dir = tempfile::tempdir().expect("a temporary folder");
        let made = expect(Command::new(built().join("xtask")).args(["dist", "--out"]).arg(dir.path().join("out")), 0);
        let made = String::from_utf8(made.stdout).expect("paths");
        let files: Vec<PathBuf> = made.lines().map(PathBuf::from).collect();
        (dir, files.try_into().expect("an archive and a package"))
    });
    files
}

impl Release {
    fn new() -> Self {
        let dir = tempfile::tempdir().expect("a temporary folder");
        let [archive, package] = made();
        let name = archive.file_name().and_then(|name| name.to_str()).expect("a name");
        let name = name.strip_suffix(".tar.zst").expect("an archive");
        let expected = format!("dragfree-{}-{}-linux", env!("CARGO_PKG_VERSION"), std::env::consts::ARCH);
        assert_eq!(name, expected);
        let place = dir.path().join("some where");
        std::fs::create_dir(&place).expect("writable");
        let file = std::fs::File::open(archive).expect("readable");
        tar::Archive::new(zstd::Decoder::new(file).expect("zstd")).unpack(&place).expect("a sound archive");
        let tops: Vec<_> = std::fs::read_dir(&place).expect("a folder").flatten().map(|e| e.file_name()).collect();
        assert_eq!(tops, [name], "one top folder");
        let home = dir.path().join("home");
        std::fs::create_dir(&home).expect("writable");
        Self { top: place.join(name), home, package: package.clone(), _dir: dir }
    }

    /// A command in the user's folder, with the archive's `bin` on the path and nothing of ours in the environment.
    fn command(&self, program: &str) -> Command {
        let mut command = Command::new(program);
        let path =
            std::env::join_paths([&self.top.join("bin"), Path::new("/usr/bin"), Path::new("/bin")]).expect("a path");
        command.env_clear().env("HOME", &self.home).env("PATH", path).current_dir(&self.home);
        command
    }

    fn dragfree(&self, arguments: &[&str]) -> Command {
        let mut command = self.command(self.top.join("bin/dragfree").to_str().expect("text"));
        command.args(arguments);
        command
    }
}

#[test]
fn a_release_works_wherever_it_is_unpacked() {
    let release = Release::new();
    let run = |arguments: &[&str]| expect(&mut release.dragfree(arguments), 0);

    // Everything comes from the archive.
    let list = json(&mut release.dragfree(&["plugins", "list", "--json"]), 0);
    let plugins = list["plugins"].as_array().expect("plugins");
    assert!(plugins.len() > 20 && list["refused"].as_array().is_some_and(Vec::is_empty), "{list:#}");
    let lib = release.top.join("lib/dragfree");
    assert!(plugins.iter().all(|p| p["path"].as_str().is_some_and(|path| Path::new(path).parent() == Some(&lib))));

    // Missions, pipelines and models by name.
    run(&["simulate", "taiji", "--out", "telemetry", "--hours", "0.5"]);
    run(&["config", "check", "science-mode", "telemetry/SC1_2035-01-01.mcap", "--model", "com-offset"]);
    let calibrate = ["run", "science-mode", "telemetry/SC1_2035-01-01.mcap", "--mission", "taiji", "--json"];
    let product = json(&mut release.dragfree(&calibrate), 0);
    assert_eq!(product["id"], "COM1B_2035-01-01_SC1_01_0001");
    let told = expect(&mut release.dragfree(&["simulate", "tajii", "--out", "t"]), 1);
    assert!(String::from_utf8_lossy(&told.stderr).contains("taiji"), "{told:?}");

    // A new mission of one's own, every file of it used.
    run(&["init", "mine"]);
    run(&["simulate", "mine/mission.toml", "--out", "mine/telemetry", "--hours", "0.5"]);
    let sources =
        ["run", "mine/pipeline.toml", "mine/telemetry/SC1_2035-01-01.mcap", "--archive", "mine/archive", "--json"];
    let product = json(&mut release.dragfree(&sources), 0);
    let inputs = product["inputs"].as_array().expect("inputs");
    for file in ["mine/mission.toml", "mine/model.toml", "mine/pipeline.toml"] {
        let name = Path::new(file).file_name().expect("a name").to_string_lossy();
        let input = inputs.iter().find(|input| input["name"] == *name).expect(file);
        let used = std::fs::metadata(release.home.join(file)).expect("a file").len();
        assert_eq!(input["size"].as_u64(), Some(used), "{file}");
        let text = std::fs::read_to_string(release.home.join(file)).expect("a file");
        assert!(text.starts_with('#') && !text.contains("../"), "{text}");
    }
    let taken = expect(&mut release.dragfree(&["init", "mine"]), 1);
    assert!(String::from_utf8_lossy(&taken.stderr).contains("is there already"));

    // A plugin in C without any cache of cargo's.
    run(&["plugins", "new", "my-force", "--kind", "effect", "--lang", "c"]);
    expect(release.command("make").args(["-C", "my-force"]), 0);
    run(&["plugins", "validate", "my-force/libmy_force.so"]);

    // A plugin in Rust against the SDK of the archive; cargo takes the crates that it has downloaded before.
    run(&["plugins", "new", "my-stage", "--kind", "stage"]);
    let manifest = std::fs::read_to_string(release.home.join("my-stage/Cargo.toml")).expect("a manifest");
    let sdk = release.top.join("share/dragfree/sdk/core/sdk");
    assert!(manifest.contains(sdk.to_str().expect("text")), "{manifest}");
    let target = built().parent().expect("a target folder").join("skeletons");
    let cargo = std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into());
    let mut build = release.command(cargo.to_str().expect("text"));
    // A toolchain belongs to the machine: where it is and which is meant stay as they are.
    let real_home = PathBuf::from(std::env::var_os("HOME").expect("a home"));
    build.env("CARGO_HOME", real_home.join(".cargo")).env("RUSTUP_HOME", real_home.join(".rustup"));
    let of_tools = |name: &str| name == "PATH" || name == "CARGO_HOME" || name.starts_with("RUSTUP_");
    build.envs(std::env::vars_os().filter(|(name, _)| name.to_str().is_some_and(of_tools)));
    build.current_dir(release.home.join("my-stage")).args([
        "build",
        "--quiet",
        "--release",
        "--offline",
        "--target-dir",
    ]);
    expect(build.arg(&target), 0);
    let library = target.join("release/libmy_stage.so");
    expect(release.dragfree(&["plugins", "validate"]).arg(&library), 0);

    // Help for shells and `man`.
    let completions = run(&["completions", "bash"]).stdout;
    let installed = std::fs::read(release.top.join("share/bash-completion/completions/dragfree")).expect("installed");
    assert!(completions == installed && String::from_utf8_lossy(&completions).contains("--plugin-dir"));
    let page = std::fs::read_to_string(release.top.join("share/man/man1/dragfree-model-add.1")).expect("a man page");
    assert!(page.contains(".TH dragfree-model-add") && page.contains("prior\\-sigma"), "{page}");

    package_holds(&release);
    let binary = std::fs::read(release.top.join("share/dragfree/sdk/Cargo.toml")).expect("a manifest");
    assert!(!String::from_utf8_lossy(&binary).contains(root().to_str().expect("text")), "no path of this machine");
}

/// What cargo itself says is linked into program and plugins stands in the bill of materials, with its licence, and
/// what comes from elsewhere with its checksum; what only tests need does not.
#[test]
fn the_bill_of_materials_names_every_crate() {
    let release = Release::new();
    let path = release.top.join("share/doc/dragfree/sbom.cdx.json");
    let bill: serde_json::Value =
        serde_json::from_slice(&std::fs::read(path).expect("a bill")).expect("a JSON document");
    assert_eq!((&bill["bomFormat"], &bill["specVersion"]), (&"CycloneDX".into(), &"1.5".into()));
    let components = bill["components"].as_array().expect("components");
    let text = |c: &serde_json::Value, key: &str| c[key].as_str().unwrap_or_else(|| panic!("{key} of {c}")).to_owned();
    let named: BTreeSet<String> =
        components.iter().map(|c| format!("{} v{}", text(c, "name"), text(c, "version"))).collect();
    for c in components {
        assert!(c["licenses"][0]["expression"].is_string(), "{c}");
        let sha256 = c["hashes"][0]["content"].as_str().map_or(0, str::len);
        let ours = text(c, "name").starts_with("dragfree");
        assert_eq!(sha256, if ours { 0 } else { 64 }, "{c}");
        assert_eq!(text(c, "purl"), text(c, "bom-ref"));
    }
    let cargo = std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into());
    let mut tree = Command::new(cargo);
    tree.current_dir(root()).args(["tree", "--offline", "--locked", "--edges", "normal", "--prefix", "none"]);
    let packages = ["dragfree", "dragfree-effects", "dragfree-sim", "dragfree-hinf-dfacs"];
    tree.args(packages.iter().flat_map(|name| ["--package", name]));
    let linked = String::from_utf8(expect(&mut tree, 0).stdout).expect("names");
    let linked: BTreeSet<String> =
        linked.lines().filter(|l| !l.is_empty()).map(|l| l.split(' ').take(2).collect::<Vec<_>>().join(" ")).collect();
    assert!(linked.len() > 100, "{linked:?}");
    let missing: Vec<&String> = linked.iter().filter(|name| !named.contains(*name)).collect();
    assert!(missing.is_empty(), "{missing:?}");
    assert!(!named.iter().any(|name| name.starts_with("proptest ") || name.starts_with("criterion ")), "{named:?}");
}

/// The package is an `ar` archive of three members in order, and installs the same files below /usr.
fn package_holds(release: &Release) {
    let bytes = std::fs::read(&release.package).expect("readable");
    let mut rest = bytes.strip_prefix(b"!<arch>\n").expect("an ar archive");
    let mut members = Vec::new();
    while rest.len() >= 60 {
        let field = |range: std::ops::Range<usize>| String::from_utf8_lossy(&rest[range]).trim().to_owned();
        let (name, size): (String, usize) = (field(0..16), field(48..58).parse().expect("a size"));
        assert_eq!(&rest[58..60], b"`\n");
        members.push((name, &rest[60..60 + size]));
        rest = &rest[(60 + size.next_multiple_of(2)).min(rest.len())..];
    }
    let names: Vec<&str> = members.iter().map(|(name, _)| name.as_str()).collect();
    assert_eq!(names, ["debian-binary", "control.tar.gz", "data.tar.gz"]);
    assert_eq!(members[0].1, b"2.0\n");
    let folder = release.home.join("package");
    for (_, packed) in &members[1..] {
        let mut gunzip = Command::new("gzip");
        let file = release.home.join("part.gz");
        std::fs::write(&file, packed).expect("writable");
        let tar = expect(gunzip.arg("-dc").arg(&file), 0).stdout;
        tar::Archive::new(tar.as_slice()).unpack(&folder).expect("a sound part");
    }
    let control = std::fs::read_to_string(folder.join("control")).expect("what the package says of itself");
    for line in ["Package: dragfree", &format!("Version: {}", env!("CARGO_PKG_VERSION")), "Depends: libc6 (>= 2."] {
        assert!(control.contains(line), "{line}: {control}");
    }
    assert_eq!(files(&folder.join("usr")), files(&release.top), "the same tree");
    let program = folder.join("usr/bin/dragfree");
    let list = json(release.command(program.to_str().expect("text")).args(["plugins", "list", "--json"]), 0);
    assert!(list["plugins"].as_array().is_some_and(|plugins| plugins.len() > 20), "{list}");
}

/// Paths below a folder, with their contents.
fn files(folder: &Path) -> BTreeSet<(PathBuf, Vec<u8>)> {
    let mut found = BTreeSet::new();
    let mut folders = vec![folder.to_owned()];
    while let Some(next) = folders.pop() {
        for entry in std::fs::read_dir(&next).expect("a folder").flatten() {
            if entry.path().is_dir() {
                folders.push(entry.path());
            } else {
                let path = entry.path().strip_prefix(folder).expect("below").to_owned();
                found.insert((path, std::fs::read(entry.path()).expect("readable")));
            }
        }
    }
    found
}
