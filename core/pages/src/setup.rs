//! What the pages are made from.

use std::path::PathBuf;

use chrono::NaiveDate;
use dragfree_engine::config::Mission;
use dragfree_engine::registry::Registry;

use crate::jobs::Starter;

/// True value of a coefficient of a simulation, in its SI unit.
pub type Truth = Box<dyn Fn(&str) -> Option<f64> + Send + Sync>;

/// What the pages are made from.
pub struct Setup {
    /// Folder of the archive.
    pub archive: PathBuf,
    /// Installed plugins.
    pub registry: Registry,
    /// Mission that effects are tried with before they are kept.
    pub mission: Mission,
    /// Model file that "Keep" adds effects to; none where there is nothing to keep them in.
    pub model: Option<PathBuf>,
    /// Programs that pages may start; none where they may not.
    pub starter: Option<Starter>,
    /// Truth of a simulation whose seal is open.
    pub truth: Option<Truth>,
    /// Events on the time line.
    pub events: Option<PathBuf>,
    /// Kinds of events with the effects whose coefficients they change.
    pub steps: Vec<(String, String)>,
    /// What commands repeat so that they find the same archive and plugins, a space before each word.
    pub flags: String,
    /// The same for `dragfree model add`: the mission that effects are tried with, and plugins.
    pub model_flags: String,
    /// Name and version of the program.
    pub software: &'static str,
    /// Tells which day it is, UTC: a server stays for weeks.
    pub today: Box<dyn Fn() -> NaiveDate + Send + Sync>,
}
