//! What exists at a point of the chain.

use crate::{Coefficient, Column, Constraint, Model, NoiseProcess, Response};

/// Columns and declarations of the plugins before this point, in the order in which they were made.
#[derive(Clone, Debug, Default)]
pub struct Available {
    /// Columns.
    pub columns: Vec<Column>,
    /// Coefficients of the model's effects.
    pub coefficients: Vec<Coefficient>,
    /// Constraints on them.
    pub constraints: Vec<Constraint>,
    /// Noise in the channels, at the levels that the model's effects state.
    pub noise: Vec<NoiseProcess>,
}

/// A column is a regressor of a coefficient that no effect declares.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct NoSuchCoefficient {
    /// Table of the column.
    pub table: String,
    /// The column.
    pub column: String,
    /// The coefficient that it names.
    pub coefficient: String,
}

impl std::fmt::Display for NoSuchCoefficient {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(
            f,
            "column {} of table {} is a regressor of coefficient `{}`, which nobody declares; the effect that makes it \
             must announce it in its link",
            self.column, self.table, self.coefficient
        )
    }
}

impl std::error::Error for NoSuchCoefficient {}

impl Available {
    /// Columns, and what a model declares of them.
    pub fn new(columns: Vec<Column>, model: Model) -> Self {
        let Model { coefficients, constraints, noise } = model;
        Self { columns, coefficients, constraints, noise }
    }

    /// A column by table and name.
    pub fn column(&self, table: &str, name: &str) -> Option<&Column> {
        self.columns.iter().find(|c| c.table == table && c.name == name)
    }

    /// A column by name, in whichever table.
    pub fn find(&self, name: &str) -> Option<&Column> {
        self.columns.iter().find(|c| c.name == name)
    }

    /// The columns whose attribute `kind` is `kind`.
    pub fn of_kind<'a>(&'a self, kind: &'a str) -> impl Iterator<Item = &'a Column> {
        self.columns.iter().filter(move |c| c.attribute("kind") == kind)
    }

    /// How the channels answer to each coefficient: those that the coefficients declare, and the columns of `kind`
    /// `regressor`, which are a response with the factor one each.
    ///
    /// # Errors
    /// A column is a regressor of a coefficient that nobody declares.
    pub fn responses(&self) -> Result<Vec<(&Coefficient, Response)>, NoSuchCoefficient> {
        let mut all = Vec::new();
        for column in self.of_kind("regressor") {
            let (table, series) = (column.table.clone(), column.name.clone());
            let name = column.attribute("coefficient");
            let Some(coefficient) = self.coefficient(name) else {
                return Err(NoSuchCoefficient { table, column: series, coefficient: name.to_owned() });
            };
            let channel = column.attribute("channel").to_owned();
            all.push((coefficient, Response { channel, table, series, factor: 1.0, times: None, in_readout: false }));
        }
        for c in &self.coefficients {
            all.extend(c.responses.iter().map(|r| (c, r.clone())));
        }
        Ok(all)
    }

    /// Whether a response is by a series that was made from commands (attribute `in_loop` = `true`).
    pub fn is_in_loop(&self, response: &Response) -> bool {
        let made = |c: &&Column| c.name == response.series && (response.table.is_empty() || c.table == response.table);
        self.columns.iter().filter(made).any(|c| c.attribute("in_loop") == "true")
    }

    /// Whether a coefficient acts through a series that was made from commands. Commands depend on the past readouts of
    /// all channels: a fit of such a coefficient must condition on all of them.
    ///
    /// # Errors
    /// As [`Self::responses`].
    pub fn has_regressors_in_loop(&self) -> Result<bool, NoSuchCoefficient> {
        Ok(self.responses()?.iter().any(|(_, r)| self.is_in_loop(r)))
    }

    /// A coefficient by name.
    pub fn coefficient(&self, name: &str) -> Option<&Coefficient> {
        self.coefficients.iter().find(|c| c.name == name)
    }
}
