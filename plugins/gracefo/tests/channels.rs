//! Mathematics of the stage: sign of a channel and angular rate, each against an independent reference.

use std::path::PathBuf;

use dragfree_gracefo::Window;
use dragfree_gracefo::accelerometer::{AttitudeRate, BlockDifferences, channel_orf_m_s2, noise_block_differences};
use dragfree_gracefo::archive::Container;
use dragfree_gracefo::rows::{Rows, parse};
use dragfree_physics::noise::NoiseShape;
use nalgebra::{Matrix3, Rotation3, Vector3};

/// Acceleration measured by an accelerometer at an offset, by the matrix of GROOPS' program
/// SimulateAccelerometerCoMOffset (centrifugal, Euler, gravity gradient), written out element by element.
fn offset_acceleration(w: Vector3<f64>, wd: Vector3<f64>, gradient: Matrix3<f64>, d: Vector3<f64>) -> Vector3<f64> {
    let mut m = -gradient;
    m[(0, 0)] += -w.y * w.y - w.z * w.z;
    m[(0, 1)] += w.x * w.y - wd.z;
    m[(0, 2)] += w.x * w.z + wd.y;
    m[(1, 0)] += w.x * w.y + wd.z;
    m[(1, 1)] += -w.x * w.x - w.z * w.z;
    m[(1, 2)] += w.y * w.z - wd.x;
    m[(2, 0)] += w.x * w.z - wd.y;
    m[(2, 1)] += w.y * w.z + wd.x;
    m[(2, 2)] += -w.x * w.x - w.y * w.y;
    m * d
}

/// Reference: positions of spacecraft and free mass in an inertial frame, with the housing at `b`, differenced twice as
/// seen from the housing. The accelerometer measures GROOPS' acceleration plus the force on the spacecraft; its channel
/// must equal the second derivative of the displacement.
#[test]
fn the_channel_is_the_acceleration_of_a_free_mass() {
    let b = Vector3::new(0.3, -0.2, 0.4);
    let push = Vector3::new(2e-3, -1e-3, 3e-3);
    let (rate, growth) = (Vector3::new(0.03, 0.05, -0.02), Vector3::new(0.004, -0.006, 0.005));
    // SRF relative to IRF at time t, to second order in t, which suffices for differences about t = 0.
    let attitude = |t: f64| Rotation3::new(rate * t) * Rotation3::new(growth * (0.5 * t * t));
    // The mass starts at the housing's centre with its velocity; only the spacecraft is accelerated.
    let start = b;
    let velocity = rate.cross(&b);
    let seen = |t: f64| attitude(t).inverse() * (start + velocity * t - push * (0.5 * t * t)) - b;
    let dt = 1e-3;
    let second = (seen(dt) - 2.0 * seen(0.0) + seen(-dt)) / (dt * dt);

    let measured = push + offset_acceleration(rate, growth, Matrix3::zeros(), b);
    let channel = channel_orf_m_s2(&Matrix3::identity(), &measured);
    assert!((channel - second).norm() < 1e-8, "{channel} against {second}");
    assert!((-channel - second).norm() > 1e-3, "the other sign would not pass");
    // The regressors −α×b − ω×(ω×b) explain all of it but the force.
    let modelled = -growth.cross(&b) - rate.cross(&rate.cross(&b));
    assert!((channel - modelled + push).norm() < 1e-12);
}

/// A gravity gradient accelerates the free mass: `+Γ b` in the channel.
#[test]
fn the_gradient_has_the_sign_of_the_free_mass() {
    let gradient = Matrix3::from_diagonal(&Vector3::new(-1.0, -1.0, 2.0)) * 1.2e-6;
    let b = Vector3::new(1e-3, 2e-3, 3e-3);
    let measured = offset_acceleration(Vector3::zeros(), Vector3::zeros(), gradient, b);
    assert!((channel_orf_m_s2(&Matrix3::identity(), &measured) - gradient * b).norm() < 1e-20);
}

fn table(level: &str, code: &str) -> Rows {
    let path = PathBuf::from(env!("CARGO_MANIFEST_DIR"))
        .join(format!("../../fixtures/gracefo/gracefo_{level}_2023-06-01_RL04.ascii.noLRI.tgz"));
    let mut found = None;
    Container::open(&path)
        .expect("fixture")
        .visit(|member, text| {
            if member.product.code == code && member.spacecraft == 'C' {
                found = parse(text, member.product, 'C', Window::ALL).ok();
            }
        })
        .expect("whole archive");
    found.expect("the product").tables.remove(0)
}

/// The spacecraft points at its twin, so it rotates once per orbit about the orbit's normal. Axis, sense and rate by
/// the orbit GNI1B agree with the attitude SCA1B to milliradians; the inverse quaternion would rotate the other way.
#[test]
fn the_rate_from_the_attitude_matches_the_orbit() {
    let (attitude, orbit) = (table("1B", "SCA1B"), table("1B", "GNI1B"));
    let mut rate = AttitudeRate::default();
    let at = |rows: &Rows, first: usize, k: usize| Vector3::from([0, 1, 2].map(|i| rows.columns[first + i][k]));
    for k in 0..100 {
        assert_eq!(attitude.time_ns[k], orbit.time_ns[k]);
        let q = [0, 1, 2, 3].map(|i| attitude.columns[i][k]);
        let omega = rate.next(attitude.time_ns[k], q, 1_000_000_000);
        if k == 0 {
            assert!(omega.iter().all(|x| x.is_nan()), "no rate without a predecessor");
            continue;
        }
        let (r, v) = (at(&orbit, 0, k), at(&orbit, 6, k));
        let normal_irf = r.cross(&v) / r.norm_squared();
        let turn = nalgebra::UnitQuaternion::from_quaternion(nalgebra::Quaternion::new(q[0], q[1], q[2], q[3]));
        let normal_srf = turn.inverse() * normal_irf;
        assert!((omega - normal_srf).norm() < 0.01 * normal_srf.norm(), "{omega} against {normal_srf}");
    }
}

#[test]
fn the_rate_is_undefined_after_a_gap() {
    let mut rate = AttitudeRate::default();
    let q = |angle: f64| [(0.5 * angle).cos(), 0.0, (0.5 * angle).sin(), 0.0];
    let step = 100_000_000;
    assert!(rate.next(0, q(0.0), step).y.is_nan());
    assert!((rate.next(step, q(1e-4), step).y - 1e-3).abs() < 1e-12);
    // Either sign is the same attitude.
    assert!((rate.next(2 * step, q(2e-4).map(|x| -x), step).y - 1e-3).abs() < 1e-12);
    assert!(rate.next(4 * step, q(4e-4), step).y.is_nan(), "an epoch is missing");
    assert!(rate.next(5 * step, [f64::NAN; 4], step).y.is_nan());
    assert!(rate.next(6 * step, q(6e-4), step).y.is_nan(), "no attitude before");
    assert!((rate.next(7 * step, q(7e-4), step).y - 1e-3).abs() < 1e-12);
    assert!(rate.next(8 * step, [0.0; 4], step).y.is_nan(), "no quaternion at all");
}

/// White noise of one-sided PSD `S` has block means over m samples of variance `S/(2 m dt)`, and differences of twice
/// that.
#[test]
fn block_differences_of_noise_follow_its_spectrum() {
    let white = noise_block_differences(&NoiseShape::white(3e-8), 0.1);
    for (level, step) in white.iter().enumerate() {
        let want = 9e-16 / (0.1 * f64::from(1_u32 << level));
        assert!((step / want - 1.0).abs() < 1e-3, "{level}: {step:e} against {want:e}");
    }
    // A term in f⁻² at a block of one: asd² f_c² · 4π dt ∫₀^{π/2} sin²x/x² dx, and the integral is Si(π) − 2/π.
    let corner = noise_block_differences(&NoiseShape::with_corner(3e-8, 5.0, 2), 0.1)[0] - white[0];
    let want = 9e-16 * 25.0 * 4.0 * std::f64::consts::PI * 0.1 * (1.851_937_051_982_466 - std::f64::consts::FRAC_2_PI);
    assert!((corner / want - 1.0).abs() < 1e-5, "{corner:e} against {want:e}");
}

#[test]
fn block_differences_do_not_cross_gaps() {
    let run = |values: &[f64]| {
        let mut steps = BlockDifferences::default();
        for x in values {
            steps.next(&Vector3::new(*x, 0.0, 1.0));
        }
        steps.ratio_to_noise(&[1.0; 10])
    };
    assert_eq!(run(&[1.0; 8]), None, "seven steps are too few");
    // Nine differences of 2; that of 90 lies across the gap. Blocks of two have four differences and do not count.
    let mut values = vec![0.0, 2.0, 0.0, 2.0, 0.0, f64::NAN];
    values.extend([90.0, 92.0, 90.0, 92.0, 90.0, 92.0]);
    assert_eq!(run(&values), Some([4.0, 0.0, 0.0]));
}

/// In ten quiet seconds the angular acceleration of ACC1A is the noise that the mission file states, within its
/// statistics. A thruster pulse would show, and so would an oscillation of a tenth of the sample noise.
#[test]
fn real_quiet_data_are_mostly_noise() {
    let rows = table("1A", "ACC1A");
    let noise = noise_block_differences(&NoiseShape::with_corner(7e-8, 0.01, 2), 0.1);
    let ratio = |extra: &dyn Fn(usize) -> f64| {
        let mut steps = BlockDifferences::default();
        for k in 0..rows.time_ns.len() {
            steps.next(&Vector3::from([3, 4, 5].map(|i| rows.columns[i][k] + extra(k))));
        }
        steps.ratio_to_noise(&noise).expect("a hundred rows")
    };
    assert!(ratio(&|_| 0.0).iter().all(|r| *r < 3.0), "{:?}", ratio(&|_| 0.0));
    assert!(ratio(&|k| if k == 50 { 1e-5 } else { 0.0 }).iter().all(|r| *r > 10.0));
    assert!(ratio(&|k| 4e-7 * (std::f64::consts::TAU * k as f64 / 20.0).sin()).iter().all(|r| *r > 10.0));
}
