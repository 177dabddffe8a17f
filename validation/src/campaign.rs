//! The coverage campaign: many seeds of one day, and twins with a deliberate error.
//!
//! A **twin** runs in two configurations: *unprotected*, without the features that correct a wrong mission file, where
//! the statistics must fail if the tests have power; and *product*, where they should pass. Twins are six hours long
//! and have a wide prior of the offsets, so that the data dominate.

use std::collections::VecDeque;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::sync::Mutex;
use std::time::Instant;

use crate::error::{CampaignError, file};
use crate::program::{Chain, Program, line, root};
use crate::records::{Line, Results};

/// Length of a twin, h.
pub(crate) const TWIN_HOURS: f64 = 6.0;
/// Number of seeds of the twins.
pub(crate) const TWIN_SEEDS: u32 = 40;

/// A twin.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Twin {
    /// Name; the configuration adds `unprotected` or `product`.
    pub(crate) name: &'static str,
    /// Description in the report.
    pub(crate) words: &'static str,
    /// Noise tables whose PSD is scaled by a factor in the mission file of `run`.
    pub(crate) scaled: Option<(&'static [&'static str], f64)>,
    /// Effects in the simulation that the model lacks.
    pub(crate) effects: &'static [&'static str],
    /// Whether it also runs as the product.
    pub(crate) with_product: bool,
    /// Seeds.
    pub(crate) seeds: u32,
}

const THRUST: &[&str] = &["thruster_force", "thruster_torque"];
const READOUTS: &[&str] = &["ifo_x", "is_x", "is_y", "is_z", "is_angle", "dws_local", "dws_long_arm"];
const LOUD_IS: &[&str] = &["is-noise:tm1.y=2", "is-noise:tm1.z=2", "is-noise:tm2.y=2", "is-noise:tm2.z=2"];

const fn twin(name: &'static str, words: &'static str, scaled: Option<(&'static [&'static str], f64)>) -> Twin {
    Twin { name, words, scaled, effects: &[], with_product: true, seeds: TWIN_SEEDS }
}

/// A twin of one noise alone, unprotected only.
const fn alone(name: &'static str, words: &'static str, noise: &'static [&'static str], power: f64) -> Twin {
    Twin { with_product: false, seeds: TWIN_SEEDS / 2, ..twin(name, words, Some((noise, power))) }
}

/// All twins; the first is the control, without error.
pub(crate) const TWINS: [Twin; 9] = [
    twin("control", "nothing wrong", None),
    twin("q-times-10", "thrust noise believed 10 times in power (Q×10)", Some((THRUST, 10.0))),
    twin("q-over-10", "thrust noise believed 1/10 (Q/10)", Some((THRUST, 0.1))),
    twin("r-times-10", "readout noise believed 10 times (R×10)", Some((READOUTS, 10.0))),
    Twin { effects: LOUD_IS, ..twin("is-noise-times-2", "capacitive noise doubled in truth", None) },
    alone("force-times-10", "force noise alone believed 10 times", &["thruster_force"], 10.0),
    alone("force-over-10", "force noise alone believed 1/10", &["thruster_force"], 0.1),
    alone("torque-times-10", "torque noise alone believed 10 times", &["thruster_torque"], 10.0),
    alone("torque-over-10", "torque noise alone believed 1/10", &["thruster_torque"], 0.1),
];

impl Twin {
    /// Name of its unprotected configuration.
    pub(crate) fn unprotected(&self) -> String {
        format!("{} unprotected", self.name)
    }

    /// Name of its product configuration.
    pub(crate) fn product(&self) -> String {
        format!("{} product", self.name)
    }
}

/// Name of the configuration without twin.
pub(crate) const NOMINAL: &str = "nominal";

/// All configurations in the order of the results.
pub(crate) fn configurations() -> Vec<String> {
    std::iter::once(NOMINAL.to_owned()).chain(TWINS.iter().flat_map(|t| [t.unprotected(), t.product()])).collect()
}

/// Folder with the files of the chains.
pub(crate) struct ScratchFolder {
    folder: PathBuf,
}

fn write(path: &Path, text: &str) -> Result<(), CampaignError> {
    std::fs::write(path, text).map_err(|e| file(path, &e))
}

pub(crate) fn parse(path: &Path) -> Result<toml::Table, CampaignError> {
    std::fs::read_to_string(path).map_err(|e| file(path, &e))?.parse().map_err(|e| file(path, &e))
}

/// The default mission.
pub(crate) fn taiji() -> PathBuf {
    root().join("fixtures/missions/taiji.toml")
}

/// The default pipeline.
pub(crate) fn science_mode() -> PathBuf {
    root().join("fixtures/pipelines/science-mode.toml")
}

/// Multiplies the amplitude spectral density of a `[noise]` table.
fn scale_asd(mission: &mut toml::Table, noise: &str, factor: f64) -> Option<()> {
    let table = mission.get_mut("noise")?.as_table_mut()?.get_mut(noise)?.as_table_mut()?;
    let (_, asd) = table.iter_mut().find(|(key, _)| key.starts_with("asd_"))?;
    *asd = toml::Value::Float(asd.as_float()? * factor);
    Some(())
}

impl ScratchFolder {
    /// An empty folder for telemetry and archives, and the files of the chains.
    pub(crate) fn new(folder: &Path) -> Result<Self, CampaignError> {
        // Removes telemetry of an interrupted run, half a gigabyte a day.
        if folder.exists() {
            std::fs::remove_dir_all(folder).map_err(|e| file(folder, &e))?;
        }
        std::fs::create_dir_all(folder).map_err(|e| file(folder, &e))?;
        Ok(Self { folder: folder.to_owned() })
    }

    pub(crate) fn path(&self, name: &str) -> PathBuf {
        self.folder.join(name)
    }

    /// The default mission with scaled amplitudes, `(noise, factor)`.
    pub(crate) fn mission(
        &self,
        name: &str,
        amplitudes: &[(&str, f64)],
        controllers: Option<&Path>,
    ) -> Result<PathBuf, CampaignError> {
        let mut mission = parse(&taiji())?;
        if let Some(frozen) = controllers {
            // The controllers were designed for the truth; only the stated noise changes.
            mission.extend(parse(frozen)?);
        }
        for (noise, factor) in amplitudes {
            scale_asd(&mut mission, noise, *factor).ok_or_else(|| file(&taiji(), &format!("no noise {noise}")))?;
        }
        let path = self.path(&format!("{name}.toml"));
        write(&path, &mission.to_string())?;
        Ok(path)
    }

    /// The chain of a twin, unprotected or as the product.
    fn chain(&self, program: &Program, twin: &Twin, protected: bool) -> Result<Chain, CampaignError> {
        let mut chain = Chain { pipeline: science_mode(), ..Chain::default() };
        if !protected {
            let mut pipeline = parse(&chain.pipeline)?;
            let stages = pipeline.get_mut("stage").and_then(toml::Value::as_array_mut);
            for stage in stages.into_iter().flatten().filter_map(toml::Value::as_table_mut) {
                let off = match stage.get("plugin").and_then(toml::Value::as_str) {
                    // Without adaptation the covariance of the recursion is that of its gains.
                    Some("es-akf") => "adaptation = \"off\"\ngate_sigma = 0.0\ncalibrated_sigma = false",
                    Some("qp-check") => "refinements = 0",
                    _ => continue,
                };
                let off: toml::Table = off.parse().map_err(|e| file(&chain.pipeline, &e))?;
                stage.insert("parameters".to_owned(), off.into());
            }
            // Relative paths start at the pipeline's folder.
            for (key, path) in [("mission", taiji()), ("model", root().join("fixtures/models/com-offset.toml"))] {
                let header = pipeline.get_mut("pipeline").and_then(toml::Value::as_table_mut);
                let header = header.ok_or_else(|| file(&chain.pipeline, &"no table [pipeline]"))?;
                header.insert(key.to_owned(), path.to_string_lossy().into_owned().into());
            }
            chain.pipeline = self.path("unprotected.toml");
            write(&chain.pipeline, &pipeline.to_string())?;
        }
        if let Some((noises, power)) = twin.scaled {
            let frozen = self.path("controllers.toml");
            if !frozen.exists() {
                program.freeze(&taiji(), &frozen)?;
            }
            let amplitudes: Vec<(&str, f64)> = noises.iter().map(|n| (*n, power.sqrt())).collect();
            chain.mission = Some(self.mission(twin.name, &amplitudes, Some(&frozen))?);
        }
        let model = self.path("wide-prior.toml");
        let mut text = "[model]\nrevision = \"wide-prior\"\n".to_owned();
        for instance in ["tm1", "tm2"] {
            let _ = writeln!(text, "\n[[effect]]\nid = \"com-offset\"\ninstance = \"{instance}\"\nestimate = true");
            for axis in ["x", "y", "z"] {
                let _ = writeln!(text, "prior.{axis} = {{ sigma = 1.0 }}");
            }
        }
        write(&model, &text)?;
        chain.model = Some(model);
        Ok(chain)
    }
}

/// One simulation, with the configurations that use it.
struct Task {
    seed: u32,
    hours: f64,
    effects: &'static [&'static str],
    runs: Vec<(String, Chain)>,
}

impl Task {
    /// Approximate cost, hours of data.
    fn weight(&self) -> f64 {
        self.hours * (0.5 + self.runs.len() as f64)
    }
}

/// Progress on stderr.
pub(crate) struct Meter {
    start: Instant,
    total: f64,
    done: Mutex<f64>,
}

impl Meter {
    pub(crate) fn new(total: f64) -> Self {
        Self { start: Instant::now(), total, done: Mutex::new(0.0) }
    }

    pub(crate) fn say(&self, weight: f64, what: &str) {
        let Ok(mut done) = self.done.lock() else { return };
        *done += weight;
        let elapsed = self.start.elapsed().as_secs_f64();
        let left = elapsed * (self.total / *done - 1.0);
        note(&format!("{:5.1} %  {elapsed:5.0} s, {left:5.0} s to go  {what}", 100.0 * *done / self.total));
    }
}

/// A line on stderr.
pub(crate) fn note(text: &str) {
    use std::io::Write as _;
    let _ = writeln!(std::io::stderr(), "{text}"); // no way to report a failing stderr
}

/// Runs tasks on `at_once` threads.
pub(crate) fn work<T: Send>(
    tasks: Vec<T>,
    at_once: usize,
    each: impl Fn(T) -> Result<(), CampaignError> + Sync,
) -> Result<(), CampaignError> {
    let queue = Mutex::new(VecDeque::from(tasks));
    let failed = Mutex::new(None);
    std::thread::scope(|scope| {
        for _ in 0..at_once {
            scope.spawn(|| {
                while let Some(task) = queue.lock().ok().and_then(|mut q| q.pop_front()) {
                    if let Err(error) = each(task) {
                        // The first failure ends the campaign; results on disk stay.
                        if let (Ok(mut queue), Ok(mut failed)) = (queue.lock(), failed.lock()) {
                            queue.clear();
                            failed.get_or_insert(error);
                        }
                    }
                }
            });
        }
    });
    failed.into_inner().ok().flatten().map_or(Ok(()), Err)
}

/// Runs the seeds that `results` lacks, and the twins of those seeds.
/// After an error the results so far are on disk, and the next call continues.
pub(crate) fn coverage(
    program: &Program,
    seeds: std::ops::RangeInclusive<u32>,
    results: &Path,
    scratch: &Path,
) -> Result<(), CampaignError> {
    let build = program.digest()?;
    let (results, dropped) = Results::<Line>::open(results, &build)?;
    if dropped > 0 {
        note(&format!("{dropped} results of another build are dropped and measured again"));
    }
    let scratch_folder = ScratchFolder::new(scratch)?;
    let nominal = Chain { pipeline: science_mode(), ..Chain::default() };
    let mut twins = Vec::new();
    for twin in &TWINS {
        twins.push((twin, twin.unprotected(), scratch_folder.chain(program, twin, false)?));
        if twin.with_product {
            twins.push((twin, twin.product(), scratch_folder.chain(program, twin, true)?));
        }
    }
    let mut tasks = Vec::new();
    for seed in seeds {
        let mut add = |hours: f64, effects: &'static [&'static str], runs: Vec<(String, Chain)>| {
            let runs: Vec<_> = runs.into_iter().filter(|(name, _)| !results.has(name, seed)).collect();
            if !runs.is_empty() {
                tasks.push(Task { seed, hours, effects, runs });
            }
        };
        add(24.0, &[], vec![(NOMINAL.to_owned(), nominal.clone())]);
        for effects in [&[] as &[&str], LOUD_IS] {
            let of_seed = twins.iter().filter(|(twin, _, _)| twin.effects == effects && seed <= twin.seeds);
            add(TWIN_HOURS, effects, of_seed.map(|(_, name, chain)| (name.clone(), chain.clone())).collect());
        }
    }
    let meter = Meter::new(tasks.iter().map(Task::weight).sum());
    // Two single-threaded days in parallel are faster than two days in sequence on two threads.
    work(tasks, 2, |task| {
        let weight = task.weight();
        let name = format!("seed-{}-{}-{}", task.seed, task.hours, task.effects.len());
        let folder = scratch_folder.path(&name);
        let mut arguments: Vec<String> =
            ["--hours", &task.hours.to_string(), "--seed", &task.seed.to_string()].map(str::to_owned).to_vec();
        arguments.extend(task.effects.iter().flat_map(|e| ["--effect".to_owned(), (*e).to_owned()]));
        let simulated = program.simulate(&taiji(), &folder, &arguments)?;
        for (i, (configuration, chain)) in task.runs.into_iter().enumerate() {
            let product = program.run(&chain, &simulated.files, &folder.join(format!("archive-{i}")))?;
            let found = line(&configuration, task.seed, &build, &simulated.truth_m, &product)
                .map_err(|what| CampaignError::Product { configuration, seed: task.seed, what })?;
            results.append(found)?;
        }
        std::fs::remove_dir_all(&folder).map_err(|e| file(&folder, &e))?;
        meter.say(weight, &name);
        Ok(())
    })?;
    results.sort(&configurations()).map(drop)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_belief_changes_only_the_noise() {
        let mut mission = parse(&taiji()).unwrap();
        let before = mission.clone();
        scale_asd(&mut mission, "thruster_force", 10.0_f64.sqrt()).unwrap();
        let asd = |m: &toml::Table| m["noise"]["thruster_force"]["asd_n_rthz"].as_float().unwrap();
        assert!(((asd(&mission) / asd(&before)).powi(2) - 10.0).abs() < 1e-12);
        mission["noise"]["thruster_force"]["asd_n_rthz"] = toml::Value::Float(asd(&before));
        assert_eq!(mission, before);
        assert!(scale_asd(&mut mission, "no-such-noise", 2.0).is_none());
        assert!(THRUST.iter().chain(READOUTS).all(|n| scale_asd(&mut mission, n, 1.0).is_some()));
    }

    /// Twins have distinct names, and the first is the control.
    #[test]
    fn twins_have_distinct_names() {
        let names = configurations();
        let distinct: std::collections::BTreeSet<&String> = names.iter().collect();
        assert_eq!(distinct.len(), names.len());
        assert!(TWINS[0].scaled.is_none() && TWINS[0].effects.is_empty());
        assert!(TWINS[1..].iter().all(|t| t.scaled.is_some() || !t.effects.is_empty()));
    }

    #[test]
    fn work_runs_each_task_once_and_stops_at_a_failure() {
        let done = Mutex::new(Vec::new());
        work((0..50).collect(), 2, |i| {
            done.lock().unwrap().push(i);
            Ok(())
        })
        .unwrap();
        let mut done = done.into_inner().unwrap();
        done.sort_unstable();
        assert_eq!(done, (0..50).collect::<Vec<i32>>());
        let tried = Mutex::new(0);
        let error = work((0..50).collect::<Vec<u32>>(), 2, |i| {
            *tried.lock().unwrap() += 1;
            if i == 3 {
                Err(file(Path::new("f"), &"full"))
            } else {
                std::thread::sleep(std::time::Duration::from_millis(2));
                Ok(())
            }
        });
        assert!(error.is_err() && *tried.lock().unwrap() < 50);
    }
}
