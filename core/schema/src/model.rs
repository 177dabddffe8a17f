//! What the effects of a model declare: coefficients, how channels respond to them, and constraints.

use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

use crate::NoiseProcess;
use crate::number::{finite_or_null, infinity, minus_infinity, or_infinity, or_minus_infinity};

/// What earlier plugins of a chain declared, as the host hands it to a later one (`model_json` of `dragfree_link_v1`).
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "json-schema", derive(schemars::JsonSchema))]
#[serde(default)]
pub struct Model {
    /// Coefficients of the model's effects, then those of the candidates.
    pub coefficients: Vec<Coefficient>,
    /// Constraints on them.
    pub constraints: Vec<Constraint>,
    /// Noise in the channels.
    pub noise: Vec<NoiseProcess>,
}

/// A coefficient of an effect.
///
/// It acts in one of four ways: by `responses` or columns of kind `regressor` (a cause that lasts), by `noise` (it
/// multiplies the amplitude of a noise process), or, as a candidate, by one of its `variants` or `transients`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "json-schema", derive(schemars::JsonSchema))]
pub struct Coefficient {
    /// `EFFECT.INSTANCE`, or `EFFECT.INSTANCE.NAME` where there are several: `com-offset.tm1.x`.
    pub name: String,
    /// Id of the effect; the host fills it in.
    #[serde(default)]
    pub effect: String,
    /// Instance of the effect; the host fills it in.
    #[serde(default)]
    pub instance: String,
    /// SI unit, `1` for a number.
    pub unit: String,
    /// Frame, empty where there is none.
    #[serde(default)]
    pub frame: String,
    /// Lower end of the physical range; null for none.
    #[serde(default = "minus_infinity", serialize_with = "finite_or_null", deserialize_with = "or_minus_infinity")]
    #[cfg_attr(feature = "json-schema", schemars(with = "Option<f64>"))]
    pub lower: f64,
    /// Upper end of the physical range; null for none.
    #[serde(default = "infinity", serialize_with = "finite_or_null", deserialize_with = "or_infinity")]
    #[cfg_attr(feature = "json-schema", schemars(with = "Option<f64>"))]
    pub upper: f64,
    /// Value before any data.
    #[serde(default)]
    pub initial: f64,
    /// Standard deviation before any data; null for none.
    #[serde(default = "infinity", serialize_with = "finite_or_null", deserialize_with = "or_infinity")]
    #[cfg_attr(feature = "json-schema", schemars(with = "Option<f64>"))]
    pub prior_sigma: f64,
    /// False where the model fixes the coefficient at `initial`; the host fills it in.
    #[serde(default = "yes")]
    pub estimate: bool,
    /// True where the effect is not in the model and is only tried by a diagnosis; the host fills it in.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub candidate: bool,
    /// How channels respond, beside the columns of kind `regressor`.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub responses: Vec<Response>,
    /// Values of the shape parameters behind the responses, a lag or a resonance.
    #[serde(default, skip_serializing_if = "Shape::is_empty")]
    pub shape: Shape,
    /// Candidates: the forms that the cause may have, in place of `responses`.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub variants: Vec<Variant>,
    /// Candidates: the courses that a cause of short duration may have, at a time that the host finds.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub transients: Vec<Transient>,
    /// A noise process whose amplitude the coefficient multiplies, 1 for the declared level; such a coefficient has no
    /// responses.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub noise: String,
    /// A noise process that the coefficient filters.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub colours: Option<Colour>,
}

fn yes() -> bool {
    true
}

impl Default for Coefficient {
    fn default() -> Self {
        Self {
            name: String::new(),
            effect: String::new(),
            instance: String::new(),
            unit: "1".to_owned(),
            frame: String::new(),
            lower: f64::NEG_INFINITY,
            upper: f64::INFINITY,
            initial: 0.0,
            prior_sigma: f64::INFINITY,
            estimate: true,
            candidate: false,
            responses: Vec::new(),
            shape: Shape::new(),
            variants: Vec::new(),
            transients: Vec::new(),
            noise: String::new(),
            colours: None,
        }
    }
}

/// Shape parameters by name: numbers, or names of columns.
pub type Shape = BTreeMap<String, serde_json::Value>;

/// How one channel responds to a coefficient: `factor` times a series, times the value of another coefficient where
/// `times` names one.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "json-schema", derive(schemars::JsonSchema))]
pub struct Response {
    /// The channel, `tm1.accel.x`.
    pub channel: String,
    /// Table of the series.
    pub table: String,
    /// Column of the series, a mean over `[t_k, t_{k+1})`.
    pub series: String,
    /// Unit of the channel per unit of the series and of the coefficients.
    pub factor: f64,
    /// The other coefficient of a product, `com-offset.tm1.x`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub times: Option<String>,
    /// Whether the channel alone differs, not the motion that it reads: what follows the motion does not follow this.
    #[serde(default, skip_serializing_if = "is_false")]
    pub in_readout: bool,
}

#[allow(clippy::trivially_copy_pass_by_ref, reason = "for serde")]
fn is_false(value: &bool) -> bool {
    !value
}

/// One of several forms that a cause may have.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "json-schema", derive(schemars::JsonSchema))]
pub struct Variant {
    /// Values of the shape parameters; given to the effect as parameters they make these responses.
    #[serde(default)]
    pub shape: Shape,
    /// How channels respond.
    pub responses: Vec<Response>,
    /// Unit of the coefficient, where it is not that of the others.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub unit: Option<String>,
    /// Its physical range, lower and upper end, where it is not that of the others.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub range: Option<[f64; 2]>,
    /// A noise process that it filters.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub colours: Option<Colour>,
}

/// A cause of short duration that begins at an unknown time: a hit, a glitch.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "json-schema", derive(schemars::JsonSchema))]
pub struct Transient {
    /// Values of the shape parameters, all but `at_ns`, which the host finds: Unix ns of the sample in which it begins.
    #[serde(default)]
    pub shape: Shape,
    /// Its course, one mean per sample from the one in which it begins.
    pub kernel: Vec<f64>,
    /// Channels with the factor with which the course acts on each: unit of the channel per unit of kernel and
    /// coefficient.
    pub channels: Vec<(String, f64)>,
}

/// How a coefficient c filters a noise process that drives its effect as commands do: `|1 + cH|²` times its power.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "json-schema", derive(schemars::JsonSchema))]
pub struct Colour {
    /// The process, `thruster_force:sc.x`.
    pub process: String,
    /// `H(s)`, s in s⁻¹: coefficients of the numerator's polynomial, the constant first.
    pub numerator: Vec<f64>,
    /// The same of its denominator.
    pub denominator: Vec<f64>,
}

/// A linear constraint on coefficients, `lower ≤ Σ weight · coefficient ≤ upper`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "json-schema", derive(schemars::JsonSchema))]
pub struct Constraint {
    /// Name; constraints of one name from several instances add their terms.
    pub name: String,
    /// `survey`, a measurement with a tolerance, or `range`, a physical bound.
    pub kind: String,
    /// Coefficients with their weights.
    pub terms: Vec<(String, f64)>,
    /// Lower bound; null for none.
    #[serde(default = "minus_infinity", serialize_with = "finite_or_null", deserialize_with = "or_minus_infinity")]
    #[cfg_attr(feature = "json-schema", schemars(with = "Option<f64>"))]
    pub lower: f64,
    /// Upper bound; null for none.
    #[serde(default = "infinity", serialize_with = "finite_or_null", deserialize_with = "or_infinity")]
    #[cfg_attr(feature = "json-schema", schemars(with = "Option<f64>"))]
    pub upper: f64,
    /// SI unit of the bounds.
    #[serde(default)]
    pub unit: String,
    /// Number of instances that must contribute; with fewer the host drops the constraint.
    #[serde(default = "one")]
    pub parts: u32,
}

impl Constraint {
    /// Kind of a measurement with a tolerance.
    pub const SURVEY: &str = "survey";

    /// Whether it is a measurement, and not a physical bound.
    #[must_use]
    pub fn is_survey(&self) -> bool {
        self.kind == Self::SURVEY
    }
}

fn one() -> u32 {
    1
}
