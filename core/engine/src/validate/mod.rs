//! A plugin by itself: what `plugin.h` asks and what the chain relies on, checked over made-up inputs, without any
//! other plugin.
//!
//! A [`Check`] is run in the process of the caller. A plugin that crashes takes that process with it, so a caller that
//! wants to go on runs each check in a process of its own, as `dragfree plugins validate` does.

mod session;
mod stand;

pub use dragfree_schema::Coefficient;
use dragfree_schema::ParameterType;
use serde::Serialize;
use serde_json::{Value, json};
use std::path::PathBuf;

use crate::border::{BorderError, Config, Kind, Library, LinkRequest, Linked, Manifest, PluginInfo};
use crate::config::{ConfigError, Mission, resolve_parameters};
use crate::table::{Batch, Column};
use session::{Given, Session, difference};

/// Epochs that a check feeds: ten minutes at 10 Hz.
const EPOCHS: usize = 6000;
/// Epochs without any value in [`Check::Gaps`].
const GAP: std::ops::Range<usize> = 2000..2050;
/// Sizes of batches whose results must agree.
const BATCHES: [usize; 4] = [EPOCHS, 1, 7, 512];

/// Something that is checked.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Check {
    /// The manifest says who it is, and every default is one that the parameter's own declaration allows.
    Manifest,
    /// Every instance can be created.
    Create,
    /// Every instance finds its columns, and what it announces is whole.
    Link,
    /// Times ascend, no value is infinite; an effect gives one row per input row, finite after its transient.
    Values,
    /// Missing values are no failure.
    Gaps,
    /// Results do not depend on where batches end, bit by bit.
    Batches,
    /// Twice the same input gives the same, bit by bit.
    Replay,
    /// A state that is saved, loaded and saved again is the same bytes, and the instance that took it over goes on as
    /// the first.
    State,
    /// Bytes that are no state are refused.
    Garbage,
}

impl Check {
    /// In the order in which they make sense.
    pub const ALL: [Self; 9] = {
        use Check::*;
        [Manifest, Create, Link, Values, Gaps, Batches, Replay, State, Garbage]
    };
}

impl std::fmt::Display for Check {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        self.serialize(f)
    }
}

/// Why a check fails.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs, reason = "every field is named in its sentence")]
pub enum Finding {
    /// The plugin failed or broke a rule of the border.
    #[error(transparent)]
    Border(#[from] BorderError),
    /// The parameters given are not those that it declares.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// The manifest is not whole.
    #[error("manifest: {0}")]
    Manifest(String),
    /// What an instance announced or gave is not what the chain relies on.
    #[error("{instance}: {what}")]
    Broken { instance: String, what: String },
}

/// The plugin and what it is given.
#[derive(Debug)]
pub struct Subject<'a> {
    /// Its library.
    pub opened: &'a Library,
    /// Which of the library's plugins.
    pub plugin: &'a PluginInfo,
    /// The mission.
    pub mission: &'a Mission,
    /// Parameters besides the defaults.
    pub parameters: &'a toml::Table,
    /// Files, for a source that reads some.
    pub files: &'a [PathBuf],
}

/// The rate of most rows, where it is not the one declared, within a hundredth.
fn other_rate(batch: &Batch, declared_hz: f64) -> Option<f64> {
    let mut steps: Vec<i64> = batch.time_ns.windows(2).map(|pair| pair[1] - pair[0]).collect();
    steps.sort_unstable();
    let step = steps.get(steps.len() / 2).filter(|step| **step > 0)?;
    let found_hz = 1e9 / *step as f64;
    ((found_hz / declared_hz - 1.0).abs() > 0.01).then_some(found_hz)
}

impl Subject<'_> {
    /// Runs a check and gives one sentence about what was looked at.
    ///
    /// # Errors
    /// The first [`Finding`].
    pub fn run(&self, check: Check) -> Result<String, Finding> {
        match check {
            Check::Manifest => manifest(&self.plugin.manifest, self.plugin.kind),
            Check::Create => self.each(|s, name| s.create(name, false).map(|_| ()), "came to life"),
            Check::Link => self.each(Self::link, "found their columns"),
            Check::Values => self.each(|s, name| s.values(name, None), "gave rows that can be used"),
            Check::Gaps if self.plugin.kind == Kind::Source => Ok("a source has no input".to_owned()),
            Check::Gaps => self.each(|s, name| s.values(name, Some(GAP)), "went on over 50 epochs without values"),
            Check::Batches => self.each(Self::batches, "gave the same in batches of 6000, 1, 7 and 512"),
            Check::Replay => self.each(Self::replay, "gave the same twice"),
            Check::State => self.each(Self::state, "went on from their states"),
            Check::Garbage => self.each(Self::garbage, "refused what is no state"),
        }
    }

    /// The coefficients that an instance of an effect announces; none where it finds no column to its liking among the
    /// made-up ones, which says nothing of a mission's own.
    ///
    /// # Errors
    /// [`Finding`]: its parameters are not those it declares, or it refuses them.
    pub fn coefficients(&self, instance: &str) -> Result<Option<Vec<Coefficient>>, Finding> {
        self.create(instance, false)?;
        let Ok((_, _, linked)) = self.linked(instance, false) else { return Ok(None) };
        Ok(Some(linked.coefficients))
    }

    /// The same, or why it finds no column to its liking among the made-up ones.
    ///
    /// # Errors
    /// [`Finding`]: as above, and what it refuses when it is linked.
    pub fn announced_coefficients(&self, instance: &str) -> Result<Vec<Coefficient>, Finding> {
        let (_, _, linked) = self.linked(instance, false)?;
        Ok(linked.coefficients)
    }

    /// The columns that are made up for it, the most of them.
    pub fn columns(&self) -> Vec<Column> {
        let rate_hz = 1e9 / self.step_ns() as f64;
        stand::stands(self.plugin.kind, rate_hz, &serde_json::Map::new()).into_iter().next().unwrap_or_default()
    }

    /// Runs `check` for each instance; a stage or a source has one.
    fn each(&self, check: impl Fn(&Self, &str) -> Result<(), Finding>, what: &str) -> Result<String, Finding> {
        let instances = self.plugin.manifest.instances_on(&self.mission.value);
        if self.plugin.manifest.instances.is_empty() {
            check(self, "")?;
            return Ok(format!("1 instance: {what}"));
        }
        instances.iter().try_for_each(|name| check(self, name))?;
        Ok(format!("{} instances: {what}", instances.len()))
    }

    fn broken(&self, instance: &str, what: impl Into<String>) -> Finding {
        let id = &self.plugin.manifest.id;
        let instance = if instance.is_empty() { id.clone() } else { format!("{id}:{instance}") };
        Finding::Broken { instance, what: what.into() }
    }

    fn create(&self, instance: &str, candidate: bool) -> Result<crate::border::Instance, Finding> {
        let manifest = &self.plugin.manifest;
        let value = json!({
            "parameters": resolve_parameters("the command line", manifest, self.parameters)?,
            "mission": self.mission.value,
            "instance": instance,
            "candidate": candidate,
            "needs": [],
            "threads": 1,
            "files": self.files,
            "start_ns": stand::START_NS,
            "end_ns": stand::START_NS + EPOCHS as i64 * self.step_ns(),
        });
        Ok(crate::border::Instance::create(self.opened, self.plugin, &Config { value })?)
    }

    /// Interval of the mission's epochs, ns.
    fn step_ns(&self) -> i64 {
        let rate_hz = self.mission.value["mission"]["sample_rate_hz"].as_f64().filter(|rate| *rate > 0.0);
        (1e9 / rate_hz.unwrap_or(10.0)).round() as i64
    }

    /// A linked instance, the columns that it was offered and what it said.
    fn linked(
        &self,
        instance: &str,
        candidate: bool,
    ) -> Result<(crate::border::Instance, Vec<Column>, Linked), Finding> {
        let rate_hz = 1e9 / self.step_ns() as f64;
        let parameters = resolve_parameters("the command line", &self.plugin.manifest, self.parameters)?;
        let mut refused = None;
        for available in stand::stands(self.plugin.kind, rate_hz, &parameters) {
            let mut node = self.create(instance, candidate)?;
            match node.link(LinkRequest { available: &available, model_json: stand::MODEL }) {
                Ok(linked) => return Ok((node, available, linked)),
                // A stage that makes the grid stands before it: the next stand has less.
                Err(BorderError::Link { sentence, .. }) if sentence.contains("exists already") => {}
                Err(other) => refused = refused.or(Some(other)),
            }
        }
        Err(refused.map_or_else(|| self.broken(instance, "writes columns that the telemetry has"), Finding::from))
    }

    fn session(&self, instance: &str, gap: Option<std::ops::Range<usize>>) -> Result<Session, Finding> {
        let (mut node, available, linked) = self.linked(instance, false)?;
        node.activate(u32::try_from(EPOCHS).unwrap_or(u32::MAX))?;
        Ok(Session::new(node, self.plugin.kind, &available, &linked, self.step_ns(), gap))
    }

    fn link(&self, instance: &str) -> Result<(), Finding> {
        let (_, available, linked) = self.linked(instance, false)?;
        if self.plugin.kind == Kind::Effect {
            self.announced(instance, &available, &linked)?;
            let (_, available, linked) = self.linked(instance, true)?;
            self.announced(instance, &available, &linked)?;
        }
        for column in linked.writes.iter().flat_map(|t| &t.columns) {
            if column.unit.is_empty() && !column.name.ends_with("status") && !column.name.ends_with("flag") {
                let what = format!("column {}:{} has no unit; `1` is the unit of a number", column.table, column.name);
                return Err(self.broken(instance, what));
            }
        }
        Ok(())
    }

    /// Coefficients with name, unit, range, and columns that say which coefficient and which channel they belong to.
    fn announced(&self, instance: &str, available: &[Column], linked: &Linked) -> Result<(), Finding> {
        let fail = |what: String| Err(self.broken(instance, what));
        let start = format!("{}.{instance}", self.plugin.manifest.id);
        let mut names = Vec::new();
        for c in &linked.coefficients {
            let name = c.name.as_str();
            let rest = name.strip_prefix(&start);
            if !rest.is_some_and(|rest| rest.is_empty() || rest.starts_with('.')) {
                return fail(format!(
                    "coefficient {name} must be called {start}, or {start}.NAME where there are several"
                ));
            }
            if names.contains(&name) {
                return fail(format!("coefficient {name} is announced twice"));
            }
            names.push(name);
            if c.unit.is_empty() {
                return fail(format!("coefficient {name} has no unit; `1` is the unit of a number"));
            }
            let Coefficient { lower, upper, initial, .. } = c;
            if lower >= upper || !(lower..=upper).contains(&initial) {
                return fail(format!(
                    "coefficient {name} is to begin at {initial} within a range from {lower} to {upper}; begin inside"
                ));
            }
            if c.prior_sigma <= 0.0 {
                return fail(format!("coefficient {name} has a prior standard deviation that is not above zero"));
            }
        }
        if names.is_empty() {
            return fail(
                "announces no coefficient, so nothing can be estimated; call `coefficient` in `link`".to_owned(),
            );
        }
        let channels: Vec<&str> =
            available.iter().filter(|c| c.attribute("kind") == "channel").map(|c| c.name.as_str()).collect();
        for column in linked.writes.iter().flat_map(|t| &t.columns).filter(|c| c.attribute("kind") == "regressor") {
            if !names.contains(&column.attribute("coefficient")) {
                return fail(format!("column {} names no coefficient of this instance", column.name));
            }
            if !channels.contains(&column.attribute("channel")) {
                let known = channels.join(", ");
                return fail(format!("column {} names no channel; there are {known}", column.name));
            }
        }
        Ok(())
    }

    fn values(&self, instance: &str, gap: Option<std::ops::Range<usize>>) -> Result<(), Finding> {
        let whole = gap.is_none();
        let mut session = self.session(instance, gap)?;
        session.advance(EPOCHS, 512)?;
        let Given { batches, times_ns, broken, .. } = session.finish()?;
        if let Some(first) = broken.first() {
            return Err(self.broken(instance, format!("its report breaks the schema: {first}")));
        }
        let (_, _, linked) = self.linked(instance, false)?;
        for (table, batch) in linked.writes.iter().zip(&batches).filter(|(table, _)| whole && table.rate_hz > 0.0) {
            if let Some(found_hz) = other_rate(batch, table.rate_hz) {
                let what =
                    format!("table {} comes at {found_hz} Hz, and was declared at {} Hz", table.name, table.rate_hz);
                return Err(self.broken(instance, what));
            }
        }
        for (table, batch) in batches.iter().enumerate() {
            if batch.time_ns.windows(2).any(|pair| pair[0] >= pair[1]) {
                return Err(self.broken(instance, format!("the times of table {table} do not ascend")));
            }
            if batch.columns.iter().flatten().any(|x| x.is_infinite()) {
                return Err(self.broken(instance, format!("table {table} has an infinite value; NaN is no value")));
            }
            if self.plugin.kind != Kind::Effect {
                continue;
            }
            if batch.time_ns != times_ns {
                let what = format!("table {table} has {} rows for {} given", batch.time_ns.len(), times_ns.len());
                return Err(self.broken(instance, what + "; an effect gives one for each, at its time"));
            }
            // An effect with memory may have a transient: only the second half must be finite.
            if whole && batch.columns.iter().any(|column| column[column.len() / 2..].iter().any(|x| !x.is_finite())) {
                return Err(self.broken(instance, format!("table {table} has NaN where every input was finite")));
            }
        }
        Ok(())
    }

    fn batches(&self, instance: &str) -> Result<(), Finding> {
        let mut first = None;
        for size in BATCHES {
            let mut session = self.session(instance, None)?;
            session.advance(EPOCHS, size)?;
            let result = session.finish()?;
            let when = format!("in batches of {size} in place of {EPOCHS} epochs");
            let whole = first.get_or_insert_with(|| result.clone());
            self.same(instance, whole, &result, &when, "keep what is left over for the next call")?;
        }
        Ok(())
    }

    fn replay(&self, instance: &str) -> Result<(), Finding> {
        let run = || -> Result<_, Finding> {
            let mut session = self.session(instance, None)?;
            session.advance(EPOCHS, 512)?;
            session.finish()
        };
        let hint = "clocks, addresses and random numbers without a seed are no input";
        self.same(instance, &run()?, &run()?, "the second time", hint)
    }

    fn state(&self, instance: &str) -> Result<(), Finding> {
        // A source's rows may be slow: few at a time, or there is nothing left after the first call.
        let size = if self.plugin.kind == Kind::Source { 7 } else { 500 };
        let mut first = self.session(instance, None)?;
        first.advance(EPOCHS / 2, size)?;
        let saved = first.save()?;
        let mut second = first.heir(self.session(instance, None)?);
        second.load(&saved)?;
        let again = second.save()?;
        if saved != again {
            let what =
                format!("a state of {} bytes, loaded and saved again, is {} other bytes", saved.len(), again.len());
            return Err(self.broken(instance, what));
        }
        first.forget_rows();
        first.advance(EPOCHS, size)?;
        second.advance(EPOCHS, size)?;
        let (first, second) = (first.finish()?, second.finish()?);
        self.same(instance, &first, &second, "resumed from its state", "the state must hold all that counts")
    }

    /// That two results are equal; `when` says how the second was made, `hint` what to do about a difference.
    fn same(&self, instance: &str, a: &Given, b: &Given, when: &str, hint: &str) -> Result<(), Finding> {
        let report = || (a.report != b.report).then(|| "the report is another".to_owned());
        match difference(&a.batches, &b.batches).or_else(report) {
            Some(what) => Err(self.broken(instance, format!("{when} {what}; {hint}"))),
            None => Ok(()),
        }
    }

    fn garbage(&self, instance: &str) -> Result<(), Finding> {
        let mut session = self.session(instance, None)?;
        session.advance(EPOCHS / 2, 500)?;
        let saved = session.save()?;
        let mut wrong = vec![vec![0xff], b"this is no state".to_vec(), stand::noise_bytes(4096)];
        if let Some((_, shorter)) = saved.split_last() {
            wrong.push(shorter.to_vec());
            wrong.push([&saved[..], &[0]].concat());
            wrong.push(Vec::new());
        }
        for bytes in wrong.into_iter().filter(|bytes| *bytes != saved) {
            if self.session(instance, None)?.load(&bytes).is_ok() {
                let what = format!(
                    "took {} bytes for a state, where its own has {}; check length and content in `load`",
                    bytes.len(),
                    saved.len()
                );
                return Err(self.broken(instance, what));
            }
        }
        Ok(())
    }
}

/// Checks id, version and texts, and that every default is allowed by the parameter's own declaration.
fn manifest(manifest: &Manifest, kind: Kind) -> Result<String, Finding> {
    let fail = |what: String| Err(Finding::Manifest(what));
    let plain = |text: &str| {
        text.starts_with(|c: char| c.is_ascii_lowercase())
            && text.chars().all(|c| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '-')
    };
    if !plain(&manifest.id) {
        return fail(format!("id `{}` must be small letters, digits and hyphens, a letter first", manifest.id));
    }
    let numbers = manifest.version.split(['-', '+']).next().unwrap_or_default().split('.');
    if numbers.clone().count() != 3 || numbers.clone().any(|n| n.parse::<u32>().is_err()) {
        return fail(format!("version `{}` must be of the form 1.2.3", manifest.version));
    }
    for (what, text) in [("licence", &manifest.licence), ("description", &manifest.description)] {
        if text.trim().is_empty() {
            return fail(format!("the {what} is empty"));
        }
    }
    if kind != Kind::Effect && !manifest.instances.is_empty() {
        return fail(format!("a {kind} has no instances"));
    }
    for (k, parameter) in manifest.parameters.iter().enumerate() {
        let name = &parameter.name;
        if manifest.parameters[..k].iter().any(|other| other.name == *name) {
            return fail(format!("parameter {name} is declared twice"));
        }
        if parameter.help.trim().is_empty() {
            return fail(format!("parameter {name} has no help"));
        }
        if matches!(parameter.kind, ParameterType::F64 | ParameterType::F64List) && parameter.unit.is_empty() {
            return fail(format!("parameter {name} has no unit; `1` is the unit of a number"));
        }
        let default = toml::Value::try_from(&parameter.default)
            .map_err(|_| Finding::Manifest(format!("parameter {name} has the default {}", parameter.default)))?;
        let given = toml::Table::from_iter([(name.clone(), default)]);
        resolve_parameters("its own default", manifest, &given)?;
    }
    Ok(format!("{kind} {} {}, {} parameters", manifest.id, manifest.version, manifest.parameters.len()))
}

/// The result of a check as `dragfree plugins validate` hands it from process to process.
pub fn to_json(result: &Result<String, Finding>) -> Value {
    match result {
        Ok(detail) => json!({ "passed": true, "detail": detail }),
        Err(finding) => json!({ "passed": false, "detail": finding.to_string() }),
    }
}
