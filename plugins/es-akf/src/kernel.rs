//! The covariance algebra of one step, by structure instead of by dense products.
//!
//! `A` is the identity but for the rows of `r`, `v` and `n`, `H` has three rows of zeros and ones, and
//! `P_{k+1} − A P_k Aᵀ = Q − W Mᵀ` with `M = A P Hᵀ` and `W = M S⁻¹ = A K`. So `Q̂_iter` is a low-rank update, and one
//! pass over the upper blocks of `P` and `Q` does a whole step.
//!
//! Matrices are `N×N` with `N` the number of states rounded up; rows and columns beyond the states stay zero.
//! **Invariant: `P` is exactly symmetric.** Every pass computes the upper triangle in blocks eight wide and mirrors it;
//! the same recursion without the mirror turns non-finite within 10⁵ steps. It is the upper one because the rows of `r`
//! and `v`, the only ones that `A` mixes, come first: whole rows of it take eight entries at a time.

use std::ops::Range;

use crate::model::{BIAS, Model, R, THETA, V};

/// A 3×3 matrix over the readouts x, y, z.
pub type Mat3 = [[f64; 3]; 3];
/// Three columns of `N` rows, such as `K` or `P Hᵀ`, stored by column.
pub type Columns<const N: usize> = [[f64; N]; 3];

/// Width of the blocks of a whole row, in columns. The first block ends before the noise-shaping states.
const LANES: usize = 8;
/// Width of the blocks along the diagonal: the narrower, the less is computed that the mirror overwrites.
const NARROW: usize = 2;
/// Side of the tiles in which a matrix is mirrored.
const TILE: usize = 4;

/// A square matrix on the heap, padded with zeros.
#[derive(Clone, Debug, PartialEq)]
pub struct Matrix<const N: usize>(pub Box<[[f64; N]; N]>);

impl<const N: usize> Matrix<N> {
    /// All zero.
    #[must_use]
    pub fn zero() -> Self {
        Self(Box::new([[0.0; N]; N]))
    }

    /// Copies the strict upper triangle onto the lower one, tile by tile.
    pub fn mirror(&mut self) {
        for i in (0..N).step_by(TILE) {
            for j in (i..N).step_by(TILE) {
                let tile: [[f64; TILE]; TILE] = std::array::from_fn(|k| std::array::from_fn(|l| self.0[i + k][j + l]));
                for l in 0..TILE {
                    for k in 0..if i == j { l } else { TILE } {
                        self.0[j + l][i + k] = tile[k][l];
                    }
                }
            }
        }
    }
}

/// Blocks of row `i` that hold its upper triangle.
const fn upper_blocks<const N: usize>(i: usize) -> Range<usize> {
    i / NARROW..N / NARROW
}

/// A row, or a column of [`Columns`], in blocks.
#[inline(always)]
fn blocks<const N: usize, const W: usize>(row: &[f64; N]) -> &[[f64; W]] {
    row.as_chunks().0
}

#[inline(always)]
fn blocks_mut<const N: usize, const W: usize>(row: &mut [f64; N]) -> &mut [[f64; W]] {
    row.as_chunks_mut().0
}

/// `sum += factor · row`.
#[inline(always)]
fn add<const N: usize>(sum: &mut [f64; N], factor: f64, row: &[f64; N]) {
    for l in 0..N {
        sum[l] += factor * row[l];
    }
}

/// `Σ_c weight[c] columns[c]` over one block.
#[inline(always)]
fn combine(weight: [f64; 3], columns: [&[f64; NARROW]; 3]) -> [f64; NARROW] {
    std::array::from_fn(|l| weight[0] * columns[0][l] + weight[1] * columns[1][l] + weight[2] * columns[2][l])
}

/// `A` of one step and the selections of `H`, shared by every covariance of a test mass.
#[derive(Clone, Debug)]
pub struct Transition<const N: usize> {
    dt: f64,
    half_dt2: f64,
    coefficients: usize,
    /// The noise-shaping states.
    noise: Range<usize>,
    /// Diagonal of `A_n`, by state; one for all others.
    decay: Box<[f64; N]>,
    /// The rest of `A_n` over the decay: row, column > row, entry, rows ascending.
    links: Vec<(usize, usize, f64)>,
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
        let mut decay = Box::new([1.0; N]);
        let mut links = Vec::new();
        for (axis, first, chain) in model.placed_chains() {
            outputs[axis].push(first);
            for i in first..first + chain.states() {
                decay[i] = chain.decay();
                let link = |j: usize| (i, j, chain.transition[j - i] / chain.decay());
                links.extend((i + 1..first + chain.states()).map(link));
            }
        }
        Self {
            dt: model.dt_s,
            half_dt2: 0.5 * model.dt_s * model.dt_s,
            coefficients: model.coefficients.len(),
            noise: THETA + model.coefficients.len()..model.states(),
            decay,
            links,
            outputs,
            phi: Box::new([[0.0; 3]; N]),
        }
    }

    /// `X ← A X + B û` (eq:Final_AKF_X_k).
    pub fn state(&self, x: &mut [f64; N], u: &[f64; 3]) {
        let before = *x;
        self.move_noise(&before, x, 1.0);
        self.move_mass(x, u);
    }

    /// The rows of `r` and `v`.
    #[inline(always)]
    fn move_mass(&self, x: &mut [f64; N], u: &[f64; 3]) {
        let mut a: [f64; 3] = std::array::from_fn(|i| x[BIAS + i] + u[i]);
        for (phi, theta) in self.phi[..self.coefficients].iter().zip(&x[THETA..]) {
            for i in 0..3 {
                a[i] += phi[i] * theta;
            }
        }
        for i in 0..3 {
            x[R + i] += self.dt * x[V + i] + self.half_dt2 * a[i];
            x[V + i] += self.dt * a[i];
        }
    }

    /// The rows of `n`: `moved = factor · A_n x`, `factor · x` for all other states, from the second block on.
    #[inline(always)]
    fn move_noise(&self, x: &[f64; N], moved: &mut [f64; N], factor: f64) {
        for l in LANES..N {
            moved[l] = (factor * self.decay[l]) * x[l];
        }
        for &(i, j, link) in &self.links {
            moved[i] += link * moved[j];
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
        let mut c = [[0.0; N]; 3];
        for (column, outputs) in c.iter_mut().zip(&self.outputs) {
            for &i in outputs {
                add(column, 1.0, &p.0[i]);
            }
        }
        c
    }

    /// `H C` for three columns `C`.
    #[must_use]
    pub fn observed_twice(&self, c: &Columns<N>) -> Mat3 {
        std::array::from_fn(|i| std::array::from_fn(|j| self.outputs[i].iter().map(|&s| c[j][s]).sum()))
    }

    /// Upper triangle of `A P Aᵀ` into `product`; what stands below it means nothing.
    pub fn conjugate(&self, p: &Matrix<N>, product: &mut Matrix<N>) {
        let d = &mut *product.0;
        let (first, end) = (self.noise.start, self.noise.end);
        // · Aᵀ for the columns of n, then A · for their rows; a row of n needs none before its own first block.
        for (i, (row, before)) in d[..end].iter_mut().zip(p.0.iter()).enumerate() {
            row[..LANES].copy_from_slice(&before[..LANES]);
            self.move_noise(before, row, if i < first { 1.0 } else { self.decay[i] });
        }
        for &(i, j, link) in &self.links {
            let (upper, lower) = d.split_at_mut(j);
            for l in LANES..N {
                upper[i][l] += link * lower[0][l];
            }
        }
        // A · for the rows of r and v; the columns of r and v are, by symmetry, these rows but for their own block.
        for b in 0..N / LANES {
            for axis in 0..3 {
                let mut a: [f64; LANES] = blocks(&d[BIAS + axis])[b];
                for (phi, theta) in self.phi[..self.coefficients].iter().zip(&d[THETA..]) {
                    let theta: &[f64; LANES] = &blocks(theta)[b];
                    for l in 0..LANES {
                        a[l] += phi[axis] * theta[l];
                    }
                }
                let (r, v): ([f64; LANES], [f64; LANES]) = (blocks(&d[R + axis])[b], blocks(&d[V + axis])[b]);
                let moved: [f64; LANES] = std::array::from_fn(|l| r[l] + (self.dt * v[l] + self.half_dt2 * a[l]));
                blocks_mut(&mut d[R + axis])[b] = moved;
                let moved: [f64; LANES] = std::array::from_fn(|l| v[l] + self.dt * a[l]);
                blocks_mut(&mut d[V + axis])[b] = moved;
            }
        }
        for row in &mut d[..BIAS] {
            self.move_mass(row, &[0.0; 3]);
        }
    }

    /// `A C` for three columns `C`.
    #[must_use]
    pub fn columns(&self, c: &Columns<N>) -> Columns<N> {
        let mut moved = [[0.0; N]; 3];
        for (column, before) in moved.iter_mut().zip(c) {
            column[..LANES].copy_from_slice(&before[..LANES]);
            self.move_noise(before, column, 1.0);
            self.move_mass(column, &[0.0; 3]);
        }
        moved
    }
}

/// Adds `Q` to `A P Aᵀ` where `Q` is not zero.
pub fn add_noise<const N: usize>(apa: &mut Matrix<N>, q: &Matrix<N>, entries: &[(usize, usize)]) {
    for &(i, j) in entries {
        apa.0[i][j] += q.0[i][j];
    }
}

/// `Σ_d weight[c][d] columns[d]`.
#[must_use]
#[inline]
pub fn mix<const N: usize>(weight: &Mat3, columns: &Columns<N>) -> Columns<N> {
    let mut mixed = [[0.0; N]; 3];
    for (out, w) in mixed.iter_mut().zip(weight) {
        for l in 0..N {
            out[l] = w[0] * columns[0][l] + w[1] * columns[1][l] + w[2] * columns[2][l];
        }
    }
    mixed
}

/// `P = APAᵀ + Q − W Mᵀ` on the upper blocks, mirrored (eq:Final_AKF_p_k1).
pub fn advance<const N: usize>(p: &mut Matrix<N>, apaq: &Matrix<N>, w: &Columns<N>, m: &Columns<N>) {
    for i in 0..N {
        let wi = [w[0][i], w[1][i], w[2][i]];
        for b in upper_blocks::<N>(i) {
            let wm = combine(wi, [&blocks(&m[0])[b], &blocks(&m[1])[b], &blocks(&m[2])[b]]);
            let apaq: &[f64; NARROW] = &blocks(&apaq.0[i])[b];
            let next: [f64; NARROW] = std::array::from_fn(|l| apaq[l] - wm[l]);
            blocks_mut(&mut p.0[i])[b] = next;
        }
    }
    p.mirror();
}

/// `Q̂_k = update(Q̂_{k−1}, Q̂_iter, K Ŝ Kᵀ)` on the given entries of the upper triangle, with
/// `Q̂_iter = Q̂ − W Mᵀ + K Ŝ Kᵀ` (eq:Final_AKF_Q_ITER with `P̂_{k+1}` of `Q̂_{k−1}`) and `y = K Ŝ`.
pub fn adapt<const N: usize>(
    q: &mut Matrix<N>,
    entries: &[(usize, usize)],
    [w, m]: [&Columns<N>; 2],
    [y, k]: [&Columns<N>; 2],
    update: impl Fn(f64, f64, f64) -> f64,
) {
    for &(i, j) in entries {
        let wm = w[0][i] * m[0][j] + w[1][i] * m[1][j] + w[2][i] * m[2][j];
        let ksk = y[0][i] * k[0][j] + y[1][i] * k[1][j] + y[2][i] * k[2][j];
        let before = q.0[i][j];
        q.0[i][j] = update(before, (before - wm) + ksk, ksk);
    }
}

/// Covariance of a filter whose gain `K` was not made for it (Joseph's form, by structure):
/// `P = A [(I − KH) P (I − KH)ᵀ + K R Kᵀ] Aᵀ + Q = APAᵀ + Q − W Lᵀ − L Wᵀ`, `L = M − W S/2`, `S = H P Hᵀ + R`.
pub fn advance_with_foreign_gain<const N: usize>(
    p: &mut Matrix<N>,
    apaq: &Matrix<N>,
    w: &Columns<N>,
    m: &Columns<N>,
    s: &Mat3,
) {
    let mut l = mix(&s.map(|row| row.map(|x| -0.5 * x)), w);
    for (l, m) in l.iter_mut().zip(m) {
        add(l, 1.0, m);
    }
    for i in 0..N {
        let wi = [w[0][i], w[1][i], w[2][i]];
        let li = [l[0][i], l[1][i], l[2][i]];
        for b in upper_blocks::<N>(i) {
            let wl = combine(wi, [&blocks(&l[0])[b], &blocks(&l[1])[b], &blocks(&l[2])[b]]);
            let lw = combine(li, [&blocks(&w[0])[b], &blocks(&w[1])[b], &blocks(&w[2])[b]]);
            let apaq: &[f64; NARROW] = &blocks(&apaq.0[i])[b];
            let next: [f64; NARROW] = std::array::from_fn(|c| apaq[c] - (wl[c] + lw[c]));
            blocks_mut(&mut p.0[i])[b] = next;
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
