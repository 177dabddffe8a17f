//! Passes over the data that sum the likelihood of the innovations, and the decision that follows from them.
//!
//! Each pass filters the channels at one point: values of the model's coefficients, levels of the noise and the effects
//! that are named so far. What the sums say is a step from this point; passes are repeated until the step is a small
//! part of the errors.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::OnceLock;

use dragfree_archive::Written;
use dragfree_engine::chain::Chain;
use dragfree_engine::config::EffectEntry;
use dragfree_engine::examine::{Examination, examine};
use dragfree_engine::run::Progress;
use dragfree_engine::sources::Sources;
use dragfree_identification::diagnosis::{Constancy, LINE, TRANSIENT};
use dragfree_identification::innovations::decision::{Candidate, Evidence, Prior, Quadratic, Selection, disagreement};
use dragfree_identification::innovations::filter::{Moments, Start, Sums};
use dragfree_schema::{AT_NS, Coefficient, FREQUENCY_HZ, NoiseProcess, PREDICTION_NEED, Settings, Shape};
use nalgebra::{DMatrix, DVector};

mod drifts;
mod ends;
mod experiment;
mod numbers;
mod pass;
mod settling;
mod stretches;

pub(crate) use ends::transients_near_ends;
pub(crate) use experiment::{Experiment, InBlock, Settled, information};
pub(crate) use numbers::with_numbers;
use pass::{At, Constant, Filtered};
pub(crate) use settling::{Reached, settle};
pub(crate) use stretches::{Alone, Stretches};
use stretches::{Stretch, stretches};

use crate::WorkflowError;
use crate::replay::{Pass, Replay, noise_levels};

/// Passes that decide, after which the answer is given as it is, with what still moves.
pub(crate) const PASSES: usize = 6;
/// A point is reached when nothing moves by more than this part of its σ.
const REACHED_SIGMAS: f64 = 0.5;
/// Largest last step of the logarithm of a level: σ, which has two digits, is made with the level before it.
const TWO_DIGITS: f64 = 0.01;
/// σ of the logarithm of a level before any data: the data decide.
pub(crate) const LEVEL_PRIOR: f64 = 1.0;
/// Largest change of the logarithm of a level in one pass: beyond it the quadratic form is no likelihood.
const LEVEL_STEP: f64 = 0.7;

/// Length of a block of sums, s: how finely changes through the data are resolved.
const BLOCK_S: f64 = 600.0;

/// Means of series by table and name.
pub(crate) type Means = BTreeMap<(String, String), f64>;

/// Where a pass is made.
#[derive(Clone, Debug, Default)]
pub(crate) struct Point {
    /// Values of coefficients by name; of candidates only those that are named.
    pub(crate) values: BTreeMap<String, f64>,
    /// Amplitudes of components of the noise over the declared ones.
    pub(crate) levels: BTreeMap<String, f64>,
    /// Powers of time of each channel, by product, beside series with their means; none before the first pass.
    powers: BTreeMap<String, f64>,
    /// Means of series by table and name, by product.
    means: Vec<Means>,
    /// States at the start of each stretch, by product.
    starts: Vec<Vec<DVector<f64>>>,
    /// First rows, by product, Unix ns: to these the starts belong. A pass with fewer series has more rows.
    first_ns: Vec<i64>,
}

impl Point {
    /// Declared levels, and coefficients of the model at these values.
    pub(crate) fn at(values: BTreeMap<String, f64>) -> Self {
        Self { values, ..Self::default() }
    }
}

/// What a parameter of the likelihood stands for.
#[derive(Clone, Debug)]
pub(crate) enum Meaning {
    /// A coefficient of the model or of a candidate.
    Coefficient(Box<Coefficient>),
    /// The logarithm of the level of a component of the noise.
    Level,
    /// A power of time in a channel of one product.
    Power,
    /// By how much a number in the form of an effect is larger, as a logarithm or a time in s; its σ before any data.
    Number(f64),
}

/// What a pass is for.
#[derive(Clone, Copy, PartialEq)]
pub(crate) enum How {
    /// It fits constants and the model beside what is named.
    Opening,
    /// It fits all candidates.
    Fit,
    /// It chooses among the candidates.
    Select,
}

impl Meaning {
    /// Values of the shape parameters of a candidate.
    fn form(&self) -> Option<&Shape> {
        match self {
            Self::Coefficient(c) if c.candidate => Some(&c.shape),
            _ => None,
        }
    }
}

/// An effect's instance that may be in the model or not, in one form.
#[derive(Clone, Debug)]
pub(crate) struct Place {
    pub(crate) effect: String,
    pub(crate) instance: String,
    /// Values of the shape parameters.
    pub(crate) shape: Shape,
    /// Its parameters of the likelihood.
    pub(crate) parameters: Vec<usize>,
}

impl Place {
    /// `EFFECT:INSTANCE`.
    pub(crate) fn name(&self) -> String {
        format!("{}:{}", self.effect, self.instance)
    }

    /// Family of trials of its form.
    pub(crate) fn family(&self) -> &str {
        family(&self.effect, &self.shape)
    }
}

/// The result: a selection with what its parameters stand for.
pub(crate) struct Decided {
    pub(crate) selection: Selection,
    /// Name and meaning of each parameter.
    pub(crate) parameters: Vec<(String, Meaning)>,
    /// Candidates.
    pub(crate) candidates: Vec<Place>,
    /// What is known of sums of coefficients before any data.
    surveys: Vec<(Vec<(String, f64)>, Prior)>,
    /// What is known of all sums of parameters before any data.
    pub(crate) priors: Vec<(Vec<(usize, f64)>, Prior)>,
    /// Sums of each product.
    parts: Vec<Part>,
    /// The likelihood, for what the model would be without one of the chosen.
    pub(crate) quadratic: Quadratic,
    /// That of each product by itself; none where there is only one.
    pub(crate) by_product: Vec<Quadratic>,
    /// The same without knowledge that is common to all products, once it was asked for.
    data_of_products: OnceLock<Vec<Quadratic>>,
    pub(crate) chi2: f64,
    /// Minus twice the logarithm of the likelihood where the pass was made, with what is known before any data, up to a
    /// constant of the data.
    height: f64,
    pub(crate) numbers: f64,
    pub(crate) channels: BTreeMap<String, BTreeSet<String>>,
    /// Values of the parameters at which the pass was made.
    start: Vec<f64>,
    constants: Vec<Constant>,
    means: Vec<Means>,
    /// Starts of the stretches, by product.
    starts: Vec<Vec<Start>>,
    /// First rows, by product, Unix ns.
    first_ns: Vec<i64>,
    /// Candidates that could not be tried, and why.
    pub(crate) not_tried: Vec<(String, String)>,
}

impl Decided {
    /// The likelihood of the coefficients of one product, with the noise levels and the powers of time fitted: what
    /// adds to that of other products. `None` of several products.
    pub(crate) fn of_coefficients(&self) -> Option<CoefficientSums> {
        let [part] = &self.parts[..] else { return None };
        let kept = self.coefficients(|_| true);
        let (information, score) = self.reduced(part, &kept);
        let coefficient = |i: &usize| match &self.parameters[*i].1 {
            Meaning::Coefficient(c) => Some((**c).clone()),
            _ => None,
        };
        Some(CoefficientSums {
            coefficients: kept.iter().filter_map(coefficient).collect(),
            information,
            score,
            chi2: part.sums.chi2,
            numbers: part.sums.numbers,
            surveys: self.surveys.clone(),
            channels: self.channels.clone(),
        })
    }

    /// Whether several products agree in the coefficients of the model and of what is named; `None` of one product.
    pub(crate) fn agreement(&self) -> Option<Constancy> {
        let named: BTreeSet<usize> = self.selection.chosen.iter().map(|f| f.candidate).collect();
        let chosen = |i: usize| named.iter().any(|c| self.candidates[*c].parameters.contains(&i));
        let in_model = |i: usize| matches!(&self.parameters[i].1, Meaning::Coefficient(c) if !c.candidate);
        let kept = self.coefficients(|i| chosen(i) || in_model(i));
        let data: Vec<_> = self.parts.iter().map(|part| self.reduced(part, &kept)).collect();
        let (chi2, dof) = disagreement(&data, self.numbers);
        (dof > 0).then(|| Constancy::new(chi2, dof))
    }

    /// What the data of each product say by themselves, without surveys and other knowledge of coefficients: that is
    /// common to all products, and values that rest on it would not be independent. None of one product.
    pub(crate) fn data_of_products(&self) -> &[Quadratic] {
        let of = |part: &Part| {
            let mut sums = Sums::zeros(self.parameters.len(), 0);
            part.add_to(&mut sums);
            Quadratic::new(&sums, &self.start, &self.level_priors(), self.quadratic.candidates().to_vec())
        };
        self.data_of_products
            .get_or_init(|| if self.parts.len() > 1 { self.parts.iter().map(of).collect() } else { Vec::new() })
    }

    /// What is known of the noise levels before any data.
    fn level_priors(&self) -> Vec<(Vec<(usize, f64)>, Prior)> {
        let levels = (0..self.parameters.len()).filter(|i| matches!(self.parameters[*i].1, Meaning::Level));
        levels.map(|i| (vec![(i, 1.0)], Prior { mean: 0.0, sigma: LEVEL_PRIOR })).collect()
    }

    /// Parameters that are coefficients, of those that are asked for.
    fn coefficients(&self, asked: impl Fn(usize) -> bool) -> Vec<usize> {
        let coefficient = |i: &usize| matches!(self.parameters[*i].1, Meaning::Coefficient(_));
        (0..self.parameters.len()).filter(coefficient).filter(|i| asked(*i)).collect()
    }

    /// Information of some coefficients in one product, and their score about zero, with the noise levels and the
    /// powers of time fitted; others are zero.
    fn reduced(&self, part: &Part, kept: &[usize]) -> (DMatrix<f64>, DVector<f64>) {
        let mut sums = Sums::zeros(self.parameters.len(), 0);
        part.add_to(&mut sums);
        let about_zero = &sums.information * DVector::from_column_slice(&self.start);
        sums.score.iter_mut().zip(about_zero.iter()).for_each(|(score, moved)| *score += moved);
        for i in self.coefficients(|i| !kept.contains(&i)) {
            sums.information.row_mut(i).fill(0.0);
            sums.information.column_mut(i).fill(0.0);
        }
        let zero = vec![0.0; self.start.len()];
        Quadratic::new(&sums, &zero, &self.level_priors(), kept.iter().copied().map(Candidate::free).collect())
            .of_candidates()
    }
}

/// The likelihood of the coefficients of one product about zero, everything else fitted.
pub(crate) struct CoefficientSums {
    /// Coefficients of the model and of candidates.
    pub(crate) coefficients: Vec<Coefficient>,
    /// Their information.
    pub(crate) information: DMatrix<f64>,
    /// Derivative of the log-likelihood where all are zero, as a quadratic form has it.
    pub(crate) score: DVector<f64>,
    /// Sum of squares of the whitened innovations.
    pub(crate) chi2: f64,
    /// Numbers of them.
    pub(crate) numbers: f64,
    /// What is known of sums of coefficients before any data.
    pub(crate) surveys: Vec<(Vec<(String, f64)>, Prior)>,
    /// Channels on which each coefficient acts.
    pub(crate) channels: BTreeMap<String, BTreeSet<String>>,
}

/// The decision that sums of several products give.
pub(crate) fn joined(
    products: Vec<CoefficientSums>,
    settings: &Settings,
    judge: &dyn Judge,
    not_tried: Vec<(String, String)>,
) -> Decided {
    let mut all = Joined::default();
    for product in products {
        let places = product.coefficients.into_iter().enumerate();
        let mut place = |c: Coefficient| all.place((c.name.clone(), Meaning::Coefficient(Box::new(c))));
        let places = places.map(|(i, c)| (i, place(c))).collect();
        let mut sums = Sums::zeros(0, 0);
        (sums.information, sums.score) = (product.information, product.score.as_slice().to_vec());
        (sums.chi2, sums.numbers) = (product.chi2, product.numbers);
        all.parts.push(Part { sums, moments: None, stretches: Vec::new(), places });
        all.surveys = product.surveys;
        all.channels.extend(product.channels);
    }
    all.decided(&Point::default(), How::Select, settings, judge, not_tried)
}

/// Family of trials of a form of an effect: what acts once was searched for at every time, and what acts at one
/// frequency at every frequency. An impulse at every step of a flag is neither.
pub(crate) fn family<'a>(effect: &'a str, shape: &Shape) -> &'a str {
    if shape.contains_key(AT_NS) {
        TRANSIENT
    } else if shape.contains_key(FREQUENCY_HZ) {
        LINE
    } else {
        effect
    }
}

/// What the decision needs to know of candidates.
pub(crate) trait Judge {
    /// Decimal logarithm of the corrected p-value of a gain `2 Δ ln L` of a form in a family of trials.
    fn log10_p(&self, family: &str, gain: f64, dof: usize) -> f64;
    /// Logarithm of the weight of an effect's instance before any data.
    fn ln_prior(&self, effect: &str, instance: &str, family: &str) -> f64;
}

/// The point that the sums of a pass lead to.
pub(crate) fn step(from: &Point, decided: &Decided) -> Point {
    let chosen: BTreeSet<usize> = decided.selection.chosen.iter().map(|f| f.candidate).collect();
    to_values(from, decided, &decided.selection.values, &chosen)
}

/// The same with the model alone, and nothing named.
pub(crate) fn step_of_model(from: &Point, decided: &Decided) -> Point {
    to_values(from, decided, &decided.quadratic.solution(&[]).0, &BTreeSet::new())
}

fn to_values(from: &Point, decided: &Decided, values: &DVector<f64>, chosen: &BTreeSet<usize>) -> Point {
    // A pass that fits constants and the model has neither levels nor candidates among its parameters.
    let mut to = Point { values: from.values.clone(), levels: from.levels.clone(), ..Point::default() };
    let others = decided.candidates.iter().enumerate().filter(|(c, _)| !chosen.contains(c));
    let not_named: BTreeSet<usize> = others.flat_map(|(_, place)| place.parameters.iter().copied()).collect();
    for i in &not_named {
        to.values.remove(&decided.parameters[*i].0);
    }
    for (i, (name, meaning)) in decided.parameters.iter().enumerate() {
        let value = values[i];
        match meaning {
            Meaning::Coefficient(_) if not_named.contains(&i) => {}
            Meaning::Coefficient(_) => drop(to.values.insert(name.clone(), value)),
            Meaning::Level => {
                let before = from.levels.get(name).copied().unwrap_or(1.0).ln();
                let moved = (value - before).clamp(-LEVEL_STEP, LEVEL_STEP);
                to.levels.insert(name.clone(), (before + moved).exp());
            }
            Meaning::Power => drop(to.powers.insert(name.clone(), value)),
            Meaning::Number(_) => {}
        }
    }
    for constant in &decided.constants {
        let own = constant.at(&to.values);
        to.powers.entry(constant.power.clone()).and_modify(|value| *value -= own);
    }
    // Series that are not in this pass keep the means that they had.
    to.means.clone_from(&from.means);
    to.means.resize_with(decided.means.len(), Means::new);
    to.means.iter_mut().zip(&decided.means).for_each(|(all, own)| all.extend(own.clone()));
    let moved = values - DVector::from_column_slice(&decided.start);
    let state = |start: &Start| &start.state + &start.slope * &moved;
    to.first_ns.clone_from(&decided.first_ns);
    to.starts = decided.starts.iter().map(|product| product.iter().map(state).collect()).collect();
    to
}

/// What differs between two points: effects that are in one alone, and what the step has left by more than a part of
/// its σ. A step of Newton's method in the logarithm of a level leaves its square.
pub(crate) fn moved(from: &Point, to: &Point, decided: &Decided) -> BTreeSet<String> {
    let level = |point: &Point, name: &String| point.levels.get(name).copied().unwrap_or(1.0).ln();
    let all = decided.parameters.iter().zip(decided.selection.sigma.iter());
    let moving = all.filter(|((name, meaning), sigma)| {
        let left = match meaning {
            Meaning::Coefficient(_) => match (from.values.get(name), to.values.get(name)) {
                (Some(a), Some(b)) => (a - b).abs(),
                (None, None) => return false,
                _ => return true,
            },
            Meaning::Level => match (level(from, name) - level(to, name)).abs() {
                step if step > TWO_DIGITS => return true,
                step => step.powi(2),
            },
            Meaning::Power | Meaning::Number(_) => return false,
        };
        left > REACHED_SIGMAS * **sigma
    });
    moving.map(|((name, _), _)| name.clone()).collect()
}

/// One pass over all products, with effects in these forms and slow forces beside the declared noise.
///
/// # Errors
/// [`WorkflowError::NoLikelihood`] where the declared noise cannot be filtered; otherwise as a replay.
pub(crate) fn one_pass(
    replay: &Replay<'_>,
    chosen: &[EffectEntry],
    slow: &[NoiseProcess],
    how: How,
    point: &Point,
    judge: &dyn Judge,
    progress: &mut dyn FnMut(Pass, usize, Progress),
) -> Result<Decided, WorkflowError> {
    let (joined, not_tried) = sums_of_pass(replay, chosen, slow, how, point, progress)?;
    Ok(joined.decided(point, how, replay.settings()?, judge, not_tried))
}

/// The sums of one pass over all products, and what could not be tried.
fn sums_of_pass(
    replay: &Replay<'_>,
    chosen: &[EffectEntry],
    slow: &[NoiseProcess],
    how: How,
    point: &Point,
    progress: &mut dyn FnMut(Pass, usize, Progress),
) -> Result<(Joined, Vec<(String, String)>), WorkflowError> {
    let settings = replay.settings()?;
    let levels = noise_levels(replay.products);
    let mut joined = Joined::default();
    let mut not_tried = Vec::new();
    for (number, Written { product, path }) in replay.products.iter().enumerate() {
        let sources = Sources::of(path)?;
        let examination = Examination {
            product,
            sources: &sources,
            candidates: Vec::new(),
            chosen: chosen.to_vec(),
            needs: &[PREDICTION_NEED],
            values: &levels,
            altered: None,
            recordings: Some(&replay.recordings),
            threads: replay.threads,
            batch_rows: replay.batch_rows,
        };
        let opening = how == How::Opening;
        let block_s = (!opening).then_some(BLOCK_S);
        let at = At { point, slow, opening, number, block_s, data: true, search: false, waveforms: &[] };
        let link = |chain: &Chain| Filtered::link(chain, at, settings, replay.threads);
        let (filtered, refused) =
            examine(replay.registry, &examination, link, &mut |p| progress(Pass::Likelihood, number, p))?;
        not_tried.extend(refused);
        joined.add(filtered, &mut not_tried, settings);
    }
    Ok((joined, not_tried))
}

/// Sums of several products, by the names of the parameters.
#[derive(Default)]
struct Joined {
    parameters: Vec<(String, Meaning)>,
    surveys: Vec<(Vec<(String, f64)>, Prior)>,
    channels: BTreeMap<String, BTreeSet<String>>,
    parts: Vec<Part>,
    constants: Vec<Constant>,
    means: Vec<Means>,
    first_ns: Vec<i64>,
}

/// Sums of one product.
struct Part {
    sums: Sums,
    /// The same with time as weight; an extract has none.
    moments: Option<Moments>,
    /// Sums of its stretches of time; an extract has them elsewhere.
    stretches: Vec<Stretch>,
    /// Parameters of the product among all.
    places: Vec<(usize, usize)>,
}

impl Part {
    /// Adds the sums to those of `all` parameters.
    fn add_to(&self, all: &mut Sums) {
        for (i, a) in &self.places {
            all.score[*a] += self.sums.score[*i];
            for (j, b) in &self.places {
                all.information[(*a, *b)] += self.sums.information[(*i, *j)];
            }
        }
        all.chi2 += self.sums.chi2;
        all.numbers += self.sums.numbers;
        all.samples += self.sums.samples;
        all.ln_det += self.sums.ln_det;
    }

    /// Starts of its stretches as they follow all `parameters`.
    fn starts(&self, parameters: usize) -> Vec<Start> {
        let of_all = |start: &Start| {
            let mut slope = DMatrix::zeros(start.slope.nrows(), parameters);
            self.places.iter().for_each(|(own, all)| slope.set_column(*all, &start.slope.column(*own)));
            Start { state: start.state.clone(), slope }
        };
        self.sums.starts.iter().map(of_all).collect()
    }
}

impl Joined {
    fn add(&mut self, filtered: Filtered, not_tried: &mut Vec<(String, String)>, settings: &Settings) {
        self.means.push(filtered.means());
        self.first_ns.push(filtered.first_ns.unwrap_or(i64::MIN));
        let Filtered { parameters, surveys, channels, gaps, innovations, constants, .. } = filtered;
        self.constants.extend(constants);
        let gappy = gaps.refused(settings);
        let mut places = Vec::new();
        for (i, parameter) in parameters.into_iter().enumerate() {
            if let Some(reason) = gappy.get(&parameter.0) {
                not_tried.push((parameter.0, reason.clone()));
                continue;
            }
            places.push((i, self.place(parameter)));
        }
        let passed = innovations.finish();
        let (moments, stretches) = (Some(passed.moments()), stretches(&passed));
        self.parts.push(Part { sums: passed.total(), moments, stretches, places });
        self.surveys = surveys;
        self.channels.extend(channels);
    }

    /// Index of a parameter among all. One in another form is another one.
    fn place(&mut self, parameter: (String, Meaning)) -> usize {
        let same = |(name, meaning): &(String, Meaning)| *name == parameter.0 && meaning.form() == parameter.1.form();
        self.parameters.iter().position(same).unwrap_or_else(|| {
            self.parameters.push(parameter);
            self.parameters.len() - 1
        })
    }

    fn decided(
        self,
        point: &Point,
        how: How,
        settings: &Settings,
        judge: &dyn Judge,
        not_tried: Vec<(String, String)>,
    ) -> Decided {
        let parameters = self.parameters;
        let mut groups: Vec<Place> = Vec::new();
        let mut start = Vec::new();
        let mut priors = Vec::new();
        for (i, (name, meaning)) in parameters.iter().enumerate() {
            let is_another_form = parameters[..i].iter().any(|(other, _)| other == name);
            start.push(match meaning {
                Meaning::Coefficient(_) if is_another_form => 0.0,
                Meaning::Coefficient(_) => point.values.get(name).copied().unwrap_or(0.0),
                Meaning::Level => point.levels.get(name).copied().unwrap_or(1.0).ln(),
                Meaning::Power => point.powers.get(name).map_or(0.0, |value| {
                    let means = self.constants.iter().filter(|c| c.power == *name).map(|c| c.at(&point.values));
                    value + means.sum::<f64>()
                }),
                Meaning::Number(_) => 0.0,
            });
            match meaning {
                Meaning::Coefficient(c) if c.candidate => {
                    // The forms of an effect are places apart, also where one of them has no shape.
                    let lacks = |p: &Place| p.parameters.iter().all(|own| parameters[*own].0 != *name);
                    let is_it = |p: &Place| (&p.effect, &p.instance, &p.shape) == (&c.effect, &c.instance, &c.shape);
                    let of = |p: &&mut Place| is_it(p) && lacks(p);
                    match groups.iter_mut().find(of) {
                        Some(place) => place.parameters.push(i),
                        None => groups.push(Place {
                            effect: c.effect.clone(),
                            instance: c.instance.clone(),
                            shape: c.shape.clone(),
                            parameters: vec![i],
                        }),
                    }
                }
                Meaning::Coefficient(c) if c.prior_sigma.is_finite() && c.prior_sigma > 0.0 => {
                    priors.push((vec![(i, 1.0)], Prior { mean: c.initial, sigma: c.prior_sigma }));
                }
                Meaning::Level => priors.push((vec![(i, 1.0)], Prior { mean: 0.0, sigma: LEVEL_PRIOR })),
                Meaning::Number(sigma) if sigma.is_finite() => {
                    priors.push((vec![(i, 1.0)], Prior { mean: 0.0, sigma: *sigma }));
                }
                _ => {}
            }
        }
        let at = |name: &String| parameters.iter().position(|(own, _)| own == name);
        for (terms, prior) in &self.surveys {
            let found: Option<Vec<(usize, f64)>> = terms.iter().map(|(name, w)| Some((at(name)?, *w))).collect();
            priors.extend(found.map(|terms| (terms, *prior)));
        }
        let candidates: Vec<Candidate> = groups
            .iter()
            .map(|place| {
                let Place { effect, instance, parameters: own, .. } = place;
                let coefficients = || {
                    own.iter().filter_map(|i| match &parameters[*i].1 {
                        Meaning::Coefficient(c) => Some(c),
                        _ => None,
                    })
                };
                Candidate {
                    parameters: own.clone(),
                    lower: coefficients().map(|c| c.lower).collect(),
                    upper: coefficients().map(|c| c.upper).collect(),
                    prior_sigma: coefficients().map(|c| c.prior_sigma).collect(),
                    ln_prior: judge.ln_prior(effect, instance, place.family()),
                    shaped: coefficients().any(|c| !c.shape.is_empty()),
                }
            })
            .collect();
        let p = parameters.len();
        let mut sums = Sums::zeros(p, 0);
        self.parts.iter().for_each(|part| part.add_to(&mut sums));
        let known = priors.iter().map(|(terms, prior)| prior.chi2(terms, &start)).sum::<f64>();
        let height = sums.chi2 + sums.ln_det + known;
        let starts = self.parts.iter().map(|part| part.starts(p)).collect();
        let of_product = |part: &Part| {
            let mut own = Sums::zeros(p, 0);
            part.add_to(&mut own);
            Quadratic::new(&own, &start, &priors, candidates.clone())
        };
        let by_product = if self.parts.len() > 1 { self.parts.iter().map(of_product).collect() } else { Vec::new() };
        let quadratic = Quadratic::new(&sums, &start, &priors, candidates);
        let log10_p = |c: usize, gain: f64| judge.log10_p(groups[c].family(), gain, groups[c].parameters.len());
        let selection = match how {
            How::Select => quadratic.select(&Evidence {
                log10_p: &log10_p,
                bound: settings.false_alarm.log10(),
                most: settings.max_added,
                remainder: settings.excess_remainder,
                range: settings.range_sigmas.powi(2),
            }),
            How::Opening | How::Fit => quadratic.with_all(),
        };
        Decided {
            selection,
            parameters,
            candidates: groups,
            surveys: self.surveys,
            priors,
            parts: self.parts,
            quadratic,
            by_product,
            data_of_products: OnceLock::new(),
            chi2: sums.chi2,
            height,
            numbers: sums.numbers,
            channels: self.channels,
            constants: self.constants,
            means: self.means,
            first_ns: self.first_ns,
            start,
            starts,
            not_tried,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// What was searched for at every time or frequency has the trials of that search; the same effect where it lasts,
    /// such as pulses at every step of a flag, has those of its forms.
    #[test]
    fn a_form_has_the_trials_of_the_search_that_found_it() {
        let shape = |key: &str| Shape::from([(key.to_owned(), serde_json::json!(1))]);
        assert_eq!(family("impulse", &shape(AT_NS)), TRANSIENT);
        assert_eq!(family("line", &shape(FREQUENCY_HZ)), LINE);
        assert_eq!(family("impulse", &shape("flag")), "impulse");
    }

    struct Any;

    impl Judge for Any {
        fn log10_p(&self, _: &str, gain: f64, _: usize) -> f64 {
            -gain
        }

        fn ln_prior(&self, _: &str, _: &str, _: &str) -> f64 {
            0.0
        }
    }

    fn coefficient(effect: &str, name: &str) -> Coefficient {
        let (effect, name) = (effect.to_owned(), name.to_owned());
        Coefficient { name, effect, instance: "sc".to_owned(), candidate: true, ..Coefficient::default() }
    }

    fn sums(coefficients: Vec<Coefficient>, information: DMatrix<f64>, score: DVector<f64>) -> CoefficientSums {
        let (surveys, channels) = (Vec::new(), BTreeMap::new());
        CoefficientSums { coefficients, information, score, chi2: 1e4, numbers: 1e4, surveys, channels }
    }

    /// The values that the data of two products have by themselves are independent, though an offset of which a survey
    /// knows as much as a day has a correlation of 0.9 with the effect: over 1000 draws the mean χ² of their
    /// difference is 1 within 4σ (false alarm 6e-5). With the survey in both it is not.
    #[test]
    fn products_are_compared_by_their_data_alone() {
        use rand::SeedableRng;
        use rand_distr::{Distribution, StandardNormal};
        let mut random = rand_xoshiro::Xoshiro256PlusPlus::seed_from_u64(31);
        let mut normal = || -> f64 { StandardNormal.sample(&mut random) };
        let information = DMatrix::from_row_slice(2, 2, &[1.0, 0.9, 0.9, 1.0]);
        let root = information.clone().cholesky().expect("positive").l();
        let [mut alone, mut surveyed] = [0.0; 2];
        for _ in 0..1000 {
            let truth = DVector::from_vec(vec![normal(), 100.0]);
            let product = |noise: [f64; 2]| {
                let offset = Coefficient { prior_sigma: 1.0, candidate: false, ..coefficient("offset", "offset") };
                let score = &information * &truth + &root * DVector::from_row_slice(&noise);
                sums(vec![offset, coefficient("effect", "effect")], information.clone(), score)
            };
            let products = vec![product([normal(), normal()]), product([normal(), normal()])];
            let decided = joined(products, &Settings::default(), &Any, Vec::new());
            let chi2 = |products: &[Quadratic]| {
                let of = |q: &Quadratic| (q.solution(&[0]).0[1], q.solution(&[0]).1[1]);
                let [(a, a_sigma), (b, b_sigma)] = [0, 1].map(|k| of(&products[k]));
                (a - b).powi(2) / (a_sigma.powi(2) + b_sigma.powi(2))
            };
            alone += chi2(decided.data_of_products()) / 1000.0;
            surveyed += chi2(&decided.by_product) / 1000.0;
        }
        let bound = 4.0 * (2.0_f64 / 1000.0).sqrt();
        assert!((alone - 1.0).abs() < bound && (surveyed - 1.0).abs() > bound, "{alone} {surveyed}");
    }

    /// Coefficients of one form are one place, whichever product has them first.
    #[test]
    fn a_place_has_the_coefficients_of_one_form() {
        let of_form = |name: &str, lag: f64| {
            let shape = Shape::from([("lag_s".to_owned(), serde_json::json!(lag))]);
            Coefficient { shape, ..coefficient("effect", name) }
        };
        let product = |all: Vec<Coefficient>| {
            let n = all.len();
            sums(all, DMatrix::identity(n, n), DVector::zeros(n))
        };
        let products = vec![product(vec![of_form("a", 1.0)]), product(vec![of_form("a", 2.0), of_form("b", 2.0)])];
        let decided = joined(products, &Settings::default(), &Any, Vec::new());
        let name = |i: &usize| decided.parameters[*i].0.as_str();
        let places: Vec<Vec<&str>> =
            decided.candidates.iter().map(|p| p.parameters.iter().map(name).collect()).collect();
        assert_eq!(places, [vec!["a"], vec!["a", "b"]]);
    }
}
