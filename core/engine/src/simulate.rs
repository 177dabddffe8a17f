//! Telemetry files from a source plugin: one a day, the truth apart.

use chrono::{DateTime, NaiveDate};
use std::ops::Range;
use std::path::PathBuf;
use std::sync::mpsc::{SyncSender, sync_channel};
use std::thread::{Scope, ScopedJoinHandle};

use crate::EngineError;
use crate::config::Mission;
use crate::feed::{Feed, SourceFeed, SourceOptions};
use crate::registry::Registry;
use crate::run::Progress;
use crate::sealed::{DIGEST_KEY, Sealed};
use crate::stop;
use crate::table::{Chunk, TableSpec};
use crate::telemetry::{FileHeader, TelemetryWriter, WriteError};
use dragfree_archive::files::IoContext as _;

/// What to simulate.
#[derive(Clone, Debug)]
pub struct SimulateOptions {
    /// Mission file.
    pub mission: PathBuf,
    /// Folder of the files; the truth goes into its folder `truth`.
    pub out: PathBuf,
    /// First time, Unix ns.
    pub start_ns: i64,
    /// End, exclusive, Unix ns.
    pub end_ns: i64,
    /// Id of the source plugin.
    pub source: String,
    /// Its parameters.
    pub parameters: toml::Table,
    /// Version of the program.
    pub software: String,
    /// Threads that may work: with more than one, telemetry and truth are each written on a thread of their own.
    pub threads: usize,
}

/// What was simulated.
#[derive(Clone, Debug, Default)]
pub struct SimulateOutcome {
    /// Telemetry, one file a day.
    pub files: Vec<PathBuf>,
    /// The truth of the same days.
    pub truth_files: Vec<PathBuf>,
    /// What the source hides, when it hides something.
    pub sealed_file: Option<PathBuf>,
}

const DAY_NS: i64 = 86_400_000_000_000;

/// Simulates, and writes what the spacecraft would have sent.
///
/// # Errors
/// The source refuses or fails; a file is there already.
pub fn simulate(
    registry: &Registry,
    options: &SimulateOptions,
    progress: &mut dyn FnMut(Progress),
) -> Result<SimulateOutcome, EngineError> {
    let mission = Mission::load(&options.mission)?;
    let window = options.start_ns..options.end_ns;
    if window.is_empty() {
        return Err(EngineError::EmptyWindow);
    }
    for day in days(&window) {
        for path in [options.path(&mission, day, false), options.path(&mission, day, true)] {
            if path.exists() {
                return Err(EngineError::Exists { path });
            }
        }
    }
    let mut feed = SourceFeed::open(
        registry,
        &options.source,
        &mission,
        &SourceOptions {
            given_in: "the command line".to_owned(),
            parameters: &options.parameters,
            files: &[],
            window_ns: Some(window.clone()),
            // What fits a second-level cache goes through the writer while it is there.
            rows: 1024,
        },
    )?;
    let sealed = feed.sealed()?;
    let sealed_file = sealed.as_ref().map(|_| options.sealed_path(&mission, &window));
    if let (Some(sealed), Some(path)) = (&sealed, &sealed_file) {
        sealed.write(path)?;
    }
    std::thread::scope(|scope| {
        let mut days = DayFiles {
            scope,
            options,
            mission: &mission,
            tables: feed.tables().to_vec(),
            open: None,
            done: SimulateOutcome { sealed_file, ..SimulateOutcome::default() },
            sealed,
        };
        loop {
            let chunk = match feed.next() {
                Ok(Some(chunk)) => chunk,
                Ok(None) => break,
                // A writer that failed has failed at earlier rows.
                Err(failure) => return Err(days.abandon().err().unwrap_or(failure)),
            };
            progress(Progress { until_ns: chunk.complete_until_ns, first_ns: window.start, end_ns: Some(window.end) });
            days.write(chunk)?;
            if let Err(stopped) = stop::check() {
                return Err(days.abandon().err().unwrap_or(stopped));
            }
        }
        days.close()?;
        Ok(days.done)
    })
}

fn days(window: &Range<i64>) -> impl Iterator<Item = NaiveDate> {
    let (first, last) = (window.start.div_euclid(DAY_NS), (window.end - 1).div_euclid(DAY_NS));
    (first..=last).map(|day| DateTime::from_timestamp_nanos(day * DAY_NS).date_naive())
}

impl SimulateOptions {
    fn path(&self, mission: &Mission, day: NaiveDate, truth: bool) -> PathBuf {
        let folder = if truth { self.out.join("truth") } else { self.out.clone() };
        folder.join(format!("{}_{day}.mcap", mission.spacecraft))
    }

    fn sealed_path(&self, mission: &Mission, window: &Range<i64>) -> PathBuf {
        let day = DateTime::from_timestamp_nanos(window.start).date_naive();
        self.out.join("truth").join(format!("{}_{day}.sealed.json", mission.spacecraft))
    }
}

/// Chunks that wait for a writer: enough to keep it busy, and memory stays flat.
const QUEUE: usize = 4;

/// A writer on this thread or on one of its own.
enum Pen<'scope> {
    Here(Box<TelemetryWriter>),
    There { queue: SyncSender<Option<Chunk>>, thread: ScopedJoinHandle<'scope, Result<Option<PathBuf>, WriteError>> },
}

impl<'scope> Pen<'scope> {
    fn there(scope: &'scope Scope<'scope, '_>, mut writer: TelemetryWriter) -> Self {
        let (queue, chunks) = sync_channel::<Option<Chunk>>(QUEUE);
        let thread = scope.spawn(move || {
            // A queue that ends without `None` was abandoned: its file is dropped.
            while let Ok(said) = chunks.recv() {
                match said {
                    Some(chunk) => writer.write(chunk)?,
                    None => return writer.finish().map(Some),
                }
            }
            Ok(None)
        });
        Self::There { queue, thread }
    }

    /// Writes a chunk, or queues it; gives the pen back.
    fn write(self, chunk: Chunk) -> Result<Self, WriteError> {
        match self {
            Self::Here(mut writer) => {
                writer.write(chunk)?;
                Ok(Self::Here(writer))
            }
            Self::There { queue, thread } => match queue.send(Some(chunk)) {
                Ok(()) => Ok(Self::There { queue, thread }),
                // The thread has ended: it failed at an earlier chunk.
                Err(_) => Err(join(thread).expect_err("a writer stops early only with an error")),
            },
        }
    }

    /// Leaves no file.
    fn abandon(self) -> Result<(), WriteError> {
        match self {
            Self::Here(_) => Ok(()),
            Self::There { queue, thread } => {
                drop(queue);
                join(thread).map(drop)
            }
        }
    }

    fn finish(self) -> Result<PathBuf, WriteError> {
        match self {
            Self::Here(writer) => writer.finish(),
            Self::There { queue, thread } => {
                // If the thread has ended, joining it gives its error.
                let _ = queue.send(None);
                join(thread).map(|path| path.expect("a writer that is told to finish does"))
            }
        }
    }
}

fn join<T>(thread: ScopedJoinHandle<'_, T>) -> T {
    thread.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic))
}

/// The files of the day that is being written.
struct Open<'scope> {
    end_ns: i64,
    telemetry: Pen<'scope>,
    truth: Pen<'scope>,
}

struct DayFiles<'scope, 'env> {
    scope: &'scope Scope<'scope, 'env>,
    options: &'env SimulateOptions,
    mission: &'env Mission,
    tables: Vec<TableSpec>,
    open: Option<Open<'scope>>,
    done: SimulateOutcome,
    sealed: Option<Sealed>,
}

impl<'scope> DayFiles<'scope, '_> {
    fn write(&mut self, mut chunk: Chunk) -> Result<(), EngineError> {
        while let Some(first) = chunk.batches.iter().filter_map(|b| b.time_ns.first()).min().copied() {
            if self.open.as_ref().is_some_and(|open| first >= open.end_ns) {
                self.close()?;
            }
            let Open { end_ns, telemetry, truth } = match self.open.take() {
                Some(open) => open,
                None => self.create(first)?,
            };
            let later = chunk.split_off(end_ns);
            let [mut mine, mut apart] =
                [(); 2].map(|()| Chunk { complete_until_ns: chunk.complete_until_ns, ..Chunk::default() });
            for (batch, table) in chunk.batches.into_iter().zip(&self.tables) {
                if table.truth { &mut apart } else { &mut mine }.batches.push(batch);
            }
            self.open = Some(Open { end_ns, telemetry: telemetry.write(mine)?, truth: truth.write(apart)? });
            chunk = later;
        }
        Ok(())
    }

    fn create(&mut self, time_ns: i64) -> Result<Open<'scope>, EngineError> {
        let start = time_ns.div_euclid(DAY_NS) * DAY_NS;
        let day = DateTime::from_timestamp_nanos(start).date_naive();
        let header = FileHeader {
            time_scale: "UTC".to_owned(),
            mission: self.mission.name.clone(),
            spacecraft: self.mission.spacecraft.clone(),
            producer: self.options.source.clone(),
            version: self.options.software.clone(),
            // The digest and nothing else: the telemetry must not tell what is hidden.
            extra: self.sealed.iter().map(|s| (DIGEST_KEY.to_owned(), s.sha256.clone())).collect(),
        };
        let pen = |truth: bool, tables: &[TableSpec]| {
            let path = self.options.path(self.mission, day, truth);
            if let Some(folder) = path.parent() {
                std::fs::create_dir_all(folder).at("make the folder", folder)?;
            }
            let tables: Vec<TableSpec> = tables.iter().filter(|t| t.truth == truth).cloned().collect();
            let writer = TelemetryWriter::create(&path, &tables, &header)?;
            Ok::<_, EngineError>(if self.options.threads > 1 {
                Pen::there(self.scope, writer)
            } else {
                Pen::Here(Box::new(writer))
            })
        };
        Ok(Open { end_ns: start + DAY_NS, telemetry: pen(false, &self.tables)?, truth: pen(true, &self.tables)? })
    }

    fn abandon(&mut self) -> Result<(), EngineError> {
        if let Some(open) = self.open.take() {
            open.telemetry.abandon()?;
            open.truth.abandon()?;
        }
        Ok(())
    }

    fn close(&mut self) -> Result<(), EngineError> {
        if let Some(open) = self.open.take() {
            self.done.truth_files.push(open.truth.finish()?);
            self.done.files.push(open.telemetry.finish()?);
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::table::Batch;
    use crate::telemetry::interface_tables;

    /// Times and one number for every column of `ifo`.
    fn chunk(table: &TableSpec, times: &[i64]) -> Chunk {
        let batch =
            Batch { time_ns: times.to_vec(), columns: table.columns.iter().map(|_| vec![0.0; times.len()]).collect() };
        Chunk { batches: vec![batch], complete_until_ns: times.last().map_or(0, |t| t + 1) }
    }

    /// Writes `chunks` on another thread, `end`s, and tells how many files there are.
    fn write(chunks: &[&[i64]], end: fn(Pen<'_>) -> Result<(), WriteError>) -> (Result<(), WriteError>, usize) {
        let folder = tempfile::tempdir().unwrap();
        let table: Vec<TableSpec> = interface_tables().into_iter().filter(|t| t.name == "ifo").collect();
        let writer = TelemetryWriter::create(&folder.path().join("a.mcap"), &table, &FileHeader::default()).unwrap();
        let result = std::thread::scope(|scope| {
            let pen =
                chunks.iter().try_fold(Pen::there(scope, writer), |pen, times| pen.write(chunk(&table[0], times)));
            end(pen?)
        });
        (result, std::fs::read_dir(folder.path()).unwrap().count())
    }

    #[test]
    fn another_thread_says_why_it_cannot_write() {
        let finish = |pen: Pen<'_>| pen.finish().map(drop);
        let (done, files) = write(&[&[0, 1], &[2], &[3]], finish);
        assert!(done.is_ok() && files == 1);
        let abandon = |pen: Pen<'_>| pen.abandon();
        let (done, files) = write(&[&[0, 1], &[2]], abandon);
        assert!(done.is_ok() && files == 0);
        // More chunks after the bad one than the queue holds, and none: both ways of noticing.
        for later in [0, 10] {
            let mut chunks: Vec<&[i64]> = vec![&[5, 6], &[4]];
            chunks.extend(std::iter::repeat_n(&[9_i64] as &[i64], later));
            let (failed, files) = write(&chunks, finish);
            assert!(matches!(failed, Err(WriteError::OutOfOrder { time_ns: 4, .. })) && files == 0, "{failed:?}");
            assert!(write(&chunks, abandon).0.is_err());
        }
    }
}
