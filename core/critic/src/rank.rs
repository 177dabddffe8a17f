//! Which cause is missing: every candidate against what the model leaves, from the sums alone.
//!
//! With the model fitted and Σ measured from its residuals, adding coefficients p to the fitted ones q lowers χ² by `sᵀ S⁻¹ s`,
//! `s = c_p − N_pq θ_q`, `S = N_pp − N_pq N_qq⁻¹ N_qp`; all of it is linear in the Gram matrices, and exact for that Σ. Σ is that of
//! the mission with its levels measured (see `dragfree_estimation::levels`) and has taken up a plain excess that nobody explains.
//! Values beyond a coefficient's hard range are no explanation: χ² is taken at the best point inside.
//!
//! Shapes are scanned on the grid of the forms, and between neighbours by mixing the two, which for a lag or a resonance on a fine
//! grid is an interpolation.

use std::collections::BTreeMap;

use dragfree_estimation::estimate::{Estimate, EstimateError, Observed, Refinement, estimate_with};
use dragfree_estimation::levels::Levels;
use dragfree_estimation::sigma::NoiseModel;
use dragfree_estimation::spectra::{Layout, Plan, Spectra, Sums};
use nalgebra::{Cholesky, DMatrix, DVector};

use crate::gather::{Gathered, Gram};
use crate::question::{Candidate, Question};

/// How often Σ is measured from the residuals.
const REFINEMENTS: usize = 3;

/// Projection above which two causes cannot be told apart.
pub const CONFOUNDED: f64 = 0.95;

/// What is left of a candidate's information beside the model when it is called degenerate with it.
const DEGENERATE: f64 = 0.02;

/// A model fitted to the sums.
pub struct Fit {
    /// What was added to the model.
    pub added: Vec<Candidate>,
    /// Coefficients of the model, then of what was added.
    pub estimate: Estimate,
    layout: Layout,
    /// Columns of the layout among all.
    columns: Vec<usize>,
    /// What candidates are judged by: all data, and each set of stretches.
    scores: Scores,
    halves: [Scores; 2],
}

/// A model solved.
struct Solved {
    layout: Layout,
    columns: Vec<usize>,
    estimate: Estimate,
}

/// A fit with an excess of power that nothing explains, under the Σ that the mission's noise has.
pub struct WithoutExcess {
    /// The fit.
    pub plain: Fit,
    /// Bands of the excess.
    pub bands: Vec<bool>,
    /// Real observations in them.
    pub observations: f64,
}

/// A candidate beside a fit.
#[derive(Clone, Debug)]
pub struct Scored {
    /// The candidate in its best form.
    pub candidate: Candidate,
    /// Best values inside the ranges.
    pub value: DVector<f64>,
    /// Whether the free fit lies inside them.
    pub in_range: bool,
    /// By how much χ² falls.
    pub delta_chi2: f64,
    /// Information of its coefficients beside the model.
    pub information: DMatrix<f64>,
    /// Part of the information that the model leaves it.
    pub left: f64,
    /// By how much its absence moves each free coefficient of the fit.
    pub shift: DVector<f64>,
}

/// All candidates beside a fit.
#[derive(Clone, Debug)]
pub struct Ranked {
    /// Each place of each effect in its best form, the best first.
    pub all: Vec<Scored>,
    /// Forms that were tried, per effect.
    pub tried: BTreeMap<String, usize>,
    /// Places of effects of which these data say nothing: what they are made of does not change, or the model has it already.
    pub mute: Vec<String>,
}

/// A candidate fitted to each half of the data.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Halves {
    /// By how much χ² of each half falls with the values that the other gives. A half that knows little of a slow cause gives values
    /// that are no good, and that is no evidence against the cause.
    pub gains: [f64; 2],
    /// χ² of the difference of the two halves' values, one degree of freedom per coefficient: the evidence against it.
    pub difference_chi2: f64,
}

/// Everything that is asked of the sums.
pub struct Court<'a> {
    /// Model and candidates.
    pub question: &'a Question,
    /// Sums.
    pub gathered: &'a Gathered,
    /// Both sets together.
    pub total: Gram,
    /// Noise of the mission.
    pub noise: &'a NoiseModel,
    plan: Plan,
}

/// What a band needs: residual against columns, and the model's columns against columns, under `Σ⁻¹`.
struct Scores {
    /// Column, channel: `Σ_b (residual · Σ⁻¹)`.
    residual: DMatrix<f64>,
    /// The same of the model's regressors, per free coefficient.
    model: Vec<DMatrix<f64>>,
    /// `N_qq⁻¹` with what surveys and ranges know.
    covariance: DMatrix<f64>,
    /// `Σ⁻¹` times what makes information of sums, per band.
    weights: Vec<DMatrix<f64>>,
    theta: DVector<f64>,
}

impl<'a> Court<'a> {
    /// Takes the sums.
    #[must_use]
    pub fn new(question: &'a Question, gathered: &'a Gathered, noise: &'a NoiseModel) -> Self {
        Self { question, gathered, total: gathered.total(), noise, plan: gathered.plan() }
    }

    /// Bands.
    #[must_use]
    pub fn plan(&self) -> &Plan {
        &self.plan
    }

    /// Fits the model with what was added.
    ///
    /// # Errors
    /// As [`estimate_with`].
    pub fn fit(&self, added: &[Candidate]) -> Result<Fit, EstimateError> {
        let Solved { layout, columns, estimate } = self.solve(added, REFINEMENTS)?;
        let [first, second] = &self.gathered.sets;
        let of = |gram: &Gram| self.scores(gram, &estimate, &layout, &columns);
        let (scores, halves) = (of(&self.total), [of(first), of(second)]);
        Ok(Fit { added: added.to_vec(), estimate, layout, columns, scores, halves })
    }

    fn solve(&self, added: &[Candidate], refinements: usize) -> Result<Solved, EstimateError> {
        let (layout, columns) = self.question.layout(&self.gathered.columns.names, added);
        let spectra = self.total.select(&columns);
        let sums = Sums { total: spectra, block_ns: 1, blocks: Vec::new() };
        let observed = Observed { layout: &layout, plan: &self.plan, sums: &sums, prediction: None };
        let unknowns = self.question.unknowns(added);
        let bounds = self.question.bounds();
        let estimate = estimate_with(&observed, self.noise, &unknowns, &bounds, refinements, Refinement::Levels)?;
        Ok(Solved { layout, columns, estimate })
    }

    fn scores(&self, gram: &Gram, estimate: &Estimate, layout: &Layout, columns: &[usize]) -> Scores {
        let n = self.gathered.columns.names.len();
        let channels = self.question.channels.len();
        let theta = &estimate.theta;
        let linear = layout.linear_at(theta.as_slice());
        let kept = self.total.weights.evenly();
        let weights: Vec<DMatrix<f64>> = estimate.inverses.iter().zip(&kept).map(|(w, k)| w * *k).collect();
        let mut residual = DMatrix::zeros(n, channels);
        let free = &estimate.free;
        let mut model = vec![DMatrix::zeros(n, channels); free.len()];
        for (g, w) in gram.bands.iter().zip(&weights) {
            let m = g.nrows();
            let mut left = g.columns(0, channels).into_owned();
            for r in &linear.regressors {
                let column = columns[channels + r.series];
                if column < m {
                    left.column_mut(r.channel).axpy(-r.factor * theta[r.coefficient], &g.column(column), 1.0);
                }
            }
            residual.rows_mut(0, m).gemm(1.0, &left, w, 1.0);
            for r in &linear.regressors {
                let column = columns[channels + r.series];
                let Some(k) = free.iter().position(|f| *f == r.coefficient).filter(|_| column < m) else { continue };
                model[k].rows_mut(0, m).ger(r.factor, &g.column(column), &w.row(r.channel).transpose(), 1.0);
            }
        }
        let covariance =
            estimate.known.clone().cholesky().map_or_else(|| DMatrix::zeros(free.len(), free.len()), |c| c.inverse());
        Scores { residual, model, covariance, weights, theta: theta.clone() }
    }

    /// Where Σ had to take up an excess: the fit as it stands without that. What explains the excess shows here, and so does what follows
    /// it by chance.
    #[must_use]
    pub fn without_excess(&self, fit: &Fit) -> Option<WithoutExcess> {
        let measured = self.residual_psd(fit);
        let mut levels = Levels::new(self.noise, &self.plan, &self.total.weights, &measured);
        levels.fit();
        let (bands, observations) = levels.excess_bands();
        if observations <= 0.0 {
            return None;
        }
        let mut estimate = fit.estimate.clone();
        estimate.inverses = levels.plain_inverses();
        let [first, second] = &self.gathered.sets;
        let of = |gram: &Gram| self.scores(gram, &estimate, &fit.layout, &fit.columns);
        let (scores, halves) = (of(&self.total), [of(first), of(second)]);
        let (added, layout, columns) = (fit.added.clone(), fit.layout.clone(), fit.columns.clone());
        let plain = Fit { added, estimate, layout, columns, scores, halves };
        Some(WithoutExcess { plain, bands, observations })
    }

    /// `−2 log` of the likelihood of the model with what was added, up to a constant of the data, where what it does not explain of an
    /// excess in some bands is taken up; `fit` has the levels of the noise.
    ///
    /// It has a minimum where the excess is explained and one where it is taken up, and the lower one counts.
    ///
    /// # Errors
    /// As [`Self::fit`].
    pub fn deviance(&self, fit: &Fit, bands: &[bool], added: &[Candidate]) -> Result<f64, EstimateError> {
        let measured = self.residual_psd(fit);
        let mut levels = Levels::new(self.noise, &self.plan, &self.total.weights, &measured);
        levels.fit();
        let mut least = f64::INFINITY;
        for refinements in [0, REFINEMENTS] {
            let Solved { layout, columns, estimate } = self.solve(added, refinements)?;
            least = least.min(levels.deviance(&Self::residual(&self.total, &layout, &columns, &estimate.theta), bands));
        }
        Ok(least)
    }

    /// Terms of each coefficient: column, channel, factor, with products at the fit's values.
    fn terms(candidate: &Candidate, theta: &DVector<f64>) -> Vec<Vec<(usize, usize, f64)>> {
        let of = |form: &crate::question::Form| {
            let at =
                |t: &crate::question::Term| (t.column, t.channel, t.factor * t.times.map_or(1.0, |other| theta[other]));
            form.terms.iter().map(at).collect()
        };
        candidate.parts.iter().map(|(_, form)| of(form)).collect()
    }

    /// `N` between two candidates' coefficients, before anything is projected out.
    fn between(&self, gram: &Gram, scores: &Scores, a: &Candidate, b: &Candidate) -> DMatrix<f64> {
        Self::weighed(gram, &scores.weights, &scores.theta, a, b)
    }

    fn weighed(
        gram: &Gram,
        weights: &[DMatrix<f64>],
        theta: &DVector<f64>,
        a: &Candidate,
        b: &Candidate,
    ) -> DMatrix<f64> {
        let (a, b) = (Self::terms(a, theta), Self::terms(b, theta));
        DMatrix::from_fn(a.len(), b.len(), |i, j| {
            let mut sum = 0.0;
            for (g, w) in gram.bands.iter().zip(weights) {
                let m = g.nrows();
                for (s, c, f) in a[i].iter().filter(|t| t.0 < m) {
                    for (t, d, h) in b[j].iter().filter(|t| t.0 < m) {
                        sum += f * h * w[(*c, *d)] * g[(*s, *t)];
                    }
                }
            }
            sum
        })
    }

    /// Score of a candidate's coefficients, and their information with the model's.
    fn against(scores: &Scores, candidate: &Candidate) -> (DVector<f64>, DMatrix<f64>) {
        let terms = Self::terms(candidate, &scores.theta);
        let sum = |m: &DMatrix<f64>, i: usize| terms[i].iter().map(|(s, c, f)| f * m[(*s, *c)]).sum::<f64>();
        let score = DVector::from_fn(terms.len(), |i, _| sum(&scores.residual, i));
        (score, DMatrix::from_fn(terms.len(), scores.model.len(), |i, q| sum(&scores.model[q], i)))
    }

    fn score(&self, scores: &Scores, candidate: Candidate) -> Option<Scored> {
        let own = self.between(&self.total, scores, &candidate, &candidate);
        let (score, with_model) = Self::against(scores, &candidate);
        let information = &own - &with_model * &scores.covariance * with_model.transpose();
        let left = (0..own.nrows()).map(|i| information[(i, i)] / own[(i, i)]).fold(1.0, f64::min);
        // A coefficient that nothing sees, or that the model has already.
        if left.is_nan() || left <= 1e-9 {
            return None;
        }
        let bounds: Vec<(f64, f64)> = candidate
            .parts
            .iter()
            .map(|(_, f)| (f.lower.unwrap_or(f64::NEG_INFINITY), f.upper.unwrap_or(f64::INFINITY)))
            .collect();
        let free = Cholesky::new(information.clone())?.solve(&score);
        let in_range = free.iter().zip(&bounds).all(|(x, (lower, upper))| lower <= x && x <= upper);
        let value = if in_range { free } else { inside(&information, &score, &bounds) };
        let delta_chi2 = 2.0 * score.dot(&value) - value.dot(&(&information * &value));
        let shift = &scores.covariance * with_model.transpose() * &value;
        Some(Scored { candidate, value, in_range, delta_chi2, information, left, shift })
    }

    /// The part of what would be known of a candidate under some `Σ⁻¹` that comes from some of the bands.
    #[must_use]
    pub fn part_in(&self, fit: &Fit, inverses: &[DMatrix<f64>], candidate: &Candidate, bands: &[bool]) -> f64 {
        let kept = self.total.weights.evenly();
        let weights: Vec<DMatrix<f64>> = inverses.iter().zip(&kept).map(|(w, k)| w * *k).collect();
        let here: Vec<DMatrix<f64>> = weights.iter().zip(bands).map(|(w, b)| w * f64::from(u8::from(*b))).collect();
        let theta = &fit.scores.theta;
        let of = |w: &[DMatrix<f64>]| Self::weighed(&self.total, w, theta, candidate, candidate).diagonal();
        // Of several coefficients, each in its own unit.
        of(&here).component_div(&of(&weights)).mean()
    }

    /// What a candidate is worth when bands that stand for little time count for what they are (see [`Spectra::evenly`]).
    fn honest(&self, fit: &Fit, mut scored: Scored) -> Scored {
        let weights = &self.total.weights;
        let over = |(u, v): (f64, f64)| if v > 0.0 { u / v } else { 0.0 };
        let over: Vec<f64> = weights.evenly().into_iter().zip(weights.kept()).map(over).collect();
        let size = |w: &[DMatrix<f64>]| {
            let own = Self::weighed(&self.total, w, &fit.scores.theta, &scored.candidate, &scored.candidate);
            scored.value.dot(&(own * &scored.value))
        };
        let uneven: Vec<DMatrix<f64>> = fit.scores.weights.iter().zip(&over).map(|(w, r)| w * *r).collect();
        let part = (size(&fit.scores.weights) / size(&uneven)).min(1.0);
        if part.is_finite() {
            scored.delta_chi2 *= part;
            scored.information *= part;
        }
        scored
    }

    /// Every place of every effect that is not in the fit, in its best form; the best first. Also how many forms of each effect were
    /// tried, and the names of those of which these data say nothing.
    #[must_use]
    pub fn rank(&self, fit: &Fit) -> Ranked {
        let scores = &fit.scores;
        let (mut tried, mut mute) = (BTreeMap::new(), Vec::new());
        let mut ranked = Vec::new();
        for place in self.question.places() {
            let first = &self.question.coefficients[place[0]];
            if fit.added.iter().any(|a| (&a.effect, &a.instance) == (&first.effect, &first.instance)) {
                continue;
            }
            let forms = first.forms.len();
            let scored: Vec<Option<Scored>> =
                (0..forms).map(|f| self.score(scores, self.question.candidate(&place, f))).collect();
            *tried.entry(first.effect.clone()).or_default() += scored.iter().flatten().count();
            let best = scored.iter().flatten().max_by(|a, b| a.delta_chi2.total_cmp(&b.delta_chi2));
            let Some(best) = best else {
                mute.push(format!("{}:{}", first.effect, first.instance));
                continue;
            };
            ranked.push(self.honest(fit, self.between_neighbours(scores, &scored, best)));
        }
        ranked.sort_by(|a, b| b.delta_chi2.total_cmp(&a.delta_chi2));
        Ranked { all: ranked, tried, mute }
    }

    /// The best mixture of the best form with a neighbour on its grid of shapes.
    fn between_neighbours(&self, scores: &Scores, all: &[Option<Scored>], best: &Scored) -> Scored {
        let mut winner = best.clone();
        for (_, other) in neighbours(&best.candidate, all.iter().flatten().map(|s| &s.candidate)) {
            let mixed = |part: f64| self.score(scores, best.candidate.towards(other, part));
            // Golden section over the part of the way.
            let (mut a, mut b) = (0.0, 1.0);
            for _ in 0..12 {
                let (c, d) = (b - 0.618_034 * (b - a), a + 0.618_034 * (b - a));
                let [fc, fd] = [c, d].map(|x| mixed(x).map_or(f64::NEG_INFINITY, |s| s.delta_chi2));
                if fc > fd { b = d } else { a = c }
            }
            if let Some(s) = mixed(0.5 * (a + b)).filter(|s| s.delta_chi2 > winner.delta_chi2) {
                winner = s;
            }
        }
        winner
    }

    /// What the two sets of stretches say of a candidate; `None` where one of them says nothing.
    #[must_use]
    pub fn held_out(&self, fit: &Fit, candidate: &Candidate) -> Option<Halves> {
        let judge = |set: usize| {
            let scores = &fit.halves[set];
            let (score, _) = Self::against(scores, candidate);
            let information = self.between(&self.gathered.sets[set], scores, candidate, candidate);
            let covariance = Cholesky::new(information.clone())?.inverse();
            Some((&covariance * &score, score, information, covariance))
        };
        let (a, b) = (judge(0)?, judge(1)?);
        let gain = |value: &DVector<f64>, score: &DVector<f64>, information: &DMatrix<f64>| {
            2.0 * score.dot(value) - value.dot(&(information * value))
        };
        let difference = &a.0 - &b.0;
        Some(Halves {
            gains: [gain(&b.0, &a.1, &a.2), gain(&a.0, &b.1, &b.2)],
            difference_chi2: difference.dot(&Cholesky::new(&a.3 + &b.3)?.solve(&difference)),
        })
    }

    /// Causes that the data cannot tell from `scored`, and coefficients of the model that it is degenerate with.
    #[must_use]
    pub fn confounders(&self, fit: &Fit, scored: &Scored, ranked: &[Scored]) -> Vec<String> {
        let scores = &fit.scores;
        let direction = |s: &Scored| (Self::against(scores, &s.candidate).1.transpose() * &s.value, s.value.clone());
        let (model, value) = direction(scored);
        let norm = |s: &Scored, v: &DVector<f64>| v.dot(&(&s.information * v));
        let mut names = Vec::new();
        for other in ranked.iter().filter(|o| o.candidate.name() != scored.candidate.name()) {
            let (their_model, their_value) = direction(other);
            let own = self.between(&self.total, scores, &scored.candidate, &other.candidate);
            let shared = value.dot(&(&own * &their_value)) - model.dot(&(&scores.covariance * &their_model));
            let both = norm(scored, &value) * norm(other, &their_value);
            if both > 0.0 && shared.abs() > CONFOUNDED * both.sqrt() {
                names.push(other.candidate.name());
            }
        }
        if scored.left < DEGENERATE {
            let share = |q: usize| model[q].powi(2) * scores.covariance[(q, q)];
            let free = &fit.estimate.free;
            let lead = (0..free.len()).max_by(|a, b| share(*a).total_cmp(&share(*b)));
            names.extend(lead.map(|q| fit.layout.coefficients[free[q]].clone()));
        }
        names
    }

    /// Cross-spectra of the residuals of a fit, per band, over those expected of a PSD of one: a measured Σ.
    #[must_use]
    pub fn residual_psd(&self, fit: &Fit) -> Vec<DMatrix<f64>> {
        Self::residual(&self.total, &fit.layout, &fit.columns, &fit.estimate.theta)
    }

    /// The same of each set of stretches.
    #[must_use]
    pub fn residual_psd_of_sets(&self, fit: &Fit) -> [Vec<DMatrix<f64>>; 2] {
        let of = |gram: &Gram| Self::residual(gram, &fit.layout, &fit.columns, &fit.estimate.theta);
        self.gathered.sets.each_ref().map(of)
    }

    fn residual(gram: &Gram, layout: &Layout, columns: &[usize], theta: &DVector<f64>) -> Vec<DMatrix<f64>> {
        let spectra: Spectra = gram.select(columns);
        dragfree_estimation::normal::residual_spectra(&spectra, layout, theta)
            .into_iter()
            .zip(&gram.weights.expected)
            .map(|(r, e)| r / e.max(f64::MIN_POSITIVE))
            .collect()
    }
}

/// How far its one differing number is away, and the candidate.
type Neighbour<'a> = (f64, &'a Candidate);

/// Candidates of the same place that differ in one number of their shape, the next below and above.
fn neighbours<'a>(of: &Candidate, all: impl Iterator<Item = &'a Candidate>) -> Vec<Neighbour<'a>> {
    let shape = &of.parts[0].1.shape;
    let (mut below, mut above): (Option<Neighbour<'_>>, Option<Neighbour<'_>>) = (None, None);
    for other in all {
        let theirs = &other.parts[0].1.shape;
        let differing: Vec<_> = shape.iter().filter(|(k, v)| theirs.get(*k) != Some(v)).collect();
        let [(key, value)] = differing[..] else { continue };
        let (Some(mine), Some(other_value)) = (value.as_f64(), theirs.get(key).and_then(serde_json::Value::as_f64))
        else {
            continue;
        };
        let distance = other_value - mine;
        if distance > 0.0 && above.is_none_or(|(d, _)| distance < d) {
            above = Some((distance, other));
        } else if distance < 0.0 && below.is_none_or(|(d, _)| distance > d) {
            below = Some((distance, other));
        }
    }
    below.into_iter().chain(above).collect()
}

/// The minimum of `½ xᵀSx − sᵀx` in a box, coordinate by coordinate: S is positive definite and small.
fn inside(information: &DMatrix<f64>, score: &DVector<f64>, bounds: &[(f64, f64)]) -> DVector<f64> {
    let mut x: DVector<f64> = DVector::from_iterator(bounds.len(), bounds.iter().map(|(l, u)| 0.0f64.clamp(*l, *u)));
    for _ in 0..200 {
        for i in 0..x.len() {
            let rest = score[i] - information.row(i).dot(&x.transpose()) + information[(i, i)] * x[i];
            x[i] = (rest / information[(i, i)]).clamp(bounds[i].0, bounds[i].1);
        }
    }
    x
}
