//! The release: what is built, laid out as it is installed, as one archive and as a Debian package.

use crate::Failure;
use crate::deb;
use crate::sbom;
use crate::tree::Tree;
use serde_json::Value;
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::SystemTime;

/// The workspace.
pub(crate) const ROOT: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/..");

/// The crate that plugins in Rust depend on.
const SDK: &str = "dragfree-sdk";

/// Compression level: a few seconds for the whole tree.
const ZSTD_LEVEL: i32 = 12;

/// Makes archive and package in `out`, and gives their paths, one a line.
pub(crate) fn make(out: &Path) -> Result<String, Failure> {
    let root = Path::new(ROOT).canonicalize()?;
    let workspace = Workspace::read(&root)?;
    let target = workspace.target.to_str().ok_or("the target folder's path is no text")?;
    cargo(&root, &["build", "--quiet", "--release", "--workspace", "--lib", "--bins", "--target-dir", target])?;
    let version = workspace.version("dragfree")?;
    let tree = layout(&root, &workspace)?;
    let time_s = release_time_s()?;
    std::fs::create_dir_all(out)?;
    let name = format!("dragfree-{version}-{}-{}", std::env::consts::ARCH, std::env::consts::OS);
    let archive = out.join(format!("{name}.tar.zst"));
    let zstd = zstd::Encoder::new(std::io::BufWriter::new(std::fs::File::create(&archive)?), ZSTD_LEVEL)?;
    std::io::Write::flush(&mut tree.tar(&name, time_s, zstd)?.finish()?)?;
    let package = out.join(format!("{name}.deb"));
    std::fs::write(&package, deb::package(&tree, &version, time_s)?)?;
    Ok(format!("{}\n{}\n", archive.display(), package.display()))
}

/// `SOURCE_DATE_EPOCH` makes two releases of one source the same, byte for byte.
fn release_time_s() -> Result<u64, Failure> {
    match std::env::var("SOURCE_DATE_EPOCH") {
        Ok(seconds) => Ok(seconds.parse().map_err(|e| format!("SOURCE_DATE_EPOCH = {seconds}: {e}"))?),
        Err(_) => Ok(SystemTime::now().duration_since(SystemTime::UNIX_EPOCH)?.as_secs()),
    }
}

fn layout(root: &Path, workspace: &Workspace) -> Result<Tree, Failure> {
    let built = workspace.target.join("release");
    let mut tree = Tree::default();
    let program = built.join(format!("dragfree{}", std::env::consts::EXE_SUFFIX));
    tree.put_program("bin/dragfree", std::fs::read(&program)?);
    for library in workspace.plugins() {
        let file = format!("{}{library}{}", std::env::consts::DLL_PREFIX, std::env::consts::DLL_SUFFIX);
        tree.copy(&built.join(&file), &format!("lib/dragfree/{file}"))?;
    }
    tree.copy(&root.join("core/abi/include"), "include")?;
    for folder in ["missions", "pipelines", "models", "schema", "proto"] {
        tree.copy(&root.join("fixtures").join(folder), &format!("share/dragfree/{folder}"))?;
    }
    sdk(root, workspace, &mut tree)?;
    for page in ["README.md", "CHANGELOG.md", "SECURITY.md", "VALIDATION.md"] {
        tree.copy(&root.join(page), &format!("share/doc/dragfree/{page}"))?;
    }
    tree.copy(&root.join("campaigns"), "share/dragfree/campaigns")?;
    tree.copy(&root.join("ops-guide/src"), "share/doc/dragfree/guide")?;
    tree.copy(
        &root.join("fixtures/ephemeris/LICENSE-naif-packages.txt"),
        "share/doc/dragfree/LICENSE-naif-packages.txt",
    )?;
    let linked = workspace.plugin_packages().chain(["dragfree".to_owned()]).collect();
    tree.put("share/doc/dragfree/sbom.cdx.json", sbom::make(root, &workspace.version("dragfree")?, &linked)?);
    tree.put("share/doc/dragfree/copyright", "License: MIT OR Apache-2.0\n");
    let pages = tempfile::tempdir()?;
    output(Command::new(&program).args(["man", "--out"]).arg(pages.path()))?;
    tree.copy(pages.path(), "share/man/man1")?;
    for (shell, path) in [
        ("bash", "share/bash-completion/completions/dragfree"),
        ("zsh", "share/zsh/site-functions/_dragfree"),
        ("fish", "share/fish/vendor_completions.d/dragfree.fish"),
    ] {
        tree.put(path, output(Command::new(&program).args(["completions", shell]))?);
    }
    Ok(tree)
}

/// The SDK and the crates of ours below it as a workspace, with the lock file of this one cut to what it needs.
fn sdk(root: &Path, workspace: &Workspace, tree: &mut Tree) -> Result<(), Failure> {
    let crates = workspace.below(SDK);
    let folders: Vec<&str> = crates.iter().map(|name| workspace.folder(name)).collect::<Result<_, _>>()?;
    let mut manifest: toml_edit::DocumentMut = std::fs::read_to_string(root.join("Cargo.toml"))?.parse()?;
    let section = manifest["workspace"].as_table_mut().ok_or("Cargo.toml has no [workspace]")?;
    section["members"] = toml_edit::value(folders.iter().copied().collect::<toml_edit::Array>());
    if let Some(dependencies) = section["dependencies"].as_table_mut() {
        dependencies.retain(|name, entry| entry.get("path").is_none() || crates.contains(name));
    }
    let staged = tempfile::tempdir()?;
    let mut sources = Tree::default();
    for folder in folders {
        for part in ["Cargo.toml", "src", "include", "examples"] {
            let from = root.join(folder).join(part);
            if from.exists() {
                sources.copy(&from, &format!("{folder}/{part}"))?;
            }
        }
    }
    sources.put("Cargo.toml", manifest.to_string());
    sources.put("Cargo.lock", std::fs::read(root.join("Cargo.lock"))?);
    let tar = sources.tar("sdk", 0, Vec::new())?;
    tar::Archive::new(tar.as_slice()).unpack(staged.path())?;
    let folder = staged.path().join("sdk");
    cargo(&folder, &["update", "--quiet", "--workspace", "--offline"])?;
    tree.copy(&folder, "share/dragfree/sdk")
}

/// What `cargo metadata` says of our crates, and where they are built.
pub(crate) struct Workspace {
    packages: Vec<Value>,
    root: PathBuf,
    pub(crate) target: PathBuf,
}

impl Workspace {
    pub(crate) fn read(root: &Path) -> Result<Self, Failure> {
        let text = cargo(root, &["metadata", "--no-deps", "--offline", "--format-version", "1"])?;
        let metadata: Value = serde_json::from_slice(&text)?;
        let packages = metadata["packages"].as_array().cloned().ok_or("cargo metadata names no packages")?;
        // This program lies in the target folder that it was built into, `target/release/xtask`.
        let target = std::env::current_exe()?.ancestors().nth(2).ok_or("xtask lies in no target folder")?.to_owned();
        Ok(Self { packages, root: root.to_owned(), target })
    }

    fn package(&self, name: &str) -> Result<&Value, Failure> {
        Ok(self
            .packages
            .iter()
            .find(|p| p["name"] == name)
            .ok_or_else(|| format!("the workspace has no crate {name}"))?)
    }

    fn version(&self, name: &str) -> Result<String, Failure> {
        Ok(self.package(name)?["version"].as_str().ok_or("a crate without a version")?.to_owned())
    }

    /// Folder of a crate, below the workspace.
    fn folder(&self, name: &str) -> Result<&str, Failure> {
        let manifest = self.package(name)?["manifest_path"].as_str().ok_or("a crate without a manifest")?;
        let folder = Path::new(manifest).parent().and_then(|folder| folder.strip_prefix(&self.root).ok());
        Ok(folder.and_then(Path::to_str).ok_or_else(|| format!("{manifest} lies outside of the workspace"))?)
    }

    /// Libraries of plugins: what is built as a `cdylib` beside the program.
    pub(crate) fn plugins(&self) -> Vec<String> {
        let targets = self.packages.iter().filter_map(|p| p["targets"].as_array()).flatten();
        let name = |target: &Value| target["name"].as_str().map(|name| name.replace('-', "_"));
        targets.filter(|target| is_plugin(target)).filter_map(name).collect()
    }

    /// The crates that these are built from.
    fn plugin_packages(&self) -> impl Iterator<Item = String> {
        let makes_one = |p: &&Value| p["targets"].as_array().is_some_and(|all| all.iter().any(is_plugin));
        self.packages.iter().filter(makes_one).filter_map(|p| Some(p["name"].as_str()?.to_owned()))
    }

    /// A crate and those of ours that it needs, in order of their names.
    fn below(&self, name: &str) -> BTreeSet<String> {
        let mut found = BTreeSet::new();
        let mut waiting = vec![name.to_owned()];
        while let Some(name) = waiting.pop() {
            let Ok(package) = self.package(&name) else { continue };
            let dependencies = package["dependencies"].as_array().into_iter().flatten();
            let ours = dependencies.filter(|d| d["path"].is_string() && d["kind"].is_null());
            if found.insert(name.clone()) {
                waiting.extend(ours.filter_map(|d| d["name"].as_str()).map(str::to_owned));
            }
        }
        found
    }
}

/// Whether a target of a crate is a library of plugins.
fn is_plugin(target: &Value) -> bool {
    let has = |key: &str, what: &str| target[key].as_array().is_some_and(|all| all.iter().any(|x| x == what));
    has("crate_types", "cdylib") && !has("kind", "example")
}

pub(crate) fn cargo(folder: &Path, arguments: &[&str]) -> Result<Vec<u8>, Failure> {
    let cargo = std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into());
    output(Command::new(cargo).current_dir(folder).args(arguments))
}

/// Stdout of a command that must succeed.
pub(crate) fn output(command: &mut Command) -> Result<Vec<u8>, Failure> {
    let output = command.output().map_err(|error| format!("{command:?}: {error}"))?;
    if output.status.success() {
        return Ok(output.stdout);
    }
    Err(format!("{command:?}: {}\n{}", output.status, String::from_utf8_lossy(&output.stderr)).into())
}
