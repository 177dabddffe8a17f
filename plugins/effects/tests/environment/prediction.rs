//! Prediction mode through the plugin interface: what columns state that they lack, and that none uses later values.

use crate::harness::{AXES, Telemetry, mission_json};
use dragfree_engine::chain::{Carry, Chain, build};
use dragfree_engine::config::{EffectEntry, Mission, Model, Node, Pipeline};
use dragfree_engine::registry::Registry;
use dragfree_engine::table::{Column, TableSpec};
use rand::SeedableRng;
use rand_xoshiro::Xoshiro256PlusPlus;
use serde_json::{Value, json};
use std::path::{Path, PathBuf};

/// Columns of hinf-dfacs, in prediction mode with what they lack.
fn telemetry(rows: usize, prediction: bool) -> Telemetry {
    let mut telemetry =
        Telemetry::new(rows, &[("hk.b", "T"), ("hk.g", "T m-1"), ("hk.a", "K"), ("hk.c", "K"), ("hk.f", "1")]);
    for (tm, frame) in [("tm1", "ORF_1"), ("tm2", "ORF_2")] {
        for axis in AXES {
            let name = format!("{tm}.u_orf_m_s2.{axis}");
            telemetry.add("reconstruction", &name, "m s-2", frame, [].into());
        }
    }
    for column in &mut telemetry.columns {
        let lacks = match column.name.split_once('.') {
            Some(("sc", rest)) => rest.strip_prefix("alpha_srf_rad_s2.").map(|axis| format!("sc.alpha.{axis}")),
            Some((tm, rest)) => rest.strip_prefix("u_orf_m_s2.").map(|axis| format!("{tm}.accel.{axis}")),
            None => None,
        };
        if let Some(channel) = lacks.filter(|_| prediction) {
            column.attributes.insert("unpredicted".to_owned(), json!({ channel: 1.0 }).to_string());
        }
        if column.name.starts_with("tm1.r_orf_m.") {
            let noise = if column.name.ends_with('x') { "ifo_x" } else { "is_y" };
            column.attributes.insert("noise".to_owned(), noise.to_owned());
        }
    }
    telemetry
}

fn written(telemetry: &Telemetry, id: &str, instance: &str) -> Vec<Column> {
    let (_, linked) = telemetry.link(id, instance, json!({}), false).unwrap_or_else(|e| panic!("{e}"));
    linked.writes.into_iter().flat_map(|t| t.columns).collect()
}

/// Gains against differences of the columns themselves. ω is zero and its terms are even in α, so that central
/// differences are exact.
#[test]
fn an_offset_s_regressors_lack_their_derivatives_by_the_angular_acceleration() {
    for (tm, rows) in [("tm1", 6), ("tm2", 6)] {
        let mut telemetry = telemetry(rows, true);
        for (j, axis) in AXES.iter().enumerate() {
            let step = |k: usize| if k / 2 == j { [1e-6, -1e-6][k % 2] } else { 0.0 };
            telemetry.fill(&format!("sc.alpha_srf_rad_s2.{axis}"), |t| step((t * 10.0).round() as usize));
        }
        let (mut effect, linked) = telemetry.link("com-offset", tm, json!({}), false).expect("linked");
        let made = telemetry.process(&mut effect, &linked, 0, rows);
        let columns: Vec<Column> = linked.writes.into_iter().flat_map(|t| t.columns).collect();
        assert_eq!(columns.len(), 9);
        let mut largest = 0.0_f64;
        for (column, values) in columns.iter().zip(&made) {
            let gains: Value = serde_json::from_str(&column.attributes["unpredicted"]).expect("JSON");
            assert_eq!(gains.as_object().map(serde_json::Map::len), Some(3));
            for (j, axis) in AXES.iter().enumerate() {
                let want = (values[2 * j] - values[2 * j + 1]) / 2e-6;
                let got = gains[format!("sc.alpha.{axis}")].as_f64().expect("a gain");
                assert!((got - want).abs() < 1e-9, "{} by {axis}: {got} against {want}", column.name);
                largest = largest.max(want.abs());
            }
        }
        assert!(largest > 0.9, "an axis turned by 30° has gains of cos 30° and 1");
    }
    assert!(
        written(&telemetry(1, false), "com-offset", "tm1").iter().all(|c| !c.attributes.contains_key("unpredicted"))
    );
}

#[test]
fn a_series_states_what_its_source_lacks_as_a_value_or_as_a_slope() {
    let attribute = |columns: &[Column], series: &str, key: &str| {
        let column = columns.iter().find(|c| c.name == series).unwrap_or_else(|| panic!("no {series} in {columns:?}"));
        column.attributes.get(key).cloned()
    };
    let late = written(&telemetry(1, true), "time-offset", "ifo");
    let series = "slope(tm1.u_orf_m_s2.x)";
    assert_eq!(attribute(&late, series, "unpredicted_slope").as_deref(), Some(r#"{"tm1.accel.x":1.0}"#));
    assert_eq!(attribute(&late, series, "unpredicted"), None);
    let late = written(&telemetry(1, true), "time-offset", "dws");
    let series = "slope(sc.alpha_srf_rad_s2.y)";
    assert_eq!(attribute(&late, series, "unpredicted_slope").as_deref(), Some(r#"{"sc.alpha.y":1.0}"#));
    assert_eq!(late.len(), 3, "{late:?}");
    let drift = written(&telemetry(1, true), "offset-drift", "sc.x");
    assert!(!drift.is_empty() && drift.iter().all(|c| c.attributes.keys().all(|key| !key.starts_with("unpredicted"))));
    let mut held = telemetry(1, true);
    assert_eq!(attribute(&written(&held, "stiffness", "tm1.y"), "held(tm1.r_orf_m.y)", "unpredicted"), None);
    let column = held.columns.iter_mut().find(|c| c.name == "tm1.r_orf_m.y").expect("a readout");
    column.attributes.insert("unpredicted".to_owned(), r#"{"tm1.accel.y":2.0}"#.to_owned());
    let held = written(&held, "stiffness", "tm1.y");
    assert_eq!(attribute(&held, "held(tm1.r_orf_m.y)", "unpredicted").as_deref(), Some(r#"{"tm1.accel.y":2.0}"#));
}

/// What follows the motion must not follow an error of a readout: the host asks the responses.
#[test]
fn errors_of_readouts_say_that_they_move_nothing() {
    let mut telemetry = telemetry(1, true);
    for axis in AXES {
        telemetry.add("reconstruction", &format!("used.tm1.torque_orf_nm.{axis}"), "N m", "ORF_1", [].into());
    }
    let in_readout = |id: &str, instance: &str| -> Vec<bool> {
        let (_, linked) =
            telemetry.link(id, instance, json!({}), false).unwrap_or_else(|e| panic!("{id}:{instance}: {e}"));
        let responses: Vec<bool> =
            linked.coefficients.iter().flat_map(|c| &c.responses).map(|r| r.in_readout).collect();
        assert!(!responses.is_empty(), "{id}:{instance}");
        responses
    };
    let errors = [
        ("is-scale", "tm1.y"),
        ("is-crosstalk", "tm1.y-z"),
        ("tilt-to-length", "tm1"),
        ("time-offset", "ifo"),
        ("time-offset", "dws"),
        ("time-offset", "is"),
    ];
    for (id, instance) in errors {
        assert!(in_readout(id, instance).iter().all(|x| *x), "{id}:{instance}");
    }
    for (id, instance) in [("mps-gain", "sc.y"), ("mps-tilt", "sc.y"), ("es-gain", "tm1.y")] {
        assert!(in_readout(id, instance).iter().all(|x| !x), "{id}:{instance}");
    }
}

/// Rows before a change of all columns that effects read stay as they were, bit by bit, and some row after it does not.
#[test]
fn no_effect_uses_later_values() {
    const ROWS: usize = 400;
    const CHANGED: usize = 200;
    let mut before = telemetry(ROWS, true);
    let mut random = Xoshiro256PlusPlus::seed_from_u64(5);
    before.rows.iter_mut().flatten().for_each(|x| *x = rand::RngExt::random_range(&mut random, 0.5..1.5));
    let flag = before.columns.iter().position(|c| c.name == "hk.f").expect("a flag");
    before.rows[flag].iter_mut().enumerate().for_each(|(k, x)| *x = f64::from(u8::from(k / 50 % 2 == 1)));
    let mut after = before.clone();
    after.rows.iter_mut().for_each(|column| column[CHANGED..].iter_mut().for_each(|x| *x = 1.0 - *x));
    for (id, instance, parameters) in [
        ("com-offset", "tm1", json!({})),
        ("is-scale", "tm1.y", json!({})),
        ("time-offset", "ifo", json!({})),
        ("time-offset", "is", json!({})),
        ("time-offset", "dws", json!({})),
        ("stiffness", "tm1.y", json!({})),
        ("mps-correlation", "layout", json!({})),
        ("offset-drift", "sc.x", json!({})),
        ("offset-drift", "sc.z", json!({"with": "hk.a"})),
        ("slosh", "sc.x", json!({})),
        ("thermal", "tm1.x", json!({"plus": "hk.a", "minus": "hk.c"})),
        ("magnetic", "tm2", json!({"gradient": "hk.g", "field": "hk.b"})),
        ("impulse", "sc.phi", json!({"flag": "hk.f", "pulse_s": 1.0})),
    ] {
        let made = |telemetry: &Telemetry| {
            let linked = telemetry.link(id, instance, parameters.clone(), false);
            let (mut effect, linked) = linked.unwrap_or_else(|e| panic!("{id}:{instance}: {e}"));
            telemetry.process(&mut effect, &linked, 0, ROWS)
        };
        let (before, after) = (made(&before), made(&after));
        let bits = |columns: &[Vec<f64>], range: std::ops::Range<usize>| -> Vec<u64> {
            columns.iter().flat_map(|c| c[range.clone()].iter().map(|x| x.to_bits())).collect()
        };
        assert!(bits(&before, 0..CHANGED) == bits(&after, 0..CHANGED), "{id}:{instance} uses later values");
        let regressors_are_computed = !before.is_empty();
        let changed = bits(&before, CHANGED..ROWS) != bits(&after, CHANGED..ROWS);
        assert!(changed || !regressors_are_computed, "{id}:{instance} does not depend on what was changed");
    }
}

/// The effects alone, over the columns of hinf-dfacs as if a feed brought them.
fn chain(folder: &str, change: impl FnOnce(&mut Model)) -> Chain {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join(folder);
    std::fs::create_dir_all(&folder).expect("a folder");
    let program = std::env::current_exe().expect("a test program has a path");
    let library = format!("{}dragfree_effects{}", std::env::consts::DLL_PREFIX, std::env::consts::DLL_SUFFIX);
    let built = program.parent().expect("target/PROFILE/deps/test").join(&library);
    std::fs::copy(built, folder.join(&library)).expect("cargo builds the library before its tests");
    let registry = Registry::discover(&[folder]);

    let mut tables: Vec<TableSpec> = Vec::new();
    for column in telemetry(1, true).columns {
        match tables.iter_mut().find(|t| t.name == column.table) {
            Some(table) => table.columns.push(column),
            None => tables.push(TableSpec {
                name: column.table.clone(),
                rate_hz: column.rate_hz,
                columns: vec![column],
                truth: false,
            }),
        }
    }
    let pipeline = Pipeline {
        path: PathBuf::from("p.toml"),
        name: "p".to_owned(),
        product: "P".to_owned(),
        release: 1,
        mission: None,
        model: None,
        source: None,
        nodes: vec![Node::Effects],
        settings: dragfree_engine::schema::Settings::default(),
    };
    let (path, name) = (PathBuf::from("m.toml"), || "m".to_owned());
    let mission = Mission { path, name: name(), spacecraft: name(), value: mission_json() };
    let mut model = Model::parse(Path::new("m.toml"), "[model]\nrevision = \"1\"\n").expect("a model");
    change(&mut model);
    build(&registry, &pipeline, &mission, &model, &tables, Carry { batch_rows: 100, threads: 1, run_in_until_ns: None })
        .expect("a chain")
}

fn drift(column: &str) -> EffectEntry {
    let mut entry = EffectEntry::new("offset-drift", "sc.x");
    entry.parameters.insert("with".to_owned(), toml::Value::String(column.to_owned()));
    entry
}

#[test]
fn a_chosen_candidate_has_the_form_of_its_parameters_alone() {
    let chosen = chain("chosen", |model| {
        model.effects = vec![EffectEntry::new("com-offset", "tm1")];
        model.chosen = vec![drift("hk.c"), drift("hk.a"), EffectEntry::new("com-offset", "tm1"), drift("hk.nothing")];
    });
    let [.., one, other] = &chosen.coefficients[..] else { panic!("{:?}", chosen.coefficients) };
    assert_eq!(chosen.coefficients.len(), 3 + 2);
    for (c, form) in [(one, "hk.c"), (other, "hk.a")] {
        assert_eq!((c.name.as_str(), c.shape["with"].as_str()), ("offset-drift.sc.x", Some(form)));
        assert!(c.candidate && !c.estimate && c.variants.is_empty() && !c.responses.is_empty());
        // Each answers to columns of its own.
        let exists = |r: &dragfree_engine::schema::Response| {
            chosen.columns.iter().filter(|column| column.table == r.table && column.name == r.series).count()
        };
        assert!(c.responses.iter().all(|r| exists(r) == 1), "{c:?}");
    }
    assert_ne!(one.responses, other.responses);
    assert!(chosen.coefficients[..3].iter().all(|c| !c.candidate && c.estimate));
    // What is in the model is not tried beside it, and what has no form is not either.
    let reasons: Vec<&str> = chosen.not_tried.iter().map(|(_, reason)| reason.as_str()).collect();
    let [twice, nothing] = reasons[..] else { panic!("{reasons:?}") };
    assert!(twice.contains("exists twice") && nothing.contains("hk.nothing"), "{reasons:?}");
    assert_eq!(chosen.nodes.len(), 3);

    let refused = chain("refused", |model| model.chosen = vec![drift("hk.nothing")]);
    assert!(refused.coefficients.is_empty() && refused.nodes.is_empty());
    let [(name, reason)] = &refused.not_tried[..] else { panic!("{:?}", refused.not_tried) };
    assert!(name == "offset-drift:sc.x" && reason.contains("hk.nothing"), "{reason}");

    // The twin: as a candidate it has every form, for the time and two temperatures.
    let tried = chain("tried", |model| model.candidates = vec![drift("hk.c")]);
    assert!(tried.coefficients[0].candidate && tried.coefficients[0].variants.len() == 3);
}
