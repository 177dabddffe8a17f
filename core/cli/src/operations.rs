//! The mission's file of operations: which one is meant, and the archive that it names.

use crate::failure::{Failure, Refusal};
use dragfree_workflow::operations::{FILE, Operations};
use std::path::{Path, PathBuf};

/// The file that is named, or the nearest one from this folder upwards.
///
/// # Errors
/// There is none, or it cannot be read.
pub(crate) fn load(named: Option<&Path>) -> Result<Operations, Failure> {
    let path = named.map(PathBuf::from).or_else(|| Operations::find(Path::new(".")));
    Ok(Operations::load(&path.ok_or(Refusal::NoOperations)?)?)
}

/// The archive that a command works on where `--archive` does not say: that of the nearest file of operations.
pub(crate) fn archive() -> PathBuf {
    let found = Operations::find(Path::new(".")).and_then(|path| Operations::load(&path).ok());
    found.map_or_else(|| PathBuf::from("archive"), |operations| operations.archive)
}

/// Name of the file of operations.
pub(crate) const NAME: &str = FILE;
