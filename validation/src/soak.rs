//! A year and more of days through `dragfree watch`, a third of them late, cut, doubled or corrected, and the program
//! killed now and then: the archive must be that of the same days without any of it.

use std::collections::BTreeMap;
use std::ops::RangeInclusive;
use std::path::{Path, PathBuf};
use std::process::{Child, Command};
use std::time::{Duration, Instant};

use chrono::{Days, NaiveDate};
use dragfree_tests::recording::Recording;
use rand::{RngExt as _, SeedableRng as _};
use rand_xoshiro::Xoshiro256PlusPlus;
use serde::{Deserialize, Serialize};
use serde_json::json;

use crate::campaign::{Meter, ScratchFolder, note};
use crate::error::{CampaignError, file};
use crate::program::Program;
use crate::records::{Keyed, Results};

/// Part of the days on which something is wrong, and part of those after which the program is killed.
const WRONG: f64 = 1.0 / 3.0;
const KILLED: f64 = 0.05;

/// Days of the last life of the program before its memory and handles are first looked at.
const WARM: u32 = 20;

/// Growth of the memory that is allowed, over that at the first look.
const GROWTH: f64 = 0.05;

/// What a product says that must be the same.
const SAID: [&str; 7] = ["coefficients", "covariance", "verdict", "quality", "losses", "model", "history"];

/// Longest wait until a day is run, s.
const PATIENCE_S: u64 = 120;

/// The program rests when it has used no processor for so long, s: before, it may not have given memory back.
const REST_S: f64 = 0.3;

/// One soak.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Soak {
    seed: u32,
    /// Digest of program and plugins.
    build: String,
    days: u32,
    /// How many days were late, cut, doubled, corrected.
    late: u32,
    cut: u32,
    doubled: u32,
    corrected: u32,
    kills: u32,
    /// Products, all revisions.
    products: u32,
    /// What is wrong: days whose newest product is not that of the calm archive, and what `verify` finds.
    differences: Vec<String>,
    /// Memory in use and open handles of the last life, at rest: at the first look, and the most after it.
    memory_kb: [u64; 2],
    handles: [u64; 2],
    /// Days of that life.
    last_life_days: u32,
    seconds: f64,
}

impl Keyed for Soak {
    fn key(&self) -> (String, u32) {
        (String::new(), self.seed)
    }

    fn made_with(&self) -> &str {
        &self.build
    }
}

/// Runs the seeds that `results` lacks.
pub(crate) fn soak(
    program: &Program,
    seeds: RangeInclusive<u32>,
    days: u32,
    results: &Path,
    scratch: &Path,
) -> Result<(), CampaignError> {
    let build = program.whole_digest()?;
    let (results, _) = Results::<Soak>::open(results, &build)?;
    for seed in seeds.filter(|seed| !results.has("", *seed)).collect::<Vec<_>>() {
        let folder = scratch.join(format!("soak-{seed}"));
        ScratchFolder::new(&folder)?;
        let soak = Bench::new(program, &folder, seed, days)?.run(&build)?;
        results.append(soak)?;
        std::fs::remove_dir_all(&folder).map_err(|e| file(&folder, &e))?;
    }
    let all = results.sort(&[""])?;
    note(&table(&all).0);
    Ok(())
}

/// What is wrong with a file when it first comes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Fault {
    /// It comes days later.
    Late,
    /// It is cut off, and comes whole days later.
    Cut,
    /// It comes twice.
    Doubled,
    /// Messages are missing, and it comes whole days later.
    Corrected,
}

/// What happens to the inbox.
enum Arrival {
    /// The whole file of a night.
    Whole(u32),
    /// A part of it.
    Part(u32, Fault),
    /// The whole file under another name.
    Again(u32),
}

/// Two missions of the same nights: one whose telemetry comes whole and in order, one with everything else.
struct Bench<'a> {
    program: &'a Program,
    dice: Xoshiro256PlusPlus,
    seed: u32,
    days: u32,
    calm: PathBuf,
    storm: PathBuf,
    vault: PathBuf,
}

impl<'a> Bench<'a> {
    fn new(program: &'a Program, folder: &Path, seed: u32, days: u32) -> Result<Self, CampaignError> {
        let bench = Self {
            program,
            dice: Xoshiro256PlusPlus::seed_from_u64(u64::from(seed)),
            seed,
            days,
            calm: folder.join("calm"),
            storm: folder.join("storm"),
            vault: folder.join("calm/telemetry"),
        };
        for mission in [&bench.calm, &bench.storm] {
            program.ask(folder, &["init", &mission.to_string_lossy()])?;
            let inbox = mission.join("telemetry");
            std::fs::create_dir_all(&inbox).map_err(|e| file(&inbox, &e))?;
        }
        Ok(bench)
    }

    /// The files of a night: twelve minutes before midnight and twelve after it, so that a day has two pieces, and the
    /// second of the day before is its run-in.
    fn night(&self, night: u32) -> Result<[PathBuf; 2], CampaignError> {
        let first = NaiveDate::from_ymd_opt(2035, 1, 1).unwrap_or_default();
        let day = |k: u32| first + Days::new(u64::from(k));
        let made = self.calm.join("made");
        let (start, seed) = (format!("{}T23:48:00Z", day(night)), (1000 * self.seed + night).to_string());
        let more = ["--out", "made", "--start", &start, "--hours", "0.4", "--seed", &seed];
        self.program.ask(&self.calm, &[&["simulate", "mission.toml"], &more[..]].concat())?;
        let mut files = [PathBuf::new(), PathBuf::new()];
        for (k, to) in files.iter_mut().enumerate() {
            let from = made.join(format!("SC1_{}.mcap", day(night + k as u32)));
            *to = self.vault.join(format!("night{night:03}-{k}.mcap"));
            std::fs::rename(&from, &*to).map_err(|e| file(&from, &e))?;
        }
        std::fs::remove_dir_all(&made).map_err(|e| file(&made, &e))?;
        Ok(files)
    }

    /// What happens on which day: every file comes whole at last.
    fn calendar(&mut self, counts: &mut BTreeMap<Fault, u32>) -> BTreeMap<u32, Vec<Arrival>> {
        let mut all: BTreeMap<u32, Vec<Arrival>> = BTreeMap::new();
        for night in 0..self.days {
            let later = (night + self.dice.random_range(1..=10)).min(self.days);
            let faults = [Fault::Late, Fault::Cut, Fault::Doubled, Fault::Corrected];
            let wrong = self.dice.random_bool(WRONG).then(|| faults[self.dice.random_range(0..faults.len())]);
            if let Some(fault) = wrong {
                *counts.entry(fault).or_default() += 1;
            }
            let mut on = |day: u32, arrival: Arrival| all.entry(day).or_default().push(arrival);
            match wrong {
                None => on(night, Arrival::Whole(night)),
                Some(Fault::Late) => on(later, Arrival::Whole(night)),
                Some(Fault::Doubled) => {
                    on(night, Arrival::Whole(night));
                    on(later, Arrival::Again(night));
                }
                Some(fault) => {
                    on(night, Arrival::Part(night, fault));
                    on(later, Arrival::Whole(night));
                }
            }
        }
        all
    }

    fn arrives(&self, arrival: &Arrival) -> Result<(), CampaignError> {
        let (night, name) = match arrival {
            Arrival::Whole(night) | Arrival::Part(night, _) => (*night, ""),
            Arrival::Again(night) => (*night, "again-"),
        };
        for k in 0..2 {
            let from = self.vault.join(format!("night{night:03}-{k}.mcap"));
            let to = self.storm.join(format!("telemetry/{name}night{night:03}-{k}.mcap"));
            // Written beside and renamed, as every transfer should do it.
            let beside = to.with_extension("part");
            let io = |e: std::io::Error| file(&to, &e);
            match arrival {
                Arrival::Part(_, Fault::Cut) => {
                    let bytes = std::fs::read(&from).map_err(io)?;
                    std::fs::write(&beside, &bytes[..bytes.len() * 3 / 5]).map_err(io)?;
                }
                Arrival::Part(..) => {
                    let recording = Recording::read(&from);
                    let gap = recording.start_ns() + 200_000_000_000..recording.start_ns() + 320_000_000_000;
                    recording.write(&beside, |m| (!gap.contains(&m.log_time)).then_some(m));
                }
                _ => drop(std::fs::copy(&from, &beside).map_err(io)?),
            }
            std::fs::rename(&beside, &to).map_err(io)?;
        }
        Ok(())
    }

    fn watch(&self) -> Result<Child, CampaignError> {
        self.program.start(&self.storm, &["watch", "--settle-s", "0.05"])
    }

    /// Waits until no day is due.
    fn settles(&self) -> Result<(), CampaignError> {
        let since = Instant::now();
        loop {
            let due = self.program.ask(&self.storm, &["catch-up", "--dry-run"])?;
            if due["days"].as_array().is_some_and(Vec::is_empty) {
                return Ok(());
            }
            if since.elapsed() > Duration::from_secs(PATIENCE_S) {
                return Err(file(&self.storm, &format!("after {PATIENCE_S} s there are still due: {}", due["days"])));
            }
            std::thread::sleep(Duration::from_millis(50));
        }
    }

    /// Waits until the program rests.
    fn rests(&self, id: u32) -> Result<(), CampaignError> {
        let begun = Instant::now();
        let (mut used, mut since) = (processor_ticks(id), Instant::now());
        while since.elapsed().as_secs_f64() < REST_S {
            if begun.elapsed() > Duration::from_secs(PATIENCE_S) {
                return Err(file(&self.storm, &format!("watch has not come to rest in {PATIENCE_S} s")));
            }
            std::thread::sleep(Duration::from_millis(20));
            let now = processor_ticks(id);
            if now != used {
                (used, since) = (now, Instant::now());
            }
        }
        Ok(())
    }

    /// The newest product of every day, what it says and of which bytes it was made, and the number of all. A file that
    /// comes twice has two names, and which of them a product states is no matter here.
    fn held(&self, mission: &Path) -> Result<(BTreeMap<String, String>, u32), CampaignError> {
        let list = self.program.ask(mission, &["products", "list"])?;
        let products = list["products"].as_array().cloned().unwrap_or_default();
        let mut newest = BTreeMap::new();
        for product in &products {
            let id = product["id"].as_str().unwrap_or_default();
            newest.insert(product["day"].as_str().unwrap_or_default().to_owned(), id.to_owned());
        }
        for id in newest.values_mut() {
            let shown = self.program.ask(mission, &["products", "show", id])?;
            let inputs = shown["inputs"].as_array().into_iter().flatten();
            let mut bytes: Vec<&str> = inputs.filter_map(|input| input["sha256"].as_str()).collect();
            bytes.sort_unstable();
            let said = SAID.map(|key| format!("{key} {}", shown[key]));
            *id = format!("{}\n{}", said.join("\n"), bytes.join(" "));
        }
        Ok((newest, products.len() as u32))
    }

    fn run(mut self, build: &str) -> Result<Soak, CampaignError> {
        let start = Instant::now();
        let meter = Meter::new(f64::from(2 * self.days));
        for night in 0..self.days {
            self.night(night)?;
            meter.say(1.0, &format!("night {night} is simulated"));
        }
        self.program.ask(&self.calm, &["catch-up"])?;
        let mut counts = BTreeMap::new();
        let calendar = self.calendar(&mut counts);
        let (mut kills, mut life) = (0, 0);
        let (mut memory_kb, mut handles) = ([0; 2], [0; 2]);
        let mut child = self.watch()?;
        for day in 0..=self.days {
            for arrival in calendar.get(&day).into_iter().flatten() {
                self.arrives(arrival)?;
            }
            life += 1;
            // The second half is one life, in which memory and handles are looked at.
            if day < self.days / 2 && self.dice.random_bool(KILLED) {
                std::thread::sleep(Duration::from_secs_f64(self.dice.random_range(0.0..2.0)));
                let _ = child.kill();
                let _ = child.wait();
                child = self.watch()?;
                (kills, life) = (kills + 1, 0);
            }
            self.settles()?;
            self.rests(child.id())?;
            if let Some(now) = in_use(child.id()).filter(|_| life >= WARM && day >= self.days / 2) {
                for (seen, now) in [&mut memory_kb, &mut handles].into_iter().zip(now) {
                    *seen = if seen[0] == 0 { [now; 2] } else { [seen[0], seen[1].max(now)] };
                }
            }
            meter.say(1.0, &format!("day {day}: {kills} kills, {} kB, {} handles", memory_kb[1], handles[1]));
        }
        let _ = Command::new("kill").args(["-TERM", &child.id().to_string()]).status();
        let ended = child.wait().map_err(|e| file(&self.storm, &e))?;
        let ((calm, _), (storm, products)) = (self.held(&self.calm)?, self.held(&self.storm)?);
        let mut differences = differences(&calm, &storm);
        let verified = self.program.ask(&self.storm, &["products", "verify", "--all"])?;
        if verified["broken"] != json!([]) {
            differences.push(format!("broken: {}", verified["broken"]));
        }
        if !ended.success() {
            differences.push(format!("watch ended with {ended}"));
        }
        let count = |fault| counts.get(&fault).copied().unwrap_or(0);
        Ok(Soak {
            seed: self.seed,
            build: build.to_owned(),
            days: self.days,
            late: count(Fault::Late),
            cut: count(Fault::Cut),
            doubled: count(Fault::Doubled),
            corrected: count(Fault::Corrected),
            kills,
            products,
            differences,
            memory_kb,
            handles,
            last_life_days: life,
            seconds: start.elapsed().as_secs_f64().round(),
        })
    }
}

/// Days of which two archives have not the same product.
fn differences(calm: &BTreeMap<String, String>, storm: &BTreeMap<String, String>) -> Vec<String> {
    let mut days: Vec<&String> = calm.keys().chain(storm.keys()).collect();
    days.sort();
    days.dedup();
    days.into_iter().filter(|day| calm.get(*day) != storm.get(*day)).cloned().collect()
}

/// Memory in use, kB, and open handles of a process; none where the system does not tell.
fn in_use(id: u32) -> Option<[u64; 2]> {
    let status = std::fs::read_to_string(format!("/proc/{id}/status")).ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:"))?;
    let memory = line.trim().trim_end_matches("kB").trim().parse().ok()?;
    Some([memory, std::fs::read_dir(format!("/proc/{id}/fd")).ok()?.count() as u64])
}

/// Time of the processors that a process has used, in ticks of the system; none where it does not tell.
fn processor_ticks(id: u32) -> Option<u64> {
    let stat = std::fs::read_to_string(format!("/proc/{id}/stat")).ok()?;
    // After the name, which may have spaces, come the state and ten more fields.
    let fields: Vec<&str> = stat.rsplit(')').next()?.split_whitespace().collect();
    Some(fields.get(11)?.parse::<u64>().ok()? + fields.get(12)?.parse::<u64>().ok()?)
}

/// What is said of the soaks in VALIDATION.md, and what is outside of its bounds.
pub(crate) fn table(all: &[Soak]) -> (String, Vec<String>) {
    if all.is_empty() {
        return ("Not run yet.\n".to_owned(), Vec::new());
    }
    let mut text =
        "| days | late | cut | doubled | corrected | kills | products | days that differ | memory at rest | handles | time |\n\
                    |---|---|---|---|---|---|---|---|---|---|---|\n"
            .to_owned();
    let mut failed = Vec::new();
    for s in all {
        let mb = s.memory_kb.map(|kb| kb as f64 / 1e3);
        text += &format!(
            "| {} | {} | {} | {} | {} | {} | {} | {} | {:.1}, at most {:.1} MB in {} days | {}, at most {} | {:.0} min |\n",
            s.days,
            s.late,
            s.cut,
            s.doubled,
            s.corrected,
            s.kills,
            s.products,
            s.differences.len(),
            mb[0],
            mb[1],
            s.last_life_days,
            s.handles[0],
            s.handles[1],
            s.seconds / 60.0
        );
        failed.extend(s.differences.iter().map(|day| format!("soak: seed {}: {day} differs", s.seed)));
        if mb[1] > (1.0 + GROWTH) * mb[0] {
            failed.push(format!("soak: seed {}: memory grew from {:.1} to {:.1} MB", s.seed, mb[0], mb[1]));
        }
        if s.handles[1] != s.handles[0] {
            failed.push(format!("soak: seed {}: handles grew from {} to {}", s.seed, s.handles[0], s.handles[1]));
        }
    }
    (text, failed)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn soak(memory_kb: [u64; 2], handles: [u64; 2], differences: &[&str]) -> Soak {
        Soak {
            seed: 1,
            build: "b".to_owned(),
            days: 400,
            late: 30,
            cut: 31,
            doubled: 32,
            corrected: 33,
            kills: 10,
            products: 500,
            differences: differences.iter().map(|d| (*d).to_owned()).collect(),
            memory_kb,
            handles,
            last_life_days: 200,
            seconds: 1200.0,
        }
    }

    #[test]
    fn what_grows_or_differs_fails() {
        let (text, failed) = table(&[soak([40_000, 41_900], [9, 9], &[])]);
        assert!(failed.is_empty() && text.contains("| 400 | 30 | 31 | 32 | 33 | 10 | 500 | 0 |"), "{text} {failed:?}");
        assert_eq!(table(&[soak([40_000, 42_100], [9, 10], &["2035-03-01"])]).1.len(), 3);
    }

    #[test]
    fn days_differ_by_product_or_absence() {
        let of = |all: &[(&str, &str)]| all.iter().map(|(a, b)| ((*a).to_owned(), (*b).to_owned())).collect();
        let (calm, storm) = (of(&[("1", "a"), ("2", "b"), ("3", "c")]), of(&[("1", "a"), ("2", "x"), ("4", "d")]));
        assert_eq!(differences(&calm, &storm), ["2", "3", "4"]);
    }

    #[test]
    fn a_process_has_memory_handles_and_processor_time() {
        assert!(processor_ticks(std::process::id()).is_some());
        let [memory, handles] = in_use(std::process::id()).expect("told");
        assert!(memory > 100 && handles >= 3, "{memory} {handles}");
    }
}
