//! `dragfree joint` and `dragfree trend`.

use super::{Done, INCONSISTENT, SOFTWARE, products};
use crate::args::{Days, Joint as JointCommand, Trend as TrendCommand};
use crate::failure::Failure;
use crate::text::{self, Paint};
use dragfree_archive::files::IoContext as _;
use dragfree_chart::{Line, Panel, Scale, Stroke};
use dragfree_workflow::joint::{self as workflow, Changed, Coefficient, Joint, Measured, Options};
use dragfree_workflow::trend::{self, Series, Trend};
use serde_json::json;
use std::fmt::Write as _;
use std::time::SystemTime;

/// A second as days have them.
const DAY_S: f64 = 86_400.0;

/// What the days are asked for with: events and their effects as the mission's file of operations has them, where the
/// command line does not say.
fn options(days: &Days) -> Result<Options, Failure> {
    let operations = days.archive.operations()?;
    let mut options = Options {
        first: days.days.0,
        last: days.days.1,
        spacecraft: days.spacecraft.clone(),
        events: days.events.clone(),
        steps: days.steps.clone(),
        constant: false,
    };
    if let Some(operations) = operations {
        options.events = options.events.or(operations.events);
        let more = operations.steps.into_iter().filter(|step| !options.steps.contains(step)).collect::<Vec<_>>();
        options.steps.extend(more);
    }
    Ok(options)
}

pub(super) fn joint(command: &JointCommand, json: bool, paint: Paint) -> Result<Done, Failure> {
    let archive = products::archive(&command.days.archive.folder()?)?;
    let asked = Options { constant: command.constant, ..options(&command.days)? };
    let joint = workflow::joint(&archive, &asked)?;
    let (mut id, mut new) = (None, false);
    if !command.dry_run {
        let (written, is_new) = workflow::archived(&archive, &joint, SystemTime::now().into(), SOFTWARE)?;
        (id, new) = (Some(written.product.id().to_owned()), is_new);
    }
    let code = if joint.agrees() { 0 } else { INCONSISTENT };
    if json {
        let mut value = serde_json::to_value(&joint)?;
        (value["product"], value["new"]) = (json!(id), json!(new));
        return Ok(Done { code, ..Done::json(&value) });
    }
    let mut text = String::new();
    if let Some(id) = id {
        let _ = writeln!(text, "product   {}{}", paint.bold(&id), if new { "" } else { ", which is there already" });
    }
    text += &screen(&joint, paint);
    Ok(Done { text, code })
}

fn screen(joint: &Joint, paint: Paint) -> String {
    let mut text = String::new();
    let days = format!("{} days of {} from {} to {}", joint.days.len(), joint.spacecraft, joint.first, joint.last);
    text += &text::labelled("days", &days);
    let few = |all: &[String]| match all {
        [all @ .., last] if all.len() >= 6 => format!("{} … {last} ({} days)", all[..3].join(", "), all.len() + 1),
        all => all.join(", "),
    };
    if !joint.missing.is_empty() {
        let all: Vec<String> = joint.missing.iter().map(ToString::to_string).collect();
        text += &text::labelled("missing", &few(&all));
    }
    for left in &joint.left_out {
        text += &text::labelled("left out", &format!("{}: {}", left.product, left.reason));
    }
    for event in &joint.events {
        let stated: Vec<String> = event.data.iter().map(|(k, v)| format!("{k} {v}")).collect();
        let words = [format!("{} at {}", event.kind, event.time), event.comments.clone(), stated.join(", ")];
        let words: Vec<String> = words.into_iter().filter(|w| !w.is_empty()).collect();
        text += &text::labelled("event", &words.join("; "));
    }
    let _ = writeln!(text, "\nat {}, the end of the data:", crate::utc::format(joint.epoch_ns));
    let rows = joint.coefficients.iter().flat_map(rows);
    text += &text::columns(&text::table(&["coefficient", "value", "unit", ""], rows));
    let same = joint.same;
    let word = if joint.agrees() { paint.good("yes") } else { paint.bad("no") };
    let words = match same.dof {
        0 => "nothing to compare".to_owned(),
        dof => format!("{word}: χ² {:.1} on {dof} degrees of freedom, p = {:.2e}", same.chi2, same.p),
    };
    let _ = writeln!(text, "\nthe same every day  {words}");
    if !joint.agrees() {
        let mut worst: Vec<_> = joint.days.iter().collect();
        worst.sort_by(|a, b| a.agreement.p.total_cmp(&b.agreement.p));
        for day in worst.iter().take(3) {
            let words = format!("{}: χ² {:.1} on {}", day.product, day.agreement.chi2, day.agreement.dof);
            text += &text::labelled("differs", &words);
        }
    }
    for sentence in &joint.weak {
        text += &text::labelled("weak", sentence);
    }
    for note in &joint.notes {
        text += &text::labelled("note", note);
    }
    text
}

/// A coefficient with its changes.
fn rows(c: &Coefficient) -> Vec<Vec<String>> {
    let (unit, factor) = text::readable_unit(&c.unit);
    let measured = |m: Measured, factor: f64| text::measured(m.value * factor, m.sigma * factor);
    let own = Measured { value: c.value, sigma: c.sigma };
    let mut rows = vec![vec![c.name.clone(), measured(own, factor), unit.to_owned(), String::new()]];
    let mut add = |name: String, changed: Changed, unit: String, factor: f64| {
        let seen = if changed.seen { "seen" } else { "not seen" };
        rows.push(vec![name, measured(changed.size, factor), unit, seen.to_owned()]);
    };
    if let Some(rate) = c.rate {
        add("  rate".to_owned(), rate, format!("{unit}/d"), factor * DAY_S);
    }
    for step in &c.steps {
        let name = match &step.events[..] {
            [one] => format!("  step {one}"),
            several => format!("  step {} +{}", several.first().map_or("", String::as_str), several.len() - 1),
        };
        add(name, step.changed, unit.to_owned(), factor);
    }
    rows
}

pub(super) fn trend(command: &TrendCommand, json: bool, paint: Paint) -> Result<Done, Failure> {
    let archive = products::archive(&command.days.archive.folder()?)?;
    let trend = trend::trend(&archive, &options(&command.days)?, super::stamp().time.date_naive())?;
    if let Some(path) = &command.csv {
        std::fs::write(path, csv(&trend)).at("write", path)?;
    }
    if let Some(path) = &command.picture {
        std::fs::write(path, picture(&trend)?).at("write", path)?;
    }
    let code = if trend.alerts.is_empty() { 0 } else { INCONSISTENT };
    if json {
        return Ok(Done { code, ..Done::json(&serde_json::to_value(&trend)?) });
    }
    let (Some(first), Some(last)) = (trend.days.first(), trend.days.last()) else {
        return Ok(Done::new(String::new()));
    };
    let days = format!("{} days of {} from {} to {}", trend.days.len(), trend.spacecraft, first.day, last.day);
    let mut text = text::labelled("days", &days);
    let row = |series: &Series| {
        let (unit, factor) = text::readable_unit(&series.unit);
        let last = series.points.last();
        let told = |m: Option<Measured>| {
            m.map_or_else(|| "-".to_owned(), |m| text::measured(m.value * factor, m.sigma * factor))
        };
        vec![
            series.name.clone(),
            told(last.map(|p| p.measured)),
            told(last.and_then(|p| p.predicted)),
            unit.to_owned(),
            last.and_then(|p| p.sigmas).map_or_else(|| "-".to_owned(), |s| format!("{s:+.1} σ")),
        ]
    };
    let _ = writeln!(text, "\n{}:", last.day);
    let heading = ["coefficient", "value", "predicted", "unit", "difference"];
    text += &text::columns(&text::table(&heading, trend.coefficients.iter().map(row)));
    text.push('\n');
    for alert in &trend.alerts {
        let of = alert.coefficient.as_ref().map_or_else(String::new, |c| format!("{c} "));
        text += &text::labelled("alert", &format!("{} {of}{}", alert.day, alert.what));
    }
    let rate = format!("one false alarm in {:.0} days at most", 1.0 / trend.false_alarm_per_day);
    let word = if trend.alerts.is_empty() { paint.good("none") } else { paint.bad(&trend.alerts.len().to_string()) };
    let _ = writeln!(text, "alerts    {word}; {rate}");
    Ok(Done { text, code })
}

/// One row for each coefficient of each day.
fn csv(trend: &Trend) -> String {
    let mut text =
        "day,product,verdict,coefficient,unit,frame,value,sigma,predicted,predicted_sigma,sigmas\n".to_owned();
    for series in &trend.coefficients {
        for point in &series.points {
            let of_day = trend.days.iter().find(|day| day.day == point.day);
            let number = |x: Option<f64>| x.map_or_else(String::new, |x| format!("{x:e}"));
            let _ = writeln!(
                text,
                "{},{},{},{},{},{},{:e},{:e},{},{},{}",
                point.day,
                of_day.map_or("", |day| day.product.as_str()),
                of_day.and_then(|day| day.verdict.as_deref()).unwrap_or_default(),
                series.name,
                series.unit,
                series.frame,
                point.measured.value,
                point.measured.sigma,
                number(point.predicted.map(|p| p.value)),
                number(point.predicted.map(|p| p.sigma)),
                number(point.sigmas),
            );
        }
    }
    text
}

/// A panel for each coefficient: values with one σ on either side, what was predicted, and events.
fn picture(trend: &Trend) -> Result<String, Failure> {
    let first = trend.days.first().map(|day| day.day).unwrap_or_default();
    let days = |day: chrono::NaiveDate| (day - first).num_days() as f64;
    let last = trend.days.last().map_or(0.0, |day| days(day.day));
    let panel = |series: &Series| {
        let (unit, factor) = text::readable_unit(&series.unit);
        let with = |k: f64| {
            series.points.iter().map(move |p| (days(p.day), (p.measured.value + k * p.measured.sigma) * factor))
        };
        let band: Vec<(f64, f64)> = with(1.0).chain(with(-1.0).collect::<Vec<_>>().into_iter().rev()).collect();
        // A line ends where a day has no prediction, as after an event.
        let stretches = series.points.split(|p| p.predicted.is_none()).filter(|stretch| !stretch.is_empty());
        let predicted = stretches.map(|stretch| {
            stretch.iter().filter_map(|p| Some((days(p.day), p.predicted?.value * factor))).collect::<Vec<_>>()
        });
        let all: Vec<f64> = band.iter().map(|(_, y)| *y).collect();
        let (low, high) = all.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), y| (a.min(*y), b.max(*y)));
        let mut lines =
            vec![Line::new("value ± σ", 0, Stroke::Area, band), Line::new("", 0, Stroke::Solid, with(0.0).collect())];
        for (number, stretch) in predicted.enumerate() {
            let label = if number == 0 { "predicted" } else { "" };
            lines.push(Line::new(label, 1, Stroke::Dashed, stretch));
        }
        let margin = 0.05 * (high - low).max(f64::MIN_POSITIVE);
        let events = trend.events.iter().filter(|e| e.changes(&series.name));
        for (number, event) in events.enumerate() {
            let at = event.time_ns as f64 / 8.64e13 - days_since_1970(first);
            let label = if number == 0 { "event" } else { "" };
            lines.push(Line::new(label, 6, Stroke::Solid, vec![(at, low - margin), (at, high + margin)]));
        }
        Panel {
            title: series.name.clone(),
            x_label: format!("days since {first}"),
            y_label: format!("value / {unit}"),
            x_scale: Scale::Linear,
            y_scale: Scale::Linear,
            x: -0.5..last + 0.5,
            y: Some(low - margin..high + margin),
            lines,
        }
    };
    let panels: Vec<Panel> = trend.coefficients.iter().map(panel).collect();
    Ok(dragfree_chart::svg(&panels, 2)?)
}

fn days_since_1970(day: chrono::NaiveDate) -> f64 {
    (day - chrono::NaiveDate::default()).num_days() as f64
}
