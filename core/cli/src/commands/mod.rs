//! One function per command; each gives back what belongs on stdout.

mod bench;
mod campaign;
mod compare;
mod days;
mod demo;
mod describe;
mod design;
mod diagnose;
mod init;
mod ladder;
mod many_days;
mod model;
mod new_plugin;
mod plugins;
mod probe;
mod products;
mod replay;
mod reveal;
mod run;
mod simulate;
mod validate;

use crate::args::{Arguments, Command, Config, Global};
use crate::failure::{Failure, Refusal};
use crate::text::{self, Paint};
use dragfree_archive::PublicKey;
use dragfree_engine::border::Isolation;
use dragfree_engine::limits::OPENING;
use dragfree_engine::registry::Registry;
use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::time::Duration;

/// Exit code where the model contradicts the data, or is not sufficient.
const INCONSISTENT: u8 = 4;

/// What a command leaves: text for stdout and the exit code.
#[derive(Debug)]
pub(crate) struct Done {
    pub(crate) text: String,
    pub(crate) code: u8,
}

impl Done {
    fn new(text: String) -> Self {
        Self { text, code: 0 }
    }

    fn json(value: &serde_json::Value) -> Self {
        Self::new(format!("{value:#}\n"))
    }
}

/// Does what the arguments say.
pub(crate) fn execute(arguments: &Arguments, paint: Paint) -> Result<Done, Failure> {
    let global = &arguments.global;
    match &arguments.command {
        Command::Demo { dir, open } => demo::execute(dir, *open, global, paint),
        Command::Init(command) => init::execute(command, global.json),
        Command::Completions { shell } => describe::completions(*shell),
        Command::Man { out } => describe::man(out),
        Command::Simulate(command) => simulate::execute(command, global),
        Command::Reveal(command) => reveal::execute(command, global, paint),
        Command::Design(command) => design::execute(command, global, paint),
        Command::Run(command) => run::execute(command, global, paint),
        Command::Compare(command) => compare::execute(command, global, paint),
        Command::Diagnose(command) => diagnose::execute(command, global, paint),
        Command::Config(Config::Check(chain)) => run::config_check(chain, global),
        Command::Plugins(command) => plugins::execute(command, global, paint),
        Command::Day(command) => days::day(command, global, paint),
        Command::CatchUp(command) => days::catch_up(command, global, paint),
        Command::Watch(command) => days::watch(command, global, paint),
        Command::Products(command) => products::execute(command, global, paint),
        Command::Campaign(command) => campaign::execute(command, global, paint),
        Command::Joint(command) => many_days::joint(command, global.json, paint),
        Command::Trend(command) => many_days::trend(command, global.json, paint),
        Command::At(command) => products::at(command, global.json, paint),
        Command::Archive(command) => products::of_archive(command, global.json),
        Command::Model(command) => model::execute(command, global, paint),
        Command::Ladder(command) => ladder::execute(command, global.json, paint),
        Command::Serve(command) => bench::serve(command, global),
        Command::Report(command) => bench::report(command, global),
    }
}

/// The plugins of the folders asked for and of the program's own; two of one id are an error.
fn registry(global: &Global) -> Result<Registry, Failure> {
    let registry = discovered(global)?;
    registry.check_ids()?;
    Ok(registry)
}

/// The same as they were found.
fn discovered(global: &Global) -> Result<Registry, Failure> {
    let listed = std::env::var_os("DRAGFREE_PLUGIN_PATH").unwrap_or_default();
    let listed = std::env::split_paths(&listed).filter(|folder| !folder.as_os_str().is_empty());
    let mut folders: Vec<PathBuf> = global.plugin_dir.iter().cloned().chain(listed).collect();
    if let Some(missing) = folders.iter().find(|folder| !folder.is_dir()) {
        return Err(Refusal::PluginFolder(missing.clone()).into());
    }
    folders.extend(own_folders());
    let limit = Duration::from_secs_f64(global.plugin_time_limit).min(OPENING);
    let key = plugin_key(global)?;
    Ok(Registry::discover_probed(&folders, isolation(global)?, key.as_ref(), &mut |files, by| {
        probe::probe(files, by, limit)
    }))
}

/// The environment variable with the key of who vouches for plugins.
const PLUGIN_KEY: &str = "DRAGFREE_PLUGIN_KEY";

/// The key of who vouches for plugins.
fn plugin_key(global: &Global) -> Result<Option<PublicKey>, Failure> {
    let of_environment = || std::env::var(PLUGIN_KEY).ok().filter(|key| !key.is_empty());
    let given = global.plugin_key.clone().or_else(of_environment);
    given.map(|given| public_key("--plugin-key", &given)).transpose()
}

/// A key that an option gives as a file or as text.
fn public_key(option: &str, given: &str) -> Result<PublicKey, Failure> {
    PublicKey::of(given).map_err(|what| format!("{option} {given}: {what}").into())
}

/// This program again, for a plugin that is to run in a process of its own.
fn isolation(global: &Global) -> Result<Isolation, Failure> {
    let program = std::env::current_exe().map_err(|error| format!("this program cannot find itself: {error}"))?;
    let arguments = ["plugins", "serve", "--quiet"].map(OsString::from).to_vec();
    Ok(Isolation { program, arguments, limit: Duration::from_secs_f64(global.plugin_time_limit) })
}

/// Beside the program, which is also where a build puts the plugins, and where an installation does.
fn own_folders() -> Vec<PathBuf> {
    let program = std::env::current_exe().and_then(|path| path.canonicalize());
    let Some(beside) = program.ok().and_then(|path| path.parent().map(PathBuf::from)) else {
        return Vec::new();
    };
    let installed = beside.with_file_name("lib").join("dragfree");
    [beside, installed].into_iter().filter(|folder| folder.is_dir()).collect()
}

/// What a suggested command repeats of this one, so that it finds the same products and plugins; a space before each
/// word.
fn repeated(archive: Option<&Path>, global: &Global) -> String {
    let archive = archive.into_iter().map(|folder| ("--archive", folder));
    let plugins = global.plugin_dir.iter().map(|folder| ("--plugin-dir", folder.as_path()));
    let word = |(flag, folder): (&str, &Path)| format!(" {flag} {}", text::quoted(&folder.to_string_lossy()));
    let key = global.plugin_key.iter().map(|key| ("--plugin-key", Path::new(key)));
    archive.chain(plugins).chain(key).map(word).collect()
}

/// Threads that may work: as asked for, or as many as the machine has.
fn threads(global: &Global) -> usize {
    let all = || std::thread::available_parallelism().map_or(1, std::num::NonZero::get);
    global.threads.map_or_else(all, usize::from)
}

/// Version of the program, as products tell it.
const SOFTWARE: &str = concat!("dragfree ", env!("CARGO_PKG_VERSION"));

/// Now, and by this program.
fn stamp() -> dragfree_archive::Stamp<'static> {
    dragfree_archive::Stamp { time: std::time::SystemTime::now().into(), software: SOFTWARE }
}
