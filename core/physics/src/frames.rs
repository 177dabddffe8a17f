//! Rotations between the paper's frames (Section II): IRF, CRF, SRF, `ORF_1`, `ORF_2`.

use nalgebra::{Matrix3, Vector3};

/// Skew-symmetric matrix `v×`: `skew(v) * w == v.cross(&w)`.
pub fn skew(v: &Vector3<f64>) -> Matrix3<f64> {
    Matrix3::new(0.0, -v.z, v.y, v.z, 0.0, -v.x, -v.y, v.x, 0.0)
}

/// Components in a frame turned by `angle_rad` about axis 3, from components in the parent frame:
/// `R_z(φ) = [[c, s, 0], [−s, c, 0], [0, 0, 1]]`.
pub fn dcm_turned_about_z(angle_rad: f64) -> Matrix3<f64> {
    let (s, c) = angle_rad.sin_cos();
    Matrix3::new(c, s, 0.0, -s, c, 0.0, 0.0, 0.0, 1.0)
}

/// `Ω(ω, α) = [ω×][ω×] + [α×]`, so that a point at `b` fixed in the rotating frame is accelerated by `Ω b`
/// (below eq:TM_SC_relative_acceleration). Shape 3×3, s⁻².
pub fn omega_matrix(omega_rad_s: &Vector3<f64>, alpha_rad_s2: &Vector3<f64>) -> Matrix3<f64> {
    let w = skew(omega_rad_s);
    w * w + skew(alpha_rad_s2)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The check of the paper's Table tab_para / tab:com_calibration_results: `b_1^S` and `b_2^S` in their ORFs.
    #[test]
    fn offsets_of_the_paper_in_their_optical_frames() {
        let third = std::f64::consts::FRAC_PI_6;
        let b1 = dcm_turned_about_z(third) * Vector3::new(0.001, 0.18, 0.0);
        let b2 = dcm_turned_about_z(-third) * Vector3::new(0.001, -0.18, 0.0);
        for (got, want) in [(b1, [0.090_866, 0.155_385, 0.0]), (b2, [0.090_866, -0.155_385, 0.0])] {
            for i in 0..3 {
                assert!((got[i] - want[i]).abs() < 1e-6, "{got} against {want:?}");
            }
        }
    }

    #[test]
    fn a_point_on_a_spinning_body_is_pulled_inward() {
        let a = omega_matrix(&Vector3::new(0.0, 0.0, 2.0), &Vector3::zeros()) * Vector3::new(3.0, 0.0, 0.0);
        assert_eq!(a, Vector3::new(-12.0, 0.0, 0.0));
    }
}
