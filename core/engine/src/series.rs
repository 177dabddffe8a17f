//! The time series beside a product: tables that stages want archived, as they come, at the end, or as means.

use dragfree_archive::ProductWriter;

use crate::EngineError;
use crate::chain::{Archived, Chain, Sink};
use crate::means::Means;
use crate::table::{Batch, Chunk, TableSpec};
use crate::telemetry::{FileHeader, TelemetryWriter};

/// The file, written only when a stage has any rows for it.
pub(crate) struct Series {
    tables: Vec<Table>,
    writer: Option<TelemetryWriter>,
    /// Rows before this time are of data that only settle the stages.
    from_ns: i64,
}

/// A topic of the file.
struct Table {
    spec: TableSpec,
    rows: Rows,
}

/// Rows on their way into the file.
enum Rows {
    /// They are written as they come.
    Coming { last_ns: Option<i64> },
    /// They come at the end, after those of all others: these need not wait for them.
    AtTheEnd(Vec<Batch>),
    /// They are made of those that come.
    Means(Means),
}

impl Series {
    /// A file among the staged ones of a product.
    ///
    /// # Errors
    /// It cannot be created.
    pub(crate) fn create(
        chain: &Chain,
        product: &mut ProductWriter,
        header: &FileHeader,
        from_ns: i64,
    ) -> Result<Self, EngineError> {
        let table = |(spec, archived)| {
            let rows = match archived {
                Archived::Whole => Rows::Coming { last_ns: None },
                Archived::AtTheEnd => Rows::AtTheEnd(Vec::new()),
                Archived::Means { columns, rate_hz } => Rows::Means(Means::new(columns, rate_hz)),
            };
            Table { spec, rows }
        };
        let tables: Vec<Table> = chain.archived_tables().into_iter().map(table).collect();
        let specs: Vec<TableSpec> = tables.iter().map(|t| t.spec.clone()).collect();
        let create = || TelemetryWriter::create(&product.staged("mcap"), &specs, header);
        let writer = (!tables.is_empty()).then(create).transpose()?;
        Ok(Self { tables, writer, from_ns })
    }

    /// Writes what has waited for the end.
    ///
    /// # Errors
    /// The file cannot be written.
    pub(crate) fn finish(self) -> Result<(), EngineError> {
        let nothing = self.nothing();
        let Some(mut writer) = self.writer else { return Ok(()) };
        writer.write(Chunk { batches: nothing, complete_until_ns: i64::MAX })?;
        for (index, table) in self.tables.into_iter().enumerate() {
            let batches = match table.rows {
                Rows::Coming { .. } => Vec::new(),
                Rows::AtTheEnd(batches) => batches,
                Rows::Means(means) => vec![means.rows()],
            };
            batches.into_iter().try_for_each(|batch| writer.write_table(index, batch))?;
        }
        writer.finish()?;
        Ok(())
    }

    /// A batch without rows for every table.
    fn nothing(&self) -> Vec<Batch> {
        self.tables.iter().map(|t| Batch::empty(t.spec.columns.len())).collect()
    }

    /// The rows that belong to the product.
    fn settled(&self, batch: &Batch) -> Batch {
        let early = batch.time_ns.partition_point(|t| *t < self.from_ns);
        let columns = batch.columns.iter().map(|column| column[early..].to_vec()).collect();
        Batch { time_ns: batch.time_ns[early..].to_vec(), columns }
    }
}

impl Sink for Series {
    fn rows(&mut self, table: &TableSpec, batch: &Batch) -> Result<(), String> {
        if self.writer.is_none() || batch.time_ns.last().is_none_or(|last| *last < self.from_ns) {
            return Ok(());
        }
        let index = self.tables.iter().position(|t| t.spec.name == table.name);
        let index = index.ok_or_else(|| format!("table {} is none of those that are archived", table.name))?;
        if let Rows::Means(means) = &mut self.tables[index].rows {
            means.push(batch, self.from_ns);
            return Ok(());
        }
        let settled = self.settled(batch);
        match &mut self.tables[index].rows {
            Rows::AtTheEnd(batches) => {
                batches.push(settled);
                return Ok(());
            }
            Rows::Coming { last_ns } => *last_ns = settled.time_ns.last().copied(),
            Rows::Means(_) => {}
        }
        // A table without any row so far may still deliver earlier ones.
        let last = |t: &Table| match t.rows {
            Rows::Coming { last_ns } => Some(last_ns.unwrap_or(i64::MIN)),
            Rows::AtTheEnd(_) | Rows::Means(_) => None,
        };
        let complete_until_ns = self.tables.iter().filter_map(last).min().unwrap_or(i64::MIN);
        let mut batches = self.nothing();
        batches[index] = settled;
        let chunk = Chunk { batches, complete_until_ns };
        self.writer.as_mut().map_or(Ok(()), |writer| writer.write(chunk).map_err(|e| e.to_string()))
    }
}
