//! Gram matrices per band of channels, the model's series and those of every candidate: `Σ Re(x* xᵀ)` over segments.
//!
//! Any model made of these columns is solved from the sums without reading the data again.
//!
//! Two lengths of segments cover the bands. Short ones serve those from [`SLOW_HZ`] on. Segments [`LONG`] times as
//! long, of samples that [`Decimator`] has decimated, serve those below, where heat, charge and drifts act and
//! which lie under the main lobe of a short window. A run shorter than a long segment is one segment for the bins that
//! its halves do not have. Slow series stand last and are in the long segments alone.

use std::ops::Range;

use dragfree_estimation::segments::{Cuts, Segmenter};
use dragfree_estimation::spectra::{LONG, Plan, Spectra, Transformer, triangle};
use nalgebra::{DMatrix, DMatrixView, DVector};

use crate::coherence::HousekeepingCoherence;
use crate::columns::Columns;
use crate::lines::{LineSearch, Lines};
use crate::slow_samples::{SlowSamples, Thinner};
use crate::transient::{Part, Search, Transients};
use dragfree_estimation::decimate::{Decimator, Response, SLOW_HZ};

/// Halvings of a long segment that make a short one.
const HALVINGS: usize = LONG.ilog2() as usize;

/// Matched filters run in long segments, halves and quarters.
const SHORTEST_LOOKED_AT: usize = 2;

/// Decimated samples come at least this many times as often as [`SLOW_HZ`]: aliases below it are then weaker by 1e7.
const THIN: f64 = 6.0;

/// Time of one row of the maps of `compare`, ns.
pub const HOUR_NS: i64 = 3_600_000_000_000;

/// Sums of some segments.
#[derive(Clone, Debug, PartialEq)]
pub struct Gram {
    /// Weights as those of the channels' spectra; their cross-spectra stay empty.
    pub weights: Spectra,
    /// Per band, the square of its active columns.
    pub bands: Vec<Symmetric>,
}

/// A symmetric matrix. Most of the memory of a diagnosis is in these, so that little more than one triangle is kept:
/// blocks of columns, each from its part of the diagonal down.
#[derive(Clone, Debug, PartialEq)]
pub struct Symmetric {
    order: usize,
    blocks: Vec<DMatrix<f64>>,
}

/// Columns of a block of a [`Symmetric`] matrix.
const BLOCK: usize = 64;

impl Symmetric {
    /// A matrix of zeros, `order` × `order`.
    pub fn zeros(order: usize) -> Self {
        let block = |first: usize| DMatrix::zeros(order - first, BLOCK.min(order - first));
        Self { order, blocks: (0..order).step_by(BLOCK).map(block).collect() }
    }

    /// Number of rows and of columns.
    pub fn order(&self) -> usize {
        self.order
    }

    /// An element.
    ///
    /// # Panics
    /// There is no such row or column.
    pub fn at(&self, i: usize, j: usize) -> f64 {
        let (row, column) = (i.max(j), i.min(j));
        let first = column / BLOCK * BLOCK;
        self.blocks[column / BLOCK][(row - first, column - first)]
    }

    /// A column.
    ///
    /// # Panics
    /// As [`Self::at`].
    pub fn column(&self, j: usize) -> DVector<f64> {
        DVector::from_fn(self.order, |i, _| self.at(i, j))
    }

    /// Adds another one of the same order.
    pub fn add(&mut self, other: &Self) {
        self.blocks.iter_mut().zip(&other.blocks).for_each(|(a, b)| *a += b);
    }

    /// Adds `AᵀA` of the first columns of A: blocks of columns meet themselves and what follows.
    ///
    /// # Panics
    /// A has fewer columns than this matrix.
    pub fn add_square(&mut self, a: &DMatrixView<'_, f64>) {
        let a = a.columns(0, self.order);
        let transposed = a.transpose();
        for (k, block) in self.blocks.iter_mut().enumerate() {
            let first = k * BLOCK;
            block.gemm(1.0, &transposed.rows(first, block.nrows()), &a.columns(first, block.ncols()), 1.0);
        }
    }
}

impl Gram {
    pub(crate) fn zero(columns: &Columns, plan: &Plan) -> Self {
        let square = |b: usize| Symmetric::zeros(columns.active(plan, b));
        Self { weights: Spectra::zero(plan.bands.len(), 0), bands: (0..plan.bands.len()).map(square).collect() }
    }

    /// Adds the sums of other segments of the same columns.
    pub fn add(&mut self, other: &Self) {
        self.weights.add(&other.weights);
        self.bands.iter_mut().zip(&other.bands).for_each(|(a, b)| a.add(b));
    }

    /// The spectra of some of the columns, in the order asked for; zero where a slow one has nothing.
    pub fn select(&self, columns: &[usize]) -> Spectra {
        let mut out = self.weights.clone();
        out.packed = Vec::with_capacity(self.bands.len() * triangle(columns.len()));
        for g in &self.bands {
            for (i, a) in columns.iter().enumerate() {
                let inside = |b: &usize| *a < g.order() && *b < g.order();
                out.packed.extend(columns[..=i].iter().map(|b| if inside(b) { g.at(*a, *b) } else { 0.0 }));
            }
        }
        out
    }
}

/// An hour of the channels and the model's series.
#[derive(Clone, Debug, PartialEq)]
pub struct Hour {
    /// Its start, Unix ns.
    pub start_ns: i64,
    /// Cross-spectra of the base columns of segments whose middle lies in it.
    pub spectra: Spectra,
}

/// All sums of some telemetry.
#[derive(Clone, Debug, PartialEq)]
pub struct GramSums {
    /// Columns.
    pub columns: Columns,
    /// Samples of a short segment.
    pub length: usize,
    /// Samples per second.
    pub rate_hz: f64,
    /// Sums of all segments.
    pub total: Gram,
    /// The base columns hour by hour, in the bands of short segments ([`Self::hour_plan`]).
    pub hours: Vec<Hour>,
    /// Housekeeping against the residuals.
    pub housekeeping: HousekeepingCoherence,
    /// Slow samples of both.
    pub slow: SlowSamples,
    /// The loudest transients.
    pub transients: Transients,
    /// The loudest lines.
    pub lines: Lines,
}

impl GramSums {
    /// The plan of the bands of the sums.
    pub fn plan(&self) -> Plan {
        whole_plan(self.length, self.rate_hz)
    }

    /// The plan of the bands of the hours.
    pub fn hour_plan(&self) -> Plan {
        Plan::new(self.length, self.rate_hz)
    }
}

/// Sums segments.
pub struct GramAccumulator {
    /// Bands of the sums.
    whole: Plan,
    /// Bands below [`SLOW_HZ`].
    low_bands: usize,
    short: Plan,
    bench: SegmentTransform,
    search: Search,
    long_search: Search,
    line_search: LineSearch,
    decimator: Decimator,
    segmenter: Segmenter,
    long: Plan,
    long_bench: SegmentTransform,
    thinner: Thinner,
    gathered: GramSums,
}

/// Samples into spectra into sums.
struct SegmentTransform {
    threads: usize,
    transformers: Vec<Transformer>,
    first_bin: usize,
    /// Real and imaginary parts from the first bin, a column of the matrix per column of the data.
    spectra: DMatrix<f64>,
}

impl SegmentTransform {
    fn new(plan: &Plan, columns: usize, threads: usize) -> Self {
        Self {
            threads,
            transformers: (0..threads).map(|_| Transformer::new(plan)).collect(),
            first_bin: plan.first_bin,
            spectra: DMatrix::zeros(2 * (plan.length / 2 - plan.first_bin), columns),
        }
    }

    fn transform(&mut self, plan: &Plan, taper: usize, columns: &[&[f64]]) {
        let rows = self.spectra.nrows();
        let each = columns.len().div_ceil(self.threads);
        let spectra = self.spectra.as_mut_slice();
        std::thread::scope(|scope| {
            let parts = spectra.chunks_mut(each * rows).zip(columns.chunks(each)).zip(&mut self.transformers);
            for ((out, columns), transformer) in parts {
                scope.spawn(move || {
                    for (out, samples) in out.chunks_exact_mut(rows).zip(columns) {
                        transformer.transform(plan, taper, samples, out);
                    }
                });
            }
        });
    }

    /// `G_b += A_bᵀ A_b` in every band, the bands shared among the threads by the work in them.
    fn multiply(&self, bins: &[Range<usize>], grams: &mut [Symmetric]) {
        let spectra = &self.spectra;
        let earliest = bins.iter().filter(|b| !b.is_empty()).map(|b| b.start).min();
        assert!(earliest.is_none_or(|first| first >= self.first_bin), "the spectra have no bin {earliest:?}");
        let work = |g: &Symmetric, bins: &Range<usize>| g.order().pow(2) * bins.len();
        let total: usize = grams.iter().zip(bins).map(|(g, b)| work(g, b)).sum();
        std::thread::scope(|scope| {
            let mut rest = grams;
            let mut first = 0;
            for thread in 0..self.threads {
                let mut taken = 0;
                let mut count = 0;
                while count < rest.len() && (taken < total.div_ceil(self.threads) || thread + 1 == self.threads) {
                    taken += work(&rest[count], &bins[first + count]);
                    count += 1;
                }
                let (mine, others) = std::mem::take(&mut rest).split_at_mut(count);
                let bins = &bins[first..first + count];
                (rest, first) = (others, first + count);
                scope.spawn(move || {
                    for (g, bins) in mine.iter_mut().zip(bins).filter(|(_, b)| !b.is_empty()) {
                        g.add_square(&spectra.rows(2 * (bins.start - self.first_bin), 2 * bins.len()));
                    }
                });
            }
        });
    }

    fn base(&self, columns: usize) -> DMatrixView<'_, f64> {
        self.spectra.columns(0, columns)
    }
}

impl GramAccumulator {
    /// Sums short segments of `length` samples, and long ones. `coherence` is called with the plan of long segments;
    /// housekeeping follows the columns.
    pub fn new(
        columns: Columns,
        length: usize,
        rate_hz: f64,
        threads: usize,
        coherence: impl FnOnce(&Plan) -> HousekeepingCoherence,
        search: Search,
        line_search: LineSearch,
    ) -> Self {
        let threads = threads.max(1);
        let (whole, short) = (whole_plan(length, rate_hz), Plan::new(length, rate_hz));
        let (long, factor) = low_plan(length, rate_hz);
        let slow = |b: usize| whole.bin_hz(whole.bands[b].end as f64) <= SLOW_HZ;
        let low_bands = (0..whole.bands.len().min(long.bands.len())).take_while(|b| slow(*b)).count();
        let housekeeping = coherence(&long);
        let all = columns.names.len() + housekeeping.names.len();
        let decimator = Decimator::new(factor, all, (1e9 / rate_hz).round() as i64, threads);
        let names = housekeeping.names.clone();
        let (units, residual) = (columns.housekeeping_units.clone(), housekeeping.residual.clone());
        let thinner = Thinner::new(names, units, decimator.step_ns(), residual, columns.names.len());
        let slow = thinner.nothing();
        Self {
            low_bands,
            bench: SegmentTransform::new(&short, columns.fast, threads),
            long_search: search.thinned(factor, SLOW_HZ),
            search,
            line_search,
            segmenter: Segmenter::new(long.length, decimator.step_ns(), vec![false; all]),
            decimator,
            thinner,
            long_bench: SegmentTransform::new(&long, columns.names.len(), threads),
            gathered: GramSums {
                length,
                rate_hz,
                total: Gram::zero(&columns, &whole),
                hours: Vec::new(),
                housekeeping,
                slow,
                transients: Transients::default(),
                lines: Lines::default(),
                columns,
            },
            whole,
            short,
            long,
        }
    }

    /// The sums.
    pub fn finish(mut self) -> GramSums {
        self.gathered.slow = self.thinner.finish();
        self.gathered.lines = self.line_search.finish();
        self.gathered
    }

    fn hour(&mut self, taper: usize, middle_ns: i64) {
        let start_ns = middle_ns.div_euclid(HOUR_NS) * HOUR_NS;
        let base = self.gathered.columns.base;
        if self.gathered.hours.last().is_none_or(|h| h.start_ns != start_ns) {
            self.gathered.hours.push(Hour { start_ns, spectra: Spectra::zero(self.short.bands.len(), base) });
        }
        let Some(hour) = self.gathered.hours.last_mut() else { return };
        hour.spectra.count_segment(&self.short, taper, false);
        let mut entries = hour.spectra.packed.iter_mut();
        for bins in self.short.bins(taper) {
            for i in 0..base {
                for j in 0..=i {
                    let rows = (2 * (bins.start - self.short.first_bin), 2 * bins.len());
                    let [a, b] = [i, j].map(|c| self.bench.spectra.view((rows.0, c), (rows.1, 1)));
                    if let Some(entry) = entries.next() {
                        *entry += a.dot(&b);
                    }
                }
            }
        }
    }

    /// The segmenter of decimated samples, and what takes its segments.
    fn low(&mut self) -> (&mut Segmenter, Low<'_>) {
        let low = Low {
            response: self.decimator.response(),
            rate_hz: self.short.rate_hz,
            whole: &self.whole,
            low_bands: self.low_bands,
            long: &self.long,
            bench: &mut self.long_bench,
            search: &mut self.long_search,
            gathered: &mut self.gathered,
        };
        (&mut self.segmenter, low)
    }
}

/// The plan of the bands of the sums.
pub(crate) fn whole_plan(length: usize, rate_hz: f64) -> Plan {
    Plan::slow(LONG * length, length, rate_hz)
}

/// The plan of long segments of decimated samples, and the factor of the decimation.
pub(crate) fn low_plan(length: usize, rate_hz: f64) -> (Plan, usize) {
    let mut factor = 1;
    while (LONG * length).is_multiple_of(8 * factor) && rate_hz / (2 * factor) as f64 >= THIN * SLOW_HZ {
        factor *= 2;
    }
    (Plan::slow(LONG * length / factor, length / factor, rate_hz / factor as f64), factor)
}

fn middle_ns(first_ns: i64, columns: &[&[f64]], rate_hz: f64) -> i64 {
    let samples = columns.first().map_or(0, |c| c.len());
    first_ns + (0.5e9 * samples as f64 / rate_hz) as i64
}

impl Cuts for GramAccumulator {
    fn plan(&self) -> &Plan {
        &self.short
    }

    fn segment(&mut self, taper: usize, first_ns: i64, columns: &[&[f64]], overlaps: bool) {
        let middle_ns = middle_ns(first_ns, columns, self.short.rate_hz);
        let set = &mut self.gathered.total;
        let bands = self.low_bands..self.whole.bands.len();
        self.bench.transform(&self.short, taper, columns);
        self.bench.multiply(&self.whole.bins(taper + HALVINGS)[bands.clone()], &mut set.bands[bands.clone()]);
        set.weights.count_bands(&self.whole, taper + HALVINGS, overlaps, bands);
        set.weights.segments += 1;
        self.hour(taper, middle_ns);
        if taper == 0 {
            let base = self.bench.base(self.gathered.columns.base);
            let found = &mut self.gathered.transients;
            self.search.segment(&self.short, self.short.length, Part::MiddleHalf, first_ns, &base, found);
        }
    }

    fn rows(&mut self, first_ns: i64, columns: &[&[f64]]) {
        self.line_search.push(first_ns, &columns[..self.gathered.columns.base]);
        let (times, thinned) = self.decimator.push(first_ns, columns);
        let thinned: Vec<&[f64]> = thinned.iter().map(Vec::as_slice).collect();
        self.thinner.push(&times, &thinned);
        let (segmenter, mut low) = self.low();
        segmenter.cut(&times, &thinned, &mut low);
    }

    fn gap(&mut self) {
        self.decimator.gap();
        self.thinner.gap();
        let (segmenter, mut low) = self.low();
        segmenter.cut_end(&mut low);
    }
}

/// Takes the long segments.
struct Low<'a> {
    /// Of the decimator.
    response: Response,
    /// Samples per second before it.
    rate_hz: f64,
    whole: &'a Plan,
    low_bands: usize,
    long: &'a Plan,
    bench: &'a mut SegmentTransform,
    search: &'a mut Search,
    gathered: &'a mut GramSums,
}

impl Cuts for Low<'_> {
    fn plan(&self) -> &Plan {
        self.long
    }

    fn segment(&mut self, taper: usize, first_ns: i64, columns: &[&[f64]], overlaps: bool) {
        self.take([self.long, self.whole], taper, columns, overlaps);
        // Shorter ones cover the ends of a run.
        if taper <= SHORTEST_LOOKED_AT {
            let part = if taper == 0 { Part::MiddleHalf } else { Part::All };
            self.look(columns.first().map_or(0, |c| c.len()), part, first_ns);
        }
    }

    fn short_run(&mut self, first_ns: i64, columns: &[&[f64]]) {
        let samples = columns.first().map_or(0, |c| c.len());
        let even = samples - samples % 4;
        if even < self.long.length / LONG {
            return;
        }
        let columns: Vec<&[f64]> = columns.iter().map(|c| &c[..even]).collect();
        let thinned = self.whole.length / self.long.length;
        let plans = [self.long.between_halves(even), self.whole.between_halves(even * thinned)];
        if even > self.long.length / 2 {
            self.take([&plans[0], &plans[1]], 0, &columns, false);
        } else {
            self.transform(&plans[0], 0, &columns[..self.gathered.columns.names.len()]);
        }
        self.look(even, Part::All, first_ns);
    }

    /// The last hour of a run lies under no other window but its edge.
    fn tail(&mut self, first_ns: i64, columns: &[&[f64]]) {
        let columns = &columns[..self.gathered.columns.base];
        let samples = columns.first().map_or(0, |c| c.len());
        let lengths: Vec<usize> = self.long.lengths().collect();
        for taper in 1..=SHORTEST_LOOKED_AT {
            let Some(first) = lengths.get(taper).and_then(|length| samples.checked_sub(*length)) else { continue };
            let last: Vec<&[f64]> = columns.iter().map(|c| &c[first..]).collect();
            self.transform(self.long, taper, &last);
            self.look(lengths[taper], Part::All, first_ns + first as i64 * self.step_ns());
        }
    }
}

impl Low<'_> {
    /// Step of the decimated samples, ns.
    fn step_ns(&self) -> i64 {
        (1e9 / self.long.rate_hz).round() as i64
    }

    /// Spectra of the samples before the decimation.
    fn transform(&mut self, plan: &Plan, taper: usize, columns: &[&[f64]]) {
        let samples = columns.first().map_or(0, |c| c.len());
        self.bench.transform(plan, taper, columns);
        for k in plan.first_bin..samples / 2 {
            let gain = self.response.at(k as f64 * plan.rate_hz / samples as f64 / self.rate_hz);
            self.bench.spectra.rows_mut(2 * (k - plan.first_bin), 2).scale_mut(gain.recip());
        }
    }

    /// Runs the matched filters on the segment that was transformed last.
    fn look(&mut self, samples: usize, part: Part, first_ns: i64) {
        let base = self.bench.base(self.gathered.columns.base);
        // A template begins with the first half of its first sample.
        let first_ns = first_ns - (0.5e9 / self.long.rate_hz) as i64;
        self.search.segment(self.long, samples, part, first_ns, &base, &mut self.gathered.transients);
    }

    /// A segment of the `taper`-th length. `plans` are that of the decimated samples, whose lowest bands are those of
    /// the sums, and that of all samples, which gives its weight.
    fn take(&mut self, plans: [&Plan; 2], taper: usize, columns: &[&[f64]], overlaps: bool) {
        let [plan, counted] = plans;
        let (columns, housekeeping) = columns.split_at(self.gathered.columns.names.len());
        self.transform(plan, taper, columns);
        let set = &mut self.gathered.total;
        let bands = 0..self.low_bands.min(plan.bands.len());
        self.bench.multiply(&plan.bins(taper)[bands.clone()], &mut set.bands[bands.clone()]);
        set.weights.count_bands(counted, taper, overlaps, bands);
        let base = self.bench.base(self.gathered.columns.base);
        self.gathered.housekeeping.segment(plan, taper, housekeeping, &base, overlaps);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Several blocks, of which the last one is narrower; the product by nalgebra as a whole.
    #[test]
    fn a_sum_of_squares_has_both_triangles() {
        for order in [1, BLOCK, 2 * BLOCK + 7] {
            let a = DMatrix::from_fn(9, order + 2, |i, j| ((7 * i + 3 * j) % 11) as f64 - 4.0);
            let mut sum = Symmetric::zeros(order);
            sum.add_square(&a.as_view());
            let mut twice = sum.clone();
            twice.add(&sum);
            let whole = a.columns(0, order).transpose() * a.columns(0, order);
            assert_eq!(DMatrix::from_fn(order, order, |i, j| sum.at(i, j)), whole);
            assert_eq!(twice.column(order / 2), 2.0 * whole.column(order / 2));
        }
    }

    #[test]
    fn little_more_than_a_triangle_is_kept() {
        let kept: usize = Symmetric::zeros(800).blocks.iter().map(DMatrix::len).sum();
        assert!(kept < 800 * (800 + 2 * BLOCK) / 2, "{kept}");
    }
}
