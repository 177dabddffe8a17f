//! Where the inputs of a product lie now.

use std::path::{Path, PathBuf};

use crate::EngineError;
use dragfree_archive::{Archive, ArchiveError, Place};

/// Where the inputs of a product lie: pipeline, mission and model in the archive, telemetry where it was seen last.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Sources {
    /// Pipeline file.
    pub pipeline: PathBuf,
    /// Mission file.
    pub mission: PathBuf,
    /// Model file.
    pub model: PathBuf,
    /// Telemetry.
    pub telemetry: Vec<PathBuf>,
    /// First time that was asked for, Unix ns.
    pub from_ns: Option<i64>,
    /// End of the time that was asked for, Unix ns.
    pub until_ns: Option<i64>,
    /// Data before `from_ns` that only settled the stages before the estimators, ns.
    pub run_in_ns: i64,
}

impl Sources {
    /// Those of the product whose `.toml` lies in an archive.
    ///
    /// # Errors
    /// The file is in no archive; an input is gone.
    pub fn of(product: &Path) -> Result<Self, EngineError> {
        let id = product.file_stem().unwrap_or_default().to_string_lossy();
        Self::in_archive(&Archive::of(product)?, &id)
    }

    /// Those of a product of an archive.
    ///
    /// # Errors
    /// There is no such product; an input is gone.
    pub fn in_archive(archive: &Archive, id: &str) -> Result<Self, EngineError> {
        let row = archive.row(id)?;
        let inputs = archive.inputs(id)?;
        let gone = |place: &Place| ArchiveError::Moved {
            role: place.role.clone(),
            name: place.name.clone(),
            id: id.to_owned(),
            place: place.path.clone().unwrap_or_else(|| PathBuf::from(&place.name)),
        };
        let there = |place: &Place| match &place.path {
            Some(path) if path.is_file() => Ok(path.clone()),
            _ => Err(gone(place)),
        };
        let kept = |role: &str| -> Result<PathBuf, EngineError> {
            if let Some(Place { path: Some(path), .. }) = archive.made_of(id, role)? {
                return Ok(path);
            }
            let input = inputs.iter().find(|place| place.role == role);
            let missing =
                || ArchiveError::NotFound { id: format!("{id}: {role}"), folder: archive.folder().to_owned() };
            Ok(there(input.ok_or_else(missing)?)?)
        };
        let telemetry = inputs.iter().filter(|place| place.role == "telemetry").map(there);
        Ok(Self {
            pipeline: kept("pipeline")?,
            mission: kept("mission")?,
            model: kept("model")?,
            telemetry: telemetry.collect::<Result<_, _>>()?,
            from_ns: row.asked_from_ns,
            until_ns: row.asked_until_ns,
            run_in_ns: row.run_in_ns,
        })
    }
}
