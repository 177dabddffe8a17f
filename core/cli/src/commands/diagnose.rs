//! `dragfree diagnose`: the data of products once more, with every effect that is not in the model.

use super::{Done, INCONSISTENT, products, replay};
use crate::advice;
use crate::args::{Diagnose, Global};
use crate::failure::{Failure, Refusal};
use crate::text::Paint;
use chrono::DateTime;
use dragfree_archive::Written;
use dragfree_archive::files::IoContext as _;
use dragfree_identification::diagnosis::{Diagnosis, Found, Offset};
use dragfree_identification::transient::Detection;
use dragfree_workflow::diagnose::diagnose;
use dragfree_workflow::extract::diagnose_extracts;
use dragfree_workflow::next::{Next, next};
use dragfree_workflow::words::after_a_number;
use std::fmt::Write as _;
use std::path::Path;

pub(super) fn execute(command: &Diagnose, global: &Global, paint: Paint) -> Result<Done, Failure> {
    let archive = &command.archive.folder()?;
    let products = products::open_all(&command.products, archive)?;
    products::look_for(&products, &command.inputs.folders)?;
    if command.keep_extract && products.len() != 1 {
        return Err(Refusal::Extracts(products.len()).into());
    }
    let (answer, kept) = if command.extracts {
        let diagnosis = diagnose_extracts(&products)?;
        (Answer { diagnosis, effects: None, unnamed: Vec::new(), next: None }, None)
    } else {
        let others = if command.next { latest(archive)? } else { Vec::new() };
        let (diagnosed, next) = replay::with_meter(&products, global, |replay, progress| {
            let diagnosed = diagnose(replay, command.keep_extract, progress)?;
            let next = command.next.then(|| next(replay, &diagnosed, &others, progress)).transpose()?;
            Ok((diagnosed, next))
        })?;
        let kept = match (&diagnosed.extract, &products[..]) {
            (Some(extract), [product]) => Some(extract.write(&product.path, &super::stamp())?),
            _ => None,
        };
        let unnamed = diagnosed.unexplained_transients().into_iter().cloned().collect();
        let effects = Some(diagnosed.effects());
        (Answer { diagnosis: diagnosed.diagnosis, effects, unnamed, next }, kept)
    };
    let code = if answer.diagnosis.verdict == "sufficient" { 0 } else { INCONSISTENT };
    if global.json || command.out.is_some() {
        let mut value = products::said_of(&products, &answer.diagnosis)?;
        if let Some(next) = &answer.next {
            value["next"] = serde_json::to_value(next)?;
        }
        let document = Done::json(&value);
        if let Some(path) = &command.out {
            std::fs::write(path, &document.text).at("write", path)?;
        }
        if global.json {
            return Ok(Done { code, ..document });
        }
    }
    let mut text = screen(&answer, command, &super::repeated(None, global), paint);
    if let Some(next) = &answer.next {
        text += &advice::screen(next);
    }
    if let Some((path, bytes)) = kept {
        let _ = writeln!(text, "extract   {}, {} bytes", path.display(), crate::text::grouped(bytes));
    }
    Ok(Done { code, ..Done::new(text) })
}

/// The newest products of an archive; none where there is no archive, as products may be named by their files.
fn latest(archive: &Path) -> Result<Vec<Written>, Failure> {
    if !archive.is_dir() {
        return Ok(Vec::new());
    }
    let archive = products::archive(archive)?;
    let newest = archive.newest()?.into_iter();
    newest.map(|entry| Ok(Written { product: archive.product(&entry.row.id)?, path: entry.path })).collect()
}

/// What is shown.
struct Answer {
    diagnosis: Diagnosis,
    /// Effects that were tried; not known of extracts.
    effects: Option<usize>,
    /// Detected transients that are no part of the answer.
    unnamed: Vec<Detection>,
    /// What would tell more, where it was asked for.
    next: Option<Next>,
}

fn screen(answer: &Answer, command: &Diagnose, repeated: &str, paint: Paint) -> String {
    let Answer { diagnosis: d, effects, unnamed, .. } = answer;
    let top = command.top;
    let mut out = String::new();
    let verdict = match d.verdict.as_str() {
        "missing" => "an effect is missing from the model",
        "unexplained" => "something is left that no installed effect explains",
        _ => "the model is sufficient for these data",
    };
    let _ = writeln!(out, "verdict   {} ({verdict})", paint.bold(&d.verdict));
    let _ = writeln!(
        out,
        "tried     {} forms{}, false alarms at most {} in 100",
        d.tried,
        effects.map_or_else(String::new, |n| format!(" of {n} effects")),
        100.0 * d.false_alarm_rate
    );
    let accepted: Vec<&Found> = d.candidates.iter().filter(|f| f.accepted).collect();
    if !accepted.is_empty() {
        let _ = writeln!(out, "\nWhat is missing");
        accepted.iter().for_each(|f| put(&mut out, f, d.false_alarm_rate));
    }
    let others: Vec<&Found> =
        d.candidates.iter().filter(|f| !f.accepted).take(top.saturating_sub(accepted.len())).collect();
    if !others.is_empty() {
        let _ = writeln!(out, "\nTried next, and not accepted");
        others.iter().for_each(|f| put(&mut out, f, d.false_alarm_rate));
    }
    for reason in &d.reasons {
        out += &crate::text::labelled("reason", reason);
    }
    if !d.offsets.is_empty() {
        let offset = |o: &Offset| {
            let [value, sigma, with] = [o.value_m, o.sigma_m, o.sigma_with_undetected_m].map(|x| 1e3 * x);
            format!("{} = {value:.2} ± {sigma:.2} ({with:.2}) mm", o.coefficient)
        };
        let all: Vec<String> = d.offsets.iter().map(offset).collect();
        let text = format!("{}; in brackets σ if effects act that were not detected", all.join(", "));
        out += &crate::text::labelled("offsets", &text);
    }
    for level in &d.levels {
        let level = format!("{}:{} = {:.3} ± {:.3}", level.effect, level.instance, level.value, level.sigma);
        out += &crate::text::labelled("noise", &format!("{level}, within the tolerance of a mission file"));
    }
    if let Some(u) = &d.unexplained {
        let _ = writeln!(out, "\nWhat no installed effect explains");
        let _ = writeln!(out, "  channels {}", u.channels.join(", "));
        let band = format!("between {:.2e} and {:.2e} Hz", u.band_hz[0], u.band_hz[1]);
        let _ = match (u.kind.as_str(), u.power) {
            ("driven", _) => writeln!(out, "  driven by something aboard, {band}"),
            (kind, true) => writeln!(out, "  {kind} {band}, {:.2} times the power", u.ratio),
            (kind, false) => writeln!(out, "  {kind} {band}, told by housekeeping: {:.2} times the power", u.ratio),
        };
        if !u.coherent_with.is_empty() {
            out.push_str(&crate::text::labelled("  coherent with", &u.coherent_with.join(", ")));
        }
    }
    if !d.formulas.is_empty() {
        let several = match (d.formulas.len(), together(d).len()) {
            (2.., 0) => ", each",
            (all @ 2.., chosen) if chosen == all => ", together",
            _ => "",
        };
        let _ = writeln!(out, "\nFormulas that would explain it{several}");
        d.formulas.iter().for_each(|f| put(&mut out, f, d.false_alarm_rate));
    }
    if !unnamed.is_empty() {
        let _ = writeln!(out, "\nTransients that were detected and are no part of the answer");
        for h in unnamed.iter().take(top) {
            let at = DateTime::from_timestamp_nanos(h.at_ns).format("%Y-%m-%dT%H:%M:%SZ");
            let _ = writeln!(out, "  {at}, as {}:{} would, {:.0}σ", h.effect, h.instance, h.significance);
        }
        let _ = writeln!(
            out,
            "  Within seconds of a gap or an end there is too little to weigh it: run two days' files as one."
        );
    }
    if let Some(f) = accepted.first() {
        let _ = writeln!(out, "\nnext      {}", added(f, repeated));
    }
    let first = d.formulas.first().filter(|_| together(d).is_empty());
    for f in together(d).into_iter().chain(first) {
        let _ = writeln!(out, "\nnext      {}", added(f, repeated));
    }
    for (name, reason) in &d.not_tried {
        let _ = writeln!(out, "not tried {name}: {reason}");
    }
    out
}

/// Formulas that were chosen together; none where the data do not tell those that are proposed from each other.
fn together(d: &Diagnosis) -> Vec<&Found> {
    d.formulas.iter().filter(|f| f.accepted).collect()
}

/// The command that adds an effect to a model, in the form that was found.
fn added(f: &Found, repeated: &str) -> String {
    let set = |(key, value): (&String, &serde_json::Value)| match value {
        serde_json::Value::Array(ends) => {
            format!(" --set {key}={}", ends.iter().map(ToString::to_string).collect::<Vec<_>>().join(","))
        }
        serde_json::Value::String(text) => format!(" --set \"{key}={text}\""),
        value => format!(" --set {key}={value}"),
    };
    let parameters: String = f.shape.iter().map(set).collect();
    format!("dragfree model add MODEL.toml {}:{}{parameters}{repeated}", f.effect, f.instance)
}

/// `different` is the p-value below which products differ.
fn put(out: &mut String, f: &Found, different: f64) {
    let _ = writeln!(out, "  {}:{}", f.effect, f.instance);
    let _ = writeln!(
        out,
        "    {} = {:.4e} ± {:.1e}{}, χ² falls by {:.0}, p = {:.1e}{}",
        f.coefficient,
        f.value,
        f.sigma,
        after_a_number(&f.unit),
        f.delta_chi2,
        f.p_value,
        if f.in_range { "" } else { ", at the end of its range" }
    );
    if let Some(reason) = &f.refused {
        out.push_str(&crate::text::labelled("    refused", reason));
    }
    for (key, value) in &f.shape {
        let sigma = f.shape_sigma.get(key).map_or_else(String::new, |sigma| format!(" ± {sigma:.1e}"));
        let _ = writeln!(out, "    {key} = {value}{sigma}");
    }
    let moved: Vec<String> = f
        .offset_shift_sigma
        .iter()
        .filter(|(_, s)| s.abs() > 1.0)
        .map(|(name, s)| format!("{name} by {:.2} mm ({s:.1}σ)", 1e3 * f.offset_shift_m[name]))
        .collect();
    if !moved.is_empty() {
        let _ = writeln!(out, "    without it {}", moved.join(", "));
    }
    if let Some(c) = &f.constancy {
        let days: Vec<String> = f.by_product.iter().map(|d| format!("{:.3e} ± {:.0e}", d.value, d.sigma)).collect();
        let verdict = if c.p_value < different { "not the same in all products" } else { "the same in all products" };
        let text = format!("{verdict}: {} (χ² {:.1} of {}, p = {:.1e})", days.join(", "), c.chi2, c.dof, c.p_value);
        out.push_str(&crate::text::labelled("    values", &text));
    }
    if !f.confounders.is_empty() {
        out.push_str(&crate::text::labelled("    cannot be told from", &f.confounders.join(", ")));
    }
}
