//! The bars of speed and memory, each measured in one call.

use serde::{Deserialize, Serialize};
use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::process::Command;

use crate::campaign::{ScratchFolder, note, science_mode, taiji};
use crate::error::{CampaignError, file};
use crate::program::{Program, Used, output, root};
use crate::records::write_document;
use crate::stats::median;

/// What was measured.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Speed {
    /// Date of the measurement.
    pub(crate) date: String,
    /// One for each bar.
    pub(crate) rows: Vec<Row>,
}

/// A bar and what was measured.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Row {
    /// What was measured.
    pub(crate) what: String,
    /// The number.
    pub(crate) measured: f64,
    /// What it must reach, or must not exceed.
    pub(crate) bar: Bar,
    /// Unit of both.
    pub(crate) unit: String,
    /// Command that measures it.
    pub(crate) command: String,
}

/// A limit.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum Bar {
    /// The number must not be smaller.
    AtLeast(f64),
    /// The number must not be larger.
    AtMost(f64),
}

impl Row {
    fn new(what: &str, measured: f64, bar: Bar, unit: &str, command: &str) -> Self {
        // Three digits are more than times are worth.
        let digits = 10_f64.powf(2.0 - measured.abs().max(1e-9).log10().floor());
        let measured = (measured * digits).round() / digits;
        Self { what: what.to_owned(), measured, bar, unit: unit.to_owned(), command: command.to_owned() }
    }

    fn met(&self) -> bool {
        match self.bar {
            Bar::AtLeast(bar) => self.measured >= bar,
            Bar::AtMost(bar) => self.measured <= bar,
        }
    }
}

impl Speed {
    /// The table of the report.
    pub(crate) fn table(&self) -> String {
        let mut text = format!("Measured on {} on two cores; what misses its bar is **bold**.\n\n", self.date);
        text += "| what | measured | bar | command |\n|---|---|---|---|\n";
        for row in &self.rows {
            let (sign, bar) = match row.bar {
                Bar::AtLeast(bar) => ('≥', bar),
                Bar::AtMost(bar) => ('≤', bar),
            };
            let measured = format!("{} {}", row.measured, row.unit);
            let measured = if row.met() { measured } else { format!("**{measured}**") };
            let _ = writeln!(text, "| {} | {measured} | {sign} {bar} | `{}` |", row.what, row.command);
        }
        text
    }
}

/// Number of timings of a whole program, of which the median counts.
const REPEATS: usize = 5;
const DAY_S: f64 = 86_400.0;
/// Benchmarks that add up to the cost of candidates.
const SIX_HOURS_S: f64 = 21_600.0;
/// Epochs of a day.
const EPOCHS: f64 = 864_000.0;

/// Median of a criterion benchmark in a folder, ns.
fn criterion(folder: &Path, name: &[&str]) -> Result<f64, CampaignError> {
    let mut path = folder.to_owned();
    path.extend(name);
    path.push("new/estimates.json");
    let text = std::fs::read_to_string(&path).map_err(|e| file(&path, &e))?;
    let estimates: serde_json::Value = serde_json::from_str(&text).map_err(|e| file(&path, &e))?;
    estimates["median"]["point_estimate"].as_f64().ok_or_else(|| file(&path, &"no median"))
}

/// Runs benchmarks, which leave their times in a folder.
fn bench(names: &[&str], to: &Path) -> Result<(), CampaignError> {
    let cargo = std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into());
    let mut command = Command::new(cargo);
    // Of the whole workspace, so that crates have the features that they have in the program.
    command.current_dir(root()).args(["bench", "--quiet", "--workspace"]);
    command.args(names.iter().flat_map(|name| ["--bench", name])).env("CRITERION_HOME", to);
    output(&mut command, &[0]).map(|_| ())
}

/// Measures all bars, on an otherwise idle machine, and writes the file; `days` is the length of the longest run.
pub(crate) fn measure(program: &Program, days: u32, path: &Path, scratch: &Path) -> Result<(), CampaignError> {
    let folder = ScratchFolder::new(&scratch.join("speed"))?;
    let program = program.with_threads(2);
    let mut rows = starts(&program)?;
    rows.extend(whole_days(&program, days, &folder)?);
    rows.extend(kernels(&folder.path("criterion"))?);
    let date = chrono::Utc::now().format("%Y-%m-%d").to_string();
    let speed = Speed { date, rows };
    note(&speed.table());
    write_document(path, &speed)
}

/// Medians of several calls of the same command.
fn used(program: &Program, arguments: &[&str]) -> Result<Used, CampaignError> {
    let once = |_| program.used(root(), arguments).map(|(_, used)| used);
    let all: Vec<Used> = (0..REPEATS).map(once).collect::<Result<_, _>>()?;
    let of = |part: fn(&Used) -> f64| median(all.iter().map(part).collect());
    Ok(Used { wall_s: of(|u| u.wall_s), processor_s: of(|u| u.processor_s), memory_mb: of(|u| u.memory_mb) })
}

/// Commands that do next to nothing.
fn starts(program: &Program) -> Result<Vec<Row>, CampaignError> {
    let calls: [(&[&str], f64); 3] = [(&["--version"], 10.0), (&["--help"], 10.0), (&["plugins", "list"], 50.0)];
    let row = |(arguments, bar): (&[&str], f64)| {
        let ms = 1e3 * used(program, arguments)?.wall_s;
        let command = format!("dragfree {}", arguments.join(" "));
        Ok(Row::new(&format!("`{command}`"), ms, Bar::AtMost(bar), "ms", &command))
    };
    calls.into_iter().map(row).collect()
}

/// Simulation, calibration and diagnosis of a day, and calibration of many.
fn whole_days(program: &Program, days: u32, folder: &ScratchFolder) -> Result<Vec<Row>, CampaignError> {
    let (mission, pipeline) = (taiji(), science_mode());
    let text = |path: &Path| path.to_string_lossy().into_owned();
    let telemetry = text(&folder.path("telemetry"));
    let simulate = |days: &str| {
        let _ = std::fs::remove_dir_all(&telemetry); // it may not be there yet
        let arguments = ["simulate", &text(&mission), "--out", &telemetry, "--days", days, "--json"];
        let (made, used) = program.used(root(), &arguments)?;
        let files = made["files"].as_array().into_iter().flatten().filter_map(|f| f.as_str().map(PathBuf::from));
        Ok::<_, CampaignError>((files.collect::<Vec<_>>(), used))
    };
    let archive = text(&folder.path("archive"));
    let run = |files: &[PathBuf]| {
        let _ = std::fs::remove_dir_all(&archive); // it may not be there yet
        let files: Vec<String> = files.iter().map(|f| text(f)).collect();
        let pipeline = text(&pipeline);
        let mut arguments = vec!["run", &pipeline];
        arguments.extend(files.iter().map(String::as_str));
        arguments.extend(["--archive", &archive, "--json"]);
        program.used(root(), &arguments)
    };
    let medians = |all: &[Used], part: fn(&Used) -> f64| median(all.iter().map(part).collect());
    let mut simulated = Vec::new();
    for _ in 0..REPEATS {
        simulated.push(simulate("1")?.1);
    }
    let (day, _) = simulate("1")?;
    let (mut ran, mut id) = (Vec::new(), String::new());
    for _ in 0..REPEATS {
        let (product, used) = run(&day)?;
        id = product["id"].as_str().unwrap_or_default().to_owned();
        ran.push(used);
    }
    let diagnosed = program.used(root(), &["diagnose", &id, "--archive", &archive, "--json"])?.1;
    let (wall, memory) = (medians(&ran, |u| u.wall_s), medians(&ran, |u| u.memory_mb));
    let second_core = 100.0 * (medians(&ran, |u| u.processor_s / u.wall_s) - 1.0);
    let (all, _) = simulate(&days.to_string())?;
    let (_, many) = run(&all)?;
    let (run, simulate) = ("dragfree run science-mode DAY.mcap", "dragfree simulate taiji --days 1");
    let of_days = format!("{days} days, the same");
    let growth = 100.0 * (many.memory_mb / memory - 1.0);
    Ok(vec![
        Row::new("a day from MCAP to the product", DAY_S / wall, Bar::AtLeast(50_000.0), "× real time", run),
        Row::new("its second core at work", second_core, Bar::AtLeast(80.0), "%", run),
        Row::new("its memory", memory, Bar::AtMost(100.0), "MB", run),
        Row::new(&of_days, many.wall_s, Bar::AtMost(1.8 * f64::from(days)), "s", "dragfree run science-mode *.mcap"),
        Row::new(&format!("memory of {days} days above that of one"), growth, Bar::AtMost(2.0), "%", "the same"),
        Row::new("diagnosis of a day", diagnosed.wall_s, Bar::AtMost(6.0), "s", "dragfree diagnose DAY"),
        Row::new("its memory", diagnosed.memory_mb, Bar::AtMost(400.0), "MB", "dragfree diagnose DAY"),
        Row::new(
            "a day simulated and written as MCAP",
            DAY_S / medians(&simulated, |u| u.wall_s),
            Bar::AtLeast(60_000.0),
            "× real time",
            simulate,
        ),
    ])
}

/// Parts, by their benchmarks.
fn kernels(folder: &Path) -> Result<Vec<Row>, CampaignError> {
    bench(&["step", "candidates"], folder)?;
    const STEP: &str = "es-akf step, 22 states";
    const CANDIDATES: &str = "100 candidates";
    let akf = "cargo bench -p dragfree-es-akf --bench step";
    let candidates = "cargo bench -p dragfree-identification --bench candidates";
    let simulator = "cargo bench -p dragfree-sim --bench step";
    let dense = criterion(folder, &[STEP, "dense nalgebra"])?;
    let step = |name: &str| Ok::<_, CampaignError>(dense / criterion(folder, &[STEP, name])?);
    let seconds = |name: &str| Ok::<_, CampaignError>(1e-9 * criterion(folder, &[CANDIDATES, name])?);
    let epoch_s = 1e-9 * criterion(folder, &["whole epoch"])?;
    Ok(vec![
        Row::new(
            "a day simulated without writing, one core",
            DAY_S / (EPOCHS * epoch_s),
            Bar::AtLeast(250_000.0),
            "× real time",
            simulator,
        ),
        Row::new(
            "ES-AKF step of 22 states, faster than dense nalgebra",
            step("structured")?,
            Bar::AtLeast(8.0),
            "×",
            akf,
        ),
        Row::new("the same with the covariance behind σ", step("structured, with sigma")?, Bar::AtLeast(8.0), "×", akf),
        Row::new(
            "normal equations of 100 candidates of a day, two threads",
            DAY_S / SIX_HOURS_S * seconds("sums of six hours")?,
            Bar::AtMost(10.0),
            "s",
            candidates,
        ),
        Row::new(
            "a model fitted and 100 candidates ranked from sums",
            seconds("fit and rank")?,
            Bar::AtMost(0.1),
            "s",
            candidates,
        ),
    ])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_misses_its_bar_is_bold() {
        let row = |measured, bar| Row::new("a", measured, bar, "s", "c");
        let rows = vec![row(7.6, Bar::AtLeast(8.0)), row(23_351.0, Bar::AtLeast(8.0)), row(7.6, Bar::AtMost(8.0))];
        let text = Speed { date: "2035-01-01".into(), rows }.table();
        let lines: Vec<&str> = text.lines().skip(4).collect();
        assert_eq!(
            lines,
            ["| a | **7.6 s** | ≥ 8 | `c` |", "| a | 23400 s | ≥ 8 | `c` |", "| a | 7.6 s | ≤ 8 | `c` |"]
        );
    }
}
