//! The source across the border, as the engine drives it.

use dragfree_engine::border::{Config, Instance, Kind, Library, LinkRequest};
use dragfree_engine::table::{Batch, TableSpec};
use dragfree_physics::mission::Mission;
use dragfree_sim::hidden::Hidden;
use serde_json::{Value, json};
use std::path::{Path, PathBuf};

const START_NS: i64 = 2_051_222_400_000_000_000;

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..")
}

/// The shared library lies beside the folder of the test's own program.
fn library() -> Library {
    let folder = std::env::current_exe().unwrap().parent().unwrap().parent().unwrap().to_owned();
    let name = format!("{}dragfree_sim{}", std::env::consts::DLL_PREFIX, std::env::consts::DLL_SUFFIX);
    Library::open(&folder.join(name)).unwrap()
}

fn config(seconds: i64, change: impl Fn(&mut Value, &mut Value)) -> Config {
    let text = std::fs::read_to_string(root().join("fixtures/missions/taiji.toml")).unwrap();
    let mut mission: Value = toml::from_str(&text).unwrap();
    let mut parameters = json!({
        "seed": 5, "com_offset_srf_m": [0.001, 0.0, 0.0], "command": true, "stiffness_error": 0.2, "settle_s": 60.0,
        "effects": [], "manoeuvres": [], "hidden": -1
    });
    change(&mut mission, &mut parameters);
    let value = json!({
        "parameters": parameters, "mission": mission, "instance": "", "files": [],
        "start_ns": START_NS, "end_ns": START_NS + seconds * 1_000_000_000
    });
    Config { value }
}

fn create(library: &Library, config: &Config) -> Result<Instance, String> {
    let plugin = library.plugins.iter().find(|p| p.kind == Kind::Source && p.manifest.id == "sim").unwrap();
    Instance::create(library, plugin, config).map_err(|e| e.to_string())
}

fn linked(library: &Library, config: &Config) -> (Instance, Vec<TableSpec>) {
    let mut sim = create(library, config).unwrap();
    let linked = sim.link(LinkRequest { available: &[], model_json: "{}" }).unwrap();
    sim.activate(65_536).unwrap();
    (sim, linked.writes)
}

fn append(all: &mut [Batch], batches: Vec<Batch>) {
    for (whole, part) in all.iter_mut().zip(batches) {
        whole.time_ns.extend(part.time_ns);
        for (w, p) in whole.columns.iter_mut().zip(part.columns) {
            w.extend(p);
        }
    }
}

/// Everything a source gives, in batches of `rows`.
fn run(library: &Library, config: &Config, rows: u32) -> (Vec<TableSpec>, Vec<Batch>) {
    let (mut sim, tables) = linked(library, config);
    let mut all: Vec<Batch> = tables.iter().map(|t| Batch::empty(t.columns.len())).collect();
    loop {
        let step = sim.next(rows).unwrap();
        assert!(step.batches.iter().flat_map(|b| b.time_ns.last()).all(|t| *t < step.complete_until_ns));
        append(&mut all, step.batches);
        if step.done {
            return (tables, all);
        }
    }
}

#[test]
fn rows_do_not_depend_on_the_batch_size() {
    let library = library();
    let config = config(300, |_, _| {});
    let (tables, whole) = run(&library, &config, 65_536);
    assert!(run(&library, &config, 1).1 == whole && run(&library, &config, 777).1 == whole);
    let other = self::config(300, |_, p| p["seed"] = json!(6));
    assert!(run(&library, &other, 777).1 != whole, "the seed matters");

    let rows = |name: &str| {
        let i = tables.iter().position(|t| t.name == name).unwrap();
        (whole[i].time_ns.len(), whole[i].time_ns[0])
    };
    for (name, count) in [("is", 3000), ("ifo", 3000), ("dws", 3000), ("command", 3000), ("ephemeris", 5)] {
        assert_eq!(rows(name), (count, START_NS), "{name}");
    }
    assert_eq!(rows("hk/battery_current_a"), (300, START_NS));
    assert_eq!(rows("truth"), (3000, START_NS));
    assert!(whole.iter().flat_map(|b| b.columns.iter().flatten()).all(|x| x.is_finite()));
    assert!(tables.iter().all(|t| t.truth == (t.name == "truth")));
}

/// The mission whose thrusters are told one by one.
fn with_thrusters(mission: &mut Value) {
    let text = std::fs::read_to_string(root().join("fixtures/missions/taiji-thrusters.toml")).unwrap();
    let other: Value = toml::from_str(&text).unwrap();
    mission["thrusters"] = other["thrusters"].clone();
    assert_eq!(*mission, other, "the two missions differ in their thrusters alone");
}

#[test]
fn a_saved_state_goes_on_bit_for_bit() {
    goes_on(|_| {});
}

#[test]
fn a_saved_state_goes_on_bit_for_bit_with_thrusters_and_lines() {
    goes_on(|mission| {
        with_thrusters(mission);
        mission["noise"]["dws_long_arm"]["lines"] = json!([{ "amplitude_rad": 1e-9, "frequency_hz": 0.055 }]);
    });
}

fn goes_on(change: impl Fn(&mut Value)) {
    let library = library();
    let effects = [
        "slosh:sc.x=0.01",
        "thermal:tm1.x=1e-12",
        "time-offset:dws=0.13",
        "offset-drift:sc.x=1e-8,kappa_m_k=1e-5",
        "is-noise:tm1.y=1.5",
    ];
    let config = config(200, |m, p| {
        change(m);
        p["effects"] = json!(effects);
    });
    let (_, whole) = run(&library, &config, 777);
    let (mut first, tables) = linked(&library, &config);
    let mut all: Vec<Batch> = tables.iter().map(|t| Batch::empty(t.columns.len())).collect();
    append(&mut all, first.next(1234).unwrap().batches);
    let state = first.save().unwrap();
    let (mut second, _) = linked(&library, &config);
    second.load(&state).unwrap();
    append(&mut all, second.next(65_536).unwrap().batches);
    assert!(all == whole);
    assert!(second.load(&state[..state.len() / 2]).is_err() && second.load(b"{}").is_err());
}

/// Telemetry and report tell when an actuator or a readout is at its end; a day that is well has none of it.
#[test]
fn saturation_is_seen() {
    let library = library();
    let told = |config: &Config| {
        let (mut sim, tables) = linked(&library, config);
        let batches = sim.next(65_536).unwrap().batches;
        let at = |table: &str, column: &str| {
            let t = tables.iter().position(|t| t.name == table).unwrap();
            batches[t].columns[tables[t].columns.iter().position(|c| c.name == column).unwrap()].clone()
        };
        let counts = sim.report("[]").unwrap().counts;
        (at("hk/actuators_at_limit", "value"), at("is", "tm1.status"), at("command", "tm1.force_orf_n.y"), counts)
    };
    let (flags, status, _, counts) = told(&config(100, |_, _| {}));
    assert_eq!(flags.len(), 100);
    assert!(flags.iter().chain(&status).all(|x| *x == 0.0) && counts["epochs"] == 1000);
    assert!(counts["epochs_at_actuator_limit"] == 0 && counts["epochs_with_saturated_readout"] == 0);

    // Self-gravity of 1e-9 m/s² takes 2e-9 N to hold, the noise of the readouts several nm.
    let (flags, status, force, counts) = told(&config(100, |m, p| {
        m["actuators"]["electrostatic_force_limit_n"] = json!(1e-12);
        m["limits"]["displacement_m"] = json!(1e-9);
        p["settle_s"] = json!(0.0);
    }));
    let clipped = force.iter().filter(|f| f.abs() == 1e-12).count();
    assert!(clipped > 500, "{clipped}");
    let at_limit = counts["epochs_at_actuator_limit"] as f64;
    // The last packet tells the samples up to its own; what follows waits for the next one.
    let told = flags.iter().sum::<f64>();
    assert!(told >= clipped as f64 - 9.0 && told <= at_limit && at_limit - told <= 9.0, "{told} {at_limit}");
    let saturated = status.iter().filter(|s| **s == 1.0).count() as u64;
    assert!(saturated > 0 && counts["epochs_with_saturated_readout"] >= saturated, "{counts:?}");
}

#[test]
fn the_command_can_be_kept_on_board() {
    let library = library();
    let (_, tables) = linked(&library, &config(10, |_, p| p["command"] = json!(false)));
    assert!(!tables.iter().any(|t| t.name == "command"));
}

/// Every column is a field of telemetry.proto and every field a column.
#[test]
fn columns_are_the_fields_of_the_interface() {
    let library = library();
    let (_, tables) = linked(&library, &config(10, |_, _| {}));
    let proto = std::fs::read_to_string(root().join("fixtures/proto/telemetry.proto")).unwrap();
    for (table, message) in [
        ("is", "InertialSensors"),
        ("ifo", "Interferometers"),
        ("dws", "Dws"),
        ("command", "Command"),
        ("ephemeris", "Ephemeris"),
        ("hk/tank_mass_kg", "Scalar"),
        ("truth", "Truth"),
    ] {
        let table = tables.iter().find(|t| t.name == table).unwrap();
        let names: Vec<&str> = table.columns.iter().map(|c| c.name.as_str()).collect();
        assert_eq!(names, fields(&proto, message), "{message}");
    }
}

/// Leaves of a message, depth first in the order of the text; reads the simple proto3 of the interface alone.
fn fields(proto: &str, message: &str) -> Vec<String> {
    let body = proto.split(&format!("message {message} {{")).nth(1).unwrap().split("\n}").next().unwrap();
    let mut out = Vec::new();
    for line in body.lines() {
        let mut words = line.split_whitespace();
        let (Some(kind), Some(name), Some("=")) = (words.next(), words.next(), words.next()) else { continue };
        if kind == "double" || kind == "uint32" {
            out.push(name.to_owned());
        } else {
            out.extend(fields(proto, kind).into_iter().map(|leaf| format!("{name}.{leaf}")));
        }
    }
    out
}

#[test]
fn what_has_no_sense_is_refused_by_name() {
    let library = library();
    let refusal = |change: &dyn Fn(&mut Value, &mut Value)| create(&library, &config(10, change)).err().unwrap();
    for (what, found) in [
        ("spacecraft.mass_kg", refusal(&|m, _| m["spacecraft"]["mass_kg"] = json!(0.0))),
        ("symmetric", refusal(&|m, _| m["spacecraft"]["inertia_srf_kg_m2"][0][1] = json!(99.0))),
        ("test_mass.tm1.mass_kg", refusal(&|m, _| m["test_mass"]["tm1"]["mass_kg"] = json!(0.0))),
        ("noise.is_y.asd_m_rthz = -1", refusal(&|m, _| m["noise"]["is_y"]["asd_m_rthz"] = json!(-1.0))),
        (
            "noise.is_y.lines.amplitude_m",
            refusal(&|m, _| {
                m["noise"]["is_y"]["lines"] = json!([{ "amplitude_m": -1e-9, "frequency_hz": 0.1 }]);
            }),
        ),
        (
            "noise.is_y.lines.frequency_hz = 5",
            refusal(&|m, _| {
                m["noise"]["is_y"]["lines"] = json!([{ "amplitude_m": 1e-9, "frequency_hz": 5.0 }]);
            }),
        ),
        ("self_gravity.drift_m_s2_day = -1", refusal(&|m, _| m["self_gravity"]["drift_m_s2_day"] = json!(-1.0))),
        ("thrusters.min_n", refusal(&|m, _| m["thrusters"] = json!({ "min_n": 1e-6 }))),
        ("thrusters.delay_s = 11", refusal(&|m, _| m["thrusters"] = json!({ "delay_s": 11.0 }))),
        (
            "thrusters.max_n = missing",
            refusal(&|m, _| {
                with_thrusters(m);
                drop(m["thrusters"].as_object_mut().unwrap().remove("max_n"));
            }),
        ),
        (
            "thrusters.unit[2].direction_srf",
            refusal(&|m, _| {
                with_thrusters(m);
                m["thrusters"]["unit"][2]["direction_srf"] = json!([0.0, 0.0, 0.0]);
            }),
        ),
        (
            "six independent",
            refusal(&|m, _| {
                with_thrusters(m);
                m["thrusters"]["unit"].as_array_mut().unwrap().truncate(5);
            }),
        ),
        ("housing.between", refusal(&|m, _| drop(m["test_mass"].as_object_mut().unwrap().remove("tm2")))),
        ("[noise.dws_local]", refusal(&|m, _| drop(m["noise"].as_object_mut().unwrap().remove("dws_local")))),
        ("[requirements]", refusal(&|m, _| drop(m.as_object_mut().unwrap().remove("requirements")))),
        (
            "missing ephemeris span: the epoch of [orbit], 2050",
            refusal(&|m, _| {
                m["orbit"]["epoch_utc"] = json!("2050-01-01");
            }),
        ),
        ("com_offset_srf_m", refusal(&|_, p| p["com_offset_srf_m"] = json!([0.0, 1.0]))),
        ("sloshing:sc.x=0.1", refusal(&|_, p| p["effects"] = json!(["sloshing:sc.x=0.1"]))),
        ("es-gain:tm3.y=0.1", refusal(&|_, p| p["effects"] = json!(["es-gain:tm3.y=0.1"]))),
        ("es-gain:tm1.y=much", refusal(&|_, p| p["effects"] = json!(["es-gain:tm1.y=much"]))),
    ] {
        assert!(found.contains(what), "{what}: {found}");
    }
}

/// What is hidden shows in the attachment that the host seals and nowhere else: tables, columns and their attributes
/// are the same, and so are rows where the seed draws nothing. The seed is the first that draws something, and nothing.
#[test]
fn hidden_effects_leave_no_trace_but_their_own() {
    let library = library();
    let text = std::fs::read_to_string(root().join("fixtures/missions/taiji.toml")).unwrap();
    let mission = Mission::from_json(&toml::from_str::<Value>(&text).unwrap().to_string()).unwrap();
    let drawn = |seed: i64| Hidden::draw(seed.cast_unsigned(), 120.0 / 86_400.0, &mission).drawn.len();
    let something = (0..).find(|seed| drawn(*seed) > 0).unwrap();
    let nothing = (0..).find(|seed| drawn(*seed) == 0).unwrap();
    let hide = |seed: i64| config(120, move |_, p| p["hidden"] = json!(seed));
    let (plain, rows) = run(&library, &hide(-1), 4096);
    let (hidden, changed) = run(&library, &hide(something), 4096);
    assert_eq!(plain, hidden);
    assert!(rows != changed, "seed {something} changes the rows");
    assert!(rows == run(&library, &hide(nothing), 4096).1, "seed {nothing} changes nothing");

    let sealed = |seed: i64| {
        let report = linked(&library, &hide(seed)).0.report("[]").unwrap();
        assert!(report.quality.keys().all(|k| k != "hidden"), "{report:?}");
        report.attachments
    };
    assert!(sealed(-1).is_empty());
    for seed in [something, nothing] {
        let attachments = sealed(seed);
        assert_eq!(attachments[0].suffix, "sealed.json");
        let content: Value = serde_json::from_str(&attachments[0].text).unwrap();
        assert_eq!(content["effects"].as_array().unwrap().len(), drawn(seed));
        assert_eq!((&content["hidden_seed"], &content["noise_seed"]), (&json!(seed), &json!(5)));
        let b_m = content["offset_m"]["com-offset.tm1.x"].as_f64().unwrap();
        assert!((b_m - 0.090_866_025).abs() < 2e-3, "{b_m}");
        assert_eq!(sealed(seed), attachments, "the same again");
    }
}

/// A thrust gain of −2 turns the drag-free loop into a push; the message says when and where.
#[test]
fn a_loop_that_diverges_says_when_and_where() {
    let library = library();
    let found = create(
        &library,
        &config(10, |_, p| {
            p["effects"] = json!(["mps-gain:sc.x=-2"]);
            p["settle_s"] = json!(86_400.0);
        }),
    )
    .err()
    .unwrap();
    assert!(found.contains("diverged") && found.contains(" s after") && found.contains("tm"), "{found}");
}
