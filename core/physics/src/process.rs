//! Random processes that follow a [`NoiseShape`]: exact discretisations, stationary from the first sample, one normal
//! deviate a sample.
//!
//! A term `asd² (f₀/f)^{2n}` is white noise through `n` leaky integrators. The innovation form of the process with
//! added white noise needs one deviate per sample instead of one per state:
//!
//! `y_k = x̂_0 + e_k`, `x̂ ← Φ x̂ + K e_k`, `e_k` white with variance `S`,
//!
//! with `K` and `S` of the steady Kalman filter of the sampled integrators (Anderson & Moore, Optimal Filtering, ch.
//! 9).

use nalgebra::{SMatrix, SVector};
use rand::Rng;
use rand_distr::{Distribution, StandardNormal};
use std::f64::consts::TAU;

use crate::noise::{NoiseLine, NoiseShape, NoiseTerm};

/// Leak of the integrators, rad/s. It bounds the variance; below 1 µHz a shape turns flat.
pub const LEAK_RAD_S: f64 = TAU * 1e-6;

/// One draw of a standard normal deviate (ziggurat).
pub fn normal<R: Rng + ?Sized>(rng: &mut R) -> f64 {
    StandardNormal.sample(rng)
}

/// States of the steepest term that a mission file may hold, exponent 8.
const MOST_STATES: usize = 4;

type Square = SMatrix<f64, MOST_STATES, MOST_STATES>;
type Column = SVector<f64, MOST_STATES>;

fn factorial(n: usize) -> f64 {
    (1..=n).map(|k| k as f64).product()
}

/// `∫₀¹ t^m e^{−ct} dt` for `c ≪ 1`, by its series; the closed form cancels.
fn incomplete_gamma(m: usize, c: f64) -> f64 {
    (0..12).map(|k| (-c).powi(k as i32) / (factorial(k) * (m + k + 1) as f64)).sum()
}

/// All terms of a shape as one chain of leaky integrators, sampled: `x_0` is the coloured part of the process, `x_i`
/// its `i`-th derivative times `dtⁱ`, as if undamped. A term of exponent `2n` is white noise into `x_{n−1}`.
///
/// All terms leak alike, so that the steepest one's chain serves them all: `Φ_ij = e^{−λdt}/(j−i)!`.
struct SampledChain {
    transition: Square,
    /// Covariance that one step adds.
    added: Square,
    /// Stationary covariance.
    stationary: Square,
    /// Variance of the white part of a sample.
    white: f64,
}

impl SampledChain {
    fn new(shape: &NoiseShape, dt_s: f64) -> Self {
        let states = shape.coloured().map(NoiseTerm::states).max().unwrap_or(0);
        let transition = Square::from_fn(|i, j| {
            let power = j.checked_sub(i).filter(|_| j < states);
            power.map_or(0.0, |m| (-LEAK_RAD_S * dt_s).exp() / factorial(m))
        });
        let mut chain = Self {
            transition,
            added: Square::zeros(),
            stationary: Square::zeros(),
            white: 0.5 * shape.white_psd() / dt_s,
        };
        for term in shape.coloured() {
            // Impulse response of x_i: dtⁱ t^a/a! e^{−λt}, a = n−1−i; covariances are integrals of products of these.
            // The two-sided intensity is half the one-sided PSD of the white noise.
            let n = term.states();
            let intensity = 0.5 * (term.asd * (TAU * term.corner_hz).powi(n as i32)).powi(2);
            let (rate, step) = (2.0 * LEAK_RAD_S * dt_s, intensity * dt_s.powi(2 * n as i32 - 1));
            for (i, j) in (0..n).flat_map(|i| (0..n).map(move |j| (i, j))) {
                let (a, b) = (n - 1 - i, n - 1 - j);
                let scale = step / (factorial(a) * factorial(b));
                chain.added[(i, j)] += scale * incomplete_gamma(a + b, rate);
                chain.stationary[(i, j)] += scale * factorial(a + b) / rate.powi((a + b) as i32 + 1);
            }
        }
        chain
    }

    /// Covariance of the steady Kalman filter's prediction, from the Riccati equation by structure-preserving doubling
    /// (Chu, Fan, Lin & Wang 2004), applied to the filtered covariance, whose equation is regular without a white part.
    fn prediction(&self) -> Square {
        let (phi, q) = (&self.transition, &self.added);
        let variance = q[(0, 0)] + self.white;
        if variance == 0.0 {
            return Square::zeros();
        }
        let (cross, seen) = (q.column(0), phi.row(0));
        let mut a = (phi - cross * seen / variance).transpose();
        let mut g = seen.transpose() * seen / variance;
        let mut x = q - cross * cross.transpose() / variance;
        // 2^40 steps exceed the memory of the leak.
        for _ in 0..40 {
            let Some(inverse) = (Square::identity() + g * x).lu().try_inverse() else { break };
            let mixed = inverse * a;
            let gain = a * inverse * g * a.transpose();
            x += a.transpose() * x * mixed;
            a *= mixed;
            g += gain;
        }
        phi * x * phi.transpose() + q
    }
}

/// Lower Cholesky factor of a covariance, computed on its correlations: the states differ by many orders of magnitude.
/// A state without variance stays zero.
fn cholesky(covariance: &Square) -> Square {
    let sigma = |i: usize| covariance[(i, i)].max(0.0).sqrt();
    let correlation = Square::from_fn(|i, j| match (i == j, sigma(i) * sigma(j)) {
        (true, _) => 1.0,
        (false, scale) if scale > 0.0 => covariance[(i, j)] / scale,
        _ => 0.0,
    });
    let Some(factor) = correlation.cholesky() else { return Square::zeros() };
    let factor = factor.l();
    Square::from_fn(|i, j| sigma(i) * factor[(i, j)])
}

/// A line of the spectrum, `amplitude cos(2πf t + φ)`, by rotation from sample to sample.
#[derive(Clone, Debug)]
struct RunningLine {
    amplitude: f64,
    /// Cosine and sine of the angle of one sample.
    turn: [f64; 2],
    /// Cosine and sine of the phase.
    phase: [f64; 2],
}

impl RunningLine {
    fn start<R: Rng + ?Sized>(&mut self, rng: &mut R) {
        // The direction of two normal deviates is uniform.
        let (x, y) = (normal(rng), normal(rng));
        let length = x.hypot(y);
        self.phase = [x / length, y / length];
    }

    fn next(&mut self) -> f64 {
        let ([c, s], [dc, ds]) = (self.phase, self.turn);
        let (x, y) = (c * dc - s * ds, s * dc + c * ds);
        // Newton's step for 1/√(x²+y²) at one: the length does not drift by rounding.
        let length = 1.5 - 0.5 * (x * x + y * y);
        self.phase = [x * length, y * length];
        self.amplitude * c
    }
}

/// A random process sampled every `dt_s`.
#[derive(Clone, Debug)]
pub struct NoiseProcess {
    states: usize,
    transition: Square,
    /// `√S` and `K √S`: gains from a unit deviate to the sample and to the states.
    sigma: f64,
    kick: Column,
    /// Cholesky factor of the stationary covariance of `x̂`.
    stationary: Square,
    state: Column,
    lines: Vec<RunningLine>,
}

impl NoiseProcess {
    /// A process of the given shape; its coloured terms are zero until [`Self::start`].
    pub fn new(shape: &NoiseShape, dt_s: f64) -> Self {
        Self::with_lines(shape, &[], dt_s)
    }

    /// A process of the given shape, with lines of random phase.
    pub fn with_lines(shape: &NoiseShape, lines: &[NoiseLine], dt_s: f64) -> Self {
        let chain = SampledChain::new(shape, dt_s);
        let prediction = chain.prediction();
        let sigma = (prediction[(0, 0)] + chain.white).sqrt();
        let kick = chain.transition * prediction.column(0);
        let line = |l: &NoiseLine| {
            let (sine, cosine) = (TAU * l.frequency_hz * dt_s).sin_cos();
            RunningLine { amplitude: l.amplitude, turn: [cosine, sine], phase: [1.0, 0.0] }
        };
        Self {
            states: (0..MOST_STATES).take_while(|i| chain.transition[(*i, *i)] != 0.0).count(),
            transition: chain.transition,
            sigma,
            kick: if sigma > 0.0 { kick / sigma } else { Column::zeros() },
            // Prediction and its error are uncorrelated, so their covariances add.
            stationary: cholesky(&(chain.stationary - prediction)),
            state: Column::zeros(),
            lines: lines.iter().map(line).collect(),
        }
    }

    /// Draws the states from their stationary distribution, and the phases of the lines.
    pub fn start<R: Rng + ?Sized>(&mut self, rng: &mut R) {
        let mut w = Column::zeros();
        for x in w.iter_mut().take(self.states) {
            *x = normal(rng);
        }
        self.state = self.stationary * w;
        for line in &mut self.lines {
            line.start(rng);
        }
    }

    /// Prediction of the next sample from the past.
    pub fn slow(&self) -> f64 {
        self.state[0]
    }

    /// The next sample.
    pub fn next<R: Rng + ?Sized>(&mut self, rng: &mut R) -> f64 {
        let w = normal(rng);
        let out = self.state[0] + self.sigma * w;
        self.state = self.transition * self.state + self.kick * w;
        self.lines.iter_mut().fold(out, |sum, line| sum + line.next())
    }

    /// The states, for a checkpoint.
    pub fn states(&self) -> impl Iterator<Item = f64> + '_ {
        self.state.iter().take(self.states).chain(self.lines.iter().flat_map(|l| &l.phase)).copied()
    }

    /// Mutable access to the states in the order of [`Self::states`].
    pub fn states_mut(&mut self) -> impl Iterator<Item = &mut f64> + '_ {
        self.state.iter_mut().take(self.states).chain(self.lines.iter_mut().flat_map(|l| &mut l.phase))
    }
}

/// Independent processes of one sample interval, sampled together: rows over the processes, one pass.
#[derive(Clone, Debug)]
pub struct NoiseBank {
    /// The processes as built, from which [`Self::start`] draws.
    processes: Vec<NoiseProcess>,
    /// First row of `Φ`, `e^{−λdt}/m!`, as far as any process has states.
    transition: Vec<f64>,
    sigma: Vec<f64>,
    /// By state, then by process.
    kick: Vec<Vec<f64>>,
    state: Vec<Vec<f64>>,
    /// Process and line.
    lines: Vec<(usize, RunningLine)>,
    /// Deviates and samples of the last call, by process.
    deviates: Vec<f64>,
    samples: Vec<f64>,
}

impl NoiseBank {
    /// A bank of processes of one sample interval.
    pub fn new(processes: Vec<NoiseProcess>) -> Self {
        let states = processes.iter().map(|p| p.states).max().unwrap_or(0);
        let deepest = processes.iter().find(|p| p.states == states);
        let mut bank = Self {
            transition: (0..states).filter_map(|m| deepest.map(|p| p.transition[(0, m)])).collect(),
            sigma: processes.iter().map(|p| p.sigma).collect(),
            kick: (0..states).map(|i| processes.iter().map(|p| p.kick[i]).collect()).collect(),
            state: vec![vec![0.0; processes.len()]; states],
            lines: Vec::new(),
            deviates: vec![0.0; processes.len()],
            samples: vec![0.0; processes.len()],
            processes,
        };
        bank.gather();
        bank
    }

    /// Copies states and lines from the processes.
    fn gather(&mut self) {
        for (i, row) in self.state.iter_mut().enumerate() {
            row.iter_mut().zip(&self.processes).for_each(|(slot, process)| *slot = process.state[i]);
        }
        let lines = self.processes.iter().enumerate();
        self.lines = lines.flat_map(|(p, process)| process.lines.iter().map(move |l| (p, l.clone()))).collect();
    }

    /// Draws the states of every process from their stationary distribution, and the phases of the lines.
    pub fn start<R: Rng + ?Sized>(&mut self, rng: &mut R) {
        for process in &mut self.processes {
            process.start(rng);
        }
        self.gather();
    }

    /// Sets one process to zero; the others and the random stream are not affected.
    pub fn silence(&mut self, process: usize) {
        self.sigma[process] = 0.0;
        for row in self.kick.iter_mut().chain(&mut self.state) {
            row[process] = 0.0;
        }
        self.lines.retain(|(p, _)| *p != process);
    }

    /// As [`NoiseProcess::slow`] of one process.
    pub fn slow(&self, process: usize) -> f64 {
        self.state.first().map_or(0.0, |row| row[process])
    }

    /// The next sample of every process.
    pub fn next<R: Rng + ?Sized>(&mut self, rng: &mut R) -> &[f64] {
        let (w, out) = (&mut self.deviates[..], &mut self.samples[..]);
        for x in &mut *w {
            *x = normal(rng);
        }
        for ((out, sigma), w) in out.iter_mut().zip(&self.sigma).zip(&*w) {
            *out = sigma * w;
        }
        if let Some(row) = self.state.first() {
            for (out, state) in out.iter_mut().zip(row) {
                *out += state;
            }
        }
        // Row i depends on old rows from i on, so ascending order overwrites nothing that is still needed.
        for (i, kick) in self.kick.iter().enumerate() {
            let [row, deeper @ ..] = &mut self.state[i..] else { break };
            let leak = self.transition[0];
            for ((state, kick), w) in row.iter_mut().zip(kick).zip(&*w) {
                *state = leak * *state + kick * w;
            }
            for (other, c) in deeper.iter().zip(&self.transition[1..]) {
                for (state, other) in row.iter_mut().zip(other) {
                    *state += c * other;
                }
            }
        }
        for (p, line) in &mut self.lines {
            out[*p] += line.next();
        }
        out
    }

    /// Last result of [`Self::next`]; zeros before.
    pub fn samples(&self) -> &[f64] {
        &self.samples
    }

    /// The states, for a checkpoint.
    pub fn states(&self) -> Vec<f64> {
        self.state.iter().flatten().chain(self.lines.iter().flat_map(|(_, l)| &l.phase)).copied().collect()
    }

    /// Restores [`Self::states`]; false if the length differs.
    pub fn set_states(&mut self, states: &[f64]) -> bool {
        if states.len() != self.processes.len() * self.state.len() + 2 * self.lines.len() {
            return false;
        }
        let slots = self.state.iter_mut().flatten().chain(self.lines.iter_mut().flat_map(|(_, l)| &mut l.phase));
        for (slot, value) in slots.zip(states) {
            *slot = *value;
        }
        true
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

    fn shapes() -> [NoiseShape; 6] {
        let mut mixed = NoiseShape::with_corner(2e-9, 2e-2, 4);
        mixed.terms.push(NoiseTerm { asd: 5e-9, corner_hz: 3e-3, exponent: 2 });
        [
            NoiseShape { terms: vec![term(2)] },
            NoiseShape { terms: vec![term(4)] },
            NoiseShape::with_corner(2e-9, 2e-3, 2),
            NoiseShape::with_corner(2e-9, 2e-3, 4),
            NoiseShape::with_corner(1e-5, 1e-4, 4),
            mixed,
        ]
    }

    /// `P = Φ P Φᵀ + Q` to rounding: stationary whatever the number of steps.
    #[test]
    fn stationary_covariance_is_a_fixed_point() {
        // A leak of 1 µHz moves P by 1e-6 per step; exponents above 4 lose Q in the rounding of P.
        for shape in shapes() {
            let c = SampledChain::new(&shape, DT_S);
            let p = c.stationary;
            let next = c.transition * p * c.transition.transpose() + c.added;
            for (i, j) in (0..4).flat_map(|i| (0..4).map(move |j| (i, j))) {
                let scale = (p[(i, i)] * p[(j, j)]).sqrt();
                assert!((next[(i, j)] - p[(i, j)]).abs() <= 1e-14 * scale, "{shape:?}, {i} {j}");
            }
        }
    }

    /// The noise that a step adds, against an integration of its own: many thin Euler steps of the covariance.
    #[test]
    fn a_step_adds_the_exact_covariance() {
        for exponent in [2, 4, 6, 8] {
            let n = exponent as usize / 2;
            let c = SampledChain::new(&NoiseShape { terms: vec![term(exponent)] }, DT_S);
            let q = 0.5 * (2e-9 * (TAU * 2e-3).powi(n as i32)).powi(2);
            let thin = 20_000;
            let h = DT_S / f64::from(thin);
            let mut p = Square::zeros();
            let mut a = Square::zeros();
            for i in 0..n {
                a[(i, i)] = -LEAK_RAD_S;
                if i > 0 {
                    a[(i - 1, i)] = 1.0;
                }
            }
            for _ in 0..thin {
                p += (a * p + p * a.transpose()) * h;
                p[(n - 1, n - 1)] += q * h;
            }
            for (i, j) in (0..n).flat_map(|i| (0..n).map(move |j| (i, j))) {
                let error = (p[(i, j)] * DT_S.powi((i + j) as i32) / c.added[(i, j)] - 1.0).abs();
                // Euler's rule is off by about (2n−1)²/thin.
                assert!(error < 50.0 / f64::from(thin), "exponent {exponent}, {i} {j}: {error}");
            }
        }
    }

    /// Autocovariance of `asd² (f₀/f)^{2n}` with the leak, from the impulse response `t^{n−1}/(n−1)! e^{−λt}`.
    fn closed_form(shape: &NoiseShape, lag_s: f64) -> f64 {
        let one = |t: &NoiseTerm| {
            let (l, n) = (LEAK_RAD_S, t.exponent / 2);
            let q = 0.5 * (t.asd * (TAU * t.corner_hz).powi(n as i32)).powi(2);
            let polynomial = if n == 1 { 1.0 / (2.0 * l) } else { (1.0 + l * lag_s) / (4.0 * l.powi(3)) };
            q * polynomial * (-l * lag_s).exp()
        };
        let white = if lag_s == 0.0 { 0.5 * shape.white_psd() / DT_S } else { 0.0 };
        white + shape.coloured().map(one).sum::<f64>()
    }

    /// What the innovation form gives in the long run, from `Φ`, `K` and `S` alone: `Σ ΦʲKSKᵀΦʲᵀ` by doubling.
    fn long_run(process: &NoiseProcess) -> Square {
        let (mut sum, mut power) = (process.kick * process.kick.transpose(), process.transition);
        for _ in 0..40 {
            sum += power * sum * power.transpose();
            power *= power;
        }
        sum
    }

    /// One deviate a sample gives the autocovariance of white noise and chains: at every lag, and from the first sample
    /// on as in the long run. `e^{−λdt}` has the grain `ε`, which moves a pole by `ε/(λ dt)` of its distance from one;
    /// a deviate too strong by 1e-6 is seen.
    #[test]
    fn innovation_form_has_the_autocovariance_of_the_shape() {
        for shape in shapes() {
            let process = NoiseProcess::new(&shape, DT_S);
            for states in [long_run(&process), process.stationary * process.stationary.transpose()] {
                for lag in [0, 1, 2, 10, 1000, 100_000, 2_000_000] {
                    // cov(y_{k+m}, y_k) = c Φ^{m−1} (Φ Σ cᵀ + K S)
                    let found = match lag {
                        0 => states[(0, 0)] + process.sigma.powi(2),
                        _ => {
                            let after = process.transition * states.column(0) + process.kick * process.sigma;
                            (process.transition.pow(lag - 1) * after)[0]
                        }
                    };
                    let want = closed_form(&shape, f64::from(lag) * DT_S);
                    let bound = process.states as f64 * f64::EPSILON / (LEAK_RAD_S * DT_S);
                    assert!((found / want - 1.0).abs() < bound, "{shape:?}, lag {lag}: {found} {want}");
                }
            }
            let mut strong = process.clone();
            strong.kick *= 1.0 + 1e-6;
            let ratio = long_run(&strong)[(0, 0)] / closed_form(&shape, DT_S);
            assert!((ratio - 1.0).abs() > 1e-6, "{shape:?}");
        }
    }

    /// The spectrum in band does not depend on the step: `2 dt S |1 + c (z − Φ)⁻¹ K|²`, evaluated, against the shape.
    /// The leak takes `n (λ/ω)²`, what folds back adds less than `(ω dt)²/11`. Deviates drawn for another step are
    /// seen.
    #[test]
    fn spectrum_does_not_depend_on_the_step() {
        for shape in shapes() {
            for (dt_s, f_hz) in [0.01, 0.1, 1.0, 10.0].into_iter().flat_map(|dt| [1e-4, 1e-3, 5e-3].map(|f| (dt, f))) {
                let process = NoiseProcess::new(&shape, dt_s);
                let omega = TAU * f_hz;
                let bound = process.states as f64 * (LEAK_RAD_S / omega).powi(2) + (omega * dt_s).powi(2) / 11.0;
                let error = (model_psd(&process, f_hz, dt_s) / shape.psd(f_hz) - 1.0).abs();
                assert!(error < bound, "{shape:?}, {dt_s} s, {f_hz} Hz: {error} {bound}");
                let other = NoiseProcess::new(&shape, 0.9 * dt_s);
                assert!((model_psd(&other, f_hz, dt_s) / shape.psd(f_hz) - 1.0).abs() > 0.05, "{shape:?}");
            }
        }
    }

    /// `2 dt S |1 + c (z − Φ)⁻¹ K|²`.
    fn model_psd(process: &NoiseProcess, frequency_hz: f64, dt_s: f64) -> f64 {
        let (sine, cosine) = (TAU * frequency_hz * dt_s).sin_cos();
        // (z − Φ) x = k in real and imaginary parts: (cos − Φ) x_r − sin x_i = k, sin x_r + (cos − Φ) x_i = 0.
        let real = Square::identity() * cosine - process.transition;
        let inverse = real.lu().try_inverse().unwrap();
        let x_r = (real + inverse * (sine * sine)).lu().solve(&process.kick).unwrap();
        let x_i = inverse * x_r * -sine;
        2.0 * dt_s * ((process.sigma + x_r[0]).powi(2) + x_i[0].powi(2))
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

    /// Amplitude, frequency and step of a line against `cos`, over a million samples; the phase is uniform over the
    /// seeds.
    #[test]
    fn lines_keep_amplitude_frequency_and_phase() {
        let line = NoiseLine { amplitude: 3.0, frequency_hz: 0.0551 };
        let process = NoiseProcess::with_lines(&NoiseShape::default(), &[line], DT_S);
        let mut rng = Xoshiro256PlusPlus::seed_from_u64(1);
        let mut running = process.clone();
        running.start(&mut rng);
        let phase = running.lines[0].phase[1].atan2(running.lines[0].phase[0]);
        for k in 0..1_000_000 {
            let want = 3.0 * (TAU * (0.0551 * DT_S * f64::from(k)).fract() + phase).cos();
            // Rounding of the turn and of the argument adds up to 1e-16 a sample.
            assert!((running.next(&mut rng) - want).abs() < 3.0 * 1e-16 * f64::from(k) + 1e-14, "sample {k}");
        }
        // Mean cosine and sine of 2000 uniform phases: σ = 1/√4000 each, 4.5σ, false alarm 1.4e-5 for both.
        let phases = (0..2000).map(|seed| {
            let mut process = process.clone();
            process.start(&mut Xoshiro256PlusPlus::seed_from_u64(seed));
            process.lines[0].phase
        });
        let sum = phases.fold([0.0, 0.0], |a, b| [a[0] + b[0], a[1] + b[1]]);
        assert!(sum.iter().all(|s| (s / 2000.0).abs() < 4.5 / f64::sqrt(4000.0)), "{sum:?}");
    }

    /// A bank is its processes, one deviate each in their order.
    #[test]
    fn a_bank_gives_what_its_processes_give() {
        let [a, b, c, d, _, e] = shapes();
        let line = NoiseLine { amplitude: 1e-9, frequency_hz: 0.3 };
        let processes = [
            NoiseProcess::new(&a, DT_S),
            NoiseProcess::new(&NoiseShape::white(3e-9), DT_S),
            NoiseProcess::with_lines(&b, &[line, line], DT_S),
            NoiseProcess::new(&c, DT_S),
            NoiseProcess::new(&d, DT_S),
            NoiseProcess::new(&e, DT_S),
            NoiseProcess::new(&NoiseShape { terms: vec![term(8)] }, DT_S),
        ];
        let mut bank = NoiseBank::new(processes.to_vec());
        let mut single = processes;
        let mut rng = Xoshiro256PlusPlus::seed_from_u64(9);
        let mut twin = rng.clone();
        bank.start(&mut rng);
        single.iter_mut().for_each(|p| p.start(&mut twin));
        for k in 0..1000 {
            let samples = bank.next(&mut rng);
            for (i, (process, sample)) in single.iter_mut().zip(samples.iter().copied()).enumerate() {
                let want = process.next(&mut twin);
                // Sums in another order.
                let scale = process.state.amax() + process.sigma;
                assert!((sample - want).abs() < 1e-13 * scale, "process {i}, sample {k}: {sample} {want}");
            }
        }
        let mut resumed = NoiseBank::new(single.into());
        assert!(!resumed.set_states(&[0.0]) && resumed.set_states(&bank.states()));
        for _ in 0..100 {
            assert_eq!(bank.next(&mut rng), resumed.next(&mut twin));
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
