//! Whether what the model of some products leaves is the noise of the mission.

use std::collections::{BTreeMap, BTreeSet};

use dragfree_archive::product::Product;
use dragfree_engine::run::Progress;
use dragfree_identification::compare::{self, Comparison, Innovations, Nis};
use dragfree_identification::scores::CandidateScorer;
use toml::Table;

use crate::WorkflowError;
use crate::replay::{Pass, Replay, What, sum};

/// Compares the data of products of one model with the declared noise. `progress` is told the pass and the number of
/// the product.
///
/// # Errors
/// [`WorkflowError`]: an input has changed, the products do not belong together, or there is too little data.
pub fn compare(
    replay: &Replay<'_>,
    progress: &mut dyn FnMut(Pass, usize, Progress),
) -> Result<Comparison, WorkflowError> {
    let settings = replay.settings()?;
    let record = sum(replay, settings, What::Model, progress)?;
    let noise = record.noise_model()?;
    let scorer = CandidateScorer::new(&record.candidate_set, &record.gathered, &noise, settings);
    let products = || replay.products.iter().map(|p| &p.product);
    let innovations = Innovations::judge(&octaves(products()), record.gathered.rate_hz, settings.false_alarm);
    Ok(compare::compare(&scorer, nis(products(), settings.false_alarm), innovations)?)
}

/// What a stage says of the innovations of its recursive filters: name of the body, then its figures.
fn filters(stage: &Table) -> impl Iterator<Item = (&str, &Table, &Table)> {
    stage.iter().filter_map(|(body, figures)| {
        let figures = figures.as_table()?;
        Some((body.as_str(), figures, figures.get("innovation_octaves")?.as_table()?))
    })
}

/// Readouts in one update of a stage's filters, their mean where these differ: each filter follows some bodies, each
/// body has some axes.
fn readouts_per_update(stage: &Table) -> Option<f64> {
    let axes = |name: &str| filters(stage).find(|(body, ..)| *body == name).map_or(0, |(.., octaves)| octaves.len());
    let followed = |(body, figures, _): (&str, &Table, &Table)| -> Vec<String> {
        let names = figures.get("followed").and_then(|names| names.as_array());
        let given = names.map(|names| names.iter().filter_map(|n| Some(n.as_str()?.to_owned())).collect());
        given.unwrap_or_else(|| vec![body.to_owned()])
    };
    let each: BTreeSet<Vec<String>> = filters(stage).map(followed).collect();
    let readouts: usize = each.iter().flatten().map(|name| axes(name)).sum();
    (readouts > 0).then(|| readouts as f64 / each.len() as f64)
}

/// Mean normalised innovation squared of the recursive filters of all products together.
fn nis<'a>(products: impl Iterator<Item = &'a Product>, false_alarm: f64) -> Option<Nis> {
    let dof = |p: &Product| {
        let of = |(name, stage): (&String, &Table)| {
            Some(*p.quality.counts.get(name)?.get("updates")? as f64 * readouts_per_update(stage)?)
        };
        p.quality.stages.iter().filter_map(of).sum::<f64>()
    };
    let known = |(nis, dof): &(f64, f64)| nis.is_finite() && *dof > 0.0;
    let all: Vec<(f64, f64)> = products.map(|p| (p.quality.nis, dof(p))).filter(known).collect();
    let dof: f64 = all.iter().map(|(_, n)| n).sum();
    (!all.is_empty()).then(|| Nis::new(all.iter().map(|(nis, n)| nis * n).sum::<f64>() / dof, dof, false_alarm))
}

/// Mean square and count of each readout's innovations, octave by octave, of all products together.
fn octaves<'a>(products: impl Iterator<Item = &'a Product>) -> BTreeMap<String, Vec<(f64, u64)>> {
    let mut all: BTreeMap<String, Vec<(f64, u64)>> = BTreeMap::new();
    for (body, _, axes) in products.flat_map(|p| p.quality.stages.values()).flat_map(filters) {
        for (axis, octaves) in axes {
            let numbers = |key: &str| octaves.get(key).and_then(|x| x.as_array()).into_iter().flatten();
            let sum = all.entry(format!("{body}.{axis}")).or_default();
            for (k, (power, n)) in numbers("power").zip(numbers("count")).enumerate() {
                let (power, n) = (power.as_float().unwrap_or(0.0), n.as_integer().unwrap_or(0).max(0) as u64);
                if sum.len() == k {
                    sum.push((0.0, 0));
                }
                let (mean, count) = sum[k];
                let total = (count + n).max(1);
                sum[k] = ((mean * count as f64 + power * n as f64) / total as f64, count + n);
            }
        }
    }
    all
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A stage whose filters follow these bodies, of three axes each.
    fn stage(filters: &[&[&str]]) -> Table {
        let octaves = "innovation_octaves = { x = {}, y = {}, z = {} }";
        let bodies = filters.iter().flat_map(|followed| followed.iter().map(move |body| (body, followed)));
        let text: Vec<String> =
            bodies.map(|(body, followed)| format!("[{body}]\nfollowed = {followed:?}\n{octaves}\n")).collect();
        text.concat().parse().expect("TOML")
    }

    /// Two filters of three readouts have three an update, one filter of both bodies has six: with three its bounds
    /// were √2 too wide.
    #[test]
    fn a_joint_filter_has_six_readouts_an_update() {
        assert_eq!(readouts_per_update(&stage(&[&["tm1"], &["tm2"]])), Some(3.0));
        assert_eq!(readouts_per_update(&stage(&[&["tm1", "tm2"]])), Some(6.0));
        assert_eq!(readouts_per_update(&stage(&[&["tm1"]])), Some(3.0));
        assert_eq!(readouts_per_update(&Table::new()), None);
        let width = |dof: f64| Nis::new(1.0, dof, 0.01).bounds.map(|b| b - 1.0);
        // Of χ²/dof the bounds narrow as 1/√dof.
        let [three, six] = [3e6, 6e6].map(width);
        assert!((0..2).all(|i| (three[i] / six[i] - 2f64.sqrt()).abs() < 1e-2), "{three:?} {six:?}");
    }
}
