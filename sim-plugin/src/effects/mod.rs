//! Physical effects that are unknown to the controller and to the model of a calibration, computed from true states.
//!
//! An effect is requested as `ID:INSTANCE=SIZE[,NAME=VALUE]...` ([`EffectRequest::parse`]); [`catalogue`] lists all of
//! them. Each becomes a [`Cause`] that acts inside the control loop. A module holds a family of effects.

mod actuators;
mod constants;
mod correlation;
mod geometry;
mod noise;
mod pushes;
mod readout;
mod request;
mod slosh;
mod stray;

use dragfree_physics::control::Command;
use dragfree_physics::mission::Mission;
use nalgebra::Vector3;
use rand_xoshiro::Xoshiro256PlusPlus;
use serde::{Deserialize, Serialize};

use crate::interior::Interior;
use crate::plant::{Loads, Plant, State};
use crate::random::stream;
use crate::sensors::Measured;
pub use request::{Built, EffectError, EffectRequest, Kind, Number, Place, Shape};

/// Every kind of effect.
pub fn catalogue() -> impl Iterator<Item = &'static Kind> {
    [
        constants::KINDS,
        geometry::KINDS,
        actuators::KINDS,
        noise::KINDS,
        correlation::KINDS,
        readout::KINDS,
        stray::KINDS,
        slosh::KINDS,
        pushes::KINDS,
    ]
    .into_iter()
    .flatten()
}

/// True quantities at `t_k`.
pub struct Moment<'a> {
    /// Since the first sample of the telemetry; negative while the loop settles, s.
    pub elapsed_s: f64,
    /// Sample interval, s.
    pub dt_s: f64,
    /// True state.
    pub state: &'a State,
    /// True plant.
    pub plant: &'a Plant,
    /// Interior of the spacecraft.
    pub inside: &'a Interior,
    /// `ω_CI`, CRF, rad/s.
    pub omega_crf_rad_s: Vector3<f64>,
    /// Force of sunlight over the coming sample, SRF, N; zero before it is known.
    pub sunlight_srf_n: Vector3<f64>,
}

/// A running effect. Each method corresponds to a point of the loop; most effects implement one of them.
///
/// Each effect has its own random stream, so that adding one changes no other noise.
pub trait Cause: Send {
    /// Changes constants of the plant before the loop is closed.
    fn begin(&mut self, _plant: &mut Plant, _rng: &mut Xoshiro256PlusPlus) {}

    /// Whether it replaces the mission's thruster noise along the axes.
    fn replaces_thruster_noise(&self) -> bool {
        false
    }

    /// Whether [`Self::reshape`] does anything.
    fn moves(&self) -> bool {
        false
    }

    /// Changes the geometry of the plant from the initial one to that of an instant.
    fn reshape(&self, _elapsed_s: f64, _inside: &Interior, _plant: &mut Plant) {}

    /// Changes the readouts at `t_k`.
    fn read(&mut self, _now: &Moment<'_>, _rng: &mut Xoshiro256PlusPlus, _measured: &mut Measured) {}

    /// Changes the forces and torques that result from the command over `[t_k, t_{k+1})`, `elapsed_s` after the first
    /// sample of the telemetry.
    fn act(&mut self, _elapsed_s: f64, _command: &Command, _acting: &mut Command) {}

    /// Adds loads over `[t_k, t_{k+1})`.
    fn push(&mut self, _now: &Moment<'_>, _rng: &mut Xoshiro256PlusPlus, _loads: &mut Loads) {}

    /// Adds loads that depend on all other loads.
    fn react(&mut self, _now: &Moment<'_>, _loads: &mut Loads) {}

    /// State, for a checkpoint.
    fn states(&self) -> Vec<f64> {
        Vec::new()
    }

    /// Restores [`Self::states`]; false if the length differs.
    fn set_states(&mut self, states: &[f64]) -> bool {
        states.is_empty()
    }
}

/// Data other than the request from which effects are built.
pub struct Basis<'a> {
    /// The mission.
    pub mission: &'a Mission,
}

struct Active {
    cause: Box<dyn Cause>,
    rng: Xoshiro256PlusPlus,
}

/// The effects of a simulation; often none.
#[derive(Default)]
pub struct Effects(Vec<Active>);

/// State of one effect.
#[derive(Serialize, Deserialize)]
pub struct Saved {
    rng: Xoshiro256PlusPlus,
    states: Vec<f64>,
}

impl Effects {
    /// The requested effects.
    ///
    /// # Errors
    /// [`EffectError::Mission`] if the mission lacks a section.
    pub fn new(request: &[EffectRequest], basis: &Basis<'_>, seed: u64) -> Result<Self, EffectError> {
        let name = |a: &EffectRequest| format!("{}:{}", a.kind.id, a.instance);
        let active = request.iter().enumerate().map(|(i, one)| {
            // The random stream does not depend on the size.
            let before = request[..i].iter().filter(|other| name(other) == name(one)).count();
            Ok(Active { cause: one.cause(basis)?, rng: stream(seed, &format!("{} {before}", name(one))) })
        });
        Ok(Self(active.collect::<Result<_, EffectError>>()?))
    }

    /// Changes the plant before the loop is closed.
    pub fn begin(&mut self, plant: &mut Plant) {
        for Active { cause, rng } in &mut self.0 {
            cause.begin(plant, rng);
        }
    }

    /// Whether the mission's thruster noise along the axes is replaced.
    pub fn replace_thruster_noise(&self) -> bool {
        self.0.iter().any(|active| active.cause.replaces_thruster_noise())
    }

    /// Whether the geometry changes with time.
    pub fn moves(&self) -> bool {
        self.0.iter().any(|active| active.cause.moves())
    }

    /// Changes the geometry of the plant from the initial one to that of an instant.
    pub fn reshape(&self, elapsed_s: f64, inside: &Interior, plant: &mut Plant) {
        for active in &self.0 {
            active.cause.reshape(elapsed_s, inside, plant);
        }
    }

    /// Changes the readouts at `t_k`.
    pub fn read(&mut self, now: &Moment<'_>, measured: &mut Measured) {
        for Active { cause, rng } in &mut self.0 {
            cause.read(now, rng, measured);
        }
    }

    /// Forces and torques that result from a command `elapsed_s` after the first sample of the telemetry.
    pub fn act(&mut self, elapsed_s: f64, command: &Command) -> Command {
        let mut acting = *command;
        for active in &mut self.0 {
            active.cause.act(elapsed_s, command, &mut acting);
        }
        acting
    }

    /// Adds loads over the coming sample.
    pub fn push(&mut self, now: &Moment<'_>, loads: &mut Loads) {
        for Active { cause, rng } in &mut self.0 {
            cause.push(now, rng, loads);
        }
        for active in &mut self.0 {
            active.cause.react(now, loads);
        }
    }

    /// The states, for a checkpoint.
    pub fn save(&self) -> Vec<Saved> {
        self.0.iter().map(|a| Saved { rng: a.rng.clone(), states: a.cause.states() }).collect()
    }

    /// Restores [`Self::save`]; false for a state of other effects.
    pub fn load(&mut self, saved: &[Saved]) -> bool {
        saved.len() == self.0.len()
            && self.0.iter_mut().zip(saved).all(|(active, saved)| {
                active.rng = saved.rng.clone();
                active.cause.set_states(&saved.states)
            })
    }
}

/// The unit vector along an axis.
fn along(axis: usize) -> Vector3<f64> {
    Vector3::from_fn(|i, _| f64::from(i == axis))
}
