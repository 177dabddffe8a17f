//! Months: days with an offset that drifts and steps, each calibrated alone, then together by `joint` and `trend`.

use std::ffi::OsString;
use std::ops::RangeInclusive;
use std::path::Path;
use std::time::Instant;

use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::campaign::{Meter, ScratchFolder, science_mode, taiji, work};
use crate::error::{CampaignError, file};
use crate::frozen;
use crate::program::{Chain, Program};
use crate::records::{COEFFICIENTS, Keyed, Results, read, rounded};
use crate::stats;

/// Days of a set.
const DAYS: u32 = 90;

/// The first day, 2035-01-01, since 1970.
const FIRST_DAY: i64 = 23_741;

/// Drift of the centre of mass along x of SRF, mm per day.
const DRIFT_MM: f64 = 0.02;

/// Events, each before a day, with the step along x of SRF, mm: a declared one without a step, two trims, and one that
/// is too small to be seen.
const EVENTS: [(u32, f64); 4] = [(15, 0.0), (30, 0.5), (60, -1.1), (75, 0.05)];

/// Directions that the survey leaves free: both test masses together, along x, y and z. Pulls of both test masses hang
/// together, so the mean over them counts half.
const INDEPENDENT: usize = 3;

/// The result of one set.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Months {
    /// Seed.
    pub(crate) seed: u32,
    /// Hours of telemetry of each day.
    pub(crate) hours: f64,
    /// Digest of program and plugins.
    pub(crate) build: String,
    /// Commit of program and plugins; empty in results of before.
    #[serde(default)]
    pub(crate) commit: String,
    /// Time that `joint` took at first and once more, s.
    pub(crate) joint_s: [f64; 2],
    /// χ² of the days against the fit, and its degrees of freedom.
    pub(crate) same: (f64, f64),
    /// Each coefficient.
    pub(crate) coefficients: Vec<Course>,
    /// Coefficients of days that left what `trend` predicts.
    pub(crate) alerts: usize,
    /// Coefficients of days that `trend` predicted.
    pub(crate) predicted: usize,
}

/// A coefficient.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Course {
    /// Error at the end and σ, m.
    pub(crate) value: [f64; 2],
    /// Error of the rate and σ, m/s.
    pub(crate) rate: [f64; 2],
    /// Whether the rate was seen.
    pub(crate) rate_seen: bool,
    /// Error of each step and σ, m.
    pub(crate) steps: Vec<[f64; 2]>,
    /// Whether each step was seen.
    pub(crate) seen: Vec<bool>,
}

impl Keyed for Months {
    fn key(&self) -> (String, u32) {
        (format!("{}h", self.hours), self.seed)
    }

    /// Builds of one commit in several places differ in their digests.
    fn made_with(&self) -> &str {
        &self.commit
    }
}

/// Which sets are wanted.
pub(crate) struct Sets {
    /// Seeds.
    pub(crate) seeds: RangeInclusive<u32>,
    /// Hours of telemetry of each day.
    pub(crate) hours: f64,
    /// Sets at a time.
    pub(crate) at_once: usize,
}

impl Sets {
    /// The arguments that ask for them, of which `[results, scratch]` are files and folders.
    fn arguments(&self, [results, scratch]: [&Path; 2]) -> Result<Vec<OsString>, CampaignError> {
        let seeds = format!("{}-{}", self.seeds.start(), self.seeds.end());
        let words = [seeds, self.hours.to_string(), self.at_once.to_string()].map(OsString::from);
        let names = ["--seeds", "--hours", "--at-once"].map(OsString::from);
        let own = names.into_iter().zip(words).flat_map(|(name, value)| [name, value]);
        Ok(std::iter::once("months".into()).chain(own).chain(frozen::places(results, scratch)?).collect())
    }
}

/// Offset along x of SRF at a time, mm; `day` is the first day that sees a step.
fn offset_mm(day: u32, days: f64) -> f64 {
    DRIFT_MM * days + EVENTS.iter().filter(|(before, _)| *before <= day).map(|(_, step)| step).sum::<f64>()
}

/// Name of a day.
fn name(day: u32) -> String {
    let seconds = (FIRST_DAY + i64::from(day)) * 86_400;
    chrono::DateTime::from_timestamp(seconds, 0).map(|t| t.format("%Y-%m-%d").to_string()).unwrap_or_default()
}

/// Runs the seeds that `results` lacks, with the program of the commit that it names.
pub(crate) fn months(sets: &Sets, results: &Path, scratch: &Path) -> Result<(), CampaignError> {
    let lines: Vec<Months> = read(results)?;
    let commits = lines.iter().map(|line| line.commit.as_str());
    let Some(commit) = frozen::present_or_go_on(commits, || sets.arguments([results, scratch]))? else { return Ok(()) };
    let program = &Program::build()?;
    let build = program.whole_digest()?;
    let (results, _) = Results::<Months>::open(results, &commit)?;
    let (hours, configuration) = (sets.hours, format!("{}h", sets.hours));
    let tasks: Vec<u32> = sets.seeds.clone().filter(|seed| !results.has(&configuration, *seed)).collect();
    let meter = Meter::new(f64::from(DAYS) * tasks.len() as f64);
    work(tasks, sets.at_once, |seed| {
        let folder = scratch.join(format!("months-{seed}"));
        ScratchFolder::new(&folder)?;
        let set = Set { program, seed, hours, folder: &folder };
        let truth_m = set.fly(&meter)?;
        results.append(set.judge(&truth_m, [&build, &commit])?)?;
        std::fs::remove_dir_all(&folder).map_err(|e| file(&folder, &e))
    })?;
    results.sort(&[configuration]).map(|_| ())
}

struct Set<'a> {
    program: &'a Program,
    seed: u32,
    hours: f64,
    folder: &'a Path,
}

impl Set<'_> {
    /// Simulates and calibrates every day; gives the true offsets of each, m.
    fn fly(&self, meter: &Meter) -> Result<Vec<[f64; 6]>, CampaignError> {
        let chain = Chain { pipeline: science_mode(), ..Chain::default() };
        let mut truth_m = Vec::new();
        for day in 0..DAYS {
            let middle = f64::from(day) + 0.5 * self.hours / 24.0;
            let arguments = [
                "--start".to_owned(),
                name(day),
                "--hours".to_owned(),
                self.hours.to_string(),
                "--seed".to_owned(),
                (self.seed * 1000 + day).to_string(),
                "--effect".to_owned(),
                format!("com-offset:sc.x={:e}", 1e-3 * offset_mm(day, middle)),
            ];
            let telemetry = self.folder.join("telemetry");
            let made = self.program.simulate(&taiji(), &telemetry, &arguments)?;
            self.program.run(&chain, &made.files, &self.folder.join("archive"))?;
            std::fs::remove_dir_all(&telemetry).map_err(|e| file(&telemetry, &e))?;
            truth_m.push(made.truth_m);
            meter.say(1.0, &format!("seed {}, {}", self.seed, name(day)));
        }
        Ok(truth_m)
    }

    fn judge(&self, truth_m: &[[f64; 6]], [build, commit]: [&str; 2]) -> Result<Months, CampaignError> {
        let events: String = EVENTS
            .iter()
            .map(|(day, _)| {
                format!("- {{soe_event: MTEA, time: '{} 00:00:00 UTC', changes: [com-offset]}}\n", name(*day))
            })
            .collect();
        let path = self.folder.join("events.yaml");
        std::fs::write(&path, events).map_err(|e| file(&path, &e))?;
        let ask = |command: &str| -> Result<_, CampaignError> {
            let start = Instant::now();
            let days = format!("{}..{}", name(0), name(DAYS - 1));
            let answer = self.program.of_days(command, &days, &path, &self.folder.join("archive"))?;
            Ok((answer, start.elapsed().as_secs_f64()))
        };
        let ((joint, first_s), (_, again_s), (trend, _)) = (ask("joint")?, ask("joint")?, ask("trend")?);
        let lacks = |what: &str| file(&path, &format!("joint gives no {what}"));
        let per_mm: Vec<f64> = (0..6)
            .map(|i| {
                let last = f64::from(DAYS - 1) + 0.5 * self.hours / 24.0;
                let apart = offset_mm(DAYS - 1, last) - offset_mm(0, 0.5 * self.hours / 24.0);
                (truth_m[truth_m.len() - 1][i] - truth_m[0][i]) / apart
            })
            .collect();
        let mut coefficients = Vec::new();
        for (i, name) in COEFFICIENTS.iter().enumerate() {
            let all = joint["coefficients"].as_array().into_iter().flatten();
            let found = all.into_iter().find(|c| c["name"] == *name).ok_or_else(|| lacks(name))?;
            let pull = |value: &Value, truth: f64| -> Result<[f64; 2], CampaignError> {
                let number = |key: &str| value[key].as_f64().ok_or_else(|| lacks(key));
                Ok([rounded(number("value")? - truth), rounded(number("sigma")?)])
            };
            // From the middle of the last day to its end there is drift.
            let at_end = truth_m[truth_m.len() - 1][i] + per_mm[i] * DRIFT_MM * 0.5 * self.hours / 24.0;
            let steps = found["steps"].as_array().ok_or_else(|| lacks("steps"))?;
            coefficients.push(Course {
                value: pull(found, at_end)?,
                rate: pull(&found["rate"], per_mm[i] * DRIFT_MM / 86_400.0)?,
                rate_seen: found["rate"]["seen"] == true,
                steps: steps
                    .iter()
                    .zip(EVENTS)
                    .map(|(s, (_, mm))| pull(s, per_mm[i] * mm))
                    .collect::<Result<_, _>>()?,
                seen: steps.iter().map(|s| s["seen"] == true).collect(),
            });
        }
        let points = trend["coefficients"].as_array().into_iter().flatten().flat_map(|c| c["points"].as_array());
        let same = |key: &str| joint["same"][key].as_f64().ok_or_else(|| lacks(key));
        Ok(Months {
            seed: self.seed,
            hours: self.hours,
            build: build.to_owned(),
            commit: commit.to_owned(),
            joint_s: [rounded(first_s), rounded(again_s)],
            same: (rounded(same("chi2")?), same("dof")?),
            coefficients,
            alerts: trend["alerts"].as_array().into_iter().flatten().filter(|a| !a["coefficient"].is_null()).count(),
            predicted: points.flatten().filter(|p| !p["predicted"].is_null()).count(),
        })
    }
}

/// Error and σ of something of a coefficient, and whether it was seen where that is told.
type Told = ([f64; 2], Option<bool>);

/// What is said of the sets in VALIDATION.md, and what is outside of its bounds.
pub(crate) fn table(all: &[Months]) -> (String, Vec<String>) {
    let Some(first) = all.first() else { return ("Not run yet.\n".to_owned(), Vec::new()) };
    let mut failed = Vec::new();
    let n = all.len() * INDEPENDENT;
    // Two-sided, all eight together once in 100.
    let bounds = stats::rms(n, 0.01 / 8.0);
    let mut text = format!(
        "{} sets of {DAYS} days with {} h of telemetry each (build {}): the centre of mass drifts by {DRIFT_MM} mm a day along x of \
         SRF, and steps at four declared events. Pulls over all six coefficients and sets; those of the two test masses hang \
         together, so that bounds are those of {n} values, left by one of all eight once in 100.\n\n\
         | what | true along x of SRF | median σ of tm1.x | rms pull | accepted | seen in tm1.x |\n|---|---|---|---|---|---|\n",
        all.len(),
        first.hours,
        if first.commit.is_empty() { &first.build } else { first.commit.get(..12).unwrap_or(&first.commit) }
    );
    let mut row = |what: &str, truth: &str, factor: f64, of: &dyn Fn(&Course) -> Told| {
        let each = || all.iter().flat_map(|m| &m.coefficients).map(of);
        let count = each().count() as f64;
        let rms = (each().map(|([error, sigma], _)| (error / sigma).powi(2)).sum::<f64>() / count).sqrt();
        let own = || all.iter().map(|m| of(&m.coefficients[0]));
        let sigma = factor * stats::median(own().map(|([_, sigma], _)| sigma).collect());
        let seen = own().filter(|(_, seen)| *seen == Some(true)).count();
        let seen =
            if own().any(|(_, seen)| seen.is_some()) { format!("{seen} of {}", all.len()) } else { "–".to_owned() };
        let mark = if bounds.hold(rms) { "" } else { "**" };
        if !bounds.hold(rms) {
            failed.push(format!("months: rms pull of {what} is {rms:.2}"));
        }
        text += &format!(
            "| {what} | {truth} | {sigma:.3} | {mark}{rms:.2}{mark} | {:.2}–{:.2} | {seen} |\n",
            bounds.low, bounds.high
        );
    };
    row("value at the end, mm", "–", 1e3, &|c| (c.value, None));
    row("rate, mm/d", &DRIFT_MM.to_string(), 8.64e7, &|c| (c.rate, Some(c.rate_seen)));
    for (k, (day, step)) in EVENTS.iter().enumerate() {
        row(&format!("step before day {day}, mm"), &step.to_string(), 1e3, &move |c| (c.steps[k], Some(c.seen[k])));
    }
    let (chi2, dof) = all.iter().fold((0.0, 0.0), |(chi2, dof), m| (chi2 + m.same.0, dof + m.same.1));
    let accepted = stats::chi2_per_dof(dof, 0.01);
    if !accepted.hold(chi2 / dof) {
        failed.push(format!("months: days against the fit, χ²/dof {:.3}", chi2 / dof));
    }
    let false_steps = all.iter().flat_map(|m| &m.coefficients).filter(|c| c.seen[0]).count();
    let [alerts, predicted] = [all.iter().map(|m| m.alerts).sum::<usize>(), all.iter().map(|m| m.predicted).sum()];
    text += &format!(
        "\nDays against what fits them all: χ²/dof {:.3} on {dof:.0} degrees of freedom, accepted {:.3}–{:.3} (once in 100). Steps \
         reported where there is none: {false_steps} of {}, at a false-alarm rate of 1 in 100 for all steps and coefficients of a \
         set. `trend`: {alerts} of {predicted} predictions alarm, at most {:.0} are to be expected.\n",
        chi2 / dof,
        accepted.low,
        accepted.high,
        6 * all.len(),
        predicted as f64 * 0.01 / 6.0,
    );
    (text, failed)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The program of a commit is asked for the same sets, wherever it lies.
    #[test]
    fn another_program_is_asked_for_the_same_sets() {
        let sets = Sets { seeds: 3..=20, hours: 8.0, at_once: 2 };
        let arguments = sets.arguments(["/r.jsonl".as_ref(), "/scratch".as_ref()]).unwrap();
        let expected = "months --seeds 3-20 --hours 8 --at-once 2 --results /r.jsonl --scratch /scratch";
        assert_eq!(arguments, expected.split(' ').map(OsString::from).collect::<Vec<_>>());
        assert!(
            sets.arguments(["r.jsonl".as_ref(), "scratch".as_ref()]).unwrap()[8].to_string_lossy().starts_with('/')
        );
    }

    #[test]
    fn days_have_names_and_offsets() {
        assert_eq!((name(0).as_str(), name(31).as_str()), ("2035-01-01", "2035-02-01"));
        assert!((offset_mm(29, 29.0) - 0.58).abs() < 1e-12);
        assert!((offset_mm(60, 60.0) - (1.2 + 0.5 - 1.1)).abs() < 1e-12);
    }

    /// Errors of σ are within the bounds; of 1.5 σ they are not.
    #[test]
    fn the_table_marks_what_is_outside() {
        let set = |scale: f64| {
            let sign = |k: u32| if k.is_multiple_of(2) { 1.0 } else { -1.0 };
            let course = |k: u32| Course {
                value: [scale * sign(k), 1.0],
                rate: [scale * sign(k), 1.0],
                rate_seen: true,
                steps: vec![[scale * sign(k), 1.0]; 4],
                seen: vec![false, true, true, false],
            };
            (1..=20)
                .map(|seed| Months {
                    seed,
                    hours: 8.0,
                    build: "b".into(),
                    commit: String::new(),
                    joint_s: [1.0, 0.5],
                    same: (510.0, 510.0),
                    coefficients: (0..6).map(course).collect(),
                    alerts: 0,
                    predicted: 10,
                })
                .collect::<Vec<_>>()
        };
        let (text, failed) = table(&set(1.0));
        assert!(failed.is_empty() && text.contains("| 20 of 20 |") && text.contains("0 of 120"), "{text}");
        assert_eq!(table(&set(1.5)).1.len(), 6);
    }
}
