//! Readouts that differ from the true state: `is-scale`, `is-crosstalk`, `tilt-to-length`, `time-offset`.
//!
//! A readout error `δ(t)` adds its second difference to the channel. A regressor formed from the same readout would be
//! correlated with its noise (errors in variables), so regressors use the estimated acceleration `û + Φ b + d` instead;
//! Methods, "Acceleration of a test mass". Along s_3, where `d` is unobservable, they use what the past predicts of it;
//! Methods, "Readout errors normal to the optical plane".
//!
//! In prediction mode regressors are made of `û + Φ b` alone along every axis, and the host accounts for `d`.

use dragfree_physics::mission::Mission;
use dragfree_sdk::prelude::*;

use crate::columns::alpha_is_commanded;
use crate::common::{AXES, TEST_MASSES, TM_YZ, axis_of, manifest};
use crate::linear::{
    Body, CoefficientForms, InputColumn, LinearEffect, Series, Term, TmAcceleration, accel_channel, attitude_channel,
    axis_pair, latest_column, offset_coupling_terms, offset_terms, tm_acceleration, unpredicted,
};
use crate::prediction::Normal;

const SCALE: [f64; 2] = [-0.2, 0.2];
const LEVER_M: [f64; 2] = [-5e-3, 5e-3];
const DELAY_S: [f64; 2] = [0.0, 0.2];

/// Terms that add the second difference of the displacement along `from` to the channel of `to`.
///
/// # Errors
/// The acceleration of the test mass is unobservable.
fn second_difference_terms(
    mission: &Mission,
    available: &Available,
    by: &'static str,
    instance: &str,
    (from, to): (usize, usize),
) -> Result<Vec<Term>, PluginError> {
    let tm = &Body::of(mission, instance, by)?;
    let readout = latest_column(available, &InputColumn::displacement(tm, to).name);
    if readout.is_some_and(|c| c.attribute("noise").starts_with("ifo")) {
        return Err(PluginError::error(format!(
            "{by}: {} of {} is read by an interferometer, not by the inertial sensor; remove the effect from the model",
            AXES[to], tm.name
        )));
    }
    let predicts = unpredicted(available, &InputColumn::known_accel(tm, from)).is_some();
    if from == 2 && !predicts {
        let normal = Normal::of(available, mission, by)?;
        let series = normal.predicted(normal.place(tm, by)?, by)?;
        return Ok(vec![Term::new(accel_channel(tm, to), Series::Predicted(Box::new(series)), 1.0)]);
    }
    let Some(TmAcceleration { modelled, unmodelled }) = tm_acceleration(available, mission, tm, from) else {
        return Err(PluginError::error(format!(
            "{by}: the acceleration of a test mass is observable only with the interferometers of both test masses; give \
             telemetry with the topic /ifo, or remove the effect from the model"
        )));
    };
    let term = |(series, factor, times)| Term { channel: accel_channel(tm, to), series, factor, times };
    Ok(modelled.into_iter().chain(unmodelled).map(term).collect())
}

/// `is-scale`: the capacitive readout reports `(1 + s) r` for a displacement `r`.
///
/// `z = s r̈ = s (û + Φ b + d)` along the axis; s: 1, ±0.2. Products of `s` with other coefficients are of second
/// order. Confounders: gains of actuators along the axis, above all `es-gain`.
///
/// * Along y, `d` is in the regressor and in the channel; only an estimator that models it as common to both test
///   masses is unbiased.
/// * Along z, `d` is unobservable; the regressor is the second difference of the displacement that past readouts of all
///   test masses predict.
///
/// **Limit.** x is read by the interferometer, so its capacitive scale is unobservable.
pub(crate) enum IsScale {}

impl LinearEffect for IsScale {
    const MANIFEST: Manifest = manifest(
        "is-scale",
        "Scale of the capacitive readout along an axis differs from one",
        &[],
        TM_YZ,
        &["commands"],
    );
    const IN_READOUT: bool = true;

    fn coefficients(
        setup: &Setup,
        mission: &Mission,
        available: &Available,
    ) -> Result<Vec<CoefficientForms>, PluginError> {
        let axis = axis_of(setup.instance());
        let terms = second_difference_terms(mission, available, "the effect is-scale", setup.instance(), (axis, axis))?;
        Ok(CoefficientForms::only("1", SCALE, terms))
    }
}

/// `is-crosstalk`: in instance `NAME.y-z`, `k` times the displacement along y appears in the readout of z.
///
/// `z_to = k r̈_from = k (û + Φ b + d)_from`; k: 1, ±0.2. From z, where `d` is unobservable, the regressor is made of
/// the predicted displacement. No instance ends in x, which the interferometer reads. Confounders: `es-crosstalk` of
/// the same axes.
pub(crate) enum IsCrosstalk {}

impl LinearEffect for IsCrosstalk {
    const MANIFEST: Manifest = manifest(
        "is-crosstalk",
        "Part of the displacement along one axis appears in the capacitive readout of another",
        &[],
        &["{test_mass}.x-y", "{test_mass}.x-z", "{test_mass}.y-z", "{test_mass}.z-y"],
        &["commands"],
    );
    const IN_READOUT: bool = true;

    fn coefficients(
        setup: &Setup,
        mission: &Mission,
        available: &Available,
    ) -> Result<Vec<CoefficientForms>, PluginError> {
        let axes = axis_pair(setup.instance());
        let terms = second_difference_terms(mission, available, "the effect is-crosstalk", setup.instance(), axes)?;
        Ok(CoefficientForms::only("1", SCALE, terms))
    }
}

/// `tilt-to-length`: the interferometer reports `x + c θ + d ψ`.
///
/// `z_x = c θ̈ + d ψ̈` with the test mass's angles relative to its housing, `(θ̈, ψ̈) = (J_m⁻¹ M_E − T_S^O α̂)_{y,z}`.
/// Coefficients `.theta` and `.psi`, m rad⁻¹, ±5e-3. Rotational stiffness is neglected.
///
/// **Collinear with the offset** in x, where `c` acts like `b_z` and `d` like `−b_y` (1 mm/rad for 1 mm). The offset
/// differs by its response along y and z, and below the bandwidth of the test mass's own attitude control. That control
/// reads the spacecraft's attitude beside `sc.alpha`: see `AHEAD_ATTRIBUTE`.
pub(crate) enum TiltToLength {}

impl LinearEffect for TiltToLength {
    const MANIFEST: Manifest = manifest(
        "tilt-to-length",
        "Part of a test mass's angles appears in the interferometer",
        &[],
        TEST_MASSES,
        &["commands"],
    );
    const IN_READOUT: bool = true;

    fn coefficients(
        setup: &Setup,
        mission: &Mission,
        available: &Available,
    ) -> Result<Vec<CoefficientForms>, PluginError> {
        const BY: &str = "the effect tilt-to-length";
        let tm = &Body::of(mission, setup.instance(), BY)?;
        let name = &tm.name;
        let readout = InputColumn::displacement(tm, 0).name;
        if latest_column(available, &readout).is_some_and(|c| c.attribute("noise") != "ifo_x") {
            return Err(PluginError::error(format!(
                "effect tilt-to-length: x of {name} is read by the inertial sensor, not by an interferometer; remove the effect from \
                 the model"
            )));
        }
        let (inverse, t) = (tm.section.inertia_inverse(name, BY)?, tm.section.dcm_orf_from_srf());
        let part = |name: &'static str, angle: usize| {
            let torque = (0..3).map(|j| (InputColumn::electrodes_torque(tm, j), inverse[(angle, j)]));
            let turn = (0..3).map(|j| (InputColumn::alpha(j), -t[(angle, j)]));
            let both = torque.chain(turn);
            let terms =
                both.map(|(source, factor)| Term::new(accel_channel(tm, 0), Series::Column(source), factor)).collect();
            CoefficientForms::named(name, "m rad-1", LEVER_M, terms)
        };
        Ok(vec![part("theta", 1), part("psi", 2)])
    }
}

/// `time-offset`: an instrument reports the state of `τ` earlier. τ: s, 0 to 0.2.
///
/// `z = −τ da/dt` with the known acceleration `a = û + Φ b`. τ is unbiased up to one sample interval; Methods, "Delay
/// of a readout".
/// * `ifo` acts on x of both test masses. The unmodelled acceleration is delayed too; only an estimator that models it
///   as common with y, which is on time, is unbiased.
/// * `dws` acts on the attitude channels with `a = J_S⁻¹ M_T`, and on the test masses through `α̂`, which is late by
///   `τ ∂α̂/∂τ`: they show `+τ [T ∂α̂/∂τ ×] b`. In prediction mode `a = α̂` for the attitude, whose unknown part is
///   late too, and nothing acts through `α̂`, which is the commanded one.
/// * `is` acts on all axes that the inertial sensor reads. Beside an interferometer, `d` in the optical plane is on
///   time and `a = û + Φ b + d`. Otherwise all readouts of `d` are late alike, which does not show, and `a = û + Φ b`.
///
/// Confounders: a delay of the actuators, which `[thrusters]` of the mission file states; gains at high frequency.
pub(crate) enum TimeOffset {}

impl LinearEffect for TimeOffset {
    const MANIFEST: Manifest = manifest(
        "time-offset",
        "An instrument reports its state with a delay",
        &[],
        &["ifo", "dws", "is"],
        &["commands", "dws-delay-response"],
    );
    const IN_READOUT: bool = true;

    fn coefficients(
        setup: &Setup,
        mission: &Mission,
        available: &Available,
    ) -> Result<Vec<CoefficientForms>, PluginError> {
        const BY: &str = "the effect time-offset";
        let mut terms = Vec::new();
        if setup.instance() == "dws" && alpha_is_commanded(available) {
            for row in 0..3 {
                let series = Series::Slope(InputColumn::alpha(row), "rad s-3");
                terms.push(Term::new(attitude_channel(row), series, -1.0));
            }
            return Ok(CoefficientForms::only("s", DELAY_S, terms));
        }
        if setup.instance() == "dws" {
            let inverse = mission.spacecraft.inertia_inverse();
            for (row, axis) in (0..3).flat_map(|row| (0..3).map(move |axis| (row, axis))) {
                let series = Series::Slope(InputColumn::torque(axis), "N m s-1");
                terms.push(Term::new(attitude_channel(row), series, -inverse[(row, axis)]));
            }
            let response = |j| Series::Column(InputColumn::alpha_by_dws_delay(j));
            terms.extend(offset_coupling_terms(available, mission, BY, response, -1.0)?);
            return Ok(CoefficientForms::only("s", DELAY_S, terms));
        }
        let bodies = Body::all(mission);
        for (tm, axis) in bodies.iter().flat_map(|tm| (0..3).map(move |axis| (tm, axis))) {
            let column = latest_column(available, &InputColumn::displacement(tm, axis).name);
            let reads = column.map_or("", |c| c.attribute("noise"));
            if !reads.starts_with(setup.instance()) {
                continue;
            }
            terms.push(Term::new(
                accel_channel(tm, axis),
                Series::Slope(InputColumn::known_accel(tm, axis), "m s-3"),
                -1.0,
            ));
            for (column, times) in offset_terms(available, tm, axis) {
                let series = Series::Slope(column, "s-3");
                terms.push(Term { channel: accel_channel(tm, axis), series, factor: -1.0, times: Some(times) });
            }
            if setup.instance() != "is" {
                continue;
            }
            for (series, factor, times) in
                tm_acceleration(available, mission, tm, axis).map(|a| a.unmodelled).into_iter().flatten()
            {
                let series = match series {
                    Series::Newer(column) => Series::NewerSlope(column, "m s-3"),
                    Series::Column(column) => Series::Slope(column, "rad s-3"),
                    other => other,
                };
                terms.push(Term { channel: accel_channel(tm, axis), series, factor: -factor, times });
            }
        }
        Ok(CoefficientForms::only("s", DELAY_S, terms))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::test_spacecraft::{TestSpacecraft, setup};
    use nalgebra::{Matrix3, Vector3};

    /// In the plane of the two optical axes.
    const UNKNOWN_FORCE_SRF_N: [Vector3<f64>; 2] = [Vector3::new(0.4, -0.7, 0.0), Vector3::new(-0.5, 0.3, 0.0)];

    #[test]
    fn is_scale_matches_the_derivative() {
        for (tm, axis) in [(0, 1), (1, 1)] {
            let instance = format!("tm{}.{}", tm + 1, AXES[axis]);
            let test_spacecraft = TestSpacecraft { unknown_force_srf_n: UNKNOWN_FORCE_SRF_N, ..TestSpacecraft::new() };
            test_spacecraft.assert_matches_derivative::<IsScale>(
                &instance,
                "",
                &[&|w, s| w.readout_gain[tm][(axis, axis)] += s],
            );
        }
    }

    #[test]
    fn is_crosstalk_matches_the_derivative() {
        for (tm, from, to) in [(0, 0, 1), (0, 1, 2), (1, 0, 1), (1, 0, 2)] {
            let instance = format!("tm{}.{}-{}", tm + 1, AXES[from], AXES[to]);
            let test_spacecraft = TestSpacecraft { unknown_force_srf_n: UNKNOWN_FORCE_SRF_N, ..TestSpacecraft::new() };
            test_spacecraft.assert_matches_derivative::<IsCrosstalk>(
                &instance,
                "",
                &[&|w, k| w.readout_gain[tm][(to, from)] += k],
            );
        }
    }

    /// Along z a prediction of all test masses takes the place of `d`; no interferometer is needed, but the noise of
    /// thrusters and readouts is.
    #[test]
    fn along_z_the_displacement_is_predicted() {
        let mut test_spacecraft = TestSpacecraft::new();
        let error = IsScale::coefficients(&setup("tm2.z", ""), &test_spacecraft.mission, &test_spacecraft.available())
            .unwrap_err();
        assert!(error.message().contains("noise.thruster_force"), "{}", error.message());
        test_spacecraft.mission = with_noise(&test_spacecraft.mission);
        let mut available = test_spacecraft.available();
        for column in available.columns.iter_mut().filter(|c| c.attribute("noise") == "ifo_x") {
            column.attributes.insert("noise".to_owned(), "is_x".to_owned());
        }
        let terms = |of: Vec<CoefficientForms>| -> Vec<(String, String, f64)> {
            let all = of[0].forms[0].terms.iter();
            all.map(|t| (t.channel.clone(), t.series.name(), t.factor)).collect()
        };
        let scale = IsScale::coefficients(&setup("tm2.z", ""), &test_spacecraft.mission, &available).unwrap();
        let predicted = |channel: &str| vec![(channel.to_owned(), "predicted(tm2.accel.z)".to_owned(), 1.0)];
        assert_eq!(terms(scale), predicted("tm2.accel.z"));
        let mixed = IsCrosstalk::coefficients(&setup("tm2.z-y", ""), &test_spacecraft.mission, &available).unwrap();
        assert_eq!(terms(mixed), predicted("tm2.accel.y"));
    }

    fn with_noise(mission: &Mission) -> Mission {
        let mut mission = mission.clone();
        let taiji: serde_json::Value =
            toml::from_str(include_str!("../../../fixtures/missions/taiji.toml")).expect("the fixture is TOML");
        mission.noise = Mission::from_json(&taiji.to_string()).expect("the fixture is a mission").noise;
        mission
    }

    #[test]
    fn readout_effects_need_the_interferometers() {
        let test_spacecraft = TestSpacecraft::new();
        let mut available = test_spacecraft.available();
        for column in available.columns.iter_mut().filter(|c| c.attribute("noise") == "ifo_x") {
            column.attributes.insert("noise".to_owned(), "is_x".to_owned());
        }
        for error in [
            IsScale::coefficients(&setup("tm2.y", ""), &test_spacecraft.mission, &available).unwrap_err(),
            IsCrosstalk::coefficients(&setup("tm1.y-z", ""), &test_spacecraft.mission, &available).unwrap_err(),
        ] {
            assert!(error.message().contains("only with the interferometers"), "{}", error.message());
        }
        let error = TiltToLength::coefficients(&setup("tm1", ""), &test_spacecraft.mission, &available).unwrap_err();
        assert!(error.message().contains("x of tm1 is read by the inertial sensor"), "{}", error.message());
    }

    #[test]
    fn effects_of_the_inertial_sensor_need_it() {
        let test_spacecraft = TestSpacecraft::new();
        let mut available = test_spacecraft.available();
        let y = InputColumn::displacement(&Body::of(&test_spacecraft.mission, "tm2.y", "a test").unwrap(), 1).name;
        for column in available.columns.iter_mut().filter(|c| c.name == y) {
            column.attributes.insert("noise".to_owned(), "ifo_y".to_owned());
        }
        for error in [
            IsScale::coefficients(&setup("tm2.y", ""), &test_spacecraft.mission, &available).unwrap_err(),
            IsCrosstalk::coefficients(&setup("tm2.x-y", ""), &test_spacecraft.mission, &available).unwrap_err(),
        ] {
            assert!(error.message().contains("y of tm2 is read by an interferometer"), "{}", error.message());
        }
        IsScale::coefficients(&setup("tm1.y", ""), &test_spacecraft.mission, &available).unwrap();
    }

    #[test]
    fn tilt_to_length_matches_the_derivative() {
        for tm in 0..2 {
            let instance = format!("tm{}", tm + 1);
            let test_spacecraft = TestSpacecraft::new();
            test_spacecraft.assert_matches_derivative::<TiltToLength>(
                &instance,
                "",
                &[&|w, c| w.tilt_to_length_m_rad[tm][0] += c, &|w, d| w.tilt_to_length_m_rad[tm][1] += d],
            );
        }
    }

    #[test]
    fn time_offset_matches_the_derivative() {
        let late = |channels: &'static [usize]| {
            move |w: &mut crate::test_spacecraft::Deviations, tau: f64| {
                channels.iter().for_each(|c| w.readout_delay_s[*c] += tau);
            }
        };
        TestSpacecraft::new().assert_matches_derivative::<TimeOffset>("ifo", "", &[&late(&[0, 3])]);
        // An unmodelled force in the optical plane is on time in the interferometers.
        let test_spacecraft = TestSpacecraft { unknown_force_srf_n: UNKNOWN_FORCE_SRF_N, ..TestSpacecraft::new() };
        test_spacecraft.assert_matches_derivative::<TimeOffset>("is", "", &[&late(&[1, 2, 4, 5])]);
        let smoother_gain = Matrix3::new(0.7, 0.1, -0.2, 0.1, 0.4, 0.05, -0.1, 0.2, 0.9);
        let test_spacecraft = TestSpacecraft { smoother_gain, only_torque_varies: true, ..TestSpacecraft::new() };
        test_spacecraft.assert_matches_derivative::<TimeOffset>("dws", "", &[&late(&[6, 7, 8])]);
    }

    /// Known and unknown part of the declared series together are what the readouts show, under an unmodelled torque
    /// and an unmodelled force along every axis.
    #[test]
    fn in_prediction_mode_readout_effects_match_the_derivative() {
        let predicting = || TestSpacecraft {
            prediction: true,
            thruster_layout: true,
            unknown_force_srf_n: [Vector3::new(0.4, -0.7, 0.3), Vector3::new(-0.5, 0.3, 0.6)],
            ..TestSpacecraft::new()
        };
        for (tm, axis) in [(0, 1), (1, 1), (0, 2), (1, 2)] {
            predicting().assert_matches_derivative::<IsScale>(
                &format!("tm{}.{}", tm + 1, AXES[axis]),
                "",
                &[&|w, s| w.readout_gain[tm][(axis, axis)] += s],
            );
        }
        for (tm, from, to) in [(0, 0, 1), (1, 0, 2), (0, 1, 2), (1, 2, 1)] {
            predicting().assert_matches_derivative::<IsCrosstalk>(
                &format!("tm{}.{}-{}", tm + 1, AXES[from], AXES[to]),
                "",
                &[&|w, k| w.readout_gain[tm][(to, from)] += k],
            );
        }
        for (instance, channels) in [("ifo", &[0, 3][..]), ("is", &[1, 2, 4, 5]), ("dws", &[6, 7, 8])] {
            let late = |w: &mut crate::test_spacecraft::Deviations, tau: f64| {
                channels.iter().for_each(|c: &usize| w.readout_delay_s[*c] += tau);
            };
            predicting().assert_matches_derivative::<TimeOffset>(instance, "", &[&late]);
        }
    }

    /// Where no interferometer reads, only prediction mode has an acceleration along y, and along z one without the
    /// noise of the readouts.
    #[test]
    fn in_prediction_mode_readout_effects_need_no_interferometer() {
        let test_spacecraft = TestSpacecraft { prediction: true, ..TestSpacecraft::new() };
        let mut available = test_spacecraft.available();
        for column in available.columns.iter_mut().filter(|c| c.attribute("noise") == "ifo_x") {
            column.attributes.insert("noise".to_owned(), "is_x".to_owned());
        }
        for instance in ["tm2.y", "tm2.z"] {
            let forms = IsScale::coefficients(&setup(instance, ""), &test_spacecraft.mission, &available).unwrap();
            let names: Vec<String> = forms[0].forms[0].terms.iter().map(|t| t.series.name()).collect();
            assert!(names.len() == 3 && names[0].starts_with("tm2.u_orf_m_s2."), "{names:?}");
        }
    }

    /// A mass under accelerations held between samples, periodic in `N`, sampled late by exact kinematics. The
    /// projection of the second difference's change onto the averaged series is the delay, exactly up to one sample.
    #[test]
    fn the_estimated_delay_is_exact_up_to_one_sample() {
        const N: usize = 64;
        const DT: f64 = 0.1;
        let mut a: [f64; N] = std::array::from_fn(|k| (1.7 * k as f64 + 0.3 * (k * k) as f64).sin());
        let mean = a.iter().sum::<f64>() / N as f64;
        a.iter_mut().for_each(|a| *a -= mean);
        // A velocity of zero mean makes the position periodic.
        let mut velocity = [0.0; N];
        for k in 1..N {
            velocity[k] = velocity[k - 1] + a[k - 1] * DT;
        }
        let drift = (0..N).map(|k| velocity[k] * DT + 0.5 * a[k] * DT * DT).sum::<f64>() / (N as f64 * DT);
        velocity.iter_mut().for_each(|v| *v -= drift);
        let mut position = [0.0; N];
        for k in 1..N {
            position[k] = position[k - 1] + velocity[k - 1] * DT + 0.5 * a[k - 1] * DT * DT;
        }
        let wrapped = |k: usize, n: usize| (k + N - n) % N;
        let late = |k: usize, tau: f64| {
            let whole = (tau / DT).ceil() as usize;
            let (k, part) = (wrapped(k, whole), whole as f64 * DT - tau);
            position[k] + velocity[k] * part + 0.5 * a[k] * part * part
        };
        let series = |k: usize| -(a[k] - a[wrapped(k, 1)]) / DT;
        let projected = |tau: f64| {
            let (mut product, mut square) = (0.0, 0.0);
            for k in 0..N {
                let shown = (late((k + 1) % N, tau) - 2.0 * late(k, tau) + late(wrapped(k, 1), tau)) / (DT * DT);
                let z = shown - 0.5 * (a[k] + a[wrapped(k, 1)]);
                let phi = 0.5 * (series(k) + series(wrapped(k, 1)));
                (product, square) = (product + phi * z, square + phi * phi);
            }
            product / square
        };
        for tau in [0.001, 0.03, 0.05, 0.1] {
            assert!((projected(tau) - tau).abs() < 1e-9, "{tau}: {}", projected(tau));
        }
        // Beyond one sample, white acceleration gives a visible error.
        assert!((projected(0.2) - 0.2).abs() > 0.05, "{}", projected(0.2));
    }
}
