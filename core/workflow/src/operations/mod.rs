//! Days that run themselves: what a mission's `mission-ops.toml` says, which telemetry belongs to a day, which days are
//! to be run, and running them.
//!
//! A day is calibrated by itself. The hour before it runs in the stages before the estimators and no further, so that
//! its product does not depend on the products of earlier days: telemetry that comes late changes its own day and the
//! one after it.

mod config;
mod days;
mod inbox;

pub use config::{FILE, Operations};
pub use days::{Day, Outcome, Planned, Planner, Ran, Report, catch_up, plan};
pub use inbox::{Inbox, InboxFile};
