//! What a plugin is and which parameters it takes, as a constant; [`dragfree_schema::Manifest`] is the form that
//! crosses the border. Validation, `plugins inspect` and the guide's tables derive from it.

use dragfree_schema::ParameterType;
use serde_json::Value;

/// What a plugin is.
#[derive(Clone, Copy, Debug)]
pub struct Manifest {
    /// Id by which pipelines and models name it, `es-akf`.
    pub id: &'static str,
    /// Version of the plugin.
    pub version: &'static str,
    /// SPDX expression.
    pub licence: &'static str,
    /// One sentence.
    pub description: &'static str,
    /// Parameters; a key that is not among them is an error.
    pub parameters: &'static [Parameter],
    /// Effects only: the places where it can act; `{table}` in a name stands for each key of the mission's table of
    /// that name, as `{test_mass}.x`.
    pub instances: &'static [&'static str],
    /// Effects only: columns beyond the usual ones that stages before it are asked to make, by the names that they give
    /// them; see [`crate::Setup::needs`].
    pub needs: &'static [&'static str],
}

/// A parameter: name, unit, default, range, help.
#[derive(Clone, Copy, Debug)]
pub struct Parameter {
    name: &'static str,
    unit: &'static str,
    help: &'static str,
    kind: Kind,
}

#[derive(Clone, Copy, Debug)]
enum Kind {
    F64 { default: f64, minimum: f64, maximum: f64 },
    I64 { default: i64, minimum: i64, maximum: i64 },
    Bool { default: bool },
    Text { default: &'static str, choices: &'static [&'static str] },
    F64List { default: &'static [f64] },
    TextList { default: &'static [&'static str] },
}

impl Parameter {
    /// A number within `range`.
    #[must_use]
    pub const fn f64(
        name: &'static str,
        unit: &'static str,
        default: f64,
        range: std::ops::RangeInclusive<f64>,
        help: &'static str,
    ) -> Self {
        let kind = Kind::F64 { default, minimum: *range.start(), maximum: *range.end() };
        Self { name, unit, help, kind }
    }

    /// A whole number within `range`.
    #[must_use]
    pub const fn i64(
        name: &'static str,
        unit: &'static str,
        default: i64,
        range: std::ops::RangeInclusive<i64>,
        help: &'static str,
    ) -> Self {
        let kind = Kind::I64 { default, minimum: *range.start(), maximum: *range.end() };
        Self { name, unit, help, kind }
    }

    /// A switch.
    #[must_use]
    pub const fn bool(name: &'static str, default: bool, help: &'static str) -> Self {
        Self { name, unit: "", help, kind: Kind::Bool { default } }
    }

    /// A text, one of `choices` unless that is empty.
    #[must_use]
    pub const fn text(
        name: &'static str,
        default: &'static str,
        choices: &'static [&'static str],
        help: &'static str,
    ) -> Self {
        Self { name, unit: "", help, kind: Kind::Text { default, choices } }
    }

    /// A list of numbers.
    #[must_use]
    pub const fn f64_list(name: &'static str, unit: &'static str, default: &'static [f64], help: &'static str) -> Self {
        Self { name, unit, help, kind: Kind::F64List { default } }
    }

    /// A list of texts.
    #[must_use]
    pub const fn text_list(name: &'static str, default: &'static [&'static str], help: &'static str) -> Self {
        Self { name, unit: "", help, kind: Kind::TextList { default } }
    }

    fn owned(self) -> dragfree_schema::Parameter {
        let mut owned = dragfree_schema::Parameter {
            name: self.name.to_owned(),
            kind: ParameterType::F64,
            unit: self.unit.to_owned(),
            default: Value::Null,
            minimum: None,
            maximum: None,
            choices: Vec::new(),
            help: self.help.to_owned(),
        };
        (owned.kind, owned.default) = match self.kind {
            Kind::F64 { default, minimum, maximum } => {
                (owned.minimum, owned.maximum) = (Some(minimum), Some(maximum));
                (ParameterType::F64, default.into())
            }
            Kind::I64 { default, minimum, maximum } => {
                (owned.minimum, owned.maximum) = (Some(minimum as f64), Some(maximum as f64));
                (ParameterType::I64, default.into())
            }
            Kind::Bool { default } => (ParameterType::Bool, default.into()),
            Kind::Text { default, choices } => {
                owned.choices = texts(choices);
                (ParameterType::Text, default.into())
            }
            Kind::F64List { default } => (ParameterType::F64List, default.into()),
            Kind::TextList { default } => (ParameterType::TextList, default.into()),
        };
        owned
    }
}

fn texts(list: &[&str]) -> Vec<String> {
    list.iter().map(|text| (*text).to_owned()).collect()
}

impl Manifest {
    /// The manifest as it crosses the border.
    #[must_use]
    pub fn owned(&self) -> dragfree_schema::Manifest {
        dragfree_schema::Manifest {
            id: self.id.to_owned(),
            version: self.version.to_owned(),
            licence: self.licence.to_owned(),
            description: self.description.to_owned(),
            instances: texts(self.instances),
            needs: texts(self.needs),
            parameters: self.parameters.iter().map(|p| p.owned()).collect(),
        }
    }

    /// The same as JSON.
    #[must_use]
    pub fn to_json(&self) -> String {
        // A constant of texts, finite numbers and lists of them is always JSON.
        serde_json::to_string(&self.owned()).unwrap_or_default()
    }
}
