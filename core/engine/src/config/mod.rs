//! Pipeline, mission and model files, and the parameters in them: read, checked, handed on.
//!
//! The engine knows no physics: of a mission file it reads the name and the spacecraft, the rest is the plugins'.

mod model;
mod parameters;
mod pipeline;

pub use model::{EffectEntry, Model, Prior};
pub use parameters::resolve as resolve_parameters;
pub use pipeline::{Mission, Node, Pipeline};

use std::path::{Path, PathBuf};

/// A file that cannot be used.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs, reason = "every field is named in its sentence")]
pub enum ConfigError {
    /// It cannot be read.
    #[error("{}: cannot be read: {source}; check the path", path.display())]
    Read { path: PathBuf, source: std::io::Error },
    /// It is not TOML of the shape wanted: unknown keys, wrong types.
    #[error("{}: {source}", path.display())]
    Shape { path: PathBuf, source: Box<toml::de::Error> },
    /// It is TOML, but has no sense.
    #[error("{}: {what}", path.display())]
    Sense { path: PathBuf, what: String },
    /// A plugin's parameters are not those that it declares.
    #[error("{file}: parameters of {plugin}: {what}")]
    Parameter { file: String, plugin: String, what: String },
}

pub(crate) fn read(path: &Path) -> Result<String, ConfigError> {
    dragfree_archive::files::read_text(path, crate::limits::CONFIG_BYTES)
        .map_err(|source| ConfigError::Read { path: path.to_owned(), source })
}

fn parse<T: serde::de::DeserializeOwned>(path: &Path, text: &str) -> Result<T, ConfigError> {
    toml::from_str(text).map_err(|source| ConfigError::Shape { path: path.to_owned(), source: Box::new(source) })
}
