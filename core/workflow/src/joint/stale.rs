//! Which calibrations of many days would come out otherwise now.

use std::collections::{BTreeMap, BTreeSet};

use chrono::NaiveDate;
use dragfree_archive::files::sha256;
use dragfree_archive::{Archive, JOINT, Row};
use dragfree_engine::EngineError;
use serde::Serialize;

use super::asked::Declared;
use super::product::{EVENTS, asked};
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

/// Calibrations of many days, the newest of each time and all that are certified, that would come out otherwise now.
/// `now` is what is declared of events now.
///
/// # Errors
/// The archive cannot be read.
pub fn stale(archive: &Archive, now: &Declared) -> Result<Vec<Stale>, WorkflowError> {
    let days: Vec<Row> = archive.newest().map_err(EngineError::from)?.into_iter().map(|entry| entry.row).collect();
    let certified: BTreeSet<String> =
        archive.validity(None).map_err(EngineError::from)?.into_iter().map(|validity| validity.id).collect();
    let mut watched: BTreeMap<(String, Option<i64>, Option<i64>), Row> = BTreeMap::new();
    let mut others = Vec::new();
    for row in archive.named(JOINT).map_err(EngineError::from)? {
        if row.withdrawn.is_some() || row.problem.is_some() {
            continue;
        }
        let before = watched.insert((row.spacecraft.clone(), row.asked_from_ns, row.asked_until_ns), row);
        others.extend(before.filter(|before| certified.contains(&before.id)));
    }
    let mut stale = Vec::new();
    for row in others.into_iter().chain(watched.into_values()) {
        let reasons = reasons(archive, &row, &days, now)?;
        if !reasons.is_empty() {
            stale.push(Stale { product: row.id, reasons });
        }
    }
    stale.sort_by(|a: &Stale, b| a.product.cmp(&b.product));
    Ok(stale)
}

fn reasons(archive: &Archive, row: &Row, days: &[Row], now: &Declared) -> Result<Vec<String>, WorkflowError> {
    let product = archive.document(&row.id).map_err(EngineError::from)?;
    let left_out = asked(archive, &row.id).map_err(EngineError::from)?.left_out;
    let of_inputs = product.inputs.iter().map(|input| input.sha256.as_str());
    let known: BTreeSet<&str> = of_inputs.chain(left_out.iter().map(|(_, sha256)| sha256.as_str())).collect();
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
    let events = archive.made_of(&row.id, EVENTS).map_err(EngineError::from)?;
    if let (Some(kept), Some((name, text))) = (events, &now.file)
        && kept.name == *name
        && kept.sha256 != sha256(text)
    {
        reasons.push(format!("the events of {name} are others now"));
    }
    Ok(reasons)
}
