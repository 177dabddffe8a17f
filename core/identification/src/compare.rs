//! Where the model fails: residual power per channel, band and hour against the prediction of the mission's noise.
//!
//! The model is fitted as [`crate::diagnosis`] fits it, and its residuals are compared with Σ of the mission file: a Σ
//! refined from the residuals would explain them by construction. `R_b`, measured over predicted power of a band, has
//! the mean 1 and n complex observations, `2n R_b` being χ² with 2n degrees of freedom. n follows from the weights of
//! the tapered, overlapping segments ([`dragfree_estimation::spectra::Spectra::observations`]); what the model's few
//! coefficients take of it is not counted.
//!
//! Every channel has five tests, each at [`dragfree_schema::Settings::false_alarm`] over the number of all tests
//! (Bonferroni): `level`, `bands`, `hours`, `cumulative` and `ljung-box`; see [`Test`].
//!
//! **Null combinations.** An acceleration a of the spacecraft appears in the channels of mass i as `A_i a`; the columns
//! of `A_i` are those of the processes `thruster_force` of Σ. `A_1⁺ z_1 − A_2⁺ z_2` is free of a, and the mean of the
//! two is the *common* acceleration. A model that fails in the channels and not in the null combinations has its fault
//! in the forces on the spacecraft.

use std::collections::BTreeMap;
use std::f64::consts::PI;
use std::ops::Range;

use dragfree_estimation::estimate::colours;
use dragfree_estimation::levels::Levels;
use dragfree_estimation::sigma::NoiseModel;
use dragfree_estimation::spectra::{Band, Plan, Spectra};
use nalgebra::{Cholesky, DMatrix, DVector};
use serde::Serialize;

use crate::coherence::{Coherence, StepwiseCoherence};
use crate::distributions::{chi2_per_dof_quantile, chi2_tails, corrected, kolmogorov, two_sided};
use crate::scores::{CandidateScorer, IdentificationError};

/// Lags of the portmanteau test. Bands are 1/16 of their frequency wide: the cosine of a longer lag turns round within
/// one.
const LAGS: usize = 10;

/// A power of a band against its prediction.
#[derive(Clone, Debug, Serialize)]
pub struct Cell {
    /// First and last frequency, Hz.
    pub band_hz: [f64; 2],
    /// Measured over predicted power; none where no segment reaches.
    pub chi2_per_dof: Option<f64>,
    /// Degrees of freedom.
    pub dof: f64,
}

/// A test of a channel.
#[derive(Clone, Debug, Serialize)]
pub struct Test {
    /// * `level`: χ²/dof over all bands.
    /// * `bands`: χ²/dof of the band that is farthest from 1: narrow ones (1/16), thirds of a decade, and everything
    ///   below the end of
    ///   each third.
    /// * `hours`: the same of single hours, in thirds of a decade.
    /// * `cumulative`: the cumulative periodogram of the whitened residual, its largest distance from a straight line
    ///   times √n
    ///   (Bartlett 1955); it does not ask for the level.
    /// * `ljung-box`: autocorrelations of the whitened residual at ten lags, taken from its spectrum:
    ///   `r_k = ∫ R cos 2πfkΔt df / ∫ R df`, and `Q = rᵀ C⁻¹ r` with the covariance C that bands of that width give.
    ///   With bands of one bin it is Ljung and Box's n Σ r_k².
    pub name: &'static str,
    /// What is compared.
    pub statistic: f64,
    /// p-value, corrected for the cells within the test.
    pub p_value: f64,
    /// Whether `p_value` is above the rate of this test.
    pub passes: bool,
    /// The cell that is farthest out.
    pub at: Option<Place>,
}

/// Band and hour.
#[derive(Clone, Debug, Serialize)]
pub struct Place {
    /// First and last frequency, Hz.
    pub band_hz: [f64; 2],
    /// Start of the hour, Unix ns; none for all hours.
    pub hour_ns: Option<i64>,
}

/// What a channel is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Kind {
    /// One of the channels of the product.
    Channel,
    /// The acceleration that all test masses see, along an axis of the spacecraft.
    Common,
    /// The difference between two test masses, which no force on the spacecraft reaches.
    Null,
}

/// A channel, or a combination of some.
#[derive(Clone, Debug, Serialize)]
pub struct Channel {
    /// `tm1.accel.x`, `common.sc.x` or `null.sc.x`.
    pub name: String,
    /// Channels and their weights.
    pub combination: Vec<(String, f64)>,
    /// What it is.
    pub kind: Kind,
    /// Frequencies, Hz.
    pub frequency_hz: Vec<f64>,
    /// One-sided PSD of the residual, unit of the channel squared per Hz.
    pub measured_psd: Vec<f64>,
    /// The same as the declared noise predicts it.
    pub predicted_psd: Vec<f64>,
    /// Ends of the interval in which 95 % of `measured_psd / predicted_psd` lie if the prediction is right.
    pub interval_95: Vec<[f64; 2]>,
    /// Measured over predicted power over all bands.
    pub chi2_per_dof: f64,
    /// Degrees of freedom.
    pub dof: f64,
    /// The same against the mission's noise with the levels that fit the residuals best: about 1 where a level is all
    /// that is wrong.
    pub chi2_per_dof_fitted_levels: f64,
    /// Share of the whitened power beyond prediction, every third of a decade weighing alike, and only where the excess
    /// is certain: `Σ (R−1) / Σ R`.
    pub unexplained: f64,
    /// Thirds of a decade, all hours together.
    pub bands: Vec<Cell>,
    /// Hour by hour, the same bands.
    pub map: Vec<Vec<Cell>>,
    /// Part of the whitened power expected and measured up to each frequency.
    pub cumulative: Vec<[f64; 2]>,
    /// Half width in which a cumulative periodogram stays, at the rate of a single test.
    pub cumulative_limit: f64,
    /// Autocorrelations of the whitened residual at lags of 1, 2 … samples.
    pub autocorrelation: Vec<f64>,
    /// Tests; none where the channel holds more than declared noise.
    pub tests: Vec<Test>,
    /// Whether all are passed.
    pub passes: bool,
}

/// NIS of the recursive filters.
#[derive(Clone, Debug, Serialize)]
pub struct Nis {
    /// Mean normalised innovation squared per degree of freedom.
    pub value: f64,
    /// Degrees of freedom.
    pub dof: f64,
    /// Bounds at [`dragfree_schema::Settings::false_alarm`].
    pub bounds: [f64; 2],
    /// Whether it lies between them.
    pub passes: bool,
}

impl Nis {
    /// Judges the filter's mean normalised innovation squared.
    pub fn new(value: f64, dof: f64, false_alarm: f64) -> Self {
        let bounds = [0.5 * false_alarm, 1.0 - 0.5 * false_alarm].map(|p| chi2_per_dof_quantile(p, dof));
        Self { value, dof, bounds, passes: (bounds[0]..=bounds[1]).contains(&value) }
    }
}

/// Innovations of a readout in the recursive filter, octave by octave.
///
/// They are white if the filter's model, the mission's noise and the gains are right. A filter that adapts has other
/// gains, and one for each test mass lacks the other's readouts. So this tells where in frequency the filter is wrong,
/// and is no part of the verdict.
#[derive(Clone, Debug, Serialize)]
pub struct Innovations {
    /// `tm1.x`.
    pub readout: String,
    /// Octaves, the highest first: `chi2_per_dof` is the mean square over what the mission's noise predicts for the
    /// gains in use.
    pub octaves: Vec<Cell>,
    /// p-value of the octave that is farthest from one, corrected for all octaves of all readouts.
    pub p_value: f64,
    /// The number of that octave.
    pub farthest: usize,
    /// Whether the p-value is above [`dragfree_schema::Settings::false_alarm`].
    pub passes: bool,
}

impl Innovations {
    /// Judges readouts sampled at `rate_hz` by mean squares and counts of each octave, as [Haar's wavelets][1] give
    /// them.
    ///
    /// [1]: https://en.wikipedia.org/wiki/Haar_wavelet
    pub fn judge(readouts: &BTreeMap<String, Vec<(f64, u64)>>, rate_hz: f64, false_alarm: f64) -> Vec<Self> {
        let told = |octaves: &Vec<(f64, u64)>| octaves.iter().filter(|(_, n)| *n > 0).count();
        let trials: usize = readouts.values().map(told).sum();
        let band = |k: usize| [2.0, 1.0].map(|of| rate_hz / (of * (2usize << k) as f64));
        let of = |(readout, octaves): (&String, &Vec<(f64, u64)>)| {
            let cell = |(k, (power, n)): (usize, &(f64, u64))| Cell {
                band_hz: band(k),
                chi2_per_dof: (*n > 0).then_some(*power),
                dof: *n as f64,
            };
            let octaves: Vec<Cell> = octaves.iter().enumerate().map(cell).collect();
            let chance = |c: &Cell| c.chi2_per_dof.map_or(1.0, |power| two_sided(power, c.dof));
            let far = octaves.iter().enumerate().min_by(|a, b| chance(a.1).total_cmp(&chance(b.1)))?;
            let p_value = corrected(chance(far.1), trials as f64);
            let farthest = far.0;
            Some(Self { readout: readout.clone(), passes: p_value >= false_alarm, p_value, farthest, octaves })
        };
        readouts.iter().filter_map(of).collect()
    }
}

/// A coherence of housekeeping with a residual that is certain.
#[derive(Clone, Debug, Serialize)]
pub struct SignificantCoherence {
    /// The driver and its coherence.
    #[serde(flatten)]
    pub coherence: Coherence,
    /// p-value, corrected for every driver and channel.
    pub p_value: f64,
}

/// The answer.
#[derive(Clone, Debug, Serialize)]
pub struct Comparison {
    /// `passes` or `fails`.
    pub verdict: &'static str,
    /// Whether every channel passes every test.
    pub passes: bool,
    /// False-alarm rate of all tests together.
    pub false_alarm_rate: f64,
    /// False-alarm rate of a single test.
    pub false_alarm_rate_per_test: f64,
    /// Segments and their length, s.
    pub segments: u64,
    /// Length of a segment, s.
    pub segment_s: f64,
    /// Starts of the hours of the maps, Unix ns.
    pub hours_ns: Vec<i64>,
    /// Channels, then what is common to the test masses, then null combinations.
    pub channels: Vec<Channel>,
    /// Innovations of the recursive filter; no part of the verdict.
    pub nis: Option<Nis>,
    /// The same octave by octave; no part of the verdict either.
    pub innovations: Vec<Innovations>,
    /// Significant coherences of housekeeping with residuals: evidence, not a test, since actuator currents follow
    /// commands, and these the noise.
    pub coherences: Vec<SignificantCoherence>,
    /// Per channel the drivers selected by partial coherence, with their multiple coherence.
    pub together: Vec<StepwiseCoherence>,
}

/// Measured over predicted power per band, with the complex observations behind it.
#[derive(Clone, Debug)]
struct Ratios {
    ratio: Vec<f64>,
    observations: Vec<f64>,
}

impl Ratios {
    /// Mean over a range of bands, and the observations of it. `Spectra::observations` counts for bands of many bins;
    /// neighbouring bins of a Hann window share 4/9 of their power, the next 1/36, so that few bins know more than
    /// their part.
    fn mean(&self, bands: &[Band], range: Range<usize>) -> (f64, f64) {
        let n: f64 = self.observations[range.clone()].iter().sum();
        let sum: f64 = range.clone().map(|b| self.observations[b] * self.ratio[b]).sum();
        let bins: usize = bands[range].iter().map(|b| b.bins()).sum();
        let m = bins as f64;
        let variance = 1.0 + 2.0 * (4.0 / 9.0 * (1.0 - 1.0 / m) + (1.0 - 2.0 / m).max(0.0) / 36.0);
        (sum / n.max(f64::MIN_POSITIVE), n * (35.0 / 18.0) / variance)
    }
}

/// Compares the sums with the mission's noise. `nis` and `innovations` are those of the recursive filters, from the
/// products.
///
/// # Errors
/// [`IdentificationError`]: too little data, or a model that cannot be fitted.
pub fn compare(
    scorer: &CandidateScorer<'_>,
    nis: Option<Nis>,
    innovations: Vec<Innovations>,
) -> Result<Comparison, IdentificationError> {
    let (gathered, names, settings) = (scorer.gathered, &scorer.candidate_set.channels, scorer.settings);
    // The hours and their sum are of segments of one length, whatever else was gathered.
    let plan = &gathered.hour_plan();
    let base = gathered.columns.base;
    let mut whole = Spectra::zero(plan.bands.len(), base);
    gathered.hours.iter().for_each(|h| whole.add(&h.spectra));
    let whole_observations = observations(&whole, plan);
    // The lowest band is seen by segments of full length alone, one observation each.
    let lowest = plan.bands.first().map_or(1, |b| b.bins()) as f64;
    scorer.require(
        "comparison",
        scorer.settings.min_segments,
        whole_observations.first().map_or(0.0, |n| n / lowest),
    )?;
    let fit = scorer.fit(&[])?;
    let residual = residual(scorer, fit.estimate.theta.as_slice());
    let psd = |spectra: &Spectra| -> Vec<DMatrix<f64>> {
        let band = |b: usize| {
            let sums = &residual * unpacked(spectra.band(b, base), base) * residual.transpose();
            sums / spectra.expected[b].max(f64::MIN_POSITIVE)
        };
        (0..plan.bands.len()).map(band).collect()
    };
    let measured = psd(&whole);
    let hours: Vec<Vec<DMatrix<f64>>> = gathered.hours.iter().map(|h| psd(&h.spectra)).collect();
    let hour_observations: Vec<Vec<f64>> = gathered.hours.iter().map(|h| observations(&h.spectra, plan)).collect();
    let predicted = predicted(scorer.noise, plan);
    let unknowns = scorer.candidate_set.unknowns(&[]);
    let mut levels = Levels::new(scorer.noise, plan, &whole, &measured, settings)
        .coloured(plan, &colours(&unknowns, &fit.estimate.theta));
    levels.fit();

    let known = |i: usize| scorer.noise.residual()[i];
    let single = |i: usize| DVector::from_fn(names.len(), |j, _| f64::from(u8::from(i == j)));
    let mut combinations: Vec<(String, DVector<f64>, Kind)> =
        (0..names.len()).map(|i| (names[i].clone(), single(i), Kind::Channel)).collect();
    combinations.extend(pairs(scorer.noise, names, gathered.rate_hz));
    let tested = |w: &DVector<f64>| (0..names.len()).all(|i| w[i] == 0.0 || known(i));
    let allowed =
        settings.false_alarm / (TESTS * combinations.iter().filter(|(_, w, _)| tested(w)).count().max(1)) as f64;
    let hours_ns: Vec<i64> = gathered.hours.iter().map(|h| h.start_ns).collect();
    let channels: Vec<Channel> = combinations
        .into_iter()
        .map(|(name, w, kind)| {
            let power = |m: &DMatrix<f64>| w.dot(&(m * &w));
            let expected: Vec<f64> = predicted.iter().map(power).collect();
            let of = |measured: &[DMatrix<f64>], observations: Vec<f64>| Ratios {
                ratio: measured.iter().zip(&expected).map(|(m, p)| power(m) / p).collect(),
                observations,
            };
            let total = of(&measured, whole_observations.clone());
            let by_hour: Vec<Ratios> = hours.iter().zip(&hour_observations).map(|(m, n)| of(m, n.clone())).collect();
            let mut channel = judge(plan, &total, &by_hour, &hours_ns, allowed, settings.outside_interval);
            channel.measured_psd = measured.iter().map(power).collect();
            channel.chi2_per_dof_fitted_levels = {
                // The level's prediction lies on the middle of a band, as the plain one it is compared with.
                let at = |b: usize| power(&scorer.noise.psd(plan.frequency_hz(plan.bands[b])));
                let ratio = |b: usize| total.ratio[b] * at(b) / power(&levels.modelled()[b]);
                let n = &total.observations;
                (0..n.len()).map(|b| n[b] * ratio(b)).sum::<f64>() / n.iter().sum::<f64>()
            };
            channel.predicted_psd = expected;
            channel.combination =
                names.iter().zip(w.iter()).filter(|(_, x)| **x != 0.0).map(|(n, x)| (n.clone(), *x)).collect();
            if !tested(&w) {
                (channel.tests, channel.passes, channel.unexplained) = (Vec::new(), true, 0.0);
            }
            (channel.name, channel.kind) = (name, kind);
            channel
        })
        .collect();
    let all = gathered.housekeeping.coherences(names);
    let passes = channels.iter().all(|c| c.passes);
    let coherences = all.into_iter().map(|c| SignificantCoherence { p_value: c.p_value(), coherence: c });
    Ok(Comparison {
        verdict: if passes { "passes" } else { "fails" },
        passes,
        false_alarm_rate: settings.false_alarm,
        false_alarm_rate_per_test: allowed,
        segments: whole.segments,
        segment_s: gathered.length as f64 / gathered.rate_hz,
        hours_ns,
        channels,
        nis,
        innovations,
        coherences: coherences.filter(|w| w.p_value < settings.false_alarm).take(settings.max_coherences).collect(),
        together: gathered.housekeeping.stepwise_coherence(names, settings.false_alarm),
    })
}

/// Residuals as combinations of the base columns: channels × columns.
fn residual(scorer: &CandidateScorer<'_>, theta: &[f64]) -> DMatrix<f64> {
    let columns = &scorer.gathered.columns;
    let mut out = DMatrix::identity(columns.channels, columns.base);
    for (c, value) in scorer.candidate_set.coefficients.iter().zip(theta) {
        for t in &c.forms[0].terms {
            out[(t.channel, t.column)] -= value * t.factor * t.times.map_or(1.0, |other| theta[other]);
        }
    }
    out
}

fn unpacked(triangle: &[f64], n: usize) -> DMatrix<f64> {
    DMatrix::from_fn(n, n, |i, j| {
        let (i, j) = (i.max(j), i.min(j));
        triangle[i * (i + 1) / 2 + j]
    })
}

/// Complex observations of some hours, corrected for the overlap of segments by half, which their sums do not count.
fn observations(hours: &Spectra, plan: &Plan) -> Vec<f64> {
    let count = |overlaps: bool| {
        let mut s = Spectra::zero(plan.bands.len(), 0);
        (0..hours.segments).for_each(|k| s.count_segment(plan, 0, overlaps && k > 0));
        s.kept().first().copied().unwrap_or(0.0)
    };
    let cost = if hours.segments > 0 { count(true) / count(false) } else { 0.0 };
    hours.observations(plan).into_iter().map(|n| n * cost).collect()
}

/// Σ of the mission as segments see it: under a Hann window a bin holds 2/3 of its own power and 1/6 of each
/// neighbour's, exact for spectra up to f⁴ (the window's second and fourth moments), and a band the mean of its bins.
fn predicted(noise: &NoiseModel, plan: &Plan) -> Vec<DMatrix<f64>> {
    let at = |k: usize| noise.psd(plan.bin_hz(k as f64));
    plan.bands
        .iter()
        .map(|band| {
            let inside = (band.first..band.end).fold(at(band.first) * 0.0, |sum, k| sum + at(k));
            // Of the sum over bins the inner ones lose to their neighbours what they gain from them.
            let [a, b, c, d] = [band.first - 1, band.first, band.end - 1, band.end].map(at);
            (inside + (a - b - c + d) / 6.0) / band.bins() as f64
        })
        .collect()
}

/// Common and null combinations of two test masses; none where not both see every direction of a force.
fn pairs(noise: &NoiseModel, channels: &[String], rate_hz: f64) -> Vec<(String, DVector<f64>, Kind)> {
    let vectors = noise.vector_processes().into_iter().filter(|axes| !axes.iter().any(|a| noise.is_estimated(a)));
    vectors.map(|axes| pairs_of(noise, &axes, channels, rate_hz)).find(|pairs| !pairs.is_empty()).unwrap_or_default()
}

/// The same of one vector process, by the names of its components, `PROCESS:AXIS`. A channel's first word names its
/// body.
fn pairs_of(noise: &NoiseModel, axes: &[&str], channels: &[String], rate_hz: f64) -> Vec<(String, DVector<f64>, Kind)> {
    let n = channels.len();
    // Each component is one vector times itself: the acceleration along an axis as the channels see it.
    let columns: Vec<DVector<f64>> = axes
        .iter()
        .filter_map(|axis| noise.process_psd(axis, 0.01 * rate_hz))
        .map(|p| p.column(p.diagonal().imax()).into_owned())
        .collect();
    let body = |i: usize| channels[i].split('.').next().unwrap_or_default();
    let mut bodies: Vec<&str> = Vec::new();
    for i in (0..n).filter(|i| columns.iter().any(|c| c[*i] != 0.0)) {
        if !bodies.contains(&body(i)) {
            bodies.push(body(i));
        }
    }
    let [first, second] = bodies[..] else { return Vec::new() };
    let seen_by = |name: &str| {
        let rows: Vec<usize> = (0..n).filter(|i| body(*i) == name).collect();
        (DMatrix::from_fn(rows.len(), axes.len(), |i, k| columns[k][rows[i]]), rows)
    };
    let (mut a, rows_a) = seen_by(first);
    let (mut b, rows_b) = seen_by(second);
    // A unit of acceleration along the axis, and up where the first body sees most of it.
    for k in 0..axes.len() {
        let scale = a[(a.column(k).icamax(), k)].signum() * a.column(k).norm();
        a.column_mut(k).unscale_mut(scale);
        b.column_mut(k).unscale_mut(scale);
    }
    let inverse = |m: &DMatrix<f64>| m.clone().pseudo_inverse(1e-9).ok().filter(|_| m.rank(1e-9) == axes.len());
    let (Some(from_a), Some(from_b)) = (inverse(&a), inverse(&b)) else { return Vec::new() };
    let along = |k: usize, kind: Kind| {
        let (name, of_a, of_b) = if kind == Kind::Null { ("null", 1.0, -1.0) } else { ("common", 0.5, 0.5) };
        let mut weights = DVector::zeros(n);
        let rounded = |x: f64| if x.abs() < 1e-12 { 0.0 } else { x };
        rows_a.iter().enumerate().for_each(|(j, i)| weights[*i] = rounded(of_a * from_a[(k, j)]));
        rows_b.iter().enumerate().for_each(|(j, i)| weights[*i] = rounded(of_b * from_b[(k, j)]));
        let axis = axes[k].split_once(':').map_or(axes[k], |(_, axis)| axis);
        (format!("{name}.{axis}"), weights, kind)
    };
    [Kind::Common, Kind::Null]
        .into_iter()
        .flat_map(|kind| (0..axes.len()).map(move |k| (k, kind)))
        .map(|(k, kind)| along(k, kind))
        .collect()
}

/// Ranges of bands, a third of a decade each.
fn thirds(bands: &[Band]) -> Vec<Range<usize>> {
    let mut out = Vec::new();
    let mut first = 0;
    while first < bands.len() {
        let limit = bands[first].first as f64 * 10.0f64.powf(1.0 / 3.0);
        let end = first + bands[first..].iter().take_while(|b| (b.first as f64) < limit).count();
        out.push(first..end);
        first = end;
    }
    out
}

/// Tests of a channel.
const TESTS: usize = 5;

/// Tests a channel. `allowed` is the false-alarm rate of a single test.
fn judge(plan: &Plan, total: &Ratios, hours: &[Ratios], hours_ns: &[i64], allowed: f64, outside: f64) -> Channel {
    let bands = &plan.bands;
    let thirds = thirds(bands);
    let hz = |r: &Range<usize>| [bands[r.start].first, bands[r.end - 1].end - 1].map(|k| plan.bin_hz(k as f64));
    let cell = |ratios: &Ratios, range: &Range<usize>| {
        let (mean, n) = ratios.mean(bands, range.clone());
        Cell { band_hz: hz(range), chi2_per_dof: (n > 0.0).then_some(mean), dof: 2.0 * n }
    };
    let n: f64 = total.observations.iter().sum();
    let part: Vec<f64> = total.observations.iter().map(|o| o / n).collect();
    let mean: f64 = part.iter().zip(&total.ratio).map(|(w, r)| w * r).sum();
    let test =
        |name, statistic: f64, p_value: f64, at| Test { name, statistic, p_value, passes: p_value >= allowed, at };
    // The cell that is farthest out.
    let farthest = |name, cells: &[(Cell, Option<i64>)]| {
        let chance = |c: &Cell| c.chi2_per_dof.map_or(1.0, |r| two_sided(r, c.dof));
        let tried = cells.iter().filter(|(c, _)| c.chi2_per_dof.is_some()).count();
        let worst = cells.iter().map(|(c, hour)| (chance(c), c, hour)).min_by(|a, b| a.0.total_cmp(&b.0));
        let (p, place) = worst.map_or((1.0, None), |(p, c, hour)| (p, Some((c, hour))));
        let at = place.map(|(c, hour)| Place { band_hz: c.band_hz, hour_ns: *hour });
        test(name, place.and_then(|(c, _)| c.chi2_per_dof).unwrap_or(f64::NAN), corrected(p, tried as f64), at)
    };
    let whole: Vec<Cell> = thirds.iter().map(|r| cell(total, r)).collect();
    let map: Vec<Vec<Cell>> = hours.iter().map(|h| thirds.iter().map(|r| cell(h, r)).collect()).collect();
    let narrow = (0..bands.len()).map(|b| cell(total, &(b..b + 1)));
    let slow = thirds[1..].iter().map(|r| cell(total, &(0..r.end)));
    let all_hours: Vec<_> = narrow.chain(whole.iter().cloned()).chain(slow).map(|c| (c, None)).collect();
    let with_hour = |(row, hour): (&Vec<Cell>, &i64)| row.iter().map(|c| (c.clone(), Some(*hour))).collect::<Vec<_>>();
    let by_hour: Vec<_> = map.iter().zip(hours_ns).flat_map(with_hour).collect();

    let mut cumulative = Vec::with_capacity(bands.len());
    let (mut expected, mut power) = (0.0, 0.0);
    for (w, r) in part.iter().zip(&total.ratio) {
        expected += w;
        power += w * r / mean;
        cumulative.push([expected, power]);
    }
    let apart = cumulative.iter().map(|[e, p]| (e - p).abs()).fold(0.0, f64::max) * n.sqrt();
    let (autocorrelation, portmanteau) = autocorrelations(plan, &part, &total.ratio, n);
    let tests = vec![
        test("level", mean, two_sided(mean, 2.0 * n), None),
        farthest("bands", &all_hours),
        farthest("hours", &by_hour),
        test("cumulative", apart, kolmogorov(apart), None),
        test("ljung-box", portmanteau, chi2_tails(portmanteau / LAGS as f64, LAGS as f64).1, None),
    ];
    let beyond = |c: &Cell| {
        let certain =
            c.chi2_per_dof.filter(|r| *r > 1.0 && corrected(two_sided(*r, c.dof), whole.len() as f64) < allowed);
        certain.map_or(0.0, |r| r - 1.0)
    };
    let beyond: f64 = whole.iter().map(beyond).sum();
    let both: f64 = whole.iter().filter_map(|c| c.chi2_per_dof).sum();
    let interval = |b: usize| {
        let (_, n) = total.mean(bands, b..b + 1);
        [0.5 * outside, 1.0 - 0.5 * outside].map(|p| chi2_per_dof_quantile(p, 2.0 * n))
    };
    Channel {
        name: String::new(),
        combination: Vec::new(),
        kind: Kind::Channel,
        frequency_hz: bands.iter().map(|b| plan.frequency_hz(*b)).collect(),
        measured_psd: Vec::new(),
        predicted_psd: Vec::new(),
        interval_95: (0..bands.len()).map(interval).collect(),
        chi2_per_dof: mean,
        dof: 2.0 * n,
        chi2_per_dof_fitted_levels: f64::NAN,
        unexplained: beyond / both,
        bands: whole,
        map,
        cumulative,
        cumulative_limit: kolmogorov_point(allowed) / n.sqrt(),
        autocorrelation,
        passes: tests.iter().all(|t| t.passes),
        tests,
    }
}

/// The distance that a Brownian bridge exceeds with this probability.
fn kolmogorov_point(p: f64) -> f64 {
    // The first term of the series, of which the next is the fourth power.
    (-0.5 * (0.5 * p).ln()).sqrt()
}

/// Autocorrelations at the first [`LAGS`] lags, and `rᵀ C⁻¹ r`.
fn autocorrelations(plan: &Plan, part: &[f64], ratio: &[f64], n: f64) -> (Vec<f64>, f64) {
    // Mean of cos 2πfkΔt over a band.
    let cosine = |lag: usize, band: &Band| {
        let turn = |edge: f64| 2.0 * PI * lag as f64 * edge / plan.length as f64;
        let (a, b) = (turn(band.first as f64 - 0.5), turn(band.end as f64 - 0.5));
        (b.sin() - a.sin()) / (b - a)
    };
    let cosines = DMatrix::from_fn(LAGS, part.len(), |k, b| cosine(k + 1, &plan.bands[b]));
    let part = DVector::from_column_slice(part);
    let mean = part.dot(&DVector::from_column_slice(ratio));
    let excess = DVector::from_fn(ratio.len(), |b, _| part[b] * (ratio[b] / mean - 1.0));
    let r = &cosines * excess;
    let centre = &cosines * &part;
    let covariance =
        (&cosines * DMatrix::from_diagonal(&part) * cosines.transpose() - &centre * centre.transpose()) / n;
    let q = Cholesky::new(covariance).map_or(f64::NAN, |c| r.dot(&c.solve(&r)));
    (r.iter().copied().collect(), q)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gram::HOUR_NS;
    use dragfree_estimation::spectra::{Analyser, Layout, Sums};
    use dragfree_schema::{NoiseEstimate, NoiseProcess, NoiseShape, Settings};
    use rand::SeedableRng;
    use rand_distr::{Distribution, StandardNormal};
    use rand_xoshiro::Xoshiro256PlusPlus;

    const LENGTH: usize = 256;
    const HOURS: usize = 8;

    /// Of white innovations one readout in a hundred fails of all together; one octave a tenth too loud, of ten
    /// thousand, is 7σ.
    #[test]
    fn innovations_are_judged_octave_by_octave() {
        let octaves = |wrong: f64| (0..10).map(|k| (if k == 3 { wrong } else { 1.0 }, 10_000 >> k)).collect::<Vec<_>>();
        let readouts =
            |wrong| BTreeMap::from([("tm1.x".to_owned(), octaves(wrong)), ("tm1.y".to_owned(), octaves(1.0))]);
        assert!(Innovations::judge(&readouts(1.0), 10.0, 0.01).iter().all(|i| i.passes && i.p_value > 0.99));
        let judged = Innovations::judge(&readouts(1.3), 10.0, 0.01);
        assert!(!judged[0].passes && judged[1].passes, "{judged:?}");
        // 1250 of variance 2/1250: 7.5σ; Haar's fourth octave of 10 Hz.
        assert_eq!((judged[0].farthest, judged[0].octaves[3].band_hz), (3, [0.3125, 0.625]));
        assert!(judged[0].p_value < 1e-9, "{judged:?}");
    }

    /// White noise of unit variance at 1 Hz, eight hours, what `shape` makes of it, cut and judged as a channel whose
    /// prediction is white; `louder` multiplies the measured power of band and hour.
    fn judged(seed: u64, allowed: f64, shape: fn(&mut [f64]), louder: fn(f64, usize) -> f64) -> Channel {
        let mut random = Xoshiro256PlusPlus::seed_from_u64(seed);
        let mut x: Vec<f64> = (0..3600 * HOURS).map(|_| StandardNormal.sample(&mut random)).collect();
        shape(&mut x);
        let layout =
            Layout { channels: vec!["c".to_owned()], series: vec![], regressors: vec![], coefficients: vec![] };
        let mut analyser = Analyser::new(Plan::new(LENGTH, 1.0), &layout);
        let mut hours = vec![Sums::new(analyser.plan(), &layout); HOURS];
        for first in (0..=x.len() - LENGTH).step_by(LENGTH / 2) {
            let hour = (first + LENGTH / 2) / 3600;
            // An hour's sums do not count overlaps.
            analyser.add(0, 1_000_000_000 * first as i64, &[&x[first..first + LENGTH]], false, &mut hours[hour]);
        }
        let plan = analyser.plan();
        let ratios = |s: &Spectra, observations, hour: &dyn Fn(f64) -> f64| Ratios {
            // The one-sided PSD of white noise of unit variance at 1 Hz is 2.
            ratio: (0..plan.bands.len())
                .map(|b| hour(plan.frequency_hz(plan.bands[b])) * s.packed[b] / (2.0 * s.expected[b]))
                .collect(),
            observations,
        };
        let mean = |hz: f64| (0..HOURS).map(|h| louder(hz, h)).sum::<f64>() / HOURS as f64;
        let mut total = Spectra::zero(plan.bands.len(), 1);
        hours.iter().for_each(|h| total.add(&h.total));
        let whole = ratios(&total, observations(&total, plan), &mean);
        let by_hour: Vec<Ratios> = hours
            .iter()
            .enumerate()
            .map(|(h, s)| ratios(&s.total, observations(&s.total, plan), &|hz| louder(hz, h)))
            .collect();
        let starts: Vec<i64> = (0..HOURS as i64).map(|h| h * HOUR_NS).collect();
        judge(plan, &whole, &by_hour, &starts, allowed, Settings::default().outside_interval)
    }

    fn failed(c: &Channel) -> Vec<&'static str> {
        c.tests.iter().filter(|t| !t.passes).map(|t| t.name).collect()
    }

    /// A thousand draws of white noise, each test at 5 %: 50 false alarms are expected with a deviation of 6.9. `level`
    /// and `ljung-box` are exact; the others are held to the rate and may stay below it, as neighbouring cells share
    /// power and bands hide distances between their ends.
    #[test]
    fn white_noise_fails_at_the_stated_rate() {
        const DRAWS: u64 = 1000;
        let mut alarms = BTreeMap::new();
        for seed in 0..DRAWS {
            for name in failed(&judged(seed, 0.05, |_| (), |_, _| 1.0)) {
                *alarms.entry(name).or_insert(0.0) += 1.0;
            }
        }
        let expected = 0.05 * DRAWS as f64;
        let deviation = (expected * 0.95).sqrt();
        for name in ["level", "bands", "hours", "cumulative", "ljung-box"] {
            let count = alarms.get(name).copied().unwrap_or(0.0);
            assert!(count < expected + 4.0 * deviation, "{alarms:?}");
            assert!(!["level", "ljung-box"].contains(&name) || count > expected - 4.0 * deviation, "{alarms:?}");
        }
    }

    /// Twins that differ by one thing, at the rate of a test in a sound model; each is missed by chance in less than
    /// one of a thousand.
    #[test]
    fn what_is_not_white_fails_where_it_is_not() {
        const RATE: f64 = 0.01 / 15.0;
        let plain: fn(&mut [f64]) = |_| ();
        assert!(judged(1, RATE, plain, |_, _| 1.0).passes);
        // A tenth more power above 0.2 Hz: 8,000 observations, 9σ.
        let band = judged(1, RATE, plain, |hz, _| if hz > 0.2 { 1.1 } else { 1.0 });
        assert!(failed(&band).contains(&"bands") && failed(&band).contains(&"cumulative"), "{:?}", band.tests);
        // The same everywhere: a level, and white.
        let level = judged(1, RATE, plain, |_, _| 1.1);
        assert!(failed(&level).contains(&"level"), "{:?}", level.tests);
        assert!(!failed(&level).contains(&"cumulative") && !failed(&level).contains(&"ljung-box"), "{:?}", level.tests);
        // Half as much again in one hour, as much less in the next: 20 % of a third of a decade's σ in the mean, 8σ in
        // the hour.
        let hour = judged(1, RATE, plain, |hz, h| match (hz > 0.2, h) {
            (true, 3) => 1.4,
            (true, 4) => 0.6,
            _ => 1.0,
        });
        assert_eq!(failed(&hour), ["hours"], "{:?}", hour.tests);
        let place = hour.tests[2].at.as_ref().expect("a place");
        assert!(place.band_hz[1] > 0.2 && [Some(3 * HOUR_NS), Some(4 * HOUR_NS)].contains(&place.hour_ns));
        // A line of a fiftieth of the power, in one bin.
        let line = judged(
            1,
            RATE,
            |x| x.iter_mut().enumerate().for_each(|(t, x)| *x += 0.2 * (0.6 * t as f64).sin()),
            |_, _| 1.0,
        );
        let at = line.tests[1].at.as_ref().expect("a place").band_hz;
        assert!(failed(&line).contains(&"bands") && at[0] < 0.1 && at[1] > 0.09, "{:?}", line.tests);
        // An autoregression of 0.06: ten deviations of the first autocorrelation, and the second is its square.
        let correlated = judged(1, RATE, |x| (1..x.len()).for_each(|t| x[t] += 0.06 * x[t - 1]), |_, _| 1.0);
        assert!(failed(&correlated).contains(&"ljung-box"), "{:?}", correlated.tests);
        assert!((correlated.autocorrelation[0] - 0.06).abs() < 0.024, "{:?}", correlated.autocorrelation);
        assert!(level.unexplained > 0.0 && judged(1, RATE, plain, |_, _| 1.0).unexplained == 0.0);
    }

    /// The bundled mission, whose test masses look 30° to either side: with c = cos 30° and s = sin 30°, the first mass
    /// sees the spacecraft's x as (c, −s, 0) and the second as (c, s, 0).
    #[test]
    fn null_combinations_are_those_of_the_geometry() {
        let (c, s) = (0.75f64.sqrt(), 0.5);
        let names: Vec<String> = ["a.accel", "b.accel", "craft.alpha"]
            .iter()
            .flat_map(|body| ["x", "y", "z"].map(|axis| format!("{body}.{axis}")))
            .collect();
        let vector = |name: &str, first: usize, rows: &[[f64; 3]]| NoiseProcess {
            name: name.to_owned(),
            spectrum: Some(NoiseShape::white(1e-7)),
            components: ["x", "y", "z"].map(|axis| format!("{name}:craft.{axis}")).to_vec(),
            enters: names[first..]
                .iter()
                .cloned()
                .zip(rows.iter().map(|row| row.map(|g| -g / 1500.0).to_vec()))
                .collect(),
            ..NoiseProcess::default()
        };
        let eye = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
        let bodies = [[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0], [c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]];
        let torque = NoiseProcess {
            estimate: Some(NoiseEstimate {
                matrix: eye.map(|row| row.to_vec()).to_vec(),
                enters: vector("lever", 0, &bodies).enters,
                ..NoiseEstimate::default()
            }),
            ..vector("torque", 6, &eye)
        };
        let noise = NoiseModel::new(&[torque, vector("force", 0, &bodies)], &names, 0.1).expect("a model");
        let pairs = pairs(&noise, &names, 10.0);
        assert_eq!(
            pairs.iter().map(|p| p.2 == Kind::Null).collect::<Vec<_>>(),
            [false, false, false, true, true, true]
        );
        let want = [[c, -s, 0.0, -c, -s, 0.0], [s, c, 0.0, s, -c, 0.0], [0.0, 0.0, 1.0, 0.0, 0.0, -1.0]];
        for ((name, weights, _), want) in pairs[3..].iter().zip(want) {
            let apart = (0..6).map(|i| (weights[i] - want[i]).abs()).fold(0.0, f64::max);
            assert!(apart < 1e-9 && (6..9).all(|i| weights[i] == 0.0), "{name}: {weights}");
            // No common force is left in them, but for rounding.
            for axis in ["x", "y", "z"] {
                let force = noise.process_psd(&format!("force:craft.{axis}"), 0.01).expect("a process");
                assert!(weights.dot(&(&force * weights)).abs() < 1e-14 * force.trace());
            }
        }
    }
}
