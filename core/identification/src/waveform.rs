//! Waveforms of transients at known times.

use dragfree_estimation::spectra::{Band, Plan};

/// A waveform that begins at a known time.
#[derive(Clone, Debug, PartialEq)]
pub struct Waveform {
    /// Unix ns of the sample in which it begins.
    pub at_ns: i64,
    /// Time between samples, ns.
    pub step_ns: i64,
    /// One mean per sample from that one on, s⁻¹.
    pub kernel: Vec<f64>,
}

impl Waveform {
    /// Its means over the samples of some rows.
    pub fn over(&self, time_ns: &[i64]) -> Vec<f64> {
        let mean = |now_ns: &i64| {
            let since = (now_ns - self.at_ns + self.step_ns / 2).div_euclid(self.step_ns);
            usize::try_from(since).ok().and_then(|k| self.kernel.get(k)).copied().unwrap_or(0.0)
        };
        time_ns.iter().map(mean).collect()
    }

    /// `4 ∫ |K|² df` over each band of a plan, K its transform: what all of it, without a window, would add to the
    /// diagonal of the Gram matrix. `averaged` where the columns are means of two samples.
    pub fn energy(&self, plan: &Plan, averaged: bool) -> Vec<f64> {
        let dt_s = plan.rate_hz.recip();
        let power = |hz: f64| {
            let turn = std::f64::consts::TAU * hz * dt_s;
            let (re, im) = self.kernel.iter().enumerate().fold((0.0, 0.0), |(re, im), (k, x)| {
                let (sin, cos) = (turn * k as f64).sin_cos();
                (re + x * cos, im + x * sin)
            });
            let mean = if averaged { (0.5 * turn).cos().powi(2) } else { 1.0 };
            (re * re + im * im) * dt_s * dt_s * mean
        };
        let band = |b: &Band| {
            // By the midpoint rule; where the bands are wide a waveform has little that changes within a quarter of
            // one.
            let parts = b.bins().min(4);
            let (first, width) = (b.first as f64 - 0.5, b.bins() as f64 / parts as f64);
            let at = |i: usize| power(plan.bin_hz(first + (i as f64 + 0.5) * width));
            4.0 * plan.bin_hz(width) * (0..parts).map(at).sum::<f64>()
        };
        plan.bands.iter().map(band).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn waveform(kernel: &[f64]) -> Waveform {
        Waveform { at_ns: 5_000_000_000, step_ns: 100_000_000, kernel: kernel.to_vec() }
    }

    #[test]
    fn it_begins_in_its_sample_and_ends() {
        let times: Vec<i64> = (48..54).map(|k| 100_000_000 * k).collect();
        assert_eq!(waveform(&[3.0, 2.0, 1.0]).over(&times), [0.0, 0.0, 3.0, 2.0, 1.0, 0.0]);
        // A grid that lies a nanosecond beside is the same one.
        let beside: Vec<i64> = times.iter().map(|t| t - 1).collect();
        assert_eq!(waveform(&[3.0, 2.0, 1.0]).over(&beside), [0.0, 0.0, 3.0, 2.0, 1.0, 0.0]);
    }

    /// Parseval: over all frequencies `2 Δt Σ k²`, of the mean of two samples that of the mean.
    #[test]
    fn its_energy_is_that_of_its_samples() {
        let kernel = [4.0, -2.0, 7.0, 1.0];
        let plan = Plan::slow(16_384, 1024, 10.0);
        let means = [2.0, 1.0, 2.5, 4.0, 0.5];
        for (averaged, samples) in [(false, &kernel[..]), (true, &means[..])] {
            let whole: f64 = waveform(&kernel).energy(&plan, averaged).iter().sum();
            let want = 2.0 * 0.1 * samples.iter().map(|x| x * x).sum::<f64>();
            // Below the first bin and in the last nothing is counted.
            assert!((whole / want - 1.0).abs() < 2e-3, "{whole} against {want}");
        }
    }
}
