//! A plugin instance under test: fed with generated rows, its output collected.

use std::ops::Range;

use super::Finding;
use super::stand::{START_NS, Signal};
use crate::border::{Instance, Kind, Linked, Rows};
use crate::table::{Batch, Column};

/// A slow irregular table has a row every so many epochs.
const SLOW: usize = 100;

/// An input table: how often it has rows, and what they hold.
struct Input {
    every: usize,
    signals: Vec<Signal>,
}

/// A linked and active instance.
pub(super) struct Session {
    node: Instance,
    kind: Kind,
    inputs: Vec<Input>,
    step_ns: i64,
    /// Epochs in which every input is NaN.
    gap: Option<Range<usize>>,
    /// Epochs given, or taken from a source.
    at: usize,
    done: bool,
    /// Times given since the rows were forgotten last.
    times_ns: Vec<i64>,
    batches: Vec<Batch>,
}

impl Session {
    pub(super) fn new(
        node: Instance,
        kind: Kind,
        available: &[Column],
        linked: &Linked,
        step_ns: i64,
        gap: Option<Range<usize>>,
    ) -> Self {
        let inputs = linked.reads.iter().map(|columns| {
            let columns: Vec<&Column> = columns.iter().map(|c| &available[c.available]).collect();
            let slow = columns.iter().any(|c| c.table.starts_with("hk/") || c.table == "ephemeris");
            Input { every: if slow { SLOW } else { 1 }, signals: columns.into_iter().map(Signal::of).collect() }
        });
        let batches = linked.writes.iter().map(|t| Batch::empty(t.columns.len())).collect();
        let inputs = inputs.collect();
        Self { node, kind, inputs, step_ns, gap, at: 0, done: false, times_ns: Vec::new(), batches }
    }

    /// A fresh session that goes on where this one stands.
    pub(super) fn heir(&self, fresh: Self) -> Self {
        Self { at: self.at, done: self.done, ..fresh }
    }

    pub(super) fn forget_rows(&mut self) {
        self.times_ns.clear();
        self.batches.iter_mut().for_each(|batch| *batch = Batch::empty(batch.columns.len()));
    }

    fn time_ns(&self, epoch: usize) -> i64 {
        START_NS + epoch as i64 * self.step_ns
    }

    /// Goes on to an epoch, `size` at a time.
    pub(super) fn advance(&mut self, until: usize, size: usize) -> Result<(), Finding> {
        while self.at < until && !self.done {
            let batches = if self.kind == Kind::Source {
                let step = self.node.next(u32::try_from(size).unwrap_or(u32::MAX))?;
                // A source may be done with nothing, or be complete from the start: its clock counts.
                self.at = usize::try_from(step.complete_until_ns.saturating_sub(START_NS) / self.step_ns).unwrap_or(0);
                self.done = step.done;
                Some(step.batches)
            } else {
                let end = (self.at + size).min(until);
                let batches = self.process(self.at..end)?;
                self.at = end;
                batches
            };
            self.take(batches.unwrap_or_default());
        }
        Ok(())
    }

    fn process(&mut self, epochs: Range<usize>) -> Result<Option<Vec<Batch>>, Finding> {
        let times: Vec<i64> = epochs.clone().map(|epoch| self.time_ns(epoch)).collect();
        let tables: Vec<Table> = self
            .inputs
            .iter()
            .map(|input| {
                let rows: Vec<usize> = epochs.clone().filter(|epoch| epoch.is_multiple_of(input.every)).collect();
                let value = |signal: &Signal, epoch: usize| match &self.gap {
                    Some(gap) if gap.contains(&epoch) => f64::NAN,
                    _ => signal.at(self.time_ns(epoch)),
                };
                let columns = input.signals.iter().map(|s| rows.iter().map(|epoch| value(s, *epoch)).collect());
                (rows.iter().map(|epoch| self.time_ns(*epoch)).collect(), columns.collect())
            })
            .collect();
        let rows: Vec<Rows<'_>> = tables
            .iter()
            .map(|(time_ns, columns)| Rows { time_ns, columns: columns.iter().map(Vec::as_slice).collect() })
            .collect();
        let before = tables.clone();
        let made = self.node.process(&rows, self.time_ns(epochs.end))?;
        drop(rows);
        if !same_rows(&tables, &before) {
            let what = "writes into the rows that it is given, which other plugins read too".to_owned();
            return Err(Finding::Broken { instance: self.node.name.clone(), what });
        }
        self.times_ns.extend(times);
        Ok(made)
    }

    fn take(&mut self, batches: Vec<Batch>) {
        for (all, batch) in self.batches.iter_mut().zip(batches) {
            all.time_ns.extend(batch.time_ns);
            for (all, column) in all.columns.iter_mut().zip(batch.columns) {
                all.extend(column);
            }
        }
    }

    /// Flushes it and asks for its report.
    pub(super) fn finish(mut self) -> Result<Given, Finding> {
        if self.kind != Kind::Source {
            let rest = self.node.flush()?;
            self.take(rest);
        }
        let report = serde_json::to_string(&self.node.report("[]")?).unwrap_or_default();
        let broken = self.node.broken_in_report().to_vec();
        Ok(Given { batches: self.batches, times_ns: self.times_ns, report, broken })
    }

    pub(super) fn save(&mut self) -> Result<Vec<u8>, Finding> {
        Ok(self.node.save()?)
    }

    pub(super) fn load(&mut self, state: &[u8]) -> Result<(), Finding> {
        Ok(self.node.load(state)?)
    }
}

/// What an instance gave.
#[derive(Clone)]
pub(super) struct Given {
    /// Rows since they were forgotten last.
    pub(super) batches: Vec<Batch>,
    /// Times that it was given since.
    pub(super) times_ns: Vec<i64>,
    /// Its report, as text: NaN is not equal to itself.
    pub(super) report: String,
    /// Where it broke its schema.
    pub(super) broken: Vec<String>,
}

/// Times and columns of one input table.
type Table = (Vec<i64>, Vec<Vec<f64>>);

/// Whether rows are the same bit by bit.
fn same_rows(a: &[Table], b: &[Table]) -> bool {
    let bits = |(_, columns): &Table| columns.iter().flatten().map(|v| v.to_bits()).collect::<Vec<_>>();
    a.iter().zip(b).all(|(a, b)| a.0 == b.0 && bits(a) == bits(b))
}

/// Where two results differ; every NaN is no value, and so alike.
pub(super) fn difference(a: &[Batch], b: &[Batch]) -> Option<String> {
    for (table, (a, b)) in a.iter().zip(b).enumerate() {
        if a.time_ns != b.time_ns {
            return Some(format!("table {table} has {} rows in place of {}, or other times", b.rows(), a.rows()));
        }
        for (column, (a, b)) in a.columns.iter().zip(&b.columns).enumerate() {
            let differs = |(x, y): (&f64, &f64)| x.to_bits() != y.to_bits() && !(x.is_nan() && y.is_nan());
            if let Some(row) = a.iter().zip(b).position(differs) {
                let (x, y) = (a[row], b[row]);
                return Some(format!("column {column} of table {table} is {y:e} in place of {x:e} in row {row}"));
            }
        }
    }
    None
}
