//! A solution of many days in the terms of its product.

use dragfree_estimation::estimate::Estimate;
use dragfree_estimation::joint::{self as many, Change};
use dragfree_estimation::stored::Stored;
use dragfree_identification::distributions::chi2_tails;
use nalgebra::DVector;

use super::days::Products;
use super::result::{Changed, Coefficient, Measured, Step};
use super::{Border, product};
use crate::days::{DAY_NS, start_of_day_ns};

/// What a solution is told as.
pub(super) struct Reported<'a> {
    pub(super) days: &'a Products,
    pub(super) borders: &'a [Border],
    pub(super) origin: f64,
    pub(super) last: i64,
    pub(super) false_alarm: f64,
}

impl Reported<'_> {
    /// Time of a step: of the last of its events.
    fn step_ns(&self, after: usize) -> i64 {
        let times = self.borders[after].events.iter().map(|e| e.time_ns);
        times.max().unwrap_or_else(|| start_of_day_ns(self.borders[after].after))
    }

    /// End of the last day's data, in days after the origin.
    fn end_days(&self) -> f64 {
        let end_ns = self.days[&self.last].1.header.non_standard_attributes.stop_time_epoch_ns;
        (end_ns - start_of_day_ns(self.last)) as f64 / DAY_NS as f64 + self.last as f64 - self.origin
    }

    pub(super) fn coefficients(&self, like: &Stored, solution: &many::Joint) -> Vec<Coefficient> {
        let Estimate { free, theta, covariance, .. } = &solution.solution.estimate;
        let of_free = free.iter().map(|i| theta[*i]);
        let estimated = DVector::from_iterator(free.len(), of_free);
        let sigma = |weights: &DVector<f64>| {
            covariance.as_ref().map_or(f64::NAN, |c| weights.dot(&(c * weights)).max(0.0).sqrt())
        };
        let change = |course: usize| {
            let at = free.iter().position(|i| *i == solution.of_day + course)?;
            let own = covariance.as_ref().map_or(f64::NAN, |c| c[(at, at)].sqrt());
            Some(Measured { value: estimated[at], sigma: own })
        };
        let rates = solution.courses.iter().filter(|c| c.change == Change::Rate).count();
        let changed = |size: Measured, tried: usize| {
            let p = chi2_tails((size.value / size.sigma).powi(2), 1.0).1;
            Changed { size, seen: p * tried as f64 <= self.false_alarm }
        };
        let mut all = Vec::new();
        for (i, c) in like.declared.coefficients.iter().enumerate().filter(|(i, _)| free.contains(i)) {
            let weights = solution.weights(i, self.end_days(), self.borders.len());
            let mut told = Coefficient {
                name: c.name.clone(),
                unit: c.unit.clone(),
                frame: c.frame.clone(),
                value: weights.dot(&estimated),
                sigma: sigma(&weights),
                rate: None,
                steps: Vec::new(),
            };
            for (number, course) in solution.courses.iter().enumerate().filter(|(_, c)| c.coefficient == i) {
                let Some(size) = change(number) else { continue };
                match course.change {
                    Change::Rate => {
                        let per_s = 1e9 / DAY_NS as f64;
                        let size = Measured { value: size.value * per_s, sigma: size.sigma * per_s };
                        told.rate = Some(changed(size, rates));
                    }
                    Change::Step(after) => told.steps.push(Step {
                        events: self.borders[after].events.iter().map(|e| e.time.clone()).collect(),
                        changed: changed(size, solution.courses.len() - rates),
                        time_ns: self.step_ns(after),
                    }),
                }
            }
            all.push(told);
        }
        all
    }

    /// Names of the product's coefficients, those of [`Self::coefficients`] with rates and steps behind each, and their
    /// covariance.
    pub(super) fn covariance(&self, like: &Stored, solution: &many::Joint) -> Option<(Vec<String>, Vec<Vec<f64>>)> {
        let Estimate { free, covariance, .. } = &solution.solution.estimate;
        let covariance = covariance.as_ref()?;
        let (mut names, mut rows) = (Vec::new(), Vec::new());
        for (i, c) in like.declared.coefficients.iter().enumerate().filter(|(i, _)| free.contains(i)) {
            names.push(c.name.clone());
            rows.push(solution.weights(i, self.end_days(), self.borders.len()));
            for (number, course) in solution.courses.iter().enumerate().filter(|(_, c)| c.coefficient == i) {
                let Some(at) = free.iter().position(|i| *i == solution.of_day + number) else { continue };
                let mut row = DVector::zeros(free.len());
                match course.change {
                    Change::Rate => {
                        names.push(product::rate(&c.name));
                        row[at] = 1e9 / DAY_NS as f64;
                    }
                    Change::Step(after) => {
                        names.push(product::step(&c.name, self.step_ns(after)));
                        row[at] = 1.0;
                    }
                }
                rows.push(row);
            }
        }
        let of = |a: &DVector<f64>| rows.iter().map(|b| a.dot(&(covariance * b))).collect();
        Some((names, rows.iter().map(of).collect()))
    }
}
