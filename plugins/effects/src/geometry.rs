//! Geometry that is not as the mission has it: `offset-drift`, `opening-angle`.

use dragfree_physics::mission::Mission;
use dragfree_sdk::prelude::*;
use nalgebra::Vector3;

use crate::linear::{
    Driver, Form, Linear, Part, Recipe, Series, Source, Term, accel, motion, of_optical_axes, push, sc_axis, tm_axis, tm_name,
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
/// `a_y` is told by the very x that it would explain, and a regressor made from the readout that it must explain fits that
/// readout's noise. But whatever x shows a push on the spacecraft may have done: the thrusters' noise is far above the interferometer's
/// where any other readout sees anything at all. So `δ a_y` in x is put as what y of both test masses shows less for it:
/// `−w_j δ a_y`, with the combination `y_j = Σ_i w_ji x_i` of the two optical axes. For one test mass alone, without knowing `d` from
/// both, that is no equation: `qp-check` fits it, `es-akf`, which follows each alone, does not.
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
        // The housing's acceleration along an axis: the test mass's motion without what its electrodes do.
        let housing = |axis: usize| {
            let mut pieces: Vec<_> = motion(available, mission, tm, axis)?
                .into_iter()
                .map(|(piece, factor, times)| (piece.series(), factor, times))
                .collect();
            let mass_kg = mission.test_mass.get(&tm_name(tm))?.mass_kg;
            pieces.push((Series::Column(Source::electrodes_force(tm, axis)), -1.0 / mass_kg, None));
            Some(pieces)
        };
        let weights = |tm: usize| of_optical_axes(mission, tm, 1);
        let (Some(x), Some(y), Some(own), Some(others)) = (housing(0), housing(1), weights(tm), weights(1 - tm)) else {
            return Err(PluginError::error(
                "effect opening-angle: without the interferometers of both test masses nobody knows the thrusters' noise, and without \
                 that not how a housing moves; give telemetry with /ifo, or take the effect out of the model",
            ));
        };
        let mut terms: Vec<Term> = Vec::new();
        for (to, pieces, weight) in [(tm, &x, -1.0), (tm, &y, -own[tm]), (1 - tm, &y, -others[tm])] {
            for (series, factor, times) in pieces {
                let term = Term {
                    channel: accel(to, 1),
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

    /// What x shows is put as a push on the spacecraft, so what is compared is what no such push reaches: y of each test mass less what
    /// its direction is of the two optical axes, by its angle to them.
    #[test]
    fn a_frame_that_is_turned_sees_the_housings_push_from_elsewhere() {
        for tm in 0..2 {
            // The electrodes' recoil on the spacecraft, 1/1000 in a real one, is not turned.
            let gust_srf_n = [Vector3::new(0.4, -0.7, 0.0), Vector3::new(-0.5, 0.3, 0.0)];
            let bench = Bench { electrodes: false, gust_srf_n, ..Bench::new() };
            let instance = format!("tm{}", tm + 1);
            let forms = bench.forms::<OpeningAngleRecipe>(&instance, "");
            let (truth, form) = (bench.derivative(&|w, angle| w.opening_rad[tm] += angle), &forms[0].1);
            assert!(form.terms.iter().all(|t| t.channel.ends_with("accel.y")), "{form:?}");
            // x_1 stands 1 rad before x_2 in this mission; y_1 = (x_2 − cos x_1)/sin up to sign, y_2 = (cos x_2 − x_1)/sin.
            let free = |z: &[f64; 9]| {
                let (sin, cos) = 1.0f64.sin_cos();
                [z[1] + (z[3] - cos * z[0]) / sin, z[4] + (cos * z[3] - z[0]) / sin]
            };
            let close = |form: &Form| {
                let (got, want) = (free(&bench.predicted(form)), free(&truth));
                (0..2).all(|i| (got[i] - want[i]).abs() < 2e-5)
            };
            assert!(close(form), "{:?} against {:?}", free(&bench.predicted(form)), free(&truth));
            // The electrodes are silent here and stand in it with what they are.
            for i in (0..form.terms.len()).filter(|i| !form.terms[*i].series.name().contains("force_orf_n")) {
                for factor in [-1.0, 0.0] {
                    let mut other = form.clone();
                    other.terms[i].factor *= factor;
                    assert!(!close(&other), "{:?} says nothing", form.terms[i]);
                }
            }
        }
    }

    #[test]
    fn what_the_electrodes_do_turns_with_the_frame() {
        let form = Bench::new().forms::<OpeningAngleRecipe>("tm1", "").remove(0).1;
        let factor = |name: &str| form.terms.iter().find(|t| t.series.name() == name).expect(name).factor;
        for axis in ["x", "y"] {
            // û holds F/m of 0.7 kg.
            let [force, known] = ["used.tm1.force_orf_n", "tm1.u_orf_m_s2"].map(|name| factor(&format!("{name}.{axis}")));
            assert!((force + known / 0.7).abs() < 1e-12 && known != 0.0, "{axis}: {force} {known}");
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
