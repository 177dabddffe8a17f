//! Sums over everything that might explain the data: channels, the model's series and those of every candidate, cut once.
//!
//! Per band the Gram matrix `Σ Re(x* xᵀ)` of all columns, by matrix products, so that any model made of them is solved and ranked
//! without reading the data again. Series that are slow by their nature stand last and are left out above [`SLOW_HZ`]. What the
//! data of every second stretch of an hour and a half say is kept apart from the rest: a cause must help in both.

use std::ops::Range;

use dragfree_estimation::segments::Cuts;
use dragfree_estimation::spectra::{FIRST_BIN, Plan, Spectra, Transformer, triangle};
use nalgebra::DMatrix;

use crate::transient::Search;
use crate::witness::Witnesses;

/// Slow series have nothing above this.
pub const SLOW_HZ: f64 = 0.05;

/// Stretches of this length go to the first and the second set in turn, s.
const STRETCH_S: f64 = 1.5 * 3600.0;

/// The map of where the model fails has one row for this time, ns.
pub const HOUR_NS: i64 = 3_600_000_000_000;

/// What the columns are, in the order in which they are handed in.
#[derive(Clone, Debug, PartialEq)]
pub struct Columns {
    /// Names: channels, series of the model, series of candidates, slow series of candidates.
    pub names: Vec<String>,
    /// How many of them are channels.
    pub channels: usize,
    /// Channels and series of the model.
    pub base: usize,
    /// All but the slow ones.
    pub fast: usize,
}

impl Columns {
    /// Columns that take part in a band.
    fn active(&self, plan: &Plan, band: usize) -> usize {
        if plan.bin_hz(plan.bands[band].end as f64) <= SLOW_HZ { self.names.len() } else { self.fast }
    }
}

/// Sums of some segments.
#[derive(Clone, Debug, PartialEq)]
pub struct Gram {
    /// Weights as those of the channels' spectra; their cross-spectra stay empty.
    pub weights: Spectra,
    /// Per band, the square of its active columns, symmetric.
    pub bands: Vec<DMatrix<f64>>,
}

impl Gram {
    pub(crate) fn zero(columns: &Columns, plan: &Plan) -> Self {
        let square = |b: usize| DMatrix::zeros(columns.active(plan, b), columns.active(plan, b));
        Self { weights: Spectra::zero(plan.bands.len(), 0), bands: (0..plan.bands.len()).map(square).collect() }
    }

    /// Adds the sums of other segments of the same columns.
    pub fn add(&mut self, other: &Self) {
        self.weights.add(&other.weights);
        self.bands.iter_mut().zip(&other.bands).for_each(|(a, b)| *a += b);
    }

    /// The spectra of some of the columns, in the order asked for; zero where a slow one has nothing.
    #[must_use]
    pub fn select(&self, columns: &[usize]) -> Spectra {
        let mut out = self.weights.clone();
        out.packed = Vec::with_capacity(self.bands.len() * triangle(columns.len()));
        for g in &self.bands {
            for (i, a) in columns.iter().enumerate() {
                let inside = |b: &usize| *a < g.nrows() && *b < g.nrows();
                out.packed.extend(columns[..=i].iter().map(|b| if inside(b) { g[(*a, *b)] } else { 0.0 }));
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

/// Everything that was gathered.
#[derive(Clone, Debug, PartialEq)]
pub struct Gathered {
    /// What the columns are.
    pub columns: Columns,
    /// Samples of a segment, samples per second.
    pub length: usize,
    /// Samples per second.
    pub rate_hz: f64,
    /// Sums of the first and the second set of stretches.
    pub sets: [Gram; 2],
    /// The base columns hour by hour.
    pub hours: Vec<Hour>,
    /// Housekeeping against the residuals.
    pub witnesses: Witnesses,
    /// The loudest transients.
    pub transients: Search,
}

impl Gathered {
    /// All segments together.
    #[must_use]
    pub fn total(&self) -> Gram {
        let mut total = self.sets[0].clone();
        total.add(&self.sets[1]);
        total
    }

    /// The plan of its bands.
    #[must_use]
    pub fn plan(&self) -> Plan {
        Plan::new(self.length, self.rate_hz)
    }
}

/// Gathers segments.
pub struct Gatherer {
    plan: Plan,
    threads: usize,
    transformers: Vec<Transformer>,
    /// Real and imaginary parts from the first bin, a column of the matrix per column of the data.
    spectra: DMatrix<f64>,
    /// What has been gathered.
    pub gathered: Gathered,
}

impl Gatherer {
    /// A gatherer of segments of `length` samples.
    #[must_use]
    pub fn new(
        columns: Columns,
        length: usize,
        rate_hz: f64,
        threads: usize,
        witnesses: Witnesses,
        transients: Search,
    ) -> Self {
        let plan = Plan::new(length, rate_hz);
        let gram = Gram::zero(&columns, &plan);
        Self {
            transformers: (0..threads.max(1)).map(|_| Transformer::new(&plan)).collect(),
            spectra: DMatrix::zeros(2 * (length / 2 - FIRST_BIN), columns.names.len()),
            gathered: Gathered {
                length,
                rate_hz,
                sets: [gram.clone(), gram],
                hours: Vec::new(),
                witnesses,
                transients,
                columns,
            },
            threads: threads.max(1),
            plan,
        }
    }

    fn transform(&mut self, taper: usize, columns: &[&[f64]]) {
        let rows = self.spectra.nrows();
        let each = columns.len().div_ceil(self.threads);
        let (plan, spectra) = (&self.plan, self.spectra.as_mut_slice());
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
    fn multiply(&mut self, taper: usize, set: usize) {
        let bins = self.plan.bins(taper);
        let spectra = &self.spectra;
        let grams = &mut self.gathered.sets[set].bands;
        let work = |g: &DMatrix<f64>, bins: &Range<usize>| g.len() * bins.len();
        let total: usize = grams.iter().zip(bins).map(|(g, b)| work(g, b)).sum();
        std::thread::scope(|scope| {
            let mut rest = grams.as_mut_slice();
            let mut first = 0;
            for thread in 0..self.threads {
                let mut taken = 0;
                let mut count = 0;
                while count < rest.len() && (taken < total.div_ceil(self.threads) || thread + 1 == self.threads) {
                    taken += work(&rest[count], &bins[first + count]);
                    count += 1;
                }
                let (mine, others) = rest.split_at_mut(count);
                let bins = &bins[first..first + count];
                (rest, first) = (others, first + count);
                scope.spawn(move || {
                    for (g, bins) in mine.iter_mut().zip(bins).filter(|(_, b)| !b.is_empty()) {
                        let part = spectra.view((2 * (bins.start - FIRST_BIN), 0), (2 * bins.len(), g.ncols()));
                        g.gemm(1.0, &part.transpose(), &part, 1.0);
                    }
                });
            }
        });
    }

    fn hour(&mut self, taper: usize, middle_ns: i64) {
        let start_ns = middle_ns.div_euclid(HOUR_NS) * HOUR_NS;
        let base = self.gathered.columns.base;
        if self.gathered.hours.last().is_none_or(|h| h.start_ns != start_ns) {
            self.gathered.hours.push(Hour { start_ns, spectra: Spectra::zero(self.plan.bands.len(), base) });
        }
        let Some(hour) = self.gathered.hours.last_mut() else { return };
        hour.spectra.count_segment(&self.plan, taper, false);
        let mut entries = hour.spectra.packed.iter_mut();
        for bins in self.plan.bins(taper) {
            for i in 0..base {
                for j in 0..=i {
                    let rows = (2 * (bins.start - FIRST_BIN), 2 * bins.len());
                    let [a, b] = [i, j].map(|c| self.spectra.view((rows.0, c), (rows.1, 1)));
                    if let Some(entry) = entries.next() {
                        *entry += a.dot(&b);
                    }
                }
            }
        }
    }
}

impl Cuts for Gatherer {
    fn plan(&self) -> &Plan {
        &self.plan
    }

    fn segment(&mut self, taper: usize, first_ns: i64, columns: &[&[f64]], overlaps: bool) {
        // What follows the columns are housekeeping values.
        let (columns, housekeeping) = columns.split_at(self.gathered.columns.names.len());
        let samples = columns.first().map_or(0, |c| c.len());
        let middle_ns = first_ns + (0.5e9 * samples as f64 / self.plan.rate_hz) as i64;
        let set = (middle_ns.div_euclid((STRETCH_S * 1e9) as i64)).rem_euclid(2) as usize;
        self.transform(taper, columns);
        self.multiply(taper, set);
        self.gathered.sets[set].weights.count_segment(&self.plan, taper, overlaps);
        self.hour(taper, middle_ns);
        let base = self.gathered.columns.base;
        if taper == 0 {
            self.gathered.transients.segment(&self.plan, first_ns, &self.spectra.columns(0, base));
            self.gathered.witnesses.segment(&self.plan, housekeeping, &self.spectra.columns(0, base));
        }
    }
}
