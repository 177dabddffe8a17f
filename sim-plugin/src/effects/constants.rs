//! Constants of the plant that differ from the mission file.

use nalgebra::Vector3;
use rand_xoshiro::Xoshiro256PlusPlus;

use super::request::{EffectRequest, Kind, Number, Place, sc_axes, tm_axes};
use super::{Cause, along};
use crate::plant::Plant;

pub(super) const KINDS: &[Kind] = &[
    Kind {
        id: "com-offset",
        places: sc_axes,
        size: Number::new("m", -0.1, 0.1),
        help: "both housings sit this much farther along the axis, seen from the centre of mass",
        shape: &[],
        build: |request, _| Ok(Box::new(Constant(request.clone()))),
    },
    Kind {
        id: "stiffness",
        places: tm_axes,
        size: Number::new("s-2", -1e-4, 1e-4),
        help: "added to S_TT: acceleration per displacement; positive pushes away from the centre",
        shape: &[],
        build: |request, _| Ok(Box::new(Constant(request.clone()))),
    },
    Kind {
        id: "cross-stiffness",
        places: tm_axes,
        size: Number::new("m s-2 rad-1", -1e-5, 1e-5),
        help: "added to S_TR: acceleration along the axis per angle about it, and the torque that belongs to it",
        shape: &[],
        build: |request, _| Ok(Box::new(Constant(request.clone()))),
    },
];

struct Constant(EffectRequest);

impl Cause for Constant {
    fn begin(&mut self, plant: &mut Plant, _rng: &mut Xoshiro256PlusPlus) {
        let size = self.0.size;
        match (self.0.kind.id, self.0.place) {
            ("com-offset", Place::ScAxis(axis)) => {
                let offset: Vector3<f64> = along(axis) * size;
                plant.tm.iter_mut().for_each(|tm| tm.offset_srf_m += offset);
            }
            ("stiffness", Place::TmAxis(tm, axis)) => plant.tm[tm].stiffness_tt[(axis, axis)] += size,
            (_, Place::TmAxis(tm, axis)) => {
                let body = &mut plant.tm[tm];
                body.stiffness_tr[(axis, axis)] += size;
                // Force and torque derive from one potential: J_m S_RT = m S_TRᵀ.
                let torque = along(axis) * (size * body.mass_kg);
                body.stiffness_rt += body.inertia_inverse * torque * along(axis).transpose();
            }
            _ => {}
        }
    }
}
