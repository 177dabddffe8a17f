//! Tables: what flows from a feed (files or a source plugin) through the stages. See ARCHITECTURE.md.

pub use dragfree_schema::Column;
use serde::{Deserialize, Serialize};

/// A table as linked: its columns after the times.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct TableSpec {
    /// Name, `is` or `grid`.
    pub name: String,
    /// Rate of a uniform table, Hz; 0 for an irregular one.
    pub rate_hz: f64,
    /// Columns after `time_ns`.
    pub columns: Vec<Column>,
    /// True where the table holds the truth of a simulation: written apart, never linked to a stage.
    pub truth: bool,
}

/// Rows of one table.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Batch {
    /// Unix nanoseconds of the telemetry's time scale, ascending.
    pub time_ns: Vec<i64>,
    /// One vector per column of the [`TableSpec`], each as long as `time_ns`; NaN where there is no value.
    pub columns: Vec<Vec<f64>>,
}

impl Batch {
    /// An empty batch with `columns` columns.
    pub fn empty(columns: usize) -> Self {
        Self { time_ns: Vec::new(), columns: vec![Vec::new(); columns] }
    }

    /// Takes the rows at and after `time_ns` out.
    pub fn split_off(&mut self, time_ns: i64) -> Self {
        let at = self.time_ns.partition_point(|t| *t < time_ns);
        Self {
            time_ns: self.time_ns.split_off(at),
            columns: self.columns.iter_mut().map(|c| c.split_off(at)).collect(),
        }
    }

    /// Its columns, the times first, each as the bytes of its values.
    pub(crate) fn bytes(&self) -> Vec<&[u8]> {
        let values = self.columns.iter().map(|column| bytemuck::cast_slice(column));
        std::iter::once(bytemuck::cast_slice(&self.time_ns)).chain(values).collect()
    }

    /// Number of rows.
    pub fn rows(&self) -> usize {
        self.time_ns.len()
    }
}

/// A stretch of time from a feed: for each of its tables the rows of that stretch.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Chunk {
    /// One batch per table of the feed, in its order.
    pub batches: Vec<Batch>,
    /// Every row before this time has been delivered, Unix ns.
    pub complete_until_ns: i64,
}

impl Chunk {
    /// Takes the rows at and after `time_ns` out; this chunk is complete until then at most.
    pub fn split_off(&mut self, time_ns: i64) -> Self {
        let later = self.batches.iter_mut().map(|b| b.split_off(time_ns)).collect();
        let complete_until_ns = self.complete_until_ns;
        self.complete_until_ns = complete_until_ns.min(time_ns);
        Self { batches: later, complete_until_ns }
    }
}
