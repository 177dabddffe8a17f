//! Logs go to stderr, from warnings on unless `-q`, `-v` or `-vv` is given, and to the file of `--log-json`.

use crate::args::Global;
use crate::failure::Failure;
use crate::progress;
use dragfree_archive::files::IoContext as _;
use std::fs::File;
use std::io::{IsTerminal as _, Write};
use std::sync::Mutex;
use tracing_subscriber::filter::LevelFilter;
use tracing_subscriber::prelude::*;

/// Stderr, after the progress line is taken away.
struct Stderr;

impl Write for Stderr {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        progress::clear_line();
        std::io::stderr().write(bytes)
    }

    fn flush(&mut self) -> std::io::Result<()> {
        std::io::stderr().flush()
    }
}

/// Starts logging. The file holds a JSON object a line, with a time, and everything that `-vv` shows.
///
/// # Errors
/// The file cannot be written.
pub(crate) fn start(global: &Global, colour: bool) -> Result<(), Failure> {
    let level = match (global.quiet, global.verbose) {
        (true, _) => LevelFilter::ERROR,
        (false, 0) => LevelFilter::WARN,
        (false, 1) => LevelFilter::INFO,
        (false, 2) => LevelFilter::DEBUG,
        (false, _) => LevelFilter::TRACE,
    };
    let screen = tracing_subscriber::fmt::layer()
        .with_target(global.verbose > 1)
        .without_time()
        .with_ansi(colour && std::io::stderr().is_terminal())
        .with_writer(|| Stderr)
        .with_filter(level);
    let file = match &global.log_json {
        Some(path) => {
            let file = File::create(path).at("write the log", path)?;
            Some(tracing_subscriber::fmt::layer().json().with_writer(Mutex::new(file)).with_filter(LevelFilter::DEBUG))
        }
        None => None,
    };
    tracing_subscriber::registry().with(screen).with(file).init();
    Ok(())
}
