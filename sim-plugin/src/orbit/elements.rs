//! The triangle at its epoch: three Kepler orbits of one eccentricity and inclination, a third of a turn apart.
//!
//! S. V. Dhurandhar et al., Class. Quantum Grav. 22 (2005) 481, with the tilt of K. R. Nayak et al., Class. Quantum
//! Grav. 23 (2006) 1763: π/3 + 5α/8 for the angle between triangle and ecliptic, where α is arm length over the
//! diameter of the Earth's orbit, which leaves the arms least flexing. For Taiji: B. Wu et al., Phys. Rev. D 100 (2019)
//! 122001.

use nalgebra::{Matrix3, Vector3};

use super::motion::{MU_SUN_M3_S2, State};

/// Astronomical unit, m (IAU 2012); here the semi-major axis.
pub(super) const AU_M: f64 = 149_597_870_700.0;
/// Obliquity of the ecliptic at J2000, 84381.448″ (IAU 1976), rad.
const OBLIQUITY_RAD: f64 = 84_381.448 / 3600.0 * std::f64::consts::PI / 180.0;

/// Components in IRF from components on the ecliptic of J2000.
pub(super) fn dcm_irf_from_ecliptic() -> Matrix3<f64> {
    let (s, c) = OBLIQUITY_RAD.sin_cos();
    Matrix3::new(1.0, 0.0, 0.0, 0.0, c, -s, 0.0, s, c)
}

/// SC1, SC2 and SC3 around a centre at the given ecliptic longitude, SC1 at its aphelion and highest above the
/// ecliptic.
pub(super) fn triangle(longitude_rad: f64, arm_m: f64) -> [State; 3] {
    let alpha = arm_m / (2.0 * AU_M);
    let (e, inclination) = shape(alpha, std::f64::consts::FRAC_PI_3 + 0.625 * alpha);
    let third = std::f64::consts::TAU / 3.0;
    [0.0, third, 2.0 * third].map(|turn| on_orbit(e, inclination, longitude_rad + turn, -turn))
}

/// Eccentricity and inclination, rad, that put an aphelion where the vertex of a triangle tilted by `tilt_rad` is.
fn shape(alpha: f64, tilt_rad: f64) -> (f64, f64) {
    // From the triangle's centre to a vertex, in semi-major axes.
    let side = 2.0 / 3_f64.sqrt() * alpha;
    let (out, up) = (1.0 + side * tilt_rad.cos(), side * tilt_rad.sin());
    (out.hypot(up) - 1.0, up.atan2(out))
}

/// A spacecraft whose aphelion, the highest point of its orbit, has the longitude `apse_rad`, at `anomaly_rad` from
/// there.
pub(super) fn on_orbit(e: f64, inclination_rad: f64, apse_rad: f64, anomaly_rad: f64) -> State {
    // Counted from aphelion, Kepler's equation is E + e sin E = M.
    let mut anomaly = anomaly_rad;
    for _ in 0..20 {
        anomaly -= (anomaly + e * anomaly.sin() - anomaly_rad) / (1.0 + e * anomaly.cos());
    }
    let (sin, cos) = anomaly.sin_cos();
    let minor = (1.0 - e * e).sqrt();
    let rate_rad_s = (MU_SUN_M3_S2 / AU_M.powi(3)).sqrt() / (1.0 + e * cos);
    let (si, ci) = inclination_rad.sin_cos();
    let (sl, cl) = apse_rad.sin_cos();
    // The line of apses first, then across it in the orbit's plane.
    let along = Vector3::new(cl * ci, sl * ci, si);
    let across = Vector3::new(-sl, cl, 0.0);
    let irf = dcm_irf_from_ecliptic() * AU_M;
    State {
        r_irf_m: irf * (along * (cos + e) + across * (minor * sin)),
        v_irf_m_s: irf * (across * (minor * cos) - along * sin) * rate_rad_s,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Each orbit has the semi-major axis of one astronomical unit: `v² = μ(2/r − 1/a)`.
    #[test]
    fn the_triangle_is_equilateral_and_circles_in_a_year() {
        let arm_m = 3e9;
        let states = triangle(1.2, arm_m);
        for s in &states {
            let a_m = 1.0 / (2.0 / s.r_irf_m.norm() - s.v_irf_m_s.norm_squared() / MU_SUN_M3_S2);
            assert!((a_m / AU_M - 1.0).abs() < 1e-14, "{a_m}");
        }
        for (i, j) in [(0, 1), (1, 2), (2, 0)] {
            let arm = (states[i].r_irf_m - states[j].r_irf_m).norm();
            // Second order in α = 0.01: half a per cent.
            assert!((arm / arm_m - 1.0).abs() < 0.01, "{arm}");
        }
        let ecliptic = dcm_irf_from_ecliptic().tr_mul(&states[0].r_irf_m);
        assert!((ecliptic.y.atan2(ecliptic.x) - 1.2).abs() < 1e-12 && ecliptic.z > 0.0);
    }

    /// Arms of 5e9 m, the Sun alone, one year. K. R. Nayak et al. (IUCAA preprint 31/05, "Reducing the flexing of the
    /// arms of LISA") tell a flexing of about 48,000 km where the untilted triangle has 115,000 km.
    #[test]
    fn the_tilt_leaves_the_published_flexing() {
        let alpha = 5e9 / (2.0 * AU_M);
        let flexing_m = |tilt_rad: f64| {
            let (e, inclination) = shape(alpha, tilt_rad);
            let third = std::f64::consts::TAU / 3.0;
            let arms = (0..360).map(|degree| {
                let anomaly = f64::from(degree).to_radians();
                let [a, b] = [0.0, third].map(|turn| on_orbit(e, inclination, turn, anomaly - turn).r_irf_m);
                (b - a).norm()
            });
            let (least, most) = arms.fold((f64::INFINITY, 0.0_f64), |(lo, hi), arm| (lo.min(arm), hi.max(arm)));
            most - least
        };
        let third_of_pi = std::f64::consts::FRAC_PI_3;
        // Two digits and three are what the abstract gives.
        let (tilted_m, untilted_m) = (flexing_m(third_of_pi + 0.625 * alpha), flexing_m(third_of_pi));
        assert!(
            (tilted_m / 48e6 - 1.0).abs() < 0.01 && (untilted_m / 115e6 - 1.0).abs() < 0.01,
            "{tilted_m} {untilted_m}"
        );
    }
}
