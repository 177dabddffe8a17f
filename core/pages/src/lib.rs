//! The workbench: pages of an archive for a browser, served on this machine or written as files.
//!
//! The pages say what [`dragfree_workflow`] answers, and compute nothing themselves.

mod address;
mod compare;
mod day;
mod formula;
mod guard;
pub mod jobs;
mod keep;
mod layout;
mod missing;
mod mission;
pub mod pictures;
mod plugins;
mod report;
pub mod server;
mod setup;
mod site;
mod sliders;
mod spacecraft;
mod starting;
mod trends;

pub use formula::Typed;
pub use layout::Links;
pub use report::report;
pub use setup::{Setup, Truth};
pub use site::{Query, Site};

use std::path::PathBuf;

/// Why a page cannot be made or served.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs, reason = "every field is named in its sentence")]
pub enum PagesError {
    /// The archive.
    #[error(transparent)]
    Archive(#[from] dragfree_archive::ArchiveError),
    /// What the page shows cannot be computed.
    #[error(transparent)]
    Workflow(#[from] dragfree_workflow::WorkflowError),
    /// The switches cannot be set so.
    #[error(transparent)]
    Refit(#[from] dragfree_workflow::refit::RefitError),
    /// The model cannot be changed.
    #[error(transparent)]
    Add(#[from] dragfree_workflow::adding::AddError),
    /// A picture.
    #[error(transparent)]
    Chart(#[from] dragfree_chart::ChartError),
    /// No such page.
    #[error("there is no page {0}; the menu lists those that there are")]
    NoPage(String),
    /// A request that cannot be understood.
    #[error("{0}")]
    Request(String),
    /// A request that is not allowed.
    #[error("{0}")]
    Refused(String),
    /// No address to listen at.
    #[error("no page can be served at {address}: {source}; --listen names another address")]
    Listen { address: String, source: std::io::Error },
    /// A file of a report.
    #[error("cannot write {}: {source}", path.display())]
    Write { path: PathBuf, source: std::io::Error },
    /// The operating system gives no random numbers.
    #[error("no token can be made: {0}")]
    Token(String),
}
