//! The numbers in the forms of what is named, fitted with its size: a lag, a resonance, the course of a glitch.
//!
//! Forms that are tried are points of a grid. The size that one of them has is as wrong as the form, and its σ does not
//! know. Two forms on either side of each number tell how the data change with it, so that it is a parameter like
//! others: the size has the σ that is left with it, and passes go on until the numbers stay.

use std::collections::{BTreeMap, BTreeSet};

use dragfree_engine::config::EffectEntry;
use dragfree_engine::run::Progress;
use dragfree_identification::innovations::filter::{Start, Sums};
use dragfree_schema::{AT_NS, Coefficient, FREQUENCY_HZ};
use nalgebra::{DMatrix, DVector};
use serde_json::{Value, json};

use super::{
    Decided, How, Joined, Meaning, PASSES, Part, Place, Point, REACHED_SIGMAS, Settled, one_pass, step, sums_of_pass,
};
use crate::WorkflowError;
use crate::answer::Evidence;
use crate::replay::{Pass, Replay};

/// Part of a number by which the forms on either side differ from it: little for any number that data tell, and much
/// more than rounding.
const PART: f64 = 1e-3;
/// The same of a time, s.
const PART_S: f64 = 1e-2;
/// σ of the logarithm of a number before any data: the data decide.
const PRIOR: f64 = 1.0;
/// Largest change of the logarithm of a number in one pass: beyond it two forms close to each other say little.
const STEP: f64 = 0.7;

/// A number in the form of a named effect.
struct Number {
    effect: String,
    instance: String,
    key: String,
    /// It in the two forms on either side.
    above: Value,
    below: Value,
    /// Half of what these differ by: of the logarithm, of a time in s.
    half: f64,
    /// σ of this before any data.
    prior_sigma: f64,
}

impl Number {
    /// The numbers of an entry, each with the entries on either side. One that is zero has no other side. What acts at
    /// one frequency has been searched for at every frequency, and what acts in one sample at every sample.
    fn all(entry: &EffectEntry) -> Vec<(Self, [EffectEntry; 2])> {
        let of = |(key, value): (&String, &toml::Value)| {
            let (above, below, half, prior_sigma) = match value {
                toml::Value::Integer(at_ns) if key == AT_NS => {
                    let part_ns = (1e9 * PART_S) as i64;
                    ((at_ns + part_ns).into(), (at_ns - part_ns).into(), PART_S, f64::INFINITY)
                }
                toml::Value::Float(x) if *x > 0.0 && key != FREQUENCY_HZ => {
                    ((x * PART.exp()).into(), (x * (-PART).exp()).into(), PART, PRIOR)
                }
                _ => return None,
            };
            let with = |value: &toml::Value| {
                let mut entry = entry.clone();
                entry.parameters.insert(key.clone(), value.clone());
                entry
            };
            let (above, below): (toml::Value, toml::Value) = (above, below);
            let entries = [with(&above), with(&below)];
            let (effect, instance) = (entry.id.clone(), entry.instance.clone());
            let (above, below) = (json!(above), json!(below));
            Some((Self { effect, instance, key: key.clone(), above, below, half, prior_sigma }, entries))
        };
        let all: Vec<(Self, [EffectEntry; 2])> = entry.parameters.iter().filter_map(of).collect();
        if all.iter().all(|(number, _)| number.key == AT_NS) { Vec::new() } else { all }
    }

    /// Its name as a parameter of the likelihood.
    fn name(&self) -> String {
        name_of_number(&self.key, &self.effect, &self.instance)
    }

    /// Whether a coefficient is another one with this number on one side.
    fn is_beside(&self, own: &Coefficient, other: &Coefficient, side: &Value) -> bool {
        let differs_here_alone = |(key, value): (&String, &Value)| {
            if *key == self.key { value == side } else { own.shape.get(key) == Some(value) }
        };
        other.name == own.name && other.shape.len() == own.shape.len() && other.shape.iter().all(differs_here_alone)
    }

    /// Moves the number of an entry.
    fn move_in(&self, entry: &mut EffectEntry, by: f64) {
        match entry.parameters.get_mut(&self.key) {
            Some(toml::Value::Integer(at_ns)) => *at_ns += (1e9 * by) as i64,
            Some(toml::Value::Float(x)) => *x = six_digits(*x * by.clamp(-STEP, STEP).exp()),
            _ => {}
        }
    }
}

fn name_of_number(key: &str, effect: &str, instance: &str) -> String {
    format!("{key} of {effect}:{instance}")
}

/// A number as six digits have it.
fn six_digits(x: f64) -> f64 {
    format!("{x:.5e}").parse().unwrap_or(x)
}

/// What is named in the forms that its numbers have as the data want them, with these as further parameters. None where
/// no form has a number that settles: an effect with one that does not stays in the form in which it was named.
///
/// # Errors
/// As a pass.
pub(crate) fn with_numbers(
    replay: &Replay<'_>,
    end: &Settled,
    evidence: &Evidence<'_>,
    progress: &mut dyn FnMut(Pass, usize, Progress),
) -> Result<Option<Decided>, WorkflowError> {
    let mut held = BTreeSet::new();
    loop {
        match fit_numbers(replay, end, &held, evidence, progress)? {
            Outcome::NoNumbers => return Ok(None),
            Outcome::Settled(decided) => return Ok(Some(*decided)),
            Outcome::Moving(effects) => held.extend(effects),
        }
    }
}

/// What passes that fit numbers end with.
enum Outcome {
    NoNumbers,
    Settled(Box<Decided>),
    /// Effects and instances whose numbers still move.
    Moving(Vec<(String, String)>),
}

/// Passes that fit the numbers of all named effects but those that are `held` in their forms.
fn fit_numbers(
    replay: &Replay<'_>,
    end: &Settled,
    held: &BTreeSet<(String, String)>,
    evidence: &Evidence<'_>,
    progress: &mut dyn FnMut(Pass, usize, Progress),
) -> Result<Outcome, WorkflowError> {
    let named = end.decided.selection.chosen.iter().map(|f| &end.decided.candidates[f.candidate]);
    let named: Vec<&Place> = named.collect();
    let place = |e: &EffectEntry| named.iter().find(|p| (&p.effect, &p.instance) == (&e.id, &e.instance));
    let is_named = |e: &&EffectEntry| place(e).is_some();
    // Of what filters a noise the difference of two forms is no measure: for a slosh of 8σ it gave its damping to 6 to
    // 23 %, where the likelihood of damping from 0.01 to 0.05 differs by a χ² of 7.
    let colours = |e: &EffectEntry| place(e).is_some_and(|p| end.decided.colours(p));
    let is_held = |e: &EffectEntry| held.contains(&(e.id.clone(), e.instance.clone()));
    let is_fitted = |e: &&EffectEntry| evidence.proposal(&e.id, &e.instance).is_none() && !colours(e) && !is_held(e);
    let mut entries: Vec<EffectEntry> = end.chosen.iter().filter(is_named).cloned().collect();
    let mut point = end.point.clone();
    let mut moving = Vec::new();
    for pass in 0..PASSES {
        let (numbers, beside): (Vec<Number>, Vec<_>) = entries.iter().filter(is_fitted).flat_map(Number::all).unzip();
        if numbers.is_empty() {
            return Ok(Outcome::NoNumbers);
        }
        let all: Vec<EffectEntry> = entries.iter().cloned().chain(beside.into_iter().flatten()).collect();
        // Series that are new have no means yet.
        if pass == 0 {
            let opening = one_pass(replay, &all, &end.slow, How::Opening, &point, evidence, progress)?;
            point = step(&point, &opening);
        }
        let (joined, not_tried) = sums_of_pass(replay, &all, &end.slow, How::Fit, &point, progress)?;
        let joined = joined.with_numbers(&numbers, &point);
        let decided = joined.decided(&point, How::Fit, replay.settings()?, evidence, not_tried);
        let at = |n: &Number| decided.parameters.iter().position(|(name, _)| *name == n.name());
        let moves = numbers.iter().filter_map(|n| Some((n, at(n)?)));
        let moves = moves.map(|(n, i)| (n, decided.selection.values[i], decided.selection.sigma[i]));
        let moves: Vec<(&Number, f64, f64)> = moves.collect();
        // A time that has left the data has no information.
        let settled = |by: f64, sigma: f64| sigma > 0.0 && by.abs() <= REACHED_SIGMAS * sigma;
        let left = moves.iter().filter(|(_, by, sigma)| !settled(*by, *sigma));
        moving = left.map(|(n, ..)| (n.effect.clone(), n.instance.clone())).collect();
        if moving.is_empty() {
            return Ok(Outcome::Settled(Box::new(decided)));
        }
        for (number, by, _) in moves {
            let own = |e: &&mut EffectEntry| (&e.id, &e.instance) == (&number.effect, &number.instance);
            entries.iter_mut().filter(own).for_each(|entry| number.move_in(entry, by));
        }
        point = step(&point, &decided);
    }
    Ok(Outcome::Moving(moving))
}

impl Decided {
    /// Whether an effect filters a noise.
    fn colours(&self, place: &Place) -> bool {
        let colours = |i: &usize| matches!(&self.parameters[*i].1, Meaning::Coefficient(c) if c.colours.is_some());
        place.parameters.iter().any(colours)
    }

    /// σ of the numbers in the form of an effect that were fitted, in their units.
    pub(crate) fn shape_sigma(&self, place: &Place) -> BTreeMap<String, f64> {
        let sigma = |(key, value): (&String, &Value)| {
            let name = name_of_number(key, &place.effect, &place.instance);
            let i = self.parameters.iter().position(|(own, _)| *own == name)?;
            let sigma = self.selection.sigma[i];
            Some((key.clone(), if key == AT_NS { 1e9 * sigma } else { value.as_f64()? * sigma }))
        };
        place.shape.iter().filter_map(sigma).collect()
    }
}

impl Joined {
    /// Puts the change with each number in the place of the forms on either side of it: per unit of the number, what
    /// the values at a point make of their difference.
    fn with_numbers(self, numbers: &[Number], point: &Point) -> Self {
        let coefficient = |i: &usize| match &self.parameters[*i].1 {
            Meaning::Coefficient(c) if c.candidate => Some(&**c),
            _ => None,
        };
        let is_first = |i: &usize| self.parameters[..*i].iter().all(|(name, _)| *name != self.parameters[*i].0);
        let kept: Vec<usize> = (0..self.parameters.len()).filter(is_first).collect();
        let mut parameters: Vec<(String, Meaning)> = kept.iter().map(|i| self.parameters[*i].clone()).collect();
        // Old parameters by new ones.
        let mut columns: Vec<Vec<(usize, f64)>> = kept.iter().map(|i| vec![(*i, 1.0)]).collect();
        for number in numbers {
            let own = kept.iter().filter_map(coefficient);
            let own = own.filter(|c| (&c.effect, &c.instance) == (&number.effect, &number.instance));
            let difference = own.map(|c| {
                let side = |value: &Value| {
                    let mut all = 0..self.parameters.len();
                    all.find(|j| coefficient(j).is_some_and(|other| number.is_beside(c, other, value)))
                };
                let per_unit = point.values.get(&c.name)? / (2.0 * number.half);
                Some([(side(&number.above)?, per_unit), (side(&number.below)?, -per_unit)])
            });
            let Some(difference) = difference.collect::<Option<Vec<_>>>() else { continue };
            parameters.push((number.name(), Meaning::Number(number.prior_sigma)));
            columns.push(difference.concat());
        }
        let mut to_old = DMatrix::zeros(self.parameters.len(), columns.len());
        for (new, column) in columns.iter().enumerate() {
            column.iter().for_each(|(old, factor)| to_old[(*old, new)] += factor);
        }
        let of_part = |part: &Part| {
            let mut sums = Sums::zeros(self.parameters.len(), 0);
            part.add_to(&mut sums);
            sums.information = to_old.tr_mul(&(&sums.information * &to_old));
            sums.score = to_old.tr_mul(&DVector::from_column_slice(&sums.score)).as_slice().to_vec();
            let start = |s: Start| Start { slope: s.slope * &to_old, ..s };
            sums.starts = part.starts(self.parameters.len()).into_iter().map(start).collect();
            let places = (0..parameters.len()).map(|i| (i, i)).collect();
            Part { sums, moments: None, stretches: Vec::new(), places }
        };
        let parts = self.parts.iter().map(of_part).collect();
        Self { parts, parameters, ..self }
    }
}
