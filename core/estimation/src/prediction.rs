//! The prediction-error fit: the same coefficients in the time domain, causally, as a check on every one of them.
//!
//! A fit by spectra is unbiased under feedback when Σ is right over the whole band and segments lose nothing at their
//! ends. Here nothing is cut into segments: each channel and its regressors pass the causal filter that makes the
//! channel's noise white, and the coefficients are those that make the filter's one-step predictions best (Ljung,
//! *System Identification*, §7 and §13.4: the direct method, unbiased in closed loop when the noise model is right).
//!
//! A channel's noise is taken as `a cos²(πf dt) + b (4 sin²(πf dt)/dt²)²`, an acceleration held over a sample and a
//! white readout differenced twice; both levels follow the residuals' spectrum, at the first segment and whenever their
//! number has doubled. With `y = z − 2 + z⁻¹` that is `b y²/dt⁴ + a (1 + y/4)` up to the sampling, so the filter is the
//! inverse of a polynomial of second degree. What is slower than 3 mHz, constant and drifting accelerations above all,
//! is taken out of channels and regressors by the same causal filter.
//!
//! Channels are taken one by one, which costs efficiency. Regressors made of commands depend on the other channels'
//! past, so that this fit is biased for them and no check. The covariance is that of the blocks' scatter.

use dragfree_physics::levels::{self, Bin, Levels};
use nalgebra::{Cholesky, DMatrix, DVector};

use crate::normal::{accumulate, residuals};
use crate::sigma::NoiseModel;
use crate::spectra::{Layout, MAX_BLOCKS, Plan, Spectra};

/// Slower than this is not seen.
const WASHOUT_HZ: f64 = 3e-3;

/// After a gap, time constants of the washout until a constant of 1e-9 m s⁻² is below 1e-14.
const SETTLING: f64 = 14.0;

/// Length of a block at first, ns.
const FIRST_BLOCK_NS: i64 = 3_600_000_000_000;

/// The filter that makes a channel's noise white: `e_k = x_k − c₁ e_{k−1} − c₂ e_{k−2}`, then the washout twice.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Whitener {
    c: [f64; 2],
    /// Pole of the washout.
    pole: f64,
    /// Variance of `e` when the levels are right.
    variance: f64,
}

impl Whitener {
    fn new(levels: Levels, differenced: bool, dt_s: f64) -> Self {
        let pole = (-std::f64::consts::TAU * WASHOUT_HZ * dt_s).exp();
        // A sample of white noise of one-sided PSD S has the variance S f_s/2.
        let (held, readout) = (levels.held * 0.5 / dt_s, levels.readout * 0.5 / dt_s / dt_s.powi(4));
        if !differenced || readout <= 0.0 {
            return Self { c: [0.0; 2], pole, variance: held };
        }
        // readout y² + held y/4 + held = 0, then z with z − 2 + 1/z = y inside the unit circle; held ≪ readout keeps y
        // complex.
        let half = -held / 8.0 / readout;
        let square = half * half - held / readout;
        let roots = if square < 0.0 {
            [Complex { re: half, im: (-square).sqrt() }, Complex { re: half, im: -(-square).sqrt() }]
        } else {
            // The larger first, the other by the product of the two.
            let larger = half - square.sqrt();
            [Complex { re: larger, im: 0.0 }, Complex { re: held / readout / larger, im: 0.0 }]
        };
        let [z, w] = roots.map(Complex::inside);
        let product = Complex { re: z.re * w.re - z.im * w.im, im: 0.0 };
        // S = σ² |1 − (z+w) q + z w q²|², whose coefficient of q² is σ² z w = readout.
        Self { c: [-(z.re + w.re), product.re], pole, variance: readout / product.re }
    }
}

#[derive(Clone, Copy)]
struct Complex {
    re: f64,
    im: f64,
}

impl Complex {
    /// The solution of `z − 2 + 1/z = y` inside the unit circle: `1 + y/2 ± √(y + y²/4)`.
    fn inside(self) -> Self {
        let square =
            Self { re: self.re + (self.re * self.re - self.im * self.im) / 4.0, im: self.im + self.re * self.im / 2.0 };
        let size = square.re.hypot(square.im);
        let root = Self {
            re: ((size + square.re) / 2.0).max(0.0).sqrt(),
            im: ((size - square.re) / 2.0).max(0.0).sqrt().copysign(square.im),
        };
        let (plus, minus) = (
            Self { re: 1.0 + self.re / 2.0 + root.re, im: self.im / 2.0 + root.im },
            Self { re: 1.0 + self.re / 2.0 - root.re, im: self.im / 2.0 - root.im },
        );
        // The product of the two is one, and the one outside the circle is no difference of large numbers.
        let outside = if plus.re.hypot(plus.im) > minus.re.hypot(minus.im) { plus } else { minus };
        let square = outside.re * outside.re + outside.im * outside.im;
        Self { re: outside.re / square, im: -outside.im / square }
    }
}

/// What a filter remembers of one column.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Memory {
    /// Last two outputs of the whitening, then input and output of each washout, and what is taken off the column.
    pub values: [f64; 7],
}

impl Memory {
    /// At the start of a stretch, of a column that has a constant: the filter would ring from it at the start, and
    /// again whenever it is designed anew, and a slow regressor may have one that is large against all that it varies.
    fn beside(constant: f64) -> Self {
        Self { values: [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, constant] }
    }

    fn next(&mut self, w: &Whitener, x: f64) -> f64 {
        let [e1, e2, u, v, p, q, constant] = self.values;
        let e = x - constant - w.c[0] * e1 - w.c[1] * e2;
        let first = w.pole * v + (e - u);
        let second = w.pole * q + (first - p);
        self.values = [e, e1, e, first, first, second, constant];
        second
    }
}

/// `Σ φ φᵀ/σ²` and `Σ φ e/σ²` of one stretch of time.
#[derive(Clone, Debug, PartialEq)]
pub struct Stretch {
    /// Number of the block: its start over its length.
    pub number: i64,
    /// Rows of the matrix, then the right-hand side.
    pub sums: Vec<f64>,
}

/// Everything that survives a checkpoint.
#[derive(Clone, Debug, PartialEq)]
pub struct State {
    /// Levels of each channel.
    pub levels: Vec<Levels>,
    /// Memory of each channel's filter, then of each regressor's.
    pub memory: Vec<Memory>,
    /// Samples since the last gap.
    pub since_gap: u64,
    /// Length of a block, ns.
    pub block_ns: i64,
    /// Blocks in order of time.
    pub blocks: Vec<Stretch>,
    /// Segments when the levels were last measured.
    pub trained_at: u64,
}

/// The running fit.
#[derive(Clone)]
pub struct Prediction {
    layout: Layout,
    /// Per channel, whether it is a second difference of a displacement.
    differenced: Vec<bool>,
    dt_s: f64,
    /// Per channel its regressors.
    regressors: Vec<Vec<usize>>,
    /// `Σ⁻¹` of the model per band, with which residuals are made for the levels.
    inverses: Vec<DMatrix<f64>>,
    whiteners: Vec<Whitener>,
    /// What must survive a checkpoint.
    pub state: State,
}

impl Prediction {
    /// A fit with the levels of the model; none when the modelled Σ is singular. `differenced` says of each channel
    /// whether it is a second difference of a displacement.
    pub fn new(model: &NoiseModel, differenced: &[bool], layout: &Layout, plan: &Plan) -> Option<Self> {
        let dt_s = 1.0 / plan.rate_hz;
        let sigma: Vec<DMatrix<f64>> = plan.bands.iter().map(|b| model.psd(plan.frequency_hz(*b))).collect();
        let inverses =
            sigma.iter().map(|s| Cholesky::new(s.clone()).map(|c| c.inverse())).collect::<Option<Vec<_>>>()?;
        let bins: Vec<f64> = plan.bands.iter().map(|b| b.bins() as f64).collect();
        let frequencies: Vec<f64> = plan.bands.iter().map(|b| plan.frequency_hz(*b)).collect();
        let channels = layout.channels.len();
        let levels = (0..channels)
            .map(|c| {
                let psd: Vec<f64> = sigma.iter().map(|s| s[(c, c)]).collect();
                fit(&frequencies, &psd, &bins, differenced[c], dt_s)
            })
            .collect();
        let regressors = (0..channels)
            .map(|c| (0..layout.regressors.len()).filter(|r| layout.regressors[*r].channel == c).collect());
        let mut prediction = Self {
            regressors: regressors.collect(),
            differenced: differenced.to_vec(),
            dt_s,
            inverses,
            whiteners: Vec::new(),
            state: State {
                levels,
                memory: vec![Memory::default(); channels + layout.regressors.len()],
                since_gap: 0,
                block_ns: FIRST_BLOCK_NS,
                blocks: Vec::new(),
                trained_at: 0,
            },
            layout: layout.clone(),
        };
        prediction.design();
        Some(prediction)
    }

    /// Filters for the levels of the state; to be called when the state was put in from outside.
    pub fn design(&mut self) {
        let pairs = self.state.levels.iter().zip(&self.differenced);
        self.whiteners = pairs.map(|(l, d)| Whitener::new(*l, *d, self.dt_s)).collect();
    }

    /// Adds samples without a gap among them, one slice per column of the sums, the first at `first_ns`.
    pub fn push(&mut self, first_ns: i64, columns: &[&[f64]]) {
        let rows = columns.first().map_or(0, |c| c.len());
        let step_ns = 1e9 * self.dt_s;
        let settling = (SETTLING / (std::f64::consts::TAU * WASHOUT_HZ * self.dt_s)).ceil() as u64;
        let mut k = 0;
        while k < rows {
            // Up to the end of the block, and of the settling.
            let time_ns = first_ns + (step_ns * k as f64) as i64;
            let number = time_ns.div_euclid(self.state.block_ns);
            let left_ns = ((number + 1) * self.state.block_ns - time_ns) as f64;
            let mut end = rows.min(k + (left_ns / step_ns).ceil().max(1.0) as usize);
            let settled = self.state.since_gap >= settling;
            if !settled {
                end = end.min(k + (settling - self.state.since_gap) as usize);
            }
            let part: Vec<&[f64]> = columns.iter().map(|c| &c[k..end]).collect();
            self.filter(settled.then_some(number), &part);
            self.state.since_gap += (end - k) as u64;
            k = end;
        }
    }

    fn filter(&mut self, number: Option<i64>, columns: &[&[f64]]) {
        let channels = self.layout.channels.len();
        let n = self.layout.coefficients.len();
        let mut added = vec![0.0; self.block_size()];
        let begins = self.state.since_gap == 0 && columns.iter().any(|column| !column.is_empty());
        for c in (0..channels).filter(|c| !self.regressors[*c].is_empty()) {
            let w = self.whiteners[c];
            let memory = &mut self.state.memory;
            let mut run = |m: usize, column: &[f64]| -> Vec<f64> {
                let mean = || column.iter().sum::<f64>() / column.len() as f64;
                let mut state = if begins { Memory::beside(mean()) } else { memory[m] };
                let out = column.iter().map(|x| state.next(&w, *x)).collect();
                memory[m] = state;
                out
            };
            let error = run(c, columns[c]);
            let phi: Vec<(usize, f64, Vec<f64>)> = self.regressors[c]
                .iter()
                .map(|r| {
                    let regressor = &self.layout.regressors[*r];
                    (regressor.coefficient, regressor.factor, run(channels + r, columns[channels + regressor.series]))
                })
                .collect();
            for (i, a, x) in &phi {
                added[n * n + i] += a * dot(x, &error) / w.variance;
                for (j, b, y) in &phi {
                    added[n * i + j] += a * b * dot(x, y) / w.variance;
                }
            }
        }
        let Some(number) = number else { return };
        if self.state.blocks.last().is_none_or(|b| b.number != number) {
            self.state.blocks.push(Stretch { number, sums: vec![0.0; added.len()] });
        }
        if let Some(last) = self.state.blocks.last_mut() {
            last.sums.iter_mut().zip(&added).for_each(|(s, a)| *s += a);
        }
        while self.state.blocks.len() > MAX_BLOCKS {
            self.coarsen();
        }
    }

    /// Blocks of twice the length.
    fn coarsen(&mut self) {
        self.state.block_ns *= 2;
        let mut merged: Vec<Stretch> = Vec::new();
        for mut block in self.state.blocks.drain(..) {
            block.number = block.number.div_euclid(2);
            match merged.last_mut() {
                Some(last) if last.number == block.number => {
                    last.sums.iter_mut().zip(&block.sums).for_each(|(a, b)| *a += b);
                }
                _ => merged.push(block),
            }
        }
        self.state.blocks = merged;
    }

    /// The next sample does not follow the last one.
    pub fn gap(&mut self) {
        self.state.memory.iter_mut().for_each(|m| *m = Memory::default());
        self.state.since_gap = 0;
    }

    /// Numbers in a block's sums.
    pub fn block_size(&self) -> usize {
        let n = self.layout.coefficients.len();
        n * n + n
    }

    /// Whether the number of segments has doubled since the levels were measured.
    pub fn is_due(&self, segments: u64) -> bool {
        segments >= (2 * self.state.trained_at).max(1)
    }

    /// Measures the levels anew from the residuals of all segments so far.
    pub fn train(&mut self, spectra: &Spectra, plan: &Plan) {
        self.state.trained_at = spectra.segments;
        // What is slow is washed out, and may be more than the noise.
        let weights = spectra.weights_of(plan.ordinary_bands()).kept();
        let equations = accumulate(spectra, &self.layout, &self.inverses, &weights);
        // A coefficient that nothing sees yet is left at zero.
        let mut normal = equations.normal;
        let largest = normal.diagonal().amax();
        for i in 0..normal.nrows() {
            normal[(i, i)] = normal[(i, i)] * (1.0 + 1e-9) + 1e-12 * largest + f64::MIN_POSITIVE;
        }
        let Some(factor) = Cholesky::new(normal) else { return };
        let theta: DVector<f64> = factor.solve(&equations.right);
        let residual = residuals(spectra, &self.layout, plan.bands.len(), &theta);
        let frequencies: Vec<f64> = plan.bands.iter().map(|b| plan.frequency_hz(*b)).collect();
        for c in 0..self.layout.channels.len() {
            let psd: Vec<f64> = residual.iter().zip(&spectra.expected).map(|(r, e)| r[(c, c)] / e).collect();
            self.state.levels[c] = fit(&frequencies, &psd, &spectra.expected, self.differenced[c], self.dt_s);
        }
        self.design();
    }

    /// Per block, the normal matrix and the right-hand side.
    pub(crate) fn equations(&self) -> Vec<(DMatrix<f64>, DVector<f64>)> {
        let n = self.layout.coefficients.len();
        let split = |b: &Stretch| {
            (DMatrix::from_row_slice(n, n, &b.sums[..n * n]), DVector::from_column_slice(&b.sums[n * n..]))
        };
        self.state.blocks.iter().map(split).collect()
    }
}

/// Levels that fit a spectrum.
fn fit(frequencies: &[f64], psd: &[f64], weights: &[f64], differenced: bool, dt_s: f64) -> Levels {
    let bins: Vec<Bin> = frequencies
        .iter()
        .zip(psd)
        .zip(weights)
        .map(|((f, s), w)| Bin { frequency_hz: *f, psd: *s, weight: *w })
        .filter(|b| b.frequency_hz > WASHOUT_HZ)
        .collect();
    let unknown = Levels { held: 1.0, readout: 0.0 };
    if differenced {
        return levels::fit(&bins, dt_s).map_or(unknown, |fitted| fitted.levels);
    }
    let used = bins.iter().filter(|b| b.psd.is_finite() && b.weight > 0.0);
    let (sum, weight) = used.fold((0.0, 0.0), |(s, w), b| (s + b.weight * b.psd, w + b.weight));
    if sum > 0.0 { Levels { held: sum / weight, readout: 0.0 } } else { unknown }
}

/// Scalar product in four lanes.
fn dot(a: &[f64], b: &[f64]) -> f64 {
    let mut lanes = [0.0; 4];
    let (a4, b4) = (a.chunks_exact(4), b.chunks_exact(4));
    let rest: f64 = a4.remainder().iter().zip(b4.remainder()).map(|(x, y)| x * y).sum();
    for (x, y) in a4.zip(b4) {
        for l in 0..4 {
            lanes[l] += x[l] * y[l];
        }
    }
    lanes.iter().sum::<f64>() + rest
}

#[cfg(test)]
mod tests {
    use super::*;

    /// `|1 + c₁ q + c₂ q²|² σ²` on the unit circle against the spectrum that it stands for, from 1e-4 Hz to Nyquist.
    #[test]
    fn the_filter_is_the_root_of_the_spectrum() {
        let dt = 0.1;
        for (held, readout) in [(4.4e-21, 3.2e-18), (4.4e-21, 2e-24), (1e-10, 1e-10), (1e-20, 1e-30)] {
            let w = Whitener::new(Levels { held, readout }, true, dt);
            for f in [1e-4, 1e-3, 0.01, 0.03, 0.1, 0.5, 1.0, 3.0, 4.9] {
                let phase = std::f64::consts::TAU * f * dt;
                let re = 1.0 + w.c[0] * phase.cos() + w.c[1] * (2.0 * phase).cos();
                let im = -w.c[0] * phase.sin() - w.c[1] * (2.0 * phase).sin();
                let (sin, cos) = (0.5 * phase).sin_cos();
                let want = (held * cos * cos + readout * (4.0 * sin * sin / (dt * dt)).powi(2)) * 0.5 / dt;
                let got = w.variance * (re * re + im * im);
                // Near zero frequency the polynomial is a difference of numbers near one.
                let grain = 1e-15 * w.variance;
                assert!((got - want).abs() < 1e-9 * want + grain, "{held} {readout} {f}: {got} against {want}");
            }
        }
    }

    /// A constant leaves nothing, at the start and when the levels are measured anew, however large it is.
    #[test]
    fn a_constant_of_a_regressor_never_shows() {
        let before = Whitener::new(Levels { held: 4.4e-21, readout: 3.2e-18 }, true, 0.1);
        let after = Whitener::new(Levels { held: 2e-21, readout: 4e-18 }, true, 0.1);
        let mut memory = Memory::beside(300.0);
        let shown =
            |memory: &mut Memory, w: &Whitener| (0..1000).map(|_| memory.next(w, 300.0).abs()).fold(0.0, f64::max);
        assert_eq!(shown(&mut memory, &before), 0.0);
        assert_eq!(shown(&mut memory, &after), 0.0);
        // Its twin, which begins at zero as if the constant were a step.
        let mut memory = Memory::default();
        shown(&mut memory, &before);
        for _ in 0..20_000 {
            memory.next(&before, 300.0);
        }
        assert!(shown(&mut memory, &after) > 1.0);
    }

    #[test]
    fn the_level_of_a_direct_measurement_is_its_mean() {
        let f = [0.1, 1.0, 2.0];
        let l = fit(&f, &[2.0; 3], &[1.0; 3], false, 0.1);
        assert_eq!(l, Levels { held: 2.0, readout: 0.0 });
    }
}
