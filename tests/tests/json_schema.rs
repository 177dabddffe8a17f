//! The JSON Schema beside plugin.h is that of the types. With `DRAGFREE_WRITE_SCHEMA=1` this test writes it anew.

use dragfree_schema::{Coefficient, Constraint, Manifest, Model, NoiseProcess, Report, Settings};
use schemars::{JsonSchema, schema_for};
use std::path::Path;

fn committed<T: JsonSchema>(name: &str) {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../core/abi/include/dragfree/schema");
    let path = folder.join(format!("{name}.schema.json"));
    let made = serde_json::to_string_pretty(&schema_for!(T)).expect("JSON") + "\n";
    if std::env::var_os("DRAGFREE_WRITE_SCHEMA").is_some() {
        std::fs::create_dir_all(&folder).expect("the folder");
        std::fs::write(&path, &made).expect("written");
    }
    let there = std::fs::read_to_string(&path).unwrap_or_default();
    let again = "DRAGFREE_WRITE_SCHEMA=1 cargo test --release -p dragfree-tests --test programs json_schema";
    assert!(there == made, "{} is not the schema of {name}; run `{again}`", path.display());
}

#[test]
fn the_committed_schemas_are_those_of_the_types() {
    committed::<Manifest>("manifest");
    committed::<Coefficient>("coefficient");
    committed::<Constraint>("constraint");
    committed::<NoiseProcess>("noise_process");
    committed::<Model>("model");
    committed::<Report>("report");
    committed::<Settings>("settings");
}

/// The examples of the guide are declarations: nothing in them is left out when they are read.
#[test]
fn the_declarations_of_the_guide_are_declarations() {
    let guide = include_str!("../../ops-guide/src/plugins.md");
    let examples: Vec<&str> = guide.split("```json\n").skip(1).filter_map(|rest| rest.split("```").next()).collect();
    let (noise, coefficients): (Vec<_>, Vec<_>) = examples.into_iter().partition(|e| e.contains("noise_processes"));
    assert_eq!((noise.len(), coefficients.len()), (1, 2));
    let attributes: serde_json::Value = serde_json::from_str(noise[0]).expect("JSON");
    let declared: Vec<NoiseProcess> = serde_json::from_value(attributes["noise_processes"].clone()).expect("noise");
    assert!(declared.len() == 2 && declared.iter().all(|process| process.check().is_ok()));
    for text in coefficients {
        let example: serde_json::Value = serde_json::from_str(text).expect("JSON");
        let read: Coefficient = serde_json::from_str(text).expect("a coefficient");
        let again = serde_json::to_value(&read).expect("JSON");
        for (key, value) in example.as_object().expect("an object") {
            assert_eq!(again[key], *value, "{key}");
        }
    }
}
