//! From the mission file to the noise of the filter's model.

use dragfree_physics::frames::skew;
use dragfree_physics::mission::{Mission, MissionError};
use dragfree_physics::noise::NoiseShape;
use nalgebra::Matrix3;

use crate::model::{Coefficient, Model, Prior};
use crate::shaping::Chain;

/// What the mission file does not say.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Choices {
    /// Prior of the states that are no coefficients.
    pub prior: Prior,
    /// Random walk of the bias acceleration, m s⁻² per √s, on top of the red part of the forces on the test mass.
    pub bias_walk_m_s2_rts: f64,
    /// Below this frequency coloured readout noise is white, Hz.
    pub leak_hz: f64,
    /// Part of the torque noise's variance that α̂ does not know, acting through the nominal offset.
    pub unknown_alpha: f64,
}

/// The model of a test mass.
///
/// Acceleration noise: thrust and sunlight over the spacecraft's mass, the white parts of electrostatic (y, z) and
/// stray forces, and what α̂ does not know: above the band of the wavefront sensors that is the whole torque noise,
/// through the nominal offset. The red (`1/f²`) parts of the forces on the test mass walk with `a_b`.
///
/// # Errors
/// [`MissionError::Missing`] when the mission has no such test mass, no readout noise or no thrust noise.
pub fn model(
    mission: &Mission,
    test_mass: &str,
    coefficients: Vec<Coefficient>,
    choices: &Choices,
) -> Result<Model, MissionError> {
    const STAGE: &str = "es-akf";
    let tm = mission.test_mass(test_mass, STAGE)?;
    let (noise, dt_s) = (&mission.noise, mission.dt_s());
    let x = noise.ifo_x.as_ref().or(noise.is_x.as_ref());
    let readouts = [
        x.ok_or_else(|| MissionError::Missing { section: "noise.ifo_x".to_owned(), needed_by: STAGE })?.shape(),
        Mission::need(&noise.is_y, "noise.is_y", STAGE)?.shape(),
        Mission::need(&noise.is_z, "noise.is_z", STAGE)?.shape(),
    ];
    let thrust = Mission::need(&noise.thruster_force, "noise.thruster_force", STAGE)?.shape();
    let white = |shape: Option<NoiseShape>| shape.map_or(0.0, |s| s.white_psd());
    let electrostatic = noise.electrostatic_force.as_ref().map(|n| n.shape());
    let stray = noise.test_mass_acceleration.as_ref().map(|n| n.shape());
    let sunlight = noise.solar_pressure.as_ref().map(|n| n.shape());
    let torque = noise.thruster_torque.as_ref().map(|n| n.shape());

    // One-sided PSDs in ORF; noise alike on all axes of SRF is so in ORF too.
    let common = (thrust.white_psd() + white(sunlight)) / mission.spacecraft.mass_kg.powi(2) + white(stray.clone());
    let lateral = white(electrostatic.clone()) / tm.mass_kg.powi(2);
    let mut psd = Matrix3::from_diagonal(&[common, common + lateral, common + lateral].into());
    if let Some(inverse) = mission.spacecraft.inertia().try_inverse() {
        let dcm = tm.dcm_orf_from_srf();
        let lever = skew(&tm.offset_nominal_orf_m()) * dcm * inverse;
        psd += lever * lever.transpose() * (white(torque) * choices.unknown_alpha);
    }
    let per_step = 0.5 / dt_s;
    let red = red_walk(electrostatic.as_ref()) / tm.mass_kg.powi(2) + red_walk(stray.as_ref());
    Ok(Model {
        dt_s,
        acceleration_m2_s4: std::array::from_fn(|i| std::array::from_fn(|j| psd[(i, j)] * per_step)),
        bias_step_m2_s4: (choices.bias_walk_m_s2_rts.powi(2) + red) * dt_s,
        readout_m2: std::array::from_fn(|i| readouts[i].white_psd() * per_step),
        chains: readouts.map(|shape| shape.coloured().map(|t| Chain::new(t, choices.leak_hz, dt_s)).collect()),
        coefficients,
        prior: choices.prior,
    })
}

/// Variance per second of the random walk whose one-sided PSD is the `1/f²` part of a shape, unit² s⁻¹.
fn red_walk(shape: Option<&NoiseShape>) -> f64 {
    let terms = shape.into_iter().flat_map(NoiseShape::coloured).filter(|t| t.exponent == 2);
    terms.map(|t| 0.5 * (t.asd * std::f64::consts::TAU * t.corner_hz).powi(2)).sum()
}
