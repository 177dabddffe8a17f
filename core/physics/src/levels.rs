//! Fit of two noise levels to the spectrum of a second difference.

/// Spectral densities of a channel's noise, one-sided: held acceleration, and readout before it is differenced.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Levels {
    /// `a`, the channel's unit squared per Hz.
    pub held: f64,
    /// `b`, the same times s⁴.
    pub readout: f64,
}

/// Fitted levels.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Fitted {
    /// The levels.
    pub levels: Levels,
    /// σ of the logarithm of the held level, and of that of the readout, where the weights of the bins are the inverses
    /// of the relative variances of their PSDs.
    pub sigma: [f64; 2],
}

/// The power response of a second difference to an acceleration that is held over a sample, `cos²(πf dt)`, and to a
/// readout, `(4 sin²(πf dt)/dt²)²`.
pub fn responses(frequency_hz: f64, dt_s: f64) -> [f64; 2] {
    let (sin, cos) = (std::f64::consts::PI * frequency_hz * dt_s).sin_cos();
    [cos * cos, (4.0 * sin * sin / (dt_s * dt_s)).powi(2)]
}

/// A bin or band of a spectrum.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Bin {
    /// Hz.
    pub frequency_hz: f64,
    /// One-sided PSD.
    pub psd: f64,
    /// Weight, proportional to the inverse of the relative variance of the PSD.
    pub weight: f64,
}

/// Least-squares fit of `a cos² + b (4 sin²/dt²)²` to a spectrum, in relative misfit. Bins without power or weight are
/// omitted; `None` if none is left.
pub fn fit(bins: &[Bin], dt_s: f64) -> Option<Fitted> {
    let used: Vec<([f64; 2], Bin)> = bins
        .iter()
        .filter(|b| b.psd.is_finite() && b.psd > 0.0 && b.weight > 0.0)
        .map(|b| (responses(b.frequency_hz, dt_s), *b))
        .filter(|(r, _)| r[0] > 0.0 && r[1] > 0.0)
        .collect();
    // Start from upper bounds: each level alone cannot exceed the measured spectrum in any bin.
    let least = |i: usize| used.iter().map(|(r, b)| b.psd / r[i]).fold(f64::INFINITY, f64::min);
    let (mut held, mut readout) = (least(0), least(1));
    if used.is_empty() {
        return None;
    }
    let mut sigma = [f64::INFINITY; 2];
    for _ in 0..20 {
        let (mut aa, mut ab, mut bb, mut ay, mut by) = (0.0, 0.0, 0.0, 0.0, 0.0);
        for (r, bin) in &used {
            let model = held * r[0] + readout * r[1];
            // In units of the current levels, so that the unknowns are near one.
            let (p, q, s, w) = (held * r[0] / model, readout * r[1] / model, bin.psd / model, bin.weight);
            aa += w * p * p;
            ab += w * p * q;
            bb += w * q * q;
            ay += w * p * s;
            by += w * q * s;
        }
        let determinant = aa * bb - ab * ab;
        if determinant <= 1e-12 * aa * bb {
            break;
        }
        let (x, y) = ((ay * bb - by * ab) / determinant, (by * aa - ay * ab) / determinant);
        sigma = [(bb / determinant).sqrt(), (aa / determinant).sqrt()];
        // A level falls by a factor of four at most per step, and stays positive.
        (held, readout) = (held * x.max(0.25), readout * y.max(0.25));
    }
    Some(Fitted { levels: Levels { held, readout }, sigma })
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;
    use rand_distr::{Distribution, StandardNormal};
    use rand_xoshiro::Xoshiro256PlusPlus;

    use super::*;
    use crate::spectrum::welch;

    #[test]
    fn levels_are_found_from_their_spectrum() {
        let bin =
            |f: f64, of: &dyn Fn([f64; 2]) -> f64| Bin { frequency_hz: f, psd: of(responses(f, 0.1)), weight: 1.0 };
        let bins: Vec<Bin> = (1..400).map(|k| bin(0.0125 * f64::from(k), &|r| 3e-21 * r[0] + 5e-18 * r[1])).collect();
        let l = fit(&bins, 0.1).expect("levels").levels;
        assert!((l.held / 3e-21 - 1.0).abs() < 1e-9 && (l.readout / 5e-18 - 1.0).abs() < 1e-9, "{l:?}");
        assert_eq!(fit(&[], 0.1), None);
        assert_eq!(fit(&[Bin { frequency_hz: 1.0, psd: f64::NAN, weight: 1.0 }], 0.1), None);
    }

    /// The mean square of 200 pulls of each level: 1 ± 0.1, so 0.6 to 1.4 fails by chance once in 15000. Neighbouring
    /// bins taken for independent would give 1.9.
    #[test]
    fn levels_scatter_by_their_sigma() {
        let (held, readout, dt_s) = (3e-21, 8e-20, 0.1_f64);
        let mut random = Xoshiro256PlusPlus::seed_from_u64(1);
        let mut noise = |psd: f64, samples: usize| -> Vec<f64> {
            let sigma = (0.5 * psd / dt_s).sqrt();
            (0..samples).map(|_| sigma * Distribution::<f64>::sample(&StandardNormal, &mut random)).collect()
        };
        let mut squares = [0.0; 2];
        for _ in 0..200 {
            let (a, y) = (noise(held, 32_769), noise(readout, 32_770));
            let channel: Vec<f64> = (1..32_769)
                .map(|k| 0.5 * (a[k - 1] + a[k]) + (y[k + 1] - 2.0 * y[k] + y[k - 1]) / (dt_s * dt_s))
                .collect();
            let spectrum = welch(&channel, 1.0 / dt_s, 2048).expect("a spectrum");
            let bins: Vec<Bin> = (3..1000)
                .map(|k| Bin {
                    frequency_hz: spectrum.frequency_hz[k],
                    psd: spectrum.psd[k],
                    weight: spectrum.bin_weight(),
                })
                .collect();
            let Fitted { levels, sigma } = fit(&bins, dt_s).expect("levels");
            squares[0] += ((levels.held / held).ln() / sigma[0]).powi(2) / 200.0;
            squares[1] += ((levels.readout / readout).ln() / sigma[1]).powi(2) / 200.0;
        }
        assert!(squares.iter().all(|s| (0.6..1.4).contains(s)), "{squares:?}");
    }
}
