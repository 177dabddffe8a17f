//! `dragfree diagnose`: the data of products once more, with every effect that is not in the model.

use super::Done;
use crate::args::{BATCH_ROWS, Diagnose, Global};
use crate::failure::Failure;
use crate::progress::Meter;
use crate::text::Paint;
use chrono::DateTime;
use dragfree_engine::examine::{Examination, Sources, candidates, examine, has_parameter, model};
use dragfree_estimation::sigma::{Measured, NoiseModel};
use dragfree_identification::diagnosis::{Diagnosis, Found, RefinementRequest, diagnose};
use dragfree_identification::record::Record;
use dragfree_identification::scores::CandidateScorer;
use dragfree_identification::transient::Detection;
use dragfree_physics::mission::Mission;
use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::io::Write as _;
use std::path::{Path, PathBuf};

/// Parameter of an effect whose candidate can be tried about one shape in fine steps.
const FINE: &str = "fine";

/// Of what happened transient, as much is weighed against all else.
const MOST_EVENTS: usize = 8;

/// And no less than what chance gives in one of so many searches: which of it is certain, its full weight decides.
const WORTH_TRYING: f64 = 0.5;

/// What is seen within this of something louder is its ringing in another window, ns.
const SAME_EVENT_NS: i64 = 3_600_000_000_000;

pub(super) fn execute(command: &Diagnose, global: &Global, paint: Paint) -> Result<Done, Failure> {
    let Gathering { record, mut diagnosis } = gather_candidates(&command.products, &command.archive.folder, global)?;
    if let Some(path) = &command.save_sums {
        let file = std::fs::File::create(path).map_err(Failure::io("write", path))?;
        let mut file = std::io::BufWriter::with_capacity(1 << 20, file);
        record.write(&mut file).and_then(|()| file.flush()).map_err(Failure::io("write", path))?;
    }
    diagnosis.not_tried.extend(record.not_tried.iter().cloned());
    if global.json {
        return Ok(Done::json(&serde_json::to_value(&diagnosis).map_err(Failure::engine)?));
    }
    Ok(Done::new(screen(&diagnosis, &record, command.top, paint)))
}

/// The verdict on what was gathered; `tried_before` as [`diagnose`] takes it.
fn judge(record: &Record, mission: &Mission, tried_before: &BTreeMap<String, usize>) -> Result<Diagnosis, Failure> {
    let noise = noise(record, mission)?;
    diagnose(&CandidateScorer::new(&record.candidate_set, &record.gathered, &noise), tried_before)
        .map_err(Failure::engine)
}

pub(super) fn noise(record: &Record, mission: &Mission) -> Result<NoiseModel, Failure> {
    let measured = |d: &bool| if *d { Measured::Differenced } else { Measured::Directly };
    let channels: Vec<(&str, Measured)> =
        record.candidate_set.channels.iter().map(String::as_str).zip(record.differenced.iter().map(measured)).collect();
    NoiseModel::new(mission, &channels, 1.0 / record.gathered.rate_hz).map_err(Failure::engine)
}

/// What is gathered.
#[derive(Clone, Copy, PartialEq)]
enum What<'a> {
    /// The model alone.
    Model,
    /// Transients.
    Events,
    /// Every candidate, at these times what happens transient, and about these shapes in fine steps what can be tried so.
    Everything(&'a [Detection], &'a [RefinementRequest]),
}

/// What is known of some products.
pub(super) struct Gathering {
    /// Sums.
    pub(super) record: Record,
    /// What they say.
    pub(super) diagnosis: Diagnosis,
}

/// Gathers the data of products of one model, with the model alone.
pub(super) fn gather_model(names: &[String], archive: &Path, global: &Global) -> Result<(Record, Mission), Failure> {
    gather(names, archive, global, What::Model)
}

/// Gathers the data of products of one model, with every candidate, and diagnoses them. The data are read twice: transients has
/// to be found before it can be weighed against what lasts; and once more where a shape stands out that can be tried in finer steps.
pub(super) fn gather_candidates(names: &[String], archive: &Path, global: &Global) -> Result<Gathering, Failure> {
    let found = gather(names, archive, global, What::Events)?.0.gathered.transients;
    let events: Vec<Detection> = found.certain(WORTH_TRYING).take(MOST_EVENTS).cloned().collect();
    let pass = |refinement_requests: &[RefinementRequest], tried_before: &BTreeMap<String, usize>| {
        let (mut record, mission) = gather(names, archive, global, What::Everything(&events, refinement_requests))?;
        record.gathered.transients = found.clone();
        let diagnosis = judge(&record, &mission, tried_before)?;
        Ok::<_, Failure>(Gathering { record, diagnosis })
    };
    let first = pass(&[], &BTreeMap::new())?;
    let registry = super::registry(global)?;
    let mut refinement_requests = first.diagnosis.refinement_requests.clone();
    refinement_requests.retain(|request| has_parameter(&registry, &request.effect, FINE));
    if refinement_requests.is_empty() {
        return Ok(first);
    }
    let mut tried = first.diagnosis.forms;
    tried.retain(|effect, _| refinement_requests.iter().any(|request| request.effect == *effect));
    // Sums are large, and these are made again.
    drop(first.record);
    pass(&refinement_requests, &tried)
}

fn gather(names: &[String], archive: &Path, global: &Global, what: What<'_>) -> Result<(Record, Mission), Failure> {
    let registry = super::registry(global)?;
    let mut whole: Option<(Record, Mission)> = None;
    for name in names {
        let (product, path) = super::products::open(name, archive)?;
        let sources = Sources::read(&path).map_err(Failure::engine)?;
        let folder = tempfile::tempdir().map_err(Failure::engine)?;
        let out = folder.path().join("sums");
        let mut parameters = toml::Table::new();
        let text = |path: &Path| toml::Value::String(path.to_string_lossy().into_owned());
        parameters.insert("out".to_owned(), text(&out));
        let equations = path.with_extension("neq.json");
        if equations.is_file() {
            parameters.insert("reference".to_owned(), text(&equations));
        }
        let mut all = candidates(&registry, &model(&sources).map_err(Failure::engine)?);
        let (said, candidates) = match what {
            What::Model => ("compare", Vec::new()),
            What::Events => {
                all.retain(|e| has_parameter(&registry, &e.id, "at_ns"));
                ("look", all)
            }
            What::Everything(events, refinement_requests) => {
                for request in refinement_requests {
                    all.iter_mut().filter(|e| (&e.id, &e.instance) == (&request.effect, &request.instance)).for_each(
                        |e| {
                            let shape = request
                                .shape
                                .iter()
                                .filter_map(|(k, v)| Some((k.clone(), toml::Value::try_from(v).ok()?)));
                            e.parameters = shape.collect();
                            e.parameters.insert(FINE.to_owned(), toml::Value::Integer(1));
                        },
                    );
                }
                let file = folder.path().join("events.json");
                let json = serde_json::to_vec(events).map_err(Failure::engine)?;
                std::fs::write(&file, json).map_err(Failure::io("write", &file))?;
                parameters.insert("events".to_owned(), text(&file));
                ("diagnose", all)
            }
        };
        if what == What::Events {
            parameters.insert("gather".to_owned(), toml::Value::String("events".to_owned()));
        }
        let what = Examination {
            product: &product,
            sources: &sources,
            stage: ("critic", parameters),
            candidates,
            threads: super::threads(global),
            batch_rows: BATCH_ROWS as usize,
        };
        let mut meter = Meter::new(said, global);
        let not_tried = examine(&registry, &what, &mut |p| meter.show(&p)).map_err(Failure::engine)?;
        let file = std::fs::File::open(&out).map_err(Failure::engine)?;
        let mut record =
            Record::read(&mut std::io::BufReader::with_capacity(1 << 20, file)).map_err(Failure::engine)?;
        record.not_tried.extend(not_tried);
        match &mut whole {
            None => whole = Some((record, mission(&sources.mission)?)),
            Some((sum, _)) => sum.add(&record).map_err(Failure::engine)?,
        }
    }
    whole.ok_or_else(|| Failure::engine(std::io::Error::other("no product was named")))
}

fn mission(path: &PathBuf) -> Result<Mission, Failure> {
    let text = std::fs::read_to_string(path).map_err(Failure::engine)?;
    let value: toml::Value = toml::from_str(&text).map_err(Failure::engine)?;
    let json = serde_json::to_string(&value).map_err(Failure::engine)?;
    Mission::from_json(&json).map_err(Failure::engine)
}

fn screen(d: &Diagnosis, record: &Record, top: usize, paint: Paint) -> String {
    let mut out = String::new();
    let verdict = match d.verdict.as_str() {
        "missing" => "an effect is missing from the model",
        "unexplained" => "something is left that no installed effect explains",
        _ => "the model is sufficient for these data",
    };
    let _ = writeln!(out, "verdict   {} ({verdict})", paint.bold(&d.verdict));
    let _ = writeln!(
        out,
        "tried     {} forms of {} effects, false alarms at most {} in 100",
        d.tried,
        record.candidate_set.places().iter().filter(|p| !record.candidate_set.coefficients[p[0]].transient).count(),
        100.0 * d.false_alarm_rate
    );
    let accepted: Vec<&Found> = d.candidates.iter().filter(|f| f.accepted).collect();
    if !accepted.is_empty() {
        let _ = writeln!(out, "\nWhat is missing");
        accepted.iter().for_each(|f| put(&mut out, f));
    }
    let others: Vec<&Found> =
        d.candidates.iter().filter(|f| !f.accepted).take(top.saturating_sub(accepted.len())).collect();
    if !others.is_empty() {
        let _ = writeln!(out, "\nWhat was tried next, and is no explanation");
        others.iter().for_each(|f| put(&mut out, f));
    }
    if let Some(u) = &d.unexplained {
        let _ = writeln!(out, "\nWhat nobody explains");
        let _ = writeln!(out, "  channels {}", u.channels.join(", "));
        let _ = writeln!(
            out,
            "  {} between {:.2e} and {:.2e} Hz, {:.2} times the power",
            u.kind, u.band_hz[0], u.band_hz[1], u.ratio
        );
        if !u.coherent_with.is_empty() {
            let _ = writeln!(out, "  coherent with {}", u.coherent_with.join(", "));
        }
    }
    let unnamed = unnamed(record.gathered.transients.certain(d.false_alarm_rate), &accepted);
    if !unnamed.is_empty() {
        let _ = writeln!(out, "\nWhat was seen to happen, and is no part of the answer");
        for h in unnamed.iter().take(top) {
            let at = DateTime::from_timestamp_nanos(h.at_ns).format("%Y-%m-%dT%H:%M:%SZ");
            let _ = writeln!(out, "  {at}, as {}:{} would, {:.0}σ", h.effect, h.instance, h.significance);
        }
        let _ = writeln!(out, "  Near a gap or the end there is too little to weigh it: run two days' files as one.");
    }
    if let Some(f) = accepted.first() {
        let _ = writeln!(out, "\nnext      dragfree model add MODEL.toml {}:{}", f.effect, f.instance);
    }
    for (name, reason) in &d.not_tried {
        let _ = writeln!(out, "not tried {name}: {reason}");
    }
    out
}

/// What was seen, the loudest first, but for what is part of the answer and what rings beside something louder.
fn unnamed<'a>(seen: impl Iterator<Item = &'a Detection>, accepted: &[&Found]) -> Vec<&'a Detection> {
    let at_ns = |f: &&Found| f.shape.get("at_ns").and_then(serde_json::Value::as_i64);
    let mut told: Vec<i64> = accepted.iter().filter_map(at_ns).collect();
    let mut is_new = |detection: &&Detection| {
        let new = told.iter().all(|at_ns| (at_ns - detection.at_ns).abs() > SAME_EVENT_NS);
        told.push(detection.at_ns);
        new
    };
    seen.filter(|detection| is_new(detection)).collect()
}

fn put(out: &mut String, f: &Found) {
    let _ = writeln!(out, "  {}:{}", f.effect, f.instance);
    let _ = writeln!(
        out,
        "    {} = {:.4e} ± {:.1e} {}, χ² falls by {:.0}, chance {:.1e}{}",
        f.coefficient,
        f.value,
        f.sigma,
        f.unit,
        f.delta_chi2,
        f.p_value,
        if f.in_range { "" } else { ", at the end of its range" }
    );
    for (key, value) in &f.shape {
        let _ = writeln!(out, "    {key} = {value}");
    }
    let moved: Vec<String> = f
        .offset_shift_sigma
        .iter()
        .filter(|(_, s)| s.abs() > 1.0)
        .map(|(name, s)| format!("{name} by {:.2} mm ({s:.1}σ)", 1e3 * f.offset_shift_m[name]))
        .collect();
    if !moved.is_empty() {
        let _ = writeln!(out, "    without it {}", moved.join(", "));
    }
    if !f.confounders.is_empty() {
        let _ = writeln!(out, "    cannot be told from {}", f.confounders.join(", "));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_rings_beside_something_louder_or_is_named_is_not_told_again() {
        let detection = |at_s: i64| Detection {
            effect: "impulse".to_owned(),
            instance: "tm1.x".to_owned(),
            coefficient: "impulse.tm1.x".to_owned(),
            unit: "N s".to_owned(),
            shape: serde_json::Map::new(),
            at_ns: 1_000_000_000 * at_s,
            significance: 10.0,
        };
        let seen = [detection(20_000), detection(21_800), detection(24_000), detection(5_000)];
        let times = |accepted: &[&Found]| -> Vec<i64> {
            unnamed(seen.iter(), accepted).iter().map(|h| h.at_ns / 1_000_000_000).collect()
        };
        // The third rings beside the second, which rings beside the first.
        assert_eq!(times(&[]), [20_000, 5_000]);
    }
}
