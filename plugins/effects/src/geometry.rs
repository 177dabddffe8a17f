//! Geometry that differs from the mission file: `offset-drift`, `opening-angle`.

use dragfree_physics::mission::Mission;
use dragfree_sdk::prelude::*;
use nalgebra::Vector3;

use crate::common::{SC_AXES, TEST_MASSES, axis_of, is_housekeeping, manifest};
use crate::linear::{
    Body, CoefficientForms, Form, InputColumn, LinearEffect, Multiplier, Series, Term, accel_channel,
    optical_axis_weights, optical_pair, tm_acceleration, unpredicted, vector_terms,
};

const RATE_M_S: [f64; 2] = [-2e-7, 2e-7];
const PER_KELVIN_M: [f64; 2] = [-2e-4, 2e-4];
/// One kilogram 1.5 m from the centre of a spacecraft of 1500 kg moves the centre of mass by 1 mm.
const PER_KILOGRAM_M: [f64; 2] = [-2e-2, 2e-2];

/// `offset-drift`: the centre of mass moves along an axis `e` of SRF, so `b_i^S(t) = b_i^S + k s(t) e`.
///
/// Channels: `z_i = −k s T_S^{O_i} (α̂ × e)`, eq:TM_SC_relative_acceleration. Terms in `ω²`, `b̈` and `ω × ḃ` are
/// negligible. The parameter `with` selects `s`:
/// * `time`: seconds from `since_ns`, by default from the run's first epoch. k: m s⁻¹, ±2e-7. The model's offset refers
///   to that time, so normal equations of several runs may be added only if all of them state the same `since_ns`.
/// * `hk.NAME` in K: change since its first value. k: m K⁻¹, ±2e-4. The model's offset refers to the first value.
/// * `hk.NAME` in kg: decrease since its first value, e.g. propellant spent. k: m kg⁻¹, ±2e-2.
///
/// Confounders: any other slow drift, which is collinear within a day.
pub(crate) enum OffsetDrift {}

const TIME: &str = "time";

impl LinearEffect for OffsetDrift {
    const MANIFEST: Manifest = manifest(
        "offset-drift",
        "The centre of mass moves along an axis with time, a temperature or the propellant spent",
        &[
            Parameter::text(
                "with",
                TIME,
                &[],
                "what the offset is proportional to: `time`, or a housekeeping column `hk.NAME` in K or kg",
            ),
            Parameter::i64(
                "since_ns",
                "ns",
                0,
                0..=i64::MAX,
                "Unix time of zero drift; 0 for the first epoch of the run, which prevents combining runs",
            ),
        ],
        SC_AXES,
        &[],
    );

    fn coefficients(
        setup: &Setup,
        mission: &Mission,
        available: &Available,
    ) -> Result<Vec<CoefficientForms>, PluginError> {
        let since_ns = Some(setup.i64("since_ns")?).filter(|ns| *ns != 0);
        let mut followed = vec![setup.text("with")?];
        if setup.candidate() {
            let drives = |c: &&Column| ["K", "kg"].contains(&c.unit.as_str());
            let columns = available.columns.iter().filter(|c| is_housekeeping(c)).filter(drives);
            followed = std::iter::once(TIME).chain(columns.map(|c| c.name.as_str())).map(str::to_owned).collect();
        }
        let axis = axis_of(setup.instance());
        let forms = followed.iter().map(|with| drift_form(axis, with, since_ns, mission, available));
        let forms = forms.collect::<Result<_, _>>()?;
        Ok(vec![CoefficientForms { name: "", forms }])
    }
}

/// The form of a drift along an axis that is proportional to the time or to a column.
fn drift_form(
    drift_axis: usize,
    with: &str,
    since_ns: Option<i64>,
    mission: &Mission,
    available: &Available,
) -> Result<Form, PluginError> {
    let growth = |c, unit, lost| Multiplier::Growth { column: InputColumn::of(c, unit), lost };
    let (multiplier, product, unit, range) = if with == TIME {
        (Multiplier::Time(since_ns), "rad s-1", "m s-1", RATE_M_S)
    } else {
        let column = available.column("grid", with).filter(|_| with.starts_with("hk."));
        match column.map(|c| (c, c.unit.as_str())) {
            Some((c, "K")) => (growth(c, "K", false), "rad K s-2", "m K-1", PER_KELVIN_M),
            Some((c, "kg")) => (growth(c, "kg", true), "rad kg s-2", "m kg-1", PER_KILOGRAM_M),
            found => {
                return Err(PluginError::error(format!(
                    "effect offset-drift: parameter `with` = \"{with}\" is {}; set \"time\" or a housekeeping column hk.NAME in K or kg",
                    found.map_or("not a column of the telemetry".to_owned(), |(_, unit)| format!("a column in {unit}"))
                )));
            }
        }
    };
    let mut terms = Vec::new();
    for tm in &Body::all(mission) {
        let t = tm.section.dcm_orf_from_srf();
        for j in (0..3).filter(|j| *j != drift_axis) {
            // Response −e_j × e to a unit of α̂ about j.
            let unit = |axis: usize| Vector3::from_fn(|i, _| f64::from(i == axis));
            let per_alpha: Vector3<f64> = -t * unit(j).cross(&unit(drift_axis));
            terms.extend(vector_terms(
                tm,
                &Series::Times(InputColumn::alpha(j), multiplier.clone(), product),
                &per_alpha,
            ));
        }
    }
    let shape = Shape::from([("with".to_owned(), with.into())]);
    Ok(Form::new(shape, unit, range, terms))
}

/// Three times what 25 days of 5 nrad/s make of it.
const OPENING_RAD: [f64; 2] = [-0.033, 0.033];

/// `opening-angle`: the frame of a test mass, with its electrodes and readouts, is rotated by δ about s_3 from `T_S^O`.
///
/// The test mass sees the housing's acceleration `a = û − F_E/m + Φ b + d` from another direction: `z = −δ e_3 × a`, so
/// `δ a_y` in x and `−δ a_x` in y. δ: rad, ±0.033. The unmodelled `d` is estimated from the readouts themselves, so its
/// terms are arranged as derived in Methods, "Opening angle". `d` is observable only where both optical axes are read.
/// In prediction mode `d` is left to the host.
///
/// Confounders: `mps-tilt:sc.z`, which rotates the thrust for both test masses; `is-crosstalk` of x in y; the direction
/// of the offset.
pub(crate) enum OpeningAngle {}

impl LinearEffect for OpeningAngle {
    const MANIFEST: Manifest = manifest(
        "opening-angle",
        "The frame of a test mass is rotated about s_3 from the mission's opening angle",
        &[],
        TEST_MASSES,
        &["commands"],
    );

    fn coefficients(
        setup: &Setup,
        mission: &Mission,
        available: &Available,
    ) -> Result<Vec<CoefficientForms>, PluginError> {
        let tm = &Body::of(mission, setup.instance(), "the effect opening-angle")?;
        let [x, y] = [0, 1].map(|axis| tm_acceleration(available, mission, tm, axis));
        // Weight of this optical axis in y of this test mass, and in y of the other one.
        let both = optical_pair(available, mission).filter(|both| both.iter().any(|body| body.name == tm.name));
        let weights = both.and_then(|both| {
            let place = usize::from(both[1].name == tm.name);
            let [own, others] = [place, 1 - place].map(|body| optical_axis_weights(&both, &both[body], 1));
            Some((both[1 - place].clone(), own?[place], others?[place]))
        });
        let predicts = (0..2).all(|axis| unpredicted(available, &InputColumn::known_accel(tm, axis)).is_some());
        // Then there are no terms of `d` to be weighed.
        let weights = if predicts { Some((tm.clone(), 0.0, 0.0)) } else { weights };
        let (Some(x), Some(y), Some((other, own, others))) = (x, y, weights) else {
            return Err(PluginError::error(
                "effect opening-angle: the acceleration of the housings is observable only with the interferometers of both test \
                 masses; give telemetry with the topic /ifo, or remove the effect from the model",
            ));
        };
        let mass_kg = tm.section.mass_kg;
        // The housing's acceleration excludes the electrodes' force on the test mass.
        let electrodes = |axis: usize| (Series::Column(InputColumn::electrodes_force(tm, axis)), -1.0 / mass_kg, None);
        let total_x = [x.modelled, x.unmodelled, vec![electrodes(0)]].concat();
        let modelled_y = [y.modelled, vec![electrodes(1)]].concat();
        let rows = [
            ((tm, 0), &modelled_y, 1.0),
            ((tm, 1), &total_x, -1.0),
            ((tm, 1), &y.unmodelled, -own),
            ((&other, 1), &y.unmodelled, -others),
        ];
        let mut terms: Vec<Term> = Vec::new();
        for ((to, axis), summands, weight) in rows {
            for (series, factor, times) in summands {
                let term = Term {
                    channel: accel_channel(to, axis),
                    series: series.clone(),
                    factor: factor * weight,
                    times: times.clone(),
                };
                let same =
                    |t: &&mut Term| t.channel == term.channel && t.series == term.series && t.times == term.times;
                match terms.iter_mut().find(same) {
                    Some(before) => before.factor += term.factor,
                    None => terms.push(term),
                }
            }
        }
        Ok(CoefficientForms::only("rad", OPENING_RAD, terms))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::common::AXES;
    use crate::test_spacecraft::{Deviations, ELAPSED_S, TestSpacecraft, setup};

    #[test]
    fn offset_drift_matches_the_derivative() {
        for axis in 0..3 {
            let instance = format!("sc.{}", AXES[axis]);
            let time = |w: &mut Deviations, rate: f64| w.offset_srf_m[axis] += rate * ELAPSED_S;
            TestSpacecraft::new().assert_matches_derivative::<OffsetDrift>(
                &instance,
                r#""with": "time", "since_ns": 0"#,
                &[&time],
            );
            // Spent fuel counts positive.
            let test_spacecraft = TestSpacecraft { fuel_change_kg: -2.3, ..TestSpacecraft::new() };
            let spent = |w: &mut Deviations, beta: f64| w.offset_srf_m[axis] += beta * 2.3;
            test_spacecraft.assert_matches_derivative::<OffsetDrift>(
                &instance,
                r#""with": "hk.fuel_kg", "since_ns": 0"#,
                &[&spent],
            );
        }
    }

    #[test]
    fn a_drift_candidate_has_a_form_for_time_and_each_column_in_kelvin_or_kilogram() {
        let test_spacecraft = TestSpacecraft::new();
        let setup = r#"{"instance": "sc.x", "candidate": true, "parameters": {"with": "time", "since_ns": 0}}"#;
        let setup = Setup::for_tests(setup).unwrap();
        let coefficients =
            OffsetDrift::coefficients(&setup, &test_spacecraft.mission, &test_spacecraft.available()).unwrap();
        let forms: Vec<_> =
            coefficients[0].forms.iter().map(|f| (f.shape["with"].as_str().unwrap(), f.unit.as_str())).collect();
        assert_eq!(forms, [("time", "m s-1"), ("hk.fuel_kg", "m kg-1")]);
    }

    const UNKNOWN_FORCE_SRF_N: [Vector3<f64>; 2] = [Vector3::new(0.4, -0.7, 0.0), Vector3::new(-0.5, 0.3, 0.0)];

    #[test]
    fn opening_angle_matches_the_derivative() {
        for tm in 0..2 {
            TestSpacecraft::new().assert_matches_derivative::<OpeningAngle>(
                &format!("tm{}", tm + 1),
                "",
                &[&|w, angle| w.opening_error_rad[tm] += angle],
            );
        }
    }

    /// With an unmodelled force the comparison uses the combinations that such a force does not reach: y of each test
    /// mass less the combination of the two optical axes along it.
    #[test]
    fn opening_angle_matches_the_derivative_under_an_unmodelled_force() {
        for tm in 0..2 {
            let test_spacecraft = TestSpacecraft { unknown_force_srf_n: UNKNOWN_FORCE_SRF_N, ..TestSpacecraft::new() };
            let form = test_spacecraft.forms::<OpeningAngle>(&format!("tm{}", tm + 1), "").remove(0).1;
            let truth = test_spacecraft.derivative(&|w, angle| w.opening_error_rad[tm] += angle);
            // The mission's optical axes are 1 rad apart: y_1 = (cos x_1 − x_2)/sin, y_2 = (x_1 − cos x_2)/sin.
            let free = |z: &[f64; 9]| {
                let (sin, cos) = 1.0f64.sin_cos();
                [z[1] - (cos * z[0] - z[3]) / sin, z[4] - (z[0] - cos * z[3]) / sin]
            };
            let close = |form: &Form| {
                let (got, want) = (free(&test_spacecraft.declared(form)), free(&truth));
                (0..2).all(|i| (got[i] - want[i]).abs() < 2e-5)
            };
            assert!(close(&form), "{:?} against {:?}", free(&test_spacecraft.declared(&form)), free(&truth));
            for i in 0..form.terms.len() {
                let mut other = form.clone();
                other.terms[i].factor = 0.0;
                assert!(!close(&other), "{:?} has no influence", form.terms[i]);
            }
        }
    }

    /// Known and unknown part of the declared series together are what the housing's rotation shows.
    #[test]
    fn in_prediction_mode_opening_angle_matches_the_derivative() {
        for tm in 0..2 {
            let test_spacecraft = TestSpacecraft {
                prediction: true,
                thruster_layout: true,
                unknown_force_srf_n: UNKNOWN_FORCE_SRF_N,
                ..TestSpacecraft::new()
            };
            test_spacecraft.assert_matches_derivative::<OpeningAngle>(
                &format!("tm{}", tm + 1),
                "",
                &[&|w, angle| w.opening_error_rad[tm] += angle],
            );
        }
    }

    #[test]
    fn a_drift_refuses_columns_of_other_units() {
        let test_spacecraft = TestSpacecraft::new();
        for (with, why) in [("hk.bus_v", "in V"), ("hk.nothing", "not a column"), ("tm1.r_orf_m.x", "not a column")] {
            let setup = setup("sc.x", &format!(r#""with": "{with}", "since_ns": 0"#));
            let error =
                OffsetDrift::coefficients(&setup, &test_spacecraft.mission, &test_spacecraft.available()).unwrap_err();
            assert!(error.message().contains(with) && error.message().contains(why), "{}", error.message());
        }
    }
}
