//! Geometry that changes with time: the centre of mass wanders, the optical axes open.

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
            Shape {
                name: "kappa_m_k",
                number: Number::new("m K-1", -1e-3, 1e-3),
                default: 0.0,
                help: "per kelvin of the structure, m/K",
            },
            Shape {
                name: "beta_m_kg",
                number: Number::new("m kg-1", -1.0, 1.0),
                default: 0.0,
                help: "per kilogram of propellant spent, m/kg",
            },
        ],
        build,
    },
    Kind {
        id: "opening-angle",
        places: test_masses,
        size: Number::new("rad", -0.5, 0.5),
        help: "the optical frame is turned by SIZE about s_3 beyond the mission's angle",
        shape: &[
            Shape {
                name: "rate_rad_s",
                number: Number::new("rad s-1", -1e-6, 1e-6),
                default: 0.0,
                help: "and by this per second, rad/s",
            },
            Shape {
                name: "follow",
                number: Number::new("1", -2.0, 2.0),
                default: 0.0,
                help: "and by this part of what half the opening angle grows",
            },
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

/// `T_S^O(t)`. The frame's own rate, some nrad/s, adds less than 1e-17 m/s² and is left out of the equations of motion.
struct Opening {
    tm: usize,
    angle_rad: f64,
    rate_rad_s: f64,
    follow: f64,
    /// Sign of the angle by which the mission turns the frame: the frames open away from each other.
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
