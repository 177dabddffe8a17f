//! Columns in, a record out.

use std::borrow::Cow;
use std::collections::BTreeMap;
use std::io::BufWriter;
use std::path::Path;

use dragfree_estimation::colour;
use dragfree_estimation::estimate::{Observed, Refinement, estimate_with};
use dragfree_estimation::segments::{Segmenter, all_finite, longest_length};
use dragfree_estimation::sigma::{BandNoise, Measured, NoiseModel};
use dragfree_estimation::spectra::Plan;
use dragfree_estimation::stored::Stored;
use dragfree_identification::candidates::{CandidateSet, Coefficient as Asked, Form, Rule, Term};
use dragfree_identification::coherence::HousekeepingCoherence;
use dragfree_identification::gram::{Columns, GramAccumulator, LONG, SLOW_HZ};
use dragfree_identification::record::Record;
use dragfree_identification::transient::{Detection, Search, Template};
use dragfree_identification::waveform::Waveform;
use dragfree_physics::mission::Mission;
use dragfree_sdk::prelude::*;
use nalgebra::DMatrix;

/// Rows at the start that wait for the first value of every candidate's series, s: housekeeping may come once a minute.
const PATIENCE_S: f64 = 120.0;

/// A candidate whose series lack more of their rows is not tried.
const MISSING: f64 = 0.01;

/// Gathers sums.
pub struct Critic {
    mission: Mission,
    segment_s: f64,
    out: String,
    reference: String,
    only_events: bool,
    events: String,
    threads: usize,
    linked: Option<Linked>,
}

struct Linked {
    columns: Vec<In>,
    names: Vec<String>,
    candidate_set: CandidateSet,
    differenced: Vec<bool>,
    base: usize,
    /// Courses that begin at known times, and where they stand among the columns.
    waveforms: Vec<Waveform>,
    courses_at: usize,
    segmenter: Segmenter,
    gatherer: GramAccumulator,
    rate_hz: f64,
    /// Last value of each column.
    held: Vec<f64>,
    /// Rows without a value, per column, after the first ones.
    missing: Vec<u64>,
    rows: u64,
    waiting: bool,
}

impl Stage for Critic {
    const MANIFEST: Manifest = Manifest {
        id: "critic",
        version: env!("CARGO_PKG_VERSION"),
        licence: "MIT OR Apache-2.0",
        description: "Sums over channels, model, candidates and housekeeping, from which the model is criticised",
        parameters: &[
            Parameter::f64("segment_s", "s", 1638.4, 10.0..=100_000.0, "length of a segment"),
            Parameter::text("out", "", &[], "file for what is gathered"),
            Parameter::text(
                "reference",
                "",
                &[],
                "normal equations of the product (.neq.json): residuals for the search of transients, and for coherences of housekeeping",
            ),
            Parameter::text(
                "gather",
                "everything",
                &["everything", "events"],
                "events: only look for what happens transient, and gather nothing of any candidate",
            ),
            Parameter::text(
                "events",
                "",
                &[],
                "file with the times at which something was found to happen (JSON): waveforms of candidates that begin then are gathered",
            ),
        ],
        instances: &[],
        needs: &[],
    };

    fn new(setup: &Setup) -> Result<Self, PluginError> {
        Ok(Self {
            mission: Mission::from_json(setup.mission_json())?,
            segment_s: setup.f64("segment_s")?,
            out: setup.text("out")?,
            reference: setup.text("reference")?,
            only_events: setup.text("gather")? == "events",
            events: setup.text("events")?,
            threads: setup.threads(),
            linked: None,
        })
    }

    fn link(&mut self, available: &Available, link: &mut Link<'_>) -> Result<(), PluginError> {
        self.linked = Some(self.linked(available, link)?);
        Ok(())
    }

    fn process(&mut self, input: &Inputs<'_>, _output: &mut Outputs) -> Result<(), PluginError> {
        let linked = self.linked.as_mut().ok_or_else(before_link)?;
        let begun: Vec<Vec<f64>> = linked.waveforms.iter().map(|c| c.over(input.time_ns())).collect();
        let mut columns: Vec<&[f64]> = linked.columns.iter().map(|c| input.f64(*c)).collect();
        columns.splice(linked.courses_at..linked.courses_at, begun.iter().map(Vec::as_slice));
        linked.push(input.time_ns(), &columns);
        Ok(())
    }

    fn report(&mut self, _earlier: &[Report]) -> Result<Report, PluginError> {
        let out = self.out.clone();
        let linked = self.linked.as_mut().ok_or_else(before_link)?;
        linked.segmenter.cut_end(&mut linked.gatherer);
        let covered = linked.segmenter.state.covered;
        if let (false, Some(linked)) = (out.is_empty(), self.linked.take()) {
            write(Path::new(&out), &linked.record())
                .map_err(|e| PluginError::error(format!("critic: {out} cannot be written: {e}")))?;
        }
        let mut report = Report::default();
        report.counts.insert("epochs_in_segments".to_owned(), covered);
        Ok(report)
    }

    fn state(&mut self, _state: &mut State<'_>) -> Result<(), PluginError> {
        Err(PluginError::error("critic: has no state to resume from; run it over the whole stretch at once"))
    }
}

fn before_link() -> PluginError {
    PluginError::fatal("critic was called before it was linked; the host must link first")
}

/// Beside the place, and renamed: a kill leaves nothing that looks whole.
fn write(path: &Path, record: &Record) -> std::io::Result<()> {
    let folder = path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let mut file = BufWriter::with_capacity(1 << 20, tempfile::NamedTempFile::new_in(folder)?);
    record.write(&mut file)?;
    file.into_inner().map_err(std::io::IntoInnerError::into_error)?.persist(path)?;
    Ok(())
}

fn name_of(channel: &Column) -> &str {
    match channel.attribute("channel") {
        "" => &channel.name,
        name => name,
    }
}

fn finite(x: f64) -> Option<f64> {
    x.is_finite().then_some(x)
}

impl Critic {
    fn linked(&self, available: &Available, link: &mut Link<'_>) -> Result<Linked, PluginError> {
        let channels: Vec<&Column> = available.of_kind("channel").collect();
        let Some(rate_hz) = channels.first().map(|c| c.rate_hz) else {
            return Err(PluginError::error(
                "critic finds no channel to explain: put a stage before it that makes some, such as hinf-dfacs",
            ));
        };
        let differenced: Vec<bool> = channels.iter().map(|c| c.attribute("average") == "2").collect();
        let templates = templates(available, &channels, &differenced);
        let waveforms = self.waveforms(&templates, rate_hz)?;
        let sorted = Series::sort(available, &channels, self.only_events, &waveforms)?;
        let housekeeping: Vec<&Column> =
            available.columns.iter().filter(|c| c.table == "grid" && c.name.starts_with("hk.")).collect();
        let own = channels.iter().map(|c| Want::of(c));
        let made = |(table, _): &&(String, String)| table != WAVEFORMS;
        let series = sorted.keys.iter().filter(made).map(|(table, name)| Want::new(name).table(table));
        let wants = own.chain(series).chain(housekeeping.iter().map(|c| Want::of(c)));
        let columns: Vec<In> = wants.map(|want| link.read(&want.rate_hz(rate_hz))).collect::<Result<_, _>>()?;
        let names: Vec<String> =
            channels.iter().map(|c| name_of(c).to_owned()).chain(sorted.keys.iter().map(|(_, n)| n.clone())).collect();
        let length = longest_length((self.segment_s * rate_hz).round() as usize);
        let plan = Plan::slow(LONG * length, length, rate_hz);
        let all = Columns {
            names: names.clone(),
            channels: channels.len(),
            base: channels.len() + sorted.base,
            fast: channels.len() + sorted.fast,
            energy: waveforms.iter().map(|c| c.energy(&plan, differenced.contains(&true))).collect(),
        };
        let candidate_set = candidate_set(available, &channels, &sorted, &waveforms);
        let residual = self.residual(&candidate_set, &channels, &all, length)?;
        // As they are called in telemetry: `hk/battery_current_a`.
        let topics: Vec<String> = housekeeping.iter().map(|c| c.name.replacen("hk.", "hk/", 1)).collect();
        let whole: Vec<(&str, Measured)> = channels.iter().map(|c| (name_of(c), measured(c))).collect();
        let noise = NoiseModel::new(&self.mission, &whole, 1.0 / rate_hz)?;
        let inverse = |hz: f64| {
            let sigma = noise.psd(hz);
            let nothing = DMatrix::zeros(sigma.nrows(), sigma.ncols());
            sigma.cholesky().map_or(nothing, |c| c.inverse())
        };
        // The mission's Σ: what these data promise has taken up the power of what is looked for.
        // From the lowest bin of a long segment on.
        let lower = plan.bands.iter().map(|b| (plan.bin_hz(b.end as f64 - 0.5), inverse(plan.frequency_hz(*b))));
        let inverses = lower.collect();
        // What was looked for before is not looked for again.
        let templates = if self.events.is_empty() { templates } else { Vec::new() };
        let search = Search::new(templates, residual.clone(), inverses).on(self.threads);
        let coherence = |plan: &Plan| {
            let whitening = plan.bands.iter().map(|b| inverse(plan.frequency_hz(*b))).collect();
            HousekeepingCoherence::new(topics, plan, residual, whitening)
        };
        let width = columns.len() + waveforms.len();
        let averaged: Vec<bool> =
            (0..width).map(|i| (all.channels..names.len()).contains(&i) && differenced.iter().any(|d| *d)).collect();
        Ok(Linked {
            held: vec![f64::NAN; width],
            missing: vec![0; width],
            rows: 0,
            waiting: true,
            segmenter: Segmenter::new(length, (1e9 / rate_hz).round() as i64, averaged).of_first(all.fast),
            base: all.base,
            courses_at: all.fast - waveforms.len(),
            waveforms,
            gatherer: GramAccumulator::new(all, length, rate_hz, self.threads, coherence, search),
            columns,
            names,
            candidate_set,
            differenced,
            rate_hz,
        })
    }

    /// The waveforms that begin where something was found to happen.
    fn waveforms(&self, templates: &[Template], rate_hz: f64) -> Result<Vec<Waveform>, PluginError> {
        if self.events.is_empty() {
            return Ok(Vec::new());
        }
        let refuse = |what: String| PluginError::error(format!("critic: {}: {what}", self.events));
        let text = std::fs::read_to_string(&self.events).map_err(|e| refuse(e.to_string()))?;
        let detections: Vec<Detection> = serde_json::from_str(&text).map_err(|e| refuse(e.to_string()))?;
        let waveform = |detection: &Detection| {
            let of = |t: &&Template| {
                (&t.effect, &t.instance, &t.coefficient)
                    == (&detection.effect, &detection.instance, &detection.coefficient)
            };
            let own = |t: &&Template| t.shape.iter().all(|(key, value)| detection.shape.get(key) == Some(value));
            let template = templates.iter().find(|t| of(t) && own(t)).ok_or_else(|| {
                refuse(format!(
                    "no effect has the waveform of {}:{} at {} ns any more",
                    detection.effect, detection.instance, detection.at_ns
                ))
            })?;
            Ok(Waveform {
                at_ns: detection.at_ns,
                step_ns: (1e9 / rate_hz).round() as i64,
                kernel: template.kernel.clone(),
            })
        };
        detections.iter().map(waveform).collect()
    }

    /// Residuals as combinations of the base columns, at the coefficients of the product's own sums where they are given.
    fn residual(
        &self,
        candidate_set: &CandidateSet,
        channels: &[&Column],
        columns: &Columns,
        length: usize,
    ) -> Result<DMatrix<f64>, PluginError> {
        let n = channels.len();
        let mut theta: Vec<f64> = candidate_set.coefficients.iter().map(|c| c.initial).collect();
        if !self.reference.is_empty() {
            let refuse = |what: String| PluginError::error(format!("critic: {}: {what}", self.reference));
            let text = std::fs::read_to_string(&self.reference).map_err(|e| refuse(e.to_string()))?;
            let mut value: serde_json::Value = serde_json::from_str(&text).map_err(|e| refuse(e.to_string()))?;
            let stored: Stored = serde_json::from_value(value["sums"].take()).map_err(|e| refuse(e.to_string()))?;
            let (layout, plan, sums) = Stored::stack(&[stored]).map_err(|e| refuse(e.to_string()))?;
            let model = candidate_set.model();
            let same = layout.coefficients.iter().eq(candidate_set.coefficients[..model].iter().map(|c| &c.name));
            if !same || plan.length != length {
                return Err(refuse("belongs to another model, or to segments of another length".to_owned()));
            }
            if sums.total.segments > 0 {
                let of = |name: &String| channels.iter().find(|c| name_of(c) == name);
                let seen: Vec<(&str, Measured)> =
                    layout.channels.iter().filter_map(of).map(|c| (name_of(c), measured(c))).collect();
                let noise = NoiseModel::new(&self.mission, &seen, 1.0 / plan.rate_hz)?;
                let observed = Observed { layout: &layout, plan: &plan, sums: &sums, prediction: None };
                let (unknowns, bounds) = (candidate_set.unknowns(&[]), candidate_set.bounds());
                let solved = estimate_with(
                    &observed,
                    &BandNoise::new(&noise, &plan),
                    &unknowns,
                    &bounds,
                    3,
                    Refinement::Levels,
                )?;
                theta.iter_mut().zip(solved.theta.iter()).for_each(|(t, s)| *t = *s);
            }
        }
        let mut residual = DMatrix::zeros(n, columns.base);
        (0..n).for_each(|c| residual[(c, c)] = 1.0);
        for (i, c) in candidate_set.coefficients[..candidate_set.model()].iter().enumerate() {
            for t in &c.forms[0].terms {
                residual[(t.channel, t.column)] -= theta[i] * t.factor * t.times.map_or(1.0, |other| theta[other]);
            }
        }
        Ok(residual)
    }
}

fn measured(channel: &Column) -> Measured {
    if channel.attribute("average") == "1" { Measured::Directly } else { Measured::Differenced }
}

/// The table of columns that no plugin makes.
const WAVEFORMS: &str = "events";

/// The series behind the channels, sorted as the sums want them.
struct Series {
    /// Table and name: of the model, of candidates, slow ones of candidates.
    keys: Vec<(String, String)>,
    base: usize,
    fast: usize,
    /// How each coefficient acts, by its name, where it is not by variants.
    responses: BTreeMap<String, Vec<Response>>,
}

impl Series {
    fn sort(
        available: &Available,
        channels: &[&Column],
        model_alone: bool,
        waveforms: &[Waveform],
    ) -> Result<Self, PluginError> {
        let mut responses: BTreeMap<String, Vec<Response>> = BTreeMap::new();
        for (c, r) in available.responses()? {
            responses.entry(c.name.clone()).or_default().push(r);
        }
        let exists = |r: &&Response| channels.iter().any(|c| name_of(c) == r.channel);
        let slow = |r: &Response| {
            let column = available.column(&r.table, &r.series);
            column.is_some_and(|c| c.attribute("below_hz").parse::<f64>().is_ok_and(|hz| hz <= SLOW_HZ))
        };
        let mut keys: Vec<(String, String)> = Vec::new();
        let mut seen = std::collections::HashSet::new();
        let mut counts = [0; 2];
        for part in 0..3 {
            for c in available.coefficients.iter().filter(|c| !(c.candidate && model_alone)) {
                let own = responses.get(&c.name).into_iter().flatten();
                for r in own.chain(c.variants.iter().flat_map(|v| &v.responses)).filter(exists) {
                    let wanted = match part {
                        0 => !c.candidate,
                        1 => c.candidate && !slow(r),
                        _ => c.candidate,
                    };
                    let key = (r.table.clone(), r.series.clone());
                    if wanted && seen.insert(key.clone()) {
                        keys.push(key);
                    }
                }
            }
            if part == 1 {
                keys.extend((0..waveforms.len()).map(|k| (WAVEFORMS.to_owned(), format!("event {k}"))));
            }
            if part < 2 {
                counts[part] = keys.len();
            }
        }
        Ok(Self { keys, base: counts[0], fast: counts[1], responses })
    }
}

fn candidate_set(available: &Available, channels: &[&Column], series: &Series, waveforms: &[Waveform]) -> CandidateSet {
    let column: BTreeMap<(&str, &str), usize> =
        series.keys.iter().enumerate().map(|(i, (t, n))| ((t.as_str(), n.as_str()), channels.len() + i)).collect();
    let coefficient = |name: &String| available.coefficients.iter().position(|c| !c.candidate && c.name == *name);
    let terms = |responses: &[Response]| -> Vec<Term> {
        let term = |r: &Response| {
            let times = match &r.times {
                Some(other) => Some(coefficient(other)?),
                None => None,
            };
            Some(Term {
                channel: channels.iter().position(|c| name_of(c) == r.channel)?,
                column: *column.get(&(r.table.as_str(), r.series.as_str()))?,
                factor: r.factor,
                times,
            })
        };
        // What acts through a coefficient that the model lacks does not act.
        responses.iter().filter_map(term).collect()
    };
    let asked = |c: &Coefficient| {
        let colour = |c: &Colour| colour::Colour {
            process: c.process.clone(),
            numerator: c.numerator.clone(),
            denominator: c.denominator.clone(),
        };
        let form = |shape: &Shape, responses: &[Response], unit: Option<&String>, range: Option<[f64; 2]>| Form {
            colours: None,
            shape: shape.iter().map(|(k, v)| (k.clone(), v.clone())).collect(),
            unit: unit.unwrap_or(&c.unit).clone(),
            lower: finite(range.map_or(c.lower, |r| r[0])),
            upper: finite(range.map_or(c.upper, |r| r[1])),
            terms: terms(responses),
        };
        let forms = if !c.variants.is_empty() {
            let form = |v: &Variant| Form {
                colours: v.colours.as_ref().map(colour),
                ..form(&v.shape, &v.responses, v.unit.as_ref(), v.range)
            };
            c.variants.iter().map(form).collect()
        } else {
            match series.responses.get(&c.name) {
                Some(responses) => {
                    let colours = c.colours.as_ref().map(colour);
                    vec![Form { colours, ..form(&c.shape, responses, None, None) }]
                }
                None if c.candidate => Vec::new(),
                None => vec![form(&c.shape, &[], None, None)],
            }
        };
        Asked {
            name: c.name.clone(),
            effect: c.effect.clone(),
            instance: c.instance.clone(),
            initial: c.initial,
            prior_sigma: finite(c.prior_sigma),
            estimate: c.estimate,
            candidate: c.candidate,
            transient: false,
            forms,
            noise: c.noise.clone(),
        }
    };
    // Whatever has the waveform of something that was found may have been the cause.
    let transient = |c: &Coefficient| {
        let at = |(k, waveform): (usize, &Waveform)| {
            let transient = c.transients.iter().find(|t| t.kernel == waveform.kernel)?;
            let mut shape: serde_json::Map<_, _> = transient.shape.clone().into_iter().collect();
            shape.insert("at_ns".to_owned(), waveform.at_ns.into());
            let column = *column.get(&(WAVEFORMS, format!("event {k}").as_str()))?;
            let term = |(name, factor): &(String, f64)| {
                let channel = channels.iter().position(|c| name_of(c) == name)?;
                Some(Term { channel, column, factor: *factor, times: None })
            };
            let terms = transient.channels.iter().filter_map(term).collect();
            let (lower, upper) = (finite(c.lower), finite(c.upper));
            Some(Form { shape, unit: c.unit.clone(), lower, upper, terms, colours: None })
        };
        let forms: Vec<Form> = waveforms.iter().enumerate().filter_map(at).collect();
        (!forms.is_empty()).then(|| Asked { transient: true, noise: String::new(), forms, ..asked(c) })
    };
    let rule = |r: &Constraint| Rule {
        name: r.name.clone(),
        survey: r.kind == "survey",
        terms: r.terms.iter().filter_map(|(name, weight)| Some((coefficient(name)?, *weight))).collect(),
        lower: finite(r.lower),
        upper: finite(r.upper),
    };
    CandidateSet {
        channels: channels.iter().map(|c| name_of(c).to_owned()).collect(),
        coefficients: available
            .coefficients
            .iter()
            .map(asked)
            .chain(available.coefficients.iter().filter_map(transient))
            .collect(),
        rules: available.constraints.iter().map(rule).collect(),
    }
}

fn templates(available: &Available, channels: &[&Column], differenced: &[bool]) -> Vec<Template> {
    let mut out = Vec::new();
    for c in available.coefficients.iter().filter(|c| c.candidate) {
        for t in &c.transients {
            let at = |(name, factor): &(String, f64)| {
                let channel = channels.iter().position(|c| name_of(c) == name)?;
                Some((channel, *factor, differenced[channel]))
            };
            let channels: Vec<(usize, f64, bool)> = t.channels.iter().filter_map(at).collect();
            if !channels.is_empty() && !t.kernel.is_empty() {
                out.push(Template {
                    effect: c.effect.clone(),
                    instance: c.instance.clone(),
                    coefficient: c.name.clone(),
                    unit: c.unit.clone(),
                    shape: t.shape.iter().map(|(k, v)| (k.clone(), v.clone())).collect(),
                    kernel: t.kernel.clone(),
                    channels,
                });
            }
        }
    }
    out
}

impl Linked {
    fn push(&mut self, time_ns: &[i64], columns: &[&[f64]]) {
        let mut filled: Vec<Cow<'_, [f64]>> = Vec::with_capacity(columns.len() - self.base);
        for (j, column) in columns.iter().enumerate().skip(self.base) {
            if all_finite(column) {
                self.held[j] = column.last().copied().unwrap_or(self.held[j]);
                filled.push(Cow::Borrowed(column));
                continue;
            }
            let mut held = self.held[j];
            let mut missing = 0;
            filled.push(
                column
                    .iter()
                    .map(|x| {
                        if x.is_finite() {
                            held = *x;
                        } else {
                            missing += 1;
                        }
                        held
                    })
                    .collect(),
            );
            self.held[j] = held;
            if !self.waiting {
                self.missing[j] += missing;
            }
        }
        let mut first = columns.first().map_or_else(Vec::new, |c| c.to_vec());
        if self.waiting {
            let patience = ((PATIENCE_S * self.rate_hz) as u64).saturating_sub(self.rows) as usize;
            let lacks = |k: usize| filled.iter().any(|c| c[k].is_nan());
            let wait = (0..time_ns.len()).take_while(|k| *k < patience && lacks(*k)).count();
            first[..wait].fill(f64::NAN);
            self.waiting = wait == time_ns.len();
        }
        // Whoever has no value by now has none at all, and stays at zero.
        for column in filled.iter_mut().filter(|c| c.iter().any(|x| x.is_nan())) {
            column.to_mut().iter_mut().filter(|x| x.is_nan()).for_each(|x| *x = 0.0);
        }
        self.rows += time_ns.len() as u64;
        let all: Vec<&[f64]> = std::iter::once(first.as_slice())
            .chain(columns[1..self.base].iter().copied())
            .chain(filled.iter().map(AsRef::as_ref))
            .collect();
        self.segmenter.cut(time_ns, &all, &mut self.gatherer);
    }

    /// What was gathered; candidates whose series have gaps are left out, with the reason.
    fn record(self) -> Record {
        let mut candidate_set = self.candidate_set;
        let mut not_tried = Vec::new();
        let gappy = |column: usize| {
            self.missing[column] as f64 > MISSING * self.rows.max(1) as f64 || self.held[column].is_nan()
        };
        let model = candidate_set.model();
        let mut fewer: BTreeMap<usize, usize> = BTreeMap::new();
        for c in &mut candidate_set.coefficients[model..] {
            let before = c.forms.len();
            let mut culprit = None;
            c.forms.retain(|f| {
                let bad = f.terms.iter().find(|t| t.column >= self.base && gappy(t.column));
                culprit = bad.map(|t| t.column).or(culprit);
                bad.is_none()
            });
            if let (false, Some(column)) = (c.forms.is_empty(), culprit) {
                *fewer.entry(column).or_default() += before - c.forms.len();
            }
            if let (true, Some(column)) = (before > 0 && c.forms.is_empty(), culprit) {
                not_tried.push((
                    format!("{}:{}", c.effect, c.instance),
                    format!(
                        "{} has no value in {} of {} epochs: what it is made of has gaps",
                        self.names[column], self.missing[column], self.rows
                    ),
                ));
            }
        }
        not_tried.extend(fewer.into_iter().map(|(column, forms)| {
            let (missing, rows) = (self.missing[column], self.rows);
            let reason =
                format!("it has no value in {missing} of {rows} epochs, so {forms} forms of effects are left out");
            (self.names[column].clone(), reason)
        }));
        Record { candidate_set, differenced: self.differenced, gathered: self.gatherer.finish(), not_tried }
    }
}
