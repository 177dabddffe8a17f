//! `dragfree model`.

use super::{Done, products};
use crate::args::{Global, Model as Command, ModelAdd, ModelFix};
use crate::failure::{Failure, Refusal};
use crate::screen::problems_json;
use crate::text::{self, Paint, columns, labelled, table};
use dragfree_archive::files::IoContext as _;
use dragfree_archive::files::Problem;
use dragfree_engine::border::{Kind, Manifest, ParameterType};
use dragfree_engine::config::{EffectEntry, Model, Prior};
use dragfree_engine::revisions::{self, Change, Committed, Edit, Log, Logged, Place, What};
use dragfree_workflow::adding::{self, Addition};
use serde_json::{Value, json};
use std::path::Path;

pub(super) fn execute(command: &Command, global: &Global, paint: Paint) -> Result<Done, Failure> {
    let json = global.json;
    match command {
        Command::Show { model, revision } => show(model, revision.as_deref(), json, paint),
        Command::Log { model } => {
            let log = revisions::log(model)?;
            Ok(if json { Done::json(&log_json(&log)) } else { Done::new(log_text(&log, paint)) })
        }
        Command::Add(command) => add(command, global, paint),
        Command::Remove { model, effect } => {
            let (id, instance) = split(effect);
            change(model, global, paint, |edit| edit.remove(id, instance))
        }
        Command::Restore { model, revision } => change(model, global, paint, |edit| edit.restore(revision)),
        Command::Commit { model } => change(model, global, paint, |_| Ok(())),
        Command::Fix(command) => fix(command, global, paint),
    }
}

/// `ID:INSTANCE`, or the id alone.
fn split(effect: &str) -> (&str, Option<&str>) {
    effect.split_once(':').map_or((effect, None), |(id, instance)| (id, Some(instance)))
}

fn change(
    path: &Path,
    global: &Global,
    paint: Paint,
    act: impl FnOnce(&mut Edit) -> Result<(), revisions::RevisionError>,
) -> Result<Done, Failure> {
    let mut edit = Edit::begin(path)?;
    let revision = edit.model().map(|m| m.revision.clone()).unwrap_or_default();
    act(&mut edit)?;
    let committed = edit.commit()?;
    Ok(done(path, &revision, committed.as_ref(), None, global, paint))
}

/// What a command has made; `archive` where it read a product.
fn done(
    path: &Path,
    revision: &str,
    committed: Option<&Committed>,
    archive: Option<&Path>,
    global: &Global,
    paint: Paint,
) -> Done {
    let json = global.json;
    let Some(made) = committed else {
        if json {
            let value =
                json!({"path": path.to_string_lossy(), "before": revision, "revision": revision, "changes": []});
            return Done::json(&value);
        }
        return Done::new(format!("{} is revision {revision}: nothing has changed\n", path.display()));
    };
    if json {
        return Done::json(&json!({
            "path": path.to_string_lossy(),
            "before": made.before,
            "recorded": made.recorded,
            "revision": made.revision,
            "parent": made.parent,
            "changes": made.changes,
            "history": made.history.to_string_lossy(),
        }));
    }
    let mut text = String::new();
    if let (Some(recorded), Some(before)) = (&made.recorded, &made.before) {
        let words = format!("the file was edited by hand since revision {before}; that is revision {recorded} now");
        text += &labelled("edited", &words).replacen("edited", &paint.doubtful("edited"), 1);
    }
    for change in &made.changes {
        let (word, more) = told(change);
        text += &labelled(word, &format!("{}{more}", change.effect));
    }
    let parent = made.parent.as_deref().map_or(String::new(), |parent| format!("{parent} → "));
    text += &format!("revision  {parent}{}\n", paint.bold(&made.revision));
    text += &format!("model     {}\nhistory   {}\n", path.display(), made.history.display());
    let (model, repeated) = (text::quoted(&path.to_string_lossy()), super::repeated(archive, global));
    text += &format!("next      dragfree run PIPELINE.toml FILE... --model {model}{repeated}\n");
    Done::new(text)
}

fn told(change: &Change) -> (&'static str, String) {
    match &change.what {
        What::Added => ("added", String::new()),
        What::Removed => ("removed", String::new()),
        What::Changed(keys) => ("changed", format!(" ({})", keys.join(", "))),
    }
}

fn add(command: &ModelAdd, global: &Global, paint: Paint) -> Result<Done, Failure> {
    let mut comment = String::new();
    let mut diagnosed = None;
    let mut entry = match (&command.from, &command.effect) {
        (Some(diagnosis), effect) => {
            let candidate = candidate(diagnosis, effect.as_deref(), command.rank)?;
            comment = evidence(&candidate);
            let entry = proposed(diagnosis, &candidate)?;
            diagnosed = Some(candidate);
            entry
        }
        (None, Some(effect)) => {
            let (id, instance) = split(effect);
            EffectEntry::new(id, instance.unwrap_or_default())
        }
        (None, None) => return Err("name an effect, or a diagnosis with --from".into()),
    };
    let found = super::registry(global)?.find(Kind::Effect, &entry.id)?;
    let manifest = &found.info.manifest;
    for (name, value) in &command.set {
        entry.parameters.insert(name.clone(), parameter(manifest, name, value)?);
    }
    priors(&mut entry, command)?;
    let mission = super::validate::mission(command.mission.as_deref())?;
    let addition = Addition { entry, comment, diagnosed: diagnosed.as_ref().map(values).unwrap_or_default() };
    let added = adding::add(&command.model, &super::registry(global)?, &mission, &[addition])?;
    Ok(done(&command.model, &added.before, added.committed.as_ref(), None, global, paint))
}

/// Values of a candidate's coefficients by name.
fn values(candidate: &Value) -> Vec<(String, f64)> {
    let all = candidate["coefficients"].as_array().into_iter().flatten();
    all.filter_map(|c| Some((c["name"].as_str()?.to_owned(), c["value"].as_f64()?))).collect()
}

/// A parameter's value as the plugin declares it: texts need no quotes, lists no brackets.
fn parameter(manifest: &Manifest, name: &str, value: &str) -> Result<toml::Value, Failure> {
    let declared = manifest.parameters.iter().find(|p| p.name == name).map(|p| p.kind);
    let literal = |text: &str| text.parse::<toml::Value>().ok();
    let bracketed = || literal(value).filter(toml::Value::is_array);
    let parsed = match declared {
        Some(ParameterType::Text) => literal(value).filter(toml::Value::is_str).or_else(|| Some(value.into())),
        Some(ParameterType::TextList) => {
            let texts = value.split(',').map(|v| toml::Value::from(v.trim()));
            bracketed().or_else(|| Some(toml::Value::Array(texts.collect())))
        }
        Some(ParameterType::F64List) => bracketed().or_else(|| literal(&format!("[{value}]"))),
        _ => literal(value),
    };
    Ok(parsed.ok_or_else(|| format!("--set {name}={value}: the value is no number, truth or text in quotes"))?)
}

/// Priors of the command line; a value without a name belongs to the only coefficient that an effect may have.
fn priors(entry: &mut EffectEntry, command: &ModelAdd) -> Result<(), Failure> {
    let whole = entry.coefficient();
    let only = whole.rsplit('.').next().unwrap_or_default().to_owned();
    let mut put = |numbers: &[(Option<String>, f64)], set: fn(&mut Prior, f64)| {
        for (name, number) in numbers {
            set(entry.prior.entry(name.clone().unwrap_or_else(|| only.clone())).or_default(), *number);
        }
    };
    put(&command.value, |prior, number| prior.value = Some(number));
    put(&command.fixed, |prior, number| prior.value = Some(number));
    put(&command.prior_sigma, |prior, number| prior.sigma = Some(number));
    entry.estimate = command.fixed.is_empty();
    if let Some((_, sigma)) = command.prior_sigma.iter().find(|(_, sigma)| *sigma <= 0.0) {
        return Err(format!("--prior-sigma {sigma}: a standard deviation is above zero").into());
    }
    Ok(())
}

/// The candidate of a diagnosis: the named one, or that of a rank.
fn candidate(path: &Path, effect: Option<&str>, rank: Option<u16>) -> Result<Value, Failure> {
    let text = std::fs::read_to_string(path).at("read", path)?;
    let refuse = |what: String| Refusal::Diagnosis { path: path.to_owned(), what };
    let diagnosis: Value = serde_json::from_str(&text).map_err(|e| refuse(format!("it is no JSON: {e}")))?;
    let Some(candidates) = diagnosis["candidates"].as_array() else {
        return Err(
            refuse("it has no `candidates`; write it with `dragfree diagnose PRODUCT --json`".to_owned()).into()
        );
    };
    let formulas = diagnosis["formulas"].as_array();
    let accepted = |c: &&Value| c["accepted"] == true;
    let (named, others): (Vec<&Value>, Vec<&Value>) = candidates.iter().partition(accepted);
    let candidates: Vec<&Value> = named.into_iter().chain(formulas.into_iter().flatten()).chain(others).collect();
    let name = |c: &&Value| format!("{}:{}", word(&c["effect"]), word(&c["instance"]));
    let names: Vec<String> = candidates.iter().map(name).collect();
    if names.is_empty() {
        return Err(refuse(format!(
            "it has no candidate (verdict: {}), so there is nothing to add",
            word(&diagnosis["verdict"])
        ))
        .into());
    }
    let at = match effect {
        None => usize::from(rank.unwrap_or(1)) - 1,
        Some(effect) => {
            let wanted = if effect.contains(':') { effect.to_owned() } else { format!("{effect}:") };
            let fits = |n: &String| *n == wanted || (!effect.contains(':') && n.starts_with(&wanted));
            names.iter().position(fits).unwrap_or(usize::MAX)
        }
    };
    Ok(candidates.get(at).copied().cloned().ok_or_else(|| {
        let asked = effect.map_or_else(|| format!("rank {}", at + 1), |effect| format!("candidate {effect}"));
        refuse(format!("it has no {asked}; it has {}", names.join(", ")))
    })?)
}

fn word(value: &Value) -> &str {
    value.as_str().unwrap_or_default()
}

/// The effect of a candidate, with the shape that fits best.
fn proposed(path: &Path, candidate: &Value) -> Result<EffectEntry, Failure> {
    let mut entry = EffectEntry::new(word(&candidate["effect"]), word(&candidate["instance"]));
    for (name, value) in candidate["shape"].as_object().into_iter().flatten() {
        let what = |e| Refusal::Diagnosis { path: path.to_owned(), what: format!("shape.{name} = {value}: {e}") };
        entry.parameters.insert(name.clone(), toml::Value::try_from(value).map_err(what)?);
    }
    Ok(entry)
}

/// Why the effect is there, for whoever reads the file.
fn evidence(candidate: &Value) -> String {
    let number = |key: &str| candidate[key].as_f64().unwrap_or(f64::NAN);
    let (unit, factor) = text::readable_unit(word(&candidate["unit"]));
    let size = format!("{} {unit}", text::measured(number("value") * factor, number("sigma") * factor));
    format!("diagnosed: {}, Δχ² {:.0}", size.trim_end(), number("delta_chi2"))
}

fn fix(command: &ModelFix, global: &Global, paint: Paint) -> Result<Done, Failure> {
    let product = products::open(&command.product, &command.archive.folder()?)?.product;
    let out = command.out.clone().unwrap_or_else(|| command.model.with_extension("fixed.toml"));
    if out.canonicalize().ok().is_some_and(|out| command.model.canonicalize().ok() == Some(out)) {
        return Err(
            "--out is the model file itself: what is fixed there could not be estimated again; name another file"
                .into(),
        );
    }
    let adopted = product.result.adopted();
    let solution = adopted.first().map(|c| c.solution.as_str()).unwrap_or_default();
    let values: Vec<(String, f64)> = adopted.iter().map(|c| (c.name.clone(), c.value)).collect();
    let mut edit = Edit::begin_or_new(&out)?;
    edit.fix(&command.model, &product.model.revision, (product.id(), &values), &command.keep)?;
    let committed = edit.commit()?;
    let mut made = done(&out, "", committed.as_ref(), Some(&command.archive.folder()?), global, paint);
    if !global.json {
        made.text = format!("fixed     at the values of {} ({solution})\n", product.id()) + &made.text;
    }
    Ok(made)
}

fn show(path: &Path, revision: Option<&str>, json: bool, paint: Paint) -> Result<Done, Failure> {
    let model = match revision {
        None => Model::load(path)?,
        Some(revision) => revisions::find(path, revision)?.0,
    };
    let (name, parent) = model.identity();
    if json {
        return Ok(Done::json(&json!({
            "path": model.path.to_string_lossy(),
            "revision": name,
            "parent": parent,
            "edited_by_hand": model.edited_by_hand(),
            "effects": model.effects,
        })));
    }
    let mut text = paint.bold(&format!("model {name}"));
    text += &parent.map_or(String::new(), |parent| format!(", from {parent}"));
    text += "\n\n";
    if model.effects.is_empty() {
        text += "no effect; `dragfree model add MODEL.toml EFFECT:INSTANCE` adds one\n";
    } else {
        text += &effects(&model.effects);
    }
    text += &format!("\nfile      {}\n", model.path.display());
    if model.edited_by_hand() {
        let words = "edited by hand since that revision was made; `dragfree model commit` makes a revision of it";
        text += &labelled("note", words).replacen("edited by hand", &paint.doubtful("edited by hand"), 1);
    }
    Ok(Done::new(text))
}

/// A row per effect; what a prior or a parameter says goes below where the row would be too wide.
fn effects(effects: &[EffectEntry]) -> String {
    let row = |e: &EffectEntry| {
        let state = if e.estimate { "estimated" } else { "fixed" };
        let instance = if e.instance.is_empty() { "-" } else { &e.instance };
        vec![e.id.clone(), instance.to_owned(), state.to_owned(), prior(e).join("; "), parameters(e).join(", ")]
    };
    let rows = table(&["effect", "instance", "coefficients", "prior", "parameters"], effects.iter().map(row));
    let wide = columns(&rows);
    if text::fits(&wide) {
        return wide;
    }
    let short: Vec<_> = rows.iter().map(|row| row[..3].to_vec()).collect();
    let mut narrow = String::new();
    for (line, effect) in columns(&short).lines().zip(std::iter::once(None).chain(effects.iter().map(Some))) {
        narrow += &format!("{line}\n");
        let Some(effect) = effect else { continue };
        for (label, words) in [("  prior", prior(effect)), ("  with", parameters(effect))] {
            for word in words {
                narrow += &labelled(label, &word);
            }
        }
    }
    narrow
}

fn prior(effect: &EffectEntry) -> Vec<String> {
    let one = |(name, prior): (&String, &Prior)| {
        let mut words = vec![name.clone()];
        words.extend(prior.value.map(|value| format!("= {}", exact(value))));
        words.extend(prior.sigma.map(|sigma| format!("± {}", exact(sigma))));
        let end = |end: Option<f64>| end.map_or_else(|| "…".to_owned(), exact);
        if prior.lower.is_some() || prior.upper.is_some() {
            words.push(format!("in [{}, {}]", end(prior.lower), end(prior.upper)));
        }
        words.join(" ")
    };
    effect.prior.iter().map(one).collect()
}

/// Every digit, and no row of zeros.
fn exact(number: f64) -> String {
    if number == 0.0 || (1e-3..1e6).contains(&number.abs()) { number.to_string() } else { format!("{number:e}") }
}

fn parameters(effect: &EffectEntry) -> Vec<String> {
    effect.parameters.iter().map(|(name, value)| format!("{name} = {value}")).collect()
}

fn log_text(log: &Log, paint: Paint) -> String {
    let mut rows = table(&["", "revision", "parent", "changes"], []);
    for revision in &log.revisions {
        let mark = match revision.place {
            Place::Current => "*",
            Place::Ancestor => "|",
            Place::Aside => "",
        };
        let told: Vec<String> = changes(revision);
        let name =
            if revision.edited { format!("{} (edited)", revision.model.revision) } else { revision.revision.clone() };
        let parent = revision.parent.clone().unwrap_or_else(|| "-".to_owned());
        let first = told.first().cloned().unwrap_or_default();
        rows.push(vec![mark.to_owned(), name, parent, first]);
        rows.extend(told.into_iter().skip(1).map(|more| vec![String::new(), String::new(), String::new(), more]));
    }
    let mut text = columns(&rows);
    if log.revisions.iter().any(|r| r.place == Place::Aside) {
        text += "\n* is the file, | led to it; the others stand aside, `dragfree model restore` brings one back\n";
    }
    for revision in log.revisions.iter().filter(|r| r.edited) {
        let words = format!(
            "by hand since revision {}; `dragfree model commit` makes a revision of it",
            revision.model.revision
        );
        text += &labelled("edited", &words).replacen("edited", &paint.doubtful("edited"), 1);
    }
    for Problem { path, reason } in &log.problems {
        text += &format!("{} {reason}\n          {}\n", paint.doubtful("not used:"), path.display());
    }
    text
}

/// `+ es-gain:tm1.y`, `− thermal:tm1.x`, `~ com-offset:tm1 (prior)`.
fn changes(revision: &Logged) -> Vec<String> {
    let told: Vec<String> = revision
        .changes
        .iter()
        .map(|change| match &change.what {
            What::Added => format!("+ {}", change.effect),
            What::Removed => format!("− {}", change.effect),
            What::Changed(keys) => format!("~ {} ({})", change.effect, keys.join(", ")),
        })
        .collect();
    if told.is_empty() { vec!["the same effects".to_owned()] } else { told }
}

fn log_json(log: &Log) -> Value {
    let revision = |r: &Logged| {
        json!({
            "revision": r.revision,
            "parent": r.parent,
            "place": r.place,
            "edited_by_hand": r.edited,
            "changes": r.changes,
            "effects": r.model.effects,
            "path": r.model.path.to_string_lossy(),
        })
    };
    json!({
        "revisions": log.revisions.iter().map(revision).collect::<Vec<_>>(),
        "problems": problems_json(&log.problems),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn entry(instance: &str) -> EffectEntry {
        EffectEntry::new("thermal", instance)
    }

    #[test]
    fn a_model_fits_the_screen_whatever_stands_in_it() {
        let mut plain = entry("tm1.x");
        plain.prior.insert("x".into(), Prior { sigma: Some(0.05), ..Prior::default() });
        let narrow = effects(std::slice::from_ref(&plain));
        assert_eq!(narrow.lines().nth(1), Some("thermal  tm1.x     estimated     x ± 0.05"), "{narrow}");
        plain.parameters.insert("source".into(), "hk.electronics_box_panel_plus_y_temperature_k".into());
        plain.prior.insert("y".into(), Prior { value: Some(-1.25e-12), lower: Some(-1e-11), ..Prior::default() });
        let wide = effects(&[plain, entry("tm2.z")]);
        assert!(wide.lines().all(|line| text::width(line) <= text::WIDTH), "{wide}");
        assert!(wide.contains("y = -1.25e-12 in [-1e-11, …]") && wide.contains("temperature_k"), "{wide}");
    }

    #[test]
    fn parameters_are_read_as_the_plugin_declares_them() {
        let manifest: Manifest = serde_json::from_value(json!({
            "id": "thermal", "version": "0.1.0", "licence": "MIT", "description": "",
            "parameters": [
                {"name": "lag_s", "type": "f64", "default": 0.0},
                {"name": "from", "type": "text", "default": ""},
                {"name": "names", "type": "text_list", "default": []},
                {"name": "edges", "type": "f64_list", "default": []},
            ],
        }))
        .expect("a manifest");
        for (name, value, wanted) in [
            ("lag_s", "480", "480"),
            ("from", "hk.a", "\"hk.a\""),
            ("from", "\"hk.a\"", "\"hk.a\""),
            ("from", "480", "\"480\""),
            ("names", "a, b", "[\"a\", \"b\"]"),
            ("edges", "1, 2.5", "[1, 2.5]"),
            ("edges", "[1.0]", "[1.0]"),
            ("unknown", "true", "true"),
        ] {
            assert_eq!(parameter(&manifest, name, value).expect(value).to_string(), wanted);
        }
        assert!(parameter(&manifest, "lag_s", "long").is_err());
    }

    #[test]
    fn a_diagnosis_gives_effect_shape_and_evidence() {
        let folder = tempfile::tempdir().expect("folder");
        let path = folder.path().join("d.json");
        let text = json!({"verdict": "missing", "candidates": [
            {"effect": "thermal", "instance": "tm1.x", "value": 2.7e-12, "sigma": 4e-14, "unit": "m s-2 K-1",
             "shape": {"lag_s": 480.0, "from": "hk.a"}, "delta_chi2": 4175.2},
            {"effect": "es-gain", "instance": "tm2.y", "value": 0.027, "sigma": 0.004, "unit": "1", "shape": {}},
        ]});
        std::fs::write(&path, text.to_string()).expect("written");
        let first = candidate(&path, None, None).expect("the first");
        let entry = proposed(&path, &first).expect("an effect");
        assert_eq!(entry.to_string(), "thermal:tm1.x");
        assert_eq!(parameters(&entry), ["lag_s = 480.0", "from = \"hk.a\""]);
        let number = json!({"value": 0.5, "sigma": 0.01, "unit": "1", "delta_chi2": 9.0});
        assert_eq!(evidence(&number), "diagnosed: 0.500 ± 0.010, Δχ² 9", "the unit of a number is none");
        assert_eq!(evidence(&first), "diagnosed: (2.700 ± 0.040)e-12 m s-2 K-1, Δχ² 4175");
        assert_eq!(candidate(&path, None, Some(2)).expect("the second")["instance"], "tm2.y");
        assert_eq!(candidate(&path, Some("es-gain:tm2.y"), None).expect("by name")["instance"], "tm2.y");
        assert_eq!(candidate(&path, Some("es-gain"), None).expect("by id")["instance"], "tm2.y");
        for (effect, rank, part) in [
            (Some("es-gain:tm1.y"), None, "no candidate es-gain:tm1.y; it has thermal:tm1.x, es-gain:tm2.y"),
            (None, Some(3), "no rank 3; it has"),
        ] {
            let error = candidate(&path, effect, rank).expect_err(part).to_string();
            assert!(error.contains(part), "{error}");
        }
        std::fs::write(&path, "{\"verdict\": \"sufficient\", \"candidates\": []}").expect("written");
        let error = candidate(&path, None, None).expect_err("none").to_string();
        assert!(error.contains("nothing to add"), "{error}");
    }
}
