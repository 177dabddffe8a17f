//! Position of the Earth, from the excerpt of DE440 in `fixtures/ephemeris`.

use chrono::DateTime;
use nalgebra::Vector3;

use super::OrbitError;
use super::leap_seconds::{J2000_UNIX_S, LeapSeconds};
use super::spk::Spk;

/// The excerpt of DE440.
pub(super) const DE440: &[u8] = include_bytes!("../../../fixtures/ephemeris/de440-excerpt.bsp");
/// The leap-second kernel.
pub(super) const LEAP_SECONDS: &str = include_str!("../../../fixtures/ephemeris/latest_leapseconds.tls");

/// NAIF's numbers.
const BARYCENTRE: i32 = 0;
const EARTH_MOON: i32 = 3;
const SUN: i32 = 10;
const EARTH: i32 = 399;

/// Planetary ephemeris and time scales.
#[derive(Clone, Debug)]
pub struct Ephemeris {
    spk: Spk<'static>,
    leap_seconds: LeapSeconds,
    /// First and last time, TDB seconds past J2000.
    span_s: (f64, f64),
}

impl Ephemeris {
    /// DE440 and the leap seconds that this library carries.
    ///
    /// # Errors
    /// [`OrbitError::Spk`] and [`OrbitError::LeapSeconds`] when the library was built from damaged files.
    pub fn embedded() -> Result<Self, OrbitError> {
        let spk = Spk::new(DE440)?;
        let span_s = spk.span_s(&[(SUN, BARYCENTRE), (EARTH_MOON, BARYCENTRE), (EARTH, EARTH_MOON)])?;
        Ok(Self { spk, leap_seconds: LeapSeconds::new(LEAP_SECONDS)?, span_s })
    }

    /// First and last time, TDB seconds past J2000.
    pub fn span_s(&self) -> (f64, f64) {
        self.span_s
    }

    /// UTC to TDB.
    pub fn leap_seconds(&self) -> &LeapSeconds {
        &self.leap_seconds
    }

    /// Refuses a time outside the span; `what` names it.
    ///
    /// # Errors
    /// [`OrbitError::Span`].
    pub fn check(&self, what: &'static str, unix_ns: i64) -> Result<(), OrbitError> {
        let (first_s, last_s) = self.span_s;
        if (first_s..=last_s).contains(&self.leap_seconds.et_s(unix_ns)) {
            return Ok(());
        }
        let tdb = |et_s: f64| utc(et_s as i64 + J2000_UNIX_S);
        let when = utc(unix_ns.div_euclid(1_000_000_000));
        Err(OrbitError::Span { what, when, first: tdb(first_s), last: tdb(last_s) })
    }

    /// The Earth relative to the Sun, ICRF axes, m, at TDB seconds past J2000.
    ///
    /// # Errors
    /// [`OrbitError::Spk`] outside the span.
    pub fn earth_irf_m(&self, et_s: f64) -> Result<Vector3<f64>, OrbitError> {
        let barycentre = self.spk.position_m(EARTH_MOON, BARYCENTRE, et_s)?;
        let earth = self.spk.position_m(EARTH, EARTH_MOON, et_s)?;
        let sun = self.spk.position_m(SUN, BARYCENTRE, et_s)?;
        Ok(barycentre + earth - sun)
    }
}

/// `2034-06-01T00:00:00`
fn utc(unix_s: i64) -> String {
    DateTime::from_timestamp(unix_s, 0).map_or_else(String::new, |t| t.format("%Y-%m-%dT%H:%M:%S").to_string())
}
