//! What calls of an instance are given and give back.

use super::library::PluginInfo;
use crate::table::{Batch, Column};

/// What an instance is made from: the JSON object that `dragfree_config_v1` describes.
#[derive(Clone, Debug, Default)]
pub struct Config {
    /// `parameters`, `mission`, `instance`, `files`, `start_ns`, `end_ns`.
    pub value: serde_json::Value,
}

/// What exists when an instance is linked.
#[derive(Clone, Copy, Debug)]
pub struct LinkRequest<'a> {
    /// Every column made so far.
    pub available: &'a [Column],
    /// What the plugins before it declared: a [`dragfree_schema::Model`].
    pub model_json: &'a str,
}

/// Rows of one input table.
#[derive(Debug)]
pub struct Rows<'a> {
    /// Times.
    pub time_ns: &'a [i64],
    /// The columns read, in slot order.
    pub columns: Vec<&'a [f64]>,
}

/// One step of a source.
#[derive(Debug)]
pub struct SourceStep {
    /// One batch per written table.
    pub batches: Vec<Batch>,
    /// Every row before this time has been given.
    pub complete_until_ns: i64,
    /// There is nothing more.
    pub done: bool,
}

impl Config {
    /// Name of an instance of a plugin: its id, with the instance of an effect.
    pub(super) fn name_of(&self, plugin: &PluginInfo) -> String {
        let id = &plugin.manifest.id;
        match self.value.get("instance").and_then(serde_json::Value::as_str).unwrap_or_default() {
            "" => id.clone(),
            instance => format!("{id}:{instance}"),
        }
    }
}
