//! Texts and pointers from plugins: nothing is read beyond what may be there.

use std::ffi::c_char;

/// Whether a pointer can be a reference's: neither null nor misaligned.
pub(super) fn aligned<T>(pointer: *const T) -> bool {
    !pointer.is_null() && pointer.is_aligned()
}

/// A text of at most `limit` bytes; `None` for null. Bytes that are no UTF-8 become replacement characters.
///
/// # Errors
/// It has no end within the limit.
///
/// # Safety
/// `text` is null, or its bytes up to a NUL, or `limit` of them, can be read.
pub(super) unsafe fn text_of(text: *const c_char, limit: usize) -> Result<Option<String>, String> {
    if text.is_null() {
        return Ok(None);
    }
    let mut length = 0;
    // SAFETY: by the caller; nothing behind the NUL is read.
    while unsafe { *text.add(length) } != 0 {
        length += 1;
        if length > limit {
            return Err(format!("a text of more than {limit} bytes"));
        }
    }
    // SAFETY: these bytes were just read.
    let bytes = unsafe { std::slice::from_raw_parts(text.cast::<u8>(), length) };
    Ok(Some(String::from_utf8_lossy(bytes).into_owned()))
}

#[cfg(test)]
#[allow(clippy::undocumented_unsafe_blocks, reason = "the tests stand for a plugin that keeps the header's promises")]
mod tests {
    use super::*;

    #[test]
    fn a_text_ends_at_its_limit() {
        let read = |bytes: &[u8], limit| unsafe { text_of(bytes.as_ptr().cast(), limit) };
        assert_eq!(read(b"abc\0def\0", 3), Ok(Some("abc".to_owned())));
        assert_eq!(read(b"\0", 0), Ok(Some(String::new())));
        assert_eq!(read(b"a\xff\0", 9), Ok(Some("a\u{fffd}".to_owned())));
        assert!(read(b"abcd", 3).is_err(), "no NUL within the limit");
        assert_eq!(unsafe { text_of(std::ptr::null(), 3) }, Ok(None));
    }
}
