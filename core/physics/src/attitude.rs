//! Attitude quaternions. `q` turns a parent frame A into a body frame B: `T_A^B = dcm(q)`, and for small angles its
//! vector part is half the rotation about the axes of B.

use nalgebra::{Matrix3, Quaternion, Vector3};

use crate::frames::skew;

/// Components in the body frame from components in the parent frame, `T_A^B`:
/// `1 − 2w[v×] + 2[v×]²`, which keeps the full precision of small angles.
#[inline]
pub fn dcm(q: &Quaternion<f64>) -> Matrix3<f64> {
    let v = skew(&q.imag());
    Matrix3::identity() - v * (2.0 * q.w) + v * v * 2.0
}

/// `dcm(q) v`, without the matrix: `v − 2w u×v + 2 u×(u×v)`.
#[inline]
pub fn turn(q: &Quaternion<f64>, v: &Vector3<f64>) -> Vector3<f64> {
    let u = q.imag();
    let t = u.cross(v) * 2.0;
    v - t * q.w + u.cross(&t)
}

/// Quaternion of a rotation vector, rad.
#[inline]
pub fn from_rotation_vector(angle_rad: &Vector3<f64>) -> Quaternion<f64> {
    let half = 0.5 * angle_rad.norm();
    // sin(h)/h by its series where the quotient would be 0/0; the next term is below 1e-18 there.
    let sinc = if half < 1e-4 { 1.0 - half * half / 6.0 } else { half.sin() / half };
    Quaternion::from_imag(angle_rad * (0.5 * sinc)) + Quaternion::from_real(half.cos())
}

/// Rotation vector of a unit quaternion, rad: for small angles the rotations about axes 1, 2, 3 of the body frame.
#[inline]
pub fn rotation_vector(q: &Quaternion<f64>) -> Vector3<f64> {
    let (v, w) = if q.w < 0.0 { (-q.imag(), -q.w) } else { (q.imag(), q.w) };
    let sine = v.norm();
    let factor = if sine < 1e-4 { 2.0 + sine * sine / 3.0 } else { 2.0 * sine.atan2(w) / sine };
    v * factor
}

/// `q̇ = ½(q ⊗ ω_body − ω_parent ⊗ q)` with both rates against the same third frame, rad/s: `body` in the body frame,
/// `parent` in the parent frame.
#[inline]
pub fn derivative(q: &Quaternion<f64>, body: &Vector3<f64>, parent: &Vector3<f64>) -> Quaternion<f64> {
    let (u, difference) = (q.imag(), body - parent);
    let imag = difference * q.w + u.cross(&(body + parent));
    Quaternion::from_parts(-0.5 * u.dot(&difference), imag * 0.5)
}

/// A quaternion whose length is one to within `ε`, made one to within `ε²`.
#[inline]
pub fn unit(q: &Quaternion<f64>) -> Quaternion<f64> {
    q * (1.5 - 0.5 * q.norm_squared())
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

    /// The derivative against a difference of turns, of the body about its axes and of the parent about its own.
    #[test]
    fn derivative_turns_body_and_parent() {
        let q = from_rotation_vector(&Vector3::new(0.4, 0.2, -0.9));
        let (body, parent) = (Vector3::new(0.3, -0.2, 0.5), Vector3::new(-0.1, 0.4, 0.2));
        let h = 1e-6;
        let turned = |h: f64| from_rotation_vector(&(parent * h)).conjugate() * q * from_rotation_vector(&(body * h));
        let numeric = (turned(h) - turned(-h)) / (2.0 * h);
        assert!((numeric - derivative(&q, &body, &parent)).norm() < 1e-9);
    }

    #[test]
    fn a_length_near_one_is_made_one() {
        let q = from_rotation_vector(&Vector3::new(0.4, 0.2, -0.9));
        let error = unit(&(q * (1.0 + 1e-4))).norm() - 1.0;
        // (1+ε)(1.5 − 0.5(1+ε)²) = 1 − 1.5 ε² + …
        assert!((error / -1.5e-8 - 1.0).abs() < 1e-3, "{error}");
    }
}
