//! Thrusters one by one: the force that comes with their torque would pass for the offset.
//!
//! Loop and stage are linear, so that impulses of every thruster and every sensor through both give the exact offset
//! that a long record leads to where the truth has none.

use dragfree_hinf_dfacs::reconstruction::AngularAcceleration::Smoother;
use dragfree_hinf_dfacs::reconstruction::Row;
use dragfree_physics::frames::skew;
use dragfree_physics::mission::{Mission, ThrusterUnit, Thrusters};
use nalgebra::{Complex, Matrix3, Vector3};
use std::f64::consts::TAU;

use crate::common::{AttitudeLoop, DT_S, levels, mission, run, settings, stage};

const QUIET: usize = 40_321;
const AFTER: usize = 1 << 14;

pub(crate) fn layout() -> Thrusters {
    let text = include_str!("../../../../fixtures/missions/taiji-thrusters.toml");
    let value: serde_json::Value = toml::from_str(text).expect("the fixture is TOML");
    let mission = Mission::from_json(&value.to_string()).expect("the fixture is a mission");
    let thrusters = mission.thrusters.expect("the fixture has thrusters");
    // Here they do at once what they are told.
    Thrusters { lag_s: 0.0, delay_s: 0.0, step_n: 0.0, ..thrusters }
}

fn with(thrusters: Option<Thrusters>) -> Mission {
    Mission { thrusters, ..mission() }
}

/// Rows of the stage that is told a mission, after an impulse: of a thruster's thrust, 1e-7 N, or of a sensor, 1e-9
/// rad.
fn rows(told: &Mission, torque_nm: &Vector3<f64>, error_rad: &Vector3<f64>) -> Vec<Row> {
    let mut body = AttitudeLoop::new(&mission());
    let zero = Vector3::zeros();
    let of = |k: usize| if k == QUIET { (torque_nm, error_rad) } else { (&zero, &zero) };
    let epochs: Vec<_> = (0..QUIET + AFTER).map(|k| body.step(of(k).0, of(k).1).0).collect();
    run(&mut stage(told, &settings(Smoother)), &epochs)
}

/// Offset in SRF, m, that least squares finds in `z = −F/m_S − Δû` for `z = −α̂ × b`, all frequencies from 3 to 300 mHz
/// alike. `F` is the thrusters' noise and `Δû` what the stage adds to what is commanded.
fn offset_found(told: &Mission) -> Vector3<f64> {
    let units = layout().unit;
    let mission = mission();
    let dcm_srf_from_orf =
        mission.test_mass("tm1", "a test").expect("the fixture has it").dcm_orf_from_srf().transpose();
    let [_, sensing] = levels(&mission);
    let mut information = Matrix3::zeros();
    let mut right = Vector3::zeros();
    for input in 0..units.len() + 3 {
        let (mut force, mut torque, mut error) = (Vector3::zeros(), Vector3::zeros(), Vector3::zeros());
        let level = match units.get(input) {
            Some(ThrusterUnit { position_srf_m, direction_srf, asd_n_rthz }) => {
                force = Vector3::from(*direction_srf).normalize() * 1e-7;
                torque = Vector3::from(*position_srf_m).cross(&force);
                (asd_n_rthz / 1e-7).powi(2)
            }
            None => {
                error[input - units.len()] = 1e-9;
                sensing / 1e-18
            }
        };
        let (whole, commanded) = (rows(told, &torque, &error), rows(&with(None), &torque, &error));
        let alpha = |k: usize| Vector3::from_column_slice(&whole[k].values[..3]);
        let added = |k: usize| {
            let u = |rows: &[Row]| Vector3::from_column_slice(&rows[k].values[9..12]);
            let noise = if k == QUIET { force / mission.spacecraft.mass_kg } else { Vector3::zeros() };
            -noise - dcm_srf_from_orf * (u(&whole) - u(&commanded))
        };
        for point in 0..40 {
            let f = 3e-3 * 100_f64.powf((f64::from(point) + 0.5) / 40.0);
            let spectrum = |of: &dyn Fn(usize) -> Vector3<f64>| {
                let mut sum = Vector3::<Complex<f64>>::zeros();
                for k in QUIET - 4000..QUIET + AFTER {
                    let phase = Complex::cis(-TAU * (f * DT_S * k as f64).fract());
                    sum += of(k).map(|x| phase * x);
                }
                (sum.map(|x| x.re), sum.map(|x| x.im))
            };
            let (a, z) = (spectrum(&alpha), spectrum(&added));
            for (a, z) in [(a.0, z.0), (a.1, z.1)] {
                // Points are even in ln f.
                let regressors = -skew(&a);
                information += regressors.transpose() * regressors * (level * f);
                right += regressors.transpose() * z * (level * f);
            }
        }
    }
    information.try_inverse().expect("all axes turn") * right
}

/// At 3 mHz the smoother gives (0.1 mHz/f)² = 1.1e-3 of the noise to its wandering torque, with which no force comes,
/// and less above: so much of the twin's 5.6 mm may be left.
#[test]
fn the_force_that_comes_with_a_torque_is_known() {
    let found = offset_found(&with(Some(layout())));
    assert!(found.norm() < 6.2e-6, "{found}");
}

/// The twins: without the term, and with thrusters told to sit on the other side.
#[test]
fn untold_it_passes_for_an_offset() {
    let untold = offset_found(&with(None));
    let mut other = layout();
    for unit in &mut other.unit {
        unit.position_srf_m = unit.position_srf_m.map(|x| -x);
    }
    let turned = offset_found(&with(Some(other)));
    assert!(untold.norm() > 5e-3, "{untold}");
    assert!(turned.norm() > 1.5 * untold.norm(), "{turned}");
}
