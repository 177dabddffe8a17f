//! What a stage has to say when the data are through.

use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// The result of a stage or a source. Everything is optional; the host merges the reports of all stages into the
/// product.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Report {
    /// Id of the plugin; the host fills it in.
    #[serde(skip_serializing_if = "String::is_empty")]
    pub plugin: String,
    /// Estimated coefficients.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub coefficients: Vec<Estimate>,
    /// Covariance by solution.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub covariance: BTreeMap<String, Covariance>,
    /// `agree`, `disagree` or `weak`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub verdict: Option<String>,
    /// Directions of the coefficients that the data do not see, in words.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub weak_directions: Vec<String>,
    /// χ² per degree of freedom of the residuals.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub chi2_per_dof: Option<f64>,
    /// Normalised innovation squared per degree of freedom.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub nis: Option<f64>,
    /// `telemetered` or `reconstructed`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub commands: Option<String>,
    /// Epochs of the grid that were used.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub epochs_used: Option<u64>,
    /// Epochs of the grid that were not.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub epochs_rejected: Option<u64>,
    /// Data were lost on the way: the run ends with exit code 3.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub data_loss: bool,
    /// The model does not fit the data: the run ends with exit code 4.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub inconsistent: bool,
    /// What was counted, by reason.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub counts: BTreeMap<String, u64>,
    /// Sentences for the operator.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub notes: Vec<String>,
    /// Anything else worth keeping.
    #[serde(skip_serializing_if = "serde_json::Map::is_empty")]
    pub quality: serde_json::Map<String, serde_json::Value>,
    /// Texts to store beside the product.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub attachments: Vec<Attachment>,
}

/// One coefficient by one solution.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Estimate {
    /// `com-offset.tm1.x`
    pub name: String,
    /// `es-akf`, `qp` or `adopted`.
    pub solution: String,
    /// Value; none where there is no estimate.
    pub value: Option<f64>,
    /// One standard deviation; none where the data do not see the coefficient.
    pub sigma: Option<f64>,
    /// SI unit.
    pub unit: String,
    /// Frame.
    pub frame: String,
}

/// Covariance of one solution.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Covariance {
    /// Coefficients in the order of rows and columns.
    pub names: Vec<String>,
    /// Rows, SI.
    pub matrix: Vec<Vec<f64>>,
}

/// A text to store beside the product.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Attachment {
    /// End of the file name after the product's id, `neq.json`.
    pub suffix: String,
    /// Content.
    pub text: String,
}
