//! The sums of some products solved with some effects.

use std::collections::{BTreeMap, BTreeSet};

use dragfree_identification::innovations::decision::Quadratic;
use dragfree_identification::quadratic::inverse;
use nalgebra::{DMatrix, DVector};
use serde_json::Map;

use super::{Basis, Confounder, Day, Effect, Form, Offset, On, Rung, Size, Switch, level_name};
use crate::answer::NoiseLevel;
use crate::likelihood::family;

/// Effects that are not switched on are told as far as this rank: what comes after explains nothing.
const TOLD: usize = 24;

/// Of these the first are told with what their absence does and what they are confounded with.
const EXPLAINED: usize = 12;

/// Below this fall of χ² two effects cannot be told apart: three σ.
const ALIKE_CHI2: f64 = 9.0;

/// The sums of the products of a fit, and what they are tested by.
pub(super) struct Solving<'a> {
    pub(super) basis: &'a Basis,
    pub(super) quadratic: Quadratic,
    pub(super) fitted: Vec<&'a Day>,
    pub(super) held_out: Vec<&'a Day>,
    pub(super) levels: Vec<NoiseLevel>,
}

impl Solving<'_> {
    pub(super) fn rungs(&self, names: &[String], on: &[On]) -> Vec<Rung> {
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
        let values = self.quadratic.values(&set);
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
            sigma_m: covariance[(*i, *i)].max(0.0).sqrt(),
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
    pub(super) fn effects(&self, on: &[On]) -> (Vec<Effect>, usize) {
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
        let now = self.quadratic.values(&set);
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
        let off = self.forms_told(set).into_iter().filter(|c| !set.contains(c));
        let mut all: Vec<(usize, f64)> = off.map(|c| (c, gain(c))).collect();
        all.sort_by(|a, b| b.1.total_cmp(&a.1));
        let unlikely = all.len().saturating_sub(TOLD);
        all.truncate(TOLD);
        (all.into_iter().map(|(c, _)| c).collect(), unlikely)
    }

    /// The candidates, each in one form: one that is on, otherwise the first by name, which is that of a day.
    fn forms_told(&self, set: &[usize]) -> Vec<usize> {
        let switches = &self.basis.switches;
        let mut order: Vec<usize> = (0..switches.len()).collect();
        order.sort_by_key(|c| (!set.contains(c), switches[*c].name.len(), *c));
        let mut told: Vec<usize> = Vec::new();
        for c in order {
            if set.contains(&c) || told.iter().all(|other| !switches[c].is_alike(&switches[*other])) {
                told.push(c);
            }
        }
        told.sort_unstable();
        told
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
        let (p_value, log10_p_value) =
            self.basis.trials.p_value(family(effect, shape), fitted.gain, parameters.len() as f64);
        let names = parameters.iter().map(|i| &self.basis.coefficients[*i].name);
        let channels: BTreeSet<&String> = names.filter_map(|name| self.basis.channels.get(name)).flatten().collect();
        Effect {
            name: name.clone(),
            effect: effect.clone(),
            instance: instance.clone(),
            shape: shape.clone().into_iter().collect(),
            forms: self.forms_of(c),
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

    /// The forms of a candidate's effect; none where there is one alone.
    fn forms_of(&self, c: usize) -> Vec<Form> {
        let switches = &self.basis.switches;
        let alike = switches.iter().filter(|other| switches[c].is_alike(other));
        let form = |s: &Switch| Form { name: s.name.clone(), shape: s.shape.clone().into_iter().collect() };
        let all: Vec<Form> = alike.map(form).collect();
        if all.len() > 1 { all } else { Vec::new() }
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
            forms: Vec::new(),
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
        let toggled = self.quadratic.values(&toggled);
        let (with, without) = if effect.on { (now, &toggled) } else { (&toggled, now) };
        let shift = |i: usize| (self.basis.coefficients[i].name.clone(), without[i] - with[i]);
        // What is not there has nothing that it could be confounded with.
        let is_there = effect.on || effect.p_value < self.basis.settings.false_alarm;
        let others = told.iter().filter(|other| is_there && **other != c && !set.contains(other));
        let values: Vec<f64> = effect.coefficients.iter().map(|size| size.value).collect();
        let alike = others.map(|other| Confounder {
            name: self.basis.switches[*other].name.clone(),
            chi2: self.quadratic.separation_of(c, &values, *other, set),
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

    pub(super) fn level(&self, on: On) -> Option<&NoiseLevel> {
        match on {
            On::Level(k) => self.levels.get(k),
            On::Effect(_) => None,
        }
    }
}

pub(super) fn effects_of(on: &[On]) -> Vec<usize> {
    on.iter().filter_map(|o| o.switch()).collect()
}
