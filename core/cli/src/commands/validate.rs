//! `dragfree plugins validate`: each check in a process of its own, so that a crash is a result.

use super::Done;
use crate::args::{Global, Validate};
use crate::bundled;
use crate::failure::{Failure, Refusal};
use crate::text::{self, Paint};
use dragfree_engine::border::{self, Library, PluginInfo};
use dragfree_engine::config::Mission;
use dragfree_engine::validate::{Check, Subject, to_json};
use serde_json::{Value, json};
use std::io::Read as _;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitStatus, Stdio};
use std::sync::mpsc::Receiver;
use std::time::{Duration, Instant};

/// What a child's answer begins with; a plugin may print what it likes before it.
const ANSWER: &str = "dragfree-check ";

/// Asked of a child in place of a check: what a library holds.
const LIST: &str = "list";

pub(super) fn execute(validate: &Validate, global: &Global, paint: Paint) -> Result<Done, Failure> {
    if let Some(check) = &validate.check {
        return answered(validate, check);
    }
    let target = Path::new(&validate.target);
    let subjects = if target.is_file() { listed(validate, target) } else { found(validate, global)? };
    let mut all = Vec::new();
    for (kind, id, path) in subjects {
        let mut checks = Vec::new();
        if id.is_empty() {
            checks.push(json!({ "check": "open", "passed": false, "detail": kind }));
        } else {
            for check in Check::ALL {
                let mut result = ask(validate, &path, &check.to_string(), Some((&kind, &id)));
                result["check"] = json!(check);
                checks.push(result);
                // An instance that cannot be created or linked, or hangs, ends the checks.
                let ends = |c: &Value| {
                    c["stopped"] == true || c["passed"] == false && matches!(check, Check::Create | Check::Link)
                };
                if checks.last().is_some_and(ends) {
                    break;
                }
            }
        }
        let passed = checks.iter().all(|c| c["passed"] == true);
        all.push(json!({ "id": id, "kind": kind, "path": path.to_string_lossy(), "passed": passed, "checks": checks }));
    }
    let passed = all.iter().all(|plugin| plugin["passed"] == true);
    let code = u8::from(!passed);
    if global.json {
        return Ok(Done { code, ..Done::json(&json!({ "passed": passed, "plugins": all })) });
    }
    Ok(Done { text: all.iter().map(|plugin| screen(plugin, paint)).collect(), code })
}

/// The plugins of the registry that have the id: kind, id, file.
fn found(validate: &Validate, global: &Global) -> Result<Vec<(String, String, PathBuf)>, Failure> {
    let registry = super::registry(global)?;
    let of_id = registry.plugins().filter(|found| found.info.manifest.id == validate.target);
    let all: Vec<_> = of_id
        .map(|found| (found.info.kind.to_string(), found.info.manifest.id.clone(), found.opened.path.clone()))
        .collect();
    if all.is_empty() { Err(Refusal::Plugin(validate.target.clone()).into()) } else { Ok(all) }
}

/// The plugins of a file, as a child of ours sees them; where it cannot be opened, the reason in place of the kind.
fn listed(validate: &Validate, path: &Path) -> Vec<(String, String, PathBuf)> {
    let answer = ask(validate, path, LIST, None);
    let text = |value: &Value| value.as_str().unwrap_or_default().to_owned();
    match answer["plugins"].as_array() {
        Some(plugins) => plugins.iter().map(|p| (text(&p["kind"]), text(&p["id"]), path.to_owned())).collect(),
        None => vec![(text(&answer["detail"]), String::new(), path.to_owned())],
    }
}

/// Asks a child; whatever becomes of it is an answer.
fn ask(validate: &Validate, path: &Path, check: &str, plugin: Option<(&str, &str)>) -> Value {
    let failed = |detail: String| json!({ "passed": false, "detail": detail });
    let program = match std::env::current_exe() {
        Ok(program) => program,
        Err(error) => return failed(format!("this program cannot find itself: {error}")),
    };
    let mut command = Command::new(program);
    command.args(["plugins", "validate"]).arg(path).args(["--check", check, "--quiet"]);
    if let Some((kind, id)) = plugin {
        command.args(["--kind", kind, "--id", id]);
    }
    if let Some(mission) = &validate.mission {
        command.arg("--mission").arg(mission);
    }
    for set in &validate.set {
        command.args(["--set", set]);
    }
    for file in &validate.file {
        command.arg("--file").arg(file);
    }
    let limit = Duration::from_secs_f64(validate.time_limit);
    match answer(command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped()), limit) {
        Ok((Some(status), stdout, stderr)) => {
            let line = stdout.lines().rev().find_map(|line| line.strip_prefix(ANSWER));
            let told = line.and_then(|line| serde_json::from_str(line).ok());
            told.unwrap_or_else(|| failed(format!("{}{}", border::ended(status), last_line(&stderr))))
        }
        Ok((None, ..)) => {
            let detail =
                format!("was not done after {} s and was stopped; --time-limit gives it longer", validate.time_limit);
            json!({ "passed": false, "stopped": true, "detail": detail })
        }
        Err(error) => failed(format!("cannot be run: {error}")),
    }
}

/// Status, where it ended in time, and what it wrote to stdout and stderr.
fn answer(command: &mut Command, limit: Duration) -> std::io::Result<(Option<ExitStatus>, String, String)> {
    let mut child = command.spawn()?;
    // A process started by the plugin may keep the pipes open after the child's end, hence the threads and time limits.
    let read = |pipe: Option<Box<dyn std::io::Read + Send>>| {
        let (sender, receiver) = std::sync::mpsc::channel();
        std::thread::spawn(move || {
            let mut bytes = Vec::new();
            // What was written until the pipe broke is what there is.
            let _ = pipe.map(|mut pipe| pipe.read_to_end(&mut bytes));
            let _ = sender.send(String::from_utf8_lossy(&bytes).into_owned()); // nobody may be waiting any more
        });
        receiver
    };
    let stdout = read(child.stdout.take().map(|pipe| Box::new(pipe) as _));
    let stderr = read(child.stderr.take().map(|pipe| Box::new(pipe) as _));
    let begun = Instant::now();
    let status = loop {
        match child.try_wait()? {
            Some(status) => break Some(status),
            None if begun.elapsed() > limit => {
                child.kill()?;
                child.wait()?;
                break None;
            }
            None => std::thread::sleep(Duration::from_millis(5)),
        }
    };
    let text = |pipe: Receiver<String>| pipe.recv_timeout(limit).unwrap_or_default();
    Ok((status, text(stdout), text(stderr)))
}

fn last_line(stderr: &str) -> String {
    stderr
        .lines()
        .rev()
        .find(|line| !line.trim().is_empty())
        .map_or_else(String::new, |line| format!("; it said: {line}"))
}

/// The child's part: one check in this very process.
fn answered(validate: &Validate, check: &str) -> Result<Done, Failure> {
    let library = match Library::open(Path::new(&validate.target)) {
        Ok(library) => library,
        Err(error) => return Ok(told(&json!({ "passed": false, "detail": error.to_string() }))),
    };
    if check == LIST {
        let plugins: Vec<Value> =
            library.plugins.iter().map(|p| json!({ "kind": p.kind, "id": p.manifest.id })).collect();
        return Ok(told(&json!({ "passed": true, "plugins": plugins })));
    }
    let wanted = |p: &&PluginInfo| {
        validate.kind.as_ref().is_none_or(|kind| *kind == p.kind.to_string())
            && validate.id.as_ref().is_none_or(|id| *id == p.manifest.id)
    };
    let plugin = library.plugins.iter().find(wanted).ok_or_else(|| Refusal::Plugin(validate.target.clone()))?;
    let check =
        Check::ALL.into_iter().find(|c| c.to_string() == check).ok_or_else(|| format!("there is no check {check}"))?;
    let mission = mission(validate.mission.as_deref())?;
    let parameters = validate.set.iter().map(|text| parameter(text)).collect::<Result<toml::Table, Failure>>()?;
    let subject =
        Subject { opened: &library, plugin, mission: &mission, parameters: &parameters, files: &validate.file };
    Ok(told(&to_json(&subject.run(check))))
}

fn told(answer: &Value) -> Done {
    // A plugin may have left a line unfinished.
    Done { text: format!("\n{ANSWER}{answer}\n"), code: u8::from(answer["passed"] != true) }
}

/// The mission of a file, or the bundled one.
pub(super) fn mission(path: Option<&Path>) -> Result<Mission, Failure> {
    if let Some(path) = path {
        return Ok(Mission::load(path)?);
    }
    let text = bundled::FILES.iter().find(|(path, _)| *path == bundled::MISSION).map_or("", |(_, text)| text);
    Ok(Mission::parse(Path::new(bundled::MISSION), text)?)
}

/// `NAME=VALUE`, the value as TOML has it, or else a text.
fn parameter(text: &str) -> Result<(String, toml::Value), Failure> {
    let (name, value) = text.split_once('=').ok_or_else(|| format!("--set {text}: NAME=VALUE is needed"))?;
    let parsed = toml::from_str::<toml::Table>(&format!("value = {value}")).ok().and_then(|mut t| t.remove("value"));
    Ok((name.trim().to_owned(), parsed.unwrap_or_else(|| toml::Value::from(value))))
}

fn screen(plugin: &Value, paint: Paint) -> String {
    let text = |value: &Value| value.as_str().unwrap_or_default().to_owned();
    let title = if text(&plugin["id"]).is_empty() {
        text(&plugin["path"])
    } else {
        format!("{} {}  {}", text(&plugin["kind"]), text(&plugin["id"]), text(&plugin["path"]))
    };
    let mut screen = paint.bold(&title) + "\n";
    let checks = plugin["checks"].as_array().map_or(&[][..], Vec::as_slice);
    for check in checks {
        let passed = check["passed"] == true;
        let label = text(&check["check"]);
        let words = format!("{}: {}", if passed { "passed" } else { "FAILED" }, text(&check["detail"]));
        let line = text::labelled(&label, &words);
        screen += &if passed { line } else { paint.bad(line.trim_end()) + "\n" };
    }
    let missing = Check::ALL.len().saturating_sub(checks.len());
    if missing > 0 {
        screen += &text::labelled("", &format!("{missing} more checks make no sense before that is mended"));
    }
    screen
}
