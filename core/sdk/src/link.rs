//! Columns, coefficients and constraints: what a plugin sees, asks for and makes before a byte of data is read.

use dragfree_abi as abi;
use dragfree_schema::{Available, Coefficient, Column, Constraint, NoiseProcess};

use crate::error::PluginError;
use crate::host;
use crate::want::Want;

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
        let slot = host::read(self.raw, want)?;
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
        self.write_noisy(table, name, unit, frame, attributes, &[])
    }

    /// A column with attributes, and noise processes that are declared with it. A process may enter any channel of this
    /// stage or of one before it; which column it is declared with does not matter.
    ///
    /// # Errors
    /// The host refuses it: the name is taken, a process of this name exists, or one of its numbers is not finite.
    pub fn write_noisy(
        &mut self,
        table: Table,
        name: &str,
        unit: &str,
        frame: &str,
        attributes: &[(&str, &str)],
        noise: &[NoiseProcess],
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
        host::write(self.raw, &column, noise)?;
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
        host::declare(self.link.raw, self.link.raw.coefficient, coefficient)
    }

    /// A series that responses refer to by [`Self::table`] and this name: one value per row, a mean over
    /// `[t_k, t_{k+1})`.
    ///
    /// # Errors
    /// The host refuses it: the name is taken.
    pub fn series(&mut self, name: &str, unit: &str, frame: &str) -> Result<Out, PluginError> {
        self.series_with(name, unit, frame, &[])
    }

    /// As [`Self::series`], with more attributes.
    ///
    /// # Errors
    /// As [`Self::series`].
    pub fn series_with(
        &mut self,
        name: &str,
        unit: &str,
        frame: &str,
        attributes: &[(&str, &str)],
    ) -> Result<Out, PluginError> {
        let all = [&[("kind", "series"), ("effect", self.effect)], attributes].concat();
        self.link.write_with(self.table, name, unit, frame, &all)
    }

    /// As [`Self::shared_series`], of a series without content above `below_hz`, such as one made of housekeeping:
    /// nobody need look for it there.
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

    /// A series of this name of an effect before this one, by its table, or else a new one of this effect. The name
    /// must say all that the values depend on: `lag(hk.eh1_xp_temperature_k, 480)`.
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
        self.shared_series_with(available, name, unit, frame, &[])
    }

    /// As [`Self::shared_series`], with further attributes of the column.
    ///
    /// # Errors
    /// As [`Self::series`].
    pub fn shared_series_with(
        &mut self,
        available: &Available,
        name: &str,
        unit: &str,
        frame: &str,
        attributes: &[(&str, &str)],
    ) -> Result<(String, Option<Out>), PluginError> {
        if let Some(column) = available.of_kind("series").find(|c| c.name == name) {
            return Ok((column.table.clone(), None));
        }
        let all = [&[("kind", "series"), ("effect", self.effect)], attributes].concat();
        Ok((self.table(), Some(self.link.write_with(self.table, name, unit, frame, &all)?)))
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
        self.regressor_with(coefficient, channel, unit, &[])
    }

    /// As [`Self::regressor`], with further attributes of the column.
    ///
    /// # Errors
    /// The host refuses it.
    pub fn regressor_with(
        &mut self,
        coefficient: &str,
        channel: &str,
        unit: &str,
        attributes: &[(&str, &str)],
    ) -> Result<Out, PluginError> {
        let own = [("kind", "regressor"), ("coefficient", coefficient), ("channel", channel), ("effect", self.effect)];
        let all = [&own, attributes].concat();
        self.link.write_with(self.table, &format!("{coefficient}@{channel}"), unit, "", &all)
    }

    /// A constraint on coefficients.
    ///
    /// # Errors
    /// The host refuses it: its bounds contradict those of the same name.
    pub fn constraint(&mut self, constraint: &Constraint) -> Result<(), PluginError> {
        host::declare(self.link.raw, self.link.raw.constraint, constraint)
    }
}
