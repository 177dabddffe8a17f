//! The archive: opened, brought up to date, committed to.

use crate::ArchiveError;
use crate::catalogue::{self, Catalogue};
use crate::files::{IoContext as _, inode, sync_folder};
use crate::journal::{Event, Journal, JournalEntry, Stamp};
use crate::objects::{Objects, PLACE, entries};
use crate::product::{self, EXTRACT, PRODUCT, STATE};
use crate::staging::{self, Staging, announce};
use std::fs::{self, File, TryLockError};
use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// A commit takes milliseconds; who holds the archive longer than this is stopped or gone astray.
const PATIENCE: Duration = Duration::from_secs(60);

/// An archive, open.
#[derive(Debug)]
pub struct Archive {
    pub(crate) folder: PathBuf,
    pub(crate) objects: Objects,
    pub(crate) journal: Journal,
    pub(crate) catalogue: Catalogue,
    /// Whether what is found to be behind may be brought up to date.
    pub(crate) writable: bool,
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
            for event in new.iter().flat_map(|(entry, _)| entry.event.each()) {
                self.give_names(event)?;
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
    pub(crate) fn give_name(&self, id: &str, suffix: &str, sha256: &str) -> Result<(), ArchiveError> {
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
        self.place_and_commit(&staging, &[], event, stamp)
    }

    /// Places durable files as the contents with their digests and commits the event that names them. Where that fails
    /// the contents that are new are taken away again. The caller holds the archive and has brought it up to date.
    pub(crate) fn place_and_commit(
        &mut self,
        staging: &Staging,
        contents: &[(PathBuf, String)],
        event: Event,
        stamp: &Stamp<'_>,
    ) -> Result<(), ArchiveError> {
        let (number, previous) = self.catalogue.applied()?;
        if !contents.is_empty() {
            announce(staging.path(), contents.iter().map(|(_, sha256)| sha256.as_str()))?;
        }
        let mut new = Vec::new();
        let commit = || {
            for (from, sha256) in contents {
                if self.objects.place(from, sha256)? {
                    new.push(sha256);
                }
            }
            self.journal.append(staging.path(), (number, &previous), event, stamp)
        };
        if let Err(error) = commit() {
            for sha256 in new {
                let _ = self.objects.remove(sha256); // already failing; `verify` tells what stays
            }
            return Err(error);
        }
        if let Err(error) = self.catch_up() {
            tracing::warn!("committed; names and catalogue are left to the next command: {error}");
        }
        Ok(())
    }

    /// The `.toml` of a product.
    pub fn path_of(&self, id: &str) -> PathBuf {
        self.folder.join(format!("{id}.{PRODUCT}"))
    }

    pub(crate) fn missing(&self, id: &str) -> ArchiveError {
        ArchiveError::NotFound { id: id.to_owned(), folder: self.folder.clone() }
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

    /// An entry of the journal.
    ///
    /// # Errors
    /// There is none with that number, or it is damaged.
    pub fn event(&self, number: u64) -> Result<JournalEntry, ArchiveError> {
        let path = self.journal.path(number);
        let gone = || ArchiveError::Journal { path, reason: "it is gone".to_owned() };
        Ok(self.journal.read(number)?.ok_or_else(gone)?.0)
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

/// Whether a folder cannot be written at all, in contrast to one that fails.
fn cannot_write(error: &std::io::Error) -> bool {
    matches!(
        error.kind(),
        ErrorKind::ReadOnlyFilesystem | ErrorKind::PermissionDenied | ErrorKind::StorageFull | ErrorKind::QuotaExceeded
    )
}
