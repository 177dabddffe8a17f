//! What the effects of this crate share: names of places, responses of the spacecraft's motion, saved numbers, telemetry
//! columns by unit.

use dragfree_physics::mission::{Mission, MissionError};
use dragfree_sdk::prelude::*;

/// Axes as the columns name them.
pub(crate) const AXES: [&str; 3] = ["x", "y", "z"];
/// What is made of housekeeping and has passed a lag or a slow sensor has nothing above this, Hz.
pub(crate) const SLOW_HZ: f64 = 0.05;
/// Every axis of both test masses.
pub(crate) const TM_AXES: [&str; 6] = ["tm1.x", "tm1.y", "tm1.z", "tm2.x", "tm2.y", "tm2.z"];

/// The constant parts of a manifest filled in.
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

/// Index of the axis at the end of `sc.x` or `tm1.x`.
pub(crate) fn axis_of(instance: &str) -> usize {
    let letter = instance.rsplit('.').next().unwrap_or_default();
    AXES.iter().position(|axis| *axis == letter).unwrap_or(0)
}

/// `tm1` of `tm1.x`.
pub(crate) fn tm_of(instance: &str) -> &str {
    instance.split('.').next().unwrap_or_default()
}

/// `tm1.accel.x` of `tm1.x`.
pub(crate) fn channel_of(instance: &str) -> String {
    format!("{}.accel.{}", tm_of(instance), AXES[axis_of(instance)])
}

/// A series: its table and its name.
pub(crate) type Place = (String, String);

/// `factor` times a series.
pub(crate) fn response(channel: String, place: &Place, factor: f64) -> Response {
    Response { channel, table: place.0.clone(), series: place.1.clone(), factor, times: None }
}

/// What a force on the spacecraft along an axis of SRF, a series in newton, does to the test masses that stay behind:
/// `−T_S^{O_i} e/m_S` on `tmN.accel.x|y|z` (eq:TM_SC_relative_acceleration).
pub(crate) fn behind_spacecraft(mission: &Mission, axis: usize, force: &Place) -> Vec<Response> {
    let each = mission.test_mass.iter().flat_map(|(name, tm)| {
        let column = tm.dcm_orf_from_srf().column(axis) / -mission.spacecraft.mass_kg;
        (0..3).map(move |row| response(format!("{name}.accel.{}", AXES[row]), force, column[row]))
    });
    // Zeros of a rotation about s_3 come out as rounding.
    each.filter(|r| r.factor.abs() * mission.spacecraft.mass_kg > 1e-12).collect()
}

/// What a torque on the spacecraft about an axis of SRF, a series in N m, does to its attitude: `J_S⁻¹ e` on
/// `sc.alpha.x|y|z` (eq:SC_attitude_dynamics).
pub(crate) fn turning(mission: &Mission, axis: usize, torque: &Place) -> Vec<Response> {
    let column = mission.spacecraft.inertia_inverse().column(axis).into_owned();
    (0..3).map(|row| response(format!("sc.alpha.{}", AXES[row]), torque, column[row])).collect()
}

/// The responses on channels that exist.
///
/// # Errors
/// None of the channels exists.
pub(crate) fn on_channels(
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
            "effect {by} acts on {}, and no stage before it makes any of them; put hinf-dfacs, or another stage that does, before \
             the effects, or take {by} out of the model",
            wanted.join(", ")
        )));
    }
    Ok(responses)
}

/// Housekeeping columns of a unit, in the order of the telemetry. Their names say nothing to an effect.
pub(crate) fn housekeeping<'a>(available: &'a Available, unit: &'a str) -> impl Iterator<Item = &'a Column> {
    available.columns.iter().filter(move |c| c.table == "grid" && c.name.starts_with("hk.") && c.unit == unit)
}

/// The housekeeping column that a parameter names.
///
/// # Errors
/// There is none of that name and unit; the sentence lists those of the unit.
pub(crate) fn named<'a>(
    available: &'a Available,
    by: &str,
    parameter: &str,
    name: &str,
    unit: &str,
) -> Result<&'a Column, PluginError> {
    available.columns.iter().find(|c| c.table == "grid" && c.name == name && c.unit == unit).ok_or_else(|| {
        let all: Vec<&str> = housekeeping(available, unit).map(|c| c.name.as_str()).collect();
        let all = if all.is_empty() { "none in this telemetry".to_owned() } else { all.join(", ") };
        let found = if name.is_empty() { "is not given".to_owned() } else { format!("= \"{name}\" is none of them") };
        PluginError::error(format!(
            "effect {by}: its parameter `{parameter}` must name a telemetry column in {unit}, and {found}; there are: {all}"
        ))
    })
}

/// A column by table and name.
pub(crate) fn place(column: &Column) -> Place {
    (column.table.clone(), column.name.clone())
}

/// The mission, with the sentence of an effect that cannot do without it.
pub(crate) fn mission(setup: &Setup) -> Result<Mission, MissionError> {
    Mission::from_json(setup.mission_json())
}

/// The number of rows left out between two epochs; 0 between neighbours.
pub(crate) fn rows_between(before_ns: i64, now_ns: i64, dt_s: f64) -> u64 {
    let rows = ((now_ns - before_ns) as f64 * 1e-9 / dt_s).round();
    if rows >= 2.0 { rows as u64 - 1 } else { 0 }
}

/// Numbers as bytes behind a mark that says whose they are.
pub(crate) fn saved(mark: &[u8; 8], numbers: impl IntoIterator<Item = f64>) -> Vec<u8> {
    let mut bytes = mark.to_vec();
    bytes.extend(numbers.into_iter().flat_map(f64::to_le_bytes));
    bytes
}

/// Takes back `count` numbers of [`saved`].
///
/// # Errors
/// The bytes are something else.
pub(crate) fn loaded(mark: &[u8; 8], by: &str, count: usize, bytes: &[u8]) -> Result<Vec<f64>, PluginError> {
    let (words, rest) = bytes.strip_prefix(mark).unwrap_or(&[0]).as_chunks::<8>();
    if !rest.is_empty() || words.len() != count {
        return Err(PluginError::error(format!(
            "effect {by}: {} bytes are not its state of {count} numbers; it was saved by another version or for another model, so \
             start from the telemetry",
            bytes.len()
        )));
    }
    Ok(words.iter().map(|word| f64::from_le_bytes(*word)).collect())
}
