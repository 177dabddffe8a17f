//! The extended-state model of one test mass (eq:extended_state_space, eq:readout_model), discretised.

use crate::shaping::Chain;

/// First index of each group of states: `X = [r(3), v(3), a_b(3), θ(m), n(s)]`.
pub(crate) const R: usize = 0;
pub(crate) const V: usize = 3;
pub(crate) const BIAS: usize = 6;
pub(crate) const THETA: usize = 9;

/// What is believed before the first sample, 1σ, and what `r` and `v` fall back to after a loss of track.
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

/// The model of one test mass. All components are in its ORF.
///
/// `A` is not stored: with `φ` (3×m) the regressors, mean over `[t_k, t_{k+1})`, it is, exactly for accelerations
/// constant over a step, `r ← r + dt v + dt²/2 (a_b + φθ + û)`, `v ← v + dt (a_b + φθ + û)`, `n ← A_n n`, and the
/// identity for `a_b` and `θ`. The offset's regressors are `φ = −[α̂×] − [ω̂×][ω̂×]`; the printed A has `+[α×]`,
/// against the paper's own eq:TM_SC_relative_acceleration.
#[derive(Clone, Debug, PartialEq)]
pub struct Model {
    /// Step, s.
    pub dt_s: f64,
    /// Covariance of the mean acceleration noise of one step, 3×3, m² s⁻⁴: one-sided PSD × sample rate / 2.
    ///
    /// The noise is taken constant over a step, as û and α̂ are means over it, so the blocks of `Q` are
    /// `(dt⁴/4, dt³/2, dt²)`; a continuous white force would have `dt³/3` in place of `dt³/4` in `rr`.
    pub acceleration_m2_s4: [[f64; 3]; 3],
    /// Variance that each component of `a_b` gains in one step, m² s⁻⁴.
    pub bias_step_m2_s4: f64,
    /// Variance of the white part of the readouts x, y, z, m²: one-sided PSD × sample rate / 2.
    pub readout_m2: [f64; 3],
    /// Noise-shaping chains of the readouts x, y, z.
    pub chains: [Vec<Chain>; 3],
    /// Coefficients that act on this test mass.
    pub coefficients: Vec<Coefficient>,
    /// Prior of the other states.
    pub prior: Prior,
}

impl Model {
    /// Number of states, `9 + m + s`.
    #[must_use]
    pub fn states(&self) -> usize {
        THETA + self.coefficients.len() + self.chains.iter().flatten().map(Chain::states).sum::<usize>()
    }

    /// Chains with their axis and their first state.
    pub fn placed_chains(&self) -> impl Iterator<Item = (usize, usize, &Chain)> {
        let mut at = THETA + self.coefficients.len();
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
        let dt = self.dt_s;
        for i in 0..3 {
            for j in 0..3 {
                let q = self.acceleration_m2_s4[i][j];
                set(R + i, R + j, q * dt.powi(4) / 4.0);
                set(R + i, V + j, q * dt.powi(3) / 2.0);
                set(V + i, R + j, q * dt.powi(3) / 2.0);
                set(V + i, V + j, q * dt.powi(2));
            }
            set(BIAS + i, BIAS + i, self.bias_step_m2_s4);
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
        for i in 0..3 {
            set(R + i, R + i, self.prior.displacement_m.powi(2));
            set(V + i, V + i, self.prior.velocity_m_s.powi(2));
            set(BIAS + i, BIAS + i, self.prior.bias_m_s2.powi(2));
        }
        for (j, c) in self.coefficients.iter().enumerate() {
            set(THETA + j, THETA + j, c.prior_sigma.powi(2));
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
