//! Instruments that show something else than what is: `is-scale`, `is-crosstalk`, `tilt-to-length`, `time-offset`.
//!
//! A readout error `δ(t)` adds its second difference to the channel. What is twice differenced here is **not** the readout: a
//! regressor made from the readout that it must explain fits that readout's own noise (a scale error of +0.96 on clean data).
//! It is the known motion: `û`, made of commands, which carry readout noise only into later samples, so that a fit over the whole
//! band is unbiased; `Φ b` of the model's offset, without which a scale error would not multiply the signal itself; and for capacitive
//! readouts the push `d` that nobody commanded, as the interferometers tell it: the loop works against it, so that what moves the
//! test mass is the small rest of `û + d`. With `û` alone a scale error of 15 % came out of six hours as 0.3 ± 0.1 %.

use dragfree_physics::mission::Mission;
use dragfree_sdk::prelude::*;

use crate::linear::{
    Linear, Motion, Part, Piece, Recipe, Series, Source, Term, accel, latest, motion, offset_terms, through_offset,
    tm_axis, tm_name, tm_pair, turn,
};

const SCALE: [f64; 2] = [-0.2, 0.2];
const LEVER_M: [f64; 2] = [-5e-3, 5e-3];
const DELAY_S: [f64; 2] = [0.0, 0.2];

const fn manifest(
    id: &'static str,
    description: &'static str,
    instances: &'static [&'static str],
    needs: &'static [&'static str],
) -> Manifest {
    let (version, licence) = (env!("CARGO_PKG_VERSION"), "MIT OR Apache-2.0");
    Manifest { id, version, licence, description, parameters: &[], instances, needs }
}

/// The second difference of the displacement along `from`, as known, in the channel of `to`.
fn shown(
    mission: &Mission,
    available: &Available,
    effect: &str,
    (tm, from, to): (usize, usize, usize),
) -> Result<Vec<Term>, PluginError> {
    let Some(Motion { known, push }) = motion(available, mission, tm, from) else {
        return Err(PluginError::error(format!(
            "effect {effect}: without the interferometers of both test masses nobody knows the thrusters' noise, and without that not \
             how a test mass moves; give telemetry with /ifo, or take the effect out of the model"
        )));
    };
    let term = |(piece, factor, times)| Term { channel: accel(tm, to), series: Piece::series(piece), factor, times };
    Ok(known.into_iter().chain(push).map(term).collect())
}

/// `is-scale`: the capacitive readout shows a displacement `r` as `(1 + s) r`.
///
/// `z = s r̈ = s (û + Φ b + d)` along the axis; s: 1, ±0.2. Other effects of the model move the test mass too: their products with `s`
/// are of second order. Confounders: gains of what pushes along the axis, `es-gain` above all.
///
/// **Limits.** `x` is read by the interferometer, so no residual shows its scale, and along `z` nothing tells `d`. The push `d` is in
/// the regressor and in the channel: only a fit that knows how `d` is common to both test masses can tell them apart. `qp-check`
/// does (clean data of six hours, eight times: 0.008 ± 0.004 in the mean, the 0.008 that its lowest bins, which it does not see, would
/// take back); `es-akf` follows each test mass alone and does not (0.48 ± 0.02), and the verdict says that they disagree.
#[derive(Debug)]
pub(crate) struct IsScaleRecipe(usize, usize);

/// See [`IsScaleRecipe`].
pub(crate) type IsScale = Linear<IsScaleRecipe>;

impl Recipe for IsScaleRecipe {
    const MANIFEST: Manifest = manifest(
        "is-scale",
        "The capacitive readout shows more or less of a displacement than there is",
        &["tm1.y", "tm2.y"],
        &["commands"],
    );

    fn new(setup: &Setup) -> Result<Self, PluginError> {
        let (tm, axis) = tm_axis(setup.instance());
        Ok(Self(tm, axis))
    }

    fn parts(&self, mission: &Mission, available: &Available) -> Result<Vec<Part>, PluginError> {
        Ok(Part::only("1", SCALE, shown(mission, available, "is-scale", (self.0, self.1, self.1))?))
    }
}

/// `is-crosstalk`: `tm1.y-z` shows `k` times the displacement along y in z too.
///
/// `z_to = k r̈_from = k (û + Φ b + d)_from`; k: 1, ±0.2. Into x nothing shows it, as the interferometer reads that; from z nothing
/// tells `d`.
#[derive(Debug)]
pub(crate) struct IsCrosstalkRecipe(usize, usize, usize);

/// See [`IsCrosstalkRecipe`].
pub(crate) type IsCrosstalk = Linear<IsCrosstalkRecipe>;

impl Recipe for IsCrosstalkRecipe {
    const MANIFEST: Manifest = manifest(
        "is-crosstalk",
        "The capacitive readout of one axis shows a part of the displacement along another one",
        &["tm1.x-y", "tm1.x-z", "tm1.y-z", "tm2.x-y", "tm2.x-z", "tm2.y-z"],
        &["commands"],
    );

    fn new(setup: &Setup) -> Result<Self, PluginError> {
        let (tm, from, to) = tm_pair(setup.instance());
        Ok(Self(tm, from, to))
    }

    fn parts(&self, mission: &Mission, available: &Available) -> Result<Vec<Part>, PluginError> {
        Ok(Part::only("1", SCALE, shown(mission, available, "is-crosstalk", (self.0, self.1, self.2))?))
    }
}

/// `tilt-to-length`: the interferometer shows `x + c θ + d ψ`.
///
/// `z_x = c θ̈ + d ψ̈` with the test mass's angles relative to its housing: `(θ̈, ψ̈) = (J_m⁻¹ M_E − T_S^O α̂)_{y,z}`, commanded
/// torque and the turn of the housing; rotational stiffness adds 1e-6 s⁻² of the angle, 1e-17 m s⁻² at the housing's 1e-8 rad.
/// Coefficients `.theta` and `.psi`, m rad⁻¹, ±5e-3.
///
/// **Degenerate with the offset**: `−T α̂` in x is what `com-offset` does there: `c` is as much `b_z`, `d` as much `−b_y` (1 mm/rad
/// = 1 mm) in x. What tells them apart is that the offset acts along y and z too and at frequencies below the test mass's
/// own attitude control, where it follows its housing.
#[derive(Debug)]
pub(crate) struct TiltToLengthRecipe(usize);

/// See [`TiltToLengthRecipe`].
pub(crate) type TiltToLength = Linear<TiltToLengthRecipe>;

impl Recipe for TiltToLengthRecipe {
    const MANIFEST: Manifest = manifest(
        "tilt-to-length",
        "The interferometer shows a part of the test mass's angles",
        &["tm1", "tm2"],
        &["commands"],
    );

    fn new(setup: &Setup) -> Result<Self, PluginError> {
        Ok(Self(tm_axis(setup.instance()).0))
    }

    fn parts(&self, mission: &Mission, available: &Available) -> Result<Vec<Part>, PluginError> {
        const BY: &str = "the effect tilt-to-length";
        let (tm, name) = (self.0, tm_name(self.0));
        let readout = Source::displacement(tm, 0).name;
        if latest(available, &readout).is_some_and(|c| c.attribute("noise") != "ifo_x") {
            return Err(PluginError::error(format!(
                "effect tilt-to-length: x of {name} is read by the inertial sensor, not by an interferometer; take it out of the model"
            )));
        }
        let test_mass = mission.test_mass(&name, BY)?;
        let (inverse, t) = (test_mass.inertia_inverse(&name, BY)?, test_mass.dcm_orf_from_srf());
        let part = |name: &'static str, angle: usize| {
            let torque = (0..3).map(|j| (Source::electrodes_torque(tm, j), inverse[(angle, j)]));
            let turn = (0..3).map(|j| (Source::alpha(j), -t[(angle, j)]));
            let both = torque.chain(turn);
            let terms = both.map(|(source, factor)| Term::new(accel(tm, 0), Series::Column(source), factor)).collect();
            Part::named(name, "m rad-1", LEVER_M, terms)
        };
        Ok(vec![part("theta", 1), part("psi", 2)])
    }
}

/// `time-offset`: what an instrument shows at `t` was true `τ` before.
///
/// A readout `r(t − τ)` has the second difference of `r` less `τ` times its rate: `z = −τ da/dt`, with `a = û + Φ b` the known
/// motion and `da/dt = (a_k − a_{k−1})/Δt`. Averaged over two samples as the channels are, this lies half a sample beside
/// the true difference: the error is orthogonal to the regressor at every frequency, and with it that of second order, so that
/// `τ` is unbiased up to one sample interval; at two it is small by `(1 + cos 2πfΔt)/2` of what drives it. τ: s, 0 to 0.2.
///
/// `ifo` acts on x of both test masses. `dws` acts on the
/// attitude channels, with `a` the angular acceleration that was commanded, `J_S⁻¹ M_T`, and through `α̂`, which is too late by
/// `τ ∂α̂/∂τ`: the test masses' channels, which have `Φ(α̂) b` explained, show `+τ [T ∂α̂/∂τ ×] b` more. Its local part, which reads the
/// test masses' angles, is in no channel.
///
/// **Limits.** What nobody commanded comes late too. In x alone its spectrum does not tell, but `qp-check` knows it to be common with y,
/// which is on time: 0.05 s of `ifo` came out of six hours as 0.027 ± 0.004 s (three seeds), of `es-akf` as 0.044 ± 0.006 s. A late
/// capacitive readout is not offered for that reason: it came out as nothing.
///
/// Confounders: a delay of the actuators, which `[thrusters]` of the mission file states, looks the same in all channels that the
/// actuator drives; gains at high frequency.
#[derive(Debug)]
pub(crate) struct TimeOffsetRecipe(String);

/// See [`TimeOffsetRecipe`].
pub(crate) type TimeOffset = Linear<TimeOffsetRecipe>;

impl Recipe for TimeOffsetRecipe {
    const MANIFEST: Manifest = manifest(
        "time-offset",
        "An instrument shows what was true some time before",
        &["ifo", "dws"],
        &["commands", "dws-delay-response"],
    );

    fn new(setup: &Setup) -> Result<Self, PluginError> {
        Ok(Self(setup.instance().to_owned()))
    }

    fn parts(&self, mission: &Mission, available: &Available) -> Result<Vec<Part>, PluginError> {
        const BY: &str = "the effect time-offset";
        let mut terms = Vec::new();
        if self.0 == "dws" {
            let inverse = mission.spacecraft.inertia_inverse();
            for (row, axis) in (0..3).flat_map(|row| (0..3).map(move |axis| (row, axis))) {
                let series = Series::Slope(Source::torque(axis), "N m s-1");
                terms.push(Term::new(turn(row), series, -inverse[(row, axis)]));
            }
            let response = |j| Series::Column(Source::alpha_by_dws_delay(j));
            terms.extend(through_offset(available, mission, BY, response, -1.0)?);
            return Ok(Part::only("s", DELAY_S, terms));
        }
        for (tm, axis) in (0..2).flat_map(|tm| (0..3).map(move |axis| (tm, axis))) {
            let column = latest(available, &Source::displacement(tm, axis).name);
            let reads = column.map_or("", |c| c.attribute("noise"));
            if !reads.starts_with("ifo") {
                continue;
            }
            terms.push(Term::new(accel(tm, axis), Series::Slope(Source::known(tm, axis), "m s-3"), -1.0));
            for (column, times) in offset_terms(available, tm, axis) {
                let series = Series::Slope(column, "s-3");
                terms.push(Term { channel: accel(tm, axis), series, factor: -1.0, times: Some(times) });
            }
        }
        Ok(Part::only("s", DELAY_S, terms))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bench::Bench;
    use crate::linear::AXES;
    use nalgebra::{Matrix3, Vector3};

    /// In the plane that the interferometers see.
    const GUST: [Vector3<f64>; 2] = [Vector3::new(0.4, -0.7, 0.0), Vector3::new(-0.5, 0.3, 0.0)];

    #[test]
    fn a_scale_multiplies_the_whole_motion_the_offsets_part_included() {
        for (tm, axis) in [(0, 1), (1, 1)] {
            let instance = format!("tm{}.{}", tm + 1, AXES[axis]);
            let bench = Bench { gust_srf_n: GUST, ..Bench::new() };
            bench.check::<IsScaleRecipe>(&instance, "", &[&|w, s| w.shown[tm][(axis, axis)] += s]);
        }
    }

    #[test]
    fn crosstalk_shows_the_first_axis_named_in_the_second() {
        for (tm, from, to) in [(0, 0, 1), (0, 1, 2), (1, 0, 1), (1, 0, 2)] {
            let instance = format!("tm{}.{}-{}", tm + 1, AXES[from], AXES[to]);
            let bench = Bench { gust_srf_n: GUST, ..Bench::new() };
            bench.check::<IsCrosstalkRecipe>(&instance, "", &[&|w, k| w.shown[tm][(to, from)] += k]);
        }
    }

    #[test]
    fn without_interferometers_nobody_knows_how_a_test_mass_moves() {
        let bench = Bench::new();
        let mut available = bench.available();
        for column in available.columns.iter_mut().filter(|c| c.attribute("noise") == "ifo_x") {
            column.attributes.insert("noise".to_owned(), "is_x".to_owned());
        }
        for error in [
            IsScaleRecipe(1, 1).parts(&bench.mission, &available).unwrap_err(),
            IsCrosstalkRecipe(0, 1, 2).parts(&bench.mission, &available).unwrap_err(),
        ] {
            assert!(error.message().contains("without the interferometers"), "{}", error.message());
        }
        let error = TiltToLengthRecipe(0).parts(&bench.mission, &available).unwrap_err();
        assert!(error.message().contains("x of tm1 is read by the inertial sensor"), "{}", error.message());
    }

    #[test]
    fn a_tilt_shows_the_test_masss_own_turn_less_that_of_its_housing() {
        for tm in 0..2 {
            let instance = format!("tm{}", tm + 1);
            let bench = Bench::new();
            bench.check::<TiltToLengthRecipe>(
                &instance,
                "",
                &[&|w, c| w.tilt_m_rad[tm][0] += c, &|w, d| w.tilt_m_rad[tm][1] += d],
            );
        }
    }

    #[test]
    fn a_late_readout_shows_less_of_what_grows() {
        let late = |channels: &'static [usize]| {
            move |w: &mut crate::bench::Wrong, tau: f64| channels.iter().for_each(|c| w.late_s[*c] += tau)
        };
        Bench::new().check::<TimeOffsetRecipe>("ifo", "", &[&late(&[0, 3])]);
        let sees = Matrix3::new(0.7, 0.1, -0.2, 0.1, 0.4, 0.05, -0.1, 0.2, 0.9);
        let bench = Bench { sees, torque_alone_varies: true, ..Bench::new() };
        bench.check::<TimeOffsetRecipe>("dws", "", &[&late(&[6, 7, 8])]);
    }

    /// A mass under accelerations that are held from sample to sample and repeat after `N`, sampled late by exact kinematics. What
    /// the second difference gains, projected on the averaged series, is the delay: exactly up to one sample, as the rest is
    /// orthogonal to it.
    #[test]
    fn the_delay_that_comes_out_is_exact_up_to_one_sample() {
        const N: usize = 64;
        const DT: f64 = 0.1;
        let mut a: [f64; N] = std::array::from_fn(|k| (1.7 * k as f64 + 0.3 * (k * k) as f64).sin());
        let mean = a.iter().sum::<f64>() / N as f64;
        a.iter_mut().for_each(|a| *a -= mean);
        // With a velocity of zero mean the place repeats too.
        let mut velocity = [0.0; N];
        for k in 1..N {
            velocity[k] = velocity[k - 1] + a[k - 1] * DT;
        }
        let drift = (0..N).map(|k| velocity[k] * DT + 0.5 * a[k] * DT * DT).sum::<f64>() / (N as f64 * DT);
        velocity.iter_mut().for_each(|v| *v -= drift);
        let mut place = [0.0; N];
        for k in 1..N {
            place[k] = place[k - 1] + velocity[k - 1] * DT + 0.5 * a[k - 1] * DT * DT;
        }
        let back = |k: usize, n: usize| (k + N - n) % N;
        let late = |k: usize, tau: f64| {
            let whole = (tau / DT).ceil() as usize;
            let (k, part) = (back(k, whole), whole as f64 * DT - tau);
            place[k] + velocity[k] * part + 0.5 * a[k] * part * part
        };
        let series = |k: usize| -(a[k] - a[back(k, 1)]) / DT;
        let projected = |tau: f64| {
            let (mut product, mut square) = (0.0, 0.0);
            for k in 0..N {
                let shown = (late((k + 1) % N, tau) - 2.0 * late(k, tau) + late(back(k, 1), tau)) / (DT * DT);
                let z = shown - 0.5 * (a[k] + a[back(k, 1)]);
                let phi = 0.5 * (series(k) + series(back(k, 1)));
                (product, square) = (product + phi * z, square + phi * phi);
            }
            product / square
        };
        for tau in [0.001, 0.03, 0.05, 0.1] {
            assert!((projected(tau) - tau).abs() < 1e-9, "{tau}: {}", projected(tau));
        }
        // Beyond, white motion shows that it is not.
        assert!((projected(0.2) - 0.2).abs() > 0.05, "{}", projected(0.2));
    }
}
