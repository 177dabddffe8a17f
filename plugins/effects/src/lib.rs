//! The bundled effects, a module each.
//!
//! An effect turns telemetry into regressors, the acceleration that a physical cause adds to a channel per unit of its
//! coefficient; see ARCHITECTURE.md.

pub mod com_offset;

pub use com_offset::ComOffset;

dragfree_sdk::export_plugin!(effects: [ComOffset]);
