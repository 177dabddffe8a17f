//! Delay and first-order lag of an actuator.

/// Exact delay and first-order lag of a sample-and-hold command: `τ ẏ = u(t − delay) − y`.
#[derive(Clone, Debug)]
pub struct Lag {
    samples: usize,
    /// Fraction of a sample in the delay.
    part: f64,
    /// The older command acts for the fraction `part` of a sample, then the newer one. For both intervals, the factor
    /// of `y − u` at the end and in the mean.
    left: [f64; 2],
    mean: [f64; 2],
}

impl Lag {
    /// A lag of time constant `lag_s` behind a delay, for commands every `dt_s`.
    pub fn new(lag_s: f64, delay_s: f64, dt_s: f64) -> Self {
        let delay = delay_s / dt_s;
        // Rounding must not turn a whole number of samples into the next lower one.
        let samples = (delay + 1e-9).floor();
        let part = (delay - samples).max(0.0);
        let left = |stretch: f64| if lag_s > 0.0 { (-stretch * dt_s / lag_s).exp() } else { 0.0 };
        let mean = |stretch: f64| {
            let x = stretch * dt_s / lag_s;
            if lag_s > 0.0 && x > 0.0 { -(-x).exp_m1() / x } else { 0.0 }
        };
        let stretches = [part, 1.0 - part];
        Self { samples: samples as usize, part, left: stretches.map(left), mean: stretches.map(mean) }
    }

    /// Whole samples of delay: the age of the newer command of [`Self::step`]; the older one is a sample older.
    pub fn samples(&self) -> usize {
        self.samples
    }

    /// Returns the mean over a sample and advances `y` to its end.
    pub fn step(&self, y: &mut f64, older: f64, newer: f64) -> f64 {
        let mut mean = 0.0;
        for (i, (u, stretch)) in [(older, self.part), (newer, 1.0 - self.part)].into_iter().enumerate() {
            if stretch > 0.0 {
                mean += stretch * (u + (*y - u) * self.mean[i]);
                *y = u + (*y - u) * self.left[i];
            }
        }
        mean
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A step of 1 behind 30 ms of a 100 ms sample, then `1 − e^{−t/τ}`: over the first sample its mean is the integral
    /// over 70 ms, by hand with τ = 200 ms.
    #[test]
    fn a_step_by_hand() {
        let lag = Lag::new(0.2, 0.13, 0.1);
        assert_eq!(lag.samples(), 1);
        let mut y = 0.0;
        let mean = lag.step(&mut y, 0.0, 1.0);
        let end = 1.0 - (-0.07_f64 / 0.2).exp();
        assert!((y - end).abs() < 1e-15 && (mean - (0.07 - 0.2 * end) / 0.1).abs() < 1e-15, "{y} {mean}");
        assert_eq!(Lag::new(0.0, 0.3, 0.1).samples(), 3);
    }
}
