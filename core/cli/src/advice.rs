//! The screen of `diagnose --next`.

use chrono::DateTime;
use dragfree_workflow::next::{Advice, Expected, Hour, LimitAdvice, Next, OfArchive, Planned};
use dragfree_workflow::words::after_a_number;
use std::fmt::Write as _;

use crate::text::labelled;

/// What would tell more.
pub(crate) fn screen(next: &Next) -> String {
    let mut out = String::new();
    if next.separations.is_empty() && next.limits.is_empty() {
        let text = "nothing that is named needs to be told from anything else, and no limit is wide";
        return format!("\n{}", labelled("more", text));
    }
    if let Some(reason) = &next.no_manoeuvre {
        out += &format!("\n{}", labelled("more", &format!("no manoeuvre is planned: {reason}")));
    }
    for advice in &next.separations {
        separation(&mut out, advice, next);
    }
    for advice in &next.limits {
        limit(&mut out, advice, next);
    }
    out
}

/// A line below a heading.
fn line(label: &str, words: &str) -> String {
    labelled(&format!("  {label:<9}"), words)
}

fn separation(out: &mut String, a: &Advice, next: &Next) {
    let _ = writeln!(out, "\nWhat would tell {} from {}", a.effect, a.from);
    *out += &line("now", &format!("{:.1}σ expected of data like these", a.now_sigma));
    match &a.data {
        Some(data) if data.times > 1.0 => {
            let length = format!("{:.1} times these data, {:.1} h, tell them apart at 5σ", data.times, data.hours);
            *out += &line("data", &length);
            data.coefficients.iter().for_each(|c| coefficient(out, c, "then"));
        }
        Some(_) => *out += &line("data", "as much again: these should have told them apart at 5σ, on average"),
        None => *out += &line("data", "no length of such data: a test on the ground, or a manoeuvre"),
    }
    *out += &line("archive", &archive(&a.archive));
    if let Some(text) = hours(&a.hours) {
        *out += &line("hours", &text);
    }
    manoeuvre(out, a.manoeuvre.as_ref(), next);
}

fn limit(out: &mut String, a: &LimitAdvice, next: &Next) {
    let _ = writeln!(out, "\nWhat would limit {}", a.effect);
    let text = format!("σ {:.1e} of {}, which may be {:.1e}", a.sigma_now, a.coefficient, a.largest);
    *out += &line("now", &text);
    manoeuvre(out, a.manoeuvre.as_ref(), next);
}

fn coefficient(out: &mut String, c: &Expected, then: &str) {
    let unit = after_a_number(&c.unit);
    let text = format!("{} ± {:.1e}{unit} now, ± {:.1e}{unit} {then}", c.name, c.sigma_now, c.sigma_expected);
    *out += &line("", &text);
}

fn archive(a: &OfArchive) -> String {
    let count = a.products.len();
    if count == 0 {
        return "no other product of this spacecraft and model whose inputs are at hand".to_owned();
    }
    let names = if count <= 3 { a.products.join(", ") } else { format!("{} and {} more", a.products[0], count - 1) };
    let enough = if a.enough { "" } else { ", not enough" };
    format!("{:.1}σ with {names} ({:.1} h) if they tell as much an hour{enough}", a.expected_sigma, a.hours)
}

/// In which hours most of the separation lies; nothing where there are few.
fn hours(all: &[Hour]) -> Option<String> {
    let total: f64 = all.iter().map(|hour| hour.chi2).sum();
    let mut sorted: Vec<&Hour> = all.iter().collect();
    sorted.sort_by(|a, b| b.chi2.total_cmp(&a.chi2));
    let first = sorted.first().filter(|_| all.len() > 2 && total > 0.0)?;
    let sums = sorted.iter().scan(0.0, |sum, hour| {
        *sum += hour.chi2;
        Some(*sum)
    });
    let half = 1 + sums.take_while(|sum| *sum < 0.5 * total).count();
    let at = DateTime::from_timestamp_nanos(first.from_ns).format("%Y-%m-%dT%H:%MZ");
    let most = 100.0 * first.chi2 / total;
    Some(format!("half of it lies in {half} of {} hours, {most:.0} % in that from {at} on", all.len()))
}

fn manoeuvre(out: &mut String, planned: Option<&Planned>, next: &Next) {
    if next.no_manoeuvre.is_some() {
        return;
    }
    let authority = 100.0 * next.authority;
    let Some(p) = planned else {
        let text = format!("none with {authority:.0} % of the authority within half a run of {:.1} h", next.run_hours);
        *out += &line("manoeuvre", &text);
        return;
    };
    let text = format!(
        "{} with {:.1e} {} at {} Hz for {:.0} s: {:.0}σ expected in a run of {:.1} h; at most {authority:.0} % of what \
         actuators and readouts allow",
        p.input, p.amplitude, p.unit, p.frequency_hz, p.duration_s, p.expected_sigma, next.run_hours
    );
    *out += &line("manoeuvre", &text);
    p.coefficients.iter().for_each(|c| coefficient(out, c, "with it"));
    *out += &line("", &format!("dragfree simulate … {}", p.simulate));
}
