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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::spectrum::welch;
    use rand::SeedableRng;
    use rand_xoshiro::Xoshiro256PlusPlus;

    const DT_S: f64 = 0.1;

    fn term(exponent: u32) -> NoiseTerm {
        NoiseTerm { asd: 2e-9, corner_hz: 2e-3, exponent }
    }

    /// The process and the numbers of its steps.
    fn series(process: &NoiseProcess, seed: u64, n: usize) -> Vec<f64> {
        let mut rng = Xoshiro256PlusPlus::seed_from_u64(seed);
        let mut process = process.clone();
        process.start(&mut rng);
        (0..n).map(|_| process.next(&mut rng)).collect()
    }

    /// `P = Φ P Φᵀ + Q` to rounding, on the scale of Q: stationary whatever the number of steps.
    #[test]
    fn stationary_covariance_is_a_fixed_point() {
        // A leak of 1 µHz moves P by 1e-6 per step; exponents above 4 lose Q in the rounding of P.
        for exponent in [2, 4] {
            let c = Chain::new(&term(exponent), DT_S);
            let p = c.stationary * c.stationary.transpose();
            let next = c.transition * p * c.transition.transpose() + c.kick * c.kick.transpose();
            for i in 0..c.states {
                for j in 0..c.states {
                    let scale = (p[(i, i)] * p[(j, j)]).sqrt();
                    assert!((next[(i, j)] - p[(i, j)]).abs() < 1e-14 * scale, "exponent {exponent}, {i} {j}");
                }
            }
        }
    }

    /// The noise that a step adds, against an integration of its own: many thin Euler steps of the covariance.
    #[test]
    fn a_step_adds_the_exact_covariance() {
        for exponent in [2, 4, 6, 8] {
            let c = Chain::new(&term(exponent), DT_S);
            let q = 0.5 * (2e-9 * (TAU * 2e-3).powi(exponent as i32 / 2)).powi(2);
            let thin = 20_000;
            let h = DT_S / f64::from(thin);
            let mut p = Square::zeros();
            let mut a = Square::zeros();
            for i in 0..c.states {
                a[(i, i)] = -LEAK_RAD_S;
                if i > 0 {
                    a[(i, i - 1)] = 1.0;
                }
            }
            for _ in 0..thin {
                p += (a * p + p * a.transpose()) * h;
                p[(0, 0)] += q * h;
            }
            let exact = c.kick * c.kick.transpose();
            for i in 0..c.states {
                for j in 0..c.states {
                    let error = (p[(i, j)] / exact[(i, j)] - 1.0).abs();
                    // Euler's rule is off by about (i+j+1)²/thin.
                    assert!(error < 50.0 / f64::from(thin), "exponent {exponent}, {i} {j}: {error}");
                }
            }
        }
    }

    /// Variance of the very first sample and of sample 500 over 2000 seeds against the closed form, 4.5σ of χ².
    #[test]
    fn variance_is_stationary_from_the_first_sample() {
        let n = 2000;
        for (exponent, factor) in [(2, 2.0), (4, 4.0)] {
            let shape = NoiseShape { terms: vec![term(exponent)] };
            let process = NoiseProcess::new(&shape, DT_S);
            let half = exponent as i32 / 2;
            let intensity = 0.5 * (2e-9 * (TAU * 2e-3).powi(half)).powi(2);
            // q/(2λ) for one leaky integrator, q/(4λ³) for two.
            let variance = intensity / (factor * LEAK_RAD_S.powi(2 * half - 1));
            let mut sums = [0.0; 2];
            for seed in 0..n {
                let x = series(&process, seed, 501);
                sums[0] += x[0] * x[0];
                sums[1] += x[500] * x[500];
            }
            for sum in sums {
                let z = (sum / (n as f64 * variance) - 1.0) / (2.0 / n as f64).sqrt();
                assert!(z.abs() < 4.5, "exponent {exponent}: off by {z} sigma");
            }
        }
    }

    /// Autocorrelation through the structure function `E (x_{k+m} − x_k)² = 2 P (1 − e^{−λ m dt})`, exponent 2.
    #[test]
    fn autocorrelation_follows_the_leak() {
        let process = NoiseProcess::new(&NoiseShape { terms: vec![term(2)] }, DT_S);
        let p = 0.5 * (2e-9 * TAU * 2e-3).powi(2) / (2.0 * LEAK_RAD_S);
        let n = 2000;
        for lag in [1, 10, 400] {
            let want = -2.0 * p * (-LEAK_RAD_S * lag as f64 * DT_S).exp_m1();
            let sum: f64 = (0..n).map(|seed| series(&process, seed, lag + 1)).map(|x| (x[lag] - x[0]).powi(2)).sum();
            let z = (sum / (n as f64 * want) - 1.0) / (2.0 / n as f64).sqrt();
            assert!(z.abs() < 4.5, "lag {lag}: off by {z} sigma");
        }
    }

    /// z of the measured band against a shape's PSD, worst of the bands.
    fn worst_z(process: &NoiseProcess, model: &NoiseShape) -> f64 {
        let spectrum = welch(&series(process, 3, 1 << 19), 1.0 / DT_S, 1 << 15).unwrap();
        // Above 0.3 Hz a sampled red process folds back on itself; where it matters the white part is far above it.
        [(3e-3, 6e-3), (6e-3, 3e-2), (3e-2, 0.3)]
            .iter()
            .map(|(lo, hi)| spectrum.ratio(*lo..*hi, |f| model.psd(f)).unwrap())
            .map(|r| ((r.value - 1.0) / r.sigma).abs())
            .fold(0.0, f64::max)
    }

    /// PSD of whole shapes in three bands, each within 4.5σ (false alarm 7e-6 a band), and the twin whose corner or
    /// level is off is caught.
    #[test]
    fn spectrum_follows_the_shape() {
        for exponent in [2, 4] {
            let shape = NoiseShape::with_corner(2e-9, 2e-2, exponent);
            let process = NoiseProcess::new(&shape, DT_S);
            let z = worst_z(&process, &shape);
            assert!(z < 4.5, "exponent {exponent}: {z} sigma");
            let corner = NoiseShape::with_corner(2e-9, 3e-2, exponent);
            assert!(worst_z(&process, &corner) > 4.5, "a corner 1.5 times off is seen");
            let level = NoiseShape::with_corner(2.1e-9, 2e-2, exponent);
            assert!(worst_z(&process, &level) > 4.5, "a level 5 % off is seen");
        }
    }

    #[test]
    fn states_go_and_come_back() {
        let process = NoiseProcess::new(&NoiseShape::with_corner(1e-9, 1e-3, 4), DT_S);
        let mut rng = Xoshiro256PlusPlus::seed_from_u64(1);
        let mut a = process.clone();
        a.start(&mut rng);
        let mut b = process;
        let saved: Vec<f64> = a.states().collect();
        assert_eq!(saved.len(), 2);
        for (slot, value) in b.states_mut().zip(saved) {
            *slot = value;
        }
        let mut twin = rng.clone();
        for _ in 0..100 {
            assert_eq!(a.next(&mut rng).to_bits(), b.next(&mut twin).to_bits());
        }
    }
}
