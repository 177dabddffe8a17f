//! An archive as its users have it: damage is noticed, products are made again elsewhere, sets say what holds when.

use dragfree_tests::{built, dragfree, expect, fixture, json, simulate};
use serde_json::{Value, json};
use std::path::{Path, PathBuf};
use std::process::Command;
use tempfile::TempDir;

const FIRST: &str = "COM1B_2035-01-01_SC1_01_0001";
const SECOND: &str = "COM1B_2035-01-01_SC1_01_0002";

/// A folder with half an hour of telemetry in `data`, a model file of its own, and its product in `archive`.
fn mission() -> (TempDir, PathBuf) {
    mission_of("0.5")
}

/// The same with so many hours.
fn mission_of(hours: &str) -> (TempDir, PathBuf) {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let data = dir.path().join("data");
    std::fs::create_dir(&data).expect("a folder");
    let telemetry = simulate(&data, &["--hours", hours]).remove(0);
    std::fs::copy(fixture("models/com-offset.toml"), dir.path().join("model.toml")).expect("copied");
    json(&mut run(dir.path(), &telemetry, &[]), 0);
    (dir, telemetry)
}

fn run(folder: &Path, telemetry: &Path, arguments: &[&str]) -> Command {
    let mut command = dragfree(folder);
    command.arg("run").arg(fixture("pipelines/science-mode.toml")).arg(telemetry).args(["--model", "model.toml"]);
    command.args(["--json"]).args(arguments);
    command
}

fn products(folder: &Path, arguments: &[&str]) -> Command {
    let mut command = dragfree(folder);
    command.arg("products").args(arguments);
    command
}

fn told(command: &mut Command) -> String {
    String::from_utf8(expect(command, 1).stderr).expect("text")
}

/// A flipped bit in any file beside a product passes neither `list`, `show` nor `ladder`; `rebuild` mends it.
#[test]
fn a_flipped_bit_is_noticed_by_every_command_and_mended_by_rebuild() {
    let (dir, _) = mission();
    for suffix in ["mcap", "neq.json", "state", "toml"] {
        let path = dir.path().join("archive").join(format!("{FIRST}.{suffix}"));
        let sound = std::fs::read(&path).expect("readable");
        let mut damaged = sound.clone();
        let middle = damaged.len() / 2;
        damaged[middle] ^= 1;
        std::fs::write(&path, &damaged).expect("writable");
        let list = json(&mut products(dir.path(), &["list", "--json"]), 0);
        assert_eq!(list["products"], json!([]), "{suffix}");
        assert_eq!(list["problems"].as_array().map(Vec::len), Some(1), "{suffix}");
        for command in [vec!["products", "show", FIRST], vec!["ladder", FIRST], vec!["compare", FIRST]] {
            let error = told(dragfree(dir.path()).args(&command));
            assert!(error.contains("is damaged") && error.contains(suffix), "{command:?}: {error}");
        }
        let verified = json(&mut products(dir.path(), &["verify", "--json"]), 1);
        assert_eq!(verified["broken"][0]["what"], FIRST);
        assert_eq!(verified["broken"][0]["can_be_rebuilt"], true);
        let rebuilt = json(&mut products(dir.path(), &["rebuild", FIRST, "--json"]), 0);
        assert_eq!((&rebuilt["same"], &rebuilt["mended"]), (&json!(true), &json!([suffix])), "{rebuilt:#}");
        assert_eq!(std::fs::read(&path).expect("readable"), sound, "{suffix}");
        assert_eq!(json(&mut products(dir.path(), &["verify", "--all", "--json"]), 0)["broken"], json!([]));
    }
}

/// The archive alone, carried to another place with the telemetry somewhere else, gives every product again.
#[test]
fn a_product_is_made_again_from_a_copy_of_the_archive_and_telemetry_found_by_digest() {
    let (dir, telemetry) = mission();
    let state = ["--until", "2035-01-01T00:20:00Z", "--save-state", "state"];
    json(&mut run(dir.path(), &telemetry, &state), 0);
    json(&mut run(dir.path(), &telemetry, &["--load-state", "state", "--stream", "oper", "--final"]), 0);
    let other = tempfile::tempdir().expect("a temporary folder");
    expect(Command::new("cp").arg("-r").arg(dir.path().join("archive")).arg(other.path()), 0);
    let hidden = other.path().join("tapes/2035");
    std::fs::create_dir_all(&hidden).expect("a folder");
    std::fs::rename(&telemetry, hidden.join("another-name.mcap")).expect("renamed");
    drop(dir);
    let error = told(&mut products(other.path(), &["rebuild", FIRST]));
    assert!(error.contains("--inputs DIR"), "{error}");
    for revision in 1..=3 {
        let id = format!("COM1B_2035-01-01_SC1_01_000{revision}");
        let rebuilt = json(&mut products(other.path(), &["rebuild", &id, "--inputs", "tapes", "--json"]), 0);
        assert_eq!((&rebuilt["same"], &rebuilt["same_state"]), (&json!(true), &json!(true)), "{id}: {rebuilt:#}");
    }
    let third = json(&mut products(other.path(), &["show", "2035-01-01", "--json"]), 0);
    assert_eq!(third["id"], "COM1B_2035-01-01_SC1_01_0003");
    let lineage = json(&mut products(other.path(), &["lineage", "2035-01-01", "--json"]), 0);
    assert_eq!(lineage["resumed"], json!([SECOND]));
    let text = expect(&mut products(other.path(), &["lineage", SECOND, "--picture", "l.svg"]), 0);
    let text = String::from_utf8(text.stdout).expect("text");
    assert!(text.contains("resumed by COM1B_2035-01-01_SC1_01_0003"), "{text}");
    let picture = std::fs::read_to_string(other.path().join("l.svg")).expect("a picture");
    assert!(picture.contains("another-name.mcap") || picture.contains("SC1_2035-01-01.mcap"));
}

/// Plugins' libraries of another build are another origin, and the digest says so; that all the rest is the same is
/// told.
#[test]
fn a_product_made_again_with_other_libraries_has_another_digest_and_the_same_result() {
    let (dir, _) = mission();
    let other = dir.path().join("other build");
    std::fs::create_dir(&other).expect("a folder");
    for entry in std::fs::read_dir(built()).expect("a folder").flatten() {
        let (name, path) = (entry.file_name(), entry.path());
        if name == "dragfree" || path.extension().is_some_and(|e| e == std::env::consts::DLL_EXTENSION) {
            let mut content = std::fs::read(&path).expect("readable");
            content.extend(if name == "dragfree" { &b""[..] } else { b"another build" });
            std::fs::write(other.join(&name), content).expect("writable");
        }
    }
    let program = other.join("dragfree");
    std::fs::set_permissions(&program, std::fs::metadata(built().join("dragfree")).expect("there").permissions())
        .expect("a program");
    let rebuild = |more: &[&str], code: i32| {
        let mut command = Command::new(&program);
        command.current_dir(dir.path()).env_remove("DRAGFREE_PLUGIN_PATH").args(["products", "rebuild", FIRST]);
        expect(command.args(more), code)
    };
    let rebuilt: Value = serde_json::from_slice(&rebuild(&["--json"], 1).stdout).expect("JSON");
    assert_eq!((&rebuilt["same"], &rebuilt["same_but_libraries"]), (&json!(false), &json!(true)), "{rebuilt:#}");
    let told = String::from_utf8(rebuild(&[], 1).stdout).expect("text");
    let words = told.split_whitespace().collect::<Vec<_>>().join(" ");
    assert!(words.contains("all that was found is the same, to the last bit"), "{told}");
    let sound = json(&mut products(dir.path(), &["rebuild", FIRST, "--json"]), 0);
    assert_eq!((&sound["same"], &sound["same_but_libraries"]), (&json!(true), &json!(true)), "{sound:#}");
}

/// Another model, or an edited mission file, is named as what differs.
#[test]
fn an_earlier_product_stays_comparable_and_the_differences_are_named() {
    let (dir, telemetry) = mission();
    expect(dragfree(dir.path()).args(["model", "add", "model.toml", "stiffness:tm1.x"]), 0);
    let second = json(&mut run(dir.path(), &telemetry, &["--stream", "oper", "--final"]), 0);
    // The model file has changed since the first product was made: its own model is in the archive.
    let rebuilt = json(&mut products(dir.path(), &["rebuild", FIRST, "--json"]), 0);
    assert_eq!(rebuilt["same"], true);
    let diff = json(&mut products(dir.path(), &["diff", FIRST, SECOND, "--json"]), 0);
    assert_eq!(diff["same"], false);
    let names = |what: &str| {
        let all = diff[what].as_array().expect("changes");
        all.iter().map(|c| c["what"].as_str().expect("a name").to_owned()).collect::<Vec<_>>()
    };
    assert_eq!(names("model"), ["revision", "effect stiffness"]);
    assert_eq!(names("inputs"), ["model model.toml"]);
    assert!(names("plugins").iter().any(|name| name == "stiffness:tm1.x"), "{diff:#}");
    let values = diff["values"].as_array().expect("values");
    let offset = values.iter().find(|v| v["name"] == "com-offset.tm1.x").expect("an offset");
    let [a, b] = ["first", "second"].map(|side| offset[side].as_f64().expect("a value"));
    let sigma = ["first_sigma", "second_sigma"].map(|s| offset[s].as_f64().expect("σ")).into_iter().fold(0.0, f64::max);
    let sigmas = offset["sigmas"].as_f64().expect("a ratio");
    assert!((sigmas - (b - a) / sigma).abs() < 1e-12);
    assert_eq!(json(&mut products(dir.path(), &["diff", FIRST, FIRST, "--json"]), 0)["same"], true);
    let list = json(&mut products(dir.path(), &["list", "--json"]), 0);
    let stream = |i: usize| (list["products"][i]["stream"].clone(), list["products"][i]["status"].clone());
    assert_eq!(stream(0), (json!("TEST"), json!("quicklook")));
    assert_eq!(stream(1), (json!("OPER"), json!("final")));
    assert_eq!(second["id"], SECOND);
}

#[test]
fn a_set_says_which_calibration_holds_at_a_time() {
    let (dir, telemetry) = mission();
    json(&mut run(dir.path(), &telemetry, &[]), 0);
    let at = |time: &str, code: i32| -> Value {
        let output = expect(dragfree(dir.path()).args(["at", time, "--json"]), code);
        serde_json::from_slice(&output.stdout).unwrap_or_default()
    };
    at("2035-01-05T12:00Z", 1);
    let certify = |from: &str, until: &str, code: i32| {
        let arguments = ["certify", FIRST, "--from", from, "--until", until, "--into", "ops"];
        String::from_utf8(expect(&mut products(dir.path(), &arguments), code).stderr).expect("text")
    };
    certify("2035-01-01", "2035-02-01", 0);
    assert!(certify("2035-01-31", "2035-02-02", 1).contains("overlaps"));
    let found = at("2035-01-05T12:00Z", 0);
    let calibration = &found["calibrations"][0];
    let product = json(&mut products(dir.path(), &["show", FIRST, "--json"]), 0);
    assert_eq!((&calibration["id"], &calibration["sha256"]), (&product["id"], &product["sha256"]));
    assert_eq!(calibration["covariance"], product["covariance"]["adopted"]);
    let adopted: Vec<&Value> =
        product["coefficients"].as_array().expect("all").iter().filter(|c| c["solution"] == "adopted").collect();
    for (a, b) in calibration["coefficients"].as_array().expect("coefficients").iter().zip(adopted) {
        assert_eq!((&a["name"], &a["value"], &a["sigma"]), (&b["name"], &b["value"], &b["sigma"]));
    }
    at("2035-02-01", 1); // the end is not part of the time
    expect(
        &mut products(
            dir.path(),
            &["decertify", "--from-set", "ops", "--spacecraft", "SC1", "--from", "2035-01-05", "--until", "2035-01-06"],
        ),
        0,
    );
    at("2035-01-05T12:00Z", 1);
    at("2035-01-06", 0);
    expect(&mut products(dir.path(), &["sets", "publish", "ops"]), 0);
    assert!(certify("2035-01-05", "2035-01-06", 1).contains("set ops is published"));
    let withdrawn = expect(&mut products(dir.path(), &["withdraw", FIRST, "--reason", "wrong survey"]), 0);
    assert!(String::from_utf8_lossy(&withdrawn.stdout).contains("set ops still names it"));
    let error = told(dragfree(dir.path()).args(["at", "2035-01-06"]));
    assert!(error.contains("withdrawn: wrong survey"), "{error}");
    let list = json(&mut products(dir.path(), &["list", "--latest", "--json"]), 0);
    assert_eq!(list["products"].as_array().map(Vec::len), Some(1));
    assert_eq!(list["products"][0]["id"], SECOND);
    expect(&mut products(dir.path(), &["sets", "invalidate", "ops", "--reason", "wrong survey"]), 0);
    assert!(told(dragfree(dir.path()).args(["at", "2035-01-06"])).contains("nothing is certified"));
    expect(dragfree(dir.path()).args(["archive", "reindex"]), 0);
    assert!(told(dragfree(dir.path()).args(["at", "2035-01-06"])).contains("nothing is certified"));
}

/// Who publishes a set signs what it says. Another key, a change of the statement, of the set or of a product is told,
/// also where whoever changed the archive has made its digests anew.
#[test]
fn a_set_that_was_signed_is_compared_with_what_it_was() {
    let (dir, _) = mission();
    let dir = dir.path();
    let certify = ["certify", FIRST, "--from", "2035-01-01", "--until", "2035-02-01", "--into", "ops"];
    expect(&mut products(dir, &certify), 0);
    let check = |key: &str, code: i32| {
        let output = expect(&mut products(dir, &["sets", "check", "ops.toml", "--key", key]), code);
        String::from_utf8_lossy(&[output.stdout, output.stderr].concat()).into_owned()
    };
    let keys = minisign::KeyPair::generate_unencrypted_keypair().expect("keys");
    let others = minisign::KeyPair::generate_unencrypted_keypair().expect("keys");
    let (own, other) = (keys.pk.to_base64(), others.pk.to_base64());
    let statement = dir.join("ops.toml");
    let sign = || {
        let text = std::fs::read(&statement).expect("readable");
        // minisign takes comments of up to 8,192 bytes.
        let comment = "as flown, ".repeat(800);
        let signed = minisign::sign(Some(&keys.pk), &keys.sk, text.as_slice(), Some(&comment), None).expect("signed");
        std::fs::write(dir.join("ops.toml.minisig"), signed.into_string()).expect("written");
    };
    let state = ["sets", "statement", "ops", "--out", "ops.toml"];
    expect(&mut products(dir, &state), 0);
    assert!(check(&own, 1).contains("ops.toml.minisig cannot be read"));
    sign();
    assert!(check(&own, 0).contains("set ops, open: 1 times"));
    assert!(check(&other, 1).contains("is not signed with the key that was given"));
    expect(&mut products(dir, &["sets", "publish", "ops"]), 0);
    assert!(check(&own, 1).contains("the set was open, and is published"));
    expect(&mut products(dir, &state), 0);
    assert!(check(&own, 1).contains("is not signed with the key that was given"));
    sign();
    let printed = expect(&mut products(dir, &["sets", "statement", "ops"]), 0).stdout;
    assert_eq!(printed, std::fs::read(&statement).expect("readable"));
    assert!(check(&own, 0).contains("published"));
    // An archive with the same names and times, whose digests all agree with other contents.
    let (forged, _) = mission_of("0.6");
    expect(&mut products(forged.path(), &certify), 0);
    expect(&mut products(forged.path(), &["sets", "publish", "ops"]), 0);
    expect(&mut products(forged.path(), &["verify"]), 0);
    for file in ["ops.toml", "ops.toml.minisig"] {
        std::fs::copy(dir.join(file), forged.path().join(file)).expect("copied");
    }
    let found = told(&mut products(forged.path(), &["sets", "check", "ops.toml", "--key", &own]));
    assert!(found.contains("no longer: ") && found.contains("not signed: "), "{found}");
}

#[test]
fn a_product_is_exported_for_other_programs() {
    let (dir, _) = mission();
    let product = json(&mut products(dir.path(), &["show", FIRST, "--json"]), 0);
    let text = |format: &str| {
        let output = expect(&mut products(dir.path(), &["export", FIRST, "--format", format]), 0);
        String::from_utf8(output.stdout).expect("text")
    };
    let csv = text("csv");
    let rows: Vec<Vec<&str>> = csv.lines().skip(1).map(|line| line.split(',').collect()).collect();
    let coefficients = product["coefficients"].as_array().expect("coefficients");
    assert_eq!(rows.len(), coefficients.len());
    for (row, c) in rows.iter().zip(coefficients) {
        assert_eq!((row[3], row[4]), (c["solution"].as_str().expect("text"), c["name"].as_str().expect("text")));
        assert_eq!(row[5].parse::<f64>().expect("a number"), c["value"].as_f64().expect("a number"));
        assert_eq!(row[6].parse::<f64>().expect("a number"), c["sigma"].as_f64().expect("a number"));
    }
    let vcm = text("vcm1b");
    let (header, records) = vcm.split_once("# End of YAML header\n").expect("a header");
    let header: serde_yaml_ng::Value = serde_yaml_ng::from_str(header).expect("YAML");
    assert_eq!(header["header"]["dimensions"]["num_records"].as_u64(), Some(2));
    assert_eq!(header["header"]["variables"].as_sequence().map(Vec::len), Some(8));
    for (record, test_mass) in records.lines().zip(["tm1", "tm2"]) {
        let fields: Vec<&str> = record.split(' ').collect();
        assert_eq!((fields.len(), fields[1], fields[2]), (8, "SC1", test_mass));
        // 2035-01-01T00:29:59.9 UTC: 12784.5 days after 2000-01-01T12:00, and 18 s between GPS time and UTC.
        assert_eq!(fields[0].parse::<i64>().expect("seconds"), 12_783 * 86_400 + 43_200 + 1_799 + 18);
        let number = |i: usize| fields[i].parse::<f64>().expect("a number");
        for (axis, i) in [("x", 4), ("y", 5), ("z", 6)] {
            let name = format!("com-offset.{test_mass}.{axis}");
            let of = |c: &&Value| c["name"] == *name && c["solution"] == "adopted";
            let value = coefficients.iter().find(of).expect("a coefficient")["value"].as_f64().expect("a number");
            assert!((number(3) * number(i) - value).abs() < 1e-12, "{name}");
        }
    }
    assert_eq!(serde_json::from_str::<Value>(&text("json")).expect("JSON")["sha256"], product["sha256"]);
}
