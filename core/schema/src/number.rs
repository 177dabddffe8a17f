//! Numbers that JSON cannot write: `null` stands for NaN and for an open end of a range.

use serde::{Deserialize, Deserializer, Serialize, Serializer};

pub(crate) fn finite_or_null<S: Serializer>(value: &f64, serializer: S) -> Result<S::Ok, S::Error> {
    value.is_finite().then_some(*value).serialize(serializer)
}

pub(crate) fn or_infinity<'de, D: Deserializer<'de>>(deserializer: D) -> Result<f64, D::Error> {
    Ok(Option::deserialize(deserializer)?.unwrap_or(f64::INFINITY))
}

pub(crate) fn or_minus_infinity<'de, D: Deserializer<'de>>(deserializer: D) -> Result<f64, D::Error> {
    Ok(Option::deserialize(deserializer)?.unwrap_or(f64::NEG_INFINITY))
}

pub(crate) fn infinity() -> f64 {
    f64::INFINITY
}

pub(crate) fn minus_infinity() -> f64 {
    f64::NEG_INFINITY
}

/// A matrix whose entries may be NaN. `serde_json` writes NaN as `null` by itself.
pub(crate) fn matrix<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Vec<Vec<f64>>, D::Error> {
    let rows: Vec<Vec<Option<f64>>> = Vec::deserialize(deserializer)?;
    Ok(rows.into_iter().map(|row| row.into_iter().map(|x| x.unwrap_or(f64::NAN)).collect()).collect())
}
