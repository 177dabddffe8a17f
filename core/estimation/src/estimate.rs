//! From the sums to coefficients: normal equations, constrained solution, Σ from the residuals, honest covariance.
//!
//! **Covariance.** `C = (N + Σ_rows a aᵀ/σ_row²)⁻¹`, times χ²/dof where that is above one. A constraint says that a
//! quantity lies in an interval of half width h and nothing else: a uniform density, whose Gaussian equivalent has σ =
//! h/√3. A survey holds the value near its middle. A range does not: it cuts off, the value stands anywhere in it where
//! the data do not see, and the rms distance of two points of an interval is √2 h/√3; σ = h. Where a row is *active*,
//! the value stands at its bound and the truth anywhere in the interval: the mean square about that bound is (2h/√3)².
//! Projecting active rows out would claim that a quantity is known exactly because the data wanted it outside its
//! range.

use dragfree_schema::{Coefficient, Constraint, Settings};
use nalgebra::{Cholesky, DMatrix, DVector};
use serde::Serialize;

use crate::colour::Colour;
use crate::levels::Levels;
use crate::normal::{Equations, NormalEquations, Split, accumulate};
use crate::prediction::Prediction;
use crate::qp::{Active, Kkt, Problem, QpError, Row, Side};
use crate::random_walk::{BandSpectra, significant_powers};
use crate::refine::{Chi2, SigmaError, Whitening};
use crate::sigma::{BandNoise, NoiseError, NoiseModel};
use crate::spectra::{Band, FIRST_BIN, Layout, Plan, Spectra, Sums};
use crate::verdict::{self, Direction, Pull, chi2_per_dof_at};

/// A coefficient of the model.
#[derive(Clone, Debug, PartialEq)]
pub struct Unknown {
    /// Its name.
    pub name: String,
    /// Its unit.
    pub unit: String,
    /// Lower end of its physical range, −∞ for none.
    pub lower: f64,
    /// Upper end of its physical range, +∞ for none.
    pub upper: f64,
    /// Value where it is not estimated.
    pub initial: f64,
    /// Prior σ; sets its natural size where it has no range.
    pub prior_sigma: f64,
    /// Whether it is estimated.
    pub estimate: bool,
    /// A noise that it colours; where levels of the noise are measured, not its bands.
    pub colours: Option<Colour>,
}

impl Unknown {
    /// Of a declared coefficient.
    pub fn of(c: &Coefficient) -> Self {
        Self {
            name: c.name.clone(),
            unit: c.unit.clone(),
            lower: c.lower,
            upper: c.upper,
            initial: c.initial,
            prior_sigma: c.prior_sigma,
            estimate: c.estimate,
            colours: c.colours.clone(),
        }
    }
}

/// The noises that unknowns colour, with their values.
pub fn colours<'a>(unknowns: &'a [Unknown], theta: &'a DVector<f64>) -> Vec<(&'a Colour, f64)> {
    unknowns.iter().zip(theta.iter()).filter_map(|(u, value)| Some((u.colours.as_ref()?, *value))).collect()
}

/// A linear constraint among coefficients.
#[derive(Clone, Debug, PartialEq)]
pub struct Bound {
    /// Its name.
    pub name: String,
    /// Knowledge from a survey counts as information; a range does not, when the data's own power is judged.
    pub survey: bool,
    /// Index of a coefficient, weight.
    pub terms: Vec<(usize, f64)>,
    /// Lower bound.
    pub lower: f64,
    /// Upper bound.
    pub upper: f64,
}

impl Bound {
    /// Of declared constraints; one on a coefficient that is not in the model constrains nothing here.
    pub fn all(coefficients: &[Coefficient], constraints: &[Constraint]) -> Vec<Self> {
        let index = |name: &str| coefficients.iter().position(|c| c.name == name);
        let of = |c: &Constraint| {
            let terms = c.terms.iter().map(|(name, weight)| Some((index(name)?, *weight))).collect::<Option<_>>()?;
            Some(Self { name: c.name.clone(), survey: c.is_survey(), terms, lower: c.lower, upper: c.upper })
        };
        constraints.iter().filter_map(of).collect()
    }
}

/// What was made of the data.
#[derive(Clone, Copy)]
pub struct Observed<'a> {
    /// Channels, series and regressors.
    pub layout: &'a Layout,
    /// Bands and segments.
    pub plan: &'a Plan,
    /// Cross-spectra.
    pub sums: &'a Sums,
    /// The fit in the time domain.
    pub prediction: Option<&'a Prediction>,
}

/// Why there is no estimate.
#[derive(Debug, thiserror::Error)]
pub enum EstimateError {
    /// Σ cannot be used.
    #[error(transparent)]
    Sigma(#[from] SigmaError),
    /// The constrained problem has no solution.
    #[error(transparent)]
    Qp(#[from] QpError),
    /// Declared noise that cannot be used.
    #[error(transparent)]
    Noise(#[from] NoiseError),
}

/// The solution and how it came about.
#[derive(Clone, Debug)]
pub struct Estimate {
    /// Coefficients that were solved for.
    pub free: Vec<usize>,
    /// All coefficients, the fixed ones at their initial value.
    pub theta: DVector<f64>,
    /// Covariance of the free coefficients; none when there is neither data nor range in some direction.
    pub covariance: Option<DMatrix<f64>>,
    /// By how much σ of each of them was widened: for residuals beyond the refined Σ or blocks of time that scatter
    /// more than chance allows, whichever is more, and for information that is uneven in time.
    pub widened: Vec<f64>,
    /// Directions that data and survey do not see.
    pub weak: Vec<Direction>,
    /// Rows at which the solution stands.
    pub active: Vec<Active>,
    /// The data's score of the free coefficients at the solution, `c − Nθ`, where ranges hold it back; what surveys
    /// hold stays where it is.
    pub bound_score: DVector<f64>,
    /// Conditions of optimality of the last solution.
    pub kkt: Kkt,
    /// The normal equations, with the refined Σ.
    pub normal: NormalEquations,
    /// Information of data, surveys and ranges on the free coefficients.
    pub known: DMatrix<f64>,
    /// Refined `Σ⁻¹`, channels × channels, per band.
    pub inverses: Vec<DMatrix<f64>>,
    /// `−2 log` of the likelihood of the residuals under the Σ that fits them best, up to a constant of the data.
    pub deviance: f64,
    /// What the blocks of time say of σ, for each free coefficient; none with fewer than [`LEAST_BLOCKS`].
    pub scatter: Option<Scatter>,
    /// The same coefficients by the fit in the time domain.
    pub prediction: Option<Check>,
    /// Surveys and ranges against the data.
    pub pulls: Vec<Pull>,
    /// χ² of the surveys against the data, and its degrees of freedom.
    pub survey_chi2: (f64, f64),
    /// How well the noise is understood.
    pub quality: Quality,
}

/// Blocks below which nothing is said about their scatter.
pub const LEAST_BLOCKS: usize = 6;

/// The information measured: pulls of single blocks of time against what the normal equations promise.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Scatter {
    /// Blocks compared.
    pub blocks: usize,
    /// Scatter of the blocks' pulls on each free coefficient over what `N` promises, as a ratio of σ.
    pub ratio: Vec<f64>,
    /// Above this the ratio is no chance ([`Settings::scatter_sigmas`]) and widens σ.
    pub upper: f64,
}

/// A second solution.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Check {
    /// Values of the free coefficients.
    pub value: Vec<f64>,
    /// Their σ, from the scatter of the blocks where there are enough.
    pub sigma: Vec<f64>,
    /// Blocks of time.
    pub blocks: usize,
}

/// χ² and how far Σ moved.
#[derive(Clone, Debug, Serialize)]
pub struct Quality {
    /// χ²/dof with Σ from the residuals.
    pub chi2_per_dof: f64,
    /// Degrees of freedom of it.
    pub dof: f64,
    /// χ²/dof with Σ as declared.
    pub chi2_per_dof_modelled_sigma: f64,
    /// Each channel alone, with Σ from the residuals.
    pub channels: Vec<ChannelQuality>,
    /// χ²/dof of the coherence between channels that the model does not connect, and its degrees of freedom.
    pub between_groups: (f64, f64),
    /// Largest change of a coefficient in the last refinement, in its σ.
    pub last_step_sigma: f64,
    /// Frequency and χ²/dof of the narrow band that fits the refined Σ least.
    pub worst_band: (f64, f64),
    /// Degrees of freedom of the worst band.
    pub worst_band_dof: f64,
}

/// One channel's noise.
#[derive(Clone, Debug, Serialize)]
pub struct ChannelQuality {
    /// Name.
    pub channel: String,
    /// χ²/dof with Σ from the residuals.
    pub chi2_per_dof: f64,
    /// Degrees of freedom.
    pub dof: f64,
    /// Measured over modelled amplitude, whole band.
    pub measured_over_modelled: f64,
    /// The same by decade: from Hz, to Hz, ratio, its standard deviation when the noise is stationary.
    pub by_decade: Vec<(f64, f64, f64, f64)>,
}

/// Steps for products of two coefficients: each is taken at the other's last value, whose error enters times a gain of
/// some per cent, so three leave a millionth of it.
const PRODUCT_STEPS: usize = 3;

/// Solves for the coefficients, and again in the time domain where there is a `prediction`; Σ is measured from the
/// residuals, and the coefficients solved again, `refinements` times.
///
/// # Errors
/// [`EstimateError`] when the modelled noise is singular or the constraints contradict each other.
pub fn estimate(
    observed: &Observed<'_>,
    model: &NoiseModel,
    unknowns: &[Unknown],
    bounds: &[Bound],
    refinements: usize,
) -> Result<Estimate, EstimateError> {
    let settings = Settings::default();
    let method = Method { refinements, refinement: Refinement::Bands, settings: &settings };
    estimate_with(observed, &BandNoise::new(model, observed.plan), unknowns, bounds, &method)
}

/// What of Σ is measured from the residuals.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Refinement {
    /// Every band, with its correlations.
    Bands,
    /// The levels of the declared processes alone; see [`crate::levels`]. For models with regressors that the loop
    /// makes of the noise.
    Levels,
}

/// How Σ is refined, and from what size on something is judged.
#[derive(Clone, Copy, Debug)]
pub struct Method<'a> {
    /// How often Σ is measured from the residuals.
    pub refinements: usize,
    /// What of it.
    pub refinement: Refinement,
    /// Thresholds.
    pub settings: &'a Settings,
}

/// As [`estimate`], with Σ refined in one way or the other, and the declared noise in the bands of the plan.
///
/// # Errors
/// As [`estimate`].
pub fn estimate_with(
    observed: &Observed<'_>,
    noise: &BandNoise<'_>,
    unknowns: &[Unknown],
    bounds: &[Bound],
    method: &Method<'_>,
) -> Result<Estimate, EstimateError> {
    let Observed { sums, prediction, plan, layout } = *observed;
    let Method { refinements, refinement, settings } = *method;
    let spectra = &sums.total;
    let whitening = Whitening::new(noise, plan, spectra)?;
    let even = refinement == Refinement::Levels;
    let kept = if even { zero_area_weights(spectra, plan) } else { spectra.kept() };
    let mut inverses = whitening.model_inverses();
    let initial: Vec<f64> = unknowns.iter().map(|u| u.initial).collect();
    let mut linear = layout.linear_at(&initial);
    let mut apart = layout.in_loop();
    apart.retain(|i| unknowns[*i].estimate);
    let split = Split { spectra, slow_bands: plan.slow_bands, apart: &apart };
    let mut equations = split.accumulate(&linear, &inverses, &kept);
    let seen = |i: usize| equations.normal[(i, i)] > 0.0;
    let free: Vec<usize> = (0..unknowns.len()).filter(|i| unknowns[*i].estimate && seen(*i)).collect();
    let unseen: Vec<usize> = (0..unknowns.len()).filter(|i| unknowns[*i].estimate && !seen(*i)).collect();

    let mut solved = Reduced::new(&equations, unknowns, bounds, &free).solve()?;
    let mut residual = split.residuals(&linear, &inverses, &kept, &solved.theta);
    let modelled = whitening.chi2(&residual, &inverses, false);
    let mut last_step = DVector::zeros(unknowns.len());
    // Products of coefficients want as many steps as Σ does.
    let products = layout.regressors.iter().any(|r| r.times.is_some());
    let steps = if products { refinements.max(PRODUCT_STEPS) } else { refinements };
    for step in 0..steps {
        if step < refinements {
            let from = FromResiduals { plan, spectra, residual: &residual, settings };
            inverses = from.refined(noise, refinement, &whitening, &colours(unknowns, &solved.theta))?;
        }
        linear = layout.linear_at(solved.theta.as_slice());
        equations = split.accumulate(&linear, &inverses, &kept);
        let next = Reduced::new(&equations, unknowns, bounds, &free).solve()?;
        last_step = &next.theta - &solved.theta;
        solved = next;
        residual = split.residuals(&linear, &inverses, &kept, &solved.theta);
    }
    let layout = &linear;
    let fitted = refinements > 0 && refinement == Refinement::Bands;
    let chi2 = whitening.chi2(&residual, &inverses, fitted);

    let reduced = Reduced::new(&equations, unknowns, bounds, &free);
    let weak = reduced.weak(unknowns, &unseen, settings.weak_direction);
    let dof = (chi2.expected - free.len() as f64).max(1.0);
    let chi2_per_dof = chi2.sum / dof;
    let covariance = reduced.covariance(&solved.active);
    let scatter = covariance.as_ref().and_then(|c| {
        let linear = Observed { layout, ..*observed };
        scatter(&linear, &inverses, &solved.theta, c, &free, settings.scatter_sigmas)
    });
    let by_blocks = |k: usize| scatter.as_ref().map_or(1.0, |s| if s.ratio[k] > s.upper { s.ratio[k] } else { 1.0 });
    let by_noise = chi2_per_dof.max(1.0).sqrt();
    let by_time = match &covariance {
        Some(c) if even => unevenness(spectra, &kept, layout, &inverses, &free, c),
        _ => vec![1.0; free.len()],
    };
    let widened: Vec<f64> = (0..free.len()).map(|k| by_blocks(k).max(by_noise) * by_time[k]).collect();
    let covariance =
        covariance.map(|c| DMatrix::from_fn(c.nrows(), c.ncols(), |i, j| c[(i, j)] * widened[i] * widened[j]));
    let last_step_sigma = covariance.as_ref().map_or(f64::NAN, |c| {
        free.iter().enumerate().map(|(k, i)| last_step[*i].abs() / c[(k, k)].sqrt()).fold(0.0, f64::max)
    });
    let prediction = match prediction {
        Some(p) => check(p, unknowns, bounds, &free)?,
        None => None,
    };
    let known = reduced.with_knowledge(&solved.active);
    let bound_score = reduced.bound_score(&solved.active);
    let (pulls, survey_chi2) = reduced.pulls(&solved.active, chi2_per_dof.max(1.0));
    let (worst, worst_band_dof) = worst_band(&residual, &inverses, plan, &whitening);
    let quality = Quality {
        chi2_per_dof,
        dof,
        chi2_per_dof_modelled_sigma: modelled.sum / modelled.expected,
        channels: channel_quality(&chi2, &residual, plan, layout, &whitening),
        between_groups: {
            let (sum, dof) = whitening.between_groups(&residual);
            (sum / dof.max(1.0), dof)
        },
        last_step_sigma,
        worst_band: worst,
        worst_band_dof,
    };
    let names = unknowns.iter().map(|u| u.name.clone()).collect();
    Ok(Estimate {
        free,
        theta: solved.theta,
        covariance,
        widened,
        weak,
        active: solved.active,
        bound_score,
        kkt: solved.kkt,
        normal: NormalEquations::new(names, &equations, spectra.segments),
        known,
        deviance: whitening.deviance(&residual),
        inverses,
        scatter,
        prediction,
        pulls,
        survey_chi2,
        quality,
    })
}

/// Weights with which the score of a gain inside the loop vanishes where the gain is right: each band as much as it is
/// wide, and the octave above the lowest bin for what lies below it too. Slow bands have their own weights, as such a
/// gain is not estimated there.
///
/// A command follows the noise through a strictly causal filter U, and `∫ Re U df = 0` from zero on (see
/// [`crate::levels`]). Below the lowest bin of an ordinary segment, 1.8 mHz, the loop is stiff, and U is much as it is
/// in the octave above. Left out, that moved gains of the thrusters by 0.02, more than their σ, whatever the length of
/// the data. Segments that are there for what is slow leave next to nothing out.
pub(crate) fn zero_area_weights(spectra: &Spectra, plan: &Plan) -> Vec<f64> {
    let octave = if plan.first_bin == FIRST_BIN { FIRST_BIN..2 * FIRST_BIN } else { 0..0 };
    // Of frequencies from zero, half a bin belongs to the constant.
    let both = 1.0 + (FIRST_BIN as f64 - 0.5) / FIRST_BIN as f64;
    let weight = |(band, even): (&Band, f64)| if octave.contains(&band.first) { both * even } else { even };
    let mut weights: Vec<f64> = plan.bands.iter().zip(spectra.equal_time_weights()).map(weight).collect();
    weights[..plan.slow_bands].copy_from_slice(&spectra.kept()[..plan.slow_bands]);
    weights
}

/// By how much σ of each free coefficient is larger than the equations with other weights than the true ones say: bands
/// that stand for little time count as if they stood for all. `C (N + Σ_b (u_b/v_b − 1) N_b) C` against `C`, `used` are
/// the u_b, and v_b the true ones.
fn unevenness(
    spectra: &Spectra,
    used: &[f64],
    layout: &Layout,
    inverses: &[DMatrix<f64>],
    free: &[usize],
    covariance: &DMatrix<f64>,
) -> Vec<f64> {
    let over = |(u, v): (&f64, &f64)| if *v > 0.0 { u * (u / v - 1.0) } else { 0.0 };
    let excess: Vec<f64> = used.iter().zip(&spectra.kept()).map(over).collect();
    let normal = accumulate(spectra, layout, inverses, &excess).normal;
    let more = DMatrix::from_fn(free.len(), free.len(), |i, j| normal[(free[i], free[j])]);
    let spread = covariance * more * covariance;
    (0..free.len()).map(|k| (1.0 + spread[(k, k)] / covariance[(k, k)]).max(1.0).sqrt()).collect()
}

/// What Σ is measured from, and from what size on something is judged.
struct FromResiduals<'a> {
    plan: &'a Plan,
    spectra: &'a Spectra,
    residual: &'a [DMatrix<f64>],
    settings: &'a Settings,
}

impl FromResiduals<'_> {
    /// `Σ⁻¹` per band. Slow bands are refined by bands in any case: no gain in the loop is estimated there, which a Σ
    /// that is free in every band would fit.
    fn refined(
        &self,
        noise: &BandNoise<'_>,
        refinement: Refinement,
        declared: &Whitening,
        colours: &[(&Colour, f64)],
    ) -> Result<Vec<DMatrix<f64>>, SigmaError> {
        let slow = self.plan.slow_bands;
        let is_slow = self.spectra.weight[..slow].iter().any(|w| *w > 0.0);
        if !is_slow && refinement == Refinement::Bands {
            return Ok(declared.refined_inverses(self.residual));
        }
        let measured = self.measured();
        let levels = self.fitted(noise.model, &measured, colours);
        if !is_slow {
            return Ok(levels.inverses());
        }
        let mut mean = noise.mean.clone();
        mean[..slow].clone_from_slice(&self.slow_sigma(&noise.model.directions, &levels, &measured));
        let beside_walks = Whitening::new(&BandNoise { model: noise.model, mean }, self.plan, self.spectra)?;
        let mut inverses = beside_walks.refined_inverses(self.residual);
        if refinement == Refinement::Levels {
            inverses[slow..].clone_from_slice(&levels.inverses()[slow..]);
        }
        Ok(inverses)
    }

    /// One-sided cross-spectra of the residuals.
    fn measured(&self) -> Vec<DMatrix<f64>> {
        let expected = self.spectra.expected.iter().map(|e| e.max(f64::MIN_POSITIVE));
        self.residual.iter().zip(expected).map(|(r, e)| r / e).collect()
    }

    /// Levels that fit the ordinary bands. A slow force that nobody models is no level of the noise.
    fn fitted<'b>(
        &'b self,
        model: &'b NoiseModel,
        measured: &'b [DMatrix<f64>],
        colours: &[(&Colour, f64)],
    ) -> Levels<'b> {
        let weights = self.spectra.weights_of(self.plan.ordinary_bands());
        let mut levels = Levels::new(model, self.plan, &weights, measured, self.settings).coloured(self.plan, colours);
        levels.fit();
        levels
    }

    /// Σ in the slow bands: the declared noise at the levels of the bands above, and random walks of the forces where
    /// the residuals have some.
    fn slow_sigma(
        &self,
        directions: &[DVector<f64>],
        levels: &Levels<'_>,
        measured: &[DMatrix<f64>],
    ) -> Vec<DMatrix<f64>> {
        let observations = self.spectra.observations(self.plan);
        let all: Vec<BandSpectra<'_>> = (0..self.plan.slow_bands)
            .map(|b| BandSpectra {
                hz: self.plan.frequency_hz(self.plan.bands[b]),
                observations: observations[b],
                modelled: &levels.modelled()[b],
                measured: &measured[b],
            })
            .collect();
        let seen: Vec<BandSpectra<'_>> = all.iter().filter(|b| b.observations > 0.0).copied().collect();
        let directions: Vec<&DVector<f64>> = directions.iter().collect();
        let powers = significant_powers(&seen, &directions, self.settings.level_delta_chi2);
        all.iter().map(|band| band.with(&powers, &directions)).collect()
    }
}

/// The problem in the free coefficients alone.
struct Reduced<'a> {
    free: &'a [usize],
    unknowns: &'a [Unknown],
    /// `N`, whose inverse is a covariance.
    information: DMatrix<f64>,
    right: DVector<f64>,
    rows: Vec<Row>,
    /// What each row knows.
    knowledge: Vec<Knowledge>,
    /// Natural size of each free coefficient: half of its range, or its prior σ, or what the data say.
    size: DVector<f64>,
}

/// What a row knows beyond excluding values.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Knowledge {
    /// A measurement that is not ours.
    Survey,
    /// A physical range.
    Range,
    /// Nothing that another row does not say: the range of a coefficient that a range constraint bounds as well.
    Repeated,
}

struct Solved {
    theta: DVector<f64>,
    active: Vec<Active>,
    kkt: Kkt,
}

/// A coefficient with neither range nor prior is called weak only when double precision cannot tell it from nothing.
const SIZE_WITHOUT_RANGE: f64 = 1e6;

impl<'a> Reduced<'a> {
    fn new(
        Equations { normal, right, .. }: &Equations,
        unknowns: &'a [Unknown],
        bounds: &[Bound],
        free: &'a [usize],
    ) -> Self {
        let n = free.len();
        let fixed: Vec<usize> = (0..unknowns.len()).filter(|i| !free.contains(i)).collect();
        let information = DMatrix::from_fn(n, n, |i, j| normal[(free[i], free[j])]);
        let right = DVector::from_fn(n, |i, _| {
            let known: f64 = fixed.iter().map(|f| normal[(free[i], *f)] * unknowns[*f].initial).sum();
            right[free[i]] - known
        });
        let (mut rows, mut knowledge) = (Vec::new(), Vec::new());
        for (k, i) in free.iter().enumerate() {
            let u = &unknowns[*i];
            let mut terms = vec![0.0; n];
            terms[k] = 1.0;
            rows.push(Row { name: format!("range of {}", u.name), terms, lower: u.lower, upper: u.upper });
            let bounded_again = bounds.iter().any(|b| !b.survey && b.terms.iter().any(|(j, w)| j == i && *w != 0.0));
            knowledge.push(if bounded_again { Knowledge::Repeated } else { Knowledge::Range });
        }
        for b in bounds {
            let known: f64 =
                b.terms.iter().filter(|(i, _)| fixed.contains(i)).map(|(i, w)| w * unknowns[*i].initial).sum();
            let mut terms = vec![0.0; n];
            for (i, weight) in &b.terms {
                if let Some(k) = free.iter().position(|f| f == i) {
                    terms[k] += weight;
                }
            }
            if terms.iter().any(|t| *t != 0.0) {
                rows.push(Row { name: b.name.clone(), terms, lower: b.lower - known, upper: b.upper - known });
                knowledge.push(if b.survey { Knowledge::Survey } else { Knowledge::Range });
            }
        }
        let size = DVector::from_fn(n, |k, _| {
            let u = &unknowns[free[k]];
            let candidates = [0.5 * (u.upper - u.lower), u.prior_sigma];
            let usable = candidates.into_iter().find(|s| s.is_finite() && *s > 0.0);
            usable.unwrap_or_else(|| SIZE_WITHOUT_RANGE / information[(k, k)].sqrt())
        });
        Self { free, unknowns, information, right, rows, knowledge, size }
    }

    /// Information of data and rows, with the σ of each row as `sigma(index, row)` has it.
    fn with_rows(&self, sigma: impl Fn(usize, &Row) -> f64) -> DMatrix<f64> {
        let mut m = self.information.clone();
        for (i, row) in self.rows.iter().enumerate() {
            let a = DVector::from_column_slice(&row.terms);
            // An interval of no width is an equality; in double precision 1e-9 of the unknowns' sizes is one.
            let least = 1e-9 * a.component_mul(&self.size).norm();
            let weight = sigma(i, row).max(least).powi(-2);
            if weight > 0.0 {
                m += &a * a.transpose() * weight;
            }
        }
        m
    }

    fn solve(&self) -> Result<Solved, EstimateError> {
        let mut theta = DVector::from_fn(self.unknowns.len(), |i, _| self.unknowns[i].initial);
        if self.free.is_empty() {
            return Ok(Solved { theta, active: Vec::new(), kkt: Kkt::default() });
        }
        let problem = Problem {
            normal: self.information.clone(),
            right: self.right.clone(),
            rows: self.rows.clone(),
            // σ with the others held, or the natural size where there is no information: unit curvature, an objective
            // in χ².
            scale: DVector::from_fn(self.free.len(), |k, _| {
                (self.information[(k, k)] + self.size[k].powi(-2)).sqrt().recip()
            }),
            origin: self.gaussian_solution(),
        };
        let solution = problem.solve()?;
        for (k, i) in self.free.iter().enumerate() {
            theta[*i] = solution.theta[k];
        }
        Ok(Solved { theta, active: solution.active, kkt: solution.kkt })
    }

    /// Where the solution would be if every row were an observation of its interval's middle: a start for the solver.
    fn gaussian_solution(&self) -> DVector<f64> {
        let mut right = self.right.clone();
        for row in self.rows.iter().filter(|r| r.half_width().is_finite() && r.half_width() > 0.0) {
            let weight = 3.0 / row.half_width().powi(2);
            right += DVector::from_column_slice(&row.terms) * (weight * 0.5 * (row.lower + row.upper));
        }
        let matrix = self.with_rows(|_, r| if r.half_width() > 0.0 { uniform_sigma(r) } else { f64::INFINITY });
        self.inverse(&matrix).map_or_else(|| DVector::zeros(self.free.len()), |inverse| inverse * right)
    }

    /// Inverse in natural sizes, none when not positive definite.
    fn inverse(&self, matrix: &DMatrix<f64>) -> Option<DMatrix<f64>> {
        let d = DMatrix::from_diagonal(&self.size);
        Cholesky::new(&d * matrix * &d).map(|c| &d * c.inverse() * &d)
    }

    fn covariance(&self, active: &[Active]) -> Option<DMatrix<f64>> {
        self.inverse(&self.with_knowledge(active))
    }

    /// `Σ z a` over ranges at which the solution stands.
    fn bound_score(&self, active: &[Active]) -> DVector<f64> {
        let mut sum = DVector::zeros(self.free.len());
        for a in active.iter().filter(|a| self.knowledge[a.row] != Knowledge::Survey) {
            let sign = if a.side == Side::Upper { 1.0 } else { -1.0 };
            sum += DVector::from_column_slice(&self.rows[a.row].terms) * (sign * a.multiplier);
        }
        sum
    }

    /// Information of the data and of every row.
    fn with_knowledge(&self, active: &[Active]) -> DMatrix<f64> {
        self.with_rows(|i, row| {
            let at_a_bound = active.iter().any(|a| a.row == i);
            match self.knowledge[i] {
                Knowledge::Repeated => f64::INFINITY,
                _ if at_a_bound => 2.0 * uniform_sigma(row),
                Knowledge::Survey => uniform_sigma(row),
                Knowledge::Range => row.half_width(),
            }
        })
    }

    /// What the data say of each row without it: surveys against data and ranges, ranges against data and surveys.
    /// `noise` is the χ²/dof by which covariances grow.
    fn pulls(&self, active: &[Active], noise: f64) -> (Vec<Pull>, (f64, f64)) {
        let is_survey = |i: usize| self.knowledge[i] == Knowledge::Survey;
        let with = |survey: bool| {
            // Nothing but a finite size in directions without data.
            let prior = DMatrix::from_diagonal(&self.size.map(|s| s.powi(-2)));
            let use_row = |i: usize| survey && is_survey(i);
            let matrix = self.with_rows(|i, r| if use_row(i) { uniform_sigma(r) } else { f64::INFINITY }) + prior;
            let mut right = self.right.clone() + self.middle().component_div(&self.size.map(|s| s * s));
            for (_, row) in self.rows.iter().enumerate().filter(|(i, r)| use_row(*i) && r.half_width().is_finite()) {
                let least = 1e-9 * DVector::from_column_slice(&row.terms).component_mul(&self.size).norm();
                let weight = uniform_sigma(row).max(least).powi(-2);
                right += DVector::from_column_slice(&row.terms) * (weight * 0.5 * (row.lower + row.upper));
            }
            self.inverse(&matrix).map(|c| (&c * right, c * noise))
        };
        let (Some((free, c_free)), Some((held, c_held))) = (with(false), with(true)) else {
            return (Vec::new(), (0.0, 0.0));
        };
        let mut pulls = Vec::new();
        let mut surveys: Vec<(DVector<f64>, f64, f64)> = Vec::new();
        for (i, row) in self.rows.iter().enumerate() {
            let a = DVector::from_column_slice(&row.terms);
            let multiplier = active.iter().filter(|m| m.row == i).map(|m| m.multiplier).sum();
            let (distance, sigma) = if is_survey(i) {
                let distance = a.dot(&free) - 0.5 * (row.lower + row.upper);
                surveys.push((a.clone(), distance, uniform_sigma(row)));
                (distance, (a.dot(&(&c_free * &a)) + uniform_sigma(row).powi(2)).sqrt())
            } else {
                let value = a.dot(&held);
                let beyond = (value - row.upper).max(0.0) - (row.lower - value).max(0.0);
                (beyond, a.dot(&(&c_held * &a)).sqrt())
            };
            let unit = self.unit(row);
            pulls.push(Pull { constraint: row.name.clone(), unit, distance, sigma, multiplier, survey: is_survey(i) });
        }
        let n = surveys.len();
        let spread = DMatrix::from_fn(n, n, |i, j| {
            let own = if i == j { surveys[i].2.powi(2) } else { 0.0 };
            surveys[i].0.dot(&(&c_free * &surveys[j].0)) + own
        });
        let distance = DVector::from_fn(n, |i, _| surveys[i].1);
        let chi2 = Cholesky::new(spread).map_or((0.0, 0.0), |c| (distance.dot(&c.solve(&distance)), n as f64));
        (pulls, chi2)
    }

    /// Middles of the coefficients' ranges, or where they start.
    fn middle(&self) -> DVector<f64> {
        DVector::from_fn(self.free.len(), |k, _| {
            let u = &self.unknowns[self.free[k]];
            let middle = 0.5 * (u.lower + u.upper);
            if middle.is_finite() { middle } else { u.initial }
        })
    }

    /// Unit of a row: that of its first coefficient.
    fn unit(&self, row: &Row) -> String {
        let first = row.terms.iter().position(|t| *t != 0.0);
        first.map_or_else(String::new, |k| self.unknowns[self.free[k]].unit.clone())
    }

    fn weak(&self, unknowns: &[Unknown], unseen: &[usize], from: f64) -> Vec<Direction> {
        let information = self.with_rows(|i, row| match self.knowledge[i] {
            Knowledge::Survey => uniform_sigma(row),
            _ => f64::INFINITY,
        });
        let names: Vec<(&str, &str)> =
            self.free.iter().map(|i| (unknowns[*i].name.as_str(), unknowns[*i].unit.as_str())).collect();
        let mut weak = verdict::weak_directions(&information, &self.size, &names, from);
        weak.extend(unseen.iter().map(|i| Direction::unseen(&unknowns[*i].name)));
        weak
    }
}

/// The prediction-error fit under the same rows; none before its filters have settled, or where it does not see a
/// coefficient.
fn check(
    prediction: &Prediction,
    unknowns: &[Unknown],
    bounds: &[Bound],
    free: &[usize],
) -> Result<Option<Check>, EstimateError> {
    let blocks = prediction.equations();
    let n = unknowns.len();
    let mut sum = Equations { normal: DMatrix::zeros(n, n), right: DVector::zeros(n), zz: 0.0 };
    for (normal, right) in &blocks {
        sum.normal += normal;
        sum.right += right;
    }
    if free.is_empty() || free.iter().any(|i| sum.normal[(*i, *i)] <= 0.0) {
        return Ok(None);
    }
    let reduced = Reduced::new(&sum, unknowns, bounds, free);
    let solved = reduced.solve()?;
    let known = reduced.with_knowledge(&solved.active);
    let Some(bread) = reduced.inverse(&known) else { return Ok(None) };
    let covariance = if blocks.len() < LEAST_BLOCKS {
        bread
    } else {
        // The scatter of the blocks' pulls in place of N; what the rows know stays what it is.
        let mut middle = known - &reduced.information;
        let shared = blocks.len() as f64 / (blocks.len() as f64 - 1.0);
        for (normal, right) in &blocks {
            let pull = right - normal * &solved.theta;
            let pull = DVector::from_fn(free.len(), |k, _| pull[free[k]]);
            middle += &pull * pull.transpose() * shared;
        }
        &bread * middle * &bread
    };
    Ok(Some(Check {
        value: free.iter().map(|i| solved.theta[*i]).collect(),
        sigma: covariance.diagonal().iter().map(|v| v.max(0.0).sqrt()).collect(),
        blocks: blocks.len(),
    }))
}

/// Pulls of the blocks on the free coefficients, `C (c_b − N_b θ)`, squared and summed, over their expectation when Σ
/// is right and the same at all times; B blocks share one θ, which takes a part 1/B.
fn scatter(
    &Observed { sums, layout, plan, .. }: &Observed<'_>,
    inverses: &[DMatrix<f64>],
    theta: &DVector<f64>,
    covariance: &DMatrix<f64>,
    free: &[usize],
    sigmas: f64,
) -> Option<Scatter> {
    let blocks = sums.blocks.len();
    if blocks < LEAST_BLOCKS || free.is_empty() {
        return None;
    }
    // Long segments have no blocks.
    let kept = sums.total.weights_of(plan.ordinary_bands()).kept();
    let (mut measured, mut expected) = (DVector::zeros(free.len()), DVector::zeros(free.len()));
    for block in &sums.blocks {
        let equations = accumulate(&block.spectra, layout, inverses, &kept);
        let pull = &equations.right - &equations.normal * theta;
        let pull = covariance * DVector::from_fn(free.len(), |k, _| pull[free[k]]);
        // `kept² Σg²/Σg` with the block's own weights: what the pull's variance is when the block's segments are taken
        // as they lie.
        let own = block.spectra.kept();
        let weights: Vec<f64> =
            kept.iter().zip(&own).map(|(k, own)| if *own > 0.0 { k * k / own } else { 0.0 }).collect();
        let variance = accumulate(&block.spectra, layout, inverses, &weights).normal;
        let variance = DMatrix::from_fn(free.len(), free.len(), |i, j| variance[(free[i], free[j])]);
        measured += pull.component_mul(&pull);
        expected += (covariance * variance * covariance).diagonal();
    }
    let dof = blocks as f64 - 1.0;
    let ratio = measured.component_div(&expected).map(|r| (r * blocks as f64 / dof).sqrt());
    let upper = chi2_per_dof_at(dof, sigmas).sqrt();
    Some(Scatter { blocks, ratio: ratio.iter().copied().collect(), upper })
}

/// σ of a uniform density over a row's interval; infinite where one side is open.
fn uniform_sigma(row: &Row) -> f64 {
    row.half_width() / 3f64.sqrt()
}

fn channel_quality(
    chi2: &Chi2,
    residual: &[DMatrix<f64>],
    plan: &Plan,
    layout: &Layout,
    whitening: &Whitening,
) -> Vec<ChannelQuality> {
    let overall = whitening.power_ratio(residual, 0..plan.bands.len());
    let mut decades: Vec<(i32, std::ops::Range<usize>)> = Vec::new();
    for (b, band) in plan.bands.iter().enumerate() {
        if whitening.observations(b..b + 1) == 0.0 {
            continue;
        }
        let decade = plan.frequency_hz(*band).log10().floor() as i32;
        match decades.last_mut() {
            Some((last, range)) if *last == decade => range.end = b + 1,
            _ => decades.push((decade, b..b + 1)),
        }
    }
    let by_decade: Vec<(f64, f64, Vec<f64>, f64)> = decades
        .into_iter()
        .map(|(_, range)| {
            let [first, last] = [plan.bands[range.start], plan.bands[range.end - 1]];
            let (from, to) = (plan.hz(first, first.first as f64), plan.hz(last, last.end as f64));
            // Half the relative standard deviation of a power that n complex observations give.
            let sigma = 0.5 / whitening.observations(range.clone()).sqrt();
            (from, to, whitening.power_ratio(residual, range), sigma)
        })
        .collect();
    layout
        .channels
        .iter()
        .enumerate()
        .map(|(c, name)| {
            let (sum, expected) = chi2.channel[c];
            ChannelQuality {
                channel: name.clone(),
                chi2_per_dof: sum / expected,
                dof: expected,
                measured_over_modelled: overall[c].sqrt(),
                by_decade: by_decade
                    .iter()
                    .map(|(from, to, ratio, sigma)| (*from, *to, ratio[c].sqrt(), ratio[c].sqrt() * sigma))
                    .collect(),
            }
        })
        .collect()
}

/// Frequency, χ²/dof and degrees of freedom of the narrow band that stands out most: a line shows here, because Σ is
/// refined in bands too wide to follow it.
fn worst_band(
    residual: &[DMatrix<f64>],
    inverses: &[DMatrix<f64>],
    plan: &Plan,
    whitening: &Whitening,
) -> ((f64, f64), f64) {
    let mut worst = ((0.0, 0.0), 1.0);
    // A slow band has few observations, whose scatter would hide a line above.
    for b in plan.ordinary_bands() {
        let (expected, dof) = whitening.expected_chi2(b);
        let ratio = residual[b].dot(&inverses[b]) / expected;
        if ratio > worst.0.1 {
            worst = ((plan.frequency_hz(plan.bands[b]), ratio), dof);
        }
    }
    worst
}

#[cfg(test)]
mod tests {
    use super::*;

    /// `Σ_b w_b e_b Re U_b` over what one bin of all segments weighs, for a command that answers a step by
    /// `−(1 − e^{−2πf_c t})` from the next sample on: strictly causal, and −1 far below the corner.
    fn score(plan: &Plan, spectra: &Spectra, weights: &[f64], corner_hz: f64) -> f64 {
        let response = |hz: f64| {
            let turn = nalgebra::Complex::from_polar(1.0, -std::f64::consts::TAU * hz / plan.rate_hz);
            let part = 1.0 - (-std::f64::consts::TAU * corner_hz / plan.rate_hz).exp();
            -(turn * part / (1.0 - turn * (1.0 - part))).re
        };
        let mean = |band: &Band| {
            (band.first..band.end).map(|k| response(plan.bin_hz(k as f64))).sum::<f64>() / band.bins() as f64
        };
        let bands = plan.bands.iter().zip(weights).zip(&spectra.expected);
        let top = plan.bands.len() - 1;
        let bin = weights[top] * spectra.expected[top] / plan.bands[top].bins() as f64;
        bands.map(|((band, w), e)| w * e * mean(band)).sum::<f64>() / bin
    }

    /// Of a strictly causal filter the real part has no area. All bands alike leave out what lies below the lowest bin,
    /// two and a half bins in which `U = −1`; zero-area weights leave out by what U differs in the octave above,
    /// `(f/f_c)²` of these: 1 % for a corner of ten times its frequency.
    #[test]
    fn what_lies_below_the_lowest_bin_counts_with_the_octave_above() {
        let plan = Plan::new(16_384, 10.0);
        let mut spectra = Spectra::zero(plan.bands.len(), 0);
        (0..20).for_each(|k| spectra.count_segment(&plan, 0, k > 0));
        for corner_hz in [0.03, 0.1] {
            let alike = score(&plan, &spectra, &spectra.equal_time_weights(), corner_hz);
            let balanced = score(&plan, &spectra, &zero_area_weights(&spectra, &plan), corner_hz);
            assert!((alike - 2.5).abs() < 0.1, "{corner_hz} Hz: {alike}");
            assert!(balanced.abs() < 0.1, "{corner_hz} Hz: {balanced}");
        }
        // Of longer segments for what is slow nothing is added.
        let slow = Plan::slow(16 * 16_384, 16_384, 10.0);
        let mut spectra = Spectra::zero(slow.bands.len(), 0);
        spectra.count_segment(&slow, 0, false);
        assert_eq!(zero_area_weights(&spectra, &slow), spectra.equal_time_weights());
    }
}
