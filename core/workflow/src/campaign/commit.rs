//! Taking over results, and how far a campaign has come.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::{self, File};
use std::path::{Path, PathBuf};

use dragfree_archive::files::IoContext as _;
use dragfree_archive::{Archive, Stamp};
use dragfree_engine::EngineError;
use serde::Serialize;

use super::plan::{Job, Task};
use super::task::{LOCK, Outcome};
use crate::WorkflowError;

/// What was taken over.
#[derive(Clone, Debug, Serialize)]
pub struct Committed {
    /// Products, by their ids in the archive.
    pub products: Vec<String>,
    /// Days that gave no product, with the reason.
    pub failed: Vec<(String, String)>,
    /// Sums that the archive did not keep before.
    pub sums: usize,
    /// Folders of killed workers and results of other plans that were cleared.
    pub cleared: usize,
}

/// How far a campaign has come.
#[derive(Clone, Debug, Serialize)]
pub struct Status {
    /// Tasks of each kind: done, all.
    pub kinds: BTreeMap<&'static str, (usize, usize)>,
    /// Workers at a task.
    pub at_work: usize,
    /// Days that gave no product, with the reason.
    pub failed: Vec<(String, String)>,
    /// Ids of tasks that are not done and need nothing that is not done.
    pub ready: Vec<String>,
}

fn kind(job: &Job) -> &'static str {
    match job {
        Job::Day { .. } | Job::Flight(_) => "days",
        Job::Sums { .. } => "sums",
    }
}

fn day(job: &Job) -> String {
    match job {
        Job::Day { planned } => planned.day.day.to_string(),
        Job::Flight(flight) => flight.day.to_string(),
        Job::Sums { level, index } => format!("sums {level} {index}"),
    }
}

/// How far a campaign has come.
///
/// # Errors
/// The folder cannot be read.
pub fn status(folder: &Path, tasks: &[Task]) -> Result<Status, WorkflowError> {
    let mut status = Status { kinds: BTreeMap::new(), at_work: 0, failed: Vec::new(), ready: Vec::new() };
    let (mut there, mut done) = (BTreeSet::new(), BTreeSet::new());
    for task in tasks {
        let outcome = Outcome::read(&folder.join(&task.output));
        let count = status.kinds.entry(kind(&task.job)).or_default();
        count.1 += 1;
        if let Some(outcome) = outcome {
            there.insert(&task.id);
            match outcome.failed {
                Some(reason) => status.failed.push((day(&task.job), reason)),
                None => {
                    count.0 += 1;
                    done.insert(&task.id);
                }
            }
        }
    }
    // Sums go without a day that failed.
    let ready = |task: &&Task| !done.contains(&task.id) && task.after.iter().all(|id| there.contains(id));
    status.ready = tasks.iter().filter(ready).map(|task| task.id.clone()).collect();
    status.at_work = locks(folder)?.iter().filter(|path| is_held(path)).count();
    Ok(status)
}

/// Takes over the results of all tasks into an archive: the products in one step, in the order of the plan. Then clears
/// what killed workers have left, and results of other plans. `spacecraft` is that of the days.
///
/// # Errors
/// A task has no result, or one is damaged; the archive cannot be written. Nothing is taken over then.
pub fn commit(
    folder: &Path,
    tasks: &[Task],
    (archive, spacecraft): (&Path, &str),
    stamp: &Stamp<'_>,
) -> Result<Committed, WorkflowError> {
    let mut outcomes = Vec::new();
    for task in tasks {
        let result = folder.join(&task.output);
        let outcome = Outcome::read(&result).filter(|outcome| outcome.id == task.id);
        let Some(outcome) = outcome else {
            let left = status(folder, tasks)?;
            let (done, all) = left.kinds.values().fold((0, 0), |(d, a), (done, all)| (d + done, a + all));
            return Err(WorkflowError::Campaign(format!(
                "{done} of {all} tasks have a result; the first without one is {} ({})",
                task.id,
                day(&task.job)
            )));
        };
        outcomes.push((task, result, outcome));
    }
    let again = |e| WorkflowError::from(EngineError::from(e));
    let mut products = Vec::new();
    for (task, result, outcome) in &outcomes {
        let Some(id) = &outcome.product else { continue };
        let own = result.join("archive");
        let product = Archive::open(&own).and_then(|archive| archive.document(id)).map_err(again)?;
        let found = product.header.non_standard_attributes.sha256;
        if found != outcome.digest {
            return Err(WorkflowError::Campaign(format!(
                "the result of task {} is damaged: its product has the digest {found}, it says {}; remove {} and do the task again",
                task.id,
                outcome.digest,
                result.display()
            )));
        }
        products.push((own, id.clone()));
    }
    let mut archive = Archive::create(archive).map_err(again)?;
    let products = archive.take_over(&products, stamp).map_err(again)?;
    let mut failed = Vec::new();
    for (task, _, outcome) in &outcomes {
        if let Some(reason) = &outcome.failed {
            let day = day(&task.job);
            archive.keep_failure((&day, spacecraft), reason, &task.build, stamp).map_err(again)?;
            failed.push((day, reason.clone()));
        }
    }
    let kept = archive.sums();
    let mut sums = 0;
    for (task, result, _) in &outcomes {
        if matches!(task.job, Job::Sums { .. }) {
            sums += kept.take_over(&result.join("sums")).map_err(again)?;
        }
    }
    Ok(Committed { products, failed, sums, cleared: clear(folder, tasks)? })
}

/// Files that workers hold, or held.
fn locks(folder: &Path) -> Result<Vec<PathBuf>, WorkflowError> {
    let mut all = names(&folder.join("scratch"))?;
    all.retain(|path| path.to_string_lossy().ends_with(LOCK));
    Ok(all)
}

fn names(folder: &Path) -> Result<Vec<PathBuf>, WorkflowError> {
    let read = || -> std::io::Result<Vec<PathBuf>> {
        let mut all = fs::read_dir(folder)?.map(|entry| Ok(entry?.path())).collect::<std::io::Result<Vec<_>>>()?;
        all.sort();
        Ok(all)
    };
    Ok(read().at("read", folder).map_err(EngineError::from)?)
}

fn is_held(lock: &Path) -> bool {
    File::open(lock).is_ok_and(|file| file.try_lock().is_err())
}

/// Clears folders of killed workers, and results of tasks that are in no plan.
fn clear(folder: &Path, tasks: &[Task]) -> Result<usize, WorkflowError> {
    let mut waste = Vec::new();
    let scratch = names(&folder.join("scratch"))?;
    for lock in locks(folder)?.into_iter().filter(|lock| !is_held(lock)) {
        waste.push(lock.with_extension(""));
        waste.push(lock);
    }
    // A lock is there before its folder and after it.
    let lock_of = |path: &PathBuf| PathBuf::from(format!("{}{LOCK}", path.display()));
    waste.extend(scratch.into_iter().filter(|path| path.is_dir() && !lock_of(path).exists()));
    let own: BTreeSet<PathBuf> = tasks.iter().map(|task| folder.join(&task.output)).collect();
    waste.extend(names(&folder.join("results"))?.into_iter().filter(|path| !own.contains(path)));
    waste.retain(|path| path.exists());
    for path in &waste {
        let cleared = if path.is_dir() { fs::remove_dir_all(path) } else { fs::remove_file(path) };
        cleared.at("clear", path).map_err(EngineError::from)?;
    }
    Ok(waste.len())
}
