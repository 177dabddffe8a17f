//! Archives of earlier versions: a folder of products without a journal.

use crate::ArchiveError;
use crate::archive::Archive;
use crate::catalogue::parts;
use crate::files::{IoContext as _, Problem, sha256_of};
use crate::journal::{Event, InputPlace, Stamp, Stored};
use crate::objects::entries;
use crate::product::{self, EXTRACT, Product};
use crate::staging::Staging;
use serde::Deserialize;
use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

/// What came of a migration.
#[derive(Clone, Debug, Default)]
pub struct Migrated {
    /// Products that were taken over.
    pub products: Vec<String>,
    /// Files that were not, with the reason. They stay where they are.
    pub problems: Vec<Problem>,
}

/// Where the inputs of a product lay, as earlier versions wrote it beside the product.
#[derive(Deserialize)]
struct Sources {
    pipeline: PathBuf,
    mission: PathBuf,
    model: PathBuf,
    telemetry: Vec<PathBuf>,
    from_ns: Option<i64>,
    until_ns: Option<i64>,
}

const SOURCES: &str = "sources.json";

/// Takes over the products of a folder that has no journal. One that was stopped goes on where it was.
///
/// # Errors
/// The folder cannot be read or written. What is wrong with a single product is told and leaves the others alone.
pub fn migrate(folder: &Path, stamp: &Stamp<'_>) -> Result<Migrated, ArchiveError> {
    let names = entries(folder)?;
    let mut archive = Archive::create_beside(folder)?;
    let mut migrated = Migrated::default();
    let is_product = |name: &&String| name.ends_with(".toml") && parts(name).is_some();
    for name in names.iter().filter(is_product) {
        let path = folder.join(name);
        let id = name.trim_end_matches(".toml");
        if archive.row(id).is_ok() {
            continue;
        }
        match take_over(&mut archive, folder, &path, stamp) {
            Ok(()) => migrated.products.push(id.to_owned()),
            Err(error @ ArchiveError::Io(_)) => return Err(error),
            Err(error) => migrated.problems.push(Problem { path, reason: error.to_string() }),
        }
    }
    // What only the old form needed goes once everything that it says is in the journal.
    for id in &migrated.products {
        let _ = fs::remove_file(folder.join(format!("{id}.{SOURCES}"))); // one that stays is listed
    }
    for name in names.iter().filter(|name| name.ends_with(".claim")) {
        let _ = fs::remove_file(folder.join(name)); // hidden and of no use
    }
    Ok(migrated)
}

fn take_over(archive: &mut Archive, folder: &Path, path: &Path, stamp: &Stamp<'_>) -> Result<(), ArchiveError> {
    let product = product::read(path)?;
    let staging = Staging::begin(folder)?;
    let mut contents = vec![(path.to_owned(), sha256_of(path).at("read", path)?)];
    for file in &product.attachments {
        let beside = path.with_extension(&file.suffix);
        let found = sha256_of(&beside).at("read", &beside)?;
        if found != file.sha256 {
            let reason = format!("its digest is {found}, the product says {}", file.sha256);
            return Err(ArchiveError::Damaged { path: beside, reason });
        }
        contents.push((beside, found));
    }
    let sources = fs::read(path.with_extension(SOURCES)).ok();
    let sources: Option<Sources> = sources.and_then(|text| serde_json::from_slice(&text).ok());
    let mut event = Event::Product {
        id: product.id().to_owned(),
        sha256: contents[0].1.clone(),
        made_of: BTreeMap::new(),
        places: Vec::new(),
        from_ns: None,
        until_ns: None,
        run_in_ns: 0,
    };
    if let (Some(sources), Event::Product { made_of, places, from_ns, until_ns, .. }) = (sources, &mut event) {
        (*from_ns, *until_ns) = (sources.from_ns, sources.until_ns);
        let own = [("pipeline", &sources.pipeline), ("mission", &sources.mission), ("model", &sources.model)];
        for (role, file) in own {
            if let Some(kept) = same(&product, role, file, staging.path())? {
                contents.push((staging.path().join(role), kept.sha256.clone()));
                made_of.insert(role.to_owned(), kept);
            }
        }
        let telemetry = product.inputs.iter().filter(|input| input.role == "telemetry");
        let place = |(input, path): (&product::Input, &PathBuf)| InputPlace {
            sha256: input.sha256.clone(),
            path: path.clone(),
        };
        places.extend(telemetry.zip(&sources.telemetry).map(place));
    }
    let held = archive.hold()?;
    archive.finish()?;
    archive.place_and_commit(&staging, &contents, event, stamp)?;
    drop(held);
    let extract = path.with_extension(EXTRACT);
    if let Ok(content) = fs::read(&extract) {
        archive.keep_extract(product.id(), &content, stamp)?;
    }
    Ok(())
}

/// Copies an input of a product if its file is still what it was.
fn same(product: &Product, role: &str, file: &Path, staging: &Path) -> Result<Option<Stored>, ArchiveError> {
    let Some(input) = product.inputs.iter().find(|input| input.role == role) else { return Ok(None) };
    let copy = staging.join(role);
    if fs::copy(file, &copy).is_err() || sha256_of(&copy).at("read", &copy)? != input.sha256 {
        return Ok(None);
    }
    Ok(Some(Stored { name: input.name.clone(), sha256: input.sha256.clone(), size: input.size }))
}
