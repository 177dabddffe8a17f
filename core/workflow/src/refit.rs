//! The model with effects switched on or off, solved again from what diagnoses have kept of products, without
//! telemetry.
//!
//! An extract holds the log-likelihood of the coefficients of the model and of all candidates as a quadratic form about
//! zero ([`crate::extract`]). Forms of days add, so that any set of effects is a small linear system, and days that are
//! kept out of the sum test it.

use std::collections::{BTreeMap, BTreeSet};

use dragfree_archive::Written;
use dragfree_engine::registry::Registry;
use dragfree_identification::diagnosis::Trials;
use dragfree_identification::innovations::decision::{Candidate, Prior, Quadratic, inverse};
use dragfree_identification::innovations::filter::Sums;
use dragfree_schema::{Coefficient, Settings, Shape};
use nalgebra::{DMatrix, DVector};
use serde::Serialize;
use serde_json::{Map, Value};

use crate::WorkflowError;
use crate::answer::{Evidence, NoiseLevel};
use crate::extract::{Extract, levels_of_all, of_products, shared, trials};
use crate::likelihood::{CoefficientSums, Decided, Meaning, joined};

/// Effects that are not switched on are told as far as this rank: what comes after explains nothing.
const TOLD: usize = 16;

/// Of these the first are told with what their absence does and what they are confounded with.
const EXPLAINED: usize = 8;

/// Below this fall of χ² two effects cannot be told apart: three σ.
const ALIKE_CHI2: f64 = 9.0;

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
    /// Family of trials of each effect.
    families: BTreeMap<String, String>,
    named: Vec<String>,
    not_tried: BTreeMap<String, String>,
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
}

/// What can be switched: an effect's instance in one form.
struct Switch {
    name: String,
    effect: String,
    instance: String,
    shape: Shape,
}

/// What is asked of a basis.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Asked {
    /// Effects in the order in which they were switched on, by [`Effect::name`].
    pub on: Vec<String>,
    /// Products that are kept out of the fit.
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
    /// Nothing is left to fit.
    #[error("all products are kept out of the fit: leave one in")]
    NothingToFit,
}

/// The model with some effects switched on.
#[derive(Clone, Debug, Serialize)]
pub struct Refit {
    /// Products of the fit.
    pub products: Vec<String>,
    /// Products that are kept out.
    pub held_out: Vec<String>,
    /// Whitened innovations in the fit.
    pub numbers: f64,
    /// The model, then one more effect each.
    pub rungs: Vec<Rung>,
    /// Effects: those that are on in their order, then the others by significance beside them.
    pub effects: Vec<Effect>,
    /// Other effects, too insignificant to be told.
    pub not_told: usize,
}

/// The model with the first effects that are on.
#[derive(Clone, Debug, Serialize)]
pub struct Rung {
    /// The effect that this rung adds; none for the model alone.
    pub added: Option<String>,
    /// χ² of the fit: the squares of the whitened innovations, with every day's levels of noise fitted, and of the
    /// surveys.
    pub chi2: f64,
    /// By how much it is below that of the model alone.
    pub fall: f64,
    /// χ² of the products that are kept out, at the values of the fit; none where all are in the fit.
    pub held_out_chi2: Option<f64>,
    /// By how much that is below that of the model alone.
    pub held_out_fall: Option<f64>,
    /// Coefficients of the model that are lengths.
    pub offsets: Vec<Offset>,
    /// Their covariance, m², rows in the order of `offsets`.
    pub covariance_m2: Vec<Vec<f64>>,
}

/// An offset of the model.
#[derive(Clone, Debug, Serialize)]
pub struct Offset {
    /// `com-offset.NAME.AXIS`
    pub name: String,
    /// Value, m.
    pub value_m: f64,
    /// Standard deviation, m.
    pub sigma_m: f64,
    /// Frame, empty where there is none.
    pub frame: String,
}

/// An effect beside those that are on, or one of them.
#[derive(Clone, Debug, Serialize)]
pub struct Effect {
    /// `EFFECT:INSTANCE`, with a number behind it where the effect is there in several forms.
    pub name: String,
    /// Effect.
    pub effect: String,
    /// Instance.
    pub instance: String,
    /// Values of the shape parameters.
    pub shape: Map<String, Value>,
    /// Whether it is on.
    pub on: bool,
    /// Whether the diagnosis of a product names it.
    pub named: bool,
    /// Whether it states a level of noise. The sums have the levels fitted already, so that it moves no offset.
    pub is_noise: bool,
    /// Coefficients inside their ranges.
    pub coefficients: Vec<Size>,
    /// Fall of χ² beside the others that are on.
    pub delta_chi2: f64,
    /// p-value, corrected for everything that the diagnoses tried.
    pub p_value: f64,
    /// Its decimal logarithm.
    pub log10_p_value: f64,
    /// Whether the data want values outside its physical range.
    pub out_of_range: bool,
    /// Channels on which it acts.
    pub channels: Vec<String>,
    /// By how much each offset is wrong without it, m.
    pub offset_shift_m: BTreeMap<String, f64>,
    /// What these data cannot tell from it, of the effects told.
    pub confounders: Vec<Confounder>,
}

/// An effect that explains nearly the same.
#[derive(Clone, Debug, Serialize)]
pub struct Confounder {
    /// Effect.
    pub name: String,
    /// Expected rise of χ² with it in the place of the other.
    pub chi2: f64,
}

/// A coefficient of an effect.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Size {
    /// Name.
    pub name: String,
    /// Value in `unit`.
    pub value: f64,
    /// Standard deviation in `unit`.
    pub sigma: f64,
    /// SI unit.
    pub unit: String,
}

impl Basis {
    /// Reads the extracts of products of one model.
    ///
    /// # Errors
    /// [`WorkflowError`]: an extract is missing, or the products have different models.
    pub fn read(registry: &Registry, products: &[Written]) -> Result<Self, WorkflowError> {
        let settings = products.first().ok_or(WorkflowError::NoProduct)?.product.settings.clone();
        let extracts = of_products(products)?;
        let trials = trials(&extracts);
        let (sums, not_tried) = shared(&extracts);
        let evidence =
            Evidence { trials: trials.clone(), least: settings.false_alarm, registry, products, proposals: Vec::new() };
        // The sums with their ranges and priors; which effects are added is the caller's decision.
        let nothing_added = Settings { max_added: 0, ..settings.clone() };
        let parts: Vec<_> =
            sums.iter().map(|s| (s.coefficients.clone(), s.information.clone(), s.score.clone())).collect();
        let totals: Vec<(f64, f64)> = sums.iter().map(|s: &CoefficientSums| (s.chi2, s.numbers)).collect();
        let decided = joined(sums, &nothing_added, &evidence, Vec::new());
        let coefficients: Vec<Coefficient> = decided.parameters.iter().filter_map(coefficient).collect();
        let switches = switches(&decided);
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
            };
            // An extract is made about the model alone, and gives χ² there.
            day.chi2_at_zero = totals[k].0 - day.rise(&values);
            days.push(day);
        }
        let named = named_by(&extracts, &switches);
        let families = switches.iter().map(|s| (s.effect.clone(), evidence.family(&s.effect).to_owned())).collect();
        Ok(Self {
            days,
            candidates: decided.quadratic.candidates().to_vec(),
            priors: decided.priors.clone(),
            channels: decided.channels.clone(),
            coefficients,
            switches,
            trials,
            families,
            named,
            not_tried,
            settings,
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
        if let Some(other) = asked.held_out.iter().find(|id| self.products().all(|own| own != id.as_str())) {
            return Err(RefitError::NoProduct(other.clone()));
        }
        let (held_out, fitted): (Vec<&Day>, Vec<&Day>) =
            self.days.iter().partition(|day| asked.held_out.contains(&day.product));
        if fitted.is_empty() {
            return Err(RefitError::NothingToFit);
        }
        let levels = levels_of_all(&fitted.iter().map(|day| &day.levels[..]).collect::<Vec<_>>());
        let on = asked.on.iter().map(|name| self.find(name, &levels)).collect::<Result<Vec<_>, _>>()?;
        let solving = Solving { basis: self, quadratic: self.quadratic(&fitted), fitted, held_out, levels };
        let rungs = solving.rungs(&asked.on, &on);
        let (effects, not_told) = solving.effects(&on);
        let ids = |days: &[&Day]| days.iter().map(|day| day.product.clone()).collect();
        Ok(Refit {
            products: ids(&solving.fitted),
            held_out: ids(&solving.held_out),
            numbers: solving.fitted.iter().map(|day| day.numbers).sum(),
            rungs,
            effects,
            not_told,
        })
    }

    fn find(&self, name: &str, levels: &[NoiseLevel]) -> Result<On, RefitError> {
        let effect = self.switches.iter().position(|s| s.name == name).map(On::Effect);
        let level = || levels.iter().position(|l| level_name(l) == name).map(On::Level);
        effect.or_else(level).ok_or_else(|| RefitError::NoEffect(name.to_owned()))
    }

    /// χ² of what is known of the coefficients beside the data.
    fn beside_data(&self, values: &DVector<f64>) -> f64 {
        let pull = |(terms, prior): &(Vec<(usize, f64)>, Prior)| {
            let sum: f64 = terms.iter().map(|(i, weight)| weight * values[*i]).sum();
            ((sum - prior.mean) / prior.sigma).powi(2)
        };
        self.priors.iter().map(pull).sum()
    }

    fn quadratic(&self, days: &[&Day]) -> Quadratic {
        let n = self.coefficients.len();
        let mut sums = Sums {
            information: DMatrix::zeros(n, n),
            score: vec![0.0; n],
            chi2: 0.0,
            numbers: 0.0,
            squares: DMatrix::zeros(0, 0),
            samples: 0,
            starts: Vec::new(),
        };
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

impl Day {
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

struct Solving<'a> {
    basis: &'a Basis,
    quadratic: Quadratic,
    fitted: Vec<&'a Day>,
    held_out: Vec<&'a Day>,
    levels: Vec<NoiseLevel>,
}

impl Solving<'_> {
    fn rungs(&self, names: &[String], on: &[On]) -> Vec<Rung> {
        let mut rungs: Vec<Rung> = Vec::new();
        for count in 0..=on.len() {
            let mut rung = self.rung(&on[..count]);
            rung.added = count.checked_sub(1).map(|last| names[last].clone());
            if let Some(first) = rungs.first() {
                rung.fall = first.chi2 - rung.chi2;
                rung.held_out_fall = first.held_out_chi2.zip(rung.held_out_chi2).map(|(before, now)| before - now);
            }
            rungs.push(rung);
        }
        rungs
    }

    fn rung(&self, on: &[On]) -> Rung {
        let set = effects_of(on);
        let (values, sigma) = self.quadratic.solution(&set);
        let covariance = self.quadratic.covariance(&set);
        let offsets: Vec<usize> = self.offsets().collect();
        let levels: Vec<&NoiseLevel> = on.iter().filter_map(|o| self.level(*o)).collect();
        let chi2 = |days: &[&Day]| {
            let of_levels = |day: &Day| levels.iter().map(|level| day.fall_with(level)).sum::<f64>();
            days.iter().map(|day| day.chi2_at_zero + day.rise(&values) - of_levels(day)).sum::<f64>()
        };
        let held_out_chi2 = (!self.held_out.is_empty()).then(|| chi2(&self.held_out));
        let offset = |i: &usize| Offset {
            name: self.basis.coefficients[*i].name.clone(),
            value_m: values[*i],
            sigma_m: sigma[*i],
            frame: self.basis.coefficients[*i].frame.clone(),
        };
        Rung {
            added: None,
            chi2: chi2(&self.fitted) + self.basis.beside_data(&values),
            fall: 0.0,
            held_out_fall: held_out_chi2.map(|_| 0.0),
            held_out_chi2,
            offsets: offsets.iter().map(offset).collect(),
            covariance_m2: offsets.iter().map(|i| offsets.iter().map(|j| covariance[(*i, *j)]).collect()).collect(),
        }
    }

    /// Effects that are on, then the others by significance; and how many more there are.
    fn effects(&self, on: &[On]) -> (Vec<Effect>, usize) {
        let set = effects_of(on);
        let levels = (0..self.levels.len()).map(On::Level).filter(|level| !on.contains(level));
        let (likely, unlikely) = self.likely(&set);
        let off = likely.into_iter().filter(|c| self.quadratic.observable(*c, &set)).map(On::Effect);
        let mut off: Vec<(On, Effect)> = off.chain(levels).map(|o| (o, self.effect(o, &set))).collect();
        let by_evidence = |a: &Effect, b: &Effect| {
            a.log10_p_value.total_cmp(&b.log10_p_value).then(b.delta_chi2.total_cmp(&a.delta_chi2))
        };
        off.sort_by(|(_, a), (_, b)| by_evidence(a, b));
        let not_told = unlikely + off.len().saturating_sub(TOLD);
        off.truncate(TOLD);
        let mut all: Vec<(On, Effect)> =
            on.iter().map(|o| (*o, Effect { on: true, ..self.effect(*o, &set) })).collect();
        all.extend(off);
        let told: Vec<usize> = all.iter().filter_map(|(o, _)| o.switch()).collect();
        let (now, _) = self.quadratic.solution(&set);
        let explained = on.len() + EXPLAINED;
        let consequences = |(k, (o, effect)): (usize, (On, Effect))| {
            if k < explained { self.with_consequences(o, effect, (&set, &now), &told) } else { effect }
        };
        (all.into_iter().enumerate().map(consequences).collect(), not_told)
    }

    /// The candidates beside a set that explain most for their number of coefficients, ranges aside, and how many there
    /// are besides. The exact numbers of all would take most of the time.
    fn likely(&self, set: &[usize]) -> (Vec<usize>, usize) {
        let (information, score) = self.quadratic.of_candidates();
        let mut first = 0;
        let places: Vec<Vec<usize>> = self
            .basis
            .candidates
            .iter()
            .map(|c| {
                let own = (first..first + c.parameters.len()).collect();
                first += c.parameters.len();
                own
            })
            .collect();
        let at: Vec<usize> = set.iter().flat_map(|c| places[*c].iter().copied()).collect();
        let of = |rows: &[usize], columns: &[usize]| {
            DMatrix::from_fn(rows.len(), columns.len(), |i, j| information[(rows[i], columns[j])])
        };
        let score = |rows: &[usize]| DVector::from_fn(rows.len(), |i, _| score[rows[i]]);
        let inner = inverse(&of(&at, &at));
        let gain = |c: usize| {
            let own = &places[c];
            let along = of(own, &at) * &inner;
            let left = score(own) - &along * score(&at);
            let known = of(own, own) - &along * of(&at, own);
            left.dot(&(inverse(&known) * &left)) - own.len() as f64
        };
        let off = (0..places.len()).filter(|c| !set.contains(c));
        let mut all: Vec<(usize, f64)> = off.map(|c| (c, gain(c))).collect();
        all.sort_by(|a, b| b.1.total_cmp(&a.1));
        let unlikely = all.len().saturating_sub(TOLD);
        all.truncate(TOLD);
        (all.into_iter().map(|(c, _)| c).collect(), unlikely)
    }

    fn effect(&self, which: On, set: &[usize]) -> Effect {
        match which {
            On::Effect(c) => self.of_candidate(c, set),
            On::Level(k) => self.of_level(&self.levels[k]),
        }
    }

    fn of_candidate(&self, c: usize, set: &[usize]) -> Effect {
        let Switch { name, effect, instance, shape } = &self.basis.switches[c];
        let fitted = self.quadratic.beside(c, set);
        let parameters = &self.basis.candidates[c].parameters;
        let size = |(k, i): (usize, &usize)| Size {
            name: self.basis.coefficients[*i].name.clone(),
            value: fitted.values[k],
            sigma: fitted.covariance[(k, k)].max(0.0).sqrt(),
            unit: self.basis.coefficients[*i].unit.clone(),
        };
        let family = self.basis.families.get(effect).map_or(effect.as_str(), String::as_str);
        let (p_value, log10_p_value) = self.basis.trials.p_value(family, fitted.gain, parameters.len() as f64);
        let names = parameters.iter().map(|i| &self.basis.coefficients[*i].name);
        let channels: BTreeSet<&String> = names.filter_map(|name| self.basis.channels.get(name)).flatten().collect();
        Effect {
            name: name.clone(),
            effect: effect.clone(),
            instance: instance.clone(),
            shape: shape.clone().into_iter().collect(),
            on: false,
            named: self.basis.named.contains(name),
            is_noise: false,
            coefficients: parameters.iter().enumerate().map(size).collect(),
            delta_chi2: fitted.gain,
            p_value,
            log10_p_value,
            out_of_range: fitted.beyond > self.basis.settings.range_sigmas.powi(2),
            channels: channels.into_iter().cloned().collect(),
            offset_shift_m: BTreeMap::new(),
            confounders: Vec::new(),
        }
    }

    fn of_level(&self, level: &NoiseLevel) -> Effect {
        let value = level.ln.exp() * level.stated;
        let size = Size { name: level.coefficient.clone(), value, sigma: level.sigma * value, unit: "1".to_owned() };
        let gain = self.fitted.iter().map(|day| day.fall_with(level)).sum::<f64>().max(0.0);
        let (p_value, log10_p_value) = self.basis.trials.p_value(&level.effect, gain, 1.0);
        let name = level_name(level);
        Effect {
            named: self.basis.named.contains(&name),
            name,
            effect: level.effect.clone(),
            instance: level.instance.clone(),
            shape: Map::new(),
            on: false,
            is_noise: true,
            coefficients: vec![size],
            delta_chi2: gain,
            p_value,
            log10_p_value,
            out_of_range: false,
            channels: level.channels.clone(),
            offset_shift_m: BTreeMap::new(),
            confounders: Vec::new(),
        }
    }

    /// With what its absence does to the offsets, and what these data cannot tell from it.
    /// `now` are the set that is on and its solution.
    fn with_consequences(&self, which: On, effect: Effect, now: (&[usize], &DVector<f64>), told: &[usize]) -> Effect {
        let Some(c) = which.switch() else { return effect };
        let (set, now) = now;
        let others: Vec<usize> = set.iter().copied().filter(|other| *other != c).collect();
        let toggled = if effect.on { others } else { [&others[..], &[c]].concat() };
        let (toggled, _) = self.quadratic.solution(&toggled);
        let (with, without) = if effect.on { (now, &toggled) } else { (&toggled, now) };
        let shift = |i: usize| (self.basis.coefficients[i].name.clone(), without[i] - with[i]);
        // What is not there has nothing that it could be confounded with.
        let is_there = effect.on || effect.p_value < self.basis.settings.false_alarm;
        let others = told.iter().filter(|other| is_there && **other != c && !set.contains(other));
        let alike = others.map(|other| Confounder {
            name: self.basis.switches[*other].name.clone(),
            chi2: self.quadratic.separation(c, *other, set),
        });
        let mut confounders: Vec<Confounder> = alike.filter(|other| other.chi2 < ALIKE_CHI2).collect();
        confounders.sort_by(|a, b| a.chi2.total_cmp(&b.chi2));
        Effect { offset_shift_m: self.offsets().map(shift).collect(), confounders, ..effect }
    }

    /// Coefficients of the model that are lengths.
    fn offsets(&self) -> impl Iterator<Item = usize> {
        let all = self.basis.coefficients.iter().enumerate();
        all.filter(|(_, c)| !c.candidate && c.unit == "m").map(|(i, _)| i)
    }

    fn level(&self, on: On) -> Option<&NoiseLevel> {
        match on {
            On::Level(k) => self.levels.get(k),
            On::Effect(_) => None,
        }
    }
}

impl On {
    fn switch(self) -> Option<usize> {
        match self {
            Self::Effect(c) => Some(c),
            Self::Level(_) => None,
        }
    }
}

fn effects_of(on: &[On]) -> Vec<usize> {
    on.iter().filter_map(|o| o.switch()).collect()
}

fn coefficient((_, meaning): &(String, Meaning)) -> Option<Coefficient> {
    match meaning {
        Meaning::Coefficient(c) => Some((**c).clone()),
        Meaning::Level | Meaning::Power => None,
    }
}

/// Names of the candidates; of several forms of one, those after the first with a number.
fn switches(decided: &Decided) -> Vec<Switch> {
    let mut all: Vec<Switch> = Vec::new();
    for place in &decided.candidates {
        let before = all.iter().filter(|s| (&s.effect, &s.instance) == (&place.effect, &place.instance)).count();
        let name = if before == 0 { place.name() } else { format!("{}#{}", place.name(), before + 1) };
        let (effect, instance) = (place.effect.clone(), place.instance.clone());
        all.push(Switch { name, effect, instance, shape: place.shape.clone() });
    }
    all
}

fn position_of(switches: &[Switch], named: &(String, String)) -> Option<usize> {
    switches.iter().position(|s| (&s.effect, &s.instance) == (&named.0, &named.1))
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
        let name = position_of(switches, named).map(|at| switches[at].name.clone()).or_else(level);
        all.extend(name.filter(|name| !all.contains(name)));
    }
    all
}

#[cfg(test)]
mod tests;
