//! Effect `com-offset`: the offset `b_i` of a test mass's housing from the spacecraft's centre of mass.
//!
//! A point at `b` in a frame that turns with `ω` and `α` is accelerated by `Ω b`, `Ω = [α×] + [ω×][ω×]`; the free test
//! mass stays behind, and its displacement from the housing shows `−Ω b`
//! (eq:TM_SC_relative_acceleration; the matrix `A` of eq:extended_state_space is printed with the sign turned and
//! without the second term).

use dragfree_physics::frames::omega_matrix;
use dragfree_physics::mission::{Housing, Mission, TestMass};
use dragfree_sdk::prelude::*;
use nalgebra::{Matrix3, Vector3};

const AXES: [&str; 3] = ["x", "y", "z"];

/// `−Ω` in ORF, s⁻²: what one metre of offset along each axis of ORF (column) adds to the acceleration along each axis
/// of ORF (row), m s⁻².
///
/// `alpha_srf_rad_s2` is the mean over an interval, `omega_srf_rad_s` the rate in its middle; then this is the mean over
/// the interval but for `[α×]² Δt²/12`, 1e-22 s⁻² at 0.1 s and 1e-10 rad s⁻², a billionth of the signal.
#[must_use]
pub fn regressors(
    dcm_orf_from_srf: &Matrix3<f64>,
    alpha_srf_rad_s2: &Vector3<f64>,
    omega_srf_rad_s: &Vector3<f64>,
) -> Matrix3<f64> {
    -omega_matrix(&(dcm_orf_from_srf * omega_srf_rad_s), &(dcm_orf_from_srf * alpha_srf_rad_s2))
}

/// The three components of the offset in ORF, m: nominal values, and the intervals that hold the mission's box.
fn coefficients(instance: &str, test_mass: &TestMass) -> [Coefficient; 3] {
    let nominal = test_mass.offset_nominal_orf_m();
    let half = test_mass.dcm_orf_from_srf().abs() * Vector3::from(test_mass.offset_box_srf_m);
    [0, 1, 2].map(|j| Coefficient {
        name: format!("com-offset.{instance}.{}", AXES[j]),
        unit: "m".to_owned(),
        frame: frame(instance).to_owned(),
        lower: nominal[j] - half[j],
        upper: nominal[j] + half[j],
        initial: nominal[j],
        // The truth must lie in the box, so its half width as one standard deviation leaves the data the word.
        prior_sigma: half[j],
        ..Coefficient::default()
    })
}

/// The box of the mission, exact in SRF: `(T_O^S b)_i` within `offset_box` of the nominal offset.
fn box_constraints(instance: &str, test_mass: &TestMass) -> [Constraint; 3] {
    let srf_from_orf = test_mass.dcm_orf_from_srf().transpose();
    [0, 1, 2].map(|i| Constraint {
        name: format!("com-box.{instance}.{}", AXES[i]),
        kind: "range".to_owned(),
        terms: terms(instance, &srf_from_orf, i, 1.0),
        lower: test_mass.offset_nominal_srf_m[i] - test_mass.offset_box_srf_m[i],
        upper: test_mass.offset_nominal_srf_m[i] + test_mass.offset_box_srf_m[i],
        unit: "m".to_owned(),
        parts: 1,
    })
}

/// This test mass's part of `T_{O_1}^S b_1 − T_{O_2}^S b_2` = surveyed baseline within its tolerance. It takes both test
/// masses, so it counts only when both are in the model.
fn baseline_constraints(instance: &str, test_mass: &TestMass, housing: &Housing) -> [Constraint; 3] {
    let srf_from_orf = test_mass.dcm_orf_from_srf().transpose();
    let sign = if instance == "tm1" { 1.0 } else { -1.0 };
    [0, 1, 2].map(|i| Constraint {
        name: format!("baseline.{}", AXES[i]),
        kind: "survey".to_owned(),
        terms: terms(instance, &srf_from_orf, i, sign),
        lower: housing.baseline_srf_m[i] - housing.baseline_tolerance_m,
        upper: housing.baseline_srf_m[i] + housing.baseline_tolerance_m,
        unit: "m".to_owned(),
        parts: 2,
    })
}

/// Row `i` of a matrix as weights of the three coefficients, without zeros.
fn terms(instance: &str, matrix: &Matrix3<f64>, i: usize, sign: f64) -> Vec<(String, f64)> {
    let weighted = (0..3).filter(|j| matrix[(i, *j)] != 0.0);
    weighted.map(|j| (format!("com-offset.{instance}.{}", AXES[j]), sign * matrix[(i, j)])).collect()
}

fn frame(instance: &str) -> &'static str {
    if instance == "tm1" { "ORF_1" } else { "ORF_2" }
}

#[derive(Debug)]
struct Handles {
    alpha: [In; 3],
    omega: [In; 3],
    /// Per channel that exists: its row of the matrix, and a column per coefficient.
    channels: Vec<(usize, [Out; 3])>,
    /// From `t_k` to the middle of what a channel's sample averages, s.
    middle_s: f64,
}

/// The effect.
#[derive(Debug)]
pub struct ComOffset {
    instance: String,
    mission: Mission,
    dcm_orf_from_srf: Matrix3<f64>,
    handles: Option<Handles>,
}

impl Effect for ComOffset {
    const MANIFEST: Manifest = Manifest {
        id: "com-offset",
        version: env!("CARGO_PKG_VERSION"),
        licence: "MIT OR Apache-2.0",
        description: "Offset of a test mass's housing from the spacecraft's centre of mass",
        parameters: &[],
        instances: &["tm1", "tm2"],
        needs: &[],
    };

    fn new(setup: &Setup) -> Result<Self, PluginError> {
        let mission = Mission::from_json(setup.mission_json())?;
        let instance = setup.instance().to_owned();
        let dcm_orf_from_srf = mission.test_mass(&instance, "the effect com-offset")?.dcm_orf_from_srf();
        Ok(Self { instance, mission, dcm_orf_from_srf, handles: None })
    }

    fn link(&mut self, available: &Available, link: &mut EffectLink<'_, '_>) -> Result<(), PluginError> {
        let mut vector = |stem: &str, unit: &str| -> Result<[In; 3], PluginError> {
            let [x, y, z] = AXES.map(|axis| link.read(&Want::new(format!("{stem}.{axis}")).unit(unit).frame("SRF")));
            Ok([x?, y?, z?])
        };
        let alpha = vector("sc.alpha_srf_rad_s2", "rad s-2")?;
        let omega = vector("sc.omega_srf_rad_s", "rad s-1")?;
        let test_mass = self.mission.test_mass(&self.instance, "the effect com-offset")?;
        let coefficients = coefficients(&self.instance, test_mass);
        for coefficient in &coefficients {
            link.coefficient(coefficient)?;
        }
        let mut channels = Vec::new();
        let mut averaged = false;
        for (row, axis) in AXES.iter().enumerate() {
            let name = format!("{}.accel.{axis}", self.instance);
            let Some(channel) = available.of_kind("channel").find(|c| c.name == name) else { continue };
            averaged |= channel.attribute("average") == "2";
            let [x, y, z] = [0, 1, 2].map(|j| link.regressor(&coefficients[j].name, &name, "s-2"));
            channels.push((row, [x?, y?, z?]));
        }
        if channels.is_empty() {
            return Err(PluginError::error(format!(
                "effect com-offset:{0} acts on the channels {0}.accel.x, y and z, and no stage before it makes any of \
                 them; put hinf-dfacs, or another stage that does, before the effects, or take {0} out of the model",
                self.instance
            )));
        }
        for constraint in box_constraints(&self.instance, test_mass) {
            link.constraint(&constraint)?;
        }
        if let (2, Some(housing)) = (self.mission.test_mass.len(), &self.mission.housing) {
            for constraint in baseline_constraints(&self.instance, test_mass, housing) {
                link.constraint(&constraint)?;
            }
        }
        let middle_s = if averaged { self.mission.dt_s() / 2.0 } else { 0.0 };
        self.handles = Some(Handles { alpha, omega, channels, middle_s });
        Ok(())
    }

    fn process(&mut self, input: &Inputs<'_>, output: &mut Outputs) -> Result<(), PluginError> {
        let Some(handles) = &self.handles else {
            return Err(PluginError::fatal("com-offset: called before it was linked"));
        };
        let [alpha, omega] = [handles.alpha, handles.omega].map(|vector| vector.map(|axis| input.f64(axis)));
        for k in 0..input.rows() {
            let [alpha, omega] = [alpha, omega].map(|vector| Vector3::from(vector.map(|axis| axis[k])));
            let phi = regressors(&self.dcm_orf_from_srf, &alpha, &(omega + alpha * handles.middle_s));
            for (row, columns) in &handles.channels {
                for (j, column) in columns.iter().enumerate() {
                    output.f64(*column).push(phi[(*row, j)]);
                }
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use dragfree_physics::frames::dcm_turned_about_z;

    /// Attitude of a tumbling body, inertial from SRF, written out as products of plane rotations.
    fn attitude(t: f64) -> Matrix3<f64> {
        let (a, b, c) = (0.3 * (1.1 * t).sin() + 0.2 * t, 0.4 * (0.7 * t).cos(), 0.5 * (0.9 * t).sin() - 0.1 * t * t);
        let x = Matrix3::new(1.0, 0.0, 0.0, 0.0, a.cos(), -a.sin(), 0.0, a.sin(), a.cos());
        let y = Matrix3::new(b.cos(), 0.0, b.sin(), 0.0, 1.0, 0.0, -b.sin(), 0.0, b.cos());
        let z = Matrix3::new(c.cos(), -c.sin(), 0.0, c.sin(), c.cos(), 0.0, 0.0, 0.0, 1.0);
        x * y * z
    }

    /// First derivative of order four.
    fn derivative(f: impl Fn(f64) -> Vector3<f64>, t: f64) -> Vector3<f64> {
        let h = 1e-3;
        ((f(t - 2.0 * h) - f(t + 2.0 * h)) + (f(t + h) - f(t - h)) * 8.0) / (12.0 * h)
    }

    /// `ω` in SRF from `Rᵀ dR/dt`, read off its entries.
    fn rate(t: f64) -> Vector3<f64> {
        let column = |j: usize| derivative(move |t| attitude(t).column(j).into(), t);
        let spin = attitude(t).transpose() * Matrix3::from_columns(&[column(0), column(1), column(2)]);
        Vector3::new(spin[(2, 1)], spin[(0, 2)], spin[(1, 0)])
    }

    /// The housing is carried along the second derivative of its inertial position; a free mass beside it is not, so
    /// relative to the housing it falls the other way. Position differences know nothing of `Ω`.
    #[test]
    fn the_free_mass_stays_behind_the_point_that_the_body_carries_along() {
        for (angle, b) in [(0.52, Vector3::new(0.09, 0.155, 0.0)), (-0.52, Vector3::new(0.091, -0.155, 0.02))] {
            let orf_from_srf = dcm_turned_about_z(angle);
            let b_srf = orf_from_srf.transpose() * b;
            for t in [0.3, 1.7, 4.1] {
                let velocity = move |t| derivative(move |t| attitude(t) * b_srf, t);
                let carried = orf_from_srf * attitude(t).transpose() * derivative(velocity, t);
                let (alpha, omega) = (derivative(rate, t), rate(t));
                let seen = regressors(&orf_from_srf, &alpha, &omega) * b;
                assert!((seen + carried).norm() < 1e-7 * carried.norm(), "{seen} against −{carried}");
                // The test sees each sign and each term.
                for (alpha_sign, omega_factor) in [(-1.0, 1.0), (1.0, 0.0), (0.0, 1.0)] {
                    let wrong = regressors(&orf_from_srf, &(alpha * alpha_sign), &(omega * omega_factor)) * b;
                    assert!((wrong + carried).norm() > 0.05 * carried.norm());
                }
            }
        }
    }

    /// Mean over an interval of constant α by Simpson's rule, which is exact for a square, against the rate in its middle.
    #[test]
    fn the_rate_in_the_middle_gives_the_mean_over_the_interval() {
        let (alpha, omega, dt) = (Vector3::new(3e-3, -2e-3, 1e-3), Vector3::new(0.02, 0.5, -0.3), 0.1);
        let t = dcm_turned_about_z(0.5);
        let at = |tau: f64| regressors(&t, &alpha, &(omega + alpha * tau));
        let mean = (at(0.0) + at(dt / 2.0) * 4.0 + at(dt)) / 6.0;
        let bound = alpha.norm_squared() * dt * dt / 12.0;
        assert!((at(dt / 2.0) - mean).norm() <= 1.5 * bound);
        assert!((at(0.0) - mean).norm() > 1e3 * bound);
    }

    fn test_mass(angle: f64, y: f64) -> TestMass {
        let text = format!(
            r#"{{"mass_kg": 1.96, "orf_from_srf_angle_rad": {angle}, "offset_nominal_srf_m": [0.0, {y}, 0.0],
                "offset_box_srf_m": [0.02, 0.01, 0.03]}}"#
        );
        serde_json::from_str(&text).unwrap()
    }

    fn value(constraint: &Constraint, offsets: &[(&str, Vector3<f64>)]) -> f64 {
        let of = |name: &str| {
            let (instance, b) = offsets.iter().find(|(tm, _)| name.contains(tm)).unwrap();
            let axis = AXES.iter().position(|a| name == format!("com-offset.{instance}.{a}")).unwrap();
            b[axis]
        };
        constraint.terms.iter().map(|(name, weight)| weight * of(name)).sum()
    }

    /// The corners of the box in SRF: each meets the exact constraints with equality and lies within the ranges of the
    /// coefficients, some on their ends.
    #[test]
    fn the_box_holds_its_corners_and_no_more() {
        let tm = test_mass(0.4, 0.18);
        let (constraints, ranges) = (box_constraints("tm1", &tm), coefficients("tm1", &tm));
        let mut reached = [false; 6];
        for corner in 0..8 {
            let sign = |i: usize| if corner >> i & 1 == 1 { 1.0 } else { -1.0 };
            let shift = Vector3::from_fn(|i, _| sign(i) * tm.offset_box_srf_m[i]);
            let b_srf = Vector3::from(tm.offset_nominal_srf_m) + shift;
            let b = tm.dcm_orf_from_srf() * b_srf;
            for i in 0..3 {
                let bound = if sign(i) > 0.0 { constraints[i].upper } else { constraints[i].lower };
                assert!((value(&constraints[i], &[("tm1", b)]) - bound).abs() < 1e-15);
                let range = &ranges[i];
                assert!(range.lower - 1e-15 <= b[i] && b[i] <= range.upper + 1e-15);
                reached[i] |= (b[i] - range.lower).abs() < 1e-15;
                reached[3 + i] |= (b[i] - range.upper).abs() < 1e-15;
            }
        }
        assert!(reached.iter().all(|r| *r));
        assert_eq!(ranges[2].frame, "ORF_1");
        assert_eq!(ranges[0].name, "com-offset.tm1.x");
    }

    /// The paper's offsets differ by exactly its baseline; the parts of the two test masses add up to it.
    #[test]
    fn the_two_parts_of_the_baseline_add_up() {
        let housing: Housing =
            serde_json::from_str(r#"{"baseline_srf_m": [0.0, 0.36, 0.0], "baseline_tolerance_m": 2e-5}"#).unwrap();
        let third = std::f64::consts::FRAC_PI_6;
        let (tm1, tm2) = (test_mass(third, 0.18), test_mass(-third, -0.18));
        let b1 = Vector3::new(0.090_866_025_403_784_44, 0.155_384_572_681_198_96, 0.0);
        let b2 = Vector3::new(0.090_866_025_403_784_44, -0.155_384_572_681_198_96, 0.0);
        let offsets = [("tm1", b1), ("tm2", b2)];
        let parts = [baseline_constraints("tm1", &tm1, &housing), baseline_constraints("tm2", &tm2, &housing)];
        for i in 0..3 {
            let [one, two] = [&parts[0][i], &parts[1][i]];
            assert_eq!((one.lower, one.upper, &one.name, one.parts), (two.lower, two.upper, &two.name, 2));
            let baseline = value(one, &offsets) + value(two, &offsets);
            assert!((baseline - housing.baseline_srf_m[i]).abs() < 1e-12, "{i}: {baseline}");
            assert!((one.upper - one.lower - 4e-5).abs() < 1e-15);
        }
    }
}
