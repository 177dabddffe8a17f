//! External and transient loads: sunlight, micrometeoroids, glitches of a test mass, moves of the antenna.

use dragfree_physics::mission::Mission;
use nalgebra::Vector3;
use rand_xoshiro::Xoshiro256PlusPlus;

use super::request::{Built, EffectRequest, Kind, Number, Place, Shape, sc_angles, sc_axes, tm_axes};
use super::{Basis, Cause, Moment, along};
use crate::plant::Loads;

const ARM: Number = Number::new("m", -10.0, 10.0);
const SECONDS: Number = Number::new("s", 0.0, 1e9);

pub(super) const KINDS: &[Kind] = &[
    Kind {
        id: "solar-pressure",
        places: |_| vec![Place::Spacecraft],
        size: Number::new("1", -1.0, 10.0),
        help: "sunlight pushes (1 + SIZE) times as hard, at the mission's arm and what is added to it",
        shape: &[
            Shape::new("arm_x_m", ARM, 0.0, "added to the arm, SRF x, m"),
            Shape::new("arm_y_m", ARM, 0.0, "the same, y, m"),
            Shape::new("arm_z_m", ARM, 0.0, "the same, z, m"),
        ],
        build: solar_pressure,
    },
    Kind {
        id: "impulse",
        places: |count| [sc_axes(count), sc_angles(count), tm_axes(count)].concat(),
        size: Number::new("N s", -1.0, 1.0),
        help: "sc.x: a micrometeoroid's momentum; NAME.x: a glitch's; sc.phi: angular momentum (N m s) that each move of \
               the antenna takes at its start and gives back at its end",
        shape: &[
            Shape::new("at_s", SECONDS, 3600.0, "seconds after the first sample"),
            Shape::new("arm_x_m", ARM, 0.5, "sc.x: where it hits, SRF x, m"),
            Shape::new("arm_y_m", ARM, 0.5, "the same, y, m"),
            Shape::new("arm_z_m", ARM, 0.3, "the same, z, m"),
            Shape::new("rise_s", Number::new("s", 0.0, 1e5), 5.0, "NAME.x: rise, s"),
            Shape::new("decay_s", Number::new("s", 1e-3, 1e5), 60.0, "NAME.x: decay, s"),
            Shape::new("pulse_s", Number::new("s", 0.1, 1e4), 10.0, "sc.phi: its length, s"),
        ],
        build: impulse,
    },
];

fn arm(request: &EffectRequest) -> Vector3<f64> {
    Vector3::new(request.shape("arm_x_m"), request.shape("arm_y_m"), request.shape("arm_z_m"))
}

struct SolarPressure {
    size: f64,
    arm_srf_m: Vector3<f64>,
    added_srf_m: Vector3<f64>,
}

fn solar_pressure(request: &EffectRequest, basis: &Basis<'_>) -> Built {
    let section = Mission::need(&basis.mission.solar_pressure, "solar_pressure", "the effect solar-pressure")?;
    let arm_srf_m = Vector3::from(section.arm_srf_m);
    Ok(Box::new(SolarPressure { size: request.size, arm_srf_m, added_srf_m: arm(request) }))
}

impl Cause for SolarPressure {
    fn push(&mut self, now: &Moment<'_>, _rng: &mut Xoshiro256PlusPlus, loads: &mut Loads) {
        let more = now.sunlight_srf_n * self.size;
        loads.force_srf_n += more;
        loads.torque_srf_nm += self.arm_srf_m.cross(&more) + self.added_srf_m.cross(&(now.sunlight_srf_n + more));
    }
}

fn impulse(request: &EffectRequest, _: &Basis<'_>) -> Built {
    let size = request.size;
    let at_s = request.shape("at_s");
    Ok(match request.place {
        Place::TmAxis(tm, axis) => {
            let (rise_s, decay_s) = (request.shape("rise_s"), request.shape("decay_s"));
            Box::new(Glitch { tm, axis, momentum_n_s: size, at_s, rise_s, decay_s })
        }
        Place::ScAngle(axis) => {
            let momentum_n_m_s = along(axis) * size;
            Box::new(Antenna {
                momentum_n_m_s,
                pulse_s: request.shape("pulse_s"),
                moved: false,
                sign: 0.0,
                left_s: 0.0,
            })
        }
        Place::ScAxis(axis) => Box::new(Hit { momentum_n_s: along(axis) * size, arm_srf_m: arm(request), at_s }),
        _ => unreachable!("instances are axes and angles"),
    })
}

/// A micrometeoroid: its momentum within one sample.
struct Hit {
    momentum_n_s: Vector3<f64>,
    arm_srf_m: Vector3<f64>,
    at_s: f64,
}

impl Cause for Hit {
    fn push(&mut self, now: &Moment<'_>, _rng: &mut Xoshiro256PlusPlus, loads: &mut Loads) {
        // The sample whose interval contains the hit; times are rounded multiples of the interval.
        let sample = |s: f64| (s / now.dt_s + 1e-6).floor();
        if sample(now.elapsed_s) == sample(self.at_s) {
            let force = self.momentum_n_s / now.dt_s;
            loads.force_srf_n += force;
            loads.torque_srf_nm += self.arm_srf_m.cross(&force);
        }
    }
}

/// A force on a test mass as `(e^{−t/τ1} − e^{−t/τ2})/(τ1 − τ2)`, as LISA Pathfinder saw them (2205.11938).
struct Glitch {
    tm: usize,
    axis: usize,
    momentum_n_s: f64,
    at_s: f64,
    rise_s: f64,
    decay_s: f64,
}

impl Glitch {
    /// Fraction of the momentum delivered after `t` seconds.
    fn given(&self, t: f64) -> f64 {
        let (rise, decay) = (self.rise_s, self.decay_s);
        if t <= 0.0 {
            0.0
        } else if (decay - rise).abs() < 1e-6 * decay {
            1.0 - (1.0 + t / decay) * (-t / decay).exp()
        } else {
            let left = |tau: f64| if tau > 0.0 { tau * (-t / tau).exp() } else { 0.0 };
            1.0 - (left(decay) - left(rise)) / (decay - rise)
        }
    }
}

impl Cause for Glitch {
    fn push(&mut self, now: &Moment<'_>, _rng: &mut Xoshiro256PlusPlus, loads: &mut Loads) {
        let since_s = now.elapsed_s - self.at_s;
        let part = self.given(since_s + now.dt_s) - self.given(since_s);
        let acceleration = self.momentum_n_s * part / (now.dt_s * now.plant.tm[self.tm].mass_kg);
        loads.tm[self.tm].acceleration_orf_m_s2[self.axis] += acceleration;
    }
}

/// Angular momentum that a move of the antenna takes at its start and returns at its end.
struct Antenna {
    momentum_n_m_s: Vector3<f64>,
    pulse_s: f64,
    moved: bool,
    sign: f64,
    left_s: f64,
}

impl Cause for Antenna {
    fn push(&mut self, now: &Moment<'_>, _rng: &mut Xoshiro256PlusPlus, loads: &mut Loads) {
        let moves = now.inside.antenna_moves;
        if moves != self.moved {
            (self.moved, self.left_s) = (moves, self.pulse_s);
            self.sign = if moves { 1.0 } else { -1.0 };
        }
        let part = (self.left_s / now.dt_s).clamp(0.0, 1.0);
        loads.torque_srf_nm += self.momentum_n_m_s * (self.sign * part / self.pulse_s);
        self.left_s -= part * now.dt_s;
    }

    fn states(&self) -> Vec<f64> {
        vec![f64::from(self.moved), self.sign, self.left_s]
    }

    fn set_states(&mut self, states: &[f64]) -> bool {
        let [moved, sign, left_s] = states else { return false };
        (self.moved, self.sign, self.left_s) = (*moved != 0.0, *sign, *left_s);
        true
    }
}
