//! Synthetic data for the tests: a test mass on a double integrator under known and unknown forces.

#![allow(dead_code, unreachable_pub)] // each test file uses its part

use dragfree_es_akf::filter::{Adaptation, Settings};
use dragfree_es_akf::model::{Coefficient, Model, Prior};
use dragfree_es_akf::shaping::Chain;
use dragfree_physics::noise::NoiseTerm;
use nalgebra::{Cholesky, DMatrix, DVector};
use rand::SeedableRng;
use rand_distr::{Distribution, StandardNormal};
use rand_xoshiro::Xoshiro256PlusPlus;

pub const DT_S: f64 = 0.1;

/// How the angular acceleration varies from step to step.
#[derive(Clone, Copy)]
pub enum Alpha {
    White,
    /// First-order process of this correlation time, s.
    Coloured(f64),
}

/// The default mission's noise levels; `exponents` are those of the coloured readout noise per axis, white below
/// `leak_hz`.
pub fn model(exponents: [&[u32]; 3], leak_hz: f64) -> Model {
    let half_rate = 0.5 / DT_S;
    let asd = [1.42e-12, 1.8e-9, 1.8e-9];
    let corner = [2e-3, 1e-3, 1e-3];
    let force = (1e-7_f64 / 1500.0).powi(2) * half_rate;
    Model {
        dt_s: DT_S,
        acceleration_m2_s4: DMatrix::identity(3, 3) * force,
        bias_step_m2_s4: (3e-15_f64).powi(2) * DT_S,
        readout_m2: asd.map(|a| a * a * half_rate).to_vec(),
        torque_noise: Vec::new(),
        chains: (0..3)
            .map(|i| {
                let term = |&exponent: &u32| NoiseTerm { asd: asd[i], corner_hz: corner[i], exponent };
                exponents[i].iter().map(|e| Chain::new(&term(e), leak_hz, DT_S)).collect()
            })
            .collect(),
        coefficients: vec![Coefficient { initial: 0.0, prior_sigma: 0.1 }; 3],
        prior: Prior { displacement_m: 1e-7, velocity_m_s: 1e-8, bias_m_s2: 1e-9 },
    }
}

pub fn settings(adaptation: Adaptation) -> Settings {
    Settings {
        adaptation,
        forgetting: 0.999_999,
        warm_up_epochs: 2000,
        gate_sigma: 0.0,
        gate_patience: 30,
        calibrated_sigma: true,
        check_epochs: 6000,
    }
}

/// One epoch: the readout at `t_k` and what acts over `[t_k, t_{k+1})`.
#[derive(Clone, Copy)]
pub struct Epoch {
    pub readout_m: [f64; 3],
    pub u_m_s2: [f64; 3],
    pub phi: [[f64; 3]; 3],
}

/// One chain of coloured readout noise.
struct Coloured {
    axis: usize,
    transition: Vec<f64>,
    state: Vec<f64>,
    drive: DMatrix<f64>,
}

/// A seeded stretch of data whose statistics are those of `model`, with the offset `b_m`.
pub struct Simulation {
    rng: Xoshiro256PlusPlus,
    model: Model,
    drive: [f64; 3],
    pub b_m: [f64; 3],
    pub bias_m_s2: [f64; 3],
    alpha: Alpha,
    alpha_sigma_rad_s2: f64,
    last_alpha: [f64; 3],
    r: [f64; 3],
    v: [f64; 3],
    chains: Vec<Coloured>,
}

impl Simulation {
    /// Offset, bias and first states are drawn from the model's own prior.
    pub fn new(model: &Model, alpha: Alpha, seed: u64) -> Self {
        let mut rng = Xoshiro256PlusPlus::seed_from_u64(seed);
        let mut normal = || -> f64 { StandardNormal.sample(&mut rng) };
        let b_m = std::array::from_fn(|j| model.coefficients[j].initial + model.coefficients[j].prior_sigma * normal());
        let bias_m_s2 = std::array::from_fn(|_| model.prior.bias_m_s2 * normal());
        let v = std::array::from_fn(|_| model.prior.velocity_m_s * normal());
        let chains = model
            .placed_chains()
            .map(|(axis, _, c)| {
                let n = c.states();
                let first = factor(n, &c.stationary) * DVector::from_fn(n, |_, _| normal());
                Coloured {
                    axis,
                    transition: c.transition.clone(),
                    state: first.as_slice().to_vec(),
                    drive: factor(n, &c.noise),
                }
            })
            .collect();
        Self {
            drive: std::array::from_fn(|i| model.acceleration_m2_s4[(i, i)].sqrt()),
            model: model.clone(),
            b_m,
            bias_m_s2,
            alpha,
            alpha_sigma_rad_s2: 3e-9,
            last_alpha: [0.0; 3],
            r: [0.0; 3],
            v,
            chains,
            rng,
        }
    }

    fn normal(&mut self) -> f64 {
        StandardNormal.sample(&mut self.rng)
    }

    pub fn epoch(&mut self) -> Epoch {
        let dt = self.model.dt_s;
        let mut readout_m = [0.0; 3];
        for i in 0..3 {
            readout_m[i] = self.r[i] + self.model.readout_m2[i].sqrt() * self.normal();
        }
        for chain in &self.chains {
            readout_m[chain.axis] += chain.state[0];
        }
        let (keep, add) = match self.alpha {
            Alpha::White => (0.0, 1.0),
            Alpha::Coloured(tau) => ((-dt / tau).exp(), (1.0 - (-2.0 * dt / tau).exp()).sqrt()),
        };
        for i in 0..3 {
            self.last_alpha[i] = keep * self.last_alpha[i] + add * self.alpha_sigma_rad_s2 * self.normal();
        }
        let a = self.last_alpha;
        // −[α×], by coefficient: column j of the matrix.
        let phi = [[0.0, -a[2], a[1]], [a[2], 0.0, -a[0]], [-a[1], a[0], 0.0]];
        // A soft controller keeps the test mass near zero; the filter is told what it did.
        let u_m_s2 = std::array::from_fn(|i| -0.01 * self.r[i] - 0.1 * self.v[i]);
        let bias_step = self.model.bias_step_m2_s4.sqrt();
        for i in 0..3 {
            let known = u_m_s2[i] + (0..3).map(|j| phi[j][i] * self.b_m[j]).sum::<f64>();
            let a = known + self.bias_m_s2[i] + self.drive[i] * self.normal();
            self.r[i] += dt * self.v[i] + 0.5 * dt * dt * a;
            self.v[i] += dt * a;
            self.bias_m_s2[i] += bias_step * self.normal();
        }
        for Coloured { transition, state, drive, .. } in &mut self.chains {
            let n = state.len();
            let fresh = &*drive * DVector::from_fn(n, |_, _| StandardNormal.sample(&mut self.rng));
            for i in 0..n {
                state[i] = (i..n).map(|j| transition[j - i] * state[j]).sum::<f64>() + fresh[i];
            }
        }
        Epoch { readout_m, u_m_s2, phi }
    }
}

/// Square root of a covariance whose entries span many decades.
fn factor(n: usize, covariance: &[f64]) -> DMatrix<f64> {
    let scale: Vec<f64> = (0..n).map(|i| covariance[i * n + i].sqrt()).collect();
    let scaled = DMatrix::from_fn(n, n, |i, j| covariance[i * n + j] / (scale[i] * scale[j]));
    let l = Cholesky::new(scaled).expect("a chain's covariance is positive definite").l();
    DMatrix::from_fn(n, n, |i, j| scale[i] * l[(i, j)])
}
