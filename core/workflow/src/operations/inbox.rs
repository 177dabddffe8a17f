//! Telemetry files, each with its digest and the time that it covers.

use crate::WorkflowError;
use dragfree_archive::files::sha256_of;
use dragfree_engine::EngineError;
use dragfree_engine::replay::Replay;
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::time::SystemTime;

/// A telemetry file.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct InboxFile {
    /// Where it lies.
    pub path: PathBuf,
    /// Its digest.
    pub sha256: String,
    /// First time in it, Unix ns.
    pub first_ns: i64,
    /// Last time in it, Unix ns.
    pub last_ns: i64,
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

/// What was read of a file, with its length and time of change then.
#[derive(Debug, Serialize, Deserialize)]
struct Known {
    size: u64,
    modified: Option<SystemTime>,
    file: Result<InboxFile, String>,
}

impl Inbox {
    /// What an earlier program has read of the files, so that each is read once; nothing where there is no such file.
    pub fn remembered(path: &Path) -> Self {
        let text = std::fs::read(path).ok();
        let known = text.and_then(|text| serde_json::from_slice(&text).ok()).unwrap_or_default();
        Self { known, ..Self::default() }
    }

    /// Keeps what was read of the files. It only saves time, so that a failure is no matter.
    pub fn remember(&self, path: &Path) {
        let keep = || -> Option<()> {
            let file = tempfile::NamedTempFile::new_in(path.parent()?).ok()?;
            serde_json::to_writer(&file, &self.known).ok()?;
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
            let stat = std::fs::metadata(&path).ok();
            let size = stat.as_ref().map_or(0, std::fs::Metadata::len);
            let modified = stat.and_then(|s| s.modified().ok());
            if self.known.get(&path).is_none_or(|known| (known.size, known.modified) != (size, modified)) {
                let file = read(&path, spacecraft);
                self.known.insert(path.clone(), Known { size, modified, file });
            }
            match self.known.get(&path).map(|known| &known.file) {
                Some(Ok(file)) if contents.insert(file.sha256.clone()) => self.files.push(file.clone()),
                Some(Err(reason)) => self.strangers.push((path, reason.clone())),
                _ => {}
            }
        }
        self.files.sort_by_key(|file| (file.first_ns, file.last_ns, file.path.clone()));
        Ok(())
    }
}

/// Time and digest of a file; a sentence where it is no telemetry of the spacecraft.
fn read(path: &Path, spacecraft: &str) -> Result<InboxFile, String> {
    let sha256 = sha256_of(path).map_err(|e| e.to_string())?;
    let replay = Replay::open(&[path.to_owned()], None, 1).map_err(|e| EngineError::from(e).to_string())?;
    let info = replay.info();
    if !info.spacecraft.is_empty() && info.spacecraft != spacecraft {
        return Err(format!("it is of spacecraft {}, not of {spacecraft}", info.spacecraft));
    }
    let (Some(first_ns), Some(last_ns)) = (info.first_ns, info.last_ns) else {
        return Err("it holds no message with a time".to_owned());
    };
    Ok(InboxFile { path: path.to_owned(), sha256, first_ns, last_ns })
}
