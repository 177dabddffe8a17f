//! Model files: a list of effects.

use serde::Deserialize;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use super::{ConfigError, parse, read};

/// A model: a revision and its effects.
#[derive(Clone, Debug)]
pub struct Model {
    /// The file.
    pub path: PathBuf,
    /// Revision.
    pub revision: String,
    /// Revision that this one came from.
    pub parent: Option<String>,
    /// Effects in order.
    pub effects: Vec<EffectEntry>,
    /// Effects that are not in the file but are to be tried beside it.
    pub candidates: Vec<EffectEntry>,
}

/// One `[[effect]]`.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EffectEntry {
    /// Id of the effect.
    pub id: String,
    /// Where it acts, `tm1`.
    #[serde(default)]
    pub instance: String,
    /// False fixes every coefficient at its value.
    #[serde(default = "yes")]
    pub estimate: bool,
    /// Priors by the last part of a coefficient's name, `x`.
    #[serde(default)]
    pub prior: BTreeMap<String, Prior>,
    /// Parameters of the effect.
    #[serde(default)]
    pub parameters: toml::Table,
}

/// What a model file says of one coefficient, in its SI unit.
#[derive(Clone, Copy, Debug, Default, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Prior {
    /// Value before any data, or the fixed value.
    pub value: Option<f64>,
    /// Standard deviation before any data.
    pub sigma: Option<f64>,
    /// Lower end of the range.
    pub lower: Option<f64>,
    /// Upper end of the range.
    pub upper: Option<f64>,
}

fn yes() -> bool {
    true
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct File {
    model: Header,
    #[serde(default)]
    effect: Vec<EffectEntry>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Header {
    revision: String,
    parent: Option<String>,
}

impl Model {
    /// Reads a model file.
    ///
    /// # Errors
    /// [`ConfigError`] says what, where and why.
    pub fn load(path: &Path) -> Result<Self, ConfigError> {
        let file: File = parse(path, &read(path)?)?;
        let sense = |what: String| ConfigError::Sense { path: path.to_owned(), what };
        for (i, effect) in file.effect.iter().enumerate() {
            if file.effect[..i].iter().any(|e| e.id == effect.id && e.instance == effect.instance) {
                return Err(sense(format!("effect {}:{} stands twice; remove one", effect.id, effect.instance)));
            }
            for (name, prior) in &effect.prior {
                let numbers = [prior.value, prior.sigma, prior.lower, prior.upper];
                if numbers.iter().flatten().any(|x| !x.is_finite()) || prior.sigma.is_some_and(|s| s <= 0.0) {
                    return Err(sense(format!(
                        "effect {}:{}: prior.{name} must be finite, with sigma above zero",
                        effect.id, effect.instance
                    )));
                }
            }
        }
        Ok(Self {
            path: path.to_owned(),
            revision: file.model.revision,
            parent: file.model.parent,
            effects: file.effect,
            candidates: Vec::new(),
        })
    }
}
