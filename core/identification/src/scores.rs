//! Score tests (Lagrange multiplier tests) of every candidate against the residuals of the model, from the sums alone.
//!
//! With the model fitted, adding coefficients p to the fitted ones q lowers χ² by `sᵀ S⁻¹ s`, `s = c_p − N_pq θ_q`,
//! `S = N_pp − N_pq N_qq⁻¹ N_qp`. All of it is linear in the Gram matrices, and exact for the Σ in use: that of the
//! mission with its levels measured (`dragfree_estimation::levels`), which also absorbs an unexplained excess of power.
//! Values beyond a coefficient's hard range are no explanation: χ² is taken at the best point inside.
//!
//! Shape parameters are scanned on the grid of the forms. Between neighbours the series of the two are mixed, which on
//! a fine grid of lags or resonances is an interpolation.

use std::collections::BTreeMap;

use dragfree_estimation::estimate::{Estimate, EstimateError, Method, Observed, Refinement, colours, estimate_with};
use dragfree_estimation::levels::Levels;
use dragfree_estimation::sigma::{BandNoise, NoiseModel};
use dragfree_estimation::spectra::{Layout, Plan, Spectra, Sums};
use dragfree_schema::Settings;
use nalgebra::{Cholesky, DMatrix, DVector};

use crate::candidates::{Candidate, CandidateSet, Coefficient};
use crate::gram::{Gram, GramSums};
use crate::quadratic::largest_in_box;

/// Refinements of Σ from the residuals.
const REFINEMENTS: usize = 3;

/// Why there is no comparison or diagnosis.
#[derive(Debug, thiserror::Error)]
#[expect(missing_docs, reason = "the message names the fields")]
pub enum IdentificationError {
    /// Nothing can be fitted.
    #[error(transparent)]
    Estimate(#[from] EstimateError),
    /// Too little data.
    #[error(
        "a {what} needs at least {needed} × {segment_s:.0} s without a gap, and there are {segments:.2} × {segment_s:.0} s: \
         give more telemetry, or several products"
    )]
    TooShort { what: &'static str, needed: f64, segments: f64, segment_s: f64 },
}

/// A model fitted to the sums.
pub struct Fit {
    /// What was added to the model.
    pub added: Vec<Candidate>,
    /// Coefficients of the model, then of what was added.
    pub estimate: Estimate,
    layout: Layout,
    /// Columns of the layout among all.
    columns: Vec<usize>,
    scores: Scores,
}

/// The solution of a model.
struct Solved {
    layout: Layout,
    columns: Vec<usize>,
    estimate: Estimate,
}

/// A fit with an unexplained excess of power, under the mission's Σ, which has not absorbed the excess.
pub struct WithoutExcess {
    /// The fit.
    pub plain: Fit,
    /// Bands of the excess.
    pub bands: Vec<bool>,
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
    /// Fall of χ².
    pub delta_chi2: f64,
    /// Information of its coefficients beside the model.
    pub information: DMatrix<f64>,
    /// Corrected over plain information, see [`CandidateScorer::window_corrected`].
    understated: f64,
}

/// All candidates beside a fit.
#[derive(Clone, Debug)]
pub struct Ranked {
    /// Each instance of each effect in its best form, the best first.
    pub all: Vec<Scored>,
    /// Forms that were tried, per effect, without transients.
    pub tried: BTreeMap<String, usize>,
    /// Instances without information in these data: their series do not vary, or the model contains the same already.
    pub unobservable: Vec<String>,
}

/// A candidate beside the model.
struct Beside {
    score: DVector<f64>,
    information: DMatrix<f64>,
}

/// Scores candidates from the sums.
pub struct CandidateScorer<'a> {
    /// Model and candidates.
    pub candidate_set: &'a CandidateSet,
    /// Sums.
    pub gathered: &'a GramSums,
    /// All of them.
    pub total: &'a Gram,
    /// Noise as it is declared.
    pub noise: &'a NoiseModel,
    /// Thresholds.
    pub settings: &'a Settings,
    noise_in_bands: BandNoise<'a>,
    plan: Plan,
}

/// Inner products under `Σ⁻¹`, summed over bands: residuals with columns, and the model's regressors with columns.
struct Scores {
    /// Column, channel: `Σ_b (residual · Σ⁻¹)`.
    residual: DMatrix<f64>,
    /// The same of the model's regressors, per free coefficient.
    model: Vec<DMatrix<f64>>,
    /// `N_qq` of the free coefficients, from these data alone.
    normal: DMatrix<f64>,
    /// `N_qq⁻¹` with what surveys and ranges know.
    covariance: DMatrix<f64>,
    /// Score of the free coefficients, of those at the end of a range.
    bound_score: DVector<f64>,
    /// Per band, `Σ⁻¹` times the weight that turns sums into information.
    weights: Vec<DMatrix<f64>>,
    theta: DVector<f64>,
}

impl<'a> CandidateScorer<'a> {
    /// Takes the sums.
    pub fn new(
        candidate_set: &'a CandidateSet,
        gathered: &'a GramSums,
        noise: &'a NoiseModel,
        settings: &'a Settings,
    ) -> Self {
        let plan = gathered.plan();
        let noise_in_bands = BandNoise::new(noise, &plan);
        Self { candidate_set, gathered, total: &gathered.total, noise, settings, noise_in_bands, plan }
    }

    /// Bands.
    pub fn plan(&self) -> &Plan {
        &self.plan
    }

    /// Refuses `segments` short segments where they are fewer than `what` needs.
    ///
    /// # Errors
    /// [`IdentificationError::TooShort`].
    pub(crate) fn require(&self, what: &'static str, needed: f64, segments: f64) -> Result<(), IdentificationError> {
        let segment_s = self.gathered.length as f64 / self.gathered.rate_hz;
        if segments >= needed {
            return Ok(());
        }
        Err(IdentificationError::TooShort { what, needed, segments, segment_s })
    }

    /// Fits the model with what was added.
    ///
    /// # Errors
    /// As [`estimate_with`].
    pub fn fit(&self, added: &[Candidate]) -> Result<Fit, EstimateError> {
        Ok(self.scored(added.to_vec(), self.solve(added, REFINEMENTS)?))
    }

    fn solve(&self, added: &[Candidate], refinements: usize) -> Result<Solved, EstimateError> {
        let (layout, columns) = self.candidate_set.layout(&self.gathered.columns.names, added);
        let spectra = self.total.select(&columns);
        let sums = Sums { total: spectra, block_ns: 1, blocks: Vec::new() };
        let observed = Observed { layout: &layout, plan: &self.plan, sums: &sums, prediction: None };
        let unknowns = self.candidate_set.unknowns(added);
        let bounds = self.candidate_set.bounds();
        let method = Method { refinements, refinement: Refinement::Levels, settings: self.settings };
        let estimate = estimate_with(&observed, &self.noise_in_bands, &unknowns, &bounds, &method)?;
        Ok(Solved { layout, columns, estimate })
    }

    fn scored(&self, added: Vec<Candidate>, solved: Solved) -> Fit {
        let mut scores = self.scores(&solved);
        let Solved { layout, columns, estimate } = solved;
        scores.covariance = estimate.known.clone().try_inverse().unwrap_or(scores.covariance);
        scores.bound_score = estimate.bound_score.clone();
        Fit { added, estimate, layout, columns, scores }
    }

    /// Inner products of the data with the residuals of the solution, every band weighted by its own time.
    /// Neither surveys nor ranges enter `covariance` and `bound_score` here.
    fn scores(&self, solved: &Solved) -> Scores {
        let gram = self.total;
        let Solved { layout, columns, estimate } = solved;
        let n = self.gathered.columns.names.len();
        let channels = self.candidate_set.channels.len();
        let theta = &estimate.theta;
        let linear = layout.linear_at(theta.as_slice());
        let weights: Vec<DMatrix<f64>> =
            estimate.inverses.iter().zip(gram.weights.equal_time_weights()).map(|(w, k)| w * k).collect();
        let mut residual = DMatrix::zeros(n, channels);
        let free = &estimate.free;
        let mut model = vec![DMatrix::zeros(n, channels); free.len()];
        for (g, w) in gram.bands.iter().zip(&weights) {
            let m = g.order();
            let mut left = DMatrix::from_fn(m, channels, |i, j| g.at(i, j));
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
        let (mut normal, mut score) = (DMatrix::zeros(free.len(), free.len()), DVector::zeros(free.len()));
        for r in &linear.regressors {
            let at = (columns[channels + r.series], r.channel);
            let Some(k) = free.iter().position(|f| *f == r.coefficient) else { continue };
            score[k] += r.factor * residual[at];
            model.iter().enumerate().for_each(|(l, with)| normal[(k, l)] += r.factor * with[at]);
        }
        let covariance = DMatrix::zeros(free.len(), free.len());
        let theta = theta.clone();
        Scores { residual, model, normal, covariance, bound_score: score, weights, theta }
    }

    /// Levels of the mission's noise beside the residual spectra `measured`.
    pub fn levels<'b>(&'b self, fit: &Fit, measured: &'b [DMatrix<f64>]) -> Levels<'b> {
        let unknowns = self.candidate_set.unknowns(&fit.added);
        let colours = colours(&unknowns, &fit.estimate.theta);
        Levels::new(self.noise, &self.plan, &self.total.weights, measured, self.settings).coloured(&self.plan, &colours)
    }

    /// The fit under a Σ that has not absorbed the excess of power; none where there is no excess. Under it the cause
    /// of the excess scores high, and so does whatever correlates with the excess by chance.
    pub fn without_excess(&self, fit: &Fit) -> Option<WithoutExcess> {
        let measured = self.residual_psd(fit);
        let mut levels = self.levels(fit, &measured);
        levels.fit();
        let (bands, observations) = levels.excess_bands();
        if observations <= 0.0 {
            return None;
        }
        let plain = self.under(fit, levels.plain_inverses());
        Some(WithoutExcess { plain, bands })
    }

    /// The same solution with other Σ⁻¹ in the scores.
    fn under(&self, fit: &Fit, inverses: Vec<DMatrix<f64>>) -> Fit {
        let estimate = Estimate { inverses, ..fit.estimate.clone() };
        let mut solved = Solved { layout: fit.layout.clone(), columns: fit.columns.clone(), estimate };
        solved.estimate.known += self.scores(&solved).normal - &fit.scores.normal;
        self.scored(fit.added.clone(), solved)
    }

    /// `−2 log` of the likelihood of the model with `added`, up to a constant of the data. In `bands` the noise absorbs
    /// the excess that the model leaves; elsewhere it has the levels of `fit`.
    ///
    /// It has one minimum where the excess is explained and one where it is absorbed. The lower one is returned.
    ///
    /// # Errors
    /// As [`Self::fit`].
    pub fn deviance(&self, fit: &Fit, bands: &[bool], added: &[Candidate]) -> Result<f64, EstimateError> {
        let measured = self.residual_psd(fit);
        let mut levels = self.levels(fit, &measured);
        levels.fit();
        let mut least = f64::INFINITY;
        for refinements in [0, REFINEMENTS] {
            let Solved { layout, columns, estimate } = self.solve(added, refinements)?;
            least = least.min(levels.deviance(&self.residual(&layout, &columns, &estimate.theta), bands));
        }
        Ok(least)
    }

    /// `−2 log` of the likelihood of the model with `added`, up to a constant of the data, with levels of the noise
    /// fitted beside it and with the noise that `added` filter. In `bands` the noise absorbs the excess that is left.
    ///
    /// # Errors
    /// As [`Self::fit`].
    pub fn profile_deviance(&self, added: &[Candidate], bands: &[bool]) -> Result<f64, EstimateError> {
        let Solved { layout, columns, estimate } = self.solve(added, REFINEMENTS)?;
        let measured = self.residual(&layout, &columns, &estimate.theta);
        let unknowns = self.candidate_set.unknowns(added);
        let colours = colours(&unknowns, &estimate.theta);
        let levels = Levels::new(self.noise, &self.plan, &self.total.weights, &measured, self.settings);
        let mut levels = levels.coloured(&self.plan, &colours);
        levels.fit();
        Ok(levels.deviance(&measured, bands))
    }

    /// The form of highest likelihood of a candidate that filters a noise process, which scores do not account for: a
    /// hill climb on the grid of shapes from the local maxima of the score. `None` for a candidate that filters
    /// nothing.
    ///
    /// # Errors
    /// As [`Self::fit`].
    pub fn coloured(&self, fit: &Fit, candidate: &Candidate) -> Result<Option<Candidate>, EstimateError> {
        if candidate.parts.iter().all(|(_, form)| form.colours.is_none()) {
            return Ok(None);
        }
        let same = |p: &Vec<usize>| p.iter().eq(candidate.parts.iter().map(|(i, _)| i));
        let Some(place) = self.candidate_set.places().into_iter().find(same) else { return Ok(None) };
        let count = self.candidate_set.coefficients[place[0]].forms.len();
        let forms: Vec<Candidate> = (0..count).map(|form| self.candidate_set.candidate(&place, form)).collect();
        let worth = |form: &Candidate| self.score(&fit.scores, form.clone()).map_or(0.0, |s| s.delta_chi2);
        let scores: Vec<f64> = forms.iter().map(worth).collect();
        let index = |of: &Candidate| forms.iter().position(|form| form == of);
        let score = |of: &Candidate| index(of).map_or(0.0, |i| scores[i]);
        let highest = |i: &usize| neighbours(&forms[*i], forms.iter()).iter().all(|(_, n)| score(n) <= scores[*i]);
        let mut summits: Vec<usize> = (0..forms.len()).filter(highest).collect();
        summits.sort_by(|a, b| scores[*b].total_cmp(&scores[*a]));
        summits.truncate(self.settings.likelihood_starts);
        let mut known: BTreeMap<usize, f64> = BTreeMap::new();
        let bands = vec![false; self.plan.bands.len()];
        let mut likelihood = |i: usize| -> Result<f64, EstimateError> {
            if let Some(value) = known.get(&i) {
                return Ok(*value);
            }
            let value = self.profile_deviance(&[&fit.added[..], std::slice::from_ref(&forms[i])].concat(), &bands)?;
            known.insert(i, value);
            Ok(value)
        };
        let mut best: Option<(usize, f64)> = None;
        for summit in summits {
            let mut at = (summit, likelihood(summit)?);
            loop {
                let from = at.0;
                for next in neighbours(&forms[from], forms.iter()).into_iter().filter_map(|(_, n)| index(n)) {
                    let value = likelihood(next)?;
                    if value < at.1 {
                        at = (next, value);
                    }
                }
                if at.0 == from {
                    break;
                }
            }
            if best.is_none_or(|(_, least)| at.1 < least) {
                best = Some(at);
            }
        }
        Ok(best.map(|(i, _)| forms[i].clone()))
    }

    /// Terms of each coefficient: column, channel, factor, with products at the fit's values.
    fn terms(candidate: &Candidate, theta: &DVector<f64>) -> Vec<Vec<(usize, usize, f64)>> {
        let of = |form: &crate::candidates::Form| {
            let at = |t: &crate::candidates::Term| {
                (t.column, t.channel, t.factor * t.times.map_or(1.0, |other| theta[other]))
            };
            form.terms.iter().map(at).collect()
        };
        candidate.parts.iter().map(|(_, form)| of(form)).collect()
    }

    fn weighed(&self, weights: &[DMatrix<f64>], theta: &DVector<f64>, a: &Candidate, b: &Candidate) -> DMatrix<f64> {
        let (a, b) = (Self::terms(a, theta), Self::terms(b, theta));
        DMatrix::from_fn(a.len(), b.len(), |i, j| {
            let mut sum = 0.0;
            for (g, w) in self.total.bands.iter().zip(weights) {
                let m = g.order();
                for (s, c, f) in a[i].iter().filter(|t| t.0 < m) {
                    for (t, d, h) in b[j].iter().filter(|t| t.0 < m) {
                        sum += f * h * w[(*c, *d)] * g.at(*s, *t);
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

    /// Score and information of a candidate beside the model; none where it is unobservable or contained in the model.
    fn beside(&self, scores: &Scores, candidate: &Candidate) -> Option<Beside> {
        let own = self.weighed(&scores.weights, &scores.theta, candidate, candidate);
        let (score, with_model) = Self::against(scores, candidate);
        // The missing candidate may have pushed a coefficient to the end of its range, where the score of the data is
        // not zero. Beside the candidate that coefficient moves back, so its score enters the candidate's.
        let score = score - &with_model * (&scores.covariance * &scores.bound_score);
        let information = &own - &with_model * &scores.covariance * with_model.transpose();
        let left = |i: usize| own[(i, i)] > 0.0 && information[(i, i)] > 1e-9 * own[(i, i)];
        (0..own.nrows()).all(left).then_some(Beside { score, information })
    }

    fn score(&self, scores: &Scores, candidate: Candidate) -> Option<Scored> {
        let Beside { score, information } = self.beside(scores, &candidate)?;
        let bounds: Vec<(f64, f64)> = candidate
            .parts
            .iter()
            .map(|(_, f)| (f.lower.unwrap_or(f64::NEG_INFINITY), f.upper.unwrap_or(f64::INFINITY)))
            .collect();
        let free = Cholesky::new(information.clone())?.solve(&score);
        let in_range = free.iter().zip(&bounds).all(|(x, (lower, upper))| lower <= x && x <= upper);
        let value = if in_range { free } else { largest_in_box(&information, &score, &bounds) };
        let delta_chi2 = 2.0 * score.dot(&value) - value.dot(&(&information * &value));
        Some(Scored { candidate, value, in_range, delta_chi2, information, understated: 1.0 })
    }

    /// The part of a candidate's information under the declared noise that comes from `bands`.
    pub fn part_in(&self, fit: &Fit, candidate: &Candidate, bands: &[bool]) -> f64 {
        let theta = &fit.scores.theta;
        let of = |bands: &dyn Fn(usize) -> bool| {
            let weights: Vec<DMatrix<f64>> =
                fit.scores.weights.iter().enumerate().map(|(b, w)| w * f64::from(u8::from(bands(b)))).collect();
            self.weighed(&weights, theta, candidate, candidate).diagonal()
        };
        // Of several coefficients, each in its own unit.
        of(&|b| bands[b]).component_div(&of(&|_| true)).mean()
    }

    /// Corrects the information of a candidate for the weights of the sums. What lasts is weighted by the time that
    /// each band covers ([`Spectra::equal_time_weights`] count all alike). A short waveform has the information of
    /// least squares without a taper: signal and noise are tapered alike, so its position in a segment must not matter.
    fn window_corrected(&self, fit: &Fit, mut scored: Scored) -> Scored {
        let (weights, candidate) = (&self.total.weights, &scored.candidate);
        let equal_time = weights.equal_time_weights();
        let ratio = |(u, v): (f64, f64)| if v > 0.0 { u / v } else { 0.0 };
        let energy = candidate.parts.iter().flat_map(|(_, form)| &form.terms).find_map(|t| {
            let energy = self.gathered.columns.energy_of(t.column)?;
            let windowed = self.total.bands.iter().zip(&equal_time).map(|(g, k)| g.at(t.column, t.column) * k);
            Some(energy.iter().copied().zip(windowed).map(ratio).map(|r| r.min(self.settings.max_taper_loss)).collect())
        });
        let lasts = || equal_time.iter().copied().zip(weights.kept()).map(|(e, k)| ratio((k, e)).min(1.0)).collect();
        let factors: Vec<f64> = energy.unwrap_or_else(lasts);
        let size = |w: &[DMatrix<f64>]| {
            let own = self.weighed(w, &fit.scores.theta, candidate, candidate);
            scored.value.dot(&(own * &scored.value))
        };
        let better: Vec<DMatrix<f64>> = fit.scores.weights.iter().zip(&factors).map(|(w, r)| w * *r).collect();
        let part = size(&better) / size(&fit.scores.weights);
        if part.is_finite() {
            scored.delta_chi2 *= part;
            scored.information *= part;
            scored.understated = part;
        }
        scored
    }

    /// Every instance of every effect that is not in the fit, in its best form, the best first; with the number of
    /// forms tried per effect, and the unobservable instances.
    pub fn rank(&self, fit: &Fit) -> Ranked {
        self.rank_where(fit, |_| true)
    }

    /// The same of some coefficients.
    pub fn rank_where(&self, fit: &Fit, asked: impl Fn(&Coefficient) -> bool) -> Ranked {
        let scores = &fit.scores;
        let (mut tried, mut unobservable) = (BTreeMap::new(), Vec::new());
        let mut ranked = Vec::new();
        for place in self.candidate_set.places() {
            let first = &self.candidate_set.coefficients[place[0]];
            let same = |a: &Candidate| (&a.effect, &a.instance) == (&first.effect, &first.instance);
            if fit.added.iter().any(same) || !asked(first) {
                continue;
            }
            let forms = self.candidate_set.possible_forms(&place, &fit.added, self.settings.same_transient_s);
            if forms.is_empty() {
                continue;
            }
            let scored: Vec<Option<Scored>> =
                forms.into_iter().map(|f| self.score(scores, self.candidate_set.candidate(&place, f))).collect();
            // The matched filters count their own trials.
            if !first.transient {
                *tried.entry(first.effect.clone()).or_default() += scored.iter().flatten().count();
            }
            let best = scored.iter().flatten().max_by(|a, b| a.delta_chi2.total_cmp(&b.delta_chi2));
            let Some(best) = best else {
                if !first.transient {
                    unobservable.push(format!("{}:{}", first.effect, first.instance));
                }
                continue;
            };
            // Forms of a transient differ in time and cannot be mixed.
            let best = if first.transient { best.clone() } else { self.between_neighbours(scores, &scored, best) };
            ranked.push(self.window_corrected(fit, best));
        }
        ranked.sort_by(|a, b| b.delta_chi2.total_cmp(&a.delta_chi2));
        Ranked { all: ranked, tried, unobservable }
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

    /// Cross-spectra of the residuals of a fit per band, over those of white noise of unit PSD: a measured Σ.
    pub fn residual_psd(&self, fit: &Fit) -> Vec<DMatrix<f64>> {
        self.residual(&fit.layout, &fit.columns, &fit.estimate.theta)
    }

    fn residual(&self, layout: &Layout, columns: &[usize], theta: &DVector<f64>) -> Vec<DMatrix<f64>> {
        let spectra: Spectra = self.total.select(columns);
        dragfree_estimation::normal::residual_spectra(&spectra, layout, theta)
            .into_iter()
            .zip(&self.total.weights.expected)
            .map(|(r, e)| r / e.max(f64::MIN_POSITIVE))
            .collect()
    }
}

/// Distance in the one shape parameter that differs, and the candidate.
type Neighbour<'a> = (f64, &'a Candidate);

/// Forms of the same instance that differ in one shape parameter: the next below and the next above.
fn neighbours<'a>(of: &Candidate, all: impl Iterator<Item = &'a Candidate>) -> Vec<Neighbour<'a>> {
    let shape = &of.parts[0].1.shape;
    let mut nearest: BTreeMap<(&str, bool), Neighbour<'_>> = BTreeMap::new();
    for other in all {
        let theirs = &other.parts[0].1.shape;
        let differing: Vec<_> = shape.iter().filter(|(k, v)| theirs.get(*k) != Some(v)).collect();
        let [(key, value)] = differing[..] else { continue };
        let (Some(mine), Some(other_value)) = (value.as_f64(), theirs.get(key).and_then(serde_json::Value::as_f64))
        else {
            continue;
        };
        let distance = (other_value - mine).abs();
        let side = (key.as_str(), other_value > mine);
        if distance > 0.0 && nearest.get(&side).is_none_or(|(d, _)| distance < *d) {
            nearest.insert(side, (distance, other));
        }
    }
    nearest.into_values().collect()
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use crate::candidates::{Coefficient, Form, Term};
    use crate::coherence::HousekeepingCoherence;
    use crate::columns::Columns;
    use crate::gram::GramAccumulator;
    use crate::lines::LineSearch;
    use crate::transient::Search;
    use crate::waveform::Waveform;
    use dragfree_estimation::segments::Segmenter;
    use dragfree_estimation::spectra::LONG;
    use rand::SeedableRng;
    use rand_distr::{Distribution, StandardNormal};
    use rand_xoshiro::Xoshiro256PlusPlus;
    use serde_json::Map;

    const LENGTH: usize = 1024;
    const SAMPLES: usize = 20_000;
    const WAVEFORM: [f64; 4] = [1.0; 4];
    /// Two channels of white noise of one-sided PSD 1 at 1 Hz.
    const VARIANCE: f64 = 0.5;

    fn coefficient(instance: &str, candidate: bool, transient: bool, forms: Vec<Form>) -> Coefficient {
        Coefficient {
            name: format!("e.{instance}"),
            effect: "e".to_owned(),
            instance: instance.to_owned(),
            initial: 0.0,
            prior_sigma: None,
            estimate: !candidate,
            candidate,
            transient,
            forms,
            noise: String::new(),
        }
    }

    fn form(shape: &[(&str, i64)], terms: &[(usize, usize, f64)]) -> Form {
        let shape: Map<_, _> = shape.iter().map(|(k, v)| ((*k).to_owned(), (*v).into())).collect();
        let term = |(channel, column, factor): &(usize, usize, f64)| Term {
            channel: *channel,
            column: *column,
            factor: *factor,
            times: None,
        };
        let terms = terms.iter().map(term).collect();
        Form { shape, unit: "1".to_owned(), lower: None, upper: None, terms, colours: None }
    }

    /// A model of one coefficient. Candidates: transients at one time in the first channel, in both and in the second,
    /// and a lasting cause at the first's instance.
    pub(crate) fn candidate_set() -> CandidateSet {
        let at = &[("at_ns", 1)];
        CandidateSet {
            channels: vec!["first".to_owned(), "second".to_owned()],
            coefficients: vec![
                coefficient("model", false, false, vec![form(&[], &[(0, 2, 1.0)])]),
                coefficient("one", true, false, vec![form(&[], &[(0, 3, 1.0)])]),
                coefficient("one", true, true, vec![form(at, &[(0, 4, 1.0)])]),
                coefficient("both", true, true, vec![form(at, &[(0, 4, 1.0), (1, 4, 0.1)])]),
                coefficient("other", true, true, vec![form(at, &[(1, 4, 1.0)])]),
            ],
            rules: Vec::new(),
        }
    }

    /// Waveforms of some sizes at some samples, and `push` of the lasting series, whose correlation with the model's is
    /// 0.9.
    pub(crate) fn gathered(seed: u64, samples: usize, events: &[(usize, f64)], push: f64) -> GramSums {
        let mut rng = Xoshiro256PlusPlus::seed_from_u64(seed);
        let mut white = || -> Vec<f64> { (0..samples).map(|_| StandardNormal.sample(&mut rng)).collect() };
        let (mut first, mut second, model, mut lasting) = (white(), white(), white(), white());
        lasting.iter_mut().zip(&model).for_each(|(x, m)| *x = 0.9 * m + 0.19f64.sqrt() * *x);
        let time_ns: Vec<i64> = (0..samples as i64).map(|k| 1_000_000_000 * k).collect();
        let waveform = |at: usize| Waveform { at_ns: time_ns[at], step_ns: 1_000_000_000, kernel: WAVEFORM.to_vec() };
        let waveforms: Vec<Waveform> = events.iter().map(|(at, _)| waveform(*at)).collect();
        let series: Vec<Vec<f64>> = waveforms.iter().map(|w| w.over(&time_ns)).collect();
        first.iter_mut().for_each(|x| *x *= VARIANCE.sqrt());
        for (event, (_, size)) in series.iter().zip(events) {
            first.iter_mut().zip(event).for_each(|(x, e)| *x += size * e);
        }
        first.iter_mut().zip(&lasting).for_each(|(x, l)| *x += push * l);
        second.iter_mut().for_each(|x| *x *= VARIANCE.sqrt());
        let plan = Plan::slow(LONG * LENGTH, LENGTH, 1.0);
        let columns = Columns {
            names: ["first", "second", "model", "lasting", "event", "event"].map(str::to_owned)[..4 + events.len()]
                .to_vec(),
            tables: vec![String::new(); 4 + events.len()],
            channels: 2,
            base: 3,
            fast: 4 + events.len(),
            energy: waveforms.iter().map(|w| w.energy(&plan, false)).collect(),
            housekeeping_units: Vec::new(),
        };
        let residual = DMatrix::from_fn(2, 3, |i, j| f64::from(u8::from(i == j)));
        let coherence = |plan: &Plan| {
            let whitening = vec![DMatrix::identity(2, 2); plan.bands.len()];
            HousekeepingCoherence::new(Vec::new(), Vec::new(), plan, residual.clone(), whitening, Vec::new())
        };
        let search = Search::new(Vec::new(), residual.clone(), Vec::new());
        let mut gatherer = GramAccumulator::new(columns, LENGTH, 1.0, 1, coherence, search, LineSearch::nowhere());
        let mut segmenter = Segmenter::new(LENGTH, 1_000_000_000, vec![false; 4 + events.len()]);
        let slices: Vec<&[f64]> =
            [&first, &second, &model, &lasting].into_iter().chain(&series).map(Vec::as_slice).collect();
        segmenter.cut(&time_ns, &slices, &mut gatherer);
        segmenter.cut_end(&mut gatherer);
        gatherer.finish()
    }

    fn noise() -> NoiseModel {
        // Channels without declared noise: white.
        NoiseModel::new(&[], &["first", "second"], 1.0).unwrap()
    }

    fn transient(ranked: &Ranked, instance: &str) -> Scored {
        let of = |s: &&Scored| s.candidate.transient && s.candidate.instance == instance;
        ranked.all.iter().find(of).unwrap_or_else(|| panic!("{instance} is not ranked")).clone()
    }

    /// Wherever in a segment an event lies, its σ is that of least squares over its four samples, `√(½/4)`, to a tenth;
    /// by the weights of the sums alone it would be smaller. Its size lies within 4.5σ of the truth (false alarm 7e-6,
    /// eight times).
    #[test]
    fn an_event_has_the_error_of_least_squares_wherever_it_is() {
        let (candidate_set, noise, settings) = (candidate_set(), noise(), Settings::default());
        let mut natural: Vec<f64> = Vec::new();
        for (k, at) in (0..8).map(|k| (k, 9000 + 64 * k)) {
            let gathered = gathered(7 + k as u64, SAMPLES, &[(at, 6.0)], 0.0);
            let scorer = CandidateScorer::new(&candidate_set, &gathered, &noise, &settings);
            let scored = transient(&scorer.rank(&scorer.fit(&[]).unwrap()), "one");
            let sigma = scored.information[(0, 0)].sqrt().recip();
            let exact = (VARIANCE / 4.0).sqrt();
            assert!((sigma / exact - 1.0).abs() < 0.1, "at {at}: {sigma} against {exact}");
            assert!((scored.value[0] - 6.0).abs() < 4.5 * sigma, "at {at}: {}", scored.value[0]);
            natural.push(sigma * scored.understated.sqrt() / exact);
        }
        assert!(natural.iter().all(|x| *x < 0.95), "{natural:?}");
    }

    /// The missing cause pushes the model's coefficient, whose truth is 0, to 0.9, and its range ends at 0.1. Beside
    /// the candidate it moves back, and the candidate has the size that it has without a range; otherwise it would be
    /// 0.91/0.19. Within 4.5σ, twice (false alarm 1.4e-5).
    #[test]
    fn what_a_range_holds_back_comes_back_beside_a_candidate() {
        let (mut candidate_set, noise, settings) = (candidate_set(), noise(), Settings::default());
        let gathered = gathered(5, SAMPLES, &[(9000, 0.0)], 1.0);
        for limit in [None, Some(0.1)] {
            let form = &mut candidate_set.coefficients[0].forms[0];
            (form.lower, form.upper) = (limit.map(|x: f64| -x), limit);
            let scorer = CandidateScorer::new(&candidate_set, &gathered, &noise, &settings);
            let fit = scorer.fit(&[]).unwrap();
            assert_eq!(fit.estimate.active.len(), usize::from(limit.is_some()));
            let ranked = scorer.rank(&fit);
            let lasting = ranked.all.iter().find(|s| !s.candidate.transient && s.candidate.instance == "one").unwrap();
            let sigma = lasting.information[(0, 0)].sqrt().recip();
            assert!(
                (lasting.value[0] - 1.0).abs() < 4.5 * sigma && sigma < 0.02,
                "{limit:?}: {} ± {sigma}",
                lasting.value[0]
            );
        }
    }

    /// A lasting cause of the instance of an event is ranked apart, and what was added is not ranked again.
    #[test]
    fn an_event_is_ranked_apart_from_what_lasts() {
        let (candidate_set, noise, settings) = (candidate_set(), noise(), Settings::default());
        assert_eq!(candidate_set.places().len(), 4);
        let gathered = gathered(3, SAMPLES, &[(9000, 6.0)], 0.0);
        let scorer = CandidateScorer::new(&candidate_set, &gathered, &noise, &settings);
        let fit = scorer.fit(&[]).unwrap();
        let ranked = scorer.rank(&fit);
        let one = transient(&ranked, "one");
        assert!(ranked.all.iter().any(|s| !s.candidate.transient && s.candidate.instance == "one"));
        // Forms of transients are counted by the matched filters.
        assert_eq!(ranked.tried, BTreeMap::from([("e".to_owned(), 1)]));
        // What was added is not ranked again, and the residual no longer holds it.
        let fit = scorer.fit(&[one.candidate]).unwrap();
        let left = scorer.rank(&fit);
        assert!(left.all.iter().all(|s| s.candidate.instance != "one"));
        assert!(transient(&left, "other").delta_chi2 < 20.0);
    }

    /// Two lasting causes push; a third candidate has the series of the first in another unit. All three stand out, and
    /// beside the first only the second does: of the third no finer form is asked for.
    #[test]
    fn what_the_most_significant_candidate_explains_is_not_asked_for_again() {
        let (mut candidate_set, noise, settings) = (candidate_set(), noise(), Settings::default());
        candidate_set.coefficients.truncate(2);
        candidate_set.coefficients.push(coefficient("other", true, false, vec![form(&[], &[(0, 4, 1.0)])]));
        candidate_set.coefficients.push(coefficient("same", true, false, vec![form(&[], &[(0, 3, 2.0)])]));
        let gathered = gathered(5, SAMPLES, &[(9000, 8.0)], 1.0);
        let scorer = CandidateScorer::new(&candidate_set, &gathered, &noise, &settings);
        let screened = crate::screen::screen(&scorer, &[]).unwrap();
        let instances = |requests: &[crate::screen::RefinementRequest]| {
            let mut all: Vec<String> = requests.iter().map(|r| r.instance.clone()).collect();
            all.sort();
            all
        };
        assert_eq!(instances(&screened.requests), ["one", "other", "same"]);
        let mut requests = screened.requests.clone();
        crate::screen::retain_unexplained(&scorer, &screened, &mut requests).unwrap();
        let first = screened.forms[0].instance.clone();
        assert!(first == "one" || first == "same", "{first}");
        let mut expected = [first, "other".to_owned()];
        expected.sort();
        assert_eq!(instances(&requests), expected);
    }

    /// An event at the first of two times is named at "one"; "both" could have made it too. It stays at that time, to
    /// be compared, and not at the second time, where six times there is nothing (it would have more of the noise there
    /// than beside the named one in all six once in 64). Where something happened at the second time as well, it is
    /// there.
    #[test]
    fn what_could_have_made_a_named_event_stays_at_its_time() {
        let (mut candidate_set, noise, settings) = (candidate_set(), noise(), Settings::default());
        let times = [("at_ns", 9_000_000_000_000), ("at_ns", 12_000_000_000_000)];
        for instance in [2, 3] {
            let before = candidate_set.coefficients[instance].forms[0].clone();
            let at = |k: usize| {
                let terms: Vec<_> = before.terms.iter().map(|t| (t.channel, 4 + k, t.factor)).collect();
                form(&times[k..=k], &terms)
            };
            candidate_set.coefficients[instance].forms = vec![at(0), at(1)];
        }
        let rival = |seed: u64, later: f64| {
            let mut gathered = gathered(seed, SAMPLES, &[(9000, 6.0), (12_000, later)], 0.0);
            gathered.transients.tried = 1e4;
            let scorer = CandidateScorer::new(&candidate_set, &gathered, &noise, &settings);
            let named = candidate_set.candidate(&[2], 0);
            let forms = crate::screen::screen(&scorer, std::slice::from_ref(&named)).unwrap().forms;
            let of = |instance: &str| forms.iter().find(|f| f.transient && f.instance == instance).unwrap();
            assert_eq!(of("one").parts, named.parts);
            of("both").parts[0].1.shape["at_ns"].clone()
        };
        for seed in 1..=6 {
            assert_eq!(rival(seed, 0.0), times[0].1);
        }
        assert_eq!(rival(7, 6.0), times[1].1);
    }
}
