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

use super::library::Kind;
use super::link::{check_noise, declared_again};
use crate::limits::STATE_BYTES;
use crate::table::Column;
use message::{Answer, receive};

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

/// Reads bytes as an answer of the process of a plugin, with the checks of what it declares: for who damages answers.
///
/// # Errors
/// A sentence: they are none, or it declares what no plugin can.
pub fn read_answer(bytes: &[u8], available: &[Column], kind: Kind) -> Result<(), String> {
    let (answer, _) = receive::<Answer>(&mut &*bytes, STATE_BYTES).map_err(|e| e.to_string())?;
    match answer {
        Answer::Linked(linked) => check_noise(&declared_again(linked, available, kind)?, available),
        _ => Ok(()),
    }
}
