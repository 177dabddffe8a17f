//! Noise-shaping states `n` of eq:readout_model: a readout's coloured noise as the output of driven chains.
//!
//! A term `asd² (f_c/f)^p` of a one-sided PSD is a chain of `p/2` integrators driven by white noise. Pure integrators
//! beside the double integrator of `r` would let the variance of the unobservable difference grow without bound, so
//! each integrator leaks at `ω_l`: `asd² f_c^p / (f² + f_l²)^{p/2}`, stationary, and equal to the term far above `f_l`.

use dragfree_physics::noise::NoiseTerm;
use nalgebra::{Complex, Matrix3, Vector3};

/// Chain of leaky integrators `ṅ_i = −ω_l n_i + n_{i+1}`, the last one driven by white noise; `n_0` is the output.
///
/// Everything here is exact for the continuous process sampled every `dt`.
#[derive(Clone, Debug, PartialEq)]
pub struct Chain {
    /// First row of the transition over one step, `e^{−ω_l dt} dt^l / l!`; the matrix is upper triangular and Toeplitz.
    pub transition: Vec<f64>,
    /// Covariance of what the drive adds in one step, row-major, unit².
    pub noise: Vec<f64>,
    /// Stationary covariance, row-major, unit².
    pub stationary: Vec<f64>,
}

impl Chain {
    /// The chain of one coloured term, leaking below `leak_hz`, sampled every `dt_s`.
    pub fn new(term: &NoiseTerm, leak_hz: f64, dt_s: f64) -> Self {
        let states = (term.exponent / 2) as usize;
        let tau = std::f64::consts::TAU;
        let leak = tau * leak_hz;
        // Two-sided intensity of the drive: half of the one-sided PSD asd² (2π f_c)^p.
        let drive = 0.5 * term.asd.powi(2) * (tau * term.corner_hz).powi(term.exponent.cast_signed());
        let decay = (-leak * dt_s).exp();
        let transition = (0..states).map(|l| decay * power_over_factorial(dt_s, l)).collect();
        let mut noise = vec![0.0; states * states];
        let mut stationary = vec![0.0; states * states];
        for i in 0..states {
            for j in 0..states {
                // An impulse of the drive reaches state i as e^{−ω_l s} s^a / a!.
                let (a, b) = (states - 1 - i, states - 1 - j);
                let scale = drive / (factorial(a) * factorial(b));
                noise[i * states + j] = scale * moment(a + b, 2.0 * leak, dt_s);
                stationary[i * states + j] = scale * factorial(a + b) / (2.0 * leak).powi(a as i32 + b as i32 + 1);
            }
        }
        Self { transition, noise, stationary }
    }

    /// Decay of each state over one step.
    pub fn decay(&self) -> f64 {
        self.transition.first().copied().unwrap_or(1.0)
    }

    /// Number of states.
    pub fn states(&self) -> usize {
        self.transition.len()
    }
}

/// The torque noise that the reconstructed angular acceleration leaves unknown, as a process of two states.
///
/// α̂ is the posterior mean given all wavefront sensing. With white torque noise of PSD `q` and white sensing noise of
/// PSD `r`, sampled every `dt`, its error has the PSD `q g r/(q c + g r)`, `g = |1 − z|⁴/dt⁴`, `c = |1 + z|²/4` (the
/// second difference of an attitude sees the mean of two samples). Its spectral factor is `√(q a₂) (1 − z⁻¹)²/A(z)`,
/// `A = 1 + a₁ z⁻¹ + a₂ z⁻²` the factor of the denominator with its zeros inside the unit circle: a Butterworth
/// high-pass where the corner lies far below Nyquist.
///
/// The white deviate acts at once, and the state `y` subtracts what the smoother knows of it:
/// `y ← y + μ d + β w`, `d ← (a₂ − μ²) d − μ y + (μ − β²/μ) w`, `β = 2 + a₁`, `μ² = A(1)`.
#[derive(Clone, Debug, PartialEq)]
pub struct TorqueNoiseShaping {
    /// Acceleration of each axis by one deviate, held for a step, m/s².
    pub lever_m_s2: Vec<f64>,
    /// `β`.
    beta: f64,
    /// `μ`.
    mu: f64,
    /// `a₂`.
    decay: f64,
}

impl TorqueNoiseShaping {
    /// Its states `y, d`; `y` alone acts.
    pub const STATES: usize = 2;

    /// What is left of white noise that acts with `lever_m_s2` (1σ, held for a step) by sensing whose noise crosses it
    /// at `crossover_rad_s`, the fourth root of the ratio of the two PSDs, `q/r`.
    pub fn new(lever_m_s2: Vec<f64>, crossover_rad_s: f64, dt_s: f64) -> Self {
        // With s = 2 − z − z⁻¹ the denominator is ρ s² + q (4 − s)/4, ρ = r/dt⁴: two roots s, each of a pair z, 1/z.
        let ratio = (crossover_rad_s * dt_s).powi(4);
        let middle = Complex::new(ratio / 8.0, 0.0);
        let apart = (middle * middle - Complex::new(ratio, 0.0)).sqrt();
        // λ = 1 − z, the smaller of the two, without cancellation.
        let [first, second] = [middle + apart, middle - apart].map(|s| {
            let root = (s * s * 0.25 - s).sqrt();
            let [a, b] = [s * 0.5 + root, s * 0.5 - root];
            if (Complex::new(1.0, 0.0) - a).norm() < 1.0 { a } else { b }
        });
        // A = (1 − z₁ z⁻¹)(1 − z₂ z⁻¹): β = λ₁ + λ₂, A(1) = λ₁ λ₂.
        let (beta, at_dc) = ((first + second).re, (first * second).re);
        let decay = 1.0 - beta + at_dc;
        let lever_m_s2 = lever_m_s2.into_iter().map(|l| l * decay.sqrt()).collect();
        Self { lever_m_s2, beta, mu: at_dc.sqrt(), decay }
    }

    /// Transition of `y, d` over one step.
    pub fn transition(&self) -> [[f64; 2]; 2] {
        [[1.0, self.mu], [-self.mu, 1.0 - self.beta]]
    }

    /// What one deviate adds to `y, d` in a step.
    pub fn drive(&self) -> [f64; 2] {
        [self.beta, self.mu - self.beta * self.beta / self.mu]
    }

    /// The transition as a diagonal and two shears after it: `y += first · d`, then `d += second · y`.
    pub fn factors(&self) -> ([f64; 2], [f64; 2]) {
        ([1.0, self.decay], [self.mu / self.decay, -self.mu])
    }

    /// Stationary covariance of `y, d`: the solution of `Σ = A Σ Aᵀ + g gᵀ`.
    pub fn stationary(&self) -> [[f64; 2]; 2] {
        let ([[a, b], [c, d]], [g, h]) = (self.transition(), self.drive());
        // Unknowns yy, yd, dd.
        let equations = Matrix3::new(
            1.0 - a * a,
            -2.0 * a * b,
            -b * b,
            -a * c,
            1.0 - a * d - b * c,
            -b * d,
            -c * c,
            -2.0 * c * d,
            1.0 - d * d,
        );
        let [yy, yd, dd] =
            equations.lu().solve(&Vector3::new(g * g, g * h, h * h)).unwrap_or_else(Vector3::zeros).into();
        [[yy, yd], [yd, dd]]
    }
}

fn factorial(n: usize) -> f64 {
    (1..=n).map(|i| i as f64).product()
}

fn power_over_factorial(x: f64, n: usize) -> f64 {
    x.powi(n as i32) / factorial(n)
}

/// `∫_0^T s^n e^{−c s} ds` as its power series: no cancellation while `c T` is small, as a leak of microhertz is.
fn moment(n: usize, c: f64, t: f64) -> f64 {
    let x = -c * t;
    let (mut power, mut sum, mut k) = (1.0, 0.0_f64, 0_usize);
    loop {
        let term = power / (n + k + 1) as f64;
        sum += term;
        k += 1;
        power *= x / k as f64;
        if power.abs() <= f64::EPSILON * sum.abs() || k > 200 {
            return t.powi(n as i32 + 1) * sum;
        }
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use nalgebra::{Complex, DMatrix};

    fn matrices(chain: &Chain) -> (DMatrix<f64>, DMatrix<f64>, DMatrix<f64>) {
        let n = chain.states();
        let a = DMatrix::from_fn(n, n, |i, j| if j >= i { chain.transition[j - i] } else { 0.0 });
        (a, DMatrix::from_row_slice(n, n, &chain.noise), DMatrix::from_row_slice(n, n, &chain.stationary))
    }

    /// The stationary covariance solves `Σ = A Σ Aᵀ + Q`. A leak of 0.1 Hz keeps the difference well conditioned.
    #[test]
    fn stationary_covariance_is_the_fixed_point() {
        for exponent in [2, 4, 6, 8] {
            let chain = Chain::new(&NoiseTerm { asd: 3.0, corner_hz: 0.2, exponent }, 0.1, 0.1);
            let (a, q, sigma) = matrices(&chain);
            let error = (&a * &sigma * a.transpose() + q - &sigma).norm() / sigma.norm();
            assert!(error < 1e-13, "exponent {exponent}: {error}");
        }
    }

    /// PSD of the sampled chain, `2 dt C (zI − A)⁻¹ Q (zI − A)⁻ᴴ Cᵀ`, against the shape it stands for.
    /// Far from the leak and from Nyquist the two agree to the order of `(f_l/f)²` and of the aliases.
    #[test]
    fn sampled_psd_is_the_shape() {
        let dt = 0.1;
        for exponent in [2, 4] {
            let term = NoiseTerm { asd: 1.8e-9, corner_hz: 1e-3, exponent };
            let (a, q, _) = matrices(&Chain::new(&term, 1e-6, dt));
            let n = a.nrows();
            for f in [1e-4, 1e-3, 1e-2, 0.1] {
                let z = Complex::from_polar(1.0, std::f64::consts::TAU * f * dt);
                let zia = DMatrix::from_fn(n, n, |i, j| {
                    Complex::new(-a[(i, j)], 0.0) + if i == j { z } else { Complex::new(0.0, 0.0) }
                });
                let inverse = zia.try_inverse().expect("no pole on the unit circle");
                let psd = (&inverse * q.map(|x| Complex::new(x, 0.0)) * inverse.adjoint())[(0, 0)].re * 2.0 * dt;
                let want = term.asd.powi(2) * (term.corner_hz / f).powi(exponent as i32);
                let bound = 3e-4 + (std::f64::consts::PI * f * dt).powi(2);
                assert!((psd / want - 1.0).abs() < bound, "exponent {exponent} at {f} Hz: {psd:e} against {want:e}");
            }
        }
    }

    /// Transfer from the deviate to the acceleration of the first axis, from the state space alone.
    pub(crate) fn gain(noise: &TorqueNoiseShaping, axis: usize, cycles_per_sample: f64) -> f64 {
        let z = Complex::from_polar(1.0, std::f64::consts::TAU * cycles_per_sample);
        let complex = |m: DMatrix<f64>| m.map(|x| Complex::new(x, 0.0));
        let transition = complex(DMatrix::from_fn(2, 2, |i, j| noise.transition()[i][j]));
        let drive = complex(DMatrix::from_row_slice(2, 1, &noise.drive()));
        let inverse = (DMatrix::identity(2, 2) * z - transition).try_inverse().expect("no pole on the unit circle");
        (noise.lever_m_s2[axis] * (Complex::new(1.0, 0.0) - (inverse * drive)[(0, 0)])).norm()
    }

    /// The spectrum is that of the smoother's error by Wiener's formula, from far below the crossover to Nyquist, with
    /// complex poles (sensing as good as torque noise below a quarter of the sample rate) and with real ones.
    #[test]
    fn the_error_of_the_smoothed_angular_acceleration_has_wieners_spectrum() {
        let dt = 0.1;
        for crossover_rad_s in [0.01, 0.45, 5.0, 27.0, 30.0, 80.0_f64] {
            let noise = TorqueNoiseShaping::new(vec![2.0], crossover_rad_s, dt);
            let (q, r) = (4.0, 4.0 / crossover_rad_s.powi(4));
            for f in [1e-4, 1e-3, 1e-2, 0.07, 0.3, 1.0, 3.0, 4.9] {
                let half = std::f64::consts::PI * f * dt;
                let (second_difference, mean) = ((2.0 * half.sin() / dt).powi(4), half.cos().powi(2));
                let want = q * second_difference * r / (q * mean + second_difference * r);
                let got = gain(&noise, 0, f * dt).powi(2);
                // Below the crossover 1 and what the states hold cancel, to (f/f_c)⁴ of them.
                assert!(
                    (got - want).abs() < 1e-9 * want + 1e-13 * q,
                    "{crossover_rad_s} rad/s at {f} Hz: {got:e}, {want:e}"
                );
            }
        }
    }

    #[test]
    fn torque_noise_starts_stationary_and_its_shears_are_its_transition() {
        for crossover_rad_s in [0.01, 0.45, 27.0, 80.0_f64] {
            let noise = TorqueNoiseShaping::new(vec![2.0], crossover_rad_s, 0.1);
            let matrix = |m: [[f64; 2]; 2]| DMatrix::from_fn(2, 2, |i, j| m[i][j]);
            let (a, sigma) = (matrix(noise.transition()), matrix(noise.stationary()));
            let drive = DMatrix::from_row_slice(2, 1, &noise.drive());
            let next = &a * &sigma * a.transpose() + &drive * drive.transpose();
            assert!((&next - &sigma).norm() < 1e-10 * sigma.norm(), "{sigma} is not stationary: {next}");
            assert!(sigma.symmetric_eigenvalues().min() > 0.0, "{sigma}");
            let ([d0, d1], [first, second]) = noise.factors();
            let sheared = DMatrix::from_row_slice(2, 2, &[1.0, 0.0, second, 1.0])
                * DMatrix::from_row_slice(2, 2, &[1.0, first, 0.0, 1.0])
                * DMatrix::from_row_slice(2, 2, &[d0, 0.0, 0.0, d1]);
            assert!((&sheared - &a).norm() < 1e-12 * a.norm(), "{sheared} against {a}");
        }
    }
}
