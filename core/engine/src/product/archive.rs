//! The archive: a folder of products. Writing is a transaction, reading trusts nothing.
//!
//! Files are made in a hidden folder inside the archive and hard-linked to their names, which fails where a name is
//! taken, so nothing is ever overwritten. The `.toml` comes last: a product exists when it is complete. A claim file
//! keeps two writers from mixing their attachments under one revision.

use super::ProductError;
use super::draft::{self, Draft};
use super::file::{self, Attachment, Product, Supersedes};
use crate::files::{IoContext as _, Problem, folder_of, sha256_of, sync_folder};
use chrono::NaiveDate;
use dragfree_schema::Report;
use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io::{ErrorKind, Write as _};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// A claim that stays longer is one that a killed writer left.
const PATIENCE: Duration = Duration::from_secs(5);

/// Suffix of the file that says where the inputs lay. No product lists it: places change, content does not.
pub(crate) const SOURCES: &str = "sources.json";

/// Suffixes of files that no product lists, since they come later or change.
const UNLISTED: [&str; 2] = [SOURCES, EXTRACT];

/// Suffix of what a diagnosis of a product keeps for later ones.
pub const EXTRACT: &str = "extract.json";

/// Revisions have four digits.
const LAST_REVISION: u32 = 9999;

/// A product and where it lies.
#[derive(Clone, Debug)]
pub struct Written {
    /// The product.
    pub product: Product,
    /// Its `.toml`.
    pub path: PathBuf,
}

/// Writes one product: ask for [`ProductWriter::staged`] paths, write the files, [`ProductWriter::commit`].
/// Dropped without a commit it leaves nothing behind.
#[derive(Debug)]
pub struct ProductWriter {
    archive: PathBuf,
    staging: tempfile::TempDir,
    staged: BTreeMap<String, PathBuf>,
    beside: BTreeMap<String, PathBuf>,
}

/// Writes what a diagnosis keeps of a product beside it, in one step: another reader sees the whole file or what was
/// there before.
///
/// # Errors
/// [`ProductError::Io`]: the archive cannot be written.
pub fn write_extract(product: &Path, content: &[u8]) -> Result<PathBuf, ProductError> {
    let path = product.with_extension(EXTRACT);
    let archive = folder_of(&path);
    // The folder is that of a writer, so that what a killed one leaves is known as such.
    let staging =
        tempfile::Builder::new().prefix(".staging-").tempdir_in(archive).at("write in the archive", archive)?;
    let staged = staging.path().join(EXTRACT);
    let mut file = File::create(&staged).at("write", &staged)?;
    file.write_all(content).and_then(|()| file.sync_all()).at("write", &staged)?;
    fs::rename(&staged, &path).at("write", &path)?;
    sync_folder(archive).at("write in the archive", archive)?;
    Ok(path)
}

impl ProductWriter {
    /// Opens a transaction in the folder `archive`, which is made where it does not exist.
    ///
    /// # Errors
    /// [`ProductError::Io`]: the folder cannot be made or written.
    pub fn begin(archive: &Path) -> Result<Self, ProductError> {
        fs::create_dir_all(archive).at("make the archive", archive)?;
        let staging = tempfile::Builder::new().prefix(".staging-").tempdir_in(archive);
        let staging = staging.at("write in the archive", archive)?;
        Ok(Self { archive: archive.to_owned(), staging, staged: BTreeMap::new(), beside: BTreeMap::new() })
    }

    /// Path at which the caller writes the file that will lie beside the product as `ID.suffix`.
    pub fn staged(&mut self, suffix: &str) -> PathBuf {
        let path = self.staging.path().join(suffix);
        self.staged.insert(suffix.to_owned(), path.clone());
        path
    }

    /// The same for a file that the product does not list, since what it holds may change: where the inputs lay.
    pub(crate) fn staged_unlisted(&mut self, suffix: &str) -> PathBuf {
        let path = self.staging.path().join(suffix);
        self.beside.insert(suffix.to_owned(), path.clone());
        path
    }

    /// Writes the product of `draft` as the next free revision of its day.
    ///
    /// # Errors
    /// [`ProductError`]; nothing is left in the archive then.
    pub fn commit(self, draft: &Draft) -> Result<Written, ProductError> {
        self.commit_with(draft, || Ok(()))
    }

    /// The same; `last_step` runs once every file has its name, and the product stays only if it succeeds.
    ///
    /// # Errors
    /// [`ProductError`] or the error of `last_step`; nothing is left in the archive then.
    pub fn commit_with<E: From<ProductError>>(
        mut self,
        draft: &Draft,
        last_step: impl FnOnce() -> Result<(), E>,
    ) -> Result<Written, E> {
        let stem = draft::stem(draft)?;
        self.attach(&draft.reports)?;
        let attachments = self.staged.iter().map(|(suffix, path)| seal(suffix, path));
        let attachments = attachments.collect::<Result<Vec<_>, _>>()?;
        let mut revision = 1;
        let mut waiting = (revision, Instant::now());
        loop {
            revision = next_free(&self.archive, &stem, revision)?;
            if waiting.0 != revision {
                waiting = (revision, Instant::now());
            }
            let Some(claim) = Claim::take(&self.archive, &stem, revision)? else {
                // Whoever has it may still give it up, and the next would be written over a gap.
                if waiting.1.elapsed() < PATIENCE {
                    std::thread::sleep(PATIENCE / 500);
                } else {
                    revision += 1;
                }
                continue;
            };
            // Another writer may have finished between the look and the claim.
            if next_free(&self.archive, &stem, revision)? == revision {
                let supersedes = superseded(&self.archive, &stem, draft, &attachments)?;
                let product = draft::product(draft, revision, attachments, supersedes)?;
                let (placed, path) = self.place(&product)?;
                last_step()?;
                placed.keep();
                drop(claim);
                return Ok(Written { product, path });
            }
        }
    }

    /// Writes the attachments of the reports.
    fn attach(&mut self, reports: &[Report]) -> Result<(), ProductError> {
        for report in reports {
            for attachment in &report.attachments {
                let suffix = &attachment.suffix;
                let refuse =
                    |reason| ProductError::Attachment { stage: report.plugin.clone(), suffix: suffix.clone(), reason };
                let plain = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || matches!(c, '.' | '-' | '_');
                if !suffix.starts_with(|c: char| c.is_ascii_lowercase()) || !suffix.chars().all(plain) {
                    return Err(refuse("a suffix is lower-case letters, digits, '.', '-' and '_', a letter first"));
                }
                if suffix == "toml" || self.staged.contains_key(suffix) || self.beside.contains_key(suffix) {
                    return Err(refuse("that file exists already"));
                }
                let path = self.staged(suffix);
                fs::write(&path, &attachment.text).at("write", path)?;
            }
        }
        Ok(())
    }

    /// Gives every staged file its name, the product last; the names are taken away again unless they are kept.
    fn place(&self, product: &Product) -> Result<(Placed, PathBuf), ProductError> {
        let staged = self.staging.path().join("product.toml");
        let text = product.emit()?;
        let write = || {
            let mut file = File::create_new(&staged)?;
            file.write_all(text.as_bytes())?;
            file.sync_all()
        };
        write().at("write", &staged)?;
        let back = fs::read_to_string(&staged).at("read", &staged)?;
        if file::parse(&back, &staged)?.document() != product.document() {
            return Err(ProductError::Damaged { path: staged, reason: "it does not read as it was written".into() });
        }
        let mut placed = Placed::default();
        for (suffix, from) in self.staged.iter().chain(&self.beside) {
            placed.link(from, self.archive.join(format!("{}.{suffix}", product.id())))?;
        }
        sync_folder(&self.archive).at("write", &self.archive)?;
        let path = self.archive.join(format!("{}.toml", product.id()));
        placed.link(&staged, path.clone())?;
        sync_folder(&self.archive).at("write", &self.archive)?;
        Ok((placed, path))
    }
}

/// Makes a staged file durable and takes its digest.
fn seal(suffix: &str, path: &Path) -> Result<Attachment, ProductError> {
    let file = File::open(path).at("read", path)?;
    file.sync_all().at("write", path)?;
    let size = file.metadata().at("read", path)?.len();
    Ok(Attachment { suffix: suffix.to_owned(), size, sha256: sha256_of(path).at("read", path)? })
}

/// The right to write one revision: a hidden file that only one writer can make.
struct Claim(PathBuf);

impl Claim {
    /// `None` where another writer has it. A claim that a killed writer left costs one revision number, no more.
    fn take(archive: &Path, stem: &str, revision: u32) -> Result<Option<Self>, ProductError> {
        let path = archive.join(format!(".{stem}_{revision:04}.claim"));
        match File::create_new(&path) {
            Err(error) if error.kind() == ErrorKind::AlreadyExists => Ok(None),
            made => {
                made.at("write", &path)?;
                Ok(Some(Self(path)))
            }
        }
    }
}

impl Drop for Claim {
    fn drop(&mut self) {
        let _ = fs::remove_file(&self.0); // a claim that stays costs a revision number
    }
}

/// Files that have their names, taken away again unless the whole product has.
#[derive(Default)]
struct Placed(Vec<PathBuf>);

impl Placed {
    fn link(&mut self, from: &Path, to: PathBuf) -> Result<(), ProductError> {
        fs::hard_link(from, &to).at("place (the archive's file system must have hard links)", &to)?;
        self.0.push(to);
        Ok(())
    }

    fn keep(mut self) {
        self.0.clear();
    }
}

impl Drop for Placed {
    fn drop(&mut self) {
        for path in &self.0 {
            let _ = fs::remove_file(path); // already failing; what stays is reported by `list`
        }
    }
}

/// The first revision from `from` on after every one that has a file in the archive.
fn next_free(archive: &Path, stem: &str, from: u32) -> Result<u32, ProductError> {
    let taken = names(archive)?.into_iter().filter_map(|name| {
        let revision = name.strip_prefix(stem)?.strip_prefix('_')?.get(..4)?;
        revision.parse::<u32>().ok()
    });
    let next = taken.max().map_or(1, |last| last + 1).max(from);
    if next > LAST_REVISION { Err(ProductError::Full(stem.to_owned())) } else { Ok(next) }
}

/// Names in the archive that are text and not hidden, in order.
fn names(archive: &Path) -> Result<Vec<String>, ProductError> {
    let mut names = Vec::new();
    for entry in fs::read_dir(archive).at("read the archive", archive)? {
        let entry = entry.at("read the archive", archive)?;
        if let Ok(name) = entry.file_name().into_string()
            && !name.starts_with('.')
        {
            names.push(name);
        }
    }
    names.sort();
    Ok(names)
}

/// What the new product takes the place of, and what changed since.
fn superseded(
    archive: &Path,
    stem: &str,
    draft: &Draft,
    attachments: &[Attachment],
) -> Result<Option<Supersedes>, ProductError> {
    let earlier = names(archive)?.into_iter().rev().filter(|name| name.starts_with(stem) && name.ends_with(".toml"));
    let Some(old) = earlier.filter_map(|name| file::read(&archive.join(name)).ok()).next() else {
        return Ok(None);
    };
    let new = draft::product(draft, 1, attachments.to_vec(), None)?;
    let sha256 = old.header.non_standard_attributes.sha256.clone();
    let changed = [
        ("inputs", old.inputs != new.inputs),
        ("plugins or their parameters", old.history != new.history),
        ("program", software(&old) != software(&new)),
        ("window", window(&old) != window(&new)),
    ];
    let changed: Vec<&str> = changed.into_iter().filter_map(|(what, differs)| differs.then_some(what)).collect();
    let reason = match changed.as_slice() {
        [] if sha256 == new.digest() => "run again, same result".to_owned(),
        [] => "run again with the same inputs, plugins and parameters".to_owned(),
        changed => format!("changed: {}", changed.join(", ")),
    };
    Ok(Some(Supersedes { id: old.id().to_owned(), sha256, reason }))
}

fn software(product: &Product) -> &str {
    &product.header.non_standard_attributes.software_version
}

fn window(product: &Product) -> (i64, i64) {
    let attributes = &product.header.non_standard_attributes;
    (attributes.start_time_epoch_ns, attributes.stop_time_epoch_ns)
}

/// What an archive holds.
#[derive(Clone, Debug, Default)]
pub struct Listing {
    /// Products by day, spacecraft, name, release and revision.
    pub entries: Vec<Entry>,
    /// Files that are no sound product; nothing is done to them.
    pub problems: Vec<Problem>,
}

/// A product in an archive.
#[derive(Clone, Debug)]
pub struct Entry {
    /// The product.
    pub product: Product,
    /// Its `.toml`.
    pub path: PathBuf,
    /// True for the highest revision of the highest release of its day and spacecraft.
    pub latest: bool,
}

impl Entry {
    /// The id without the revision.
    fn stem(&self) -> &str {
        self.product.id().rsplit_once('_').map_or("", |(stem, _)| stem)
    }

    /// Product, day and spacecraft: what the releases and revisions have in common.
    fn series(&self) -> (String, String, String) {
        let attributes = &self.product.header.non_standard_attributes;
        let platform = &self.product.header.global_attributes.platform;
        (attributes.day.clone(), platform.clone(), attributes.product.clone())
    }
}

/// Lists an archive. What is damaged or foreign is reported beside the products.
///
/// # Errors
/// [`ProductError::Io`]: the folder itself cannot be read.
pub fn list(archive: &Path) -> Result<Listing, ProductError> {
    let mut listing = Listing::default();
    let names = names(archive)?;
    for name in names.iter().filter(|name| name.ends_with(".toml")) {
        let path = archive.join(name);
        match file::read(&path).and_then(|product| complete(product, &path)) {
            Ok(product) => listing.entries.push(Entry { product, path, latest: false }),
            Err(error) => listing.problems.push(Problem { path, reason: error.to_string() }),
        }
    }
    for name in names.iter().filter(|name| !name.ends_with(".toml")) {
        let owned = |entry: &Entry| {
            let suffix = name.strip_prefix(entry.product.id()).and_then(|rest| rest.strip_prefix('.'));
            suffix.is_some_and(|suffix| {
                UNLISTED.contains(&suffix) || entry.product.attachments.iter().any(|file| file.suffix == suffix)
            })
        };
        if !listing.entries.iter().any(owned) {
            let reason = "belongs to no sound product; a run that was stopped may have left it".to_owned();
            listing.problems.push(Problem { path: archive.join(name), reason });
        }
    }
    let order = |entry: &Entry| {
        let attributes = &entry.product.header.non_standard_attributes;
        (entry.series(), attributes.release, attributes.revision)
    };
    listing.entries.sort_by_key(order);
    for index in 0..listing.entries.len() {
        let next = listing.entries.get(index + 1).map(Entry::series);
        listing.entries[index].latest = next != Some(listing.entries[index].series());
    }
    Ok(listing)
}

/// Checks that the files beside the product are there in full length.
fn complete(product: Product, path: &Path) -> Result<Product, ProductError> {
    for attachment in &product.attachments {
        let beside = path.with_extension(&attachment.suffix);
        let size = fs::metadata(&beside).at("read", &beside)?.len();
        if size != attachment.size {
            let reason = format!("it has {size} bytes, the product says {}", attachment.size);
            return Err(ProductError::Damaged { path: beside, reason });
        }
    }
    Ok(product)
}

/// Finds a product by its id, by its id without the revision (the latest one then) or by its day.
///
/// # Errors
/// [`ProductError`]: there is none, or it is damaged.
pub fn find(archive: &Path, id: &str) -> Result<Entry, ProductError> {
    let missing = || ProductError::NotFound { id: id.to_owned(), folder: archive.to_owned() };
    let id = id.strip_suffix(".toml").unwrap_or(id);
    let path = archive.join(format!("{id}.toml"));
    let day = id.parse::<NaiveDate>().is_ok();
    let mut entries = list(archive)?.entries;
    entries.retain(|entry| {
        entry.path == path || entry.stem() == id || (day && entry.product.header.non_standard_attributes.day == id)
    });
    let of_other_series = |entry: &&Entry| entries.last().is_some_and(|last| last.series() != entry.series());
    if entries.iter().any(|entry| of_other_series(&entry)) {
        let mut stems: Vec<String> = entries.iter().map(|entry| entry.stem().to_owned()).collect();
        stems.dedup();
        return Err(ProductError::Several { day: id.to_owned(), folder: archive.to_owned(), stems: stems.join(", ") });
    }
    let found = entries.pop();
    match found {
        Some(entry) => Ok(entry),
        None if path.is_file() => {
            Err(file::read(&path).and_then(|product| complete(product, &path)).err().unwrap_or_else(missing))
        }
        None => Err(missing()),
    }
}

/// The latest products of all days from `first` to `last` that have one, in order.
///
/// # Errors
/// [`ProductError`]: no day has one, a day has products of several spacecraft, or the folder cannot be read.
pub fn find_days(archive: &Path, first: NaiveDate, last: NaiveDate) -> Result<Vec<Entry>, ProductError> {
    let inside = |entry: &Entry| {
        let day = entry.product.header.non_standard_attributes.day.parse::<NaiveDate>();
        entry.latest && day.is_ok_and(|day| first <= day && day <= last)
    };
    let mut entries: Vec<Entry> = list(archive)?.entries.into_iter().filter(inside).collect();
    entries.sort_by_key(Entry::series);
    let day = |entry: &Entry| entry.product.header.non_standard_attributes.day.clone();
    if let Some(two) = entries.windows(2).find(|two| day(&two[0]) == day(&two[1])) {
        let stems = two.iter().map(|entry| entry.stem().to_owned()).collect::<Vec<_>>().join(", ");
        return Err(ProductError::Several { day: day(&two[0]), folder: archive.to_owned(), stems });
    }
    if entries.is_empty() {
        return Err(ProductError::NotFound { id: format!("{first}..{last}"), folder: archive.to_owned() });
    }
    Ok(entries)
}
