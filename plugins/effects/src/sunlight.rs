//! Sunlight that pushes harder or elsewhere than the mission file says: `solar-pressure`.

use dragfree_physics::mission::Mission;
use dragfree_sdk::prelude::*;
use nalgebra::{Matrix3, Vector3};

use crate::linear::{Linear, Part, Recipe, Series, Source, Term, push, tm_name, turn};

const EXCESS: [f64; 2] = [-0.3, 0.3];
const ARM_M: [f64; 2] = [-0.5, 0.5];

/// `solar-pressure`: sunlight pushes `(1 + f)` times as hard as the mission file says, at an arm that is longer by `δ`.
///
/// With `F = force_n · s` along the unit vector `s` from the Sun: `z_i = −f T_S^{O_i} F/m_S` on the test masses, and on the
/// attitude `J_S⁻¹ (f arm × F + δ × F)`. Coefficients `.force` (1, ±0.3) and `.arm_x`, `.arm_y`, `.arm_z` (m, ±0.5, SRF). Nothing
/// acts through `α̂`: so slow a torque is in the attitude, which the smoother follows there whatever the commands say.
///
/// The Sun stands still in SRF but for some 1e-5 rad a day, so all of it is a constant but for that, and a constant is fitted
/// anyway: an upper limit is the honest answer. Confounders: every constant force, self-gravity above all.
#[derive(Debug)]
pub(crate) struct SolarPressureRecipe;

/// See [`SolarPressureRecipe`].
pub(crate) type SolarPressure = Linear<SolarPressureRecipe>;

impl Recipe for SolarPressureRecipe {
    const MANIFEST: Manifest = Manifest {
        id: "solar-pressure",
        version: env!("CARGO_PKG_VERSION"),
        licence: "MIT OR Apache-2.0",
        description: "Sunlight pushes more or less than the mission file says, or at another place",
        parameters: &[],
        instances: &["sc"],
        needs: &["commands"],
    };

    fn new(_: &Setup) -> Result<Self, PluginError> {
        Ok(Self)
    }

    fn parts(&self, mission: &Mission, _: &Available) -> Result<Vec<Part>, PluginError> {
        let sunlight = Mission::need(&mission.solar_pressure, "solar_pressure", "the effect solar-pressure")?;
        let (inverse, force_n) = (mission.spacecraft.inertia_inverse(), sunlight.force_n);
        let turns = |arm: Vector3<f64>| -> Vec<Term> {
            let per_unit: Matrix3<f64> = inverse * arm.cross_matrix() * force_n;
            let both = (0..3).flat_map(|row| (0..3).map(move |axis| (row, axis)));
            both.map(|(row, axis)| Term::new(turn(row), Series::Column(Source::sun(axis)), per_unit[(row, axis)]))
                .collect()
        };
        let mut force = turns(Vector3::from(sunlight.arm_srf_m));
        for tm in 0..2 {
            let Some(test_mass) = mission.test_mass.get(&tm_name(tm)) else { continue };
            let per_unit = test_mass.dcm_orf_from_srf() * (-force_n / mission.spacecraft.mass_kg);
            for axis in 0..3 {
                force.extend(push(tm, &Series::Column(Source::sun(axis)), &per_unit.column(axis).into()));
            }
        }
        let mut parts = vec![Part::named("force", "1", EXCESS, force)];
        for (name, arm) in [("arm_x", Vector3::x()), ("arm_y", Vector3::y()), ("arm_z", Vector3::z())] {
            parts.push(Part::named(name, "m", ARM_M, turns(arm)));
        }
        Ok(parts)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bench::Bench;

    #[test]
    fn more_light_pushes_and_turns_as_light_does() {
        let bench = Bench { electrodes: false, ..Bench::new() };
        bench.check::<SolarPressureRecipe>(
            "sc",
            "",
            &[
                &|w, excess| w.sunlight += excess,
                &|w, arm| w.arm_srf_m.x += arm,
                &|w, arm| w.arm_srf_m.y += arm,
                &|w, arm| w.arm_srf_m.z += arm,
            ],
        );
    }
}
