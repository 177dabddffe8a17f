//! Actuators whose output differs from the command: `es-gain`, `es-crosstalk`, `mps-gain`, `mps-tilt`, `torque-gain`.
//!
//! Regressors are the commands (columns `used.*`, mean over the sample, with the mission's lag and delay). Feedback
//! makes the commands depend on past readout noise only, so a least-squares fit is unbiased over the whole band up to
//! Nyquist but biased over part of it; Methods, "Regressors inside the control loop".
//!
//! **Confounders.** Feedback mirrors every slow unmodelled force in the command, so a gain near −1 fits such a force;
//! the hard ranges exclude this. `mps-gain` and `mps-tilt` of different axes share their series. `torque-gain` is
//! equivalent to an error of the inertia; part of it, acting through the offset, is collinear with the offset across
//! the axis.

use dragfree_physics::mission::Mission;
use dragfree_sdk::prelude::*;
use nalgebra::{Matrix3, Vector3};

use crate::common::{SC_AXES, TM_YZ, axis_of, manifest};
use crate::linear::{
    Body, CoefficientForms, InputColumn, LinearEffect, Series, Term, accel_channel, attitude_channel, axis_pair,
    offset_coupling_terms, vector_terms,
};

const GAIN: [f64; 2] = [-0.3, 0.3];
const CROSSTALK: [f64; 2] = [-0.1, 0.1];
const TILT_RAD: [f64; 2] = [-0.1, 0.1];
const TORQUE_GAIN: [f64; 2] = [-0.15, 0.15];

/// Unit vector along an axis.
fn unit_vector(axis: usize) -> Vector3<f64> {
    Vector3::from_fn(|i, _| f64::from(i == axis))
}

/// Terms of an electrode force along axis `from` that acts along `to`: `F_E/m_m` on the test mass plus the spacecraft's
/// recoil `F_E/m_S` (`û_i` of Section IV). The recoil in the other test mass's channels is far below thruster noise and
/// omitted.
fn electrode_terms(
    mission: &Mission,
    by: &'static str,
    instance: &str,
    (from, to): (usize, usize),
) -> Result<Vec<Term>, PluginError> {
    let tm = &Body::of(mission, instance, by)?;
    let per_newton = 1.0 / tm.section.mass_kg + 1.0 / mission.spacecraft.mass_kg;
    Ok(vec![Term::new(accel_channel(tm, to), Series::Column(InputColumn::electrodes_force(tm, from)), per_newton)])
}

/// `es-gain`: electrodes apply `(1 + g) F_E` where `F_E` is commanded along an axis of ORF.
///
/// `z = g F_E (1/m_m + 1/m_S)`; g: 1, ±0.3. The change of the recoil torque `b × g F_E` is negligible and followed by
/// `α̂`. LISA Pathfinder calibrated such gains to per cents (Armano et al., Phys. Rev. D 97, 122002).
pub(crate) enum EsGain {}

impl LinearEffect for EsGain {
    const MANIFEST: Manifest =
        manifest("es-gain", "Gain of the electrodes' force along an axis differs from one", &[], TM_YZ, &["commands"]);

    fn coefficients(setup: &Setup, mission: &Mission, _: &Available) -> Result<Vec<CoefficientForms>, PluginError> {
        let (instance, axis) = (setup.instance(), axis_of(setup.instance()));
        let terms = electrode_terms(mission, "the effect es-gain", instance, (axis, axis))?;
        Ok(CoefficientForms::only("1", GAIN, terms))
    }
}

/// `es-crosstalk`: in instance `tm2.y-x`, `δ` times the force commanded along y also acts along x.
///
/// `z_to = δ F_E,from (1/m_m + 1/m_S)`; δ: 1, ±0.1.
pub(crate) enum EsCrosstalk {}

impl LinearEffect for EsCrosstalk {
    const MANIFEST: Manifest = manifest(
        "es-crosstalk",
        "Part of the force commanded along one axis also acts along another",
        &[],
        &["{test_mass}.y-x", "{test_mass}.y-z", "{test_mass}.z-x", "{test_mass}.z-y"],
        &["commands"],
    );

    fn coefficients(setup: &Setup, mission: &Mission, _: &Available) -> Result<Vec<CoefficientForms>, PluginError> {
        let terms = electrode_terms(mission, "the effect es-crosstalk", setup.instance(), axis_pair(setup.instance()))?;
        Ok(CoefficientForms::only("1", CROSSTALK, terms))
    }
}

/// Terms of an additional thruster force `matrix · F_T`: `z_i = −T_S^{O_i} matrix F_T/m_S` on all test masses.
fn thrust_terms(mission: &Mission, matrix: &Matrix3<f64>) -> Vec<Term> {
    let mut terms = Vec::new();
    for tm in &Body::all(mission) {
        let per_newton = tm.section.dcm_orf_from_srf() * matrix / -mission.spacecraft.mass_kg;
        for (from, column) in per_newton.column_iter().enumerate() {
            terms.extend(vector_terms(tm, &Series::Column(InputColumn::thrust(from)), &column.into()));
        }
    }
    terms.retain(|term| term.factor.abs() > 1e-12 / mission.spacecraft.mass_kg);
    terms
}

/// `mps-gain`: thrusters apply `(1 + g) F_T` where `F_T` is commanded along an axis of SRF.
///
/// `z_i = −g T_S^{O_i} e F_T,e/m_S`; g: 1, ±0.3. `α̂` does not depend on forces, so no term acts through it.
pub(crate) enum MpsGain {}

impl LinearEffect for MpsGain {
    const MANIFEST: Manifest = manifest(
        "mps-gain",
        "Gain of the thrusters' force along an axis differs from one",
        &[],
        SC_AXES,
        &["commands"],
    );

    fn coefficients(setup: &Setup, mission: &Mission, _: &Available) -> Result<Vec<CoefficientForms>, PluginError> {
        let axis = unit_vector(axis_of(setup.instance()));
        Ok(CoefficientForms::only("1", GAIN, thrust_terms(mission, &(axis * axis.transpose()))))
    }
}

/// `mps-tilt`: the thrusters' frame is rotated by `θ` about an axis `e` of SRF, so `F_T` acts as `F_T + θ e × F_T`.
///
/// `z_i = −θ T_S^{O_i} (e × F_T)/m_S`; θ: rad, ±0.1.
pub(crate) enum MpsTilt {}

impl LinearEffect for MpsTilt {
    const MANIFEST: Manifest =
        manifest("mps-tilt", "The thrusters' frame is rotated about an axis", &[], SC_AXES, &["commands"]);

    fn coefficients(setup: &Setup, mission: &Mission, _: &Available) -> Result<Vec<CoefficientForms>, PluginError> {
        let axis = unit_vector(axis_of(setup.instance()));
        Ok(CoefficientForms::only("rad", TILT_RAD, thrust_terms(mission, &axis.cross_matrix())))
    }
}

/// `torque-gain`: thrusters apply `(1 + g) M_T` where `M_T` is commanded about an axis of SRF; g: 1, ±0.15.
///
/// * Attitude: `g J_S⁻¹ e M_T,e` (eq:SC_attitude_dynamics).
/// * Test masses, through the estimate of the angular acceleration: `−g [T ∂α̂/∂g ×] b`
///   (eq:TM_SC_relative_acceleration), a product with the model's offset.
/// * Test masses, for thrusters with a layout: `g ∂û/∂g`, because `û` contains the force correlated with the estimated
///   torque noise, which depends on g.
pub(crate) enum TorqueGain {}

impl LinearEffect for TorqueGain {
    const MANIFEST: Manifest = manifest(
        "torque-gain",
        "Gain of the thrusters' torque about an axis differs from one, or the inertia does",
        &[],
        SC_AXES,
        &["commands", "torque-response"],
    );

    fn coefficients(
        setup: &Setup,
        mission: &Mission,
        available: &Available,
    ) -> Result<Vec<CoefficientForms>, PluginError> {
        let axis = axis_of(setup.instance());
        let inverse = mission.spacecraft.inertia_inverse();
        let torque = Series::Column(InputColumn::torque(axis));
        let mut terms: Vec<Term> =
            (0..3).map(|j| Term::new(attitude_channel(j), torque.clone(), inverse[(j, axis)])).collect();
        let response = |j| Series::Column(InputColumn::alpha_by_torque_gain(axis, j));
        terms.extend(offset_coupling_terms(available, mission, "the effect torque-gain", response, 1.0)?);
        let bodies = Body::all(mission);
        for (tm, row) in bodies.iter().flat_map(|tm| (0..3).map(move |row| (tm, row))) {
            let source = InputColumn::known_accel_by_torque_gain(axis, tm, row);
            if available.find(&source.name).is_some() {
                terms.push(Term::new(accel_channel(tm, row), Series::Column(source), 1.0));
            }
        }
        Ok(CoefficientForms::only("1", TORQUE_GAIN, terms))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::common::AXES;
    use crate::test_spacecraft::{Deviations, TestSpacecraft, setup};

    #[test]
    fn es_gain_matches_the_derivative() {
        for (tm, axis) in [(0, 1), (0, 2), (1, 1), (1, 2)] {
            let instance = format!("tm{}.{}", tm + 1, AXES[axis]);
            TestSpacecraft::new().assert_matches_derivative::<EsGain>(
                &instance,
                "",
                &[&|w, g| w.electrode_gain[tm][(axis, axis)] += g],
            );
        }
    }

    #[test]
    fn es_crosstalk_matches_the_derivative() {
        for (tm, from, to) in [(0, 1, 0), (0, 1, 2), (0, 2, 0), (1, 2, 1)] {
            let instance = format!("tm{}.{}-{}", tm + 1, AXES[from], AXES[to]);
            TestSpacecraft::new().assert_matches_derivative::<EsCrosstalk>(
                &instance,
                "",
                &[&|w, d| w.electrode_gain[tm][(to, from)] += d],
            );
        }
    }

    #[test]
    fn mps_gain_matches_the_derivative() {
        for axis in 0..3 {
            let instance = format!("sc.{}", AXES[axis]);
            TestSpacecraft::new().assert_matches_derivative::<MpsGain>(
                &instance,
                "",
                &[&|w, g| w.thrust_gain[(axis, axis)] += g],
            );
        }
    }

    #[test]
    fn mps_tilt_matches_the_derivative() {
        for axis in 0..3 {
            // Exact rotation, of which the effect declares the first order.
            let tilt = move |w: &mut Deviations, angle: f64| {
                w.thrust_gain = *nalgebra::Rotation3::new(unit_vector(axis) * angle).matrix();
            };
            TestSpacecraft::new().assert_matches_derivative::<MpsTilt>(&format!("sc.{}", AXES[axis]), "", &[&tilt]);
        }
    }

    /// A smoother with a different gain about each axis.
    #[test]
    fn torque_gain_matches_the_derivative() {
        for (axis, thruster_layout) in [(0, false), (1, false), (2, false), (0, true), (1, true), (2, true)] {
            let smoother_gain = Matrix3::new(0.7, 0.1, -0.2, 0.1, 0.4, 0.05, -0.1, 0.2, 0.9);
            let test_spacecraft = TestSpacecraft { smoother_gain, thruster_layout, ..TestSpacecraft::new() };
            let instance = format!("sc.{}", AXES[axis]);
            test_spacecraft.assert_matches_derivative::<TorqueGain>(
                &instance,
                "",
                &[&|w, g| w.torque_gain[(axis, axis)] += g],
            );
        }
    }

    #[test]
    fn torque_gain_acts_on_the_attitude_alone_without_an_offset_in_the_model() {
        let test_spacecraft = TestSpacecraft::new();
        let mut available = test_spacecraft.available();
        let coefficients = TorqueGain::coefficients(&setup("sc.y", ""), &test_spacecraft.mission, &available).unwrap();
        assert!(coefficients[0].forms[0].terms.iter().any(|t| t.times.as_deref() == Some("com-offset.tm2.z")));
        // The coefficient of a candidate has no value.
        available.coefficients.iter_mut().for_each(|c| c.candidate = true);
        let coefficients = TorqueGain::coefficients(&setup("sc.y", ""), &test_spacecraft.mission, &available).unwrap();
        assert!(coefficients[0].forms[0].terms.iter().all(|t| t.channel.starts_with("sc.alpha") && t.times.is_none()));
        assert_eq!(coefficients[0].forms[0].terms.len(), 3);
    }
}
