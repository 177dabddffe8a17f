//! Contents by digest: `objects/ab/cdef…`, written once and never changed.

use crate::ArchiveError;
use crate::files::{IoContext as _, sha256, sha256_of, sync_folder};
use std::fs;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};

/// The folder of contents.
#[derive(Clone, Debug)]
pub(crate) struct Objects {
    folder: PathBuf,
}

impl Objects {
    pub(crate) fn new(archive: &Path) -> Self {
        Self { folder: archive.join("objects") }
    }

    /// Where the content with a digest lies, or would lie.
    pub(crate) fn path(&self, sha256: &str) -> PathBuf {
        let (start, rest) = sha256.split_at_checked(2).unwrap_or((sha256, ""));
        self.folder.join(start).join(rest)
    }

    /// Gives a durable file its place; true where nothing was there before. A damaged object is replaced: the digest
    /// says which of the two is right.
    pub(crate) fn place(&self, from: &Path, sha256: &str) -> Result<bool, ArchiveError> {
        let to = self.path(sha256);
        let folder = to.parent().unwrap_or(&self.folder);
        let link = || fs::hard_link(from, &to);
        fs::create_dir_all(folder).at("make the folder", folder)?;
        let new = match link() {
            Ok(()) => true,
            Err(error) if error.kind() == ErrorKind::AlreadyExists => {
                if sha256_of(&to).at("read", &to)? != sha256 {
                    fs::rename(from, &to).at("replace the damaged", &to)?;
                }
                false
            }
            Err(error) => return Err(error).at(PLACE, &to).map_err(Into::into),
        };
        sync_folder(folder).and_then(|()| sync_folder(&self.folder)).at("flush", folder)?;
        Ok(new)
    }

    /// The content with a digest, compared with it.
    pub(crate) fn read(&self, digest: &str) -> Result<Vec<u8>, ArchiveError> {
        let path = self.path(digest);
        let content = fs::read(&path).at("read", &path)?;
        let found = sha256(&content);
        if found == digest {
            Ok(content)
        } else {
            Err(ArchiveError::Damaged { path, reason: format!("its digest is {found}, its name says {digest}") })
        }
    }

    /// Takes away a content that no event names.
    pub(crate) fn remove(&self, sha256: &str) -> Result<(), ArchiveError> {
        let path = self.path(sha256);
        match fs::remove_file(&path) {
            Err(error) if error.kind() != ErrorKind::NotFound => Err(error).at("remove", &path).map_err(Into::into),
            _ => Ok(()),
        }
    }

    /// Digests of everything there is, in order.
    pub(crate) fn all(&self) -> Result<Vec<String>, ArchiveError> {
        let mut all = Vec::new();
        for start in entries(&self.folder)? {
            for rest in entries(&self.folder.join(&start))? {
                all.push(format!("{start}{rest}"));
            }
        }
        all.sort();
        Ok(all)
    }
}

/// What is said where a link fails.
pub(crate) const PLACE: &str = "place (the archive's file system must have hard links)";

/// Names in a folder that are text; none where there is no folder.
pub(crate) fn entries(folder: &Path) -> Result<Vec<String>, ArchiveError> {
    let read = match fs::read_dir(folder) {
        Err(error) if error.kind() == ErrorKind::NotFound => return Ok(Vec::new()),
        read => read.at("read", folder)?,
    };
    let mut names = Vec::new();
    for entry in read {
        names.extend(entry.at("read", folder)?.file_name().into_string().ok());
    }
    names.sort();
    Ok(names)
}
