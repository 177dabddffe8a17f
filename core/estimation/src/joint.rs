//! One solution of many days, in which coefficients may change at a constant rate and in steps at known times.
//!
//! Days are given as sums ([`crate::moments`]) over *stretches*, between which coefficients may step. A rate and a step
//! are further coefficients: of the series times the time, and of the series from the step on. So a solution of many
//! days is one of the same kind as that of a day, with more columns: Σ from its residuals, constraints, covariance.
//!
//! Whether days agree is seen in the scores of single days at the solution ([`DayScore`]), which are independent.

use dragfree_schema::{Coefficient, Constraint, Settings};
use nalgebra::{DMatrix, DVector, SymmetricEigen};

use crate::estimate::{Bound, Estimate, EstimateError, Method, Observed, Refinement, zero_area_weights};
use crate::free_levels::{WithLevels, solve};
use crate::moments::Moments;
use crate::normal::{Split, accumulate};
use crate::spectra::{Layout, Plan, Regressor, Spectra, Sums, triangle};
use crate::stored::Declared;
use crate::verdict::chi2_per_dof_at;

/// Days between two steps.
#[derive(Clone, Debug)]
pub struct Stretch {
    /// Their sums, about one origin that all stretches share.
    pub sums: Moments,
    /// Middle of the stretch, days after the origin.
    pub middle_days: f64,
}

/// How a coefficient changes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Change {
    /// At a constant rate.
    Rate,
    /// By a step between a stretch and the next one, 0 between the first two.
    Step(usize),
}

impl Change {
    /// What a change of one unit adds to its coefficient.
    pub fn at(self, days: f64, stretch: usize) -> f64 {
        match self {
            Self::Rate => days,
            Self::Step(after) => f64::from(u8::from(stretch > after)),
        }
    }
}

/// A change of a coefficient, itself a coefficient.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Course {
    /// Index of the coefficient that changes.
    pub coefficient: usize,
    /// How.
    pub change: Change,
}

/// The data of many days.
#[derive(Clone, Copy)]
pub struct ManyDays<'a> {
    /// Channels, series and regressors of a day.
    pub layout: &'a Layout,
    /// Bands and segments.
    pub plan: &'a Plan,
    /// Noise, coefficients and constraints.
    pub declared: &'a Declared,
    /// Thresholds.
    pub settings: &'a Settings,
    /// At least one.
    pub stretches: &'a [Stretch],
    /// From the first day to the last one.
    pub length_days: f64,
}

/// A solution of many days.
pub struct Joint {
    /// Coefficients of a day, at the origin and before the first step.
    pub of_day: usize,
    /// Their changes, which follow them in the estimate.
    pub courses: Vec<Course>,
    /// The solution; changes are in units of their coefficient, rates in these per day.
    pub solution: WithLevels,
}

/// What a day alone says of the coefficients, at a solution of many: `W (θ_day − θ)` and W.
#[derive(Clone, Debug)]
pub struct DayScore {
    days: f64,
    stretch: usize,
    /// Information on the free coefficients of a day.
    information: DMatrix<f64>,
    /// Its score at the solution.
    score: DVector<f64>,
    /// χ² of the score when the day's coefficients are those of the solution.
    pub chi2: f64,
    /// Its degrees of freedom: directions that the day sees.
    pub dof: usize,
}

/// Whether days have the same coefficients.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Same {
    /// χ² of the differences of the days from what fits them all.
    pub chi2: f64,
    /// Its degrees of freedom.
    pub dof: usize,
}

/// Directions whose information is below this part of the largest one, each coefficient in its own σ, are not seen.
const UNSEEN: f64 = 1e-8;

impl ManyDays<'_> {
    /// Solves for the coefficients and for their changes.
    ///
    /// Of a product of two coefficients that both change, the product of the changes is left out.
    ///
    /// # Errors
    /// [`EstimateError`] as [`crate::estimate::estimate`].
    pub fn solve(&self, courses: &[Course]) -> Result<Joint, EstimateError> {
        let extended = Extended::new(self.layout, courses);
        let sums = self.sums(&extended);
        let mut coefficients = self.declared.coefficients.clone();
        coefficients.extend(courses.iter().map(|course| self.coefficient(course)));
        let bounds = Bound::all(&coefficients, &self.constraints(courses));
        let observed = Observed { layout: &extended.layout, plan: self.plan, sums: &sums, prediction: None };
        let method =
            Method { refinements: self.declared.refinements, refinement: self.refinement(), settings: self.settings };
        let solution = solve(&observed, &self.declared.noise, &coefficients, &bounds, &method)?;
        Ok(Joint { of_day: self.layout.coefficients.len(), courses: courses.to_vec(), solution })
    }

    /// Commands follow the very noise whose spectrum would be measured.
    fn refinement(&self) -> Refinement {
        if self.layout.in_loop().is_empty() { Refinement::Bands } else { Refinement::Levels }
    }

    /// A change as a coefficient: as large as the range of what changes.
    fn coefficient(&self, course: &Course) -> Coefficient {
        let of = &self.declared.coefficients[course.coefficient];
        let width = of.upper - of.lower;
        let name = change_name(&of.name, course.change);
        let declared = Coefficient { name, lower: -width, upper: width, initial: 0.0, ..of.clone() };
        Coefficient { noise: String::new(), colours: None, prior_sigma: f64::INFINITY, ..declared }
    }

    /// Constraints of a day on its coefficients and their changes.
    ///
    /// A range holds in the middle of every stretch. A survey knows a sum of coefficients once, at the origin: what is
    /// wrong with it is wrong at all times, and more rows would count it more often. As it holds at all times, a change
    /// of the sum is at most the difference of two values of its interval, whose half width h makes it σ = √2 h/√3.
    fn constraints(&self, courses: &[Course]) -> Vec<Constraint> {
        let mut changes: Vec<Change> = courses.iter().map(|course| course.change).collect();
        changes.sort_unstable();
        changes.dedup();
        let mut all = Vec::new();
        for constraint in &self.declared.constraints {
            if !constraint.is_survey() {
                for (number, stretch) in self.stretches.iter().enumerate() {
                    let mut terms = constraint.terms.clone();
                    for change in &changes {
                        terms.extend(self.terms_of(
                            constraint,
                            courses,
                            *change,
                            change.at(stretch.middle_days, number),
                        ));
                    }
                    all.push(Constraint { terms, ..constraint.clone() });
                }
                continue;
            }
            all.push(constraint.clone());
            let width = 0.5 * (constraint.upper - constraint.lower) * std::f64::consts::SQRT_2;
            for change in &changes {
                let by = if *change == Change::Rate { self.length_days } else { 1.0 };
                let terms = self.terms_of(constraint, courses, *change, by);
                if !terms.is_empty() && width.is_finite() {
                    let name = format!("change of {}", constraint.name);
                    all.push(Constraint { name, terms, lower: -width, upper: width, ..constraint.clone() });
                }
            }
        }
        all
    }

    /// Terms of a constraint, of one change of its coefficients.
    fn terms_of(&self, constraint: &Constraint, courses: &[Course], change: Change, by: f64) -> Vec<(String, f64)> {
        let changing = courses.iter().filter(|course| course.change == change && by != 0.0);
        let names: Vec<&str> = changing.map(|c| self.declared.coefficients[c.coefficient].name.as_str()).collect();
        let own = constraint.terms.iter().filter(|(of, _)| names.contains(&of.as_str()));
        own.map(|(of, weight)| (change_name(of, change), weight * by)).collect()
    }

    fn sums(&self, extended: &Extended) -> Sums {
        let mut sums = Sums::new(self.plan, &extended.layout);
        for (number, stretch) in self.stretches.iter().enumerate() {
            sums.total.add(&extended.spectra(&stretch.sums, number));
        }
        sums
    }

    /// What a day says alone, at a solution. `days` is its time after the origin.
    pub fn score(&self, joint: &Joint, spectra: &Spectra, days: f64, stretch: usize) -> DayScore {
        let Estimate { theta: all, inverses, .. } = &joint.solution.estimate;
        let mut theta = all.rows(0, joint.of_day).into_owned();
        for (course, value) in joint.courses.iter().zip(all.iter().skip(joint.of_day)) {
            theta[course.coefficient] += value * course.change.at(days, stretch);
        }
        let linear = self.layout.linear_at(theta.as_slice());
        let weights = match self.refinement() {
            Refinement::Levels => zero_area_weights(spectra, self.plan),
            Refinement::Bands => spectra.kept(),
        };
        let free = joint.free_of_day();
        let mut apart = self.layout.in_loop();
        apart.retain(|i| free.contains(i));
        let split = Split { spectra, slow_bands: self.plan.slow_bands, apart: &apart };
        let equations = split.accumulate(&linear, inverses, &weights);
        let normal = of_free(&equations.normal, &free);
        let right = &equations.right - &equations.normal * &theta;
        let right = DVector::from_fn(free.len(), |k, _| right[free[k]]);
        // What the score varies by: bands that count more than they know vary more.
        let more: Vec<f64> = weights.iter().zip(&spectra.kept()).map(|(w, k)| excess(*w, *k)).collect();
        let variance = if more.iter().all(|m| *m == 0.0) {
            normal.clone()
        } else {
            &normal + of_free(&accumulate(spectra, &linear, inverses, &more).normal, &free)
        };
        let (inverse, dof) = pseudo_inverse(&variance);
        let chi2 = right.dot(&(&inverse * &right));
        let weighted = &normal * &inverse;
        DayScore { days, stretch, information: &weighted * &normal, score: weighted * right, chi2, dof }
    }
}

/// By how much the variance of a score exceeds what it knows, for a band with weight `w` in place of `kept`.
fn excess(w: f64, kept: f64) -> f64 {
    if kept > 0.0 { w * (w / kept - 1.0) } else { 0.0 }
}

fn of_free(matrix: &DMatrix<f64>, free: &[usize]) -> DMatrix<f64> {
    DMatrix::from_fn(free.len(), free.len(), |i, j| matrix[(free[i], free[j])])
}

/// Name of a change among the coefficients.
fn change_name(of: &str, change: Change) -> String {
    match change {
        Change::Rate => format!("{of} rate"),
        Change::Step(after) => format!("{of} step {}", after + 1),
    }
}

impl Joint {
    /// Free coefficients of a day.
    pub fn free_of_day(&self) -> Vec<usize> {
        self.solution.estimate.free.iter().copied().filter(|i| *i < self.of_day).collect()
    }

    /// Weights of the estimated coefficients and changes in a coefficient of a day at a time.
    pub fn weights(&self, coefficient: usize, days: f64, stretch: usize) -> DVector<f64> {
        let free = &self.solution.estimate.free;
        DVector::from_fn(free.len(), |k, _| match free[k].checked_sub(self.of_day) {
            None => f64::from(u8::from(free[k] == coefficient)),
            Some(course) if self.courses[course].coefficient == coefficient => {
                self.courses[course].change.at(days, stretch)
            }
            Some(_) => 0.0,
        })
    }

    /// The free coefficients of a day at a time, one row each, as sums of what is estimated.
    fn design(&self, day: &DayScore) -> DMatrix<f64> {
        let rows: Vec<_> =
            self.free_of_day().iter().map(|i| self.weights(*i, day.days, day.stretch).transpose()).collect();
        DMatrix::from_rows(&rows)
    }

    /// Information and score of the days on all that is estimated.
    fn together(&self, days: &[DayScore]) -> (DMatrix<f64>, DVector<f64>) {
        let n = self.solution.estimate.free.len();
        let (mut information, mut score) = (DMatrix::zeros(n, n), DVector::zeros(n));
        for day in days {
            let design = self.design(day);
            information += design.tr_mul(&(&day.information * &design));
            score += design.tr_mul(&day.score);
        }
        (information, score)
    }

    /// χ² of the days' differences from the values that fit them best, surveys and ranges apart.
    pub fn same(&self, days: &[DayScore]) -> Same {
        if self.solution.estimate.free.is_empty() {
            return Same { chi2: 0.0, dof: 0 };
        }
        let (information, score) = self.together(days);
        let (inverse, rank) = pseudo_inverse(&information);
        let all: f64 = days.iter().map(|day| day.chi2).sum();
        let dof: usize = days.iter().map(|day| day.dof).sum();
        Same { chi2: all - score.dot(&(&inverse * &score)), dof: dof.saturating_sub(rank) }
    }

    /// Widens the covariance by χ²/dof of the days' differences where that is more than chance allows, and gives the
    /// factor of σ. One factor for all: σ of a sum of coefficients, such as one at another time, must not depend on how
    /// it is written.
    pub fn widened(mut self, same: Same, sigmas: f64) -> (Self, f64) {
        let dof = same.dof as f64;
        let factor = if same.dof > 0 && same.chi2 / dof > chi2_per_dof_at(dof, sigmas) { same.chi2 / dof } else { 1.0 };
        if let Some(covariance) = &mut self.solution.estimate.covariance {
            *covariance *= factor;
        }
        (self, factor.sqrt())
    }
}

/// Inverse of a symmetric matrix over the directions that it sees, and their number.
fn pseudo_inverse(matrix: &DMatrix<f64>) -> (DMatrix<f64>, usize) {
    let n = matrix.nrows();
    if n == 0 {
        return (DMatrix::zeros(0, 0), 0);
    }
    let scale = matrix.diagonal().map(|d| if d > 0.0 { d.sqrt().recip() } else { 0.0 });
    let scaled = DMatrix::from_fn(n, n, |i, j| scale[i] * matrix[(i, j)] * scale[j]);
    let SymmetricEigen { eigenvalues, eigenvectors } = SymmetricEigen::new(scaled);
    let least = UNSEEN * eigenvalues.max().max(0.0);
    let seen = |value: &f64| *value > least;
    let inverse = eigenvalues.map(|v| if seen(&v) { v.recip() } else { 0.0 });
    let inverse = &eigenvectors * DMatrix::from_diagonal(&inverse) * eigenvectors.transpose();
    let inverse = DMatrix::from_fn(n, n, |i, j| scale[i] * inverse[(i, j)] * scale[j]);
    (inverse, eigenvalues.iter().filter(|v| seen(v)).count())
}

/// A layout with further series, those of the days times what changes of coefficients add to them.
struct Extended {
    layout: Layout,
    /// Column of a day, and the change, behind each column.
    columns: Vec<(usize, Option<Change>)>,
}

impl Extended {
    fn new(layout: &Layout, courses: &[Course]) -> Self {
        let (channels, of_day) = (layout.channels.len(), layout.coefficients.len());
        let mut extended =
            Self { layout: layout.clone(), columns: (0..layout.columns()).map(|column| (column, None)).collect() };
        for (number, course) in courses.iter().enumerate() {
            extended.layout.coefficients.push(change_name(&layout.coefficients[course.coefficient], course.change));
            for r in &layout.regressors {
                let acts = [
                    (r.coefficient == course.coefficient).then(|| Regressor { coefficient: of_day + number, ..*r }),
                    (r.times == Some(course.coefficient)).then(|| Regressor { times: Some(of_day + number), ..*r }),
                ];
                for regressor in acts.into_iter().flatten() {
                    let column = (channels + r.series, Some(course.change));
                    let known = extended.columns.iter().position(|c| *c == column);
                    let at = known.unwrap_or_else(|| {
                        extended.columns.push(column);
                        extended.layout.series.push(change_name(&layout.series[r.series], course.change));
                        extended.columns.len() - 1
                    });
                    extended.layout.regressors.push(Regressor { series: at - channels, ..regressor });
                }
            }
        }
        extended
    }

    /// Cross-spectra of all columns.
    fn spectra(&self, sums: &Moments, stretch: usize) -> Spectra {
        let of_day = self.columns.iter().filter(|(_, change)| change.is_none()).count();
        let (bands, entries) = (sums.spectra.expected.len(), triangle(of_day));
        let mut packed = Vec::with_capacity(bands * triangle(self.columns.len()));
        // The power of time that a change brings; none where it has not happened yet.
        let power = |change: Option<Change>| match change {
            None => Some(0),
            Some(Change::Rate) => Some(1),
            Some(Change::Step(after)) => (stretch > after).then_some(0),
        };
        for band in 0..bands {
            for (i, (a, change)) in self.columns.iter().enumerate() {
                for (b, other) in &self.columns[..=i] {
                    let value = power(*change).zip(power(*other)).map_or(0.0, |(p, q)| {
                        let (low, high) = (a.min(b), a.max(b));
                        sums.power(p + q)[band * entries + triangle(*high) + low]
                    });
                    packed.push(value);
                }
            }
        }
        Spectra { packed, ..sums.spectra.clone() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::spectra::Analyser;
    use crate::verdict::chi2_per_dof_at;
    use dragfree_schema::{NoiseProcess, NoiseShape};
    use rand::SeedableRng as _;
    use rand_distr::{Distribution as _, StandardNormal};
    use rand_xoshiro::Xoshiro256PlusPlus;

    const SEGMENT: usize = 64;
    const SEGMENTS: usize = 40;
    const RATE_HZ: f64 = 10.0;

    /// Two channels of unit white noise, `a` with a coefficient of its own, both with a shared one.
    fn layout() -> Layout {
        let regressor = |coefficient, channel, series, factor| Regressor {
            coefficient,
            channel,
            series,
            factor,
            times: None,
            in_loop: false,
        };
        Layout {
            channels: vec!["a".into(), "b".into()],
            series: vec!["s".into(), "u".into()],
            regressors: vec![regressor(0, 0, 0, 1.0), regressor(1, 0, 1, -0.5), regressor(1, 1, 1, 2.0)],
            coefficients: vec!["gain.a".into(), "gain.b".into()],
        }
    }

    fn declared() -> Declared {
        let noise = |channel: &str| NoiseProcess {
            name: channel.to_owned(),
            // One-sided, of unit variance at 10 samples per second.
            spectrum: Some(NoiseShape::white((2.0 / RATE_HZ).sqrt())),
            enters: [(channel.to_owned(), vec![1.0])].into(),
            ..NoiseProcess::default()
        };
        let coefficient =
            |name: &str| Coefficient { name: name.to_owned(), effect: "gain".into(), ..Coefficient::default() };
        Declared {
            noise: vec![noise("a"), noise("b")],
            coefficients: vec![coefficient("gain.a"), coefficient("gain.b")],
            constraints: Vec::new(),
            refinements: 2,
        }
    }

    /// A day's sums with these coefficients.
    fn day(plan: &Plan, random: &mut Xoshiro256PlusPlus, theta: [f64; 2]) -> Spectra {
        let layout = layout();
        let mut analyser = Analyser::new(plan.clone(), &layout);
        let mut sums = Sums::new(plan, &layout);
        for k in 0..SEGMENTS {
            let mut white = || -> Vec<f64> { (0..SEGMENT).map(|_| StandardNormal.sample(random)).collect() };
            let (s, u, mut a, mut b) = (white(), white(), white(), white());
            for t in 0..SEGMENT {
                a[t] += theta[0] * s[t] - 0.5 * theta[1] * u[t];
                b[t] += 2.0 * theta[1] * u[t];
            }
            analyser.add(0, k as i64 * 6_400_000_000, &[&a, &b, &s, &u], false, &mut sums);
        }
        sums.total
    }

    struct Flight {
        days: Vec<(Spectra, f64, usize)>,
        stretches: Vec<Stretch>,
    }

    /// Twelve days; `truth` gives the coefficients at a time after the middle, the step is before the eighth day.
    fn flight(plan: &Plan, seed: u64, truth: impl Fn(f64, usize) -> [f64; 2]) -> Flight {
        let mut random = Xoshiro256PlusPlus::seed_from_u64(seed);
        let mut days = Vec::new();
        for k in 0..12 {
            let (time, stretch) = (f64::from(k) - 5.5, usize::from(k >= 7));
            days.push((day(plan, &mut random, truth(time, stretch)), time, stretch));
        }
        let stretch = |number: usize| {
            let own = days.iter().filter(|(.., stretch)| *stretch == number);
            let mut sums = Moments::default();
            own.clone().for_each(|(s, time, _)| sums.add(&Moments::of_day(s.clone(), *time)));
            let middle_days = own.clone().map(|(_, time, _)| time).sum::<f64>() / own.count() as f64;
            Stretch { sums, middle_days }
        };
        let stretches = vec![stretch(0), stretch(1)];
        Flight { days, stretches }
    }

    fn solve(plan: &Plan, flight: &Flight, courses: &[Course]) -> (Joint, Vec<DayScore>) {
        let (layout, declared, settings) = (layout(), declared(), Settings::default());
        let all = ManyDays {
            layout: &layout,
            plan,
            declared: &declared,
            settings: &settings,
            stretches: &flight.stretches,
            length_days: 12.0,
        };
        let joint = all.solve(courses).expect("a solution");
        let scores = flight.days.iter().map(|(s, time, stretch)| all.score(&joint, s, *time, *stretch)).collect();
        (joint, scores)
    }

    const STEP: Course = Course { coefficient: 0, change: Change::Step(0) };
    const RATE: Course = Course { coefficient: 1, change: Change::Rate };

    fn truth(time: f64, stretch: usize) -> [f64; 2] {
        [0.3 + if stretch > 0 { 0.2 } else { 0.0 }, -0.1 + 0.01 * time]
    }

    /// Values, step and rate of 60 flights: 240 pulls, squared and summed, within 4σ of χ²; and the days' differences
    /// from the fit: 60 times 24 less 4 degrees of freedom. Without the step the days are not the same in any flight.
    #[test]
    fn steps_and_rates_come_back_with_their_sigma() {
        let plan = Plan::new(SEGMENT, RATE_HZ);
        let (mut pulls, mut same, mut flights) = (0.0, Same { chi2: 0.0, dof: 0 }, 0.0);
        for seed in 0..60 {
            let flight = flight(&plan, seed, truth);
            let (joint, scores) = solve(&plan, &flight, &[STEP, RATE]);
            let estimate = &joint.solution.estimate;
            let error = DVector::from_fn(4, |k, _| estimate.theta[k] - [0.3, -0.1, 0.2, 0.01][k]);
            let covariance = estimate.covariance.clone().expect("everything is seen");
            pulls += error.dot(&(covariance.try_inverse().expect("regular") * &error));
            let own = joint.same(&scores);
            same = Same { chi2: same.chi2 + own.chi2, dof: same.dof + own.dof };
            flights += 1.0;
            let (joint, scores) = solve(&plan, &flight, &[RATE]);
            let without = joint.same(&scores);
            let bound = chi2_per_dof_at(without.dof as f64, 5.0) * without.dof as f64;
            assert!(without.chi2 > bound, "seed {seed}: {without:?}");
        }
        assert_eq!(same.dof, 60 * 20);
        let within = |chi2: f64, dof: f64| {
            let (low, high) = (chi2_per_dof_at(dof, -4.0), chi2_per_dof_at(dof, 4.0));
            assert!((low..high).contains(&(chi2 / dof)), "{chi2} on {dof}");
        };
        within(pulls, 4.0 * flights);
        within(same.chi2, same.dof as f64);
    }

    /// Where the noise of every third day is three times as loud, Σ of all days has it, σ is right, and nothing is
    /// widened: the pull of the first coefficient over 30 flights is within 4σ of χ². Where a coefficient is another
    /// one every day, by five σ of a day, the days differ, and σ is widened.
    #[test]
    fn days_that_differ_widen_sigma_and_louder_ones_do_not() {
        let plan = Plan::new(SEGMENT, RATE_HZ);
        let loud = |k: usize| if k.is_multiple_of(3) { 3.0 } else { 1.0 };
        let (mut pulls, mut wide) = (0.0, 0);
        for seed in 300..330 {
            let mut flight = flight(&plan, seed, |_, _| [0.0, 0.0]);
            for (k, (spectra, ..)) in flight.days.iter_mut().enumerate() {
                // Channels are columns 0 and 1: with nothing in them but noise they may be made louder.
                for band in spectra.packed.chunks_mut(triangle(4)) {
                    let of = |column: usize| if column < 2 { loud(k) } else { 1.0 };
                    for i in 0..4 {
                        (0..=i).for_each(|j| band[triangle(i) + j] *= of(i) * of(j));
                    }
                }
            }
            let moments = flight.days.iter().map(|(s, time, _)| Moments::of_day(s.clone(), *time));
            let mut sums = Moments::default();
            moments.for_each(|m| sums.add(&m));
            flight.stretches = vec![Stretch { sums, middle_days: 0.0 }];
            flight.days.iter_mut().for_each(|(.., stretch)| *stretch = 0);
            let (joint, scores) = solve(&plan, &flight, &[RATE]);
            let same = joint.same(&scores);
            let (joint, factor) = joint.widened(same, 3.0);
            wide += u32::from(factor > 1.0);
            let estimate = &joint.solution.estimate;
            let sigma = estimate.covariance.as_ref().expect("seen")[(0, 0)].sqrt();
            pulls += (estimate.theta[0] / sigma).powi(2) / 30.0;
        }
        assert!((chi2_per_dof_at(30.0, -4.0)..chi2_per_dof_at(30.0, 4.0)).contains(&pulls), "{pulls}");
        assert_eq!(wide, 0);

        for seed in 400..420 {
            let jumping = flight(&plan, seed, |time, _| [if (time as i64) % 2 == 0 { 0.1 } else { -0.1 }, 0.0]);
            let (joint, scores) = solve(&plan, &jumping, &[RATE]);
            let same = joint.same(&scores);
            let before = joint.solution.estimate.covariance.clone().expect("seen");
            let (joint, factor) = joint.widened(same, 4.0);
            assert!(factor > 2.0, "seed {seed}: {factor}");
            let after = joint.solution.estimate.covariance.expect("seen");
            assert!((after / (factor * factor) - &before).norm() < 1e-12 * before.norm());
        }
    }

    /// A survey of the sum of both coefficients is known once, and tells that the sum neither steps nor drifts: what it
    /// knows of the sum, its σ says, and of its step √2 times that.
    #[test]
    fn a_survey_is_counted_once_and_holds_always() {
        let plan = Plan::new(SEGMENT, RATE_HZ);
        let flight = flight(&plan, 7, |_, stretch| truth(0.0, stretch));
        let mut declared = declared();
        declared.constraints.push(Constraint {
            name: "sum".to_owned(),
            kind: Constraint::SURVEY.to_owned(),
            terms: vec![("gain.a".to_owned(), 1.0), ("gain.b".to_owned(), 1.0)],
            lower: 0.2 - 1e-4,
            upper: 0.2 + 1e-4,
            unit: "1".to_owned(),
            parts: 1,
        });
        let (layout, settings) = (layout(), Settings::default());
        let all = ManyDays {
            layout: &layout,
            plan: &plan,
            declared: &declared,
            settings: &settings,
            stretches: &flight.stretches,
            length_days: 12.0,
        };
        let both = [STEP, Course { coefficient: 1, ..STEP }, RATE, Course { coefficient: 0, ..RATE }];
        let joint = all.solve(&both).expect("a solution");
        let Estimate { theta, covariance, .. } = &joint.solution.estimate;
        let covariance = covariance.as_ref().expect("seen");
        // σ of a row's sum over that of its interval; twice where the solution stands at an end of it.
        let h = 1e-4;
        let check = |(i, j): (usize, usize), middle: f64, half: f64| {
            let distance = (theta[i] + theta[j] - middle).abs();
            assert!(distance < 1.01 * half, "{distance} {half}");
            let expected = half / 3f64.sqrt() * if distance > 0.99 * half { 2.0 } else { 1.0 };
            let sigma = (covariance[(i, i)] + covariance[(j, j)] + 2.0 * covariance[(i, j)]).sqrt();
            assert!((sigma / expected - 1.0).abs() < 0.01, "{sigma} {expected}");
        };
        check((0, 1), 0.2, h);
        check((2, 3), 0.0, h * 2f64.sqrt());
        check((4, 5), 0.0, h * 2f64.sqrt() / 12.0);
    }
}
