//! What a product was made of, and what was made of it.

use crate::WorkflowError;
use dragfree_archive::product::Stage;
use dragfree_archive::{Archive, ArchiveError, Find, Place, Row, Validity};
use dragfree_engine::EngineError;
use serde::Serialize;

/// What a product was made of, and what was made of it.
#[derive(Clone, Debug, Serialize)]
pub struct Lineage {
    /// The product.
    pub product: Row,
    /// Files that were read, each at a place where it is or was last.
    pub inputs: Vec<Place>,
    /// Contents that the archive keeps: pipeline, mission, model, the state it resumed and the state it left.
    pub kept: Vec<Place>,
    /// Plugins that ran, in order.
    pub plugins: Vec<Stage>,
    /// Products whose states lead to it, the last first.
    pub resumed: Vec<String>,
    /// The product that it took the place of.
    pub supersedes: Option<String>,
    /// Products that took its place.
    pub superseded_by: Vec<String>,
    /// Products that resumed from the state that it left.
    pub resumed_by: Vec<String>,
    /// Calibrations of many days that it entered.
    pub entered: Vec<String>,
    /// Tests on other data with the model fixed at its values.
    pub tested_by: Vec<String>,
    /// Times for which it is certified.
    pub certified: Vec<Validity>,
}

/// The lineage of a product.
///
/// # Errors
/// There is no such product, or it is damaged.
pub fn lineage(archive: &Archive, id: &str) -> Result<Lineage, WorkflowError> {
    let made = || -> Result<Lineage, ArchiveError> {
        let product = archive.row(id)?;
        let all = archive.list(&Find::default())?.entries;
        let with = |holds: &dyn Fn(&Row) -> bool| -> Vec<String> {
            all.iter().filter(|entry| holds(&entry.row)).map(|entry| entry.row.id.clone()).collect()
        };
        let left = |id: &str| archive.made_of(id, "state_out");
        let mut resumed: Vec<String> = Vec::new();
        loop {
            let at = resumed.last().map_or(id, String::as_str);
            let Some(state) = archive.made_of(at, "state_in")? else { break };
            let of = archive.products_with("state_out", &state.sha256)?;
            // The same result twice leaves the same state twice; the first one made it.
            let Some(before) = of.into_iter().find(|found| found != at && !resumed.contains(found)) else { break };
            resumed.push(before);
        }
        let resumed_by = match left(id)? {
            Some(state) => archive.products_with("state_in", &state.sha256)?,
            None => Vec::new(),
        };
        let mut certified = archive.validity(None)?;
        certified.retain(|validity| validity.id == id);
        Ok(Lineage {
            inputs: archive.inputs(id)?,
            kept: archive.all_made_of(id)?,
            plugins: archive.product(id)?.history,
            resumed,
            supersedes: product.supersedes.clone(),
            superseded_by: with(&|row| row.supersedes.as_deref() == Some(id)),
            resumed_by,
            entered: archive.products_of(product.digest.as_deref().unwrap_or_default())?,
            tested_by: with(&|row| row.fixed_from.as_deref() == Some(id)),
            certified,
            product,
        })
    };
    Ok(made().map_err(EngineError::from)?)
}
