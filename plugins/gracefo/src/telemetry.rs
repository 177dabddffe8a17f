//! Stream of rows of one spacecraft from all files, ordered in time. One day is in memory at a time.

use std::collections::BTreeMap;
use std::path::PathBuf;

use dragfree_sdk::PluginError;
use serde::{Deserialize, Serialize};

use crate::archive::{Container, Member};
use crate::product::{PRODUCTS, Product};
use crate::rows::{Counts, Parsed, Rows, align_quaternions, order, parse};
use crate::{Level1Error, Window};

/// Error that prevents a telemetry stream.
#[expect(missing_docs, reason = "the messages name the fields")]
#[derive(Debug, thiserror::Error)]
pub enum TelemetryError {
    /// A file cannot be read.
    #[error("{}: {source}; check the path and its permissions", path.display())]
    Read { path: PathBuf, source: std::io::Error },
    /// No file contains data of the spacecraft.
    #[error(
        "none of the {files} files given contains a product of spacecraft {spacecraft}: {seen}; give .tgz archives or .txt \
         files named PRODUCT_DATE_SPACECRAFT_RELEASE.txt, and check mission.spacecraft and the parameter products"
    )]
    Nothing { files: usize, spacecraft: char, seen: String },
    /// Unknown product.
    #[error("parameter products: unknown product `{0}`; known products: {1}")]
    UnknownProduct(String, String),
    /// A saved state of other files.
    #[error("the saved state does not belong to these files: {0}; rerun from the telemetry without it")]
    ForeignState(String),
}

/// A table of the stream.
#[derive(Clone, Debug)]
pub struct TableId {
    /// Product.
    pub product: &'static Product,
    /// Index of the product's table.
    pub part: usize,
    /// Name.
    pub name: String,
}

/// State after the last row emitted.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct State {
    dates: Vec<String>,
    tables: Vec<String>,
    /// Index of the day in memory.
    day: usize,
    /// Rows of that day already emitted, per table.
    given: Vec<usize>,
    /// Last quaternion before that day, per table.
    quaternions: Vec<Option<[f64; 4]>>,
    /// Rows of that day before this time are late.
    not_before_ns: Option<i64>,
    last_ns: Option<i64>,
    log: Log,
}

/// Counts and losses.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Log {
    /// Nonzero counts, such as `acc1a.rows`.
    pub counts: BTreeMap<String, u64>,
    /// First anomaly of each kind, by kind and product.
    pub notes: BTreeMap<String, String>,
    /// Whether expected data are lost.
    pub data_loss: bool,
}

impl Log {
    fn count(&mut self, product: &Product, what: &str, n: u64) {
        if n > 0 {
            *self.counts.entry(format!("{}.{what}", product.code.to_lowercase())).or_default() += n;
        }
    }

    fn note(&mut self, kind: &str, product: &Product, text: String) {
        self.notes.entry(format!("{kind}.{}", product.code)).or_insert(text);
    }

    fn file(&mut self, member: &Member, counts: &Counts) {
        let (product, name) = (member.product, &member.name);
        for (what, n) in counts.each() {
            self.count(product, what, n);
        }
        if let Some(promised) = counts.promised {
            let text = format!("{name}: the header says {promised} rows, the file has {}", counts.lines);
            self.note("promised", product, text);
        }
        if let Some(line) = counts.first_garbage_line {
            let text = format!("{name}: {} unreadable lines dropped, first line {line}", counts.garbage);
            self.note("garbage", product, text);
        }
        if counts.truncated > 0 {
            self.note("truncated", product, format!("{name}: truncated, or not readable to its end"));
        }
        self.data_loss |= counts.garbage > 0 || counts.truncated > 0;
    }

    fn refused(&mut self, member: &Member, error: &Level1Error) {
        self.count(member.product, "files_refused", 1);
        self.note("refused", member.product, format!("{}: not used: {error}", member.name));
        self.data_loss = true;
    }
}

/// The stream.
#[derive(Debug)]
pub struct Telemetry {
    containers: Vec<Container>,
    spacecraft: char,
    window: Window,
    /// Tables, in product order.
    pub tables: Vec<TableId>,
    /// Rows of the day in memory, per table; `None` until the first row is requested.
    day: Option<Vec<Rows>>,
    quaternions_after: Vec<Option<[f64; 4]>>,
    state: State,
}

impl Telemetry {
    /// Lists the files. `wanted` names products; empty for all.
    ///
    /// # Errors
    /// [`TelemetryError`].
    pub fn open(
        files: &[PathBuf],
        spacecraft: char,
        window: Window,
        wanted: &[String],
    ) -> Result<Self, TelemetryError> {
        for name in wanted {
            if !PRODUCTS.iter().any(|p| p.code.eq_ignore_ascii_case(name)) {
                let all: Vec<&str> = PRODUCTS.iter().map(|p| p.code).collect();
                return Err(TelemetryError::UnknownProduct(name.clone(), all.join(", ")));
            }
        }
        let is_wanted = |m: &Member| {
            m.spacecraft == spacecraft
                && (wanted.is_empty() || wanted.iter().any(|w| m.product.code.eq_ignore_ascii_case(w)))
        };
        let mut log = Log::default();
        let (mut containers, mut dates, mut seen) = (Vec::new(), Vec::new(), Vec::new());
        for path in files {
            let mut container =
                Container::open(path).map_err(|source| TelemetryError::Read { path: path.clone(), source })?;
            if let Some(damage) = &container.damage {
                *log.counts.entry("archives_damaged".to_owned()).or_default() += 1;
                log.notes.insert(
                    format!("archive.{}", path.display()),
                    format!("{}: the archive is damaged, data after the damage are lost: {damage}", path.display()),
                );
                log.data_loss = true;
            }
            seen.extend(container.members.iter().map(|m| m.name.clone()));
            container.members.retain(is_wanted);
            dates.extend(container.members.iter().map(|m| m.date.clone()));
            containers.push(container);
        }
        if dates.is_empty() {
            seen.truncate(4);
            let seen = if seen.is_empty() { "no product".to_owned() } else { seen.join(", ") };
            return Err(TelemetryError::Nothing { files: files.len(), spacecraft, seen });
        }
        dates.sort_unstable();
        dates.dedup();
        let there = |p: &Product| containers.iter().flat_map(|c| &c.members).any(|m| m.product.code == p.code);
        let tables: Vec<TableId> = PRODUCTS
            .iter()
            .filter(|p| there(p))
            .flat_map(|product| {
                product.tables().into_iter().enumerate().map(move |(part, name)| TableId { product, part, name })
            })
            .collect();
        let state = State {
            dates,
            tables: tables.iter().map(|t| t.name.clone()).collect(),
            given: vec![0; tables.len()],
            quaternions: vec![None; tables.len()],
            log,
            ..State::default()
        };
        let quaternions_after = vec![None; tables.len()];
        Ok(Self { containers, spacecraft, window, tables, day: None, quaternions_after, state })
    }

    /// Emits up to `rows` more rows in time order, as (table, row, rows of the table's day). Returns the time before
    /// which all rows have been emitted, and whether the stream has ended.
    ///
    /// # Errors
    /// A file has become unreadable.
    pub fn next(
        &mut self,
        rows: usize,
        mut emit: impl FnMut(usize, usize, &Rows),
    ) -> Result<(i64, bool), TelemetryError> {
        if self.day.is_none() {
            let log = self.load()?;
            self.state.log = log;
        }
        for _ in 0..rows.max(1) {
            let Some((time_ns, table)) = self.head() else { break };
            if let Some(day) = &self.day {
                emit(table, self.state.given[table], &day[table]);
            }
            self.state.given[table] += 1;
            self.state.last_ns = Some(time_ns);
        }
        while self.head().is_none() && self.state.day + 1 < self.state.dates.len() {
            self.state.day += 1;
            self.state.given.fill(0);
            self.state.quaternions = std::mem::take(&mut self.quaternions_after);
            self.state.not_before_ns = self.state.last_ns.map(|t| t + 1);
            let log = self.load()?;
            self.state.log = log;
        }
        let after_last = self.state.last_ns.map_or(i64::MIN, |t| t + 1);
        Ok(self.head().map_or((after_last, true), |(time_ns, _)| (time_ns, false)))
    }

    /// Counts and losses so far.
    pub fn log(&self) -> &Log {
        &self.state.log
    }

    /// Visits the whole state.
    ///
    /// # Errors
    /// What is loaded is no state of a stream of these files, or a file cannot be read any more.
    pub fn visit(&mut self, state: &mut dragfree_sdk::state::State<'_>) -> Result<(), PluginError> {
        // Before the first row nothing was counted: the day is read when it is wanted.
        let mut saved = (self.day.is_some(), self.state.clone());
        state.document(&mut saved)?;
        if state.is_loading() {
            self.set_state(saved)?;
        }
        Ok(())
    }

    fn set_state(&mut self, (loaded, state): (bool, State)) -> Result<(), TelemetryError> {
        let foreign = |what: &str| Err(TelemetryError::ForeignState(what.to_owned()));
        if state.dates != self.state.dates || state.tables != self.state.tables {
            return foreign("it has other days or products");
        }
        let n = self.tables.len();
        if state.day >= state.dates.len() || state.given.len() != n || state.quaternions.len() != n {
            return foreign("it is inconsistent");
        }
        self.state = state;
        self.day = None;
        if loaded {
            self.load()?;
            let day = self.day.as_deref().unwrap_or_default();
            if day.iter().zip(&self.state.given).any(|(rows, given)| *given > rows.time_ns.len()) {
                return foreign("a file has fewer rows than were read before");
            }
        }
        Ok(())
    }

    /// Time and table of the next row.
    fn head(&self) -> Option<(i64, usize)> {
        let day = self.day.as_ref()?;
        let next = |(table, rows): (usize, &Rows)| rows.time_ns.get(self.state.given[table]).map(|t| (*t, table));
        day.iter().enumerate().filter_map(next).min()
    }

    /// Reads the current day into memory; returns the log to adopt if the day is read for the first time.
    fn load(&mut self) -> Result<Log, TelemetryError> {
        let date = &self.state.dates[self.state.day];
        let mut log = self.state.log.clone();
        let mut files: Vec<(Member, Parsed)> = Vec::new();
        for container in self.containers.iter().filter(|c| c.members.iter().any(|m| m.date == *date)) {
            let visited = container.visit(|member, text| {
                let wanted = member.date == *date && container.members.iter().any(|m| m.name == member.name);
                if wanted {
                    match parse(text, member.product, self.spacecraft, self.window) {
                        Ok(parsed) => files.push((member, parsed)),
                        Err(error) => log.refused(&member, &error),
                    }
                }
            });
            // A damaged archive was noted when it was opened.
            if let (Err(source), None) = (visited, &container.damage) {
                return Err(TelemetryError::Read { path: container.path().to_owned(), source });
            }
        }
        // Rows of the newer release come first, and the first row of a time is kept.
        files.sort_by(|(a, _), (b, _)| b.release.cmp(&a.release));
        for (member, parsed) in &files {
            log.file(member, &parsed.counts);
        }
        let mut quaternions_after = self.state.quaternions.clone();
        let mut day = Vec::with_capacity(self.tables.len());
        for (k, id) in self.tables.iter().enumerate() {
            let parts: Vec<Rows> = files
                .iter_mut()
                .filter(|(m, _)| m.product.code == id.product.code)
                .map(|(_, parsed)| std::mem::take(&mut parsed.tables[id.part]))
                .collect();
            let mut rows = self.join(id, parts, &mut log);
            if let Some(first) = id.product.quaternion {
                align_quaternions(&mut rows, first, &mut quaternions_after[k]);
            }
            day.push(rows);
        }
        self.quaternions_after = quaternions_after;
        self.day = Some(day);
        Ok(log)
    }

    fn join(&self, id: &TableId, parts: Vec<Rows>, log: &mut Log) -> Rows {
        let mut joined = Rows { time_ns: Vec::new(), columns: vec![Vec::new(); id.product.columns.len()] };
        for part in parts {
            if joined.time_ns.is_empty() {
                joined = part;
                continue;
            }
            joined.time_ns.extend(part.time_ns);
            for (all, more) in joined.columns.iter_mut().zip(part.columns) {
                all.extend(more);
            }
        }
        let mut counts = Counts { rows: joined.time_ns.len() as u64, ..Counts::default() };
        order(&mut joined, &mut counts);
        let late = self.state.not_before_ns.map_or(0, |t| joined.time_ns.partition_point(|x| *x < t));
        joined.time_ns.drain(..late);
        for column in &mut joined.columns {
            column.drain(..late);
        }
        log.count(id.product, "rows_duplicate", counts.duplicates);
        log.count(id.product, "rows_late", late as u64);
        log.count(id.product, "rows", joined.time_ns.len() as u64);
        joined
    }
}
