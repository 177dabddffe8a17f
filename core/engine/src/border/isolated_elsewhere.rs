//! Processes of their own for plugins: not on this system.

use std::convert::Infallible;
use std::ffi::OsString;
use std::path::PathBuf;
use std::time::Duration;

use super::call::{Config, LinkRequest, Rows, SourceStep};
use super::library::{Checked, Kind, Library, PluginInfo};
use super::link::Linked;
use super::{BorderError, exit_now};
use crate::table::{Batch, Column};

/// How a process for a plugin would be started.
#[derive(Clone, Debug)]
#[allow(missing_docs, reason = "as on Linux")]
pub struct Isolation {
    pub program: PathBuf,
    pub arguments: Vec<OsString>,
    pub limit: Duration,
}

/// Nobody calls this.
pub fn serve() -> ! {
    exit_now(1)
}

/// Refuses a library.
///
/// # Errors
/// Always.
pub fn described(_: &Isolation, checked: &Checked) -> Result<Library, BorderError> {
    Err(BorderError::Refused { path: checked.path().to_owned(), reason: NOT_HERE.to_owned() })
}

/// Refuses an answer.
///
/// # Errors
/// Always.
pub fn read_answer(_: &[u8], _: &[Column], _: Kind) -> Result<(), String> {
    Err(NOT_HERE.to_owned())
}

const NOT_HERE: &str = "is to run in a process of its own, which works on Linux alone";

/// Cannot exist.
#[derive(Debug)]
pub(super) struct Isolated(Infallible);

impl Isolated {
    pub(super) fn create(_: &Isolation, library: &Library, _: &PluginInfo, _: &Config) -> Result<Self, BorderError> {
        Err(BorderError::Refused { path: library.path.clone(), reason: NOT_HERE.to_owned() })
    }

    pub(super) fn link(&mut self, _: LinkRequest<'_>) -> Result<Linked, BorderError> {
        match self.0 {}
    }

    pub(super) fn activate(&mut self, _: u32) -> Result<(), BorderError> {
        match self.0 {}
    }

    pub(super) fn process(&mut self, _: &[Rows<'_>], _: i64) -> Result<Option<Vec<Batch>>, BorderError> {
        match self.0 {}
    }

    pub(super) fn next(&mut self, _: u32) -> Result<SourceStep, BorderError> {
        match self.0 {}
    }

    pub(super) fn flush(&mut self) -> Result<Vec<Batch>, BorderError> {
        match self.0 {}
    }

    pub(super) fn report(&mut self, _: &str) -> Result<Option<Vec<u8>>, BorderError> {
        match self.0 {}
    }

    pub(super) fn save(&mut self) -> Result<Vec<u8>, BorderError> {
        match self.0 {}
    }

    pub(super) fn load(&mut self, _: &[u8]) -> Result<(), BorderError> {
        match self.0 {}
    }
}
