//! Campaigns: many days calibrated by workers that share nothing but a folder.
//!
//! A plan is a list of tasks, each with an id that is a digest of all that it depends on. A worker does a task into a
//! folder of its own and renames that to `results/ID`: a result is there whole or not at all, and doing a task twice
//! changes nothing. Workers never touch the archive. At the end one program takes over all results, in the order of the
//! plan and in one step, so that the archive is the one that a single machine makes.

mod commit;
mod plan;
mod task;

pub use commit::{Committed, Status, commit, status};
pub use plan::{Flight, Job, PLAN, Spec, Task, plan, read, write};
pub use task::{Done, Worker};
