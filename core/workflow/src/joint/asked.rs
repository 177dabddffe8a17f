//! What is asked of many days.

use std::path::PathBuf;

use chrono::NaiveDate;
use dragfree_archive::files::read_text;
use dragfree_engine::limits::CONFIG_BYTES;
use serde::{Deserialize, Serialize};

use super::events::{self, Event};
use crate::WorkflowError;

/// What is asked for.
#[derive(Clone, Debug, Default)]
pub struct Options {
    /// First day.
    pub first: NaiveDate,
    /// Last day.
    pub last: NaiveDate,
    /// Spacecraft; the only one where it is left out.
    pub spacecraft: Option<String>,
    /// File of events.
    pub events: Option<PathBuf>,
    /// Kinds of events with the effects, or coefficients, that they change.
    pub steps: Vec<(String, String)>,
    /// Whether coefficients are known to be constant between events.
    pub constant: bool,
}

/// What is declared of the days.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct Declared {
    /// First and last day.
    pub days: (NaiveDate, NaiveDate),
    /// Kinds of events with the effects that they change.
    pub steps: Vec<(String, String)>,
    /// Whether coefficients are known to be constant between events.
    pub constant: bool,
    /// Name and text of the file of events.
    #[serde(skip)]
    pub file: Option<(String, String)>,
}

impl Declared {
    /// Reads the file of events that is asked for.
    ///
    /// # Errors
    /// It cannot be read.
    pub fn read(options: &Options) -> Result<Self, WorkflowError> {
        let file = options.events.as_ref().map(|path| {
            let refuse = |e: std::io::Error| WorkflowError::Events { path: path.clone(), what: e.to_string() };
            let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
            read_text(path, CONFIG_BYTES).map(|text| (name, text)).map_err(refuse)
        });
        Ok(Self {
            days: (options.first, options.last),
            steps: options.steps.clone(),
            constant: options.constant,
            file: file.transpose()?,
        })
    }

    /// Events of a spacecraft, in order.
    ///
    /// # Errors
    /// The file is no list of events.
    pub fn events(&self, spacecraft: &str) -> Result<Vec<Event>, WorkflowError> {
        let parse = |(name, text): &(String, String)| events::parse(text, name.as_ref(), spacecraft, &self.steps);
        self.file.as_ref().map_or_else(|| Ok(Vec::new()), parse)
    }
}
