//! Bridges over a few missing readouts, for the second differences alone.
//!
//! One readout that is missing takes three second differences with it, and a spectrum wants stretches without a hole. A
//! cubic through the two readouts on either side misses by the size of the readout's own noise (and by `d⁴r/dt⁴`,
//! nothing at these rates), and the second difference gives that error the spectrum that the noise of a readout has. In
//! a few parts per thousand of the samples it cannot be seen. The readouts themselves stay missing: a filter has a
//! better prediction than a cubic.

/// Longest bridge, samples.
pub(crate) const LONGEST: usize = 5;

/// The values between the two before and the two after a hole of `missing` samples: Lagrange's cubic.
pub(crate) fn bridge(before: [f64; 2], after: [f64; 2], missing: usize) -> impl Iterator<Item = f64> {
    let end = missing as f64 + 1.0;
    let at = [-1.0, 0.0, end, end + 1.0];
    let value = [before[0], before[1], after[0], after[1]];
    (1..=missing).map(move |k| {
        let t = k as f64;
        (0..4)
            .map(|i| {
                let others = (0..4).filter(|j| *j != i);
                value[i] * others.map(|j| (t - at[j]) / (at[i] - at[j])).product::<f64>()
            })
            .sum()
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_cubic_is_met_exactly() {
        let p = |t: f64| 1.0 - 2.0 * t + 0.5 * t * t - 0.25 * t * t * t;
        for missing in 1..=LONGEST {
            let end = missing as f64 + 1.0;
            let got: Vec<f64> = bridge([p(-1.0), p(0.0)], [p(end), p(end + 1.0)], missing).collect();
            for (k, got) in got.iter().enumerate() {
                assert!((got - p(k as f64 + 1.0)).abs() < 1e-12);
            }
            assert_eq!(got.len(), missing);
        }
    }
}
