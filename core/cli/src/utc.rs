//! Instants on the command line.

use chrono::{DateTime, NaiveDate, NaiveDateTime};

/// Unix ns of an RFC 3339 instant, of a date alone (its first instant) or of a date and time without a zone (UTC).
pub(crate) fn parse(text: &str) -> Result<i64, String> {
    let zoned = DateTime::parse_from_rfc3339(text).ok().map(|instant| instant.to_utc());
    let without_zone = text.strip_suffix('Z').unwrap_or(text);
    let to_the_minute = || NaiveDateTime::parse_from_str(without_zone, "%Y-%m-%dT%H:%M").ok();
    let plain = || text.parse::<NaiveDateTime>().ok().or_else(to_the_minute).map(|instant| instant.and_utc());
    let date = || text.parse::<NaiveDate>().ok().map(|day| day.and_time(chrono::NaiveTime::MIN).and_utc());
    let instant = zoned
        .or_else(plain)
        .or_else(date)
        .ok_or("a date or an instant is needed, as in 2035-01-01 or 2035-01-01T06:00:00Z")?;
    instant.timestamp_nanos_opt().ok_or_else(|| "only the years 1678 to 2261 can be counted in nanoseconds".to_owned())
}

/// `2035-01-01 06:00:00`, fractions where there are any.
pub(crate) fn format(time_ns: i64) -> String {
    DateTime::from_timestamp_nanos(time_ns).format("%Y-%m-%d %H:%M:%S%.f").to_string()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn instants_are_read() {
        // 2035-01-01 is 23741 days after 1970-01-01: 65 years of 365 days and 16 leap days.
        const DAY_NS: i64 = 86_400_000_000_000;
        const START_NS: i64 = (65 * 365 + 16) * DAY_NS;
        assert_eq!(parse("2035-01-01"), Ok(START_NS));
        assert_eq!(parse("2035-01-01T06:00:00Z"), Ok(START_NS + DAY_NS / 4));
        assert_eq!(parse("2035-01-01T06:00:00+02:00"), Ok(START_NS + DAY_NS / 6));
        assert_eq!(parse("2035-01-01T06:00Z"), Ok(START_NS + DAY_NS / 4));
        assert_eq!(parse("2035-01-01T06:00:00.5"), Ok(START_NS + DAY_NS / 4 + 500_000_000));
        for wrong in ["", "2035", "2035-13-01", "2035-02-29", "9999-01-01", "06:00"] {
            assert!(parse(wrong).is_err(), "{wrong}");
        }
        assert_eq!(format(START_NS + 100_000_000), "2035-01-01 00:00:00.100");
    }
}
