//! Products: what a run leaves behind, `COM1B_2035-01-01_SC1_01_0001.toml` and the files beside it.
//!
//! The engine fills a [`Draft`] when the last stage has reported; [`ProductWriter`] turns it into a [`Product`] and
//! archives it. A product is immutable: a second run of the same day is the next revision. The layout is fixed by
//! `fixtures/schema/product.schema.json`, which every product is checked against when written and when read.
//!
//! A missing number is `nan` in a product, as in the tables, and `null` in JSON, which has no `nan`.

mod archive;
mod draft;
mod emit;
mod file;
mod json;

pub(crate) use archive::SOURCES;
pub use archive::{EXTRACT, Entry, Listing, ProductWriter, Written, find, find_days, list, write_extract};
pub use draft::Draft;
pub use file::{
    Attachment, Coefficient, Covariance, Dimensions, FORMAT_VERSION, GlobalAttributes, Header, Input, Loss, Model,
    NoiseLevel, NonStandardAttributes, Outcome, Product, Quality, Stage, Status, Stream, Supersedes, Variable, read,
};
pub use json::to_json;

use crate::files::IoError;
use std::path::PathBuf;

/// Why a product could not be made, written or read.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs, reason = "every field is named in its sentence")]
pub enum ProductError {
    /// The operating system refused something.
    #[error(transparent)]
    Io(#[from] IoError),
    /// Two stages, or one stage twice, want to write the same file beside the product.
    #[error("stage {stage} attaches {suffix:?}, but {reason}; rename the attachment in the plugin")]
    Attachment { stage: String, suffix: String, reason: &'static str },
    /// A part of the product's name holds a character that would break the name apart.
    #[error(
        "{what} {value:?} cannot stand in a file name: only letters, digits and '-' may; change it in the {place} file"
    )]
    Name { what: &'static str, value: String, place: &'static str },
    /// The document breaks the schema.
    #[error("product {id} breaks its schema at {at}: {reason}")]
    Schema { id: String, at: String, reason: String },
    /// The file is no TOML.
    #[error("{} is no product: {source}", path.display())]
    Parse { path: PathBuf, source: Box<toml::de::Error> },
    /// The product cannot be expressed in TOML.
    #[error("product {id} cannot be written as TOML: {source}")]
    Emit { id: String, source: toml::ser::Error },
    /// The file was changed after it was archived, or did not survive being written.
    #[error("{} is damaged: {reason}; restore it from a copy, or run the day again", path.display())]
    Damaged { path: PathBuf, reason: String },
    /// The file was written by a later program.
    #[error("{} has format version {found}, this program reads {FORMAT_VERSION}; use a newer dragfree", path.display())]
    Format { path: PathBuf, found: String },
    /// No such product.
    #[error("no product {id} in {}; `dragfree products list` shows what there is", folder.display())]
    NotFound { id: String, folder: PathBuf },
    /// A day alone does not say which product is meant.
    #[error("{} has several products of {day}: name one of {stems}", folder.display())]
    Several { day: String, folder: PathBuf, stems: String },
    /// All revisions of that day are used up.
    #[error("all 9999 revisions of {0} are taken; raise the release in the pipeline file")]
    Full(String),
}

#[cfg(test)]
mod tests;
