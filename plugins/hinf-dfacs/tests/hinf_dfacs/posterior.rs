//! The smoother against the Gaussian posterior by dense least squares, with sensing and commands missing, and with the
//! sensing's coloured noise as states of its own.

use dragfree_hinf_dfacs::smoother::{Model, Smoothed, Smoother};
use dragfree_physics::noise::NoiseShape;
use nalgebra::{DMatrix, DVector, Matrix3, Vector3};
use std::f64::consts::TAU;

const DT_S: f64 = 0.1;
const EPOCHS: usize = 80;
const MOMENT_KG_M2: f64 = 800.0;
const TORQUE_PSD: f64 = 1e-14;
const SENSING_PSD: f64 = 2.5e-19;

fn sensed(k: usize) -> bool {
    !(20..33).contains(&k) && k != 50
}

fn commanded(k: usize) -> bool {
    k != 40 && k != 60
}

fn known(k: usize) -> f64 {
    1e-9 * (0.3 * k as f64).sin()
}

/// Anything will do: a mean is linear in the data.
fn attitude(k: usize) -> f64 {
    1e-9 * (0.11 * k as f64).cos() + 3e-10 * (1.7 * k as f64).sin() + 2e-10 * k as f64
}

/// The sensing's noise: its coloured part is as strong as the thrusters' at any frequency for exponent 4 at 80 mHz.
fn sensing(corner_hz: f64, exponent: u32) -> NoiseShape {
    NoiseShape::with_corner(SENSING_PSD.sqrt(), corner_hz, exponent)
}

/// Least squares over every unknown at once: attitude and rate at the start and after each missing command, `β_0` and
/// its steps, `w_k`, and the coloured noise `n` of exponent 2 (one state) or 4 (two), leaking at 1 µHz, with its steps.
/// Gives `β_k + w_k` and the rate of `θ + n`.
fn dense(corner_hz: f64, exponent: u32) -> (Vec<f64>, Vec<f64>) {
    let w_sigma = (TORQUE_PSD * 5.0).sqrt() / MOMENT_KG_M2;
    let step_sigma = w_sigma * TAU * 1e-4 * DT_S;
    let noise_sigma = (SENSING_PSD * 5.0).sqrt();
    let intensity = 0.5 * SENSING_PSD * (TAU * corner_hz).powi(exponent.cast_signed());
    let leak = (-TAU * 1e-6 * DT_S).exp();
    // θ_0, ω_0, β_0, then w_k, the step of β and two steps of n for each epoch, then θ and ω after each cut, then n.
    let unknowns = 3 + 4 * EPOCHS + 4 + 2;
    let mut sigma = DVector::from_element(unknowns, 0.0);
    let row = |at: usize| {
        let mut row = DVector::zeros(unknowns + 1);
        row[at] = 1.0;
        row
    };
    // Each state is a row over the unknowns, and in the last place what is known.
    let (mut theta, mut omega, mut beta) = (row(0), row(1), row(2));
    (sigma[0], sigma[1], sigma[2]) = (1e-2, 1e-4, 1e-6);
    let (mut coloured, mut rate) = (row(unknowns - 2), row(unknowns - 1));
    // Stationary behind the leak.
    let twice_leak = 2.0 * TAU * 1e-6;
    match exponent {
        2 => sigma[unknowns - 2] = (intensity / twice_leak).sqrt(),
        4 => {
            sigma[unknowns - 1] = (intensity / twice_leak).sqrt();
            sigma[unknowns - 2] = (2.0 * intensity / twice_leak.powi(3)).sqrt();
        }
        _ => {}
    }
    let mut cuts = 0;
    let mut equations = Vec::new();
    let (mut disturbances, mut omegas) = (Vec::new(), Vec::new());
    for k in 0..EPOCHS {
        if sensed(k) {
            equations.push((&theta + &coloured, attitude(k)));
        }
        let (w, step) = (3 + 4 * k, 4 + 4 * k);
        (sigma[w], sigma[step]) = (w_sigma, step_sigma);
        disturbances.push(&beta + row(w));
        omegas.push(&omega + &rate);
        if commanded(k) {
            let mut alpha = &beta + row(w);
            alpha[unknowns] += known(k);
            theta += &omega * DT_S + &alpha * (0.5 * DT_S * DT_S);
            omega += alpha * DT_S;
        } else {
            let fresh = 3 + 4 * EPOCHS + 2 * cuts;
            (theta, omega) = (row(fresh), row(fresh + 1));
            (sigma[fresh], sigma[fresh + 1]) = (1e-2, 1e-4);
            cuts += 1;
        }
        beta += row(step);
        // White noise of the intensity integrated once or twice over a sample: a step of variance `I dt`, and one of
        // position and rate with `[dt³/3, dt²/2; dt²/2, dt] I`, whose position is half the rate's step and `dt³/12` of
        // its own.
        let (first, second) = (5 + 4 * k, 6 + 4 * k);
        match exponent {
            2 => {
                sigma[first] = (intensity * DT_S).sqrt();
                coloured = coloured * leak + row(first);
            }
            4 => {
                (sigma[first], sigma[second]) = ((intensity * DT_S).sqrt(), (intensity * DT_S.powi(3) / 12.0).sqrt());
                coloured = (coloured + &rate * DT_S) * leak + row(first) * (0.5 * DT_S) + row(second);
                rate = rate * leak + row(first);
            }
            _ => {}
        }
    }
    let m = equations.len();
    let a = DMatrix::from_fn(m + unknowns, unknowns, |i, j| match i.checked_sub(m) {
        None => equations[i].0[j] * sigma[j] / noise_sigma,
        Some(prior) => f64::from(u8::from(prior == j)),
    });
    let b = DVector::from_fn(m + unknowns, |i, _| match equations.get(i) {
        Some((row, y)) => (y - row[unknowns]) / noise_sigma,
        None => 0.0,
    });
    let qr = a.qr();
    let scaled = qr.r().solve_upper_triangular(&(qr.q().transpose() * b)).expect("priors make it regular");
    let mean = |row: &DVector<f64>| row.rows(0, unknowns).dot(&scaled.component_mul(&sigma)) + row[unknowns];
    (disturbances.iter().map(mean).collect(), omegas.iter().map(mean).collect())
}

/// Three axes that are alike; the second carries minus the first and the third nothing.
fn axes() -> Vector3<f64> {
    Vector3::new(1.0, -1.0, 0.0)
}

fn smoothed(readout: &NoiseShape) -> Vec<Smoothed> {
    let disturbance = Matrix3::from_diagonal_element(TORQUE_PSD / MOMENT_KG_M2.powi(2));
    let mut smoother = Smoother::new(Model::new(&disturbance, readout, DT_S));
    for k in 0..EPOCHS {
        smoother.update(sensed(k).then_some(axes() * attitude(k)).as_ref());
        smoother.advance(commanded(k).then_some(axes() * known(k)).as_ref());
    }
    smoother.smooth(EPOCHS)
}

/// Largest differences from the posterior of disturbance and rate, over the largest of each.
fn errors(smoothed: &[Smoothed], (disturbances, omegas): &(Vec<f64>, Vec<f64>)) -> [f64; 2] {
    let scale = |x: &[f64]| x.iter().fold(0.0, |m: f64, x| m.max(x.abs()));
    let mut worst = [0.0_f64; 2];
    for (k, got) in smoothed.iter().enumerate() {
        // After a missing command the posterior of w is its prior.
        if commanded(k) {
            let error = (got.disturbance_rad_s2 - axes() * disturbances[k]).norm() / scale(disturbances);
            worst[0] = worst[0].max(error);
        }
        worst[1] = worst[1].max((got.omega_crf_rad_s - axes() * omegas[k]).norm() / scale(omegas));
    }
    worst
}

/// What the leak does to the posterior is of the order of its decay over the 8 s, 5e-5, of the part of noise; the other
/// terms are exact to the rounding of the dense solution.
#[test]
fn smoother_gives_the_posterior_mean() {
    for (corner_hz, exponent, bound) in [(0.0, 0, 1e-6), (2e-3, 4, 1e-6), (0.08, 4, 5e-5), (0.2, 2, 5e-5)] {
        let shape = sensing(corner_hz, exponent);
        let found = errors(&smoothed(&shape), &dense(corner_hz, exponent));
        assert!(found.iter().all(|e| *e < bound), "exponent {exponent} at {corner_hz} Hz: {found:?}");
    }
}

/// The twin: noise of the same strength that the smoother is not told of is taken for motion, by twenty times the bound
/// and more.
#[test]
fn a_smoother_without_colour_misses_the_posterior() {
    for (corner_hz, exponent) in [(0.08, 4), (0.2, 2)] {
        let found = errors(&smoothed(&sensing(0.0, 0)), &dense(corner_hz, exponent));
        assert!(found[0] > 1e-3, "exponent {exponent} at {corner_hz} Hz: {found:?}");
    }
}
