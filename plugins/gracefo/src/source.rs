//! Source `gracefo`: the run's files in, irregular tables out.

use dragfree_physics::mission::Mission;
use dragfree_sdk::prelude::*;

use crate::Window;
use crate::telemetry::Telemetry;

/// Reads GRACE-FO Level-1 text files of the spacecraft that the mission names.
#[derive(Debug)]
pub struct GraceFo {
    telemetry: Telemetry,
    spacecraft: String,
    letter: char,
    tables: Vec<(Table, Vec<Out>)>,
}

/// Letter of a spacecraft's name: `C` for `GRACE-FO-C`.
///
/// # Errors
/// The name ends with neither `C` nor `D`.
pub fn letter_of(spacecraft: &str) -> Result<char, PluginError> {
    spacecraft.chars().next_back().filter(|c| matches!(c, 'C' | 'D')).ok_or_else(|| {
        PluginError::error(format!(
            "mission.spacecraft = `{spacecraft}` must end with C or D, which selects the spacecraft in the source gracefo; write \
             `GRACE-FO-C` or `GRACE-FO-D`"
        ))
    })
}

impl Source for GraceFo {
    const MANIFEST: Manifest = Manifest {
        id: "gracefo",
        version: env!("CARGO_PKG_VERSION"),
        licence: "MIT OR Apache-2.0",
        description: "Reads GRACE-FO Level-1 text files, plain or in .tgz archives",
        parameters: &[Parameter::text_list(
            "products",
            &[],
            "products to read, e.g. ACC1A and SCA1B; empty for all in the files",
        )],
        instances: &[],
        needs: &[],
    };

    fn new(setup: &Setup) -> Result<Self, PluginError> {
        let mission = Mission::from_json(setup.mission_json())?;
        let letter = letter_of(&mission.mission.spacecraft)?;
        let window = Window {
            start_ns: setup.start_ns().unwrap_or(Window::ALL.start_ns),
            end_ns: setup.end_ns().unwrap_or(Window::ALL.end_ns),
        };
        let telemetry = Telemetry::open(setup.files(), letter, window, &setup.text_list("products")?)?;
        Ok(Self { telemetry, spacecraft: mission.mission.spacecraft, letter, tables: Vec::new() })
    }

    fn link(&mut self, link: &mut Link<'_>) -> Result<(), PluginError> {
        for id in &self.telemetry.tables {
            let table = link.table(&id.name, 0.0);
            let clock = if id.product.on_receiver_time() { "receiver" } else { "gps" };
            let mut columns = Vec::with_capacity(id.product.columns.len());
            for c in id.product.columns {
                let (_, unit, ..) = c.quantity.units();
                let attributes = [("product", id.product.code), ("variable", c.variable), ("clock", clock)];
                columns.push(link.write_with(table, c.name, unit, c.frame, &attributes)?);
            }
            self.tables.push((table, columns));
        }
        Ok(())
    }

    fn next(&mut self, rows: usize, output: &mut Outputs) -> Result<Progress, PluginError> {
        let tables = &self.tables;
        let (complete_until_ns, done) = self.telemetry.next(rows, |table, k, rows| {
            let (out, columns) = &tables[table];
            output.time(*out).push(rows.time_ns[k]);
            for (column, values) in columns.iter().zip(&rows.columns) {
                output.f64(*column).push(values[k]);
            }
        })?;
        Ok(Progress { complete_until_ns, done })
    }

    fn report(&mut self) -> Result<Report, PluginError> {
        let log = self.telemetry.log();
        let mut notes: Vec<String> = log.notes.values().cloned().collect();
        let codes = |of: fn(&crate::product::Product) -> bool| {
            let mut codes: Vec<&str> =
                self.telemetry.tables.iter().filter(|t| of(t.product)).map(|t| t.product.code).collect();
            codes.dedup();
            codes.join(", ")
        };
        let receiver = codes(crate::product::Product::on_receiver_time);
        if !receiver.is_empty() {
            notes.push(format!(
                "{receiver}: time tags are those of the on-board receiver, not GPS time; the clock offsets of CLK1B (tens of \
                 milliseconds) are not applied"
            ));
        }
        let transplanted = codes(|p| p.code.starts_with("ACT"));
        if self.letter == 'D' && !transplanted.is_empty() {
            notes.push(format!(
                "{transplanted} of spacecraft D is the accelerometer of C, transplanted; ACC1A is its own"
            ));
        }
        let quality = [
            ("time_scale", "GPS".to_owned()),
            ("mission", "GRACE-FO".to_owned()),
            ("spacecraft", self.spacecraft.clone()),
        ];
        Ok(Report {
            counts: log.counts.clone(),
            notes,
            data_loss: log.data_loss,
            quality: quality.into_iter().map(|(k, v)| (k.to_owned(), v.into())).collect(),
            ..Report::default()
        })
    }

    fn state(&mut self, state: &mut State<'_>) -> Result<(), PluginError> {
        self.telemetry.visit(state)
    }
}
