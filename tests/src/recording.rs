//! Telemetry read into memory and written again with changes, by the `mcap` crate alone.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;

/// A message of a file, with public fields to change.
#[derive(Clone, Debug)]
pub struct Message {
    /// Topic, `/is`.
    pub topic: Arc<str>,
    /// Time of the sample, Unix ns.
    pub log_time: u64,
    /// Protobuf.
    pub data: Vec<u8>,
}

/// A telemetry file in memory.
#[derive(Debug)]
pub struct Recording {
    channels: BTreeMap<Arc<str>, Arc<mcap::Channel<'static>>>,
    messages: Vec<Message>,
}

impl Recording {
    /// Reads a telemetry file.
    ///
    /// # Panics
    /// The file is damaged.
    #[must_use]
    pub fn read(path: &Path) -> Self {
        let bytes = std::fs::read(path).expect("readable");
        let mut recording = Self { channels: BTreeMap::new(), messages: Vec::new() };
        for message in mcap::MessageStream::new(&bytes).expect("an MCAP file") {
            let message = message.expect("a sound message");
            let known =
                recording.channels.get_key_value(message.channel.topic.as_str()).map(|(topic, _)| topic.clone());
            let topic = known.unwrap_or_else(|| {
                let topic: Arc<str> = message.channel.topic.as_str().into();
                recording.channels.insert(topic.clone(), message.channel.clone());
                topic
            });
            let data = message.data.to_vec();
            recording.messages.push(Message { topic, log_time: message.log_time, data });
        }
        recording
    }

    /// Time of the first message, Unix ns.
    #[must_use]
    pub fn start_ns(&self) -> u64 {
        self.messages[0].log_time
    }

    /// The messages in the order of the file.
    #[must_use]
    pub fn messages(&self) -> &[Message] {
        &self.messages
    }

    /// Writes the messages for which `change` returns a message.
    pub fn write(&self, to: &Path, mut change: impl FnMut(Message) -> Option<Message>) {
        self.write_all(to, self.messages.iter().filter_map(|m| change(m.clone())));
    }

    /// Writes messages, in this order, to the channels of the recording; a topic without messages has no channel.
    ///
    /// # Panics
    /// The file cannot be written.
    pub fn write_all(&self, to: &Path, messages: impl IntoIterator<Item = Message>) {
        let file = std::io::BufWriter::new(std::fs::File::create(to).expect("writable"));
        let options = mcap::WriteOptions::new().profile("").chunk_size(Some(1 << 20)).compression(None);
        let mut writer = options.create(file).expect("a writer");
        let metadata = [
            ("time_scale", "UTC"),
            ("mission", "Taiji"),
            ("spacecraft", "SC1"),
            ("producer", "tests"),
            ("version", "1"),
        ];
        let metadata = metadata.map(|(k, v)| (k.to_owned(), v.to_owned())).into();
        writer.write_metadata(&mcap::records::Metadata { name: "dragfree".to_owned(), metadata }).expect("written");
        let mut ids = BTreeMap::new();
        for (sequence, message) in messages.into_iter().enumerate() {
            let channel = &self.channels[&message.topic];
            let id = *ids.entry(message.topic.clone()).or_insert_with(|| {
                // A channel without a schema has the number 0.
                let schema = channel.schema.as_ref().map_or(0, |schema| {
                    writer.add_schema(&schema.name, &schema.encoding, &schema.data).expect("a schema")
                });
                let encoding = &channel.message_encoding;
                writer.add_channel(schema, &message.topic, encoding, &channel.metadata).expect("a channel")
            });
            let (log_time, sequence) = (message.log_time, u32::try_from(sequence).expect("few messages"));
            let header = mcap::records::MessageHeader { channel_id: id, sequence, log_time, publish_time: log_time };
            writer.write_to_known_channel(&header, &message.data).expect("written");
        }
        writer.finish().expect("a whole file");
    }
}

/// Fields of one message: number, wire type, and position of the value.
fn fields(bytes: &[u8]) -> Vec<(u64, u64, std::ops::Range<usize>)> {
    let mut at = 0;
    let varint = |at: &mut usize| {
        let (mut value, mut shift) = (0u64, 0);
        loop {
            let byte = bytes[*at];
            *at += 1;
            value |= u64::from(byte & 0x7f) << shift;
            shift += 7;
            if byte < 0x80 {
                return value;
            }
        }
    };
    let mut found = Vec::new();
    while at < bytes.len() {
        let tag = varint(&mut at);
        let start = match tag & 7 {
            2 => {
                let length = usize::try_from(varint(&mut at)).expect("a length");
                at += length;
                at - length
            }
            1 => {
                at += 8;
                at - 8
            }
            _ => {
                let start = at;
                varint(&mut at);
                start
            }
        };
        found.push((tag >> 3, tag & 7, start..at));
    }
    found
}

/// Position of a field's value; `path` lists the field number per level.
fn find(bytes: &[u8], path: &[u64]) -> Option<std::ops::Range<usize>> {
    let (first, rest) = path.split_first()?;
    let (_, _, range) = fields(bytes).into_iter().find(|(number, _, _)| number == first)?;
    if rest.is_empty() {
        return Some(range);
    }
    let inner = find(&bytes[range.clone()], rest)?;
    Some(range.start + inner.start..range.start + inner.end)
}

impl Message {
    /// A double; `None` if it was not sent. In proto3 that means zero, unless the enclosing message is absent.
    #[must_use]
    pub fn double(&self, path: &[u64]) -> Option<f64> {
        self.data.get(find(&self.data, path)?)?.try_into().ok().map(f64::from_le_bytes)
    }

    /// Replaces a double that was sent.
    ///
    /// # Panics
    /// It was not sent.
    pub fn set_double(&mut self, path: &[u64], value: f64) {
        let range = find(&self.data, path).unwrap_or_else(|| panic!("{}: no field {path:?}", self.topic));
        self.data[range].copy_from_slice(&value.to_le_bytes());
    }

    /// Sets a small integer such as a status, sent before or not: messages merge, and the later value wins.
    ///
    /// # Panics
    /// The field number exceeds 15.
    pub fn set_number(&mut self, path: &[u64], value: u8) {
        let Some((last, outer)) = path.split_last() else { return };
        let small = |number: u64, kind: u64| u8::try_from(number << 3 | kind).expect("a small field number");
        let mut bytes = vec![small(*last, 0), value];
        for number in outer.iter().rev() {
            let length = u8::try_from(bytes.len()).expect("a short message");
            bytes.splice(0..0, [small(*number, 2), length]);
        }
        self.data.extend(bytes);
    }

    /// Removes a field of the outermost message.
    pub fn remove(&mut self, field: u64) {
        let mut kept = Vec::with_capacity(self.data.len());
        let mut start = 0;
        for (number, _, range) in fields(&self.data) {
            if number != field {
                kept.extend_from_slice(&self.data[start..range.end]);
            }
            start = range.end;
        }
        self.data = kept;
    }
}
