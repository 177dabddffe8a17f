//! Failures: what, where, why, what next.

use std::error::Error;
use std::path::PathBuf;

/// A failure of the command itself; the engine has its own.
#[derive(Debug, thiserror::Error)]
pub(crate) enum Failure {
    /// The operating system refused something.
    #[error("cannot {action} {}: {source}", path.display())]
    Io { action: &'static str, path: PathBuf, source: std::io::Error },
    /// A plugin folder that was asked for is not there.
    #[error("the plugin folder {} does not exist; correct --plugin-dir or DRAGFREE_PLUGIN_PATH", .0.display())]
    PluginFolder(PathBuf),
    /// No plugin of that name.
    #[error("no plugin {0}; `dragfree plugins list` shows what was found and what was refused")]
    Plugin(String),
    /// No archive there.
    #[error("there is no archive {}; --archive names one, `dragfree run` makes one", .0.display())]
    NoArchive(PathBuf),
    /// The demo would have to share a folder.
    #[error("{} is neither empty nor made by an earlier demo; name a folder of its own with --dir", .0.display())]
    NoDemoFolder(PathBuf),
    /// A diagnosis that names no effect to add.
    #[error("{}: {what}", path.display())]
    Diagnosis { path: PathBuf, what: String },
    /// Arguments that make no sense together.
    #[error("{0}")]
    Usage(String),
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
    /// A check that does not exist.
    #[error("there is no check {0}")]
    NoCheck(String),
    /// `--set` without a value.
    #[error("--set {0}: NAME=VALUE is needed")]
    NoParameter(String),
    /// The engine failed.
    #[error(transparent)]
    Engine(#[from] Box<dyn Error>),
}

impl Failure {
    pub(crate) fn io(action: &'static str, path: impl Into<PathBuf>) -> impl FnOnce(std::io::Error) -> Self {
        let path = path.into();
        move |source| Self::Io { action, path, source }
    }

    /// A failure from any error of the engine.
    pub(crate) fn engine(error: impl Error + 'static) -> Self {
        Self::Engine(Box::new(error))
    }
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

    #[derive(Debug, thiserror::Error)]
    #[error("the pipeline stopped")]
    struct Outer {
        source: Failure,
    }

    #[test]
    fn causes_are_told_once() {
        let full = || std::io::Error::from(std::io::ErrorKind::StorageFull);
        let inner = Failure::Io { action: "write", path: "a.toml".into(), source: full() };
        assert_eq!(chain(&inner), format!("cannot write a.toml: {}", full()));
        assert_eq!(
            chain(&Outer { source: inner }),
            format!("the pipeline stopped\n  because cannot write a.toml: {}", full())
        );
    }
}
