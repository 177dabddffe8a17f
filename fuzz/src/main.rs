//! `dragfree-fuzz`: rounds of damaged inputs; goes on where the results end.

use clap::Parser;
use dragfree_fuzz::mutate::input;
use dragfree_fuzz::round::{Round, round};
use dragfree_fuzz::targets::Target;
use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Duration;

/// Feeds damaged inputs to readers, and writes what came of it.
#[derive(Debug, Parser)]
struct Arguments {
    /// Readers; all of them by default
    #[arg(value_name = "TARGET")]
    targets: Vec<String>,
    /// Seconds for each
    #[arg(long, default_value_t = 60.0)]
    seconds: f64,
    /// Most inputs for each
    #[arg(long, default_value_t = u64::MAX)]
    inputs: u64,
    /// Write the input with this number into a file, and read nothing
    #[arg(long, value_name = "N")]
    show: Option<u64>,
    /// File of results
    #[arg(long, value_name = "FILE", default_value = "validation/results/fuzz.jsonl")]
    results: PathBuf,
}

#[derive(Debug, thiserror::Error)]
enum FuzzError {
    #[error("there is no reader {0}; there are {known}", known = Target::ALL.map(Target::name).join(", "))]
    Target(String),
    #[error("{path}: {1}", path = .0.display())]
    File(PathBuf, std::io::Error),
    #[error("{path}: {1}", path = .0.display())]
    Results(PathBuf, serde_json::Error),
}

fn main() -> ExitCode {
    // Panics are counted, not told one by one.
    std::panic::set_hook(Box::new(|_| {}));
    match run(&Arguments::parse()) {
        Ok(true) => ExitCode::SUCCESS,
        Ok(false) => ExitCode::from(3),
        Err(error) => {
            let _ = writeln!(std::io::stderr(), "dragfree-fuzz: {error}"); // nobody is left to tell
            ExitCode::FAILURE
        }
    }
}

fn run(arguments: &Arguments) -> Result<bool, FuzzError> {
    let named = |name: &String| Target::named(name).ok_or_else(|| FuzzError::Target(name.clone()));
    let mut targets = arguments.targets.iter().map(named).collect::<Result<Vec<_>, _>>()?;
    if targets.is_empty() {
        targets = Target::ALL.to_vec();
    }
    let scratch = tempfile::tempdir().map_err(|e| FuzzError::File(std::env::temp_dir(), e))?;
    let mut sound = true;
    for target in targets {
        let kept = scratch.path().join(target.name());
        let failed = |error| FuzzError::File(kept.clone(), error);
        if let Some(number) = arguments.show {
            let path = PathBuf::from(format!("{}-{number}.bin", target.name()));
            let bytes = input(&target.corpus().map_err(failed)?, number);
            std::fs::write(&path, bytes).map_err(|e| FuzzError::File(path, e))?;
            continue;
        }
        let first = next(&arguments.results, target)?;
        let time = Duration::from_secs_f64(arguments.seconds);
        let round = round(target, first, arguments.inputs, time, &kept).map_err(failed)?;
        sound &= round.panics.is_empty() && round.late.is_empty();
        let _ = writeln!(std::io::stderr(), "{} {}: {} panics", round.target, round.inputs, round.panics.len());
        append(&arguments.results, &round)?;
    }
    Ok(sound)
}

/// Number of the first input that a reader has not had.
fn next(results: &Path, target: Target) -> Result<u64, FuzzError> {
    let text = match std::fs::read_to_string(results) {
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(0),
        text => text.map_err(|e| FuzzError::File(results.to_owned(), e))?,
    };
    let mut next = 0;
    for line in text.lines() {
        let round: Round = serde_json::from_str(line).map_err(|e| FuzzError::Results(results.to_owned(), e))?;
        if round.target == target.name() {
            next = next.max(round.first + round.inputs);
        }
    }
    Ok(next)
}

fn append(results: &Path, round: &Round) -> Result<(), FuzzError> {
    let line = serde_json::to_string(round).map_err(|e| FuzzError::Results(results.to_owned(), e))?;
    let open = std::fs::File::options().create(true).append(true).open(results);
    open.and_then(|mut file| writeln!(file, "{line}")).map_err(|e| FuzzError::File(results.to_owned(), e))
}
