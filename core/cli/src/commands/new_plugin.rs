//! `dragfree plugins new`: the skeleton of a plugin, in a folder outside this workspace.

use crate::args::{Language, NewPlugin, PluginKind};
use crate::commands::Done;
use crate::failure::{Failure, Refusal};
use crate::installed;
use dragfree_archive::files::IoContext as _;
use std::path::PathBuf;

macro_rules! skeleton {
    ($file:literal) => {
        include_str!(concat!("../../skeletons/", $file))
    };
}

/// A JSON Schema of the border, beside its header.
macro_rules! schema {
    ($name:literal) => {
        (
            concat!("include/dragfree/schema/", $name, ".schema.json"),
            include_str!(concat!("../../../abi/include/dragfree/schema/", $name, ".schema.json")),
        )
    };
}

/// Path and text of every file.
fn files(kind: PluginKind, language: Language) -> Vec<(&'static str, &'static str)> {
    match language {
        Language::Rust => {
            let code = match kind {
                PluginKind::Effect => skeleton!("rust/effect.rs"),
                PluginKind::Stage => skeleton!("rust/stage.rs"),
                PluginKind::Source => skeleton!("rust/source.rs"),
            };
            let ignored = "/target\n";
            vec![
                ("Cargo.toml", skeleton!("rust/Cargo.toml")),
                ("src/lib.rs", code),
                ("README.md", skeleton!("rust/README.md")),
                (".gitignore", ignored),
            ]
        }
        Language::C => {
            let code = match kind {
                PluginKind::Effect => skeleton!("c/effect.c"),
                PluginKind::Stage => skeleton!("c/stage.c"),
                PluginKind::Source => skeleton!("c/source.c"),
            };
            vec![
                ("{{FILE}}.c", code),
                ("Makefile", skeleton!("c/Makefile")),
                ("README.md", skeleton!("c/README.md")),
                ("include/dragfree/plugin.h", include_str!("../../../abi/include/dragfree/plugin.h")),
                ("include/dragfree/rows.h", include_str!("../../../abi/include/dragfree/rows.h")),
                schema!("coefficient"),
                schema!("constraint"),
                schema!("manifest"),
                schema!("model"),
                schema!("noise_process"),
                schema!("report"),
            ]
        }
    }
}

/// The third command of the README: how the plugin comes into a model or a pipeline; and what to give the run.
fn add(name: &str, kind: PluginKind, folder: &str) -> (String, String) {
    let channel = "--set channel=hk.battery_current_a";
    let (add, given) = match kind {
        PluginKind::Effect => (
            format!("dragfree model add model.toml {name}:tm1.x {channel} --plugin-dir {folder}"),
            "PIPELINE.toml … --model model.toml",
        ),
        PluginKind::Stage => {
            (format!("printf '\\n[[stage]]\\nplugin = \"{name}\"\\n' >> pipeline.toml"), "pipeline.toml …")
        }
        PluginKind::Source => {
            (format!("printf '\\n[source]\\nplugin = \"{name}\"\\n' >> pipeline.toml"), "pipeline.toml …")
        }
    };
    (add, format!("dragfree run {given} --plugin-dir {folder}"))
}

pub(super) fn execute(new: &NewPlugin, json: bool) -> Result<Done, Failure> {
    let name = &new.name;
    let folder = new.out.clone().unwrap_or_else(|| PathBuf::from(name));
    let taken = std::fs::read_dir(&folder).is_ok_and(|mut entries| entries.next().is_some());
    if taken {
        return Err(Refusal::NoPluginFolder(folder).into());
    }
    let (sdk, sdk_said) = sdk(new)?;
    let kind = match new.kind {
        PluginKind::Effect => "An effect",
        PluginKind::Stage => "A stage",
        PluginKind::Source => "A source",
    };
    let place = if new.lang == Language::Rust { "target/release" } else { "." };
    let (add, run) = add(name, new.kind, place);
    let values = [
        ("{{NAME}}", name.as_str()),
        ("{{FILE}}", &name.replace('-', "_")),
        ("{{A_KIND}}", kind),
        ("{{SDK}}", &sdk),
        ("{{SDK_SAID}}", &sdk_said),
        ("{{ADD}}", &add),
        ("{{RUN}}", &run),
    ];
    let fill = |text: &str| values.iter().fold(text.to_owned(), |text, (key, value)| text.replace(key, value));
    let mut written = Vec::new();
    for (path, text) in files(new.kind, new.lang) {
        let path = folder.join(fill(path));
        if let Some(parent) = path.parent() {
            std::fs::create_dir_all(parent).at("make the folder", parent)?;
        }
        std::fs::write(&path, fill(text)).at("write", &path)?;
        written.push(path.to_string_lossy().into_owned());
    }
    // The versions that the SDK was tested with.
    if let (Language::Rust, None, Some(lock)) = (new.lang, &new.sdk_git, installed::sdk_lock()) {
        let to = folder.join("Cargo.lock");
        std::fs::copy(&lock, &to).at("write", &to)?;
        written.push(to.to_string_lossy().into_owned());
    }
    if json {
        return Ok(Done::json(&serde_json::json!({ "folder": folder.to_string_lossy(), "files": written })));
    }
    let build = if new.lang == Language::Rust { "cargo build --release" } else { "make" };
    let readme = folder.join("README.md");
    Ok(Done::new(format!(
        "{}\nnext: cd {} && {build}; the rest is in {}\n",
        written.join("\n"),
        folder.display(),
        readme.display()
    )))
}

/// The SDK as a dependency, and in words.
fn sdk(new: &NewPlugin) -> Result<(String, String), Failure> {
    if let Some(url) = &new.sdk_git {
        return Ok((format!("git = {url:?}"), format!("the repository {url}")));
    }
    let asked = new.sdk.clone().unwrap_or_else(installed::sdk);
    match asked.canonicalize() {
        Ok(path) if path.join("Cargo.toml").is_file() => {
            let shown = path.display().to_string();
            let by = if new.sdk.is_some() { "named when this was written" } else { "that came with this `dragfree`" };
            Ok((
                format!("path = {shown:?}"),
                format!("the folder `{shown}`, {by}; change it in `Cargo.toml` when it moves"),
            ))
        }
        // A C plugin needs the header alone.
        _ if new.lang == Language::C => Ok((String::new(), String::new())),
        _ => Err(Refusal::NoSdk(asked).into()),
    }
}
