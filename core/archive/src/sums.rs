//! Sums of several days, kept so that they need not be added again. They are made from products and hold nothing else:
//! each lies under a digest of what it was made from, and may be deleted at any time.

use crate::archive::Archive;
use crate::files::{IoContext as _, hex, sync_folder};
use crate::staging::Staging;
use sha2::{Digest as _, Sha256};
use std::fs::{self, File};
use std::io::Write as _;
use std::path::PathBuf;

/// Bytes of the digest at the end of a file.
const DIGEST: usize = 32;

impl Archive {
    /// The content that was kept under a key; none where there is none, or where it is not what was written.
    pub fn sums(&self, key: &str) -> Option<Vec<u8>> {
        let mut content = fs::read(self.place_of_sums(key)).ok()?;
        let digest = content.split_off(content.len().checked_sub(DIGEST)?);
        (Sha256::digest(&content).as_slice() == digest).then_some(content)
    }

    /// Keeps a content under a key, at once and whole. It only saves time, so that a failure is no matter.
    pub fn keep_sums(&self, key: &str, content: &[u8]) {
        let keep = || -> Result<(), crate::ArchiveError> {
            let staging = Staging::begin(&self.folder)?;
            let (staged, to) = (staging.path().join("sums"), self.place_of_sums(key));
            let folder = crate::files::folder_of(&to);
            fs::create_dir_all(folder).at("make the folder", folder)?;
            let write = || {
                let mut file = File::create_new(&staged)?;
                file.write_all(content)?;
                file.write_all(&Sha256::digest(content))?;
                file.sync_all()
            };
            write().at("write", &staged)?;
            fs::rename(&staged, &to).at("place", &to)?;
            Ok(sync_folder(folder).at("flush", folder)?)
        };
        if let Err(error) = keep() {
            tracing::debug!("sums are not kept: {error}");
        }
    }

    fn place_of_sums(&self, key: &str) -> PathBuf {
        self.folder.join("sums").join(&hex(&Sha256::digest(key))[..32])
    }
}
