//! Sums of several days with the powers of time that a rate needs.
//!
//! A coefficient that changes at a constant rate acts through its series and through the series times the time. The
//! cross-spectra of both are those of the series, summed over days with weights 1, t and t², t in days. So what is kept
//! of some days is three sums, whatever their number, and any of their coefficients may have a rate.

use crate::spectra::Spectra;

/// Cross-spectra of some days times 1, t and t², with t in days from an origin of the caller's.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Moments {
    /// The sums.
    pub spectra: Spectra,
    /// Packed lower triangles as in `spectra`, times t.
    pub first: Vec<f64>,
    /// The same times t².
    pub second: Vec<f64>,
}

impl Moments {
    /// Of one day, the middle of whose data lies `days` after the origin.
    pub fn of_day(spectra: Spectra, days: f64) -> Self {
        let times = |factor: f64| spectra.packed.iter().map(|x| factor * x).collect();
        Self { first: times(days), second: times(days * days), spectra }
    }

    /// About an origin that lies `days` earlier.
    pub fn shifted(mut self, days: f64) -> Self {
        let lower = self.spectra.packed.iter().zip(&self.first);
        for (second, (sum, first)) in self.second.iter_mut().zip(lower) {
            *second += 2.0 * days * first + days * days * sum;
        }
        for (first, sum) in self.first.iter_mut().zip(&self.spectra.packed) {
            *first += days * sum;
        }
        self
    }

    /// Adds the sums of other days, about the same origin.
    pub fn add(&mut self, other: &Self) {
        if self.spectra.packed.is_empty() {
            self.clone_from(other);
            return;
        }
        self.spectra.add(&other.spectra);
        for (own, other) in [(&mut self.first, &other.first), (&mut self.second, &other.second)] {
            own.iter_mut().zip(other).for_each(|(a, b)| *a += b);
        }
    }

    /// The sums times the `power`-th power of t.
    pub(crate) fn power(&self, power: usize) -> &[f64] {
        match power {
            0 => &self.spectra.packed,
            1 => &self.first,
            _ => &self.second,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn day(value: f64, days: f64) -> Moments {
        let spectra = Spectra { packed: vec![value, 0.3 * value], expected: vec![1.0], ..Spectra::default() };
        Moments::of_day(spectra, days)
    }

    /// `Σ G (t + s)ᵏ` written out, for three days about another origin.
    #[test]
    fn another_origin_is_a_shift_of_time() {
        let all = [(2.0, -3.5), (-1.0, 0.25), (5.0, 11.0)];
        let mut sum = Moments::default();
        all.iter().for_each(|(value, days)| sum.add(&day(*value, *days)));
        let shifted = sum.shifted(4.0);
        for power in 0..3 {
            let direct: f64 = all.iter().map(|(value, days)| value * (days + 4.0_f64).powi(power)).sum();
            let found = shifted.power(power as usize);
            assert!(
                (found[0] - direct).abs() < 1e-12 * direct.abs() && (found[1] - 0.3 * direct).abs() < 1e-11,
                "{power}"
            );
        }
        assert_eq!(shifted.spectra.expected, [3.0]);
    }

    /// Days added in another order have other bits: why sums of many days are added in a tree whose shape is fixed.
    #[test]
    fn the_order_of_addition_shows() {
        let days: Vec<Moments> = (1..=8).map(|k| day(0.1 * f64::from(k), 0.3 * f64::from(k))).collect();
        let add = |order: &[usize]| {
            let mut sum = Moments::default();
            order.iter().for_each(|k| sum.add(&days[*k]));
            sum
        };
        let forward = add(&[0, 1, 2, 3, 4, 5, 6, 7]);
        assert_eq!(forward, add(&[0, 1, 2, 3, 4, 5, 6, 7]));
        let orders = [[7, 6, 5, 4, 3, 2, 1, 0], [3, 0, 6, 1, 7, 2, 5, 4], [4, 5, 6, 7, 0, 1, 2, 3]];
        assert!(orders.iter().any(|order| add(order) != forward));
    }
}
