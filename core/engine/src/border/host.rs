//! What the host offers a plugin to call: the log, the configuration, and a place for bytes.

use dragfree_abi as abi;
use std::collections::BTreeMap;
use std::ffi::{CString, c_char, c_void};
use std::sync::atomic::{AtomicU32, Ordering};

use super::text::text_of;
use crate::limits::{LOG_BYTES, LOG_LINES, NAME_BYTES};

/// The log of one instance.
#[derive(Debug)]
pub(super) struct Log {
    plugin: String,
    lines: AtomicU32,
}

impl Log {
    pub(super) fn new(plugin: &str) -> Self {
        Self { plugin: plugin.to_owned(), lines: AtomicU32::new(0) }
    }

    fn take(&self, level: i32, message: &str) {
        let plugin = &self.plugin;
        match self.lines.fetch_update(Ordering::Relaxed, Ordering::Relaxed, |n| n.checked_add(1)) {
            Ok(before) if before < LOG_LINES => {}
            Ok(LOG_LINES) => return tracing::warn!(%plugin, "logged more than {LOG_LINES} lines; the rest is left out"),
            _ => return,
        }
        match level {
            abi::LOG_ERROR => tracing::error!(%plugin, "{message}"),
            abi::LOG_WARN => tracing::warn!(%plugin, "{message}"),
            abi::LOG_INFO => tracing::info!(%plugin, "{message}"),
            _ => tracing::debug!(%plugin, "{message}"),
        }
    }
}

/// `log` of `dragfree_host_v1`.
pub(super) unsafe extern "C" fn log(context: *mut c_void, level: i32, message: *const c_char) {
    // SAFETY: the context is the `Log` of the instance, which lives as long as it; many threads may share it.
    let Some(log) = (unsafe { context.cast::<Log>().as_ref() }) else { return };
    // SAFETY: the message is null or NUL-terminated.
    match unsafe { text_of(message, LOG_BYTES) } {
        Ok(Some(message)) => log.take(level, &message),
        Ok(None) => {}
        Err(_) => log.take(level, &format!("a line of more than {LOG_BYTES} bytes, left out")),
    }
}

/// The configuration while `create` runs.
pub(super) struct ConfigContext<'a> {
    value: &'a serde_json::Value,
    /// Texts that were asked for, by path; they stay where they are until `create` is done.
    texts: BTreeMap<String, CString>,
}

impl<'a> ConfigContext<'a> {
    pub(super) fn new(value: &'a serde_json::Value) -> Self {
        Self { value, texts: BTreeMap::new() }
    }

    fn find(&self, path: &str) -> Option<&'a serde_json::Value> {
        path.split('.').try_fold(self.value, |value, key| match value {
            serde_json::Value::Array(items) => items.get(key.parse::<usize>().ok()?),
            other => other.get(key),
        })
    }

    /// A text, which lives as long as this.
    fn text(&mut self, path: &str) -> Option<*const c_char> {
        if let Some(kept) = self.texts.get(path) {
            return Some(kept.as_ptr());
        }
        let text = CString::new(self.find(path)?.as_str()?).ok()?;
        // The heap buffer of a CString does not move when the map grows.
        Some(self.texts.entry(path.to_owned()).or_insert(text).as_ptr())
    }
}

/// Answers one question about the configuration. The context is borrowed for the question alone, so that no two
/// borrows of it overlap.
///
/// # Safety
/// `context` is null or a `ConfigContext` that nothing else uses now; `path` is null or NUL-terminated; `out` is null
/// or a place for an answer.
unsafe fn answer<T>(
    context: *mut c_void,
    path: *const c_char,
    out: *mut T,
    find: impl FnOnce(&mut ConfigContext<'_>, &str) -> Option<T>,
) -> abi::Status {
    // SAFETY: by the caller.
    let asked = unsafe { (context.cast::<ConfigContext<'_>>().as_mut(), text_of(path, NAME_BYTES), out.as_mut()) };
    let (Some(context), Ok(Some(path)), Some(out)) = asked else { return abi::ERROR };
    match find(context, &path) {
        Some(value) => {
            *out = value;
            abi::OK
        }
        None => abi::ERROR,
    }
}

/// `get_f64` of `dragfree_config_v1`.
pub(super) unsafe extern "C" fn get_f64(context: *mut c_void, path: *const c_char, out: *mut f64) -> abi::Status {
    // SAFETY: as the header promises.
    unsafe { answer(context, path, out, |config, path| config.find(path)?.as_f64()) }
}

/// `get_text` of `dragfree_config_v1`.
pub(super) unsafe extern "C" fn get_text(
    context: *mut c_void,
    path: *const c_char,
    out: *mut *const c_char,
) -> abi::Status {
    // SAFETY: as the header promises.
    unsafe { answer(context, path, out, |config, path| config.text(path)) }
}

/// Bytes that a plugin writes, up to a limit.
pub(super) struct Collected {
    pub(super) bytes: Vec<u8>,
    limit: usize,
    /// A call that could not be taken, and why.
    pub(super) refused: Option<String>,
}

impl Collected {
    pub(super) fn new(limit: usize) -> Self {
        Self { bytes: Vec::new(), limit, refused: None }
    }
}

/// `write` of `dragfree_writer_v1`.
pub(super) unsafe extern "C" fn collect(context: *mut c_void, bytes: *const u8, length: usize) -> abi::Status {
    // SAFETY: the context is the `Collected` of `Instance::bytes_from`, which nothing else uses now.
    let Some(collected) = (unsafe { context.cast::<Collected>().as_mut() }) else { return abi::ERROR };
    if length > collected.limit - collected.bytes.len() {
        collected.refused = Some(format!("writes more than {} bytes", collected.limit));
    } else if length > 0 && bytes.is_null() {
        collected.refused = Some("writes bytes from nowhere".to_owned());
    }
    if collected.refused.is_some() {
        return abi::ERROR;
    }
    if length > 0 {
        // SAFETY: the plugin gives `length` bytes, which is below the limit and so below `isize::MAX`.
        collected.bytes.extend_from_slice(unsafe { std::slice::from_raw_parts(bytes, length) });
    }
    abi::OK
}

#[cfg(test)]
#[allow(clippy::undocumented_unsafe_blocks, reason = "the tests stand for a plugin that keeps the header's promises")]
mod tests {
    use super::*;
    use serde_json::json;

    /// A length beyond `isize::MAX` made a slice that no program may have.
    #[test]
    fn bytes_beyond_the_limit_are_refused() {
        let byte = [7_u8; 4];
        let mut collected = Collected::new(6);
        let context = (&raw mut collected).cast();
        let write = |pointer: *const u8, length| unsafe { collect(context, pointer, length) };
        assert_eq!(write(byte.as_ptr(), 4), abi::OK);
        assert_eq!(write(byte.as_ptr(), usize::MAX), abi::ERROR);
        assert_eq!(write(byte.as_ptr(), 1), abi::ERROR, "what failed once stays so");
        assert_eq!((collected.bytes, collected.refused.is_some()), (vec![7; 4], true));
        let mut null = Collected::new(6);
        assert_eq!(unsafe { collect((&raw mut null).cast(), std::ptr::null(), 1) }, abi::ERROR);
        assert_eq!(unsafe { collect(std::ptr::null_mut(), byte.as_ptr(), 1) }, abi::ERROR);
    }

    #[test]
    fn questions_about_the_configuration() {
        let value = json!({"parameters": {"gain": 2.5, "name": "x", "list": [1, {"deep": "y"}]}});
        let mut config = ConfigContext::new(&value);
        let context = (&raw mut config).cast();
        let number = |path: *const c_char| {
            let mut out = f64::NAN;
            (unsafe { get_f64(context, path, &raw mut out) }, out)
        };
        assert_eq!(number(c"parameters.gain".as_ptr()), (abi::OK, 2.5));
        assert_eq!(number(c"parameters.name".as_ptr()).0, abi::ERROR);
        assert_eq!(number(std::ptr::null()).0, abi::ERROR);
        assert_eq!(unsafe { get_f64(context, c"parameters.gain".as_ptr(), std::ptr::null_mut()) }, abi::ERROR);
        let text = |path: &std::ffi::CStr| {
            let mut out = std::ptr::null();
            (unsafe { get_text(context, path.as_ptr(), &raw mut out) }, out)
        };
        let first = text(c"parameters.name");
        assert_eq!(first.0, abi::OK);
        assert_eq!(text(c"parameters.list.1.deep").0, abi::OK);
        assert_eq!(text(c"parameters.name").1, first.1, "asked again, it is where it was");
        assert_eq!(unsafe { std::ffi::CStr::from_ptr(first.1) }, c"x");
        assert_eq!(text(c"parameters.list.9").0, abi::ERROR);
    }
}
