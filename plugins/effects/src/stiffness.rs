//! Forces that depend on displacement and angle of a test mass: `stiffness`, `cross-stiffness`.
//!
//! The regressor is a readout, held over missing values. The channel's sample at `t_k` contains readouts up to
//! `t_{k+1}` and the regressor only those up to `t_k`, so readout noise in the regressor does not bias a fit over the
//! whole band. The displacement's change within a sample is neglected. Both are usually below detection; the result is
//! an upper limit.

use dragfree_physics::mission::Mission;
use dragfree_sdk::prelude::*;

use crate::common::{ANGLES, TM_AXES, axis_of, manifest};
use crate::linear::{Body, CoefficientForms, InputColumn, LinearEffect, Series, Term, accel_channel};

const STIFFNESS_S2: [f64; 2] = [-1e-5, 1e-5];
const CROSS_M_S2_RAD: [f64; 2] = [-1e-6, 1e-6];

/// `stiffness`: an error of a diagonal element of `S_TT`, ORF.
///
/// `z = ΔS r` with the measured displacement; ΔS: s⁻², ±1e-5, positive if the force points away from the centre. The
/// mission file's stiffness is part of `û` (eq:TM_SC_relative_acceleration, `F_st`). Confounders: gains of the
/// actuators that hold the test mass.
pub(crate) enum Stiffness {}

impl LinearEffect for Stiffness {
    const MANIFEST: Manifest = manifest(
        "stiffness",
        "Force gradient of a test mass along an axis beyond the mission file's",
        &[],
        TM_AXES,
        &[],
    );

    fn coefficients(setup: &Setup, mission: &Mission, _: &Available) -> Result<Vec<CoefficientForms>, PluginError> {
        let (tm, axis) = (&Body::of(mission, setup.instance(), "the effect stiffness")?, axis_of(setup.instance()));
        let terms = vec![Term::new(accel_channel(tm, axis), Series::Held(InputColumn::displacement(tm, axis)), 1.0)];
        Ok(CoefficientForms::only("s-2", STIFFNESS_S2, terms))
    }
}

/// `cross-stiffness`: an error of a diagonal element of `S_TR`, ORF.
///
/// `z = ΔS θ` with the measured angle about the axis: local wavefront sensing for `θ` and `ψ`, the inertial sensor for
/// `φ`. ΔS: m s⁻² rad⁻¹, ±1e-6. The corresponding torque, `J_m S_RT = m S_TRᵀ`, is in no channel.
pub(crate) enum CrossStiffness {}

impl LinearEffect for CrossStiffness {
    const MANIFEST: Manifest =
        manifest("cross-stiffness", "Force on a test mass per angle beyond the mission file's", &[], TM_AXES, &[]);

    fn coefficients(
        setup: &Setup,
        mission: &Mission,
        available: &Available,
    ) -> Result<Vec<CoefficientForms>, PluginError> {
        let (tm, axis) =
            (&Body::of(mission, setup.instance(), "the effect cross-stiffness")?, axis_of(setup.instance()));
        let local = InputColumn::angle_by_dws(tm, ANGLES[axis]);
        let angle =
            if available.find(&local.name).is_some() { local } else { InputColumn::angle_by_is(tm, ANGLES[axis]) };
        Ok(CoefficientForms::only(
            "m s-2 rad-1",
            CROSS_M_S2_RAD,
            vec![Term::new(accel_channel(tm, axis), Series::Held(angle), 1.0)],
        ))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::common::AXES;
    use crate::test_spacecraft::{TestSpacecraft, setup};
    use nalgebra::Vector3;

    #[test]
    fn stiffness_terms_match_the_derivative() {
        for (tm, axis) in [(0, 0), (0, 1), (1, 2)] {
            let r_orf_m = [Vector3::new(0.4, -0.3, 0.2), Vector3::new(-0.2, 0.5, 0.6)];
            let angle_orf_rad = [Vector3::new(0.3, 0.7, -0.2), Vector3::new(0.1, -0.4, 0.5)];
            let test_spacecraft = TestSpacecraft { r_orf_m, angle_orf_rad, ..TestSpacecraft::new() };
            let instance = format!("tm{}.{}", tm + 1, AXES[axis]);
            test_spacecraft.assert_matches_derivative::<Stiffness>(
                &instance,
                "",
                &[&|w, s| w.stiffness_s2[tm][(axis, axis)] += s],
            );
            test_spacecraft.assert_matches_derivative::<CrossStiffness>(
                &instance,
                "",
                &[&|w, s| w.cross_stiffness_m_s2_rad[tm][(axis, axis)] += s],
            );
        }
    }

    #[test]
    fn wavefront_sensing_is_preferred_for_angles() {
        let test_spacecraft = TestSpacecraft::new();
        let mut available = test_spacecraft.available();
        let name = |available: &Available| {
            let coefficients =
                CrossStiffness::coefficients(&setup("tm2.z", ""), &test_spacecraft.mission, available).unwrap();
            coefficients[0].forms[0].terms[0].series.name()
        };
        assert_eq!(name(&available), "held(is.tm2.att_orf_rad.psi)");
        available.columns.push(Column { name: "dws.tm2.psi_orf_rad".to_owned(), ..Column::default() });
        assert_eq!(name(&available), "held(dws.tm2.psi_orf_rad)");
    }
}
