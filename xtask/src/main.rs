//! Tasks of the project's developers. `cargo xtask dist --out DIR` makes a release.

mod deb;
mod dist;
mod sbom;
mod tree;

use clap::{Parser, Subcommand};
use std::io::Write as _;
use std::path::PathBuf;
use std::process::ExitCode;

/// Why a task failed, one sentence.
type Failure = Box<dyn std::error::Error>;

#[derive(Debug, Parser)]
#[command(name = "cargo xtask", arg_required_else_help = true)]
struct Arguments {
    #[command(subcommand)]
    task: Task,
}

#[derive(Debug, Subcommand)]
enum Task {
    /// Make the release archive and the Debian package of this machine's platform
    Dist {
        /// Folder for both
        #[arg(long, value_name = "DIR")]
        out: PathBuf,
    },
}

fn main() -> ExitCode {
    let Task::Dist { out } = Arguments::parse().task;
    match dist::make(&out) {
        Ok(files) => {
            for file in files {
                let _ = writeln!(std::io::stdout(), "{}", file.display()); // nobody may be reading
            }
            ExitCode::SUCCESS
        }
        Err(error) => {
            let _ = writeln!(std::io::stderr(), "xtask: {error}"); // nobody is left to tell
            ExitCode::FAILURE
        }
    }
}
