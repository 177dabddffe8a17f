//! Products of other archives, taken over in one step: what workers of a campaign have made, each in an archive of its
//! own.

use crate::ArchiveError;
use crate::archive::Archive;
use crate::files::{IoContext as _, sha256, write_durable};
use crate::journal::{Event, InputPlace, Stamp, Stored};
use crate::product::{self, EXTRACT, PRODUCT, Product, Supersedes};
use crate::staging::Staging;
use crate::writer::LAST_REVISION;
use std::collections::BTreeMap;
use std::fs::{self, File};
use std::path::{Path, PathBuf};

/// What is about to be placed.
struct Prepared {
    /// Digest and staged file of each content.
    contents: BTreeMap<String, PathBuf>,
    events: Vec<Event>,
}

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
        let _held = self.hold()?;
        self.finish()?;
        let mut newest: BTreeMap<String, (u32, Option<Product>)> = BTreeMap::new();
        let mut prepared = Prepared { contents: BTreeMap::new(), events: Vec::new() };
        let mut ids = Vec::new();
        for (folder, id) in products {
            let from = Self::open(folder)?;
            let product = from.product(id)?;
            let stem = crate::catalogue::stem(id).to_owned();
            let (revision, before) = match newest.remove(&stem) {
                Some(known) => known,
                None => self.newest_revision(&stem)?,
            };
            let digest = |product: &Product| product.header.non_standard_attributes.sha256.clone();
            if before.as_ref().is_some_and(|before| digest(before) == digest(&product)) {
                newest.insert(stem, (revision, before));
                continue;
            }
            if revision == LAST_REVISION {
                return Err(ArchiveError::Full(stem));
            }
            let apart = product.unnumbered(&stem);
            let supersedes = before.map(|before| Supersedes::new(&before, &apart));
            let product = apart.numbered(revision + 1, product.attachments.clone(), supersedes);
            ids.push(product.id().to_owned());
            prepared.product(staging.path(), (&from, id), &product)?;
            newest.insert(stem, (revision + 1, Some(product)));
        }
        if ids.is_empty() {
            return Ok(ids);
        }
        let contents: Vec<_> = prepared.contents.into_iter().map(|(sha256, path)| (path, sha256)).collect();
        self.place_and_commit(&staging, &contents, Event::Several { events: prepared.events }, stamp)?;
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

impl Prepared {
    /// Stages the files of a product and what it was made of, and its document under its new name.
    fn product(&mut self, staging: &Path, (from, id): (&Archive, &str), product: &Product) -> Result<(), ArchiveError> {
        let row = from.row(id)?;
        // The document has another name here; an extract is no part of a product.
        let beside = |suffix: &str| ![PRODUCT, EXTRACT].contains(&suffix);
        for (_, sha256, _) in from.files_of(id)?.into_iter().filter(|(suffix, ..)| beside(suffix)) {
            self.stage(staging, from, &sha256)?;
        }
        let mut made_of = BTreeMap::new();
        for place in from.all_made_of(id)? {
            self.stage(staging, from, &place.sha256)?;
            let kept = Stored { name: place.name, sha256: place.sha256, size: place.size };
            made_of.insert(place.role, kept);
        }
        let text = product.emit()?;
        let document = sha256(&text);
        let staged = staging.join(&document);
        write_durable(&staged, text.as_bytes())?;
        self.contents.insert(document.clone(), staged);
        let places = from.inputs(id)?.into_iter().filter_map(|place| {
            let (path, sha256) = (place.path?, place.sha256);
            Some(InputPlace { sha256, path })
        });
        self.events.push(Event::Product {
            id: product.id().to_owned(),
            sha256: document,
            made_of,
            places: places.collect(),
            from_ns: row.asked_from_ns,
            until_ns: row.asked_until_ns,
            run_in_ns: row.run_in_ns,
        });
        Ok(())
    }

    /// Copies a content into the staging folder: a link would let who writes over a result write over the archive.
    fn stage(&mut self, staging: &Path, from: &Archive, digest: &str) -> Result<(), ArchiveError> {
        if self.contents.contains_key(digest) {
            return Ok(());
        }
        let (source, staged) = (from.objects.path(digest), staging.join(digest));
        fs::copy(&source, &staged).at("copy", &source)?;
        File::open(&staged).and_then(|file| file.sync_all()).at("write", &staged)?;
        let found = crate::files::sha256_of(&staged).at("read", &staged)?;
        if found != digest {
            let reason = format!("its digest is {found}, its name says {digest}");
            return Err(ArchiveError::Damaged { path: source, reason });
        }
        self.contents.insert(digest.to_owned(), staged);
        Ok(())
    }
}
