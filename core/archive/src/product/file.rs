//! The product file: its layout, its digest, reading and emitting. The JSON Schema refuses unknown keys.

use super::emit::emit;
use crate::ArchiveError;
use crate::files::{IoContext as _, sha256};
use dragfree_schema::{Role, Settings};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::Path;
use std::sync::LazyLock;

/// Version of the layout.
pub const FORMAT_VERSION: &str = "1.2.0";

static SCHEMA: LazyLock<jsonschema::Validator> = LazyLock::new(|| {
    let schema = serde_json::from_str(include_str!("../../../../fixtures/schema/product.schema.json"))
        .expect("the committed schema is JSON");
    jsonschema::validator_for(&schema).expect("the committed schema is a JSON Schema")
});

/// A product: header blocks after GRACE-FO's Level-1B, then what the run found and how.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Product {
    /// Version of the layout, [`FORMAT_VERSION`].
    pub format_version: String,
    /// What the file is.
    pub header: Header,
    /// Model that the estimators used.
    pub model: Model,
    /// Thresholds; the present defaults where a product does not store one.
    #[serde(default)]
    pub settings: Settings,
    /// What they found.
    pub result: Outcome,
    /// How far to trust it.
    pub quality: Quality,
    /// The revision that this one takes the place of.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub supersedes: Option<Supersedes>,
    /// Every file that was read.
    pub inputs: Vec<Input>,
    /// Every plugin that ran, in order.
    pub history: Vec<Stage>,
    /// Data that were lost.
    pub losses: Vec<Loss>,
    /// Files beside the product.
    pub attachments: Vec<Attachment>,
}

/// Header blocks with the names of GRACE-FO's Level-1B files.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Header {
    /// How many of each.
    pub dimensions: Dimensions,
    /// Attributes of CF and ACDD.
    pub global_attributes: GlobalAttributes,
    /// Attributes that those conventions do not know.
    pub non_standard_attributes: NonStandardAttributes,
    /// Quantities with their units.
    pub variables: Vec<Variable>,
}

/// How many of each.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Dimensions {
    /// Epochs, used and rejected.
    pub epoch: u64,
    /// Coefficients, whatever the number of solutions.
    pub coefficient: usize,
    /// Plugins that ran.
    pub stage: usize,
    /// Files read.
    pub input: usize,
}

/// Attributes of CF and ACDD.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct GlobalAttributes {
    /// `COM1B_2035-01-01_SC1_01_0001`, also the file's name.
    pub id: String,
    /// One line.
    pub title: String,
    /// One sentence.
    pub summary: String,
    /// Conventions that the names follow.
    pub conventions: String,
    /// Mission.
    pub project: String,
    /// Spacecraft.
    pub platform: String,
    /// `1B`, `2` of many days.
    pub processing_level: String,
    /// Release, two digits.
    pub product_version: String,
    /// Pipeline.
    pub source: String,
    /// When the file was made, UTC; not part of the digest.
    pub date_created: String,
    /// First epoch in the product's time scale.
    pub time_coverage_start: String,
    /// Last epoch in the product's time scale.
    pub time_coverage_stop: String,
}

/// Attributes that CF and ACDD do not know.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct NonStandardAttributes {
    /// Product name, `COM1B`.
    pub product: String,
    /// Changes with model, estimator, frame or unit.
    pub release: u32,
    /// Changes with late data or another run of the same day.
    pub revision: u32,
    /// UTC day of the first epoch.
    pub day: String,
    /// Operations, reprocessing or a test.
    pub stream: Stream,
    /// How final the product is.
    pub status: Status,
    /// `UTC`, `TAI`, `GPS` or `unknown`.
    pub time_scale: String,
    /// First epoch, Unix ns of `time_scale`.
    pub start_time_epoch_ns: i64,
    /// Last epoch, Unix ns of `time_scale`.
    pub stop_time_epoch_ns: i64,
    /// Frames that the coefficients stand in.
    pub frames: Vec<String>,
    /// Version of the program.
    pub software_version: String,
    /// [`Product::digest`].
    pub sha256: String,
}

/// Why a product was made.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "UPPERCASE")]
pub enum Stream {
    /// Daily operations.
    Oper,
    /// Reprocessing.
    Rpro,
    /// A test or a simulation.
    #[default]
    Test,
}

/// How final a product is.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Status {
    /// First look, data may still come.
    #[default]
    Quicklook,
    /// All data are in.
    Final,
    /// Not to be used; of earlier versions, since the archive says it now.
    Withdrawn,
}

/// A quantity of the product.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Variable {
    /// Name, as in the result.
    pub name: String,
    /// In words.
    pub long_name: String,
    /// SI unit.
    pub units: String,
    /// Frame, empty where there is none.
    pub frame: String,
    /// ISO 19115-1 code, `modelResult`.
    pub coverage_content_type: String,
}

/// Model that the estimators used.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct Model {
    /// Its revision.
    pub revision: String,
    /// The revision that it came from.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub parent: Option<String>,
    /// The product whose values it was fixed at: the run is a test on data that were kept out of that fit.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub fixed_from: Option<String>,
    /// Its effects, each once, `com-offset`.
    pub effects: Vec<String>,
    /// Levels of noise that its effects state.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub noise_levels: Vec<NoiseLevel>,
}

/// A level of noise with which a run began: the declared amplitude of a component times `value`. An estimate of it is
/// among the coefficients.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct NoiseLevel {
    /// `mps-noise.sc.y`
    pub coefficient: String,
    /// Component of the declared noise, `thruster_force:sc.y`.
    pub component: String,
    /// Amplitude over the declared one.
    pub value: f64,
}

/// What the estimators found.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Outcome {
    /// Epoch of the coefficients, Unix ns of the product's time scale: the end of the window.
    pub epoch_ns: i64,
    /// `agree`, `disagree` or `weak`; absent where no stage compared solutions.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub verdict: Option<String>,
    /// Every coefficient of every solution.
    pub coefficients: Vec<Coefficient>,
    /// Covariances by solution.
    pub covariance: BTreeMap<String, Covariance>,
}

impl Outcome {
    /// The solution to use: the adopted one, else a batch solution, else the first that there is.
    pub fn adopted(&self) -> Vec<&Coefficient> {
        let all = &self.coefficients;
        let of = |role: Role| all.iter().find(|c| c.role == Some(role));
        // Products from before solutions had roles have the name alone.
        let named = || all.iter().find(|c| c.role.is_none() && c.solution == "adopted");
        let first = of(Role::Adopted).or_else(named).or_else(|| of(Role::Batch)).or_else(|| all.first());
        all.iter().filter(|c| first.is_some_and(|first| c.solution == first.solution)).collect()
    }

    /// Whether a recursive solution stands beside the batch one, so that they can agree.
    pub fn is_compared(&self) -> bool {
        let valued = || self.coefficients.iter().filter(|c| c.value.is_finite() && c.sigma.is_finite());
        let of = |role: Role| valued().any(|c| c.role == Some(role));
        // Products from before solutions had roles have the name alone.
        let mut others: Vec<&str> = valued().filter(|c| c.role.is_none()).map(|c| c.solution.as_str()).collect();
        others.retain(|solution| *solution != "adopted");
        of(Role::Recursive) && of(Role::Batch) || others.iter().any(|solution| *solution != others[0])
    }
}

/// One coefficient of one solution.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Coefficient {
    /// `com-offset.tm1.x`.
    pub name: String,
    /// `es-akf`, `qp` or `adopted`.
    pub solution: String,
    /// What the solution is for; absent in products of before, and where the stage said nothing.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub role: Option<Role>,
    /// Value in `unit`.
    pub value: f64,
    /// Standard deviation in `unit`.
    pub sigma: f64,
    /// SI unit.
    pub unit: String,
    /// Frame, empty where there is none.
    pub frame: String,
}

/// A covariance; its units are the products of those of the coefficients.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Covariance {
    /// Coefficients of the rows, n.
    pub names: Vec<String>,
    /// n × n, by rows.
    pub matrix: Vec<Vec<f64>>,
}

/// How far to trust the result.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Quality {
    /// Epochs that entered the result.
    pub epochs_used: u64,
    /// Epochs that did not.
    pub epochs_rejected: u64,
    /// `telemetered` or `reconstructed`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub commands: Option<String>,
    /// χ² of the residuals per degree of freedom.
    pub chi2_per_dof: f64,
    /// Mean normalised innovation squared per channel.
    pub nis: f64,
    /// True where data were lost.
    pub data_loss: bool,
    /// True where the model contradicts the data.
    pub inconsistent: bool,
    /// Directions that the data do not determine.
    pub weak_directions: Vec<String>,
    /// Sentences of the stages.
    pub notes: Vec<String>,
    /// Counts by stage; `replay` is the engine's own.
    pub counts: BTreeMap<String, BTreeMap<String, u64>>,
    /// Free figures by stage.
    pub stages: BTreeMap<String, toml::Table>,
}

/// The revision that a product takes the place of.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Supersedes {
    /// Its id.
    pub id: String,
    /// Its digest.
    pub sha256: String,
    /// What changed since.
    pub reason: String,
}

impl Supersedes {
    /// What a product says of the one that it takes the place of.
    pub(crate) fn new(old: &Product, new: &Product) -> Self {
        Self {
            id: old.id().to_owned(),
            sha256: old.header.non_standard_attributes.sha256.clone(),
            reason: what_changed(old, new),
        }
    }
}

/// What differs between a product and the one that takes its place, in words.
fn what_changed(old: &Product, new: &Product) -> String {
    let software = |product: &Product| product.header.non_standard_attributes.software_version.clone();
    let window = |product: &Product| {
        let attributes = &product.header.non_standard_attributes;
        (attributes.start_time_epoch_ns, attributes.stop_time_epoch_ns)
    };
    let changed = [
        ("inputs", old.inputs != new.inputs),
        ("plugins or their parameters", old.history != new.history),
        ("program", software(old) != software(new)),
        ("window", window(old) != window(new)),
    ];
    let changed: Vec<&str> = changed.into_iter().filter_map(|(what, differs)| differs.then_some(what)).collect();
    match changed.as_slice() {
        [] if old.header.non_standard_attributes.sha256 == new.digest() => "run again, same result".to_owned(),
        [] => "run again with the same inputs, plugins and parameters".to_owned(),
        changed => format!("changed: {}", changed.join(", ")),
    }
}

/// A file that was read.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Input {
    /// What it is: `telemetry`, `mission`, `model`, `pipeline`, `state` or, of a product of many days, `product`.
    pub role: String,
    /// File name without folders, so that a product does not depend on where it was made.
    pub name: String,
    /// Bytes.
    pub size: u64,
    /// Digest, lower-case hexadecimal.
    pub sha256: String,
}

/// A plugin that ran.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Stage {
    /// Plugin, `qp-check`.
    pub plugin: String,
    /// Instance of an effect, `tm1`; empty for sources and stages.
    pub instance: String,
    /// `source`, `stage` or `effect`.
    pub kind: String,
    /// Version of the plugin.
    pub version: String,
    /// ABI that it was built for.
    pub abi: String,
    /// Digest of its library.
    pub library_sha256: String,
    /// Digest of its parameters, defaults filled in.
    pub parameters_sha256: String,
}

/// Data that were lost.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Loss {
    /// What was lost, `corrupt chunk`.
    pub kind: String,
    /// How often.
    pub count: u64,
    /// Where and why, one sentence.
    pub detail: String,
}

/// A file beside the product.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Attachment {
    /// What follows the product's id, `neq.json`.
    pub suffix: String,
    /// Bytes.
    pub size: u64,
    /// Digest, lower-case hexadecimal.
    pub sha256: String,
}

impl Product {
    /// `COM1B_2035-01-01_SC1_01_0001`.
    pub fn id(&self) -> &str {
        &self.header.global_attributes.id
    }

    /// The product as `revision` of its series, with its files and its digest; its id has no revision before.
    pub(crate) fn numbered(&self, revision: u32, attachments: Vec<Attachment>, supersedes: Option<Supersedes>) -> Self {
        let mut product = Self { attachments, supersedes, ..self.clone() };
        product.header.non_standard_attributes.revision = revision;
        product.header.global_attributes.id = format!("{}_{revision:04}", self.id());
        product.header.non_standard_attributes.sha256 = product.digest();
        product
    }

    /// The product under another id without a revision.
    pub(crate) fn unnumbered(&self, stem: &str) -> Self {
        let mut product = Self { supersedes: None, ..self.clone() };
        stem.clone_into(&mut product.header.global_attributes.id);
        product
    }

    /// SHA-256 of what the run found and from what, lower-case hexadecimal.
    ///
    /// Its bytes are the document as JSON without white space, keys sorted, missing numbers `null`; left out are the
    /// creation date, the id and revision, what it supersedes and the digest itself. The same inputs, plugins,
    /// parameters and model therefore give the same digest, whenever and how often they are run.
    ///
    /// Thresholds count as they stand in the file: another version may have others.
    pub fn digest(&self) -> String {
        self.digest_beside(self.document().get_mut("settings").map(serde_json::Value::take))
    }

    /// The digest with these thresholds.
    fn digest_beside(&self, settings: Option<serde_json::Value>) -> String {
        let mut computed = self.clone();
        computed.supersedes = None;
        computed.header.global_attributes.id.clear();
        computed.header.global_attributes.date_created.clear();
        computed.header.non_standard_attributes.revision = 0;
        computed.header.non_standard_attributes.sha256.clear();
        let mut document = computed.document();
        match (settings, document.as_object_mut()) {
            (Some(settings), Some(document)) => document.insert("settings".to_owned(), settings),
            (None, Some(document)) => document.remove("settings"),
            (_, None) => None,
        };
        sha256(canonical(document))
    }

    /// The whole document.
    pub(crate) fn document(&self) -> serde_json::Value {
        serde_json::to_value(self).expect("every key of a product is a string")
    }

    /// The text of the file, checked against the schema.
    pub(crate) fn emit(&self) -> Result<String, ArchiveError> {
        check(self.id(), &self.document())?;
        let table = toml::Table::try_from(self);
        Ok(emit(&table.map_err(|source| ArchiveError::Emit { id: self.id().to_owned(), source })?))
    }
}

/// A document as JSON without white space, keys sorted.
fn canonical(mut document: serde_json::Value) -> Vec<u8> {
    document.sort_all_objects();
    document.to_string().into_bytes()
}

/// Reads a product and checks its format version, schema, name and digest.
///
/// # Errors
/// [`ArchiveError`]: the file cannot be read, is no product, is from a later version or was changed.
pub fn read(path: &Path) -> Result<Product, ArchiveError> {
    let text = std::fs::read_to_string(path).at("read", path)?;
    let product = parse(&text, path)?;
    if path.file_stem().is_none_or(|stem| stem != product.id()) {
        return Err(ArchiveError::Damaged {
            path: path.to_owned(),
            reason: format!("the file says that it is {}", product.id()),
        });
    }
    Ok(product)
}

/// Reads a product's text; `path` is for messages.
pub(crate) fn parse(text: &str, path: &Path) -> Result<Product, ArchiveError> {
    let table = |source| ArchiveError::Parse { path: path.to_owned(), source: Box::new(source) };
    let document: toml::Table = toml::from_str(text).map_err(table)?;
    let major = |version: &str| version.split('.').next().map(str::to_owned);
    if let Some(found) = document.get("format_version").and_then(toml::Value::as_str)
        && major(found) != major(FORMAT_VERSION)
    {
        return Err(ArchiveError::Format { path: path.to_owned(), found: found.to_owned() });
    }
    let name = path.file_stem().unwrap_or_default().to_string_lossy();
    let mut stored = serde_json::to_value(&document).expect("every key of TOML is a string");
    check(&name, &stored)?;
    let product: Product = document.try_into().map_err(table)?;
    let written = &product.header.non_standard_attributes.sha256;
    let found = product.digest_beside(stored.get_mut("settings").map(serde_json::Value::take));
    if found != *written {
        let reason = format!("its digest is {found}, the file says {written}");
        return Err(ArchiveError::Damaged { path: path.to_owned(), reason });
    }
    Ok(product)
}

fn check(id: &str, document: &serde_json::Value) -> Result<(), ArchiveError> {
    SCHEMA.validate(document).map_err(|error| ArchiveError::Schema {
        id: id.to_owned(),
        at: error.instance_path().to_string(),
        reason: error.to_string(),
    })
}
