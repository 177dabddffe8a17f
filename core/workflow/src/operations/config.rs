//! `mission-ops.toml`: where the parts of a mission lie.

use crate::WorkflowError;
use dragfree_archive::files::read_text;
use dragfree_engine::limits::CONFIG_BYTES;
use serde::Deserialize;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Name of the file, which is looked for from the working folder upwards.
pub const FILE: &str = "mission-ops.toml";

/// What the file says; paths in it are relative to its folder.
#[derive(Clone, Debug)]
pub struct Operations {
    /// The file.
    pub path: PathBuf,
    /// Pipeline file.
    pub pipeline: PathBuf,
    /// Mission file; the pipeline's where there is none.
    pub mission: Option<PathBuf>,
    /// Model file; the pipeline's where there is none.
    pub model: Option<PathBuf>,
    /// Folder of the products.
    pub archive: PathBuf,
    /// Patterns of telemetry files, `inbox/*.mcap`.
    pub inbox: Vec<String>,
    /// Data before a day that settle the stages before the estimators, ns.
    pub run_in_ns: i64,
    /// File of events of the spacecraft.
    pub events: Option<PathBuf>,
    /// Kinds of events with the effects whose coefficients they change.
    pub steps: BTreeMap<String, String>,
    /// Command of the operator's for a product with loss of data.
    pub on_data_loss: Option<String>,
    /// Command of the operator's for a product whose model contradicts the data.
    pub on_inconsistent: Option<String>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct File {
    operations: Table,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Table {
    pipeline: PathBuf,
    mission: Option<PathBuf>,
    model: Option<PathBuf>,
    archive: PathBuf,
    inbox: Vec<String>,
    #[serde(default = "one_hour")]
    run_in_hours: f64,
    events: Option<PathBuf>,
    #[serde(default)]
    steps: BTreeMap<String, String>,
    on_data_loss: Option<String>,
    on_inconsistent: Option<String>,
}

fn one_hour() -> f64 {
    1.0
}

impl Operations {
    /// The file in `start` or in the nearest folder above it.
    pub fn find(start: &Path) -> Option<PathBuf> {
        let start = std::path::absolute(start).ok()?;
        start.ancestors().map(|folder| folder.join(FILE)).find(|path| path.is_file())
    }

    /// Reads the file.
    ///
    /// # Errors
    /// [`WorkflowError::Operations`] says what is wrong with it.
    pub fn load(path: &Path) -> Result<Self, WorkflowError> {
        let refuse = |what: String| WorkflowError::Operations { path: path.to_owned(), what };
        let text = read_text(path, CONFIG_BYTES).map_err(|e| refuse(e.to_string()))?;
        let File { operations: table } = toml::from_str(&text).map_err(|e| refuse(e.to_string()))?;
        let place = std::path::absolute(path).map_err(|e| refuse(e.to_string()))?;
        let folder = place.parent().unwrap_or(Path::new("/"));
        let run_in_ns = table.run_in_hours * 3.6e12;
        if !(0.0..=8.64e13).contains(&run_in_ns) {
            return Err(refuse(format!("run_in_hours = {} must lie between 0 and 24", table.run_in_hours)));
        }
        if table.inbox.is_empty() {
            return Err(refuse("inbox names no telemetry; it is a list of patterns, [\"inbox/*.mcap\"]".to_owned()));
        }
        let pattern = |pattern: &String| folder.join(pattern).to_string_lossy().into_owned();
        Ok(Self {
            path: place.clone(),
            pipeline: folder.join(table.pipeline),
            mission: table.mission.map(|p| folder.join(p)),
            model: table.model.map(|p| folder.join(p)),
            archive: folder.join(table.archive),
            inbox: table.inbox.iter().map(pattern).collect(),
            run_in_ns: run_in_ns as i64,
            events: table.events.map(|p| folder.join(p)),
            steps: table.steps,
            on_data_loss: table.on_data_loss,
            on_inconsistent: table.on_inconsistent,
        })
    }
}
