//! Rows that wait for a reader.
//!
//! A batch is shared by all of its readers. A call takes rows of one batch as they are; only where it takes rows of
//! several are its columns copied into one.

use std::collections::VecDeque;
use std::ops::Range;
use std::sync::Arc;

use crate::border::Rows;
use crate::table::Batch;

/// The columns of one table that one node reads, from the first row that it has not seen.
#[derive(Clone, Debug)]
pub(super) struct Queue {
    pub(super) table: String,
    pub(super) uniform: bool,
    /// Number of columns.
    width: usize,
    /// Rows before this time are not for the reader, Unix ns.
    from_ns: i64,
    pieces: VecDeque<Piece>,
}

/// Rows of a batch that no call has taken yet.
#[derive(Clone, Debug)]
struct Piece {
    batch: Arc<Batch>,
    /// Columns of the batch, in the reader's order.
    columns: Arc<[usize]>,
    rows: Range<usize>,
}

impl Queue {
    pub(super) fn new(table: String, uniform: bool, columns: usize) -> Self {
        Self { table, uniform, width: columns, from_ns: i64::MIN, pieces: VecDeque::new() }
    }

    /// Leaves out rows before a time.
    pub(super) fn begin_at(&mut self, from_ns: i64) {
        self.from_ns = from_ns;
    }

    pub(super) fn rows(&self) -> usize {
        self.pieces.iter().map(|p| p.rows.len()).sum()
    }

    pub(super) fn push(&mut self, batch: &Arc<Batch>, columns: &Arc<[usize]>) {
        let early = batch.time_ns.partition_point(|t| *t < self.from_ns);
        if early < batch.rows() {
            let (batch, columns) = (Arc::clone(batch), Arc::clone(columns));
            self.pieces.push_back(Piece { rows: early..batch.rows(), batch, columns });
        }
    }

    /// Puts the first `rows` rows into one batch, unless they are in one.
    pub(super) fn gather(&mut self, rows: usize) {
        if self.pieces.front().is_none_or(|first| first.rows.len() >= rows) {
            return;
        }
        let mut batch = Batch { time_ns: Vec::with_capacity(rows), columns: Vec::new() };
        batch.columns.resize_with(self.width, || Vec::with_capacity(rows));
        while batch.rows() < rows {
            let Some(mut piece) = self.pieces.pop_front() else { break };
            let taken = piece.rows.start..piece.rows.end.min(piece.rows.start + rows - batch.rows());
            batch.time_ns.extend_from_slice(&piece.batch.time_ns[taken.clone()]);
            for (to, from) in batch.columns.iter_mut().zip(piece.columns.iter()) {
                to.extend_from_slice(&piece.batch.columns[*from][taken.clone()]);
            }
            piece.rows.start = taken.end;
            if !piece.rows.is_empty() {
                self.pieces.push_front(piece);
            }
        }
        self.put_first(batch);
    }

    /// The first `rows` rows, which have been gathered.
    pub(super) fn front(&self, rows: usize) -> Rows<'_> {
        let Some(first) = self.pieces.front() else {
            return Rows { time_ns: &[], columns: vec![&[]; self.width] };
        };
        let range = first.rows.start..first.rows.start + rows;
        Rows {
            time_ns: &first.batch.time_ns[range.clone()],
            columns: first.columns.iter().map(|c| &first.batch.columns[*c][range.clone()]).collect(),
        }
    }

    /// Times of the first `rows` rows, which have been gathered.
    pub(super) fn times(&self, rows: usize) -> &[i64] {
        self.pieces.front().map_or(&[], |first| &first.batch.time_ns[first.rows.start..first.rows.start + rows])
    }

    /// Forgets the first `rows` rows.
    pub(super) fn consume(&mut self, mut rows: usize) {
        while let Some(first) = self.pieces.front_mut().filter(|_| rows > 0) {
            let taken = rows.min(first.rows.len());
            first.rows.start += taken;
            rows -= taken;
            if first.rows.is_empty() {
                self.pieces.pop_front();
            }
        }
    }

    pub(super) fn columns(&self) -> usize {
        self.width
    }

    /// Puts back rows that were saved.
    pub(super) fn replace(&mut self, time_ns: Vec<i64>, columns: Vec<Vec<f64>>) {
        self.pieces.clear();
        self.put_first(Batch { time_ns, columns });
    }

    fn put_first(&mut self, batch: Batch) {
        let rows = 0..batch.rows();
        if !rows.is_empty() {
            self.pieces.push_front(Piece { batch: Arc::new(batch), columns: (0..self.width).collect(), rows });
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// Batches of a table with three columns, whose values tell row and column.
    fn batches(lengths: &[usize]) -> Vec<Arc<Batch>> {
        let mut from = 0;
        let batch = |length: &usize| {
            let rows = from..from + *length as i64;
            from = rows.end;
            let column = |c: i64| rows.clone().map(|t| (10 * t + c) as f64).collect();
            Arc::new(Batch { time_ns: rows.clone().collect(), columns: (0..3).map(column).collect() })
        };
        lengths.iter().map(batch).collect()
    }

    proptest! {
        /// However rows come in and are taken out: every row once and in order, in the columns that were asked for.
        #[test]
        fn rows_come_out_as_they_went_in(
            lengths in prop::collection::vec(0_usize..9, 1..12),
            calls in prop::collection::vec(1_usize..13, 1..40),
            from_ns in -2_i64..9,
        ) {
            let columns: Arc<[usize]> = Arc::from([2, 0]);
            let mut queue = Queue::new("t".to_owned(), true, 2);
            queue.begin_at(from_ns);
            let mut waiting = batches(&lengths).into_iter();
            let (mut times, mut values) = (Vec::new(), Vec::new());
            for wanted in calls {
                if let Some(batch) = waiting.next() {
                    queue.push(&batch, &columns);
                }
                let rows = wanted.min(queue.rows());
                queue.gather(rows);
                prop_assert_eq!(queue.times(rows), queue.front(rows).time_ns);
                times.extend_from_slice(queue.front(rows).time_ns);
                let front = queue.front(rows);
                values.extend((0..rows).flat_map(|k| [front.columns[0][k], front.columns[1][k]]));
                queue.consume(rows);
            }
            let first = from_ns.max(0);
            let expected: Vec<i64> = (first..first + times.len() as i64).collect();
            prop_assert_eq!(&times, &expected);
            let both = times.iter().flat_map(|t| [(10 * t + 2) as f64, (10 * t) as f64]);
            prop_assert_eq!(values, both.collect::<Vec<f64>>());
        }
    }

    #[test]
    fn a_call_within_one_batch_copies_nothing() {
        let batch = &batches(&[8])[0];
        let mut queue = Queue::new("t".to_owned(), true, 1);
        queue.push(batch, &Arc::from([1]));
        queue.consume(3);
        queue.gather(5);
        assert!(std::ptr::eq(&raw const queue.front(5).columns[0][0], &raw const batch.columns[1][3]));
    }
}
