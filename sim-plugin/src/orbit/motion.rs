//! Motion of the three spacecraft under the Sun and the Earth (eq:a_g), heliocentric, on a fixed grid of nodes.
//!
//! The origin is the Sun, which the Earth accelerates too: the indirect term `−μ_e r_e/r_e³` is added to the printed
//! ones. Other forces are omitted, because a drag-free controller compensates them.

use nalgebra::Vector3;

use super::OrbitError;
use super::ephemeris::Ephemeris;

/// Gravitational parameter of the Sun, m³ s⁻² (DE440).
pub(super) const MU_SUN_M3_S2: f64 = 1.327_124_400_412_794_2e20;
/// Gravitational parameter of the Earth, m³ s⁻² (DE440).
pub(super) const MU_EARTH_M3_S2: f64 = 3.986_004_355_070_226e14;

/// Numbers of substeps of the extrapolation, of order 10.
const SUBSTEPS: [u32; 5] = [1, 2, 3, 4, 5];
/// Seconds between nodes.
const NODE_S: f64 = 2.0 * 86_400.0;

/// Position and velocity relative to the Sun.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct State {
    /// Position, IRF, m.
    pub r_irf_m: Vector3<f64>,
    /// Velocity, IRF, m/s.
    pub v_irf_m_s: Vector3<f64>,
}

/// Accelerations at a number of seconds, from positions.
trait Field {
    fn accelerations(&self, at_s: f64, r_irf_m: &[Vector3<f64>; 3]) -> Result<[Vector3<f64>; 3], OrbitError>;
}

/// Sun and Earth, seconds counted from the epoch.
struct SunAndEarth<'a> {
    ephemeris: &'a Ephemeris,
    epoch_et_s: f64,
}

impl Field for SunAndEarth<'_> {
    fn accelerations(&self, at_s: f64, r_irf_m: &[Vector3<f64>; 3]) -> Result<[Vector3<f64>; 3], OrbitError> {
        let (first_s, last_s) = self.ephemeris.span_s();
        // A checked time may round across the end of the span.
        let earth = self.ephemeris.earth_irf_m((self.epoch_et_s + at_s).clamp(first_s, last_s))?;
        Ok(r_irf_m.map(|r| gravity_irf_m_s2(&r, &earth)))
    }
}

/// `a_g` in axes that fall with the Sun, m/s².
pub(super) fn gravity_irf_m_s2(r_irf_m: &Vector3<f64>, earth_irf_m: &Vector3<f64>) -> Vector3<f64> {
    pull(r_irf_m, MU_SUN_M3_S2) + pull(&(r_irf_m - earth_irf_m), MU_EARTH_M3_S2) + pull(earth_irf_m, MU_EARTH_M3_S2)
}

/// Acceleration at `r` from a point mass.
fn pull(r_m: &Vector3<f64>, mu_m3_s2: f64) -> Vector3<f64> {
    r_m * (-mu_m3_s2 / r_m.norm().powi(3))
}

/// The orbits over the ephemeris' whole span. A state is one step from the node before it as seen from the epoch, so it
/// does not depend on what was asked before.
#[derive(Clone, Debug)]
pub(super) struct Motion {
    epoch_et_s: f64,
    /// States at `k · NODE_S` after the epoch and before it.
    after: Vec<[State; 3]>,
    before: Vec<[State; 3]>,
}

impl Motion {
    pub(super) fn new(ephemeris: &Ephemeris, epoch_et_s: f64, start: [State; 3]) -> Result<Self, OrbitError> {
        let field = SunAndEarth { ephemeris, epoch_et_s };
        let (first_s, last_s) = ephemeris.span_s();
        let after = nodes(&field, start, NODE_S, last_s - epoch_et_s)?;
        let before = nodes(&field, start, -NODE_S, epoch_et_s - first_s)?;
        Ok(Self { epoch_et_s, after, before })
    }

    /// States at a time, seconds of TDB from the epoch.
    pub(super) fn at(&self, ephemeris: &Ephemeris, since_s: f64) -> Result<[State; 3], OrbitError> {
        let nodes = if since_s < 0.0 { &self.before } else { &self.after };
        let index = ((since_s.abs() / NODE_S) as usize).min(nodes.len() - 1);
        let from_s = (index as f64 * NODE_S).copysign(since_s);
        step(&SunAndEarth { ephemeris, epoch_et_s: self.epoch_et_s }, &nodes[index], from_s, since_s - from_s)
    }
}

/// States at every `step_s` as far as `length_s`.
fn nodes(field: &impl Field, start: [State; 3], step_s: f64, length_s: f64) -> Result<Vec<[State; 3]>, OrbitError> {
    let count = (length_s / step_s.abs()) as usize; // a cast of a float saturates
    let mut nodes = Vec::with_capacity(count + 1);
    let mut state = start;
    nodes.push(state);
    for k in 0..count {
        state = step(field, &state, k as f64 * step_s, step_s)?;
        nodes.push(state);
    }
    Ok(nodes)
}

/// One step by extrapolated Störmer sums (E. Hairer, S. P. Nørsett, G. Wanner, Solving Ordinary Differential Equations
/// I, II.14).
fn step(field: &impl Field, start: &[State; 3], at_s: f64, step_s: f64) -> Result<[State; 3], OrbitError> {
    let r0 = start.map(|s| s.r_irf_m);
    let first = field.accelerations(at_s, &r0)?;
    // Row of the Aitken–Neville table of deviations.
    let mut row: Vec<Bend> = Vec::with_capacity(SUBSTEPS.len());
    for (j, &n) in SUBSTEPS.iter().enumerate() {
        let mut next = vec![bend(field, start, &first, at_s, step_s, n)?];
        for k in 0..j {
            let ratio = f64::from(n) / f64::from(SUBSTEPS[j - 1 - k]);
            next.push(next[k].extrapolated(&row[k], ratio * ratio));
        }
        row = next;
    }
    let bend = &row[SUBSTEPS.len() - 1];
    Ok(std::array::from_fn(|i| State {
        r_irf_m: r0[i] + (start[i].v_irf_m_s * step_s + bend.r_m[i]),
        v_irf_m_s: start[i].v_irf_m_s + bend.v_m_s[i],
    }))
}

/// Deviation from straight motion by gravity, kept separately to reduce rounding.
struct Bend {
    r_m: [Vector3<f64>; 3],
    v_m_s: [Vector3<f64>; 3],
}

impl Bend {
    /// `self + (self − coarser)/(ratio² − 1)`
    fn extrapolated(&self, coarser: &Self, ratio_squared: f64) -> Self {
        let weight = 1.0 / (ratio_squared - 1.0);
        let ahead =
            |a: &[Vector3<f64>; 3], b: &[Vector3<f64>; 3]| std::array::from_fn(|i| a[i] + (a[i] - b[i]) * weight);
        Self { r_m: ahead(&self.r_m, &coarser.r_m), v_m_s: ahead(&self.v_m_s, &coarser.v_m_s) }
    }
}

/// Störmer's rule in `n` substeps, summed as Henrici does.
fn bend(
    field: &impl Field,
    start: &[State; 3],
    first: &[Vector3<f64>; 3],
    at_s: f64,
    step_s: f64,
    n: u32,
) -> Result<Bend, OrbitError> {
    let h = step_s / f64::from(n);
    let mut v_m_s = first.map(|a| a * (0.5 * h));
    let mut r_m = [Vector3::zeros(); 3];
    for m in 1..=n {
        let elapsed_s = step_s * (f64::from(m) / f64::from(n));
        for (r, v) in r_m.iter_mut().zip(&v_m_s) {
            *r += v * h;
        }
        let r = std::array::from_fn(|i| start[i].r_irf_m + (start[i].v_irf_m_s * elapsed_s + r_m[i]));
        let weight = if m == n { 0.5 * h } else { h };
        for (v, a) in v_m_s.iter_mut().zip(field.accelerations(at_s + elapsed_s, &r)?) {
            *v += a * weight;
        }
    }
    Ok(Bend { r_m, v_m_s })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::orbit::elements::{AU_M, on_orbit};

    /// The Sun alone.
    struct Kepler;

    impl Field for Kepler {
        fn accelerations(&self, _: f64, r_irf_m: &[Vector3<f64>; 3]) -> Result<[Vector3<f64>; 3], OrbitError> {
            Ok(r_irf_m.map(|r| pull(&r, MU_SUN_M3_S2)))
        }
    }

    /// An orbit of eccentricity 0.2, far more than the triangle's 0.006, at three anomalies, counted from aphelion.
    fn on_kepler_orbit(elapsed_s: f64) -> [State; 3] {
        let motion_rad_s = (MU_SUN_M3_S2 / AU_M.powi(3)).sqrt();
        [0.3, 2.0, 4.5].map(|anomaly| on_orbit(0.2, 0.1, 0.5, anomaly + motion_rad_s * elapsed_s))
    }

    fn flown(step_s: f64, steps: u32) -> [State; 3] {
        let length_s = step_s.abs() * f64::from(steps);
        *nodes(&Kepler, on_kepler_orbit(0.0), step_s, length_s * (1.0 + 1e-9)).unwrap().last().unwrap()
    }

    fn error_m(a: &[State; 3], b: &[State; 3]) -> f64 {
        (0..3).map(|i| (a[i].r_irf_m - b[i].r_irf_m).norm()).sum()
    }

    /// Order 10: halving the step leaves 1/1024 of the error, as long as that is truncation.
    #[test]
    fn the_step_has_order_ten() {
        let year_s = 384.0 * 86_400.0;
        let errors = [24.0, 12.0].map(|days| {
            let step_s = days * 86_400.0;
            error_m(&flown(step_s, (year_s / step_s) as u32), &on_kepler_orbit(year_s))
        });
        let order = (errors[0] / errors[1]).log2();
        assert!((9.0..11.5).contains(&order), "{order}");
    }

    /// With the step that is used, rounding is what is left, forwards and backwards.
    #[test]
    fn an_undisturbed_orbit_keeps_energy_and_angular_momentum() {
        let start = on_kepler_orbit(0.0);
        for sign in [1.0, -1.0] {
            let end = flown(sign * NODE_S, 1100);
            let want = on_kepler_orbit(sign * NODE_S * 1100.0);
            // 1,100 roundings of 3e-5 m and 4e-12 m/s, six years long, as in a random walk.
            let error_m = error_m(&end, &want);
            assert!(error_m < 0.1, "{error_m} m");
            for (a, b) in start.iter().zip(&end) {
                let energy = |s: &State| 0.5 * s.v_irf_m_s.norm_squared() - MU_SUN_M3_S2 / s.r_irf_m.norm();
                let momentum = |s: &State| s.r_irf_m.cross(&s.v_irf_m_s);
                let lost =
                    [(energy(b) / energy(a) - 1.0).abs(), (momentum(b) - momentum(a)).norm() / momentum(a).norm()];
                assert!(lost.iter().all(|l| *l < 1e-13), "{lost:?}");
            }
        }
    }

    /// Sun and Earth over a year: half the step changes nothing but rounding.
    #[test]
    fn half_the_step_gives_the_same_orbit() {
        let ephemeris = Ephemeris::embedded().unwrap();
        let field = SunAndEarth { ephemeris: &ephemeris, epoch_et_s: 1_104_494_469.183_910_4 };
        let start = super::super::elements::triangle(1.4, 3e9);
        let length_s = 366.5 * 86_400.0;
        let [whole, half] = [1.0, 0.5].map(|part| nodes(&field, start, part * NODE_S, length_s).unwrap());
        let error_m = error_m(whole.last().unwrap(), &half[2 * (whole.len() - 1)]);
        assert!(error_m < 0.01, "{error_m} m");
    }
}
