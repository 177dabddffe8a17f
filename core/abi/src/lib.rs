//! The C border between the dragfree host and a plugin: the Rust mirror of `include/dragfree/plugin.h`, nothing else.
//!
//! The header is the reference: its comments give the lifecycle, the threads and the owners. A C program compiled by
//! this crate's tests compares every size and offset.
#![no_std]
#![allow(unsafe_code, reason = "this crate declares the C border; it runs no code of its own")]

use core::ffi::{c_char, c_void};

/// `DRAGFREE_ABI_VERSION`
pub const ABI_VERSION: u32 = 1;
/// Factory id of sources.
pub const SOURCE_V1: &str = "dragfree.source/1";
/// Factory id of stages.
pub const STAGE_V1: &str = "dragfree.stage/1";
/// Factory id of effects.
pub const EFFECT_V1: &str = "dragfree.effect/1";
/// Name of the one exported symbol, with its NUL.
pub const ENTRY_SYMBOL: &[u8] = b"dragfree_entry\0";

/// What a call came to.
pub type Status = i32;
/// Done.
pub const OK: Status = 0;
/// This batch gives nothing; the instance is as before the call.
pub const DISCARD: Status = 1;
/// Failed; only a snapshot can bring the instance back.
pub const ERROR: Status = 2;
/// Failed; never call this instance again.
pub const FATAL: Status = 3;

/// `struct ArrowSchema` of the Arrow C Data Interface.
#[repr(C)]
#[derive(Debug)]
pub struct ArrowSchema {
    /// Type, `g` for float64, `l` for int64, `+s` for a struct.
    pub format: *const c_char,
    /// Field name.
    pub name: *const c_char,
    /// Length-prefixed key–value pairs.
    pub metadata: *const c_char,
    /// Flags.
    pub flags: i64,
    /// Number of children.
    pub n_children: i64,
    /// Children.
    pub children: *mut *mut ArrowSchema,
    /// Dictionary, unused.
    pub dictionary: *mut ArrowSchema,
    /// Frees the schema.
    pub release: Option<unsafe extern "C" fn(*mut ArrowSchema)>,
    /// The producer's own.
    pub private_data: *mut c_void,
}

/// `struct ArrowArray` of the Arrow C Data Interface.
#[repr(C)]
#[derive(Debug)]
pub struct ArrowArray {
    /// Rows.
    pub length: i64,
    /// Nulls; always 0 here.
    pub null_count: i64,
    /// First row in the buffers.
    pub offset: i64,
    /// Number of buffers.
    pub n_buffers: i64,
    /// Number of children.
    pub n_children: i64,
    /// Buffers: validity, values.
    pub buffers: *mut *const c_void,
    /// Children.
    pub children: *mut *mut ArrowArray,
    /// Dictionary, unused.
    pub dictionary: *mut ArrowArray,
    /// Frees the array; null where there is none.
    pub release: Option<unsafe extern "C" fn(*mut ArrowArray)>,
    /// The producer's own.
    pub private_data: *mut c_void,
}

impl ArrowArray {
    /// An array that holds nothing and needs no release.
    #[must_use]
    pub const fn empty() -> Self {
        Self {
            length: 0,
            null_count: 0,
            offset: 0,
            n_buffers: 0,
            n_children: 0,
            buffers: core::ptr::null_mut(),
            children: core::ptr::null_mut(),
            dictionary: core::ptr::null_mut(),
            release: None,
            private_data: core::ptr::null_mut(),
        }
    }
}

/// `dragfree_error_v1`
#[repr(C)]
#[derive(Debug)]
pub struct ErrorV1 {
    /// Caller-owned buffer.
    pub text: *mut c_char,
    /// Its size, bytes.
    pub capacity: usize,
}

/// `dragfree_writer_v1`
#[repr(C)]
#[derive(Debug)]
pub struct WriterV1 {
    /// The host's own.
    pub context: *mut c_void,
    /// Takes bytes.
    pub write: unsafe extern "C" fn(*mut c_void, *const u8, usize) -> Status,
}

/// `DRAGFREE_LOG_ERROR`
pub const LOG_ERROR: i32 = 1;
/// `DRAGFREE_LOG_WARN`
pub const LOG_WARN: i32 = 2;
/// `DRAGFREE_LOG_INFO`
pub const LOG_INFO: i32 = 3;
/// `DRAGFREE_LOG_DEBUG`
pub const LOG_DEBUG: i32 = 4;

/// `dragfree_host_v1`
#[repr(C)]
#[derive(Debug)]
pub struct HostV1 {
    /// The host's own.
    pub context: *mut c_void,
    /// Takes a message.
    pub log: unsafe extern "C" fn(*mut c_void, i32, *const c_char),
}

/// `dragfree_config_v1`
#[repr(C)]
#[derive(Debug)]
pub struct ConfigV1 {
    /// The host's own.
    pub context: *mut c_void,
    /// The whole configuration.
    pub json: *const c_char,
    /// A number by dotted path.
    pub get_f64: unsafe extern "C" fn(*mut c_void, *const c_char, *mut f64) -> Status,
    /// A string by dotted path.
    pub get_text: unsafe extern "C" fn(*mut c_void, *const c_char, *mut *const c_char) -> Status,
}

/// `dragfree_column_v1`
#[repr(C)]
#[derive(Debug)]
pub struct ColumnV1 {
    /// Table.
    pub table: *const c_char,
    /// Name.
    pub name: *const c_char,
    /// Unit.
    pub unit: *const c_char,
    /// Frame.
    pub frame: *const c_char,
    /// Rate, Hz.
    pub rate_hz: f64,
    /// JSON object of strings, or null.
    pub attributes: *const c_char,
}

/// `dragfree_slot_v1`
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct SlotV1 {
    /// Index of the table among the inputs.
    pub table: u32,
    /// Index of the column in it, after the times.
    pub column: u32,
}

/// `dragfree_link_v1`
#[repr(C)]
#[derive(Debug)]
pub struct LinkV1 {
    /// The host's own.
    pub context: *mut c_void,
    /// Number of columns that exist.
    pub available_count: u32,
    /// Those columns.
    pub available: *const ColumnV1,
    /// Coefficients and constraints declared so far.
    pub model_json: *const c_char,
    /// Asks for a column.
    pub read: unsafe extern "C" fn(*mut c_void, *const ColumnV1, *mut SlotV1) -> Status,
    /// Announces a column.
    pub write: unsafe extern "C" fn(*mut c_void, *const ColumnV1) -> Status,
    /// Announces a coefficient.
    pub coefficient: unsafe extern "C" fn(*mut c_void, *const c_char) -> Status,
    /// Announces a constraint.
    pub constraint: unsafe extern "C" fn(*mut c_void, *const c_char) -> Status,
}

/// `dragfree_inputs_v1`
#[repr(C)]
#[derive(Debug)]
pub struct InputsV1 {
    /// Every row of an irregular table before this time has been given.
    pub complete_until_ns: i64,
    /// Number of tables.
    pub table_count: u32,
    /// Their schemas.
    pub schemas: *const ArrowSchema,
    /// Their rows.
    pub tables: *const ArrowArray,
}

/// `dragfree_progress_v1`
#[repr(C)]
#[derive(Clone, Copy, Debug, Default)]
pub struct ProgressV1 {
    /// Every row before this time has been delivered.
    pub complete_until_ns: i64,
    /// Not 0: there is nothing more.
    pub done: i32,
}

/// `link`
pub type LinkFn = unsafe extern "C" fn(*mut c_void, *const LinkV1, *mut ErrorV1) -> Status;
/// `activate`
pub type ActivateFn = unsafe extern "C" fn(*mut c_void, u32, *mut ErrorV1) -> Status;
/// `process`
pub type ProcessFn = unsafe extern "C" fn(*mut c_void, *const InputsV1, *mut ArrowArray, *mut ErrorV1) -> Status;
/// `next`
pub type NextFn = unsafe extern "C" fn(*mut c_void, u32, *mut ArrowArray, *mut ProgressV1, *mut ErrorV1) -> Status;
/// `flush`
pub type FlushFn = unsafe extern "C" fn(*mut c_void, *mut ArrowArray, *mut ErrorV1) -> Status;
/// `report`
pub type ReportFn = unsafe extern "C" fn(*mut c_void, *const c_char, *const WriterV1, *mut ErrorV1) -> Status;
/// `save`
pub type SaveFn = unsafe extern "C" fn(*mut c_void, *const WriterV1, *mut ErrorV1) -> Status;
/// `load`
pub type LoadFn = unsafe extern "C" fn(*mut c_void, *const u8, usize, *mut ErrorV1) -> Status;
/// `destroy`
pub type DestroyFn = unsafe extern "C" fn(*mut c_void);
/// `create`
pub type CreateFn = unsafe extern "C" fn(u32, *const HostV1, *const ConfigV1, *mut NodeV1, *mut ErrorV1) -> Status;

/// `dragfree_node_v1`
#[repr(C)]
#[derive(Debug)]
pub struct NodeV1 {
    /// The instance.
    pub self_: *mut c_void,
    /// Says what is read and written.
    pub link: Option<LinkFn>,
    /// Takes memory.
    pub activate: Option<ActivateFn>,
    /// One batch.
    pub process: Option<ProcessFn>,
    /// More epochs of a source.
    pub next: Option<NextFn>,
    /// Gives what a lag held back.
    pub flush: Option<FlushFn>,
    /// The result.
    pub report: Option<ReportFn>,
    /// The state as bytes.
    pub save: Option<SaveFn>,
    /// Takes a state back.
    pub load: Option<LoadFn>,
    /// Frees everything.
    pub destroy: Option<DestroyFn>,
}

impl NodeV1 {
    /// A node before `create`.
    #[must_use]
    pub const fn empty() -> Self {
        Self {
            self_: core::ptr::null_mut(),
            link: None,
            activate: None,
            process: None,
            next: None,
            flush: None,
            report: None,
            save: None,
            load: None,
            destroy: None,
        }
    }
}

/// `dragfree_factory_v1`
#[repr(C)]
#[derive(Debug)]
pub struct FactoryV1 {
    /// Number of plugins.
    pub count: u32,
    /// Manifest of one, as JSON.
    pub manifest: Option<unsafe extern "C" fn(u32) -> *const c_char>,
    /// Makes an instance.
    pub create: Option<CreateFn>,
}

/// `dragfree_entry_v1`
#[repr(C)]
#[derive(Debug)]
pub struct EntryV1 {
    /// `DRAGFREE_ABI_VERSION`, first and always first.
    pub abi_version: u32,
    /// 0.
    pub reserved: u32,
    /// The factory of an id, or null.
    pub get_factory: Option<unsafe extern "C" fn(*const c_char) -> *const FactoryV1>,
}

// SAFETY: an entry holds a number and a function pointer, both constant.
unsafe impl Sync for EntryV1 {}
// SAFETY: a factory holds a number and function pointers, all constant.
unsafe impl Sync for FactoryV1 {}
