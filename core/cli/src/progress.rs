//! Progress on stderr: one line that is rewritten on a terminal, a plain line now and then where it is asked for.

use crate::utc;
use std::io::{IsTerminal as _, Write as _};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// True while an unfinished line stands on the terminal, so that logs begin a fresh one.
static LINE_OPEN: AtomicBool = AtomicBool::new(false);

/// How progress is shown.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Style {
    Silent,
    Line,
    Plain,
}

/// Progress of one job.
pub(crate) struct Meter {
    style: Style,
    job: &'static str,
    started: Instant,
    shown: Option<Instant>,
    first_ns: Option<i64>,
}

impl Meter {
    /// `verbose` shows progress also where stderr is no terminal.
    pub(crate) fn new(job: &'static str, quiet: bool, verbose: bool) -> Self {
        let style = match (quiet, std::io::stderr().is_terminal()) {
            (true, _) => Style::Silent,
            (false, true) => Style::Line,
            (false, false) if verbose => Style::Plain,
            (false, false) => Style::Silent,
        };
        Self { style, job, started: Instant::now(), shown: None, first_ns: None }
    }

    /// `epoch_ns` is reached; the job ends at `end_ns` where that is known.
    pub(crate) fn reached(&mut self, epoch_ns: i64, end_ns: Option<i64>) {
        let first_ns = *self.first_ns.get_or_insert(epoch_ns);
        let interval = match self.style {
            Style::Silent => return,
            Style::Line => Duration::from_millis(200),
            Style::Plain => Duration::from_secs(5),
        };
        let now = Instant::now();
        if now.duration_since(self.shown.unwrap_or(self.started)) < interval {
            return;
        }
        self.shown = Some(now);
        let line = line(self.job, now.duration_since(self.started), first_ns, epoch_ns, end_ns);
        let mut stderr = std::io::stderr().lock();
        // Progress that cannot be shown is no reason to stop.
        let _ = match self.style {
            Style::Line => {
                LINE_OPEN.store(true, Ordering::Relaxed);
                write!(stderr, "\r\x1b[K{line}").and_then(|()| stderr.flush())
            }
            Style::Plain | Style::Silent => writeln!(stderr, "{line}"),
        };
    }
}

impl Drop for Meter {
    fn drop(&mut self) {
        clear_line();
    }
}

/// Takes the progress line away before something else is written to the terminal.
pub(crate) fn clear_line() {
    if LINE_OPEN.swap(false, Ordering::Relaxed) {
        let _ = write!(std::io::stderr(), "\r\x1b[K"); // as above
    }
}

/// `run  2035-01-01 03:00:00  50 %  21600 × real time  1 s left`.
fn line(job: &str, elapsed: Duration, first_ns: i64, epoch_ns: i64, end_ns: Option<i64>) -> String {
    let seconds = |from: i64, to: i64| to.saturating_sub(from).max(0) as f64 * 1e-9;
    let done_s = seconds(first_ns, epoch_ns);
    let rate = done_s / elapsed.as_secs_f64().max(1e-9);
    let second_ns = epoch_ns.div_euclid(1_000_000_000) * 1_000_000_000;
    let mut line = format!("{job}  {}  {rate:.0} × real time", utc::format(second_ns));
    if let Some(end_ns) = end_ns {
        let whole_s = seconds(first_ns, end_ns);
        if whole_s > 0.0 && rate > 0.0 {
            let left_s = (whole_s - done_s).max(0.0) / rate;
            line += &format!("  {:.0} %  {left_s:.0} s left", (100.0 * done_s / whole_s).min(100.0));
        }
    }
    line
}

#[cfg(test)]
mod tests {
    use super::*;

    const START_NS: i64 = 2_051_222_400_000_000_000;
    const HOUR_NS: i64 = 3_600_000_000_000;

    #[test]
    fn rate_and_time_left_follow_from_the_epochs() {
        let second = Duration::from_secs(1);
        let half = line("run", second, START_NS, START_NS + 3 * HOUR_NS, Some(START_NS + 6 * HOUR_NS));
        assert_eq!(half, "run  2035-01-01 03:00:00  10800 × real time  50 %  1 s left");
        assert_eq!(line("run", second, START_NS, START_NS, None), "run  2035-01-01 00:00:00  0 × real time");
        let past = line("run", second, START_NS, START_NS + 7 * HOUR_NS, Some(START_NS + 6 * HOUR_NS));
        assert!(past.ends_with("100 %  0 s left"), "{past}");
    }
}
