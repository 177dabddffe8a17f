//! Damaged files of a product, put back from the same product made again.

use crate::ArchiveError;
use crate::archive::Archive;
use crate::catalogue::Row;
use crate::files::{self, IoContext as _, sha256_of};
use crate::product::{self, PRODUCT, Product, Supersedes};
use crate::staging::Staging;
use std::fs::{self, File};
use std::path::Path;

impl Archive {
    /// Puts back files of a product that are damaged or gone, where the same product made again in another archive has
    /// them with their digest. Returns their suffixes.
    ///
    /// # Errors
    /// An archive cannot be read or written.
    pub fn mend(&mut self, id: &str, other: &Self, again: &Product) -> Result<Vec<String>, ArchiveError> {
        let staging = Staging::begin(&self.folder)?;
        let _held = self.hold()?;
        self.finish()?;
        let mut found = other.files_of(again.id())?;
        for role in ["pipeline", "mission", "model", "state_in"] {
            let kept = other.made_of(again.id(), role)?;
            found.extend(kept.map(|place| (String::new(), place.sha256, place.size)));
        }
        let mut mended = Vec::new();
        for (suffix, sha256, _) in self.files_of(id)? {
            let name = self.folder.join(format!("{id}.{suffix}"));
            let whole = |path: &Path| sha256_of(path).is_ok_and(|found| found == sha256);
            if whole(&name) && whole(&self.objects.path(&sha256)) {
                continue;
            }
            let staged = staging.path().join(&suffix);
            if suffix == PRODUCT {
                let row = self.row(id)?;
                let supersedes = self.supersedes_of(&row, again)?;
                let stem = id.rsplit_once('_').map_or(id, |(stem, _)| stem);
                let attachments = again.attachments.clone();
                let text = again.unnumbered(stem).numbered(row.revision, attachments, supersedes).emit()?;
                if files::sha256(&text) != sha256 {
                    continue;
                }
                fs::write(&staged, text).at("write", &staged)?;
            } else if found.iter().any(|(_, other, _)| *other == sha256) {
                fs::copy(other.objects.path(&sha256), &staged).at("write", &staged)?;
            } else {
                continue;
            }
            File::open(&staged).and_then(|file| file.sync_all()).at("write", &staged)?;
            self.objects.place(&staged, &sha256)?;
            self.give_name(id, &suffix, &sha256)?;
            mended.push(suffix);
        }
        if mended.iter().any(|suffix| suffix == PRODUCT) {
            self.catalogue.clear()?;
            self.catch_up()?;
        }
        Ok(mended)
    }

    /// What the document of a product said that it supersedes, as far as the archive still knows.
    fn supersedes_of(&self, row: &Row, again: &Product) -> Result<Option<Supersedes>, ArchiveError> {
        let stem = row.id.rsplit_once('_').map_or("", |(stem, _)| stem);
        let mut earlier = self.catalogue.products("substr(p.id, 1, length(p.id) - 5) = ?1", [stem])?;
        earlier.retain(|other| other.number < row.number && other.problem.is_none());
        let Some(before) = earlier.pop() else { return Ok(None) };
        let old = product::read(&self.path_of(&before.id))?;
        Ok(Some(Supersedes::new(&old, again)))
    }

    /// Compares the contents that the archive keeps for a product with their digests.
    ///
    /// # Errors
    /// One is gone or damaged.
    pub fn verify_kept(&self, id: &str) -> Result<(), ArchiveError> {
        for place in self.catalogue.made_of(id)? {
            self.objects.read(&place.sha256)?;
        }
        Ok(())
    }
}
