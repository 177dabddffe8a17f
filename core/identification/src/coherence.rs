//! Coherence of housekeeping with the residuals.
//!
//! Drivers are each housekeeping value, its derivative, its square and the products of two. Their cross-spectra with
//! `Σ⁻¹ r` of the residuals r are summed over long segments, in wide bands below [`SLOW_HZ`]. `Σ⁻¹ r`,
//! at unit power, is what is left of a channel given all others: a force on one test mass shows there far below the
//! thrusters' noise, which moves all channels. A lag between cause and force turns the phase and leaves the coherence.
//! For n complex observations without relation `−2(n−1) log(1 − |γ|²)` is χ² with two degrees of freedom, whatever the
//! driver (Goodman 1957).
//!
//! Housekeeping channels are coherent with one another, so one cause raises many coherences.
//! [`HousekeepingCoherence::stepwise_coherence`] selects drivers by their partial coherence given those selected before
//! (Bendat and Piersol, Random Data, 4th ed., §7.3); what all of them explain is their multiple coherence.

use std::ops::Range;

use dragfree_estimation::spectra::{Band, Plan, Transformer};
use nalgebra::{Complex, DMatrix, DMatrixView};
use serde::{Deserialize, Serialize};

use crate::distributions::{corrected, ln_chi2_above};
use dragfree_estimation::decimate::SLOW_HZ;

/// Ratio of the ends of a band.
const RATIO: f64 = 1.6;

/// Products of two are drivers if there are no more housekeeping channels than this.
const MOST_FOR_PRODUCTS: usize = 100;

/// Independent observations per bin of a segment under a Hann window: of a segment alone, and of one that overlaps the
/// one before it by half. Neighbouring bins are correlated.
const WORTH: [f64; 2] = [0.514, 0.48];

/// A function of housekeeping that may drive a force.
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
    /// `−2(n−1) log(1 − |γ|²)` over all bands.
    pub statistic: f64,
    /// Its degrees of freedom.
    pub dof: f64,
    /// Trials for the correction of the p-value: drivers of one housekeeping channel and products of two have half of
    /// the false-alarm rate each, however many there are of them.
    pub trials: f64,
    /// Part of the residual's power that is coherent, less its mean without any relation, in the band with the largest
    /// statistic.
    pub explained: f64,
    /// That band, Hz.
    pub band_hz: [f64; 2],
}

/// Drivers that are coherent with a channel's residual, each given those before it.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct StepwiseCoherence {
    /// Channel.
    pub channel: String,
    /// The drivers in words.
    pub drivers: Vec<String>,
    /// p-value of each given those before it, corrected for all drivers of all channels.
    pub p_values: Vec<f64>,
    /// Their multiple coherence in the band where it is largest, less its mean without any relation.
    pub explained: f64,
    /// That band, Hz.
    pub band_hz: [f64; 2],
}

/// Most drivers that are selected for one channel.
const MAX_STEPS: usize = 5;

/// A driver is collinear with the selected ones if they leave less than this part of its power.
const OWN: f64 = 1e-6;

/// The sums.
#[derive(Clone, Debug, PartialEq)]
pub struct HousekeepingCoherence {
    pub(crate) names: Vec<String>,
    pub(crate) drivers: Vec<Driver>,
    /// Residual of each channel as a combination of the base columns.
    pub(crate) residual: DMatrix<f64>,
    /// `Σ⁻¹` per band of the plan; none after reading, when no segment comes.
    whitening: Vec<DMatrix<f64>>,
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
    /// Per band the cross-spectra of the drivers that are no products, real and imaginary parts, lower triangles; none
    /// where there are too many.
    pub(crate) among: Vec<[DMatrix<f64>; 2]>,
    /// Per band: complex observations.
    pub(crate) observations: Vec<f64>,
    /// Per band and channel: `(Σ⁻¹)_cc`.
    weight: DMatrix<f64>,
    /// Time between samples of a segment, s.
    step_s: f64,
}

/// What a function says of a channel in one band, or in other numbers of equal noise.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Part {
    /// Complex observations.
    pub(crate) observations: f64,
    /// Power of the residual.
    pub(crate) power: f64,
    /// Power that one unit of the function has.
    pub(crate) squared: f64,
    /// Its product with the residual.
    pub(crate) along: f64,
}

impl HousekeepingCoherence {
    /// For housekeeping of these names, segments of a plan, residuals made by `residual` (channels × base columns) and
    /// `Σ⁻¹` per band of the plan.
    pub fn new(names: Vec<String>, plan: &Plan, residual: DMatrix<f64>, whitening: Vec<DMatrix<f64>>) -> Self {
        let n = names.len();
        let mut drivers: Vec<Driver> =
            (0..n).flat_map(|i| [Driver::Value(i), Driver::Derivative(i), Driver::Square(i)]).collect();
        if n <= MOST_FOR_PRODUCTS {
            drivers.extend((0..n).flat_map(|i| (0..i).map(move |j| Driver::Product(j, i))));
        }
        let bin_hz = plan.bin_hz(1.0);
        let last = ((SLOW_HZ / bin_hz) as usize).min(plan.length / 2);
        let mut bands = Vec::new();
        let mut first = plan.first_bin;
        while first < last {
            let end = ((first as f64 * RATIO).ceil() as usize).max(first + 1).min(last);
            bands.push([first, end]);
            first = end;
        }
        let channels = residual.nrows();
        let weight = DMatrix::from_fn(bands.len(), channels, |b, c| {
            let common = |band: &Band| bands[b][1].min(band.end).saturating_sub(bands[b][0].max(band.first)) as f64;
            let all = plan.bands.iter().zip(&whitening).map(|(band, m)| (common(band), m[(c, c)]));
            let (bins, sum) = all.fold((0.0, 0.0), |(bins, sum), (n, x)| (bins + n, sum + n * x));
            if bins > 0.0 { sum / bins } else { 0.0 }
        });
        let wide = bands.len() * channels;
        let singles = if n <= MOST_FOR_PRODUCTS { 3 * n } else { 0 };
        Self {
            among: vec![[DMatrix::zeros(singles, singles), DMatrix::zeros(singles, singles)]; bands.len()],
            level: vec![f64::NAN; n],
            residual_power: DMatrix::zeros(bands.len(), channels),
            power: DMatrix::zeros(drivers.len(), bands.len()),
            cross: [DMatrix::zeros(drivers.len(), wide), DMatrix::zeros(drivers.len(), wide)],
            observations: vec![0.0; bands.len()],
            weight,
            step_s: (bin_hz * plan.length as f64).recip(),
            names,
            drivers,
            residual,
            whitening,
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
        self.observations.iter_mut().zip(&other.observations).for_each(|(a, b)| *a += b);
        self.among.iter_mut().flatten().zip(other.among.iter().flatten()).for_each(|(a, b)| *a += b);
    }

    /// A segment of the plan's `taper`-th length: housekeeping sample by sample, spectra of the base columns.
    pub fn segment(
        &mut self,
        plan: &Plan,
        taper: usize,
        housekeeping: &[&[f64]],
        base: &DMatrixView<'_, f64>,
        overlaps: bool,
    ) {
        let samples = housekeeping.first().map_or(0, |x| x.len());
        if samples == 0 {
            return;
        }
        let mut transformer = Transformer::new(plan);
        for (level, x) in self.level.iter_mut().zip(housekeeping).filter(|(level, _)| level.is_nan()) {
            *level = x.iter().sum::<f64>() / x.len() as f64;
        }
        // Bins of this length, as rows of the spectra.
        let rows_between = |first: usize, end: usize| {
            let bins = plan.bins_between(taper, first..end);
            2 * (bins.start - plan.first_bin)..2 * (bins.end - plan.first_bin)
        };
        let rows: Vec<Range<usize>> = self.bands.iter().map(|[first, end]| rows_between(*first, *end)).collect();
        let mut residual = base.rows(0, rows.last().map_or(0, |r| r.end)) * self.residual.transpose();
        for (band, inverse) in plan.bands.iter().zip(&self.whitening) {
            let rows = rows_between(band.first, band.end);
            let (start, end) = (rows.start, rows.end.min(residual.nrows()));
            if start < end {
                // Each of unit power, so that a band is as loud at one end as at the other.
                let unit = DMatrix::from_diagonal(&inverse.diagonal().map(|x| x.sqrt().recip()));
                let white = residual.rows(start, end - start) * (inverse * unit);
                residual.rows_mut(start, end - start).copy_from(&white);
            }
        }
        let channels = self.residual.nrows();
        for (b, rows) in rows.iter().enumerate() {
            self.observations[b] += 0.5 * rows.len() as f64 * WORTH[usize::from(overlaps)];
            for c in 0..channels {
                self.residual_power[(b, c)] += residual.view((rows.start, c), (rows.len(), 1)).norm_squared();
            }
        }
        let mut spectrum = vec![0.0; 2 * (samples / 2 - plan.first_bin)];
        // Spectra of those that are no products, a column each.
        let singles = self.among.first().map_or(0, |a| a[0].nrows());
        let mut all = DMatrix::zeros(rows.last().map_or(0, |r| r.end), singles);
        for (d, driver) in self.drivers.iter().enumerate() {
            transformer.transform(plan, taper, &driver.samples(housekeeping, &self.level), &mut spectrum);
            if d < singles {
                let length = all.nrows();
                all.column_mut(d).copy_from_slice(&spectrum[..length]);
            }
            for (b, rows) in rows.iter().enumerate() {
                let own = &spectrum[rows.clone()];
                self.power[(d, b)] += own.iter().map(|x| x * x).sum::<f64>();
                for c in 0..channels {
                    let (mut re, mut im) = (0.0, 0.0);
                    let theirs = &residual.as_slice()[c * residual.nrows()..][rows.clone()];
                    for (s, r) in own.chunks_exact(2).zip(theirs.chunks_exact(2)) {
                        re += s[0] * r[0] + s[1] * r[1];
                        im += s[0] * r[1] - s[1] * r[0];
                    }
                    let column = b * channels + c;
                    self.cross[0][(d, column)] += re;
                    self.cross[1][(d, column)] += im;
                }
            }
        }
        for (rows, among) in rows.into_iter().zip(&mut self.among) {
            // Times i, so that the imaginary part is a product of real matrices too.
            let own = all.rows(rows.start, rows.len()).into_owned();
            let turned =
                DMatrix::from_fn(
                    own.nrows(),
                    own.ncols(),
                    |r, d| {
                        if r % 2 == 0 { own[(r + 1, d)] } else { -own[(r - 1, d)] }
                    },
                );
            among[0].gemm_tr(1.0, &own, &own, 1.0);
            among[1].gemm_tr(1.0, &own, &turned, 1.0);
        }
    }

    /// Forward selection of drivers, without products, for each channel's residual; only channels with any. `alarm` is
    /// the false-alarm rate over all channels.
    pub fn stepwise_coherence(&self, channels: &[String], alarm: f64) -> Vec<StepwiseCoherence> {
        (0..channels.len()).filter_map(|c| self.stepwise_coherence_of(channels, c, alarm)).collect()
    }

    fn stepwise_coherence_of(&self, channels: &[String], c: usize, alarm: f64) -> Option<StepwiseCoherence> {
        let singles = self.among.first().map_or(0, |a| a[0].nrows());
        // Per band the Hermitian matrix of the drivers and, last, the residual, from which each selected driver is
        // swept.
        let mut bands: Vec<DMatrix<Complex<f64>>> = (0..self.bands.len())
            .map(|b| {
                let column = b * channels.len() + c;
                DMatrix::from_fn(singles + 1, singles + 1, |i, j| match (i == singles, j == singles) {
                    (false, false) => Complex::new(self.among[b][0][(i, j)], self.among[b][1][(i, j)]),
                    (false, true) => Complex::new(self.cross[0][(i, column)], self.cross[1][(i, column)]),
                    (true, false) => Complex::new(self.cross[0][(j, column)], -self.cross[1][(j, column)]),
                    (true, true) => Complex::new(self.residual_power[(b, c)], 0.0),
                })
            })
            .collect();
        let whole: Vec<Vec<f64>> = bands.iter().map(|m| m.diagonal().iter().map(|x| x.re).collect()).collect();
        let trials = (singles * channels.len()) as f64;
        let mut named: Vec<usize> = Vec::new();
        let mut p_values = Vec::new();
        while named.len() < MAX_STEPS {
            let left = |b: usize, i: usize| bands[b][(i, i)].re > OWN * whole[b][i];
            let chance = |d: usize| {
                let (mut statistic, mut dof) = (0.0, 0.0);
                for (b, m) in bands.iter().enumerate() {
                    let n = self.observations[b] - named.len() as f64;
                    if n < 2.0 || !left(b, d) || !left(b, singles) {
                        continue;
                    }
                    let squared = m[(d, singles)].norm_sqr() / (m[(d, d)].re * m[(singles, singles)].re);
                    statistic -= 2.0 * (n - 1.0) * (-squared.min(1.0 - 1e-12)).ln_1p();
                    dof += 2.0;
                }
                (dof > 0.0).then(|| ln_chi2_above(statistic, dof))
            };
            let others = (0..singles).filter(|d| !named.contains(d)).filter_map(|d| Some((d, chance(d)?)));
            let (best, ln_p) = others.min_by(|a, b| a.1.total_cmp(&b.1))?;
            let p_value = corrected(ln_p.exp(), trials);
            if p_value >= alarm {
                break;
            }
            for (m, whole) in bands.iter_mut().zip(&whole) {
                let pivot = m[(best, best)].re;
                if pivot > OWN * whole[best] {
                    let column = m.column(best).into_owned();
                    m.gerc(Complex::new(-1.0 / pivot, 0.0), &column, &column, Complex::new(1.0, 0.0));
                }
            }
            named.push(best);
            p_values.push(p_value);
        }
        let explained = |b: &usize| {
            let (q, n) = (named.len() as f64, self.observations[*b]);
            let power = whole[*b][singles];
            (n > q + 1.0 && power > 0.0).then(|| 1.0 - bands[*b][(singles, singles)].re / power - q / n)
        };
        let best = (0..bands.len()).filter_map(|b| Some((b, explained(&b)?))).max_by(|a, b| a.1.total_cmp(&b.1))?;
        let [first, end] = self.bands[best.0];
        (!named.is_empty()).then(|| StepwiseCoherence {
            channel: channels[c].clone(),
            drivers: named.iter().map(|d| self.drivers[*d].label(&self.names)).collect(),
            p_values,
            explained: best.1,
            band_hz: [first as f64 * self.bin_hz, (end - 1) as f64 * self.bin_hz],
        })
    }

    /// What a driver with a frequency response says of a channel in the bands from `from_hz` on; a derivative is one by
    /// time.
    pub(crate) fn parts(
        &self,
        channel: usize,
        driver: Driver,
        response: impl Fn(f64) -> Complex<f64>,
        from_hz: f64,
    ) -> Vec<Part> {
        let channels = self.residual.nrows();
        let Some(d) = self.drivers.iter().position(|own| *own == driver) else { return Vec::new() };
        let unit = if matches!(driver, Driver::Derivative(_)) { (2.0 * self.step_s).recip() } else { 1.0 };
        let part = |(b, [first, end]): (usize, &[usize; 2])| {
            let weight = self.weight[(b, channel)];
            let power = self.residual_power[(b, channel)];
            let usable = *first as f64 * self.bin_hz >= from_hz && self.observations[b] > 2.0;
            if !usable || power <= 0.0 || weight <= 0.0 {
                return None;
            }
            let response = response((*first as f64 * (*end as f64 - 1.0)).sqrt() * self.bin_hz) * unit;
            let column = b * channels + channel;
            let cross = Complex::new(self.cross[0][(d, column)], self.cross[1][(d, column)]);
            Some(Part {
                observations: self.observations[b] - 1.0,
                power,
                squared: weight * response.norm_sqr() * self.power[(d, b)],
                along: weight.sqrt() * (response.conj() * cross).re,
            })
        };
        self.bands.iter().enumerate().filter_map(part).collect()
    }

    /// Coherence of each driver with the residual of each channel, the most significant first.
    pub fn coherences(&self, channels: &[String]) -> Vec<Coherence> {
        let mut all = Vec::new();
        let singles = self.drivers.iter().filter(|d| d.of().len() == 1).count();
        let kinds = if singles == self.drivers.len() { 1.0 } else { 2.0 };
        for (d, driver) in self.drivers.iter().enumerate() {
            for (c, channel) in channels.iter().enumerate() {
                let (mut statistic, mut dof, mut explained, mut band_hz) = (0.0, 0.0, 0.0, [0.0; 2]);
                let mut most = 0.0;
                for (b, [first, end]) in self.bands.iter().enumerate() {
                    let n = self.observations[b];
                    let power = self.power[(d, b)] * self.residual_power[(b, c)];
                    if n < 2.0 || power <= 0.0 {
                        continue;
                    }
                    let column = b * channels.len() + c;
                    let squared = (self.cross[0][(d, column)].powi(2) + self.cross[1][(d, column)].powi(2)) / power;
                    // Without any relation P(|γ|² > x) = (1 − x)^(n−1), and the mean of |γ|² is 1/n.
                    let said = -2.0 * (n - 1.0) * (-squared.min(1.0 - 1e-12)).ln_1p();
                    statistic += said;
                    dof += 2.0;
                    if said > most {
                        most = said;
                        explained = (squared - 1.0 / n).max(0.0);
                        band_hz = [*first as f64 * self.bin_hz, (*end - 1) as f64 * self.bin_hz];
                    }
                }
                if dof > 0.0 {
                    let of: Vec<String> = driver.of().iter().map(|i| self.names[*i].clone()).collect();
                    let alike = if of.len() == 1 { singles } else { self.drivers.len() - singles };
                    let trials = kinds * (alike * channels.len()) as f64;
                    let (driver, channel) = (driver.label(&self.names), channel.clone());
                    all.push(Coherence { driver, of, channel, statistic, dof, trials, explained, band_hz });
                }
            }
        }
        // Corrected for the number of trials: a product with a nearly constant channel is its other factor, slightly
        // better by chance.
        let worth = |c: &Coherence| c.statistic - 2.0 * c.trials.ln();
        all.sort_by(|a, b| worth(b).total_cmp(&worth(a)));
        all
    }
}

impl Driver {
    /// The factors of a product, each by itself.
    pub fn factors(self) -> Vec<Self> {
        match self {
            Self::Product(i, j) => vec![Self::Value(i), Self::Value(j)],
            _ => Vec::new(),
        }
    }

    pub(crate) fn of(self) -> Vec<usize> {
        match self {
            Self::Value(i) | Self::Derivative(i) | Self::Square(i) => vec![i],
            Self::Product(i, j) => vec![i, j],
        }
    }

    pub(crate) fn label(self, names: &[String]) -> String {
        match self {
            Self::Value(i) => names[i].clone(),
            Self::Derivative(i) => format!("d/dt {}", names[i]),
            Self::Square(i) => format!("{}^2", names[i]),
            Self::Product(i, j) => format!("{} * {}", names[i], names[j]),
        }
    }

    pub(crate) fn samples(self, values: &[&[f64]], level: &[f64]) -> Vec<f64> {
        match self {
            Self::Value(i) => values[i].to_vec(),
            Self::Derivative(i) => {
                let x = values[i];
                (0..x.len()).map(|k| x[(k + 1).min(x.len() - 1)] - x[k.saturating_sub(1)]).collect()
            }
            Self::Square(i) => values[i].iter().map(|x| x * x).collect(),
            Self::Product(i, j) => {
                values[i].iter().zip(values[j]).map(|(x, y)| (x - level[i]) * (y - level[j])).collect()
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::distributions::chi2_tails;
    use rand::SeedableRng;
    use rand_distr::{Distribution, StandardNormal};
    use rand_xoshiro::Xoshiro256PlusPlus;

    const CHANNELS: usize = 6;
    /// As many as are tried together.
    const NAMES: usize = 50;

    /// Three segments that overlap, of white channels and housekeeping as `change` leaves them; housekeeping 0 is a
    /// flag that is up in the last quarter alone.
    fn segments(seed: u64, change: impl Fn(&mut [Vec<f64>], &mut [Vec<f64>])) -> (HousekeepingCoherence, Vec<String>) {
        let mut rng = Xoshiro256PlusPlus::seed_from_u64(seed);
        let plan = Plan::new(1024, 1.0);
        let samples = 2 * plan.length;
        let mut white = |n: usize| -> Vec<f64> { (0..n).map(|_| StandardNormal.sample(&mut rng)).collect() };
        let mut channels: Vec<Vec<f64>> = (0..CHANNELS).map(|_| white(samples)).collect();
        let mut housekeeping: Vec<Vec<f64>> = (0..NAMES).map(|_| white(samples)).collect();
        housekeeping[0] = (0..samples).map(|k| f64::from(u8::from(4 * k > 3 * samples))).collect();
        change(&mut channels, &mut housekeeping);
        let names = (0..NAMES).map(|i| format!("hk/{i}")).collect();
        let whitening = vec![DMatrix::identity(CHANNELS, CHANNELS); plan.bands.len()];
        let mut coherence = HousekeepingCoherence::new(names, &plan, DMatrix::identity(CHANNELS, CHANNELS), whitening);
        let mut transformer = Transformer::new(&plan);
        for first in (0..=samples - plan.length).step_by(plan.length / 2) {
            let cut = |x: &Vec<f64>| x[first..first + plan.length].to_vec();
            let mut base = DMatrix::zeros(2 * (plan.length / 2 - plan.first_bin), CHANNELS);
            for (mut column, x) in base.column_iter_mut().zip(&channels) {
                transformer.transform(&plan, 0, &cut(x), column.as_mut_slice());
            }
            let cuts: Vec<Vec<f64>> = housekeeping.iter().map(cut).collect();
            let slices: Vec<&[f64]> = cuts.iter().map(Vec::as_slice).collect();
            coherence.segment(&plan, 0, &slices, &base.columns(0, CHANNELS), first > 0);
        }
        (coherence, (0..CHANNELS).map(|c| format!("channel {c}")).collect())
    }

    /// With some of the second housekeeping added to the first channel.
    fn coherences(seed: u64, of_second_in_first: f64) -> Vec<Coherence> {
        let (coherence, names) = segments(seed, |channels, housekeeping| {
            channels[0].iter_mut().zip(&housekeeping[1]).for_each(|(z, x)| *z += of_second_in_first * x);
        });
        coherence.coherences(&names)
    }

    /// p-values of independent housekeeping are uniform. Values and derivatives of one channel are correlated, so that
    /// the spread is that of a third of them. False alarm 1e-5 each.
    #[test]
    fn p_values_of_independent_housekeeping_are_uniform() {
        let chances: Vec<f64> = coherences(1, 0.0).iter().map(|w| chi2_tails(w.statistic / w.dof, w.dof).1).collect();
        let n = chances.len() as f64;
        for p in [1e-1, 1e-2, 1e-4] {
            let found = chances.iter().filter(|chance| **chance < p).count() as f64;
            let most = n * p + 4.3 * (3.0 * n * p).sqrt() + 3.0;
            assert!(found <= most, "{found} of {n} below {p}");
        }
    }

    /// Two drivers, each with twice the amplitude of the noise, and a noisy copy of the first. All three are coherent
    /// with the channel, with 4/9, 4/9 and 2/9 of its power. Two of them explain 8/9 of it, to which the third adds
    /// nothing.
    #[test]
    fn a_copy_of_a_driver_is_not_selected_beside_it() {
        let together = |parts: &[(usize, f64)]| {
            let (coherence, names) = segments(7, |channels, housekeeping| {
                for (driver, part) in parts {
                    let driver = housekeeping[*driver].clone();
                    channels[0].iter_mut().zip(driver).for_each(|(z, x)| *z += part * x);
                }
                let first = housekeeping[1].clone();
                housekeeping[3].iter_mut().zip(first).for_each(|(copy, x)| *copy += x);
            });
            (coherence.coherences(&names), coherence.stepwise_coherence(&names, 1e-3))
        };
        let (pairs, found) = together(&[(1, 2.0), (2, 2.0)]);
        // In narrow bands a derivative is as coherent as its value.
        let lights_up = |name: &str| pairs.iter().take(6).any(|w| w.of == [name] && w.channel == "channel 0");
        assert!(["hk/1", "hk/2", "hk/3"].into_iter().all(lights_up), "{:?}", &pairs[..6]);
        assert_eq!(found.len(), 1, "{found:?}");
        let mut drivers: Vec<&str> = found[0].drivers.iter().map(|d| d.trim_start_matches("d/dt ")).collect();
        drivers.sort_unstable();
        assert_eq!((found[0].channel.as_str(), &drivers[..]), ("channel 0", &["hk/1", "hk/2"][..]));
        // The largest of the bands, of 20 observations and more each: (1 − γ²)√(2/n)γ = 0.03, of which four σ.
        assert!((found[0].explained - 8.0 / 9.0).abs() < 0.13, "{found:?}");
        // Without drivers none is selected, with a false alarm of 1e-3.
        assert_eq!(together(&[]).1, []);
    }

    /// Parts of a driver have its amplitude, as the channels' noise has unit power. With some 75 observations σ is
    /// 1/√(2·75) = 0.08, of which 4.4 (false alarm 1e-5); behind a response the amplitude is that of what comes out.
    #[test]
    fn parts_have_the_amplitude_of_a_driver() {
        let (coherence, _) = segments(3, |channels, housekeeping| {
            channels[0].iter_mut().zip(&housekeeping[1]).for_each(|(z, x)| *z += 3.0 * x);
        });
        let amplitude = |response: f64, from_hz: f64| {
            let parts = coherence.parts(0, Driver::Value(1), |_| Complex::new(response, 0.0), from_hz);
            let sum = |of: fn(&Part) -> f64| parts.iter().map(of).sum::<f64>();
            (sum(|p| p.along) / sum(|p| p.squared), sum(|p| p.observations))
        };
        let (found, observations) = amplitude(1.0, 0.0);
        assert!((found - 3.0).abs() < 4.4 * (2.0 * observations).sqrt().recip(), "{found} of {observations}");
        assert!((amplitude(-2.0, 0.0).0 + found / 2.0).abs() < 1e-12);
        assert!(amplitude(1.0, 0.02).1 < observations);
    }

    /// The twin: a driver with half of a channel's power, |γ|² = 1/2, is worth 2n log 2 = 97 over some 70 observations.
    #[test]
    fn a_driver_is_the_largest_coherence() {
        let all = coherences(2, 1.0);
        assert_eq!((all[0].driver.as_str(), all[0].channel.as_str()), ("hk/1", "channel 0"));
        assert!(chi2_tails(all[0].statistic / all[0].dof, all[0].dof).1 < 1e-8, "{:?}", all[0]);
        assert!(all[0].explained > 0.3, "{:?}", all[0]);
    }
}
