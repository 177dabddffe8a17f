//! From wire to columns: one packet, one epoch of four packets, and ten minutes of 10 Hz telemetry from a file.

use std::hint::black_box;
use std::path::{Path, PathBuf};

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use dragfree_engine::replay::Replay;
use dragfree_engine::table::{Batch, Chunk, TableSpec};
use dragfree_engine::telemetry::{
    Cells, Decoder, Encoder, FileHeader, MessageType, TelemetryWriter, expected, interface_tables,
};

const TOPICS: [&str; 4] = ["is", "ifo", "dws", "command"];
/// Ten minutes at 10 Hz.
const EPOCHS: usize = 6000;
/// 2035-01-01, Unix ns.
const START_NS: i64 = 2_051_222_400_000_000_000;

fn table(name: &str) -> TableSpec {
    interface_tables().into_iter().find(|t| t.name == name).expect("a topic of the interface")
}

/// Values with all their bits in use, like noise, from a multiplicative generator; statuses are 0.
fn batch(table: &TableSpec) -> Batch {
    let mut state = 1_u64;
    let mut noise = || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 11) as f64 * 1e-25
    };
    let columns = table.columns.iter().map(|c| match c.name.ends_with("status") {
        true => vec![0.0; EPOCHS],
        false => (0..EPOCHS).map(|_| noise()).collect(),
    });
    Batch { time_ns: (0..EPOCHS as i64).map(|k| START_NS + k * 100_000_000).collect(), columns: columns.collect() }
}

fn decode(c: &mut Criterion) {
    let mut group = c.benchmark_group("decode");
    let mut epoch = vec![];
    for name in TOPICS {
        let table = table(name);
        let batch = batch(&table);
        let mut message = vec![];
        Encoder::new(MessageType::of(&table).expect("a message")).encode(&batch, 0, &mut message).expect("finite");
        let layout = expected(&format!("/{name}")).expect("a topic of the interface");
        let decoder = Decoder::new(layout);
        epoch.push((message, decoder, vec![f64::NAN; layout.leaves().len()]));
    }
    group.bench_function("epoch of 4 packets", |b| {
        b.iter(|| {
            for (message, decoder, values) in &mut epoch {
                let mut cells = Cells { values, rows: 1, row: 0 };
                black_box(decoder.decode(black_box(message), &mut cells)).expect("sound");
            }
        });
    });
    group.finish();
}

fn write(path: &Path) {
    let tables = TOPICS.map(table);
    let batches = tables.iter().map(batch).collect();
    let header = FileHeader { time_scale: "TAI".to_owned(), ..FileHeader::default() };
    let mut writer = TelemetryWriter::create(path, &tables, &header).expect("a file");
    writer.write(Chunk { batches, complete_until_ns: i64::MAX }).expect("sound rows");
    writer.finish().expect("a file");
}

fn replay(path: &Path, threads: usize) -> usize {
    let mut replay = Replay::open(&[PathBuf::from(path)], None, threads).expect("a sound file");
    let mut rows = 0;
    while let Some(chunk) = replay.next().expect("a sound file") {
        rows += chunk.batches.iter().map(Batch::rows).sum::<usize>();
    }
    rows
}

/// 600 s divided by the time of one iteration is the ratio to real time.
fn file(c: &mut Criterion) {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("ten-minutes.mcap");
    write(&path);
    let mut group = c.benchmark_group("ten minutes");
    group.throughput(Throughput::Elements(EPOCHS as u64)).sample_size(30);
    for threads in [1, 2] {
        group.bench_function(format!("replay, {threads} threads"), |b| {
            b.iter(|| assert_eq!(replay(&path, threads), EPOCHS * TOPICS.len()));
        });
    }
    group.bench_function("write", |b| b.iter(|| write(&path)));
    group.finish();
}

criterion_group!(benches, decode, file);
criterion_main!(benches);
