//! The telemetry of the corpus: 20 epochs of every table, stored in four ways.
//! `DRAGFREE_WRITE_CORPUS=1 cargo test --release -p dragfree-fuzz --test corpus` writes it.

use dragfree_engine::replay::Replay;
use dragfree_engine::table::{Batch, Chunk, Column, TableSpec};
use dragfree_engine::telemetry::{FileHeader, TelemetryWriter, interface_tables};
use std::collections::BTreeMap;
use std::io::Cursor;
use std::path::{Path, PathBuf};

const EPOCHS: usize = 20;
/// 2035-01-01T00:00:00Z, Unix ns.
const START_NS: i64 = 2_051_222_400_000_000_000;

/// A file of the simulator's own writer.
fn written(path: &Path) -> Vec<u8> {
    let tables = interface_tables();
    let header = FileHeader {
        time_scale: "UTC".to_owned(),
        mission: "Taiji".to_owned(),
        spacecraft: "SC1".to_owned(),
        producer: "fuzz".to_owned(),
        version: "1".to_owned(),
        extra: BTreeMap::new(),
    };
    let mut writer = TelemetryWriter::create(path, &tables, &header).expect("writable");
    let time_ns: Vec<i64> = (0..EPOCHS).map(|k| START_NS + 100_000_000 * k as i64).collect();
    let value = |column: usize, row: usize| 1e-9 * (column * EPOCHS + row) as f64;
    let column = |(number, column): (usize, &Column)| -> Vec<f64> {
        let status = column.name.ends_with("status");
        (0..EPOCHS).map(|row| if status { 0.0 } else { value(number, row) }).collect()
    };
    let batch = |table: &TableSpec| Batch {
        time_ns: time_ns.clone(),
        columns: table.columns.iter().enumerate().map(column).collect(),
    };
    let batches = tables.iter().map(batch).collect();
    writer.write(Chunk { batches, complete_until_ns: i64::MAX }).expect("written");
    writer.finish().expect("whole");
    std::fs::read(path).expect("readable")
}

/// The same messages by another writer.
fn rewritten(bytes: &[u8], options: mcap::WriteOptions) -> Vec<u8> {
    let mut writer = options.profile("").create(Cursor::new(Vec::new())).expect("a writer");
    let metadata = [("time_scale", "UTC"), ("mission", "Taiji"), ("spacecraft", "SC1")];
    let metadata = metadata.map(|(k, v)| (k.to_owned(), v.to_owned())).into();
    writer.write_metadata(&mcap::records::Metadata { name: "dragfree".to_owned(), metadata }).expect("written");
    for message in mcap::MessageStream::new(bytes).expect("an MCAP file") {
        writer.write(&message.expect("a sound message")).expect("written");
    }
    writer.finish().expect("whole");
    writer.into_inner().into_inner()
}

#[test]
fn the_telemetry_of_the_corpus_is_read_whole() {
    let corpus = Path::new(env!("CARGO_MANIFEST_DIR")).join("corpus/telemetry");
    let scratch = tempfile::tempdir().expect("a temporary folder");
    let own = written(&scratch.path().join("own.mcap"));
    let options = || mcap::WriteOptions::new().compression_threads(0).chunk_size(Some(4000));
    let files = [
        ("zstd.mcap", own.clone()),
        ("lz4.mcap", rewritten(&own, options().compression(Some(mcap::Compression::Lz4)))),
        ("plain.mcap", rewritten(&own, options().compression(None))),
        ("loose.mcap", rewritten(&own, options().use_chunks(false))),
    ];
    if std::env::var_os("DRAGFREE_WRITE_CORPUS").is_some() {
        std::fs::create_dir_all(&corpus).expect("writable");
        files.iter().for_each(|(name, bytes)| std::fs::write(corpus.join(name), bytes).expect("writable"));
    }
    let paths: Vec<PathBuf> = files.iter().map(|(name, _)| corpus.join(name)).collect();
    for path in paths {
        let mut replay = Replay::open(std::slice::from_ref(&path), None, 1).expect("telemetry");
        let mut rows = 0;
        while let Some(chunk) = replay.next().expect("sound") {
            rows += chunk.batches.iter().map(Batch::rows).sum::<usize>();
        }
        replay.digests().expect("readable");
        assert_eq!(rows, EPOCHS * interface_tables().len(), "{}", path.display());
        assert!(!replay.losses().data_loss(), "{}: {:?}", path.display(), replay.losses());
        assert!(std::fs::metadata(&path).expect("there").len() < 100_000, "small enough to change well");
    }
}
