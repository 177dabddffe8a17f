//! A plugin instance: created, linked, fed, asked for report and state, destroyed.

use arrow_schema::{DataType, ffi::FFI_ArrowSchema};
use dragfree_abi as abi;
use dragfree_schema::{Coefficient, Constraint, NOISE_ATTRIBUTE, NoiseProcess, Report};
use serde::de::DeserializeOwned;
use std::collections::BTreeMap;
use std::ffi::{CStr, CString, c_char, c_void};

use super::crash::Name;
use super::library::{Kind, Library, PluginInfo};
use super::{BorderError, arrow, floats, read, without_name};
use crate::table::{Batch, Column, TableSpec};

/// What an instance is made from: the JSON object that `dragfree_config_v1` describes.
#[derive(Clone, Debug, Default)]
pub struct Config {
    /// `parameters`, `mission`, `instance`, `files`, `start_ns`, `end_ns`.
    pub value: serde_json::Value,
}

/// What exists when an instance is linked.
#[derive(Clone, Copy, Debug)]
pub struct LinkRequest<'a> {
    /// Every column made so far.
    pub available: &'a [Column],
    /// What the plugins before it declared: a [`dragfree_schema::Model`].
    pub model_json: &'a str,
}

/// A column that an instance reads: its index among the available ones.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ReadColumn {
    /// Index into [`LinkRequest::available`].
    pub available: usize,
}

/// What an instance declared when it was linked.
#[derive(Clone, Debug, Default)]
pub struct Linked {
    /// Per input table, in slot order: the columns read.
    pub reads: Vec<Vec<ReadColumn>>,
    /// Tables written, in order.
    pub writes: Vec<TableSpec>,
    /// Coefficients that it announced.
    pub coefficients: Vec<Coefficient>,
    /// Constraints that it announced.
    pub constraints: Vec<Constraint>,
    /// Noise processes that it declared.
    pub noise: Vec<NoiseProcess>,
}

/// Rows of one input table.
#[derive(Debug)]
pub struct Rows<'a> {
    /// Times.
    pub time_ns: &'a [i64],
    /// The columns read, in slot order.
    pub columns: Vec<&'a [f64]>,
}

/// One step of a source.
#[derive(Debug)]
pub struct SourceStep {
    /// One batch per written table.
    pub batches: Vec<Batch>,
    /// Every row before this time has been given.
    pub complete_until_ns: i64,
    /// There is nothing more.
    pub done: bool,
}

/// A plugin instance.
#[derive(Debug)]
pub struct Instance {
    /// Id, with the instance of an effect: `com-offset:tm1`.
    pub name: String,
    /// The same, for the crash report.
    crash_name: Name,
    /// Source, stage or effect.
    pub kind: Kind,
    node: abi::NodeV1,
    // Lives as long as the node, which holds a pointer to it.
    _host: Box<abi::HostV1>,
    _host_name: Box<CString>,
    input_schemas: Vec<FFI_ArrowSchema>,
    /// Columns of each written table, beside the times.
    output_columns: Vec<usize>,
    /// An earlier call failed; nothing but `destroy` may follow.
    dead: bool,
}

// SAFETY: the header lets an instance be called from any thread, one at a time; the host's callbacks take no state but
// an immutable name.
unsafe impl Send for Instance {}

impl Drop for Instance {
    fn drop(&mut self) {
        if let Some(destroy) = self.node.destroy {
            // SAFETY: called once, in whatever state.
            self.crash_name.during("destroy", || unsafe { destroy(self.node.self_) });
        }
    }
}

unsafe extern "C" fn log(context: *mut c_void, level: i32, message: *const c_char) {
    if context.is_null() || message.is_null() {
        return;
    }
    // SAFETY: the context is the instance's name, the message a NUL-terminated string.
    let (plugin, message) =
        unsafe { (CStr::from_ptr(context.cast()).to_string_lossy(), CStr::from_ptr(message).to_string_lossy()) };
    match level {
        abi::LOG_ERROR => tracing::error!(%plugin, "{message}"),
        abi::LOG_WARN => tracing::warn!(%plugin, "{message}"),
        abi::LOG_INFO => tracing::info!(%plugin, "{message}"),
        _ => tracing::debug!(%plugin, "{message}"),
    }
}

/// The configuration while `create` runs.
struct ConfigContext<'a> {
    value: &'a serde_json::Value,
    texts: Vec<CString>,
}

impl ConfigContext<'_> {
    fn find(&self, path: &str) -> Option<&serde_json::Value> {
        path.split('.').try_fold(self.value, |value, key| match value {
            serde_json::Value::Array(items) => items.get(key.parse::<usize>().ok()?),
            other => other.get(key),
        })
    }
}

/// # Safety
/// `context` is a `ConfigContext`, `path` NUL-terminated.
unsafe fn config_value<'a>(context: *mut c_void, path: *const c_char) -> Option<(&'a mut ConfigContext<'a>, String)> {
    if path.is_null() {
        return None;
    }
    // SAFETY: by the caller.
    unsafe {
        let context = context.cast::<ConfigContext<'a>>().as_mut()?;
        Some((context, CStr::from_ptr(path).to_string_lossy().into_owned()))
    }
}

unsafe extern "C" fn get_f64(context: *mut c_void, path: *const c_char, out: *mut f64) -> abi::Status {
    // SAFETY: as the header promises.
    unsafe {
        let Some((context, path)) = config_value(context, path) else { return abi::ERROR };
        match (context.find(&path).and_then(serde_json::Value::as_f64), out.as_mut()) {
            (Some(value), Some(out)) => {
                *out = value;
                abi::OK
            }
            _ => abi::ERROR,
        }
    }
}

unsafe extern "C" fn get_text(context: *mut c_void, path: *const c_char, out: *mut *const c_char) -> abi::Status {
    // SAFETY: as the header promises.
    unsafe {
        let Some((context, path)) = config_value(context, path) else { return abi::ERROR };
        let text = context.find(&path).and_then(serde_json::Value::as_str).map(str::to_owned);
        match (text.and_then(|t| CString::new(t).ok()), out.as_mut()) {
            (Some(text), Some(out)) => {
                // The heap buffer of a CString does not move when the vector grows.
                *out = text.as_ptr();
                context.texts.push(text);
                abi::OK
            }
            _ => abi::ERROR,
        }
    }
}

/// The declarations while `link` runs.
struct LinkContext<'a> {
    available: &'a [Column],
    linked: Linked,
    tables: Vec<String>,
    kind: Kind,
    refused: Option<String>,
}

impl LinkContext<'_> {
    fn refuse(&mut self, sentence: String) -> abi::Status {
        self.refused.get_or_insert(sentence);
        abi::ERROR
    }

    fn read(&mut self, want: &WantedColumn) -> Result<abi::SlotV1, String> {
        let column = self.find(want)?;
        let have = &self.available[column];
        let mismatch = |what: &str, wanted: &str, is: &str| {
            Err(format!(
                "wants column {}:{} with {what} `{wanted}`, but it is made with {what} `{is}`; correct the one that is wrong",
                have.table, have.name
            ))
        };
        if let Some(unit) = want.unit.as_deref().filter(|u| *u != have.unit) {
            return mismatch("unit", unit, &have.unit);
        }
        if let Some(frame) = want.frame.as_deref().filter(|f| *f != have.frame) {
            return mismatch("frame", frame, &have.frame);
        }
        if want.rate_hz != 0.0 && want.rate_hz != have.rate_hz {
            return mismatch("rate in Hz", &want.rate_hz.to_string(), &have.rate_hz.to_string());
        }
        let table = self.tables.iter().position(|t| *t == have.table).unwrap_or_else(|| {
            self.tables.push(have.table.clone());
            self.linked.reads.push(Vec::new());
            self.tables.len() - 1
        });
        let columns = &mut self.linked.reads[table];
        let read = ReadColumn { available: column };
        let position = columns.iter().position(|c| *c == read).unwrap_or_else(|| {
            columns.push(read);
            columns.len() - 1
        });
        let index = |i: usize| u32::try_from(i).map_err(|e| e.to_string());
        Ok(abi::SlotV1 { table: index(table)?, column: index(position)? })
    }

    fn find(&self, want: &WantedColumn) -> Result<usize, String> {
        let fits = |c: &Column| c.name == want.name && want.table.as_ref().is_none_or(|t| *t == c.table);
        // Raw telemetry has the names that preprocessed columns keep: without a table, the grid is meant.
        let uniform = self.available.iter().any(|c| fits(c) && c.rate_hz > 0.0);
        let mut found = self
            .available
            .iter()
            .enumerate()
            .filter(|(_, c)| fits(c) && (!uniform || c.rate_hz > 0.0 || want.table.is_some()));
        let shown = want.table.as_ref().map_or_else(|| want.name.clone(), |t| format!("{t}:{}", want.name));
        match (found.next(), found.next()) {
            (Some((index, _)), None) => Ok(index),
            (Some((_, a)), Some((_, b))) => Err(format!(
                "wants column {shown}, which tables {} and {} both have; it must name the table",
                a.table, b.table
            )),
            (None, _) => {
                let mut near: Vec<_> = self
                    .available
                    .iter()
                    .map(|c| (distance(&c.name, &want.name), format!("{}:{}", c.table, c.name)))
                    .collect();
                near.sort();
                let near: Vec<_> = near.into_iter().take(3).map(|(_, name)| name).collect();
                let near = if near.is_empty() {
                    "there are no columns yet".to_owned()
                } else {
                    format!("nearest: {}", near.join(", "))
                };
                Err(format!(
                    "wants column {shown}, which no file and no stage before it makes ({near}); add the topic or the stage that makes it"
                ))
            }
        }
    }

    fn write(&mut self, column: Column) -> Result<(), String> {
        if column.table.is_empty() || column.name.is_empty() {
            return Err("writes a column without a table or a name".to_owned());
        }
        let taken = |c: &Column| c.table == column.table && c.name == column.name;
        if self.available.iter().any(taken) || self.linked.writes.iter().flat_map(|t| &t.columns).any(taken) {
            return Err(format!("writes column {}:{}, which exists already", column.table, column.name));
        }
        if !(column.rate_hz.is_finite() && column.rate_hz >= 0.0) {
            return Err(format!("writes column {}:{} at a rate of {} Hz", column.table, column.name, column.rate_hz));
        }
        if let Some(table) = self.linked.writes.iter_mut().find(|t| t.name == column.table) {
            if table.rate_hz != column.rate_hz {
                return Err(format!(
                    "writes table {} at {} Hz and at {} Hz",
                    table.name, table.rate_hz, column.rate_hz
                ));
            }
            table.columns.push(column);
        } else {
            if self.available.iter().any(|c| c.table == column.table) {
                return Err(format!("writes table {}, which exists already", column.table));
            }
            let truth = self.kind == Kind::Source && column.table == "truth";
            let (name, rate_hz) = (column.table.clone(), column.rate_hz);
            self.linked.writes.push(TableSpec { name, rate_hz, columns: vec![column], truth });
        }
        Ok(())
    }
}

/// The declared noise makes sense, and enters channels that exist.
fn check_noise(linked: &Linked, available: &[Column]) -> Result<(), String> {
    for process in &linked.noise {
        process.check().map_err(|what| format!("declares the noise process `{}`: {what}", process.name))?;
        let known = |channel: &str| {
            let written = linked.writes.iter().flat_map(|t| &t.columns);
            let name = |c: &Column| c.attributes.get("channel").map_or(c.name.clone(), String::clone);
            available.iter().chain(written).any(|c| c.attribute("kind") == "channel" && name(c) == channel)
        };
        if let Some(channel) = process.channels().find(|channel| !known(channel)) {
            return Err(format!(
                "declares that the noise process `{}` enters `{channel}`, which is no channel; write it with the attribute kind = channel",
                process.name
            ));
        }
    }
    Ok(())
}

/// A coarse measure of how far two names are apart: what is left outside the common start and end.
fn distance(a: &str, b: &str) -> usize {
    let start = a.bytes().zip(b.bytes()).take_while(|(x, y)| x == y).count();
    let end = a.bytes().rev().zip(b.bytes().rev()).take_while(|(x, y)| x == y).count();
    (a.len().max(b.len())).saturating_sub(start + end)
}

struct WantedColumn {
    table: Option<String>,
    name: String,
    unit: Option<String>,
    frame: Option<String>,
    rate_hz: f64,
}

/// # Safety
/// `text` is null or NUL-terminated.
unsafe fn optional(text: *const c_char) -> Option<String> {
    // SAFETY: by the caller.
    (!text.is_null()).then(|| unsafe { CStr::from_ptr(text) }.to_string_lossy().into_owned())
}

unsafe extern "C" fn link_read(
    context: *mut c_void,
    wanted: *const abi::ColumnV1,
    slot: *mut abi::SlotV1,
) -> abi::Status {
    // SAFETY: as the header promises.
    unsafe {
        let (Some(context), Some(c)) = (context.cast::<LinkContext<'_>>().as_mut(), wanted.as_ref()) else {
            return abi::ERROR;
        };
        let Some(name) = optional(c.name) else { return context.refuse("wants a column without a name".to_owned()) };
        let want = WantedColumn {
            table: optional(c.table),
            name,
            unit: optional(c.unit),
            frame: optional(c.frame),
            rate_hz: c.rate_hz,
        };
        match (context.read(&want), slot.as_mut()) {
            (Ok(found), Some(slot)) => {
                *slot = found;
                abi::OK
            }
            (Ok(_), None) => context.refuse("gave no slot".to_owned()),
            (Err(sentence), _) => context.refuse(sentence),
        }
    }
}

unsafe extern "C" fn link_write(context: *mut c_void, column: *const abi::ColumnV1) -> abi::Status {
    // SAFETY: as the header promises.
    unsafe {
        let (Some(context), Some(c)) = (context.cast::<LinkContext<'_>>().as_mut(), column.as_ref()) else {
            return abi::ERROR;
        };
        let text = |t| optional(t).unwrap_or_default();
        let result = attributes(&text(c.attributes))
            .map_err(|what| format!("attributes of column {}: {what}", text(c.name)))
            .and_then(|(attributes, noise)| {
                context.linked.noise.extend(noise);
                context.write(Column {
                    table: text(c.table),
                    name: text(c.name),
                    unit: text(c.unit),
                    frame: text(c.frame),
                    rate_hz: c.rate_hz,
                    attributes,
                })
            });
        result.map_or_else(|sentence| context.refuse(sentence), |()| abi::OK)
    }
}

/// The attributes of a written column, and the noise processes among them.
fn attributes(json: &str) -> Result<(BTreeMap<String, String>, Vec<NoiseProcess>), String> {
    if json.is_empty() {
        return Ok((BTreeMap::new(), Vec::new()));
    }
    let mut all: serde_json::Map<String, serde_json::Value> = serde_json::from_str(json).map_err(|e| e.to_string())?;
    let noise = all.remove(NOISE_ATTRIBUTE).map_or(Ok(Vec::new()), read::declaration);
    let noise = noise.map_err(|what| format!("{NOISE_ATTRIBUTE}: {what}"))?;
    Ok((read::declaration(all.into())?, noise))
}

/// # Safety
/// As the header promises for `coefficient` and `constraint`.
unsafe fn link_json<T: DeserializeOwned>(
    context: *mut c_void,
    json: *const c_char,
    what: &str,
    list: impl FnOnce(&mut Linked) -> &mut Vec<T>,
) -> abi::Status {
    // SAFETY: by the caller.
    unsafe {
        let Some(context) = context.cast::<LinkContext<'_>>().as_mut() else { return abi::ERROR };
        if context.kind != Kind::Effect {
            return context.refuse(format!("announces a {what}, but is no effect"));
        }
        let document = serde_json::from_str(&optional(json).unwrap_or_default()).map_err(|e| e.to_string());
        match document.and_then(read::declaration) {
            Ok(declared) => {
                list(&mut context.linked).push(declared);
                abi::OK
            }
            Err(why) => context.refuse(format!("announces a {what} that cannot be read: {why}")),
        }
    }
}

unsafe extern "C" fn link_coefficient(context: *mut c_void, json: *const c_char) -> abi::Status {
    // SAFETY: as the header promises.
    unsafe { link_json(context, json, "coefficient", |linked| &mut linked.coefficients) }
}

unsafe extern "C" fn link_constraint(context: *mut c_void, json: *const c_char) -> abi::Status {
    // SAFETY: as the header promises.
    unsafe { link_json(context, json, "constraint", |linked| &mut linked.constraints) }
}

unsafe extern "C" fn collect(context: *mut c_void, bytes: *const u8, length: usize) -> abi::Status {
    // SAFETY: the context is the vector of `bytes_from`; the plugin gives `length` bytes.
    unsafe {
        match context.cast::<Vec<u8>>().as_mut() {
            Some(buffer) if length == 0 || !bytes.is_null() => {
                if length > 0 {
                    buffer.extend_from_slice(std::slice::from_raw_parts(bytes, length));
                }
                abi::OK
            }
            _ => abi::ERROR,
        }
    }
}

/// A column as C strings.
struct CColumn {
    table: CString,
    name: CString,
    unit: CString,
    frame: CString,
    attributes: CString,
    rate_hz: f64,
}

impl CColumn {
    fn new(column: &Column) -> Self {
        // Names come from files and plugins: a NUL cannot be in a C string, and no column has one that matters.
        let c = |s: &str| CString::new(s.replace('\0', "?")).unwrap_or_default();
        let attributes = serde_json::to_string(&column.attributes).unwrap_or_default();
        Self {
            table: c(&column.table),
            name: c(&column.name),
            unit: c(&column.unit),
            frame: c(&column.frame),
            attributes: c(&attributes),
            rate_hz: column.rate_hz,
        }
    }

    fn raw(&self) -> abi::ColumnV1 {
        abi::ColumnV1 {
            table: self.table.as_ptr(),
            name: self.name.as_ptr(),
            unit: self.unit.as_ptr(),
            frame: self.frame.as_ptr(),
            rate_hz: self.rate_hz,
            attributes: self.attributes.as_ptr(),
        }
    }
}

impl Instance {
    /// Makes an instance.
    ///
    /// # Errors
    /// The plugin refused the configuration.
    pub fn create(library: &Library, plugin: &PluginInfo, config: &Config) -> Result<Self, BorderError> {
        let instance = config.value.get("instance").and_then(serde_json::Value::as_str).unwrap_or_default();
        let name =
            if instance.is_empty() { plugin.manifest.id.clone() } else { format!("{}:{instance}", plugin.manifest.id) };
        let rule = |what: String| BorderError::Rule { plugin: name.clone(), call: "create", what };
        let factory =
            library.factory(plugin.kind).map_err(rule)?.ok_or_else(|| rule("the factory vanished".to_owned()))?;
        let create = factory.create.ok_or_else(|| rule("a factory without `create`".to_owned()))?;
        let host_name = Box::new(CString::new(name.replace('\0', "?")).unwrap_or_default());
        let host = Box::new(abi::HostV1 { context: host_name.as_ptr().cast_mut().cast(), log });
        let json = CString::new(config.value.to_string().replace("\\u0000", "?")).unwrap_or_default();
        let mut context = ConfigContext { value: &config.value, texts: Vec::new() };
        let raw = abi::ConfigV1 { context: (&raw mut context).cast(), json: json.as_ptr(), get_f64, get_text };
        let mut node = abi::NodeV1::empty();
        let crash_name = Name::of(&name);
        guarded_call(crash_name, &name, "create", |error| {
            // SAFETY: every pointer lives during the call; the host and its name live as long as the node.
            unsafe { create(plugin.index, &raw const *host, &raw const raw, &raw mut node, error) }
        })?;
        if node.destroy.is_none() || node.link.is_none() {
            return Err(rule("an instance without `link` or `destroy`".to_owned()));
        }
        Ok(Self {
            name,
            crash_name,
            kind: plugin.kind,
            node,
            _host: host,
            _host_name: host_name,
            input_schemas: Vec::new(),
            output_columns: Vec::new(),
            dead: false,
        })
    }

    /// Links it: it declares what it reads and writes.
    ///
    /// # Errors
    /// A column is missing or is another than wanted: [`BorderError::Link`] holds the sentence.
    pub fn link(&mut self, request: LinkRequest<'_>) -> Result<Linked, BorderError> {
        let columns: Vec<CColumn> = request.available.iter().map(CColumn::new).collect();
        let raw_columns: Vec<abi::ColumnV1> = columns.iter().map(CColumn::raw).collect();
        let model = CString::new(request.model_json.replace('\0', "?")).unwrap_or_default();
        let mut context = LinkContext {
            available: request.available,
            linked: Linked::default(),
            tables: Vec::new(),
            kind: self.kind,
            refused: None,
        };
        let raw = abi::LinkV1 {
            context: (&raw mut context).cast(),
            available_count: u32::try_from(raw_columns.len()).unwrap_or(u32::MAX),
            available: raw_columns.as_ptr(),
            model_json: model.as_ptr(),
            read: link_read,
            write: link_write,
            coefficient: link_coefficient,
            constraint: link_constraint,
        };
        let link = self.function(self.node.link, "link")?;
        // SAFETY: every pointer lives during the call.
        let result = self.call("link", |node, error| unsafe { link(node, &raw const raw, error) });
        // The host's own message is more precise than the plugin's.
        if let Some(sentence) = context.refused {
            self.dead = true;
            return Err(BorderError::Link { plugin: self.name.clone(), sentence });
        }
        result?;
        let linked = context.linked;
        check_noise(&linked, request.available)
            .map_err(|sentence| BorderError::Link { plugin: self.name.clone(), sentence })?;
        for columns in &linked.reads {
            let columns: Vec<Column> = columns.iter().map(|c| request.available[c.available].clone()).collect();
            let schema = FFI_ArrowSchema::try_from(DataType::Struct(arrow::fields_of(&columns)))
                .map_err(|e| BorderError::Link { plugin: self.name.clone(), sentence: e.to_string() })?;
            self.input_schemas.push(schema);
        }
        self.output_columns = linked.writes.iter().map(|t| t.columns.len()).collect();
        Ok(linked)
    }

    /// Lets it allocate for batches of at most `max_rows` rows.
    ///
    /// # Errors
    /// The plugin failed.
    pub fn activate(&mut self, max_rows: u32) -> Result<(), BorderError> {
        let Some(activate) = self.node.activate else { return Ok(()) };
        // SAFETY: linked before, by the caller's order.
        self.call("activate", |node, error| unsafe { activate(node, max_rows, error) })
    }

    /// One batch; `None` when the plugin discarded it.
    ///
    /// # Errors
    /// The plugin failed or broke a rule of the border.
    pub fn process(&mut self, tables: &[Rows<'_>], complete_until_ns: i64) -> Result<Option<Vec<Batch>>, BorderError> {
        let process = self.function(self.node.process, "process")?;
        let (_owned, arrays): (Vec<_>, Vec<abi::ArrowArray>) =
            tables.iter().map(|t| arrow::borrow(t.time_ns, &t.columns)).unzip();
        let inputs = abi::InputsV1 {
            complete_until_ns,
            table_count: u32::try_from(arrays.len()).unwrap_or(u32::MAX),
            schemas: self.input_schemas.as_ptr().cast(),
            tables: arrays.as_ptr(),
        };
        self.outputs("process", |node, outputs, error| {
            // SAFETY: every pointer lives during the call; there is one output array per written table.
            unsafe { process(node, &raw const inputs, outputs, error) }
        })
    }

    /// About `rows` more epochs of a source.
    ///
    /// # Errors
    /// The plugin failed or broke a rule of the border.
    pub fn next(&mut self, rows: u32) -> Result<SourceStep, BorderError> {
        let next = self.function(self.node.next, "next")?;
        let mut progress = abi::ProgressV1::default();
        let batches = self.outputs("next", |node, outputs, error| {
            // SAFETY: as in `process`.
            unsafe { next(node, rows, outputs, &raw mut progress, error) }
        })?;
        let batches = batches.ok_or_else(|| self.rule("next", "a source may not discard".to_owned()))?;
        Ok(SourceStep { batches, complete_until_ns: progress.complete_until_ns, done: progress.done != 0 })
    }

    /// The rows that a lag held back.
    ///
    /// # Errors
    /// The plugin failed or broke a rule of the border.
    pub fn flush(&mut self) -> Result<Vec<Batch>, BorderError> {
        let Some(flush) = self.node.flush else {
            return Ok(self.output_columns.iter().map(|columns| Batch::empty(*columns)).collect());
        };
        // SAFETY: as in `process`.
        let batches = self.outputs("flush", |node, outputs, error| unsafe { flush(node, outputs, error) })?;
        batches.ok_or_else(|| self.rule("flush", "nothing to discard here".to_owned()))
    }

    /// The report; unknown keys become notes in it.
    ///
    /// # Errors
    /// The plugin failed, or gave what cannot be understood: the sentence names the key.
    pub fn report(&mut self, earlier_json: &str) -> Result<Report, BorderError> {
        let Some(report) = self.node.report else { return Ok(Report::default()) };
        let earlier = CString::new(earlier_json.replace('\0', "?")).unwrap_or_default();
        // SAFETY: the string and the writer live during the call.
        let bytes =
            self.bytes_from("report", |node, writer, error| unsafe { report(node, earlier.as_ptr(), writer, error) })?;
        let report = read::report(&String::from_utf8_lossy(&bytes)).map_err(|what| self.rule("report", what))?;
        Ok(Report { plugin: self.name.clone(), ..report })
    }

    /// The whole state.
    ///
    /// # Errors
    /// The plugin failed.
    pub fn save(&mut self) -> Result<Vec<u8>, BorderError> {
        let Some(save) = self.node.save else { return Ok(Vec::new()) };
        // SAFETY: the writer lives during the call.
        self.bytes_from("save", |node, writer, error| unsafe { save(node, writer, error) })
    }

    /// Takes a state back.
    ///
    /// # Errors
    /// The bytes are no state of this plugin.
    pub fn load(&mut self, state: &[u8]) -> Result<(), BorderError> {
        let Some(load) = self.node.load else {
            return if state.is_empty() {
                Ok(())
            } else {
                Err(self.rule("load", "a state for a plugin without one".to_owned()))
            };
        };
        // SAFETY: the bytes live during the call.
        self.call("load", |node, error| unsafe { load(node, state.as_ptr(), state.len(), error) })
    }

    fn rule(&self, call: &'static str, what: String) -> BorderError {
        BorderError::Rule { plugin: self.name.clone(), call, what }
    }

    fn function<F: Copy>(&self, function: Option<F>, call: &'static str) -> Result<F, BorderError> {
        function.ok_or_else(|| self.rule(call, "its kind must have this function".to_owned()))
    }

    fn call(
        &mut self,
        call: &'static str,
        work: impl FnOnce(*mut c_void, *mut abi::ErrorV1) -> abi::Status,
    ) -> Result<(), BorderError> {
        match self.call_or_discard(call, work)? {
            true => Ok(()),
            false => Err(self.rule(call, "nothing to discard here".to_owned())),
        }
    }

    /// `Ok(false)` when the plugin discarded the batch.
    fn call_or_discard(
        &mut self,
        call: &'static str,
        work: impl FnOnce(*mut c_void, *mut abi::ErrorV1) -> abi::Status,
    ) -> Result<bool, BorderError> {
        if self.dead {
            return Err(self.rule(call, "it failed before and must not be called again".to_owned()));
        }
        let node = self.node.self_;
        let result = guarded_call(self.crash_name, &self.name, call, |error| work(node, error));
        self.dead = result.is_err();
        result
    }

    fn outputs(
        &mut self,
        call: &'static str,
        work: impl FnOnce(*mut c_void, *mut abi::ArrowArray, *mut abi::ErrorV1) -> abi::Status,
    ) -> Result<Option<Vec<Batch>>, BorderError> {
        let mut arrays: Vec<abi::ArrowArray> = self.output_columns.iter().map(|_| abi::ArrowArray::empty()).collect();
        let pointer = arrays.as_mut_ptr();
        let called = self.call_or_discard(call, |node, error| work(node, pointer, error));
        // Arrays are taken, and so released, even after a failed call.
        let batches: Result<Vec<Batch>, String> = arrays
            .into_iter()
            .zip(&self.output_columns)
            // SAFETY: the plugin filled the arrays as the header asks, or left them empty.
            .map(|(array, columns)| unsafe { arrow::take(array, *columns) })
            .collect();
        if !called? {
            return Ok(None);
        }
        batches.map(Some).map_err(|what| {
            self.dead = true;
            self.rule(call, what)
        })
    }

    fn bytes_from(
        &mut self,
        call: &'static str,
        work: impl FnOnce(*mut c_void, *const abi::WriterV1, *mut abi::ErrorV1) -> abi::Status,
    ) -> Result<Vec<u8>, BorderError> {
        let mut bytes: Vec<u8> = Vec::new();
        let writer = abi::WriterV1 { context: (&raw mut bytes).cast(), write: collect };
        self.call(call, |node, error| work(node, &raw const writer, error))?;
        Ok(bytes)
    }
}

/// Makes a call with an error buffer, watches the floating-point control word, and turns the status into a result:
/// `Ok(false)` for a discarded batch.
fn guarded_call(
    name: Name,
    plugin: &str,
    call: &'static str,
    work: impl FnOnce(*mut abi::ErrorV1) -> abi::Status,
) -> Result<bool, BorderError> {
    let mut text = [0u8; 4096];
    let mut error = abi::ErrorV1 { text: text.as_mut_ptr().cast(), capacity: text.len() };
    let before = floats::control_word();
    let status = name.during(call, || work(&raw mut error));
    if floats::control_word() != before {
        floats::restore(before);
        let what = "it changed the floating-point control word, which would change every later result".to_owned();
        return Err(BorderError::Rule { plugin: plugin.to_owned(), call, what });
    }
    let end = text.iter().position(|b| *b == 0).unwrap_or(text.len());
    let message = String::from_utf8_lossy(&text[..end]);
    let message = without_name(plugin, &message).to_owned();
    match status {
        abi::OK => Ok(true),
        abi::DISCARD => {
            tracing::warn!(%plugin, "discarded a batch: {message}");
            Ok(false)
        }
        abi::ERROR | abi::FATAL => {
            let message = if message.is_empty() { "failed without a word".to_owned() } else { message };
            Err(BorderError::Plugin { plugin: plugin.to_owned(), call, message })
        }
        other => {
            Err(BorderError::Rule { plugin: plugin.to_owned(), call, what: format!("status {other} does not exist") })
        }
    }
}
