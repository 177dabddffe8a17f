//! Fuzz targets as plain functions: whatever the bytes, no panic, no endless loop, no unbounded memory.

use std::path::PathBuf;
use std::sync::Arc;

use super::Replay;
use super::scan::Source;
use crate::telemetry::{Cells, Decoder, Layout, check, expected};

/// A schema from outside.
pub fn fuzz_schema(bytes: &[u8]) {
    if let Ok(layout) = Layout::parse(bytes, "dragfree.telemetry.v1.Dws") {
        let _ = check("/dws", &layout);
        let mut values = vec![f64::NAN; layout.leaves().len()];
        let _ = Decoder::new(&layout).decode(bytes, &mut Cells { values: &mut values, rows: 1, row: 0 });
    }
}

/// A message from outside, against every message of the interface.
pub fn fuzz_message(bytes: &[u8]) {
    for layout in ["/is", "/ifo", "/dws", "/command", "/ephemeris", "/hk/x", "/truth"].into_iter().filter_map(expected)
    {
        let mut values = vec![f64::NAN; layout.leaves().len()];
        let _ = Decoder::new(layout).decode(bytes, &mut Cells { values: &mut values, rows: 1, row: 0 });
    }
}

/// A file from outside. Returns how many rows it gave.
pub fn fuzz_file(bytes: &[u8]) -> usize {
    let source = Source::Memory(PathBuf::from("fuzz.mcap"), Arc::from(bytes));
    let Ok(mut replay) = Replay::from_sources(vec![source], None, 1) else { return 0 };
    let mut rows = 0;
    while let Ok(Some(chunk)) = replay.next() {
        rows += chunk.batches.iter().map(crate::table::Batch::rows).sum::<usize>();
    }
    rows
}
