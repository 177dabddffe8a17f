//! Logs go to stderr; the engine's warnings are shown unless `-q` is given.

use crate::progress;
use std::io::{IsTerminal as _, Write};
use tracing_subscriber::filter::LevelFilter;

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

/// Starts logging; `verbose` counts the `-v`.
pub(crate) fn start(quiet: bool, verbose: u8, colour: bool) {
    let level = match (quiet, verbose) {
        (true, _) => LevelFilter::ERROR,
        (false, 0) => LevelFilter::WARN,
        (false, 1) => LevelFilter::INFO,
        (false, 2) => LevelFilter::DEBUG,
        (false, _) => LevelFilter::TRACE,
    };
    tracing_subscriber::fmt()
        .with_max_level(level)
        .with_target(verbose > 1)
        .without_time()
        .with_ansi(colour && std::io::stderr().is_terminal())
        .with_writer(|| Stderr)
        .init();
}
