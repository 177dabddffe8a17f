//! Which days are to be run, and running them.

use super::{Inbox, InboxFile, Operations};
use crate::WorkflowError;
use crate::days::{DAY_NS, day_number, day_of_number, start_of_day_ns};
use chrono::NaiveDate;
use dragfree_archive::files::sha256;
use dragfree_archive::product::{Status, Stream};
use dragfree_archive::{Archive, ArchiveError, Place, Row, Stamp, Written};
use dragfree_engine::EngineError;
use dragfree_engine::border::Kind;
use dragfree_engine::config::{Mission, Model, Pipeline};
use dragfree_engine::registry::Registry;
use dragfree_engine::run::{Progress, RunOptions, run};
use serde::{Deserialize, Serialize};
use std::collections::BTreeSet;
use std::ops::Range;
use std::path::{Path, PathBuf};

/// A day is whole when no more than this is missing at either end of it, ns.
const EDGE_NS: i64 = 1_000_000_000;

/// A day with telemetry.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Day {
    /// UTC day.
    pub day: NaiveDate,
    /// Its newest product; none where it has none.
    pub product: Option<String>,
    /// Why it is to be run; empty where it is not.
    pub reasons: Vec<String>,
    /// Why the last run gave no product; it is not run again with the same inputs.
    pub failed: Option<String>,
}

/// A day that is to be run.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Planned {
    /// What is said of it.
    pub day: Day,
    files: Vec<PathBuf>,
    whole: bool,
    stream: Stream,
    tried_with: String,
}

/// What came of a day.
#[derive(Clone, Debug)]
pub enum Outcome {
    /// A product.
    Product(Box<Written>),
    /// None, with the reason.
    Failed(String),
}

/// A day that was run.
#[derive(Clone, Debug)]
pub struct Ran {
    /// UTC day.
    pub day: NaiveDate,
    /// What came of it.
    pub outcome: Outcome,
}

/// What a day is compared with and run with.
pub struct Planner<'a> {
    operations: &'a Operations,
    registry: &'a Registry,
    /// Threads, rows of a batch, time and program.
    options: RunOptions,
    product: String,
    spacecraft: String,
    /// Role and digest of pipeline, mission and model.
    configuration: Vec<(&'static str, String)>,
    model: Model,
}

impl<'a> Planner<'a> {
    /// Reads pipeline, mission and model.
    ///
    /// # Errors
    /// One of them cannot be read, or the pipeline reads its telemetry with a source plugin.
    pub fn new(operations: &'a Operations, registry: &'a Registry, options: RunOptions) -> Result<Self, WorkflowError> {
        let read = |path: &PathBuf| std::fs::read_to_string(path).unwrap_or_default();
        let pipeline = Pipeline::load(&operations.pipeline).map_err(EngineError::from)?;
        if let Some((source, _)) = &pipeline.source {
            // Only MCAP files say which times they cover; a source's files are known to the source alone.
            let what = format!(
                "the pipeline {} reads its telemetry with the source {source}, whose files do not say which days they cover; \
                 calibrate each day by `dragfree run {} FILES --from DAY --until DAY --stream oper`",
                operations.pipeline.display(),
                operations.pipeline.display()
            );
            return Err(WorkflowError::Operations { path: operations.path.clone(), what });
        }
        let missing = |what| EngineError::NotNamed { what, pipeline: operations.pipeline.clone() };
        let mission = operations.mission.clone().or(pipeline.mission.clone()).ok_or_else(|| missing("mission"))?;
        let model = operations.model.clone().or(pipeline.model.clone()).ok_or_else(|| missing("model"))?;
        let spacecraft = Mission::load(&mission).map_err(EngineError::from)?.spacecraft;
        Ok(Self {
            configuration: vec![
                ("pipeline", sha256(read(&operations.pipeline))),
                ("mission", sha256(read(&mission))),
                ("model", sha256(read(&model))),
            ],
            model: Model::load(&model).map_err(EngineError::from)?,
            product: pipeline.product,
            spacecraft,
            options: RunOptions {
                pipeline: operations.pipeline.clone(),
                mission: Some(mission),
                model: Some(model),
                archive: operations.archive.clone(),
                run_in_ns: operations.run_in_ns,
                ..options
            },
            operations,
            registry,
        })
    }

    /// Spacecraft of the mission.
    pub fn spacecraft(&self) -> &str {
        &self.spacecraft
    }

    /// Telemetry that a day is made of: files that cover a part of it, and of the run-in before it.
    fn files<'f>(&self, inbox: &'f Inbox, day: NaiveDate) -> Vec<&'f InboxFile> {
        let of_day = day_ns(day);
        let with_run_in = of_day.start - self.operations.run_in_ns..of_day.end;
        let has = |file: &InboxFile, time: &Range<i64>| file.within(time.clone()).next().is_some();
        if !inbox.files.iter().any(|file| has(file, &of_day)) {
            return Vec::new();
        }
        inbox.files.iter().filter(|file| has(file, &with_run_in)).collect()
    }

    /// A day beside its newest product; none where there is no telemetry of it.
    fn look_at(&self, archive: &Archive, inbox: &Inbox, day: NaiveDate) -> Result<Option<Planned>, WorkflowError> {
        let again = |e| WorkflowError::from(EngineError::from(e));
        let files = self.files(inbox, day);
        if files.is_empty() {
            return Ok(None);
        }
        let name = day.to_string();
        let row = archive.of_day(&name, &self.spacecraft, &self.product).map_err(again)?;
        let made_of = |row: &Row| Ok::<_, ArchiveError>((archive.inputs(&row.id)?, archive.libraries(&row.id)?));
        let made_of = row.as_ref().map(made_of).transpose().map_err(again)?;
        let (reasons, same_configuration) = match (&row, &made_of) {
            (Some(row), Some((inputs, libraries))) => {
                let reasons = match archive.looks_sound(&row.id) {
                    Ok(()) => self.reasons(row, inputs, libraries, &files),
                    Err(_) => vec![format!("{} is damaged", row.id)],
                };
                (reasons, self.changed_configuration(inputs).is_empty())
            }
            _ => (vec!["it has no product".to_owned()], true),
        };
        let mut tried: Vec<String> = files.iter().map(|file| file.sha256.clone()).collect();
        tried.extend(self.configuration.iter().map(|(_, sha256)| sha256.clone()));
        tried.extend(self.libraries().into_iter().map(|(_, sha256)| sha256));
        let tried_with = sha256(tried.join("\n"));
        let failed = archive.failed(&name, &self.spacecraft).map_err(again)?;
        let failed = failed.filter(|(_, with)| *with == tried_with).map(|(reason, _)| reason);
        let of_day = day_ns(day);
        let covered = || files.iter().flat_map(|file| file.within(of_day.clone()));
        let begins = covered().any(|stretch| stretch.start <= of_day.start + EDGE_NS);
        let ends = covered().any(|stretch| of_day.end - EDGE_NS < stretch.end);
        Ok(Some(Planned {
            day: Day { day, product: row.map(|row| row.id), reasons, failed },
            files: files.into_iter().map(|file| file.path.clone()).collect(),
            whole: begins && ends,
            stream: if same_configuration { Stream::Oper } else { Stream::Rpro },
            tried_with,
        }))
    }

    /// Why a product is not what a run would give now, from what it was made of and the plugins' libraries.
    fn reasons(
        &self,
        row: &Row,
        inputs: &[Place],
        libraries: &[(String, String)],
        files: &[&InboxFile],
    ) -> Vec<String> {
        let mut reasons = Vec::new();
        let telemetry = || inputs.iter().filter(|input| input.role == "telemetry");
        let used: BTreeSet<&str> = telemetry().map(|input| input.sha256.as_str()).collect();
        let there: BTreeSet<&str> = files.iter().map(|file| file.sha256.as_str()).collect();
        let file_name = |path: &PathBuf| path.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
        let new = files.iter().filter(|file| !used.contains(file.sha256.as_str())).map(|file| file_name(&file.path));
        reasons.extend(new.map(|name| format!("telemetry {name} was not there, or was another")));
        let gone = telemetry().filter(|input| !there.contains(input.sha256.as_str()));
        reasons.extend(gone.map(|input| format!("telemetry {} is gone, or is another now", input.name)));
        reasons
            .extend(self.changed_configuration(inputs).into_iter().map(|what| format!("the {what} file has changed")));
        for (name, sha256) in self.libraries() {
            if libraries.iter().any(|(plugin, library)| *plugin == name && *library != sha256) {
                reasons.push(format!("plugin {name} is another build"));
            }
        }
        let of_day = row.day.parse().map_or(0..DAY_NS, day_ns);
        let asked = (row.asked_from_ns, row.asked_until_ns, row.run_in_ns);
        if asked != (Some(of_day.start), Some(of_day.end), self.operations.run_in_ns) {
            reasons.push("another window or another run-in was asked for".to_owned());
        }
        reasons
    }

    /// Which of pipeline, mission and model a product was not made with.
    fn changed_configuration(&self, inputs: &[Place]) -> Vec<&'static str> {
        let same =
            |role: &str, sha256: &String| inputs.iter().any(|input| input.role == role && input.sha256 == *sha256);
        let changed = self.configuration.iter().filter(|(role, sha256)| !same(role, sha256));
        changed.map(|(role, _)| *role).collect()
    }

    /// Plugins that are installed, with the digests of their libraries.
    fn libraries(&self) -> Vec<(String, String)> {
        let in_model = |id: &str| self.model.effects.iter().any(|effect| effect.id == id);
        let all = self.registry.plugins();
        let mut all: Vec<_> = all
            .filter(|found| found.info.kind != Kind::Effect || in_model(&found.info.manifest.id))
            .map(|found| (found.info.manifest.id.clone(), found.opened.sha256.clone()))
            .collect();
        all.sort();
        all
    }

    /// A digest of pipeline, mission, model and of the plugins that are installed.
    pub fn configuration_digest(&self) -> String {
        let mut all: Vec<String> = self.configuration.iter().map(|(_, sha256)| sha256.clone()).collect();
        all.extend(self.libraries().into_iter().map(|(_, sha256)| sha256));
        sha256(all.join("\n"))
    }

    /// A day with telemetry of its own, in place of that of the inbox.
    pub fn with_files(&self, day: NaiveDate, files: Vec<PathBuf>, whole: bool) -> Planned {
        let day = Day { day, product: None, reasons: Vec::new(), failed: None };
        Planned { day, files, whole, stream: Stream::Test, tried_with: self.configuration_digest() }
    }

    /// The mission file.
    pub fn mission(&self) -> Option<&PathBuf> {
        self.options.mission.as_ref()
    }

    /// Data before a day that settle the stages before the estimators, ns.
    pub fn run_in_ns(&self) -> i64 {
        self.operations.run_in_ns
    }

    /// Runs a day into an archive of its own.
    ///
    /// # Errors
    /// The run fails.
    pub fn run_apart(
        &self,
        planned: &Planned,
        archive: &Path,
        progress: &mut dyn FnMut(Progress),
    ) -> Result<Written, EngineError> {
        run(self.registry, &RunOptions { archive: archive.to_owned(), ..self.of(planned) }, progress)
    }

    fn of(&self, planned: &Planned) -> RunOptions {
        let of_day = day_ns(planned.day.day);
        RunOptions {
            files: planned.files.clone(),
            from_ns: Some(of_day.start),
            until_ns: Some(of_day.end),
            stream: planned.stream,
            status: if planned.whole { Status::Final } else { Status::Quicklook },
            ..self.options.clone()
        }
    }

    /// Runs a day. A day that gives no product is noted in the archive, so that the next one goes on; where another
    /// attempt may succeed it is not, so that the next program runs the day again.
    ///
    /// # Errors
    /// The archive cannot be written, or somebody asked to stop.
    pub fn run(&self, planned: &Planned, progress: &mut dyn FnMut(Progress)) -> Result<Ran, WorkflowError> {
        let day = planned.day.day;
        match run(self.registry, &self.of(planned), progress) {
            Ok(written) => Ok(Ran { day, outcome: Outcome::Product(Box::new(written)) }),
            Err(stopped @ (EngineError::Stopped | EngineError::Archive(_))) => Err(stopped.into()),
            Err(error) => {
                let reason = error.to_string();
                if error.may_pass() {
                    return Ok(Ran { day, outcome: Outcome::Failed(reason) });
                }
                let stamp = Stamp { time: self.options.created, software: &self.options.software };
                let keep = || {
                    let mut archive = Archive::create(&self.operations.archive)?;
                    archive.keep_failure((&day.to_string(), &self.spacecraft), &reason, &planned.tried_with, &stamp)
                };
                keep().map_err(EngineError::from)?;
                Ok(Ran { day, outcome: Outcome::Failed(reason) })
            }
        }
    }
}

/// Told how far a day has come.
pub type Report = Box<dyn FnMut(Progress)>;

/// Every day that there is telemetry of, in order.
///
/// # Errors
/// The archive cannot be read.
pub fn plan(planner: &Planner<'_>, archive: &Archive, inbox: &Inbox) -> Result<Vec<Planned>, WorkflowError> {
    let mut days = BTreeSet::new();
    for file in &inbox.files {
        days.extend(file.days().flatten().map(day_of_number));
    }
    let mut planned = Vec::new();
    for day in days {
        planned.extend(planner.look_at(archive, inbox, day)?);
    }
    Ok(planned)
}

/// Runs in order every day up to `until` that has no product or one that would come out otherwise now; a day that
/// failed with the same inputs is left out. `begins` is told a day before it is run, and `ran` at once what came of it:
/// a later day may end the program.
///
/// # Errors
/// The archive cannot be read or written, or somebody asked to stop.
pub fn catch_up(
    planner: &Planner<'_>,
    inbox: &Inbox,
    until: Option<NaiveDate>,
    begins: &mut dyn FnMut(&Planned) -> Report,
    ran: &mut dyn FnMut(&Planned, Ran),
) -> Result<(), WorkflowError> {
    let archive = Archive::create(&planner.operations.archive).map_err(EngineError::from)?;
    let days = plan(planner, &archive, inbox)?;
    drop(archive);
    let due = |planned: &&Planned| {
        let day = &planned.day;
        !day.reasons.is_empty() && day.failed.is_none() && until.is_none_or(|until| day.day <= until)
    };
    for planned in days.iter().filter(due) {
        let mut progress = begins(planned);
        let done = planner.run(planned, &mut *progress)?;
        drop(progress);
        ran(planned, done);
    }
    Ok(())
}

/// The time of a day, Unix ns.
fn day_ns(day: NaiveDate) -> Range<i64> {
    let start = start_of_day_ns(day_number(day));
    start..start + DAY_NS
}
