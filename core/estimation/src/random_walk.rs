//! Random walks of acceleration beside the declared noise: slow forces that nobody models.
//!
//! An unknown slow force looks like whatever slow series is nearest to it. Beside a random walk of the right power such
//! a series explains no more than chance. The power is that of the highest likelihood of the residuals' spectra
//! (Whittle): with `Σ_b + Σ_k q_k f_b⁻² g_k g_kᵀ` the modelled spectra in band b and Ŵ_b the measured ones, the
//! iteration
//!
//! ```text
//! q_k ← q_k √( Σ_b n_b f_b⁻² g_kᵀ Σ⁻¹ Ŵ Σ⁻¹ g_k / Σ_b n_b f_b⁻² g_kᵀ Σ⁻¹ g_k )
//! ```
//!
//! raises the likelihood in every step (majorisation of the Itakura–Saito divergence: Févotte and Idier, Neural
//! Computation 23, 2421, 2011) and keeps every power positive. A random walk is there when the likelihood says so:
//! beside one that is not, slow regressors would have less information than they have.

use dragfree_schema::{NoiseProcess, NoiseResponse};
use nalgebra::{Cholesky, DMatrix, DVector};

/// Steps of the iteration: a power that is there has converged to a small part of its own uncertainty.
const STEPS: usize = 100;

/// Unit vectors along which declared forces enter the channels, no two of them parallel, each with the name of the
/// first component that does.
pub fn held_directions<S: AsRef<str>>(declared: &[NoiseProcess], channels: &[S]) -> Vec<(String, DVector<f64>)> {
    let mut directions: Vec<(String, DVector<f64>)> = Vec::new();
    for process in declared.iter().filter(|p| p.response == NoiseResponse::Held) {
        for k in 0..process.size() {
            let gain = |c: &S| process.enters.get(c.as_ref()).map_or(0.0, |gains| gains[k]);
            let direction = DVector::from_iterator(channels.len(), channels.iter().map(gain));
            let Some(direction) = direction.try_normalize(f64::MIN_POSITIVE) else { continue };
            let parallel = |(_, other): &(String, DVector<f64>)| direction.dot(other).abs() > 1.0 - 1e-9;
            if !directions.iter().any(parallel) {
                directions.push((process.components.get(k).unwrap_or(&process.name).clone(), direction));
            }
        }
    }
    directions
}

/// One-sided cross-spectra of the channels in a band.
#[derive(Clone, Copy)]
pub struct BandSpectra<'a> {
    /// Middle of the band, Hz.
    pub hz: f64,
    /// Complex observations.
    pub observations: f64,
    /// Of the noise.
    pub modelled: &'a DMatrix<f64>,
    /// Of the residuals.
    pub measured: &'a DMatrix<f64>,
}

impl BandSpectra<'_> {
    /// The modelled spectra with random walks of `powers` at 1 Hz along `directions`.
    pub fn with(&self, powers: &[f64], directions: &[&DVector<f64>]) -> DMatrix<f64> {
        let mut total = self.modelled.clone();
        for (q, g) in powers.iter().zip(directions) {
            total.ger(q / self.hz.powi(2), g, g, 1.0);
        }
        total
    }
}

/// Powers at 1 Hz of random walks along `directions`, zero for those without which `−2 log` of the likelihood rises by
/// less than `least`: the one that explains most is added until none explains enough.
pub fn significant_powers(bands: &[BandSpectra<'_>], directions: &[&DVector<f64>], least: f64) -> Vec<f64> {
    let mut chosen: Vec<usize> = Vec::new();
    let mut found = (Vec::new(), deviance(bands, &[], &[]));
    while chosen.len() < directions.len() {
        let with = |k: usize| {
            let all: Vec<&DVector<f64>> = chosen.iter().chain([&k]).map(|k| directions[*k]).collect();
            let powers = powers(bands, &all);
            let deviance = deviance(bands, &powers, &all);
            (k, powers, deviance)
        };
        let left = (0..directions.len()).filter(|k| !chosen.contains(k));
        let best = left.map(with).min_by(|a, b| a.2.total_cmp(&b.2));
        let Some((k, powers, deviance)) = best.filter(|best| found.1 - best.2 > least) else { break };
        chosen.push(k);
        found = (powers, deviance);
    }
    let mut powers = vec![0.0; directions.len()];
    chosen.iter().zip(found.0).for_each(|(k, q)| powers[*k] = q);
    powers
}

/// `−2 log` of Whittle's likelihood up to a constant; infinite where the modelled spectra are singular.
fn deviance(bands: &[BandSpectra<'_>], powers: &[f64], directions: &[&DVector<f64>]) -> f64 {
    let of = |band: &BandSpectra<'_>| {
        Cholesky::new(band.with(powers, directions)).map_or(f64::INFINITY, |factor| {
            let ln_det: f64 = factor.l().diagonal().iter().map(|x| 2.0 * x.ln()).sum();
            2.0 * band.observations * (ln_det + factor.solve(band.measured).trace())
        })
    };
    bands.iter().map(of).sum()
}

/// Powers at 1 Hz of random walks along `directions`, of the highest likelihood.
fn powers(bands: &[BandSpectra<'_>], directions: &[&DVector<f64>]) -> Vec<f64> {
    let Some(lowest) = bands.iter().min_by(|a, b| a.hz.total_cmp(&b.hz)) else { return vec![0.0; directions.len()] };
    let inverse = |m: DMatrix<f64>| Cholesky::new(m).map(|c| c.inverse());
    let Some(known) = inverse(lowest.modelled.clone()) else { return vec![0.0; directions.len()] };
    // As much as the modelled noise in the lowest band.
    let mut powers: Vec<f64> = directions.iter().map(|g| lowest.hz.powi(2) / g.dot(&(&known * *g))).collect();
    for _ in 0..STEPS {
        let (mut above, mut below) = (vec![0.0; powers.len()], vec![0.0; powers.len()]);
        for band in bands {
            let Some(inverse) = inverse(band.with(&powers, directions)) else { continue };
            for (k, g) in directions.iter().enumerate() {
                let along = &inverse * *g;
                let weight = band.observations / band.hz.powi(2);
                above[k] += weight * along.dot(&(band.measured * &along));
                below[k] += weight * g.dot(&along);
            }
        }
        for (q, (a, b)) in powers.iter_mut().zip(above.iter().zip(&below)) {
            *q *= if *b > 0.0 { (a / b).max(0.0).sqrt() } else { 0.0 };
        }
    }
    powers
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Where the measured spectra are the modelled ones with random walks of known powers, these come back; a direction
    /// without one has none.
    #[test]
    fn powers_of_exact_spectra_come_back() {
        let directions =
            [[1.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]].map(|g| DVector::from_row_slice(&g).normalize());
        let truth = [4e-4, 0.0, 9e-6];
        let modelled = DMatrix::from_row_slice(3, 3, &[2.0, 1.0, 0.0, 1.0, 2.0, 0.3, 0.0, 0.3, 1.0]);
        let hz: Vec<f64> = (1..30).map(|k| 1e-3 * f64::from(k)).collect();
        let measured: Vec<DMatrix<f64>> = hz
            .iter()
            .map(|f| {
                let walks = directions.iter().zip(truth).map(|(g, q)| g * g.transpose() * (q / (f * f)));
                walks.fold(modelled.clone(), |sum, walk| sum + walk)
            })
            .collect();
        let band = |(f, w): (&f64, _)| BandSpectra { hz: *f, observations: 5.0, modelled: &modelled, measured: w };
        let bands: Vec<BandSpectra<'_>> = hz.iter().zip(&measured).map(band).collect();
        let found = powers(&bands, &directions.each_ref());
        for (q, truth) in found.iter().zip(truth) {
            // Convergence at a bound is slow: what is not there is below a hundredth of the smallest that is.
            assert!((q - truth).abs() < 1e-2 * truth.max(9e-6), "{found:?}");
        }
        let significant = significant_powers(&bands, &directions.each_ref(), 25.0);
        assert!(significant[0] > 0.0 && significant[1] == 0.0 && significant[2] > 0.0, "{significant:?}");
        let fewer = significant_powers(&bands, &directions.each_ref(), f64::INFINITY);
        assert_eq!(fewer, [0.0; 3]);
    }
}
