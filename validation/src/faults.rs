//! Mixtures of faults in telemetry of two producers: whether a product is ever wrong and says that it is right.
//!
//! Each seed determines the producer, the flight, in which nothing is hidden, and one to four faults of messages or
//! bytes. What `run` says of the telemetry is compared with the truth.

use std::fs;
use std::ops::{Range, RangeInclusive};
use std::path::{Path, PathBuf};

use dragfree_tests::foreign::Draw;
use dragfree_tests::recording::{Message, Recording};
use rand::{RngExt as _, SeedableRng as _};
use rand_distr::{Distribution as _, StandardNormal};
use rand_xoshiro::Xoshiro256PlusPlus;
use serde::{Deserialize, Serialize};

use crate::campaign::{Meter, ScratchFolder, note, science_mode, taiji, work};
use crate::error::{CampaignError, file};
use crate::program::{Chain, Program, Ran, solution};
use crate::records::{Keyed, Results, rounded};

/// Length of a flight, h.
const HOURS: f64 = 2.0;
const SAMPLES: u64 = 72_000;
const STEP_NS: u64 = 100_000_000;

/// Most faults of one set.
const MOST: usize = 4;

/// Error over σ from which a value that is said to be right is wrong.
const WRONG: f64 = 4.0;

/// What may be wrong with telemetry.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
enum Kind {
    /// Every topic is missing for a while.
    Gap,
    /// One topic is missing for a while.
    GapOfTopic,
    /// Messages are missing here and there.
    Loss,
    /// Messages come twice.
    Twice,
    /// Messages come twice with different values.
    Conflict,
    /// Messages of a while come in another order.
    Disorder,
    /// Single samples are far off.
    Spikes,
    /// Values are not numbers for a while.
    NotNumbers,
    /// A value does not change for a while.
    Stuck,
    /// A status says that values are not valid, and they are not.
    Flagged,
    /// A readout has another zero from some time on.
    Step,
    /// The clock is set forward.
    ClockStep,
    /// One topic has its times late for a while.
    LateTimes,
    /// A readout is louder for a while.
    Burst,
    /// There are no commands.
    NoCommands,
    /// There is no housekeeping.
    NoHousekeeping,
    /// The ephemeris is missing for a while.
    GapOfEphemeris,
    /// The file ends early.
    Cut,
    /// Bytes of the file are changed.
    FlippedBytes,
    /// The data come in overlapping files.
    Pieces,
}

const KINDS: [(Kind, &str); 20] = [
    (Kind::Gap, "hours without data are left out"),
    (Kind::GapOfTopic, "as a gap, where the topic is needed"),
    (Kind::Loss, "as a gap"),
    (Kind::Twice, "counted; the value is that without"),
    (Kind::Conflict, "lost data, exit code 3; the first in the order of the file counts"),
    (Kind::Disorder, "put in order; the value is that without"),
    (Kind::Spikes, "left out or weighed down, or no agreement"),
    (Kind::NotNumbers, "as a gap"),
    (Kind::Stuck, "left out, or no agreement"),
    (Kind::Flagged, "as a gap"),
    (Kind::Step, "left out, or no agreement"),
    (Kind::ClockStep, "a gap; the value is that without"),
    (Kind::LateTimes, "no agreement, where it can be seen"),
    (Kind::Burst, "no agreement, or a larger σ"),
    (Kind::NoCommands, "commands are reconstructed"),
    (Kind::NoHousekeeping, "the value is that without"),
    (Kind::GapOfEphemeris, "interpolated, or left out"),
    (Kind::Cut, "lost data, exit code 3"),
    (Kind::FlippedBytes, "lost data, exit code 3"),
    (Kind::Pieces, "the value is that of one file"),
];

/// One set.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Mixture {
    seed: u32,
    /// Digest of program and plugins.
    build: String,
    /// Whether the telemetry is that of the bundled simulator.
    own: bool,
    faults: Vec<Fault>,
    /// Exit code of `run`.
    exit: i32,
    /// The first line on stderr where there is no product.
    refused: Option<String>,
    /// Verdict of the product; none where no value was adopted.
    verdict: Option<String>,
    /// Largest error over σ of the adopted values.
    largest_pull: Option<f64>,
}

/// A fault as it was drawn.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Fault {
    kind: Kind,
    /// What exactly.
    detail: String,
}

impl Keyed for Mixture {
    fn key(&self) -> (String, u32) {
        (String::new(), self.seed)
    }

    fn made_with(&self) -> &str {
        &self.build
    }
}

impl Mixture {
    /// Says that its values are right where one is not.
    fn confidently_wrong(&self) -> bool {
        self.verdict.as_deref() == Some("agree") && self.largest_pull.is_some_and(|pull| pull > WRONG)
    }
}

/// Flies the seeds that `results` lacks.
pub(crate) fn faults(
    program: &Program,
    seeds: RangeInclusive<u32>,
    at_once: usize,
    results: &Path,
    scratch: &Path,
) -> Result<(), CampaignError> {
    let build = program.whole_digest()?;
    let (results, _) = Results::<Mixture>::open(results, &build)?;
    let tasks: Vec<u32> = seeds.filter(|seed| !results.has("", *seed)).collect();
    let meter = Meter::new(tasks.len() as f64);
    work(tasks, at_once, |seed| {
        let folder = scratch.join(format!("faults-{seed}"));
        ScratchFolder::new(&folder)?;
        let mixture = mixture(program, seed, &build, &folder)?;
        let wrong = if mixture.confidently_wrong() { "CONFIDENTLY WRONG " } else { "" };
        let kinds: Vec<String> = mixture.faults.iter().map(|f| format!("{:?}", f.kind)).collect();
        let verdict = mixture.verdict.as_deref().or(mixture.refused.as_deref()).unwrap_or("no value");
        meter.say(1.0, &format!("seed {seed}: {wrong}{} → {verdict}", kinds.join(" ")));
        results.append(mixture)?;
        fs::remove_dir_all(&folder).map_err(|e| file(&folder, &e))
    })?;
    let all = results.sort(&[""])?;
    note(&table(&all).0);
    Ok(())
}

fn mixture(program: &Program, seed: u32, build: &str, folder: &Path) -> Result<Mixture, CampaignError> {
    let mut dice = Xoshiro256PlusPlus::seed_from_u64(u64::from(seed));
    let own = dice.random_bool(0.5);
    let io = |e: std::io::Error| file(folder, &e);
    let mut chain = Chain { pipeline: science_mode(), ..Chain::default() };
    let (telemetry, truth_m) = if own {
        let arguments = ["--seed".to_owned(), seed.to_string(), "--hours".to_owned(), HOURS.to_string()];
        let made = program.simulate(&taiji(), &folder.join("telemetry"), &arguments)?;
        (made.files, made.truth_m)
    } else {
        let draw = Draw::new(u64::from(seed), HOURS, true);
        let bundled = fs::read_to_string(taiji()).map_err(io)?;
        let mission = draw.mission(&bundled).ok_or_else(|| file(folder, &"the bundled mission lacks a key"))?;
        let path = folder.join("mission.toml");
        fs::write(&path, mission).map_err(io)?;
        chain.mission = Some(path);
        let offset = |k: usize| draw.flight.offset_orf_m(k / 3)[k % 3];
        (draw.record(folder).map_err(io)?, std::array::from_fn(offset))
    };
    let whole = telemetry.first().ok_or_else(|| file(folder, &"there is no telemetry"))?;
    let (files, faults) = damage(&Recording::read(whole), folder, &mut dice).map_err(io)?;
    let Ran { exit, product, said } = program.try_run(&chain, &files, &folder.join("archive"))?;
    let verdict = product.as_ref().and_then(|p| Some(p["verdict"].as_str()?.to_owned()));
    let adopted = product.as_ref().and_then(|p| solution(p, "adopted", &truth_m).ok());
    let pulls = adopted.map(|solution| solution.pulls().into_iter().map(f64::abs).fold(0.0, f64::max));
    Ok(Mixture {
        seed,
        build: build.to_owned(),
        own,
        faults,
        exit,
        refused: product.is_none().then(|| said.lines().next().unwrap_or_default().to_owned()),
        verdict,
        largest_pull: pulls.map(rounded),
    })
}

/// Writes the telemetry with one to [`MOST`] faults; gives the files and what was done.
fn damage(
    recording: &Recording,
    folder: &Path,
    dice: &mut Xoshiro256PlusPlus,
) -> std::io::Result<(Vec<PathBuf>, Vec<Fault>)> {
    let mut messages = recording.messages().to_vec();
    let (mut faults, mut of_file) = (Vec::new(), Vec::new());
    for _ in 0..dice.random_range(1..=MOST) {
        let kind = KINDS[dice.random_range(0..KINDS.len())].0;
        match kind {
            Kind::Cut | Kind::FlippedBytes | Kind::Pieces => of_file.push(kind),
            _ => faults.push(Fault { kind, detail: of_messages(kind, &mut messages, recording.start_ns(), dice) }),
        }
    }
    let mut files = Vec::new();
    if of_file.contains(&Kind::Pieces) {
        let count = dice.random_range(2..=5);
        let each = messages.len() / count;
        for k in 0..count {
            let overlap = dice.random_range(0..=each / 4);
            let part = &messages[(k * each).saturating_sub(overlap)..((k + 1) * each + overlap).min(messages.len())];
            let path = folder.join(format!("piece-{}.mcap", dice.random_range(0..1_000_000)));
            recording.write_all(&path, part.iter().cloned());
            files.push(path);
        }
        faults.push(Fault { kind: Kind::Pieces, detail: format!("{count} files") });
    } else {
        let path = folder.join("damaged.mcap");
        recording.write_all(&path, messages);
        files.push(path);
    }
    for kind in of_file.into_iter().filter(|kind| *kind != Kind::Pieces) {
        let path = &files[dice.random_range(0..files.len())];
        let mut bytes = fs::read(path)?;
        let detail = if kind == Kind::Cut {
            let part: f64 = dice.random_range(0.6..0.99);
            bytes.truncate((bytes.len() as f64 * part) as usize);
            format!("{:.0} % of the bytes are left", 100.0 * part)
        } else {
            let count = dice.random_range(1..=20);
            for _ in 0..count {
                let at = dice.random_range(100..bytes.len());
                bytes[at] ^= 1 << dice.random_range(0..8);
            }
            format!("{count} bits")
        };
        fs::write(path, bytes)?;
        faults.push(Fault { kind, detail });
    }
    Ok((files, faults))
}

/// Fields that are read out: topic, path, noise of a sample.
const READOUTS: [(&str, &[u64], f64); 12] = [
    ("/is", &[1, 1, 1], 4e-9),
    ("/is", &[1, 1, 2], 4e-9),
    ("/is", &[1, 1, 3], 4e-9),
    ("/is", &[2, 1, 1], 4e-9),
    ("/is", &[2, 1, 2], 4e-9),
    ("/is", &[2, 1, 3], 4e-9),
    ("/ifo", &[1, 1], 7e-12),
    ("/ifo", &[2, 1], 7e-12),
    ("/dws", &[1, 1], 2e-9),
    ("/dws", &[3, 1], 7e-10),
    ("/dws", &[3, 2], 7e-10),
    ("/dws", &[3, 3], 7e-10),
];

/// Topics of the control loop.
const TOPICS: [&str; 4] = ["/is", "/ifo", "/dws", "/command"];

/// Puts a fault into messages; says what was done.
fn of_messages(kind: Kind, messages: &mut Vec<Message>, start_ns: u64, dice: &mut Xoshiro256PlusPlus) -> String {
    let (from, length) = (dice.random_range(0.1..0.9), 5.0 * 240_f64.powf(dice.random::<f64>()));
    let from_ns = start_ns + (from * (SAMPLES * STEP_NS) as f64) as u64 / STEP_NS * STEP_NS;
    let during: Range<u64> = from_ns..from_ns + (1e9 * length) as u64;
    let when = format!("{length:.0} s from {:.0} s on", from * HOURS * 3600.0);
    let topic = TOPICS[dice.random_range(0..TOPICS.len())];
    let (read, path, noise) = READOUTS[dice.random_range(0..READOUTS.len())];
    let field = format!("{read} {path:?}");
    let inside = |m: &Message| during.contains(&m.log_time);
    let change = |all: &mut Vec<Message>, wanted: &dyn Fn(&Message) -> bool, to: &mut dyn FnMut(f64) -> f64| {
        for m in all.iter_mut().filter(|m| &*m.topic == read && wanted(m)) {
            if let Some(value) = m.double(path) {
                m.set_double(path, to(value));
            }
        }
    };
    match kind {
        Kind::Gap => {
            messages.retain(|m| !inside(m));
            when
        }
        Kind::GapOfTopic => {
            messages.retain(|m| !(inside(m) && &*m.topic == topic));
            format!("{topic}, {when}")
        }
        Kind::Loss => {
            let part = 0.001 * 50_f64.powf(dice.random::<f64>());
            messages.retain(|_| !dice.random_bool(part));
            format!("{:.1} % of all messages", 100.0 * part)
        }
        Kind::Twice => {
            let again: Vec<Message> = messages.iter().filter(|m| inside(m)).cloned().collect();
            messages.extend(again);
            when
        }
        Kind::Conflict => {
            let mut again: Vec<Message> = messages.iter().filter(|m| inside(m) && &*m.topic == read).cloned().collect();
            change(&mut again, &|_| true, &mut |x| x + 1e3 * noise);
            messages.extend(again);
            format!("{field}, {when}")
        }
        Kind::Disorder => {
            let at: Vec<usize> = (0..messages.len()).filter(|i| inside(&messages[*i])).collect();
            if let (Some(first), Some(last)) = (at.first(), at.last()) {
                messages[*first..=*last].reverse();
            }
            when
        }
        Kind::Spikes => {
            let (count, size) = (dice.random_range(1..=50), noise * 10_f64.powf(dice.random_range(1.0..6.0)));
            let times: Vec<u64> = (0..count).map(|_| start_ns + STEP_NS * dice.random_range(0..SAMPLES)).collect();
            change(messages, &|m| times.contains(&m.log_time), &mut |x| x + size);
            format!("{field}, {count} of {size:.1e}")
        }
        Kind::NotNumbers => {
            change(messages, &inside, &mut |_| f64::NAN);
            format!("{field}, {when}")
        }
        Kind::Stuck => {
            let mut held = None;
            change(messages, &inside, &mut |x| *held.get_or_insert(x));
            format!("{field}, {when}")
        }
        Kind::Flagged => {
            for m in messages.iter_mut().filter(|m| &*m.topic == "/is" && during.contains(&m.log_time)) {
                m.set_number(&[1, 3], 1);
                for axis in 1..=3 {
                    if m.double(&[1, 1, axis]).is_some() {
                        m.set_double(&[1, 1, axis], 1e-3);
                    }
                }
            }
            format!("/is of tm1, {when}")
        }
        Kind::Step => {
            let size = noise * 10_f64.powf(dice.random_range(1.0..5.0));
            change(messages, &|m| m.log_time >= from_ns, &mut |x| x + size);
            format!("{field}, {size:.1e} from {:.0} s on", from * HOURS * 3600.0)
        }
        Kind::ClockStep => {
            let by = dice.random_range(1..600);
            messages.iter_mut().filter(|m| m.log_time >= from_ns).for_each(|m| m.log_time += by * STEP_NS);
            format!("{:.1} s at {:.0} s", by as f64 * 0.1, from * HOURS * 3600.0)
        }
        Kind::LateTimes => {
            let by = dice.random_range(1..=3);
            for m in messages.iter_mut().filter(|m| during.contains(&m.log_time) && &*m.topic == topic) {
                m.log_time += by * STEP_NS;
            }
            format!("{topic} by {:.1} s, {when}", by as f64 * 0.1)
        }
        Kind::Burst => {
            let louder = 2.0 * 15_f64.powf(dice.random::<f64>());
            let mut white = || -> f64 { StandardNormal.sample(dice) };
            change(messages, &inside, &mut |x| x + louder * noise * white());
            format!("{field}, {louder:.0} times as loud, {when}")
        }
        Kind::NoCommands => {
            messages.retain(|m| &*m.topic != "/command");
            String::new()
        }
        Kind::NoHousekeeping => {
            messages.retain(|m| !m.topic.starts_with("/hk/"));
            String::new()
        }
        Kind::GapOfEphemeris => {
            messages.retain(|m| !(inside(m) && &*m.topic == "/ephemeris"));
            when
        }
        Kind::Cut | Kind::FlippedBytes | Kind::Pieces => String::new(),
    }
}

/// What is said of the mixtures in VALIDATION.md, and what is outside of its bounds.
pub(crate) fn table(all: &[Mixture]) -> (String, Vec<String>) {
    let Some(first) = all.first() else { return ("Not run yet.\n".to_owned(), Vec::new()) };
    let wrong: Vec<&Mixture> = all.iter().filter(|m| m.confidently_wrong()).collect();
    let own = all.iter().filter(|m| m.own).count();
    let mut text = format!(
        "{} mixtures of one to {MOST} faults in {HOURS} h of telemetry (build {}): {own} of the bundled simulator, {} of the other \
         producer, whose noise differs from the declared one by up to 30 %. A value that is more than {WRONG}σ wrong with the verdict \
         `agree`: {}.\n\n\
         | fault | promise | sets with it | refused | `agree` | largest pull of these | other verdicts | exit code 3 |\n\
         |---|---|---|---|---|---|---|---|\n",
        all.len(),
        first.build,
        all.len() - own,
        wrong.len()
    );
    for (kind, promise) in KINDS {
        let with: Vec<&Mixture> = all.iter().filter(|m| m.faults.iter().any(|f| f.kind == kind)).collect();
        let count = |is: &dyn Fn(&Mixture) -> bool| with.iter().filter(|m| is(m)).count();
        let agree = |m: &Mixture| m.verdict.as_deref() == Some("agree");
        let pulls = with.iter().filter(|m| agree(m)).filter_map(|m| m.largest_pull);
        let name = serde_json::to_value(kind).ok().and_then(|v| Some(v.as_str()?.replace('-', " ")));
        text += &format!(
            "| {} | {promise} | {} | {} | {} | {:.1} | {} | {} |\n",
            name.unwrap_or_default(),
            with.len(),
            count(&|m| m.refused.is_some()),
            count(&agree),
            pulls.fold(0.0, f64::max),
            count(&|m| m.refused.is_none() && !agree(m)),
            count(&|m| m.exit == 3)
        );
    }
    let failed = wrong.iter().map(|m| {
        let pull = m.largest_pull.unwrap_or(f64::NAN);
        format!("faults: seed {} is {pull:.1}σ wrong and agrees ({})", m.seed, described(&m.faults))
    });
    (text, failed.collect())
}

fn described(faults: &[Fault]) -> String {
    faults.iter().map(|f| format!("{:?} {}", f.kind, f.detail)).collect::<Vec<_>>().join("; ")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn set(verdict: &str, pull: f64) -> Mixture {
        let faults = vec![Fault { kind: Kind::Stuck, detail: "/ifo".to_owned() }];
        let (verdict, largest_pull) = (Some(verdict.to_owned()), Some(pull));
        Mixture { seed: 7, build: "b".to_owned(), own: true, faults, exit: 0, refused: None, verdict, largest_pull }
    }

    /// A kind that did nothing would make its row of the table weaker without a word. Of eight draws five change
    /// something at least: a gap of a few seconds may lie between two messages of the ephemeris.
    #[test]
    fn every_fault_changes_the_telemetry() {
        let folder = tempfile::tempdir().expect("a folder");
        let files = Draw::new(1, HOURS, true).record(folder.path()).expect("a recording");
        let recording = Recording::read(&files[0]);
        let plain = |m: &Message| (m.log_time, m.topic.clone(), m.data.clone());
        let before: Vec<_> = recording.messages().iter().map(plain).collect();
        let of_file = [Kind::Cut, Kind::FlippedBytes, Kind::Pieces];
        for (kind, _) in KINDS.into_iter().filter(|(kind, _)| !of_file.contains(kind)) {
            let changed = |seed: u64| {
                let mut messages = recording.messages().to_vec();
                let mut dice = Xoshiro256PlusPlus::seed_from_u64(seed);
                let _ = of_messages(kind, &mut messages, recording.start_ns(), &mut dice);
                messages.len() != before.len() || messages.iter().zip(&before).any(|(m, was)| plain(m) != *was)
            };
            let count = (1..=8).filter(|seed| changed(*seed)).count();
            assert!(count >= 5, "{kind:?} has changed {count} of 8");
        }
    }

    #[test]
    fn only_what_is_wrong_and_agrees_fails() {
        let (text, failed) = table(&[set("agree", 3.9), set("disagree", 50.0)]);
        assert!(failed.is_empty() && text.contains("`agree`: 0."), "{text}");
        assert!(text.contains("| stuck | left out, or no agreement | 2 | 0 | 1 | 3.9 | 1 | 0 |"), "{text}");
        let (_, failed) = table(&[set("agree", 4.1)]);
        assert_eq!(failed, ["faults: seed 7 is 4.1σ wrong and agrees (Stuck /ifo)"]);
    }
}
