//! How far writers of an archive have come, told beside what they have not committed: for people who look on.

use crate::archive::Archive;
use crate::staging;
use serde::{Deserialize, Serialize};
use std::fs;
use std::path::PathBuf;
use std::time::{Duration, Instant, SystemTime};

/// File of a writer's folder.
pub(crate) const RUNNING: &str = ".running.json";

/// How often a writer tells, and after what time first: a short run tells nothing.
const EVERY: Duration = Duration::from_secs(1);

/// A calibration that is under way.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Running {
    /// What is calibrated: name of the product and spacecraft.
    pub what: String,
    /// Process.
    pub process: u32,
    /// When it began, Unix ns of this machine's clock.
    pub began_ns: i64,
    /// When it told this.
    pub told_ns: i64,
    /// First time of the data, Unix ns.
    pub first_ns: i64,
    /// Everything before this time is done.
    pub until_ns: i64,
    /// End of the data, where it is known.
    pub end_ns: Option<i64>,
}

impl Running {
    /// Seconds of data a second.
    pub fn rate(&self) -> f64 {
        (self.until_ns - self.first_ns) as f64 / (self.told_ns - self.began_ns).max(1) as f64
    }

    /// Part that is done, and seconds that are left; none where no end is known.
    pub fn left(&self) -> Option<(f64, f64)> {
        let (done_ns, all_ns) = (self.until_ns - self.first_ns, self.end_ns? - self.first_ns);
        let part = (done_ns as f64 / all_ns.max(1) as f64).clamp(0.0, 1.0);
        let left_s = (all_ns - done_ns).max(0) as f64 * 1e-9 / self.rate();
        left_s.is_finite().then_some((part, left_s))
    }
}

/// Tells how far a writer has come. What it tells is a help alone: where it cannot be written, nothing is lost.
#[derive(Debug)]
pub struct Teller {
    path: PathBuf,
    next: Instant,
    running: Running,
}

impl Teller {
    pub(crate) fn new(path: PathBuf, what: String) -> Self {
        let now_ns = now_ns();
        let (process, first_ns) = (std::process::id(), 0);
        let running =
            Running { what, process, began_ns: now_ns, told_ns: now_ns, first_ns, until_ns: first_ns, end_ns: None };
        Self { path, next: Instant::now() + EVERY, running }
    }

    /// Everything from `first_ns` to `until_ns` is done, of what goes to `end_ns`.
    pub fn tell(&mut self, first_ns: i64, until_ns: i64, end_ns: Option<i64>) {
        if Instant::now() < self.next {
            return;
        }
        self.next = Instant::now() + EVERY;
        self.running = Running { told_ns: now_ns(), first_ns, until_ns, end_ns, ..self.running.clone() };
        if let Ok(text) = serde_json::to_vec(&self.running) {
            let _ = fs::write(&self.path, text);
        }
    }
}

fn now_ns() -> i64 {
    let since = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default();
    i64::try_from(since.as_nanos()).unwrap_or(i64::MAX)
}

impl Archive {
    /// The calibrations that are under way and have told how far they are; those of dead writers are none.
    pub fn running(&self) -> Vec<Running> {
        let of = |folder: PathBuf| serde_json::from_slice(&fs::read(folder.join(RUNNING)).ok()?).ok();
        let mut all: Vec<Running> = staging::held(self.folder()).into_iter().filter_map(of).collect();
        all.sort_by_key(|running| (running.began_ns, running.process));
        all
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ProductWriter;

    #[test]
    fn what_is_left_follows_from_the_rate() {
        let running = Running {
            what: "COM1B SC1".to_owned(),
            process: 1,
            began_ns: 0,
            told_ns: 2_000_000_000,
            first_ns: 1_000,
            until_ns: 1_000 + 20_000_000_000_000,
            end_ns: Some(1_000 + 80_000_000_000_000),
        };
        assert_eq!(running.rate(), 1e4);
        let (part, left_s) = running.left().expect("an end");
        assert!(part == 0.25 && (left_s - 6.0).abs() < 1e-9, "{part} {left_s}");
        assert_eq!(Running { end_ns: None, ..running.clone() }.left(), None);
        assert_eq!(Running { until_ns: 1_000, ..running }.left(), None, "nothing is done yet");
    }

    #[test]
    fn a_writer_is_seen_while_it_lives() {
        let folder = tempfile::tempdir().expect("a folder");
        let writer = ProductWriter::begin(folder.path()).expect("a writer");
        let archive = Archive::open(folder.path()).expect("an archive");
        let mut teller = writer.teller("COM1B SC1");
        teller.tell(10, 20, Some(30));
        assert_eq!(archive.running(), [], "not within the first second");
        teller.next = Instant::now();
        teller.tell(10, 20, Some(30));
        let seen = archive.running();
        assert_eq!((seen.len(), seen[0].until_ns, seen[0].process), (1, 20, std::process::id()));
        drop(writer);
        assert_eq!(archive.running(), []);
    }

    #[test]
    fn what_a_dead_writer_has_told_is_not_believed() {
        let folder = tempfile::tempdir().expect("a folder");
        let archive = Archive::create(folder.path()).expect("an archive");
        let dead = folder.path().join("staging/wdead");
        fs::create_dir_all(&dead).expect("a folder");
        fs::write(dead.with_extension("lock"), "").expect("written");
        let mut teller = Teller::new(dead.join(RUNNING), "COM1B SC1".to_owned());
        teller.next = Instant::now();
        teller.tell(10, 20, None);
        assert!(dead.join(RUNNING).exists());
        assert_eq!(archive.running(), []);
    }
}
