//! What products were made of: differences, lineage, and making one again.

mod diff;
mod lineage;
mod rebuild;

pub use diff::{Change, Diff, ValueChange, diff};
pub use lineage::{Lineage, lineage};
pub use rebuild::{Rebuilt, can_be_rebuilt, rebuild};
