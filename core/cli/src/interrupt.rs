//! SIGINT and SIGTERM: the first ends the job after its next batch, the second ends the program at once.

/// Takes the two signals from now on.
///
/// # Errors
/// The operating system refuses.
#[cfg(unix)]
pub(crate) fn listen() -> std::io::Result<()> {
    use signal_hook::consts::{SIGINT, SIGTERM};
    let flag = dragfree_engine::stop::flag();
    for signal in [SIGINT, SIGTERM] {
        // In this order: on the first signal the flag is not set yet.
        signal_hook::flag::register_conditional_shutdown(signal, 128 + signal, flag.clone())?;
        signal_hook::flag::register(signal, flag.clone())?;
    }
    Ok(())
}

#[cfg(not(unix))]
pub(crate) fn listen() -> std::io::Result<()> {
    Ok(())
}
