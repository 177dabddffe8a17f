//! What a run knows at its end, and how it becomes a product.

use crate::border::without_name;
use crate::feed::Summary;
use crate::replay::Finding;
use chrono::{DateTime, SecondsFormat, Utc};
use dragfree_archive::product::{
    Coefficient, Covariance, Dimensions, FORMAT_VERSION, GlobalAttributes, Header, Input, Loss, Model,
    NonStandardAttributes, Outcome, Product, Quality, Stage, Status, Stream, Variable,
};
use dragfree_archive::{ArchiveError, JOINT, MadeOf, ProductWriter, Stamp, Written};
use dragfree_schema::{Report, Role, Settings};
use std::collections::BTreeSet;

/// All that a product is made from.
#[derive(Clone, Debug)]
pub struct Draft {
    /// Pipeline, `science-mode`.
    pub pipeline: String,
    /// Product name, `COM1B`: letters and digits.
    pub product: String,
    /// Release of the product; changes with model, estimator, frame or unit.
    pub release: u32,
    /// Mission, `Taiji`.
    pub mission: String,
    /// Spacecraft, `SC1`: letters, digits and `-`.
    pub spacecraft: String,
    /// First epoch, Unix ns of `time_scale`.
    pub first_ns: i64,
    /// Last epoch, Unix ns of `time_scale`.
    pub last_ns: i64,
    /// Every file that was read.
    pub inputs: Vec<Input>,
    /// Every plugin that ran, in order.
    pub history: Vec<Stage>,
    /// Model that the estimators used.
    pub model: Model,
    /// Version of the program, with its commit where it is known.
    pub software: String,
    /// Time scale, losses, counts and notes of the replay; those of the stages stand in their reports.
    pub replay: Summary,
    /// Reports in pipeline order, each with its plugin.
    pub reports: Vec<Report>,
    /// Thresholds.
    pub settings: Settings,
    /// Why the product is made.
    pub stream: Stream,
    /// How final it is.
    pub status: Status,
    /// When the product is made; the engine has no clock.
    pub created: DateTime<Utc>,
}

impl Draft {
    /// Archives the product with what its stages attach.
    ///
    /// # Errors
    /// [`ArchiveError`]; nothing is left in the archive then.
    pub fn commit(&self, writer: ProductWriter, made_of: MadeOf) -> Result<Written, ArchiveError> {
        let product = product(self)?;
        let writer = self.attached(writer)?;
        writer.commit(&product, made_of, &Stamp { time: self.created, software: &self.software })
    }

    /// As [`Self::commit`]; where the newest revision is the same, that is given, and false.
    ///
    /// # Errors
    /// As [`Self::commit`].
    pub fn commit_if_new(&self, writer: ProductWriter, made_of: MadeOf) -> Result<(Written, bool), ArchiveError> {
        let product = product(self)?;
        let writer = self.attached(writer)?;
        writer.commit_if_new(&product, made_of, &Stamp { time: self.created, software: &self.software })
    }

    fn attached(&self, mut writer: ProductWriter) -> Result<ProductWriter, ArchiveError> {
        for report in &self.reports {
            for attachment in &report.attachments {
                writer.attach(&report.plugin, &attachment.suffix, &attachment.text)?;
            }
        }
        Ok(writer)
    }
}

/// UTC day of the first epoch.
fn day(draft: &Draft) -> String {
    DateTime::from_timestamp_nanos(draft.first_ns).format("%Y-%m-%d").to_string()
}

/// A product's name without its revision, `COM1B_2035-01-01_SC1_01`.
fn stem(draft: &Draft) -> Result<String, ArchiveError> {
    let named = |what, value: &str, place, extra: &[char]| {
        let fits = !value.is_empty() && value.chars().all(|c| c.is_ascii_alphanumeric() || extra.contains(&c));
        if fits { Ok(()) } else { Err(ArchiveError::Name { what, value: value.to_owned(), place }) }
    };
    named("the product name", &draft.product, "pipeline", &[])?;
    named("the spacecraft", &draft.spacecraft, "mission", &['-'])?;
    Ok(format!("{}_{}_{}_{:02}", draft.product, day(draft), draft.spacecraft, draft.release))
}

/// Builds the product. The archive gives it its revision, and fills in its files and its digest.
fn product(draft: &Draft) -> Result<Product, ArchiveError> {
    let id = stem(draft)?;
    let result = outcome(draft);
    let losses: Vec<Loss> = draft.replay.losses.iter().cloned().chain(nothing_adopted(&result.coefficients)).collect();
    let quality = quality(draft, !losses.is_empty());
    let header = Header {
        dimensions: Dimensions {
            epoch: quality.epochs_used.saturating_add(quality.epochs_rejected),
            coefficient: distinct(&result.coefficients).len(),
            stage: draft.history.len(),
            input: draft.inputs.len(),
        },
        global_attributes: GlobalAttributes {
            id,
            title: format!("{} calibration of {} {}", draft.product, draft.mission, draft.spacecraft),
            summary: format!(
                "Coefficients of the model's effects from {} files by the pipeline {}",
                draft.inputs.len(),
                draft.pipeline
            ),
            conventions: "CF-1.6, ACDD-1.3, ISO 8601".to_owned(),
            project: draft.mission.clone(),
            platform: draft.spacecraft.clone(),
            processing_level: if draft.product == JOINT { "2" } else { "1B" }.to_owned(),
            product_version: format!("{:02}", draft.release),
            source: draft.pipeline.clone(),
            date_created: draft.created.to_rfc3339_opts(SecondsFormat::Secs, true),
            time_coverage_start: calendar(draft.first_ns),
            time_coverage_stop: calendar(draft.last_ns),
        },
        non_standard_attributes: NonStandardAttributes {
            product: draft.product.clone(),
            release: draft.release,
            revision: 0,
            day: day(draft),
            stream: draft.stream,
            status: draft.status,
            time_scale: if draft.replay.time_scale.is_empty() { "unknown" } else { &draft.replay.time_scale }
                .to_owned(),
            start_time_epoch_ns: draft.first_ns,
            stop_time_epoch_ns: draft.last_ns,
            frames: frames(&result.coefficients),
            software_version: draft.software.clone(),
            sha256: String::new(),
        },
        variables: variables(&result.coefficients),
    };
    Ok(Product {
        format_version: FORMAT_VERSION.to_owned(),
        header,
        model: draft.model.clone(),
        settings: draft.settings.clone(),
        result,
        quality,
        supersedes: None,
        inputs: draft.inputs.clone(),
        history: draft.history.clone(),
        losses,
        attachments: Vec::new(),
    })
}

/// The value of the last stage that reports one: it has seen the earlier reports.
fn last<T>(draft: &Draft, get: impl Fn(&Report) -> Option<T>) -> Option<T> {
    draft.reports.iter().rev().find_map(get)
}

fn outcome(draft: &Draft) -> Outcome {
    let coefficients = draft.reports.iter().flat_map(|report| &report.coefficients).map(|estimate| Coefficient {
        name: estimate.name.clone(),
        solution: estimate.solution.clone(),
        role: estimate.role,
        value: estimate.value.unwrap_or(f64::NAN),
        sigma: estimate.sigma.unwrap_or(f64::NAN),
        unit: estimate.unit.clone(),
        frame: estimate.frame.clone(),
    });
    let covariance = draft.reports.iter().flat_map(|report| &report.covariance).map(|(solution, reported)| {
        (solution.clone(), Covariance { names: reported.names.clone(), matrix: reported.matrix.clone() })
    });
    let verdict = last(draft, |report| report.verdict.clone());
    // Estimators cannot know: what is late follows the same laws, with another noise.
    let verdict = if contradictory(draft) { verdict.map(|_| "disagree".to_owned()) } else { verdict };
    Outcome { epoch_ns: draft.last_ns, verdict, coefficients: coefficients.collect(), covariance: covariance.collect() }
}

/// Whether times of the data contradict each other.
fn contradictory(draft: &Draft) -> bool {
    draft.replay.losses.iter().any(|loss| loss.kind == Finding::SteppedClocks.to_string())
}

fn quality(draft: &Draft, lost: bool) -> Quality {
    let mut weak_directions: Vec<String> = Vec::new();
    for direction in draft.reports.iter().flat_map(|report| &report.weak_directions) {
        if !weak_directions.contains(direction) {
            weak_directions.push(direction.clone());
        }
    }
    let replayed = Some(("replay".to_owned(), draft.replay.counts.clone())).filter(|(_, counts)| !counts.is_empty());
    let reported =
        |report: &Report| (!report.counts.is_empty()).then(|| (report.plugin.clone(), report.counts.clone()));
    let note = |report: &Report| -> Vec<String> {
        report.notes.iter().map(|note| format!("{}: {}", report.plugin, without_name(&report.plugin, note))).collect()
    };
    let figures =
        |report: &Report| (!report.quality.is_empty()).then(|| (report.plugin.clone(), table(&report.quality)));
    Quality {
        epochs_used: last(draft, |report| report.epochs_used).unwrap_or(0),
        epochs_rejected: last(draft, |report| report.epochs_rejected).unwrap_or(0),
        commands: last(draft, |report| report.commands.clone()),
        chi2_per_dof: last(draft, |report| report.chi2_per_dof).unwrap_or(f64::NAN),
        nis: last(draft, |report| report.nis).unwrap_or(f64::NAN),
        data_loss: lost || draft.reports.iter().any(|report| report.data_loss),
        inconsistent: contradictory(draft) || draft.reports.iter().any(|report| report.inconsistent),
        weak_directions,
        notes: draft
            .replay
            .notes
            .iter()
            .map(|note| format!("replay: {note}"))
            .chain(draft.reports.iter().flat_map(note))
            .collect(),
        counts: replayed.into_iter().chain(draft.reports.iter().filter_map(reported)).collect(),
        stages: draft.reports.iter().filter_map(figures).collect(),
    }
}

/// A product that says nothing: a run that used epochs and adopted no value is no success.
fn nothing_adopted(coefficients: &[Coefficient]) -> Option<Loss> {
    let adopted: Vec<&Coefficient> = coefficients.iter().filter(|c| c.role == Some(Role::Adopted)).collect();
    if adopted.is_empty() || adopted.iter().any(|c| c.value.is_finite()) {
        return None;
    }
    let detail = "no coefficient has an adopted value: the notes say which data were missing or not used".to_owned();
    Some(Loss { kind: "values_not_adopted".to_owned(), count: adopted.len() as u64, detail })
}

/// JSON as TOML: TOML has no null, so a missing value becomes `nan`.
fn value(json: &serde_json::Value) -> toml::Value {
    use serde_json::Value as Json;
    match json {
        Json::Null => toml::Value::Float(f64::NAN),
        Json::Bool(flag) => toml::Value::Boolean(*flag),
        Json::Number(number) => match number.as_i64() {
            Some(integer) => toml::Value::Integer(integer),
            None => toml::Value::Float(number.as_f64().unwrap_or(f64::NAN)),
        },
        Json::String(text) => toml::Value::String(text.clone()),
        Json::Array(items) => toml::Value::Array(items.iter().map(value).collect()),
        Json::Object(map) => toml::Value::Table(table(map)),
    }
}

fn table(map: &serde_json::Map<String, serde_json::Value>) -> toml::Table {
    map.iter().map(|(key, item)| (key.clone(), value(item))).collect()
}

/// One entry per coefficient, whatever the number of its solutions, in the order of the reports.
fn distinct(coefficients: &[Coefficient]) -> Vec<&Coefficient> {
    let mut seen = BTreeSet::new();
    coefficients.iter().filter(|coefficient| seen.insert(&coefficient.name)).collect()
}

fn frames(coefficients: &[Coefficient]) -> Vec<String> {
    let named = coefficients.iter().map(|c| &c.frame).filter(|frame| !frame.is_empty());
    named.collect::<BTreeSet<_>>().into_iter().cloned().collect()
}

fn variables(coefficients: &[Coefficient]) -> Vec<Variable> {
    let estimated = distinct(coefficients).into_iter().map(|coefficient| Variable {
        name: coefficient.name.clone(),
        long_name: format!("coefficient {}", coefficient.name),
        units: coefficient.unit.clone(),
        frame: coefficient.frame.clone(),
        coverage_content_type: "modelResult".to_owned(),
    });
    let figure = |name: &str, long_name: &str, units: &str| Variable {
        name: name.to_owned(),
        long_name: long_name.to_owned(),
        units: units.to_owned(),
        frame: String::new(),
        coverage_content_type: "qualityInformation".to_owned(),
    };
    let figures = [
        figure("covariance", "covariance of the coefficients; the product of the units of row and column", ""),
        figure("chi2_per_dof", "chi-squared of the residuals per degree of freedom", "1"),
        figure("nis", "mean normalised innovation squared per channel", "1"),
    ];
    estimated.chain(figures).collect()
}

/// ISO 8601 in the product's own time scale, hence without a zone.
fn calendar(time_ns: i64) -> String {
    DateTime::from_timestamp_nanos(time_ns).format("%Y-%m-%dT%H:%M:%S%.9f").to_string()
}

#[cfg(test)]
mod tests;
