//! `dragfree serve` and `dragfree report`: the workbench.

use super::{Done, SOFTWARE, products};
use crate::args::{Bench, Global, Report, Serve};
use crate::failure::Failure;
use crate::{output, text, truth};
use dragfree_archive::Archive;
use dragfree_pages::jobs::{Job, Starter};
use dragfree_pages::server::{Ready, serve as pages};
use dragfree_pages::{Setup, Site, Truth};
use dragfree_workflow::operations::Operations;
use serde_json::json;
use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::SystemTime;

pub(super) fn serve(command: &Serve, global: &Global) -> Result<Done, Failure> {
    let site = Site::new(setup(&command.bench, global, command.allow_changes)?);
    let mut failed = Ok(());
    pages(site, command.listen, command.allow_changes, |ready| {
        failed = output::print(&told(ready, command, global));
        if let Some(page) = &command.open {
            open(&format!("{}{page}", ready.address));
        }
    })?;
    failed?;
    Ok(Done::new(String::new()))
}

/// Without a browser the pages are there all the same.
fn open(address: &str) {
    if let Err(error) = ::open::that_detached(address) {
        // Nobody may be reading.
        let _ = writeln!(std::io::stderr(), "no browser could be opened ({error}); open {address} in yours");
    }
}

fn told(ready: &Ready, command: &Serve, global: &Global) -> String {
    let Ready { address, token } = ready;
    let needed = command.allow_changes || !command.listen.ip().is_loopback();
    if global.json {
        return format!("{}\n", json!({ "address": address, "token": needed.then_some(token) }));
    }
    let mut text = format!("pages     {address}\n");
    if command.allow_changes {
        text += &format!("changes   {address}#token={token}\n");
    }
    if needed {
        text += &format!("token     {token}\n");
    }
    text + "end       Ctrl-C\n"
}

pub(super) fn report(command: &Report, global: &Global) -> Result<Done, Failure> {
    let site = Site::new(setup(&command.bench, global, false)?);
    let files = dragfree_pages::report(&site, &command.product, &command.out)?;
    if global.json {
        let files: Vec<String> = files.iter().map(|file| file.to_string_lossy().into_owned()).collect();
        return Ok(Done::json(&json!({ "files": files })));
    }
    let open = command.out.join("index.html");
    Ok(Done::new(format!("report    {} files\nopen      {}\n", files.len(), open.display())))
}

/// `starts` says whether pages may start commands.
fn setup(bench: &Bench, global: &Global, starts: bool) -> Result<Setup, Failure> {
    let archive = bench.archive.folder()?;
    let operations = bench.archive.operations()?;
    if starts && operations.is_some() && !archive.exists() {
        // The first day is still to come.
        Archive::create(&archive)?;
    }
    // Refuses a folder that is none, before a browser does.
    products::archive(&archive)?;
    let of = |file: fn(&Operations) -> Option<PathBuf>| operations.as_ref().and_then(file);
    let mission = bench.mission.clone().or_else(|| of(|o| o.mission.clone()));
    let named = |path: &PathBuf| format!(" --mission {}", text::quoted(&path.to_string_lossy()));
    let mission_flag = mission.as_ref().map(named).unwrap_or_default();
    let truth = bench.truth.as_deref().map(truth::first).transpose()?;
    let truth = truth.map(|values| -> Truth { Box::new(move |name| dragfree_score::offset(&values, name)) });
    Ok(Setup {
        registry: super::registry(global)?,
        mission: super::validate::mission(mission.as_deref())?,
        model: bench.model.clone().or_else(|| of(|o| o.model.clone())),
        truth,
        starter: starts.then(|| starter(operations.as_ref(), &archive, global)).transpose()?,
        events: of(|o| o.events.clone()),
        steps: operations.as_ref().map(|o| o.steps.clone().into_iter().collect()).unwrap_or_default(),
        flags: super::repeated(Some(&archive), global),
        model_flags: mission_flag + &super::repeated(None, global),
        software: SOFTWARE,
        today: Box::new(|| chrono::DateTime::<chrono::Utc>::from(SystemTime::now()).date_naive()),
        archive,
    })
}

/// This program once more, with the archive, plugins and threads of this one. Progress goes to stderr.
fn starter(operations: Option<&Operations>, archive: &Path, global: &Global) -> Result<Starter, Failure> {
    let program = std::env::current_exe()?;
    let (operations, archive) = (operations.map(|o| o.path.clone()), archive.to_owned());
    let (plugins, key, threads) = (global.plugin_dir.clone(), global.plugin_key.clone(), global.threads);
    Ok(Box::new(move |job| {
        let mut command = Command::new(&program);
        match job {
            Job::CatchUp => command.args(["catch-up", "--ops"]).arg(operations.as_ref()?),
            Job::Diagnose { product } => {
                command.args(["diagnose", product, "--keep-extract", "--archive"]).arg(&archive)
            }
        };
        for folder in &plugins {
            command.arg("--plugin-dir").arg(folder);
        }
        command.envs(key.iter().map(|key| (super::PLUGIN_KEY, key)));
        if let Some(threads) = threads {
            command.args(["--threads", &threads.to_string()]);
        }
        command.arg("-v");
        Some(command)
    }))
}
