//! What a plugin says of itself before anything else.

use serde::{Deserialize, Serialize};

/// Name by which a host asks stages for prediction mode, as effects ask for columns in [`Manifest::needs`].
///
/// Every column that effects make regressors of then depends on commands and past readouts alone, so that regressors
/// can be tested against the innovations of a Kalman predictor of the channels. What a column lacks is named by its
/// attribute [`crate::UNPREDICTED_ATTRIBUTE`]. Stages declare the noise in the channels without an estimate of what
/// drives them.
pub const PREDICTION_NEED: &str = "prediction";

/// Parameter of an effect that acts once, at a time that the host finds, Unix ns. `NAME-2` is another time at the place
/// `NAME`.
pub const AT_NS: &str = "at_ns";

/// Parameter of an effect that acts at one frequency, which the host finds. `NAME-2` is another one at the place
/// `NAME`.
pub const FREQUENCY_HZ: &str = "frequency_hz";

/// Place and number of an instance of an effect that may be several times at one place: `tm1.z-2` is the second one at
/// `tm1.z`, which is the first.
pub fn place_and_number(instance: &str) -> (&str, usize) {
    let numbered = instance.rsplit_once('-').and_then(|(place, text)| {
        let number: usize = text.parse().ok()?;
        (number > 1 && number.to_string() == text).then_some((place, number))
    });
    numbered.unwrap_or((instance, 1))
}

/// What a plugin is and which parameters it takes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "json-schema", derive(schemars::JsonSchema))]
pub struct Manifest {
    /// Id by which pipelines and models name it, `es-akf`: small letters, digits and hyphens.
    pub id: String,
    /// Version of the plugin, `1.2.3`.
    pub version: String,
    /// SPDX expression.
    pub licence: String,
    /// One sentence.
    pub description: String,
    /// Effects only: the places where it can act, `sc.x`. `{table}` in a name stands for each key of the mission's
    /// table of that name, as `{test_mass}.x` for the test masses.
    #[serde(default)]
    pub instances: Vec<String>,
    /// Effects only: columns beyond the usual ones that stages before it are asked to make, by the names that those
    /// stages give them: `commands`, `torque-response`, `dws-delay-response`.
    #[serde(default)]
    pub needs: Vec<String>,
    /// Parameters; a pipeline or model file that gives another key is refused.
    #[serde(default)]
    pub parameters: Vec<Parameter>,
}

impl Manifest {
    /// The places where an effect can act on a mission: the names of [`Self::instances`] with the keys of the mission's
    /// tables, in alphabetical order. Neighbours that name one table are repeated together for each key.
    pub fn instances_on(&self, mission: &serde_json::Value) -> Vec<String> {
        let table = |name: &String| template(name).map(|(_, table, _)| table.to_owned());
        let mut all = Vec::new();
        for group in self.instances.chunk_by(|a, b| table(a).is_some() && table(a) == table(b)) {
            let Some(table) = table(&group[0]) else {
                all.extend_from_slice(group);
                continue;
            };
            let entries = mission.get(&table).and_then(serde_json::Value::as_object);
            let mut keys: Vec<&String> = entries.into_iter().flat_map(|entries| entries.keys()).collect();
            keys.sort();
            for key in keys {
                let names = group.iter().filter_map(|name| template(name));
                all.extend(names.map(|(before, _, after)| format!("{before}{key}{after}")));
            }
        }
        all
    }

    /// Whether it may be several times at one place, each with a time or a frequency of its own.
    pub fn repeats(&self) -> bool {
        self.parameters.iter().any(|p| [AT_NS, FREQUENCY_HZ].contains(&p.name.as_str()))
    }

    /// The place of an instance: the instance itself, without its number where the effect may be there several times.
    pub fn place_of<'a>(&self, instance: &'a str) -> &'a str {
        if self.repeats() { place_and_number(instance).0 } else { instance }
    }

    /// Whether there may be a mission on which the effect can act at a place.
    pub fn may_act_at(&self, instance: &str) -> bool {
        let instance = self.place_of(instance);
        self.instances.iter().any(|name| match template(name) {
            None => name == instance,
            Some((before, _, after)) => {
                let key = instance.strip_prefix(before).and_then(|rest| rest.strip_suffix(after));
                key.is_some_and(|key| !key.is_empty() && !key.contains('.'))
            }
        })
    }
}

/// What stands before, in and behind the braces of a name.
fn template(name: &str) -> Option<(&str, &str, &str)> {
    let (before, rest) = name.split_once('{')?;
    let (table, after) = rest.split_once('}')?;
    Some((before, table, after))
}

/// A parameter as declared.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "json-schema", derive(schemars::JsonSchema))]
pub struct Parameter {
    /// Name. Three have a meaning for `diagnose`: `at_ns`, when a transient begins, `frequency_hz`, at which a line
    /// acts, and `fine`, 1 for candidates about one shape.
    pub name: String,
    /// Type of its value.
    #[serde(rename = "type")]
    pub kind: ParameterType,
    /// SI unit, `1` for a number, empty for what has none.
    #[serde(default)]
    pub unit: String,
    /// Value when nothing is said.
    pub default: serde_json::Value,
    /// Smallest value.
    #[serde(default)]
    pub minimum: Option<f64>,
    /// Largest value.
    #[serde(default)]
    pub maximum: Option<f64>,
    /// Texts that are allowed; empty for any.
    #[serde(default)]
    pub choices: Vec<String>,
    /// One sentence.
    #[serde(default)]
    pub help: String,
}

/// Type of a parameter's value.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "json-schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "snake_case")]
pub enum ParameterType {
    /// A finite number.
    F64,
    /// A whole number.
    I64,
    /// True or false.
    Bool,
    /// A text.
    Text,
    /// A list of finite numbers.
    F64List,
    /// A list of texts.
    TextList,
}

impl std::fmt::Display for ParameterType {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::F64 => "f64",
            Self::I64 => "i64",
            Self::Bool => "bool",
            Self::Text => "text",
            Self::F64List => "f64_list",
            Self::TextList => "text_list",
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    fn manifest(instances: &[&str]) -> Manifest {
        let text = json!({"id": "e", "version": "1.0.0", "licence": "MIT", "description": "d", "instances": instances});
        serde_json::from_value(text).expect("a manifest")
    }

    /// The key is the outer loop for neighbours of one table; other names stay where they are.
    #[test]
    fn names_in_braces_stand_for_the_keys_of_a_table() {
        let manifest = manifest(&["sc.x", "{test_mass}.x", "{test_mass}.y", "{gauge}", "{nothing}.z"]);
        let mission = json!({"test_mass": {"b": {}, "a": {}}, "gauge": {"g1": 1}});
        assert_eq!(manifest.instances_on(&mission), ["sc.x", "a.x", "a.y", "b.x", "b.y", "g1"]);
        assert_eq!(manifest.instances_on(&json!({})), ["sc.x"]);
    }

    #[test]
    fn a_place_is_told_from_others_without_a_mission() {
        let manifest = manifest(&["sc.x", "{test_mass}.y-x"]);
        assert!(manifest.may_act_at("sc.x") && manifest.may_act_at("tm7.y-x"));
        assert!(!manifest.may_act_at("sc.x-2") && place_and_number("tm7.y-x") == ("tm7.y-x", 1));
        let at_ns = serde_json::from_value(json!({"name": AT_NS, "type": "i64", "default": 0})).expect("a parameter");
        let once = Manifest { parameters: vec![at_ns], ..manifest.clone() };
        assert!(once.may_act_at("sc.x-2") && place_and_number("sc.x-2") == ("sc.x", 2));
        assert!(!manifest.may_act_at("sc.y") && !manifest.may_act_at(".y-x") && !manifest.may_act_at("tm7.x-y"));
    }
}
