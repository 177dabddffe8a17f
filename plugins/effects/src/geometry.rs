//! Geometry that is not as the mission has it: `offset-drift`, `opening-angle`.

use dragfree_physics::mission::Mission;
use dragfree_sdk::prelude::*;
use nalgebra::Vector3;

use crate::linear::{
    Driver, Form, Linear, Part, Piece, Recipe, Series, Source, Term, accel, motion, of_optical_axes, push, sc_axis,
    tm_axis, tm_name,
};

const RATE_M_S: [f64; 2] = [-2e-7, 2e-7];
const PER_KELVIN_M: [f64; 2] = [-2e-4, 2e-4];
/// A kilogram a metre and a half from the centre of a spacecraft of 1500 kg moves it by a millimetre.
const PER_KILOGRAM_M: [f64; 2] = [-2e-2, 2e-2];

/// `offset-drift`: both housings wander along an axis `e` of SRF as the centre of mass moves, `b_i^S(t) = b_i^S + k s(t) e`.
///
/// `z_i = −k s T_S^{O_i} (α̂ × e)`, eq:TM_SC_relative_acceleration; the terms in `ω²`, 1e-13 s⁻², and `b̈` and `2ω×ḃ`, below
/// 1e-15 m s⁻², are left out. What `s` is, the parameter `with` says:
/// * `time`: seconds from `since_ns`, by default from the first epoch of the run. k: m s⁻¹, ±2e-7. The offset of the model is then
///   that at this time: runs of several days add up in one solution only if all of them state the same `since_ns`.
/// * `hk.NAME`: a housekeeping column in K, what it has gained since its first value. k: m K⁻¹, ±2e-4. The offset is that at the
///   first value.
/// * a column in kg, what it has **lost** since its first value, as propellant spent. k: m kg⁻¹, ±2e-2.
///
/// The critic tries time and every such column. Confounders: each other, as all that is slow resembles a drift within a day.
#[derive(Debug)]
pub(crate) struct OffsetDriftRecipe {
    axis: usize,
    with: String,
    since_ns: Option<i64>,
    candidate: bool,
}

/// See [`OffsetDriftRecipe`].
pub(crate) type OffsetDrift = Linear<OffsetDriftRecipe>;

const TIME: &str = "time";

impl Recipe for OffsetDriftRecipe {
    const MANIFEST: Manifest = Manifest {
        id: "offset-drift",
        version: env!("CARGO_PKG_VERSION"),
        licence: "MIT OR Apache-2.0",
        description: "The centre of mass moves along an axis, with time, a temperature or the propellant spent",
        parameters: &[
            Parameter::text(
                "with",
                TIME,
                &[],
                "what the offset follows: `time`, or a housekeeping column `hk.NAME` in K or kg",
            ),
            Parameter::i64(
                "since_ns",
                "ns",
                0,
                0..=i64::MAX,
                "Unix time from which the drift counts; 0 is the first epoch of the run, other runs then cannot be added",
            ),
        ],
        instances: &["sc.x", "sc.y", "sc.z"],
        needs: &[],
    };

    fn new(setup: &Setup) -> Result<Self, PluginError> {
        Ok(Self {
            axis: sc_axis(setup.instance()),
            with: setup.text("with")?,
            since_ns: Some(setup.i64("since_ns")?).filter(|ns| *ns != 0),
            candidate: setup.candidate(),
        })
    }

    fn parts(&self, mission: &Mission, available: &Available) -> Result<Vec<Part>, PluginError> {
        let forms = if self.candidate {
            let followed = available
                .columns
                .iter()
                .filter(|c| c.table == "grid" && c.name.starts_with("hk.") && ["K", "kg"].contains(&c.unit.as_str()));
            std::iter::once(TIME).chain(followed.map(|c| c.name.as_str())).collect()
        } else {
            vec![self.with.as_str()]
        };
        let forms = forms.into_iter().map(|with| self.form(with, mission, available)).collect::<Result<_, _>>()?;
        Ok(vec![Part { name: "", forms }])
    }
}

impl OffsetDriftRecipe {
    fn form(&self, with: &str, mission: &Mission, available: &Available) -> Result<Form, PluginError> {
        let (driver, product, unit, range) = if with == TIME {
            (Driver::Time(self.since_ns), "rad s-1", "m s-1", RATE_M_S)
        } else {
            let column = available.column("grid", with).filter(|_| with.starts_with("hk."));
            match column.map(|c| (c, c.unit.as_str())) {
                Some((c, "K")) => {
                    (Driver::Growth { column: Source::of(c, "K"), lost: false }, "rad K s-2", "m K-1", PER_KELVIN_M)
                }
                Some((c, "kg")) => {
                    (Driver::Growth { column: Source::of(c, "kg"), lost: true }, "rad kg s-2", "m kg-1", PER_KILOGRAM_M)
                }
                found => {
                    return Err(PluginError::error(format!(
                        "effect offset-drift: with = \"{with}\" is {}; give \"time\", or a housekeeping column hk.NAME in K or kg",
                        found.map_or("no column of the telemetry".to_owned(), |(_, unit)| format!("in {unit}"))
                    )));
                }
            }
        };
        let mut terms = Vec::new();
        for tm in 0..2 {
            let Some(test_mass) = mission.test_mass.get(&tm_name(tm)) else { continue };
            let t = test_mass.dcm_orf_from_srf();
            for j in (0..3).filter(|j| *j != self.axis) {
                // −e_j × e, for a unit of α̂ about j.
                let unit = |axis: usize| Vector3::from_fn(|i, _| f64::from(i == axis));
                let per_turn: Vector3<f64> = -t * unit(j).cross(&unit(self.axis));
                terms.extend(push(tm, &Series::Times(Source::alpha(j), driver.clone(), product), &per_turn));
            }
        }
        let shape = Shape::from([("with".to_owned(), with.into())]);
        Ok(Form::new(shape, unit, range, terms))
    }
}

const OPENING_RAD: [f64; 2] = [-0.1, 0.1];

/// `opening-angle`: a test mass's frame, with its electrodes and its readouts, is turned by δ about s_3 beyond `T_S^O`.
///
/// What the housing's own acceleration does to the test mass, `a = û − F_E/m + Φ b + d` with the push `d` that nobody commanded, comes
/// from another direction: `z = −δ e_3 × a`, so `δ a_y` in x and `−δ a_x` in y. δ: rad, ±0.1.
///
/// `d_y` is told by the very x that it would explain, and a regressor made from the readout that it must explain fits that
/// readout's noise. But `d_x + δ d_y` is a push on the spacecraft as good as `d_x`: read so, x shows nothing of it, and y of each test
/// mass, which is `w_j` of the optical axis in question, shows `w_j δ d_y` less than that push would do. So x has the known part of
/// `a_y` alone.
///
/// **Limits.** `d` is known where both optical axes are read. `es-akf` follows each test mass alone, in which `d` and what is left of it
/// in y are one noise.
///
/// Confounders: `mps-tilt:sc.z` turns both test masses' forces alike; `is-crosstalk` of x in y; the offset's own direction.
#[derive(Debug)]
pub(crate) struct OpeningAngleRecipe(usize);

/// See [`OpeningAngleRecipe`].
pub(crate) type OpeningAngle = Linear<OpeningAngleRecipe>;

impl Recipe for OpeningAngleRecipe {
    const MANIFEST: Manifest = Manifest {
        id: "opening-angle",
        version: env!("CARGO_PKG_VERSION"),
        licence: "MIT OR Apache-2.0",
        description: "A test mass's optical axis points in another direction about s_3 than the mission says",
        parameters: &[],
        instances: &["tm1", "tm2"],
        needs: &["commands"],
    };

    fn new(setup: &Setup) -> Result<Self, PluginError> {
        Ok(Self(tm_axis(setup.instance()).0))
    }

    fn parts(&self, mission: &Mission, available: &Available) -> Result<Vec<Part>, PluginError> {
        let tm = self.0;
        let [x, y] = [0, 1].map(|axis| motion(available, mission, tm, axis));
        let weights = |body: usize| of_optical_axes(mission, body, 1).map(|w| w[tm]);
        let (Some(x), Some(y), Some(own), Some(others)) = (x, y, weights(tm), weights(1 - tm)) else {
            return Err(PluginError::error(
                "effect opening-angle: without the interferometers of both test masses nobody knows the thrusters' noise, and without \
                 that not how a housing moves; give telemetry with /ifo, or take the effect out of the model",
            ));
        };
        let mass_kg = mission.test_mass(&tm_name(tm), "the effect opening-angle")?.mass_kg;
        // The housing moves as the test mass without what the electrodes do to that.
        let electrodes = |axis: usize| (Series::Column(Source::electrodes_force(tm, axis)), -1.0 / mass_kg, None);
        let series = |part: Vec<(Piece, f64, Option<String>)>| {
            part.into_iter().map(|(piece, factor, times)| (piece.series(), factor, times))
        };
        let x: Vec<_> = series([x.known, x.push].concat()).chain([electrodes(0)]).collect();
        let known_y: Vec<_> = series(y.known).chain([electrodes(1)]).collect();
        let push_y: Vec<_> = series(y.push).collect();
        let rows =
            [((tm, 0), &known_y, 1.0), ((tm, 1), &x, -1.0), ((tm, 1), &push_y, -own), ((1 - tm, 1), &push_y, -others)];
        let mut terms: Vec<Term> = Vec::new();
        for ((to, axis), pieces, weight) in rows {
            for (series, factor, times) in pieces {
                let term = Term {
                    channel: accel(to, axis),
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
        Ok(Part::only("rad", OPENING_RAD, terms))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bench::{Bench, ELAPSED_S, Wrong};
    use crate::linear::AXES;

    #[test]
    fn an_offset_that_wanders_acts_by_what_it_has_wandered() {
        for axis in 0..3 {
            let instance = format!("sc.{}", AXES[axis]);
            let time = |w: &mut Wrong, rate: f64| w.offset_srf_m[axis] += rate * ELAPSED_S;
            Bench::new().check::<OffsetDriftRecipe>(&instance, r#""with": "time", "since_ns": 0"#, &[&time]);
            // Fuel that is spent counts positive.
            let bench = Bench { gained_kg: -2.3, ..Bench::new() };
            let spent = |w: &mut Wrong, beta: f64| w.offset_srf_m[axis] += beta * 2.3;
            bench.check::<OffsetDriftRecipe>(&instance, r#""with": "hk.fuel_kg", "since_ns": 0"#, &[&spent]);
        }
    }

    #[test]
    fn a_candidate_tries_time_and_every_column_of_a_unit_that_moves_masses() {
        let bench = Bench::new();
        let recipe = OffsetDriftRecipe { axis: 0, with: TIME.to_owned(), since_ns: None, candidate: true };
        let parts = recipe.parts(&bench.mission, &bench.available()).unwrap();
        let forms: Vec<_> =
            parts[0].forms.iter().map(|f| (f.shape["with"].as_str().unwrap(), f.unit.as_str())).collect();
        assert_eq!(forms, [("time", "m s-1"), ("hk.fuel_kg", "m kg-1")]);
    }

    const GUST: [Vector3<f64>; 2] = [Vector3::new(0.4, -0.7, 0.0), Vector3::new(-0.5, 0.3, 0.0)];

    #[test]
    fn a_frame_that_is_turned_sees_the_housings_acceleration_from_elsewhere() {
        for tm in 0..2 {
            Bench::new().check::<OpeningAngleRecipe>(
                &format!("tm{}", tm + 1),
                "",
                &[&|w, angle| w.opening_rad[tm] += angle],
            );
        }
    }

    /// With a push that nobody commanded, what is compared is what no such push reaches: y of each test mass less what its direction is of
    /// the two optical axes, by its angle to them.
    #[test]
    fn an_unknown_push_is_seen_from_elsewhere_too() {
        for tm in 0..2 {
            let bench = Bench { gust_srf_n: GUST, ..Bench::new() };
            let form = bench.forms::<OpeningAngleRecipe>(&format!("tm{}", tm + 1), "").remove(0).1;
            let truth = bench.derivative(&|w, angle| w.opening_rad[tm] += angle);
            // x_1 stands 1 rad before x_2 in this mission: y_1 = (cos x_1 − x_2)/sin, y_2 = (x_1 − cos x_2)/sin.
            let free = |z: &[f64; 9]| {
                let (sin, cos) = 1.0f64.sin_cos();
                [z[1] - (cos * z[0] - z[3]) / sin, z[4] - (z[0] - cos * z[3]) / sin]
            };
            let close = |form: &Form| {
                let (got, want) = (free(&bench.predicted(form)), free(&truth));
                (0..2).all(|i| (got[i] - want[i]).abs() < 2e-5)
            };
            assert!(close(&form), "{:?} against {:?}", free(&bench.predicted(&form)), free(&truth));
            for i in 0..form.terms.len() {
                let mut other = form.clone();
                other.terms[i].factor = 0.0;
                assert!(!close(&other), "{:?} says nothing", form.terms[i]);
            }
        }
    }

    #[test]
    fn a_column_that_moves_no_mass_is_refused_by_name() {
        let bench = Bench::new();
        for (with, why) in [("hk.bus_v", "in V"), ("hk.nothing", "no column"), ("tm1.r_orf_m.x", "no column")] {
            let recipe = OffsetDriftRecipe { axis: 0, with: with.to_owned(), since_ns: None, candidate: false };
            let error = recipe.parts(&bench.mission, &bench.available()).unwrap_err();
            assert!(error.message().contains(with) && error.message().contains(why), "{}", error.message());
        }
    }
}
