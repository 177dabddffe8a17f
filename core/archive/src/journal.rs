//! The journal: one file for each event, numbered without gaps, each with the digest of the one before.

use crate::ArchiveError;
use crate::files::{IoContext as _, sha256, sync_folder, write_durable};
use crate::objects::{PLACE, entries};
use chrono::{DateTime, Utc};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::fs;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};

/// Version of the layout.
const FORMAT: u32 = 1;

/// An event with its place in the journal.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct JournalEntry {
    /// Version of the layout.
    pub format: u32,
    /// 1, 2, 3 …
    pub number: u64,
    /// SHA-256 of the entry before; empty in the first.
    pub previous: String,
    /// When it was committed, by the clock of that machine.
    pub time: DateTime<Utc>,
    /// Version of the program.
    pub software: String,
    /// What happened.
    pub event: Event,
}

/// What can happen to an archive.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "kebab-case")]
pub enum Event {
    /// A product was archived.
    Product {
        /// Its id.
        id: String,
        /// SHA-256 of its `.toml`.
        sha256: String,
        /// Contents kept beside it by role: `pipeline`, `mission`, `model`, `state_in`, `state_out`.
        made_of: BTreeMap<String, Stored>,
        /// Where its inputs lay when it was made.
        places: Vec<InputPlace>,
        /// First time that was asked for, Unix ns.
        from_ns: Option<i64>,
        /// End of the time that was asked for, Unix ns.
        until_ns: Option<i64>,
        /// Data before `from_ns` that only settled the stages before the estimators, ns.
        #[serde(default)]
        run_in_ns: i64,
    },
    /// Several of these at once, none of them `several`.
    Several {
        /// In order.
        events: Vec<Event>,
    },
    /// A day gave no product.
    Failed {
        /// UTC day.
        day: String,
        /// Spacecraft.
        spacecraft: String,
        /// Why, as the operator was told.
        reason: String,
        /// Digest of everything that it was tried with: with the same again it would fail again.
        tried_with: String,
    },
    /// A diagnosis kept its sums.
    Extract {
        /// The product.
        id: String,
        /// SHA-256 of the extract.
        sha256: String,
        /// Bytes.
        size: u64,
    },
    /// Inputs were found in other places.
    Places {
        /// Digest and place.
        places: Vec<InputPlace>,
    },
    /// A product is not to be used any more.
    Withdrawn {
        /// The product.
        id: String,
        /// Why.
        reason: String,
    },
    /// A product holds for a time in a set.
    Certified {
        /// Name of the set.
        set: String,
        /// The product.
        id: String,
        /// First time, Unix ns.
        from_ns: i64,
        /// End, exclusive, Unix ns; none where it holds until further notice.
        until_ns: Option<i64>,
    },
    /// A set says nothing about a time any more.
    Decertified {
        /// Name of the set.
        set: String,
        /// Spacecraft.
        spacecraft: String,
        /// First time, Unix ns; none from the beginning.
        from_ns: Option<i64>,
        /// End, exclusive, Unix ns; none without end.
        until_ns: Option<i64>,
    },
    /// A set was published or invalidated.
    Set {
        /// Its name.
        set: String,
        /// Its state from now on.
        state: SetState,
        /// Why; empty where nothing was said.
        reason: String,
    },
}

/// State of a set of calibrations.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum SetState {
    /// Certifications may come and go.
    Open,
    /// Fixed: what it said once, it says always.
    Published,
    /// Not to be used any more.
    Invalidated,
}

impl Event {
    /// Itself, or what happened at once.
    pub(crate) fn each(&self) -> &[Self] {
        match self {
            Self::Several { events } => events,
            one => std::slice::from_ref(one),
        }
    }
}

impl SetState {
    /// As in the journal.
    pub fn name(self) -> &'static str {
        match self {
            Self::Open => "open",
            Self::Published => "published",
            Self::Invalidated => "invalidated",
        }
    }
}

/// A content of the archive.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Stored {
    /// Name that the file had.
    pub name: String,
    /// Its digest.
    pub sha256: String,
    /// Bytes.
    pub size: u64,
}

/// Where a content outside of the archive lies.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct InputPlace {
    /// Its digest.
    pub sha256: String,
    /// The file.
    pub path: PathBuf,
}

/// The folder of events.
#[derive(Clone, Debug)]
pub(crate) struct Journal {
    pub(crate) folder: PathBuf,
}

impl Journal {
    pub(crate) fn new(archive: &Path) -> Self {
        Self { folder: archive.join("journal") }
    }

    pub(crate) fn path(&self, number: u64) -> PathBuf {
        self.folder.join(format!("{number:08}.json"))
    }

    /// The entry with a number and its digest; `None` where there is none yet.
    pub(crate) fn read(&self, number: u64) -> Result<Option<(JournalEntry, String)>, ArchiveError> {
        let path = self.path(number);
        let text = match fs::read(&path) {
            Err(error) if error.kind() == ErrorKind::NotFound => return Ok(None),
            text => text.at("read", &path)?,
        };
        let damaged = |reason: String| ArchiveError::Journal { path: path.clone(), reason };
        let entry: JournalEntry = serde_json::from_slice(&text).map_err(|e| damaged(e.to_string()))?;
        if entry.format > FORMAT {
            let path = path.clone();
            return Err(ArchiveError::Format { path, found: format!("{} of the journal", entry.format) });
        }
        if entry.number != number {
            return Err(damaged(format!("it says that it is entry {}", entry.number)));
        }
        Ok(Some((entry, sha256(&text))))
    }

    /// Number of the last entry, by the names in the folder; missing ones are refused.
    pub(crate) fn last(&self) -> Result<u64, ArchiveError> {
        let names = entries(&self.folder)?;
        let number = |name: &String| name.strip_suffix(".json").and_then(|digits| digits.parse::<u64>().ok());
        let mut last = 0;
        for found in names.iter().filter_map(number) {
            if found != last + 1 {
                let path = self.path(last + 1);
                return Err(ArchiveError::Journal { path, reason: format!("it is missing, entry {found} is there") });
            }
            last = found;
        }
        Ok(last)
    }

    /// Writes an entry after the one with number and digest `after`: the commit. `staging` is a folder of the writer.
    pub(crate) fn append(
        &self,
        staging: &Path,
        after: (u64, &str),
        event: Event,
        stamp: &Stamp<'_>,
    ) -> Result<(), ArchiveError> {
        let number = after.0 + 1;
        let entry = JournalEntry {
            format: FORMAT,
            number,
            previous: after.1.to_owned(),
            time: stamp.time,
            software: stamp.software.to_owned(),
            event,
        };
        let staged = staging.join(".entry.json");
        let text = serde_json::to_vec_pretty(&entry).map_err(std::io::Error::from).at("write", &staged)?;
        write_durable(&staged, &text)?;
        let path = self.path(number);
        fs::hard_link(&staged, &path).at(PLACE, &path)?;
        if let Err(error) = sync_folder(&self.folder) {
            // Whoever looks sees the entry; only a power failure could still take it back.
            tracing::warn!("the folder {} cannot be flushed to disk: {error}", self.folder.display());
        }
        Ok(())
    }
}

/// When and by what an event is committed.
#[derive(Clone, Copy, Debug)]
pub struct Stamp<'a> {
    /// Time.
    pub time: DateTime<Utc>,
    /// Version of the program.
    pub software: &'a str,
}
