//! `dragfree-validation`: measures, and writes the generated parts of VALIDATION.md.

use clap::{Args, Parser, Subcommand};
use dragfree_validation::campaign::{self, CampaignError, note};
use dragfree_validation::program::{Program, root};
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
    match &arguments.command {
        Command::Coverage(c) => {
            let file = c.results.clone().unwrap_or_else(|| results.join("coverage.jsonl"));
            campaign::coverage(&Program::build()?, c.seeds.clone(), &file, &scratch)
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
