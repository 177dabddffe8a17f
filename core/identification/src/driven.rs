//! Forces that follow a function of housekeeping: which function explains the residual of a channel best, over the whole
//! of each product.
//!
//! A slow cause shows most below the lowest frequency of the segments of [`crate::gram`], where heat, currents and what
//! they heat change from hour to hour. Here residuals and housekeeping are kept as samples some hundred seconds apart. A
//! channel is taken given the others, `y = gᵀ r` with `g = Σ⁻¹ e_c / (Σ⁻¹)_cc`: the thrusters' noise, which moves all
//! test masses, is gone from it, and a force along the channel is not. With the covariance of its declared noise the
//! amplitude of a function is that of generalised least squares beside powers of time. What is faster than these samples
//! comes from the cross-spectra of [`crate::coherence`]. The amplitude a is one, the level of the noise one in each band
//! and one of the samples: with n numbers of power P before and P(a) after, the likelihood rises by `½ Σ n log(P/P(a))`.

use std::collections::{BTreeMap, BTreeSet};

use dragfree_estimation::sigma::NoiseModel;
use nalgebra::{Cholesky, Complex, DMatrix, DVector};

use crate::candidates::{Candidate, CandidateSet, Form};
use crate::coherence::{Driver, HousekeepingCoherence, Part};
use crate::decimate::Decimator;

/// Distance of samples, s; a multiple of it where there would be more than [`MOST`] in a product.
const STEP_S: f64 = 100.0;

/// Most samples of a product in a fit, whose cost grows with their square.
const MOST: usize = 432;

/// Powers of time beside every function, from the zeroth.
const POWERS: usize = 3;

/// Ratio of the lags that are tried before the best is refined.
const RATIO: f64 = 2.0;

/// Steps of the golden section that refines a lag, each by 0.618: to a per cent.
const LAG_STEPS: usize = 10;

/// Rounds in which amplitude and levels of the noise follow each other: what is explained is a part of the power, and
/// the error of the levels falls by that part in each round.
const LEVEL_ROUNDS: usize = 10;

/// Functions of one housekeeping channel, and products, that are given for a channel.
const ALTERNATIVES: usize = 2;

/// Part of the power of a function that is rounding.
const OWN: f64 = 1e-9;

/// Frequencies in the integral of a covariance, per 1/T.
const FINENESS: f64 = 4.0;

/// What lies between a cause and its force.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Memory {
    /// Nothing.
    None,
    /// A first-order lag, s.
    Lag(f64),
    /// The force follows the integral of the cause.
    Integral,
}

/// A channel's residual as a multiple of a function of housekeeping.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Driven {
    /// Index of the channel.
    pub channel: usize,
    /// The function.
    pub driver: Driver,
    /// What lies between it and the force.
    pub memory: Memory,
    /// Twice the rise of the logarithm of the likelihood.
    pub gain: f64,
}

/// Samples without a gap.
#[derive(Clone, Debug, Default, PartialEq)]
struct Stretch {
    first_ns: i64,
    /// By channel.
    residual: Vec<Vec<f64>>,
    /// Series of candidates, by index of the column after those of the model.
    series: Vec<Vec<f64>>,
    housekeeping: Vec<Vec<f64>>,
}

impl Stretch {
    fn columns(&self) -> Vec<&[f64]> {
        self.residual.iter().chain(&self.series).chain(&self.housekeeping).map(Vec::as_slice).collect()
    }

    /// Of columns in that order, with as many residuals and series as here.
    fn with(&self, first_ns: i64, mut columns: Vec<Vec<f64>>) -> Self {
        let housekeeping = columns.split_off(self.residual.len() + self.series.len());
        let series = columns.split_off(self.residual.len());
        Self { first_ns, residual: columns, series, housekeeping }
    }
}

impl Stretch {
    fn len(&self) -> usize {
        self.residual.first().map_or(0, Vec::len)
    }
}

/// Slow samples of residuals and housekeeping, by product.
#[derive(Clone, Debug, PartialEq)]
pub struct SlowSamples {
    names: Vec<String>,
    units: Vec<String>,
    step_s: f64,
    /// Columns of the model.
    base: usize,
    products: Vec<Vec<Stretch>>,
}

/// Makes them of samples that come more often.
#[derive(Debug)]
pub(crate) struct Thinner {
    decimator: Decimator,
    residual: DMatrix<f64>,
    samples: SlowSamples,
}

impl Thinner {
    /// For samples every `step_ns`, residuals as combinations (channels × base columns), and housekeeping of these names
    /// and units.
    pub(crate) fn new(
        names: Vec<String>,
        units: Vec<String>,
        step_ns: i64,
        residual: DMatrix<f64>,
        columns: usize,
    ) -> Self {
        let factor = ((1e9 * STEP_S / step_ns as f64).round() as usize).max(1);
        let base = residual.ncols();
        let decimator = Decimator::new(factor, residual.nrows() + columns - base + names.len(), step_ns, 1);
        let step_s = 1e-9 * decimator.step_ns() as f64;
        let samples = SlowSamples { names, units, step_s, base, products: vec![vec![Stretch::default()]] };
        Self { decimator, residual, samples }
    }

    /// Samples of all columns, and after them of housekeeping, at these times.
    pub(crate) fn push(&mut self, times: &[i64], columns: &[&[f64]]) {
        let Some(&first_ns) = times.first() else { return };
        let (base, rest) = columns.split_at(self.samples.base);
        let residual = |row: usize| -> Vec<f64> {
            let of = |k: usize| self.residual.row(row).iter().zip(base).map(|(a, x)| a * x[k]).sum();
            (0..times.len()).map(of).collect()
        };
        let residuals: Vec<Vec<f64>> = (0..self.residual.nrows()).map(residual).collect();
        let all: Vec<&[f64]> = residuals.iter().map(Vec::as_slice).chain(rest.iter().copied()).collect();
        let (times, thinned) = self.decimator.push(first_ns, &all);
        let Some(stretch) = self.samples.products.last_mut().and_then(|all| all.last_mut()) else { return };
        let Some(first_ns) = times.first() else { return };
        if stretch.len() == 0 {
            let series = vec![Vec::new(); rest.len() - self.samples.names.len()];
            let empty = Stretch { residual: vec![Vec::new(); residuals.len()], series, ..Stretch::default() };
            *stretch = empty.with(*first_ns, thinned);
            return;
        }
        let own = stretch.residual.iter_mut().chain(&mut stretch.series).chain(&mut stretch.housekeeping);
        own.zip(&thinned).for_each(|(all, new)| all.extend_from_slice(new));
    }

    /// The run has ended.
    pub(crate) fn gap(&mut self) {
        self.decimator.gap();
        if let Some(all) = self.samples.products.last_mut() {
            all.push(Stretch::default());
        }
    }

    /// No samples.
    pub(crate) fn nothing(&self) -> SlowSamples {
        SlowSamples { products: Vec::new(), ..self.samples.clone() }
    }

    pub(crate) fn finish(mut self) -> SlowSamples {
        self.samples.products.iter_mut().for_each(|all| all.retain(|stretch| stretch.len() > POWERS));
        self.samples
    }
}

/// Whitened samples of a channel, from which powers of time are taken off.
struct Whitened {
    /// Lower Cholesky factors of the covariance, by stretch.
    factors: Vec<DMatrix<f64>>,
    /// Part of each channel in the combination.
    gains: DVector<f64>,
    /// Orthonormal powers of time of all products, and what is added to the model.
    beside: DMatrix<f64>,
    y: DVector<f64>,
}

impl SlowSamples {
    /// Adds other products with the same housekeeping.
    pub fn add(&mut self, other: &Self) {
        self.products.extend(other.products.iter().cloned());
    }

    /// Functions that are tried for each channel by [`Self::driven`].
    pub fn functions(&self, housekeeping: &HousekeepingCoherence) -> usize {
        self.forms(housekeeping).len()
    }

    fn forms(&self, housekeeping: &HousekeepingCoherence) -> Vec<(Driver, Memory)> {
        let memories = self.memories();
        let with = |driver: &Driver| {
            let all = if driver.factors().is_empty() { &memories[..] } else { &[Memory::None] };
            all.iter().map(|memory| (*driver, *memory)).collect::<Vec<_>>()
        };
        housekeeping.drivers.iter().flat_map(with).collect()
    }

    /// Lags from the distance of samples to the length of the longest stretch.
    fn memories(&self) -> Vec<Memory> {
        let longest = self.products.iter().flatten().map(Stretch::len).max().unwrap_or(0) as f64;
        let count = longest.max(1.0).log2() as i32;
        let lags = (0..count).map(|k| Memory::Lag(self.step_s * RATIO.powi(k)));
        [Memory::None, Memory::Integral].into_iter().chain(lags).collect()
    }

    /// For each of some channels the functions of housekeeping that explain most of its residual, the best first, no
    /// two of the same housekeeping: some that explain more than the best of as many would by chance. `noise` is that
    /// of the channels.
    pub fn driven(&self, channels: &[usize], noise: &NoiseModel, housekeeping: &HousekeepingCoherence) -> Vec<Driven> {
        let (thin, means_s) = self.thinned();
        let forms = thin.forms(housekeeping);
        let chance = 2.0 * ((forms.len() * channels.len()) as f64).ln();
        let mut all = Vec::new();
        for channel in channels {
            let Some(whitened) = thin.whitened(*channel, noise, &means_s) else { continue };
            let search = Search { samples: &thin, housekeeping, channel: *channel, whitened };
            let gains = search.gains(&forms);
            let mut order: Vec<usize> = (0..forms.len()).filter(|i| gains[*i] > chance).collect();
            order.sort_by(|a, b| gains[*b].total_cmp(&gains[*a]));
            // A product with what hardly changes is its other factor, slightly better by chance: each kind has its own.
            let mut of: Vec<Vec<usize>> = Vec::new();
            for i in order {
                let own = forms[i].0.of();
                let alike = of.iter().filter(|other| other.len() == own.len()).count();
                if alike < ALTERNATIVES && !of.contains(&own) {
                    of.push(own);
                    all.push(search.refined(forms[i]));
                }
            }
        }
        all
    }

    /// With no more samples in a product than [`MOST`], and the lengths of the running means that they have passed, s.
    fn thinned(&self) -> (Self, Vec<f64>) {
        let longest = self.products.iter().map(|all| all.iter().map(Stretch::len).sum::<usize>()).max().unwrap_or(0);
        let factor = longest.div_ceil(MOST);
        if factor <= 1 {
            return (self.clone(), vec![self.step_s]);
        }
        let step_ns = (1e9 * self.step_s).round() as i64;
        let thin = |stretch: &Stretch| {
            let columns = stretch.columns();
            let mut decimator = Decimator::new(factor, columns.len(), step_ns, 1);
            let (times, thinned) = decimator.push(stretch.first_ns, &columns);
            stretch.with(times.first().copied().unwrap_or_default(), thinned)
        };
        let product = |all: &Vec<Stretch>| all.iter().map(thin).filter(|s| s.len() > POWERS).collect();
        let step_s = self.step_s * factor as f64;
        let thin = Self {
            names: self.names.clone(),
            units: self.units.clone(),
            step_s,
            base: self.base,
            products: self.products.iter().map(product).collect(),
        };
        (thin, vec![self.step_s, step_s])
    }

    /// A channel given the others, whitened; none where its noise is unknown or there are too few samples.
    fn whitened(&self, channel: usize, noise: &NoiseModel, means_s: &[f64]) -> Option<Whitened> {
        let longest = self.products.iter().flatten().map(Stretch::len).max()?;
        // The combination that is quietest in the middle of the frequencies, in their logarithm.
        let length_s = longest as f64 * self.step_s;
        let middle_hz = (2.0 * length_s * self.step_s).sqrt().recip();
        let inverse = noise.psd(middle_hz).cholesky()?.inverse();
        let gains = inverse.column(channel) / inverse[(channel, channel)];
        let covariance = self.covariance(&gains, noise, longest, means_s);
        let factor_of = |n: usize| {
            let toeplitz = DMatrix::from_fn(n, n, |i, j| covariance[i.abs_diff(j)]);
            Some(Cholesky::new(toeplitz)?.unpack())
        };
        let stretches: Vec<&Stretch> = self.products.iter().flatten().collect();
        let factors: Vec<DMatrix<f64>> = stretches.iter().map(|s| factor_of(s.len())).collect::<Option<_>>()?;
        let rows: usize = stretches.iter().map(|s| s.len()).sum();
        let (mut y, mut powers) = (DVector::zeros(rows), DMatrix::zeros(rows, POWERS * self.products.len()));
        let mut first = 0;
        for (product, all) in self.products.iter().enumerate() {
            let start_ns = all.first().map_or(0, |s| s.first_ns);
            for stretch in all {
                for k in 0..stretch.len() {
                    let of = |(r, gain): (&Vec<f64>, &f64)| gain * r[k];
                    y[first + k] = stretch.residual.iter().zip(gains.iter()).map(of).sum();
                    let days = (1e-9 * (stretch.first_ns - start_ns) as f64 + k as f64 * self.step_s) / 86_400.0;
                    (0..POWERS).for_each(|p| powers[(first + k, POWERS * product + p)] = days.powi(p as i32));
                }
                first += stretch.len();
            }
        }
        let mut whitened = Whitened { factors, gains, beside: powers, y };
        whitened.beside = whitened.whiten(&whitened.beside)?.qr().q();
        let y = whitened.whiten(&DMatrix::from_column_slice(rows, 1, whitened.y.as_slice()))?;
        whitened.y = whitened.left(&y).column(0).into_owned();
        (rows > whitened.beside.ncols() + 1).then_some(whitened)
    }

    /// Covariance of the noise of a combination of channels by the distance of samples.
    fn covariance(&self, gains: &DVector<f64>, noise: &NoiseModel, longest: usize, means_s: &[f64]) -> Vec<f64> {
        let length_s = longest as f64 * self.step_s;
        let step_hz = (FINENESS * length_s).recip();
        // Above the rate of the samples five running means leave nothing.
        let count = (2.0 / self.step_s / step_hz) as usize;
        let power = |k: &usize| {
            let hz = (*k as f64 + 0.5) * step_hz;
            let filter: f64 = means_s.iter().map(|mean_s| sinc(std::f64::consts::PI * hz * mean_s).powi(10)).product();
            (hz, filter * gains.dot(&(noise.psd(hz) * gains)) * step_hz)
        };
        let spectrum: Vec<(f64, f64)> = (0..count).collect::<Vec<_>>().iter().map(power).collect();
        let at = |lag: usize| {
            let angle = std::f64::consts::TAU * lag as f64 * self.step_s;
            spectrum.iter().map(|(hz, power)| power * (angle * hz).cos()).sum()
        };
        (0..longest).map(at).collect()
    }

    /// Forms of candidates that the samples choose: for each place of which all forms act along one channel by slow
    /// series, the form that explains most of it beside what is `added`.
    pub fn forms_of(
        &self,
        places: &[Vec<usize>],
        set: &CandidateSet,
        fast: usize,
        added: &[Candidate],
        noise: &NoiseModel,
    ) -> Vec<Candidate> {
        let (thin, means_s) = self.thinned();
        let mut by_channel: BTreeMap<usize, Vec<&Vec<usize>>> = BTreeMap::new();
        for place in places {
            let terms = || place.iter().flat_map(|i| &set.coefficients[*i].forms).flat_map(|form| &form.terms);
            let channel = terms().next().map(|t| t.channel);
            let slow = terms().all(|t| t.column >= fast && Some(t.channel) == channel && t.times.is_none());
            let plain = place.iter().all(|i| !set.coefficients[*i].transient && set.coefficients[*i].forms.len() > 1);
            if let (Some(channel), true) = (channel, slow && plain) {
                by_channel.entry(channel).or_default().push(place);
            }
        }
        let mut chosen = Vec::new();
        for (channel, places) in by_channel {
            let Some(mut whitened) = thin.whitened(channel, noise, &means_s) else { continue };
            let parts = added.iter().flat_map(|c| &c.parts).map(|(_, form)| form);
            let acting: Vec<DVector<f64>> = parts.filter_map(|form| thin.acting(form, &whitened.gains)).collect();
            if !acting.is_empty() {
                let Some(white) = whitened.whiten(&DMatrix::from_columns(&acting)) else { continue };
                whitened.add(&white);
            }
            let columns = || places.iter().flat_map(|p| p.iter()).flat_map(|i| &set.coefficients[*i].forms);
            let used: BTreeSet<usize> = columns().flat_map(|form| &form.terms).map(|t| t.column).collect();
            let used: Vec<usize> = used.into_iter().collect();
            let plain: Vec<DVector<f64>> = used.iter().filter_map(|column| thin.column(*column)).collect();
            if plain.len() < used.len() {
                continue;
            }
            let Some(white) = whitened.whiten(&DMatrix::from_columns(&plain)) else { continue };
            let left = whitened.left(&white);
            let gain = |candidate: &Candidate| {
                let of = |(_, form): &(usize, Form)| {
                    let mut sum = DVector::zeros(whitened.y.len());
                    for t in &form.terms {
                        let at = used.binary_search(&t.column).unwrap_or(0);
                        sum.axpy(t.factor, &left.column(at), 1.0);
                    }
                    sum
                };
                let unit = |d: DVector<f64>| d.try_normalize(f64::MIN_POSITIVE);
                let d: Vec<DVector<f64>> = candidate.parts.iter().map(of).filter_map(unit).collect();
                if d.is_empty() {
                    return 0.0;
                }
                let d = DMatrix::from_columns(&d);
                let along = d.tr_mul(&whitened.y);
                d.tr_mul(&d).pseudo_inverse(OWN).map_or(0.0, |inverse| along.dot(&(inverse * &along)))
            };
            for place in places {
                let forms = 0..set.coefficients[place[0]].forms.len();
                let all = forms.map(|form| set.candidate(place, form)).map(|c| (gain(&c), c));
                chosen.extend(all.max_by(|a, b| a.0.total_cmp(&b.0)).map(|(_, c)| c));
            }
        }
        chosen
    }

    /// A series of a candidate in all stretches.
    fn column(&self, column: usize) -> Option<DVector<f64>> {
        let at = column.checked_sub(self.base)?;
        let all: Option<Vec<&Vec<f64>>> = self.products.iter().flatten().map(|s| s.series.get(at)).collect();
        Some(DVector::from_vec(all?.into_iter().flatten().copied().collect()))
    }

    /// What a unit of a form adds to a combination of channels; none where it adds nothing.
    fn acting(&self, form: &Form, gains: &DVector<f64>) -> Option<DVector<f64>> {
        let mut sum: Option<DVector<f64>> = None;
        for t in &form.terms {
            let own = self.column(t.column)? * (t.factor * gains[t.channel]);
            sum = Some(match sum {
                Some(sum) => sum + own,
                None => own,
            });
        }
        sum.filter(|s| s.norm_squared() > 0.0)
    }

    /// Samples of a function in all stretches.
    fn series(&self, driver: Driver, memory: Memory, level: &[f64]) -> Vec<f64> {
        let of = |stretch: &Stretch| {
            let columns: Vec<&[f64]> = stretch.housekeeping.iter().map(Vec::as_slice).collect();
            let mut x = driver.samples(&columns, level);
            if matches!(driver, Driver::Derivative(_)) {
                x.iter_mut().for_each(|x| *x /= 2.0 * self.step_s);
            }
            memory.behind(x, self.step_s)
        };
        self.products.iter().flatten().flat_map(of).collect()
    }

    /// Root mean square of a function about its mean, in the unit of [`Self::expression`].
    pub fn rms(&self, driver: Driver, memory: Memory, housekeeping: &HousekeepingCoherence) -> f64 {
        let series = self.series(driver, memory, &housekeeping.level);
        let n = series.len().max(1) as f64;
        let mean = series.iter().sum::<f64>() / n;
        (series.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / n).sqrt()
    }

    /// The function as the effect `formula` reads it, `lag(hk.battery_current_a^2, 120.0)`.
    pub fn expression(&self, driver: Driver, memory: Memory, housekeeping: &HousekeepingCoherence) -> String {
        let level = &housekeeping.level;
        let name = |i: usize| self.names[i].replacen("hk/", "hk.", 1);
        let about = |i: usize| {
            let sign = if level[i] < 0.0 { '+' } else { '-' };
            format!("({} {sign} {:e})", name(i), level[i].abs())
        };
        let plain = match driver {
            Driver::Value(i) => name(i),
            Driver::Derivative(i) => format!("derivative({})", name(i)),
            Driver::Square(i) => format!("{}^2", name(i)),
            Driver::Product(i, j) => format!("{} * {}", about(i), about(j)),
        };
        match memory {
            Memory::None => plain,
            Memory::Lag(lag_s) => format!("lag({plain}, {lag_s:.1})"),
            Memory::Integral => format!("integral({plain})"),
        }
    }

    /// The function in words, as among coherences.
    pub fn label(&self, driver: Driver) -> String {
        driver.label(&self.names)
    }

    /// Unit of the amplitude of a function that is an acceleration, `m s-2 A-2`.
    pub fn unit_of_amplitude(&self, driver: Driver, memory: Memory) -> String {
        let times = if matches!(driver, Driver::Square(_)) { 2 } else { 1 };
        let rate = i32::from(matches!(driver, Driver::Derivative(_)));
        let seconds = -2 + rate - i32::from(matches!(memory, Memory::Integral));
        let mut powers = vec![("m".to_owned(), 1), ("s".to_owned(), seconds)];
        let symbols = driver.of().into_iter().flat_map(|i| self.units[i].split_whitespace());
        for (symbol, power) in symbols.filter_map(symbol_and_power) {
            match powers.iter_mut().find(|(own, _)| *own == symbol) {
                Some((_, own)) => *own -= times * power,
                None => powers.push((symbol, -times * power)),
            }
        }
        let told = powers.into_iter().filter(|(_, power)| *power != 0);
        let told = told.map(|(symbol, power)| if power == 1 { symbol } else { format!("{symbol}{power}") });
        told.collect::<Vec<_>>().join(" ")
    }
}

/// `s-2` as symbol and power; none of `1`.
fn symbol_and_power(text: &str) -> Option<(String, i32)> {
    let end = text.find(|c: char| c == '-' || c.is_ascii_digit()).unwrap_or(text.len());
    let (symbol, power) = text.split_at(end);
    let power = if power.is_empty() { 1 } else { power.parse().ok()? };
    (!symbol.is_empty()).then(|| (symbol.to_owned(), power))
}

fn sinc(x: f64) -> f64 {
    if x == 0.0 { 1.0 } else { x.sin() / x }
}

impl Memory {
    /// Its frequency response.
    fn at(self, hz: f64) -> Complex<f64> {
        let omega = std::f64::consts::TAU * hz;
        match self {
            Self::None => Complex::new(1.0, 0.0),
            Self::Lag(lag_s) => Complex::new(1.0, omega * lag_s).inv(),
            Self::Integral => Complex::new(0.0, omega).inv(),
        }
    }

    /// What comes out behind it, settled at the start; between samples the cause is a straight line.
    fn behind(self, mut x: Vec<f64>, step_s: f64) -> Vec<f64> {
        match self {
            Self::None => {}
            Self::Integral => {
                let (mut sum, mut before) = (0.0, x.first().copied().unwrap_or(0.0));
                for x in &mut x {
                    sum += 0.5 * step_s * (before + *x);
                    before = std::mem::replace(x, sum);
                }
            }
            Self::Lag(lag_s) => {
                let decay = (-step_s / lag_s).exp();
                let mut before = x.first().copied().unwrap_or(0.0);
                let mut out = before;
                for x in &mut x {
                    let delay = (*x - before) * lag_s / step_s;
                    out = *x - delay + (out - before + delay) * decay;
                    before = std::mem::replace(x, out);
                }
            }
        }
        x
    }
}

/// What explains one channel.
struct Search<'a> {
    samples: &'a SlowSamples,
    housekeeping: &'a HousekeepingCoherence,
    channel: usize,
    whitened: Whitened,
}

impl Search<'_> {
    /// Gains of some functions.
    fn gains(&self, forms: &[(Driver, Memory)]) -> Vec<f64> {
        let (w, samples) = (&self.whitened, self.samples);
        let mut all = DMatrix::zeros(w.y.len(), forms.len());
        for (mut column, (driver, memory)) in all.column_iter_mut().zip(forms) {
            column.copy_from_slice(&samples.series(*driver, *memory, &self.housekeeping.level));
        }
        let Some(whole) = w.whiten(&all) else { return vec![0.0; forms.len()] };
        let own = w.left(&whole);
        let observations = 0.5 * (w.y.len() - w.beside.ncols()) as f64;
        let nyquist_hz = 0.5 / samples.step_s;
        let part = |k: usize| {
            let (d, whole) = (own.column(k), whole.column(k));
            // What powers of time explain of a function but for rounding has nothing of its own.
            let told = d.norm_squared() > OWN * whole.norm_squared();
            let (squared, along) = if told { (d.norm_squared(), d.dot(&w.y)) } else { (0.0, 0.0) };
            Part { observations, power: w.y.norm_squared(), squared, along }
        };
        let gain = |(k, (driver, memory)): (usize, &(Driver, Memory))| {
            let fast = self.housekeeping.parts(self.channel, *driver, |hz| memory.at(hz), nyquist_hz);
            gain(&[&[part(k)], &fast[..]].concat())
        };
        forms.iter().enumerate().map(gain).collect()
    }

    /// The best memory of a function, between the lags that are tried too.
    fn refined(&self, (driver, best): (Driver, Memory)) -> Driven {
        let gain = |memory: Memory| self.gains(&[(driver, memory)])[0];
        let all = self.samples.memories().into_iter().map(|memory| (memory, gain(memory)));
        let (mut memory, mut most) = all.max_by(|a, b| a.1.total_cmp(&b.1)).unwrap_or((best, 0.0));
        if let Memory::Lag(lag_s) = memory {
            let (mut low, mut high) = ((lag_s / RATIO).ln(), (lag_s * RATIO).ln());
            let golden = 0.5 * (5.0_f64.sqrt() - 1.0);
            for _ in 0..LAG_STEPS {
                let (a, b) = (high - golden * (high - low), low + golden * (high - low));
                if gain(Memory::Lag(a.exp())) > gain(Memory::Lag(b.exp())) { high = b } else { low = a }
            }
            memory = Memory::Lag((0.5 * (low + high)).exp());
            most = gain(memory);
        }
        Driven { channel: self.channel, driver, memory, gain: most }
    }
}

/// Twice the rise of the logarithm of the likelihood by one amplitude in all parts, each with a level of its own.
fn gain(parts: &[Part]) -> f64 {
    let mut left: Vec<f64> = parts.iter().map(|p| p.power).collect();
    for _ in 0..LEVEL_ROUNDS {
        let weighed =
            |of: fn(&Part) -> f64| parts.iter().zip(&left).map(|(p, left)| p.observations / left * of(p)).sum::<f64>();
        let (squared, along) = (weighed(|p| p.squared), weighed(|p| p.along));
        let amplitude = if squared > 0.0 { along / squared } else { 0.0 };
        let taken = |p: &Part| amplitude * (2.0 * p.along - amplitude * p.squared);
        left.iter_mut().zip(parts).for_each(|(left, p)| *left = (p.power - taken(p)).max(1e-12 * p.power));
    }
    parts.iter().zip(&left).map(|(p, left)| 2.0 * p.observations * (p.power / left).ln()).sum()
}

impl Whitened {
    /// Columns of samples of all stretches, whitened; none where a covariance is singular.
    fn whiten(&self, columns: &DMatrix<f64>) -> Option<DMatrix<f64>> {
        let mut all = columns.clone();
        let mut first = 0;
        for factor in &self.factors {
            let mut rows = all.rows_mut(first, factor.nrows());
            if !factor.solve_lower_triangular_mut(&mut rows) {
                return None;
            }
            first += factor.nrows();
        }
        Some(all)
    }

    /// Whitened columns without what powers of time and what is added explain.
    fn left(&self, white: &DMatrix<f64>) -> DMatrix<f64> {
        white - &self.beside * self.beside.tr_mul(white)
    }

    /// Whitened columns are in the model too.
    fn add(&mut self, white: &DMatrix<f64>) {
        for k in 0..white.ncols() {
            let column = DMatrix::from_column_slice(white.nrows(), 1, white.column(k).as_slice());
            // Twice, so that rounding leaves nothing of the others in it.
            let left = self.left(&self.left(&column));
            if left.norm_squared() > OWN * column.norm_squared() {
                self.beside = DMatrix::from_columns(
                    &self
                        .beside
                        .column_iter()
                        .map(|c| c.into_owned())
                        .chain([left.column(0) / left.norm()])
                        .collect::<Vec<_>>(),
                );
            }
        }
        let y = DMatrix::from_column_slice(self.y.len(), 1, self.y.as_slice());
        self.y = self.left(&y).column(0).into_owned();
    }
}
