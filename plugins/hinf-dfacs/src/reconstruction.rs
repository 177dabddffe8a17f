//! Makes the rows of the table `reconstruction` from gridded telemetry, epoch by epoch.

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
use crate::replay::{CommandNumbers, Comparison, LastReadout, ReadoutNumbers, Replay, electrodes_of, visit_command};
use crate::smoother::{Model, Smoothed, Smoother};
use crate::thruster_response::ThrusterResponse;

const NEEDED_BY: &str = "hinf-dfacs";
/// Source of `α̂`. Only the smoother gives an unbiased calibration (Methods, "Angular acceleration").
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum AngularAcceleration {
    /// `E[α | all wavefront sensing, all commands]`.
    Smoother,
    /// Commanded torque alone: it lacks the thruster noise to which the controller responds, which biases `b_x`.
    Commanded,
    /// Second difference of the attitude alone: readout noise in the regressor attenuates the offset.
    SecondDifference,
}

/// Settings of a reconstruction.
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
    /// Replay the control law, to replace missing commands and to check telemetered ones.
    pub replay: bool,
    /// Time after which a replayed control law counts as settled, s.
    pub warm_up_s: f64,
    /// Noise power relative to the mission file.
    pub scale: NoiseScale,
    /// Columns that effects request.
    pub needs: Needs,
}

/// Telemetry at `t_k`; NaN where missing.
#[derive(Clone, Copy, Debug, Default)]
pub struct Epoch {
    /// Unix ns.
    pub time_ns: i64,
    /// The most precise readouts, in the order of [`Mission::channels`], m and rad.
    pub readout: ReadoutNumbers,
    /// Command for `[t_k, t_{k+1})`, in the order of [`crate::replay::command_vectors`], N and N m.
    pub command: CommandNumbers,
    /// Unit vector from the Sun to the spacecraft, SRF.
    pub sun_srf: Vector3<f64>,
    /// Age of the latest ephemeris packet, s; NaN if not telemetered.
    pub ephemeris_age_s: f64,
    /// Angular velocity `ω_CI` of CRF relative to IRF, CRF, rad s⁻¹.
    pub omega_crf_rad_s: Vector3<f64>,
    /// Its derivative `ω̇_CI`, CRF, rad s⁻².
    pub alpha_crf_rad_s2: Vector3<f64>,
}

impl Epoch {
    /// Visits every field; `test_masses` is their number.
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

/// Number of values in a row of the table `reconstruction` for a number of test masses.
pub fn row_length(test_masses: usize) -> usize {
    9 + 9 * test_masses
}

/// A row: `α̂` (SRF, rad s⁻²), `ω̂` (SRF, rad s⁻¹), `r` (m) and `û` (m s⁻²) of each test mass in its ORF, then the
/// channels `NAME.accel` (m s⁻²) of each and `sc.alpha` (rad s⁻²), three values each.
#[derive(Clone, Debug, PartialEq)]
pub struct Row {
    /// Unix ns.
    pub time_ns: i64,
    /// Values in the order above; NaN where unknown.
    pub values: Few<f64, { 9 + 9 * MOST_TEST_MASSES }>,
    /// Values of the requested columns, in the order of [`Reconstruction::on_demand_columns`].
    pub on_demand: Vec<f64>,
}

impl Row {
    /// The channels of the spacecraft's attitude, `sc.alpha`, rad s⁻².
    pub fn attitude_channels(&self) -> [f64; 3] {
        let values = &self.values[self.values.len() - 3..];
        [values[0], values[1], values[2]]
    }
}

/// Numbers of epochs by the data that they have.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counts {
    /// All epochs.
    pub epochs: u64,
    /// Epochs with a telemetered command.
    pub commands_telemetered: u64,
    /// Epochs with a replayed command.
    pub commands_replayed: u64,
    /// Epochs without a command.
    pub commands_missing: u64,
    /// Epochs without a Sun direction, if sunlight is modelled and its direction telemetered.
    pub sun_missing: u64,
    /// Epochs without the spacecraft's attitude.
    pub attitude_missing: u64,
    /// Epochs with a command that lacks the electrodes of one test mass.
    pub commands_of_one_test_mass: u64,
    /// Missing readouts, per axis, that the channels interpolate.
    pub readouts_bridged: u64,
    /// Epochs without `α̂`, because no attitude readout lies within the smoother's memory.
    pub alpha_unknown: u64,
}

/// Data of a test mass in an epoch that waits for the smoother, ORF.
#[derive(Clone, Copy, Debug, Default)]
struct PendingTestMass {
    r_orf_m: Vector3<f64>,
    /// The same with short gaps interpolated.
    bridged_orf_m: Vector3<f64>,
    u_orf_m_s2: Vector3<f64>,
}

/// An epoch that waits for the smoother.
#[derive(Clone, Copy, Debug, Default)]
struct Pending {
    time_ns: i64,
    attitude_rad: Vector3<f64>,
    /// The same with short gaps interpolated.
    bridged_rad: Vector3<f64>,
    tm: PerTestMass<PendingTestMass>,
    /// Angular acceleration relative to IRF by the known torques, SRF.
    alpha_known_rad_s2: Vector3<f64>,
    /// `ω̇_SI − ω̇_SC = T ω̇_CI − ω_SC×(T ω_CI)`.
    frame_rad_s2: Vector3<f64>,
    /// `ω_CI`, to which the smoother adds `ω_SC`; in prediction mode with the filtered `ω_SC`.
    omega_rad_s: Vector3<f64>,
}

impl Pending {
    /// Interpolated readout of an axis, counted over the attitude and the displacements of each test mass.
    fn bridged(&self, axis: usize) -> f64 {
        if axis < 3 { self.bridged_rad[axis] } else { self.tm[axis / 3 - 1].bridged_orf_m[axis % 3] }
    }

    fn set_bridged(&mut self, axis: usize, value: f64) {
        let vector = if axis < 3 { &mut self.bridged_rad } else { &mut self.tm[axis / 3 - 1].bridged_orf_m };
        vector[axis % 3] = value;
    }

    fn vectors(&mut self) -> impl Iterator<Item = &mut Vector3<f64>> {
        let spacecraft = [
            &mut self.attitude_rad,
            &mut self.bridged_rad,
            &mut self.alpha_known_rad_s2,
            &mut self.frame_rad_s2,
            &mut self.omega_rad_s,
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

/// Reconstruction of one run: [`Self::push`] epochs in order, then [`Self::finish`].
pub struct Reconstruction {
    rate_hz: f64,
    angular_acceleration: AngularAcceleration,
    needs_sun: bool,
    /// See [`Needs::prediction`].
    prediction: bool,
    known: KnownModel,
    /// `−T_S^{O_i} C J/m_S` (`C`: [`ThrustNoise::force_per_torque`]): acceleration of each test mass, ORF, by the
    /// force correlated with torque noise, per angular acceleration by that noise, SRF; m s⁻² per rad s⁻².
    tm_accel_per_alpha: Vec<Matrix3<f64>>,
    smoother: Smoother,
    replay: Option<Replay>,
    last_readout: LastReadout,
    thruster_response: ThrusterResponse,
    /// Sun direction at the epoch, and in the latest packet, which the feed-forward on board holds.
    sun_srf: Option<Vector3<f64>>,
    packet_sun_srf: Option<Vector3<f64>>,
    omega_ci_rad_s: Vector3<f64>,
    alpha_ci_rad_s2: Vector3<f64>,
    pending: Vec<Pending>,
    /// Samples from the last attitude readout to the last emitted epoch; infinite before the first readout.
    since_attitude: f64,
    /// The epoch before the first pending one.
    previous: Option<Pending>,
    /// `None` if no effect requests a column.
    on_demand: Option<OnDemand>,
    counts: Counts,
}

fn finite(v: &Vector3<f64>) -> Option<Vector3<f64>> {
    v.iter().all(|x| x.is_finite()).then_some(*v)
}

/// The smoother's model from the noise of thruster torque and long-arm wavefront sensing.
fn model(mission: &Mission, noise: &ThrustNoise, settings: &Settings) -> Result<Model, MissionError> {
    let inverse = mission.spacecraft.inertia_inverse();
    let torque = noise.torque * noise.torque_shape.white_psd();
    let mut sensing = Mission::need(&mission.noise.dws_long_arm, "noise.dws_long_arm", NEEDED_BY)?.shape();
    sensing.terms.iter_mut().for_each(|term| term.asd *= settings.scale.sensing.sqrt());
    let refuse = |key: &str, psd: f64| {
        let reason = "must be above zero: it sets the weights of wavefront sensing and commands";
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
    let scale = Matrix3::from_diagonal(&settings.scale.torque.map(f64::sqrt));
    Ok(Model::new(&(scale * inverse * torque * inverse.transpose() * scale), &sensing, 1.0 / settings.rate_hz))
}

/// One-sided PSDs by the mission file: angular acceleration by thruster torque noise about each axis of SRF,
/// rad² s⁻⁴/Hz, and the white part of the attitude's readout noise, rad²/Hz; `None` if the file lacks either.
pub fn levels_of(mission: &Mission) -> Option<(Vector3<f64>, f64)> {
    let noise = ThrustNoise::of(mission)?;
    let inverse = mission.spacecraft.inertia_inverse();
    let torque = noise.torque * noise.torque_shape.white_psd();
    let sensing = mission.noise.dws_long_arm.as_ref()?.shape().white_psd();
    Some(((inverse * torque * inverse.transpose()).diagonal(), sensing))
}

impl Reconstruction {
    /// Starts a reconstruction for a mission.
    ///
    /// # Errors
    /// [`MissionError`] if the mission lacks test masses, the noise of thruster torque or of long-arm wavefront
    /// sensing, or, with `settings.replay`, a control law.
    pub fn new(mission: &Mission, settings: &Settings) -> Result<Self, MissionError> {
        let missing = || MissionError::Missing { section: "noise.thruster_torque".to_owned(), needed_by: NEEDED_BY };
        let noise = ThrustNoise::of(mission).filter(|n| !n.torque_shape.terms.is_empty()).ok_or_else(missing)?;
        let model = model(mission, &noise, settings)?;
        let known = KnownModel::new(mission)?;
        let test_masses = mission.test_mass.len();
        let force_per_alpha = noise.force_per_torque * mission.spacecraft.inertia();
        let accel_per_alpha = |tm: &TestMass| tm.dcm_orf_from_srf() * force_per_alpha / -mission.spacecraft.mass_kg;
        let tm_accel_per_alpha: Vec<_> = mission.test_mass.values().map(accel_per_alpha).collect();
        let replay = if settings.replay {
            let (law, numbers) = (ControlLaw::new(mission)?, 6 + 6 * test_masses);
            let delay = mission.control.as_ref().map_or(0, |control| control.delay_samples as usize);
            Some(Replay::new(law, delay, numbers, !settings.commands, settings.warm_up_s, settings.rate_hz))
        } else {
            None
        };
        let prediction = settings.needs.prediction;
        let on_demand = || OnDemand::new(settings.needs, mission, tm_accel_per_alpha.clone());
        Ok(Self {
            rate_hz: settings.rate_hz,
            // The smoother and the second difference use later readouts.
            angular_acceleration: if prediction {
                AngularAcceleration::Commanded
            } else {
                settings.angular_acceleration
            },
            prediction,
            needs_sun: settings.sun && mission.solar_pressure.is_some(),
            on_demand: (settings.needs != Needs::default()).then(on_demand),
            tm_accel_per_alpha,
            known,
            smoother: Smoother::new(model),
            replay,
            last_readout: LastReadout::new(3 + 6 * test_masses),
            thruster_response: ThrusterResponse::new(mission, 1.0 / settings.rate_hz),
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

    /// Adds one epoch, and appends to `rows` those whose lag has passed.
    ///
    /// SRF and CRF differ by the attitude error, 1e-8 rad. So `T_C^S = 1`, and the three angles form a vector whose
    /// second derivative is the angular acceleration relative to CRF.
    ///
    /// # Errors
    /// [`StateError`] if the control law refuses its own initial state.
    pub fn push(&mut self, epoch: &Epoch, rows: &mut Vec<Row>) -> Result<(), StateError> {
        self.counts.epochs += 1;
        self.last_readout.update(&epoch.readout);
        // Values of the ephemeris are held if missing: they change by 1e-5 between packets, in a minute.
        self.sun_srf = finite(&epoch.sun_srf).or(self.sun_srf);
        let same_packet = epoch.ephemeris_age_s >= 1.0 / self.rate_hz && self.packet_sun_srf.is_some();
        if !same_packet {
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
            omega_rad_s: if self.prediction { omega_sc + self.omega_ci_rad_s } else { self.omega_ci_rad_s },
        });
        self.interpolate_gaps();
        if self.smoother.waiting() == 2 * self.lag() {
            self.emit(self.lag(), rows);
        }
        Ok(())
    }

    /// Interpolates over gaps that the two newest epochs end. Such a gap is still pending: it is shorter than the lag.
    fn interpolate_gaps(&mut self) {
        let end = self.pending.len();
        for axis in 0..3 + 3 * self.tm_accel_per_alpha.len() {
            let at = |back: usize| end.checked_sub(back).map_or(f64::NAN, |k| self.pending[k].bridged(axis));
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
                self.pending[k].set_bridged(axis, value);
                self.counts.readouts_bridged += 1;
            }
        }
    }

    /// Ends the data: appends the remaining rows.
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
            Some(replay) => replay.step(&self.last_readout, self.packet_sun_srf, telemetered)?,
            None => None,
        };
        let counter = match (telemetered, &replayed) {
            (Some(_), _) => &mut self.counts.commands_telemetered,
            (None, Some(_)) => &mut self.counts.commands_replayed,
            (None, None) => &mut self.counts.commands_missing,
        };
        *counter += 1;
        // If a command lacks the electrodes of one test mass, the other bodies are still modelled: the recoil on the
        // spacecraft, 1e-9 N, is a thousandth of the thrusters' noise.
        let without = |tm: usize| -> Option<CommandNumbers> {
            let mut others = epoch.command;
            others[electrodes_of(tm)].fill(0.0);
            others.iter().all(|x| x.is_finite()).then_some(others)
        };
        let mut unknown = None;
        let commanded = telemetered.copied().or(replayed).or_else(|| {
            unknown = (0..self.tm_accel_per_alpha.len()).find(|tm| without(*tm).is_some());
            unknown.and_then(without)
        });
        if unknown.is_some() {
            self.counts.commands_missing -= 1;
            self.counts.commands_of_one_test_mass += 1;
        }
        let thrust = self.thruster_response.step(commanded.as_ref().and_then(|numbers| numbers.first_chunk().copied()));
        let acting = commanded.zip(thrust).map(|(mut numbers, thrust)| {
            numbers[..6].copy_from_slice(&thrust);
            numbers
        });
        if let Some(on_demand) = &mut self.on_demand {
            on_demand.push(acting.as_ref(), unknown, self.sun_srf);
        }
        if self.needs_sun && self.sun_srf.is_none() {
            self.counts.sun_missing += 1;
            return Ok(None);
        }
        let readout = self.last_readout.test_masses();
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
        let mut smoothed = if self.prediction {
            vec![Smoothed::default(); count]
        } else {
            self.smoother.smoothed(if delay { self.pending.len() } else { count })
        };
        let alpha_crf = |(p, s): (&Pending, &Smoothed)| p.alpha_known_rad_s2 - p.frame_rad_s2 + s.disturbance_rad_s2;
        let alpha_crf_rad_s2: Vec<_> = self.pending.iter().zip(&smoothed).filter(|_| delay).map(alpha_crf).collect();
        smoothed.truncate(count);
        for (pending, smoothed) in self.pending.iter_mut().zip(&smoothed) {
            for (tm, accel_per_alpha) in pending.tm.iter_mut().zip(&self.tm_accel_per_alpha) {
                tm.u_orf_m_s2 += accel_per_alpha * smoothed.noise_rad_s2;
            }
        }
        let alpha_unknown =
            if self.prediction { vec![false; smoothed.len()] } else { self.find_unknown_alpha(smoothed.len()) };
        let known = |v: &Vector3<f64>| v.iter().all(|x| x.is_finite());
        let available = |(p, alpha_unknown): (&Pending, &bool)| Availability {
            alpha: known(&p.alpha_known_rad_s2) && !alpha_unknown,
            u: p.tm.map(|tm| known(&tm.u_orf_m_s2)),
        };
        let mut on_demand = Vec::new();
        if let Some(columns) = &mut self.on_demand {
            let available: Vec<Availability> = self.pending.iter().zip(&alpha_unknown).map(available).collect();
            on_demand = columns.emit(&self.smoother, &available, &alpha_crf_rad_s2);
        }
        self.smoother.release(count);
        let mut on_demand = on_demand.into_iter();
        rows.reserve(smoothed.len());
        for (k, (smoothed, alpha_unknown)) in smoothed.iter().zip(alpha_unknown).enumerate() {
            let row = self.row(k, smoothed, alpha_unknown);
            rows.push(Row { on_demand: on_demand.next().unwrap_or_default(), ..row });
        }
        if let Some(last) = smoothed.len().checked_sub(1) {
            self.previous = Some(self.pending[last]);
        }
        self.pending.drain(..smoothed.len());
    }

    /// Whether each of the `count` oldest pending epochs is further from every attitude readout than the smoother's
    /// memory. There `α̂` would be the commanded value, which lacks the disturbance that it counteracts: it would bias
    /// the calibration.
    fn find_unknown_alpha(&mut self, count: usize) -> Vec<bool> {
        let sensed = |pending: &Pending| pending.attitude_rad.iter().all(|x| x.is_finite());
        let memory = self.smoother.model().memory();
        let mut unknown = vec![false; count];
        let mut until_attitude = f64::INFINITY;
        for (k, pending) in self.pending.iter().enumerate().rev() {
            until_attitude = if sensed(pending) { 0.0 } else { until_attitude + 1.0 };
            if let Some(unknown) = unknown.get_mut(k) {
                *unknown = until_attitude > memory;
            }
        }
        for (pending, unknown) in self.pending.iter().zip(&mut unknown) {
            self.since_attitude = if sensed(pending) { 0.0 } else { self.since_attitude + 1.0 };
            *unknown &= self.since_attitude > memory;
            self.counts.alpha_unknown += u64::from(*unknown);
        }
        unknown
    }

    fn row(&self, k: usize, smoothed: &Smoothed, alpha_unknown: bool) -> Row {
        let now = &self.pending[k];
        let before = if k == 0 { self.previous.as_ref() } else { Some(&self.pending[k - 1]) };
        let after = self.pending.get(k + 1);
        let missing = Vector3::from_element(f64::NAN);
        let alpha = match self.angular_acceleration {
            AngularAcceleration::Smoother if alpha_unknown => missing,
            AngularAcceleration::Smoother => now.alpha_known_rad_s2 + smoothed.disturbance_rad_s2,
            AngularAcceleration::Commanded => now.alpha_known_rad_s2,
            AngularAcceleration::SecondDifference => match (before, after, self.pending.get(k + 2)) {
                // Mean of the second differences at both ends of the interval.
                (Some(a), Some(c), Some(d)) => {
                    let sum = d.attitude_rad - c.attitude_rad - now.attitude_rad + a.attitude_rad;
                    sum * (0.5 * self.rate_hz * self.rate_hz) + now.frame_rad_s2
                }
                _ => missing,
            },
        };
        let omega = smoothed.omega_crf_rad_s + now.omega_rad_s;
        let mut vectors: Few<Vector3<f64>, { 3 + 3 * MOST_TEST_MASSES }> = [alpha, omega].into_iter().collect();
        for tm in &now.tm {
            vectors.push(tm.r_orf_m);
            vectors.push(tm.u_orf_m_s2);
        }
        // Measured minus known acceleration; a second difference measures the mean of two samples.
        let channel = |read: &dyn Fn(&Pending) -> Vector3<f64>, known: &dyn Fn(&Pending) -> Vector3<f64>| {
            let (Some(a), Some(c)) = (before, after) else { return missing };
            (read(a) - 2.0 * read(now) + read(c)) * (self.rate_hz * self.rate_hz) - 0.5 * (known(a) + known(now))
        };
        for i in 0..now.tm.len() {
            vectors.push(channel(&|p| p.tm[i].bridged_orf_m, &|p| p.tm[i].u_orf_m_s2));
        }
        vectors.push(channel(&|p| p.bridged_rad, &|p| p.alpha_known_rad_s2 - p.frame_rad_s2));
        Row { time_ns: now.time_ns, values: vectors.iter().flatten().copied().collect(), on_demand: Vec::new() }
    }

    /// From now on the smoother weighs by the levels of noise of `settings`.
    ///
    /// # Errors
    /// As [`Self::new`].
    pub fn set_levels(&mut self, mission: &Mission, settings: &Settings) -> Result<(), MissionError> {
        let missing = || MissionError::Missing { section: "noise.thruster_torque".to_owned(), needed_by: NEEDED_BY };
        let noise = ThrustNoise::of(mission).ok_or_else(missing)?;
        self.smoother.set_levels(&model(mission, &noise, settings)?);
        Ok(())
    }

    /// Name, unit and frame of the requested columns.
    pub fn on_demand_columns(&self) -> Vec<(String, &'static str, String)> {
        self.on_demand.as_ref().map(OnDemand::columns).unwrap_or_default()
    }

    /// Numbers of epochs by the data that they have.
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

    /// Comparison of replayed with telemetered commands; `None` if there was none.
    pub fn comparison(&self) -> Option<&Comparison> {
        self.replay.as_ref().map(Replay::comparison).filter(|c| c.samples() > 0)
    }

    /// Smallest delay of a row, samples; the largest is twice as long.
    pub fn lag(&self) -> usize {
        self.smoother.model().lag()
    }

    /// Saves or restores the whole state, bit for bit.
    ///
    /// # Errors
    /// [`StateError`] if the state belongs to another mission or model; `self` must not be used after that.
    pub fn visit(&mut self, state: &mut State<'_>) -> Result<(), StateError> {
        let test_masses = self.tm_accel_per_alpha.len();
        state.same("mission", &format!("{test_masses} test masses"))?;
        state.same("model", &self.needs().describe())?;
        self.smoother.visit(state)?;
        self.last_readout.visit(state)?;
        self.thruster_response.visit(state)?;
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
            &mut c.alpha_unknown,
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
