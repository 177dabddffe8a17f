//! A second look at the data of a product: its inputs through its chain once more, with another stage in place of the estimators.

use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

use crate::EngineError;
use crate::border::Kind;
use crate::chain::{self, Forget};
use crate::config::{EffectEntry, Model, Node};
use crate::product::Product;
use crate::registry::Registry;
use crate::replay;
use crate::run::{Progress, RunOptions, Setup, carry, carry_all, window};

/// Where the inputs of a product lay, in a file beside it that is no part of it: places change, content does not.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
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
}

impl Sources {
    pub(crate) fn of(setup: &Setup, options: &RunOptions) -> Self {
        let absolute = |path: &Path| std::path::absolute(path).unwrap_or_else(|_| path.to_owned());
        Self {
            pipeline: absolute(&setup.pipeline.path),
            mission: absolute(&setup.mission.path),
            model: absolute(&setup.model.path),
            telemetry: options.files.iter().map(|f| absolute(f)).collect(),
            from_ns: options.from_ns,
            until_ns: options.until_ns,
        }
    }

    fn path(product: &Path) -> PathBuf {
        product.with_extension("sources.json")
    }

    pub(crate) fn write(&self, product: &Path) -> Result<(), EngineError> {
        let path = Self::path(product);
        let text = serde_json::to_string_pretty(self).unwrap_or_default() + "\n";
        std::fs::write(&path, text).map_err(|source| EngineError::Io { action: "write", path, source })
    }

    /// Reads them.
    ///
    /// # Errors
    /// [`EngineError::Io`] where there is no such file beside the product.
    pub fn read(product: &Path) -> Result<Self, EngineError> {
        let path = Self::path(product);
        let text = std::fs::read_to_string(&path).map_err(|source| EngineError::Io {
            action: "read where the inputs lay, from",
            path: path.clone(),
            source,
        })?;
        serde_json::from_str(&text).map_err(|e| EngineError::Io { action: "read", path, source: e.into() })
    }
}

/// What to do with the data of a product.
pub struct Examination<'a> {
    /// The product.
    pub product: &'a Product,
    /// Where its inputs are now.
    pub sources: &'a Sources,
    /// Stage that stands in place of all behind the effects, with its parameters.
    pub stage: (&'a str, toml::Table),
    /// Effects that are tried beside those of the model.
    pub candidates: Vec<EffectEntry>,
    /// Threads.
    pub threads: usize,
    /// Most rows in one call of a plugin.
    pub batch_rows: usize,
}

/// Every instance of every installed effect that is not in a model. An effect that may act anywhere is not tried: its place is the
/// user's to say.
#[must_use]
pub fn candidates(registry: &Registry, model: &Model) -> Vec<EffectEntry> {
    let mut all = Vec::new();
    for found in registry.plugins().filter(|p| p.info.kind == Kind::Effect) {
        let manifest = &found.info.manifest;
        for instance in &manifest.instances {
            if !model.effects.iter().any(|e| e.id == manifest.id && e.instance == *instance) {
                all.push(EffectEntry {
                    id: manifest.id.clone(),
                    instance: instance.clone(),
                    estimate: true,
                    prior: std::collections::BTreeMap::new(),
                    parameters: toml::Table::new(),
                });
            }
        }
    }
    all
}

/// Whether an effect has a parameter: with `at_ns` what it does happens once, at a time that the host finds; with `fine` its candidate
/// can be tried about one shape in fine steps.
#[must_use]
pub fn has_parameter(registry: &Registry, effect: &str, name: &str) -> bool {
    let found = registry.find(Kind::Effect, effect);
    found.is_ok_and(|f| f.info.manifest.parameters.iter().any(|p| p.name == name))
}

/// The model of a product, as its file is now.
///
/// # Errors
/// It cannot be read.
pub fn model(sources: &Sources) -> Result<Model, EngineError> {
    Ok(Model::load(&sources.model)?)
}

/// Carries the data of a product through its chain and gives what could not be tried.
///
/// # Errors
/// An input has changed since the product was made, is gone, or a plugin fails.
pub fn examine(
    registry: &Registry,
    what: &Examination<'_>,
    progress: &mut dyn FnMut(Progress),
) -> Result<Vec<(String, String)>, EngineError> {
    let sources = what.sources;
    unchanged(what.product, sources)?;
    let options = RunOptions {
        pipeline: sources.pipeline.clone(),
        files: sources.telemetry.clone(),
        mission: Some(sources.mission.clone()),
        model: Some(sources.model.clone()),
        archive: PathBuf::new(),
        from_ns: sources.from_ns,
        until_ns: sources.until_ns,
        threads: what.threads,
        batch_rows: what.batch_rows,
        state_in: None,
        state_out: None,
        created: chrono::DateTime::UNIX_EPOCH,
        software: String::new(),
    };
    let mut setup = Setup::load(&options)?;
    setup.model.candidates.clone_from(&what.candidates);
    let keep =
        setup.pipeline.nodes.iter().position(|n| *n == Node::Effects).map_or(setup.pipeline.nodes.len(), |i| i + 1);
    setup.pipeline.nodes.truncate(keep);
    let (plugin, parameters) = (what.stage.0.to_owned(), what.stage.1.clone());
    setup.pipeline.nodes.push(Node::Stage { plugin, parameters });
    let mut feed = setup.feed(registry, &options, window(&options, None))?;
    let tables = feed.get().tables().to_vec();
    let mut chain = chain::build(registry, &setup.pipeline, &setup.mission, &setup.model, &tables, carry(&options))?;
    let covered = carry_all(feed.get(), &mut chain, &mut Forget, progress)?;
    if covered.is_none() {
        return Err(EngineError::NoRows { files: options.files });
    }
    chain.finish(&mut Forget)?;
    chain.reports()?;
    Ok(chain.not_tried)
}

/// The inputs are those that the product names.
fn unchanged(product: &Product, sources: &Sources) -> Result<(), EngineError> {
    let all = [&sources.pipeline, &sources.mission, &sources.model].into_iter().chain(&sources.telemetry);
    for path in all {
        let digest =
            replay::sha256(path).map_err(|source| EngineError::Io { action: "read", path: path.clone(), source })?;
        if !product.inputs.iter().any(|input| input.sha256 == digest) {
            return Err(EngineError::Changed { path: path.clone(), product: product.id().to_owned() });
        }
    }
    Ok(())
}
