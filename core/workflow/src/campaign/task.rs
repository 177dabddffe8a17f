//! Doing a task.

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::path::{Path, PathBuf};

use dragfree_archive::files::{IoContext as _, sha256, sync_folder};
use dragfree_archive::{Archive, Sums, Written};
use dragfree_engine::EngineError;
use dragfree_engine::registry::Registry;
use dragfree_engine::run::Progress;
use dragfree_engine::simulate::{SimulateOptions, simulate};
use serde::{Deserialize, Serialize};

use super::plan::{Flight, Job, Task};
use crate::WorkflowError;
use crate::days::{DAY_NS, day_number, start_of_day_ns};
use crate::joint::calendar::{Calendar, Leaf, Node};
use crate::operations::{Planned, Planner};

/// The bundled simulator.
const SIMULATOR: &str = "sim";

/// Ends the name of the file that a worker holds while it is at a task.
pub(super) const LOCK: &str = ".lock";

/// Result of a task, as it lies in its folder.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct Outcome {
    /// The task.
    pub(super) id: String,
    /// Digest of the product, or of the sums; empty where it failed.
    pub(super) digest: String,
    /// The product in the archive beside.
    pub(super) product: Option<String>,
    /// Why there is none.
    pub(super) failed: Option<String>,
}

impl Outcome {
    /// What is in a folder of a result; none where there is none.
    pub(super) fn read(folder: &Path) -> Option<Self> {
        serde_json::from_slice(&fs::read(folder.join("result.json")).ok()?).ok()
    }
}

/// What came of a task.
#[derive(Clone, Debug, Serialize)]
pub struct Done {
    /// The task.
    pub id: String,
    /// Digest of its result; empty where the day gave no product.
    pub digest: String,
    /// Whether it was done now.
    pub new: bool,
    /// Why a day gave no product.
    pub failed: Option<String>,
}

/// Who does tasks.
pub struct Worker<'a> {
    /// Folder of the campaign.
    pub folder: &'a Path,
    /// Plugins.
    pub registry: &'a Registry,
    /// Pipeline, mission, model, with which a day is run.
    pub planner: &'a Planner<'a>,
    /// Digest of the program.
    pub program: &'a str,
    /// Its version.
    pub software: &'a str,
    /// Threads that may work.
    pub threads: usize,
}

impl Worker<'_> {
    /// Does a task, or gives the result that is there.
    ///
    /// # Errors
    /// Program, plugins or configuration are others than planned; a result that it needs is not there; two runs of the
    /// task differ; the folder cannot be written.
    pub fn task(&self, task: &Task, all: &[Task], progress: &mut dyn FnMut(Progress)) -> Result<Done, WorkflowError> {
        let result = self.folder.join(&task.output);
        // A day that failed is tried again: what it lacked may be there now.
        if let Some(outcome) = Outcome::read(&result).filter(|outcome| outcome.failed.is_none()) {
            return Ok(done(outcome, false));
        }
        let build = sha256(format!("{}\n{}", self.program, self.planner.configuration_digest()));
        if build != task.build {
            return Err(WorkflowError::Campaign(format!(
                "task {} was planned with another program, or other plugins, pipeline, mission or model than are here; plan again, \
                 or bring them to this machine",
                task.id
            )));
        }
        let scratch = Scratch::new(self.folder, &task.id)?;
        let outcome = match &task.job {
            Job::Sums { level, index } => {
                self.sums(task, all, Node { level: *level, index: *index }, &scratch.folder)?
            }
            Job::Day { planned } => calibrated(task, self.day(planned, &scratch.folder, progress))?,
            Job::Flight(flight) => calibrated(task, self.flight(flight, &scratch.folder, progress))?,
        };
        scratch.commit(&outcome, &result).map(|new| done(outcome, new))
    }

    /// Calibrates a day with its telemetry.
    fn day(
        &self,
        planned: &Planned,
        scratch: &Path,
        progress: &mut dyn FnMut(Progress),
    ) -> Result<Written, EngineError> {
        self.planner.run_apart(planned, &scratch.join("archive"), progress)
    }

    /// Simulates a day and calibrates it; its telemetry is not kept.
    fn flight(
        &self,
        flight: &Flight,
        scratch: &Path,
        progress: &mut dyn FnMut(Progress),
    ) -> Result<Written, EngineError> {
        let telemetry = scratch.join("telemetry");
        let start_ns = start_of_day_ns(day_number(flight.day));
        let mut parameters = toml::Table::new();
        parameters.insert("seed".into(), i64::from(flight.seed).into());
        parameters.insert("effects".into(), flight.effects.clone().into());
        let options = SimulateOptions {
            mission: self.planner.mission().cloned().unwrap_or_default(),
            out: telemetry.clone(),
            start_ns: start_ns - self.planner.run_in_ns(),
            end_ns: start_ns + (flight.hours * 3.6e12) as i64,
            source: SIMULATOR.to_owned(),
            parameters,
            software: self.software.to_owned(),
            threads: self.threads,
        };
        let made = simulate(self.registry, &options, progress)?;
        let whole = options.end_ns - start_ns >= DAY_NS;
        let written = self.day(&self.planner.with_files(flight.day, made.files, whole), scratch, progress)?;
        fs::remove_dir_all(&telemetry).at("clear", &telemetry)?;
        Ok(written)
    }

    /// Adds the sums of a node, of days whose results are there.
    fn sums(&self, task: &Task, all: &[Task], node: Node, scratch: &Path) -> Result<Outcome, WorkflowError> {
        let mut days = BTreeMap::new();
        let mut kept: Vec<PathBuf> = Vec::new();
        for id in &task.after {
            let other = all.iter().find(|other| other.id == *id);
            let folder = other.map(|other| self.folder.join(&other.output));
            let Some((folder, outcome)) = folder.and_then(|folder| Outcome::read(&folder).map(|o| (folder, o))) else {
                return Err(WorkflowError::Campaign(format!(
                    "task {} needs the result of {id}, which is not there",
                    task.id
                )));
            };
            let Some(product) = outcome.product else {
                kept.push(folder.join("sums"));
                continue;
            };
            let archive = Archive::open(&folder.join("archive")).map_err(EngineError::from)?;
            let document = archive.document(&product).map_err(EngineError::from)?;
            let day = document.header.non_standard_attributes.day.parse().map_or(0, day_number);
            days.insert(day, Leaf::new(&archive, day, &document)?);
        }
        let folder = scratch.join("sums");
        let calendar = Calendar { kept: Sums::apart(&folder, kept), days };
        let sums = calendar.node(node)?;
        let bits = |values: &[f64]| values.iter().flat_map(|x| x.to_le_bytes()).collect::<Vec<u8>>();
        let digest =
            sums.map(|sums| sha256([bits(&sums.spectra.packed), bits(&sums.first), bits(&sums.second)].concat()));
        Ok(Outcome { id: task.id.clone(), digest: digest.unwrap_or_default(), product: None, failed: None })
    }
}

/// Result of a task that calibrates a day: a day that gives no product is a result, too.
fn calibrated(task: &Task, run: Result<Written, EngineError>) -> Result<Outcome, WorkflowError> {
    let outcome = |digest: String, product, failed| Outcome { id: task.id.clone(), digest, product, failed };
    match run {
        Ok(Written { product, .. }) => {
            let digest = product.header.non_standard_attributes.sha256.clone();
            Ok(outcome(digest, Some(product.id().to_owned()), None))
        }
        Err(stopped @ (EngineError::Stopped | EngineError::Archive(_))) => Err(stopped.into()),
        Err(error) => Ok(outcome(String::new(), None, Some(error.to_string()))),
    }
}

fn done(outcome: Outcome, new: bool) -> Done {
    Done { id: outcome.id, digest: outcome.digest, new, failed: outcome.failed }
}

/// A folder that a worker has for itself; gone when it is dropped.
struct Scratch {
    folder: PathBuf,
    lock: PathBuf,
    _held: File,
}

impl Scratch {
    fn new(campaign: &Path, id: &str) -> Result<Self, WorkflowError> {
        let root = campaign.join("scratch");
        let make = || -> Result<Self, EngineError> {
            fs::create_dir_all(&root).at("make the folder", &root)?;
            let made = tempfile::Builder::new().prefix(&format!("{id}.")).suffix(LOCK).tempfile_in(&root);
            let (held, lock) = made.at("write in", &root)?.keep().map_err(|e| e.error).at("write in", &root)?;
            held.lock().at("lock", &lock)?;
            let folder = lock.with_extension("");
            fs::create_dir(&folder).at("make the folder", &folder)?;
            Ok(Self { folder, lock, _held: held })
        };
        Ok(make()?)
    }

    /// Gives the result its place; false where another worker has put the same there in the meantime.
    fn commit(self, outcome: &Outcome, result: &Path) -> Result<bool, WorkflowError> {
        let place = || -> Result<bool, EngineError> {
            let path = self.folder.join("result.json");
            let text = serde_json::to_vec_pretty(outcome).map_err(std::io::Error::from).at("write", &path)?;
            fs::write(&path, text).and_then(|()| File::open(&path)?.sync_all()).at("write", &path)?;
            sync_folder(&self.folder).at("flush", &self.folder)?;
            // A result that failed, or cannot be read, gives way.
            if result.exists() && Outcome::read(result).is_none_or(|there| there.failed.is_some()) {
                fs::remove_dir_all(result).at("clear", result)?;
            }
            match fs::rename(&self.folder, result) {
                Ok(()) => {
                    let results = dragfree_archive::files::folder_of(result);
                    sync_folder(results).at("flush", results)?;
                    Ok(true)
                }
                Err(_) if Outcome::read(result).is_some() => Ok(false),
                Err(error) => Err(error).at("place", result).map_err(Into::into),
            }
        };
        let new = place()?;
        let there = Outcome::read(result).map(|there| there.digest).unwrap_or_default();
        if there != outcome.digest {
            return Err(WorkflowError::Campaign(format!(
                "two runs of task {} differ: {there} and {}; a plugin does not give the same result twice, or the machines differ",
                outcome.id, outcome.digest
            )));
        }
        Ok(new)
    }
}

impl Drop for Scratch {
    fn drop(&mut self) {
        // What stays, `commit` clears.
        let _ = fs::remove_dir_all(&self.folder);
        let _ = fs::remove_file(&self.lock);
    }
}
