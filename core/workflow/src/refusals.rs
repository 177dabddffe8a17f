//! What is chosen and not named after all, with the reason of each.

use dragfree_identification::candidates::Candidate;
use dragfree_identification::diagnosis::{Found, Unexplained};
use dragfree_identification::distributions::ln_chi2_above;
use dragfree_identification::innovations::decision::Fitted;
use dragfree_identification::scores::CandidateScorer;
use dragfree_schema::Settings;

use crate::WorkflowError;
use crate::answer::{Evidence, a_value, found};
use crate::likelihood::{Decided, Judge, Place};

/// The effects of a decision.
pub(crate) struct Answers {
    /// Named ones.
    pub(crate) named: Vec<Found>,
    /// The rest, with a reason where one that is significant is refused.
    pub(crate) others: Vec<Found>,
}

impl Answers {
    /// What is chosen as named, the rest as not; without the formulas of the rest.
    pub(crate) fn new(settings: &Settings, decided: &Decided, evidence: &Evidence<'_>) -> Self {
        let found = |f, accepted| found(settings, decided, f, evidence, accepted);
        let rest = decided.selection.rest.iter().map(|f| found(f, false));
        Self {
            named: decided.selection.chosen.iter().map(|f| found(f, true)).collect(),
            others: rest.filter(|f| !is_formula(f, evidence)).collect(),
        }
    }

    /// Takes the formulas out of what is named.
    pub(crate) fn take_formulas(&mut self, evidence: &Evidence<'_>) -> Vec<Found> {
        self.named.extract_if(.., |f| is_formula(f, evidence)).collect()
    }

    /// Refuses some of what is named.
    pub(crate) fn refuse(&mut self, which: impl Fn(&Found) -> bool, why: impl Fn(&Found) -> String) {
        let refused = self.named.extract_if(.., |f| which(f));
        self.others.extend(refused.map(|f| Found { accepted: false, refused: Some(why(&f)), ..f }));
    }

    /// The same of the effect at a place.
    fn refuse_place(&mut self, place: &Place, why: impl Fn(&Found) -> String) {
        self.refuse(|f| is_at(f, place), why);
    }

    /// Refuses what is named in the place of an effect that the data want outside of its physical range: that one is
    /// refused, and what is like it takes its place.
    pub(crate) fn refuse_stand_ins(&mut self, settings: &Settings, decided: &Decided, evidence: &Evidence<'_>) {
        let set: Vec<usize> = decided.selection.chosen.iter().map(|f| f.candidate).collect();
        let (range, more) = (settings.range_sigmas.powi(2), -settings.false_alarm.ln());
        for c in &set {
            let Some(outside) = decided.quadratic.stands_in_for(*c, &set, range, more) else { continue };
            let (name, value) = a_value(&outside, decided, evidence);
            self.refuse_place(&decided.candidates[*c], |_| {
                format!("{name} explains more in its place, with {value}, outside its physical range")
            });
        }
    }

    /// Refuses what may as well be a force that no effect knows; returns the formulas that state such forces.
    pub(crate) fn refuse_like_formulas(
        &mut self,
        settings: &Settings,
        decided: &Decided,
        evidence: &Evidence<'_>,
    ) -> Vec<Found> {
        let mut formulas: Vec<Found> = Vec::new();
        for (place, rivals) in not_told_from_formulas(settings, decided, evidence) {
            let words = |f: &Found| evidence.proposal(&f.effect, &f.instance).map(|p| p.words.clone());
            let names: Vec<String> = rivals.iter().filter_map(words).collect();
            self.refuse_place(place, |f| {
                let all: Vec<String> = names.iter().chain(&f.confounders).cloned().collect();
                format!("these data do not tell it from {}", first_few(&all))
            });
            // One formula may take the place of several effects.
            for rival in rivals {
                let is_it = |f: &&mut Found| (&f.effect, &f.instance) == (&rival.effect, &rival.instance);
                match formulas.iter_mut().find(is_it) {
                    Some(other) if other.log10_p_value > rival.log10_p_value => *other = rival,
                    Some(_) => {}
                    None => formulas.push(rival),
                }
            }
        }
        formulas
    }

    /// Refuses what is one of the series that resemble an unknown force together.
    pub(crate) fn refuse_beside_formulas(&mut self, decided: &Decided, evidence: &Evidence<'_>) {
        let why = "formulas are needed beside it, which explain the greater part of what it explains, and more";
        for place in followed_by_formulas(decided, evidence) {
            self.refuse_place(place, |_| why.to_owned());
        }
    }

    /// Refuses slow effects that act where a formula explains more.
    pub(crate) fn refuse_parts_of_formulas(&mut self, formulas: &[Found], is_slow: impl Fn(&Found) -> bool) {
        self.refuse(
            |own| is_slow(own) && is_part_of_one(own, formulas),
            |_| "a force that no effect states acts there and explains more: it may be a part of that".to_owned(),
        );
    }

    /// Refuses what follows the cause of a power that it leaves. `forms` are the forms of what is named, and
    /// `unexplained` what is left beside them.
    ///
    /// # Errors
    /// The forms cannot be fitted.
    pub(crate) fn refuse_followers(
        &mut self,
        scorer: &CandidateScorer<'_>,
        forms: &[Candidate],
        unexplained: Option<&Unexplained>,
    ) -> Result<(), WorkflowError> {
        let Some(u) = unexplained.filter(|u| u.power) else { return Ok(()) };
        let doubtful = follows_an_excess(scorer, forms, u)?;
        let is_one = |f: &Found| doubtful.iter().any(|c| (&c.effect, &c.instance) == (&f.effect, &f.instance));
        self.refuse(is_one, |_| format!("with it {} still show what no effect explains", u.channels.join(", ")));
        Ok(())
    }

    /// The chosen candidates that are named or are among the proposed `formulas`.
    pub(crate) fn kept(&self, decided: &Decided, formulas: &[Found]) -> Vec<usize> {
        let is_kept = |c: &usize| {
            let place = &decided.candidates[*c];
            self.named.iter().chain(formulas).any(|f| is_at(f, place))
        };
        decided.selection.chosen.iter().map(|f| f.candidate).filter(is_kept).collect()
    }

    /// The others by significance.
    pub(crate) fn sort_others(&mut self) {
        self.others.sort_by(|a, b| a.log10_p_value.total_cmp(&b.log10_p_value));
    }

    /// Where nothing is named, the reasons for which what is significant is refused.
    pub(crate) fn why_none_is_named(&self) -> Vec<String> {
        let refused = |f: &Found| {
            let reason = f.refused.as_ref()?;
            Some(format!("{}:{} would lower χ² by {:.0}, and is refused: {reason}", f.effect, f.instance, f.delta_chi2))
        };
        if self.named.is_empty() { self.others.iter().filter_map(refused).collect() } else { Vec::new() }
    }

    /// All as candidates of an answer: named ones first, and so many others.
    pub(crate) fn into_candidates(self, most_others: usize) -> Vec<Found> {
        self.named.into_iter().chain(self.others.into_iter().take(most_others)).collect()
    }
}

/// Whether an effect is the one at a place.
fn is_at(f: &Found, place: &Place) -> bool {
    (&f.effect, &f.instance) == (&place.effect, &place.instance)
}

fn is_formula(f: &Found, evidence: &Evidence<'_>) -> bool {
    evidence.proposal(&f.effect, &f.instance).is_some()
}

/// What is named, and may as well be a force that no effect knows: the probability of that is above the false-alarm
/// rate, or a formula with fewer coefficients explains as much but for what the further ones explain by chance. With
/// the formulas that state such forces, the most probable first.
fn not_told_from_formulas<'a>(
    settings: &Settings,
    decided: &'a Decided,
    evidence: &Evidence<'_>,
) -> Vec<(&'a Place, Vec<Found>)> {
    let place = |c: usize| &decided.candidates[c];
    let is_formula = |c: usize| evidence.proposal(&place(c).effect, &place(c).instance).is_some();
    let set: Vec<usize> = decided.selection.chosen.iter().map(|f| f.candidate).collect();
    let rivals = |f: &'a Fitted| {
        let probable = f.alternatives.iter().filter(|(c, _)| is_formula(*c));
        let doubtful = probable.clone().map(|(_, p)| p).sum::<f64>() > settings.false_alarm;
        let mut formulas: Vec<usize> =
            probable.filter(|(_, p)| doubtful && *p > settings.false_alarm).map(|(c, _)| *c).collect();
        let others: Vec<usize> = set.iter().copied().filter(|c| *c != f.candidate).collect();
        let fitted = |c: usize| decided.quadratic.beside(c, &others);
        let more = place(f.candidate).parameters.len() - 1;
        let is_simpler = |c: &usize| more > 0 && is_formula(*c) && !set.contains(c) && !formulas.contains(c);
        let by_chance = |lost: f64| ln_chi2_above(lost.max(0.0), more as f64) > settings.false_alarm.ln();
        let simpler = (0..decided.candidates.len()).filter(is_simpler).map(|c| (c, fitted(c).gain));
        let as_good = simpler.filter(|(_, gain)| by_chance(f.gain - gain));
        let ln_prior = |p: &Place| evidence.ln_prior(&p.effect, &p.instance, p.family());
        let ln_weight = |(c, gain): (usize, f64)| 0.5 * gain + ln_prior(place(c));
        let mut as_good: Vec<(usize, f64)> = as_good.map(|own| (own.0, ln_weight(own))).collect();
        as_good.sort_by(|a, b| b.1.total_cmp(&a.1));
        let least = as_good.first().map_or(0.0, |best| best.1 + settings.false_alarm.ln());
        formulas.extend(as_good.into_iter().filter(|(_, weight)| *weight > least).map(|(c, _)| c));
        // Each is as good as the other: nothing speaks against it.
        let formula = |c: usize| Found { refused: None, ..found(settings, decided, &fitted(c), evidence, false) };
        let all: Vec<Found> = formulas.into_iter().take(settings.max_evaluated).map(formula).collect();
        (!all.is_empty()).then(|| (place(f.candidate), all))
    };
    decided.selection.chosen.iter().filter(|f| !is_formula(f.candidate)).filter_map(rivals).collect()
}

/// What is chosen together with formulas, of which formulas explain the greater part, and more than it explains without
/// them: of an unknown force it is one of the series that resemble it together, as they are.
fn followed_by_formulas<'a>(decided: &'a Decided, evidence: &Evidence<'_>) -> Vec<&'a Place> {
    let place = |c: usize| &decided.candidates[c];
    let is_formula = |c: &usize| evidence.proposal(&place(*c).effect, &place(*c).instance).is_some();
    let set: Vec<usize> = decided.selection.chosen.iter().map(|f| f.candidate).collect();
    let (formulas, effects): (Vec<usize>, Vec<usize>) = set.iter().copied().partition(is_formula);
    if formulas.is_empty() {
        return Vec::new();
    }
    let follows = |c: &usize| {
        let others: Vec<usize> = effects.iter().copied().filter(|other| other != c).collect();
        let with = |more: &[usize]| decided.quadratic.gain(&[&others[..], more].concat());
        decided.quadratic.explain_most_of(*c, &others, &formulas, None) && with(&formulas) > with(&[*c])
    };
    effects.iter().filter(|c| follows(c)).map(|c| place(*c)).collect()
}

/// Whether an effect acts where a formula explains more.
fn is_part_of_one(own: &Found, formulas: &[Found]) -> bool {
    let shares = |f: &Found| f.channels.iter().any(|channel| own.channels.contains(channel));
    formulas.iter().any(|f| shares(f) && f.delta_chi2 > own.delta_chi2)
}

/// Named effects that act where more power than the noise is left with them, in the bands that say most about them:
/// they follow the cause of that power, and are not it.
fn follows_an_excess(
    scorer: &CandidateScorer<'_>,
    named: &[Candidate],
    u: &Unexplained,
) -> Result<Vec<Candidate>, WorkflowError> {
    let fit = scorer.fit(named)?;
    let Some(excess) = scorer.without_excess(&fit) else { return Ok(Vec::new()) };
    let acts = |c: &&Candidate| {
        let channels = &scorer.candidate_set.channels;
        let mut own = c.parts.iter().flat_map(|(_, form)| &form.terms).map(|t| &channels[t.channel]);
        own.any(|channel| u.channels.contains(channel))
    };
    let mostly = |c: &&Candidate| scorer.part_in(&excess.plain, c, &excess.bands) > 0.5;
    Ok(named.iter().filter(|c| !c.transient).filter(acts).filter(mostly).cloned().collect())
}

/// The first three names of a list, and how many there are besides.
fn first_few(names: &[String]) -> String {
    let few = names.iter().take(3).map(String::as_str).collect::<Vec<_>>().join(", ");
    if names.len() > 3 { format!("{few} and {} more", names.len() - 3) } else { few }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::answer::offsets;
    use crate::answer::tests::one_trial;
    use crate::likelihood::{CoefficientSums, joined};
    use dragfree_identification::diagnosis::Offset;
    use dragfree_schema::Coefficient;
    use nalgebra::{DMatrix, DVector};
    use std::collections::BTreeMap;

    /// Four days of an offset and two effects whose series have correlations of 0.7, 0.5 and 0.5, of which the first
    /// effect acts with `value` and cannot be larger than 0.3; each day knows a value by 0.02.
    struct Days {
        decided: Decided,
        answers: Answers,
        before: Vec<Found>,
        offsets: Vec<Offset>,
    }

    impl Days {
        fn new(value: f64) -> Self {
            let candidate = |effect: &str, upper: f64| Coefficient {
                name: format!("{effect}.sc"),
                effect: effect.to_owned(),
                instance: "sc".to_owned(),
                unit: "rad".to_owned(),
                candidate: true,
                upper,
                ..Coefficient::default()
            };
            let offset = Coefficient { name: "offset".to_owned(), unit: "m".to_owned(), ..Coefficient::default() };
            let correlations = [1.0, 0.5, 0.5, 0.5, 1.0, 0.7, 0.5, 0.7, 1.0];
            let information: DMatrix<f64> = 2500.0 * DMatrix::from_row_slice(3, 3, &correlations);
            let score = &information * DVector::from_column_slice(&[0.0, value, 0.0]);
            let day = || CoefficientSums {
                coefficients: vec![offset.clone(), candidate("large", 0.3), candidate("like-it", f64::INFINITY)],
                information: information.clone(),
                score: score.clone(),
                chi2: 1e4,
                numbers: 1e4,
                surveys: Vec::new(),
                channels: BTreeMap::new(),
            };
            let settings = Settings::default();
            let evidence =
                Evidence { trials: one_trial(), least: settings.false_alarm, products: &[], proposals: Vec::new() };
            let decided = joined((0..4).map(|_| day()).collect(), &settings, &evidence, Vec::new());
            let mut answers = Answers::new(&settings, &decided, &evidence);
            let before = answers.named.clone();
            answers.refuse_stand_ins(&settings, &decided, &evidence);
            let offsets = offsets(&decided, &evidence, &answers.kept(&decided, &[]));
            Self { decided, answers, before, offsets }
        }
    }

    fn effects(all: &[Found]) -> Vec<&str> {
        all.iter().map(|f| f.effect.as_str()).collect()
    }

    /// What days together want outside of a range is refused, and so is what is like it, with the value that the days
    /// want; the reasons say both, where nothing else is named. Inside of the range it is named.
    #[test]
    fn nothing_stands_in_on_several_days_for_what_is_outside_of_its_range() {
        let Days { answers: outside, before, .. } = Days::new(0.5);
        assert_eq!((effects(&before), effects(&outside.named)), (vec!["like-it"], vec![]));
        let reasons = outside.why_none_is_named();
        let says = |words: &str| reasons.iter().any(|reason| reason.contains(words));
        assert!(reasons.len() == 2 && says("like-it:sc would lower χ²"), "{reasons:?}");
        assert!(
            says("large:sc explains more in its place, with 5.00e-1 ± 1.2e-2 rad, outside its physical range"),
            "{reasons:?}"
        );
        assert!(says("large:sc would lower χ²") && says("its best value lies outside its physical range"));
        let Days { answers: inside, before, .. } = Days::new(0.2);
        assert_eq!((effects(&before), effects(&inside.named)), (vec!["large"], vec!["large"]));
        assert!(inside.why_none_is_named().is_empty());
    }

    /// A reason that is given for a refused one is no reason for anything where another is named.
    #[test]
    fn a_refused_one_beside_a_named_one_is_no_reason() {
        let mut all = Days::new(0.2).answers;
        all.named.extend(Days::new(0.2).answers.named.into_iter().map(|f| Found { effect: "other".to_owned(), ..f }));
        all.refuse(|f| f.effect == "large", |f| format!("{} is a test's", f.instance));
        let refused: Vec<_> =
            all.others.iter().filter_map(|f| f.refused.as_deref().map(|why| (f.accepted, why))).collect();
        assert_eq!((effects(&all.named), refused), (vec!["other"], vec![(false, "sc is a test's")]));
        assert!(all.why_none_is_named().is_empty());
        assert_eq!(effects(&all.into_candidates(1)), ["other", "like-it"]);
    }

    /// Offsets are those beside what is named, with its own σ: without what is refused, whose part then counts as that
    /// of an effect that is not detected.
    #[test]
    fn offsets_stand_beside_what_is_named_and_not_beside_what_is_refused() {
        for (value, set) in [(0.5, &[][..]), (0.2, &[0][..])] {
            let Days { decided, offsets, .. } = Days::new(value);
            let (values, sigma) = decided.quadratic.solution(set);
            let [offset] = &offsets[..] else { panic!("one offset") };
            assert_eq!((offset.value_m, offset.sigma_m), (values[0], sigma[0]));
            assert!(offset.sigma_with_undetected_m > offset.sigma_m);
        }
        // Where it is refused the offset has half of it, which the total σ covers.
        let Offset { value_m, sigma_with_undetected_m, .. } = Days::new(0.5).offsets[0].clone();
        assert!((value_m - 0.25).abs() < 1e-9 && sigma_with_undetected_m > 0.2, "{value_m} {sigma_with_undetected_m}");
    }
}
