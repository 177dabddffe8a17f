//! Ending early: whoever asks for it, by a signal or a button, every job of the process ends after its next batch and
//! leaves nothing half done.

use crate::EngineError;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, LazyLock};

static REQUESTED: LazyLock<Arc<AtomicBool>> = LazyLock::new(Arc::default);

/// The flag that asks every job of the process to end; a signal handler may set it.
pub fn flag() -> Arc<AtomicBool> {
    Arc::clone(&REQUESTED)
}

/// Whether somebody asked.
pub(crate) fn requested() -> bool {
    REQUESTED.load(Ordering::Relaxed)
}

/// Ends a job where that was asked for.
///
/// # Errors
/// [`EngineError::Stopped`].
pub(crate) fn check() -> Result<(), EngineError> {
    if requested() { Err(EngineError::Stopped) } else { Ok(()) }
}
