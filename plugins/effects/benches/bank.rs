//! Cost of a day at 10 Hz through the plugin interface, in batches as the program makes them: the lags of a thermal
//! candidate over 25 temperatures, the resonances of the slosh candidate, and a formula beside the equivalent compiled
//! effect.

#[allow(dead_code, reason = "the benchmark uses part of the tests' harness")]
#[path = "../tests/environment/harness.rs"]
mod harness;

use criterion::{Criterion, criterion_group, criterion_main};
use harness::Telemetry;
use serde_json::{Value, json};
use std::hint::black_box;
use std::time::Instant;

const DAY: usize = 864_000;
const BATCH: usize = 4096;
const ROWS: usize = 16 * BATCH;

/// Time of the fastest of several runs over [`ROWS`] rows, s.
fn seconds(telemetry: &Telemetry, id: &str, parameters: &Value, candidate: bool) -> f64 {
    let instance = match id {
        "slosh" => "sc.x",
        "formula" => "mine",
        _ => "tm1.x",
    };
    let (mut effect, linked) =
        telemetry.link(id, instance, parameters.clone(), candidate).unwrap_or_else(|e| panic!("{id}: {e}"));
    let run = |_| {
        let start = Instant::now();
        for from in (0..ROWS).step_by(BATCH) {
            black_box(telemetry.process(&mut effect, &linked, from, from + BATCH));
        }
        start.elapsed().as_secs_f64()
    };
    (0..if candidate { 5 } else { 60 }).map(run).fold(f64::INFINITY, f64::min)
}

fn benches(c: &mut Criterion) {
    let names: Vec<String> = (0..25).map(|i| format!("hk.t{i}")).collect();
    let temperatures: Vec<(&str, &str)> = names.iter().map(|n| (n.as_str(), "K")).collect();
    let mut telemetry = Telemetry::new(ROWS, &temperatures);
    for (i, name) in names.iter().enumerate() {
        telemetry.fill(name, |t| 290.0 + (0.01 * (i + 1) as f64 * t).sin());
    }
    let compiled = json!({"plus": "hk.t1", "minus": "hk.t2", "lag_s": 480.0});
    let formula = |expression: &str| json!({"acts_on": "tm1.accel.x", "expression": expression, "unit": "1", "range": [-1.0, 1.0]});
    let equivalent = formula("lag(hk.t1, 480) - lag(hk.t2, 480)");
    let day = |seconds: f64| seconds * DAY as f64 / ROWS as f64;
    let bank = day(seconds(&telemetry, "thermal", &json!({}), true));
    let modes = day(seconds(&telemetry, "slosh", &json!({}), true));
    let one = day(seconds(&telemetry, "thermal", &compiled, false));
    let interpreted = day(seconds(&telemetry, "formula", &equivalent, false));
    let arithmetic = day(seconds(&telemetry, "formula", &formula("hk.t1 * hk.t2 + 3 * hk.t1 ^ 2"), false));
    #[allow(clippy::print_stdout)] // the ratio is the result of this benchmark
    {
        println!("a day of 25 temperatures behind 13 lags each: {bank:.2} s");
        println!("a day of the slosh candidate's resonances about one axis: {modes:.2} s");
        println!("a day of the compiled effect: {:.1} ms", 1e3 * one);
        println!("a day of the equivalent formula: {:.1} ms, ratio {:.2}", 1e3 * interpreted, interpreted / one);
        println!("a day of a formula without state: {:.1} ms", 1e3 * arithmetic);
    }
    for (name, id, parameters) in [("compiled", "thermal", &compiled), ("formula", "formula", &equivalent)] {
        let (mut effect, linked) = telemetry
            .link(id, if id == "formula" { "mine" } else { "tm1.x" }, parameters.clone(), false)
            .unwrap_or_else(|e| panic!("{id}: {e}"));
        c.bench_function(&format!("{name}, {BATCH} rows"), |b| {
            b.iter(|| black_box(telemetry.process(&mut effect, &linked, 0, BATCH)));
        });
    }
}

criterion_group!(all, benches);
criterion_main!(all);
