//! Ends the program where a plugin does not come back: nothing can take a thread out of foreign code.

use crate::progress;
use crate::text::{self, Paint};
use dragfree_engine::border;
use std::io::Write as _;
use std::time::{Duration, Instant};

/// Most time between two looks.
const LOOK: Duration = Duration::from_millis(500);

/// Looks from now on whether a call of a plugin takes longer than `limit`.
pub(crate) fn start(limit: Duration) {
    let pause = (limit / 8).min(LOOK);
    let watch = move || {
        // Time in which the program was stopped, by a terminal or a debugger: no plugin could come back then.
        let mut stopped = Duration::ZERO;
        loop {
            let before = Instant::now();
            std::thread::sleep(pause);
            stopped += before.elapsed().saturating_sub(2 * pause);
            if let Some((plugin, call)) = border::overdue(limit + stopped) {
                end(plugin, call, limit);
            }
        }
    };
    if let Err(error) = std::thread::Builder::new().spawn(watch) {
        // Nobody is left to tell where this fails.
        let _ = writeln!(std::io::stderr(), "dragfree: nobody looks whether plugins come back: {error}");
    }
}

fn end(plugin: &str, call: &str, limit: Duration) -> ! {
    progress::clear_line();
    let plugin = text::harmless(plugin, Paint(false));
    let limit = limit.as_secs_f64();
    // Nobody is left to tell.
    let _ = writeln!(
        std::io::stderr(),
        "dragfree: plugin {plugin}: {call}: did not come back within {limit} s; nothing was archived. \
         `dragfree plugins validate` helps to find out why, --plugin-time-limit gives it longer"
    );
    border::exit_now(1)
}
