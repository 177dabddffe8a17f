//! Sums of several days, kept so that they need not be added again. They are made from products and hold nothing else:
//! each lies under a digest of what it was made from, and may be deleted at any time.

use crate::ArchiveError;
use crate::archive::Archive;
use crate::files::{IoContext as _, hex};
use crate::objects::entries;
use crate::staging::Staging;
use sha2::{Digest as _, Sha256};
use std::fs;
use std::path::{Path, PathBuf};

/// Bytes of the digest at the end of a file.
const DIGEST: usize = 32;

/// Where sums are kept.
#[derive(Clone, Debug)]
pub struct Sums {
    folder: PathBuf,
    /// The archive in whose staging folder files are written first; otherwise the folder is its writer's alone.
    archive: Option<PathBuf>,
    /// Further folders that are looked into.
    more: Vec<PathBuf>,
}

impl Archive {
    /// The sums that the archive keeps.
    pub fn sums(&self) -> Sums {
        Sums { folder: self.folder.join("sums"), archive: Some(self.folder.clone()), more: Vec::new() }
    }
}

impl Sums {
    /// In a folder that nobody else writes into; what is not there is looked for in `more`.
    pub fn apart(folder: &Path, more: Vec<PathBuf>) -> Self {
        Self { folder: folder.to_owned(), archive: None, more }
    }

    /// The content that was kept under a key; none where there is none, or where it is not what was written.
    pub fn get(&self, key: &str) -> Option<Vec<u8>> {
        let name = name(key);
        std::iter::once(&self.folder).chain(&self.more).find_map(|folder| sealed(&folder.join(&name)))
    }

    /// Keeps a content under a key, at once and whole. It only saves time, so that a failure is no matter.
    pub fn keep(&self, key: &str, content: &[u8]) {
        let mut content = content.to_vec();
        content.extend_from_slice(&Sha256::digest(&content));
        if let Err(error) = self.place(&name(key), &content) {
            tracing::debug!("sums are not kept: {error}");
        }
    }

    /// Takes over what another folder keeps and this one does not. Returns how many files that were.
    ///
    /// # Errors
    /// It cannot be read, or not be written.
    pub fn take_over(&self, folder: &Path) -> Result<usize, ArchiveError> {
        let mut count = 0;
        for name in entries(folder)? {
            let path = folder.join(&name);
            if sealed(&path).is_some() && sealed(&self.folder.join(&name)).is_none() {
                self.place(&name, &fs::read(&path).at("read", &path)?)?;
                count += 1;
            }
        }
        Ok(count)
    }

    fn place(&self, name: &str, content: &[u8]) -> Result<(), ArchiveError> {
        let to = self.folder.join(name);
        fs::create_dir_all(&self.folder).at("make the folder", &self.folder)?;
        // A file that a power failure cuts off is noticed by its digest.
        match &self.archive {
            Some(archive) => {
                let staging = Staging::begin(archive)?;
                let staged = staging.path().join(name);
                fs::write(&staged, content).at("write", &staged)?;
                Ok(fs::rename(&staged, &to).at("place", &to)?)
            }
            None => Ok(fs::write(&to, content).at("write", &to)?),
        }
    }
}

/// Name of the file of a key.
fn name(key: &str) -> String {
    hex(&Sha256::digest(key))[..32].to_owned()
}

/// Content of a file without the digest at its end; none where that is another one.
fn sealed(path: &Path) -> Option<Vec<u8>> {
    let mut content = fs::read(path).ok()?;
    let digest = content.split_off(content.len().checked_sub(DIGEST)?);
    (Sha256::digest(&content).as_slice() == digest).then_some(content)
}
