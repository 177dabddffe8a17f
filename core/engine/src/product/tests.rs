use super::*;
use crate::feed::Summary;
use chrono::{DateTime, Utc};
use dragfree_schema::{Report, Settings};
use proptest::prelude::*;
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::path::Path;

const ZERO_DIGEST: &str = "0000000000000000000000000000000000000000000000000000000000000000";

fn created(seconds: i64) -> DateTime<Utc> {
    DateTime::from_timestamp(seconds, 0).expect("in range")
}

fn report(json: Value) -> Report {
    serde_json::from_value(json).expect("a report")
}

fn qp_report(value: f64) -> Value {
    json!({
        "plugin": "qp-check",
        "coefficients": [
            {"name": "com-offset.tm1.x", "solution": "qp", "value": value, "sigma": 1e-4, "unit": "m", "frame": "ORF_1"},
            {"name": "com-offset.tm1.y", "solution": "qp", "value": 0.1557, "sigma": null, "unit": "m", "frame": "ORF_1"},
        ],
        "covariance": {"qp": {"names": ["com-offset.tm1.x", "com-offset.tm1.y"], "matrix": [[1e-8, null], [null, 2.5e-9]]}},
        "verdict": "weak",
        "weak_directions": ["com-offset.tm1.y"],
        "chi2_per_dof": 1.01,
        "commands": "telemetered",
        "epochs_used": 99,
        "epochs_rejected": 1,
        "counts": {"rows": 100},
        "notes": ["the prior was not needed"],
        "quality": {"condition": 12.5, "missing": null, "tried": 3},
        "attachments": [{"suffix": "neq.json", "text": "{}"}],
    })
}

fn draft(value: f64) -> Draft {
    Draft {
        pipeline: "science-mode".into(),
        product: "COM1B".into(),
        release: 1,
        mission: "Taiji".into(),
        spacecraft: "SC1".into(),
        first_ns: 2_051_222_400_000_000_000,
        last_ns: 2_051_222_409_900_000_000,
        inputs: vec![Input { role: "telemetry".into(), name: "a.mcap".into(), size: 7, sha256: ZERO_DIGEST.into() }],
        history: vec![Stage {
            plugin: "qp-check".into(),
            instance: String::new(),
            kind: "stage".into(),
            version: "0.1.0".into(),
            abi: "1".into(),
            library_sha256: ZERO_DIGEST.into(),
            parameters_sha256: ZERO_DIGEST.into(),
        }],
        model: Model {
            revision: "1".into(),
            parent: None,
            effects: vec!["com-offset".into()],
            noise_levels: Vec::new(),
        },
        software: "0.1.0".into(),
        replay: Summary {
            time_scale: "UTC".into(),
            counts: BTreeMap::from([("gaps".into(), 2)]),
            notes: vec!["a topic is not in the interface".into()],
            ..Summary::default()
        },
        reports: vec![
            report(json!({"plugin": "es-akf", "nis": 0.99, "epochs_used": 100, "verdict": null})),
            report(qp_report(value)),
        ],
        settings: Default::default(),
        created: created(1_800_000_000),
    }
}

fn write(folder: &Path, draft: &Draft) -> Written {
    ProductWriter::begin(folder).expect("begin").commit(draft).expect("commit")
}

fn visible(folder: &Path) -> Vec<String> {
    let mut names: Vec<_> = std::fs::read_dir(folder)
        .expect("folder")
        .map(|entry| entry.expect("entry").file_name().into_string().expect("text"))
        .collect();
    names.sort();
    names
}

#[test]
fn a_product_reads_as_it_was_written() {
    let folder = tempfile::tempdir().expect("folder");
    let written = write(folder.path(), &draft(0.0909));
    assert_eq!(written.path.file_name().expect("name"), "COM1B_2035-01-01_SC1_01_0001.toml");
    let back = read(&written.path).expect("read");
    assert_eq!(format!("{back:?}"), format!("{:?}", written.product));
    assert_eq!(back.quality.epochs_used, 99, "the last stage has the word");
    assert!((back.quality.nis - 0.99).abs() < 1e-15, "what the last stage leaves open stays with an earlier one");
    assert!(back.quality.notes.contains(&"qp-check: the prior was not needed".to_owned()));
    assert_eq!(
        visible(folder.path()),
        ["COM1B_2035-01-01_SC1_01_0001.neq.json", "COM1B_2035-01-01_SC1_01_0001.toml"],
        "nothing of the transaction stays"
    );
}

#[test]
fn a_failed_last_step_leaves_nothing() {
    let folder = tempfile::tempdir().expect("folder");
    let mut writer = ProductWriter::begin(folder.path()).expect("begin");
    std::fs::write(writer.staged_unlisted("sources.json"), "{}").expect("written");
    let refused = ProductError::Full("test".into());
    let error = writer.commit_with(&draft(0.0909), || Err(refused)).expect_err("the last step failed");
    assert!(matches!(error, ProductError::Full(_)), "{error}");
    assert_eq!(visible(folder.path()), Vec::<String>::new());
    let mut writer = ProductWriter::begin(folder.path()).expect("begin");
    std::fs::write(writer.staged_unlisted("sources.json"), "{}").expect("written");
    writer.commit(&draft(0.0909)).expect("committed");
    assert_eq!(visible(folder.path()).len(), 3, "product, attachment, sources");
    assert!(list(folder.path()).expect("list").problems.is_empty(), "the sources of a product are no leftover");
}

#[test]
fn a_day_of_two_spacecraft_is_asked_about() {
    let folder = tempfile::tempdir().expect("folder");
    let other = Draft { spacecraft: "SC2".into(), ..draft(0.1) };
    for draft in [&draft(0.0909), &draft(0.0910), &other] {
        write(folder.path(), draft);
    }
    let error = find(folder.path(), "2035-01-01").expect_err("which one?").to_string();
    assert!(error.contains("name one of COM1B_2035-01-01_SC1_01, COM1B_2035-01-01_SC2_01"), "{error}");
    let one = find(folder.path(), "COM1B_2035-01-01_SC1_01").expect("the latest of one spacecraft");
    assert_eq!(one.product.id(), "COM1B_2035-01-01_SC1_01_0002");
}

#[test]
fn a_note_is_told_once_with_its_stage() {
    let folder = tempfile::tempdir().expect("folder");
    let mut draft = draft(0.0909);
    draft.reports[0].notes = vec!["es-akf: slow".to_owned(), "es-akf is slow".to_owned()];
    let notes = write(folder.path(), &draft).product.quality.notes;
    assert!(
        notes.contains(&"es-akf: slow".to_owned()) && notes.contains(&"es-akf: es-akf is slow".to_owned()),
        "{notes:?}"
    );
}

#[test]
fn json_has_the_keys_of_the_contract_and_null_for_missing_numbers() {
    let folder = tempfile::tempdir().expect("folder");
    let Written { product, path } = write(folder.path(), &draft(0.0909));
    let json = to_json(&product, &path);
    assert_eq!(json["id"], "COM1B_2035-01-01_SC1_01_0001");
    assert_eq!(json["path"], path.to_string_lossy().as_ref());
    assert_eq!(json["epochs_used"], 99);
    assert_eq!(json["epochs_rejected"], 1);
    assert_eq!(json["commands"], "telemetered");
    assert_eq!(
        json["coefficients"][1],
        json!({"name": "com-offset.tm1.y", "solution": "qp", "value": 0.1557, "sigma": null, "unit": "m", "frame": "ORF_1"})
    );
    assert_eq!(json["covariance"]["qp"], json!([[1e-8, null], [null, 2.5e-9]]));
    assert_eq!(json["covariance_names"]["qp"], json!(["com-offset.tm1.x", "com-offset.tm1.y"]));
    assert_eq!(json["verdict"], "weak");
    assert_eq!(json["weak_directions"], json!(["com-offset.tm1.y"]));
    assert_eq!(json["chi2_per_dof"], 1.01);
    assert_eq!(json["nis"], 0.99);
    assert_eq!(json["model"]["revision"], "1");
    assert_eq!(json["model"]["effects"], json!(["com-offset"]));
}

#[test]
fn a_run_without_results_still_makes_a_product() {
    let folder = tempfile::tempdir().expect("folder");
    let empty = Draft { reports: Vec::new(), history: Vec::new(), inputs: Vec::new(), ..draft(0.0) };
    let Written { product, path } = write(folder.path(), &empty);
    let json = to_json(&product, &path);
    assert_eq!((&json["verdict"], &json["nis"], &json["commands"]), (&Value::Null, &Value::Null, &Value::Null));
    assert_eq!(json["coefficients"], json!([]));
}

#[test]
fn the_digest_knows_the_result_and_not_the_clock() {
    let folder = tempfile::tempdir().expect("folder");
    let digest = |draft: &Draft| write(folder.path(), draft).product.header.non_standard_attributes.sha256;
    let first = digest(&draft(0.0909));
    assert_eq!(first, digest(&Draft { created: created(1_900_000_000), ..draft(0.0909) }));
    assert_ne!(first, digest(&draft(f64::from_bits(0.0909_f64.to_bits() + 1))), "one bit of the value counts");
    let mut other_plugin = draft(0.0909);
    other_plugin.history[0].version = "0.1.1".into();
    assert_ne!(first, digest(&other_plugin));
}

/// A product of a version with a threshold that is gone and without one that is new has the digest of its own text.
#[test]
fn thresholds_of_other_versions_are_no_damage() {
    let folder = tempfile::tempdir().expect("folder");
    let Written { product, path } = write(folder.path(), &draft(0.0909));
    let text = std::fs::read_to_string(&path).expect("read");
    let mut document = serde_json::to_value(&product).expect("document");
    let settings = document["settings"].as_object_mut().expect("thresholds");
    settings.insert("gone".to_owned(), json!(3.5));
    settings.remove("false_alarm").expect("a threshold");
    document["header"]["global_attributes"]["id"] = json!("");
    document["header"]["global_attributes"]["date_created"] = json!("");
    document["header"]["non_standard_attributes"]["revision"] = json!(0);
    document["header"]["non_standard_attributes"]["sha256"] = json!("");
    document.sort_all_objects();
    let digest = crate::files::sha256(document.to_string().into_bytes());
    let without: Vec<&str> = text.lines().filter(|line| !line.starts_with("false_alarm = ")).collect();
    let other = without.join("\n").replace("[settings]\n", "[settings]\ngone = 3.5\n");
    let other = other.replace(&product.header.non_standard_attributes.sha256, &digest);
    std::fs::write(&path, &other).expect("write");
    let found = read(&path).expect("a sound product");
    assert_eq!(found.settings, Settings::default());
    std::fs::write(&path, other.replace("gone = 3.5", "gone = 3.6")).expect("write");
    assert!(matches!(read(&path), Err(ProductError::Damaged { .. })), "a changed threshold is damage");
}

#[test]
fn a_second_run_is_the_next_revision_and_says_what_changed() {
    let folder = tempfile::tempdir().expect("folder");
    let first = write(folder.path(), &draft(0.0909));
    let text = std::fs::read(&first.path).expect("read");
    let second = write(folder.path(), &draft(0.0909));
    assert_eq!(second.product.id(), "COM1B_2035-01-01_SC1_01_0002");
    assert_eq!(text, std::fs::read(&first.path).expect("read"), "the first is untouched");
    let supersedes = second.product.supersedes.expect("an earlier revision");
    assert_eq!(supersedes.id, first.product.id());
    assert_eq!(supersedes.reason, "run again, same result");
    let mut late = draft(0.0909);
    late.inputs[0].size = 8;
    let third = write(folder.path(), &late).product.supersedes.expect("an earlier revision");
    assert_eq!((third.id.as_str(), third.reason.as_str()), ("COM1B_2035-01-01_SC1_01_0002", "changed: inputs"));
}

#[test]
fn concurrent_writers_get_a_revision_each_with_their_own_attachments() {
    const WRITERS: u32 = 8;
    let folder = tempfile::tempdir().expect("folder");
    std::thread::scope(|scope| {
        for writer in 0..WRITERS {
            let folder = folder.path();
            scope.spawn(move || {
                let mut transaction = ProductWriter::begin(folder).expect("begin");
                let series = transaction.staged("mcap");
                std::fs::write(series, format!("{writer}")).expect("write");
                transaction.commit(&draft(f64::from(writer))).expect("commit");
            });
        }
    });
    let listing = list(folder.path()).expect("list");
    assert!(listing.problems.is_empty(), "{:?}", listing.problems);
    let revisions = listing.entries.iter().map(|entry| entry.product.header.non_standard_attributes.revision);
    assert!(revisions.eq(1..=WRITERS), "no revision lost, none twice");
    assert_eq!(listing.entries.iter().filter(|entry| entry.latest).count(), 1);
    for entry in &listing.entries {
        let beside = std::fs::read_to_string(entry.path.with_extension("mcap")).expect("series");
        assert_eq!(beside, format!("{}", entry.product.result.coefficients[0].value));
    }
}

/// Whoever claimed a revision may find that it is not its to write, and give it up: the next writer waits for it and
/// leaves no gap.
#[test]
fn a_claim_that_is_given_up_leaves_no_gap() {
    let folder = tempfile::tempdir().expect("folder");
    let claim = folder.path().join(".COM1B_2035-01-01_SC1_01_0001.claim");
    std::fs::write(&claim, "").expect("write");
    std::thread::scope(|scope| {
        let writer = scope.spawn(|| write(folder.path(), &draft(0.0909)));
        std::thread::sleep(std::time::Duration::from_millis(200));
        std::fs::remove_file(&claim).expect("the claim");
        let written = writer.join().expect("a product");
        assert_eq!(written.product.id(), "COM1B_2035-01-01_SC1_01_0001");
    });
}

#[test]
fn a_claim_or_a_file_left_by_a_killed_writer_costs_a_revision_and_nothing_else() {
    let folder = tempfile::tempdir().expect("folder");
    std::fs::write(folder.path().join(".COM1B_2035-01-01_SC1_01_0001.claim"), "").expect("write");
    std::fs::write(folder.path().join("COM1B_2035-01-01_SC1_01_0002.mcap"), "half").expect("write");
    let written = write(folder.path(), &draft(0.0909));
    assert_eq!(written.product.id(), "COM1B_2035-01-01_SC1_01_0003");
    assert_eq!(list(folder.path()).expect("list").problems.len(), 1, "the orphan is reported");
}

#[test]
fn a_failed_commit_leaves_nothing() {
    let folder = tempfile::tempdir().expect("folder");
    let mut bad = draft(0.0909);
    bad.replay.time_scale = "Mars".into();
    let error = ProductWriter::begin(folder.path()).expect("begin").commit(&bad).expect_err("no such time scale");
    let said = error.to_string();
    assert!(said.contains("/header/non_standard_attributes/time_scale") && said.contains("Mars"), "{said}");
    assert!(visible(folder.path()).is_empty(), "{:?}", visible(folder.path()));
}

#[test]
fn names_that_would_break_the_product_name_are_refused() {
    let folder = tempfile::tempdir().expect("folder");
    for spacecraft in ["", "SC_1", "../SC1", "SC1\0"] {
        let bad = Draft { spacecraft: spacecraft.into(), ..draft(0.0) };
        let error = ProductWriter::begin(folder.path()).expect("begin").commit(&bad).expect_err("refused");
        assert!(matches!(error, ProductError::Name { what: "the spacecraft", .. }), "{error}");
    }
    for suffix in ["toml", "../x", "", "a/b"] {
        let mut bad = draft(0.0);
        bad.reports[1].attachments[0].suffix = suffix.into();
        let error = ProductWriter::begin(folder.path()).expect("begin").commit(&bad).expect_err("refused");
        assert!(matches!(error, ProductError::Attachment { .. }), "{suffix:?}: {error}");
    }
}

#[test]
fn what_was_changed_after_archiving_is_refused_and_reported() {
    let folder = tempfile::tempdir().expect("folder");
    let path = write(folder.path(), &draft(0.0909)).path;
    let sound = std::fs::read_to_string(&path).expect("read");
    let damage = [
        (sound.replace("0.0909", "0.0908"), "its digest is"),
        (sound.replace("verdict = \"weak\"", "verdict = \"superb\""), "/result/verdict"),
        (sound.replace("[result]", "[result]\nmood = 1"), "/result"),
        (sound.replace("format_version = \"1.0.0\"", "format_version = \"2.0.0\""), "format version 2.0.0"),
        (sound[..sound.len() / 2].to_owned(), "COM1B"),
        ("\0\0\0".to_owned(), "is no product"),
    ];
    for (text, expected) in damage {
        assert_ne!(text, sound, "{expected}");
        std::fs::write(&path, text).expect("write");
        let listing = list(folder.path()).expect("list goes on");
        assert!(listing.entries.is_empty());
        assert!(listing.problems[0].reason.contains(expected), "{:?} lacks {expected:?}", listing.problems[0]);
        assert!(find(folder.path(), "COM1B_2035-01-01_SC1_01_0001").is_err());
    }
    std::fs::write(&path, &sound).expect("write");
    std::fs::remove_file(path.with_extension("neq.json")).expect("remove");
    let problems = list(folder.path()).expect("list").problems;
    assert!(problems[0].reason.contains("neq.json"), "{problems:?}");
}

#[test]
fn a_product_is_found_by_id_by_day_and_without_its_revision() {
    let folder = tempfile::tempdir().expect("folder");
    write(folder.path(), &draft(1.0));
    write(folder.path(), &draft(2.0));
    let found = |id: &str| find(folder.path(), id).map(|entry| entry.product.id().to_owned());
    assert_eq!(found("COM1B_2035-01-01_SC1_01_0001").expect("id"), "COM1B_2035-01-01_SC1_01_0001");
    assert_eq!(found("COM1B_2035-01-01_SC1_01").expect("stem"), "COM1B_2035-01-01_SC1_01_0002");
    assert_eq!(found("2035-01-01").expect("day"), "COM1B_2035-01-01_SC1_01_0002");
    assert!(matches!(found("2035-01-02"), Err(ProductError::NotFound { .. })));
    let days = |first: &str, last: &str| {
        let [first, last] = [first, last].map(|day| day.parse().expect("a day"));
        find_days(folder.path(), first, last)
            .map(|all| all.iter().map(|entry| entry.product.id().to_owned()).collect::<Vec<_>>())
    };
    assert_eq!(days("2034-12-31", "2035-01-05").expect("days"), ["COM1B_2035-01-01_SC1_01_0002"]);
    assert!(matches!(days("2035-01-02", "2035-01-05"), Err(ProductError::NotFound { .. })));
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    /// Every finite value and every name survives the file, bit for bit.
    #[test]
    fn floats_and_texts_survive(
        value in any::<f64>().prop_filter("finite", |v| v.is_finite()),
        sigma in prop_oneof![Just(f64::MIN_POSITIVE), Just(5e-324), Just(f64::MAX), 0.0..1e-12_f64],
        note in any::<String>(),
    ) {
        let folder = tempfile::tempdir().expect("folder");
        let mut draft = draft(value);
        draft.reports[1].coefficients[0].sigma = Some(sigma);
        draft.reports[1].notes = vec![note.clone()];
        draft.reports[1].covariance.get_mut("qp").expect("a covariance").matrix[0][0] = value;
        let product = read(&write(folder.path(), &draft).path).expect("read");
        prop_assert_eq!(product.result.coefficients[0].value.to_bits(), value.to_bits());
        prop_assert_eq!(product.result.coefficients[0].sigma.to_bits(), sigma.to_bits());
        prop_assert_eq!(product.result.covariance["qp"].matrix[0][0].to_bits(), value.to_bits());
        prop_assert!(product.result.covariance["qp"].matrix[0][1].is_nan());
        prop_assert_eq!(&product.quality.notes[1], &format!("qp-check: {note}"));
    }
}
