//! Where the inputs of a product lay when it was made.

use serde::{Deserialize, Serialize};
use std::io;
use std::path::{Path, PathBuf};

use crate::EngineError;
use crate::files::IoContext as _;
use crate::product::SOURCES;

/// Where the inputs of a product lay, in a file beside it that is no part of it: places change, content does not.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Sources {
    /// Pipeline file.
    pub pipeline: PathBuf,
    /// Mission file.
    pub mission: PathBuf,
    /// Model file.
    pub model: PathBuf,
    /// Telemetry.
    pub telemetry: Vec<PathBuf>,
    /// First time that was asked for, Unix ns.
    pub from_ns: Option<i64>,
    /// End of the time that was asked for, Unix ns.
    pub until_ns: Option<i64>,
}

impl Sources {
    pub(crate) fn write(&self, path: &Path) -> Result<(), EngineError> {
        let text = serde_json::to_string_pretty(self).unwrap_or_default() + "\n";
        Ok(std::fs::write(path, text).at("write", path)?)
    }

    /// Reads them.
    ///
    /// # Errors
    /// [`EngineError::Io`] where there is no such file beside the product.
    pub fn read(product: &Path) -> Result<Self, EngineError> {
        let path = product.with_extension(SOURCES);
        let text = std::fs::read_to_string(&path).at("read where the inputs lay, from", &path)?;
        Ok(serde_json::from_str(&text).map_err(io::Error::from).at("read", path)?)
    }
}
