//! The closed loop, epoch by epoch: measure, command, act.

use dragfree_physics::attitude::{rotation_vector, turn};
use dragfree_physics::control::{Command, ControlLaw, PerTestMass};
use dragfree_physics::control_design::growth_per_sample;
use dragfree_physics::manoeuvre::{Manoeuvre, ManoeuvreError};
use dragfree_physics::mission::{ANGLES, AXES, Actuators, Limits, Mission, MissionError, SPACECRAFT};
use dragfree_physics::process::normal;
use nalgebra::{Matrix3, Vector3};
use rand::{RngExt, SeedableRng};
use rand_xoshiro::Xoshiro256PlusPlus;
use serde::{Deserialize, Serialize};

use crate::effects::{Basis, EffectError, EffectRequest, Effects, Moment, Saved};
use crate::interior::{Influences, Interior, Running, SavedInterior};
use crate::orbit::{Constellation, Environment, OrbitError};
use crate::plant::{Loads, Outside, Plant, State};
use crate::sensors::{Measured, Noises};
use crate::thrusters::{SavedThrusters, Thrusters};

/// Standard deviation of the initial readouts, m and rad (the paper).
const INITIAL_SIGMA: f64 = 5e-8;
/// Seconds of a day.
const DAY_S: f64 = 86_400.0;
/// Seconds between packets of `/ephemeris`.
const EPHEMERIS_S: f64 = 60.0;
/// Displacement, m, and angle, rad, beyond which the loop has diverged.
const LOST_M: f64 = 1e-3;
const LOST_RAD: f64 = 0.1;

/// Why a simulation cannot go on.
#[expect(missing_docs, reason = "the messages name the fields")]
#[derive(Debug, thiserror::Error)]
pub enum SimulationError {
    /// The mission file is not suitable.
    #[error(transparent)]
    Mission(#[from] MissionError),
    /// There is no orbit at that time.
    #[error(transparent)]
    Orbit(#[from] OrbitError),
    /// An effect was refused.
    #[error(transparent)]
    Effect(#[from] EffectError),
    /// A manoeuvre was refused.
    #[error(transparent)]
    Manoeuvre(#[from] ManoeuvreError),
    /// A parameter is invalid.
    #[error("{0}")]
    Parameter(String),
    /// A controller of the mission file does not stabilise its channel.
    #[error(
        "mission file: control.channel.\"{channel}\" makes an unstable loop, growing by {growth:.4} a sample with \
         {delay_samples} sample(s) of delay; correct its gain, its sections or control.delay_samples, or leave \
         [control.channel] out for the H-infinity design"
    )]
    Unstable { channel: String, growth: f64, delay_samples: u32 },
    /// The loop diverged.
    #[error(
        "the loop diverged {elapsed_s} s after the start of the simulation: {what} = {value:e} {unit}; \
         check [control], [actuators] and the sizes of the effects"
    )]
    Diverged { elapsed_s: f64, what: String, value: f64, unit: &'static str },
    /// A saved state of another simulation.
    #[error("state of the simulator: {0}; it was saved with another mission or parameters")]
    State(String),
}

/// Settings of a simulation, besides the mission.
#[derive(Clone, Debug)]
pub struct Settings {
    /// Seed of all random numbers.
    pub seed: u64,
    /// First epoch, Unix ns.
    pub start_ns: i64,
    /// Seconds that the loop runs before the first epoch.
    pub settle_s: f64,
    /// True minus nominal position of the housings relative to the centre of mass, SRF, m.
    pub com_offset_srf_m: Vector3<f64>,
    /// Largest relative error of a stiffness element.
    pub stiffness_error: f64,
    /// Effects unknown to the controller.
    pub effects: Vec<EffectRequest>,
    /// What is commanded beside the control law.
    pub manoeuvres: Vec<Manoeuvre>,
}

/// One epoch of the loop.
#[derive(Clone, Debug)]
pub struct Epoch {
    /// Number of the epoch.
    pub index: i64,
    /// Its time `t_k`, Unix ns.
    pub time_ns: i64,
    /// Readouts at `t_k`.
    pub measured: Measured,
    /// Command over `[t_k, t_{k+1})`.
    pub command: Command,
    /// Whether the command is at its limit, or beyond the thrusters.
    pub at_limit: bool,
    /// The truth at `t_k`; α and `a_ng` as means over `[t_k, t_{k+1})`.
    pub truth: Truth,
    /// The `/ephemeris` packet of this epoch, when it has one.
    pub ephemeris: Option<Ephemeris>,
}

/// True states.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Truth {
    /// Displacements, ORF, m.
    pub r_orf_m: PerTestMass<Vector3<f64>>,
    /// Attitude relative to CRF, rad.
    pub sc_crf_rad: Vector3<f64>,
    /// `ω_SI`, SRF, rad/s.
    pub omega_srf_rad_s: Vector3<f64>,
    /// Mean `α`, SRF, rad/s².
    pub alpha_srf_rad_s2: Vector3<f64>,
    /// Mean non-gravitational acceleration, SRF, m/s².
    pub nongrav_srf_m_s2: Vector3<f64>,
    /// Housings relative to the centre of mass, ORF, m.
    pub offset_orf_m: PerTestMass<Vector3<f64>>,
}

/// Orbit and pointing as determined on ground.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ephemeris {
    /// Determined position, IRF, m.
    pub r_sc_irf_m: Vector3<f64>,
    /// Velocity, IRF, m/s.
    pub v_sc_irf_m_s: Vector3<f64>,
    /// `ω_CI`, CRF, rad/s.
    pub omega_crf_rad_s: Vector3<f64>,
    /// `ω̇_CI`, CRF, rad/s².
    pub alpha_crf_rad_s2: Vector3<f64>,
    /// Unit vector from the Sun to the spacecraft, SRF taken as CRF.
    pub sun_srf: Vector3<f64>,
}

/// The running loop.
pub struct Simulator {
    settings: Settings,
    dt_s: f64,
    ephemeris_every: i64,
    /// Epoch of the first sample, before zero by the settling time.
    first: i64,
    plant: Plant,
    law: ControlLaw,
    noises: Noises,
    rng: Xoshiro256PlusPlus,
    effects: Effects,
    inside: Running,
    /// The plant with its initial geometry.
    begun: Plant,
    offset_orf_m: PerTestMass<Vector3<f64>>,
    /// `k_dSC` and its arm.
    sunlight: Option<(f64, Vector3<f64>)>,
    /// `None` if the thrusters apply the command.
    thrusters: Option<Thrusters>,
    actuators: Option<Actuators>,
    limits: Option<Limits>,
    self_gravity: Vec<SelfGravity>,
    /// Names of the test masses.
    names: Vec<String>,
    /// Error of the determined orbit, IRF, and an equal one for the Sun's direction, CRF, m.
    orbit_error_irf_m: Vector3<f64>,
    sun_error_crf: Vector3<f64>,
    state: State,
    index: i64,
    constellation: Constellation,
    /// Surroundings at the last packet, and the epoch of it.
    environment: Environment,
    environment_index: i64,
    gradient_orf_s2: PerTestMass<Matrix3<f64>>,
}

/// Residual gravity of the spacecraft at a test mass.
struct SelfGravity {
    acceleration_orf_m_s2: Vector3<f64>,
    drift_orf_m_s3: Vector3<f64>,
    angular_acceleration_orf_rad_s2: Vector3<f64>,
}

/// State of the simulation.
#[derive(Serialize, Deserialize)]
struct Snapshot {
    index: i64,
    environment_index: i64,
    rng: Xoshiro256PlusPlus,
    state: Vec<f64>,
    noises: Vec<f64>,
    law: Vec<f64>,
    effects: Vec<Saved>,
    inside: SavedInterior,
    thrusters: Option<SavedThrusters>,
}

/// True quantities at the next epoch, borrowed field by field because the effects are borrowed mutably.
macro_rules! now {
    ($simulator:expr, $sunlight:expr) => {
        Moment {
            elapsed_s: $simulator.index as f64 * $simulator.dt_s,
            dt_s: $simulator.dt_s,
            state: &$simulator.state,
            plant: &$simulator.plant,
            inside: &$simulator.inside.now,
            omega_crf_rad_s: $simulator.environment.omega_crf_rad_s,
            sunlight_srf_n: $sunlight,
        }
    };
}

impl Simulator {
    /// Closes the loop and lets it settle.
    ///
    /// # Errors
    /// [`SimulationError`]: a section is missing, or the loop diverges while it settles.
    pub fn new(mission: &Mission, settings: Settings) -> Result<Self, SimulationError> {
        refuse_unstable(mission)?;
        // Constants and noise have separate streams, so that a parameter changes no noise.
        let mut once = Xoshiro256PlusPlus::seed_from_u64(settings.seed);
        let mut rng = once.clone();
        rng.jump();

        let range = settings.stiffness_error;
        let mut factors = || -> [Matrix3<f64>; 3] {
            std::array::from_fn(|_| Matrix3::from_fn(|_, _| 1.0 + range * (2.0 * once.random::<f64>() - 1.0)))
        };
        let stiffness: Vec<_> = mission.test_mass.iter().map(|_| factors()).collect();
        let mut plant = Plant::new(mission, &settings.com_offset_srf_m, &stiffness)?;
        let mut effects = Effects::new(&settings.effects, &Basis { mission }, settings.seed)?;
        effects.begin(&mut plant);
        let mut uniform = |limit: f64| limit * (2.0 * once.random::<f64>() - 1.0);
        let bounds = &mission.self_gravity;
        let mut self_gravity = || SelfGravity {
            acceleration_orf_m_s2: Vector3::from_fn(|i, _| uniform(bounds.acceleration_orf_m_s2[i])),
            drift_orf_m_s3: Vector3::from_fn(|_, _| uniform(bounds.drift_m_s2_day / DAY_S)),
            angular_acceleration_orf_rad_s2: Vector3::from_fn(|_, _| uniform(bounds.angular_acceleration_rad_s2)),
        };
        let self_gravity: Vec<_> = mission.test_mass.iter().map(|_| self_gravity()).collect();
        let orbit_sigma = mission.solar_pressure.as_ref().map_or(0.0, |s| s.orbit_error_m);
        let mut gauss = |sigma: f64| Vector3::from_fn(|_, _| sigma * normal(&mut once));
        let orbit_error_irf_m = gauss(orbit_sigma);
        // The orbit's error is isotropic, so the components in CRF may be drawn independently.
        let sun_error_crf = gauss(orbit_sigma);
        let sc = gauss(INITIAL_SIGMA);
        let tm: Vec<_> = mission.test_mass.iter().map(|_| (gauss(INITIAL_SIGMA), gauss(INITIAL_SIGMA))).collect();

        let mut noises = Noises::new(mission)?;
        noises.start(&mut rng);
        if effects.replace_thruster_noise() {
            noises.silence_thrusters();
        }
        let shown = noises.slow_readout();

        let dt_s = mission.dt_s();
        let first = -(settings.settle_s / dt_s).round() as i64;
        let constellation = Constellation::new(mission)?;
        let first_ns = epoch_ns(settings.start_ns, first, dt_s);
        constellation.check("the start of the simulation (settling included),", first_ns)?;
        let environment = constellation.at(first_ns)?;
        let outside = Outside {
            omega_crf_rad_s: environment.omega_crf_rad_s,
            alpha_crf_rad_s2: environment.alpha_crf_rad_s2,
            gradient_orf_s2: gradient_orf(&plant, &environment),
        };
        let at = tm.iter().zip(&shown.tm).map(|((r, angle), shown)| (r - shown.r_orf_m, angle - shown.att_orf_rad));
        let at: Vec<_> = at.collect();
        let state = State::at_rest(&(sc - shown.sc_crf_rad), &at, &plant, &outside);
        let influences = Influences {
            sun_distance_m: environment.r_sc_irf_m.norm(),
            sun_srf: environment.sun_crf,
            opening_rad: environment.opening_angle_rad,
        };
        let (begun, offset_orf_m) = (plant.clone(), offsets(&plant));
        let mut simulator = Self {
            dt_s,
            ephemeris_every: (EPHEMERIS_S / dt_s).round().max(1.0) as i64,
            first,
            plant,
            law: ControlLaw::new(mission)?,
            noises,
            rng,
            effects,
            inside: Running::new(settings.seed, dt_s, mission.test_mass.len(), &influences),
            begun,
            offset_orf_m,
            sunlight: mission.solar_pressure.as_ref().map(|s| (s.force_n, Vector3::from(s.arm_srf_m))),
            thrusters: mission.thrusters.as_ref().map(|t| Thrusters::new(t, dt_s, settings.seed)).transpose()?,
            actuators: mission.actuators.clone(),
            limits: mission.limits.clone(),
            self_gravity,
            names: mission.test_mass.keys().cloned().collect(),
            orbit_error_irf_m,
            sun_error_crf,
            state,
            index: first,
            constellation,
            environment,
            environment_index: first,
            gradient_orf_s2: outside.gradient_orf_s2,
            settings,
        };
        if simulator.effects.moves() {
            simulator.reshape();
            // The first change of the geometry does not move the test masses.
            simulator.state = state;
        }
        while simulator.index < 0 {
            simulator.step()?;
        }
        Ok(simulator)
    }

    /// Time of the coming epoch, Unix ns.
    pub fn time_ns(&self) -> i64 {
        epoch_ns(self.settings.start_ns, self.index, self.dt_s)
    }

    /// Number of the coming epoch.
    pub fn index(&self) -> i64 {
        self.index
    }

    /// The true state at the coming epoch.
    pub fn state(&self) -> &State {
        &self.state
    }

    /// The true plant, for the constants of the truth and for tests.
    pub fn plant(&self) -> &Plant {
        &self.plant
    }

    /// The orbits.
    pub fn constellation(&self) -> &Constellation {
        &self.constellation
    }

    /// Runs one epoch.
    ///
    /// # Errors
    /// [`SimulationError::Diverged`], and [`SimulationError::Orbit`] beyond the ephemeris.
    pub fn step(&mut self) -> Result<Epoch, SimulationError> {
        let (index, time_ns) = (self.index, self.time_ns());
        let packet = index.rem_euclid(self.ephemeris_every) == 0;
        if packet {
            self.surroundings(index)?;
        }
        let ephemeris = self.ephemeris();
        let mut measured = self.noises.measure(&self.state, &mut self.rng);
        self.effects.read(&now!(self, Vector3::zeros()), &mut measured);
        if let Some(limits) = &self.limits {
            measured.saturate(limits);
        }
        let response = self.law.step(&measured.readout(Some(ephemeris.sun_srf)));
        let command = self.with_manoeuvres(response);
        let (loads, outside) = (self.loads(&command), self.outside());
        let before = self.state;
        let means = self.plant.step(&mut self.state, &loads, &outside, self.dt_s);
        let offset_orf_m = self.offset_orf_m;
        self.index += 1;
        self.check()?;
        if self.inside.due(self.index) {
            let influences = self.influences();
            self.inside.step(self.index, &influences);
        }
        if self.effects.moves() {
            self.reshape();
        }
        Ok(Epoch {
            index,
            time_ns,
            measured,
            command,
            at_limit: self.at_limit(&command),
            truth: Truth {
                r_orf_m: before.tm.map(|tm| tm.r_orf_m),
                sc_crf_rad: before.sc_crf_rad(),
                omega_srf_rad_s: before.omega_srf_rad_s,
                alpha_srf_rad_s2: means.alpha_srf_rad_s2,
                nongrav_srf_m_s2: means.nongrav_srf_m_s2,
                offset_orf_m,
            },
            ephemeris: packet.then_some(ephemeris),
        })
    }

    /// The command with the manoeuvres, within the actuators' limits.
    fn with_manoeuvres(&self, mut command: Command) -> Command {
        let elapsed_s = self.index as f64 * self.dt_s;
        self.settings.manoeuvres.iter().for_each(|m| m.add(elapsed_s, &mut command));
        match &self.actuators {
            Some(limits) if !self.settings.manoeuvres.is_empty() => command.limited(limits),
            _ => command,
        }
    }

    /// Updates the surroundings at an epoch.
    fn surroundings(&mut self, index: i64) -> Result<(), OrbitError> {
        self.environment = self.constellation.at(epoch_ns(self.settings.start_ns, index, self.dt_s))?;
        self.environment_index = index;
        self.gradient_orf_s2 = gradient_orf(&self.plant, &self.environment);
        Ok(())
    }

    /// The last packet.
    fn ephemeris(&self) -> Ephemeris {
        let e = &self.environment;
        let distance_m = e.r_sc_irf_m.norm();
        Ephemeris {
            r_sc_irf_m: e.r_sc_irf_m + self.orbit_error_irf_m,
            v_sc_irf_m_s: e.v_sc_irf_m_s,
            omega_crf_rad_s: e.omega_crf_rad_s,
            alpha_crf_rad_s2: e.alpha_crf_rad_s2,
            sun_srf: (e.sun_crf + self.sun_error_crf / distance_m).normalize(),
        }
    }

    /// The current surroundings: `ω_CI` extrapolated linearly from the last packet; `Γ` held, with SRF taken as CRF.
    fn outside(&self) -> Outside {
        let e = &self.environment;
        let since_s = self.since_packet_s();
        Outside {
            omega_crf_rad_s: e.omega_crf_rad_s + e.alpha_crf_rad_s2 * since_s,
            alpha_crf_rad_s2: e.alpha_crf_rad_s2,
            gradient_orf_s2: self.gradient_orf_s2,
        }
    }

    /// The inside of the spacecraft at the coming epoch.
    pub fn inside(&self) -> &Interior {
        &self.inside.now
    }

    /// The housings relative to the centre of mass at the coming epoch, each in its ORF, m.
    pub fn offset_orf_m(&self) -> &[Vector3<f64>] {
        &self.offset_orf_m
    }

    /// Seconds since the surroundings were updated.
    fn since_packet_s(&self) -> f64 {
        (self.index - self.environment_index) as f64 * self.dt_s
    }

    /// External inputs of the interior.
    fn influences(&self) -> Influences {
        let e = &self.environment;
        Influences {
            sun_distance_m: e.r_sc_irf_m.norm(),
            sun_srf: turn(&self.state.q_srf_from_crf, &e.sun_crf),
            opening_rad: e.opening_angle_rad + e.opening_rate_rad_s * self.since_packet_s(),
        }
    }

    /// Updates the geometry to the next epoch. A drift of the centre of mass moves the housings against the test
    /// masses.
    fn reshape(&mut self) {
        let elapsed_s = self.index as f64 * self.dt_s;
        let mut plant = self.begun.clone();
        self.effects.reshape(elapsed_s, &self.inside.now, &mut plant);
        for ((tm, new), old) in self.state.tm.iter_mut().zip(&plant.tm).zip(&self.plant.tm) {
            tm.r_orf_m -= new.dcm_orf_from_srf * (new.offset_srf_m - old.offset_srf_m);
        }
        self.plant = plant;
        self.offset_orf_m = offsets(&self.plant);
    }

    /// True loads over the next sample.
    fn loads(&mut self, command: &Command) -> Loads {
        let elapsed_s = self.index as f64 * self.dt_s;
        let mut acting = self.effects.act(elapsed_s, command);
        if let Some(thrusters) = &mut self.thrusters {
            (acting.mps_force_srf_n, acting.mps_torque_srf_nm) =
                thrusters.act(&acting.mps_force_srf_n, &acting.mps_torque_srf_nm);
        }
        let mut loads = Loads {
            force_srf_n: acting.mps_force_srf_n,
            torque_srf_nm: acting.mps_torque_srf_nm,
            ..Loads::zero(self.plant.tm.len())
        };
        for ((load, acting), own) in loads.tm.iter_mut().zip(&acting.tm).zip(&self.self_gravity) {
            load.force_orf_n = acting.force_orf_n;
            load.torque_orf_nm = acting.torque_orf_nm;
            load.acceleration_orf_m_s2 = own.acceleration_orf_m_s2 + own.drift_orf_m_s3 * elapsed_s;
            load.angular_acceleration_orf_rad_s2 = own.angular_acceleration_orf_rad_s2;
        }
        let flicker_n = self.noises.disturb(&mut loads);
        let mut sunlight_srf_n = Vector3::zeros();
        if let Some((force_n, arm)) = &self.sunlight {
            // eq:SRP_transfer_function and eq:SRP_torque; the printed matrix is the arm's cross product.
            sunlight_srf_n = turn(&self.state.q_srf_from_crf, &self.environment.sun_crf) * (force_n + flicker_n);
            loads.force_srf_n += sunlight_srf_n;
            loads.torque_srf_nm += arm.cross(&sunlight_srf_n);
        }
        self.effects.push(&now!(self, sunlight_srf_n), &mut loads);
        self.inside.thrust(&acting.mps_force_srf_n);
        loads
    }

    fn at_limit(&self, command: &Command) -> bool {
        self.actuators.as_ref().is_some_and(|limits| command.reaches(limits))
            || self.thrusters.as_ref().is_some_and(Thrusters::saturated)
    }

    fn check(&self) -> Result<(), SimulationError> {
        if self.state.is_within(LOST_M, LOST_RAD) {
            return Ok(());
        }
        let worst =
            |v: &Vector3<f64>, limit: f64| (0..3).find(|i| v[*i].is_nan() || v[*i].abs() > limit).map(|i| (i, v[i]));
        let lost = |what: String, value: f64, unit: &'static str| SimulationError::Diverged {
            elapsed_s: (self.index - self.first) as f64 * self.dt_s,
            what,
            value,
            unit,
        };
        for (name, tm) in self.names.iter().zip(&self.state.tm) {
            if let Some((axis, value)) = worst(&tm.r_orf_m, LOST_M) {
                return Err(lost(format!("{name}.{}", AXES[axis]), value, "m"));
            }
            if let Some((axis, value)) = worst(&rotation_vector(&tm.q_mrf_from_orf), LOST_RAD) {
                return Err(lost(format!("{name}.{}", ANGLES[axis]), value, "rad"));
            }
        }
        match worst(&self.state.sc_crf_rad(), LOST_RAD) {
            Some((axis, value)) => Err(lost(format!("{SPACECRAFT}.{}", ANGLES[axis]), value, "rad")),
            None => Ok(()),
        }
    }

    /// The state as JSON, which keeps every bit of a float.
    ///
    /// # Errors
    /// Never in practice: no number of a running loop is infinite.
    pub fn save(&self) -> Result<Vec<u8>, SimulationError> {
        let snapshot = Snapshot {
            index: self.index,
            environment_index: self.environment_index,
            rng: self.rng.clone(),
            state: self.state.to_numbers(),
            noises: self.noises.states(),
            law: self.law.state(),
            effects: self.effects.save(),
            inside: self.inside.save(),
            thrusters: self.thrusters.as_ref().map(Thrusters::save),
        };
        serde_json::to_vec(&snapshot).map_err(|e| SimulationError::State(e.to_string()))
    }

    /// Restores a state.
    ///
    /// # Errors
    /// [`SimulationError::State`] when the bytes are not a state of this simulation.
    pub fn load(&mut self, bytes: &[u8]) -> Result<(), SimulationError> {
        let refuse = |what: &str| SimulationError::State(what.to_owned());
        let snapshot: Snapshot = serde_json::from_slice(bytes).map_err(|e| refuse(&e.to_string()))?;
        let state = State::from_numbers(&snapshot.state, self.plant.tm.len())
            .ok_or_else(|| refuse("the plant has other states"))?;
        if !self.noises.set_states(&snapshot.noises) {
            return Err(refuse("the noise has other states"));
        }
        if !self.effects.load(&snapshot.effects) || !self.inside.load(&snapshot.inside) {
            return Err(refuse("the effects or the inside of the spacecraft have other states"));
        }
        let fits = match (&mut self.thrusters, snapshot.thrusters) {
            (Some(thrusters), Some(saved)) => thrusters.load(saved),
            (thrusters, saved) => thrusters.is_none() && saved.is_none(),
        };
        if !fits {
            return Err(refuse("the thrusters have other states"));
        }
        self.law.set_state(&snapshot.law).map_err(|e| refuse(&e.to_string()))?;
        (self.index, self.rng) = (snapshot.index, snapshot.rng);
        // The geometry first, because it moves the test masses of the current state.
        self.reshape();
        self.state = state;
        Ok(self.surroundings(snapshot.environment_index)?)
    }
}

/// `b_i` in ORF.
fn offsets(plant: &Plant) -> PerTestMass<Vector3<f64>> {
    plant.tm.iter().map(|tm| tm.dcm_orf_from_srf * tm.offset_srf_m).collect()
}

/// Excess of a channel's growth per sample over one that counts as rounding: a channel without control drifts.
const DRIFTING: f64 = 1e-6;

/// Refuses controllers of the mission file that do not stabilise their channel.
fn refuse_unstable(mission: &Mission) -> Result<(), SimulationError> {
    let Some(control) = &mission.control else { return Ok(()) };
    let delay_samples = control.delay_samples;
    for (channel, controller) in &control.channel {
        let growth = growth_per_sample(controller, delay_samples, mission.dt_s()).unwrap_or(f64::NAN);
        if growth.is_nan() || growth > 1.0 + DRIFTING {
            return Err(SimulationError::Unstable { channel: channel.clone(), growth, delay_samples });
        }
    }
    Ok(())
}

/// `Γ` in each ORF, for SRF on CRF.
fn gradient_orf(plant: &Plant, environment: &Environment) -> PerTestMass<Matrix3<f64>> {
    let of = |t: &Matrix3<f64>| t * environment.gradient_crf_s2 * t.transpose();
    plant.tm.iter().map(|tm| of(&tm.dcm_orf_from_srf)).collect()
}

/// Time of an epoch, Unix ns, to the nearest nanosecond whatever the rate.
fn epoch_ns(start_ns: i64, index: i64, dt_s: f64) -> i64 {
    // Whole seconds separately, because nanoseconds of weeks exceed the resolution of a double.
    let rate_hz = 1.0 / dt_s;
    let seconds = (index as f64 / rate_hz).floor();
    let rest_s = (index as f64 - seconds * rate_hz) / rate_hz;
    start_ns + seconds as i64 * 1_000_000_000 + (rest_s * 1e9).round() as i64
}
