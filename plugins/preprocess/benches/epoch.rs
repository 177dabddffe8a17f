//! Cost of 61 columns through the stage and the plugin interface: ten minutes in two batches, 6,000 epochs an
//! iteration.

#[path = "../tests/common/mod.rs"]
mod common;

use common::{START_NS, columns, library, link, process, telemetry, topics};
use criterion::{BatchSize, Criterion, Throughput, criterion_group, criterion_main};

const MINUTE_NS: i64 = 60_000_000_000;

fn epoch(c: &mut Criterion) {
    let (library, topics) = (library(), topics());
    let (available, data) = (columns(&topics), telemetry(&topics, 2_400));
    let mut group = c.benchmark_group("preprocess");
    group.throughput(Throughput::Elements(6_000));
    group.bench_function("61 columns", |b| {
        b.iter_batched_ref(
            || {
                let (mut stage, linked) = link(&library, &available).unwrap();
                process(&mut stage, &linked, &topics, &data, START_NS, START_NS + 20 * MINUTE_NS);
                (stage, linked)
            },
            |(stage, linked)| {
                for part in 0..2 {
                    let from_ns = START_NS + (20 + 5 * part) * MINUTE_NS;
                    process(stage, linked, &topics, &data, from_ns, from_ns + 5 * MINUTE_NS);
                }
            },
            BatchSize::LargeInput,
        );
    });
    group.finish();
}

criterion_group!(benches, epoch);
criterion_main!(benches);
