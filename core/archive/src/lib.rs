//! Products, and the archive that keeps them with everything they were made of.
//!
//! ```text
//! ARCHIVE/COM1B_2035-01-01_SC1_01_0001.toml   names for people, hard links into `objects`
//!         objects/ab/cdef…                    contents by SHA-256, written once
//!         journal/00000001.json               what happened, in order, one file an event
//!         catalogue.sqlite                    the same as tables; made again from the two above whenever it is gone
//!         staging/                            what writers have not committed
//!         sums/                               sums of days, which may be deleted
//! ```
//!
//! An event has happened when its file has its number in the journal, and nothing before that is visible. Everything
//! after it, names and catalogue, is brought up to date by whichever command opens the archive next.

mod archive;
mod catalogue;
mod contents;
mod events;
pub mod files;
mod journal;
mod mend;
mod migrate;
mod objects;
pub mod product;
mod running;
mod signature;
mod staging;
mod sums;
mod take_over;
mod writer;

pub use archive::Archive;
pub use catalogue::{Place, Row, Validity, stem};
pub use contents::{Entry, Find, Listing};
pub use events::Window;
pub use journal::{Event, InputPlace, JournalEntry, SetState, Stamp, Stored};
pub use migrate::{Migrated, migrate};
pub use product::{EXTRACT, JOINT, STATE};
pub use running::{Running, Teller};
pub use signature::PublicKey;
pub use sums::Sums;
pub use writer::{MadeOf, ProductWriter, Written};

use files::IoError;
use product::FORMAT_VERSION;
use std::path::PathBuf;

/// Why a product or an archive could not be made, written or read.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs, reason = "every field is named in its sentence")]
pub enum ArchiveError {
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
    /// There is no archive in the folder.
    #[error("there is no archive in {}; --archive names one, `dragfree run` makes one", .0.display())]
    NoArchive(PathBuf),
    /// The folder holds products of an earlier version, without a journal.
    #[error(
        "{} was written by an earlier version; `dragfree archive migrate --archive {}` takes its products over",
        .0.display(), .0.display()
    )]
    Unmigrated(PathBuf),
    /// An entry of the journal is missing or is not what it was.
    #[error("{} is damaged: {reason}; restore it from a copy of the archive", path.display())]
    Journal { path: PathBuf, reason: String },
    /// Another program has held the archive for too long.
    #[error(
        "another program has been writing into {} for {seconds} s; wait for it or end it: `fuser {}` tells which it is",
        folder.display(), folder.join("journal/lock").display()
    )]
    Busy { folder: PathBuf, seconds: u64 },
    /// The catalogue refused a question.
    #[error("the catalogue {} fails: {source}; `dragfree archive reindex` makes it again", path.display())]
    Catalogue { path: PathBuf, source: rusqlite::Error },
    /// A file that a product was made of is not where it was.
    #[error(
        "{role} {name} of {id} is not at {}; `--inputs DIR` looks for it by its digest in another folder",
        place.display()
    )]
    Moved { role: String, name: String, id: String, place: PathBuf },
    /// Something that an event asks for cannot be.
    #[error("{0}")]
    Refused(String),
}

#[cfg(test)]
mod tests;
