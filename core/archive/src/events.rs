//! What people say of products: withdrawn, certified for a time in a set, seen in another place.

use crate::ArchiveError;
use crate::archive::Archive;
use crate::catalogue::{Place, Validity};
use crate::files::{IoContext as _, sha256, sha256_of, write_durable};
use crate::journal::{Event, InputPlace, SetState, Stamp};
use crate::objects::entries;
use crate::product::EXTRACT;
use crate::staging::Staging;
use std::fs;
use std::path::PathBuf;

/// A time, `until_ns` exclusive.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Window {
    /// First time, Unix ns.
    pub from_ns: Option<i64>,
    /// End, Unix ns.
    pub until_ns: Option<i64>,
}

impl Archive {
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

    /// Keeps what a diagnosis found of a product beside it; an earlier one gives its name up.
    ///
    /// # Errors
    /// The archive cannot be written.
    pub fn keep_extract(&mut self, id: &str, content: &[u8], stamp: &Stamp<'_>) -> Result<PathBuf, ArchiveError> {
        self.row(id)?;
        let staging = Staging::begin(&self.folder)?;
        let staged = staging.path().join(EXTRACT);
        let sha256 = sha256(content);
        write_durable(&staged, content)?;
        let _held = self.hold()?;
        self.finish()?;
        let event = Event::Extract { id: id.to_owned(), sha256: sha256.clone(), size: content.len() as u64 };
        self.place_and_commit(&staging, &[(staged, sha256)], event, stamp)?;
        Ok(self.folder.join(format!("{id}.{EXTRACT}")))
    }

    /// Takes note of where contents were found.
    ///
    /// # Errors
    /// The archive cannot be written.
    pub fn keep_places(&mut self, places: Vec<InputPlace>, stamp: &Stamp<'_>) -> Result<(), ArchiveError> {
        if places.is_empty() { Ok(()) } else { self.commit(stamp, |_| Ok(Event::Places { places })) }
    }

    /// Takes note that a day gave no product.
    ///
    /// # Errors
    /// The archive cannot be written.
    pub fn keep_failure(
        &mut self,
        (day, spacecraft): (&str, &str),
        reason: &str,
        tried_with: &str,
        stamp: &Stamp<'_>,
    ) -> Result<(), ArchiveError> {
        let event = Event::Failed {
            day: day.to_owned(),
            spacecraft: spacecraft.to_owned(),
            reason: reason.to_owned(),
            tried_with: tried_with.to_owned(),
        };
        self.commit(stamp, |_| Ok(event))
    }

    /// Marks a product as not to be used any more.
    ///
    /// # Errors
    /// There is no such product, or it is withdrawn already.
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
    /// There is no such product, it is damaged or withdrawn; the set is not open; the time is empty, or it overlaps
    /// another.
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
}

/// A time for people.
fn time(ns: i64) -> String {
    if ns == i64::MAX {
        return "further notice".to_owned();
    }
    chrono::DateTime::from_timestamp_nanos(ns).to_rfc3339_opts(chrono::SecondsFormat::AutoSi, true)
}
