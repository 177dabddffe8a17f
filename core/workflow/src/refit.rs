//! The model with effects switched on or off, solved again from what diagnoses have kept of products, without
//! telemetry.
//!
//! An extract holds the log-likelihood of the coefficients of the model and of all candidates as a quadratic form about
//! zero ([`crate::extract`]). Forms of days add, so that any set of effects is a small linear system, and days that are
//! kept out of the sum test it.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::sync::{Arc, Mutex, PoisonError};

use dragfree_archive::Written;
use dragfree_identification::diagnosis::Trials;
use dragfree_identification::innovations::decision::{Candidate, Prior, Quadratic};
use dragfree_identification::innovations::filter::Sums;
use dragfree_schema::{Coefficient, Settings, Shape};
use nalgebra::{DMatrix, DVector};
use serde_json::json;

use crate::WorkflowError;
use crate::answer::{Evidence, NoiseLevel};
use crate::extract::{ByBand, Extract, Kept, levels_of_all, of_products, shared, trials};
use crate::likelihood::{Alone, CoefficientSums, Decided, Meaning, Stretches, joined};

mod solving;
mod spectra;
mod told;

use solving::Solving;
pub use told::{Confounder, Effect, Form, Offset, Refit, Rung, Size, Spectra, Stretch};

/// What diagnoses have kept of products of one model, ready to be solved with other effects.
pub struct Basis {
    settings: Settings,
    days: Vec<Day>,
    coefficients: Vec<Coefficient>,
    channels: BTreeMap<String, BTreeSet<String>>,
    priors: Vec<(Vec<(usize, f64)>, Prior)>,
    candidates: Vec<Candidate>,
    switches: Vec<Switch>,
    trials: Trials,
    named: Vec<String>,
    unexplained: Vec<String>,
    not_tried: BTreeMap<String, String>,
    /// Housekeeping channels with their units.
    housekeeping: BTreeMap<String, String>,
    /// Days that are divided into a part in the fit and one that is kept out, newest first.
    divided: Mutex<VecDeque<Arc<Divided>>>,
}

/// A product of which some stretches of time are kept out of the fit.
struct Divided {
    product: String,
    kept_out: Vec<usize>,
    fit: Day,
    out: Day,
}

/// One product.
struct Day {
    product: String,
    /// Index of each of its coefficients among all.
    places: Vec<usize>,
    information: DMatrix<f64>,
    score: DVector<f64>,
    /// χ² where all coefficients are zero, as the quadratic form has it.
    chi2_at_zero: f64,
    numbers: f64,
    levels: Vec<NoiseLevel>,
    /// Index of each of its coefficients in its extract.
    kept: Vec<usize>,
    by_band: Option<Arc<ByBand>>,
    /// First and last time of each stretch, Unix ns. Their sums are read when one is kept out of the fit, so that those
    /// of many days are not all in memory.
    stretches: Vec<(i64, i64)>,
    /// Where they are.
    extract: Option<Kept>,
}

/// What can be switched: an effect's instance in one form.
struct Switch {
    name: String,
    effect: String,
    instance: String,
    shape: Shape,
}

/// Between a product and the number of a stretch of its time.
pub const STRETCH: char = '@';

/// Divided days that are kept besides one of each product.
const DIVIDED: usize = 4;

/// What is asked of a basis.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Asked {
    /// Effects in the order in which they were switched on, by [`Effect::name`].
    pub on: Vec<String>,
    /// Products that are kept out of the fit, and stretches of time of products: `PRODUCT@2` is the second one.
    pub held_out: Vec<String>,
}

/// Why a basis cannot be solved.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs, reason = "every field is named in its sentence")]
pub enum RefitError {
    /// No such effect.
    #[error("{0:?} is no effect that these products were diagnosed with; `dragfree diagnose` lists them")]
    NoEffect(String),
    /// No such product.
    #[error("{0:?} is none of these products")]
    NoProduct(String),
    /// No such stretch of time.
    #[error("{0:?} is no stretch of time of these products; `dragfree diagnose PRODUCT --keep-extract` keeps them")]
    NoStretch(String),
    /// All stretches of a product.
    #[error("every stretch of {0} is kept out: keep the whole product out")]
    WholeProduct(String),
    /// What was read before is not there any more.
    #[error("{0}")]
    Unreadable(String),
    /// Nothing is left to fit.
    #[error("all products are kept out of the fit: leave one in")]
    NothingToFit,
}

impl Basis {
    /// Reads the extracts of products of one model.
    ///
    /// # Errors
    /// [`WorkflowError`]: an extract is missing, or the products have different models.
    pub fn read(products: &[Written]) -> Result<Self, WorkflowError> {
        let settings = products.first().ok_or(WorkflowError::NoProduct)?.product.settings.clone();
        let mut stretches = Vec::new();
        let extracts = of_products(products, |extract| stretches.push(times(extract.take_stretches())))?;
        let trials = trials(&extracts);
        let (sums, not_tried) = shared(&extracts, |c| in_all_days(&extracts, c));
        let evidence =
            Evidence { trials: trials.clone(), least: settings.false_alarm, products, proposals: Vec::new() };
        // The sums with their ranges and priors; which effects are added is the caller's decision.
        let nothing_added = Settings { max_added: 0, ..settings.clone() };
        let parts: Vec<_> =
            sums.iter().map(|s| (s.coefficients.clone(), s.information.clone(), s.score.clone())).collect();
        let totals: Vec<(f64, f64)> = sums.iter().map(|s: &CoefficientSums| (s.chi2, s.numbers)).collect();
        let decided = joined(sums, &nothing_added, &evidence, Vec::new());
        let coefficients: Vec<Coefficient> = decided.parameters.iter().filter_map(coefficient).collect();
        let beside = |i: usize| match &decided.parameters[i].1 {
            Meaning::Coefficient(c) => extracts.iter().all(|e| e.has_beside(c) || e.place(c).is_none()),
            Meaning::Level | Meaning::Power | Meaning::Number(_) => false,
        };
        let switches = switches(&decided, beside);
        let mut days = Vec::new();
        for (k, (own, information, score)) in parts.into_iter().enumerate() {
            let same = |c: &Coefficient| {
                coefficients.iter().position(|o| o.name == c.name && (!c.candidate || o.shape == c.shape))
            };
            let places: Vec<usize> = own.iter().filter_map(same).collect();
            let alone = decided.by_product.get(k).unwrap_or(&decided.quadratic);
            let (values, _) = alone.solution(&[]);
            let mut day = Day {
                product: products[k].product.id().to_owned(),
                places,
                information,
                score,
                chi2_at_zero: 0.0,
                numbers: totals[k].1,
                levels: extracts[k].levels().to_vec(),
                kept: own.iter().filter_map(|c| extracts[k].place(c)).collect(),
                by_band: None,
                stretches: std::mem::take(&mut stretches[k]),
                extract: extracts[k].read_from().cloned(),
            };
            // An extract is made about the model alone, and gives χ² there.
            day.chi2_at_zero = totals[k].0 - day.rise(&values);
            days.push(day);
        }
        let named = named_by(&extracts, &switches);
        let unexplained = extracts.iter().filter_map(Extract::unexplained).map(str::to_owned).collect();
        let housekeeping = extracts.iter().flat_map(Extract::housekeeping);
        let housekeeping = housekeeping.map(|(name, unit)| (name.clone(), unit.clone())).collect();
        for (day, mut extract) in days.iter_mut().zip(extracts) {
            day.by_band = extract.take_by_band().map(Arc::new);
        }
        Ok(Self {
            days,
            candidates: decided.quadratic.candidates().to_vec(),
            priors: decided.priors.clone(),
            channels: decided.channels.clone(),
            coefficients,
            switches,
            trials,
            named,
            unexplained,
            not_tried,
            settings,
            housekeeping,
            divided: Mutex::default(),
        })
    }

    /// Products.
    pub fn products(&self) -> impl Iterator<Item = &str> {
        self.days.iter().map(|day| day.product.as_str())
    }

    /// Effects that the products' own diagnoses name, by [`Effect::name`].
    pub fn named(&self) -> &[String] {
        &self.named
    }

    /// Why the products' own diagnoses say that the model does not explain them, beside what they name.
    pub fn unexplained(&self) -> &[String] {
        &self.unexplained
    }

    /// Housekeeping channels of the products, as expressions name them, with their units.
    pub fn housekeeping(&self) -> &BTreeMap<String, String> {
        &self.housekeeping
    }

    /// What could not be tried, and why.
    pub fn not_tried(&self) -> &BTreeMap<String, String> {
        &self.not_tried
    }

    /// False-alarm rate below which an effect is named.
    pub fn false_alarm(&self) -> f64 {
        self.settings.false_alarm
    }

    /// Solves the sums of the products that are not kept out, with these effects.
    ///
    /// # Errors
    /// [`RefitError`]: an effect or a product is not there, or no product is left.
    pub fn refit(&self, asked: &Asked) -> Result<Refit, RefitError> {
        let divided = self.divided(&asked.held_out)?;
        let whole = |day: &&Day| divided.iter().all(|d| d.product != day.product);
        let (mut held_out, mut fitted): (Vec<&Day>, Vec<&Day>) =
            self.days.iter().filter(whole).partition(|day| asked.held_out.contains(&day.product));
        fitted.extend(divided.iter().map(|d| &d.fit));
        held_out.extend(divided.iter().map(|d| &d.out));
        if fitted.is_empty() {
            return Err(RefitError::NothingToFit);
        }
        let levels = levels_of_all(&fitted.iter().map(|day| &day.levels[..]).collect::<Vec<_>>());
        let on = asked.on.iter().map(|name| self.find(name, &levels)).collect::<Result<Vec<_>, _>>()?;
        let solving = Solving { basis: self, quadratic: self.quadratic(&fitted), fitted, held_out, levels };
        let rungs = solving.rungs(&asked.on, &on);
        let spectra = solving.spectra(&on);
        let (effects, not_told) = solving.effects(&on);
        let ids = |days: &[&Day]| days.iter().map(|day| day.product.clone()).collect();
        let of_divided = |held: &&String| {
            divided.iter().any(|d| held.split_once(STRETCH).is_some_and(|(product, _)| product == d.product))
        };
        let stretches = asked.held_out.iter().filter(of_divided);
        let whole: Vec<&Day> = solving.held_out.iter().copied().filter(whole).collect();
        Ok(Refit {
            products: ids(&solving.fitted),
            held_out: [ids(&whole), stretches.cloned().collect()].concat(),
            spectra,
            numbers: solving.fitted.iter().map(|day| day.numbers).sum(),
            rungs,
            effects,
            not_told,
        })
    }

    /// Stretches of time of each product, any of which can be kept out of the fit; none where there are not two.
    pub fn stretches(&self, product: &str) -> Vec<Stretch> {
        let day = self.days.iter().find(|day| day.product == product);
        let all = day.map_or(&[][..], |day| &day.stretches);
        let all = if all.len() > 1 { all } else { &[] };
        let stretch =
            |(k, &(from_ns, until_ns))| Stretch { name: format!("{product}{STRETCH}{}", k + 1), from_ns, until_ns };
        all.iter().enumerate().map(stretch).collect()
    }

    /// The products of which a part is kept out.
    fn divided(&self, held_out: &[String]) -> Result<Vec<Arc<Divided>>, RefitError> {
        let mut parts: BTreeMap<&str, BTreeSet<usize>> = BTreeMap::new();
        for held in held_out {
            let (product, stretch) = held.split_once(STRETCH).map_or((held.as_str(), None), |(p, k)| (p, Some(k)));
            let day = self.days.iter().find(|day| day.product == product);
            let day = day.ok_or_else(|| RefitError::NoProduct(held.clone()))?;
            let Some(stretch) = stretch else { continue };
            let count = day.stretches.len();
            let number = stretch.parse::<usize>().ok().filter(|k| (1..=count).contains(k));
            let number = number.ok_or_else(|| RefitError::NoStretch(held.clone()))?;
            if held_out.iter().all(|other| other != product) {
                parts.entry(product).or_default().insert(number - 1);
            }
        }
        parts.into_iter().map(|(product, kept_out)| self.divide(product, kept_out.into_iter().collect())).collect()
    }

    fn divide(&self, product: &str, kept_out: Vec<usize>) -> Result<Arc<Divided>, RefitError> {
        let same = |d: &&Arc<Divided>| d.product == product && d.kept_out == kept_out;
        let known = self.divided.lock().unwrap_or_else(PoisonError::into_inner).iter().find(same).cloned();
        if let Some(known) = known {
            return Ok(known);
        }
        let no_product = || RefitError::NoProduct(product.to_owned());
        let day = self.days.iter().find(|day| day.product == product).ok_or_else(no_product)?;
        if kept_out.len() == day.stretches.len() {
            return Err(RefitError::WholeProduct(product.to_owned()));
        }
        let extract = day.extract.as_ref().ok_or_else(no_product)?.read();
        let stretches = extract.map_err(|e| RefitError::Unreadable(e.to_string()))?.take_stretches();
        let stretches = stretches.ok_or_else(no_product)?;
        let (fit, out) = stretches.divided(|k| kept_out.contains(&k));
        let (fit, out) = (day.with(&fit), day.with(&out));
        let divided = Arc::new(Divided { product: product.to_owned(), kept_out, fit, out });
        let mut all = self.divided.lock().unwrap_or_else(PoisonError::into_inner);
        all.push_front(Arc::clone(&divided));
        all.truncate(self.days.len() + DIVIDED);
        Ok(divided)
    }

    fn find(&self, name: &str, levels: &[NoiseLevel]) -> Result<On, RefitError> {
        let effect = self.switches.iter().position(|s| s.name == name).map(On::Effect);
        let level = || levels.iter().position(|l| level_name(l) == name).map(On::Level);
        effect.or_else(level).ok_or_else(|| RefitError::NoEffect(name.to_owned()))
    }

    /// χ² of what is known of the coefficients beside the data.
    fn beside_data(&self, values: &DVector<f64>) -> f64 {
        self.priors.iter().map(|(terms, prior)| prior.chi2(terms, values.as_slice())).sum()
    }

    fn quadratic(&self, days: &[&Day]) -> Quadratic {
        let n = self.coefficients.len();
        let mut sums = Sums::zeros(n, 0);
        for day in days {
            for (j, b) in day.places.iter().enumerate() {
                sums.score[*b] += day.score[j];
                for (i, a) in day.places.iter().enumerate() {
                    sums.information[(*a, *b)] += day.information[(i, j)];
                }
            }
            sums.numbers += day.numbers;
        }
        Quadratic::new(&sums, &vec![0.0; n], &self.priors, self.candidates.clone())
    }
}

/// First and last time of each stretch.
fn times(stretches: Option<Stretches>) -> Vec<(i64, i64)> {
    stretches.map_or(Vec::new(), |s| s.all.iter().map(|one| (one.from_ns, one.until_ns)).collect())
}

impl Day {
    /// The same product with another likelihood of its coefficients.
    fn with(&self, alone: &Alone) -> Self {
        let n = self.kept.len();
        let level = |own: &NoiseLevel| {
            let (_, ln, sigma) = alone.levels.iter().find(|(name, ..)| *name == own.coefficient)?;
            Some(NoiseLevel { ln: *ln, sigma: *sigma, ..own.clone() })
        };
        Self {
            product: self.product.clone(),
            places: self.places.clone(),
            information: DMatrix::from_fn(n, n, |i, j| alone.information[(self.kept[i], self.kept[j])]),
            score: DVector::from_fn(n, |i, _| alone.score[self.kept[i]]),
            chi2_at_zero: alone.chi2_at_zero,
            numbers: alone.numbers,
            levels: self.levels.iter().filter_map(level).collect(),
            kept: self.kept.clone(),
            by_band: self.by_band.clone(),
            stretches: Vec::new(),
            extract: None,
        }
    }

    /// χ² at these values of all coefficients, above that at zero.
    fn rise(&self, values: &DVector<f64>) -> f64 {
        // Most values are zero: effects that are off.
        let acting: Vec<usize> = (0..self.places.len()).filter(|i| values[self.places[*i]] != 0.0).collect();
        let mut sum = 0.0;
        for i in &acting {
            let own = values[self.places[*i]];
            let along: f64 = acting.iter().map(|j| self.information[(*i, *j)] * values[self.places[*j]]).sum();
            sum += own * (along - 2.0 * self.score[*i]);
        }
        sum
    }

    /// By how much −2 log of the likelihood falls with a level of noise as some days have it: this day's own estimate
    /// is a Gaussian about its value.
    fn fall_with(&self, level: &NoiseLevel) -> f64 {
        let own = self.levels.iter().find(|l| l.coefficient == level.coefficient && l.sigma > 0.0);
        own.map_or(0.0, |l| (l.ln.powi(2) - (l.ln - level.ln).powi(2)) / l.sigma.powi(2))
    }
}

/// An effect that is on.
#[derive(Clone, Copy, Debug, PartialEq)]
enum On {
    /// Index of the switch, which is that of the candidate.
    Effect(usize),
    /// Index of a level of noise.
    Level(usize),
}

impl On {
    fn switch(self) -> Option<usize> {
        match self {
            Self::Effect(c) => Some(c),
            Self::Level(_) => None,
        }
    }
}

fn coefficient((_, meaning): &(String, Meaning)) -> Option<Coefficient> {
    match meaning {
        Meaning::Coefficient(c) => Some((**c).clone()),
        Meaning::Level | Meaning::Power | Meaning::Number(_) => None,
    }
}

/// Whether every day that names the effect of this coefficient has it in this form: falls of χ² of forms are
/// compared, so that all are of the same days.
fn in_all_days(extracts: &[Extract], c: &Coefficient) -> bool {
    let names =
        |e: &&Extract| e.named().iter().any(|(effect, instance)| (effect, instance) == (&c.effect, &c.instance));
    extracts.iter().filter(names).all(|e| e.place(c).is_some())
}

/// Names of the candidates. Of several forms of one, those after the first have a number; those that are `beside` what
/// a day names come last.
fn switches(decided: &Decided, beside: impl Fn(usize) -> bool) -> Vec<Switch> {
    let mut order: Vec<usize> = (0..decided.candidates.len()).collect();
    order.sort_by_key(|c| decided.candidates[*c].parameters.iter().copied().any(&beside));
    let mut forms: BTreeMap<String, usize> = BTreeMap::new();
    let mut names = vec![String::new(); order.len()];
    for c in order {
        let name = decided.candidates[c].name();
        let number = forms.entry(name.clone()).and_modify(|n| *n += 1).or_insert(1);
        names[c] = if *number == 1 { name } else { format!("{name}#{number}") };
    }
    let all = names.into_iter().zip(&decided.candidates);
    all.map(|(name, place)| Switch {
        name,
        effect: place.effect.clone(),
        instance: place.instance.clone(),
        shape: place.shape.clone(),
    })
    .collect()
}

impl Switch {
    /// Whether another one is the same effect in another form.
    fn is_alike(&self, other: &Self) -> bool {
        let fixed = |shape: &Shape| -> Shape {
            shape
                .iter()
                .map(|(key, value)| (key.clone(), if value.is_number() { json!(0) } else { value.clone() }))
                .collect()
        };
        (&self.effect, &self.instance) == (&other.effect, &other.instance) && fixed(&self.shape) == fixed(&other.shape)
    }
}

fn level_name(level: &NoiseLevel) -> String {
    format!("{}:{}", level.effect, level.instance)
}

/// What the products' own diagnoses name, each once.
fn named_by(extracts: &[Extract], switches: &[Switch]) -> Vec<String> {
    let mut all = Vec::new();
    for named in extracts.iter().flat_map(Extract::named) {
        let is_level = |l: &NoiseLevel| (&l.effect, &l.instance) == (&named.0, &named.1);
        let level = || extracts.iter().flat_map(Extract::levels).find(|l| is_level(l)).map(level_name);
        let plain = format!("{}:{}", named.0, named.1);
        let name = switches.iter().any(|s| s.name == plain).then_some(plain).or_else(level);
        all.extend(name.filter(|name| !all.contains(name)));
    }
    all
}

#[cfg(test)]
mod tests;
