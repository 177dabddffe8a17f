//! Levels of the noise: which process of the mission is louder or quieter than the mission file says.
//!
//! The residuals' measured spectra Ŵ against `Σ + (k² − 1) P` for each named process P, by Whittle's likelihood
//! `Σ_b 2n_b (log det Σ_b + tr Σ_b⁻¹ Ŵ_b)`; k is the process's amplitude over the mission's.
//!
//! **Why not Σ band by band, where commands are regressors.** In the loop a command is the thrusters' noise w behind a strictly
//! causal filter, u = Uw. With a gain wrong by δ the residual is `(1 + δU) w`, and `∫ log|1 + δU|² df = 0` (Szegő, Jensen): a Σ that
//! is free in every band fits each δ as well as any other, and refining it walks away from the truth, by +5 to +12 % on clean
//! data. What tells δ is that w has the shape that the mission file gives it. So shapes stay, and levels alone are measured.

use nalgebra::{Cholesky, DMatrix};

use crate::sigma::NoiseModel;
use crate::spectra::{Plan, Spectra};

/// Amplitudes that are tried lie between its inverse and this.
const MOST: f64 = 20.0;

/// A level is taken over when `−2 log` of the likelihood falls by more, five σ.
const LEAST: f64 = 25.0;

/// Where the power of a band is more than so many times what the levels explain, and certainly so, Σ takes up the excess: something
/// that nobody models must not make others significant.
const EXCESS: f64 = 2.0;

/// A process with another amplitude.
#[derive(Clone, Debug, PartialEq)]
pub struct Level {
    /// Name of the process.
    pub process: String,
    /// Amplitude over the mission's.
    pub value: f64,
    /// Its σ.
    pub sigma: f64,
    /// By how much `−2 log` of the likelihood falls.
    pub delta_chi2: f64,
}

/// What is compared: per band its complex observations, the measured spectra and the modelled ones.
pub struct Levels<'a> {
    noise: &'a NoiseModel,
    plan: &'a Plan,
    observations: Vec<f64>,
    measured: &'a [DMatrix<f64>],
    modelled: Vec<DMatrix<f64>>,
}

impl<'a> Levels<'a> {
    /// `measured` are the residuals' one-sided cross-spectra per band, `weights` say how well they are known.
    #[must_use]
    pub fn new(noise: &'a NoiseModel, plan: &'a Plan, weights: &Spectra, measured: &'a [DMatrix<f64>]) -> Self {
        let modelled = plan.bands.iter().map(|b| noise.psd(plan.frequency_hz(*b))).collect();
        Self { noise, plan, observations: weights.observations(plan), measured, modelled }
    }

    /// The modelled spectra, per band, with the levels that were taken over.
    #[must_use]
    pub fn modelled(&self) -> &[DMatrix<f64>] {
        &self.modelled
    }

    fn process(&self, name: &str) -> Option<Vec<DMatrix<f64>>> {
        self.plan.bands.iter().map(|b| self.noise.process_psd(name, self.plan.frequency_hz(*b))).collect()
    }

    fn deviance(&self, process: &[DMatrix<f64>], amplitude: f64) -> f64 {
        let excess = amplitude * amplitude - 1.0;
        let mut sum = 0.0;
        for (((sigma, p), w), n) in self.modelled.iter().zip(process).zip(self.measured).zip(&self.observations) {
            let Some(l) = Cholesky::new(sigma + p * excess) else { return f64::INFINITY };
            sum += 2.0 * n * (2.0 * l.l().diagonal().map(f64::ln).sum() + l.solve(w).trace());
        }
        sum
    }

    /// The amplitude of a process that fits best; `None` where the channels do not have it.
    #[must_use]
    pub fn level(&self, name: &str) -> Option<Level> {
        let process = self.process(name)?;
        let at = |log: f64| self.deviance(&process, log.exp());
        // The likelihood of one level has one minimum.
        let (mut a, mut b) = (-MOST.ln(), MOST.ln());
        for _ in 0..40 {
            let (c, d) = (b - 0.618_034 * (b - a), a + 0.618_034 * (b - a));
            if at(c) < at(d) { b = d } else { a = c }
        }
        let log = 0.5 * (a + b);
        let step = 1e-2;
        let curvature = (at(log + step) - 2.0 * at(log) + at(log - step)) / (step * step);
        // Half the curvature of −2 log L is the information.
        let sigma = log.exp() * (0.5 * curvature).max(f64::MIN_POSITIVE).sqrt().recip();
        Some(Level { process: name.to_owned(), value: log.exp(), sigma, delta_chi2: at(0.0) - at(log) })
    }

    /// Takes over every level that is plainly another, the plainest first, until none is.
    pub fn fit(&mut self) {
        let names: Vec<String> = self.noise.process_names().map(str::to_owned).collect();
        for _ in 0..2 * names.len() {
            let levels = names.iter().filter_map(|name| self.level(name));
            let Some(best) = levels.max_by(|a, b| a.delta_chi2.total_cmp(&b.delta_chi2)) else { return };
            if best.delta_chi2 < LEAST || (best.value - 1.0).abs() < 1e-3 {
                return;
            }
            self.take(&best);
        }
    }

    /// `Σ⁻¹` per band, with the excess of single channels taken up.
    #[must_use]
    pub fn inverses(&self) -> Vec<DMatrix<f64>> {
        let bands = self.modelled.iter().zip(self.measured).zip(&self.observations);
        bands
            .map(|((sigma, w), n)| {
                let louder = |c: usize| {
                    let ratio = w[(c, c)] / sigma[(c, c)];
                    let certain = 1.0 + 5.0 / n.max(1.0).sqrt();
                    if ratio > EXCESS.max(certain) { ratio.sqrt() } else { 1.0 }
                };
                let scale: Vec<f64> = (0..sigma.nrows()).map(louder).collect();
                let wide = DMatrix::from_fn(sigma.nrows(), sigma.ncols(), |i, j| sigma[(i, j)] * scale[i] * scale[j]);
                Cholesky::new(wide).map_or_else(|| DMatrix::zeros(sigma.nrows(), sigma.ncols()), |c| c.inverse())
            })
            .collect()
    }

    /// Takes a level over into what is modelled.
    pub fn take(&mut self, level: &Level) {
        let Some(process) = self.process(&level.process) else { return };
        let excess = level.value * level.value - 1.0;
        self.modelled.iter_mut().zip(&process).for_each(|(sigma, p)| *sigma += p * excess);
    }
}
