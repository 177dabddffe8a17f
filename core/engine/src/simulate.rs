//! Telemetry files from a source plugin: one a day, the truth apart.

use chrono::{DateTime, NaiveDate};
use std::ops::Range;
use std::path::PathBuf;

use crate::EngineError;
use crate::config::Mission;
use crate::feed::{Feed, SourceFeed, SourceOptions};
use crate::registry::Registry;
use crate::run::Progress;
use crate::table::{Batch, Chunk, TableSpec};
use crate::telemetry::{FileHeader, TelemetryWriter};

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
}

/// What was simulated.
#[derive(Clone, Debug, Default)]
pub struct SimulateOutcome {
    /// Telemetry, one file a day.
    pub files: Vec<PathBuf>,
    /// The truth of the same days.
    pub truth_files: Vec<PathBuf>,
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
            rows: 8192,
        },
    )?;
    let mut days = DayFiles {
        options,
        mission: &mission,
        tables: feed.tables().to_vec(),
        open: None,
        done: SimulateOutcome::default(),
    };
    let mut epochs = 0;
    while let Some(chunk) = feed.next()? {
        epochs += chunk.batches.iter().map(Batch::rows).max().unwrap_or(0) as u64;
        progress(Progress {
            until_ns: chunk.complete_until_ns,
            first_ns: window.start,
            end_ns: Some(window.end),
            epochs,
        });
        days.write(&chunk)?;
    }
    days.close()?;
    Ok(days.done)
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
}

/// The files of the day that is being written.
struct Open {
    end_ns: i64,
    telemetry: TelemetryWriter,
    truth: TelemetryWriter,
}

struct DayFiles<'a> {
    options: &'a SimulateOptions,
    mission: &'a Mission,
    tables: Vec<TableSpec>,
    open: Option<Open>,
    done: SimulateOutcome,
}

impl DayFiles<'_> {
    fn write(&mut self, chunk: &Chunk) -> Result<(), EngineError> {
        let mut starts = vec![0; chunk.batches.len()];
        loop {
            let first = chunk.batches.iter().zip(&starts).filter_map(|(b, s)| b.time_ns.get(*s)).min().copied();
            let Some(first) = first else { return Ok(()) };
            if self.open.as_ref().is_some_and(|open| first >= open.end_ns) {
                self.close()?;
            }
            let open = match self.open.take() {
                Some(open) => open,
                None => self.create(first)?,
            };
            let until = chunk.complete_until_ns.min(open.end_ns);
            let (mut telemetry, mut truth) = (
                Chunk { batches: Vec::new(), complete_until_ns: until },
                Chunk { batches: Vec::new(), complete_until_ns: until },
            );
            for ((batch, start), table) in chunk.batches.iter().zip(&mut starts).zip(&self.tables) {
                let end = batch.time_ns.partition_point(|t| *t < open.end_ns);
                let cut = Batch {
                    time_ns: batch.time_ns[*start..end].to_vec(),
                    columns: batch.columns.iter().map(|c| c[*start..end].to_vec()).collect(),
                };
                *start = end;
                if table.truth { &mut truth } else { &mut telemetry }.batches.push(cut);
            }
            let open = self.open.insert(open);
            open.telemetry.write(&telemetry)?;
            open.truth.write(&truth)?;
        }
    }

    fn create(&mut self, time_ns: i64) -> Result<Open, EngineError> {
        let start = time_ns.div_euclid(DAY_NS) * DAY_NS;
        let day = DateTime::from_timestamp_nanos(start).date_naive();
        let header = FileHeader {
            time_scale: "UTC".to_owned(),
            mission: self.mission.name.clone(),
            spacecraft: self.mission.spacecraft.clone(),
            producer: self.options.source.clone(),
            version: self.options.software.clone(),
            ..FileHeader::default()
        };
        let writer = |truth: bool, tables: &[TableSpec]| {
            let path = self.options.path(self.mission, day, truth);
            if let Some(folder) = path.parent() {
                std::fs::create_dir_all(folder).map_err(|source| EngineError::Io {
                    action: "make the folder",
                    path: folder.to_owned(),
                    source,
                })?;
            }
            let tables: Vec<TableSpec> = tables.iter().filter(|t| t.truth == truth).cloned().collect();
            Ok::<_, EngineError>(TelemetryWriter::create(&path, &tables, &header)?)
        };
        Ok(Open { end_ns: start + DAY_NS, telemetry: writer(false, &self.tables)?, truth: writer(true, &self.tables)? })
    }

    fn close(&mut self) -> Result<(), EngineError> {
        if let Some(open) = self.open.take() {
            self.done.truth_files.push(open.truth.finish()?.path);
            self.done.files.push(open.telemetry.finish()?.path);
        }
        Ok(())
    }
}
