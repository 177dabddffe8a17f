//! Decoded rows of one channel in one piece of a file, and their merger into the rows of a table.

use super::losses::{Finding, Losses};
use crate::table::Batch;

/// Place of a block in the order of the files: file, offset of the piece, channel.
pub(super) type Rank = (usize, u64, u16);

/// Rows in order of time.
#[derive(Debug)]
pub(super) struct Block {
    pub(super) rank: Rank,
    times: Vec<i64>,
    /// One vector per column.
    columns: Vec<Vec<f64>>,
    /// First row not yet delivered.
    next: usize,
}

impl Block {
    /// A block of rows as they came; `values` holds the columns one after the other, each `capacity` long. Rows of
    /// equal time keep their order.
    pub(super) fn new(rank: Rank, times: Vec<i64>, values: &[f64], capacity: usize) -> Self {
        let rows = times.len();
        let columns = values.chunks_exact(capacity.max(1)).map(|c| &c[..rows]);
        if times.is_sorted() {
            return Self { rank, columns: columns.map(<[f64]>::to_vec).collect(), times, next: 0 };
        }
        let mut order: Vec<usize> = (0..rows).collect();
        order.sort_by_key(|&row| times[row]);
        Self {
            rank,
            times: order.iter().map(|&row| times[row]).collect(),
            columns: columns.map(|c| order.iter().map(|&row| c[row]).collect()).collect(),
            next: 0,
        }
    }

    /// Bytes that rows of so many columns take.
    pub(super) fn bytes_of(rows: usize, columns: usize) -> usize {
        rows.saturating_mul(columns + 1).saturating_mul(size_of::<f64>())
    }

    /// Bytes that its rows take.
    pub(super) fn bytes(&self) -> usize {
        Self::bytes_of(self.times.len(), self.columns.len())
    }

    /// Time of the first row not yet delivered, Unix ns.
    pub(super) fn head(&self) -> Option<i64> {
        self.times.get(self.next).copied()
    }
}

/// Takes every row before `until_ns` out of `blocks`, in order of time and, for equal times, of rank. Of rows with
/// one time the first stays; the others are duplicates when they say the same and conflicts when they do not. Gives the
/// rows, and the times of the conflicts.
pub(super) fn drain(
    blocks: &mut Vec<Block>,
    until_ns: i64,
    columns: usize,
    topic: &str,
    losses: &mut Losses,
) -> (Batch, Vec<i64>) {
    let mut batch = Batch::empty(columns);
    let (mut duplicates, mut conflicts) = (0, Vec::new());
    loop {
        let heads = || blocks.iter().enumerate().filter_map(|(i, b)| Some((b.head()?, b.rank, i)));
        let Some((head, _, first)) = heads().filter(|h| h.0 < until_ns).min() else { break };
        let limit = heads().filter(|h| h.2 != first).map(|h| h.0).min().unwrap_or(i64::MAX).min(until_ns);
        let block = &mut blocks[first];
        // The head may share its time with another block's; what follows must come before the other.
        let mut row = block.next;
        while row < block.times.len() && (block.times[row] < limit || block.times[row] == head && row == block.next) {
            if batch.time_ns.last() == Some(&block.times[row]) {
                let same = block
                    .columns
                    .iter()
                    .zip(&batch.columns)
                    .all(|(c, kept)| kept.last().is_some_and(|k| k.to_bits() == c[row].to_bits()));
                if same {
                    duplicates += 1;
                } else {
                    conflicts.push(block.times[row]);
                }
                row += 1;
                continue;
            }
            let start = row;
            row += 1;
            while row < block.times.len() && block.times[row] < limit && block.times[row] > block.times[row - 1] {
                row += 1;
            }
            batch.time_ns.extend_from_slice(&block.times[start..row]);
            for (out, column) in batch.columns.iter_mut().zip(&block.columns) {
                out.extend_from_slice(&column[start..row]);
            }
        }
        block.next = row;
    }
    blocks.retain(|b| b.head().is_some());
    losses.add(Finding::DuplicateMessages, duplicates, topic, || {
        format!("{topic}: messages that were there already were dropped")
    });
    losses.add(Finding::ConflictingMessages, conflicts.len() as u64, topic, || {
        format!("{topic}: messages of one time with different values; the first in the order of the files was kept")
    });
    (batch, conflicts)
}
