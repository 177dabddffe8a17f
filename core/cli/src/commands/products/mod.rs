//! `dragfree products`, `dragfree at`, `dragfree archive`.

mod certify;
mod export;
mod history;
mod parquet;
mod verify;

use super::Done;
use crate::args::{ArchiveCommand, Global, Products};
use crate::failure::{Failure, Refusal};
use crate::screen;
use crate::text::Paint;
pub(super) use certify::at;
use dragfree_archive::product;
use dragfree_archive::{Archive, Find, Written};
use std::path::{Path, PathBuf};

pub(super) fn execute(command: &Products, global: &Global, paint: Paint) -> Result<Done, Failure> {
    let json = global.json;
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
            let folder = &list.archive.folder()?;
            let listing = archive(folder)?.list(&find)?;
            if json {
                return Ok(Done::json(&screen::listing_json(&listing)));
            }
            Ok(Done::new(screen::listing(&listing, folder, paint)))
        }
        Products::Show { product, archive } => show(product, &archive.folder()?, json, paint),
        Products::Diff { first, second, archive } => history::diff([first, second], &archive.folder()?, json, paint),
        Products::Lineage { product, picture, archive } => {
            history::lineage(product, &archive.folder()?, picture.as_deref(), json, paint)
        }
        Products::Verify { products, archive, .. } => verify::verify(products, &archive.folder()?, json, paint),
        Products::Rebuild { product, archive, inputs } => {
            verify::rebuild(product, &archive.folder()?, &inputs.folders, global, paint)
        }
        Products::Stale(ops) => super::days::stale(ops, global, paint),
        Products::Withdraw { product, reason, archive } => certify::withdraw(product, reason, &archive.folder()?, json),
        Products::Certify { product, from, until, set, archive, .. } => {
            certify::certify(product, set, (*from, *until), &archive.folder()?, json)
        }
        Products::Decertify { set, spacecraft, from, until, archive } => {
            certify::decertify(set, spacecraft, (*from, *until), &archive.folder()?, json)
        }
        Products::Sets(command) => certify::sets(command, json),
        Products::Export { product, format, out, archive } => {
            export::execute(product, *format, out.as_deref(), &archive.folder()?)
        }
    }
}

/// `dragfree archive`.
pub(super) fn of_archive(command: &ArchiveCommand, json: bool) -> Result<Done, Failure> {
    match command {
        ArchiveCommand::Reindex(archive) => {
            exists(&archive.folder()?)?;
            let events = Archive::reindex(&archive.folder()?)?;
            if json {
                return Ok(Done::json(&serde_json::json!({"events": events})));
            }
            Ok(Done::new(format!("catalogue made again from {events} events\n")))
        }
        ArchiveCommand::Migrate(archive) => {
            exists(&archive.folder()?)?;
            let migrated = dragfree_archive::migrate(&archive.folder()?, &super::stamp())?;
            let code = u8::from(!migrated.problems.is_empty());
            if json {
                let problems = screen::problems_json(&migrated.problems);
                let value = serde_json::json!({"products": migrated.products, "problems": problems});
                return Ok(Done { code, ..Done::json(&value) });
            }
            let mut text = format!("{} products taken over\n", migrated.products.len());
            for problem in &migrated.problems {
                text += &crate::text::labelled("left", &problem.reason);
            }
            Ok(Done { text, code })
        }
    }
}

/// A result as JSON, with the products that it is of and the program that says it.
pub(super) fn said_of(products: &[Written], result: &impl serde::Serialize) -> Result<serde_json::Value, Failure> {
    let of = |w: &Written| {
        serde_json::json!({
            "id": w.product.id(),
            "sha256": w.product.header.non_standard_attributes.sha256,
            "model": w.product.model.revision,
            "software_version": w.product.header.non_standard_attributes.software_version,
        })
    };
    let mut value = serde_json::to_value(result)?;
    value["products"] = products.iter().map(of).collect();
    value["software_version"] = super::SOFTWARE.into();
    Ok(value)
}

/// Looks for inputs of products that are not where they were.
pub(super) fn look_for(products: &[Written], folders: &[PathBuf]) -> Result<(), Failure> {
    for written in products.iter().filter(|_| !folders.is_empty()) {
        Archive::of(&written.path)?.look_in(folders, &[written.product.id()], &super::stamp())?;
    }
    Ok(())
}

/// The archive of a folder.
pub(super) fn archive(folder: &Path) -> Result<Archive, Failure> {
    exists(folder)?;
    Ok(Archive::open(folder)?)
}

fn exists(folder: &Path) -> Result<(), Failure> {
    if folder.is_dir() { Ok(()) } else { Err(Refusal::NoArchive(folder.to_owned()).into()) }
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
