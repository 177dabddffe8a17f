//! What the author of a `dragfree` plugin uses: the traits [`Source`], [`Stage`] and [`Effect`], and
//! [`export_plugin!`].
//!
//! A plugin is a struct, a [`Manifest`], and one of the traits:
//!
//! ```
//! use dragfree_sdk::prelude::*;
//!
//! /// Twice the measured displacement of test mass 1.
//! struct Twice {
//!     x: Option<(In, Table, Out)>,
//! }
//!
//! impl Stage for Twice {
//!     const MANIFEST: Manifest = Manifest {
//!         id: "twice",
//!         version: "1.0.0",
//!         licence: "MIT",
//!         description: "Doubles a column",
//!         parameters: &[Parameter::f64("factor", "1", 2.0, 0.0..=10.0, "what to multiply by")],
//!         instances: &[],
//!         needs: &[],
//!     };
//!     fn new(_setup: &Setup) -> Result<Self, PluginError> {
//!         Ok(Self { x: None })
//!     }
//!     fn link(&mut self, available: &Available, link: &mut Link<'_>) -> Result<(), PluginError> {
//!         let x = link.read(&Want::new("is.tm1.r_orf_m.x").unit("m").frame("ORF_1"))?;
//!         let rate_hz = available.find("is.tm1.r_orf_m.x").map_or(0.0, |c| c.rate_hz);
//!         let table = link.table("twice", rate_hz);
//!         self.x = Some((x, table, link.write(table, "twice.x", "m", "ORF_1")?));
//!         Ok(())
//!     }
//!     fn process(&mut self, input: &Inputs<'_>, output: &mut Outputs) -> Result<(), PluginError> {
//!         let Some((x, table, twice)) = self.x else { return Ok(()) };
//!         output.time(table).extend_from_slice(input.time_ns());
//!         output.f64(twice).extend(input.f64(x).iter().map(|x| 2.0 * x));
//!         Ok(())
//!     }
//!     fn report(&mut self, _earlier: &[Report]) -> Result<Report, PluginError> {
//!         Ok(Report::default())
//!     }
//!     fn state(&mut self, _state: &mut State<'_>) -> Result<(), PluginError> {
//!         Ok(())
//!     }
//! }
//!
//! export_plugin!(stages: [Twice]);
//! # fn main() {}
//! ```

mod batch;
pub mod border;
mod error;
mod host;
mod link;
mod manifest;
mod node;
mod setup;
mod want;

pub use batch::{Inputs, Outputs, Progress};
pub use dragfree_schema::{
    AHEAD_ATTRIBUTE, Attachment, Available, Coefficient, Colour, Column, Constraint, Covariance, Estimate,
    NoiseEstimate, NoiseLevels, NoiseProcess, NoiseResponse, NoiseShape, NoiseTerm, PREDICTION_NEED, Report, Response,
    Role, Settings, Shape, Transient, UNPREDICTED_ATTRIBUTE, UNPREDICTED_SLOPE_ATTRIBUTE, Variant, place_and_number,
    state,
};
pub use error::PluginError;
pub use link::{EffectLink, In, Link, Out, Table};
pub use manifest::{Manifest, Parameter};
pub use node::{Effect, Source, Stage};
pub use setup::{Level, Log, Setup};
pub use want::Want;

/// Everything a plugin needs.
pub mod prelude {
    pub use crate::state::{State, StateError};
    pub use crate::{
        AHEAD_ATTRIBUTE, Attachment, Available, Coefficient, Colour, Column, Constraint, Covariance, Effect,
        EffectLink, Estimate, In, Inputs, Level, Link, Log, Manifest, NoiseEstimate, NoiseLevels, NoiseProcess,
        NoiseResponse, NoiseShape, NoiseTerm, Out, Outputs, PREDICTION_NEED, Parameter, PluginError, Progress, Report,
        Response, Role, Settings, Setup, Shape, Source, Stage, Table, Transient, UNPREDICTED_ATTRIBUTE,
        UNPREDICTED_SLOPE_ATTRIBUTE, Variant, Want, export_plugin,
    };
}
