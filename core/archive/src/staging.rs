//! What writers have not committed: a folder for each, held by a lock that its owner's death releases.

use crate::ArchiveError;
use crate::files::IoContext as _;
use crate::objects::entries;
use std::fs::{self, File, TryLockError};
use std::io::ErrorKind;
use std::path::{Path, PathBuf};

/// Name of the list of digests that a writer is about to place; a killed one's are looked through. What a plugin
/// attaches begins with a letter.
const PLACING: &str = ".placing.json";

const LOCK: &str = ".lock";

/// A writer's folder; gone when it is dropped.
#[derive(Debug)]
pub(crate) struct Staging {
    lock: File,
    folder: PathBuf,
}

impl Staging {
    /// Makes one inside of `staging/` of an archive.
    pub(crate) fn begin(archive: &Path) -> Result<Self, ArchiveError> {
        let all = root(archive);
        fs::create_dir_all(&all).at("make the folder", &all)?;
        loop {
            let made = tempfile::Builder::new().prefix("w").suffix(LOCK).tempfile_in(&all);
            let (lock, path) = made.at("write in the archive", &all)?.keep().map_err(|e| e.error).at("write", &all)?;
            lock.lock().at("lock", &path)?;
            // Between its making and its locking, another program may have taken it for a dead writer's.
            if !path.exists() {
                continue;
            }
            let folder = path.with_extension("");
            let staging = Self { lock, folder };
            fs::create_dir(&staging.folder).at("make the folder", &staging.folder)?;
            return Ok(staging);
        }
    }

    pub(crate) fn path(&self) -> &Path {
        &self.folder
    }
}

impl Drop for Staging {
    fn drop(&mut self) {
        // What stays, the next command clears. The folder first: as long as there is a lock, it is held.
        if fs::remove_dir_all(&self.folder).is_ok() || !self.folder.exists() {
            let _ = fs::remove_file(self.folder.with_extension(&LOCK[1..]));
        }
        let _ = self.lock.unlock();
    }
}

fn root(archive: &Path) -> PathBuf {
    archive.join("staging")
}

/// Whether any writer, alive or dead, has a folder.
pub(crate) fn any(archive: &Path) -> Result<bool, ArchiveError> {
    Ok(!entries(&root(archive))?.is_empty())
}

/// Folders of writers that live.
pub(crate) fn held(archive: &Path) -> Vec<PathBuf> {
    let root = root(archive);
    let lives = |lock: &PathBuf| {
        // Shared, so that nobody who looks on keeps another from looking.
        let lock = File::open(lock).map(|file| file.try_lock_shared());
        matches!(lock, Ok(Err(TryLockError::WouldBlock)))
    };
    let locks = entries(&root).unwrap_or_default().into_iter().filter(|name| name.ends_with(LOCK));
    locks.map(|name| root.join(name)).filter(lives).map(|lock| lock.with_extension("")).collect()
}

/// Clears the folders of dead writers. `forget` is told what each was about to place, before its folder is gone: who
/// is killed in between leaves the list to the next.
pub(crate) fn clear_dead(
    archive: &Path,
    mut forget: impl FnMut(Vec<String>) -> Result<(), ArchiveError>,
) -> Result<(), ArchiveError> {
    let root = root(archive);
    let all = entries(&root)?;
    for name in all.iter().filter(|name| name.ends_with(LOCK)) {
        let path = root.join(name);
        let lock = match File::open(&path) {
            Err(error) if error.kind() == ErrorKind::NotFound => continue,
            lock => lock.at("read", &path)?,
        };
        match lock.try_lock() {
            Ok(()) => {}
            Err(TryLockError::WouldBlock) => continue,
            Err(TryLockError::Error(error)) => return Err(error).at("lock", &path).map_err(Into::into),
        }
        let folder = path.with_extension("");
        if let Ok(list) = fs::read(folder.join(PLACING)) {
            // A list that was not written to its end was not acted on.
            forget(serde_json::from_slice(&list).unwrap_or_default())?;
        }
        if folder.exists() {
            fs::remove_dir_all(&folder).at("clear", &folder)?;
        }
        fs::remove_file(&path).at("clear", &path)?;
    }
    // A lock is there before its folder and after it, so one without a lock is nobody's.
    for name in all.iter().filter(|name| !name.ends_with(LOCK) && !all.contains(&format!("{name}{LOCK}"))) {
        let path = root.join(name);
        let cleared = if path.is_dir() { fs::remove_dir_all(&path) } else { fs::remove_file(&path) };
        cleared.at("clear", &path)?;
    }
    Ok(())
}

/// Writes the list of contents that are about to be placed, so that those of a killed writer are found.
pub(crate) fn announce<'a>(staging: &Path, digests: impl Iterator<Item = &'a str>) -> Result<(), ArchiveError> {
    let path = staging.join(PLACING);
    let text = serde_json::to_vec(&digests.collect::<Vec<_>>()).map_err(std::io::Error::from).at("write", &path)?;
    Ok(fs::write(&path, text).at("write", path)?)
}
