//! Transients near the ends of the data and of gaps, before any effect is weighed.

use dragfree_archive::Written;
use dragfree_engine::chain::Chain;
use dragfree_engine::examine::{Examination, candidates, examine, has_parameter};
use dragfree_engine::run::Progress;
use dragfree_engine::sources::Sources;
use dragfree_identification::innovations::decision::{Candidate, Quadratic};
use dragfree_identification::transient::{Detection, PROFILE_S, Template, Transients, is_one_transient};
use dragfree_identification::waveform::Waveform;
use dragfree_schema::{AT_NS, PREDICTION_NEED};

use super::pass::{At, Filtered, Placed};
use super::{How, Judge, Point, one_pass, step};
use crate::WorkflowError;
use crate::replay::{Pass, Replay, noise_levels};

/// A decision among no candidates.
struct NoCandidates;

impl Judge for NoCandidates {
    fn log10_p(&self, _: &str, _: f64, _: usize) -> f64 {
        0.0
    }

    fn ln_prior(&self, _: &str, _: &str, _: &str) -> f64 {
        0.0
    }
}

/// Puts transients near the ends of the data of all products, as the innovations of the model show them, in the place
/// of those that the spectra show there. Returns them alone.
///
/// # Errors
/// As a pass of the likelihood.
pub(crate) fn transients_near_ends(
    replay: &Replay<'_>,
    by_spectra: &mut Transients,
    progress: &mut dyn FnMut(Pass, usize, Progress),
) -> Result<Transients, WorkflowError> {
    let settings = replay.settings()?;
    let adopted = replay.products.iter().flat_map(|p| p.product.result.adopted());
    let start = Point::at(adopted.map(|c| (c.name.clone(), c.value)).collect());
    // Constants are many σ of the noise, and a filter would take them for transients.
    let opening = one_pass(replay, &[], &[], How::Opening, &start, &NoCandidates, progress)?;
    let point = step(&start, &opening);
    let mut found = Transients::default();
    for number in 0..replay.products.len() {
        let mut filtered = pass(replay, number, &point, &[], true, progress)?;
        let (transients, windows) = filtered.innovations.transients();
        by_spectra.detections.retain(|d| windows.iter().all(|w| !w.contains(&d.at_ns)));
        let chance = settings.transient_p_value;
        let trials = Transients { detections: Vec::new(), tried: by_spectra.tried + transients.tried };
        let certain = |d: &&Detection| trials.p_value(d) < chance;
        let lasts = |d: &&Detection| template(&filtered.templates, d).is_some_and(|t| t.kernel.len() > 1);
        let events = transients.detections.iter().filter(certain).filter(lasts).cloned().collect();
        let refined = refine(replay, number, &point, (&filtered.templates, filtered.rate_hz), events, progress)?;
        let mut detections: Vec<Detection> =
            transients.detections.iter().filter(|d| !(certain(d) && lasts(d))).cloned().collect();
        detections.extend(refined);
        found.add(&Transients { detections, ..transients });
    }
    by_spectra.add(&found);
    Ok(found)
}

/// A pass over a product that fits constants and the model, with waveforms beside them.
fn pass(
    replay: &Replay<'_>,
    number: usize,
    point: &Point,
    waveforms: &[Placed],
    search: bool,
    progress: &mut dyn FnMut(Pass, usize, Progress),
) -> Result<Filtered, WorkflowError> {
    let Written { product, path } = replay.products.get(number).ok_or(WorkflowError::NoProduct)?;
    let sources = Sources::of(path)?;
    let mut events = candidates(replay.registry, &sources)?;
    events.retain(|e| search && has_parameter(replay.registry, &e.id, AT_NS));
    let examination = Examination {
        product,
        sources: &sources,
        candidates: events,
        chosen: Vec::new(),
        needs: &[PREDICTION_NEED],
        values: &noise_levels(replay.products),
        altered: None,
        recordings: Some(&replay.recordings),
        threads: replay.threads,
        batch_rows: replay.batch_rows,
    };
    let settings = replay.settings()?;
    let at = At { point, slow: &[], opening: true, number, block_s: None, data: true, search, waveforms };
    let link = |chain: &Chain| Filtered::link(chain, at, settings, replay.threads);
    let (filtered, _) = examine(replay.registry, &examination, link, &mut |p| progress(Pass::Transients, number, p))?;
    Ok(filtered)
}

fn template<'a>(templates: &'a [Template], d: &Detection) -> Option<&'a Template> {
    let place = |t: &&Template| (&t.effect, &t.instance, &t.coefficient) == (&d.effect, &d.instance, &d.coefficient);
    let form = |t: &&Template| t.shape.iter().all(|(key, value)| d.shape.get(key) == Some(value));
    templates.iter().find(|t| place(t) && form(t))
}

/// Mean time of a waveform after its begin, samples.
fn centre(kernel: &[f64]) -> f64 {
    let sum: f64 = kernel.iter().sum();
    kernel.iter().enumerate().map(|(k, x)| k as f64 * x).sum::<f64>() / sum
}

/// Times and courses of detections by their likelihoods, with constants, starts and the model fitted beside each: near
/// an end a matched filter alone has the wrong time, as these can follow a part of the transient. The course is that of
/// the likeliest place, as all of them are about one transient.
fn refine(
    replay: &Replay<'_>,
    number: usize,
    point: &Point,
    (templates, rate_hz): (&[Template], f64),
    mut events: Vec<Detection>,
    progress: &mut dyn FnMut(Pass, usize, Progress),
) -> Result<Vec<Detection>, WorkflowError> {
    let step_ns = (1e9 / rate_hz).round() as i64;
    // Samples, so that the waveform and the effect agree.
    let moved = |d: &Detection, by_s: f64| d.moved((by_s * rate_hz).round() as i64 * step_ns);
    for stage in [Stage::Times(COARSE_S), Stage::Courses, Stage::Times(FINE_S)] {
        let mut trials: Vec<(usize, Detection)> = Vec::new();
        for (i, event) in events.iter().enumerate() {
            let Some(own) = template(templates, event) else { continue };
            match stage {
                Stage::Times(step_s) => {
                    trials.extend((-STEPS..=STEPS).map(|k| (i, moved(event, f64::from(k) * step_s))));
                }
                Stage::Courses => {
                    let same = |t: &&Template| t.coefficient == own.coefficient && t.kernel.len() > 1;
                    let begin = |t: &Template| (centre(&own.kernel) - centre(&t.kernel)) / rate_hz;
                    let course = |t: &Template| (i, moved(&event.of_course(&t.shape), begin(t)));
                    trials.extend(templates.iter().filter(same).map(course));
                }
            }
        }
        if trials.is_empty() {
            break;
        }
        let placed = |(_, d): &(usize, Detection)| {
            let t = template(templates, d)?;
            let channels = t.channels.iter().map(|(channel, factor, _)| (*channel, *factor)).collect();
            Some(Placed { waveform: Waveform { at_ns: d.at_ns, step_ns, kernel: t.kernel.clone() }, channels })
        };
        let waveforms: Vec<Placed> = trials.iter().filter_map(placed).collect();
        let filtered = pass(replay, number, point, &waveforms, false, progress)?;
        let gains = gains(filtered, waveforms.len());
        let best: Vec<usize> = (0..events.len())
            .filter_map(|i| {
                let own = (0..trials.len()).filter(|k| trials[*k].0 == i);
                own.max_by(|a, b| gains[*a].total_cmp(&gains[*b]))
            })
            .collect();
        for k in &best {
            let (i, trial) = &trials[*k];
            events[*i] = trial.clone();
            let neighbour = |k: usize| trials.get(k).filter(|(other, _)| other == i).map(|_| gains[k]);
            if let (Stage::Times(step_s), Some(before), Some(after)) =
                (stage, k.checked_sub(1).and_then(neighbour), neighbour(k + 1))
            {
                // The vertex of the parabola through three times.
                let bend = before - 2.0 * gains[*k] + after;
                let by_s = if bend < 0.0 { 0.5 * step_s * (before - after) / bend } else { 0.0 };
                events[*i] = moved(&events[*i], by_s);
            }
        }
        if matches!(stage, Stage::Courses) {
            of_the_likeliest(&mut events, &best, &gains, templates, step_ns);
        }
    }
    Ok(events)
}

/// What is varied.
#[derive(Clone, Copy)]
enum Stage {
    /// Begins, in steps of so many seconds.
    Times(f64),
    /// Courses, with the mean time as it is.
    Courses,
}

/// Steps of the time to each side.
const STEPS: i32 = 4;
/// A search near an end may miss the time by some minutes.
const COARSE_S: f64 = 40.0;
/// The parabola leaves a small part of this.
const FINE_S: f64 = 10.0;

/// Gives detections of one transient the course of the likeliest of them.
fn of_the_likeliest(events: &mut [Detection], best: &[usize], gains: &[f64], templates: &[Template], step_ns: i64) {
    let known = events.to_vec();
    for event in events {
        let near = |d: &Detection| is_one_transient(d.at_ns, event.at_ns, PROFILE_S);
        let all = known.iter().zip(best).filter(|(d, _)| near(d));
        let Some((likeliest, _)) = all.max_by(|a, b| gains[*a.1].total_cmp(&gains[*b.1])) else { continue };
        let (Some(own), Some(other)) = (template(templates, event), template(templates, likeliest)) else { continue };
        let by = (centre(&own.kernel) - centre(&other.kernel)).round() as i64;
        *event = event.of_course(&other.shape).moved(by * step_ns);
    }
}

/// Twice the gain in the logarithm of the likelihood of each of the last parameters of a pass by itself.
fn gains(filtered: Filtered, waveforms: usize) -> Vec<f64> {
    let all = filtered.parameters.len();
    let sums = filtered.innovations.finish().total();
    let candidate = |i: usize| Candidate { shaped: true, ..Candidate::free(i) };
    let quadratic = Quadratic::new(&sums, &vec![0.0; all], &[], (all - waveforms..all).map(candidate).collect());
    (0..waveforms).map(|k| quadratic.beside(k, &[]).gain).collect()
}
