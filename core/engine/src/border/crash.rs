//! A signal handler that names the plugin, and the call, in which the program crashed.
//!
//! It reads static memory alone, which is valid in any state of the program: each name is leaked once.

use std::cell::Cell;
use std::collections::BTreeMap;
use std::sync::atomic::{AtomicPtr, Ordering};
use std::sync::{Mutex, PoisonError};

/// A plugin's name, never freed.
#[derive(Clone, Copy, Debug)]
pub(super) struct Name(&'static &'static str);

/// Most calls noted at a time; the crash report of another thread omits those beyond.
const NOTED: usize = 64;

thread_local! {
    /// The plugin that this thread is in, and the call.
    static CURRENT: Cell<Option<(Name, &'static str)>> = const { Cell::new(None) };
}

/// The plugins that some thread is in: a plugin's own threads carry no name.
static RUNNING: [AtomicPtr<&'static str>; NOTED] = [const { AtomicPtr::new(std::ptr::null_mut()) }; NOTED];

impl Name {
    pub(super) fn of(name: &str) -> Self {
        static NAMES: Mutex<BTreeMap<&'static str, &'static &'static str>> = Mutex::new(BTreeMap::new());
        let mut names = NAMES.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(kept) = names.get(name) {
            return Self(kept);
        }
        let text: &'static str = Box::leak(name.into());
        let kept: &'static &'static str = Box::leak(Box::new(text));
        names.insert(text, kept);
        Self(kept)
    }

    /// Runs `work`, which calls the plugin; a crash in it is reported under this name.
    pub(super) fn during<R>(self, call: &'static str, work: impl FnOnce() -> R) -> R {
        let outer = CURRENT.replace(Some((self, call)));
        let mark = std::ptr::from_ref(self.0).cast_mut();
        let free = |slot: &&AtomicPtr<_>| {
            slot.compare_exchange(std::ptr::null_mut(), mark, Ordering::Relaxed, Ordering::Relaxed).is_ok()
        };
        let slot = RUNNING.iter().find(free);
        let result = work();
        if let Some(slot) = slot {
            slot.store(std::ptr::null_mut(), Ordering::Relaxed);
        }
        CURRENT.set(outer);
        result
    }
}

#[cfg(unix)]
mod handler {
    use super::{CURRENT, NOTED, Name, RUNNING};
    use libc::{c_int, c_void, siginfo_t};
    use std::sync::atomic::Ordering;
    use std::sync::{Once, OnceLock};

    /// Signals of a crash and their meaning.
    const FATAL_SIGNALS: [(c_int, &str); 6] = [
        (libc::SIGSEGV, "SIGSEGV, memory that is not its own"),
        (libc::SIGBUS, "SIGBUS, memory that is not there"),
        (libc::SIGILL, "SIGILL, an illegal instruction"),
        (libc::SIGFPE, "SIGFPE, a division of whole numbers by zero"),
        (libc::SIGABRT, "SIGABRT, it aborted"),
        (libc::SIGTRAP, "SIGTRAP, a trap"),
    ];

    /// Previous handlers; Rust's own one reports a stack overflow.
    static BEFORE: [OnceLock<libc::sigaction>; FATAL_SIGNALS.len()] = [const { OnceLock::new() }; FATAL_SIGNALS.len()];

    /// Installs the handler, once.
    pub(in super::super) fn install() {
        static INSTALLED: Once = Once::new();
        INSTALLED.call_once(|| {
            for ((signal, _), before) in FATAL_SIGNALS.iter().zip(&BEFORE) {
                // SAFETY: an all-zero sigaction is a valid one; both structures live during the calls, and the handler
                // does nothing that a signal handler may not do.
                unsafe {
                    let mut old: libc::sigaction = std::mem::zeroed();
                    let mut new: libc::sigaction = std::mem::zeroed();
                    new.sa_sigaction = report_crash as extern "C" fn(c_int, *mut siginfo_t, *mut c_void) as usize;
                    new.sa_flags = libc::SA_SIGINFO | libc::SA_ONSTACK;
                    if libc::sigaction(*signal, std::ptr::null(), &raw mut old) == 0 {
                        let _ = before.set(old); // set once, by `call_once`
                        libc::sigaction(*signal, &raw const new, std::ptr::null_mut());
                    }
                }
            }
        });
    }

    /// Text on the stack: a handler must not allocate. What does not fit is cut.
    struct Line {
        bytes: [u8; 1024],
        length: usize,
    }

    impl Line {
        fn put(&mut self, text: &str) {
            let count = text.len().min(self.bytes.len() - self.length);
            self.bytes[self.length..self.length + count].copy_from_slice(&text.as_bytes()[..count]);
            self.length += count;
        }
    }

    /// Reports the plugin, restores the previous handler and lets the signal come again.
    extern "C" fn report_crash(signal: c_int, info: *mut siginfo_t, _: *mut c_void) {
        let index = FATAL_SIGNALS.iter().position(|(fatal, _)| *fatal == signal).unwrap_or(0);
        let mut line = Line { bytes: [0; 1024], length: 0 };
        if let Some((Name(name), call)) = CURRENT.get() {
            let end = "; report it to its author, `dragfree plugins validate` helps to find it\n";
            for text in ["\ndragfree: plugin ", name, ": ", call, ": crashed: ", FATAL_SIGNALS[index].1, end] {
                line.put(text);
            }
        } else {
            let mut separator = "\ndragfree: crashed outside of the program's own threads while these plugins ran: ";
            for slot in &RUNNING[..NOTED] {
                // SAFETY: the slots hold null or what `Name::of` has leaked.
                if let Some(name) = unsafe { slot.load(Ordering::Relaxed).as_ref() } {
                    line.put(separator);
                    line.put(name);
                    separator = ", ";
                }
            }
            if line.length > 0 {
                line.put(": ");
                line.put(FATAL_SIGNALS[index].1);
                line.put("\n");
            }
        }
        // SAFETY: `write`, `sigaction` and `raise` may be called in a signal handler; the buffer, the structures and
        // `info` live during the calls.
        unsafe {
            if line.length > 0 {
                libc::write(libc::STDERR_FILENO, line.bytes.as_ptr().cast(), line.length);
            }
            if let Some(before) = BEFORE[index].get() {
                libc::sigaction(signal, before, std::ptr::null_mut());
            }
            // A fault happens again by itself once this returns; a signal that somebody sent does not.
            if info.as_ref().is_none_or(|info| info.si_code <= 0) {
                libc::raise(signal);
            }
        }
    }
}

#[cfg(unix)]
pub(super) use handler::install;

/// Elsewhere there are no signals.
#[cfg(not(unix))]
pub(super) fn install() {}
