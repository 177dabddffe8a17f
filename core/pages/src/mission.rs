//! The calendar of days.

use std::collections::BTreeMap;

use chrono::{DateTime, Datelike as _, NaiveDate};
use dragfree_archive::Row;
use maud::{Markup, html};

use crate::PagesError;
use crate::jobs::Job;
use crate::layout::{Links, command, page as whole};
use crate::site::{Query, Site};
use crate::starting::button;

/// Days that ask for attention are listed as far as this.
const LISTED: usize = 12;

/// What a day of the calendar shows.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum State {
    Good,
    Weak,
    Lost,
    Bad,
    Withdrawn,
    None,
}

impl State {
    const ALL: [Self; 6] = [Self::Good, Self::Weak, Self::Lost, Self::Bad, Self::Withdrawn, Self::None];

    /// Of all products of a day, by the newest that is of use.
    fn of(rows: &[&Row]) -> Self {
        let Some(row) = shown(rows) else { return Self::None };
        let verdict = row.verdict.as_deref();
        match () {
            () if row.withdrawn.is_some() => Self::Withdrawn,
            () if row.problem.is_some() || verdict == Some("disagree") || row.inconsistent == Some(true) => Self::Bad,
            () if row.data_loss == Some(true) => Self::Lost,
            () if verdict == Some("agree") => Self::Good,
            () => Self::Weak,
        }
    }

    /// A sign beside the colour, for those who see no colours.
    fn sign(self) -> &'static str {
        match self {
            Self::Good => "✓",
            Self::Weak => "~",
            Self::Lost => "!",
            Self::Bad => "✗",
            Self::Withdrawn => "−",
            Self::None => "·",
        }
    }

    fn class(self) -> &'static str {
        match self {
            Self::Good => "good",
            Self::Weak => "weak",
            Self::Lost => "lost",
            Self::Bad => "bad",
            Self::Withdrawn => "withdrawn",
            Self::None => "none",
        }
    }

    fn words(self) -> &'static str {
        match self {
            Self::Good => "nothing speaks against the model",
            Self::Weak => "the data determine the offset weakly, or nothing was compared",
            Self::Lost => "data were lost",
            Self::Bad => "the model contradicts the data",
            Self::Withdrawn => "withdrawn",
            Self::None => "no product",
        }
    }
}

/// The product of a day that counts: the newest that holds, or else the newest.
fn shown<'a>(rows: &[&'a Row]) -> Option<&'a Row> {
    let tests = |row: &&&Row| row.fixed_from.is_none();
    let holds = rows.iter().filter(tests).rfind(|row| row.latest);
    holds.or_else(|| rows.iter().rfind(tests)).or_else(|| rows.last()).copied()
}

type Days<'a> = BTreeMap<NaiveDate, Vec<&'a Row>>;

pub(crate) fn page(site: &Site, _query: &Query, links: &Links) -> Result<Markup, PagesError> {
    let rows = site.archive()?.rows()?;
    let mut series: BTreeMap<(&str, &str), Days<'_>> = BTreeMap::new();
    for row in &rows {
        if let Ok(day) = row.day.parse() {
            series.entry((&row.spacecraft, &row.name)).or_default().entry(day).or_default().push(row);
        }
    }
    let body = html! {
        @if series.is_empty() {
            p { "The archive " code { (site.setup.archive.display()) } " has no product yet. This makes one:" }
            (command(&format!("dragfree run PIPELINE.toml FILE.mcap{}", site.setup.flags)))
            p { "Or put telemetry into the inbox that mission-ops.toml names, and run what is due:" }
        }
        @for ((spacecraft, name), days) in &series { (of_series(site, spacecraft, name, days)) }
        h2 { "What runs, and what is due" }
        div id="running" aria-live="polite" data-reload="" { (running(site)?) }
        p { "Every day that has no product, or one that would come out otherwise now, is calibrated by:" }
        (button(site, links, &Job::CatchUp, "Run what is due"))
        p { "These commands say which days these are, and wait for new telemetry:" }
        (command("dragfree products stale\ndragfree watch"))
    };
    let lead = "Look for days with ✗ or ! and open them; on a day with ✓ the two solutions agree, and its page says \
        whether to use it.";
    Ok(whole(links, "Mission", "Mission", lead, &body))
}

/// The calibrations that are under way: the part of the page that is asked for again.
pub(crate) fn running(site: &Site) -> Result<Markup, PagesError> {
    let all = site.archive()?.running();
    Ok(html! {
        @if all.is_empty() && !site.runs() { p { "Nothing runs now." } }
        (site.job()?)
        @for job in &all {
            @let until = DateTime::from_timestamp_nanos(job.until_ns).format("%Y-%m-%d %H:%M:%S");
            p {
                strong { (job.what) } " has come to " (until) ", " (format!("{:.0}", job.rate())) " times as fast as the data"
                @if let Some((part, left_s)) = job.left() {
                    ": " (format!("{:.0}", 100.0 * part)) " %, " (format!("{left_s:.0}")) " s left. "
                    progress max="100" value=(format!("{:.0}", 100.0 * part)) aria-label={ "Part of " (job.what) } {}
                } @else { "." }
                span class="quiet" { " Process " (job.process) }
            }
        }
    })
}

fn of_series(site: &Site, spacecraft: &str, name: &str, days: &Days<'_>) -> Markup {
    let (first, last) = match (days.keys().next(), days.keys().last()) {
        (Some(first), Some(last)) => (*first, *last),
        _ => return html! {},
    };
    let mut counts: BTreeMap<State, usize> = BTreeMap::new();
    for day in first.iter_days().take_while(|day| *day <= last) {
        *counts.entry(days.get(&day).map_or(State::None, |rows| State::of(rows))).or_default() += 1;
    }
    let bad = |state: State| matches!(state, State::Bad | State::Lost | State::Withdrawn);
    let attention: Vec<(&NaiveDate, State, &Row)> = days
        .iter()
        .rev()
        .filter_map(|(day, rows)| Some((day, State::of(rows), shown(rows)?)))
        .filter(|(_, state, _)| bad(*state))
        .collect();
    let quiet = (site.setup.today)().signed_duration_since(last).num_days();
    html! {
        h2 { (spacecraft) " · " (name) }
        p {
            (days.len()) " days from " (first) " to " (last) ". "
            @if quiet == 1 { "The last one is of yesterday. " }
            @if quiet > 1 { "Nothing has come for " (quiet) " days. " }
        }
        ul class="legend" {
            @for state in State::ALL {
                @if let Some(count) = counts.get(&state) {
                    li { span class={ "day " (state.class()) } { (state.sign()) } " " (state.words()) ": " (count) }
                }
            }
        }
        @if !attention.is_empty() {
            h3 { "Asks for attention" }
            ul {
                @for (day, state, row) in attention.iter().take(LISTED) {
                    li {
                        a href={ "/day/" (row.id) } { (day) } ": " (state.words())
                        @if let Some(reason) = row.withdrawn.as_ref().or(row.problem.as_ref()) { ": " (reason) }
                    }
                }
                @if attention.len() > LISTED { li { "and " (attention.len() - LISTED) " earlier ones" } }
            }
        }
        h3 { "Calendar" }
        div class="calendar" {
            @for (year, month) in months(first, last).into_iter().rev() { (of_month(year, month, days)) }
        }
    }
}

/// Months from that of `first` to that of `last`.
fn months(first: NaiveDate, last: NaiveDate) -> Vec<(i32, u32)> {
    let number = |day: NaiveDate| day.year() * 12 + i32::try_from(day.month0()).unwrap_or(0);
    let of = |n: i32| (n.div_euclid(12), u32::try_from(n.rem_euclid(12) + 1).unwrap_or(1));
    (number(first)..=number(last)).map(of).collect()
}

fn of_month(year: i32, month: u32, days: &Days<'_>) -> Markup {
    let Some(first) = NaiveDate::from_ymd_opt(year, month, 1) else { return html! {} };
    let all = first.iter_days().take_while(|day| day.month() == month);
    html! {
        section class="month" aria-label={ (year) "-" (format!("{month:02}")) } {
            h4 { (year) "-" (format!("{month:02}")) }
            div class="days" {
                @for _ in 0..first.weekday().num_days_from_monday() { span {} }
                @for day in all { (of_day(day, days.get(&day).map_or(&[], Vec::as_slice))) }
            }
        }
    }
}

fn of_day(day: NaiveDate, rows: &[&Row]) -> Markup {
    let state = State::of(rows);
    match shown(rows) {
        Some(row) => html! {
            a class={ "day " (state.class()) } href={ "/day/" (row.id) } title={ (day) ": " (state.words()) } {
                (state.sign()) span class="hidden" { (day) }
            }
        },
        None => html! { span class="day none" title={ (day) ": no product" } { "·" } },
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn months_go_over_the_turn_of_a_year() {
        let day = |text: &str| text.parse::<NaiveDate>().expect("a day");
        assert_eq!(months(day("2034-11-30"), day("2035-02-01")), [(2034, 11), (2034, 12), (2035, 1), (2035, 2)]);
        assert_eq!(months(day("2035-02-01"), day("2035-02-28")), [(2035, 2)]);
    }
}
