//! Where rows come from: MCAP files, or a source plugin.

use serde_json::json;
use std::collections::BTreeMap;
use std::ops::Range;
use std::path::{Path, PathBuf};

use dragfree_schema::Report;

use crate::EngineError;
use crate::border::{BorderError, Config, Instance};
use crate::chain;
use crate::config::{Mission, resolve_parameters};
use crate::input::InputFile;
use crate::registry::{Found, Registry};
use crate::replay::Replay;
use crate::sealed::Sealed;
use crate::table::{Chunk, TableSpec};
use dragfree_archive::files::IoContext as _;
use dragfree_archive::product::{Input, Loss};

/// Rows in stretches of time.
pub trait Feed {
    /// Its tables.
    fn tables(&self) -> &[TableSpec];

    /// The next stretch; `None` at the end.
    ///
    /// # Errors
    /// The feed failed.
    fn next(&mut self) -> Result<Option<Chunk>, EngineError>;

    /// Times that the feed expects to cover, Unix ns; `None` where it cannot know.
    fn span_ns(&self) -> Option<Range<i64>>;

    /// The files that it reads, with their digests, in the order in which they were given; what the files' own sums say
    /// goes to the summary.
    ///
    /// # Errors
    /// A file is not what it was when it was opened, or cannot be read.
    fn inputs(&mut self) -> Result<Vec<Input>, EngineError>;

    /// That no file has changed since it was opened.
    ///
    /// # Errors
    /// One has.
    fn unchanged(&self) -> Result<(), EngineError>;

    /// What there is to say at the end.
    ///
    /// # Errors
    /// The feed failed.
    fn summary(&mut self) -> Result<Summary, EngineError>;

    /// The source plugin, if it is one.
    fn source(&self) -> Option<&SourceFeed> {
        None
    }
}

/// What a feed has to say at its end.
#[derive(Clone, Debug, Default)]
pub struct Summary {
    /// `UTC`, `TAI` or `GPS`.
    pub time_scale: String,
    /// What was counted.
    pub counts: BTreeMap<String, u64>,
    /// What was lost.
    pub losses: Vec<Loss>,
    /// Sentences for the operator.
    pub notes: Vec<String>,
    /// The report of a source plugin.
    pub report: Option<Report>,
}

/// Telemetry files.
pub struct FileFeed {
    replay: Replay,
    files: Vec<PathBuf>,
    window_ns: Option<Range<i64>>,
}

impl FileFeed {
    /// Opens the files. What comes before `run_in_until_ns`, Unix ns, only settles the stages.
    ///
    /// # Errors
    /// [`EngineError::Replay`]; or the telemetry is of another spacecraft than the mission.
    pub fn open(
        files: &[PathBuf],
        window_ns: Option<Range<i64>>,
        run_in_until_ns: Option<i64>,
        threads: usize,
        mission: &Mission,
    ) -> Result<Self, EngineError> {
        let mut replay = Replay::open_with_run_in(files, window_ns.clone(), run_in_until_ns, threads)?;
        if replay.tables().is_empty() {
            let losses = replay.losses();
            let said =
                losses.entries().into_iter().map(|l| l.detail).chain(losses.notes()).collect::<Vec<_>>().join("; ");
            return Err(EngineError::NoTelemetry { files: files.to_vec(), said });
        }
        let spacecraft = &replay.info().spacecraft;
        if !spacecraft.is_empty() && *spacecraft != mission.spacecraft {
            return Err(EngineError::WrongSpacecraft {
                telemetry: spacecraft.clone(),
                mission: mission.spacecraft.clone(),
                path: mission.path.clone(),
            });
        }
        replay.hash_ahead();
        Ok(Self { replay, files: files.to_vec(), window_ns })
    }
}

impl Feed for FileFeed {
    fn tables(&self) -> &[TableSpec] {
        self.replay.tables()
    }

    fn next(&mut self) -> Result<Option<Chunk>, EngineError> {
        Ok(self.replay.next()?)
    }

    fn span_ns(&self) -> Option<Range<i64>> {
        let covered = &self.replay.info().covered_ns;
        let (mut first, mut end) = (covered.first()?.start, covered.last()?.end);
        if let Some(window) = &self.window_ns {
            first = first.max(window.start);
            end = end.min(window.end);
        }
        Some(first..end)
    }

    fn inputs(&mut self) -> Result<Vec<Input>, EngineError> {
        let digests = self.replay.digests()?;
        Ok(self.files.iter().zip(digests).map(|(path, (size, sha256))| telemetry(path, size, sha256)).collect())
    }

    fn unchanged(&self) -> Result<(), EngineError> {
        Ok(self.replay.unchanged()?)
    }

    fn summary(&mut self) -> Result<Summary, EngineError> {
        let (losses, run_in) = (self.replay.losses(), self.replay.losses_of_run_in());
        let lost = run_in.entries().into_iter().map(|loss| format!("{} {}: {}", loss.count, loss.kind, loss.detail));
        let before = lost.chain(run_in.notes());
        let before = before.map(|what| format!("in the time before the data, which only settles the stages: {what}"));
        Ok(Summary {
            time_scale: self.replay.info().time_scale.clone(),
            counts: losses.counts(),
            losses: losses.entries(),
            notes: losses.notes().into_iter().chain(before).collect(),
            report: None,
        })
    }
}

/// A file of telemetry as a product names it.
fn telemetry(path: &Path, size: u64, sha256: String) -> Input {
    let name = path.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
    Input { role: "telemetry".to_owned(), name, size, sha256 }
}

/// A source plugin.
#[derive(Debug)]
pub struct SourceFeed {
    /// The plugin and its library.
    pub found: Found,
    /// Its parameters, complete.
    pub parameters: serde_json::Map<String, serde_json::Value>,
    instance: Instance,
    tables: Vec<TableSpec>,
    span_ns: Option<Range<i64>>,
    /// The files that it was given, as they were before it opened them.
    files: Vec<(InputFile, Input)>,
    rows: u32,
    done: bool,
    /// Steps in a row that gave no row and went nowhere.
    idle: u32,
    complete_until_ns: i64,
}

/// Most steps in a row in which a source may give nothing and go nowhere: it would never end.
const MOST_IDLE: u32 = 10_000;

/// What a source is opened with.
#[derive(Clone, Debug)]
pub struct SourceOptions<'a> {
    /// File that gives the parameters, for messages.
    pub given_in: String,
    /// Parameters as given.
    pub parameters: &'a toml::Table,
    /// Files to read.
    pub files: &'a [PathBuf],
    /// Times wanted, Unix ns.
    pub window_ns: Option<Range<i64>>,
    /// Epochs per stretch.
    pub rows: usize,
}

impl SourceFeed {
    /// Makes the source and asks for its tables.
    ///
    /// # Errors
    /// The plugin is missing, or refuses its parameters, its files or the mission.
    pub fn open(
        registry: &Registry,
        id: &str,
        mission: &Mission,
        options: &SourceOptions<'_>,
    ) -> Result<Self, EngineError> {
        let found = registry.find(crate::border::Kind::Source, id)?;
        let parameters = resolve_parameters(&options.given_in, &found.info.manifest, options.parameters)?;
        let config = Config {
            value: json!({
                "parameters": parameters,
                "mission": mission.value,
                "files": options.files,
                "start_ns": options.window_ns.as_ref().map(|w| w.start),
                "end_ns": options.window_ns.as_ref().map(|w| w.end),
            }),
        };
        let files = options.files.iter().map(|path| before(path)).collect::<Result<_, _>>()?;
        let (instance, tables) = chain::open_source(&found, &config)?;
        Ok(Self {
            found,
            parameters,
            instance,
            tables,
            span_ns: options.window_ns.clone(),
            files,
            rows: u32::try_from(options.rows.max(1)).unwrap_or(u32::MAX),
            done: false,
            idle: 0,
            complete_until_ns: i64::MIN,
        })
    }
}

/// A file before a plugin opens it by its path.
fn before(path: &Path) -> Result<(InputFile, Input), EngineError> {
    let input = InputFile::open(path).at("read", path)?;
    let sha256 = input.sums(0).at("read", path)?.sha256;
    let named = telemetry(path, input.size(), sha256);
    Ok((input, named))
}

/// End of the name of an attachment that is sealed: the source's secret until it is revealed.
const SEALED: &str = "sealed.json";

impl SourceFeed {
    /// What the source wants sealed, the attachment `sealed.json` of its report; it is never part of a product.
    ///
    /// # Errors
    /// The source failed.
    pub fn sealed(&mut self) -> Result<Option<Sealed>, EngineError> {
        let report = self.instance.report("[]").map_err(chain::ChainError::from)?;
        let sealed = report.attachments.iter().find(|a| a.suffix == SEALED);
        Ok(sealed.map(|a| Sealed::new(&a.text)))
    }
}

impl Feed for SourceFeed {
    fn tables(&self) -> &[TableSpec] {
        &self.tables
    }

    fn next(&mut self) -> Result<Option<Chunk>, EngineError> {
        if self.done {
            return Ok(None);
        }
        let step = self.instance.next(self.rows).map_err(chain::ChainError::from)?;
        self.done = step.done;
        let went_on = step.batches.iter().any(|b| b.rows() > 0) || step.complete_until_ns > self.complete_until_ns;
        self.idle = if went_on { 0 } else { self.idle + 1 };
        self.complete_until_ns = step.complete_until_ns;
        if self.idle > MOST_IDLE && !self.done {
            let what = format!("{MOST_IDLE} steps in a row without a row, and time stands still; say `done`");
            let plugin = self.found.info.manifest.id.clone();
            return Err(chain::ChainError::from(BorderError::Rule { plugin, call: "next", what }).into());
        }
        Ok(Some(Chunk { batches: step.batches, complete_until_ns: step.complete_until_ns }))
    }

    fn span_ns(&self) -> Option<Range<i64>> {
        self.span_ns.clone()
    }

    fn inputs(&mut self) -> Result<Vec<Input>, EngineError> {
        self.unchanged()?;
        Ok(self.files.iter().map(|(_, named)| named.clone()).collect())
    }

    fn unchanged(&self) -> Result<(), EngineError> {
        for (input, _) in &self.files {
            if !input.is_unchanged().and_then(|same| Ok(same && input.is_in_place()?)).at("read", input.path())? {
                return Err(crate::replay::ReplayError::Changed { path: input.path().to_owned() }.into());
            }
        }
        Ok(())
    }

    fn summary(&mut self) -> Result<Summary, EngineError> {
        let mut report = self.instance.report("[]").map_err(chain::ChainError::from)?;
        report.attachments.retain(|a| a.suffix != SEALED);
        let time_scale = report.quality.get("time_scale").and_then(|v| v.as_str()).filter(|t| !t.is_empty());
        Ok(Summary { time_scale: time_scale.unwrap_or("UTC").to_owned(), report: Some(report), ..Summary::default() })
    }

    fn source(&self) -> Option<&SourceFeed> {
        Some(self)
    }
}
