//! Tail probabilities of χ² and of Kolmogorov's distribution, accurate far out, where p-values are decided.

/// `ln Γ(x)` for `x > 0` (Lanczos, g = 7, to 1e-14).
fn ln_gamma(x: f64) -> f64 {
    const C: [f64; 8] = [
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
    let sum = C.iter().enumerate().fold(0.999_999_999_999_809_9, |sum, (i, c)| sum + c / (x + i as f64 + 1.0));
    let t = x + 7.5;
    0.5 * std::f64::consts::TAU.ln() + (x + 0.5) * t.ln() - t + sum.ln()
}

/// `ln (x^a e^{−x}/Γ(a))`.
fn ln_leading(a: f64, x: f64) -> f64 {
    a * x.ln() - x - ln_gamma(a)
}

/// The lower incomplete gamma function `P(a, x)` by its series (Abramowitz and Stegun 6.5.29), for x below the mean.
fn series_below(a: f64, x: f64) -> f64 {
    let (mut term, mut sum, mut n) = (1.0 / a, 1.0 / a, a);
    while term > 1e-17 * sum {
        n += 1.0;
        term *= x / n;
        sum += term;
    }
    (ln_leading(a, x).exp() * sum).min(1.0)
}

/// `ln Q(a, x)` of the upper one by its continued fraction (6.5.31), for x above the mean.
fn ln_fraction_above(a: f64, x: f64) -> f64 {
    let (mut b, mut c) = (x + 1.0 - a, f64::MAX);
    let mut d = 1.0 / b;
    let mut fraction = d;
    // Some √a steps are enough.
    for i in 1..100_000 {
        let i = f64::from(i);
        let an = -i * (i - a);
        b += 2.0;
        d = 1.0 / (an * d + b);
        c = b + an / c;
        fraction *= c * d;
        if (c * d - 1.0).abs() < 1e-15 {
            break;
        }
    }
    (ln_leading(a, x) + fraction.ln()).min(0.0)
}

/// Probabilities that χ² of `dof` degrees of freedom lies below and above `dof * per_dof`.
pub fn chi2_tails(per_dof: f64, dof: f64) -> (f64, f64) {
    let (a, x) = (0.5 * dof, 0.5 * dof * per_dof);
    if x.is_nan() || x <= 0.0 || a <= 0.0 {
        return (0.0, 1.0);
    }
    if x < a + 1.0 {
        let below = series_below(a, x);
        return (below, 1.0 - below);
    }
    let above = ln_fraction_above(a, x).exp();
    (1.0 - above, above)
}

/// Logarithm of the probability that χ² of `dof` degrees of freedom is above `chi2`; finite where the probability
/// underflows.
pub fn ln_chi2_above(chi2: f64, dof: f64) -> f64 {
    let (a, x) = (0.5 * dof, 0.5 * chi2);
    if x.is_nan() || x <= 0.0 || a <= 0.0 {
        return 0.0;
    }
    if x < a + 1.0 { (-series_below(a, x)).ln_1p() } else { ln_fraction_above(a, x) }
}

/// Probability that a normal number is so many σ from its mean or more, on either side.
pub fn normal_tails(sigmas: f64) -> f64 {
    ln_chi2_above(sigmas * sigmas, 1.0).exp()
}

/// Two-sided p-value of a χ²/dof.
pub fn two_sided(per_dof: f64, dof: f64) -> f64 {
    let (below, above) = chi2_tails(per_dof, dof);
    (2.0 * below.min(above)).min(1.0)
}

/// The χ²/dof below which a part `p` of all draws lies.
pub fn chi2_per_dof_quantile(p: f64, dof: f64) -> f64 {
    let (mut low, mut high) = (0.0, 1.0);
    while chi2_tails(high, dof).0 < p && high < 1e9 {
        high *= 2.0;
    }
    for _ in 0..60 {
        let middle = 0.5 * (low + high);
        if chi2_tails(middle, dof).0 < p { low = middle } else { high = middle }
    }
    0.5 * (low + high)
}

/// Probability that the largest distance of a Brownian bridge from zero exceeds `x` (Kolmogorov 1933).
pub fn kolmogorov(x: f64) -> f64 {
    // The alternating series needs many terms where the chance is one anyway.
    if x < 0.2 {
        return 1.0;
    }
    let term = |k: i32| f64::from(if k % 2 == 1 { 2 } else { -2 }) * (-2.0 * (f64::from(k) * x).powi(2)).exp();
    (1..50).map(term).sum::<f64>().clamp(0.0, 1.0)
}

/// p-value of the best of `tried` (Šidák): `1 − (1 − p)^n`.
pub fn corrected(p: f64, tried: f64) -> f64 {
    (-(tried * (-p).ln_1p()).exp_m1()).clamp(0.0, 1.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Tables of χ²: P(χ²₁ > 3.841459) = 0.05, P(χ²₂ > 2 ln 100) = 0.01, P(χ²₂₀ < 10.85081) = 0.05, P(χ²₉ > 60) =
    /// 1.3378e-9, and `P(χ²₂ > 2x) = e^{-x}` far out.
    #[test]
    fn tails_are_those_of_the_tables() {
        let above = |chi2: f64, dof: f64| chi2_tails(chi2 / dof, dof).1;
        assert!((above(3.841_459, 1.0) - 0.05).abs() < 1e-7);
        assert!((above(2.0 * 100f64.ln(), 2.0) - 0.01).abs() < 1e-12);
        assert!((chi2_tails(10.850_81 / 20.0, 20.0).0 - 0.05).abs() < 1e-6);
        assert!((above(120.0, 2.0) / (-60f64).exp() - 1.0).abs() < 1e-10);
        // A hundred thousand degrees of freedom, two deviations up: the normal 0.022750 and Edgeworth's √(8/dof)/6
        // (z²−1) φ(z).
        let far = above(1e5 + 2.0 * (2e5f64).sqrt(), 1e5);
        assert!((far / (0.022_750 + 0.000_241) - 1.0).abs() < 1e-3, "{far}");
        for (p, dof) in [(0.025, 3.0), (0.975, 3.0), (0.5, 1e4)] {
            assert!((chi2_tails(chi2_per_dof_quantile(p, dof), dof).0 - p).abs() < 1e-9);
        }
    }

    /// Where the probability underflows its logarithm is finite: for two degrees of freedom `−χ²/2`, for one that of
    /// the leading terms `e^{−χ²/2} √(2/(π χ²)) (1 − 1/χ²)`.
    #[test]
    fn the_logarithm_of_a_probability_is_finite_however_small() {
        let chi2: f64 = 4000.0;
        assert!((ln_chi2_above(chi2, 2.0) + 0.5 * chi2).abs() < 1e-9);
        let leading = -0.5 * chi2 - 0.5 * (std::f64::consts::FRAC_PI_2 * chi2).ln() + (-chi2.recip()).ln_1p();
        assert!((ln_chi2_above(chi2, 1.0) - leading).abs() < 1e-6);
        assert!((ln_chi2_above(0.1, 1.0) - 0.751_829_634_f64.ln()).abs() < 1e-8);
        assert!((normal_tails(1.0) - 0.317_310_508).abs() < 1e-9);
    }

    #[test]
    fn a_p_value_is_corrected_for_all_trials() {
        assert!((corrected(1e-6, 1000.0) - 1e-3).abs() < 1e-6);
        assert_eq!(corrected(0.5, 1e6), 1.0);
    }

    /// The classical 5 % point 1.3581 and 1 % point 1.6276.
    #[test]
    fn kolmogorov_s_points_are_those_of_the_tables() {
        assert!((kolmogorov(1.358_1) - 0.05).abs() < 1e-5 && (kolmogorov(1.627_6) - 0.01).abs() < 1e-5);
        assert!(kolmogorov(0.1) == 1.0 && (kolmogorov(0.3) - 1.0).abs() < 1e-4);
    }
}
