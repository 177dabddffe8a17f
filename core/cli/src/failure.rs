//! Failures: what, where, why, what next.

use std::error::Error;
use std::path::PathBuf;

/// Any error: of the engine, of a library, or a [`Refusal`].
pub(crate) type Failure = Box<dyn Error>;

/// What the command line itself refuses.
#[derive(Debug, thiserror::Error)]
pub(crate) enum Refusal {
    /// A plugin folder that was asked for is not there.
    #[error("the plugin folder {} does not exist; correct --plugin-dir or DRAGFREE_PLUGIN_PATH", .0.display())]
    PluginFolder(PathBuf),
    /// No plugin of that name.
    #[error("no plugin {0}; `dragfree plugins list` shows what was found and what was refused")]
    Plugin(String),
    /// No archive there.
    #[error("there is no archive {}; --archive names one, `dragfree run` makes one", .0.display())]
    NoArchive(PathBuf),
    /// No file of operations.
    #[error(
        "there is no mission-ops.toml here or in a folder above; name one with --ops, `dragfree init DIR` writes one"
    )]
    NoOperations,
    /// Another program runs days.
    #[error("another dragfree runs days of {}; wait for it, or end it", .0.display())]
    DaysRunning(PathBuf),
    /// The demo would have to share a folder.
    #[error("{} is neither empty nor made by an earlier demo; name a folder of its own with --dir", .0.display())]
    NoDemoFolder(PathBuf),
    /// The demo would have to print one document while it shows pages.
    #[error("--open shows pages until it is ended, and --json prints one document at the end; leave one of them out")]
    OpenAsJson,
    /// A diagnosis that names no effect to add.
    #[error("{}: {what}", path.display())]
    Diagnosis { path: PathBuf, what: String },
    /// An extract of several products.
    #[error("--keep-extract keeps the extract of one product, and {0} were named; diagnose each by itself")]
    Extracts(usize),
    /// A skeleton would have to share a folder.
    #[error("{} is not empty; name another folder with --out", .0.display())]
    NoPluginFolder(PathBuf),
    /// There is no SDK to depend on.
    #[error("there is no SDK in {}; name its folder with --sdk, or its repository with --sdk-git", .0.display())]
    NoSdk(PathBuf),
    /// A name of nothing that comes with the program.
    #[error("there is no file {name}, and no {kind} `{name}` comes with dragfree; it has {known}")]
    NoName { kind: &'static str, name: String, known: String },
    /// A file is in the way.
    #[error("{} is there already and stays as it is; name another folder", .0.display())]
    Taken(PathBuf),
}

/// The error and, a line each, the causes that it does not tell itself.
pub(crate) fn chain(error: &dyn Error) -> String {
    let mut text = error.to_string();
    let mut cause = error.source();
    while let Some(error) = cause {
        let told = error.to_string();
        if !text.contains(&told) {
            text += &format!("\n  because {told}");
        }
        cause = error.source();
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;
    use dragfree_archive::files::IoError;

    #[derive(Debug, thiserror::Error)]
    #[error("the pipeline stopped")]
    struct Outer {
        source: IoError,
    }

    #[test]
    fn causes_are_told_once() {
        let full = || std::io::Error::from(std::io::ErrorKind::StorageFull);
        let inner = IoError { action: "write", path: "a.toml".into(), source: full() };
        assert_eq!(chain(&inner), format!("cannot write a.toml: {}", full()));
        assert_eq!(
            chain(&Outer { source: inner }),
            format!("the pipeline stopped\n  because cannot write a.toml: {}", full())
        );
    }
}
