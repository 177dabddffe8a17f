//! Files: errors that name them, digests, and durable renames.

use sha2::{Digest as _, Sha256};
use std::fs::{self, File};
use std::io::{self, Read as _, Write as _};
use std::path::{Path, PathBuf};

/// The operating system refused something.
#[derive(Debug, thiserror::Error)]
#[error("cannot {action} {}: {source}", path.display())]
pub struct IoError {
    /// What was tried, "write".
    pub action: &'static str,
    /// File or folder.
    pub path: PathBuf,
    /// The system's reason.
    pub source: io::Error,
}

/// A file that is not used.
#[derive(Clone, Debug)]
pub struct Problem {
    /// The file.
    pub path: PathBuf,
    /// What is wrong, one sentence.
    pub reason: String,
}

/// Adds action and path to a result of the operating system.
pub trait IoContext<T> {
    /// The same result; its error says that `action` failed on `path`.
    ///
    /// # Errors
    /// [`IoError`] where the result was an error.
    fn at(self, action: &'static str, path: impl AsRef<Path>) -> Result<T, IoError>;
}

impl<T> IoContext<T> for io::Result<T> {
    fn at(self, action: &'static str, path: impl AsRef<Path>) -> Result<T, IoError> {
        self.map_err(|source| IoError { action, path: path.as_ref().to_owned(), source })
    }
}

/// Folder that holds a file; `.` for a bare name.
pub fn folder_of(path: &Path) -> &Path {
    path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."))
}

/// Makes the renames in a folder durable; does nothing on systems where a folder cannot be flushed.
///
/// # Errors
/// The operating system refuses.
pub fn sync_folder(folder: &Path) -> io::Result<()> {
    if cfg!(unix) { File::open(folder).and_then(|folder| folder.sync_all()) } else { Ok(()) }
}

/// The text of a file of at most `limit` bytes.
///
/// # Errors
/// It cannot be read, is longer, or is no UTF-8.
pub fn read_text(path: &Path, limit: u64) -> io::Result<String> {
    let mut bytes = Vec::new();
    File::open(path)?.take(limit.saturating_add(1)).read_to_end(&mut bytes)?;
    if bytes.len() as u64 > limit {
        return Err(io::Error::other(format!("it is longer than {limit} bytes")));
    }
    String::from_utf8(bytes).map_err(|error| io::Error::new(io::ErrorKind::InvalidData, error.utf8_error()))
}

/// Writes a new file and makes its content durable.
pub(crate) fn write_durable(path: &Path, content: &[u8]) -> Result<(), IoError> {
    let write = || {
        let mut file = File::create_new(path)?;
        file.write_all(content)?;
        file.sync_all()
    };
    write().at("write", path)
}

/// Lower-case hexadecimal.
pub fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

/// SHA-256 of some bytes, lower-case hexadecimal.
pub fn sha256(bytes: impl AsRef<[u8]>) -> String {
    hex(&Sha256::digest(bytes))
}

/// SHA-256 of all bytes of a file, lower-case hexadecimal.
///
/// # Errors
/// The file cannot be read.
pub fn sha256_of(path: &Path) -> io::Result<String> {
    let mut file = File::open(path)?;
    let mut hasher = Sha256::new();
    let mut buffer = vec![0; 1 << 18];
    loop {
        match file.read(&mut buffer)? {
            0 => return Ok(hex(&hasher.finalize())),
            count => hasher.update(&buffer[..count]),
        }
    }
}

/// Number of a file on its file system.
#[cfg(unix)]
pub(crate) fn inode(stat: &fs::Metadata) -> u64 {
    use std::os::unix::fs::MetadataExt as _;
    stat.ino()
}

/// When a file was written last, Unix ns.
#[cfg(unix)]
pub(crate) fn mtime_ns(stat: &fs::Metadata) -> i64 {
    use std::os::unix::fs::MetadataExt as _;
    stat.mtime().saturating_mul(1_000_000_000).saturating_add(stat.mtime_nsec())
}

#[cfg(not(unix))]
pub(crate) fn inode(_stat: &fs::Metadata) -> u64 {
    0
}

#[cfg(not(unix))]
pub(crate) fn mtime_ns(stat: &fs::Metadata) -> i64 {
    let since = stat.modified().ok().and_then(|t| t.duration_since(std::time::UNIX_EPOCH).ok());
    since.and_then(|d| i64::try_from(d.as_nanos()).ok()).unwrap_or(0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_text_is_read_up_to_its_limit_and_refused_beyond() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("text");
        fs::write(&path, "offset é").unwrap();
        assert_eq!(read_text(&path, 9).unwrap(), "offset é");
        // Cut in the middle of a character, it is too long before it is no UTF-8.
        for limit in [8, 7, 0] {
            assert_eq!(read_text(&path, limit).unwrap_err().to_string(), format!("it is longer than {limit} bytes"));
        }
        fs::write(&path, [b'o', 0xff]).unwrap();
        assert_eq!(read_text(&path, 9).unwrap_err().kind(), io::ErrorKind::InvalidData);
    }
}
