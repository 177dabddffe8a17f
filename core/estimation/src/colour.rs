//! Effects that filter a declared noise process: what moves with the spacecraft is driven by the thrusters' noise as by
//! their commands.
//!
//! A residual that a coefficient c leaves, `z = (1 + cH)(F + n)` with F known and n not, holds `(1 + cH) n` when `cHF`
//! is explained. Under a Σ without that, a gain in the loop is biased, as commands answer to the noise: the whitened
//! residual is no longer what is new in each sample. So the process has `|1 + cH|²` times its power.

use std::f64::consts::TAU;

pub use dragfree_schema::Colour;
use realfft::num_complex::Complex64;

use crate::spectra::{Band, Plan};

/// Points of a band at which a response is taken: a resonance may be narrower than the band.
const POINTS: usize = 16;

/// What a [`Colour`] does to the power of its process.
pub trait ColourPower {
    /// `|1 + cH|²` of the coefficient c, its mean over a band.
    fn power(&self, coefficient: f64, plan: &Plan, band: Band) -> f64;
}

impl ColourPower for Colour {
    fn power(&self, coefficient: f64, plan: &Plan, band: Band) -> f64 {
        let polynomial =
            |c: &[f64], s: Complex64| c.iter().rev().fold(Complex64::default(), |sum, c| sum * s + Complex64::from(*c));
        let at = |i: usize| {
            let bin = band.first as f64 - 0.5 + band.bins() as f64 * (i as f64 + 0.5) / POINTS as f64;
            let s = Complex64::new(0.0, TAU * plan.hz(band, bin));
            (1.0 + coefficient * polynomial(&self.numerator, s) / polynomial(&self.denominator, s)).norm_sqr()
        };
        (0..POINTS).map(at).sum::<f64>() / POINTS as f64
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A resonance at 0.1 Hz with a damping ratio of 0.05 under `−ẍ = a s²/(s² + 2ZΩs + Ω²)`: 1 + c far above, 1 far
    /// below, and `|1 − ic/(2Z)|²`, 2 for c = 0.1, at the resonance, which a band of one bin sees.
    #[test]
    fn a_resonance_has_its_heights() {
        let omega = TAU * 0.1;
        let colour = Colour {
            process: String::new(),
            numerator: vec![0.0, 0.0, 1.0],
            denominator: vec![omega * omega, 0.1 * omega, 1.0],
        };
        let plan = Plan::new(20_000, 10.0);
        let bin = |hz: f64| (hz / plan.bin_hz(1.0)).round() as usize;
        for (hz, power) in [(0.002, 1.0), (0.1, 2.0), (4.0, 1.21)] {
            let band = Band { first: bin(hz), end: bin(hz) + 1, of: plan.length };
            assert!((colour.power(0.1, &plan, band) / power - 1.0).abs() < 2e-3, "{hz}");
        }
        // A wide band has the mean of what its bins have.
        let wide = Band { first: bin(0.05), end: bin(0.05) + 16, of: plan.length };
        let bins = (wide.first..wide.end).map(|k| colour.power(0.1, &plan, Band { first: k, end: k + 1, ..wide }));
        assert!((colour.power(0.1, &plan, wide) / (bins.sum::<f64>() / 16.0) - 1.0).abs() < 1e-4);
    }
}
