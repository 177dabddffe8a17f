//! MCAP written from its specification.

use std::fs::File;
use std::io::{self, Write};
use std::path::Path;

use super::Record;
use super::wire;

/// Layout of the file.
#[derive(Clone, Copy, Debug)]
pub struct Container {
    /// Whether messages are in chunks.
    pub chunks: bool,
    /// Whether chunks are compressed with zstd.
    pub zstd: bool,
    /// Whether the file has summary, statistics and indexes.
    pub summary: bool,
    /// Whether the topic `/command` exists.
    pub command: bool,
    /// Whether the topic `/ephemeris` exists.
    pub ephemeris: bool,
}

const MAGIC: &[u8; 8] = b"\x89MCAP0\r\n";
const MESSAGES_PER_CHUNK: usize = 4_000;
/// Bytes that are kept before they are written.
const BUFFER: usize = 1 << 22;

fn text(out: &mut Vec<u8>, text: &str) {
    out.extend_from_slice(&(text.len() as u32).to_le_bytes());
    out.extend_from_slice(text.as_bytes());
}

fn map(out: &mut Vec<u8>, entries: &[(&str, &str)]) {
    let mut inner = Vec::new();
    for (key, value) in entries {
        text(&mut inner, key);
        text(&mut inner, value);
    }
    out.extend_from_slice(&(inner.len() as u32).to_le_bytes());
    out.extend_from_slice(&inner);
}

fn record(out: &mut Vec<u8>, opcode: u8, content: &[u8]) {
    out.push(opcode);
    out.extend_from_slice(&(content.len() as u64).to_le_bytes());
    out.extend_from_slice(content);
}

struct Topic {
    name: &'static str,
    message: &'static str,
    encoding: &'static str,
    metadata: &'static [(&'static str, &'static str)],
}

const TOPICS: [Topic; 16] = [
    Topic { name: "/is", message: "InertialSensors", encoding: "protobuf", metadata: &[] },
    Topic { name: "/ifo", message: "Interferometers", encoding: "protobuf", metadata: &[] },
    Topic { name: "/dws", message: "Dws", encoding: "protobuf", metadata: &[] },
    Topic { name: "/command", message: "Command", encoding: "protobuf", metadata: &[] },
    Topic { name: "/ephemeris", message: "Ephemeris", encoding: "protobuf", metadata: &[] },
    Topic {
        name: "/hk/flux_capacitor_v",
        message: "Scalar",
        encoding: "protobuf",
        metadata: &[("unit", "V"), ("place", "bay 3"), ("rate_hz", "0.5")],
    },
    Topic {
        name: "/hk/tank_pressure_pa",
        message: "Scalar",
        encoding: "protobuf",
        metadata: &[("unit", "Pa"), ("place", "tank"), ("rate_hz", "0.1")],
    },
    Topic { name: "/debug/text", message: "", encoding: "json", metadata: &[] },
    Topic { name: "/hk/housing_a_left_k", message: "Scalar", encoding: "protobuf", metadata: THERMOMETER },
    Topic { name: "/hk/housing_a_right_k", message: "Scalar", encoding: "protobuf", metadata: THERMOMETER },
    Topic { name: "/hk/battery_case_k", message: "Scalar", encoding: "protobuf", metadata: THERMOMETER },
    Topic {
        name: "/hk/bus_current_a",
        message: "Scalar",
        encoding: "protobuf",
        metadata: &[("unit", "A"), ("place", "power unit"), ("rate_hz", "1")],
    },
    Topic {
        name: "/hk/panel_k",
        message: "Scalar",
        encoding: "protobuf",
        metadata: &[("unit", "K"), ("place", "panel"), ("rate_hz", "0.1")],
    },
    Topic { name: "/hk/boom_bx_t", message: "Scalar", encoding: "protobuf", metadata: MAGNETOMETER },
    Topic { name: "/hk/boom_by_t", message: "Scalar", encoding: "protobuf", metadata: MAGNETOMETER },
    Topic { name: "/hk/boom_bz_t", message: "Scalar", encoding: "protobuf", metadata: MAGNETOMETER },
];
/// Topics of a file without those of the power system and the magnetometer.
const WITHOUT_POWER: usize = 11;

const MAGNETOMETER: &[(&str, &str)] = &[("unit", "T"), ("place", "boom"), ("rate_hz", "0.1")];

const THERMOMETER: &[(&str, &str)] = &[("unit", "K"), ("place", "somewhere"), ("rate_hz", "0.1")];

fn definitions(topics: usize) -> Vec<u8> {
    let mut out = Vec::new();
    let descriptors = wire::descriptor_set();
    for (id, topic) in (1u16..).zip(&TOPICS[..topics]) {
        let schema_id = if topic.message.is_empty() { 0 } else { id };
        if schema_id != 0 {
            let mut schema = id.to_le_bytes().to_vec();
            text(&mut schema, &format!("dragfree.telemetry.v1.{}", topic.message));
            text(&mut schema, "protobuf");
            schema.extend_from_slice(&(descriptors.len() as u32).to_le_bytes());
            schema.extend_from_slice(&descriptors);
            record(&mut out, 0x03, &schema);
        }
        let mut channel = id.to_le_bytes().to_vec();
        channel.extend_from_slice(&schema_id.to_le_bytes());
        text(&mut channel, topic.name);
        text(&mut channel, topic.encoding);
        map(&mut channel, topic.metadata);
        record(&mut out, 0x04, &channel);
    }
    out
}

struct Chunk {
    start_offset: u64,
    length: u64,
    first: u64,
    last: u64,
    index_offsets: Vec<(u16, u64)>,
    index_length: u64,
    compressed: u64,
    uncompressed: u64,
}

/// A file that grows sample by sample.
pub struct Recorder {
    file: File,
    /// Bytes in the file, and bytes that are not yet written to it.
    written: u64,
    out: Vec<u8>,
    container: Container,
    /// Whether current and panel temperature of the power system, and the magnetic field, are telemetered.
    power: bool,
    /// Messages of the open chunk, with times and positions per channel.
    open: Vec<u8>,
    index: [Vec<(u64, u64)>; TOPICS.len()],
    messages: usize,
    span: Option<(u64, u64)>,
    chunks: Vec<Chunk>,
    counts: [u64; TOPICS.len()],
    whole: Option<(u64, u64)>,
}

impl Recorder {
    /// A new file with its definitions; `power` tells whether current and panel temperature of the power system, and
    /// the magnetic field, are telemetered.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn create(path: &Path, container: Container, power: bool) -> io::Result<Self> {
        let mut recorder = Self {
            file: File::create(path)?,
            written: 0,
            out: MAGIC.to_vec(),
            container,
            power,
            open: Vec::new(),
            index: Default::default(),
            messages: 0,
            span: None,
            chunks: Vec::new(),
            counts: [0; TOPICS.len()],
            whole: None,
        };
        let mut header = Vec::new();
        text(&mut header, "");
        text(&mut header, "somebody else 7.1");
        record(&mut recorder.out, 0x01, &header);
        let mut metadata = Vec::new();
        text(&mut metadata, "dragfree");
        let who = [("time_scale", "UTC"), ("mission", "Taiji"), ("spacecraft", "SC1"), ("producer", "somebody else")];
        map(&mut metadata, &who);
        record(&mut recorder.out, 0x0c, &metadata);
        recorder.out.extend_from_slice(&definitions(recorder.topics()));
        Ok(recorder)
    }

    fn topics(&self) -> usize {
        if self.power { TOPICS.len() } else { WITHOUT_POWER }
    }

    /// Appends the `k`-th sample of a flight, at `time_ns`; `k` decides which slower messages come with it.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn sample(&mut self, k: usize, time_ns: u64, r: &Record) -> io::Result<()> {
        self.message(0, time_ns, &wire::inertial_sensors(r))?;
        self.message(1, time_ns, &wire::interferometers(r))?;
        self.message(2, time_ns, &wire::dws(r))?;
        if self.container.command {
            self.message(3, time_ns, &wire::command(r))?;
        }
        if self.container.ephemeris && k.is_multiple_of(600) {
            self.message(4, time_ns, &wire::ephemeris())?;
        }
        if k.is_multiple_of(20) {
            self.message(5, time_ns, &wire::scalar(1.21e9 + (k as f64 / 100.0).sin()))?;
        }
        if self.power && k.is_multiple_of(10) {
            self.message(11, time_ns, &wire::scalar(r.bus_a))?;
        }
        if k.is_multiple_of(100) {
            self.message(6, time_ns, &wire::scalar(2e7 - k as f64))?;
            self.message(7, time_ns, br#"{"says": "all is well"}"#)?;
            for (i, t) in r.temperature_k.into_iter().enumerate() {
                self.message(8 + i, time_ns, &wire::scalar(t))?;
            }
            if self.power {
                self.message(12, time_ns, &wire::scalar(r.panel_k))?;
                for (i, b) in r.field_t.into_iter().enumerate() {
                    self.message(13 + i, time_ns, &wire::scalar(b))?;
                }
            }
        }
        Ok(())
    }

    /// Ends the file.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn finish(mut self) -> io::Result<()> {
        self.close_chunk()?;
        record(&mut self.out, 0x0f, &[0; 4]);
        self.summary();
        self.out.extend_from_slice(MAGIC);
        self.file.write_all(&self.out)
    }

    fn position(&self) -> u64 {
        self.written + self.out.len() as u64
    }

    /// Writes what is kept if it is much.
    fn spill(&mut self) -> io::Result<()> {
        if self.out.len() >= BUFFER {
            self.file.write_all(&self.out)?;
            self.written += self.out.len() as u64;
            self.out.clear();
        }
        Ok(())
    }

    fn message(&mut self, topic: usize, time_ns: u64, data: &[u8]) -> io::Result<()> {
        let mut content = ((topic + 1) as u16).to_le_bytes().to_vec();
        content.extend_from_slice(&(self.counts[topic] as u32).to_le_bytes());
        content.extend_from_slice(&time_ns.to_le_bytes());
        content.extend_from_slice(&time_ns.to_le_bytes());
        content.extend_from_slice(data);
        self.counts[topic] += 1;
        let widen = |span: Option<(u64, u64)>| {
            span.map_or(Some((time_ns, time_ns)), |(a, b)| Some((a.min(time_ns), b.max(time_ns))))
        };
        self.whole = widen(self.whole);
        if !self.container.chunks {
            record(&mut self.out, 0x05, &content);
            return self.spill();
        }
        self.span = widen(self.span);
        self.index[topic].push((time_ns, self.open.len() as u64));
        record(&mut self.open, 0x05, &content);
        self.messages += 1;
        if self.messages == MESSAGES_PER_CHUNK {
            self.close_chunk()?;
        }
        Ok(())
    }

    fn close_chunk(&mut self) -> io::Result<()> {
        let Some((first, last)) = self.span.take() else { return Ok(()) };
        let records = std::mem::take(&mut self.open);
        let packed = if self.container.zstd { zstd::encode_all(&records[..], 1)? } else { records.clone() };
        let mut content = first.to_le_bytes().to_vec();
        content.extend_from_slice(&last.to_le_bytes());
        content.extend_from_slice(&(records.len() as u64).to_le_bytes());
        content.extend_from_slice(&crc32fast::hash(&records).to_le_bytes());
        text(&mut content, if self.container.zstd { "zstd" } else { "" });
        content.extend_from_slice(&(packed.len() as u64).to_le_bytes());
        content.extend_from_slice(&packed);
        let start_offset = self.position();
        record(&mut self.out, 0x06, &content);
        let (length, indexes) = (self.position() - start_offset, self.position());
        let mut index_offsets = Vec::new();
        for (topic, entries) in self.index.iter_mut().enumerate().filter(|(_, e)| !e.is_empty()) {
            let id = (topic + 1) as u16;
            index_offsets.push((id, self.written + self.out.len() as u64));
            let mut content = id.to_le_bytes().to_vec();
            content.extend_from_slice(&(entries.len() as u32 * 16).to_le_bytes());
            for (time, offset) in entries.drain(..) {
                content.extend_from_slice(&time.to_le_bytes());
                content.extend_from_slice(&offset.to_le_bytes());
            }
            record(&mut self.out, 0x07, &content);
        }
        self.messages = 0;
        self.chunks.push(Chunk {
            start_offset,
            length,
            first,
            last,
            index_offsets,
            index_length: self.position() - indexes,
            compressed: packed.len() as u64,
            uncompressed: records.len() as u64,
        });
        self.spill()
    }

    fn summary(&mut self) {
        let start = self.position();
        if !self.container.summary {
            record(&mut self.out, 0x02, &[0; 20]);
            return;
        }
        let topics = self.topics();
        let mut summary = definitions(topics);
        for c in &self.chunks {
            let mut content = Vec::new();
            for number in [c.first, c.last, c.start_offset, c.length] {
                content.extend_from_slice(&number.to_le_bytes());
            }
            content.extend_from_slice(&(c.index_offsets.len() as u32 * 10).to_le_bytes());
            for (id, offset) in &c.index_offsets {
                content.extend_from_slice(&id.to_le_bytes());
                content.extend_from_slice(&offset.to_le_bytes());
            }
            content.extend_from_slice(&c.index_length.to_le_bytes());
            text(&mut content, if self.container.zstd { "zstd" } else { "" });
            content.extend_from_slice(&c.compressed.to_le_bytes());
            content.extend_from_slice(&c.uncompressed.to_le_bytes());
            record(&mut summary, 0x08, &content);
        }
        let (first, last) = self.whole.unwrap_or_default();
        let mut content = self.counts.iter().sum::<u64>().to_le_bytes().to_vec();
        content.extend_from_slice(&(topics as u16 - 1).to_le_bytes());
        for number in [topics as u32, 0, 1, self.chunks.len() as u32] {
            content.extend_from_slice(&number.to_le_bytes());
        }
        content.extend_from_slice(&first.to_le_bytes());
        content.extend_from_slice(&last.to_le_bytes());
        content.extend_from_slice(&(topics as u32 * 10).to_le_bytes());
        for (id, count) in (1u16..).zip(&self.counts[..topics]) {
            content.extend_from_slice(&id.to_le_bytes());
            content.extend_from_slice(&count.to_le_bytes());
        }
        record(&mut summary, 0x0b, &content);
        // The CRC covers the summary and the footer up to itself.
        let mut footer = vec![0x02];
        footer.extend_from_slice(&20u64.to_le_bytes());
        footer.extend_from_slice(&start.to_le_bytes());
        footer.extend_from_slice(&0u64.to_le_bytes());
        summary.extend_from_slice(&footer);
        let crc = crc32fast::hash(&summary);
        self.out.extend_from_slice(&summary);
        self.out.extend_from_slice(&crc.to_le_bytes());
    }
}

/// Writes the records of a flight that begins at `start_ns`.
///
/// # Panics
/// The file cannot be written.
pub fn write(path: &Path, records: &[Record], start_ns: u64, container: Container) {
    let mut recorder = Recorder::create(path, container, false).expect("the folder is writable");
    for (k, r) in records.iter().enumerate() {
        recorder.sample(k, start_ns + k as u64 * PERIOD_NS, r).expect("the file is writable");
    }
    recorder.finish().expect("the file is writable");
}

/// Time from sample to sample, ns.
pub const PERIOD_NS: u64 = 100_000_000;
