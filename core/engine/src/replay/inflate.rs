//! The records of a piece of a file, uncompressed and vouched for by their CRC.

use std::fmt;
use std::io::{self, Read};

use crate::input::InputFile;
use crate::limits::{INFLATION, INFLATION_FREE_BYTES, PIECE_BYTES};

/// How the records of a piece are stored.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Stored {
    /// As they are, in the data section.
    Loose,
    /// In a chunk.
    Chunk { compression: String, uncompressed_size: u64, crc: u32 },
}

/// A stretch of a file with messages: a chunk, or a run of loose messages.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Piece {
    /// Where its bytes begin in the file.
    pub(super) offset: u64,
    /// How many there are.
    pub(super) length: u64,
    /// Earliest log time, as told.
    pub(super) start: u64,
    /// Latest log time, as told.
    pub(super) end: u64,
    pub(super) stored: Stored,
}

/// Why the records of a piece are not there.
#[derive(Debug)]
pub(super) enum InflateError {
    /// The file cannot be read.
    Io(io::Error),
    /// What stands there is not what was written.
    Corrupt(String),
    /// What was written is nothing that can be read.
    Unreadable {
        /// Why.
        why: String,
        /// What helps.
        remedy: &'static str,
    },
}

/// Reads and decompresses, in buffers that stay.
pub(super) struct Inflater {
    zstd: zstd::bulk::Decompressor<'static>,
    stored: Vec<u8>,
    records: Vec<u8>,
}

impl Inflater {
    pub(super) fn new() -> io::Result<Self> {
        Ok(Self { zstd: zstd::bulk::Decompressor::new()?, stored: Vec::new(), records: Vec::new() })
    }

    /// The records of `piece`.
    pub(super) fn read(&mut self, file: &InputFile, piece: &Piece) -> Result<&[u8], InflateError> {
        let corrupt = |what: String| Err(InflateError::Corrupt(what));
        let too_large = |bytes: u64| {
            let why = format!("{bytes} bytes, where a chunk may have {PIECE_BYTES}");
            Err(InflateError::Unreadable { why, remedy: "write it again in chunks of a few MiB (`mcap compress`)" })
        };
        if piece.length > PIECE_BYTES {
            return too_large(piece.length);
        }
        file.read_range(piece.offset, piece.length, &mut self.stored).map_err(InflateError::Io)?;
        let got = self.stored.len() as u64;
        if got != piece.length {
            return corrupt(format!("the file ends {} bytes early", piece.length - got));
        }
        let Stored::Chunk { compression, uncompressed_size, crc } = &piece.stored else {
            return Ok(&self.stored);
        };
        if *uncompressed_size > PIECE_BYTES {
            return too_large(*uncompressed_size);
        }
        if *uncompressed_size > piece.length.saturating_mul(INFLATION).max(INFLATION_FREE_BYTES) {
            return corrupt(format!("{} bytes that are to become {uncompressed_size}", piece.length));
        }
        let size = usize::try_from(*uncompressed_size)
            .map_err(|_| InflateError::Corrupt(format!("{uncompressed_size} bytes do not fit the memory")))?;
        let records = match compression.as_str() {
            "" => &self.stored,
            "zstd" => {
                self.records.clear();
                self.records.reserve(size);
                // Writers may cut the stream into frames; the bulk decoder takes them all.
                self.zstd
                    .decompress_to_buffer(&self.stored, &mut self.records)
                    .map_err(|e| InflateError::Corrupt(format!("zstd: {e}")))?;
                &self.records
            }
            "lz4" => {
                self.records.clear();
                lz4::Decoder::new(self.stored.as_slice())
                    .and_then(|d| d.take(uncompressed_size + 1).read_to_end(&mut self.records))
                    .map_err(|e| InflateError::Corrupt(format!("lz4: {e}")))?;
                &self.records
            }
            other => {
                let why = format!("compression {other:?} is neither zstd nor lz4");
                return Err(InflateError::Unreadable { why, remedy: "write it again with zstd (`mcap compress`)" });
            }
        };
        if records.len() != size {
            return corrupt(format!("{} bytes where {size} were written", records.len()));
        }
        if *crc != 0 && crc32fast::hash(records) != *crc {
            return corrupt("its CRC is wrong".to_owned());
        }
        Ok(records)
    }
}

impl fmt::Debug for Inflater {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Inflater").field("stored", &self.stored.len()).field("records", &self.records.len()).finish()
    }
}
