//! Products of one stretch of data that were made with different mission files.

use std::collections::BTreeMap;
use std::path::Path;

use dragfree_archive::Written;
use dragfree_archive::product::{Input, Product};
use dragfree_estimation::free_levels::log_determinant;
use dragfree_estimation::sigma::{BandNoise, NoiseModel};
use dragfree_estimation::stored::Stored;
use dragfree_schema::{Coefficient, NoiseLevels};

/// Names of the rungs of a ladder: revisions, and where missions differ `REVISION@MISSION`.
pub(super) struct Labels {
    /// By digest of the mission file, its name and the order in which products bring it; empty with one mission.
    missions: BTreeMap<String, (usize, String)>,
}

fn input<'a>(product: &'a Product, role: &'a str) -> impl Iterator<Item = &'a Input> {
    product.inputs.iter().filter(move |input| input.role == role)
}

fn digest(product: &Product) -> &str {
    input(product, "mission").next().map_or("", |input| &input.sha256)
}

/// Whether two products are of the same telemetry.
pub(super) fn same_telemetry(a: &Product, b: &Product) -> bool {
    let digests = |p| {
        let mut all: Vec<&str> = input(p, "telemetry").map(|input| input.sha256.as_str()).collect();
        all.sort_unstable();
        all
    };
    !digests(a).is_empty() && digests(a) == digests(b)
}

impl Labels {
    pub(super) fn new<'a>(products: impl Iterator<Item = &'a Product>) -> Self {
        let mut missions: BTreeMap<String, (usize, String)> = BTreeMap::new();
        for product in products {
            let (digest, order) = (digest(product), missions.len());
            let stem = input(product, "mission").next().and_then(|i| Path::new(&i.name).file_stem()?.to_str());
            let stem = stem.unwrap_or_default();
            if missions.contains_key(digest) {
                continue;
            }
            let taken = missions.values().any(|(_, name)| name == stem);
            let name = if taken { format!("{stem}-{}", &digest[..digest.len().min(6)]) } else { stem.to_owned() };
            missions.insert(digest.to_owned(), (order, name));
        }
        if missions.len() < 2 {
            missions.clear();
        }
        Self { missions }
    }

    /// Whether missions differ.
    pub(super) fn several(&self) -> bool {
        !self.missions.is_empty()
    }

    /// Place of a product's mission among the missions.
    pub(super) fn mission(&self, product: &Product) -> usize {
        self.missions.get(digest(product)).map_or(0, |(order, _)| *order)
    }

    /// Rung of a revision with the mission of a product.
    pub(super) fn with(&self, product: &Product, revision: &str) -> String {
        let mission = self.missions.get(digest(product));
        mission.map_or_else(|| revision.to_owned(), |(_, name)| format!("{revision}@{name}"))
    }

    /// Rung of a product.
    pub(super) fn of(&self, product: &Product) -> String {
        self.with(product, &product.model.revision)
    }
}

/// `Σ 2n log det Σ` of a product with the noise of its mission file, from the sums beside it; `None` where there are
/// none, or where they are of a part of the product's observations.
pub fn declared_log_determinant(written: &Written) -> Option<f64> {
    let text = std::fs::read(written.path.with_extension("neq.json")).ok()?;
    let stored = Stored::of_equations(&text).ok()?;
    let mut noise = stored.declared.noise.clone();
    let (layout, plan, sums) = Stored::stack(&[stored]).ok()?;
    let stated = written.product.model.noise_levels.iter().map(|level| Coefficient {
        name: level.coefficient.clone(),
        noise: level.component.clone(),
        initial: level.value,
        ..Coefficient::default()
    });
    NoiseLevels::of(&stated.collect::<Vec<_>>()).inverse().apply(&mut noise).ok()?;
    let model = NoiseModel::new(&noise, &layout.channels, 1.0 / plan.rate_hz).ok()?;
    let there = sums.total.counted().sum::<f64>() * layout.channels.len() as f64;
    let whole = super::float(super::weighed(&written.product)?, "observations");
    let complete = (there - whole).abs() <= 1e-9 * whole;
    complete.then(|| log_determinant(&BandNoise::new(&model, &plan), &sums.total)).flatten()
}
