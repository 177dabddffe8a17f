//! One causal pass: innovations of the channels, and how they change with every parameter, into sums.
//!
//! A parameter θ adds a known signal φ to the channels or changes the noise, or both. With `ν = −∂e/∂θ`,
//!
//! ```text
//! ν = φ − C χ,   χ⁺ = F χ + K ν − ∂K e
//! ```
//!
//! is the same filter once more. Whitened, ν and e are summed as a matrix of products.
//!
//! The predictor is the steady one from the first sample on and after every gap. What an infinite past would have told
//! it of the moving averages is then unknown: a state whose effect on the innovations is filtered beside the parameters
//! and fitted out of the sums. Given that state the innovations are white, so this is exact. The state is free: its
//! variance before any data is [`FREE`] times what it would be by chance, because commands know the readouts before the
//! first sample, and a state that is independent of them would bias a gain.

use nalgebra::{DMatrix, DVector};

use super::predictor::{Change, Predictor};
use super::state_space::NoiseStates;

/// Parameters that are filtered side by side.
const LANES: usize = 8;
/// Tiles of a group, whose products are taken together.
const TILES: usize = 4;
/// Rows that are filtered before products are taken.
const ROWS: usize = 256;
/// What is left of a start when squares of innovations are summed for levels of the noise, and the longest wait, s.
const SETTLED: f64 = 1e-2;
const LONGEST_WAIT_S: f64 = 600.0;
/// Variance of a start over what it is by chance.
pub(crate) const FREE: f64 = 1e6;
/// Powers of time that each channel may follow beside everything else: a constant, a slope, a curvature.
pub const POWERS: usize = 3;
const DAY_NS: f64 = 86_400e9;

/// Response of a channel to a parameter: channel, series, factor.
pub type Response = (usize, usize, f64);

/// A parameter of the likelihood.
#[derive(Clone, Debug, Default)]
pub struct Parameter {
    /// What it adds to the channels.
    pub responses: Vec<Response>,
    /// How it changes the noise.
    pub change: Option<Change>,
}

/// Sums of a pass. Sums of several stretches of data add.
#[derive(Clone, Debug)]
pub struct Sums {
    /// Information, parameters × parameters.
    pub information: DMatrix<f64>,
    /// Score: the derivative of the log-likelihood by each parameter.
    pub score: Vec<f64>,
    /// Sum of squares of the whitened innovations.
    pub chi2: f64,
    /// Numbers of them.
    pub numbers: f64,
    /// `Σ ẽ ẽᵀ`, channels × channels.
    pub squares: DMatrix<f64>,
    /// Number of samples.
    pub samples: u64,
    /// The start of each stretch without a gap.
    pub starts: Vec<Start>,
}

/// What the past of a stretch would have told of the moving averages, as the stretch has it.
#[derive(Clone, Debug)]
pub struct Start {
    /// The state, in the units of the channels, at the values of the parameters of the pass.
    pub state: DVector<f64>,
    /// Its change with each parameter.
    pub slope: DMatrix<f64>,
}

/// Eight parameters.
struct Tile {
    /// Channel, lane, series, factor in units of the channel.
    responses: Vec<(usize, usize, usize, f64)>,
    /// `∂K`, states × channels; empty where no parameter changes the noise.
    changes: Vec<[f64; LANES]>,
    state: Vec<[f64; LANES]>,
}

struct Group {
    tiles: Vec<Tile>,
    /// Whitened ν: lanes of all tiles × (rows × channels).
    whitened: DMatrix<f64>,
}

/// The matrices of the filter, laid out for it.
struct Kernel {
    channels: usize,
    states: usize,
    /// State, state before, factor.
    transition: Vec<(usize, usize, f64)>,
    /// Channel, state, factor.
    output: Vec<(usize, usize, f64)>,
    gain: Vec<f64>,
    whitening: Vec<f64>,
}

/// A pass over the data.
pub struct Innovations {
    kernel: Kernel,
    unit: Vec<f64>,
    /// What is known of the channels: taken off before anything else.
    known: Vec<Response>,
    /// Parameters, and behind them the start of the moving averages.
    groups: Vec<Group>,
    parameters: Vec<Parameter>,
    /// Groups of parameters.
    asked: usize,
    /// Covariance of the moving averages at a start.
    start: DMatrix<f64>,
    /// What the starts explain of the squares.
    by_starts: f64,
    /// Whether no row has been filtered since the last start.
    fresh: bool,
    /// Starts as they are known, and as they are found.
    known_starts: Vec<DVector<f64>>,
    starts: Vec<Start>,
    threads: usize,
    series: usize,
    averaged: bool,
    step_ns: i64,
    settling: usize,
    /// State of the predictor.
    state: Vec<f64>,
    /// Samples until squares are summed.
    unsettled: usize,
    last_ns: Option<i64>,
    first_ns: Option<i64>,
    /// Series of the last row, without the powers of time.
    before: Vec<f64>,
    /// Rows that wait: series with powers of time, innovations, and whether their squares count.
    inputs: Vec<f64>,
    innovations: Vec<f64>,
    counts: Vec<bool>,
    whitened: DMatrix<f64>,
    products: Vec<DMatrix<f64>>,
    squares: DMatrix<f64>,
    samples: u64,
    /// Samples of which squares are summed.
    settled: u64,
    chi2: f64,
}

/// What a pass is made of.
pub struct Setup<'a> {
    /// Noise as a system.
    pub system: &'a NoiseStates,
    /// Its predictor.
    pub predictor: &'a Predictor,
    /// What is known of the channels.
    pub known: Vec<Response>,
    /// Parameters.
    pub parameters: Vec<Parameter>,
    /// States at the start of the stretches as an earlier pass has them; zero where there are none.
    pub starts: Vec<DVector<f64>>,
    /// Series that come in, without the powers of time, which follow them.
    pub series: usize,
    /// Whether a channel's sample is the mean of two samples of a series.
    pub averaged: bool,
    /// Sampling interval, ns.
    pub step_ns: i64,
    /// Threads; results do not depend on them.
    pub threads: usize,
}

impl Innovations {
    /// A pass that has seen nothing.
    pub fn new(setup: Setup<'_>) -> Self {
        let Setup { system, predictor, known, parameters, starts, series, averaged, step_ns, threads } = setup;
        let (channels, states) = (system.channels(), system.transition.nrows());
        let sparse = |m: &DMatrix<f64>| {
            let all = (0..m.nrows()).flat_map(|i| (0..m.ncols()).map(move |j| (i, j)));
            all.filter(|at| m[*at] != 0.0).map(|(i, j)| (i, j, m[(i, j)])).collect::<Vec<_>>()
        };
        let by_rows = |m: &DMatrix<f64>| m.row_iter().flat_map(|row| row.iter().copied().collect::<Vec<_>>()).collect();
        let unit = system.unit.clone();
        let columns = ROWS * channels;
        let group = |own: &[Parameter]| {
            let tiles: Vec<Tile> = own.chunks(LANES).map(|own| Tile::new(own, &unit, states)).collect();
            Group { whitened: DMatrix::zeros(LANES * tiles.len(), columns), tiles }
        };
        let mut groups: Vec<Group> = parameters.chunks(LANES * TILES).map(group).collect();
        let asked = groups.len();
        groups.extend(vec![Parameter::default(); 2 * channels].chunks(LANES * TILES).map(group));
        let products = pairs(groups.len())
            .map(|(i, j)| {
                let rows = groups[i].whitened.nrows();
                DMatrix::zeros(rows, groups.get(j).map_or(1, |g| g.whitened.nrows()))
            })
            .collect();
        let most = (LONGEST_WAIT_S * 1e9 / step_ns as f64) as usize;
        let settling = predictor.settling(system, SETTLED, most);
        let mut pass = Self {
            kernel: Kernel {
                channels,
                states,
                transition: sparse(&system.transition),
                output: sparse(&system.output),
                gain: by_rows(&predictor.gain),
                whitening: by_rows(&predictor.whitening),
            },
            known: known.into_iter().map(|(c, s, factor)| (c, s, factor / unit[c])).collect(),
            unit,
            groups,
            parameters,
            asked,
            start: predictor.known_of_the_start(system) * FREE,
            by_starts: 0.0,
            fresh: false,
            known_starts: starts,
            starts: Vec::new(),
            threads: threads.max(1),
            series,
            averaged,
            step_ns,
            settling,
            state: vec![0.0; states],
            unsettled: settling,
            last_ns: None,
            first_ns: None,
            before: vec![f64::NAN; series],
            inputs: Vec::new(),
            innovations: Vec::new(),
            counts: Vec::new(),
            whitened: DMatrix::zeros(1, columns),
            products,
            squares: DMatrix::zeros(channels, channels),
            samples: 0,
            settled: 0,
            chi2: 0.0,
        };
        pass.restart();
        pass
    }

    /// Adds a row: the channels and the series at `time_ns`. A row with a number that is not finite is a gap.
    pub fn push(&mut self, time_ns: i64, channels: &[f64], series: &[f64]) {
        let follows = self.last_ns.is_some_and(|last| (time_ns - last - self.step_ns).abs() < self.step_ns / 2);
        let sound = |values: &[f64]| values.iter().all(|x| x.is_finite());
        let whole = sound(channels) && sound(series) && (!self.averaged || follows && sound(&self.before));
        if !(follows && whole) {
            self.interrupt();
        }
        let first = *self.first_ns.get_or_insert(time_ns);
        if whole {
            let from = self.inputs.len();
            let mean = |(now, before): (&f64, &f64)| if self.averaged { 0.5 * (now + before) } else { *now };
            self.inputs.extend(series.iter().zip(&self.before).map(mean));
            let days = (time_ns - first) as f64 / DAY_NS;
            self.inputs.extend((0..POWERS).map(|k| days.powi(k as i32)));
            let mut z: Vec<f64> = channels.iter().zip(&self.unit).map(|(z, unit)| z / unit).collect();
            for (c, s, factor) in &self.known {
                z[*c] -= factor * self.inputs[from + s];
            }
            self.kernel.step(&mut self.state, &mut z);
            self.innovations.extend(z);
            self.fresh = false;
            self.counts.push(self.unsettled == 0);
            self.unsettled = self.unsettled.saturating_sub(1);
        }
        self.last_ns = Some(time_ns);
        self.before.copy_from_slice(series);
        if self.counts.len() == ROWS {
            self.sum();
        }
    }

    /// A gap: what moving averages contribute is unknown again. What is slower goes on.
    fn interrupt(&mut self) {
        if !self.fresh {
            self.sum();
            self.take_start_out();
            self.restart();
        }
    }

    fn restart(&mut self) {
        let moving = 2 * self.kernel.channels;
        self.state[..moving].fill(0.0);
        if let Some(known) = self.known_starts.get(self.starts.len()) {
            self.state[..moving].copy_from_slice(known.as_slice());
        }
        let tiles = self.groups.iter_mut().flat_map(|g| &mut g.tiles);
        tiles.for_each(|tile| tile.state[..moving].fill([0.0; LANES]));
        for i in 0..moving {
            let group = &mut self.groups[self.asked + i / (LANES * TILES)];
            let tile = &mut group.tiles[i % (LANES * TILES) / LANES];
            tile.state.iter_mut().for_each(|state| state[i % LANES] = 0.0);
            tile.state[i][i % LANES] = -1.0;
        }
        self.unsettled = self.settling;
        self.fresh = true;
    }

    /// Fits the state at the start out of all sums since then: with D its information, M its covariance before the data
    /// and B its products with the rest, they lose `B M (1 + D M)⁻¹ Bᵀ`.
    fn take_start_out(&mut self) {
        let (moving, wide, groups) = (2 * self.kernel.channels, LANES * TILES, self.groups.len());
        let places: Vec<(usize, usize)> = pairs(groups).collect();
        let at = |i: usize, j: usize| places.iter().position(|place| *place == (i, j)).unwrap_or(0);
        let own = |group: usize| (group - self.asked) * wide;
        // Products of a group, or of the data, with the states.
        let with = |group: usize| {
            let rows = self.groups.get(group).map_or(1, |g| g.whitened.nrows());
            let mut b = DMatrix::zeros(rows, moving);
            for other in self.asked..groups {
                let (product, turned) = if group <= other {
                    (&self.products[at(group, other)], false)
                } else {
                    (&self.products[at(other, group)], true)
                };
                for (i, j) in (0..rows).flat_map(|i| (0..wide.min(moving - own(other))).map(move |j| (i, j))) {
                    b[(i, own(other) + j)] = if turned { product[(j, i)] } else { product[(i, j)] };
                }
            }
            b
        };
        let mut information = DMatrix::zeros(moving, moving);
        for group in self.asked..groups {
            let rows = wide.min(moving - own(group));
            information.rows_mut(own(group), rows).copy_from(&with(group).rows(0, rows));
        }
        let unit = DMatrix::identity(moving, moving);
        let inverse = (unit + &information * &self.start).try_inverse();
        let gain = &self.start * inverse.unwrap_or_else(|| DMatrix::zeros(moving, moving));
        let all: Vec<DMatrix<f64>> = (0..=groups).map(with).collect();
        let before = self.known_starts.get(self.starts.len()).cloned().unwrap_or_else(|| DVector::zeros(moving));
        let mut slope = DMatrix::zeros(moving, self.parameters.len());
        for (i, mut column) in slope.column_iter_mut().enumerate() {
            column.copy_from(&(&gain * all[i / wide].row(i % wide).transpose() * -1.0));
        }
        self.starts.push(Start { state: before + &gain * all[groups].row(0).transpose(), slope });
        self.by_starts += (&all[groups] * &gain * all[groups].transpose())[(0, 0)];
        for (product, (i, j)) in self.products.iter_mut().zip(places) {
            if i < self.asked && (j < self.asked || j == groups) {
                *product -= &all[i] * &gain * all[j].transpose();
            } else {
                product.fill(0.0);
            }
        }
    }

    /// Filters the waiting rows by every parameter and adds the products.
    fn sum(&mut self) {
        let rows = self.counts.len();
        if rows == 0 {
            return;
        }
        let n = self.kernel.channels;
        let width = self.series + POWERS;
        for (row, counts) in self.counts.iter().enumerate() {
            let e = &self.innovations[row * n..(row + 1) * n];
            for c in 0..n {
                let whitened: f64 = (0..=c).map(|d| self.kernel.whitening[c * n + d] * e[d]).sum();
                self.whitened[(0, row * n + c)] = whitened;
            }
            let e = self.whitened.columns(row * n, n).transpose();
            self.chi2 += e.norm_squared();
            self.samples += 1;
            if *counts {
                self.squares.ger(1.0, &e.column(0), &e.column(0), 1.0);
                self.settled += 1;
            }
        }
        let batch = Batch { rows, width, inputs: &self.inputs, innovations: &self.innovations };
        let kernel = &self.kernel;
        in_parallel(&mut self.groups, self.threads, |_, group| group.filter(kernel, &batch));
        let (groups, data, columns) = (&self.groups, &self.whitened, rows * n);
        let places: Vec<(usize, usize)> = pairs(groups.len()).collect();
        in_parallel(&mut self.products, self.threads, |at, product| {
            let (i, j) = places[at];
            let a = groups[i].whitened.columns(0, columns);
            let b = groups.get(j).map_or(data, |g| &g.whitened).columns(0, columns);
            product.gemm(1.0, &a, &b.transpose(), 1.0);
        });
        self.inputs.clear();
        self.innovations.clear();
        self.counts.clear();
    }

    /// The sums, with what the levels of the noise add to them.
    pub fn finish(mut self) -> Sums {
        self.sum();
        self.take_start_out();
        let p = self.parameters.len();
        let (mut information, mut score) = (DMatrix::zeros(p, p), vec![0.0; p]);
        let wide = LANES * TILES;
        for ((i, j), product) in pairs(self.groups.len()).zip(&self.products) {
            for (a, b) in (0..product.nrows()).flat_map(|a| (0..product.ncols()).map(move |b| (a, b))) {
                let row = i * wide + a;
                if i >= self.asked || row >= p {
                    continue;
                }
                if j == self.groups.len() {
                    score[row] = product[(a, b)];
                } else if j < self.asked && j * wide + b < p {
                    information[(row, j * wide + b)] = product[(a, b)];
                    information[(j * wide + b, row)] = product[(a, b)];
                }
            }
        }
        let samples = self.settled as f64;
        let changes: Vec<(usize, &DMatrix<f64>)> =
            self.parameters.iter().enumerate().filter_map(|(i, p)| Some((i, &p.change.as_ref()?.innovation))).collect();
        for (i, own) in &changes {
            score[*i] += 0.5 * (own.component_mul(&self.squares).sum() - samples * own.trace());
            for (j, other) in &changes {
                information[(*i, *j)] += 0.5 * samples * own.component_mul(other).sum();
            }
        }
        let (chi2, numbers) = (self.chi2 - self.by_starts, (self.samples as usize * self.kernel.channels) as f64);
        Sums { information, score, chi2, numbers, squares: self.squares, samples: self.samples, starts: self.starts }
    }
}

/// Pairs of groups, each once; the last number stands for the data.
fn pairs(groups: usize) -> impl Iterator<Item = (usize, usize)> {
    (0..groups).flat_map(move |i| (i..=groups).map(move |j| (i, j)))
}

/// Calls `work` with every item and its index, on some threads.
fn in_parallel<T: Send>(items: &mut [T], threads: usize, work: impl Fn(usize, &mut T) + Sync) {
    let part = items.len().div_ceil(threads).max(1);
    std::thread::scope(|scope| {
        for (number, own) in items.chunks_mut(part).enumerate() {
            let work = &work;
            scope.spawn(move || own.iter_mut().enumerate().for_each(|(i, item)| work(number * part + i, item)));
        }
    });
}

struct Batch<'a> {
    rows: usize,
    /// Series with the powers of time.
    width: usize,
    inputs: &'a [f64],
    innovations: &'a [f64],
}

impl Kernel {
    /// From what is seen to innovations, for the data.
    fn step(&self, state: &mut [f64], z: &mut [f64]) {
        for (c, s, factor) in &self.output {
            z[*c] -= factor * state[*s];
        }
        let mut next: Vec<f64> =
            self.gain.chunks(self.channels).map(|k| k.iter().zip(&*z).map(|(k, e)| k * e).sum()).collect();
        for (i, j, factor) in &self.transition {
            next[*i] += factor * state[*j];
        }
        state.copy_from_slice(&next);
    }
}

impl Group {
    fn filter(&mut self, kernel: &Kernel, batch: &Batch<'_>) {
        for (t, tile) in self.tiles.iter_mut().enumerate() {
            tile.filter(kernel, batch, &mut self.whitened, t * LANES);
        }
    }
}

impl Tile {
    fn new(parameters: &[Parameter], unit: &[f64], states: usize) -> Self {
        let mut responses: Vec<(usize, usize, usize, f64)> = Vec::new();
        for (lane, parameter) in parameters.iter().enumerate() {
            responses.extend(parameter.responses.iter().map(|(c, s, factor)| (*c, lane, *s, factor / unit[*c])));
        }
        let mut changes = Vec::new();
        for (lane, change) in parameters.iter().enumerate().filter_map(|(lane, p)| Some((lane, p.change.as_ref()?))) {
            changes.resize(states * unit.len(), [0.0; LANES]);
            for (i, row) in change.gain.row_iter().enumerate() {
                row.iter().enumerate().for_each(|(c, k)| changes[i * unit.len() + c][lane] = *k);
            }
        }
        Self { responses, changes, state: vec![[0.0; LANES]; states] }
    }

    fn filter(&mut self, kernel: &Kernel, batch: &Batch<'_>, whitened: &mut DMatrix<f64>, lane: usize) {
        let n = kernel.channels;
        let mut nu = vec![[0.0; LANES]; n];
        let mut next = vec![[0.0; LANES]; kernel.states];
        for row in 0..batch.rows {
            nu.fill([0.0; LANES]);
            let input = &batch.inputs[row * batch.width..(row + 1) * batch.width];
            for (c, lane, s, factor) in &self.responses {
                nu[*c][*lane] += factor * input[*s];
            }
            for (c, s, factor) in &kernel.output {
                add(&mut nu[*c], -factor, &self.state[*s]);
            }
            for c in 0..n {
                let mut white = [0.0; LANES];
                for d in 0..=c {
                    add(&mut white, kernel.whitening[c * n + d], &nu[d]);
                }
                whitened.column_mut(row * n + c).rows_mut(lane, LANES).copy_from_slice(&white);
            }
            for (i, next) in next.iter_mut().enumerate() {
                *next = [0.0; LANES];
                for (c, nu) in nu.iter().enumerate() {
                    add(next, kernel.gain[i * n + c], nu);
                }
            }
            if !self.changes.is_empty() {
                let e = &batch.innovations[row * n..(row + 1) * n];
                for (next, change) in next.iter_mut().zip(self.changes.chunks(n)) {
                    change.iter().zip(e).for_each(|(change, e)| add(next, -e, change));
                }
            }
            for (i, j, factor) in &kernel.transition {
                add(&mut next[*i], *factor, &self.state[*j]);
            }
            std::mem::swap(&mut self.state, &mut next);
        }
    }
}

#[inline(always)]
fn add(to: &mut [f64; LANES], factor: f64, what: &[f64; LANES]) {
    to.iter_mut().zip(what).for_each(|(to, x)| *to += factor * x);
}
