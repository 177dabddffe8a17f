//! `dragfree campaign`.

use super::{Done, SOFTWARE, stamp};
use crate::args::{BATCH_ROWS, Campaign, Global};
use crate::failure::Failure;
use crate::progress::Meter;
use crate::text::{self, Paint};
use dragfree_archive::files::{IoContext as _, sha256_of};
use dragfree_engine::registry::Registry;
use dragfree_workflow::calibrate::Options;
use dragfree_workflow::campaign::{self as workflow, Spec, Task, Worker};
use dragfree_workflow::operations::{Operations, Planner};
use std::collections::BTreeSet;
use std::fmt::Write as _;
use std::fs::File;
use std::io::{Read as _, Seek as _, SeekFrom};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, SystemTime};

/// How often it is looked whether a task on this machine has ended.
const LOOK: Duration = Duration::from_millis(20);

/// How much is shown of what a task has said, bytes from its end.
const LAST_WORDS_BYTES: u64 = 1 << 14;

pub(super) fn execute(command: &Campaign, global: &Global, paint: Paint) -> Result<Done, Failure> {
    match command {
        Campaign::Plan { spec, out } => plan(spec, out, global),
        Campaign::Task { folder, id, number } => task(folder, id.as_deref(), *number, global),
        Campaign::Run { folder, local } => {
            run(folder, local.map_or_else(|| super::threads(global), usize::from), global, paint)
        }
        Campaign::Commit { folder } => commit(folder, global),
        Campaign::Status { folder } => status(folder, global),
    }
}

/// Digest of this program.
fn program() -> Result<String, Failure> {
    let exe = std::env::current_exe().at("find", "this program")?;
    Ok(sha256_of(&exe).at("read", &exe)?)
}

fn planner<'a>(operations: &'a Operations, registry: &'a Registry, global: &Global) -> Result<Planner<'a>, Failure> {
    let options = Options {
        threads: super::threads(global),
        batch_rows: BATCH_ROWS as usize,
        created: SystemTime::now().into(),
        software: SOFTWARE.to_owned(),
        ..Options::default()
    };
    Ok(Planner::new(operations, registry, options)?)
}

fn plan(spec: &Path, out: &Path, global: &Global) -> Result<Done, Failure> {
    let spec = Spec::load(spec)?;
    let operations = Operations::load(spec.ops())?;
    let registry = super::registry(global)?;
    let folder = std::path::absolute(out).at("find", out)?;
    let tasks = workflow::plan(&spec, &folder, &planner(&operations, &registry, global)?, &operations, &program()?)?;
    let path = workflow::write(&folder, &tasks)?;
    if global.json {
        return Ok(Done::json(&serde_json::json!({"plan": path, "tasks": tasks})));
    }
    let mut text = format!("plan      {}, {} tasks\n", path.display(), tasks.len());
    text += &text::labelled("next", &format!("dragfree campaign run {}", text::quoted(&out.to_string_lossy())));
    Ok(Done::new(text))
}

/// The operations that the tasks of a plan are of.
fn operations(tasks: &[Task], folder: &Path) -> Result<Operations, Failure> {
    let first = tasks.first().ok_or_else(|| format!("the plan of {} has no task", folder.display()))?;
    Ok(Operations::load(&first.ops)?)
}

fn task(folder: &Path, id: Option<&str>, number: Option<usize>, global: &Global) -> Result<Done, Failure> {
    let folder = folder.canonicalize().at("find", folder)?;
    let tasks = workflow::read(&folder)?;
    let by_number = number.and_then(|n| tasks.get(n.checked_sub(1)?));
    let found = by_number.or_else(|| tasks.iter().find(|task| Some(task.id.as_str()) == id));
    let task = found.ok_or_else(|| {
        let which = id.map_or_else(|| format!("line {}", number.unwrap_or_default()), |id| format!("task {id}"));
        format!("the plan of {} has no {which}", folder.display())
    })?;
    let operations = operations(&tasks, &folder)?;
    let registry = super::registry(global)?;
    let worker = Worker {
        folder: &folder,
        registry: &registry,
        planner: &planner(&operations, &registry, global)?,
        program: &program()?,
        software: SOFTWARE,
        threads: super::threads(global),
    };
    let mut meter = Meter::new("task", global);
    let done = worker.task(task, &tasks, &mut |progress| meter.show(&progress))?;
    if global.json {
        return Ok(Done::json(&serde_json::to_value(&done)?));
    }
    Ok(Done::new(match &done.failed {
        Some(reason) => format!("{}  no product: {reason}\n", done.id),
        None => format!("{}  {}\n", done.id, done.digest),
    }))
}

/// Does what is ready, several tasks at a time, each in a process of its own.
fn run(folder: &Path, at_once: usize, global: &Global, paint: Paint) -> Result<Done, Failure> {
    let tasks = workflow::read(folder)?;
    let exe = std::env::current_exe().at("find", "this program")?;
    // A file takes whatever a plugin says; a pipe that nobody reads would hold its task up.
    let mut running: Vec<(String, Child, File)> = Vec::new();
    let mut tried = BTreeSet::new();
    let mut errors: Vec<String> = Vec::new();
    loop {
        let ready = if running.len() < at_once { workflow::status(folder, &tasks)?.ready } else { Vec::new() };
        for id in ready.into_iter().filter(|id| !tried.contains(id)).take(at_once - running.len()).collect::<Vec<_>>() {
            let mut command = Command::new(&exe);
            command.args(["--quiet", "--threads", "1"]);
            command.args(global.plugin_dir.iter().flat_map(|dir| [Path::new("--plugin-dir"), dir.as_path()]));
            command.args(["--plugin-time-limit", &global.plugin_time_limit.to_string()]);
            command.envs(global.plugin_key.iter().map(|key| (super::PLUGIN_KEY, key)));
            let said = tempfile::tempfile().at("make a file in", std::env::temp_dir())?;
            let stderr = said.try_clone().at("open", std::env::temp_dir())?;
            command.args(["campaign", "task"]).arg(folder).arg(&id).stdout(Stdio::null()).stderr(stderr);
            let child = command.spawn().at("start", &exe)?;
            running.push((id.clone(), child, said));
            tried.insert(id);
        }
        if running.is_empty() {
            break;
        }
        let mut left = Vec::new();
        for (id, mut child, said) in running {
            match child.try_wait().at("wait for", &exe)? {
                None => left.push((id, child, said)),
                Some(status) if status.success() => {}
                Some(_) => errors.push(format!("task {id}: {}", last_words(said))),
            }
        }
        running = left;
        std::thread::sleep(LOOK);
    }
    let mut done = status(folder, global)?;
    if !workflow::status(folder, &tasks)?.failed.is_empty() {
        done.code = 1;
    }
    if !errors.is_empty() {
        done.code = 1;
        if global.json {
            let mut value: serde_json::Value = serde_json::from_str(&done.text)?;
            value["errors"] = serde_json::json!(errors);
            return Ok(Done { code: done.code, ..Done::json(&value) });
        }
        done.text.extend(errors.iter().map(|error| text::labelled(&paint.bad("error"), error)));
    }
    Ok(done)
}

/// The last of what a task has said.
fn last_words(mut said: File) -> String {
    let mut words = Vec::new();
    let end = said.seek(SeekFrom::End(0)).unwrap_or(0);
    let read =
        said.seek(SeekFrom::Start(end.saturating_sub(LAST_WORDS_BYTES))).and_then(|_| said.read_to_end(&mut words));
    match read {
        Ok(_) => String::from_utf8_lossy(&words).trim().to_owned(),
        Err(error) => format!("what it said cannot be read: {error}"),
    }
}

fn commit(folder: &Path, global: &Global) -> Result<Done, Failure> {
    let folder: PathBuf = folder.canonicalize().at("find", folder)?;
    let tasks = workflow::read(&folder)?;
    let operations = operations(&tasks, &folder)?;
    let registry = super::registry(global)?;
    let spacecraft = planner(&operations, &registry, global)?.spacecraft().to_owned();
    let committed = workflow::commit(&folder, &tasks, (&operations.archive, &spacecraft), &stamp())?;
    let code = u8::from(!committed.failed.is_empty());
    if global.json {
        return Ok(Done { code, ..Done::json(&serde_json::to_value(&committed)?) });
    }
    let mut text = String::new();
    for id in &committed.products {
        let _ = writeln!(text, "product   {id}");
    }
    for (day, reason) in &committed.failed {
        text += &text::labelled("failed", &format!("{day}: {reason}"));
    }
    let _ = writeln!(
        text,
        "{} products taken over, {} sums, {} files and folders cleared",
        committed.products.len(),
        committed.sums,
        committed.cleared
    );
    Ok(Done { text, code })
}

fn status(folder: &Path, global: &Global) -> Result<Done, Failure> {
    let tasks = workflow::read(folder)?;
    let status = workflow::status(folder, &tasks)?;
    if global.json {
        return Ok(Done::json(&serde_json::to_value(&status)?));
    }
    let mut text = String::new();
    for (kind, (done, all)) in &status.kinds {
        let _ = writeln!(text, "{kind:<10}{done} of {all}");
    }
    let _ = writeln!(text, "{:<10}{}", "at work", status.at_work);
    for (day, reason) in &status.failed {
        text += &text::labelled("failed", &format!("{day}: {reason}"));
    }
    Ok(Done::new(text))
}
