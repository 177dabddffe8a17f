//! Declared noise as a linear system that white noise drives, one step per sample.
//!
//! A channel's sample is the mean of two samples of an acceleration plus the second difference of a readout, so noise
//! with a white spectrum makes a moving average of order two. Its state is kept in observer form: `s_1` is what the
//! past contributes to the next sample, `s_2` to the one after it. The matrices of transition and of output are then
//! the same whatever the levels of the noise and the coefficients, which change the covariance of the driving noise
//! alone:
//!
//! ```text
//! s_1⁺ = s_2 + ξ_1,   s_2⁺ = ξ_2,   r⁺ = λ r + ξ_r,   z = s_1 + r + η
//! ```
//!
//! Coloured terms of the spectra, `(corner/f)^p`, are sums of white noise repeated `p/2` times: the states r. Below
//! a microhertz they are flat.

use std::collections::BTreeMap;
use std::f64::consts::TAU;

use dragfree_schema::{Colour, NoiseProcess, NoiseResponse, NoiseTerm};
use nalgebra::DMatrix;

/// The frequency below which a coloured term no longer rises, Hz: what is slower than ten days is a constant here.
const LEAST_HZ: f64 = 1e-6;

/// Why declared noise makes no linear system.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{0}")]
pub struct NoNoise(pub String);

/// Where the noise is taken: everything on which it depends.
#[derive(Clone, Debug, PartialEq)]
pub struct NoisePoint {
    /// Amplitudes of the components of [`NoiseStates::components`] over the declared ones.
    pub levels: Vec<f64>,
    /// Channels × channels: how much of the unknown acceleration in a channel (column) the model's regressors leave out
    /// in a channel (row).
    pub unpredicted: DMatrix<f64>,
    /// The same of its backward difference over the sampling interval.
    pub unpredicted_slope: DMatrix<f64>,
    /// Coefficients of the filters. One that the system has no states for acts on nothing: it is taken for zero.
    pub filtered: Vec<f64>,
}

/// An effect that filters a component of noise: the channels see `1 + c H` times what they would see.
#[derive(Clone)]
struct Filter {
    component: String,
    /// Response in powers of the delay, with the mean of two samples: numerator and denominator, `d_0 = 1`.
    numerator: Vec<f64>,
    denominator: Vec<f64>,
    /// Its states among all; none where its coefficient is zero.
    first: Option<usize>,
}

#[derive(Clone)]
struct Process {
    declared: NoiseProcess,
    enters: DMatrix<f64>,
    covariance: DMatrix<f64>,
    /// Index of the level of each component.
    levels: Vec<Option<usize>>,
}

/// A sum of `order` repeated summations of white noise, in some of the channels.
#[derive(Clone)]
struct Slow {
    order: usize,
    /// First state of each channel that has it; the last of `order` states is seen.
    first: Vec<Option<usize>>,
}

/// The system: transition and output, and the covariance of the driving noise at any point.
#[derive(Clone)]
pub struct NoiseStates {
    /// Names of the components whose levels may differ.
    pub components: Vec<String>,
    /// `F`, states × states.
    pub transition: DMatrix<f64>,
    /// `C`, channels × states.
    pub output: DMatrix<f64>,
    /// Unit of each channel: the channels are divided by it before anything else.
    pub unit: Vec<f64>,
    dt_s: f64,
    processes: Vec<Process>,
    slow: Vec<Slow>,
    filters: Vec<Filter>,
}

/// A channel's sample is the mean of two of an acceleration held over samples.
const MEAN: [f64; 3] = [0.5, 0.5, 0.0];

impl NoiseStates {
    /// The system of `channels`, sampled every `dt_s`, driven by `declared` noise, with effects that filter it.
    /// `filtered` are the coefficients of these: a filter at zero has no states here, see [`NoiseStates::extended`].
    ///
    /// # Errors
    /// [`NoNoise`]: a spectrum is unknown, a channel has no noise of its own, or an estimate takes part of it out.
    pub fn new(
        declared: &[NoiseProcess],
        channels: &[String],
        dt_s: f64,
        filters: &[Colour],
        filtered: &[f64],
    ) -> Result<Self, NoNoise> {
        let n = channels.len();
        let mut components: Vec<String> = Vec::new();
        let mut processes = Vec::new();
        for process in declared.iter().filter(|p| p.channels().any(|c| channels.iter().any(|own| own == c))) {
            process.check().map_err(|what| NoNoise(format!("process `{}`: {what}", process.name)))?;
            if process.spectrum.is_none() {
                return Err(NoNoise(format!("the spectrum of the noise `{}` is not declared", process.name)));
            }
            if process.estimate.is_some() {
                return Err(NoNoise(format!(
                    "the stage that declares `{}` replaces part of it by an estimate from later samples",
                    process.name
                )));
            }
            let size = process.size();
            let row = |i: usize| process.enters.get(&channels[i]);
            let enters = DMatrix::from_fn(n, size, |i, k| row(i).map_or(0.0, |gains| gains[k]));
            let covariance = process
                .covariance
                .as_ref()
                .map_or_else(|| DMatrix::identity(size, size), |rows| DMatrix::from_fn(size, size, |i, j| rows[i][j]));
            let mut level = |name: &String| {
                components.iter().position(|c| c == name).unwrap_or_else(|| {
                    components.push(name.clone());
                    components.len() - 1
                })
            };
            let levels = (0..size).map(|k| process.components.get(k).map(&mut level)).collect();
            processes.push(Process { declared: process.clone(), enters, covariance, levels });
        }
        let mut states = 2 * n;
        let mut slow: Vec<Slow> = Vec::new();
        for process in &processes {
            for (order, _) in process.terms().filter_map(|term| summations(process.declared.response, term, dt_s)) {
                let at = slow.iter().position(|s| s.order == order).unwrap_or_else(|| {
                    slow.push(Slow { order, first: vec![None; n] });
                    slow.len() - 1
                });
                for i in (0..n).filter(|i| process.enters.row(*i).amax() > 0.0) {
                    if slow[at].first[i].is_none() {
                        slow[at].first[i] = Some(states);
                        states += order;
                    }
                }
            }
        }
        let filters: Vec<Filter> = filters
            .iter()
            .zip(filtered)
            .map(|(colour, coefficient)| {
                let (numerator, denominator) = discrete(colour, dt_s);
                let first = (*coefficient != 0.0).then_some(states);
                states += first.map_or(0, |_| numerator.len() - 1);
                Filter { component: colour.process.clone(), numerator, denominator, first }
            })
            .collect();
        let mut all = Self {
            components,
            transition: DMatrix::zeros(states, states),
            output: DMatrix::zeros(n, states),
            unit: vec![1.0; n],
            dt_s,
            processes,
            slow,
            filters,
        };
        all.connect(n);
        let driving = all.driving(&all.declared_point());
        for i in 0..n {
            let variance = driving[(i, i)];
            if !(variance.is_finite() && variance > 0.0) {
                return Err(NoNoise(format!("no noise of {} is declared that is new in every sample", channels[i])));
            }
            all.unit[i] = variance.sqrt();
        }
        all.connect(n);
        Ok(all)
    }

    /// Fills the matrices of transition and output.
    fn connect(&mut self, n: usize) {
        let keep = (-TAU * LEAST_HZ * self.dt_s).exp();
        self.transition.fill(0.0);
        self.output.fill(0.0);
        for i in 0..n {
            self.output[(i, i)] = 1.0;
            self.transition[(i, n + i)] = 1.0;
        }
        for slow in &self.slow {
            for (i, first) in slow.first.iter().enumerate().filter_map(|(i, first)| Some((i, (*first)?))) {
                for k in first..first + slow.order {
                    self.transition[(k, k)] = keep;
                    if k > first {
                        self.transition[(k, k - 1)] = 1.0;
                    }
                }
                self.output[(i, first + slow.order - 1)] = 1.0;
            }
        }
        for (filter, first) in self.filters.iter().filter_map(|f| Some((f, f.first?))) {
            let order = filter.numerator.len() - 1;
            for k in 0..order {
                self.transition[(first + k, first)] -= filter.denominator.get(k + 1).unwrap_or(&0.0);
                if k + 1 < order {
                    self.transition[(first + k, first + k + 1)] += 1.0;
                }
            }
            if let Some((p, k)) = self.component(&filter.component) {
                for i in 0..n {
                    self.output[(i, first)] = self.processes[p].enters[(i, k)] / self.unit[i];
                }
            }
        }
    }

    /// The same system with the states of one more filter behind all others. At coefficient zero nothing drives them,
    /// so that what is predicted is the same; how it changes with the coefficient, see [`Predictor::change`], is not.
    ///
    /// [`Predictor::change`]: super::predictor::Predictor::change
    pub fn extended(&self, filter: usize) -> Self {
        let mut all = self.clone();
        let before = self.transition.nrows();
        if let Some(own) = all.filters.get_mut(filter).filter(|f| f.first.is_none()) {
            let states = before + own.numerator.len() - 1;
            own.first = Some(before);
            all.transition = DMatrix::zeros(states, states);
            all.output = DMatrix::zeros(self.channels(), states);
            all.connect(self.channels());
        }
        all
    }

    fn component(&self, name: &str) -> Option<(usize, usize)> {
        let of = |p: &Process| p.declared.components.iter().position(|c| c == name);
        self.processes.iter().enumerate().find_map(|(i, p)| Some((i, of(p)?)))
    }

    /// Place of each state among those that are needed to filter data: a channel sees only the sum of its slow states
    /// of all orders, and sums follow the same differences as the states at the same distance from the output. With R
    /// the matrix that sums, `R F = F' R` and `C = C' R`.
    pub fn merged(&self) -> Vec<usize> {
        let mut stands: Vec<usize> = (0..self.transition.nrows()).collect();
        for i in 0..self.channels() {
            let chains = || self.slow.iter().filter_map(|s| Some((s.order, s.first[i]?)));
            let Some((longest, whole)) = chains().max() else { continue };
            for (order, first) in chains() {
                (0..order).for_each(|k| stands[first + k] = whole + longest - order + k);
            }
        }
        let mut kept = stands.clone();
        kept.sort_unstable();
        kept.dedup();
        stands.iter().map(|s| kept.binary_search(s).unwrap_or(0)).collect()
    }

    /// Channels.
    pub fn channels(&self) -> usize {
        self.output.nrows()
    }

    /// The declared levels, without effects.
    pub fn declared_point(&self) -> NoisePoint {
        let n = self.channels();
        NoisePoint {
            levels: vec![1.0; self.components.len()],
            unpredicted: DMatrix::zeros(n, n),
            unpredicted_slope: DMatrix::zeros(n, n),
            filtered: vec![0.0; self.filters.len()],
        }
    }

    /// Covariance of the noise that drives a step: of what is new in the channels (first) and of what enters the
    /// states, in the units of the channels.
    pub fn driving(&self, point: &NoisePoint) -> DMatrix<f64> {
        let (n, states) = (self.channels(), self.transition.nrows());
        let mut total = DMatrix::zeros(n + states, n + states);
        let known = DMatrix::identity(n, n) + &point.unpredicted;
        for process in &self.processes {
            let mut amplitudes = process.covariance.clone();
            for (k, level) in process.levels.iter().enumerate().filter_map(|(k, level)| Some((k, (*level)?))) {
                amplitudes.row_mut(k).scale_mut(point.levels[level]);
                amplitudes.column_mut(k).scale_mut(point.levels[level]);
            }
            let held = process.declared.response == NoiseResponse::Held;
            let enters = if held { &known * &process.enters } else { process.enters.clone() };
            for term in process.terms() {
                // One-sided: white noise of variance v has the density 2 v Δt.
                let omega = TAU * term.corner_hz * self.dt_s;
                let variance = term.asd * term.asd * omega.powi(term.exponent.cast_signed()) / (2.0 * self.dt_s);
                let mut gain = DMatrix::zeros(n + states, enters.ncols());
                match summations(process.declared.response, term, self.dt_s) {
                    Some((order, per)) => {
                        let slow = self.slow.iter().find(|s| s.order == order);
                        for (i, first) in slow.into_iter().flat_map(|s| s.first.iter().enumerate()) {
                            let Some(first) = first else { continue };
                            let mut own = gain.row_mut(n + first);
                            own += enters.row(i) * (per / self.unit[i]);
                        }
                    }
                    None => {
                        for (lag, at) in average(process.declared.response, term, self.dt_s).into_iter().enumerate() {
                            for i in 0..n {
                                let mut own = gain.row_mut(lag * n + i);
                                own += enters.row(i) * (at / self.unit[i]);
                            }
                        }
                        if held {
                            self.add_slopes(&mut gain, &(&point.unpredicted_slope * &process.enters));
                            self.add_filters(&mut gain, process, point);
                        }
                    }
                }
                total += &gain * (&amplitudes * variance) * gain.transpose();
            }
        }
        total
    }

    /// The mean of two backward differences is the difference over two samples.
    fn add_slopes(&self, gain: &mut DMatrix<f64>, enters: &DMatrix<f64>) {
        let n = self.channels();
        for (lag, sign) in [(0, 0.5), (2, -0.5)] {
            for i in 0..n {
                let mut own = gain.row_mut(lag * n + i);
                own += enters.row(i) * (sign / self.dt_s / self.unit[i]);
            }
        }
    }

    fn add_filters(&self, gain: &mut DMatrix<f64>, process: &Process, point: &NoisePoint) {
        let n = self.channels();
        for (filter, coefficient) in self.filters.iter().zip(&point.filtered) {
            let Some(first) = filter.first else { continue };
            let Some(k) = process.declared.components.iter().position(|c| *c == filter.component) else { continue };
            for i in 0..n {
                gain[(i, k)] += coefficient * filter.numerator[0] * process.enters[(i, k)] / self.unit[i];
            }
            for j in 1..filter.numerator.len() {
                let denominator = filter.denominator.get(j).unwrap_or(&0.0);
                gain[(n + first + j - 1, k)] += coefficient * (filter.numerator[j] - denominator * filter.numerator[0]);
            }
        }
    }
}

impl Process {
    fn terms(&self) -> impl Iterator<Item = &NoiseTerm> {
        self.declared.spectrum.iter().flat_map(|shape| &shape.terms).filter(|term| term.asd > 0.0)
    }
}

/// How often white noise is summed to make a term as the channel sees it, and the factor of it; nothing for a term that
/// is a moving average.
fn summations(response: NoiseResponse, term: &NoiseTerm, dt_s: f64) -> Option<(usize, f64)> {
    let order = term.exponent as usize / 2;
    match response {
        NoiseResponse::Held | NoiseResponse::Direct => (order > 0).then_some((order, 1.0)),
        NoiseResponse::Differenced => (order > 2).then(|| (order - 2, dt_s.powi(-2))),
    }
}

/// What a moving average contributes to this sample and to the next two, per white noise.
fn average(response: NoiseResponse, term: &NoiseTerm, dt_s: f64) -> [f64; 3] {
    let per = dt_s.powi(-2);
    match (response, term.exponent) {
        (NoiseResponse::Held, _) => MEAN,
        (NoiseResponse::Direct, _) => [1.0, 0.0, 0.0],
        (NoiseResponse::Differenced, 0) => [per, -2.0 * per, per],
        (NoiseResponse::Differenced, 2) => [per, -per, 0.0],
        (NoiseResponse::Differenced, _) => [per, 0.0, 0.0],
    }
}

/// A response `H(s)` sampled by the bilinear transform and averaged over two samples, in powers of the delay.
fn discrete(colour: &Colour, dt_s: f64) -> (Vec<f64>, Vec<f64>) {
    let order = colour.denominator.len().max(colour.numerator.len()) - 1;
    // s^k (1 + q)^order → (2/Δt)^k (1 − q)^k (1 + q)^(order − k).
    let polynomial = |of: &[f64]| {
        let mut sum = vec![0.0; order + 1];
        for (k, factor) in of.iter().enumerate() {
            let mut term = vec![factor * (2.0 / dt_s).powi(i32::try_from(k).unwrap_or(i32::MAX))];
            for m in 0..order {
                term = times(&term, if m < k { -1.0 } else { 1.0 });
            }
            sum.iter_mut().zip(&term).for_each(|(s, t)| *s += t);
        }
        sum
    };
    let (numerator, denominator) = (polynomial(&colour.numerator), polynomial(&colour.denominator));
    let first = denominator[0];
    let mean: Vec<f64> = times(&numerator, 1.0).iter().map(|x| 0.5 * x / first).collect();
    (mean, denominator.iter().map(|x| x / first).collect())
}

/// A polynomial times `1 + sign q`.
fn times(polynomial: &[f64], sign: f64) -> Vec<f64> {
    let mut out = polynomial.to_vec();
    out.push(0.0);
    polynomial.iter().enumerate().for_each(|(i, x)| out[i + 1] += sign * x);
    out
}

/// The gains of a column's attribute as a row over the channels.
pub fn gains(text: &str, channels: &[String]) -> Vec<f64> {
    let by_channel: BTreeMap<String, f64> = serde_json::from_str(text).unwrap_or_default();
    channels.iter().map(|c| by_channel.get(c).copied().unwrap_or(0.0)).collect()
}
