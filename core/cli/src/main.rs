//! The dragfree command: arguments, progress, tables, exit codes. What it does is done by the engine.

mod args;
mod bundled;
mod commands;
mod failure;
mod logs;
mod progress;
mod screen;
mod text;
mod truth;
mod utc;

use args::{Arguments, Colour};
use clap::Parser as _;
use std::io::{ErrorKind, IsTerminal as _, Write as _};
use std::process::ExitCode;

fn main() -> ExitCode {
    let arguments = Arguments::parse();
    let allowed = std::env::var_os("NO_COLOR").is_none_or(|value| value.is_empty());
    let colour = |terminal: bool| match arguments.global.color {
        Colour::Always => true,
        Colour::Never => false,
        Colour::Auto => allowed && terminal,
    };
    logs::start(arguments.global.quiet, arguments.global.verbose, colour(std::io::stderr().is_terminal()));
    let paint = text::Paint(colour(std::io::stdout().is_terminal()));
    match commands::execute(&arguments, paint) {
        Ok(done) => match print(&done.text) {
            Ok(()) => ExitCode::from(done.code),
            Err(error) => complain(&error),
        },
        Err(error) => complain(&error),
    }
}

/// Writes the result; a reader that has seen enough is no failure.
fn print(text: &str) -> std::io::Result<()> {
    let mut stdout = std::io::stdout().lock();
    match stdout.write_all(text.as_bytes()).and_then(|()| stdout.flush()) {
        Err(error) if error.kind() == ErrorKind::BrokenPipe => Ok(()),
        other => other,
    }
}

fn complain(error: &dyn std::error::Error) -> ExitCode {
    progress::clear_line();
    let _ = writeln!(std::io::stderr(), "dragfree: {}", failure::chain(error)); // nobody is left to tell
    ExitCode::FAILURE
}
