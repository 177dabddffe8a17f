//! Housekeeping as witness: which channel of the telemetry is coherent with what nobody explains.
//!
//! For each housekeeping value, its derivative, its square and the products of two, the complex cross-spectrum with the residuals
//! is summed over segments, in wide bands below [`crate::gather::SLOW_HZ`]. A lag between cause and force turns the phase and leaves
//! the coherence. For n complex observations without relation `−2n log(1 − |γ|²)` is χ² with two degrees of freedom (Goodman 1957).

use dragfree_estimation::spectra::{FIRST_BIN, Plan, Transformer};
use nalgebra::{DMatrix, DMatrixView};
use serde::{Deserialize, Serialize};

use crate::gather::SLOW_HZ;

/// Ratio of the ends of a band.
const RATIO: f64 = 1.6;

/// With more channels of housekeeping than this their products are too many to try.
const MOST_FOR_PRODUCTS: usize = 100;

/// Segments of Hann windows that overlap by half are worth this part of their number.
const WORTH: f64 = 0.53;

/// What may drive a force.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Driver {
    /// A value.
    Value(usize),
    /// Its derivative.
    Derivative(usize),
    /// Its square.
    Square(usize),
    /// The product of two, each about where it began.
    Product(usize, usize),
}

/// A driver, and how coherent it is with a channel's residual.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Coherence {
    /// The driver in words, `hk/battery_current_a^2`.
    pub driver: String,
    /// Housekeeping channels in it.
    pub of: Vec<String>,
    /// Channel.
    pub channel: String,
    /// `−2n log(1 − |γ|²)` over all bands.
    pub statistic: f64,
    /// Its degrees of freedom.
    pub dof: f64,
    /// Part of the residual's power that is coherent, in the band where that is largest.
    pub explained: f64,
    /// That band, Hz.
    pub band_hz: [f64; 2],
}

/// The sums.
#[derive(Clone, Debug, PartialEq)]
pub struct Witnesses {
    pub(crate) names: Vec<String>,
    pub(crate) drivers: Vec<Driver>,
    /// Residual of each channel as a combination of the base columns.
    pub(crate) residual: DMatrix<f64>,
    /// Bands in bins of a segment.
    pub(crate) bands: Vec<[usize; 2]>,
    pub(crate) bin_hz: f64,
    /// Level from which products count, per channel of housekeeping; none before the first segment.
    pub(crate) level: Vec<f64>,
    /// Per band and channel: power of the residual.
    pub(crate) residual_power: DMatrix<f64>,
    /// Per driver and band: its power.
    pub(crate) power: DMatrix<f64>,
    /// Per driver, a column per band and channel: real and imaginary parts of the cross-spectrum.
    pub(crate) cross: [DMatrix<f64>; 2],
    pub(crate) segments: u64,
}

impl Witnesses {
    /// For housekeeping of these names, segments of `length` samples and residuals made by `residual` (channels × base columns).
    #[must_use]
    pub fn new(names: Vec<String>, length: usize, rate_hz: f64, residual: DMatrix<f64>) -> Self {
        let n = names.len();
        let mut drivers: Vec<Driver> =
            (0..n).flat_map(|i| [Driver::Value(i), Driver::Derivative(i), Driver::Square(i)]).collect();
        if n <= MOST_FOR_PRODUCTS {
            drivers.extend((0..n).flat_map(|i| (0..i).map(move |j| Driver::Product(j, i))));
        }
        let bin_hz = rate_hz / length as f64;
        let last = ((SLOW_HZ / bin_hz) as usize).min(length / block(length, rate_hz) / 2);
        let mut bands = Vec::new();
        let mut first = FIRST_BIN;
        while first < last {
            let end = ((first as f64 * RATIO).ceil() as usize).max(first + 1).min(last);
            bands.push([first, end]);
            first = end;
        }
        let channels = residual.nrows();
        let wide = bands.len() * channels;
        Self {
            level: vec![f64::NAN; n],
            residual_power: DMatrix::zeros(bands.len(), channels),
            power: DMatrix::zeros(drivers.len(), bands.len()),
            cross: [DMatrix::zeros(drivers.len(), wide), DMatrix::zeros(drivers.len(), wide)],
            segments: 0,
            names,
            drivers,
            residual,
            bands,
            bin_hz,
        }
    }

    /// Adds the sums of other segments with the same housekeeping.
    pub fn add(&mut self, other: &Self) {
        if self.names != other.names || self.bands != other.bands {
            return;
        }
        self.residual_power += &other.residual_power;
        self.power += &other.power;
        self.cross.iter_mut().zip(&other.cross).for_each(|(a, b)| *a += b);
        self.segments += other.segments;
    }

    /// A segment: housekeeping sample by sample, spectra of the base columns.
    pub fn segment(&mut self, plan: &Plan, housekeeping: &[&[f64]], base: &DMatrixView<'_, f64>) {
        let (Some(last), false) = (self.bands.last().copied(), self.names.is_empty()) else { return };
        let block = block(plan.length, plan.rate_hz);
        let coarse = Plan::new(plan.length / block, plan.rate_hz / block as f64);
        let mut transformer = Transformer::new(&coarse);
        let means =
            |x: &[f64]| -> Vec<f64> { x.chunks_exact(block).map(|c| c.iter().sum::<f64>() / block as f64).collect() };
        let values: Vec<Vec<f64>> = housekeeping.iter().map(|x| means(x)).collect();
        for (level, x) in self.level.iter_mut().zip(&values).filter(|(level, _)| level.is_nan()) {
            *level = x.iter().sum::<f64>() / x.len() as f64;
        }
        let residual = base.rows(0, 2 * (last[1] - FIRST_BIN)) * self.residual.transpose();
        let channels = self.residual.nrows();
        for (b, [first, end]) in self.bands.iter().enumerate() {
            for c in 0..channels {
                let part = residual.view((2 * (first - FIRST_BIN), c), (2 * (end - first), 1));
                self.residual_power[(b, c)] += part.norm_squared();
            }
        }
        let mut spectrum = vec![0.0; coarse.length];
        for (d, driver) in self.drivers.iter().enumerate() {
            let samples = driver.samples(&values, &self.level);
            transformer.transform(&coarse, 0, &samples, &mut spectrum);
            for (b, [first, end]) in self.bands.iter().enumerate() {
                let range = 2 * (first - FIRST_BIN)..2 * (end - FIRST_BIN);
                let own = &spectrum[range.clone()];
                self.power[(d, b)] += own.iter().map(|x| x * x).sum::<f64>();
                for c in 0..channels {
                    let (mut re, mut im) = (0.0, 0.0);
                    for (s, r) in own
                        .chunks_exact(2)
                        .zip(residual.as_slice()[c * residual.nrows()..][range.clone()].chunks_exact(2))
                    {
                        re += s[0] * r[0] + s[1] * r[1];
                        im += s[0] * r[1] - s[1] * r[0];
                    }
                    let column = b * channels + c;
                    self.cross[0][(d, column)] += re;
                    self.cross[1][(d, column)] += im;
                }
            }
        }
        self.segments += 1;
    }

    /// How coherent each driver is with the residual of each channel, the most coherent first.
    #[must_use]
    pub fn coherences(&self, channels: &[String]) -> Vec<Coherence> {
        let mut all = Vec::new();
        for (d, driver) in self.drivers.iter().enumerate() {
            for (c, channel) in channels.iter().enumerate() {
                let (mut statistic, mut dof, mut explained, mut band_hz) = (0.0, 0.0, 0.0, [0.0; 2]);
                for (b, [first, end]) in self.bands.iter().enumerate() {
                    let n = WORTH * (self.segments + 1) as f64 * (end - first) as f64;
                    let power = self.power[(d, b)] * self.residual_power[(b, c)];
                    if n < 2.0 || power <= 0.0 {
                        continue;
                    }
                    let column = b * channels.len() + c;
                    let squared = (self.cross[0][(d, column)].powi(2) + self.cross[1][(d, column)].powi(2)) / power;
                    // Of n observations the squared coherence is 1/n without any relation.
                    statistic -= 2.0 * n * (-squared.min(1.0 - 1e-12)).ln_1p();
                    dof += 2.0;
                    if squared - 1.0 / n > explained {
                        explained = squared - 1.0 / n;
                        band_hz = [*first as f64 * self.bin_hz, (*end - 1) as f64 * self.bin_hz];
                    }
                }
                if dof > 0.0 {
                    let of = driver.of().iter().map(|i| self.names[*i].clone()).collect();
                    let driver = driver.label(&self.names);
                    all.push(Coherence { driver, of, channel: channel.clone(), statistic, dof, explained, band_hz });
                }
            }
        }
        all.sort_by(|a, b| b.statistic.total_cmp(&a.statistic));
        all
    }

    /// Drivers that were tried.
    #[must_use]
    pub fn tried(&self) -> usize {
        self.drivers.len()
    }
}

/// Samples that are averaged: a power of two, so that twice [`SLOW_HZ`] stays below Nyquist.
fn block(length: usize, rate_hz: f64) -> usize {
    let mut block = 1;
    while length.is_multiple_of(8 * block) && rate_hz / (2.0 * (2 * block) as f64) > 1.5 * SLOW_HZ {
        block *= 2;
    }
    block
}

impl Driver {
    fn of(self) -> Vec<usize> {
        match self {
            Self::Value(i) | Self::Derivative(i) | Self::Square(i) => vec![i],
            Self::Product(i, j) => vec![i, j],
        }
    }

    fn label(self, names: &[String]) -> String {
        match self {
            Self::Value(i) => names[i].clone(),
            Self::Derivative(i) => format!("d/dt {}", names[i]),
            Self::Square(i) => format!("{}^2", names[i]),
            Self::Product(i, j) => format!("{} * {}", names[i], names[j]),
        }
    }

    fn samples(self, values: &[Vec<f64>], level: &[f64]) -> Vec<f64> {
        match self {
            Self::Value(i) => values[i].clone(),
            Self::Derivative(i) => {
                let x = &values[i];
                (0..x.len()).map(|k| x[(k + 1).min(x.len() - 1)] - x[k.saturating_sub(1)]).collect()
            }
            Self::Square(i) => values[i].iter().map(|x| x * x).collect(),
            Self::Product(i, j) => {
                values[i].iter().zip(&values[j]).map(|(x, y)| (x - level[i]) * (y - level[j])).collect()
            }
        }
    }
}
