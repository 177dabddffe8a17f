//! The program under test, called as a user calls it: `dragfree simulate`, then `dragfree run`.

use serde_json::Value;
use sha2::{Digest as _, Sha256};
use std::collections::BTreeMap;
use std::ffi::OsStr;
use std::path::{Path, PathBuf};
use std::process::Command;

use dragfree_engine::telemetry::first_message;

use crate::records::{COEFFICIENTS, Line, Solution, rounded};

/// Error of a run.
#[derive(Debug, thiserror::Error)]
pub enum ProgramError {
    /// The program did not start.
    #[error("{command}: {source}")]
    Start {
        /// What was called.
        command: String,
        /// Why.
        source: std::io::Error,
    },
    /// The program failed.
    #[error("{command}: {status}\n{message}")]
    Failed {
        /// What was called.
        command: String,
        /// Exit status.
        status: std::process::ExitStatus,
        /// Its message.
        message: String,
    },
    /// The output has another form than expected.
    #[error("{command}: {what} is missing in what it printed")]
    Answer {
        /// What was called.
        command: String,
        /// Missing part.
        what: String,
    },
    /// A file of the run cannot be read or removed.
    #[error("{path}: {reason}", path = path.display())]
    File {
        /// The file.
        path: PathBuf,
        /// Why.
        reason: String,
    },
}

/// The repository.
#[must_use]
pub fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap_or(Path::new("."))
}

/// The built program.
#[derive(Clone, Debug)]
pub struct Program {
    exe: PathBuf,
    threads: usize,
}

/// Telemetry of a simulation, from which the truth was read and removed before any calibration.
#[derive(Clone, Debug)]
pub struct Simulated {
    /// The files, oldest first.
    pub files: Vec<PathBuf>,
    /// True offsets, m.
    pub truth_m: [f64; 6],
}

/// Telemetry of a simulation with hidden effects, and its sealed truth in another folder.
#[derive(Clone, Debug)]
pub struct Hidden {
    /// The files, oldest first.
    pub files: Vec<PathBuf>,
    /// The sealed file.
    pub sealed: PathBuf,
    /// True offsets, m.
    pub truth_m: [f64; 6],
}

/// Inputs of `run` besides the telemetry.
#[derive(Clone, Debug, Default)]
pub struct Chain {
    /// Pipeline file.
    pub pipeline: PathBuf,
    /// Mission file in place of the pipeline's.
    pub mission: Option<PathBuf>,
    /// Model file in place of the pipeline's.
    pub model: Option<PathBuf>,
}

impl Program {
    /// Builds program and plugins, so that the measured program is current.
    ///
    /// # Errors
    /// [`ProgramError`]: the workspace does not build.
    pub fn build() -> Result<Self, ProgramError> {
        let folder = std::env::current_exe()
            .map_err(|source| ProgramError::Start { command: "this program".to_owned(), source })?
            .parent()
            .map(Path::to_owned)
            .unwrap_or_default();
        let cargo = std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into());
        let mut build = Command::new(cargo);
        build.current_dir(root()).args(["build", "--quiet", "--release", "--workspace", "--lib", "--bins"]);
        if let Some(target) = folder.parent() {
            build.arg("--target-dir").arg(target);
        }
        output(&mut build, &[0])?;
        Ok(Self { exe: folder.join(format!("dragfree{}", std::env::consts::EXE_SUFFIX)), threads: 1 })
    }

    /// The same program with a number of threads for each run; the default is one.
    #[must_use]
    pub fn with_threads(&self, threads: usize) -> Self {
        Self { exe: self.exe.clone(), threads }
    }

    fn command(&self) -> Command {
        let mut command = Command::new(&self.exe);
        command.current_dir(root()).env_remove("DRAGFREE_PLUGIN_PATH").env("NO_COLOR", "1").arg("--quiet");
        command.arg("--threads").arg(self.threads.to_string());
        command
    }

    /// Digest of the plugins' libraries, which identifies a build.
    ///
    /// # Errors
    /// [`ProgramError`].
    pub fn digest(&self) -> Result<String, ProgramError> {
        let mut command = self.command();
        let answer = json(command.args(["plugins", "list", "--json"]), &[0])?;
        let plugins = answer["plugins"].as_array().ok_or_else(|| missing(&command, "plugins"))?;
        let mut digests: Vec<&str> = plugins.iter().filter_map(|p| p["sha256"].as_str()).collect();
        digests.sort_unstable();
        let digest = Sha256::digest(digests.concat());
        Ok(digest.iter().take(6).map(|byte| format!("{byte:02x}")).collect())
    }

    /// Writes the controllers designed for a mission to a file with the section `control`.
    ///
    /// # Errors
    /// [`ProgramError`].
    pub fn freeze(&self, mission: &Path, to: &Path) -> Result<(), ProgramError> {
        output(self.command().arg("design").arg(mission).arg("--freeze").arg(to), &[0]).map(|_| ())
    }

    /// Simulates into a new folder, reads the truth and removes it.
    ///
    /// # Errors
    /// [`ProgramError`].
    pub fn simulate(
        &self,
        mission: &Path,
        folder: &Path,
        arguments: &[impl AsRef<OsStr>],
    ) -> Result<Simulated, ProgramError> {
        let mut command = self.command();
        command.arg("simulate").arg(mission).arg("--out").arg(folder).args(arguments).arg("--json");
        let made = json(&mut command, &[0])?;
        let paths = |key: &str| -> Vec<PathBuf> {
            made[key].as_array().into_iter().flatten().filter_map(Value::as_str).map(PathBuf::from).collect()
        };
        let truth_files = paths("truth_files");
        let first = truth_files.first().ok_or_else(|| missing(&command, "truth_files"))?;
        let truth_m = offsets_m(first)?;
        for path in &truth_files {
            std::fs::remove_file(path).map_err(|e| ProgramError::File { path: path.clone(), reason: e.to_string() })?;
        }
        Ok(Simulated { files: paths("files"), truth_m })
    }

    /// Simulates with hidden effects into `folder` and moves the truth away; `noise` is the seed of everything else.
    ///
    /// # Errors
    /// [`ProgramError`].
    pub fn hide(
        &self,
        mission: &Path,
        folder: &Path,
        [hidden, noise]: [u32; 2],
        hours: f64,
    ) -> Result<Hidden, ProgramError> {
        let (telemetry, away) = (folder.join("telemetry"), folder.join("sealed"));
        let mut command = self.command();
        command.arg("simulate").arg(mission).arg("--out").arg(&telemetry).arg("--json");
        for (option, value) in
            [("--hidden", hidden.to_string()), ("--seed", noise.to_string()), ("--hours", hours.to_string())]
        {
            command.args([option, &value]);
        }
        let made = json(&mut command, &[0])?;
        let sealed = made["sealed_file"].as_str().map(Path::new).ok_or_else(|| missing(&command, "sealed_file"))?;
        let file = |reason: String| ProgramError::File { path: sealed.to_owned(), reason };
        let (Some(truth), Some(name)) = (sealed.parent(), sealed.file_name()) else {
            return Err(file("it has no folder".to_owned()));
        };
        std::fs::rename(truth, &away).map_err(|e| file(e.to_string()))?;
        let all = |key: &str| made[key].as_array().into_iter().flatten().filter_map(Value::as_str).map(PathBuf::from);
        let moved = all("truth_files").find_map(|path| Some(away.join(path.file_name()?)));
        let truth_m = offsets_m(&moved.ok_or_else(|| missing(&command, "truth_files"))?)?;
        Ok(Hidden { files: all("files").collect(), sealed: away.join(name), truth_m })
    }

    /// Runs `dragfree model` with arguments.
    ///
    /// # Errors
    /// [`ProgramError`].
    pub fn model(&self, words: &[&OsStr]) -> Result<(), ProgramError> {
        output(self.command().arg("model").args(words), &[0]).map(|_| ())
    }

    /// Runs `dragfree diagnose` on a product.
    ///
    /// # Errors
    /// [`ProgramError`].
    pub fn diagnose(&self, product: &Value, archive: &Path) -> Result<Value, ProgramError> {
        let mut command = self.command();
        let id = product["id"].as_str().ok_or_else(|| missing(&command, "id"))?;
        command.arg("diagnose").arg(id).arg("--archive").arg(archive).arg("--json");
        json(&mut command, &[0, 4])
    }

    /// Runs `dragfree reveal`, which scores a diagnosis against the sealed truth.
    ///
    /// # Errors
    /// [`ProgramError`].
    pub fn reveal(&self, hidden: &Hidden, diagnosis: &Path) -> Result<Value, ProgramError> {
        let mut command = self.command();
        command.arg("reveal").arg(&hidden.sealed).arg("--diagnosis").arg(diagnosis);
        command.args(hidden.files.iter().flat_map(|file| [OsStr::new("--telemetry"), file.as_os_str()]));
        Ok(json(command.arg("--json"), &[0])?["score"].take())
    }

    /// Runs a chain over telemetry and returns the product as JSON. Exit codes for lost data and an inconsistent model
    /// are accepted.
    ///
    /// # Errors
    /// [`ProgramError`].
    pub fn run(&self, chain: &Chain, files: &[PathBuf], archive: &Path) -> Result<Value, ProgramError> {
        let mut command = self.command();
        command.arg("run").arg(&chain.pipeline).args(files).arg("--archive").arg(archive).arg("--json");
        for (option, path) in [("--mission", &chain.mission), ("--model", &chain.model)] {
            if let Some(path) = path {
                command.arg(option).arg(path);
            }
        }
        json(&mut command, &[0, 3, 4])
    }
}

/// True offsets, m, in a simulation's truth.
fn offsets_m(truth: &Path) -> Result<[f64; 6], ProgramError> {
    let file = |reason: String| ProgramError::File { path: truth.to_owned(), reason };
    let first = first_message(truth, "/truth").map_err(|e| file(e.to_string()))?;
    let mut truth_m = [0.0; 6];
    for (i, value) in truth_m.iter_mut().enumerate() {
        let key = format!("b{}_orf_m.{}", i / 3 + 1, ["x", "y", "z"][i % 3]);
        *value = *first.get(&key).ok_or_else(|| file(format!("it has no {key}")))?;
    }
    Ok(truth_m)
}

fn output(command: &mut Command, codes: &[i32]) -> Result<Vec<u8>, ProgramError> {
    let name = format!("{command:?}");
    let output = command.output().map_err(|source| ProgramError::Start { command: name.clone(), source })?;
    match output.status.code() {
        Some(code) if codes.contains(&code) => Ok(output.stdout),
        _ => Err(ProgramError::Failed {
            command: name,
            status: output.status,
            message: String::from_utf8_lossy(&output.stderr).into_owned(),
        }),
    }
}

fn json(command: &mut Command, codes: &[i32]) -> Result<Value, ProgramError> {
    let text = output(command, codes)?;
    serde_json::from_slice(&text).map_err(|_| missing(command, "a JSON document"))
}

fn missing(command: &Command, what: &str) -> ProgramError {
    ProgramError::Answer { command: format!("{command:?}"), what: what.to_owned() }
}

/// The result of a product.
///
/// # Errors
/// The name of what the product lacks.
pub fn line(configuration: &str, seed: u32, build: &str, truth_m: &[f64; 6], product: &Value) -> Result<Line, String> {
    let number = |value: &Value, what: &str| value.as_f64().ok_or_else(|| what.to_owned());
    let text = |key: &str| product[key].as_str().map(str::to_owned).ok_or_else(|| key.to_owned());
    let stage = &product["quality"]["stages"]["es-akf"];
    let sigma_stretch = [
        number(&stage["tm1"]["sigma_stretch"], "sigma_stretch of tm1")?,
        number(&stage["tm2"]["sigma_stretch"], "sigma_stretch of tm2")?,
    ];
    let mut p_end_sigma_m = [0.0; 6];
    for (sigma, name) in p_end_sigma_m.iter_mut().zip(COEFFICIENTS) {
        *sigma = rounded(number(&stage["p_end_sigma"][name], "p_end_sigma")?);
    }
    let solution = |label: &str| solution(product, label, truth_m);
    let qp = solution("qp")?;
    let adopted = Some(solution("adopted")?).filter(|adopted| *adopted != qp);
    let span_ns =
        number(&product["stop_time_epoch_ns"], "stop time")? - number(&product["start_time_epoch_ns"], "start time")?;
    Ok(Line {
        configuration: configuration.to_owned(),
        seed,
        hours: (span_ns / 3.6e12 * 1000.0).round() / 1000.0,
        date: text("date_created")?.chars().take(10).collect(),
        software: text("software_version")?,
        build: build.to_owned(),
        verdict: text("verdict")?,
        nis: rounded(number(&product["nis"], "nis")?),
        nis_dof: 3.0 * number(&product["quality"]["counts"]["es-akf"]["updates"], "updates")?,
        chi2_per_dof: rounded(number(&product["chi2_per_dof"], "chi2_per_dof")?),
        sigma_stretch: sigma_stretch.map(rounded),
        qp_widened: qp_widened(product)?.map(rounded),
        p_end_sigma_m,
        es_akf: solution("es-akf")?,
        qp,
        adopted,
    })
}

/// Inflation of each σ by `qp-check`.
fn qp_widened(product: &Value) -> Result<[f64; 6], String> {
    let widened = &product["quality"]["stages"]["qp-check"]["widened"];
    let mut all = [1.0; 6];
    for (factor, name) in all.iter_mut().zip(COEFFICIENTS) {
        *factor = widened[name].as_f64().ok_or_else(|| format!("widened {name}"))?;
    }
    Ok(all)
}

/// One solution of a product.
///
/// # Errors
/// The name of what the product lacks.
pub fn solution(product: &Value, label: &str, truth_m: &[f64; 6]) -> Result<Solution, String> {
    let lacks = || format!("solution {label}");
    let all = product["coefficients"].as_array().ok_or_else(lacks)?;
    let names = product["covariance_names"][label].as_array().ok_or_else(lacks)?;
    let values: BTreeMap<&str, f64> = all
        .iter()
        .filter(|c| c["solution"] == label)
        .filter_map(|c| Some((c["name"].as_str()?, c["value"].as_f64()?)))
        .collect();
    let place = |name: &str| names.iter().position(|n| n == name).ok_or_else(lacks);
    let mut value_m = [0.0; 6];
    let mut covariance_m2 = Vec::with_capacity(21);
    for (i, a) in COEFFICIENTS.into_iter().enumerate() {
        value_m[i] = *values.get(a).ok_or_else(lacks)?;
        for b in &COEFFICIENTS[i..] {
            let entry = &product["covariance"][label][place(a)?][place(b)?];
            covariance_m2.push(rounded(entry.as_f64().ok_or_else(lacks)?));
        }
    }
    let error_m = std::array::from_fn(|i| rounded(value_m[i] - truth_m[i]));
    Ok(Solution { value_m: value_m.map(rounded), error_m, covariance_m2 })
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    fn product() -> Value {
        let coefficient = |name: &str, solution: &str, value: f64| json!({ "name": name, "solution": solution, "value": value, "sigma": 0.0 });
        let mut coefficients = Vec::new();
        let mut covariance = serde_json::Map::new();
        let mut names = serde_json::Map::new();
        // The product has the names in another order.
        let order: Vec<&str> = COEFFICIENTS.iter().rev().copied().collect();
        for (label, scale) in [("es-akf", 2.0), ("qp", 1.0), ("adopted", 1.0)] {
            for (i, name) in order.iter().enumerate() {
                coefficients.push(coefficient(name, label, scale * i as f64));
            }
            let matrix: Vec<Vec<f64>> =
                (0..6).map(|i| (0..6).map(|j| scale * f64::from(i.min(j) + 10 * i.max(j) + 1)).collect()).collect();
            covariance.insert(label.to_owned(), json!(matrix));
            names.insert(label.to_owned(), json!(order));
        }
        let widened: serde_json::Map<_, _> =
            order.iter().enumerate().map(|(i, n)| ((*n).to_owned(), json!(if i == 0 { 1.6 } else { 1.1 }))).collect();
        let p_end: serde_json::Map<_, _> = COEFFICIENTS.iter().map(|n| ((*n).to_owned(), json!(1e-3))).collect();
        json!({
            "coefficients": coefficients, "covariance": covariance, "covariance_names": names,
            "verdict": "agree", "nis": 1.0, "chi2_per_dof": 1.0, "software_version": "dragfree 0.1.0",
            "date_created": "2026-11-21T04:14:45Z",
            "start_time_epoch_ns": 0_i64, "stop_time_epoch_ns": 86_399_900_000_000_i64,
            "quality": { "counts": { "es-akf": { "updates": 100 } }, "stages": {
                "qp-check": { "widened": widened },
                "es-akf": {
                "tm1": { "sigma_stretch": 1.0 }, "tm2": { "sigma_stretch": 2.0 }, "p_end_sigma": p_end } } },
        })
    }

    #[test]
    fn a_product_becomes_a_line() {
        let found = line("nominal", 7, "abc", &[1.0; 6], &product()).unwrap();
        assert_eq!((found.seed, found.date.as_str(), found.hours, found.nis_dof), (7, "2026-11-21", 24.0, 300.0));
        // tm1.x stands last in the product.
        assert_eq!((found.es_akf.value_m[0], found.es_akf.error_m[0], found.qp.error_m[5]), (10.0, 9.0, -1.0));
        let c = found.qp.covariance();
        assert_eq!((c[(0, 0)], c[(5, 5)], c[(0, 5)]), (56.0, 1.0, 51.0));
        assert_eq!((found.sigma_stretch, found.adopted.as_ref()), ([1.0, 2.0], None));
        assert_eq!(found.qp_widened, [1.1, 1.1, 1.1, 1.1, 1.1, 1.6]);
    }

    #[test]
    fn what_a_product_lacks_is_named() {
        let mut lame = product();
        lame["covariance"]["qp"] = Value::Null;
        assert_eq!(line("nominal", 7, "abc", &[1.0; 6], &lame).unwrap_err(), "solution qp");
    }
}
