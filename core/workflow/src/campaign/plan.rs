//! Which tasks there are.

use std::path::{Path, PathBuf};

use chrono::NaiveDate;
use dragfree_archive::Archive;
use dragfree_archive::files::{IoContext as _, read_text, sha256};
use dragfree_engine::EngineError;
use dragfree_engine::limits::CONFIG_BYTES;
use serde::{Deserialize, Serialize};

use crate::WorkflowError;
use crate::days::{day_number, day_of_number};
use crate::joint::calendar::Node;
use crate::operations::{self, Inbox, Operations, Planned, Planner};

/// Name of the file of tasks in a campaign's folder.
pub const PLAN: &str = "plan.jsonl";

/// What a campaign is to do.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Spec {
    campaign: Campaign,
    simulate: Option<Simulate>,
}

#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Campaign {
    /// File of operations: pipeline, mission, model, archive and inbox.
    ops: PathBuf,
    /// First and last day, `2035-01-01..2035-03-31`.
    days: String,
}

/// Telemetry that each task simulates, in place of the inbox.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Simulate {
    /// Seed; that of a day is `1000 · seed` plus its place.
    seed: u32,
    /// Hours of each day.
    #[serde(default = "whole_day")]
    hours: f64,
    /// Effects, as of `simulate --effect`.
    #[serde(default)]
    effects: Vec<String>,
}

fn whole_day() -> f64 {
    24.0
}

/// What a task does.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "kebab-case")]
pub enum Job {
    /// Calibrates a day.
    Day {
        /// The day with its telemetry.
        planned: Planned,
    },
    /// Simulates a day and calibrates it; its telemetry is not kept.
    Flight(Flight),
    /// Adds the sums of a node of the calendar.
    Sums {
        /// 2^level days …
        level: u32,
        /// … from `index · 2^level` on, since 1970.
        index: i64,
    },
}

/// A day to be simulated.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Flight {
    /// The day.
    pub day: NaiveDate,
    /// Seed of the day.
    pub seed: u32,
    /// Hours.
    pub hours: f64,
    /// Effects, as of `simulate --effect`.
    pub effects: Vec<String>,
}

/// A task.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Task {
    /// Digest of the job and of everything that it depends on.
    pub id: String,
    /// Ids of tasks whose results it reads.
    pub after: Vec<String>,
    /// The command that does it.
    pub argv: Vec<String>,
    /// Folder of its result, in that of the campaign.
    pub output: PathBuf,
    /// File of operations.
    pub ops: PathBuf,
    /// Digest of program, plugins and configuration.
    pub build: String,
    /// What it does.
    #[serde(flatten)]
    pub job: Job,
}

impl Spec {
    /// Reads a file; paths in it are relative to its folder.
    ///
    /// # Errors
    /// It cannot be read.
    pub fn load(path: &Path) -> Result<Self, WorkflowError> {
        let refuse = |what: String| WorkflowError::Campaign(format!("{}: {what}", path.display()));
        let text = read_text(path, CONFIG_BYTES).map_err(|e| refuse(e.to_string()))?;
        let mut spec: Self = toml::from_str(&text).map_err(|e| refuse(e.to_string()))?;
        let place = std::path::absolute(path).map_err(|e| refuse(e.to_string()))?;
        spec.campaign.ops = place.parent().unwrap_or(Path::new("/")).join(&spec.campaign.ops);
        Ok(spec)
    }

    /// The file of operations.
    pub fn ops(&self) -> &Path {
        &self.campaign.ops
    }

    fn days(&self) -> Result<(i64, i64), WorkflowError> {
        let days = &self.campaign.days;
        let parsed = days.split_once("..").and_then(|(a, b)| Some((a.parse().ok()?, b.parse().ok()?)));
        match parsed.map(|(a, b)| (day_number(a), day_number(b))) {
            Some((first, last)) if first <= last => Ok((first, last)),
            _ => Err(WorkflowError::Campaign(format!("days = {days:?} is not of the form 2035-01-01..2035-03-31"))),
        }
    }
}

/// The tasks of a campaign in a folder. `program` is the digest of the program.
///
/// # Errors
/// The inbox or the archive cannot be read, or there is no telemetry of the days.
pub fn plan(
    spec: &Spec,
    folder: &Path,
    planner: &Planner<'_>,
    operations: &Operations,
    program: &str,
) -> Result<Vec<Task>, WorkflowError> {
    let (first, last) = spec.days()?;
    let build = sha256(format!("{program}\n{}", planner.configuration_digest()));
    let make = |job: Job, after: Vec<String>| -> Result<Task, WorkflowError> {
        // A day says by a digest with which telemetry it is to be run.
        let said = serde_json::to_string(&job).map_err(|e| WorkflowError::Campaign(e.to_string()))?;
        let id = sha256(format!("{build}\n{said}\n{}", after.join("\n")))[..32].to_owned();
        let argv = ["dragfree", "campaign", "task", &folder.to_string_lossy(), &id].map(str::to_owned).to_vec();
        let (output, ops) = (Path::new("results").join(&id), spec.campaign.ops.clone());
        Ok(Task { id, after, argv, output, ops, build: build.clone(), job })
    };
    let mut tasks = Vec::new();
    let mut days: Vec<(i64, String)> = Vec::new();
    match &spec.simulate {
        Some(simulate) => {
            if !(simulate.hours > 0.0 && simulate.hours <= 24.0) {
                let what = format!("hours = {} must be more than 0 and at most 24", simulate.hours);
                return Err(WorkflowError::Campaign(what));
            }
            for (place, number) in (0..).zip(first..=last) {
                let (seed, effects) = (simulate.seed.wrapping_mul(1000).wrapping_add(place), simulate.effects.clone());
                let job = Job::Flight(Flight { day: day_of_number(number), seed, hours: simulate.hours, effects });
                tasks.push(make(job, Vec::new())?);
                days.push((number, tasks[tasks.len() - 1].id.clone()));
            }
        }
        None => {
            let mut inbox = Inbox::default();
            inbox.look(&operations.inbox, planner.spacecraft())?;
            let archive = Archive::create(&operations.archive).map_err(EngineError::from)?;
            for mut planned in operations::plan(planner, &archive, &inbox)? {
                let number = day_number(planned.day.day);
                if !(first..=last).contains(&number) {
                    continue;
                }
                // What the archive has now is no part of the task.
                (planned.day.product, planned.day.reasons, planned.day.failed) = (None, Vec::new(), None);
                tasks.push(make(Job::Day { planned }, Vec::new())?);
                days.push((number, tasks[tasks.len() - 1].id.clone()));
            }
        }
    }
    if days.is_empty() {
        let what = format!("there is no telemetry of {} in {}", spec.campaign.days, operations.inbox.join(", "));
        return Err(WorkflowError::Campaign(what));
    }
    let mut nodes: Vec<(Node, String)> = Vec::new();
    for node in Node::kept(first, last) {
        let own = days.iter().filter(|(day, _)| (node.first()..node.end()).contains(day)).map(|(_, id)| id);
        let below = nodes.iter().filter(|(other, _)| node.made_of(*other)).map(|(_, id)| id);
        let after: Vec<String> = own.chain(below).cloned().collect();
        if after.is_empty() {
            continue;
        }
        let task = make(Job::Sums { level: node.level, index: node.index }, after)?;
        nodes.push((node, task.id.clone()));
        tasks.push(task);
    }
    Ok(tasks)
}

/// Writes the tasks of a campaign, one JSON document a line, into its folder, which is made where there is none.
///
/// # Errors
/// The folder cannot be written.
pub fn write(folder: &Path, tasks: &[Task]) -> Result<PathBuf, WorkflowError> {
    let path = folder.join(PLAN);
    let keep = || -> Result<(), EngineError> {
        std::fs::create_dir_all(folder).at("make the folder", folder)?;
        for name in ["results", "scratch"] {
            let own = folder.join(name);
            std::fs::create_dir_all(&own).at("make the folder", &own)?;
        }
        let mut file = tempfile::NamedTempFile::new_in(folder).at("write in", folder)?;
        for task in tasks {
            use std::io::Write as _;
            let line = serde_json::to_string(task).map_err(std::io::Error::from).at("write", &path)?;
            writeln!(file, "{line}").at("write", &path)?;
        }
        file.persist(&path).map_err(|e| e.error).at("write", &path)?;
        Ok(())
    };
    keep()?;
    Ok(path)
}

/// Reads the tasks of a campaign.
///
/// # Errors
/// There is no plan, or it is damaged.
pub fn read(folder: &Path) -> Result<Vec<Task>, WorkflowError> {
    let path = folder.join(PLAN);
    let refuse = |what: String| WorkflowError::Campaign(format!("{}: {what}", path.display()));
    let text = std::fs::read_to_string(&path).map_err(|e| refuse(e.to_string()))?;
    let mut tasks = Vec::new();
    for (number, line) in text.lines().enumerate() {
        tasks.push(serde_json::from_str(line).map_err(|e| refuse(format!("line {}: {e}", number + 1)))?);
    }
    if tasks.is_empty() {
        return Err(refuse("it has no task".to_owned()));
    }
    Ok(tasks)
}
