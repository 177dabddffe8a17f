//! Where the inputs of a product lay when it was made.

use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

use crate::EngineError;
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
    fn path(product: &Path) -> PathBuf {
        product.with_extension(SOURCES)
    }

    pub(crate) fn write(&self, path: &Path) -> Result<(), EngineError> {
        let text = serde_json::to_string_pretty(self).unwrap_or_default() + "\n";
        std::fs::write(path, text).map_err(|source| EngineError::Io { action: "write", path: path.to_owned(), source })
    }

    /// Reads them.
    ///
    /// # Errors
    /// [`EngineError::Io`] where there is no such file beside the product.
    pub fn read(product: &Path) -> Result<Self, EngineError> {
        let path = Self::path(product);
        let text = std::fs::read_to_string(&path).map_err(|source| EngineError::Io {
            action: "read where the inputs lay, from",
            path: path.clone(),
            source,
        })?;
        serde_json::from_str(&text).map_err(|e| EngineError::Io { action: "read", path, source: e.into() })
    }
}
