//! The covariance algebra of one step, by structure instead of by dense products.
//!
//! `A` is the identity but for the rows of `r`, `v` and `n`, `H` has three rows of zeros and ones, and
//! `P_{k+1} − A P_k Aᵀ = Q − W Mᵀ` with `M = A P Hᵀ` and `W = M S⁻¹ = A K`. So `Q̂_iter` is a low-rank update, and one
//! pass over the lower blocks of `P` and `Q` does a whole step.
//!
//! Matrices are `N×N` with `N` the number of states rounded up; rows and columns beyond the states stay zero.
//! **Invariant: `P` is exactly symmetric.** Every pass computes the lower triangle in blocks eight wide and mirrors it;
//! the same recursion without the mirror turns non-finite within 10⁵ steps.

use crate::model::{BIAS, Model, R, THETA, V};

/// A 3×3 matrix over the readouts x, y, z.
pub type Mat3 = [[f64; 3]; 3];
/// Three columns of `N` rows, such as `K` or `P Hᵀ`, stored by column.
pub type Columns<const N: usize> = [[f64; N]; 3];

/// Width of the blocks, in columns.
const LANES: usize = 8;

/// A square matrix on the heap, padded with zeros.
#[derive(Clone, Debug, PartialEq)]
pub struct Matrix<const N: usize>(pub Box<[[f64; N]; N]>);

impl<const N: usize> Matrix<N> {
    /// All zero.
    #[must_use]
    pub fn zero() -> Self {
        Self(Box::new([[0.0; N]; N]))
    }

    /// Copies the strict lower triangle onto the upper one.
    pub fn mirror(&mut self) {
        for i in 1..N {
            for j in 0..i {
                self.0[j][i] = self.0[i][j];
            }
        }
    }
}

/// Columns of row `i` that hold its lower triangle, rounded up to whole blocks.
const fn lower_width(i: usize) -> usize {
    (i / LANES + 1) * LANES
}

/// `A` of one step and the selections of `H`, shared by every covariance of a test mass.
#[derive(Clone, Debug)]
pub struct Transition<const N: usize> {
    dt: f64,
    half_dt2: f64,
    coefficients: usize,
    /// First state of each chain, and the first row of its Toeplitz transition.
    chains: Vec<(usize, Vec<f64>)>,
    /// States that add up in each readout: `r_i` and the outputs of its chains.
    outputs: [Vec<usize>; 3],
    /// Regressors of the current step by coefficient, m s⁻² per unit; rows beyond the coefficients stay zero.
    pub phi: Box<[[f64; 3]; N]>,
}

impl<const N: usize> Transition<N> {
    /// The transition of a model, regressors zero.
    #[must_use]
    pub fn new(model: &Model) -> Self {
        let mut outputs = [vec![R], vec![R + 1], vec![R + 2]];
        let mut chains = Vec::new();
        for (axis, first, chain) in model.placed_chains() {
            outputs[axis].push(first);
            chains.push((first, chain.transition.clone()));
        }
        Self {
            dt: model.dt_s,
            half_dt2: 0.5 * model.dt_s * model.dt_s,
            coefficients: model.coefficients.len(),
            chains,
            outputs,
            phi: Box::new([[0.0; 3]; N]),
        }
    }

    /// `X ← A X + B û` (eq:Final_AKF_X_k).
    pub fn state(&self, x: &mut [f64; N], u: &[f64; 3]) {
        for i in 0..3 {
            let mut a = x[BIAS + i] + u[i];
            for j in 0..self.coefficients {
                a += self.phi[j][i] * x[THETA + j];
            }
            x[R + i] += self.dt * x[V + i] + self.half_dt2 * a;
            x[V + i] += self.dt * a;
        }
        for (first, taps) in &self.chains {
            for i in 0..taps.len() {
                x[first + i] = (i..taps.len()).map(|j| taps[j - i] * x[first + j]).sum();
            }
        }
    }

    /// `H x` for a column.
    #[must_use]
    pub fn observe(&self, x: &[f64; N]) -> [f64; 3] {
        std::array::from_fn(|axis| self.outputs[axis].iter().map(|&i| x[i]).sum())
    }

    /// `P Hᵀ` of a symmetric `P`.
    #[must_use]
    pub fn observed(&self, p: &Matrix<N>) -> Columns<N> {
        std::array::from_fn(|axis| {
            let mut column = [0.0; N];
            for &i in &self.outputs[axis] {
                for l in 0..N {
                    column[l] += p.0[i][l];
                }
            }
            column
        })
    }

    /// `H C` for three columns `C`.
    #[must_use]
    pub fn observed_twice(&self, c: &Columns<N>) -> Mat3 {
        std::array::from_fn(|i| std::array::from_fn(|j| self.outputs[i].iter().map(|&s| c[j][s]).sum()))
    }

    /// `destination = A · source`; with `LOWER`, only the lower blocks.
    fn rows<const LOWER: bool>(&self, destination: &mut Matrix<N>, source: &Matrix<N>) {
        let (d, s) = (&mut *destination.0, &*source.0);
        let width = |i: usize| if LOWER { lower_width(i) } else { N };
        for axis in 0..3 {
            for b in (0..width(V + axis)).step_by(LANES) {
                let mut a = [0.0; LANES];
                a.copy_from_slice(&s[BIAS + axis][b..b + LANES]);
                for j in 0..self.coefficients {
                    let f = self.phi[j][axis];
                    for l in 0..LANES {
                        a[l] += f * s[THETA + j][b + l];
                    }
                }
                for l in 0..LANES {
                    let v = s[V + axis][b + l];
                    d[R + axis][b + l] = s[R + axis][b + l] + (self.dt * v + self.half_dt2 * a[l]);
                    d[V + axis][b + l] = v + self.dt * a[l];
                }
            }
        }
        for i in BIAS..THETA + self.coefficients {
            d[i][..width(i)].copy_from_slice(&s[i][..width(i)]);
        }
        for (first, taps) in &self.chains {
            for i in 0..taps.len() {
                for b in (0..width(first + i)).step_by(LANES) {
                    let mut sum = [0.0; LANES];
                    for j in i..taps.len() {
                        let tap = taps[j - i];
                        for l in 0..LANES {
                            sum[l] += tap * s[first + j][b + l];
                        }
                    }
                    d[first + i][b..b + LANES].copy_from_slice(&sum);
                }
            }
        }
    }

    /// Lower blocks of `A P Aᵀ` into `product`, and `M = A P Hᵀ`. `half` is scratch.
    pub fn conjugate(
        &self,
        p: &Matrix<N>,
        half: &mut Matrix<N>,
        product: &mut Matrix<N>,
        turned: &mut Matrix<N>,
    ) -> Columns<N> {
        self.rows::<false>(half, p);
        let m = std::array::from_fn(|axis| {
            let mut column = [0.0; N];
            for &i in &self.outputs[axis] {
                for l in 0..N {
                    column[l] += half.0[l][i];
                }
            }
            column
        });
        for i in 0..N {
            for j in 0..lower_width(i) {
                turned.0[i][j] = half.0[j][i];
            }
        }
        self.rows::<true>(product, turned);
        m
    }
}

/// `Σ_d weight[c][d] columns[d]`.
#[must_use]
pub fn mix<const N: usize>(weight: &Mat3, columns: &Columns<N>) -> Columns<N> {
    std::array::from_fn(|c| {
        let [a, b, e] = weight[c];
        std::array::from_fn(|l| a * columns[0][l] + b * columns[1][l] + e * columns[2][l])
    })
}

/// `P = APAᵀ − W Mᵀ + Q` on the lower blocks, mirrored.
pub fn advance<const N: usize>(p: &mut Matrix<N>, apa: &Matrix<N>, w: &Columns<N>, m: &Columns<N>, q: &Matrix<N>) {
    for i in 0..N {
        let wi = [w[0][i], w[1][i], w[2][i]];
        for b in (0..lower_width(i)).step_by(LANES) {
            for l in 0..LANES {
                let j = b + l;
                let wm = wi[0] * m[0][j] + wi[1] * m[1][j] + wi[2] * m[2][j];
                p.0[i][j] = (apa.0[i][j] - wm) + q.0[i][j];
            }
        }
    }
    p.mirror();
}

/// The last three lines of the recursion in one pass: `Q̂_iter = Q̂ − W Mᵀ + K Ŝ Kᵀ` (eq:Final_AKF_Q_ITER, with
/// `P̂_{k+1}` of `Q̂_{k−1}`), `Q̂_k = update(Q̂_{k−1}, Q̂_iter, K Ŝ Kᵀ)`, and `P_{k+1} = A (I − K H) P Aᵀ + Q̂_k`
/// (eq:Final_AKF_p_k1). `y = K Ŝ`.
#[allow(clippy::too_many_arguments)] // one argument per matrix of the paper's equations
pub fn advance_adapting<const N: usize>(
    p: &mut Matrix<N>,
    q: &mut Matrix<N>,
    apa: &Matrix<N>,
    w: &Columns<N>,
    m: &Columns<N>,
    y: &Columns<N>,
    k: &Columns<N>,
    update: impl Fn(f64, f64, f64) -> f64,
) {
    for i in 0..N {
        let wi = [w[0][i], w[1][i], w[2][i]];
        let yi = [y[0][i], y[1][i], y[2][i]];
        for b in (0..lower_width(i)).step_by(LANES) {
            for l in 0..LANES {
                let j = b + l;
                let wm = wi[0] * m[0][j] + wi[1] * m[1][j] + wi[2] * m[2][j];
                let ksk = yi[0] * k[0][j] + yi[1] * k[1][j] + yi[2] * k[2][j];
                let before = q.0[i][j];
                let after = update(before, (before - wm) + ksk, ksk);
                q.0[i][j] = after;
                p.0[i][j] = (apa.0[i][j] - wm) + after;
            }
        }
    }
    p.mirror();
}

/// Covariance of a filter whose gain `K` was not made for it (Joseph's form, by structure):
/// `P = A [(I − KH) P (I − KH)ᵀ + K R Kᵀ] Aᵀ + Q = APAᵀ − W Lᵀ − L Wᵀ + Q`, `L = M − W S/2`, `S = H P Hᵀ + R`.
pub fn advance_with_foreign_gain<const N: usize>(
    p: &mut Matrix<N>,
    apa: &Matrix<N>,
    w: &Columns<N>,
    m: &Columns<N>,
    s: &Mat3,
    q: &Matrix<N>,
) {
    let half_ws = mix(s, w);
    let l_: Columns<N> = std::array::from_fn(|c| std::array::from_fn(|i| m[c][i] - 0.5 * half_ws[c][i]));
    for i in 0..N {
        let wi = [w[0][i], w[1][i], w[2][i]];
        let li = [l_[0][i], l_[1][i], l_[2][i]];
        for b in (0..lower_width(i)).step_by(LANES) {
            for l in 0..LANES {
                let j = b + l;
                let wl = wi[0] * l_[0][j] + wi[1] * l_[1][j] + wi[2] * l_[2][j];
                let lw = li[0] * w[0][j] + li[1] * w[1][j] + li[2] * w[2][j];
                p.0[i][j] = (apa.0[i][j] - (wl + lw)) + q.0[i][j];
            }
        }
    }
    p.mirror();
}

/// Inverse of a symmetric positive definite 3×3 matrix over the axes in `used`, zero elsewhere; `None` when it is not
/// positive definite. A readout that is not used so drops out of `K = P Hᵀ S⁻¹` and of everything made from it.
#[must_use]
pub fn inverse(s: &Mat3, used: [bool; 3]) -> Option<Mat3> {
    // LDLᵀ with unused axes replaced by the unit matrix.
    let at = |i: usize, j: usize| match (used[i] && used[j], i == j) {
        (true, _) => s[i][j],
        (false, true) => 1.0,
        (false, false) => 0.0,
    };
    let d0 = at(0, 0);
    let (l1, l2) = (at(1, 0) / d0, at(2, 0) / d0);
    let d1 = at(1, 1) - l1 * l1 * d0;
    let l3 = (at(2, 1) - l1 * l2 * d0) / d1;
    let d2 = at(2, 2) - l2 * l2 * d0 - l3 * l3 * d1;
    if !(d0 > 0.0 && d1 > 0.0 && d2 > 0.0 && d0.is_finite() && d1.is_finite() && d2.is_finite()) {
        return None;
    }
    // L⁻¹ has rows (1, 0, 0), (−l1, 1, 0), (l1 l3 − l2, −l3, 1).
    let inv_l = [[1.0, 0.0, 0.0], [-l1, 1.0, 0.0], [l1 * l3 - l2, -l3, 1.0]];
    let d = [d0, d1, d2];
    let mut out = [[0.0; 3]; 3];
    for i in 0..3 {
        for j in 0..=i {
            if used[i] && used[j] {
                let x = (i..3).map(|r| inv_l[r][i] * inv_l[r][j] / d[r]).sum();
                out[i][j] = x;
                out[j][i] = x;
            }
        }
    }
    Some(out)
}
