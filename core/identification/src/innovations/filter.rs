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
//! variance before any data is a million times what it would be by chance, because commands know the readouts before
//! the first sample, and a state that is independent of them would bias a gain.
//!
//! The state is fitted at the end of a stretch without a gap, and at the end of each block of time: everything goes on
//! from the state as it is then found, with what is still unknown of it. A block's rows are so given the blocks before
//! it, as a likelihood is a product of conditional ones, and the sums of all blocks are those of the whole. Between
//! test masses, where forces are weak, readouts are averaged over many minutes: what a start was is told for many
//! hours.

use std::sync::{Mutex, PoisonError};

use nalgebra::{DMatrix, DMatrixView, DVector, Dyn};

use super::predictor::{Beside, Change, Predictor};
use super::state_space::NoiseStates;

/// Parameters that are filtered side by side.
const LANES: usize = 8;
/// Tiles of a group, whose products are taken together.
const TILES: usize = 5;
/// Parameters of a group.
const WIDE: usize = LANES * TILES;
/// Rows that are filtered before products are taken.
const ROWS: usize = 128;
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
    /// Channels whose innovations, whitened with those before them, are not weighed for it: they are not independent of
    /// what it adds. What is left is the likelihood of the other channels alone.
    pub not_weighed: Vec<usize>,
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

/// Sums of a block of time, given all blocks before it. See [`Sums`].
#[derive(Clone, Debug)]
pub struct Block {
    /// Where the block begins: a multiple of its length after the first row of all, ns.
    pub first_ns: i64,
    /// Upper triangle of the information, column after column: element (i, j) with i ≤ j is at `j (j + 1) / 2 + i`.
    pub information: Vec<f64>,
    /// Score.
    pub score: Vec<f64>,
    /// Sum of squares of the whitened innovations.
    pub chi2: f64,
    /// Numbers of them.
    pub numbers: f64,
    /// `Σ ẽ ẽᵀ` of the settled samples, channels × channels.
    pub squares: DMatrix<f64>,
    /// Number of samples.
    pub samples: u64,
    /// Number of samples in `squares`: those that no start reaches.
    pub settled: u64,
}

/// What a pass gives.
#[derive(Clone, Debug)]
pub struct Passed {
    /// Blocks with at least one sample, in the order of time.
    pub blocks: Vec<Block>,
    /// The start of each stretch without a gap.
    pub starts: Vec<Start>,
    parameters: usize,
    channels: usize,
}

impl Passed {
    /// The sums of all blocks.
    pub fn total(&self) -> Sums {
        let mut sums = Sums::zeros(self.parameters, self.channels);
        self.blocks.iter().for_each(|block| sums.add(block));
        sums.starts.clone_from(&self.starts);
        sums
    }
}

impl Sums {
    /// Sums of nothing.
    pub fn zeros(parameters: usize, channels: usize) -> Self {
        Self {
            information: DMatrix::zeros(parameters, parameters),
            score: vec![0.0; parameters],
            chi2: 0.0,
            numbers: 0.0,
            squares: DMatrix::zeros(channels, channels),
            samples: 0,
            starts: Vec::new(),
        }
    }

    /// Adds a block of the same parameters.
    pub fn add(&mut self, block: &Block) {
        let mut packed = block.information.iter();
        for j in 0..self.score.len() {
            for (i, x) in (0..=j).zip(&mut packed) {
                self.information[(i, j)] += x;
                self.information[(j, i)] = self.information[(i, j)];
            }
        }
        self.score.iter_mut().zip(&block.score).for_each(|(to, x)| *to += x);
        self.chi2 += block.chi2;
        self.numbers += block.numbers;
        self.squares += &block.squares;
        self.samples += block.samples;
    }
}

/// The matrices of the filter, laid out for it.
struct Kernel {
    channels: usize,
    /// States as they are filtered, see [`NoiseStates::merged`], made even by one that stays zero.
    states: usize,
    /// Two states after two states: for both a state before and a factor, zero where the other has more of them.
    transition: Vec<Vec<[(usize, f64); 2]>>,
    /// Of each channel: states and factors.
    output: Vec<Vec<(usize, f64)>>,
    /// Two states after two states, their gains channel by channel.
    gain: Vec<[f64; 2]>,
    /// Two channels after two channels: channels up to the second of them.
    whitening: Vec<Vec<[f64; 2]>>,
}

/// Eight parameters.
struct Tile {
    /// Channel, lane, series, factor in units of the channel.
    responses: Vec<(usize, usize, usize, f64)>,
    /// `∂K`, states × channels; empty where no parameter changes the noise.
    changes: Vec<[f64; LANES]>,
    /// Filters at zero, each in one lane.
    filters: Vec<Filter>,
    state: Vec<[f64; LANES]>,
    next: Vec<[f64; LANES]>,
    nu: Vec<[f64; LANES]>,
    /// Channel and lane that are not weighed.
    not_weighed: Vec<(usize, usize)>,
}

/// A filter at coefficient zero: states of one parameter.
struct Filter {
    lane: usize,
    /// State, state before, factor.
    transition: Vec<(usize, usize, f64)>,
    /// Channel, state, factor.
    output: Vec<(usize, usize, f64)>,
    /// `∂K`, states × channels.
    gain: Vec<f64>,
    state: Vec<f64>,
    next: Vec<f64>,
}

/// Tiles whose products are taken together.
struct Group {
    tiles: Vec<Tile>,
    /// Whitened ν: lanes of all tiles × (rows × channels).
    whitened: DMatrix<f64>,
}

/// Products of the lanes of two groups.
struct Product {
    groups: (usize, usize),
    sum: DMatrix<f64>,
}

/// Rows that wait.
struct Waiting {
    /// Series with the powers of time.
    inputs: Vec<f64>,
    innovations: Vec<f64>,
    /// Whether the squares of a row count for the levels.
    counts: Vec<bool>,
}

/// A pass over the data.
pub struct Innovations {
    kernel: Kernel,
    unit: Vec<f64>,
    /// What is known of the channels: taken off before anything else.
    known: Vec<Response>,
    /// Parameters and the data, and at last the start of the moving averages.
    groups: Vec<Group>,
    /// `W ∂S Wᵀ` of the parameters that change the noise.
    changes: Vec<(usize, DMatrix<f64>)>,
    /// Lane of each parameter, and at last that of the data.
    lanes: Vec<usize>,
    /// Covariance of the moving averages at a start.
    start: DMatrix<f64>,
    /// Covariance of the start of the stretch that goes on, as the blocks before have it.
    uncertain: DMatrix<f64>,
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
    next: Vec<f64>,
    z: Vec<f64>,
    /// Samples until squares are summed.
    unsettled: usize,
    last_ns: Option<i64>,
    first_ns: Option<i64>,
    /// Series of the last row, without the powers of time.
    before: Vec<f64>,
    waiting: Waiting,
    /// Those of parameters and data first.
    products: Vec<Product>,
    /// Samples of a block, and the number of the block that is summed.
    block: Option<u64>,
    number: i64,
    blocks: Vec<Block>,
    squares: DMatrix<f64>,
    samples: u64,
    /// Samples of which squares are summed.
    settled: u64,
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
    /// Length of a block in samples, by time from the first row, gaps included; all in one where there is none.
    pub block: Option<u64>,
    /// Threads; results do not depend on them.
    pub threads: usize,
}

impl Innovations {
    /// A pass that has seen nothing.
    pub fn new(setup: Setup<'_>) -> Self {
        let Setup { system, predictor, known, parameters, starts, series, averaged, step_ns, block, threads } = setup;
        let (channels, moving) = (system.channels(), 2 * system.channels());
        let kernel = Kernel::new(system, predictor);
        let unit = system.unit.clone();
        // Side by side those that change the noise, as a tile without any is filtered faster.
        let mut order: Vec<usize> = (0..parameters.len()).collect();
        order.sort_by_key(|i| parameters[*i].change.is_none());
        let mut lanes = vec![parameters.len(); parameters.len() + 1];
        order.iter().enumerate().for_each(|(lane, i)| lanes[*i] = lane);
        // The data have a lane of their own, without a response, for what the fitted starts change.
        let none = Parameter::default();
        let own: Vec<&Parameter> = order.iter().map(|i| &parameters[*i]).chain([&none]).collect();
        let merged = system.merged();
        let group = |own: &[&Parameter]| {
            let tiles: Vec<Tile> = own.chunks(LANES).map(|own| Tile::new(own, &unit, &kernel, &merged)).collect();
            Group { whitened: DMatrix::zeros(LANES * tiles.len(), ROWS * channels), tiles }
        };
        let mut groups: Vec<Group> = own.chunks(WIDE).map(group).collect();
        let asked = groups.len();
        groups.push(group(&vec![&none; moving]));
        let pairs = (0..asked).flat_map(|i| (i..asked).map(move |j| (i, j)));
        let size = |i: usize| groups[i].whitened.nrows();
        let product = |(i, j): (usize, usize)| Product { groups: (i, j), sum: DMatrix::zeros(size(i), size(j)) };
        let products = pairs.chain((0..=asked).map(|i| (i, asked))).map(product).collect();
        let most = (LONGEST_WAIT_S * 1e9 / step_ns as f64) as usize;
        let start = predictor.known_of_the_start(system) * FREE;
        let innovation = |(i, p): (usize, &Parameter)| Some((i, p.change.as_ref()?.innovation.clone()));
        let mut pass = Self {
            known: known.into_iter().map(|(c, s, factor)| (c, s, factor / unit[c])).collect(),
            unit,
            groups,
            changes: parameters.iter().enumerate().filter_map(innovation).collect(),
            lanes,
            uncertain: start.clone(),
            start,
            fresh: false,
            known_starts: starts,
            starts: Vec::new(),
            threads: threads.max(1),
            series,
            averaged,
            step_ns,
            settling: predictor.settling(system, SETTLED, most),
            state: vec![0.0; kernel.states],
            next: vec![0.0; kernel.states],
            z: vec![0.0; channels],
            unsettled: 0,
            last_ns: None,
            first_ns: None,
            before: vec![f64::NAN; series],
            waiting: Waiting { inputs: Vec::new(), innovations: Vec::new(), counts: Vec::new() },
            products,
            block: block.map(|samples| samples.max(1)),
            number: 0,
            blocks: Vec::new(),
            squares: DMatrix::zeros(channels, channels),
            samples: 0,
            settled: 0,
            kernel,
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
            self.enter_block(time_ns - first);
            let from = self.waiting.inputs.len();
            let mean = |(now, before): (&f64, &f64)| if self.averaged { 0.5 * (now + before) } else { *now };
            self.waiting.inputs.extend(series.iter().zip(&self.before).map(mean));
            let days = (time_ns - first) as f64 / DAY_NS;
            self.waiting.inputs.extend((0..POWERS).map(|k| days.powi(k as i32)));
            for ((to, z), unit) in self.z.iter_mut().zip(channels).zip(&self.unit) {
                *to = z / unit;
            }
            for (c, s, factor) in &self.known {
                self.z[*c] -= factor * self.waiting.inputs[from + s];
            }
            self.kernel.step(&mut self.state, &mut self.next, &mut self.z);
            self.waiting.innovations.extend(&self.z);
            self.fresh = false;
            self.waiting.counts.push(self.unsettled == 0);
            self.unsettled = self.unsettled.saturating_sub(1);
        }
        self.last_ns = Some(time_ns);
        self.before.copy_from_slice(series);
        if self.waiting.counts.len() == ROWS {
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

    /// Closes the block before, if `since_ns` from the first row is in another.
    fn enter_block(&mut self, since_ns: i64) {
        let Some(length) = self.block else { return };
        let sample = (since_ns + self.step_ns / 2).div_euclid(self.step_ns);
        let number = sample.div_euclid(length.cast_signed());
        if number != self.number {
            self.close_block();
            self.number = number;
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
        let lanes = self.groups.last_mut().into_iter().flat_map(|g| &mut g.tiles);
        for (t, tile) in lanes.enumerate() {
            tile.state.fill([0.0; LANES]);
            for i in t * LANES..moving.min((t + 1) * LANES) {
                tile.state[i][i - t * LANES] = -1.0;
            }
        }
        let state = DVector::from_column_slice(&self.state[..moving]);
        self.starts.push(Start { state, slope: DMatrix::zeros(moving, self.lanes.len() - 1) });
        self.uncertain.copy_from(&self.start);
        self.unsettled = self.settling;
        self.fresh = true;
    }

    /// Fits the state at the start out of all sums since then: with D its information, M its covariance before the data
    /// and B its products with the rest, they lose `B G Bᵀ` with `G = M (1 + D M)⁻¹`, which is its covariance
    /// afterwards. All lanes go on as they would from the start as it is found. That of the data has the difference
    /// from the innovations from the start as it is known, which stay what drives the lanes of the noise: what these
    /// are is then the same whenever a start is fitted.
    fn take_start_out(&mut self) {
        let moving = 2 * self.kernel.channels;
        let asked = self.groups.len() - 1;
        let with_start = self.products.len() - self.groups.len();
        let (own, with) = self.products.split_at_mut(with_start);
        let Some(information) = with.last().map(|p| p.sum.view((0, 0), (moving, moving)).into_owned()) else { return };
        let gain = known_with(&self.uncertain, &information);
        // Lanes of a group × states.
        let products: Vec<DMatrix<f64>> = with[..asked].iter().map(|p| p.sum.columns(0, moving).into_owned()).collect();
        let fitted: Vec<DMatrix<f64>> = products.iter().map(|b| b * &gain).collect();
        for Product { groups: (i, j), sum } in own {
            *sum -= &fitted[*i] * products[*j].transpose();
        }
        with.iter_mut().for_each(|p| p.sum.fill(0.0));
        let of = |lane: usize| fitted[lane / WIDE].row(lane % WIDE);
        let Some((data, parameters)) = self.lanes.split_last() else { return };
        if let Some(start) = self.starts.last_mut() {
            start.state += of(*data).transpose();
            for (i, lane) in parameters.iter().enumerate() {
                let mut slope = start.slope.column_mut(i);
                slope -= of(*lane).transpose();
            }
        }
        self.uncertain = gain;
        let Some((starts, rest)) = self.groups.split_last_mut() else { return };
        for i in 0..moving {
            let (tile, at) = (&starts.tiles[i / LANES].state, i % LANES);
            for (g, group) in rest.iter_mut().enumerate() {
                for (t, own) in group.tiles.iter_mut().enumerate() {
                    let by: [f64; LANES] = std::array::from_fn(|l| fitted[g][(t * LANES + l, i)]);
                    own.state.iter_mut().zip(tile).for_each(|(x, influence)| add(x, -influence[at], &by));
                }
            }
        }
    }

    /// Filters the waiting rows by every parameter and adds the products.
    fn sum(&mut self) {
        let rows = self.waiting.counts.len();
        if rows == 0 {
            return;
        }
        let n = self.kernel.channels;
        let batch = Batch {
            rows,
            width: self.series + POWERS,
            inputs: &self.waiting.inputs,
            innovations: &self.waiting.innovations,
        };
        let (kernel, threads) = (&self.kernel, self.threads);
        in_parallel(&mut self.groups, threads, |group| group.filter(kernel, &batch));
        // The lane of the data has what the starts as they are found add to the innovations.
        let lane = self.lanes.last().copied().unwrap_or(0);
        let mut white = DVector::zeros(n);
        for row in 0..rows {
            kernel.whiten(&self.waiting.innovations[row * n..(row + 1) * n], white.as_mut_slice());
            let own = &mut self.groups[lane / WIDE].whitened;
            white.iter().enumerate().for_each(|(c, e)| own[(lane % WIDE, row * n + c)] += *e);
            if self.waiting.counts[row] {
                self.squares.ger(1.0, &white, &white, 1.0);
                self.settled += 1;
            }
        }
        self.samples += rows as u64;
        let whitened: Vec<&[f64]> = self.groups.iter().map(|g| g.whitened.as_slice()).collect();
        in_parallel(&mut self.products, threads, |Product { groups: (i, j), sum }| {
            let (a, b) = (sum.nrows(), sum.ncols());
            let a = DMatrixView::from_slice(whitened[*i], a, rows * n);
            // Transposed by its strides.
            let b = DMatrixView::<f64, Dyn, Dyn>::from_slice_with_strides(whitened[*j], rows * n, b, b, 1);
            sum.gemm(1.0, &a, &b, 1.0);
        });
        self.waiting.inputs.clear();
        self.waiting.innovations.clear();
        self.waiting.counts.clear();
    }

    /// Sums what waits and keeps it as a block, with what the levels of the noise add.
    fn close_block(&mut self) {
        self.sum();
        self.take_start_out();
        if self.samples == 0 {
            return;
        }
        let Some((data, parameters)) = self.lanes.split_last() else { return };
        let groups = self.groups.len() - 1;
        let product = |a: usize, b: usize| {
            let (a, b) = (a.min(b), a.max(b));
            let (i, j) = (a / WIDE, b / WIDE);
            // Rows of a triangle before the i-th.
            self.products[i * groups - i * i.saturating_sub(1) / 2 + j - i].sum[(a % WIDE, b % WIDE)]
        };
        let mut information: Vec<f64> = Vec::with_capacity(parameters.len() * (parameters.len() + 1) / 2);
        for (j, b) in parameters.iter().enumerate() {
            information.extend(parameters[..=j].iter().map(|a| product(*a, *b)));
        }
        let mut score: Vec<f64> = parameters.iter().map(|a| product(*a, *data)).collect();
        let settled = self.settled as f64;
        for (k, (i, own)) in self.changes.iter().enumerate() {
            score[*i] += 0.5 * (own.component_mul(&self.squares).sum() - settled * own.trace());
            for (j, other) in &self.changes[..=k] {
                information[i * (i + 1) / 2 + j] += 0.5 * settled * own.component_mul(other).sum();
            }
        }
        let length = self.block.map_or(0, u64::cast_signed);
        self.blocks.push(Block {
            first_ns: self.first_ns.unwrap_or(0) + self.number * length * self.step_ns,
            information,
            score,
            chi2: product(*data, *data),
            numbers: (self.samples as usize * self.kernel.channels) as f64,
            squares: self.squares.clone(),
            samples: self.samples,
            settled: self.settled,
        });
        self.products.iter_mut().for_each(|p| p.sum.fill(0.0));
        self.squares.fill(0.0);
        self.samples = 0;
        self.settled = 0;
    }

    /// The sums by blocks.
    pub fn finish(mut self) -> Passed {
        self.close_block();
        if self.fresh {
            // No row has followed.
            self.starts.pop();
        }
        let (parameters, channels) = (self.lanes.len() - 1, self.kernel.channels);
        Passed { blocks: self.blocks, starts: self.starts, parameters, channels }
    }
}

/// Covariance of a state with covariance M before some data that have the information D on it: with `M = L Lᵀ` it is
/// `L (1 + Lᵀ D L)⁻¹ Lᵀ`. The matrix that is inverted is symmetric and has no eigenvalue below one.
fn known_with(before: &DMatrix<f64>, information: &DMatrix<f64>) -> DMatrix<f64> {
    let eigen = before.clone().symmetric_eigen();
    let root = &eigen.eigenvectors * DMatrix::from_diagonal(&eigen.eigenvalues.map(|x| x.max(0.0).sqrt()));
    let mut inner = root.transpose() * information * &root;
    inner = (&inner + inner.transpose()) * 0.5 + DMatrix::identity(root.ncols(), root.ncols());
    match inner.cholesky() {
        Some(factor) => {
            let half = factor.l().solve_lower_triangular(&root.transpose()).unwrap_or_else(|| root.transpose());
            half.transpose() * half
        }
        None => before.clone(),
    }
}

/// Calls `work` with every item, on some threads.
fn in_parallel<T: Send>(items: &mut [T], threads: usize, work: impl Fn(&mut T) + Sync) {
    if threads.min(items.len()) < 2 {
        return items.iter_mut().for_each(work);
    }
    let queue = Mutex::new(items.iter_mut());
    let next = || queue.lock().unwrap_or_else(PoisonError::into_inner).next();
    let all = || {
        while let Some(item) = next() {
            work(item);
        }
    };
    std::thread::scope(|scope| {
        (1..threads).for_each(|_| drop(scope.spawn(all)));
        all();
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
    fn new(system: &NoiseStates, predictor: &Predictor) -> Self {
        let n = system.channels();
        let merged = system.merged();
        let states = merged.iter().max().map_or(0, |last| last + 1).next_multiple_of(2);
        let mut rows = vec![Vec::new(); states];
        let mut output = vec![Vec::new(); n];
        let mut seen = vec![false; states];
        for (j, to) in merged.iter().enumerate() {
            // One of those that are merged stands for all.
            if std::mem::replace(&mut seen[*to], true) {
                continue;
            }
            for (i, factor) in system.transition.column(j).iter().enumerate().filter(|(_, x)| **x != 0.0) {
                rows[merged[i]].push((*to, *factor));
            }
            for (c, factor) in system.output.column(j).iter().enumerate().filter(|(_, x)| **x != 0.0) {
                output[c].push((*to, *factor));
            }
        }
        let both = |rows: &[Vec<(usize, f64)>]| {
            let at = |half: usize, k: usize| rows[half].get(k).copied().unwrap_or_default();
            (0..rows[0].len().max(rows[1].len())).map(|k| [at(0, k), at(1, k)]).collect()
        };
        let transition = rows.chunks_exact(2).map(both).collect();
        let mut gain = vec![[0.0; 2]; states / 2 * n];
        for (i, to) in merged.iter().enumerate() {
            for c in 0..n {
                gain[to / 2 * n + c][to % 2] += predictor.gain[(i, c)];
            }
        }
        let w = |c: usize, d: usize| if c < n { predictor.whitening[(c, d)] } else { 0.0 };
        let two = |c: usize| (0..n.min(c + 2)).map(|d| [w(c, d), w(c + 1, d)]).collect();
        Self { channels: n, states, transition, output, gain, whitening: (0..n).step_by(2).map(two).collect() }
    }

    /// From what is seen to innovations, for the data.
    fn step(&self, state: &mut Vec<f64>, next: &mut Vec<f64>, z: &mut [f64]) {
        for (z, output) in z.iter_mut().zip(&self.output) {
            output.iter().for_each(|(s, factor)| *z -= factor * state[*s]);
        }
        let pairs = self.transition.iter().zip(self.gain.chunks_exact(self.channels));
        for (next, (before, k)) in next.chunks_exact_mut(2).zip(pairs) {
            let mut two = [0.0; 2];
            for [(i, p), (j, q)] in before {
                two[0] += p * state[*i];
                two[1] += q * state[*j];
            }
            for ([p, q], e) in k.iter().zip(&*z) {
                two[0] += p * e;
                two[1] += q * e;
            }
            next.copy_from_slice(&two);
        }
        std::mem::swap(state, next);
    }

    fn whiten(&self, e: &[f64], to: &mut [f64]) {
        for (pair, w) in self.whitening.iter().enumerate() {
            for (half, to) in to[2 * pair..].iter_mut().take(2).enumerate() {
                *to = w.iter().zip(e).map(|(w, e)| w[half] * e).sum();
            }
        }
    }
}

impl Group {
    fn filter(&mut self, kernel: &Kernel, batch: &Batch<'_>) {
        for (t, tile) in self.tiles.iter_mut().enumerate() {
            tile.filter(kernel, batch, &mut self.whitened, t * LANES);
        }
    }
}

impl Filter {
    fn new(lane: usize, of: &Beside) -> Self {
        let sparse = |m: &DMatrix<f64>| {
            let all = (0..m.nrows()).flat_map(|i| (0..m.ncols()).map(move |j| (i, j)));
            all.filter(|at| m[*at] != 0.0).map(|(i, j)| (i, j, m[(i, j)])).collect()
        };
        let states = of.gain.nrows();
        Self {
            lane,
            transition: sparse(&of.transition),
            output: sparse(&of.output),
            gain: of.gain.transpose().as_slice().to_vec(),
            state: vec![0.0; states],
            next: vec![0.0; states],
        }
    }

    /// Takes off what is seen of it, and goes on by the innovations `e`.
    fn step(&mut self, nu: &mut [[f64; LANES]], e: &[f64]) {
        for (c, s, factor) in &self.output {
            nu[*c][self.lane] -= factor * self.state[*s];
        }
        for (next, k) in self.next.iter_mut().zip(self.gain.chunks_exact(e.len())) {
            *next = -k.iter().zip(e).map(|(k, e)| k * e).sum::<f64>();
        }
        for (i, j, factor) in &self.transition {
            self.next[*i] += factor * self.state[*j];
        }
        std::mem::swap(&mut self.state, &mut self.next);
    }
}

impl Tile {
    fn new(parameters: &[&Parameter], unit: &[f64], kernel: &Kernel, merged: &[usize]) -> Self {
        let n = unit.len();
        let mut responses: Vec<(usize, usize, usize, f64)> = Vec::new();
        for (lane, parameter) in parameters.iter().enumerate() {
            responses.extend(parameter.responses.iter().map(|(c, s, factor)| (*c, lane, *s, factor / unit[*c])));
        }
        let (mut changes, mut filters) = (Vec::new(), Vec::new());
        for (lane, change) in parameters.iter().enumerate().filter_map(|(lane, p)| Some((lane, p.change.as_ref()?))) {
            changes.resize(kernel.states * n, [0.0; LANES]);
            filters.extend(change.beside.as_ref().map(|beside| Filter::new(lane, beside)));
            for (i, row) in change.gain.row_iter().enumerate() {
                row.iter().enumerate().for_each(|(c, k)| changes[merged[i] * n + c][lane] += *k);
            }
        }
        let zero = [0.0; LANES];
        let each = parameters.iter().enumerate();
        let not_weighed = each.flat_map(|(lane, p)| p.not_weighed.iter().map(move |c| (*c, lane))).collect();
        Self {
            responses,
            changes,
            filters,
            state: vec![zero; kernel.states],
            next: vec![zero; kernel.states],
            nu: vec![zero; n],
            not_weighed,
        }
    }

    fn filter(&mut self, kernel: &Kernel, batch: &Batch<'_>, whitened: &mut DMatrix<f64>, lane: usize) {
        let n = kernel.channels;
        let wide = whitened.nrows();
        let columns = whitened.as_mut_slice();
        for row in 0..batch.rows {
            self.nu.fill([0.0; LANES]);
            let input = &batch.inputs[row * batch.width..(row + 1) * batch.width];
            for (c, lane, s, factor) in &self.responses {
                self.nu[*c][*lane] += factor * input[*s];
            }
            for (nu, output) in self.nu.iter_mut().zip(&kernel.output) {
                let mut sum = *nu;
                output.iter().for_each(|(s, factor)| add(&mut sum, -factor, &self.state[*s]));
                *nu = sum;
            }
            let e = &batch.innovations[row * n..(row + 1) * n];
            self.filters.iter_mut().for_each(|filter| filter.step(&mut self.nu, e));
            let to = &mut columns[row * n * wide..(row + 1) * n * wide];
            for (w, to) in kernel.whitening.iter().zip(to.chunks_mut(2 * wide)) {
                let two = multiply([[0.0; LANES]; 2], w, &self.nu);
                for (white, to) in two.iter().zip(to.chunks_exact_mut(wide)) {
                    to[lane..lane + LANES].copy_from_slice(white);
                }
            }
            self.not_weighed.iter().for_each(|(c, own)| to[c * wide + lane + own] = 0.0);
            let pairs = kernel.transition.iter().zip(kernel.gain.chunks_exact(n));
            for (pair, (next, (before, k))) in self.next.chunks_exact_mut(2).zip(pairs).enumerate() {
                let (mut first, mut second) = ([0.0; LANES], [0.0; LANES]);
                for [(i, p), (j, q)] in before {
                    add(&mut first, *p, &self.state[*i]);
                    add(&mut second, *q, &self.state[*j]);
                }
                let mut two = multiply([first, second], k, &self.nu);
                if let Some(changes) = self.changes.get(2 * pair * n..(2 * pair + 2) * n) {
                    two = two_changes(two, changes, e);
                }
                next.copy_from_slice(&two);
            }
            std::mem::swap(&mut self.state, &mut self.next);
        }
    }
}

/// Takes two rows of `∂K` times what drives them off: each lane has a matrix of its own.
#[inline(always)]
fn two_changes(from: [[f64; LANES]; 2], changes: &[[f64; LANES]], e: &[f64]) -> [[f64; LANES]; 2] {
    let [mut first, mut second] = from;
    let (p, q) = changes.split_at(e.len());
    for ((e, p), q) in e.iter().zip(p).zip(q) {
        add(&mut first, -e, p);
        add(&mut second, -e, q);
    }
    [first, second]
}

/// Adds a matrix of two rows times lanes: two at once read each lane once.
#[inline(always)]
fn multiply(to: [[f64; LANES]; 2], two: &[[f64; 2]], by: &[[f64; LANES]]) -> [[f64; LANES]; 2] {
    let [mut first, mut second] = to;
    for ([p, q], x) in two.iter().zip(by) {
        add(&mut first, *p, x);
        add(&mut second, *q, x);
    }
    [first, second]
}

#[inline(always)]
fn add(to: &mut [f64; LANES], factor: f64, what: &[f64; LANES]) {
    to.iter_mut().zip(what).for_each(|(to, x)| *to += factor * x);
}
