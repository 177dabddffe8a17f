//! `dragfree simulate`.

use super::Done;
use crate::args::{Global, Simulate};
use crate::failure::Failure;
use crate::progress::Meter;
use dragfree_engine::simulate::{SimulateOptions, SimulateOutcome, simulate};
use std::fmt::Write as _;

/// The bundled simulator.
const SOURCE: &str = "sim";

pub(super) fn execute(command: &Simulate, global: &Global) -> Result<Done, Failure> {
    let made = run(command, global)?;
    if global.json {
        let paths =
            |files: &[std::path::PathBuf]| files.iter().map(|f| f.to_string_lossy().into_owned()).collect::<Vec<_>>();
        return Ok(Done::json(&serde_json::json!({
            "files": paths(&made.files), "truth_files": paths(&made.truth_files), "sealed_file": made.sealed_file,
        })));
    }
    let mut text = String::new();
    for file in &made.files {
        let _ = writeln!(text, "telemetry {}", file.display());
    }
    for file in &made.truth_files {
        let _ = writeln!(text, "truth     {}", file.display());
    }
    if let Some(file) = &made.sealed_file {
        let _ = writeln!(text, "sealed    {}", file.display());
    }
    Ok(Done::new(text))
}

/// Runs the simulator and writes its files.
pub(super) fn run(command: &Simulate, global: &Global) -> Result<SimulateOutcome, Failure> {
    let registry = super::registry(global)?;
    let mut parameters = toml::Table::new();
    parameters.insert("seed".into(), i64::from(command.seed).into());
    if let Some(seed) = command.hidden {
        parameters.insert("hidden".into(), i64::from(seed).into());
    }
    parameters.insert("command".into(), (!command.no_command).into());
    parameters.insert("effects".into(), command.effects.clone().into());
    parameters.insert("manoeuvres".into(), command.manoeuvres.clone().into());
    let options = SimulateOptions {
        mission: command.mission.clone(),
        out: command.out.clone(),
        start_ns: command.start_ns,
        end_ns: command.end_ns(),
        source: SOURCE.to_owned(),
        parameters,
        software: super::SOFTWARE.to_owned(),
        threads: super::threads(global),
    };
    let mut meter = Meter::new("simulate", global);
    Ok(simulate(&registry, &options, &mut |progress| meter.show(&progress))?)
}
