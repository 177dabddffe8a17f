//! Parameters side by side, eight in a tile: the filter of what they add, and the products of the results.
//!
//! Every lane has the same operations in the same order, so results do not depend on how many of them a processor takes
//! at once; only whether it rounds once or twice in `a b + c` does.

use std::ops::Range;

use aligned_vec::{AVec, avec};
use nalgebra::{DMatrix, DVector};
use pulp::{Arch, Simd, WithSimd};

use super::predictor::{Beside, Change, Predictor};
use super::state_space::NoiseStates;

/// Parameters of a tile.
pub(super) const LANES: usize = 8;
/// States whose sums are taken side by side.
const BLOCK: usize = 8;
/// Channels whose sums are.
const CHANNELS: usize = 3;

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

/// The matrices of the filter, laid out for it.
pub(super) struct Kernel {
    pub(super) channels: usize,
    /// States as they are filtered, see [`NoiseStates::merged`], and some that stay zero up to whole blocks.
    pub(super) states: usize,
    /// Of each state: states before and factors.
    transition: Vec<Vec<(usize, f64)>>,
    /// Of each channel: states and factors.
    output: Vec<Vec<(usize, f64)>>,
    /// Block after block of states, their gains channel by channel.
    gain: Vec<[f64; BLOCK]>,
    /// Of each block of channels: channels up to the last of them.
    whitening: Vec<Vec<[f64; CHANNELS]>>,
}

/// Rows that are filtered at once.
pub(super) struct Batch<'a> {
    /// Its first row among those that wait.
    pub(super) first: usize,
    /// Series with the powers of time.
    pub(super) width: usize,
    pub(super) inputs: &'a [f64],
    pub(super) innovations: &'a [f64],
}

/// Eight parameters.
pub(super) struct Tile {
    /// Place among channels × lanes, series, factor in units of the channel.
    responses: Vec<(usize, usize, f64)>,
    /// `∂K`, block after block of states: channel by channel, state by state, all lanes; empty where no parameter
    /// changes the noise.
    changes: AVec<f64>,
    /// Filters at zero, each in one lane.
    filters: Vec<Filter>,
    /// States × lanes.
    pub(super) state: AVec<f64>,
    next: AVec<f64>,
    /// Channels × lanes.
    nu: AVec<f64>,
    /// Whitened ν: rows × channels × lanes.
    pub(super) whitened: AVec<f64>,
    /// Places among channels × lanes that are not weighed.
    not_weighed: Vec<usize>,
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

impl Kernel {
    pub(super) fn new(system: &NoiseStates, predictor: &Predictor) -> Self {
        let n = system.channels();
        let merged = system.merged();
        let states = merged.iter().max().map_or(0, |last| last + 1).next_multiple_of(BLOCK);
        let mut transition = vec![Vec::new(); states];
        let mut output = vec![Vec::new(); n];
        let mut seen = vec![false; states];
        for (j, to) in merged.iter().enumerate() {
            // One of those that are merged stands for all.
            if std::mem::replace(&mut seen[*to], true) {
                continue;
            }
            for (i, factor) in system.transition.column(j).iter().enumerate().filter(|(_, x)| **x != 0.0) {
                transition[merged[i]].push((*to, *factor));
            }
            for (c, factor) in system.output.column(j).iter().enumerate().filter(|(_, x)| **x != 0.0) {
                output[c].push((*to, *factor));
            }
        }
        let mut gain = vec![[0.0; BLOCK]; states / BLOCK * n];
        for (i, to) in merged.iter().enumerate() {
            for c in 0..n {
                gain[to / BLOCK * n + c][to % BLOCK] += predictor.gain[(i, c)];
            }
        }
        let w = |c: usize, d: usize| if c < n { predictor.whitening[(c, d)] } else { 0.0 };
        let block =
            |c: usize| (0..n.min(c + CHANNELS)).map(|d| std::array::from_fn(|k| w(c + k, d))).collect::<Vec<_>>();
        Self { channels: n, states, transition, output, gain, whitening: (0..n).step_by(CHANNELS).map(block).collect() }
    }

    /// Transition and gain of the states from `first` on, which follow no other state.
    pub(super) fn states_from(&self, first: usize) -> (DMatrix<f64>, DMatrix<f64>) {
        let count = self.states.saturating_sub(first);
        let mut transition = DMatrix::zeros(count, count);
        for (i, before) in self.transition.iter().skip(first).enumerate() {
            before.iter().filter(|(s, _)| *s >= first).for_each(|(s, factor)| transition[(i, s - first)] += factor);
        }
        let gain = |i: usize, c: usize| self.gain[(first + i) / BLOCK * self.channels + c][(first + i) % BLOCK];
        (transition, DMatrix::from_fn(count, self.channels, gain))
    }

    /// From what is seen to innovations, for the data.
    pub(super) fn step(&self, state: &mut Vec<f64>, next: &mut Vec<f64>, z: &mut [f64]) {
        for (z, output) in z.iter_mut().zip(&self.output) {
            output.iter().for_each(|(s, factor)| *z -= factor * state[*s]);
        }
        let blocks = self.transition.chunks_exact(BLOCK).zip(self.gain.chunks_exact(self.channels));
        for (next, (before, k)) in next.chunks_exact_mut(BLOCK).zip(blocks) {
            let mut block: [f64; BLOCK] = std::array::from_fn(|i| before[i].iter().map(|(s, f)| f * state[*s]).sum());
            for (k, e) in k.iter().zip(&*z) {
                block.iter_mut().zip(k).for_each(|(x, k)| *x += k * e);
            }
            next.copy_from_slice(&block);
        }
        std::mem::swap(state, next);
    }

    pub(super) fn whiten(&self, e: &[f64], to: &mut [f64]) {
        for (w, to) in self.whitening.iter().zip(to.chunks_mut(CHANNELS)) {
            for (k, to) in to.iter_mut().enumerate() {
                *to = w.iter().zip(e).map(|(w, e)| w[k] * e).sum();
            }
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
    fn step(&mut self, nu: &mut [f64], e: &[f64]) {
        for (c, s, factor) in &self.output {
            nu[c * LANES + self.lane] -= factor * self.state[*s];
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
    /// At most eight parameters, of which at most `rows` wait to be multiplied.
    pub(super) fn new(parameters: &[&Parameter], unit: &[f64], kernel: &Kernel, merged: &[usize], rows: usize) -> Self {
        let n = unit.len();
        let mut responses = Vec::new();
        for (lane, parameter) in parameters.iter().enumerate() {
            responses
                .extend(parameter.responses.iter().map(|(c, s, factor)| (c * LANES + lane, *s, factor / unit[*c])));
        }
        let mut changes = AVec::new(0);
        let mut filters = Vec::new();
        for (lane, change) in parameters.iter().enumerate().filter_map(|(lane, p)| Some((lane, p.change.as_ref()?))) {
            changes.resize(kernel.states * n * LANES, 0.0);
            filters.extend(change.beside.as_ref().map(|beside| Filter::new(lane, beside)));
            for (i, row) in change.gain.row_iter().enumerate() {
                let (block, within) = (merged[i] / BLOCK, merged[i] % BLOCK);
                for (c, k) in row.iter().enumerate() {
                    changes[((block * n + c) * BLOCK + within) * LANES + lane] += *k;
                }
            }
        }
        let each = parameters.iter().enumerate();
        let not_weighed = each.flat_map(|(lane, p)| p.not_weighed.iter().map(move |c| c * LANES + lane)).collect();
        Self {
            responses,
            changes,
            filters,
            state: avec![0.0; kernel.states * LANES],
            next: avec![0.0; kernel.states * LANES],
            nu: avec![0.0; n * LANES],
            whitened: avec![0.0; rows * n * LANES],
            not_weighed,
        }
    }

    /// Filters at zero go on over samples of which nothing is seen.
    pub(super) fn filters_over(&mut self, samples: u64) {
        for filter in &mut self.filters {
            let states = filter.state.len();
            let mut transition = DMatrix::zeros(states, states);
            filter.transition.iter().for_each(|(i, j, factor)| transition[(*i, *j)] += factor);
            let over: DMatrix<f64> = transition.pow(u32::try_from(samples).unwrap_or(u32::MAX));
            let state = over * DVector::from_column_slice(&filter.state);
            filter.state.copy_from_slice(state.as_slice());
        }
    }

    /// Filters some rows into their places in `whitened`.
    pub(super) fn filter(&mut self, kernel: &Kernel, batch: &Batch<'_>) {
        Arch::new().dispatch(Filtering { tile: self, kernel, batch });
    }
}

struct Filtering<'a> {
    tile: &'a mut Tile,
    kernel: &'a Kernel,
    batch: &'a Batch<'a>,
}

impl WithSimd for Filtering<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { tile, kernel, batch } = self;
        let n = kernel.channels;
        // What is added, lane by lane, before all lanes are taken at once: these would wait for those.
        let first = batch.first * n * LANES;
        let rows = &mut tile.whitened[first..first + batch.innovations.len() * LANES];
        rows.fill(0.0);
        for (input, row) in batch.inputs.chunks_exact(batch.width).zip(rows.chunks_exact_mut(n * LANES)) {
            tile.responses.iter().for_each(|(at, s, factor)| row[*at] += factor * input[*s]);
        }
        for (e, out) in batch.innovations.chunks_exact(n).zip(rows.chunks_exact_mut(n * LANES)) {
            seen(simd, kernel, &tile.state, out, &mut tile.nu);
            tile.filters.iter_mut().for_each(|filter| filter.step(&mut tile.nu, e));
            whiten(simd, kernel, &tile.nu, out);
            tile.not_weighed.iter().for_each(|at| out[*at] = 0.0);
            go_on(simd, kernel, &tile.state, &tile.nu, &mut tile.next);
            if !tile.changes.is_empty() {
                change(simd, &tile.changes, e, &mut tile.next);
            }
            std::mem::swap(&mut tile.state, &mut tile.next);
        }
    }
}

/// Vectors in the lanes of a tile.
#[inline(always)]
fn vectors<S: Simd>() -> usize {
    LANES / S::F64_LANES
}

/// `ν = φ − C χ`.
#[inline(always)]
fn seen<S: Simd>(simd: S, kernel: &Kernel, state: &[f64], phi: &[f64], nu: &mut [f64]) {
    let per = vectors::<S>();
    let (state, phi, nu) = (S::as_simd_f64s(state).0, S::as_simd_f64s(phi).0, S::as_mut_simd_f64s(nu).0);
    for ((nu, phi), output) in nu.chunks_exact_mut(per).zip(phi.chunks_exact(per)).zip(&kernel.output) {
        for v in 0..per {
            let mut sum = phi[v];
            for (s, factor) in output {
                sum = simd.mul_add_e_f64s(simd.splat_f64s(-factor), state[s * per + v], sum);
            }
            nu[v] = sum;
        }
    }
}

/// `W ν`.
#[inline(always)]
fn whiten<S: Simd>(simd: S, kernel: &Kernel, nu: &[f64], out: &mut [f64]) {
    let per = vectors::<S>();
    let (nu, out) = (S::as_simd_f64s(nu).0, S::as_mut_simd_f64s(out).0);
    for (w, out) in kernel.whitening.iter().zip(out.chunks_mut(CHANNELS * per)) {
        for v in 0..per {
            let sums = times(simd, [simd.splat_f64s(0.0); CHANNELS], w, nu, v);
            for (out, sum) in out.chunks_exact_mut(per).zip(sums) {
                out[v] = sum;
            }
        }
    }
}

/// `χ⁺ = F χ + K ν`.
#[inline(always)]
fn go_on<S: Simd>(simd: S, kernel: &Kernel, state: &[f64], nu: &[f64], next: &mut [f64]) {
    let per = vectors::<S>();
    let (state, nu, next) = (S::as_simd_f64s(state).0, S::as_simd_f64s(nu).0, S::as_mut_simd_f64s(next).0);
    let blocks = kernel.transition.chunks_exact(BLOCK).zip(kernel.gain.chunks_exact(kernel.channels));
    for ((before, k), next) in blocks.zip(next.chunks_exact_mut(BLOCK * per)) {
        for v in 0..per {
            let mut sums = [simd.splat_f64s(0.0); BLOCK];
            for (sum, before) in sums.iter_mut().zip(before) {
                for (s, factor) in before {
                    *sum = simd.mul_add_e_f64s(simd.splat_f64s(*factor), state[s * per + v], *sum);
                }
            }
            let sums = times(simd, sums, k, nu, v);
            for (next, sum) in next.chunks_exact_mut(per).zip(sums) {
                next[v] = sum;
            }
        }
    }
}

/// Adds a block of rows of a matrix times one vector of the lanes.
#[inline(always)]
fn times<S: Simd, const N: usize>(
    simd: S,
    to: [S::f64s; N],
    block: &[[f64; N]],
    by: &[S::f64s],
    vector: usize,
) -> [S::f64s; N] {
    let mut sums = to;
    for (factors, by) in block.iter().zip(by.chunks_exact(vectors::<S>())) {
        for (sum, factor) in sums.iter_mut().zip(factors) {
            *sum = simd.mul_add_e_f64s(simd.splat_f64s(*factor), by[vector], *sum);
        }
    }
    sums
}

/// `χ⁺ −= ∂K e`: each lane has a matrix of its own.
#[inline(always)]
fn change<S: Simd>(simd: S, changes: &[f64], e: &[f64], next: &mut [f64]) {
    let per = vectors::<S>();
    let (changes, next) = (S::as_simd_f64s(changes).0, S::as_mut_simd_f64s(next).0);
    for (block, next) in changes.chunks_exact(e.len() * BLOCK * per).zip(next.chunks_exact_mut(BLOCK * per)) {
        for (of_channel, e) in block.chunks_exact(BLOCK * per).zip(e) {
            let e = simd.splat_f64s(-e);
            for (next, k) in next.iter_mut().zip(of_channel) {
                *next = simd.mul_add_e_f64s(e, *k, *next);
            }
        }
    }
}

/// Products of the lanes of a tile with those of itself and of all tiles after it.
pub(super) struct Products {
    tile: usize,
    /// Tile after tile: lanes of the first × lanes.
    sums: AVec<f64>,
}

impl Products {
    pub(super) fn new(tile: usize, tiles: usize) -> Self {
        Self { tile, sums: avec![0.0; (tiles - tile) * LANES * LANES] }
    }

    /// The product of a lane of the first tile with one of another tile.
    pub(super) fn at(&self, lane: usize, tile: usize, other: usize) -> f64 {
        self.sums[((tile - self.tile) * LANES + lane) * LANES + other]
    }

    /// All products with a tile: lanes of the first, lane after lane.
    pub(super) fn with(&mut self, tile: usize) -> &mut [f64] {
        let first = (tile - self.tile) * LANES * LANES;
        &mut self.sums[first..first + LANES * LANES]
    }

    pub(super) fn clear(&mut self) {
        self.sums.fill(0.0);
    }

    /// Adds some products of each pair of lanes, by row and channel; `whitened` are the results of all tiles.
    pub(super) fn add(&mut self, whitened: &[&[f64]], own: Range<usize>) {
        let panels = whitened.iter().skip(self.tile).map(|w| &w[own.start * LANES..own.end * LANES]).collect();
        Arch::new().dispatch(Adding { panels, sums: &mut self.sums });
    }
}

struct Adding<'a> {
    /// Of each tile, the first one first: products × lanes.
    panels: Vec<&'a [f64]>,
    sums: &'a mut [f64],
}

impl WithSimd for Adding<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { panels, sums } = self;
        let Some(first) = panels.first() else { return };
        let per = vectors::<S>();
        let vectors: Vec<(&[S::f64s], usize)> =
            panels.iter().flat_map(|p| (0..per).map(move |v| (S::as_simd_f64s(p).0, v))).collect();
        let sums = S::as_mut_simd_f64s(sums).0;
        // As many sums as a processor with vectors of that length keeps in its registers.
        let mut at = 0;
        while at < vectors.len() {
            match (per, vectors.len() - at) {
                (1, 3..) => {
                    outer::<S, LANES, 3>(simd, first, 0, &vectors[at..], at, sums);
                    at += 3;
                }
                (1, _) => {
                    outer::<S, LANES, 1>(simd, first, 0, &vectors[at..], at, sums);
                    at += 1;
                }
                _ => {
                    outer::<S, 4, 2>(simd, first, 0, &vectors[at..], at, sums);
                    outer::<S, 4, 2>(simd, first, 4, &vectors[at..], at, sums);
                    at += 2;
                }
            }
        }
    }
}

/// Adds the products of A lanes from `lane` on with N vectors, of which the first is the `at`-th of all.
#[inline(always)]
fn outer<S: Simd, const A: usize, const N: usize>(
    simd: S,
    first: &[f64],
    lane: usize,
    vectors: &[(&[S::f64s], usize)],
    at: usize,
    sums: &mut [S::f64s],
) {
    let per = LANES / S::F64_LANES;
    let mut all = [[simd.splat_f64s(0.0); N]; A];
    let columns: [(&[S::f64s], usize); N] = std::array::from_fn(|j| vectors[j]);
    for (k, a) in first.chunks_exact(LANES).enumerate() {
        let b: [S::f64s; N] = std::array::from_fn(|j| columns[j].0[k * per + columns[j].1]);
        for (sums, a) in all.iter_mut().zip(&a[lane..lane + A]) {
            let a = simd.splat_f64s(*a);
            for (sum, b) in sums.iter_mut().zip(b) {
                *sum = simd.mul_add_e_f64s(a, b, *sum);
            }
        }
    }
    for (i, row) in all.into_iter().enumerate() {
        for (j, sum) in row.into_iter().enumerate() {
            let (tile, v) = ((at + j) / per, (at + j) % per);
            let to = &mut sums[(tile * LANES + lane + i) * per + v];
            *to = simd.add_f64s(*to, sum);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt, SeedableRng};
    use rand_xoshiro::Xoshiro256PlusPlus;

    const N: usize = 4;
    const STATES: usize = 16;
    const ROWS: usize = 50;

    /// Processors with these lengths of vectors, as far as this one has them.
    fn all() -> Vec<Arch> {
        let mut all = vec![Arch::Scalar, Arch::new()];
        #[cfg(target_arch = "x86_64")]
        all.extend(pulp::x86::V3::try_new().map(Arch::V3));
        all
    }

    /// A filter of random numbers, and eight parameters of which one changes the noise.
    fn filter(dice: &mut Xoshiro256PlusPlus) -> (Kernel, Tile) {
        let mut small = || dice.random_range(-0.1..0.1);
        let kernel = Kernel {
            channels: N,
            states: STATES,
            transition: (0..STATES).map(|i| vec![(i, 0.5 + small()), ((i + 1) % STATES, small())]).collect(),
            output: (0..N).map(|c| vec![(c, 1.0), (c + N, small())]).collect(),
            gain: (0..STATES / BLOCK * N).map(|_| std::array::from_fn(|_| small())).collect(),
            whitening: vec![(0..3).map(|_| [1.0 + small(); 3]).collect(), (0..4).map(|_| [1.0 + small(); 3]).collect()],
        };
        let parameter = |lane: usize| Parameter {
            responses: vec![(lane % N, lane % 2, 1.0)],
            change: (lane == 3).then(|| Change {
                gain: DMatrix::from_fn(STATES, N, |i, j| 0.01 * (i + j) as f64),
                innovation: DMatrix::zeros(N, N),
                beside: None,
            }),
            not_weighed: if lane == 5 { vec![1] } else { Vec::new() },
        };
        let parameters: Vec<Parameter> = (0..LANES).map(parameter).collect();
        let merged: Vec<usize> = (0..STATES).collect();
        let tile = Tile::new(&parameters.iter().collect::<Vec<_>>(), &[1.0; N], &kernel, &merged, ROWS);
        (kernel, tile)
    }

    /// Vectors of every length give the same, up to whether `a b + c` is rounded once or twice; products of lanes also
    /// equal sums made one by one.
    #[test]
    fn the_length_of_a_vector_changes_nothing() {
        let made = |arch: Arch| {
            let mut dice = Xoshiro256PlusPlus::seed_from_u64(1);
            let (kernel, mut tile) = filter(&mut dice);
            let inputs: Vec<f64> = (0..2 * ROWS).map(|_| dice.random_range(-1.0..1.0)).collect();
            let innovations: Vec<f64> = (0..N * ROWS).map(|_| dice.random_range(-1.0..1.0)).collect();
            let batch = Batch { first: 0, width: 2, inputs: &inputs, innovations: &innovations };
            arch.dispatch(Filtering { tile: &mut tile, kernel: &kernel, batch: &batch });
            // Five tiles, so that vectors are left over after whole groups of them.
            let tiles: Vec<Vec<f64>> =
                (1..6).map(|k| tile.whitened.iter().map(|x| x * f64::from(k)).collect()).collect();
            let panels: Vec<&[f64]> = tiles.iter().map(Vec::as_slice).collect();
            let mut products = Products::new(1, 5);
            arch.dispatch(Adding { panels: panels[1..].to_vec(), sums: &mut products.sums });
            (tile.whitened.to_vec(), products)
        };
        let (filtered, _) = made(Arch::Scalar);
        assert!(filtered.iter().any(|x| x.abs() > 0.1));
        let near = |a: f64, b: f64| (a - b).abs() < 1e-12 * (1.0 + b.abs());
        for arch in all() {
            let (own, products) = made(arch);
            assert!(own.iter().zip(&filtered).all(|(a, b)| near(*a, *b)), "{arch:?}");
            for (tile, a, b) in (1..5).flat_map(|t| (0..64).map(move |k| (t, k / LANES, k % LANES))) {
                let lane = |l: usize| filtered.iter().skip(l).step_by(LANES);
                let sum: f64 = 2.0 * (tile + 1) as f64 * lane(a).zip(lane(b)).map(|(x, y)| x * y).sum::<f64>();
                assert!(near(products.at(a, tile, b), sum), "{arch:?} {tile} {a} {b}");
            }
        }
    }
}
