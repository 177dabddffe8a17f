//! What happens once: every template at every time, by the filter that is matched to it and to the noise.
//!
//! With residuals r whose spectrum is Σ and a template `T(f)` that begins at `t`, the amplitude that fits best is
//! `n(t)/D`, `n(t) = Σ_f Re T* Σ⁻¹ r e^{2πift}`, `D = Σ_f T* Σ⁻¹ T`, and its significance `n/√D`; one inverse transform gives all times.
//! Under a window w that is long against the template both n and its noise are those without it times `w(t)`.
//!
//! A hit of the spacecraft stands out of broad noise and is looked for in short segments. What pushes a test mass for a minute is
//! known by the velocity that is left, below 2 mHz, where a short segment sees nothing: it is looked for in long ones.

use std::f64::consts::{PI, TAU};
use std::ops::Range;
use std::sync::Arc;

use dragfree_estimation::spectra::Plan;
use nalgebra::{DMatrix, DMatrixView, DVector};
use realfft::num_complex::Complex64;
use realfft::{ComplexToReal, RealFftPlanner};
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

/// Significance below which a peak is not kept.
const LEAST: f64 = 5.0;

/// Median of the size of a standard normal number.
const MEDIAN: f64 = 0.674_49;

/// Peaks of one cause nearer than this are one, s: in short segments, and in long ones, where the filter of what is known below 2 mHz
/// rings for half an hour on either side. A second, smaller event within it is not told.
const NEAR_S: [f64; 2] = [120.0, 1800.0];

/// Peaks that are kept.
const MOST: usize = 50;

/// A short course of something, and how the channels answer.
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
    /// Course, one mean per sample.
    pub kernel: Vec<f64>,
    /// Channel, factor, and whether the channel sees the mean of two samples.
    pub channels: Vec<(usize, f64, bool)>,
}

/// A template that was found.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Hit {
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
    /// Every coefficient of the effect with this course at this time, fitted together: a hit pushes and turns, and what
    /// turns is seen in the test masses too.
    pub coefficients: Vec<Amplitude>,
}

/// A coefficient of what was found.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Amplitude {
    /// Name.
    pub name: String,
    /// Value, in `unit`.
    pub value: f64,
    /// Its σ.
    pub sigma: f64,
    /// Unit.
    pub unit: String,
}

/// What was found.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Transients {
    /// Peaks, the loudest first.
    pub hits: Vec<Hit>,
    /// Templates times samples that were tried.
    pub tried: f64,
}

impl Transients {
    /// Adds the peaks of other data.
    pub fn add(&mut self, other: &Self) {
        self.hits.extend(other.hits.iter().cloned());
        self.hits.sort_by(|a, b| b.significance.total_cmp(&a.significance));
        self.hits.truncate(MOST);
        self.tried += other.tried;
    }
}

/// The search in segments of one rate.
pub struct Search {
    templates: Vec<Template>,
    /// Residual of each channel as a combination of the base columns.
    residual: DMatrix<f64>,
    /// Upper end of each band, Hz, and `Σ⁻¹` in it; nothing is looked at above.
    inverses: Vec<(f64, DMatrix<f64>)>,
    /// One of [`NEAR_S`].
    near_s: f64,
    /// What every segment of a length needs, made for the first.
    prepared: Option<(usize, Prepared)>,
}

/// Where a segment is looked at: at the times at which no other segment is looked at.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Part {
    /// Its middle half, where segments overlap by half.
    MiddleHalf,
    /// All but a tenth at either end, where the window leaves little.
    All,
}

/// A template as the filter wants it.
struct Filter {
    conjugate: Vec<Complex64>,
    /// `√D`, `D = Σ_f t`, `t = T* Σ⁻¹ T`.
    root: f64,
    /// `Σ_f t²`.
    squares: f64,
}

/// Mean of a squared Hann window times two: the power of a segment's noise over that where the window is one.
const WINDOW_POWER: f64 = 0.75;

/// Templates as the filter wants them.
struct Prepared {
    inverse: Arc<dyn ComplexToReal<f64>>,
    filters: Vec<Filter>,
    /// Per bin, the conjugate response of a mean of two samples.
    mean: Vec<Complex64>,
}

impl Search {
    /// Looks for `templates` in residuals made by `residual` (channels × base columns); `inverses` are the upper end of each band,
    /// Hz, and `Σ⁻¹` in it.
    #[must_use]
    pub fn new(templates: Vec<Template>, residual: DMatrix<f64>, inverses: Vec<(f64, DMatrix<f64>)>) -> Self {
        Self { templates, residual, inverses, near_s: NEAR_S[0], prepared: None }
    }

    /// The same for samples of which `factor` have become one, up to a frequency.
    #[must_use]
    pub fn thinned(&self, factor: usize, below_hz: f64) -> Self {
        let template = |t: &Template| Template {
            kernel: t.kernel.chunks(factor).map(|c| c.iter().sum::<f64>() / factor as f64).collect(),
            // The mean of two samples is that of one here.
            channels: t.channels.iter().map(|(c, factor, _)| (*c, *factor, false)).collect(),
            ..t.clone()
        };
        let inverses = self.inverses.iter().take_while(|(end_hz, _)| *end_hz <= below_hz).cloned().collect();
        let templates = self.templates.iter().map(template).collect();
        Self { near_s: NEAR_S[1], ..Self::new(templates, self.residual.clone(), inverses) }
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
        let mut planner = RealFftPlanner::<f64>::new();
        let (forward, inverse) = (planner.plan_fft_forward(n), planner.plan_fft_inverse(n));
        let scale = (4.0 / (plan.rate_hz * n as f64)).sqrt();
        let mean: Vec<Complex64> =
            (0..=n / 2).map(|k| 0.5 * (1.0 + Complex64::from_polar(1.0, TAU * k as f64 / n as f64))).collect();
        let mut time = vec![0.0; n];
        let filter = |template: &Template| {
            let mut spectrum = vec![Complex64::default(); n / 2 + 1];
            time.fill(0.0);
            let course = template.kernel.len().min(n / 4);
            time[..course].copy_from_slice(&template.kernel[..course]);
            // The length is that of the plan of the transform, the only thing that it refuses.
            let done = forward.process(&mut time, &mut spectrum);
            debug_assert!(done.is_ok());
            let (mut sum, mut squares) = (0.0, 0.0);
            for (bins, (_, own)) in self.bins(plan, n).into_iter().zip(&self.inverses) {
                let answer = Answer::new(template, template, own);
                for k in bins {
                    let t = spectrum[k].norm_sqr() * scale * scale * answer.at(mean[k]);
                    sum += t;
                    squares += t * t;
                }
            }
            spectrum.iter_mut().for_each(|t| *t = t.conj() * scale);
            Filter { conjugate: spectrum, root: sum.max(0.0).sqrt(), squares }
        };
        Prepared { filters: self.templates.iter().map(filter).collect(), inverse, mean }
    }

    /// What a template's matched filter makes of whitened residuals, bin by bin.
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

    /// All templates of the effect and course of one, fitted together where that one has its peak, at sample `k`; `louder` than Σ says
    /// is the noise.
    fn amplitudes(
        &self,
        plan: &Plan,
        n: usize,
        (of, k, louder): (usize, usize, f64),
        white: &DMatrix<f64>,
        prepared: &Prepared,
    ) -> Vec<Amplitude> {
        let own = &self.templates[of];
        let alike = |t: &Template| (&t.effect, &t.instance, &t.shape) == (&own.effect, &own.instance, &own.shape);
        let group: Vec<usize> = (0..self.templates.len())
            .filter(|i| alike(&self.templates[*i]) && prepared.filters[*i].root > 0.0)
            .collect();
        let window = (PI * k as f64 / n as f64).sin().powi(2);
        let turn = |bin: usize| Complex64::from_polar(1.0, TAU * (bin * k % n) as f64 / n as f64);
        let score = DVector::from_iterator(
            group.len(),
            group.iter().map(|i| {
                let filtered = self.filtered(plan, n, *i, white, prepared);
                filtered.iter().enumerate().map(|(bin, x)| (x * turn(bin)).re).sum::<f64>() / window
            }),
        );
        let course = &prepared.filters[of].conjugate;
        let information = DMatrix::from_fn(group.len(), group.len(), |i, j| {
            let of = |(bins, (_, own)): (Range<usize>, &(f64, DMatrix<f64>))| {
                let answer = Answer::new(&self.templates[group[i]], &self.templates[group[j]], own);
                bins.map(|k| course[k].norm_sqr() * answer.at(prepared.mean[k])).sum::<f64>()
            };
            self.bins(plan, n).into_iter().zip(&self.inverses).map(of).sum::<f64>()
        });
        let Some(covariance) = information.cholesky().map(|c| c.inverse()) else { return Vec::new() };
        let values: DVector<f64> = &covariance * score;
        let amplitude = |(i, t): (usize, &usize)| Amplitude {
            name: self.templates[*t].coefficient.clone(),
            value: values[i],
            sigma: louder * covariance[(i, i)].sqrt(),
            unit: self.templates[*t].unit.clone(),
        };
        group.iter().enumerate().map(amplitude).collect()
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
        let prepared = match self.prepared.take() {
            Some((length, prepared)) if length == n => prepared,
            _ => self.prepare(plan, n),
        };
        let mut time = vec![0.0; n];
        // Segments that overlap by half cover every time once with their middle halves.
        let middle = match part {
            Part::MiddleHalf => n / 4..3 * n / 4,
            Part::All => n / 10..n - n / 10,
        };
        let window: Vec<f64> = middle.clone().map(|k| (PI * k as f64 / n as f64).sin().powi(2)).collect();
        let mut peaks: Vec<(usize, usize, f64)> = Vec::new();
        for (of, Filter { root, squares, .. }) in prepared.filters.iter().enumerate() {
            if *root <= 0.0 {
                continue;
            }
            let mut spectrum = self.filtered(plan, n, of, &white, &prepared);
            let power: f64 = spectrum.iter().map(Complex64::norm_sqr).sum();
            if prepared.inverse.process(&mut spectrum, &mut time).is_err() {
                continue;
            }
            // The transform sums the bins of both signs.
            let significance: Vec<f64> =
                time[middle.clone()].iter().zip(&window).map(|(x, w)| 0.5 * x / (w * root)).collect();
            // Noise may be louder than Σ says. Its median does not see what happens a few times and is soon over; and what a peak
            // leaves of the filtered power does not see what happens once, however long it rings.
            let mut sizes: Vec<f64> = significance.iter().map(|x| x.abs()).collect();
            let half = sizes.len() / 2;
            let median = *sizes.select_nth_unstable_by(half, f64::total_cmp).1 / MEDIAN;
            let sizes = significance.iter().zip(&window).map(|(x, w)| (x * w / root).powi(2));
            let left = power - sizes.fold(0.0, f64::max) * squares;
            let left = (left / (WINDOW_POWER * root * root)).max(0.0).sqrt();
            let louder = median.min(left).max(1.0);
            for (k, x) in middle.clone().zip(&significance).filter(|(_, x)| x.abs() > LEAST * louder) {
                let at_ns = first_ns + (k as f64 * 1e9 / plan.rate_hz).round() as i64;
                if keep(&mut found.hits, &self.templates[of], self.near_s, at_ns, x.abs() / louder) {
                    peaks.push((of, k, louder));
                }
            }
        }
        // Only what was kept is worth the time.
        for (of, k, louder) in peaks {
            let at_ns = first_ns + (k as f64 * 1e9 / plan.rate_hz).round() as i64;
            let t = &self.templates[of];
            let same_course = |h: &Hit| t.shape.iter().all(|(key, value)| h.shape.get(key) == Some(value));
            let is = |h: &&mut Hit| {
                let same = (&h.effect, &h.instance, &h.coefficient) == (&t.effect, &t.instance, &t.coefficient);
                h.at_ns == at_ns && same && same_course(h) && h.coefficients.is_empty()
            };
            if let Some(hit) = found.hits.iter_mut().find(is) {
                hit.coefficients = self.amplitudes(plan, n, (of, k, louder), &white, &prepared);
            }
        }
        self.prepared = Some((n, prepared));
        found.tried += (self.templates.len() * middle.len()) as f64;
    }
}

/// How two templates of one course share information in a band: the sum over their channels, of which those that see the mean of two
/// samples answer with its response.
struct Answer {
    plain: f64,
    mixed: f64,
    averaged: f64,
}

impl Answer {
    fn new(a: &Template, b: &Template, inverse: &DMatrix<f64>) -> Self {
        let mut answer = Self { plain: 0.0, mixed: 0.0, averaged: 0.0 };
        for (c, factor, mean) in &a.channels {
            for (d, other, their_mean) in &b.channels {
                let part = factor * other * inverse[(*c, *d)];
                match (mean, their_mean) {
                    (false, false) => answer.plain += part,
                    (true, true) => answer.averaged += part,
                    _ => answer.mixed += part,
                }
            }
        }
        answer
    }

    fn at(&self, mean: Complex64) -> f64 {
        self.plain + self.mixed * mean.re + self.averaged * mean.norm_sqr()
    }
}

/// Keeps a peak if no louder one is near; whether it did.
fn keep(hits: &mut Vec<Hit>, template: &Template, near_s: f64, at_ns: i64, significance: f64) -> bool {
    let near = |h: &Hit| (h.at_ns - at_ns).abs() < (near_s * 1e9) as i64;
    if hits.iter().any(|h| near(h) && h.significance >= significance)
        || hits.len() >= MOST && hits.last().is_some_and(|h| h.significance >= significance)
    {
        return false;
    }
    hits.retain(|h| !near(h));
    let mut shape = template.shape.clone();
    shape.insert("at_ns".to_owned(), at_ns.into());
    let hit = Hit {
        effect: template.effect.clone(),
        instance: template.instance.clone(),
        coefficient: template.coefficient.clone(),
        unit: template.unit.clone(),
        shape,
        at_ns,
        significance,
        coefficients: Vec::new(),
    };
    let place = hits.partition_point(|h| h.significance >= significance);
    hits.insert(place, hit);
    hits.truncate(MOST);
    true
}

#[cfg(test)]
mod tests {
    use super::*;
    use dragfree_estimation::spectra::Transformer;
    use rand::SeedableRng;
    use rand_distr::{Distribution, StandardNormal};
    use rand_xoshiro::Xoshiro256PlusPlus;

    const N: usize = 4096;
    const COURSE: usize = 8;
    const AT: usize = 1500;

    fn template(coefficient: &str, channels: &[(usize, f64)]) -> Template {
        Template {
            effect: "event".to_owned(),
            instance: "here".to_owned(),
            coefficient: coefficient.to_owned(),
            unit: "1".to_owned(),
            shape: Map::new(),
            kernel: vec![1.0; COURSE],
            channels: channels.iter().map(|(c, factor)| (*c, *factor, false)).collect(),
        }
    }

    /// Two channels of white noise of unit variance at 1 Hz, whose one-sided PSD is 2; `a` pushes the first, `b` half of it and the second.
    fn hits(seed: u64, below_hz: f64, part: Part, [a, b]: [f64; 2], wave: f64) -> Vec<Hit> {
        let mut rng = Xoshiro256PlusPlus::seed_from_u64(seed);
        let plan = Plan::new(N, 1.0);
        let inverse = DMatrix::from_diagonal_element(2, 2, 0.5);
        let templates = vec![template("a", &[(0, 1.0)]), template("b", &[(0, 0.5), (1, 1.0)])];
        let mut search = Search::new(templates, DMatrix::identity(2, 2), vec![(below_hz, inverse)]);
        let mut base = DMatrix::zeros(2 * (N / 2 - plan.first_bin), 2);
        for (c, mut column) in base.column_iter_mut().enumerate() {
            let pushed = [a + 0.5 * b, b][c];
            let sample = |k: usize| {
                let noise: f64 = StandardNormal.sample(&mut rng);
                let event = if (AT..AT + COURSE).contains(&k) { pushed } else { 0.0 };
                noise + event + wave * (TAU * 0.02 * k as f64).sin()
            };
            let samples: Vec<f64> = (0..N).map(sample).collect();
            Transformer::new(&plan).transform(&plan, 0, &samples, column.as_mut_slice());
        }
        let mut found = Transients::default();
        search.segment(&plan, N, part, 0, &base.columns(0, 2), &mut found);
        found.hits
    }

    /// What pushes two channels, one of them by two coefficients at once, comes out with both values, each within 4σ (false alarm
    /// 1.3e-4); σ is that of least squares over the eight samples, `(8 (1, ½; ½, 1¼))⁻¹`. Taken alone, the first would be `a + ½ b`.
    #[test]
    fn an_event_has_its_time_its_values_and_the_errors_of_least_squares() {
        let truth = [4.0, -6.0];
        let found = hits(1, 0.5, Part::MiddleHalf, truth, 0.0);
        let hit = &found[0];
        assert!((hit.at_ns - 1_000_000_000 * AT as i64).abs() <= 1_000_000_000, "{hit:?}");
        let sigma = [(10.0_f64 / 64.0).sqrt(), (8.0_f64 / 64.0).sqrt()];
        for ((found, truth), sigma) in hit.coefficients.iter().zip(truth).zip(sigma) {
            assert!((found.value - truth).abs() < 4.0 * sigma, "{found:?}");
            assert!((found.sigma / sigma - 1.0).abs() < 0.02, "{found:?} against {sigma}");
        }
        assert!(hits(2, 0.5, Part::MiddleHalf, [0.0; 2], 0.0).is_empty());
    }

    /// Through a filter that rings for a quarter of the segment an event is found all the same, however loud.
    #[test]
    fn an_event_that_rings_is_found_however_loud_it_is() {
        for size in [15.0, 500.0] {
            let found = hits(3, 0.003, Part::MiddleHalf, [size, 0.0], 0.0);
            let hit = found.first().unwrap_or_else(|| panic!("{size} is not found"));
            assert!((hit.at_ns - 1_000_000_000 * AT as i64).abs() < 100_000_000_000, "{hit:?}");
            let a = hit.coefficients.iter().find(|c| c.name == "a").expect("fitted");
            assert!((a.value - size).abs() < 4.0 * a.sigma, "{size}: {a:?}");
        }
    }

    /// Through two bins alone it rings over the whole segment: the median of the filter's output is the event itself, and only what
    /// its peak leaves tells that there is nothing else.
    #[test]
    fn an_event_that_rings_over_the_whole_segment_is_found() {
        assert!(!hits(3, 0.0012, Part::MiddleHalf, [500.0, 0.0], 0.0).is_empty());
    }

    /// What goes on and on is no event.
    #[test]
    fn a_wave_is_no_event() {
        for part in [Part::MiddleHalf, Part::All] {
            assert!(hits(4, 0.5, part, [0.0; 2], 10.0).is_empty());
        }
    }

    #[test]
    fn a_thinned_template_gives_as_much() {
        let search = Search::new(vec![template("a", &[(0, 1.0)])], DMatrix::identity(1, 1), Vec::new());
        let kernel = &search.thinned(3, 1.0).templates[0].kernel;
        assert_eq!(kernel.len(), 3);
        assert!((3.0 * kernel.iter().sum::<f64>() - COURSE as f64).abs() < 1e-12);
    }
}
