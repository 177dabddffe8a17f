//! `dragfree products`.

use super::Done;
use crate::args::Products;
use crate::failure::{Failure, Refusal};
use crate::screen;
use crate::text::Paint;
use dragfree_archive::product;
use dragfree_archive::{Archive, Find, Written};
use std::path::Path;

pub(super) fn execute(command: &Products, json: bool, paint: Paint) -> Result<Done, Failure> {
    match command {
        Products::List(list) => {
            let find = Find {
                from: list.from,
                until: list.until,
                spacecraft: list.spacecraft.clone(),
                verdict: list.verdict.clone(),
                model: list.model.clone(),
                set: list.set.clone(),
                latest: list.latest,
            };
            let folder = &list.archive.folder;
            let listing = archive(folder)?.list(&find)?;
            if json {
                return Ok(Done::json(&screen::listing_json(&listing)));
            }
            Ok(Done::new(screen::listing(&listing, folder, paint)))
        }
        Products::Show { product, archive } => show(product, &archive.folder, json, paint),
    }
}

/// The archive of a folder.
pub(super) fn archive(folder: &Path) -> Result<Archive, Failure> {
    if folder.is_dir() { Ok(Archive::open(folder)?) } else { Err(Refusal::NoArchive(folder.to_owned()).into()) }
}

/// A product by its file, or by a name in the archive, compared with what was archived.
pub(super) fn open(name: &str, folder: &Path) -> Result<Written, Failure> {
    let file = Path::new(name);
    if !file.is_file() {
        let archive = archive(folder)?;
        let path = archive.find(name)?.path;
        return read(&archive, &path);
    }
    match Archive::of(file) {
        Ok(archive) => read(&archive, file),
        // A copy outside of any archive has its own digest alone.
        Err(_) => Ok(Written { product: product::read(file)?, path: file.to_owned() }),
    }
}

fn read(archive: &Archive, path: &Path) -> Result<Written, Failure> {
    let id = path.file_stem().unwrap_or_default().to_string_lossy();
    Ok(Written { product: archive.product(&id)?, path: path.to_owned() })
}

/// Products by their names; `DAY..DAY` stands for the newest of every day that has one.
pub(super) fn open_all(names: &[String], folder: &Path) -> Result<Vec<Written>, Failure> {
    let mut all = Vec::new();
    for name in names {
        let days = name.split_once("..").and_then(|(a, b)| Some((a.parse().ok()?, b.parse().ok()?)));
        match days.filter(|_| !Path::new(name).is_file()) {
            Some((first, last)) => {
                let archive = archive(folder)?;
                for entry in archive.find_days(first, last)? {
                    all.push(read(&archive, &entry.path)?);
                }
            }
            None => all.push(open(name, folder)?),
        }
    }
    Ok(all)
}

/// `name` is a product's file, or a name in the archive.
fn show(name: &str, folder: &Path, json: bool, paint: Paint) -> Result<Done, Failure> {
    let Written { product, path } = open(name, folder)?;
    if json {
        return Ok(Done::json(&product::to_json(&product, &path)));
    }
    Ok(Done::new(screen::product(&product, &path, paint)))
}
