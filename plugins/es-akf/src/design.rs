//! From the mission file to the noise of the filter's model.

use dragfree_physics::frames::skew;
use dragfree_physics::mission::{DisplacementNoise, Mission, MissionError, Noise};
use dragfree_physics::noise::NoiseShape;
use dragfree_physics::thrust_noise::ThrustNoise;
use dragfree_sdk::NoiseLevels;
use nalgebra::{DMatrix, Matrix3};

use crate::model::{Coefficient, Model, Prior};
use crate::shaping::{Chain, TorqueNoiseShaping};

const STAGE: &str = "es-akf";

const AXES: [&str; 3] = ["x", "y", "z"];

/// What the mission file does not say.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Choices {
    /// Prior of the states that are no coefficients.
    pub prior: Prior,
    /// Random walk of the bias acceleration, m s⁻² per √s, on top of the red part of the forces on the test mass.
    pub bias_walk_m_s2_rts: f64,
    /// Below this frequency coloured readout noise is white, Hz.
    pub leak_hz: f64,
    /// Fraction of the torque noise's variance that α̂ does not know; it acts through the nominal offset.
    pub unknown_alpha: f64,
}

/// The model of one test mass, or of several in one filter.
///
/// Acceleration noise is a sum: thrust and sunlight over the spacecraft's mass, common to all test masses; the white
/// parts of electrostatic (y, z) and stray forces on each; and the error of α̂ through the nominal offset. Where a
/// thruster pushes and turns at once, û contains the expected force given the known torque. Then the force conditional
/// on the torque remains, and an unknown torque carries its force. The red (`1/f²`) parts of the forces on the test
/// mass drive the random walk of `a_b`.
///
/// The error of α̂ is the torque noise above the band of the wavefront sensors. For one test mass it is white: where
/// its spectrum matters, the force noise of the thrusters exceeds it. The difference of two test masses does not
/// contain that force, so that several test masses have it as a [`TorqueNoiseShaping`], which is known below the
/// frequency at which torque noise turns the spacecraft by as much as the sensors' noise.
///
/// `readouts` names the tables under `[noise]` that belong to the readouts x, y, z of each test mass, `levels` the
/// amplitudes of components of noise over the mission file's.
///
/// # Errors
/// [`MissionError::Missing`] when the mission has no such test mass, no readout noise or no thrust noise.
///
/// # Panics
/// When there are not three readouts for each test mass.
pub fn model(
    mission: &Mission,
    test_masses: &[&str],
    readouts: &[&str],
    coefficients: Vec<Coefficient>,
    choices: &Choices,
    levels: &NoiseLevels,
) -> Result<Model, MissionError> {
    let axes = 3 * test_masses.len();
    assert_eq!(axes, readouts.len(), "readouts of {test_masses:?}");
    let (noise, dt_s) = (&mission.noise, mission.dt_s());
    let tms = test_masses.iter().map(|name| mission.test_mass(name, STAGE)).collect::<Result<Vec<_>, _>>()?;
    // Of an axis of a test mass, over the mission file's.
    let level = |process: &str, axis: usize| {
        levels.amplitude(&format!("{process}:{}.{}", test_masses[axis / 3], AXES[axis % 3]))
    };
    let mut shapes = readouts.iter().map(|name| readout_noise(noise, name)).collect::<Result<Vec<_>, _>>()?;
    for (axis, shape) in shapes.iter_mut().enumerate() {
        shape.terms.iter_mut().for_each(|term| term.asd *= level("readout", axis));
    }
    let mut thrust = ThrustNoise::of(mission).filter(|t| !t.force_shape.terms.is_empty());
    if let Some(thrust) = &mut thrust {
        let amplitudes = |process: &str| {
            let of = |axis| levels.amplitude(&format!("{process}:sc.{axis}"));
            Matrix3::from_diagonal(&AXES.map(of).into())
        };
        let (force, torque) = (amplitudes("thruster_force"), amplitudes("thruster_torque"));
        thrust.force_given_torque = force * thrust.force_given_torque * force;
        thrust.torque = torque * thrust.torque * torque;
    }
    let thrust = Mission::need(&thrust, "noise.thruster_force", STAGE)?;
    let white = |shape: Option<NoiseShape>| shape.map_or(0.0, |s| s.white_psd());
    let electrostatic = noise.electrostatic_force.as_ref().map(|n| n.shape());
    let stray = noise.test_mass_acceleration.as_ref().map(|n| n.shape());
    let sunlight = noise.solar_pressure.as_ref().map(|n| n.shape());

    // One-sided PSDs in ORF, the test masses below each other: what a force on the spacecraft does to each, and a
    // torque on it, −α × b − F/m.
    let mass_kg = mission.spacecraft.mass_kg;
    let inverse = mission.spacecraft.inertia().try_inverse().unwrap_or_else(Matrix3::zeros);
    let mut pushed = DMatrix::zeros(axes, 3);
    let mut turned = DMatrix::zeros(axes, 3);
    let mut psd = DMatrix::zeros(axes, axes);
    for (t, tm) in tms.iter().enumerate() {
        let dcm = tm.dcm_orf_from_srf();
        let lever = skew(&tm.offset_nominal_orf_m()) * dcm * inverse - dcm * thrust.force_per_torque / mass_kg;
        pushed.fixed_view_mut::<3, 3>(3 * t, 0).copy_from(&dcm);
        turned.fixed_view_mut::<3, 3>(3 * t, 0).copy_from(&lever);
        for axis in 0..3 {
            let row = 3 * t + axis;
            let electrodes =
                if tm.is_drag_free(axis) { 0.0 } else { white(electrostatic.clone()) / tm.mass_kg.powi(2) };
            psd[(row, row)] = white(stray.clone()) * level("test_mass_acceleration", row).powi(2)
                + electrodes * level("electrostatic_force", row).powi(2);
        }
    }
    let left = thrust.force_given_torque * thrust.force_shape.white_psd() + Matrix3::identity() * white(sunlight);
    psd += &pushed * (left / mass_kg.powi(2)) * pushed.transpose();
    let per_step = 0.5 / dt_s;
    let unknown = thrust.torque_shape.white_psd() * choices.unknown_alpha;
    let mut torque_noise = Vec::new();
    let sensing = noise.dws_long_arm.as_ref().map(|n| n.shape().white_psd()).filter(|_| test_masses.len() > 1);
    match sensing {
        Some(sensing) => {
            // The axes about which torque noise turns the spacecraft independently, in which the smoother works too.
            let torque_psd = thrust.torque * thrust.torque_shape.white_psd();
            let alpha = (inverse * torque_psd * inverse.transpose()).symmetric_eigen();
            let least = 1e-12 * alpha.eigenvalues.max();
            for (axis, alpha_psd) in
                alpha.eigenvectors.column_iter().zip(&alpha.eigenvalues).filter(|(_, psd)| **psd > least)
            {
                let torque =
                    mission.spacecraft.inertia() * axis * (alpha_psd * choices.unknown_alpha * per_step).sqrt();
                let lever = (&turned * torque).as_slice().to_vec();
                let crossover_rad_s = (alpha_psd / sensing).powf(0.25);
                torque_noise.push(TorqueNoiseShaping::new(lever, crossover_rad_s, dt_s));
            }
        }
        None => psd += &turned * (thrust.torque * unknown) * turned.transpose(),
    }
    let red = |(t, mass_kg): (usize, f64)| {
        let largest = |process: &str| (0..3).map(|axis| level(process, 3 * t + axis).powi(2)).fold(0.0, f64::max);
        red_walk(electrostatic.as_ref()) / mass_kg.powi(2) * largest("electrostatic_force")
            + red_walk(stray.as_ref()) * largest("test_mass_acceleration")
    };
    let red = tms.iter().map(|tm| tm.mass_kg).enumerate().map(red).fold(0.0, f64::max);
    Ok(Model {
        dt_s,
        acceleration_m2_s4: psd * per_step,
        torque_noise,
        bias_step_m2_s4: (choices.bias_walk_m_s2_rts.powi(2) + red) * dt_s,
        readout_m2: shapes.iter().map(|shape| shape.white_psd() * per_step).collect(),
        chains: shapes
            .iter()
            .map(|shape| shape.coloured().map(|t| Chain::new(t, choices.leak_hz, dt_s)).collect())
            .collect(),
        coefficients,
        prior: choices.prior,
    })
}

/// Tables of `[noise]` with a coloured part that the filter leaves out: it has that of readouts, and of forces on a
/// test mass the part whose PSD falls as 1/f².
pub fn without_their_colour(noise: &Noise) -> Vec<&'static str> {
    let coloured = |shape: Option<NoiseShape>, known: Option<u32>| {
        shape.is_some_and(|shape| shape.coloured().any(|term| Some(term.exponent) != known))
    };
    let force = noise.thruster_force.as_ref().map(|n| n.shape());
    let torque = noise.thruster_torque.as_ref().map(|n| n.shape());
    let sunlight = noise.solar_pressure.as_ref().map(|n| n.shape());
    let electrodes = noise.electrostatic_force.as_ref().map(|n| n.shape());
    let stray = noise.test_mass_acceleration.as_ref().map(|n| n.shape());
    let all = [
        ("thruster_force", coloured(force, None)),
        ("thruster_torque", coloured(torque, None)),
        ("solar_pressure", coloured(sunlight, None)),
        ("electrostatic_force", coloured(electrodes, Some(2))),
        ("test_mass_acceleration", coloured(stray, Some(2))),
    ];
    all.into_iter().filter(|(_, left_out)| *left_out).map(|(name, _)| name).collect()
}

fn readout_noise(noise: &Noise, name: &str) -> Result<NoiseShape, MissionError> {
    let table = noise.displacement(name).map(DisplacementNoise::shape);
    table.ok_or_else(|| MissionError::Missing { section: format!("noise.{name}"), needed_by: STAGE })
}

/// Variance per second of the random walk whose one-sided PSD is the `1/f²` part of a shape, unit² s⁻¹.
fn red_walk(shape: Option<&NoiseShape>) -> f64 {
    let terms = shape.into_iter().flat_map(NoiseShape::coloured).filter(|t| t.exponent == 2);
    terms.map(|t| 0.5 * (t.asd * std::f64::consts::TAU * t.corner_hz).powi(2)).sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::shaping::tests::gain;
    use dragfree_physics::mission::DisplacementTerm;
    use nalgebra::{Complex, DMatrix, Vector3};

    /// The paper's spacecraft with the default noise.
    fn taiji() -> Mission {
        let mission = serde_json::json!({
            "mission": { "name": "Taiji", "spacecraft": "SC1", "sample_rate_hz": 10.0 },
            "spacecraft": {
                "mass_kg": 1500.0,
                "inertia_srf_kg_m2": [[800.0, 13.0, 10.0], [13.0, 800.0, 12.0], [10.0, 12.0, 1000.0]],
            },
            "test_mass": { "tm1": {
                "mass_kg": 1.96,
                "orf_from_srf_angle_rad": std::f64::consts::FRAC_PI_6,
                "offset_nominal_srf_m": [0.0, 0.18, 0.0],
                "offset_box_srf_m": [0.02, 0.02, 0.02],
            } },
            "noise": {
                "ifo_x": { "asd_m_rthz": 1.42e-12, "corner_hz": 2e-3, "exponent": 4 },
                "is_y": { "asd_m_rthz": 1.8e-9, "corner_hz": 1e-3, "exponent": 2 },
                "is_z": { "asd_m_rthz": 1.8e-9, "corner_hz": 1e-3, "exponent": 2 },
                "thruster_force": { "asd_n_rthz": 1e-7 },
                "thruster_torque": { "asd_nm_rthz": 1e-7 },
            },
        });
        Mission::from_json(&mission.to_string()).expect("a mission")
    }

    fn choices(unknown_alpha: f64) -> Choices {
        let prior = Prior { displacement_m: 1e-6, velocity_m_s: 1e-7, bias_m_s2: 1e-7 };
        Choices { prior, bias_walk_m_s2_rts: 0.0, leak_hz: 1e-6, unknown_alpha }
    }

    /// States of the chains of each readout.
    fn states_of_chains(model: &Model) -> Vec<usize> {
        model.chains.iter().map(|chains| chains.iter().map(Chain::states).sum()).collect()
    }

    /// Numbers by hand: 1e-7 N/√Hz over 1500 kg at 10 Hz, 1e-7 N m/√Hz over about 800 kg m² through 0.18 m.
    #[test]
    fn the_default_mission_in_numbers() {
        let names = ["ifo_x", "is_y", "is_z"];
        let model = |unknown| {
            model(&taiji(), &["tm1"], &names, vec![], &choices(unknown), &NoiseLevels::default()).expect("complete")
        };
        let still = model(0.0);
        let thrust = (1e-7_f64 / 1500.0).powi(2) * 5.0;
        assert!((still.acceleration_m2_s4[(0, 0)] / thrust - 1.0).abs() < 1e-5);
        assert!((still.readout_m2[0] / ((1.42e-12_f64).powi(2) * 5.0) - 1.0).abs() < 1e-12);
        assert_eq!(states_of_chains(&still), [2, 1, 1]);
        // −α × b with b = (0.09, 0.156, 0): along z both horizontal components act, over 800 kg m²; x and y see α_z
        // alone.
        let moved = model(1.0);
        let along_z = moved.acceleration_m2_s4[(2, 2)] - still.acceleration_m2_s4[(2, 2)];
        let by_hand = (1e-7_f64 / 800.0 * 0.18).powi(2) * 5.0;
        assert!((along_z / by_hand - 1.0).abs() < 0.05, "{along_z:e} against {by_hand:e}");
        assert!(moved.acceleration_m2_s4[(0, 0)] - still.acceleration_m2_s4[(0, 0)] < by_hand);
    }

    /// Levels of components make the filter that a mission file of these levels makes; one along an axis acts there and
    /// nowhere else.
    #[test]
    fn levels_scale_the_noise_of_their_components() {
        let names = ["ifo_x", "is_y", "is_z"];
        let levels = |stated: &[(&str, f64)]| {
            let level = |(component, k): &(&str, f64)| dragfree_sdk::Coefficient {
                noise: (*component).to_owned(),
                initial: *k,
                ..Default::default()
            };
            NoiseLevels::of(&stated.iter().map(level).collect::<Vec<_>>())
        };
        let with = |mission: &Mission, stated: &[(&str, f64)]| {
            model(mission, &["tm1"], &names, vec![], &choices(1.0), &levels(stated)).expect("complete")
        };
        let mut louder = taiji();
        louder.noise.thruster_force.as_mut().expect("there").asd_n_rthz *= 2.0;
        louder.noise.thruster_torque.as_mut().expect("there").asd_nm_rthz *= 3.0;
        louder.noise.is_y.as_mut().expect("there").asd_m_rthz *= 1.5;
        let mut stated: Vec<(String, f64)> = Vec::new();
        for axis in AXES {
            stated.push((format!("thruster_force:sc.{axis}"), 2.0));
            stated.push((format!("thruster_torque:sc.{axis}"), 3.0));
        }
        stated.extend([("readout:tm1.y".to_owned(), 1.5), ("readout:tm2.z".to_owned(), 7.0)]);
        let stated: Vec<(&str, f64)> = stated.iter().map(|(component, k)| (component.as_str(), *k)).collect();
        let (by_mission, by_levels) = (with(&louder, &[]), with(&taiji(), &stated));
        let close = |a: f64, b: f64| (a - b).abs() <= 1e-12 * a.abs();
        assert!(by_mission.acceleration_m2_s4.iter().zip(&by_levels.acceleration_m2_s4).all(|(a, b)| close(*a, *b)));
        assert!(by_mission.readout_m2.iter().zip(&by_levels.readout_m2).all(|(a, b)| close(*a, *b)));
        let drive = |m: &Model| m.chains.iter().flatten().flat_map(|c| c.noise.clone()).collect::<Vec<f64>>();
        assert!(drive(&by_mission).iter().zip(drive(&by_levels)).all(|(a, b)| close(*a, b)));

        // ORF of tm1 is SRF turned about z: a force along z moves the test mass along z alone.
        let (plain, up) = (with(&taiji(), &[]), with(&taiji(), &[("thruster_force:sc.z", 2.0)]));
        let more = &up.acceleration_m2_s4 - &plain.acceleration_m2_s4;
        let alone = (1e-7_f64 / 1500.0).powi(2) * 5.0;
        assert!((more[(2, 2)] / (3.0 * alone) - 1.0).abs() < 1e-9, "{more}");
        assert!((0..3).all(|i| (0..3).all(|j| (i, j) == (2, 2) || more[(i, j)].abs() < 1e-9 * alone)), "{more}");
    }

    /// Further `terms` of a readout are further chains: 4 + 3 + 3 states, whose spectra add up to what the file says.
    /// The sampled spectrum of a chain of `p/2` integrators is `a² (f_c/f)^p` to the order of its aliases, `(π f dt)²`,
    /// and of the leak.
    #[test]
    fn further_terms_of_a_readout_are_further_states() {
        let mut mission = taiji();
        let term = |corner_hz, exponent| DisplacementTerm { asd_m_rthz: 1.42e-12, corner_hz, exponent };
        let noise = &mut mission.noise;
        noise.ifo_x.as_mut().expect("there").terms = vec![term(3e-3, 2), term(1e-4, 2)];
        for readout in [&mut noise.is_y, &mut noise.is_z] {
            readout.as_mut().expect("there").terms = vec![term(5e-4, 4)];
        }
        let offset = vec![Coefficient { initial: 0.0, prior_sigma: 0.1 }; 3];
        let model =
            model(&mission, &["tm1"], &["ifo_x", "is_y", "is_z"], offset, &choices(1.0), &NoiseLevels::default())
                .expect("complete");
        assert_eq!(states_of_chains(&model), [4, 3, 3]);
        assert_eq!(model.states(), 22);
        let stated = |f: f64| 1.42e-12_f64.powi(2) * ((2e-3 / f).powi(4) + (3e-3 / f).powi(2) + (1e-4 / f).powi(2));
        for f in [2e-4_f64, 2e-3, 2e-2] {
            let psd: f64 = model.chains[0].iter().map(|c| sampled_psd(c, f)).sum();
            assert!(
                (psd / stated(f) - 1.0).abs() < 3e-4 + (std::f64::consts::PI * f * 0.1).powi(2),
                "{psd:e} at {f} Hz"
            );
        }
    }

    /// One-sided PSD of a chain's output, `2 dt C (zI − A)⁻¹ Q (zI − A)⁻ᴴ Cᵀ`.
    fn sampled_psd(chain: &Chain, f_hz: f64) -> f64 {
        let n = chain.states();
        let z = Complex::from_polar(1.0, std::f64::consts::TAU * f_hz * 0.1);
        let zia = DMatrix::from_fn(n, n, |i, j| {
            let a = if j >= i { chain.transition[j - i] } else { 0.0 };
            Complex::new(-a, 0.0) + if i == j { z } else { Complex::new(0.0, 0.0) }
        });
        let inverse = zia.try_inverse().expect("no pole on the unit circle");
        let q = DMatrix::from_row_slice(n, n, &chain.noise).map(|x| Complex::new(x, 0.0));
        (&inverse * q * inverse.adjoint())[(0, 0)].re * 0.2
    }

    /// The nine thrusters by sums over them, each pushing and turning at once: with the whole torque unknown every unit
    /// moves the test mass by `−f d/m − (J⁻¹ (r×d) f) × b`; with the torque known, no more than with it unknown.
    #[test]
    fn thrusters_that_push_and_turn_at_once() {
        let text = include_str!("../../../fixtures/missions/taiji-thrusters.toml");
        let value: toml::Value = toml::from_str(text).expect("the fixture is TOML");
        let mission = Mission::from_json(&serde_json::to_string(&value).expect("JSON")).expect("a mission");
        let names = ["ifo_x", "is_y", "is_z"];
        let noise = |unknown| {
            let model = model(&mission, &["tm2"], &names, vec![], &choices(unknown), &NoiseLevels::default())
                .expect("complete");
            Matrix3::from_fn(|i, j| model.acceleration_m2_s4[(i, j)] / 5.0)
        };
        let (known, unknown) = (noise(0.0), noise(1.0));
        let tm = mission.test_mass("tm2", "the test").expect("it is there");
        let inverse = mission.spacecraft.inertia_inverse();
        let mut by_hand = Matrix3::zeros();
        for unit in &mission.thrusters.as_ref().expect("units").unit {
            let d = Vector3::from(unit.direction_srf).normalize();
            let alpha = tm.dcm_orf_from_srf() * (inverse * Vector3::from(unit.position_srf_m).cross(&d));
            let a = -tm.dcm_orf_from_srf() * d / mission.spacecraft.mass_kg - alpha.cross(&tm.offset_nominal_orf_m());
            by_hand += a * a.transpose() * unit.asd_n_rthz.powi(2);
        }
        // What is not thrust is white and on the diagonal: stray forces, sunlight, electrodes; 1e-3 of the thrust.
        assert!((unknown - by_hand).amax() < 2e-3 * by_hand.amax(), "{unknown} against {by_hand}");
        let gained = (unknown - known).symmetric_eigenvalues();
        assert!(gained.min() > -1e-9 * gained.max() && gained.max() > 0.0, "{gained}");
    }

    /// Two test masses, ±30° and ±0.18 m: no thrust moves `y_1 + y_2` against `x_1 − x_2`, as both show the spacecraft
    /// along s₂, so that nothing is left there but the electrodes; and the torques shake what they shake of one test
    /// mass, at Nyquist.
    #[test]
    fn between_two_test_masses_the_thrust_falls_out() {
        let text = include_str!("../../../fixtures/missions/taiji.toml");
        let value: toml::Value = toml::from_str(text).expect("the fixture is TOML");
        let mission = Mission::from_json(&serde_json::to_string(&value).expect("JSON")).expect("a mission");
        let names = ["ifo_x", "is_y", "is_z", "ifo_x", "is_y", "is_z"];
        let both =
            model(&mission, &["tm1", "tm2"], &names, vec![], &choices(1.0), &NoiseLevels::default()).expect("complete");
        let q = DMatrix::from_fn(6, 6, |i, j| both.acceleration_m2_s4[(i, j)] / 5.0);
        let quiet = |weights: [f64; 6]| {
            let w = DMatrix::from_row_slice(1, 6, &weights);
            (&w * &q * w.transpose())[(0, 0)]
        };
        // s₂ = sin 30° x₁ + cos 30° y₁ = −sin 30° x₂ + cos 30° y₂: the noise of four electrodes and test masses, by
        // hand.
        let (s, c) = (0.5, 0.75_f64.sqrt());
        let own = 2.0 * (3e-15_f64).powi(2) * (s * s + c * c) + 2.0 * (2e-14_f64 / 1.96).powi(2) * c * c;
        let between = quiet([s, c, 0.0, s, -c, 0.0]);
        assert!((between / own - 1.0).abs() < 1e-3, "{between:e} against {own:e}");
        assert!(quiet([s, c, 0.0, 0.0, 0.0, 0.0]) > 1e7 * between, "the thrust is there");

        // The red noise of each test mass, 1/f² of the electrodes and of stray forces, is a walk of 2πf_c/√2 times its
        // white noise.
        let walk = |asd: f64, corner_hz: f64| 0.5 * (std::f64::consts::TAU * corner_hz * asd).powi(2);
        let own = (walk(2e-14 / 1.96, 1e-3) + walk(3e-15, 4e-4)) * both.dt_s;
        assert!((both.bias_step_m2_s4 / own - 1.0).abs() < 1e-9, "{:e} against {own:e}", both.bias_step_m2_s4);

        let white =
            model(&mission, &["tm1"], &["ifo_x", "is_y", "is_z"], vec![], &choices(1.0), &NoiseLevels::default())
                .expect("complete");
        let none =
            model(&mission, &["tm1"], &["ifo_x", "is_y", "is_z"], vec![], &choices(0.0), &NoiseLevels::default())
                .expect("complete");
        let power = |axis: usize, frequency_hz: f64| -> f64 {
            both.torque_noise.iter().map(|noise| gain(noise, axis, frequency_hz * both.dt_s).powi(2)).sum()
        };
        for i in 0..3 {
            let torque = white.acceleration_m2_s4[(i, i)] - none.acceleration_m2_s4[(i, i)];
            let at_nyquist = power(i, 5.0);
            assert!((at_nyquist / torque - 1.0).abs() < 1e-6, "axis {i}: {at_nyquist:e} against {torque:e}");
        }
        // Along x and y the torque about s₃ acts. It turns 1000 kg m² by as much as the sensors' noise at
        // √(1e-10/5e-10)/2π Hz, where half of it is known.
        let crossover_hz = 0.2_f64.sqrt() / std::f64::consts::TAU;
        let left = power(0, crossover_hz) / power(0, 5.0);
        assert!((left - 0.5).abs() < 2e-3, "{left} of the torque noise is left at the crossover");
    }

    /// An interferometer may read any axis.
    #[test]
    fn an_interferometer_along_y_has_its_own_noise() {
        let mut mission = taiji();
        mission.noise.ifo_y = mission.noise.ifo_x.clone();
        let of = |names: &[&str]| {
            model(&mission, &["tm1"], names, vec![], &choices(1.0), &NoiseLevels::default()).expect("complete")
        };
        let model = of(&["ifo_x", "ifo_y", "is_z"]);
        assert_eq!(model.readout_m2[1], model.readout_m2[0]);
        assert!(of(&["ifo_x", "is_y", "is_z"]).readout_m2[1] > model.readout_m2[1]);
    }

    #[test]
    fn colour_that_the_filter_has_not_is_named() {
        let mut mission = taiji();
        assert_eq!(without_their_colour(&mission.noise), [""; 0]);
        let force = mission.noise.thruster_force.as_mut().expect("a force");
        (force.corner_hz, force.exponent) = (1e-2, 2);
        let stray = |exponent: u32| {
            let table = serde_json::json!({ "asd_m_s2_rthz": 3e-15, "corner_hz": 1e-3, "exponent": exponent });
            serde_json::from_value(table).expect("stray forces")
        };
        mission.noise.test_mass_acceleration = Some(stray(2));
        assert_eq!(without_their_colour(&mission.noise), ["thruster_force"]);
        mission.noise.test_mass_acceleration = Some(stray(4));
        assert_eq!(without_their_colour(&mission.noise), ["thruster_force", "test_mass_acceleration"]);
    }

    #[test]
    fn what_is_missing_is_named() {
        let mut mission = taiji();
        mission.noise.is_y = None;
        let error =
            model(&mission, &["tm1"], &["ifo_x", "is_y", "is_z"], vec![], &choices(1.0), &NoiseLevels::default())
                .expect_err("no noise.is_y");
        assert!(error.to_string().contains("noise.is_y"), "{error}");
    }
}
