//! Algebraic Riccati equations through the stable subspace of a Hamiltonian matrix.

use nalgebra::linalg::balancing::balance_parlett_reinsch;
use nalgebra::{Complex, DMatrix};

use crate::schur::{Schur, complex, eigenvalues, lyapunov};

type Matrix = DMatrix<f64>;

/// Eigenvalues closer to the imaginary axis than this, on the scale of the balanced Hamiltonian, count as on it.
const AXIS_TOLERANCE: f64 = 1e-12;
/// Newton steps after the subspace; the first one already reaches rounding.
const NEWTON_STEPS: usize = 3;

/// Why a Riccati equation has no stabilising solution.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum RiccatiError {
    /// The Hamiltonian has eigenvalues on the imaginary axis: no subspace separates.
    #[error("its Hamiltonian has an eigenvalue on the imaginary axis at {frequency_rad_s:e} rad/s")]
    ImaginaryAxis {
        /// Where, in the unit of the problem, rad/s.
        frequency_rad_s: f64,
    },
    /// The stable subspace is no graph over the states.
    #[error("the stable subspace of its Hamiltonian has no complement")]
    NoGraph,
    /// The eigenvalue iteration did not settle.
    #[error("the Schur form of its Hamiltonian was not found; entries are not finite")]
    NotFinite,
}

/// The symmetric `X` with `Aᵀ X + X A + X R X + Q = 0` and `A + R X` stable, for `H = [[A, R], [−Q, −Aᵀ]]`
/// (`X = Ric(H)` of Doyle, Glover, Khargonekar and Francis). `R` and `Q` may be indefinite.
///
/// The balanced Hamiltonian's stable subspace by a reordered complex Schur form, then Newton's iteration.
///
/// # Errors
/// [`RiccatiError`] says why there is none.
pub fn stabilising_solution(hamiltonian: &Matrix) -> Result<Matrix, RiccatiError> {
    let n = hamiltonian.nrows() / 2;
    let stable = |m: Matrix| eigenvalues(&m).is_some_and(|values| values.iter().all(|z| z.re < 0.0));
    if hamiltonian.view((n, 0), (n, n)).amax() == 0.0 && stable(hamiltonian.view((0, 0), (n, n)).into_owned()) {
        // Zero, and not what rounding makes of it: its sign matters to who asks.
        return Ok(Matrix::zeros(n, n));
    }
    let mut balanced = hamiltonian.clone();
    let scaling = balance_parlett_reinsch(&mut balanced);
    let size = balanced.norm();
    let mut schur = Schur::new(complex(&balanced)).ok_or(RiccatiError::NotFinite)?;
    let on_axis = |z: &&Complex<f64>| z.re.abs() <= AXIS_TOLERANCE * size;
    if let Some(z) = schur.t.diagonal().iter().find(on_axis) {
        return Err(RiccatiError::ImaginaryAxis { frequency_rad_s: z.im.abs() });
    }
    if schur.reorder(|z| z.re < 0.0) != n {
        // A pair has crossed the axis in rounding.
        let nearest = schur
            .t
            .diagonal()
            .iter()
            .map(|z| (z.re.abs(), z.im.abs()))
            .fold((f64::INFINITY, 0.0), |a, b| if b.0 < a.0 { b } else { a });
        return Err(RiccatiError::ImaginaryAxis { frequency_rad_s: nearest.1 });
    }
    let scaled = |i: usize, j: usize| schur.q[(i, j)] * scaling[i];
    let upper = DMatrix::from_fn(n, n, scaled);
    let lower = DMatrix::from_fn(n, n, |i, j| scaled(n + i, j));
    // X = X_2 X_1⁻¹, from X_1ᵀ Xᵀ = X_2ᵀ.
    let x = upper.transpose().lu().solve(&lower.transpose()).ok_or(RiccatiError::NoGraph)?.map(|z| z.re);
    let x = (&x + x.transpose()) * 0.5;
    if x.iter().all(|v| v.is_finite()) { Ok(refined(hamiltonian, x)) } else { Err(RiccatiError::NoGraph) }
}

/// `Aᵀ X + X A + X R X + Q`.
fn residual(hamiltonian: &Matrix, x: &Matrix) -> Matrix {
    let n = x.nrows();
    let xa = x * hamiltonian.view((0, 0), (n, n));
    &xa + xa.transpose() + x * hamiltonian.view((0, n), (n, n)) * x - hamiltonian.view((n, 0), (n, n))
}

/// Newton's (Kleinman's) steps as long as they help.
fn refined(hamiltonian: &Matrix, mut x: Matrix) -> Matrix {
    let n = x.nrows();
    let (a, r) = (hamiltonian.view((0, 0), (n, n)), hamiltonian.view((0, n), (n, n)));
    let mut rest = residual(hamiltonian, &x);
    for _ in 0..NEWTON_STEPS {
        let Some(step) = lyapunov(&(a + r * &x), &rest) else { break };
        let next = &x + step;
        let left = residual(hamiltonian, &next);
        if left.norm().partial_cmp(&(0.5 * rest.norm())) != Some(std::cmp::Ordering::Less) {
            break;
        }
        (x, rest) = (next, left);
    }
    x
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn hamiltonian(a: &Matrix, r: &Matrix, q: &Matrix) -> Matrix {
        let n = a.nrows();
        let mut h = Matrix::zeros(2 * n, 2 * n);
        h.view_mut((0, 0), (n, n)).copy_from(a);
        h.view_mut((0, n), (n, n)).copy_from(r);
        h.view_mut((n, 0), (n, n)).copy_from(&-q);
        h.view_mut((n, n), (n, n)).copy_from(&-a.transpose());
        h
    }

    /// The double integrator's regulator in closed form: `X = [[√2, 1], [1, √2]]` for `Q = diag(1, 0)`, `R = −b bᵀ`.
    #[test]
    fn double_integrator_has_its_textbook_solution() {
        let a = Matrix::from_row_slice(2, 2, &[0.0, 1.0, 0.0, 0.0]);
        let r = Matrix::from_row_slice(2, 2, &[0.0, 0.0, 0.0, -1.0]);
        let q = Matrix::from_row_slice(2, 2, &[1.0, 0.0, 0.0, 0.0]);
        let x = stabilising_solution(&hamiltonian(&a, &r, &q)).unwrap();
        let root = std::f64::consts::SQRT_2;
        assert!((x - Matrix::from_row_slice(2, 2, &[root, 1.0, 1.0, root])).norm() < 1e-14);
    }

    /// A scalar bounded real equation, `−2x + x²/γ² + 1 = 0` for `1/(s+1)`: a solution for γ > 1 alone.
    #[test]
    fn no_solution_below_the_norm() {
        let h = |gamma: f64| {
            let one = Matrix::from_element(1, 1, 1.0);
            hamiltonian(&-&one, &(&one / (gamma * gamma)), &one)
        };
        let gamma: f64 = 1.25;
        let exact = gamma * gamma * (1.0 - (1.0 - gamma.powi(-2)).sqrt());
        assert!((stabilising_solution(&h(gamma)).unwrap()[0] - exact).abs() < 1e-14);
        let error = stabilising_solution(&h(0.5)).unwrap_err();
        // λ² = 1 − 1/γ² = −3.
        assert!(
            matches!(error, RiccatiError::ImaginaryAxis { frequency_rad_s } if (frequency_rad_s - 3.0_f64.sqrt()).abs() < 1e-12)
        );
    }

    proptest! {
        /// Residual and stability for random regulators whose states differ by up to eight decades in scale.
        #[test]
        fn equation_is_solved_and_the_loop_is_stable(
            n in 1..7_usize,
            values in prop::collection::vec(-1.0..1.0_f64, 64),
            exponents in prop::collection::vec(-4.0..4.0_f64, 7),
        ) {
            let scale = |i: usize| 10.0_f64.powf(exponents[i]);
            let a = Matrix::from_fn(n, n, |i, j| values[7 * i + j] * scale(i) / scale(j));
            let b = Matrix::from_fn(n, 1, |i, _| (values[49 + i] + 1.5) * scale(i));
            let c = Matrix::from_fn(1, n, |_, j| (values[56 + j] + 1.5) / scale(j));
            let h = hamiltonian(&a, &-(&b * b.transpose()), &(c.transpose() * &c));
            let Ok(x) = stabilising_solution(&h) else {
                // Nearly uncontrollable or unobservable modes on the axis are rare and refused.
                return Ok(());
            };
            let unscale = Matrix::from_diagonal(&nalgebra::DVector::from_fn(n, |i, _| scale(i)));
            let scaled = &unscale * &x * &unscale;
            let rest = &unscale * residual(&h, &x) * &unscale;
            prop_assert!(rest.norm() < 1e-9 * (1.0 + scaled.norm()).powi(2), "{} {}", rest.norm(), scaled.norm());
            // An unstable mode that the input hardly reaches makes X as large as it is hard to reach, and the loop loses those digits;
            // the synthesis proves its loops by certificates of their own.
            if scaled.norm() > 1e6 {
                return Ok(());
            }
            // In the coordinates without the scales: an eigenvalue is only as exact as the rounding of the largest entry.
            let scales = nalgebra::DVector::from_fn(n, |i, _| 1.0 / scale(i));
            let closed = Matrix::from_diagonal(&scales) * (&a - &b * b.transpose() * &x) * &unscale;
            let bound = 1e-9 * (1.0 + closed.norm());
            prop_assert!(eigenvalues(&closed).unwrap().iter().all(|z| z.re < bound));
        }
    }
}
