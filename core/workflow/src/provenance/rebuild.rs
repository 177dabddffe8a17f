//! Making a product again from what it was made of.

use super::{Diff, diff};
use crate::{WorkflowError, joint};
use dragfree_archive::files::IoContext as _;
use dragfree_archive::product::{Product, Stage};
use dragfree_archive::{Archive, ArchiveError, JOINT, Place, Row, Written};
use dragfree_engine::EngineError;
use dragfree_engine::registry::Registry;
use dragfree_engine::run::{Progress, RunOptions, run};
use dragfree_engine::sources::Sources;
use serde::Serialize;
use std::path::{Path, PathBuf};

/// What came of making a product again.
#[derive(Clone, Debug, Serialize)]
pub struct Rebuilt {
    /// The product.
    pub id: String,
    /// Whether the new one has its digest.
    pub same: bool,
    /// Whether it would have it if the plugins' libraries had the digests that the archived one states: all that was
    /// found is the same, to the last bit, by code that may be other code.
    pub same_but_libraries: bool,
    /// Digest of the archived one.
    pub archived_sha256: String,
    /// Digest of the new one.
    pub rebuilt_sha256: String,
    /// Whether the state that it left is the same; none where the archive has none.
    pub same_state: Option<bool>,
    /// What differs; none where the archived one cannot be read.
    pub diff: Option<Diff>,
    /// Files of the product that were damaged and are whole again.
    pub mended: Vec<String>,
}

/// Runs what a product was made of once more, apart, and compares. Files of the product that are damaged and come out
/// with their digest are put back.
///
/// # Errors
/// An input is gone, or the run fails.
pub fn rebuild(
    registry: &Registry,
    archive: &mut Archive,
    id: &str,
    options: &RunOptions,
    progress: &mut dyn FnMut(Progress),
) -> Result<Rebuilt, WorkflowError> {
    let again = |error: ArchiveError| WorkflowError::from(EngineError::from(error));
    let row = archive.row(id).map_err(again)?;
    let archived = archive.product(id);
    let apart =
        tempfile::tempdir().at("make a folder for", "the product that is made again").map_err(EngineError::from)?;
    let folder = apart.path().join("archive");
    let created = archive.event(row.number).map_err(again)?.time;
    let made = if row.name == JOINT {
        joint::again(archive, id, &folder, created, &options.software)?
    } else {
        let options = RunOptions { created, archive: folder.clone(), ..options.clone() };
        run_again(registry, archive, &row, apart.path(), &options, progress)?
    };
    let rebuilt = Archive::open(&folder).map_err(again)?;
    let digest = |product: &Product| product.header.non_standard_attributes.sha256.clone();
    let archived_sha256 = row.digest.clone().unwrap_or_default();
    let state = |archive: &Archive, id: &str| archive.made_of(id, "state_out").map(|p| p.map(|p| p.sha256));
    let left = state(archive, id).map_err(again)?;
    let same_state = left.map(|sha256| state(&rebuilt, made.product.id()).is_ok_and(|found| found == Some(sha256)));
    let mended = archive.mend(id, &rebuilt, &made.product).map_err(again)?;
    Ok(Rebuilt {
        id: id.to_owned(),
        same: archived_sha256 == digest(&made.product),
        same_but_libraries: archived
            .as_ref()
            .is_ok_and(|archived| with_libraries_of(archived, &made.product).digest() == archived_sha256),
        archived_sha256,
        rebuilt_sha256: digest(&made.product),
        same_state,
        diff: archived.ok().map(|archived| diff(&archived, &made.product)),
        mended,
    })
}

/// A product as if it had been made with the libraries of another one.
fn with_libraries_of(other: &Product, product: &Product) -> Product {
    let mut product = product.clone();
    for (Stage { library_sha256: own, .. }, Stage { library_sha256: theirs, .. }) in
        product.history.iter_mut().zip(&other.history)
    {
        own.clone_from(theirs);
    }
    product
}

/// Runs what a product of one run was made of once more.
fn run_again(
    registry: &Registry,
    archive: &Archive,
    row: &Row,
    apart: &Path,
    options: &RunOptions,
    progress: &mut dyn FnMut(Progress),
) -> Result<Written, WorkflowError> {
    let id = row.id.as_str();
    let sources = Sources::in_archive(archive, id)?;
    let inputs = archive.inputs(id).map_err(EngineError::from)?;
    let mut named = Named { folder: apart, inputs: &inputs, count: 0 };
    let mut files = Vec::new();
    for path in &sources.telemetry {
        files.push(named.name("telemetry", path)?);
    }
    let state = archive.made_of(id, "state_in").map_err(EngineError::from)?;
    let options = RunOptions {
        pipeline: named.name("pipeline", &sources.pipeline)?,
        mission: Some(named.name("mission", &sources.mission)?),
        model: Some(named.name("model", &sources.model)?),
        state_in: state.and_then(|s| s.path).map(|path| named.name("state", &path)).transpose()?,
        files,
        from_ns: sources.from_ns,
        until_ns: sources.until_ns,
        run_in_ns: sources.run_in_ns,
        stream: known(row.stream.as_deref()).unwrap_or(options.stream),
        status: known(row.status.as_deref()).unwrap_or(options.status),
        ..options.clone()
    };
    Ok(run(registry, &options, progress)?)
}

/// Whether everything is there that a product was made of.
pub fn can_be_rebuilt(archive: &Archive, id: &str) -> bool {
    match archive.row(id) {
        Ok(row) if row.name == JOINT => {
            let inputs = archive.inputs(id).unwrap_or_default();
            let whole = |row: Row| archive.document(&row.id).is_ok();
            inputs.iter().all(|input| archive.with_digest(&input.name, &input.sha256).is_ok_and(whole))
        }
        _ => Sources::in_archive(archive, id).is_ok(),
    }
}

/// A word of the catalogue.
fn known<T: serde::de::DeserializeOwned>(word: Option<&str>) -> Option<T> {
    serde_json::from_value(word?.into()).ok()
}

/// Inputs under the names that a product has them by: the names are part of its digest.
struct Named<'a> {
    folder: &'a Path,
    inputs: &'a [Place],
    count: usize,
}

impl Named<'_> {
    fn name(&mut self, role: &str, path: &Path) -> Result<PathBuf, EngineError> {
        let of_role = self.inputs.iter().filter(|place| place.role == role);
        let here = of_role.clone().find(|place| place.path.as_deref() == Some(path));
        let name = here.or_else(|| of_role.clone().next()).map_or("input", |place| place.name.as_str());
        self.count += 1;
        let folder = self.folder.join(self.count.to_string());
        std::fs::create_dir(&folder).at("make the folder", &folder)?;
        let link = folder.join(name);
        let path = std::path::absolute(path).unwrap_or_else(|_| path.to_owned());
        #[cfg(unix)]
        std::os::unix::fs::symlink(&path, &link).at("link", &link)?;
        #[cfg(not(unix))]
        std::fs::copy(&path, &link).map(drop).at("copy", &link)?;
        Ok(link)
    }
}
