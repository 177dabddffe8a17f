//! The DFACS control law: fifteen single-loop controllers behind the static decoupling of the paper
//! (eq:decoupled_input_with_SRP), shared by the simulator and by the stage that replays it.
//!
//! One [`ControlLaw::step`] per sample turns the readout at `t_k` into the command that acts over `[t_k, t_{k+1})`.
//! With the default delay of one sample that command was computed from the readout at `t_{k−1}`.

use nalgebra::Vector3;
use std::collections::VecDeque;

use crate::control_design::design;
use crate::decoupling::{Accelerations, AllocationMatrix, InputVector, LinearPlant};
use crate::mission::{Actuators, CHANNELS, ChannelController, Mission, MissionError};

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

impl Command {
    pub(crate) fn from_vector(u: &InputVector) -> Self {
        let at = |i: usize| Vector3::new(u[i], u[i + 1], u[i + 2]);
        let tm =
            |i: usize| TestMassCommand { force_orf_n: Vector3::new(0.0, u[i], u[i + 1]), torque_orf_nm: at(i + 2) };
        Self { mps_force_srf_n: at(0), mps_torque_srf_nm: at(3), tm: [tm(6), tm(11)] }
    }

    /// Whether any component is at its limit or beyond it.
    #[must_use]
    pub fn reaches(&self, limits: &Actuators) -> bool {
        let reaches = |v: &Vector3<f64>, limit: f64| v.iter().fold(false, |any, x| any | (x.abs() >= limit));
        let tm = self.tm.iter().fold(false, |any, tm| {
            any | reaches(&tm.force_orf_n, limits.electrostatic_force_limit_n)
                | reaches(&tm.torque_orf_nm, limits.electrostatic_torque_limit_nm)
        });
        tm | reaches(&self.mps_force_srf_n, limits.thrust_limit_n)
            | reaches(&self.mps_torque_srf_nm, limits.torque_limit_nm)
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

const WIDTH: usize = CHANNELS.len();

/// The `n`-th second-order section of every channel (direct form II transposed), arrays over the channels.
struct Sections {
    b: [[f64; WIDTH]; 3],
    a: [[f64; WIDTH]; 2],
    states: [[f64; WIDTH]; 2],
}

impl Sections {
    /// A channel that has no such section hands its input on.
    fn new(controllers: &[&ChannelController; WIDTH], n: usize) -> Self {
        const UNIT: [f64; 5] = [1.0, 0.0, 0.0, 0.0, 0.0];
        let of =
            |coefficient: usize| std::array::from_fn(|c| controllers[c].sections.get(n).unwrap_or(&UNIT)[coefficient]);
        Self { b: [of(0), of(1), of(2)], a: [of(3), of(4)], states: [[0.0; WIDTH]; 2] }
    }

    fn step(&mut self, x: &mut [f64; WIDTH]) {
        let ([b0, b1, b2], [a1, a2], [s0, s1]) = (&self.b, &self.a, &mut self.states);
        for c in 0..WIDTH {
            let out = b0[c] * x[c] + s0[c];
            s0[c] = b1[c] * x[c] - a1[c] * out + s1[c];
            s1[c] = b2[c] * x[c] - a2[c] * out;
            x[c] = out;
        }
    }
}

/// The controllers of all channels.
struct Controllers {
    gain_s2: [f64; WIDTH],
    sections: Vec<Sections>,
}

impl Controllers {
    fn new(controllers: &[&ChannelController; WIDTH]) -> Self {
        let longest = controllers.iter().map(|c| c.sections.len()).max().unwrap_or(0);
        Self {
            gain_s2: controllers.map(|c| c.gain_s2),
            sections: (0..longest).map(|n| Sections::new(controllers, n)).collect(),
        }
    }

    /// `u_d = −gain · H(z) y`, channel by channel.
    fn step(&mut self, mut y: [f64; WIDTH]) -> Accelerations {
        for sections in &mut self.sections {
            sections.step(&mut y);
        }
        Accelerations::from_fn(|c, _| -self.gain_s2[c] * y[c])
    }

    fn states(&self) -> impl Iterator<Item = &f64> {
        self.sections.iter().flat_map(|s| s.states.iter().flatten())
    }

    fn states_mut(&mut self) -> impl Iterator<Item = &mut f64> {
        self.sections.iter_mut().flat_map(|s| s.states.iter_mut().flatten())
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
    allocation: AllocationMatrix,
    controllers: Controllers,
    limits: Option<Actuators>,
    /// `k_dSC`, N, and the arm of the force, SRF, m.
    sunlight: Option<(f64, Vector3<f64>)>,
    /// Commands that wait for their interval, oldest first; as many as samples of delay.
    waiting: VecDeque<Command>,
}

impl ControlLaw {
    /// Builds the law of a mission: its own controllers, or those of [`design`] when `[control.channel]` lists none.
    ///
    /// # Errors
    /// [`MissionError`] when a section is missing or the geometry leaves a channel without an actuator.
    pub fn new(mission: &Mission) -> Result<Self, MissionError> {
        let mut control = mission.control.clone().unwrap_or_default();
        if control.channel.is_empty() {
            control.channel = design(mission)?.controllers();
        }
        let channel = |name: &&str| {
            control.channel.get(*name).ok_or_else(|| MissionError::Missing {
                section: format!("control.channel.\"{name}\""),
                needed_by: NEEDED_BY,
            })
        };
        let channels = CHANNELS.iter().map(channel).collect::<Result<Vec<_>, _>>()?;
        let controllers = Controllers::new(&std::array::from_fn(|c| channels[c]));
        let plant = LinearPlant::new(mission)?;
        let allocation = plant.allocation()?.matrix;
        Ok(Self {
            plant,
            allocation,
            controllers,
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
        let wanted = self.controllers.step(std::array::from_fn(|c| p[c / 3][c % 3])) - self.plant.stiffness(y);
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
        let commands = self.waiting.iter().flat_map(|c| c.vectors().into_iter().flat_map(|v| v.iter().copied()));
        self.controllers.states().copied().chain(commands).collect()
    }

    /// Takes back what [`Self::state`] gave, bit for bit.
    ///
    /// # Errors
    /// [`StateError`] when the length is another law's; the law is then unchanged.
    pub fn set_state(&mut self, state: &[f64]) -> Result<(), StateError> {
        let sections = self.controllers.states().count();
        let expected = sections + 18 * self.waiting.len();
        if state.len() != expected {
            return Err(StateError { expected, found: state.len() });
        }
        let (controllers, commands) = state.split_at(sections);
        for (slot, value) in self.controllers.states_mut().zip(controllers) {
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
    use crate::mission::Control;
    use nalgebra::Matrix3;

    fn law() -> ControlLaw {
        ControlLaw::new(&taiji()).unwrap()
    }

    /// Deterministic readouts of about 1e-8 m and rad in every channel.
    fn readout(k: usize) -> Readout {
        let v = |i: usize| Vector3::from_fn(|j, _| 1e-8 * ((k * 7 + i * 3 + j) as f64).sin());
        let tm = |i: usize| TestMassReadout { r_orf_m: v(i), att_orf_rad: v(i + 1) };
        Readout { sc_crf_rad: v(0), tm: [tm(1), tm(3)], sun_srf: Some(Vector3::new(0.866, 0.1, -0.5)) }
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
        let limits = taiji().actuators.unwrap();
        assert!(c.reaches(&limits) && !Command::default().reaches(&limits));
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
            mission.control = Some(Control { delay_samples, ..Control::default() });
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
        mission.control = Some(Control { channel: channel.into(), ..Control::default() });
        let error = ControlLaw::new(&mission).err().unwrap().to_string();
        assert!(error.contains("control.channel.\"sc.phi\""), "{error}");
    }
}
