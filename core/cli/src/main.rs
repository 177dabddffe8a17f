//! The dragfree command: arguments, progress, tables, exit codes. What it does is done by the engine.

mod advice;
mod args;
mod bundled;
mod commands;
mod failure;
mod installed;
mod interrupt;
mod logs;
mod operations;
mod output;
mod progress;
mod screen;
mod text;
mod truth;
mod utc;

use args::{Arguments, Colour};
use clap::Parser as _;
use std::io::{IsTerminal as _, Write as _};
use std::process::ExitCode;

fn main() -> ExitCode {
    let mut arguments = Arguments::parse();
    let allowed = std::env::var_os("NO_COLOR").is_none_or(|value| value.is_empty());
    let colour = |terminal: bool| match arguments.global.color {
        Colour::Always => true,
        Colour::Never => false,
        Colour::Auto => allowed && terminal,
    };
    if let Err(error) = logs::start(&arguments.global, colour(std::io::stderr().is_terminal())) {
        return complain(&*error);
    }
    let paint = text::Paint(colour(std::io::stdout().is_terminal()));
    if let Err(error) = output::reserve() {
        return complain(&error);
    }
    let mut run = || -> Result<u8, failure::Failure> {
        installed::resolve(&mut arguments)?;
        if arguments.command.carries_rows() {
            interrupt::listen()?;
        }
        let done = commands::execute(&arguments, paint)?;
        output::print(&done.text)?;
        Ok(done.code)
    };
    run().map_or_else(|error| complain(&*error), ExitCode::from)
}

fn complain(error: &dyn std::error::Error) -> ExitCode {
    progress::clear_line();
    let _ = writeln!(std::io::stderr(), "dragfree: {}", failure::chain(error)); // nobody is left to tell
    ExitCode::FAILURE
}
