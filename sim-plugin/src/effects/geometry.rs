//! Geometry that changes with time: drift of the centre of mass, opening of the optical axes.

use dragfree_physics::frames::dcm_turned_about_z;

use super::request::{Built, EffectRequest, Kind, Number, Place, Shape, sc_axes, test_masses};
use super::{Basis, Cause, along};
use crate::interior::Interior;
use crate::plant::Plant;

pub(super) const KINDS: &[Kind] = &[
    Kind {
        id: "offset-drift",
        places: sc_axes,
        size: Number::new("m s-1", -1e-5, 1e-5),
        help: "both housings wander along the axis, seen from the centre of mass, by SIZE per second, and by what follows",
        shape: &[
            Shape::new("kappa_m_k", Number::new("m K-1", -1e-3, 1e-3), 0.0, "per kelvin of the structure, m/K"),
            Shape::new("beta_m_kg", Number::new("m kg-1", -1.0, 1.0), 0.0, "per kilogram of propellant spent, m/kg"),
        ],
        build,
    },
    Kind {
        id: "opening-angle",
        places: test_masses,
        size: Number::new("rad", -0.5, 0.5),
        help: "the optical frame is turned by SIZE about s_3 beyond the mission's angle",
        shape: &[
            Shape::new("rate_rad_s", Number::new("rad s-1", -1e-6, 1e-6), 0.0, "and by this per second, rad/s"),
            Shape::new(
                "follow",
                Number::new("1", -2.0, 2.0),
                0.0,
                "and by this part of what half the opening angle grows",
            ),
        ],
        build,
    },
];

fn build(request: &EffectRequest, basis: &Basis<'_>) -> Built {
    Ok(match request.place {
        Place::ScAxis(axis) => Box::new(OffsetDrift {
            axis,
            rate_m_s: request.size,
            kappa_m_k: request.shape("kappa_m_k"),
            beta_m_kg: request.shape("beta_m_kg"),
        }),
        Place::Tm(tm) => Box::new(Opening {
            tm,
            angle_rad: request.size,
            rate_rad_s: request.shape("rate_rad_s"),
            follow: request.shape("follow"),
            side: basis.mission.test_mass.values().nth(tm).map_or(1.0, |tm| tm.orf_from_srf_angle_rad.signum()),
        }),
        _ => unreachable!("instances are axes and test masses"),
    })
}

/// `b(t) = b + ḃ t + κ (T − T_0) + β (m_0 − m)`, `t` from the first sample.
struct OffsetDrift {
    axis: usize,
    rate_m_s: f64,
    kappa_m_k: f64,
    beta_m_kg: f64,
}

impl Cause for OffsetDrift {
    fn moves(&self) -> bool {
        true
    }

    fn reshape(&self, elapsed_s: f64, inside: &Interior, plant: &mut Plant) {
        let (tank_kg, structure_k) = inside.smooth(elapsed_s);
        let (warmer_k, spent_kg) = (structure_k - inside.structure_first_k, inside.tank_first_kg - tank_kg);
        let drift_m = self.rate_m_s * elapsed_s + self.kappa_m_k * warmer_k + self.beta_m_kg * spent_kg;
        plant.tm.iter_mut().for_each(|tm| tm.offset_srf_m += along(self.axis) * drift_m);
    }
}

/// `T_S^O(t)`. The rate of the frame is neglected in the equations of motion.
struct Opening {
    tm: usize,
    angle_rad: f64,
    rate_rad_s: f64,
    follow: f64,
    /// Sign of the mission's angle of the frame: the frames open in opposite directions.
    side: f64,
}

impl Cause for Opening {
    fn moves(&self) -> bool {
        true
    }

    fn reshape(&self, elapsed_s: f64, inside: &Interior, plant: &mut Plant) {
        let half_rad = 0.5 * self.follow * (inside.opening_rad - inside.opening_first_rad);
        let followed_rad = if self.side > 0.0 { half_rad } else { -half_rad };
        let body = &mut plant.tm[self.tm];
        let turn = dcm_turned_about_z(self.angle_rad + self.rate_rad_s * elapsed_s + followed_rad);
        body.dcm_orf_from_srf = turn * body.dcm_orf_from_srf;
    }
}
