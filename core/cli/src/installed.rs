//! What comes with the program: missions, pipelines and models by name, and the SDK.
//!
//! In an installation they lie in `../share/dragfree` from the program, in a build folder in the source tree that it
//! was built from.

use crate::args::{Arguments, Command, Config, Model, Plugins};
use crate::failure::{Failure, Refusal};
use std::path::{Component, Path, PathBuf};

/// The source tree that this program was built from; gone where the program was carried away.
const SOURCE: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../..");

/// A kind of file that has names.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Named {
    Mission,
    Pipeline,
    Model,
}

impl Named {
    fn word(self) -> &'static str {
        match self {
            Self::Mission => "mission",
            Self::Pipeline => "pipeline",
            Self::Model => "model",
        }
    }

    /// Its folder beside those of the other kinds.
    fn folder(self) -> String {
        format!("{}s", self.word())
    }
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
fn names(kind: Named) -> Vec<String> {
    let entries = std::fs::read_dir(fixtures().join(kind.folder())).into_iter().flatten().flatten();
    let paths = entries.map(|entry| entry.path()).filter(|path| path.extension().is_some_and(|e| e == "toml"));
    let mut names: Vec<String> = paths.filter_map(|path| Some(path.file_stem()?.to_str()?.to_owned())).collect();
    names.sort();
    names
}

/// A file that exists is itself; a name alone is the file of that name that comes with the program.
///
/// # Errors
/// It is a name alone, and there is none of it.
pub(crate) fn find(kind: Named, given: &Path) -> Result<PathBuf, Failure> {
    let mut parts = given.components();
    let is_name =
        matches!((parts.next(), parts.next()), (Some(Component::Normal(_)), None)) && given.extension().is_none();
    if !is_name || given.exists() {
        return Ok(given.to_owned());
    }
    let found = fixtures().join(kind.folder()).join(given).with_extension("toml");
    if found.is_file() {
        return Ok(found.canonicalize().unwrap_or(found));
    }
    Err(Refusal::NoName { kind: kind.word(), name: given.display().to_string(), known: names(kind).join(", ") }.into())
}

/// Pipelines that come with the program and are made for a mission that does, by name.
pub(crate) fn pipeline_of(mission: &str) -> Option<PathBuf> {
    let path = |name: &String| fixtures().join("pipelines").join(name).with_extension("toml");
    let wanted = format!("\"../missions/{mission}.toml\"");
    names(Named::Pipeline)
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
        put(Named::Pipeline, &mut chain.pipeline)?;
        put_if(Named::Mission, &mut chain.mission)?;
        put_if(Named::Model, &mut chain.model)
    };
    match &mut arguments.command {
        Command::Simulate(command) => put(Named::Mission, &mut command.mission),
        Command::Design(command) => put(Named::Mission, &mut command.mission),
        Command::Run(command) => chain(&mut command.chain),
        Command::Config(Config::Check(command)) => chain(command),
        Command::Plugins(Plugins::Validate(command)) => put_if(Named::Mission, &mut command.mission),
        Command::Init(command) => put(Named::Mission, &mut command.mission),
        // The commands that change a model ask for a file: what comes with the program is everybody's.
        Command::Model(Model::Show { model, .. }) => put(Named::Model, model),
        Command::Model(Model::Add(command)) => put_if(Named::Mission, &mut command.mission),
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_name_is_found_and_a_path_is_left_alone() {
        let taiji = find(Named::Mission, Path::new("taiji")).expect("it comes with the program");
        assert!(taiji.ends_with("missions/taiji.toml") && taiji.is_file(), "{}", taiji.display());
        for path in ["taiji.toml", "./taiji", "a/b", "/no/such/file.toml"] {
            assert_eq!(find(Named::Mission, Path::new(path)).expect("a path"), Path::new(path));
        }
        let error = find(Named::Model, Path::new("taiji")).expect_err("no model").to_string();
        assert!(error.contains("no model `taiji`") && error.contains("com-offset"), "{error}");
        assert!(pipeline_of("taiji").is_some_and(|path| path.ends_with("science-mode.toml")));
        assert!(pipeline_of("gracefo-c").is_some_and(|path| path.ends_with("accelerometer.toml")));
        assert_eq!(pipeline_of("nobody"), None);
    }
}
