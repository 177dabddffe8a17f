//! What comes with the program: missions, pipelines and models by name, and the SDK.
//!
//! In an installation they lie in `../share/dragfree` from the program, in a build folder in the source tree that it
//! was built from.

use crate::args::{Arguments, Command, Config, Model, Plugins};
use crate::failure::{Failure, Refusal};
use std::path::{Component, Path, PathBuf};

/// The source tree that this program was built from; gone where the program was carried away.
const SOURCE: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../..");

/// Kinds of files that have names; each has a folder, its name with an `s`.
pub(crate) const MISSION: &str = "mission";
pub(crate) const PIPELINE: &str = "pipeline";
pub(crate) const MODEL: &str = "model";

fn folder(kind: &str) -> PathBuf {
    fixtures().join(format!("{kind}s"))
}

/// `share/dragfree` of the installation; none in a build folder.
fn share() -> Option<PathBuf> {
    let program = std::env::current_exe().and_then(|path| path.canonicalize()).ok()?;
    let share = program.parent()?.parent()?.join("share/dragfree");
    share.is_dir().then_some(share)
}

/// The folder with `missions`, `pipelines` and `models`.
fn fixtures() -> PathBuf {
    share().unwrap_or_else(|| Path::new(SOURCE).join("fixtures"))
}

/// The SDK's crate.
pub(crate) fn sdk() -> PathBuf {
    share().map_or_else(|| Path::new(SOURCE).join("core/sdk"), |share| share.join("sdk/core/sdk"))
}

/// The lock file that the SDK was tested with; none where only the sources of the program have one.
pub(crate) fn sdk_lock() -> Option<PathBuf> {
    share().map(|share| share.join("sdk/Cargo.lock")).filter(|lock| lock.is_file())
}

/// The names of a kind, in order.
fn names(kind: &str) -> Vec<String> {
    let entries = std::fs::read_dir(folder(kind)).into_iter().flatten().flatten();
    let paths = entries.map(|entry| entry.path()).filter(|path| path.extension().is_some_and(|e| e == "toml"));
    let mut names: Vec<String> = paths.filter_map(|path| Some(path.file_stem()?.to_str()?.to_owned())).collect();
    names.sort();
    names
}

/// A file that exists is itself; a name alone is the file of that name that comes with the program.
///
/// # Errors
/// It is a name alone, and there is none of it.
pub(crate) fn find(kind: &'static str, given: &Path) -> Result<PathBuf, Failure> {
    let mut parts = given.components();
    let is_name =
        matches!((parts.next(), parts.next()), (Some(Component::Normal(_)), None)) && given.extension().is_none();
    if !is_name || given.exists() {
        return Ok(given.to_owned());
    }
    let found = folder(kind).join(given).with_extension("toml");
    if found.is_file() {
        return Ok(found.canonicalize().unwrap_or(found));
    }
    Err(Refusal::NoName { kind, name: given.display().to_string(), known: names(kind).join(", ") }.into())
}

/// Pipelines that come with the program and are made for a mission that does, by name.
pub(crate) fn pipeline_of(mission: &str) -> Option<PathBuf> {
    let path = |name: &String| folder(PIPELINE).join(name).with_extension("toml");
    let wanted = format!("\"../missions/{mission}.toml\"");
    names(PIPELINE)
        .iter()
        .map(path)
        .find(|path| std::fs::read_to_string(path).is_ok_and(|text| text.lines().any(|l| l.contains(&wanted))))
}

/// Puts files in the place of names.
///
/// # Errors
/// As [`find`].
pub(crate) fn resolve(arguments: &mut Arguments) -> Result<(), Failure> {
    let put = |kind, path: &mut PathBuf| find(kind, path).map(|found| *path = found);
    let put_if = |kind, path: &mut Option<PathBuf>| path.as_mut().map_or(Ok(()), |path| put(kind, path));
    let chain = |chain: &mut crate::args::Chain| {
        put(PIPELINE, &mut chain.pipeline)?;
        put_if(MISSION, &mut chain.mission)?;
        put_if(MODEL, &mut chain.model)
    };
    match &mut arguments.command {
        Command::Simulate(command) => put(MISSION, &mut command.mission),
        Command::Design(command) => put(MISSION, &mut command.mission),
        Command::Run(command) => chain(&mut command.chain),
        Command::Config(Config::Check(command)) => chain(command),
        Command::Plugins(Plugins::Validate(command)) => put_if(MISSION, &mut command.mission),
        Command::Init(command) => put(MISSION, &mut command.mission),
        // Commands that change a model take a file only: installed models are shared.
        Command::Model(Model::Show { model, .. }) => put(MODEL, model),
        Command::Model(Model::Add(command)) => put_if(MISSION, &mut command.mission),
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_name_is_found_and_a_path_is_left_alone() {
        let taiji = find(MISSION, Path::new("taiji")).expect("it comes with the program");
        assert!(taiji.ends_with("missions/taiji.toml") && taiji.is_file(), "{}", taiji.display());
        for path in ["taiji.toml", "./taiji", "a/b", "/no/such/file.toml"] {
            assert_eq!(find(MISSION, Path::new(path)).expect("a path"), Path::new(path));
        }
        let error = find(MODEL, Path::new("taiji")).expect_err("no model").to_string();
        assert!(error.contains("no model `taiji`") && error.contains("com-offset"), "{error}");
        assert!(pipeline_of("taiji").is_some_and(|path| path.ends_with("science-mode.toml")));
        assert!(pipeline_of("gracefo-c").is_some_and(|path| path.ends_with("accelerometer.toml")));
        assert_eq!(pipeline_of("nobody"), None);
    }
}
