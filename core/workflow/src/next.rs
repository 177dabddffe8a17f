//! What would tell a named effect from what it cannot be told from, and what would limit an effect that is hardly
//! limited: more data, products of the archive, or a small manoeuvre, each with the σ that is expected.
//!
//! All of it follows from the information matrix of the last pass of a diagnosis, with the noise and the values that it
//! found: no data of the future are needed.

use dragfree_archive::Written;
use dragfree_engine::run::Progress;
use dragfree_engine::sources::Sources;
use dragfree_identification::diagnosis::SEPARATED_CHI2;
use dragfree_identification::innovations::decision::Quadratic;
use nalgebra::DVector;
use serde::Serialize;

mod flights;

use flights::{AUTHORITY, Catalogue, Flight};

use crate::WorkflowError;
use crate::diagnose::Diagnosed;
use crate::likelihood::{Decided, Experiment, Meaning, Settled, information};
use crate::replay::{Pass, Replay};

/// Shortest manoeuvre, s, and fewest periods of it.
const SHORTEST_S: f64 = 300.0;
const FEWEST_PERIODS: f64 = 2.0;
/// Part of a run that a manoeuvre may take.
const MOST_OF_A_RUN: f64 = 0.5;
/// Length of data over that of these from which on it is no advice.
pub const LONGEST: f64 = 1000.0;
/// Most effects with a wide limit for which a manoeuvre is looked for.
const MOST_LIMITS: usize = 3;
/// Length of a stretch by which it is told where the information of the data lies, s.
const STRETCH_S: f64 = 3600.0;

/// What would tell more.
#[derive(Clone, Debug, Serialize)]
pub struct Next {
    /// Length of the run for which a manoeuvre is planned, that of the last product, h.
    pub run_hours: f64,
    /// Largest part of the limits of actuators and readouts that a manoeuvre takes.
    pub authority: f64,
    /// For each named effect and each other effect that it cannot be told from.
    pub separations: Vec<Advice>,
    /// For effects of which the data do not exclude the largest physical size.
    pub limits: Vec<LimitAdvice>,
    /// Why no manoeuvre could be planned at all.
    pub no_manoeuvre: Option<String>,
}

/// What would tell an effect from another.
#[derive(Clone, Debug, Serialize)]
pub struct Advice {
    /// The named effect, `EFFECT:INSTANCE`.
    pub effect: String,
    /// The other.
    pub from: String,
    /// What these data tell, σ: root of the χ² by which the other in its place is expected to be worse.
    pub now_sigma: f64,
    /// More data like these; none where no length of them would do.
    pub data: Option<MoreData>,
    /// Products of the archive that are not in this diagnosis.
    pub archive: OfArchive,
    /// Which hours of these data carry the separation.
    pub hours: Vec<Hour>,
    /// The shortest manoeuvre of the catalogue that tells them apart within a run.
    pub manoeuvre: Option<Planned>,
}

/// How long data like these must be.
#[derive(Clone, Debug, Serialize)]
pub struct MoreData {
    /// Length over that of these data.
    pub times: f64,
    /// Length, h.
    pub hours: f64,
    /// σ of the coefficients of both effects.
    pub coefficients: Vec<Expected>,
}

/// What further products of the archive are expected to tell.
#[derive(Clone, Debug, Default, Serialize)]
pub struct OfArchive {
    /// Products of the same spacecraft and model whose inputs are at hand, until they suffice.
    pub products: Vec<String>,
    /// Their data that were used, h.
    pub hours: f64,
    /// σ that is expected of these data with them, if they tell as much an hour as these.
    pub expected_sigma: f64,
    /// Whether that is five.
    pub enough: bool,
}

/// Part of the data in a separation.
#[derive(Clone, Debug, Serialize)]
pub struct Hour {
    /// Product.
    pub product: String,
    /// Begin, Unix ns of the product's time scale.
    pub from_ns: i64,
    /// Part of χ².
    pub chi2: f64,
}

/// A coefficient as a diagnosis would tell it.
#[derive(Clone, Debug, Serialize)]
pub struct Expected {
    /// Coefficient.
    pub name: String,
    /// Unit.
    pub unit: String,
    /// σ of it now.
    pub sigma_now: f64,
    /// σ that is expected.
    pub sigma_expected: f64,
}

/// A manoeuvre in a run as long as the last product.
#[derive(Clone, Debug, Serialize)]
pub struct Planned {
    /// Actuator: `sc.x` is thrust, `sc.phi` torque of the thrusters, `NAME.y` force of the electrodes.
    pub input: String,
    /// Amplitude of the command.
    pub amplitude: f64,
    /// `N` or `N m`.
    pub unit: String,
    /// Frequency, Hz.
    pub frequency_hz: f64,
    /// Length, s, a whole number of periods.
    pub duration_s: f64,
    /// By how many σ the effects are expected to be told apart in such a run alone, or the largest size excluded.
    pub expected_sigma: f64,
    /// σ of the coefficients in a run like the last product alone: without the manoeuvre, and with it.
    pub coefficients: Vec<Expected>,
    /// The manoeuvre as `dragfree simulate` flies it in the middle of such a run.
    pub simulate: String,
}

/// What would limit an effect.
#[derive(Clone, Debug, Serialize)]
pub struct LimitAdvice {
    /// Effect, `EFFECT:INSTANCE`.
    pub effect: String,
    /// Coefficient.
    pub coefficient: String,
    /// Largest physical size.
    pub largest: f64,
    /// σ of it now.
    pub sigma_now: f64,
    /// The shortest manoeuvre that shows the largest size at five σ.
    pub manoeuvre: Option<Planned>,
}

/// What would tell more than a diagnosis; `others` are further products of the archive, of any model.
///
/// # Errors
/// As a replay.
pub fn next(
    replay: &Replay<'_>,
    diagnosed: &Diagnosed,
    others: &[Written],
    progress: &mut dyn FnMut(Pass, usize, Progress),
) -> Result<Next, WorkflowError> {
    let ask = Ask::new(replay, diagnosed);
    let (pairs, limited) = (ask.pairs(), ask.limited());
    let mut next = Next {
        run_hours: ask.run_s / 3600.0,
        authority: AUTHORITY,
        separations: Vec::new(),
        limits: Vec::new(),
        no_manoeuvre: None,
    };
    if pairs.is_empty() && limited.is_empty() {
        return Ok(next);
    }
    let catalogue = match Catalogue::new(replay, ask.end, replay.products.len() - 1, progress) {
        Err(WorkflowError::Mission(reason)) => {
            next.no_manoeuvre = Some(reason.to_string());
            None
        }
        catalogue => Some(catalogue?),
    };
    let catalogue = catalogue.as_ref();
    let hours = if pairs.is_empty() { Vec::new() } else { ask.hours(&pairs, progress)? };
    let archive = usable(replay, others);
    for (pair, hours) in pairs.iter().zip(hours) {
        next.separations.push(ask.separation(*pair, hours, &archive, catalogue));
    }
    next.limits = limited.into_iter().map(|one| ask.limit(one, catalogue)).collect();
    Ok(next)
}

/// Products of the same spacecraft and model as a replay's that are none of its own and whose inputs are at hand, with
/// the length of what was used, h.
fn usable(replay: &Replay<'_>, others: &[Written]) -> Vec<(String, f64)> {
    let Some(Written { product, .. }) = replay.products.first() else { return Vec::new() };
    let platform = &product.header.global_attributes.platform;
    let fits = |w: &&Written| {
        let other = &w.product;
        let known = replay.products.iter().any(|own| own.product.id() == other.id());
        let alike =
            other.model.revision == product.model.revision && other.header.global_attributes.platform == *platform;
        let at_hand = Sources::of(&w.path).is_ok_and(|s| s.telemetry.iter().all(|file| file.is_file()));
        !known && alike && at_hand
    };
    others.iter().filter(fits).map(|w| (w.product.id().to_owned(), used_s(w) / 3600.0)).collect()
}

/// Length of a product, s.
fn length_s(written: &Written) -> f64 {
    let times = &written.product.header.non_standard_attributes;
    1e-9 * (times.stop_time_epoch_ns - times.start_time_epoch_ns) as f64
}

/// Length of the data of a product that were used, s.
fn used_s(written: &Written) -> f64 {
    let quality = &written.product.quality;
    let (used, not) = (quality.epochs_used as f64, quality.epochs_rejected as f64);
    length_s(written) * used / (used + not).max(1.0)
}

/// Two candidates, by their numbers in the decision: the named one and another.
type Pair = (usize, usize);

/// A diagnosis, and what is asked of it.
struct Ask<'a> {
    replay: &'a Replay<'a>,
    end: &'a Settled,
    decided: &'a Decided,
    /// The likelihood of the last product alone.
    run: &'a Quadratic,
    /// Length of the last product, s.
    run_s: f64,
    /// Named candidates.
    set: Vec<usize>,
    /// Probability from which another explanation counts.
    least: f64,
}

impl<'a> Ask<'a> {
    fn new(replay: &'a Replay<'a>, diagnosed: &'a Diagnosed) -> Self {
        let end = &diagnosed.end;
        let decided = &end.decided;
        Self {
            replay,
            end,
            decided,
            run: decided.by_product.last().unwrap_or(&decided.quadratic),
            run_s: replay.products.last().map_or(0.0, length_s),
            set: decided.selection.chosen.iter().map(|f| f.candidate).collect(),
            least: diagnosed.settings.false_alarm,
        }
    }

    fn values(&self) -> &DVector<f64> {
        &self.decided.selection.values
    }

    fn name(&self, candidate: usize) -> String {
        self.decided.candidates[candidate].name()
    }

    /// Named effects, each with all that it cannot be told from.
    fn pairs(&self) -> Vec<Pair> {
        let of = |f: &dragfree_identification::innovations::decision::Fitted| -> Vec<Pair> {
            let likely = f.alternatives.iter().filter(|(_, p)| *p > self.least);
            likely.map(|(other, _)| (f.candidate, *other)).collect()
        };
        self.decided.selection.chosen.iter().flat_map(of).collect()
    }

    /// Effects that are not named and whose largest physical size, which comes with them, is below five σ, the least
    /// limited first.
    fn limited(&self) -> Vec<(usize, f64)> {
        let excess =
            |(candidate, largest): (usize, f64)| largest / self.decided.quadratic.sigma(candidate, &self.set)[0];
        let rest = self.decided.selection.rest.iter().map(|f| f.candidate);
        let mut all: Vec<(usize, f64)> = rest.filter_map(|c| Some((c, self.largest(c)?))).collect();
        all.retain(|one| excess(*one).powi(2) < SEPARATED_CHI2);
        all.sort_by(|a, b| excess(*a).total_cmp(&excess(*b)));
        all.truncate(MOST_LIMITS);
        all
    }

    /// The largest size of the only coefficient of a candidate; nothing of an effect of several coefficients or none.
    fn largest(&self, candidate: usize) -> Option<f64> {
        let [own] = self.decided.candidates[candidate].parameters[..] else { return None };
        let Meaning::Coefficient(c) = &self.decided.parameters[own].1 else { return None };
        let largest = c.upper.abs().max(c.lower.abs());
        (largest.is_finite() && largest > 0.0).then_some(largest)
    }

    /// σ of the coefficients of some candidates now and as expected, each beside what is named.
    fn expected(&self, candidates: &[usize], now: &Quadratic, then: &Quadratic) -> Vec<Expected> {
        let of = |candidate: &usize| {
            let sigma = [now, then].map(|quadratic| quadratic.sigma(*candidate, &self.set));
            let own = self.decided.candidates[*candidate].parameters.clone().into_iter().enumerate();
            own.filter_map(move |(k, i)| {
                let (name, Meaning::Coefficient(c)) = &self.decided.parameters[i] else { return None };
                let (name, unit) = (name.clone(), c.unit.clone());
                Some(Expected { name, unit, sigma_now: sigma[0][k], sigma_expected: sigma[1][k] })
            })
        };
        candidates.iter().flat_map(of).collect()
    }

    fn separation(
        &self,
        pair: Pair,
        hours: Vec<Hour>,
        archive: &[(String, f64)],
        catalogue: Option<&Catalogue>,
    ) -> Advice {
        let (effect, from) = pair;
        let chi2 = self.decided.quadratic.separation(effect, from, &self.set);
        let goal = |then: &Quadratic| then.separation(effect, from, &self.set);
        Advice {
            effect: self.name(effect),
            from: self.name(from),
            now_sigma: chi2.sqrt(),
            data: self.more_data(pair, chi2),
            archive: of_archive(archive, chi2, self.hours_used()),
            hours,
            manoeuvre: catalogue.and_then(|c| self.shortest(c, &[effect, from], &goal)),
        }
    }

    /// Length of the data of all products, h.
    fn hours_used(&self) -> f64 {
        self.replay.products.iter().map(used_s).sum::<f64>() / 3600.0
    }

    fn more_data(&self, (effect, from): Pair, chi2: f64) -> Option<MoreData> {
        let times = (SEPARATED_CHI2 / chi2.max(f64::MIN_POSITIVE)).max(1.0);
        let now = &self.decided.quadratic;
        (times < LONGEST).then(|| MoreData {
            times,
            hours: times * self.hours_used(),
            coefficients: self.expected(&[effect, from], now, &now.of_length(times, self.values())),
        })
    }

    fn limit(&self, (candidate, largest): (usize, f64), catalogue: Option<&Catalogue>) -> LimitAdvice {
        let sigma = |quadratic: &Quadratic| quadratic.sigma(candidate, &self.set)[0];
        let goal = |then: &Quadratic| (largest / sigma(then)).powi(2);
        LimitAdvice {
            effect: self.name(candidate),
            coefficient: self.decided.parameters[self.decided.candidates[candidate].parameters[0]].0.clone(),
            largest,
            sigma_now: sigma(&self.decided.quadratic),
            manoeuvre: catalogue.and_then(|c| self.shortest(c, &[candidate], &goal)),
        }
    }

    /// The run with a manoeuvre of some length.
    fn with(&self, flight: &Flight, duration_s: f64) -> Quadratic {
        self.run.expected(&(&flight.per_second * duration_s), self.values())
    }

    /// The shortest manoeuvre with which χ² by the goal reaches five σ; of several as short the one of the largest.
    fn shortest(
        &self,
        catalogue: &Catalogue,
        candidates: &[usize],
        goal: &dyn Fn(&Quadratic) -> f64,
    ) -> Option<Planned> {
        let mut best: Option<(f64, f64, &Flight)> = None;
        for flight in &catalogue.flights {
            let longest_s = best.map_or(MOST_OF_A_RUN * self.run_s, |(duration_s, ..)| duration_s);
            let Some((duration_s, chi2)) = self.least_periods(flight, longest_s, goal) else { continue };
            if best.is_none_or(|(best_s, best_chi2, _)| duration_s < best_s || chi2 > best_chi2) {
                best = Some((duration_s, chi2, flight));
            }
        }
        let (duration_s, chi2, flight) = best?;
        Some(self.planned(catalogue, flight, duration_s, chi2, candidates))
    }

    /// The shortest length of a manoeuvre, in whole periods, that reaches five σ, and χ² then; nothing if the longest
    /// that is allowed does not.
    fn least_periods(&self, flight: &Flight, longest_s: f64, goal: &dyn Fn(&Quadratic) -> f64) -> Option<(f64, f64)> {
        let period_s = flight.frequency_hz.recip();
        let reached = |periods: f64| goal(&self.with(flight, periods * period_s));
        let mut enough = (longest_s / period_s + 1e-9).floor();
        let mut least = (SHORTEST_S / period_s).ceil().max(FEWEST_PERIODS);
        if enough < least || reached(enough) < SEPARATED_CHI2 {
            return None;
        }
        while least < enough {
            let middle = ((least + enough) / 2.0).floor();
            if reached(middle) < SEPARATED_CHI2 {
                least = middle + 1.0;
            } else {
                enough = middle;
            }
        }
        Some((enough * period_s, reached(enough)))
    }

    fn planned(
        &self,
        catalogue: &Catalogue,
        flight: &Flight,
        duration_s: f64,
        chi2: f64,
        candidates: &[usize],
    ) -> Planned {
        let Flight { input, amplitude, frequency_hz, .. } = *flight;
        let input_name = input.name(&catalogue.mission);
        let from_s = (0.5 * (self.run_s - duration_s)).round();
        let times = format!("from_s={from_s},until_s={}", from_s + duration_s);
        Planned {
            simulate: format!("--manoeuvre {input_name}={amplitude:e},frequency_hz={frequency_hz},{times}"),
            input: input_name,
            amplitude,
            unit: input.unit().to_owned(),
            frequency_hz,
            duration_s,
            expected_sigma: chi2.sqrt(),
            coefficients: self.expected(candidates, self.run, &self.with(flight, duration_s)),
        }
    }

    /// The part of every hour of the data in the separation of each pair.
    fn hours(
        &self,
        pairs: &[Pair],
        progress: &mut dyn FnMut(Pass, usize, Progress),
    ) -> Result<Vec<Vec<Hour>>, WorkflowError> {
        let contrast = |(effect, from): &Pair| self.decided.quadratic.contrast(*effect, *from, &self.set);
        let contrasts: Vec<DVector<f64>> = pairs.iter().map(contrast).collect();
        let mut hours: Vec<Vec<Hour>> = vec![Vec::new(); pairs.len()];
        for (number, written) in self.replay.products.iter().enumerate() {
            let sources = Sources::of(&written.path)?;
            let experiment = Experiment { number, sources: &sources, altered: None, means: None, block_s: STRETCH_S };
            let (blocks, _) = information(self.replay, self.end, &self.end.chosen, &experiment, progress)?;
            for (hours, w) in hours.iter_mut().zip(&contrasts) {
                hours.extend(blocks.iter().map(|block| Hour {
                    product: written.product.id().to_owned(),
                    from_ns: block.first_ns,
                    chi2: w.dot(&(&block.information * w)).max(0.0),
                }));
            }
        }
        Ok(hours)
    }
}

/// The first products of an archive that suffice, if an hour of them tells as much as one of the data at hand.
fn of_archive(archive: &[(String, f64)], chi2: f64, hours: f64) -> OfArchive {
    let per_hour = chi2 / hours.max(f64::MIN_POSITIVE);
    let mut all = OfArchive { expected_sigma: chi2.sqrt(), enough: chi2 >= SEPARATED_CHI2, ..OfArchive::default() };
    for (id, hours) in archive {
        if all.enough {
            break;
        }
        all.products.push(id.clone());
        all.hours += hours;
        let with = chi2 + per_hour * all.hours;
        (all.expected_sigma, all.enough) = (with.sqrt(), with >= SEPARATED_CHI2);
    }
    all
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn products_of_the_archive_are_taken_until_they_suffice() {
        let archive = [("A", 2.0), ("B", 3.0), ("C", 6.0)].map(|(id, hours)| (id.to_owned(), hours));
        // 3σ in 3 h: 3 a hour, so that 25 needs 8 1/3 h.
        let all = of_archive(&archive, 9.0, 3.0);
        assert_eq!(all.products, ["A", "B", "C"]);
        assert!(all.enough && (all.expected_sigma.powi(2) - 42.0).abs() < 1e-9 && all.hours == 11.0, "{all:?}");
        let all = of_archive(&archive[..2], 9.0, 3.0);
        assert!(!all.enough && (all.expected_sigma.powi(2) - 24.0).abs() < 1e-9, "{all:?}");
        assert!(of_archive(&archive, 36.0, 3.0).products.is_empty());
    }
}
