//! How time and memory of a run grow with the length of the data, their rate, the effects of the model, the columns of
//! the sums, and threads.

use std::fmt::Write as _;
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::time::Instant;

use clap::ValueEnum;
use dragfree_chart::{ChartError, Line, Panel, Scale, Stroke, svg};
use dragfree_estimation::spectra::{Analyser, Layout, Plan, Sums};
use serde::{Deserialize, Serialize};

use crate::campaign::{ScratchFolder, note, parse, science_mode, taiji};
use crate::error::{CampaignError, file};
use crate::program::{Program, Used, root};
use crate::records::{read_document, write_document};
use crate::stats::median;

/// What was measured.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Growth {
    /// One for each quantity that grows.
    pub(crate) series: Vec<Series>,
}

/// Measurements with more and more of one quantity.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Series {
    /// Date of the measurement.
    date: String,
    /// What was done.
    pub(crate) work: String,
    /// The quantity, with its unit.
    pub(crate) grows: String,
    /// Smallest first.
    pub(crate) points: Vec<Point>,
}

/// One measurement.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Point {
    /// The quantity.
    pub(crate) x: f64,
    /// Time of the processors, s.
    pub(crate) processor_s: f64,
    /// Time by the clock, s.
    pub(crate) wall_s: f64,
    /// Most memory at a time, MB; `None` where the work is a part of this program.
    pub(crate) memory_mb: Option<f64>,
}

const REPEATS: usize = 3;
/// Half of them on each test mass, whose filter has room for 80: 96 states, 16 of them without any.
const MOST_EFFECTS: u32 = 100;

/// What grows.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum Grows {
    /// Effects of the model
    Effects,
    /// Samples per second
    Rate,
    /// Columns of the sums
    Columns,
    /// Threads
    Threads,
    /// Length of the data
    Length,
}

/// Measures some series, on an otherwise idle machine, and writes them into the file; `days` is the longest run.
pub(crate) fn growth(
    program: &Program,
    what: &[Grows],
    days: u32,
    results: &Path,
    scratch: &Path,
) -> Result<(), CampaignError> {
    let bench = Bench { program: program.with_threads(2), folder: ScratchFolder::new(&scratch.join("growth"))? };
    let mut growth: Growth = read_document(results)?.unwrap_or(Growth { series: Vec::new() });
    for grows in what {
        let series = match grows {
            Grows::Effects => bench.effects(&[1, 3, 10, 30, MOST_EFFECTS])?,
            Grows::Rate => bench.rates(&[1.0, 3.0, 10.0, 30.0, 100.0])?,
            Grows::Columns => columns(&[9, 18, 36, 72, 144]),
            Grows::Threads => bench.threads(program)?,
            Grows::Length => bench.lengths(days)?,
        };
        match growth.series.iter_mut().find(|s| s.grows == series.grows) {
            Some(before) => *before = series,
            None => growth.series.push(series),
        }
        write_document(results, &growth)?;
    }
    note(&growth.table());
    Ok(())
}

/// The program and where it works.
struct Bench {
    program: Program,
    folder: ScratchFolder,
}

impl Bench {
    fn simulate(&self, mission: &Path, length: [&str; 2]) -> Result<Vec<PathBuf>, CampaignError> {
        let folder = self.folder.path("telemetry");
        let _ = std::fs::remove_dir_all(&folder); // it may not be there yet
        Ok(self.program.simulate(mission, &folder, &length)?.files)
    }

    /// Medians of several runs.
    fn run(&self, program: &Program, more: &[&Path], files: &[PathBuf], x: f64) -> Result<Point, CampaignError> {
        let archive = self.folder.path("archive");
        let mut all: Vec<Used> = Vec::new();
        for _ in 0..REPEATS {
            let _ = std::fs::remove_dir_all(&archive); // it may not be there yet
            let mut arguments = vec![PathBuf::from("run"), science_mode()];
            arguments.extend_from_slice(files);
            arguments.extend(more.iter().map(|path| path.to_path_buf()));
            arguments.extend(["--archive".into(), archive.clone(), "--json".into()]);
            all.push(program.used(root(), &arguments)?.1);
        }
        let of = |part: fn(&Used) -> f64| median(all.iter().map(part).collect());
        let memory_mb = Some(of(|u| u.memory_mb));
        note(&format!("{x}: {:.2} s of the processors", of(|u| u.processor_s)));
        Ok(Point { x, processor_s: of(|u| u.processor_s), wall_s: of(|u| u.wall_s), memory_mb })
    }

    fn lengths(&self, days: u32) -> Result<Series, CampaignError> {
        let mut points = Vec::new();
        for hours in [1.0, 6.0] {
            let files = self.simulate(&taiji(), ["--hours", &hours.to_string()])?;
            points.push(self.run(&self.program, &[], &files, hours)?);
        }
        let files = self.simulate(&taiji(), ["--days", &days.to_string()])?;
        for days in [1, 5, 25].into_iter().filter(|d| *d <= files.len()) {
            points.push(self.run(&self.program, &[], &files[..days], 24.0 * days as f64)?);
        }
        Ok(Series::new("run on two threads", "length of the data / h", points))
    }

    fn rates(&self, rates_hz: &[f64]) -> Result<Series, CampaignError> {
        let mut points = Vec::new();
        for rate in rates_hz {
            let mut mission = parse(&taiji())?;
            let table = mission.get_mut("mission").and_then(toml::Value::as_table_mut);
            let table = table.ok_or_else(|| file(&taiji(), &"no table [mission]"))?;
            table.insert("sample_rate_hz".to_owned(), (*rate).into());
            let path = self.folder.path("rate.toml");
            std::fs::write(&path, mission.to_string()).map_err(|e| file(&path, &e))?;
            let files = self.simulate(&path, ["--hours", "2"])?;
            points.push(self.run(&self.program, &["--mission".as_ref(), &path], &files, *rate)?);
        }
        Ok(Series::new("run of two hours", "rate / Hz", points))
    }

    fn effects(&self, counts: &[u32]) -> Result<Series, CampaignError> {
        let files = self.simulate(&taiji(), ["--hours", "6"])?;
        let bare = root().join("fixtures/models/com-offset.toml");
        let bare = std::fs::read_to_string(&bare).map_err(|e| file(&bare, &e))?;
        let mut points = Vec::new();
        for count in counts {
            let mut model = bare.clone();
            for i in 1..=*count {
                // Lines from 1 to 100 mHz, each a force of its own.
                let hz = 1e-3 * f64::from(i);
                let test_mass = 1 + (i - 1) % 2;
                let _ = write!(
                    model,
                    "\n[[effect]]\nid = \"formula\"\ninstance = \"line{i}\"\nestimate = true\nparameters = {{ acts_on = \
                     \"tm{test_mass}.accel.y\", expression = \"sin(2 * pi * {hz} * time_s)\", unit = \"m s-2\", range = [-1e-12, \
                     1e-12] }}\n"
                );
            }
            let path = self.folder.path("model.toml");
            std::fs::write(&path, model).map_err(|e| file(&path, &e))?;
            points.push(self.run(&self.program, &["--model".as_ref(), &path], &files, f64::from(*count))?);
        }
        Ok(Series::new("run of six hours", "effects beside the offset", points))
    }

    fn threads(&self, program: &Program) -> Result<Series, CampaignError> {
        let files = self.simulate(&taiji(), ["--days", "1"])?;
        let point = |threads: usize| self.run(&program.with_threads(threads), &[], &files, threads as f64);
        Ok(Series::new("run of a day", "threads", vec![point(1)?, point(2)?]))
    }
}

/// The sums of cross-spectra of six hours.
fn columns(counts: &[usize]) -> Series {
    const LENGTH: usize = 16_384;
    const SEGMENTS: usize = 25;
    let mut state = 1_u64;
    let mut noise = || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 11) as f64 * 1e-16
    };
    let plan = Plan::new(LENGTH, 10.0);
    let segment: Vec<Vec<f64>> =
        (0..counts.iter().copied().max().unwrap_or(0)).map(|_| (0..LENGTH).map(|_| noise()).collect()).collect();
    let sums_of = |count: usize| {
        let layout = Layout {
            channels: (0..count).map(|i| i.to_string()).collect(),
            series: Vec::new(),
            regressors: Vec::new(),
            coefficients: Vec::new(),
        };
        let columns: Vec<&[f64]> = segment[..count].iter().map(Vec::as_slice).collect();
        let (mut sums, mut analyser) = (Sums::new(&plan, &layout), Analyser::new(plan.clone(), &layout));
        let begun = Instant::now();
        (0..SEGMENTS).for_each(|_| analyser.add(0, 0, &columns, false, &mut sums));
        begun.elapsed().as_secs_f64()
    };
    let point = |count: &usize| {
        let seconds = median((0..REPEATS).map(|_| sums_of(*count)).collect());
        Point { x: *count as f64, processor_s: seconds, wall_s: seconds, memory_mb: None }
    };
    Series::new("cross-spectra of six hours", "columns", counts.iter().map(point).collect())
}

/// Slope of the straight line through the logarithms.
fn exponent(points: &[(f64, f64)]) -> f64 {
    let n = points.len() as f64;
    let logs: Vec<(f64, f64)> = points.iter().map(|(x, y)| (x.ln(), y.ln())).collect();
    let mean = |of: fn(&(f64, f64)) -> f64| logs.iter().map(of).sum::<f64>() / n;
    let (mx, my) = (mean(|p| p.0), mean(|p| p.1));
    let (xy, xx) = logs.iter().fold((0.0, 0.0), |(xy, xx), (x, y)| (xy + (x - mx) * (y - my), xx + (x - mx).powi(2)));
    xy / xx
}

impl Series {
    /// Of today.
    fn new(work: &str, grows: &str, points: Vec<Point>) -> Self {
        let date = chrono::Utc::now().format("%Y-%m-%d").to_string();
        Self { date, work: work.to_owned(), grows: grows.to_owned(), points }
    }

    /// Points of a part, where it was measured.
    fn of(&self, part: impl Fn(&Point) -> Option<f64>) -> Vec<(f64, f64)> {
        self.points.iter().filter_map(|p| Some((p.x, part(p)?))).collect()
    }

    fn processor(&self) -> Vec<(f64, f64)> {
        self.of(|p| Some(p.processor_s))
    }

    fn memory(&self) -> Vec<(f64, f64)> {
        self.of(|p| p.memory_mb)
    }
}

impl Growth {
    /// The table of the report.
    pub(crate) fn table(&self) -> String {
        let mut text = format!(
            "Medians of {REPEATS}. The columns `time` and `memory` are the exponents over the whole range.\n\n\
             | work | grows | from | to | processor, s | clock, s | memory, MB | time | memory | measured on |\n\
             |---|---|---|---|---|---|---|---|---|---|\n"
        );
        for s in &self.series {
            let Some((first, last)) = s.points.first().zip(s.points.last()) else { continue };
            let memory = |p: &Point| p.memory_mb.map_or("–".to_owned(), |mb| format!("{mb:.0}"));
            let memory_exponent =
                if s.memory().is_empty() { "–".to_owned() } else { format!("{:.2}", exponent(&s.memory())) };
            let _ = writeln!(
                text,
                "| {} | {} | {} | {} | {:.2} to {:.2} | {:.2} to {:.2} | {} to {} | {:.2} | {memory_exponent} | {} |",
                s.work,
                s.grows,
                first.x,
                last.x,
                first.processor_s,
                last.processor_s,
                first.wall_s,
                last.wall_s,
                memory(first),
                memory(last),
                exponent(&s.processor()),
                s.date,
            );
        }
        text
    }

    /// One panel for each series, both axes logarithmic.
    pub(crate) fn picture(&self) -> Result<String, ChartError> {
        let panel = |s: &Series| {
            let (time, memory) = (s.processor(), s.memory());
            let mut lines =
                vec![Line::new(format!("processor / s, x^{:.2}", exponent(&time)), 0, Stroke::Solid, time.clone())];
            if !memory.is_empty() {
                let clock = s.of(|p| Some(p.wall_s));
                lines.push(Line::new(format!("clock / s, x^{:.2}", exponent(&clock)), 2, Stroke::Solid, clock));
                let label = format!("memory / 100 MB, x^{:.2}", exponent(&memory));
                let scaled = memory.iter().map(|(x, mb)| (*x, mb / 100.0)).collect();
                lines.push(Line::new(label, 1, Stroke::Dashed, scaled));
            }
            let x = time.first().map_or(1.0, |p| p.0)..time.last().map_or(10.0, |p| p.0);
            let x: Range<f64> = x.start / 1.1..x.end * 1.1;
            Panel {
                title: s.work.clone(),
                x_label: s.grows.clone(),
                y_label: String::new(),
                x_scale: Scale::Logarithmic,
                y_scale: Scale::Logarithmic,
                x,
                y: None,
                lines,
            }
        };
        svg(&self.series.iter().map(panel).collect::<Vec<_>>(), 2)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_power_law_has_its_exponent() {
        let points: Vec<(f64, f64)> = [1.0_f64, 3.0, 10.0, 100.0].map(|x| (x, 7.0 * x.powf(1.7))).into();
        assert!((exponent(&points) - 1.7).abs() < 1e-12);
    }

    #[test]
    fn the_table_has_a_row_for_each_series_and_the_picture_can_be_drawn() {
        let point = |x: f64| Point { x, processor_s: 2.0 * x, wall_s: x, memory_mb: Some(100.0) };
        let series =
            |work: &str| Series { date: "2035-01-01".into(), ..Series::new(work, "g", vec![point(1.0), point(10.0)]) };
        let growth = Growth { series: vec![series("a"), series("b")] };
        let table = growth.table();
        assert!(
            table
                .contains("| a | g | 1 | 10 | 2.00 to 20.00 | 1.00 to 10.00 | 100 to 100 | 1.00 | 0.00 | 2035-01-01 |"),
            "{table}"
        );
        assert!(growth.picture().is_ok());
    }
}
