//! The program under test, called as a user calls it: `dragfree simulate`, then `dragfree run`.

use serde::Deserialize;
use serde_json::Value;
use sha2::{Digest as _, Sha256};
use std::collections::BTreeMap;
use std::ffi::OsStr;
use std::io::{BufRead as _, BufReader, Read as _};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::Instant;

use dragfree_engine::telemetry::first_message;
use wait4::Wait4 as _;

use crate::error::{CampaignError, file};
use crate::records::{COEFFICIENTS, Line, Solution, rounded};

/// The repository.
pub(crate) fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap_or(Path::new("."))
}

/// The built program.
#[derive(Clone, Debug)]
pub(crate) struct Program {
    exe: PathBuf,
    threads: usize,
}

/// Telemetry of a simulation, from which the truth was read and removed before any calibration.
#[derive(Clone, Debug)]
pub(crate) struct Simulated {
    /// The files, oldest first.
    pub(crate) files: Vec<PathBuf>,
    /// True offsets, m.
    pub(crate) truth_m: [f64; 6],
}

/// A workbench that runs.
pub(crate) struct Server {
    process: Child,
    pub(crate) port: u16,
}

impl Server {
    /// Memory in use, MB; NaN where the system does not say.
    pub(crate) fn memory_mb(&self) -> f64 {
        let status = std::fs::read_to_string(format!("/proc/{}/status", self.process.id())).unwrap_or_default();
        let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"));
        line.and_then(|l| l.trim().strip_suffix("kB")?.trim().parse().ok()).map_or(f64::NAN, |kb: f64| kb / 1e3)
    }

    pub(crate) fn end(&mut self) {
        let _ = self.process.kill().and_then(|()| self.process.wait()); // it may have ended
    }
}

/// What `dragfree simulate --json` prints.
#[derive(Deserialize)]
struct Made {
    files: Vec<PathBuf>,
    truth_files: Vec<PathBuf>,
    sealed_file: Option<PathBuf>,
}

/// Telemetry of a simulation with hidden effects, and its sealed truth in another folder.
#[derive(Clone, Debug)]
pub(crate) struct Hidden {
    /// The files, oldest first.
    pub(crate) files: Vec<PathBuf>,
    /// The sealed file.
    pub(crate) sealed: PathBuf,
    /// True offsets, m.
    pub(crate) truth_m: [f64; 6],
}

/// Inputs of `run` besides the telemetry.
#[derive(Clone, Debug, Default)]
pub(crate) struct Chain {
    /// Pipeline file.
    pub(crate) pipeline: PathBuf,
    /// Mission file in place of the pipeline's.
    pub(crate) mission: Option<PathBuf>,
    /// Model file in place of the pipeline's.
    pub(crate) model: Option<PathBuf>,
}

impl Program {
    /// Builds program and plugins, so that the measured program is current.
    pub(crate) fn build() -> Result<Self, CampaignError> {
        let folder = std::env::current_exe()
            .map_err(|source| CampaignError::Start { command: "this program".to_owned(), source })?
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
    pub(crate) fn with_threads(&self, threads: usize) -> Self {
        Self { exe: self.exe.clone(), threads }
    }

    fn command(&self) -> Command {
        let mut command = Command::new(&self.exe);
        command.current_dir(root()).env_remove("DRAGFREE_PLUGIN_PATH").env("NO_COLOR", "1").arg("--quiet");
        command.arg("--threads").arg(self.threads.to_string());
        command
    }

    /// Digest of the plugins' libraries, which identifies a build.
    pub(crate) fn digest(&self) -> Result<String, CampaignError> {
        let mut command = self.command();
        let answer = json(command.args(["plugins", "list", "--json"]), &[0])?;
        let plugins = answer["plugins"].as_array().ok_or_else(|| missing(&command, "plugins"))?;
        let mut digests: Vec<&str> = plugins.iter().filter_map(|p| p["sha256"].as_str()).collect();
        digests.sort_unstable();
        let digest = Sha256::digest(digests.concat());
        Ok(digest.iter().take(6).map(|byte| format!("{byte:02x}")).collect())
    }

    /// Digest of the program and the plugins' libraries: a diagnosis is made by both.
    pub(crate) fn whole_digest(&self) -> Result<String, CampaignError> {
        let exe = std::fs::read(&self.exe).map_err(|e| file(&self.exe, &e))?;
        let digest = Sha256::new().chain_update(exe).chain_update(self.digest()?).finalize();
        Ok(digest.iter().take(6).map(|byte| format!("{byte:02x}")).collect())
    }

    /// Writes the controllers designed for a mission to a file with the section `control`.
    pub(crate) fn freeze(&self, mission: &Path, to: &Path) -> Result<(), CampaignError> {
        output(self.command().arg("design").arg(mission).arg("--freeze").arg(to), &[0]).map(|_| ())
    }

    /// Simulates into a new folder, reads the truth and removes it.
    pub(crate) fn simulate(
        &self,
        mission: &Path,
        folder: &Path,
        arguments: &[impl AsRef<OsStr>],
    ) -> Result<Simulated, CampaignError> {
        let made = self.simulated(mission, folder, arguments)?;
        let truth_m = offsets_m(&made.truth_files[0])?;
        for path in &made.truth_files {
            std::fs::remove_file(path).map_err(|e| file(path, &e))?;
        }
        Ok(Simulated { files: made.files, truth_m })
    }

    /// Simulates with hidden effects into `folder` and moves the truth away; `noise` is the seed of everything else.
    pub(crate) fn hide(
        &self,
        mission: &Path,
        folder: &Path,
        [hidden, noise]: [u32; 2],
        hours: f64,
    ) -> Result<Hidden, CampaignError> {
        let (telemetry, away) = (folder.join("telemetry"), folder.join("sealed"));
        let [hidden, noise, hours] = [hidden.to_string(), noise.to_string(), hours.to_string()];
        let arguments = ["--hidden", &hidden, "--seed", &noise, "--hours", &hours];
        let made = self.simulated(mission, &telemetry, &arguments)?;
        let sealed = made.sealed_file.unwrap_or_default();
        let (Some(truth), Some(name)) = (sealed.parent(), sealed.file_name()) else {
            return Err(file(&sealed, &"it has no folder"));
        };
        std::fs::rename(truth, &away).map_err(|e| file(&sealed, &e))?;
        let truth_m = offsets_m(&away.join(made.truth_files[0].file_name().unwrap_or_default()))?;
        Ok(Hidden { files: made.files, sealed: away.join(name), truth_m })
    }

    /// Runs `dragfree simulate`; there is at least one file of truth.
    fn simulated(&self, mission: &Path, folder: &Path, arguments: &[impl AsRef<OsStr>]) -> Result<Made, CampaignError> {
        let mut command = self.command();
        command.arg("simulate").arg(mission).arg("--out").arg(folder).args(arguments).arg("--json");
        let made: Made =
            serde_json::from_value(json(&mut command, &[0])?).map_err(|e| missing(&command, &e.to_string()))?;
        if made.truth_files.is_empty() { Err(missing(&command, "truth_files")) } else { Ok(made) }
    }

    /// Runs `dragfree model` with arguments.
    pub(crate) fn model(&self, words: &[&OsStr]) -> Result<(), CampaignError> {
        output(self.command().arg("model").args(words), &[0]).map(|_| ())
    }

    /// Runs `dragfree diagnose` on products of one model, with additional arguments.
    pub(crate) fn diagnose_together(
        &self,
        products: &[Value],
        archive: &Path,
        arguments: &[&str],
    ) -> Result<Value, CampaignError> {
        let mut command = self.command();
        command.arg("diagnose");
        for product in products {
            command.arg(product["id"].as_str().ok_or_else(|| missing(&command, "id"))?);
        }
        command.arg("--archive").arg(archive).arg("--json").args(arguments);
        json(&mut command, &[0, 4])
    }

    /// Runs `dragfree reveal`, which scores a diagnosis against the sealed truth.
    pub(crate) fn reveal(&self, hidden: &Hidden, diagnosis: &Path) -> Result<Value, CampaignError> {
        let mut command = self.command();
        command.arg("reveal").arg(&hidden.sealed).arg("--diagnosis").arg(diagnosis);
        command.args(hidden.files.iter().flat_map(|file| [OsStr::new("--telemetry"), file.as_os_str()]));
        Ok(json(command.arg("--json"), &[0])?["score"].take())
    }

    /// Runs a command in a folder, and gives its answer as JSON. Data loss and inconsistent models are accepted.
    pub(crate) fn ask(&self, folder: &Path, arguments: &[&str]) -> Result<Value, CampaignError> {
        json(self.command().current_dir(folder).args(arguments).arg("--json"), &[0, 3, 4])
    }

    /// Starts a command in a folder.
    pub(crate) fn start(&self, folder: &Path, arguments: &[&str]) -> Result<Child, CampaignError> {
        let mut command = self.command();
        command.current_dir(folder).args(arguments).stdout(Stdio::null()).stderr(Stdio::null());
        command.spawn().map_err(|source| CampaignError::Start { command: format!("{command:?}"), source })
    }

    /// Starts the workbench over an archive.
    pub(crate) fn serve(&self, archive: &Path) -> Result<Server, CampaignError> {
        let mut command = self.command();
        command.args(["serve", "--listen", "127.0.0.1:0", "--json", "--archive"]).arg(archive).stdout(Stdio::piped());
        let spawned = command.spawn();
        let mut process = spawned.map_err(|source| CampaignError::Start { command: format!("{command:?}"), source })?;
        let mut line = String::new();
        let read = process.stdout.take().map(|out| BufReader::new(out).read_line(&mut line));
        let ready: Value = serde_json::from_str(&line).unwrap_or_default();
        let port = ready["address"].as_str().and_then(|a| a.trim_end_matches('/').rsplit(':').next()?.parse().ok());
        match (read, port) {
            (Some(Ok(_)), Some(port)) => Ok(Server { process, port }),
            _ => {
                let _ = process.kill(); // it may have ended
                Err(missing(&command, "address"))
            }
        }
    }

    /// Runs `dragfree joint` or `trend` over days of an archive. Days that disagree and alerts are accepted.
    pub(crate) fn of_days(
        &self,
        command: &str,
        days: &str,
        events: &Path,
        archive: &Path,
    ) -> Result<Value, CampaignError> {
        let mut called = self.command();
        called.arg(command).arg(days).arg("--events").arg(events).arg("--archive").arg(archive).arg("--json");
        json(&mut called, &[0, 4])
    }

    /// Runs a chain over telemetry and returns the product as JSON. Exit codes for lost data and an inconsistent model
    /// are accepted.
    pub(crate) fn run(&self, chain: &Chain, files: &[PathBuf], archive: &Path) -> Result<Value, CampaignError> {
        json(&mut self.run_command(chain, files, archive), &[0, 3, 4])
    }

    /// The same of telemetry that may be refused.
    pub(crate) fn try_run(&self, chain: &Chain, files: &[PathBuf], archive: &Path) -> Result<Ran, CampaignError> {
        let mut command = self.run_command(chain, files, archive);
        command.arg("--quiet");
        let name = format!("{command:?}");
        let output = command.output().map_err(|source| CampaignError::Start { command: name.clone(), source })?;
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        match output.status.code() {
            Some(exit @ (0 | 3 | 4)) => {
                let product = serde_json::from_slice(&output.stdout);
                let product = product.map_err(|_| missing(&command, "a JSON document"))?;
                Ok(Ran { exit, product: Some(product), said })
            }
            Some(exit @ 1) => Ok(Ran { exit, product: None, said }),
            _ => Err(CampaignError::Failed { command: name, status: output.status, message: said }),
        }
    }

    /// What a command takes, run in a folder. Data loss and inconsistent models are accepted.
    pub(crate) fn used(&self, folder: &Path, arguments: &[impl AsRef<OsStr>]) -> Result<(Value, Used), CampaignError> {
        let mut command = self.command();
        let (printed, used) = measured(command.current_dir(folder).args(arguments), &[0, 3, 4])?;
        Ok((serde_json::from_slice(&printed).unwrap_or_default(), used))
    }

    fn run_command(&self, chain: &Chain, files: &[PathBuf], archive: &Path) -> Command {
        let mut command = self.command();
        command.arg("run").arg(&chain.pipeline).args(files).arg("--archive").arg(archive).arg("--json");
        for (option, path) in [("--mission", &chain.mission), ("--model", &chain.model)] {
            if let Some(path) = path {
                command.arg(option).arg(path);
            }
        }
        command
    }
}

/// What became of a run.
#[derive(Clone, Debug)]
pub(crate) struct Ran {
    /// Exit code.
    pub(crate) exit: i32,
    /// The product; none where the run was refused.
    pub(crate) product: Option<Value>,
    /// What stood on stderr.
    pub(crate) said: String,
}

/// True offsets, m, in a simulation's truth.
fn offsets_m(truth: &Path) -> Result<[f64; 6], CampaignError> {
    let first = first_message(truth, "/truth").map_err(|e| file(truth, &e))?;
    let mut truth_m = [0.0; 6];
    for (i, value) in truth_m.iter_mut().enumerate() {
        let key = format!("b{}_orf_m.{}", i / 3 + 1, ["x", "y", "z"][i % 3]);
        *value = *first.get(&key).ok_or_else(|| file(truth, &format!("it has no {key}")))?;
    }
    Ok(truth_m)
}

/// What a process took.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Used {
    /// By the clock, s.
    pub(crate) wall_s: f64,
    /// Of the processors, s.
    pub(crate) processor_s: f64,
    /// Most memory at a time, MB.
    pub(crate) memory_mb: f64,
}

/// What a command prints and takes, where it ends with one of these codes.
pub(crate) fn measured(command: &mut Command, codes: &[i32]) -> Result<(Vec<u8>, Used), CampaignError> {
    let name = format!("{command:?}");
    let fault = |source| CampaignError::Start { command: name.clone(), source };
    let begun = Instant::now();
    let mut process = command.stdout(Stdio::piped()).stderr(Stdio::null()).spawn().map_err(fault)?;
    let mut printed = Vec::new();
    process.stdout.take().map(|mut out| out.read_to_end(&mut printed)).transpose().map_err(fault)?;
    let ended = process.wait4().map_err(fault)?;
    let wall_s = begun.elapsed().as_secs_f64();
    match ended.status.code() {
        Some(code) if codes.contains(&code) => {
            let processor_s = (ended.rusage.utime + ended.rusage.stime).as_secs_f64();
            Ok((printed, Used { wall_s, processor_s, memory_mb: ended.rusage.maxrss as f64 / 1e6 }))
        }
        _ => Err(CampaignError::Failed { command: name, status: ended.status, message: String::new() }),
    }
}

/// What a command prints, where it ends with one of these codes.
pub(crate) fn output(command: &mut Command, codes: &[i32]) -> Result<Vec<u8>, CampaignError> {
    let name = format!("{command:?}");
    let output = command.output().map_err(|source| CampaignError::Start { command: name.clone(), source })?;
    match output.status.code() {
        Some(code) if codes.contains(&code) => Ok(output.stdout),
        _ => Err(CampaignError::Failed {
            command: name,
            status: output.status,
            message: String::from_utf8_lossy(&output.stderr).into_owned(),
        }),
    }
}

fn json(command: &mut Command, codes: &[i32]) -> Result<Value, CampaignError> {
    let text = output(command, codes)?;
    serde_json::from_slice(&text).map_err(|_| missing(command, "a JSON document"))
}

fn missing(command: &Command, what: &str) -> CampaignError {
    CampaignError::Answer { command: format!("{command:?}"), what: what.to_owned() }
}

/// The result of a product.
/// An error names what the product lacks.
pub(crate) fn line(
    configuration: &str,
    seed: u32,
    build: &str,
    truth_m: &[f64; 6],
    product: &Value,
) -> Result<Line, String> {
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
/// An error names what the product lacks.
pub(crate) fn solution(product: &Value, label: &str, truth_m: &[f64; 6]) -> Result<Solution, String> {
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
