//! Noise that exceeds the mission file's from some time on, or has a spectral line.
//!
//! The excess is an independent process with `sqrt(k² − 1)` times the mission's shape, so that powers add to `k²`.

use dragfree_physics::mission::Mission;
use dragfree_physics::noise::NoiseShape;
use dragfree_physics::process::NoiseProcess;
use rand::RngExt;
use rand_xoshiro::Xoshiro256PlusPlus;
use std::f64::consts::TAU;

use super::correlation::noise_along_axes;
use super::request::{Built, EffectRequest, Kind, Number, Place, Shape, sc_axes, tm_axes};
use super::{Basis, Cause, Moment, along};
use crate::plant::{Loads, Plant};
use crate::sensors::Measured;

const FACTOR: Number = Number::new("1", 1.0, 100.0);
const LINE: &[Shape] = &[
    Shape::new("line_hz", Number::new("Hz", 0.0, 5.0), 0.0, "frequency of a line, 0 for none"),
    Shape::new(
        "line_rthz",
        Number::new("Hz^0.5", 0.0, 1e3),
        0.1,
        "amplitude of the line, in units of the mission's ASD above the corner",
    ),
    Shape::new("from_s", Number::new("s", 0.0, 1e8), 0.0, "when it begins"),
];

pub(super) const KINDS: &[Kind] = &[
    Kind {
        id: "mps-noise",
        places: sc_axes,
        size: FACTOR,
        help: "thrusters: the force noise along the axis has SIZE times the mission's ASD",
        shape: LINE,
        build: |request, basis| {
            noise_along_axes(basis.mission)?;
            let table = &basis.mission.noise.thruster_force;
            let shape = Mission::need(table, "noise.thruster_force", "mps-noise")?.shape();
            Excess::boxed(request, basis, &shape)
        },
    },
    Kind {
        id: "torque-noise",
        places: sc_axes,
        size: FACTOR,
        help: "thrusters: the torque noise about the axis has SIZE times the mission's ASD",
        shape: LINE,
        build: |request, basis| {
            noise_along_axes(basis.mission)?;
            let table = &basis.mission.noise.thruster_torque;
            let shape = Mission::need(table, "noise.thruster_torque", "torque-noise")?.shape();
            Excess::boxed(request, basis, &shape)
        },
    },
    Kind {
        id: "is-noise",
        places: tm_axes,
        size: FACTOR,
        help: "capacitive readout: the noise along the axis has SIZE times the mission's ASD",
        shape: LINE,
        build: |request, basis| {
            let noise = &basis.mission.noise;
            let (table, section) = match request.place {
                Place::TmAxis(_, 0) => (&noise.is_x, "noise.is_x"),
                Place::TmAxis(_, 1) => (&noise.is_y, "noise.is_y"),
                _ => (&noise.is_z, "noise.is_z"),
            };
            let shape = Mission::need(table, section, "is-noise")?.shape();
            Excess::boxed(request, basis, &shape)
        },
    },
];

struct Excess {
    id: &'static str,
    place: Place,
    process: NoiseProcess,
    line_hz: f64,
    line_amplitude: f64,
    line_phase_rad: f64,
    /// When it begins.
    from_s: f64,
}

impl Excess {
    fn boxed(request: &EffectRequest, basis: &Basis<'_>, shape: &NoiseShape) -> Built {
        let line_amplitude = request.shape("line_rthz") * shape.white_psd().sqrt();
        let factor = (request.size * request.size - 1.0).sqrt();
        let mut excess = shape.clone();
        excess.terms.iter_mut().for_each(|term| term.asd *= factor);
        Ok(Box::new(Self {
            id: request.kind.id,
            place: request.place,
            process: NoiseProcess::new(&excess, basis.mission.dt_s()),
            line_hz: request.shape("line_hz"),
            line_amplitude,
            line_phase_rad: 0.0,
            from_s: request.shape("from_s"),
        }))
    }

    fn next(&mut self, at_s: f64, rng: &mut Xoshiro256PlusPlus) -> f64 {
        let noise = self.process.next(rng);
        if at_s < self.from_s {
            0.0
        } else if self.line_hz > 0.0 {
            noise + self.line_amplitude * (TAU * (self.line_hz * at_s).fract() + self.line_phase_rad).sin()
        } else {
            noise
        }
    }
}

impl Cause for Excess {
    fn begin(&mut self, _plant: &mut Plant, rng: &mut Xoshiro256PlusPlus) {
        self.process.start(rng);
        self.line_phase_rad = TAU * rng.random::<f64>();
    }

    fn read(&mut self, now: &Moment<'_>, rng: &mut Xoshiro256PlusPlus, measured: &mut Measured) {
        if let Place::TmAxis(tm, axis) = self.place {
            measured.tm[tm].is_r_orf_m[axis] += self.next(now.elapsed_s, rng);
        }
    }

    fn push(&mut self, now: &Moment<'_>, rng: &mut Xoshiro256PlusPlus, loads: &mut Loads) {
        if let Place::ScAxis(axis) = self.place {
            let noise = along(axis) * self.next(now.elapsed_s + 0.5 * now.dt_s, rng);
            *(if self.id == "mps-noise" { &mut loads.force_srf_n } else { &mut loads.torque_srf_nm }) += noise;
        }
    }

    fn states(&self) -> Vec<f64> {
        std::iter::once(self.line_phase_rad).chain(self.process.states()).collect()
    }

    fn set_states(&mut self, states: &[f64]) -> bool {
        let slots: Vec<&mut f64> = std::iter::once(&mut self.line_phase_rad).chain(self.process.states_mut()).collect();
        crate::random::fill(slots, states)
    }
}
