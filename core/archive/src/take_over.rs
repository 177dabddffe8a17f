//! Products of other archives, taken over in one step: what workers of a campaign have made, each in an archive of its
//! own.

use crate::ArchiveError;
use crate::archive::Archive;
use crate::catalogue::{Place, Row};
use crate::files::{IoContext as _, sha256, write_durable};
use crate::journal::{Event, InputPlace, Stamp, Stored};
use crate::product::{self, EXTRACT, PRODUCT, Product, Supersedes};
use crate::staging::Staging;
use crate::writer::LAST_REVISION;
use std::collections::BTreeMap;
use std::fs::{self, File};
use std::path::{Path, PathBuf};

/// A product of another archive, with what an event says of it.
struct Found {
    product: Product,
    made_of: BTreeMap<String, Stored>,
    places: Vec<InputPlace>,
    row: Row,
}

impl Found {
    fn read(folder: &Path, id: &str) -> Result<Self, ArchiveError> {
        let from = Archive::open(folder)?;
        let kept = |place: Place| (place.role, Stored { name: place.name, sha256: place.sha256, size: place.size });
        let seen = |place: Place| Some(InputPlace { sha256: place.sha256, path: place.path? });
        Ok(Self {
            product: from.product(id)?,
            made_of: from.all_made_of(id)?.into_iter().map(kept).collect(),
            places: from.inputs(id)?.into_iter().filter_map(seen).collect(),
            row: from.row(id)?,
        })
    }
}

/// What is about to be placed: digest and staged file of each content.
type Contents = BTreeMap<String, PathBuf>;

impl Archive {
    /// Takes over products, each from an archive in a folder, with all their files: all of them or none, as the next
    /// revisions of their days, in the order that is given. One whose newest revision here is the same is left out.
    /// Returns the ids of those that were taken over.
    ///
    /// # Errors
    /// A product or a file of it is damaged or gone, or an archive cannot be read or written.
    pub fn take_over(
        &mut self,
        products: &[(PathBuf, String)],
        stamp: &Stamp<'_>,
    ) -> Result<Vec<String>, ArchiveError> {
        let staging = Staging::begin(&self.folder)?;
        let mut contents = Contents::new();
        let mut all = Vec::new();
        // Before the archive is held: others wait for it, and the copies of many days take long.
        for (folder, id) in products {
            let found = Found::read(folder, id)?;
            let (_, newest) = self.newest_revision(found.row.stem())?;
            if newest.is_none_or(|newest| digest(&newest) != digest(&found.product)) {
                copy(staging.path(), folder, id, &mut contents)?;
            }
            all.push((folder, id, found));
        }
        let _held = self.hold()?;
        self.finish()?;
        let mut newest: BTreeMap<String, (u32, Option<Product>)> = BTreeMap::new();
        let (mut ids, mut events) = (Vec::new(), Vec::new());
        for (folder, id, found) in all {
            let stem = found.row.stem().to_owned();
            let (revision, before) = match newest.remove(&stem) {
                Some(known) => known,
                None => self.newest_revision(&stem)?,
            };
            if before.as_ref().is_some_and(|before| digest(before) == digest(&found.product)) {
                newest.insert(stem, (revision, before));
                continue;
            }
            if revision == LAST_REVISION {
                return Err(ArchiveError::Full(stem));
            }
            // What somebody has added meanwhile may have left something to copy.
            copy(staging.path(), folder, id, &mut contents)?;
            let apart = found.product.unnumbered(&stem);
            let supersedes = before.map(|before| Supersedes::new(&before, &apart));
            let product = apart.numbered(revision + 1, found.product.attachments.clone(), supersedes);
            let text = product.emit()?;
            let document = sha256(&text);
            let staged = staging.path().join(&document);
            write_durable(&staged, text.as_bytes())?;
            contents.insert(document.clone(), staged);
            ids.push(product.id().to_owned());
            events.push(Event::Product {
                id: product.id().to_owned(),
                sha256: document,
                made_of: found.made_of,
                places: found.places,
                from_ns: found.row.asked_from_ns,
                until_ns: found.row.asked_until_ns,
                run_in_ns: found.row.run_in_ns,
            });
            newest.insert(stem, (revision + 1, Some(product)));
        }
        if ids.is_empty() {
            return Ok(ids);
        }
        let contents: Vec<_> = contents.into_iter().map(|(sha256, path)| (path, sha256)).collect();
        self.place_and_commit(&staging, &contents, Event::Several { events }, stamp)?;
        Ok(ids)
    }

    /// The newest revision of a product, 0 where there is none, and itself where it is sound.
    fn newest_revision(&self, stem: &str) -> Result<(u32, Option<Product>), ArchiveError> {
        let mut rows = self.catalogue.products("substr(p.id, 1, length(p.id) - 5) = ?1", [stem])?;
        let revision = rows.last().map_or(0, |row| row.revision);
        rows.retain(|row| row.problem.is_none());
        Ok((revision, rows.pop().and_then(|row| product::read(&self.path_of(&row.id)).ok())))
    }
}

/// Digest of what a product found and from what.
fn digest(product: &Product) -> &str {
    &product.header.non_standard_attributes.sha256
}

/// Copies what is beside a product's document, and what it was made of, into the staging folder; what is there already
/// stays. A link would let who writes over a result write over the archive.
fn copy(staging: &Path, folder: &Path, id: &str, contents: &mut Contents) -> Result<(), ArchiveError> {
    let from = Archive::open(folder)?;
    // The document has another name here; an extract is no part of a product.
    let beside = |suffix: &str| ![PRODUCT, EXTRACT].contains(&suffix);
    let files = from.files_of(id)?.into_iter().filter(|(suffix, ..)| beside(suffix)).map(|(_, sha256, _)| sha256);
    let made_of = from.all_made_of(id)?.into_iter().map(|place| place.sha256);
    for digest in files.chain(made_of) {
        if contents.contains_key(&digest) {
            continue;
        }
        let (source, staged) = (from.objects.path(&digest), staging.join(&digest));
        fs::copy(&source, &staged).at("copy", &source)?;
        File::open(&staged).and_then(|file| file.sync_all()).at("write", &staged)?;
        let found = crate::files::sha256_of(&staged).at("read", &staged)?;
        if found != digest {
            let reason = format!("its digest is {found}, its name says {digest}");
            return Err(ArchiveError::Damaged { path: source, reason });
        }
        contents.insert(digest, staged);
    }
    Ok(())
}
