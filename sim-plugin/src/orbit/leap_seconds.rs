//! UTC to TDB by NAIF's leap-second kernel (its equations \[1\] to \[6\]), as CSPICE's `str2et` does it.

use chrono::NaiveDate;

/// 2000-01-01T12:00:00, Unix s.
pub(super) const J2000_UNIX_S: i64 = 946_728_000;

/// Why a leap-second kernel was refused.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("leap-second kernel: {key} is missing or no list of numbers and @dates in order; fetch the kernel again")]
pub struct LeapSecondError {
    /// The assignment that could not be read.
    pub key: &'static str,
}

/// `TDB − UTC`. After the kernel's last entry, 37 s from 2017-01-01 on, no leap second is assumed; before its first,
/// 1972-01-01, the first holds.
#[derive(Clone, Debug)]
pub struct LeapSeconds {
    /// `DELTA_T_A`, TT − TAI, s.
    delta_t_a_s: f64,
    /// `K`, s.
    k_s: f64,
    /// `EB`.
    eb: f64,
    /// `M0`, rad, and `M1`, rad/s.
    m: [f64; 2],
    /// From when, Unix s, and `TAI − UTC`, s.
    delta_at: Vec<(i64, f64)>,
}

impl LeapSeconds {
    /// Reads the kernel's text.
    ///
    /// # Errors
    /// [`LeapSecondError`] names the invalid assignment.
    pub fn new(text: &str) -> Result<Self, LeapSecondError> {
        let numbers = |key: &'static str, count: usize| -> Result<Vec<f64>, LeapSecondError> {
            let words = assignment(text, key).ok_or(LeapSecondError { key })?;
            let numbers: Option<Vec<f64>> = words.iter().map(|w| real(w)).collect();
            numbers.filter(|n| n.len() == count).ok_or(LeapSecondError { key })
        };
        let key = "DELTET/DELTA_AT";
        let entries = assignment(text, key).and_then(|words| {
            let (pairs, rest) = words.as_chunks::<2>();
            let entries: Option<Vec<_>> = pairs.iter().map(|[s, date]| Some((unix_s(date)?, real(s)?))).collect();
            entries.filter(|e| rest.is_empty() && !e.is_empty() && e.is_sorted_by_key(|e| e.0))
        });
        let m = numbers("DELTET/M", 2)?;
        Ok(Self {
            delta_t_a_s: numbers("DELTET/DELTA_T_A", 1)?[0],
            k_s: numbers("DELTET/K", 1)?[0],
            eb: numbers("DELTET/EB", 1)?[0],
            m: [m[0], m[1]],
            delta_at: entries.ok_or(LeapSecondError { key })?,
        })
    }

    /// `TDB − UTC` at a time, s.
    pub fn tdb_minus_utc_s(&self, unix_ns: i64) -> f64 {
        let unix_s = unix_ns.div_euclid(1_000_000_000);
        let entry = self.delta_at.partition_point(|(from, _)| *from <= unix_s).saturating_sub(1);
        let tt_minus_utc_s = self.delta_at[entry].1 + self.delta_t_a_s;
        // TT in place of TDB: the difference of 2 ms times M1 is below the resolution of E.
        let mean_anomaly = self.m[0] + self.m[1] * (since_j2000_s(unix_ns) + tt_minus_utc_s);
        let eccentric_anomaly = mean_anomaly + self.eb * mean_anomaly.sin();
        tt_minus_utc_s + self.k_s * eccentric_anomaly.sin()
    }

    /// TDB seconds past J2000, with the resolution of a double.
    pub fn et_s(&self, unix_ns: i64) -> f64 {
        since_j2000_s(unix_ns) + self.tdb_minus_utc_s(unix_ns)
    }
}

/// UTC seconds past J2000, leap seconds not counted.
fn since_j2000_s(unix_ns: i64) -> f64 {
    // Whole seconds separately: 1e18 ns exceed the integers of a double.
    let (whole_s, rest_ns) = (unix_ns.div_euclid(1_000_000_000), unix_ns.rem_euclid(1_000_000_000));
    (whole_s - J2000_UNIX_S) as f64 + rest_ns as f64 * 1e-9
}

/// The words that are assigned to a key, in the parts of the kernel that are data.
fn assignment<'a>(text: &'a str, key: &str) -> Option<Vec<&'a str>> {
    let data = text.split("\\begindata").skip(1).map(|part| part.split("\\begintext").next().unwrap_or(part));
    let value = data.flat_map(|part| part.split("DELTET/")).find_map(|assignment| {
        let (name, value) = assignment.split_once('=')?;
        (format!("DELTET/{}", name.trim()) == key).then_some(value)
    })?;
    Some(value.split([' ', '\t', '\r', '\n', ',', '(', ')']).filter(|w| !w.is_empty()).collect())
}

/// A number with Fortran's exponent.
fn real(word: &str) -> Option<f64> {
    word.replace(['D', 'd'], "e").parse().ok().filter(|x: &f64| x.is_finite())
}

/// `@1972-JAN-1`.
fn unix_s(word: &str) -> Option<i64> {
    let date = NaiveDate::parse_from_str(word.strip_prefix('@')?, "%Y-%b-%d").ok()?;
    Some(date.and_time(chrono::NaiveTime::MIN).and_utc().timestamp())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::orbit::ephemeris::LEAP_SECONDS;

    #[test]
    fn the_kernel_is_read_whole() {
        let leap = LeapSeconds::new(LEAP_SECONDS).unwrap();
        assert_eq!(leap.delta_at.len(), 28);
        assert_eq!(leap.delta_at[0], (63_072_000, 10.0));
        assert_eq!(leap.delta_at[27], (1_483_228_800, 37.0));
        assert_eq!((leap.delta_t_a_s, leap.k_s, leap.eb), (32.184, 1.657e-3, 1.671e-2));
        assert_eq!(leap.m, [6.239_996, 1.990_968_71e-7]);
    }

    #[test]
    fn a_leap_second_counts_from_its_day_on() {
        let leap = LeapSeconds::new(LEAP_SECONDS).unwrap();
        let at = |unix_s: i64| leap.tdb_minus_utc_s(unix_s * 1_000_000_000);
        assert!((at(1_483_228_800) - at(1_483_228_799) - 1.0).abs() < 1e-9);
        assert!((at(0) - 42.184).abs() < 1.7e-3, "1972's offset before 1972");
    }

    #[test]
    fn a_damaged_kernel_names_what_is_missing() {
        let without = |from: &str, to: &str| LeapSeconds::new(&LEAP_SECONDS.replace(from, to)).unwrap_err().key;
        assert_eq!(without("DELTET/EB ", "DELTET/EC "), "DELTET/EB");
        assert_eq!(without("1.657D-3", "1.657Q-3"), "DELTET/K");
        assert_eq!(without("@2017-JAN-1", "@2017-JAM-1"), "DELTET/DELTA_AT");
        assert_eq!(without("@2017-JAN-1", "@1971-JAN-1"), "DELTET/DELTA_AT");
        assert_eq!(without("\\begindata", ""), "DELTET/M");
        assert!(LeapSeconds::new("").is_err());
    }
}
