//! Solar radiation pressure that differs from the mission file: `solar-pressure`.

use dragfree_physics::mission::Mission;
use dragfree_sdk::prelude::*;
use nalgebra::{Matrix3, Vector3};

use crate::columns::alpha_is_commanded;
use crate::common::manifest;
use crate::linear::{
    Body, CoefficientForms, InputColumn, LinearEffect, Series, Term, accel_channel, attitude_channel, vector_terms,
};
use crate::torque::through_offset;

const EXCESS: [f64; 2] = [-0.3, 0.3];
const ARM_M: [f64; 2] = [-0.5, 0.5];

/// `solar-pressure`: the solar force is `(1 + f)` times the mission file's and its lever arm differs by `δ`.
///
/// With `F = force_n · s` along the unit vector `s` from the Sun: `z_i = −f T_S^{O_i} F/m_S` on the test masses and
/// `J_S⁻¹ (f arm × F + δ × F)` on the attitude. Coefficients `.force` (1, ±0.3) and `.arm_x`, `.arm_y`, `.arm_z` (m,
/// ±0.5, SRF). No term acts through `α̂`: the smoother takes so slow a torque from the attitude, whatever the commands.
/// In prediction mode, where `α̂` is what is commanded, the torque acts on the test masses through their offsets.
///
/// In science mode the Sun is almost fixed in SRF, so the response is nearly constant and the result is an upper limit.
/// Confounders: every constant force, self-gravity above all.
pub(crate) enum SolarPressure {}

impl LinearEffect for SolarPressure {
    const MANIFEST: Manifest = manifest(
        "solar-pressure",
        "Solar radiation force or its lever arm differ from the mission file",
        &[],
        &["sc"],
        &["commands"],
    );

    fn coefficients(_: &Setup, mission: &Mission, available: &Available) -> Result<Vec<CoefficientForms>, PluginError> {
        let pressure = Mission::need(&mission.solar_pressure, "solar_pressure", "the effect solar-pressure")?;
        let (inverse, force_n) = (mission.spacecraft.inertia_inverse(), pressure.force_n);
        let torque_terms = |arm: Vector3<f64>| -> Vec<Term> {
            let per_unit: Matrix3<f64> = inverse * arm.cross_matrix() * force_n;
            let sun = |axis| Series::Column(InputColumn::sun(axis));
            let both = (0..3).flat_map(|row| (0..3).map(move |axis| (row, axis)));
            let mut terms: Vec<Term> =
                both.map(|(row, axis)| Term::new(attitude_channel(row), sun(axis), per_unit[(row, axis)])).collect();
            let bodies = if alpha_is_commanded(available) { Body::all(mission) } else { Vec::new() };
            for (tm, axis) in bodies.iter().flat_map(|tm| (0..3).map(move |axis| (tm, axis))) {
                let alpha = per_unit.column(axis).into_owned();
                let coupled = through_offset(available, &tm.name, &tm.section.dcm_orf_from_srf(), &alpha);
                terms.extend(coupled.map(|(row, times, factor)| Term {
                    times: Some(times),
                    ..Term::new(accel_channel(tm, row), sun(axis), factor)
                }));
            }
            terms
        };
        let mut force = torque_terms(Vector3::from(pressure.arm_srf_m));
        for tm in &Body::all(mission) {
            let per_unit = tm.section.dcm_orf_from_srf() * (-force_n / mission.spacecraft.mass_kg);
            for axis in 0..3 {
                force.extend(vector_terms(tm, &Series::Column(InputColumn::sun(axis)), &per_unit.column(axis).into()));
            }
        }
        let mut coefficients = vec![CoefficientForms::named("force", "1", EXCESS, force)];
        for (name, arm) in [("arm_x", Vector3::x()), ("arm_y", Vector3::y()), ("arm_z", Vector3::z())] {
            coefficients.push(CoefficientForms::named(name, "m", ARM_M, torque_terms(arm)));
        }
        Ok(coefficients)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::test_spacecraft::TestSpacecraft;

    /// By `α̂` of the smoother, and in prediction mode through the offsets.
    #[test]
    fn solar_pressure_matches_the_derivative() {
        for prediction in [false, true] {
            let test_spacecraft = TestSpacecraft { electrodes_active: false, prediction, ..TestSpacecraft::new() };
            test_spacecraft.assert_matches_derivative::<SolarPressure>(
                "sc",
                "",
                &[
                    &|w, excess| w.solar_force_gain += excess,
                    &|w, arm| w.arm_srf_m.x += arm,
                    &|w, arm| w.arm_srf_m.y += arm,
                    &|w, arm| w.arm_srf_m.z += arm,
                ],
            );
        }
    }
}
