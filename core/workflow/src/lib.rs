//! The jobs behind the commands: calibrate a day, compare the model with the data, diagnose what is missing, climb the
//! ladder of models. Each takes options, the registry of plugins and a callback for progress, and gives values; none
//! prints, knows a terminal or asks a clock.

pub mod adding;
mod answer;
pub mod calibrate;
pub mod campaign;
pub mod compare;
mod days;
pub mod diagnose;
pub mod extract;
pub mod formula;
pub mod foxglove;
pub mod joint;
pub mod ladder;
mod likelihood;
pub mod next;
pub mod operations;
pub mod over_time;
mod proposals;
pub mod provenance;
pub mod refit;
mod refusals;
mod replay;
pub mod residuals;
mod sums;
pub mod trend;
pub mod words;

pub use replay::{Pass, Replay};

use std::path::PathBuf;

use dragfree_archive::JOINT;
use dragfree_archive::product::Product;
use dragfree_engine::EngineError;
use dragfree_estimation::estimate::EstimateError;
use dragfree_estimation::sigma::NoiseError;
use dragfree_identification::record::Unlike;
use dragfree_identification::scores::IdentificationError;
use dragfree_schema::NoSuchCoefficient;

/// A calibration of many days where the product of a day is needed.
#[derive(Debug, thiserror::Error)]
#[error(
    "{0} is one calibration of many days, with no data of its own; name the products of its days, which `dragfree products lineage {0}` \
     lists"
)]
pub struct ManyDays(String);

impl ManyDays {
    /// That every product is of one day.
    ///
    /// # Errors
    /// One is of many days.
    fn refuse<'a>(products: impl IntoIterator<Item = &'a Product>) -> Result<(), Self> {
        let of_many = |product: &&Product| product.header.non_standard_attributes.product == JOINT;
        products.into_iter().find(of_many).map_or(Ok(()), |product| Err(Self(product.id().to_owned())))
    }
}

/// Why a comparison or a diagnosis failed.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs, reason = "every field is named in its sentence")]
pub enum WorkflowError {
    /// The chain cannot be run again over the data.
    #[error(transparent)]
    Engine(#[from] EngineError),
    /// An effect makes a regressor of a coefficient that it does not declare.
    #[error(transparent)]
    Coefficient(#[from] NoSuchCoefficient),
    /// Declared noise that contradicts itself.
    #[error(transparent)]
    Noise(#[from] NoiseError),
    /// The model cannot be fitted.
    #[error(transparent)]
    Estimate(#[from] EstimateError),
    /// Products that do not belong together.
    #[error(transparent)]
    Unlike(#[from] Unlike),
    /// No comparison or diagnosis.
    #[error(transparent)]
    Identification(#[from] IdentificationError),
    /// What a mission's file of operations says cannot be followed.
    #[error("{}: {what}", path.display())]
    Operations { path: PathBuf, what: String },
    /// A campaign that cannot be planned, or a task of it that cannot be done here.
    #[error("{0}")]
    Campaign(String),
    /// A file of events that cannot be used.
    #[error("{}: {what}", path.display())]
    Events { path: PathBuf, what: String },
    /// No day can enter a calibration of many.
    #[error("no day is left to calibrate together: {what}")]
    NoDays { what: String },
    /// Days of several spacecraft or pipelines.
    #[error("the archive has products of several series in that time ({what}); name the spacecraft")]
    SeveralSeries { what: String },
    /// No product was named.
    #[error("no product was named")]
    NoProduct,
    /// A product without data of its own.
    #[error(transparent)]
    ManyDays(#[from] ManyDays),
    /// There is nothing to explain.
    #[error("the chain makes no channel to explain: put a stage before the effects that makes some")]
    NoChannel,
    /// A response names a series that nobody makes.
    #[error(
        "a response is to column {name} of table {table}, which nobody makes; the effect that declares it is at fault"
    )]
    NoColumn { table: String, name: String },
    /// Normal equations that cannot be used.
    #[error("{}: {what}", path.display())]
    Reference { path: PathBuf, what: String },
    /// An extract that cannot be used or written.
    #[error("extract {}: {what}", path.display())]
    Extract { path: PathBuf, what: String },
    /// Products of different models.
    #[error("{product} has other coefficients in its model than {first}: name products of one model")]
    OfOtherModel { product: String, first: String },
    /// The likelihood of innovations needs more than the stages declare.
    #[error("the likelihood of the innovations is not to be had: {0}")]
    NoLikelihood(String),
    /// A mission file that a manoeuvre cannot be planned with.
    #[error("no manoeuvre can be planned: {0}")]
    Mission(#[from] dragfree_physics::mission::MissionError),
    /// A detection without its template.
    #[error(
        "{effect} has no waveform any more for the transient at {at_ns} ns: its plugin declares others in every pass"
    )]
    NoTemplate { effect: String, at_ns: i64 },
}
