//! The smoother against the Gaussian posterior by dense least squares, with sensing and commands missing.

use dragfree_hinf_dfacs::smoother::{Model, Smoother};
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

/// Least squares over every unknown at once: attitude and rate at the start and after each missing command, `β_0` and
/// its steps, `w_k`. Gives `β_k + w_k` and `ω_k`.
fn dense() -> (Vec<f64>, Vec<f64>) {
    let w_sigma = (TORQUE_PSD * 5.0).sqrt() / MOMENT_KG_M2;
    let step_sigma = w_sigma * TAU * 1e-4 * DT_S;
    let noise_sigma = (SENSING_PSD * 5.0).sqrt();
    // θ_0, ω_0, β_0, then w_k and the step of β for each epoch, then θ and ω after each cut.
    let unknowns = 3 + 2 * EPOCHS + 4;
    let mut sigma = DVector::from_element(unknowns, 0.0);
    let row = |at: usize| {
        let mut row = DVector::zeros(unknowns + 1);
        row[at] = 1.0;
        row
    };
    // Each state is a row over the unknowns, and in the last place what is known.
    let (mut theta, mut omega, mut beta) = (row(0), row(1), row(2));
    (sigma[0], sigma[1], sigma[2]) = (1e-2, 1e-4, 1e-6);
    let mut cuts = 0;
    let mut equations = Vec::new();
    let (mut disturbances, mut omegas) = (Vec::new(), Vec::new());
    for k in 0..EPOCHS {
        if sensed(k) {
            equations.push((theta.clone(), attitude(k)));
        }
        let (w, step) = (3 + 2 * k, 4 + 2 * k);
        (sigma[w], sigma[step]) = (w_sigma, step_sigma);
        disturbances.push(&beta + row(w));
        omegas.push(omega.clone());
        if commanded(k) {
            let mut alpha = &beta + row(w);
            alpha[unknowns] += known(k);
            theta += &omega * DT_S + &alpha * (0.5 * DT_S * DT_S);
            omega += alpha * DT_S;
        } else {
            let fresh = 3 + 2 * EPOCHS + 2 * cuts;
            (theta, omega) = (row(fresh), row(fresh + 1));
            (sigma[fresh], sigma[fresh + 1]) = (1e-2, 1e-4);
            cuts += 1;
        }
        beta += row(step);
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

#[test]
fn smoother_gives_the_posterior_mean() {
    let inertia = Matrix3::from_diagonal_element(MOMENT_KG_M2);
    let mut smoother = Smoother::new(Model::new(&inertia, TORQUE_PSD, SENSING_PSD, DT_S));
    // The three axes are alike; the second carries minus the first and the third nothing.
    let axes = Vector3::new(1.0, -1.0, 0.0);
    for k in 0..EPOCHS {
        smoother.update(sensed(k).then_some(axes * attitude(k)).as_ref());
        smoother.advance(commanded(k).then_some(axes * known(k)).as_ref());
    }
    let (disturbances, omegas) = dense();
    let scale = |x: &[f64]| x.iter().fold(0.0, |m: f64, x| m.max(x.abs()));
    for (k, got) in smoother.smooth(EPOCHS).iter().enumerate() {
        // After a missing command the posterior of w is its prior.
        let want = if commanded(k) { axes * disturbances[k] } else { got.disturbance_rad_s2 };
        let error = (got.disturbance_rad_s2 - want).norm() / scale(&disturbances);
        assert!(error < 1e-6, "epoch {k}: {} against {want}", got.disturbance_rad_s2);
        let error = (got.omega_crf_rad_s - axes * omegas[k]).norm() / scale(&omegas);
        assert!(error < 1e-6, "epoch {k}: {} against {}", got.omega_crf_rad_s, omegas[k]);
    }
}
