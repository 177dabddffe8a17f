//! The host's side of `plugin.h`: libraries, instances, calls. All unsafe code of the engine is in this folder.
//!
//! A library is opened once and never closed: unloading code with thread-locals is unsound (rust-lang/rust#59629).
#![allow(unsafe_code, reason = "this module calls through the C border")]

mod arrow;
mod call;
mod crash;
mod exit;
mod floats;
mod host;
mod instance;
#[cfg(target_os = "linux")]
mod isolated;
#[cfg(not(target_os = "linux"))]
#[path = "isolated_elsewhere.rs"]
mod isolated;
mod library;
mod link;
mod local;
mod owner;
mod read;
mod text;

pub use call::{Config, LinkRequest, Rows, SourceStep};
pub use crash::overdue;
pub use dragfree_schema::{Manifest, Parameter, ParameterType};
pub use exit::{ended, exit_is_due, exit_now, give_memory_back, watch_exit};
pub use instance::Instance;
pub use isolated::{Isolation, described, read_answer, serve};
pub use library::{Checked, Identity, Kind, Library, PluginInfo};
pub use link::{Linked, ReadColumn};

use std::path::PathBuf;

/// What is said of a plugin that leaves another control word.
const FLOATS_CHANGED: &str = "it changed the floating-point control word, which would change every later result";

/// A plugin's message without its own name in front, which every message is told with.
pub(crate) fn without_name<'a>(plugin: &str, message: &'a str) -> &'a str {
    let id = plugin.split_once(':').map_or(plugin, |(id, _)| id);
    let rest = |name| message.strip_prefix(name).and_then(|rest| rest.strip_prefix(':'));
    rest(plugin).or_else(|| rest(id)).map_or(message, str::trim_start)
}

/// What can go wrong at the border.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs, reason = "every field is named in its sentence")]
pub enum BorderError {
    /// A library was refused.
    #[error("{}: refused: {reason}", path.display())]
    Refused { path: PathBuf, reason: String },
    /// A plugin refused its configuration or its columns, or failed.
    #[error("plugin {plugin}: {call}: {message}")]
    Plugin { plugin: String, call: &'static str, message: String },
    /// A plugin broke the rules of the border.
    #[error("plugin {plugin}: {call}: broke the rules of plugin.h: {what}; report it to its author")]
    Rule { plugin: String, call: &'static str, what: String },
    /// Columns do not fit.
    #[error("plugin {plugin}: {sentence}")]
    Link { plugin: String, sentence: String },
}
