//! From the sums of a pass to a set of effects: the gain in the likelihood of every set, with everything that is not
//! asked for fitted beside it.

use nalgebra::{DMatrix, DVector};
use serde::{Deserialize, Serialize};

use super::filter::Sums;
use crate::quadratic::{inverse, largest_in_box};

/// By how many times the error that rounding is expected to make a number must differ from zero to be no rounding: sums
/// of n products have one of √n ε (Higham and Mary, 2019), and each product comes from several operations.
const ROUNDING: f64 = 30.0;

/// An effect that may be in the model or not.
#[derive(Clone, Debug)]
pub struct Candidate {
    /// Its parameters.
    pub parameters: Vec<usize>,
    /// Lower ends of their ranges.
    pub lower: Vec<f64>,
    /// Upper ends.
    pub upper: Vec<f64>,
    /// Standard deviation of each before any data; infinite where nothing is known.
    pub prior_sigma: Vec<f64>,
    /// Logarithm of the weight that it has before any data.
    pub ln_prior: f64,
    /// Whether its form is a point of a grid, so that the true one differs from it.
    pub shaped: bool,
}

impl Candidate {
    /// One parameter of which nothing is known before any data.
    pub fn free(parameter: usize) -> Self {
        Self {
            parameters: vec![parameter],
            lower: vec![f64::NEG_INFINITY],
            upper: vec![f64::INFINITY],
            prior_sigma: vec![f64::INFINITY],
            ln_prior: 0.0,
            shaped: false,
        }
    }
}

/// What counts as evidence.
pub struct Evidence<'a> {
    /// Decimal logarithm of the corrected p-value of a gain of a candidate.
    pub log10_p: &'a dyn Fn(usize, f64) -> f64,
    /// The same below which a candidate is added.
    pub bound: f64,
    /// Most candidates in a set.
    pub most: usize,
    /// Part of the gain of a candidate whose form is a point of a grid that the true form may leave to others.
    pub remainder: f64,
    /// By how much the likelihood, as twice its logarithm, may be higher outside the ranges of a candidate's values
    /// than inside before the candidate is refused.
    pub range: f64,
}

/// What is known of a sum of parameters beside the data: a Gaussian about `mean`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Prior {
    /// Mean.
    pub mean: f64,
    /// Standard deviation.
    pub sigma: f64,
}

impl Prior {
    /// Square of the distance of a sum of parameters with these values from the mean, in σ.
    pub fn chi2(&self, terms: &[(usize, f64)], values: &[f64]) -> f64 {
        let sum: f64 = terms.iter().map(|(i, weight)| weight * values[*i]).sum();
        ((sum - self.mean) / self.sigma).powi(2)
    }
}

/// Values, their covariance and the gain 2 Δ ln L.
#[derive(Clone, Debug)]
pub struct Fitted {
    /// Index of the candidate.
    pub candidate: usize,
    /// Values inside their ranges.
    pub values: Vec<f64>,
    /// Values without ranges.
    pub free: Vec<f64>,
    /// Covariance of the free values, everything else fitted.
    pub covariance: DMatrix<f64>,
    /// Twice the logarithm of the ratio of likelihoods with and without it.
    pub gain: f64,
    /// How much more it would be without the ranges of its own values.
    pub beyond: f64,
    /// Others that explain as much in its place, with their probabilities, and its own.
    pub alternatives: Vec<(usize, f64)>,
    /// Its probability among them.
    pub probability: f64,
}

/// The chosen set, and what the others would add to it.
#[derive(Clone, Debug)]
pub struct Selection {
    /// Effects of the set, in the order of the candidates.
    pub chosen: Vec<Fitted>,
    /// The others, each beside the set.
    pub rest: Vec<Fitted>,
    /// Candidates without information beside the model.
    pub unobservable: Vec<usize>,
    /// Values of all parameters; zero for candidates that are not chosen.
    pub values: DVector<f64>,
    /// σ of all parameters of the model and of the set.
    pub sigma: DVector<f64>,
}

/// The likelihood near a point as a quadratic form in the values of all parameters.
pub struct Quadratic {
    information: DMatrix<f64>,
    /// Such that `score − information · values` is the derivative at `values`.
    score: DVector<f64>,
    base: Vec<usize>,
    /// Inverse of the information of the base.
    base_inverse: DMatrix<f64>,
    candidates: Vec<Candidate>,
    /// Numbers in the data.
    numbers: f64,
    /// Information and score of the candidates' parameters, the base fitted, by index of the parameter.
    profiled: DMatrix<f64>,
    profiled_score: DVector<f64>,
    /// What rounding may leave of the information of each parameter, the base fitted.
    rounding: Vec<f64>,
}

impl Quadratic {
    /// From sums about the values `start`, with what is known of weighted sums of parameters. Parameters of no
    /// candidate are the base, which is in every set.
    pub fn new(sums: &Sums, start: &[f64], priors: &[(Vec<(usize, f64)>, Prior)], candidates: Vec<Candidate>) -> Self {
        let mut information = sums.information.clone();
        let mut score = DVector::from_column_slice(&sums.score) + &information * DVector::from_column_slice(start);
        for (terms, prior) in priors {
            let known = prior.sigma.powi(-2);
            for (i, a) in terms {
                score[*i] += a * known * prior.mean;
                terms.iter().for_each(|(j, b)| information[(*i, *j)] += a * b * known);
            }
        }
        let optional = |i: &usize| candidates.iter().any(|c| c.parameters.contains(i));
        let base: Vec<usize> = (0..start.len()).filter(|i| !optional(i)).collect();
        let mut quadratic = Self {
            profiled: information.clone(),
            profiled_score: score.clone(),
            information,
            score,
            base,
            base_inverse: DMatrix::zeros(0, 0),
            candidates,
            numbers: sums.numbers.max(1.0),
            rounding: Vec::new(),
        };
        quadratic.profile();
        quadratic
    }

    /// Information and score of the candidates' parameters, in their order, everything else fitted; zero where rounding
    /// alone is left of the information.
    pub fn of_candidates(&self) -> (DMatrix<f64>, DVector<f64>) {
        let all: Vec<usize> = (0..self.candidates.len()).collect();
        let at = self.parameters(&all);
        let known = |i: usize| self.profiled[(at[i], at[i])] > self.rounding[at[i]];
        let information = DMatrix::from_fn(at.len(), at.len(), |i, j| {
            if known(i) && known(j) { self.profiled[(at[i], at[j])] } else { 0.0 }
        });
        let score = |i: usize, _| if known(i) { self.profiled_score[at[i]] } else { 0.0 };
        (information, DVector::from_fn(at.len(), score))
    }

    fn profile(&mut self) {
        self.base_inverse = self.inverse(&self.base);
        let (b, inner) = (&self.base, &self.base_inverse);
        let p = self.score.len();
        let across = DMatrix::from_fn(p, b.len(), |i, j| self.information[(i, b[j])]);
        let along = &across * inner;
        self.profiled = &self.information - &along * across.transpose();
        self.profiled_score = &self.score - &along * DVector::from_fn(b.len(), |i, _| self.score[b[i]]);
        // Each number of the information is wrong by a part of √(I_ii I_jj); what the base leaves is a sum of them.
        let size = |i: usize| self.information[(i, i)].max(0.0).sqrt();
        let part = ROUNDING * self.numbers.sqrt() * f64::EPSILON;
        let sums = (0..p).map(|i| size(i) + (0..b.len()).map(|j| along[(i, j)].abs() * size(b[j])).sum::<f64>());
        self.rounding = sums.map(|sum| part * sum * sum).collect();
    }

    /// Inverse of the information of some parameters; those without any get a variance of zero.
    fn inverse(&self, of: &[usize]) -> DMatrix<f64> {
        inverse(&DMatrix::from_fn(of.len(), of.len(), |i, j| self.information[(of[i], of[j])]))
    }

    fn parameters(&self, set: &[usize]) -> Vec<usize> {
        set.iter().flat_map(|c| self.candidates[*c].parameters.iter().copied()).collect()
    }

    /// Values inside the ranges and the gain of a set of candidates.
    fn fit(&self, set: &[usize]) -> (Vec<f64>, f64) {
        self.fit_without_ranges_of(None, set)
    }

    /// The same with one candidate of the set, if any, outside of its ranges too.
    fn fit_without_ranges_of(&self, candidate: Option<usize>, set: &[usize]) -> (Vec<f64>, f64) {
        let at = self.parameters(set);
        let ranges = |c: &usize| -> Vec<(f64, f64)> {
            let Candidate { lower, upper, .. } = &self.candidates[*c];
            let all = lower.iter().copied().zip(upper.iter().copied());
            let is_free = Some(*c) == candidate;
            all.map(|range| if is_free { (f64::NEG_INFINITY, f64::INFINITY) } else { range }).collect()
        };
        let bounds: Vec<(f64, f64)> = set.iter().flat_map(ranges).collect();
        let n = DMatrix::from_fn(at.len(), at.len(), |i, j| self.profiled[(at[i], at[j])]);
        let s = DVector::from_fn(at.len(), |i, _| self.profiled_score[at[i]]);
        let values = largest_in_box(&n, &s, &bounds);
        let gain = 2.0 * s.dot(&values) - values.dot(&(&n * &values));
        (values.iter().copied().collect(), gain)
    }

    /// Logarithm of the evidence of a set: of the probability of the data with the values averaged over what is known
    /// of them before, up to a constant, and of the weights of its candidates. Of a value of which nothing is known, a
    /// Gaussian with the information of one number of the data is (Kass and Wasserman, 1995).
    fn ln_evidence(&self, set: &[usize]) -> f64 {
        let at = self.parameters(set);
        let known = set.iter().flat_map(|c| &self.candidates[*c].prior_sigma).zip(&at).map(|(sigma, i)| {
            let of_one = (self.numbers / self.profiled[(*i, *i)].max(f64::MIN_POSITIVE)).sqrt();
            if sigma.is_finite() { *sigma } else { of_one }
        });
        let known: Vec<f64> = known.collect();
        let scaled = |i: usize, j: usize| known[i] * self.profiled[(at[i], at[j])] * known[j];
        let total = DMatrix::from_fn(at.len(), at.len(), |i, j| f64::from(u8::from(i == j)) + scaled(i, j));
        let score = DVector::from_fn(at.len(), |i, _| known[i] * self.profiled_score[at[i]]);
        let weights: f64 = set.iter().map(|c| self.candidates[*c].ln_prior).sum();
        let Some(factor) = total.cholesky() else { return f64::NEG_INFINITY };
        let ln_det: f64 = factor.l().diagonal().iter().map(|x| 2.0 * x.ln()).sum();
        0.5 * (score.dot(&factor.solve(&score)) - ln_det) + weights
    }

    /// A candidate beside a set, or in it.
    pub fn beside(&self, candidate: usize, set: &[usize]) -> Fitted {
        let others: Vec<usize> = set.iter().copied().filter(|c| *c != candidate).collect();
        let all: Vec<usize> = others.iter().copied().chain([candidate]).collect();
        let (values, with) = self.fit(&all);
        let (_, without) = self.fit(&others);
        let at = self.parameters(&all);
        let own = self.candidates[candidate].parameters.len();
        let n = DMatrix::from_fn(at.len(), at.len(), |i, j| self.profiled[(at[i], at[j])]);
        let covariance = inverse(&n);
        let free = &covariance * DVector::from_fn(at.len(), |i, _| self.profiled_score[at[i]]);
        let first = at.len() - own;
        let Candidate { lower, upper, .. } = &self.candidates[candidate];
        let is_inside = |(k, x): (usize, &f64)| lower[k] < *x && *x < upper[k];
        let beyond = if values[first..].iter().enumerate().all(is_inside) {
            0.0
        } else {
            self.fit_without_ranges_of(Some(candidate), &all).1 - with
        };
        Fitted {
            candidate,
            values: values[first..].to_vec(),
            free: free.as_slice()[first..].to_vec(),
            covariance: covariance.view((first, first), (own, own)).into_owned(),
            gain: (with - without).max(0.0),
            beyond: beyond.max(0.0),
            alternatives: Vec::new(),
            probability: 1.0,
        }
    }

    /// Whether the base and a set leave more of the information of each parameter of a candidate than rounding may.
    pub fn observable(&self, candidate: usize, set: &[usize]) -> bool {
        let others: Vec<usize> = set.iter().copied().filter(|c| *c != candidate).collect();
        let at = self.parameters(&others);
        let inner = inverse(&DMatrix::from_fn(at.len(), at.len(), |i, j| self.profiled[(at[i], at[j])]));
        self.candidates[candidate].parameters.iter().all(|p| {
            let across = DVector::from_fn(at.len(), |i, _| self.profiled[(*p, at[i])]);
            self.profiled[(*p, *p)] - across.dot(&(&inner * &across)) > self.rounding[*p]
        })
    }

    /// A set of effects in which each is significant beside the others.
    ///
    /// The most significant candidate is added; one is exchanged for another, or for two, where that raises the
    /// evidence; and what is not significant beside the others is taken out, until a set comes back.
    pub fn select(&self, evidence: &Evidence<'_>) -> Selection {
        let all: Vec<usize> = (0..self.candidates.len()).collect();
        let unobservable: Vec<usize> = all.iter().copied().filter(|c| !self.observable(*c, &[])).collect();
        let usable: Vec<usize> = all.into_iter().filter(|c| !unobservable.contains(c)).collect();
        let mut met: Vec<Vec<usize>> = vec![Vec::new()];
        let mut set: Vec<usize> = Vec::new();
        loop {
            let next = usable.iter().filter(|c| !set.contains(c) && self.observable(**c, &set));
            let significant = next.map(|c| (*c, self.log10_p(*c, &set, evidence)));
            let best = significant.min_by(|a, b| a.1.total_cmp(&b.1)).filter(|(_, p)| *p < evidence.bound);
            if let Some((c, _)) = best.filter(|_| set.len() < evidence.most) {
                set.push(c);
            }
            self.exchange(&mut set, &usable, evidence);
            while let Some(weak) = self.weakest(&set, evidence) {
                set.retain(|c| *c != weak);
            }
            set.sort_unstable();
            if let Some(before) = met.iter().position(|other| *other == set) {
                met.drain(..before);
                break;
            }
            met.push(set.clone());
        }
        // One set, or those between which the search goes round.
        let by_evidence = |a: &Vec<usize>, b: &Vec<usize>| self.ln_evidence(a).total_cmp(&self.ln_evidence(b));
        let set = met.into_iter().max_by(by_evidence).unwrap_or_default();
        let chosen = set.iter().map(|c| self.with_alternatives(*c, &set, &usable)).collect();
        let rest = usable
            .iter()
            .filter(|c| !set.contains(c) && self.observable(**c, &set))
            .map(|c| self.beside(*c, &set))
            .collect();
        let (values, sigma) = self.solution(&set);
        Selection { chosen, rest, unobservable, values, sigma }
    }

    /// The set of all candidates.
    pub fn with_all(&self) -> Selection {
        let set: Vec<usize> = (0..self.candidates.len()).collect();
        let (values, sigma) = self.solution(&set);
        let chosen = set.iter().map(|c| self.beside(*c, &set)).collect();
        Selection { chosen, rest: Vec::new(), unobservable: Vec::new(), values, sigma }
    }

    /// The least significant member of a set, if it is not significant beside the others.
    fn weakest(&self, set: &[usize], evidence: &Evidence<'_>) -> Option<usize> {
        let all = set.iter().map(|c| (*c, self.log10_p(*c, set, evidence)));
        all.max_by(|a, b| a.1.total_cmp(&b.1)).filter(|(_, p)| *p >= evidence.bound).map(|(c, _)| c)
    }

    /// Decimal logarithm of the p-value of a candidate beside a set; that of chance where it may be what the form of
    /// another leaves, and where the data want values outside its ranges.
    fn log10_p(&self, candidate: usize, set: &[usize], evidence: &Evidence<'_>) -> f64 {
        let Fitted { gain, beyond, .. } = self.beside(candidate, set);
        if beyond > evidence.range {
            return 0.0;
        }
        let shaped = set.iter().filter(|c| **c != candidate && self.candidates[**c].shaped);
        let largest = shaped.map(|c| self.beside(*c, set).gain).fold(0.0, f64::max);
        if gain < evidence.remainder * largest { 0.0 } else { (evidence.log10_p)(candidate, gain) }
    }

    /// Puts another candidate, or two, in the place of one of the set where that has a larger evidence. Two causes may
    /// together look like a third, which explains more than either of them.
    fn exchange(&self, set: &mut Vec<usize>, usable: &[usize], evidence: &Evidence<'_>) {
        for i in 0..set.len() {
            let mut others = set.clone();
            others.remove(i);
            let left: Vec<usize> = usable.iter().copied().filter(|c| !set.contains(c)).collect();
            let pairs = left.iter().enumerate().flat_map(|(k, a)| left[k + 1..].iter().map(|b| vec![*a, *b]));
            let room = others.len() + 2 <= evidence.most;
            let mut best = (vec![set[i]], self.ln_evidence(set));
            for own in left.iter().map(|c| vec![*c]).chain(pairs.filter(|_| room)) {
                let all = [&others[..], &own].concat();
                let value = self.ln_evidence(&all);
                let stands = || own.iter().all(|c| self.log10_p(*c, &all, evidence) < evidence.bound);
                if value > best.1 + 1e-6 && stands() {
                    best = (own, value);
                }
            }
            let mut own = best.0.into_iter();
            set[i] = own.next().unwrap_or(set[i]);
            set.extend(own);
        }
    }

    /// By how much χ² is expected to be higher with another candidate in the place of one of a set, if that one acts
    /// with its fitted values: what the other and the rest of the set leave of it. Grows with the length of the data.
    pub fn separation(&self, candidate: usize, from: usize, set: &[usize]) -> f64 {
        self.separation_of(candidate, &self.beside(candidate, set).values, from, set)
    }

    /// The same where the candidate acts with these values.
    pub fn separation_of(&self, candidate: usize, values: &[f64], from: usize, set: &[usize]) -> f64 {
        let others: Vec<usize> = set.iter().copied().filter(|c| *c != candidate).chain([from]).collect();
        let (own, at) = (self.parameters(&[candidate]), self.parameters(&others));
        let n = |rows: &[usize], columns: &[usize]| {
            DMatrix::from_fn(rows.len(), columns.len(), |i, j| self.profiled[(rows[i], columns[j])])
        };
        let across = n(&own, &at);
        let left = n(&own, &own) - &across * inverse(&n(&at, &at)) * across.transpose();
        let values = DVector::from_column_slice(values);
        values.dot(&(left * &values)).max(0.0)
    }

    /// Weights of all parameters whose quadratic form with the information of a stretch of data is the part of that
    /// stretch in [`Self::separation`], but for what is known beside the data.
    pub fn contrast(&self, candidate: usize, from: usize, set: &[usize]) -> DVector<f64> {
        let others: Vec<usize> = set.iter().copied().filter(|c| *c != candidate).chain([from]).collect();
        let own = self.parameters(&[candidate]);
        let at: Vec<usize> = self.base.iter().copied().chain(self.parameters(&others)).collect();
        let values = self.beside(candidate, set).values;
        let mut weights = DVector::zeros(self.score.len());
        own.iter().zip(&values).for_each(|(i, value)| weights[*i] = *value);
        let along = &self.information * &weights;
        let taken = self.inverse(&at) * DVector::from_fn(at.len(), |i, _| along[at[i]]);
        at.iter().zip(taken.iter()).for_each(|(i, x)| weights[*i] = -x);
        weights
    }

    /// σ of the parameters of a candidate, beside a set or in it, everything else fitted.
    pub fn sigma(&self, candidate: usize, set: &[usize]) -> Vec<f64> {
        self.beside(candidate, set).covariance.diagonal().iter().map(|variance| variance.max(0.0).sqrt()).collect()
    }

    /// The likelihood that is expected of data with `more` information than these, if all parameters have these
    /// `values`.
    pub fn expected(&self, more: &DMatrix<f64>, values: &DVector<f64>) -> Self {
        let information = &self.information + more;
        let mut quadratic = Self {
            score: &information * values,
            profiled: information.clone(),
            profiled_score: DVector::zeros(values.len()),
            information,
            base: self.base.clone(),
            base_inverse: DMatrix::zeros(0, 0),
            candidates: self.candidates.clone(),
            numbers: self.numbers,
            rounding: Vec::new(),
        };
        quadratic.profile();
        quadratic
    }

    /// The likelihood that is expected of data like these of another length, as a multiple of theirs.
    pub fn of_length(&self, times: f64, values: &DVector<f64>) -> Self {
        self.expected(&(&self.information * (times - 1.0)), values)
    }

    /// The same likelihood with parameters of the base as one more candidate, the last: without it they are zero.
    pub fn with_candidate(&self, candidate: Candidate) -> Self {
        let base = self.base.iter().copied().filter(|i| !candidate.parameters.contains(i)).collect();
        let mut quadratic = Self {
            information: self.information.clone(),
            score: self.score.clone(),
            base,
            base_inverse: DMatrix::zeros(0, 0),
            candidates: self.candidates.iter().cloned().chain([candidate]).collect(),
            numbers: self.numbers,
            profiled: DMatrix::zeros(0, 0),
            profiled_score: DVector::zeros(0),
            rounding: Vec::new(),
        };
        quadratic.profile();
        quadratic
    }

    /// A candidate of a set, with those of the `usable` ones that explain as much in its place. Beside one that has
    /// less evidence than nothing, as an event after a search of every time may have, they need more evidence than
    /// nothing: whatever explains nothing would be as likely.
    pub fn with_alternatives(&self, candidate: usize, set: &[usize], usable: &[usize]) -> Fitted {
        let mut fitted = self.beside(candidate, set);
        let others: Vec<usize> = set.iter().copied().filter(|c| *c != candidate).collect();
        let evidence = |c: usize| self.ln_evidence(&others.iter().copied().chain([c]).collect::<Vec<_>>());
        let (own, nothing) = (evidence(candidate), self.ln_evidence(&others));
        let weights: Vec<(usize, f64)> = usable
            .iter()
            .filter(|c| !set.contains(c))
            .map(|c| (*c, (evidence(*c) - own).min(0.0).exp()))
            .filter(|(c, weight)| *weight > 1e-3 && (own > nothing || evidence(*c) > nothing))
            .collect();
        let sum = 1.0 + weights.iter().map(|(_, w)| w).sum::<f64>();
        fitted.probability = sum.recip();
        fitted.alternatives = weights.into_iter().map(|(c, w)| (c, w / sum)).collect();
        fitted.alternatives.sort_by(|a, b| b.1.total_cmp(&a.1));
        fitted
    }

    /// What one of a set stands in for, if anything: among the candidates that the data want outside of their ranges
    /// by more than `range`, the one with the most evidence in its place. That is more than the set has by `more`, as a
    /// logarithm, and leaves the one of the set the smaller part of its gain.
    pub fn stands_in_for(&self, candidate: usize, set: &[usize], range: f64, more: f64) -> Option<Fitted> {
        let others: Vec<usize> = set.iter().copied().filter(|c| *c != candidate).collect();
        let with = |c: usize| [&others[..], &[c]].concat();
        let least = self.ln_evidence(set) + more;
        let takes_most = |outside: usize| self.explain_most_of(candidate, &others, &[outside], Some(outside));
        let left = (0..self.candidates.len()).filter(|c| !set.contains(c) && self.observable(*c, &others));
        let explains = left.map(|c| (c, self.ln_evidence(&with(c)))).filter(|(_, evidence)| *evidence > least);
        let outside = explains.map(|(c, evidence)| (self.beside(c, &others), evidence));
        let all = outside.filter(|(f, _)| f.beyond > range && takes_most(f.candidate));
        all.max_by(|a, b| a.1.total_cmp(&b.1)).map(|(fitted, _)| fitted)
    }

    /// Whether `by` explain the greater part of what a candidate explains beside `others`: less than half of its gain
    /// is left to it with them. The ranges of `outside`, which may be one of them, are left aside.
    pub fn explain_most_of(&self, candidate: usize, others: &[usize], by: &[usize], outside: Option<usize>) -> bool {
        let gain = |set: &[usize]| self.fit_without_ranges_of(outside, set).1;
        let own = |beside: &[usize]| gain(&[beside, &[candidate]].concat()) - gain(beside);
        own(&[others, by].concat()) < 0.5 * own(others)
    }

    /// The candidates.
    pub fn candidates(&self) -> &[Candidate] {
        &self.candidates
    }

    /// Values and σ of all parameters if `others` may act beside a set, each with what is known of it before any data:
    /// that and the data limit what they can be. Ranges of the set are left aside. Zero for parameters of neither.
    pub fn solution_with(&self, set: &[usize], others: &[usize]) -> (DVector<f64>, DVector<f64>) {
        let mut information = self.information.clone();
        for c in others {
            let Candidate { parameters, lower, upper, prior_sigma, .. } = &self.candidates[*c];
            for (k, i) in parameters.iter().enumerate() {
                // Where only a range is known, σ of an even distribution over it.
                let even = (upper[k] - lower[k]) / 12.0_f64.sqrt();
                let known = if prior_sigma[k].is_finite() { prior_sigma[k] } else { even };
                information[(*i, *i)] += known.powi(-2);
            }
        }
        let optional = self.parameters(set).into_iter().chain(self.parameters(others));
        let at: Vec<usize> = self.base.iter().copied().chain(optional).collect();
        let covariance = inverse(&DMatrix::from_fn(at.len(), at.len(), |i, j| information[(at[i], at[j])]));
        let solved = &covariance * DVector::from_fn(at.len(), |i, _| self.score[at[i]]);
        let (mut values, mut sigma) = (DVector::zeros(self.score.len()), DVector::zeros(self.score.len()));
        for (k, i) in at.iter().enumerate() {
            (values[*i], sigma[*i]) = (solved[k], covariance[(k, k)].max(0.0).sqrt());
        }
        (values, sigma)
    }

    /// Values of the base and of a set; zero for candidates that are not in it.
    pub fn values(&self, set: &[usize]) -> DVector<f64> {
        let mut values = DVector::zeros(self.score.len());
        let (inside, _) = self.fit(set);
        self.parameters(set).iter().zip(inside).for_each(|(i, x)| values[*i] = x);
        let rest = &self.score - &self.information * &values;
        let solved = &self.base_inverse * DVector::from_fn(self.base.len(), |i, _| rest[self.base[i]]);
        self.base.iter().zip(solved.iter()).for_each(|(i, x)| values[*i] = *x);
        values
    }

    /// By how much χ² falls with a set in the model.
    pub fn gain(&self, set: &[usize]) -> f64 {
        self.fit(set).1
    }

    /// Values and σ of the base and of a set.
    pub fn solution(&self, set: &[usize]) -> (DVector<f64>, DVector<f64>) {
        let mut sigma = DVector::zeros(self.score.len());
        let all: Vec<usize> = self.base.iter().copied().chain(self.parameters(set)).collect();
        let covariance = self.inverse(&all);
        all.iter().enumerate().for_each(|(k, i)| sigma[*i] = covariance[(k, k)].max(0.0).sqrt());
        (self.values(set), sigma)
    }

    /// Covariance of all parameters with a set; zero for candidates that are not in it.
    pub fn covariance(&self, set: &[usize]) -> DMatrix<f64> {
        let all: Vec<usize> = self.base.iter().copied().chain(self.parameters(set)).collect();
        let own = self.inverse(&all);
        let mut covariance = DMatrix::zeros(self.score.len(), self.score.len());
        for (k, i) in all.iter().enumerate() {
            all.iter().enumerate().for_each(|(l, j)| covariance[(*i, *j)] = own[(k, l)]);
        }
        covariance
    }
}

/// By how much the likelihoods of several data about the same point, as twice their logarithms, are higher where each
/// has coefficients of its own than where all have the same, and by how many values: χ² and its degrees of freedom
/// where the data agree. Information and score of each; `numbers` are those in the data.
pub fn disagreement(data: &[(DMatrix<f64>, DVector<f64>)], numbers: f64) -> (f64, usize) {
    let least = ROUNDING * numbers.max(1.0).sqrt() * f64::EPSILON;
    let highest = |information: &DMatrix<f64>, score: &DVector<f64>| {
        let unit = information.diagonal().map(|d| if d > 0.0 { d.sqrt().recip() } else { 0.0 });
        let scaled = DMatrix::from_fn(unit.len(), unit.len(), |i, j| information[(i, j)] * unit[i] * unit[j]);
        let eigen = scaled.symmetric_eigen();
        let along = eigen.eigenvectors.transpose() * score.component_mul(&unit);
        let known = eigen.eigenvalues.iter().zip(along.iter()).filter(|(value, _)| **value > least);
        known.fold((0.0, 0), |(sum, n), (value, x)| (sum + x * x / value, n + 1))
    };
    let Some((information, score)) = data.first() else { return (0.0, 0) };
    let mut all = (information * 0.0, score * 0.0);
    let (mut apart, mut values) = (0.0, 0_usize);
    for (information, score) in data {
        all = (all.0 + information, all.1 + score);
        let (gain, n) = highest(information, score);
        (apart, values) = (apart + gain, values + n);
    }
    let (together, n) = highest(&all.0, &all.1);
    // Where a direction is near rounding in each, all together may know it and none alone.
    ((apart - together).max(0.0), values.saturating_sub(n))
}
