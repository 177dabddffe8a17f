//! Random processes that follow a [`NoiseShape`]: exact discretisations, stationary from the first sample.

use nalgebra::{DMatrix, DVector};
use rand::Rng;
use rand_distr::{Distribution, StandardNormal};
use std::f64::consts::TAU;

use crate::noise::{NoiseShape, NoiseTerm};

/// Leak of the integrators, rad/s. It bounds the variance; below 1 µHz a shape turns flat.
pub const LEAK_RAD_S: f64 = TAU * 1e-6;

/// One draw of a standard normal deviate (ziggurat).
pub fn normal<R: Rng + ?Sized>(rng: &mut R) -> f64 {
    StandardNormal.sample(rng)
}

/// A term `asd² (f₀/f)^{2n}` as `n` leaky integrators in a row behind white noise,
/// `ẋ_1 = −λ x_1 + w`, `ẋ_i = −λ x_i + x_{i−1}`, output `x_n`; `w` has the one-sided PSD `asd² (2πf₀)^{2n}`.
#[derive(Clone, Debug)]
struct Chain {
    /// `exp(A dt)`, lower triangular.
    transition: DMatrix<f64>,
    /// Cholesky factor of the covariance that one step adds.
    kick: DMatrix<f64>,
    /// Cholesky factor of the stationary covariance.
    stationary: DMatrix<f64>,
    state: DVector<f64>,
}

fn factorial(n: usize) -> f64 {
    (1..=n).map(|k| k as f64).product()
}

/// `∫₀^τ t^m e^{−ct} dt` for `cτ ≪ 1`, by its series; the closed form cancels.
fn incomplete_gamma(m: usize, c: f64, tau: f64) -> f64 {
    (0..12)
        .map(|k| (-c).powi(k) * tau.powi(m as i32 + k + 1) / (factorial(k as usize) * (m as f64 + f64::from(k) + 1.0)))
        .sum()
}

impl Chain {
    fn new(term: &NoiseTerm, dt_s: f64) -> Self {
        let n = term.exponent as usize / 2;
        // Two-sided intensity of w: half of the one-sided PSD.
        let intensity = 0.5 * (term.asd * (TAU * term.corner_hz).powi(n as i32)).powi(2);
        // x_i answers a unit impulse with t^{i−1}/(i−1)! e^{−λt}; covariances are integrals of products of these.
        let covariance = |integral: &dyn Fn(usize) -> f64| {
            DMatrix::from_fn(n, n, |i, j| intensity * integral(i + j) / (factorial(i) * factorial(j)))
        };
        let whole = covariance(&|m| factorial(m) / (2.0 * LEAK_RAD_S).powi(m as i32 + 1));
        let step = covariance(&|m| incomplete_gamma(m, 2.0 * LEAK_RAD_S, dt_s));
        let transition = DMatrix::from_fn(n, n, |i, j| {
            if i < j { 0.0 } else { dt_s.powi((i - j) as i32) / factorial(i - j) * (-LEAK_RAD_S * dt_s).exp() }
        });
        let factor = |m: DMatrix<f64>| scaled_cholesky(&m);
        Self { transition, kick: factor(step), stationary: factor(whole), state: DVector::zeros(n) }
    }

    fn start<R: Rng + ?Sized>(&mut self, rng: &mut R) {
        let w = DVector::from_fn(self.state.len(), |_, _| normal(rng));
        self.state = &self.stationary * w;
    }

    /// Gives `x_n` now and moves on by one step. Loops instead of matrix products: the matrices are 1×1 or 2×2.
    fn next<R: Rng + ?Sized>(&mut self, rng: &mut R) -> f64 {
        let n = self.state.len();
        let out = self.state[n - 1];
        let mut w = [0.0; MOST_STATES];
        for x in &mut w[..n] {
            *x = normal(rng);
        }
        for i in (0..n).rev() {
            let mut x = 0.0;
            for j in 0..=i {
                x += self.transition[(i, j)] * self.state[j] + self.kick[(i, j)] * w[j];
            }
            // Row i needs the old states 0..=i only, so going downwards overwrites nothing still needed.
            self.state[i] = x;
        }
        out
    }
}

/// States of the steepest term that a mission file may hold, exponent 8.
const MOST_STATES: usize = 4;

/// Lower Cholesky factor, computed on the correlation matrix: the states differ by many orders of magnitude.
fn scaled_cholesky(m: &DMatrix<f64>) -> DMatrix<f64> {
    let sigma = m.diagonal().map(f64::sqrt);
    if sigma.iter().any(|s| *s == 0.0) {
        return DMatrix::zeros(m.nrows(), m.ncols());
    }
    let correlation = DMatrix::from_fn(m.nrows(), m.ncols(), |i, j| m[(i, j)] / (sigma[i] * sigma[j]));
    let factor = correlation.cholesky().map_or_else(|| DMatrix::zeros(m.nrows(), m.ncols()), |c| c.unpack());
    DMatrix::from_diagonal(&sigma) * factor
}

/// A random process sampled every `dt_s`: white part `asd²/(2 dt)` and one chain per coloured term.
#[derive(Clone, Debug)]
pub struct NoiseProcess {
    white_sigma: f64,
    chains: Vec<Chain>,
}

impl NoiseProcess {
    /// A process of the given shape; it is silent in its coloured terms until [`Self::start`].
    #[must_use]
    pub fn new(shape: &NoiseShape, dt_s: f64) -> Self {
        Self {
            white_sigma: (0.5 * shape.white_psd() / dt_s).sqrt(),
            chains: shape.coloured().map(|t| Chain::new(t, dt_s)).collect(),
        }
    }

    /// Draws the states from their stationary distribution.
    pub fn start<R: Rng + ?Sized>(&mut self, rng: &mut R) {
        for chain in &mut self.chains {
            chain.start(rng);
        }
    }

    /// The coloured part of the coming sample: what a slow drift has already built up.
    #[must_use]
    pub fn slow(&self) -> f64 {
        self.chains.iter().map(|c| c.state[c.state.len() - 1]).sum()
    }

    /// The next sample.
    pub fn next<R: Rng + ?Sized>(&mut self, rng: &mut R) -> f64 {
        let mut out = if self.white_sigma > 0.0 { self.white_sigma * normal(rng) } else { 0.0 };
        for chain in &mut self.chains {
            out += chain.next(rng);
        }
        out
    }

    /// The states, for a checkpoint.
    pub fn states(&self) -> impl Iterator<Item = f64> + '_ {
        self.chains.iter().flat_map(|c| c.state.iter().copied())
    }

    /// Mutable access to the states in the order of [`Self::states`].
    pub fn states_mut(&mut self) -> impl Iterator<Item = &mut f64> + '_ {
        self.chains.iter_mut().flat_map(|c| c.state.iter_mut())
    }
}
