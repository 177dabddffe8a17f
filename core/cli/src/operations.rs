//! The mission's file of operations: which one is meant, and the archive that it names.

use crate::failure::{Failure, Refusal};
use dragfree_workflow::operations::{FILE, Operations};
use std::path::{Path, PathBuf};

/// The file that is named, or the nearest one from this folder upwards; none where there is no such file.
///
/// # Errors
/// It cannot be read.
pub(crate) fn nearest(named: Option<&Path>) -> Result<Option<Operations>, Failure> {
    let path = named.map(PathBuf::from).or_else(|| Operations::find(Path::new(".")));
    Ok(path.map(|path| Operations::load(&path)).transpose()?)
}

/// As [`nearest`].
///
/// # Errors
/// There is none, or it cannot be read.
pub(crate) fn load(named: Option<&Path>) -> Result<Operations, Failure> {
    nearest(named)?.ok_or_else(|| Refusal::NoOperations.into())
}

/// The archive that a command works on where `--archive` does not say: that of the file of operations that is named, or
/// of the nearest one.
///
/// # Errors
/// The file that is named cannot be read.
pub(crate) fn archive(named: Option<&Path>) -> Result<PathBuf, Failure> {
    let found = match named {
        Some(_) => nearest(named)?,
        None => nearest(None).ok().flatten(),
    };
    Ok(found.map_or_else(|| PathBuf::from("archive"), |operations| operations.archive))
}

/// Name of the file of operations.
pub(crate) const NAME: &str = FILE;
