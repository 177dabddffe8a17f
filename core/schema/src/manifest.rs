//! What a plugin says of itself before anything else.

use serde::{Deserialize, Serialize};

/// What a plugin is and which parameters it takes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "json-schema", derive(schemars::JsonSchema))]
pub struct Manifest {
    /// Id by which pipelines and models name it, `es-akf`: small letters, digits and hyphens.
    pub id: String,
    /// Version of the plugin, `1.2.3`.
    pub version: String,
    /// SPDX expression.
    pub licence: String,
    /// One sentence.
    pub description: String,
    /// Effects only: the places where it can act, `tm1`, `tm2`.
    #[serde(default)]
    pub instances: Vec<String>,
    /// Effects only: columns beyond the usual ones that stages before it are asked to make, by the names that those
    /// stages give them: `commands`, `torque-response`, `dws-delay-response`.
    #[serde(default)]
    pub needs: Vec<String>,
    /// Parameters; a pipeline or model file that gives another key is refused.
    #[serde(default)]
    pub parameters: Vec<Parameter>,
}

/// A parameter as declared.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "json-schema", derive(schemars::JsonSchema))]
pub struct Parameter {
    /// Name. Two have a meaning for `diagnose`: `at_ns`, when a transient begins, and `fine`, 1 for candidates about
    /// one shape.
    pub name: String,
    /// Type of its value.
    #[serde(rename = "type")]
    pub kind: ParameterType,
    /// SI unit, `1` for a number, empty for what has none.
    #[serde(default)]
    pub unit: String,
    /// Value when nothing is said.
    pub default: serde_json::Value,
    /// Smallest value.
    #[serde(default)]
    pub minimum: Option<f64>,
    /// Largest value.
    #[serde(default)]
    pub maximum: Option<f64>,
    /// Texts that are allowed; empty for any.
    #[serde(default)]
    pub choices: Vec<String>,
    /// One sentence.
    #[serde(default)]
    pub help: String,
}

/// Type of a parameter's value.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "json-schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "snake_case")]
pub enum ParameterType {
    /// A finite number.
    F64,
    /// A whole number.
    I64,
    /// True or false.
    Bool,
    /// A text.
    Text,
    /// A list of finite numbers.
    F64List,
    /// A list of texts.
    TextList,
}

impl std::fmt::Display for ParameterType {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::F64 => "f64",
            Self::I64 => "i64",
            Self::Bool => "bool",
            Self::Text => "text",
            Self::F64List => "f64_list",
            Self::TextList => "text_list",
        })
    }
}
