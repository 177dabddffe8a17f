//! Power of a series octave by octave: of white noise each octave has the same.
//!
//! Haar's wavelets: of two neighbours a and b, `(a − b)/√2` belongs to the upper octave and `(a + b)/√2` is passed on,
//! half as often. For white Gaussian noise of variance σ² all of them are independent with that variance, so that n of
//! an octave have `Σ d²/σ²` distributed as χ² with n degrees of freedom, whatever the other octaves do. Memory is
//! fixed, and a sample costs two steps on average however long the series is.

use dragfree_sdk::state::{State, StateError};

/// At 10 Hz the lowest octave ends at 38 µHz; what is slower is not looked at.
pub const OCTAVES: usize = 17;

/// Sums of squares so far; the first octave is the highest, from a quarter of the sampling rate to half of it.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Octaves {
    /// The first of two neighbours, where it waits for the second.
    waiting: [Option<f64>; OCTAVES],
    sum: [f64; OCTAVES],
    count: [u64; OCTAVES],
}

impl Octaves {
    /// The next sample.
    pub fn push(&mut self, sample: f64) {
        let mut sample = sample;
        for octave in 0..OCTAVES {
            let Some(first) = self.waiting[octave].take() else {
                self.waiting[octave] = Some(sample);
                return;
            };
            self.sum[octave] += 0.5 * (first - sample) * (first - sample);
            self.count[octave] += 1;
            sample = std::f64::consts::FRAC_1_SQRT_2 * (first + sample);
        }
    }

    /// The next sample does not follow the last one.
    pub fn interrupt(&mut self) {
        self.waiting = [None; OCTAVES];
    }

    /// Mean square and degrees of freedom of each octave that has any, the highest first.
    pub fn powers(&self) -> impl Iterator<Item = (f64, u64)> + '_ {
        let seen = |(sum, n): (&f64, &u64)| (*n > 0).then(|| (sum / *n as f64, *n));
        self.sum.iter().zip(&self.count).map_while(seen)
    }

    /// Visits all that the next sample depends on.
    pub(crate) fn visit(&mut self, state: &mut State<'_>) -> Result<(), StateError> {
        self.waiting.iter_mut().try_for_each(|waiting| state.option(waiting, State::f64))?;
        state.f64s(&mut self.sum)?;
        self.count.iter_mut().try_for_each(|n| state.u64(n))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;
    use rand_distr::{Distribution, StandardNormal};
    use rand_xoshiro::Xoshiro256PlusPlus;

    fn octaves(samples: impl IntoIterator<Item = f64>) -> Octaves {
        let mut octaves = Octaves::default();
        samples.into_iter().for_each(|x| octaves.push(x));
        octaves
    }

    fn noise(n: usize) -> Vec<f64> {
        let mut rng = Xoshiro256PlusPlus::seed_from_u64(3);
        (0..n).map(|_| StandardNormal.sample(&mut rng)).collect()
    }

    /// Each octave within 4.9σ of χ², 1e-6 each.
    #[test]
    fn white_noise_has_the_same_power_in_every_octave() {
        let found: Vec<(f64, u64)> = octaves(noise(1 << 16)).powers().collect();
        assert_eq!(
            found.iter().map(|(_, n)| *n).collect::<Vec<_>>(),
            (0..16).map(|o| 1 << (15 - o)).collect::<Vec<_>>()
        );
        for (power, n) in found.iter().filter(|(_, n)| *n >= 64) {
            assert!((power - 1.0).abs() < 4.9 * (2.0 / *n as f64).sqrt(), "{found:?}");
        }
    }

    /// The twin: a sum of neighbours `(x_k + x_{k+1})/√2` has the spectrum `1 + cos 2πfΔt`. Of it the highest octave
    /// sees `(x_0 − x_2)/2`, of variance 1/2, where 0.02 is 5σ; the octaves far below tend to 2.
    #[test]
    fn what_is_coloured_is_seen_at_its_octave() {
        let x = noise(1 << 16);
        let smooth = x.windows(2).map(|w| std::f64::consts::FRAC_1_SQRT_2 * (w[0] + w[1]));
        let found: Vec<(f64, u64)> = octaves(smooth).powers().collect();
        assert!((found[0].0 - 0.5).abs() < 0.02 && found[1].0 > 1.1 && found[5].0 > 1.5, "{found:?}");
    }

    /// Nothing is paired across a gap.
    #[test]
    fn a_gap_pairs_nothing() {
        let mut two = octaves([1.0]);
        two.interrupt();
        two.push(2.0);
        assert_eq!(two.powers().count(), 0);
        two.push(4.0);
        assert_eq!(two.powers().collect::<Vec<_>>(), [(2.0, 1)]);
    }
}
