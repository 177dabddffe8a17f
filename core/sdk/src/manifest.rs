//! What a plugin is and which parameters it takes, declared once; validation, `plugins inspect` and the guide's
//! tables derive from it.

use serde_json::{Value, json};

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
    /// Effects only: the instances that exist, `tm1`, `tm2`.
    pub instances: &'static [&'static str],
    /// Effects only: columns beyond the usual ones that stages before it are asked to make, by the names that they give them;
    /// see [`crate::Setup::needs`].
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

    fn to_json(self) -> Value {
        let mut object = json!({ "name": self.name, "unit": self.unit, "help": self.help });
        let fields = match self.kind {
            Kind::F64 { default, minimum, maximum } => {
                json!({ "type": "f64", "default": default, "minimum": minimum, "maximum": maximum })
            }
            Kind::I64 { default, minimum, maximum } => {
                json!({ "type": "i64", "default": default, "minimum": minimum, "maximum": maximum })
            }
            Kind::Bool { default } => json!({ "type": "bool", "default": default }),
            Kind::Text { default, choices } => json!({ "type": "text", "default": default, "choices": choices }),
            Kind::F64List { default } => json!({ "type": "f64_list", "default": default }),
            Kind::TextList { default } => json!({ "type": "text_list", "default": default }),
        };
        if let (Value::Object(object), Value::Object(fields)) = (&mut object, fields) {
            object.extend(fields);
        }
        object
    }
}

impl Manifest {
    /// The manifest as the border carries it.
    #[must_use]
    pub fn to_json(&self) -> String {
        json!({
            "id": self.id,
            "version": self.version,
            "licence": self.licence,
            "description": self.description,
            "instances": self.instances,
            "needs": self.needs,
            "parameters": self.parameters.iter().map(|p| p.to_json()).collect::<Vec<_>>(),
        })
        .to_string()
    }
}
