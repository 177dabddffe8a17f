//! `dragfree demo`: simulate, run, show, and only then look at the truth.

use super::{Done, run, simulate};
use crate::args::{Archive, BATCH_ROWS, Chain, Global, Run, Simulate};
use crate::failure::Failure;
use crate::text::Paint;
use crate::{bundled, screen, truth};
use dragfree_engine::product;
use std::fmt::Write as _;
use std::fs::{self, OpenOptions};
use std::io::{ErrorKind, Write as _};
use std::path::Path;

/// File that marks a folder as the demo's own.
const MARK: &str = ".dragfree-demo";

/// 2035-01-01, the day of the paper's simulation.
const START_NS: i64 = 2_051_222_400_000_000_000;

pub(super) fn execute(folder: &Path, global: &Global, paint: Paint) -> Result<Done, Failure> {
    own(folder)?;
    for (path, text) in bundled::FILES {
        place(&folder.join(path), text)?;
    }
    // Only the telemetry is made anew: the archive keeps every revision, the configuration is the user's.
    let telemetry = folder.join("telemetry");
    if telemetry.exists() {
        fs::remove_dir_all(&telemetry).map_err(Failure::io("remove the earlier demo's", &telemetry))?;
    }
    let made = simulate::run(
        &Simulate {
            mission: folder.join(bundled::MISSION),
            out: telemetry,
            start_ns: START_NS,
            hours: Some(6.0),
            days: None,
            seed: 1,
            effects: Vec::new(),
            hidden: None,
            no_command: false,
        },
        global,
    )?;
    let command = Run {
        chain: Chain {
            pipeline: folder.join(bundled::PIPELINE),
            files: made.files.clone(),
            mission: None,
            model: None,
            archive: Archive { folder: folder.join("archive") },
        },
        from: None,
        until: None,
        load_state: None,
        save_state: None,
        batch_rows: BATCH_ROWS,
    };
    let outcome = run::archive(&command, global)?;
    let code = run::code(&outcome.product);
    let truth = made.truth_files.first().map(|file| truth::first(file)).transpose()?.unwrap_or_default();
    if global.json {
        let mut json = product::to_json(&outcome.product, &outcome.path);
        json["truth"] = serde_json::json!(truth);
        return Ok(Done { code, ..Done::json(&json) });
    }
    let mut text = screen::product(&outcome.product, &outcome.path, paint);
    for file in &made.files {
        let _ = writeln!(text, "telemetry {}", file.display());
    }
    let _ = writeln!(text, "next      {}", run::next(&outcome.product, &command.chain.archive.folder));
    let _ = writeln!(text, "          open the .mcap files in Foxglove, PlotJuggler or Rerun");
    let _ = writeln!(text, "\nThe truth of the simulation, which no stage has seen:");
    text += &truth::table(&outcome.product.result.coefficients, &truth);
    Ok(Done { text, code })
}

/// Makes `folder` the demo's own: it must be new, empty or an earlier demo's.
fn own(folder: &Path) -> Result<(), Failure> {
    fs::create_dir_all(folder).map_err(Failure::io("make", folder))?;
    let empty = fs::read_dir(folder).map_err(Failure::io("read", folder))?.next().is_none();
    if !empty && !folder.join(MARK).is_file() {
        return Err(Failure::NoDemoFolder(folder.to_owned()));
    }
    place(&folder.join(MARK), "Made by `dragfree demo`, which replaces telemetry/ when it is run again.\n")
}

/// Writes a bundled file; one that is there is the user's and stays.
fn place(path: &Path, text: &str) -> Result<(), Failure> {
    if let Some(folder) = path.parent() {
        fs::create_dir_all(folder).map_err(Failure::io("make", folder))?;
    }
    match OpenOptions::new().write(true).create_new(true).open(path) {
        Ok(mut file) => file.write_all(text.as_bytes()).map_err(Failure::io("write", path)),
        Err(error) if error.kind() == ErrorKind::AlreadyExists => Ok(()),
        Err(error) => Err(Failure::io("write", path)(error)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_folder_of_someone_else_is_refused_and_untouched() {
        let folder = tempfile::tempdir().expect("folder");
        let mine = folder.path().join("mine.txt");
        fs::write(&mine, "mine").expect("write");
        assert!(matches!(own(folder.path()), Err(Failure::NoDemoFolder(_))));
        assert_eq!(fs::read_dir(folder.path()).expect("folder").count(), 1);
        fs::remove_file(&mine).expect("remove");
        own(folder.path()).expect("an empty folder will do");
        own(folder.path()).expect("and the demo's own");
    }

    #[test]
    fn a_file_that_the_user_changed_stays() {
        let folder = tempfile::tempdir().expect("folder");
        let path = folder.path().join("missions/taiji.toml");
        place(&path, "first").expect("written");
        fs::write(&path, "changed").expect("write");
        place(&path, "first").expect("left alone");
        assert_eq!(fs::read_to_string(&path).expect("read"), "changed");
    }
}
