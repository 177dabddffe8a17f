//! The border itself: the C functions of `plugin.h` in front of the traits. Panics stop here.
#![allow(unsafe_code, reason = "this module is the C border")]

use arrow_array::{Array, ArrayRef, Float64Array, Int64Array, StructArray};
use arrow_data::ffi::FFI_ArrowArray;
use arrow_schema::{DataType, Field, Fields};
use dragfree_schema::{Available, Column, Report};
use std::any::Any;
use std::cell::RefCell;
use std::ffi::{CStr, CString, c_char, c_void};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::ptr;
use std::sync::{Arc, Once, OnceLock};

use crate::batch::{InputTable, Inputs, Outputs};
use crate::error::PluginError;
use crate::link::{Link, Written};
use crate::manifest::Manifest;
use crate::node::{Effect, EffectNode, Node, Source, SourceNode, Stage, StageNode};
use crate::setup::Setup;

// The Arrow crates' array and the header's are the same C struct.
const _: () = assert!(size_of::<FFI_ArrowArray>() == size_of::<abi::ArrowArray>());

/// What a plugin is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// `dragfree.stage/1`
    Stage,
    /// `dragfree.effect/1`
    Effect,
    /// `dragfree.source/1`
    Source,
}

/// A plugin as the export macro lists it.
#[derive(Clone, Copy)]
pub struct Registration {
    kind: Kind,
    manifest: Manifest,
    create: fn(&Setup) -> Result<Box<dyn Node>, PluginError>,
}

impl std::fmt::Debug for Registration {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Registration").field("id", &self.manifest.id).finish_non_exhaustive()
    }
}

impl Registration {
    /// A stage.
    #[must_use]
    pub const fn stage<T: Stage>() -> Self {
        Self { kind: Kind::Stage, manifest: T::MANIFEST, create: |setup| Ok(Box::new(StageNode(T::new(setup)?))) }
    }

    /// An effect.
    #[must_use]
    pub const fn effect<T: Effect>() -> Self {
        Self {
            kind: Kind::Effect,
            manifest: T::MANIFEST,
            create: |setup| Ok(Box::new(EffectNode { effect: T::new(setup)?, instance: setup.instance().to_owned() })),
        }
    }

    /// A source.
    #[must_use]
    pub const fn source<T: Source>() -> Self {
        Self { kind: Kind::Source, manifest: T::MANIFEST, create: |setup| Ok(Box::new(SourceNode(T::new(setup)?))) }
    }
}

/// The plugins of one kind in a library, with their manifests as C strings.
#[derive(Debug)]
pub struct Shelf {
    kind: Kind,
    all: &'static [Registration],
    manifests: OnceLock<Vec<CString>>,
}

impl Shelf {
    /// Those of `all` that are of one kind.
    #[must_use]
    pub const fn new(kind: Kind, all: &'static [Registration]) -> Self {
        Self { kind, all, manifests: OnceLock::new() }
    }

    /// How many there are.
    #[must_use]
    pub const fn count(kind: Kind, all: &[Registration]) -> u32 {
        let (mut i, mut count) = (0, 0);
        while i < all.len() {
            if all[i].kind as u8 == kind as u8 {
                count += 1;
            }
            i += 1;
        }
        count
    }

    fn registrations(&self) -> impl Iterator<Item = &'static Registration> {
        self.all.iter().filter(|r| r.kind == self.kind)
    }

    /// `dragfree_factory_v1.manifest`
    pub fn manifest(&'static self, index: u32) -> *const c_char {
        let manifests = self.manifests.get_or_init(|| {
            // JSON has no NUL: the serializer escapes it.
            self.registrations().map(|r| CString::new(r.manifest.to_json()).unwrap_or_default()).collect()
        });
        manifests.get(index as usize).map_or(ptr::null(), |m| m.as_ptr())
    }

    /// `dragfree_factory_v1.create`
    ///
    /// # Safety
    /// The pointers are those that the header promises.
    pub unsafe fn create(
        &'static self,
        index: u32,
        host: *const abi::HostV1,
        config: *const abi::ConfigV1,
        node: *mut abi::NodeV1,
        error: *mut abi::ErrorV1,
    ) -> abi::Status {
        quiet_panics();
        let made = guarded(|| {
            let registration = self
                .registrations()
                .nth(index as usize)
                .ok_or_else(|| PluginError::error(format!("no plugin {index} in this library")))?;
            // SAFETY: the header promises a valid configuration and host during `create`.
            let (config, host) = unsafe { (config.as_ref(), host.as_ref()) };
            let config = config.ok_or_else(|| PluginError::error("the host gave no configuration"))?;
            // SAFETY: the header promises a NUL-terminated UTF-8 string.
            let json = unsafe { CStr::from_ptr(config.json) }.to_str()?;
            (registration.create)(&Setup::parse(json, host)?)
        });
        match made {
            Ok(inner) => {
                let instance = Box::new(Instance {
                    node: inner,
                    poisoned: None,
                    uniform: None,
                    written: Vec::new(),
                    fields: Vec::new(),
                });
                // SAFETY: the header promises a node to fill.
                unsafe { ptr::write(node, vtable(Box::into_raw(instance))) };
                abi::OK
            }
            // SAFETY: the header promises a valid error buffer or null.
            Err(e) => unsafe { tell(error, &e) },
        }
    }
}

/// One living plugin.
struct Instance {
    node: Box<dyn Node>,
    /// Why it must not be called again.
    poisoned: Option<String>,
    uniform: Option<u32>,
    written: Vec<Written>,
    /// Arrow fields of each written table.
    fields: Vec<Fields>,
}

fn vtable(instance: *mut Instance) -> abi::NodeV1 {
    abi::NodeV1 {
        self_: instance.cast(),
        link: Some(link),
        activate: Some(activate),
        process: Some(process),
        next: Some(next),
        flush: Some(flush),
        report: Some(report),
        save: Some(save),
        load: Some(load),
        destroy: Some(destroy),
    }
}

thread_local! {
    static PANIC_PLACE: RefCell<String> = const { RefCell::new(String::new()) };
}

// A plugin has its own copy of the standard library, so this hook is the plugin's alone: a panic becomes an error of
// the host, with its place, and prints nothing.
fn quiet_panics() {
    static ONCE: Once = Once::new();
    ONCE.call_once(|| {
        std::panic::set_hook(Box::new(|info| {
            let place = info.location().map_or_else(String::new, |l| format!(" at {}:{}", l.file(), l.line()));
            PANIC_PLACE.with(|p| *p.borrow_mut() = place);
        }));
    });
}

fn panic_text(payload: &(dyn Any + Send)) -> String {
    let text = payload
        .downcast_ref::<&str>()
        .map(|s| (*s).to_owned())
        .or_else(|| payload.downcast_ref::<String>().cloned())
        .unwrap_or_else(|| "a panic without a text".to_owned());
    let place = PANIC_PLACE.with(|p| p.borrow().clone());
    format!("the plugin panicked{place}: {text}; this is a defect of the plugin, report it to its author")
}

fn guarded<T>(work: impl FnOnce() -> Result<T, PluginError>) -> Result<T, PluginError> {
    match catch_unwind(AssertUnwindSafe(work)) {
        Ok(result) => result,
        Err(payload) => {
            let text = panic_text(payload.as_ref());
            // Dropping a payload may itself panic; nothing may leave the border.
            let _ = catch_unwind(AssertUnwindSafe(|| drop(payload)));
            Err(PluginError::fatal(text))
        }
    }
}

/// Writes an error into the caller's buffer, cut at a character border, and gives its status.
///
/// # Safety
/// `error` is null or points to a buffer as the header promises.
unsafe fn tell(error: *mut abi::ErrorV1, e: &PluginError) -> abi::Status {
    // SAFETY: by the caller.
    if let Some(error) = unsafe { error.as_mut() }
        && !error.text.is_null()
        && error.capacity > 0
    {
        let clean = e.message.replace('\0', "?");
        let mut length = clean.len().min(error.capacity - 1);
        while !clean.is_char_boundary(length) {
            length -= 1;
        }
        // SAFETY: `length + 1 ≤ capacity` bytes are the caller's to write.
        unsafe {
            ptr::copy_nonoverlapping(clean.as_ptr(), error.text.cast(), length);
            *error.text.add(length) = 0;
        }
    }
    e.status
}

/// Runs `work` on the instance, unless it is poisoned; poisons it when the work says so.
///
/// # Safety
/// `this` came from `vtable` and is not used elsewhere during the call; `error` as in `tell`.
unsafe fn enter(
    this: *mut c_void,
    error: *mut abi::ErrorV1,
    work: impl FnOnce(&mut Instance) -> Result<(), PluginError>,
) -> abi::Status {
    // SAFETY: by the caller.
    let Some(instance) = (unsafe { this.cast::<Instance>().as_mut() }) else { return abi::FATAL };
    let result = match &instance.poisoned {
        Some(why) => Err(PluginError::fatal(format!("called again after a fatal error: {why}"))),
        None => guarded(|| work(instance)),
    };
    match result {
        Ok(()) => abi::OK,
        Err(e) => {
            if e.status == abi::FATAL && instance.poisoned.is_none() {
                instance.poisoned = Some(e.message.clone());
            }
            // SAFETY: by the caller.
            unsafe { tell(error, &e) }
        }
    }
}

/// A string of the host's, owned.
///
/// # Safety
/// `text` is null or NUL-terminated.
unsafe fn owned(text: *const c_char) -> String {
    if text.is_null() {
        return String::new();
    }
    // SAFETY: by the caller.
    unsafe { CStr::from_ptr(text) }.to_string_lossy().into_owned()
}

/// # Safety
/// The pointers of `raw` are those that the header promises.
unsafe fn columns_of(raw: &abi::LinkV1) -> Result<Vec<Column>, PluginError> {
    if raw.available_count == 0 {
        return Ok(Vec::new());
    }
    // SAFETY: the header promises `available_count` columns.
    let columns = unsafe { std::slice::from_raw_parts(raw.available, raw.available_count as usize) };
    columns
        .iter()
        .map(|c| {
            // SAFETY: strings of a column are NUL-terminated or null.
            let (table, name, unit, frame, attributes) =
                unsafe { (owned(c.table), owned(c.name), owned(c.unit), owned(c.frame), owned(c.attributes)) };
            let attributes =
                if attributes.is_empty() { Default::default() } else { serde_json::from_str(&attributes)? };
            Ok(Column { table, name, unit, frame, rate_hz: c.rate_hz, attributes })
        })
        .collect()
}

unsafe extern "C" fn link(this: *mut c_void, raw: *const abi::LinkV1, error: *mut abi::ErrorV1) -> abi::Status {
    // SAFETY: the host calls with what the header promises.
    unsafe {
        enter(this, error, |instance| {
            let raw = raw.as_ref().ok_or_else(|| PluginError::error("the host gave no link"))?;
            let available = Available::new(columns_of(raw)?, serde_json::from_str(&owned(raw.model_json))?);
            let mut link = Link::new(raw, &available);
            instance.node.link(&available, &mut link)?;
            instance.uniform = link.uniform_input;
            instance.written = link.written;
            instance.fields = instance.written.iter().map(fields_of).collect();
            Ok(())
        })
    }
}

fn fields_of(table: &Written) -> Fields {
    std::iter::once(Field::new("time_ns", DataType::Int64, false))
        .chain(table.columns.iter().map(|c| Field::new(&c.name, DataType::Float64, false)))
        .collect()
}

unsafe extern "C" fn activate(this: *mut c_void, _max_rows: u32, error: *mut abi::ErrorV1) -> abi::Status {
    // SAFETY: as the header promises.
    unsafe { enter(this, error, |_| Ok(())) }
}

/// The values of a primitive child.
///
/// # Safety
/// `array` is a live Arrow array of the type `T`.
unsafe fn values<'a, T>(array: *const abi::ArrowArray, rows: usize) -> Result<&'a [T], PluginError> {
    // SAFETY: by the caller.
    let array = unsafe { array.as_ref() }.ok_or_else(|| PluginError::error("a column without an array"))?;
    if rows == 0 {
        return Ok(&[]);
    }
    if array.n_buffers != 2 || array.offset < 0 || array.length < rows.cast_signed() as i64 {
        return Err(PluginError::error("a column that is no primitive Arrow array of the table's length"));
    }
    // SAFETY: a primitive array has a validity and a value buffer of `offset + length` values.
    Ok(unsafe {
        let data: *const T = (*array.buffers.add(1)).cast();
        std::slice::from_raw_parts(data.offset(array.offset as isize), rows)
    })
}

/// # Safety
/// `raw` is what the header promises, alive as long as the result.
unsafe fn inputs_of<'a>(raw: *const abi::InputsV1, uniform: Option<u32>) -> Result<Inputs<'a>, PluginError> {
    // SAFETY: by the caller.
    let raw = unsafe { raw.as_ref() }.ok_or_else(|| PluginError::error("the host gave no inputs"))?;
    let mut tables = Vec::with_capacity(raw.table_count as usize);
    for i in 0..raw.table_count as usize {
        // SAFETY: there are `table_count` struct arrays with `n_children` children each, the first of int64.
        unsafe {
            let table = &*raw.tables.add(i);
            let rows = usize::try_from(table.length)?;
            let children = usize::try_from(table.n_children)?;
            if children == 0 || table.offset != 0 {
                return Err(PluginError::error("an input table without times"));
            }
            let time_ns = values::<i64>(*table.children, rows)?;
            let columns =
                (1..children).map(|c| values::<f64>(*table.children.add(c), rows)).collect::<Result<_, _>>()?;
            tables.push(InputTable { time_ns, columns });
        }
    }
    Ok(Inputs { tables, uniform, complete_until_ns: raw.complete_until_ns })
}

/// Moves the rows into the host's arrays.
///
/// # Safety
/// `arrays` points to as many arrays as the instance writes tables.
unsafe fn export(outputs: Outputs, fields: &[Fields], arrays: *mut abi::ArrowArray) -> Result<(), PluginError> {
    outputs.check()?;
    for (i, (table, fields)) in outputs.tables.into_iter().zip(fields).enumerate() {
        if table.time_ns.is_empty() {
            continue;
        }
        let times: ArrayRef = Arc::new(Int64Array::from(table.time_ns));
        let columns = std::iter::once(times)
            .chain(table.columns.into_iter().map(|c| Arc::new(Float64Array::from(c)) as ArrayRef));
        let rows = StructArray::try_new(fields.clone(), columns.collect(), None)?;
        // SAFETY: by the caller; the layouts are the same C struct.
        unsafe { ptr::write(arrays.add(i).cast(), FFI_ArrowArray::new(&rows.to_data())) };
    }
    Ok(())
}

unsafe extern "C" fn process(
    this: *mut c_void,
    inputs: *const abi::InputsV1,
    outputs: *mut abi::ArrowArray,
    error: *mut abi::ErrorV1,
) -> abi::Status {
    // SAFETY: as the header promises.
    unsafe {
        enter(this, error, |instance| {
            let inputs = inputs_of(inputs, instance.uniform)?;
            let mut rows = Outputs::new(&instance.written);
            instance.node.process(&inputs, &mut rows)?;
            export(rows, &instance.fields, outputs)
        })
    }
}

unsafe extern "C" fn next(
    this: *mut c_void,
    rows: u32,
    outputs: *mut abi::ArrowArray,
    progress: *mut abi::ProgressV1,
    error: *mut abi::ErrorV1,
) -> abi::Status {
    // SAFETY: as the header promises.
    unsafe {
        enter(this, error, |instance| {
            let mut out = Outputs::new(&instance.written);
            let reached = instance.node.next(rows as usize, &mut out)?;
            export(out, &instance.fields, outputs)?;
            if let Some(progress) = progress.as_mut() {
                *progress = reached.into();
            }
            Ok(())
        })
    }
}

unsafe extern "C" fn flush(this: *mut c_void, outputs: *mut abi::ArrowArray, error: *mut abi::ErrorV1) -> abi::Status {
    // SAFETY: as the header promises.
    unsafe {
        enter(this, error, |instance| {
            let mut rows = Outputs::new(&instance.written);
            instance.node.flush(&mut rows)?;
            export(rows, &instance.fields, outputs)
        })
    }
}

/// # Safety
/// `writer` is what the header promises.
unsafe fn write_bytes(writer: *const abi::WriterV1, bytes: &[u8]) -> Result<(), PluginError> {
    // SAFETY: by the caller.
    let writer = unsafe { writer.as_ref() }.ok_or_else(|| PluginError::error("the host gave no writer"))?;
    // SAFETY: the bytes live during the call.
    let status = unsafe { (writer.write)(writer.context, bytes.as_ptr(), bytes.len()) };
    PluginError::unless_ok(status, || "the host did not take the bytes".to_owned())
}

unsafe extern "C" fn report(
    this: *mut c_void,
    earlier: *const c_char,
    writer: *const abi::WriterV1,
    error: *mut abi::ErrorV1,
) -> abi::Status {
    // SAFETY: as the header promises.
    unsafe {
        enter(this, error, |instance| {
            let earlier = owned(earlier);
            let earlier: Vec<Report> = if earlier.is_empty() { Vec::new() } else { serde_json::from_str(&earlier)? };
            let report = instance.node.report(&earlier)?;
            write_bytes(writer, &serde_json::to_vec(&report)?)
        })
    }
}

unsafe extern "C" fn save(this: *mut c_void, writer: *const abi::WriterV1, error: *mut abi::ErrorV1) -> abi::Status {
    // SAFETY: as the header promises.
    unsafe { enter(this, error, |instance| write_bytes(writer, &instance.node.save()?)) }
}

unsafe extern "C" fn load(this: *mut c_void, bytes: *const u8, length: usize, error: *mut abi::ErrorV1) -> abi::Status {
    // SAFETY: as the header promises.
    unsafe {
        enter(this, error, |instance| {
            let state = if length == 0 { &[] } else { std::slice::from_raw_parts(bytes, length) };
            instance.node.load(state)
        })
    }
}

unsafe extern "C" fn destroy(this: *mut c_void) {
    if !this.is_null() {
        // SAFETY: the host calls this once with the instance that `create` made. A panic in a destructor stops here.
        let _ = catch_unwind(AssertUnwindSafe(|| unsafe { drop(Box::from_raw(this.cast::<Instance>())) }));
    }
}

/// Defines `dragfree_entry`, the one exported symbol of a plugin library.
///
/// `export_plugin!(stages: [A, B], effects: [C], sources: [D]);` with any of the three lists, in any order.
#[macro_export]
macro_rules! export_plugin {
    ($($kind:ident: [$($plugin:ty),* $(,)?]),+ $(,)?) => {
        #[allow(unsafe_code, reason = "the exported symbol of the C border")]
        const _: () = {
            use $crate::border::{Kind, Registration, Shelf, abi};

            static ALL: &[Registration] = &[$($($crate::export_plugin!(@one $kind $plugin)),*),+];
            $crate::export_plugin!(@factory Stage stage_manifest stage_create STAGES STAGE_FACTORY);
            $crate::export_plugin!(@factory Effect effect_manifest effect_create EFFECTS EFFECT_FACTORY);
            $crate::export_plugin!(@factory Source source_manifest source_create SOURCES SOURCE_FACTORY);

            unsafe extern "C" fn get_factory(id: *const core::ffi::c_char) -> *const abi::FactoryV1 {
                // SAFETY: the host gives a NUL-terminated string.
                let id = unsafe { core::ffi::CStr::from_ptr(id) };
                let factory = match id.to_str() {
                    Ok(abi::STAGE_V1) => &STAGE_FACTORY,
                    Ok(abi::EFFECT_V1) => &EFFECT_FACTORY,
                    Ok(abi::SOURCE_V1) => &SOURCE_FACTORY,
                    _ => return core::ptr::null(),
                };
                if factory.count == 0 { core::ptr::null() } else { factory }
            }

            // The name is exported from shared libraries alone: in an rlib linked into a test program several plugins
            // would define it.
            #[cfg_attr(not(test), unsafe(export_name = "dragfree_entry"))]
            #[used]
            static ENTRY: abi::EntryV1 =
                abi::EntryV1 { abi_version: abi::ABI_VERSION, reserved: 0, get_factory: Some(get_factory) };
        };
    };
    (@one stages $plugin:ty) => { Registration::stage::<$plugin>() };
    (@one effects $plugin:ty) => { Registration::effect::<$plugin>() };
    (@one sources $plugin:ty) => { Registration::source::<$plugin>() };
    (@factory $kind:ident $manifest:ident $create:ident $shelf:ident $factory:ident) => {
        static $shelf: Shelf = Shelf::new(Kind::$kind, ALL);
        unsafe extern "C" fn $manifest(index: u32) -> *const core::ffi::c_char {
            $shelf.manifest(index)
        }
        unsafe extern "C" fn $create(
            index: u32,
            host: *const abi::HostV1,
            config: *const abi::ConfigV1,
            node: *mut abi::NodeV1,
            error: *mut abi::ErrorV1,
        ) -> abi::Status {
            // SAFETY: the host calls with what the header promises.
            unsafe { $shelf.create(index, host, config, node, error) }
        }
        static $factory: abi::FactoryV1 = abi::FactoryV1 {
            count: Shelf::count(Kind::$kind, ALL),
            manifest: Some($manifest),
            create: Some($create),
        };
    };
}

#[doc(hidden)]
pub use dragfree_abi as abi;
