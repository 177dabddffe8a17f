//! A calibration of many days as a product of the archive, `COM2`, and what it says of a time.

use chrono::{DateTime, Utc};
use dragfree_archive::files::IoContext as _;
use dragfree_archive::product::{self, Coefficient, Product};
use dragfree_archive::{Archive, ArchiveError, JOINT, MadeOf, Place, ProductWriter, Window, Written, stem};
use dragfree_engine::EngineError;
use dragfree_engine::draft::Draft;
use dragfree_engine::feed::Summary;
use dragfree_schema::{Attachment, Covariance, Estimate, Report, Role};
use nalgebra::{DMatrix, DVector};
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use std::path::Path;

use super::{Declared, Joint};
use crate::WorkflowError;
use crate::days::{day_number, start_of_day_ns};

/// What makes the product, among its notes and figures.
const MAKER: &str = "joint";

/// Name of a rate among the coefficients of a product.
pub(super) fn rate(of: &str) -> String {
    format!("{of}{RATE}")
}

/// Name of a step among the coefficients of a product.
pub(super) fn step(of: &str, time_ns: i64) -> String {
    format!("{of}{STEP}{}", DateTime::from_timestamp_nanos(time_ns).format("%Y-%m-%dT%H:%M:%S"))
}

/// Suffix of the table of days beside a product.
const DAYS: &str = "days.json";

/// Role of the file of events among what is kept.
pub(super) const EVENTS: &str = "events";

/// Role of what was asked for among what is kept.
const ASKED: &str = "asked";

const RATE: &str = ".rate";
const STEP: &str = ".step.";

/// Archives a calibration of many days. One that is there already with the same result is given instead, and false.
///
/// # Errors
/// The archive cannot be written.
pub fn archived(
    archive: &Archive,
    joint: &Joint,
    created: DateTime<Utc>,
    software: &str,
) -> Result<(Written, bool), WorkflowError> {
    Ok(commit(archive.folder(), joint, created, software).map_err(EngineError::from)?)
}

fn commit(
    folder: &Path,
    joint: &Joint,
    created: DateTime<Utc>,
    software: &str,
) -> Result<(Written, bool), ArchiveError> {
    let (draft, window) = draft(joint, created, software);
    let mut writer = ProductWriter::begin(folder)?;
    if let Some((name, text)) = &joint.declared.file {
        writer.keep(EVENTS, name, text.as_bytes())?;
    }
    let left_out = joint.left_out.iter().map(|l| (stem(&l.product).to_owned(), l.sha256.clone())).collect();
    let asked = json!(Asked { declared: joint.declared.clone(), left_out });
    writer.keep(ASKED, "asked.json", asked.to_string().as_bytes())?;
    draft.commit_if_new(writer, MadeOf { window, ..MadeOf::default() })
}

/// Makes a calibration of many days again, from the products that it was made of, in another archive.
///
/// # Errors
/// One of these products is gone or damaged, or the archive cannot be written.
pub fn again(
    archive: &Archive,
    id: &str,
    apart: &Path,
    created: DateTime<Utc>,
    software: &str,
) -> Result<Written, WorkflowError> {
    let made = || -> Result<_, ArchiveError> {
        let Asked { mut declared, left_out } = asked(archive, id)?;
        let inputs = archive.inputs(id)?.into_iter().map(|input| (input.name, input.sha256));
        let all = inputs.chain(left_out);
        let rows = all.map(|(stem, sha256)| archive.with_digest(&stem, &sha256)).collect::<Result<Vec<_>, _>>()?;
        if let Some(Place { name, path: Some(path), .. }) = archive.made_of(id, EVENTS)? {
            let text = std::fs::read_to_string(&path).at("read", &path)?;
            declared.file = Some((name, text));
        }
        Ok((rows, declared))
    };
    let (rows, declared) = made().map_err(EngineError::from)?;
    let joint = super::of_products(archive, rows, declared)?;
    Ok(commit(apart, &joint, created, software).map_err(EngineError::from)?.0)
}

/// The table of days, with products by their names without revision, as among the inputs.
fn table(joint: &Joint) -> Value {
    let mut table = json!(joint);
    for list in ["days", "left_out"] {
        for day in table[list].as_array_mut().into_iter().flatten() {
            day["product"] = stem(day["product"].as_str().unwrap_or_default()).into();
        }
    }
    table
}

/// What a calibration was asked for, as the archive keeps it.
#[derive(Serialize, Deserialize)]
pub(super) struct Asked {
    pub(super) declared: Declared,
    /// Days that were left out: names of their products without revision, and digests.
    pub(super) left_out: Vec<(String, String)>,
}

/// What a calibration of the archive was asked for.
pub(super) fn asked(archive: &Archive, id: &str) -> Result<Asked, ArchiveError> {
    let gone =
        || ArchiveError::NotFound { id: format!("what {id} was asked for"), folder: archive.folder().to_owned() };
    let path = archive.made_of(id, ASKED)?.and_then(|place| place.path).ok_or_else(gone)?;
    let text = std::fs::read(&path).at("read", &path)?;
    serde_json::from_slice(&text).map_err(|e| ArchiveError::Damaged { path, reason: e.to_string() })
}

/// The product, and the time that it is of.
fn draft(joint: &Joint, created: DateTime<Utc>, software: &str) -> (Draft, Window) {
    let like = &joint.like;
    let attributes = &like.header.non_standard_attributes;
    let (from, until) = (start_of_day_ns(day_number(joint.first)), start_of_day_ns(day_number(joint.last) + 1));
    let draft = Draft {
        pipeline: like.header.global_attributes.source.clone(),
        product: JOINT.to_owned(),
        release: attributes.release,
        mission: like.header.global_attributes.project.clone(),
        spacecraft: joint.spacecraft.clone(),
        first_ns: from,
        last_ns: attributes.stop_time_epoch_ns,
        inputs: joint.inputs.clone(),
        history: Vec::new(),
        model: like.model.clone(),
        software: software.to_owned(),
        replay: Summary { time_scale: attributes.time_scale.clone(), ..Summary::default() },
        reports: vec![report(joint)],
        settings: like.settings.clone(),
        stream: attributes.stream,
        status: attributes.status,
        created,
    };
    (draft, Window { from_ns: Some(from), until_ns: Some(until) })
}

fn report(joint: &Joint) -> Report {
    let disagree = !joint.agrees();
    let verdict = match (disagree, joint.weak.is_empty()) {
        (true, _) => "disagree",
        (false, false) => "weak",
        (false, true) => "agree",
    };
    let mut coefficients = Vec::new();
    for c in &joint.coefficients {
        let mut add = |name: String, unit: String, value: f64, sigma: f64| {
            coefficients.push(Estimate {
                name,
                solution: MAKER.to_owned(),
                role: Some(Role::Adopted),
                value: Some(value),
                sigma: Some(sigma),
                unit,
                frame: c.frame.clone(),
            });
        };
        add(c.name.clone(), c.unit.clone(), c.value, c.sigma);
        for step in &c.steps {
            add(self::step(&c.name, step.time_ns), c.unit.clone(), step.changed.size.value, step.changed.size.sigma);
        }
        if let Some(per_s) = c.rate {
            let unit = if c.unit == "1" { "1/s".to_owned() } else { format!("{}/s", c.unit) };
            add(rate(&c.name), unit, per_s.size.value, per_s.size.sigma);
        }
    }
    let mut notes = joint.notes.clone();
    notes.extend(joint.left_out.iter().map(|l| format!("{} is left out: {}", stem(&l.product), l.reason)));
    if disagree {
        notes.push(format!(
            "the days are not all the same: χ² {:.1} on {}, probability {:.1e}",
            joint.same.chi2, joint.same.dof, joint.same.p
        ));
    }
    let quality =
        [("same_every_day", json!(joint.same)), ("days", joint.days.len().into()), ("widened", json!(joint.widened))];
    Report {
        plugin: MAKER.to_owned(),
        coefficients,
        covariance: joint
            .covariance
            .iter()
            .map(|(names, matrix)| (MAKER.to_owned(), Covariance { names: names.clone(), matrix: matrix.clone() }))
            .collect(),
        verdict: Some(verdict.to_owned()),
        weak_directions: joint.weak.clone(),
        chi2_per_dof: Some(joint.chi2_per_dof),
        inconsistent: disagree,
        notes,
        quality: quality.into_iter().map(|(k, v)| (k.to_owned(), v)).collect(),
        attachments: vec![Attachment { suffix: DAYS.to_owned(), text: table(joint).to_string() }],
        ..Report::default()
    }
}

/// Rate of a coefficient among the recommended ones of a product, per s; none where it has none.
pub fn rate_of<'a>(product: &'a Product, name: &str) -> Option<&'a Coefficient> {
    let name = rate(name);
    product.result.adopted().into_iter().find(|c| c.name == name)
}

/// What a product says of a time.
#[derive(Clone, Debug)]
pub struct At {
    /// Coefficients, with the values that they have then.
    pub coefficients: Vec<Coefficient>,
    /// The covariance of those that are estimated; none where the product has none.
    pub covariance: Option<product::Covariance>,
}

/// The recommended coefficients of a product at a time, Unix ns. Those of one day are constant; in one of many days a
/// rate and the steps until then are counted in, and do not stand beside.
pub fn at(product: &Product, time_ns: i64) -> At {
    let adopted = product.result.adopted();
    let solution = adopted.first().map_or("", |c| c.solution.as_str());
    let covariance = product.result.covariance.get(solution);
    let names: Vec<&str> = match covariance {
        Some(covariance) => covariance.names.iter().map(String::as_str).collect(),
        None => adopted.iter().map(|c| c.name.as_str()).collect(),
    };
    let values =
        DVector::from_fn(names.len(), |k, _| adopted.iter().find(|c| c.name == names[k]).map_or(f64::NAN, |c| c.value));
    let is_many = product.header.non_standard_attributes.product == JOINT;
    // Values are those at the epoch: what came between is taken off.
    let before_s = (product.result.epoch_ns - time_ns) as f64 * 1e-9;
    let change = |of: &str, name: &str| -> f64 {
        match name.strip_prefix(of) {
            Some(RATE) => -before_s,
            Some(rest) => {
                let time = rest.strip_prefix(STEP).and_then(|t| format!("{t}Z").parse::<DateTime<Utc>>().ok());
                let later = time.and_then(|t| t.timestamp_nanos_opt()).is_some_and(|step_ns| time_ns < step_ns);
                if later { -1.0 } else { 0.0 }
            }
            None => 0.0,
        }
    };
    let is_change = |name: &str| is_many && (name.ends_with(RATE) || name.contains(STEP));
    let told: Vec<&Coefficient> = adopted.iter().filter(|c| !is_change(&c.name)).copied().collect();
    let Some(estimated) = covariance.filter(|_| is_many) else {
        return At { coefficients: told.into_iter().cloned().collect(), covariance: covariance.cloned() };
    };
    let known: Vec<&Coefficient> = told.iter().filter(|c| estimated.names.contains(&c.name)).copied().collect();
    let weights = DMatrix::from_fn(known.len(), names.len(), |i, j| {
        if known[i].name == names[j] { 1.0 } else { change(&known[i].name, names[j]) }
    });
    let matrix = DMatrix::from_fn(names.len(), names.len(), |i, j| estimated.matrix[i][j]);
    let (values, matrix) = (&weights * values, &weights * matrix * weights.transpose());
    let of = |c: &Coefficient| match known.iter().position(|k| k.name == c.name) {
        Some(i) => Coefficient { value: values[i], sigma: matrix[(i, i)].max(0.0).sqrt(), ..c.clone() },
        None => c.clone(),
    };
    At {
        coefficients: told.into_iter().map(of).collect(),
        covariance: Some(product::Covariance {
            names: known.iter().map(|c| c.name.clone()).collect(),
            matrix: matrix.row_iter().map(|row| row.iter().copied().collect()).collect(),
        }),
    }
}
