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
//! What is slower goes on through a gap as nothing is seen of it: it decays, and is less certain by what the samples of
//! the gap would have told. This part of its state is unknown too, with the variance that it has by chance: a slow
//! force has moved on, and the step that it shows after the gap is no effect that happens to change there.
//!
//! The state is fitted at the end of a stretch without a gap, and at the end of each block of time: everything goes on
//! from the state as it is then found, with what is still unknown of it. A block's rows are so given the blocks before
//! it, as a likelihood is a product of conditional ones, and the sums of all blocks are those of the whole. Between
//! test masses, where forces are weak, readouts are averaged over many minutes: what a start was is told for many
//! hours.

use std::ops::Range;
use std::sync::{Mutex, PoisonError};

use nalgebra::{DMatrix, DVector};

use super::ends::Ends;
use super::lanes::{Batch, Kernel, LANES, Products, Tile};
pub use super::lanes::{Parameter, Response};
use super::predictor::Predictor;
use super::state_space::NoiseStates;
use crate::transient::{Template, Transients};

/// Rows whose products are taken at once: as many as caches hold of all tiles.
const ROWS: usize = 32;
/// Rows that wait until threads filter them. Threads that started for each [`ROWS`] made a day's diagnosis a third
/// longer by the clock.
const WAITING_ROWS: usize = 16 * ROWS;
/// What is left of a start when squares of innovations are summed for levels of the noise, and the longest wait, s.
const SETTLED: f64 = 1e-2;
const LONGEST_WAIT_S: f64 = 600.0;
/// Variance of a start over what it is by chance.
pub(crate) const FREE: f64 = 1e6;
/// Powers of time that each channel may follow beside everything else: a constant, a slope, a curvature.
pub const POWERS: usize = 3;
/// Nanoseconds in a day.
pub const DAY_NS: f64 = 86_400e9;

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
    /// Logarithm of the determinant of the covariance of the innovations, over all samples.
    pub ln_det: f64,
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
    /// Mean time of its samples, Unix ns.
    pub mean_ns: i64,
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
    /// Logarithm of the determinant of the covariance of the innovations of a sample.
    ln_det: f64,
    parameters: usize,
    channels: usize,
}

impl Passed {
    /// The sums of all blocks.
    pub fn total(&self) -> Sums {
        let mut sums = Sums::zeros(self.parameters, self.channels);
        self.blocks.iter().for_each(|block| sums.add(block));
        sums.ln_det = self.ln_det * sums.samples as f64;
        sums.starts.clone_from(&self.starts);
        sums
    }

    /// The sums of all blocks with the time of each as weight.
    pub fn moments(&self) -> Moments {
        let from_ns = self.blocks.first().map_or(0, |block| block.mean_ns);
        let until_ns = self.blocks.last().map_or(0, |block| block.mean_ns);
        let p = self.parameters;
        let mut moments = Moments {
            from_ns,
            until_ns,
            once: DMatrix::zeros(p, p),
            twice: DMatrix::zeros(p, p),
            score: DVector::zeros(p),
        };
        for block in &self.blocks {
            let days = (block.mean_ns - from_ns) as f64 / DAY_NS;
            let mut sums = Sums::zeros(p, self.channels);
            sums.add(block);
            moments.once += &sums.information * days;
            moments.twice += &sums.information * (days * days);
            moments.score += DVector::from_vec(sums.score) * days;
        }
        moments
    }
}

/// Sums with time as weight: the information and the score of parameters that change at a constant rate. What a
/// parameter θ adds in a block, a rate of it per day adds times the days since some instant.
#[derive(Clone, Debug)]
pub struct Moments {
    /// From when time counts: mean time of the first block, Unix ns.
    pub from_ns: i64,
    /// Mean time of the last block, Unix ns.
    pub until_ns: i64,
    /// Information times days: of a parameter and the rate of another.
    pub once: DMatrix<f64>,
    /// Information times days squared: of two rates.
    pub twice: DMatrix<f64>,
    /// Score times days.
    pub score: DVector<f64>,
}

impl Moments {
    /// The same with time from another instant, of the sums that they belong to.
    pub fn about(&self, sums: &Sums, from_ns: i64) -> Self {
        let days = (from_ns - self.from_ns) as f64 / DAY_NS;
        Self {
            from_ns,
            until_ns: self.until_ns,
            once: &self.once - &sums.information * days,
            twice: &self.twice - &self.once * (2.0 * days) + &sums.information * (days * days),
            score: &self.score - DVector::from_column_slice(&sums.score) * days,
        }
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
            ln_det: 0.0,
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
    /// Logarithm of the determinant of the covariance of the innovations of a sample.
    ln_det: f64,
    unit: Vec<f64>,
    /// What is known of the channels: taken off before anything else.
    known: Vec<Response>,
    /// Parameters and the data, and at last what is unknown at the start of a stretch.
    tiles: Vec<Tile>,
    /// Tiles of parameters and the data.
    asked: usize,
    /// Those and the tiles of what is unknown in the stretch that goes on.
    active: usize,
    /// `W ∂S Wᵀ` of the parameters that change the noise.
    changes: Vec<(usize, DMatrix<f64>)>,
    /// Lane of each parameter, and at last that of the data.
    lanes: Vec<usize>,
    /// Covariance of the moving averages at a start.
    start: DMatrix<f64>,
    /// What a gap does to the slower states.
    slower: Slower,
    /// Covariance of what stretches before have left unknown of them.
    carried: DMatrix<f64>,
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
    /// The last row that was filtered.
    last_whole_ns: Option<i64>,
    first_ns: Option<i64>,
    /// Series of the last row, without the powers of time.
    before: Vec<f64>,
    waiting: Waiting,
    /// By tile.
    products: Vec<Products>,
    /// Samples of a block, and the number of the block that is summed.
    block: Option<u64>,
    number: i64,
    blocks: Vec<Block>,
    squares: DMatrix<f64>,
    samples: u64,
    /// Sum of their times since the first row of all, ns.
    times_ns: i128,
    /// Samples of which squares are summed.
    settled: u64,
    /// Whether all innovations are taken as zero.
    without_data: bool,
    /// Innovations near the ends of the data, where transients are searched for.
    ends: Option<Ends>,
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
        let tile = |own: &[&Parameter]| Tile::new(own, &unit, &kernel, &merged, WAITING_ROWS);
        let mut tiles: Vec<Tile> = own.chunks(LANES).map(tile).collect();
        let asked = tiles.len();
        let slower = Slower::new(&kernel, moving, &predictor.innovation);
        tiles.extend(vec![&none; moving + slower.states()].chunks(LANES).map(tile));
        let products = (0..tiles.len()).map(|i| Products::new(i, tiles.len())).collect();
        let most = (LONGEST_WAIT_S * 1e9 / step_ns as f64) as usize;
        let start = predictor.known_of_the_start(system) * FREE;
        let innovation = |(i, p): (usize, &Parameter)| Some((i, p.change.as_ref()?.innovation.clone()));
        let mut pass = Self {
            known: known.into_iter().map(|(c, s, factor)| (c, s, factor / unit[c])).collect(),
            unit,
            tiles,
            asked,
            active: asked,
            carried: DMatrix::zeros(slower.states(), slower.states()),
            slower,
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
            last_whole_ns: None,
            first_ns: None,
            before: vec![f64::NAN; series],
            waiting: Waiting { inputs: Vec::new(), innovations: Vec::new(), counts: Vec::new() },
            products,
            block: block.map(|samples| samples.max(1)),
            number: 0,
            blocks: Vec::new(),
            squares: DMatrix::zeros(channels, channels),
            samples: 0,
            times_ns: 0,
            settled: 0,
            without_data: false,
            ends: None,
            ln_det: predictor.ln_det(),
            kernel,
        };
        pass.restart();
        pass
    }

    /// The same with all innovations zero: the information of the series alone, as before there are data.
    pub fn without_data(mut self) -> Self {
        self.without_data = true;
        self
    }

    /// The same with a search for transients near the ends of the data and of gaps.
    pub fn with_search(mut self, templates: Vec<Template>) -> Self {
        self.ends = Some(Ends::new(&self.kernel, &self.unit, self.step_ns, templates));
        self
    }

    /// The transients that were searched for, and the times between which each window of the search lies, Unix ns.
    pub fn transients(&mut self) -> (Transients, Vec<Range<i64>>) {
        let threads = self.threads;
        self.ends.as_mut().map_or_else(Default::default, |ends| {
            ends.gap();
            ends.search(threads)
        })
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
            if let (true, Some(last)) = (self.fresh, self.last_whole_ns) {
                let steps = (time_ns - last + self.step_ns / 2).div_euclid(self.step_ns);
                self.after_gap(u64::try_from(steps - 1).unwrap_or(0));
            }
            self.last_whole_ns = Some(time_ns);
            self.enter_block(time_ns - first);
            let from = self.waiting.inputs.len();
            let mean = |(now, before): (&f64, &f64)| if self.averaged { 0.5 * (now + before) } else { *now };
            self.waiting.inputs.extend(series.iter().zip(&self.before).map(mean));
            self.times_ns += i128::from(time_ns - first);
            let days = (time_ns - first) as f64 / DAY_NS;
            self.waiting.inputs.extend((0..POWERS).map(|k| days.powi(k as i32)));
            for ((to, z), unit) in self.z.iter_mut().zip(channels).zip(&self.unit) {
                *to = z / unit;
            }
            for (c, s, factor) in &self.known {
                self.z[*c] -= factor * self.waiting.inputs[from + s];
            }
            if self.without_data {
                self.z.fill(0.0);
            }
            self.kernel.step(&mut self.state, &mut self.next, &mut self.z);
            self.waiting.innovations.extend(&self.z);
            if let Some(ends) = &mut self.ends {
                let mut white = vec![0.0; self.z.len()];
                self.kernel.whiten(&self.z, &mut white);
                ends.push(time_ns, &white);
            }
            self.fresh = false;
            self.waiting.counts.push(self.unsettled == 0);
            self.unsettled = self.unsettled.saturating_sub(1);
        }
        self.last_ns = Some(time_ns);
        self.before.copy_from_slice(series);
        if self.waiting.counts.len() == WAITING_ROWS {
            self.sum();
        }
    }

    /// A gap: what moving averages contribute is unknown again. What is slower goes on, see [`Self::after_gap`].
    fn interrupt(&mut self) {
        if !self.fresh {
            self.sum();
            self.take_start_out();
            self.carried = self.unknown_of_slower();
            self.restart();
            self.ends.iter_mut().for_each(Ends::gap);
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
        let (asked, starts) = self.tiles.split_at_mut(self.asked);
        asked.iter_mut().for_each(|tile| tile.state[..moving * LANES].fill(0.0));
        starts.iter_mut().for_each(|tile| tile.state.fill(0.0));
        for i in 0..moving {
            starts[i / LANES].state[i * LANES + i % LANES] = -1.0;
        }
        let state = DVector::from_column_slice(&self.state[..moving]);
        self.starts.push(Start { state, slope: DMatrix::zeros(moving, self.lanes.len() - 1) });
        self.uncertain = self.start.clone();
        self.active = self.asked + moving.div_ceil(LANES);
        self.unsettled = self.settling;
        self.fresh = true;
    }

    /// The first row after so many missing samples: all lanes go on without innovations for so long, and what the
    /// slower states have done meanwhile is unknown with the moving averages.
    fn after_gap(&mut self, missing: u64) {
        let (moving, slow) = (2 * self.kernel.channels, self.slower.states());
        self.tiles[..self.asked].iter_mut().for_each(|tile| tile.filters_over(missing));
        if slow == 0 {
            return;
        }
        let Over { transition, learned } = self.slower.over(missing);
        let learned = learned + &transition * &self.carried * transition.transpose();
        let own = DVector::from_column_slice(&self.state[moving..]);
        self.state[moving..].copy_from_slice((&transition * own).as_slice());
        let (asked, starts) = self.tiles.split_at_mut(self.asked);
        for tile in asked {
            let lanes = &mut tile.state[moving * LANES..];
            let before = DMatrix::from_row_slice(slow, LANES, lanes);
            lanes.copy_from_slice((&transition * before).transpose().as_slice());
        }
        for i in moving..moving + slow {
            starts[i / LANES].state[i * LANES + i % LANES] = -1.0;
        }
        let known = self.uncertain.clone();
        self.uncertain = DMatrix::zeros(moving + slow, moving + slow);
        self.uncertain.view_mut((0, 0), (moving, moving)).copy_from(&known);
        self.uncertain.view_mut((moving, moving), (slow, slow)).copy_from(&learned);
        self.active = self.tiles.len();
    }

    /// Covariance of the slower states by what is still unknown of the stretch: what it makes of them by now.
    fn unknown_of_slower(&self) -> DMatrix<f64> {
        let (moving, unknown) = (2 * self.kernel.channels, self.uncertain.nrows());
        let starts = &self.tiles[self.asked..];
        let influence = DMatrix::from_fn(self.slower.states(), unknown, |i, j| {
            starts[j / LANES].state[(moving + i) * LANES + j % LANES]
        });
        &influence * &self.uncertain * influence.transpose()
    }

    /// Fits the state at the start out of all sums since then: with D its information, M its covariance before the data
    /// and B its products with the rest, they lose `B G Bᵀ` with `G = M (1 + D M)⁻¹`, which is its covariance
    /// afterwards. All lanes go on as they would from the start as it is found. That of the data has the difference
    /// from the innovations from the start as it is known, which stay what drives the lanes of the noise: what these
    /// are is then the same whenever a start is fitted.
    fn take_start_out(&mut self) {
        let (moving, unknown) = (2 * self.kernel.channels, self.uncertain.nrows());
        let own = self.asked * LANES;
        let product = |a: usize, start: usize| {
            let (a, b) = (a, own + start);
            self.products[a / LANES].at(a % LANES, b / LANES, b % LANES)
        };
        let information = DMatrix::from_fn(unknown, unknown, |i, j| product(own + i.min(j), i.max(j)));
        let gain = known_with(&self.uncertain, &information);
        // Lanes × states.
        let with_start = DMatrix::from_fn(own, unknown, product);
        let fitted = &with_start * &gain;
        let lost = &fitted * with_start.transpose();
        for (i, products) in self.products.iter_mut().enumerate() {
            for j in i..self.asked {
                for (k, sum) in products.with(j).iter_mut().enumerate() {
                    *sum -= lost[(i * LANES + k / LANES, j * LANES + k % LANES)];
                }
            }
            (self.asked.max(i)..self.tiles.len()).for_each(|j| products.with(j).fill(0.0));
        }
        let Some((data, parameters)) = self.lanes.split_last() else { return };
        if let Some(start) = self.starts.last_mut() {
            start.state += fitted.row(*data).columns(0, moving).transpose();
            for (i, lane) in parameters.iter().enumerate() {
                let mut slope = start.slope.column_mut(i);
                slope -= fitted.row(*lane).columns(0, moving).transpose();
            }
        }
        self.uncertain = gain;
        let (asked, starts) = self.tiles.split_at_mut(self.asked);
        for (t, tile) in asked.iter_mut().enumerate() {
            for i in 0..unknown {
                let influence = starts[i / LANES].state.chunks_exact(LANES).map(|lanes| lanes[i % LANES]);
                for (state, influence) in tile.state.chunks_exact_mut(LANES).zip(influence) {
                    let by = (0..LANES).map(|l| fitted[(t * LANES + l, i)]);
                    state.iter_mut().zip(by).for_each(|(x, by)| *x -= influence * by);
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
        let (n, width) = (self.kernel.channels, self.series + POWERS);
        let Waiting { inputs, innovations, .. } = &self.waiting;
        let inputs = inputs.chunks(ROWS * width);
        let batches: Vec<Batch<'_>> = inputs
            .zip(innovations.chunks(ROWS * n))
            .enumerate()
            .map(|(k, (inputs, innovations))| Batch { first: k * ROWS, width, inputs, innovations })
            .collect();
        let (kernel, threads) = (&self.kernel, self.threads);
        in_parallel(self.tiles[..self.active].iter_mut().collect(), threads, |tile| {
            batches.iter().for_each(|batch| tile.filter(kernel, batch));
        });
        // The lane of the data has what the starts as they are found add to the innovations.
        let lane = self.lanes.last().copied().unwrap_or(0);
        let mut white = DVector::zeros(n);
        for (row, e) in self.waiting.innovations.chunks_exact(n).enumerate() {
            kernel.whiten(e, white.as_mut_slice());
            let own = self.tiles[lane / LANES].whitened.chunks_exact_mut(LANES).skip(row * n);
            own.zip(white.iter()).for_each(|(own, e)| own[lane % LANES] += e);
            if self.waiting.counts[row] {
                self.squares.ger(1.0, &white, &white, 1.0);
                self.settled += 1;
            }
        }
        self.samples += rows as u64;
        let whitened: Vec<&[f64]> = self.tiles[..self.active].iter().map(|tile| tile.whitened.as_slice()).collect();
        // The first tile has the most products, so each thread has tiles from the front and from the back; it takes all
        // products of a batch while caches hold it.
        let mut shares: Vec<Vec<&mut Products>> = (0..threads).map(|_| Vec::new()).collect();
        for (i, products) in self.products.iter_mut().enumerate() {
            let turn = i % (2 * threads);
            shares[turn.min(2 * threads - 1 - turn)].push(products);
        }
        in_parallel(shares, threads, |mut share| {
            for first in (0..rows).step_by(ROWS) {
                let own = first * n..rows.min(first + ROWS) * n;
                share.iter_mut().for_each(|products| products.add(&whitened, own.clone()));
            }
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
        let product = |a: usize, b: usize| {
            let (a, b) = (a.min(b), a.max(b));
            self.products[a / LANES].at(a % LANES, b / LANES, b % LANES)
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
            mean_ns: self.first_ns.unwrap_or(0) + (self.times_ns / i128::from(self.samples)) as i64,
            information,
            score,
            chi2: product(*data, *data),
            numbers: (self.samples as usize * self.kernel.channels) as f64,
            squares: self.squares.clone(),
            samples: self.samples,
            settled: self.settled,
        });
        self.products.iter_mut().for_each(Products::clear);
        self.squares.fill(0.0);
        self.samples = 0;
        self.times_ns = 0;
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
        Passed { blocks: self.blocks, starts: self.starts, ln_det: self.ln_det, parameters, channels }
    }
}

/// States that are slower than the moving averages, over a gap.
struct Slower {
    /// Over one sample.
    sample: Over,
}

/// Some samples of which nothing is seen.
#[derive(Clone)]
struct Over {
    /// What they make of a state.
    transition: DMatrix<f64>,
    /// Covariance of what they would have told of it.
    learned: DMatrix<f64>,
}

impl Slower {
    /// The states from `first` on. With every sample the steady predictor learns of a state what has the covariance
    /// `K S Kᵀ`: by this the Riccati equation differs from one without measurements.
    fn new(kernel: &Kernel, first: usize, innovation: &DMatrix<f64>) -> Self {
        let (transition, gain) = kernel.states_from(first);
        Self { sample: Over { learned: &gain * innovation * gain.transpose(), transition } }
    }

    fn states(&self) -> usize {
        self.sample.transition.nrows()
    }

    fn over(&self, mut samples: u64) -> Over {
        let none = DMatrix::identity(self.states(), self.states());
        let (mut all, mut power) = (Over { learned: &none * 0.0, transition: none }, self.sample.clone());
        while samples > 0 {
            if samples & 1 == 1 {
                all = all.then(&power);
            }
            power = power.then(&power);
            samples >>= 1;
        }
        all
    }
}

impl Over {
    fn then(&self, next: &Self) -> Self {
        Self {
            transition: &next.transition * &self.transition,
            learned: &next.transition * &self.learned * next.transition.transpose() + &next.learned,
        }
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
fn in_parallel<T: Send>(items: Vec<T>, threads: usize, work: impl Fn(T) + Sync) {
    if threads.min(items.len()) < 2 {
        return items.into_iter().for_each(work);
    }
    let queue = Mutex::new(items.into_iter());
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
