//! Slow samples: residuals, series of candidates and housekeeping over the whole of each product.
//!
//! A slow cause shows most below the lowest frequency of the segments of [`crate::gram`], where heat, currents and what
//! they heat change from hour to hour. Here all of it is kept as samples a hundred seconds apart. A channel is taken
//! given the others, `y = gᵀ r` with `g = Σ⁻¹ e_c / (Σ⁻¹)_cc`: the thrusters' noise, which moves all test masses, is
//! gone from it, and a force along the channel is not. Of a force that enters the channels along another direction d
//! it is `g = Σ⁻¹ d / (dᵀΣ⁻¹d)`. With the covariance of its declared noise the amplitude of a
//! series is that of generalised least squares beside powers of time. Gaps separate stretches, which are taken as
//! independent.

use std::collections::{BTreeMap, BTreeSet};

use dragfree_estimation::sigma::NoiseModel;
use nalgebra::{Cholesky, DMatrix, DVector};

use crate::candidates::{Candidate, CandidateSet, Form};
use dragfree_estimation::decimate::Decimator;

/// Distance of samples, s; a multiple of it where there would be more than [`MOST`] in a product.
const STEP_S: f64 = 100.0;

/// Most samples of a product in a fit, whose cost grows with their square.
const MOST: usize = 432;

/// Powers of time beside every series, from the zeroth.
const POWERS: usize = 3;

/// Part of the power of a series that is rounding.
pub(crate) const OWN: f64 = 1e-9;

/// Steps between two forms that differ in a number, in its logarithm: 5 % of a lag where forms are a factor of 1.5
/// apart, so that passes come to rest.
const BETWEEN: u32 = 8;

/// Frequencies in the integral of a covariance, per 1/T.
const FINENESS: f64 = 4.0;

/// Cosines of which a random walk is made: what is left of it lies above the frequencies at which slow causes show.
const COSINES: usize = 64;

/// Steps between two powers of a random walk that are tried, in its logarithm: less than a tenth of what the power of
/// one degree of freedom is uncertain by.
const POWER_STEP: f64 = 0.1;

/// Samples without a gap.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Stretch {
    first_ns: i64,
    /// By channel.
    residual: Vec<Vec<f64>>,
    /// Series of candidates, by index of the column after those of the model.
    series: Vec<Vec<f64>>,
    pub(crate) housekeeping: Vec<Vec<f64>>,
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
    pub(crate) fn len(&self) -> usize {
        self.residual.first().map_or(0, Vec::len)
    }
}

/// Slow samples of residuals and housekeeping, by product.
#[derive(Clone, Debug, PartialEq)]
pub struct SlowSamples {
    pub(crate) names: Vec<String>,
    pub(crate) units: Vec<String>,
    pub(crate) step_s: f64,
    /// Columns of the model.
    base: usize,
    pub(crate) products: Vec<Vec<Stretch>>,
}

/// Makes them of samples that come more often.
#[derive(Debug)]
pub(crate) struct Thinner {
    decimator: Decimator,
    residual: DMatrix<f64>,
    samples: SlowSamples,
}

impl Thinner {
    /// For samples of so many `columns` every `step_ns`, of which the first make residuals (channels × base columns),
    /// and for housekeeping of these names and units.
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
pub(crate) struct Whitened {
    /// Lower Cholesky factors of the covariance, by stretch.
    factors: Vec<DMatrix<f64>>,
    /// Part of each channel in the combination.
    gains: DVector<f64>,
    /// Orthonormal powers of time of all products, and what is added to the model.
    pub(crate) beside: DMatrix<f64>,
    pub(crate) y: DVector<f64>,
}

impl SlowSamples {
    /// Names and units of what was sampled.
    pub fn housekeeping(&self) -> impl Iterator<Item = (&str, &str)> {
        self.names.iter().zip(&self.units).map(|(name, unit)| (name.as_str(), unit.as_str()))
    }

    /// Adds other products with the same housekeeping.
    pub fn add(&mut self, other: &Self) {
        debug_assert_eq!(self.names, other.names);
        self.products.extend(other.products.iter().cloned());
    }

    /// With no more samples in a product than [`MOST`], and the lengths of the running means that they have passed, s.
    pub(crate) fn thinned(&self) -> (Self, Vec<f64>) {
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

    /// A force that enters the channels along a direction, given what else is in them, whitened; none where the noise
    /// is unknown or there are too few samples.
    pub(crate) fn whitened(&self, along: &DVector<f64>, noise: &NoiseModel, means_s: &[f64]) -> Option<Whitened> {
        let longest = self.products.iter().flatten().map(Stretch::len).max()?;
        // The combination that is quietest in the middle of the frequencies, in their logarithm.
        let length_s = longest as f64 * self.step_s;
        let middle_hz = (2.0 * length_s * self.step_s).sqrt().recip();
        let inverse = noise.psd(middle_hz).cholesky()?.inverse();
        let gains = &inverse * along;
        let gains = &gains / along.dot(&gains);
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
            let along = DVector::from_fn(set.channels.len(), |c, _| f64::from(u8::from(c == channel)));
            let Some(mut whitened) = thin.whitened(&along, noise, &means_s) else { continue };
            if thin.add_to(&mut whitened, added).is_none() {
                continue;
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
                whitened.explained(candidate.parts.iter().map(of))
            };
            for place in places {
                let forms: Vec<Candidate> =
                    (0..set.coefficients[place[0]].forms.len()).map(|form| set.candidate(place, form)).collect();
                let all = forms.iter().map(|c| (gain(c), c));
                let Some((_, best)) = all.max_by(|a, b| a.0.total_cmp(&b.0)) else { continue };
                let between = neighbours(best, &forms).into_iter().flat_map(|other| {
                    (1..BETWEEN).map(move |k| best.towards(other, f64::from(k) / f64::from(BETWEEN)))
                });
                let all = std::iter::once(best.clone()).chain(between).map(|c| (gain(&c), c));
                chosen.extend(all.max_by(|a, b| a.0.total_cmp(&b.0)).map(|(_, c)| c));
            }
        }
        chosen
    }

    /// What is left of the channels `along` a direction, beside what is `added` and the noise, and what a random walk
    /// of acceleration explains of it, whose power is whatever explains most. None where a covariance is singular.
    pub(crate) fn beside_a_walk(
        &self,
        along: &DVector<f64>,
        added: &[Candidate],
        noise: &NoiseModel,
    ) -> Option<BesideWalk> {
        let (thin, means_s) = self.thinned();
        let mut whitened = thin.whitened(along, noise, &means_s)?;
        thin.add_to(&mut whitened, added)?;
        let explained = whitened.explained_by_a_walk(&whitened.left(&whitened.whiten(&thin.walk())?));
        Some(BesideWalk { samples: thin, whitened, explained })
    }

    /// Adds what acts on a combination of channels to its model; none where a covariance is singular.
    fn add_to(&self, whitened: &mut Whitened, added: &[Candidate]) -> Option<()> {
        let parts = added.iter().flat_map(|c| &c.parts).map(|(_, form)| form);
        let acting: Vec<DVector<f64>> = parts.filter_map(|form| self.acting(form, &whitened.gains)).collect();
        if !acting.is_empty() {
            let white = whitened.whiten(&DMatrix::from_columns(&acting))?;
            whitened.add(&white);
        }
        Some(())
    }

    /// Columns of which a random walk through each product is the sum with independent amplitudes of one variance,
    /// once its mean is free: `cos(πkt/T)/k` (Karhunen–Loève).
    fn walk(&self) -> DMatrix<f64> {
        let rows = self.products.iter().flatten().map(Stretch::len).sum();
        let mut all = DMatrix::zeros(rows, COSINES * self.products.len());
        let mut first = 0;
        for (product, stretches) in self.products.iter().enumerate() {
            let start_ns = stretches.first().map_or(0, |s| s.first_ns);
            let at_s = |s: &Stretch, k: usize| 1e-9 * (s.first_ns - start_ns) as f64 + (k as f64 + 0.5) * self.step_s;
            let length_s = stretches.last().map_or(0.0, |s| at_s(s, s.len()) - 0.5 * self.step_s);
            for stretch in stretches {
                for k in 0..stretch.len() {
                    let angle = std::f64::consts::PI * at_s(stretch, k) / length_s;
                    for c in 0..COSINES {
                        let order = (c + 1) as f64;
                        all[(first + k, COSINES * product + c)] = (order * angle).cos() / order;
                    }
                }
                first += stretch.len();
            }
        }
        all
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
}

/// A slow force along a direction, and what a random walk explains of it.
pub(crate) struct BesideWalk {
    /// The samples, so far apart as they are weighed.
    pub(crate) samples: SlowSamples,
    whitened: Whitened,
    explained: f64,
}

impl BesideWalk {
    /// What a force of one unit in each channel adds to the combination of channels that shows the direction.
    pub(crate) fn gains(&self) -> &DVector<f64> {
        &self.whitened.gains
    }

    /// What a candidate adds to that combination, by coefficient.
    pub(crate) fn acting(&self, candidate: &Candidate) -> Vec<DVector<f64>> {
        let forms = candidate.parts.iter().map(|(_, form)| form);
        forms.filter_map(|form| self.samples.acting(form, self.gains())).collect()
    }

    /// Whether one of some causes, each by itself, explains the force better than the random walk does: `causes` are
    /// what each adds, by amplitude, and `tried` is of how many they are the best. Where a cause has more free numbers
    /// than the walk's one, each costs the logarithm of the number of samples (Schwarz, 1978), and being the best of
    /// many costs twice the logarithm of their number.
    pub(crate) fn is_explained_by_one_of(&self, causes: &[Vec<DVector<f64>>], tried: f64) -> bool {
        let explained = |acting: &Vec<DVector<f64>>| {
            let white = (!acting.is_empty()).then(|| self.whitened.whiten(&DMatrix::from_columns(acting)))??;
            let left = self.whitened.left(&white);
            let own = left.column_iter().zip(white.column_iter());
            let own = own.filter(|(left, white)| left.norm_squared() > OWN * white.norm_squared());
            let own: Vec<DVector<f64>> = own.map(|(left, _)| left.into_owned()).collect();
            let more = own.len().saturating_sub(1) as f64;
            Some(self.whitened.explained(own.into_iter()) - more * (self.whitened.y.len() as f64).ln())
        };
        let best = causes.iter().filter_map(explained).reduce(f64::max);
        best.is_some_and(|best| best - 2.0 * tried.max(1.0).ln() > self.explained)
    }
}

/// Forms that differ from one in their numbers alone, such as a lag: the nearest below and above.
fn neighbours<'a>(of: &Candidate, forms: &'a [Candidate]) -> Vec<&'a Candidate> {
    let shape = |c: &Candidate| c.parts[0].1.shape.clone();
    let own = shape(of);
    let distance = |c: &Candidate| {
        let mut sum = 0.0;
        for (key, value) in shape(c) {
            match (own.get(&key).and_then(|v| v.as_f64()), value.as_f64()) {
                (Some(a), Some(b)) if a > 0.0 && b > 0.0 => sum += (b / a).ln(),
                _ if own.get(&key) == Some(&value) => {}
                _ => return None,
            }
        }
        Some(sum)
    };
    let all: Vec<(f64, &Candidate)> = forms.iter().filter_map(|c| Some((distance(c)?, c))).collect();
    let nearest = |sign: f64| {
        let side = all.iter().filter(|(d, _)| sign * d > 0.0);
        side.min_by(|a, b| a.0.abs().total_cmp(&b.0.abs())).map(|(_, c)| *c)
    };
    [nearest(-1.0), nearest(1.0)].into_iter().flatten().collect()
}

fn sinc(x: f64) -> f64 {
    if x == 0.0 { 1.0 } else { x.sin() / x }
}

impl Whitened {
    /// Columns of samples of all stretches, whitened; none where a covariance is singular.
    pub(crate) fn whiten(&self, columns: &DMatrix<f64>) -> Option<DMatrix<f64>> {
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
    pub(crate) fn left(&self, white: &DMatrix<f64>) -> DMatrix<f64> {
        white - &self.beside * self.beside.tr_mul(white)
    }

    /// What whitened columns, from which the model is taken off, explain together.
    fn explained(&self, columns: impl Iterator<Item = DVector<f64>>) -> f64 {
        let unit: Vec<DVector<f64>> = columns.filter_map(|d| d.try_normalize(f64::MIN_POSITIVE)).collect();
        if unit.is_empty() {
            return 0.0;
        }
        let d = DMatrix::from_columns(&unit);
        let along = d.tr_mul(&self.y);
        d.tr_mul(&d).pseudo_inverse(OWN).map_or(0.0, |inverse| along.dot(&(inverse * &along)))
    }

    /// What a sum of columns explains whose amplitudes are independent and of one variance, of whatever variance
    /// explains most: twice the rise of the restricted log-likelihood.
    fn explained_by_a_walk(&self, columns: &DMatrix<f64>) -> f64 {
        let modes = columns.tr_mul(columns).symmetric_eigen();
        let along = modes.eigenvectors.tr_mul(&columns.tr_mul(&self.y));
        let largest = modes.eigenvalues.max();
        if largest <= 0.0 {
            return 0.0;
        }
        let gain = |power: f64| {
            let of = |(lambda, z): (&f64, &f64)| {
                let grown = power * lambda.max(0.0);
                power * z.powi(2) / (1.0 + grown) - grown.ln_1p()
            };
            modes.eigenvalues.iter().zip(along.iter()).map(of).sum::<f64>()
        };
        // As far below the noise as above a walk that explains everything.
        let most = (self.y.norm_squared() / OWN).ln();
        let count = (most / POWER_STEP) as usize;
        let powers = (0..count).map(|k| (POWER_STEP * k as f64).exp() * OWN.sqrt() / largest);
        powers.map(gain).fold(0.0, f64::max)
    }

    /// Whitened columns are in the model too.
    fn add(&mut self, white: &DMatrix<f64>) {
        for k in 0..white.ncols() {
            let column = DMatrix::from_column_slice(white.nrows(), 1, white.column(k).as_slice());
            // Twice, so that rounding leaves nothing of the others in it.
            let left = self.left(&self.left(&column));
            if left.norm_squared() > OWN * column.norm_squared() {
                let last = self.beside.ncols();
                self.beside = std::mem::take(&mut self.beside).insert_column(last, 0.0);
                self.beside.set_column(last, &(left.column(0) / left.norm()));
            }
        }
        let y = DMatrix::from_column_slice(self.y.len(), 1, self.y.as_slice());
        self.y = self.left(&y).column(0).into_owned();
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use dragfree_schema::{NoiseProcess, NoiseResponse, NoiseShape, NoiseTerm};
    use rand::SeedableRng;
    use rand_distr::{Distribution, StandardNormal};
    use rand_xoshiro::Xoshiro256PlusPlus;
    use serde_json::json;

    use crate::candidates::{Coefficient, Term};

    /// Distance of the samples that come in, s.
    pub(crate) const IN_S: f64 = 5.0;
    /// Amplitude spectral densities of a force on both channels and of one on each, m s⁻² Hz^-½.
    const BOTH: f64 = 1e-10;
    const EACH: f64 = 1e-13;

    pub(crate) fn noise() -> NoiseModel {
        let process = |name: &str, asd: f64, enters: [Vec<f64>; 2]| NoiseProcess {
            name: name.to_owned(),
            unit: "m s-2".to_owned(),
            spectrum: Some(NoiseShape { terms: vec![NoiseTerm { asd, corner_hz: 1.0, exponent: 0 }] }),
            response: NoiseResponse::Held,
            enters: ["a", "b"].map(str::to_owned).into_iter().zip(enters).collect(),
            ..NoiseProcess::default()
        };
        let both = process("both", BOTH, [vec![1.0], vec![1.0]]);
        let each = process("each", EACH, [vec![1.0, 0.0], vec![0.0, 1.0]]);
        NoiseModel::new(&[both, each], &["a".to_owned(), "b".to_owned()], IN_S).expect("a noise model")
    }

    /// The first of the two channels.
    pub(crate) fn first() -> DVector<f64> {
        DVector::from_vec(vec![1.0, 0.0])
    }

    /// Two channels of that noise, to which `force` is added in the first, and series as columns after them.
    pub(crate) fn samples(
        seed: u64,
        hours: f64,
        force: impl Fn(f64) -> f64,
        series: &[&dyn Fn(f64) -> f64],
        housekeeping: &[&dyn Fn(f64) -> f64],
    ) -> SlowSamples {
        let mut rng = Xoshiro256PlusPlus::seed_from_u64(seed);
        let count = (3600.0 * hours / IN_S) as usize;
        // Of a one-sided density S every IN_S: variance S/(2 IN_S).
        let mut white = |asd: f64| {
            asd * (2.0 * IN_S).sqrt().recip() * <StandardNormal as Distribution<f64>>::sample(&StandardNormal, &mut rng)
        };
        let mut columns = vec![Vec::new(); 2];
        for k in 0..count {
            let both = white(BOTH);
            columns[0].push(both + white(EACH) + force(IN_S * k as f64));
            columns[1].push(both + white(EACH));
        }
        let of = |f: &&dyn Fn(f64) -> f64| (0..count).map(|k| f(IN_S * k as f64)).collect::<Vec<f64>>();
        columns.extend(series.iter().chain(housekeeping).map(of));
        let (names, units) = (0..housekeeping.len()).map(|i| (format!("hk/{i}"), "A".to_owned())).unzip();
        let width = 2 + series.len();
        let mut thinner = Thinner::new(names, units, (1e9 * IN_S) as i64, DMatrix::identity(2, 2), width);
        // In portions, whose bounds change nothing.
        for first in (0..count).step_by(1000) {
            let end = (first + 1000).min(count);
            let times: Vec<i64> = (first..end).map(|k| (1e9 * IN_S) as i64 * k as i64).collect();
            thinner.push(&times, &columns.iter().map(|c| &c[first..end]).collect::<Vec<_>>());
        }
        thinner.finish()
    }

    /// Whitened noise has unit variance and no correlation, and the noise that both channels share is gone: 20 sets of
    /// 12 hours, some 430 numbers each. False alarm 1e-5 each.
    #[test]
    fn whitened_noise_is_white() {
        let (mut squares, mut products, mut n) = (0.0, 0.0, 0.0);
        for seed in 0..20 {
            let (thin, means_s) = samples(seed, 12.0, |_| 0.0, &[], &[]).thinned();
            let whitened = thin.whitened(&first(), &noise(), &means_s).expect("a covariance");
            squares += whitened.y.norm_squared();
            n += (whitened.y.len() - POWERS) as f64;
            products += whitened.y.as_slice().windows(2).map(|w| w[0] * w[1]).sum::<f64>();
        }
        // The covariance is of a density over positive frequencies, so the variance of y is that of the samples.
        assert!((squares / n - 1.0).abs() < 4.4 * (2.0 / n).sqrt(), "{}", squares / n);
        // Powers of time leave −POWERS/n.
        assert!((products / n + POWERS as f64 * 20.0 / n).abs() < 4.4 / n.sqrt(), "{}", products / n);
    }

    fn coefficient(name: &str, columns: &[&[usize]]) -> Coefficient {
        let term = |column: &usize| Term { channel: 0, column: *column, factor: 1.0, times: None };
        let form = |columns: &&[usize]| Form {
            shape: [("columns".to_owned(), json!(columns))].into_iter().collect(),
            unit: "1".to_owned(),
            lower: None,
            upper: None,
            terms: columns.iter().map(term).collect(),
            colours: None,
        };
        Coefficient {
            name: name.to_owned(),
            effect: name.to_owned(),
            instance: "x".to_owned(),
            initial: 0.0,
            prior_sigma: None,
            estimate: true,
            candidate: true,
            transient: false,
            forms: columns.iter().map(form).collect(),
            noise: String::new(),
        }
    }

    /// Cosines of a random walk have no mean over samples without gaps.
    #[test]
    fn a_random_walk_has_no_mean() {
        let walk = samples(1, 4.0, |_| 0.0, &[], &[]).walk();
        assert!(walk.nrows() > COSINES && walk.row_sum().iter().all(|sum| sum.abs() < 1e-9), "{}", walk.row_sum());
    }

    /// A force that changes once in the data, of which one form of a candidate is the series and another nearly: the
    /// form is the right one, and beside that candidate a second force in another form is found.
    #[test]
    fn the_form_is_that_of_the_whole_run() {
        let hours = 10.0;
        let rise = |start_h: f64| move |t: f64| (1.0 + ((t / 3600.0 - start_h) / 0.7).tanh()) / 2.0;
        let (a, b, c, d) = (rise(4.0), rise(4.4), rise(7.0), rise(7.4));
        let force = |t: f64| 4e-14 * a(t) + 2e-14 * d(t);
        let all = samples(5, hours, force, &[&a, &b, &c, &d], &[]);
        let set = CandidateSet {
            channels: vec!["a".to_owned(), "b".to_owned()],
            coefficients: vec![coefficient("first", &[&[2], &[3]]), coefficient("second", &[&[4], &[5]])],
            rules: Vec::new(),
        };
        let columns = |c: &Candidate| c.parts[0].1.shape["columns"].clone();
        let places = set.places();
        let first = all.forms_of(&places[..1], &set, 2, &[set.candidate(&[1], 1)], &noise());
        assert_eq!(first.iter().map(columns).collect::<Vec<_>>(), [json!([2])]);
        let second = all.forms_of(&places[1..], &set, 2, &first, &noise());
        assert_eq!(second.iter().map(columns).collect::<Vec<_>>(), [json!([5])]);
    }

    /// A random walk with steps of unit variance in every hour.
    pub(crate) fn random_walk(seed: u64, hours: f64) -> impl Fn(f64) -> f64 {
        let mut rng = Xoshiro256PlusPlus::seed_from_u64(seed);
        let step = (IN_S / 3600.0).sqrt();
        let mut sum = 0.0;
        let mut next = || {
            sum += step * <StandardNormal as Distribution<f64>>::sample(&StandardNormal, &mut rng);
            sum
        };
        let walk: Vec<f64> = (0..(3600.0 * hours / IN_S) as usize + 1).map(|_| next()).collect();
        move |t: f64| walk[(t / IN_S) as usize]
    }

    /// A force that is one of eight random walks is explained by that one, in 100 sets of nine hours, and one that is
    /// none of them by a random walk of its own. By chance one of eight resembles it as well in one of 200 sets (seeds
    /// 0 to 199), so that more than five of 100 are a false alarm of 1e-5.
    #[test]
    fn a_slow_force_is_told_from_an_unknown_one() {
        let (hours, size) = (9.0, 1e-14);
        let (mut unknown, mut own) = (0, 0);
        for seed in 0..100 {
            let walks: Vec<_> = (0..9).map(|k| random_walk(1000 + 10 * seed + k, hours)).collect();
            let series: Vec<&dyn Fn(f64) -> f64> = walks[1..].iter().map(|w| w as &dyn Fn(f64) -> f64).collect();
            let set = CandidateSet {
                channels: vec!["a".to_owned(), "b".to_owned()],
                coefficients: (0..8).map(|k| coefficient(&format!("walk{k}"), &[&[2 + k]])).collect(),
                rules: Vec::new(),
            };
            let all: Vec<Candidate> = (0..8).map(|k| set.candidate(&[k], 0)).collect();
            let is_explained = |force: &dyn Fn(f64) -> f64| {
                let samples = samples(seed, hours, |t| size * force(t), &series, &[]);
                let beside = samples.beside_a_walk(&first(), &[], &noise()).expect("a covariance");
                let causes: Vec<_> = all.iter().map(|c| beside.acting(c)).collect();
                assert!(seed > 0 || !beside.is_explained_by_one_of(&[], 1.0), "by no cause");
                usize::from(beside.is_explained_by_one_of(&causes, 8.0))
            };
            unknown += is_explained(&walks[0]);
            own += is_explained(&walks[1]);
        }
        assert_eq!(own, 100);
        assert!(unknown <= 5, "{unknown}");
    }
}
