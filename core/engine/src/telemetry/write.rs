//! Tables as an MCAP file that every common viewer plots.

use std::collections::BTreeMap;
use std::io::{self, BufWriter};
use std::path::{Path, PathBuf};

use tempfile::NamedTempFile;

use super::encode::{EncodeError, Encoder, MessageType};
use super::mcap_file::McapFile;
use crate::table::{Batch, Chunk, TableSpec};
use dragfree_archive::files::{folder_of, sync_folder};

/// Why a file cannot be written.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs, reason = "every field is named in its sentence")]
pub enum WriteError {
    /// The file system refuses.
    #[error("cannot write {path}: {source}; check the folder, its permissions and its free space", path = path.display())]
    Io { path: PathBuf, source: io::Error },
    /// A table does not fit its message.
    #[error(transparent)]
    Encode(#[from] EncodeError),
    /// Rows that are not in order of time, or come after later ones were written.
    #[error("table {table}: a row at {time_ns} ns after one at {after_ns} ns; rows must come in order of time")]
    OutOfOrder { table: String, time_ns: i64, after_ns: i64 },
    /// A time before 1970, which a file cannot hold.
    #[error("table {table}: a row at {time_ns} ns lies before 1970; MCAP times are unsigned")]
    NegativeTime { table: String, time_ns: i64 },
    /// A batch that has not the columns of its table.
    #[error("table {table}: {found} columns of {rows} rows each were due, the batch has something else", found = columns)]
    Shape { table: String, columns: usize, rows: usize },
}

/// What the Metadata record `dragfree` says.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct FileHeader {
    /// `UTC`, `TAI` or `GPS`: what the Unix nanoseconds count.
    pub time_scale: String,
    /// Name of the mission.
    pub mission: String,
    /// Name of the spacecraft, `SC1`.
    pub spacecraft: String,
    /// Program that made the data.
    pub producer: String,
    /// Its version.
    pub version: String,
    /// Anything else worth keeping.
    pub extra: BTreeMap<String, String>,
}

/// One table on its way into the file.
struct Topic {
    name: String,
    channel: u16,
    encoder: Encoder,
    /// Rows that wait until every table has come as far.
    pending: Batch,
    /// Rows of `pending` already written.
    done: usize,
    /// Time of the last row that was written, Unix ns.
    last_ns: i64,
}

/// Writes tables into one MCAP file: protobuf, chunks of about 1 MiB, zstd, CRCs, indexes, statistics; messages in
/// order of time across topics. The file appears under its name when it is complete; until then, and after any error,
/// there is no such file.
pub struct TelemetryWriter {
    path: PathBuf,
    file: McapFile<BufWriter<NamedTempFile>>,
    topics: Vec<Topic>,
    message: Vec<u8>,
    written_until_ns: i64,
}

impl TelemetryWriter {
    /// Starts a file with one topic per table, `/` and the table's name.
    ///
    /// # Errors
    /// [`WriteError`] when the file cannot be created or a table fits no message.
    pub fn create(path: &Path, tables: &[TableSpec], header: &FileHeader) -> Result<Self, WriteError> {
        let io = |source| WriteError::Io { path: path.to_owned(), source };
        let file = BufWriter::with_capacity(1 << 18, temporary(path).map_err(io)?);
        let mut file = McapFile::new(file, &format!("{} {}", header.producer, header.version)).map_err(io)?;
        let mut metadata = header.extra.clone();
        for (key, value) in [
            ("time_scale", &header.time_scale),
            ("mission", &header.mission),
            ("spacecraft", &header.spacecraft),
            ("producer", &header.producer),
            ("version", &header.version),
        ] {
            metadata.insert(key.to_owned(), value.clone());
        }
        file.metadata("dragfree", &metadata).map_err(io)?;
        let mut topics = Vec::with_capacity(tables.len());
        for table in tables {
            let message = MessageType::of(table)?;
            let topic = format!("/{}", table.name);
            let metadata = channel_metadata(table, &message);
            let channel = file.channel(&topic, &message.name, &message.descriptor_set, &metadata).map_err(io)?;
            topics.push(Topic {
                name: table.name.clone(),
                channel,
                encoder: Encoder::new(message),
                pending: Batch::empty(table.columns.len()),
                done: 0,
                last_ns: i64::MIN,
            });
        }
        Ok(Self { path: path.to_owned(), file, topics, message: Vec::new(), written_until_ns: i64::MIN })
    }

    /// Takes the rows of a chunk, one batch per table in the order of [`TelemetryWriter::create`], and writes
    /// everything before its `complete_until_ns`.
    ///
    /// # Errors
    /// [`WriteError`]; nothing can be written after one.
    pub fn write(&mut self, chunk: Chunk) -> Result<(), WriteError> {
        for (topic, batch) in self.topics.iter_mut().zip(chunk.batches) {
            topic.accept(batch, self.written_until_ns)?;
        }
        self.write_before(chunk.complete_until_ns)
    }

    /// Writes what is left, closes the file, makes it durable and gives it its name, which is returned.
    ///
    /// # Errors
    /// [`WriteError`]; there is no file then.
    pub fn finish(mut self) -> Result<PathBuf, WriteError> {
        self.write_before(i64::MAX)?;
        let Self { path, file, .. } = self;
        let io = |source| WriteError::Io { path: path.clone(), source };
        let file = file.finish().map_err(io)?;
        let file = file.into_inner().map_err(|e| io(e.into_error()))?;
        file.as_file().sync_all().map_err(io)?;
        file.persist(&path).map_err(|e| io(e.error))?;
        // A rename is durable when its folder is.
        sync_folder(folder_of(&path)).map_err(io)?;
        Ok(path)
    }

    /// Takes rows of one table, by its number in [`TelemetryWriter::create`], and writes them at once: in order of time
    /// within the table alone, so that no table waits for another.
    ///
    /// # Errors
    /// [`WriteError`]; nothing can be written after one.
    ///
    /// # Panics
    /// When there is no such table.
    pub fn write_table(&mut self, table: usize, batch: Batch) -> Result<(), WriteError> {
        let topic = &mut self.topics[table];
        topic.accept(batch, topic.last_ns)?;
        while topic.head().is_some() {
            topic.write_row(&mut self.file, &mut self.message, &self.path)?;
        }
        topic.forget();
        Ok(())
    }

    fn write_before(&mut self, until_ns: i64) -> Result<(), WriteError> {
        // Equal times go in the order of the tables.
        while let Some(time_ns) = self.topics.iter().filter_map(Topic::head).min().filter(|t| *t < until_ns) {
            for topic in &mut self.topics {
                while topic.head() == Some(time_ns) {
                    topic.write_row(&mut self.file, &mut self.message, &self.path)?;
                }
            }
        }
        self.topics.iter_mut().for_each(Topic::forget);
        self.written_until_ns = self.written_until_ns.max(until_ns);
        Ok(())
    }
}

impl Topic {
    /// Time of the first row that is not yet written.
    fn head(&self) -> Option<i64> {
        self.pending.time_ns.get(self.done).copied()
    }

    /// Writes the first row that is not yet written.
    fn write_row(
        &mut self,
        file: &mut McapFile<BufWriter<NamedTempFile>>,
        message: &mut Vec<u8>,
        path: &Path,
    ) -> Result<(), WriteError> {
        let time_ns = self.pending.time_ns[self.done];
        message.clear();
        self.encoder.encode(&self.pending, self.done, message)?;
        let log_time = u64::try_from(time_ns);
        let log_time = log_time.map_err(|_| WriteError::NegativeTime { table: self.name.clone(), time_ns })?;
        let io = |source| WriteError::Io { path: path.to_owned(), source };
        file.message(self.channel, log_time, message).map_err(io)?;
        self.last_ns = time_ns;
        self.done += 1;
        Ok(())
    }

    /// Takes rows in order of time, none before `written_until_ns`.
    fn accept(&mut self, batch: Batch, written_until_ns: i64) -> Result<(), WriteError> {
        let (columns, rows) = (self.pending.columns.len(), batch.rows());
        if batch.columns.len() != columns || batch.columns.iter().any(|c| c.len() != rows) {
            return Err(WriteError::Shape { table: self.name.clone(), columns, rows });
        }
        let mut after_ns = self.pending.time_ns.last().copied().unwrap_or(written_until_ns);
        for &time_ns in &batch.time_ns {
            if time_ns < after_ns {
                return Err(WriteError::OutOfOrder { table: self.name.clone(), time_ns, after_ns });
            }
            after_ns = time_ns;
        }
        if self.pending.rows() == 0 {
            self.pending = batch;
            return Ok(());
        }
        self.pending.time_ns.extend_from_slice(&batch.time_ns);
        for (pending, column) in self.pending.columns.iter_mut().zip(&batch.columns) {
            pending.extend_from_slice(column);
        }
        Ok(())
    }

    /// Drops the rows that are written.
    fn forget(&mut self) {
        self.pending.time_ns.drain(..self.done);
        for column in &mut self.pending.columns {
            column.drain(..self.done);
        }
        self.done = 0;
    }
}

/// What the schema cannot say: unit, place and rate of a housekeeping scalar; units and original names of the columns
/// of a generated message.
fn channel_metadata(table: &TableSpec, message: &MessageType) -> BTreeMap<String, String> {
    let mut metadata = BTreeMap::new();
    if table.name.starts_with("hk/") {
        if let Some(column) = table.columns.first() {
            metadata.insert("unit".to_owned(), column.unit.clone());
            for key in ["place", "rate_hz"] {
                if let Some(value) = column.attributes.get(key) {
                    metadata.insert(key.to_owned(), value.clone());
                }
            }
        }
        if table.rate_hz > 0.0 {
            metadata.entry("rate_hz".to_owned()).or_insert_with(|| table.rate_hz.to_string());
        }
    }
    for (path, column) in message.paths.iter().zip(&table.columns) {
        for (key, value) in [("unit", &column.unit), ("frame", &column.frame)] {
            if !value.is_empty() {
                metadata.insert(format!("{key}:{path}"), value.clone());
            }
        }
        if *path != column.name {
            metadata.insert(format!("name:{path}"), column.name.clone());
        }
    }
    metadata
}

/// What the name of a file begins with until it is complete.
const WRITING: &str = ".writing-";

/// A file beside `path`, removed unless it is renamed, and locked, so that it is known whose writer is still alive.
/// Files of dead writers in the same folder are removed.
fn temporary(path: &Path) -> io::Result<NamedTempFile> {
    let folder = folder_of(path);
    clear_dead(folder);
    let mut builder = tempfile::Builder::new();
    builder.prefix(WRITING).suffix(".mcap");
    #[cfg(unix)]
    {
        use std::os::unix::fs::PermissionsExt as _;
        builder.permissions(std::fs::Permissions::from_mode(0o666)); // less the umask, as of any new file
    }
    loop {
        let file = builder.tempfile_in(folder)?;
        file.as_file().lock()?;
        // Before it was locked, another program may have taken it for a dead writer's.
        if file.path().exists() {
            return Ok(file);
        }
    }
}

/// Removes files that writers in a folder did not complete and will not.
fn clear_dead(folder: &Path) {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    for entry in entries.filter(|entry| entry.file_name().to_string_lossy().starts_with(WRITING)) {
        if std::fs::File::open(entry.path()).is_ok_and(|file| file.try_lock().is_ok()) {
            let _ = std::fs::remove_file(entry.path()); // of no use, and in nobody's way
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::replay::Replay;
    use crate::telemetry::interface_tables;

    const START: i64 = 2_051_222_400_000_000_000;

    /// A killed writer's file goes with the next file, a living writer's stays.
    #[test]
    fn what_a_killed_writer_leaves_is_removed_by_the_next() {
        let dir = tempfile::tempdir().expect("a temporary folder");
        let dead = dir.path().join(".writing-dead.mcap");
        std::fs::write(&dead, "half").expect("writable");
        let living = temporary(&dir.path().join("a.mcap")).expect("a file");
        assert!(!dead.exists());
        let other = temporary(&dir.path().join("b.mcap")).expect("a file");
        assert!(living.path().exists() && other.path().exists());
    }

    /// `ifo` and `dws` alone.
    fn tables() -> Vec<TableSpec> {
        interface_tables().into_iter().filter(|t| t.name == "ifo" || t.name == "dws").collect()
    }

    fn rows(table: &TableSpec, times: &[i64]) -> Batch {
        Batch {
            time_ns: times.iter().map(|t| START + t).collect(),
            columns: table.columns.iter().map(|_| vec![1.0; times.len()]).collect(),
        }
    }

    fn chunk(ifo: &[i64], dws: &[i64], until: i64) -> Chunk {
        let tables = tables();
        Chunk { batches: vec![rows(&tables[0], ifo), rows(&tables[1], dws)], complete_until_ns: START + until }
    }

    /// A table that comes late by a lag is still written in order with the others.
    #[test]
    fn topics_are_merged_in_time_across_chunks() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.mcap");
        let mut writer = TelemetryWriter::create(&path, &tables(), &FileHeader::default()).unwrap();
        writer.write(chunk(&[0, 1, 2, 3], &[0], 1)).unwrap();
        writer.write(chunk(&[], &[1, 2, 3], 3)).unwrap();
        writer.finish().unwrap();
        let file = std::fs::read(&path).unwrap();
        let order: Vec<(i64, String)> = mcap::MessageStream::new(&file)
            .unwrap()
            .map(|m| m.map(|m| (m.log_time as i64 - START, m.channel.topic.clone())).unwrap())
            .collect();
        let expected: Vec<_> = (0..4).flat_map(|t| [(t, "/ifo".to_owned()), (t, "/dws".to_owned())]).collect();
        assert_eq!(order, expected);
        let replay = Replay::open(&[path], None, 1).unwrap();
        assert_eq!(replay.tables(), tables());
    }

    #[test]
    fn what_cannot_be_written_leaves_no_file() {
        let cases: [(&[i64], bool, &str); 3] =
            [(&[5, 4], false, "order of time"), (&[-1], true, "order of time"), (&[-START - 1], false, "before 1970")];
        for (times, after_others, why) in cases {
            let folder = tempfile::tempdir().unwrap();
            let mut writer =
                TelemetryWriter::create(&folder.path().join("a.mcap"), &tables(), &FileHeader::default()).unwrap();
            if after_others {
                writer.write(chunk(&[0], &[0], 1)).unwrap();
            }
            let error = writer.write(chunk(times, &[], 9)).unwrap_err();
            assert!(error.to_string().contains(why), "{error}");
            drop(writer);
            assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
        }
        let missing = TelemetryWriter::create(Path::new("/nowhere/at/all.mcap"), &tables(), &FileHeader::default());
        assert!(matches!(missing.err(), Some(WriteError::Io { .. })));
        let mut short = chunk(&[0], &[0], 1);
        short.batches[0].columns.pop();
        let folder = tempfile::tempdir().unwrap();
        let mut writer =
            TelemetryWriter::create(&folder.path().join("a.mcap"), &tables(), &FileHeader::default()).unwrap();
        assert!(matches!(writer.write(short), Err(WriteError::Shape { .. })));
    }
}
