//! Arguments. The names are a contract: scripts use them.

use crate::failure::Failure;
use crate::operations;
use crate::utc;
use chrono::NaiveDate;
use clap::{ArgAction, Args, Parser, Subcommand, ValueEnum};
use dragfree_workflow::operations::Operations;
use std::net::SocketAddr;
use std::num::NonZeroUsize;
use std::path::PathBuf;

/// Epochs that plugins are handed at a time unless the command line says otherwise.
pub(crate) const BATCH_ROWS: u32 = 4096;

/// Calibrates the offset between a drag-free spacecraft's centre of mass and its test masses.
#[derive(Debug, Parser)]
#[command(name = "dragfree", version, max_term_width = 100, arg_required_else_help = true)]
#[command(after_help = "Exit codes: 0 done, 1 failed, 2 usage, 3 done with loss of data, \
    4 done, but the data contradict the model, a test fails or an alert is raised.")]
pub(crate) struct Arguments {
    /// What to do.
    #[command(subcommand)]
    pub(crate) command: Command,
    /// Flags that every command knows.
    #[command(flatten)]
    pub(crate) global: Global,
}

#[derive(Clone, Debug, Args)]
#[command(next_help_heading = "Everywhere")]
pub(crate) struct Global {
    /// Folder with plugins, besides the one of the program; repeatable. Also DRAGFREE_PLUGIN_PATH
    #[arg(long, global = true, value_name = "DIR")]
    pub(crate) plugin_dir: Vec<PathBuf>,
    /// Public key of minisign, or its file: open no plugin but those of a plugins.lock that is signed with it. Also
    /// DRAGFREE_PLUGIN_KEY
    #[arg(long, global = true, value_name = "KEY")]
    pub(crate) plugin_key: Option<String>,
    /// Print the result as JSON
    #[arg(long, global = true)]
    pub(crate) json: bool,
    /// No progress, errors only
    #[arg(short, long, global = true, conflicts_with = "verbose")]
    pub(crate) quiet: bool,
    /// Progress and log lines on stderr; twice for more
    #[arg(short, long, global = true, action = ArgAction::Count)]
    pub(crate) verbose: u8,
    /// Write the log lines of -vv into a file, a JSON object a line
    #[arg(long, global = true, value_name = "FILE")]
    pub(crate) log_json: Option<PathBuf>,
    /// Colours
    #[arg(long, global = true, value_enum, default_value_t = Colour::Auto, value_name = "WHEN")]
    pub(crate) color: Colour,
    /// Threads that a run may use
    #[arg(long, global = true, value_name = "N", value_parser = clap::value_parser!(u16).range(1..))]
    pub(crate) threads: Option<u16>,
    /// Seconds after which a call of a plugin that has not come back ends the program
    #[arg(long, global = true, value_name = "S", default_value_t = 600.0, value_parser = seconds)]
    pub(crate) plugin_time_limit: f64,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum Colour {
    /// Where stdout is a terminal and NO_COLOR is not set
    Auto,
    Always,
    Never,
}

#[derive(Debug, Subcommand)]
pub(crate) enum Command {
    /// A story: simulate hours with a hidden effect, calibrate, diagnose, mend the model, open the seal
    Demo {
        /// Folder for everything that the demo writes
        #[arg(long, value_name = "DIR", default_value = "dragfree-demo")]
        dir: PathBuf,
        /// Show the story in a browser at the end, until Ctrl-C
        #[arg(long)]
        open: bool,
    },
    /// Write the files of a new mission: mission, pipeline and model, with comments
    Init(Init),
    /// Simulate telemetry: one file per day, the truth apart in DIR/truth/
    Simulate(Simulate),
    /// Open what `simulate --hidden` hid, check that it was not changed since, and score a diagnosis against it
    Reveal(Reveal),
    /// H-infinity synthesis and allocation of a mission: gamma, bounds and margins per channel
    Design(Design),
    /// Replay telemetry through a pipeline and archive a product
    Run(Run),
    /// Where the model fails: every channel, band and hour against the noise of the mission
    Compare(Compare),
    /// Which effect is missing: a ranked list with evidence, size and what its absence does to the offset
    Diagnose(Diagnose),
    /// Check configuration without running
    #[command(subcommand)]
    Config(Config),
    /// The plugins that can be found
    #[command(subcommand)]
    Plugins(Plugins),
    /// Calibrate one day by the mission's file of operations
    Day(DayCommand),
    /// Calibrate, in order, every day that has no product or would come out otherwise now
    CatchUp(CatchUp),
    /// Stay, and calibrate days as their telemetry comes in
    Watch(Watch),
    /// The products of an archive
    #[command(subcommand)]
    Products(Products),
    /// Many days by many workers: on this machine, by Dask, or as a Slurm array
    #[command(subcommand)]
    Campaign(Campaign),
    /// One calibration of many days from the sums that their products hold, with rates, and steps at events
    Joint(Joint),
    /// Values of days with their errors, and the days that leave what those before them predict
    Trend(Trend),
    /// The calibration that holds at a time, by a set of certified products; exit code 1 where there is none
    At(At),
    /// The archive itself
    #[command(subcommand)]
    Archive(ArchiveCommand),
    /// Model files: what is in them, what changed, every revision kept
    #[command(subcommand)]
    Model(Model),
    /// The error from model revision to revision, on days of the fit and on days kept out of it
    Ladder(Ladder),
    /// The workbench: pages in a browser, served on this machine
    Serve(Serve),
    /// The workbench's pages of one product as files, for a mail or a folder on the web
    Report(Report),
    /// Print what completes this command line in a shell
    Completions {
        /// Shell
        #[arg(value_enum)]
        shell: Shell,
    },
    /// Write the man pages
    #[command(hide = true)]
    Man {
        /// Folder for the pages
        #[arg(long, value_name = "DIR")]
        out: PathBuf,
    },
}

impl Command {
    /// Whether another process of this program has started it to run a plugin apart.
    pub(crate) fn is_a_plugins_process(&self) -> bool {
        matches!(self, Self::Plugins(Plugins::Serve))
    }

    /// Whether it carries rows of telemetry through plugins, and so can end between two batches of them.
    pub(crate) fn carries_rows(&self) -> bool {
        matches!(
            self,
            Self::Demo { .. }
                | Self::Simulate(_)
                | Self::Run(_)
                | Self::Compare(_)
                | Self::Diagnose(_)
                | Self::Day(_)
                | Self::CatchUp(_)
                | Self::Watch(_)
                | Self::Serve(_)
                | Self::Products(Products::Rebuild { .. })
        )
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum Shell {
    Bash,
    Zsh,
    Fish,
}

#[derive(Debug, Args)]
pub(crate) struct Init {
    /// Folder for the files
    #[arg(value_name = "DIR")]
    pub(crate) folder: PathBuf,
    /// Mission to start from: a file, or the name of one that comes with the program
    #[arg(long, value_name = "MISSION", default_value = "taiji")]
    pub(crate) mission: PathBuf,
}

/// What `simulate --help` ends with; the simulator has the last word, and a test compares.
const EFFECTS: &str = "\
Effects, and where (TM: tm1, tm2; AXIS: x, y, z; size in SI units):
  com-offset:sc.AXIS           stiffness:TM.AXIS       cross-stiffness:TM.AXIS
  offset-drift:sc.AXIS         opening-angle:TM        es-gain:TM.y|z
  es-crosstalk:TM.FROM-TO      mps-gain:sc.AXIS        mps-tilt:sc.AXIS
  torque-gain:sc.AXIS          mps-noise:sc.AXIS       torque-noise:sc.AXIS
  is-noise:TM.AXIS             is-scale:TM.AXIS        is-crosstalk:TM.FROM-TO
  tilt-to-length:TM            time-offset:is|ifo|dws  thermal:TM.AXIS
  magnetic:TM                  charge:TM               current-force:TM.AXIS
  product-force:TM.AXIS        field-force:TM.AXIS     slosh:sc.x|y
  solar-pressure:sc            mps-correlation:layout  impulse:sc.AXIS|TM.AXIS|sc.phi|theta|psi
Some have named shapes, as thermal:tm1.x=2e-12,lag_s=480. A question, as
--effect thermal:?=0, is answered with unit, shapes and what it does.";

#[derive(Debug, Args)]
#[command(after_help = EFFECTS)]
pub(crate) struct Simulate {
    /// Mission file, or the name of one that comes with the program: taiji, taiji-thrusters, lisa, single
    #[arg(value_name = "MISSION.toml")]
    pub(crate) mission: PathBuf,
    /// Folder for the telemetry
    #[arg(long, value_name = "DIR")]
    pub(crate) out: PathBuf,
    /// First epoch, `2035-01-01` or `2035-01-01T06:00:00Z`
    #[arg(long = "start", value_name = "UTC", value_parser = utc::parse, default_value = "2035-01-01")]
    pub(crate) start_ns: i64,
    /// Length in hours [default: 6]
    #[arg(long, value_name = "H", value_parser = positive, conflicts_with = "days")]
    pub(crate) hours: Option<f64>,
    /// Length in days
    #[arg(long, value_name = "N", value_parser = positive)]
    pub(crate) days: Option<f64>,
    /// Seed of every noise
    #[arg(long, value_name = "S", default_value_t = 1)]
    pub(crate) seed: u32,
    /// Add an effect to the truth, `es-gain:tm1.y=0.02`, SI units; repeatable. The list is below
    #[arg(long = "effect", value_name = "ID:INSTANCE=SIZE[,NAME=VALUE]...", value_parser = effect)]
    pub(crate) effects: Vec<String>,
    /// Command a sine beside the control law, `sc.x=1e-7,frequency_hz=0.01,from_s=3600,until_s=5400`: N or N m, s
    /// after the first epoch; `sc.x` is thrust, `sc.phi` torque, `tm1.y` force of the electrodes; repeatable
    #[arg(
        long = "manoeuvre",
        value_name = "INPUT=AMPLITUDE,frequency_hz=F,from_s=A,until_s=B",
        conflicts_with = "no_command"
    )]
    pub(crate) manoeuvres: Vec<String>,
    /// Hide what this seed draws: mostly one effect; sealed in DIR/truth/, opened by `reveal`
    #[arg(long, value_name = "SEED")]
    pub(crate) hidden: Option<u32>,
    /// Leave out the /command topic
    #[arg(long)]
    pub(crate) no_command: bool,
}

impl Simulate {
    /// End of the simulation, exclusive, Unix ns.
    pub(crate) fn end_ns(&self) -> i64 {
        let hours = self.days.map_or(self.hours.unwrap_or(6.0), |days| 24.0 * days);
        self.start_ns.saturating_add((hours * 3600e9).round() as i64) // a cast of a float saturates
    }
}

#[derive(Debug, Args)]
pub(crate) struct Reveal {
    /// Sealed file, DIR/truth/*.sealed.json
    #[arg(value_name = "SEALED")]
    pub(crate) sealed: PathBuf,
    /// Telemetry that names its digest; repeatable [default: what lies in DIR]
    #[arg(long, value_name = "FILE")]
    pub(crate) telemetry: Vec<PathBuf>,
    /// Score the output of `dragfree diagnose --json`
    #[arg(long, value_name = "FILE")]
    pub(crate) diagnosis: Option<PathBuf>,
}

#[derive(Debug, Args)]
pub(crate) struct Design {
    /// Mission file
    #[arg(value_name = "MISSION.toml")]
    pub(crate) mission: PathBuf,
    /// Draw sensitivities and predicted spectra as SVG into this folder
    #[arg(long, value_name = "DIR")]
    pub(crate) pictures: Option<PathBuf>,
    /// Write the controllers as the section `control` of a mission file
    #[arg(long, value_name = "FILE")]
    pub(crate) freeze: Option<PathBuf>,
}

#[derive(Debug, Args)]
pub(crate) struct Run {
    #[command(flatten)]
    pub(crate) chain: Chain,
    /// First epoch
    #[arg(long, value_name = "UTC", value_parser = utc::parse)]
    pub(crate) from: Option<i64>,
    /// End of the last epoch
    #[arg(long, value_name = "UTC", value_parser = utc::parse)]
    pub(crate) until: Option<i64>,
    /// Resume from the state that an earlier run saved; refused when mission, model or plugins have changed since
    #[arg(long, value_name = "FILE")]
    pub(crate) load_state: Option<PathBuf>,
    /// Save the state once the product is archived, so that the next day can resume; may be the file resumed from
    #[arg(long, value_name = "FILE")]
    pub(crate) save_state: Option<PathBuf>,
    /// Why the product is made: operations, reprocessing or a test
    #[arg(long, value_enum, value_name = "STREAM", default_value_t = RunStream::Test)]
    pub(crate) stream: RunStream,
    /// All data of the window are in: the product is final, not a first look
    #[arg(long = "final")]
    pub(crate) is_final: bool,
    /// Epochs that plugins are handed at a time; results do not depend on it
    #[arg(long, value_name = "N", default_value_t = BATCH_ROWS, value_parser = clap::value_parser!(u32).range(1..))]
    pub(crate) batch_rows: u32,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum RunStream {
    /// Daily operations
    Oper,
    /// Reprocessing
    Rpro,
    /// A test or a simulation
    Test,
}

/// What a run is linked from.
#[derive(Debug, Args)]
pub(crate) struct Chain {
    /// Pipeline file, or the name of one that comes with the program: science-mode
    #[arg(value_name = "PIPELINE.toml")]
    pub(crate) pipeline: PathBuf,
    /// Telemetry, in any order
    #[arg(value_name = "FILE")]
    pub(crate) files: Vec<PathBuf>,
    /// Mission file in place of the pipeline's
    #[arg(long, value_name = "MISSION.toml")]
    pub(crate) mission: Option<PathBuf>,
    /// Model file in place of the pipeline's
    #[arg(long, value_name = "MODEL.toml")]
    pub(crate) model: Option<PathBuf>,
    #[command(flatten)]
    pub(crate) archive: Archive,
}

#[derive(Debug, Args)]
pub(crate) struct Archive {
    /// Folder with the products [default: that of the nearest mission-ops.toml, or `archive`]
    #[arg(long = "archive", value_name = "DIR")]
    named: Option<PathBuf>,
    /// File of operations that names the folder
    #[arg(long, value_name = "FILE", conflicts_with = "named")]
    ops: Option<PathBuf>,
}

impl Archive {
    /// The folder.
    ///
    /// # Errors
    /// The file of operations that is named cannot be read.
    pub(crate) fn folder(&self) -> Result<PathBuf, Failure> {
        self.named.clone().map_or_else(|| operations::archive(self.ops.as_deref()), Ok)
    }

    /// The file of operations that belongs to it, where there is one.
    ///
    /// # Errors
    /// It cannot be read.
    pub(crate) fn operations(&self) -> Result<Option<Operations>, Failure> {
        if self.named.is_some() { Ok(None) } else { operations::nearest(self.ops.as_deref()) }
    }
}

/// What the pages of the workbench are made from.
#[derive(Debug, Args)]
pub(crate) struct Bench {
    #[command(flatten)]
    pub(crate) archive: Archive,
    /// Model file that "Keep" adds effects to [default: that of mission-ops.toml]
    #[arg(long, value_name = "FILE")]
    pub(crate) model: Option<PathBuf>,
    /// Mission file that effects are tried with before they are kept [default: that of mission-ops.toml]
    #[arg(long, value_name = "FILE")]
    pub(crate) mission: Option<PathBuf>,
    /// Truth of a simulation whose seal is open, `DIR/truth/NAME.mcap`, to be laid over
    #[arg(long, value_name = "FILE")]
    pub(crate) truth: Option<PathBuf>,
}

#[derive(Debug, Args)]
pub(crate) struct Serve {
    #[command(flatten)]
    pub(crate) bench: Bench,
    /// Address; one of another machine's reach needs the token for reading too. Port 0 takes a free one
    #[arg(long, value_name = "ADDRESS:PORT", default_value = "127.0.0.1:7035")]
    pub(crate) listen: SocketAddr,
    /// Let pages change the model, with the token that is printed at the start. Without it they only read
    #[arg(long)]
    pub(crate) allow_changes: bool,
    /// Open a browser, at this page where one is given: `missing?products=ID`
    #[arg(long, value_name = "PAGE", num_args = 0..=1, default_missing_value = "")]
    pub(crate) open: Option<String>,
}

#[derive(Debug, Args)]
pub(crate) struct Report {
    /// Product, by its id or its day
    #[arg(value_name = "PRODUCT")]
    pub(crate) product: String,
    /// Folder for the pages
    #[arg(long, value_name = "DIR")]
    pub(crate) out: PathBuf,
    #[command(flatten)]
    pub(crate) bench: Bench,
}

/// Days of an archive.
#[derive(Debug, Args)]
pub(crate) struct Days {
    /// First and last day, `2035-01-01..2035-03-31`
    #[arg(value_name = "DAY..DAY", value_parser = days)]
    pub(crate) days: (NaiveDate, NaiveDate),
    /// Spacecraft; needed where the archive has products of several
    #[arg(long, value_name = "NAME")]
    pub(crate) spacecraft: Option<String>,
    /// Events, a list in YAML as JPL's of GRACE-FO [default: that of mission-ops.toml]
    #[arg(long, value_name = "FILE")]
    pub(crate) events: Option<PathBuf>,
    /// A kind of event, and the effect whose coefficients it changes: `MTEA=com-offset`; repeatable
    #[arg(long = "step", value_name = "EVENT=EFFECT", value_parser = step)]
    pub(crate) steps: Vec<(String, String)>,
    #[command(flatten)]
    pub(crate) archive: Archive,
}

fn days(text: &str) -> Result<(NaiveDate, NaiveDate), String> {
    let parsed = text.split_once("..").and_then(|(a, b)| Some((a.parse().ok()?, b.parse().ok()?)));
    match parsed {
        Some((first, last)) if first <= last => Ok((first, last)),
        Some(_) => Err("the last day is before the first one".to_owned()),
        None => Err("two days and two dots between them are wanted, 2035-01-01..2035-03-31".to_owned()),
    }
}

fn step(text: &str) -> Result<(String, String), String> {
    let parts = text.split_once('=').filter(|(event, effect)| !event.is_empty() && !effect.is_empty());
    let (event, effect) = parts.ok_or("EVENT=EFFECT is wanted, MTEA=com-offset")?;
    Ok((event.to_owned(), effect.to_owned()))
}

#[derive(Debug, Args)]
pub(crate) struct Joint {
    #[command(flatten)]
    pub(crate) days: Days,
    /// Coefficients are known to be constant between events: estimate no rates
    #[arg(long)]
    pub(crate) constant: bool,
    /// Archive no product
    #[arg(long)]
    pub(crate) dry_run: bool,
}

#[derive(Debug, Args)]
pub(crate) struct Trend {
    #[command(flatten)]
    pub(crate) days: Days,
    /// Draw the values of every coefficient over days
    #[arg(long, value_name = "FILE.svg")]
    pub(crate) picture: Option<PathBuf>,
    /// Write the values as a table
    #[arg(long, value_name = "FILE.csv")]
    pub(crate) csv: Option<PathBuf>,
}

/// Where a mission's parts lie.
#[derive(Debug, Args)]
pub(crate) struct Ops {
    /// File of operations [default: mission-ops.toml in this folder or the nearest one above]
    #[arg(long = "ops", value_name = "FILE")]
    pub(crate) file: Option<PathBuf>,
}

#[derive(Debug, Args)]
pub(crate) struct DayCommand {
    /// Day
    #[arg(value_name = "DATE")]
    pub(crate) day: NaiveDate,
    #[command(flatten)]
    pub(crate) ops: Ops,
}

#[derive(Debug, Args)]
pub(crate) struct CatchUp {
    /// Last day
    #[arg(long, value_name = "DATE")]
    pub(crate) until: Option<NaiveDate>,
    /// Say what is to be done, and do nothing
    #[arg(long)]
    pub(crate) dry_run: bool,
    #[command(flatten)]
    pub(crate) ops: Ops,
}

#[derive(Debug, Args)]
pub(crate) struct Watch {
    /// Wait until nothing has been written into the inbox for this long, s
    #[arg(long, value_name = "S", value_parser = seconds, default_value_t = 5.0)]
    pub(crate) settle_s: f64,
    #[command(flatten)]
    pub(crate) ops: Ops,
}

#[derive(Debug, Args)]
pub(crate) struct Compare {
    /// Products of one model: id, id without the revision, day, DAY..DAY or file
    #[arg(value_name = "PRODUCT", required = true)]
    pub(crate) products: Vec<String>,
    #[command(flatten)]
    pub(crate) archive: Archive,
    #[command(flatten)]
    pub(crate) inputs: Inputs,
    /// Write spectra, maps and tests as one page of HTML that needs nothing else
    #[arg(long, value_name = "FILE.html")]
    pub(crate) page: Option<PathBuf>,
}

#[derive(Debug, Args)]
pub(crate) struct Diagnose {
    /// Products of one model: id, id without the revision, day, DAY..DAY or file
    #[arg(value_name = "PRODUCT", required = true)]
    pub(crate) products: Vec<String>,
    #[command(flatten)]
    pub(crate) archive: Archive,
    #[command(flatten)]
    pub(crate) inputs: Inputs,
    /// Candidates to print, the named ones among them; --json has all, with limits
    #[arg(long, value_name = "N", default_value_t = 8)]
    pub(crate) top: usize,
    /// Write what --json prints to a file, too: `model add --from` and `reveal --diagnosis` read it
    #[arg(long, value_name = "FILE")]
    pub(crate) out: Option<PathBuf>,
    /// Say what would tell a named effect from what it cannot be told from: more data like these, products of the
    /// archive, or a small manoeuvre, with the σ that is expected
    #[arg(long)]
    pub(crate) next: bool,
    /// Keep what a later diagnosis of several products needs of this one, in a file beside it
    #[arg(long, conflicts_with = "extracts")]
    pub(crate) keep_extract: bool,
    /// Diagnose from the extracts of the products, without telemetry
    #[arg(long, conflicts_with = "next")]
    pub(crate) extracts: bool,
}

#[derive(Debug, Subcommand)]
pub(crate) enum Config {
    /// Check pipeline, plugins, parameters and columns; telemetry is not read
    Check(Chain),
}

#[derive(Debug, Subcommand)]
pub(crate) enum Plugins {
    /// List what was found and what was refused, with the reason
    List,
    /// Show a plugin's parameters
    Inspect {
        /// Plugin, `es-akf`
        #[arg(value_name = "ID")]
        id: String,
    },
    /// Check a plugin by itself, each check in a process of its own
    Validate(Validate),
    /// Write the skeleton of a plugin that builds and works as it is
    New(NewPlugin),
    /// Open libraries in this very process: what this command asks of its children
    #[command(hide = true)]
    Probe {
        /// Answer with digests
        #[arg(long)]
        digests: bool,
        /// Libraries
        #[arg(value_name = "FILE")]
        files: Vec<PathBuf>,
    },
    /// Run the plugin that another process asks for over stdin
    #[command(hide = true)]
    Serve,
}

#[derive(Debug, Args)]
pub(crate) struct Validate {
    /// Plugin file, or the id of one that `list` finds
    #[arg(value_name = "FILE|ID")]
    pub(crate) target: String,
    /// Mission that it is given [default: the bundled one]
    #[arg(long, value_name = "MISSION.toml")]
    pub(crate) mission: Option<PathBuf>,
    /// Parameter in place of its default; repeatable
    #[arg(long, value_name = "NAME=VALUE")]
    pub(crate) set: Vec<String>,
    /// File for a source that reads some; repeatable
    #[arg(long, value_name = "FILE")]
    pub(crate) file: Vec<PathBuf>,
    /// Seconds after which a check that is not done is stopped
    #[arg(long, value_name = "S", default_value_t = 60.0, value_parser = seconds)]
    pub(crate) time_limit: f64,
    /// One check, in this very process: what this command asks of its children
    #[arg(long, hide = true)]
    pub(crate) check: Option<String>,
    /// Kind of the plugin in a file of several
    #[arg(long, hide = true)]
    pub(crate) kind: Option<String>,
    /// Id of the plugin in a file of several
    #[arg(long, hide = true)]
    pub(crate) id: Option<String>,
}

#[derive(Debug, Args)]
pub(crate) struct NewPlugin {
    /// Id of the plugin: small letters, digits and hyphens
    #[arg(value_name = "NAME", value_parser = plugin_name)]
    pub(crate) name: String,
    /// What it is
    #[arg(long, value_enum)]
    pub(crate) kind: PluginKind,
    /// Language
    #[arg(long, value_enum, default_value_t = Language::Rust)]
    pub(crate) lang: Language,
    /// Folder to write [default: NAME]
    #[arg(long, value_name = "DIR")]
    pub(crate) out: Option<PathBuf>,
    /// Folder of the SDK, for Rust [default: the one that came with this program]
    #[arg(long, value_name = "DIR", conflicts_with = "sdk_git")]
    pub(crate) sdk: Option<PathBuf>,
    /// Repository of the SDK, for Rust
    #[arg(long, value_name = "URL")]
    pub(crate) sdk_git: Option<String>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum PluginKind {
    /// A physical cause, whose coefficient is estimated
    Effect,
    /// A stage of the chain
    Stage,
    /// Telemetry that is no file of ours
    Source,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum Language {
    Rust,
    C,
}

#[derive(Debug, Subcommand)]
pub(crate) enum Products {
    /// List the products of an archive
    List(List),
    /// Show a product
    Show {
        /// Its id, its id without the revision, its day or its file
        #[arg(value_name = "PRODUCT")]
        product: String,
        #[command(flatten)]
        archive: Archive,
    },
    /// What differs between two products: values in σ, then inputs, plugins, parameters and model
    Diff {
        /// The earlier one: its id, its id without the revision, its day or its file
        #[arg(value_name = "A")]
        first: String,
        /// The later one
        #[arg(value_name = "B")]
        second: String,
        #[command(flatten)]
        archive: Archive,
    },
    /// What a product was made of, and what was made of it
    Lineage {
        /// Its id, its id without the revision or its day
        #[arg(value_name = "PRODUCT")]
        product: String,
        /// Draw it as SVG
        #[arg(long, value_name = "FILE.svg")]
        picture: Option<PathBuf>,
        #[command(flatten)]
        archive: Archive,
    },
    /// Compare everything that belongs to products with its digests
    Verify {
        /// Products: ids, ids without the revision or days [default: all]
        #[arg(value_name = "PRODUCT")]
        products: Vec<String>,
        /// All products, the journal and every content of the archive
        #[arg(long, conflicts_with = "products")]
        all: bool,
        #[command(flatten)]
        archive: Archive,
    },
    /// Make a product again from what it was made of, and compare; a damaged one is mended by it
    Rebuild {
        /// Its id, its id without the revision or its day
        #[arg(value_name = "PRODUCT")]
        product: String,
        #[command(flatten)]
        archive: Archive,
        #[command(flatten)]
        inputs: Inputs,
    },
    /// Products that would come out otherwise now, with the reasons: telemetry, files or plugins are others
    Stale(Ops),
    /// Say that a product is not to be used any more; it stays in the archive
    Withdraw {
        /// Its id
        #[arg(value_name = "PRODUCT")]
        product: String,
        /// Why
        #[arg(long, value_name = "TEXT")]
        reason: String,
        #[command(flatten)]
        archive: Archive,
    },
    /// Say that a product holds for a time, in a set; times of a set never overlap
    Certify {
        /// Its id, its id without the revision or its day
        #[arg(value_name = "PRODUCT")]
        product: String,
        /// First time
        #[arg(long, value_name = "UTC", value_parser = utc::parse)]
        from: i64,
        /// End, exclusive
        #[arg(long, value_name = "UTC", value_parser = utc::parse, required_unless_present = "open_ended")]
        until: Option<i64>,
        /// Until further notice: a time without calibration is then not noticed as such
        #[arg(long, conflicts_with = "until")]
        open_ended: bool,
        /// Name of the set, which is made where there is none
        #[arg(long = "into", value_name = "SET")]
        set: String,
        #[command(flatten)]
        archive: Archive,
    },
    /// Take a time out of a set
    Decertify {
        /// Name of the set
        #[arg(long = "from-set", value_name = "SET")]
        set: String,
        /// Spacecraft, `SC1`
        #[arg(long, value_name = "NAME")]
        spacecraft: String,
        /// First time [default: from the beginning]
        #[arg(long, value_name = "UTC", value_parser = utc::parse)]
        from: Option<i64>,
        /// End, exclusive [default: without end]
        #[arg(long, value_name = "UTC", value_parser = utc::parse)]
        until: Option<i64>,
        #[command(flatten)]
        archive: Archive,
    },
    /// Sets of certified products
    #[command(subcommand)]
    Sets(Sets),
    /// Write the result of a product in another format
    Export {
        /// Its id, its id without the revision, its day or its file
        #[arg(value_name = "PRODUCT")]
        product: String,
        /// Format
        #[arg(long, value_enum)]
        format: Format,
        /// File [default: the terminal]
        #[arg(long, value_name = "FILE")]
        out: Option<PathBuf>,
        #[command(flatten)]
        archive: Archive,
    },
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum Format {
    /// A row per coefficient of every solution
    Csv,
    /// The same as Parquet
    Parquet,
    /// The offset of each test mass in the text format of GRACE-FO's VCM1B
    Vcm1b,
    /// The whole product
    Json,
    /// A layout of Foxglove for the time series in the .mcap beside the product
    Foxglove,
}

#[derive(Debug, Subcommand)]
pub(crate) enum Sets {
    /// List the sets, and what each says
    List(Archive),
    /// Fix a set: what it says it says always
    Publish {
        /// Name of the set
        #[arg(value_name = "SET")]
        set: String,
        #[command(flatten)]
        archive: Archive,
    },
    /// Say that a set is not to be used any more
    Invalidate {
        /// Name of the set
        #[arg(value_name = "SET")]
        set: String,
        /// Why
        #[arg(long, value_name = "TEXT")]
        reason: String,
        #[command(flatten)]
        archive: Archive,
    },
    /// Print what a set says, with the digests of its products, to be signed
    Statement {
        /// Name of the set
        #[arg(value_name = "SET")]
        set: String,
        /// Write it into this file
        #[arg(long, value_name = "FILE")]
        out: Option<PathBuf>,
        #[command(flatten)]
        archive: Archive,
    },
    /// Compare a set and its products with a statement of it that was signed
    Check {
        /// The statement; FILE.minisig is its signature
        #[arg(value_name = "FILE")]
        statement: PathBuf,
        /// Public key of minisign of who has signed it, or its file
        #[arg(long, value_name = "KEY")]
        key: String,
        #[command(flatten)]
        archive: Archive,
    },
}

#[derive(Debug, Subcommand)]
pub(crate) enum ArchiveCommand {
    /// Make the catalogue again from the journal and the products
    Reindex(Archive),
    /// Take over the products of a folder that an earlier version wrote
    Migrate(Archive),
}

#[derive(Debug, Args)]
pub(crate) struct At {
    /// Time
    #[arg(value_name = "UTC", value_parser = utc::parse)]
    pub(crate) time_ns: i64,
    /// Set of certified products [default: the only one that is not invalidated]
    #[arg(long, value_name = "SET")]
    pub(crate) set: Option<String>,
    /// Spacecraft [default: all]
    #[arg(long, value_name = "NAME")]
    pub(crate) spacecraft: Option<String>,
    #[command(flatten)]
    pub(crate) archive: Archive,
}

/// Where inputs may be that are not where they were.
#[derive(Debug, Args)]
pub(crate) struct Inputs {
    /// Look here, and in the folders inside, for telemetry that has moved; it is found by its digest; repeatable
    #[arg(long = "inputs", value_name = "DIR")]
    pub(crate) folders: Vec<PathBuf>,
}

#[derive(Debug, Args)]
pub(crate) struct List {
    #[command(flatten)]
    pub(crate) archive: Archive,
    /// First day
    #[arg(long, value_name = "DAY")]
    pub(crate) from: Option<NaiveDate>,
    /// Last day
    #[arg(long, value_name = "DAY")]
    pub(crate) until: Option<NaiveDate>,
    /// Spacecraft, `SC1`
    #[arg(long, value_name = "NAME")]
    pub(crate) spacecraft: Option<String>,
    /// agree, disagree or weak
    #[arg(long, value_name = "VERDICT")]
    pub(crate) verdict: Option<String>,
    /// Revision of the model, or its beginning
    #[arg(long, value_name = "REVISION")]
    pub(crate) model: Option<String>,
    /// Those that a set names
    #[arg(long, value_name = "SET")]
    pub(crate) set: Option<String>,
    /// Only the newest of each day that holds: not withdrawn, not in disagreement, no test on data kept out of a fit
    #[arg(long)]
    pub(crate) latest: bool,
}

#[derive(Debug, Subcommand)]
pub(crate) enum Campaign {
    /// List the tasks of a campaign: one JSON document a line, in DIR/plan.jsonl
    Plan {
        /// What the campaign is to do
        #[arg(value_name = "SPEC.toml")]
        spec: PathBuf,
        /// Folder of the campaign, which all workers see
        #[arg(long, value_name = "DIR")]
        out: PathBuf,
    },
    /// Do one task, or give the result that is there
    Task {
        /// Folder of the campaign
        #[arg(value_name = "DIR")]
        folder: PathBuf,
        /// Its id
        #[arg(value_name = "ID", required_unless_present = "number")]
        id: Option<String>,
        /// Its line in the plan, from 1, in place of the id: for job arrays
        #[arg(long, value_name = "N", conflicts_with = "id")]
        number: Option<usize>,
    },
    /// Do all tasks that have no result on this machine
    Run {
        /// Folder of the campaign
        #[arg(value_name = "DIR")]
        folder: PathBuf,
        /// Tasks at a time [default: as many as the machine has processors]
        #[arg(long, value_name = "N")]
        local: Option<NonZeroUsize>,
    },
    /// Take the results over into the archive, all of them in one step
    Commit {
        /// Folder of the campaign
        #[arg(value_name = "DIR")]
        folder: PathBuf,
    },
    /// How far the campaign has come
    Status {
        /// Folder of the campaign
        #[arg(value_name = "DIR")]
        folder: PathBuf,
    },
}

/// What can be done with a model file.
#[derive(Debug, Subcommand)]
pub(crate) enum Model {
    /// Show the effects of a model
    Show {
        /// Model file
        #[arg(value_name = "MODEL.toml")]
        model: PathBuf,
        /// An earlier revision; the number in front is enough
        #[arg(long, value_name = "REVISION")]
        revision: Option<String>,
    },
    /// List the revisions, newest first, with what changed in each
    Log {
        /// Model file
        #[arg(value_name = "MODEL.toml")]
        model: PathBuf,
    },
    /// Add an effect: a new revision
    Add(ModelAdd),
    /// Remove an effect: a new revision
    Remove {
        /// Model file
        #[arg(value_name = "MODEL.toml")]
        model: PathBuf,
        /// `es-gain:tm1.y`; the id alone where it is there once
        #[arg(value_name = "EFFECT[:INSTANCE]")]
        effect: String,
    },
    /// Make an earlier revision the newest again
    Restore {
        /// Model file
        #[arg(value_name = "MODEL.toml")]
        model: PathBuf,
        /// Its name, or the number in front
        #[arg(value_name = "REVISION")]
        revision: String,
    },
    /// Make a revision of what was edited by hand
    Commit {
        /// Model file
        #[arg(value_name = "MODEL.toml")]
        model: PathBuf,
    },
    /// Fix every coefficient at a product's value, in a model file of its own: what a held-out day is run with
    Fix(ModelFix),
}

#[derive(Debug, Args)]
pub(crate) struct ModelAdd {
    /// Model file
    #[arg(value_name = "MODEL.toml")]
    pub(crate) model: PathBuf,
    /// Effect and where it acts, `es-gain:tm1.y`; may be left out with --from
    #[arg(value_name = "EFFECT[:INSTANCE]", required_unless_present = "from")]
    pub(crate) effect: Option<String>,
    /// Set a parameter; repeatable. `dragfree plugins inspect EFFECT` lists them
    #[arg(long, value_name = "NAME=VALUE", value_parser = setting)]
    pub(crate) set: Vec<(String, String)>,
    /// Do not estimate, but fix at a value in SI units; repeatable, NAME= where the effect has several coefficients
    #[arg(long, value_name = "[NAME=]VALUE", value_parser = named_number, allow_hyphen_values = true,
        conflicts_with_all = ["value", "prior_sigma"])]
    pub(crate) fixed: Vec<(Option<String>, f64)>,
    /// Value before any data, SI; repeatable
    #[arg(long, value_name = "[NAME=]VALUE", value_parser = named_number, allow_hyphen_values = true)]
    pub(crate) value: Vec<(Option<String>, f64)>,
    /// Standard deviation before any data, SI; repeatable
    #[arg(long, value_name = "[NAME=]SIGMA", value_parser = named_number)]
    pub(crate) prior_sigma: Vec<(Option<String>, f64)>,
    /// Mission that the effect is tried with [default: the bundled one]
    #[arg(long, value_name = "MISSION.toml")]
    pub(crate) mission: Option<PathBuf>,
    /// Take effect and shape from the output of `dragfree diagnose --json`
    #[arg(long, value_name = "DIAGNOSIS.json")]
    pub(crate) from: Option<PathBuf>,
    /// Which candidate of the diagnosis [default: 1, or that of the named effect]
    #[arg(long, value_name = "N", requires = "from", conflicts_with = "effect", value_parser = clap::value_parser!(u16).range(1..))]
    pub(crate) rank: Option<u16>,
}

#[derive(Debug, Args)]
pub(crate) struct ModelFix {
    /// Model file that the product was made with
    #[arg(value_name = "MODEL.toml")]
    pub(crate) model: PathBuf,
    /// Product with the coefficients: its file, its id or its day
    #[arg(long = "from", value_name = "PRODUCT")]
    pub(crate) product: String,
    /// Effect that stays estimated, `com-offset`; repeatable
    #[arg(long, value_name = "EFFECT[:INSTANCE]")]
    pub(crate) keep: Vec<String>,
    /// Model file to write [default: MODEL.fixed.toml]
    #[arg(long, value_name = "FILE")]
    pub(crate) out: Option<PathBuf>,
    #[command(flatten)]
    pub(crate) archive: Archive,
}

#[derive(Debug, Args)]
pub(crate) struct Ladder {
    /// Products of the fit, every revision over the same data: files, ids or days
    #[arg(value_name = "PRODUCT", required = true)]
    pub(crate) products: Vec<String>,
    /// Products of other data, made with what `dragfree model fix` wrote; repeatable
    #[arg(long, value_name = "PRODUCT", num_args = 1..)]
    pub(crate) held_out: Vec<String>,
    /// Truth of a simulation, DIR/truth/*.mcap: shows the true error
    #[arg(long, value_name = "FILE")]
    pub(crate) truth: Option<PathBuf>,
    /// Draw the ladder as SVG
    #[arg(long, value_name = "FILE.svg")]
    pub(crate) picture: Option<PathBuf>,
    #[command(flatten)]
    pub(crate) archive: Archive,
}

fn setting(text: &str) -> Result<(String, String), String> {
    let (name, value) = text.split_once('=').ok_or("NAME=VALUE is needed, as in lag_s=480")?;
    Ok((name.trim().to_owned(), value.trim().to_owned()))
}

fn named_number(text: &str) -> Result<(Option<String>, f64), String> {
    let (name, number) = text.rsplit_once('=').map_or((None, text), |(name, number)| (Some(name.trim()), number));
    match number.trim().parse() {
        Ok(number) if f64::is_finite(number) => Ok((name.map(str::to_owned), number)),
        _ => Err("a finite number in SI units is needed, with NAME= in front where there are several".to_owned()),
    }
}

fn positive(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(number) if number > 0.0 && number.is_finite() => Ok(number),
        _ => Err("a number above zero is needed".to_owned()),
    }
}

/// A time in seconds that a clock can count.
fn seconds(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(number) if (1e-3..=1e9).contains(&number) => Ok(number),
        _ => Err("a number of seconds from 0.001 to 1e9 is needed".to_owned()),
    }
}

/// A name that is an id, a crate and part of a file name.
fn plugin_name(text: &str) -> Result<String, String> {
    let plain = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '-';
    if text.starts_with(|c: char| c.is_ascii_lowercase()) && text.len() <= 32 && text.chars().all(plain) {
        Ok(text.to_owned())
    } else {
        Err("small letters, digits and hyphens are needed, a letter first, 32 at most, as in my-effect".to_owned())
    }
}

/// The form alone: which effects there are is the simulator's to say.
fn effect(text: &str) -> Result<String, String> {
    let number = |value: &str| value.trim().parse().is_ok_and(|x: f64| x.is_finite());
    let mut parts = text.split(',').map(|part| part.split_once('='));
    let whole = parts.next().flatten().is_some_and(|(name, size)| {
        name.split_once(':').is_some_and(|(id, instance)| !id.is_empty() && !instance.is_empty()) && number(size)
    });
    if whole && parts.all(|part| part.is_some_and(|(name, value)| !name.is_empty() && number(value))) {
        Ok(text.to_owned())
    } else {
        Err("ID:INSTANCE=SIZE[,NAME=VALUE]... is needed, as in es-gain:tm1.y=0.02, numbers in SI units".to_owned())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::{CommandFactory, error::ErrorKind};

    fn parse(line: &str) -> Result<Arguments, clap::Error> {
        Arguments::try_parse_from(line.split(' '))
    }

    #[test]
    fn the_declaration_is_sound() {
        Arguments::command().debug_assert();
    }

    #[test]
    fn every_line_of_the_contract_parses() {
        for line in [
            "dragfree demo",
            "dragfree demo --dir d",
            "dragfree simulate m.toml --out d --start 2035-01-01 --hours 6 --seed 3 --effect es-gain:tm1.y=0.02 --no-command",
            "dragfree simulate m.toml --out d --start 2035-01-01T06:00:00Z --days 2 --hidden 7",
            "dragfree reveal d/truth/a.sealed.json --telemetry a.mcap --telemetry b.mcap --json",
            "dragfree reveal d/truth/a.sealed.json --diagnosis d.json --json",
            "dragfree run p.toml a.mcap b.mcap --mission m.toml --model c.toml --archive d --from 2035-01-01 --until 2035-01-02 --json",
            "dragfree run p.toml",
            "dragfree design m.toml --json",
            "dragfree diagnose COM1B_2035-01-01_SC1_01_0001 b.toml --archive d --json",
            "dragfree design m.toml --pictures d --freeze c.toml",
            "dragfree config check p.toml",
            "dragfree init d --mission taiji",
            "dragfree completions zsh",
            "dragfree plugins list --json --plugin-dir a --plugin-dir b",
            "dragfree plugins inspect es-akf",
            "dragfree plugins validate libmy_effect.so --mission m.toml --set channel=hk.a --file a.dat --json",
            "dragfree plugins validate es-akf --time-limit 2.5",
            "dragfree plugins new my-effect --kind effect --lang c --out d",
            "dragfree plugins new my-effect --kind stage --sdk ../core/sdk",
            "dragfree products list --json",
            "dragfree products show COM1B_2035-01-01_SC1_01_0001 --archive d --color never",
            "dragfree products list --from 2035-01-01 --until 2035-01-31 --verdict agree --model 2 --set ops --latest",
            "dragfree products diff a b --json",
            "dragfree products lineage a --picture l.svg",
            "dragfree products verify --all",
            "dragfree products verify a b",
            "dragfree products rebuild a --inputs d --inputs e",
            "dragfree products withdraw a --reason wrong",
            "dragfree products certify a --from 2035-01-01 --until 2035-02-01 --into ops",
            "dragfree products certify a --from 2035-01-01 --open-ended --into ops",
            "dragfree products decertify --from-set ops --spacecraft SC1 --from 2035-01-05 --until 2035-01-06",
            "dragfree products sets list",
            "dragfree products sets publish ops",
            "dragfree products sets invalidate ops --reason wrong",
            "dragfree products sets statement ops --out ops.toml",
            "dragfree products sets check ops.toml --key mission.pub",
            "dragfree products export a --format vcm1b --out f.txt",
            "dragfree day 2035-01-05 --ops m/mission-ops.toml",
            "dragfree catch-up --until 2035-01-05 --dry-run --json",
            "dragfree watch --settle-s 2",
            "dragfree products stale",
            "dragfree at 2035-01-05T12:00Z --set ops --json",
            "dragfree archive reindex --archive d",
            "dragfree archive migrate --archive d",
            "dragfree run p.toml --stream oper --final",
            "dragfree --threads 2 -q run p.toml",
            "dragfree -vv run p.toml",
            "dragfree run p.toml --log-json l.jsonl",
            "dragfree model show m.toml --revision 2",
            "dragfree model log m.toml --json",
            "dragfree model add m.toml es-gain:tm1.y --set lag_s=480 --value 0.01 --prior-sigma 0.05",
            "dragfree model add m.toml com-offset:tm1 --fixed x=0.09 --fixed y=-0.1",
            "dragfree model add m.toml es-gain:tm1.y --fixed -6.1e-2",
            "dragfree model add m.toml es-gain:tm1.y --value -0.01",
            "dragfree model add m.toml --from d.json --rank 2",
            "dragfree model add m.toml thermal:tm1.x --from d.json",
            "dragfree model remove m.toml es-gain:tm1.y",
            "dragfree model restore m.toml 1",
            "dragfree model commit m.toml",
            "dragfree model fix m.toml --from p.toml --keep com-offset --out h.toml",
            "dragfree ladder a b --held-out c d --truth t.mcap --picture l.svg --json",
        ] {
            parse(line).unwrap_or_else(|error| panic!("{line}: {error}"));
        }
    }

    #[test]
    fn wrong_usage_is_refused() {
        for (line, kind) in [
            ("dragfree simulate m.toml", ErrorKind::MissingRequiredArgument),
            ("dragfree simulate m.toml --out d --hours 1 --days 1", ErrorKind::ArgumentConflict),
            ("dragfree simulate m.toml --out d --hours -1", ErrorKind::UnknownArgument),
            ("dragfree simulate m.toml --out d --hours nan", ErrorKind::ValueValidation),
            ("dragfree simulate m.toml --out d --effect es-gain=1", ErrorKind::ValueValidation),
            ("dragfree simulate m.toml --out d --effect es-gain:tm1.y=much", ErrorKind::ValueValidation),
            ("dragfree simulate m.toml --out d --effect es-gain:tm1.y=1,f", ErrorKind::ValueValidation),
            ("dragfree simulate m.toml --out d --effect es-gain:tm1.y=1,f=nan", ErrorKind::ValueValidation),
            ("dragfree simulate m.toml --out d --start yesterday", ErrorKind::ValueValidation),
            ("dragfree plugins new My_Effect --kind effect", ErrorKind::ValueValidation),
            ("dragfree plugins new my-effect", ErrorKind::MissingRequiredArgument),
            ("dragfree run p.toml --threads 0", ErrorKind::ValueValidation),
            ("dragfree run p.toml --batch-rows 0", ErrorKind::ValueValidation),
            ("dragfree model add m.toml", ErrorKind::MissingRequiredArgument),
            ("dragfree model add m.toml --rank 1", ErrorKind::MissingRequiredArgument),
            ("dragfree model add m.toml a:b --from d.json --rank 1", ErrorKind::ArgumentConflict),
            ("dragfree model add m.toml a:b --fixed 1 --prior-sigma 1", ErrorKind::ArgumentConflict),
            ("dragfree model add m.toml a:b --value nan", ErrorKind::ValueValidation),
            ("dragfree model add m.toml a:b --set lag", ErrorKind::ValueValidation),
            ("dragfree ladder", ErrorKind::MissingRequiredArgument),
            ("dragfree -q -v run p.toml", ErrorKind::ArgumentConflict),
            ("dragfree frobnicate", ErrorKind::InvalidSubcommand),
        ] {
            assert_eq!(parse(line).expect_err(line).kind(), kind, "{line}");
        }
    }

    #[test]
    fn effects_and_lengths_are_read() {
        let line = "dragfree simulate m.toml --out d --effect a:b.c=-2e-3 --effect d:e=1,f_hz=0.03,g=2 --days 2";
        let Command::Simulate(simulate) = parse(line).expect("parses").command else {
            panic!("simulate was asked for")
        };
        assert_eq!(simulate.effects, ["a:b.c=-2e-3", "d:e=1,f_hz=0.03,g=2"]);
        assert_eq!(simulate.start_ns, 2_051_222_400_000_000_000);
        assert_eq!(simulate.end_ns() - simulate.start_ns, 172_800_000_000_000);
    }
}
