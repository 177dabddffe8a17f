//! The diagnosis campaign: sets of 2 h to 3 × 24 h by two producers, diagnosed as a user would and scored.
//!
//! Each seed determines length, producer, kind and size of what is hidden. Sets of the bundled simulator go through
//! `simulate --hidden`, `run`, `diagnose` and `reveal`, with the sealed truth moved away in between; sets of the
//! foreign producer are scored by names. If everything that was named is true, it is added to the model and the same
//! telemetry is calibrated again.

use std::ffi::{OsStr, OsString};
use std::ops::RangeInclusive;
use std::path::{Path, PathBuf};
use std::time::Instant;

use clap::ValueEnum;
use dragfree_tests::foreign::Draw;
use serde_json::{Value, json};

use crate::campaign::{Meter, note, science_mode, taiji, work};
use crate::diagnosis_report::summary;
use crate::diagnosis_score::{Truth, by_names, by_reveal, name_of, undiagnosed};
use crate::error::{CampaignError, file};
use crate::frozen;
use crate::program::{Chain, Hidden, Program, root, solution};
use crate::records::{Acted, Answer, Diagnosed, Extended, KeptOut, Results, Solution, read, rounded};

/// Length of a set.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum Length {
    /// Two hours
    #[value(name = "2")]
    H2,
    /// Six hours
    #[value(name = "6")]
    H6,
    /// Nine hours
    #[value(name = "9")]
    H9,
    /// A day
    #[value(name = "24")]
    H24,
    /// Three days of one model, calibrated each and diagnosed together
    #[value(name = "3x24")]
    Three24,
}

impl Length {
    /// All lengths, shortest first.
    pub(crate) const ALL: [Self; 5] = [Self::H2, Self::H6, Self::H9, Self::H24, Self::Three24];

    /// As in results.
    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::H2 => "2h",
            Self::H6 => "6h",
            Self::H9 => "9h",
            Self::H24 => "24h",
            Self::Three24 => "3x24h",
        }
    }

    /// Length of all data, h.
    pub(crate) fn hours(self) -> f64 {
        match self {
            Self::H2 => 2.0,
            Self::H6 => 6.0,
            Self::H9 => 9.0,
            Self::H24 => 24.0,
            Self::Three24 => 72.0,
        }
    }
}

/// Producer of the telemetry.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum Producer {
    /// The bundled simulator
    Own,
    /// Another simulator, with controllers, noise and encoder of its own
    Foreign,
}

impl Producer {
    /// As in results.
    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::Own => "own",
            Self::Foreign => "foreign",
        }
    }
}

/// What is the same for all sets of a call.
#[derive(Clone, Debug, Default)]
pub(crate) struct Plan {
    /// Length in place of the seed's.
    pub(crate) length: Option<Length>,
    /// Producer in place of the seed's.
    pub(crate) producer: Option<Producer>,
    /// Whether nothing is hidden.
    pub(crate) clean: bool,
    /// Further arguments of `dragfree diagnose`.
    pub(crate) arguments: Vec<String>,
}

/// Seeds of a block in which every length has the same number of sets, and a quarter of each is foreign.
const BLOCK: u32 = 20;
/// Distance of the seeds of one length from those of the next, so that lengths share no telemetry.
const SEEDS_PER_LENGTH: u32 = 100_000;
/// Offset of the seeds of sets in which nothing is hidden.
const CLEAN_SEEDS: u32 = 50_000;
/// Distance of the seeds of kept-out data from those of the set, more than there are seeds of sets.
const KEPT_OUT_SEEDS: u32 = 10_000_000;
/// Where kept-out data of the bundled simulator and of the other producer begin: on another day than the set.
const KEPT_OUT_FROM: &str = "2035-02-01";
const KEPT_OUT_AFTER_NS: u64 = 10 * 86_400_000_000_000;
/// Deviation of a noise level from the mission file from which naming it is not false.
const TRUE_LEVEL: f64 = 0.05;

/// One set to be measured.
#[derive(Clone, Debug, PartialEq)]
struct Set {
    seed: u32,
    length: Length,
    producer: Producer,
    clean: bool,
}

impl Plan {
    /// The arguments that ask for some seeds, with files and folders `[results, scratch]`.
    fn arguments_of(
        &self,
        seeds: &RangeInclusive<u32>,
        at_once: usize,
        [results, scratch]: [&Path; 2],
    ) -> Result<Vec<OsString>, CampaignError> {
        let mut words = vec!["diagnosis".to_owned(), format!("--seeds={}-{}", seeds.start(), seeds.end())];
        words.extend(self.length.map(|length| format!("--length={}", named(&length))));
        words.extend(self.producer.map(|producer| format!("--producer={}", named(&producer))));
        words.extend(self.clean.then(|| "--clean".to_owned()));
        words.push(format!("--arguments={}", self.arguments.join(" ")));
        words.push(format!("--at-once={at_once}"));
        Ok(words.into_iter().map(OsString::from).chain(frozen::places(results, scratch)?).collect())
    }

    fn set(&self, seed: u32) -> Set {
        let (block, place) = ((seed - 1) / BLOCK, (seed - 1) % BLOCK);
        let lengths = Length::ALL.len() as u32;
        let (length, quarter) = (place % lengths, place / lengths);
        // The foreign quarter is another one in each length and block.
        let producer = if quarter == (length + block) % 4 { Producer::Foreign } else { Producer::Own };
        Set {
            seed,
            length: self.length.unwrap_or(Length::ALL[length as usize]),
            producer: self.producer.unwrap_or(producer),
            clean: self.clean,
        }
    }

    fn configuration(&self, set: &Set) -> String {
        let clean = if set.clean { " clean" } else { "" };
        let arguments = self.arguments.join(" ");
        let comma = if arguments.is_empty() { "" } else { ", " };
        format!("{} {}{clean}{comma}{arguments}", set.length.name(), set.producer.name())
    }
}

/// A value as it is written in an argument.
fn named(value: &impl ValueEnum) -> String {
    value.to_possible_value().map(|v| v.get_name().to_owned()).unwrap_or_default()
}

impl Set {
    /// Seed of everything that is drawn.
    fn drawn_by(&self) -> u32 {
        let length = Length::ALL.iter().position(|l| *l == self.length).unwrap_or(0) as u32;
        SEEDS_PER_LENGTH * (1 + length) + if self.clean { CLEAN_SEEDS } else { 0 } + self.seed
    }
}

/// Telemetry of a set, one file for each product, with what only the score may read.
struct Made {
    files: Vec<PathBuf>,
    mission: Option<PathBuf>,
    truth_m: [f64; 6],
    secret: Secret,
}

enum Secret {
    /// The sealed file of the bundled simulator.
    Sealed(Hidden),
    /// What the foreign producer drew.
    Drawn(Box<Draw>),
    /// Nothing is hidden.
    Nothing,
}

/// Runs the seeds that `results` lacks, `at_once` in parallel, with the program of the commit that they name.
/// After an error the results so far are on disk, and the next call continues.
pub(crate) fn diagnosis(
    plan: &Plan,
    seeds: RangeInclusive<u32>,
    at_once: usize,
    results: &Path,
    scratch: &Path,
) -> Result<(), CampaignError> {
    let lines: Vec<Diagnosed> = read(results)?;
    let commits = lines.iter().map(|line| line.commit.as_str());
    let asked = || plan.arguments_of(&seeds, at_once, [results, scratch]);
    let Some(commit) = frozen::present_or_go_on(commits, asked)? else { return Ok(()) };
    let program = &Program::build()?;
    let (results, _) = Results::<Diagnosed>::open(results, &commit)?;
    let sets = seeds.map(|seed| plan.set(seed)).filter(|set| !results.has(&plan.configuration(set), set.seed));
    let sets: Vec<Set> = sets.collect();
    // A start of the program takes about as long as an hour of data.
    let weight = |set: &Set| 1.0 + set.length.hours();
    let meter = Meter::new(sets.iter().map(weight).sum());
    work(sets, at_once, |set| {
        let configuration = plan.configuration(&set);
        let folder = scratch.join(format!("diagnosis-{}-{}", configuration.replace(' ', "-"), set.seed));
        let io = |e: std::io::Error| file(&folder, &e);
        if folder.exists() {
            std::fs::remove_dir_all(&folder).map_err(io)?;
        }
        std::fs::create_dir_all(&folder).map_err(io)?;
        let measurement = Measurement { program, plan, set: &set, folder: &folder, configuration: &configuration };
        let line = measurement.measure(&commit)?;
        let said = told(&line);
        results.append(line)?;
        std::fs::remove_dir_all(&folder).map_err(io)?;
        meter.say(weight(&set), &format!("{configuration} {}: {said}", set.seed));
        Ok(())
    })?;
    note(&summary(&results.sort(&[] as &[&str])?));
    Ok(())
}

/// A set in a few words.
fn told(line: &Diagnosed) -> String {
    let hidden: Vec<&str> = line.effects.iter().map(|e| e.name.as_str()).collect();
    let hidden = if hidden.is_empty() { "nothing hidden".to_owned() } else { hidden.join(" and ") };
    match &line.answer {
        Some(a) if a.named.is_empty() => format!("{hidden}; {} ({} s)", a.verdict, line.diagnosis_s),
        Some(a) => format!("{hidden}; {}: {} ({} s)", a.verdict, a.named.join(", "), line.diagnosis_s),
        None => format!("{hidden}; failed"),
    }
}

/// One set with its files.
struct Measurement<'a> {
    program: &'a Program,
    plan: &'a Plan,
    set: &'a Set,
    folder: &'a Path,
    configuration: &'a str,
}

/// Calibrations of a set and their diagnosis.
struct Said {
    products: Vec<Value>,
    diagnosis: Value,
    diagnosis_s: f64,
}

impl Measurement<'_> {
    fn io(&self, e: &std::io::Error) -> CampaignError {
        file(self.folder, e)
    }

    fn lacks(&self, what: String) -> CampaignError {
        CampaignError::Product { configuration: self.configuration.to_owned(), seed: self.set.seed, what }
    }

    fn measure(&self, commit: &str) -> Result<Diagnosed, CampaignError> {
        let made = match self.set.producer {
            Producer::Own => self.simulated()?,
            Producer::Foreign => self.flown()?,
        };
        let model = self.folder.join("bare.toml");
        std::fs::copy(root().join("fixtures/models/com-offset.toml"), &model).map_err(|e| self.io(&e))?;
        let chain = Chain { pipeline: science_mode(), mission: made.mission.clone(), model: Some(model) };
        let (said, failed) = match self.diagnosed(&chain, &made) {
            Ok(said) => (Some(said), None),
            Err(CampaignError::Failed { message, .. }) => (None, Some(shortened(&message))),
            Err(error) => return Err(error),
        };
        let (answer, mut effects) = self.scored(&made, said.as_ref())?;
        if let [one] = &mut effects[..]
            && (!one.known || one.significance_at_hand.is_none())
        {
            one.significance_at_hand = self.in_the_model(&chain, &made, one)?;
        }
        let mut line = Diagnosed {
            configuration: self.configuration.to_owned(),
            seed: self.set.seed,
            commit: commit.to_owned(),
            length: self.set.length.name().to_owned(),
            producer: self.set.producer.name().to_owned(),
            arguments: self.plan.arguments.join(" "),
            drawn: if let Secret::Drawn(draw) = &made.secret { told_of(draw) } else { Value::Null },
            diagnosis_s: 0.0,
            failed,
            run_verdicts: Vec::new(),
            chi2_per_dof: Vec::new(),
            answer,
            effects,
            before: Vec::new(),
            after: None,
            kept_out: None,
        };
        if let Some(said) = said {
            let products = &said.products;
            line.diagnosis_s = said.diagnosis_s;
            line.run_verdicts = products.iter().map(|p| p["verdict"].as_str().unwrap_or("?").to_owned()).collect();
            line.chi2_per_dof = products.iter().filter_map(|p| p["chi2_per_dof"].as_f64()).collect();
            line.before = self.offsets(products, &made.truth_m)?;
            let added = self.all_true(&made, &line, &said.diagnosis);
            if !added.is_empty() {
                line.after = Some(self.extended(&chain, &made, &said.diagnosis, added)?);
            }
            line.kept_out = self.kept_out(&chain, &made, &said, &line.effects)?;
        }
        Ok(line)
    }

    /// Telemetry of the bundled simulator; the sealed truth is moved away before anything reads it.
    fn simulated(&self) -> Result<Made, CampaignError> {
        let (seed, hours) = (self.set.drawn_by(), self.set.length.hours());
        if self.set.clean {
            let arguments = ["--seed".to_owned(), seed.to_string(), "--hours".to_owned(), hours.to_string()];
            let made = self.program.simulate(&taiji(), &self.folder.join("telemetry"), &arguments)?;
            return Ok(Made { files: made.files, mission: None, truth_m: made.truth_m, secret: Secret::Nothing });
        }
        let hidden = self.program.hide(&taiji(), self.folder, [seed, seed], hours)?;
        let (files, truth_m) = (hidden.files.clone(), hidden.truth_m);
        Ok(Made { files, mission: None, truth_m, secret: Secret::Sealed(hidden) })
    }

    /// Telemetry of the foreign producer, with a mission file that declares its noise.
    fn flown(&self) -> Result<Made, CampaignError> {
        let draw = Draw::new(self.set.drawn_by().into(), self.set.length.hours(), self.set.clean);
        let files = draw.record(self.folder).map_err(|e| self.io(&e))?;
        let bundled = std::fs::read_to_string(taiji()).map_err(|e| file(&taiji(), &e))?;
        let text = draw.mission(&bundled).ok_or_else(|| file(&taiji(), &"a table of the flight's is missing"))?;
        let mission = self.folder.join("mission.toml");
        std::fs::write(&mission, text).map_err(|e| self.io(&e))?;
        let offset = [0, 1].map(|i| draw.flight.offset_orf_m(i));
        let truth_m = std::array::from_fn(|i| offset[i / 3][i % 3]);
        Ok(Made { files, mission: Some(mission), truth_m, secret: Secret::Drawn(Box::new(draw)) })
    }

    fn archive(&self) -> PathBuf {
        self.folder.join("archive")
    }

    fn run(&self, chain: &Chain, made: &Made) -> Result<Vec<Value>, CampaignError> {
        made.files.iter().map(|day| self.program.run(chain, std::slice::from_ref(day), &self.archive())).collect()
    }

    fn diagnosed(&self, chain: &Chain, made: &Made) -> Result<Said, CampaignError> {
        let products = self.run(chain, made)?;
        let start = Instant::now();
        let arguments: Vec<&str> = self.plan.arguments.iter().map(String::as_str).collect();
        let diagnosis = self.program.diagnose_together(&products, &self.archive(), &arguments)?;
        Ok(Said { products, diagnosis, diagnosis_s: (start.elapsed().as_secs_f64() * 10.0).round() / 10.0 })
    }

    fn offsets(&self, products: &[Value], truth_m: &[f64; 6]) -> Result<Vec<Solution>, CampaignError> {
        products.iter().map(|p| solution(p, "adopted", truth_m).map_err(|what| self.lacks(what))).collect()
    }

    fn scored(&self, made: &Made, said: Option<&Said>) -> Result<(Option<Answer>, Vec<Acted>), CampaignError> {
        // Of what could not be diagnosed, the score keeps what was hidden.
        let nothing = json!({ "verdict": "failed", "candidates": [] });
        let diagnosis = said.map_or(&nothing, |said| &said.diagnosis);
        let (answer, effects) = match &made.secret {
            Secret::Sealed(hidden) => {
                let path = self.folder.join("diagnosis.json");
                std::fs::write(&path, diagnosis.to_string()).map_err(|e| self.io(&e))?;
                by_reveal(&self.program.reveal(hidden, &path)?, diagnosis)
            }
            Secret::Drawn(draw) if said.is_none() => return Ok((None, undiagnosed(&draw.acted))),
            Secret::Drawn(draw) => {
                let levels = draw.true_levels(TRUE_LEVEL);
                by_names(&Truth { acted: &draw.acted, levels: &levels, start_ns: draw.start_ns }, diagnosis)
            }
            Secret::Nothing => by_names(&Truth { acted: &[], levels: &[], start_ns: 0 }, diagnosis),
        };
        Ok((said.map(|_| answer), effects))
    }

    /// Significance of a force that no effect covers, or of a line, with the σ that `run` has with it in the model;
    /// none of other effects, and where that fails.
    fn in_the_model(&self, chain: &Chain, made: &Made, acted: &Acted) -> Result<Option<f64>, CampaignError> {
        let Some((_, place)) = acted.name.split_once(':') else { return Ok(None) };
        let line_hz = match &made.secret {
            Secret::Drawn(draw) => draw.acted.iter().find_map(|own| own.frequency_hz),
            _ => None,
        };
        let (entry, coefficient) = if let Some(formula) = true_formula(&acted.name) {
            (formula, "formula.known".to_owned())
        } else if let Some(hz) = line_hz {
            // Of a line of any phase the two amplitudes have one σ.
            (Entry { name: acted.name.clone(), set: vec![format!("frequency_hz={hz}")] }, format!("line.{place}.sin"))
        } else {
            return Ok(None);
        };
        let products = match self.with(chain, "known.toml", &[entry.words()]).and_then(|chain| self.run(&chain, made)) {
            Err(CampaignError::Failed { .. }) => return Ok(None),
            products => products?,
        };
        let sigma = |product: &Value| {
            let all = product["coefficients"].as_array()?;
            let own = all.iter().find(|c| c["name"] == coefficient.as_str() && c["solution"] == "adopted")?;
            own["sigma"].as_f64()
        };
        let information: f64 = products.iter().filter_map(sigma).map(|sigma| sigma.powi(-2)).sum();
        Ok(Some(acted.size.abs() * information.sqrt()))
    }

    /// A chain whose model has some entries more, in a file of its own: of each the words of `dragfree model add` after
    /// the file.
    fn with(&self, chain: &Chain, file: &str, entries: &[Vec<&OsStr>]) -> Result<Chain, CampaignError> {
        let model = self.folder.join(file);
        std::fs::copy(chain.model.as_deref().unwrap_or(Path::new("")), &model).map_err(|e| self.io(&e))?;
        for words in entries {
            self.program.model(&[&["add".as_ref(), model.as_os_str()], &words[..]].concat())?;
        }
        Ok(Chain { model: Some(model), ..chain.clone() })
    }

    /// By how much χ² falls on other data of the same length, a day at most, with what is proposed and with the true
    /// formula, each fitted to the first day of the set. Proposed are the formulas that were chosen together, or the
    /// first of those that the data do not tell from each other.
    fn kept_out(
        &self,
        chain: &Chain,
        made: &Made,
        said: &Said,
        effects: &[Acted],
    ) -> Result<Option<KeptOut>, CampaignError> {
        let [acted] = effects else { return Ok(None) };
        let Some(entry) = true_formula(&acted.name) else { return Ok(None) };
        let others = self.other_data(made, acted)?;
        let without = self.on_other_data(chain, made, &others)?;
        let fall = |file: &str, entries: &[Vec<&OsStr>]| -> Result<Option<f64>, CampaignError> {
            let with = self.with(chain, file, entries).and_then(|chain| self.on_other_data(&chain, made, &others));
            let with = match with {
                Err(CampaignError::Failed { .. }) => return Ok(None),
                with => with?,
            };
            let of_these = ["ladder", &without[0], &with[0], "--held-out", &without[1], &with[1]];
            let answer = self.program.ask(self.folder, &[&of_these[..], &["--archive", "archive"]].concat())?;
            Ok(answer["revisions"][1]["held_out"]["fall"]["delta_chi2"].as_f64())
        };
        let formulas = said.diagnosis["formulas"].as_array().map_or(&[][..], Vec::as_slice);
        let chosen = formulas.iter().filter(|f| f["accepted"] == true).map(name_of);
        let mut names: Vec<String> = chosen.collect();
        if names.is_empty() {
            names.extend(formulas.first().map(name_of));
        }
        let from = self.folder.join("proposed.json");
        std::fs::write(&from, said.diagnosis.to_string()).map_err(|e| self.io(&e))?;
        let of_it = |name: &String| [OsString::from(name), "--from".into(), from.clone().into()];
        let entries: Vec<[OsString; 3]> = names.iter().map(of_it).collect();
        let entries: Vec<Vec<&OsStr>> = entries.iter().map(|e| e.iter().map(OsString::as_os_str).collect()).collect();
        let proposed = if entries.is_empty() { None } else { fall("proposed.toml", &entries)? };
        Ok(Some(KeptOut { proposed, true_formula: fall("true.toml", &[entry.words()])? }))
    }

    /// Data on which the same acts, of another seed and day.
    fn other_data(&self, made: &Made, acted: &Acted) -> Result<Vec<PathBuf>, CampaignError> {
        let folder = self.folder.join("other");
        let hours = self.set.length.hours().min(Length::H24.hours());
        if let Secret::Drawn(draw) = &made.secret {
            std::fs::create_dir_all(&folder).map_err(|e| self.io(&e))?;
            let mut other = (**draw).clone();
            (other.flight.seconds, other.start_ns) = (3600.0 * hours, draw.start_ns + KEPT_OUT_AFTER_NS);
            other.flight.seed = draw.flight.seed.wrapping_add(KEPT_OUT_SEEDS.into());
            return other.record(&folder).map_err(|e| self.io(&e));
        }
        let seed = KEPT_OUT_SEEDS + self.set.drawn_by();
        let arguments = ["--start", KEPT_OUT_FROM, "--seed", &seed.to_string(), "--hours", &hours.to_string()];
        let effect = format!("--effect={}={}", acted.name, acted.size);
        let arguments: Vec<&str> = arguments.into_iter().chain([effect.as_str()]).collect();
        Ok(self.program.simulate(&taiji(), &folder, &arguments)?.files)
    }

    /// Products of the first day of a set, and of other data with all that this has told but the offset.
    fn on_other_data(&self, chain: &Chain, made: &Made, others: &[PathBuf]) -> Result<[String; 2], CampaignError> {
        let id = |product: &Value| product["id"].as_str().map(str::to_owned).ok_or_else(|| self.lacks("id".to_owned()));
        let archive = self.archive();
        let fitted = id(&self.program.run(chain, &made.files[..1], &archive)?)?;
        let model = chain.model.clone().unwrap_or_default();
        let fixed = model.with_extension("fixed.toml");
        let words = ["fix".as_ref(), model.as_os_str(), "--from".as_ref(), fitted.as_ref(), "--keep".as_ref()];
        let out = ["com-offset".as_ref(), "--archive".as_ref(), archive.as_os_str(), "--out".as_ref()];
        self.program.model(&[&words[..], &out[..], &[fixed.as_os_str()]].concat())?;
        let other = id(&self.program.run(&Chain { model: Some(fixed), ..chain.clone() }, others, &archive)?)?;
        Ok([fitted, other])
    }

    /// Names of everything that was named, if all of it is true.
    fn all_true(&self, made: &Made, line: &Diagnosed, diagnosis: &Value) -> Vec<String> {
        let levels = if let Secret::Drawn(draw) = &made.secret { draw.true_levels(TRUE_LEVEL) } else { Vec::new() };
        let is_true = |name: &String| line.effects.iter().any(|e| e.named && e.name == *name) || levels.contains(name);
        let candidates = diagnosis["candidates"].as_array().into_iter().flatten();
        let named: Vec<String> = candidates.filter(|c| c["accepted"] == true).map(name_of).collect();
        let false_causes = line.answer.as_ref().is_none_or(|a| !a.false_causes.is_empty());
        if false_causes || !named.iter().all(is_true) { Vec::new() } else { named }
    }

    /// Adds effects to the model as a user would, and calibrates the same telemetry again.
    fn extended(
        &self,
        chain: &Chain,
        made: &Made,
        diagnosis: &Value,
        added: Vec<String>,
    ) -> Result<Extended, CampaignError> {
        let (model, from) = (self.folder.join("found.toml"), self.folder.join("named.json"));
        let bare = chain.model.as_deref().unwrap_or(Path::new(""));
        std::fs::copy(bare, &model).map_err(|e| self.io(&e))?;
        std::fs::write(&from, diagnosis.to_string()).map_err(|e| self.io(&e))?;
        let chain = Chain { model: Some(model.clone()), ..chain.clone() };
        let calibrated = || {
            for name in &added {
                let words = ["add".as_ref(), model.as_os_str(), name.as_ref(), "--from".as_ref(), from.as_os_str()];
                self.program.model(&words)?;
            }
            self.run(&chain, made)
        };
        match calibrated() {
            Ok(products) => {
                let offset = self.offsets(&products, &made.truth_m)?;
                Ok(Extended { added, failed: None, offset })
            }
            Err(CampaignError::Failed { message, .. }) => {
                Ok(Extended { added, failed: Some(shortened(&message)), offset: Vec::new() })
            }
            Err(error) => Err(error),
        }
    }
}

/// An entry of a model: its name, and what is set in it.
struct Entry {
    name: String,
    set: Vec<String>,
}

impl Entry {
    /// As `dragfree model add` takes it.
    fn words(&self) -> Vec<&OsStr> {
        let set = self.set.iter().flat_map(|set| ["--set".as_ref(), set.as_ref()]);
        std::iter::once(self.name.as_ref()).chain(set).collect()
    }
}

/// The formula `formula:known` of an effect, `EFFECT:INSTANCE`, that is a force of a kind that no effect covers.
fn true_formula(name: &str) -> Option<Entry> {
    let (effect, place) = name.split_once(':')?;
    let (expression, unit) = formula_of(effect)?;
    let (test_mass, axis) = place.split_once('.').unwrap_or((place, "x"));
    let set = vec![
        format!("acts_on={test_mass}.accel.{axis}"),
        format!("expression={expression}"),
        format!("unit={unit}"),
        "range=-1e-8,1e-8".to_owned(),
    ];
    Some(Entry { name: "formula:known".to_owned(), set })
}

/// A force of a kind that no effect covers as a formula of telemetry, with the unit of its size.
fn formula_of(effect: &str) -> Option<(&'static str, &'static str)> {
    Some(match effect {
        "current-force" => ("lag(hk.battery_current_a ^ 2, 50)", "m s-2 A-2"),
        "product-force" => ("(hk.battery_current_a - 2.1) * (hk.structure_temperature_k - 296.5)", "m s-2 A-1 K-1"),
        "current-squared" => ("hk.bus_current_a ^ 2", "m s-2 A-2"),
        "current-by-panel" => ("(hk.bus_current_a - 2) * (hk.panel_k - 310)", "m s-2 A-1 K-1"),
        _ => return None,
    })
}

/// The beginning of a message, for a result line.
fn shortened(message: &str) -> String {
    message.trim().chars().take(300).collect()
}

/// What a foreign set was drawn with.
fn told_of(draw: &Draw) -> Value {
    let (loops, variation, start) = (&draw.flight.loops, &draw.variation, &draw.variation.start);
    let attitude = variation.attitude.map(|factor| rounded(factor * loops.attitude));
    let [x, y, z] = [loops.x, loops.y, loops.z].map(rounded);
    let gaps_s: Vec<[f64; 2]> = draw.gaps_s.iter().map(|(at, length)| [rounded(*at), rounded(*length)]).collect();
    json!({
        "loops_rad_s": { "attitude": attitude, "x": x, "y": y, "z": z },
        "noise_over_declared": draw.deviation.map(rounded),
        "errors_at_start": {
            "before_s": rounded(start.before_s),
            "displacement_m": start.displacement_m.map(|r| r.map(rounded)),
            "attitude_rad": start.attitude_rad.map(rounded),
        },
        "start_ns": draw.start_ns,
        "gaps_s": gaps_s,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeMap;

    /// In 400 seeds every length has 80 sets, of which 20 are foreign.
    #[test]
    fn lengths_have_equal_parts_and_a_quarter_is_foreign() {
        let mut count: BTreeMap<(&str, &str), usize> = BTreeMap::new();
        for seed in 1..=400 {
            let set = Plan::default().set(seed);
            *count.entry((set.length.name(), set.producer.name())).or_default() += 1;
        }
        for length in Length::ALL {
            assert_eq!((count[&(length.name(), "own")], count[&(length.name(), "foreign")]), (60, 20));
        }
    }

    #[test]
    fn a_plan_overrides_the_seed_and_is_part_of_the_key() {
        let plan = Plan { clean: true, length: Some(Length::H6), ..Plan::default() };
        let sets: Vec<Set> = (1..=120).map(|seed| plan.set(seed)).collect();
        assert!(sets.iter().all(|set| set.length == Length::H6 && set.clean));
        assert_eq!(sets.iter().filter(|set| set.producer == Producer::Foreign).count(), 30);
        assert_eq!(plan.set(9), plan.set(9));
        let arguments = ["--decide-by", "innovations"].map(str::to_owned).to_vec();
        let plan = Plan { producer: Some(Producer::Foreign), arguments, ..Plan::default() };
        assert_eq!(plan.configuration(&plan.set(5)), "3x24h foreign, --decide-by innovations");
    }

    /// No two sets of 1000 seeds share what is drawn.
    #[test]
    fn seeds_of_lengths_are_apart() {
        let mut seen = std::collections::BTreeSet::new();
        for (length, clean) in Length::ALL.iter().flat_map(|l| [(l, false), (l, true)]) {
            let plan = Plan { length: Some(*length), clean, ..Plan::default() };
            assert!((1..=1000).all(|seed| seen.insert(plan.set(seed).drawn_by())));
        }
    }

    /// Foreign sets hide every kind, with the significance for which they are drawn, and the same for the same seed.
    #[test]
    fn foreign_sets_hide_every_kind() {
        let mut kinds: BTreeMap<&str, usize> = BTreeMap::new();
        let (mut nothing, mut pairs) = (0, 0);
        for seed in 1..=1000_u32 {
            let draw = Draw::new(seed.into(), 6.0, false);
            assert_eq!(draw, Draw::new(seed.into(), 6.0, false));
            nothing += usize::from(draw.acted.is_empty());
            pairs += usize::from(draw.acted.len() == 2);
            for acted in &draw.acted {
                let z = acted.significance();
                assert!(z >= 3.999 && (z <= 20.001 || acted.effect.ends_with("-noise")), "{acted:?}");
                *kinds.entry(acted.effect).or_default() += 1;
            }
            let louder = draw.acted.iter().filter(|a| a.effect.ends_with("-noise"));
            let levels = draw.true_levels(TRUE_LEVEL);
            assert!(louder.into_iter().all(|a| (a.size - 1.0).abs() < TRUE_LEVEL || levels.contains(&a.name())));
        }
        for kind in dragfree_tests::foreign::KINDS.into_iter().flatten() {
            assert!(kinds.contains_key(kind), "{kind} is never drawn: {kinds:?}");
        }
        assert!((60..=140).contains(&nothing) && (100..=200).contains(&pairs), "{nothing} {pairs}");
    }

    /// The mission file of a flight is one that the program reads, with the declared noise and no other change.
    #[test]
    fn the_mission_file_declares_the_noise() {
        let bundled = std::fs::read_to_string(taiji()).unwrap();
        let draw = Draw::new(3, 6.0, true);
        let text = draw.mission(&bundled).unwrap();
        let [mut found, before]: [toml::Table; 2] = [&text, &bundled].map(|t| t.parse().unwrap());
        let asd = |table: &str, key: &str| found["noise"][table][key].as_float().unwrap();
        assert_eq!(asd("thruster_force", "asd_n_rthz"), draw.declared.thrust_n);
        assert_eq!(asd("is_y", "asd_m_rthz"), draw.declared.is_m);
        assert!(found["noise"]["is_y"].get("corner_hz").is_none());
        assert_eq!(found["solar_pressure"]["arm_srf_m"], before["solar_pressure"]["arm_srf_m"]);
        for key in ["noise", "solar_pressure"] {
            found[key] = before[key].clone();
        }
        assert_eq!(found, before);
        assert!(draw.mission("[noise.ifo_x]\n").is_none());
    }
}
