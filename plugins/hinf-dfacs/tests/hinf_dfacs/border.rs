//! The stage across the border, as the engine drives it.

use crate::common::{AttitudeLoop, levels, mission};
use dragfree_engine::border::{Config, Instance, Kind, Library, LinkRequest, Rows};
use dragfree_engine::chain::{Carry, build};
use dragfree_engine::config::{Mission, Model, Pipeline};
use dragfree_engine::registry::Registry;
use dragfree_engine::table::{Batch, Column, TableSpec};
use dragfree_sdk::prelude::{PREDICTION_NEED, UNPREDICTED_ATTRIBUTE};
use nalgebra::Vector3;
use rand::SeedableRng;
use rand_distr::{Distribution, StandardNormal};
use rand_xoshiro::Xoshiro256PlusPlus;
use serde_json::{Value, json};
use std::path::{Path, PathBuf};

/// Fields of the interface that the stage may read: prefix, leaves, unit, frame.
const INTERFACE: [(&str, &[&str], &str, &str); 18] = [
    ("dws.sc_crf_rad.", &["phi", "theta", "psi"], "rad", "CRF"),
    ("ifo.tm1.", &["x_orf_m"], "m", "ORF_1"),
    ("ifo.tm2.", &["x_orf_m"], "m", "ORF_2"),
    ("is.tm1.r_orf_m.", &["x", "y", "z"], "m", "ORF_1"),
    ("is.tm2.r_orf_m.", &["x", "y", "z"], "m", "ORF_2"),
    ("is.tm1.att_orf_rad.", &["phi", "theta", "psi"], "rad", "ORF_1"),
    ("is.tm2.att_orf_rad.", &["phi", "theta", "psi"], "rad", "ORF_2"),
    ("dws.tm1.", &["theta_orf_rad", "psi_orf_rad"], "rad", "ORF_1"),
    ("dws.tm2.", &["theta_orf_rad", "psi_orf_rad"], "rad", "ORF_2"),
    ("command.mps_force_srf_n.", &["x", "y", "z"], "N", "SRF"),
    ("command.mps_torque_srf_nm.", &["x", "y", "z"], "N m", "SRF"),
    ("command.tm1.force_orf_n.", &["x", "y", "z"], "N", "ORF_1"),
    ("command.tm1.torque_orf_nm.", &["x", "y", "z"], "N m", "ORF_1"),
    ("command.tm2.force_orf_n.", &["x", "y", "z"], "N", "ORF_2"),
    ("command.tm2.torque_orf_nm.", &["x", "y", "z"], "N m", "ORF_2"),
    ("ephemeris.omega_crf_rad_s.", &["x", "y", "z"], "rad s-1", "CRF"),
    ("ephemeris.alpha_crf_rad_s2.", &["x", "y", "z"], "rad s-2", "CRF"),
    ("ephemeris.sun_srf.", &["x", "y", "z"], "1", "SRF"),
];

/// A `grid` table: columns and rows.
struct Grid {
    columns: Vec<Column>,
    rows: Batch,
}

impl Grid {
    /// The attitude loop under noise; every other readout zero, the Sun ahead, CRF at rest.
    fn of_the_loop(epochs: usize) -> Self {
        let mission = mission();
        let [torque, sensing] = levels(&mission).map(|psd| (5.0 * psd).sqrt());
        let mut random = Xoshiro256PlusPlus::seed_from_u64(23);
        let mut gauss =
            |sigma: f64| Vector3::from_fn(|_, _| sigma * Distribution::<f64>::sample(&StandardNormal, &mut random));
        let mut columns = Vec::new();
        for (prefix, leaves, unit, frame) in INTERFACE {
            columns.extend(leaves.iter().map(|leaf| Column {
                table: "grid".to_owned(),
                name: format!("{prefix}{leaf}"),
                unit: unit.to_owned(),
                frame: frame.to_owned(),
                rate_hz: 10.0,
                attributes: std::collections::BTreeMap::new(),
            }));
        }
        let mut rows = Batch::empty(columns.len());
        let mut body = AttitudeLoop::new(&mission);
        for _ in 0..epochs {
            let (epoch, _) = body.step(&gauss(torque), &gauss(sensing));
            rows.time_ns.push(epoch.time_ns);
            for (column, values) in columns.iter().zip(&mut rows.columns) {
                values.push(0.0);
                if let (Some(value), Some(leaf)) = (values.last_mut(), column.name.strip_prefix("dws.sc_crf_rad.")) {
                    *value = epoch.readout[["phi", "theta", "psi"].iter().position(|l| *l == leaf).expect("an angle")];
                }
            }
            let first = columns.iter().position(|c| c.name.starts_with("command.")).expect("commands");
            for (values, command) in rows.columns[first..].iter_mut().zip(epoch.command.iter().copied()) {
                *values.last_mut().expect("a row") = command;
            }
        }
        let sun = columns.iter().position(|c| c.name == "ephemeris.sun_srf.x").expect("the Sun");
        rows.columns[sun].fill(1.0);
        Self { columns, rows }
    }

    fn without(mut self, prefix: &str) -> Self {
        let keep: Vec<bool> = self.columns.iter().map(|c| !c.name.starts_with(prefix)).collect();
        let mut kept = keep.iter();
        self.columns.retain(|_| *kept.next().expect("one per column"));
        let mut kept = keep.iter();
        self.rows.columns.retain(|_| *kept.next().expect("one per column"));
        self
    }
}

/// The shared library that cargo built for this test lies beside its program; the one a folder up is that of the last
/// `cargo build` and may be stale.
fn library() -> Library {
    Library::open(&library_path()).expect("cargo builds the library before its tests")
}

fn library_path() -> PathBuf {
    let program = std::env::current_exe().expect("a test program has a path");
    let folder = program.parent().expect("target/PROFILE/deps/test");
    let name = format!("{}dragfree_hinf_dfacs{}", std::env::consts::DLL_PREFIX, std::env::consts::DLL_SUFFIX);
    folder.join(name)
}

fn create(library: &Library, parameters: &Value, needs: &[&str]) -> Instance {
    create_for(&taiji(), library, parameters, needs)
}

fn taiji() -> Value {
    toml::from_str(include_str!("../../../../fixtures/missions/taiji.toml")).expect("TOML")
}

fn create_for(mission: &Value, library: &Library, parameters: &Value, needs: &[&str]) -> Instance {
    let mut all =
        json!({"angular_acceleration": "smoother", "compare_commands": true, "measure_noise": true, "warm_up_s": 60.0});
    for (key, value) in parameters.as_object().expect("an object") {
        all[key] = value.clone();
    }
    let value = json!({"parameters": all, "mission": mission, "instance": "", "files": [], "needs": needs});
    let plugin = library.plugins.iter().find(|p| p.kind == Kind::Stage).expect("the library has a stage");
    Instance::create(library, plugin, &Config { value }).expect("the fixture is a mission")
}

struct Output {
    columns: Vec<Column>,
    rows: Batch,
    report: Value,
}

fn run(grid: &Grid, parameters: &Value, batch_rows: usize) -> Output {
    run_asked(grid, parameters, batch_rows, &[])
}

fn run_asked(grid: &Grid, parameters: &Value, batch_rows: usize, needs: &[&str]) -> Output {
    let library = library();
    let mut stage = create(&library, parameters, needs);
    let linked = stage.link(LinkRequest { available: &grid.columns, model_json: "{}" }).expect("linked");
    stage.activate(65_536).expect("active");
    let [reads] = &linked.reads[..] else { panic!("one table is read") };
    let [table] = &linked.writes[..] else { panic!("one table is written") };
    assert_eq!((table.name.as_str(), table.rate_hz), ("reconstruction", 10.0));
    let mut rows = Batch::empty(table.columns.len());
    let mut append = |batches: Vec<Batch>| {
        for batch in batches {
            rows.time_ns.extend(batch.time_ns);
            for (whole, part) in rows.columns.iter_mut().zip(batch.columns) {
                whole.extend(part);
            }
        }
    };
    let n = grid.rows.rows();
    for start in (0..n).step_by(batch_rows) {
        let range = start..n.min(start + batch_rows);
        let input = Rows {
            time_ns: &grid.rows.time_ns[range.clone()],
            columns: reads.iter().map(|r| &grid.rows.columns[r.available][range.clone()]).collect(),
        };
        append(stage.process(&[input], i64::MAX).expect("processed").expect("nothing is discarded"));
    }
    append(stage.flush().expect("flushed"));
    let report = serde_json::to_value(stage.report("[]").expect("a report")).expect("JSON");
    Output { columns: table.columns.clone(), rows, report }
}

fn link_refusal(grid: &Grid, parameters: &Value, needs: &[&str]) -> String {
    let library = library();
    let mut stage = create(&library, parameters, needs);
    stage.link(LinkRequest { available: &grid.columns, model_json: "{}" }).expect_err("it must refuse").to_string()
}

fn notes(report: &Value) -> String {
    report["notes"].to_string()
}

#[test]
fn the_table_is_the_contract_s() {
    let grid = Grid::of_the_loop(3000);
    let Output { columns, rows, report } = run(&grid, &json!({}), 4096);
    let of = |name: &str| columns.iter().find(|c| c.name == name).unwrap_or_else(|| panic!("no {name}"));
    for (name, unit, frame) in [
        ("sc.alpha_srf_rad_s2", "rad s-2", "SRF"),
        ("sc.omega_srf_rad_s", "rad s-1", "SRF"),
        ("tm1.r_orf_m", "m", "ORF_1"),
        ("tm2.u_orf_m_s2", "m s-2", "ORF_2"),
        ("tm1.accel", "m s-2", "ORF_1"),
        ("tm2.accel", "m s-2", "ORF_2"),
        ("sc.alpha", "rad s-2", "SRF"),
    ] {
        for axis in ["x", "y", "z"] {
            let name = format!("{name}.{axis}");
            let column = of(&name);
            assert_eq!((column.unit.as_str(), column.frame.as_str(), column.rate_hz), (unit, frame, 10.0));
            let channel = name.contains(".accel.") || name.starts_with("sc.alpha.");
            assert_eq!(column.attributes.get("kind").is_some_and(|k| k == "channel"), channel, "{name}");
            if channel {
                assert_eq!(
                    (column.attributes["channel"].as_str(), column.attributes["average"].as_str()),
                    (&*name, "2")
                );
            }
        }
    }
    assert_eq!(columns.len(), 27);
    assert_eq!(of("tm1.accel.x").attributes["noise"], "ifo_x");
    assert_eq!(rows.time_ns, grid.rows.time_ns);
    assert_eq!(report["commands"], "telemetered");
    assert_eq!(report["counts"]["commands_telemetered"], 3000);
    let ratio = report["quality"]["attitude_innovation_ratio"][0].as_f64().expect("a number");
    // 3000 squares have a mean within 2.6 % of one at one standard deviation; five are allowed.
    assert!((ratio - 1.0).abs() < 0.13, "{ratio}");
}

#[test]
fn batches_cannot_be_seen() {
    let grid = Grid::of_the_loop(3000);
    let bits = |o: &Output| -> Vec<u64> { o.rows.columns.iter().flatten().map(|v| v.to_bits()).collect() };
    let whole = run(&grid, &json!({}), 65_536);
    for batch in [1, 777] {
        let other = run(&grid, &json!({}), batch);
        assert!(bits(&other) == bits(&whole) && other.rows.time_ns == whole.rows.time_ns, "batches of {batch}");
        assert_eq!(other.report, whole.report);
    }
}

#[test]
fn it_does_without_what_can_be_missing() {
    let full = run(&Grid::of_the_loop(3000), &json!({}), 4096);
    assert!(!notes(&full.report).contains("interferometer"));

    let is_x = run(&Grid::of_the_loop(3000).without("ifo.tm2"), &json!({}), 4096);
    assert!(notes(&is_x.report).contains("no interferometer for tm2"), "{}", notes(&is_x.report));
    let noise =
        |name: &str| is_x.columns.iter().find(|c| c.name == name).expect("a channel").attributes["noise"].clone();
    assert_eq!((noise("tm1.accel.x").as_str(), noise("tm2.accel.x").as_str()), ("ifo_x", "is_x"));

    let dark = run(&Grid::of_the_loop(3000).without("ephemeris"), &json!({}), 4096);
    assert!(notes(&dark.report).contains("sunlight is not modelled"), "{}", notes(&dark.report));
    assert!(notes(&dark.report).contains("relative to CRF"), "{}", notes(&dark.report));

    let replayed = run(&Grid::of_the_loop(3000).without("command"), &json!({}), 4096);
    assert_eq!(replayed.report["commands"], "reconstructed");
    assert_eq!(replayed.report["counts"]["commands_replayed"], 2400);
    // While the law settles nothing is said about the noise: 2400 squares, five times 2.9 %.
    let ratio = replayed.report["quality"]["attitude_innovation_ratio"][2].as_f64().expect("a number");
    assert!((ratio - 1.0).abs() < 0.15, "{ratio}");

    let angles = Grid::of_the_loop(3000).without("is.tm1.att_orf_rad").without("dws.tm1");
    assert_eq!(run(&angles, &json!({}), 4096).report["commands"], "telemetered");
    let refusal = link_refusal(&angles.without("command"), &json!({}), &[]);
    assert!(refusal.contains("/command") && refusal.contains("replayed"), "{refusal}");
}

/// Telemetry has a field for the interferometer of each test mass; a mission may have none there.
#[test]
fn an_instrument_that_the_mission_has_not_is_not_read() {
    let mut mission = taiji();
    mission["test_mass"]["tm2"]["interferometer"] = json!([]);
    let (library, grid) = (library(), Grid::of_the_loop(1));
    let noise_of = |mission: &Value| -> Vec<String> {
        let mut stage = create_for(mission, &library, &json!({}), &[]);
        let linked = stage.link(LinkRequest { available: &grid.columns, model_json: "{}" }).expect("linked");
        let columns = linked.writes.iter().flat_map(|table| &table.columns);
        let of = |c: &Column| c.attributes.get("noise").filter(|_| c.name.ends_with(".accel.x")).cloned();
        columns.filter_map(of).collect()
    };
    assert_eq!(noise_of(&taiji()), ["ifo_x", "ifo_x"]);
    assert_eq!(noise_of(&mission), ["ifo_x", "is_x"]);
}

#[test]
fn what_must_be_there_is_asked_for_by_name() {
    let refusal = link_refusal(&Grid::of_the_loop(1).without("dws.sc_crf_rad"), &json!({}), &[]);
    assert!(refusal.contains("dws.sc_crf_rad.phi"), "{refusal}");
    let refusal = link_refusal(&Grid::of_the_loop(1).without("is.tm2.r_orf_m.z"), &json!({}), &[]);
    assert!(refusal.contains("is.tm2.r_orf_m.z"), "{refusal}");
    let mut wrong = Grid::of_the_loop(1);
    wrong.columns[0].unit = "deg".to_owned();
    let refusal = link_refusal(&wrong, &json!({}), &[]);
    assert!(refusal.contains("deg") && refusal.contains("rad"), "{refusal}");
}

#[test]
fn the_naive_ways_say_that_they_are() {
    let grid = Grid::of_the_loop(3000);
    for method in ["commanded", "second-difference"] {
        let report = run(&grid, &json!({"angular_acceleration": method}), 4096).report;
        assert_eq!(report["quality"]["angular_acceleration"], method);
        assert!(notes(&report).contains("biases the calibration"), "{}", notes(&report));
    }
}

/// A torque of twice the law's, about one axis.
#[test]
fn another_controller_is_noticed() {
    let mut grid = Grid::of_the_loop(3000);
    let torque = grid.columns.iter().position(|c| c.name == "command.mps_torque_srf_nm.y").expect("a torque");
    for value in &mut grid.rows.columns[torque] {
        *value *= 2.0;
    }
    let noted = notes(&run(&grid, &json!({}), 4096).report);
    assert!(noted.contains("another controller flew"), "{noted}");
    let quiet = run(&grid, &json!({"compare_commands": false}), 4096).report;
    assert!(quiet["quality"].get("command_replay").is_none(), "{quiet}");
}

/// The columns on demand change nothing of the others, through the stretch that is held back for the levels of the
/// noise and after.
#[test]
fn what_is_asked_for_comes_beside_the_rest() {
    let grid = Grid::of_the_loop(34_000);
    let usual = run(&grid, &json!({"compare_commands": false}), 4096);
    for (needs, first, unit, frame, count) in [
        ("commands", "used.mps_force_srf_n.x", "N", "SRF", 21),
        ("torque-response", "response.alpha_srf_rad_s2.by_torque_gain.x.x", "rad s-2", "SRF", 9),
        ("dws-delay-response", "response.alpha_srf_rad_s2.by_dws_delay.x", "rad s-3", "SRF", 3),
    ] {
        let on_demand = run_asked(&grid, &json!({"compare_commands": false}), 4096, &[needs]);
        assert_eq!(on_demand.columns[..27], usual.columns);
        assert_eq!(on_demand.rows.time_ns, usual.rows.time_ns);
        let bits = |o: &Output| -> Vec<u64> { o.rows.columns[..27].iter().flatten().map(|v| v.to_bits()).collect() };
        assert!(bits(&on_demand) == bits(&usual), "{needs}");
        let column = &on_demand.columns[27];
        assert_eq!((column.name.as_str(), column.unit.as_str(), column.frame.as_str()), (first, unit, frame));
        assert_eq!((on_demand.columns.len(), column.attributes["kind"].as_str()), (27 + count, "series"));
        assert!(
            on_demand.rows.columns[27..].iter().all(|c| c.len() == 34_000 && c.iter().all(|x| x.is_finite())),
            "{needs}"
        );
    }
    let at = |rows: &Grid, name: &str| rows.columns.iter().position(|c| c.name == name).expect("a column");
    let on_demand = run_asked(&grid, &json!({"compare_commands": false}), 4096, &["commands"]);
    for (column, values) in on_demand.columns.iter().zip(&on_demand.rows.columns).skip(27) {
        let told = column.name.replace("used.sun_srf", "ephemeris.sun_srf").replace("used.", "command.");
        assert_eq!(*values, grid.rows.columns[at(&grid, &told)], "{told}");
    }
}

/// All columns are those of the commanded angular acceleration, whatever the parameter says, with what they lack.
#[test]
fn in_prediction_mode_columns_state_what_they_lack() {
    let needs = ["commands", "dws-delay-response", "prediction", "torque-response"];
    let grid = Grid::of_the_loop(3000);
    let commanded = run(&grid, &json!({"angular_acceleration": "commanded"}), 4096);
    let at = |o: &Output, name: &str| o.columns.iter().position(|c| c.name == name).expect("a column");
    for method in ["smoother", "second-difference", "commanded"] {
        let predicted = run_asked(&grid, &json!({"angular_acceleration": method}), 4096, &needs);
        for (column, values) in predicted.columns.iter().zip(&predicted.rows.columns) {
            let lacks = column.attributes.get("unpredicted").map(String::as_str);
            let want = match column.name.split_once('.').expect("a body") {
                ("sc", rest) => rest.strip_prefix("alpha_srf_rad_s2.").map(|axis| format!("sc.alpha.{axis}")),
                (tm, rest) => rest.strip_prefix("u_orf_m_s2.").map(|axis| format!("{tm}.accel.{axis}")),
            };
            let want = want.filter(|_| !column.name.starts_with("response.")).map(|of| format!("{{\"{of}\":1.0}}"));
            assert_eq!(lacks, want.as_deref(), "{}", column.name);
            if want.is_some() {
                assert!(*values == commanded.rows.columns[at(&commanded, &column.name)], "{}", column.name);
            }
        }
        assert_eq!(predicted.report["quality"]["angular_acceleration"], "commanded");
        assert!(!notes(&predicted.report).contains("biases the calibration"), "{}", notes(&predicted.report));
    }
    let attributes = |o: &Output| o.columns.iter().flat_map(|c| c.attributes.keys().cloned()).collect::<Vec<_>>();
    assert!(!attributes(&commanded).contains(&"unpredicted".to_owned()));
}

/// The stage in a chain of the engine, whose host asks: what it declares has no estimate.
#[test]
fn what_the_host_asks_for_reaches_the_stage() {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("asked");
    std::fs::create_dir_all(&folder).expect("a folder");
    let file = library_path();
    std::fs::copy(&file, folder.join(file.file_name().expect("a file"))).expect("cargo builds the library");
    let registry = Registry::discover(std::slice::from_ref(&folder));
    let grid =
        TableSpec { name: "grid".to_owned(), rate_hz: 10.0, columns: Grid::of_the_loop(1).columns, truth: false };
    let file = folder.join("pipeline.toml");
    let text = "[pipeline]\nname = \"p\"\nproduct = \"P\"\nrelease = 1\n[[stage]]\nplugin = \"hinf-dfacs\"\n";
    std::fs::write(&file, text).expect("written");
    let pipeline = Pipeline::load(&file).expect("a pipeline");
    let text = include_str!("../../../../fixtures/missions/taiji.toml");
    let mission = Mission::parse(Path::new("taiji.toml"), text).expect("a mission");
    let mut model = Model::parse(Path::new("m.toml"), "[model]\nrevision = \"1\"\n").expect("a model");
    for asked in [false, true] {
        model.needs = if asked { vec![PREDICTION_NEED.to_owned()] } else { Vec::new() };
        let carry = Carry { batch_rows: 4096, threads: 1, run_in_until_ns: None };
        let chain = build(&registry, &pipeline, &mission, &model, std::slice::from_ref(&grid), carry).expect("a chain");
        let stated = chain.columns.iter().filter(|c| c.attributes.contains_key(UNPREDICTED_ATTRIBUTE)).count();
        let torque = chain.noise.iter().find(|p| p.name == "thruster_torque").expect("torque noise");
        assert_eq!((stated, torque.estimate.is_none()), if asked { (9, true) } else { (0, false) });
    }
}

#[test]
fn a_response_of_what_is_not_made_is_refused() {
    for needs in ["torque-response", "dws-delay-response"] {
        let grid = Grid::of_the_loop(1);
        let refusal = link_refusal(&grid, &json!({"angular_acceleration": "commanded"}), &[needs]);
        assert!(refusal.contains("angular_acceleration = \"smoother\""), "{refusal}");
    }
    run_asked(&Grid::of_the_loop(10), &json!({"angular_acceleration": "commanded"}), 4096, &["commands"]);
}
