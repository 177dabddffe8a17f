//! What is told of many days.

use chrono::NaiveDate;
use dragfree_archive::Row;
use dragfree_archive::product::{Input, Product};
use dragfree_identification::distributions::chi2_tails;
use serde::Serialize;

use super::asked::Declared;
use super::events::Event;

/// One calibration of many days.
#[derive(Clone, Debug, Serialize)]
pub struct Joint {
    /// Spacecraft.
    pub spacecraft: String,
    /// First day that was asked for.
    pub first: NaiveDate,
    /// Last day that was asked for.
    pub last: NaiveDate,
    /// Time of the values, the end of the data, Unix ns of the days' time scale.
    pub epoch_ns: i64,
    /// Coefficients at that time, with their changes.
    pub coefficients: Vec<Coefficient>,
    /// Whether the days agree with it.
    pub same: Agreement,
    /// χ² per degree of freedom of the residuals, with the declared noise.
    pub chi2_per_dof: f64,
    /// Factor by which σ is widened because the days differ more than their noise says; 1 where they do not.
    pub widened: f64,
    /// Directions that the data do not determine.
    pub weak: Vec<String>,
    /// Days that entered, in order.
    pub days: Vec<Day>,
    /// Days with a product that did not, and why.
    pub left_out: Vec<LeftOut>,
    /// Days that were asked for and have no product.
    pub missing: Vec<NaiveDate>,
    /// Events that lie between days.
    pub events: Vec<Event>,
    /// What was declared of events.
    pub declared: Declared,
    /// Sentences.
    pub notes: Vec<String>,
    /// Covariance of all that was estimated, in the units of the product.
    #[serde(skip)]
    pub(super) covariance: Option<(Vec<String>, Vec<Vec<f64>>)>,
    #[serde(skip)]
    pub(super) like: Product,
    #[serde(skip)]
    pub(super) inputs: Vec<Input>,
}

/// A coefficient of all days.
#[derive(Clone, Debug, Serialize)]
pub struct Coefficient {
    /// `com-offset.tm1.x`
    pub name: String,
    /// SI unit.
    pub unit: String,
    /// Frame, empty where there is none.
    pub frame: String,
    /// Value at the end of the data.
    pub value: f64,
    /// Its standard deviation.
    pub sigma: f64,
    /// Constant rate, per s; none where it is known to be zero, or with too few days.
    pub rate: Option<Changed>,
    /// Steps at events that change it.
    pub steps: Vec<Step>,
}

/// A value.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct Measured {
    /// Value.
    pub value: f64,
    /// Standard deviation.
    pub sigma: f64,
}

/// A rate, or the size of a step.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct Changed {
    /// Value and σ.
    #[serde(flatten)]
    pub size: Measured,
    /// Whether it stands out from the noise, at the false-alarm rate of the settings for all rates, or steps, together.
    pub seen: bool,
}

/// A step of a coefficient.
#[derive(Clone, Debug, Serialize)]
pub struct Step {
    /// Times of the events, as they are written.
    pub events: Vec<String>,
    /// Its size.
    #[serde(flatten)]
    pub changed: Changed,
    /// Time of the last of its events, Unix ns.
    #[serde(skip)]
    pub(super) time_ns: i64,
}

/// A day.
#[derive(Clone, Debug, Serialize)]
pub struct Day {
    /// Day.
    pub day: NaiveDate,
    /// Its product.
    pub product: String,
    /// Digest of that.
    pub sha256: String,
    /// The values of the product.
    pub values: Vec<Value>,
    /// Whether the day agrees with all days.
    #[serde(flatten)]
    pub agreement: Agreement,
}

/// A coefficient as a day's product has it.
#[derive(Clone, Debug, Serialize)]
pub struct Value {
    /// Coefficient.
    pub name: String,
    /// Value and σ.
    #[serde(flatten)]
    pub measured: Measured,
}

/// A χ² with its probability.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Agreement {
    /// χ².
    pub chi2: f64,
    /// Degrees of freedom.
    pub dof: usize,
    /// Probability of a larger one where there is agreement.
    pub p: f64,
}

impl Agreement {
    pub(super) fn new(chi2: f64, dof: usize) -> Self {
        let p = if dof == 0 { 1.0 } else { chi2_tails(chi2 / dof as f64, dof as f64).1 };
        Self { chi2, dof, p }
    }
}

/// A day that did not enter.
#[derive(Clone, Debug, Serialize)]
pub struct LeftOut {
    /// Day.
    pub day: NaiveDate,
    /// Its product.
    pub product: String,
    /// Digest of that.
    pub sha256: String,
    /// Why.
    pub reason: String,
}

impl LeftOut {
    pub(super) fn new(day: NaiveDate, row: &Row, reason: String) -> Self {
        Self { day, product: row.id.clone(), sha256: row.digest.clone().unwrap_or_default(), reason }
    }
}

impl Joint {
    /// Whether what fits all days fits each.
    pub fn agrees(&self) -> bool {
        self.same.p >= self.like.settings.false_alarm
    }
}
