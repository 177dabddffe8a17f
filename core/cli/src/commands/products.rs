//! `dragfree products`.

use super::Done;
use crate::args::Products;
use crate::failure::{Failure, Refusal};
use crate::screen;
use crate::text::Paint;
use dragfree_engine::product::{self, Written};
use std::path::Path;

pub(super) fn execute(command: &Products, json: bool, paint: Paint) -> Result<Done, Failure> {
    match command {
        Products::List(archive) => {
            exists(&archive.folder)?;
            let listing = product::list(&archive.folder)?;
            if json {
                return Ok(Done::json(&screen::listing_json(&listing)));
            }
            Ok(Done::new(screen::listing(&listing, &archive.folder, paint)))
        }
        Products::Show { product, archive } => show(product, &archive.folder, json, paint),
    }
}

/// A product by its file, or by a name in the archive, and its file.
pub(super) fn open(name: &str, archive: &Path) -> Result<Written, Failure> {
    let file = Path::new(name);
    if file.is_file() {
        return Ok(Written { product: product::read(file)?, path: file.to_owned() });
    }
    exists(archive)?;
    let entry = product::find(archive, name)?;
    Ok(Written { product: entry.product, path: entry.path })
}

/// Products by their names; `DAY..DAY` stands for the latest of every day that has one.
pub(super) fn open_all(names: &[String], archive: &Path) -> Result<Vec<Written>, Failure> {
    let mut all = Vec::new();
    for name in names {
        let days = name.split_once("..").and_then(|(a, b)| Some((a.parse().ok()?, b.parse().ok()?)));
        match days.filter(|_| !Path::new(name).is_file()) {
            Some((first, last)) => {
                exists(archive)?;
                let entries = product::find_days(archive, first, last)?;
                all.extend(entries.into_iter().map(|entry| Written { product: entry.product, path: entry.path }));
            }
            None => all.push(open(name, archive)?),
        }
    }
    Ok(all)
}

/// `name` is a product's file, or a name in the archive.
fn show(name: &str, archive: &Path, json: bool, paint: Paint) -> Result<Done, Failure> {
    let Written { product, path } = open(name, archive)?;
    if json {
        return Ok(Done::json(&product::to_json(&product, &path)));
    }
    Ok(Done::new(screen::product(&product, &path, paint)))
}

fn exists(archive: &Path) -> Result<(), Failure> {
    if archive.is_dir() { Ok(()) } else { Err(Refusal::NoArchive(archive.to_owned()).into()) }
}
