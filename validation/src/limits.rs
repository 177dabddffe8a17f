//! What data of each length can say of each effect: σ of its coefficients beside the model, constants, slopes, starts
//! and levels of the noise, from the information of the likelihood. Computed on telemetry in which nothing is hidden.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::campaign::{ScratchFolder, note, science_mode, taiji};
use crate::diagnosis::Length;
use crate::error::{CampaignError, file};
use crate::program::{Chain, Program, root};
use crate::records::{Keyed, Results, rounded};

/// Seed of the telemetry.
const SEED: u32 = 1;

/// The limits of one length.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Limits {
    /// Length, as `6h`.
    pub(crate) length: String,
    /// Digest of program and plugins.
    pub(crate) build: String,
    /// Every coefficient of every candidate.
    pub(crate) limits: Vec<Known>,
}

/// What is known of a coefficient.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Known {
    /// Name.
    pub(crate) coefficient: String,
    /// Effect.
    pub(crate) effect: String,
    /// Unit.
    pub(crate) unit: String,
    /// σ.
    pub(crate) sigma: f64,
}

impl Keyed for Limits {
    fn key(&self) -> (String, u32) {
        (self.length.clone(), SEED)
    }

    fn made_with(&self) -> &str {
        &self.build
    }
}

/// Computes the lengths that `results` lacks.
pub(crate) fn limits(program: &Program, results: &Path, scratch: &Path) -> Result<(), CampaignError> {
    let build = program.whole_digest()?;
    let (results, _) = Results::<Limits>::open(results, &build)?;
    for length in Length::ALL.into_iter().filter(|length| !results.has(length.name(), SEED)) {
        let folder = scratch.join(format!("limits-{}", length.name()));
        ScratchFolder::new(&folder)?;
        let diagnosis = diagnosed(program, length, &folder)?;
        let limits = known(&diagnosis).ok_or_else(|| file(&folder, &"the diagnosis has no upper_limits"))?;
        note(&format!("{}: {}, σ of {} coefficients", length.name(), diagnosis["verdict"], limits.len()));
        results.append(Limits { length: length.name().to_owned(), build: build.clone(), limits })?;
        std::fs::remove_dir_all(&folder).map_err(|e| file(&folder, &e))?;
    }
    results.sort(&Length::ALL.map(Length::name)).map(|_| ())
}

fn diagnosed(program: &Program, length: Length, folder: &Path) -> Result<Value, CampaignError> {
    let arguments = ["--seed".to_owned(), SEED.to_string(), "--hours".to_owned(), length.hours().to_string()];
    let made = program.simulate(&taiji(), &folder.join("telemetry"), &arguments)?;
    let model: PathBuf = root().join("fixtures/models/com-offset.toml");
    let chain = Chain { pipeline: science_mode(), mission: None, model: Some(model) };
    let archive = folder.join("archive");
    let run = |day: &PathBuf| program.run(&chain, std::slice::from_ref(day), &archive);
    let products: Vec<Value> = made.files.iter().map(run).collect::<Result<_, _>>()?;
    program.diagnose_together(&products, &archive, &[])
}

fn known(diagnosis: &Value) -> Option<Vec<Known>> {
    let of = |limit: &Value| {
        let text = |key: &str| Some(limit[key].as_str()?.to_owned());
        Some(Known {
            coefficient: text("coefficient")?,
            effect: text("effect")?,
            unit: text("unit")?,
            sigma: rounded(limit["sigma"].as_f64()?),
        })
    };
    diagnosis["upper_limits"].as_array()?.iter().map(of).collect()
}

/// A table: σ of the best and the worst known coefficient of each effect and unit, by length.
pub(crate) fn table(all: &[Limits]) -> String {
    if all.is_empty() {
        return "Not computed yet.\n".to_owned();
    }
    let mut rows: BTreeMap<(&str, &str), BTreeMap<&str, Vec<f64>>> = BTreeMap::new();
    for of_length in all {
        for k in of_length.limits.iter().filter(|k| k.sigma.is_finite() && k.sigma > 0.0) {
            let row = rows.entry((&k.effect, &k.unit)).or_default();
            row.entry(&of_length.length).or_default().push(k.sigma);
        }
    }
    let names: Vec<&str> = Length::ALL.iter().map(|l| l.name()).collect();
    let mut text = format!("Build {}.\n\n| effect, unit | {} |\n|---|", all[0].build, names.join(" | "));
    text.push_str(&"---|".repeat(names.len()));
    text.push('\n');
    for ((effect, unit), by_length) in rows {
        let unit = if unit == "1" { String::new() } else { format!(", {unit}") };
        let cells = names.iter().map(|name| by_length.get(name).map_or_else(|| "–".to_owned(), |own| range(own)));
        text.push_str(&format!("| `{effect}`{unit} | {} |\n", cells.collect::<Vec<_>>().join(" | ")));
    }
    text
}

/// The smallest and the largest of some numbers.
fn range(all: &[f64]) -> String {
    let (least, most) = all.iter().fold((f64::INFINITY, 0.0_f64), |(a, b), x| (a.min(*x), b.max(*x)));
    let digits = |x: f64| if (0.001..1000.0).contains(&x) { two_digits(x) } else { format!("{x:.1e}") };
    let (least, most) = (digits(least), digits(most));
    if least == most { least } else { format!("{least} to {most}") }
}

fn two_digits(x: f64) -> String {
    let decimals = (1 - x.log10().floor() as i32).max(0) as usize;
    format!("{x:.decimals$}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_row_has_the_smallest_and_the_largest_sigma_of_each_length() {
        let known = |coefficient: &str, sigma| Known {
            coefficient: coefficient.to_owned(),
            effect: "es-gain".to_owned(),
            unit: "1".to_owned(),
            sigma,
        };
        let of = |length: &str, limits| Limits { length: length.to_owned(), build: "b".to_owned(), limits };
        let all = [of("2h", vec![known("a", 0.0123), known("b", 0.2)]), of("24h", vec![known("a", 2.5e-5)])];
        assert!(table(&all).contains("| `es-gain` | 0.012 to 0.20 | – | – | 2.5e-5 | – |\n"), "{}", table(&all));
    }
}
