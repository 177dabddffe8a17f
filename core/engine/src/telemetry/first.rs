//! The first message of a topic: what a simulation tells of a truth that stays as it is.

use super::{Cells, Decoder, Layout};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Why the first message cannot be had.
#[derive(Debug, thiserror::Error)]
#[error("{}: {source}", path.display())]
pub struct FirstError {
    /// The file.
    pub path: PathBuf,
    /// What is wrong with the file, its schema or its message.
    pub source: Box<dyn std::error::Error + Send + Sync>,
}

/// The first message of a topic, values by field path, `b1_orf_m.x`; empty without one.
///
/// # Errors
/// [`FirstError`] when the file is no telemetry.
pub fn first_message(path: &Path, topic: &str) -> Result<BTreeMap<String, f64>, FirstError> {
    first(path, topic).map_err(|source| FirstError { path: path.to_owned(), source })
}

fn first(path: &Path, topic: &str) -> Result<BTreeMap<String, f64>, Box<dyn std::error::Error + Send + Sync>> {
    let bytes = std::fs::read(path)?;
    for message in mcap::MessageStream::new(&bytes)? {
        let message = message?;
        if let Some(schema) = message.channel.schema.as_ref().filter(|_| message.channel.topic == topic) {
            let layout = Layout::parse(&schema.data, &schema.name)?;
            let mut values = vec![f64::NAN; layout.leaves().len()];
            let mut cells = Cells { values: &mut values, rows: 1, row: 0 };
            Decoder::new(&layout).decode(&message.data, &mut cells)?;
            return Ok(layout.leaves().iter().map(|leaf| leaf.path.clone()).zip(values).collect());
        }
    }
    Ok(BTreeMap::new())
}
