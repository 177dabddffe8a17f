//! The DFACS control law: a single-loop controller for each channel behind the static decoupling of the paper
//! (eq:decoupled_input_with_SRP), shared by the simulator and by the stage that replays it.
//!
//! One [`ControlLaw::step`] per sample turns the readout at `t_k` into the command that acts over `[t_k, t_{k+1})`.
//! With the default delay of one sample that command was computed from the readout at `t_{k−1}`.

use nalgebra::Vector3;
use std::collections::VecDeque;

use crate::control_design::design;
use crate::decoupling::{Allocator, LinearPlant};
use crate::mission::{Actuators, ChannelController, Mission, MissionError};
pub use crate::signals::{Command, PerTestMass, Readout, TestMassCommand, TestMassReadout};

const NEEDED_BY: &str = "the control law";

/// The `n`-th second-order section of every channel (direct form II transposed), rows over the channels.
struct Sections {
    b: [Vec<f64>; 3],
    a: [Vec<f64>; 2],
    states: [Vec<f64>; 2],
}

impl Sections {
    /// A channel without such a section passes its input through.
    fn new(controllers: &[&ChannelController], n: usize) -> Self {
        const UNIT: [f64; 5] = [1.0, 0.0, 0.0, 0.0, 0.0];
        let of = |coefficient: usize| -> Vec<f64> {
            controllers.iter().map(|c| c.sections.get(n).unwrap_or(&UNIT)[coefficient]).collect()
        };
        let zero = || vec![0.0; controllers.len()];
        Self { b: [of(0), of(1), of(2)], a: [of(3), of(4)], states: [zero(), zero()] }
    }

    fn step(&mut self, x: &mut [f64]) {
        // Slices of one length, so that the loop needs no checks.
        let width = x.len();
        let ([b0, b1, b2], [a1, a2]) = (self.b.each_ref().map(|v| &v[..width]), self.a.each_ref().map(|v| &v[..width]));
        let [s0, s1] = self.states.each_mut().map(|v| &mut v[..width]);
        for c in 0..width {
            let out = b0[c] * x[c] + s0[c];
            s0[c] = b1[c] * x[c] - a1[c] * out + s1[c];
            s1[c] = b2[c] * x[c] - a2[c] * out;
            x[c] = out;
        }
    }
}

/// The controllers of all channels.
struct Controllers {
    gain_s2: Vec<f64>,
    sections: Vec<Sections>,
    /// Readouts, overwritten by the outputs.
    values: Vec<f64>,
}

impl Controllers {
    fn new(controllers: &[&ChannelController]) -> Self {
        let longest = controllers.iter().map(|c| c.sections.len()).max().unwrap_or(0);
        Self {
            gain_s2: controllers.iter().map(|c| c.gain_s2).collect(),
            sections: (0..longest).map(|n| Sections::new(controllers, n)).collect(),
            values: vec![0.0; controllers.len()],
        }
    }

    /// `u_d = −gain · H(z) y`, channel by channel.
    fn step(&mut self, y: &Readout) -> &mut [f64] {
        let (spacecraft, test_masses) = self.values.split_at_mut(3);
        spacecraft.copy_from_slice(y.sc_crf_rad.as_slice());
        for (slots, tm) in test_masses.chunks_exact_mut(6).zip(&y.tm) {
            slots[..3].copy_from_slice(tm.r_orf_m.as_slice());
            slots[3..].copy_from_slice(tm.att_orf_rad.as_slice());
        }
        for sections in &mut self.sections {
            sections.step(&mut self.values);
        }
        for (value, gain) in self.values.iter_mut().zip(&self.gain_s2) {
            *value *= -gain;
        }
        &mut self.values
    }

    fn states(&self) -> impl Iterator<Item = &f64> {
        self.sections.iter().flat_map(|s| s.states.iter().flatten())
    }

    fn states_mut(&mut self) -> impl Iterator<Item = &mut f64> {
        self.sections.iter_mut().flat_map(|s| s.states.iter_mut().flatten())
    }
}

/// A saved state of another control law.
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
    allocation: Allocator,
    controllers: Controllers,
    limits: Option<Actuators>,
    /// `k_dSC`, N, and the arm of the force, SRF, m.
    sunlight: Option<(f64, Vector3<f64>)>,
    /// Delayed commands, oldest first; one per sample of delay.
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
        let channel = |name: &String| {
            control.channel.get(name).ok_or_else(|| MissionError::Missing {
                section: format!("control.channel.\"{name}\""),
                needed_by: NEEDED_BY,
            })
        };
        let channels = mission.channels();
        let controllers = Controllers::new(&channels.iter().map(channel).collect::<Result<Vec<_>, _>>()?);
        let plant = LinearPlant::new(mission)?;
        let allocation = Allocator::new(&plant.allocation()?);
        Ok(Self {
            plant,
            allocation,
            controllers,
            limits: mission.actuators.clone(),
            sunlight: mission.solar_pressure.as_ref().map(|s| (s.force_n, Vector3::from(s.arm_srf_m))),
            waiting: (0..control.delay_samples).map(|_| Command::zero(mission.test_mass.len())).collect(),
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
        let wanted = self.controllers.step(y);
        self.plant.take_stiffness_off(y, wanted);
        let mut command = self.allocation.command(&self.plant, wanted);
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

    /// The state: that of the controllers, then the delayed commands.
    pub fn state(&self) -> Vec<f64> {
        self.controllers.states().copied().chain(self.waiting.iter().flat_map(Command::numbers)).collect()
    }

    /// Restores [`Self::state`] exactly.
    ///
    /// # Errors
    /// [`StateError`] if the length differs; the law is then unchanged.
    pub fn set_state(&mut self, state: &[f64]) -> Result<(), StateError> {
        let sections = self.controllers.states().count();
        let width = self.plant.channels() + 3;
        let expected = sections + width * self.waiting.len();
        if state.len() != expected {
            return Err(StateError { expected, found: state.len() });
        }
        let (controllers, commands) = state.split_at(sections);
        for (slot, value) in self.controllers.states_mut().zip(controllers) {
            *slot = *value;
        }
        for (slot, values) in self.waiting.iter_mut().zip(commands.chunks_exact(width)) {
            *slot = Command::from_numbers(values);
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mission::Control;
    use crate::testing::taiji;
    use nalgebra::Matrix3;

    fn law() -> ControlLaw {
        ControlLaw::new(&taiji()).unwrap()
    }

    /// Deterministic readouts of about 1e-8 m and rad in every channel.
    fn readout(k: usize) -> Readout {
        let v = |i: usize| Vector3::from_fn(|j, _| 1e-8 * ((k * 7 + i * 3 + j) as f64).sin());
        let tm = |i: usize| TestMassReadout { r_orf_m: v(i), att_orf_rad: v(i + 1) };
        Readout { sc_crf_rad: v(0), tm: [tm(1), tm(3)].into(), sun_srf: Some(Vector3::new(0.866, 0.1, -0.5)) }
    }

    /// A displaced test mass pulls the spacecraft after it, a lateral one is pushed back: the signs of r̈ = −T F_T/m_S
    /// + F_E/m_m.
    #[test]
    fn commands_oppose_the_readout() {
        let mut y = Readout::zero(2);
        y.tm[0].r_orf_m = Vector3::new(1e-8, 1e-8, 0.0);
        y.tm[1].r_orf_m = Vector3::new(1e-8, 1e-8, 0.0);
        y.sc_crf_rad = Vector3::new(1e-8, 0.0, 0.0);
        let mut law = law();
        let first = law.step(&y);
        assert_eq!(first, Command::zero(2), "a sample of delay");
        let command = law.step(&y);
        assert!(command.mps_force_srf_n.x > 0.0 && command.mps_torque_srf_nm.x < 0.0, "{command:?}");
        assert!(command.tm[0].force_orf_n.y < 0.0 && command.tm[0].force_orf_n.x == 0.0, "{command:?}");
    }

    /// Mirrors eq:SRP_constant_estimate: with nothing to correct, thrust cancels sunlight and its torque.
    #[test]
    fn feed_forward_cancels_sunlight() {
        let sun = Vector3::new(0.6, 0.0, -0.8);
        let mut law = law();
        let y = Readout { sun_srf: Some(sun), ..Readout::zero(2) };
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
        assert!(c.reaches(&limits) && !Command::zero(2).reaches(&limits));
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
            let silent = (0..10).take_while(|_| law.step(&readout(1)) == Command::zero(2)).count();
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
