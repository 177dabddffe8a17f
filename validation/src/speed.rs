//! Ratios of speed. Times depend on the machine, so only ratios are kept.

use serde::{Deserialize, Serialize};
use std::fmt::Write as _;
use std::io::ErrorKind;
use std::path::Path;
use std::process::Command;
use std::time::Instant;

use crate::campaign::{ScratchFolder, science_mode, taiji};
use crate::error::{CampaignError, file};
use crate::program::{Chain, Program, root};
use crate::stats::median;

/// Measured ratios.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Speed {
    /// Date of the measurement.
    pub(crate) date: String,
    /// The ratios.
    pub(crate) ratios: Vec<Ratio>,
}

/// One ratio.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Ratio {
    /// What is compared.
    pub(crate) what: String,
    /// Speed ratio.
    pub(crate) times: f64,
    /// Required ratio.
    pub(crate) bar: f64,
    /// Command that measures it.
    pub(crate) command: String,
}

/// Number of timings of a whole program, of which the median counts.
const REPEATS: usize = 3;
const DAY_S: f64 = 86_400.0;
/// Benchmarks that add up to the cost of candidates.
const SIX_HOURS_S: f64 = 21_600.0;

impl Speed {
    /// Reads a file; `None` if it does not exist.
    pub(crate) fn read(path: &Path) -> Result<Option<Self>, CampaignError> {
        match std::fs::read_to_string(path) {
            Err(error) if error.kind() == ErrorKind::NotFound => Ok(None),
            Err(error) => Err(file(path, &error)),
            Ok(text) => serde_json::from_str(&text).map(Some).map_err(|e| file(path, &e)),
        }
    }

    /// The table of the report.
    pub(crate) fn table(&self) -> String {
        let mut text = format!("Measured on {}; a number below its bar is **bold**.\n\n", self.date);
        text += "| what | times faster | bar | command |\n|---|---|---|---|\n";
        for r in &self.ratios {
            let number =
                |x: f64| if x < 100.0 { format!("{x:.1}") } else { format!("{:.0}", 100.0 * (x / 100.0).round()) };
            let times = number(r.times);
            let times = if r.times < r.bar { format!("**{times}**") } else { times };
            let _ = writeln!(text, "| {} | {times} | {} | `{}` |", r.what, number(r.bar), r.command);
        }
        text
    }
}

/// Median of a criterion benchmark, ns.
fn criterion(name: &[&str]) -> Result<f64, CampaignError> {
    let mut path = root().join("target/criterion");
    path.extend(name);
    path.push("new/estimates.json");
    let text = std::fs::read_to_string(&path).map_err(|e| file(&path, &e))?;
    let estimates: serde_json::Value = serde_json::from_str(&text).map_err(|e| file(&path, &e))?;
    estimates["median"]["point_estimate"].as_f64().ok_or_else(|| file(&path, &"no median"))
}

fn bench(package: &str, name: &str) -> Result<(), CampaignError> {
    let cargo = std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into());
    let mut command = Command::new(cargo);
    command.current_dir(root()).args(["bench", "--quiet", "-p", package, "--bench", name]);
    command.stdout(std::process::Stdio::null());
    match command.status() {
        Ok(status) if status.success() => Ok(()),
        Ok(status) => Err(file(root(), &format!("{command:?}: {status}"))),
        Err(error) => Err(file(root(), &error)),
    }
}

/// Measures all ratios, on an otherwise idle machine, and writes the file.
pub(crate) fn measure(program: &Program, path: &Path, scratch: &Path) -> Result<(), CampaignError> {
    bench("dragfree-es-akf", "step")?;
    bench("dragfree-identification", "candidates")?;
    const STEP: &str = "es-akf step, 22 states";
    let dense = criterion(&[STEP, "dense nalgebra"])?;
    let step = |name: &str| Ok::<_, CampaignError>(dense / criterion(&[STEP, name])?);

    const CANDIDATES: &str = "100 candidates";
    let seconds = |name: &str| Ok::<_, CampaignError>(1e-9 * criterion(&[CANDIDATES, name])?);

    let scratch_folder = ScratchFolder::new(scratch)?;
    let program = program.with_threads(2);
    let chain = Chain { pipeline: science_mode(), ..Chain::default() };
    let (mut simulating, mut running) = (Vec::new(), Vec::new());
    let mut date = String::new();
    for repeat in 0..REPEATS {
        let folder = scratch_folder.path(&format!("speed-{repeat}"));
        let start = Instant::now();
        let simulated = program.simulate(&taiji(), &folder, &["--days", "1"])?;
        simulating.push(start.elapsed().as_secs_f64());
        let start = Instant::now();
        let product = program.run(&chain, &simulated.files, &folder.join("archive"))?;
        running.push(start.elapsed().as_secs_f64());
        date = product["date_created"].as_str().unwrap_or_default().chars().take(10).collect();
        std::fs::remove_dir_all(&folder).map_err(|e| file(&folder, &e))?;
    }
    let ratio = |what: &str, times: f64, bar: f64, command: &str| Ratio {
        what: what.to_owned(),
        times: (times * 100.0).round() / 100.0,
        bar,
        command: command.to_owned(),
    };
    let bench = "cargo bench -p dragfree-es-akf --bench step";
    let candidates = "cargo bench -p dragfree-identification --bench candidates";
    let speed = Speed {
        date,
        ratios: vec![
            ratio("ES-AKF step, 22 states, than dense nalgebra", step("structured")?, 8.0, bench),
            ratio("the same with the covariance behind σ", step("structured, with sigma")?, 8.0, bench),
            ratio(
                "one day from MCAP on disk to the product, two threads, than real time",
                DAY_S / median(running),
                20_000.0,
                "dragfree run fixtures/pipelines/science-mode.toml DAY.mcap",
            ),
            ratio(
                "one day simulated and written as MCAP, two threads, than real time",
                DAY_S / median(simulating),
                50_000.0,
                "dragfree simulate fixtures/missions/taiji.toml --out DIR --days 1",
            ),
            ratio(
                "normal equations of 100 candidates, two threads, than real time; the bar is ten seconds a day",
                SIX_HOURS_S / seconds("sums of six hours")?,
                DAY_S / 10.0,
                candidates,
            ),
            ratio(
                "model fitted and 100 candidates ranked from stacked sums, than a tenth of a second",
                0.1 / seconds("fit and rank")?,
                1.0,
                candidates,
            ),
        ],
    };
    let text = serde_json::to_string_pretty(&speed).map_err(|e| file(path, &e))?;
    std::fs::write(path, text + "\n").map_err(|e| file(path, &e))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_ratio_below_its_bar_is_bold() {
        let ratio = |times| Ratio { what: "a".into(), times, bar: 8.0, command: "c".into() };
        let text = Speed { date: "2035-01-01".into(), ratios: vec![ratio(7.6), ratio(23_351.0)] }.table();
        assert!(text.contains("| **7.6** | 8.0 |") && text.contains("| 23400 |"), "{text}");
    }
}
