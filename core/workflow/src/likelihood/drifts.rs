//! Coefficients and levels of noise that change through the data at a constant rate.
//!
//! The rate of a parameter needs no series of its own: what it adds in a block of time is what the parameter adds,
//! times the time ([`Moments`]). A coefficient that is neither in the model nor named is tried with its value beside
//! its rate.

use dragfree_identification::diagnosis::{DRIFT, Drift};
use dragfree_identification::innovations::decision::{Candidate, Fitted, Quadratic};
use dragfree_identification::innovations::filter::DAY_NS;
use dragfree_schema::{AT_NS, Coefficient, FREQUENCY_HZ, Settings};

use super::{Decided, Judge, Meaning, no_sums};
use crate::proposals::FORMULA;

/// Whether a candidate's time, frequency or formula was chosen by these data: its rate has as many trials as that
/// search, and one that acts once has no rate.
fn searched(c: &Coefficient) -> bool {
    c.effect == FORMULA || [AT_NS, FREQUENCY_HZ].iter().any(|name| c.shape.contains_key(*name))
}

/// A parameter with a rate.
struct Changing {
    parameter: usize,
    /// Whether its value is an unknown too that the set does not have.
    with_value: bool,
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
        let log10_p = |f: &Fitted, c: &Changing| judge.log10_p(DRIFT, f.gain, 1 + usize::from(c.with_value));
        let name = |c: &Changing| self.parameters[c.parameter].0.clone();
        let mut set = chosen;
        let mut found = Vec::new();
        while found.len() < settings.max_added {
            let left = (0..changing.len()).filter(|k| !set.contains(&(first + k)));
            let tried: Vec<(usize, Fitted)> = left
                .filter(|k| quadratic.observable(first + k, &set))
                .map(|k| (k, quadratic.beside(first + k, &set)))
                .filter(|(_, f)| f.beyond <= settings.range_sigmas.powi(2))
                .collect();
            let p = |(k, f): &&(usize, Fitted)| log10_p(f, &changing[*k]);
            let Some(best) = tried.iter().min_by(|a, b| p(a).total_cmp(&p(b))) else { break };
            if p(&best) >= settings.false_alarm.log10() {
                break;
            }
            let (k, fitted) = best;
            // Twice the logarithm of the ratio of likelihoods, of as many values.
            let likely = |(other, f): &&(usize, Fitted)| {
                let [own, of] = [*k, *other].map(|i| f64::from(u8::from(changing[i].with_value)));
                let worse = 0.5 * (fitted.gain - f.gain) + of - own;
                other != k && (-worse).exp() > settings.false_alarm
            };
            let confounders = tried.iter().filter(likely).map(|(other, _)| name(&changing[*other])).collect();
            set.push(first + k);
            // Its value at half the time beside its rate: data that lie more on one side of it give another one alone.
            let middle = quadratic.values(&set)[changing[*k].parameter];
            found.push(self.drift(&changing[*k], fitted, (middle, days), (10f64.powf(p(&best)), confounders)));
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
                let with_value = place(i).is_some_and(|place| !chosen.contains(&place));
                Some(Changing { parameter: i, with_value })
            }
            Meaning::Level => Some(Changing { parameter: i, with_value: false }),
            Meaning::Power | Meaning::Number(_) => None,
        };
        (0..self.parameters.len()).filter_map(of).collect()
    }

    /// The likelihood with the rates as further parameters and candidates, per day about an instant.
    fn with_rates(&self, changing: &[Changing], days: f64, about_ns: i64) -> Quadratic {
        let p = self.parameters.len();
        let mut sums = no_sums(p + changing.len());
        for part in &self.parts {
            let mut own = no_sums(p);
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
            let value = c.with_value.then_some((c.parameter, lower, upper));
            let all = value.into_iter().chain([(p + k, -fastest, fastest)]);
            let (mut parameters, mut ends) = (Vec::new(), (Vec::new(), Vec::new()));
            for (i, lower, upper) in all {
                parameters.push(i);
                ends.0.push(lower);
                ends.1.push(upper);
            }
            let prior_sigma = vec![f64::INFINITY; parameters.len()];
            Candidate { parameters, lower: ends.0, upper: ends.1, prior_sigma, ln_prior: 0.0, shaped: false }
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
        let last = fitted.values.len() - 1;
        let per_day = fitted.values[last];
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
            sigma_per_day: fitted.covariance[(last, last)].max(0.0).sqrt(),
            delta_chi2: fitted.gain,
            p_value: evidence.0,
            confounders: evidence.1,
        }
    }
}
