//! Records of an MCAP file, parsed without trust: every length is checked against the bytes that are there.

use std::collections::{BTreeMap, BTreeSet};

/// Operation code and length of a record.
pub(super) const RECORD_HEADER: usize = 9;
/// Channel, sequence, log time and publish time of a message.
pub(super) const MESSAGE_HEADER: usize = 22;
/// Length of the body of a footer.
pub(super) const FOOTER: usize = 20;

/// A record that is shorter than what it says, or holds text that is none.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Malformed;

type Parsed<T> = Result<T, Malformed>;

/// What is left of a record.
pub(super) struct Cursor<'a>(pub(super) &'a [u8]);

impl<'a> Cursor<'a> {
    pub(super) fn bytes(&mut self, count: usize) -> Parsed<&'a [u8]> {
        let (head, rest) = self.0.split_at_checked(count).ok_or(Malformed)?;
        self.0 = rest;
        Ok(head)
    }

    fn array<const N: usize>(&mut self) -> Parsed<[u8; N]> {
        let (head, rest) = self.0.split_first_chunk::<N>().ok_or(Malformed)?;
        self.0 = rest;
        Ok(*head)
    }

    pub(super) fn u8(&mut self) -> Parsed<u8> {
        self.array::<1>().map(|[byte]| byte)
    }

    pub(super) fn u16(&mut self) -> Parsed<u16> {
        self.array().map(u16::from_le_bytes)
    }

    pub(super) fn u32(&mut self) -> Parsed<u32> {
        self.array().map(u32::from_le_bytes)
    }

    pub(super) fn u64(&mut self) -> Parsed<u64> {
        self.array().map(u64::from_le_bytes)
    }

    fn prefixed(&mut self) -> Parsed<&'a [u8]> {
        let length = usize::try_from(self.u32()?).map_err(|_| Malformed)?;
        self.bytes(length)
    }

    fn string(&mut self) -> Parsed<String> {
        std::str::from_utf8(self.prefixed()?).map(str::to_owned).map_err(|_| Malformed)
    }

    fn map(&mut self) -> Parsed<BTreeMap<String, String>> {
        let mut entries = Cursor(self.prefixed()?);
        let mut map = BTreeMap::new();
        while !entries.0.is_empty() {
            map.insert(entries.string()?, entries.string()?);
        }
        Ok(map)
    }

    /// The next record: operation code and body. `None` at the end.
    pub(super) fn record(&mut self) -> Parsed<Option<(u8, &'a [u8])>> {
        if self.0.is_empty() {
            return Ok(None);
        }
        let op = self.u8()?;
        let length = usize::try_from(self.u64()?).map_err(|_| Malformed)?;
        self.bytes(length).map(|body| Some((op, body)))
    }
}

#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Schema {
    pub(super) id: u16,
    pub(super) name: String,
    pub(super) encoding: String,
    pub(super) data: Vec<u8>,
}

impl Schema {
    pub(super) fn parse(body: &[u8]) -> Parsed<Self> {
        let mut c = Cursor(body);
        Ok(Self { id: c.u16()?, name: c.string()?, encoding: c.string()?, data: c.prefixed()?.to_vec() })
    }
}

#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Channel {
    pub(super) id: u16,
    pub(super) schema_id: u16,
    pub(super) topic: String,
    pub(super) encoding: String,
    pub(super) metadata: BTreeMap<String, String>,
}

impl Channel {
    pub(super) fn parse(body: &[u8]) -> Parsed<Self> {
        let mut c = Cursor(body);
        Ok(Self { id: c.u16()?, schema_id: c.u16()?, topic: c.string()?, encoding: c.string()?, metadata: c.map()? })
    }
}

/// A message: channel, log time, payload.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Message<'a> {
    pub(super) channel: u16,
    pub(super) log_time: u64,
    pub(super) data: &'a [u8],
}

impl<'a> Message<'a> {
    pub(super) fn parse(body: &'a [u8]) -> Parsed<Self> {
        let mut c = Cursor(body);
        let channel = c.u16()?;
        c.u32()?; // sequence
        let log_time = c.u64()?;
        c.u64()?; // publish time
        Ok(Self { channel, log_time, data: c.0 })
    }
}

/// A chunk without its records.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct ChunkHeader {
    pub(super) start: u64,
    pub(super) end: u64,
    pub(super) uncompressed_size: u64,
    pub(super) crc: u32,
    pub(super) compression: String,
    pub(super) compressed_size: u64,
    /// Length of what was parsed, which is where the records begin.
    pub(super) length: usize,
}

impl ChunkHeader {
    /// Most bytes a header can sensibly have: the fixed part and the name of the compression.
    pub(super) const MAX: usize = 40 + 64;

    pub(super) fn parse(body: &[u8]) -> Parsed<Self> {
        let mut c = Cursor(body);
        let mut header = Self {
            start: c.u64()?,
            end: c.u64()?,
            uncompressed_size: c.u64()?,
            crc: c.u32()?,
            compression: c.string()?,
            compressed_size: c.u64()?,
            length: 0,
        };
        header.length = body.len() - c.0.len();
        Ok(header)
    }
}

/// Where the summary says a chunk lies, and when.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct ChunkIndex {
    pub(super) start: u64,
    pub(super) end: u64,
    pub(super) offset: u64,
    pub(super) length: u64,
}

impl ChunkIndex {
    pub(super) fn parse(body: &[u8]) -> Parsed<Self> {
        let mut c = Cursor(body);
        Ok(Self { start: c.u64()?, end: c.u64()?, offset: c.u64()?, length: c.u64()? })
    }
}

/// What the statistics count, as far as it tells whether a summary, or a file, is complete.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Statistics {
    pub(super) schemas: u16,
    pub(super) channels: u32,
    pub(super) chunks: u32,
    pub(super) messages: u64,
    /// Channels with at least one message; `None` where the writer did not count by channel.
    pub(super) used: Option<BTreeSet<u16>>,
}

impl Statistics {
    pub(super) fn parse(body: &[u8]) -> Parsed<Self> {
        let mut c = Cursor(body);
        let messages = c.u64()?;
        let (schemas, channels) = (c.u16()?, c.u32()?);
        c.u32()?; // attachments
        c.u32()?; // metadata
        let chunks = c.u32()?;
        c.u64()?; // first time
        c.u64()?; // last time
        let mut counts = Cursor(c.prefixed()?);
        let mut used = BTreeSet::new();
        while !counts.0.is_empty() {
            let (channel, count) = (counts.u16()?, counts.u64()?);
            if count > 0 {
                used.insert(channel);
            }
        }
        let used = Some(used).filter(|used| messages == 0 || !used.is_empty());
        Ok(Self { schemas, channels, chunks, messages, used })
    }
}

/// A Metadata record: its name and its entries.
pub(super) fn metadata(body: &[u8]) -> Parsed<(String, BTreeMap<String, String>)> {
    let mut c = Cursor(body);
    Ok((c.string()?, c.map()?))
}

/// A footer: where the summary begins, where its offsets begin, its CRC.
pub(super) fn footer(body: &[u8]) -> Parsed<(u64, u64, u32)> {
    let mut c = Cursor(body);
    Ok((c.u64()?, c.u64()?, c.u32()?))
}
