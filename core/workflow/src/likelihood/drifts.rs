//! Coefficients and levels of noise that change through the data at a constant rate.
//!
//! The rate of a parameter needs no series of its own: what it adds in a block of time is what the parameter adds,
//! times the time ([`Moments`]). Beside the rate of a coefficient that is neither in the model nor named the values of
//! its effect are unknown too. What they explain is no evidence of a change: their form is the best of many, and was
//! not good enough to be named.

use dragfree_identification::diagnosis::{DRIFT, Drift};
use dragfree_identification::innovations::decision::{Candidate, Fitted, Quadratic};
use dragfree_identification::innovations::filter::{DAY_NS, Sums};
use dragfree_schema::{AT_NS, Coefficient, FREQUENCY_HZ, Settings};

use super::{Decided, Judge, Meaning};
use crate::proposals::FORMULA;

/// Whether a candidate's time, frequency or formula was chosen by these data: its rate has as many trials as that
/// search, and one that acts once has no rate.
fn searched(c: &Coefficient) -> bool {
    c.effect == FORMULA || [AT_NS, FREQUENCY_HZ].iter().any(|name| c.shape.contains_key(*name))
}

/// A parameter with a rate.
struct Changing {
    parameter: usize,
    /// The candidate whose values are unknown beside its rate; none where they are in the model or named.
    beside: Option<usize>,
}

/// A rate that was tried.
struct Tried {
    /// Index among those that may change.
    changing: usize,
    /// The rate, its effect's values fitted beside it.
    rate: Fitted,
    /// By how much χ² falls with the rate and with these values.
    gain: f64,
    /// Number of these values.
    values: usize,
    log10_p: f64,
}

impl Decided {
    /// What changes beside the effects that are named, the most significant first. `None` where time is not known.
    pub(crate) fn drifts(&self, settings: &Settings, judge: &dyn Judge) -> Vec<Drift> {
        let Some((from_ns, until_ns)) = self.span_ns() else { return Vec::new() };
        let days = (until_ns - from_ns) as f64 / DAY_NS;
        let chosen: Vec<usize> = self.selection.chosen.iter().map(|f| f.candidate).collect();
        let changing = self.changing(&chosen);
        if days <= 0.0 || changing.is_empty() {
            return Vec::new();
        }
        let quadratic = self.with_rates(&changing, days, i64::midpoint(from_ns, until_ns));
        let first = self.candidates.len();
        let name = |k: usize| self.parameters[changing[k].parameter].0.clone();
        let with_values = |k: usize, set: &[usize]| -> Vec<usize> {
            let own = changing[k].beside.filter(|own| !set.contains(own));
            set.iter().copied().chain(own).collect()
        };
        let mut set = chosen;
        let mut found = Vec::new();
        while found.len() < settings.max_added {
            let without = quadratic.gain(&set);
            let try_rate = |k: usize| {
                let beside = with_values(k, &set);
                let is_observable = |candidate: &usize| quadratic.observable(*candidate, &beside);
                if !beside[set.len()..].iter().chain([&(first + k)]).all(is_observable) {
                    return None;
                }
                let rate = quadratic.beside(first + k, &beside);
                let values = beside[set.len()..].iter().map(|own| self.candidates[*own].parameters.len()).sum();
                let gain = quadratic.gain(&beside) + rate.gain - without;
                let log10_p = judge.log10_p(DRIFT, rate.gain, 1);
                let is_inside = rate.beyond <= settings.range_sigmas.powi(2);
                is_inside.then_some(Tried { changing: k, rate, gain, values, log10_p })
            };
            let left = (0..changing.len()).filter(|k| !set.contains(&(first + k)));
            let tried: Vec<Tried> = left.filter_map(try_rate).collect();
            let Some(best) = tried.iter().min_by(|a, b| a.log10_p.total_cmp(&b.log10_p)) else { break };
            if best.log10_p >= settings.false_alarm.log10() {
                break;
            }
            // Twice the logarithm of the ratio of likelihoods, of as many values.
            let likely = |other: &&Tried| {
                let worse = 0.5 * (best.gain - other.gain) + other.values as f64 - best.values as f64;
                other.changing != best.changing && (-worse).exp() > settings.false_alarm
            };
            let confounders = tried.iter().filter(likely).map(|other| name(other.changing)).collect();
            set = with_values(best.changing, &set);
            set.push(first + best.changing);
            // Its value at half the time beside its rate: data that lie more on one side of it give another one alone.
            let changing = &changing[best.changing];
            let middle = quadratic.values(&set)[changing.parameter];
            found.push(self.drift(changing, &best.rate, (middle, days), (10f64.powf(best.log10_p), confounders)));
        }
        found
    }

    /// Mean times of the first and of the last block of all products, Unix ns.
    fn span_ns(&self) -> Option<(i64, i64)> {
        let all = || self.parts.iter().filter_map(|part| part.moments.as_ref());
        Some((all().map(|m| m.from_ns).min()?, all().map(|m| m.until_ns).max()?))
    }

    /// Coefficients and levels that may change.
    fn changing(&self, chosen: &[usize]) -> Vec<Changing> {
        let place = |i: usize| self.candidates.iter().position(|place| place.parameters.contains(&i));
        let of = |i: usize| match &self.parameters[i].1 {
            Meaning::Coefficient(c) if c.candidate && searched(c) => None,
            Meaning::Coefficient(_) => {
                Some(Changing { parameter: i, beside: place(i).filter(|place| !chosen.contains(place)) })
            }
            Meaning::Level => Some(Changing { parameter: i, beside: None }),
            Meaning::Power | Meaning::Number(_) => None,
        };
        (0..self.parameters.len()).filter_map(of).collect()
    }

    /// The likelihood with the rates as further parameters and candidates, per day about an instant.
    fn with_rates(&self, changing: &[Changing], days: f64, about_ns: i64) -> Quadratic {
        let p = self.parameters.len();
        let mut sums = Sums::zeros(p + changing.len(), 0);
        for part in &self.parts {
            let mut own = Sums::zeros(p, 0);
            part.add_to(&mut own);
            for i in 0..p {
                sums.score[i] += own.score[i];
                (0..p).for_each(|j| sums.information[(i, j)] += own.information[(i, j)]);
            }
            sums.numbers += own.numbers;
            let Some(moments) = &part.moments else { continue };
            let moments = moments.about(&part.sums, about_ns);
            let own = |all: usize| part.places.iter().find(|(_, to)| *to == all).map(|(own, _)| *own);
            for (k, c) in changing.iter().enumerate() {
                let Some(i) = own(c.parameter) else { continue };
                sums.score[p + k] += moments.score[i];
                for (j, all) in &part.places {
                    sums.information[(p + k, *all)] += moments.once[(i, *j)];
                    sums.information[(*all, p + k)] += moments.once[(i, *j)];
                }
                for (l, other) in changing.iter().enumerate() {
                    let Some(j) = own(other.parameter) else { continue };
                    sums.information[(p + k, p + l)] += moments.twice[(i, j)];
                }
            }
        }
        let start: Vec<f64> = self.start.iter().copied().chain(changing.iter().map(|_| 0.0)).collect();
        let rate = |(k, c): (usize, &Changing)| {
            let [lower, upper] = match &self.parameters[c.parameter].1 {
                Meaning::Coefficient(of) => [of.lower, of.upper],
                Meaning::Level | Meaning::Power | Meaning::Number(_) => [f64::NEG_INFINITY, f64::INFINITY],
            };
            // A value that stays in its range cannot change by more than its width.
            let fastest = (upper - lower) / days;
            Candidate { lower: vec![-fastest], upper: vec![fastest], ..Candidate::free(p + k) }
        };
        let rates = changing.iter().enumerate().map(rate);
        let candidates = self.quadratic.candidates().iter().cloned().chain(rates).collect();
        Quadratic::new(&sums, &start, &self.priors, candidates)
    }

    fn drift(
        &self,
        changing: &Changing,
        fitted: &Fitted,
        (middle, days): (f64, f64),
        evidence: (f64, Vec<String>),
    ) -> Drift {
        let (name, meaning) = &self.parameters[changing.parameter];
        let per_day = fitted.values[0];
        let ends = [-0.5, 0.5].map(|part| middle + part * days * per_day);
        let (unit, [at_start, at_end]) = match meaning {
            Meaning::Coefficient(c) => (c.unit.clone(), ends),
            Meaning::Level | Meaning::Power | Meaning::Number(_) => ("1".to_owned(), ends.map(f64::exp)),
        };
        Drift {
            coefficient: name.clone(),
            unit,
            at_start,
            at_end,
            per_day,
            sigma_per_day: fitted.covariance[(0, 0)].max(0.0).sqrt(),
            delta_chi2: fitted.gain,
            p_value: evidence.0,
            confounders: evidence.1,
        }
    }
}

#[cfg(test)]
mod tests {
    use dragfree_identification::innovations::filter::Moments;
    use nalgebra::{DMatrix, DVector};
    use serde_json::json;

    use super::super::{How, Joined, Part, Point};
    use super::*;

    /// Gaussian tails, whatever was tried.
    struct OneTrial;

    impl Judge for OneTrial {
        fn log10_p(&self, _: &str, gain: f64, _: usize) -> f64 {
            -0.2 * gain
        }

        fn ln_prior(&self, _: &str, _: &str, _: &str) -> f64 {
            0.0
        }
    }

    /// Drifts of one candidate with a lag, which is not named, in a day of data without noise, whose information is one
    /// and lies `mean` ± `spread` days from the middle of the day: its value there and its rate per day.
    fn drifts(value: f64, rate: f64, (mean, spread): (f64, f64)) -> Vec<Drift> {
        let coefficient = Coefficient {
            name: "thermal.tm1.x".to_owned(),
            effect: "thermal".to_owned(),
            instance: "tm1.x".to_owned(),
            candidate: true,
            shape: [("lag_s".to_owned(), json!(480.0))].into_iter().collect(),
            ..Coefficient::default()
        };
        let mut all = Joined::default();
        let place = all.place((coefficient.name.clone(), Meaning::Coefficient(Box::new(coefficient))));
        // Moments of time since the begin of the day.
        let (once, squared) = (0.5 + mean, (0.5 + mean).powi(2) + spread * spread);
        let at_begin = value - 0.5 * rate;
        let mut sums = Sums::zeros(1, 0);
        (sums.information, sums.score, sums.numbers) = (DMatrix::identity(1, 1), vec![at_begin + rate * once], 1e4);
        let moments = Moments {
            from_ns: 0,
            until_ns: DAY_NS as i64,
            once: &sums.information * once,
            twice: &sums.information * squared,
            score: DVector::from_vec(vec![at_begin * once + rate * squared]),
        };
        all.parts.push(Part { sums, moments: Some(moments), stretches: Vec::new(), places: vec![(0, place)] });
        let mut decided = all.decided(&Point::default(), How::Select, &Settings::default(), &OneTrial, Vec::new());
        decided.selection.chosen.clear();
        decided.drifts(&Settings::default(), &OneTrial)
    }

    /// A constant value is no change, however much it explains: it is the best of all lags and thermometers.
    #[test]
    fn a_value_that_is_not_named_is_no_drift() {
        assert!(drifts(5.5, 0.0, (0.0, 0.3)).is_empty());
        assert!(drifts(5.5, 0.0, (0.2, 0.2)).is_empty());
    }

    /// What changes is told with what the change alone explains, and with its values at both ends of the day wherever
    /// in it the data lie.
    #[test]
    fn a_rate_is_told_with_the_values_at_both_ends() {
        for (mean, spread) in [(0.0, 0.3), (0.2, 0.2)] {
            let [drift] = &drifts(2.0, 20.0, (mean, spread))[..] else { panic!("one drift of data about {mean}") };
            let expected = [-8.0, 12.0, 20.0, spread.recip(), (20.0 * spread).powi(2)];
            let found = [drift.at_start, drift.at_end, drift.per_day, drift.sigma_per_day, drift.delta_chi2];
            for (found, expected) in found.iter().zip(expected) {
                assert!((found / expected - 1.0).abs() < 1e-6, "{found} for {expected}: {drift:?}");
            }
        }
    }
}
