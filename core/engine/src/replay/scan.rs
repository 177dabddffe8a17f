//! One file from outside: where its pieces lie, which channels it defines, whose it is.
//!
//! The walk goes from record to record over the whole data section and reads little more than their headers, so a file
//! that was cut, has no summary or mixes chunked with loose messages needs no path of its own. The summary serves
//! twice: it lists the channels, which otherwise only a pass through every chunk finds, and its chunk index is what the
//! walk falls back on when a record's length is damaged.

use std::collections::{BTreeMap, BTreeSet};
use std::io::{self, BufReader, Read, Seek, SeekFrom};

use mcap::MAGIC;
use mcap::records::op;

use super::inflate::{InflateError, Inflater, Piece, Stored};
use super::losses::{Finding, Losses};
use super::records::{
    Channel, ChunkHeader, ChunkIndex, Cursor, FOOTER, MESSAGE_HEADER, Message, RECORD_HEADER, Schema, Statistics,
    footer, metadata,
};
use crate::input::{InputFile, InputReader};
use crate::limits::{DEFINITION_BYTES, PIECE_BYTES};

/// Size at which a run of loose messages is closed.
const LOOSE_BYTES: u64 = 1 << 20;
/// Buffer of the walk: a chunk's header and the message indexes before the next one.
const WALK_BUFFER: usize = 1 << 13;

/// What a file defines.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(super) struct Definitions {
    pub(super) schemas: BTreeMap<u16, Schema>,
    pub(super) channels: BTreeMap<u16, Channel>,
}

impl Definitions {
    /// Takes a Schema or Channel record; false when it is malformed or contradicts an earlier one.
    fn take(&mut self, code: u8, body: &[u8]) -> bool {
        match code {
            op::SCHEMA => {
                Schema::parse(body).is_ok_and(|s| *self.schemas.entry(s.id).or_insert_with(|| s.clone()) == s)
            }
            op::CHANNEL => {
                Channel::parse(body).is_ok_and(|c| *self.channels.entry(c.id).or_insert_with(|| c.clone()) == c)
            }
            _ => true,
        }
    }
}

/// A file as it was found.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(super) struct Scan {
    pub(super) bytes: u64,
    pub(super) pieces: Vec<Piece>,
    pub(super) definitions: Definitions,
    /// Channels that have messages.
    pub(super) used: BTreeSet<u16>,
    /// Entries of the Metadata record `dragfree`.
    pub(super) metadata: Option<BTreeMap<String, String>>,
    /// Messages that the file should hold, where it says so.
    pub(super) messages: Option<u64>,
    /// Where the data section ends, and its CRC, where the file has one.
    pub(super) checked_until: Option<(u64, u32)>,
    /// Which CRCs cover its messages beside that of the data section.
    pub(super) cover: Cover,
}

/// Which CRCs cover the messages of a file beside that of its data section.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) enum Cover {
    /// Each lies in a chunk with a CRC, and every chunk of the index was found.
    All,
    /// Some lie in chunks without a CRC. The data section's cannot be relied on then: the crate `mcap` 0.26 leaves such
    /// chunks out of it.
    #[default]
    Uncertain,
    /// Some lie outside of chunks, or chunks may be missing.
    DataSectionAlone,
}

/// Why a file cannot be scanned at all.
#[derive(Debug)]
pub(super) enum ScanError {
    Io(io::Error),
    NotMcap,
}

impl From<io::Error> for ScanError {
    fn from(error: io::Error) -> Self {
        Self::Io(error)
    }
}

/// Scans one file; what is wrong with it goes to `losses`.
pub(super) fn scan(file: &InputFile, losses: &mut Losses) -> Result<Scan, ScanError> {
    let name = super::name_of(file.path());
    let bytes = file.size();
    let mut scan = Scan { bytes, ..Scan::default() };
    if bytes == 0 {
        losses.add(Finding::EmptyFiles, 1, &name, || format!("{name} is empty; nothing was read from it"));
        return Ok(scan);
    }
    let mut magic = Vec::new();
    file.read_range(0, MAGIC.len() as u64, &mut magic)?;
    if !MAGIC.starts_with(&magic) {
        return Err(ScanError::NotMcap);
    }
    let summary = summary(file, bytes)?;
    Walk { name: &name, bytes, index: &summary.chunks, scan: &mut scan, losses }.run(file.reader(0))?;
    let complete = summary.complete;
    scan.messages = summary.messages;
    scan.cover = if scan.pieces.iter().any(|p| matches!(p.stored, Stored::Chunk { crc: 0, .. })) {
        Cover::Uncertain
    } else if complete && scan.pieces.iter().all(|p| p.stored != Stored::Loose) {
        Cover::All
    } else {
        Cover::DataSectionAlone
    };
    if scan.checked_until.is_none() && scan.pieces.iter().any(|p| p.stored == Stored::Loose) {
        losses.add(Finding::UncheckedFiles, 1, &name, || {
            format!("{name} has messages outside of chunks and no CRC of its data section; damage to them goes unseen")
        });
    }
    scan.used.extend(summary.used);
    let doubtful = doubtful(&scan.pieces, &summary.chunks, complete);
    for (id, schema) in summary.definitions.schemas {
        scan.definitions.schemas.entry(id).or_insert(schema);
    }
    for (id, channel) in summary.definitions.channels {
        scan.definitions.channels.entry(id).or_insert(channel);
    }
    if !complete && !scan.pieces.is_empty() {
        losses.add(Finding::FilesWithoutSummary, 1, &name, || {
            format!("{name} has no complete summary; it was read twice. `mcap recover` writes one")
        });
    }
    inspect(file, &mut scan, &doubtful, &name, losses)?;
    if scan.pieces.is_empty() {
        losses.add(Finding::FilesWithoutMessages, 1, &name, || format!("{name} holds no messages"));
    }
    Ok(scan)
}

/// Chunks whose header is not to be believed, for it stands outside every CRC: it disagrees with the index, or with
/// itself, or there is no index; and those that may define channels that no summary lists.
fn doubtful(pieces: &[Piece], index: &[ChunkIndex], complete: bool) -> Vec<usize> {
    let mut ordered = index.to_vec();
    ordered.sort_by_key(|i| i.offset);
    let agrees = |p: &Piece| {
        let before = ordered.partition_point(|i| i.offset < p.offset);
        before.checked_sub(1).is_some_and(|i| {
            let index = ordered[i];
            p.offset < index.offset.saturating_add(index.length) && (index.start, index.end) == (p.start, p.end)
        })
    };
    (0..pieces.len())
        .filter(|&i| {
            let piece = &pieces[i];
            piece.stored != Stored::Loose && (!complete || piece.start > piece.end || !agrees(piece))
        })
        .collect()
}

/// Reads the chunks at `which` for their definitions and their true range of times. A corrupt one is left for the
/// reader to report.
fn inspect(
    file: &InputFile,
    scan: &mut Scan,
    which: &[usize],
    name: &str,
    losses: &mut Losses,
) -> Result<(), ScanError> {
    if which.is_empty() {
        return Ok(());
    }
    let mut inflater = Inflater::new()?;
    for &at in which {
        let records = match inflater.read(file, &scan.pieces[at]) {
            Ok(records) => records,
            Err(InflateError::Io(error)) => return Err(error.into()),
            Err(InflateError::Corrupt(_) | InflateError::Unreadable { .. }) => continue,
        };
        let mut cursor = Cursor(records);
        let (mut start, mut end) = (u64::MAX, 0);
        while let Ok(Some((code, body))) = cursor.record() {
            if code == op::MESSAGE {
                if let Ok(message) = Message::parse(body) {
                    scan.used.insert(message.channel);
                    start = start.min(message.log_time);
                    end = end.max(message.log_time);
                }
            } else if !scan.definitions.take(code, body) {
                losses.add(Finding::DamagedRecords, 1, name, || {
                    format!("{name}: a schema or channel contradicts another")
                });
            }
        }
        (scan.pieces[at].start, scan.pieces[at].end) = (start.min(end), end);
    }
    Ok(())
}

/// What the end of a file says about the rest.
#[derive(Default)]
struct Summary {
    definitions: Definitions,
    chunks: Vec<ChunkIndex>,
    /// Channels that have messages.
    used: BTreeSet<u16>,
    /// It lists as many schemas, channels and chunks as it counts.
    complete: bool,
    /// Messages that the file should hold.
    messages: Option<u64>,
}

/// Reads the summary; an unreadable one is as good as none.
fn summary(file: &InputFile, bytes: u64) -> io::Result<Summary> {
    const TAIL: usize = RECORD_HEADER + FOOTER + MAGIC.len();
    let none = Ok(Summary::default());
    let Some(footer_at) = bytes.checked_sub(TAIL as u64) else { return none };
    let mut tail = Vec::with_capacity(TAIL);
    file.read_range(footer_at, TAIL as u64, &mut tail)?;
    let mut cursor = Cursor(&tail);
    let Ok(Some((op::FOOTER, body))) = cursor.record() else { return none };
    let Ok((start, _, crc)) = footer(body) else { return none };
    if cursor.0 != MAGIC || start < MAGIC.len() as u64 || start > footer_at || footer_at - start > PIECE_BYTES {
        return none;
    }
    let mut section = Vec::new();
    file.read_range(start, footer_at - start, &mut section)?;
    let mut hasher = crc32fast::Hasher::new();
    hasher.update(&section);
    hasher.update(&tail[..RECORD_HEADER + FOOTER - 4]); // the CRC covers the footer up to itself
    if crc != 0 && hasher.finalize() != crc {
        return none;
    }
    Ok(parse_summary(&section).unwrap_or_default())
}

fn parse_summary(section: &[u8]) -> Option<Summary> {
    let mut summary = Summary::default();
    let mut statistics = None;
    let mut cursor = Cursor(section);
    while let Some((code, body)) = cursor.record().ok()? {
        match code {
            op::SCHEMA | op::CHANNEL if !summary.definitions.take(code, body) => return None,
            op::CHUNK_INDEX => summary.chunks.push(ChunkIndex::parse(body).ok()?),
            op::STATISTICS => statistics = Some(Statistics::parse(body).ok()?),
            _ => {}
        }
    }
    if let Some(statistics) = statistics {
        summary.messages = Some(statistics.messages);
        summary.complete = usize::from(statistics.schemas) == summary.definitions.schemas.len()
            && statistics.channels as usize == summary.definitions.channels.len()
            && statistics.chunks as usize == summary.chunks.len();
        summary.used = statistics.used.unwrap_or_else(|| summary.definitions.channels.keys().copied().collect());
    }
    Some(summary)
}

/// The walk over the data section.
struct Walk<'a> {
    name: &'a str,
    bytes: u64,
    /// Chunk index of the summary.
    index: &'a [ChunkIndex],
    scan: &'a mut Scan,
    losses: &'a mut Losses,
}

impl Walk<'_> {
    fn run(&mut self, file: InputReader<'_>) -> io::Result<()> {
        let mut known: Vec<u64> = self.index.iter().map(|i| i.offset).collect();
        known.sort_unstable();
        let mut reader = BufReader::with_capacity(WALK_BUFFER, file);
        let mut at = MAGIC.len() as u64;
        let mut here = reader.seek(SeekFrom::Start(at))?;
        let mut body = Vec::new();
        loop {
            // Forth or, after a damaged record, back; the buffer stays where it can.
            match i64::try_from(i128::from(at) - i128::from(here)) {
                Ok(distance) => reader.seek_relative(distance)?,
                Err(_) => drop(reader.seek(SeekFrom::Start(at))?),
            }
            let mut header = [0; RECORD_HEADER];
            if self.bytes.saturating_sub(at) < RECORD_HEADER as u64 || !fill(&mut reader, &mut header)? {
                self.cut(at);
                return Ok(());
            }
            here = at + RECORD_HEADER as u64;
            let code = header[0];
            let mut length = [0; 8];
            length.copy_from_slice(&header[1..]);
            let length = u64::from_le_bytes(length);
            let body_at = at + RECORD_HEADER as u64;
            let end = body_at.checked_add(length).filter(|&end| end <= self.bytes && code != 0);
            // Where the summary knows a chunk there is one, not inside another record and not after the end.
            let next_known = known.get(known.partition_point(|&k| k <= at)).copied().filter(|&next| next < self.bytes);
            let lost_chunk = code != op::CHUNK && known.binary_search(&at).is_ok();
            let last = matches!(code, op::DATA_END | op::FOOTER);
            let end = match (end, next_known) {
                (Some(end), None) if !lost_chunk => end,
                (Some(end), Some(next)) if !lost_chunk && !last && end <= next => end,
                (_, Some(next)) => {
                    self.damaged(at, next, "reading goes on at the next chunk of the index");
                    at = next;
                    continue;
                }
                (_, None) if code == 0 || lost_chunk => {
                    self.damaged(at, self.bytes, "its kind is wrong");
                    return Ok(());
                }
                (_, None) => {
                    self.cut(at);
                    return Ok(());
                }
            };
            if last {
                if code == op::DATA_END {
                    self.checked(at, length, &mut reader)?;
                }
                return Ok(());
            }
            let wanted = match code {
                op::CHUNK => length.min(ChunkHeader::MAX as u64),
                op::MESSAGE => length.min(MESSAGE_HEADER as u64),
                op::SCHEMA | op::CHANNEL | op::METADATA => length.min(DEFINITION_BYTES),
                _ => 0,
            };
            body.clear();
            here += (&mut reader).take(wanted).read_to_end(&mut body)? as u64;
            let sound = match code {
                op::CHUNK => self.chunk(body_at, length, &body),
                op::MESSAGE => self.loose(at, end, &body),
                op::METADATA => self.metadata(&body),
                _ => self.scan.definitions.take(code, &body),
            };
            if !sound {
                self.damaged(at, end, "its content contradicts itself");
            }
            at = end;
        }
    }

    /// Takes the CRC of the data section, which ends at `at`; 0 stands for none.
    fn checked(&mut self, at: u64, length: u64, reader: &mut impl Read) -> io::Result<()> {
        let mut crc = [0; 4];
        if length >= crc.len() as u64 && fill(reader, &mut crc)? {
            self.scan.checked_until = Some((at, u32::from_le_bytes(crc))).filter(|(_, crc)| *crc != 0);
        }
        Ok(())
    }

    fn chunk(&mut self, body_at: u64, length: u64, body: &[u8]) -> bool {
        let Ok(header) = ChunkHeader::parse(body) else { return false };
        let offset = header.length as u64;
        if header.compressed_size != length - offset {
            return false;
        }
        // Either size may be damaged: the header stands outside every CRC.
        if header.uncompressed_size > 0 || header.compressed_size > 0 {
            self.scan.pieces.push(Piece {
                offset: body_at + offset,
                length: header.compressed_size,
                start: header.start,
                end: header.end,
                stored: Stored::Chunk {
                    compression: header.compression,
                    uncompressed_size: header.uncompressed_size,
                    crc: header.crc,
                },
            });
        }
        true
    }

    fn loose(&mut self, at: u64, end: u64, body: &[u8]) -> bool {
        let Ok(message) = Message::parse(body) else { return false };
        let time = message.log_time;
        self.scan.used.insert(message.channel);
        match self.scan.pieces.last_mut() {
            Some(run) if run.stored == Stored::Loose && run.offset + run.length == at && run.length < LOOSE_BYTES => {
                run.length = end - run.offset;
                run.start = run.start.min(time);
                run.end = run.end.max(time);
            }
            _ => self.scan.pieces.push(Piece {
                offset: at,
                length: end - at,
                start: time,
                end: time,
                stored: Stored::Loose,
            }),
        }
        true
    }

    fn metadata(&mut self, body: &[u8]) -> bool {
        let Ok((name, entries)) = metadata(body) else { return false };
        if name == "dragfree" {
            self.scan.metadata.get_or_insert(entries);
        }
        true
    }

    fn cut(&mut self, at: u64) {
        let (name, lost) = (self.name, self.bytes.saturating_sub(at));
        self.losses.add(Finding::TruncatedFiles, 1, name, || {
            format!("{name} ends in the middle: its last {lost} bytes are no whole record and what followed is lost; fetch it again")
        });
    }

    fn damaged(&mut self, at: u64, to: u64, why: &str) {
        let name = self.name;
        self.losses.add(Finding::DamagedRecords, 1, name, || {
            format!(
                "{name}: the record at byte {at} is damaged ({why}); bytes {at} to {to} are lost; fetch the file again"
            )
        });
    }
}

/// Reads as much as there is room for; false at the end of the file.
fn fill(reader: &mut impl Read, buffer: &mut [u8]) -> io::Result<bool> {
    match reader.read_exact(buffer) {
        Ok(()) => Ok(true),
        Err(e) if e.kind() == io::ErrorKind::UnexpectedEof => Ok(false),
        Err(e) => Err(e),
    }
}
