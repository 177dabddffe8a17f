//! `dragfree reveal`.

use super::Done;
use crate::args::{Global, Reveal};
use crate::failure::{Failure, Refusal};
use crate::text::{self, Paint, columns, labelled, table};
use dragfree_archive::files::IoContext as _;
use dragfree_engine::border::Kind;
use dragfree_engine::sealed::Sealed;
use dragfree_score::{Compared, Outcome, Score, Scored, Verdict, score};
use serde_json::Value;
use std::path::Path;

pub(super) fn execute(command: &Reveal, global: &Global, paint: Paint) -> Result<Done, Failure> {
    let path = &command.sealed;
    let sealed = Sealed::read(path)?;
    let content = sealed.content(path)?;
    let checked = sealed.check(path, &command.telemetry)?;
    let scored = command.diagnosis.as_deref().map(|diagnosis| judge(&content, diagnosis, global)).transpose()?;
    if global.json {
        let mut value = serde_json::json!({"sha256": sealed.sha256, "telemetry": checked, "content": content});
        if let Some(score) = scored {
            value["score"] = serde_json::json!(score);
        }
        return Ok(Done::json(&value));
    }
    let agreement = match checked.len() {
        0 => paint.doubtful("not checked: no telemetry beside it names a digest; --telemetry FILE"),
        1 => "agrees with 1 telemetry file".to_owned(),
        n => format!("agrees with {n} telemetry files"),
    };
    let mut screen = format!("sha256    {}\n          {agreement}\n", sealed.sha256);
    screen += &labelled("seeds", &format!("hidden {}, noise {}", content["hidden_seed"], content["noise_seed"]));
    screen += "\n";
    screen += &effects(&content);
    screen += "\n";
    for (name, value) in content["offset_m"].as_object().into_iter().flatten() {
        screen += &format!("{name}  {:.4} mm\n", value.as_f64().unwrap_or(f64::NAN) * 1e3);
    }
    if let Some(score) = &scored {
        screen += "\n";
        screen += &verdict(score, paint);
    }
    Ok(Done::new(screen))
}

/// Scores a diagnosis, with the effects that are installed here.
fn judge(content: &Value, path: &Path, global: &Global) -> Result<Score, Failure> {
    let text = std::fs::read_to_string(path).at("read", path)?;
    let refuse = |what: String| Refusal::Diagnosis { path: path.to_owned(), what };
    let diagnosis: Value = serde_json::from_str(&text)
        .map_err(|e| refuse(format!("it is no JSON: {e}; write it with `dragfree diagnose PRODUCT --json`")))?;
    let effects: Vec<_> = super::registry(global)?.plugins().filter(|p| p.info.kind == Kind::Effect).collect();
    let installed = |id: &str, instance: &str| {
        effects.iter().any(|p| p.info.manifest.id == id && p.info.manifest.may_act_at(instance))
    };
    Ok(score(content, &diagnosis, &installed).map_err(refuse)?)
}

fn verdict(score: &Score, paint: Paint) -> String {
    let (word, meaning) = match score.verdict {
        Verdict::Right if score.effects.is_empty() => ("right", "nothing is hidden and nothing is named"),
        Verdict::Right => ("right", "what is hidden is accepted, and nothing else"),
        Verdict::Confounded => ("confounded", "what is hidden is named as what the data cannot tell from the accepted"),
        Verdict::Wrong => ("wrong", "a cause that did not act is accepted in place of what is hidden"),
        Verdict::Missed => ("missed", "what is hidden is not found"),
        Verdict::FalseAlarm if score.effects.is_empty() => {
            ("false alarm", "nothing is hidden, and the model is not sufficient")
        }
        Verdict::FalseAlarm => ("false alarm", "what is hidden is found, and a cause that did not act is accepted too"),
        Verdict::Unexplained if score.correct => ("unexplained", "rightly: no installed effect covers what is hidden"),
        Verdict::Unexplained => ("unexplained", "something is hidden; its cause is not named"),
    };
    let painted = if score.correct { paint.good(word) } else { paint.bad(word) };
    let mut screen = labelled("score", &format!("{word}: {meaning}")).replacen(word, &painted, 1);
    let said = format!("{}, of {} forms", score.diagnosis_verdict, text::grouped(score.tried));
    screen += &labelled("diagnosis", &said);
    for name in &score.false_causes {
        screen += &labelled("false", &format!("{name} is accepted and did not act"));
    }
    if score.effects.is_empty() {
        return screen;
    }
    screen += "\n";
    screen += &outcomes(&score.effects);
    let compared: Vec<&Compared> = score.effects.iter().flat_map(|e| &e.values).collect();
    if !compared.is_empty() {
        screen += "\n";
        screen += &values(&compared);
    }
    for e in &score.effects {
        let who = format!("{}:{}", e.truth.effect, e.truth.instance);
        let mut notes: Vec<String> = e.not_compared_because.iter().map(|why| format!("not compared: {why}")).collect();
        notes.extend(e.not_covered_because.iter().map(|why| format!("not tried: {why}")));
        if !e.confounder_of.is_empty() {
            notes.push(format!("named as what cannot be told from {}", e.confounder_of.join(", ")));
        }
        if !e.drivers.is_empty() {
            let rank = e.driver_rank.map_or("not there".to_owned(), |rank| format!("number {rank}"));
            notes.push(format!("driven by {}: {rank} under `coherent with`", e.drivers.join(" and ")));
        }
        for limit in e.limits.iter().filter(|_| !e.accepted) {
            let (unit, factor) = text::readable_unit(&limit.unit);
            notes.push(format!("{} below {} {unit} at 95 %", limit.coefficient, text::plain(limit.limit_95 * factor)));
        }
        for note in notes {
            screen += &labelled("note", &format!("{who}: {note}"));
        }
    }
    screen
}

/// A row for everything that acted.
fn outcomes(effects: &[Scored]) -> String {
    let sigma = |s: Option<f64>| s.map_or_else(|| "-".to_owned(), |s| format!("{s:.1} σ"));
    let row = |e: &Scored| {
        let outcome = match e.outcome {
            Outcome::Accepted => "accepted",
            Outcome::Confounded => "a confounder",
            Outcome::Unexplained => "unexplained",
            Outcome::Missed => "missed",
        };
        vec![
            format!("{}:{}", e.truth.effect, e.truth.instance),
            e.rank.map_or_else(|| "-".to_owned(), |rank| rank.to_string()),
            outcome.to_owned(),
            sigma(e.truth.expected_significance),
            sigma(e.significance),
        ]
    };
    columns(&table(&["hidden", "rank", "outcome", "expected", "found"], effects.iter().map(row)))
}

/// A row for every size that can be compared; the unit is left out where the row would be too wide.
fn values(compared: &[&Compared]) -> String {
    let row = |c: &&Compared| {
        let (unit, factor) = text::readable_unit(&c.unit);
        vec![
            c.coefficient.clone(),
            text::plain(c.truth * factor),
            text::measured(c.value * factor, c.sigma * factor),
            format!("{:+.1} σ", c.difference_sigma),
            unit.to_owned(),
        ]
    };
    let mut rows = table(&["size", "true", "found", "off by", ""], compared.iter().map(row));
    if !text::fits(&columns(&rows)) {
        rows.iter_mut().for_each(|row| row.truncate(4));
    }
    columns(&rows)
}

/// What is hidden, a block each.
fn effects(content: &Value) -> String {
    let word = |value: &Value| value.as_str().unwrap_or_default().to_owned();
    let number = |value: &Value| value.as_f64().unwrap_or(f64::NAN);
    let one = |e: &Value| {
        let (unit, factor) = text::readable_unit(e["unit"].as_str().unwrap_or_default());
        let size = text::plain(number(&e["size"]) * factor);
        let mut block = labelled("hidden", &format!("{}:{} {size} {unit}", word(&e["effect"]), word(&e["instance"])));
        let shape = e["shape"].as_object().into_iter().flatten();
        let shape: Vec<String> = shape.map(|(name, value)| format!("{name} {}", text::plain(number(value)))).collect();
        if !shape.is_empty() {
            block += &labelled("shape", &shape.join(", "));
        }
        let covered = if e["covered"] == false { "; no bundled effect covers it" } else { "" };
        block + &labelled("expected", &format!("{:.1} σ{covered}", number(&e["significance"])))
    };
    match content["effects"].as_array().map_or(&[][..], Vec::as_slice) {
        [] => "hidden    nothing\n".to_owned(),
        all => all.iter().map(one).collect(),
    }
}
