//! A file that a job reads: opened once, hashed and read through one descriptor, and at the end compared with what it
//! was, so that a product names the bytes that it was made of.

use serde::{Deserialize, Serialize};
use sha2::{Digest as _, Sha256};
use std::collections::BTreeMap;
use std::fs::{File, Metadata};
use std::io::{self, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, SystemTime};

/// Size of the buffer that a whole file goes through.
const BUFFER: usize = 1 << 18;

/// An open file.
#[derive(Debug)]
pub(crate) struct InputFile {
    path: PathBuf,
    file: File,
    /// What it looked like when it was opened.
    opened_as: Look,
    /// Whether it was written so long ago that whatever is written to it now would make it look otherwise.
    settled: bool,
}

/// Clocks of file systems go in steps of some milliseconds: within one, a file may change and look the same.
const SETTLES: Duration = Duration::from_secs(1);

/// Digests of settled files, by what these look like and the end of the CRC: a diagnosis opens the same ones for each
/// of its passes.
static KNOWN: Mutex<BTreeMap<(Look, u64), Sums>> = Mutex::new(BTreeMap::new());
/// Most of them.
const MOST_KNOWN: usize = 10_000;
/// Digests that an earlier call of the program has left, and no file of this one has had yet.
static RECALLED: Mutex<BTreeMap<Look, String>> = Mutex::new(BTreeMap::new());

/// What tells whether a file has changed: any write or rename over it changes one of these.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub(crate) struct Look {
    size: u64,
    #[cfg(unix)]
    modified_ns: (i64, i64),
    #[cfg(unix)]
    changed_ns: (i64, i64),
    #[cfg(unix)]
    place: (u64, u64),
    #[cfg(not(unix))]
    modified: Option<SystemTime>,
}

impl Look {
    #[cfg(unix)]
    fn of(stat: &Metadata) -> Self {
        use std::os::unix::fs::MetadataExt as _;
        Self {
            size: stat.len(),
            modified_ns: (stat.mtime(), stat.mtime_nsec()),
            changed_ns: (stat.ctime(), stat.ctime_nsec()),
            place: (stat.dev(), stat.ino()),
        }
    }

    #[cfg(not(unix))]
    fn of(stat: &Metadata) -> Self {
        Self { size: stat.len(), modified: stat.modified().ok() }
    }

    /// When it last changed; none where the system does not tell.
    #[cfg(unix)]
    fn changed(&self) -> Option<SystemTime> {
        let (seconds, nanoseconds) = (u64::try_from(self.changed_ns.0).ok()?, u32::try_from(self.changed_ns.1).ok()?);
        SystemTime::UNIX_EPOCH.checked_add(Duration::new(seconds, nanoseconds))
    }

    #[cfg(not(unix))]
    fn changed(&self) -> Option<SystemTime> {
        None
    }
}

/// Takes digests of an earlier call of the program for those of files that look the same.
pub(crate) fn recall(digests: Vec<(Look, String)>) {
    locked(&RECALLED).extend(digests);
}

/// Digests of the files that this process has had, with what these look like.
pub(crate) fn used() -> Vec<(Look, String)> {
    let known = locked(&KNOWN);
    known
        .iter()
        .filter(|((_, end), _)| *end == 0)
        .map(|((look, _), sums)| (look.clone(), sums.sha256.clone()))
        .collect()
}

fn locked<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Digests of a whole file.
#[derive(Clone, Debug)]
pub(crate) struct Sums {
    /// SHA-256, lower-case hexadecimal.
    pub(crate) sha256: String,
    /// CRC-32 of the bytes before the place that was asked for.
    pub(crate) crc: u32,
}

impl InputFile {
    pub(crate) fn open(path: &Path) -> io::Result<Self> {
        let file = File::open(path)?;
        let opened_as = Look::of(&file.metadata()?);
        let settled = opened_as.changed().is_some_and(|at| at.elapsed().is_ok_and(|age| age > SETTLES));
        Ok(Self { path: path.to_owned(), file, opened_as, settled })
    }

    pub(crate) fn path(&self) -> &Path {
        &self.path
    }

    /// Whether whatever is written to it after it was opened makes it look otherwise.
    pub(crate) fn is_settled(&self) -> bool {
        self.settled
    }

    /// What it looked like when it was opened: a settled file that looks the same later is the same.
    pub(crate) fn look(&self) -> String {
        format!("{:?}", self.opened_as)
    }

    /// Size when it was opened, bytes.
    pub(crate) fn size(&self) -> u64 {
        self.opened_as.size
    }

    /// What the operating system says of it now.
    pub(crate) fn metadata(&self) -> io::Result<Metadata> {
        self.file.metadata()
    }

    /// Keeps it open as long as the program runs; its descriptor.
    #[cfg(unix)]
    pub(crate) fn keep_open(&self) -> io::Result<std::os::fd::RawFd> {
        use std::os::fd::IntoRawFd as _;
        Ok(self.file.try_clone()?.into_raw_fd())
    }

    /// Whether it is the file that was opened, unwritten since.
    pub(crate) fn is_unchanged(&self) -> io::Result<bool> {
        Ok(Look::of(&self.file.metadata()?) == self.opened_as)
    }

    /// Whether its path leads to it still: a plugin opens files by path.
    pub(crate) fn is_in_place(&self) -> io::Result<bool> {
        Ok(Look::of(&std::fs::metadata(&self.path)?) == self.opened_as)
    }

    /// Reads `length` bytes at `offset` into `buffer`, fewer at the end of the file; what the buffer held is gone.
    pub(crate) fn read_range(&self, offset: u64, length: u64, buffer: &mut Vec<u8>) -> io::Result<()> {
        buffer.clear();
        self.reader(offset).take(length).read_to_end(buffer)?;
        Ok(())
    }

    /// Its bytes from `position` on.
    pub(crate) fn reader(&self, position: u64) -> InputReader<'_> {
        InputReader { input: self, position }
    }

    /// Digests of all of it; the CRC covers the bytes before `crc_end`.
    pub(crate) fn sums(&self, crc_end: u64) -> io::Result<Sums> {
        let known = || locked(&KNOWN);
        let key = (self.opened_as.clone(), crc_end);
        if let Some(sums) = known().get(&key).filter(|_| self.settled) {
            return Ok(sums.clone());
        }
        let recalled = if crc_end == 0 && self.settled { locked(&RECALLED).remove(&self.opened_as) } else { None };
        let sums = match recalled {
            Some(sha256) => Sums { sha256, crc: 0 },
            None => self.read_sums(crc_end)?,
        };
        if self.settled && self.is_unchanged()? {
            let mut known = known();
            if known.len() >= MOST_KNOWN {
                known.clear();
            }
            known.insert(key, sums.clone());
        }
        Ok(sums)
    }

    fn read_sums(&self, crc_end: u64) -> io::Result<Sums> {
        let (mut sha256, mut crc) = (Sha256::new(), crc32fast::Hasher::new());
        let mut reader = self.reader(0);
        let mut buffer = vec![0; BUFFER];
        loop {
            let left = usize::try_from(crc_end.saturating_sub(reader.position)).unwrap_or(usize::MAX);
            let count = match reader.read(&mut buffer) {
                Err(error) if error.kind() == io::ErrorKind::Interrupted => continue,
                count => count?,
            };
            if count == 0 {
                break;
            }
            sha256.update(&buffer[..count]);
            crc.update(&buffer[..count.min(left)]);
        }
        Ok(Sums { sha256: dragfree_archive::files::hex(&sha256.finalize()), crc: crc.finalize() })
    }
}

/// A place in an open file. Several read one file, since each has its own position.
#[derive(Debug)]
pub(crate) struct InputReader<'a> {
    input: &'a InputFile,
    position: u64,
}

impl Read for InputReader<'_> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        #[cfg(unix)]
        let count = std::os::unix::fs::FileExt::read_at(&self.input.file, buffer, self.position)?;
        #[cfg(windows)]
        let count = std::os::windows::fs::FileExt::seek_read(&self.input.file, buffer, self.position)?;
        self.position += count as u64;
        Ok(count)
    }
}

impl Seek for InputReader<'_> {
    fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
        let position = match to {
            SeekFrom::Start(position) => Some(position),
            SeekFrom::Current(by) => self.position.checked_add_signed(by),
            SeekFrom::End(by) => self.input.size().checked_add_signed(by),
        };
        self.position = position.ok_or(io::ErrorKind::InvalidInput)?;
        Ok(self.position)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A diagnosis opens its telemetry for each pass: it is hashed once, and again after it has changed.
    #[test]
    fn sums_of_a_settled_file_are_remembered_until_it_changes() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a");
        let sha256 = |path: &Path| InputFile::open(path).unwrap().sums(0).unwrap().sha256;
        std::fs::write(&path, "one").unwrap();
        assert!(!InputFile::open(&path).unwrap().settled, "it may still change within a tick of the clock");
        std::thread::sleep(SETTLES + Duration::from_millis(100));
        let input = InputFile::open(&path).unwrap();
        let key = (input.opened_as.clone(), 0);
        assert!(input.settled && !KNOWN.lock().unwrap().contains_key(&key));
        let one = sha256(&path);
        assert_eq!(KNOWN.lock().unwrap()[&key].sha256, one);
        assert_eq!(sha256(&path), one);
        std::fs::write(&path, "two").unwrap();
        assert_ne!(sha256(&path), one);
    }

    #[test]
    fn sums_are_of_the_bytes_that_are_read() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("file");
        let bytes: Vec<u8> = (0..700_000_u32).map(|k| ((k * 31) >> 3) as u8).collect();
        std::fs::write(&path, &bytes).unwrap();
        let input = InputFile::open(&path).unwrap();
        for end in [0, 1, 262_144, 300_000, 700_000, u64::MAX] {
            let sums = input.sums(end).unwrap();
            let covered = usize::try_from(end).unwrap_or(usize::MAX).min(bytes.len());
            assert_eq!(sums.crc, crc32fast::hash(&bytes[..covered]), "{end}");
            assert_eq!(sums.sha256, dragfree_archive::files::sha256(&bytes));
        }
        let mut part = vec![9; 3];
        input.read_range(699_990, 100, &mut part).unwrap();
        assert_eq!(part, bytes[699_990..]);
    }

    /// A file that was replaced while it was read gave rows of two files, and the digest of the second.
    #[cfg(unix)]
    #[test]
    fn a_replaced_or_rewritten_file_is_noticed() {
        let folder = tempfile::tempdir().unwrap();
        let (path, other) = (folder.path().join("file"), folder.path().join("other"));
        std::fs::write(&path, "one").unwrap();
        let input = InputFile::open(&path).unwrap();
        assert!(input.is_unchanged().unwrap() && input.is_in_place().unwrap());
        std::fs::write(&other, "two").unwrap();
        std::fs::rename(&other, &path).unwrap();
        assert!(!input.is_unchanged().unwrap() && !input.is_in_place().unwrap());
        let mut kept = vec![];
        input.read_range(0, 10, &mut kept).unwrap();
        assert_eq!(kept, b"one", "what is read is what was opened");

        let input = InputFile::open(&path).unwrap();
        let written = std::fs::metadata(&path).unwrap().modified().unwrap();
        std::thread::sleep(Duration::from_millis(20)); // the clock of a file system has ticks
        std::fs::write(&path, "TWO").unwrap();
        File::options().write(true).open(&path).unwrap().set_modified(written).unwrap();
        assert!(!input.is_unchanged().unwrap(), "same size, same time of writing");
    }
}
