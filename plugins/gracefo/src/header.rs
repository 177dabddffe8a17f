//! YAML header of a GRACE-FO Level-1 text file, which defines the columns of a row.

use serde_yaml_ng::{Mapping, Value};

use crate::Level1Error;

/// The line that ends the header.
pub const END_OF_HEADER: &str = "# End of YAML header";

/// Maximum header size; headers of the mission are below 60 kB.
pub const MAX_HEADER_BYTES: usize = 1 << 20;

/// Epoch of the mission's time tags, as written in headers.
const EPOCH: &str = "2000-01-01T12:00:00";

/// Which rows contain a variable.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Presence {
    /// All rows.
    Always,
    /// Rows whose `prod_flag` has this bit set.
    Bit(u8),
    /// No row: the header gives the variable no bit (`statusflag` of ACC1A).
    Never,
}

/// A variable of the header, in column order.
#[derive(Clone, Debug, PartialEq)]
pub struct Variable {
    /// Name as written.
    pub name: String,
    /// Unit as written; empty where the header gives none.
    pub units: String,
    /// Which rows contain it.
    pub presence: Presence,
    /// Value that the header defines as missing.
    pub fill: Option<f64>,
}

/// A parsed header.
#[derive(Clone, Debug, PartialEq)]
pub struct Header {
    /// `dimensions.num_records`, which real files violate.
    pub num_records: Option<u64>,
    /// `GRACE C`, `GRACE D`.
    pub platform: String,
    /// Variables in the order of a row's columns.
    pub variables: Vec<Variable>,
    /// Bits of `qualflg` that mean that the time tag is not on the receiver's time scale.
    pub untimed_mask: u32,
}

impl Header {
    /// Parses the text above [`END_OF_HEADER`].
    ///
    /// # Errors
    /// [`Level1Error`]: invalid YAML, no list of variables, or another epoch.
    pub fn parse(text: &str) -> Result<Self, Level1Error> {
        let root: Value = serde_yaml_ng::from_str(text).map_err(|e| Level1Error::Yaml(e.to_string()))?;
        let header = root.get("header").ok_or(Level1Error::MissingKey("header"))?;
        let epoch = at(header, &["non-standard_attributes", "epoch_time"]).map(scalar).unwrap_or_default();
        if !epoch.starts_with(EPOCH) {
            return Err(Level1Error::Epoch(epoch));
        }
        let list = at(header, &["variables"])
            .and_then(Value::as_sequence)
            .ok_or(Level1Error::MissingKey("header.variables"))?;
        let mut bits = list.iter().filter_map(named).find(|(n, _)| n == "prod_flag").map_or_else(Vec::new, |(_, v)| {
            let mut bits = defined_bits(v);
            bits.reverse();
            bits
        });
        let mut variables = Vec::with_capacity(list.len());
        let mut untimed_mask = 0;
        for (name, about) in list.iter().filter_map(named) {
            // The comment is "5th column" or "next column, if prod_flag bit set".
            let conditional = text_of(about, "comment").contains("prod_flag");
            let presence = match conditional {
                false => Presence::Always,
                true => bits.pop().map_or(Presence::Never, Presence::Bit),
            };
            if name == "qualflg" {
                untimed_mask = untimed_bits(about);
            }
            variables.push(Variable {
                units: text_of(about, "units"),
                fill: ["_FillValue", "fill_value", "missing_value"].iter().find_map(|k| text_of(about, k).parse().ok()),
                name,
                presence,
            });
        }
        Ok(Self {
            num_records: at(header, &["dimensions", "num_records"]).and_then(Value::as_u64),
            platform: at(header, &["global_attributes", "platform"]).map(scalar).unwrap_or_default(),
            variables,
            untimed_mask,
        })
    }

    /// Index of a variable.
    pub fn index(&self, name: &str) -> Option<usize> {
        self.variables.iter().position(|v| v.name == name)
    }
}

fn at<'a>(value: &'a Value, path: &[&str]) -> Option<&'a Value> {
    path.iter().try_fold(value, |v, key| v.get(key))
}

/// Removes tags such as `!<!> "[1b, 2b]"`, which carry no information here.
fn untagged(value: &Value) -> &Value {
    match value {
        Value::Tagged(t) => &t.value,
        v => v,
    }
}

fn scalar(value: &Value) -> String {
    match untagged(value) {
        Value::String(s) => s.clone(),
        Value::Number(n) => n.to_string(),
        Value::Bool(b) => b.to_string(),
        _ => String::new(),
    }
}

fn text_of(about: &Mapping, key: &str) -> String {
    about.get(key).map(scalar).unwrap_or_default()
}

/// Name and body of an item `- NAME: {…}`.
fn named(item: &Value) -> Option<(String, &Mapping)> {
    let (name, about) = item.as_mapping()?.iter().next()?;
    Some((name.as_str()?.to_owned(), about.as_mapping()?))
}

fn meanings(about: &Mapping) -> impl Iterator<Item = String> + '_ {
    ["flag_meanings", "bit_meanings"]
        .iter()
        .filter_map(|k| about.get(*k).map(untagged).and_then(Value::as_sequence))
        .flatten()
        .map(scalar)
}

/// `bit 3 = meaning` → (3, "meaning"). Ranges (`bits 29-31 = Not defined`) are never defined bits.
fn bit(meaning: &str) -> Option<(u8, &str)> {
    let (number, text) = meaning.strip_prefix("bit ")?.split_once('=')?;
    let number = number.trim().parse().ok().filter(|n| *n < 32)?;
    Some((number, text.trim()))
}

/// Bits of `prod_flag` that announce a value. The k-th belongs to the k-th conditional variable: order is reliable,
/// spelling (`ICU block number`, `icu_blk_nr`) is not.
fn defined_bits(about: &Mapping) -> Vec<u8> {
    meanings(about).filter_map(|m| bit(&m).filter(|(_, text)| *text != "Not defined").map(|(n, _)| n)).collect()
}

fn untimed_bits(about: &Mapping) -> u32 {
    let says_untimed = |t: &str| t.contains("1 - Spacecraft elapsed time") || t.contains("No Timing pulse sync");
    let mask = |m: String| bit(&m).filter(|(_, t)| says_untimed(t)).map(|(n, _)| 1_u32 << n);
    meanings(about).filter_map(mask).fold(0, |all, one| all | one)
}
