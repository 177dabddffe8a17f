//! Days, by their number since 1970-01-01.

use chrono::{DateTime, NaiveDate};

/// Length of a day, ns.
pub(crate) const DAY_NS: i64 = 86_400_000_000_000;

/// Number of a day.
pub(crate) fn day_number(day: NaiveDate) -> i64 {
    (day - NaiveDate::default()).num_days()
}

/// The day of a number.
pub(crate) fn day_of_number(number: i64) -> NaiveDate {
    DateTime::from_timestamp_nanos(start_of_day_ns(number)).date_naive()
}

/// First instant of a day, Unix ns.
pub(crate) fn start_of_day_ns(number: i64) -> i64 {
    number.saturating_mul(DAY_NS)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn days_are_counted_from_1970() {
        let day = NaiveDate::from_ymd_opt(2035, 1, 1).expect("a day");
        // 65 years of 365 days and 16 leap days.
        assert_eq!(day_number(day), 65 * 365 + 16);
        assert_eq!(day_of_number(day_number(day)), day);
        assert_eq!(day_number(NaiveDate::default()), 0);
    }
}
