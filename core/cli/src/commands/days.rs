//! `dragfree day`, `catch-up`, `watch` and `products stale`.

use super::{Done, INCONSISTENT};
use crate::args::{BATCH_ROWS, CatchUp, DayCommand, Global, Ops, Watch};
use crate::failure::{Failure, Refusal};
use crate::operations;
use crate::progress::Meter;
use crate::text::{self, Paint};
use chrono::NaiveDate;
use dragfree_archive::files::IoContext as _;
use dragfree_archive::product::Product;
use dragfree_archive::{Archive, Written};
use dragfree_engine::border;
use dragfree_engine::registry::Registry;
use dragfree_workflow::calibrate::{Options, Progress};
use dragfree_workflow::joint;
use dragfree_workflow::operations::{self as workflow, Inbox, Operations, Outcome, Planned, Planner, Ran};
use notify::Watcher as _;
use serde_json::{Value, json};
use std::fmt::Write as _;
use std::fs::{File, TryLockError};
use std::path::{Path, PathBuf};
use std::sync::atomic::Ordering;
use std::sync::mpsc;
use std::time::{Duration, SystemTime};

/// What the commands of this file share.
struct Desk {
    operations: Operations,
    registry: Registry,
    inbox: Inbox,
}

impl Desk {
    fn open(ops: &Ops, global: &Global) -> Result<Self, Failure> {
        let operations = operations::load(ops.file.as_deref())?;
        let inbox = Inbox::remembered(&memory(&operations));
        Ok(Self { operations, registry: super::registry(global)?, inbox })
    }

    fn planner(&self, global: &Global) -> Result<Planner<'_>, Failure> {
        let options = Options {
            threads: super::threads(global),
            batch_rows: BATCH_ROWS as usize,
            created: SystemTime::now().into(),
            software: super::SOFTWARE.to_owned(),
            ..Options::default()
        };
        Ok(Planner::new(&self.operations, &self.registry, options)?)
    }

    /// The right to run days of the archive, until it is dropped or the program ends.
    fn hold(&self) -> Result<File, Failure> {
        let archive = Archive::create(&self.operations.archive)?;
        let path = archive.folder().join("journal/days.lock");
        let lock = File::options().create(true).truncate(false).write(true).open(&path).at("write", &path)?;
        match lock.try_lock() {
            Ok(()) => Ok(lock),
            Err(TryLockError::WouldBlock) => Err(Refusal::DaysRunning(archive.folder().to_owned()).into()),
            Err(TryLockError::Error(error)) => Err(error).at("lock", &path).map_err(Into::into),
        }
    }

    /// Reads what is new in the inbox.
    fn read_inbox(&mut self, global: &Global) -> Result<(), Failure> {
        let spacecraft = self.planner(global)?.spacecraft().to_owned();
        self.inbox.look(&self.operations.inbox, &spacecraft)?;
        self.inbox.remember(&memory(&self.operations));
        Ok(())
    }

    /// The same, and gives every day with telemetry.
    fn look(&mut self, global: &Global) -> Result<Vec<Planned>, Failure> {
        self.read_inbox(global)?;
        let archive = Archive::create(&self.operations.archive)?;
        Ok(workflow::plan(&self.planner(global)?, &archive, &self.inbox)?)
    }
}

/// Where is kept what was read of the inbox.
fn memory(operations: &Operations) -> PathBuf {
    operations.archive.join("journal/inbox.json")
}

pub(super) fn day(command: &DayCommand, global: &Global, paint: Paint) -> Result<Done, Failure> {
    let mut desk = Desk::open(&command.ops, global)?;
    let _held = desk.hold()?;
    let days = desk.look(global)?;
    let Some(planned) = days.iter().find(|planned| planned.day.day == command.day) else {
        return Err(format!(
            "there is no telemetry of {} in {}{}",
            command.day,
            desk.operations.inbox.join(", "),
            strangers(&desk.inbox)
        )
        .into());
    };
    let mut meter = Meter::new("day", global);
    let ran = desk.planner(global)?.run(planned, &mut |progress| meter.show(&progress))?;
    let told = vec![Told::of(&desk.operations, &ran, planned.day.reasons.clone())];
    Ok(done(&told, &desk.inbox, global, paint))
}

pub(super) fn catch_up(command: &CatchUp, global: &Global, paint: Paint) -> Result<Done, Failure> {
    let mut desk = Desk::open(&command.ops, global)?;
    if command.dry_run {
        let days = desk.look(global)?;
        let due = |p: &&Planned| !p.day.reasons.is_empty() && command.until.is_none_or(|until| p.day.day <= until);
        return Ok(planned(days.iter().filter(due), &desk.inbox, global, paint));
    }
    let _held = desk.hold()?;
    let mut told = Vec::new();
    let ended = run_due(&mut desk, command.until, global, &mut |day| told.push(day));
    if let Err(error) = ended {
        // What was run is told too.
        if !told.is_empty() {
            crate::output::print(&done(&told, &desk.inbox, global, paint).text)?;
        }
        return Err(error);
    }
    Ok(done(&told, &desk.inbox, global, paint))
}

/// Runs the days that are due, with the operator's commands for each at once; `told` has what came of it.
fn run_due(
    desk: &mut Desk,
    until: Option<NaiveDate>,
    global: &Global,
    told: &mut dyn FnMut(Told),
) -> Result<(), Failure> {
    desk.read_inbox(global)?;
    let planner = desk.planner(global)?;
    let mut begins = |_: &Planned| -> Box<dyn FnMut(Progress)> {
        let mut meter = Meter::new("day", global);
        Box::new(move |progress| meter.show(&progress))
    };
    let mut ran = |planned: &Planned, ran: Ran| told(Told::of(&desk.operations, &ran, planned.day.reasons.clone()));
    Ok(workflow::catch_up(&planner, &desk.inbox, until, &mut begins, &mut ran)?)
}

pub(super) fn watch(command: &Watch, global: &Global, paint: Paint) -> Result<Done, Failure> {
    let mut desk = Desk::open(&command.ops, global)?;
    let _held = desk.hold()?;
    let (sender, events) = mpsc::channel();
    let mut watcher = notify::recommended_watcher(move |event| {
        if is_change(&event) {
            let _ = sender.send(()); // the receiver goes last, when the program ends
        }
    })?;
    for folder in folders(&desk.operations.inbox) {
        std::fs::create_dir_all(&folder).at("make the folder", &folder)?;
        watcher.watch(&folder, notify::RecursiveMode::Recursive)?;
    }
    let settle = Duration::from_secs_f64(command.settle_s);
    let stop = dragfree_engine::stop::flag();
    while !stop.load(Ordering::Relaxed) {
        let mut printed = Ok(());
        let mut print = |day: Told| {
            if printed.is_ok() {
                printed = crate::output::print(&day.line(paint));
            }
        };
        let ended = run_due(&mut desk, None, global, &mut print);
        printed?;
        match ended {
            Ok(()) => {}
            Err(_) if stop.load(Ordering::Relaxed) => break,
            Err(error) => return Err(error),
        }
        // Also where nothing was due: to look at all days needs the more memory the more there are.
        border::give_memory_back();
        // The first event ends the wait, and as long as others follow within the time to settle it goes on.
        let mut changed = false;
        while !stop.load(Ordering::Relaxed) {
            match events.recv_timeout(if changed { settle } else { Duration::from_millis(500) }) {
                Ok(_) => changed = true,
                Err(mpsc::RecvTimeoutError::Timeout) if changed => break,
                Err(mpsc::RecvTimeoutError::Timeout) => {}
                Err(mpsc::RecvTimeoutError::Disconnected) => return Err("the inbox cannot be watched any more".into()),
            }
        }
    }
    Ok(Done::new(String::new()))
}

/// Whether something may be new. That a folder or a file is opened says nothing: to look at the inbox opens it.
fn is_change(event: &notify::Result<notify::Event>) -> bool {
    use notify::event::{AccessKind, AccessMode, EventKind};
    let Ok(event) = event else { return true };
    !matches!(event.kind, EventKind::Access(kind) if kind != AccessKind::Close(AccessMode::Write))
}

/// Folders in which files of the patterns may come up: what stands before the first wildcard.
fn folders(patterns: &[String]) -> Vec<PathBuf> {
    let fixed = |pattern: &String| {
        let plain = |part: &std::path::Component<'_>| !part.as_os_str().to_string_lossy().contains(['*', '?', '[']);
        let fixed: PathBuf = Path::new(pattern).components().take_while(plain).collect();
        // A pattern without a wildcard is a file.
        if fixed.as_os_str() == Path::new(pattern).as_os_str() {
            fixed.parent().map(PathBuf::from).unwrap_or_default()
        } else {
            fixed
        }
    };
    let mut all: Vec<PathBuf> = patterns.iter().map(fixed).collect();
    all.sort();
    all.dedup();
    all
}

pub(super) fn stale(ops: &Ops, global: &Global, paint: Paint) -> Result<Done, Failure> {
    let mut desk = Desk::open(ops, global)?;
    let days = desk.look(global)?;
    let is_stale = |p: &&Planned| p.day.product.is_some() && !p.day.reasons.is_empty();
    let mut done = planned(days.iter().filter(is_stale), &desk.inbox, global, paint);
    let options = joint::Options {
        events: desk.operations.events.clone().filter(|path| path.is_file()),
        ..joint::Options::default()
    };
    let many = joint::stale(&Archive::open(&desk.operations.archive)?, &joint::Declared::read(&options)?)?;
    if global.json {
        let mut value: Value = serde_json::from_str(&done.text)?;
        value["many_days"] = json!(many);
        return Ok(Done { code: done.code, ..Done::json(&value) });
    }
    for stale in many {
        let _ = writeln!(done.text, "{}", paint.bold(&stale.product));
        for reason in &stale.reasons {
            done.text += &text::labelled("", reason);
        }
    }
    Ok(done)
}

/// Days with what is to be done, and why.
fn planned<'a>(days: impl Iterator<Item = &'a Planned>, inbox: &Inbox, global: &Global, paint: Paint) -> Done {
    let days: Vec<&Planned> = days.collect();
    if global.json {
        let days: Vec<Value> = days.iter().map(|planned| json!(planned.day)).collect();
        return Done::json(&json!({"days": days, "strangers": strangers_json(inbox)}));
    }
    let mut text = String::new();
    for Planned { day, .. } in &days {
        let product = day.product.as_deref().unwrap_or("no product");
        let _ = writeln!(text, "{}  {product}", paint.bold(&day.day.to_string()));
        for reason in &day.reasons {
            text += &text::labelled("", reason);
        }
        if let Some(reason) = &day.failed {
            text += &text::labelled("failed", reason);
        }
    }
    if days.is_empty() {
        text += "every day with telemetry has the product that a run would give now\n";
    }
    Done::new(text + &strangers(inbox))
}

/// What is told of a day that was run.
struct Told {
    day: NaiveDate,
    product: Option<String>,
    verdict: Option<String>,
    reasons: Vec<String>,
    failed: Option<String>,
    /// Commands of the operators that failed.
    commands_failed: Vec<String>,
    code: u8,
}

impl Told {
    /// Runs the operator's commands for what came of a day, and tells both.
    fn of(operations: &Operations, ran: &Ran, reasons: Vec<String>) -> Self {
        let commands_failed = follow(operations, ran);
        let (product, verdict, failed, code) = match &ran.outcome {
            Outcome::Product(written) => {
                let Written { product, .. } = &**written;
                let code = super::run::code(product);
                (Some(product.id().to_owned()), product.result.verdict.clone(), None, code)
            }
            Outcome::Failed(reason) => (None, None, Some(reason.clone()), 1),
        };
        let code = if commands_failed.is_empty() { code } else { 1 };
        Self { day: ran.day, product, verdict, reasons, failed, commands_failed, code }
    }

    fn line(&self, paint: Paint) -> String {
        let mut text = match (&self.product, &self.failed) {
            (Some(id), _) => format!("{}  {id}  {}\n", self.day, self.verdict.as_deref().unwrap_or("no verdict")),
            (None, _) => format!("{}  {}\n", self.day, paint.bad("failed")),
        };
        if let Some(reason) = &self.failed {
            text += &text::labelled("", reason);
        }
        self.commands_failed.iter().for_each(|what| text += &text::labelled("", what));
        text
    }
}

fn done(told: &[Told], inbox: &Inbox, global: &Global, paint: Paint) -> Done {
    // A failure weighs most, then a model that contradicts the data, then a loss.
    let weight = |code: u8| [0, 1, INCONSISTENT, 3].iter().position(|c| *c == code).filter(|p| *p > 0);
    let worst = told.iter().filter_map(|told| weight(told.code).map(|w| (w, told.code))).min();
    let code = worst.map_or(0, |(_, code)| code);
    if global.json {
        let days: Vec<Value> = told
            .iter()
            .map(|t| {
                json!({"day": t.day.to_string(), "product": t.product, "verdict": t.verdict, "reasons": t.reasons,
                    "failed": t.failed, "commands_failed": t.commands_failed, "exit_code": t.code})
            })
            .collect();
        return Done { code, ..Done::json(&json!({"days": days, "strangers": strangers_json(inbox)})) };
    }
    let mut text: String = told.iter().map(|told| told.line(paint)).collect();
    if told.is_empty() {
        text += "nothing to do: every day with telemetry has the product that a run would give now\n";
    }
    Done { text: text + &strangers(inbox), code }
}

fn strangers(inbox: &Inbox) -> String {
    let line =
        |(path, reason): &(PathBuf, String)| text::labelled("not used", &format!("{}: {reason}", path.display()));
    inbox.strangers.iter().map(line).collect()
}

fn strangers_json(inbox: &Inbox) -> Vec<Value> {
    let entry = |(path, reason): &(PathBuf, String)| json!({"path": path.to_string_lossy(), "reason": reason});
    inbox.strangers.iter().map(entry).collect()
}

/// Runs the operator's commands for what came of a day. Gives those that failed: other days go on, and theirs too.
fn follow(operations: &Operations, ran: &Ran) -> Vec<String> {
    let Outcome::Product(written) = &ran.outcome else { return Vec::new() };
    let Product { quality, .. } = &written.product;
    let due = [(quality.data_loss, &operations.on_data_loss), (quality.inconsistent, &operations.on_inconsistent)];
    let folder = operations.path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let run = |command: &String| {
        let status = std::process::Command::new("sh")
            .args(["-c", command])
            .current_dir(folder)
            .env("DRAGFREE_PRODUCT", written.product.id())
            .env("DRAGFREE_PRODUCT_PATH", &written.path)
            .env("DRAGFREE_DAY", ran.day.to_string())
            .stdout(std::io::stderr())
            .status();
        let why = match status {
            Ok(status) if status.success() => return None,
            Ok(status) => status.to_string(),
            Err(error) => error.to_string(),
        };
        Some(format!("{}: the command `{command}` failed: {why}", operations.path.display()))
    };
    due.into_iter().filter(|(is, _)| *is).filter_map(|(_, command)| command.as_ref()).filter_map(run).collect()
}
