//! An archive as the pages see it: what they are asked, and what they read once.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, PoisonError};

use dragfree_archive::{Archive, EXTRACT, Written};
use dragfree_workflow::refit::{Asked, Basis, Refit};
use serde::Deserialize;

use crate::PagesError;
use crate::jobs::Jobs;
use crate::setup::Setup;

/// Bases that are kept in memory: a colleague may look at other days.
const BASES: usize = 4;

/// Most products of a refit.
const MOST_PRODUCTS: usize = 120;

/// The pages of an archive.
pub struct Site {
    pub(crate) setup: Setup,
    pub(crate) jobs: Jobs,
    /// With the digests of their extracts: a product that is diagnosed anew has another one.
    bases: Mutex<VecDeque<(Vec<String>, Arc<Basis>)>>,
}

/// What stands behind `?` in an address.
#[derive(Clone, Debug, Default, Deserialize)]
pub struct Query {
    /// Products, separated by commas.
    #[serde(default)]
    pub products: String,
    /// Effects that are on, separated by commas, in their order.
    #[serde(default)]
    pub on: String,
    /// Products that are kept out of the fit, separated by commas.
    #[serde(default)]
    pub held: String,
    /// First day.
    #[serde(default)]
    pub from: String,
    /// Last day.
    #[serde(default)]
    pub until: String,
    /// Spacecraft.
    #[serde(default)]
    pub spacecraft: String,
}

impl Site {
    /// Pages of an archive.
    pub fn new(setup: Setup) -> Self {
        Self { setup, jobs: Jobs::default(), bases: Mutex::default() }
    }

    /// What the switches of an address give.
    ///
    /// # Errors
    /// [`PagesError`]: the switches cannot be set so.
    pub fn refit(&self, query: &Query) -> Result<Refit, PagesError> {
        Ok(self.basis(&query.products)?.refit(&query.asked())?)
    }

    pub(crate) fn archive(&self) -> Result<Archive, PagesError> {
        Ok(Archive::open(&self.setup.archive)?)
    }

    /// What the diagnoses of some products have kept, read once.
    pub(crate) fn basis(&self, products: &str) -> Result<Arc<Basis>, PagesError> {
        let ids = list(products);
        if ids.len() > MOST_PRODUCTS {
            return Err(PagesError::Request(format!("at most {MOST_PRODUCTS} products are looked at together")));
        }
        let archive = self.archive()?;
        // Of a product without one, `Basis::read` says how to make it.
        let key: Vec<String> = ids.iter().map(|id| archive.digest_of(id, EXTRACT).unwrap_or_default()).collect();
        let found = {
            let bases = self.bases.lock().unwrap_or_else(PoisonError::into_inner);
            bases.iter().find(|(digests, _)| *digests == key).map(|(_, basis)| Arc::clone(basis))
        };
        if let Some(basis) = found {
            return Ok(basis);
        }
        let written = ids.iter().map(|id| -> Result<Written, PagesError> {
            let row = archive.row(id)?;
            Ok(Written { product: archive.product(&row.id)?, path: archive.path_of(&row.id) })
        });
        let written: Vec<Written> = written.collect::<Result<_, _>>()?;
        let basis = Arc::new(Basis::read(&written)?);
        let mut bases = self.bases.lock().unwrap_or_else(PoisonError::into_inner);
        bases.push_front((key, Arc::clone(&basis)));
        bases.truncate(BASES);
        Ok(basis)
    }
}

impl Query {
    pub(crate) fn asked(&self) -> Asked {
        Asked { on: list(&self.on), held_out: list(&self.held) }
    }
}

/// Parts of a list, each once.
pub(crate) fn list(text: &str) -> Vec<String> {
    let mut all: Vec<String> = Vec::new();
    for part in text.split(',').map(str::trim).filter(|part| !part.is_empty()) {
        if all.iter().all(|own| own != part) {
            all.push(part.to_owned());
        }
    }
    all
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_list_has_each_part_once_in_its_order() {
        assert_eq!(list("b,a,, b ,c"), ["b", "a", "c"]);
        assert!(list("").is_empty());
    }
}
