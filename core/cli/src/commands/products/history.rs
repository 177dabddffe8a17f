//! `dragfree products diff` and `lineage`.

use crate::commands::Done;
use crate::failure::Failure;
use crate::text::{self, Paint};
use dragfree_archive::files::IoContext as _;
use dragfree_archive::product::Stage;
use dragfree_pages::pictures::{self, is_data, short};
use dragfree_workflow::provenance::{self, Change, Diff, Lineage};
use std::fmt::Write as _;
use std::path::Path;

pub(super) fn diff(names: [&str; 2], folder: &Path, json: bool, paint: Paint) -> Result<Done, Failure> {
    let [first, second] = [super::open(names[0], folder)?, super::open(names[1], folder)?];
    let diff = provenance::diff(&first.product, &second.product);
    if json {
        return Ok(Done::json(&serde_json::to_value(&diff)?));
    }
    let mut text = format!("first     {}\nsecond    {}\n", diff.first, diff.second);
    if diff.same {
        let _ = writeln!(text, "digest    {}: the same result from the same inputs", paint.good("same"));
    }
    Ok(Done::new(text + &differences(&diff, paint)))
}

/// Values, then everything else that is not the same.
pub(super) fn differences(diff: &Diff, paint: Paint) -> String {
    let mut screen = String::new();
    if !diff.values.is_empty() {
        let row = |c: &provenance::ValueChange| {
            let (unit, factor) = text::readable_unit(&c.unit);
            let value = |x: Option<f64>, s: Option<f64>| {
                x.map_or_else(|| "-".to_owned(), |x| text::measured(x * factor, s.unwrap_or(f64::NAN) * factor))
            };
            vec![
                c.name.clone(),
                value(c.first, c.first_sigma),
                value(c.second, c.second_sigma),
                unit.to_owned(),
                c.sigmas.map_or_else(|| "-".to_owned(), |q| format!("{q:+.2} σ")),
            ]
        };
        let heading = ["coefficient", "first", "second", "unit", "difference"];
        screen += "\n";
        let table = text::columns(&text::table(&heading, diff.values.iter().map(row)));
        screen += &if text::fits(&table) { table } else { stacked(&heading, diff.values.iter().map(row)) };
    }
    let parts = [
        ("inputs", &diff.inputs),
        ("plugins", &diff.plugins),
        ("parameters", &diff.parameters),
        ("model", &diff.model),
        ("other", &diff.other),
    ];
    for (name, changes) in parts.into_iter().filter(|(_, changes)| !changes.is_empty()) {
        let _ = writeln!(screen, "\n{}", paint.bold(name));
        for Change { what, first, second } in changes {
            let side = |side: &Option<String>| side.as_deref().map_or_else(|| "not there".to_owned(), short_digests);
            screen += &text::labelled("", what);
            screen += &text::labelled("            first  ", &side(first));
            screen += &text::labelled("            second ", &side(second));
        }
    }
    if parts.iter().all(|(_, changes)| changes.is_empty()) {
        screen += "\ninputs, plugins, parameters and model are the same\n";
    }
    screen
}

pub(super) fn lineage(
    name: &str,
    folder: &Path,
    picture: Option<&Path>,
    json: bool,
    paint: Paint,
) -> Result<Done, Failure> {
    let archive = super::archive(folder)?;
    let id = archive.find(name)?.row.id;
    let lineage = provenance::lineage(&archive, &id)?;
    if let Some(path) = picture {
        std::fs::write(path, pictures::lineage(&lineage)?).at("write", path)?;
    }
    if json {
        return Ok(Done::json(&serde_json::to_value(&lineage)?));
    }
    let mut text = told(&lineage, paint);
    if let Some(path) = picture {
        let _ = writeln!(text, "picture   {}", path.display());
    }
    Ok(Done::new(text))
}

/// Rows whose first cell, a name, stands on a line of its own.
fn stacked(heading: &[&str], rows: impl Iterator<Item = Vec<String>>) -> String {
    let (names, mut rest): (Vec<String>, Vec<Vec<String>>) =
        text::table(heading, rows).into_iter().map(|mut row| (row.remove(0), row)).unzip();
    rest.iter_mut().for_each(|row| row.insert(0, String::new()));
    let below = text::columns(&rest);
    names.iter().zip(below.lines()).map(|(name, values)| format!("{name}\n{values}\n")).collect()
}

/// A text with the start of each digest in it alone.
fn short_digests(words: &str) -> String {
    let is_digest = |word: &str| word.len() == 64 && word.bytes().all(|b| b.is_ascii_hexdigit());
    words.split(' ').map(|word| if is_digest(word) { short(word) } else { word }).collect::<Vec<_>>().join(" ")
}

/// Role of the products that one of many days was made of.
const PRODUCT: &str = "product";

fn told(l: &Lineage, paint: Paint) -> String {
    let mut text = format!("{}\n", paint.bold(&l.product.id));
    if let Some(reason) = &l.product.withdrawn {
        text += &text::labelled("withdrawn", reason);
    }
    text += "\nmade of\n";
    for place in l.inputs.iter().filter(is_data) {
        // Products lie in the archive, under another digest: theirs leaves out when they were made.
        let there = place.role == PRODUCT || place.path.as_ref().is_some_and(|path| path.is_file());
        let gone = if there { String::new() } else { format!(", {}", paint.doubtful("not there any more")) };
        let _ = writeln!(text, "  {:<9}  {}  {}{gone}", place.role, short(&place.sha256), place.name);
        if let Some(path) = &place.path {
            let _ = writeln!(text, "             {}", path.display());
        }
    }
    for place in l.kept.iter().filter(|place| place.role != "state_out") {
        let role = if place.role == "state_in" { "state" } else { &place.role };
        let _ = writeln!(text, "  {role:<9}  {}  {}", short(&place.sha256), place.name);
    }
    for stage in &l.plugins {
        let Stage { version, library_sha256, .. } = stage;
        let colon = if stage.instance.is_empty() { "" } else { ":" };
        let name = format!("{}{colon}{}", stage.plugin, stage.instance);
        let _ = writeln!(text, "  plugin     {}  {name} {}", short(library_sha256), version);
    }
    for id in &l.resumed {
        let _ = writeln!(text, "  after      {id}");
    }
    if let Some(id) = &l.supersedes {
        let _ = writeln!(text, "  in place of {id}");
    }
    let of_it = [
        ("superseded by", &l.superseded_by),
        ("resumed by", &l.resumed_by),
        ("entered", &l.entered),
        ("tested on other data by", &l.tested_by),
    ];
    if of_it.iter().any(|(_, ids)| !ids.is_empty()) || !l.certified.is_empty() {
        text += "\nmade of it\n";
    }
    for (what, id) in of_it.into_iter().flat_map(|(what, ids)| ids.iter().map(move |id| (what, id))) {
        let _ = writeln!(text, "  {what} {id}");
    }
    for v in &l.certified {
        let _ = writeln!(text, "  set {} from {}", v.set, crate::utc::format(v.from_ns));
    }
    text
}
