//! Which plugin runs now, in which call and since when; and a signal handler that names it where the program crashes.
//!
//! The handler reads static memory alone, which is valid in any state of the program: each name is leaked once.

use std::cell::Cell;
use std::collections::BTreeMap;
use std::sync::atomic::{AtomicPtr, AtomicU64, AtomicUsize, Ordering};
use std::sync::{LazyLock, Mutex, PoisonError};
use std::time::{Duration, Instant};

use super::floats;

/// A plugin's name, never freed.
#[derive(Clone, Copy, Debug)]
pub(super) struct Name(&'static &'static str);

/// Most calls noted at a time; those beyond are neither named by another thread's crash nor timed.
const NOTED: usize = 64;

/// The calls, so that a slot can hold a number in place of a text.
const CALLS: [&str; 13] = [
    "open", "create", "link", "activate", "process", "next", "flush", "report", "save", "load", "release", "destroy",
    "a call",
];

/// A call under way.
struct Slot {
    /// Milliseconds after the first call, at least 1; 0 where the slot is free.
    since_ms: AtomicU64,
    call: AtomicUsize,
    /// Null or a leaked name.
    name: AtomicPtr<&'static str>,
}

impl Slot {
    const fn free() -> Self {
        let name = AtomicPtr::new(std::ptr::null_mut());
        Self { since_ms: AtomicU64::new(0), call: AtomicUsize::new(0), name }
    }

    fn name(&self) -> Option<&'static str> {
        // SAFETY: the slots hold null or what `Name::of` has leaked.
        unsafe { self.name.load(Ordering::Acquire).as_ref() }.copied()
    }
}

thread_local! {
    /// The plugin that this thread is in, and the call.
    static CURRENT: Cell<Option<(Name, &'static str)>> = const { Cell::new(None) };
}

/// The plugins that some thread is in: a plugin's own threads carry no name.
static RUNNING: [Slot; NOTED] = [const { Slot::free() }; NOTED];

fn now_ms() -> u64 {
    static FIRST: LazyLock<Instant> = LazyLock::new(Instant::now);
    u64::try_from(FIRST.elapsed().as_millis()).unwrap_or(u64::MAX).saturating_add(1)
}

/// A plugin and a call that has not come back within `limit`, where there is one.
pub fn overdue(limit: Duration) -> Option<(&'static str, &'static str)> {
    let limit_ms = u64::try_from(limit.as_millis()).unwrap_or(u64::MAX);
    let now = now_ms();
    RUNNING.iter().find_map(|slot| {
        let since = slot.since_ms.load(Ordering::Acquire);
        if since == 0 || now.saturating_sub(since) <= limit_ms {
            return None;
        }
        let call = CALLS[slot.call.load(Ordering::Acquire).min(CALLS.len() - 1)];
        let name = slot.name()?;
        // Still the same call: the slot may have been taken over in between.
        (slot.since_ms.load(Ordering::Acquire) == since).then_some((name, call))
    })
}

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

    /// Runs `work`, which calls the plugin: a crash in it is reported under this name. True beside the result where it
    /// left another floating-point control word, which is put back.
    pub(super) fn guarded<R>(self, call: &'static str, work: impl FnOnce() -> R) -> (R, bool) {
        let before = floats::control_word();
        let result = self.during(call, work);
        let changed = floats::control_word() != before;
        if changed {
            floats::restore(before);
        }
        (result, changed)
    }

    fn during<R>(self, call: &'static str, work: impl FnOnce() -> R) -> R {
        let outer = CURRENT.replace(Some((self, call)));
        let now = now_ms();
        let free = |slot: &&Slot| slot.since_ms.compare_exchange(0, now, Ordering::AcqRel, Ordering::Relaxed).is_ok();
        let slot = RUNNING.iter().find(free);
        if let Some(slot) = slot {
            slot.call.store(CALLS.iter().position(|c| *c == call).unwrap_or(CALLS.len() - 1), Ordering::Release);
            slot.name.store(std::ptr::from_ref(self.0).cast_mut(), Ordering::Release);
        }
        let result = work();
        if let Some(slot) = slot {
            slot.name.store(std::ptr::null_mut(), Ordering::Release);
            slot.since_ms.store(0, Ordering::Release);
        }
        CURRENT.set(outer);
        result
    }
}

#[cfg(unix)]
mod handler {
    use super::{CURRENT, Name, RUNNING};
    use libc::{c_int, c_void, siginfo_t};
    use std::sync::{Once, OnceLock};

    /// Signals of a crash and their meaning.
    const FATAL_SIGNALS: [(c_int, &str); 6] = [
        (libc::SIGSEGV, "crashed: SIGSEGV, memory that is not its own"),
        (libc::SIGBUS, "crashed: SIGBUS, memory that is not there"),
        (libc::SIGILL, "crashed: SIGILL, an illegal instruction"),
        (libc::SIGFPE, "crashed: SIGFPE, a division of whole numbers by zero"),
        (libc::SIGABRT, "crashed: SIGABRT, it aborted"),
        (libc::SIGTRAP, "crashed: SIGTRAP, a trap"),
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

    /// Says which plugin did `what`: that of this thread, or else those that any thread is in. False where there is
    /// none.
    pub(in super::super) fn blame(what: &str) -> bool {
        let mut line = Line { bytes: [0; 1024], length: 0 };
        if let Some((Name(name), call)) = CURRENT.get() {
            let end = "; report it to its author, `dragfree plugins validate` helps to find it\n";
            for text in ["\ndragfree: plugin ", name, ": ", call, ": ", what, end] {
                line.put(text);
            }
        } else {
            for name in RUNNING.iter().filter_map(super::Slot::name) {
                let first = "\ndragfree: outside of the program's own threads, while these plugins ran: ";
                line.put(if line.length == 0 { first } else { ", " });
                line.put(name);
            }
            if line.length > 0 {
                [": ", what, "\n"].iter().for_each(|text| line.put(text));
            }
        }
        // SAFETY: `write` may be called in a signal handler; the buffer lives during the call.
        line.length > 0 && unsafe { libc::write(libc::STDERR_FILENO, line.bytes.as_ptr().cast(), line.length) } >= 0
    }

    /// Reports the plugin, restores the previous handler and lets the signal come again.
    extern "C" fn report_crash(signal: c_int, info: *mut siginfo_t, _: *mut c_void) {
        let index = FATAL_SIGNALS.iter().position(|(fatal, _)| *fatal == signal).unwrap_or(0);
        blame(FATAL_SIGNALS[index].1);
        // SAFETY: `sigaction` and `raise` may be called in a signal handler; the structures and `info` live during the
        // calls.
        unsafe {
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
pub(super) use handler::{blame, install};

/// Elsewhere there are no signals.
#[cfg(not(unix))]
pub(super) fn install() {}
