//! Rows in and rows out.

use dragfree_abi as abi;

use crate::error::PluginError;
use crate::link::{In, Out, Table, Written};

/// The rows that a call is given; borrowed from the host.
#[derive(Debug)]
pub struct Inputs<'a> {
    pub(crate) tables: Vec<InputTable<'a>>,
    pub(crate) uniform: Option<u32>,
    pub(crate) complete_until_ns: i64,
}

#[derive(Debug)]
pub(crate) struct InputTable<'a> {
    pub(crate) time_ns: &'a [i64],
    pub(crate) columns: Vec<&'a [f64]>,
}

impl Inputs<'_> {
    /// Number of rows of the joined uniform tables; 0 where only irregular tables are read.
    #[must_use]
    pub fn rows(&self) -> usize {
        self.time_ns().len()
    }

    /// Times of the joined uniform tables, Unix ns.
    #[must_use]
    pub fn time_ns(&self) -> &[i64] {
        self.uniform.map_or(&[], |table| self.tables[table as usize].time_ns)
    }

    /// Times of the table that a column belongs to, Unix ns.
    #[must_use]
    pub fn times_of(&self, column: In) -> &[i64] {
        self.tables[column.slot.table as usize].time_ns
    }

    /// Values of a column, NaN where there is none.
    #[must_use]
    pub fn f64(&self, column: In) -> &[f64] {
        self.tables[column.slot.table as usize].columns[column.slot.column as usize]
    }

    /// Every row of an irregular table before this time has been given, Unix ns.
    #[must_use]
    pub fn complete_until_ns(&self) -> i64 {
        self.complete_until_ns
    }
}

/// The rows that a call gives.
#[derive(Debug, Default)]
pub struct Outputs {
    pub(crate) tables: Vec<OutputTable>,
}

#[derive(Debug, Default)]
pub(crate) struct OutputTable {
    pub(crate) name: String,
    pub(crate) time_ns: Vec<i64>,
    pub(crate) columns: Vec<Vec<f64>>,
}

impl Outputs {
    pub(crate) fn new(written: &[Written]) -> Self {
        let tables = written
            .iter()
            .map(|w| OutputTable {
                name: w.name.clone(),
                time_ns: Vec::new(),
                columns: vec![Vec::new(); w.columns.len()],
            })
            .collect();
        Self { tables }
    }

    /// Times of a table; push one per row.
    pub fn time(&mut self, table: Table) -> &mut Vec<i64> {
        &mut self.tables[table.index].time_ns
    }

    /// Values of a column; push one per row.
    pub fn f64(&mut self, column: Out) -> &mut Vec<f64> {
        &mut self.tables[column.table].columns[column.column]
    }

    pub(crate) fn check(&self) -> Result<(), PluginError> {
        for table in &self.tables {
            let rows = table.time_ns.len();
            if let Some((i, column)) = table.columns.iter().enumerate().find(|(_, c)| c.len() != rows) {
                return Err(PluginError::fatal(format!(
                    "table {}: column {i} has {} rows where the times have {rows}; push one value per time",
                    table.name,
                    column.len()
                )));
            }
        }
        Ok(())
    }
}

/// How far a source has come.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Progress {
    /// Every row before this time has been delivered, Unix ns.
    pub complete_until_ns: i64,
    /// There is nothing more.
    pub done: bool,
}

impl From<Progress> for abi::ProgressV1 {
    fn from(progress: Progress) -> Self {
        Self { complete_until_ns: progress.complete_until_ns, done: i32::from(progress.done) }
    }
}
