//! Formulas that a user writes, checked before any telemetry is read: the effect is asked whether it takes them.

use std::collections::BTreeMap;

use dragfree_engine::border::Kind;
use dragfree_engine::config::{EffectEntry, Mission};
use dragfree_engine::registry::Registry;
use dragfree_engine::validate::Subject;
use serde::Serialize;

use crate::proposals::FORMULA;

/// What begins the name of a housekeeping channel.
const HOUSEKEEPING: &str = "hk.";

/// Most letters of an error: a plugin's text may hold what was typed.
const MOST_LETTERS: usize = 400;

/// A formula as it is typed.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Asked {
    /// Instance.
    pub name: String,
    /// `tm1.accel.x`, for one.
    pub acts_on: String,
    /// What acts per unit of the coefficient.
    pub expression: String,
    /// SI unit of the coefficient.
    pub unit: String,
    /// Physical range of the coefficient.
    pub range: [f64; 2],
}

/// Why a formula is refused.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{what}")]
pub struct FormulaError {
    /// The reason.
    pub what: String,
    /// Letter of the expression that it begins at, counted from 1; none where the expression is not at fault.
    pub letter: Option<usize>,
}

/// A name that an expression may use.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
pub struct Name {
    /// Name.
    pub name: String,
    /// SI unit, empty where it is not known.
    pub unit: String,
}

/// The names that an expression may use: housekeeping of some products, by name with its unit, and what a
/// reconstruction gives.
pub fn names(registry: &Registry, mission: &Mission, housekeeping: &BTreeMap<String, String>) -> Vec<Name> {
    let own = housekeeping.iter().map(|(name, unit)| Name { name: name.clone(), unit: unit.clone() });
    let parameters = toml::Table::new();
    let made_up = registry.find(Kind::Effect, FORMULA).ok().map(|found| {
        let (opened, plugin) = (&found.opened, &found.info);
        Subject { opened, plugin, mission, parameters: &parameters, files: &[] }.columns()
    });
    let of_reconstruction = made_up.into_iter().flatten().filter(|c| c.table == "reconstruction");
    let of_reconstruction = of_reconstruction.filter(|c| c.attribute("kind") != "channel");
    own.chain(of_reconstruction.map(|c| Name { name: c.name.clone(), unit: c.unit.clone() })).collect()
}

/// Where a formula may act: on a test mass or on the spacecraft.
pub fn places(mission: &Mission) -> Vec<String> {
    let masses = mission.value["test_mass"].as_object().into_iter().flatten().map(|(name, _)| name.as_str());
    let bodies = masses.flat_map(|name| [(name, "accel"), (name, "force")]);
    let bodies = bodies.chain([("sc", "force"), ("sc", "torque")]);
    bodies.flat_map(|(body, what)| ["x", "y", "z"].map(|axis| format!("{body}.{what}.{axis}"))).collect()
}

/// The entry of a model, once the effect takes it and every housekeeping channel is one of the products'. Where none is
/// known, any may be meant.
///
/// # Errors
/// [`FormulaError`]: what is wrong, and where.
pub fn entry(
    registry: &Registry,
    mission: &Mission,
    housekeeping: &BTreeMap<String, String>,
    asked: &Asked,
) -> Result<EffectEntry, FormulaError> {
    let refuse = |text: &str| marked(text);
    let mut entry = EffectEntry::new(FORMULA, &asked.name);
    let text = |value: &String| toml::Value::String(value.clone());
    entry.parameters.insert("acts_on".to_owned(), text(&asked.acts_on));
    entry.parameters.insert("expression".to_owned(), text(&asked.expression));
    entry.parameters.insert("unit".to_owned(), text(&asked.unit));
    let range = asked.range.iter().map(|x| toml::Value::Float(*x)).collect();
    entry.parameters.insert("range".to_owned(), toml::Value::Array(range));
    let found = registry.find(Kind::Effect, FORMULA).map_err(|e| refuse(&e.to_string()))?;
    entry.check_instance(&found.info.manifest, mission).map_err(|e| refuse(&e))?;
    let subject =
        Subject { opened: &found.opened, plugin: &found.info, mission, parameters: &entry.parameters, files: &[] };
    subject.announced_coefficients(&asked.name).map_err(|e| refuse(&e.to_string()))?;
    match unknown(&asked.expression, housekeeping) {
        Some((letter, what)) => Err(FormulaError { what, letter: Some(letter) }),
        None => Ok(entry),
    }
}

/// The first housekeeping channel that is not there: letter and reason.
fn unknown(expression: &str, housekeeping: &BTreeMap<String, String>) -> Option<(usize, String)> {
    if housekeeping.is_empty() {
        return None;
    }
    let is_name = |c: char| c.is_ascii_alphanumeric() || c == '_' || c == '.';
    let letters: Vec<char> = expression.chars().collect();
    let begins = |k: usize| is_name(letters[k]) && (k == 0 || !is_name(letters[k - 1]));
    (0..letters.len()).filter(|k| begins(*k)).find_map(|k| {
        let word: String = letters[k..].iter().take_while(|c| is_name(**c)).collect();
        let lacks = word.starts_with(HOUSEKEEPING) && !housekeeping.contains_key(&word);
        lacks.then(|| (k + 1, format!("these products have no channel `{word}`")))
    })
}

/// An error of the plugin with the letter that it marks: `…column 7: WHAT`, the expression below it and a caret.
fn marked(text: &str) -> FormulaError {
    let short = |text: &str| text.chars().take(MOST_LETTERS).collect::<String>();
    let at = text.match_indices("column ").find_map(|(at, word)| {
        let (number, what) = text[at + word.len()..].split_once(": ")?;
        Some((number.parse::<usize>().ok()?, what.lines().next()?))
    });
    match at {
        Some((letter, what)) => FormulaError { what: short(what), letter: Some(letter) },
        None => FormulaError { what: short(text.lines().next().unwrap_or_default()), letter: None },
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_error_of_the_plugin_says_where() {
        let error =
            marked("plugin formula, create: effect formula:a: column 7: unknown name `hk`\n  1 + 2 hk\n        ^");
        assert_eq!((error.what.as_str(), error.letter), ("unknown name `hk`", Some(7)));
        assert_eq!(marked("no\ncolumn x: y").letter, None);
        assert_eq!(marked(&"é".repeat(1000)).what.chars().count(), MOST_LETTERS);
    }

    #[test]
    fn a_channel_that_is_not_there_is_marked() {
        let known = BTreeMap::from([("hk.a_k".to_owned(), "K".to_owned())]);
        assert_eq!(unknown("2 * hk.a_k", &known), None);
        let (letter, what) = unknown("\u{3c0} + lag(hk.b_k, 3)", &known).expect("unknown");
        assert_eq!((letter, what.contains("hk.b_k")), (9, true));
        assert_eq!(unknown("hk.b_k", &BTreeMap::new()), None, "nothing is known");
    }
}
