//! The columns of which the sums are made.

use dragfree_estimation::decimate::SLOW_HZ;
use dragfree_estimation::spectra::Plan;

/// What the columns are, in the order in which they are handed in.
#[derive(Clone, Debug, PartialEq)]
pub struct Columns {
    /// Names: channels, series of the model, series of candidates, slow series of candidates.
    pub names: Vec<String>,
    /// Tables in which they stand. Names may come again in another table.
    pub tables: Vec<String>,
    /// How many of them are channels.
    pub channels: usize,
    /// Channels and series of the model.
    pub base: usize,
    /// All but the slow ones.
    pub fast: usize,
    /// Energy per band of the waveforms, which stand last among those: what they would add to the diagonal of the Gram
    /// matrix without a taper. A taper leaves a part of it that depends on their time.
    pub energy: Vec<Vec<f64>>,
    /// Units of housekeeping, whose samples follow the columns.
    pub housekeeping_units: Vec<String>,
}

impl Columns {
    /// Energy per band of a waveform.
    pub fn energy_of(&self, column: usize) -> Option<&[f64]> {
        let first = self.fast.checked_sub(self.energy.len())?;
        self.energy.get(column.checked_sub(first)?).map(Vec::as_slice)
    }

    /// Index of a column.
    pub fn place(&self, table: &str, name: &str) -> Option<usize> {
        (0..self.names.len()).find(|i| self.tables[*i] == table && self.names[*i] == name)
    }

    /// Number of columns in a band.
    pub(crate) fn active(&self, plan: &Plan, band: usize) -> usize {
        if plan.bin_hz(plan.bands[band].end as f64) <= SLOW_HZ { self.names.len() } else { self.fast }
    }
}
