//! GRACE-FO Level-1 text files as a source of tables, and a stage that lets an accelerometer take the place of a
//! drag-free test mass.
//!
//! What the files do that a reader of their headers would not expect, and what is done about it:
//!
//! | in the files | here |
//! |---|---|
//! | `num_records` is not the number of rows | counted and noted |
//! | which columns a row has depends on its `prod_flag` | bits and variables are paired from the header |
//! | the header names a variable that has no bit (`statusflag`) | in no row |
//! | 1e33 stands for no value | NaN, counted |
//! | rows out of order, repeated, cut, foreign, of garbage | sorted, or dropped and counted |
//! | MAG1A has two columns in another order than its header, and microseconds where it says nanoseconds | read as the rows are |
//! | ACC1A and ACT1A have the accelerometer's axes, ACT1B the spacecraft's, and no header says how they lie | all in SRF |
//! | the angular columns of ACT1A and ACT1B are zero | left out |
//! | ACT1A and ACT1B of spacecraft D are C's, transplanted | noted |
//! | time tags of Level 1A are the on-board receiver's | column attribute `clock`, noted |
//! | archives hold stray `._*` members | ignored |

pub mod accelerometer;
pub mod angular;
pub mod archive;
pub mod header;
pub mod product;
pub mod rows;
pub mod source;
pub mod telemetry;

use dragfree_sdk::export_plugin;

export_plugin!(stages: [accelerometer::Accelerometer], sources: [source::GraceFo]);

/// Why a file was refused.
#[derive(Debug, thiserror::Error)]
pub enum Level1Error {
    /// The line that ends a header is not there.
    #[error("no line `# End of YAML header`: this is no GRACE-FO Level-1 text file, or it was cut in its header")]
    NoEndOfHeader,
    /// The header is no YAML.
    #[error("the header is no YAML: {0}")]
    Yaml(String),
    /// The header lacks something.
    #[error("the header has no {0}")]
    MissingKey(&'static str),
    /// The header lacks a variable of the product.
    #[error("the header has no variable {0}: not this product, or another release of it")]
    MissingVariable(&'static str),
    /// Time counts from another epoch.
    #[error("time counts from `{0}`, not from 2000-01-01T12:00:00")]
    Epoch(String),
    /// A variable has another unit.
    #[error("variable {variable} is in `{found}`, not in `{wanted}`: another release of the product")]
    Unit {
        /// The variable.
        variable: &'static str,
        /// Unit in the header.
        found: String,
        /// Unit expected.
        wanted: &'static str,
    },
    /// The file is another spacecraft's.
    #[error("the header says platform `{found}`, the file name says {wanted}")]
    Platform {
        /// Platform in the header.
        found: String,
        /// Letter of the spacecraft in the file name.
        wanted: char,
    },
}

/// A stretch of time, half open, in nanoseconds of the tables' time scale.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Window {
    /// First instant inside.
    pub start_ns: i64,
    /// First instant after.
    pub end_ns: i64,
}

impl Window {
    /// All time.
    pub const ALL: Self = Self { start_ns: i64::MIN, end_ns: i64::MAX };

    /// Whether an instant is inside.
    #[must_use]
    pub const fn contains(self, time_ns: i64) -> bool {
        self.start_ns <= time_ns && time_ns < self.end_ns
    }
}
