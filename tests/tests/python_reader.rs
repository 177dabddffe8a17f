//! Our files read by the Python packages `mcap` and `mcap-protobuf-support`, from the schema in the file alone. Skipped
//! with a message without Python or a package index.

#![allow(clippy::print_stdout, reason = "a skipped test says so")]

use dragfree_tests::foreign::{Container, Flight, Hidden, Loops, fly, write};
use dragfree_tests::{dragfree, fixture, root, simulate};
use serde_json::Value;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::OnceLock;

const PACKAGES: [&str; 3] = ["mcap==1.2.2", "mcap-protobuf-support==0.5.3", "protobuf>=5,<7"];

/// A Python with the packages; `None`, with a message, if unavailable.
fn python() -> Option<&'static Path> {
    static PYTHON: OnceLock<Option<PathBuf>> = OnceLock::new();
    let found = PYTHON.get_or_init(|| {
        let folder = dragfree_tests::built().join("python-readers");
        let python = folder.join("bin/python");
        let ready = |python: &Path| {
            let imports = "import mcap.reader, mcap_protobuf.decoder";
            Command::new(python).args(["-c", imports]).output().is_ok_and(|o| o.status.success())
        };
        if ready(&python) {
            return Some(python);
        }
        let made = Command::new("python3").args(["-m", "venv"]).arg(&folder).output();
        if !made.is_ok_and(|o| o.status.success()) {
            println!("skipped: no python3 with venv on this machine");
            return None;
        }
        let mut install = Command::new(&python);
        install.args(["-m", "pip", "install", "--quiet", "--disable-pip-version-check"]).args(PACKAGES);
        let output = install.output().expect("pip runs");
        if ready(&python) {
            return Some(python);
        }
        println!("skipped: pip cannot install {PACKAGES:?}: {}", String::from_utf8_lossy(&output.stderr));
        None
    });
    found.as_deref()
}

fn read(python: &Path, file: &Path) -> Value {
    let output = Command::new(python).arg(root().join("tests/python/read_mcap.py")).arg(file).output().expect("runs");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&output.stdout).expect("JSON")
}

fn assert_near(got: &Value, want: f64, what: &str) {
    let got = got.as_f64().unwrap_or_else(|| panic!("no {what}"));
    assert!((got - want).abs() <= 1e-12 * want.abs(), "{what}: {got} against {want}");
}

/// Our reader and the Python one find equal numbers in telemetry and time series.
#[test]
fn python_reads_what_we_write() {
    let Some(python) = python() else { return };
    let dir = tempfile::tempdir().expect("a temporary folder");
    let file = simulate(dir.path(), &["--hours", "0.5", "--seed", "5"]).remove(0);
    let telemetry = read(python, &file);
    assert_eq!(telemetry["metadata"]["dragfree"]["time_scale"], "UTC");
    assert_eq!(telemetry["metadata"]["dragfree"]["spacecraft"], "SC1");
    let topics = telemetry["topics"].as_object().expect("topics");
    for topic in ["/is", "/ifo", "/dws", "/command"] {
        assert_eq!(topics[topic]["count"], 18_000, "{topic}");
    }
    assert_eq!(topics["/ephemeris"]["count"], 30);
    assert!(!topics.contains_key("/truth"), "the truth lies apart");
    let hk: Vec<_> = topics.iter().filter(|(t, _)| t.starts_with("/hk/")).collect();
    assert!(!hk.is_empty());
    for (topic, found) in hk {
        for key in ["unit", "place", "rate_hz"] {
            assert!(found["metadata"][key].is_string(), "{topic} has no {key}");
        }
    }
    // The same sums by the mcap crate and a decoder of wire bytes in this file.
    let bytes = std::fs::read(&file).expect("readable");
    let sum: f64 = mcap::MessageStream::new(&bytes)
        .expect("MCAP")
        .map(|m| m.expect("sound"))
        .filter(|m| m.channel.topic == "/ifo")
        .map(|m| first_double(&m.data))
        .sum();
    assert_near(&topics["/ifo"]["sums"]["tm1.x_orf_m"], sum, "Σ ifo.tm1.x_orf_m");

    let mut run = dragfree(dir.path());
    run.arg("run").arg(fixture("pipelines/science-mode.toml")).arg(&file).args(["--archive", "archive", "--json"]);
    let output = run.output().expect("runs");
    assert!(matches!(output.status.code(), Some(0 | 4)), "{}", String::from_utf8_lossy(&output.stderr));
    let product: Value = serde_json::from_slice(&output.stdout).expect("JSON");
    let id = product["id"].as_str().expect("an id");
    let series = read(python, &dir.path().join("archive").join(format!("{id}.mcap")));
    let filter = &series["topics"]["/es-akf"];
    assert!(filter["count"].as_u64().expect("a count") >= 29, "one row a minute: {filter}");
    assert!(filter["sums"].as_object().expect("columns").len() >= 12, "six offsets with their σ: {filter}");
    let missing = filter["missing"].as_object().expect("columns");
    // NIS is counted after the filter's warm-up of ten minutes.
    let warming = |(name, n): (&String, &Value)| name.ends_with(".nis") && n.as_u64().is_some_and(|n| n <= 10);
    assert!(missing.iter().all(warming), "{filter}");

    // Half an hour in intervals of 1.875 s, nine channels with four numbers each; the layout names fields of this file.
    let residuals = &series["topics"]["/residuals"];
    assert!((900..=961).contains(&residuals["count"].as_u64().expect("a count")), "{residuals}");
    assert_eq!(residuals["sums"].as_object().map(serde_json::Map::len), Some(36), "{residuals}");
    let mut export = dragfree(dir.path());
    export.args(["products", "export", id, "--format", "foxglove", "--archive", "archive"]);
    let layout: Value = serde_json::from_slice(&export.output().expect("runs").stdout).expect("JSON");
    let panels = layout["configById"].as_object().expect("panels");
    for path in panels.values().filter_map(|panel| panel["paths"].as_array()).flatten() {
        let path = path["value"].as_str().expect("a path");
        let (topic, field) = path.split_once('.').expect("a topic and a field");
        assert!(series["topics"][topic]["sums"].get(field).is_some(), "{path} is not in the file");
    }
}

/// The first double of `Interferometers`: tm1 { x_orf_m }, wire bytes `0a LEN 09 …`.
fn first_double(data: &[u8]) -> f64 {
    assert_eq!((data[0], data[2]), (0x0a, 0x09), "tm1.x_orf_m is the first field");
    f64::from_le_bytes(data[3..11].try_into().expect("eight bytes"))
}

/// The other producer's file is readable by others.
#[test]
fn python_reads_the_other_producer() {
    let Some(python) = python() else { return };
    let dir = tempfile::tempdir().expect("a temporary folder");
    let flight = Flight {
        seconds: 600.0,
        seed: 3,
        shift_srf_m: [0.0; 3],
        thrust_n: 1e-7,
        torque_nm: 1e-7,
        ifo_m: 1e-12,
        is_m: 1e-9,
        dws_rad: 1e-9,
        sunlight_n: 0.0,
        loops: Loops { attitude: 0.4, x: 0.4, y: 0.2, z: 0.2 },
        hidden: Hidden::default(),
    };
    let records = fly(&flight);
    for (chunks, zstd, summary) in [(true, true, true), (true, false, false), (false, false, true)] {
        let file = dir.path().join("foreign.mcap");
        let container = Container { chunks, zstd, summary, command: true, ephemeris: true };
        write(&file, &records, 2_056_850_400_034_567_890, container);
        let found = read(python, &file);
        assert_eq!(found["topics"]["/is"]["count"], 6_000, "{container:?}");
        assert_near(
            &found["topics"]["/is"]["sums"]["tm2.r_orf_m.z"],
            records.iter().map(|r| r.is_r_m[1][2]).sum(),
            "Σ is.tm2.r_orf_m.z",
        );
        assert_near(
            &found["topics"]["/command"]["sums"]["mps_force_srf_n.x"],
            records.iter().map(|r| r.force_n[0]).sum(),
            "Σ command.mps_force_srf_n.x",
        );
    }
}
