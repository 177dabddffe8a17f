//! The bands below the first bin of ordinary segments: decimated samples in segments [`LONG`] times as long.
//!
//! Heat, currents and charge act there. A channel and its regressors are decimated by the same filter, so that their
//! regressions stay, and every spectrum is divided by the filter's response. A run shorter than a long segment is one
//! segment for the bins that its halves do not have. What is kept is some hundred samples a column, however long the
//! telemetry is.

use crate::decimate::{Decimator, Response};
use crate::segments::{Cuts, Segmenter};
use crate::spectra::{LONG, Plan, Spectra, Transformer, dot, triangle};

/// Decimated samples come at least this many times as often as the highest slow frequency. Its alias by the first
/// multiple of their rate is then weaker by `5⁵`, and the second difference of readout noise louder by `5²`.
const THIN: f64 = 6.0;

/// Turns long segments into cross-spectra.
#[derive(Clone)]
struct LongAnalyser {
    /// Segments of decimated samples.
    plan: Plan,
    /// Bands that are summed, the first of the plan.
    bands: usize,
    columns: usize,
    factor: usize,
    /// Of the decimator.
    response: Response,
    /// Samples per second before it.
    rate_hz: f64,
    transformer: Transformer,
    /// Per column: real and imaginary part of each bin from the plan's first.
    scaled: Vec<Vec<f64>>,
}

impl LongAnalyser {
    /// For the slow bands of a plan; none where it has none.
    fn new(plan: &Plan, columns: usize) -> Option<Self> {
        let last = plan.bands[..plan.slow_bands].last()?;
        let below_hz = plan.hz(*last, last.end as f64);
        let mut factor = 1;
        let divides = |factor: usize| last.of.is_multiple_of(8 * factor);
        while divides(factor) && plan.rate_hz / (2 * factor) as f64 >= THIN * below_hz {
            factor *= 2;
        }
        let (length, rate_hz) = (last.of / factor, plan.rate_hz / factor as f64);
        let long = Plan::slow(length, length / LONG, rate_hz);
        Some(Self {
            bands: plan.slow_bands,
            columns,
            factor,
            response: Response::of(factor),
            rate_hz: plan.rate_hz,
            transformer: Transformer::new(&long),
            scaled: vec![vec![0.0; long.length]; columns],
            plan: long,
        })
    }

    /// Adds one segment of the `taper`-th length of a plan, that of long segments or of one between two lengths.
    fn add(&mut self, plan: Option<&Plan>, taper: usize, columns: &[&[f64]], overlaps: bool, total: &mut Spectra) {
        let plan = plan.unwrap_or(&self.plan);
        let bands = 0..self.bands.min(plan.bands.len());
        let bins = &plan.bins(taper)[bands.clone()];
        let Some(end) = bins.iter().filter(|b| !b.is_empty()).map(|b| b.end).max() else { return };
        for (samples, out) in columns.iter().zip(&mut self.scaled) {
            self.transformer.transform(plan, taper, samples, out);
            for (k, pair) in (plan.first_bin..end).zip(out.chunks_exact_mut(2)) {
                let gain = self.response.at(k as f64 * plan.rate_hz / samples.len() as f64 / self.rate_hz);
                pair.iter_mut().for_each(|x| *x /= gain);
            }
        }
        let mut entries = total.packed[..bands.end * triangle(self.columns)].iter_mut();
        for bins in bins {
            let range = 2 * (bins.start - plan.first_bin)..2 * (bins.end - plan.first_bin);
            for i in 0..self.columns {
                let a = &self.scaled[i][range.clone()];
                for (b, entry) in self.scaled[..=i].iter().zip(&mut entries) {
                    *entry += dot(a, &b[range.clone()]);
                }
            }
        }
        let mut counted = Spectra::zero(plan.bands.len(), 0);
        counted.count_bands(plan, taper, overlaps, bands.clone());
        // Weights are of the samples before the decimation.
        for b in bands {
            total.expected[b] += counted.expected[b];
            total.weight[b] += self.factor as f64 * counted.weight[b];
            total.weight_squared[b] += self.factor as f64 * counted.weight_squared[b];
        }
    }
}

/// Long segments, and the samples that those to come still need.
#[derive(Clone)]
pub struct SlowBand {
    long: LongAnalyser,
    pub(crate) decimator: Decimator,
    pub(crate) segmenter: Segmenter,
}

impl SlowBand {
    /// For the slow bands of a plan; none where it has none.
    pub(crate) fn new(plan: &Plan, columns: usize) -> Option<Self> {
        let long = LongAnalyser::new(plan, columns)?;
        let decimator = Decimator::new(long.factor, columns, (1e9 / plan.rate_hz).round() as i64, 1);
        let segmenter = Segmenter::new(long.plan.length, decimator.step_ns(), vec![false; columns]);
        Some(Self { long, decimator, segmenter })
    }

    /// More samples of a run.
    pub(crate) fn push(&mut self, first_ns: i64, columns: &[&[f64]], total: &mut Spectra) {
        let (times, thinned) = self.decimator.push(first_ns, columns);
        let thinned: Vec<&[f64]> = thinned.iter().map(Vec::as_slice).collect();
        self.segmenter.cut(&times, &thinned, &mut IntoTotal { long: &mut self.long, total });
    }

    /// The run has ended.
    pub(crate) fn gap(&mut self, total: &mut Spectra) {
        self.decimator.gap();
        self.segmenter.cut_end(&mut IntoTotal { long: &mut self.long, total });
    }
}

/// Long segments into the sums.
struct IntoTotal<'a> {
    long: &'a mut LongAnalyser,
    total: &'a mut Spectra,
}

impl Cuts for IntoTotal<'_> {
    fn plan(&self) -> &Plan {
        &self.long.plan
    }

    fn segment(&mut self, taper: usize, _first_ns: i64, columns: &[&[f64]], overlaps: bool) {
        self.long.add(None, taper, columns, overlaps, self.total);
    }

    fn short_run(&mut self, _first_ns: i64, columns: &[&[f64]]) {
        let samples = columns.first().map_or(0, |c| c.len());
        let even = samples - samples % 4;
        if even > self.long.plan.length / 2 {
            let plan = self.long.plan.between_halves(even);
            let columns: Vec<&[f64]> = columns.iter().map(|c| &c[..even]).collect();
            self.long.add(Some(&plan), 0, &columns, false, self.total);
        }
    }
}
