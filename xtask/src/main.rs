//! Tasks of the project's developers. `cargo xtask dist --out DIR` makes a release, `cargo xtask second-checkout --at
//! DIR` looks whether another checkout makes every product again, `cargo xtask miri` whether the border breaks a rule
//! of memory.

mod deb;
mod dist;
mod miri;
mod sbom;
mod second_checkout;
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
    /// Build a clone elsewhere, and make every product of an archive again with it; takes as long as a build
    SecondCheckout {
        /// A new folder for the clone and the archive
        #[arg(long, value_name = "DIR")]
        at: PathBuf,
        /// Hours of telemetry of each of four days
        #[arg(long, default_value = "2")]
        hours: String,
    },
    /// Run the tests of the border under Miri, which is installed where it is missing
    Miri,
}

fn main() -> ExitCode {
    let done = match Arguments::parse().task {
        Task::Dist { out } => dist::make(&out),
        Task::SecondCheckout { at, hours } => second_checkout::try_it(&at, &hours),
        Task::Miri => miri::look(),
    };
    match done {
        Ok(told) => {
            let _ = write!(std::io::stdout(), "{told}"); // nobody may be reading
            ExitCode::SUCCESS
        }
        Err(error) => {
            let _ = writeln!(std::io::stderr(), "xtask: {error}"); // nobody is left to tell
            ExitCode::FAILURE
        }
    }
}
