//! Algebraic Riccati equations through the stable subspace of a Hamiltonian matrix.

use nalgebra::linalg::balancing::balance_parlett_reinsch;
use nalgebra::{Complex, DMatrix};

use crate::schur::{Schur, complex, eigenvalues, lyapunov};

type Matrix = DMatrix<f64>;

/// Eigenvalues closer to the imaginary axis than this, on the scale of the balanced Hamiltonian, count as on it.
const AXIS_TOLERANCE: f64 = 1e-12;
/// Newton steps after the subspace; the first one already reaches rounding.
const NEWTON_STEPS: usize = 3;
/// The slowest eigenvalue of the loop keeps at least this part of its distance from the imaginary axis, or rounding
/// dominates.
const KEPT_DISTANCE: f64 = 0.5;

/// Why a Riccati equation has no stabilising solution.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
#[expect(missing_docs, reason = "the messages name the fields")]
pub enum RiccatiError {
    /// The Hamiltonian has eigenvalues on the imaginary axis: no subspace separates.
    #[error("its Hamiltonian has an eigenvalue on the imaginary axis at {frequency_rad_s:e} rad/s")]
    ImaginaryAxis { frequency_rad_s: f64 },
    /// The stable subspace has no basis `[I; X]`.
    #[error("the stable subspace of its Hamiltonian has no complement")]
    NoGraph,
    /// The loop `A + R X` of the solution is not accurate in double precision.
    #[error(
        "the loop of its solution has an eigenvalue at {slowest_rad_s:e} rad/s where exact arithmetic has the slowest at \
         {exact_rad_s:e} rad/s: an unstable mode that is hardly reached or hardly seen makes the solution so large that double \
         precision does not hold the loop; act on that mode or measure it better, or leave it out of the plant"
    )]
    LostInRounding { slowest_rad_s: f64, exact_rad_s: f64 },
    /// The eigenvalue iteration did not settle.
    #[error("the Schur form of its Hamiltonian was not found; entries are not finite")]
    NotFinite,
}

/// The symmetric `X` with `Aᵀ X + X A + X R X + Q = 0` and `A + R X` stable, for `H = [[A, R], [−Q, −Aᵀ]]`
/// (`X = Ric(H)` of Doyle, Glover, Khargonekar and Francis). `R` and `Q` may be indefinite.
///
/// The balanced Hamiltonian's stable subspace by a reordered complex Schur form, then Newton's iteration. The
/// eigenvalues of the loop must be the Hamiltonian's stable ones: a solution that lost them to rounding is refused.
///
/// # Errors
/// [`RiccatiError`] says why there is none.
pub fn stabilising_solution(hamiltonian: &Matrix) -> Result<Matrix, RiccatiError> {
    let Candidate { x, slowest_rad_s, exact_rad_s } = candidate(hamiltonian)?;
    // False for NaN too.
    let held = slowest_rad_s <= KEPT_DISTANCE * exact_rad_s;
    if held { Ok(x) } else { Err(RiccatiError::LostInRounding { slowest_rad_s, exact_rad_s }) }
}

/// A solution, and the slowest eigenvalue of its loop: computed from the loop, and from the Hamiltonian.
struct Candidate {
    x: Matrix,
    slowest_rad_s: f64,
    exact_rad_s: f64,
}

fn candidate(hamiltonian: &Matrix) -> Result<Candidate, RiccatiError> {
    let n = hamiltonian.nrows() / 2;
    let stable = |m: Matrix| eigenvalues(&m).is_some_and(|values| values.iter().all(|z| z.re < 0.0));
    if hamiltonian.view((n, 0), (n, n)).amax() == 0.0 && stable(hamiltonian.view((0, 0), (n, n)).into_owned()) {
        // Exactly zero: callers test its sign.
        return Ok(Candidate { x: Matrix::zeros(n, n), slowest_rad_s: -1.0, exact_rad_s: -1.0 });
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
        // Rounding moved an eigenvalue across the axis.
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
    if !x.iter().all(|v| v.is_finite()) {
        return Err(RiccatiError::NoGraph);
    }
    let x = refined(hamiltonian, x);
    // The loop in the balanced states, x = diag(scaling) x̃; X maps states to costates.
    let in_balanced_states = Matrix::from_fn(n, n, |i, j| x[(i, j)] * scaling[j] / scaling[n + i]);
    let closed = balanced.view((0, 0), (n, n)) + balanced.view((0, n), (n, n)) * in_balanced_states;
    let slowest = |values: &mut dyn Iterator<Item = f64>| values.fold(f64::NEG_INFINITY, f64::max);
    let slowest_rad_s = eigenvalues(&closed).map_or(f64::NAN, |values| slowest(&mut values.iter().map(|z| z.re)));
    let exact_rad_s = slowest(&mut schur.t.diagonal().iter().take(n).map(|z| z.re));
    Ok(Candidate { x, slowest_rad_s, exact_rad_s })
}

/// `Aᵀ X + X A + X R X + Q`.
fn residual(hamiltonian: &Matrix, x: &Matrix) -> Matrix {
    let n = x.nrows();
    let xa = x * hamiltonian.view((0, 0), (n, n));
    &xa + xa.transpose() + x * hamiltonian.view((0, n), (n, n)) * x - hamiltonian.view((n, 0), (n, n))
}

/// Newton (Kleinman) steps while they halve the residual.
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

    /// Whether the numbers of a regulator, in states of one scale, leave no solution: from singular values of the loop,
    /// of the Hamiltonian and of `[a − z, b]`, not from what the refusal says of itself.
    fn is_excused(refusal: RiccatiError, a: &Matrix, b: &Matrix, h: &Matrix) -> bool {
        let n = a.nrows();
        let at = |m: &Matrix, z: Complex<f64>| complex(m) - DMatrix::identity(m.nrows(), m.nrows()) * z;
        let on_axis = |omega: f64| Complex::new(0.0, omega);
        match refusal {
            RiccatiError::ImaginaryAxis { frequency_rad_s } => {
                at(h, on_axis(frequency_rad_s)).singular_values().min() < 1e-10 * h.norm()
            }
            // An unstable mode z that the input does not reach: [a − z, b] loses rank.
            RiccatiError::NoGraph => eigenvalues(a).unwrap().into_iter().filter(|z| z.re > 0.0).any(|z| {
                let both = at(a, z) * at(a, z).adjoint() + complex(&(b * b.transpose()));
                both.symmetric_eigenvalues().min() < 1e-13 * a.norm_squared()
            }),
            // The rounding of the loop's own terms reaches from the loop to one with an eigenvalue on the axis.
            RiccatiError::LostInRounding { .. } => {
                let x = candidate(h).unwrap().x;
                let closed = a - b * b.transpose() * &x;
                let rounding = n as f64 * f64::EPSILON * (a.norm() + b.norm_squared() * x.norm());
                let seen = eigenvalues(&closed).unwrap().into_iter().chain(eigenvalues(h).unwrap());
                let distances = seen.map(|z| at(&closed, on_axis(z.im)).singular_values().min());
                distances.fold(f64::INFINITY, f64::min) < rounding
            }
            RiccatiError::NotFinite => false,
        }
    }

    /// The refusal's excuses are none for a sound regulator.
    #[test]
    fn nothing_excuses_the_refusal_of_a_sound_regulator() {
        let a = Matrix::from_row_slice(2, 2, &[0.0, 1.0, 0.5, 0.3]);
        let b = Matrix::from_row_slice(2, 1, &[0.2, 1.0]);
        let h = hamiltonian(&a, &-(&b * b.transpose()), &Matrix::identity(2, 2));
        stabilising_solution(&h).unwrap();
        for refusal in [
            RiccatiError::ImaginaryAxis { frequency_rad_s: 0.0 },
            RiccatiError::NoGraph,
            RiccatiError::LostInRounding { slowest_rad_s: 1.0, exact_rad_s: -1.0 },
            RiccatiError::NotFinite,
        ] {
            assert!(!is_excused(refusal, &a, &b, &h), "{refusal}");
        }
    }

    /// An unstable mode at 1 rad/s that the input reaches by 1e-9: the gain that moves it is 2e9, `X` is 2e18, and of
    /// `b bᵀ X` no digit below 100 is left.
    #[test]
    fn a_mode_that_is_hardly_reached_is_refused_and_said_to_be() {
        let a = Matrix::from_row_slice(2, 2, &[1.0, 0.3, 0.2, -1.0]);
        let unstable = eigenvalues(&a).unwrap().iter().map(|z| z.re).fold(0.0, f64::max);
        // The mode's left eigenvector is (0.2, λ − 1) to scale: this b is nearly orthogonal to it.
        let b = Matrix::from_row_slice(2, 1, &[1.0 - unstable + 1e-9, 0.2]);
        let h = hamiltonian(&a, &-(&b * b.transpose()), &Matrix::identity(2, 2));
        let refusal = stabilising_solution(&h).unwrap_err();
        assert!(matches!(refusal, RiccatiError::LostInRounding { .. }), "{refusal}");
        assert!(refusal.to_string().contains("leave it out of the plant"), "{refusal}");
        assert!(is_excused(refusal, &a, &b, &h));
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
            let unscale = Matrix::from_diagonal(&nalgebra::DVector::from_fn(n, |i, _| scale(i)));
            // The same in states of one scale, in which norms mean something.
            let down = Matrix::from_diagonal(&nalgebra::DVector::from_fn(n, |i, _| 1.0 / scale(i)));
            let x = match stabilising_solution(&h) {
                Ok(x) => x,
                Err(refusal) => {
                    let (a, b, c) = (&down * &a * &unscale, &down * &b, &c * &unscale);
                    let h = hamiltonian(&a, &-(&b * b.transpose()), &(c.transpose() * &c));
                    prop_assert!(is_excused(refusal, &a, &b, &h), "{}", refusal);
                    return Ok(());
                }
            };
            let scaled = &unscale * &x * &unscale;
            let rest = &unscale * residual(&h, &x) * &unscale;
            prop_assert!(rest.norm() < 1e-9 * (1.0 + scaled.norm()).powi(2), "{} {}", rest.norm(), scaled.norm());
            // Theory has no tolerance: the loop's eigenvalues are the Hamiltonian's stable ones. Rounding has none
            // either, because a solution is given out only where rounding has taken less than half of the slowest one's
            // distance from the axis.
            let closed = &down * (&a - &b * b.transpose() * &x) * &unscale;
            prop_assert!(eigenvalues(&closed).unwrap().iter().all(|z| z.re < 0.0));
        }
    }
}
