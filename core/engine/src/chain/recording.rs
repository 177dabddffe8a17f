//! What the stages before the effects have made of some data, kept in a file for as long as the program needs it.
//!
//! A diagnosis reads the same data many times, each time with other effects. The stages before the effects make the
//! same rows each time, so they are kept when they are made first and read from then on.

use std::collections::BTreeSet;
use std::fs::File;
use std::io::{BufWriter, Read as _, Seek as _, SeekFrom, Write as _};
use std::sync::{Arc, Mutex, PoisonError};

use super::queue::Queue;
use super::{Call, Chain, ChainError, ChainNode, Reader, Sink, To, check_join};
use crate::limits::RECORDING_BYTES;
use crate::table::{Batch, TableSpec};

/// Rows of one block of a file.
const BLOCK_ROWS: usize = 4096;

/// Rows that were kept, by what has made them. Their file has no name and is gone with the program.
#[derive(Debug, Default)]
pub struct Recordings {
    all: Mutex<Vec<Arc<Recording>>>,
}

/// The rows of some tables.
#[derive(Debug)]
pub(crate) struct Recording {
    /// Data and stages that have made them.
    made_by: String,
    tables: Vec<TableSpec>,
    file: File,
    blocks: Vec<Stretch>,
}

/// Some rows of all tables, which have the same times.
#[derive(Debug)]
struct Stretch {
    time_ns: Vec<i64>,
    /// Where the first column begins in the file.
    at: u64,
}

/// Takes rows while stages make them.
#[derive(Debug)]
pub(super) struct Recorder {
    made_by: String,
    tables: Vec<TableSpec>,
    pub(super) inputs: Vec<Queue>,
    file: BufWriter<File>,
    blocks: Vec<Stretch>,
    bytes: u64,
    most_bytes: u64,
}

impl Recordings {
    /// Rows of the same data from the same stages, with all that the effects and the host of a chain read.
    pub(crate) fn find(&self, made_by: &str, chain: &Chain) -> Option<Arc<Recording>> {
        let all = self.all.lock().unwrap_or_else(PoisonError::into_inner);
        all.iter().find(|recording| recording.made_by == made_by && recording.serves(chain)).cloned()
    }

    fn add(&self, recording: Recording) {
        self.all.lock().unwrap_or_else(PoisonError::into_inner).push(Arc::new(recording));
    }

    /// Bytes that may still be kept.
    fn left(&self) -> u64 {
        let all = self.all.lock().unwrap_or_else(PoisonError::into_inner);
        RECORDING_BYTES.saturating_sub(all.iter().map(|recording| recording.bytes()).sum())
    }
}

impl Recording {
    fn bytes(&self) -> u64 {
        let columns: usize = self.tables.iter().map(|t| t.columns.len()).sum();
        let rows: usize = self.blocks.iter().map(|block| block.time_ns.len()).sum();
        (8 * columns * rows) as u64
    }

    /// Whether it has all columns that effects and the host of a chain read.
    fn serves(&self, chain: &Chain) -> bool {
        let kept = |table: &str| self.tables.iter().any(|own| own.name == table);
        let inputs = chain.nodes.iter().filter(|n| n.is_effect).flat_map(|n| &n.inputs).chain(&chain.tap.inputs);
        let made = |table: &str| {
            let mut effects = chain.nodes.iter().filter(|n| n.is_effect).flat_map(|n| &n.writes);
            effects.any(|own| own.name == table)
        };
        inputs.map(|queue| queue.table.as_str()).all(|table| kept(table) || made(table))
    }

    /// Times of the blocks.
    pub(crate) fn blocks(&self) -> impl Iterator<Item = &[i64]> {
        self.blocks.iter().map(|block| block.time_ns.as_slice())
    }

    /// The columns of a block that `wanted` asks for, table by table; the others stay empty.
    fn read(&self, block: usize, wanted: &[Vec<bool>]) -> std::io::Result<Vec<Batch>> {
        let block = &self.blocks[block];
        let rows = block.time_ns.len();
        let mut at = block.at;
        let mut batches = Vec::new();
        for (table, wanted) in self.tables.iter().zip(wanted) {
            let mut batch = Batch { time_ns: block.time_ns.clone(), columns: vec![Vec::new(); table.columns.len()] };
            for (column, wanted) in batch.columns.iter_mut().zip(wanted) {
                if *wanted {
                    column.resize(rows, 0.0);
                    (&self.file).seek(SeekFrom::Start(at))?;
                    (&self.file).read_exact(bytemuck::cast_slice_mut(column))?;
                }
                at += 8 * rows as u64;
            }
            batches.push(batch);
        }
        Ok(batches)
    }
}

impl Recorder {
    /// Writes rows that all tables have, a block of them, or `all` of them. A recorder that cannot go on says why.
    pub(super) fn pour(&mut self, all: bool) -> Result<(), String> {
        let least = if all { 1 } else { BLOCK_ROWS };
        loop {
            let rows = self.inputs.iter().map(Queue::rows).min().unwrap_or(0).min(BLOCK_ROWS);
            if rows < least {
                return Ok(());
            }
            self.inputs.iter_mut().for_each(|queue| queue.gather(rows));
            check_join("the recording", &self.inputs, rows).map_err(|e| e.to_string())?;
            self.blocks.push(Stretch { time_ns: self.inputs[0].times(rows).to_vec(), at: self.bytes });
            for column in self.inputs.iter().flat_map(|queue| queue.front(rows).columns) {
                self.bytes += 8 * rows as u64;
                if self.bytes > self.most_bytes {
                    return Err(format!("it would be larger than {} bytes", self.most_bytes));
                }
                self.file.write_all(bytemuck::cast_slice(column)).map_err(|e| e.to_string())?;
            }
            self.inputs.iter_mut().for_each(|queue| queue.consume(rows));
        }
    }
}

impl Chain {
    /// Keeps what the stages before the effects make at the rate of what the host reads: all of it, as later passes
    /// read other columns. Where it cannot be kept, nothing is lost but time.
    pub(crate) fn record(&mut self, made_by: String, recordings: &Recordings) {
        let stages = || self.nodes.iter().filter(|n| !n.is_effect).flat_map(|n| &n.writes);
        let read = |table: &&TableSpec| self.tap.inputs.iter().any(|queue| queue.table == table.name);
        let Some(rate_hz) = stages().find(read).map(|t| t.rate_hz).filter(|hz| *hz > 0.0) else { return };
        let tables: Vec<TableSpec> = stages().filter(|t| t.rate_hz == rate_hz).cloned().collect();
        let Ok(file) = tempfile::tempfile() else { return };
        let most_bytes = recordings.left().min(free_bytes(&file) / 2);
        let inputs = tables.iter().map(|t| Queue::new(t.name.clone(), true, t.columns.len())).collect();
        for (input, table) in tables.iter().enumerate() {
            for (made, route) in self.nodes.iter_mut().flat_map(|n| n.writes.iter().zip(&mut n.routes)) {
                if made.name == table.name {
                    let columns = (0..made.columns.len()).collect();
                    route.readers.push(Reader { to: To::Recording, input, columns });
                }
            }
        }
        let file = BufWriter::new(file);
        self.recorder = Some(Recorder { made_by, tables, inputs, file, blocks: Vec::new(), bytes: 0, most_bytes });
    }

    /// The end of a recording.
    pub(crate) fn recorded(&mut self, recordings: &Recordings) {
        let Some(mut recorder) = self.recorder.take() else { return };
        if let Err(why) = recorder.pour(true) {
            return not_kept(&why);
        }
        let Recorder { made_by, tables, file, blocks, .. } = recorder;
        match file.into_inner() {
            Ok(file) => recordings.add(Recording { made_by, tables, file, blocks }),
            Err(e) => not_kept(&e.to_string()),
        }
    }

    /// Who made the rows that effects read: data, and stages with all that they were given.
    pub(crate) fn made_by(&self, data: &str) -> String {
        let stage = |n: &ChainNode| {
            let columns: Vec<String> = n.writes.iter().flat_map(|t| &t.columns).map(|c| format!("{c:?}")).collect();
            let digest = dragfree_archive::files::sha256(columns.join("\n"));
            format!("{} {} {} {digest}", n.name(), n.sha256, serde_json::Value::Object(n.parameters.clone()))
        };
        let stages: Vec<String> = self.nodes.iter().filter(|n| !n.is_effect).map(stage).collect();
        format!("{data}\n{}\n{}\n{}", self.mission_sha256, self.needs.join(" "), stages.join("\n"))
    }

    /// From now on rows come from a recording: the stages before the effects are not called and take none. Gives the
    /// columns of each table that are read.
    pub(crate) fn silence_stages(&mut self, recording: &Recording) -> Vec<Vec<bool>> {
        self.from_recording = true;
        let is_effect: Vec<bool> = self.nodes.iter().map(|n| n.is_effect).collect();
        for route in self.nodes.iter_mut().flat_map(|n| &mut n.routes) {
            route.readers.retain(|reader| !matches!(reader.to, To::Node(n) if !is_effect[n]));
            // The host has what it asked for by the tap; not every column is there to be archived.
            route.archive = false;
        }
        let read = |table: &TableSpec| {
            let routes = self.nodes.iter().flat_map(|n| n.writes.iter().zip(&n.routes));
            let own = routes.filter(|(made, _)| made.name == table.name).flat_map(|(_, route)| &route.readers);
            let read: BTreeSet<usize> = own.flat_map(|reader| reader.columns.iter().copied()).collect();
            (0..table.columns.len()).map(|c| read.contains(&c)).collect()
        };
        recording.tables.iter().map(read).collect()
    }

    /// Hands the rows of a block of a recording, in the columns that [`Self::silence_stages`] gave, to the effects and
    /// to the host.
    ///
    /// # Errors
    /// The file cannot be read, or as [`Chain::feed`].
    pub(crate) fn play(
        &mut self,
        recording: &Recording,
        block: usize,
        wanted: &[Vec<bool>],
        sink: &mut dyn Sink,
    ) -> Result<(), ChainError> {
        let mut batches = recording.read(block, wanted).map_err(|e| ChainError::Recording { what: e.to_string() })?;
        for i in 0..self.nodes.len() {
            let made = |table: &TableSpec| {
                let own = recording.tables.iter().position(|kept| kept.name == table.name);
                own.map_or_else(|| Batch::empty(table.columns.len()), |k| std::mem::take(&mut batches[k]))
            };
            if !self.nodes[i].is_effect {
                let made = self.nodes[i].writes.iter().map(made).collect();
                self.distribute(i, made, sink)?;
            }
        }
        let last_ns = recording.blocks[block].time_ns.last().copied().unwrap_or(i64::MIN);
        self.complete_until_ns = last_ns.saturating_add(1);
        while self.round(Call::AnyRows, sink)? {}
        Ok(())
    }
}

/// Says why a recording is given up: the data are then read from their files each time.
pub(super) fn not_kept(why: &str) {
    tracing::info!("what the stages make is not kept: {why}; each pass reads the telemetry");
}

#[cfg(unix)]
fn free_bytes(file: &File) -> u64 {
    rustix::fs::fstatvfs(file).map_or(0, |space| space.f_frsize.saturating_mul(space.f_bavail))
}

#[cfg(not(unix))]
fn free_bytes(_file: &File) -> u64 {
    u64::MAX
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::table::Column;

    fn recorder(most_bytes: u64) -> Recorder {
        let column = |table: &str, name: &str| Column {
            table: table.to_owned(),
            name: name.to_owned(),
            unit: String::new(),
            frame: String::new(),
            rate_hz: 10.0,
            attributes: std::collections::BTreeMap::new(),
        };
        let table = |name: &str, columns: &[&str]| TableSpec {
            name: name.to_owned(),
            rate_hz: 10.0,
            columns: columns.iter().map(|c| column(name, c)).collect(),
            truth: false,
        };
        let tables = vec![table("a", &["x", "y"]), table("b", &["z"])];
        Recorder {
            made_by: "test".to_owned(),
            inputs: tables.iter().map(|t| Queue::new(t.name.clone(), true, t.columns.len())).collect(),
            tables,
            file: BufWriter::new(tempfile::tempfile().expect("a file")),
            blocks: Vec::new(),
            bytes: 0,
            most_bytes,
        }
    }

    /// Rows from `first` on; the k-th column of a table has the value `k` and a thousandth of the row.
    fn rows(columns: usize, times: std::ops::Range<i64>) -> Arc<Batch> {
        let column = |k: usize| times.clone().map(|t| k as f64 + 0.001 * t as f64).collect();
        Arc::new(Batch { time_ns: times.clone().collect(), columns: (0..columns).map(column).collect() })
    }

    fn take(recorder: &mut Recorder, rows_of_a: i64, rows_of_b: i64) -> Result<(), String> {
        for (input, columns, count) in [(0, 2, rows_of_a), (1, 1, rows_of_b)] {
            let all: Arc<[usize]> = (0..columns).collect();
            for from in (0..count).step_by(1000) {
                recorder.inputs[input].push(&rows(columns, from..count.min(from + 1000)), &all);
            }
        }
        recorder.pour(false)?;
        recorder.pour(true)
    }

    #[test]
    fn what_is_read_is_what_was_written_and_unwanted_columns_are_left_out() {
        let mut recorder = recorder(u64::MAX);
        take(&mut recorder, 10_000, 10_000).expect("written");
        let Recorder { made_by, tables, file, blocks, .. } = recorder;
        let recording = Recording { made_by, tables, file: file.into_inner().expect("written"), blocks };
        assert_eq!(recording.bytes(), 3 * 8 * 10_000);
        let mut from = 0;
        for block in 0..recording.blocks().count() {
            let batches = recording.read(block, &[vec![false, true], vec![true]]).expect("readable");
            let times = from..from + batches[0].rows() as i64;
            from = times.end;
            assert!(batches[0].columns[0].is_empty());
            assert_eq!(batches[0].columns[1], rows(2, times.clone()).columns[1]);
            assert_eq!(batches[1], *rows(1, times));
        }
        assert_eq!(from, 10_000);
    }

    #[test]
    fn what_does_not_fit_ends_a_recording() {
        let refused = take(&mut recorder(100_000), 10_000, 10_000);
        assert!(refused.is_err_and(|why| why.contains("100000 bytes")));
    }
}
