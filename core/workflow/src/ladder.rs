//! The ladder of model revisions: how the error falls from one to the next, on the days of the fit and on days kept out
//! of it.
//!
//! χ² is computed with the mission file's Σ, which revisions share; with a Σ from residuals it could not be compared
//! between revisions. Where a revision states levels of noise, or missions differ, Σ differs too, and what falls is
//! `−2 log` of the likelihood, χ² plus `Σ 2n log det Σ`: a larger Σ lowers χ² of any data. Channels of one telemetry
//! differ between missions by known accelerations alone, so that their likelihoods can be compared.

use std::collections::{BTreeMap, BTreeSet};

use serde::Serialize;

use dragfree_archive::product::{Coefficient, Product};
use dragfree_engine::config::Model;

use crate::ManyDays;

mod missions;
mod nees;

pub use missions::declared_log_determinant;
use missions::{Labels, same_telemetry};
pub use nees::Nees;

/// Why products make no ladder.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs, reason = "every field is named in its sentence")]
pub enum LadderError {
    /// Products of two spacecraft, or of none.
    #[error("{0}")]
    Products(String),
    /// A product without data of its own.
    #[error(transparent)]
    ManyDays(#[from] ManyDays),
    /// A product that is no held-out one.
    #[error("{id} cannot be held out: {why}")]
    HeldOut { id: String, why: String },
}

/// Revisions in the order of parentage.
#[derive(Clone, Debug, Serialize)]
pub struct Ladder {
    /// Windows that every revision was fitted to.
    pub days: Vec<Window>,
    /// Revisions.
    pub revisions: Vec<Rung>,
    /// Revisions whose effects do not help on the days kept out.
    pub over_fitted: Vec<OverFitted>,
    /// What could not be compared, and why.
    pub notes: Vec<String>,
}

/// A stretch of data.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
pub struct Window {
    /// Day of the product's name.
    pub day: String,
    /// First epoch, Unix ns of the product's time scale.
    pub start_ns: i64,
    /// Last epoch, Unix ns of the product's time scale.
    pub stop_ns: i64,
}

/// One revision.
#[derive(Clone, Debug, Serialize)]
pub struct Rung {
    /// Name.
    pub revision: String,
    /// Parent as the products have it.
    pub parent: Option<String>,
    /// Revision that changes are told from: the parent, or where it has no product, the one with most of these effects
    /// and no other.
    pub compared_with: Option<String>,
    /// Effects, `ID:INSTANCE`.
    pub effects: Vec<String>,
    /// Effects that the compared revision lacks.
    pub added: Vec<String>,
    /// Effects that the compared revision has besides.
    pub removed: Vec<String>,
    /// Products, one a window.
    pub products: Vec<String>,
    /// Days of the fit together.
    #[serde(flatten)]
    pub fit: Fit,
    /// Fall of χ² from the compared revision.
    pub fall: Option<Fall>,
    /// Estimated coefficients.
    pub coefficients: Vec<Value>,
    /// Normalised estimation error squared of each solution, where truth is known.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub nees: Vec<Nees>,
    /// The same model, its coefficients fixed, on days kept out of the fit.
    pub held_out: Option<HeldOut>,
}

/// How well a revision describes some days.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Fit {
    /// `Σ rᴴ Σ⁻¹ r` with the mission's Σ, at the levels of noise that the model states.
    pub chi2: f64,
    /// `Σ 2n log (det Σ/det Σ_mission)` of these levels.
    #[serde(skip_serializing_if = "is_zero")]
    pub log_determinant: f64,
    /// `Σ 2n log det Σ_mission`; zero in a ladder of one mission, `None` where it is unknown.
    #[serde(skip)]
    declared_log_determinant: Option<f64>,
    /// Observations, estimated coefficients not subtracted.
    pub dof: f64,
    /// χ² per observation.
    pub chi2_per_dof: f64,
    /// Rms of the whitened residual, 1 when model and noise are right.
    pub rms: f64,
    /// Mean normalised innovation squared.
    pub nis: f64,
    /// Each channel.
    pub channels: Vec<Channel>,
}

fn is_zero(x: &f64) -> bool {
    *x == 0.0
}

/// One channel.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Channel {
    /// `tm1.accel.x`
    pub channel: String,
    /// χ² per observation of this channel alone.
    pub chi2_per_dof: f64,
    /// Its root.
    pub rms: f64,
}

/// A fall of χ², or of `−2 log` of the likelihood where the revisions do not share Σ.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Fall {
    /// Above zero where the newer revision is better.
    pub delta_chi2: f64,
    /// Standard deviation of that because the two weigh different epochs; zero where they weigh the same.
    pub uncertainty: f64,
}

/// A coefficient of a revision.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Value {
    /// `com-offset.tm1.x`
    pub name: String,
    /// Adopted value, mean over the days weighted by 1/σ², in `unit`.
    pub value: f64,
    /// Standard deviation, days taken for independent, in `unit`.
    pub sigma: f64,
    /// SI unit.
    pub unit: String,
    /// Frame, empty where there is none.
    pub frame: String,
    /// Change from the compared revision over σ.
    pub change_sigmas: Option<f64>,
    /// Truth of a simulation, in `unit`.
    pub truth: Option<f64>,
    /// Value − truth, in `unit`.
    pub error: Option<f64>,
    /// The same over σ.
    pub error_sigmas: Option<f64>,
}

/// A revision on days kept out of the fit.
#[derive(Clone, Debug, Serialize)]
pub struct HeldOut {
    /// Products.
    pub products: Vec<String>,
    /// Windows.
    pub days: Vec<Window>,
    /// All of them together.
    #[serde(flatten)]
    pub fit: Fit,
    /// Fall of χ² from the compared revision on the days that both have.
    pub fall: Option<Fall>,
    /// What the fall says of the effects that were added.
    pub verdict: Option<Verdict>,
}

/// Whether what was added helps on days kept out.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub enum Verdict {
    /// χ² falls.
    #[serde(rename = "helps")]
    Helps,
    /// χ² does not fall.
    #[serde(rename = "over-fitted")]
    OverFitted,
    /// The two weigh different epochs, and that may be all.
    #[serde(rename = "undecided")]
    Undecided,
}

/// A revision whose effects do not help where they were not fitted.
#[derive(Clone, Debug, Serialize)]
pub struct OverFitted {
    /// Revision.
    pub revision: String,
    /// Effects that it added.
    pub effects: Vec<String>,
    /// Fall of χ² on the days kept out: at or below zero.
    pub delta_chi2: f64,
}

/// Makes the ladder of `products`; `held_out` are products of `dragfree model fix` of those revisions on other days,
/// `truth` gives the true value of a coefficient in its SI unit, `declared` the [`declared_log_determinant`] of a
/// product, which is asked for only where missions differ.
///
/// # Errors
/// [`LadderError`] says which product does not fit, and why.
pub fn ladder(
    products: &[Product],
    held_out: &[Product],
    truth: &dyn Fn(&str) -> Option<f64>,
    declared: &dyn Fn(&Product) -> Option<f64>,
) -> Result<Ladder, LadderError> {
    let Some(first) = products.first() else {
        return Err(LadderError::Products("a ladder needs a product; `dragfree run` makes one".to_owned()));
    };
    ManyDays::refuse(products.iter().chain(held_out))?;
    for other in products.iter().chain(held_out) {
        if craft(other) != craft(first) && !same_telemetry(other, first) {
            return Err(LadderError::Products(format!(
                "{} is of {}, {} is of {}: a ladder is of one spacecraft, or of one telemetry read with several missions",
                first.id(),
                craft(first),
                other.id(),
                craft(other)
            )));
        }
    }
    let mut notes = Vec::new();
    let labels = Labels::new(products.iter().chain(held_out));
    // In a ladder of one mission all fits have this term in common.
    let declared = |p: &Product| if labels.several() { declared(p) } else { Some(0.0) };
    let mut of = by_revision(products, &labels);
    let days = common(&mut of, &mut notes)?;
    let parents = compared(&of, &labels);
    let mut kept_out: BTreeMap<String, BTreeMap<Window, &Product>> = BTreeMap::new();
    for product in held_out {
        let revision = held_out_of(product, &of, &days, &labels)?;
        newer(kept_out.entry(revision).or_default(), product);
    }

    let mut revisions: Vec<Rung> = Vec::new();
    for revision in order(&of, &parents) {
        let own = &of[&revision];
        let compared_with = parents[&revision].clone();
        let before = compared_with.as_ref().and_then(|p| revisions.iter().find(|r| r.revision == *p));
        let effects = effects(any(own));
        let missing = |from: &[String], what: &[String]| -> Vec<String> {
            what.iter().filter(|e| !from.contains(e)).cloned().collect()
        };
        let added = before.map_or_else(Vec::new, |b| missing(&b.effects, &effects));
        let removed = before.map_or_else(Vec::new, |b| missing(&effects, &b.effects));
        let this = fit(own.values().copied(), &declared);
        let fall = before.and_then(|b| fall(&b.fit, &this, &format!("{} and {revision}", b.revision), &mut notes));
        let held = kept_out.get(&revision).map(|own| {
            let before = compared_with.as_ref().and_then(|p| Some((p, kept_out.get(p)?)));
            if before.is_none() && !added.is_empty() {
                let parent = compared_with.as_deref().unwrap_or_default();
                notes.push(format!(
                    "revision {parent} has no held-out product, so it cannot be said whether {} helps there: \
                     `dragfree model fix` with a product of {parent}, and run the day",
                    added.join(", ")
                ));
            }
            let sigmas = first.settings.ladder_sigmas;
            held_out_fit(own, before, (&revision, !added.is_empty(), sigmas), &declared, &mut notes)
        });
        let coefficients = values(own, before, truth);
        revisions.push(Rung {
            revision: revision.clone(),
            parent: any(own).model.parent.clone(),
            compared_with,
            effects,
            added,
            removed,
            products: own.values().map(|p| p.id().to_owned()).collect(),
            fit: this,
            fall,
            coefficients,
            nees: nees::nees(own.values().copied(), truth),
            held_out: held,
        });
    }
    let over_fitted = revisions.iter().filter_map(|r| {
        let held = r.held_out.as_ref().filter(|h| h.verdict == Some(Verdict::OverFitted))?;
        let delta_chi2 = held.fall?.delta_chi2;
        Some(OverFitted { revision: r.revision.clone(), effects: r.added.clone(), delta_chi2 })
    });
    Ok(Ladder { days, over_fitted: over_fitted.collect(), revisions, notes })
}

fn craft(product: &Product) -> String {
    let attributes = &product.header.global_attributes;
    format!("{} {}", attributes.project, attributes.platform)
}

fn window(product: &Product) -> Window {
    let attributes = &product.header.non_standard_attributes;
    Window {
        day: attributes.day.clone(),
        start_ns: attributes.start_time_epoch_ns,
        stop_ns: attributes.stop_time_epoch_ns,
    }
}

type Days<'a> = BTreeMap<Window, &'a Product>;

/// The product that was made last where two are of the same window and model.
fn newer<'a>(days: &mut Days<'a>, product: &'a Product) {
    let revision = |p: &Product| {
        let attributes = &p.header.non_standard_attributes;
        (attributes.release, attributes.revision)
    };
    let slot = days.entry(window(product)).or_insert(product);
    if revision(product) > revision(slot) {
        *slot = product;
    }
}

fn by_revision<'a>(products: &'a [Product], labels: &Labels) -> BTreeMap<String, Days<'a>> {
    let mut of: BTreeMap<String, Days<'_>> = BTreeMap::new();
    for product in products {
        newer(of.entry(labels.of(product)).or_default(), product);
    }
    of
}

/// Leaves only windows that every revision has.
fn common(of: &mut BTreeMap<String, Days<'_>>, notes: &mut Vec<String>) -> Result<Vec<Window>, LadderError> {
    let mut all = of.values().map(|days| days.keys().cloned().collect::<BTreeSet<_>>());
    let first = all.next().unwrap_or_default();
    let shared = all.fold(first, |shared, days| &shared & &days);
    if shared.is_empty() {
        let told: Vec<String> = of
            .iter()
            .map(|(revision, days)| {
                let days: Vec<String> = days.values().map(|p| format!("{} ({})", window(p).day, p.id())).collect();
                format!("revision {revision}: {}", days.join(", "))
            })
            .collect();
        return Err(LadderError::Products(format!(
            "no stretch of data was fitted with every revision, so they cannot be compared: {}; run each over the same files, with \
             the same --from and --until",
            told.join("; ")
        )));
    }
    for (revision, days) in of.iter_mut() {
        let left: Vec<String> =
            days.iter().filter(|(w, _)| !shared.contains(w)).map(|(_, p)| p.id().to_owned()).collect();
        if !left.is_empty() {
            notes.push(format!(
                "{}: left out, not every revision was fitted there (this is {revision})",
                left.join(", ")
            ));
        }
        days.retain(|w, _| shared.contains(w));
    }
    Ok(shared.into_iter().collect())
}

/// A product of the revision; each has one.
fn any<'a>(days: &Days<'a>) -> &'a Product {
    days.values().next().expect("only windows that every revision has are kept, and there is one")
}

/// Effects that ran, `ID:INSTANCE`.
fn effects(product: &Product) -> Vec<String> {
    let ran = product.history.iter().filter(|s| s.kind == "effect");
    let name = |s: &dragfree_archive::product::Stage| {
        if s.instance.is_empty() { s.plugin.clone() } else { format!("{}:{}", s.plugin, s.instance) }
    };
    ran.map(name).collect()
}

/// Sort key of a revision: its number, then its name.
fn number(revision: &str) -> (u32, &str) {
    let own = revision.split('@').next().unwrap_or_default();
    (Model::counter(own).unwrap_or(0), revision)
}

/// The revision that each is compared with: of the same mission; the first of a further mission with the same revision
/// of an earlier one.
fn compared(of: &BTreeMap<String, Days<'_>>, labels: &Labels) -> BTreeMap<String, Option<String>> {
    let set = |days: &Days<'_>| effects(any(days)).into_iter().collect::<BTreeSet<_>>();
    let nearest = |revision: &String, days: &Days<'_>| {
        let parent = any(days).model.parent.as_ref().map(|parent| labels.with(any(days), parent));
        if let Some(parent) = parent.filter(|p| of.contains_key(p) && p != revision) {
            return Some(parent);
        }
        let own = set(days);
        let mission = labels.mission(any(days));
        let same = of.iter().filter(|(_, d)| labels.mission(any(d)) == mission);
        let smaller = same.map(|(r, d)| (set(d), r)).filter(|(s, _)| s.len() < own.len() && s.is_subset(&own));
        if let Some((_, nearest)) = smaller.max_by_key(|(s, r)| (s.len(), number(r))) {
            return Some(nearest.clone());
        }
        let of_model = |d: &Days<'_>| any(d).model.revision.clone();
        let earlier = of.iter().filter(|(_, d)| labels.mission(any(d)) < mission && of_model(d) == of_model(days));
        earlier.min_by_key(|(_, d)| labels.mission(any(d))).map(|(r, _)| r.clone())
    };
    of.iter().map(|(revision, days)| (revision.clone(), nearest(revision, days))).collect()
}

/// Each revision after the one that it is compared with, branches one after the other.
fn order(of: &BTreeMap<String, Days<'_>>, parents: &BTreeMap<String, Option<String>>) -> Vec<String> {
    let children = |of_whom: Option<&String>| {
        let mut found: Vec<&String> = of.keys().filter(|r| parents[*r].as_ref() == of_whom).collect();
        found.sort_by_key(|r| std::cmp::Reverse(number(r)));
        found
    };
    let mut out: Vec<String> = Vec::new();
    let mut open = children(None);
    while let Some(next) = open.pop() {
        if !out.contains(next) {
            out.push(next.clone());
            open.extend(children(Some(next)));
        }
    }
    // Parents written by hand can form a cycle, which no root reaches.
    let rest: Vec<String> = of.keys().filter(|r| !out.contains(r)).cloned().collect();
    out.extend(rest);
    out
}

/// The figures of the stage that weighed the channels.
fn weighed(product: &Product) -> Option<&toml::Table> {
    product.quality.stages.values().find(|stage| stage.contains_key("dof") && stage.contains_key("channels"))
}

fn float(table: &toml::Table, key: &str) -> f64 {
    let value = table.get(key);
    value.and_then(|v| v.as_float().or_else(|| v.as_integer().map(|i| i as f64))).unwrap_or(f64::NAN)
}

/// Some days together: sums of χ² and of observations.
fn fit<'a>(days: impl Iterator<Item = &'a Product>, declared: &dyn Fn(&Product) -> Option<f64>) -> Fit {
    let (mut chi2, mut dof) = (0.0, 0.0);
    let (mut log_determinant, mut declared_log_determinant) = (0.0, Some(0.0));
    let (mut nis, mut epochs) = (0.0, 0.0);
    let mut channels: Vec<(String, f64, f64)> = Vec::new();
    for product in days {
        let figures = weighed(product);
        // Degrees of freedom lack what the stage estimated, of coefficients and of noise, and the sum over observations
        // must not depend on that. Products of before tell these alone.
        let told = |f: &toml::Table| {
            let observations = float(f, "observations");
            if observations.is_nan() { float(f, "dof") + product.result.adopted().len() as f64 } else { observations }
        };
        let observations = figures.map_or(f64::NAN, told);
        chi2 += product.quality.chi2_per_dof * observations;
        dof += observations;
        let of_levels = figures.map(|f| float(f, "log_determinant_over_declared")).filter(|x| !x.is_nan());
        log_determinant += of_levels.unwrap_or(0.0);
        declared_log_determinant = declared_log_determinant.zip(declared(product)).map(|(sum, own)| sum + own);
        nis += product.quality.nis * product.quality.epochs_used as f64;
        epochs += product.quality.epochs_used as f64;
        let listed = figures.and_then(|f| f.get("channels")).and_then(toml::Value::as_array);
        for channel in listed.into_iter().flatten().filter_map(toml::Value::as_table) {
            let name = channel.get("channel").and_then(toml::Value::as_str).unwrap_or_default();
            let (weight, power) = (float(channel, "dof"), float(channel, "measured_over_modelled").powi(2));
            match channels.iter_mut().find(|(known, ..)| known == name) {
                Some((_, sum, weights)) => (*sum, *weights) = (*sum + weight * power, *weights + weight),
                None => channels.push((name.to_owned(), weight * power, weight)),
            }
        }
    }
    let channel = |(channel, sum, weight): (String, f64, f64)| {
        let chi2_per_dof = sum / weight;
        Channel { channel, chi2_per_dof, rms: chi2_per_dof.sqrt() }
    };
    Fit {
        chi2,
        log_determinant,
        declared_log_determinant,
        dof,
        chi2_per_dof: chi2 / dof,
        rms: (chi2 / dof).sqrt(),
        nis: nis / epochs,
        channels: channels.into_iter().map(channel).collect(),
    }
}

/// Fall of χ² between two fits of the same days; `None`, with a note, where they do not weigh the same channels.
fn fall(before: &Fit, after: &Fit, who: &str, notes: &mut Vec<String>) -> Option<Fall> {
    let names = |fit: &Fit| fit.channels.iter().map(|c| c.channel.clone()).collect::<Vec<_>>();
    if names(before) != names(after) {
        notes.push(format!("revisions {who} do not weigh the same channels, so their χ² cannot be compared"));
        return None;
    }
    // A lag or a gap of a new column takes epochs away: per observation times observations, and what the others may
    // hold.
    let apart = (before.dof - after.dof).abs();
    let uncertainty = if apart < 1e-6 * after.dof { 0.0 } else { (2.0 * apart).sqrt() };
    if uncertainty > 0.0 {
        notes.push(format!(
            "revisions {who} weigh {:.0} and {:.0} observations: the fall of χ² is uncertain by {uncertainty:.0}",
            before.dof, after.dof
        ));
    }
    let [Some(earlier), Some(later)] = [before, after].map(|fit| fit.declared_log_determinant) else {
        notes.push(format!(
            "revisions {who} are of different missions, and the sums beside a product, `.neq.json`, are not there or are \
             of a part of it: without them the likelihoods under two declarations of noise cannot be compared"
        ));
        return None;
    };
    let determinants = |fit: &Fit, declared: f64| (fit.log_determinant + declared) / fit.dof;
    let fall = before.chi2_per_dof - after.chi2_per_dof + (determinants(before, earlier) - determinants(after, later));
    let delta_chi2 = fall * after.dof;
    if before.log_determinant != after.log_determinant || earlier != later {
        notes.push(format!(
            "revisions {who} have different noise: what falls is −2 log of the likelihood, χ² plus log det Σ"
        ));
    }
    delta_chi2.is_finite().then_some(Fall { delta_chi2, uncertainty })
}

/// The revision that a held-out product belongs to.
fn held_out_of(
    product: &Product,
    of: &BTreeMap<String, Days<'_>>,
    days: &[Window],
    labels: &Labels,
) -> Result<String, LadderError> {
    let refuse = |why: String| LadderError::HeldOut { id: product.id().to_owned(), why };
    let fixed = "`dragfree model fix MODEL.toml --from PRODUCT` writes the model to run it with";
    if of.contains_key(&labels.of(product)) {
        return Err(refuse(format!(
            "it was made with revision {} itself, which estimates its coefficients; {fixed}",
            product.model.revision
        )));
    }
    let parent = product.model.parent.as_ref().map(|parent| labels.with(product, parent));
    let Some((revision, _)) = parent.and_then(|p| of.get_key_value(&p)) else {
        let known: Vec<&str> = of.keys().map(String::as_str).collect();
        return Err(refuse(format!(
            "its model {} is no child of a revision of the ladder ({}); {fixed}",
            product.model.revision,
            known.join(", ")
        )));
    };
    let own = window(product);
    if let Some(seen) = days.iter().find(|d| d.start_ns <= own.stop_ns && own.start_ns <= d.stop_ns) {
        return Err(refuse(format!("the fit has seen {} already; take another stretch of data", seen.day)));
    }
    Ok(revision.clone())
}

fn held_out_fit(
    own: &Days<'_>,
    before: Option<(&String, &Days<'_>)>,
    (revision, added, sigmas): (&str, bool, f64),
    declared: &dyn Fn(&Product) -> Option<f64>,
    notes: &mut Vec<String>,
) -> HeldOut {
    let names = |days: &Days<'_>| {
        let all = days.values().flat_map(|p| p.result.adopted()).map(|c| c.name.clone());
        all.collect::<BTreeSet<_>>()
    };
    let fall = before.and_then(|(parent, theirs)| {
        let both: Vec<&Window> = own.keys().filter(|w| theirs.contains_key(*w)).collect();
        if both.is_empty() {
            notes.push(format!("revisions {parent} and {revision} have no held-out day in common"));
            return None;
        }
        // What is estimated anew on one side only would lower χ² there whatever the added effect does.
        if names(own) != names(theirs) {
            notes.push(format!(
                "the held-out products of revisions {parent} and {revision} do not leave the same coefficients free, so they cannot \
                 be compared: give `dragfree model fix` the same --keep"
            ));
            return None;
        }
        let of = |days: &Days<'_>| fit(both.iter().map(|w| days[*w]), declared);
        fall(&of(theirs), &of(own), &format!("{parent} and {revision}, held out,"), notes)
    });
    let verdict = fall.filter(|_| added).map(|fall| match fall.delta_chi2 {
        delta if delta.abs() < sigmas * fall.uncertainty => Verdict::Undecided,
        delta if delta > 0.0 => Verdict::Helps,
        _ => Verdict::OverFitted,
    });
    HeldOut {
        products: own.values().map(|p| p.id().to_owned()).collect(),
        days: own.keys().cloned().collect(),
        fit: fit(own.values().copied(), declared),
        fall,
        verdict,
    }
}

/// Coefficients over the days, beside those of the compared revision and the truth.
fn values(days: &Days<'_>, before: Option<&Rung>, truth: &dyn Fn(&str) -> Option<f64>) -> Vec<Value> {
    let all: Vec<&Coefficient> = days.values().flat_map(|p| p.result.adopted()).collect();
    let mut seen = BTreeSet::new();
    let names: Vec<&Coefficient> = all.iter().copied().filter(|c| seen.insert(&c.name)).collect();
    let mean = |name: &str| {
        let of: Vec<&&Coefficient> = all.iter().filter(|c| c.name == name).collect();
        if let [one] = of[..] {
            return (one.value, one.sigma);
        }
        let (mut sum, mut weights) = (0.0, 0.0);
        for c in of.iter().filter(|c| c.value.is_finite() && c.sigma > 0.0) {
            let weight = c.sigma.powi(-2);
            (sum, weights) = (sum + weight * c.value, weights + weight);
        }
        (sum / weights, weights.sqrt().recip())
    };
    let over = |difference: f64, sigma: f64| (sigma > 0.0 && difference.is_finite()).then(|| difference / sigma);
    names
        .into_iter()
        .map(|c| {
            let (value, sigma) = mean(&c.name);
            let earlier = before.and_then(|b| b.coefficients.iter().find(|e| e.name == c.name));
            let truth = truth(&c.name);
            let error = truth.map(|truth| value - truth);
            Value {
                name: c.name.clone(),
                value,
                sigma,
                unit: c.unit.clone(),
                frame: c.frame.clone(),
                change_sigmas: earlier.and_then(|e| over(value - e.value, sigma)),
                truth,
                error,
                error_sigmas: error.and_then(|error| over(error, sigma)),
            }
        })
        .collect()
}

#[cfg(test)]
mod tests;
