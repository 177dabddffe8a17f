//! Rows in memory that two processes share. One of them writes, the other reads; whose turn it is, messages say.

use bytemuck::AnyBitPattern;
use rustix::fs::{MemfdFlags, SealFlags};
use rustix::mm::{MapFlags, ProtFlags};
use std::io;
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::ptr::{NonNull, null_mut};

use crate::limits::ISOLATED_BYTES;
use crate::table::Batch;

/// Bytes of a value.
const VALUE: usize = size_of::<f64>();
/// Smallest mapping, bytes.
const LEAST: usize = 1 << 20;

/// Shared memory, as far as it is mapped here.
#[derive(Debug)]
pub(super) struct Memory {
    file: OwnedFd,
    map: Option<NonNull<u8>>,
    size: usize,
}

// SAFETY: the mapping belongs to this value alone, and moves with it.
unsafe impl Send for Memory {}

impl Drop for Memory {
    fn drop(&mut self) {
        self.unmap();
    }
}

impl Memory {
    /// Memory of no size, which cannot shrink: a reader that has looked at its size may rely on it.
    ///
    /// # Errors
    /// The system has no memory of that kind.
    pub(super) fn new() -> io::Result<Self> {
        let file = rustix::fs::memfd_create("dragfree rows", MemfdFlags::CLOEXEC | MemfdFlags::ALLOW_SEALING)?;
        rustix::fs::fcntl_add_seals(&file, SealFlags::SHRINK | SealFlags::SEAL)?;
        Ok(Self::of(file))
    }

    /// Memory that another process has made.
    pub(super) fn of(file: OwnedFd) -> Self {
        Self { file, map: None, size: 0 }
    }

    pub(super) fn descriptor(&self) -> BorrowedFd<'_> {
        self.file.as_fd()
    }

    fn unmap(&mut self) {
        if let Some(map) = self.map.take() {
            // SAFETY: the mapping is this value's, and nothing points into it: borrows of it borrow this value.
            let _ = unsafe { rustix::mm::munmap(map.as_ptr().cast(), self.size) };
        }
    }

    /// Maps at least so many bytes, which the file has.
    fn map(&mut self, bytes: usize) -> io::Result<NonNull<u8>> {
        if let Some(map) = self.map.filter(|_| self.size >= bytes) {
            return Ok(map);
        }
        let size = usize::try_from(rustix::fs::fstat(&self.file)?.st_size).unwrap_or(0);
        if size < bytes {
            return Err(io::Error::new(io::ErrorKind::UnexpectedEof, "rows that are not in the shared memory"));
        }
        self.unmap();
        // SAFETY: a new mapping at a place that the system chooses.
        let map = unsafe {
            rustix::mm::mmap(null_mut(), size, ProtFlags::READ | ProtFlags::WRITE, MapFlags::SHARED, &self.file, 0)?
        };
        (self.map, self.size) = (NonNull::new(map.cast()), size);
        self.map.ok_or_else(|| io::Error::other("memory at address zero"))
    }

    /// Writes columns one behind the other, each as the bytes of its values.
    ///
    /// # Errors
    /// There are too many, or there is no memory for them.
    pub(super) fn write(&mut self, columns: &[&[u8]]) -> io::Result<()> {
        let bytes = within(columns.iter().map(|column| column.len()).sum())?;
        if bytes == 0 {
            return Ok(());
        }
        if self.map.is_none() || self.size < bytes {
            let size = bytes.next_power_of_two().max(LEAST);
            rustix::fs::ftruncate(&self.file, size as u64)?;
        }
        let mut to = self.map(bytes)?;
        for column in columns {
            // SAFETY: all columns together have `bytes` bytes, which are mapped; a slice of ours does not lie there.
            unsafe {
                to.as_ptr().copy_from_nonoverlapping(column.as_ptr(), column.len());
                to = to.add(column.len());
            }
        }
        Ok(())
    }

    /// Copies tables of so many rows and columns out.
    ///
    /// # Errors
    /// They are not there.
    pub(super) fn copied(&mut self, tables: &[(usize, usize)]) -> io::Result<Vec<Batch>> {
        let mut columns = self.columns(tables)?;
        let batch = |(rows, count): &(usize, usize)| Batch {
            time_ns: columns.copied(*rows),
            columns: (0..*count).map(|_| columns.copied(*rows)).collect(),
        };
        Ok(tables.iter().map(batch).collect())
    }

    /// The columns of tables of so many rows and columns, beside the times.
    ///
    /// # Errors
    /// They are not there.
    pub(super) fn columns(&mut self, tables: &[(usize, usize)]) -> io::Result<Columns<'_>> {
        let values = |(rows, columns): &(usize, usize)| columns.saturating_add(1).saturating_mul(*rows);
        let bytes = tables.iter().map(values).fold(0, usize::saturating_add).saturating_mul(VALUE);
        let from = if bytes == 0 { NonNull::<u64>::dangling().cast() } else { self.map(within(bytes)?)? };
        Ok(Columns { from, left: bytes, _memory: std::marker::PhantomData })
    }
}

/// Columns in shared memory, one after the other.
pub(super) struct Columns<'a> {
    from: NonNull<u8>,
    /// Bytes that are left.
    left: usize,
    _memory: std::marker::PhantomData<&'a mut Memory>,
}

impl<'a> Columns<'a> {
    fn next(&mut self, rows: usize) -> NonNull<u8> {
        let bytes = rows * VALUE;
        assert!(bytes <= self.left, "the memory was mapped for these columns");
        let column = self.from;
        self.left -= bytes;
        // SAFETY: within the mapping, or at its end.
        self.from = unsafe { column.add(bytes) };
        column
    }

    fn copied<T: AnyBitPattern>(&mut self, rows: usize) -> Vec<T> {
        let from = self.next(rows);
        let mut out: Vec<T> = Vec::with_capacity(rows);
        // SAFETY: `rows` values are mapped there; all are written before they count. The other process may change them
        // meanwhile, and any bits are a number.
        unsafe {
            from.as_ptr().copy_to_nonoverlapping(out.as_mut_ptr().cast(), rows * VALUE);
            out.set_len(rows);
        }
        out
    }

    /// The values where they lie.
    ///
    /// # Safety
    /// The other process does not write while they are used.
    pub(super) unsafe fn lying<T: AnyBitPattern>(&mut self, rows: usize) -> &'a [T] {
        let from = self.next(rows);
        // SAFETY: mapped, aligned as every column is a multiple of a value long, and unchanged by the caller's word.
        unsafe { std::slice::from_raw_parts(from.as_ptr().cast(), rows) }
    }
}

fn within(bytes: usize) -> io::Result<usize> {
    let few = u64::try_from(bytes).is_ok_and(|bytes| bytes <= ISOLATED_BYTES);
    few.then_some(bytes).ok_or_else(|| io::Error::other(format!("{bytes} bytes of rows at once")))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn batch() -> impl Strategy<Value = Batch> {
        (0..5_usize, 0..300_usize).prop_flat_map(|(columns, rows)| {
            let bits = proptest::collection::vec(any::<u64>().prop_map(f64::from_bits), rows);
            (proptest::collection::vec(any::<i64>(), rows), proptest::collection::vec(bits, columns))
                .prop_map(|(time_ns, columns)| Batch { time_ns, columns })
        })
    }

    proptest! {
        /// Bit for bit, NaN and all, through a second mapping, whatever came before.
        #[test]
        fn rows_come_out_as_they_went_in(all in proptest::collection::vec(proptest::collection::vec(batch(), 0..4), 1..4)) {
            let mut here = Memory::new().unwrap();
            let mut there = Memory::of(here.file.try_clone().unwrap());
            for batches in all {
                here.write(&batches.iter().flat_map(Batch::bytes).collect::<Vec<_>>()).unwrap();
                let sizes: Vec<_> = batches.iter().map(|b| (b.rows(), b.columns.len())).collect();
                let bits = |b: &Batch| (b.time_ns.clone(), b.columns.iter().flatten().map(|x| x.to_bits()).collect::<Vec<_>>());
                let out = there.copied(&sizes).unwrap();
                prop_assert_eq!(out.iter().map(bits).collect::<Vec<_>>(), batches.iter().map(bits).collect::<Vec<_>>());
            }
        }
    }

    /// A child that names more rows than there are, or shrinks the memory behind us, ends in an error, not in SIGBUS.
    #[test]
    fn memory_that_is_not_there_is_refused() {
        let mut memory = Memory::new().unwrap();
        assert!(memory.copied(&[(1, 0)]).is_err(), "nothing was written");
        let batch = Batch { time_ns: vec![7; 10], columns: vec![vec![1.0; 10]] };
        memory.write(&batch.bytes()).unwrap();
        assert!(rustix::fs::ftruncate(&memory.file, 0).is_err(), "sealed");
        assert!(memory.copied(&[(LEAST, 1)]).is_err());
        assert!(memory.copied(&[(usize::MAX, usize::MAX)]).is_err());
        assert_eq!(memory.copied(&[(10, 1)]).unwrap(), [batch]);
    }
}
