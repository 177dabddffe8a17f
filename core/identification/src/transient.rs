//! Detection of transients: for every template, at every time, the filter that is matched to it and to the noise.
//!
//! With residuals r whose spectrum is Σ and a template `T(f)` that begins at `t`, `n(t) = Σ_f Re T* Σ⁻¹ r e^{2πift}` is
//! largest where it fits best; one inverse transform gives all times. Under a window w the noise of n is not the same
//! at all times: with `u = Σ^{-1/2} T` in the time domain, of unit energy, its variance is `D V(t)`,
//! `D = Σ_f T* Σ⁻¹ T`, `V(t) = Σ_s u²(s − t) w²(s)`, whether the filter is short against the window or rings through
//! all of it. The significance is `n/√(D V)`.
//!
//! A hit on the spacecraft stands out of broad-band noise and is detected in short segments. A push of a test mass for
//! a minute leaves a velocity, whose information lies below 2 mHz, and is detected in long ones. Detections become
//! candidates among all others; their amplitude and cause are decided there ([`crate::diagnosis`]).

use std::collections::BTreeMap;
use std::f64::consts::{PI, TAU};
use std::ops::Range;
use std::sync::Arc;

use dragfree_estimation::spectra::Plan;
use nalgebra::{Cholesky, DMatrix, DMatrixView};
use realfft::num_complex::Complex64;
use realfft::{ComplexToReal, RealFftPlanner, RealToComplex};
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

use crate::distributions::normal_tails;

/// Peaks of a lower significance are not kept.
pub(crate) const LEAST: f64 = 5.0;

/// Level u, σ, at which trials are counted: about that of the weakest certain peak. Noise behind a filter whose power
/// has the mean squared frequency ν² crosses u upwards `ν T e^{−u²/2}` times in T (Rice, Bell Syst. Tech. J. 24, 46):
/// as often as `√(2π) u ν T` independent normal numbers exceed it.
pub(crate) const LOUD: f64 = 6.0;

/// Times where the taper leaves less than this part of the noise's power are skipped: other causes could not be told
/// apart there.
const LEAST_VARIANCE: f64 = 0.1;

/// Median of the size of a standard normal number.
pub(crate) const MEDIAN: f64 = 0.674_49;

/// Peaks nearer than this to a higher one are part of it, s: in short segments, and in long ones, where a filter of the
/// information below 2 mHz rings for half an hour on either side. A second, smaller event within it is not detected.
const NEAR_S: [f64; 2] = [120.0, 1800.0];

/// Begins that are nearer to each other than this, s, may be those of one transient with two profiles.
pub const PROFILE_S: f64 = 600.0;

/// Peaks that are kept.
const MOST: usize = 50;

/// A short waveform, and the channels that respond to it.
#[derive(Clone, Debug, PartialEq)]
pub struct Template {
    /// Effect.
    pub effect: String,
    /// Instance.
    pub instance: String,
    /// Coefficient.
    pub coefficient: String,
    /// Unit of the coefficient.
    pub unit: String,
    /// Values of the shape parameters.
    pub shape: Map<String, Value>,
    /// Waveform, one mean per sample.
    pub kernel: Vec<f64>,
    /// Channel, factor, and whether the channel sees the mean of two samples.
    pub channels: Vec<(usize, f64, bool)>,
}

impl Template {
    /// Its detection at a time.
    pub(crate) fn at(&self, at_ns: i64, significance: f64) -> Detection {
        let mut shape = self.shape.clone();
        shape.insert("at_ns".to_owned(), at_ns.into());
        Detection {
            effect: self.effect.clone(),
            instance: self.instance.clone(),
            coefficient: self.coefficient.clone(),
            unit: self.unit.clone(),
            shape,
            at_ns,
            significance,
        }
    }
}

/// A template that was detected.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Detection {
    /// Effect.
    pub effect: String,
    /// Instance.
    pub instance: String,
    /// Coefficient.
    pub coefficient: String,
    /// Unit.
    pub unit: String,
    /// Shape, with `at_ns`.
    pub shape: Map<String, Value>,
    /// Unix ns of the sample in which it begins.
    pub at_ns: i64,
    /// Amplitude over σ of this template alone, by which it was found.
    pub significance: f64,
}

/// Whether what begins at two times at one place is one transient: the information of a slow one rings for long.
pub fn is_one_transient(a_ns: i64, b_ns: i64, same_s: f64) -> bool {
    (a_ns - b_ns).abs() <= (1e9 * same_s) as i64
}

impl Detection {
    /// The same at a later time.
    pub fn moved(&self, by_ns: i64) -> Self {
        let at_ns = self.at_ns + by_ns;
        let mut moved = Self { at_ns, ..self.clone() };
        moved.shape.insert("at_ns".to_owned(), at_ns.into());
        moved
    }

    /// The same with other shape parameters.
    pub fn of_course(&self, shape: &Map<String, Value>) -> Self {
        let mut other = self.clone();
        other.shape.extend(shape.clone());
        other
    }
}

/// All detections.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Transients {
    /// Peaks, the loudest first.
    pub detections: Vec<Detection>,
    /// Independent trials that would have a peak of 6σ as often as the search.
    pub tried: f64,
}

impl Transients {
    /// Peaks whose p-value over the whole search is below `chance`.
    pub fn certain(&self, chance: f64) -> impl Iterator<Item = &Detection> {
        self.detections.iter().filter(move |h| self.p_value(h) < chance)
    }

    /// p-value of a peak over the whole search, without an upper end.
    pub fn p_value(&self, detection: &Detection) -> f64 {
        normal_tails(detection.significance) * self.tried
    }

    /// Adds the peaks of other data.
    pub fn add(&mut self, other: &Self) {
        self.detections.extend(other.detections.iter().cloned());
        self.detections.sort_by(|a, b| b.significance.total_cmp(&a.significance));
        self.detections.truncate(MOST);
        self.tried += other.tried;
    }
}

/// The search in segments of one rate.
pub struct Search {
    templates: Vec<Template>,
    /// Residual of each channel as a combination of the base columns.
    residual: DMatrix<f64>,
    /// Upper end of each band, Hz, and `Σ⁻¹` in it; filters end there.
    inverses: Vec<(f64, DMatrix<f64>)>,
    /// One of [`NEAR_S`].
    near_s: f64,
    threads: usize,
    /// Filters for segments of a length, made for the first of each.
    prepared: BTreeMap<usize, Prepared>,
}

/// Times of a segment at which its filter outputs are used, so that each time is used once.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Part {
    /// Its middle half, where segments overlap by half.
    MiddleHalf,
    /// All of it, as far as the taper leaves enough power.
    All,
}

/// A matched filter.
struct Filter {
    conjugate: Vec<Complex64>,
    /// `√D`, `D = Σ_f t`, `t = T* Σ⁻¹ T`.
    root: f64,
    /// `Σ_f t²`.
    squares: f64,
    /// Root of the mean squared frequency of `t`, Hz.
    spread_hz: f64,
    /// `√V` at every sample.
    deviation: Vec<f64>,
}

/// Mean of a squared Hann window times two: the power of a segment's noise over that where the window is one.
const WINDOW_POWER: f64 = 0.75;

/// The matched filters of all templates.
struct Prepared {
    inverse: Arc<dyn ComplexToReal<f64>>,
    filters: Vec<Filter>,
    /// Per bin, the conjugate response of a mean of two samples.
    mean: Vec<Complex64>,
}

impl Search {
    /// Detects `templates` in residuals made by `residual` (channels × base columns); `inverses` are the upper end of
    /// each band, Hz, and `Σ⁻¹` in it.
    pub fn new(templates: Vec<Template>, residual: DMatrix<f64>, inverses: Vec<(f64, DMatrix<f64>)>) -> Self {
        Self { templates, residual, inverses, near_s: NEAR_S[0], threads: 1, prepared: BTreeMap::new() }
    }

    /// The same with the templates shared among threads.
    pub fn on(self, threads: usize) -> Self {
        Self { threads: threads.max(1), ..self }
    }

    /// The same for samples decimated by `factor`, up to a frequency.
    pub fn thinned(&self, factor: usize, below_hz: f64) -> Self {
        let template = |t: &Template| Template {
            kernel: t.kernel.chunks(factor).map(|c| c.iter().sum::<f64>() / factor as f64).collect(),
            // The mean of two samples is that of one here.
            channels: t.channels.iter().map(|(c, factor, _)| (*c, *factor, false)).collect(),
            ..t.clone()
        };
        let inverses = self.inverses.iter().take_while(|(end_hz, _)| *end_hz <= below_hz).cloned().collect();
        let templates = self.templates.iter().map(template).collect();
        let thinned = Self::new(templates, self.residual.clone(), inverses).on(self.threads);
        Self { near_s: NEAR_S[1], ..thinned }
    }

    /// Bins of a segment of `n` samples in each band.
    fn bins(&self, plan: &Plan, n: usize) -> Vec<Range<usize>> {
        let mut first = plan.first_bin;
        let of = |(end_hz, _): &(f64, DMatrix<f64>)| {
            let end = ((end_hz * n as f64 / plan.rate_hz).round() as usize).clamp(first, (n / 2).max(first));
            std::mem::replace(&mut first, end)..end
        };
        self.inverses.iter().map(of).collect()
    }

    fn prepare(&self, plan: &Plan, n: usize) -> Prepared {
        let fft = Transforms::new(n);
        let mean: Vec<Complex64> =
            (0..=n / 2).map(|k| 0.5 * (1.0 + Complex64::from_polar(1.0, TAU * k as f64 / n as f64))).collect();
        // `Σ⁻¹ = L Lᵀ`: `Lᵀ T` is the template in white noise.
        let nothing = |m: &DMatrix<f64>| DMatrix::zeros(m.nrows(), m.ncols());
        let whitening = self
            .inverses
            .iter()
            .map(|(_, m)| Cholesky::new(m.clone()).map_or_else(|| nothing(m), |c| c.unpack().transpose()));
        let bands: Vec<(Range<usize>, DMatrix<f64>)> = self.bins(plan, n).into_iter().zip(whitening).collect();
        let window = fft.spectrum((0..n).map(|k| (PI * k as f64 / n as f64).sin().powi(4)).collect());
        let scale = (4.0 / (plan.rate_hz * n as f64)).sqrt();
        let filter = |template: &Template| {
            let mut kernel = template.kernel.clone();
            kernel.truncate(n / 4);
            kernel.resize(n, 0.0);
            let spectrum = fft.spectrum(kernel);
            let channels = self.residual.nrows();
            let mut white = vec![vec![Complex64::default(); n / 2 + 1]; channels];
            for (bins, whitening) in &bands {
                // Parts that see a sample, and the mean of two.
                let mut factors = [nalgebra::DVector::zeros(channels), nalgebra::DVector::zeros(channels)];
                template
                    .channels
                    .iter()
                    .for_each(|(c, factor, averaged)| factors[usize::from(*averaged)][*c] += factor);
                let [plain, averaged] = factors.map(|f| whitening * f);
                for k in bins.clone() {
                    let (t, m) = (spectrum[k] * scale, mean[k].conj());
                    (0..channels).for_each(|c| white[c][k] = t * (plain[c] + averaged[c] * m));
                }
            }
            let (mut sum, mut squares, mut spread) = (0.0, 0.0, 0.0);
            for k in plan.first_bin..n / 2 {
                let t: f64 = white.iter().map(|w| w[k].norm_sqr()).sum();
                sum += t;
                squares += t * t;
                spread += t * (k as f64 * plan.rate_hz / n as f64).powi(2);
            }
            let mut energy = vec![0.0; n];
            for time in white.into_iter().map(|w| fft.samples(w)) {
                energy.iter_mut().zip(time).for_each(|(e, x)| *e += x * x);
            }
            let whole: f64 = energy.iter().sum::<f64>().max(f64::MIN_POSITIVE);
            // Correlation of the energy with the squared window.
            let correlated = fft.spectrum(energy).into_iter().zip(&window).map(|(e, w)| e.conj() * w).collect();
            let variance = fft.samples(correlated).into_iter().map(|v| v / (whole * n as f64));
            Filter {
                conjugate: spectrum.into_iter().map(|t| t.conj() * scale).collect(),
                root: sum.sqrt(),
                squares,
                spread_hz: (spread / sum.max(f64::MIN_POSITIVE)).sqrt(),
                deviation: variance.map(|v| v.max(0.0).sqrt()).collect(),
            }
        };
        Prepared { filters: self.templates.iter().map(filter).collect(), inverse: fft.inverse, mean }
    }

    /// Output of a template's matched filter for whitened residuals, bin by bin.
    fn filtered(&self, plan: &Plan, n: usize, of: usize, white: &DMatrix<f64>, prepared: &Prepared) -> Vec<Complex64> {
        let mut spectrum = vec![Complex64::default(); n / 2 + 1];
        for (c, factor, averaged) in &self.templates[of].channels {
            let rows = white.column(*c);
            let pairs = rows.as_slice().chunks_exact(2).zip(&mut spectrum[plan.first_bin..n / 2]);
            for ((pair, out), mean) in pairs.zip(&prepared.mean[plan.first_bin..]) {
                let x = Complex64::new(pair[0], pair[1]) * *factor;
                *out += if *averaged { x * mean } else { x };
            }
        }
        spectrum.iter_mut().zip(&prepared.filters[of].conjugate).for_each(|(x, filter)| *x *= filter);
        spectrum
    }

    /// A segment of `n` samples at the rate of a plan: spectra of the base columns from the plan's first bin.
    pub fn segment(
        &mut self,
        plan: &Plan,
        n: usize,
        part: Part,
        first_ns: i64,
        base: &DMatrixView<'_, f64>,
        found: &mut Transients,
    ) {
        if self.templates.is_empty() {
            return;
        }
        let whole = base.rows(0, 2 * (n / 2 - plan.first_bin)) * self.residual.transpose();
        let mut white = DMatrix::zeros(whole.nrows(), whole.ncols());
        for (bins, (_, inverse)) in self.bins(plan, n).into_iter().zip(&self.inverses) {
            let (start, rows) = (2 * (bins.start - plan.first_bin), 2 * bins.len());
            white.rows_mut(start, rows).copy_from(&(whole.rows(start, rows) * inverse));
        }
        let prepared = self.prepared.remove(&n).unwrap_or_else(|| self.prepare(plan, n));
        // Segments that overlap by half cover every time once with their middle halves.
        let middle = match part {
            Part::MiddleHalf => n / 4..3 * n / 4,
            Part::All => 0..n,
        };
        let all: Vec<usize> = (0..self.templates.len()).collect();
        let each = all.len().div_ceil(self.threads);
        let look = |templates: &[usize]| -> Vec<MatchedFilterOutput> {
            let mut time = vec![0.0; n];
            let seen = |of: &usize| self.look(plan, *of, &middle, &white, &prepared, &mut time);
            templates.iter().filter_map(seen).collect()
        };
        let looked: Vec<MatchedFilterOutput> = std::thread::scope(|scope| {
            let running: Vec<_> = all.chunks(each).map(|own| scope.spawn(|| look(own))).collect();
            let join = |thread: std::thread::ScopedJoinHandle<'_, Vec<MatchedFilterOutput>>| {
                thread.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic))
            };
            running.into_iter().flat_map(join).collect()
        });
        for MatchedFilterOutput { template, tried, peaks } in looked {
            found.tried += tried;
            for (k, sigmas) in peaks {
                let at_ns = first_ns + (k as f64 * 1e9 / plan.rate_hz).round() as i64;
                keep(&mut found.detections, &self.templates[template], self.near_s, at_ns, sigmas);
            }
        }
        self.prepared.insert(n, prepared);
    }

    /// Output of one filter at some times of a segment of as many samples as `time` has; `None` where the template is
    /// unobservable.
    fn look(
        &self,
        plan: &Plan,
        template: usize,
        times: &Range<usize>,
        white: &DMatrix<f64>,
        prepared: &Prepared,
        time: &mut [f64],
    ) -> Option<MatchedFilterOutput> {
        let filter = &prepared.filters[template];
        let least = LEAST_VARIANCE.sqrt();
        let looked: Vec<usize> = times.clone().filter(|k| filter.deviation[*k] > least).collect();
        if filter.root <= 0.0 || looked.is_empty() {
            return None;
        }
        let tried = TAU.sqrt() * LOUD * filter.spread_hz * looked.len() as f64 / plan.rate_hz;
        let mut spectrum = self.filtered(plan, time.len(), template, white, prepared);
        let power: f64 = spectrum.iter().map(Complex64::norm_sqr).sum();
        if prepared.inverse.process(&mut spectrum, time).is_err() {
            return Some(MatchedFilterOutput { template, tried, peaks: Vec::new() });
        }
        // The transform sums the bins of both signs.
        let significance = |k: usize| 0.5 * time[k] / (filter.deviation[k] * filter.root);
        // Noise may exceed the mission's Σ. Two robust estimates of its level: the median of the output, which short
        // events leave alone, and the power less that of the highest peak, which one event leaves alone however long it
        // rings.
        let mut sizes: Vec<f64> = looked.iter().map(|k| significance(*k).abs()).collect();
        let half = sizes.len() / 2;
        let median = *sizes.select_nth_unstable_by(half, f64::total_cmp).1 / MEDIAN;
        let peak = looked.iter().map(|k| (0.5 * time[*k] / (filter.root * filter.root)).powi(2)).fold(0.0, f64::max);
        let left = (power - peak * filter.squares) / (WINDOW_POWER * filter.root * filter.root);
        let louder = median.min(left.max(0.0).sqrt()).max(1.0);
        let sigmas = looked.into_iter().map(|k| (k, significance(k).abs() / louder));
        Some(MatchedFilterOutput { template, tried, peaks: sigmas.filter(|(_, sigmas)| *sigmas > LEAST).collect() })
    }
}

/// Output of one matched filter in a segment.
struct MatchedFilterOutput {
    template: usize,
    /// Independent trials.
    tried: f64,
    /// Samples, and how many σ stand there.
    peaks: Vec<(usize, f64)>,
}

/// Transforms of one length.
pub(crate) struct Transforms {
    forward: Arc<dyn RealToComplex<f64>>,
    inverse: Arc<dyn ComplexToReal<f64>>,
}

impl Transforms {
    pub(crate) fn new(n: usize) -> Self {
        let mut planner = RealFftPlanner::<f64>::new();
        Self { forward: planner.plan_fft_forward(n), inverse: planner.plan_fft_inverse(n) }
    }

    pub(crate) fn spectrum(&self, mut samples: Vec<f64>) -> Vec<Complex64> {
        let mut spectrum = self.forward.make_output_vec();
        // The length is that of the plan of the transform, the only thing that it refuses.
        let done = self.forward.process(&mut samples, &mut spectrum);
        debug_assert!(done.is_ok());
        spectrum
    }

    /// Without the factor of one over the length.
    pub(crate) fn samples(&self, mut spectrum: Vec<Complex64>) -> Vec<f64> {
        // What belongs to no pair of frequencies is real.
        for end in [0, spectrum.len() - 1] {
            spectrum[end].im = 0.0;
        }
        let mut samples = self.inverse.make_output_vec();
        let done = self.inverse.process(&mut spectrum, &mut samples);
        debug_assert!(done.is_ok());
        samples
    }
}

/// Keeps a peak if no higher one is near.
fn keep(detections: &mut Vec<Detection>, template: &Template, near_s: f64, at_ns: i64, significance: f64) {
    let near = |h: &Detection| (h.at_ns - at_ns).abs() < (near_s * 1e9) as i64;
    if detections.iter().any(|h| near(h) && h.significance >= significance)
        || detections.len() >= MOST && detections.last().is_some_and(|h| h.significance >= significance)
    {
        return;
    }
    detections.retain(|h| !near(h));
    let place = detections.partition_point(|h| h.significance >= significance);
    detections.insert(place, template.at(at_ns, significance));
    detections.truncate(MOST);
}

#[cfg(test)]
mod tests {
    use super::*;
    use dragfree_estimation::spectra::Transformer;
    use rand::SeedableRng;
    use rand_distr::{Distribution, StandardNormal};
    use rand_xoshiro::Xoshiro256PlusPlus;

    const N: usize = 4096;
    const WAVEFORM: usize = 8;
    const AT: usize = 1500;

    fn template(coefficient: &str, channels: &[(usize, f64)]) -> Template {
        Template {
            effect: "event".to_owned(),
            instance: "here".to_owned(),
            coefficient: coefficient.to_owned(),
            unit: "1".to_owned(),
            shape: Map::new(),
            kernel: vec![1.0; WAVEFORM],
            channels: channels.iter().map(|(c, factor)| (*c, *factor, false)).collect(),
        }
    }

    fn search(below_hz: f64) -> Search {
        let inverse = DMatrix::from_diagonal_element(2, 2, 0.5);
        let templates = vec![template("a", &[(0, 1.0)]), template("b", &[(0, 0.5), (1, 1.0)])];
        Search::new(templates, DMatrix::identity(2, 2), vec![(below_hz, inverse)])
    }

    /// Spectra of two channels of white noise of unit variance at 1 Hz, whose one-sided PSD is 2, with more in them.
    fn spectra(seed: u64, more: impl Fn(usize, usize) -> f64) -> DMatrix<f64> {
        let mut rng = Xoshiro256PlusPlus::seed_from_u64(seed);
        let plan = Plan::new(N, 1.0);
        let mut base = DMatrix::zeros(2 * (N / 2 - plan.first_bin), 2);
        for (c, mut column) in base.column_iter_mut().enumerate() {
            let noise: [f64; N] = std::array::from_fn(|_| StandardNormal.sample(&mut rng));
            let samples: Vec<f64> = noise.iter().enumerate().map(|(k, x)| x + more(c, k)).collect();
            Transformer::new(&plan).transform(&plan, 0, &samples, column.as_mut_slice());
        }
        base
    }

    /// Something of a size that pushes the first channel from a sample on.
    fn detections(seed: u64, below_hz: f64, part: Part, (size, at): (f64, usize), wave: f64) -> Vec<Detection> {
        let pushed = |c: usize, k: usize| if c == 0 && (at..at + WAVEFORM).contains(&k) { size } else { 0.0 };
        let base = spectra(seed, |c, k| pushed(c, k) + wave * (TAU * 0.02 * k as f64).sin());
        let mut found = Transients::default();
        search(below_hz).segment(&Plan::new(N, 1.0), N, part, 0, &base.columns(0, 2), &mut found);
        found.detections
    }

    /// At its sample or the next, by the right template, with the significance `size √8` of least squares (within 4σ,
    /// false alarm 1e-4), in the middle of a segment; and nothing where there is nothing.
    #[test]
    fn an_event_has_its_time_and_the_significance_of_least_squares() {
        let detection = &detections(1, 0.5, Part::MiddleHalf, (4.0, N / 2), 0.0)[0];
        assert!((detection.at_ns - 1_000_000_000 * (N / 2) as i64).abs() <= 1_000_000_000, "{detection:?}");
        assert_eq!(detection.coefficient, "a");
        assert!((detection.significance - 4.0 * 8.0_f64.sqrt()).abs() < 4.0, "{detection:?}");
        assert!(detections(2, 0.5, Part::MiddleHalf, (0.0, 0), 0.0).is_empty());
    }

    /// Through a filter that rings for a quarter of the segment an event is found all the same, however loud, in all of
    /// it; to a period of the highest frequency that is left.
    #[test]
    fn an_event_that_rings_is_found_however_loud_it_is() {
        for (size, at) in [(15.0, 1500), (500.0, 1500), (30.0, 900), (500.0, 3200)] {
            let found = detections(3, 0.003, Part::All, (size, at), 0.0);
            let detection = found.first().unwrap_or_else(|| panic!("{size} is not found"));
            assert!((detection.at_ns - 1_000_000_000 * at as i64).abs() < 333_000_000_000, "{detection:?} at {at}");
        }
    }

    /// Noise has a variance of one in units of σ at every time, near the ends of a segment too, behind a filter that
    /// rings through a quarter of it: 400 sets, each number within 4.5σ (false alarm 7e-6, three of them).
    #[test]
    fn noise_is_as_loud_at_the_ends_as_in_the_middle() {
        let (plan, search) = (Plan::new(N, 1.0), search(0.003));
        let prepared = search.prepare(&plan, N);
        let filter = &prepared.filters[0];
        let times = [N / 5, N / 4, N / 2];
        assert!(times.iter().all(|k| filter.deviation[*k] > LEAST_VARIANCE.sqrt()));
        let mut power = [0.0; 3];
        let sets = 400;
        for seed in 0..sets {
            let white = spectra(1000 + seed, |_, _| 0.0) * 0.5;
            let mut filtered = search.filtered(&plan, N, 0, &white, &prepared);
            // Above the band nothing is known.
            filtered[(0.003 * N as f64).round() as usize..].fill(Complex64::default());
            let mut time = vec![0.0; N];
            prepared.inverse.process(&mut filtered, &mut time).unwrap();
            for (power, k) in power.iter_mut().zip(times) {
                *power += (0.5 * time[k] / (filter.deviation[k] * filter.root)).powi(2) / sets as f64;
            }
        }
        let sigma = (2.0 / sets as f64).sqrt();
        assert!(power.iter().all(|p| (p - 1.0).abs() < 4.5 * sigma), "{power:?}");
    }

    /// White noise has a mean squared frequency of a twelfth of the rate's square: what is said of the number of trials
    /// is Rice's.
    #[test]
    fn trials_are_as_many_as_the_noise_has_crossings() {
        let mut search = search(0.5);
        search.templates = vec![Template { kernel: vec![1.0], ..template("a", &[(0, 1.0)]) }];
        let mut found = Transients::default();
        let base = spectra(5, |_, _| 0.0);
        search.segment(&Plan::new(N, 1.0), N, Part::MiddleHalf, 0, &base.columns(0, 2), &mut found);
        let crossings = (N / 2) as f64 / 12.0_f64.sqrt();
        assert!((found.tried / (TAU.sqrt() * LOUD * crossings) - 1.0).abs() < 0.01, "{}", found.tried);
    }

    /// Through two bins alone it rings over the whole segment: the median of the filter's output is the event itself,
    /// and only what its peak leaves tells that there is nothing else.
    #[test]
    fn an_event_that_rings_over_the_whole_segment_is_found() {
        assert!(!detections(3, 0.0012, Part::MiddleHalf, (500.0, AT), 0.0).is_empty());
    }

    /// A lasting wave is no event.
    #[test]
    fn a_wave_is_no_event() {
        for part in [Part::MiddleHalf, Part::All] {
            assert!(detections(4, 0.5, part, (0.0, 0), 10.0).is_empty());
        }
    }

    #[test]
    fn a_thinned_template_gives_as_much() {
        let search = Search::new(vec![template("a", &[(0, 1.0)])], DMatrix::identity(1, 1), Vec::new());
        let kernel = &search.thinned(3, 1.0).templates[0].kernel;
        assert_eq!(kernel.len(), 3);
        assert!((3.0 * kernel.iter().sum::<f64>() - WAVEFORM as f64).abs() < 1e-12);
    }
}
