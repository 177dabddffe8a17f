//! Source of tables from GRACE-FO Level-1 text files, and the stage `accelerometer`, which uses an accelerometer in
//! place of a drag-free test mass.
//!
//! Deviations of the files from their headers, and their treatment:
//!
//! | in the files | here |
//! |---|---|
//! | `num_records` differs from the number of rows | counted and noted |
//! | the columns of a row depend on its `prod_flag` | bits and variables are paired from the header |
//! | the header names a variable without a bit (`statusflag`) | treated as absent from all rows |
//! | 1e33 means no value | NaN, counted |
//! | rows out of order, repeated, truncated, foreign or unreadable | sorted, or dropped and counted |
//! | MAG1A has two columns in another order than its header, and microseconds for nanoseconds | read as the rows are |
//! | ACC1A and ACT1A use the accelerometer's axes, ACT1B the spacecraft's, undocumented | all converted to SRF |
//! | the angular columns of ACT1A and ACT1B are zero | omitted |
//! | ACT1A and ACT1B of spacecraft D are transplanted from C | noted |
//! | time tags of Level 1A are those of the on-board receiver | column attribute `clock`, noted |
//! | archives contain `._*` members | ignored |

pub mod accelerometer;
pub mod angular;
pub mod archive;
pub mod header;
mod noise;
pub mod product;
pub mod rows;
pub mod source;
pub mod telemetry;

use dragfree_sdk::export_plugin;

export_plugin!(stages: [accelerometer::Accelerometer], sources: [source::GraceFo]);

/// Error that makes a file unreadable.
#[expect(missing_docs, reason = "the messages name the fields")]
#[derive(Debug, thiserror::Error)]
pub enum Level1Error {
    /// The line that ends a header is missing.
    #[error("no line `# End of YAML header`: not a GRACE-FO Level-1 text file, or truncated in its header")]
    NoEndOfHeader,
    /// The header is not valid YAML.
    #[error("the header is not valid YAML: {0}")]
    Yaml(String),
    /// The header lacks a key.
    #[error("the header has no {0}")]
    MissingKey(&'static str),
    /// The header lacks a variable of the product.
    #[error("the header has no variable {0}: another product, or another release")]
    MissingVariable(&'static str),
    /// Time counts from another epoch.
    #[error("time counts from `{0}`, expected 2000-01-01T12:00:00")]
    Epoch(String),
    /// A variable has another unit.
    #[error("variable {variable} is in `{found}`, expected `{wanted}`: another release of the product")]
    Unit { variable: &'static str, found: String, wanted: &'static str },
    /// The file belongs to another spacecraft.
    #[error("the header says platform `{found}`, the file name says {wanted}")]
    Platform { found: String, wanted: char },
}

/// Half-open time interval, ns of the tables' time scale.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Window {
    /// Start, included.
    pub start_ns: i64,
    /// End, excluded.
    pub end_ns: i64,
}

impl Window {
    /// All time.
    pub const ALL: Self = Self { start_ns: i64::MIN, end_ns: i64::MAX };

    /// Whether a time is inside.
    pub const fn contains(self, time_ns: i64) -> bool {
        self.start_ns <= time_ns && time_ns < self.end_ns
    }
}
