//! The stage through the plugin interface.

mod common;

use common::{START_NS, append, columns, library, link, process, telemetry, topics};
use dragfree_engine::table::Batch;

#[test]
fn the_grid_keeps_unit_frame_and_attributes_of_every_column() {
    let columns = columns(&topics());
    let (_stage, linked) = link(&library(), &columns).unwrap();
    let grid = &linked.writes[0];
    // The additional column is the age of the packet held on board.
    assert_eq!((grid.name.as_str(), grid.rate_hz, grid.columns.len()), ("grid", 10.0, columns.len() + 1));
    assert!(grid.columns.iter().any(|c| c.name == "ephemeris.age_s" && c.unit == "s"));
    for (read, written) in columns.iter().zip(grid.columns.iter().filter(|c| c.name != "ephemeris.age_s")) {
        assert_eq!((&read.unit, &read.frame), (&written.unit, &written.frame));
    }
    let names: Vec<&str> = grid.columns.iter().map(|c| c.name.as_str()).collect();
    for name in ["is.tm1.r_orf_m.x", "dws.sc_crf_rad.phi", "command.tm2.force_orf_n.y", "ephemeris.sun_srf.z"] {
        assert!(names.contains(&name), "{name}");
    }
    let field = grid.columns.iter().find(|c| c.name == "hk.field").unwrap();
    assert_eq!((field.attributes["place"].as_str(), field.attributes["source_rate_hz"].as_str()), ("bus", "0.1"));
}

#[test]
fn a_missing_topic_is_named_with_those_found() {
    for missing in ["is", "dws"] {
        let mut topics = topics();
        topics.retain(|t| t.name != missing);
        let error = link(&library(), &columns(&topics)).err().unwrap();
        assert!(error.contains(&format!("topic {missing} is missing")) && error.contains("ephemeris"), "{error}");
    }
    let mut topics = topics();
    topics.retain(|t| t.name != "command" && t.name != "ifo");
    assert!(link(&library(), &columns(&topics)).is_ok());
}

#[test]
fn wrong_units_frames_and_missing_fields_are_refused_by_name() {
    let good = columns(&topics());
    for (change, words) in [
        (("is", "tm1.r_orf_m.y", "mm", "ORF_1"), "tm1.r_orf_m.y"),
        (("dws", "sc_crf_rad.psi", "rad", "SRF"), "sc_crf_rad.psi"),
    ] {
        let mut bad = good.clone();
        let column = bad.iter_mut().find(|c| c.table == change.0 && c.name == change.1).unwrap();
        (column.unit, column.frame) = (change.2.to_owned(), change.3.to_owned());
        let error = link(&library(), &bad).err().unwrap();
        assert!(error.contains(words), "{error}");
    }
    let less: Vec<_> = good.into_iter().filter(|c| c.name != "tm2.r_orf_m.z").collect();
    let error = link(&library(), &less).err().unwrap();
    assert!(error.contains("tm2.r_orf_m.z"), "{error}");
}

#[test]
fn rows_and_report_do_not_depend_on_batches_or_saved_states() {
    let (library, topics) = (library(), topics());
    let (available, mut data) = (columns(&topics), telemetry(&topics, 1_500));
    // One NaN, one infinity, a raised flag, and ten seconds without the interferometers.
    data[0].columns[1][700] = f64::NAN;
    data[0].columns[2][800] = f64::INFINITY;
    data[2].columns[7][900] = 4.0;
    data[1].time_ns.drain(1_000..1_100);
    data[1].columns.iter_mut().for_each(|c| drop(c.drain(1_000..1_100)));
    let run = |rows: i64, restore: bool| {
        let (mut stage, linked) = link(&library, &available).unwrap();
        let mut all = Batch::empty(available.len());
        let end_ns = START_NS + 1_500 * 1_000_000_000;
        let mut from_ns = START_NS;
        while from_ns < end_ns {
            let to_ns = (from_ns + rows * 100_000_000).min(end_ns);
            append(&mut all, process(&mut stage, &linked, &topics, &data, from_ns, to_ns));
            from_ns = to_ns;
            if restore {
                let state = stage.save().unwrap();
                stage = link(&library, &available).unwrap().0;
                stage.load(&state).unwrap();
            }
        }
        append(&mut all, stage.flush().unwrap().remove(0));
        let bits: Vec<Vec<u64>> = all.columns.iter().map(|c| c.iter().map(|v| v.to_bits()).collect()).collect();
        (all.time_ns, bits, serde_json::to_value(stage.report("[]").unwrap()).unwrap())
    };
    let whole = run(65_536, false);
    assert!(whole == run(1, false) && whole == run(777, true));
    assert_eq!(whole.0, (0..15_000).map(|k| START_NS + k * 100_000_000).collect::<Vec<_>>());
    let report = &whole.2;
    // The capacitive x replaces the interferometers and test mass 2 suffices at 700 and 800; without attitude, 900 is
    // lost.
    assert_eq!((&report["epochs_used"], &report["epochs_rejected"]), (&14_999.into(), &1.into()));
    assert_eq!(report["data_loss"], true);
    let counts =
        [("is.nan_values", 1), ("is.infinite_values", 1), ("dws.status_values", 3), ("ifo.missing_epochs", 100)];
    for (name, count) in counts {
        assert_eq!(report["counts"][name], count, "{name} in {report}");
    }
}

#[test]
fn a_foreign_state_is_refused() {
    let (mut stage, _) = link(&library(), &columns(&topics())).unwrap();
    let error = stage.load(b"{}").err().unwrap().to_string();
    assert!(error.contains("state of preprocess"), "{error}");
}
