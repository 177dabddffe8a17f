//! The model, and the forms of every candidate.

use dragfree_estimation::colour::Colour;
use dragfree_estimation::estimate::{Bound, Unknown};
use dragfree_estimation::spectra::{Layout, Regressor};
use dragfree_schema::{AT_NS, place_and_number};
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

use crate::columns::Columns;
use crate::transient::is_one_transient;

/// A channel's response to a coefficient.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Term {
    /// Index of the channel.
    pub channel: usize,
    /// Index of the column.
    pub column: usize,
    /// Unit of the channel per unit of column and coefficients.
    pub factor: f64,
    /// Index of another coefficient of the model that multiplies it.
    pub times: Option<usize>,
}

/// One form that a coefficient may have.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Form {
    /// Values of the shape parameters.
    pub shape: Map<String, Value>,
    /// Unit of the coefficient.
    pub unit: String,
    /// Lower end of its physical range, none for −∞.
    pub lower: Option<f64>,
    /// Upper end of its physical range, none for ∞.
    pub upper: Option<f64>,
    /// Responses of the channels.
    pub terms: Vec<Term>,
    /// A noise process that it filters.
    #[serde(default)]
    pub colours: Option<Colour>,
}

/// A coefficient of the model or of a candidate.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Coefficient {
    /// Name.
    pub name: String,
    /// Effect.
    pub effect: String,
    /// Instance.
    pub instance: String,
    /// Value before any data, or the fixed value.
    pub initial: f64,
    /// Standard deviation before any data, none for ∞.
    pub prior_sigma: Option<f64>,
    /// Whether the model estimates it.
    pub estimate: bool,
    /// Whether it is a candidate, no part of the model.
    pub candidate: bool,
    /// Whether its forms are waveforms at the times of detected transients.
    #[serde(default)]
    pub transient: bool,
    /// Its forms; one for a coefficient of the model.
    pub forms: Vec<Form>,
    /// A noise process whose level it multiplies.
    pub noise: String,
}

/// A linear constraint of the model.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Rule {
    /// Name.
    pub name: String,
    /// Whether it is a survey.
    pub survey: bool,
    /// Index of a coefficient, weight.
    pub terms: Vec<(usize, f64)>,
    /// Bounds, none for none.
    pub lower: Option<f64>,
    /// Upper bound.
    pub upper: Option<f64>,
}

/// Model and candidates.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct CandidateSet {
    /// Names of the channels.
    pub channels: Vec<String>,
    /// Coefficients, those of the model first.
    pub coefficients: Vec<Coefficient>,
    /// Constraints of the model.
    pub rules: Vec<Rule>,
}

/// Forms of a candidate that are left out.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LeftOut {
    /// Its name, `es-gain:tm1.y`.
    pub name: String,
    /// Whether no form is left.
    pub all: bool,
    /// For each form that is left out a column that it lacks.
    pub columns: Vec<usize>,
}

/// An instance of an effect in one form, which can be added to a model.
#[derive(Clone, Debug, PartialEq)]
pub struct Candidate {
    /// Effect.
    pub effect: String,
    /// Instance.
    pub instance: String,
    /// Whether it is a waveform at the time of a detected transient.
    pub transient: bool,
    /// Indices of its coefficients, with the form of each.
    pub parts: Vec<(usize, Form)>,
}

impl Coefficient {
    /// Whether an instance of an effect is at its place, the instance itself or one with another number.
    pub fn is_at_place_of(&self, effect: &str, instance: &str) -> bool {
        effect == self.effect && place_and_number(instance).0 == place_and_number(&self.instance).0
    }

    /// Times of the others among some candidates that are transients at its place.
    pub fn times_beside(&self, candidates: &[Candidate]) -> Vec<i64> {
        let others = candidates.iter().filter(|c| self.is_at_place_of(&c.effect, &c.instance));
        others.filter(|c| c.instance != self.instance).filter_map(Candidate::at_ns).collect()
    }
}

impl CandidateSet {
    /// Coefficients of the model.
    pub fn model(&self) -> usize {
        self.coefficients.iter().take_while(|c| !c.candidate).count()
    }

    /// Forms that a transient may have beside some candidates: none before those with a smaller number at its place are
    /// among these, and none within `same_s` of one at its place. All forms of what is no transient.
    pub fn possible_forms(&self, place: &[usize], added: &[Candidate], same_s: f64) -> Vec<usize> {
        let first = &self.coefficients[place[0]];
        let all = 0..first.forms.len();
        if !first.transient {
            return all.collect();
        }
        let (_, number) = place_and_number(&first.instance);
        let smaller = self.coefficients.iter().filter(|c| c.transient && first.is_at_place_of(&c.effect, &c.instance));
        let mut smaller = smaller.filter(|c| place_and_number(&c.instance).1 < number);
        let is_added = |c: &Coefficient| added.iter().any(|a| (&a.effect, &a.instance) == (&c.effect, &c.instance));
        if !smaller.all(is_added) {
            return Vec::new();
        }
        let taken = first.times_beside(added);
        let is_free = |own: i64| taken.iter().all(|other| !is_one_transient(own, *other, same_s));
        all.filter(|form| at_ns_of(&first.forms[*form]).is_none_or(is_free)).collect()
    }

    /// Every instance of every effect that is not in the model, as the indices of its coefficients: without noise
    /// levels, and transients apart from lasting causes.
    pub fn places(&self) -> Vec<Vec<usize>> {
        let mut places: Vec<Vec<usize>> = Vec::new();
        for (i, c) in self.coefficients.iter().enumerate().filter(|(_, c)| c.candidate && !c.forms.is_empty()) {
            let same = |p: &&mut Vec<usize>| {
                let other = &self.coefficients[p[0]];
                let key = |c: &Coefficient| (c.transient, c.forms.len());
                (&other.effect, &other.instance, key(other)) == (&c.effect, &c.instance, key(c))
            };
            match places.iter_mut().find(same) {
                Some(place) => place.push(i),
                None => places.push(vec![i]),
            }
        }
        places
    }

    /// The same candidates in the forms that another set has too; none where the two differ in anything else.
    pub fn common(&self, other: &Self) -> Option<Self> {
        let without_forms = |set: &Self| {
            let mut set = set.clone();
            set.coefficients.iter_mut().filter(|c| c.candidate).for_each(|c| c.forms.clear());
            set
        };
        if without_forms(self) != without_forms(other) {
            return None;
        }
        let mut common = self.clone();
        if self == other {
            return Some(common);
        }
        for (own, theirs) in common.coefficients.iter_mut().zip(&other.coefficients) {
            // Both have the order of the whole list.
            let mut left = theirs.forms.iter();
            own.forms.retain(|form| {
                let mut ahead = left.clone();
                let is_there = ahead.any(|other| other == form);
                if is_there {
                    left = ahead;
                }
                is_there
            });
        }
        Some(common)
    }

    /// Leaves out the forms of candidates that need a column which `lacks` a value: of all coefficients of a place, as
    /// a form is one of all of them. Tells each place, and the columns.
    pub fn leave_out(&mut self, lacks: impl Fn(usize) -> bool) -> Vec<LeftOut> {
        let mut all = Vec::new();
        for place in self.places() {
            let forms = self.coefficients[place[0]].forms.len();
            let culprit = |form: usize| {
                let mut terms = place.iter().flat_map(|i| &self.coefficients[*i].forms[form].terms);
                terms.find(|t| lacks(t.column)).map(|t| t.column)
            };
            let culprits: Vec<Option<usize>> = (0..forms).map(culprit).collect();
            for i in &place {
                let mut keeps = culprits.iter().map(Option::is_none);
                self.coefficients[*i].forms.retain(|_| keeps.next().unwrap_or(true));
            }
            let columns: Vec<usize> = culprits.into_iter().flatten().collect();
            if !columns.is_empty() {
                let first = &self.coefficients[place[0]];
                let name = format!("{}:{}", first.effect, first.instance);
                all.push(LeftOut { name, all: columns.len() == forms, columns });
            }
        }
        all
    }

    /// The `form`-th form of the coefficients of a place.
    pub fn candidate(&self, place: &[usize], form: usize) -> Candidate {
        let first = &self.coefficients[place[0]];
        Candidate {
            effect: first.effect.clone(),
            instance: first.instance.clone(),
            transient: first.transient,
            parts: place.iter().map(|i| (*i, self.coefficients[*i].forms[form].clone())).collect(),
        }
    }

    /// Unknowns of the model and of what was added to it.
    pub fn unknowns(&self, added: &[Candidate]) -> Vec<Unknown> {
        let unknown = |c: &Coefficient, form: &Form, estimate: bool| Unknown {
            name: c.name.clone(),
            unit: form.unit.clone(),
            lower: form.lower.unwrap_or(f64::NEG_INFINITY),
            upper: form.upper.unwrap_or(f64::INFINITY),
            initial: if estimate && c.candidate { 0.0 } else { c.initial },
            prior_sigma: c.prior_sigma.unwrap_or(f64::INFINITY),
            estimate,
            colours: form.colours.clone(),
        };
        let model = self.coefficients[..self.model()].iter().map(|c| unknown(c, &c.forms[0], c.estimate));
        let added = added.iter().flat_map(|a| &a.parts).map(|(i, form)| unknown(&self.coefficients[*i], form, true));
        model.chain(added).collect()
    }

    /// Constraints as the estimator takes them.
    pub fn bounds(&self) -> Vec<Bound> {
        let bound = |r: &Rule| Bound {
            name: r.name.clone(),
            survey: r.survey,
            terms: r.terms.clone(),
            lower: r.lower.unwrap_or(f64::NEG_INFINITY),
            upper: r.upper.unwrap_or(f64::INFINITY),
        };
        self.rules.iter().map(bound).collect()
    }

    /// The layout of the model with what was added, and the columns that it is made of.
    pub fn layout(&self, names: &[String], added: &[Candidate]) -> (Layout, Vec<usize>) {
        let model = self.model();
        let mut columns: Vec<usize> = (0..self.channels.len()).collect();
        let mut regressors = Vec::new();
        let own = self.coefficients[..model].iter().enumerate().map(|(i, c)| (i, &c.forms[0]));
        let more = added.iter().flat_map(|a| &a.parts).enumerate().map(|(k, (_, form))| (model + k, form));
        for (coefficient, form) in own.chain(more) {
            for t in &form.terms {
                let at = columns.iter().position(|c| *c == t.column).unwrap_or_else(|| {
                    columns.push(t.column);
                    columns.len() - 1
                });
                let series = at - self.channels.len();
                regressors.push(Regressor {
                    coefficient,
                    channel: t.channel,
                    series,
                    factor: t.factor,
                    times: t.times,
                    in_loop: false,
                });
            }
        }
        let layout = Layout {
            channels: self.channels.clone(),
            series: columns[self.channels.len()..].iter().map(|c| names[*c].clone()).collect(),
            regressors,
            coefficients: self.unknowns(added).into_iter().map(|u| u.name).collect(),
        };
        (layout, columns)
    }
}

/// When a form of a transient begins, Unix ns.
fn at_ns_of(form: &Form) -> Option<i64> {
    form.shape.get(AT_NS)?.as_i64()
}

impl Candidate {
    /// When it begins, Unix ns, where it is a transient.
    pub fn at_ns(&self) -> Option<i64> {
        at_ns_of(&self.parts.first()?.1)
    }

    /// Its name, `es-gain:tm1.y`.
    pub fn name(&self) -> String {
        format!("{}:{}", self.effect, self.instance)
    }

    /// Whether it acts by slow series alone.
    pub fn is_slow(&self, columns: &Columns) -> bool {
        let mut terms = self.parts.iter().flat_map(|(_, form)| &form.terms).peekable();
        terms.peek().is_some() && terms.all(|t| t.column >= columns.fast)
    }

    /// The same in another set, whose coefficients and columns stand in other places; none where it lacks one of them.
    pub fn moved(&self, from: (&CandidateSet, &Columns), to: (&CandidateSet, &Columns)) -> Option<Self> {
        let coefficient = |i: usize| {
            let own = &from.0.coefficients[i];
            to.0.coefficients.iter().position(|c| (&c.name, c.transient) == (&own.name, own.transient))
        };
        let mut moved = self.clone();
        for (index, form) in &mut moved.parts {
            *index = coefficient(*index)?;
            for t in &mut form.terms {
                t.column = to.1.place(&from.1.tables[t.column], &from.1.names[t.column])?;
            }
        }
        Some(moved)
    }

    /// Between this form and another of the same place: `part` of the way, shapes in their logarithm.
    pub fn towards(&self, other: &Self, part: f64) -> Self {
        let mut mixed = self.clone();
        for ((_, form), (_, to)) in mixed.parts.iter_mut().zip(&other.parts) {
            form.terms.iter_mut().for_each(|t| t.factor *= 1.0 - part);
            form.terms.extend(to.terms.iter().map(|t| Term { factor: t.factor * part, ..t.clone() }));
            for (key, value) in &mut form.shape {
                let (Some(a), Some(b)) = (value.as_f64(), to.shape.get(key).and_then(Value::as_f64)) else { continue };
                if a != b && a > 0.0 && b > 0.0 {
                    *value = Value::from(a * (b / a).powf(part));
                }
            }
        }
        mixed
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn set(names: &[&str]) -> CandidateSet {
        let coefficient = |name: &&str| Coefficient {
            name: (*name).to_owned(),
            effect: (*name).to_owned(),
            instance: "tm1".to_owned(),
            initial: 0.0,
            prior_sigma: None,
            estimate: true,
            candidate: true,
            transient: false,
            forms: Vec::new(),
            noise: String::new(),
        };
        CandidateSet { channels: Vec::new(), coefficients: names.iter().map(coefficient).collect(), rules: Vec::new() }
    }

    fn columns(all: &[(&str, &str)]) -> Columns {
        Columns {
            names: all.iter().map(|(_, name)| (*name).to_owned()).collect(),
            tables: all.iter().map(|(table, _)| (*table).to_owned()).collect(),
            channels: 1,
            base: 1,
            fast: all.len(),
            energy: Vec::new(),
            housekeeping_units: Vec::new(),
        }
    }

    /// A coefficient with a form for each shape, made of a column of its own.
    fn with_forms(name: &str, transient: bool, forms: &[(i64, usize)]) -> Coefficient {
        let form = |(at_ns, column): &(i64, usize)| Form {
            shape: [(AT_NS.to_owned(), Value::from(*at_ns))].into_iter().collect(),
            unit: "1".to_owned(),
            lower: None,
            upper: None,
            terms: vec![Term { channel: 0, column: *column, factor: 1.0, times: None }],
            colours: None,
        };
        let (effect, instance) = name.split_once(':').expect("an effect and its place");
        let forms = forms.iter().map(form).collect();
        let own = set(&["x"]).coefficients.remove(0);
        Coefficient {
            name: name.replace(':', "."),
            effect: effect.to_owned(),
            instance: instance.to_owned(),
            transient,
            forms,
            ..own
        }
    }

    /// Two coefficients of one place lose a form together where one of them lacks a column; two days keep what both
    /// have, and differ where more than forms does.
    #[test]
    fn forms_that_lack_a_column_are_left_out_of_both_coefficients_and_both_days() {
        let forms = [(1, 1), (2, 2), (3, 3)];
        let two = [with_forms("b:tm1", false, &forms), with_forms("b:tm1", false, &[(1, 4), (2, 5), (3, 6)])];
        let whole = CandidateSet { coefficients: two.to_vec(), ..set(&[]) };
        let mut first = whole.clone();
        let left_out = first.leave_out(|column| column == 5);
        assert_eq!(left_out, [LeftOut { name: "b:tm1".to_owned(), all: false, columns: vec![5] }]);
        assert_eq!(first.coefficients.iter().map(|c| c.forms.len()).collect::<Vec<_>>(), [2, 2]);
        let mut second = whole.clone();
        second.leave_out(|column| column == 1);
        let common = first.common(&second).expect("they differ in forms alone");
        let columns = |c: &Coefficient| c.forms.iter().map(|form| form.terms[0].column).collect::<Vec<_>>();
        assert_eq!(common.coefficients.iter().map(columns).collect::<Vec<_>>(), [vec![3], vec![6]]);
        second.coefficients[0].initial = 1.0;
        assert_eq!(first.common(&second), None);
    }

    /// A second transient at a place is tried once the first is there, and at none of its times; nor is the first tried
    /// at those of the second.
    #[test]
    fn a_second_transient_at_a_place_has_other_times_than_the_first() {
        let times = [(0, 1), (10, 2), (100, 3)].map(|(s, column)| (1_000_000_000 * s, column));
        let names = ["impulse:tm1.z", "impulse:tm1.z-2", "impulse:tm2.z"];
        let all = CandidateSet { coefficients: names.map(|name| with_forms(name, true, &times)).to_vec(), ..set(&[]) };
        let possible = |place: usize, added: &[Candidate]| all.possible_forms(&[place], added, 20.0);
        assert_eq!((possible(0, &[]), possible(1, &[])), (vec![0, 1, 2], Vec::new()));
        let first = all.candidate(&[0], 1);
        assert_eq!(possible(1, std::slice::from_ref(&first)), [2]);
        assert_eq!(possible(2, std::slice::from_ref(&first)), [0, 1, 2]);
        assert_eq!(possible(0, &[first, all.candidate(&[1], 2)]), [0, 1]);
    }

    /// Where another effect's series stand before its own, a candidate reads its own; in a set without them it is none.
    #[test]
    fn a_candidate_keeps_its_series_in_another_set() {
        let from = (set(&["magnetic", "thermal"]), columns(&[("channels", "x"), ("slow", "a"), ("slow.1", "a")]));
        let all = [("channels", "x"), ("formula", "formula"), ("slow", "a"), ("slow.1", "a")];
        let to = (set(&["formula", "magnetic", "thermal"]), columns(&all));
        let term = Term { channel: 0, column: 2, factor: 2.0, times: None };
        let form = Form {
            shape: Map::new(),
            unit: "1".to_owned(),
            lower: None,
            upper: None,
            terms: vec![term],
            colours: None,
        };
        let (effect, instance) = ("thermal".to_owned(), "tm1".to_owned());
        let candidate = Candidate { effect, instance, transient: false, parts: vec![(1, form)] };
        let moved = candidate.moved((&from.0, &from.1), (&to.0, &to.1)).expect("all series are there");
        assert_eq!((moved.parts[0].0, moved.parts[0].1.terms[0].column), (2, 3));
        assert_eq!(moved.moved((&to.0, &to.1), (&from.0, &from.1)), Some(candidate.clone()));
        assert_eq!(candidate.moved((&from.0, &from.1), (&to.0, &columns(&all[..3]))), None);
    }
}
