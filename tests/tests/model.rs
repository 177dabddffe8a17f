//! Model files with history and the ladder of revisions, as whole programs on two hours of telemetry.

use dragfree_tests::{compile_plugin, dragfree, expect, fixture, json, simulate};
use serde_json::Value;
use std::path::{Path, PathBuf};
use std::process::Command;

/// Cross-talk of the simulated test mass 1, covered by an effect in C built outside the workspace.
const CROSSTALK: f64 = 0.1;

/// A user's folder: a model, two hours of telemetry, one of them withheld from the fit, and a plugin.
struct Desk {
    dir: tempfile::TempDir,
    hours: [PathBuf; 2],
    truth: PathBuf,
}

impl Desk {
    /// Seeds 1 and 2, chosen before the first run.
    fn new() -> Self {
        let dir = tempfile::tempdir().expect("a temporary folder");
        let effect = format!("es-crosstalk:tm1.y-x={CROSSTALK}");
        let hours = [("one", "1", "2035-01-01"), ("two", "2", "2035-01-02")].map(|(name, seed, start)| {
            let folder = dir.path().join(name);
            std::fs::create_dir(&folder).expect("writable");
            simulate(&folder, &["--hours", "1", "--seed", seed, "--start", start, "--effect", &effect]).remove(0)
        });
        let truths = std::fs::read_dir(dir.path().join("one/truth")).expect("a truth").flatten().map(|e| e.path());
        let truth = truths.into_iter().find(|p| p.extension().is_some_and(|e| e == "mcap")).expect("a truth file");
        compile_plugin(dir.path(), "model_effects.c", "model_effects", &[]);
        std::fs::copy(fixture("models/com-offset.toml"), dir.path().join("m.toml")).expect("copied");
        Self { dir, hours, truth }
    }

    fn path(&self) -> &Path {
        self.dir.path()
    }

    fn command(&self, arguments: &[&str]) -> Command {
        let mut command = dragfree(self.path());
        command.args(arguments).arg("--plugin-dir").arg(self.path());
        command
    }

    /// Runs one hour; a weak or inconsistent result is accepted.
    fn run(&self, hour: usize, model: &str) -> Value {
        let mut command = dragfree(self.path());
        command.arg("run").arg(fixture("pipelines/science-mode.toml")).arg(&self.hours[hour]);
        command.args(["--archive", "archive", "--json", "--model", model, "--plugin-dir"]).arg(self.path());
        let output = command.output().expect("the program runs");
        assert!(matches!(output.status.code(), Some(0 | 4)), "{}", String::from_utf8_lossy(&output.stderr));
        serde_json::from_slice(&output.stdout).expect("JSON")
    }

    /// Two products: the model fitted to the first hour, and evaluated on the second with its coefficients but the
    /// offset fixed.
    fn fit_and_hold_out(&self) -> [String; 2] {
        let fitted = self.run(0, "m.toml");
        let id = fitted["id"].as_str().expect("an id");
        let made =
            json(&mut self.command(&["model", "fix", "m.toml", "--from", id, "--keep", "com-offset", "--json"]), 0);
        assert_eq!(made["parent"], fitted["model"]["revision"], "{made}");
        let held = self.run(1, "m.fixed.toml");
        let estimated = held["coefficients"].as_array().expect("coefficients");
        assert!(estimated.iter().all(|c| c["name"].as_str().is_some_and(|n| n.starts_with("com-offset."))), "{held}");
        assert_eq!(held["model"]["parent"], fitted["model"]["revision"]);
        [id.to_owned(), held["id"].as_str().expect("an id").to_owned()]
    }
}

fn text(command: &mut Command) -> String {
    String::from_utf8(expect(command, 0).stdout).expect("UTF-8")
}

fn narrow(text: &str) {
    for line in text.lines().filter(|line| !["model ", "history", "next", "file"].iter().any(|w| line.starts_with(w))) {
        assert!(line.chars().count() <= 80, "{} columns: {line}", line.chars().count());
    }
}

/// A true cross-talk of 10 % is added to the model, then a false one of the other test mass, fixed at 10 %. The first
/// improves the withheld hour; the second does not and is named.
#[test]
fn the_ladder_separates_useful_from_useless_effects() {
    let desk = Desk::new();
    let mut products = vec![desk.fit_and_hold_out()];
    let add = ["model", "add", "m.toml", "c-es-crosstalk:tm1.y-x", "--set", "scale=1.0", "--prior-sigma", "0.1"];
    let added = text(&mut desk.command(&add));
    narrow(&added);
    assert!(added.contains("added     c-es-crosstalk:tm1.y-x") && added.contains("dragfree run "), "{added}");
    products.push(desk.fit_and_hold_out());
    text(&mut desk.command(&["model", "add", "m.toml", "c-es-crosstalk:tm2.y-x", "--fixed", "0.1"]));
    products.push(desk.fit_and_hold_out());

    let truth = desk.truth.to_str().expect("text");
    let mut arguments = vec!["ladder"];
    // Not in order of ancestry.
    arguments.extend(products.iter().rev().map(|[fitted, _]| fitted.as_str()));
    arguments.push("--held-out");
    arguments.extend(products.iter().map(|[_, held]| held.as_str()));
    arguments.extend(["--truth", truth, "--picture", "ladder.svg"]);
    let screen = text(&mut desk.command(&arguments));
    narrow(&screen);
    assert!(screen.contains("over-fitted: c-es-crosstalk:tm2.y-x raises χ² by"), "{screen}");
    assert!(screen.contains("helps: c-es-crosstalk:tm1.y-x lowers χ² by"), "{screen}");
    let picture = std::fs::read_to_string(desk.path().join("ladder.svg")).expect("a picture");
    assert!(picture.contains("<svg") && picture.contains("com-offset.tm1.y"), "the picture shows the offsets");

    arguments.push("--json");
    let ladder = json(&mut desk.command(&arguments), 0);
    let rungs = ladder["revisions"].as_array().expect("revisions");
    let names: Vec<_> = rungs.iter().map(|r| r["revision"].as_str().expect("a name")).collect();
    assert_eq!((names[0], &names[1][..2], &names[2][..2]), ("1", "2-", "3-"));
    let parents: Vec<_> = rungs.iter().map(|r| r["parent"].as_str()).collect();
    assert_eq!(parents, [None, Some(names[0]), Some(names[1])]);

    // The decrease is (value/σ)² of the coefficient, whose Σ differs slightly from that of χ².
    let values = rungs[1]["coefficients"].as_array().expect("coefficients");
    let gain = values.iter().find(|c| c["name"] == "c-es-crosstalk.tm1.y-x").expect("the effect's coefficient");
    let (value, sigma) = (gain["value"].as_f64().expect("a value"), gain["sigma"].as_f64().expect("a sigma"));
    assert!((value - CROSSTALK).abs() < 5.0 * sigma, "{value} ± {sigma}");
    let fall = |rung: &Value| rung["fall"]["delta_chi2"].as_f64().expect("a fall");
    let promised = (value / sigma).powi(2);
    assert!((0.7..1.4).contains(&(fall(&rungs[1]) / promised)), "{} of {promised}", fall(&rungs[1]));
    assert_eq!(rungs[1]["held_out"]["verdict"], "helps");
    assert!(fall(&rungs[1]["held_out"]) > 0.5 * promised, "an hour like the first: {}", rungs[1]["held_out"]);
    assert_eq!(rungs[2]["held_out"]["verdict"], "over-fitted");
    assert!(fall(&rungs[2]["held_out"]) < 0.0 && fall(&rungs[2]) < 0.0);
    assert_eq!(ladder["over_fitted"][0]["effects"], serde_json::json!(["c-es-crosstalk:tm2.y-x"]));
    // The truth named by the user.
    let offset = &rungs[1]["coefficients"].as_array().expect("coefficients")[1];
    assert_eq!(offset["name"], "com-offset.tm1.y");
    let (error, truth) = (offset["error"].as_f64().expect("known"), offset["truth"].as_f64().expect("known"));
    assert!(
        (offset["value"].as_f64().expect("a value") - truth - error).abs() < 1e-12 && (truth - 0.1554).abs() < 1e-4
    );

    // Fitted data cannot be withheld, under the same revision or a descendant.
    for (held_out, part) in [(&products[0][0], "dragfree model fix"), (&products[1][0], "has seen 2035-01-01 already")]
    {
        let mut wrong = desk.command(&["ladder", &products[0][0], "--held-out", held_out]);
        let said = String::from_utf8_lossy(&expect(&mut wrong, 1).stderr).into_owned();
        assert!(said.contains("cannot be held out") && said.contains(part), "{said}");
    }
}

#[test]
fn every_change_makes_a_revision_that_can_be_shown() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let original = std::fs::read_to_string(fixture("models/com-offset.toml")).expect("readable");
    std::fs::write(dir.path().join("m.toml"), &original).expect("writable");
    let model = |arguments: &[&str]| {
        let mut command = dragfree(dir.path());
        command.arg("model").args(arguments);
        command
    };
    let effects =
        |revision: &str| json(&mut model(&["show", "m.toml", "--revision", revision, "--json"]), 0)["effects"].clone();
    let first = json(&mut model(&["show", "m.toml", "--json"]), 0);
    assert_eq!(first["revision"], "1");

    let removed = json(&mut model(&["remove", "m.toml", "com-offset:tm2", "--json"]), 0);
    let second = removed["revision"].as_str().expect("a revision");
    assert_eq!((&removed["before"], &removed["parent"]), (&Value::from("1"), &Value::from("1")));
    let added = json(&mut model(&["add", "m.toml", "com-offset:tm2", "--json"]), 0);
    let third = added["revision"].as_str().expect("a revision");
    assert_eq!(added["changes"], serde_json::json!([{"effect": "com-offset:tm2", "what": "added"}]));
    assert_eq!(effects(third), first["effects"], "what comes and goes leaves no trace");
    assert_eq!(effects("1"), first["effects"]);
    assert_eq!(effects("2").as_array().map(Vec::len), Some(1));
    let now = std::fs::read_to_string(dir.path().join("m.toml")).expect("readable");
    assert!(now.starts_with("# The model that every mission starts with"), "{now}");
    assert_eq!(std::fs::read_to_string(dir.path().join("m.history/1.toml")).expect("kept"), original);

    // An edit by hand, followed by a command.
    std::fs::write(dir.path().join("m.toml"), now.replacen("estimate = true", "estimate = false", 1))
        .expect("writable");
    let shown = text(&mut model(&["show", "m.toml"]));
    narrow(&shown);
    assert!(shown.contains("edited by hand") && shown.contains("fixed"), "{shown}");
    let restored = text(&mut model(&["restore", "m.toml", "1"]));
    narrow(&restored);
    assert!(restored.contains("edited by hand since revision 3-"), "{restored}");
    let log = json(&mut model(&["log", "m.toml", "--json"]), 0);
    let names: Vec<_> =
        log["revisions"].as_array().expect("revisions").iter().map(|r| r["revision"].as_str()).collect();
    assert_eq!(names.len(), 5, "{log}");
    assert_eq!((names[2], names[3], names[4]), (Some(third), Some(second), Some("1")));
    let logged = text(&mut model(&["log", "m.toml"]));
    narrow(&logged);
    assert!(logged.contains("− com-offset:tm2") && logged.contains("~ com-offset:tm1 (estimate)"), "{logged}");

    // Errors list the alternatives and change nothing.
    let before = std::fs::read(dir.path().join("m.toml")).expect("readable");
    for (arguments, part) in [
        (&["add", "m.toml", "com-offset:tm3"][..], "no instance `tm3`; it has tm1, tm2"),
        (&["add", "m.toml", "com-offset:tm1"], "in the model already"),
        (&["add", "m.toml", "no-such-effect:tm1"], "no effect `no-such-effect`"),
        (&["add", "m.toml", "com-offset:tm1", "--set", "colour=1"], "`colour` is no parameter"),
        (&["remove", "m.toml", "com-offset"], "2 times: name the instance"),
        (&["remove", "m.toml", "es-gain:tm1.y"], "is not in the model"),
        (&["restore", "m.toml", "77"], "no revision 77"),
        (&["show", "nothing.toml"], "cannot be read"),
    ] {
        let said = String::from_utf8_lossy(&expect(&mut model(arguments), 1).stderr).into_owned();
        assert!(said.contains(part), "{arguments:?}: {said}");
    }
    assert_eq!(std::fs::read(dir.path().join("m.toml")).expect("readable"), before);
    assert!(!dir.path().join("m.toml.lock").exists());
}
