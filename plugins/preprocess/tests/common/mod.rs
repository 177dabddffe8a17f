//! The stage through the plugin interface, with the topics of telemetry.proto.
#![allow(dead_code, reason = "each test program uses a part of it")]

use dragfree_engine::border::{Config, Instance, Kind, Library, LinkRequest, Linked, Rows};
use dragfree_engine::table::{Batch, Column};
use serde_json::{Value, json};
use std::path::Path;

pub(crate) const START_NS: i64 = 2_051_222_400_000_000_000;

/// The library beside the test's program is the one of this test run; that in the folder above may be older.
pub(crate) fn library() -> Library {
    let folder = std::env::current_exe().unwrap().parent().unwrap().to_owned();
    let name = format!("{}dragfree_preprocess{}", std::env::consts::DLL_PREFIX, std::env::consts::DLL_SUFFIX);
    Library::open(&folder.join(name)).unwrap()
}

/// Mission of the paper, default parameters.
pub(crate) fn config() -> Config {
    let fixtures = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../fixtures/missions/taiji.toml");
    let mission: Value = toml::from_str(&std::fs::read_to_string(fixtures).unwrap()).unwrap();
    let parameters = json!({
        "mandatory": ["is", "dws"], "outlier_sigma": 20.0, "stuck_samples": 10, "hold_intervals": 2.0, "max_gap_s": 21600.0
    });
    Config { value: json!({ "parameters": parameters, "mission": mission, "instance": "", "files": [] }) }
}

pub(crate) fn create(library: &Library, config: &Config) -> Result<Instance, String> {
    let plugin = library.plugins.iter().find(|p| p.kind == Kind::Stage && p.manifest.id == "preprocess").unwrap();
    Instance::create(library, plugin, config).map_err(|e| e.to_string())
}

/// A topic: name, interval in ns, columns with unit and frame.
pub(crate) struct Topic {
    pub(crate) name: &'static str,
    pub(crate) interval_ns: i64,
    pub(crate) columns: Vec<(String, &'static str, &'static str)>,
}

/// The topics of telemetry.proto with two of housekeeping, 61 columns.
pub(crate) fn topics() -> Vec<Topic> {
    let topic = |name, interval_ns| Topic { name, interval_ns, columns: Vec::new() };
    let vector = |topic: &mut Topic, stem: &str, parts: [&str; 3], unit: &'static str, frame: &'static str| {
        topic.columns.extend(parts.map(|part| (format!("{stem}.{part}"), unit, frame)));
    };
    let (xyz, angles) = (["x", "y", "z"], ["phi", "theta", "psi"]);
    let (mut is, mut ifo, mut dws) = (topic("is", 100_000_000), topic("ifo", 100_000_000), topic("dws", 100_000_000));
    let (mut command, mut ephemeris) = (topic("command", 100_000_000), topic("ephemeris", 60_000_000_000));
    vector(&mut command, "mps_force_srf_n", xyz, "N", "SRF");
    vector(&mut command, "mps_torque_srf_nm", xyz, "N m", "SRF");
    for (tm, orf) in [("tm1", "ORF_1"), ("tm2", "ORF_2")] {
        vector(&mut is, &format!("{tm}.r_orf_m"), xyz, "m", orf);
        vector(&mut is, &format!("{tm}.att_orf_rad"), angles, "rad", orf);
        is.columns.push((format!("{tm}.status"), "", ""));
        ifo.columns.push((format!("{tm}.x_orf_m"), "m", orf));
        ifo.columns.push((format!("{tm}.status"), "", ""));
        dws.columns.extend(["theta", "psi"].map(|angle| (format!("{tm}.{angle}_orf_rad"), "rad", orf)));
        vector(&mut command, &format!("{tm}.force_orf_n"), xyz, "N", orf);
        vector(&mut command, &format!("{tm}.torque_orf_nm"), xyz, "N m", orf);
    }
    vector(&mut dws, "sc_crf_rad", angles, "rad", "CRF");
    dws.columns.push(("status".to_owned(), "", ""));
    vector(&mut ephemeris, "r_sc_irf_m", xyz, "m", "IRF");
    vector(&mut ephemeris, "v_sc_irf_m_s", xyz, "m s-1", "IRF");
    vector(&mut ephemeris, "omega_crf_rad_s", xyz, "rad s-1", "CRF");
    vector(&mut ephemeris, "alpha_crf_rad_s2", xyz, "rad s-2", "CRF");
    vector(&mut ephemeris, "sun_srf", xyz, "1", "SRF");
    let (mut current, mut field) = (topic("hk/battery_current_a", 1_000_000_000), topic("hk/field", 10_000_000_000));
    current.columns.push(("value".to_owned(), "A", ""));
    field.columns.push(("value".to_owned(), "T", ""));
    vec![is, ifo, dws, command, ephemeris, current, field]
}

pub(crate) fn columns(topics: &[Topic]) -> Vec<Column> {
    let of = |t: &Topic| -> Vec<Column> {
        let column = |(name, unit, frame): &(String, &str, &str)| Column {
            table: t.name.to_owned(),
            name: name.clone(),
            unit: (*unit).to_owned(),
            frame: (*frame).to_owned(),
            rate_hz: 0.0,
            attributes: [("place".to_owned(), "bus".to_owned()), ("rate_hz".to_owned(), "0.1".to_owned())]
                .into_iter()
                .filter(|_| t.name == "hk/field")
                .collect(),
        };
        t.columns.iter().map(column).collect()
    };
    topics.iter().flat_map(of).collect()
}

/// Telemetry of `seconds`: values of 1e-9 that never repeat, status columns zero.
pub(crate) fn telemetry(topics: &[Topic], seconds: i64) -> Vec<Batch> {
    let mut word = 7_u64;
    let mut value = move || {
        word = word.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        ((word >> 11) as f64 / (1_u64 << 53) as f64 - 0.5) * 1e-9
    };
    let batch = |t: &Topic| {
        let time_ns: Vec<i64> =
            (0..seconds * 1_000_000_000 / t.interval_ns).map(|k| START_NS + k * t.interval_ns).collect();
        let mut column = |(name, ..): &(String, &str, &str)| -> Vec<f64> {
            time_ns.iter().map(|_| if name.ends_with("status") { 0.0 } else { value() }).collect()
        };
        let columns = t.columns.iter().map(&mut column).collect();
        Batch { time_ns: time_ns.clone(), columns }
    };
    topics.iter().map(batch).collect()
}

pub(crate) fn link(library: &Library, available: &[Column]) -> Result<(Instance, Linked), String> {
    let mut stage = create(library, &config())?;
    let linked = stage.link(LinkRequest { available, model_json: "{}" }).map_err(|e| e.to_string())?;
    stage.activate(65_536).map_err(|e| e.to_string())?;
    Ok((stage, linked))
}

/// Processes rows from `from_ns` to `to_ns` and returns the stage's table.
pub(crate) fn process(
    stage: &mut Instance,
    linked: &Linked,
    topics: &[Topic],
    data: &[Batch],
    from_ns: i64,
    to_ns: i64,
) -> Batch {
    let owner: Vec<(usize, usize)> =
        topics.iter().enumerate().flat_map(|(t, topic)| (0..topic.columns.len()).map(move |c| (t, c))).collect();
    let rows: Vec<Rows<'_>> = linked
        .reads
        .iter()
        .map(|columns| {
            let batch = &data[owner[columns[0].available].0];
            let range = batch.time_ns.partition_point(|t| *t < from_ns)..batch.time_ns.partition_point(|t| *t < to_ns);
            let column = |c: &dragfree_engine::border::ReadColumn| {
                let (t, c) = owner[c.available];
                &data[t].columns[c][range.clone()]
            };
            Rows { time_ns: &batch.time_ns[range.clone()], columns: columns.iter().map(column).collect() }
        })
        .collect();
    stage.process(&rows, to_ns).unwrap().unwrap().remove(0)
}

pub(crate) fn append(all: &mut Batch, part: Batch) {
    all.time_ns.extend(part.time_ns);
    for (whole, part) in all.columns.iter_mut().zip(part.columns) {
        whole.extend(part);
    }
}
