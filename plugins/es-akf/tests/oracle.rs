//! The structured step against the paper's equations as printed, in dense matrices.

mod common;

use common::{Alpha, DT_S, Epoch, Simulation, model, settings};
use dragfree_es_akf::filter::{Adaptation, Drive, Filter};
use dragfree_es_akf::model::{Coefficient, Model, Prior};
use dragfree_es_akf::shaping::{Chain, TorqueNoiseShaping};
use dragfree_physics::noise::NoiseTerm;
use nalgebra::{DMatrix, DVector, Matrix3, SMatrix, SVector, Vector3};
use rand::SeedableRng;
use rand_distr::{Distribution, StandardNormal};
use rand_xoshiro::Xoshiro256PlusPlus;

const N: usize = 22;
/// The printed `P̂_{k+1} − A P_k Aᵀ` has a grain of ε·P_rr, and P_rr grows as the noise-shaping states leak less. With
/// 0.1 mHz the grain stays below 1e-9 of `Q_rr` = q dt⁴/4; the low-rank form has no such limit.
const LEAK_HZ: f64 = 1e-4;
type Mat = SMatrix<f64, N, N>;
type State = SVector<f64, N>;

/// eqs Final_AKF_X_k to Final_AKF_p_k1, line by line, with `A_d` and `B_d` by the power series of the matrix
/// exponential of eq:extended_state_space.
struct Printed {
    /// `e^{A_n dt}` on the noise-shaping states, zero elsewhere.
    a_n: Mat,
    h: SMatrix<f64, 3, N>,
    x: State,
    p: Mat,
    q: Mat,
    r: Matrix3<f64>,
    s: Matrix3<f64>,
    alpha: f64,
}

impl Printed {
    fn new(model: &Model, alpha: f64) -> Self {
        let (mut q, mut p) = (Mat::zeros(), Mat::zeros());
        model.process_noise(|i, j, value| q[(i, j)] = value);
        model.prior_covariance(|i, j, value| p[(i, j)] = value);
        let mut h = SMatrix::zeros();
        let mut a_n = Mat::zeros();
        for i in 0..3 {
            h[(i, i)] = 1.0;
        }
        for (axis, first, chain) in model.placed_chains() {
            h[(axis, first)] = 1.0;
            for i in 0..chain.states() {
                a_n[(first + i, first + i)] = -std::f64::consts::TAU * LEAK_HZ;
                if i > 0 {
                    a_n[(first + i - 1, first + i)] = 1.0;
                }
            }
        }
        let noise_states = Mat::from_fn(|i, j| if i == j && i >= 12 { 1.0 } else { 0.0 });
        let (mut power, mut exponential) = (noise_states, Mat::zeros());
        for l in 0..12 {
            exponential += power;
            power = power * a_n * (DT_S / f64::from(l + 1));
        }
        let a_n = exponential;
        let r = Matrix3::from_diagonal(&Vector3::from_row_slice(&model.readout_m2));
        Self { a_n, h, x: State::zeros(), p, q, r, s: Matrix3::zeros(), alpha }
    }

    /// `A_d` and `B_d û`.
    fn discretised(&self, epoch: &Epoch) -> (Mat, State) {
        let mut a = SMatrix::<f64, 12, 12>::zeros();
        for i in 0..3 {
            a[(i, 3 + i)] = 1.0;
            a[(3 + i, 6 + i)] = 1.0;
            for j in 0..3 {
                a[(3 + i, 9 + j)] = epoch.phi[j][i];
            }
        }
        // A³ = 0 on [r, v, a_b, b], so e^{A dt} = I + A dt + A² dt²/2 and ∫ e^{A s} ds = dt I + A dt²/2 + A² dt³/6.
        let (identity, a2) = (SMatrix::<f64, 12, 12>::identity(), a * a);
        let mut a_d = self.a_n;
        a_d.fixed_view_mut::<12, 12>(0, 0).copy_from(&(identity + a * DT_S + a2 * (DT_S * DT_S / 2.0)));
        let integral = identity * DT_S + a * (DT_S.powi(2) / 2.0) + a2 * (DT_S.powi(3) / 6.0);
        let mut b_u = State::zeros();
        let force = SVector::<f64, 12>::from_fn(|i, _| if (3..6).contains(&i) { epoch.u_m_s2[i - 3] } else { 0.0 });
        b_u.fixed_rows_mut::<12>(0).copy_from(&(integral * force));
        (a_d, b_u)
    }

    /// The lines of one epoch, up to eq:Final_AKF_x_k1; the others need the next interval's `A_d`.
    fn correct(&mut self, readout_m: [f64; 3], learn: f64, adapt: bool) -> SMatrix<f64, N, 3> {
        let d = Vector3::from(readout_m) - self.h * self.x;
        self.s += (d * d.transpose() - self.s) * learn;
        let hph = self.h * self.p * self.h.transpose();
        if adapt {
            let r_iter = (self.s - hph) * (1.0 - self.alpha);
            self.r = self.r * self.alpha + r_iter.abs().zip_map(&self.r, f64::min);
        }
        let k = self.p * self.h.transpose() * (hph + self.r).try_inverse().expect("S is positive definite");
        self.x += k * d;
        k
    }

    fn predict(&mut self, epoch: &Epoch, k: &SMatrix<f64, N, 3>, adapt: bool) {
        let (a, b_u) = self.discretised(epoch);
        let carried = a * (Mat::identity() - k * self.h) * self.p * a.transpose();
        if adapt {
            let p_hat = carried + self.q;
            let q_iter = p_hat - a * self.p * a.transpose() + k * self.s * k.transpose();
            self.q = self.q * self.alpha + q_iter.abs().zip_map(&self.q, f64::min) * (1.0 - self.alpha);
        }
        self.p = carried + self.q;
        self.x = a * self.x + b_u;
    }
}

/// A million epochs of 22 states (4 + 3 + 3 for the readouts), adaptation on: the same estimates, to 1e-9 of their σ,
/// and the same covariances, to 1e-9 of the product of the σ, finite and exactly symmetric.
#[test]
fn a_million_steps_agree_with_the_printed_equations() {
    let model = model([&[4, 2, 2], &[4, 2], &[4, 2]], LEAK_HZ);
    assert_eq!(model.states(), N);
    let mut settings = settings(Adaptation::Monotone);
    settings.check_epochs = 0; // the printed equations repair nothing
    let mut fast = Filter::<24>::new(model.clone(), settings);
    let mut printed = Printed::new(&model, settings.forgetting);
    let mut data = Simulation::new(&model, Alpha::Coloured(1.0), 1);
    let (mut gain, mut adapt, mut learned) = (SMatrix::zeros(), false, 0_u64);
    let mut last: Option<Epoch> = None;
    let (half, epochs) = (settings.warm_up_epochs / 2, 1_000_000_u64);
    let mut worst = (0.0_f64, 0.0_f64);
    for k in 0..=epochs {
        let epoch = data.epoch();
        fast.step(epoch.readout_m, Drive { acceleration_m_s2: epoch.u_m_s2, regressors: &epoch.phi });
        if let Some(before) = &last {
            printed.predict(before, &gain, adapt);
            let first = learned < half;
            let learn = match (k > half, first) {
                (false, _) => 0.0,
                (true, true) => 1.0 / (learned + 1) as f64,
                (true, false) => 1.0 - settings.forgetting,
            };
            adapt = k > half && !first;
            learned += u64::from(k > half && first);
            gain = printed.correct(epoch.readout_m, learn, adapt);
        } else {
            for i in 0..3 {
                printed.x[i] = epoch.readout_m[i];
            }
        }
        last = Some(epoch);
        if k % 100_000 == 0 && k > 0 {
            let sigma = |i: usize| printed.p[(i, i)].sqrt();
            for i in 0..N {
                worst.0 = worst.0.max((fast.state()[i] - printed.x[i]).abs() / sigma(i));
                for j in 0..N {
                    assert_eq!(
                        fast.covariance(i, j).to_bits(),
                        fast.covariance(j, i).to_bits(),
                        "epoch {k}: P[{i}][{j}]"
                    );
                    let error = (fast.covariance(i, j) - printed.p[(i, j)]).abs() / (sigma(i) * sigma(j));
                    worst.1 = worst.1.max(error);
                }
            }
            assert!(worst.0 < 1e-9 && worst.1 < 1e-9, "epoch {k}: {worst:?}");
        }
    }
    for i in 0..N {
        for j in 0..=i {
            let scale = |m: &Mat| (m[(i, i)] * m[(j, j)]).sqrt();
            let error = (fast.process_noise(i, j) - printed.q[(i, j)]).abs();
            // Q of a long chain's output, of the order of dt⁷, lies below the grain of P from which it is made.
            assert!(error <= 1e-9 * scale(&printed.q) + 1e-14 * scale(&printed.p), "Q[{i}][{j}] is {error:e} off");
        }
    }
    assert_eq!(fast.statistics().updates, epochs);
}

#[test]
fn two_test_masses_with_coloured_torque_noise_agree_with_dense_matrices() {
    several_test_masses_agree_with_dense_matrices::<6>(20_000);
}

#[test]
fn three_test_masses_with_coloured_torque_noise_agree_with_dense_matrices() {
    several_test_masses_agree_with_dense_matrices::<9>(5_000);
}

/// Several test masses in one filter, under three thrusts and two coloured torques, two readouts missing now and then:
/// the filter that the model defines, in dense matrices, gives the same to 1e-9 of σ.
fn several_test_masses_agree_with_dense_matrices<const D: usize>(epochs: u32) {
    let mut rng = Xoshiro256PlusPlus::seed_from_u64(7);
    let mut normal = || -> f64 { StandardNormal.sample(&mut rng) };
    // Three thrusts along six axes, and a millionth of that on each axis alone.
    let pushed = DMatrix::from_fn(D, 3, |_, _| 1e-10 * normal());
    let thrust = &pushed * pushed.transpose();
    let chain = |asd, exponent| Chain::new(&NoiseTerm { asd, corner_hz: 1e-3, exponent }, LEAK_HZ, DT_S);
    let model = Model {
        dt_s: DT_S,
        acceleration_m2_s4: thrust + DMatrix::identity(D, D) * 1e-26,
        torque_noise: vec![
            TorqueNoiseShaping::new((0..D).map(|_| 3e-11 * normal()).collect(), 0.5, DT_S),
            TorqueNoiseShaping::new((0..D).map(|_| 3e-11 * normal()).collect(), 0.05, DT_S),
        ],
        bias_step_m2_s4: 1e-30,
        readout_m2: (0..D).map(|i| if i % 3 == 0 { 1e-23 } else { 1.6e-17 }).collect(),
        chains: (0..D).map(|i| vec![if i % 3 == 0 { chain(1e-12, 4) } else { chain(1.8e-9, 2) }]).collect(),
        coefficients: vec![Coefficient { initial: 0.05, prior_sigma: 0.1 }; 4],
        // Not far above what is measured, or the dense form's differences lose their digits.
        prior: Prior { displacement_m: 1e-10, velocity_m_s: 1e-10, bias_m_s2: 1e-10 },
    };
    let n = model.states();
    let theta = model.theta();
    assert_eq!((theta, n), (3 * D, 3 * D + 4 + 4 + 4 * D / 3));
    let settings = settings(Adaptation::Off);
    let mut fast = Filter::<48, D>::new(model.clone(), settings);

    let (mut q, mut p, mut h) = (DMatrix::zeros(n, n), DMatrix::zeros(n, n), DMatrix::zeros(D, n));
    model.prior_covariance(|i, j, value| p[(i, j)] = value);
    // Q from what acts in a step: the forces, held, and each torque noise's deviate on axes and states at once.
    model.process_noise(|i, j, value| {
        if (2 * D..theta).contains(&i) || i >= theta + 8 {
            q[(i, j)] = value;
        }
    });
    let held = DMatrix::from_fn(n, D, |s, i| match s {
        s if s == i => DT_S * DT_S / 2.0,
        s if s == D + i => DT_S,
        _ => 0.0,
    });
    q += &held * &model.acceleration_m2_s4 * held.transpose();
    let mut a_n = DMatrix::identity(n, n);
    for (first, noise) in model.placed_torque_noise() {
        let lever = DVector::from_row_slice(&noise.lever_m_s2);
        let mut acts = &held * &lever;
        for i in 0..2 {
            acts[first + i] = noise.drive()[i];
            (0..2).for_each(|j| a_n[(first + i, first + j)] = noise.transition()[i][j]);
        }
        a_n.column_mut(first).rows_mut(0, 2 * D).copy_from(&(&held * &lever * -1.0).rows(0, 2 * D));
        q += &acts * acts.transpose();
    }
    for (axis, first, chain) in model.placed_chains() {
        h[(axis, first)] = 1.0;
        for i in 0..chain.states() {
            for j in i..chain.states() {
                a_n[(first + i, first + j)] = chain.transition[j - i];
            }
        }
    }
    for i in 0..D {
        h[(i, i)] = 1.0;
        a_n[(i, D + i)] = DT_S;
        a_n[(i, 2 * D + i)] = DT_S * DT_S / 2.0;
        a_n[(D + i, 2 * D + i)] = DT_S;
    }
    let mut x = DVector::zeros(n);
    x.rows_mut(theta, 4).fill(0.05);
    let r = DMatrix::from_diagonal(&DVector::from_row_slice(&model.readout_m2));

    let mut worst = 0.0_f64;
    for k in 0..epochs {
        // Innovations of the covariance that the filter expects, so that estimates stay within a few σ.
        let expected = (&h * &p * h.transpose() + &r).cholesky().expect("definite").l();
        let predicted = &h * &x + expected * DVector::from_fn(D, |_, _| normal());
        let mut readout: [f64; D] = std::array::from_fn(|i| predicted[i]);
        if k % 10 == 3 {
            (readout[1], readout[3]) = (f64::NAN, f64::NAN);
        }
        // A soft controller: the rounding of a displacement must stay far below its σ.
        let u: [f64; D] = std::array::from_fn(|i| -0.01 * x[i] - 0.1 * x[D + i]);
        let phi: Vec<[f64; D]> = (0..4).map(|_| std::array::from_fn(|_| 1e-9 * normal())).collect();
        if k == 0 {
            (0..D).for_each(|i| x[i] = readout[i]);
        } else {
            let there: Vec<usize> = (0..D).filter(|i| readout[*i].is_finite()).collect();
            let (h, r) = (h.select_rows(&there), r.select_rows(&there).select_columns(&there));
            let d = DVector::from_iterator(there.len(), there.iter().map(|i| readout[*i])) - &h * &x;
            let s = &h * &p * h.transpose() + r;
            let gain = &p * h.transpose() * s.clone().try_inverse().expect("definite");
            x += &gain * d;
            p -= &gain * s * gain.transpose();
        }
        fast.step(readout, Drive { acceleration_m_s2: u, regressors: &phi });
        for (i, x) in x.iter().enumerate() {
            worst = worst.max((fast.state()[i] - x).abs() / p[(i, i)].sqrt());
        }
        assert!(worst < 1e-9, "epoch {k}: {worst:e}");
        let mut a = a_n.clone();
        for (j, phi) in phi.iter().enumerate() {
            a.column_mut(theta + j)
                .rows_mut(0, 2 * D)
                .copy_from(&(&held * DVector::from_row_slice(phi)).rows(0, 2 * D));
        }
        x = &a * x + &held * DVector::from_row_slice(&u);
        p = &a * p * a.transpose() + &q;
        p = (&p + p.transpose()) * 0.5;
    }
    for i in 0..n {
        for j in 0..n {
            assert_eq!(fast.covariance(i, j).to_bits(), fast.covariance(j, i).to_bits(), "P[{i}][{j}]");
        }
    }
}
