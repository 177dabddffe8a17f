//! Attitude quaternions. `q` turns a parent frame A into a body frame B: `T_A^B = dcm(q)`, and for small angles its
//! vector part is half the rotation about the axes of B.

use nalgebra::{Matrix3, Quaternion, Vector3};

use crate::frames::skew;

/// Components in the body frame from components in the parent frame, `T_A^B`:
/// `1 − 2w[v×] + 2[v×]²`, which keeps the full precision of small angles.
#[must_use]
pub fn dcm(q: &Quaternion<f64>) -> Matrix3<f64> {
    let v = skew(&q.imag());
    Matrix3::identity() - v * (2.0 * q.w) + v * v * 2.0
}

/// `dcm(q) v`, without the matrix: `v − 2w u×v + 2 u×(u×v)`.
#[must_use]
pub fn turn(q: &Quaternion<f64>, v: &Vector3<f64>) -> Vector3<f64> {
    let u = q.imag();
    let t = u.cross(v) * 2.0;
    v - t * q.w + u.cross(&t)
}

/// Quaternion of a rotation vector, rad.
#[must_use]
pub fn from_rotation_vector(angle_rad: &Vector3<f64>) -> Quaternion<f64> {
    let half = 0.5 * angle_rad.norm();
    // sin(h)/h by its series where the quotient would be 0/0; the next term is below 1e-18 there.
    let sinc = if half < 1e-4 { 1.0 - half * half / 6.0 } else { half.sin() / half };
    Quaternion::from_imag(angle_rad * (0.5 * sinc)) + Quaternion::from_real(half.cos())
}

/// Rotation vector of a unit quaternion, rad: for small angles the rotations about axes 1, 2, 3 of the body frame.
#[must_use]
pub fn rotation_vector(q: &Quaternion<f64>) -> Vector3<f64> {
    let (v, w) = if q.w < 0.0 { (-q.imag(), -q.w) } else { (q.imag(), q.w) };
    let sine = v.norm();
    let factor = if sine < 1e-4 { 2.0 + sine * sine / 3.0 } else { 2.0 * sine.atan2(w) / sine };
    v * factor
}

/// `q̇ = ½ q ⊗ (0, ω)` with `ω` of the body frame relative to the parent frame, in the body frame, rad/s.
#[must_use]
pub fn derivative(q: &Quaternion<f64>, omega_rad_s: &Vector3<f64>) -> Quaternion<f64> {
    q * Quaternion::from_imag(omega_rad_s * 0.5)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frames::dcm_turned_about_z;

    #[test]
    fn a_turn_about_z_is_the_frames_own() {
        let q = from_rotation_vector(&Vector3::new(0.0, 0.0, 0.7));
        assert!((dcm(&q) - dcm_turned_about_z(0.7)).amax() < 1e-15);
        let v = Vector3::new(1.0, -2.0, 3.0);
        assert!((turn(&q, &v) - dcm(&q) * v).amax() < 1e-15);
    }

    #[test]
    fn rotation_vectors_go_and_come_back() {
        for size in [1e-12, 1e-7, 5e-5, 1.9e-4, 0.3, 3.0] {
            let angle = Vector3::new(0.6, -0.48, 0.64) * size;
            let back = rotation_vector(&from_rotation_vector(&angle));
            assert!((back - angle).norm() < 4e-15 * size, "{size}: {back} {angle}");
            assert!((rotation_vector(&-from_rotation_vector(&angle)) - angle).norm() < 4e-15 * size);
        }
    }

    /// The derivative against a difference of two turns about the body's axes.
    #[test]
    fn derivative_turns_about_the_body_axes() {
        let q = from_rotation_vector(&Vector3::new(0.4, 0.2, -0.9));
        let omega = Vector3::new(0.3, -0.2, 0.5);
        let h = 1e-6;
        let turned = |h: f64| q * from_rotation_vector(&(omega * h));
        let numeric = (turned(h) - turned(-h)) / (2.0 * h);
        assert!((numeric - derivative(&q, &omega)).norm() < 1e-9);
    }
}
