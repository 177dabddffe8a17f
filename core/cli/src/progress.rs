//! Progress on stderr: one line that is rewritten on a terminal, a plain line now and then where it is asked for.

use crate::args::Global;
use crate::utc;
use dragfree_workflow::calibrate::Progress;
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
    until_ns: i64,
}

impl Meter {
    /// `-v` shows progress also where stderr is no terminal.
    pub(crate) fn new(job: &'static str, global: &Global) -> Self {
        let style = match (global.quiet, std::io::stderr().is_terminal()) {
            (true, _) => Style::Silent,
            (false, true) => Style::Line,
            (false, false) if global.verbose > 0 => Style::Plain,
            (false, false) => Style::Silent,
        };
        Self { style, job, started: Instant::now(), shown: None, until_ns: i64::MIN }
    }

    /// Shows how far the job is, now and then.
    pub(crate) fn show(&mut self, progress: &Progress) {
        let interval = match self.style {
            Style::Silent => return,
            Style::Line => Duration::from_millis(200),
            Style::Plain => Duration::from_secs(5),
        };
        let now = Instant::now();
        let elapsed = self.elapsed(now, progress.until_ns);
        if now.duration_since(self.shown.unwrap_or(self.started)) < interval {
            return;
        }
        self.shown = Some(now);
        let line = line(self.job, elapsed, progress);
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

    /// Time since the pass has begun: a job may go over its data several times, each at a rate of its own.
    fn elapsed(&mut self, now: Instant, until_ns: i64) -> Duration {
        if until_ns < self.until_ns {
            (self.started, self.shown) = (now, Some(now));
        }
        self.until_ns = until_ns;
        now.duration_since(self.started)
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

/// `run  2035-01-01 03:00:00  21600 × real time  50 %  1 s left`.
fn line(job: &str, elapsed: Duration, progress: &Progress) -> String {
    let Progress { first_ns, until_ns, end_ns } = *progress;
    let seconds = |from: i64, to: i64| to.saturating_sub(from).max(0) as f64 * 1e-9;
    let done_s = seconds(first_ns, until_ns);
    let rate = done_s / elapsed.as_secs_f64().max(1e-9);
    let second_ns = until_ns.div_euclid(1_000_000_000) * 1_000_000_000;
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
    fn each_pass_over_the_data_has_a_rate_of_its_own() {
        let (started, second) = (Instant::now(), Duration::from_secs(1));
        let mut meter = Meter { style: Style::Silent, job: "decide", started, shown: None, until_ns: i64::MIN };
        assert_eq!(meter.elapsed(started + second, START_NS), second);
        assert_eq!(meter.elapsed(started + 10 * second, START_NS + HOUR_NS), 10 * second);
        assert_eq!(meter.elapsed(started + 11 * second, START_NS), Duration::ZERO);
        assert_eq!(meter.elapsed(started + 13 * second, START_NS + HOUR_NS), 2 * second);
    }

    #[test]
    fn rate_and_time_left_follow_from_the_epochs() {
        let said = |hours: i64, end_ns: Option<i64>| {
            let progress = Progress { until_ns: START_NS + hours * HOUR_NS, first_ns: START_NS, end_ns };
            line("run", Duration::from_secs(1), &progress)
        };
        let end_ns = Some(START_NS + 6 * HOUR_NS);
        assert_eq!(said(3, end_ns), "run  2035-01-01 03:00:00  10800 × real time  50 %  1 s left");
        assert_eq!(said(0, None), "run  2035-01-01 00:00:00  0 × real time");
        assert!(said(7, end_ns).ends_with("100 %  0 s left"));
    }
}
