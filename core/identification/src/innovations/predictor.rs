//! The steady predictor of a linear system: what each sample adds to what the past predicts.
//!
//! With `x⁺ = F x + ξ`, `z = C x + η` and the covariances Q, N, R of (ξ, ξ), (ξ, η), (η, η), the predictor is
//! `x̂⁺ = F x̂ + K e`, `e = z − C x̂`, with the stabilising solution P of the discrete Riccati equation (Anderson and
//! Moore, Optimal Filtering, 1979, chapters 4 and 5):
//!
//! ```text
//! P = F P Fᵀ + Q − K S Kᵀ,   S = C P Cᵀ + R,   K = (F P Cᵀ + N) S⁻¹
//! ```

use nalgebra::{Cholesky, DMatrix};

use super::state_space::{NoNoise, NoiseStates};

/// Doublings: 2^40 samples are longer than any time constant.
const DOUBLINGS: usize = 40;
/// Relative change of any variance at which a doubling has converged.
const CONVERGED: f64 = 1e-14;
/// What is left of the past after which nothing more is added.
const FORGOTTEN: f64 = 1e-20;

/// A steady predictor.
#[derive(Clone, Debug)]
pub struct Predictor {
    /// K, states × channels.
    pub gain: DMatrix<f64>,
    /// W with `W S Wᵀ = 1`: the inverse of the lower Cholesky factor of S.
    pub whitening: DMatrix<f64>,
    /// P.
    pub covariance: DMatrix<f64>,
    /// `F − K C`.
    pub closed: DMatrix<f64>,
    /// S, the covariance of the innovations.
    pub innovation: DMatrix<f64>,
}

/// How a predictor changes with a parameter.
#[derive(Clone, Debug)]
pub struct Change {
    /// `∂K`.
    pub gain: DMatrix<f64>,
    /// `W ∂S Wᵀ`.
    pub innovation: DMatrix<f64>,
    /// What the change has beside the states of the predictor.
    pub beside: Option<Beside>,
}

/// States of a filter at coefficient zero: only the change with this coefficient has them. They follow
/// `χ⁺ = F χ − ∂K e` and take `C χ` off the change of what is seen.
#[derive(Clone, Debug)]
pub struct Beside {
    /// F, states × states.
    pub transition: DMatrix<f64>,
    /// C, channels × states.
    pub output: DMatrix<f64>,
    /// `∂K`, states × channels.
    pub gain: DMatrix<f64>,
}

/// The covariance of a driving noise in its parts.
struct Parts {
    q: DMatrix<f64>,
    n: DMatrix<f64>,
    r: DMatrix<f64>,
}

impl Parts {
    fn of(driving: &DMatrix<f64>, channels: usize) -> Self {
        let states = driving.nrows() - channels;
        Self {
            r: driving.view((0, 0), (channels, channels)).into_owned(),
            n: driving.view((channels, 0), (states, channels)).into_owned(),
            q: driving.view((channels, channels), (states, states)).into_owned(),
        }
    }
}

impl Predictor {
    /// The predictor of a system driven by noise of this covariance, see [`NoiseStates::driving`].
    ///
    /// # Errors
    /// [`NoNoise`]: no noise enters some combination of the channels, so that the past would predict it exactly.
    pub fn new(system: &NoiseStates, driving: &DMatrix<f64>) -> Result<Self, NoNoise> {
        let exact = || NoNoise("the declared noise leaves a combination of channels without any".to_owned());
        let (f, c) = (&system.transition, &system.output);
        let parts = Parts::of(driving, system.channels());
        let inverse = parts.r.clone().cholesky().ok_or_else(exact)?.inverse();
        // Without the correlation of ξ and η: F − N R⁻¹ C and Q − N R⁻¹ Nᵀ.
        let along = &parts.n * &inverse;
        let plain = f - &along * c;
        let q = symmetric(&(&parts.q - &along * parts.n.transpose()));
        let first = doubled(&plain, &(c.transpose() * &inverse * c), &q).ok_or_else(exact)?;
        let of = |p: DMatrix<f64>| -> Option<Self> {
            let innovation = symmetric(&(c * &p * c.transpose() + &parts.r));
            let factor = Cholesky::new(innovation.clone())?;
            let gain = (f * &p * c.transpose() + &parts.n) * factor.inverse();
            let whitening = factor.l().solve_lower_triangular(&DMatrix::identity(c.nrows(), c.nrows()))?;
            Some(Self { closed: f - &gain * c, gain, whitening, covariance: p, innovation })
        };
        // One step of Newton's method (Kleinman) takes the rounding of the doubling away.
        let before = of(first).ok_or_else(exact)?;
        let k = &before.gain;
        let cross = &parts.n * k.transpose();
        let driven = &parts.q - &cross - cross.transpose() + k * &parts.r * k.transpose();
        of(stationary(&before.closed, &symmetric(&driven))).ok_or_else(exact)
    }

    /// How the predictor changes when the covariance of the driving noise does, to first order. The system is that of
    /// the predictor, or has the states of filters at zero behind its own ([`NoiseStates::extended`]): these have no
    /// gain, as nothing drives them, and no part in the steady covariance, but both change.
    pub fn change(&self, system: &NoiseStates, driving: &DMatrix<f64>) -> Change {
        let (f, c) = (&system.transition, &system.output);
        let (known, states) = (self.gain.nrows(), f.nrows());
        let k = &self.gain.clone().resize_vertically(states, 0.0);
        let parts = Parts::of(driving, system.channels());
        let cross = &parts.n * k.transpose();
        let driven = &parts.q - &cross - cross.transpose() + k * &parts.r * k.transpose();
        let p = stationary(&(f - k * c), &symmetric(&driven));
        let innovation = symmetric(&(c * &p * c.transpose() + parts.r));
        let w = &self.whitening;
        let inverse = w.transpose() * w;
        let gain = (f * p * c.transpose() + parts.n - k * &innovation) * inverse;
        let beside = (states > known).then(|| Beside {
            transition: f.view_range(known.., known..).into_owned(),
            output: c.columns_range(known..).into_owned(),
            gain: gain.rows_range(known..).into_owned(),
        });
        Change { gain: gain.rows(0, known).into_owned(), innovation: w * innovation * w.transpose(), beside }
    }

    /// Logarithm of the determinant of S.
    pub fn ln_det(&self) -> f64 {
        -2.0 * self.whitening.diagonal().iter().map(|w| w.ln()).sum::<f64>()
    }

    /// Covariance of what an infinite past tells of the moving averages: that of their states without what it leaves
    /// open.
    pub fn known_of_the_start(&self, system: &NoiseStates) -> DMatrix<f64> {
        let n = 2 * system.channels();
        let f = system.transition.view((0, 0), (n, n));
        let k = self.gain.rows(0, n);
        // The predictor's own states: x̂⁺ = F x̂ + K e with e white.
        stationary(&f.into_owned(), &(k * &self.innovation * k.transpose()))
    }

    /// Samples after which what the state was has less than `part` of its influence on the innovations, at most `most`.
    pub fn settling(&self, system: &NoiseStates, part: f64, most: usize) -> usize {
        let n = 2 * system.channels();
        // The moving averages alone: what is slower is known by its constants, or by what it was before a gap.
        let mut power = self.closed.view((0, 0), (n, n)).into_owned();
        let mut samples = 1;
        while power.amax() > part && samples < most {
            power = &power * &power;
            samples *= 2;
        }
        samples.min(most)
    }
}

fn symmetric(m: &DMatrix<f64>) -> DMatrix<f64> {
    (m + m.transpose()) * 0.5
}

/// `P = F P (1 + G P)⁻¹ Fᵀ + H` by doubling that keeps the structure (Anderson 1978; Chu, Fan, Lin and Wang 2004).
fn doubled(f: &DMatrix<f64>, g: &DMatrix<f64>, h: &DMatrix<f64>) -> Option<DMatrix<f64>> {
    let unit = DMatrix::identity(f.nrows(), f.nrows());
    let (mut a, mut g, mut h) = (f.transpose(), g.clone(), h.clone());
    for _ in 0..DOUBLINGS {
        let inverse = (&unit + &g * &h).try_inverse()?;
        let more = a.transpose() * &h * &inverse * &a;
        g = symmetric(&(&g + &a * &inverse * &g * a.transpose()));
        a = &a * inverse * &a;
        h = symmetric(&(&h + &more));
        // States have units of their own, and the slow ones are small.
        if more.diagonal().iter().zip(h.diagonal().iter()).all(|(more, all)| *more <= CONVERGED * all) {
            break;
        }
    }
    h.iter().all(|x| x.is_finite()).then_some(h)
}

/// `P = A P Aᵀ + Q` of a stable A, by doubling (Smith 1968).
fn stationary(a: &DMatrix<f64>, q: &DMatrix<f64>) -> DMatrix<f64> {
    let (mut a, mut p) = (a.clone(), q.clone());
    for _ in 0..DOUBLINGS {
        p += &a * &p * a.transpose();
        a = &a * &a;
        if a.amax() < FORGOTTEN {
            break;
        }
    }
    symmetric(&p)
}
