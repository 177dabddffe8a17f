//! What the border costs: one `process` call of a plugin that does next to nothing, per call and per row.
//!
//! Needs the example plugin: `cargo build --release -p dragfree-sdk --example clumsy`.
#![allow(missing_docs, reason = "criterion's macros make undocumented functions")]

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use dragfree_engine::border::{Config, Instance, Kind, LinkRequest, Rows};
use dragfree_engine::registry::Registry;
use dragfree_engine::table::Column;
use std::collections::BTreeMap;

fn counting_stage() -> Instance {
    let exe = std::env::current_exe().expect("a path");
    let examples = exe.parent().and_then(|p| p.parent()).expect("target/release/deps").join("examples");
    // A folder of its own: cargo leaves earlier builds beside the newest one.
    let folder = tempfile::tempdir().expect("a temporary folder");
    let library = format!("{}clumsy{}", std::env::consts::DLL_PREFIX, std::env::consts::DLL_SUFFIX);
    std::fs::copy(examples.join(&library), folder.path().join(&library))
        .expect("cargo build --release -p dragfree-sdk --example clumsy");
    let registry = Registry::discover(&[folder.path().to_owned()]);
    let found = registry.find(Kind::Stage, "clumsy").expect("the example plugin");
    let config = Config { value: serde_json::json!({ "parameters": { "panic_in": "nowhere" }, "mission": {} }) };
    let mut instance = found.create(&config).expect("an instance");
    let y = Column {
        table: "grid".to_owned(),
        name: "is.tm1.r_orf_m.y".to_owned(),
        unit: "m".to_owned(),
        frame: "ORF_1".to_owned(),
        rate_hz: 10.0,
        attributes: BTreeMap::new(),
    };
    instance.link(LinkRequest { available: &[y], model_json: "{}" }).expect("linked");
    instance.activate(65_536).expect("active");
    instance
}

fn plugin_call(c: &mut Criterion) {
    let mut instance = counting_stage();
    let mut group = c.benchmark_group("plugin call");
    for rows in [1usize, 100, 4096] {
        let (times, values) = ((0..rows as i64).collect::<Vec<_>>(), vec![1e-9; rows]);
        group.throughput(Throughput::Elements(rows as u64));
        group.bench_function(format!("{rows} rows"), |b| {
            b.iter(|| {
                let table = Rows { time_ns: &times, columns: vec![&values] };
                instance.process(&[table], rows as i64).expect("done")
            });
        });
    }
    group.finish();
}

criterion_group!(benches, plugin_call);
criterion_main!(benches);
