//! Measurements behind VALIDATION.md: seeded campaigns of the program, statistics with bounds, information bounds from
//! the mission's noise, and the report generated from committed results.

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
