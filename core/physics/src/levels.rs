//! Fit of two noise levels to the spectrum of a second difference.

/// Spectral densities of a channel's noise, one-sided: held acceleration, and readout before it is differenced.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Levels {
    /// `a`, the channel's unit squared per Hz.
    pub held: f64,
    /// `b`, the same times s⁴.
    pub readout: f64,
}

/// The power response of a second difference to an acceleration that is held over a sample, `cos²(πf dt)`, and to a
/// readout, `(4 sin²(πf dt)/dt²)²`.
pub fn responses(frequency_hz: f64, dt_s: f64) -> [f64; 2] {
    let (sin, cos) = (std::f64::consts::PI * frequency_hz * dt_s).sin_cos();
    [cos * cos, (4.0 * sin * sin / (dt_s * dt_s)).powi(2)]
}

/// A bin or band of a spectrum: frequency, Hz; PSD; weight, proportional to its observations.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Bin {
    /// Hz.
    pub frequency_hz: f64,
    /// One-sided PSD.
    pub psd: f64,
    /// Weight.
    pub weight: f64,
}

/// Least-squares fit of `a cos² + b (4 sin²/dt²)²` to a spectrum, in relative misfit. Bins without power or weight are
/// omitted; `None` if none is left.
pub fn fit(bins: &[Bin], dt_s: f64) -> Option<Levels> {
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
        // A level falls by a factor of four at most per step, and stays positive.
        (held, readout) = (held * x.max(0.25), readout * y.max(0.25));
    }
    Some(Levels { held, readout })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn levels_are_found_from_their_spectrum() {
        let bin =
            |f: f64, of: &dyn Fn([f64; 2]) -> f64| Bin { frequency_hz: f, psd: of(responses(f, 0.1)), weight: 1.0 };
        let bins: Vec<Bin> = (1..400).map(|k| bin(0.0125 * f64::from(k), &|r| 3e-21 * r[0] + 5e-18 * r[1])).collect();
        let l = fit(&bins, 0.1).expect("levels");
        assert!((l.held / 3e-21 - 1.0).abs() < 1e-9 && (l.readout / 5e-18 - 1.0).abs() < 1e-9, "{l:?}");
        assert_eq!(fit(&[], 0.1), None);
        assert_eq!(fit(&[Bin { frequency_hz: 1.0, psd: f64::NAN, weight: 1.0 }], 0.1), None);
    }
}
