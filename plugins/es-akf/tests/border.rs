//! The stage across the border, with noise-shaping orders that a mission file asks for.

mod common;

use common::{Alpha, Simulation, model};
use dragfree_engine::border::{Config, Instance, Kind, Library, LinkRequest, ReadColumn, Rows};
use dragfree_engine::table::{Batch, Column};
use serde_json::{Value, json};

const AXES: [&str; 3] = ["x", "y", "z"];
const START_NS: i64 = 2_051_222_400_000_000_000;
const STEP_NS: i64 = 100_000_000;

fn library() -> Library {
    let program = std::env::current_exe().expect("a test program has a path");
    let folder = program.parent().expect("target/PROFILE/deps/test");
    let name = format!("{}dragfree_es_akf{}", std::env::consts::DLL_PREFIX, std::env::consts::DLL_SUFFIX);
    Library::open(&folder.join(name)).expect("cargo builds the library before its tests")
}

/// The bundled mission with further `terms` of coloured noise: exponents per readout.
fn mission(terms: [&[u32]; 3]) -> Value {
    let mut mission: Value =
        toml::from_str(include_str!("../../../fixtures/missions/taiji.toml")).expect("the fixture is TOML");
    for (name, exponents) in ["ifo_x", "is_y", "is_z"].iter().zip(terms) {
        let table = &mut mission["noise"][name];
        let asd = table["asd_m_rthz"].clone();
        let term = |p: &u32| json!({"asd_m_rthz": asd, "corner_hz": 1e-3, "exponent": p});
        table["terms"] = exponents.iter().map(term).collect();
    }
    mission
}

fn create(mission: &Value, adaptation: &str) -> Instance {
    let library = library();
    let parameters = json!({
        "follow": "auto", "adaptation": adaptation, "forgetting": 0.999_999, "warm_up_s": 60.0, "gate_sigma": 6.0, "gate_patience": 30,
        "calibrated_sigma": true, "check_s": 60.0, "output_interval_s": 60.0, "displacement_prior_m": 1e-6,
        "velocity_prior_m_s": 1e-7, "bias_prior_m_s2": 1e-7, "bias_walk_m_s2_rts": 3e-15,
        "bias_walk_together_m_s2_rts": 3e-16, "leak_hz": 1e-6, "unknown_alpha": 1.0,
    });
    let value = json!({"parameters": parameters, "mission": mission, "instance": "", "files": [], "needs": []});
    let plugin = library.plugins.iter().find(|p| p.kind == Kind::Stage).expect("the library has a stage");
    Instance::create(&library, plugin, &Config { value }).expect("the fixture is a mission")
}

/// What `hinf-dfacs` and the offset make of a test mass: columns and `epochs` rows of synthetic data.
fn columns_and_rows(test_mass: u64, epochs: usize) -> (Vec<Column>, Vec<i64>, Vec<Vec<f64>>) {
    let column = |table: &str, name: String, unit: &str, attributes: &[(&str, String)]| Column {
        table: table.to_owned(),
        name,
        unit: unit.to_owned(),
        frame: format!("ORF_{test_mass}"),
        rate_hz: 10.0,
        attributes: attributes.iter().map(|(k, v)| ((*k).to_owned(), v.clone())).collect(),
    };
    let mut columns = Vec::new();
    for (group, unit) in [("r_orf_m", "m"), ("u_orf_m_s2", "m s-2")] {
        columns.extend(AXES.map(|a| column("reconstruction", format!("tm{test_mass}.{group}.{a}"), unit, &[])));
    }
    for j in AXES {
        for i in AXES {
            let (coefficient, channel) = (format!("com-offset.tm{test_mass}.{j}"), format!("tm{test_mass}.accel.{i}"));
            let name = format!("{coefficient}@{channel}");
            let attributes = [("kind", "regressor".to_owned()), ("coefficient", coefficient), ("channel", channel)];
            columns.push(column(&format!("effect/com-offset:tm{test_mass}"), name, "s-2", &attributes));
        }
    }
    let synthetic = model([&[4], &[2], &[2]], 1e-6);
    let mut data = Simulation::new(&synthetic, Alpha::Coloured(1.0), test_mass);
    let (mut times, mut rows) = (Vec::new(), vec![Vec::new(); columns.len()]);
    for k in 0..epochs {
        let e = data.epoch();
        times.push(START_NS + k as i64 * STEP_NS);
        for i in 0..3 {
            rows[i].push(e.readout_m[i]);
            rows[3 + i].push(e.u_m_s2[i]);
            for j in 0..3 {
                rows[6 + 3 * j + i].push(e.phi[j][i]);
            }
        }
    }
    (columns, times, rows)
}

fn model_json(test_masses: &[u64]) -> String {
    let coefficient = |tm: &u64, a: &str| {
        json!({"name": format!("com-offset.tm{tm}.{a}"), "unit": "m", "frame": format!("ORF_{tm}"), "lower": -1.0, "upper": 1.0,
               "initial": 0.0, "prior_sigma": 0.1, "estimate": true})
    };
    let offsets: Vec<Value> = test_masses.iter().flat_map(|tm| AXES.map(|a| coefficient(tm, a))).collect();
    json!({"coefficients": offsets, "constraints": []}).to_string()
}

/// Ten minutes, cut at `cut` and gone on with from its saved state: the report and the rows for the archive.
fn run(mission: &Value, test_masses: &[u64], in_loop: bool, cut: usize) -> (Value, Vec<Batch>) {
    run_adapting(mission, test_masses, in_loop, cut, "auto")
}

fn run_adapting(
    mission: &Value,
    test_masses: &[u64],
    in_loop: bool,
    cut: usize,
    adaptation: &str,
) -> (Value, Vec<Batch>) {
    let (mut columns, mut times, mut rows) = (Vec::new(), Vec::new(), Vec::new());
    for tm in test_masses {
        let (c, t, r) = columns_and_rows(*tm, 6_000);
        columns.extend(c);
        rows.extend(r);
        times = t;
    }
    // As if the offset's regressors were made from commands.
    for column in columns.iter_mut().filter(|c| in_loop && c.attributes.contains_key("coefficient")) {
        column.attributes.insert("in_loop".to_owned(), "true".to_owned());
    }
    let begin = || {
        let mut stage = create(mission, adaptation);
        let request = LinkRequest { available: &columns, model_json: &model_json(test_masses) };
        let linked = stage.link(request).expect("linked");
        stage.activate(65_536).expect("active");
        (stage, linked)
    };
    let (mut stage, linked) = begin();
    let mut made = Vec::new();
    for part in [0..cut, cut..times.len()] {
        if part.start > 0 {
            let saved = stage.save().expect("a state");
            stage = begin().0;
            stage.load(&saved).expect("its own state");
        }
        let table = |reads: &Vec<_>| -> Vec<&[f64]> { reads.iter().map(|r| column_of(r, &rows, &part)).collect() };
        let input: Vec<Rows<'_>> =
            linked.reads.iter().map(|reads| Rows { time_ns: &times[part.clone()], columns: table(reads) }).collect();
        made.extend(stage.process(&input, i64::MAX).expect("processed").expect("nothing is discarded"));
    }
    (serde_json::to_value(stage.report("[]").expect("a report")).expect("JSON"), made)
}

fn column_of<'a>(read: &ReadColumn, rows: &'a [Vec<f64>], part: &std::ops::Range<usize>) -> &'a [f64] {
    &rows[read.available][part.clone()]
}

/// Four states for x, three each for y and z: 9 + 3 + 10.
#[test]
fn a_mission_file_can_ask_for_the_papers_22_states() {
    let (report, made) = run(&mission([&[2, 2], &[4], &[4]]), &[1], false, 6_000);
    assert_eq!(report["quality"]["tm1"]["states"], 22, "{report}");
    assert_eq!(report["counts"]["updates"], 5_999, "{report}");
    // Every repair of Q̂ and of P reaches the product.
    assert!(report["counts"]["repairs_of_q"].is_u64() && report["counts"]["repairs_of_p"].is_u64(), "{report}");
    assert_eq!(made[0].rows(), 10);
    // The last columns, NIS and mean innovations, have no value before the end of the warm-up, which is the first row.
    let (estimates, consistency) = made[0].columns.split_at(made[0].columns.len() - 4);
    assert!(estimates.iter().flatten().all(|x| x.is_finite()));
    assert!(consistency.iter().all(|c| c[0].is_nan() && c[1..].iter().all(|x| x.is_finite())), "{consistency:?}");
    assert_eq!(run(&mission([&[], &[], &[]]), &[1], false, 6_000).0["quality"]["tm1"]["states"], 16);
}

/// 18 + 6 + two for each of three torques + 8 of the readouts. A run in two parts ends as one in one.
#[test]
fn regressors_in_the_loop_put_all_test_masses_into_one_filter() {
    let bundled = mission([&[], &[], &[]]);
    let (report, made) = run(&bundled, &[1, 2], true, 6_000);
    for tm in ["tm1", "tm2"] {
        assert_eq!(report["quality"][tm]["followed"], json!(["tm1", "tm2"]), "{report}");
        assert_eq!(report["quality"][tm]["states"], 38, "{report}");
    }
    // Forces on these two have nothing in common, so that some innovations are refused: but epochs count once.
    assert!(report["counts"]["updates"].as_u64().is_some_and(|n| (5_900..6_000).contains(&n)), "{report}");
    let (in_two, parts) = run(&bundled, &[1, 2], true, 2_500);
    assert_eq!(in_two, report);
    let rows = |made: &[Batch]| -> usize { made.iter().map(Batch::rows).sum() };
    assert_eq!(rows(&parts), rows(&made));
    // Without such an effect, and with one test mass, each has its own.
    for (report, test_masses) in [
        (run(&bundled, &[1, 2], false, 6_000).0, vec!["tm1", "tm2"]),
        (run(&bundled, &[2], true, 6_000).0, vec!["tm2"]),
    ] {
        for tm in test_masses {
            assert_eq!(report["quality"][tm]["followed"], json!([tm]), "{report}");
        }
    }
}

/// A mission file with a third test mass: 27 + 9 + 6 + 12 states in one filter, 16 in each of three.
#[test]
fn the_mission_says_how_many_test_masses_there_are() {
    let mut three = mission([&[], &[], &[]]);
    three["test_mass"]["tm3"] = three["test_mass"]["tm1"].clone();
    three["housing"]["between"] = json!(["tm1", "tm2"]);
    for (in_loop, followed, states) in [(true, json!(["tm1", "tm2", "tm3"]), 54), (false, json!(["tm3"]), 16)] {
        let (report, _) = run(&three, &[1, 2, 3], in_loop, 6_000);
        assert_eq!(report["quality"]["tm3"]["followed"], followed, "{report}");
        assert_eq!(report["quality"]["tm3"]["states"], states, "{report}");
        let coefficients = report["coefficients"].as_array().expect("a list");
        assert_eq!(coefficients.len(), 9);
        assert!(coefficients.iter().all(|c| c["value"].is_f64() && c["sigma"].as_f64() > Some(0.0)), "{report}");
    }
}

/// Adaptation that is asked for acts in a filter of several test masses as in one of one; `auto` leaves the former to
/// the mission's noise.
#[test]
fn a_filter_of_several_test_masses_adapts_where_it_is_asked_to() {
    let bundled = mission([&[], &[], &[]]);
    let p_end = |adaptation| {
        let (report, _) = run_adapting(&bundled, &[1, 2], true, 6_000, adaptation);
        assert_eq!(report["quality"]["tm1"]["followed"], json!(["tm1", "tm2"]), "{report}");
        assert!(report["coefficients"].as_array().is_some_and(|c| c.iter().all(|c| c["value"].is_f64())), "{report}");
        report["quality"]["p_end_sigma"].clone()
    };
    let off = p_end("off");
    assert_eq!(p_end("auto"), off);
    for adaptation in ["monotone", "innovation", "residual"] {
        assert_ne!(p_end(adaptation), off, "{adaptation}");
    }
}

/// 18 + 6 + 6 + 2·(10 + 9 + 5) states.
#[test]
fn test_masses_of_many_states_are_followed_in_one_filter_as_long_as_they_fit() {
    let (report, _) = run(&mission([&[8, 8], &[8, 8], &[8]]), &[1, 2], true, 6_000);
    assert_eq!(report["quality"]["tm2"]["followed"], json!(["tm1", "tm2"]), "{report}");
    assert_eq!(report["quality"]["tm2"]["states"], 78, "{report}");
    let coefficients = report["coefficients"].as_array().expect("a list");
    assert!(coefficients.iter().all(|c| c["value"].is_f64() && c["sigma"].as_f64() > Some(0.0)), "{report}");
}

/// 18 + 6 + 6 + 2·(14 + 13 + 13) states.
#[test]
fn test_masses_that_do_not_fit_into_one_filter_are_followed_apart_and_the_report_says_what_that_means() {
    let (report, _) = run(&mission([&[8, 8, 8], &[8, 8, 8], &[8, 8, 8]]), &[1, 2], true, 6_000);
    assert_eq!(report["quality"]["tm2"]["followed"], json!(["tm2"]), "{report}");
    let notes = report["notes"].to_string();
    assert!(notes.contains("would have 110 states, at most 96") && notes.contains("trust qp"), "{notes}");
}

#[test]
fn more_states_than_there_is_room_for_are_refused_with_their_number() {
    let (columns, ..) = columns_and_rows(1, 0);
    let many: &[u32] = &[8; 7];
    let mut stage = create(&mission([many, many, many]), "auto");
    let request = LinkRequest { available: &columns, model_json: &model_json(&[1]) };
    let refusal = stage.link(request).expect_err("100 states").to_string();
    assert!(refusal.contains("100 states, at most 96") && refusal.contains("readout noise"), "{refusal}");
}
