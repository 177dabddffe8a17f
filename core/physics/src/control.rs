//! The DFACS control law: fifteen single-loop controllers behind the static decoupling of the paper
//! (eq:decoupled_input_with_SRP), shared by the simulator and by the stage that replays it.
//!
//! One [`ControlLaw::step`] per sample turns the readout at `t_k` into the command that acts over `[t_k, t_{k+1})`.
//! With the default delay of one sample that command was computed from the readout at `t_{k−1}`.

use nalgebra::{Matrix3, SMatrix, SVector, Vector3};
use std::collections::VecDeque;

use crate::control_design::loop_shaping;
use crate::mission::{Actuators, CHANNELS, ChannelController, Control, Mission, MissionError};

const NEEDED_BY: &str = "the control law";

/// Readout of one test mass at `t_k`.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct TestMassReadout {
    /// Displacement from the housing's centre, ORF, m: x from the interferometer, y and z from the inertial sensor.
    pub r_orf_m: Vector3<f64>,
    /// Attitude relative to ORF, rad: `φ` from the inertial sensor, `θ` and `ψ` from local wavefront sensing.
    pub att_orf_rad: Vector3<f64>,
}

/// What the controller sees at `t_k`. Every value must be finite: who replays telemetry holds the last valid sample.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Readout {
    /// Attitude of the spacecraft relative to CRF, `φ, θ, ψ`, rad.
    pub sc_crf_rad: Vector3<f64>,
    /// Test masses 1 and 2.
    pub tm: [TestMassReadout; 2],
    /// Unit vector from the Sun to the spacecraft, SRF: the latest `/ephemeris` packet at or before `t_k`.
    /// `None` before the first one: no feed-forward of sunlight.
    pub sun_srf: Option<Vector3<f64>>,
}

/// What is commanded of one test mass' electrodes.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct TestMassCommand {
    /// Electrostatic force on the test mass, ORF, N; none along the sensitive axis x.
    pub force_orf_n: Vector3<f64>,
    /// Electrostatic torque on the test mass, ORF, N m.
    pub torque_orf_nm: Vector3<f64>,
}

/// What is commanded over one sample interval.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Command {
    /// Thrust on the spacecraft `F_T`, SRF, N.
    pub mps_force_srf_n: Vector3<f64>,
    /// Thrusters' torque about the centre of mass `M_T`, SRF, N m.
    pub mps_torque_srf_nm: Vector3<f64>,
    /// Electrostatic commands of test masses 1 and 2.
    pub tm: [TestMassCommand; 2],
}

/// Inputs of eq:input_variables_reduced: `F_T` (3), `M_T` (3), then for each test mass `F_E` (y, z) and `M_E` (3).
const INPUTS: usize = 16;
/// Row of the input vector that holds the thrust along `s_3`.
const THRUST_Z: usize = 2;
/// Rows of eq:state_variables that hold `z_1` and `z_2`.
const Z: [usize; 2] = [5, 11];

type Accelerations = SVector<f64, 15>;
type InputVector = SVector<f64, INPUTS>;

impl Command {
    fn from_vector(u: &InputVector) -> Self {
        let at = |i: usize| Vector3::new(u[i], u[i + 1], u[i + 2]);
        let tm =
            |i: usize| TestMassCommand { force_orf_n: Vector3::new(0.0, u[i], u[i + 1]), torque_orf_nm: at(i + 2) };
        Self { mps_force_srf_n: at(0), mps_torque_srf_nm: at(3), tm: [tm(6), tm(11)] }
    }

    fn limited(mut self, limits: &Actuators) -> Self {
        let clamp = |v: &mut Vector3<f64>, limit: f64| v.apply(|x| *x = x.clamp(-limit, limit));
        clamp(&mut self.mps_force_srf_n, limits.thrust_limit_n);
        clamp(&mut self.mps_torque_srf_nm, limits.torque_limit_nm);
        for tm in &mut self.tm {
            clamp(&mut tm.force_orf_n, limits.electrostatic_force_limit_n);
            clamp(&mut tm.torque_orf_nm, limits.electrostatic_torque_limit_nm);
        }
        self
    }

    fn vectors(&self) -> [&Vector3<f64>; 6] {
        let [a, b] = &self.tm;
        [
            &self.mps_force_srf_n,
            &self.mps_torque_srf_nm,
            &a.force_orf_n,
            &a.torque_orf_nm,
            &b.force_orf_n,
            &b.torque_orf_nm,
        ]
    }

    fn from_values(v: &[f64]) -> Self {
        let at = |i: usize| Vector3::new(v[3 * i], v[3 * i + 1], v[3 * i + 2]);
        let tm = |i: usize| TestMassCommand { force_orf_n: at(i), torque_orf_nm: at(i + 1) };
        Self { mps_force_srf_n: at(0), mps_torque_srf_nm: at(1), tm: [tm(2), tm(4)] }
    }
}

/// The plant of eq:state_space_model that the decoupling assumes: nominal masses, offsets and stiffness.
struct LinearPlant {
    sc_mass_kg: f64,
    sc_inertia_inverse: Matrix3<f64>,
    tm: [LinearTestMass; 2],
}

struct LinearTestMass {
    mass_kg: f64,
    inertia_inverse: Matrix3<f64>,
    dcm_orf_from_srf: Matrix3<f64>,
    offset_srf_m: Vector3<f64>,
    stiffness_tt: Matrix3<f64>,
    stiffness_tr: Matrix3<f64>,
    stiffness_rt: Matrix3<f64>,
    stiffness_rr: Matrix3<f64>,
}

impl LinearPlant {
    fn new(mission: &Mission) -> Result<Self, MissionError> {
        let lever = mission.control.as_ref().is_none_or(|c| c.lever_feed_forward);
        let tm = |name: &str| -> Result<LinearTestMass, MissionError> {
            let section = mission.test_mass(name, NEEDED_BY)?;
            let inertia_inverse = section.inertia_inverse(name, NEEDED_BY)?;
            Ok(LinearTestMass {
                mass_kg: section.mass_kg,
                inertia_inverse,
                dcm_orf_from_srf: section.dcm_orf_from_srf(),
                offset_srf_m: if lever { Vector3::from(section.offset_nominal_srf_m) } else { Vector3::zeros() },
                stiffness_tt: section.stiffness_tt(),
                stiffness_tr: section.stiffness_tr(),
                stiffness_rt: section.stiffness_rt(&inertia_inverse),
                stiffness_rr: section.stiffness_rr(),
            })
        };
        Ok(Self {
            sc_mass_kg: mission.spacecraft.mass_kg,
            sc_inertia_inverse: mission.spacecraft.inertia_inverse(),
            tm: [tm("tm1")?, tm("tm2")?],
        })
    }

    /// `B_v u`: accelerations of the fifteen channels, in the order of [`CHANNELS`].
    ///
    /// `α = J_S⁻¹(M_T − Σ T M_Ej − Σ b_j×(T F_Ej))`, `r̈_i = −T((F_T − Σ T F_Ej)/m_S + α×b_i) + F_Ei/m_i`, and a test
    /// mass turns against its housing by `J_m⁻¹ M_Ei − T α`.
    fn accelerations(&self, u: &Command) -> Accelerations {
        let (mut force, mut torque) = (u.mps_force_srf_n, u.mps_torque_srf_nm);
        for (tm, e) in self.tm.iter().zip(&u.tm) {
            let f = tm.dcm_orf_from_srf.tr_mul(&e.force_orf_n);
            force -= f;
            torque -= tm.dcm_orf_from_srf.tr_mul(&e.torque_orf_nm) + tm.offset_srf_m.cross(&f);
        }
        let alpha = self.sc_inertia_inverse * torque;
        let mut out = Accelerations::zeros();
        out.fixed_rows_mut::<3>(0).copy_from(&alpha);
        for (i, (tm, e)) in self.tm.iter().zip(&u.tm).enumerate() {
            let inertial = force / self.sc_mass_kg + alpha.cross(&tm.offset_srf_m);
            let r = e.force_orf_n / tm.mass_kg - tm.dcm_orf_from_srf * inertial;
            let turn = tm.inertia_inverse * e.torque_orf_nm - tm.dcm_orf_from_srf * alpha;
            out.fixed_rows_mut::<3>(3 + 6 * i).copy_from(&r);
            out.fixed_rows_mut::<3>(6 + 6 * i).copy_from(&turn);
        }
        out
    }

    /// `B_v`, column by column.
    fn input_matrix(&self) -> SMatrix<f64, 15, INPUTS> {
        let mut b = SMatrix::<f64, 15, INPUTS>::zeros();
        for j in 0..INPUTS {
            let mut unit = InputVector::zeros();
            unit[j] = 1.0;
            b.set_column(j, &self.accelerations(&Command::from_vector(&unit)));
        }
        b
    }

    /// `A_v p̂`.
    fn stiffness(&self, y: &Readout) -> Accelerations {
        let mut out = Accelerations::zeros();
        for (i, (s, tm)) in self.tm.iter().zip(&y.tm).enumerate() {
            let r = s.stiffness_tt * tm.r_orf_m + s.stiffness_tr * tm.att_orf_rad;
            let turn = s.stiffness_rt * tm.r_orf_m + s.stiffness_rr * tm.att_orf_rad;
            out.fixed_rows_mut::<3>(3 + 6 * i).copy_from(&r);
            out.fixed_rows_mut::<3>(6 + 6 * i).copy_from(&turn);
        }
        out
    }

    /// `B_v†` under the rules of eqs x_axis_thrust to z_axis_thrust.
    ///
    /// `B_v` has one input more than channels, and the rules settle it: thrust along `s_3` serves the common motion
    /// of `z_1` and `z_2` alone, `F_Tz = −m_S (u_d6 + u_d12)/2`. The other fifteen inputs then follow from the
    /// fifteen channels without freedom, so that `B_v B_v† = 1` exactly; by the symmetry of the two optical frames
    /// `F_Tx` weighs `x_1` and `x_2` alike, and `F_Ty` weighs them opposed.
    ///
    /// `None` when the two sensitive axes are parallel to within 3°: the reaction of the electrodes, `m_m/m_S`, would
    /// still make `B_v` regular, with thrust beyond all use.
    fn allocation(&self) -> Option<SMatrix<f64, INPUTS, 15>> {
        let sensitive = |i: usize| self.tm[i].dcm_orf_from_srf.row(0).transpose();
        if sensitive(0).cross(&sensitive(1)).norm() < 0.05 {
            return None;
        }
        let b = self.input_matrix();
        let mut thrust_z = SMatrix::<f64, 1, 15>::zeros();
        for z in Z {
            thrust_z[z] = -0.5 * self.sc_mass_kg;
        }
        let wanted = SMatrix::<f64, 15, 15>::identity() - b.column(THRUST_Z) * thrust_z;
        let others: SMatrix<f64, 15, 15> = b.remove_column(THRUST_Z);
        let mut out: SMatrix<f64, INPUTS, 15> = others.lu().solve(&wanted)?.insert_row(THRUST_Z, 0.0);
        out.set_row(THRUST_Z, &thrust_z);
        Some(out)
    }
}

/// One channel's controller with the states of its sections (direct form II transposed).
struct Channel {
    controller: ChannelController,
    states: Vec<[f64; 2]>,
}

impl Channel {
    fn new(controller: ChannelController) -> Self {
        let states = vec![[0.0; 2]; controller.sections.len()];
        Self { controller, states }
    }

    /// `u_d = −gain · H(z) y`.
    fn step(&mut self, y: f64) -> f64 {
        let mut x = y;
        for ([b0, b1, b2, a1, a2], s) in self.controller.sections.iter().zip(&mut self.states) {
            let out = b0 * x + s[0];
            s[0] = b1 * x - a1 * out + s[1];
            s[1] = b2 * x - a2 * out;
            x = out;
        }
        -self.controller.gain_s2 * x
    }
}

/// A saved state does not fit this control law.
#[derive(Debug, thiserror::Error)]
#[error("state of the control law: {found} numbers where {expected} belong; it was saved with another mission file")]
pub struct StateError {
    /// Numbers that this control law has.
    pub expected: usize,
    /// Numbers that were given.
    pub found: usize,
}

/// The running control law.
pub struct ControlLaw {
    plant: LinearPlant,
    allocation: SMatrix<f64, INPUTS, 15>,
    channels: Vec<Channel>,
    limits: Option<Actuators>,
    /// `k_dSC`, N, and the arm of the force, SRF, m.
    sunlight: Option<(f64, Vector3<f64>)>,
    /// Commands that wait for their interval, oldest first; as many as samples of delay.
    waiting: VecDeque<Command>,
}

impl ControlLaw {
    /// Builds the law of a mission: its own controllers, or [`loop_shaping`] when `[control.channel]` lists none.
    ///
    /// # Errors
    /// [`MissionError`] when a section is missing or the geometry leaves a channel without an actuator.
    pub fn new(mission: &Mission) -> Result<Self, MissionError> {
        let control = match &mission.control {
            Some(c) if !c.channel.is_empty() => c.clone(),
            given => {
                let delay_samples = given.as_ref().map_or(1, |c| c.delay_samples);
                let lever_feed_forward = given.as_ref().is_none_or(|c| c.lever_feed_forward);
                Control { delay_samples, lever_feed_forward, channel: loop_shaping(mission)? }
            }
        };
        let channels = CHANNELS
            .iter()
            .map(|name| {
                control.channel.get(*name).map(|c| Channel::new(c.clone())).ok_or_else(|| MissionError::Missing {
                    section: format!("control.channel.\"{name}\""),
                    needed_by: NEEDED_BY,
                })
            })
            .collect::<Result<Vec<_>, _>>()?;
        let plant = LinearPlant::new(mission)?;
        let allocation = plant.allocation().ok_or_else(|| MissionError::Value {
            key: "test_mass.tm2.orf_from_srf_angle_rad".to_owned(),
            value: mission.test_mass("tm2", NEEDED_BY).map_or(f64::NAN, |tm| tm.orf_from_srf_angle_rad).to_string(),
            reason: "leaves the thrusters no way to serve both sensitive axes, which must differ from tm1's by 3° or more",
        })?;
        Ok(Self {
            plant,
            allocation,
            channels,
            limits: mission.actuators.clone(),
            sunlight: mission.solar_pressure.as_ref().map(|s| (s.force_n, Vector3::from(s.arm_srf_m))),
            waiting: (0..control.delay_samples).map(|_| Command::default()).collect(),
        })
    }

    /// Takes the readout at `t_k` and returns the command that acts over `[t_k, t_{k+1})`, as `/command` tells it
    /// with `log_time` `t_k`. The command computed from this readout comes out `delay_samples` calls later.
    pub fn step(&mut self, y: &Readout) -> Command {
        let response = self.respond(y);
        self.waiting.push_back(response);
        // The queue holds one more than the delay, so it is never empty here.
        self.waiting.pop_front().unwrap_or_default()
    }

    /// `u = B_v†(u_d − A_v p̂ − â_SRP)`, within the actuators' limits.
    ///
    /// Sunlight pushes the spacecraft exactly as thrust does, so `B_v†(−â_SRP)` is `−F̂_SRP` and `−D̂_SRP`: they are
    /// taken off thrust and torque. (eq:SRP_acceleration_estimate prints `+T F̂/m_S` where `r̈ ∋ −T F̂/m_S`, and zeros
    /// where a test mass sees the spacecraft turn.)
    fn respond(&mut self, y: &Readout) -> Command {
        let p = [&y.sc_crf_rad, &y.tm[0].r_orf_m, &y.tm[0].att_orf_rad, &y.tm[1].r_orf_m, &y.tm[1].att_orf_rad];
        let mut wanted = -self.plant.stiffness(y);
        for (i, channel) in self.channels.iter_mut().enumerate() {
            wanted[i] += channel.step(p[i / 3][i % 3]);
        }
        let mut command = Command::from_vector(&(self.allocation * wanted));
        if let (Some((force_n, arm)), Some(sun)) = (&self.sunlight, &y.sun_srf) {
            let force = sun * *force_n;
            command.mps_force_srf_n -= force;
            command.mps_torque_srf_nm -= arm.cross(&force);
        }
        match &self.limits {
            Some(limits) => command.limited(limits),
            None => command,
        }
    }

    /// Everything that the next steps depend on: controllers' states, then the waiting commands.
    #[must_use]
    pub fn state(&self) -> Vec<f64> {
        let sections = self.channels.iter().flat_map(|c| c.states.iter().flatten());
        let commands = self.waiting.iter().flat_map(|c| c.vectors().into_iter().flat_map(|v| v.iter().copied()));
        sections.copied().chain(commands).collect()
    }

    /// Takes back what [`Self::state`] gave, bit for bit.
    ///
    /// # Errors
    /// [`StateError`] when the length is another law's; the law is then unchanged.
    pub fn set_state(&mut self, state: &[f64]) -> Result<(), StateError> {
        let sections: usize = self.channels.iter().map(|c| 2 * c.states.len()).sum();
        let expected = sections + 18 * self.waiting.len();
        if state.len() != expected {
            return Err(StateError { expected, found: state.len() });
        }
        let (controllers, commands) = state.split_at(sections);
        let slots = self.channels.iter_mut().flat_map(|c| c.states.iter_mut().flatten());
        for (slot, value) in slots.zip(controllers) {
            *slot = *value;
        }
        for (slot, values) in self.waiting.iter_mut().zip(commands.chunks_exact(18)) {
            *slot = Command::from_values(values);
        }
        Ok(())
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use crate::control_design::tests::taiji;

    fn law() -> ControlLaw {
        ControlLaw::new(&taiji()).unwrap()
    }

    /// Deterministic readouts of about 1e-8 m and rad in every channel.
    fn readout(k: usize) -> Readout {
        let v = |i: usize| Vector3::from_fn(|j, _| 1e-8 * ((k * 7 + i * 3 + j) as f64).sin());
        let tm = |i: usize| TestMassReadout { r_orf_m: v(i), att_orf_rad: v(i + 1) };
        Readout { sc_crf_rad: v(0), tm: [tm(1), tm(3)], sun_srf: Some(Vector3::new(0.866, 0.1, -0.5)) }
    }

    #[test]
    fn allocation_is_a_right_inverse() {
        let plant = LinearPlant::new(&taiji()).unwrap();
        let error = plant.input_matrix() * plant.allocation().unwrap() - SMatrix::<f64, 15, 15>::identity();
        assert!(error.amax() < 1e-12, "{error}");
    }

    proptest::proptest! {
        /// A right inverse for other spacecraft too: masses, offsets, opening angles.
        #[test]
        fn allocation_is_a_right_inverse_for_any_geometry(
            mass_kg in 100.0..5000.0_f64,
            half_angle_rad in 0.1..0.7_f64,
            offsets in proptest::array::uniform6(-0.5..0.5_f64),
        ) {
            let mut mission = taiji();
            mission.spacecraft.mass_kg = mass_kg;
            for (i, (name, sign)) in [("tm1", 1.0), ("tm2", -1.0)].into_iter().enumerate() {
                let tm = mission.test_mass.get_mut(name).unwrap();
                tm.orf_from_srf_angle_rad = sign * half_angle_rad;
                tm.offset_nominal_srf_m = [offsets[3 * i], offsets[3 * i + 1], offsets[3 * i + 2]];
            }
            let plant = LinearPlant::new(&mission).unwrap();
            let error = plant.input_matrix() * plant.allocation().unwrap() - SMatrix::<f64, 15, 15>::identity();
            proptest::prop_assert!(error.amax() < 1e-11, "{}", error.amax());
        }
    }

    /// eqs x_axis_thrust to z_axis_thrust, with the paper's channels 4, 10 (x) and 6, 12 (z).
    #[test]
    fn thrust_follows_the_rules_of_the_paper() {
        let b = LinearPlant::new(&taiji()).unwrap().allocation().unwrap();
        let (x1, z1, x2, z2) = (3, 5, 9, 11);
        // −(c F_x + s F_y)/m_S = u_d4 and −(c F_x − s F_y)/m_S = u_d10.
        let (c, s) = (std::f64::consts::FRAC_PI_6.cos(), 0.5);
        // The electrodes' reaction, m_m/m_S, is the only other way to x.
        let near = |got: f64, want: f64| (got / want - 1.0).abs() < 4.0 * 1.96 / 1500.0;
        assert!(near(b[(0, x1)], -1500.0 / (2.0 * c)) && (b[(0, x1)] / b[(0, x2)] - 1.0).abs() < 1e-12);
        assert!(near(b[(1, x1)], -1500.0 / (2.0 * s)) && (b[(1, x1)] / b[(1, x2)] + 1.0).abs() < 1e-12);
        for j in 0..15 {
            let want = if j == z1 || j == z2 { -750.0 } else { 0.0 };
            assert_eq!(b[(2, j)], want, "F_Tz from channel {j}");
        }
        // Pushing the spacecraft for x_1 moves it along y of both housings; the electrodes carry the masses along.
        assert!(b[(6, x1)].abs() > 0.1, "F_E1y takes no part: {}", b[(6, x1)]);
    }

    /// A displaced test mass pulls the spacecraft after it, a lateral one is pushed back: the signs of r̈ = −T F_T/m_S + F_E/m_m.
    #[test]
    fn commands_oppose_the_readout() {
        let mut y = Readout::default();
        y.tm[0].r_orf_m = Vector3::new(1e-8, 1e-8, 0.0);
        y.tm[1].r_orf_m = Vector3::new(1e-8, 1e-8, 0.0);
        y.sc_crf_rad = Vector3::new(1e-8, 0.0, 0.0);
        let mut law = law();
        let first = law.step(&y);
        assert_eq!(first, Command::default(), "a sample of delay");
        let command = law.step(&y);
        assert!(command.mps_force_srf_n.x > 0.0 && command.mps_torque_srf_nm.x < 0.0, "{command:?}");
        assert!(command.tm[0].force_orf_n.y < 0.0 && command.tm[0].force_orf_n.x == 0.0, "{command:?}");
    }

    /// Mirrors eq:SRP_constant_estimate: with nothing to correct, thrust cancels sunlight and its torque.
    #[test]
    fn feed_forward_cancels_sunlight() {
        let sun = Vector3::new(0.6, 0.0, -0.8);
        let mut law = law();
        let y = Readout { sun_srf: Some(sun), ..Readout::default() };
        law.step(&y);
        let command = law.step(&y);
        let force = 6.3513e-5 * sun;
        assert!((command.mps_force_srf_n + force).amax() < 1e-20);
        let printed = Matrix3::new(0.0, -0.6, 0.0, 0.6, 0.0, -0.1, 0.0, 0.1, 0.0);
        assert!((command.mps_torque_srf_nm + printed * force).amax() < 1e-19);
    }

    #[test]
    fn commands_stay_within_the_actuators() {
        let mut y = readout(3);
        y.tm[0].r_orf_m *= 1e6;
        y.sc_crf_rad *= 1e6;
        let mut law = law();
        law.step(&y);
        let c = law.step(&y);
        assert_eq!(c.mps_force_srf_n.amax(), 1e-3);
        assert_eq!(c.mps_torque_srf_nm.amax(), 1e-3);
        assert_eq!(c.tm[0].force_orf_n.amax(), 5e-9);
        assert!(c.tm[0].torque_orf_nm.amax() <= 1e-11);
    }

    #[test]
    fn saved_state_resumes_bit_for_bit() {
        let mut whole = law();
        for k in 0..50 {
            whole.step(&readout(k));
        }
        let mut resumed = law();
        resumed.set_state(&whole.state()).unwrap();
        for k in 50..100 {
            assert_eq!(whole.step(&readout(k)), resumed.step(&readout(k)));
        }
        assert!(resumed.set_state(&whole.state()[1..]).is_err());
    }

    #[test]
    fn delay_is_configured() {
        let mut mission = taiji();
        for delay_samples in [0, 1, 3] {
            mission.control = Some(Control { delay_samples, lever_feed_forward: true, channel: Default::default() });
            let mut law = ControlLaw::new(&mission).unwrap();
            let silent = (0..10).take_while(|_| law.step(&readout(1)) == Command::default()).count();
            assert_eq!(silent, delay_samples as usize);
        }
    }

    #[test]
    fn a_mission_names_what_it_lacks() {
        let mut mission = taiji();
        mission.requirements = None;
        let error = ControlLaw::new(&mission).err().unwrap().to_string();
        assert!(error.contains("[requirements]"), "{error}");
        let mut mission = taiji();
        let channel = [("tm1.x".to_owned(), ChannelController { gain_s2: 0.1, sections: vec![] })];
        mission.control = Some(Control { delay_samples: 1, lever_feed_forward: true, channel: channel.into() });
        let error = ControlLaw::new(&mission).err().unwrap().to_string();
        assert!(error.contains("control.channel.\"sc.phi\""), "{error}");
        let mut mission = taiji();
        mission.test_mass.get_mut("tm2").unwrap().orf_from_srf_angle_rad = std::f64::consts::FRAC_PI_6;
        let error = ControlLaw::new(&mission).err().unwrap().to_string();
        assert!(error.contains("both sensitive axes"), "{error}");
    }
}
