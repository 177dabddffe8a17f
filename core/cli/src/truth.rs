//! The truth of a simulation, for what compares with it afterwards: no calibration reads it.

use crate::failure::Failure;
use dragfree_engine::telemetry::first_message;
use std::collections::BTreeMap;
use std::path::Path;

/// The first message of `/truth` in a file, by field path, `b1_orf_m.x`.
pub(crate) fn first(path: &Path) -> Result<BTreeMap<String, f64>, Failure> {
    Ok(first_message(path, "/truth")?)
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
        let offset = |coefficient| dragfree_score::offset(&truth, coefficient);
        assert_eq!(offset("com-offset.tm1.y"), Some(0.15));
        assert_eq!(offset("com-offset.tm1.z"), Some(-0.01));
        assert_eq!(offset("es-gain.tm1.y"), None);
    }
}
