//! Rows that wait for a reader.

use crate::border::Rows;
use crate::table::Batch;

/// The columns of one table that one node reads, from the first row that it has not seen.
#[derive(Clone, Debug)]
pub(super) struct Queue {
    pub(super) table: String,
    pub(super) uniform: bool,
    start: usize,
    time_ns: Vec<i64>,
    columns: Vec<Vec<f64>>,
    /// Rows before this time are not for the reader, Unix ns.
    from_ns: i64,
}

impl Queue {
    pub(super) fn new(table: String, uniform: bool, columns: usize) -> Self {
        let columns = vec![Vec::new(); columns];
        Self { table, uniform, start: 0, time_ns: Vec::new(), columns, from_ns: i64::MIN }
    }

    /// Leaves out rows before a time.
    pub(super) fn begin_at(&mut self, from_ns: i64) {
        self.from_ns = from_ns;
    }

    pub(super) fn rows(&self) -> usize {
        self.time_ns.len() - self.start
    }

    pub(super) fn push(&mut self, batch: &Batch, columns: &[usize]) {
        let early = batch.time_ns.partition_point(|t| *t < self.from_ns);
        self.time_ns.extend_from_slice(&batch.time_ns[early..]);
        for (mine, theirs) in self.columns.iter_mut().zip(columns) {
            mine.extend_from_slice(&batch.columns[*theirs][early..]);
        }
    }

    /// The first `rows` rows.
    pub(super) fn front(&self, rows: usize) -> Rows<'_> {
        let range = self.start..self.start + rows;
        Rows {
            time_ns: &self.time_ns[range.clone()],
            columns: self.columns.iter().map(|c| &c[range.clone()]).collect(),
        }
    }

    /// Forgets the first `rows` rows; moves what is left only when it is the smaller part, so that a row is moved
    /// once on average.
    pub(super) fn consume(&mut self, rows: usize) {
        self.start += rows;
        if self.start * 2 >= self.time_ns.len() {
            self.time_ns.drain(..self.start);
            for column in &mut self.columns {
                column.drain(..self.start);
            }
            self.start = 0;
        }
    }

    pub(super) fn columns(&self) -> usize {
        self.columns.len()
    }

    /// Puts back rows that were saved.
    pub(super) fn replace(&mut self, time_ns: Vec<i64>, columns: Vec<Vec<f64>>) {
        self.start = 0;
        self.time_ns = time_ns;
        self.columns = columns;
    }
}
