//! From pieces of files to stretches of time.

use std::collections::BTreeMap;
use std::ops::Range;
use std::path::PathBuf;
use std::sync::Arc;

use mcap::records::op;

use super::ReplayError;
use super::block::{Block, drain};
use super::clock::{Clock, Stepped};
use super::inflate::{InflateError, Inflater, Piece, Stored};
use super::losses::{Finding, Findings, Losses};
use super::records::{Cursor, Message};
use super::tables::{Route, Routes};
use crate::input::InputFile;
use crate::limits::ROWS_IN_FLIGHT_BYTES;
use crate::table::{Batch, Chunk, TableSpec};
use crate::telemetry::{Cells, Decoder, WireError};

/// Length of a stretch, ns: 4096 epochs at 10 Hz. The borders are its multiples since 1970, whatever the files are.
const STRETCH_NS: i64 = 409_600_000_000;
/// Rows later than this many stretches ahead are not kept but read again, so that a file in no order at all costs
/// time and not memory.
const HORIZON: i64 = 16 * STRETCH_NS;
/// Most rows of a table in a stretch by itself that count as stray. A single time of 1980 would make the product one of
/// that day.
pub(super) const STRAY_ROWS: usize = 3;
/// Distance from all other rows from which they do, ns.
pub(super) const STRAY_NS: i64 = 86_400_000_000_000;
/// 1980-01-01 and 2200-01-01: a clock outside has failed.
pub(super) const SANE_NS: Range<i64> = 315_532_800_000_000_000..7_258_118_400_000_000_000;

/// A log time as signed nanoseconds within the sane range, or the border of it that is nearest.
pub(super) fn clamp_ns(log_time: u64) -> i64 {
    i64::try_from(log_time).unwrap_or(i64::MAX).clamp(SANE_NS.start, SANE_NS.end)
}

/// Whether a log time lies within the sane range.
pub(super) fn is_sane(log_time: u64) -> bool {
    i64::try_from(log_time).is_ok_and(|t| SANE_NS.contains(&t))
}

/// After the last row that a piece states, Unix ns; `i64::MAX` where that is no time.
fn end_of(piece: &Piece) -> i64 {
    if is_sane(piece.start) && is_sane(piece.end) { clamp_ns(piece.end).saturating_add(1) } else { i64::MAX }
}

/// Counts a stretch in which the clock of a table was wrong.
fn tell_stepped(stepped: &Stepped, table: &TableSpec, losses: &mut Losses) {
    let Stepped { epochs, step_ns, from_ns, by } = *stepped;
    // At least one, as the steps themselves were met.
    losses.add(Finding::SteppedClocks, epochs.max(1), &format!("{}@{from_ns}", table.name), || {
        let (topic, s) = (&table.name, (by.abs() * step_ns) as f64 / 1e9);
        let at = chrono::DateTime::from_timestamp_nanos(from_ns).format("%H:%M:%S");
        let when = if by > 0 { "late" } else { "early" };
        format!(
            "/{topic}: its clock was {s} s {when} from {at} on for {epochs} epochs: as many messages are missing on one side \
             of them as have a second one with other values on the other; keep this time out, or send the topic again"
        )
    });
}

/// A piece that has yet to be read.
#[derive(Debug)]
struct Pending {
    piece: Piece,
    /// Rows before this time were delivered by an earlier reading, Unix ns; `i64::MIN` before the first.
    from_ns: i64,
}

/// Earliest time, file, offset: pieces are read in this order.
type Key = (i64, usize, u64);

/// A file ready to be read.
#[derive(Debug)]
pub(super) struct OpenFile {
    pub(super) input: Arc<InputFile>,
    pub(super) pieces: Vec<Piece>,
    pub(super) routes: Routes,
    /// Messages that it should hold, where it says so.
    pub(super) messages: Option<u64>,
}

/// A file under way.
#[derive(Debug)]
struct ReadFile {
    input: Arc<InputFile>,
    routes: Routes,
    /// Messages that should be in it and have not come yet; none where it does not say, or is not read whole.
    due: Option<u64>,
    /// After the last row that its pieces state, Unix ns.
    end_ns: i64,
}

/// Where a message of a piece lies.
#[derive(Debug)]
struct Entry {
    channel: u16,
    time_ns: i64,
    data: Range<usize>,
}

/// Reads the pieces of all files in order of time.
#[derive(Debug)]
pub(super) struct Reader {
    files: Vec<ReadFile>,
    tables: Vec<TableSpec>,
    queue: BTreeMap<Key, Pending>,
    /// Rows read and not yet delivered, by table.
    blocks: Vec<Vec<Block>>,
    /// The clock of each table but those of housekeeping.
    clocks: Vec<Option<Clock>>,
    window_ns: Range<i64>,
    /// After the last row that the pieces state: what comes later is another run's, and no promise can be made for it.
    end_ns: i64,
    /// Every row before this time has been delivered.
    done_ns: i64,
    /// Time of the last row delivered.
    last_ns: Option<i64>,
    inflater: Inflater,
    entries: Vec<Entry>,
    /// Rows before this time only settle the stages, Unix ns; `i64::MIN` where there are none.
    run_in_until_ns: i64,
    findings: Findings,
}

impl Reader {
    pub(super) fn new(
        files: Vec<OpenFile>,
        tables: Vec<TableSpec>,
        window_ns: Range<i64>,
        run_in_until_ns: i64,
        losses: Losses,
    ) -> Result<Self, ReplayError> {
        let inflater = Inflater::new().map_err(|source| ReplayError::Io { path: PathBuf::from("zstd"), source })?;
        let mut queue = BTreeMap::new();
        let mut opened = Vec::with_capacity(files.len());
        let mut end_ns = i64::MIN;
        for (at, file) in files.into_iter().enumerate() {
            let mut due = file.messages;
            // A chunk without messages states zero for both times.
            let with_messages = file.pieces.iter().filter(|piece| (piece.start, piece.end) != (0, 0));
            let file_end_ns = with_messages.map(end_of).max().unwrap_or(i64::MAX);
            for piece in file.pieces {
                let (start, end) = (clamp_ns(piece.start), clamp_ns(piece.end));
                // Pieces with times out of range are read for the count of them.
                let sane = is_sane(piece.start) && is_sane(piece.end);
                if !sane || end >= window_ns.start && start < window_ns.end {
                    if sane {
                        end_ns = end_ns.max(end + 1);
                    }
                    queue.insert((start, at, piece.offset), Pending { piece, from_ns: i64::MIN });
                } else {
                    due = None;
                }
            }
            opened.push(ReadFile { input: file.input, routes: file.routes, due, end_ns: file_end_ns });
        }
        let blocks = tables.iter().map(|_| vec![]).collect();
        let clocks = tables.iter().map(|t| (!t.name.starts_with("hk")).then(Clock::default)).collect();
        let (done_ns, last_ns, entries) = (i64::MIN, None, vec![]);
        Ok(Self {
            files: opened,
            tables,
            queue,
            blocks,
            clocks,
            window_ns,
            end_ns,
            done_ns,
            last_ns,
            inflater,
            entries,
            run_in_until_ns,
            findings: Findings { of_data: losses, of_run_in: Losses::default() },
        })
    }

    pub(super) fn findings(&self) -> &Findings {
        &self.findings
    }

    /// The next stretch that has a row; `None` at the end.
    pub(super) fn next(&mut self) -> Result<Option<Chunk>, ReplayError> {
        loop {
            let Some(first) = self.next_ns() else {
                self.count_missing();
                self.end_clocks();
                return Ok(None);
            };
            let until_ns = ((first.max(self.done_ns).div_euclid(STRETCH_NS)) + 1) * STRETCH_NS;
            while let Some(entry) = self.queue.first_entry().filter(|e| e.key().0 < until_ns) {
                let ((_, file, _), pending) = entry.remove_entry();
                self.read(file, pending, until_ns)?;
            }
            let losses = self.findings.before(until_ns, self.run_in_until_ns);
            let mut batches = Vec::with_capacity(self.tables.len());
            for ((blocks, table), clock) in self.blocks.iter_mut().zip(&self.tables).zip(&mut self.clocks) {
                let (batch, conflicts_ns) = drain(blocks, until_ns, table.columns.len(), &table.name, losses);
                if let Some(clock) = clock {
                    clock.see(&batch.time_ns, &conflicts_ns).iter().for_each(|s| tell_stepped(s, table, losses));
                }
                batches.push(batch);
            }
            self.done_ns = until_ns;
            if self.is_stray(&batches) {
                let rows = batches.iter().map(|b| b.rows() as u64).sum();
                self.findings.before(until_ns, self.run_in_until_ns).add(Finding::StrayMessages, rows, "", || {
                    "messages lie more than a day from all others: a clock had failed; they were dropped".to_owned()
                });
                continue;
            }
            if let Some(last) = batches.iter().filter_map(|b| b.time_ns.last()).max() {
                self.last_ns = Some(*last);
                self.end_ns = self.end_ns.max(last + 1);
                let complete_until_ns = until_ns.min(self.window_ns.end).min(self.end_ns);
                return Ok(Some(Chunk { batches, complete_until_ns }));
            }
        }
    }

    /// Time of the first row that is left, as far as pieces tell theirs rightly.
    fn next_ns(&self) -> Option<i64> {
        let queued = self.queue.first_key_value().map(|(key, _)| key.0);
        let held = self.blocks.iter().flatten().filter_map(Block::head).min();
        queued.into_iter().chain(held).min()
    }

    /// Whether a stretch holds a few rows far from all others, and there are others.
    fn is_stray(&self, batches: &[Batch]) -> bool {
        let times = || batches.iter().flat_map(|b| &b.time_ns).copied();
        let (Some(first), Some(last)) = (times().min(), times().max()) else { return false };
        let next = self.next_ns();
        let alone = self.last_ns.is_none() && next.is_none();
        !alone
            && batches.iter().all(|b| b.rows() <= STRAY_ROWS)
            && self.last_ns.is_none_or(|before| first - before > STRAY_NS)
            && next.is_none_or(|after| after - last > STRAY_NS)
    }

    /// Counts the messages that files should hold and do not; once, at the end.
    fn count_missing(&mut self) {
        for file in &mut self.files {
            let Some(missing) = file.due.take().filter(|missing| *missing > 0) else { continue };
            let name = super::name_of(file.input.path());
            let losses = self.findings.before(file.end_ns, self.run_in_until_ns);
            losses.add(Finding::MissingMessages, missing, &name, || {
                format!("{name}: {missing} messages that its statistics count are not in it; fetch the file again")
            });
        }
    }

    /// What the clocks still have to say; once, at the end.
    fn end_clocks(&mut self) {
        for (table, clock) in self.tables.iter().zip(&mut self.clocks) {
            if let Some(stepped) = clock.as_mut().and_then(Clock::end) {
                tell_stepped(&stepped, table, self.findings.before(self.end_ns, self.run_in_until_ns));
            }
        }
    }

    /// Bytes of the rows that wait to be delivered.
    fn held_bytes(&self) -> usize {
        self.blocks.iter().flatten().map(Block::bytes).sum()
    }

    /// Reads the rows of a piece that lie between what was delivered and the horizon.
    fn read(&mut self, file: usize, pending: Pending, until_ns: i64) -> Result<(), ReplayError> {
        let horizon_ns = until_ns.saturating_add(HORIZON);
        let mut held = self.held_bytes();
        let ReadFile { input, routes, due, .. } = &mut self.files[file];
        let name = super::name_of(input.path());
        let piece = &pending.piece;
        let losses = self.findings.before(end_of(piece), self.run_in_until_ns);
        let io = |source| ReplayError::Io { path: input.path().to_owned(), source };
        let records = match self.inflater.read(input, piece) {
            Ok(records) => records,
            Err(InflateError::Io(error)) => return Err(io(error)),
            Err(InflateError::Corrupt(why)) => {
                lost(losses, Finding::CorruptChunks, &name, piece, &format!("corrupt ({why})"), "fetch the file again");
                return Ok(());
            }
            Err(InflateError::Unreadable { why, remedy }) => {
                lost(losses, Finding::UnreadableChunks, &name, piece, &format!("unreadable ({why})"), remedy);
                return Ok(());
            }
        };
        let first_time = pending.from_ns == i64::MIN;
        if first_time && matches!(&piece.stored, Stored::Chunk { crc: 0, .. }) {
            losses.add(Finding::ChunksWithoutCrc, 1, &name, || {
                format!("{name} has chunks without a CRC; damage goes unseen")
            });
        }
        let wanted = Wanted {
            from_ns: pending.from_ns,
            done_ns: self.done_ns,
            horizon_ns,
            window_ns: self.window_ns.clone(),
            first_time,
        };
        let (later, messages) = index(records, &wanted, &mut self.entries, &name, losses);
        if let Some(due) = due.as_mut().filter(|_| first_time) {
            *due = due.saturating_sub(messages);
        }
        self.entries.sort_by_key(|e| e.channel); // stable: within a channel the order of the file stays
        for entries in self.entries.chunk_by(|a, b| a.channel == b.channel) {
            let (channel, count) = (entries[0].channel, entries.len());
            match routes.get_mut(&channel) {
                None => losses.add(Finding::MessagesOfUnknownChannels, count as u64, &format!("{name}#{channel}"), || {
                    format!("{name}: {count} messages are of channel {channel}, which the file does not define; they are lost")
                }),
                Some(Route::Nowhere { finding, topic }) => {
                    let why = match finding {
                        Finding::TruthMessages => "it is the truth of a simulation and no calibration may read it",
                        _ => "it is not in telemetry.proto; housekeeping belongs under /hk/",
                    };
                    losses.add(*finding, count as u64, topic, || format!("{name}: topic {topic} is not read: {why}"));
                }
                Some(Route::Table { table, decoder }) => {
                    let spec = &self.tables[*table];
                    held += Block::bytes_of(count, spec.columns.len());
                    if held > ROWS_IN_FLIGHT_BYTES {
                        return Err(ReplayError::TooMuchAtOnce { path: input.path().to_owned(), offset: piece.offset });
                    }
                    let rows = decode(entries, records, decoder, spec.columns.len());
                    let topic = &spec.name;
                    losses.add(Finding::NonFiniteValues, rows.non_finite, topic, || {
                        format!("{name}: topic /{topic} has values that are NaN or infinite; they are passed on")
                    });
                    if let Some(error) = rows.error {
                        losses.add(Finding::MalformedMessages, (count - rows.times.len()) as u64, topic, || {
                            format!("{name}: messages of topic /{topic} contradict their schema ({error}) and are lost")
                        });
                    }
                    if !rows.times.is_empty() {
                        let rank = (file, piece.offset, channel);
                        self.blocks[*table].push(Block::new(rank, rows.times, &rows.values, count));
                    }
                }
            }
        }
        if let Some(later) = later {
            let key = (later, file, piece.offset);
            self.queue.insert(key, Pending { piece: pending.piece, from_ns: horizon_ns });
        }
        Ok(())
    }
}

/// Counts a chunk whose messages are lost.
fn lost(losses: &mut Losses, finding: Finding, name: &str, piece: &Piece, what: &str, remedy: &str) {
    let Piece { offset, start, end, .. } = piece;
    losses.add(finding, 1, &format!("{name}@{offset}"), || {
        format!(
            "{name}: the chunk at byte {offset} is {what}; its messages from {start} to {end} ns are lost; {remedy}"
        )
    });
}

/// The messages of one channel, decoded.
struct Rows {
    times: Vec<i64>,
    /// The columns one after the other, each as long as there were messages.
    values: Vec<f64>,
    non_finite: u64,
    /// Why the last of the messages that are not here could not be decoded.
    error: Option<WireError>,
}

fn decode(entries: &[Entry], records: &[u8], decoder: &mut Decoder, columns: usize) -> Rows {
    let count = entries.len();
    let mut rows =
        Rows { times: Vec::with_capacity(count), values: vec![f64::NAN; columns * count], non_finite: 0, error: None };
    for entry in entries {
        let row = rows.times.len();
        let mut cells = Cells { values: &mut rows.values, rows: count, row };
        match decoder.decode(&records[entry.data.clone()], &mut cells) {
            Ok(non_finite) => {
                rows.non_finite += non_finite;
                rows.times.push(entry.time_ns);
            }
            Err(error) => {
                rows.error = Some(error);
                (0..columns).for_each(|c| rows.values[c * count + row] = f64::NAN);
            }
        }
    }
    rows
}

/// Which rows of a piece a reading takes.
struct Wanted {
    from_ns: i64,
    done_ns: i64,
    horizon_ns: i64,
    window_ns: Range<i64>,
    first_time: bool,
}

/// Lists the messages of a piece that are wanted; returns the earliest time of those that are for later, and how many
/// messages there are in all.
fn index(
    records: &[u8],
    wanted: &Wanted,
    entries: &mut Vec<Entry>,
    name: &str,
    losses: &mut Losses,
) -> (Option<i64>, u64) {
    entries.clear();
    let mut cursor = Cursor(records);
    let mut later: Option<i64> = None;
    let (mut messages, mut insane, mut backwards, mut late) = (0, 0, 0, 0);
    let mut before: BTreeMap<u16, u64> = BTreeMap::new();
    loop {
        let (code, body) = match cursor.record() {
            Ok(Some(record)) => record,
            Ok(None) => break,
            Err(_) => {
                losses.add(Finding::DamagedRecords, 1, name, || {
                    format!("{name}: a chunk ends in the middle of a record")
                });
                break;
            }
        };
        if code != op::MESSAGE {
            continue;
        }
        let end = records.len() - cursor.0.len();
        let Ok(message) = Message::parse(body) else {
            losses.add(Finding::DamagedRecords, 1, name, || format!("{name}: a message is shorter than its header"));
            continue;
        };
        messages += 1;
        let time_ns = i64::try_from(message.log_time).unwrap_or(i64::MAX);
        if wanted.first_time {
            let last = before.entry(message.channel).or_insert(0);
            backwards += u64::from(message.log_time < *last);
            *last = message.log_time;
            insane += u64::from(!SANE_NS.contains(&time_ns));
        }
        if !SANE_NS.contains(&time_ns) || !wanted.window_ns.contains(&time_ns) || time_ns < wanted.from_ns {
            continue;
        }
        if time_ns < wanted.done_ns {
            late += 1;
        } else if time_ns >= wanted.horizon_ns {
            later = Some(later.map_or(time_ns, |l| l.min(time_ns)));
        } else {
            entries.push(Entry { channel: message.channel, time_ns, data: end - message.data.len()..end });
        }
    }
    losses.add(Finding::TimesOutOfRange, insane, name, || {
        format!("{name}: messages are dated before 1980 or after 2200 and were dropped")
    });
    losses.add(Finding::BackwardTimes, backwards, name, || {
        format!("{name}: log times run backwards; they were put in order")
    });
    losses.add(Finding::LateMessages, late, name, || {
        format!("{name}: messages lie outside the times that their chunk states and came too late to be put in order; they are lost")
    });
    (later, messages)
}
