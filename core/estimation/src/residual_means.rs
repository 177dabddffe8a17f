//! Residuals over time at a rate that plots well, whatever the length of the data.
//!
//! A residual `z − Φθ` is known when θ is, at the end. Means of z and Φ over short intervals are kept until then, and
//! the products of those that meet in one channel, of which the mean square of every residual follows. There are never
//! more than [`MOST_INTERVALS`]: when there would be, each two neighbours become one.

use std::f64::consts::PI;

use dragfree_schema::state::{State, StateError};
use dragfree_schema::{FIRST_INTERVAL_NS, MOST_INTERVALS};
use nalgebra::DMatrix;

use crate::sigma::NoiseModel;
use crate::spectra::Layout;

/// The longest interval over the first one, far beyond any mission.
const MOST_DOUBLED: i64 = 1 << 20;
/// Frequencies between which the noise is interpolated.
const FREQUENCIES: usize = 256;

/// Sums over intervals.
#[derive(Clone, Debug)]
pub struct ResidualMeans {
    step_ns: i64,
    interval_ns: i64,
    /// Per channel, the columns that make its residual: itself and its series.
    columns: Vec<Vec<usize>>,
    width: usize,
    intervals: Vec<Interval>,
}

#[derive(Clone, Debug)]
struct Interval {
    /// It begins at this number times the length of an interval.
    number: i64,
    count: u64,
    /// Of every column.
    sums: Vec<f64>,
    /// Upper triangle of the products of each channel's columns, channel after channel.
    products: Vec<f64>,
}

/// The residuals of all channels in one interval.
#[derive(Clone, Debug, PartialEq)]
pub struct Means {
    /// Centre of the interval, Unix ns.
    pub time_ns: i64,
    /// Samples in it.
    pub count: u64,
    /// Mean residual of each channel, less its mean over all intervals, unit of the channel.
    pub mean: Vec<f64>,
    /// Root of the mean square of each channel's residuals, less the same mean, unit of the channel.
    pub rms: Vec<f64>,
}

impl ResidualMeans {
    /// Of the columns of a layout, the channels first, at `rate_hz`.
    pub fn new(layout: &Layout, rate_hz: f64) -> Self {
        let channels = layout.channels.len();
        let of = |channel: usize| {
            let own = layout.regressors.iter().filter(|r| r.channel == channel);
            let mut columns: Vec<usize> = own.map(|r| channels + r.series).collect();
            columns.sort_unstable();
            columns.dedup();
            columns.insert(0, channel);
            columns
        };
        Self {
            step_ns: (1e9 / rate_hz).round() as i64,
            interval_ns: FIRST_INTERVAL_NS,
            columns: (0..channels).map(of).collect(),
            width: layout.columns(),
            intervals: Vec::new(),
        }
    }

    /// Adds rows one step apart, the first at `first_ns`; one slice per column, every value finite.
    pub fn push(&mut self, first_ns: i64, columns: &[&[f64]]) {
        let rows = columns.first().map_or(0, |c| c.len());
        let step_ns = self.step_ns;
        let time_ns = |row: usize| first_ns + row as i64 * step_ns;
        let mut row = 0;
        while row < rows {
            let number = time_ns(row).div_euclid(self.interval_ns);
            let left_ns = (number + 1) * self.interval_ns - time_ns(row);
            let end = rows.min(row + ((left_ns + step_ns - 1) / step_ns) as usize);
            if self.intervals.last().is_none_or(|last| last.number != number) {
                if self.intervals.len() == MOST_INTERVALS {
                    self.double();
                    continue;
                }
                self.begin(number);
            }
            let part: Vec<&[f64]> = columns.iter().map(|c| &c[row..end]).collect();
            self.add(&part);
            row = end;
        }
    }

    fn begin(&mut self, number: i64) {
        let products = self.columns.iter().map(|c| c.len() * (c.len() + 1) / 2).sum();
        let (sums, products) = (vec![0.0; self.width], vec![0.0; products]);
        self.intervals.push(Interval { number, count: 0, sums, products });
    }

    /// Adds rows to the last interval, one after the other: sums do not depend on how they came.
    fn add(&mut self, columns: &[&[f64]]) {
        let Some(to) = self.intervals.last_mut() else { return };
        to.count += columns.first().map_or(0, |c| c.len()) as u64;
        for (sum, column) in to.sums.iter_mut().zip(columns) {
            column.iter().for_each(|x| *sum += x);
        }
        let mut products = to.products.iter_mut();
        for own in &self.columns {
            for (i, a) in own.iter().enumerate() {
                for (b, product) in own[i..].iter().zip(&mut products) {
                    columns[*a].iter().zip(columns[*b]).for_each(|(x, y)| *product += x * y);
                }
            }
        }
    }

    /// Makes one interval of each two neighbours.
    fn double(&mut self) {
        self.interval_ns *= 2;
        for mut next in std::mem::take(&mut self.intervals) {
            next.number = next.number.div_euclid(2);
            match self.intervals.last_mut().filter(|last| last.number == next.number) {
                Some(last) => {
                    last.count += next.count;
                    last.sums.iter_mut().zip(next.sums).for_each(|(to, x)| *to += x);
                    last.products.iter_mut().zip(next.products).for_each(|(to, x)| *to += x);
                }
                None => self.intervals.push(next),
            }
        }
    }

    /// Visits all of it, as part of the state of a stage with these columns.
    ///
    /// # Errors
    /// What is loaded are no intervals in the order of time.
    pub fn visit(&mut self, state: &mut State<'_>) -> Result<(), StateError> {
        state.i64(&mut self.interval_ns)?;
        let doublings = self.interval_ns / FIRST_INTERVAL_NS;
        if self.interval_ns % FIRST_INTERVAL_NS != 0 || !(1..=MOST_DOUBLED).contains(&doublings) {
            return Err(StateError::Content("the length of an interval of residuals"));
        }
        let count = state.count(self.intervals.len())?;
        if count > MOST_INTERVALS {
            return Err(StateError::Content("intervals of residuals"));
        }
        if state.is_loading() {
            self.intervals.clear();
        }
        for k in 0..count {
            if state.is_loading() {
                self.begin(0);
            }
            let interval = &mut self.intervals[k];
            state.i64(&mut interval.number)?;
            state.u64(&mut interval.count)?;
            state.f64s(&mut interval.sums)?;
            state.f64s(&mut interval.products)?;
        }
        let in_order = self.intervals.windows(2).all(|pair| pair[0].number < pair[1].number);
        let is_time = |i: &Interval| i.number.checked_add(1).and_then(|n| n.checked_mul(self.interval_ns)).is_some();
        if !in_order || !self.intervals.iter().all(is_time) {
            return Err(StateError::Content("the order of intervals of residuals"));
        }
        Ok(())
    }

    /// The residuals at `theta`, in the order of time, less their mean: no fit sees a constant, such as the gravity of
    /// the spacecraft. Intervals of which less than half has data are left out.
    pub fn at(&self, layout: &Layout, theta: &[f64]) -> Vec<Means> {
        let linear = layout.linear_at(theta);
        let channels = layout.channels.len();
        let mut weights = DMatrix::zeros(channels, self.width);
        (0..channels).for_each(|c| weights[(c, c)] = 1.0);
        for r in &linear.regressors {
            weights[(r.channel, channels + r.series)] -= r.factor * theta[r.coefficient];
        }
        let whole = (self.interval_ns / self.step_ns).max(1) as u64;
        let enough = self.intervals.iter().filter(|i| 2 * i.count >= whole);
        let sum = |c: usize, i: &Interval| self.columns[c].iter().map(|j| weights[(c, *j)] * i.sums[*j]).sum::<f64>();
        let samples = enough.clone().map(|i| i.count).sum::<u64>().max(1) as f64;
        let constant: Vec<f64> =
            (0..channels).map(|c| enough.clone().map(|i| sum(c, i)).sum::<f64>() / samples).collect();
        enough
            .map(|interval| {
                let count = interval.count as f64;
                let mut products = interval.products.iter();
                let mut square = |c: usize| {
                    let mut sum = 0.0;
                    for (i, a) in self.columns[c].iter().enumerate() {
                        for (k, (b, product)) in self.columns[c][i..].iter().zip(&mut products).enumerate() {
                            let twice = if k == 0 { 1.0 } else { 2.0 };
                            sum += twice * weights[(c, *a)] * weights[(c, *b)] * product;
                        }
                    }
                    sum / count
                };
                let raw: Vec<f64> = (0..channels).map(|c| sum(c, interval) / count).collect();
                let rms = |c: usize| (square(c) - constant[c] * (2.0 * raw[c] - constant[c])).max(0.0).sqrt();
                Means {
                    time_ns: interval.number * self.interval_ns + self.interval_ns / 2,
                    count: interval.count,
                    rms: (0..channels).map(rms).collect(),
                    mean: raw.iter().zip(&constant).map(|(mean, constant)| mean - constant).collect(),
                }
            })
            .collect()
    }

    /// The noise that the residuals have where the model is right.
    pub fn noise(&self, model: &NoiseModel) -> MeanNoise {
        let rate_hz = 1e9 / self.step_ns as f64;
        let span_s = match (self.intervals.first(), self.intervals.last()) {
            (Some(first), Some(last)) => (last.number + 1 - first.number) as f64 * self.interval_ns as f64 * 1e-9,
            _ => 1.0 / rate_hz,
        };
        MeanNoise::new(model, rate_hz, span_s)
    }
}

/// Standard deviations of means of noise.
#[derive(Clone, Debug)]
pub struct MeanNoise {
    rate_hz: f64,
    span_s: f64,
    /// Logarithms of frequencies, Hz, and at each the one-sided power spectral density of every channel.
    psd: Vec<(f64, Vec<f64>)>,
}

impl MeanNoise {
    /// Of samples at `rate_hz` over `span_s`: slower noise than once in that time is a constant, which counts for
    /// nothing.
    fn new(model: &NoiseModel, rate_hz: f64, span_s: f64) -> Self {
        let (low, high) = ((1.0 / span_s).min(0.25 * rate_hz).ln(), (0.5 * rate_hz).ln());
        let at = |k: usize| {
            let log = low + (high - low) * k as f64 / (FREQUENCIES - 1) as f64;
            (log, model.psd(log.exp()).diagonal().iter().copied().collect())
        };
        Self { rate_hz, span_s, psd: (0..FREQUENCIES).map(at).collect() }
    }

    /// σ of the mean of `count` samples in a row, per channel, unit of the channel: the root of
    /// `∫ S(f) sin²(πfnΔ)/(n² sin²(πfΔ)) df`, from once in the time of all data up to half the sampling rate.
    pub fn sigma(&self, count: u64) -> Vec<f64> {
        let (n, dt_s) = (count as f64, 1.0 / self.rate_hz);
        let channels = self.psd.first().map_or(0, |(_, psd)| psd.len());
        let mut sum = vec![0.0; channels];
        // A kernel that swings once in 1/(nΔ) needs steps that are a part of that; slower noise, equal ratios.
        let (low, high) = ((1.0 / self.span_s).min(0.25 * self.rate_hz), 0.5 * self.rate_hz);
        let (fine, mut from, mut entry) = (1.0 / (8.0 * n * dt_s), low, 0);
        while from < high {
            let to = (from + fine.min(0.05 * from).max(1e-3 * fine)).min(high);
            let f = 0.5 * (from + to);
            let single = (PI * f * dt_s).sin();
            let kernel = ((PI * f * n * dt_s).sin() / (n * single)).powi(2);
            let log = f.ln();
            while entry + 2 < self.psd.len() && self.psd[entry + 1].0 < log {
                entry += 1;
            }
            let ((a, left), (b, right)) = (&self.psd[entry], &self.psd[entry + 1]);
            let part = (log - a) / (b - a);
            for (sum, (left, right)) in sum.iter_mut().zip(left.iter().zip(right)) {
                *sum += (left + (right - left) * part) * kernel * (to - from);
            }
            from = to;
        }
        sum.into_iter().map(f64::sqrt).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::spectra::Regressor;
    use dragfree_schema::{NoiseProcess, NoiseResponse, NoiseShape, state};

    const STEP_NS: i64 = 100_000_000;

    fn layout() -> Layout {
        let regressor = |coefficient, channel, series, factor, times| Regressor {
            coefficient,
            channel,
            series,
            factor,
            times,
            in_loop: false,
        };
        Layout {
            channels: vec!["a".into(), "b".into()],
            series: vec!["s".into(), "t".into()],
            regressors: vec![
                regressor(0, 0, 0, 2.0, None),
                regressor(0, 0, 1, 1.0, Some(1)),
                regressor(1, 0, 1, -1.0, None),
                regressor(1, 1, 0, 0.5, None),
            ],
            coefficients: vec!["p".into(), "q".into()],
        }
    }

    fn noise(rows: usize, seed: u64) -> Vec<f64> {
        let mut x = seed;
        let mut next = || {
            x = x.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (x >> 11) as f64 / (1u64 << 53) as f64 - 0.5
        };
        (0..rows).map(|_| next()).collect()
    }

    fn gathered(columns: &[Vec<f64>], batch: usize) -> ResidualMeans {
        let mut all = ResidualMeans::new(&layout(), 10.0);
        for first in (0..columns[0].len()).step_by(batch) {
            let end = (first + batch).min(columns[0].len());
            let part: Vec<&[f64]> = columns.iter().map(|c| &c[first..end]).collect();
            all.push(7 * STEP_NS + first as i64 * STEP_NS, &part);
        }
        all
    }

    /// Rows one by one against the sums, in data so long that intervals were doubled twice.
    #[test]
    fn means_are_those_of_the_residuals_row_by_row() {
        let rows = 250_000;
        let mut columns: Vec<Vec<f64>> = (1..5).map(|seed| noise(rows, seed)).collect();
        // A constant is no residual.
        columns[0].iter_mut().for_each(|x| *x += 0.2);
        let (p, q) = (0.7, -1.3);
        let residual = |row: usize| {
            let [a, b, s, t] = [0, 1, 2, 3].map(|c| columns[c][row]);
            [a - 2.0 * p * s - p * q * t + q * t, b - 0.5 * q * s]
        };
        let whole = gathered(&columns, 1000);
        let means = whole.at(&layout(), &[p, q]);
        assert_eq!(whole.interval_ns, 8 * FIRST_INTERVAL_NS);
        assert!((1000..=MOST_INTERVALS).contains(&means.len()), "{}", means.len());
        let left_out = rows as u64 - means.iter().map(|m| m.count).sum::<u64>();
        assert!(left_out < 75, "{left_out}: less than half of the last interval");
        let kept = rows - left_out as usize;
        let constant = [0, 1].map(|c| (0..kept).map(|row| residual(row)[c]).sum::<f64>() / kept as f64);
        let mut row = 0;
        for m in &means {
            let own: Vec<[f64; 2]> = (row..row + m.count as usize)
                .map(|row| residual(row).into_iter().zip(constant).map(|(r, c)| r - c).collect::<Vec<_>>())
                .map(|r| [r[0], r[1]])
                .collect();
            let times = [row, row + own.len() - 1].map(|k| (7 + k as i64) * STEP_NS);
            assert!(times.iter().all(|t| (t - m.time_ns).abs() <= whole.interval_ns / 2), "{times:?}");
            for c in 0..2 {
                let mean = own.iter().map(|r| r[c]).sum::<f64>() / own.len() as f64;
                let square = own.iter().map(|r| r[c] * r[c]).sum::<f64>() / own.len() as f64;
                assert!((m.mean[c] - mean).abs() < 1e-12, "{} {mean}", m.mean[c]);
                assert!((m.rms[c] - square.sqrt()).abs() < 1e-12, "{} {square}", m.rms[c]);
            }
            row += own.len();
        }
        for batch in [1, 77, rows] {
            assert_eq!(gathered(&columns, batch).at(&layout(), &[p, q]), means, "{batch}");
        }
    }

    /// Saved and loaded into a new run they go on as if nothing had been; what is no state of them is refused.
    #[test]
    fn a_state_goes_on_where_it_was() {
        let columns: Vec<Vec<f64>> = (1..5).map(|seed| noise(60_000, seed)).collect();
        let part = |from: usize, to: usize| -> Vec<&[f64]> { columns.iter().map(|c| &c[from..to]).collect() };
        let mut first = ResidualMeans::new(&layout(), 10.0);
        first.push(0, &part(0, 45_000));
        let visit = |means: &mut ResidualMeans, state: &mut State<'_>| means.visit(state);
        let bytes = state::save("test", 1, |state| visit(&mut first, state)).expect("saved");
        let mut second = ResidualMeans::new(&layout(), 10.0);
        state::load("test", 1, &bytes, |state| visit(&mut second, state)).expect("loaded");
        for means in [&mut first, &mut second] {
            means.push(45_000 * STEP_NS, &part(45_000, 60_000));
        }
        assert_eq!(first.at(&layout(), &[0.3, 0.1]), second.at(&layout(), &[0.3, 0.1]));
        first.intervals.swap(3, 4);
        let bytes = state::save("test", 1, |state| visit(&mut first, state));
        assert!(bytes.is_err(), "out of order");
        first.intervals.swap(3, 4);
        first.interval_ns = 7;
        assert!(state::save("test", 1, |state| visit(&mut first, state)).is_err(), "no such interval");
    }

    #[test]
    fn an_interval_with_little_data_is_left_out() {
        let columns: Vec<Vec<f64>> = (1..5).map(|seed| noise(25, seed)).collect();
        let counts: Vec<u64> = gathered(&columns, 25).at(&layout(), &[0.0, 0.0]).iter().map(|m| m.count).collect();
        // From 0.7 s: 12 rows before 1.875 s, the 13 left are from 1.9 s on.
        assert_eq!(counts, [12, 13]);
        let columns: Vec<Vec<f64>> = columns.iter().map(|c| c[..15].to_vec()).collect();
        assert_eq!(gathered(&columns, 25).at(&layout(), &[0.0, 0.0]).len(), 1);
    }

    /// Of white noise σ/√n. Of second differences of it all but the ends cancels: 2σ/(nΔ²).
    #[test]
    fn sigma_of_a_mean_is_that_of_its_noise() {
        let process = |response| NoiseProcess {
            name: "n".to_owned(),
            spectrum: Some(NoiseShape::white(3.0)),
            response,
            enters: [("a".to_owned(), vec![1.0])].into(),
            ..NoiseProcess::default()
        };
        let (rate_hz, dt_s) = (10.0_f64, 0.1_f64);
        let single = 3.0_f64 * (0.5 * rate_hz).sqrt();
        for (response, count, expected) in [
            (NoiseResponse::Direct, 1, single),
            (NoiseResponse::Direct, 300, single / 300.0_f64.sqrt()),
            (NoiseResponse::Differenced, 1, single * 6.0_f64.sqrt() / dt_s.powi(2)),
            (NoiseResponse::Differenced, 300, 2.0 * single / (300.0 * dt_s.powi(2))),
        ] {
            let model = NoiseModel::new(&[process(response)], &["a"], dt_s).expect("a model");
            let sigma = MeanNoise::new(&model, rate_hz, 86_400.0).sigma(count)[0];
            assert!((sigma / expected - 1.0).abs() < 3e-3, "{response:?} {count}: {sigma} for {expected}");
        }
    }
}
