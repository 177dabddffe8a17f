//! A plugin that ends the program, with whatever exit code, has failed: without this, `exit(0)` in a plugin looks like
//! a run that went well and had nothing to say.

use std::sync::atomic::{AtomicBool, Ordering};

/// Whether the program watches over its own end.
static WATCHED: AtomicBool = AtomicBool::new(false);
/// Whether the program has come to its end by itself.
static DONE: AtomicBool = AtomicBool::new(false);

/// From now on the program ends with failure unless it says [`exit_is_due`] before.
#[cfg(unix)]
pub fn watch_exit() {
    if !WATCHED.swap(true, Ordering::Relaxed) {
        // SAFETY: the function stays; where it cannot be registered, an exit goes unwatched.
        unsafe {
            libc::atexit(at_exit);
            #[cfg(all(target_os = "linux", target_env = "gnu"))]
            at_quick_exit(at_exit);
        }
    }
}

#[cfg(not(unix))]
pub fn watch_exit() {}

/// The program has done what it was asked to, or has said why not.
pub fn exit_is_due() {
    DONE.store(true, Ordering::Relaxed);
}

/// How a process ended that should have gone on.
pub fn ended(status: std::process::ExitStatus) -> String {
    #[cfg(unix)]
    if let Some(signal) = std::os::unix::process::ExitStatusExt::signal(&status) {
        let name = match signal {
            libc::SIGILL => ", an illegal instruction",
            libc::SIGABRT => ", it aborted",
            libc::SIGBUS | libc::SIGSEGV => ", memory that is not its own",
            libc::SIGFPE => ", a division of whole numbers by zero",
            _ => "",
        };
        return format!("crashed: signal {signal}{name}");
    }
    format!("ended the process: {status}")
}

/// Ends the program now, and runs no code of any library.
pub fn exit_now(code: u8) -> ! {
    exit_is_due();
    #[cfg(unix)]
    end(code.into());
    #[cfg(not(unix))]
    std::process::exit(code.into())
}

#[cfg(all(target_os = "linux", target_env = "gnu"))]
unsafe extern "C" {
    /// The C library's, as its manual says; the crate `libc` does not have it.
    fn at_quick_exit(function: extern "C" fn()) -> libc::c_int;
}

/// What a plugin that ends the program has done.
#[cfg(unix)]
const ENDED: &str = "ended the program";

#[cfg(unix)]
fn is_due() -> bool {
    DONE.load(Ordering::Relaxed) || !WATCHED.load(Ordering::Relaxed) || crate::stop::requested()
}

#[cfg(unix)]
extern "C" fn at_exit() {
    if !is_due() {
        super::crash::blame(ENDED);
        end(1);
    }
}

/// In place of the C library's, for libraries that are opened: they see the program's symbols first.
///
/// The program itself and its standard library end by `exit`, or by this outside of any plugin's call.
#[cfg(all(target_os = "linux", target_env = "gnu"))]
#[unsafe(no_mangle)]
extern "C" fn _exit(code: libc::c_int) -> ! {
    let failed = !is_due() && super::crash::blame(ENDED);
    end(if failed { 1 } else { code })
}

#[cfg(target_os = "linux")]
fn end(code: libc::c_int) -> ! {
    loop {
        // SAFETY: the call takes a number and does not return.
        unsafe { libc::syscall(libc::SYS_exit_group, code) };
    }
}

#[cfg(all(unix, not(target_os = "linux")))]
fn end(code: libc::c_int) -> ! {
    // SAFETY: the call takes a number and does not return.
    unsafe { libc::_exit(code) }
}

/// Gives memory that is not in use back to the system, where the C library can: it keeps what the largest day needed,
/// and with threads that come and go ever more of it.
pub fn give_memory_back() {
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    // SAFETY: takes a number, and may be called at any time.
    unsafe {
        libc::malloc_trim(0);
    }
}
