//! The workbench: what its switches say, what a reader does with it in a browser, and what it refuses.

use std::io::{BufRead as _, BufReader, Read as _, Write as _};
use std::net::TcpStream;
use std::os::unix::fs::PermissionsExt as _;
use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::sync::{Mutex, MutexGuard, OnceLock, PoisonError};
use std::time::{Duration, Instant};

use dragfree_tests::browser::{Browser, Ended, get, request, send};
use dragfree_tests::calibration::TRUTH_M;
use dragfree_tests::{compile_plugin, dragfree, expect, fixture, json, root, simulate};
use serde_json::{Value, json};
use tempfile::TempDir;

/// Hidden on both days, eight σ of two hours.
const EFFECT: &str = "mps-tilt:sc.z";
const SIZE_RAD: f64 = 0.08;

const DAYS: [&str; 2] = ["COM1B_2035-01-01_SC1_01_0001", "COM1B_2035-01-02_SC1_01_0001"];

/// Two days of two hours with a hidden effect, calibrated with the offset alone and diagnosed.
struct Flight {
    folder: TempDir,
    diagnosis: Value,
    truth: PathBuf,
}

fn flight() -> &'static Flight {
    static FLIGHT: OnceLock<Flight> = OnceLock::new();
    FLIGHT.get_or_init(|| {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let at = folder.path();
        std::fs::copy(fixture("models/com-offset.toml"), at.join("model.toml")).expect("copied");
        let mut diagnosis = Value::Null;
        for (day, seed) in [("2035-01-02", "72"), ("2035-01-01", "71")] {
            let effect = format!("{EFFECT}={SIZE_RAD}");
            let out = at.join(day);
            std::fs::create_dir(&out).expect("a new folder");
            let file = simulate(&out, &["--hours", "2", "--start", day, "--seed", seed, "--effect", &effect]).remove(0);
            let run = calibrate(at, &file, "archive");
            assert!(matches!(run, 0 | 4), "{run}");
            diagnosis = json(dragfree(at).args(["diagnose", day, "--keep-extract", "--json"]), 4);
        }
        let truth = at.join("2035-01-01/truth/SC1_2035-01-01.mcap");
        Flight { folder, diagnosis, truth }
    })
}

/// One test at a time: they measure times.
fn alone() -> MutexGuard<'static, ()> {
    static ALONE: Mutex<()> = Mutex::new(());
    ALONE.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Calibrates a file with the flight's model into an archive; gives the exit code.
fn calibrate(folder: &Path, file: &Path, archive: &str) -> i32 {
    let mut run = dragfree(folder);
    run.arg("run").arg(fixture("pipelines/science-mode.toml")).arg(file);
    run.args(["--model", "model.toml", "--json", "--archive", archive]);
    run.output().expect("runs").status.code().unwrap_or(-1)
}

/// A server of the flight's archive, ended with this.
struct Server {
    process: Ended,
    port: u16,
    token: String,
}

fn serve(folder: &Path, more: &[&str]) -> Server {
    let mut command = dragfree(folder);
    command.args(["serve", "--listen", "127.0.0.1:0", "--json"]).args(more);
    let mut child = command.stdout(Stdio::piped()).spawn().expect("starts");
    let mut line = String::new();
    BufReader::new(child.stdout.take().expect("piped")).read_line(&mut line).expect("a line");
    let ready: Value = serde_json::from_str(&line).unwrap_or_else(|e| panic!("{e}: {line:?}"));
    let address = ready["address"].as_str().expect("an address");
    let port = address.trim_end_matches('/').rsplit(':').next().and_then(|port| port.parse().ok()).expect("a port");
    let token = ready["token"].as_str().unwrap_or_default().to_owned();
    Server { process: Ended(child), port, token }
}

fn number(value: &Value) -> f64 {
    value.as_f64().unwrap_or_else(|| panic!("no number: {value}"))
}

fn refit(port: u16, query: &str) -> Value {
    let answer = get(port, &format!("/refit.json?{query}"));
    assert_eq!(answer.status, 200, "{answer:?}");
    serde_json::from_str(&answer.body).unwrap_or_else(|e| panic!("{e}: {}", answer.body))
}

fn offset<'a>(rung: &'a Value, name: &str) -> &'a Value {
    let all = rung["offsets"].as_array().expect("offsets");
    all.iter().find(|o| o["name"] == name).unwrap_or_else(|| panic!("no {name} in {rung}"))
}

/// A switch gives what a diagnosis of the same product gives: from its extract to rounding, from its telemetry nearly.
/// Size, σ, fall of χ², offsets and what the absence does to them. The other day, kept out, is predicted better with
/// the effect. A run with the kept effect, by another estimator, gives the same offsets, and both are near the truth.
#[test]
fn a_switch_says_what_the_diagnosis_says_and_the_run_confirms() {
    let (_alone, flight) = (alone(), flight());
    let server = serve(flight.folder.path(), &[]);
    let on = refit(server.port, &format!("products={}&on={EFFECT}", DAYS[0]));
    let effect = &on["effects"][0];
    let summed = json(dragfree(flight.folder.path()).args(["diagnose", DAYS[0], "--extracts", "--json"]), 4);
    let near = |a: &Value, b: &Value, scale: f64, what: &str| {
        assert!((number(a) - number(b)).abs() < scale, "{what}: {a} {b}");
    };
    // From the same extract by other code, and from the telemetry. The two differ in where the model is linear.
    for (diagnosis, part) in [(&summed, 1e-6), (&flight.diagnosis, 0.2)] {
        let found = &diagnosis["candidates"][0];
        assert_eq!((effect["name"].as_str(), &found["accepted"]), (Some(EFFECT), &Value::Bool(true)), "{found:#}");
        let sigma = number(&found["sigma"]);
        near(&effect["coefficients"][0]["value"], &found["value"], part * sigma, "size");
        near(&effect["coefficients"][0]["sigma"], &found["sigma"], part * sigma, "σ");
        // χ² of a value of λ σ that is moved by a part of σ changes by 2λ times that.
        let fall = number(&found["delta_chi2"]);
        near(&effect["delta_chi2"], &found["delta_chi2"], part * 2.0 * fall.sqrt(), "fall");
        near(&on["rungs"][1]["fall"], &found["delta_chi2"], part * 2.0 * fall.sqrt(), "fall of the rung");
        for (name, truth) in TRUTH_M {
            let [before, after] = [0, 1].map(|k| offset(&on["rungs"][k], name));
            let diagnosed = diagnosis["offsets"].as_array().expect("offsets");
            let diagnosed = diagnosed.iter().find(|o| o["coefficient"] == name).expect("an offset");
            let sigma = number(&diagnosed["sigma_m"]);
            near(&after["value_m"], &diagnosed["value_m"], part * sigma, name);
            near(&after["sigma_m"], &diagnosed["sigma_m"], part * sigma, name);
            near(&effect["offset_shift_m"][name], &found["offset_shift_m"][name], part * sigma, name);
            let moved = number(&before["value_m"]) - number(&after["value_m"]);
            assert!((moved - number(&effect["offset_shift_m"][name])).abs() < 1e-6 * sigma, "{name}");
            // Six offsets within 4.5σ: a false alarm in 2e4.
            assert!((number(&after["value_m"]) - truth).abs() < 4.5 * sigma, "{name}: {after}");
        }
    }
    let held = refit(server.port, &format!("products={}&held={}&on={EFFECT}", DAYS.join(","), DAYS[1]));
    // Of λ² = 59 on a day, with a standard deviation of 2λ, some is lost by the error of the other day.
    let (fall, held_out) = (number(&held["rungs"][1]["fall"]), number(&held["rungs"][1]["held_out_fall"]));
    assert!(held_out > 5.0 && (held_out - fall).abs() < 4.5 * 2.0 * 2.0_f64.sqrt() * fall.sqrt(), "{held:#}");
    assert_eq!(held["held_out"], json!([DAYS[1]]));

    let folder = flight.folder.path();
    std::fs::copy(folder.join("model.toml"), folder.join("proof.toml")).expect("copied");
    expect(dragfree(folder).args(["model", "add", "proof.toml", EFFECT]), 0);
    let mut run = dragfree(folder);
    run.arg("run").arg(fixture("pipelines/science-mode.toml")).arg("2035-01-01/SC1_2035-01-01.mcap");
    let product = json(run.args(["--model", "proof.toml", "--archive", "proof", "--json"]), 0);
    for (name, _) in TRUTH_M {
        let (value, sigma) = dragfree_tests::coefficient(&product, name, "adopted");
        let refitted = number(&offset(&on["rungs"][1], name)["value_m"]);
        // The likelihood is efficient: the difference from another estimate of the same data has the difference of the
        // variances (Hausman, 1978), and a tenth of σ is left to the linearisation.
        let efficient = number(&offset(&on["rungs"][1], name)["sigma_m"]);
        let bound = 4.5 * (sigma.powi(2) - efficient.powi(2)).max(0.0).sqrt() + 0.1 * sigma;
        assert!((value - refitted).abs() < bound, "{name}: run {value} ± {sigma}, refit {refitted} ± {efficient}");
    }
}

/// Frequencies above which groups of bands are made of the same segments by whoever sums them, Hz.
const SAME_SEGMENTS_HZ: f64 = 0.05;

/// Mean of measured over predicted power between two frequencies as a comparison from telemetry has it: its bands
/// weighed by their observations, which follow from the width of their intervals.
fn compared(comparison: &Value, channel: &str, [first, last]: [f64; 2]) -> Option<f64> {
    let channel = comparison["channels"].as_array()?.iter().find(|c| c["name"] == channel)?;
    let numbers = |key: &str| channel[key].as_array().cloned().unwrap_or_default();
    let (hz, measured, predicted) = (numbers("frequency_hz"), numbers("measured_psd"), numbers("predicted_psd"));
    let (mut weight, mut sum) = (0.0, 0.0);
    for (k, interval) in numbers("interval_95").iter().enumerate() {
        if (0.999 * first..1.001 * last).contains(&number(&hz[k])) {
            // The width of the logarithm of χ² over its degrees of freedom goes with the root of their inverse.
            let observations = (number(&interval[1]) / number(&interval[0])).ln().powi(-2);
            weight += observations;
            sum += observations * number(&measured[k]) / number(&predicted[k]);
        }
    }
    (weight > 0.0).then(|| sum / weight)
}

/// The spectra of a switch are those that a comparison reads from the telemetry: with the model alone, and with the
/// effect those of runs that have it, within a standard deviation, as the test weighs bands by what it is told of them;
/// and what the effect changes to three thousandths, where it changes more than four times that somewhere. Hours that
/// are kept out of the fit are predicted better with the effect, and together with those of the fit they fall as the
/// whole does.
#[test]
fn spectra_and_hours_of_a_switch_are_those_of_the_telemetry() {
    let (_alone, flight) = (alone(), flight());
    let folder = flight.folder.path();
    let server = serve(folder, &[]);
    std::fs::copy(folder.join("model.toml"), folder.join("spectra.toml")).expect("copied");
    expect(dragfree(folder).args(["model", "add", "spectra.toml", EFFECT]), 0);
    for day in ["2035-01-01", "2035-01-02"] {
        let mut run = dragfree(folder);
        run.arg("run").arg(fixture("pipelines/science-mode.toml")).arg(format!("{day}/SC1_{day}.mcap"));
        expect(run.args(["--model", "spectra.toml", "--archive", "spectra"]), 0);
    }
    let read = |archive: &str| {
        let mut compare = dragfree(folder);
        let output = compare.args(["compare", "2035-01-01..2035-01-02", "--json", "--archive", archive]).output();
        serde_json::from_slice::<Value>(&output.expect("runs").stdout).expect("a JSON document")
    };
    let telemetry = [read("archive"), read("spectra")];
    let both = refit(server.port, &format!("products={}&on={EFFECT}", DAYS.join(",")));
    let (before, now) = (&both["spectra"]["before"], &both["spectra"]["now"]);
    let (mut cells, mut most) = (0, 0.0_f64);
    for (c, channel) in now["channels"].as_array().expect("channels").iter().enumerate() {
        let name = channel["name"].as_str().expect("a name");
        for (g, ends) in now["groups_hz"].as_array().expect("groups").iter().enumerate() {
            let ends = [number(&ends[0]), number(&ends[1])];
            if ends[0] < SAME_SEGMENTS_HZ {
                continue;
            }
            let [own_before, own_now] = [before, now].map(|s| number(&s["channels"][c]["groups"][g]["ratio"]));
            let [read_before, read_now] =
                [0, 1].map(|k| compared(&telemetry[k], name, ends).unwrap_or_else(|| panic!("no {name} at {ends:?}")));
            let what = format!("{name} at {ends:?}: {own_before} {read_before}, {own_now} {read_now}");
            let bounds = &now["channels"][c]["groups"][g]["bounds"];
            let sigma = (number(&bounds[1]) - number(&bounds[0])) / (2.0 * 1.96);
            assert!((own_before - read_before).abs() < sigma && (own_now - read_now).abs() < sigma, "{what}");
            let (own, of_telemetry) = (own_now - own_before, read_now - read_before);
            assert!((own - of_telemetry).abs() < 3e-3, "{what}");
            (cells, most) = (cells + 1, most.max(of_telemetry.abs()));
        }
    }
    assert!(cells > 60 && most > 0.012, "{cells} cells, {most}");
    let falls = both["spectra"]["fall"].as_array().expect("falls");
    assert!(falls.iter().map(number).sum::<f64>() > 25.0, "{falls:?}");

    let hours: Vec<String> = (1..=3).map(|k| format!("{}@{k}", DAYS[0])).collect();
    let whole = refit(server.port, &format!("products={}&on={EFFECT}", DAYS[0]));
    let half = refit(server.port, &format!("products={}&on={EFFECT}&held={}", DAYS[0], hours.join(",")));
    assert_eq!(half["held_out"], json!(hours));
    let [all, fit] = [&whole, &half].map(|r| number(&r["rungs"][1]["fall"]));
    let out = number(&half["rungs"][1]["held_out_fall"]);
    // Of the λ² of a part, what is kept out loses as much as it would gain in a fit of its own: (θ − θ̂)² of both
    // parts, a number of the size of one, with a standard deviation of 2λ of the part.
    assert!(out > 0.0 && (fit + out - all).abs() < 4.5 * 2.0 * fit.sqrt(), "{all} of the whole, {fit} and {out}");
    assert!(number(&half["numbers"]) < 0.55 * number(&whole["numbers"]));
    for wrong in ["@0", "@99", "@-1", "@", "@1@2"] {
        let path = format!("/refit.json?products={0}&held={0}{wrong}", DAYS[0]);
        assert_eq!(get(server.port, &path).status, 400, "{path}");
    }
}

/// The story by clicks alone: from the calendar to the day, to the effect, on, kept. Then by the keyboard alone. No
/// error in the console, and axe-core finds nothing serious, wide and narrow, light and dark.
#[test]
fn a_reader_finds_the_effect_and_keeps_it_by_clicks() {
    let (_alone, flight) = (alone(), flight());
    let folder = flight.folder.path();
    std::fs::copy(folder.join("model.toml"), folder.join("kept.toml")).expect("copied");
    let truth = flight.truth.display().to_string();
    let server = serve(folder, &["--model", "kept.toml", "--allow-changes", "--truth", &truth]);
    let browser = Browser::start(1280, 900, false);
    browser.open(&format!("http://127.0.0.1:{}/#token={}", server.port, server.token));
    browser.click(&format!("a.day[href$=\"{}\"]", DAYS[0]));
    browser.wait_for("document.querySelector('.verdict')");
    browser.click("main a[href^='/missing']");
    let switch = format!("[data-key='{EFFECT}']");
    browser.wait_for(&format!("document.querySelector(\"{switch}\")"));
    let value = "document.querySelector('#offsets tbody tr:nth-child(2) td:nth-child(3)').textContent";
    let before = browser.run(&format!("return {value}"));
    browser.run("window.same_page = true");
    browser.click(&switch);
    browser.wait_for(&format!("{value} !== {before}"));
    assert_eq!(browser.run("return window.same_page && location.search.includes('on=')"), true);
    assert_eq!(browser.run(&format!("return document.querySelector(\"{switch}\").ariaChecked")), "true");
    let said = browser.run("return document.querySelector('.said').textContent");
    assert!(said.as_str().is_some_and(|s| s.contains("1 effect is on") && s.contains("com-offset.tm")), "{said}");
    // The map says what has changed, and the spectrum shows both.
    let map = browser.run("return document.querySelectorAll('.map td u').length");
    assert!(number(&map) >= 1.0, "{map} cells have changed");
    browser.wait_for("document.querySelector('#spectrum .u-legend').textContent.includes('model alone')");
    browser.click("[data-channel='tm1.accel.x']");
    browser.wait_for("document.getElementById('channel').value === 'tm1.accel.x'");
    // Hours kept out by a click: the channel that was picked stays.
    let hours = format!("[data-key='{}@2']", DAYS[0]);
    browser.click(&hours);
    browser.wait_for("document.querySelector('.said').textContent.includes('on what is kept out')");
    assert_eq!(browser.run("return document.getElementById('channel').value"), "tm1.accel.x");
    browser.click(&hours);
    browser.wait_for("!document.querySelector('.said').textContent.includes('kept out')");
    // A link shows a colleague the same.
    let after = browser.run(&format!("return {value}"));
    browser.run("location.reload()");
    browser.wait_for("!window.same_page && document.querySelector('.said')");
    assert_eq!(browser.run(&format!("return {value}")), after);
    browser.click("#keep button");
    browser.wait_for("document.querySelector('#kept.kept')");
    let shown = json(dragfree(folder).args(["model", "show", "kept.toml", "--json"]), 0);
    let kept =
        shown["effects"].as_array().expect("effects").iter().any(|e| e["id"] == "mps-tilt" && e["instance"] == "sc.z");
    assert!(kept, "{shown:#}");
    // The mouse aside: back off, by the focus and the space bar.
    browser.run(&format!("document.querySelector(\"{switch}\").focus()"));
    browser.press(" ");
    browser.wait_for(&format!("document.querySelector(\"{switch}\").ariaChecked === 'false'"));
    assert_eq!(browser.run("return document.activeElement.dataset.key"), EFFECT);
    browser.run("history.back()");
    browser.wait_for(&format!("document.querySelector(\"{switch}\").ariaChecked === 'true'"));
    assert_eq!(browser.console(), Vec::<String>::new());
    drop(browser);
    for (width, dark) in [(1280, false), (1280, true), (400, false), (400, true)] {
        every_page_is_readable(&server, width, dark);
    }
}

/// A thermal force with a lag of a minute, found with a lag that the page can move: χ² falls most within a factor of
/// two of the true lag and less and less beyond it, and the size there is the diagnosis'. A slider moved by the
/// keyboard switches the effect on in that form, and back by the browser.
#[test]
fn a_lag_is_moved_by_a_slider() {
    const TRUTH: f64 = 8e-10;
    const LAG_S: f64 = 60.0;
    let _alone = alone();
    let folder = tempfile::tempdir().expect("a temporary folder");
    let at = folder.path();
    std::fs::copy(fixture("models/com-offset.toml"), at.join("model.toml")).expect("copied");
    let effect = format!("thermal:tm1.x={TRUTH:e},lag_s={LAG_S}");
    let file = simulate(at, &["--hours", "2", "--seed", "71", "--effect", &effect]).remove(0);
    assert!(matches!(calibrate(at, &file, "archive"), 0 | 4));
    let diagnosis = json(dragfree(at).args(["diagnose", DAYS[0], "--keep-extract", "--json"]), 4);
    let found = &diagnosis["candidates"][0];
    assert_eq!((&found["effect"], &found["instance"]), (&json!("thermal"), &json!("tm1.x")), "{found:#}");
    let server = serve(at, &[]);
    let on = |name: &str| refit(server.port, &format!("products={}&on={}", DAYS[0], name.replace('#', "%23")));
    let (named, fall) = ("thermal:tm1.x", |refit: &Value| number(&refit["rungs"][1]["fall"]));
    let first = on(named);
    let size = &first["effects"][0]["coefficients"][0];
    assert!((number(&size["value"]).abs() - TRUTH).abs() < 4.0 * number(&size["sigma"]), "{size}");
    assert!((fall(&first) / number(&found["delta_chi2"]) - 1.0).abs() < 0.05, "{} {found:#}", fall(&first));
    let forms = first["effects"][0]["forms"].as_array().expect("forms");
    let lag = |form: &Value| number(&form["shape"]["lag_s"]);
    let mut falls: Vec<(f64, f64)> =
        forms.iter().map(|form| (lag(form), fall(&on(form["name"].as_str().expect("a name"))))).collect();
    falls.sort_by(|a, b| a.0.total_cmp(&b.0));
    assert!(falls.len() > 10, "{falls:?}");
    let best = falls.iter().max_by(|a, b| a.1.total_cmp(&b.1)).expect("one").0;
    assert!((0.5 * LAG_S..=2.0 * LAG_S).contains(&best), "{falls:?}");
    let beyond: Vec<f64> = falls.iter().filter(|(lag, _)| *lag > 2.0 * LAG_S).map(|(_, fall)| *fall).collect();
    assert!(beyond.windows(2).all(|pair| pair[1] < pair[0]) && beyond.len() > 4, "{falls:?}");
    // The spectra know the form between those of the search, and the others.
    let channel = |refit: &Value| number(&refit["spectra"]["fall"][0]);
    assert!(channel(&first).abs() > 1e-3 && channel(&on("thermal:tm1.x#2")).abs() > 1e-3, "{:#}", first["spectra"]);
    let browser = Browser::start(1280, 900, false);
    browser.open(&format!("http://127.0.0.1:{}/missing?products={}", server.port, DAYS[0]));
    let slider = "document.querySelector(\"input[data-key='thermal:tm1.x lag_s']\")";
    browser.wait_for(slider);
    browser.run(&format!("window.same_page = true; {slider}.focus()"));
    let before = browser.run(&format!("return {slider}.ariaValueText"));
    browser.press("\u{E014}");
    browser.wait_for("document.querySelector('.said').textContent.includes('1 effect is on')");
    browser.wait_for("location.search.includes('on=')");
    let after = browser.run(&format!("return [{slider}.ariaValueText, {slider}.nextElementSibling.textContent]"));
    assert!(after[0] == after[1] && after[0] != before, "{before} {after}");
    browser.wait_for(&format!("document.activeElement === {slider}"));
    browser.wait_for("document.querySelector(\"a[role=switch][aria-label^='thermal:tm1.x']\").ariaChecked === 'true'");
    browser.run("history.back()");
    browser.wait_for("document.querySelector('.said').textContent.includes('The model alone')");
    assert_eq!(browser.run(&format!("return [window.same_page, {slider}.ariaValueText]")), json!([true, before]));
    assert_eq!(browser.console(), Vec::<String>::new());
    drop(browser);
    let page = format!("missing?products={}&on={named}", DAYS[0]);
    for (width, dark) in [(1280, false), (400, true)] {
        readable(&server, width, dark, &[&page]);
    }
}

/// A formula is typed: what is wrong is marked where it is, a name is taken from the list by the keyboard, and what
/// can be read is added to the model with the token. What is typed is text, whatever it is.
#[test]
fn a_formula_is_checked_while_it_is_typed() {
    let (_alone, flight) = (alone(), flight());
    let folder = flight.folder.path();
    std::fs::copy(folder.join("model.toml"), folder.join("formula.toml")).expect("copied");
    let server = serve(folder, &["--model", "formula.toml", "--allow-changes"]);
    let browser = Browser::start(1280, 900, false);
    browser.open(&format!("http://127.0.0.1:{}/missing?products={}#token={}", server.port, DAYS[0], server.token));
    browser.wait_for("document.getElementById('formula')");
    for (field, text) in [("unit", "m s-2 A-2"), ("lower", "-1e-11"), ("upper", "1e-11")] {
        browser.write(&format!("#formula [name={field}]"), text);
    }
    let said = "document.getElementById('formula-said').textContent";
    browser.write("#expression", "2 * <b>");
    browser.wait_for("document.querySelector('#formula-said mark')");
    let marked = browser
        .run("const m = document.querySelector('#formula-said mark'); return [m.previousSibling.data, m.textContent]");
    assert_eq!(marked, json!(["2 * ", "<"]));
    let clear = "const f = document.getElementById('expression'); f.value = ''; f.focus()";
    browser.run(clear);
    browser.write("#expression", "hk.batery_current_a");
    browser.wait_for(&format!("{said}.includes('no channel')"));
    browser.run(clear);
    browser.write("#expression", "lag(battery_cur");
    browser.wait_for("!document.getElementById('formula-names').hidden");
    browser.press("\u{E015}");
    browser.press("\u{E007}");
    assert_eq!(browser.run("return document.getElementById('expression').value"), "lag(hk.battery_current_a");
    browser.write("#expression", " ^ 2, 50)");
    browser.wait_for(&format!("{said}.includes('It can be read')"));
    browser.press("\u{E007}");
    browser.wait_for("document.querySelector('#formula-added.kept')");
    assert_eq!(browser.console(), Vec::<String>::new());
    let shown = json(dragfree(folder).args(["model", "show", "formula.toml", "--json"]), 0);
    let added = shown["effects"].as_array().expect("effects").iter().find(|e| e["id"] == "formula").cloned();
    let added = added.unwrap_or_else(|| panic!("{shown:#}"));
    assert_eq!(added["instance"], "mine", "{added:#}");
    assert!(added.to_string().contains("lag(hk.battery_current_a ^ 2, 50)"), "{added:#}");
    let before = std::fs::read(folder.join("formula.toml")).expect("a model");
    let typed = |name: &str, expression: &str| {
        json!({ "products": DAYS[0], "name": name, "acts_on": "tm1.accel.y", "expression": expression, "unit": "m s-2",
            "lower": "-1", "upper": "1" })
        .to_string()
    };
    let own = format!("http://127.0.0.1:{}", server.port);
    let headers =
        |token: &str| format!("Content-Type: application/json\r\nOrigin: {own}\r\nX-Dragfree-Token: {token}\r\n");
    let add = |token: &str, body: &str| request(server.port, "POST", "/formula", &headers(token), body);
    assert_eq!(add("", &typed("two", "1")).status, 403);
    let deep = "(".repeat(5000);
    for (name, expression) in [("a.b", "1"), ("", "1"), ("two", ""), ("two", "1 +"), ("two", &deep), ("two", "hk.none")]
    {
        let answer = add(&server.token, &typed(name, expression));
        assert!(answer.status == 400 && answer.body.len() < 1000, "{name} {expression}: {answer:?}");
    }
    assert_eq!(std::fs::read(folder.join("formula.toml")).expect("a model"), before);
    let answer = get(server.port, "/formula?name=%3Cb%3E&expression=%3Cscript%3E&lower=%3Ci%3E&upper=1");
    assert!(answer.status == 200 && !answer.body.contains("<i>") && !answer.body.contains("<script"), "{answer:?}");
}

/// A calibration or a diagnosis of two hours, beside other tests.
const COMPUTES: Duration = Duration::from_secs(400);

/// The whole story by clicks alone, from an empty archive: a run of what is due, the day, its diagnosis, the
/// comparison, the effect switched on and kept, the day calibrated once more, and the error that has fallen.
#[test]
fn from_an_empty_archive_to_a_smaller_error_by_clicks_alone() {
    let _alone = alone();
    let mission = tempfile::tempdir().expect("a temporary folder");
    let folder = mission.path();
    expect(dragfree(folder).args(["init", "."]), 0);
    let vault = folder.join("vault");
    std::fs::create_dir(&vault).expect("a folder");
    let effect = format!("{EFFECT}={SIZE_RAD}");
    let file = simulate(&vault, &["--hours", "2", "--seed", "71", "--effect", &effect]).remove(0);
    std::fs::create_dir(folder.join("telemetry")).expect("a folder");
    std::fs::copy(&file, folder.join("telemetry/SC1.mcap")).expect("copied");
    let truth = vault.join("truth/SC1_2035-01-01.mcap").display().to_string();
    assert!(!folder.join("archive").exists());
    let server = serve(folder, &["--ops", "mission-ops.toml", "--allow-changes", "--truth", &truth]);
    let browser = Browser::start(1280, 900, false);
    browser.open(&format!("http://127.0.0.1:{}/#token={}", server.port, server.token));
    browser.wait_for("document.querySelector('main').textContent.includes('no product yet')");
    browser.click("form.start button");
    browser.wait_for_within("document.querySelector('a.day')", COMPUTES);
    assert!(browser.run("return document.getElementById('running').textContent").to_string().contains("Done"));
    browser.click("a.day");
    browser.wait_for("document.querySelector('.verdict')");
    assert_eq!(browser.run("return document.querySelector('#before')"), Value::Null);
    // By the keyboard: the token is there, and the return key in its field is the button.
    browser.run("document.querySelector('form.start .token').focus()");
    browser.press("\u{E007}");
    browser.wait_for("document.getElementById('running').textContent.includes('dragfree diagnose')");
    let diagnosed = "document.querySelector(\"main ul a[href^='/missing']\")";
    browser.wait_for_within(diagnosed, COMPUTES);
    browser.click("main a[href^='/compare/']");
    browser.wait_for("document.querySelector('table.map')");
    browser.click("nav a[href='/missing']");
    let switch = format!("[data-key='{EFFECT}']");
    browser.wait_for(&format!("document.querySelector(\"{switch}\")"));
    browser.click(&switch);
    browser.wait_for("document.querySelector('.said').textContent.includes('1 effect is on')");
    browser.click("#keep button");
    browser.wait_for("document.querySelector('#kept.kept')");
    browser.click("#kept form.start button");
    browser.wait_for("document.getElementById('running').textContent.includes('dragfree catch-up')");
    browser.wait_for_within("document.querySelector(\"#running a[href^='/day/']\")", COMPUTES);
    browser.click("#running a[href^='/day/']");
    browser.wait_for("document.querySelector('#before')");
    assert_eq!(browser.console(), Vec::<String>::new());
    // True errors in σ before and now, as the page shows them.
    let rows = browser.run("return [...document.querySelectorAll('#before tbody tr')].map(r => r.textContent)");
    let sigmas = |row: &Value| -> Vec<f64> {
        let row = row.as_str().expect("text");
        row.split(" σ").filter_map(|part| part.rsplit(", ").next()?.parse().ok()).collect()
    };
    let errors: Vec<Vec<f64>> = rows.as_array().expect("rows").iter().map(sigmas).collect();
    assert!(errors.len() == TRUTH_M.len() && errors.iter().all(|row| row.len() == 2), "{rows:#}");
    let worst = |k: usize| errors.iter().map(|row| row[k]).fold(0.0, f64::max);
    // The effect moves an offset by ten σ of its own; six offsets within 4.5σ are a false alarm in 2e4.
    assert!(worst(0) > 8.0 && worst(1) < 4.5, "{rows:#}");
    let now = browser.run("return location.pathname").as_str().expect("a path").to_owned();
    drop(browser);
    for (width, dark) in [(1280, false), (400, true)] {
        readable(&server, width, dark, &["", now.trim_start_matches('/'), "missing"]);
    }
    // What pages may start, they may with the token alone, and nothing that is no product.
    let own = format!("http://127.0.0.1:{}", server.port);
    let headers =
        |token: &str| format!("Content-Type: application/json\r\nOrigin: {own}\r\nX-Dragfree-Token: {token}\r\n");
    let start = |headers: &str, body: &str| request(server.port, "POST", "/start", headers, body).status;
    assert_eq!(start("", "{\"job\":\"catch-up\"}"), 403);
    assert_eq!(start(&headers("0123456789abcdef0123456789abcdef"), "{\"job\":\"catch-up\"}"), 403);
    let right = headers(&server.token);
    assert_eq!(start(&right, "{\"job\":\"rm\"}"), 400);
    for product in ["--help", "../../etc/passwd", "nothing", "<b>"] {
        let status = start(&right, &json!({ "job": "diagnose", "product": product }).to_string());
        assert!(matches!(status, 400 | 404), "{product}: {status}");
    }
    let reads = serve(folder, &["--ops", "mission-ops.toml"]);
    let page = get(reads.port, "/");
    assert!(page.status == 200 && !page.body.contains("<form"), "{}", page.body);
    let token = headers("").replace(&own, &format!("http://127.0.0.1:{}", reads.port));
    assert_eq!(request(reads.port, "POST", "/start", &token, "{\"job\":\"catch-up\"}").status, 403);
}

/// axe-core finds nothing serious, nothing is wider than the window, no label is smaller than 11 px, and the console is
/// empty. `DRAGFREE_PICTURES=DIR` keeps pictures of the pages.
fn every_page_is_readable(server: &Server, width: u32, dark: bool) {
    let missing = format!("missing?products={}&held={}&on={EFFECT}", DAYS.join(","), DAYS[1]);
    let pages = ["", "trends", &format!("day/{}", DAYS[0]), &format!("compare/{}", DAYS[0]), &missing, "plugins"];
    readable(server, width, dark, &pages);
}

fn readable(server: &Server, width: u32, dark: bool, pages: &[&str]) {
    let axe = std::fs::read_to_string(root().join("tests/data/axe/axe.min.js")).expect("vendored");
    let browser = Browser::start(width, 900, dark);
    for page in pages {
        browser.open(&format!("http://127.0.0.1:{}/{page}", server.port));
        browser.wait_for("document.readyState === 'complete'");
        if let Some(folder) = std::env::var_os("DRAGFREE_PICTURES").map(PathBuf::from) {
            let name = page.split(['/', '?']).next().filter(|name| !name.is_empty()).unwrap_or("mission");
            browser.picture(&folder.join(format!("{name}-{width}-{}.png", if dark { "dark" } else { "light" })));
        }
        browser.run(&axe);
        let found = browser.run_async(
            "const done = arguments[arguments.length - 1]; \
             axe.run().then(r => done(r.violations.filter(v => ['serious', 'critical'].includes(v.impact)) \
             .map(v => [v.id, v.nodes.slice(0, 3).map(n => n.html + n.failureSummary)])))",
        );
        assert_eq!(found, json!([]), "{page} at {width}, dark {dark}");
        let wide = browser.run("return document.documentElement.scrollWidth - document.documentElement.clientWidth");
        assert!(number(&wide) <= 0.0, "{page} at {width}: {wide} px too wide");
        let small = browser.run(
            "return [...document.querySelectorAll('body *')].filter(e => !e.closest('svg, script, .hidden') && \
             [...e.childNodes].some(n => n.nodeType === 3 && n.data.trim()) && \
             parseFloat(getComputedStyle(e).fontSize) < 11).map(e => e.outerHTML.slice(0, 80))",
        );
        assert_eq!(small, json!([]), "{page} at {width}");
        let lead = browser.run("return document.querySelector('h1 + .lead').textContent.trim().length");
        assert!(number(&lead) > 20.0, "{page} begins with a sentence that says what to do");
        assert_eq!(browser.console(), Vec::<String>::new(), "{page} at {width}");
    }
}

/// Without the right host, origin, token or size nothing is answered or changed, and names are text wherever they are
/// shown.
#[test]
fn what_is_hostile_is_refused() {
    let (_alone, flight) = (alone(), flight());
    let folder = flight.folder.path();
    std::fs::copy(folder.join("model.toml"), folder.join("hostile.toml")).expect("copied");
    let before = std::fs::read(folder.join("hostile.toml")).expect("a model");
    let server = serve(folder, &["--model", "hostile.toml", "--allow-changes"]);
    let port = server.port;
    let own = format!("http://127.0.0.1:{port}");
    let body = json!({ "products": DAYS[0], "on": EFFECT }).to_string();
    let headers = |origin: &str, token: &str| {
        format!("Content-Type: application/json\r\nOrigin: {origin}\r\nX-Dragfree-Token: {token}\r\n")
    };
    for (headers, status) in [
        (String::new(), 403),
        (headers(&own, "0123456789abcdef0123456789abcdef"), 403),
        (headers("http://evil.example", &server.token), 403),
        (headers("null", &server.token), 403),
        (headers(&own, &server.token).replace("application/json", "text/plain"), 403),
        (headers(&own, &server.token) + "Host: evil.example\r\n", 403),
    ] {
        assert_eq!(request(port, "POST", "/keep", &headers, &body).status, status, "{headers}");
    }
    let right = headers(&own, &server.token);
    let large = format!(
        "POST /keep HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nConnection: close\r\nContent-Length: 100000\r\n{right}\r\n{}",
        "x".repeat(100_000)
    );
    // The server need not read to the end what it refuses.
    assert!(send(port, large.as_bytes()).map_or(true, |answer| answer.status == 413));
    assert_eq!(request(port, "POST", "/keep", &right, "{\"on\": 1}").status, 400);
    assert_eq!(request(port, "POST", "/", &right, "").status, 405);
    assert_eq!(request(port, "GET", "/", "Host: evil.example\r\n", "").status, 403);
    assert_eq!(std::fs::read(folder.join("hostile.toml")).expect("a model"), before);
    for path in [
        "/../../etc/passwd",
        "/assets/../Cargo.toml",
        "/assets/..%2f..%2fetc%2fpasswd",
        "/day/..%2F..%2Fetc%2Fpasswd",
        "/compare/%3Cscript%3Ealert(1)%3C%2Fscript%3E",
        "/day/%00",
    ] {
        let answer = get(port, path);
        assert_eq!(answer.status, 404, "{path}: {}", answer.body);
        assert!(answer.head.to_lowercase().contains("content-type: text/plain"), "{}", answer.head);
    }
    for query in ["on=%3Cb%3E", "held=%3Cb%3E", "products=%3Cb%3E"] {
        let query =
            if query.starts_with("products") { query.to_owned() } else { format!("products={}&{query}", DAYS[0]) };
        let answer = get(port, &format!("/missing?{query}"));
        assert!(matches!(answer.status, 400 | 404) && answer.head.contains("text/plain"), "{answer:?}");
    }
    assert!(get(port, "/").head.contains("default-src 'none'"));
    // A header that never ends, and a body that comes a byte at a time, are given up.
    let large = format!("GET / HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nX: {}\r\n\r\n", "x".repeat(2_000_000));
    assert!(send(port, large.as_bytes()).map_or(true, |answer| answer.status >= 400));
    let begun = Instant::now();
    let mut slow = TcpStream::connect(("127.0.0.1", port)).expect("connects");
    slow.write_all(b"GET / HTTP/1.1\r\nHost: 127").expect("written");
    slow.set_read_timeout(Some(Duration::from_secs(20))).expect("set");
    let mut answer = Vec::new();
    let _ = slow.read_to_end(&mut answer);
    assert!(begun.elapsed() < Duration::from_secs(10), "{:?}", begun.elapsed());
    let reads = serve(folder, &["--model", "hostile.toml"]);
    let headers = format!("Content-Type: application/json\r\nOrigin: http://127.0.0.1:{}\r\n", reads.port);
    let answer = request(reads.port, "POST", "/keep", &headers, &body);
    assert!(answer.status == 403 && answer.body.contains("--allow-changes"), "{answer:?}");
}

/// Processor time of a program, all of its threads: others on the machine do not count.
fn processor_time(id: u32) -> Duration {
    let tasks = std::fs::read_dir(format!("/proc/{id}/task")).into_iter().flatten().flatten();
    let of = |task: std::fs::DirEntry| {
        let text = std::fs::read_to_string(task.path().join("schedstat")).ok()?;
        text.split(' ').next()?.parse::<u64>().ok()
    };
    Duration::from_nanos(tasks.filter_map(of).sum())
}

/// `serve --open` gives its page to the desktop's own opener.
#[test]
fn the_page_is_opened_in_a_browser() {
    let flight = flight();
    let bin = tempfile::tempdir().expect("a temporary folder");
    let (opener, opened) = (bin.path().join("xdg-open"), bin.path().join("opened"));
    std::fs::write(&opener, format!("#!/bin/sh\nprintf %s \"$1\" > '{}'\n", opened.display())).expect("written");
    std::fs::set_permissions(&opener, std::fs::Permissions::from_mode(0o755)).expect("a mode");
    let mut command = dragfree(flight.folder.path());
    command.args(["serve", "--listen", "127.0.0.1:0", "--json", "--open", "missing?products=2035-01-01"]);
    let path = std::env::var("PATH").unwrap_or_default();
    let mut child = command.env("PATH", format!("{}:{path}", bin.path().display())).stdout(Stdio::piped()).spawn();
    let mut line = String::new();
    let stdout = child.as_mut().expect("starts").stdout.take().expect("piped");
    let _ended = Ended(child.expect("starts"));
    BufReader::new(stdout).read_line(&mut line).expect("a line");
    let ready: Value = serde_json::from_str(&line).expect("a JSON document");
    let begun = Instant::now();
    while std::fs::read_to_string(&opened).is_ok_and(|text| text.is_empty()) || !opened.exists() {
        assert!(begun.elapsed() < Duration::from_secs(20), "nothing was opened");
        std::thread::sleep(Duration::from_millis(20));
    }
    let expected = format!("{}missing?products=2035-01-01", ready["address"].as_str().expect("an address"));
    assert_eq!(std::fs::read_to_string(&opened).expect("an address"), expected);
}

/// Of 200 requests at once every one is answered, and a run beside them makes its product. A switch over HTTP takes, in
/// 95 of 100 cases, at most 100 ms of the processor, and the memory stays below 100 MB.
#[test]
#[allow(clippy::print_stdout, reason = "VALIDATION.md has these lines")]
fn many_requests_at_once_and_one_after_the_other() {
    let (_alone, flight) = (alone(), flight());
    let folder = flight.folder.path();
    let server = serve(folder, &[]);
    let port = server.port;
    let query = format!("products={}&held={}", DAYS.join(","), DAYS[1]);
    let names: Vec<String> = {
        let all = refit(port, &query);
        let all = all["effects"].as_array().expect("effects").iter();
        all.filter_map(|e| e["name"].as_str()).map(|name| name.replace('#', "%23")).collect()
    };
    assert!(names.len() > 20, "{names:?}");
    let (id, mut waits) = (server.process.0.id(), Vec::new());
    let mut times: Vec<Duration> = (0..40)
        .map(|k| {
            let on: Vec<&str> = (0..10).map(|i| names[(k + i) % names.len()].as_str()).collect();
            let (begun, before) = (Instant::now(), processor_time(id));
            let answer = get(port, &format!("/refit?{query}&on={}", on.join(",")));
            assert_eq!(answer.status, 200, "{answer:?}");
            waits.push(begun.elapsed());
            processor_time(id).saturating_sub(before)
        })
        .collect();
    times.sort();
    waits.sort();
    println!("a switch with 10 effects over HTTP: processor {:.1?}, 95 of 100 at most {:.1?}", times[20], times[37]);
    println!("the same by the clock: {:.1?}, 95 of 100 within {:.1?}", waits[20], waits[37]);
    assert!(times[37] < Duration::from_millis(100), "{times:?}");
    let run = std::thread::spawn(move || calibrate(folder, &folder.join("2035-01-01/SC1_2035-01-01.mcap"), "other"));
    let asking: Vec<_> = (0..200)
        .map(|k| {
            let path =
                if k % 2 == 0 { "/".to_owned() } else { format!("/refit?{query}&on={}", names[k % names.len()]) };
            std::thread::spawn(move || get(port, &path).status)
        })
        .collect();
    for asked in asking {
        assert_eq!(asked.join().expect("answered"), 200);
    }
    assert!(matches!(run.join().expect("runs"), 0 | 4));
    let status = std::fs::read_to_string(format!("/proc/{}/status", server.process.0.id())).unwrap_or_default();
    let peak =
        status.lines().find_map(|line| line.strip_prefix("VmHWM:")?.trim().strip_suffix(" kB")?.parse::<f64>().ok());
    if let Some(peak) = peak {
        println!("memory of the server: {:.0} MB at most", peak / 1e3);
        assert!(peak < 100e3, "{peak} kB");
    }
}

/// A calibration is seen on the page while it runs, with how far it is, and not when it has ended.
#[test]
fn what_runs_is_seen_while_it_runs() {
    let _alone = alone();
    let folder = tempfile::tempdir().expect("a temporary folder");
    let files = simulate(folder.path(), &["--hours", "16", "--seed", "4"]);
    let mut run = dragfree(folder.path());
    run.args(["--threads", "1", "-q", "run"]).arg(fixture("pipelines/science-mode.toml")).args(&files);
    let mut run = Ended(run.args(["--archive", "archive"]).stdout(Stdio::null()).spawn().expect("starts"));
    let since = Instant::now();
    while !folder.path().join("archive/staging").exists() {
        assert!(since.elapsed() < Duration::from_secs(60), "no archive");
        std::thread::sleep(Duration::from_millis(5));
    }
    let server = serve(folder.path(), &["--archive", "archive"]);
    let running = || get(server.port, "/running").body;
    let mut seen = String::new();
    while run.0.try_wait().expect("a process").is_none() {
        let now = running();
        if now.contains("COM1B SC1") {
            seen = now;
        }
        std::thread::sleep(Duration::from_millis(20));
    }
    assert!(seen.contains("has come to 2035-01-01") && seen.contains(" s left"), "{seen:?}");
    assert!(running().contains("Nothing runs now"), "{}", running());
}

/// The pages of a report are whole by themselves: every file that they load is beside them, and nothing else is.
#[test]
fn a_report_needs_no_server() {
    let (_alone, flight) = (alone(), flight());
    let folder = flight.folder.path();
    let out = folder.join("report");
    let made = json(dragfree(folder).args(["report", "2035-01-01", "--json", "--out"]).arg(&out), 0);
    assert_eq!(made["files"].as_array().map(Vec::len), Some(7), "{made:#}");
    for page in ["index.html", "compare.html", "missing.html"] {
        let text = std::fs::read_to_string(out.join(page)).expect("a page");
        assert!(text.contains(DAYS[0]), "{page}");
        for link in
            text.split(['"', '\'']).skip(1).step_by(2).filter(|w| w.ends_with(".html") || w.starts_with("assets/"))
        {
            assert!(out.join(link).is_file(), "{page} loads {link}");
        }
        assert!(!text.contains("src=\"http") && !text.contains("href=\"http") && !text.contains("href=\"/"), "{page}");
    }
    let missing = std::fs::read_to_string(out.join("missing.html")).expect("a page");
    assert!(missing.contains("1 effect is on") && missing.contains(EFFECT), "what the diagnosis names is on");
}

/// The page Plugins says of every library who vouches for it: nobody, or the lock of its folder and who signed that.
#[test]
fn the_page_of_plugins_says_who_vouches_for_a_library() {
    let _alone = alone();
    let folder = tempfile::tempdir().expect("a temporary folder");
    let library = compile_plugin(folder.path(), "c_plugins.c", "c_plugins", &[]);
    let own = folder.path().display().to_string();
    let shown = |more: &[&str]| {
        let server = serve(flight().folder.path(), &[&["--archive", "archive", "--plugin-dir", &own], more].concat());
        let page = get(server.port, "/plugins").body;
        let at = page.find("c-scale").unwrap_or_else(|| panic!("no c-scale: {page}"));
        let from = at + page[at..].find("Vouched for by").expect("who vouches");
        page[from..].split("Licence").next().unwrap_or_default().to_owned()
    };
    let nobody = shown(&[]);
    assert!(nobody.contains("nobody; it was tried in a process of its own first"), "{nobody}");
    let lock = folder.path().join("plugins.lock");
    std::fs::write(&lock, "isolate = true\n").expect("written");
    let isolated = shown(&[]);
    assert!(isolated.contains("nobody; it runs in a process of its own"), "{isolated}");
    let list = json(dragfree(folder.path()).args(["plugins", "list", "--json", "--plugin-dir", &own]), 0);
    let found =
        list["plugins"].as_array().expect("plugins").iter().find(|p| p["id"] == "c-scale").expect("it is there");
    let digest = found["sha256"].as_str().expect("a digest");
    let name = library.file_name().expect("a name").to_string_lossy().into_owned();
    let text = format!("[sha256]\n{name:?} = \"{digest}\"\n");
    std::fs::write(&lock, &text).expect("written");
    assert!(shown(&[]).contains("plugins.lock<"), "{}", shown(&[]));
    let keys = minisign::KeyPair::generate_unencrypted_keypair().expect("keys");
    let signed = minisign::sign(Some(&keys.pk), &keys.sk, text.as_bytes(), None, None).expect("signed");
    std::fs::write(folder.path().join("plugins.lock.minisig"), signed.into_string()).expect("written");
    let key = keys.pk.to_base64();
    let by_key = shown(&["--plugin-key", &key]);
    assert!(by_key.contains(&format!("plugins.lock, signed with {key}")), "{by_key}");
}
