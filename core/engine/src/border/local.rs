//! A plugin instance in this process: every call goes through the C border.

use arrow_schema::{DataType, ffi::FFI_ArrowSchema};
use dragfree_abi as abi;
use std::ffi::{CString, c_void};

use super::call::{Config, LinkRequest, Rows, SourceStep};
use super::crash::Name;
use super::host::{self, Collected, ConfigContext, Log};
use super::library::{Kind, Library, PluginInfo};
use super::link::{self, CColumn, LinkContext, Linked};
use super::{BorderError, FLOATS_CHANGED, arrow, without_name};
use crate::limits::{REPORT_BYTES, STATE_BYTES};
use crate::table::{Batch, Column};

/// A plugin instance in this process.
#[derive(Debug)]
pub(super) struct Local {
    /// Id, with the instance of an effect: `com-offset:tm1`.
    pub(super) name: String,
    /// The same, for the crash report.
    crash_name: Name,
    kind: Kind,
    node: abi::NodeV1,
    // Lives as long as the node, which holds a pointer to it.
    _host: Box<abi::HostV1>,
    // Lives as long as the host, which holds a pointer to it.
    _log: Box<Log>,
    input_schemas: Vec<FFI_ArrowSchema>,
    /// Columns of each written table, beside the times.
    output_columns: Vec<usize>,
    /// An earlier call failed; nothing but `destroy` may follow.
    dead: bool,
}

// SAFETY: the header lets an instance be called from any thread, one at a time; what the host's callbacks share between
// threads is the log, whose count is atomic.
unsafe impl Send for Local {}

impl Drop for Local {
    fn drop(&mut self) {
        if let Some(destroy) = self.node.destroy {
            // SAFETY: called once, in whatever state.
            let ((), changed) = self.crash_name.guarded("destroy", || unsafe { destroy(self.node.self_) });
            if changed {
                tracing::warn!(plugin = self.name, "destroy: {FLOATS_CHANGED}; it was put back");
            }
        }
    }
}

impl Local {
    /// Makes an instance.
    ///
    /// # Errors
    /// The plugin refused the configuration.
    pub(super) fn create(library: &Library, plugin: &PluginInfo, config: &Config) -> Result<Self, BorderError> {
        let name = config.name_of(plugin);
        let rule = |what: String| BorderError::Rule { plugin: name.clone(), call: "create", what };
        let factory =
            library.factory(plugin.kind).map_err(rule)?.ok_or_else(|| rule("the factory vanished".to_owned()))?;
        let create = factory.create.ok_or_else(|| rule("a factory without `create`".to_owned()))?;
        let log = Box::new(Log::new(&name));
        let host = Box::new(abi::HostV1 { context: (&raw const *log).cast_mut().cast(), log: host::log });
        let json = CString::new(config.value.to_string().replace("\\u0000", "?")).unwrap_or_default();
        let mut context = ConfigContext::new(&config.value);
        let context = (&raw mut context).cast();
        let (get_f64, get_text) = (host::get_f64, host::get_text);
        let raw = abi::ConfigV1 { context, json: json.as_ptr(), get_f64, get_text };
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
            _log: log,
            input_schemas: Vec::new(),
            output_columns: Vec::new(),
            dead: false,
        })
    }

    /// Links it: it declares what it reads and writes.
    ///
    /// # Errors
    /// A column is missing or is another than wanted: [`BorderError::Link`] holds the sentence.
    pub(super) fn link(&mut self, request: LinkRequest<'_>) -> Result<Linked, BorderError> {
        let columns: Vec<CColumn> = request.available.iter().map(CColumn::new).collect();
        let raw_columns: Vec<abi::ColumnV1> = columns.iter().map(CColumn::raw).collect();
        let model = CString::new(request.model_json.replace('\0', "?")).unwrap_or_default();
        let mut context = LinkContext::new(request.available, self.kind);
        let raw = abi::LinkV1 {
            context: (&raw mut context).cast(),
            available_count: u32::try_from(raw_columns.len()).unwrap_or(u32::MAX),
            available: raw_columns.as_ptr(),
            model_json: model.as_ptr(),
            read: link::link_read,
            write: link::link_write,
            coefficient: link::link_coefficient,
            constraint: link::link_constraint,
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
        link::check_noise(&linked, request.available)
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
    pub(super) fn activate(&mut self, max_rows: u32) -> Result<(), BorderError> {
        let Some(activate) = self.node.activate else { return Ok(()) };
        // SAFETY: linked before, by the caller's order.
        self.call("activate", |node, error| unsafe { activate(node, max_rows, error) })
    }

    /// One batch; `None` when the plugin discarded it.
    ///
    /// # Errors
    /// The plugin failed or broke a rule of the border.
    pub(super) fn process(
        &mut self,
        tables: &[Rows<'_>],
        complete_until_ns: i64,
    ) -> Result<Option<Vec<Batch>>, BorderError> {
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
    pub(super) fn next(&mut self, rows: u32) -> Result<SourceStep, BorderError> {
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
    pub(super) fn flush(&mut self) -> Result<Vec<Batch>, BorderError> {
        let Some(flush) = self.node.flush else {
            return Ok(self.output_columns.iter().map(|columns| Batch::empty(*columns)).collect());
        };
        // SAFETY: as in `process`.
        let batches = self.outputs("flush", |node, outputs, error| unsafe { flush(node, outputs, error) })?;
        batches.ok_or_else(|| self.rule("flush", "nothing to discard here".to_owned()))
    }

    /// The report as it is written; `None` from a plugin that gives none.
    ///
    /// # Errors
    /// The plugin failed.
    pub(super) fn report(&mut self, earlier_json: &str) -> Result<Option<Vec<u8>>, BorderError> {
        let Some(report) = self.node.report else { return Ok(None) };
        let earlier = CString::new(earlier_json.replace('\0', "?")).unwrap_or_default();
        // SAFETY: the string and the writer live during the call.
        let written = self.bytes_from("report", REPORT_BYTES, |node, writer, error| unsafe {
            report(node, earlier.as_ptr(), writer, error)
        });
        written.map(Some)
    }

    /// The whole state.
    ///
    /// # Errors
    /// The plugin failed.
    pub(super) fn save(&mut self) -> Result<Vec<u8>, BorderError> {
        let Some(save) = self.node.save else { return Ok(Vec::new()) };
        // SAFETY: the writer lives during the call.
        self.bytes_from("save", STATE_BYTES, |node, writer, error| unsafe { save(node, writer, error) })
    }

    /// Takes a state back.
    ///
    /// # Errors
    /// The bytes are no state of this plugin.
    pub(super) fn load(&mut self, state: &[u8]) -> Result<(), BorderError> {
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
        let columns = &self.output_columns;
        let (batches, changed): (Result<Vec<Batch>, String>, bool) = self.crash_name.guarded("release", || {
            let arrays = arrays.into_iter().zip(columns);
            // All of them, so that each is released.
            // SAFETY: the plugin filled the arrays as the header asks, or left them empty.
            let taken: Vec<_> = arrays.map(|(array, columns)| unsafe { arrow::take(array, *columns) }).collect();
            taken.into_iter().collect()
        });
        if !called? {
            return Ok(None);
        }
        let batches = if changed { Err(format!("release: {FLOATS_CHANGED}")) } else { batches };
        batches.map(Some).map_err(|what| {
            self.dead = true;
            self.rule(call, what)
        })
    }

    fn bytes_from(
        &mut self,
        call: &'static str,
        limit: usize,
        work: impl FnOnce(*mut c_void, *const abi::WriterV1, *mut abi::ErrorV1) -> abi::Status,
    ) -> Result<Vec<u8>, BorderError> {
        let mut collected = Collected::new(limit);
        let writer = abi::WriterV1 { context: (&raw mut collected).cast(), write: host::collect };
        let called = self.call(call, |node, error| work(node, &raw const writer, error));
        // The host's own message is more precise than the plugin's.
        if let Some(what) = collected.refused {
            self.dead = true;
            return Err(self.rule(call, what));
        }
        called.map(|()| collected.bytes)
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
    let (status, changed) = name.guarded(call, || work(&raw mut error));
    if changed {
        return Err(BorderError::Rule { plugin: plugin.to_owned(), call, what: FLOATS_CHANGED.to_owned() });
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
