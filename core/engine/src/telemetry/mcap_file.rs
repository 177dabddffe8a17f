//! The bytes of an MCAP file, written forward. Messages of one chunk are gathered and compressed at once, which costs
//! a third of compressing them one by one.

use std::collections::BTreeMap;
use std::io::{self, Write};

use mcap::MAGIC;
use mcap::records::op;

/// Uncompressed size at which a chunk is closed: small enough to seek, large enough to compress.
const CHUNK_BYTES: usize = 1 << 20;
/// Noise hardly compresses: level 1 takes more than twice the time of this one to save another tenth.
const ZSTD_LEVEL: i32 = -5;

/// A record under construction; its length is set when it is done.
struct Record(Vec<u8>);

impl Record {
    fn new(op: u8) -> Self {
        let mut bytes = vec![op];
        bytes.extend([0; 8]);
        Self(bytes)
    }

    fn u16(mut self, value: u16) -> Self {
        self.0.extend(value.to_le_bytes());
        self
    }

    fn u32(mut self, value: u32) -> Self {
        self.0.extend(value.to_le_bytes());
        self
    }

    fn u64(mut self, value: u64) -> Self {
        self.0.extend(value.to_le_bytes());
        self
    }

    fn byte(mut self, value: u8) -> Self {
        self.0.push(value);
        self
    }

    fn bytes(mut self, value: &[u8]) -> Self {
        self.0.extend((value.len() as u32).to_le_bytes());
        self.0.extend(value);
        self
    }

    fn text(self, value: &str) -> Self {
        self.bytes(value.as_bytes())
    }

    fn map(self, entries: &BTreeMap<String, String>) -> Self {
        let mut inner = Self(vec![]);
        for (key, value) in entries {
            inner = inner.text(key).text(value);
        }
        self.bytes(&inner.0)
    }

    fn done(mut self) -> Vec<u8> {
        let length = (self.0.len() - 9) as u64;
        self.0[1..9].copy_from_slice(&length.to_le_bytes());
        self.0
    }
}

/// Counts and sums what goes through.
struct Summed<W> {
    inner: W,
    position: u64,
    crc: crc32fast::Hasher,
}

impl<W: Write> Summed<W> {
    fn put(&mut self, bytes: &[u8]) -> io::Result<()> {
        self.inner.write_all(bytes)?;
        self.position += bytes.len() as u64;
        self.crc.update(bytes);
        Ok(())
    }
}

/// The messages of a chunk on their way.
#[derive(Default)]
struct Open {
    records: Vec<u8>,
    start: u64,
    end: u64,
    /// Log time and offset of each message, by channel.
    index: Vec<Vec<(u64, u64)>>,
}

/// An MCAP file being written: chunks of about 1 MiB, zstd, CRCs, indexes, statistics, summary offsets.
pub(super) struct McapFile<W> {
    out: Summed<W>,
    zstd: zstd::bulk::Compressor<'static>,
    compressed: Vec<u8>,
    open: Open,
    schemas: Vec<Vec<u8>>,
    channels: Vec<Vec<u8>>,
    chunk_indexes: Vec<Vec<u8>>,
    metadata_indexes: Vec<Vec<u8>>,
    counts: Vec<u64>,
    times: Option<(u64, u64)>,
}

impl<W: Write> McapFile<W> {
    /// Begins a file of the profile "".
    pub(super) fn new(inner: W, library: &str) -> io::Result<Self> {
        let mut out = Summed { inner, position: 0, crc: crc32fast::Hasher::new() };
        out.put(MAGIC)?;
        out.put(&Record::new(op::HEADER).text("").text(library).done())?;
        Ok(Self {
            out,
            zstd: zstd::bulk::Compressor::new(ZSTD_LEVEL)?,
            compressed: vec![],
            open: Open::default(),
            schemas: vec![],
            channels: vec![],
            chunk_indexes: vec![],
            metadata_indexes: vec![],
            counts: vec![],
            times: None,
        })
    }

    /// Writes a Metadata record.
    pub(super) fn metadata(&mut self, name: &str, entries: &BTreeMap<String, String>) -> io::Result<()> {
        let record = Record::new(op::METADATA).text(name).map(entries).done();
        let (offset, length) = (self.out.position, record.len() as u64);
        self.metadata_indexes.push(Record::new(op::METADATA_INDEX).u64(offset).u64(length).text(name).done());
        self.out.put(&record)
    }

    /// Defines a channel of protobuf messages and returns its id.
    pub(super) fn channel(
        &mut self,
        topic: &str,
        message: &str,
        descriptor_set: &[u8],
        metadata: &BTreeMap<String, String>,
    ) -> io::Result<u16> {
        let id = u16::try_from(self.channels.len() + 1).map_err(|_| io::Error::other("more than 65535 topics"))?;
        let schema = Record::new(op::SCHEMA).u16(id).text(message).text("protobuf").bytes(descriptor_set).done();
        let channel = Record::new(op::CHANNEL).u16(id).u16(id).text(topic).text("protobuf").map(metadata).done();
        self.out.put(&schema)?;
        self.out.put(&channel)?;
        self.schemas.push(schema);
        self.channels.push(channel);
        self.counts.push(0);
        self.open.index.push(vec![]);
        Ok(id)
    }

    /// Writes a message; the channel is one of [`McapFile::channel`].
    pub(super) fn message(&mut self, channel: u16, log_time: u64, data: &[u8]) -> io::Result<()> {
        let (at, open) = (usize::from(channel) - 1, &mut self.open);
        if open.records.is_empty() {
            (open.start, open.end) = (log_time, log_time);
        }
        (open.start, open.end) = (open.start.min(log_time), open.end.max(log_time));
        open.index[at].push((log_time, open.records.len() as u64));
        let mut header = [0; 31];
        header[0] = op::MESSAGE;
        header[1..9].copy_from_slice(&(22 + data.len() as u64).to_le_bytes());
        header[9..11].copy_from_slice(&channel.to_le_bytes());
        header[11..15].copy_from_slice(&(self.counts[at] as u32).to_le_bytes()); // sequence, which may wrap
        header[15..23].copy_from_slice(&log_time.to_le_bytes());
        header[23..31].copy_from_slice(&log_time.to_le_bytes());
        open.records.extend_from_slice(&header);
        open.records.extend_from_slice(data);
        self.counts[at] += 1;
        if self.open.records.len() >= CHUNK_BYTES { self.close_chunk() } else { Ok(()) }
    }

    fn close_chunk(&mut self) -> io::Result<()> {
        let Open { records, start, end, index } = &mut self.open;
        if records.is_empty() {
            return Ok(());
        }
        self.compressed.clear();
        self.compressed.reserve(zstd::zstd_safe::compress_bound(records.len()));
        self.zstd.compress_to_buffer(records.as_slice(), &mut self.compressed)?;
        let (size, compressed) = (records.len() as u64, self.compressed.len() as u64);
        let offset = self.out.position;
        let head = |op| Record::new(op).u64(*start).u64(*end);
        let mut chunk = head(op::CHUNK).u64(size).u32(crc32fast::hash(records)).text("zstd").u64(compressed).0;
        let length = chunk.len() as u64 - 9 + compressed;
        chunk[1..9].copy_from_slice(&length.to_le_bytes());
        self.out.put(&chunk)?;
        self.out.put(&self.compressed)?;
        let indexes_at = self.out.position;
        let mut offsets = vec![];
        for (id, entries) in (1_u16..).zip(index.iter_mut()).filter(|(_, entries)| !entries.is_empty()) {
            offsets.extend(id.to_le_bytes());
            offsets.extend(self.out.position.to_le_bytes());
            let pairs: Vec<u8> =
                entries.iter().flat_map(|(t, o)| [t.to_le_bytes(), o.to_le_bytes()]).flatten().collect();
            self.out.put(&Record::new(op::MESSAGE_INDEX).u16(id).bytes(&pairs).done())?;
            entries.clear();
        }
        self.chunk_indexes.push(
            head(op::CHUNK_INDEX)
                .u64(offset)
                .u64(indexes_at - offset)
                .bytes(&offsets)
                .u64(self.out.position - indexes_at)
                .text("zstd")
                .u64(compressed)
                .u64(size)
                .done(),
        );
        let (first, last) = self.times.unwrap_or((*start, *end));
        self.times = Some((first.min(*start), last.max(*end)));
        records.clear();
        Ok(())
    }

    /// Ends the file and gives back what it was written to.
    pub(super) fn finish(mut self) -> io::Result<W> {
        self.close_chunk()?;
        let data_crc = self.out.crc.clone().finalize();
        self.out.put(&Record::new(op::DATA_END).u32(data_crc).done())?;
        self.out.crc.reset(); // the summary has a sum of its own
        let summary_at = self.out.position;
        let statistics = self.statistics();
        let groups = [
            (op::SCHEMA, std::mem::take(&mut self.schemas)),
            (op::CHANNEL, std::mem::take(&mut self.channels)),
            (op::STATISTICS, vec![statistics]),
            (op::METADATA_INDEX, std::mem::take(&mut self.metadata_indexes)),
            (op::CHUNK_INDEX, std::mem::take(&mut self.chunk_indexes)),
        ];
        let mut offsets = vec![];
        for (op, records) in groups.iter().filter(|(_, records)| !records.is_empty()) {
            let start = self.out.position;
            records.iter().try_for_each(|r| self.out.put(r))?;
            offsets.push(Record::new(op::SUMMARY_OFFSET).byte(*op).u64(start).u64(self.out.position - start).done());
        }
        let offsets_at = self.out.position;
        offsets.iter().try_for_each(|r| self.out.put(r))?;
        // The sum covers the footer up to where it stands itself.
        let mut footer = Record::new(op::FOOTER).u64(summary_at).u64(offsets_at).u32(0).done();
        let crc_at = footer.len() - 4;
        self.out.crc.update(&footer[..crc_at]);
        let crc = self.out.crc.clone().finalize();
        footer[crc_at..].copy_from_slice(&crc.to_le_bytes());
        self.out.put(&footer)?;
        self.out.put(MAGIC)?;
        Ok(self.out.inner)
    }

    fn statistics(&self) -> Vec<u8> {
        let (start, end) = self.times.unwrap_or((0, 0));
        let counts: Vec<u8> = (1_u16..)
            .zip(&self.counts)
            .flat_map(|(id, count)| id.to_le_bytes().into_iter().chain(count.to_le_bytes()))
            .collect();
        Record::new(op::STATISTICS)
            .u64(self.counts.iter().sum())
            .u16(self.channels.len() as u16)
            .u32(self.channels.len() as u32)
            .u32(0) // attachments
            .u32(self.metadata_indexes.len() as u32)
            .u32(self.chunk_indexes.len() as u32)
            .u64(start)
            .u64(end)
            .bytes(&counts)
            .done()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The `mcap` crate reads the file by its records, by its summary and by its index, and checks every sum.
    #[test]
    fn another_implementation_reads_it() {
        let mut file = McapFile::new(vec![], "test 1").unwrap();
        let entries = BTreeMap::from([("time_scale".to_owned(), "TAI".to_owned())]);
        file.metadata("dragfree", &entries).unwrap();
        let channels =
            [file.channel("/a", "p.A", b"set", &entries), file.channel("/b", "p.B", b"set", &BTreeMap::new())];
        let channels = channels.map(Result::unwrap);
        let data = |k: u64| k.to_le_bytes().repeat(20);
        for k in 0..20_000 {
            file.message(channels[usize::from(k % 3 == 0)], 1_000 + k, &data(k)).unwrap();
        }
        let bytes = file.finish().unwrap();

        let options = mcap::sans_io::LinearReaderOptions::default()
            .with_validate_chunk_crcs(true)
            .with_validate_data_section_crc(true)
            .with_validate_summary_section_crc(true);
        let mut reader = mcap::sans_io::LinearReader::new_with_options(options);
        let mut rest = bytes.as_slice();
        while let Some(event) = reader.next_event() {
            match event.unwrap() {
                mcap::sans_io::LinearReadEvent::ReadRequest(wanted) => {
                    let count = wanted.min(rest.len());
                    reader.insert(count).copy_from_slice(&rest[..count]);
                    reader.notify_read(count);
                    rest = &rest[count..];
                }
                mcap::sans_io::LinearReadEvent::Record { opcode, data } => {
                    drop(mcap::parse_record(opcode, data).unwrap());
                }
            }
        }

        let summary = mcap::Summary::read(&bytes).unwrap().unwrap();
        let statistics = summary.stats.clone().unwrap();
        assert_eq!(statistics.message_count, 20_000);
        assert_eq!((statistics.message_start_time, statistics.message_end_time), (1_000, 20_999));
        assert_eq!(statistics.channel_message_counts, BTreeMap::from([(1, 13_333), (2, 6_667)]));
        assert_eq!((statistics.channel_count, statistics.schema_count, statistics.metadata_count), (2, 2, 1));
        assert_eq!(statistics.chunk_count as usize, summary.chunk_indexes.len());
        assert!(summary.chunk_indexes.len() > 2);
        assert_eq!(mcap::read::metadata(&bytes, &summary.metadata_indexes[0]).unwrap().metadata, entries);

        let mut k = 0;
        for chunk in &summary.chunk_indexes {
            let index = summary.read_message_indexes(&bytes, chunk).unwrap();
            assert_eq!(
                index.values().map(Vec::len).sum::<usize>(),
                summary.stream_chunk(&bytes, chunk).unwrap().count()
            );
            let (channel, entries) = index.iter().next().unwrap();
            let message = summary.seek_message(&bytes, chunk, &entries[0]).unwrap();
            assert_eq!((message.channel.id, message.log_time), (channel.id, entries[0].log_time));
            for message in summary.stream_chunk(&bytes, chunk).unwrap() {
                let message = message.unwrap();
                assert_eq!((message.log_time, message.publish_time), (1_000 + k, 1_000 + k));
                assert_eq!(message.channel.topic, if k % 3 == 0 { "/b" } else { "/a" });
                assert_eq!(message.data.as_ref(), data(k));
                k += 1;
            }
        }
        assert_eq!(k, 20_000);
    }

    #[test]
    fn a_file_without_messages_is_a_file() {
        let bytes = McapFile::new(vec![], "").unwrap().finish().unwrap();
        assert_eq!(mcap::Summary::read(&bytes).unwrap().unwrap().stats.unwrap().message_count, 0);
    }
}
