//! The truth of a simulation, for the demo's last lines alone: no calibration reads it.

use crate::failure::Failure;
use crate::text;
use dragfree_engine::product::Coefficient;
use dragfree_engine::telemetry::first_message;
use std::collections::BTreeMap;
use std::path::Path;

/// The first message of `/truth` in a file, by field path, `b1_orf_m.x`.
pub(crate) fn first(path: &Path) -> Result<BTreeMap<String, f64>, Failure> {
    first_message(path, "/truth").map_err(Failure::engine)
}

/// True offset of a coefficient `com-offset.tmN.AXIS`, m.
pub(crate) fn offset(truth: &BTreeMap<String, f64>, coefficient: &str) -> Option<f64> {
    let (test_mass, axis) = coefficient.strip_prefix("com-offset.tm")?.split_once('.')?;
    truth.get(&format!("b{test_mass}_orf_m.{axis}")).copied()
}

/// True offsets beside what the solution `adopted` makes of them, or each solution where none is adopted.
pub(crate) fn table(coefficients: &[Coefficient], truth: &BTreeMap<String, f64>) -> String {
    let adopted = coefficients.iter().any(|c| c.solution == "adopted");
    let shown = coefficients.iter().filter(|c| !adopted || c.solution == "adopted");
    let row = |c: &Coefficient| {
        let truth_m = offset(truth, &c.name)?;
        let (unit, factor) = text::readable_unit(&c.unit);
        let error = c.value - truth_m;
        Some(vec![
            c.name.clone(),
            format!("{:.4} {unit}", truth_m * factor),
            c.solution.clone(),
            format!("off by {} {unit}", text::plain(error * factor)),
            format!("{:.1} σ", error.abs() / c.sigma),
        ])
    };
    text::columns(&shown.filter_map(row).collect::<Vec<_>>())
}

#[cfg(test)]
mod tests {
    use super::*;
    use dragfree_engine::table::{Batch, Chunk, Column, TableSpec};
    use dragfree_engine::telemetry::{FileHeader, TelemetryWriter};

    #[test]
    fn the_first_message_is_read() {
        let names = ["b1_orf_m.x", "b1_orf_m.y", "b1_orf_m.z", "r1_orf_m.x"];
        let column = |name: &str| Column {
            table: "truth".into(),
            name: name.into(),
            unit: "m".into(),
            frame: "ORF_1".into(),
            rate_hz: 0.0,
            attributes: BTreeMap::new(),
        };
        let table = TableSpec { name: "truth".into(), rate_hz: 0.0, columns: names.map(column).into(), truth: true };
        let rows = Batch {
            time_ns: vec![1, 2],
            columns: vec![vec![0.09, 9.0], vec![0.15, 9.0], vec![-0.01, 9.0], vec![0.0, 9.0]],
        };
        let folder = tempfile::tempdir().expect("folder");
        let path = folder.path().join("truth.mcap");
        let header = FileHeader { time_scale: "UTC".into(), ..FileHeader::default() };
        let mut writer = TelemetryWriter::create(&path, &[table], &header).expect("create");
        writer.write(Chunk { batches: vec![rows], complete_until_ns: 3 }).expect("write");
        writer.finish().expect("finish");
        let truth = first(&path).expect("read");
        assert_eq!(offset(&truth, "com-offset.tm1.y"), Some(0.15));
        assert_eq!(offset(&truth, "com-offset.tm1.z"), Some(-0.01));
        assert_eq!(offset(&truth, "es-gain.tm1.y"), None);
    }

    #[test]
    fn errors_are_told_in_units_of_sigma() {
        let truth = BTreeMap::from([("b1_orf_m.x".to_owned(), 0.09), ("b2_orf_m.x".to_owned(), -0.09)]);
        let estimate = |name: &str, solution: &str, value: f64| Coefficient {
            name: name.into(),
            solution: solution.into(),
            value,
            sigma: 1e-4,
            unit: "m".into(),
            frame: "ORF_1".into(),
        };
        let estimates = [
            estimate("com-offset.tm1.x", "qp", 0.1),
            estimate("com-offset.tm1.x", "adopted", 0.0902),
            estimate("com-offset.tm2.y", "adopted", 0.1),
            estimate("es-gain.tm1.x", "adopted", 0.1),
        ];
        assert_eq!(table(&estimates, &truth), "com-offset.tm1.x  90.0000 mm  adopted  off by 0.2000 mm  2.0 σ\n");
        assert_eq!(table(&estimates[..1], &truth), "com-offset.tm1.x  90.0000 mm  qp  off by 10.0000 mm  100.0 σ\n");
    }
}
