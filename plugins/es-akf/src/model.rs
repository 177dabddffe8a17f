//! The extended-state model (eq:extended_state_space, eq:readout_model), discretised.
//!
//! It has three axes of each test mass that is followed: one test mass, as in the paper, or several together.

use nalgebra::DMatrix;

use crate::shaping::{Chain, TorqueNoiseShaping};

/// Prior 1σ before the first sample, and of `r` and `v` after a loss of track.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Prior {
    /// Displacement about the readout at which the track begins, m.
    pub displacement_m: f64,
    /// Velocity about zero, m/s.
    pub velocity_m_s: f64,
    /// Bias acceleration about zero, m/s².
    pub bias_m_s2: f64,
}

/// One coefficient `θ_j` before the first sample, in the coefficient's own unit.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Coefficient {
    /// Initial value.
    pub initial: f64,
    /// Its standard deviation.
    pub prior_sigma: f64,
}

/// The model of one test mass or of several, axes one test mass after another, `D` in all. All components are in the
/// ORF of their test mass.
///
/// The states are `X = [r(D), v(D), a_b(D), θ(m), w(2 per torque noise), n(s)]`.
///
/// `A` is not stored: with `φ` (3×m) the regressors, mean over `[t_k, t_{k+1})`, it is, exactly for accelerations
/// constant over a step, `r ← r + dt v + dt²/2 (a_b + φθ + û)`, `v ← v + dt (a_b + φθ + û)`, `n ← A_n n`, and the
/// identity for `a_b` and `θ`. The offset's regressors are `φ = −[α̂×] − [ω̂×][ω̂×]`; the printed A has `+[α×]`,
/// against the paper's own eq:TM_SC_relative_acceleration.
#[derive(Clone, Debug, PartialEq)]
pub struct Model {
    /// Step, s.
    pub dt_s: f64,
    /// Covariance of the mean acceleration noise of one step, D×D, m² s⁻⁴: one-sided PSD × sample rate / 2.
    ///
    /// The noise is taken constant over a step, as û and α̂ are means over it, so the blocks of `Q` are
    /// `(dt⁴/4, dt³/2, dt²)`; a continuous white force would have `dt³/3` in place of `dt³/4` in `rr`.
    pub acceleration_m2_s4: DMatrix<f64>,
    /// What the angular acceleration leaves unknown of the torque noise, acting through the offsets.
    pub torque_noise: Vec<TorqueNoiseShaping>,
    /// Variance that each component of `a_b` gains in one step, m² s⁻⁴.
    pub bias_step_m2_s4: f64,
    /// Variance of the white part of the readouts, m²: one-sided PSD × sample rate / 2.
    pub readout_m2: Vec<f64>,
    /// Noise-shaping chains of the readouts.
    pub chains: Vec<Vec<Chain>>,
    /// Coefficients that act on these axes.
    pub coefficients: Vec<Coefficient>,
    /// Prior of the other states.
    pub prior: Prior,
}

impl Model {
    /// Number of axes that are followed, three of each test mass.
    pub fn axes(&self) -> usize {
        self.readout_m2.len()
    }

    /// First state of the coefficients, after displacements, velocities and bias accelerations.
    pub fn theta(&self) -> usize {
        3 * self.axes()
    }

    /// Number of states, `3D + m + 2 per torque noise + s`.
    pub fn states(&self) -> usize {
        self.first_chain() + self.chains.iter().flatten().map(Chain::states).sum::<usize>()
    }

    /// First state of the noise-shaping chains.
    fn first_chain(&self) -> usize {
        self.theta() + self.coefficients.len() + TorqueNoiseShaping::STATES * self.torque_noise.len()
    }

    /// Torque noise, each process with its first state.
    pub fn placed_torque_noise(&self) -> impl Iterator<Item = (usize, &TorqueNoiseShaping)> {
        let first = self.theta() + self.coefficients.len();
        self.torque_noise.iter().enumerate().map(move |(i, noise)| (first + TorqueNoiseShaping::STATES * i, noise))
    }

    /// Chains with their axis and their first state.
    pub fn placed_chains(&self) -> impl Iterator<Item = (usize, usize, &Chain)> {
        let mut at = self.first_chain();
        self.chains.iter().enumerate().flat_map(|(axis, chains)| chains.iter().map(move |c| (axis, c))).map(
            move |(axis, chain)| {
                let first = at;
                at += chain.states();
                (axis, first, chain)
            },
        )
    }

    /// `Q` before any adaptation, n×n, by entries through `set(row, column, value)`; zero elsewhere.
    pub fn process_noise(&self, mut set: impl FnMut(usize, usize, f64)) {
        let (dt, axes) = (self.dt_s, self.axes());
        for i in 0..axes {
            for j in 0..axes {
                // A torque noise's deviate acts at once as well.
                let driven: f64 = self.torque_noise.iter().map(|s| s.lever_m_s2[i] * s.lever_m_s2[j]).sum();
                let q = self.acceleration_m2_s4[(i, j)] + driven;
                set(i, j, q * dt.powi(4) / 4.0);
                set(i, axes + j, q * dt.powi(3) / 2.0);
                set(axes + i, j, q * dt.powi(3) / 2.0);
                set(axes + i, axes + j, q * dt.powi(2));
            }
            set(2 * axes + i, 2 * axes + i, self.bias_step_m2_s4);
        }
        for (first, noise) in self.placed_torque_noise() {
            let drive = noise.drive();
            for (state, gain) in (first..).zip(drive) {
                for (i, lever) in noise.lever_m_s2.iter().enumerate() {
                    for (moved, by) in [(i, dt.powi(2) / 2.0), (axes + i, dt)] {
                        set(moved, state, by * lever * gain);
                        set(state, moved, by * lever * gain);
                    }
                }
                for (other, other_gain) in (first..).zip(drive) {
                    set(state, other, gain * other_gain);
                }
            }
        }
        for (_, first, chain) in self.placed_chains() {
            let n = chain.states();
            for i in 0..n {
                for j in 0..n {
                    set(first + i, first + j, chain.noise[i * n + j]);
                }
            }
        }
    }

    /// `P` before the first sample, n×n, by entries through `set(row, column, value)`; zero elsewhere.
    pub fn prior_covariance(&self, mut set: impl FnMut(usize, usize, f64)) {
        let axes = self.axes();
        for i in 0..axes {
            set(i, i, self.prior.displacement_m.powi(2));
            set(axes + i, axes + i, self.prior.velocity_m_s.powi(2));
            set(2 * axes + i, 2 * axes + i, self.prior.bias_m_s2.powi(2));
        }
        for (j, c) in self.coefficients.iter().enumerate() {
            set(self.theta() + j, self.theta() + j, c.prior_sigma.powi(2));
        }
        for (first, noise) in self.placed_torque_noise() {
            let stationary = noise.stationary();
            for (i, row) in stationary.iter().enumerate() {
                for (j, covariance) in row.iter().enumerate() {
                    set(first + i, first + j, *covariance);
                }
            }
        }
        for (_, first, chain) in self.placed_chains() {
            let n = chain.states();
            for i in 0..n {
                for j in 0..n {
                    set(first + i, first + j, chain.stationary[i * n + j]);
                }
            }
        }
    }
}
