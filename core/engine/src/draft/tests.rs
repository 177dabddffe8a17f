use super::*;
use dragfree_archive::product::{Input, Model, Stage, read, to_json};
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
            fixed_from: None,
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
        settings: Settings::default(),
        stream: Stream::Oper,
        status: Status::Final,
        created: created(1_800_000_000),
    }
}

fn write(folder: &Path, draft: &Draft) -> Written {
    commit(folder, draft).expect("commit")
}

fn commit(folder: &Path, draft: &Draft) -> Result<Written, ArchiveError> {
    draft.commit(ProductWriter::begin(folder)?, MadeOf::default())
}

fn visible(folder: &Path) -> Vec<String> {
    let mut names: Vec<_> = std::fs::read_dir(folder)
        .expect("folder")
        .map(|entry| entry.expect("entry").file_name().into_string().expect("text"))
        .filter(|name| name.starts_with("COM1B"))
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
    assert_eq!(back.header.non_standard_attributes.stream, Stream::Oper);
    assert_eq!(back.header.non_standard_attributes.status, Status::Final);
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
    let digest = dragfree_archive::files::sha256(document.to_string().into_bytes());
    let without: Vec<&str> = text.lines().filter(|line| !line.starts_with("false_alarm = ")).collect();
    let other = without.join("\n").replace("[settings]\n", "[settings]\ngone = 3.5\n");
    let other = other.replace(&product.header.non_standard_attributes.sha256, &digest);
    std::fs::write(&path, &other).expect("write");
    let found = read(&path).expect("a sound product");
    assert_eq!(found.settings, Settings::default());
    std::fs::write(&path, other.replace("gone = 3.5", "gone = 3.6")).expect("write");
    assert!(matches!(read(&path), Err(ArchiveError::Damaged { .. })), "a changed threshold is damage");
}

#[test]
fn a_failed_commit_leaves_nothing() {
    let folder = tempfile::tempdir().expect("folder");
    let mut bad = draft(0.0909);
    bad.replay.time_scale = "Mars".into();
    let error = commit(folder.path(), &bad).expect_err("no such time scale");
    let said = error.to_string();
    assert!(said.contains("/header/non_standard_attributes/time_scale") && said.contains("Mars"), "{said}");
    assert!(visible(folder.path()).is_empty(), "{:?}", visible(folder.path()));
}

#[test]
fn names_that_would_break_the_product_name_are_refused() {
    let folder = tempfile::tempdir().expect("folder");
    for spacecraft in ["", "SC_1", "../SC1", "SC1\0"] {
        let bad = Draft { spacecraft: spacecraft.into(), ..draft(0.0) };
        let error = commit(folder.path(), &bad).expect_err("refused");
        assert!(matches!(error, ArchiveError::Name { what: "the spacecraft", .. }), "{error}");
    }
    for suffix in ["toml", "../x", "", "a/b"] {
        let mut bad = draft(0.0);
        bad.reports[1].attachments[0].suffix = suffix.into();
        let error = commit(folder.path(), &bad).expect_err("refused");
        assert!(matches!(error, ArchiveError::Attachment { .. }), "{suffix:?}: {error}");
    }
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
