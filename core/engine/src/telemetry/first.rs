//! The first message of a topic: what a simulation tells of a truth that stays as it is.

use super::{Cells, Decoder, Layout, LayoutError, WireError};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Why the first message cannot be had.
#[derive(Debug, thiserror::Error)]
pub enum FirstError {
    /// The file cannot be read.
    #[error("{path}: {source}", path = path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// It is no MCAP file.
    #[error("{path}: {source}", path = path.display())]
    Mcap {
        /// The file.
        path: PathBuf,
        /// Why.
        source: mcap::McapError,
    },
    /// Its schema has no sense.
    #[error("{path}: {source}", path = path.display())]
    Layout {
        /// The file.
        path: PathBuf,
        /// Why.
        source: LayoutError,
    },
    /// The message has none.
    #[error("{path}: {source}", path = path.display())]
    Wire {
        /// The file.
        path: PathBuf,
        /// Why.
        source: WireError,
    },
}

/// The first message of a topic, values by field path, `b1_orf_m.x`; empty without one.
///
/// # Errors
/// [`FirstError`] when the file is no telemetry.
pub fn first_message(path: &Path, topic: &str) -> Result<BTreeMap<String, f64>, FirstError> {
    let path_of = || path.to_owned();
    let bytes = std::fs::read(path).map_err(|source| FirstError::Io { path: path_of(), source })?;
    let broken = |source| FirstError::Mcap { path: path_of(), source };
    for message in mcap::MessageStream::new(&bytes).map_err(broken)? {
        let message = message.map_err(broken)?;
        if let Some(schema) = message.channel.schema.as_ref().filter(|_| message.channel.topic == topic) {
            let layout = Layout::parse(&schema.data, &schema.name)
                .map_err(|source| FirstError::Layout { path: path_of(), source })?;
            let mut values = vec![f64::NAN; layout.leaves().len()];
            let mut cells = Cells { values: &mut values, rows: 1, row: 0 };
            Decoder::new(&layout)
                .decode(&message.data, &mut cells)
                .map_err(|source| FirstError::Wire { path: path_of(), source })?;
            return Ok(layout.leaves().iter().map(|leaf| leaf.path.clone()).zip(values).collect());
        }
    }
    Ok(BTreeMap::new())
}
