//! The host's functions that a plugin calls in its `link`.
#![allow(unsafe_code, reason = "calls the host's C functions")]

use dragfree_abi as abi;
use dragfree_schema::{Column, NOISE_ATTRIBUTE, NoiseProcess};
use serde::Serialize;
use std::ffi::{CString, c_char, c_void};
use std::ptr;

use crate::error::PluginError;
use crate::want::Want;

/// `dragfree_link_v1.read`
pub(crate) fn read(raw: &abi::LinkV1, want: &Want) -> Result<abi::SlotV1, PluginError> {
    let text = |s: &Option<String>| s.as_deref().map(CString::new).transpose();
    let pointer = |s: &Option<CString>| s.as_ref().map_or(ptr::null(), |s| s.as_ptr());
    let (table, unit, frame) = (text(&want.table)?, text(&want.unit)?, text(&want.frame)?);
    let name = CString::new(want.name.as_str())?;
    let column = abi::ColumnV1 {
        table: pointer(&table),
        name: name.as_ptr(),
        unit: pointer(&unit),
        frame: pointer(&frame),
        rate_hz: want.rate_hz,
        attributes: ptr::null(),
    };
    let mut slot = abi::SlotV1::default();
    // SAFETY: `column`, its strings and `slot` live during the call, as the header asks.
    let status = unsafe { (raw.read)(raw.context, &raw const column, &raw mut slot) };
    PluginError::unless_ok(status, || format!("column {} was refused", want.name))?;
    Ok(slot)
}

/// `dragfree_link_v1.write`, with the noise processes that are declared beside the column.
pub(crate) fn write(raw: &abi::LinkV1, column: &Column, noise: &[NoiseProcess]) -> Result<(), PluginError> {
    let (table, name) = (CString::new(column.table.as_str())?, CString::new(column.name.as_str())?);
    let (unit, frame) = (CString::new(column.unit.as_str())?, CString::new(column.frame.as_str())?);
    let texts = column.attributes.iter().map(|(key, text)| (key.clone(), text.clone().into()));
    let mut attributes: serde_json::Map<String, serde_json::Value> = texts.collect();
    if !noise.is_empty() {
        attributes.insert(NOISE_ATTRIBUTE.to_owned(), serde_json::to_value(noise)?);
    }
    let attributes = CString::new(serde_json::to_string(&attributes)?)?;
    let c = abi::ColumnV1 {
        table: table.as_ptr(),
        name: name.as_ptr(),
        unit: unit.as_ptr(),
        frame: frame.as_ptr(),
        rate_hz: column.rate_hz,
        attributes: attributes.as_ptr(),
    };
    // SAFETY: `c` and its strings live during the call.
    let status = unsafe { (raw.write)(raw.context, &raw const c) };
    PluginError::unless_ok(status, || format!("column {} was refused", column.name))
}

/// `dragfree_link_v1.coefficient` and `.constraint`
type Declare = unsafe extern "C" fn(*mut c_void, *const c_char) -> abi::Status;

/// Declares a coefficient or a constraint.
pub(crate) fn declare(raw: &abi::LinkV1, function: Declare, value: &impl Serialize) -> Result<(), PluginError> {
    let json = CString::new(serde_json::to_string(value)?)?;
    // SAFETY: `json` lives during the call, and the function belongs to the context.
    let status = unsafe { function(raw.context, json.as_ptr()) };
    PluginError::unless_ok(status, || format!("{} was refused", json.to_string_lossy()))
}
