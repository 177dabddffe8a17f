//! A round of inputs for one reader, and what came of it.

use crate::mutate::input;
use crate::targets::Target;
use serde::{Deserialize, Serialize};
use std::io;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// Time in which an input must have been read.
pub const LONGEST: Duration = Duration::from_secs(2);

/// What a round came to, a line of the results.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Round {
    /// Reader.
    pub target: String,
    /// Number of the first input.
    pub first: u64,
    /// How many there were.
    pub inputs: u64,
    /// Numbers of the inputs that made it panic.
    pub panics: Vec<u64>,
    /// Numbers of the inputs that took longer than [`LONGEST`].
    pub late: Vec<u64>,
    /// Longest time, s.
    pub slowest_s: f64,
    /// Most memory of the process until then, MB; none where the system does not say.
    pub peak_mb: Option<f64>,
}

/// Reads inputs from the `first` on, until there were `most` or the time is up. An input is kept in `kept` while it is
/// read, so that what ends the process is there afterwards.
///
/// # Errors
/// Corpus or scratch cannot be read or written.
pub fn round(target: Target, first: u64, most: u64, time: Duration, kept: &Path) -> io::Result<Round> {
    let corpus = target.corpus()?;
    let (begun, scratch) = (Instant::now(), PathBuf::from(kept).with_extension("file"));
    let name = target.name().to_owned();
    let mut round =
        Round { target: name, first, inputs: 0, panics: vec![], late: vec![], slowest_s: 0.0, peak_mb: None };
    while round.inputs < most && (!round.inputs.is_multiple_of(64) || begun.elapsed() < time) {
        let number = first + round.inputs;
        let bytes = input(&corpus, number);
        let before = Instant::now();
        let read = catch_unwind(AssertUnwindSafe(|| target.read(&bytes, &scratch)));
        let took = before.elapsed();
        match read {
            Ok(read) => read?,
            Err(_) => round.panics.push(number),
        }
        if took > LONGEST {
            round.late.push(number);
        }
        round.slowest_s = round.slowest_s.max(took.as_secs_f64());
        round.inputs += 1;
    }
    round.peak_mb = peak_mb();
    Ok(round)
}

/// Most memory that the process has had, MB.
fn peak_mb() -> Option<f64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"))?;
    line.trim().strip_suffix("kB")?.trim().parse::<f64>().ok().map(|kb| kb / 1e3)
}
