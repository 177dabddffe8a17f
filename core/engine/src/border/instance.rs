//! A plugin instance: created, linked, fed, asked for report and state, destroyed; in this process or in one of its
//! own.

use dragfree_schema::Report;

use super::call::{Config, LinkRequest, Rows, SourceStep};
use super::isolated::{Isolated, Isolation};
use super::library::{Kind, Library, PluginInfo};
use super::link::Linked;
use super::local::Local;
use super::{BorderError, read};
use crate::table::Batch;

/// A plugin instance.
#[derive(Debug)]
pub struct Instance {
    /// Id, with the instance of an effect: `com-offset:tm1`.
    pub name: String,
    /// Source, stage or effect.
    pub kind: Kind,
    body: Body,
    /// Where the last report broke its schema.
    broken_in_report: Vec<String>,
}

/// Where an instance lives.
#[derive(Debug)]
enum Body {
    Here(Local),
    Apart(Isolated),
}

/// Calls a function of the instance, wherever that is.
macro_rules! body {
    ($instance:expr, $call:ident($($argument:expr),*)) => {
        match &mut $instance.body {
            Body::Here(local) => local.$call($($argument),*),
            Body::Apart(isolated) => isolated.$call($($argument),*),
        }
    };
}

impl Instance {
    /// Makes an instance in this process.
    ///
    /// # Errors
    /// The plugin refused the configuration.
    pub fn create(library: &Library, plugin: &PluginInfo, config: &Config) -> Result<Self, BorderError> {
        Ok(Self::new(plugin, config, Body::Here(Local::create(library, plugin, config)?)))
    }

    /// Makes an instance in a process of its own.
    ///
    /// # Errors
    /// The plugin refused the configuration, or the process cannot be started.
    pub fn create_apart(
        isolation: &Isolation,
        library: &Library,
        plugin: &PluginInfo,
        config: &Config,
    ) -> Result<Self, BorderError> {
        Ok(Self::new(plugin, config, Body::Apart(Isolated::create(isolation, library, plugin, config)?)))
    }

    fn new(plugin: &PluginInfo, config: &Config, body: Body) -> Self {
        Self { name: config.name_of(plugin), kind: plugin.kind, body, broken_in_report: Vec::new() }
    }

    /// Links it: it declares what it reads and writes.
    ///
    /// # Errors
    /// A column is missing or is another than wanted: [`BorderError::Link`] holds the sentence.
    pub fn link(&mut self, request: LinkRequest<'_>) -> Result<Linked, BorderError> {
        body!(self, link(request))
    }

    /// Lets it allocate for batches of at most `max_rows` rows.
    ///
    /// # Errors
    /// The plugin failed.
    pub fn activate(&mut self, max_rows: u32) -> Result<(), BorderError> {
        body!(self, activate(max_rows))
    }

    /// One batch; `None` when the plugin discarded it.
    ///
    /// # Errors
    /// The plugin failed or broke a rule of the border.
    pub fn process(&mut self, tables: &[Rows<'_>], complete_until_ns: i64) -> Result<Option<Vec<Batch>>, BorderError> {
        body!(self, process(tables, complete_until_ns))
    }

    /// About `rows` more epochs of a source.
    ///
    /// # Errors
    /// The plugin failed or broke a rule of the border.
    pub fn next(&mut self, rows: u32) -> Result<SourceStep, BorderError> {
        body!(self, next(rows))
    }

    /// The rows that a lag held back.
    ///
    /// # Errors
    /// The plugin failed or broke a rule of the border.
    pub fn flush(&mut self) -> Result<Vec<Batch>, BorderError> {
        body!(self, flush())
    }

    /// The report; unknown keys become notes in it.
    ///
    /// # Errors
    /// The plugin failed, or gave what cannot be understood: the sentence names the key.
    pub fn report(&mut self, earlier_json: &str) -> Result<Report, BorderError> {
        let Some(bytes) = body!(self, report(earlier_json))? else { return Ok(Report::default()) };
        let broke = |what| BorderError::Rule { plugin: self.name.clone(), call: "report", what };
        let (report, broken) = read::report(&String::from_utf8_lossy(&bytes)).map_err(broke)?;
        self.broken_in_report = broken;
        Ok(Report { plugin: self.name.clone(), ..report })
    }

    /// Where the last report broke its schema, and was read all the same.
    pub(crate) fn broken_in_report(&self) -> &[String] {
        &self.broken_in_report
    }

    /// The whole state.
    ///
    /// # Errors
    /// The plugin failed.
    pub fn save(&mut self) -> Result<Vec<u8>, BorderError> {
        body!(self, save())
    }

    /// Takes a state back.
    ///
    /// # Errors
    /// The bytes are no state of this plugin.
    pub fn load(&mut self, state: &[u8]) -> Result<(), BorderError> {
        body!(self, load(state))
    }
}
