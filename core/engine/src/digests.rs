//! Digests of plugin libraries from one call of the program to the next, so that to list plugins is not to read all
//! their bytes again. What is used is hashed whenever it is opened.

use std::fs::File;
use std::io::{self, Write as _};
use std::path::Path;

use dragfree_archive::files::{folder_of, read_text};

use crate::input;

/// Longest file of digests.
const MOST_BYTES: u64 = 1 << 22;

/// Takes the digests that a file holds for those of the files that look as they did then. Does nothing where there is
/// no such file, or somebody else may have written it.
pub fn recall(path: &Path) {
    let read = || -> io::Result<()> {
        if is_own(path)? {
            input::recall(serde_json::from_str(&read_text(path, MOST_BYTES)?)?);
        }
        Ok(())
    };
    told(path, read());
}

/// Writes the digests of the files that this process has opened, unless the file holds these. Does nothing where it
/// cannot be written.
pub fn keep(path: &Path) {
    let write = || -> io::Result<()> {
        let text = serde_json::to_string(&input::used())?;
        if read_text(path, MOST_BYTES).is_ok_and(|old| old == text) {
            return Ok(());
        }
        let folder = folder_of(path);
        std::fs::create_dir_all(folder)?;
        let mut file = tempfile::NamedTempFile::new_in(folder)?;
        file.write_all(text.as_bytes())?;
        file.persist(path).map_err(|error| error.error)?;
        Ok(())
    };
    told(path, write());
}

/// Without these digests everything is the same and takes longer.
fn told(path: &Path, done: io::Result<()>) {
    if let Err(error) = done {
        tracing::debug!(path = %path.display(), %error, "digests of libraries");
    }
}

/// Whether this user alone may write a file.
#[cfg(unix)]
fn is_own(path: &Path) -> io::Result<bool> {
    use std::os::unix::fs::MetadataExt as _;
    let stat = File::open(path)?.metadata()?;
    Ok(stat.uid() == rustix::process::geteuid().as_raw() && stat.mode() & 0o022 == 0)
}

#[cfg(not(unix))]
fn is_own(path: &Path) -> io::Result<bool> {
    File::open(path).map(|_| false)
}
