//! Archiving a product: everything is written apart, placed by digest, and committed by one entry of the journal.

use crate::ArchiveError;
use crate::archive::Archive;
use crate::events::Window;
use crate::files::{IoContext as _, sha256_of, write_durable};
use crate::journal::{Event, InputPlace, Stamp, Stored};
use crate::product::{self, Attachment, EXTRACT, Product, STATE, Supersedes};
use crate::running::{RUNNING, Teller};
use crate::staging::Staging;
use std::collections::BTreeMap;
use std::fs::{self, File};
use std::path::{Path, PathBuf};

/// Revisions have four digits.
pub(crate) const LAST_REVISION: u32 = 9999;

/// A product and where it lies.
#[derive(Clone, Debug)]
pub struct Written {
    /// The product.
    pub product: Product,
    /// Its `.toml`.
    pub path: PathBuf,
}

/// What a product was made of, beside what its document says.
#[derive(Clone, Debug, Default)]
pub struct MadeOf {
    /// Where its inputs lay.
    pub places: Vec<InputPlace>,
    /// The time that was asked for.
    pub window: Window,
    /// Data before it that only settled the stages before the estimators, ns.
    pub run_in_ns: i64,
}

/// Writes one product: ask for [`ProductWriter::staged`] paths, write the files, [`ProductWriter::commit`]. What it
/// writes for itself begins with a dot, what plugins attach with a letter. Dropped without a commit it leaves nothing
/// behind.
#[derive(Debug)]
pub struct ProductWriter {
    archive: Archive,
    staging: Staging,
    attachments: BTreeMap<String, PathBuf>,
    /// Contents that are kept by role, with the names that their files had.
    kept: BTreeMap<String, (String, PathBuf)>,
}

/// A file that is about to be placed.
struct Sealed {
    from: PathBuf,
    sha256: String,
    size: u64,
}

impl ProductWriter {
    /// Opens a transaction in the archive `folder`, which is made where it does not exist.
    ///
    /// # Errors
    /// [`ArchiveError`]: the archive cannot be made, read or written.
    pub fn begin(folder: &Path) -> Result<Self, ArchiveError> {
        let archive = Archive::create(folder)?;
        let staging = Staging::begin(folder)?;
        Ok(Self { archive, staging, attachments: BTreeMap::new(), kept: BTreeMap::new() })
    }

    /// Tells others how far the calibration of `what` has come.
    pub fn teller(&self, what: &str) -> Teller {
        Teller::new(self.staging.path().join(RUNNING), what.to_owned())
    }

    /// Path at which the caller writes the file that will lie beside the product as `ID.suffix`.
    pub fn staged(&mut self, suffix: &str) -> PathBuf {
        let path = self.staging.path().join(suffix);
        self.attachments.insert(suffix.to_owned(), path.clone());
        path
    }

    /// Writes what `stage` attaches.
    ///
    /// # Errors
    /// The suffix cannot end a file name or is taken.
    pub fn attach(&mut self, stage: &str, suffix: &str, text: &str) -> Result<(), ArchiveError> {
        let refuse = |reason| ArchiveError::Attachment { stage: stage.to_owned(), suffix: suffix.to_owned(), reason };
        let plain = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || matches!(c, '.' | '-' | '_');
        if !suffix.starts_with(|c: char| c.is_ascii_lowercase()) || !suffix.chars().all(plain) {
            return Err(refuse("a suffix is lower-case letters, digits, '.', '-' and '_', a letter first"));
        }
        if ["toml", STATE, EXTRACT].contains(&suffix) || self.attachments.contains_key(suffix) {
            return Err(refuse("that file exists already"));
        }
        let path = self.staged(suffix);
        Ok(fs::write(&path, text).at("write", path)?)
    }

    /// Keeps a content that the product was made of, or left, by its role; `name` is that of its file.
    ///
    /// # Errors
    /// It cannot be written.
    pub fn keep(&mut self, role: &str, name: &str, content: &[u8]) -> Result<(), ArchiveError> {
        let path = self.staging.path().join(format!(".{role}.kept"));
        fs::write(&path, content).at("write", &path)?;
        self.kept.insert(role.to_owned(), (name.to_owned(), path));
        Ok(())
    }

    /// Archives a product that has no revision yet as the next one of its day.
    ///
    /// # Errors
    /// [`ArchiveError`]; nothing is left in the archive then.
    pub fn commit(self, product: &Product, made_of: MadeOf, stamp: &Stamp<'_>) -> Result<Written, ArchiveError> {
        self.archived(product, made_of, stamp, false).map(|(written, _)| written)
    }

    /// As [`Self::commit`]; where the newest revision is the same, that is given, and false.
    ///
    /// # Errors
    /// As [`Self::commit`].
    pub fn commit_if_new(
        self,
        product: &Product,
        made_of: MadeOf,
        stamp: &Stamp<'_>,
    ) -> Result<(Written, bool), ArchiveError> {
        self.archived(product, made_of, stamp, true)
    }

    fn archived(
        mut self,
        product: &Product,
        made_of: MadeOf,
        stamp: &Stamp<'_>,
        only_new: bool,
    ) -> Result<(Written, bool), ArchiveError> {
        let mut sealed = Vec::new();
        let mut attachments = Vec::new();
        for (suffix, path) in &self.attachments {
            let file = seal(path)?;
            attachments.push(Attachment { suffix: suffix.clone(), size: file.size, sha256: file.sha256.clone() });
            sealed.push(file);
        }
        let mut kept = BTreeMap::new();
        for (role, (name, path)) in &self.kept {
            let file = seal(path)?;
            kept.insert(role.clone(), Stored { name: name.clone(), sha256: file.sha256.clone(), size: file.size });
            sealed.push(file);
        }
        let _held = self.archive.hold()?;
        self.archive.finish()?;
        let (revision, supersedes) = self.follows(product, &attachments)?;
        let product = product.numbered(revision, attachments, supersedes);
        let before = product.supersedes.as_ref().filter(|old| only_new && old.sha256 == product.digest());
        if let Some(Supersedes { id, .. }) = before {
            let path = self.archive.path_of(id);
            return Ok((Written { product: product::read(&path)?, path }, false));
        }
        let document = self.staging.path().join(".product.toml");
        let text = product.emit()?;
        write_durable(&document, text.as_bytes())?;
        let back = fs::read_to_string(&document).at("read", &document)?;
        if product::parse(&back, &document)?.document() != product.document() {
            let reason = "it does not read as it was written".to_owned();
            return Err(ArchiveError::Damaged { path: document, reason });
        }
        let document = seal(&document)?;
        let event = Event::Product {
            id: product.id().to_owned(),
            sha256: document.sha256.clone(),
            made_of: kept,
            places: made_of.places,
            from_ns: made_of.window.from_ns,
            until_ns: made_of.window.until_ns,
            run_in_ns: made_of.run_in_ns,
        };
        sealed.push(document);
        let contents: Vec<_> = sealed.into_iter().map(|file| (file.from, file.sha256)).collect();
        self.archive.place_and_commit(&self.staging, &contents, event, stamp)?;
        Ok((Written { path: self.archive.path_of(product.id()), product }, true))
    }

    /// The revision that comes next, and what it takes the place of.
    fn follows(
        &self,
        product: &Product,
        attachments: &[Attachment],
    ) -> Result<(u32, Option<Supersedes>), ArchiveError> {
        let stem = product.id();
        let same = "substr(p.id, 1, length(p.id) - 5) = ?1";
        let mut earlier = self.archive.catalogue.products(same, [stem])?;
        let revision = earlier.last().map_or(1, |row| row.revision + 1);
        if revision > LAST_REVISION {
            return Err(ArchiveError::Full(stem.to_owned()));
        }
        earlier.retain(|row| row.problem.is_none());
        let old = earlier.pop().and_then(|row| product::read(&self.archive.path_of(&row.id)).ok());
        let new = Product { attachments: attachments.to_vec(), ..product.clone() };
        Ok((revision, old.map(|old| Supersedes::new(&old, &new))))
    }
}

/// Makes a staged file durable and takes its digest.
fn seal(path: &Path) -> Result<Sealed, ArchiveError> {
    let file = File::open(path).at("read", path)?;
    file.sync_all().at("write", path)?;
    let size = file.metadata().at("read", path)?.len();
    Ok(Sealed { from: path.to_owned(), sha256: sha256_of(path).at("read", path)?, size })
}
