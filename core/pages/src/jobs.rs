//! Commands that a page starts, one at a time. Each is a program of its own: what fails there ends nothing here, and
//! its memory is not that of the pages.

use std::io::Read;
use std::process::{Child, Command, Stdio};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use dragfree_workflow::words::quoted;
use serde::Deserialize;

use crate::PagesError;

/// Bytes of what a command says that are kept: its last lines.
const KEPT: usize = 4000;

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
pub(crate) struct Jobs(pub(crate) Arc<Mutex<State>>);

#[derive(Default)]
pub(crate) struct State {
    pub(crate) now: Option<UnderWay>,
    pub(crate) last: Option<Ended>,
    /// How many have ended.
    pub(crate) ended: u64,
}

pub(crate) struct UnderWay {
    job: Job,
    pub(crate) words: String,
    pub(crate) began: Instant,
    child: Child,
    pub(crate) said: Arc<Mutex<Vec<u8>>>,
}

pub(crate) struct Ended {
    pub(crate) job: Job,
    pub(crate) words: String,
    pub(crate) took: Duration,
    /// Exit code; none where a signal ended it.
    pub(crate) code: Option<i32>,
    pub(crate) said: String,
}

pub(crate) fn locked<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
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

pub(crate) fn text(said: &Mutex<Vec<u8>>) -> String {
    String::from_utf8_lossy(&locked(said)).trim().to_owned()
}

impl Jobs {
    /// Starts a command.
    ///
    /// # Errors
    /// Another one is under way, or the program does not start.
    pub(crate) fn start(&self, job: Job, mut command: Command) -> Result<(), PagesError> {
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
        let long = "i=0; while [ $i -lt 900 ]; do echo line $i >&2; i=$((i+1)); done; echo '<b>last</b>' >&2; sleep 0.2; exit 4";
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
