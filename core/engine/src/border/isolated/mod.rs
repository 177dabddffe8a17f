//! Plugins that are not trusted, each instance in a process of its own.
//!
//! The child opens the library behind a sandbox (`sandbox.rs`) and calls the instance through the same C border. Calls
//! and their answers are messages over a socket (`message.rs`), rows lie in memory that both processes share
//! (`memory.rs`). Nothing that comes from the child is believed: what it declares is checked again here, and rows are
//! copied out of the shared memory before they are used.

mod child;
mod memory;
mod message;
mod parent;
mod sandbox;

pub use child::serve;
pub(super) use parent::Isolated;
pub use parent::described;

use std::ffi::OsString;
use std::path::PathBuf;
use std::time::Duration;

/// How a process for a plugin is started: `program` with `arguments` calls [`serve`].
#[derive(Clone, Debug)]
pub struct Isolation {
    /// The program.
    pub program: PathBuf,
    /// Its arguments.
    pub arguments: Vec<OsString>,
    /// Longest time of a call.
    pub limit: Duration,
}
