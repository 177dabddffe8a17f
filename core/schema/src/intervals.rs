//! Intervals of series that people look at: never more than so many, whatever the length of the data.

/// Length of the first intervals, ns: five doublings make a minute.
pub const FIRST_INTERVAL_NS: i64 = 1_875_000_000;
/// Intervals that are kept. When there would be more, each two neighbours become one.
pub const MOST_INTERVALS: usize = 2048;
