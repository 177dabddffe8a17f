//! Rows as Arrow C Data: borrowed on the way in, owned and checked on the way out.

use arrow_data::ffi::FFI_ArrowArray;
use arrow_schema::{DataType, Field, Fields, ffi::FFI_ArrowSchema};
use dragfree_abi as abi;
use std::collections::HashMap;
use std::ffi::c_void;
use std::ptr;

use super::text::aligned;
use crate::limits::ROWS;
use crate::table::{Batch, Column};

const _: () = assert!(size_of::<FFI_ArrowArray>() == size_of::<abi::ArrowArray>());
const _: () = assert!(size_of::<FFI_ArrowSchema>() == size_of::<abi::ArrowSchema>());

/// The struct type of a table: `time_ns`, then its columns with unit, frame and rate as field metadata.
pub(super) fn fields_of(columns: &[Column]) -> Fields {
    std::iter::once(Field::new("time_ns", DataType::Int64, false))
        .chain(columns.iter().map(|c| {
            let mut metadata: HashMap<String, String> =
                c.attributes.iter().map(|(k, v)| (k.clone(), v.clone())).collect();
            metadata.insert("unit".to_owned(), c.unit.clone());
            metadata.insert("frame".to_owned(), c.frame.clone());
            metadata.insert("rate_hz".to_owned(), c.rate_hz.to_string());
            Field::new(&c.name, DataType::Float64, false).with_metadata(metadata)
        }))
        .collect()
}

/// A struct array over rows that stay the host's: no release, nothing to free but what it points into, which comes with
/// it. The caller keeps that and the rows alive and unchanged while the array is used.
pub(super) fn borrow(time_ns: &[i64], columns: &[&[f64]]) -> (impl Sized + use<>, abi::ArrowArray) {
    let rows = time_ns.len().cast_signed() as i64;
    let mut buffers: Vec<[*const c_void; 2]> = std::iter::once(time_ns.as_ptr().cast())
        .chain(columns.iter().map(|c| c.as_ptr().cast()))
        .map(|values| [ptr::null(), values])
        .collect();
    let mut children: Vec<abi::ArrowArray> = buffers
        .iter_mut()
        .map(|b| abi::ArrowArray { length: rows, n_buffers: 2, buffers: b.as_mut_ptr(), ..abi::ArrowArray::empty() })
        .collect();
    let mut child_pointers: Vec<*mut abi::ArrowArray> = children.iter_mut().map(|c| &raw mut *c).collect();
    // All of these are vectors: what a box holds may only be reached through it, wherever it is moved.
    let mut own_buffers = vec![ptr::null()];
    let array = abi::ArrowArray {
        length: rows,
        n_buffers: 1,
        buffers: own_buffers.as_mut_ptr(),
        n_children: child_pointers.len().cast_signed() as i64,
        children: child_pointers.as_mut_ptr(),
        ..abi::ArrowArray::empty()
    };
    ((children, child_pointers, buffers, own_buffers), array)
}

/// Takes a plugin's array of `time_ns` and so many columns: checks its shape, copies the rows, releases it.
///
/// The types are those that the plugin declared when it was linked, so no schema comes with each call.
///
/// # Safety
/// `array` was written by a plugin as a struct array of the C Data Interface, or is untouched.
pub(super) unsafe fn take(array: abi::ArrowArray, columns: usize) -> Result<Batch, String> {
    if array.release.is_none() {
        return if array.length == 0 && array.children.is_null() {
            Ok(Batch::empty(columns))
        } else {
            Err("an output array without a release function".to_owned())
        };
    }
    // SAFETY: by the caller; the array has not been released.
    let shape = unsafe { check_shape(&array, columns + 1) };
    // SAFETY: the shape was checked; lengths of buffers cannot be checked across a C border.
    let batch = shape.map(|rows| unsafe {
        let child = |i: usize| &**array.children.add(i);
        let skipped = array.offset.cast_unsigned() as usize;
        Batch {
            time_ns: values(child(0), skipped, rows),
            columns: (1..=columns).map(|i| values(child(i), skipped, rows)).collect(),
        }
    });
    // SAFETY: the two structs have one layout; this one releases the array when it is dropped.
    drop(unsafe { std::mem::transmute::<abi::ArrowArray, FFI_ArrowArray>(array) });
    batch
}

/// `rows` values of a primitive array after `skipped` ones. A plugin may have put them at any address.
///
/// # Safety
/// [`check_shape`] has seen the array, and its buffer is as long as it says.
unsafe fn values<T: Copy>(array: &abi::ArrowArray, skipped: usize, rows: usize) -> Vec<T> {
    let mut out: Vec<T> = Vec::with_capacity(rows);
    if rows > 0 {
        let first = (skipped + array.offset.cast_unsigned() as usize) * size_of::<T>();
        // SAFETY: by the caller; bytes have no alignment, and all `rows` values are written before they count.
        unsafe {
            let from = (*array.buffers.add(1)).cast::<u8>().add(first);
            ptr::copy_nonoverlapping(from, out.as_mut_ptr().cast::<u8>(), rows * size_of::<T>());
            out.set_len(rows);
        }
    }
    out
}

/// The number of rows of a struct array of so many primitive children without nulls. Lengths and offsets are small
/// enough afterwards that no sum of them, and no product with the size of a value, overflows.
///
/// # Safety
/// `array` has not been released, and its pointers lead where the C Data Interface says.
unsafe fn check_shape(array: &abi::ArrowArray, children: usize) -> Result<usize, String> {
    if array.n_children != children.cast_signed() as i64 || !aligned(array.children) {
        return Err(format!("an output table of {} children where {children} were declared", array.n_children));
    }
    if array.n_buffers != 1 || array.null_count > 0 || !array.dictionary.is_null() {
        return Err("an output table that is no struct array without nulls".to_owned());
    }
    let within = |what: &str, number: i64| match usize::try_from(number) {
        Ok(number) if number <= ROWS => Ok(number),
        _ => Err(format!("{what} {number}, where 0 to {ROWS} are possible")),
    };
    let rows = within("an output table of length", array.length)?;
    let skipped = within("an output table at offset", array.offset)?;
    for i in 0..children {
        // SAFETY: there are `n_children` pointers.
        let child = unsafe { *array.children.add(i) };
        if !aligned(child.cast_const()) {
            return Err(format!("output column {i} has no array"));
        }
        // SAFETY: it is neither null nor misaligned, and by the caller it is an array.
        let child = unsafe { &*child };
        if child.n_buffers != 2 || !aligned(child.buffers) || child.null_count > 0 || !child.dictionary.is_null() {
            return Err(format!("output column {i} is no primitive array without nulls"));
        }
        within(&format!("output column {i} at offset"), child.offset)?;
        if child.length < (rows + skipped) as i64 {
            return Err(format!("output column {i} has {} rows where the table has {rows}", child.length));
        }
        // SAFETY: there are two buffers.
        if child.length > 0 && unsafe { (*child.buffers.add(1)).is_null() } {
            return Err(format!("output column {i} has no values"));
        }
    }
    Ok(rows)
}

#[cfg(test)]
#[allow(clippy::undocumented_unsafe_blocks, reason = "the tests stand for a plugin that keeps the header's promises")]
mod tests {
    use super::*;

    /// What `check_shape` says of a table of two columns of three rows that `change` has changed.
    fn shape_of(change: impl FnOnce(&mut abi::ArrowArray, &mut [abi::ArrowArray])) -> Result<usize, String> {
        let (times, values) = ([1_i64, 2, 3], [1.0_f64, 2.0, 3.0]);
        let mut buffers = [[ptr::null(), times.as_ptr().cast()], [ptr::null(), values.as_ptr().cast::<c_void>()]];
        let mut children: Vec<abi::ArrowArray> = buffers
            .iter_mut()
            .map(|b| abi::ArrowArray { length: 3, n_buffers: 2, buffers: b.as_mut_ptr(), ..abi::ArrowArray::empty() })
            .collect();
        let first = children.as_mut_ptr();
        let mut pointers: Vec<*mut abi::ArrowArray> = (0..2).map(|i| unsafe { first.add(i) }).collect();
        let mut table = abi::ArrowArray {
            length: 3,
            n_buffers: 1,
            n_children: 2,
            children: pointers.as_mut_ptr(),
            ..abi::ArrowArray::empty()
        };
        change(&mut table, unsafe { std::slice::from_raw_parts_mut(first, 2) });
        unsafe { check_shape(&table, 2) }
    }

    #[test]
    fn what_is_borrowed_is_where_the_array_says() {
        let (times, values) = ([1_i64, 2, 3], [4.0_f64, 5.0, 6.0]);
        let (_owned, array) = borrow(&times, &[&values]);
        assert_eq!(unsafe { check_shape(&array, 2) }, Ok(3));
        assert!(unsafe { (*array.buffers).is_null() });
        let column = |i: usize| unsafe { &**array.children.add(i) };
        assert_eq!(unsafe { super::values::<i64>(column(0), 1, 2) }, times[1..]);
        assert_eq!(unsafe { super::values::<f64>(column(1), 0, 3) }, values);
    }

    /// A length of 2^60, or a large offset, ended the program: their products with the size of a value overflow.
    #[test]
    fn lengths_and_offsets_that_overflow_are_refused() {
        assert_eq!(shape_of(|_, _| ()), Ok(3));
        for huge in [1 << 25, 1 << 60, i64::MAX, -1, i64::MIN] {
            assert!(shape_of(|t, c| (t.length, c[0].length, c[1].length) = (huge, huge, huge)).is_err(), "{huge}");
            assert!(shape_of(|t, c| (t.offset, c[0].length, c[1].length) = (huge, i64::MAX, i64::MAX)).is_err());
            assert!(shape_of(|_, c| c[1].offset = huge).is_err(), "{huge}");
        }
        assert!(shape_of(|t, _| t.offset = 1).is_err(), "one row more than the columns have");
        assert_eq!(shape_of(|t, _| (t.offset, t.length) = (1, 2)), Ok(2));
    }

    #[test]
    fn pointers_that_lead_nowhere_are_refused() {
        assert!(shape_of(|t, _| t.children = ptr::null_mut()).is_err());
        assert!(shape_of(|t, _| t.children = t.children.wrapping_byte_add(1)).is_err());
        assert!(shape_of(|t, _| unsafe { *t.children = ptr::null_mut() }).is_err());
        assert!(shape_of(|t, _| unsafe { *t.children = (*t.children).wrapping_byte_add(4) }).is_err());
        assert!(shape_of(|_, c| c[0].buffers = ptr::null_mut()).is_err());
        assert!(shape_of(|_, c| unsafe { *c[1].buffers.add(1) = ptr::null() }).is_err());
        assert!(shape_of(|t, _| t.n_children = 3).is_err());
        assert!(shape_of(|_, c| c[1].null_count = 1).is_err());
        assert!(shape_of(|_, c| c[1].n_buffers = 3).is_err(), "a text column has three");
    }
}
