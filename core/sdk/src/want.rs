//! What a plugin asks of a column.

use dragfree_schema::Column;

/// A column that a plugin asks for: a name, and what it must be.
#[derive(Clone, Debug, PartialEq)]
pub struct Want {
    pub(crate) table: Option<String>,
    pub(crate) name: String,
    pub(crate) unit: Option<String>,
    pub(crate) frame: Option<String>,
    pub(crate) rate_hz: f64,
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
