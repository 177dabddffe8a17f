//! One step of the ES-AKF with 22 states, full adaptation: by structure, and as printed in dense nalgebra.
//!
//! `dense` is the paper's recursion with the products in the cheapest order and nothing allocated; `structured` does
//! the same, and gates, counts and measures; `with sigma` follows the covariance behind the reported σ besides.

use std::hint::black_box;

use criterion::{Criterion, criterion_group, criterion_main};
use dragfree_es_akf::filter::{Adaptation, Drive, Filter, Settings};
use dragfree_es_akf::model::{Coefficient, Model, Prior};
use dragfree_es_akf::shaping::Chain;
use dragfree_physics::noise::NoiseTerm;
use nalgebra::{DMatrix, Matrix3, SMatrix, SVector, Vector3};

const N: usize = 22;
const DT_S: f64 = 0.1;
const PHI: [[f64; 3]; 3] = [[0.0, -1e-9, 2e-9], [1e-9, 0.0, -3e-9], [-2e-9, 3e-9, 0.0]];
const READOUT_M: [f64; 3] = [1e-12, -2e-9, 1e-9];
const U_M_S2: [f64; 3] = [0.0; 3];

fn model() -> Model {
    let exponents: [&[u32]; 3] = [&[4, 2, 2], &[4, 2], &[4, 2]];
    let asd = [1.42e-12, 1.8e-9, 1.8e-9];
    let chain = |asd, exponent| Chain::new(&NoiseTerm { asd, corner_hz: 1e-3, exponent }, 1e-4, DT_S);
    let q = (1e-7_f64 / 1500.0).powi(2) * 0.5 / DT_S;
    Model {
        dt_s: DT_S,
        acceleration_m2_s4: DMatrix::identity(3, 3) * q,
        torque_noise: Vec::new(),
        bias_step_m2_s4: 1e-30,
        readout_m2: asd.map(|a: f64| a * a * 0.5 / DT_S).to_vec(),
        chains: (0..3).map(|i| exponents[i].iter().map(|&p| chain(asd[i], p)).collect()).collect(),
        coefficients: vec![Coefficient { initial: 0.0, prior_sigma: 0.1 }; 3],
        prior: Prior { displacement_m: 1e-7, velocity_m_s: 1e-8, bias_m_s2: 1e-9 },
    }
}

fn structured(calibrated_sigma: bool) -> impl FnMut() {
    let settings = Settings {
        adaptation: Adaptation::Monotone,
        forgetting: 0.999_999,
        warm_up_epochs: 10,
        gate_sigma: 6.0,
        gate_patience: u32::MAX,
        calibrated_sigma,
        check_epochs: 6000,
    };
    let mut filter = Filter::<24>::new(model(), settings);
    move || {
        let next = Drive { acceleration_m_s2: black_box(U_M_S2), regressors: black_box(&PHI) };
        filter.step(black_box(READOUT_M), next);
    }
}

fn dense() -> impl FnMut() {
    type Mat = SMatrix<f64, N, N>;
    let model = model();
    let (mut q, mut p, mut a_n) = (Mat::zeros(), Mat::zeros(), Mat::identity());
    model.process_noise(|i, j, value| q[(i, j)] = value);
    model.prior_covariance(|i, j, value| p[(i, j)] = value);
    let mut h = SMatrix::<f64, 3, N>::zeros();
    for (axis, first, chain) in model.placed_chains() {
        h[(axis, first)] = 1.0;
        for i in 0..chain.states() {
            for j in i..chain.states() {
                a_n[(first + i, first + j)] = chain.transition[j - i];
            }
        }
    }
    for i in 0..3 {
        h[(i, i)] = 1.0;
        a_n[(i, 3 + i)] = DT_S;
        a_n[(3 + i, 6 + i)] = DT_S;
        a_n[(i, 6 + i)] = 0.5 * DT_S * DT_S;
    }
    let mut x = SVector::<f64, N>::zeros();
    let mut r = Matrix3::from_diagonal(&Vector3::from_row_slice(&model.readout_m2));
    let mut s = r;
    let alpha = 0.999_999;
    move || {
        let mut a = a_n;
        let (phi, u) = (black_box(PHI), black_box(U_M_S2));
        for i in 0..3 {
            for j in 0..3 {
                a[(3 + i, 9 + j)] = DT_S * phi[j][i];
                a[(i, 9 + j)] = 0.5 * DT_S * DT_S * phi[j][i];
            }
        }
        x = a * x;
        for i in 0..3 {
            x[i] += 0.5 * DT_S * DT_S * u[i];
            x[3 + i] += DT_S * u[i];
        }
        let d = Vector3::from(black_box(READOUT_M)) - h * x;
        s = s * alpha + d * d.transpose() * (1.0 - alpha);
        let ph = p * h.transpose();
        let hph = h * ph;
        let r_iter = (s - hph) * (1.0 - alpha);
        r = r * alpha + r_iter.abs().zip_map(&r, f64::min);
        let k = ph * (hph + r).try_inverse().unwrap_or_else(Matrix3::zeros);
        x += k * d;
        let apa = a * p * a.transpose();
        let carried = a * (p - k * ph.transpose()) * a.transpose();
        let q_iter = carried + q - apa + k * s * k.transpose();
        q = q * alpha + q_iter.abs().zip_map(&q, f64::min) * (1.0 - alpha);
        p = carried + q;
        black_box(&p);
    }
}

fn benches(c: &mut Criterion) {
    let mut group = c.benchmark_group("es-akf step, 22 states");
    group.sample_size(30);
    let (mut alone, mut with_sigma, mut printed) = (structured(false), structured(true), dense());
    group.bench_function("structured", |b| b.iter(&mut alone));
    group.bench_function("structured, with sigma", |b| b.iter(&mut with_sigma));
    group.bench_function("dense nalgebra", |b| b.iter(&mut printed));
    group.finish();
    // The best of many short stretches: what a step costs when nothing else runs, even on a busy machine.
    let seconds = |f: &mut dyn FnMut()| {
        let stretch = |_| {
            let start = std::time::Instant::now();
            (0..100).for_each(|_| f());
            start.elapsed().as_secs_f64() / 100.0
        };
        (0..2000).map(stretch).fold(f64::INFINITY, f64::min)
    };
    let [alone, with_sigma, dense] =
        [&mut alone as &mut dyn FnMut(), &mut with_sigma, &mut printed].map(|f| 1e6 * seconds(f));
    #[allow(clippy::print_stdout)] // the ratio is what this bench is for
    {
        println!("es-akf step: dense nalgebra {dense:.2} µs");
        println!("  structured {alone:.2} µs, 1/{:.1} of it", dense / alone);
        println!("  with sigma {with_sigma:.2} µs, 1/{:.1} of it", dense / with_sigma);
    }
}

criterion_group!(all, benches);
criterion_main!(all);
