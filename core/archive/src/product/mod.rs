//! Products: what a run leaves behind, `COM1B_2035-01-01_SC1_01_0001.toml` and the files beside it.
//!
//! A product is immutable: a second run of the same day is the next revision. The layout is fixed by
//! `fixtures/schema/product.schema.json`, which every product is checked against when written and when read.
//!
//! A missing number is `nan` in a product, as in the tables, and `null` in JSON, which has no `nan`.

mod emit;
mod file;
mod json;

pub(crate) use file::parse;
pub use file::{
    Attachment, Coefficient, Covariance, Dimensions, FORMAT_VERSION, GlobalAttributes, Header, Input, Loss, Model,
    NoiseLevel, NonStandardAttributes, Outcome, Product, Quality, Stage, Status, Stream, Supersedes, Variable, read,
};
pub use json::to_json;

/// Name of products of many days.
pub const JOINT: &str = "COM2";

/// Suffix of what a diagnosis of a product keeps for later ones.
pub const EXTRACT: &str = "extract.json";

/// Suffix of the state that a run left for the next day.
pub const STATE: &str = "state";

/// Suffix of the product itself.
pub(crate) const PRODUCT: &str = "toml";
