//! Noise-shaping states `n` of eq:readout_model: a readout's coloured noise as the output of driven chains.
//!
//! A term `asd² (f_c/f)^p` of a one-sided PSD is a chain of `p/2` integrators driven by white noise. Pure integrators
//! beside the double integrator of `r` would let the variance of the unobservable difference grow without bound, so
//! each integrator leaks at `ω_l`: `asd² f_c^p / (f² + f_l²)^{p/2}`, stationary, and equal to the term far above `f_l`.

use dragfree_physics::noise::NoiseTerm;

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
    #[must_use]
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
    #[must_use]
    pub fn decay(&self) -> f64 {
        self.transition.first().copied().unwrap_or(1.0)
    }

    /// Number of states.
    #[must_use]
    pub fn states(&self) -> usize {
        self.transition.len()
    }
}

/// White noise that is known from somewhere else where it is slow: `(s/(s + ω))²` of it is left.
///
/// That is what an estimate of an angular acceleration leaves, made of angles with white noise: torques above ω, hardly anything below,
/// where the error of the estimate falls with `(f/f_c)²`. The torque acts at once, its slow part is taken away by two states,
/// `e = w − l₁ − l₂`, `l₁ ← a l₁ + g w`, `l₂ ← a l₂ + g (w − l₁)` with `a = e^{−ω dt}`, `g = 1 − a`, which is `((1 − z⁻¹)/(1 − a z⁻¹))²`.
#[derive(Clone, Debug, PartialEq)]
pub struct Shaking<const D: usize = 3> {
    /// What one σ of the white noise, held for a step, does to each axis, m/s².
    pub lever_m_s2: [f64; D],
    decay: f64,
}

impl<const D: usize> Shaking<D> {
    /// Its states `l₂, l₁`.
    pub const STATES: usize = 2;

    /// Noise of which `lever_m_s2` is one σ at Nyquist, held for a step of `dt_s`, known below `corner_rad_s`.
    #[must_use]
    pub fn new(lever_m_s2: [f64; D], corner_rad_s: f64, dt_s: f64) -> Self {
        let decay = (-corner_rad_s * dt_s).exp();
        // At Nyquist each stage has the gain 2/(1 + a).
        let whole = (0.5 * (1.0 + decay)).powi(2);
        Self { lever_m_s2: lever_m_s2.map(|l| l * whole), decay }
    }

    /// `a`, of each state over one step.
    #[must_use]
    pub fn decay(&self) -> f64 {
        self.decay
    }

    /// `g`: what the noise adds to each state in one step, and what `l₁` takes from `l₂`.
    #[must_use]
    pub fn gain(&self) -> f64 {
        1.0 - self.decay
    }

    /// Stationary covariance of `l₂, l₁`: the fixed point of their recursion.
    #[must_use]
    pub fn stationary(&self) -> [[f64; 2]; 2] {
        let (a, g) = (self.decay, self.gain());
        let lost = 1.0 - a * a;
        let first = g * g / lost;
        let cross = (g * g - a * g * first) / lost;
        let second = (g * g * first + g * g - 2.0 * a * g * cross) / lost;
        [[second, cross], [cross, first]]
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
mod tests {
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

    /// Spectrum and stationary covariance of what is left of white noise, from its own state space: `((1 − z⁻¹)/(1 − a z⁻¹))²`, one at
    /// Nyquist, `(f/f_c)⁴` far below the corner.
    #[test]
    fn what_is_known_where_it_is_slow_is_gone_there() {
        let (dt, corner) = (0.1, 0.5_f64);
        let shaking = Shaking::new([2.0], corner, dt);
        let (a, g) = (shaking.decay(), shaking.gain());
        let transition = DMatrix::from_row_slice(2, 2, &[a, -g, 0.0, a]);
        let drive = DMatrix::from_row_slice(2, 1, &[g, g]);
        let stationary = DMatrix::from_fn(2, 2, |i, j| shaking.stationary()[i][j]);
        let next = &transition * &stationary * transition.transpose() + &drive * drive.transpose();
        assert!((&next - &stationary).norm() < 1e-14 * stationary.norm(), "{stationary} is not stationary: {next}");
        let gain = |f: f64| {
            let z = Complex::from_polar(1.0, std::f64::consts::TAU * f * dt);
            let complex = |m: &DMatrix<f64>| m.map(|x| Complex::new(x, 0.0));
            let zia = DMatrix::identity(2, 2) * z - complex(&transition);
            let inverse = zia.try_inverse().expect("no pole on the unit circle");
            let slow = DMatrix::from_element(1, 2, Complex::new(1.0, 0.0)) * inverse * complex(&drive);
            (shaking.lever_m_s2[0] * (Complex::new(1.0, 0.0) - slow[(0, 0)])).norm()
        };
        assert!((gain(5.0) - 2.0).abs() < 1e-12, "{}", gain(5.0));
        // To the order of ω dt, and of (f/f_c)².
        for f in [1e-4, 1e-3] {
            let want = 2.0 * (std::f64::consts::TAU * f / corner).powi(2);
            assert!((gain(f) / want - 1.0).abs() < 1e-2, "{f} Hz: {} against {want}", gain(f));
        }
    }
}
