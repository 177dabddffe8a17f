//! From the columns of a chain to sums: channels, the model's series, those of every candidate and housekeeping, cut
//! into segments as rows come.

use std::borrow::Cow;
use std::collections::{BTreeMap, HashSet};
use std::path::Path;
use std::sync::Arc;

use dragfree_engine::chain::{Chain, Sink};
use dragfree_engine::config::EffectEntry;
use dragfree_engine::examine::Wanted;
use dragfree_estimation::decimate::SLOW_HZ;
use dragfree_estimation::estimate::{Method, Observed, Refinement, estimate_with};
use dragfree_estimation::segments::{Segmenter, all_finite, longest_length};
use dragfree_estimation::sigma::{BandNoise, NoiseModel};
use dragfree_estimation::spectra::{LONG, Plan};
use dragfree_estimation::stored::Stored;
use dragfree_identification::candidates::{CandidateSet, Coefficient as Unknown, Form, Rule, Term};
use dragfree_identification::coherence::{Direction, HousekeepingCoherence};
use dragfree_identification::columns::Columns;
use dragfree_identification::gram::GramAccumulator;
use dragfree_identification::lines::{LineSearch, Place};
use dragfree_identification::record::Record;
use dragfree_identification::transient::{Detection, Search, Template, is_one_transient};
use dragfree_identification::waveform::Waveform;
use dragfree_schema::{
    AT_NS, Available, Coefficient, Column, Constraint, FREQUENCY_HZ, NoiseProcess, Response, Settings, Shape, Variant,
    place_and_number,
};
use nalgebra::{DMatrix, DVector};

use crate::WorkflowError;

/// How often Σ is measured from the residuals of the reference.
const REFINEMENTS: usize = 3;

/// Shape parameter of a probe: where it acts.
pub(crate) const ACTS_ON: &str = "acts_on";

/// Frame of forces and torques on the spacecraft.
const SPACECRAFT_FRAME: &str = "SRF";

/// The table of columns that no plugin makes: waveforms that begin at a detection.
const WAVEFORMS: &str = "waveforms";

/// What is summed.
pub(crate) struct Request<'a> {
    /// Only matched filters run; nothing of any candidate is summed.
    pub(crate) only_transients: bool,
    /// Transients that were detected before: candidates have waveforms that begin there, and no matched filter runs.
    pub(crate) detected: Option<&'a [Detection]>,
    /// Normal equations of the product: residuals for the matched filters and for the coherences.
    pub(crate) reference: Option<&'a Path>,
    /// Effect and instance of candidates that are no candidates: how they respond says how a force enters the
    /// channels that a function of housekeeping may drive. Where there are any, products of housekeeping with commands
    /// and displacements are drivers too.
    pub(crate) probes: &'a [EffectEntry],
    /// Values about which products of housekeeping are taken: those of the product that came first; none of that one.
    pub(crate) levels: &'a [f64],
    /// Threads; results do not depend on them.
    pub(crate) threads: usize,
}

/// A series with its last value where it has none, and how many measured rows have none. Before its first value, which
/// `held` then lacks, so many rows may wait for it.
fn hold(series: &[f64], measured: &[bool], held: &mut f64, patience: usize) -> (Vec<f64>, u64) {
    let mut missing = 0;
    let values = series.iter().zip(measured).enumerate().map(|(k, (x, measured))| {
        if x.is_finite() {
            *held = *x;
        } else {
            let waits = held.is_nan() && k < patience;
            missing += u64::from(*measured && !waits);
        }
        *held
    });
    (values.collect(), missing)
}

/// Sums of the columns of a chain; takes their rows.
pub(crate) struct ColumnSums {
    names: Vec<String>,
    candidate_set: CandidateSet,
    noise: Vec<NoiseProcess>,
    base: usize,
    /// Waveforms that begin at known times, and where they stand among the columns.
    waveforms: Vec<Waveform>,
    waveforms_at: usize,
    segmenter: Segmenter,
    accumulator: GramAccumulator,
    rate_hz: f64,
    /// Last value of each column.
    held: Vec<f64>,
    /// Rows without a value, per column, after the first ones.
    missing: Vec<u64>,
    rows: u64,
    /// Rows in which the channels and the model's series have values.
    measured: u64,
    waiting: bool,
    settings: Settings,
}

impl Sink for ColumnSums {
    fn tapped(&mut self, time_ns: &[i64], columns: &[&[f64]]) {
        let begun: Vec<Vec<f64>> = self.waveforms.iter().map(|c| c.over(time_ns)).collect();
        let mut columns = columns.to_vec();
        columns.splice(self.waveforms_at..self.waveforms_at, begun.iter().map(Vec::as_slice));
        self.push(time_ns, &columns);
    }
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

fn is_of(coefficient: &Coefficient, entries: &[EffectEntry]) -> bool {
    let own = (&coefficient.effect, &coefficient.instance);
    coefficient.candidate && entries.iter().any(|e| (&e.id, &e.instance) == own)
}

/// What the chain has, as a plugin behind the effects would see it, `without` some candidates.
fn available(chain: &Chain, without: &[EffectEntry]) -> Available {
    Available {
        columns: chain.columns.clone(),
        coefficients: chain.coefficients.iter().filter(|c| !is_of(c, without)).cloned().collect(),
        constraints: chain.constraints.clone(),
        noise: chain.noise.clone(),
    }
}

impl ColumnSums {
    /// Chooses the columns of a linked chain that a request needs.
    ///
    /// # Errors
    /// There is no channel, a declared noise contradicts itself, or the reference is of another model.
    pub(crate) fn link(
        request: &Request<'_>,
        chain: &Chain,
        settings: &Settings,
    ) -> Result<Wanted<Self>, WorkflowError> {
        let available = available(chain, request.probes);
        let channels: Vec<&Column> = available.of_kind("channel").collect();
        let Some(rate_hz) = channels.first().map(|c| c.rate_hz) else {
            return Err(WorkflowError::NoChannel);
        };
        let differenced: Vec<bool> = channels.iter().map(|c| c.attribute("average") == "2").collect();
        let templates = templates(&available, &channels, &differenced);
        let waveforms = waveforms(request.detected.unwrap_or_default(), &templates, rate_hz)?;
        let sorted = Series::sort(&available, &channels, request.only_transients, &waveforms)?;
        let housekeeping: Vec<&Column> =
            available.columns.iter().filter(|c| c.table == "grid" && c.name.starts_with("hk.")).collect();
        let known: Vec<&Column> =
            available.columns.iter().filter(|c| !request.probes.is_empty() && is_known(c)).collect();
        let drivers = || housekeeping.iter().chain(&known);
        let of = |c: &&Column| (c.table.clone(), c.name.clone());
        let series = sorted.keys.iter().filter(|(table, _)| table != WAVEFORMS).cloned();
        let keys = channels.iter().map(of).chain(series).chain(drivers().map(of));
        let place = |(table, name): (String, String)| {
            let at = available.columns.iter().position(|c| c.table == table && c.name == name);
            at.ok_or(WorkflowError::NoColumn { table, name })
        };
        let wanted: Vec<usize> = keys.map(place).collect::<Result<_, _>>()?;
        let names: Vec<String> =
            channels.iter().map(|c| name_of(c).to_owned()).chain(sorted.keys.iter().map(|(_, n)| n.clone())).collect();
        let length = longest_length((settings.segment_s * rate_hz).round() as usize);
        let plan = Plan::slow(LONG * length, length, rate_hz);
        let all = Columns {
            names: names.clone(),
            tables: channels
                .iter()
                .map(|c| c.table.clone())
                .chain(sorted.keys.iter().map(|(t, _)| t.clone()))
                .collect(),
            channels: channels.len(),
            base: channels.len() + sorted.base,
            fast: channels.len() + sorted.fast,
            energy: waveforms.iter().map(|c| c.energy(&plan, differenced.contains(&true))).collect(),
            housekeeping_units: drivers().map(|c| c.unit.clone()).collect(),
        };
        let candidate_set = candidate_set(&available, &channels, &sorted, &waveforms, settings);
        let residual = residual(request.reference, &candidate_set, &channels, &all, length, settings)?;
        // As they are called in telemetry: `hk/battery_current_a`.
        let topics: Vec<String> = drivers().map(|c| c.name.replacen("hk.", "hk/", 1)).collect();
        let own: Vec<(&str, &str)> = channels.iter().map(|c| (name_of(c), c.frame.as_str())).collect();
        let mut forces = Direction::of_channels(&own);
        forces.extend(directions(chain, request.probes, &channels));
        let known = known.iter().map(|c| c.frame.clone()).collect();
        let noise = NoiseModel::new(&available.noise, &candidate_set.channels, 1.0 / rate_hz)?;
        let declared = Arc::new(noise);
        let inverse = move |hz: f64| {
            let sigma = declared.psd(hz);
            let nothing = DMatrix::zeros(sigma.nrows(), sigma.ncols());
            sigma.cholesky().map_or(nothing, |c| c.inverse())
        };
        // Matched filters whiten with the declared Σ: a Σ measured from these data has taken up the power of the
        // transient.
        let inverses =
            plan.bands.iter().map(|b| (plan.bin_hz(b.end as f64 - 0.5), inverse(plan.frequency_hz(*b)))).collect();
        let templates = if request.detected.is_some() { Vec::new() } else { templates };
        let search = Search::new(templates, residual.clone(), inverses).on(request.threads);
        let places = if request.only_transients { places(&available, &channels) } else { Vec::new() };
        let step_ns = (1e9 / rate_hz).round() as i64;
        let line_search = LineSearch::new(places, residual.clone(), Arc::new(inverse.clone()), step_ns);
        let coherence = |plan: &Plan| {
            let whitening = plan.bands.iter().map(|b| inverse(plan.frequency_hz(*b))).collect();
            HousekeepingCoherence::new(topics, known, plan, residual, whitening, forces).about(request.levels)
        };
        let width = wanted.len() + waveforms.len();
        let averaged: Vec<bool> =
            (0..width).map(|i| (all.channels..names.len()).contains(&i) && differenced.iter().any(|d| *d)).collect();
        let sums = Self {
            held: vec![f64::NAN; width],
            missing: vec![0; width],
            rows: 0,
            measured: 0,
            waiting: true,
            settings: settings.clone(),
            segmenter: Segmenter::new(length, (1e9 / rate_hz).round() as i64, averaged).of_first(all.fast),
            base: all.base,
            waveforms_at: all.fast - waveforms.len(),
            waveforms,
            accumulator: GramAccumulator::new(all, length, rate_hz, request.threads, coherence, search, line_search),
            names,
            candidate_set,
            noise: available.noise.clone(),
            rate_hz,
        };
        Ok((sums, wanted))
    }

    fn push(&mut self, time_ns: &[i64], columns: &[&[f64]]) {
        let mut filled: Vec<Cow<'_, [f64]>> = Vec::with_capacity(columns.len() - self.base);
        // A gap of the telemetry as a whole is none of a candidate's own.
        let measured: Vec<bool> =
            (0..time_ns.len()).map(|k| columns[..self.base].iter().all(|c| c[k].is_finite())).collect();
        let patience = ((self.settings.patience_s * self.rate_hz) as u64).saturating_sub(self.rows) as usize;
        for (j, column) in columns.iter().enumerate().skip(self.base) {
            if all_finite(column) {
                self.held[j] = column.last().copied().unwrap_or(self.held[j]);
                filled.push(Cow::Borrowed(column));
                continue;
            }
            let (values, missing) = hold(column, &measured, &mut self.held[j], patience);
            filled.push(Cow::Owned(values));
            self.missing[j] += missing;
        }
        let mut first = columns.first().map_or_else(Vec::new, |c| c.to_vec());
        if self.waiting {
            let lacks = |k: usize| filled.iter().any(|c| c[k].is_nan());
            let wait = (0..time_ns.len()).take_while(|k| *k < patience && lacks(*k)).count();
            first[..wait].fill(f64::NAN);
            self.waiting = wait == time_ns.len();
        }
        // A column without any value so far has none at all and stays at zero.
        for column in filled.iter_mut().filter(|c| c.iter().any(|x| x.is_nan())) {
            column.to_mut().iter_mut().filter(|x| x.is_nan()).for_each(|x| *x = 0.0);
        }
        self.rows += time_ns.len() as u64;
        self.measured += measured.iter().filter(|x| **x).count() as u64;
        let all: Vec<&[f64]> = std::iter::once(first.as_slice())
            .chain(columns[1..self.base].iter().copied())
            .chain(filled.iter().map(AsRef::as_ref))
            .collect();
        self.segmenter.cut(time_ns, &all, &mut self.accumulator);
    }

    /// The sums; candidates whose series have gaps are left out, with the reason.
    pub(crate) fn record(mut self) -> Record {
        self.segmenter.cut_end(&mut self.accumulator);
        let mut candidate_set = self.candidate_set;
        let mut not_tried = Vec::new();
        let gappy = |column: usize| {
            self.missing[column] as f64 > self.settings.max_missing * self.measured.max(1) as f64
                || self.held[column].is_nan()
        };
        let mut fewer: BTreeMap<usize, usize> = BTreeMap::new();
        for left_out in candidate_set.leave_out(|column| column >= self.base && gappy(column)) {
            match left_out.columns.last() {
                Some(column) if left_out.all => not_tried.push((
                    left_out.name,
                    format!(
                        "{} has no value in {} of {} epochs: what it is made of has gaps",
                        self.names[*column], self.missing[*column], self.measured
                    ),
                )),
                _ => left_out.columns.into_iter().for_each(|column| *fewer.entry(column).or_default() += 1),
            }
        }
        not_tried.extend(fewer.into_iter().map(|(column, forms)| {
            let (missing, rows) = (self.missing[column], self.measured);
            let reason =
                format!("it has no value in {missing} of {rows} epochs, so {forms} forms of effects are left out");
            (self.names[column].clone(), reason)
        }));
        Record { candidate_set, noise: self.noise, gathered: self.accumulator.finish(), not_tried }
    }
}

/// Residuals as combinations of the base columns, at the coefficients that the product's own sums give where there are
/// some.
fn residual(
    reference: Option<&Path>,
    candidate_set: &CandidateSet,
    channels: &[&Column],
    columns: &Columns,
    length: usize,
    settings: &Settings,
) -> Result<DMatrix<f64>, WorkflowError> {
    let n = channels.len();
    let mut theta: Vec<f64> = candidate_set.coefficients.iter().map(|c| c.initial).collect();
    if let Some(path) = reference {
        let refuse = |what: String| WorkflowError::Reference { path: path.to_owned(), what };
        let text = std::fs::read(path).map_err(|e| refuse(e.to_string()))?;
        let days = [Stored::of_equations(&text).map_err(|e| refuse(e.to_string()))?];
        let (layout, plan, sums) = Stored::stack(&days).map_err(|e| refuse(e.to_string()))?;
        let model = candidate_set.model();
        let same = layout.coefficients.iter().eq(candidate_set.coefficients[..model].iter().map(|c| &c.name));
        if !same || plan.length != length {
            return Err(refuse("belongs to another model, or to segments of another length".to_owned()));
        }
        if sums.total.segments > 0 {
            let noise = NoiseModel::new(&days[0].declared.noise, &layout.channels, 1.0 / plan.rate_hz)?;
            let observed = Observed { layout: &layout, plan: &plan, sums: &sums, prediction: None };
            let (unknowns, bounds) = (candidate_set.unknowns(&[]), candidate_set.bounds());
            let noise = BandNoise::new(&noise, &plan);
            let method = Method { refinements: REFINEMENTS, refinement: Refinement::Levels, settings };
            let solved = estimate_with(&observed, &noise, &unknowns, &bounds, &method)?;
            theta.iter_mut().zip(solved.theta.iter()).for_each(|(t, s)| *t = *s);
        }
    }
    let mut residual = DMatrix::identity(n, columns.base);
    for (i, c) in candidate_set.coefficients[..candidate_set.model()].iter().enumerate() {
        for t in &c.forms[0].terms {
            residual[(t.channel, t.column)] -= theta[i] * t.factor * t.times.map_or(1.0, |other| theta[other]);
        }
    }
    Ok(residual)
}

/// Waveforms that begin where transients were detected.
fn waveforms(detected: &[Detection], templates: &[Template], rate_hz: f64) -> Result<Vec<Waveform>, WorkflowError> {
    let waveform = |detection: &Detection| {
        let of = |t: &&Template| {
            (&t.effect, &t.instance, &t.coefficient) == (&detection.effect, &detection.instance, &detection.coefficient)
        };
        let own = |t: &&Template| t.shape.iter().all(|(key, value)| detection.shape.get(key) == Some(value));
        let template = templates.iter().find(|t| of(t) && own(t)).ok_or_else(|| WorkflowError::NoTemplate {
            effect: format!("{}:{}", detection.effect, detection.instance),
            at_ns: detection.at_ns,
        })?;
        let step_ns = (1e9 / rate_hz).round() as i64;
        Ok(Waveform { at_ns: detection.at_ns, step_ns, kernel: template.kernel.clone() })
    };
    detected.iter().map(waveform).collect()
}

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
        only_model: bool,
        waveforms: &[Waveform],
    ) -> Result<Self, WorkflowError> {
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
        let mut seen = HashSet::new();
        let mut counts = [0; 2];
        for part in 0..3 {
            for c in available.coefficients.iter().filter(|c| !(c.candidate && only_model)) {
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
                keys.extend((0..waveforms.len()).map(|k| (WAVEFORMS.to_owned(), format!("waveform {k}"))));
            }
            if part < 2 {
                counts[part] = keys.len();
            }
        }
        Ok(Self { keys, base: counts[0], fast: counts[1], responses })
    }
}

fn candidate_set(
    available: &Available,
    channels: &[&Column],
    series: &Series,
    waveforms: &[Waveform],
    settings: &Settings,
) -> CandidateSet {
    let times = apart(waveforms.iter().map(|waveform| waveform.at_ns), settings.same_transient_s);
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
        // A response scaled by a coefficient that the model lacks is dropped.
        responses.iter().filter_map(term).collect()
    };
    let unknown = |c: &Coefficient| {
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
                colours: v.colours.clone(),
                ..form(&v.shape, &v.responses, v.unit.as_ref(), v.range)
            };
            c.variants.iter().map(form).collect()
        } else {
            match series.responses.get(&c.name) {
                Some(responses) => {
                    let colours = c.colours.clone();
                    vec![Form { colours, ..form(&c.shape, responses, None, None) }]
                }
                None if c.candidate => Vec::new(),
                None => vec![form(&c.shape, &[], None, None)],
            }
        };
        Unknown {
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
    // Every coefficient with the waveform of a detection is a candidate for its cause.
    let transients = |c: &Coefficient| -> Vec<Unknown> {
        let at = |(k, waveform): (usize, &Waveform)| {
            let transient = c.transients.iter().find(|t| t.kernel == waveform.kernel)?;
            let mut shape: serde_json::Map<_, _> = transient.shape.clone().into_iter().collect();
            shape.insert(AT_NS.to_owned(), waveform.at_ns.into());
            let column = *column.get(&(WAVEFORMS, format!("waveform {k}").as_str()))?;
            let term = |(name, factor): &(String, f64)| {
                let channel = channels.iter().position(|c| name_of(c) == name)?;
                Some(Term { channel, column, factor: *factor, times: None })
            };
            let terms = transient.channels.iter().filter_map(term).collect();
            let (lower, upper) = (finite(c.lower), finite(c.upper));
            Some(Form { shape, unit: c.unit.clone(), lower, upper, terms, colours: None })
        };
        let forms: Vec<Form> = waveforms.iter().enumerate().filter_map(at).collect();
        // As many of them as there are times that are not one transient's, each an instance of its own.
        let (place, first) = place_and_number(&c.instance);
        let is_taken = |number: &usize| {
            let name = format!("{place}-{number}");
            available.coefficients.iter().any(|own| own.effect == c.effect && own.instance == name)
        };
        let mut free = (first + 1..).filter(|number| !is_taken(number));
        let number = if forms.is_empty() { 0 } else { times };
        let mut own = |k: usize| {
            let mut own = Unknown { transient: true, noise: String::new(), forms: forms.clone(), ..unknown(c) };
            if k > 0 {
                let prefix = |instance: &str| format!("{}.{instance}", c.effect);
                own.instance = format!("{place}-{}", free.next().unwrap_or(first + k));
                own.name = own.name.replacen(&prefix(&c.instance), &prefix(&own.instance), 1);
            }
            own
        };
        (0..number).map(&mut own).collect()
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
            .map(unknown)
            .chain(available.coefficients.iter().flat_map(transients))
            .collect(),
        rules: available.constraints.iter().map(rule).collect(),
    }
}

/// How many of some times, in the order in which they come, are farther from all before them than one transient
/// lasts.
fn apart(all_ns: impl Iterator<Item = i64>, same_s: f64) -> usize {
    let mut kept: Vec<i64> = Vec::new();
    for at_ns in all_ns {
        if kept.iter().all(|other| !is_one_transient(at_ns, *other, same_s)) {
            kept.push(at_ns);
        }
    }
    kept.len()
}

/// Whether a column is a command or a displacement: what may act in proportion to housekeeping. Torques on test masses
/// move no channel.
fn is_known(column: &Column) -> bool {
    let acts = match column.unit.as_str() {
        "N" | "m" => true,
        "N m" => column.frame == SPACECRAFT_FRAME,
        _ => false,
    };
    acts && column.table == "reconstruction"
}

/// How forces enter the channels, as probes respond: each by the place that it states. What acts through a coefficient
/// of the model is a small part of it, and left out.
fn directions(chain: &Chain, probes: &[EffectEntry], channels: &[&Column]) -> Vec<Direction> {
    let direction = |c: &Coefficient| {
        let mut response = DVector::zeros(channels.len());
        for r in c.responses.iter().filter(|r| r.times.is_none()) {
            if let Some(channel) = channels.iter().position(|c| name_of(c) == r.channel) {
                response[channel] += r.factor;
            }
        }
        let name = c.shape.get(ACTS_ON)?.as_str()?.to_owned();
        let frame = SPACECRAFT_FRAME.to_owned();
        (response.norm_squared() > 0.0).then_some(Direction { name, frame, response })
    };
    chain.coefficients.iter().filter(|c| is_of(c, probes)).filter_map(direction).collect()
}

/// Where a line may act: candidates of one frequency, which respond to both phases alike.
fn places(available: &Available, channels: &[&Column]) -> Vec<Place> {
    let mut all: Vec<Place> = Vec::new();
    for c in available.coefficients.iter().filter(|c| c.candidate && c.shape.contains_key(FREQUENCY_HZ)) {
        let at = |r: &Response| Some((channels.iter().position(|c| name_of(c) == r.channel)?, r.factor));
        let known = all.iter().any(|p| (&p.effect, &p.instance) == (&c.effect, &c.instance));
        if !known {
            let channels = c.responses.iter().filter_map(at).collect();
            all.push(Place { effect: c.effect.clone(), instance: c.instance.clone(), channels });
        }
    }
    all
}

pub(crate) fn templates(available: &Available, channels: &[&Column], differenced: &[bool]) -> Vec<Template> {
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

#[cfg(test)]
mod tests {
    use super::*;

    /// What a series lacks is the same in any batches: rows before its first value beyond the patience, and later ones
    /// that are measured.
    #[test]
    fn missing_values_do_not_depend_on_batches() {
        let mut series = vec![f64::NAN; 40];
        (15..40).filter(|k| k % 5 != 0).for_each(|k| series[k] = k as f64);
        let measured: Vec<bool> = (0..40).map(|k| k != 25).collect();
        for batch in [1, 7, 40] {
            let (mut held, mut values, mut missing) = (f64::NAN, Vec::new(), 0);
            for first in (0..40).step_by(batch) {
                let rows = first..(first + batch).min(40);
                let patience = 10_usize.saturating_sub(first);
                let (own, lacks) = hold(&series[rows.clone()], &measured[rows], &mut held, patience);
                values.extend(own);
                missing += lacks;
            }
            // 10 to 15, 20, 30 and 35; in 25 nothing was measured.
            assert_eq!(missing, 9, "batches of {batch}");
            assert!(values[..16].iter().all(|x| x.is_nan()) && values[20] == 19.0 && values[39] == 39.0);
        }
    }
}
