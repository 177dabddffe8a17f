//! Values of days over time.

use chrono::{Days, NaiveDate};
use dragfree_workflow::joint::Options;
use dragfree_workflow::trend::{Series, Trend, trend};
use dragfree_workflow::words::readable_unit;
use maud::{Markup, html};
use serde_json::{Value, json};

use crate::PagesError;
use crate::layout::{Links, command, data, page as whole, value};
use crate::site::{Query, Site};

/// Days shown unless the address says otherwise: the pages read every product of them.
const SHOWN: u64 = 120;

/// Most days shown.
const MOST: i64 = 1100;

const LEAD: &str = "Look for points outside of the shaded band, which is what the days before them predict (95 of 100 \
                    lie inside); a click on a point opens its day.";

pub(crate) fn page(site: &Site, query: &Query, links: &Links) -> Result<Markup, PagesError> {
    let archive = site.archive()?;
    let rows = archive.rows()?;
    let spacecraft: Vec<&str> = {
        let mut all: Vec<&str> = rows.iter().map(|row| row.spacecraft.as_str()).collect();
        all.dedup();
        all
    };
    let chosen = Some(query.spacecraft.as_str()).filter(|s| !s.is_empty()).or_else(|| spacecraft.first().copied());
    let days: Vec<NaiveDate> = rows
        .iter()
        .filter(|row| Some(row.spacecraft.as_str()) == chosen)
        .filter_map(|row| row.day.parse().ok())
        .collect();
    let Some(newest) = days.iter().max().copied() else {
        let body = html! { p { "No day has a product yet." } };
        return Ok(whole(links, "Trends", "Trends", LEAD, &body));
    };
    let day = |text: &str, what: &str| -> Result<Option<NaiveDate>, PagesError> {
        let refuse = |_| PagesError::Request(format!("{what}={text:?} is no day; one is written 2035-01-01"));
        if text.is_empty() { Ok(None) } else { text.parse().map(Some).map_err(refuse) }
    };
    let last = day(&query.until, "until")?.unwrap_or(newest);
    let first = day(&query.from, "from")?.or_else(|| last.checked_sub_days(Days::new(SHOWN - 1))).unwrap_or(last);
    let first = first.max(days.iter().min().copied().unwrap_or(first));
    if last < first || (last - first).num_days() > MOST {
        return Err(PagesError::Request(format!("{first} to {last} is no range of at most {MOST} days")));
    }
    let options = Options {
        first,
        last,
        spacecraft: chosen.map(str::to_owned),
        events: site.setup.events.clone(),
        steps: site.setup.steps.clone(),
        constant: false,
    };
    // A day that is not there yet is no alert of this page: the calendar tells how long nothing has come.
    let trend = trend(&archive, &options, newest)?;
    let body = html! {
        (range(&spacecraft, chosen, first, last))
        (alerts(&trend))
        (charts(&trend))
        (command(&format!("dragfree trend {first}..{last}{}", site.setup.flags)))
    };
    Ok(whole(links, "Trends", "Trends", LEAD, &body))
}

fn range(spacecraft: &[&str], chosen: Option<&str>, first: NaiveDate, last: NaiveDate) -> Markup {
    html! {
        form class="range" method="get" action="/trends" {
            label { "From " input type="date" name="from" value=(first); }
            label { "to " input type="date" name="until" value=(last); }
            @if spacecraft.len() > 1 {
                label { "of " select name="spacecraft" {
                    @for name in spacecraft { option selected[Some(*name) == chosen] { (name) } }
                } }
            }
            button { "Show" }
        }
    }
}

fn alerts(trend: &Trend) -> Markup {
    let product = |day: NaiveDate| trend.days.iter().find(|d| d.day == day).map(|d| d.product.as_str());
    html! {
        h2 { "Alerts" }
        @if trend.alerts.is_empty() { p { "None: every day lies where those before it predict, within its error." } }
        ul { @for alert in &trend.alerts { li {
            @match product(alert.day) {
                Some(id) => a href={ "/day/" (id) } { (alert.day) },
                None => (alert.day),
            }
            ": "
            @if let Some(name) = &alert.coefficient { code { (name) } ": " }
            (alert.what)
        } } }
    }
}

fn charts(trend: &Trend) -> Markup {
    let seconds = |day: NaiveDate| day.and_time(chrono::NaiveTime::MIN).and_utc().timestamp();
    let products: Vec<Value> = trend.days.iter().map(|d| json!([seconds(d.day), d.product])).collect();
    let event =
        |e: &dragfree_workflow::joint::Event| json!([e.time_ns / 1_000_000_000, format!("{} {}", e.kind, e.comments)]);
    let events: Vec<Value> = trend.events.iter().map(event).collect();
    let series: Vec<Value> = trend.coefficients.iter().map(|s| of_series(s, &seconds)).collect();
    html! {
        @for s in &trend.coefficients {
            @let last = s.points.last();
            section class="chart" {
                h2 { (s.name) @if !s.frame.is_empty() { " " span class="quiet" { (s.frame) } } }
                @if let Some(last) = last {
                    p { "Last, " (last.day) ": " strong { (value(last.measured.value, last.measured.sigma, &s.unit)) } }
                }
                div class="plot" data-series=(s.name) {}
            }
        }
        (data("trend", &json!({ "products": products, "events": events, "series": series })))
    }
}

/// A coefficient for the script of the page, in the unit that people read.
fn of_series(s: &Series, seconds: &dyn Fn(NaiveDate) -> i64) -> Value {
    let (unit, factor) = readable_unit(&s.unit);
    let of = |f: &dyn Fn(&dragfree_workflow::trend::Point) -> Option<f64>| -> Vec<Option<f64>> {
        s.points.iter().map(|p| f(p).map(|x| x * factor)).collect()
    };
    // Two σ of the difference between the day and its prediction: its own error and that of the prediction.
    let half = |p: &dragfree_workflow::trend::Point| Some(2.0 * p.predicted?.sigma.hypot(p.measured.sigma));
    json!({
        "name": s.name,
        "unit": unit,
        "time": s.points.iter().map(|p| seconds(p.day)).collect::<Vec<_>>(),
        "value": of(&|p| Some(p.measured.value)),
        "low": of(&|p| Some(p.measured.value - p.measured.sigma)),
        "high": of(&|p| Some(p.measured.value + p.measured.sigma)),
        "expected_low": of(&|p| Some(p.predicted?.value - half(p)?)),
        "expected_high": of(&|p| Some(p.predicted?.value + half(p)?)),
    })
}
