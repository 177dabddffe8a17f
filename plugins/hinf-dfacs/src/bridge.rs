//! Interpolation over a few missing readouts, used only for second differences.
//!
//! A missing readout affects three second differences, and a spectrum needs intervals without gaps. The error of a
//! cubic through two readouts on either side is of the size of the readout's noise, with the same spectrum after the
//! second difference, and negligible if few samples are missing. The readouts themselves stay missing, because a filter
//! predicts them better.

/// Longest gap that is interpolated, samples.
pub(crate) const LONGEST: usize = 5;

/// Lagrange's cubic over `missing` samples, from the two values before and the two after them.
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
    fn a_cubic_is_interpolated_exactly() {
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
