//! The filter at the capacity that a model needs.

use crate::filter::{Drive, Filter, Settings, Statistics};
use crate::model::Model;
use crate::state::{Bytes, StateError, Words};

/// Most states that a filter can have.
pub const MAX_STATES: usize = 64;

/// A [`Filter`] whose capacity is the next one that holds the model's states.
#[derive(Clone, Debug)]
pub enum Akf<const D: usize = 3> {
    /// Up to 16 states: the offset with the default readout noise.
    N16(Box<Filter<16, D>>),
    /// Up to 24 states: the paper's 22.
    N24(Box<Filter<24, D>>),
    /// Up to 32 states.
    N32(Box<Filter<32, D>>),
    /// Up to 48 states.
    N48(Box<Filter<48, D>>),
    /// Up to 64 states.
    N64(Box<Filter<64, D>>),
}

macro_rules! each {
    ($akf:expr, $filter:ident => $body:expr) => {
        match $akf {
            Akf::N16($filter) => $body,
            Akf::N24($filter) => $body,
            Akf::N32($filter) => $body,
            Akf::N48($filter) => $body,
            Akf::N64($filter) => $body,
        }
    };
}

impl<const D: usize> Akf<D> {
    /// A filter before its first epoch, `None` when the model has more than [`MAX_STATES`] states.
    #[must_use]
    pub fn new(model: Model<D>, settings: Settings) -> Option<Self> {
        Some(match model.states() {
            0..=16 => Self::N16(Box::new(Filter::new(model, settings))),
            17..=24 => Self::N24(Box::new(Filter::new(model, settings))),
            25..=32 => Self::N32(Box::new(Filter::new(model, settings))),
            33..=48 => Self::N48(Box::new(Filter::new(model, settings))),
            49..=MAX_STATES => Self::N64(Box::new(Filter::new(model, settings))),
            _ => return None,
        })
    }

    /// See [`Filter::step`].
    pub fn step(&mut self, readout_m: [f64; D], next: Drive<'_, D>) {
        each!(self, f => f.step(readout_m, next));
    }

    /// See [`Filter::skip`].
    pub fn skip(&mut self, epochs: u64) {
        each!(self, f => f.skip(epochs));
    }

    /// Estimates of the coefficients.
    #[must_use]
    pub fn coefficients(&self) -> &[f64] {
        each!(self, f => &f.state()[Model::<D>::THETA..][..f.model().coefficients.len()])
    }

    /// Estimate of the displacement `r`, ORF, m.
    #[must_use]
    pub fn displacement_m(&self) -> [f64; D] {
        each!(self, f => std::array::from_fn(|i| f.state()[Model::<D>::R + i]))
    }

    /// See [`Filter::coefficient_covariance`].
    #[must_use]
    pub fn coefficient_covariance(&self, i: usize, j: usize) -> f64 {
        each!(self, f => f.coefficient_covariance(i, j))
    }

    /// See [`Filter::recursion_covariance`].
    #[must_use]
    pub fn recursion_covariance(&self, i: usize, j: usize) -> f64 {
        each!(self, f => f.recursion_covariance(i, j))
    }

    /// See [`Filter::statistics`].
    #[must_use]
    pub fn statistics(&self) -> &Statistics<D> {
        each!(self, f => f.statistics())
    }

    /// See [`Filter::model`].
    #[must_use]
    pub fn model(&self) -> &Model<D> {
        each!(self, f => f.model())
    }

    /// See [`Filter::save`].
    pub fn save(&self, out: &mut Bytes) {
        each!(self, f => f.save(out));
    }

    /// See [`Filter::load`].
    ///
    /// # Errors
    /// [`StateError`] when the bytes end early.
    pub fn load(&mut self, words: &mut Words<'_>) -> Result<(), StateError> {
        each!(self, f => f.load(words))
    }
}
