//! Bounds of statistics under the hypothesis that every σ is right: binomial, χ², normal.
//!
//! Bounds with a false-alarm rate `a` are two-sided, `a/2` on either side.

use nalgebra::{DMatrix, DVector};

/// A closed interval.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Bounds {
    /// Lower end.
    pub(crate) low: f64,
    /// Upper end.
    pub(crate) high: f64,
}

impl Bounds {
    /// Whether a value is inside.
    pub(crate) fn hold(&self, value: f64) -> bool {
        (self.low..=self.high).contains(&value)
    }
}

/// ln Γ(x), x > 0, by Lanczos' sum (g = 7, nine terms), relative error below 1e-13.
fn ln_gamma(x: f64) -> f64 {
    const G: [f64; 9] = [
        0.999_999_999_999_809_9,
        676.520_368_121_885_1,
        -1_259.139_216_722_402_8,
        771.323_428_777_653_1,
        -176.615_029_162_140_6,
        12.507_343_278_686_905,
        -0.138_571_095_265_720_12,
        9.984_369_578_019_572e-6,
        1.505_632_735_149_311_6e-7,
    ];
    let x = x - 1.0;
    let t = x + 7.5;
    let sum = (1..9).fold(G[0], |sum, i| sum + G[i] / (x + i as f64));
    0.5 * std::f64::consts::TAU.ln() + (x + 0.5) * t.ln() - t + sum.ln()
}

/// Regularised lower incomplete gamma function P(a, x): series below `a + 1`, Lentz's continued fraction above.
fn gamma_p(a: f64, x: f64) -> f64 {
    if x <= 0.0 {
        return 0.0;
    }
    let front = (a * x.ln() - x - ln_gamma(a)).exp();
    if x < a + 1.0 {
        let (mut term, mut sum, mut n) = (1.0 / a, 1.0 / a, a);
        while term > sum * f64::EPSILON {
            n += 1.0;
            term *= x / n;
            sum += term;
        }
        return front * sum;
    }
    let (mut b, mut c) = (x + 1.0 - a, f64::INFINITY);
    let mut d = 1.0 / b;
    let mut h = d;
    for i in 1..100_000 {
        let an = -f64::from(i) * (f64::from(i) - a);
        b += 2.0;
        d = 1.0 / (an * d + b);
        c = b + an / c;
        h *= d * c;
        if (d * c - 1.0).abs() < 1e-15 {
            break;
        }
    }
    1.0 - front * h
}

/// Regularised incomplete beta function I_x(a, b), by Lentz's continued fraction.
fn beta_i(x: f64, a: f64, b: f64) -> f64 {
    if x <= 0.0 || x >= 1.0 {
        return x.clamp(0.0, 1.0);
    }
    if x > (a + 1.0) / (a + b + 2.0) {
        return 1.0 - beta_i(1.0 - x, b, a);
    }
    let front = (ln_gamma(a + b) - ln_gamma(a) - ln_gamma(b) + a * x.ln() + b * (-x).ln_1p()).exp() / a;
    let (mut c, mut d) = (1.0, 1.0 / (1.0 - (a + b) * x / (a + 1.0)));
    let mut h = d;
    for i in 1..10_000 {
        let m = f64::from(i);
        let even = m * (b - m) * x / ((a + 2.0 * m - 1.0) * (a + 2.0 * m));
        d = 1.0 / (1.0 + even * d);
        c = 1.0 + even / c;
        h *= d * c;
        let odd = -(a + m) * (a + b + m) * x / ((a + 2.0 * m) * (a + 2.0 * m + 1.0));
        d = 1.0 / (1.0 + odd * d);
        c = 1.0 + odd / c;
        h *= d * c;
        if (d * c - 1.0).abs() < 1e-15 {
            break;
        }
    }
    front * h
}

/// Inverse of an increasing function on [low, high], by bisection to the last bit.
fn inverse(f: impl Fn(f64) -> f64, value: f64, mut low: f64, mut high: f64) -> f64 {
    for _ in 0..200 {
        let middle = 0.5 * (low + high);
        if f(middle) < value {
            low = middle;
        } else {
            high = middle;
        }
    }
    0.5 * (low + high)
}

/// Probability that χ² with `dof` degrees of freedom is at most `x`.
pub(crate) fn chi2_cdf(x: f64, dof: f64) -> f64 {
    gamma_p(0.5 * dof, 0.5 * x)
}

/// Quantile `p` of χ² with `dof` degrees of freedom.
pub(crate) fn chi2_quantile(p: f64, dof: f64) -> f64 {
    inverse(|x| chi2_cdf(x, dof), p, 0.0, 20.0 * dof + 200.0)
}

/// Probability that a normal deviate is within `z` standard deviations.
pub(crate) fn within(z: f64) -> f64 {
    chi2_cdf(z * z, 1.0)
}

/// Inverse of [`within`].
pub(crate) fn half_width(p: f64) -> f64 {
    chi2_quantile(p, 1.0).sqrt()
}

/// Bounds of χ²/dof; above 10⁴ degrees of freedom by Wilson and Hilferty's approximation.
pub(crate) fn chi2_per_dof(dof: f64, false_alarm: f64) -> Bounds {
    if dof > 1e4 {
        let (v, z) = (2.0 / (9.0 * dof), half_width(1.0 - false_alarm));
        let bound = |z: f64| (1.0 - v + z * v.sqrt()).powi(3);
        return Bounds { low: bound(-z), high: bound(z) };
    }
    let bound = |p: f64| chi2_quantile(p, dof) / dof;
    Bounds { low: bound(0.5 * false_alarm), high: bound(1.0 - 0.5 * false_alarm) }
}

/// Bounds of the rms of `n` standard normal deviates about zero.
pub(crate) fn rms(n: usize, false_alarm: f64) -> Bounds {
    let b = chi2_per_dof(n as f64, false_alarm);
    Bounds { low: b.low.sqrt(), high: b.high.sqrt() }
}

/// Bounds of the mean of `n` standard normal deviates.
pub(crate) fn mean(n: usize, false_alarm: f64) -> Bounds {
    let z = half_width(1.0 - false_alarm) / (n as f64).sqrt();
    Bounds { low: -z, high: z }
}

/// Clopper–Pearson interval for the probability behind `k` of `n`, with confidence `1 − false_alarm`.
pub(crate) fn clopper_pearson(k: usize, n: usize, false_alarm: f64) -> Bounds {
    let (k, n, tail) = (k as f64, n as f64, 0.5 * false_alarm);
    let low = if k == 0.0 { 0.0 } else { inverse(|p| beta_i(p, k, n - k + 1.0), tail, 0.0, 1.0) };
    let high = if k == n { 1.0 } else { inverse(|p| beta_i(p, k + 1.0, n - k), 1.0 - tail, 0.0, 1.0) };
    Bounds { low, high }
}

/// Smallest and largest count of `n` whose Clopper–Pearson interval contains the probability `p`.
pub(crate) fn accepted_counts(p: f64, n: usize, false_alarm: f64) -> Option<(usize, usize)> {
    let mut held = (0..=n).filter(|k| clopper_pearson(*k, n, false_alarm).hold(p));
    let first = held.next()?;
    Some((first, held.next_back().unwrap_or(first)))
}

/// Normalised estimation error squared in the space spanned by the columns of `basis`, `(Bᵀe)ᵀ (BᵀCB)⁻¹ (Bᵀe)`; `None`
/// if the covariance is not positive definite there.
pub(crate) fn nees(error: &DVector<f64>, covariance: &DMatrix<f64>, basis: &DMatrix<f64>) -> Option<f64> {
    let e = basis.transpose() * error;
    let c = basis.transpose() * covariance * basis;
    Some(e.dot(&c.cholesky()?.solve(&e)))
}

/// Median.
pub(crate) fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    let n = values.len();
    match n {
        0 => f64::NAN,
        _ if n.is_multiple_of(2) => 0.5 * (values[n / 2 - 1] + values[n / 2]),
        _ => values[n / 2],
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;
    use rand_distr::{Distribution, StandardNormal};
    use rand_xoshiro::Xoshiro256PlusPlus;

    fn near(found: f64, wanted: f64, tolerance: f64) {
        assert!((found - wanted).abs() <= tolerance, "{found} for {wanted}");
    }

    /// Tables of χ² (Abramowitz and Stegun 26.8); two degrees of freedom in closed form, −2 ln(1 − p).
    #[test]
    fn chi2_matches_tables() {
        for (p, dof, wanted) in
            [(0.95, 1.0, 3.841_46), (0.975, 10.0, 20.483_2), (0.025, 10.0, 3.246_97), (0.99, 100.0, 135.807)]
        {
            near(chi2_quantile(p, dof), wanted, 1e-5 * wanted);
        }
        for p in [1e-4, 0.3, 0.9, 0.999_99] {
            near(chi2_quantile(p, 2.0), -2.0 * (-p).ln_1p(), 1e-9);
        }
        near(within(1.0), 0.682_689_492, 1e-9);
        near(within(2.0), 0.954_499_736, 1e-9);
        near(within(5.0), 1.0 - 5.733_031e-7, 1e-12);
        near(half_width(0.95), 1.959_963_985, 1e-8);
    }

    /// Both formulas agree where they meet; for large dof the width is √(2/dof).
    #[test]
    fn chi2_of_many_degrees_of_freedom_is_normal() {
        let (exact, approximate) = (chi2_per_dof(9_999.0, 1e-4), chi2_per_dof(10_001.0, 1e-4));
        near(exact.low, approximate.low, 2e-5);
        near(exact.high, approximate.high, 2e-5);
        near(chi2_per_dof(2e8, 0.05).high, 1.0 + 1.959_964e-4, 2e-8);
    }

    /// Reference: closed form for 0 and n of n, tables for 5 of 10 and 15 of 20.
    #[test]
    fn clopper_pearson_matches_tables() {
        let none = clopper_pearson(0, 10, 0.05);
        near(none.high, 1.0 - 0.025_f64.powf(0.1), 1e-12);
        assert_eq!(none.low, 0.0);
        near(clopper_pearson(10, 10, 0.05).low, 0.025_f64.powf(0.1), 1e-12);
        let half = clopper_pearson(5, 10, 0.05);
        near(half.low, 0.187_086, 1e-6);
        near(half.high, 0.812_914, 1e-6);
        let most = clopper_pearson(15, 20, 0.05);
        near(most.low, 0.508_954, 1e-6);
        near(most.high, 0.913_429, 1e-6);
    }

    /// The rejected counts have at most the stated probability, summed term by term.
    #[test]
    fn accepted_counts_have_the_stated_false_alarm_rate() {
        let (n, p, alarm) = (100_usize, within(1.0), 1e-3);
        let (low, high) = accepted_counts(p, n, alarm).expect("some counts are accepted");
        let mut term = (1.0 - p).powi(100);
        let mut outside = 0.0;
        for k in 0..=n {
            if !(low..=high).contains(&k) {
                outside += term;
            }
            term *= (n - k) as f64 / (k + 1) as f64 * p / (1.0 - p);
        }
        // A discrete distribution seldom reaches the stated rate.
        assert!(outside < alarm && outside > 0.2 * alarm, "{low} {high} {outside}");
    }

    fn deviates(seed: u64, n: usize, scale: f64) -> Vec<f64> {
        let mut rng = Xoshiro256PlusPlus::seed_from_u64(seed);
        (0..n)
            .map(|_| {
                let z: f64 = StandardNormal.sample(&mut rng);
                z * scale
            })
            .collect()
    }

    /// 100 normal deviates pass at a false-alarm rate of 1e-3; with σ wrong by a factor of two every statistic fails.
    #[test]
    fn bounds_accept_right_sigmas_and_reject_others() {
        let n = 100;
        let verdicts = |scale: f64| {
            let z = deviates(1, n, scale);
            let k = z.iter().filter(|z| z.abs() <= 1.0).count();
            let square = z.iter().map(|z| z * z).sum::<f64>() / n as f64;
            let accepted = accepted_counts(within(1.0), n, 1e-3).expect("some");
            [
                (accepted.0..=accepted.1).contains(&k),
                rms(n, 1e-3).hold(square.sqrt()),
                chi2_per_dof(n as f64, 1e-3).hold(square),
            ]
        };
        assert_eq!(verdicts(1.0), [true; 3]);
        assert_eq!(verdicts(2.0), [false; 3]);
        assert_eq!(verdicts(0.5), [false; 3]);
        let shifted: f64 = deviates(1, n, 1.0).iter().map(|z| z + 0.5).sum::<f64>() / n as f64;
        assert!(mean(n, 1e-3).hold(shifted - 0.5) && !mean(n, 1e-3).hold(shifted));
    }

    /// Three coordinates, two of them tied: NEES in the free plane is χ² with two degrees of freedom; without the
    /// correlation it is not.
    #[test]
    fn nees_uses_the_free_space() {
        // e = (a, b, b) with a, b correlated by 0.8.
        let covariance = DMatrix::from_row_slice(3, 3, &[1.0, 0.8, 0.8, 0.8, 1.0, 1.0, 0.8, 1.0, 1.0]);
        let half = 0.5_f64.sqrt();
        let free = DMatrix::from_row_slice(3, 2, &[1.0, 0.0, 0.0, half, 0.0, half]);
        let (x, y) = (deviates(2, 2000, 1.0), deviates(3, 2000, 1.0));
        let sum = |c: &DMatrix<f64>| -> f64 {
            x.iter()
                .zip(&y)
                .map(|(x, y)| {
                    let b = 0.8 * x + 0.6 * y;
                    nees(&DVector::from_vec(vec![*x, b, b]), c, &free).expect("positive definite")
                })
                .sum::<f64>()
                / 4000.0
        };
        assert!(chi2_per_dof(4000.0, 1e-3).hold(sum(&covariance)), "{}", sum(&covariance));
        assert!(nees(&DVector::zeros(3), &covariance, &DMatrix::identity(3, 3)).is_none_or(f64::is_finite));
        // Half the variance doubles NEES.
        assert!(!chi2_per_dof(4000.0, 1e-3).hold(sum(&(covariance * 0.5))));
    }

    #[test]
    fn median_of_odd_and_even_counts() {
        assert_eq!((median(vec![3.0, 1.0, 2.0]), median(vec![4.0, 1.0, 2.0, 3.0])), (2.0, 2.5));
    }
}
