//! Source `{{NAME}}`: telemetry that is no file of ours; here a housekeeping channel that swings once in ten minutes.
//!
//! The lines to change for another source are marked with CHANGE.

use dragfree_sdk::prelude::*;

/// CHANGE: time from row to row, ns.
const STEP_NS: i64 = 10_000_000_000;

struct Swing {
    amplitude_k: f64,
    end_ns: i64,
    next_ns: i64,
    columns: Option<(Table, Out)>,
}

impl Source for Swing {
    const MANIFEST: Manifest = Manifest {
        id: "{{NAME}}",
        version: env!("CARGO_PKG_VERSION"),
        licence: "MIT OR Apache-2.0",
        // CHANGE: one sentence.
        description: "A temperature that swings",
        // CHANGE: every parameter with unit, default, range and help; a pipeline that gives another key is refused.
        parameters: &[Parameter::f64("amplitude_k", "K", 0.1, 0.0..=100.0, "how far the temperature swings")],
        instances: &[],
        needs: &[],
    };

    fn new(setup: &Setup) -> Result<Self, PluginError> {
        // CHANGE: a source of files reads `setup.files()`, and may know its times without being asked.
        let start_ns = setup.start_ns().ok_or_else(|| PluginError::error("no start: give --from"))?;
        let end_ns = setup.end_ns().ok_or_else(|| PluginError::error("no end: give --until"))?;
        Ok(Self { amplitude_k: setup.f64("amplitude_k")?, end_ns, next_ns: start_ns, columns: None })
    }

    fn link(&mut self, link: &mut Link<'_>) -> Result<(), PluginError> {
        // CHANGE: tables are called as the topics of the telemetry, `is`, `dws`, `hk/NAME`, their columns as its
        // fields; rate 0 is rows as they come.
        let table = link.table("hk/example_temperature_k", 0.0);
        self.columns = Some((table, link.write(table, "value", "K", "")?));
        Ok(())
    }

    fn next(&mut self, rows: usize, output: &mut Outputs) -> Result<Progress, PluginError> {
        let Some((table, value)) = self.columns else { return Err(PluginError::fatal("called before it was linked")) };
        for _ in 0..rows.max(1) {
            if self.next_ns >= self.end_ns {
                break;
            }
            output.time(table).push(self.next_ns);
            // CHANGE: the values, NaN for none.
            let turns = (self.next_ns % 600_000_000_000) as f64 / 600e9;
            output.f64(value).push(293.0 + self.amplitude_k * (std::f64::consts::TAU * turns).sin());
            self.next_ns += STEP_NS;
        }
        Ok(Progress { complete_until_ns: self.next_ns.min(self.end_ns), done: self.next_ns >= self.end_ns })
    }

    fn report(&mut self) -> Result<Report, PluginError> {
        Ok(Report::default())
    }

    fn state(&mut self, state: &mut State<'_>) -> Result<(), PluginError> {
        Ok(state.i64(&mut self.next_ns)?)
    }
}

export_plugin!(sources: [Swing]);
