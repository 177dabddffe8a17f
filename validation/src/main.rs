//! Measurements behind VALIDATION.md: seeded campaigns of the program, statistics with bounds, information bounds from
//! the mission's noise, and the report generated from committed results.

mod bound;
mod campaign;
mod diagnosis;
mod diagnosis_report;
mod diagnosis_score;
mod error;
mod faults;
mod frozen;
mod growth;
mod kills;
mod limits;
mod months;
mod peers;
mod program;
mod records;
mod report;
mod soak;
mod speed;
mod stats;
mod table;
mod workbench;

use campaign::note;
use clap::{Args, Parser, Subcommand, ValueEnum};
use diagnosis::{Length, Plan, Producer};
use error::CampaignError;
use program::{Program, root};
use std::ops::RangeInclusive;
use std::path::PathBuf;
use std::process::ExitCode;

/// Measures the program and writes the generated parts of VALIDATION.md. One at a time.
#[derive(Debug, Parser)]
#[command(name = "dragfree-validation", max_term_width = 100)]
struct Arguments {
    #[command(subcommand)]
    command: Command,
    /// Folder for telemetry, emptied at the start
    #[arg(long, global = true, value_name = "DIR")]
    scratch: Option<PathBuf>,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Simulate and calibrate seeds, and their twins; goes on where it was stopped
    Coverage(Coverage),
    /// The table to beat: 25 days in three regimes of noise; goes on where it was stopped
    Table(Table),
    /// Diagnose sets of 2 h to 3 × 24 h by two producers and score them; goes on where it was stopped, with the program
    /// of the commit that the results name
    Diagnosis(Diagnosis),
    /// Calibrate 90 days with a drift and steps, alone and together; goes on where it was stopped, with the program of
    /// the commit that the results name
    Months(MonthsCommand),
    /// Kill commands that write at random instants, and look at what the next one finds; goes on where it was stopped
    Kills(KillsCommand),
    /// Put mixtures of faults into telemetry of two producers, and look whether a product is wrong and says that it is
    /// right; goes on where it was stopped
    Faults(FaultsCommand),
    /// Watch an inbox for more than a year of days, a third of them late, cut, doubled or corrected, with kills
    Soak(SoakCommand),
    /// Time the workbench over many days
    Workbench(WorkbenchCommand),
    /// Compute what data of each length can say of each effect; goes on where it was stopped
    Limits,
    /// Time every bar of speed, on a machine that does nothing else
    Speed(SpeedCommand),
    /// Time the heaviest steps and those of other packages, with the same results, on a machine that does nothing else
    Peers,
    /// Time runs of more and more data, effects and columns, on a machine that does nothing else
    Growth(GrowthCommand),
    /// Write the generated parts of VALIDATION.md and the picture from the results
    Report,
    /// Everything: coverage, table, speed, report
    All,
}

#[derive(Debug, Args)]
struct Coverage {
    /// Seeds, FIRST-LAST
    #[arg(long, value_parser = seeds, default_value = "1-100")]
    seeds: RangeInclusive<u32>,
    /// File of results
    #[arg(long, value_name = "FILE")]
    results: Option<PathBuf>,
}

#[derive(Debug, Args)]
struct Table {
    /// Seeds
    #[arg(long, value_delimiter = ',', default_value = "1")]
    seeds: Vec<u32>,
    /// Length of the long runs
    #[arg(long, default_value_t = report::TABLE_DAYS, value_parser = clap::value_parser!(u32).range(1..))]
    days: u32,
    /// Regimes at a time; 25 days of one take 14 GB of the scratch folder
    #[arg(long, default_value_t = AT_ONCE)]
    at_once: usize,
    /// File of results
    #[arg(long, value_name = "FILE")]
    results: Option<PathBuf>,
}

#[derive(Debug, Args)]
struct Diagnosis {
    /// Seeds, FIRST-LAST; each determines length, producer, kind and size
    #[arg(long, value_parser = seeds, default_value = "1-400")]
    seeds: RangeInclusive<u32>,
    /// Length of every set, in place of the seed's
    #[arg(long, value_enum)]
    length: Option<Length>,
    /// Producer of every set, in place of the seed's
    #[arg(long, value_enum)]
    producer: Option<Producer>,
    /// Hide nothing
    #[arg(long)]
    clean: bool,
    /// Further arguments of `dragfree diagnose`, separated by spaces
    #[arg(long, value_name = "ARGUMENTS", default_value = "", allow_hyphen_values = true)]
    arguments: String,
    /// Diagnoses at a time; each takes some 2 GB of memory
    #[arg(long, default_value_t = AT_ONCE)]
    at_once: usize,
    /// File of results
    #[arg(long, value_name = "FILE")]
    results: Option<PathBuf>,
}

#[derive(Debug, Args)]
struct KillsCommand {
    /// Seeds, FIRST-LAST; each determines command, signal and instant
    #[arg(long, value_parser = seeds, default_value = "1-1000")]
    seeds: RangeInclusive<u32>,
    /// Kills at a time
    #[arg(long, default_value_t = AT_ONCE)]
    at_once: usize,
    /// File of results
    #[arg(long, value_name = "FILE")]
    results: Option<PathBuf>,
}

#[derive(Debug, Args)]
struct FaultsCommand {
    /// Seeds, FIRST-LAST; each determines producer and faults
    #[arg(long, value_parser = seeds, default_value = "1-500")]
    seeds: RangeInclusive<u32>,
    /// Sets at a time
    #[arg(long, default_value_t = AT_ONCE)]
    at_once: usize,
    /// File of results
    #[arg(long, value_name = "FILE")]
    results: Option<PathBuf>,
}

#[derive(Debug, Args)]
struct SoakCommand {
    /// Seeds, FIRST-LAST
    #[arg(long, value_parser = seeds, default_value = "1-1")]
    seeds: RangeInclusive<u32>,
    /// Days of each
    #[arg(long, default_value_t = 400, value_parser = clap::value_parser!(u32).range(4..))]
    days: u32,
    /// File of results
    #[arg(long, value_name = "FILE")]
    results: Option<PathBuf>,
}

#[derive(Debug, Args)]
struct WorkbenchCommand {
    /// Days
    #[arg(long, default_value_t = 30, value_parser = clap::value_parser!(u32).range(1..))]
    days: u32,
    /// Hours of telemetry of each day
    #[arg(long, default_value_t = 2.0)]
    hours: f64,
    /// File of the result
    #[arg(long, value_name = "FILE")]
    results: Option<PathBuf>,
}

#[derive(Debug, Args)]
struct SpeedCommand {
    /// Days of the longest run; 25 of them take 14 GB of the scratch folder
    #[arg(long, default_value_t = report::TABLE_DAYS, value_parser = clap::value_parser!(u32).range(1..))]
    days: u32,
}

#[derive(Debug, Args)]
struct GrowthCommand {
    /// What grows; all where none is given
    #[arg(long, value_enum)]
    only: Vec<growth::Grows>,
    #[command(flatten)]
    longest: SpeedCommand,
}

#[derive(Debug, Args)]
struct MonthsCommand {
    /// Seeds, FIRST-LAST
    #[arg(long, value_parser = seeds, default_value = "1-20")]
    seeds: RangeInclusive<u32>,
    /// Hours of telemetry of each day
    #[arg(long, default_value_t = 8.0)]
    hours: f64,
    /// Sets at a time
    #[arg(long, default_value_t = AT_ONCE)]
    at_once: usize,
    /// File of results
    #[arg(long, value_name = "FILE")]
    results: Option<PathBuf>,
}

const AT_ONCE: usize = 2;
const SEEDS: RangeInclusive<u32> = 1..=100;

fn seeds(text: &str) -> Result<RangeInclusive<u32>, String> {
    let (first, last) = text.split_once('-').unwrap_or((text, text));
    match (first.parse(), last.parse()) {
        (Ok(first), Ok(last)) if 1 <= first && first <= last => Ok(first..=last),
        _ => Err("seeds are FIRST-LAST, from 1".to_owned()),
    }
}

fn execute(arguments: &Arguments) -> Result<(), CampaignError> {
    let results = root().join("validation/results");
    let scratch = arguments.scratch.clone().unwrap_or_else(|| root().join("target/validation"));
    let coverage_file = results.join("coverage.jsonl");
    let table_file = results.join("table.jsonl");
    let speed_file = results.join("speed.json");
    match &arguments.command {
        Command::Coverage(c) => {
            let file = c.results.as_ref().unwrap_or(&coverage_file);
            campaign::coverage(&Program::build()?, c.seeds.clone(), file, &scratch)
        }
        Command::Table(t) => {
            let file = t.results.as_ref().unwrap_or(&table_file);
            table::table(&Program::build()?, &t.seeds, t.days, t.at_once, file, &scratch)
        }
        Command::Diagnosis(d) => {
            let file = d.results.clone().unwrap_or_else(|| results.join("diagnosis.jsonl"));
            let plan = Plan {
                length: d.length,
                producer: d.producer,
                clean: d.clean,
                arguments: d.arguments.split_whitespace().map(str::to_owned).collect(),
            };
            diagnosis::diagnosis(&plan, d.seeds.clone(), d.at_once, &file, &scratch)
        }
        Command::Months(m) => {
            let file = m.results.clone().unwrap_or_else(|| results.join("months.jsonl"));
            let sets = months::Sets { seeds: m.seeds.clone(), hours: m.hours, at_once: m.at_once };
            months::months(&sets, &file, &scratch)
        }
        Command::Kills(k) => {
            let file = k.results.clone().unwrap_or_else(|| results.join("kills.jsonl"));
            kills::kills(&Program::build()?, k.seeds.clone(), k.at_once, &file, &scratch)
        }
        Command::Faults(f) => {
            let file = f.results.clone().unwrap_or_else(|| results.join("faults.jsonl"));
            faults::faults(&Program::build()?, f.seeds.clone(), f.at_once, &file, &scratch)
        }
        Command::Soak(s) => {
            let file = s.results.clone().unwrap_or_else(|| results.join("soak.jsonl"));
            soak::soak(&Program::build()?, s.seeds.clone(), s.days, &file, &scratch)
        }
        Command::Workbench(w) => {
            let file = w.results.clone().unwrap_or_else(|| results.join("workbench.json"));
            workbench::workbench(&Program::build()?, w.days, w.hours, &file, &scratch)
        }
        Command::Limits => limits::limits(&Program::build()?, &results.join("limits.jsonl"), &scratch),
        Command::Speed(s) => speed::measure(&Program::build()?, s.days, &speed_file, &scratch),
        Command::Peers => peers::peers(&Program::build()?, &results.join("peers.json"), &scratch),
        Command::Growth(g) => {
            let what = if g.only.is_empty() { growth::Grows::value_variants() } else { &g.only };
            growth::growth(&Program::build()?, what, g.longest.days, &results.join("growth.json"), &scratch)
        }
        Command::Report => report::write(&results),
        Command::All => {
            let program = Program::build()?;
            campaign::coverage(&program, SEEDS, &coverage_file, &scratch)?;
            table::table(&program, &[1], report::TABLE_DAYS, AT_ONCE, &table_file, &scratch)?;
            speed::measure(&program, report::TABLE_DAYS, &speed_file, &scratch)?;
            report::write(&results)
        }
    }
}

fn main() -> ExitCode {
    match execute(&Arguments::parse()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            note(&format!("dragfree-validation: {error}"));
            ExitCode::FAILURE
        }
    }
}
