//! Where the spacecraft is and how the constellation turns: what CRF, the gravity gradient and the Sun's direction need.
//!
//! An analytic stand-in for a propagated constellation under DE440, which will replace [`Environment::at`] and nothing
//! else: a circular heliocentric orbit in the ecliptic, 20° behind an Earth on a circle, and a rigid triangle whose
//! plane leans 60° against the ecliptic and that turns in it once a year, backwards.

use nalgebra::{Matrix3, Vector3};

/// Astronomical unit, m (IAU 2012).
const AU_M: f64 = 149_597_870_700.0;
/// Gravitational parameter of the Sun, m³ s⁻² (DE440).
const MU_SUN_M3_S2: f64 = 1.327_124_400_412_794_2e20;
/// Gravitational parameter of the Earth, m³ s⁻² (DE440).
const MU_EARTH_M3_S2: f64 = 3.986_004_355_070_226e14;
/// J2000, 2000-01-01T12:00, Unix s.
const J2000_UNIX_S: i64 = 946_728_000;
/// Mean longitude of the Earth at J2000, rad.
const EARTH_LONGITUDE_RAD: f64 = 100.464_57 * DEGREE;
/// Angle by which the constellation trails the Earth.
const TRAILING_RAD: f64 = 20.0 * DEGREE;
/// Obliquity of the ecliptic at J2000, rad.
const OBLIQUITY_RAD: f64 = 23.439_291_1 * DEGREE;
const DEGREE: f64 = std::f64::consts::PI / 180.0;

/// The surroundings at one instant.
#[derive(Clone, Debug)]
pub struct Environment {
    /// Spacecraft relative to the Sun, IRF, m.
    pub r_sc_irf_m: Vector3<f64>,
    /// Its velocity, IRF, m/s.
    pub v_sc_irf_m_s: Vector3<f64>,
    /// CRF relative to IRF, in CRF, rad/s.
    pub omega_crf_rad_s: Vector3<f64>,
    /// Its derivative, in CRF, rad/s².
    pub alpha_crf_rad_s2: Vector3<f64>,
    /// Unit vector from the Sun to the spacecraft, CRF.
    pub sun_crf: Vector3<f64>,
    /// Gradient `Γ` of the gravity of Sun and Earth, CRF, s⁻².
    pub gradient_crf_s2: Matrix3<f64>,
}

impl Environment {
    /// The surroundings at a time, Unix ns.
    #[must_use]
    pub fn at(time_ns: i64) -> Self {
        let motion_rad_s = (MU_SUN_M3_S2 / AU_M.powi(3)).sqrt();
        let elapsed_s = (time_ns - J2000_UNIX_S * 1_000_000_000) as f64 * 1e-9;
        let longitude = EARTH_LONGITUDE_RAD - TRAILING_RAD + motion_rad_s * elapsed_s;
        let phase = -motion_rad_s * elapsed_s;

        // Hill's directions: radial, along the orbit, ecliptic north.
        let (s, c) = longitude.sin_cos();
        let to_irf = |v: Vector3<f64>| {
            let (so, co) = OBLIQUITY_RAD.sin_cos();
            let (x, y, z) = (c * v.x - s * v.y, s * v.x + c * v.y, v.z);
            Vector3::new(x, co * y - so * z, so * y + co * z)
        };
        // The plane of the triangle: p_z leans 60° from ecliptic north towards the Sun, so that sunlight falls in at
        // 30° to it the year round; p_y is along the orbit. CRF is that plane's frame turned by `phase` about p_z.
        let (st, ct) = (60.0 * DEGREE).sin_cos();
        let crf_from_plane = dragfree_physics::frames::dcm_turned_about_z(phase);
        let crf_from_hill = crf_from_plane * Matrix3::new(ct, 0.0, st, 0.0, 1.0, 0.0, -st, 0.0, ct);

        let radial = Vector3::x();
        let (se, ce) = TRAILING_RAD.sin_cos();
        let to_earth = AU_M * Vector3::new(ce - 1.0, se, 0.0);
        let tidal = |direction: Vector3<f64>, mu: f64, distance: f64| {
            (3.0 * direction * direction.transpose() - Matrix3::identity()) * (mu / distance.powi(3))
        };
        let gradient_hill =
            tidal(radial, MU_SUN_M3_S2, AU_M) + tidal(to_earth.normalize(), MU_EARTH_M3_S2, to_earth.norm());

        // ω = n north − n p_z: the plane follows the orbit, the triangle turns back in it.
        let omega_plane = motion_rad_s * Vector3::new(st, 0.0, ct - 1.0);
        // A vector fixed in the plane's frame turns with −phase' about p_z as seen from CRF.
        let alpha_plane = -Vector3::new(0.0, 0.0, -motion_rad_s).cross(&omega_plane);
        Self {
            r_sc_irf_m: to_irf(AU_M * radial),
            v_sc_irf_m_s: to_irf(Vector3::new(0.0, AU_M * motion_rad_s, 0.0)),
            omega_crf_rad_s: crf_from_plane * omega_plane,
            alpha_crf_rad_s2: crf_from_plane * alpha_plane,
            sun_crf: crf_from_hill * radial,
            gradient_crf_s2: crf_from_hill * gradient_hill * crf_from_hill.transpose(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const T_NS: i64 = 2_051_222_400_000_000_000;

    #[test]
    fn the_gradient_stretches_along_the_sun() {
        let e = Environment::at(T_NS);
        let along = e.sun_crf.dot(&(e.gradient_crf_s2 * e.sun_crf));
        // 2 μ/R³ = 7.9e-14 s⁻²; the Earth adds 7e-5 of it.
        assert!((along / 7.928e-14 - 1.0).abs() < 1e-3, "{along}");
        assert!(e.gradient_crf_s2.trace().abs() < 1e-27, "no mass where the spacecraft is");
    }

    #[test]
    fn the_constellation_turns_once_a_year() {
        let e = Environment::at(T_NS);
        assert!((e.omega_crf_rad_s.norm() / 1.991e-7 - 1.0).abs() < 1e-3);
        assert!((e.sun_crf.norm() - 1.0).abs() < 1e-15 && (e.sun_crf.z + 30_f64.to_radians().cos()).abs() < 1e-12);
        assert!((e.r_sc_irf_m.norm() / AU_M - 1.0).abs() < 1e-12);
        assert!(e.r_sc_irf_m.dot(&e.v_sc_irf_m_s).abs() < 1e-3 * AU_M);
    }

    /// `ω̇` against a difference, and the Sun's apparent motion in CRF against `ω`: `ṡ_CRF = n×s − ω×s` with the orbit's
    /// own motion n about ecliptic north.
    #[test]
    fn rates_are_derivatives() {
        let h_s = 1000.0;
        let at = |s: f64| Environment::at(T_NS + (s * 1e9) as i64);
        let e = at(0.0);
        let alpha = (at(h_s).omega_crf_rad_s - at(-h_s).omega_crf_rad_s) / (2.0 * h_s);
        assert!((alpha - e.alpha_crf_rad_s2).norm() < 1e-6 * alpha.norm(), "{alpha}");
        let sun = (at(h_s).sun_crf - at(-h_s).sun_crf) / (2.0 * h_s);
        let motion_rad_s = (MU_SUN_M3_S2 / AU_M.powi(3)).sqrt();
        // n sits at 60° from the plane's normal in the Sun's meridian: n = ω + n p_z, p_z = c_3.
        let orbit = e.omega_crf_rad_s + Vector3::z() * motion_rad_s;
        let want = (orbit - e.omega_crf_rad_s).cross(&e.sun_crf);
        assert!((sun - want).norm() < 1e-6 * want.norm(), "{sun} {want}");
    }
}
