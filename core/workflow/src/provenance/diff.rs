//! What differs between two products.

use dragfree_archive::product::{Coefficient, Product, Stage};
use serde::Serialize;
use std::collections::BTreeMap;

/// What differs between two products.
#[derive(Clone, Debug, Serialize)]
pub struct Diff {
    /// The earlier one.
    pub first: String,
    /// The later one.
    pub second: String,
    /// Whether both have the same digest: the same result from the same inputs, plugins, parameters and model.
    pub same: bool,
    /// Coefficients of the adopted solutions, in the order of the first.
    pub values: Vec<ValueChange>,
    /// Files that were read.
    pub inputs: Vec<Change>,
    /// Plugins, their versions and their libraries.
    pub plugins: Vec<Change>,
    /// Parameters of plugins, and thresholds.
    pub parameters: Vec<Change>,
    /// Revision and effects of the model.
    pub model: Vec<Change>,
    /// Window, program, epochs, quality.
    pub other: Vec<Change>,
}

/// A coefficient in two products.
#[derive(Clone, Debug, Serialize)]
pub struct ValueChange {
    /// `com-offset.tm1.x`.
    pub name: String,
    /// SI unit.
    pub unit: String,
    /// Value in the first; none where it has no such coefficient.
    pub first: Option<f64>,
    /// Its σ.
    pub first_sigma: Option<f64>,
    /// Value in the second.
    pub second: Option<f64>,
    /// Its σ.
    pub second_sigma: Option<f64>,
    /// Difference over the larger of the two σ; of products that share data it is no test.
    pub sigmas: Option<f64>,
}

/// Something that is not the same.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Change {
    /// What, `telemetry SC1_2035-01-01.mcap`.
    pub what: String,
    /// In the first; none where it is not there.
    pub first: Option<String>,
    /// In the second.
    pub second: Option<String>,
}

/// Compares two products.
pub fn diff(first: &Product, second: &Product) -> Diff {
    Diff {
        first: first.id().to_owned(),
        second: second.id().to_owned(),
        same: first.digest() == second.digest(),
        values: values(first, second),
        inputs: changes(inputs(first), inputs(second)),
        plugins: changes(plugins(first, library), plugins(second, library)),
        parameters: changes(parameters(first), parameters(second)),
        model: changes(model(first), model(second)),
        other: changes(other(first), other(second)),
    }
}

fn values(first: &Product, second: &Product) -> Vec<ValueChange> {
    let (a, b) = (first.result.adopted(), second.result.adopted());
    let find = |all: &[&Coefficient], name: &str| all.iter().find(|c| c.name == name).map(|c| (c.value, c.sigma));
    let mut names: Vec<(&str, &str)> = Vec::new();
    for c in a.iter().chain(&b) {
        if !names.iter().any(|(name, _)| *name == c.name) {
            names.push((&c.name, &c.unit));
        }
    }
    let change = |(name, unit): (&str, &str)| {
        let (a, b) = (find(&a, name), find(&b, name));
        let sigmas = a.zip(b).map(|((x, s), (y, t))| (y - x) / s.max(t)).filter(|q| q.is_finite());
        let finite = |x: f64| Some(x).filter(|x| x.is_finite());
        ValueChange {
            name: name.to_owned(),
            unit: unit.to_owned(),
            first: a.and_then(|(x, _)| finite(x)),
            first_sigma: a.and_then(|(_, s)| finite(s)),
            second: b.and_then(|(x, _)| finite(x)),
            second_sigma: b.and_then(|(_, s)| finite(s)),
            sigmas,
        }
    };
    names.into_iter().map(change).collect()
}

/// Entries that are not alike, in the order of their names.
fn changes(first: BTreeMap<String, String>, mut second: BTreeMap<String, String>) -> Vec<Change> {
    let mut all = Vec::new();
    for (what, first) in first {
        let second = second.remove(&what);
        if second.as_ref() != Some(&first) {
            all.push(Change { what, first: Some(first), second });
        }
    }
    all.extend(second.into_iter().map(|(what, second)| Change { what, first: None, second: Some(second) }));
    all
}

fn inputs(product: &Product) -> BTreeMap<String, String> {
    let entry = |input: &dragfree_archive::product::Input| {
        (format!("{} {}", input.role, input.name), format!("{} bytes, {}", input.size, input.sha256))
    };
    product.inputs.iter().map(entry).collect()
}

fn plugins(product: &Product, what: impl Fn(&Stage) -> String) -> BTreeMap<String, String> {
    let name = |stage: &Stage| match stage.instance.as_str() {
        "" => stage.plugin.clone(),
        instance => format!("{}:{instance}", stage.plugin),
    };
    product.history.iter().map(|stage| (name(stage), what(stage))).collect()
}

fn library(stage: &Stage) -> String {
    let Stage { version, library_sha256, .. } = stage;
    format!("{version}, library {library_sha256}")
}

fn parameters(product: &Product) -> BTreeMap<String, String> {
    let mut all = plugins(product, |stage| stage.parameters_sha256.clone());
    let settings = serde_json::to_value(&product.settings).unwrap_or_default();
    for (name, value) in settings.as_object().into_iter().flatten() {
        all.insert(format!("[settings] {name}"), value.to_string());
    }
    all
}

fn model(product: &Product) -> BTreeMap<String, String> {
    let mut all = BTreeMap::from([("revision".to_owned(), product.model.revision.clone())]);
    all.extend(product.model.effects.iter().map(|effect| (format!("effect {effect}"), "in the model".to_owned())));
    let level = |l: &dragfree_archive::product::NoiseLevel| (format!("level {}", l.coefficient), l.value.to_string());
    all.extend(product.model.noise_levels.iter().map(level));
    all
}

fn other(product: &Product) -> BTreeMap<String, String> {
    let attributes = &product.header.non_standard_attributes;
    let quality = &product.quality;
    let loss = |l: &dragfree_archive::product::Loss| (format!("loss {}", l.kind), l.count.to_string());
    let mut all = BTreeMap::from([
        ("program".to_owned(), attributes.software_version.clone()),
        ("first epoch, ns".to_owned(), attributes.start_time_epoch_ns.to_string()),
        ("last epoch, ns".to_owned(), attributes.stop_time_epoch_ns.to_string()),
        ("epochs used".to_owned(), quality.epochs_used.to_string()),
        ("epochs rejected".to_owned(), quality.epochs_rejected.to_string()),
        ("verdict".to_owned(), product.result.verdict.clone().unwrap_or_default()),
        ("χ²/dof".to_owned(), quality.chi2_per_dof.to_string()),
        ("NIS".to_owned(), quality.nis.to_string()),
    ]);
    all.extend(product.losses.iter().map(loss));
    all.insert("notes".to_owned(), quality.notes.join("; "));
    all
}
