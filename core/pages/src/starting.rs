//! What pages show of the commands that they start, and the buttons that start them.

use maud::{Markup, html};

use crate::PagesError;
use crate::jobs::{Ended, Job, locked, text};
use crate::layout::{Links, command, shell};
use crate::site::Site;

/// Products that are offered when days have been run.
const OFFERED: usize = 4;

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
                shell(product), site.setup.flags))),
        }
    }
}
