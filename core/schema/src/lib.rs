//! What crosses the border between host and plugin as JSON, defined once for both sides.
//!
//! A plugin declares a [`Manifest`] when its library is opened; [`Coefficient`]s, [`Constraint`]s and
//! [`NoiseProcess`]es when it is linked; a [`Report`] when the data are through. Its state crosses as bytes of
//! [`mod@state`]. The host hands on to later stages what earlier ones declared, as a [`Model`].
//! `core/abi/include/dragfree/schema` holds the JSON Schema of these types for authors in other languages.
//!
//! Numbers are SI. JSON has neither NaN nor infinity: a missing number and an open end of a range are `null`.

mod available;
mod column;
mod intervals;
mod manifest;
mod model;
mod noise;
mod noise_levels;
mod number;
mod report;
mod settings;
pub mod state;

pub use available::{Available, NoSuchCoefficient};
pub use column::Column;
pub use intervals::{FIRST_INTERVAL_NS, MOST_INTERVALS};
pub use manifest::{AT_NS, FREQUENCY_HZ, Manifest, PREDICTION_NEED, Parameter, ParameterType, place_and_number};
pub use model::{Coefficient, Colour, Constraint, Model, Response, Shape, Transient, Variant};
pub use noise::{
    AHEAD_ATTRIBUTE, NOISE_ATTRIBUTE, NoiseEstimate, NoiseProcess, NoiseResponse, NoiseShape, NoiseTerm,
    UNPREDICTED_ATTRIBUTE, UNPREDICTED_SLOPE_ATTRIBUTE,
};
pub use noise_levels::NoiseLevels;
pub use report::{Attachment, Covariance, Estimate, Report, Role};
pub use settings::Settings;
