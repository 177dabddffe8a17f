//! The bill of materials of a release: every crate that is linked into program and plugins, as CycloneDX 1.5.

use crate::Failure;
use crate::dist::cargo;
use serde_json::{Map, Value, json};
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

/// The bill of what `roots`, crates of the workspace, are made of. It has neither time nor serial number, so that the
/// same source gives the same bytes.
pub(crate) fn make(root: &Path, version: &str, roots: &BTreeSet<String>) -> Result<String, Failure> {
    let host = host()?;
    let arguments = ["metadata", "--offline", "--locked", "--format-version", "1", "--filter-platform", &host];
    let metadata: Value = serde_json::from_slice(&cargo(root, &arguments)?)?;
    let checksums = checksums(&std::fs::read_to_string(root.join("Cargo.lock"))?)?;
    let packages: BTreeMap<&str, &Value> =
        of(&metadata["packages"]).filter_map(|p| Some((p["id"].as_str()?, p))).collect();
    let linked = linked(&metadata["resolve"]["nodes"], &packages, roots);
    let mut components = Vec::new();
    let mut dependencies = Vec::new();
    for (id, needs) in &linked {
        let package = packages.get(id).ok_or_else(|| format!("cargo metadata has no package {id}"))?;
        components.push(component(package, &checksums));
        let on: Vec<String> = needs.iter().filter_map(|id| packages.get(id)).map(|p| reference(p)).collect();
        dependencies.push(json!({ "ref": reference(package), "dependsOn": on }));
    }
    let own = json!({ "type": "application", "bom-ref": "dragfree", "name": "dragfree", "version": version });
    let bill = json!({
        "bomFormat": "CycloneDX",
        "specVersion": "1.5",
        "version": 1,
        "metadata": { "component": own },
        "components": components,
        "dependencies": dependencies,
    });
    Ok(format!("{bill:#}\n"))
}

/// The platform that this program was built for.
fn host() -> Result<String, Failure> {
    let rustc = std::env::var_os("RUSTC").unwrap_or_else(|| "rustc".into());
    let text = crate::dist::output(std::process::Command::new(rustc).arg("-vV"))?;
    let text = String::from_utf8(text)?;
    let line = text.lines().find_map(|line| line.strip_prefix("host: ")).ok_or("rustc names no host")?;
    Ok(line.to_owned())
}

fn of(array: &Value) -> impl Iterator<Item = &Value> {
    array.as_array().into_iter().flatten()
}

/// Packages that are linked into the roots, with those that each needs itself; what only builds or tests need is none.
fn linked<'a>(
    nodes: &'a Value,
    packages: &BTreeMap<&'a str, &'a Value>,
    roots: &BTreeSet<String>,
) -> BTreeMap<&'a str, Vec<&'a str>> {
    let is_linked = |dependency: &&Value| of(&dependency["dep_kinds"]).any(|kind| kind["kind"].is_null());
    let needs: BTreeMap<&str, Vec<&str>> = of(nodes)
        .filter_map(|node| {
            let all = of(&node["deps"]).filter(is_linked).filter_map(|d| d["pkg"].as_str());
            Some((node["id"].as_str()?, all.collect()))
        })
        .collect();
    let is_root = |id: &&str| packages[id]["name"].as_str().is_some_and(|name| roots.contains(name));
    let mut waiting: Vec<&str> = packages.keys().copied().filter(is_root).collect();
    let mut found = BTreeMap::new();
    while let Some(id) = waiting.pop() {
        let own = needs.get(id).cloned().unwrap_or_default();
        if found.insert(id, own.clone()).is_none() {
            waiting.extend(own);
        }
    }
    found
}

/// `pkg:cargo/NAME@VERSION`
fn reference(package: &Value) -> String {
    let text = |key: &str| package[key].as_str().unwrap_or_default();
    format!("pkg:cargo/{}@{}", text("name"), text("version"))
}

fn component(package: &Value, checksums: &BTreeMap<(String, String), String>) -> Value {
    let text = |key: &str| package[key].as_str().unwrap_or_default().to_owned();
    let mut component = Map::new();
    component.insert("type".to_owned(), json!("library"));
    component.insert("bom-ref".to_owned(), json!(reference(package)));
    component.insert("name".to_owned(), json!(text("name")));
    component.insert("version".to_owned(), json!(text("version")));
    component.insert("purl".to_owned(), json!(reference(package)));
    if let Some(sha256) = checksums.get(&(text("name"), text("version"))) {
        component.insert("hashes".to_owned(), json!([{ "alg": "SHA-256", "content": sha256 }]));
    }
    if let Some(licence) = package["license"].as_str() {
        // An older way to write OR.
        let expression = licence.replace('/', " OR ");
        component.insert("licenses".to_owned(), json!([{ "expression": expression }]));
    }
    Value::Object(component)
}

/// Checksums of the lock file, by name and version.
fn checksums(lock: &str) -> Result<BTreeMap<(String, String), String>, Failure> {
    let lock: toml_edit::DocumentMut = lock.parse()?;
    let packages = lock["package"].as_array_of_tables().ok_or("Cargo.lock names no packages")?;
    let text = |package: &toml_edit::Table, key: &str| Some(package.get(key)?.as_str()?.to_owned());
    let entry = |p: &toml_edit::Table| Some(((text(p, "name")?, text(p, "version")?), text(p, "checksum")?));
    Ok(packages.iter().filter_map(entry).collect())
}
