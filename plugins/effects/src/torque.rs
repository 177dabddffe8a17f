//! What a torque on the spacecraft does to the channels: to the attitude, and to the test masses through their offsets.

use dragfree_physics::mission::Mission;
use dragfree_sdk::prelude::*;
use nalgebra::{Matrix3, Vector3};

use crate::columns::alpha_is_commanded;
use crate::common::{AXES, SeriesRef, response};

/// Name of a coefficient of a test mass's centre-of-mass offset.
pub(crate) fn offset_name(tm: &str, axis: usize) -> String {
    format!("com-offset.{tm}.{}", AXES[axis])
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
        let offset = offset_name(tm, axis);
        available.coefficient(&offset).filter(|c| !c.candidate)?;
        // (−a × b)_row = ε a_other b_axis, where `other` is the third axis.
        let sign = if (row + 1) % 3 == axis { 1.0 } else { -1.0 };
        Some((row, offset, sign * turn[3 - row - axis]))
    })
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
