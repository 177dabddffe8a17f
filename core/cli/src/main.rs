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
mod watchdog;

use args::{Arguments, Colour};
use clap::Parser as _;
use dragfree_engine::border;
use std::io::{IsTerminal as _, Write as _};
use std::process::ExitCode;
use std::time::Duration;

fn main() -> ExitCode {
    let arguments = Arguments::parse();
    border::watch_exit();
    let code = perform(arguments);
    border::exit_is_due();
    code
}

fn perform(mut arguments: Arguments) -> ExitCode {
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
    // The process of a plugin has no thread before it is limited in what it may do; the one that asked it looks.
    if !arguments.command.is_a_plugins_process() {
        watchdog::start(Duration::from_secs_f64(arguments.global.plugin_time_limit));
    }
    let mut run = || -> Result<u8, failure::Failure> {
        installed::resolve(&mut arguments)?;
        if arguments.command.carries_rows() {
            interrupt::listen()?;
        }
        let done = commands::execute(&arguments, paint)?;
        let text = if arguments.global.json { done.text } else { text::harmless(&done.text, paint) };
        output::print(&text)?;
        Ok(done.code)
    };
    run().map_or_else(|error| complain(&*error), ExitCode::from)
}

fn complain(error: &dyn std::error::Error) -> ExitCode {
    progress::clear_line();
    let what = text::harmless(&failure::chain(error), text::Paint(false));
    let _ = writeln!(std::io::stderr(), "dragfree: {what}"); // nobody is left to tell
    ExitCode::FAILURE
}
