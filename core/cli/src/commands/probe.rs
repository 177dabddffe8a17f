//! Libraries that no `plugins.lock` vouches for are opened in a child process before this one opens them: one that
//! crashes, ends the program or hangs where it is opened is refused, and stops nobody.

use super::Done;
use crate::failure::Failure;
use crate::output;
use dragfree_engine::border::{self, BorderError, Identity, Library};
use serde_json::{Value, json};
use std::io::{BufRead as _, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::mpsc::{Receiver, channel};
use std::time::{Duration, Instant};

/// For each file the identity of what was opened, or why it is refused.
pub(super) fn probe(files: &[&Path], by: Identity, limit: Duration) -> Vec<Result<String, String>> {
    let mut answers: Vec<Result<String, String>> = Vec::with_capacity(files.len());
    while answers.len() < files.len() {
        let (mut child, lines) = match start(&files[answers.len()..], by) {
            Ok(started) => started,
            Err(error) => {
                let failed = format!("cannot be tried in a process of its own: {error}");
                answers.resize(files.len(), Err(failed));
                break;
            }
        };
        let (before, mut begun) = (answers.len(), Instant::now());
        let late = loop {
            if answers.len() == files.len() {
                break false;
            }
            match lines.recv_timeout(limit.saturating_sub(begun.elapsed())) {
                Ok(line) => {
                    answers.extend(answer(&line));
                    begun = Instant::now();
                }
                Err(std::sync::mpsc::RecvTimeoutError::Timeout) => break true,
                Err(std::sync::mpsc::RecvTimeoutError::Disconnected) => break false,
            }
        };
        // A child that gave all its answers has nothing else to do, and one that is late is not waited for.
        let status =
            if late || answers.len() == files.len() { child.kill().and_then(|()| child.wait()) } else { child.wait() };
        if answers.len() < files.len() {
            let how = match status {
                _ if late => format!("was not open after {} s", limit.as_secs_f64()),
                Ok(status) => border::ended(status),
                Err(error) => error.to_string(),
            };
            answers.push(Err(format!("{how}, where it was opened; it was tried in a process of its own")));
        }
        debug_assert!(answers.len() > before, "each child answers for one library at least");
    }
    answers
}

/// A child that opens the files in order, and its lines.
fn start(files: &[&Path], by: Identity) -> std::io::Result<(Child, Receiver<String>)> {
    let mut command = Command::new(std::env::current_exe()?);
    command.args(["plugins", "probe", "--quiet"]);
    if by == Identity::Digest {
        command.arg("--digests");
    }
    command.args(files);
    let mut child = command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::null()).spawn()?;
    let (sender, lines) = channel();
    let stdout = child.stdout.take();
    // A process that a library has started may keep the pipe open after the child's end, hence the thread.
    std::thread::spawn(move || {
        for line in stdout.into_iter().flat_map(|pipe| BufReader::new(pipe).lines()).map_while(Result::ok) {
            if sender.send(line).is_err() {
                break;
            }
        }
    });
    Ok((child, lines))
}

fn answer(line: &str) -> Option<Result<String, String>> {
    let answer: Value = serde_json::from_str(line).ok()?;
    let text = |key: &str| answer[key].as_str().map(str::to_owned);
    text("opened").map(Ok).or_else(|| text("refused").map(Err))
}

/// The child's part: opens each file and says so at once.
pub(super) fn child(files: &[PathBuf], digests: bool) -> Result<Done, Failure> {
    let by = if digests { Identity::Digest } else { Identity::Look };
    for file in files {
        let answer = match Library::try_open(file, by) {
            Ok(identity) => json!({ "opened": identity }),
            Err(BorderError::Refused { reason, .. }) => json!({ "refused": reason }),
            Err(error) => json!({ "refused": error.to_string() }),
        };
        output::print(&format!("{answer}\n"))?;
    }
    border::exit_now(0)
}
