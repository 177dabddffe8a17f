//! The mission file: constants, frames, noise, requirements. Units stand in the keys, unknown keys are errors.
//!
//! The engine hands every plugin the whole file as JSON; a plugin asks for the sections that it needs.

use chrono::{DateTime, NaiveDate, NaiveDateTime, Utc};
use nalgebra::{Matrix3, Vector3};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

use crate::frames::dcm_turned_about_z;
use crate::noise::{NoiseLine, NoiseShape, NoiseTerm};
use crate::ranges;

/// Why a mission file was refused: what, where, and what to do next.
#[expect(missing_docs, reason = "the messages name the fields")]
#[derive(Debug, thiserror::Error)]
pub enum MissionError {
    /// The text is not a mission: unknown key, wrong type, missing key.
    #[error(
        "mission file: {key}: {source}; every key carries its unit, and fixtures/missions/taiji.toml shows them all"
    )]
    Shape { key: String, source: serde_json::Error },
    /// A value is not physical.
    #[error("mission file: {key} = {value} {reason}")]
    Value { key: String, value: String, reason: &'static str },
    /// A value is beyond what any spacecraft has.
    #[error("mission file: {key} = {value} {must}")]
    Range { key: String, value: String, must: String },
    /// The actuators cannot accelerate every channel independently.
    #[error("mission file: no allocation of the channels to the actuators: {reason}")]
    Decoupling { reason: String },
    /// A section that a plugin needs is missing.
    #[error("mission file: section [{section}] is missing; {needed_by} needs it")]
    Missing { section: String, needed_by: &'static str },
    /// The mission file has no controllers, and the design of controllers failed.
    #[error("mission file: {0}")]
    Design(#[source] Box<dyn std::error::Error + Send + Sync>),
}

/// A whole mission file.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Mission {
    /// Name, spacecraft, sample rate.
    pub mission: Identity,
    /// Mass properties of the spacecraft.
    pub spacecraft: Spacecraft,
    /// Test masses by name; everything per test mass is in the order of their names.
    #[serde(default)]
    pub test_mass: BTreeMap<String, TestMass>,
    /// Survey of the housings.
    #[serde(default)]
    pub housing: Option<Housing>,
    /// Noise models.
    #[serde(default)]
    pub noise: Noise,
    /// Mean force and torque of sunlight.
    #[serde(default)]
    pub solar_pressure: Option<SolarPressure>,
    /// Requirement table (tab:state_precision_requirements).
    #[serde(default)]
    pub requirements: Option<Requirements>,
    /// Controllers of the channels.
    #[serde(default)]
    pub control: Option<Control>,
    /// Actuator limits.
    #[serde(default)]
    pub actuators: Option<Actuators>,
    /// Response of the thrusters to a command; without it, they apply the command.
    #[serde(default)]
    pub thrusters: Option<Thrusters>,
    /// Residual self-gravity at the test masses.
    #[serde(default)]
    pub self_gravity: SelfGravity,
    /// Limits of the telemetry beyond which a sample is an outlier.
    #[serde(default)]
    pub limits: Option<Limits>,
    /// Orbits of the constellation.
    #[serde(default)]
    pub orbit: Orbit,
    /// Tables of mission-specific plugins, not interpreted here.
    #[serde(default)]
    pub plugin: BTreeMap<String, serde_json::Value>,
}

/// `[mission]`
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Identity {
    /// Name of the mission.
    pub name: String,
    /// Name of the spacecraft, as in file and product names.
    pub spacecraft: String,
    /// Rate of the common grid, Hz.
    pub sample_rate_hz: f64,
}

/// `[spacecraft]`
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Spacecraft {
    /// Mass, kg.
    pub mass_kg: f64,
    /// Inertia about the centre of mass, in SRF, kg m², rows.
    pub inertia_srf_kg_m2: [[f64; 3]; 3],
}

/// A translational axis of a test mass.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Axis {
    /// Along `o_1`.
    X,
    /// Along `o_2`.
    Y,
    /// Along `o_3`.
    Z,
}

fn only_x() -> Vec<Axis> {
    vec![Axis::X]
}

/// `[test_mass.NAME]`
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TestMass {
    /// Mass, kg.
    pub mass_kg: f64,
    /// Inertia in MRF, kg m², rows.
    #[serde(default)]
    pub inertia_mrf_kg_m2: Option<[[f64; 3]; 3]>,
    /// Name of its frame ORF; without it `ORF_n` for the n-th test mass by name.
    #[serde(default)]
    pub frame: Option<String>,
    /// ORF is SRF turned by this angle about `s_3`, rad.
    pub orf_from_srf_angle_rad: f64,
    /// Axes that an interferometer reads; the inertial sensor reads the others. Wavefront sensing of `θ` and `ψ` comes
    /// with the interferometer along x.
    #[serde(default = "only_x")]
    pub interferometer: Vec<Axis>,
    /// Axes along which the spacecraft follows the test mass and no electrode pushes; along the others the electrodes
    /// hold the test mass.
    #[serde(default = "only_x")]
    pub drag_free: Vec<Axis>,
    /// Nominal position of the housing's centre relative to the spacecraft's centre of mass, SRF, m.
    pub offset_nominal_srf_m: [f64; 3],
    /// Half width of the box around the nominal offset that contains the true one, SRF, m.
    pub offset_box_srf_m: [f64; 3],
    /// `S_TT`, force per displacement and mass, ORF, s⁻², rows.
    #[serde(default)]
    pub stiffness_tt_orf_s2: [[f64; 3]; 3],
    /// `S_TR`, m s⁻² per rad, ORF, rows.
    #[serde(default)]
    pub stiffness_tr_orf_m_s2_rad: [[f64; 3]; 3],
    /// `S_RR`, rad s⁻² per rad, ORF, rows.
    #[serde(default)]
    pub stiffness_rr_orf_s2: [[f64; 3]; 3],
}

/// `[housing]`
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Housing {
    /// The two test masses; optional in a mission of two.
    #[serde(default)]
    pub between: Option<[String; 2]>,
    /// Surveyed vector from the second housing to the first, `b_1 − b_2`, SRF, m.
    pub baseline_srf_m: [f64; 3],
    /// Tolerance of the survey per axis, m.
    pub baseline_tolerance_m: f64,
}

/// `[noise]`: one table per process, `a·sqrt(1+(corner/f)^exponent)` plus optional further terms and lines.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Noise {
    /// Interferometer along x.
    pub ifo_x: Option<DisplacementNoise>,
    /// Interferometer along y.
    pub ifo_y: Option<DisplacementNoise>,
    /// Interferometer along z.
    pub ifo_z: Option<DisplacementNoise>,
    /// Capacitive readout along x, used where there is no interferometer.
    pub is_x: Option<DisplacementNoise>,
    /// Capacitive readout along y.
    pub is_y: Option<DisplacementNoise>,
    /// Capacitive readout along z.
    pub is_z: Option<DisplacementNoise>,
    /// Capacitive readout of the test-mass angles.
    pub is_angle: Option<AngleNoise>,
    /// Local wavefront sensing of the test-mass angles.
    pub dws_local: Option<AngleNoise>,
    /// Long-arm wavefront sensing of the spacecraft's attitude.
    pub dws_long_arm: Option<AngleNoise>,
    /// Thrust, per axis of SRF.
    pub thruster_force: Option<ForceNoise>,
    /// Thrusters' torque, per axis of SRF.
    pub thruster_torque: Option<TorqueNoise>,
    /// Electrostatic force on a test mass, along the axes that are not drag-free.
    pub electrostatic_force: Option<ForceNoise>,
    /// Electrostatic torque on a test mass.
    pub electrostatic_torque: Option<TorqueNoise>,
    /// Stray acceleration of a test mass.
    pub test_mass_acceleration: Option<AccelerationNoise>,
    /// Fluctuation of the solar pressure force.
    pub solar_pressure: Option<ForceNoise>,
    /// Linear acceleration measured by an accelerometer, with the unmodelled non-gravitational acceleration.
    pub accelerometer_linear: Option<AccelerationNoise>,
    /// Angular acceleration measured by an accelerometer.
    pub accelerometer_angular: Option<AngularAccelerationNoise>,
}

macro_rules! noise_table {
    ($what:literal, $name:ident, $term:ident, $key:ident, $line:ident, $amplitude:ident, $unit:literal) => {
        #[doc = concat!("Noise of ", $what, ".")]
        #[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
        #[serde(deny_unknown_fields)]
        pub struct $name {
            #[doc = concat!("Amplitude spectral density above the corner, ", $unit, "/√Hz.")]
            pub $key: f64,
            /// Corner frequency, Hz; 0 for white noise.
            #[serde(default)]
            pub corner_hz: f64,
            /// Even exponent of the PSD below the corner.
            #[serde(default)]
            pub exponent: u32,
            /// Further terms that add to the PSD.
            #[serde(default)]
            pub terms: Vec<$term>,
            /// Sines of random phase on top of it.
            #[serde(default, skip_serializing_if = "Vec::is_empty")]
            pub lines: Vec<$line>,
        }

        /// A further term of the PSD, `asd² (corner/f)^exponent`.
        #[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
        #[serde(deny_unknown_fields)]
        pub struct $term {
            #[doc = concat!("Amplitude spectral density at the corner, ", $unit, "/√Hz.")]
            pub $key: f64,
            /// Corner frequency, Hz.
            pub corner_hz: f64,
            /// Even exponent of the PSD.
            pub exponent: u32,
        }

        /// A sine of random phase.
        #[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
        #[serde(deny_unknown_fields)]
        pub struct $line {
            #[doc = concat!("Amplitude, ", $unit, ".")]
            pub $amplitude: f64,
            /// Frequency, Hz.
            pub frequency_hz: f64,
        }

        impl $name {
            /// The lines without their unit.
            pub fn lines(&self) -> Vec<NoiseLine> {
                let line = |l: &$line| NoiseLine { amplitude: l.$amplitude, frequency_hz: l.frequency_hz };
                self.lines.iter().map(line).collect()
            }

            /// The shape without its unit.
            pub fn shape(&self) -> NoiseShape {
                let mut shape = NoiseShape::with_corner(self.$key, self.corner_hz, self.exponent);
                shape.terms.extend(self.terms.iter().map(|t| NoiseTerm {
                    asd: t.$key,
                    corner_hz: t.corner_hz,
                    exponent: t.exponent,
                }));
                shape
            }

            fn check(&self, key: &str, sample_rate_hz: f64) -> Result<(), MissionError> {
                for line in &self.lines {
                    positive_or_zero(&format!("{key}.lines.{}", stringify!($amplitude)), line.$amplitude)?;
                    let frequency = format!("{key}.lines.frequency_hz");
                    positive(&frequency, line.frequency_hz)?;
                    if line.frequency_hz >= 0.5 * sample_rate_hz {
                        return Err(value_error(&frequency, &line.frequency_hz, "must lie below half the sample rate"));
                    }
                }
                let all = std::iter::once((self.$key, self.corner_hz, self.exponent))
                    .chain(self.terms.iter().map(|t| (t.$key, t.corner_hz, t.exponent)));
                for (asd, corner_hz, exponent) in all {
                    positive_or_zero(&format!("{key}.{}", stringify!($key)), asd)?;
                    positive_or_zero(&format!("{key}.corner_hz"), corner_hz)?;
                    if exponent % 2 != 0 || exponent > 8 {
                        let reason = "must be 0, 2, 4, 6 or 8: a shaping filter has a whole number of states";
                        return Err(value_error(&format!("{key}.exponent"), &exponent, reason));
                    }
                }
                Ok(())
            }
        }
    };
}

noise_table!(
    "a displacement readout",
    DisplacementNoise,
    DisplacementTerm,
    asd_m_rthz,
    DisplacementLine,
    amplitude_m,
    "m"
);
noise_table!("an angle readout", AngleNoise, AngleTerm, asd_rad_rthz, AngleLine, amplitude_rad, "rad");
noise_table!("a force", ForceNoise, ForceTerm, asd_n_rthz, ForceLine, amplitude_n, "N");
noise_table!("a torque", TorqueNoise, TorqueTerm, asd_nm_rthz, TorqueLine, amplitude_nm, "N m");
noise_table!(
    "an acceleration",
    AccelerationNoise,
    AccelerationTerm,
    asd_m_s2_rthz,
    AccelerationLine,
    amplitude_m_s2,
    "m s⁻²"
);
noise_table!(
    "an angular acceleration",
    AngularAccelerationNoise,
    AngularAccelerationTerm,
    asd_rad_s2_rthz,
    AngularAccelerationLine,
    amplitude_rad_s2,
    "rad s⁻²"
);

/// `[solar_pressure]` (eqs SRP_transfer_function and SRP_torque).
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SolarPressure {
    /// Mean force `k_dSC` away from the Sun, N.
    pub force_n: f64,
    /// Arm of the force about the centre of mass, SRF, m; the torque is `arm × force`.
    pub arm_srf_m: [f64; 3],
    /// Error of the orbit that the feed-forward uses, 1σ per axis, m.
    #[serde(default)]
    pub orbit_error_m: f64,
}

/// `[requirements]` (tab:state_precision_requirements), amplitude spectral densities; `f_s`, `f_r` are
/// `sqrt(1+(corner/f)^4)`.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Requirements {
    /// Test mass along x, m/√Hz.
    pub tm_x_m_rthz: f64,
    /// Test mass along y and z, m/√Hz.
    pub tm_yz_m_rthz: f64,
    /// Spacecraft attitude, rad/√Hz, times `f_s`.
    pub sc_attitude_rad_rthz: f64,
    /// Test-mass roll `φ`, rad/√Hz, times `f_r`.
    pub tm_phi_rad_rthz: f64,
    /// Test-mass `θ` and `ψ`, rad/√Hz, times `f_s`.
    pub tm_theta_psi_rad_rthz: f64,
    /// Corner of `f_s` and `f_r`, Hz; the paper does not give it.
    pub corner_hz: f64,
}

/// `[control]`: one discrete controller per channel, named as by [`Mission::channels`].
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Control {
    /// Samples between a readout and the start of the interval in which its command acts.
    pub delay_samples: u32,
    /// Whether the allocation cancels the acceleration `−α × b` of the test masses by the spacecraft's rotation, at the
    /// nominal offsets. Controllers that treat rotation and translation separately do not.
    #[serde(default = "yes")]
    pub lever_feed_forward: bool,
    /// Bandwidth of the designed attitude loop relative to what its requirement needs. A faster loop excites more
    /// angular acceleration where the interferometers are quiet, which makes the offset more observable.
    #[serde(default = "one")]
    pub attitude_bandwidth_factor: f64,
    /// Controllers by channel: all of them, or none for the default design.
    #[serde(default)]
    pub channel: BTreeMap<String, ChannelController>,
}

fn yes() -> bool {
    true
}

fn one() -> f64 {
    1.0
}

impl Default for Control {
    /// One sample of delay and the default design.
    fn default() -> Self {
        Self { delay_samples: 1, lever_feed_forward: yes(), attitude_bandwidth_factor: one(), channel: BTreeMap::new() }
    }
}

/// A controller: from a channel's readout (m or rad) to its desired acceleration `u_d` (m s⁻² or rad s⁻²).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ChannelController {
    /// `u_d = −gain · H(z) y`, gain in s⁻².
    pub gain_s2: f64,
    /// Second-order sections of `H(z)`, each `[b0, b1, b2, a1, a2]` of
    /// `(b0 + b1 z⁻¹ + b2 z⁻²)/(1 + a1 z⁻¹ + a2 z⁻²)`, applied in order at the mission's sample rate.
    pub sections: Vec<[f64; 5]>,
}

/// `[actuators]`: limits of what can be commanded.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Actuators {
    /// Thrust per axis of SRF, N.
    pub thrust_limit_n: f64,
    /// Torque per axis of SRF, N m.
    pub torque_limit_nm: f64,
    /// Electrostatic force per axis, N.
    pub electrostatic_force_limit_n: f64,
    /// Electrostatic torque per axis, N m.
    pub electrostatic_torque_limit_nm: f64,
}

/// `[thrusters]`: response of the thrusters to a command. Without units, delay and lag apply to force and torque along
/// each axis of SRF, limit and step to the force, and the noise is that of `[noise]`. With units, all of these apply to
/// each unit.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Thrusters {
    /// Time constant of the first-order lag, s.
    #[serde(default)]
    pub lag_s: f64,
    /// Delay of the thrusters themselves, s, on top of the loop's `delay_samples`.
    #[serde(default)]
    pub delay_s: f64,
    /// Least thrust of a unit, N.
    #[serde(default)]
    pub min_n: f64,
    /// Largest thrust of a unit, or along an axis, N; none without it.
    pub max_n: Option<f64>,
    /// Step of the thrust, N; 0 for none.
    #[serde(default)]
    pub step_n: f64,
    /// The thrusters; none to act along the axes.
    #[serde(default)]
    pub unit: Vec<ThrusterUnit>,
}

/// `[[thrusters.unit]]`: one thruster, whose white noise replaces the noise per axis.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ThrusterUnit {
    /// Point of application relative to the centre of mass, SRF, m.
    pub position_srf_m: [f64; 3],
    /// Direction of its force on the spacecraft, SRF, of any length.
    pub direction_srf: [f64; 3],
    /// Amplitude spectral density of its thrust, N/√Hz.
    pub asd_n_rthz: f64,
}

/// `[self_gravity]`: bounds of the spacecraft's residual gravity at a test mass; a simulation draws values within them.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SelfGravity {
    /// Largest acceleration along x, y, z, ORF, m/s².
    pub acceleration_orf_m_s2: [f64; 3],
    /// Largest angular acceleration about any axis, rad/s².
    pub angular_acceleration_rad_s2: f64,
    /// Largest drift of the acceleration along any axis, m/s² per day.
    pub drift_m_s2_day: f64,
}

impl Default for SelfGravity {
    /// Values of LISA Pathfinder, without a drift.
    fn default() -> Self {
        Self { acceleration_orf_m_s2: [3e-10, 1e-9, 1e-9], angular_acceleration_rad_s2: 5e-9, drift_m_s2_day: 0.0 }
    }
}

/// `[limits]`: absolute bounds of telemetry, beyond which a sample is unphysical and refused.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Limits {
    /// Test-mass displacement, m.
    pub displacement_m: f64,
    /// Attitude and test-mass angles, rad.
    pub angle_rad: f64,
}

/// `[orbit]`: three spacecraft on a heliocentric triangle. `mission.spacecraft` selects one of them, `SC1`, `SC2` or
/// `SC3`; any other name selects the first.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Orbit {
    /// Epoch at which the triangle is equilateral and SC1 at its aphelion: `YYYY-MM-DD` or `YYYY-MM-DDThh:mm:ss`, UTC.
    pub epoch_utc: String,
    /// Ecliptic longitude by which the triangle's centre trails the Earth then, rad; negative if it leads.
    pub trailing_angle_rad: f64,
    /// Length of the arms, m.
    pub arm_length_m: f64,
}

impl Default for Orbit {
    /// The paper's epoch, Taiji's arms and place.
    fn default() -> Self {
        Self {
            epoch_utc: "2035-01-01T00:00:00".to_owned(),
            trailing_angle_rad: 20_f64.to_radians(),
            arm_length_m: 3.0e9,
        }
    }
}

impl Orbit {
    /// The epoch.
    ///
    /// # Errors
    /// [`MissionError::Value`] when the text is no instant.
    pub fn epoch(&self) -> Result<DateTime<Utc>, MissionError> {
        let text = self.epoch_utc.strip_suffix('Z').unwrap_or(&self.epoch_utc);
        let date = || text.parse::<NaiveDate>().map(|day| day.and_time(chrono::NaiveTime::MIN));
        let instant = text.parse::<NaiveDateTime>().or_else(|_| date());
        instant
            .map(|i| i.and_utc())
            .map_err(|_| value_error("orbit.epoch_utc", &self.epoch_utc, "must be an instant as 2035-01-01T00:00:00"))
    }

    fn check(&self) -> Result<(), MissionError> {
        self.epoch()?;
        if !(LEAST_TRAILING_RAD..=std::f64::consts::PI).contains(&self.trailing_angle_rad.abs()) {
            return Err(value_error(
                "orbit.trailing_angle_rad",
                &self.trailing_angle_rad,
                "must be 0.1 to π in size: closer to the Earth the triangle is not stable",
            ));
        }
        if !(self.arm_length_m > 0.0 && self.arm_length_m <= MOST_ARM_LENGTH_M) {
            return Err(value_error("orbit.arm_length_m", &self.arm_length_m, "must be above zero and at most 1e10"));
        }
        Ok(())
    }
}

/// Smallest angle between the Earth and a stable triangle.
const LEAST_TRAILING_RAD: f64 = 0.1;
/// Longest arms: the orbits are an expansion in arm length over one astronomical unit.
const MOST_ARM_LENGTH_M: f64 = 1e10;

fn matrix(rows: &[[f64; 3]; 3]) -> Matrix3<f64> {
    Matrix3::from_fn(|i, j| rows[i][j])
}

/// Inverse of an inertia that [`Mission::check`] found positive definite.
fn inverse(inertia: Matrix3<f64>) -> Matrix3<f64> {
    inertia.cholesky().map_or_else(|| Matrix3::from_element(f64::NAN), |c| c.inverse())
}

/// Dotted key at which reading of a JSON text stopped; the error has only line and column.
fn key_at(text: &str, error: &serde_json::Error) -> String {
    let lines = text.split_inclusive('\n').take(error.line().saturating_sub(1));
    let end = (lines.map(str::len).sum::<usize>() + error.column()).min(text.len());
    let mut keys: Vec<&str> = Vec::new();
    let mut last = "";
    let mut from = None;
    for (at, byte) in text.bytes().enumerate().take(end) {
        match (byte, from) {
            (b'"', None) => from = Some(at + 1),
            (b'"', Some(start)) => {
                last = &text[start..at];
                from = None;
            }
            (b'{', None) => keys.push(""),
            // If a required key is missing, the error is at the end of its object.
            (b'}', None) if at + 1 < end => drop(keys.pop()),
            (b':', None) => {
                if let Some(key) = keys.last_mut() {
                    *key = last;
                }
            }
            _ => {}
        }
    }
    let (before, after) = text.as_bytes().split_at(end);
    if after.trim_ascii_start().starts_with(b":") {
        // The key itself is at fault.
        keys.pop();
        keys.push(last);
    } else if error.is_data() && before.ends_with(b"}") {
        keys.pop();
    }
    keys.retain(|key| !key.is_empty());
    keys.join(".")
}

fn value_error(key: &str, value: &dyn std::fmt::Display, reason: &'static str) -> MissionError {
    MissionError::Value { key: key.to_owned(), value: value.to_string(), reason }
}

fn positive(key: &str, value: f64) -> Result<(), MissionError> {
    let valid = value.is_finite() && value > 0.0;
    valid.then_some(()).ok_or_else(|| value_error(key, &value, "must be finite and above zero"))
}

fn positive_or_zero(key: &str, value: f64) -> Result<(), MissionError> {
    let valid = value.is_finite() && value >= 0.0;
    valid.then_some(()).ok_or_else(|| value_error(key, &value, "must be finite and not negative"))
}

fn inertia(key: &str, rows: &[[f64; 3]; 3]) -> Result<(), MissionError> {
    let refuse = |reason| Err(value_error(key, &format!("{rows:?}"), reason));
    let m = matrix(rows);
    if !m.iter().all(|x| x.is_finite()) || m != m.transpose() {
        return refuse("must be finite and symmetric");
    }
    let e = m.symmetric_eigenvalues();
    let (lo, sum) = (e.min(), e.sum());
    if lo <= 0.0 || e.iter().any(|x| *x > sum - x) {
        return refuse("must be positive definite and keep the triangle inequality of its principal moments");
    }
    Ok(())
}

impl Mission {
    /// Reads a mission from the JSON that the engine hands to plugins and checks every value.
    ///
    /// # Errors
    /// [`MissionError`] names the key, its value and what it must be.
    pub fn from_json(text: &str) -> Result<Self, MissionError> {
        let shape = |source: serde_json::Error| MissionError::Shape { key: key_at(text, &source), source };
        let value: serde_json::Value = serde_json::from_str(text).map_err(shape)?;
        let mission: Self = serde_json::from_str(text).map_err(shape)?;
        if let Some((key, value, must)) = ranges::beyond(&value) {
            return Err(MissionError::Range { key, value, must });
        }
        mission.check()?;
        Ok(mission)
    }

    fn check(&self) -> Result<(), MissionError> {
        positive("mission.sample_rate_hz", self.mission.sample_rate_hz)?;
        positive("spacecraft.mass_kg", self.spacecraft.mass_kg)?;
        inertia("spacecraft.inertia_srf_kg_m2", &self.spacecraft.inertia_srf_kg_m2)?;
        if self.test_mass.len() > MOST_TEST_MASSES {
            return Err(value_error("test_mass", &self.test_mass.len(), "must be at most four"));
        }
        for (name, tm) in &self.test_mass {
            let key = |k: &str| format!("test_mass.{name}.{k}");
            let plain = name.bytes().all(|b| b.is_ascii_lowercase() || b.is_ascii_digit() || b == b'_');
            if name.is_empty() || !plain || name == SPACECRAFT {
                return Err(value_error(
                    "test_mass",
                    name,
                    "must be of a-z, 0-9 and _, and not sc, the spacecraft's name",
                ));
            }
            for (k, axes) in [("interferometer", &tm.interferometer), ("drag_free", &tm.drag_free)] {
                if axes.iter().enumerate().any(|(i, axis)| axes[..i].contains(axis)) {
                    return Err(value_error(&key(k), &format!("{axes:?}"), "must name each axis once"));
                }
            }
            positive(&key("mass_kg"), tm.mass_kg)?;
            if let Some(rows) = &tm.inertia_mrf_kg_m2 {
                inertia(&key("inertia_mrf_kg_m2"), rows)?;
            }
            for x in tm.offset_box_srf_m {
                positive(&key("offset_box_srf_m"), x)?;
            }
        }
        if let Some(h) = &self.housing {
            positive("housing.baseline_tolerance_m", h.baseline_tolerance_m)?;
            if self.baseline().is_none() {
                let found = h.between.as_ref().map_or_else(|| "missing".to_owned(), |names| format!("{names:?}"));
                return Err(value_error("housing.between", &found, "must name two test masses of the mission"));
            }
        }
        self.noise.check(self.mission.sample_rate_hz)?;
        self.orbit.check()?;
        if let Some(s) = &self.solar_pressure {
            positive_or_zero("solar_pressure.force_n", s.force_n)?;
            positive_or_zero("solar_pressure.orbit_error_m", s.orbit_error_m)?;
        }
        if let Some(r) = &self.requirements {
            positive("requirements.tm_x_m_rthz", r.tm_x_m_rthz)?;
            positive("requirements.tm_yz_m_rthz", r.tm_yz_m_rthz)?;
            positive("requirements.sc_attitude_rad_rthz", r.sc_attitude_rad_rthz)?;
            positive("requirements.tm_phi_rad_rthz", r.tm_phi_rad_rthz)?;
            positive("requirements.tm_theta_psi_rad_rthz", r.tm_theta_psi_rad_rthz)?;
            positive_or_zero("requirements.corner_hz", r.corner_hz)?;
        }
        if let Some(a) = &self.actuators {
            positive("actuators.thrust_limit_n", a.thrust_limit_n)?;
            positive("actuators.torque_limit_nm", a.torque_limit_nm)?;
            positive("actuators.electrostatic_force_limit_n", a.electrostatic_force_limit_n)?;
            positive("actuators.electrostatic_torque_limit_nm", a.electrostatic_torque_limit_nm)?;
        }
        if let Some(t) = &self.thrusters {
            t.check()?;
        }
        for limit in self.self_gravity.acceleration_orf_m_s2 {
            positive_or_zero("self_gravity.acceleration_orf_m_s2", limit)?;
        }
        positive_or_zero("self_gravity.angular_acceleration_rad_s2", self.self_gravity.angular_acceleration_rad_s2)?;
        positive_or_zero("self_gravity.drift_m_s2_day", self.self_gravity.drift_m_s2_day)?;
        if let Some(c) = &self.control {
            if c.delay_samples > MOST_DELAY_SAMPLES {
                return Err(value_error("control.delay_samples", &c.delay_samples, "must be at most 100"));
            }
            if !(0.5..=4.0).contains(&c.attitude_bandwidth_factor) {
                let value = c.attitude_bandwidth_factor;
                return Err(value_error("control.attitude_bandwidth_factor", &value, "must be between 0.5 and 4"));
            }
            let channels = self.channels();
            for (name, channel) in &c.channel {
                if !channels.contains(name) {
                    return Err(value_error(
                        "control.channel",
                        name,
                        "is no channel; they are sc.phi, sc.theta, sc.psi, and x, y, z, phi, theta, psi of each test mass",
                    ));
                }
                let finite = channel.gain_s2.is_finite() && channel.sections.iter().flatten().all(|x| x.is_finite());
                if !finite {
                    return Err(value_error(&format!("control.channel.{name}"), &"…", "must be finite"));
                }
            }
        }
        Ok(())
    }

    /// The channels in the order of eq:state_variables: the spacecraft's angles, then displacements and angles of each
    /// test mass, `sc.phi`, `sc.theta`, `sc.psi`, `NAME.x`, `NAME.y`, `NAME.z`, `NAME.phi`, `NAME.theta`, `NAME.psi`.
    pub fn channels(&self) -> Vec<String> {
        let angles = ANGLES.map(|angle| format!("{SPACECRAFT}.{angle}"));
        let of = |name: &String| AXES.into_iter().chain(ANGLES).map(|freedom| format!("{name}.{freedom}")).collect();
        angles.into_iter().chain(self.test_mass.keys().flat_map(|name| -> Vec<String> { of(name) })).collect()
    }

    /// Name of the frame ORF of a test mass, `ORF_n` unless the mission gives another; empty without the test mass.
    pub fn frame(&self, name: &str) -> String {
        let numbered = self.test_mass.iter().enumerate().find(|(_, (key, _))| *key == name);
        numbered.map_or_else(String::new, |(i, (_, tm))| tm.frame.clone().unwrap_or_else(|| format!("ORF_{}", i + 1)))
    }

    /// The two test masses whose housings are surveyed, the one at the end of the baseline first; `None` without a
    /// survey.
    pub fn baseline(&self) -> Option<[&str; 2]> {
        let housing = self.housing.as_ref()?;
        let names: Vec<&str> = self.test_mass.keys().map(String::as_str).collect();
        match (&housing.between, names.as_slice()) {
            (Some([one, two]), _) if one != two && [one, two].iter().all(|n| self.test_mass.contains_key(*n)) => {
                Some([one, two])
            }
            (None, [one, two]) => Some([one, two]),
            _ => None,
        }
    }

    /// Name and noise of the best readout of a displacement: `ifo_x` where x has an interferometer, else `is_x`.
    pub fn displacement_noise(&self, test_mass: &TestMass, axis: usize) -> (&'static str, Option<&DisplacementNoise>) {
        let tables = if test_mass.has_interferometer(axis) { INTERFEROMETER } else { INERTIAL_SENSOR };
        (tables[axis], self.noise.displacement(tables[axis]))
    }

    /// The section of a test mass.
    ///
    /// # Errors
    /// [`MissionError::Missing`] when the mission has no such test mass.
    pub fn test_mass(&self, name: &str, needed_by: &'static str) -> Result<&TestMass, MissionError> {
        Self::need(&self.test_mass.get(name), &format!("test_mass.{name}"), needed_by).copied()
    }

    /// A section or a noise table that must be there.
    ///
    /// # Errors
    /// [`MissionError::Missing`] when it is not.
    pub fn need<'a, T>(section: &'a Option<T>, name: &str, needed_by: &'static str) -> Result<&'a T, MissionError> {
        section.as_ref().ok_or_else(|| MissionError::Missing { section: name.to_owned(), needed_by })
    }

    /// Seconds between epochs of the common grid.
    pub fn dt_s(&self) -> f64 {
        1.0 / self.mission.sample_rate_hz
    }
}

impl Thrusters {
    fn check(&self) -> Result<(), MissionError> {
        positive_or_zero("thrusters.lag_s", self.lag_s)?;
        positive_or_zero("thrusters.delay_s", self.delay_s)?;
        positive_or_zero("thrusters.min_n", self.min_n)?;
        positive_or_zero("thrusters.step_n", self.step_n)?;
        if self.delay_s > MOST_THRUSTER_DELAY_S {
            return Err(value_error("thrusters.delay_s", &self.delay_s, "must be at most 10 s"));
        }
        if let Some(max_n) = self.max_n {
            positive("thrusters.max_n", max_n)?;
        }
        if self.unit.is_empty() && self.min_n > 0.0 {
            return Err(value_error(
                "thrusters.min_n",
                &self.min_n,
                "must be 0 without [[thrusters.unit]]: an axis pushes both ways",
            ));
        }
        if !self.unit.is_empty() && self.max_n.is_none_or(|max_n| max_n <= self.min_n) {
            let found = self.max_n.map_or_else(|| "missing".to_owned(), |x| x.to_string());
            return Err(value_error("thrusters.max_n", &found, "must be above min_n where there are units"));
        }
        for (i, unit) in self.unit.iter().enumerate() {
            let key = |k: &str| format!("thrusters.unit[{i}].{k}");
            positive_or_zero(&key("asd_n_rthz"), unit.asd_n_rthz)?;
            if !unit.position_srf_m.iter().all(|x| x.is_finite()) {
                return Err(value_error(
                    &key("position_srf_m"),
                    &format!("{:?}", unit.position_srf_m),
                    "must be finite",
                ));
            }
            let length = Vector3::from(unit.direction_srf).norm();
            if !(length.is_finite() && length > 0.0) {
                let found = format!("{:?}", unit.direction_srf);
                return Err(value_error(&key("direction_srf"), &found, "must be finite and not zero"));
            }
        }
        Ok(())
    }
}

impl Spacecraft {
    /// Inertia `J_S`, SRF, kg m².
    pub fn inertia(&self) -> Matrix3<f64> {
        matrix(&self.inertia_srf_kg_m2)
    }

    /// `J_S⁻¹`, SRF, kg⁻¹ m⁻².
    pub fn inertia_inverse(&self) -> Matrix3<f64> {
        inverse(self.inertia())
    }
}

impl TestMass {
    /// Whether an interferometer reads an axis, 0 for x.
    pub fn has_interferometer(&self, axis: usize) -> bool {
        self.interferometer.iter().any(|a| *a as usize == axis)
    }

    /// Whether the spacecraft follows the test mass along an axis, 0 for x.
    pub fn is_drag_free(&self, axis: usize) -> bool {
        self.drag_free.iter().any(|a| *a as usize == axis)
    }

    /// `T_S^O`: components in ORF from components in SRF.
    pub fn dcm_orf_from_srf(&self) -> Matrix3<f64> {
        dcm_turned_about_z(self.orf_from_srf_angle_rad)
    }

    /// Nominal offset in ORF, m.
    pub fn offset_nominal_orf_m(&self) -> Vector3<f64> {
        self.dcm_orf_from_srf() * Vector3::from(self.offset_nominal_srf_m)
    }

    /// `S_TT`, s⁻².
    pub fn stiffness_tt(&self) -> Matrix3<f64> {
        matrix(&self.stiffness_tt_orf_s2)
    }

    /// `S_TR`, m s⁻² rad⁻¹.
    pub fn stiffness_tr(&self) -> Matrix3<f64> {
        matrix(&self.stiffness_tr_orf_m_s2_rad)
    }

    /// `J_m`, MRF, kg m².
    ///
    /// # Errors
    /// [`MissionError::Missing`] when the mission gives no inertia; `name` is the section's.
    pub fn inertia(&self, name: &str, needed_by: &'static str) -> Result<Matrix3<f64>, MissionError> {
        let section = format!("test_mass.{name}.inertia_mrf_kg_m2");
        Mission::need(&self.inertia_mrf_kg_m2, &section, needed_by).map(matrix)
    }

    /// `J_m⁻¹`, MRF, kg⁻¹ m⁻².
    ///
    /// # Errors
    /// As [`Self::inertia`].
    pub fn inertia_inverse(&self, name: &str, needed_by: &'static str) -> Result<Matrix3<f64>, MissionError> {
        self.inertia(name, needed_by).map(inverse)
    }

    /// `S_RT = m J_m⁻¹ S_TRᵀ`, rad s⁻² per m: force and torque come from one potential.
    pub fn stiffness_rt(&self, inertia_inverse: &Matrix3<f64>) -> Matrix3<f64> {
        inertia_inverse * self.stiffness_tr().transpose() * self.mass_kg
    }

    /// `S_RR`, s⁻².
    pub fn stiffness_rr(&self) -> Matrix3<f64> {
        matrix(&self.stiffness_rr_orf_s2)
    }
}

/// Longest delay of a loop, samples; a longer one is taken for an error of the file.
const MOST_DELAY_SAMPLES: u32 = 100;

/// Longest delay of thrusters, s, for the same reason.
const MOST_THRUSTER_DELAY_S: f64 = 10.0;

/// Most test masses that a mission may have.
pub const MOST_TEST_MASSES: usize = 4;
/// The spacecraft in names of channels.
pub const SPACECRAFT: &str = "sc";
/// Tables of `[noise]` for the interferometers along x, y and z.
pub const INTERFEROMETER: [&str; 3] = ["ifo_x", "ifo_y", "ifo_z"];
/// Tables of `[noise]` for the inertial sensor along x, y and z.
pub const INERTIAL_SENSOR: [&str; 3] = ["is_x", "is_y", "is_z"];
/// Axes of translation in names of channels and columns.
pub const AXES: [&str; 3] = ["x", "y", "z"];
/// Angles about them.
pub const ANGLES: [&str; 3] = ["phi", "theta", "psi"];

impl Noise {
    /// The noise of a displacement readout by the name of its table, such as `ifo_x`.
    pub fn displacement(&self, table: &str) -> Option<&DisplacementNoise> {
        match table {
            "ifo_x" => self.ifo_x.as_ref(),
            "ifo_y" => self.ifo_y.as_ref(),
            "ifo_z" => self.ifo_z.as_ref(),
            "is_x" => self.is_x.as_ref(),
            "is_y" => self.is_y.as_ref(),
            "is_z" => self.is_z.as_ref(),
            _ => None,
        }
    }

    fn check(&self, sample_rate_hz: f64) -> Result<(), MissionError> {
        macro_rules! check {
            ($($name:ident)*) => {
                $(if let Some(n) = &self.$name { n.check(concat!("noise.", stringify!($name)), sample_rate_hz)?; })*
            }
        }
        check! {
            ifo_x ifo_y ifo_z is_x is_y is_z is_angle dws_local dws_long_arm thruster_force thruster_torque
            electrostatic_force electrostatic_torque test_mass_acceleration solar_pressure accelerometer_linear
            accelerometer_angular
        }
        Ok(())
    }
}
