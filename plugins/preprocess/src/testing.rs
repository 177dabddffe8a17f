//! Shared by the tests: a noise generator, and columns with units and frames.

use crate::layout::expected;
use dragfree_sdk::Column;

/// Gaussian noise from SplitMix64 and the method of Box and Muller.
pub(crate) struct Noise(u64);

impl Noise {
    pub(crate) fn new(seed: u64) -> Self {
        Self(seed)
    }
    pub(crate) fn word(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }
    /// Uniform in (0, 1).
    pub(crate) fn uniform(&mut self) -> f64 {
        ((self.word() >> 11) as f64 + 0.5) / (1_u64 << 53) as f64
    }
    pub(crate) fn gauss(&mut self) -> f64 {
        (-2.0 * self.uniform().ln()).sqrt() * (std::f64::consts::TAU * self.uniform()).cos()
    }
}

/// Columns of a table with the unit and frame of `telemetry.proto`; a flag if it has none.
pub(crate) fn columns(table: &str, names: &[&str]) -> Vec<Column> {
    let column = |name: &&str| {
        let (unit, frame) = expected(table, name).unwrap_or(if *name == "value" { ("K", "") } else { ("", "") });
        Column {
            table: table.to_owned(),
            name: (*name).to_owned(),
            unit: unit.to_owned(),
            frame: frame.to_owned(),
            ..Column::default()
        }
    };
    names.iter().map(column).collect()
}
