//! Report of a blind campaign: numbers with their bars, and the confusion matrix.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write as _;

use dragfree_chart::ChartError;
use dragfree_chart::matrix::{Matrix, svg};
use serde_json::Value;

use crate::records::{Blind, Solution};

/// Significance from which an effect should be detected.
const PLAIN: f64 = 8.0;

/// Label of a set without hidden effects.
const NOTHING: &str = "nothing";

/// A true effect of a set.
struct Acted<'a> {
    line: &'a Blind,
    effect: &'a Value,
}

impl Acted<'_> {
    fn kind(&self) -> &str {
        self.effect["effect"].as_str().unwrap_or("?")
    }

    /// Nominal significance of its size.
    fn drawn(&self) -> f64 {
        self.effect["expected_significance"].as_f64().unwrap_or(0.0)
    }

    /// Significance of the truth with the diagnosis's own σ; `None` without σ.
    fn at_hand(&self) -> Option<f64> {
        self.effect["significance_at_hand"].as_f64()
    }

    /// Whether such an effect is installed.
    fn is_covered(&self) -> bool {
        self.effect["covered"] == true
    }

    /// Whether it is accepted, or a listed confounder of an accepted one.
    fn is_found(&self) -> bool {
        self.effect["outcome"] == "accepted" || self.effect["outcome"] == "confounded"
    }

    /// Whether it is reported as unexplained, with its driver (if any) among the first three.
    fn is_pointed_at(&self) -> bool {
        let has_driver = self.effect["drivers"].as_array().is_some_and(|d| !d.is_empty());
        self.effect["outcome"] == "unexplained"
            && (!has_driver || self.effect["driver_rank"].as_u64().is_some_and(|rank| rank <= 3))
    }
}

fn effects(line: &Blind) -> Vec<Acted<'_>> {
    let all = line.score["effects"].as_array().map_or(&[][..], Vec::as_slice);
    all.iter().map(|effect| Acted { line, effect }).collect()
}

/// First answer of a diagnosis: the kind of its first accepted candidate, or its verdict.
fn said(line: &Blind) -> &str {
    match line.score["accepted"].get(0).and_then(Value::as_str) {
        Some(name) => name.split(':').next().unwrap_or(name),
        None => line.score["diagnosis_verdict"].as_str().unwrap_or("?"),
    }
}

fn false_causes(line: &Blind) -> usize {
    line.score["false_causes"].as_array().map_or(0, Vec::len)
}

/// A ratio as text, `17 of 20, 85 %`.
fn part(k: usize, n: usize) -> String {
    if n == 0 { "none".to_owned() } else { format!("{k} of {n}, {:.0} %", 100.0 * k as f64 / n as f64) }
}

/// Errors over σ of several offset solutions.
fn pulls<'a>(solutions: impl Iterator<Item = &'a Solution>) -> Vec<f64> {
    solutions.flat_map(Solution::pulls).filter(|p| p.is_finite()).collect()
}

fn rms(values: &[f64]) -> f64 {
    (values.iter().map(|v| v * v).sum::<f64>() / values.len().max(1) as f64).sqrt()
}

/// Generated part of VALIDATION.md, and the missed bars.
pub(crate) fn numbers(lines: &[Blind]) -> (String, Vec<String>) {
    if lines.is_empty() {
        return ("Not measured yet.\n".to_owned(), Vec::new());
    }
    let mut text = provenance(lines);
    let mut missed = Vec::new();
    let _ = writeln!(text, "\n| what | measured | bar | |\n|---|---|---|---|");
    let mut row = |what: &str, measured: String, bar: &str, holds: Option<bool>| {
        let mark = match holds {
            Some(true) => "met",
            Some(false) => "**missed**",
            None => "",
        };
        let _ = writeln!(text, "| {what} | {measured} | {bar} | {mark} |");
        if holds == Some(false) {
            missed.push(format!("{what}: {measured}, bar {bar}"));
        }
    };
    let share = |k: usize, n: usize, least: f64| (n > 0).then_some(k as f64 >= least * n as f64);

    let nothing: Vec<&Blind> = lines.iter().filter(|l| effects(l).is_empty()).collect();
    let alarms = nothing.iter().filter(|l| l.score["correct"] != true).count();
    let few = share(nothing.len() - alarms, nothing.len(), 0.99);
    row("false alarms where nothing is hidden", part(alarms, nothing.len()), "≤ 1 %", few);
    let wrong = lines.iter().filter(|l| false_causes(l) > 0).count();
    row(
        "a false cause named, all sets",
        part(wrong, lines.len()),
        "≤ 1 %",
        share(lines.len() - wrong, lines.len(), 0.99),
    );

    let singles: Vec<Acted<'_>> = lines.iter().map(effects).filter(|e| e.len() == 1).flatten().collect();
    let right = |a: &&&Acted<'_>| a.is_found() && false_causes(a.line) == 0;
    let above = |significance: &dyn Fn(&Acted<'_>) -> f64, floor: f64, roof: f64| {
        let these: Vec<&Acted<'_>> =
            singles.iter().filter(|a| a.is_covered() && (floor..roof).contains(&significance(a))).collect();
        (these.iter().filter(right).count(), these.len())
    };
    // A set whose truth the diagnosis did not rank has no σ of its own and counts by the drawn significance: it is
    // missed.
    let at_hand = |a: &Acted<'_>| a.at_hand().unwrap_or_else(|| a.drawn());
    let (k, n) = above(&at_hand, PLAIN, f64::INFINITY);
    row(
        "one effect, above 8σ in the data at hand: right first, or a confounder",
        part(k, n),
        "≥ 95 %",
        share(k, n, 0.95),
    );
    let (k, n) = above(&|a| a.drawn(), PLAIN, f64::INFINITY);
    row("one effect, drawn for more than 8σ: the same", part(k, n), "≥ 95 %", share(k, n, 0.95));
    let (k, n) = above(&at_hand, 3.0, PLAIN);
    row("one effect, 3 to 8σ in the data at hand: the same", part(k, n), "", None);

    let accepted = lines.iter().flat_map(effects).filter(|a| a.effect["accepted"] == true);
    let values: Vec<f64> = accepted
        .flat_map(|a| a.effect["values"].as_array().cloned().unwrap_or_default())
        .filter_map(|v| v["difference_sigma"].as_f64())
        .collect();
    let within = values.iter().filter(|d| d.abs() <= 2.0).count();
    row(
        "coefficients of true causes within 2σ",
        part(within, values.len()),
        "≥ 93 %",
        share(within, values.len(), 0.93),
    );

    let after: Vec<_> = lines.iter().filter_map(|l| Some((l, l.after.as_ref()?))).collect();
    let apart: Vec<f64> = after
        .iter()
        .filter_map(|(_, a)| {
            let [_, found, known] = a.held_out_chi2_per_dof;
            Some((found? / known? - 1.0).abs())
        })
        .collect();
    let most = apart.iter().copied().fold(0.0, f64::max);
    row(
        "χ²/dof on telemetry kept out, with what was found against with the truth",
        format!("apart by at most {:.2} % in {} sets", 100.0 * most, apart.len()),
        "≤ 1 %",
        (!apart.is_empty()).then_some(most <= 0.01),
    );
    let before = pulls(after.iter().map(|(l, _)| &l.before));
    let with = pulls(after.iter().map(|(_, a)| &a.offset));
    let without = pulls(nothing.iter().map(|l| &l.before));
    row(
        "error of the offset over its σ, rms: before, after adding, and where nothing is hidden",
        format!("{:.2}, {:.2}, {:.2}", rms(&before), rms(&with), rms(&without)),
        "back to the last",
        None,
    );

    let pairs: Vec<Vec<Acted<'_>>> = lines.iter().map(effects).filter(|e| e.len() == 2).collect();
    let both = |p: &&Vec<Acted<'_>>| p.iter().all(|a| a.is_found() || a.is_pointed_at());
    let k = pairs.iter().filter(both).count();
    row("pairs: both found", part(k, pairs.len()), "≥ 85 %", share(k, pairs.len(), 0.85));
    let plain =
        |p: &&Vec<Acted<'_>>| p.iter().all(|a| at_hand(a).max(if a.is_covered() { 0.0 } else { a.drawn() }) >= PLAIN);
    let loud: Vec<&Vec<Acted<'_>>> = pairs.iter().filter(plain).collect();
    let k = loud.iter().filter(|p| both(p)).count();
    row("pairs of two above 8σ: both found", part(k, loud.len()), "≥ 85 %", share(k, loud.len(), 0.85));

    let unknown: Vec<&Acted<'_>> = singles.iter().filter(|a| !a.is_covered()).collect();
    for (what, floor, roof) in [("above 8σ", PLAIN, f64::INFINITY), ("of 3 to 8σ", 0.0, PLAIN)] {
        let these: Vec<&&Acted<'_>> = unknown.iter().filter(|a| (floor..roof).contains(&a.drawn())).collect();
        let k = these.iter().filter(|a| a.is_pointed_at()).count();
        let bar = if floor > 0.0 { "all" } else { "" };
        let holds = if floor > 0.0 { share(k, these.len(), 1.0) } else { None };
        let what =
            format!("a kind that no effect covers, drawn {what}: `unexplained`, the true driver among the first three");
        row(&what, part(k, these.len()), bar, holds);
    }
    text += &kinds(&singles);
    (text, missed)
}

fn provenance(lines: &[Blind]) -> String {
    let seeds: BTreeSet<u32> = lines.iter().map(|l| l.seed).collect();
    let (first, last) = (seeds.first().copied().unwrap_or(0), seeds.last().copied().unwrap_or(0));
    let join =
        |of: &dyn Fn(&Blind) -> String| lines.iter().map(of).collect::<BTreeSet<_>>().into_iter().collect::<Vec<_>>();
    let mut seconds: Vec<f64> = lines.iter().map(|l| l.diagnosis_s).collect();
    seconds.sort_by(f64::total_cmp);
    format!(
        "{} sets, {}, hidden seeds {first} to {last}, build {}; a diagnosis took {:.0} s in the median, {:.0} s at most.\n",
        lines.len(),
        join(&|l| l.configuration.clone()).join(", "),
        join(&|l| l.build.clone()).join(", "),
        seconds.get(seconds.len() / 2).copied().unwrap_or(0.0),
        seconds.last().copied().unwrap_or(0.0),
    )
}

/// Detections per kind over sets.
fn kinds(singles: &[Acted<'_>]) -> String {
    let mut rows: BTreeMap<&str, [(usize, usize); 3]> = BTreeMap::new();
    for a in singles {
        let row = rows.entry(a.kind()).or_default();
        let found = usize::from(a.is_found() || a.is_pointed_at());
        let column = usize::from(a.drawn() < PLAIN);
        (row[column].0, row[column].1) = (row[column].0 + found, row[column].1 + 1);
        if a.at_hand().is_some_and(|s| s >= PLAIN) {
            (row[2].0, row[2].1) = (row[2].0 + found, row[2].1 + 1);
        }
    }
    let mut text =
        "\n| one effect | drawn above 8σ | drawn 3 to 8σ | above 8σ in the data at hand |\n|---|---|---|---|\n"
            .to_owned();
    for (kind, row) in rows {
        let [a, b, c] = row.map(|(k, n)| if n == 0 { "–".to_owned() } else { format!("{k} of {n}") });
        let _ = writeln!(text, "| `{kind}` | {a} | {b} | {c} |");
    }
    text
}

/// Confusion matrices of the sets with at most one effect: hidden effect against first answer. `None` without results.
pub(crate) fn picture(lines: &[Blind]) -> Result<Option<String>, ChartError> {
    let plain = |a: &Acted<'_>| a.drawn().max(a.at_hand().unwrap_or(0.0)) >= PLAIN;
    let mut tables = Vec::new();
    for (title, wanted) in
        [("Hidden above 8σ (rows), said first (columns)", true), ("Hidden below 8σ, or nothing", false)]
    {
        let mut counts: BTreeMap<(&str, &str), usize> = BTreeMap::new();
        let mut covered: BTreeMap<&str, bool> = BTreeMap::new();
        for line in lines {
            let all = effects(line);
            let kind = match all.as_slice() {
                [] if !wanted => NOTHING,
                [one] if plain(one) == wanted => one.effect["effect"].as_str().unwrap_or("?"),
                _ => continue,
            };
            covered.entry(kind).or_insert_with(|| all.iter().all(Acted::is_covered));
            *counts.entry((kind, said(line))).or_default() += 1;
        }
        if counts.is_empty() {
            continue;
        }
        // No effect and uncovered kinds come last, with the answers that belong to them.
        let order =
            |name: &str| (matches!(name, NOTHING | "sufficient" | "unexplained"), covered.get(name) == Some(&false));
        let sorted = |names: BTreeSet<&str>| {
            let mut names: Vec<String> = names.into_iter().map(str::to_owned).collect();
            names.sort_by_key(|name| order(name));
            names
        };
        let rows = sorted(counts.keys().map(|(hidden, _)| *hidden).collect());
        let columns = sorted(counts.keys().map(|(_, said)| *said).collect());
        let belongs = |row: &str, column: &str| match (row, covered.get(row)) {
            (NOTHING, _) => column == "sufficient",
            (_, Some(false)) => column == "unexplained",
            _ => column == row,
        };
        let cells = |i: usize| (0..columns.len()).map(move |j| (i, j));
        let right = (0..rows.len()).flat_map(cells).filter(|(i, j)| belongs(&rows[*i], &columns[*j])).collect();
        let count = |row: &String, column: &String| counts.get(&(row.as_str(), column.as_str())).copied().unwrap_or(0);
        let counts = rows.iter().map(|row| columns.iter().map(|column| count(row, column)).collect()).collect();
        tables.push(Matrix { title: title.to_owned(), rows, columns, counts, right });
    }
    if tables.is_empty() { Ok(None) } else { svg(&tables).map(Some) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::records::After;
    use crate::records::tests::line as product;
    use serde_json::json;

    fn set(seed: u32, verdict: &str, accepted: &[&str], effects: &Value) -> Blind {
        let names: Vec<String> = effects
            .as_array()
            .into_iter()
            .flatten()
            .map(|e| format!("{}:tm1.y", e["effect"].as_str().unwrap_or("?")))
            .collect();
        let false_causes: Vec<&&str> = accepted.iter().filter(|a| !names.iter().any(|n| n == **a)).collect();
        Blind {
            configuration: "hidden-6h".to_owned(),
            seed,
            build: "b".to_owned(),
            diagnosis_s: 1.0,
            before: product("x", 1).qp,
            after: None,
            score: json!({
                "verdict": verdict, "correct": verdict == "right", "effects": effects, "accepted": accepted,
                "diagnosis_verdict": if accepted.is_empty() { "sufficient" } else { "missing" },
                "false_causes": false_causes,
            }),
        }
    }

    fn effect(kind: &str, drawn: f64, at_hand: f64, outcome: &str) -> Value {
        json!({ "effect": kind, "expected_significance": drawn, "significance_at_hand": at_hand, "covered": true,
            "accepted": outcome == "accepted", "outcome": outcome, "drivers": [], "values": [{ "difference_sigma": 0.5 }] })
    }

    #[test]
    fn bars_that_are_missed_are_told() {
        let right = set(101, "right", &["es-gain:tm1.y"], &json!([effect("es-gain", 9.0, 8.5, "accepted")]));
        let lost = set(102, "missed", &[], &json!([effect("charge", 9.0, 2.0, "missed")]));
        let alarm = set(103, "false alarm", &["slosh:sc.x"], &json!([]));
        let both = json!([effect("es-gain", 9.0, 9.0, "accepted"), effect("charge", 9.0, 9.0, "accepted")]);
        let pair = set(104, "right", &["es-gain:tm1.y", "charge:tm1.y"], &both);
        let (text, missed) = numbers(&[right.clone(), lost.clone(), alarm, pair]);
        assert!(
            text.contains("one effect, above 8σ in the data at hand: right first, or a confounder | 1 of 1, 100 %"),
            "{text}"
        );
        assert!(text.contains("drawn for more than 8σ: the same | 1 of 2, 50 %"), "{text}");
        assert!(text.contains("pairs: both found | 1 of 1"), "{text}");
        assert!(text.contains("| `charge` | 0 of 1 | – | – |"), "{text}");
        assert!(missed.iter().any(|m| m.starts_with("false alarms")), "{missed:?}");
        let (_, missed) = numbers(&[right]);
        assert_eq!(missed, Vec::<String>::new());
        let (_, missed) = numbers(&[lost]);
        assert_eq!(missed.len(), 1, "{missed:?}");
    }

    #[test]
    fn what_is_kept_out_tells_a_wrong_size() {
        let mut line = set(101, "right", &["es-gain:tm1.y"], &json!([effect("es-gain", 9.0, 8.5, "accepted")]));
        let offset = line.before.clone();
        for (found, failed) in [(1.005, 0), (1.02, 1)] {
            let held_out_chi2_per_dof = [Some(1.1), Some(found), Some(1.0)];
            line.after =
                Some(After { added: vec!["es-gain:tm1.y".to_owned()], offset: offset.clone(), held_out_chi2_per_dof });
            assert_eq!(numbers(std::slice::from_ref(&line)).1.len(), failed, "{found}");
        }
    }

    #[test]
    fn the_picture_has_what_was_hidden_and_what_was_said() {
        let right = set(101, "right", &["es-gain:tm1.y"], &json!([effect("es-gain", 9.0, 8.5, "accepted")]));
        let nothing = set(102, "right", &[], &json!([]));
        let picture = picture(&[right, nothing]).expect("a picture").expect("with cells");
        for word in ["es-gain", "nothing", "sufficient"] {
            assert!(picture.contains(word), "{word}");
        }
        assert_eq!(super::picture(&[]).expect("no picture"), None);
    }
}
