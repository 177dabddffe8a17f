//! Columns over time at a rate that plots well: mean and extremes over intervals, [`MOST_INTERVALS`] at most.

use dragfree_schema::{Column, FIRST_INTERVAL_NS, MOST_INTERVALS};

use crate::table::Batch;

/// Sums over intervals of some columns of a uniform table.
#[derive(Clone, Debug)]
pub(crate) struct Means {
    /// Indices of the columns in the table.
    columns: Vec<usize>,
    rate_hz: f64,
    interval_ns: i64,
    intervals: Vec<Interval>,
}

#[derive(Clone, Debug)]
struct Interval {
    /// It begins at this number times the length of an interval.
    number: i64,
    of: Vec<Sum>,
}

/// A column in an interval.
#[derive(Clone, Copy, Debug)]
struct Sum {
    count: u64,
    sum: f64,
    low: f64,
    high: f64,
}

impl Sum {
    const NONE: Self = Self { count: 0, sum: 0.0, low: f64::NAN, high: f64::NAN };

    fn add(&mut self, other: Self) {
        self.count += other.count;
        self.sum += other.sum;
        // The other one where there was none.
        (self.low, self.high) = (self.low.min(other.low), self.high.max(other.high));
    }
}

/// What becomes of a column: its mean over an interval, and its least and greatest value there.
pub(crate) fn columns_of(column: &Column) -> impl Iterator<Item = Column> {
    ["value", "low", "high"].into_iter().map(|what| {
        let Column { table, name, unit, frame, .. } = column.clone();
        Column { table, name: format!("{name}.{what}"), unit, frame, rate_hz: 0.0, attributes: Default::default() }
    })
}

impl Means {
    /// Of these columns of a table at `rate_hz`.
    pub(crate) fn new(columns: Vec<usize>, rate_hz: f64) -> Self {
        Self { columns, rate_hz, interval_ns: FIRST_INTERVAL_NS, intervals: Vec::new() }
    }

    /// Adds the rows of the table at and after `from_ns`; a value that is not finite is none.
    pub(crate) fn push(&mut self, batch: &Batch, from_ns: i64) {
        let mut row = batch.time_ns.partition_point(|t| *t < from_ns);
        while row < batch.rows() {
            let number = batch.time_ns[row].div_euclid(self.interval_ns);
            if self.intervals.last().is_none_or(|last| last.number != number) {
                if self.intervals.len() == MOST_INTERVALS {
                    self.double();
                    continue;
                }
                self.intervals.push(Interval { number, of: vec![Sum::NONE; self.columns.len()] });
            }
            let end = row + batch.time_ns[row..].partition_point(|t| t.div_euclid(self.interval_ns) == number);
            let Some(interval) = self.intervals.last_mut() else { return };
            for (sum, column) in interval.of.iter_mut().zip(&self.columns) {
                for x in batch.columns[*column][row..end].iter().filter(|x| x.is_finite()) {
                    sum.add(Sum { count: 1, sum: *x, low: *x, high: *x });
                }
            }
            row = end;
        }
    }

    /// Makes one interval of each two neighbours.
    fn double(&mut self) {
        self.interval_ns *= 2;
        for mut next in std::mem::take(&mut self.intervals) {
            next.number = next.number.div_euclid(2);
            match self.intervals.last_mut().filter(|last| last.number == next.number) {
                Some(last) => last.of.iter_mut().zip(next.of).for_each(|(to, own)| to.add(own)),
                None => self.intervals.push(next),
            }
        }
    }

    /// A row at the centre of every interval; NaN in the columns of which more than half is missing there.
    pub(crate) fn rows(&self) -> Batch {
        let whole = self.interval_ns as f64 * 1e-9 * self.rate_hz;
        let mut batch = Batch::empty(3 * self.columns.len());
        for interval in &self.intervals {
            batch.time_ns.push(interval.number * self.interval_ns + self.interval_ns / 2);
            for (own, to) in interval.of.iter().zip(batch.columns.chunks_mut(3)) {
                let enough = 2.0 * own.count as f64 >= whole.floor().max(1.0);
                let values = [own.sum / own.count as f64, own.low, own.high];
                to.iter_mut().zip(values).for_each(|(to, value)| to.push(if enough { value } else { f64::NAN }));
            }
        }
        batch
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const STEP_NS: i64 = 100_000_000;

    fn table(rows: usize) -> Batch {
        let value = |row: usize| ((row * 7919) % 1000) as f64 - 300.0;
        let column: Vec<f64> = (0..rows).map(|row| if row % 50 == 3 { f64::NAN } else { value(row) }).collect();
        let time_ns = (0..rows as i64).map(|row| 13 * STEP_NS + row * STEP_NS).collect();
        Batch { time_ns, columns: vec![vec![0.0; rows], column] }
    }

    fn means(batch: &Batch, rows_at_once: usize, from_ns: i64) -> Batch {
        let mut means = Means::new(vec![1], 10.0);
        for from in (0..batch.rows()).step_by(rows_at_once) {
            let own = from..batch.rows().min(from + rows_at_once);
            let columns = batch.columns.iter().map(|c| c[own.clone()].to_vec()).collect();
            means.push(&Batch { time_ns: batch.time_ns[own.clone()].to_vec(), columns }, from_ns);
        }
        means.rows()
    }

    /// In data so long that intervals were doubled three times, against the values one by one.
    #[test]
    fn means_and_extremes_are_those_of_the_values() {
        let batch = table(300_000);
        let from_ns = batch.time_ns[1000];
        let all = means(&batch, 4096, from_ns);
        assert!((MOST_INTERVALS / 2 - 1..=MOST_INTERVALS).contains(&all.rows()), "{}", all.rows());
        let interval_ns = all.time_ns[1] - all.time_ns[0];
        assert_eq!(interval_ns, 8 * FIRST_INTERVAL_NS);
        for (k, centre) in all.time_ns.iter().enumerate() {
            let within = |t: i64| t >= from_ns && (t - centre + interval_ns / 2).div_euclid(interval_ns) == 0;
            let rows = batch.time_ns.iter().zip(&batch.columns[1]).filter(|(t, x)| within(**t) && x.is_finite());
            let own: Vec<f64> = rows.map(|(_, x)| *x).collect();
            let [mean, low, high] = [0, 1, 2].map(|c| all.columns[c][k]);
            if 2 * own.len() < 150 {
                assert!(mean.is_nan() && low.is_nan() && high.is_nan());
                continue;
            }
            assert!((mean - own.iter().sum::<f64>() / own.len() as f64).abs() < 1e-9, "{mean}");
            assert_eq!(low, own.iter().copied().fold(f64::INFINITY, f64::min));
            assert_eq!(high, own.iter().copied().fold(f64::NEG_INFINITY, f64::max));
        }
        let bits = |b: &Batch| b.columns.iter().flatten().map(|x| x.to_bits()).collect::<Vec<_>>();
        for rows_at_once in [1, 777, 300_000] {
            let other = means(&batch, rows_at_once, from_ns);
            assert_eq!((&other.time_ns, bits(&other)), (&all.time_ns, bits(&all)), "{rows_at_once}");
        }
    }
}
