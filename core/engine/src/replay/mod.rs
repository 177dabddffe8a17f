//! Replay of telemetry files: any number, overlapping, in any order, damaged, as one sequence of stretches of time.
//!
//! What is right is delivered, what is wrong is counted ([`Losses`]) or, where going on would mix what must not be
//! mixed, an error ([`ReplayError`]). Borders of stretches are multiples of a fixed length since 1970, and rows are in
//! order of time, then of the files, so nothing depends on the number of threads or the order of the arguments. Memory
//! holds the pieces of files that overlap the present stretch, never a file.

mod block;
mod clock;
mod covered;
mod inflate;
mod losses;
mod reader;
mod records;
mod scan;
mod tables;
#[cfg(test)]
mod tests;

use std::collections::{BTreeMap, BTreeSet};
use std::io;
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::mpsc::{Receiver, sync_channel};
use std::thread::{self, JoinHandle};

pub use losses::{Finding, Findings, Losses};

use crate::input::{InputFile, Sums};
use crate::table::{Chunk, TableSpec};
use crate::telemetry::{Drift, LayoutError};
use reader::{OpenFile, Reader, SANE_NS, clamp_ns, is_sane};
use scan::{Cover, Scan, ScanError, scan};

/// Stretches decoded ahead on the second thread.
const AHEAD: usize = 2;

/// Why files cannot be replayed.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs, reason = "every field is named in its sentence")]
pub enum ReplayError {
    /// No files were given.
    #[error("no telemetry files were given; name at least one .mcap file")]
    NoFiles,
    /// The file system refuses.
    #[error("cannot read {path}: {source}", path = path.display())]
    Io { path: PathBuf, source: io::Error },
    /// Another kind of file.
    #[error("{path} is not an MCAP file: it does not begin with the MCAP magic bytes; remove it from the list or convert it", path = path.display())]
    NotMcap { path: PathBuf },
    /// No file has a topic of the interface.
    #[error(
        "none of the files has messages of a topic of telemetry.proto (topics found: {found}); these are not the telemetry of a drag-free spacecraft, or an empty file"
    )]
    NoTelemetry { found: String },
    /// Files that do not belong together.
    #[error("{path} says {key} = {found:?} where the files before it say {before:?}; replay them apart", path = path.display())]
    Mixed { path: PathBuf, key: &'static str, found: String, before: String },
    /// A time scale that nobody knows.
    #[error("{path} says time_scale = {found:?}; it must be UTC, TAI or GPS", path = path.display())]
    TimeScale { path: PathBuf, found: String },
    /// A topic of the interface in another encoding.
    #[error("{path}: topic {topic} carries {encoding}; telemetry must be protobuf with a protobuf schema", path = path.display())]
    Encoding { path: PathBuf, topic: String, encoding: String },
    /// A schema that cannot be used.
    #[error("{path}: topic {topic}: {source}; have the file written again by its producer", path = path.display())]
    Schema { path: PathBuf, topic: String, source: LayoutError },
    /// A schema that is not what the interface says.
    #[error("{path}: schema drift in topic {topic}: {source}; convert the file or agree on a new telemetry.proto", path = path.display())]
    Drift { path: PathBuf, topic: String, source: Drift },
    /// One housekeeping topic in two units.
    #[error("{path}: topic {topic} is in {found:?} where the files before it have {before:?}; convert one of them", path = path.display())]
    MixedUnits { path: PathBuf, topic: String, found: String, before: String },
    /// A file is not what it was.
    #[error("{path} was changed while it was read, so that its rows are of no one file; run again when it is complete", path = path.display())]
    Changed { path: PathBuf },
    /// Rows that must wait for earlier ones take too much memory.
    #[error("{path}: the chunk at byte {offset} and what waits for its turn make more than {} MiB of rows; write the file in order of time, in chunks of a few MiB (`mcap sort`, `mcap compress`)", crate::limits::ROWS_IN_FLIGHT_BYTES >> 20, path = path.display())]
    TooMuchAtOnce { path: PathBuf, offset: u64 },
    /// More topics or columns than telemetry can have.
    #[error("{path}: {what}; this is no telemetry of a spacecraft", path = path.display())]
    TooManyColumns { path: PathBuf, what: String },
    /// The thread that reads ahead ended without a word.
    #[error("the reading thread died; this is a defect of dragfree, please report it with the files")]
    Worker,
}

/// Whose data these are and from when.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct ReplayInfo {
    /// `UTC`, `TAI` or `GPS`; empty when no file says.
    pub time_scale: String,
    /// Spacecraft; empty when no file says.
    pub spacecraft: String,
    /// Stretches without a gap of more than a day in which the files have messages, Unix ns, in order, before any
    /// window; a few messages by themselves are left out, as they are dropped.
    pub covered_ns: Vec<Range<i64>>,
}

/// A replay under way.
#[derive(Debug)]
pub struct Replay {
    tables: Vec<TableSpec>,
    info: ReplayInfo,
    findings: Findings,
    engine: Engine,
    /// The files in the order in which they were given.
    checked: Vec<CheckedFile>,
    threads: usize,
    /// Their digests, where they are taken ahead.
    sums: Option<JoinHandle<Vec<io::Result<Sums>>>>,
}

/// A file, and what its own sums say of it.
#[derive(Clone, Debug)]
struct CheckedFile {
    input: Arc<InputFile>,
    /// Where its data section ends, and the CRC, where it has one.
    checked_until: Option<(u64, u32)>,
    /// Which other CRCs cover its messages.
    cover: Cover,
}

/// Who reads.
#[derive(Debug)]
enum Engine {
    Here(Box<Reader>),
    Ahead { stretches: Receiver<Stretch>, thread: Option<JoinHandle<()>> },
}

/// A stretch, or the end, and what was met until then.
type Stretch = Result<(Option<Chunk>, Findings), ReplayError>;

impl Replay {
    /// Opens `files` for the log times within `window_ns` (Unix ns, all when `None`); with two or more `threads` the
    /// reading goes ahead on a thread of its own. Files are put in order of their first time, then of their name.
    ///
    /// # Errors
    /// [`ReplayError`] when a file cannot be read at all or does not fit the others or the interface.
    pub fn open(files: &[PathBuf], window_ns: Option<Range<i64>>, threads: usize) -> Result<Self, ReplayError> {
        Self::open_with_run_in(files, window_ns, None, threads)
    }

    /// The same, where what comes before `run_in_until_ns`, Unix ns, only settles what reads it: what is wrong in
    /// pieces of files that end before is told apart ([`Findings::of_run_in`]).
    ///
    /// # Errors
    /// As [`Self::open`].
    pub fn open_with_run_in(
        files: &[PathBuf],
        window_ns: Option<Range<i64>>,
        run_in_until_ns: Option<i64>,
        threads: usize,
    ) -> Result<Self, ReplayError> {
        if files.is_empty() {
            return Err(ReplayError::NoFiles);
        }
        let mut losses = Losses::default();
        let mut scans = Vec::with_capacity(files.len());
        let mut checked = Vec::with_capacity(files.len());
        for path in files.iter().cloned() {
            let input = match InputFile::open(&path) {
                Ok(input) => Arc::new(input),
                Err(source) => return Err(ReplayError::Io { path, source }),
            };
            match scan(&input, &mut losses) {
                Ok(scan) => {
                    let Scan { checked_until, cover, .. } = scan;
                    checked.push(CheckedFile { input: Arc::clone(&input), checked_until, cover });
                    scans.push((input, scan));
                }
                Err(ScanError::Io(source)) => return Err(ReplayError::Io { path, source }),
                Err(ScanError::NotMcap) => return Err(ReplayError::NotMcap { path }),
            }
        }
        let mut files = scans;
        // By name before path, as of conflicting messages those of the first file count, wherever the files lie.
        files.sort_by_cached_key(|(input, scan)| (first_time(scan), name_of(input.path()), input.path().to_owned()));
        let mut info = info(&files, &mut losses)?;
        for (input, scan) in &files {
            let covered = covered::covered(input, &scan.pieces);
            info.covered_ns
                .extend(covered.map_err(|source| ReplayError::Io { path: input.path().to_owned(), source })?);
        }
        info.covered_ns = covered::joined(info.covered_ns);
        let (tables, routes) = tables::link(&files, &mut losses)?;
        // Files that ended before their first channel are a loss, not the wrong files.
        if tables.is_empty() && !losses.data_loss() {
            let channels = files.iter().flat_map(|(_, scan)| scan.definitions.channels.values());
            let topics: BTreeSet<&str> = channels.map(|channel| channel.topic.as_str()).collect();
            return Err(ReplayError::NoTelemetry { found: Vec::from_iter(topics).join(", ") });
        }
        let files = (files.into_iter().zip(routes))
            .map(|((input, scan), routes)| OpenFile { input, pieces: scan.pieces, routes, messages: scan.messages })
            .collect();
        let (window_ns, run_in_until_ns) = (window_ns.unwrap_or(SANE_NS), run_in_until_ns.unwrap_or(i64::MIN));
        let reader = Reader::new(files, tables.clone(), window_ns, run_in_until_ns, losses)?;
        let findings = reader.findings().clone();
        let engine = if threads < 2 { Engine::Here(Box::new(reader)) } else { ahead(reader) };
        Ok(Self { tables, info, findings, engine, checked, threads, sums: None })
    }

    /// Takes the digests of the files while they are read, where there are several threads.
    pub fn hash_ahead(&mut self) {
        if self.threads < 2 {
            return;
        }
        let (checked, threads) = (self.checked.clone(), self.threads - 1);
        // Where the system allows no more threads, they are taken when they are asked for.
        self.sums = thread::Builder::new().spawn(move || all_sums(&checked, threads)).ok();
    }

    /// The tables, in the order of the interface, housekeeping last by name. A table that is not here is a topic that
    /// no file has.
    pub fn tables(&self) -> &[TableSpec] {
        &self.tables
    }

    /// Whose data these are and from when.
    pub fn info(&self) -> &ReplayInfo {
        &self.info
    }

    /// The next stretch of time that has a row, one batch per table; `None` at the end.
    ///
    /// # Errors
    /// [`ReplayError::Io`] when a file can no longer be read.
    #[allow(clippy::should_implement_trait, reason = "an iterator cannot be asked for its losses between two items")]
    pub fn next(&mut self) -> Result<Option<Chunk>, ReplayError> {
        let (chunk, findings) = match &mut self.engine {
            Engine::Here(reader) => (reader.next()?, reader.findings().clone()),
            Engine::Ahead { stretches, .. } => match stretches.recv() {
                Ok(stretch) => stretch?,
                Err(_) if self.ended() => (None, self.findings.clone()),
                Err(_) => return Err(ReplayError::Worker),
            },
        };
        self.findings = findings;
        Ok(chunk)
    }

    /// What was met in the data until the last stretch delivered; complete when [`Replay::next`] has said `None`.
    pub fn losses(&self) -> &Losses {
        &self.findings.of_data
    }

    /// The same of what comes before the data and only settles what reads it.
    pub fn losses_of_run_in(&self) -> &Losses {
        &self.findings.of_run_in
    }

    /// That no file has changed since it was opened.
    ///
    /// # Errors
    /// [`ReplayError::Changed`].
    pub fn unchanged(&self) -> Result<(), ReplayError> {
        for CheckedFile { input, .. } in &self.checked {
            let path = || input.path().to_owned();
            if !input.is_unchanged().map_err(|source| ReplayError::Io { path: path(), source })? {
                return Err(ReplayError::Changed { path: path() });
            }
        }
        Ok(())
    }

    /// Size and SHA-256 of every file, in the order in which they were given, through the descriptors that the rows
    /// come through. What the CRCs of the data sections say goes to the losses.
    ///
    /// # Errors
    /// [`ReplayError::Changed`] when a file is not what it was when it was opened; it cannot be read.
    pub fn digests(&mut self) -> Result<Vec<(u64, String)>, ReplayError> {
        let mut digests = Vec::with_capacity(self.checked.len());
        let sums = match self.sums.take().map(JoinHandle::join) {
            Some(Ok(sums)) => sums,
            Some(Err(panic)) => std::panic::resume_unwind(panic),
            None => all_sums(&self.checked, self.threads),
        };
        for (file, sums) in self.checked.iter().zip(sums) {
            let path = || file.input.path().to_owned();
            let sums = sums.map_err(|source| ReplayError::Io { path: path(), source })?;
            digests.push((file.input.size(), sums.sha256));
            if file.checked_until.is_none_or(|(_, crc)| crc == sums.crc) {
                continue;
            }
            let name = name_of(file.input.path());
            let (finding, what) = match file.cover {
                Cover::All => (Finding::DamageBesideMessages, "only beside its messages, by the CRCs of their chunks"),
                Cover::Uncertain => (
                    Finding::UncheckedFiles,
                    "or was written by a program that leaves chunks without a CRC out of it; damage to them goes unseen",
                ),
                Cover::DataSectionAlone => {
                    (Finding::DamagedDataSections, "so that values in it may be wrong; fetch it again")
                }
            };
            self.findings
                .of_data
                .add(finding, 1, &name, || format!("{name} is not what the CRC of its data section says, {what}"));
        }
        self.unchanged()?;
        Ok(digests)
    }

    /// True when the reading thread came to its end in order.
    fn ended(&mut self) -> bool {
        match &mut self.engine {
            Engine::Here(_) => true,
            Engine::Ahead { thread, .. } => thread.take().is_none_or(|t| t.join().is_ok()),
        }
    }
}

/// The sums of files, several at once where there are threads.
fn all_sums(files: &[CheckedFile], threads: usize) -> Vec<io::Result<Sums>> {
    let sums = |file: &CheckedFile| file.input.sums(file.checked_until.map_or(0, |(end, _)| end));
    let each = |some: &[CheckedFile]| some.iter().map(sums).collect::<Vec<_>>();
    let share = files.len().div_ceil(threads.clamp(1, files.len().max(1))).max(1);
    thread::scope(|scope| {
        // Where the system allows no more threads, the work is done here.
        let start = |some| thread::Builder::new().spawn_scoped(scope, move || each(some)).map_err(|_| each(some));
        let running: Vec<_> = files.chunks(share).map(start).collect();
        let join = |thread: thread::ScopedJoinHandle<'_, Vec<_>>| {
            thread.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic))
        };
        running.into_iter().flat_map(|one| one.map_or_else(|done| done, join)).collect()
    })
}

fn ahead(reader: Reader) -> Engine {
    let (send, stretches) = sync_channel(AHEAD);
    // The reader is handed over once there is a thread: where the system allows no more, it stays here.
    let (hand, taken) = sync_channel::<Reader>(1);
    let thread = thread::Builder::new().spawn(move || {
        let Ok(mut reader) = taken.recv() else { return };
        loop {
            let stretch = reader.next().map(|chunk| (chunk, reader.findings().clone()));
            let more = matches!(&stretch, Ok((Some(_), _)));
            // The other side is gone when the replay was dropped: nobody wants the rest.
            if send.send(stretch).is_err() || !more {
                break;
            }
        }
    });
    match thread {
        Ok(thread) => match hand.send(reader) {
            Ok(()) => Engine::Ahead { stretches, thread: Some(thread) },
            Err(error) => Engine::Here(Box::new(error.0)),
        },
        Err(_) => Engine::Here(Box::new(reader)),
    }
}

/// First time that the pieces of a file state, as far as they are sane, Unix ns.
fn first_time(scan: &Scan) -> Option<i64> {
    scan.pieces.iter().flat_map(|p| [p.start, p.end]).filter(|&t| is_sane(t)).map(clamp_ns).min()
}

/// Name of a file in findings: without its folder, so that a product does not depend on where its telemetry lay.
fn name_of(path: &Path) -> String {
    path.file_name().unwrap_or(path.as_os_str()).to_string_lossy().into_owned()
}

fn info(files: &[(Arc<InputFile>, Scan)], losses: &mut Losses) -> Result<ReplayInfo, ReplayError> {
    let mut info = ReplayInfo::default();
    let mut said: BTreeMap<&'static str, String> = BTreeMap::new();
    for (input, scan) in files {
        let path = input.path().to_owned();
        let name = name_of(&path);
        let Some(metadata) = &scan.metadata else {
            losses.add(Finding::FilesWithoutMetadata, u64::from(scan.bytes > 0), &name, || {
                format!("{name} has no metadata record \"dragfree\": its spacecraft and time scale are taken on trust")
            });
            continue;
        };
        for key in ["time_scale", "mission", "spacecraft"] {
            let Some(found) = metadata.get(key).filter(|v| !v.is_empty()).cloned() else { continue };
            if key == "time_scale" && !matches!(found.as_str(), "UTC" | "TAI" | "GPS") {
                return Err(ReplayError::TimeScale { path, found });
            }
            let before = said.entry(key).or_insert_with(|| found.clone());
            if *before != found {
                return Err(ReplayError::Mixed { path, key, found, before: before.clone() });
            }
        }
    }
    let mut take = |key| said.remove(key).unwrap_or_default();
    (info.time_scale, info.spacecraft) = (take("time_scale"), take("spacecraft"));
    Ok(info)
}
