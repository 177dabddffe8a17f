//! A small catalogue of manoeuvres, and the information of each per second.
//!
//! Information is quadratic in the regressors, and the response of the loop to a manoeuvre is independent of the noise:
//! what a manoeuvre adds is the information of the regressors of a spacecraft on which nothing happens but the
//! manoeuvre. The telemetry at hand is therefore replayed with every value held at its first one and the response of
//! the linear loop added to commands and readouts; manoeuvres follow each other, and the sums of each are a block of
//! time.

use std::cell::RefCell;

use dragfree_archive::Written;
use dragfree_engine::EngineError;
use dragfree_engine::config::{EffectEntry, Mission as MissionFile};
use dragfree_engine::examine::has_parameter;
use dragfree_engine::run::Progress;
use dragfree_engine::sources::Sources;
use dragfree_engine::table::{Chunk, TableSpec};
use dragfree_identification::quadratic::inverse;
use dragfree_physics::control::Command;
use dragfree_physics::manoeuvre::{Input, LinearLoop, Manoeuvre};
use dragfree_physics::mission::{ANGLES, AXES, Mission};
use dragfree_schema::{AT_NS, FREQUENCY_HZ};
use nalgebra::DMatrix;

use super::length_s;
use crate::WorkflowError;
use crate::likelihood::{Experiment, InBlock, Meaning, Means, Settled, information};
use crate::replay::{Pass, Replay};

/// Largest command of a manoeuvre, and of the loop that answers it, over the limits of the actuators; largest readout
/// over the limits of the telemetry. At this size what is quadratic in displacements and angles stays below the noise.
pub(super) const AUTHORITY: f64 = 0.01;
/// Frequencies, Hz: below, about and above the bandwidth of the loops of the suspended axes.
const FREQUENCIES_HZ: [f64; 3] = [0.004, 0.02, 0.1];
/// A manoeuvre of the catalogue, a whole number of periods of each frequency, s.
const FLOWN_S: f64 = 1000.0;
/// Time in which the loop comes to rest after it, s.
const REST_S: f64 = 1000.0;
/// Time before it, s: channels lag a few samples.
const BEFORE_S: f64 = 20.0;
/// A manoeuvre, with the rest, s.
const SLOT_S: f64 = BEFORE_S + FLOWN_S + REST_S;

/// One manoeuvre of the catalogue.
#[derive(Clone, Debug)]
pub(super) struct Flight {
    pub(super) input: Input,
    /// N or N m.
    pub(super) amplitude: f64,
    pub(super) frequency_hz: f64,
    /// Information of the parameters of the decision per second of the manoeuvre.
    pub(super) per_second: DMatrix<f64>,
}

/// The catalogue on a mission.
pub(super) struct Catalogue {
    pub(super) mission: Mission,
    pub(super) flights: Vec<Flight>,
}

impl Catalogue {
    /// All manoeuvres, with their information in rows like those of a product, by the parameters of a decision.
    ///
    /// # Errors
    /// The mission has no control law, or as a replay.
    pub(super) fn new(
        replay: &Replay<'_>,
        end: &Settled,
        number: usize,
        progress: &mut dyn FnMut(Pass, usize, Progress),
    ) -> Result<Self, WorkflowError> {
        let written = replay.products.get(number).ok_or(WorkflowError::NoProduct)?;
        let sources = Sources::of(&written.path)?;
        let file = MissionFile::load(&sources.mission).map_err(EngineError::from)?;
        let mission = Mission::from_json(&file.value.to_string())?;
        let mut flights = within_limits(&mission, end.decided.parameters.len())?;
        let stage = Stage { replay, end, number, sources, mission: &mission, chosen: steady(replay, end) };
        let quiet = stage.quiet(written, progress)?;
        // Regressors that wait for a filter to settle begin in the first slot, so nothing is flown in it.
        let at_once = ((length_s(written) / SLOT_S) as usize).saturating_sub(1).max(1);
        for flights in flights.chunks_mut(at_once) {
            stage.fly(flights, &quiet, progress)?;
        }
        Ok(Self { mission, flights })
    }
}

/// The forms of candidates but for what acts at a time or a frequency that the data have told: its series are no part
/// of what a manoeuvre does.
fn steady(replay: &Replay<'_>, end: &Settled) -> Vec<EffectEntry> {
    let told = |e: &&EffectEntry| [AT_NS, FREQUENCY_HZ].iter().any(|name| has_parameter(replay.registry, &e.id, name));
    end.chosen.iter().filter(|e| !told(e)).cloned().collect()
}

/// Every input and frequency, with the amplitude at which no command and no readout is beyond its part of the limits.
fn within_limits(mission: &Mission, parameters: usize) -> Result<Vec<Flight>, WorkflowError> {
    let Some(limits) = &mission.actuators else { return Ok(Vec::new()) };
    let flight = |(input, frequency_hz): (Input, f64)| Flight {
        input,
        amplitude: AUTHORITY * input.limit(limits),
        frequency_hz,
        per_second: DMatrix::zeros(parameters, parameters),
    };
    let of_input = |input: Input| FREQUENCIES_HZ.into_iter().map(move |frequency_hz| (input, frequency_hz));
    let mut flights: Vec<Flight> = Input::all(mission).into_iter().flat_map(of_input).map(flight).collect();
    let most: Vec<f64> = most(mission);
    let rows = Rows::of(mission, &flights)?;
    let slot = rows.samples(SLOT_S);
    for (k, flight) in flights.iter_mut().enumerate() {
        // The first slot is quiet.
        let own = rows.values.chunks_exact(rows.width).skip((k + 1) * slot).take(slot).flatten();
        let worst = own.enumerate().map(|(i, x)| x.abs() / (AUTHORITY * most[i % rows.width])).fold(1.0, f64::max);
        flight.amplitude = two_digits(flight.amplitude / worst);
    }
    Ok(flights)
}

/// The largest number of two digits that is not above a positive one.
fn two_digits(x: f64) -> f64 {
    let unit = 10.0_f64.powi(x.log10().floor() as i32 - 1);
    let digits = (x / unit + 1e-9).floor();
    // By its text, so that it is the number that a command line states.
    format!("{digits}e{}", unit.log10().round()).parse().unwrap_or(x)
}

/// Limits of commands, then of readouts, in the order of [`Rows`].
fn most(mission: &Mission) -> Vec<f64> {
    let [force, torque, pushed, turned] = mission.actuators.as_ref().map_or([f64::INFINITY; 4], |limits| {
        [
            limits.thrust_limit_n,
            limits.torque_limit_nm,
            limits.electrostatic_force_limit_n,
            limits.electrostatic_torque_limit_nm,
        ]
    });
    let seen = mission.limits.as_ref();
    let (metres, radians) =
        (seen.map_or(f64::INFINITY, |l| l.displacement_m), seen.map_or(f64::INFINITY, |l| l.angle_rad));
    let test_masses = mission.test_mass.len();
    let of_each = |first: f64, second: f64| [[first; 3], [second; 3]].concat().repeat(test_masses);
    [[force; 3], [torque; 3]]
        .concat()
        .into_iter()
        .chain(of_each(pushed, turned))
        .chain([radians; 3])
        .chain(of_each(metres, radians))
        .collect()
}

/// Commands and readouts of the loop under manoeuvres that follow a quiet slot, row by row: the numbers of the command,
/// the spacecraft's angles, then displacements and angles of each test mass.
struct Rows {
    values: Vec<f64>,
    width: usize,
    dt_s: f64,
}

impl Rows {
    fn of(mission: &Mission, flights: &[Flight]) -> Result<Self, WorkflowError> {
        let mut the_loop = LinearLoop::new(mission)?;
        let dt_s = mission.dt_s();
        let manoeuvre = |(k, f): (usize, &Flight)| {
            let from_s = (k + 1) as f64 * SLOT_S + BEFORE_S;
            let (amplitude, frequency_hz) = (f.amplitude, f.frequency_hz);
            Manoeuvre { input: f.input, amplitude, frequency_hz, from_s, until_s: from_s + FLOWN_S }
        };
        let all: Vec<Manoeuvre> = flights.iter().enumerate().map(manoeuvre).collect();
        let test_masses = mission.test_mass.len();
        let mut rows = Self { values: Vec::new(), width: 9 + 12 * test_masses, dt_s };
        for k in 0..(all.len() + 1) * rows.samples(SLOT_S) {
            let elapsed_s = k as f64 * dt_s;
            let mut command = Command::zero(test_masses);
            all.iter().for_each(|m| m.add(elapsed_s, &mut command));
            let (readout, command) = the_loop.step(&command);
            rows.values.extend(command.numbers());
            rows.values.extend(&readout.sc_crf_rad);
            readout.tm.iter().for_each(|tm| rows.values.extend(tm.r_orf_m.iter().chain(&tm.att_orf_rad)));
        }
        Ok(rows)
    }

    /// Samples of a length of time.
    fn samples(&self, length_s: f64) -> usize {
        (length_s / self.dt_s).round() as usize
    }

    /// A number of the row at a time after the begin; zero before and after all rows.
    fn at(&self, elapsed_ns: i64, number: usize) -> f64 {
        let k = (elapsed_ns as f64 / (1e9 * self.dt_s)).round();
        if k < 0.0 { 0.0 } else { self.values.get(k as usize * self.width + number).copied().unwrap_or(0.0) }
    }
}

/// Place in a row of [`Rows`] of a column of the telemetry.
fn place(table: &str, column: &str, mission: &Mission) -> Option<usize> {
    let readouts = 6 + 6 * mission.test_mass.len();
    let along = |names: [&str; 3], name: &str| names.iter().position(|own| *own == name);
    let of = |name: &str| Some(6 * mission.test_mass.keys().position(|own| own == name)?);
    let parts: Vec<&str> = column.split('.').collect();
    match (table, parts.as_slice()) {
        ("command", ["mps_force_srf_n", axis]) => along(AXES, axis),
        ("command", ["mps_torque_srf_nm", axis]) => Some(3 + along(AXES, axis)?),
        ("command", [name, "force_orf_n", axis]) => Some(6 + of(name)? + along(AXES, axis)?),
        ("command", [name, "torque_orf_nm", axis]) => Some(9 + of(name)? + along(AXES, axis)?),
        ("dws", ["sc_crf_rad", angle]) => Some(readouts + along(ANGLES, angle)?),
        ("is", [name, "r_orf_m", axis]) => Some(readouts + 3 + of(name)? + along(AXES, axis)?),
        ("is", [name, "att_orf_rad", angle]) => Some(readouts + 6 + of(name)? + along(ANGLES, angle)?),
        ("ifo", [name, field]) => Some(readouts + 3 + of(name)? + along(AXES, field.strip_suffix("_orf_m")?)?),
        ("dws", [name, field]) => Some(readouts + 6 + of(name)? + along(ANGLES, field.strip_suffix("_orf_rad")?)?),
        _ => None,
    }
}

/// What a spacecraft at rest shows.
struct Quiet {
    means: Means,
    /// Time of the first row, Unix ns.
    first_ns: i64,
    /// Information per sample that counts for the levels of the noise: that of its covariance on coefficients.
    per_settled: DMatrix<f64>,
}

/// The telemetry at hand as a stage for manoeuvres.
struct Stage<'a> {
    replay: &'a Replay<'a>,
    end: &'a Settled,
    number: usize,
    sources: Sources,
    mission: &'a Mission,
    chosen: Vec<EffectEntry>,
}

impl Stage<'_> {
    /// The spacecraft at rest, for two slots: in the first one filters settle.
    fn quiet(
        &self,
        written: &Written,
        progress: &mut dyn FnMut(Pass, usize, Progress),
    ) -> Result<Quiet, WorkflowError> {
        let rows = Rows::of(self.mission, &[])?;
        let start_ns = written.product.header.non_standard_attributes.start_time_epoch_ns;
        let until_ns = start_ns.saturating_add((2.5e9 * SLOT_S) as i64);
        let (blocks, means) = self.replayed(&rows, None, (start_ns, until_ns), progress)?;
        let nothing = || DMatrix::zeros(self.end.decided.parameters.len(), self.end.decided.parameters.len());
        let per_settled = match blocks.get(1) {
            Some(block) if block.settled > 0.0 => self.beside_nuisances(&block.information) / block.settled,
            _ => nothing(),
        };
        Ok(Quiet { means, first_ns: blocks.first().map_or(start_ns, |block| block.first_ns), per_settled })
    }

    /// Information in rows with these responses from one time on, until another, by slots.
    fn replayed(
        &self,
        rows: &Rows,
        means: Option<&Means>,
        (first_ns, until_ns): (i64, i64),
        progress: &mut dyn FnMut(Pass, usize, Progress),
    ) -> Result<(Vec<InBlock>, Means), WorkflowError> {
        let until_ns = self.sources.until_ns.map_or(until_ns, |own| own.min(until_ns));
        let sources = Sources { until_ns: Some(until_ns), ..self.sources.clone() };
        let held = Held::default();
        let alter = |tables: &[TableSpec], chunk: &mut Chunk| held.alter(tables, chunk, self.mission, (rows, first_ns));
        let experiment =
            Experiment { number: self.number, sources: &sources, altered: Some(&alter), means, block_s: SLOT_S };
        information(self.replay, self.end, &self.chosen, &experiment, progress)
    }

    /// Flies some manoeuvres one after another and keeps the information of each.
    fn fly(
        &self,
        flights: &mut [Flight],
        quiet: &Quiet,
        progress: &mut dyn FnMut(Pass, usize, Progress),
    ) -> Result<(), WorkflowError> {
        let rows = Rows::of(self.mission, flights)?;
        let slots = (flights.len() + 1) as f64;
        let until_ns = quiet.first_ns.saturating_add((1e9 * slots * SLOT_S) as i64);
        let (blocks, _) = self.replayed(&rows, Some(&quiet.means), (quiet.first_ns, until_ns), progress)?;
        for block in blocks {
            let slot = (1e-9 * (block.first_ns - quiet.first_ns) as f64 / SLOT_S).round();
            if slot >= 1.0
                && let Some(flight) = flights.get_mut(slot as usize - 1)
            {
                let without = &quiet.per_settled * block.settled;
                flight.per_second = (self.beside_nuisances(&block.information) - without) / FLOWN_S;
            }
        }
        Ok(())
    }

    /// Information with powers of time fitted, and none of these and of the levels of the noise: a manoeuvre tells
    /// nothing of them, and constants of the series are no part of it.
    fn beside_nuisances(&self, information: &DMatrix<f64>) -> DMatrix<f64> {
        let is = |of: fn(&Meaning) -> bool| -> Vec<usize> {
            let all = self.end.decided.parameters.iter().enumerate();
            all.filter(|(_, (_, meaning))| of(meaning)).map(|(i, _)| i).collect()
        };
        let powers = is(|meaning| matches!(meaning, Meaning::Power));
        let across = information.select_columns(&powers);
        let mut left = information - &across * inverse(&across.select_rows(&powers)) * across.transpose();
        for i in is(|meaning| matches!(meaning, Meaning::Power | Meaning::Level)) {
            left.row_mut(i).fill(0.0);
            left.column_mut(i).fill(0.0);
        }
        left
    }
}

/// Part of a held value by which it goes to and fro: samples that are equal for long count as stuck and are refused.
const TO_AND_FRO: f64 = 1e-9;

/// A column whose value is held.
struct HeldColumn {
    /// Its first value.
    first: f64,
    /// Its place in a row of the response.
    place: Option<usize>,
    /// One or minus one, by turns.
    sign: f64,
}

impl HeldColumn {
    fn next(&mut self, x: f64, response: impl Fn(usize) -> f64) -> f64 {
        if !self.first.is_finite() {
            self.first = x;
        }
        let Some(place) = self.place else { return self.first };
        self.sign = -self.sign;
        self.first * (1.0 + self.sign * TO_AND_FRO) + response(place)
    }
}

/// The columns of each table.
#[derive(Default)]
struct Held(RefCell<Vec<Vec<HeldColumn>>>);

impl Held {
    /// Holds every value at its first one, and adds the response `rows` from a time on.
    fn alter(&self, tables: &[TableSpec], chunk: &mut Chunk, mission: &Mission, (rows, first_ns): (&Rows, i64)) {
        let mut held = self.0.borrow_mut();
        if held.is_empty() {
            let column =
                |table: &str, name: &str| HeldColumn { first: f64::NAN, place: place(table, name, mission), sign: 1.0 };
            let of = |table: &TableSpec| table.columns.iter().map(|c| column(&table.name, &c.name)).collect();
            *held = tables.iter().map(of).collect();
        }
        for (batch, held) in chunk.batches.iter_mut().zip(held.iter_mut()) {
            for (column, held) in batch.columns.iter_mut().zip(held) {
                for (x, time_ns) in column.iter_mut().zip(&batch.time_ns).filter(|(x, _)| x.is_finite()) {
                    *x = held.next(*x, |place| rows.at(time_ns - first_ns, place));
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn amplitudes_are_cut_to_two_digits() {
        for (x, cut) in [(1.0e-5, 1.0e-5), (1.29e-7, 1.2e-7), (9.99e-10, 9.9e-10), (5e-11, 5e-11), (3.0, 3.0)] {
            assert_eq!(two_digits(x), cut);
        }
    }
}
