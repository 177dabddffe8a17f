//! Stdout holds the result alone: what a plugin prints there goes to stderr.

use std::fs::File;
use std::io::{ErrorKind, Write as _};
use std::sync::OnceLock;

/// What stdout was when the program began.
static STDOUT: OnceLock<File> = OnceLock::new();

/// Keeps stdout for [`print()`] and puts stderr in its place, before a plugin is opened.
///
/// # Errors
/// The operating system has no descriptor left.
#[cfg(unix)]
pub(crate) fn reserve() -> std::io::Result<()> {
    let own = rustix::io::fcntl_dupfd_cloexec(std::io::stdout(), 3)?;
    rustix::stdio::dup2_stdout(std::io::stderr())?;
    let _ = STDOUT.set(File::from(own)); // set once, by `main`
    Ok(())
}

#[cfg(not(unix))]
pub(crate) fn reserve() -> std::io::Result<()> {
    Ok(())
}

/// Writes the result; a reader that has seen enough is no failure.
pub(crate) fn print(text: &str) -> std::io::Result<()> {
    let written = match STDOUT.get() {
        Some(mut stdout) => stdout.write_all(text.as_bytes()),
        None => {
            let mut stdout = std::io::stdout().lock();
            stdout.write_all(text.as_bytes()).and_then(|()| stdout.flush())
        }
    };
    match written {
        Err(error) if error.kind() == ErrorKind::BrokenPipe => Ok(()),
        other => other,
    }
}
