//! The archive: opened, brought up to date, asked.

use crate::ArchiveError;
use crate::catalogue::{self, Catalogue, Place, Row, Seen, Validity};
use crate::files::{IoContext as _, Problem, sha256_of, sync_folder};
use crate::journal::{Event, InputPlace, Journal, JournalEntry, SetState, Stamp};
use crate::objects::{Objects, PLACE, entries};
use crate::product::{self, Product};
use crate::staging::{self, Staging};
use chrono::NaiveDate;
use std::fs::{self, File, TryLockError};
use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// Suffix of what a diagnosis of a product keeps for later ones.
pub const EXTRACT: &str = "extract.json";

/// Suffix of the state that a run left for the next day.
pub const STATE: &str = "state";

/// Suffix of the product itself.
const PRODUCT: &str = "toml";

/// Names in an archive that are its own.
const OWN: [&str; 7] = [
    "objects",
    "journal",
    "staging",
    "catalogue.sqlite",
    "catalogue.sqlite-journal",
    "catalogue.sqlite-wal",
    "catalogue.sqlite-shm",
];

/// A commit takes milliseconds; who holds the archive longer than this is stopped or gone astray.
const PATIENCE: Duration = Duration::from_secs(60);

/// An archive, open.
#[derive(Debug)]
pub struct Archive {
    folder: PathBuf,
    pub(crate) objects: Objects,
    pub(crate) journal: Journal,
    pub(crate) catalogue: Catalogue,
    /// Whether what is found to be behind may be brought up to date.
    writable: bool,
}

/// What an archive holds.
#[derive(Clone, Debug, Default)]
pub struct Listing {
    /// Products by spacecraft, day, name, release and revision.
    pub entries: Vec<Entry>,
    /// Files that are no sound product; nothing is done to them.
    pub problems: Vec<Problem>,
}

/// A product in an archive.
#[derive(Clone, Debug)]
pub struct Entry {
    /// What the catalogue says.
    pub row: Row,
    /// Its `.toml`.
    pub path: PathBuf,
}

impl Entry {
    /// The id without the revision.
    pub fn stem(&self) -> &str {
        self.row.id.rsplit_once('_').map_or("", |(stem, _)| stem)
    }
}

/// Which products are listed; all of them by default.
#[derive(Clone, Debug, Default)]
pub struct Find {
    /// First day.
    pub from: Option<NaiveDate>,
    /// Last day.
    pub until: Option<NaiveDate>,
    /// Spacecraft.
    pub spacecraft: Option<String>,
    /// `agree`, `disagree` or `weak`.
    pub verdict: Option<String>,
    /// Revision of the model, or its beginning.
    pub model: Option<String>,
    /// Those that a set names.
    pub set: Option<String>,
    /// Only the newest of each day that holds.
    pub latest: bool,
}

/// A time, `until_ns` exclusive.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Window {
    /// First time, Unix ns.
    pub from_ns: Option<i64>,
    /// End, Unix ns.
    pub until_ns: Option<i64>,
}

impl Archive {
    /// Opens an archive and brings up to date what a killed program left behind.
    ///
    /// # Errors
    /// [`ArchiveError::NoArchive`], [`ArchiveError::Unmigrated`]; the journal is damaged or cannot be read.
    pub fn open(folder: &Path) -> Result<Self, ArchiveError> {
        if !folder.join("journal").is_dir() {
            let of_before = |name: &String| name.ends_with(".toml") && catalogue::parts(name).is_some();
            let unmigrated = entries(folder)?.iter().any(of_before);
            let error = if unmigrated { ArchiveError::Unmigrated } else { ArchiveError::NoArchive };
            return Err(error(folder.to_owned()));
        }
        let path = folder.join("catalogue.sqlite");
        let opened = Catalogue::open(&path).map(|catalogue| Self::with(folder, catalogue, true));
        let whole = opened.and_then(|mut archive| archive.settle().map(|()| archive));
        match whole {
            Err(ArchiveError::Catalogue { source, .. }) => Self::of_memory(folder, &path, &source.to_string()),
            Err(ArchiveError::Io(error)) if cannot_write(&error.source) => {
                Self::of_memory(folder, &path, &error.to_string())
            }
            whole => whole,
        }
    }

    /// Opens an archive, or makes one where there is none.
    ///
    /// # Errors
    /// As [`Self::open`]; the folder cannot be made.
    pub fn create(folder: &Path) -> Result<Self, ArchiveError> {
        match Self::open(folder) {
            Err(ArchiveError::NoArchive(_)) => {
                for name in ["objects", "staging", "journal"] {
                    let own = folder.join(name);
                    fs::create_dir_all(&own).at("make the archive", &own)?;
                }
                Self::open(folder)
            }
            opened => opened,
        }
    }

    /// Makes an archive in a folder that has products of an earlier version.
    pub(crate) fn create_beside(folder: &Path) -> Result<Self, ArchiveError> {
        let journal = folder.join("journal");
        fs::create_dir_all(&journal).at("make the archive", &journal)?;
        Self::open(folder)
    }

    /// The archive that a product's file lies in.
    ///
    /// # Errors
    /// As [`Self::open`].
    pub fn of(product: &Path) -> Result<Self, ArchiveError> {
        Self::open(crate::files::folder_of(product))
    }

    fn with(folder: &Path, catalogue: Catalogue, writable: bool) -> Self {
        let (objects, journal) = (Objects::new(folder), Journal::new(folder));
        Self { folder: folder.to_owned(), objects, journal, catalogue, writable }
    }

    /// Reads an archive that cannot be written, with its catalogue in memory.
    fn of_memory(folder: &Path, path: &Path, why: &str) -> Result<Self, ArchiveError> {
        tracing::debug!("{} is read without its catalogue: {why}", folder.display());
        let mut archive = Self::with(folder, Catalogue::in_memory(path)?, false);
        archive.catch_up()?;
        Ok(archive)
    }

    /// Its folder.
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// Finishes or clears what killed programs left, where there is anything.
    fn settle(&mut self) -> Result<(), ArchiveError> {
        let (number, sha256) = self.catalogue.applied()?;
        if number > 0 && self.journal.read(number)?.is_none_or(|(_, found)| found != sha256) {
            tracing::warn!("the catalogue of {} is of another journal and is made again", self.folder.display());
            self.catalogue.clear()?;
        }
        if self.behind()? || staging::any(&self.folder)? {
            let _held = self.hold()?;
            self.finish()?;
        }
        Ok(())
    }

    fn behind(&self) -> Result<bool, ArchiveError> {
        Ok(self.journal.path(self.catalogue.applied()?.0 + 1).exists())
    }

    /// The same for whoever holds the archive.
    pub(crate) fn finish(&mut self) -> Result<(), ArchiveError> {
        self.catch_up()?;
        staging::clear_dead(&self.folder, |placed| {
            for sha256 in placed {
                if !self.catalogue.names(&sha256)? {
                    self.objects.remove(&sha256)?;
                }
            }
            Ok(())
        })
    }

    /// Gives the contents of new events their names, then enters them into the catalogue.
    pub(crate) fn catch_up(&mut self) -> Result<(), ArchiveError> {
        let (mut number, mut previous) = self.catalogue.applied()?;
        let mut new = Vec::new();
        while let Some((entry, sha256)) = self.journal.read(number + 1)? {
            if entry.previous != previous {
                let reason = format!("it follows an entry {number} with another digest");
                return Err(ArchiveError::Journal { path: self.journal.path(number + 1), reason });
            }
            (number, previous) = (number + 1, sha256.clone());
            new.push((entry, sha256));
        }
        if new.is_empty() {
            return Ok(());
        }
        if self.writable {
            for (entry, _) in &new {
                self.give_names(&entry.event)?;
            }
            sync_folder(&self.folder).at("flush", &self.folder)?;
        }
        let (objects, folder) = (&self.objects, &self.folder);
        self.catalogue.apply(&new, |id, sha256| {
            let path = folder.join(format!("{id}.{PRODUCT}"));
            let text = objects.read(sha256).map_err(|e| e.to_string())?;
            let text = String::from_utf8(text).map_err(|e| e.to_string())?;
            product::parse(&text, &path).map_err(|e| e.to_string())
        })
    }

    /// Links the contents of an event to names that people read.
    fn give_names(&self, event: &Event) -> Result<(), ArchiveError> {
        match event {
            Event::Product { id, sha256, made_of, .. } => {
                if let Some(state) = made_of.get("state_out") {
                    self.give_name(id, STATE, &state.sha256)?;
                }
                let document = self.objects.read(sha256).ok().and_then(|text| String::from_utf8(text).ok());
                let path = self.path_of(id);
                let product = document.and_then(|text| product::parse(&text, &path).ok());
                for file in product.iter().flat_map(|product| &product.attachments) {
                    self.give_name(id, &file.suffix, &file.sha256)?;
                }
                self.give_name(id, PRODUCT, sha256)
            }
            Event::Extract { id, sha256, .. } => self.give_name(id, EXTRACT, sha256),
            _ => Ok(()),
        }
    }

    /// Links a content to `ID.suffix`; another file of that name is replaced in one step.
    fn give_name(&self, id: &str, suffix: &str, sha256: &str) -> Result<(), ArchiveError> {
        let (from, to) = (self.objects.path(sha256), self.folder.join(format!("{id}.{suffix}")));
        if !from.exists() {
            return Ok(()); // `list` and `verify` tell that it is gone
        }
        match fs::hard_link(&from, &to) {
            Err(error) if error.kind() == ErrorKind::AlreadyExists => {
                let stat = |path: &Path| fs::metadata(path).at("read", path);
                if inode(&stat(&from)?) != inode(&stat(&to)?) {
                    let beside = self.folder.join("staging").join(format!("{id}.{suffix}"));
                    let _ = fs::remove_file(&beside); // of a killed program
                    fs::hard_link(&from, &beside).at(PLACE, &beside)?;
                    fs::rename(&beside, &to).at("place", &to)?;
                }
                Ok(())
            }
            linked => linked.at(PLACE, &to).map_err(Into::into),
        }
    }

    /// The right to write, held until it is dropped; a killed program's is free.
    pub(crate) fn hold(&self) -> Result<File, ArchiveError> {
        let path = self.journal.folder.join("lock");
        let lock = File::options().create(true).truncate(false).write(true).open(&path).at("write", &path)?;
        let since = Instant::now();
        loop {
            match lock.try_lock() {
                Ok(()) => return Ok(lock),
                Err(TryLockError::Error(error)) => return Err(error).at("lock", &path).map_err(Into::into),
                Err(TryLockError::WouldBlock) if since.elapsed() > PATIENCE => {
                    return Err(ArchiveError::Busy { folder: self.folder.clone(), seconds: PATIENCE.as_secs() });
                }
                Err(TryLockError::WouldBlock) => std::thread::sleep(Duration::from_millis(2)),
            }
        }
    }

    /// Commits one event. `check` is asked when nobody else can write; what it refuses does not happen.
    pub(crate) fn commit(
        &mut self,
        stamp: &Stamp<'_>,
        check: impl FnOnce(&Self) -> Result<Event, ArchiveError>,
    ) -> Result<(), ArchiveError> {
        let staging = Staging::begin(&self.folder)?;
        let _held = self.hold()?;
        self.finish()?;
        let event = check(self)?;
        let (number, previous) = self.catalogue.applied()?;
        self.journal.append(staging.path(), (number, &previous), event, stamp)?;
        self.committed();
        Ok(())
    }

    /// Brings names and catalogue up to date after a commit; what fails is left to the next command.
    pub(crate) fn committed(&mut self) {
        if let Err(error) = self.catch_up() {
            tracing::warn!("committed; names and catalogue are left to the next command: {error}");
        }
    }

    /// The `.toml` of a product.
    pub fn path_of(&self, id: &str) -> PathBuf {
        self.folder.join(format!("{id}.{PRODUCT}"))
    }

    /// Reads a product and compares it, and every file beside it, with what was archived.
    ///
    /// # Errors
    /// There is no such product, or it is damaged.
    pub fn product(&self, id: &str) -> Result<Product, ArchiveError> {
        let row = self.row(id)?;
        let path = self.path_of(id);
        if let Some(reason) = row.problem {
            return Err(ArchiveError::Damaged { path, reason });
        }
        for (suffix, sha256, _) in self.files_of(id)? {
            self.check(id, &suffix, &sha256, true)?;
        }
        product::read(&path)
    }

    /// Suffix, digest and size of the files of a product, itself among them.
    pub fn files_of(&self, id: &str) -> Result<Vec<(String, String, u64)>, ArchiveError> {
        let mut files = self.catalogue.files(id)?;
        let made_of = self.catalogue.made_of(id)?;
        let state = made_of.into_iter().find(|place| place.role == "state_out");
        files.extend(state.map(|place| (STATE.to_owned(), place.sha256, place.size)));
        let own = self.catalogue.products("p.id = ?1", [id])?;
        if !own.is_empty() {
            let (sha256, size) = self.document_of(id)?;
            files.push((PRODUCT.to_owned(), sha256, size));
        }
        Ok(files)
    }

    /// Digest and size of a product's document.
    fn document_of(&self, id: &str) -> Result<(String, u64), ArchiveError> {
        let sha256 = self.catalogue.document(id)?.ok_or_else(|| self.missing(id))?;
        let size = fs::metadata(self.objects.path(&sha256)).map_or(0, |m| m.len());
        Ok((sha256, size))
    }

    /// A file beside a product, compared with its digest.
    ///
    /// # Errors
    /// There is none, or it is damaged.
    pub fn read_file(&self, id: &str, suffix: &str) -> Result<Vec<u8>, ArchiveError> {
        let files = self.files_of(id)?;
        let (_, sha256, _) = files.iter().find(|(found, ..)| found == suffix).ok_or_else(|| {
            let id = format!("{id}.{suffix}");
            ArchiveError::NotFound { id, folder: self.folder.clone() }
        })?;
        self.objects.read(sha256)
    }

    /// Compares a file with its digest. Without `fully`, one that looks as when its digest was last taken is taken for
    /// the same.
    fn check(&self, id: &str, suffix: &str, sha256: &str, fully: bool) -> Result<(), ArchiveError> {
        let name = format!("{id}.{suffix}");
        let path = self.folder.join(&name);
        let stat = fs::metadata(&path).at("read", &path)?;
        let now = Seen { sha256: sha256.to_owned(), size: stat.len(), mtime_ns: mtime_ns(&stat), inode: inode(&stat) };
        if !fully && self.catalogue.seen(&name)?.is_some_and(|before| before == now) {
            return Ok(());
        }
        let found = sha256_of(&path).at("read", &path)?;
        if found != sha256 {
            let reason = format!("its digest is {found}, the archive says {sha256}");
            return Err(ArchiveError::Damaged { path, reason });
        }
        if self.writable {
            self.catalogue.keep_seen(&name, &now);
        }
        Ok(())
    }

    fn missing(&self, id: &str) -> ArchiveError {
        ArchiveError::NotFound { id: id.to_owned(), folder: self.folder.clone() }
    }

    /// What the catalogue says of a product.
    ///
    /// # Errors
    /// There is none.
    pub fn row(&self, id: &str) -> Result<Row, ArchiveError> {
        self.catalogue.products("p.id = ?1", [id])?.pop().ok_or_else(|| self.missing(id))
    }

    /// Products that fit, and what is wrong in the folder. A file that does not look as it was archived is compared with
    /// its digest.
    ///
    /// # Errors
    /// The folder or the catalogue cannot be read.
    pub fn list(&self, find: &Find) -> Result<Listing, ArchiveError> {
        let mut listing = Listing::default();
        let mut known = std::collections::BTreeSet::new();
        for row in self.catalogue.products("1", [])? {
            let mut sound = row.problem.clone().map_or(Ok(()), Err);
            for (suffix, sha256, _) in self.files_of(&row.id)? {
                known.insert(format!("{}.{suffix}", row.id));
                sound = sound.and_then(|()| self.check(&row.id, &suffix, &sha256, false).map_err(|e| e.to_string()));
            }
            let path = self.path_of(&row.id);
            match sound {
                Ok(()) => listing.entries.push(Entry { row, path }),
                Err(reason) => listing.problems.push(Problem { path, reason }),
            }
        }
        for name in entries(&self.folder)? {
            if !name.starts_with('.') && !OWN.contains(&name.as_str()) && !known.contains(&name) {
                let reason = "belongs to no product of the archive".to_owned();
                listing.problems.push(Problem { path: self.folder.join(name), reason });
            }
        }
        let in_set = find.set.as_deref().map(|set| self.catalogue.validity(Some(set))).transpose()?;
        listing.entries.retain(|entry| {
            let row = &entry.row;
            let is = |wanted: &Option<String>, found: Option<&str>| wanted.as_deref().is_none_or(|w| found == Some(w));
            let day = row.day.parse::<NaiveDate>().ok();
            find.from.is_none_or(|from| day.is_some_and(|day| from <= day))
                && find.until.is_none_or(|until| day.is_some_and(|day| day <= until))
                && is(&find.spacecraft, Some(&row.spacecraft))
                && is(&find.verdict, row.verdict.as_deref())
                && find.model.as_ref().is_none_or(|m| row.model.as_ref().is_some_and(|found| found.starts_with(m)))
                && in_set.as_ref().is_none_or(|set| set.iter().any(|v| v.id == row.id))
                && (!find.latest || row.latest)
        });
        Ok(listing)
    }

    /// Finds a product by its id, by its id without the revision (the newest one then) or by its day. A withdrawn one is
    /// found by its id alone.
    ///
    /// # Errors
    /// There is none, or the day has products of several series.
    pub fn find(&self, name: &str) -> Result<Entry, ArchiveError> {
        let id = name.strip_suffix(".toml").unwrap_or(name);
        let entry = |row: Row| Entry { path: self.path_of(&row.id), row };
        if let Some(row) = self.catalogue.products("p.id = ?1", [id])?.pop() {
            return Ok(entry(row));
        }
        let condition = "(p.day = ?1 OR substr(p.id, 1, length(p.id) - 5) = ?1) AND w.reason IS NULL";
        let mut found: Vec<Entry> = self.catalogue.products(condition, [id])?.into_iter().map(entry).collect();
        let series = |e: &Entry| (e.row.spacecraft.clone(), e.row.name.clone());
        if let Some(last) = found.last()
            && found.iter().any(|e| series(e) != series(last))
        {
            return Err(self.several(id, &found));
        }
        found.pop().ok_or_else(|| self.missing(id))
    }

    /// The newest product of every day from `first` to `last` that has one and is not withdrawn, in order.
    ///
    /// # Errors
    /// No day has one, or a day has products of several spacecraft.
    pub fn find_days(&self, first: NaiveDate, last: NaiveDate) -> Result<Vec<Entry>, ArchiveError> {
        let condition = "p.day BETWEEN ?1 AND ?2 AND w.reason IS NULL AND p.problem IS NULL AND p.fixed_from IS NULL";
        let rows = self.catalogue.products(condition, [first.to_string(), last.to_string()])?;
        let mut newest: Vec<Entry> = Vec::new();
        for row in rows {
            let of = |row: &Row| (row.day.clone(), row.spacecraft.clone(), row.name.clone());
            if newest.last().is_some_and(|last| of(&last.row) == of(&row)) {
                newest.pop();
            }
            newest.push(Entry { path: self.path_of(&row.id), row });
        }
        newest.sort_by(|a, b| a.row.day.cmp(&b.row.day));
        if let Some(two) = newest.windows(2).find(|two| two[0].row.day == two[1].row.day) {
            return Err(self.several(&two[0].row.day, two));
        }
        if newest.is_empty() {
            return Err(self.missing(&format!("{first}..{last}")));
        }
        Ok(newest)
    }

    fn several(&self, day: &str, found: &[Entry]) -> ArchiveError {
        let mut stems: Vec<&str> = found.iter().map(Entry::stem).collect();
        stems.dedup();
        ArchiveError::Several { day: day.to_owned(), folder: self.folder.clone(), stems: stems.join(", ") }
    }

    /// What a product was made of: its inputs in their order, each at a place where a file is, or where it was last.
    ///
    /// # Errors
    /// The catalogue cannot be read.
    pub fn inputs(&self, id: &str) -> Result<Vec<Place>, ArchiveError> {
        let mut inputs = self.catalogue.inputs(id)?;
        for input in &mut inputs {
            let places = self.catalogue.places(&input.sha256)?;
            input.path = places.iter().find(|path| path.is_file()).or(places.first()).cloned();
        }
        Ok(inputs)
    }

    /// Looks for inputs of products that are not where they were in folders, and in those inside of them, by length and
    /// digest, and takes note of their places. Returns how many were found.
    ///
    /// # Errors
    /// A folder cannot be read, or the archive cannot be written.
    pub fn look_in(&mut self, folders: &[PathBuf], ids: &[&str], stamp: &Stamp<'_>) -> Result<usize, ArchiveError> {
        let mut wanted = Vec::new();
        for id in ids {
            let gone = |place: &Place| !place.path.as_ref().is_some_and(|path| path.is_file());
            wanted.extend(self.inputs(id)?.into_iter().filter(gone));
        }
        let mut found = Vec::new();
        let mut waiting: Vec<PathBuf> = folders.to_vec();
        while let (Some(folder), false) = (waiting.pop(), wanted.is_empty()) {
            for name in entries(&folder)? {
                let path = folder.join(name);
                let stat = fs::symlink_metadata(&path).at("read", &path)?;
                if stat.is_dir() {
                    waiting.push(path);
                } else if wanted.iter().any(|place| place.size == stat.len()) {
                    let sha256 = sha256_of(&path).at("read", &path)?;
                    let before = wanted.len();
                    wanted.retain(|place| place.sha256 != sha256);
                    if wanted.len() < before {
                        let path = std::path::absolute(&path).unwrap_or(path);
                        found.push(InputPlace { sha256, path });
                    }
                }
            }
        }
        let count = found.len();
        self.keep_places(found, stamp)?;
        Ok(count)
    }

    /// Where a content lies that the archive keeps for a product by `role`: `pipeline`, `mission`, `model`, `state_in`,
    /// `state_out`.
    ///
    /// # Errors
    /// The catalogue cannot be read, or there is none.
    pub fn made_of(&self, id: &str, role: &str) -> Result<Option<Place>, ArchiveError> {
        let mut all = self.catalogue.made_of(id)?;
        all.retain(|place| place.role == role);
        Ok(all.pop().map(|place| Place { path: Some(self.objects.path(&place.sha256)), ..place }))
    }

    /// Every content that the archive keeps for a product, by role.
    ///
    /// # Errors
    /// The catalogue cannot be read.
    pub fn all_made_of(&self, id: &str) -> Result<Vec<Place>, ArchiveError> {
        let at = |place: Place| Place { path: Some(self.objects.path(&place.sha256)), ..place };
        Ok(self.catalogue.made_of(id)?.into_iter().map(at).collect())
    }

    /// Products for which the archive keeps a content by `role`, by its digest.
    ///
    /// # Errors
    /// The catalogue cannot be read.
    pub fn products_with(&self, role: &str, sha256: &str) -> Result<Vec<String>, ArchiveError> {
        self.catalogue.products_with(role, sha256)
    }

    /// An entry of the journal.
    ///
    /// # Errors
    /// There is none with that number, or it is damaged.
    pub fn event(&self, number: u64) -> Result<JournalEntry, ArchiveError> {
        let path = self.journal.path(number);
        let gone = || ArchiveError::Journal { path, reason: "it is gone".to_owned() };
        Ok(self.journal.read(number)?.ok_or_else(gone)?.0)
    }

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
                if crate::files::sha256(&text) != sha256 {
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
    fn supersedes_of(&self, row: &Row, again: &Product) -> Result<Option<product::Supersedes>, ArchiveError> {
        let stem = row.id.rsplit_once('_').map_or("", |(stem, _)| stem);
        let mut earlier = self.catalogue.products("substr(p.id, 1, length(p.id) - 5) = ?1", [stem])?;
        earlier.retain(|other| other.number < row.number && other.problem.is_none());
        let Some(before) = earlier.pop() else { return Ok(None) };
        let old = product::read(&self.path_of(&before.id))?;
        Ok(Some(crate::writer::supersedes(&old, again)))
    }

    /// Products that a content entered, by digest.
    ///
    /// # Errors
    /// The catalogue cannot be read.
    pub fn products_of(&self, sha256: &str) -> Result<Vec<String>, ArchiveError> {
        self.catalogue.products_of(sha256)
    }

    /// Keeps what a diagnosis found of a product beside it; an earlier one gives its name up.
    ///
    /// # Errors
    /// The archive cannot be written.
    pub fn keep_extract(&mut self, id: &str, content: &[u8], stamp: &Stamp<'_>) -> Result<PathBuf, ArchiveError> {
        self.row(id)?;
        let staging = Staging::begin(&self.folder)?;
        let staged = staging.path().join(EXTRACT);
        let sha256 = crate::files::sha256(content);
        let write = || {
            use std::io::Write as _;
            let mut file = File::create(&staged)?;
            file.write_all(content)?;
            file.sync_all()
        };
        write().at("write", &staged)?;
        let _held = self.hold()?;
        self.finish()?;
        crate::writer::announce(staging.path(), &[sha256.clone()])?;
        let (number, previous) = self.catalogue.applied()?;
        let new = self.objects.place(&staged, &sha256)?;
        let event = Event::Extract { id: id.to_owned(), sha256: sha256.clone(), size: content.len() as u64 };
        if let Err(error) = self.journal.append(staging.path(), (number, &previous), event, stamp) {
            if new {
                self.objects.remove(&sha256)?;
            }
            return Err(error);
        }
        self.committed();
        Ok(self.folder.join(format!("{id}.{EXTRACT}")))
    }

    /// Takes note of where contents were found.
    ///
    /// # Errors
    /// The archive cannot be written.
    pub fn keep_places(&mut self, places: Vec<InputPlace>, stamp: &Stamp<'_>) -> Result<(), ArchiveError> {
        if places.is_empty() { Ok(()) } else { self.commit(stamp, |_| Ok(Event::Places { places })) }
    }

    /// Marks a product as not to be used any more.
    ///
    /// # Errors
    /// There is no such product, it is withdrawn already, or a published set names it.
    pub fn withdraw(&mut self, id: &str, reason: &str, stamp: &Stamp<'_>) -> Result<(), ArchiveError> {
        self.commit(stamp, |archive| {
            let row = archive.row(id)?;
            if let Some(earlier) = row.withdrawn {
                return Err(ArchiveError::Refused(format!("{id} is withdrawn already: {earlier}")));
            }
            Ok(Event::Withdrawn { id: id.to_owned(), reason: reason.to_owned() })
        })
    }

    /// Says that a product holds for a time, in a set that is open.
    ///
    /// # Errors
    /// There is no such product, it is damaged or withdrawn; the set is not open; the time is empty or overlaps another.
    pub fn certify(&mut self, id: &str, set: &str, window: Window, stamp: &Stamp<'_>) -> Result<(), ArchiveError> {
        let from_ns = window.from_ns.ok_or_else(|| ArchiveError::Refused("a certificate needs a first time".into()))?;
        let until = window.until_ns.unwrap_or(i64::MAX);
        if until <= from_ns {
            return Err(ArchiveError::Refused("the end is not after the first time".into()));
        }
        self.product(id)?;
        self.commit(stamp, |archive| {
            let row = archive.row(id)?;
            if let Some(reason) = row.withdrawn {
                return Err(ArchiveError::Refused(format!("{id} is withdrawn: {reason}")));
            }
            archive.check_open(set)?;
            let all = archive.catalogue.validity(Some(set))?;
            let overlap = |v: &&Validity| v.spacecraft == row.spacecraft && v.from_ns < until && from_ns < v.until_ns;
            if let Some(other) = all.iter().find(overlap) {
                return Err(ArchiveError::Refused(format!(
                    "{} holds in set {set} from {} to {}, which overlaps; `dragfree products decertify` takes a time out",
                    other.id,
                    time(other.from_ns),
                    time(other.until_ns)
                )));
            }
            Ok(Event::Certified { set: set.to_owned(), id: id.to_owned(), from_ns, until_ns: window.until_ns })
        })
    }

    /// Takes a time of a spacecraft out of a set that is open.
    ///
    /// # Errors
    /// The set is not open, or says nothing about that time.
    pub fn decertify(
        &mut self,
        set: &str,
        spacecraft: &str,
        window: Window,
        stamp: &Stamp<'_>,
    ) -> Result<(), ArchiveError> {
        let (from, until) = (window.from_ns.unwrap_or(i64::MIN), window.until_ns.unwrap_or(i64::MAX));
        self.commit(stamp, |archive| {
            archive.check_open(set)?;
            let all = archive.catalogue.validity(Some(set))?;
            if !all.iter().any(|v| v.spacecraft == spacecraft && v.from_ns < until && from < v.until_ns) {
                return Err(ArchiveError::Refused(format!("set {set} says nothing about {spacecraft} in that time")));
            }
            let (from_ns, until_ns) = (window.from_ns, window.until_ns);
            Ok(Event::Decertified { set: set.to_owned(), spacecraft: spacecraft.to_owned(), from_ns, until_ns })
        })
    }

    fn check_open(&self, set: &str) -> Result<(), ArchiveError> {
        match self.catalogue.sets()?.into_iter().find(|(name, _)| name == set) {
            Some((_, state)) if state != SetState::Open.name() => {
                Err(ArchiveError::Refused(format!("set {set} is {state}: what it said, it says always")))
            }
            _ => Ok(()),
        }
    }

    /// Publishes a set that is open, or invalidates one.
    ///
    /// # Errors
    /// There is no such set, or it is not in a state from which that goes.
    pub fn set_state(
        &mut self,
        set: &str,
        state: SetState,
        reason: &str,
        stamp: &Stamp<'_>,
    ) -> Result<(), ArchiveError> {
        self.commit(stamp, |archive| {
            let found = archive.catalogue.sets()?.into_iter().find(|(name, _)| name == set);
            let Some((_, now)) = found else {
                return Err(ArchiveError::Refused(format!(
                    "there is no set {set}; `dragfree products sets` lists them"
                )));
            };
            let goes = matches!(
                (now.as_str(), state),
                ("open", SetState::Published) | ("open" | "published", SetState::Invalidated)
            );
            if !goes {
                return Err(ArchiveError::Refused(format!("set {set} is {now} and cannot become {}", state.name())));
            }
            Ok(Event::Set { set: set.to_owned(), state, reason: reason.to_owned() })
        })
    }

    /// Sets with their states.
    ///
    /// # Errors
    /// The catalogue cannot be read.
    pub fn sets(&self) -> Result<Vec<(String, String)>, ArchiveError> {
        self.catalogue.sets()
    }

    /// Times of a set, or of all.
    ///
    /// # Errors
    /// The catalogue cannot be read.
    pub fn validity(&self, set: Option<&str>) -> Result<Vec<Validity>, ArchiveError> {
        self.catalogue.validity(set)
    }

    /// Makes the catalogue again from journal and products. Returns the number of events.
    ///
    /// # Errors
    /// The archive cannot be written, or the journal is damaged.
    pub fn reindex(folder: &Path) -> Result<u64, ArchiveError> {
        let path = folder.join("catalogue.sqlite");
        let mut archive = Self::open(folder)?;
        let _held = archive.hold()?;
        archive.events()?; // a damaged journal leaves the catalogue as it is
        archive.catalogue = Catalogue::in_memory(&path)?;
        catalogue::discard(&path);
        archive = Self::with(folder, Catalogue::open(&path)?, true);
        archive.finish()?;
        Ok(archive.catalogue.applied()?.0)
    }

    /// Entries of the journal, in order.
    ///
    /// # Errors
    /// One is missing, damaged or does not follow on the one before.
    pub fn events(&self) -> Result<Vec<JournalEntry>, ArchiveError> {
        let (last, mut previous) = (self.journal.last()?, String::new());
        let mut all = Vec::new();
        for number in 1..=last {
            let path = self.journal.path(number);
            let damaged = |reason: &str| ArchiveError::Journal { path: path.clone(), reason: reason.to_owned() };
            let (entry, sha256) = self.journal.read(number)?.ok_or_else(|| damaged("it is gone"))?;
            if entry.previous != previous {
                return Err(damaged("it follows an entry with another digest"));
            }
            previous = sha256;
            all.push(entry);
        }
        Ok(all)
    }

    /// Ids of all products, sound or not.
    ///
    /// # Errors
    /// The catalogue cannot be read.
    pub fn ids(&self) -> Result<Vec<String>, ArchiveError> {
        Ok(self.catalogue.products("1", [])?.into_iter().map(|row| row.id).collect())
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

    /// Digests of contents that no event names.
    ///
    /// # Errors
    /// The folder or the catalogue cannot be read.
    pub fn strangers(&self) -> Result<Vec<String>, ArchiveError> {
        let mut strangers = Vec::new();
        for sha256 in self.objects.all()? {
            if !self.catalogue.names(&sha256)? {
                strangers.push(sha256);
            }
        }
        Ok(strangers)
    }
}

/// A time for people.
fn time(ns: i64) -> String {
    if ns == i64::MAX {
        return "further notice".to_owned();
    }
    chrono::DateTime::from_timestamp_nanos(ns).to_rfc3339_opts(chrono::SecondsFormat::AutoSi, true)
}

/// Whether a folder cannot be written at all, in contrast to one that fails.
fn cannot_write(error: &std::io::Error) -> bool {
    matches!(
        error.kind(),
        ErrorKind::ReadOnlyFilesystem | ErrorKind::PermissionDenied | ErrorKind::StorageFull | ErrorKind::QuotaExceeded
    )
}

#[cfg(unix)]
fn inode(stat: &fs::Metadata) -> u64 {
    use std::os::unix::fs::MetadataExt as _;
    stat.ino()
}

#[cfg(unix)]
fn mtime_ns(stat: &fs::Metadata) -> i64 {
    use std::os::unix::fs::MetadataExt as _;
    stat.mtime().saturating_mul(1_000_000_000).saturating_add(stat.mtime_nsec())
}

#[cfg(not(unix))]
fn inode(_stat: &fs::Metadata) -> u64 {
    0
}

#[cfg(not(unix))]
fn mtime_ns(stat: &fs::Metadata) -> i64 {
    let since = stat.modified().ok().and_then(|t| t.duration_since(std::time::UNIX_EPOCH).ok());
    since.and_then(|d| i64::try_from(d.as_nanos()).ok()).unwrap_or(0)
}
