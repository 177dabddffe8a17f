//! Which effect is missing from the model of some products.
//!
//! The data are read for transients, for the spectra of all candidates, which choose the form of each, once more if a
//! shape can be refined, and then until the likelihood of the innovations, which decides, has settled.

use std::collections::BTreeSet;

use dragfree_engine::config::EffectEntry;
use dragfree_engine::examine::has_parameter;
use dragfree_engine::run::Progress;
use dragfree_estimation::decimate::SLOW_HZ;
use dragfree_estimation::sigma::NoiseModel;
use dragfree_identification::candidates::{Candidate, Coefficient};
use dragfree_identification::diagnosis::{self, Diagnosis, Found, Trials, UNOBSERVABLE, Unexplained};
use dragfree_identification::lines::{Line, Lines};
use dragfree_identification::record::Record;
use dragfree_identification::scores::CandidateScorer;
use dragfree_identification::screen::{RefinementRequest, Screened, retain_unexplained, screen};
use dragfree_identification::slow_forces::{not_explained, slow_forces};
use dragfree_identification::transient::{Detection, PROFILE_S, Transients, is_one_transient};
use dragfree_schema::{AT_NS, FREQUENCY_HZ, NoiseProcess, Settings};
use serde_json::json;

use crate::WorkflowError;
use crate::answer::{
    Evidence, apart, contradict, drifting, fit_form, limits, noise_levels, offsets, verdict, with_levels,
};
use crate::extract::{Extract, MadeOf};
use crate::likelihood::{
    Decided, How, PASSES, Point, Reached, Settled, moved, one_pass, settle, step, step_of_model, transients_near_ends,
    with_numbers,
};
use crate::proposals::{FORMULA, Proposal, probes, proposals};
use crate::refusals::Answers;
use crate::replay::{FINE, Forms, Pass, Replay, What, sum};

/// A diagnosis and the sums that chose the forms of the candidates.
pub struct Diagnosed {
    /// Sums.
    pub record: Record,
    /// What is missing.
    pub diagnosis: Diagnosis,
    /// Thresholds.
    pub settings: Settings,
    /// What it leaves for a diagnosis of several products; none where there are several.
    pub extract: Option<Extract>,
    /// Where the passes have ended.
    pub(crate) end: Settled,
}

/// Diagnoses the data of products of one model; `keeps` an extract of one product. `progress` is told the pass and the
/// number of the product.
///
/// # Errors
/// [`WorkflowError`]: an input has changed, the products do not belong together, there is too little data, or a stage
/// declares noise that cannot be filtered.
pub fn diagnose(
    replay: &Replay<'_>,
    keeps: bool,
    progress: &mut dyn FnMut(Pass, usize, Progress),
) -> Result<Diagnosed, WorkflowError> {
    let settings = replay.settings()?;
    let searched = Searched::new(replay, progress)?;
    let first = Spectra::gather(replay, &searched, &[], &[], &probes(replay.registry), progress)?;
    let mut tried = first.screened.tried.clone();
    let (proposals, formulas) = proposals(replay, &first.record)?;
    let mut requests = first.screened.requests.clone();
    requests.retain(|request| has_parameter(replay.registry, &request.effect, FINE));
    retain_unexplained(&first.scorer(settings), &first.screened, &mut requests)?;
    let spectra = if requests.is_empty() {
        first
    } else {
        tried.retain(|effect, _| requests.iter().any(|request| request.effect == *effect));
        // Sums are large, and these are made again.
        drop(first);
        let finer = Spectra::gather(replay, &searched, &requests, &proposals, &[], progress)?;
        for (effect, forms) in &finer.screened.tried {
            *tried.entry(effect.clone()).or_default() += forms;
        }
        finer
    };
    tried.insert(FORMULA.to_owned(), formulas);
    tried.retain(|effect, _| !has_parameter(replay.registry, effect, FREQUENCY_HZ));
    let trials = Trials::new(&spectra.scorer(settings), &tried);
    let products = replay.products;
    let evidence = Evidence { trials, least: settings.false_alarm, products, proposals };
    let (last, spectra) = decide(replay, &searched, spectra, &requests, &evidence, progress)?;
    let decided = &last.end.decided;
    let scorer = spectra.scorer(settings);
    let mut diagnosis = answer(settings, &spectra.record, &scorer, decided, &last.screened, &evidence, &last.moving)?;
    if let Some(fitted) = with_numbers(replay, &last.end, &evidence, progress)? {
        diagnosis.candidates.iter_mut().filter(|f| f.accepted).for_each(|f| fit_form(f, &fitted, &evidence, settings));
    }
    contradict(&mut diagnosis, products);
    let extract = match products {
        [product] if keeps => {
            let named = named_forms(decided, &last.screened.forms);
            let beside = forms_beside(&spectra.record, &named);
            let about_model = about_model(replay, &spectra.record, &last, (&named, &beside), &evidence, progress)?;
            let made_of = MadeOf {
                decided: &about_model,
                named: &named,
                beside: &beside,
                record: &spectra.record,
                levels: noise_levels(decided, &spectra.record, &evidence, settings),
            };
            Extract::new(product, made_of, &diagnosis, &evidence)?
        }
        _ => None,
    };
    Ok(Diagnosed { diagnosis, settings: settings.clone(), extract, end: last.end, record: spectra.record })
}

/// What the searches without forms have found.
struct Searched {
    found: Transients,
    lines: Lines,
    /// Transients that become candidates.
    detected: Detected,
}

impl Searched {
    fn new(replay: &Replay<'_>, progress: &mut dyn FnMut(Pass, usize, Progress)) -> Result<Self, WorkflowError> {
        let settings = replay.settings()?;
        let by_spectra = sum(replay, settings, What::Transients, progress)?.gathered;
        let (mut found, lines) = (by_spectra.transients, by_spectra.lines);
        let near_ends = transients_near_ends(replay, &mut found, progress)?;
        let detected = Detected::new(&found, &near_ends, settings);
        Ok(Self { found, lines, detected })
    }
}

/// Sums of the spectra of all candidates, and the forms that they choose.
struct Spectra {
    record: Record,
    noise: NoiseModel,
    screened: Screened,
    /// Whether the proposed formulas are among the candidates.
    has_formulas: bool,
}

impl Spectra {
    /// Sums of all candidates, in fine steps what is requested, and of the proposed formulas.
    fn gather(
        replay: &Replay<'_>,
        searched: &Searched,
        requests: &[RefinementRequest],
        proposals: &[Proposal],
        probes: &[EffectEntry],
        progress: &mut dyn FnMut(Pass, usize, Progress),
    ) -> Result<Self, WorkflowError> {
        let settings = replay.settings()?;
        let of_lines = searched.lines.found.iter().map(entry_of);
        let chosen: Vec<EffectEntry> = of_lines.chain(proposals.iter().map(|p| p.entry.clone())).collect();
        let forms = Forms { detected: &searched.detected.all, requests, chosen: &chosen, probes };
        let mut record = sum(replay, settings, What::Candidates(&forms), progress)?;
        record.gathered.transients = searched.found.clone();
        record.gathered.lines = searched.lines.clone();
        let noise = record.noise_model()?;
        let scorer = CandidateScorer::new(&record.candidate_set, &record.gathered, &noise, settings);
        let screened = searched.detected.screen(&scorer, &[], &BTreeSet::new())?;
        Ok(Self { record, noise, screened, has_formulas: !proposals.is_empty() })
    }

    fn scorer<'a>(&'a self, settings: &'a Settings) -> CandidateScorer<'a> {
        CandidateScorer::new(&self.record.candidate_set, &self.record.gathered, &self.noise, settings)
    }

    /// Every candidate in the form of a screen, and every proposed formula. One that has not been summed has no
    /// responses: it has one form, and only beside others does a screen need its sums.
    fn forms(&self, screened: &Screened, proposals: &[Proposal]) -> Vec<Candidate> {
        let formula = |p: &Proposal| Candidate {
            effect: p.entry.id.clone(),
            instance: p.entry.instance.clone(),
            transient: false,
            parts: Vec::new(),
        };
        let formulas = if self.has_formulas { &[] } else { proposals };
        screened.forms.iter().cloned().chain(formulas.iter().map(formula)).collect()
    }
}

/// Transients that become candidates.
struct Detected {
    /// All of them.
    all: Vec<Detection>,
    /// Those of them that are near an end of the data.
    near_ends: Vec<Detection>,
    /// The most significant at each place, and those at another time there.
    loudest: Vec<Detection>,
    /// Others near the ends, at other times than those by more than a profile lasts.
    further: Vec<Detection>,
    /// Two within this are one transient, s.
    same_s: f64,
}

impl Detected {
    /// Those of the spectra, as many as the settings allow, and those near the ends.
    fn new(found: &Transients, near_ends: &Transients, settings: &Settings) -> Self {
        let same_s = settings.same_transient_s;
        let (mut all, mut loudest, mut further): (Vec<Detection>, Vec<_>, Vec<_>) = Default::default();
        let (mut near, mut times_near) = (Vec::new(), Vec::new());
        for detection in found.certain(settings.transient_p_value) {
            let at_an_end = near_ends.detections.contains(detection);
            if !at_an_end && all.len() < settings.max_transients {
                all.push(detection.clone());
            }
            let is_first = loudest.iter().all(|other| !is_one(detection, other, same_s));
            let mut others = loudest.iter().chain(&further);
            let is_further = at_an_end && others.all(|other| !is_one(detection, other, PROFILE_S));
            if is_first {
                loudest.push(detection.clone());
            } else if is_further {
                further.push(detection.clone());
            }
            // Of a transient near an end there is one detection for each place.
            let is_one = |at_ns: &i64| is_one_transient(*at_ns, detection.at_ns, PROFILE_S);
            let is_known = times_near.iter().any(is_one);
            if at_an_end && (is_first || is_further) && (is_known || times_near.len() < settings.max_transients) {
                near.push(detection.clone());
                times_near.extend((!is_known).then_some(detection.at_ns));
            }
        }
        all.extend(near.iter().cloned());
        Self { all, near_ends: near, loudest, further, same_s }
    }

    /// The detection at a place that is tried there beside what is named: its own if the place is named, and else the
    /// most significant one. Where that is what the place shows of a named transient, and the place is no rival of it,
    /// one that is of none is tried.
    fn tried_at(&self, place: &Coefficient, named: &[Candidate], rivals: &BTreeSet<String>) -> Option<&Detection> {
        let others = place.times_beside(named);
        let is_there = |d: &&Detection| place.is_at_place_of(&d.effect, &d.instance);
        let is_new = |d: &&Detection| others.iter().all(|at_ns| !is_one_transient(d.at_ns, *at_ns, self.same_s));
        let loudest = self.loudest.iter().filter(is_there).find(is_new)?;
        let further = || self.further.iter().filter(is_there).filter(is_new);
        if let Some(own) = named.iter().find(|c| (&c.effect, &c.instance) == (&place.effect, &place.instance)) {
            return further().find(|d| Some(d.at_ns) == own.at_ns()).or(Some(loudest));
        }
        let is_named = |d: &Detection| {
            let mut times = named.iter().filter_map(Candidate::at_ns);
            times.any(|at_ns| is_one_transient(d.at_ns, at_ns, PROFILE_S))
        };
        let is_rival = rivals.contains(&format!("{}:{}", place.effect, place.instance));
        let other = further().find(|d| !is_named(d)).filter(|_| is_named(loudest) && !is_rival);
        other.or(Some(loudest))
    }

    /// The screen, with the transients near the ends in the form that the innovations have found: the spectra are
    /// tapered there.
    fn screen(
        &self,
        scorer: &CandidateScorer<'_>,
        named: &[Candidate],
        rivals: &BTreeSet<String>,
    ) -> Result<Screened, WorkflowError> {
        let mut screened = screen(scorer, named)?;
        let (set, forms) = (scorer.candidate_set, &mut screened.forms);
        for place in set.places().iter().filter(|p| set.coefficients[p[0]].transient) {
            let first = &set.coefficients[place[0]];
            let tried = self.tried_at(first, named, rivals);
            let Some(tried) = tried.filter(|d| self.near_ends.contains(d)) else { continue };
            let possible = set.possible_forms(place, named, self.same_s);
            let Some(own) = possible.into_iter().find(|k| first.forms[*k].shape == tried.shape) else { continue };
            let form = set.candidate(place, own);
            match forms.iter_mut().find(|f| f.name() == form.name()) {
                Some(other) if other.transient => *other = form,
                // What acts at the steps of a flag may be there as well as once.
                Some(_) => {}
                None => forms.push(form),
            }
        }
        Ok(screened)
    }
}

/// What the data do not tell from what is named.
fn rivals(decided: &Decided, settings: &Settings) -> BTreeSet<String> {
    let all = decided.selection.chosen.iter().flat_map(|f| &f.alternatives);
    all.filter(|(_, p)| *p > settings.false_alarm).map(|(c, _)| decided.candidates[*c].name()).collect()
}

/// Whether two detections at one place are of one transient.
fn is_one(a: &Detection, b: &Detection, same_s: f64) -> bool {
    (&a.effect, &a.instance) == (&b.effect, &b.instance) && is_one_transient(a.at_ns, b.at_ns, same_s)
}

/// A model's entry of a line.
fn entry_of(line: &Line) -> EffectEntry {
    let mut entry = EffectEntry::new(&line.effect, &line.instance);
    entry.parameters.insert(FREQUENCY_HZ.to_owned(), toml::Value::from(line.frequency_hz));
    entry
}

/// Decides by the likelihood of the innovations among the forms that the spectra choose, beside the effects that are
/// named so far: passes until nothing moves. Gives the spectra back, with the sums of the formulas where one was named.
fn decide(
    replay: &Replay<'_>,
    searched: &Searched,
    mut spectra: Spectra,
    requests: &[RefinementRequest],
    evidence: &Evidence<'_>,
    progress: &mut dyn FnMut(Pass, usize, Progress),
) -> Result<(Last, Spectra), WorkflowError> {
    let settings = replay.settings()?;
    let FirstPoint { mut point, walks, mut slow } = FirstPoint::new(&spectra, settings, evidence)?;
    let mut screened = spectra.screened.clone();
    let mut named: Vec<Candidate> = Vec::new();
    // A pass that fits constants beside what is named comes first, at the start and where a form is new: they are 1e5 σ
    // away, a filter would take them for noise, and with the unknown mean of its series a form that explains nothing
    // would seem to explain what rounding leaves of the constants.
    let (mut opening, mut passes, mut from) = (true, 0, None);
    loop {
        let forms = spectra.forms(&screened, &evidence.proposals);
        let chosen: Vec<EffectEntry> = forms.iter().map(|form| evidence.entry(form)).collect();
        if opening {
            let decided = one_pass(replay, &chosen, &slow, How::Opening, &point, evidence, progress)?;
            point = step(&point, &decided);
            opening = false;
        }
        if passes > 0 {
            let named: Vec<EffectEntry> = named.iter().map(|form| evidence.entry(form)).collect();
            point = settle(replay, &named, &slow, from.take(), point, evidence, progress)?;
        }
        let decided = one_pass(replay, &chosen, &slow, How::Select, &point, evidence, progress)?;
        let next = step(&point, &decided);
        passes += 1;
        let mut now = named_forms(&decided, &forms);
        if now.iter().any(|form| form.parts.is_empty()) {
            // Sums are large, and these are made again. With the formulas among them columns stand in other places.
            let before = (spectra.record.candidate_set.clone(), spectra.record.gathered.columns.clone());
            drop(spectra);
            spectra = Spectra::gather(replay, searched, requests, &evidence.proposals, &[], progress)?;
            let after = (&spectra.record.candidate_set, &spectra.record.gathered.columns);
            let moved = |forms: &[Candidate]| -> Vec<Candidate> {
                forms.iter().filter_map(|form| form.moved((&before.0, &before.1), after)).collect()
            };
            (screened.forms, named) = (moved(&screened.forms), moved(&named));
            let is_formula = |form: &&Candidate| evidence.proposal(&form.effect, &form.instance).is_some();
            screened.forms.extend(spectra.screened.forms.iter().filter(is_formula).cloned());
            now = named_forms(&decided, &screened.forms);
        }
        let mut moving = moved(&point, &next, &decided);
        if now != named {
            moving.extend(differences(&now, &named));
        }
        // A step is too long where it leads to less likelihood. That of another model says nothing of it.
        let adds = named.iter().all(|form| now.contains(form));
        from = adds.then(|| Reached::new(&point, &decided));
        point = next;
        // What seemed to explain a slow force is not named.
        if now.is_empty() && named.is_empty() && slow != walks && passes < PASSES {
            (slow, from) = (walks.clone(), None);
            continue;
        }
        if moving.is_empty() || passes == PASSES {
            let screened = Screened { forms: spectra.forms(&screened, &evidence.proposals), ..screened };
            return Ok((Last { end: Settled { decided, chosen, slow, point }, screened, moving }, spectra));
        }
        if now != named {
            let scorer = spectra.scorer(settings);
            let beside = searched.detected.screen(&scorer, &now, &rivals(&decided, settings))?;
            // A form that has changed is named in its new form, of which the spectra alone know a value.
            named = named_forms(&decided, &beside.forms);
            let fit = scorer.fit(&named)?;
            let values = &fit.estimate.theta.as_slice()[spectra.record.candidate_set.model()..];
            let parts = named.iter().flat_map(|c| c.parts.iter().map(move |(index, _)| (c, *index)));
            for ((_, index), value) in parts.zip(values).filter(|((c, _), _)| !now.contains(c)) {
                point.values.insert(spectra.record.candidate_set.coefficients[index].name.clone(), *value);
            }
            opening = beside.forms.iter().any(|form| !screened.forms.contains(form));
            let before = std::mem::replace(&mut slow, slow_forces(&scorer, &fit, &spectra.record.noise));
            from = from.filter(|_| !opening && slow == before);
            screened = Screened { forms: beside.forms, ..screened };
        }
    }
}

/// Where the passes begin.
struct FirstPoint {
    /// The model as the spectra have it.
    point: Point,
    /// Slow forces beside the declared noise that the residuals of the model show.
    walks: Vec<NoiseProcess>,
    /// Those of them that neither a candidate nor a proposed formula explains better.
    slow: Vec<NoiseProcess>,
}

impl FirstPoint {
    /// A glitch is no slow force, although it has the power of one.
    fn new(spectra: &Spectra, settings: &Settings, evidence: &Evidence<'_>) -> Result<Self, WorkflowError> {
        let (scorer, set) = (spectra.scorer(settings), &spectra.record.candidate_set);
        let fit = scorer.fit(&[])?;
        let model = &set.coefficients[..set.model()];
        let values = model.iter().zip(fit.estimate.theta.iter()).map(|(c, value)| (c.name.clone(), *value)).collect();
        // Of those at one place all, as the most significant may be another than what acts.
        let events = |c: &&Candidate| {
            let of = |d: &Detection| (&d.effect, &d.instance) == (&c.effect, &c.instance);
            c.transient && scorer.gathered.transients.certain(settings.false_alarm).any(of)
        };
        let events: Vec<Candidate> = spectra.screened.forms.iter().filter(events).cloned().collect();
        let beside = scorer.fit(&events)?;
        let (declared, forms) = (&spectra.record.noise, &spectra.screened.forms);
        let walks = slow_forces(&scorer, &beside, declared);
        let driven: Vec<_> = evidence.proposals.iter().map(|p| (p.driven, p.response.clone())).collect();
        let driven = (&driven[..], evidence.trials.of(FORMULA));
        let slow = not_explained(&scorer, &beside, &walks, declared, forms, driven)?;
        Ok(Self { point: Point::at(values), walks, slow })
    }
}

/// The end of the passes of a decision.
struct Last {
    end: Settled,
    screened: Screened,
    /// What had not settled.
    moving: BTreeSet<String>,
}

/// A pass about the model alone, for the extract of a product. Likelihoods of days add where they are taken about the
/// same point: what one day names, another has not. What is named has its form of this day, and those `beside` it,
/// everything else the first of its forms, which is the same on every day.
fn about_model(
    replay: &Replay<'_>,
    record: &Record,
    last: &Last,
    (named, beside): (&[Candidate], &[Candidate]),
    evidence: &Evidence<'_>,
    progress: &mut dyn FnMut(Pass, usize, Progress),
) -> Result<Decided, WorkflowError> {
    let set = &record.candidate_set;
    let places = set.places();
    let form = |screened: &Candidate| {
        let of = |place: &&Vec<usize>| set.candidate(place, 0).name() == screened.name();
        let first = places.iter().find(of).map(|place| set.candidate(place, 0));
        // A transient has the time of this day.
        let keeps = named.contains(screened) || screened.transient;
        if keeps { screened.clone() } else { first.unwrap_or_else(|| screened.clone()) }
    };
    let forms = last.screened.forms.iter().map(form).chain(beside.iter().cloned());
    let entries: Vec<EffectEntry> = forms.map(|form| evidence.entry(&form)).collect();
    let mut point = step_of_model(&last.end.point, &last.end.decided);
    // The first of the two finds the means of series that are new. Levels are those beside what is named.
    point.levels.clone_from(&last.end.point.levels);
    let opening = one_pass(replay, &entries, &last.end.slow, How::Opening, &point, evidence, progress)?;
    point = step(&point, &opening);
    one_pass(replay, &entries, &last.end.slow, How::Select, &point, evidence, progress)
}

/// Of what is named with a lag, a resonance or another number in its shape the forms of its search that differ from it
/// in one number.
fn forms_beside(record: &Record, named: &[Candidate]) -> Vec<Candidate> {
    let set = &record.candidate_set;
    let places = set.places();
    let differs_in_a_number = |a: &Candidate, b: &Candidate| {
        let (Some((_, a)), Some((_, b))) = (a.parts.first(), b.parts.first()) else { return false };
        let mut differing = a.shape.iter().filter(|(key, value)| b.shape.get(*key) != Some(*value));
        let (first, more) = (differing.next(), differing.next());
        let is_number = |key: &String| b.shape.get(key).is_some_and(serde_json::Value::is_number);
        a.shape.len() == b.shape.len() && more.is_none() && first.is_some_and(|(k, v)| v.is_number() && is_number(k))
    };
    let forms = |named: &Candidate| -> Vec<Candidate> {
        let own = named.parts.first().filter(|_| !named.transient);
        let place = own.and_then(|(index, _)| places.iter().find(|place| place.contains(index)));
        let all = place
            .into_iter()
            .flat_map(|place| (0..set.coefficients[place[0]].forms.len()).map(|form| set.candidate(place, form)));
        all.filter(|form| differs_in_a_number(named, form)).collect()
    };
    named.iter().flat_map(forms).collect()
}

/// Names of the effects that are in one of two lists in a form in which they are not in the other.
fn differences(a: &[Candidate], b: &[Candidate]) -> BTreeSet<String> {
    let only = |of: &[Candidate], other: &[Candidate]| -> Vec<String> {
        of.iter().filter(|c| !other.contains(c)).map(Candidate::name).collect()
    };
    only(a, b).into_iter().chain(only(b, a)).collect()
}

/// The named effects among some forms.
fn named_forms(decided: &Decided, forms: &[Candidate]) -> Vec<Candidate> {
    let named = |c: &&Candidate| {
        let mut all = decided.selection.chosen.iter().map(|f| &decided.candidates[f.candidate]);
        all.any(|place| (&place.effect, &place.instance) == (&c.effect, &c.instance))
    };
    let mut all: Vec<Candidate> = forms.iter().filter(named).cloned().collect();
    all.sort_by_key(Candidate::name);
    all
}

/// The answer that the last pass gives.
fn answer(
    settings: &Settings,
    record: &Record,
    scorer: &CandidateScorer<'_>,
    decided: &Decided,
    screened: &Screened,
    evidence: &Evidence<'_>,
    moving: &BTreeSet<String>,
) -> Result<Diagnosis, WorkflowError> {
    let forms = &screened.forms;
    let unexplained = diagnosis::remaining(scorer, &named_forms(decided, forms))?;
    let mut answers = Answers::new(settings, decided, evidence);
    answers.refuse_stand_ins(settings, decided, evidence);
    let mut formulas = answers.take_formulas(evidence);
    formulas.extend(answers.refuse_like_formulas(settings, decided, evidence));
    answers.refuse_beside_formulas(decided, evidence);
    answers.refuse_parts_of_formulas(&formulas, |own| {
        let form = forms.iter().find(|f| !f.transient && (&f.effect, &f.instance) == (&own.effect, &own.instance));
        form.is_some_and(|form| form.is_slow(&record.gathered.columns))
    });
    // A small remainder of what was there without them is what the grid of forms cannot represent.
    let before = diagnosis::remaining(scorer, &[])?.map_or(0.0, |u| u.ratio);
    let loud = unexplained.as_ref().filter(|u| u.ratio > settings.excess_remainder * before);
    answers.refuse_followers(scorer, &named_forms(decided, forms), loud)?;
    let unexplained = followed(unexplained, &formulas, evidence, scorer);
    let levels = noise_levels(decided, record, evidence, settings);
    let levels = with_levels(&mut answers.named, &levels, decided, evidence, settings);
    answers.sort_others();
    let mut reasons = answers.why_none_is_named();
    if !moving.is_empty() {
        let names: Vec<&str> = moving.iter().map(String::as_str).collect();
        reasons.push(format!("the likelihood is not settled after {PASSES} passes: {} still move", names.join(", ")));
    }
    let agreement = decided.agreement();
    reasons.extend(apart(agreement.as_ref(), settings));
    let drifts = decided.drifts(settings, evidence);
    reasons.extend(drifts.iter().filter_map(|drift| drifting(drift, settings, decided)));
    let verdict = verdict(&answers.named, unexplained.is_some() || !reasons.is_empty());
    let beside_constants = decided.selection.unobservable.iter().map(|c| decided.candidates[*c].name());
    let unobservable = screened.unobservable.iter().cloned().chain(beside_constants);
    let unobservable = unobservable.map(|name| (name, UNOBSERVABLE.to_owned()));
    let offsets = offsets(decided, evidence, &answers.kept(decided, &formulas));
    Ok(Diagnosis {
        verdict: verdict.to_owned(),
        false_alarm_rate: settings.false_alarm,
        tried: evidence.trials.total(),
        candidates: answers.into_candidates(settings.max_evaluated),
        upper_limits: decided.selection.rest.iter().flat_map(|f| limits(decided, f, evidence)).collect(),
        unexplained,
        formulas,
        drifts,
        offsets,
        agreement,
        reasons,
        levels,
        transients: scorer.gathered.transients.certain(settings.false_alarm).map(|h| json!(h)).collect(),
        not_tried: unobservable
            .chain(record.not_tried.iter().cloned())
            .chain(decided.not_tried.iter().cloned())
            .collect(),
    })
}

/// What is unexplained, with the drivers of the proposed formulas first among what is coherent with it.
fn followed(
    unexplained: Option<Unexplained>,
    formulas: &[Found],
    evidence: &Evidence<'_>,
    scorer: &CandidateScorer<'_>,
) -> Option<Unexplained> {
    if formulas.is_empty() {
        return unexplained;
    }
    let mut u = unexplained.unwrap_or_else(|| {
        let plan = scorer.plan();
        let lowest_hz = plan.bands.first().map_or(0.0, |band| plan.frequency_hz(*band));
        Unexplained {
            channels: Vec::new(),
            band_hz: [lowest_hz, SLOW_HZ],
            kind: "driven".to_owned(),
            ratio: 1.0,
            power: false,
            coherent_with: Vec::new(),
            coherences: Vec::new(),
        }
    });
    // The chosen ones first, then what the data cannot tell from them, as likely first.
    let own = formulas.iter().filter_map(|f| evidence.proposal(&f.effect, &f.instance));
    let words = formulas.iter().flat_map(|f| &f.confounders);
    let others = words.filter_map(|words| evidence.proposals.iter().find(|p| p.words == *words));
    let drivers: Vec<String> = own.chain(others).map(|p| p.driver.clone()).collect();
    let before = std::mem::take(&mut u.coherent_with);
    for driver in drivers.into_iter().chain(before) {
        if !u.coherent_with.contains(&driver) {
            u.coherent_with.push(driver);
        }
    }
    u.channels.extend(formulas.iter().flat_map(|f| f.channels.clone()));
    u.channels.sort();
    u.channels.dedup();
    Some(u)
}

impl Diagnosed {
    /// Number of effects that were tried, without transients.
    pub fn effects(&self) -> usize {
        let set = &self.record.candidate_set;
        set.places().iter().filter(|p| !set.coefficients[p[0]].transient).count()
    }

    /// Detected transients that no accepted candidate explains, by decreasing significance; of close ones the first.
    pub fn unexplained_transients(&self) -> Vec<&Detection> {
        let seen = self.record.gathered.transients.certain(self.diagnosis.false_alarm_rate);
        unexplained(seen, &self.diagnosis.candidates, self.settings.same_transient_s)
    }
}

fn unexplained<'a>(seen: impl Iterator<Item = &'a Detection>, candidates: &[Found], same_s: f64) -> Vec<&'a Detection> {
    let accepted = candidates.iter().filter(|f| f.accepted);
    let mut told: Vec<i64> = accepted.filter_map(|f| f.shape.get(AT_NS)?.as_i64()).collect();
    let mut is_new = |detection: &&Detection| {
        let new = told.iter().all(|at_ns| !is_one_transient(*at_ns, detection.at_ns, same_s));
        told.push(detection.at_ns);
        new
    };
    seen.filter(|detection| is_new(detection)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use dragfree_identification::candidates::Form;

    fn detection(at_s: i64) -> Detection {
        Detection {
            effect: "impulse".to_owned(),
            instance: "tm1.x".to_owned(),
            coefficient: "impulse.tm1.x".to_owned(),
            unit: "N s".to_owned(),
            shape: serde_json::Map::new(),
            at_ns: 1_000_000_000 * at_s,
            significance: 10.0,
        }
    }

    /// One transient near an end, as nine places could have made it, leaves a weaker one at the other end a candidate.
    #[test]
    fn the_places_of_a_transient_near_an_end_are_one_transient() {
        let at = |place: usize, at_s, significance| Detection {
            instance: format!("place{place}"),
            significance,
            ..detection(at_s)
        };
        let mut all: Vec<Detection> = (0..9).map(|k| at(k, 100, 100.0 - k as f64)).collect();
        all.push(at(0, 20_000, 20.0));
        let found = Transients { detections: all, tried: 1.0 };
        let detected = Detected::new(&found, &found, &Settings::default());
        assert_eq!(detected.near_ends.len(), 10);
    }

    /// A place shows a named transient of another place at 1800 s, and its own at 600 s, not as loud. Beside the named
    /// one its own is tried, unless the place is a rival of it; and where its own is named it stays.
    #[test]
    fn a_place_near_an_end_is_tried_with_its_own_transient() {
        let at = |instance: &str, at_s, significance| Detection {
            instance: instance.to_owned(),
            significance,
            ..detection(at_s)
        };
        let all = vec![at("tm1.z", 1750, 43.0), at("sc.x", 1800, 40.0), at("sc.x", 600, 25.0)];
        let found = Transients { detections: all, tried: 1.0 };
        let detected = Detected::new(&found, &found, &Settings::default());
        assert_eq!(detected.near_ends.len(), 3);
        let place = Coefficient {
            name: "impulse.sc.x".to_owned(),
            effect: "impulse".to_owned(),
            instance: "sc.x".to_owned(),
            initial: 0.0,
            prior_sigma: None,
            estimate: false,
            candidate: true,
            transient: true,
            forms: Vec::new(),
            noise: String::new(),
        };
        let named = |instance: &str, at_s: i64| {
            let shape = serde_json::Map::from_iter([(AT_NS.to_owned(), json!(1_000_000_000 * at_s))]);
            let form = Form { shape, unit: String::new(), lower: None, upper: None, terms: Vec::new(), colours: None };
            let (effect, instance) = ("impulse".to_owned(), instance.to_owned());
            Candidate { effect, instance, transient: true, parts: vec![(0, form)] }
        };
        let tried = |named: &[Candidate], rivals: &[&str]| {
            let rivals = rivals.iter().map(|name| (*name).to_owned()).collect();
            detected.tried_at(&place, named, &rivals).map(|d| d.at_ns / 1_000_000_000)
        };
        assert_eq!(tried(&[], &[]), Some(1800));
        assert_eq!(tried(&[named("tm1.z", 1750)], &[]), Some(600));
        assert_eq!(tried(&[named("tm1.z", 1750)], &["impulse:sc.x"]), Some(1800));
        assert_eq!(tried(&[named("tm1.z", 1750), named("sc.x", 600)], &[]), Some(600));
        assert_eq!(tried(&[named("sc.x", 1800)], &[]), Some(1800));
    }

    /// Of two detections near an end within what one transient rings, the louder one is a candidate; of two ends, and
    /// beside one of the spectra within that time, each.
    #[test]
    fn a_transient_near_an_end_is_one_candidate() {
        let loud = |(at_s, significance)| Detection { significance, ..detection(at_s) };
        let all = [(100, 20.0), (600, 19.0), (3000, 18.0), (20_000, 17.0)].map(loud);
        let of =
            |which: &[usize]| Transients { detections: which.iter().map(|k| all[*k].clone()).collect(), tried: 1.0 };
        let detected = |near: &[usize]| Detected::new(&of(&[0, 1, 2, 3]), &of(near), &Settings::default());
        let times = |all: &[Detection]| all.iter().map(|d| d.at_ns / 1_000_000_000).collect::<Vec<_>>();
        assert_eq!(times(&detected(&[0, 1]).near_ends), [100]);
        assert_eq!(times(&detected(&[0, 1]).all), [3000, 20_000, 100]);
        assert_eq!(times(&detected(&[0, 3]).near_ends), [100, 20_000]);
    }

    #[test]
    fn what_rings_beside_something_louder_is_not_told_again() {
        let seen = [20_000, 21_800, 24_000, 5_000].map(detection);
        // The third rings beside the second, which rings beside the first.
        let times: Vec<i64> = unexplained(seen.iter(), &[], 3600.0).iter().map(|h| h.at_ns / 1_000_000_000).collect();
        assert_eq!(times, [20_000, 5_000]);
    }
}
