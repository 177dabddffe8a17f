//! Messages of one topic of a whole file as columns: time series of products, the truth of a simulation.

use super::{Cells, Decoder, Layout};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Why the messages of a topic cannot be had.
#[derive(Debug, thiserror::Error)]
#[error("{}: {source}", path.display())]
pub struct TopicError {
    /// The file.
    pub path: PathBuf,
    /// What is wrong with the file, its schema or its messages.
    pub source: Box<dyn std::error::Error + Send + Sync>,
}

/// Messages of a topic, in the order of the file.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Topic {
    /// Log times, Unix ns.
    pub time_ns: Vec<i64>,
    /// Values by the path of their field, `b1_orf_m.x`.
    pub columns: BTreeMap<String, Vec<f64>>,
    /// What the channel says of itself: unit and frame of generated columns.
    pub metadata: BTreeMap<String, String>,
}

/// The first message of a topic, values by field path; empty without one.
///
/// # Errors
/// [`TopicError`] when the file is no telemetry.
pub fn first_message(path: &Path, topic: &str) -> Result<BTreeMap<String, f64>, TopicError> {
    let first = std::fs::read(path).map_err(Into::into).and_then(|bytes| messages(&bytes, topic, 1));
    let first = first.map_err(|source| TopicError { path: path.to_owned(), source })?;
    Ok(first.columns.into_iter().filter_map(|(field, values)| Some((field, *values.first()?))).collect())
}

/// All messages of a topic of a file, whose content is `bytes`; empty without one.
///
/// # Errors
/// [`TopicError`] when the file is no telemetry.
pub fn read_topic(path: &Path, bytes: &[u8], topic: &str) -> Result<Topic, TopicError> {
    messages(bytes, topic, usize::MAX).map_err(|source| TopicError { path: path.to_owned(), source })
}

/// The fields of every topic of a file, whose content is `bytes`, by their paths.
///
/// # Errors
/// [`TopicError`] when the file is no telemetry.
pub fn topics(path: &Path, bytes: &[u8]) -> Result<BTreeMap<String, Vec<String>>, TopicError> {
    fields(bytes).map_err(|source| TopicError { path: path.to_owned(), source })
}

fn fields(bytes: &[u8]) -> Result<BTreeMap<String, Vec<String>>, Box<dyn std::error::Error + Send + Sync>> {
    let summary = mcap::Summary::read(bytes)?.ok_or("the file has no summary")?;
    let mut all = BTreeMap::new();
    for channel in summary.channels.values() {
        let Some(schema) = &channel.schema else { continue };
        let layout = Layout::parse(&schema.data, &schema.name)?;
        let paths = layout.leaves().iter().map(|leaf| leaf.path.clone()).collect();
        all.insert(channel.topic.clone(), paths);
    }
    Ok(all)
}

fn messages(bytes: &[u8], topic: &str, most: usize) -> Result<Topic, Box<dyn std::error::Error + Send + Sync>> {
    let mut decoding: Option<(Layout, Decoder)> = None;
    let mut columns: Vec<Vec<f64>> = Vec::new();
    let mut all = Topic::default();
    for message in mcap::MessageStream::new(bytes)? {
        let message = message?;
        let Some(schema) = message.channel.schema.as_ref().filter(|_| message.channel.topic == topic) else { continue };
        if decoding.is_none() {
            let layout = Layout::parse(&schema.data, &schema.name)?;
            columns = vec![Vec::new(); layout.leaves().len()];
            all.metadata.clone_from(&message.channel.metadata);
            decoding = Some((layout.clone(), Decoder::new(&layout)));
        }
        let Some((_, decoder)) = &mut decoding else { continue };
        let mut values = vec![f64::NAN; columns.len()];
        decoder.decode(&message.data, &mut Cells { values: &mut values, rows: 1, row: 0 })?;
        all.time_ns.push(i64::try_from(message.log_time)?);
        columns.iter_mut().zip(values).for_each(|(column, x)| column.push(x));
        if all.time_ns.len() == most {
            break;
        }
    }
    if let Some((layout, _)) = decoding {
        all.columns = layout.leaves().iter().map(|leaf| leaf.path.clone()).zip(columns).collect();
    }
    Ok(all)
}
