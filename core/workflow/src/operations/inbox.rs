//! Telemetry files, each with its digest and the time that it covers.

use crate::WorkflowError;
use crate::days::DAY_NS;
use dragfree_archive::files::sha256_of;
use dragfree_engine::EngineError;
use dragfree_engine::replay::Replay;
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};
use std::ops::{Range, RangeInclusive};
use std::os::unix::fs::MetadataExt as _;
use std::path::{Path, PathBuf};

/// A telemetry file.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct InboxFile {
    /// Where it lies.
    pub path: PathBuf,
    /// Its digest.
    pub sha256: String,
    /// Stretches without a gap of more than a day in which it has messages, Unix ns, in order.
    pub covered_ns: Vec<Range<i64>>,
}

impl InboxFile {
    /// First and last day of each stretch, by their numbers.
    pub(super) fn days(&self) -> impl Iterator<Item = RangeInclusive<i64>> + '_ {
        self.covered_ns.iter().map(|stretch| day_of(stretch.start)..=day_of(stretch.end - 1))
    }

    /// Stretches that lie in part within a time.
    pub(super) fn within(&self, time_ns: Range<i64>) -> impl Iterator<Item = &Range<i64>> {
        self.covered_ns.iter().filter(move |stretch| stretch.start < time_ns.end && time_ns.start < stretch.end)
    }
}

/// Number of the day of a time.
fn day_of(time_ns: i64) -> i64 {
    time_ns.div_euclid(DAY_NS)
}

/// Telemetry files that fit the patterns of a mission, in the order of their times; of equal ones the first.
#[derive(Debug, Default)]
pub struct Inbox {
    /// Files of the spacecraft.
    pub files: Vec<InboxFile>,
    /// Files that are none, or of another spacecraft, with the reason.
    pub strangers: Vec<(PathBuf, String)>,
    /// What was read of each file, by path.
    known: BTreeMap<PathBuf, Known>,
}

/// What was read of a file, with what the file system said of it then.
#[derive(Debug)]
struct Known {
    state: FileState,
    /// Whose telemetry it is, empty where it does not say; a sentence where it is none.
    file: Result<(InboxFile, String), String>,
}

/// Size and times of a file; the second time changes with its permissions too.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
struct FileState {
    size: u64,
    modified_ns: i128,
    changed_ns: i128,
}

impl FileState {
    fn of(path: &Path) -> Self {
        let ns = |s: i64, ns: i64| i128::from(s) * 1_000_000_000 + i128::from(ns);
        std::fs::metadata(path).map_or_else(
            |_| Self::default(),
            |stat| Self {
                size: stat.len(),
                modified_ns: ns(stat.mtime(), stat.mtime_nsec()),
                changed_ns: ns(stat.ctime(), stat.ctime_nsec()),
            },
        )
    }
}

/// What is kept of a file for the next program.
type Kept = (FileState, InboxFile, String);

impl Inbox {
    /// What an earlier program has read of the files, so that each is read once; nothing where there is no such file.
    pub fn remembered(path: &Path) -> Self {
        let text = std::fs::read(path).ok();
        let kept: Vec<Kept> = text.and_then(|text| serde_json::from_slice(&text).ok()).unwrap_or_default();
        let known = |(state, file, of): Kept| (file.path.clone(), Known { state, file: Ok((file, of)) });
        Self { known: kept.into_iter().map(known).collect(), ..Self::default() }
    }

    /// Keeps what was read of the files. It only saves time, so that a failure is no matter. What was refused is left
    /// out: the next program may be another build, which reads it.
    pub fn remember(&self, path: &Path) {
        let read = |known: &'_ Known| known.file.clone().ok().map(|(file, of)| (known.state, file, of));
        let kept: Vec<Kept> = self.known.values().filter_map(read).collect();
        let keep = || -> Option<()> {
            let file = tempfile::NamedTempFile::new_in(path.parent()?).ok()?;
            serde_json::to_writer(&file, &kept).ok()?;
            file.persist(path).ok().map(drop)
        };
        keep();
    }

    /// Reads the files that are new or have changed since the last time.
    ///
    /// # Errors
    /// A pattern is wrong.
    pub fn look(&mut self, patterns: &[String], spacecraft: &str) -> Result<(), WorkflowError> {
        let mut paths = BTreeSet::new();
        for pattern in patterns {
            let refuse = |what: String| WorkflowError::Operations { path: pattern.into(), what };
            for found in glob::glob(pattern).map_err(|e| refuse(e.to_string()))? {
                paths.extend(found.ok().filter(|path| path.is_file()));
            }
        }
        self.known.retain(|path, _| paths.contains(path));
        self.files.clear();
        self.strangers.clear();
        let mut contents = BTreeSet::new();
        for path in paths {
            let state = FileState::of(&path);
            if self.known.get(&path).is_none_or(|known| known.state != state) {
                let file = read(&path);
                self.known.insert(path.clone(), Known { state, file });
            }
            match self.known.get(&path).map(|known| &known.file) {
                Some(Ok((_, of))) if !of.is_empty() && of != spacecraft => {
                    self.strangers.push((path, format!("it is of spacecraft {of}, not of {spacecraft}")));
                }
                Some(Ok((file, _))) if contents.insert(file.sha256.clone()) => self.files.push(file.clone()),
                Some(Err(reason)) => self.strangers.push((path, reason.clone())),
                _ => {}
            }
        }
        let ends = |file: &InboxFile| (file.covered_ns.first().map(|s| s.start), file.covered_ns.last().map(|s| s.end));
        self.files.sort_by_key(|file| (ends(file), file.path.clone()));
        Ok(())
    }
}

/// A file with its spacecraft, which is empty where it does not say; a sentence where it is no telemetry.
fn read(path: &Path) -> Result<(InboxFile, String), String> {
    let sha256 = sha256_of(path).map_err(|e| e.to_string())?;
    let replay = Replay::open(&[path.to_owned()], None, 1).map_err(|e| EngineError::from(e).to_string())?;
    let info = replay.info();
    if info.covered_ns.is_empty() {
        return Err("it holds no message with a time".to_owned());
    }
    Ok((InboxFile { path: path.to_owned(), sha256, covered_ns: info.covered_ns.clone() }, info.spacecraft.clone()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_covers_its_stretches_and_not_what_lies_between() {
        let covered_ns = vec![DAY_NS - 5..2 * DAY_NS, 9 * DAY_NS + 1..9 * DAY_NS + 2];
        let file = InboxFile { path: PathBuf::new(), sha256: String::new(), covered_ns };
        assert_eq!(file.days().collect::<Vec<_>>(), [0..=1, 9..=9]);
        assert_eq!(file.within(2 * DAY_NS..9 * DAY_NS).count(), 0, "the days between");
        assert_eq!(file.within(DAY_NS..10 * DAY_NS).count(), 2);
    }

    #[test]
    fn what_was_refused_is_read_again() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let (path, memory) = (folder.path().join("some.mcap"), folder.path().join("memory"));
        std::fs::write(&path, "not telemetry").expect("written");
        let mut inbox = Inbox::default();
        let patterns = [path.display().to_string()];
        inbox.look(&patterns, "SC1").expect("looked");
        assert_eq!(inbox.strangers.len(), 1);
        inbox.remember(&memory);
        assert!(Inbox::remembered(&memory).known.is_empty(), "by the next program");

        let before = FileState::of(&path);
        std::thread::sleep(std::time::Duration::from_millis(20));
        std::fs::set_permissions(&path, std::os::unix::fs::PermissionsExt::from_mode(0o600)).expect("changed");
        assert_ne!(FileState::of(&path), before, "a permission that was given");
    }

    #[test]
    fn what_was_read_is_judged_by_the_mission_of_today() {
        let covered_ns = Vec::from([Range { start: 0, end: 1 }]);
        let folder = tempfile::tempdir().expect("a temporary folder");
        let (path, memory) = (folder.path().join("some.mcap"), folder.path().join("memory"));
        std::fs::write(&path, "content").expect("written");
        let file = InboxFile { path: path.clone(), sha256: "content".into(), covered_ns };
        let known = Known { state: FileState::of(&path), file: Ok((file, "SC1".into())) };
        let inbox = Inbox { known: BTreeMap::from([(path.clone(), known)]), ..Inbox::default() };
        inbox.remember(&memory);
        let mut inbox = Inbox::remembered(&memory);
        let patterns = [path.display().to_string()];
        inbox.look(&patterns, "SC2").expect("looked");
        assert_eq!((inbox.files.len(), inbox.strangers.len()), (0, 1));
        inbox.look(&patterns, "SC1").expect("looked");
        assert_eq!((inbox.files.len(), inbox.strangers.len()), (1, 0), "read by the earlier program");
    }
}
