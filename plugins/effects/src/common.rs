//! Parts shared by several effects: parsing of instance names, responses of test masses and attitude, lookup of
//! housekeeping columns.

use dragfree_physics::mission::{Mission, MissionError};
use dragfree_sdk::prelude::*;
use nalgebra::{Matrix3, Vector3};

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
    Response { channel, table: place.0.clone(), series: place.1.clone(), factor, times: None }
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

/// Responses to a torque on the spacecraft about an axis of SRF; `torque` is a series in N m.
///
/// `J_S⁻¹ e` on `sc.alpha.x|y|z` (eq:SC_attitude_dynamics). The test masses show it through their offsets by way of
/// `α̂`; in prediction mode, where `α̂` is what is commanded, by responses of their own.
pub(crate) fn responses_to_spacecraft_torque(
    available: &Available,
    mission: &Mission,
    axis: usize,
    torque: &SeriesRef,
) -> Vec<Response> {
    let alpha = mission.spacecraft.inertia_inverse().column(axis).into_owned();
    let mut all: Vec<Response> =
        (0..3).map(|row| response(format!("sc.alpha.{}", AXES[row]), torque, alpha[row])).collect();
    if alpha_is_commanded(available) {
        for (name, tm) in &mission.test_mass {
            all.extend(through_offset(available, name, &tm.dcm_orf_from_srf(), &alpha).map(|(row, times, factor)| {
                let channel = format!("{name}.accel.{}", AXES[row]);
                Response { times: Some(times), ..response(channel, torque, factor) }
            }));
        }
    }
    all
}

/// Whether `α̂` is what is commanded, as in prediction mode, and lacks what anything else does to the attitude.
pub(crate) fn alpha_is_commanded(available: &Available) -> bool {
    AXES.iter().all(|axis| {
        let name = format!("sc.alpha_srf_rad_s2.{axis}");
        let column = available.columns.iter().rev().find(|c| c.name == name);
        column.is_some_and(|c| !c.attribute(UNPREDICTED_ATTRIBUTE).is_empty())
    })
}

/// `−[T δα ×] b` of a test mass for an angular acceleration `δα`, SRF, beyond `α̂`: row in ORF, name of the coefficient
/// that is a component of b, and the factor of their product. Empty without `com-offset` earlier in the model.
pub(crate) fn through_offset<'a>(
    available: &'a Available,
    tm: &'a str,
    dcm_orf_from_srf: &Matrix3<f64>,
    alpha_srf: &Vector3<f64>,
) -> impl Iterator<Item = (usize, String, f64)> + use<'a> {
    let turn = dcm_orf_from_srf * alpha_srf;
    let pairs = (0..3).flat_map(|row| (0..3).map(move |axis| (row, axis))).filter(|(row, axis)| row != axis);
    pairs.filter_map(move |(row, axis)| {
        let offset = format!("com-offset.{tm}.{}", AXES[axis]);
        available.coefficient(&offset).filter(|c| !c.candidate)?;
        // (−a × b)_row = ε a_other b_axis, where `other` is the third axis.
        let sign = if (row + 1) % 3 == axis { 1.0 } else { -1.0 };
        Some((row, offset, sign * turn[3 - row - axis]))
    })
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::test_spacecraft::TestSpacecraft;

    /// A torque acts on a test mass by `−(T J⁻¹ τ) × b`: once, through `α̂` or by responses of its own.
    #[test]
    fn a_torque_acts_on_the_test_masses_once() {
        let [smoothed, predicting] =
            [false, true].map(|prediction| TestSpacecraft { prediction, ..TestSpacecraft::new() });
        let mission = &smoothed.mission;
        let offsets = [("x", 0.09), ("y", -0.155), ("z", 0.02)];
        let b = Vector3::new(0.09, -0.155, 0.02);
        for axis in 0..3 {
            let on_tm1 = |available: &Available| -> Vector3<f64> {
                let mut all = responses_to_spacecraft_torque(available, mission, axis, &SeriesRef::default());
                all.retain(|r| r.channel.starts_with("tm1."));
                let mut sum = Vector3::zeros();
                for r in &all {
                    let times = r.times.as_deref().expect("a product with the offset");
                    let (_, of) = offsets.iter().find(|(axis, _)| times.ends_with(axis)).expect("a component");
                    sum[AXES.iter().position(|axis| r.channel.ends_with(axis)).expect("an axis")] += r.factor * of;
                }
                sum
            };
            let tm = mission.test_mass("tm1", "the test").expect("a test mass");
            let alpha = mission.spacecraft.inertia_inverse().column(axis).into_owned();
            let expected = (tm.dcm_orf_from_srf() * alpha).cross(&b) * -1.0;
            assert!((on_tm1(&predicting.available()) - expected).norm() < 1e-12 * expected.norm());
            assert!(on_tm1(&smoothed.available()).norm() == 0.0, "it would act twice");
        }
    }
}
