//! Effect `com-offset`: the offset `b_i` of a test mass's housing from the spacecraft's centre of mass.
//!
//! A point fixed in the spacecraft at `b` has the acceleration `Ω b`, `Ω = [α×] + [ω×][ω×]`. A free test mass does not
//! follow, so its displacement from the housing shows `−Ω b` (eq:TM_SC_relative_acceleration). Matrix `A` of
//! eq:extended_state_space is printed with the opposite sign and without the second term.

use dragfree_physics::frames::omega_matrix;
use dragfree_physics::mission::{Housing, Mission, TestMass};
use dragfree_sdk::prelude::*;
use nalgebra::{Matrix3, Vector3};
use serde_json::{Value, json};

use crate::columns::alpha_is_commanded;
use crate::common::{AXES, TEST_MASSES, manifest, mission, read_srf_vector};

/// Regressors `−Ω` in ORF, s⁻², 3 × 3: acceleration along axis `row`, m s⁻², per metre of offset along axis `column`.
///
/// `alpha_srf_rad_s2` is the mean over an interval and `omega_srf_rad_s` the rate in its middle. The result is the mean
/// over the interval up to `[α×]² Δt²/12`, which is negligible at the sample rates of drag-free control.
pub fn regressors(
    dcm_orf_from_srf: &Matrix3<f64>,
    alpha_srf_rad_s2: &Vector3<f64>,
    omega_srf_rad_s: &Vector3<f64>,
) -> Matrix3<f64> {
    -omega_matrix(&(dcm_orf_from_srf * omega_srf_rad_s), &(dcm_orf_from_srf * alpha_srf_rad_s2))
}

/// Coefficients of the offset in ORF, m. The ranges are the smallest that contain the mission's box.
fn coefficients(instance: &str, frame: &str, test_mass: &TestMass) -> [Coefficient; 3] {
    let nominal = test_mass.offset_nominal_orf_m();
    let half = test_mass.dcm_orf_from_srf().abs() * Vector3::from(test_mass.offset_box_srf_m);
    [0, 1, 2].map(|j| Coefficient {
        name: format!("com-offset.{instance}.{}", AXES[j]),
        unit: "m".to_owned(),
        frame: frame.to_owned(),
        lower: nominal[j] - half[j],
        upper: nominal[j] + half[j],
        initial: nominal[j],
        // The half width of the box as one standard deviation is a weak prior: the data dominate.
        prior_sigma: half[j],
        ..Coefficient::default()
    })
}

/// The mission's box in SRF: each component of `T_O^S b` within `offset_box` of the nominal offset.
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

/// This test mass's terms of the baseline survey `T_{O_1}^S b_1 − T_{O_2}^S b_2`, within its tolerance; `sign` is 1 for
/// the test mass at the end of the baseline and −1 for the one at its start. The engine adds
/// the terms of both test masses and applies the constraint only if both are present (`parts`).
fn baseline_constraints(instance: &str, sign: f64, test_mass: &TestMass, housing: &Housing) -> [Constraint; 3] {
    let srf_from_orf = test_mass.dcm_orf_from_srf().transpose();
    [0, 1, 2].map(|i| Constraint {
        name: format!("baseline.{}", AXES[i]),
        kind: Constraint::SURVEY.to_owned(),
        terms: terms(instance, &srf_from_orf, i, sign),
        lower: housing.baseline_srf_m[i] - housing.baseline_tolerance_m,
        upper: housing.baseline_srf_m[i] + housing.baseline_tolerance_m,
        unit: "m".to_owned(),
        parts: 2,
    })
}

/// Row `i` of a matrix as nonzero weights of the three coefficients.
fn terms(instance: &str, matrix: &Matrix3<f64>, i: usize, sign: f64) -> Vec<(String, f64)> {
    let weighted = (0..3).filter(|j| matrix[(i, *j)] != 0.0);
    weighted.map(|j| (format!("com-offset.{instance}.{}", AXES[j]), sign * matrix[(i, j)])).collect()
}

/// What the regressors lack where `α̂` is the commanded angular acceleration: their derivatives by its components, SRF,
/// as gains of the attitude channels. Terms in `ω` are of second order in what is unknown.
fn unpredicted_gains(dcm_orf_from_srf: &Matrix3<f64>) -> [[String; 3]; 3] {
    let by_alpha =
        [Vector3::x(), Vector3::y(), Vector3::z()].map(|unit| regressors(dcm_orf_from_srf, &unit, &Vector3::zeros()));
    let gains = |row: usize, j: usize| {
        let gain = |axis: usize| (format!("sc.alpha.{}", AXES[axis]), json!(by_alpha[axis][(row, j)]));
        Value::from_iter([0, 1, 2].map(gain)).to_string()
    };
    [0, 1, 2].map(|row| [0, 1, 2].map(|j| gains(row, j)))
}

#[derive(Debug)]
struct Handles {
    alpha: [In; 3],
    omega: [In; 3],
    /// Existing channels: row of the matrix, and an output column per coefficient.
    channels: Vec<(usize, [Out; 3])>,
    /// Time from `t_k` to the middle of the interval that a channel's sample averages, s.
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
    const MANIFEST: Manifest = manifest(
        "com-offset",
        "Offset of a test mass's housing from the spacecraft's centre of mass",
        &[],
        TEST_MASSES,
        &[],
    );

    fn new(setup: &Setup) -> Result<Self, PluginError> {
        let mission = mission(setup)?;
        let instance = setup.instance().to_owned();
        let dcm_orf_from_srf = mission.test_mass(&instance, "the effect com-offset")?.dcm_orf_from_srf();
        Ok(Self { instance, mission, dcm_orf_from_srf, handles: None })
    }

    fn link(&mut self, available: &Available, link: &mut EffectLink<'_, '_>) -> Result<(), PluginError> {
        let alpha = read_srf_vector(link, "sc.alpha_srf_rad_s2", "rad s-2")?;
        let omega = read_srf_vector(link, "sc.omega_srf_rad_s", "rad s-1")?;
        let test_mass = self.mission.test_mass(&self.instance, "the effect com-offset")?;
        let coefficients = coefficients(&self.instance, &self.mission.frame(&self.instance), test_mass);
        for coefficient in &coefficients {
            link.coefficient(coefficient)?;
        }
        let mut channels = Vec::new();
        let mut averaged = false;
        let lacks = unpredicted_gains(&self.dcm_orf_from_srf);
        let predicts = alpha_is_commanded(available);
        for (row, axis) in AXES.iter().enumerate() {
            let name = format!("{}.accel.{axis}", self.instance);
            let Some(channel) = available.of_kind("channel").find(|c| c.name == name) else { continue };
            averaged |= channel.attribute("average") == "2";
            let [x, y, z] = [0, 1, 2].map(|j| {
                let attributes = [(UNPREDICTED_ATTRIBUTE, lacks[row][j].as_str())];
                let attributes = if predicts { &attributes[..] } else { &[] };
                link.regressor_with(&coefficients[j].name, &name, "s-2", attributes)
            });
            channels.push((row, [x?, y?, z?]));
        }
        if channels.is_empty() {
            return Err(PluginError::error(format!(
                "effect com-offset:{0} acts on the channels {0}.accel.x, y and z, but no earlier stage writes any of them; put \
                 a stage that does (hinf-dfacs) before the effects in the pipeline, or remove {0} from the model",
                self.instance
            )));
        }
        for constraint in box_constraints(&self.instance, test_mass) {
            link.constraint(&constraint)?;
        }
        let mut ends = self.mission.baseline().into_iter().flatten().zip([1.0, -1.0]);
        let own = ends.find(|(name, _)| *name == self.instance);
        if let (Some((_, sign)), Some(housing)) = (own, &self.mission.housing) {
            for constraint in baseline_constraints(&self.instance, sign, test_mass, housing) {
                link.constraint(&constraint)?;
            }
        }
        let middle_s = if averaged { self.mission.dt_s() / 2.0 } else { 0.0 };
        self.handles = Some(Handles { alpha, omega, channels, middle_s });
        Ok(())
    }

    fn process(&mut self, input: &Inputs<'_>, output: &mut Outputs) -> Result<(), PluginError> {
        let Some(handles) = &self.handles else {
            return Err(PluginError::fatal("com-offset: process called before link"));
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

    /// Attitude of a tumbling body, inertial from SRF, as a product of plane rotations.
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

    /// The expected value is the second derivative of inertial positions, computed without `Ω`.
    #[test]
    fn regressors_match_differentiated_inertial_positions() {
        for (angle, b) in [(0.52, Vector3::new(0.09, 0.155, 0.0)), (-0.52, Vector3::new(0.091, -0.155, 0.02))] {
            let orf_from_srf = dcm_turned_about_z(angle);
            let b_srf = orf_from_srf.transpose() * b;
            for t in [0.3, 1.7, 4.1] {
                let velocity = move |t| derivative(move |t| attitude(t) * b_srf, t);
                let carried = orf_from_srf * attitude(t).transpose() * derivative(velocity, t);
                let (alpha, omega) = (derivative(rate, t), rate(t));
                let seen = regressors(&orf_from_srf, &alpha, &omega) * b;
                assert!((seen + carried).norm() < 1e-7 * carried.norm(), "{seen} against −{carried}");
                // A wrong sign or a missing term must fail.
                for (alpha_sign, omega_factor) in [(-1.0, 1.0), (1.0, 0.0), (0.0, 1.0)] {
                    let wrong = regressors(&orf_from_srf, &(alpha * alpha_sign), &(omega * omega_factor)) * b;
                    assert!((wrong + carried).norm() > 0.05 * carried.norm());
                }
            }
        }
    }

    /// Reference: Simpson's rule over the interval, exact for a quadratic.
    #[test]
    fn the_rate_at_mid_interval_gives_the_interval_mean() {
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

    /// Each corner of the box meets the constraints with equality and lies within the ranges.
    #[test]
    fn box_constraints_and_ranges_are_tight_at_the_corners() {
        let tm = test_mass(0.4, 0.18);
        let (constraints, ranges) = (box_constraints("tm1", &tm), coefficients("tm1", "ORF_1", &tm));
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

    /// The paper's offsets differ by exactly its baseline.
    #[test]
    fn baseline_terms_of_both_test_masses_add_up() {
        let housing: Housing =
            serde_json::from_str(r#"{"baseline_srf_m": [0.0, 0.36, 0.0], "baseline_tolerance_m": 2e-5}"#).unwrap();
        let third = std::f64::consts::FRAC_PI_6;
        let (tm1, tm2) = (test_mass(third, 0.18), test_mass(-third, -0.18));
        let b1 = Vector3::new(0.090_866_025_403_784_44, 0.155_384_572_681_198_96, 0.0);
        let b2 = Vector3::new(0.090_866_025_403_784_44, -0.155_384_572_681_198_96, 0.0);
        let offsets = [("tm1", b1), ("tm2", b2)];
        let parts =
            [baseline_constraints("tm1", 1.0, &tm1, &housing), baseline_constraints("tm2", -1.0, &tm2, &housing)];
        for i in 0..3 {
            let [one, two] = [&parts[0][i], &parts[1][i]];
            assert_eq!((one.lower, one.upper, &one.name, one.parts), (two.lower, two.upper, &two.name, 2));
            let baseline = value(one, &offsets) + value(two, &offsets);
            assert!((baseline - housing.baseline_srf_m[i]).abs() < 1e-12, "{i}: {baseline}");
            assert!((one.upper - one.lower - 4e-5).abs() < 1e-15);
        }
    }
}
