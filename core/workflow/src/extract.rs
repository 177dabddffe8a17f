//! The extract of a product: what a diagnosis of its telemetry leaves for later ones, which add it to those of other
//! days without reading telemetry.
//!
//! It holds the likelihood of the coefficients of the model and of every effect, as the last pass has it, with what is
//! a day's own (constants, noise levels, slow forces) fitted. Likelihoods of days add; what is linear in a day about
//! its own values is so about the values of all days, which differ from them by some of the day's σ. An effect with a
//! shape is there in the first of its forms, and in that of a day that has named it. The forms beside that one are
//! there for who looks at them ([`crate::refit`]): they decide nothing.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use dragfree_archive::{Archive, EXTRACT, Stamp, Written};
use dragfree_engine::EngineError;
use dragfree_identification::candidates::Candidate;
use dragfree_identification::diagnosis::{Diagnosis, Trials, UNOBSERVABLE};
use dragfree_identification::innovations::decision::Prior;
use dragfree_identification::record::Record;
use dragfree_schema::{Coefficient, Settings};
use nalgebra::{DMatrix, DVector};
use serde::{Deserialize, Serialize};

use crate::answer::{
    Evidence, NoiseLevel, Rival, apart, contradict, limits, offsets, rivals_of_all, verdict, with_levels,
};
use crate::likelihood::{CoefficientSums, Decided, Stretches, joined};
use crate::refusals::Answers;
use crate::{ManyDays, WorkflowError};

mod by_band;
mod packed;

pub(crate) use by_band::ByBand;
pub(crate) use packed::doubles;

/// Format of the file.
const FORMAT: &str = "dragfree-extract/1";

/// What a diagnosis of one product leaves for those of several.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Extract {
    format: String,
    /// Product.
    product: String,
    /// Release of the program.
    program: String,
    coefficients: Vec<Coefficient>,
    /// Lower triangle of their information, row after row.
    information: Vec<f64>,
    score: Vec<f64>,
    chi2: f64,
    numbers: f64,
    surveys: Vec<Survey>,
    /// Channels on which each coefficient acts.
    channels: BTreeMap<String, BTreeSet<String>>,
    /// Effect and instance of what this product alone says is missing.
    named: Vec<(String, String)>,
    levels: Vec<NoiseLevel>,
    trials: Trials,
    /// Why this product alone is not explained; none where it is.
    unexplained: Option<String>,
    not_tried: Vec<(String, String)>,
    /// What the channels leave in each band; none in extracts of older programs.
    #[serde(default)]
    by_band: Option<ByBand>,
    /// Housekeeping channels, as expressions name them, with their units.
    #[serde(default)]
    housekeeping: BTreeMap<String, String>,
    /// The likelihood of stretches of time; none in extracts of older programs.
    #[serde(default)]
    stretches: Option<Stretches>,
    /// Coefficients that are what is named in other forms.
    #[serde(default)]
    other_forms: BTreeSet<usize>,
    /// Where it was read from; none where it was made.
    #[serde(skip)]
    read_from: Option<Kept>,
}

/// What an extract is made of.
pub(crate) struct MadeOf<'a> {
    /// A pass about the model alone.
    pub(crate) decided: &'a Decided,
    /// What is named, in its form.
    pub(crate) named: &'a [Candidate],
    /// The same in other forms.
    pub(crate) beside: &'a [Candidate],
    /// The spectra.
    pub(crate) record: &'a Record,
    /// Levels of noise.
    pub(crate) levels: Vec<NoiseLevel>,
}

/// What is known of a weighted sum of coefficients before any data.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct Survey {
    terms: Vec<(String, f64)>,
    prior: Prior,
}

impl Extract {
    /// Of the diagnosis of one product.
    pub(crate) fn new(
        product: &Written,
        made_of: MadeOf<'_>,
        diagnosis: &Diagnosis,
        evidence: &Evidence<'_>,
    ) -> Result<Option<Self>, WorkflowError> {
        let MadeOf { decided, named, beside, record, levels } = made_of;
        let Some(sums) = decided.of_coefficients() else { return Ok(None) };
        let n = sums.coefficients.len();
        // A proposed formula is an effect of one diagnosis.
        let is_proposal = |c: &Coefficient| evidence.proposal(&c.effect, &c.instance).is_some();
        let kept: Vec<usize> = (0..n).filter(|i| !is_proposal(&sums.coefficients[*i])).collect();
        let accepted = diagnosis.candidates.iter().filter(|f| f.accepted);
        let coefficients: Vec<Coefficient> = kept.iter().map(|i| sums.coefficients[*i].clone()).collect();
        let adopted = product.product.result.adopted();
        let adopted = |name: &str| adopted.iter().find(|c| c.name == name).map(|c| c.value);
        let mut stretches = decided.stretches(|c| !is_proposal(c));
        // Levels are told by what could state them.
        for name in stretches.iter_mut().flat_map(|s| &mut s.levels).filter(|name| !name.is_empty()) {
            let states = record.candidate_set.coefficients.iter().find(|c| c.noise == *name);
            if let Some(c) = states {
                name.clone_from(&c.name);
            }
        }
        Ok(Some(Self {
            format: FORMAT.to_owned(),
            product: product.product.id().to_owned(),
            program: env!("CARGO_PKG_VERSION").to_owned(),
            by_band: Some(ByBand::new(&coefficients, named, record, adopted)?),
            stretches,
            other_forms: (0..coefficients.len()).filter(|i| is_in(beside, &coefficients[*i])).collect(),
            housekeeping: housekeeping(record),
            coefficients,
            information: kept
                .iter()
                .enumerate()
                .flat_map(|(row, i)| kept[..=row].iter().map(|j| sums.information[(*i, *j)]))
                .collect(),
            score: kept.iter().map(|i| sums.score[*i]).collect(),
            chi2: sums.chi2,
            numbers: sums.numbers,
            surveys: sums.surveys.into_iter().map(|(terms, prior)| Survey { terms, prior }).collect(),
            channels: sums.channels,
            named: accepted.map(|f| (f.effect.clone(), f.instance.clone())).collect(),
            levels,
            trials: evidence.trials.clone(),
            unexplained: why_unexplained(diagnosis),
            not_tried: diagnosis.not_tried.clone(),
            read_from: None,
        }))
    }

    /// Keeps it beside its product. Returns the path and the bytes.
    ///
    /// # Errors
    /// The archive cannot be written.
    pub fn write(&self, product: &Path, stamp: &Stamp<'_>) -> Result<(PathBuf, u64), WorkflowError> {
        let refuse = |e: serde_json::Error| WorkflowError::Extract { path: product.to_owned(), what: e.to_string() };
        let text = serde_json::to_vec(self).map_err(refuse)?;
        let keep = || Archive::of(product)?.keep_extract(&self.product, &text, stamp);
        let path = keep().map_err(EngineError::from)?;
        Ok((path, text.len() as u64))
    }

    /// Reads that of a product.
    ///
    /// # Errors
    /// [`WorkflowError::Extract`]: there is none, or it is damaged, or of another product, format or release.
    pub fn read(product: &Written) -> Result<Self, WorkflowError> {
        Kept::newest(product)?.read()
    }

    /// Effect and instance of what this product alone says is missing.
    pub(crate) fn named(&self) -> &[(String, String)] {
        &self.named
    }

    /// Housekeeping channels with their units.
    pub(crate) fn housekeeping(&self) -> &BTreeMap<String, String> {
        &self.housekeeping
    }

    /// Why this product alone is not explained; none where it is.
    pub(crate) fn unexplained(&self) -> Option<&str> {
        self.unexplained.as_deref()
    }

    /// Levels of noise that effects could state.
    pub(crate) fn levels(&self) -> &[NoiseLevel] {
        &self.levels
    }

    /// Which of its coefficients is this one.
    pub(crate) fn place(&self, c: &Coefficient) -> Option<usize> {
        self.coefficients.iter().position(|own| same(own, c))
    }

    /// Where it was read from; none where it was made.
    pub(crate) fn read_from(&self) -> Option<&Kept> {
        self.read_from.as_ref()
    }

    /// Takes out what the channels leave in each band.
    pub(crate) fn take_by_band(&mut self) -> Option<ByBand> {
        self.by_band.take()
    }

    /// Takes out the likelihood of stretches of time.
    pub(crate) fn take_stretches(&mut self) -> Option<Stretches> {
        self.stretches.take()
    }

    /// Whether it has this coefficient in a form beside the one that is named.
    pub(crate) fn has_beside(&self, c: &Coefficient) -> bool {
        self.other_forms.iter().any(|i| same(&self.coefficients[*i], c))
    }

    fn names(&self, c: &Coefficient) -> bool {
        self.named.iter().any(|(effect, instance)| (effect, instance) == (&c.effect, &c.instance))
    }

    /// The sums of some of its coefficients.
    fn sums(&self, keep: impl Fn(&Coefficient) -> bool) -> CoefficientSums {
        let kept: Vec<usize> = (0..self.coefficients.len()).filter(|i| keep(&self.coefficients[*i])).collect();
        let packed = |i: usize, j: usize| self.information[i.max(j) * (i.max(j) + 1) / 2 + i.min(j)];
        CoefficientSums {
            coefficients: kept.iter().map(|i| self.coefficients[*i].clone()).collect(),
            information: DMatrix::from_fn(kept.len(), kept.len(), |i, j| packed(kept[i], kept[j])),
            score: DVector::from_fn(kept.len(), |i, _| self.score[kept[i]]),
            chi2: self.chi2,
            numbers: self.numbers,
            surveys: self.surveys.iter().map(|s| (s.terms.clone(), s.prior)).collect(),
            channels: self.channels.clone(),
        }
    }
}

/// An extract in an archive, by its digest: a product that is diagnosed anew has another one.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Kept {
    product: String,
    path: PathBuf,
    sha256: String,
}

impl Kept {
    /// The newest one of a product.
    ///
    /// # Errors
    /// [`WorkflowError::Extract`]: there is none.
    pub(crate) fn newest(product: &Written) -> Result<Self, WorkflowError> {
        let (product, path) = (product.product.id().to_owned(), product.path.with_extension(EXTRACT));
        let digest = Archive::of(&path).and_then(|archive| archive.digest_of(&product, EXTRACT));
        match digest {
            Ok(sha256) => Ok(Self { product, path, sha256 }),
            Err(error) => {
                let what = format!("{error}; {}", how_to_make(&product));
                Err(WorkflowError::Extract { path, what })
            }
        }
    }

    /// Reads it.
    ///
    /// # Errors
    /// [`WorkflowError::Extract`]: it is damaged, or of another product, format or release.
    pub(crate) fn read(&self) -> Result<Extract, WorkflowError> {
        let Self { product: id, path, sha256 } = self;
        let make = how_to_make(id);
        let refuse = |what: String| WorkflowError::Extract { path: path.clone(), what };
        let text = Archive::of(path).and_then(|archive| archive.content(sha256));
        let text = text.map_err(|e| refuse(format!("{e}; {make}")))?;
        let extract: Extract = serde_json::from_slice(&text).map_err(|e| refuse(format!("{e}; {make}")))?;
        let n = extract.coefficients.len();
        let whole = extract.information.len() == n * (n + 1) / 2 && extract.score.len() == n;
        let sound = [
            (extract.format == FORMAT, format!("its format is {}, not {FORMAT}", extract.format)),
            (extract.product == *id, format!("it is of product {}", extract.product)),
            (
                extract.program == env!("CARGO_PKG_VERSION"),
                format!("release {} made it, with other candidates perhaps", extract.program),
            ),
            (whole, "its sums are not of its coefficients".to_owned()),
            (extract.by_band.as_ref().is_none_or(|b| b.is_whole(n)), "its spectra are damaged".to_owned()),
            (extract.stretches.as_ref().is_none_or(|s| s.is_whole(n)), "its stretches are damaged".to_owned()),
            (extract.other_forms.iter().all(|i| *i < n), "its forms are damaged".to_owned()),
        ];
        match sound.into_iter().find(|(holds, _)| !holds) {
            Some((_, what)) => Err(refuse(format!("{what}; {make}"))),
            None => Ok(Extract { read_from: Some(self.clone()), ..extract }),
        }
    }
}

fn how_to_make(product: &str) -> String {
    format!("make it from the telemetry: dragfree diagnose {product} --keep-extract")
}

/// Whether a coefficient is that of a candidate in its form.
fn is_in(candidates: &[Candidate], c: &Coefficient) -> bool {
    let shape = |candidate: &Candidate| candidate.parts.first().map(|(_, form)| form.shape.clone());
    let of = |candidate: &&Candidate| (&candidate.effect, &candidate.instance) == (&c.effect, &c.instance);
    c.candidate && candidates.iter().filter(of).any(|own| shape(own).is_some_and(|s| s.into_iter().eq(c.shape.clone())))
}

/// Housekeeping of the telemetry by its name in expressions, `hk.battery_current_a`, with its unit.
fn housekeeping(record: &Record) -> BTreeMap<String, String> {
    let of = |(topic, unit): (&str, &str)| Some((format!("hk.{}", topic.strip_prefix("hk/")?), unit.to_owned()));
    record.gathered.slow.housekeeping().filter_map(of).collect()
}

fn why_unexplained(diagnosis: &Diagnosis) -> Option<String> {
    let left = diagnosis.unexplained.as_ref().map(|u| format!("{} is left in {}", u.kind, u.channels.join(", ")));
    let formulas = (!diagnosis.formulas.is_empty()).then(|| "a formula is proposed".to_owned());
    let all: Vec<String> = left.into_iter().chain(formulas).chain(diagnosis.reasons.iter().cloned()).collect();
    (!all.is_empty()).then(|| all.join("; "))
}

/// Two coefficients that are the same, in the same form.
fn same(a: &Coefficient, b: &Coefficient) -> bool {
    (&a.name, &a.shape, a.candidate) == (&b.name, &b.shape, b.candidate)
}

/// Diagnoses products of one model from their extracts.
///
/// # Errors
/// [`WorkflowError`]: an extract is missing, or the products have different models.
pub fn diagnose_extracts(products: &[Written]) -> Result<Diagnosis, WorkflowError> {
    let settings = &products.first().ok_or(WorkflowError::NoProduct)?.product.settings;
    let extracts = of_products(products, |extract| drop((extract.take_by_band(), extract.take_stretches())))?;
    let evidence = Evidence { trials: trials(&extracts), least: settings.false_alarm, products, proposals: Vec::new() };
    let (sums, mut not_tried) = shared(&extracts, |_| false);
    let decided = joined(sums, settings, &evidence, Vec::new());
    let unobservable = decided.selection.unobservable.iter().map(|c| decided.candidates[*c].name());
    not_tried.extend(unobservable.map(|name| (name, UNOBSERVABLE.to_owned())));
    let mut diagnosis = answer(settings, &decided, &extracts, &evidence);
    diagnosis.not_tried = not_tried.into_iter().collect();
    contradict(&mut diagnosis, products);
    Ok(diagnosis)
}

/// The extracts of products of one model; `take` may take parts out of each, so that these are not all in memory.
///
/// # Errors
/// [`WorkflowError`]: an extract is missing, or the products have different models.
pub(crate) fn of_products(
    products: &[Written],
    mut take: impl FnMut(&mut Extract),
) -> Result<Vec<Extract>, WorkflowError> {
    ManyDays::refuse(products.iter().map(|w| &w.product))?;
    let read = |product| {
        let mut extract = Extract::read(product)?;
        take(&mut extract);
        Ok(extract)
    };
    let extracts: Vec<Extract> = products.iter().map(read).collect::<Result<_, WorkflowError>>()?;
    of_one_model(&extracts)?;
    Ok(extracts)
}

/// What was tried in all of them.
pub(crate) fn trials(extracts: &[Extract]) -> Trials {
    let mut trials = Trials::default();
    extracts.iter().for_each(|e| trials.add(&e.trials));
    trials
}

/// The sums of each that can be added to those of the others, and what could not be tried, with the reason. Of what an
/// extract has beside the form that is named, what is wanted.
pub(crate) fn shared(
    extracts: &[Extract],
    wanted: impl Fn(&Coefficient) -> bool,
) -> (Vec<CoefficientSums>, BTreeMap<String, String>) {
    let has = |e: &Extract, c: &Coefficient| e.place(c).is_some_and(|i| !e.other_forms.contains(&i) || wanted(c));
    let days = |c: &Coefficient| extracts.iter().filter(|e| has(e, c)).count();
    let several = |c: &Coefficient| days(c) > 1 || extracts.len() == 1;
    let mut not_tried: BTreeMap<String, String> = BTreeMap::new();
    for e in extracts {
        not_tried.extend(e.not_tried.iter().cloned());
        for c in e.coefficients.iter().filter(|c| has(e, c) && !e.names(c) && !several(c)) {
            let why = "its form is another on every day: a diagnosis with the telemetry chooses one for all days";
            not_tried.insert(format!("{}:{}", c.effect, c.instance), why.to_owned());
        }
    }
    let sums: Vec<_> = extracts.iter().map(|e| e.sums(|c| has(e, c) && (e.names(c) || several(c)))).collect();
    // What one day could not try, others may have.
    let tried = sums.iter().flat_map(|s| &s.coefficients).filter(|c| c.candidate);
    tried.for_each(|c| drop(not_tried.remove(&format!("{}:{}", c.effect, c.instance))));
    (sums, not_tried)
}

fn of_one_model(extracts: &[Extract]) -> Result<(), WorkflowError> {
    let model = |e: &Extract| -> Vec<String> {
        e.coefficients.iter().filter(|c| !c.candidate).map(|c| c.name.clone()).collect()
    };
    let Some(first) = extracts.first() else { return Err(WorkflowError::NoProduct) };
    match extracts.iter().find(|e| model(e) != model(first)) {
        Some(other) => {
            Err(WorkflowError::OfOtherModel { product: other.product.clone(), first: first.product.clone() })
        }
        None => Ok(()),
    }
}

/// Levels of several days: means weighted by 1/σ², and the rivals of the days on which the level is certain.
pub(crate) fn levels_of_all(days: &[&[NoiseLevel]]) -> Vec<NoiseLevel> {
    let Some(first) = days.first() else { return Vec::new() };
    let of = |level: &NoiseLevel| {
        let own = || days.iter().copied().flatten().filter(|l| l.coefficient == level.coefficient);
        let known = own().filter(|l| l.sigma > 0.0).map(|l| (l.sigma.powi(-2), l.ln));
        let (weight, sum) = known.fold((0.0, 0.0), |(w, s), (weight, ln)| (w + weight, s + weight * ln));
        let certain: Vec<&[Rival]> = own().filter_map(|l| l.rivals.as_deref()).collect();
        let rivals = (!certain.is_empty()).then(|| rivals_of_all(&certain));
        (weight > 0.0).then(|| NoiseLevel { ln: sum / weight, sigma: weight.powf(-0.5), rivals, ..level.clone() })
    };
    first.iter().filter_map(of).collect()
}

fn answer(settings: &Settings, decided: &Decided, extracts: &[Extract], evidence: &Evidence<'_>) -> Diagnosis {
    let mut answers = Answers::new(settings, decided, evidence);
    answers.refuse_stand_ins(settings, decided, evidence);
    let levels: Vec<&[NoiseLevel]> = extracts.iter().map(Extract::levels).collect();
    let levels = with_levels(&mut answers.named, &levels_of_all(&levels), decided, evidence, settings);
    answers.sort_others();
    let left = |e: &Extract| Some(format!("{} alone: {}", e.product, e.unexplained.as_ref()?));
    let agreement = decided.agreement();
    let mut reasons = answers.why_none_is_named();
    reasons.extend(apart(agreement.as_ref(), settings));
    reasons.extend(extracts.iter().filter_map(left));
    let verdict = verdict(&answers.named, !reasons.is_empty());
    let offsets = offsets(decided, evidence, &answers.kept(decided, &[]));
    Diagnosis {
        verdict: verdict.to_owned(),
        false_alarm_rate: settings.false_alarm,
        tried: evidence.trials.total(),
        candidates: answers.into_candidates(settings.max_evaluated),
        upper_limits: decided.selection.rest.iter().flat_map(|f| limits(decided, f, evidence)).collect(),
        unexplained: None,
        formulas: Vec::new(),
        drifts: Vec::new(),
        offsets,
        agreement,
        reasons,
        levels,
        transients: Vec::new(),
        not_tried: Vec::new(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    /// What one day could not try is tried where two others have it, and is not listed as left out; what none could is.
    #[test]
    fn what_some_days_have_is_tried() {
        let coefficient = |effect: &str| {
            let name = format!("{effect}.sc");
            json!({ "name": name, "effect": effect, "instance": "sc", "unit": "1", "candidate": true })
        };
        let day = |effects: &[&str], not_tried: &[&str]| -> Extract {
            let names: Vec<_> = not_tried.iter().map(|effect| (format!("{effect}:sc"), "it has gaps")).collect();
            let n = effects.len();
            serde_json::from_value(json!({
                "format": FORMAT, "product": "p", "program": "0", "chi2": 1.0, "numbers": 1.0,
                "coefficients": effects.iter().map(|effect| coefficient(effect)).collect::<Vec<_>>(),
                "information": vec![1.0; n * (n + 1) / 2], "score": vec![1.0; n], "surveys": [], "channels": {},
                "named": [], "levels": [], "trials": { "forms": {} }, "unexplained": null, "not_tried": names,
            }))
            .expect("an extract")
        };
        let days = [day(&["a", "b"], &["c"]), day(&["a", "b"], &["c"]), day(&["b"], &["a", "c"])];
        let (sums, not_tried) = shared(&days, |_| false);
        assert_eq!(not_tried.keys().collect::<Vec<_>>(), ["c:sc"]);
        assert_eq!(sums.iter().map(|s| s.coefficients.len()).collect::<Vec<_>>(), [2, 2, 1]);
    }
}
