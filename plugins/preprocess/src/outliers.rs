//! Outlier test: runs of up to three samples that deviate from the line through their neighbours.
//!
//! A displacement or an angle is the double integral of an acceleration. A force changes its curvature, a thrust pulse
//! its slope, a phase-meter slip its value; in none of them does it return to the *same* line within three samples. A
//! run of one to three samples is an outlier if
//! 1. both of its ends deviate from the chord between their neighbours by more than `sigma/2` robust standard
//!    deviations of the second difference (for one sample: its second difference exceeds `sigma`), and
//! 2. the slopes before and after the run agree with the chord within a quarter of that deviation, and
//! 3. the deviation exceeds the same multiple of the local scale, from the sixteen rows around it.
//!
//! The standard deviation comes from the upper quartile of |D²| over a block, `1.1503 σ` for Gaussian noise. It
//! tolerates 8 % of bad samples and is zero, which disables the test, for a quantised readout that seldom changes. With
//! a quartile 15 % too low, condition 1 alone has the false alarm probability `erfc(sigma · 0.85/√2)` per sample: below
//! 1e-9 from 7.3 on.

/// Rows before and after a block that the test reads.
pub(crate) const MARGIN: usize = 12;

/// Rows that share one robust scale.
pub(crate) const BLOCK: usize = 256;

/// Minimum number of second differences for a scale.
const MIN_DIFFERENCES: usize = 32;

/// Maximum length of an outlier run.
const MAX_RUN: usize = 3;

/// Upper quartile of |x| for a standard normal x.
const QUARTILE: f64 = 1.150_349_380_376_008;

/// Median of |x| for a standard normal x.
const MEDIAN: f64 = 0.674_489_750_196_081_7;

/// Replaces outliers among `x[from..to]` by NaN and returns their number; reads values outside. `scratch` is a buffer.
pub(crate) fn remove(x: &mut [f64], from: usize, to: usize, sigma: f64, scratch: &mut Vec<f64>) -> u64 {
    let (first, last) = (from.max(1), to.min(x.len().saturating_sub(1)));
    if last <= first {
        return 0;
    }
    scratch.clear();
    scratch.extend(x[first - 1..=last].windows(3).map(|w| (w[0] - 2.0 * w[1] + w[2]).abs()));
    let largest = scratch.iter().copied().fold(0.0, f64::max);
    scratch.retain(|d| !d.is_nan());
    if scratch.len() < MIN_DIFFERENCES {
        return 0;
    }
    let quartile = scratch.len() * 3 / 4;
    let scale = *scratch.select_nth_unstable_by(quartile, f64::total_cmp).1 / QUARTILE;
    let threshold = sigma * scale;
    // The common case: nothing in the block exceeds the threshold.
    if scale <= 0.0 || largest <= threshold {
        return 0;
    }
    let mut removed = 0;
    let mut k = first;
    while k < last {
        match run_at(x, k, threshold, sigma) {
            Some(length) => {
                x[k..k + length].fill(f64::NAN);
                removed += length as u64;
                k += length;
            }
            None => k += 1,
        }
    }
    removed
}

/// Length of an outlier run that begins at `a`.
fn run_at(x: &[f64], a: usize, threshold: f64, sigma: f64) -> Option<usize> {
    (1..=MAX_RUN).find(|&length| {
        let b = a + length - 1;
        if a < 2 || b + 2 >= x.len() {
            return false;
        }
        let chord = (x[b + 1] - x[a - 1]) / (length + 1) as f64;
        let off = |j: usize| (x[j] - x[a - 1] - chord * (j + 1 - a) as f64).abs();
        let deviation = (a..=b).map(off).fold(f64::INFINITY, f64::min);
        let returns = |slope: f64| (slope - chord).abs() <= deviation / 4.0;
        2.0 * deviation > threshold
            && (a..=b).all(|j| x[j].is_finite())
            && returns(x[a - 1] - x[a - 2])
            && returns(x[b + 2] - x[b + 1])
            && 2.0 * deviation > sigma * local_scale(x, a, b)
    })
}

/// Standard deviation of the second difference around a run, from the median; 0 with too few rows.
fn local_scale(x: &[f64], a: usize, b: usize) -> f64 {
    let second = |k: usize| (x[k - 1] - 2.0 * x[k] + x[k + 1]).abs();
    let before = (a.saturating_sub(10).max(1)..a.saturating_sub(1)).map(second);
    let after = (b + 2..(b + 11).min(x.len() - 1)).map(second);
    let mut around: Vec<f64> = before.chain(after).filter(|d| !d.is_nan()).collect();
    if around.len() < 8 {
        return 0.0;
    }
    let middle = around.len() / 2;
    *around.select_nth_unstable_by(middle, f64::total_cmp).1 / MEDIAN
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::Noise;

    const SIGMA: f64 = 20.0;

    /// Slow oscillation with unit white noise.
    fn readout(rows: usize, seed: u64) -> Vec<f64> {
        let mut noise = Noise::new(seed);
        (0..rows).map(|k| 50.0 * (k as f64 * 0.02).sin() + noise.gauss()).collect()
    }

    fn removed_rows(mut x: Vec<f64>, sigma: f64) -> Vec<usize> {
        let rows = x.len();
        let mut scratch = Vec::new();
        for from in (0..rows).step_by(BLOCK) {
            let (low, high) = (from.saturating_sub(MARGIN), (from + BLOCK + MARGIN).min(rows));
            remove(&mut x[low..high], from - low, (from + BLOCK).min(rows) - low, sigma, &mut scratch);
        }
        (0..rows).filter(|k| x[*k].is_nan()).collect()
    }

    #[test]
    fn runs_of_up_to_three_samples_are_found_wherever_they_lie() {
        for at in [2, 100, 254, 255, 256, 257, 511, 700] {
            for length in 1..=3 {
                let mut x = readout(1024, at as u64);
                x[at..at + length].iter_mut().for_each(|v| *v += 60.0);
                assert_eq!(removed_rows(x, SIGMA), (at..at + length).collect::<Vec<_>>(), "{length} at {at}");
            }
        }
    }

    #[test]
    fn eight_percent_of_single_outliers_do_not_hide_each_other() {
        let mut x = readout(2560, 3);
        let bad: Vec<usize> = (6..2550).step_by(13).collect();
        bad.iter().for_each(|k| x[*k] += 200.0);
        assert_eq!(removed_rows(x, SIGMA), bad);
    }

    /// Expected false alarms below 2e-4 at sigma = 7.3. At 3 the same data must lose samples.
    #[test]
    fn gaussian_noise_has_no_outliers() {
        let x = readout(200_000, 11);
        assert!(removed_rows(x.clone(), 7.3).is_empty());
        assert!(!removed_rows(x, 3.0).is_empty());
    }

    #[test]
    fn dynamic_signals_and_noise_bursts_are_kept() {
        let mut shapes: Vec<Vec<f64>> = Vec::new();
        let after = |k: usize, f: &dyn Fn(f64) -> f64| -> Vec<f64> {
            (0..1024).map(|i| if i < k { 0.0 } else { f((i - k) as f64) }).collect()
        };
        for size in [30.0, 300.0, 3e5] {
            shapes.push(after(300, &|_| size)); // a step
            shapes.push(after(300, &|i| size * i)); // a kick
            shapes.push(after(300, &|i| size * (i + 1.0))); // a kick with a step
            shapes.push(after(300, &|i| size * i.min(2.0))); // a pulse of thrust and one against it
            shapes.push(after(300, &|i| size * i * i)); // a constant thrust sets in
            shapes.push(after(300, &|i| size * (1.0 - (-i / 4.0).exp()))); // a step that settles
            shapes.push(after(300, &|i| size * (-i / 30.0).exp() * (i * 0.5).sin())); // a ring
        }
        for (s, shape) in shapes.iter().enumerate() {
            let x: Vec<f64> = readout(1024, 5).iter().zip(shape).map(|(a, b)| a + b).collect();
            assert!(removed_rows(x, SIGMA).is_empty(), "shape {s}");
        }
        // Two seconds of noise 100 times larger.
        let mut noise = Noise::new(8);
        let mut x = readout(1024, 6);
        x[500..520].iter_mut().for_each(|v| *v += 100.0 * noise.gauss());
        assert!(removed_rows(x, SIGMA).is_empty());
    }

    #[test]
    fn a_quantised_readout_switches_the_test_off() {
        let x: Vec<f64> = (0..1024).map(|k| if k % 100 == 0 { 1.0 } else { 0.0 }).collect();
        assert!(removed_rows(x, SIGMA).is_empty());
    }
}
