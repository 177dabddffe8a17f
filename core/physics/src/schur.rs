//! Complex Schur form and its reordering; eigenvalues and Lyapunov equations.
//!
//! Real matrices are treated as complex ones: no two-by-two blocks, so that reordering is a chain of plane rotations.

use nalgebra::linalg::{Hessenberg, balancing::balance_parlett_reinsch};
use nalgebra::{Complex, DMatrix};

type C64 = Complex<f64>;
type Matrix = DMatrix<f64>;
type ComplexMatrix = DMatrix<C64>;

/// QR sweeps allowed per eigenvalue; two or three are usual.
const MOST_SWEEPS: usize = 60;

/// `M = Q T Qᴴ` with unitary `Q` and upper triangular `T`.
#[derive(Clone, Debug)]
pub struct Schur {
    /// Unitary.
    pub q: ComplexMatrix,
    /// Upper triangular; eigenvalues on the diagonal.
    pub t: ComplexMatrix,
}

/// A plane rotation `[c, s; −s̄, c]` with real `c`.
#[derive(Clone, Copy)]
struct Rotation {
    c: f64,
    s: C64,
}

impl Rotation {
    /// The rotation that takes `(f, g)` to `(r, 0)`.
    fn annihilating(f: C64, g: C64) -> Self {
        let (size_f, size_g) = (f.norm(), g.norm());
        if size_g == 0.0 {
            return Self { c: 1.0, s: C64::from(0.0) };
        }
        if size_f == 0.0 {
            return Self { c: 0.0, s: g.conj() / size_g };
        }
        let r = size_f.hypot(size_g);
        Self { c: size_f / r, s: f / size_f * g.conj() / r }
    }

    /// Rows `k` and `k+1` from the left, in the given columns.
    fn rows(self, m: &mut ComplexMatrix, k: usize, columns: std::ops::Range<usize>) {
        for j in columns {
            let (x, y) = (m[(k, j)], m[(k + 1, j)]);
            m[(k, j)] = x * self.c + self.s * y;
            m[(k + 1, j)] = y * self.c - self.s.conj() * x;
        }
    }

    /// Columns `k` and `k+1` times the rotation's adjoint, in the given rows.
    fn columns(self, m: &mut ComplexMatrix, k: usize, rows: std::ops::Range<usize>) {
        for i in rows {
            let (x, y) = (m[(i, k)], m[(i, k + 1)]);
            m[(i, k)] = x * self.c + self.s.conj() * y;
            m[(i, k + 1)] = y * self.c - self.s * x;
        }
    }
}

/// Wilkinson's shift: the eigenvalue of the trailing two-by-two block that is nearer to its last entry.
fn shift(t: &ComplexMatrix, last: usize) -> C64 {
    let (a, b, c, d) = (t[(last - 1, last - 1)], t[(last - 1, last)], t[(last, last - 1)], t[(last, last)]);
    let half = (a - d) * 0.5;
    let root = (half * half + b * c).sqrt();
    let far = if (half + root).norm() > (half - root).norm() { half + root } else { half - root };
    // The smaller root of μ² − 2·half·μ − bc, without cancellation.
    if far.norm() == 0.0 { d } else { d - b * c / far }
}

impl Schur {
    /// Schur form of a square matrix; `None` when the iteration does not settle or an entry is not finite.
    pub fn new(m: ComplexMatrix) -> Option<Self> {
        let n = m.nrows();
        if !m.iter().all(|x| x.re.is_finite() && x.im.is_finite()) {
            return None;
        }
        if n < 2 {
            return Some(Self { q: ComplexMatrix::identity(n, n), t: m });
        }
        let (mut q, mut t) = Hessenberg::new(m).unpack();
        let scale = t.norm();
        let mut last = n - 1;
        let mut sweeps = 0;
        while last > 0 {
            let first = Self::deflate(&mut t, last, scale);
            if first == last {
                last -= 1;
                sweeps = 0;
                continue;
            }
            sweeps += 1;
            if sweeps > MOST_SWEEPS {
                return None;
            }
            // An exceptional shift every ten sweeps breaks rare cycles.
            let by = if sweeps % 10 == 0 { C64::from(t[(last, last - 1)].norm()) } else { shift(&t, last) };
            Self::sweep(&mut q, &mut t, first, last, by);
        }
        Some(Self { q, t })
    }

    /// Sets negligible subdiagonals to zero and gives the first row of the block that ends in `last`.
    fn deflate(t: &mut ComplexMatrix, last: usize, scale: f64) -> usize {
        for k in (1..=last).rev() {
            let near = t[(k - 1, k - 1)].norm() + t[(k, k)].norm();
            let size = if near > 0.0 { near } else { scale };
            if t[(k, k - 1)].norm() <= f64::EPSILON * size {
                t[(k, k - 1)] = C64::from(0.0);
                return k;
            }
        }
        0
    }

    /// One shifted QR step on the block `first..=last`.
    fn sweep(q: &mut ComplexMatrix, t: &mut ComplexMatrix, first: usize, last: usize, by: C64) {
        let n = t.nrows();
        for i in first..=last {
            t[(i, i)] -= by;
        }
        let rotations: Vec<Rotation> = (first..last)
            .map(|k| {
                let rotation = Rotation::annihilating(t[(k, k)], t[(k + 1, k)]);
                rotation.rows(t, k, k..n);
                t[(k + 1, k)] = C64::from(0.0);
                rotation
            })
            .collect();
        for (k, rotation) in (first..last).zip(rotations) {
            rotation.columns(t, k, 0..k + 2);
            rotation.columns(q, k, 0..n);
        }
        for i in first..=last {
            t[(i, i)] += by;
        }
    }

    /// Brings the eigenvalues that `wanted` picks to the top, in their order, and gives their number.
    pub fn reorder(&mut self, wanted: impl Fn(C64) -> bool) -> usize {
        let n = self.t.nrows();
        let mut found = 0;
        for i in 0..n {
            if wanted(self.t[(i, i)]) {
                for k in (found..i).rev() {
                    self.swap(k);
                }
                found += 1;
            }
        }
        found
    }

    /// Swaps the eigenvalues `k` and `k+1`.
    fn swap(&mut self, k: usize) {
        let n = self.t.nrows();
        let (upper, lower) = (self.t[(k, k)], self.t[(k + 1, k + 1)]);
        let rotation = Rotation::annihilating(self.t[(k, k + 1)], lower - upper);
        rotation.rows(&mut self.t, k, k..n);
        rotation.columns(&mut self.t, k, 0..k + 2);
        rotation.columns(&mut self.q, k, 0..n);
        self.t[(k + 1, k)] = C64::from(0.0);
        self.t[(k, k)] = lower;
        self.t[(k + 1, k + 1)] = upper;
    }
}

/// A real matrix as a complex one.
pub fn complex(m: &Matrix) -> ComplexMatrix {
    m.map(C64::from)
}

/// Eigenvalues of a real square matrix, balanced first; `None` when the iteration does not settle.
///
/// The real Schur form, whose pairs are conjugate to the last bit; the complex one where the real one does not settle.
pub fn eigenvalues(m: &Matrix) -> Option<Vec<C64>> {
    let mut balanced = m.clone();
    balance_parlett_reinsch(&mut balanced);
    let sweeps = MOST_SWEEPS * balanced.nrows();
    let values = match nalgebra::Schur::try_new(balanced.clone(), f64::EPSILON, sweeps) {
        Some(real) if balanced.iter().all(|x| x.is_finite()) => real.complex_eigenvalues(),
        _ => Schur::new(complex(&balanced))?.t.diagonal(),
    };
    Some(values.iter().copied().collect())
}

/// Smallest and largest of the `min(rows, columns)` singular values; NaN for entries that are not finite.
///
/// From the smaller Gram matrix, accurate to about 1e-8 of the largest. (nalgebra's iteration for complex singular
/// values is unbounded and does not always end.)
pub fn singular_value_range(m: &ComplexMatrix) -> (f64, f64) {
    let size = m.norm();
    if m.is_empty() || size == 0.0 {
        return (0.0, 0.0);
    }
    let m = m.unscale(size);
    let gram = if m.nrows() < m.ncols() { &m * m.adjoint() } else { m.adjoint() * &m };
    let Some(schur) = Schur::new(gram) else { return (f64::NAN, f64::NAN) };
    let squares = schur.t.diagonal().map(|z| z.re.max(0.0));
    (size * squares.min().sqrt(), size * squares.max().sqrt())
}

/// `X` with `Aᵀ X + X A + Q = 0`; `None` when two eigenvalues of `A` add up to zero.
pub fn lyapunov(a: &Matrix, q: &Matrix) -> Option<Matrix> {
    let n = a.nrows();
    let schur = Schur::new(complex(a))?;
    let (u, t) = (&schur.q, &schur.t);
    let mut y = -(u.adjoint() * complex(q) * u);
    // Tᴴ Y + Y T = right-hand side: column by column, and downwards in each column.
    for j in 0..n {
        for i in 0..n {
            let mut sum = y[(i, j)];
            for k in 0..j {
                sum -= y[(i, k)] * t[(k, j)];
            }
            for k in 0..i {
                sum -= t[(k, i)].conj() * y[(k, j)];
            }
            let pivot = t[(i, i)].conj() + t[(j, j)];
            if pivot.norm() == 0.0 {
                return None;
            }
            y[(i, j)] = sum / pivot;
        }
    }
    let x = (u * y * u.adjoint()).map(|z| z.re);
    Some((&x + x.transpose()) * 0.5)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn matrix(n: usize, values: &[f64]) -> Matrix {
        Matrix::from_fn(n, n, |i, j| values[i * n + j] * 10.0_f64.powf(values[(i * 7 + j * 3) % values.len()] * 2.0))
    }

    proptest! {
        #[test]
        fn schur_form_is_one_and_can_be_reordered(n in 1..12_usize, values in prop::collection::vec(-1.0..1.0_f64, 144)) {
            let m = matrix(n, &values);
            let mut schur = Schur::new(complex(&m)).unwrap();
            let tolerance = 1e-13 * n as f64 * m.norm().max(1.0);
            let error = |s: &Schur| (&s.q * &s.t * s.q.adjoint() - complex(&m)).norm();
            prop_assert!(error(&schur) < tolerance);
            let stable = schur.reorder(|z| z.re < 0.0);
            prop_assert!(error(&schur) < 10.0 * tolerance);
            prop_assert!((schur.q.adjoint() * &schur.q - ComplexMatrix::identity(n, n)).norm() < 1e-12);
            for i in 0..n {
                prop_assert_eq!(schur.t[(i, i)].re < 0.0, i < stable);
                for j in 0..i {
                    prop_assert_eq!(schur.t[(i, j)].norm(), 0.0);
                }
            }
        }

        #[test]
        fn lyapunov_equation_is_solved(n in 1..10_usize, values in prop::collection::vec(-1.0..1.0_f64, 100)) {
            let m = Matrix::from_fn(n, n, |i, j| values[i * n + j]) - Matrix::identity(n, n) * (n as f64 + 1.0);
            let q = &m + m.transpose();
            let x = lyapunov(&m, &q).unwrap();
            prop_assert!((m.transpose() * &x + &x * &m + q).norm() < 1e-12 * n as f64);
        }
    }

    /// A companion matrix with roots over six decades.
    #[test]
    fn eigenvalues_span_decades() {
        let roots = [-1e-4, -1e-2, -1.0, -30.0, -100.0];
        let mut polynomial = vec![1.0];
        for r in roots {
            let mut next = polynomial.clone();
            next.push(0.0);
            for (slot, c) in next[1..].iter_mut().zip(&polynomial) {
                *slot -= r * c;
            }
            polynomial = next;
        }
        let companion = Matrix::from_fn(5, 5, |i, j| match i {
            0 => -polynomial[j + 1],
            _ => f64::from(u8::from(i == j + 1)),
        });
        let mut found: Vec<f64> = eigenvalues(&companion).unwrap().iter().map(|z| z.re).collect();
        found.sort_by(f64::total_cmp);
        for (found, root) in found.iter().zip(roots.iter().rev()) {
            assert!((found / root - 1.0).abs() < 1e-9, "{found} for {root}");
        }
    }
}
