//! Ends the program where a plugin does not come back: nothing can take a thread out of foreign code.

use crate::progress;
use crate::text::{self, Paint};
use dragfree_engine::border;
use std::io::Write as _;
use std::time::Duration;

/// Most time between two looks.
const LOOK: Duration = Duration::from_millis(500);

/// Looks from now on whether a call of a plugin takes longer than `limit`.
pub(crate) fn start(limit: Duration) {
    let pause = (limit / 8).min(LOOK);
    std::thread::spawn(move || {
        loop {
            std::thread::sleep(pause);
            if let Some((plugin, call)) = border::overdue(limit) {
                end(plugin, call, limit);
            }
        }
    });
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
