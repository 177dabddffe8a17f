//! The stage: links columns, feeds the gridder, and writes the report.

use chrono::DateTime;
use dragfree_physics::mission::Mission;
use dragfree_sdk::prelude::*;
use serde_json::json;
use std::collections::BTreeMap;

use crate::gridder::{Config, Gridder, Sink, TableSummary};
use crate::layout::{expected, grid_name, stated_rate_hz, table_spec};
use crate::series::Reason;

/// Stage that turns irregular telemetry tables into the uniform table `grid`.
#[derive(Debug)]
pub struct Preprocess {
    mission: Mission,
    mandatory: Vec<String>,
    config: Config,
    /// No column may depend on later samples ([`PREDICTION_NEED`]).
    prediction: bool,
    /// Columns read and written, per table.
    tables: Vec<(Vec<In>, Vec<Out>)>,
    /// The table `ephemeris` and the column of its age: on board the last packet is held.
    age: Option<(usize, Out)>,
    grid: Option<Table>,
    gridder: Option<Gridder>,
}

/// Sink that writes into the host's columns.
struct Host<'a> {
    output: &'a mut Outputs,
    grid: Table,
    tables: &'a [(Vec<In>, Vec<Out>)],
    age: Option<(usize, Out)>,
}

impl Sink for Host<'_> {
    fn times(&mut self) -> &mut Vec<i64> {
        self.output.time(self.grid)
    }
    fn column(&mut self, table: usize, column: usize) -> &mut Vec<f64> {
        self.output.f64(self.tables[table].1[column])
    }
    fn age(&mut self, table: usize) -> Option<&mut Vec<f64>> {
        let (_, out) = self.age.filter(|(of, _)| *of == table)?;
        Some(self.output.f64(out))
    }
}

fn not_linked() -> PluginError {
    PluginError::fatal("preprocess: process called before link")
}

impl Stage for Preprocess {
    const MANIFEST: Manifest = Manifest {
        id: "preprocess",
        version: env!("CARGO_PKG_VERSION"),
        licence: "MIT OR Apache-2.0",
        description: "Brings all telemetry onto one grid of epochs; invalid and missing values become NaN",
        parameters: &[
            Parameter::text_list(
                "mandatory",
                &["is", "dws"],
                "topics that a calibration needs; the densest defines the epochs",
            ),
            Parameter::f64(
                "outlier_sigma",
                "1",
                10.0,
                0.0..=1e9,
                "outlier threshold for displacements and angles, in standard deviations of their second difference; below 7.3 \
                 Gaussian noise raises false alarms; 0 = off",
            ),
            Parameter::i64(
                "stuck_samples",
                "1",
                10,
                0..=10_000,
                "number of equal consecutive samples of an instrument that are invalid (stuck); 0 = off",
            ),
            Parameter::f64(
                "hold_intervals",
                "1",
                2.0,
                1.0..=100.0,
                "number of its own intervals over which slow telemetry is interpolated and held",
            ),
            Parameter::f64(
                "max_gap_s",
                "s",
                21_600.0,
                1.0..=1e6,
                "longest gap filled with rows of NaN; longer ones are omitted from the grid",
            ),
        ],
        instances: &[],
        needs: &[],
    };

    fn new(setup: &Setup) -> Result<Self, PluginError> {
        let mission = Mission::from_json(setup.mission_json())?;
        let mandatory = setup.text_list("mandatory")?;
        if mandatory.is_empty() {
            return Err(PluginError::error(
                "parameter mandatory = []: a mandatory table must define the epochs; name the instruments, e.g. [\"is\", \"dws\"]",
            ));
        }
        let config = Config {
            rate_hz: mission.mission.sample_rate_hz,
            outlier_sigma: setup.f64("outlier_sigma")?,
            stuck_samples: u32::try_from(setup.i64("stuck_samples")?)?,
            hold_intervals: setup.f64("hold_intervals")?,
            max_gap_s: setup.f64("max_gap_s")?,
            counted_from_ns: setup.start_ns().unwrap_or(i64::MIN),
        };
        let prediction = setup.needs(PREDICTION_NEED);
        Ok(Self { mission, mandatory, config, prediction, tables: Vec::new(), age: None, grid: None, gridder: None })
    }

    fn link(&mut self, available: &Available, link: &mut Link<'_>) -> Result<(), PluginError> {
        let mut found: Vec<(&str, Vec<&Column>)> = Vec::new();
        for column in available.columns.iter().filter(|c| c.rate_hz == 0.0) {
            match found.iter_mut().find(|(name, _)| *name == column.table) {
                Some((_, columns)) => columns.push(column),
                None => found.push((&column.table, vec![column])),
            }
        }
        let names: Vec<&str> = found.iter().map(|(name, _)| *name).collect();
        if let Some(missing) = self.mandatory.iter().find(|m| !names.contains(&m.as_str())) {
            let found = if names.is_empty() { "no topics".to_owned() } else { names.join(", ") };
            return Err(PluginError::error(format!(
                "topic {missing} is missing from the telemetry, which has {found}; a calibration needs it: give files that \
                 contain it, or set other topics in preprocess' parameter `mandatory`"
            )));
        }
        let test_masses: Vec<&str> = self.mission.test_mass.keys().map(String::as_str).collect();
        self.require_readouts(available, link, &test_masses)?;
        let grid = link.table("grid", self.config.rate_hz);
        let mut specs = Vec::with_capacity(found.len());
        for (name, columns) in &found {
            let mandatory = self.mandatory.iter().any(|m| m == name);
            let measured = columns.iter().filter(|c| !c.name.ends_with("status")).count();
            let stated = stated_rate_hz(columns).map(|rate| rate.to_string());
            let (mut ins, mut outs) = (Vec::new(), Vec::new());
            for column in columns {
                let mut want = Want::of(column);
                if let Some((unit, frame)) = expected(name, &column.name) {
                    want = want.unit(unit).frame(frame);
                }
                ins.push(link.read(&want)?);
                let mut attributes: Vec<(&str, &str)> =
                    column.attributes.iter().map(|(k, v)| (k.as_str(), v.as_str())).collect();
                attributes.extend(stated.as_deref().map(|rate| ("source_rate_hz", rate)));
                let name = grid_name(name, &column.name, measured == 1);
                outs.push(link.write_with(grid, &name, &column.unit, &column.frame, &attributes)?);
            }
            if *name == "ephemeris" {
                self.age = Some((specs.len(), link.write(grid, "ephemeris.age_s", "s", "")?));
            }
            let mut spec = table_spec(name, columns, mandatory, &test_masses, self.mission.limits.as_ref());
            // Some housekeeping follows commands, as the current of a valve does: interpolated, it would know readouts
            // to come.
            let held = self.prediction && name.starts_with("hk");
            spec.columns.iter_mut().for_each(|column| column.flag |= held);
            specs.push(spec);
            self.tables.push((ins, outs));
        }
        self.grid = Some(grid);
        self.gridder = Some(Gridder::new(self.config.clone(), specs));
        Ok(())
    }

    fn process(&mut self, input: &Inputs<'_>, output: &mut Outputs) -> Result<(), PluginError> {
        let (Some(gridder), Some(grid)) = (&mut self.gridder, self.grid) else { return Err(not_linked()) };
        let mut columns: Vec<&[f64]> = Vec::new();
        for (table, (ins, _)) in self.tables.iter().enumerate() {
            let Some(first) = ins.first() else { continue };
            columns.clear();
            columns.extend(ins.iter().map(|i| input.f64(*i)));
            gridder.take(table, input.times_of(*first), &columns);
        }
        gridder.advance(input.complete_until_ns(), &mut Host { output, grid, tables: &self.tables, age: self.age });
        Ok(())
    }

    fn flush(&mut self, output: &mut Outputs) -> Result<(), PluginError> {
        let (Some(gridder), Some(grid)) = (&mut self.gridder, self.grid) else { return Err(not_linked()) };
        gridder.flush(&mut Host { output, grid, tables: &self.tables, age: self.age });
        Ok(())
    }

    fn report(&mut self, _earlier: &[Report]) -> Result<Report, PluginError> {
        let gridder = self.gridder.as_mut().ok_or_else(not_linked)?;
        let report = report_of(gridder, &self.config);
        gridder.reset_counts();
        Ok(report)
    }

    fn state(&mut self, state: &mut State<'_>) -> Result<(), PluginError> {
        Ok(self.gridder.as_mut().ok_or_else(not_linked)?.visit(state)?)
    }
}

impl Preprocess {
    /// Requests the readouts that a drag-free calibration needs, so that the host names a missing one.
    fn require_readouts(
        &self,
        available: &Available,
        link: &mut Link<'_>,
        test_masses: &[&str],
    ) -> Result<(), PluginError> {
        let mut wanted: Vec<(&str, String)> = Vec::new();
        if self.mandatory.iter().any(|m| m == "is") {
            wanted.extend(
                test_masses.iter().flat_map(|tm| ["y", "z"].map(|axis| ("is", format!("{tm}.r_orf_m.{axis}")))),
            );
        }
        if self.mandatory.iter().any(|m| m == "dws") {
            wanted.extend(["phi", "theta", "psi"].map(|angle| ("dws", format!("sc_crf_rad.{angle}"))));
        }
        wanted.retain(|(table, name)| available.column(table, name).is_none());
        for (table, name) in wanted {
            let (unit, frame) = expected(table, &name).unwrap_or_default();
            link.read(&Want::new(name).table(table).unit(unit).frame(frame))?;
        }
        Ok(())
    }
}

/// Unix nanoseconds as a date in the telemetry's time scale.
fn date(time_ns: i64) -> String {
    DateTime::from_timestamp_nanos(time_ns).format("%Y-%m-%dT%H:%M:%S%.3f").to_string()
}

fn report_of(gridder: &Gridder, config: &Config) -> Report {
    let summaries = gridder.table_summaries();
    let summary = &gridder.summary;
    let mut counts: BTreeMap<String, u64> = BTreeMap::new();
    let mut data_loss = false;
    for (series, table) in gridder.tables.iter().zip(&summaries) {
        for (reason, name) in Reason::ALL {
            let count = series.tally.get(reason);
            if count > 0 {
                counts.insert(format!("{}.{name}", table.name), count);
                data_loss |= Reason::LOSSES.contains(&reason);
            }
        }
        if let Some(missing) = table.missing.filter(|m| *m > 0) {
            counts.insert(format!("{}.missing_epochs", table.name), missing);
        }
    }
    for (name, count) in [("grid.rephased", summary.rephased), ("grid.cut_gaps", summary.cut_gaps)] {
        if count > 0 {
            counts.insert(name.to_owned(), count);
        }
    }
    let mut quality = serde_json::Map::new();
    quality.insert("telemetry".to_owned(), summaries.iter().map(|l| (l.name.clone(), describe(l))).collect());
    Report {
        epochs_used: Some(summary.used),
        epochs_rejected: Some(summary.rejected),
        // A run without a usable epoch counts as data loss.
        data_loss: data_loss || summary.used == 0,
        counts,
        notes: notes(gridder, &summaries, config),
        quality,
        ..Report::default()
    }
}

fn describe(summary: &TableSummary) -> serde_json::Value {
    json!({
        "rate_hz": summary.interval_s.map(|s| 1.0 / s),
        "interpolated": summary.interpolated,
        "after_epoch_s": summary.phase_s,
    })
}

/// Reasons for invalid values, in words.
const VALUE_REASONS: [(Reason, &str); 6] = [
    (Reason::Status, "under a status flag"),
    (Reason::NotANumber, "NaN"),
    (Reason::Infinite, "infinite"),
    (Reason::Limit, "beyond [limits] of the mission file, or beyond what an ephemeris can hold"),
    (Reason::Stuck, "repeated exactly"),
    (Reason::Outlier, "outliers"),
];

/// Remarks for the operator.
fn notes(gridder: &Gridder, summaries: &[TableSummary], config: &Config) -> Vec<String> {
    let summary = &gridder.summary;
    let period_s = 1.0 / config.rate_hz;
    let epochs = summary.used + summary.rejected;
    let mut notes = Vec::new();
    let Some(reference) = gridder.reference_name() else {
        return vec!["no mandatory topic has a row, so there are no epochs".to_owned()];
    };
    if summary.used == 0 {
        notes.push(format!(
            "none of {epochs} epochs has all mandatory channels of a test mass, so there is nothing to calibrate"
        ));
    }
    if summary.longest.rows > 0 {
        notes.push(format!(
            "longest time without all mandatory channels: {:.1} s from {}",
            summary.longest.rows as f64 * period_s,
            date(summary.longest.from_ns)
        ));
    }
    if summary.cut_gaps > 0 {
        notes.push(format!(
            "{} gap(s) of {reference} longer than max_gap_s = {} s are omitted from the grid, the longest {:.1} s from {}",
            summary.cut_gaps,
            config.max_gap_s,
            summary.longest_cut_ns as f64 * 1e-9,
            date(summary.longest_cut_from_ns)
        ));
    }
    if summary.rephased > 0 {
        notes.push(format!(
            "the clock of {reference} jumped {} time(s), first at {}; the epochs follow it, and the epoch before each jump is \
             blank",
            summary.rephased,
            date(summary.first_rephased_ns)
        ));
    }
    for (series, l) in gridder.tables.iter().zip(summaries) {
        let table = &l.name;
        if series.tally.rows_in == 0 {
            notes.push(format!("{table}: no rows"));
        } else if let Some(missing) = l.missing.filter(|m| *m > 0) {
            notes.push(format!("{table}: no sample at {missing} of {epochs} epochs"));
        }
        let refused =
            VALUE_REASONS.iter().map(|(reason, what)| (series.tally.get(*reason), what)).filter(|(n, _)| *n > 0);
        let refused: Vec<String> = refused.map(|(n, what)| format!("{n} {what}")).collect();
        if !refused.is_empty() {
            notes.push(format!("{table}: invalid values: {}", refused.join(", ")));
        }
        if let (true, Some(interval)) = (series.spec.mandatory, l.interval_s)
            && (interval / period_s - 1.0).abs() > 1e-3
        {
            notes.push(format!(
                "{table} has a rate of {:.4} Hz but the mission file says {} Hz, so epochs without a sample are blank; correct \
                 mission.sample_rate_hz",
                1.0 / interval,
                config.rate_hz
            ));
        }
        if let Some(phase) = l.phase_s.filter(|p| p.abs() > period_s * 0.01 && series.tally.rows_placed > 0) {
            notes.push(format!("{table} is sampled {:+.1} ms from the epochs of {reference}", phase * 1e3));
        }
        if !l.absent.is_empty() {
            let columns = l.absent.join(", ");
            notes.push(format!(
                "{table}: {columns} are zero throughout and go on as zeros; where nothing measures them, the mission file \
                 must not say that they are read"
            ));
        }
    }
    notes
}
