//! Columns of the tables that flow through the chain.

use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// What a column is: its name, unit, frame, rate and free attributes.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Column {
    /// Table that the column belongs to.
    pub table: String,
    /// Name, unique in its table.
    pub name: String,
    /// SI unit, `m s-2`; `1` for a number, empty for flags.
    pub unit: String,
    /// Frame, `ORF_1`; empty where there is none.
    pub frame: String,
    /// Rate of a uniform table, Hz; 0 for an irregular one.
    pub rate_hz: f64,
    /// Free attributes, `kind = channel` among them.
    pub attributes: BTreeMap<String, String>,
}

impl Column {
    /// An attribute, empty where there is none.
    pub fn attribute(&self, key: &str) -> &str {
        self.attributes.get(key).map_or("", String::as_str)
    }
}
