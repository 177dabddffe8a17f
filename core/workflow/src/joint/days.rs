//! Which days enter, and whether their sums can be added.

use std::collections::{BTreeMap, BTreeSet};

use chrono::NaiveDate;
use dragfree_archive::product::{Input, Product};
use dragfree_archive::{Archive, Row};
use dragfree_engine::EngineError;
use dragfree_estimation::stored::Stored;

use super::asked::Options;
use super::calendar::{Calendar, Leaf};
use super::result::{LeftOut, Measured, Value};
use crate::WorkflowError;
use crate::days::day_number;

/// Days with what their products say.
pub(super) type Products = BTreeMap<i64, (Row, Product)>;

/// The newest product of each day that is asked for, of one spacecraft and one pipeline.
pub(crate) fn chosen(archive: &Archive, options: &Options) -> Result<Vec<Row>, WorkflowError> {
    let mut rows: Vec<Row> = archive.newest().map_err(EngineError::from)?.into_iter().map(|entry| entry.row).collect();
    rows.retain(|row| {
        let wanted = options.spacecraft.as_ref().is_none_or(|s| *s == row.spacecraft);
        wanted && row.day.parse().is_ok_and(|day: NaiveDate| (options.first..=options.last).contains(&day))
    });
    let series: BTreeSet<String> = rows.iter().map(|row| format!("{} of {}", row.name, row.spacecraft)).collect();
    if series.len() > 1 {
        let what = series.into_iter().collect::<Vec<_>>().join(", ");
        return Err(WorkflowError::SeveralSeries { what });
    }
    if rows.is_empty() {
        let what = format!("{} to {}: no day has a product", options.first, options.last);
        return Err(WorkflowError::NoDays { what });
    }
    Ok(rows)
}

/// Products that agree with their data, by day, and those that do not.
pub(super) fn products(archive: &Archive, rows: Vec<Row>) -> Result<(Products, Vec<LeftOut>), WorkflowError> {
    let (mut days, mut left_out) = (Products::new(), Vec::new());
    for row in rows {
        let day = row.day.parse::<NaiveDate>().unwrap_or_default();
        let product = archive.document(&row.id).map_err(EngineError::from)?;
        if product.quality.inconsistent {
            let reason = "its model contradicts the data; `dragfree diagnose` asks why".to_owned();
            left_out.push(LeftOut::new(day, &row, reason));
        } else {
            days.insert(day_number(day), (row, product));
        }
    }
    Ok((days, left_out))
}

/// The days' products, as what the calibration is made of: by name without revision and by digest, so that a day with
/// the same result once more changes nothing.
pub(super) fn inputs(days: &Products) -> Vec<Input> {
    let of = |(row, product): &(Row, Product)| Input {
        role: "product".to_owned(),
        name: row.stem().to_owned(),
        size: product.attachments.iter().map(|file| file.size).sum(),
        sha256: product.header.non_standard_attributes.sha256.clone(),
    };
    days.values().map(of).collect()
}

pub(super) fn leaves(archive: &Archive, days: &Products) -> Result<BTreeMap<i64, Leaf>, WorkflowError> {
    days.iter().map(|(day, (_, product))| Ok((*day, Leaf::new(archive, *day, product)?))).collect()
}

/// Whether the sums of all days can be added.
pub(super) fn same_make(calendar: &Calendar, first: i64, like: &Stored) -> Result<(), WorkflowError> {
    let path = |day: i64| calendar.days[&day].path();
    if like.declared.coefficients.is_empty() {
        let what = "its sums are of an earlier version, without ranges and surveys: run the day again".to_owned();
        return Err(WorkflowError::Reference { path: path(first), what });
    }
    let (_, make) = calendar.day(first)?;
    for day in calendar.days.keys() {
        if calendar.day(*day)?.1 != make {
            let other = calendar.stored(*day)?;
            let what = like.unlike(&other).unwrap_or("their version");
            let what = format!(
                "its sums differ from those of {} in {what}, so they cannot be added: run the days with one model, mission \
                 and pipeline",
                calendar.days[&first].product
            );
            return Err(WorkflowError::Reference { path: path(*day), what });
        }
    }
    Ok(())
}

/// The coefficients of a product that are estimated.
pub(super) fn values(product: &Product) -> Vec<Value> {
    let of = |c: &dragfree_archive::product::Coefficient| Value {
        name: c.name.clone(),
        measured: Measured { value: c.value, sigma: c.sigma },
    };
    product.result.adopted().into_iter().map(of).collect()
}
