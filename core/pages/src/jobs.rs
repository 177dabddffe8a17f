//! Commands that a page starts, one at a time. Each is a program of its own: what fails there ends nothing here, and its
//! memory is not that of the pages.

use std::io::Read;
use std::process::{Child, Command, Stdio};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use dragfree_workflow::words::quoted;
use maud::{Markup, html};
use serde::Deserialize;

use crate::PagesError;
use crate::layout::{Links, command};
use crate::site::Site;

/// Bytes of what a command says that are kept: its last lines.
const KEPT: usize = 4000;

/// Products that are offered when days have been run.
const OFFERED: usize = 4;

/// What a page may start.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize)]
#[serde(tag = "job", rename_all = "kebab-case", deny_unknown_fields)]
pub enum Job {
    /// Every day that has no product, or one that would come out otherwise now.
    CatchUp,
    /// The diagnosis of a product, with its extract.
    Diagnose {
        /// Id of the product.
        product: String,
    },
}

/// The program that does a job; none where it cannot be done here.
pub type Starter = Box<dyn Fn(&Job) -> Option<Command> + Send + Sync>;

/// The command under way and the last one that has ended.
#[derive(Default)]
pub(crate) struct Jobs(Arc<Mutex<State>>);

#[derive(Default)]
struct State {
    now: Option<UnderWay>,
    last: Option<Ended>,
    /// How many have ended.
    ended: u64,
}

struct UnderWay {
    job: Job,
    words: String,
    began: Instant,
    child: Child,
    said: Arc<Mutex<Vec<u8>>>,
}

struct Ended {
    job: Job,
    words: String,
    took: Duration,
    /// Exit code; none where a signal ended it.
    code: Option<i32>,
    said: String,
}

fn locked<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Keeps the last bytes of a stream.
fn follow(mut stream: impl Read + Send + 'static, said: &Arc<Mutex<Vec<u8>>>) -> JoinHandle<()> {
    let said = Arc::clone(said);
    std::thread::spawn(move || {
        let mut chunk = [0; 1024];
        while let Ok(n @ 1..) = stream.read(&mut chunk) {
            let mut said = locked(&said);
            said.extend_from_slice(&chunk[..n]);
            let over = said.len().saturating_sub(KEPT);
            said.drain(..over);
        }
    })
}

fn text(said: &Mutex<Vec<u8>>) -> String {
    String::from_utf8_lossy(&locked(said)).trim().to_owned()
}

impl Jobs {
    /// Starts a command.
    ///
    /// # Errors
    /// Another one is under way, or the program does not start.
    fn start(&self, job: Job, mut command: Command) -> Result<(), PagesError> {
        let args = command.get_args().map(|word| quoted(&word.to_string_lossy()));
        let words = std::iter::once("dragfree".to_owned()).chain(args).collect::<Vec<_>>().join(" ");
        let mut state = locked(&self.0);
        if let Some(now) = &state.now {
            return Err(PagesError::Request(format!("this runs now, and has to end first: {}", now.words)));
        }
        command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
        let mut child = command.spawn().map_err(|e| PagesError::Request(format!("{words} does not start: {e}")))?;
        let said = Arc::default();
        let streams: Vec<JoinHandle<()>> = [
            child.stdout.take().map(|stream| follow(stream, &said)),
            child.stderr.take().map(|stream| follow(stream, &said)),
        ]
        .into_iter()
        .flatten()
        .collect();
        state.now = Some(UnderWay { job, words, began: Instant::now(), child, said });
        drop(state);
        let state = Arc::clone(&self.0);
        std::thread::spawn(move || {
            streams.into_iter().for_each(|stream| drop(stream.join()));
            let mut state = locked(&state);
            let Some(mut now) = state.now.take() else { return };
            // Both streams are closed: it has ended, or is about to.
            let code = now.child.wait().ok().and_then(|status| status.code());
            state.ended += 1;
            let (took, said) = (now.began.elapsed(), text(&now.said));
            state.last = Some(Ended { job: now.job, words: now.words, took, code, said });
        });
        Ok(())
    }
}

impl Drop for Jobs {
    fn drop(&mut self) {
        // A killed command leaves nothing half done in the archive.
        if let Some(now) = &mut locked(&self.0).now {
            let _ = now.child.kill();
        }
    }
}

/// What an exit code says.
fn outcome(code: Option<i32>) -> (&'static str, &'static str) {
    match code {
        Some(0) => ("good-word", "Done"),
        Some(3) => ("good-word", "Done; data were lost"),
        Some(4) => ("good-word", "Done; something is missing from the model"),
        _ => ("bad-word", "Failed"),
    }
}

impl Site {
    /// Starts what a page asks for. Gives what the page says then.
    ///
    /// # Errors
    /// [`PagesError`]: it cannot be done here, there is no such product, or another command is under way.
    pub fn start(&self, job: &Job) -> Result<String, PagesError> {
        let job = match job {
            // The name in the archive, which is no option of a command.
            Job::Diagnose { product } => Job::Diagnose { product: self.archive()?.find(product)?.row.id },
            Job::CatchUp => Job::CatchUp,
        };
        let command = self.setup.starter.as_ref().and_then(|starter| starter(&job));
        let command = command.ok_or_else(|| {
            PagesError::Request("this server has no mission-ops.toml that says which days there are: --ops".to_owned())
        })?;
        self.jobs.start(job, command)?;
        Ok(html! { "Started." }.into_string())
    }

    /// Whether a command that a page has started is under way.
    pub(crate) fn runs(&self) -> bool {
        locked(&self.jobs.0).now.is_some()
    }

    /// The command that a page has started: how far it is, and what came of the last one.
    pub(crate) fn job(&self) -> Result<Markup, PagesError> {
        let state = locked(&self.jobs.0);
        let newest = match &state.last {
            Some(Ended { job: Job::CatchUp, .. }) => self.archive()?.newest()?,
            _ => Vec::new(),
        };
        Ok(html! {
            span class="hidden" data-ended=(state.ended) {}
            @if let Some(now) = &state.now {
                @let said = text(&now.said);
                p { strong { "Runs, " (now.began.elapsed().as_secs()) " s so far: " } code { (now.words) }
                    @if let Some(line) = said.lines().last() { br; span class="quiet" { (line) } }
                }
            } @else if let Some(last) = &state.last {
                @let (class, word) = outcome(last.code);
                p { strong class=(class) { (word) } ", after " (last.took.as_secs()) " s: " code { (last.words) } }
                @match &last.job {
                    Job::Diagnose { product } if matches!(last.code, Some(0 | 4)) => {
                        p { a href={ "/missing?products=" (product) } { "See which effect is missing" } }
                    }
                    Job::CatchUp if !newest.is_empty() => {
                        p { "Open "
                            @for entry in newest.iter().rev().take(OFFERED) {
                                a href={ "/day/" (entry.row.id) } { (entry.row.day) } " " }
                        }
                    }
                    _ => {}
                }
                @if last.code != Some(0) && !last.said.is_empty() {
                    details { summary { "What it said" } pre class="command" tabindex="0" { (last.said) } }
                }
            }
        })
    }
}

/// A button that starts a job, where this server may, and the command that does the same.
pub(crate) fn button(site: &Site, links: &Links, job: &Job, label: &str) -> Markup {
    let starter = site.setup.starter.as_ref().and_then(|starter| starter(job));
    let (name, product) = match job {
        Job::CatchUp => ("catch-up", None),
        Job::Diagnose { product } => ("diagnose", Some(product)),
    };
    html! {
        @if links.allows_changes() && starter.is_some() {
            form class="start" data-job=(name) data-product=[product] {
                label { "Token, printed where the server was started " input class="token" type="password"
                    autocomplete="off" size="34"; }
                button type="submit" { (label) }
                span class="started" role="status" {}
            }
        }
        @match job {
            Job::CatchUp => (command("dragfree catch-up")),
            Job::Diagnose { product } => (command(&format!("dragfree diagnose {} --keep-extract{}",
                crate::layout::shell(product), site.setup.flags))),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn shell(text: &str) -> Command {
        let mut command = Command::new("sh");
        command.args(["-c", text]);
        command
    }

    fn wait(jobs: &Jobs) {
        let begun = Instant::now();
        while locked(&jobs.0).now.is_some() {
            assert!(begun.elapsed() < Duration::from_secs(20), "it does not end");
            std::thread::sleep(Duration::from_millis(5));
        }
    }

    #[test]
    fn one_command_runs_at_a_time_and_its_last_words_are_kept() {
        let jobs = Jobs::default();
        let long =
            "i=0; while [ $i -lt 900 ]; do echo line $i; i=$((i+1)); done; echo '<b>last</b>' >&2; sleep 0.2; exit 4";
        jobs.start(Job::CatchUp, shell(long)).expect("starts");
        let refused = jobs.start(Job::CatchUp, shell("true")).expect_err("one is under way").to_string();
        assert!(refused.contains("runs now"), "{refused}");
        wait(&jobs);
        {
            let state = locked(&jobs.0);
            let last = state.last.as_ref().expect("one has ended");
            assert_eq!((last.code, state.ended), (Some(4), 1));
            assert!(last.said.len() <= KEPT && last.said.contains("line 899") && last.said.contains("<b>last</b>"));
        }
        jobs.start(Job::CatchUp, shell("kill -9 $$")).expect("starts");
        wait(&jobs);
        assert_eq!(locked(&jobs.0).last.as_ref().expect("one has ended").code, None);
    }

    #[test]
    fn a_command_ends_with_the_pages() {
        let jobs = Jobs::default();
        jobs.start(Job::CatchUp, shell("exec sleep 60")).expect("starts");
        let id = locked(&jobs.0).now.as_ref().expect("under way").child.id();
        let begun = Instant::now();
        drop(jobs);
        let state = || std::fs::read_to_string(format!("/proc/{id}/stat")).unwrap_or_default();
        while state().contains("(sleep) S") {
            assert!(begun.elapsed() < Duration::from_secs(20), "it goes on");
            std::thread::sleep(Duration::from_millis(5));
        }
    }

    #[test]
    fn what_a_page_may_ask_for_is_known() {
        let read = |text: &str| serde_json::from_str::<Job>(text);
        assert_eq!(read(r#"{"job": "catch-up"}"#).expect("known"), Job::CatchUp);
        let product = "X".to_owned();
        assert_eq!(read(r#"{"job": "diagnose", "product": "X"}"#).expect("known"), Job::Diagnose { product });
        for wrong in [r#"{"job": "rm"}"#, r#"{"job": "diagnose"}"#, r#"{"job": ["catch-up"]}"#, "{}", "7"] {
            assert!(read(wrong).is_err(), "{wrong}");
        }
    }
}
