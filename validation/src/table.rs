//! The paper's table: 25 days in three noise regimes, their first day alone, and the information bounds.

use dragfree_physics::mission::Mission;
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

use crate::bound::Case;
use crate::campaign::{Meter, ScratchFolder, note, parse, science_mode, work};
use crate::error::{CampaignError, file};
use crate::program::{Chain, Program, line, root};
use crate::records::{Keyed, Line, Results, rounded};

/// A noise regime.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Regime {
    /// Name of its results.
    pub(crate) name: &'static str,
    /// Description in the report.
    pub(crate) words: &'static str,
    mission: MissionFile,
}

#[derive(Clone, Copy, Debug)]
enum MissionFile {
    Fixture(&'static str),
    /// Scaled amplitude of the default mission, if any.
    Scaled(&'static str, f64),
}

/// The regimes.
pub(crate) const REGIMES: [Regime; 3] = [
    Regime { name: "default", words: "default noise", mission: MissionFile::Fixture("taiji.toml") },
    Regime {
        name: "quiet-dws",
        words: "quieter long-arm wavefront sensing, 2.09e-10 rad/√Hz",
        mission: MissionFile::Scaled("dws_long_arm", 2.09e-10 / 5e-10),
    },
    Regime {
        name: "thrusters",
        words: "nine thrusters with lag and noise of their own, which pushes and turns at once",
        mission: MissionFile::Fixture("taiji-thrusters.toml"),
    },
];

/// A run with its information bounds.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Row {
    /// The run.
    pub(crate) run: Line,
    /// True offsets, m.
    pub(crate) truth_m: [f64; 6],
    /// Bound of σ by one test mass alone, m.
    pub(crate) single_m: [f64; 6],
    /// Bound of σ by both test masses and the survey, m.
    pub(crate) surveyed_m: [f64; 6],
}

impl Keyed for Row {
    fn key(&self) -> (String, u32) {
        self.run.key()
    }

    fn made_with(&self) -> &str {
        self.run.made_with()
    }
}

/// Name of a configuration.
pub(crate) fn configuration(regime: &str, days: u32) -> String {
    format!("{regime}, {days} days")
}

/// Reads a mission file.
pub(crate) fn mission(path: &Path) -> Result<Mission, CampaignError> {
    let text = serde_json::to_string(&parse(path)?).map_err(|e| file(path, &e))?;
    Mission::from_json(&text).map_err(|e| file(path, &e))
}

struct Task {
    regime: Regime,
    path: PathBuf,
    seed: u32,
    lengths: Vec<u32>,
}

/// Runs what `results` lacks, `at_once` regimes in parallel; 25 days of one take 14 GB of `scratch`.
/// After an error the results so far are on disk, and the next call continues.
pub(crate) fn table(
    program: &Program,
    seeds: &[u32],
    days: u32,
    at_once: usize,
    results: &Path,
    scratch: &Path,
) -> Result<(), CampaignError> {
    let build = program.digest()?;
    // Two threads each, so that the last regime uses both cores.
    let program = program.with_threads(2);
    let (results, dropped) = Results::<Row>::open(results, &build)?;
    if dropped > 0 {
        note(&format!("{dropped} rows of another build are dropped and measured again"));
    }
    let scratch_folder = ScratchFolder::new(scratch)?;
    let mut tasks = Vec::new();
    for (regime, seed) in REGIMES.iter().flat_map(|r| seeds.iter().map(move |s| (r, *s))) {
        let mut lengths = vec![1, days];
        lengths.dedup();
        lengths.retain(|days| !results.has(&configuration(regime.name, *days), seed));
        let path = match regime.mission {
            MissionFile::Fixture(name) => root().join("fixtures/missions").join(name),
            MissionFile::Scaled(noise, factor) => scratch_folder.mission(regime.name, &[(noise, factor)], None)?,
        };
        if !lengths.is_empty() {
            tasks.push(Task { regime: *regime, path, seed, lengths });
        }
    }
    let meter = Meter::new(tasks.len() as f64);
    work(tasks, at_once, |task| {
        let case = Case::of(&mission(&task.path)?)?;
        let folder = scratch_folder.path(&format!("{}-{}", task.regime.name, task.seed));
        let longest = task.lengths.iter().copied().fold(1, u32::max);
        let arguments = ["--days", &longest.to_string(), "--seed", &task.seed.to_string()].map(str::to_owned);
        let simulated = program.simulate(&task.path, &folder, &arguments)?;
        let chain = Chain { pipeline: science_mode(), mission: Some(task.path.clone()), model: None };
        for days in &task.lengths {
            let name = configuration(task.regime.name, *days);
            let archive = folder.join(format!("archive-{days}"));
            let product = program.run(&chain, &simulated.files[..*days as usize], &archive)?;
            let run = line(&name, task.seed, &build, &simulated.truth_m, &product)
                .map_err(|what| CampaignError::Product { configuration: name.clone(), seed: task.seed, what })?;
            let bound = case.bound(86_400.0 * f64::from(*days))?;
            let row = Row {
                run,
                truth_m: simulated.truth_m.map(rounded),
                single_m: std::array::from_fn(|i| rounded(bound.single_m[i])),
                surveyed_m: std::array::from_fn(|i| rounded(bound.surveyed_m[i])),
            };
            results.append(row)?;
        }
        std::fs::remove_dir_all(&folder).map_err(|e| file(&folder, &e))?;
        meter.say(1.0, &format!("{}, seed {}", task.regime.name, task.seed));
        Ok(())
    })?;
    let order: Vec<String> = REGIMES.iter().flat_map(|r| [days, 1].map(|days| configuration(r.name, days))).collect();
    results.sort(&order).map(drop)
}
