//! Columns, coefficients and constraints: what a plugin sees, asks for and makes before a byte of data is read.

use dragfree_abi as abi;
use serde::{Deserialize, Deserializer, Serialize, Serializer};
use std::collections::BTreeMap;
use std::ffi::CString;
use std::ptr;

use crate::error::PluginError;

/// A column: what it is called and what it means.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Column {
    /// Table that it belongs to.
    pub table: String,
    /// Name, unique in its table.
    pub name: String,
    /// SI unit.
    pub unit: String,
    /// Frame, empty for none.
    pub frame: String,
    /// Rate of a uniform table, Hz; 0 for an irregular one.
    pub rate_hz: f64,
    /// Free attributes.
    pub attributes: BTreeMap<String, String>,
}

impl Column {
    /// An attribute, empty where there is none.
    #[must_use]
    pub fn attribute(&self, key: &str) -> &str {
        self.attributes.get(key).map_or("", String::as_str)
    }
}

/// A coefficient of an effect.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Coefficient {
    /// `com-offset.tm1.x`
    pub name: String,
    /// Id of the effect; the host fills it in.
    pub effect: String,
    /// Instance of the effect; the host fills it in.
    pub instance: String,
    /// SI unit.
    pub unit: String,
    /// Frame.
    pub frame: String,
    /// Lower end of the physical range.
    #[serde(serialize_with = "finite_or_null", deserialize_with = "number_or_minus_infinity")]
    pub lower: f64,
    /// Upper end of the physical range.
    #[serde(serialize_with = "finite_or_null", deserialize_with = "number_or_infinity")]
    pub upper: f64,
    /// Value before any data.
    pub initial: f64,
    /// Standard deviation before any data; infinite for none.
    #[serde(serialize_with = "finite_or_null", deserialize_with = "number_or_infinity")]
    pub prior_sigma: f64,
    /// False where the model fixes the coefficient at `initial`; the host fills it in.
    pub estimate: bool,
    /// True where the effect is no part of the model, and only asks to be; the host fills it in.
    pub candidate: bool,
    /// How it acts, besides by the columns of [`EffectLink::regressor`].
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub responses: Vec<Response>,
    /// Values of the shape parameters behind the responses, a lag or a resonance.
    #[serde(skip_serializing_if = "Shape::is_empty")]
    pub shape: Shape,
    /// What else it may be; declared in place of `responses` by a [`crate::Setup::candidate`].
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub variants: Vec<Variant>,
    /// What it may do for a short while, at a time that is to be found; declared by a [`crate::Setup::candidate`].
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub transients: Vec<Transient>,
    /// A process of the mission's noise whose amplitude the coefficient multiplies, 1 for as the mission has it; such a coefficient
    /// has no responses.
    #[serde(skip_serializing_if = "String::is_empty")]
    pub noise: String,
    /// A process of the mission's noise that it colours.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub colours: Option<Colour>,
}

/// What a coefficient c does to a process of the mission's noise that drives what it stands for as commands do: `|1 + cH|²` times its
/// power.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Colour {
    /// The process, `thruster_force:sc.x`.
    pub process: String,
    /// `H(s)`, s in s⁻¹: coefficients of the numerator's polynomial, the constant first.
    pub numerator: Vec<f64>,
    /// The same of its denominator.
    pub denominator: Vec<f64>,
}

/// Shape parameters by name: numbers, or names of columns.
pub type Shape = BTreeMap<String, serde_json::Value>;

/// How one channel answers to a coefficient: `factor` times a series, times the value of another coefficient where `times` names
/// one.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Response {
    /// The channel, `tm1.accel.x`.
    pub channel: String,
    /// Table of the series.
    pub table: String,
    /// Column of the series, a mean over `[t_k, t_{k+1})`.
    pub series: String,
    /// Unit of the channel per unit of the series and of the coefficients.
    pub factor: f64,
    /// The other coefficient of a product, `com-offset.tm1.x`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub times: Option<String>,
}

/// One of several forms that a cause may have.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Variant {
    /// Values of the shape parameters; as parameters of the effect they give these responses.
    pub shape: Shape,
    /// How it acts.
    pub responses: Vec<Response>,
    /// Unit of the coefficient, where it is not that of the others.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub unit: Option<String>,
    /// Its physical range, lower and upper end, where it is not that of the others.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub range: Option<[f64; 2]>,
    /// A process of the mission's noise that it colours.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub colours: Option<Colour>,
}

/// Something short that begins at an unknown time: a hit, a glitch.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Transient {
    /// Values of the shape parameters, all but `at_ns`, which the host finds: Unix ns of the sample in which it begins.
    pub shape: Shape,
    /// Its course, one mean per sample from the one in which it begins.
    pub kernel: Vec<f64>,
    /// Channels with the factor with which the course acts on each: unit of the channel per unit of kernel and coefficient.
    pub channels: Vec<(String, f64)>,
}

impl Default for Coefficient {
    fn default() -> Self {
        Self {
            name: String::new(),
            effect: String::new(),
            instance: String::new(),
            unit: "1".to_owned(),
            frame: String::new(),
            lower: f64::NEG_INFINITY,
            upper: f64::INFINITY,
            initial: 0.0,
            prior_sigma: f64::INFINITY,
            estimate: true,
            candidate: false,
            responses: Vec::new(),
            shape: Shape::new(),
            variants: Vec::new(),
            transients: Vec::new(),
            noise: String::new(),
            colours: None,
        }
    }
}

/// A linear constraint on coefficients, `lower ≤ Σ weight · coefficient ≤ upper`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Constraint {
    /// Name; constraints of one name from several instances add their terms.
    pub name: String,
    /// `survey`, a measurement with a tolerance, or `range`, a physical bound.
    pub kind: String,
    /// Coefficients with their weights.
    pub terms: Vec<(String, f64)>,
    /// Lower bound.
    #[serde(serialize_with = "finite_or_null", deserialize_with = "number_or_minus_infinity")]
    pub lower: f64,
    /// Upper bound.
    #[serde(serialize_with = "finite_or_null", deserialize_with = "number_or_infinity")]
    pub upper: f64,
    /// SI unit of the bounds.
    pub unit: String,
    /// Number of instances that must contribute; with fewer the host drops the constraint.
    pub parts: u32,
}

// JSON has no infinity: an open end of a range crosses the border as null.
fn finite_or_null<S: Serializer>(value: &f64, serializer: S) -> Result<S::Ok, S::Error> {
    value.is_finite().then_some(*value).serialize(serializer)
}

fn number_or_infinity<'de, D: Deserializer<'de>>(deserializer: D) -> Result<f64, D::Error> {
    Ok(Option::deserialize(deserializer)?.unwrap_or(f64::INFINITY))
}

fn number_or_minus_infinity<'de, D: Deserializer<'de>>(deserializer: D) -> Result<f64, D::Error> {
    Ok(Option::deserialize(deserializer)?.unwrap_or(f64::NEG_INFINITY))
}

/// What exists at this point of the chain.
#[derive(Clone, Debug, Default)]
pub struct Available {
    /// Every column made so far, in the order in which they were made.
    pub columns: Vec<Column>,
    /// Every coefficient of the model's effects before this point.
    pub coefficients: Vec<Coefficient>,
    /// Every constraint on them.
    pub constraints: Vec<Constraint>,
}

#[derive(Deserialize)]
struct ModelJson {
    #[serde(default)]
    coefficients: Vec<Coefficient>,
    #[serde(default)]
    constraints: Vec<Constraint>,
}

impl Available {
    pub(crate) fn parse(columns: Vec<Column>, model_json: &str) -> Result<Self, PluginError> {
        let model: ModelJson = serde_json::from_str(model_json)?;
        Ok(Self { columns, coefficients: model.coefficients, constraints: model.constraints })
    }

    /// A column by table and name.
    #[must_use]
    pub fn column(&self, table: &str, name: &str) -> Option<&Column> {
        self.columns.iter().find(|c| c.table == table && c.name == name)
    }

    /// A column by name, in whichever table.
    #[must_use]
    pub fn find(&self, name: &str) -> Option<&Column> {
        self.columns.iter().find(|c| c.name == name)
    }

    /// The columns whose attribute `kind` is `kind`.
    pub fn of_kind<'a>(&'a self, kind: &'a str) -> impl Iterator<Item = &'a Column> {
        self.columns.iter().filter(move |c| c.attribute("kind") == kind)
    }

    /// How the channels answer to each coefficient: those that the coefficients declare, and the columns of `kind` `regressor`,
    /// which are a response with the factor one each.
    ///
    /// # Errors
    /// A column is a regressor of a coefficient that nobody declares.
    pub fn responses(&self) -> Result<Vec<(&Coefficient, Response)>, PluginError> {
        let mut all = Vec::new();
        for column in self.of_kind("regressor") {
            let name = column.attribute("coefficient");
            let coefficient = self.coefficient(name).ok_or_else(|| {
                PluginError::error(format!(
                    "column {} of table {} is a regressor of coefficient `{name}`, which nobody declares; the effect that makes it \
                     must announce it in its link",
                    column.name, column.table
                ))
            })?;
            let channel = column.attribute("channel").to_owned();
            let (table, series) = (column.table.clone(), column.name.clone());
            all.push((coefficient, Response { channel, table, series, factor: 1.0, times: None }));
        }
        for c in &self.coefficients {
            all.extend(c.responses.iter().map(|r| (c, r.clone())));
        }
        Ok(all)
    }

    /// A coefficient by name.
    #[must_use]
    pub fn coefficient(&self, name: &str) -> Option<&Coefficient> {
        self.coefficients.iter().find(|c| c.name == name)
    }
}

/// A column that a plugin asks for: a name, and what it must be.
#[derive(Clone, Debug, PartialEq)]
pub struct Want {
    table: Option<String>,
    name: String,
    unit: Option<String>,
    frame: Option<String>,
    rate_hz: f64,
}

impl Want {
    /// A column of this name, in whichever table.
    pub fn new(name: impl Into<String>) -> Self {
        Self { table: None, name: name.into(), unit: None, frame: None, rate_hz: 0.0 }
    }

    /// The very column that was found among the available ones.
    #[must_use]
    pub fn of(column: &Column) -> Self {
        Self::new(&column.name).table(&column.table)
    }

    /// It must be in this table.
    #[must_use]
    pub fn table(mut self, table: impl Into<String>) -> Self {
        self.table = Some(table.into());
        self
    }

    /// It must have this unit.
    #[must_use]
    pub fn unit(mut self, unit: impl Into<String>) -> Self {
        self.unit = Some(unit.into());
        self
    }

    /// It must be in this frame.
    #[must_use]
    pub fn frame(mut self, frame: impl Into<String>) -> Self {
        self.frame = Some(frame.into());
        self
    }

    /// It must have this rate, Hz.
    #[must_use]
    pub fn rate_hz(mut self, rate_hz: f64) -> Self {
        self.rate_hz = rate_hz;
        self
    }
}

/// A column that will be read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct In {
    pub(crate) slot: abi::SlotV1,
}

/// A table that will be written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Table {
    pub(crate) index: usize,
}

/// A column that will be written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Out {
    pub(crate) table: usize,
    pub(crate) column: usize,
}

/// A table that a plugin writes, as declared.
#[derive(Clone, Debug)]
pub(crate) struct Written {
    pub(crate) name: String,
    pub(crate) rate_hz: f64,
    pub(crate) columns: Vec<Column>,
}

/// Where the declarations of `link` go.
#[derive(Debug)]
pub struct Link<'a> {
    raw: &'a abi::LinkV1,
    pub(crate) uniform_input: Option<u32>,
    pub(crate) written: Vec<Written>,
    available: Vec<(Option<String>, String, f64)>,
}

impl<'a> Link<'a> {
    pub(crate) fn new(raw: &'a abi::LinkV1, available: &Available) -> Self {
        let available = available.columns.iter().map(|c| (Some(c.table.clone()), c.name.clone(), c.rate_hz)).collect();
        Self { raw, uniform_input: None, written: Vec::new(), available }
    }

    /// Asks for a column.
    ///
    /// # Errors
    /// The host has no such column, or its unit, frame or rate is another; the host holds the sentence.
    pub fn read(&mut self, want: &Want) -> Result<In, PluginError> {
        let mut slot = abi::SlotV1::default();
        crate::border::ask_for_column(self.raw, want.parts(), &mut slot)?;
        // Of a name that raw telemetry shares with a uniform table the host gives the uniform one.
        let rate_hz = self
            .available
            .iter()
            .filter(|(table, name, _)| *name == want.name && (want.table.is_none() || *table == want.table))
            .fold(0.0, |fastest: f64, (_, _, rate_hz)| fastest.max(*rate_hz));
        if rate_hz > 0.0 && self.uniform_input.is_none() {
            self.uniform_input = Some(slot.table);
        }
        Ok(In { slot })
    }

    /// Asks for a column if it is there.
    ///
    /// # Errors
    /// It is there, but with another unit, frame or rate.
    pub fn read_if_available(&mut self, available: &Available, want: &Want) -> Result<Option<In>, PluginError> {
        let there = available
            .columns
            .iter()
            .any(|c| c.name == want.name && want.table.as_ref().is_none_or(|table| *table == c.table));
        if there { self.read(want).map(Some) } else { Ok(None) }
    }

    /// A table that will be written: uniform at `rate_hz`, irregular with 0.
    pub fn table(&mut self, name: impl Into<String>, rate_hz: f64) -> Table {
        self.written.push(Written { name: name.into(), rate_hz, columns: Vec::new() });
        Table { index: self.written.len() - 1 }
    }

    /// A column that will be written.
    ///
    /// # Errors
    /// The host refuses it: the name is taken.
    pub fn write(&mut self, table: Table, name: &str, unit: &str, frame: &str) -> Result<Out, PluginError> {
        self.write_with(table, name, unit, frame, &[])
    }

    /// A column with attributes.
    ///
    /// # Errors
    /// The host refuses it: the name is taken.
    pub fn write_with(
        &mut self,
        table: Table,
        name: &str,
        unit: &str,
        frame: &str,
        attributes: &[(&str, &str)],
    ) -> Result<Out, PluginError> {
        let written = &mut self.written[table.index];
        let column = Column {
            table: written.name.clone(),
            name: name.to_owned(),
            unit: unit.to_owned(),
            frame: frame.to_owned(),
            rate_hz: written.rate_hz,
            attributes: attributes.iter().map(|(k, v)| ((*k).to_owned(), (*v).to_owned())).collect(),
        };
        crate::border::announce_column(self.raw, &column)?;
        written.columns.push(column);
        Ok(Out { table: table.index, column: written.columns.len() - 1 })
    }
}

/// Where an effect's declarations go: a [`Link`] that also takes coefficients and constraints.
#[derive(Debug)]
pub struct EffectLink<'l, 'a> {
    link: &'l mut Link<'a>,
    table: Table,
    effect: &'static str,
}

impl<'l, 'a> EffectLink<'l, 'a> {
    pub(crate) fn new(link: &'l mut Link<'a>, effect: &'static str, instance: &str, rate_hz: f64) -> Self {
        let table = link.table(format!("effect/{effect}:{instance}"), rate_hz);
        Self { link, table, effect }
    }

    /// Asks for a column; see [`Link::read`].
    ///
    /// # Errors
    /// As [`Link::read`].
    pub fn read(&mut self, want: &Want) -> Result<In, PluginError> {
        self.link.read(want)
    }

    /// Asks for a column if it is there; see [`Link::read_if_available`].
    ///
    /// # Errors
    /// As [`Link::read_if_available`].
    pub fn read_if_available(&mut self, available: &Available, want: &Want) -> Result<Option<In>, PluginError> {
        self.link.read_if_available(available, want)
    }

    /// A coefficient of this effect.
    ///
    /// # Errors
    /// The host refuses it: the name is taken.
    pub fn coefficient(&mut self, coefficient: &Coefficient) -> Result<(), PluginError> {
        crate::border::announce_json(self.link.raw, crate::border::Announcement::Coefficient, coefficient)
    }

    /// A series that responses refer to by [`Self::table`] and this name: one value per row, a mean over `[t_k, t_{k+1})`.
    ///
    /// # Errors
    /// The host refuses it: the name is taken.
    pub fn series(&mut self, name: &str, unit: &str, frame: &str) -> Result<Out, PluginError> {
        self.link.write_with(self.table, name, unit, frame, &[("kind", "series"), ("effect", self.effect)])
    }

    /// As [`Self::shared_series`], of a series without content above `below_hz`, such as one made of housekeeping: nobody need look for
    /// it there.
    ///
    /// # Errors
    /// As [`Self::series`].
    pub fn slow_series(
        &mut self,
        available: &Available,
        name: &str,
        unit: &str,
        below_hz: f64,
    ) -> Result<(String, Option<Out>), PluginError> {
        match available.of_kind("series").find(|c| c.name == name) {
            Some(column) => Ok((column.table.clone(), None)),
            None => {
                let below_hz = below_hz.to_string();
                let attributes = [("kind", "series"), ("effect", self.effect), ("below_hz", &below_hz)];
                Ok((self.table(), Some(self.link.write_with(self.table, name, unit, "", &attributes)?)))
            }
        }
    }

    /// A series of this name of an effect before this one, by its table, or else a new one of this effect. The name must say all
    /// that the values depend on: `lag(hk.eh1_xp_temperature_k, 480)`.
    ///
    /// # Errors
    /// As [`Self::series`].
    pub fn shared_series(
        &mut self,
        available: &Available,
        name: &str,
        unit: &str,
        frame: &str,
    ) -> Result<(String, Option<Out>), PluginError> {
        match available.of_kind("series").find(|c| c.name == name) {
            Some(column) => Ok((column.table.clone(), None)),
            None => Ok((self.table(), Some(self.series(name, unit, frame)?))),
        }
    }

    /// Name of the table that this effect writes.
    #[must_use]
    pub fn table(&self) -> String {
        self.link.written[self.table.index].name.clone()
    }

    /// What one unit of `coefficient` adds to `channel`; `unit` is the channel's unit per the coefficient's.
    ///
    /// # Errors
    /// The host refuses it.
    pub fn regressor(&mut self, coefficient: &str, channel: &str, unit: &str) -> Result<Out, PluginError> {
        let attributes =
            [("kind", "regressor"), ("coefficient", coefficient), ("channel", channel), ("effect", self.effect)];
        self.link.write_with(self.table, &format!("{coefficient}@{channel}"), unit, "", &attributes)
    }

    /// A constraint on coefficients.
    ///
    /// # Errors
    /// The host refuses it: its bounds contradict those of the same name.
    pub fn constraint(&mut self, constraint: &Constraint) -> Result<(), PluginError> {
        crate::border::announce_json(self.link.raw, crate::border::Announcement::Constraint, constraint)
    }
}

/// A [`Want`] as C strings.
pub(crate) struct WantParts {
    pub(crate) table: Option<CString>,
    pub(crate) name: CString,
    pub(crate) unit: Option<CString>,
    pub(crate) frame: Option<CString>,
    pub(crate) rate_hz: f64,
}

impl Want {
    fn parts(&self) -> Result<WantParts, PluginError> {
        let c = |s: &Option<String>| s.as_deref().map(CString::new).transpose();
        Ok(WantParts {
            table: c(&self.table)?,
            name: CString::new(self.name.as_str())?,
            unit: c(&self.unit)?,
            frame: c(&self.frame)?,
            rate_hz: self.rate_hz,
        })
    }
}

pub(crate) fn pointer(text: Option<&CString>) -> *const std::ffi::c_char {
    text.map_or(ptr::null(), |s| s.as_ptr())
}
