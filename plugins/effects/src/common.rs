//! Parts shared by several effects: parsing of instance names, responses of test masses and attitude, lookup of
//! housekeeping columns.

use dragfree_physics::mission::{Mission, MissionError};
use dragfree_sdk::prelude::*;

pub(crate) use dragfree_physics::mission::{ANGLES, AXES};

/// Upper band edge of series made from housekeeping, Hz: thermometers and first-order lags pass nothing above it.
pub(crate) const SLOW_HZ: f64 = 0.05;
/// Instances of an effect on every test mass of the mission.
pub(crate) const TEST_MASSES: &[&str] = &["{test_mass}"];
/// Instances of an effect along or about every axis of SRF.
pub(crate) const SC_AXES: &[&str] = &["sc.x", "sc.y", "sc.z"];
/// Instances of an effect on every axis of every test mass.
pub(crate) const TM_AXES: &[&str] = &["{test_mass}.x", "{test_mass}.y", "{test_mass}.z"];
/// Instances of an effect on the axes of every test mass that the inertial sensor reads.
pub(crate) const TM_YZ: &[&str] = &["{test_mass}.y", "{test_mass}.z"];

/// A manifest with this crate's version and licence.
pub(crate) const fn manifest(
    id: &'static str,
    description: &'static str,
    parameters: &'static [Parameter],
    instances: &'static [&'static str],
    needs: &'static [&'static str],
) -> Manifest {
    let (version, licence) = (env!("CARGO_PKG_VERSION"), "MIT OR Apache-2.0");
    Manifest { id, version, licence, description, parameters, instances, needs }
}

/// Index of the axis that ends an instance name: 0 for `sc.x` or `tm1.x`.
pub(crate) fn axis_of(instance: &str) -> usize {
    let letter = instance.rsplit('.').next().unwrap_or_default();
    AXES.iter().position(|axis| *axis == letter).unwrap_or(0)
}

/// Test mass of an instance name: `tm1` for `tm1.x`.
pub(crate) fn tm_of(instance: &str) -> &str {
    instance.split('.').next().unwrap_or_default()
}

/// Acceleration channel of an instance: `tm1.accel.x` for `tm1.x`.
pub(crate) fn accel_channel_of(instance: &str) -> String {
    format!("{}.accel.{}", tm_of(instance), AXES[axis_of(instance)])
}

/// A coefficient in the range ±`max`, of which its prior standard deviation is a third.
pub(crate) fn symmetric(name: String, unit: &str, max: f64) -> Coefficient {
    let (unit, prior_sigma) = (unit.to_owned(), max / 3.0);
    Coefficient { name, unit, lower: -max, upper: max, prior_sigma, ..Coefficient::default() }
}

/// Table and name of a series.
pub(crate) type SeriesRef = (String, String);

/// The response `factor · series` of a channel.
pub(crate) fn response(channel: String, place: &SeriesRef, factor: f64) -> Response {
    Response { channel, table: place.0.clone(), series: place.1.clone(), factor, times: None, in_readout: false }
}

/// Responses of the test masses to a force on the spacecraft along an axis of SRF; `force` is a series in N.
///
/// Free test masses do not follow the spacecraft: `−T_S^{O_i} e/m_S` on `tmN.accel.AXIS`,
/// eq:TM_SC_relative_acceleration.
pub(crate) fn responses_to_spacecraft_force(mission: &Mission, axis: usize, force: &SeriesRef) -> Vec<Response> {
    let each = mission.test_mass.iter().flat_map(|(name, tm)| {
        let column = tm.dcm_orf_from_srf().column(axis) / -mission.spacecraft.mass_kg;
        (0..3).map(move |row| response(format!("{name}.accel.{}", AXES[row]), force, column[row]))
    });
    // Exact zeros of the rotation appear as rounding errors.
    each.filter(|r| r.factor.abs() * mission.spacecraft.mass_kg > 1e-12).collect()
}

/// Keeps the responses of channels that an earlier stage writes.
///
/// # Errors
/// No channel of the responses exists.
pub(crate) fn keep_available(
    available: &Available,
    by: &str,
    mut responses: Vec<Response>,
) -> Result<Vec<Response>, PluginError> {
    let mut wanted: Vec<String> = responses.iter().map(|r| r.channel.clone()).collect();
    responses.retain(|r| available.of_kind("channel").any(|c| c.name == r.channel));
    if responses.is_empty() {
        wanted.sort();
        wanted.dedup();
        return Err(PluginError::error(format!(
            "effect {by} acts on the channels {}, but no earlier stage writes any of them; put a stage that does (hinf-dfacs) before \
             the effects in the pipeline, or remove {by} from the model",
            wanted.join(", ")
        )));
    }
    Ok(responses)
}

/// Whether a column is housekeeping on the common grid.
pub(crate) fn is_housekeeping(column: &Column) -> bool {
    column.table == "grid" && column.name.starts_with("hk.")
}

/// Housekeeping columns with a unit, in telemetry order. Effects select by unit because missions differ in names.
pub(crate) fn housekeeping_in<'a>(available: &'a Available, unit: &'a str) -> impl Iterator<Item = &'a Column> {
    available.columns.iter().filter(move |c| is_housekeeping(c) && c.unit == unit)
}

/// Finds the housekeeping column that a parameter names.
///
/// # Errors
/// No column has that name and unit; the message lists the columns with the unit.
pub(crate) fn find_housekeeping<'a>(
    available: &'a Available,
    by: &str,
    parameter: &str,
    name: &str,
    unit: &str,
) -> Result<&'a Column, PluginError> {
    available.columns.iter().find(|c| c.table == "grid" && c.name == name && c.unit == unit).ok_or_else(|| {
        let all: Vec<&str> = housekeeping_in(available, unit).map(|c| c.name.as_str()).collect();
        let all = if all.is_empty() { "none".to_owned() } else { all.join(", ") };
        let found = if name.is_empty() { "is not set".to_owned() } else { format!("= \"{name}\" does not") };
        PluginError::error(format!(
            "effect {by}: parameter `{parameter}` must name a housekeeping column in {unit} but {found}; columns in {unit}: {all}"
        ))
    })
}

/// Reads the columns `STEM.x`, `STEM.y` and `STEM.z` of a vector in SRF.
///
/// # Errors
/// A column is missing, or has another unit or frame.
pub(crate) fn read_srf_vector(link: &mut EffectLink<'_, '_>, stem: &str, unit: &str) -> Result<[In; 3], PluginError> {
    let [x, y, z] = AXES.map(|axis| link.read(&Want::new(format!("{stem}.{axis}")).unit(unit).frame("SRF")));
    Ok([x?, y?, z?])
}

/// The series that a column is.
pub(crate) fn series_of(column: &Column) -> SeriesRef {
    (column.table.clone(), column.name.clone())
}

/// Parses the mission file.
pub(crate) fn mission(setup: &Setup) -> Result<Mission, MissionError> {
    Mission::from_json(setup.mission_json())
}

/// Number of rows missing between two epochs; 0 for consecutive epochs.
pub(crate) fn skipped_rows(before_ns: i64, now_ns: i64, dt_s: f64) -> u64 {
    let rows = ((now_ns - before_ns) as f64 * 1e-9 / dt_s).round();
    if rows >= 2.0 { rows as u64 - 1 } else { 0 }
}
