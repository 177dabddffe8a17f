//! Levels of the noise: which declared process is louder or quieter than its declaration says.
//!
//! The residuals' measured spectra Ŵ against `Σ + (k² − 1) P` for each named component P, by Whittle's likelihood
//! `Σ_b 2n_b (log det Σ_b + tr Σ_b⁻¹ Ŵ_b)`; k is the component's amplitude over the declared one.
//!
//! **Why not Σ band by band, where commands are regressors.** In the loop a command is the thrusters' noise w behind a
//! strictly causal filter, u = Uw. With a gain wrong by δ the residual is `(1 + δU) w`, and `∫ log|1 + δU|² df = 0`
//! (Szegő, Jensen): a Σ that is free in every band fits each δ as well as any other, and refining it walks away from
//! the truth, by +5 to +12 % on clean data. What tells δ is that w has the declared shape. So shapes stay, and levels
//! alone are measured.

use std::collections::BTreeMap;
use std::ops::Range;

use dragfree_schema::Settings;
use nalgebra::{Cholesky, DMatrix};

use crate::colour::{Colour, ColourPower};
use crate::sigma::NoiseModel;
use crate::spectra::{Plan, Spectra};
use crate::verdict::chi2_per_dof_at;

/// Amplitudes that are tried lie between its inverse and this.
const MOST: f64 = 20.0;

/// Most sweeps of a joint fit over its levels, and the largest step of a logarithm at which it has converged.
const JOINT_SWEEPS: usize = 30;
const JOINT_STEP: f64 = 1e-4;

/// A process with another amplitude.
#[derive(Clone, Debug, PartialEq)]
pub struct Level {
    /// Name of the process.
    pub process: String,
    /// Amplitude over the declared one.
    pub value: f64,
    /// Its σ.
    pub sigma: f64,
    /// By how much `−2 log` of the likelihood falls.
    pub delta_chi2: f64,
}

/// A direction of the whitened channels in which a process has less than this part of the power changes with no level.
const NEGLIGIBLE: f64 = 1e-9;

/// A direction of the whitened channels in a band.
struct Mode {
    /// Twice the complex observations.
    weight: f64,
    /// Part of the modelled power that is the process's.
    lambda: f64,
    /// Measured over modelled power.
    power: f64,
}

/// A band in coordinates in which the modelled noise is white, `Σ = L Lᵀ`.
struct Whitened {
    band: usize,
    /// Twice the complex observations.
    weight: f64,
    /// `L⁻¹`.
    inverse_factor: DMatrix<f64>,
    /// `L⁻¹ Ŵ L⁻ᵀ`.
    power: DMatrix<f64>,
}

/// `−2 log` of the likelihood up to a constant, with the process's power more by `excess`; infinite where no power is
/// left.
fn deviance(modes: &[Mode], excess: f64) -> f64 {
    let of = |m: &Mode| {
        let power = 1.0 + excess * m.lambda;
        if power > 0.0 { m.weight * (power.ln() + m.power / power) } else { f64::INFINITY }
    };
    modes.iter().map(of).sum()
}

/// Ratio of the ends of a group of bands.
const GROUP: f64 = 2.154_434_690_031_884;

/// Ratio of power from which Σ takes up an excess over `n` complex observations: what nobody models must not make other
/// things significant.
fn absorbed_excess(settings: &Settings, n: f64) -> f64 {
    settings.absorbed_excess_ratio.max(chi2_per_dof_at(2.0 * n.max(0.5), settings.absorbed_excess_sigmas))
}

/// The inverse, or nothing known where there is none.
fn inverted(sigma: &DMatrix<f64>) -> DMatrix<f64> {
    let nothing = || DMatrix::zeros(sigma.nrows(), sigma.ncols());
    Cholesky::new(sigma.clone()).map_or_else(nothing, |c| c.inverse())
}

/// What is compared: per band its complex observations, the measured spectra and the modelled ones.
pub struct Levels<'a> {
    /// Components by name, per band, at the declared levels.
    processes: BTreeMap<&'a str, Vec<DMatrix<f64>>>,
    /// Middle of each band, Hz.
    hz: Vec<f64>,
    observations: Vec<f64>,
    /// Bands below those of ordinary segments, which are in no group.
    slow_bands: usize,
    measured: &'a [DMatrix<f64>],
    modelled: Vec<DMatrix<f64>>,
    settings: &'a Settings,
}

impl<'a> Levels<'a> {
    /// `measured` are the residuals' one-sided cross-spectra per band, `weights` say how well they are known.
    pub fn new(
        noise: &'a NoiseModel,
        plan: &Plan,
        weights: &Spectra,
        measured: &'a [DMatrix<f64>],
        settings: &'a Settings,
    ) -> Self {
        let hz: Vec<f64> = plan.bands.iter().map(|b| plan.frequency_hz(*b)).collect();
        let process =
            |name: &'a str| Some((name, hz.iter().map(|f| noise.process_psd(name, *f)).collect::<Option<_>>()?));
        Self {
            processes: noise.process_names().filter_map(process).collect(),
            modelled: hz.iter().map(|f| noise.psd(*f)).collect(),
            observations: weights.observations(plan),
            slow_bands: plan.slow_bands,
            measured,
            hz,
            settings,
        }
    }

    /// The same where coefficients colour processes.
    pub fn coloured(mut self, plan: &Plan, colours: &[(&Colour, f64)]) -> Self {
        for (colour, coefficient) in colours {
            let Some(process) = self.processes.get_mut(colour.process.as_str()) else { continue };
            for ((p, sigma), band) in process.iter_mut().zip(&mut self.modelled).zip(&plan.bands) {
                let power = colour.power(*coefficient, plan, *band);
                *sigma += &*p * (power - 1.0);
                *p *= power;
            }
        }
        self
    }

    /// The modelled spectra, per band, with the levels that were taken over.
    pub fn modelled(&self) -> &[DMatrix<f64>] {
        &self.modelled
    }

    /// What the likelihood of a level needs. With `Σ = L Lᵀ` and `L⁻¹ P L⁻ᵀ = V Λ Vᵀ` it is
    /// `Σ_b 2n_b Σ_j (log(1 + eλ_j) + w_j/(1 + eλ_j))` up to a constant, where `e = k² − 1` and `w` is the diagonal of
    /// `Vᵀ L⁻¹ Ŵ L⁻ᵀ V`: one decomposition for every amplitude.
    fn modes(whitened: &[Whitened], process: &[DMatrix<f64>]) -> Vec<Mode> {
        let mut modes = Vec::new();
        for Whitened { band, weight, inverse_factor, power } in whitened {
            let eigen = (inverse_factor * &process[*band] * inverse_factor.transpose()).symmetric_eigen();
            for (lambda, v) in eigen.eigenvalues.iter().zip(eigen.eigenvectors.column_iter()) {
                if lambda.abs() > NEGLIGIBLE {
                    modes.push(Mode { weight: *weight, lambda: *lambda, power: v.dot(&(power * v)) });
                }
            }
        }
        modes
    }

    /// Bands in which something was observed; `None` where Σ is singular.
    fn whitened(&self) -> Option<Vec<Whitened>> {
        let whitened = |band: usize| {
            let identity = DMatrix::identity(self.modelled[band].nrows(), self.modelled[band].nrows());
            let inverse_factor = Cholesky::new(self.modelled[band].clone())?.l().solve_lower_triangular(&identity)?;
            let power = &inverse_factor * &self.measured[band] * inverse_factor.transpose();
            Some(Whitened { band, weight: 2.0 * self.observations[band], inverse_factor, power })
        };
        (0..self.modelled.len()).filter(|band| self.observations[*band] > 0.0).map(whitened).collect()
    }

    /// The amplitude of a process that fits best; `None` where the channels do not have it.
    pub fn level(&self, name: &str) -> Option<Level> {
        self.level_in(&self.whitened()?, name)
    }

    fn level_in(&self, whitened: &[Whitened], name: &str) -> Option<Level> {
        let modes = Self::modes(whitened, self.processes.get(name)?);
        let at = |log: f64| deviance(&modes, (2.0 * log).exp() - 1.0);
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
        let names: Vec<&str> = self.processes.keys().copied().collect();
        for _ in 0..2 * names.len() {
            let Some(whitened) = self.whitened() else { return };
            let levels = names.iter().filter_map(|name| self.level_in(&whitened, name));
            let Some(best) = levels.max_by(|a, b| a.delta_chi2.total_cmp(&b.delta_chi2)) else { return };
            if best.delta_chi2 < self.settings.level_delta_chi2 || (best.value - 1.0).abs() < 1e-3 {
                return;
            }
            self.take(&best);
        }
    }

    /// The amplitudes of some processes that fit best together, over the declared ones, and takes them over. Their σ
    /// are those of the inverse information, `4 Σ n tr(Σ⁻¹P_l Σ⁻¹P_m)` for logarithms of amplitudes. Processes that the
    /// channels do not have are left out.
    pub fn fit_jointly(&mut self, names: &[&str]) -> Vec<Level> {
        let there: Vec<&'a str> = self.processes.keys().copied().filter(|name| names.contains(name)).collect();
        let mut amplitudes = vec![1.0; there.len()];
        let mut delta_chi2 = vec![0.0; there.len()];
        for _ in 0..JOINT_SWEEPS {
            let mut largest = 0.0_f64;
            for (i, name) in there.iter().enumerate() {
                let Some(level) = self.level(name) else { continue };
                self.take(&level);
                // The next sweep is relative to this level.
                let power = level.value * level.value;
                self.processes.get_mut(name).into_iter().flatten().for_each(|p| *p *= power);
                amplitudes[i] *= level.value;
                delta_chi2[i] += level.delta_chi2;
                largest = largest.max(level.value.ln().abs());
            }
            if largest < JOINT_STEP {
                break;
            }
        }
        let covariance = self.information(&there).try_inverse();
        let sigma = |i: usize| covariance.as_ref().map_or(f64::INFINITY, |c| c[(i, i)].max(0.0).sqrt());
        let level = |(i, name): (usize, &&str)| Level {
            process: (*name).to_owned(),
            value: amplitudes[i],
            sigma: amplitudes[i] * sigma(i),
            delta_chi2: delta_chi2[i],
        };
        there.iter().enumerate().map(level).collect()
    }

    /// Fisher's information on the logarithms of amplitudes.
    fn information(&self, names: &[&str]) -> DMatrix<f64> {
        let mut sum = DMatrix::zeros(names.len(), names.len());
        for (b, sigma) in self.modelled.iter().enumerate().filter(|(b, _)| self.observations[*b] > 0.0) {
            let inverse = inverted(sigma);
            let parts: Vec<DMatrix<f64>> = names.iter().map(|name| &inverse * &self.processes[name][b]).collect();
            for (i, a) in parts.iter().enumerate() {
                for (j, b_part) in parts.iter().enumerate() {
                    sum[(i, j)] += 4.0 * self.observations[b] * a.dot(&b_part.transpose());
                }
            }
        }
        sum
    }

    /// Ordinary bands in groups of a third of a decade.
    fn groups(&self) -> Vec<Range<usize>> {
        let mut groups = Vec::new();
        let mut first = self.slow_bands;
        while first < self.hz.len() {
            let end = first + self.hz[first..].iter().take_while(|f| **f < self.hz[first] * GROUP).count();
            groups.push(first..end);
            first = end;
        }
        groups
    }

    /// Measured over modelled power in each channel, over some bands; and the complex observations in them. `partial`
    /// is what is left of a channel when all others are known, `(Σ⁻¹ Ŵ Σ⁻¹)_cc/(Σ⁻¹)_cc`: what acts on one test mass
    /// alone shows there, a million times below the noise of the thrusters that moves all of them.
    fn power(&self, bands: Range<usize>, inverses: &[DMatrix<f64>], partial: bool) -> (Vec<f64>, f64) {
        let n: f64 = self.observations[bands.clone()].iter().sum();
        let channels = self.modelled.first().map_or(0, DMatrix::nrows);
        let mut sum = vec![0.0; channels];
        for b in bands {
            let (w, inverse) = (&self.measured[b], &inverses[b]);
            let whitened = if partial { inverse * w * inverse } else { w.clone() };
            for (c, sum) in sum.iter_mut().enumerate() {
                let expected = if partial { inverse[(c, c)] } else { self.modelled[b][(c, c)] };
                *sum += self.observations[b] * if expected > 0.0 { whitened[(c, c)] / expected } else { 0.0 };
            }
        }
        (sum.into_iter().map(|s| s / n.max(f64::MIN_POSITIVE)).collect(), n)
    }

    /// Excesses: the bands of each group, its complex observations, and the ratios of power in each channel, the larger
    /// of the plain and the partial one.
    pub fn excesses(&self) -> Vec<(Range<usize>, f64, Vec<f64>)> {
        let inverses: Vec<DMatrix<f64>> = self.modelled.iter().map(inverted).collect();
        let of = |bands: Range<usize>| {
            let (plain, n) = self.power(bands.clone(), &inverses, false);
            let (partial, _) = self.power(bands.clone(), &inverses, true);
            (bands, n, plain.into_iter().zip(partial).map(|(a, b)| a.max(b)).collect())
        };
        self.groups().into_iter().map(of).collect()
    }

    /// `Σ⁻¹` per band, with the excess of single channels taken up.
    pub fn inverses(&self) -> Vec<DMatrix<f64>> {
        let bands = self.modelled.iter().zip(self.measured).zip(&self.observations);
        let inverses: Vec<DMatrix<f64>> = bands
            .map(|((sigma, w), n)| {
                let louder = |c: usize| {
                    let ratio = w[(c, c)] / sigma[(c, c)];
                    if ratio > absorbed_excess(self.settings, *n) { ratio.sqrt() } else { 1.0 }
                };
                let scale: Vec<f64> = (0..sigma.nrows()).map(louder).collect();
                inverted(&DMatrix::from_fn(sigma.nrows(), sigma.ncols(), |i, j| sigma[(i, j)] * scale[i] * scale[j]))
            })
            .collect();
        self.less_in_channels(inverses, |_| true, |n| absorbed_excess(self.settings, n))
    }

    /// Inverses of Σ with what a group of bands has in one channel beyond `least` of its observations taken up.
    fn less_in_channels(
        &self,
        mut inverses: Vec<DMatrix<f64>>,
        here: impl Fn(usize) -> bool,
        least: impl Fn(f64) -> f64,
    ) -> Vec<DMatrix<f64>> {
        for group in self.groups().into_iter().filter(|group| group.clone().any(&here)) {
            // What acts on one channel is seen in the others too: the loudest first.
            for _ in 0..self.modelled.first().map_or(0, DMatrix::nrows) {
                let (ratios, n) = self.power(group.clone(), &inverses, true);
                let Some((c, ratio)) = ratios.into_iter().enumerate().max_by(|a, b| a.1.total_cmp(&b.1)) else { break };
                if ratio <= least(n) * (1.0 + 1e-9) {
                    break;
                }
                // Another (ratio − 1)/(Σ⁻¹)_cc of power in this channel; the inverse by Sherman and Morrison.
                for inverse in &mut inverses[group.clone()] {
                    let column = inverse.column(c).into_owned();
                    if column[c] > 0.0 {
                        inverse.ger(-(ratio - 1.0) / (ratio * column[c]), &column, &column, 1.0);
                    }
                }
            }
        }
        inverses
    }

    /// `Σ⁻¹` per band as it is modelled, whatever the excess.
    pub fn plain_inverses(&self) -> Vec<DMatrix<f64>> {
        self.modelled.iter().map(inverted).collect()
    }

    /// The bands in which [`Self::inverses`] take up an excess, and the real observations in them, two for each complex
    /// one.
    pub fn excess_bands(&self) -> (Vec<bool>, f64) {
        let pairs = self.inverses().into_iter().zip(self.plain_inverses());
        let loud: Vec<bool> = pairs.map(|(full, plain)| (full - &plain).norm() > 1e-9 * plain.norm()).collect();
        let observations = loud.iter().zip(&self.observations).filter(|(loud, _)| **loud).map(|(_, n)| 2.0 * n).sum();
        (loud, observations)
    }

    /// `−2 log` of Whittle's likelihood of other residuals of the same data, up to a constant: under these levels, and
    /// in some bands with all power taken up that a channel has of its own beyond what is modelled, so that it is
    /// steady in the residuals.
    pub fn deviance(&self, measured: &[DMatrix<f64>], bands: &[bool]) -> f64 {
        let (processes, hz) = (BTreeMap::new(), self.hz.clone());
        let (observations, modelled) = (self.observations.clone(), self.modelled.clone());
        let Self { slow_bands, settings, .. } = *self;
        let own = Levels { processes, hz, observations, slow_bands, measured, modelled, settings };
        let of = |((inverse, w), n): ((DMatrix<f64>, &DMatrix<f64>), &f64)| {
            let power = inverse.dot(w);
            let log_det = Cholesky::new(inverse).map_or(0.0, |c| 2.0 * c.l().diagonal().map(f64::ln).sum());
            2.0 * n * (power - log_det)
        };
        // Single channels made louder as a whole, which scales what they share, would bury what little is left when it
        // cancels.
        let inverses = own.less_in_channels(self.plain_inverses(), |b| bands[b], |_| 1.0);
        inverses.into_iter().zip(measured).zip(&self.observations).filter(|(_, n)| **n > 0.0).map(of).sum()
    }

    /// Channels in which a process has power.
    pub fn channels_of(&self, process: &str) -> Vec<usize> {
        let bands = self.processes.get(process).map_or(&[][..], Vec::as_slice);
        let channels = self.modelled.first().map_or(0, DMatrix::nrows);
        (0..channels).filter(|c| bands.iter().any(|p| p[(*c, *c)] > 0.0)).collect()
    }

    /// Takes a level over into what is modelled.
    pub fn take(&mut self, level: &Level) {
        let Some(process) = self.processes.get(level.process.as_str()) else { return };
        let excess = level.value * level.value - 1.0;
        self.modelled.iter_mut().zip(process).for_each(|(sigma, p)| *sigma += p * excess);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use dragfree_schema::{NoiseProcess, NoiseResponse, NoiseShape};

    const CHANNELS: [&str; 4] = ["a.x", "a.y", "b.x", "b.y"];

    /// Two bodies that look 30° to either side and are shaken by one force, each axis with a readout of its own: x
    /// quiet, y loud.
    fn noise() -> NoiseModel {
        let (cos, sin) = (0.75_f64.sqrt(), 0.5);
        let gains = [[cos, sin], [-sin, cos], [cos, -sin], [sin, cos]].map(|row| row.map(|g| g / 1500.0).to_vec());
        let force = NoiseProcess {
            name: "force".to_owned(),
            spectrum: Some(NoiseShape::white(1e-7)),
            components: vec!["force:x".to_owned(), "force:y".to_owned()],
            enters: CHANNELS.map(str::to_owned).into_iter().zip(gains).collect(),
            ..NoiseProcess::default()
        };
        let own = |channel: &str, asd: f64, response: NoiseResponse| NoiseProcess {
            name: format!("{response:?}:{channel}"),
            spectrum: Some(NoiseShape::white(asd)),
            components: vec![format!("{response:?}:{channel}")],
            response,
            enters: [(channel.to_owned(), vec![1.0])].into(),
            ..NoiseProcess::default()
        };
        let readouts = CHANNELS.iter().zip([1.4e-12, 1.8e-9].into_iter().cycle());
        let mut declared = vec![force];
        declared.extend(readouts.map(|(channel, asd)| own(channel, asd, NoiseResponse::Differenced)));
        declared.extend(
            CHANNELS.iter().map(|c| NoiseProcess { components: Vec::new(), ..own(c, 3e-15, NoiseResponse::Held) }),
        );
        NoiseModel::new(&declared, &CHANNELS, 0.1).unwrap()
    }

    fn weights(plan: &Plan, segments: usize) -> Spectra {
        let mut weights = Spectra::zero(plan.bands.len(), 0);
        (0..segments).for_each(|k| weights.count_segment(plan, 0, k > 0));
        weights
    }

    /// Measured spectra that are exactly those of one process at 1.7 times its level give that level, no other, and a σ
    /// of `1/√(4 Σ n tr (Σ⁻¹P)²)` by Fisher's information, which is `4k² Σ n tr (Σ⁻¹ P)²` for an amplitude k where Σ
    /// has the process.
    #[test]
    fn a_level_is_measured_with_the_error_that_fisher_gives() {
        let (noise, settings) = (noise(), Settings::default());
        let plan = Plan::new(4096, 10.0);
        let weights = weights(&plan, 20);
        let hz: Vec<f64> = plan.bands.iter().map(|b| plan.frequency_hz(*b)).collect();
        let name = "Differenced:a.y";
        let of = |f: &f64| noise.process_psd(name, *f).unwrap();
        let truth: Vec<DMatrix<f64>> = hz.iter().map(|f| noise.psd(*f) + of(f) * (1.7_f64.powi(2) - 1.0)).collect();
        let mut levels = Levels::new(&noise, &plan, &weights, &truth, &settings);
        let level = levels.level(name).unwrap();
        assert!((level.value / 1.7 - 1.0).abs() < 1e-6, "{level:?}");
        let information: f64 = (hz.iter().zip(&truth).zip(weights.observations(&plan)))
            .map(|((f, sigma), n)| {
                let part = inverted(sigma) * of(f);
                4.0 * 1.7_f64.powi(2) * n * (&part * &part).trace()
            })
            .sum();
        // The curvature is taken over a step of one per cent.
        assert!(
            (level.sigma * information.sqrt() - 1.0).abs() < 1e-3,
            "{} {}",
            level.sigma,
            information.sqrt().recip()
        );
        levels.fit();
        assert!(levels.modelled().iter().zip(&truth).all(|(a, b)| (a - b).norm() < 1e-6 * b.norm()));
    }

    /// Three levels at once, one above and one below the declared one: each is found, with a σ that is no smaller than
    /// that of the level alone; what is asked for and not there is left out.
    #[test]
    fn levels_are_fitted_jointly() {
        let (noise, settings) = (noise(), Settings::default());
        let plan = Plan::new(4096, 10.0);
        let weights = weights(&plan, 20);
        let hz: Vec<f64> = plan.bands.iter().map(|b| plan.frequency_hz(*b)).collect();
        let truth = [("force:x", 1.5), ("force:y", 0.8), ("Differenced:a.y", 2.0)];
        let of = |f: &f64| {
            let more = |(name, k): &(&str, f64)| noise.process_psd(name, *f).unwrap() * (k * k - 1.0);
            truth.iter().fold(noise.psd(*f), |sum, level| sum + more(level))
        };
        let measured: Vec<DMatrix<f64>> = hz.iter().map(of).collect();
        let mut levels = Levels::new(&noise, &plan, &weights, &measured, &settings);
        let found = levels.fit_jointly(&["nothing", "force:x", "force:y", "Differenced:a.y"]);
        assert_eq!(found.len(), 3);
        for (name, k) in truth {
            let level = found.iter().find(|l| l.process == name).unwrap();
            assert!((level.value / k - 1.0).abs() < 1e-4, "{level:?}");
            // Around the solution a level of its own is one, with the σ of the others known.
            let alone = levels.level(name).unwrap();
            assert!((alone.value - 1.0).abs() < 1e-4 && level.sigma / k > 0.99 * alone.sigma, "{level:?} {alone:?}");
        }
    }

    /// A process that a coefficient colours is what is measured, at its own level; without the colour its level would
    /// be another.
    #[test]
    fn a_coloured_process_has_its_own_level() {
        let (noise, settings) = (noise(), Settings::default());
        let plan = Plan::new(16_384, 10.0);
        let weights = weights(&plan, 20);
        let name = "force:y";
        let omega = std::f64::consts::TAU * 0.06;
        let colour = Colour {
            process: name.to_owned(),
            numerator: vec![0.0, 0.0, 1.0],
            denominator: vec![omega * omega, 0.04 * omega, 1.0],
        };
        let measured: Vec<DMatrix<f64>> = (plan.bands.iter())
            .map(|b| {
                let hz = plan.frequency_hz(*b);
                noise.psd(hz) + noise.process_psd(name, hz).unwrap() * (colour.power(0.05, &plan, *b) - 1.0)
            })
            .collect();
        let levels = Levels::new(&noise, &plan, &weights, &measured, &settings).coloured(&plan, &[(&colour, 0.05)]);
        assert!(levels.modelled().iter().zip(&measured).all(|(a, b)| (a - b).norm() < 1e-9 * b.norm()));
        assert!((levels.level(name).unwrap().value - 1.0).abs() < 1e-6);
        let plain = Levels::new(&noise, &plan, &weights, &measured, &settings).level(name).unwrap();
        assert!(plain.value > 1.02 && plain.delta_chi2 > settings.level_delta_chi2, "{plain:?}");
    }

    /// A force on one test mass far below the thrusters' noise, invisible in its channel's power, is taken up where the
    /// others cancel the thrusters, exactly where it doubles what is left there in a whole group of bands. Without it
    /// Σ⁻¹ is that of the declared noise.
    #[test]
    fn an_excess_below_the_thrusters_is_taken_up() {
        let (noise, settings) = (noise(), Settings::default());
        let plan = Plan::new(16_384, 10.0);
        let weights = weights(&plan, 20);
        let sigma: Vec<DMatrix<f64>> = plan.bands.iter().map(|b| noise.psd(plan.frequency_hz(*b))).collect();
        let levels = Levels::new(&noise, &plan, &weights, &sigma, &settings);
        let (clean, group) = (levels.inverses(), levels.groups().swap_remove(0));
        assert!(clean.iter().zip(&sigma).all(|(a, b)| (a * b - DMatrix::identity(4, 4)).norm() < 1e-3));
        let mut loud = sigma.clone();
        group.clone().for_each(|b| loud[b][(2, 2)] += 2.0 / clean[b][(2, 2)]);
        assert!(group.clone().all(|b| loud[b][(2, 2)] < 1.01 * sigma[b][(2, 2)]));
        let levels = Levels::new(&noise, &plan, &weights, &loud, &settings);
        let (_, _, ratios) = levels.excesses().swap_remove(0);
        assert!((ratios[2] - 3.0).abs() < 1e-3, "{ratios:?}");
        for (b, (own, exact)) in levels.inverses().iter().zip(loud.iter().map(inverted)).enumerate() {
            assert!((own - &exact).norm() < 1e-3 * exact.norm(), "{b}");
        }
        let (bands, observations) = levels.excess_bands();
        let n: f64 = levels.observations[group.clone()].iter().sum();
        assert!((observations - 2.0 * n).abs() < 1e-9 * n && (0..bands.len()).all(|b| bands[b] == group.contains(&b)));
        // Power that is three times as loud in one direction is worth 2n (log 3) less when it is explained.
        let fall = levels.deviance(&loud, &bands) - levels.deviance(&sigma, &bands);
        assert!((fall / (2.0 * n * 3.0_f64.ln()) - 1.0).abs() < 1e-2, "{fall}");
    }
}
