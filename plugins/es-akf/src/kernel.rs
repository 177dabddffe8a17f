//! The covariance algebra of one step, by structure instead of by dense products.
//!
//! `A` is the identity but for the rows of `r`, `v` and `n`, `H` has rows of zeros and ones, and
//! `P_{k+1} − A P_k Aᵀ = Q − W Mᵀ` with `M = A P Hᵀ` and `W = M S⁻¹ = A K`. So `Q̂_iter` is a low-rank update, and one
//! pass over the upper blocks of `P` and `Q` does a whole step.
//!
//! Matrices are `N×N` with `N` the number of states rounded up; rows and columns beyond the states stay zero.
//! **Invariant: `P` is exactly symmetric.** Every pass computes the upper triangle in blocks eight wide and mirrors it;
//! the same recursion without the mirror turns non-finite within 10⁵ steps. It is the upper one because the rows of `r`
//! and `v`, the only ones that `A` mixes, come first: whole rows of it take eight entries at a time.

use std::ops::Range;

use crate::model::Model;
use crate::shaping::TorqueNoiseShaping;

/// A D×D matrix over the readouts.
pub type Square<const D: usize> = [[f64; D]; D];
/// D columns of `N` rows, such as `K` or `P Hᵀ`, stored by column.
pub type Columns<const N: usize, const D: usize> = [[f64; N]; D];

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

/// `Σ_c weight[c] columns[c]` over block `b`.
#[inline(always)]
fn combine<const N: usize, const D: usize>(weight: [f64; D], columns: &Columns<N, D>, b: usize) -> [f64; NARROW] {
    let mut sum = [0.0; NARROW];
    for (weight, column) in weight.iter().zip(columns) {
        let block: &[f64; NARROW] = &blocks(column)[b];
        for l in 0..NARROW {
            sum[l] += weight * block[l];
        }
    }
    sum
}

/// `A` of one step and the selections of `H`, shared by every covariance of a filter.
#[derive(Clone, Debug)]
pub struct Transition<const N: usize, const D: usize> {
    dt: f64,
    half_dt2: f64,
    /// States from the first coefficient on that push `v`: coefficients and torque noise.
    pushing: usize,
    /// The states of the torque noise and of the readouts.
    noise: Range<usize>,
    /// Diagonal of `A_n`, by state; one for all others.
    decay: Box<[f64; N]>,
    /// The rest of `A_n` over the decay, which is one within a block: row, column > row, entry, rows ascending.
    links: Vec<(usize, usize, f64)>,
    /// States that add up in each readout: `r_i` and the outputs of its chains.
    outputs: [Vec<usize>; D],
    /// What the states from the first coefficient on push, m s⁻² per unit: the regressors of the current step, then the
    /// levers of the torque noise, which never change.
    pub phi: Box<[[f64; D]; N]>,
}

impl<const N: usize, const D: usize> Transition<N, D> {
    /// First state of the displacements, velocities, bias accelerations and coefficients.
    pub const R: usize = 0;
    /// See [`Self::R`].
    pub const V: usize = D;
    /// See [`Self::R`].
    pub const BIAS: usize = 2 * D;
    /// See [`Self::R`].
    pub const THETA: usize = 3 * D;

    /// The transition of a model, regressors zero.
    pub fn new(model: &Model) -> Self {
        let mut outputs: [Vec<usize>; D] = std::array::from_fn(|axis| vec![Self::R + axis]);
        let mut decay = Box::new([1.0; N]);
        let mut links = Vec::new();
        let mut phi = Box::new([[0.0; D]; N]);
        for (first, noise) in model.placed_torque_noise() {
            let (diagonal, [upper, lower]) = noise.factors();
            decay[first..first + 2].copy_from_slice(&diagonal);
            phi[first - Self::THETA] = std::array::from_fn(|axis| -noise.lever_m_s2[axis]);
            links.extend([(first, first + 1, upper), (first + 1, first, lower)]);
        }
        for (axis, first, chain) in model.placed_chains() {
            outputs[axis].push(first);
            for i in first..first + chain.states() {
                decay[i] = chain.decay();
                let link = |j: usize| (i, j, chain.transition[j - i] / chain.decay());
                links.extend((i + 1..first + chain.states()).map(link));
            }
        }
        let coefficients = model.coefficients.len();
        Self {
            dt: model.dt_s,
            half_dt2: 0.5 * model.dt_s * model.dt_s,
            pushing: coefficients + TorqueNoiseShaping::STATES * model.torque_noise.len(),
            noise: Self::THETA + coefficients..model.states(),
            decay,
            links,
            outputs,
            phi,
        }
    }

    /// `X ← A X + B û` (eq:Final_AKF_X_k).
    pub fn state(&self, x: &mut [f64; N], u: &[f64; D]) {
        self.move_mass(x, u);
        self.move_noise(x, 1.0);
    }

    /// The rows of `r` and `v`, before those of the noise that pushes them.
    #[inline(always)]
    fn move_mass(&self, x: &mut [f64; N], u: &[f64; D]) {
        let mut a: [f64; D] = std::array::from_fn(|i| x[Self::BIAS + i] + u[i]);
        for (phi, theta) in self.phi[..self.pushing].iter().zip(&x[Self::THETA..]) {
            for i in 0..D {
                a[i] += phi[i] * theta;
            }
        }
        for i in 0..D {
            x[Self::R + i] += self.dt * x[Self::V + i] + self.half_dt2 * a[i];
            x[Self::V + i] += self.dt * a[i];
        }
    }

    /// The rows of the noise, and `factor · x` for all other states, from the second block on.
    #[inline(always)]
    fn move_noise(&self, x: &mut [f64; N], factor: f64) {
        for l in LANES..N {
            x[l] *= factor * self.decay[l];
        }
        for &(i, j, link) in &self.links {
            x[i] += link * x[j];
        }
    }

    /// `H x` for a column.
    pub fn observe(&self, x: &[f64; N]) -> [f64; D] {
        std::array::from_fn(|axis| self.outputs[axis].iter().map(|&i| x[i]).sum())
    }

    /// `P Hᵀ` of a symmetric `P`.
    pub fn observed(&self, p: &Matrix<N>) -> Columns<N, D> {
        let mut c = [[0.0; N]; D];
        for (column, outputs) in c.iter_mut().zip(&self.outputs) {
            for &i in outputs {
                add(column, 1.0, &p.0[i]);
            }
        }
        c
    }

    /// `H C` for the columns `C`.
    pub fn observed_twice(&self, c: &Columns<N, D>) -> Square<D> {
        std::array::from_fn(|i| std::array::from_fn(|j| self.outputs[i].iter().map(|&s| c[j][s]).sum()))
    }

    /// Upper triangle of `A P Aᵀ` into `product`; what stands below it means nothing.
    pub fn conjugate(&self, p: &Matrix<N>, product: &mut Matrix<N>) {
        let d = &mut *product.0;
        let (first, end) = (self.noise.start, self.noise.end);
        d[Self::BIAS..end].copy_from_slice(&p.0[Self::BIAS..end]);
        // A · for the rows of r and v, then · Aᵀ for their columns: by symmetry these rows but for their own block.
        for b in 0..N / LANES {
            for axis in 0..D {
                let mut a: [f64; LANES] = blocks(&p.0[Self::BIAS + axis])[b];
                for (phi, theta) in self.phi[..self.pushing].iter().zip(&p.0[Self::THETA..]) {
                    let theta: &[f64; LANES] = &blocks(theta)[b];
                    for l in 0..LANES {
                        a[l] += phi[axis] * theta[l];
                    }
                }
                let (r, v): ([f64; LANES], [f64; LANES]) =
                    (blocks(&p.0[Self::R + axis])[b], blocks(&p.0[Self::V + axis])[b]);
                let moved: [f64; LANES] = std::array::from_fn(|l| r[l] + (self.dt * v[l] + self.half_dt2 * a[l]));
                blocks_mut(&mut d[Self::R + axis])[b] = moved;
                let moved: [f64; LANES] = std::array::from_fn(|l| v[l] + self.dt * a[l]);
                blocks_mut(&mut d[Self::V + axis])[b] = moved;
            }
        }
        for row in &mut d[..Self::BIAS] {
            self.move_mass(row, &[0.0; D]);
        }
        // · Aᵀ for the columns of the noise, then A · for its rows; a row of noise needs none before its own first
        // block.
        for (i, row) in d[..end].iter_mut().enumerate() {
            self.move_noise(row, if i < first { 1.0 } else { self.decay[i] });
        }
        for &(i, j, link) in &self.links {
            let from = d[j];
            for l in LANES..N {
                d[i][l] += link * from[l];
            }
        }
    }

    /// `A C` for the columns `C`.
    pub fn columns(&self, c: &Columns<N, D>) -> Columns<N, D> {
        let mut moved = *c;
        for column in &mut moved {
            self.state(column, &[0.0; D]);
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
#[inline]
pub fn mix<const N: usize, const D: usize>(weight: &Square<D>, columns: &Columns<N, D>) -> Columns<N, D> {
    let mut mixed = [[0.0; N]; D];
    for (out, weights) in mixed.iter_mut().zip(weight) {
        for (w, column) in weights.iter().zip(columns) {
            add(out, *w, column);
        }
    }
    mixed
}

/// `P = APAᵀ + Q − W Mᵀ` on the upper blocks, mirrored (eq:Final_AKF_p_k1).
pub fn advance<const N: usize, const D: usize>(
    p: &mut Matrix<N>,
    apaq: &Matrix<N>,
    w: &Columns<N, D>,
    m: &Columns<N, D>,
) {
    for i in 0..N {
        let wi: [f64; D] = std::array::from_fn(|c| w[c][i]);
        for b in upper_blocks::<N>(i) {
            let wm = combine(wi, m, b);
            let apaq: &[f64; NARROW] = &blocks(&apaq.0[i])[b];
            let next: [f64; NARROW] = std::array::from_fn(|l| apaq[l] - wm[l]);
            blocks_mut(&mut p.0[i])[b] = next;
        }
    }
    p.mirror();
}

/// `Q̂_k = update(Q̂_{k−1}, Q̂_iter, K Ŝ Kᵀ)` on the given entries of the upper triangle, with
/// `Q̂_iter = Q̂ − W Mᵀ + K Ŝ Kᵀ` (eq:Final_AKF_Q_ITER with `P̂_{k+1}` of `Q̂_{k−1}`) and `y = K Ŝ`.
pub fn adapt<const N: usize, const D: usize>(
    q: &mut Matrix<N>,
    entries: &[(usize, usize)],
    [w, m]: [&Columns<N, D>; 2],
    [y, k]: [&Columns<N, D>; 2],
    update: impl Fn(f64, f64, f64) -> f64,
) {
    for &(i, j) in entries {
        let product = |a: &Columns<N, D>, b: &Columns<N, D>| (0..D).map(|c| a[c][i] * b[c][j]).sum::<f64>();
        let (wm, ksk) = (product(w, m), product(y, k));
        let before = q.0[i][j];
        q.0[i][j] = update(before, (before - wm) + ksk, ksk);
    }
}

/// Covariance of a filter whose gain `K` was not made for it (Joseph's form, by structure):
/// `P = A [(I − KH) P (I − KH)ᵀ + K R Kᵀ] Aᵀ + Q = APAᵀ + Q − W Lᵀ − L Wᵀ`, `L = M − W S/2`, `S = H P Hᵀ + R`.
pub fn advance_joseph<const N: usize, const D: usize>(
    p: &mut Matrix<N>,
    apaq: &Matrix<N>,
    w: &Columns<N, D>,
    m: &Columns<N, D>,
    s: &Square<D>,
) {
    let mut l = mix(&s.map(|row| row.map(|x| -0.5 * x)), w);
    for (l, m) in l.iter_mut().zip(m) {
        add(l, 1.0, m);
    }
    for i in 0..N {
        let wi: [f64; D] = std::array::from_fn(|c| w[c][i]);
        let li: [f64; D] = std::array::from_fn(|c| l[c][i]);
        for b in upper_blocks::<N>(i) {
            let (wl, lw) = (combine(wi, &l, b), combine(li, w, b));
            let apaq: &[f64; NARROW] = &blocks(&apaq.0[i])[b];
            let next: [f64; NARROW] = std::array::from_fn(|c| apaq[c] - (wl[c] + lw[c]));
            blocks_mut(&mut p.0[i])[b] = next;
        }
    }
    p.mirror();
}

/// Inverse of a symmetric positive definite matrix over the readouts in `used`, zero elsewhere; `None` when it is not
/// positive definite. A readout that is not used so drops out of `K = P Hᵀ S⁻¹` and of everything made from it.
pub fn inverse<const D: usize>(s: &Square<D>, used: [bool; D]) -> Option<Square<D>> {
    // LDLᵀ with unused readouts replaced by the unit matrix; `l` below its diagonal of ones.
    let mut l = [[0.0; D]; D];
    let mut d = [0.0; D];
    for i in 0..D {
        for j in 0..=i {
            let at = match (used[i] && used[j], i == j) {
                (true, _) => s[i][j],
                (false, true) => 1.0,
                (false, false) => 0.0,
            };
            let left = at - (0..j).map(|k| l[i][k] * l[j][k] * d[k]).sum::<f64>();
            if i == j {
                d[i] = left;
            } else {
                l[i][j] = left / d[j];
            }
        }
        if !(d[i] > 0.0 && d[i].is_finite()) {
            return None;
        }
    }
    // L⁻¹, row by row.
    let mut inv_l = [[0.0; D]; D];
    for i in 0..D {
        inv_l[i][i] = 1.0;
        for j in 0..i {
            inv_l[i][j] = -(j..i).map(|k| l[i][k] * inv_l[k][j]).sum::<f64>();
        }
    }
    let mut out = [[0.0; D]; D];
    for i in 0..D {
        for j in 0..=i {
            if used[i] && used[j] {
                let x = (i..D).map(|r| inv_l[r][i] * inv_l[r][j] / d[r]).sum();
                out[i][j] = x;
                out[j][i] = x;
            }
        }
    }
    Some(out)
}
