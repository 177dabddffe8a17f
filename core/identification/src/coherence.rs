//! Coherence of housekeeping with the residuals.
//!
//! Drivers are each housekeeping value, its derivative, its square and the products of two. Their cross-spectra with
//! `Σ⁻¹ r` of the residuals r are summed over long segments, in wide bands below [`SLOW_HZ`]. `Σ⁻¹ r`,
//! at unit power, is what is left of a channel given all others: a force on one test mass shows there far below the
//! thrusters' noise, which moves all channels. A lag between cause and force turns the phase and leaves the coherence.
//! For n complex observations without relation `−2(n−1) log(1 − |γ|²)` is χ² with two degrees of freedom, whatever the
//! driver (Goodman 1957).
//!
//! Beside the channels there may be other ways in which a force enters them, such as a force on the spacecraft: of a
//! direction d the same is `dᵀΣ⁻¹ r`. And beside housekeeping there may be known series, such as commands, which
//! are drivers as products with housekeeping alone: a gain that follows a temperature.
//!
//! Housekeeping channels are coherent with one another, so one cause raises many coherences.
//! [`HousekeepingCoherence::stepwise_coherence`] selects drivers by their partial coherence given those selected before
//! (Bendat and Piersol, Random Data, 4th ed., §7.3); what all of them explain is their multiple coherence.

use std::ops::Range;

use dragfree_estimation::spectra::{Band, Plan, Transformer};
use nalgebra::{Complex, DMatrix, DMatrixView, DVector};
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
    /// The product of housekeeping about where it began, and a known series.
    Modulated(usize, usize),
}

/// A way in which a force enters the channels: along one of them, or as one on the spacecraft does.
#[derive(Clone, Debug, PartialEq)]
pub struct Direction {
    /// Its name.
    pub name: String,
    /// Frame of the force, as of a column. A command acts where its frame is.
    pub frame: String,
    /// Acceleration in each channel per unit of the force.
    pub response: DVector<f64>,
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

impl Coherence {
    /// Probability of as much by chance, corrected for what was tried.
    pub fn p_value(&self) -> f64 {
        corrected(ln_chi2_above(self.statistic, self.dof).exp(), self.trials)
    }
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

/// Drivers of one housekeeping channel, the value first.
const VALUE: usize = 3;

/// Most drivers that are selected for one channel.
const MAX_STEPS: usize = 5;

/// A driver is collinear with the selected ones if they leave less than this part of its power.
const OWN: f64 = 1e-6;

/// The sums.
#[derive(Clone, Debug, PartialEq)]
pub struct HousekeepingCoherence {
    /// Housekeeping, then the known series.
    pub(crate) names: Vec<String>,
    /// Frames of the known series.
    known: Vec<String>,
    /// Products with known series last.
    pub(crate) drivers: Vec<Driver>,
    /// Where forces may act, the channels first.
    pub places: Vec<Direction>,
    /// Residual of each channel as a combination of the base columns.
    pub(crate) residual: DMatrix<f64>,
    /// `Σ⁻¹` per band of the plan; none after reading, when no segment comes.
    whitening: Vec<DMatrix<f64>>,
    /// Bands in bins of a segment.
    pub(crate) bands: Vec<[usize; 2]>,
    pub(crate) bin_hz: f64,
    /// Level from which products count, per channel of housekeeping; none before the first segment.
    pub(crate) level: Vec<f64>,
    /// Per band and place: power of the residual.
    pub(crate) residual_power: DMatrix<f64>,
    /// Per driver, and after them per known series, and band: its power.
    pub(crate) power: DMatrix<f64>,
    /// The same, a column per band and place: real and imaginary parts of the cross-spectrum with the residual.
    pub(crate) cross: [DMatrix<f64>; 2],
    /// Per product with a known series and band, cross-spectra: of the known series with the product, of the
    /// housekeeping with the product, and of the known series with the housekeeping.
    among_factors: [DMatrix<Complex<f64>>; 3],
    /// Per band the cross-spectra of the drivers that are no products, real and imaginary parts, lower triangles; none
    /// where there are too many.
    pub(crate) among: Vec<[DMatrix<f64>; 2]>,
    /// Per band: complex observations.
    pub(crate) observations: Vec<f64>,
    /// Per band and place: `dᵀΣ⁻¹d`.
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

/// What a driver has in common with a residual in a band.
struct Own {
    observations: f64,
    /// Power of the residual.
    power: f64,
    /// Power of the driver.
    squared: f64,
    cross: Complex<f64>,
}

impl Direction {
    /// The channels themselves, with their names and frames.
    pub fn of_channels<'a>(channels: &[(&'a str, &'a str)]) -> Vec<Self> {
        let n = channels.len();
        let of = |(c, (name, frame)): (usize, &(&str, &str))| {
            let response = DVector::from_fn(n, |row, _| if row == c { 1.0 } else { 0.0 });
            Self { name: (*name).to_owned(), frame: (*frame).to_owned(), response }
        };
        channels.iter().enumerate().map(of).collect()
    }
}

impl HousekeepingCoherence {
    /// For housekeeping of these names, of which the last are `known` series of these frames, segments of a plan,
    /// residuals made by `residual` (channels × base columns), `Σ⁻¹` per band of the plan, and the places of forces, of
    /// which the channels are the first.
    pub fn new(
        names: Vec<String>,
        known: Vec<String>,
        plan: &Plan,
        residual: DMatrix<f64>,
        whitening: Vec<DMatrix<f64>>,
        places: Vec<Direction>,
    ) -> Self {
        let n = names.len() - known.len();
        let mut drivers: Vec<Driver> =
            (0..n).flat_map(|i| [Driver::Value(i), Driver::Derivative(i), Driver::Square(i)]).collect();
        if n <= MOST_FOR_PRODUCTS {
            drivers.extend((0..n).flat_map(|i| (0..i).map(move |j| Driver::Product(j, i))));
            drivers.extend((0..n).flat_map(|i| (n..names.len()).map(move |k| Driver::Modulated(i, k))));
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
        let along = responses(&places, residual.nrows());
        let information: Vec<DVector<f64>> =
            whitening.iter().map(|m| (along.transpose() * m * &along).diagonal()).collect();
        let weight = DMatrix::from_fn(bands.len(), places.len(), |b, p| {
            let common = |band: &Band| bands[b][1].min(band.end).saturating_sub(bands[b][0].max(band.first)) as f64;
            let all = plan.bands.iter().zip(&information).map(|(band, own)| (common(band), own[p]));
            let (bins, sum) = all.fold((0.0, 0.0), |(bins, sum), (n, x)| (bins + n, sum + n * x));
            if bins > 0.0 { sum / bins } else { 0.0 }
        });
        let wide = bands.len() * places.len();
        let series = drivers.len() + known.len();
        let mut level = vec![f64::NAN; n];
        // A command acts as it is, not about where it began.
        level.resize(names.len(), 0.0);
        let singles = if n <= MOST_FOR_PRODUCTS { VALUE * n } else { 0 };
        Self {
            among: vec![[DMatrix::zeros(singles, singles), DMatrix::zeros(singles, singles)]; bands.len()],
            level,
            residual_power: DMatrix::zeros(bands.len(), places.len()),
            power: DMatrix::zeros(series, bands.len()),
            cross: [DMatrix::zeros(series, wide), DMatrix::zeros(series, wide)],
            among_factors: [0; 3].map(|_| DMatrix::zeros(n * known.len(), bands.len())),
            known,
            places,
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

    /// With products and squares about the values of other data to which these will be added: about values of their own
    /// they would be other functions.
    #[must_use]
    pub fn about(mut self, levels: &[f64]) -> Self {
        if levels.len() == self.level.len() {
            self.level.copy_from_slice(levels);
        }
        self
    }

    /// Values of housekeeping about which products and squares are taken; not a number before any segment.
    pub fn levels(&self) -> &[f64] {
        &self.level
    }

    /// Whether the sums of other segments add to these: the same housekeeping in the same bands, about the same values.
    pub fn is_like(&self, other: &Self) -> bool {
        let about_one = |(a, b): (&f64, &f64)| a.is_nan() || b.is_nan() || a == b;
        self.names == other.names && self.bands == other.bands && self.level.iter().zip(&other.level).all(about_one)
    }

    /// Adds the sums of other segments that [are like](Self::is_like) these.
    pub fn add(&mut self, other: &Self) {
        debug_assert!(self.is_like(other));
        self.level.iter_mut().zip(&other.level).filter(|(own, _)| own.is_nan()).for_each(|(own, level)| *own = *level);
        self.residual_power += &other.residual_power;
        self.power += &other.power;
        self.cross.iter_mut().zip(&other.cross).for_each(|(a, b)| *a += b);
        self.among_factors.iter_mut().zip(&other.among_factors).for_each(|(a, b)| *a += b);
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
        let plain = base.rows(0, rows.last().map_or(0, |r| r.end)) * self.residual.transpose();
        let places = responses(&self.places, self.residual.nrows());
        let mut residual = &plain * &places;
        for (band, inverse) in plan.bands.iter().zip(&self.whitening) {
            let rows = rows_between(band.first, band.end);
            let (start, end) = (rows.start, rows.end.min(residual.nrows()));
            if start < end {
                // Each of unit power, so that a band is as loud at one end as at the other.
                let along = inverse * &places;
                let information = (places.transpose() * &along).diagonal();
                let white = plain.rows(start, end - start) * (along * DMatrix::from_diagonal(&information.map(unit)));
                residual.rows_mut(start, end - start).copy_from(&white);
            }
        }
        let among_places = residual.ncols();
        for (b, rows) in rows.iter().enumerate() {
            self.observations[b] += 0.5 * rows.len() as f64 * WORTH[usize::from(overlaps)];
            for p in 0..among_places {
                self.residual_power[(b, p)] += residual.view((rows.start, p), (rows.len(), 1)).norm_squared();
            }
        }
        let mut spectrum = vec![0.0; 2 * (samples / 2 - plan.first_bin)];
        // Spectra of those that are no products, and of the known series, a column each.
        let singles = self.among.first().map_or(0, |a| a[0].nrows());
        let length = rows.last().map_or(0, |r| r.end);
        let mut all = DMatrix::zeros(length, singles);
        let mut known = DMatrix::zeros(length, self.known.len());
        let first_known = self.known().start;
        for k in 0..self.known.len() {
            transformer.transform(plan, taper, housekeeping[first_known + k], &mut spectrum);
            known.column_mut(k).copy_from_slice(&spectrum[..length]);
            self.add_series(self.drivers.len() + k, &spectrum, &rows, &residual);
        }
        for (d, driver) in self.drivers.clone().into_iter().enumerate() {
            transformer.transform(plan, taper, &driver.samples(housekeeping, &self.level), &mut spectrum);
            if d < singles {
                all.column_mut(d).copy_from_slice(&spectrum[..length]);
            }
            if let Driver::Modulated(i, k) = driver {
                let (u, value) = (known.column(k - first_known), all.column(VALUE * i));
                let [u, value] = [u.as_slice(), value.as_slice()];
                let product = i * self.known.len() + k - first_known;
                for (b, rows) in rows.iter().enumerate() {
                    let [u, value, own] = [u, value, &spectrum[..]].map(|x| &x[rows.clone()]);
                    for (sum, (left, right)) in self.among_factors.iter_mut().zip([(u, own), (value, own), (u, value)])
                    {
                        sum[(product, b)] += cross_spectrum(left, right);
                    }
                }
            }
            self.add_series(d, &spectrum, &rows, &residual);
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

    /// Adds the power of a series and its cross-spectra with the residuals of all places, by rows of the bands.
    fn add_series(&mut self, series: usize, spectrum: &[f64], rows: &[Range<usize>], residual: &DMatrix<f64>) {
        for (b, rows) in rows.iter().enumerate() {
            let own = &spectrum[rows.clone()];
            self.power[(series, b)] += own.iter().map(|x| x * x).sum::<f64>();
            for p in 0..residual.ncols() {
                let theirs = &residual.as_slice()[p * residual.nrows()..][rows.clone()];
                let sum = cross_spectrum(own, theirs);
                let column = b * residual.ncols() + p;
                self.cross[0][(series, column)] += sum.re;
                self.cross[1][(series, column)] += sum.im;
            }
        }
    }

    /// Cross-spectrum of a driver or, after them, a known series with the residual of a place in a band.
    fn cross_of(&self, series: usize, band: usize, place: usize) -> Complex<f64> {
        let column = band * self.residual_power.ncols() + place;
        Complex::new(self.cross[0][(series, column)], self.cross[1][(series, column)])
    }

    /// Whether a driver may act at a place: a known series does where its frame is.
    pub(crate) fn acts(&self, driver: Driver, place: usize) -> bool {
        match driver {
            Driver::Modulated(_, k) => self.known[k - self.known().start] == self.places[place].frame,
            _ => true,
        }
    }

    /// Number of known series that act at a place.
    pub fn known_at(&self, place: usize) -> usize {
        self.known.iter().filter(|frame| **frame == self.places[place].frame).count()
    }

    /// Known series, as indices of names.
    pub(crate) fn known(&self) -> Range<usize> {
        self.names.len() - self.known.len()..self.names.len()
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
                DMatrix::from_fn(singles + 1, singles + 1, |i, j| match (i == singles, j == singles) {
                    (false, false) => Complex::new(self.among[b][0][(i, j)], self.among[b][1][(i, j)]),
                    (false, true) => self.cross_of(i, b, c),
                    (true, false) => self.cross_of(j, b, c).conj(),
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

    /// What a driver with a frequency response says of a place in the bands from `from_hz` on; a derivative is one by
    /// time. Of a product with a known series, that given its two factors: a constant gain is no function of
    /// housekeeping, and in a control loop the residual is coherent with commands without any.
    pub(crate) fn parts(
        &self,
        place: usize,
        driver: Driver,
        response: impl Fn(f64) -> Complex<f64>,
        from_hz: f64,
    ) -> Vec<Part> {
        let Some(d) = self.drivers.iter().position(|own| *own == driver) else { return Vec::new() };
        let unit = if matches!(driver, Driver::Derivative(_)) { (2.0 * self.step_s).recip() } else { 1.0 };
        let part = |(b, [first, end]): (usize, &[usize; 2])| {
            let weight = self.weight[(b, place)];
            let own = match driver {
                Driver::Modulated(i, k) => self.given_factors(d, i, k, b, place)?,
                _ => Own {
                    observations: self.observations[b],
                    power: self.residual_power[(b, place)],
                    squared: self.power[(d, b)],
                    cross: self.cross_of(d, b, place),
                },
            };
            let usable = *first as f64 * self.bin_hz >= from_hz && own.observations > 2.0;
            if !usable || own.power <= 0.0 || weight <= 0.0 {
                return None;
            }
            let response = response((*first as f64 * (*end as f64 - 1.0)).sqrt() * self.bin_hz) * unit;
            Some(Part {
                observations: own.observations - 1.0,
                power: own.power,
                squared: weight * response.norm_sqr() * own.squared,
                along: weight.sqrt() * (response.conj() * own.cross).re,
            })
        };
        self.bands.iter().enumerate().filter_map(part).collect()
    }

    /// What a product of housekeeping with a known series says of a place in a band given both; none where they say
    /// all.
    fn given_factors(&self, product: usize, i: usize, k: usize, band: usize, place: usize) -> Option<Own> {
        let (value, known) = (VALUE * i, self.drivers.len() + k - self.known().start);
        let [u_product, value_product, u_value] =
            [0, 1, 2].map(|s| self.among_factors[s][(i * self.known.len() + k - self.known().start, band)]);
        let real = |x: f64| Complex::new(x, 0.0);
        let theirs = [known, value, product].map(|series| self.cross_of(series, band, place));
        let powers = [known, value, product].map(|series| real(self.power[(series, band)]));
        // The known series, the housekeeping, the product and the residual; the upper triangle.
        let mut m = [
            [powers[0], u_value, u_product, theirs[0]],
            [real(0.0), powers[1], value_product, theirs[1]],
            [real(0.0), real(0.0), powers[2], theirs[2]],
            [real(0.0), real(0.0), real(0.0), real(self.residual_power[(band, place)])],
        ];
        let mut observations = self.observations[band];
        for pivot in 0..2 {
            if m[pivot][pivot].re <= OWN * powers[pivot].re {
                continue;
            }
            observations -= 1.0;
            for row in pivot + 1..4 {
                for column in row..4 {
                    let taken = m[pivot][row].conj() * m[pivot][column] / m[pivot][pivot];
                    m[row][column] -= taken;
                }
            }
        }
        let own = Own { observations, power: m[3][3].re, squared: m[2][2].re, cross: m[2][3] };
        (own.squared > OWN * powers[2].re).then_some(own)
    }

    /// Coherence of each driver of housekeeping alone with the residual of each channel, the most significant first.
    pub fn coherences(&self, channels: &[String]) -> Vec<Coherence> {
        let mut all = Vec::new();
        let count = self.drivers.iter().filter(|d| !matches!(d, Driver::Modulated(..))).count();
        let singles = self.drivers.iter().filter(|d| d.of().len() == 1).count();
        let kinds = if singles == count { 1.0 } else { 2.0 };
        for (d, driver) in self.drivers[..count].iter().enumerate() {
            for (c, channel) in channels.iter().enumerate() {
                let (mut statistic, mut dof, mut explained, mut band_hz) = (0.0, 0.0, 0.0, [0.0; 2]);
                let mut most = 0.0;
                for (b, [first, end]) in self.bands.iter().enumerate() {
                    let n = self.observations[b];
                    let power = self.power[(d, b)] * self.residual_power[(b, c)];
                    if n < 2.0 || power <= 0.0 {
                        continue;
                    }
                    let squared = self.cross_of(d, b, c).norm_sqr() / power;
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
                    let alike = if of.len() == 1 { singles } else { count - singles };
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
    /// The factors of a product of two housekeeping channels, each by itself.
    pub fn factors(self) -> Vec<Self> {
        match self {
            Self::Product(i, j) => vec![Self::Value(i), Self::Value(j)],
            _ => Vec::new(),
        }
    }

    /// What is made of housekeeping alone in it.
    pub fn housekeeping(self) -> Self {
        match self {
            Self::Modulated(i, _) => Self::Value(i),
            other => other,
        }
    }

    pub(crate) fn of(self) -> Vec<usize> {
        match self {
            Self::Value(i) | Self::Derivative(i) | Self::Square(i) => vec![i],
            Self::Product(i, j) | Self::Modulated(i, j) => vec![i, j],
        }
    }

    pub(crate) fn label(self, names: &[String]) -> String {
        match self {
            Self::Value(i) => names[i].clone(),
            Self::Derivative(i) => format!("d/dt {}", names[i]),
            Self::Square(i) => format!("{}^2", names[i]),
            Self::Product(i, j) | Self::Modulated(i, j) => format!("{} * {}", names[i], names[j]),
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
            Self::Product(i, j) | Self::Modulated(i, j) => {
                values[i].iter().zip(values[j]).map(|(x, y)| (x - level[i]) * (y - level[j])).collect()
            }
        }
    }
}

/// What a unit of the force at each place is in the channels, a column each.
fn responses(places: &[Direction], channels: usize) -> DMatrix<f64> {
    let mut all = DMatrix::zeros(channels, places.len());
    places.iter().enumerate().for_each(|(p, own)| all.set_column(p, &own.response));
    all
}

/// Factor that makes a power one; 0 where there is none.
fn unit(power: f64) -> f64 {
    if power > 0.0 { power.sqrt().recip() } else { 0.0 }
}

/// Sum of `a* b` over bins, each a pair of numbers.
fn cross_spectrum(a: &[f64], b: &[f64]) -> Complex<f64> {
    let (mut re, mut im) = (0.0, 0.0);
    for (a, b) in a.chunks_exact(2).zip(b.chunks_exact(2)) {
        re += a[0] * b[0] + a[1] * b[1];
        im += a[0] * b[1] - a[1] * b[0];
    }
    Complex::new(re, im)
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
        segments_with(seed, Vec::new(), change)
    }

    /// The same, where the last of housekeeping are known series of these frames, and after the channels there is the
    /// spacecraft, which moves the first two channels.
    fn segments_with(
        seed: u64,
        known: Vec<String>,
        change: impl Fn(&mut [Vec<f64>], &mut [Vec<f64>]),
    ) -> (HousekeepingCoherence, Vec<String>) {
        segments_about(seed, known, &[], change)
    }

    /// The same with products about some values.
    fn segments_about(
        seed: u64,
        known: Vec<String>,
        levels: &[f64],
        change: impl Fn(&mut [Vec<f64>], &mut [Vec<f64>]),
    ) -> (HousekeepingCoherence, Vec<String>) {
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
        let same = DMatrix::identity(CHANNELS, CHANNELS);
        let mut places = Direction::of_channels(&[("", "ORF"); CHANNELS]);
        let response = DVector::from_fn(CHANNELS, |c, _| [-0.8, 0.6].get(c).copied().unwrap_or(0.0));
        places.push(Direction { name: "sc.force.x".to_owned(), frame: "SRF".to_owned(), response });
        let mut coherence = HousekeepingCoherence::new(names, known, &plan, same, whitening, places).about(levels);
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

    /// Amplitude and twice the rise of the log-likelihood by a driver at a place, with unit noise.
    fn told(coherence: &HousekeepingCoherence, place: usize, driver: Driver) -> (f64, f64) {
        let parts = coherence.parts(place, driver, |_| Complex::new(1.0, 0.0), 0.0);
        let sum = |of: fn(&Part) -> f64| parts.iter().map(|p| 2.0 * p.observations / p.power * of(p)).sum::<f64>();
        (sum(|p| p.along) / sum(|p| p.squared), sum(|p| p.along).powi(2) / sum(|p| p.squared))
    }

    /// On two days whose housekeeping is 5σ apart a product of two acts, about the values of the first: it has its
    /// amplitude of 3 within 4.4σ of 0.08 in the sum of both (false alarm 1e-5). About values of its own the second day
    /// has another function: that does not add.
    #[test]
    fn products_of_several_days_are_about_the_same_values() {
        let (seeds, product) = ([21, 22], Driver::Product(1, 2));
        let day = |k: usize, levels: &[f64], about: [f64; 2]| {
            let change = |channels: &mut [Vec<f64>], housekeeping: &mut [Vec<f64>]| {
                housekeeping[1].iter_mut().for_each(|x| *x += 5.0 * k as f64);
                let force = housekeeping[1].iter().zip(&housekeeping[2]);
                let force: Vec<f64> = force.map(|(x, y)| 3.0 * (x - about[0]) * (y - about[1])).collect();
                channels[0].iter_mut().zip(force).for_each(|(z, force)| *z += force);
            };
            segments_about(seeds[k], Vec::new(), levels, change).0
        };
        // The values of a day do not depend on its channels.
        let levels = day(0, &[], [0.0; 2]).levels().to_vec();
        let about = [levels[1], levels[2]];
        let mut sum = day(0, &[], about);
        let (second, about_its_own) = (day(1, &levels, about), day(1, &[], about));
        assert!(sum.is_like(&second) && !sum.is_like(&about_its_own));
        sum.add(&second);
        let (amplitude, _) = told(&sum, 0, product);
        assert!((amplitude - 3.0).abs() < 4.4 * 0.08, "{amplitude}");
        let (amplitude, _) = told(&about_its_own, 0, product);
        assert!((amplitude - 3.0).abs() > 4.4 * 0.08, "{amplitude}");
    }

    /// A force on the spacecraft enters two channels. At the place of the spacecraft it has its amplitude within 4.4σ
    /// of 0.08 (false alarm 1e-5), and more of it is told there than at either channel.
    #[test]
    fn a_force_on_the_spacecraft_is_told_at_its_place() {
        let (coherence, _) = segments_with(11, Vec::new(), |channels, housekeeping| {
            for (channel, response) in [(0, -0.8), (1, 0.6)] {
                channels[channel].iter_mut().zip(&housekeeping[1]).for_each(|(z, x)| *z += 3.0 * response * x);
            }
        });
        let at = |place: usize| told(&coherence, place, Driver::Value(1));
        assert!((at(CHANNELS).0 - 3.0).abs() < 4.4 * 0.08, "{:?}", at(CHANNELS));
        assert!(at(CHANNELS).1 > at(0).1 && at(0).1 > at(1).1, "{:?}", [at(CHANNELS), at(0), at(1)]);
    }

    /// A gain that follows a slow wave of the last of housekeeping, a command: the product has its amplitude, within
    /// 4.4σ of 0.08 over the wave's rms of 0.7, doubled for what its factors take. A constant gain of the same command
    /// is no such product, nor is a force by the wave itself: 19.5 of a χ² of one degree of freedom (false alarm 1e-5).
    /// A command acts where its frame is.
    #[test]
    fn a_gain_that_follows_housekeeping_is_told_from_its_factors() {
        let known = NAMES - 1;
        let product = Driver::Modulated(0, known);
        let with = |gain: f64, following: f64, force: f64| {
            let change = |channels: &mut [Vec<f64>], housekeeping: &mut [Vec<f64>]| {
                let turn = std::f64::consts::TAU / housekeeping[0].len() as f64;
                housekeeping[0].iter_mut().enumerate().for_each(|(k, x)| *x = (turn * k as f64).cos());
                let acting = housekeeping[0].iter().zip(&housekeeping[known]);
                let acting = acting.map(|(wave, command)| (gain + following * wave) * command + force * wave);
                channels[0].iter_mut().zip(acting).for_each(|(z, x)| *z += x);
            };
            segments_with(12, vec!["ORF".to_owned()], change).0
        };
        let (amplitude, gain) = told(&with(0.0, 3.0, 0.0), 0, product);
        assert!((amplitude - 3.0).abs() < 4.4 * 0.24 && gain > 39.0, "{amplitude} {gain}");
        for constant in [with(3.0, 0.0, 0.0), with(0.0, 0.0, 3.0)] {
            let (amplitude, gain) = told(&constant, 0, product);
            assert!(gain < 19.5, "{amplitude} {gain}");
        }
        let coherence = with(0.0, 3.0, 0.0);
        assert!(coherence.acts(product, 0) && !coherence.acts(product, CHANNELS));
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
