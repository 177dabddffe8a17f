//! Effects added to a model file, as one new revision.

use std::path::Path;

use dragfree_engine::border::Kind;
use dragfree_engine::config::{EffectEntry, Mission};
use dragfree_engine::registry::{Found, Registry, RegistryError};
use dragfree_engine::revisions::{Committed, Edit, RevisionError};
use dragfree_engine::validate::{Coefficient, Subject};

/// An effect to add.
#[derive(Clone, Debug)]
pub struct Addition {
    /// Its entry in the model.
    pub entry: EffectEntry,
    /// What stands above it in the file.
    pub comment: String,
    /// Values of its coefficients by name as a diagnosis has them. A level of noise starts at its value where the entry
    /// gives none: a recursive filter estimates no level and uses this one.
    pub diagnosed: Vec<(String, f64)>,
}

/// What came of it.
#[derive(Clone, Debug)]
pub struct Added {
    /// Revision of the file as it was found.
    pub before: String,
    /// The new revision; none where nothing has changed.
    pub committed: Option<Committed>,
}

/// Why an effect is not added.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs, reason = "every field is named in its sentence")]
pub enum AddError {
    /// No such effect.
    #[error(transparent)]
    Registry(#[from] RegistryError),
    /// The model file.
    #[error(transparent)]
    Revision(#[from] RevisionError),
    /// The effect refuses its entry.
    #[error("{reason}; tried with the mission {mission}, --mission names another")]
    Refused { reason: String, mission: String },
    /// A prior of a coefficient that it does not have.
    #[error("{effect} has no coefficient `{name}`; it has {known}")]
    NoCoefficient { effect: String, name: String, known: String },
}

/// Adds effects to a model file, after asking each of them whether it takes its entry.
///
/// # Errors
/// [`AddError`]: an effect is not installed or refuses its parameters, or the file cannot be changed.
pub fn add(model: &Path, registry: &Registry, mission: &Mission, additions: &[Addition]) -> Result<Added, AddError> {
    let entries = additions.iter().map(|addition| checked(registry, mission, addition));
    let entries: Vec<EffectEntry> = entries.collect::<Result<_, _>>()?;
    let mut edit = Edit::begin(model)?;
    let before = edit.model().map(|m| m.revision.clone()).unwrap_or_default();
    for (entry, addition) in entries.iter().zip(additions) {
        edit.add(entry, &addition.comment)?;
    }
    Ok(Added { before, committed: edit.commit()? })
}

fn checked(registry: &Registry, mission: &Mission, addition: &Addition) -> Result<EffectEntry, AddError> {
    let mut entry = addition.entry.clone();
    let found = registry.find(Kind::Effect, &entry.id)?;
    for c in accepted(&found, &entry, mission)?.iter().filter(|c| !c.noise.is_empty()) {
        if let Some((_, value)) = addition.diagnosed.iter().find(|(name, value)| *name == c.name && *value > 0.0) {
            entry.prior.entry(short(c).to_owned()).or_default().value.get_or_insert(*value);
        }
    }
    Ok(entry)
}

/// The coefficients of an effect that takes its entry, as far as they can be known without telemetry.
fn accepted(found: &Found, entry: &EffectEntry, mission: &Mission) -> Result<Vec<Coefficient>, AddError> {
    let refused = |reason: String| AddError::Refused { reason, mission: mission.name.clone() };
    let subject =
        Subject { opened: &found.opened, plugin: &found.info, mission, parameters: &entry.parameters, files: &[] };
    entry.check_instance(&found.info.manifest, mission).map_err(refused)?;
    let announced = subject.coefficients(&entry.instance).map_err(|finding| refused(finding.to_string()))?;
    let Some(coefficients) = announced else { return Ok(Vec::new()) };
    let names: Vec<&str> = coefficients.iter().map(short).collect();
    match entry.prior.keys().find(|name| !names.contains(&name.as_str())) {
        Some(name) => {
            Err(AddError::NoCoefficient { effect: entry.to_string(), name: name.clone(), known: names.join(", ") })
        }
        None => Ok(coefficients),
    }
}

/// `x` of `com-offset.NAME.x`.
fn short(coefficient: &Coefficient) -> &str {
    coefficient.name.rsplit('.').next().unwrap_or_default()
}
