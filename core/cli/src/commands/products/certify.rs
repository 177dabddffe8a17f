//! Which products hold: withdrawn ones, sets of certified ones, and what holds at a time.

use crate::args::{At, Sets};
use crate::commands::{Done, stamp};
use crate::failure::Failure;
use crate::text::{self, Paint};
use crate::utc;
use dragfree_archive::files::{IoContext as _, read_text};
use dragfree_archive::{Archive, PublicKey, SetState, Validity, Window};
use dragfree_engine::limits::CONFIG_BYTES;
use dragfree_workflow::joint;
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use std::fmt::Write as _;
use std::path::Path;

pub(super) fn withdraw(name: &str, reason: &str, folder: &Path, json: bool) -> Result<Done, Failure> {
    let mut archive = super::archive(folder)?;
    let id = archive.find(name)?.row.id;
    let certified: Vec<Validity> = archive.validity(None)?.into_iter().filter(|v| v.id == id).collect();
    archive.withdraw(&id, reason, &stamp())?;
    if json {
        return Ok(Done::json(&json!({"id": id, "reason": reason, "certified": certified})));
    }
    let mut text = format!("withdrawn {id}\n");
    for v in certified {
        let words = format!(
            "set {} still names it, {}: `dragfree products decertify` takes that out of an open set; a published one is \
             invalidated (`sets invalidate`), and another takes its place",
            v.set,
            window(&v)
        );
        text += &text::labelled("note", &words);
    }
    Ok(Done::new(text))
}

pub(super) fn certify(
    name: &str,
    set: &str,
    (from_ns, until_ns): (i64, Option<i64>),
    folder: &Path,
    json: bool,
) -> Result<Done, Failure> {
    let mut archive = super::archive(folder)?;
    let row = archive.find(name)?.row;
    archive.certify(&row.id, set, Window { from_ns: Some(from_ns), until_ns }, &stamp())?;
    if json {
        return Ok(Done::json(&json!({"id": row.id, "set": set, "from_ns": from_ns, "until_ns": until_ns})));
    }
    let until = until_ns.map_or_else(|| "further notice".to_owned(), utc::format);
    let mut text = format!("certified {}\nset       {set}, {} to {until}\n", row.id, utc::format(from_ns));
    if row.verdict.as_deref() != Some("agree") {
        let verdict = row.verdict.as_deref().unwrap_or("none");
        text += &text::labelled("note", &format!("its verdict is not `agree`, it is {verdict}"));
    }
    Ok(Done::new(text))
}

pub(super) fn decertify(
    set: &str,
    spacecraft: &str,
    (from_ns, until_ns): (Option<i64>, Option<i64>),
    folder: &Path,
    json: bool,
) -> Result<Done, Failure> {
    let mut archive = super::archive(folder)?;
    archive.decertify(set, spacecraft, Window { from_ns, until_ns }, &stamp())?;
    told(&archive, Some(set), json)
}

pub(super) fn sets(command: &Sets, json: bool) -> Result<Done, Failure> {
    match command {
        Sets::List(archive) => told(&super::archive(&archive.folder()?)?, None, json),
        Sets::Publish { set, archive } => {
            let mut archive = super::archive(&archive.folder()?)?;
            archive.set_state(set, SetState::Published, "", &stamp())?;
            told(&archive, Some(set), json)
        }
        Sets::Invalidate { set, reason, archive } => {
            let mut archive = super::archive(&archive.folder()?)?;
            archive.set_state(set, SetState::Invalidated, reason, &stamp())?;
            told(&archive, Some(set), json)
        }
        Sets::Statement { set, out, archive } => {
            let text = Statement::of(&super::archive(&archive.folder()?)?, set)?.text()?;
            if let Some(path) = out {
                std::fs::write(path, &text).at("write", path)?;
            }
            let path = out.as_ref().map(|path| path.display().to_string());
            match &path {
                _ if json => Ok(Done::json(&json!({"set": set, "statement": text, "path": path}))),
                Some(path) => Ok(Done::new(format!("written   {path}\n"))),
                None => Ok(Done::new(text)),
            }
        }
        Sets::Check { statement, key, archive } => {
            check(&super::archive(&archive.folder()?)?, statement, &crate::commands::public_key("--key", key)?, json)
        }
    }
}

/// What a set says, for who signs it.
#[derive(Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Statement {
    set: String,
    state: String,
    #[serde(default, rename = "holds", skip_serializing_if = "Vec::is_empty")]
    all: Vec<Holds>,
}

/// A product and the time for which it holds.
#[derive(Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Holds {
    spacecraft: String,
    /// UTC, or `the beginning`.
    from: String,
    /// UTC, exclusive, or `further notice`.
    until: String,
    product: String,
    /// Digest of the product.
    sha256: String,
}

impl Statement {
    /// What the archive says now. Each product is compared with its digests.
    fn of(archive: &Archive, set: &str) -> Result<Self, Failure> {
        let sets = archive.sets()?;
        let Some((set, state)) = sets.into_iter().find(|(name, _)| name == set) else {
            return Err(format!("there is no set {set}; `dragfree products sets list` shows all").into());
        };
        let holds = |v: &Validity| -> Result<Holds, Failure> {
            let product = archive.product(&v.id)?;
            archive.verify_kept(&v.id)?;
            Ok(Holds {
                spacecraft: v.spacecraft.clone(),
                from: edge(v.from_ns),
                until: edge(v.until_ns),
                product: v.id.clone(),
                sha256: product.header.non_standard_attributes.sha256,
            })
        };
        let all = archive.validity(Some(&set))?.iter().map(holds).collect::<Result<_, _>>()?;
        Ok(Self { set, state, all })
    }

    fn text(&self) -> Result<String, Failure> {
        Ok(toml::to_string(self).map_err(|error| error.to_string())?)
    }
}

/// `sets check`: the signature, then the archive.
fn check(archive: &Archive, path: &Path, key: &PublicKey, json: bool) -> Result<Done, Failure> {
    let text = read_text(path, CONFIG_BYTES).map_err(|error| format!("{} cannot be read: {error}", path.display()))?;
    key.check(path, &text)?;
    let signed: Statement =
        toml::from_str(&text).map_err(|error| format!("{} is no statement of a set: {error}", path.display()))?;
    let now = Statement::of(archive, &signed.set)?;
    let words = |h: &Holds| format!("{} from {} to {} ({})", h.product, h.from, h.until, &h.sha256);
    let mut differs = Vec::new();
    if signed.state != now.state {
        differs.push(format!("the set was {}, and is {}", signed.state, now.state));
    }
    let only = |a: &[Holds], b: &[Holds]| a.iter().filter(|h| !b.contains(h)).map(words).collect::<Vec<_>>();
    differs.extend(only(&signed.all, &now.all).iter().map(|h| format!("no longer: {h}")));
    differs.extend(only(&now.all, &signed.all).iter().map(|h| format!("not signed: {h}")));
    if !differs.is_empty() {
        return Err(format!("set {} is not what {} says: {}", now.set, path.display(), differs.join("; ")).into());
    }
    let (set, products) = (&now.set, now.all.len());
    if json {
        return Ok(Done::json(&json!({"set": set, "state": now.state, "times": products})));
    }
    Ok(Done::new(format!("signed    set {set}, {}: {products} times, as the archive has them\n", now.state)))
}

/// The sets of an archive, or one of them, with what they say.
fn told(archive: &Archive, only: Option<&str>, json: bool) -> Result<Done, Failure> {
    let sets: Vec<(String, String)> =
        archive.sets()?.into_iter().filter(|(name, _)| only.is_none_or(|only| name == only)).collect();
    let mut all = Vec::new();
    let mut text = String::new();
    for (name, state) in sets {
        let times = archive.validity(Some(&name))?;
        let _ = writeln!(text, "set       {name}, {state}");
        for v in &times {
            let withdrawn = archive.row(&v.id)?.withdrawn.map_or("", |_| "  withdrawn");
            let _ = writeln!(text, "          {}\n            {}{withdrawn}", window(v), v.id);
        }
        all.push(json!({"name": name, "state": state, "times": times}));
    }
    if json {
        return Ok(Done::json(&json!({"sets": all})));
    }
    Ok(Done::new(if text.is_empty() { "no set; `dragfree products certify` makes one\n".to_owned() } else { text }))
}

fn edge(ns: i64) -> String {
    match ns {
        i64::MIN => "the beginning".to_owned(),
        i64::MAX => "further notice".to_owned(),
        ns => utc::format(ns),
    }
}

fn window(v: &Validity) -> String {
    format!("{}  {} to {}", v.spacecraft, edge(v.from_ns), edge(v.until_ns))
}

/// `dragfree at`.
pub(in crate::commands) fn at(command: &At, json: bool, paint: Paint) -> Result<Done, Failure> {
    let archive = super::archive(&command.archive.folder()?)?;
    let set = set(&archive, command.set.as_deref())?;
    let holds = |v: &Validity| {
        v.from_ns <= command.time_ns
            && command.time_ns < v.until_ns
            && command.spacecraft.as_ref().is_none_or(|s| *s == v.spacecraft)
    };
    let mut all = archive.validity(Some(&set))?;
    all.retain(holds);
    if all.is_empty() {
        let of = command.spacecraft.as_ref().map_or(String::new(), |s| format!(" for {s}"));
        return Err(format!(
            "set {set} has no valid calibration{of} at {} UTC; `dragfree products sets list` shows its times",
            utc::format(command.time_ns)
        )
        .into());
    }
    let mut text = String::new();
    let mut values = Vec::new();
    for v in &all {
        let row = archive.row(&v.id)?;
        if let Some(reason) = row.withdrawn {
            return Err(format!(
                "set {set} names {}, which is withdrawn: {reason}; take that time out of it and certify another product, or \
                 invalidate the set where it is published",
                v.id
            )
            .into());
        }
        let product = archive.product(&v.id)?;
        let then = joint::at(&product, command.time_ns);
        let solution = then.coefficients.first().map_or("", |c| c.solution.as_str());
        let _ = writeln!(text, "{}", paint.bold(&v.id));
        text += &text::labelled("set", &format!("{set}, {}", window(v)));
        for c in &then.coefficients {
            let (unit, factor) = text::readable_unit(&c.unit);
            let value = text::measured(c.value * factor, c.sigma * factor);
            let _ = writeln!(text, "          {:<28} {value} {unit}", c.name);
        }
        let coefficient = |c: &dragfree_archive::product::Coefficient| -> Value {
            json!({"name": c.name, "value": c.value, "sigma": c.sigma, "unit": c.unit, "frame": c.frame})
        };
        values.push(json!({
            "id": v.id,
            "spacecraft": v.spacecraft,
            "set": set,
            "from_ns": v.from_ns,
            "until_ns": if v.until_ns == i64::MAX { Value::Null } else { json!(v.until_ns) },
            "solution": solution,
            "coefficients": then.coefficients.iter().map(coefficient).collect::<Vec<_>>(),
            "covariance": then.covariance.as_ref().map(|c| &c.matrix),
            "covariance_names": then.covariance.as_ref().map(|c| &c.names),
            "verdict": product.result.verdict,
            "model": product.model.revision,
            "sha256": product.header.non_standard_attributes.sha256,
        }));
    }
    if json {
        return Ok(Done::json(&json!({"time_ns": command.time_ns, "calibrations": values})));
    }
    Ok(Done::new(text))
}

/// The set that is asked: the one named, or the only one that is not invalidated.
fn set(archive: &Archive, named: Option<&str>) -> Result<String, Failure> {
    let sets = archive.sets()?;
    let invalidated = SetState::Invalidated.name();
    let list = |sets: &[&(String, String)]| sets.iter().map(|(name, _)| name.as_str()).collect::<Vec<_>>().join(", ");
    let usable: Vec<&(String, String)> = sets.iter().filter(|(_, state)| state != invalidated).collect();
    match named {
        Some(name) => match sets.iter().find(|(found, _)| found == name) {
            None => Err(format!("there is no set {name}; there are {}", list(&usable)).into()),
            Some((_, state)) if state == invalidated => Err(format!("set {name} is invalidated").into()),
            Some(_) => Ok(name.to_owned()),
        },
        None => match usable.as_slice() {
            [] => Err("nothing is certified; `dragfree products certify` says which product holds when".into()),
            [(name, _)] => Ok(name.clone()),
            several => Err(format!("there are several sets: name one with --set: {}", list(several)).into()),
        },
    }
}
