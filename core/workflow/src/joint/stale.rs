//! Which calibrations of many days would come out otherwise now.

use std::collections::{BTreeMap, BTreeSet};

use chrono::NaiveDate;
use dragfree_archive::{Archive, JOINT, Row};
use dragfree_engine::EngineError;
use serde::Serialize;

use super::product::{DAYS, Table};
use crate::WorkflowError;
use crate::days::{DAY_NS, day_number};

/// A calibration of many days that would come out otherwise now.
#[derive(Clone, Debug, Serialize)]
pub struct Stale {
    /// The product.
    pub product: String,
    /// Why.
    pub reasons: Vec<String>,
}

/// Calibrations of many days, the newest of each first day, of which a day has another product now.
///
/// # Errors
/// The archive cannot be read.
pub fn stale(archive: &Archive) -> Result<Vec<Stale>, WorkflowError> {
    let days: Vec<Row> = archive.newest().map_err(EngineError::from)?.into_iter().map(|entry| entry.row).collect();
    let mut newest: BTreeMap<String, Row> = BTreeMap::new();
    for row in archive.named(JOINT).map_err(EngineError::from)? {
        if row.withdrawn.is_none() && row.problem.is_none() {
            newest.insert(format!("{} {}", row.spacecraft, row.day), row);
        }
    }
    let mut stale = Vec::new();
    for row in newest.into_values() {
        let reasons = reasons(archive, &row, &days)?;
        if !reasons.is_empty() {
            stale.push(Stale { product: row.id, reasons });
        }
    }
    Ok(stale)
}

fn reasons(archive: &Archive, row: &Row, days: &[Row]) -> Result<Vec<String>, WorkflowError> {
    let product = archive.document(&row.id).map_err(EngineError::from)?;
    let table = archive.read_file(&row.id, DAYS).map_err(EngineError::from)?;
    let left_out = serde_json::from_slice::<Table>(&table).unwrap_or_default().left_out;
    let of_inputs = product.inputs.iter().map(|input| input.sha256.as_str());
    let known: BTreeSet<&str> = of_inputs.chain(left_out.iter().map(|left| left.sha256.as_str())).collect();
    let covered = |day: &str| {
        let day = day.parse::<NaiveDate>().ok().map(day_number);
        let edge = |ns: Option<i64>| ns.map(|ns| ns.div_euclid(DAY_NS));
        day.zip(edge(row.asked_from_ns)).zip(edge(row.asked_until_ns)).is_some_and(|((d, a), b)| (a..b).contains(&d))
    };
    let mut reasons = Vec::new();
    let own: Vec<&Row> = days.iter().filter(|day| day.spacecraft == row.spacecraft && covered(&day.day)).collect();
    let digest = |day: &Row| day.digest.clone().unwrap_or_default();
    for day in own.iter().filter(|day| !known.contains(digest(day).as_str())) {
        reasons.push(format!("{} is new, or has another result", day.id));
    }
    let gone = product.inputs.iter().filter(|input| own.iter().all(|day| day.stem() != input.name));
    reasons.extend(gone.map(|input| format!("{} has no product any more", input.name)));
    Ok(reasons)
}
