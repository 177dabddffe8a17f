//! What a refit gives.

use std::collections::BTreeMap;

use serde::Serialize;
use serde_json::{Map, Value};

use crate::residuals::Residuals;

/// The model with some effects switched on.
#[derive(Clone, Debug, Serialize)]
pub struct Refit {
    /// Products of the fit.
    pub products: Vec<String>,
    /// Products that are kept out, and stretches of time of products.
    pub held_out: Vec<String>,
    /// What the channels of the products of the fit leave in each band; none where an extract does not tell.
    pub spectra: Option<Spectra>,
    /// Whitened innovations in the fit.
    pub numbers: f64,
    /// The model, then one more effect each.
    pub rungs: Vec<Rung>,
    /// Effects: those that are on in their order, then the others by significance beside them.
    pub effects: Vec<Effect>,
    /// Other effects, too insignificant to be told.
    pub not_told: usize,
}

/// The model with the first effects that are on.
#[derive(Clone, Debug, Serialize)]
pub struct Rung {
    /// The effect that this rung adds; none for the model alone.
    pub added: Option<String>,
    /// χ² of the fit: the squares of the whitened innovations, with every day's levels of noise fitted, and of the
    /// surveys.
    pub chi2: f64,
    /// By how much it is below that of the model alone.
    pub fall: f64,
    /// χ² of the products that are kept out, at the values of the fit; none where all are in the fit.
    pub held_out_chi2: Option<f64>,
    /// By how much that is below that of the model alone.
    pub held_out_fall: Option<f64>,
    /// Coefficients of the model that are lengths.
    pub offsets: Vec<Offset>,
    /// Their covariance, m², rows in the order of `offsets`.
    pub covariance_m2: Vec<Vec<f64>>,
}

/// An offset of the model.
#[derive(Clone, Debug, Serialize)]
pub struct Offset {
    /// `com-offset.NAME.AXIS`
    pub name: String,
    /// Value, m.
    pub value_m: f64,
    /// Standard deviation, m.
    pub sigma_m: f64,
    /// Frame, empty where there is none.
    pub frame: String,
}

/// An effect beside those that are on, or one of them.
#[derive(Clone, Debug, Serialize)]
pub struct Effect {
    /// `EFFECT:INSTANCE`, with a number behind it where the effect is there in several forms.
    pub name: String,
    /// Effect.
    pub effect: String,
    /// Instance.
    pub instance: String,
    /// Values of the shape parameters.
    pub shape: Map<String, Value>,
    /// The forms in which it can be, itself among them; empty where there is one.
    pub forms: Vec<Form>,
    /// Whether it is on.
    pub on: bool,
    /// Whether the diagnosis of a product names it.
    pub named: bool,
    /// Whether it states a level of noise. The sums have the levels fitted already, so that it moves no offset.
    pub is_noise: bool,
    /// Coefficients inside their ranges.
    pub coefficients: Vec<Size>,
    /// Fall of χ² beside the others that are on.
    pub delta_chi2: f64,
    /// p-value, corrected for everything that the diagnoses tried.
    pub p_value: f64,
    /// Its decimal logarithm.
    pub log10_p_value: f64,
    /// Whether the data want values outside its physical range.
    pub out_of_range: bool,
    /// Channels on which it acts.
    pub channels: Vec<String>,
    /// By how much each offset is wrong without it, m.
    pub offset_shift_m: BTreeMap<String, f64>,
    /// What these data cannot tell from it, of the effects told.
    pub confounders: Vec<Confounder>,
}

/// A form of an effect.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Form {
    /// As [`Effect::name`].
    pub name: String,
    /// Values of the shape parameters.
    pub shape: Map<String, Value>,
}

/// An effect that explains nearly the same.
#[derive(Clone, Debug, Serialize)]
pub struct Confounder {
    /// Effect.
    pub name: String,
    /// Expected rise of χ² with it in the place of the other.
    pub chi2: f64,
}

/// A coefficient of an effect.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Size {
    /// Name.
    pub name: String,
    /// Value in `unit`.
    pub value: f64,
    /// Standard deviation in `unit`.
    pub sigma: f64,
    /// SI unit.
    pub unit: String,
}

/// What the channels leave in each group of bands, over the power of the noise.
#[derive(Clone, Debug, Serialize)]
pub struct Spectra {
    /// With the model alone.
    pub before: Residuals,
    /// With the effects that are on.
    pub now: Residuals,
    /// By how much χ² of each channel's spectrum falls: what the channels have in common is left aside.
    pub fall: Vec<f64>,
}

/// A stretch of the time of a product.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Stretch {
    /// As it is kept out: `PRODUCT@2`.
    pub name: String,
    /// Begin, Unix ns.
    pub from_ns: i64,
    /// End, Unix ns.
    pub until_ns: i64,
}
