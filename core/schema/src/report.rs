//! What a stage or a source says when the data are through.

use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// The result of a stage or a source. Every key is optional; the host merges the reports of all stages into the
/// product.
///
/// Where several stages give the same single figure, the last one counts. A key that is not listed here is left out and
/// noted in the product.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "json-schema", derive(schemars::JsonSchema))]
#[serde(default)]
pub struct Report {
    /// Id of the plugin; the host fills it in.
    #[serde(skip_serializing_if = "String::is_empty")]
    pub plugin: String,
    /// Estimated coefficients.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub coefficients: Vec<Estimate>,
    /// Covariance of the coefficients, by solution.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub covariance: BTreeMap<String, Covariance>,
    /// `agree`, `disagree` or `weak`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub verdict: Option<String>,
    /// Directions of the coefficients that the data do not determine, one sentence each.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub weak_directions: Vec<String>,
    /// χ² per degree of freedom of the residuals.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub chi2_per_dof: Option<f64>,
    /// Mean normalised innovation squared per degree of freedom.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub nis: Option<f64>,
    /// `telemetered` or `reconstructed`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub commands: Option<String>,
    /// Epochs of the grid that entered the result.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub epochs_used: Option<u64>,
    /// Epochs of the grid that did not.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub epochs_rejected: Option<u64>,
    /// Data were lost on the way: the run ends with exit code 3.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub data_loss: bool,
    /// The model does not fit the data: the run ends with exit code 4.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub inconsistent: bool,
    /// What was counted, by reason: `gaps`, `spikes`.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub counts: BTreeMap<String, u64>,
    /// Sentences for the operator.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub notes: Vec<String>,
    /// Free figures of quality, any JSON.
    #[serde(skip_serializing_if = "serde_json::Map::is_empty")]
    pub quality: serde_json::Map<String, serde_json::Value>,
    /// Texts to store beside the product.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub attachments: Vec<Attachment>,
}

/// What a solution is for. A stage that adjudicates compares the batch solution with every recursive one and says what
/// is adopted.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "json-schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "lowercase")]
pub enum Role {
    /// Estimated epoch by epoch from past data.
    Recursive,
    /// Estimated from all data of a run at once.
    Batch,
    /// What the product recommends.
    Adopted,
}

/// One coefficient by one solution.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "json-schema", derive(schemars::JsonSchema))]
pub struct Estimate {
    /// `com-offset.tm1.x`
    pub name: String,
    /// Which solution, `es-akf`, `qp` or `adopted`.
    pub solution: String,
    /// What the solution is for; one without a role is listed and takes no part in the verdict.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub role: Option<Role>,
    /// Value in `unit`; none where there is no estimate.
    pub value: Option<f64>,
    /// One standard deviation in `unit`; none where the data do not determine the coefficient.
    pub sigma: Option<f64>,
    /// SI unit.
    #[serde(default)]
    pub unit: String,
    /// Frame, empty where there is none.
    #[serde(default)]
    pub frame: String,
}

/// Covariance of one solution.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "json-schema", derive(schemars::JsonSchema))]
pub struct Covariance {
    /// Coefficients in the order of rows and columns.
    pub names: Vec<String>,
    /// n × n, by rows, SI; NaN (in JSON `null`) where an entry is not known.
    #[serde(deserialize_with = "crate::number::matrix")]
    #[cfg_attr(feature = "json-schema", schemars(with = "Vec<Vec<Option<f64>>>"))]
    pub matrix: Vec<Vec<f64>>,
}

/// A text to store beside the product.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "json-schema", derive(schemars::JsonSchema))]
pub struct Attachment {
    /// End of the file name after the product's id, `neq.json`.
    pub suffix: String,
    /// Content.
    pub text: String,
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A filter wrote NaN into its covariance; every later stage failed with "invalid type: null, expected f64".
    #[test]
    fn a_covariance_with_nan_reads_back_with_nan() {
        let covariance =
            Covariance { names: vec!["a".into(), "b".into()], matrix: vec![vec![1.0, f64::NAN], vec![f64::NAN, 2.0]] };
        let report = Report { covariance: [("recursive".to_owned(), covariance)].into(), ..Report::default() };
        let text = serde_json::to_string(&report).expect("JSON");
        assert!(text.contains("[[1.0,null],[null,2.0]]"), "{text}");
        let back: Report = serde_json::from_str(&text).expect("a report");
        let matrix = &back.covariance["recursive"].matrix;
        assert_eq!((matrix[0][0], matrix[1][1]), (1.0, 2.0));
        assert!(matrix[0][1].is_nan() && matrix[1][0].is_nan());
    }

    /// One extra key in a filter's report failed the next stage after a whole day had been read.
    #[test]
    fn a_key_of_a_newer_plugin_does_not_fail_a_reader() {
        let back: Report = serde_json::from_str(r#"{"nis": 1.0, "shade": "blue"}"#).expect("a report");
        assert_eq!(back, Report { nis: Some(1.0), ..Report::default() });
    }
}
