//! Random processes that follow a [`NoiseShape`]: exact discretisations, stationary from the first sample.

use nalgebra::SMatrix;
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

/// States of the steepest term that a mission file may hold, exponent 8.
const MOST_STATES: usize = 4;

type Square = SMatrix<f64, MOST_STATES, MOST_STATES>;

/// A term `asd² (f₀/f)^{2n}` as `n` leaky integrators in a row behind white noise,
/// `ẋ_1 = −λ x_1 + w`, `ẋ_i = −λ x_i + x_{i−1}`, output `x_n`; `w` has the one-sided PSD `asd² (2πf₀)^{2n}`.
///
/// All matrices are lower triangular, and zero beyond the first `n` rows.
#[derive(Clone, Debug)]
struct Chain {
    states: usize,
    /// `exp(A dt)`.
    transition: Square,
    /// Cholesky factor of the covariance that one step adds.
    kick: Square,
    /// Cholesky factor of the stationary covariance.
    stationary: Square,
    state: [f64; MOST_STATES],
}

fn factorial(n: usize) -> f64 {
    (1..=n).map(|k| k as f64).product()
}

/// `∫₀^τ t^m e^{−ct} dt` for `cτ ≪ 1`, by its series; the closed form cancels.
fn incomplete_gamma(m: usize, c: f64, tau: f64) -> f64 {
    let term = |k: usize| (-c * tau).powi(k as i32) / (factorial(k) * (m + k + 1) as f64);
    tau.powi(m as i32 + 1) * (0..12).map(term).sum::<f64>()
}

/// Lower Cholesky factor of a covariance, computed on its correlations: the states differ by many orders of magnitude.
fn cholesky(states: usize, covariance: impl Fn(usize, usize) -> f64) -> Square {
    let sigma = |i: usize| covariance(i, i).sqrt();
    let correlation = Square::from_fn(|i, j| match (i < states && j < states, i == j) {
        (_, true) => 1.0,
        (true, false) => covariance(i, j) / (sigma(i) * sigma(j)),
        (false, false) => 0.0,
    });
    let Some(factor) = correlation.cholesky() else { return Square::zeros() };
    let factor = factor.l();
    Square::from_fn(|i, j| if i < states && j <= i { sigma(i) * factor[(i, j)] } else { 0.0 })
}

impl Chain {
    fn new(term: &NoiseTerm, dt_s: f64) -> Self {
        let states = term.exponent as usize / 2;
        // x_i answers a unit impulse with t^{i−1}/(i−1)! e^{−λt}; covariances are integrals of products of these.
        // Half the one-sided PSD of w is its two-sided intensity.
        let intensity = 0.5 * (term.asd * (TAU * term.corner_hz).powi(states as i32)).powi(2);
        let scale = |i: usize, j: usize| intensity / (factorial(i) * factorial(j));
        let rate = 2.0 * LEAK_RAD_S;
        let transition = Square::from_fn(|i, j| {
            let power = i.checked_sub(j).filter(|_| i < states);
            power.map_or(0.0, |m| dt_s.powi(m as i32) / factorial(m) * (-LEAK_RAD_S * dt_s).exp())
        });
        if intensity == 0.0 {
            return Self { states, transition, kick: Square::zeros(), stationary: Square::zeros(), state: [0.0; 4] };
        }
        Self {
            states,
            transition,
            kick: cholesky(states, |i, j| scale(i, j) * incomplete_gamma(i + j, rate, dt_s)),
            stationary: cholesky(states, |i, j| scale(i, j) * factorial(i + j) / rate.powi((i + j) as i32 + 1)),
            state: [0.0; MOST_STATES],
        }
    }

    fn draws<R: Rng + ?Sized>(&self, rng: &mut R) -> [f64; MOST_STATES] {
        let mut w = [0.0; MOST_STATES];
        for x in &mut w[..self.states] {
            *x = normal(rng);
        }
        w
    }

    fn start<R: Rng + ?Sized>(&mut self, rng: &mut R) {
        let w = self.draws(rng);
        for i in 0..self.states {
            self.state[i] = (0..=i).map(|j| self.stationary[(i, j)] * w[j]).sum();
        }
    }

    /// `x_n` now.
    fn output(&self) -> f64 {
        self.state[self.states - 1]
    }

    /// Gives `x_n` and moves on by one step.
    fn next<R: Rng + ?Sized>(&mut self, rng: &mut R) -> f64 {
        let out = self.output();
        let w = self.draws(rng);
        // Row i needs the old states 0..=i, so going upwards from the last overwrites nothing still needed.
        for i in (0..self.states).rev() {
            self.state[i] = (0..=i).map(|j| self.transition[(i, j)] * self.state[j] + self.kick[(i, j)] * w[j]).sum();
        }
        out
    }
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
        self.chains.iter().map(Chain::output).sum()
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
        self.chains.iter().flat_map(|c| c.state[..c.states].iter().copied())
    }

    /// Mutable access to the states in the order of [`Self::states`].
    pub fn states_mut(&mut self) -> impl Iterator<Item = &mut f64> + '_ {
        self.chains.iter_mut().flat_map(|c| c.state[..c.states].iter_mut())
    }
}
