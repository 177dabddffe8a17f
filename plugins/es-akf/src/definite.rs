//! Definiteness of covariances: the element-wise `|·|` and `min` of eq:Final_AKF_Q_K do not keep `Q̂` positive.

use nalgebra::{Cholesky, DMatrix, SymmetricEigen};

use crate::kernel::Matrix;

/// How far below zero, relative to the diagonal, an eigenvalue must lie to count as indefinite. `Q` is singular by
/// construction (one force drives `r` and `v`), so rounding alone reaches 1e-16.
const TOLERANCE: f64 = 1e-9;

/// What a check found.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Finding {
    /// Positive semidefinite within the tolerance; nothing was changed.
    Semidefinite,
    /// Was indefinite; its negative part has been removed.
    Repaired,
    /// Holds NaN or infinities; nothing was changed.
    NotFinite,
}

/// Tests the upper triangle of the leading `n×n` block and, when it is indefinite, replaces it by the nearest positive
/// semidefinite matrix in the metric of its own diagonal, mirrored.
///
/// The test is one Cholesky factorisation of the matrix scaled to a unit diagonal plus 1e-9 of the identity; the
/// eigenvalues are computed only when that fails.
pub fn repair<const N: usize>(matrix: &mut Matrix<N>, n: usize) -> Finding {
    let m = &mut *matrix.0;
    if (0..n).any(|i| m[i][i..n].iter().any(|x| !x.is_finite())) {
        return Finding::NotFinite;
    }
    let scale: Vec<f64> = (0..n).map(|i| m[i][i].abs().sqrt()).collect();
    let scaled = DMatrix::from_fn(n, n, |i, j| {
        let (i, j) = (i.min(j), i.max(j));
        let by = scale[i] * scale[j];
        if by > 0.0 { m[i][j] / by } else { 0.0 }
    });
    if Cholesky::new(&scaled + DMatrix::identity(n, n) * TOLERANCE).is_some() {
        return Finding::Semidefinite;
    }
    let mut eigen = SymmetricEigen::new(scaled);
    eigen.eigenvalues.iter_mut().for_each(|e| *e = e.max(0.0));
    let nearest = eigen.recompose();
    for i in 0..n {
        for j in 0..=i {
            let x = nearest[(i, j)] * scale[i] * scale[j];
            m[i][j] = x;
            m[j][i] = x;
        }
    }
    Finding::Repaired
}

#[cfg(test)]
mod tests {
    use super::*;

    fn matrix(rows: &[[f64; 3]; 3]) -> Matrix<8> {
        let mut m = Matrix::zero();
        for i in 0..3 {
            m.0[i][..3].copy_from_slice(&rows[i]);
        }
        m
    }

    #[test]
    fn a_singular_covariance_is_semidefinite() {
        let dt = 0.1_f64;
        let mut m = matrix(&[[dt.powi(4) / 4.0, dt.powi(3) / 2.0, 0.0], [dt.powi(3) / 2.0, dt * dt, 0.0], [0.0; 3]]);
        let before = m.clone();
        assert_eq!(repair(&mut m, 3), Finding::Semidefinite);
        assert_eq!(m, before);
    }

    #[test]
    fn an_indefinite_covariance_loses_its_negative_part_whatever_the_scale() {
        // Correlation of 1.5: eigenvalues 2.5 and −0.5, so the nearest keeps 2.5·[½ ½; ½ ½].
        let mut m = matrix(&[[1e-20, 1.5e-10, 0.0], [1.5e-10, 1.0, 0.0], [0.0, 0.0, 3.0]]);
        assert_eq!(repair(&mut m, 3), Finding::Repaired);
        for (got, want) in [(m.0[0][0], 1.25e-20), (m.0[1][0], 1.25e-10), (m.0[0][1], 1.25e-10), (m.0[1][1], 1.25)] {
            assert!((got / want - 1.0).abs() < 1e-12, "{got} against {want}");
        }
        assert_eq!(repair(&mut m, 3), Finding::Semidefinite);
    }

    #[test]
    fn not_a_number_is_told_apart() {
        assert_eq!(repair(&mut matrix(&[[f64::NAN; 3]; 3]), 3), Finding::NotFinite);
    }
}
