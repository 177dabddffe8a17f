//! The constellation's frame and how it turns (eqs TCI_transformation, CRF_angular_velocity, CRF_angular_acceleration),
//! from positions, velocities and accelerations, without differences in time.

use nalgebra::{Matrix3, Vector3};

/// A vector with its first and second time derivative.
#[derive(Clone, Copy, Debug)]
pub(super) struct Moving {
    pub(super) value: Vector3<f64>,
    pub(super) rate: Vector3<f64>,
    pub(super) acceleration: Vector3<f64>,
}

impl Moving {
    fn plus(&self, other: &Self) -> Self {
        Self {
            value: self.value + other.value,
            rate: self.rate + other.rate,
            acceleration: self.acceleration + other.acceleration,
        }
    }

    pub(super) fn minus(&self, other: &Self) -> Self {
        Self {
            value: self.value - other.value,
            rate: self.rate - other.rate,
            acceleration: self.acceleration - other.acceleration,
        }
    }

    fn cross(&self, other: &Self) -> Self {
        Self {
            value: self.value.cross(&other.value),
            rate: self.rate.cross(&other.value) + self.value.cross(&other.rate),
            acceleration: self.acceleration.cross(&other.value)
                + self.rate.cross(&other.rate) * 2.0
                + self.value.cross(&other.acceleration),
        }
    }

    /// The unit vector along it: `d = l u`, `ḋ = l̇ u + l u̇`, `d̈ = l̈ u + 2 l̇ u̇ + l ü`, and `u·u̇ = 0`.
    fn unit(&self) -> Self {
        let length = self.value.norm();
        let value = self.value / length;
        let length_rate = value.dot(&self.rate);
        let rate = (self.rate - value * length_rate) / length;
        let length_acceleration = rate.dot(&self.rate) + value.dot(&self.acceleration);
        let acceleration = (self.acceleration - rate * (2.0 * length_rate) - value * length_acceleration) / length;
        Self { value, rate, acceleration }
    }
}

/// The frame of a spacecraft that looks along two arms.
#[derive(Clone, Copy, Debug)]
pub(super) struct Crf {
    /// `T_C^I`.
    pub(super) dcm_irf_from_crf: Matrix3<f64>,
    /// `ω_CI`, CRF, rad/s.
    pub(super) omega_crf_rad_s: Vector3<f64>,
    /// `ω̇_CI`, CRF, rad/s².
    pub(super) alpha_crf_rad_s2: Vector3<f64>,
    /// Angle between the arms, rad.
    pub(super) opening_angle_rad: f64,
    /// Its rate, rad/s.
    pub(super) opening_rate_rad_s: f64,
}

impl Crf {
    /// From `r_12` and `r_13`, IRF, m, s.
    pub(super) fn new(r12: &Moving, r13: &Moving) -> Self {
        let (u12, u13) = (r12.unit(), r13.unit());
        let x = u12.plus(&u13).unit();
        let z = r12.cross(r13).unit();
        let y = z.cross(&x);
        let columns = |of: fn(&Moving) -> Vector3<f64>| Matrix3::from_columns(&[of(&x), of(&y), of(&z)]);
        let t = columns(|m| m.value);
        let t_rate = columns(|m| m.rate);
        // ω× = T_I^C Ṫ_C^I and ω̇× = T_I^C (T̈_C^I − Ṫ_C^I ω×), as printed.
        let omega = t.tr_mul(&t_rate);
        let alpha = t.tr_mul(&(columns(|m| m.acceleration) - t_rate * omega));
        let (sum, difference) = (u12.plus(&u13).value.norm(), u12.minus(&u13).value.norm());
        let sine = u12.value.cross(&u13.value).norm();
        Self {
            dcm_irf_from_crf: t,
            omega_crf_rad_s: of_skew(&omega),
            alpha_crf_rad_s2: of_skew(&alpha),
            opening_angle_rad: 2.0 * difference.atan2(sum),
            opening_rate_rad_s: -(u12.rate.dot(&u13.value) + u12.value.dot(&u13.rate)) / sine,
        }
    }
}

/// `v` of `v×`.
fn of_skew(m: &Matrix3<f64>) -> Vector3<f64> {
    Vector3::new(m.m32 - m.m23, m.m13 - m.m31, m.m21 - m.m12) * 0.5
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Rotation3;

    /// Arms of fixed lengths that turn with `ω(t) = (ω_0 + α t)` about a fixed axis: CRF's rates are that rotation's,
    /// in body axes, where the axis is fixed as well.
    #[test]
    fn a_turning_triangle_tells_its_rotation() {
        let axis = Vector3::new(0.3, -0.5, 0.8).normalize();
        let (w0, alpha, angle) = (2e-7, 3e-14, 0.7);
        let turn = Rotation3::from_scaled_axis(axis * angle);
        let (omega, alpha) = (axis * w0, axis * alpha);
        let moving = |at_rest: Vector3<f64>| {
            let value = turn * at_rest;
            let rate = omega.cross(&value);
            Moving { value, rate, acceleration: alpha.cross(&value) + omega.cross(&rate) }
        };
        let crf = Crf::new(&moving(Vector3::new(3e9, 1e8, 0.0)), &moving(Vector3::new(1.5e9, 2.6e9, 2e8)));
        let into_crf = |v: &Vector3<f64>| crf.dcm_irf_from_crf.tr_mul(v);
        // Grain: 1e-16 of the rates, times some tens of operations.
        assert!((crf.omega_crf_rad_s - into_crf(&omega)).norm() < 1e-14 * w0);
        assert!((crf.alpha_crf_rad_s2 - into_crf(&alpha)).norm() < 1e-14 * w0 * w0);
        assert!(crf.opening_rate_rad_s.abs() < 1e-14 * w0);
        let t = &crf.dcm_irf_from_crf;
        assert!((t.tr_mul(t) - Matrix3::identity()).norm() < 1e-15 && t.determinant() > 0.0);
    }

    /// An arm that swings in the triangle's plane: the bisector follows at half the rate, the angle opens at all of it.
    #[test]
    fn an_opening_angle_turns_the_bisector_by_half() {
        let (open, swing) = (1.05_f64, 4e-9);
        let still = Moving { value: Vector3::x() * 3e9, rate: Vector3::zeros(), acceleration: Vector3::zeros() };
        let (s, c) = open.sin_cos();
        let value = Vector3::new(c, s, 0.0) * 3e9;
        let rate = Vector3::new(-s, c, 0.0) * (3e9 * swing);
        let crf = Crf::new(&still, &Moving { value, rate, acceleration: value * (-swing * swing) });
        assert!((crf.opening_angle_rad - open).abs() < 1e-15);
        assert!((crf.opening_rate_rad_s / swing - 1.0).abs() < 1e-14);
        assert!((crf.omega_crf_rad_s - Vector3::z() * (0.5 * swing)).norm() < 1e-15 * swing);
        assert!(crf.alpha_crf_rad_s2.norm() < 1e-14 * swing * swing);
    }
}
