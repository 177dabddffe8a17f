//! Position and rotation of the constellation, for CRF, the gravity gradient and the Sun's direction.
//!
//! Absolute positions are used here only: at one astronomical unit a double resolves 3e-5 m, which is 1e-14 of an arm
//! and negligible in the frame's axes and rates.

mod crf;
mod elements;
pub mod ephemeris;
pub mod leap_seconds;
mod motion;
pub mod spk;

use dragfree_physics::mission::{Mission, MissionError};
use nalgebra::{Matrix3, Vector3};

use crf::{Crf, Moving};
use ephemeris::Ephemeris;
use leap_seconds::LeapSecondError;
use motion::{MU_EARTH_M3_S2, MU_SUN_M3_S2, Motion, gravity_irf_m_s2};
use spk::SpkError;

pub use motion::State;

/// Why an orbit is not available.
#[expect(missing_docs, reason = "the messages name the fields")]
#[derive(Debug, thiserror::Error)]
pub enum OrbitError {
    /// The mission's `[orbit]`.
    #[error(transparent)]
    Mission(#[from] MissionError),
    /// The planetary ephemeris.
    #[error(transparent)]
    Spk(#[from] SpkError),
    /// The leap seconds.
    #[error(transparent)]
    LeapSeconds(#[from] LeapSecondError),
    /// A time outside the planetary ephemeris.
    #[error(
        "missing ephemeris span: {what} {when} UTC lies outside the ephemeris, DE440 from {first} to {last} TDB; \
         choose a time within it"
    )]
    Span { what: &'static str, when: String, first: String, last: String },
}

/// The surroundings of one spacecraft at one instant.
#[derive(Clone, Debug)]
pub struct Environment {
    /// Spacecraft relative to the Sun, IRF, m.
    pub r_sc_irf_m: Vector3<f64>,
    /// Its velocity, IRF, m/s.
    pub v_sc_irf_m_s: Vector3<f64>,
    /// `ω_CI`, CRF relative to IRF, in CRF, rad/s.
    pub omega_crf_rad_s: Vector3<f64>,
    /// `ω̇_CI`, in CRF, rad/s².
    pub alpha_crf_rad_s2: Vector3<f64>,
    /// Unit vector from the Sun to the spacecraft, CRF.
    pub sun_crf: Vector3<f64>,
    /// Gradient `Γ` of the gravity of Sun and Earth, CRF, s⁻².
    pub gradient_crf_s2: Matrix3<f64>,
    /// Angle between the two arms, rad; the optical benches stand at 60°.
    pub opening_angle_rad: f64,
    /// Its rate, rad/s.
    pub opening_rate_rad_s: f64,
}

/// Orbits of three spacecraft, seen from one of them.
#[derive(Clone, Debug)]
pub struct Constellation {
    ephemeris: Ephemeris,
    epoch_ns: i64,
    motion: Motion,
    /// Index of our spacecraft, then of the other two in cyclic order.
    numbers: [usize; 3],
}

impl Constellation {
    /// The orbits of a mission.
    ///
    /// # Errors
    /// [`OrbitError::Span`] when the epoch lies outside the ephemeris.
    pub fn new(mission: &Mission) -> Result<Self, OrbitError> {
        let ephemeris = Ephemeris::embedded()?;
        let orbit = &mission.orbit;
        let epoch_ns = orbit.epoch()?.timestamp_nanos_opt().unwrap_or(i64::MAX);
        ephemeris.check("the epoch of [orbit],", epoch_ns)?;
        let epoch_et_s = ephemeris.leap_seconds().et_s(epoch_ns);
        let earth = elements::dcm_irf_from_ecliptic().tr_mul(&ephemeris.earth_irf_m(epoch_et_s)?);
        let centre_longitude_rad = earth.y.atan2(earth.x) - orbit.trailing_angle_rad;
        let start = elements::triangle(centre_longitude_rad, orbit.arm_length_m);
        let motion = Motion::new(&ephemeris, epoch_et_s, start)?;
        let numbers = match mission.mission.spacecraft.as_str() {
            "SC2" => [1, 2, 0],
            "SC3" => [2, 0, 1],
            _ => [0, 1, 2],
        };
        Ok(Self { ephemeris, epoch_ns, motion, numbers })
    }

    /// Refuses a time that [`Self::at`] would refuse; `what` names it.
    ///
    /// # Errors
    /// [`OrbitError::Span`].
    pub fn check(&self, what: &'static str, time_ns: i64) -> Result<(), OrbitError> {
        self.ephemeris.check(what, time_ns)
    }

    /// Position and velocity of our spacecraft and of those at the far ends of its arms (SC1, SC2, SC3 for SC1), at a
    /// time, Unix ns.
    ///
    /// # Errors
    /// [`OrbitError::Span`].
    pub fn states(&self, time_ns: i64) -> Result<[State; 3], OrbitError> {
        self.check("the time", time_ns)?;
        let leap_seconds = self.ephemeris.leap_seconds();
        let elapsed_ns = time_ns - self.epoch_ns;
        let (whole_s, rest_ns) = (elapsed_ns.div_euclid(1_000_000_000), elapsed_ns.rem_euclid(1_000_000_000));
        let scales_s = leap_seconds.tdb_minus_utc_s(time_ns) - leap_seconds.tdb_minus_utc_s(self.epoch_ns);
        let states = self.motion.at(&self.ephemeris, whole_s as f64 + (rest_ns as f64 * 1e-9 + scales_s))?;
        Ok(self.numbers.map(|i| states[i]))
    }

    /// The surroundings at a time, Unix ns.
    ///
    /// # Errors
    /// [`OrbitError::Span`].
    pub fn at(&self, time_ns: i64) -> Result<Environment, OrbitError> {
        let states = self.states(time_ns)?;
        let earth = self.ephemeris.earth_irf_m(self.ephemeris.leap_seconds().et_s(time_ns))?;
        let [ours, second, third] = states.map(|s| Moving {
            value: s.r_irf_m,
            rate: s.v_irf_m_s,
            acceleration: gravity_irf_m_s2(&s.r_irf_m, &earth),
        });
        let crf = Crf::new(&second.minus(&ours), &third.minus(&ours));
        let t = &crf.dcm_irf_from_crf;
        let r = ours.value;
        let gradient_irf_s2 = tide(&r, MU_SUN_M3_S2) + tide(&(r - earth), MU_EARTH_M3_S2);
        Ok(Environment {
            r_sc_irf_m: r,
            v_sc_irf_m_s: ours.rate,
            omega_crf_rad_s: crf.omega_crf_rad_s,
            alpha_crf_rad_s2: crf.alpha_crf_rad_s2,
            sun_crf: t.tr_mul(&r.normalize()),
            gradient_crf_s2: t.tr_mul(&(gradient_irf_s2 * t)),
            opening_angle_rad: crf.opening_angle_rad,
            opening_rate_rad_s: crf.opening_rate_rad_s,
        })
    }
}

/// Gravity gradient of a point mass at `r` from it, `μ(3 r̂ r̂ᵀ − 1)/r³`, s⁻².
fn tide(r_m: &Vector3<f64>, mu_m3_s2: f64) -> Matrix3<f64> {
    let direction = r_m.normalize();
    (3.0 * direction * direction.transpose() - Matrix3::identity()) * (mu_m3_s2 / r_m.norm().powi(3))
}
