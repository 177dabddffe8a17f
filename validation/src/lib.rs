//! The measurements behind VALIDATION.md: seeded campaigns of the real program, statistics with bounds, information
//! bounds from the mission's noise alone, and the report that is made of committed results.

pub mod blind;
pub mod blind_report;
pub mod bound;
pub mod campaign;
pub mod program;
pub mod records;
pub mod report;
pub mod speed;
pub mod stats;
pub mod table;
