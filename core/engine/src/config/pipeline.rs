//! Pipeline and mission files.

use dragfree_schema::Settings;
use serde::Deserialize;
use std::path::{Path, PathBuf};

use super::{ConfigError, parse, read};

/// A pipeline: where data come from and which stages they go through.
#[derive(Clone, Debug)]
pub struct Pipeline {
    /// The file.
    pub path: PathBuf,
    /// Name.
    pub name: String,
    /// Name of the product, `COM1B`.
    pub product: String,
    /// Release of the product: model, estimator, frames and units.
    pub release: u32,
    /// Mission file, unless the command line names another.
    pub mission: Option<PathBuf>,
    /// Model file, unless the command line names another.
    pub model: Option<PathBuf>,
    /// Source plugin with its parameters; without one, telemetry comes from MCAP files.
    pub source: Option<(String, toml::Table)>,
    /// Stages in order.
    pub nodes: Vec<Node>,
    /// Thresholds, where they differ from the defaults.
    pub settings: Settings,
}

/// An entry of the chain.
#[derive(Clone, Debug, PartialEq)]
pub enum Node {
    /// A stage with its parameters.
    Stage {
        /// Id of the plugin.
        plugin: String,
        /// Whether it runs in a process of its own.
        isolate: bool,
        /// Parameters as written.
        parameters: toml::Table,
    },
    /// The model's effects.
    Effects,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct File {
    pipeline: Header,
    source: Option<SourceEntry>,
    #[serde(default)]
    stage: Vec<StageEntry>,
    #[serde(default)]
    settings: toml::Table,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Header {
    name: String,
    #[serde(default = "com1b")]
    product: String,
    #[serde(default = "one")]
    release: u32,
    mission: Option<PathBuf>,
    model: Option<PathBuf>,
}

fn com1b() -> String {
    "COM1B".to_owned()
}

fn one() -> u32 {
    1
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct SourceEntry {
    plugin: String,
    #[serde(default)]
    parameters: toml::Table,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct StageEntry {
    plugin: Option<String>,
    #[serde(default)]
    effects: bool,
    #[serde(default)]
    isolate: bool,
    #[serde(default)]
    parameters: toml::Table,
}

impl Pipeline {
    /// Reads a pipeline; paths in it are relative to its folder.
    ///
    /// # Errors
    /// [`ConfigError`] says what, where and why.
    pub fn load(path: &Path) -> Result<Self, ConfigError> {
        Self::parse(path, &read(path)?)
    }

    /// Reads the text of a pipeline file; paths in it are relative to the folder of `path`.
    ///
    /// # Errors
    /// [`ConfigError`] says what, where and why.
    pub fn parse(path: &Path, text: &str) -> Result<Self, ConfigError> {
        let file: File = parse(path, text)?;
        let folder = path.parent().unwrap_or(Path::new("."));
        let sense = |what: String| ConfigError::Sense { path: path.to_owned(), what };
        let mut nodes = Vec::new();
        for (i, stage) in file.stage.into_iter().enumerate() {
            nodes.push(match (stage.plugin, stage.effects) {
                (Some(plugin), false) => Node::Stage { plugin, isolate: stage.isolate, parameters: stage.parameters },
                (None, true) if stage.parameters.is_empty() && !stage.isolate => Node::Effects,
                (None, true) => {
                    return Err(sense(
                        "`effects = true` takes neither parameters nor `isolate`; they belong into the model file"
                            .to_owned(),
                    ));
                }
                (Some(_), true) => {
                    return Err(sense(format!("stage {} has both `plugin` and `effects`; make two of it", i + 1)));
                }
                (None, false) => {
                    return Err(sense(format!("stage {} has neither `plugin = \"…\"` nor `effects = true`", i + 1)));
                }
            });
        }
        if nodes.is_empty() {
            return Err(sense("has no [[stage]]; fixtures/pipelines/science-mode.toml shows one".to_owned()));
        }
        if nodes.iter().filter(|n| **n == Node::Effects).count() > 1 {
            return Err(sense("has `effects = true` twice; the model's effects stand at one place".to_owned()));
        }
        let product = &file.pipeline.product;
        if product.is_empty() || !product.bytes().all(|b| b.is_ascii_alphanumeric()) {
            return Err(sense(format!("product = \"{product}\" must be letters and digits: it begins file names")));
        }
        Ok(Self {
            path: path.to_owned(),
            name: file.pipeline.name,
            product: file.pipeline.product,
            release: file.pipeline.release,
            mission: file.pipeline.mission.map(|p| folder.join(p)),
            model: file.pipeline.model.map(|p| folder.join(p)),
            source: file.source.map(|s| (s.plugin, s.parameters)),
            nodes,
            settings: settings(file.settings).map_err(sense)?,
        })
    }
}

/// Thresholds: the defaults, and what the table says. Every key must be one, every value a number above zero.
fn settings(table: toml::Table) -> Result<Settings, String> {
    let known = toml::Table::try_from(Settings::default()).unwrap_or_default();
    for (key, value) in &table {
        if !known.contains_key(key) {
            let names: Vec<&str> = known.keys().map(String::as_str).collect();
            return Err(format!("[settings] has no `{key}`; there are {}", names.join(", ")));
        }
        let number = value.as_float().or_else(|| value.as_integer().map(|n| n as f64));
        if !number.is_some_and(|n| n > 0.0 && n.is_finite()) {
            return Err(format!("[settings] {key} = {value} must be a number above zero"));
        }
        if known[key].is_integer() && !value.is_integer() {
            return Err(format!("[settings] {key} = {value} must be a whole number above zero"));
        }
    }
    table.try_into().map_err(|e: toml::de::Error| format!("[settings]: {}", e.message()))
}

/// A mission file as the engine sees it.
#[derive(Clone, Debug)]
pub struct Mission {
    /// The file.
    pub path: PathBuf,
    /// `mission.name`
    pub name: String,
    /// `mission.spacecraft`
    pub spacecraft: String,
    /// The whole file, for the plugins.
    pub value: serde_json::Value,
}

impl Mission {
    /// Reads a mission file.
    ///
    /// # Errors
    /// [`ConfigError`] says what, where and why. Keys and values are checked by the plugins that use them.
    pub fn load(path: &Path) -> Result<Self, ConfigError> {
        Self::parse(path, &read(path)?)
    }

    /// A mission from the text of a file; `path` is for messages.
    ///
    /// # Errors
    /// As [`Self::load`].
    pub fn parse(path: &Path, text: &str) -> Result<Self, ConfigError> {
        let table: toml::Table = parse(path, text)?;
        let sense = |what: String| ConfigError::Sense { path: path.to_owned(), what };
        let value = serde_json::to_value(&table).map_err(|e| sense(e.to_string()))?;
        let text = |key: &str| {
            value["mission"][key]
                .as_str()
                .filter(|t| !t.is_empty())
                .map(str::to_owned)
                .ok_or_else(|| sense(format!("[mission] has no `{key}`; fixtures/missions/taiji.toml shows one")))
        };
        Ok(Self { path: path.to_owned(), name: text("name")?, spacecraft: text("spacecraft")?, value })
    }
}
