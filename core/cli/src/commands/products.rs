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
