//! Why a campaign stops.

use std::path::{Path, PathBuf};

use crate::bound::BoundError;

/// Error that stops a campaign.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs, reason = "every field is named in its sentence")]
pub(crate) enum CampaignError {
    /// The program did not start.
    #[error("{command}: {source}")]
    Start { command: String, source: std::io::Error },
    /// The program failed.
    #[error("{command}: {status}\n{message}")]
    Failed { command: String, status: std::process::ExitStatus, message: String },
    /// The output has another form than expected.
    #[error("{command}: {what} is missing in what it printed")]
    Answer { command: String, what: String },
    /// A complete line of a file of results is none.
    #[error("{path}, line {line}: {source}; results are written by `dragfree-validation` alone", path = path.display())]
    Line { path: PathBuf, line: usize, source: serde_json::Error },
    /// A bound.
    #[error(transparent)]
    Bound(#[from] BoundError),
    /// A product lacks a part.
    #[error("configuration {configuration}, seed {seed}: the product lacks {what}")]
    Product { configuration: String, seed: u32, what: String },
    /// The program of a campaign cannot be made again.
    #[error("{0}")]
    Frozen(String),
    /// A file of the campaign.
    #[error("{path}: {reason}", path = path.display())]
    File { path: PathBuf, reason: String },
}

/// An error about a file.
pub(crate) fn file(path: &Path, reason: &dyn std::fmt::Display) -> CampaignError {
    CampaignError::File { path: path.to_owned(), reason: reason.to_string() }
}
