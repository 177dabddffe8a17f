//! From telemetry on the grid to the `reconstruction` table, epoch by epoch.

use dragfree_physics::control::{Command, ControlLaw, PerTestMass};
use dragfree_physics::few::Few;
use dragfree_physics::mission::{MOST_TEST_MASSES, Mission, MissionError, TestMass};
use dragfree_physics::thrust_noise::ThrustNoise;
use dragfree_sdk::state::{State, StateError};
use nalgebra::{Matrix3, Vector3};

use crate::bridge::{LONGEST, bridge};
use crate::known::{KnownModel, KnownMotion};
use crate::noise_calibration::NoiseScale;
use crate::on_demand::{Availability, Needs, OnDemand};
use crate::replay::{CommandNumbers, Comparison, Held, ReadoutNumbers, Replay, electrodes_of, visit_command};
use crate::smoother::{Model, Smoothed, Smoother};
use crate::thruster_response::ThrusterResponse;

const NEEDED_BY: &str = "hinf-dfacs";
/// Where the angular acceleration comes from. Only the smoother gives an unbiased calibration (physics.md §4).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum AngularAcceleration {
    /// `E[α | all wavefront sensing, all commands]`.
    Smoother,
    /// The commanded torque alone: the loop makes the thrusters' noise a part of the command, which biases `b_x`.
    Commanded,
    /// Second difference of the attitude alone: errors in variables pull the offset to zero.
    SecondDifference,
}

/// How to reconstruct.
#[derive(Clone, Copy, Debug)]
pub struct Settings {
    /// Rate of the grid, Hz.
    pub rate_hz: f64,
    /// Source of `α̂`.
    pub angular_acceleration: AngularAcceleration,
    /// Commands are telemetered.
    pub commands: bool,
    /// The Sun's direction is telemetered.
    pub sun: bool,
    /// Replay the control law: where commands are missing, and beside those that are there.
    pub replay: bool,
    /// Time after which a replayed control law counts as settled, s.
    pub warm_up_s: f64,
    /// Levels of the noise against the mission file.
    pub scale: NoiseScale,
    /// Columns on demand.
    pub needs: Needs,
}

/// Telemetry at `t_k`; NaN where there is none.
#[derive(Clone, Copy, Debug, Default)]
pub struct Epoch {
    /// Unix ns.
    pub time_ns: i64,
    /// Best readouts, in the order of [`Mission::channels`], m and rad.
    pub readout: ReadoutNumbers,
    /// What acts over `[t_k, t_{k+1})`, in the order of [`crate::replay::command_vectors`], N and N m.
    pub command: CommandNumbers,
    /// Unit vector from the Sun to the spacecraft, SRF.
    pub sun_srf: Vector3<f64>,
    /// How old the latest packet of the ephemeris is, s; NaN if not telemetered.
    pub ephemeris_age_s: f64,
    /// `ω_CI`, CRF, rad s⁻¹.
    pub omega_crf_rad_s: Vector3<f64>,
    /// `ω̇_CI`, CRF, rad s⁻².
    pub alpha_crf_rad_s2: Vector3<f64>,
}

impl Epoch {
    /// Every field, of a mission with so many test masses.
    pub(crate) fn visit(&mut self, test_masses: usize, state: &mut State<'_>) -> Result<(), StateError> {
        if state.is_loading() {
            self.readout = ReadoutNumbers::from_fn(3 + 6 * test_masses, |_| 0.0);
        }
        state.i64(&mut self.time_ns)?;
        state.f64s(self.readout.iter_mut())?;
        visit_command(state, 6 + 6 * test_masses, &mut self.command)?;
        state.f64s(self.sun_srf.iter_mut())?;
        state.f64(&mut self.ephemeris_age_s)?;
        state.f64s(self.omega_crf_rad_s.iter_mut())?;
        state.f64s(self.alpha_crf_rad_s2.iter_mut())
    }
}

/// Values in a row of the `reconstruction` table, of a mission with so many test masses.
pub fn row_length(test_masses: usize) -> usize {
    9 + 9 * test_masses
}

/// A row: `α̂` (3), `ω̂` (3), `r` (3) and `û` (3) of each test mass, then the channels `NAME.accel` (3) of each and
/// `sc.alpha` (3).
#[derive(Clone, Debug, PartialEq)]
pub struct Row {
    /// Unix ns.
    pub time_ns: i64,
    /// Values, NaN where there is none.
    pub values: Few<f64, { 9 + 9 * MOST_TEST_MASSES }>,
    /// Values of the columns on demand, in the order of [`Reconstruction::on_demand_columns`].
    pub on_demand: Vec<f64>,
}

impl Row {
    /// The channels of the spacecraft's attitude, `sc.alpha`, rad s⁻².
    pub fn attitude_channels(&self) -> [f64; 3] {
        let values = &self.values[self.values.len() - 3..];
        [values[0], values[1], values[2]]
    }
}

/// What happened to how many epochs.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counts {
    /// All.
    pub epochs: u64,
    /// With a telemetered command.
    pub commands_telemetered: u64,
    /// With a replayed one.
    pub commands_replayed: u64,
    /// Without any.
    pub commands_missing: u64,
    /// Without a direction of the Sun, though sunlight is modelled and telemetered.
    pub sun_missing: u64,
    /// Without the spacecraft's attitude.
    pub attitude_missing: u64,
    /// With a command that lacks the electrodes of one test mass.
    pub commands_of_one_test_mass: u64,
    /// Readouts (axes) bridged in the channels.
    pub readouts_bridged: u64,
    /// So far from any attitude that nothing but the command is known of the angular acceleration.
    pub blind: u64,
}

/// What there is of a test mass in an epoch that waits for the smoother, ORF.
#[derive(Clone, Copy, Debug, Default)]
struct PendingTestMass {
    r_orf_m: Vector3<f64>,
    /// The same with short holes bridged.
    bridged_orf_m: Vector3<f64>,
    u_orf_m_s2: Vector3<f64>,
}

/// An epoch that waits for the smoother.
#[derive(Clone, Copy, Debug, Default)]
struct Pending {
    time_ns: i64,
    attitude_rad: Vector3<f64>,
    /// The same with short holes bridged.
    bridged_rad: Vector3<f64>,
    tm: PerTestMass<PendingTestMass>,
    /// Commanded, relative to IRF.
    alpha_known_rad_s2: Vector3<f64>,
    /// `ω̇_SI − ω̇_SC = T ω̇_CI − ω_SC×(T ω_CI)`.
    frame_rad_s2: Vector3<f64>,
    omega_ci_rad_s: Vector3<f64>,
}

impl Pending {
    /// A bridged readout by its place: attitude, then the displacements of each test mass.
    fn bridged(&self, place: usize) -> f64 {
        if place < 3 { self.bridged_rad[place] } else { self.tm[place / 3 - 1].bridged_orf_m[place % 3] }
    }

    fn bridge(&mut self, place: usize, value: f64) {
        let vector = if place < 3 { &mut self.bridged_rad } else { &mut self.tm[place / 3 - 1].bridged_orf_m };
        vector[place % 3] = value;
    }

    fn vectors(&mut self) -> impl Iterator<Item = &mut Vector3<f64>> {
        let spacecraft = [
            &mut self.attitude_rad,
            &mut self.bridged_rad,
            &mut self.alpha_known_rad_s2,
            &mut self.frame_rad_s2,
            &mut self.omega_ci_rad_s,
        ];
        let test_masses =
            self.tm.iter_mut().flat_map(|tm| [&mut tm.r_orf_m, &mut tm.bridged_orf_m, &mut tm.u_orf_m_s2]);
        spacecraft.into_iter().chain(test_masses)
    }

    fn visit(&mut self, test_masses: usize, state: &mut State<'_>) -> Result<(), StateError> {
        if state.is_loading() {
            self.tm = PerTestMass::from_fn(test_masses, |_| PendingTestMass::default());
        }
        state.i64(&mut self.time_ns)?;
        self.vectors().try_for_each(|v| state.f64s(v.iter_mut()))
    }
}

/// The running reconstruction.
pub struct Reconstruction {
    rate_hz: f64,
    angular_acceleration: AngularAcceleration,
    needs_sun: bool,
    known: KnownModel,
    /// `−T_S^{O_i} C J/m_S`: the acceleration of each test mass, ORF, by the force that comes with the thrusters'
    /// torque, from what that torque does to the spacecraft, SRF; m s⁻² per rad s⁻².
    push_per_turn: Vec<Matrix3<f64>>,
    smoother: Smoother,
    replay: Option<Replay>,
    held: Held,
    acting: ThrusterResponse,
    /// At the epoch, and as the last packet told it: on board the feed-forward holds the packet.
    sun_srf: Option<Vector3<f64>>,
    packet_sun_srf: Option<Vector3<f64>>,
    omega_ci_rad_s: Vector3<f64>,
    alpha_ci_rad_s2: Vector3<f64>,
    pending: Vec<Pending>,
    /// Samples from the last attitude to the last epoch that left; infinite before the first.
    since_attitude: f64,
    /// The epoch before the first pending one.
    previous: Option<Pending>,
    /// `None` where nothing is asked for.
    on_demand: Option<OnDemand>,
    counts: Counts,
}

fn finite(v: &Vector3<f64>) -> Option<Vector3<f64>> {
    v.iter().all(|x| x.is_finite()).then_some(*v)
}

/// The smoother's model: what the thrusters' noise does to the angular acceleration, and what the sensors see of it.
fn model(mission: &Mission, noise: &ThrustNoise, settings: &Settings) -> Result<Model, MissionError> {
    let inverse = mission.spacecraft.inertia_inverse();
    let torque = noise.torque * noise.torque_shape.white_psd();
    let mut sensing = Mission::need(&mission.noise.dws_long_arm, "noise.dws_long_arm", NEEDED_BY)?.shape();
    sensing.terms.iter_mut().for_each(|term| term.asd *= settings.scale.sensing.sqrt());
    let refuse = |key: &str, psd: f64| {
        let reason = "must be above zero: it is what weighs wavefront sensing against commands";
        Err(MissionError::Value { key: key.to_owned(), value: psd.sqrt().to_string(), reason })
    };
    let levels = torque.symmetric_eigenvalues();
    if levels.min() <= 1e-9 * levels.max() {
        let units = mission.thrusters.as_ref().is_some_and(|t| !t.unit.is_empty());
        let key = if units { "thrusters.unit.asd_n_rthz" } else { "noise.thruster_torque.asd_nm_rthz" };
        return refuse(key, levels.min().max(0.0));
    }
    if sensing.white_psd() <= 0.0 {
        return refuse("noise.dws_long_arm.asd_rad_rthz", 0.0);
    }
    let loud = Matrix3::from_diagonal(&settings.scale.torque.map(f64::sqrt));
    Ok(Model::new(&(loud * inverse * torque * inverse.transpose() * loud), &sensing, 1.0 / settings.rate_hz))
}

/// One-sided PSDs of the mission file: what the thrusters' torque does to the angular acceleration about each axis of
/// SRF, rad² s⁻⁴/Hz, and the white part of the attitude's sensing, rad²/Hz; `None` where it tells neither.
pub fn levels_of(mission: &Mission) -> Option<(Vector3<f64>, f64)> {
    let noise = ThrustNoise::of(mission)?;
    let inverse = mission.spacecraft.inertia_inverse();
    let torque = noise.torque * noise.torque_shape.white_psd();
    let sensing = mission.noise.dws_long_arm.as_ref()?.shape().white_psd();
    Some(((inverse * torque * inverse.transpose()).diagonal(), sensing))
}

impl Reconstruction {
    /// Builds the stage for a mission.
    ///
    /// # Errors
    /// [`MissionError`] when the mission lacks test masses, the noise of the thrusters' torque or of the long-arm
    /// wavefront sensing, or, with `settings.replay`, a control law.
    pub fn new(mission: &Mission, settings: &Settings) -> Result<Self, MissionError> {
        let missing = || MissionError::Missing { section: "noise.thruster_torque".to_owned(), needed_by: NEEDED_BY };
        let noise = ThrustNoise::of(mission).filter(|n| !n.torque_shape.terms.is_empty()).ok_or_else(missing)?;
        let model = model(mission, &noise, settings)?;
        let known = KnownModel::new(mission)?;
        let test_masses = mission.test_mass.len();
        let force_per_turn = noise.force_per_torque * mission.spacecraft.inertia();
        let push = |tm: &TestMass| tm.dcm_orf_from_srf() * force_per_turn / -mission.spacecraft.mass_kg;
        let push_per_turn: Vec<_> = mission.test_mass.values().map(push).collect();
        let replay = if settings.replay {
            let (law, numbers) = (ControlLaw::new(mission)?, 6 + 6 * test_masses);
            Some(Replay::new(law, numbers, !settings.commands, settings.warm_up_s, settings.rate_hz))
        } else {
            None
        };
        let on_demand = || OnDemand::new(settings.needs, mission, push_per_turn.clone());
        Ok(Self {
            rate_hz: settings.rate_hz,
            angular_acceleration: settings.angular_acceleration,
            needs_sun: settings.sun && mission.solar_pressure.is_some(),
            on_demand: (settings.needs != Needs::default()).then(on_demand),
            push_per_turn,
            known,
            smoother: Smoother::new(model),
            replay,
            held: Held::new(3 + 6 * test_masses),
            acting: ThrusterResponse::new(mission, 1.0 / settings.rate_hz),
            sun_srf: None,
            packet_sun_srf: None,
            omega_ci_rad_s: Vector3::zeros(),
            alpha_ci_rad_s2: Vector3::zeros(),
            pending: Vec::new(),
            since_attitude: f64::INFINITY,
            previous: None,
            counts: Counts::default(),
        })
    }

    /// Takes one epoch; `rows` gains those whose lag has passed.
    ///
    /// Small angles: SRF and CRF differ by the attitude error, 1e-8 rad, so `T_C^S = 1` and the three angles are a
    /// vector whose second derivative is the angular acceleration relative to CRF.
    ///
    /// # Errors
    /// [`StateError`] when the control law does not take back its own state.
    pub fn push(&mut self, epoch: &Epoch, rows: &mut Vec<Row>) -> Result<(), StateError> {
        self.counts.epochs += 1;
        self.held.take(&epoch.readout);
        // The ephemeris comes once a minute; what it tells moves by 1e-5 in that time.
        self.sun_srf = finite(&epoch.sun_srf).or(self.sun_srf);
        let held = epoch.ephemeris_age_s >= 1.0 / self.rate_hz && self.packet_sun_srf.is_some();
        if !held {
            self.packet_sun_srf = self.sun_srf;
        }
        self.omega_ci_rad_s = finite(&epoch.omega_crf_rad_s).unwrap_or(self.omega_ci_rad_s);
        self.alpha_ci_rad_s2 = finite(&epoch.alpha_crf_rad_s2).unwrap_or(self.alpha_ci_rad_s2);

        let attitude_rad = Vector3::from_column_slice(&epoch.readout[..3]);
        let attitude = finite(&attitude_rad);
        self.counts.attitude_missing += u64::from(attitude.is_none());
        let omega_sc = self.smoother.update(attitude.as_ref());
        let frame_rad_s2 = self.alpha_ci_rad_s2 - omega_sc.cross(&self.omega_ci_rad_s);

        let motion = self.known_motion(epoch, &(omega_sc + self.omega_ci_rad_s))?;
        self.smoother.advance(motion.map(|m| m.alpha_srf_rad_s2 - frame_rad_s2).as_ref());
        let missing = Vector3::from_element(f64::NAN);
        let tm = epoch.readout[3..].chunks_exact(6).enumerate().map(|(i, readout)| {
            let r_orf_m = Vector3::from_column_slice(&readout[..3]);
            let u_orf_m_s2 = motion.map_or(missing, |m| m.u_orf_m_s2[i]);
            PendingTestMass { r_orf_m, bridged_orf_m: r_orf_m, u_orf_m_s2 }
        });
        self.pending.push(Pending {
            time_ns: epoch.time_ns,
            attitude_rad,
            bridged_rad: attitude_rad,
            tm: tm.collect(),
            alpha_known_rad_s2: motion.map_or(missing, |m| m.alpha_srf_rad_s2),
            frame_rad_s2,
            omega_ci_rad_s: self.omega_ci_rad_s,
        });
        self.bridge();
        if self.smoother.waiting() == 2 * self.lag() {
            self.emit(self.lag(), rows);
        }
        Ok(())
    }

    /// Fills a hole that the two newest epochs end. At least a lag of epochs is always pending, longer than any bridge.
    fn bridge(&mut self) {
        let end = self.pending.len();
        for place in 0..3 + 3 * self.push_per_turn.len() {
            let at = |back: usize| end.checked_sub(back).map_or(f64::NAN, |k| self.pending[k].bridged(place));
            if !(at(1).is_finite() && at(2).is_finite() && at(3).is_nan()) {
                continue;
            }
            let missing = (3..).take_while(|back| end >= *back && at(*back).is_nan()).take(LONGEST + 1).count();
            let before = [at(missing + 4), at(missing + 3)];
            if missing > LONGEST || before.iter().any(|x| !x.is_finite()) {
                continue;
            }
            let after = [at(2), at(1)];
            for (k, value) in (end - 2 - missing..).zip(bridge(before, after, missing)) {
                self.pending[k].bridge(place, value);
                self.counts.readouts_bridged += 1;
            }
        }
    }

    /// There are no more epochs: gives what waits.
    pub fn finish(&mut self, rows: &mut Vec<Row>) {
        self.emit(self.pending.len(), rows);
    }

    fn needs(&self) -> Needs {
        self.on_demand.as_ref().map(OnDemand::needs).unwrap_or_default()
    }

    fn known_motion(
        &mut self,
        epoch: &Epoch,
        omega_srf_rad_s: &Vector3<f64>,
    ) -> Result<Option<KnownMotion>, StateError> {
        let telemetered = epoch.command.iter().all(|x| x.is_finite()).then_some(&epoch.command);
        let replayed = match &mut self.replay {
            Some(replay) => replay.step(&self.held, self.packet_sun_srf, telemetered)?,
            None => None,
        };
        let counter = match (telemetered, &replayed) {
            (Some(_), _) => &mut self.counts.commands_telemetered,
            (None, Some(_)) => &mut self.counts.commands_replayed,
            (None, None) => &mut self.counts.commands_missing,
        };
        *counter += 1;
        // Without the electrodes' commands of one test mass, the others and the spacecraft go on: the recoil on the
        // spacecraft, 1e-9 N, is a thousandth of the thrusters' noise.
        let without = |tm: usize| -> Option<CommandNumbers> {
            let theirs = electrodes_of(tm);
            let given = |i: usize| if theirs.contains(&i) { 0.0 } else { epoch.command[i] };
            let others = CommandNumbers::from_fn(epoch.command.len(), given);
            others.iter().all(|x| x.is_finite()).then_some(others)
        };
        let mut unknown = None;
        let commanded = telemetered.copied().or(replayed).or_else(|| {
            unknown = (0..self.push_per_turn.len()).find(|tm| without(*tm).is_some());
            unknown.and_then(without)
        });
        if unknown.is_some() {
            self.counts.commands_missing -= 1;
            self.counts.commands_of_one_test_mass += 1;
        }
        let thrust = self.acting.act(commanded.as_ref().and_then(|numbers| numbers.first_chunk().copied()));
        let acting = commanded.zip(thrust).map(|(mut numbers, thrust)| {
            numbers[..6].copy_from_slice(&thrust);
            numbers
        });
        if let Some(on_demand) = &mut self.on_demand {
            on_demand.take(acting.as_ref(), unknown, self.sun_srf);
        }
        if self.needs_sun && self.sun_srf.is_none() {
            self.counts.sun_missing += 1;
            return Ok(None);
        }
        let readout = self.held.test_masses();
        Ok(acting.map(|numbers| {
            let command = Command::from_numbers(&numbers);
            let mut motion = self.known.motion(&command, self.sun_srf.as_ref(), &readout, omega_srf_rad_s);
            if let Some(tm) = unknown {
                motion.u_orf_m_s2[tm] = Vector3::from_element(f64::NAN);
            }
            motion
        }))
    }

    fn emit(&mut self, count: usize, rows: &mut Vec<Row>) {
        let delay = self.on_demand.as_ref().is_some_and(|on_demand| on_demand.needs().dws_delay_response);
        let mut smoothed = self.smoother.smoothed(if delay { self.pending.len() } else { count });
        let alpha_crf = |(p, s): (&Pending, &Smoothed)| p.alpha_known_rad_s2 - p.frame_rad_s2 + s.disturbance_rad_s2;
        let alpha_crf_rad_s2: Vec<_> = self.pending.iter().zip(&smoothed).filter(|_| delay).map(alpha_crf).collect();
        smoothed.truncate(count);
        for (pending, smoothed) in self.pending.iter_mut().zip(&smoothed) {
            for (tm, push) in pending.tm.iter_mut().zip(&self.push_per_turn) {
                tm.u_orf_m_s2 += push * smoothed.noise_rad_s2;
            }
        }
        let blind = self.blind(smoothed.len());
        let known = |v: &Vector3<f64>| v.iter().all(|x| x.is_finite());
        let available = |(p, blind): (&Pending, &bool)| Availability {
            alpha: known(&p.alpha_known_rad_s2) && !blind,
            u: p.tm.map(|tm| known(&tm.u_orf_m_s2)),
        };
        let mut on_demand = Vec::new();
        if let Some(columns) = &mut self.on_demand {
            let leaving: Vec<Availability> = self.pending.iter().zip(&blind).map(available).collect();
            on_demand = columns.give(&self.smoother, &leaving, &alpha_crf_rad_s2);
        }
        self.smoother.release(count);
        let mut on_demand = on_demand.into_iter();
        rows.reserve(smoothed.len());
        for (k, (smoothed, blind)) in smoothed.iter().zip(blind).enumerate() {
            let row = self.row(k, smoothed, blind);
            rows.push(Row { on_demand: on_demand.next().unwrap_or_default(), ..row });
        }
        if let Some(last) = smoothed.len().checked_sub(1) {
            self.previous = Some(self.pending[last]);
        }
        self.pending.drain(..smoothed.len());
    }

    /// Whether each of the `count` oldest pending epochs is further from every attitude than the smoother remembers.
    /// What is left of `α̂` there is the command, which answers the very disturbance that it lacks: it would bias the
    /// calibration.
    fn blind(&mut self, count: usize) -> Vec<bool> {
        let sensed = |pending: &Pending| pending.attitude_rad.iter().all(|x| x.is_finite());
        let memory = self.smoother.model().memory();
        let mut blind = vec![false; count];
        let mut ahead = f64::INFINITY;
        for (k, pending) in self.pending.iter().enumerate().rev() {
            ahead = if sensed(pending) { 0.0 } else { ahead + 1.0 };
            if let Some(blind) = blind.get_mut(k) {
                *blind = ahead > memory;
            }
        }
        for (pending, blind) in self.pending.iter().zip(&mut blind) {
            self.since_attitude = if sensed(pending) { 0.0 } else { self.since_attitude + 1.0 };
            *blind &= self.since_attitude > memory;
            self.counts.blind += u64::from(*blind);
        }
        blind
    }

    fn row(&self, k: usize, smoothed: &Smoothed, blind: bool) -> Row {
        let now = &self.pending[k];
        let before = if k == 0 { self.previous.as_ref() } else { Some(&self.pending[k - 1]) };
        let after = self.pending.get(k + 1);
        let missing = Vector3::from_element(f64::NAN);
        let alpha = match self.angular_acceleration {
            AngularAcceleration::Smoother if blind => missing,
            AngularAcceleration::Smoother => now.alpha_known_rad_s2 + smoothed.disturbance_rad_s2,
            AngularAcceleration::Commanded => now.alpha_known_rad_s2,
            AngularAcceleration::SecondDifference => match (before, after, self.pending.get(k + 2)) {
                // The mean of the second differences at both ends of the interval.
                (Some(a), Some(c), Some(d)) => {
                    let sum = d.attitude_rad - c.attitude_rad - now.attitude_rad + a.attitude_rad;
                    sum * (0.5 * self.rate_hz * self.rate_hz) + now.frame_rad_s2
                }
                _ => missing,
            },
        };
        let omega = smoothed.omega_crf_rad_s + now.omega_ci_rad_s;
        let mut vectors: Few<Vector3<f64>, { 3 + 3 * MOST_TEST_MASSES }> = [alpha, omega].into_iter().collect();
        for tm in &now.tm {
            vectors.push(tm.r_orf_m);
            vectors.push(tm.u_orf_m_s2);
        }
        // Measured minus known acceleration, the known one averaged as the second difference averages it.
        let difference = |read: &dyn Fn(&Pending) -> Vector3<f64>, known: &dyn Fn(&Pending) -> Vector3<f64>| {
            let (Some(a), Some(c)) = (before, after) else { return missing };
            (read(a) - 2.0 * read(now) + read(c)) * (self.rate_hz * self.rate_hz) - 0.5 * (known(a) + known(now))
        };
        for i in 0..now.tm.len() {
            vectors.push(difference(&|p| p.tm[i].bridged_orf_m, &|p| p.tm[i].u_orf_m_s2));
        }
        vectors.push(difference(&|p| p.bridged_rad, &|p| p.alpha_known_rad_s2 - p.frame_rad_s2));
        Row { time_ns: now.time_ns, values: vectors.iter().flatten().copied().collect(), on_demand: Vec::new() }
    }

    /// Name, unit and frame of the columns on demand.
    pub fn on_demand_columns(&self) -> Vec<(String, &'static str, String)> {
        self.on_demand.as_ref().map(OnDemand::columns).unwrap_or_default()
    }

    /// What happened to how many epochs.
    pub fn counts(&self) -> Counts {
        self.counts
    }

    /// See [`Smoother::innovation_ratio`].
    pub fn innovation_ratio(&self) -> Option<[f64; 3]> {
        self.smoother.innovation_ratio()
    }

    /// See [`Smoother::inconsistency_sigma`].
    pub fn inconsistency_sigma(&self) -> Option<[f64; 3]> {
        self.smoother.inconsistency_sigma()
    }

    /// Replayed against telemetered commands; `None` where nothing was compared.
    pub fn comparison(&self) -> Option<&Comparison> {
        self.replay.as_ref().map(Replay::comparison).filter(|c| c.samples() > 0)
    }

    /// Samples by which a row is late at least; at most twice as many.
    pub fn lag(&self) -> usize {
        self.smoother.model().lag()
    }

    /// Visits the whole state, to save it or to take it back bit for bit.
    ///
    /// # Errors
    /// [`StateError`] when the state is of another mission or model; do not use the stage after that.
    pub fn visit(&mut self, state: &mut State<'_>) -> Result<(), StateError> {
        let test_masses = self.push_per_turn.len();
        state.same("mission", &format!("{test_masses} test masses"))?;
        state.same("model", &self.needs().describe())?;
        self.smoother.visit(state)?;
        self.held.visit(state)?;
        self.acting.visit(state)?;
        for direction in [&mut self.sun_srf, &mut self.packet_sun_srf] {
            state.option(direction, |state, v| state.f64s(v.iter_mut()))?;
        }
        state.f64s(self.omega_ci_rad_s.iter_mut().chain(self.alpha_ci_rad_s2.iter_mut()))?;
        let mut replays = self.replay.is_some();
        state.flag(&mut replays)?;
        match &mut self.replay {
            Some(replay) if replays => replay.visit(state)?,
            None if !replays => {}
            _ => return Err(StateError::Content("a replay of commands")),
        }
        let c = &mut self.counts;
        for count in [
            &mut c.epochs,
            &mut c.commands_telemetered,
            &mut c.commands_replayed,
            &mut c.commands_missing,
            &mut c.sun_missing,
            &mut c.attitude_missing,
            &mut c.commands_of_one_test_mass,
            &mut c.readouts_bridged,
            &mut c.blind,
        ] {
            state.u64(count)?;
        }
        state.f64(&mut self.since_attitude)?;
        state.option(&mut self.previous, |state, pending| pending.visit(test_masses, state))?;
        state.list(&mut self.pending, |state, pending| pending.visit(test_masses, state))?;
        let waiting = self.smoother.waiting();
        let on_demand = self.on_demand.as_mut();
        if self.pending.len() != waiting {
            return Err(StateError::Content("a number of waiting epochs"));
        }
        on_demand.map_or(Ok(()), |on_demand| on_demand.visit(waiting, state))
    }
}
