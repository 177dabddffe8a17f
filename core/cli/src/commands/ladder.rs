//! `dragfree ladder`.

use super::{Done, products};
use crate::args::Ladder as Arguments;
use crate::failure::Failure;
use crate::text::{self, Paint, columns, distinct, labelled, table};
use crate::truth;
use dragfree_archive::Written;
use dragfree_archive::files::IoContext as _;
use dragfree_archive::product::Product;
use dragfree_chart::{Line, Panel, Scale, Stroke, svg};
use dragfree_workflow::ladder::{Fall, Fit, Ladder, Rung, Value, Verdict, Window, declared_log_determinant, ladder};
use std::path::Path;

pub(super) fn execute(command: &Arguments, json: bool, paint: Paint) -> Result<Done, Failure> {
    let open = |names: &[String]| -> Result<Vec<Written>, Failure> {
        names.iter().map(|name| products::open(name, &command.archive.folder()?)).collect()
    };
    let (fitted, held_out) = (open(&command.products)?, open(&command.held_out)?);
    let declared = |product: &Product| {
        let written = fitted.iter().chain(&held_out).find(|w| w.product.digest() == product.digest());
        written.and_then(declared_log_determinant)
    };
    let products = |of: &[Written]| of.iter().map(|w| w.product.clone()).collect::<Vec<_>>();
    let truth = command.truth.as_deref().map(truth::first).transpose()?.unwrap_or_default();
    let truth = |name: &str| dragfree_score::offset(&truth, name);
    let ladder = ladder(&products(&fitted), &products(&held_out), &truth, &declared)?;
    if let Some(path) = &command.picture {
        let picture = svg(&panels(&ladder), 2)?;
        std::fs::write(path, picture).at("write", path)?;
    }
    if json {
        return Ok(Done::json(&serde_json::json!(ladder)));
    }
    Ok(Done::new(screen(&ladder, command.picture.as_deref(), paint)))
}

fn screen(ladder: &Ladder, picture: Option<&Path>, paint: Paint) -> String {
    let mut screen = labelled("fit", &days(&ladder.days));
    let held_out = ladder.revisions.iter().filter_map(|r| r.held_out.as_ref());
    let held: Vec<Window> = distinct(held_out.flat_map(|h| h.days.iter().cloned()));
    if !held.is_empty() {
        screen += &labelled("held out", &days(&held));
    }
    screen.push('\n');
    screen += &steps(ladder);
    screen.push('\n');
    screen += &kept_out(ladder);
    for rung in &ladder.revisions {
        let signed = |sign: &str, names: &[String]| names.iter().map(|n| format!("{sign} {n}")).collect::<Vec<_>>();
        let (added, removed) = (signed("+", &rung.added), signed("−", &rung.removed));
        let words = match &rung.compared_with {
            None => rung.effects.join(", "),
            Some(_) if added.is_empty() && removed.is_empty() => "the same effects".to_owned(),
            Some(_) => [added, removed].concat().join(", "),
        };
        let from = match &rung.compared_with {
            Some(other) if rung.parent.as_ref() != Some(other) => format!(" (from {other})"),
            _ => String::new(),
        };
        screen += &labelled(&format!("{} ", rung.revision), &format!("{words}{from}"));
    }
    screen.push('\n');
    screen += &channels(ladder);
    screen.push('\n');
    screen += &coefficients(ladder);
    for rung in ladder.revisions.iter().filter(|r| r.held_out.as_ref().is_some_and(|h| h.verdict.is_some())) {
        let Some((verdict, fall)) = rung.held_out.as_ref().and_then(|h| Some((h.verdict?, h.fall?))) else { continue };
        let what = rung.added.join(", ");
        let (painted, sentence) = match verdict {
            Verdict::Helps => {
                (paint.good("helps"), format!("{what} lowers χ² by {} on days that it was not fitted to", figure(fall)))
            }
            Verdict::OverFitted => (
                paint.bad("over-fitted"),
                format!(
                    "{what} raises χ² by {} on days that it was not fitted to; take it out with `dragfree model remove`",
                    figure(Fall { delta_chi2: -fall.delta_chi2, ..fall })
                ),
            ),
            Verdict::Undecided => (
                paint.doubtful("undecided"),
                format!("{what} changes χ² by {}, no more than other epochs may", figure(fall)),
            ),
        };
        let sentence = format!("{}: {sentence}", word(verdict));
        screen += &labelled(&format!("{} ", rung.revision), &sentence).replacen(word(verdict), &painted, 1);
    }
    for note in &ladder.notes {
        screen += &labelled("note", note);
    }
    if let Some(picture) = picture {
        screen += &format!("picture   {}\n", picture.display());
    }
    screen
}

fn days(windows: &[Window]) -> String {
    let mut days: Vec<&str> = windows.iter().map(|w| w.day.as_str()).collect();
    days.dedup();
    let words = match days[..] {
        [first, _, .., last] => format!("{first} … {last}"),
        _ => days.join(", "),
    };
    let hours = windows.iter().map(|w| (w.stop_ns - w.start_ns) as f64 / 3600e9).sum::<f64>();
    format!("{words}, {hours:.1} h")
}

/// `4175`, or with what other epochs may change of it.
fn figure(fall: Fall) -> String {
    let digits = |x: f64| if x.abs() < 100.0 { format!("{x:.1}") } else { format!("{x:.0}") };
    if fall.uncertainty > 0.0 {
        format!("{} ± {}", digits(fall.delta_chi2), digits(fall.uncertainty))
    } else {
        digits(fall.delta_chi2)
    }
}

fn ratio(x: f64) -> String {
    if x.is_finite() { format!("{x:.4}") } else { "-".to_owned() }
}

/// One row a revision.
fn steps(ladder: &Ladder) -> String {
    let row = |rung: &Rung| figures(&rung.revision, &rung.fit, rung.fall);
    let heading = ["revision", "χ²", "χ²/dof", "rms", "NIS", "χ² falls by"];
    columns(&table(&heading, ladder.revisions.iter().map(row))) + &nees(ladder)
}

/// A column a solution, where truth is known.
fn nees(ladder: &Ladder) -> String {
    let solutions = distinct(ladder.revisions.iter().flat_map(|r| &r.nees).map(|n| n.solution.as_str()));
    if solutions.is_empty() {
        return String::new();
    }
    let heading = std::iter::once("NEES/dof").chain(solutions.iter().copied()).map(str::to_owned).collect();
    let row = |rung: &Rung| {
        let of = |solution: &&str| {
            let found = rung.nees.iter().find(|n| n.solution == *solution);
            found.map_or_else(|| "-".to_owned(), |n| format!("{:.2} ({})", n.per_dof, n.dof))
        };
        std::iter::once(rung.revision.clone()).chain(solutions.iter().map(of)).collect()
    };
    let rows: Vec<Vec<String>> = std::iter::once(heading).chain(ladder.revisions.iter().map(row)).collect();
    format!("\n{}", columns(&rows))
}

fn figures(revision: &str, fit: &Fit, fall: Option<Fall>) -> Vec<String> {
    let fall = fall.map_or_else(|| "-".to_owned(), figure);
    vec![revision.to_owned(), format!("{:.0}", fit.chi2), ratio(fit.chi2_per_dof), ratio(fit.rms), ratio(fit.nis), fall]
}

fn word(verdict: Verdict) -> &'static str {
    match verdict {
        Verdict::Helps => "helps",
        Verdict::OverFitted => "over-fitted",
        Verdict::Undecided => "undecided",
    }
}

/// The same on the days kept out.
fn kept_out(ladder: &Ladder) -> String {
    let heading = ["held out", "χ²", "χ²/dof", "rms", "NIS", "χ² falls by", ""];
    let row = |rung: &Rung| {
        let held = rung.held_out.as_ref()?;
        let verdict = held.verdict.map_or("", word).to_owned();
        Some([figures(&rung.revision, &held.fit, held.fall), vec![verdict]].concat())
    };
    let rows = table(&heading, ladder.revisions.iter().filter_map(row));
    if rows.len() > 1 { columns(&rows) + "\n" } else { String::new() }
}

fn channel_names(ladder: &Ladder) -> Vec<&str> {
    distinct(ladder.revisions.iter().flat_map(|r| &r.fit.channels).map(|c| c.channel.as_str()))
}

/// χ²/dof of each channel, a column a channel.
fn channels(ladder: &Ladder) -> String {
    let names = channel_names(ladder);
    if names.is_empty() {
        return "no stage weighed the channels one by one\n".to_owned();
    }
    // The channel's middle word says only what kind it is.
    let short = |name: &str| match name.split('.').collect::<Vec<_>>()[..] {
        [body, _, axis] => format!("{body}.{axis}"),
        _ => name.to_owned(),
    };
    let heading = std::iter::once("χ²/dof".to_owned()).chain(names.iter().map(|n| short(n))).collect();
    let row = |rung: &Rung| {
        let of = |name: &&str| {
            let channel = rung.fit.channels.iter().find(|c| c.channel == *name);
            channel.map_or_else(
                || "-".to_owned(),
                |c| format!("{:.*}", if c.chi2_per_dof < 10.0 { 3 } else { 1 }, c.chi2_per_dof),
            )
        };
        std::iter::once(rung.revision.clone()).chain(names.iter().map(of)).collect()
    };
    let rows: Vec<Vec<String>> = std::iter::once(heading).chain(ladder.revisions.iter().map(row)).collect();
    columns(&rows)
}

/// Coefficients in the order in which revisions bring them.
fn names(ladder: &Ladder) -> Vec<&str> {
    distinct(ladder.revisions.iter().flat_map(|r| &r.coefficients).map(|c| c.name.as_str()))
}

/// A block a coefficient, a row a revision.
fn coefficients(ladder: &Ladder) -> String {
    let cell = |value: &Value| {
        let (unit, factor) = text::readable_unit(&value.unit);
        let place = format!("{unit} {}", value.frame).trim().to_owned();
        let change = value.change_sigmas.map_or_else(|| "-".to_owned(), |c| format!("{c:+.1} σ"));
        let mut cells = vec![text::measured(value.value * factor, value.sigma * factor), place, change];
        if let (Some(error), Some(sigmas)) = (value.error, value.error_sigmas) {
            let digits = text::measured(error * factor, value.sigma * factor);
            let error = digits.split(" ±").next().unwrap_or_default();
            cells.push(format!("{error}, {:.1} σ", sigmas.abs()));
        }
        cells
    };
    let mut rows = table(&["coefficient", "value", "", "change"], []);
    if ladder.revisions.iter().flat_map(|r| &r.coefficients).any(|c| c.error.is_some()) {
        rows[0].push("true error".to_owned());
    }
    for name in names(ladder) {
        let several = ladder.revisions.len() > 1;
        if several {
            rows.push(vec![name.to_owned()]);
        }
        for rung in &ladder.revisions {
            let Some(value) = rung.coefficients.iter().find(|c| c.name == name) else { continue };
            let first = if several { format!("  {}", rung.revision) } else { name.to_owned() };
            rows.push(std::iter::once(first).chain(cell(value)).collect());
        }
    }
    if rows.len() == 1 {
        return "no revision estimates a coefficient\n".to_owned();
    }
    let wide = columns(&rows);
    if text::fits(&wide) {
        return wide;
    }
    // The error goes under the value.
    let short: Vec<_> = rows.iter().map(|row| row[..row.len().min(4)].to_vec()).collect();
    let mut narrow = String::new();
    for (line, row) in columns(&short).lines().zip(&rows) {
        narrow += &format!("{line}\n");
        narrow += &row.get(4).map_or(String::new(), |error| format!("{:>24}{error}\n", ""));
    }
    narrow
}

/// Most coefficients in one panel: colours that remain apart.
const LINES: usize = 7;

/// Steps: a revision is a tread, from half a unit before its number to half a unit after.
fn panels(ladder: &Ladder) -> Vec<Panel> {
    let count = ladder.revisions.len();
    let tread = |label: String, number: usize, of: &dyn Fn(&Rung) -> Option<f64>| {
        let points = ladder.revisions.iter().enumerate().filter_map(|(at, rung)| {
            let value = of(rung).filter(|v| v.is_finite())?;
            let at = at as f64 + 1.0;
            Some([(at - 0.45, value), (at + 0.45, value)])
        });
        let stroke = if number < LINES { Stroke::Solid } else { Stroke::Dashed };
        Line { label, colour: number % LINES, stroke, points: points.flatten().collect() }
    };
    let revisions = ladder.revisions.iter().enumerate().map(|(at, r)| format!("{}: {}", at + 1, r.revision));
    let named = format!("revision ({})", revisions.collect::<Vec<_>>().join(", "));
    // Wider than the axis it would be cut; the table has the names in the same order.
    let x_label = if text::width(&named) > 70 { "revision, numbered as in the table".to_owned() } else { named };
    let panel = |title: &str, y_label: &str, lines: Vec<Line>| Panel {
        title: title.to_owned(),
        x_label: x_label.clone(),
        y_label: y_label.to_owned(),
        x_scale: Scale::Linear,
        y_scale: Scale::Linear,
        x: 0.5..count as f64 + 0.5,
        y: None,
        lines: lines.into_iter().filter(|line| !line.points.is_empty()).collect(),
    };
    let mut overall = vec![tread("all channels".to_owned(), 0, &|r| Some(r.fit.chi2_per_dof))];
    overall.push(tread("held out".to_owned(), 1, &|r| Some(r.held_out.as_ref()?.fit.chi2_per_dof)));
    overall.push(tread("NIS".to_owned(), 2, &|r| Some(r.fit.nis)));
    let by_channel = channel_names(ladder);
    let by_channel = by_channel.iter().enumerate().map(|(number, name)| {
        tread((*name).to_owned(), number, &|r| Some(r.fit.channels.iter().find(|c| c.channel == *name)?.chi2_per_dof))
    });
    let by_channel: Vec<Line> = by_channel.collect();
    // Only what several revisions estimate can move.
    let of = |rung: &Rung, name: &str, get: &dyn Fn(&Value) -> Option<f64>| {
        rung.coefficients.iter().find(|c| c.name == name).and_then(get)
    };
    let shared: Vec<&str> = names(ladder)
        .into_iter()
        .filter(|name| {
            ladder.revisions.iter().filter(|r| r.coefficients.iter().any(|c| c.name == *name)).count() == count
        })
        .collect();
    let last = ladder.revisions.last();
    let moved = shared.iter().enumerate().map(|(number, name)| {
        let end = last.and_then(|r| of(r, name, &|c| Some(c.value)));
        let sigma = last.and_then(|r| of(r, name, &|c| Some(c.sigma)));
        tread((*name).to_owned(), number, &|r| Some((of(r, name, &|c| Some(c.value))? - end?) / sigma?))
    });
    let moved: Vec<Line> = moved.collect();
    let wrong = shared.iter().enumerate();
    let wrong: Vec<Line> =
        wrong.map(|(n, name)| tread((*name).to_owned(), n, &|r| of(r, name, &|c| c.error_sigmas))).collect();
    [
        panel("χ²/dof with the noise of the mission file", "χ²/dof", overall),
        panel("χ²/dof by channel", "χ²/dof", by_channel),
        panel("coefficients: away from the last revision", "σ", moved),
        panel("coefficients: away from the truth", "σ", wrong),
    ]
    .into_iter()
    .filter(|panel| !panel.lines.is_empty())
    .collect()
}
