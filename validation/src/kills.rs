//! Programs that are killed at random instants, and what the next one finds.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::{Duration, Instant};

use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::campaign::{Meter, ScratchFolder, work};
use crate::error::{CampaignError, file};
use crate::program::Program;
use crate::records::{Keyed, Results};

/// What is killed, with its arguments.
const COMMANDS: [(&str, &[&str]); 5] = [
    ("day", &["day", "2035-01-02"]),
    ("catch-up", &["catch-up"]),
    ("joint", &["joint", "2035-01-01..2035-01-02"]),
    (
        "certify",
        &["products", "certify", "2035-01-01", "--from", "2035-01-01", "--until", "2035-01-02", "--into", "ops"],
    ),
    ("reindex", &["archive", "reindex"]),
];

/// By what.
const SIGNALS: [&str; 3] = ["KILL", "TERM", "INT"];

/// Days with a product in the archive that every kill begins with; the third comes in while nothing runs.
const DAYS: u32 = 3;

/// One kill.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Kill {
    /// Seed, which determines all of it.
    pub(crate) seed: u32,
    /// Digest of program and plugins.
    pub(crate) build: String,
    /// Command.
    pub(crate) command: String,
    /// Signal.
    pub(crate) signal: String,
    /// When, s after the start.
    pub(crate) after_s: f64,
    /// Whether the program had ended by then.
    pub(crate) ended: bool,
    /// What was wrong afterwards.
    pub(crate) violations: Vec<String>,
}

impl Keyed for Kill {
    fn key(&self) -> (String, u32) {
        (String::new(), self.seed)
    }

    fn made_with(&self) -> &str {
        &self.build
    }
}

/// Does the kills that `results` lacks.
pub(crate) fn kills(
    program: &Program,
    seeds: std::ops::RangeInclusive<u32>,
    at_once: usize,
    results: &Path,
    scratch: &Path,
) -> Result<(), CampaignError> {
    let build = program.whole_digest()?;
    let (results, _) = Results::<Kill>::open(results, &build)?;
    let tasks: Vec<u32> = seeds.filter(|seed| !results.has("", *seed)).collect();
    let base = scratch.join("kills-base");
    ScratchFolder::new(&base)?;
    let bench = Bench::new(program, &base)?;
    let meter = Meter::new(tasks.len() as f64);
    work(tasks, at_once, |seed| {
        let folder = scratch.join(format!("kill-{seed}"));
        ScratchFolder::new(&folder)?;
        let kill = bench.kill(seed, &folder, &build)?;
        meter.say(1.0, &format!("{} SIG{} {}", kill.command, kill.signal, kill.violations.join("; ")));
        results.append(kill)?;
        std::fs::remove_dir_all(&folder).map_err(|e| file(&folder, &e))
    })?;
    results.sort(&[""]).map(|_| ())
}

/// What every kill begins with.
struct Bench<'a> {
    program: &'a Program,
    mission: PathBuf,
    /// Per command, how long it takes undisturbed, s, and what the archive holds then.
    undisturbed: Vec<(f64, Held)>,
}

/// Products, without revisions, with their digests; and what is certified.
type Held = (BTreeMap<String, String>, Value);

impl<'a> Bench<'a> {
    fn new(program: &'a Program, folder: &Path) -> Result<Self, CampaignError> {
        let mission = folder.join("mission");
        program.ask(folder, &["init", "mission"])?;
        let ops = mission.join("mission-ops.toml");
        let text = std::fs::read_to_string(&ops).map_err(|e| file(&ops, &e))?;
        let text = text.replace("run_in_hours = 1.0", "run_in_hours = 0.0");
        std::fs::write(&ops, text).map_err(|e| file(&ops, &e))?;
        for day in 1..=DAYS {
            let (out, start) = (format!("d{day}"), format!("2035-01-{day:02}"));
            let more = ["--out", &out, "--start", &start, "--hours", "0.2", "--seed", &day.to_string()];
            program.ask(&mission, &[&["simulate", "mission.toml"], &more[..]].concat())?;
            let name = format!("SC1_2035-01-{day:02}.mcap");
            let to = mission.join(if day < DAYS { "telemetry" } else { "late" });
            std::fs::create_dir_all(&to).map_err(|e| file(&to, &e))?;
            std::fs::rename(mission.join(out).join(&name), to.join(&name)).map_err(|e| file(&to, &e))?;
        }
        program.ask(&mission, &["catch-up"])?;
        let mut bench = Self { program, mission, undisturbed: Vec::new() };
        for (number, (_, arguments)) in COMMANDS.iter().enumerate() {
            let own = folder.join(format!("undisturbed-{number}"));
            bench.copy(&own)?;
            let start = Instant::now();
            program.ask(&own, arguments)?;
            bench.undisturbed.push((start.elapsed().as_secs_f64(), held(program, &own)?));
        }
        Ok(bench)
    }

    /// The mission with the products of two days, and the telemetry of a third.
    fn copy(&self, to: &Path) -> Result<(), CampaignError> {
        let copied = Command::new("cp").arg("-a").arg(&self.mission).arg(to).status();
        if !copied.is_ok_and(|status| status.success()) {
            return Err(file(to, &"cp failed"));
        }
        let name = format!("SC1_2035-01-{DAYS:02}.mcap");
        let (from, into) = (to.join("late").join(&name), to.join("telemetry").join(&name));
        std::fs::rename(from, &into).map_err(|e| file(&into, &e))
    }

    fn kill(&self, seed: u32, folder: &Path, build: &str) -> Result<Kill, CampaignError> {
        let mission = folder.join("mission");
        self.copy(&mission)?;
        let number = seed as usize % COMMANDS.len();
        let (name, arguments) = COMMANDS[number];
        let signal = SIGNALS[(seed as usize / COMMANDS.len()) % SIGNALS.len()];
        let (length_s, expected) = &self.undisturbed[number];
        // A golden-ratio sequence covers the length evenly, whatever the number of seeds.
        let after_s = 1.05 * length_s * (f64::from(seed) * 0.618_033_988_749_895).fract();
        let before = held(self.program, &mission)?;
        let mut child = self.program.start(&mission, arguments)?;
        std::thread::sleep(Duration::from_secs_f64(after_s));
        let ended = child.try_wait().is_ok_and(|status| status.is_some());
        if !ended {
            let _ = Command::new("kill").args([&format!("-{signal}"), &child.id().to_string()]).status();
        }
        let _ = child.wait();
        let mut violations = sound(self.program, &mission, &before)?;
        // The next one is as if nothing had been; what was certified is certified.
        let start = Instant::now();
        let again = self.program.ask(&mission, arguments);
        let waited = start.elapsed().as_secs_f64() > 5.0 + 5.0 * length_s;
        let after = held(self.program, &mission)?;
        // What was certified before the kill is refused once more.
        if let Err(error) = again
            && (name != "certify" || after.1 != expected.1)
        {
            violations.push(format!("the next one fails: {error}"));
        }
        if waited {
            violations.push("the next one waits".to_owned());
        }
        if after != *expected {
            violations.push("the next one gives something else".to_owned());
        }
        violations.extend(sound(self.program, &mission, &after)?);
        Ok(Kill {
            seed,
            build: build.to_owned(),
            command: name.to_owned(),
            signal: signal.to_owned(),
            after_s: (after_s * 1e3).round() / 1e3,
            ended,
            violations,
        })
    }
}

/// What an archive holds.
fn held(program: &Program, mission: &Path) -> Result<Held, CampaignError> {
    let list = program.ask(mission, &["products", "list"])?;
    let mut products = BTreeMap::new();
    for product in list["products"].as_array().into_iter().flatten() {
        let id = product["id"].as_str().unwrap_or_default();
        let shown = program.ask(mission, &["products", "show", id])?;
        let stem = id.rsplit_once('_').map_or(id, |(stem, _)| stem);
        products.insert(stem.to_owned(), shown["sha256"].as_str().unwrap_or_default().to_owned());
    }
    Ok((products, program.ask(mission, &["products", "sets", "list"])?["sets"].take()))
}

/// What is wrong with an archive: something that was there is gone, half visible or left over, or there is a gap.
fn sound(program: &Program, mission: &Path, before: &Held) -> Result<Vec<String>, CampaignError> {
    let mut wrong = Vec::new();
    let list = program.ask(mission, &["products", "list"])?;
    if list["problems"] != serde_json::json!([]) {
        wrong.push(format!("problems {}", list["problems"]));
    }
    let verified = program.ask(mission, &["products", "verify"])?;
    if verified["broken"] != serde_json::json!([]) {
        wrong.push(format!("broken {}", verified["broken"]));
    }
    let now = held(program, mission)?;
    let lost = before.0.iter().filter(|(stem, digest)| now.0.get(*stem) != Some(digest));
    wrong.extend(lost.map(|(stem, _)| format!("{stem} is lost or changed")));
    let archive = mission.join("archive");
    let left = std::fs::read_dir(archive.join("staging")).map_or(0, Iterator::count);
    if left > 0 {
        wrong.push(format!("{left} leftovers"));
    }
    let mut revisions: BTreeMap<String, Vec<u32>> = BTreeMap::new();
    for product in list["products"].as_array().into_iter().flatten() {
        let id = product["id"].as_str().unwrap_or_default();
        if let Some((stem, revision)) = id.rsplit_once('_') {
            revisions.entry(stem.to_owned()).or_default().push(revision.parse().unwrap_or(0));
        }
    }
    for (stem, mut all) in revisions {
        all.sort_unstable();
        if !all.iter().copied().eq(1..=all.len() as u32) {
            wrong.push(format!("a gap in the revisions of {stem}: {all:?}"));
        }
    }
    Ok(wrong)
}

/// What is said of the kills in VALIDATION.md, and what is wrong.
pub(crate) fn table(all: &[Kill]) -> (String, Vec<String>) {
    let Some(first) = all.first() else { return ("Not run yet.\n".to_owned(), Vec::new()) };
    let mut text = format!(
        "{} kills (build {}), each at an instant of its own in the length of the command, and after each a list, a check of every \
         digest, and the same command once more: nothing lost, half visible or left over, no gap, no waiting, the same digests.\n\n\
         | command | SIGKILL | SIGTERM | SIGINT | had ended | violations |\n|---|---|---|---|---|---|\n",
        all.len(),
        first.build
    );
    for (name, _) in COMMANDS {
        let own: Vec<&Kill> = all.iter().filter(|kill| kill.command == name).collect();
        let by = |signal: &str| own.iter().filter(|kill| kill.signal == signal && !kill.ended).count();
        let [kill, term, int] = SIGNALS.map(by);
        let ended = own.iter().filter(|kill| kill.ended).count();
        let wrong = own.iter().filter(|kill| !kill.violations.is_empty()).count();
        text += &format!("| `{name}` | {kill} | {term} | {int} | {ended} | {wrong} |\n");
    }
    let wrong = all.iter().filter(|kill| !kill.violations.is_empty());
    let failed =
        wrong.map(|k| format!("kills: seed {} ({} SIG{}): {}", k.seed, k.command, k.signal, k.violations.join("; ")));
    (text, failed.collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn violations_are_counted_and_told() {
        let kill = |seed: u32, violations: &[&str]| Kill {
            seed,
            build: "b".into(),
            command: COMMANDS[seed as usize % 5].0.into(),
            signal: "KILL".into(),
            after_s: 0.1,
            ended: seed > 7,
            violations: violations.iter().map(|v| (*v).to_owned()).collect(),
        };
        let (text, failed) = table(&[kill(1, &[]), kill(6, &["lost"]), kill(8, &[])]);
        assert!(
            text.contains("| `catch-up` | 2 | 0 | 0 | 0 | 1 |") && text.contains("| `certify` | 0 | 0 | 0 | 1 | 0 |"),
            "{text}"
        );
        assert_eq!(failed, ["kills: seed 6 (catch-up SIGKILL): lost"]);
    }
}
