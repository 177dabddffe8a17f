//! Budgets: how much a file, a plugin or a configuration may ask of this program. What is beyond ends in a sentence,
//! not in an abort. `SECURITY.md` lists them with those of the mission file (`core/physics/src/ranges.rs`).

use std::time::Duration;

/// Largest chunk of a telemetry file, bytes, compressed or not; also of a run of loose messages and of a summary.
pub const PIECE_BYTES: u64 = 1 << 27;
/// Most bytes that one stored byte may become. Telemetry that repeats itself shrinks to a thirtieth, since each message
/// has a time of its own.
pub const INFLATION: u64 = 200;
/// Size below which [`INFLATION`] is not asked for, bytes.
pub const INFLATION_FREE_BYTES: u64 = 1 << 20;
/// Rows read from telemetry and not yet delivered, bytes: files in no order keep many.
pub const ROWS_IN_FLIGHT_BYTES: usize = 256 << 20;
/// Most bytes of a schema, channel or metadata record of a telemetry file.
pub const DEFINITION_BYTES: u64 = 1 << 24;
/// Most topics of the telemetry interface in all files of a run.
pub const TABLES: usize = 1024;
/// Most columns of a table from telemetry, and of the tables that one plugin writes.
pub const COLUMNS: usize = 4096;

/// Most bytes of rows that a program keeps in files without a name, so that stages need not make them again.
pub const RECORDING_BYTES: u64 = 8 << 30;

/// Largest configuration file: pipeline, mission, model, lock, bytes.
pub const CONFIG_BYTES: u64 = 16 << 20;

/// Largest plugin library, bytes.
pub const LIBRARY_BYTES: u64 = 1 << 30;
/// Time that a library has to be opened in, in a process of its own.
pub const OPENING: Duration = Duration::from_secs(20);
/// Most plugins of one kind in a library.
pub const PLUGINS: u32 = 256;
/// Longest text that a plugin gives at once: a manifest, a declaration, the attributes of a column, bytes.
pub const TEXT_BYTES: usize = 4 << 20;
/// Longest name of a column, a table or a unit, bytes.
pub const NAME_BYTES: usize = 256;
/// Most coefficients, constraints or noise processes that one instance declares.
pub const DECLARATIONS: usize = 4096;
/// Longest report, with what is attached to it, bytes.
pub const REPORT_BYTES: usize = 256 << 20;
/// Largest saved state of one plugin, bytes.
pub const STATE_BYTES: usize = 1 << 30;
/// Longest line that a plugin may log, bytes; the rest is cut.
pub const LOG_BYTES: usize = 4096;
/// Most lines that one instance may log; the rest is counted.
pub const LOG_LINES: u32 = 1000;
/// Most rows in one array from a plugin. `preprocess` gives a long gap as rows at once.
pub const ROWS: usize = 1 << 24;
/// Address space of a plugin in a process of its own; also most bytes of rows that it is given, or gives, at once.
pub const ISOLATED_BYTES: u64 = 4 << 30;
/// Longest message between this program and such a process, bytes, beside rows, reports and states.
pub const MESSAGE_BYTES: usize = 64 << 20;
