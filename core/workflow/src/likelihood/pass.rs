//! One pass over one product: from the columns of its chain to the filter of the innovations.

use std::collections::{BTreeMap, BTreeSet};

use dragfree_engine::chain::{Chain, Sink};
use dragfree_engine::examine::Wanted;
use dragfree_identification::innovations::decision::Prior;
use dragfree_identification::innovations::filter::{Innovations, POWERS, Parameter, Response, Setup};
use dragfree_identification::innovations::predictor::{Change, Predictor};
use dragfree_identification::innovations::state_space::{NoNoise, NoisePoint, NoiseStates, gains};
use dragfree_identification::transient::Template;
use dragfree_identification::waveform::Waveform;
use dragfree_schema::{
    AHEAD_ATTRIBUTE, Available, Coefficient, Column, NoiseProcess, Response as Declared, Settings,
    UNPREDICTED_ATTRIBUTE, UNPREDICTED_SLOPE_ATTRIBUTE,
};
use nalgebra::DMatrix;

use super::{Meaning, Point};
use crate::WorkflowError;
use crate::sums::templates;

/// Part of a coefficient's scale, and of a level, over which the noise is differenced. The covariance of the driving
/// noise is a quadratic form in them, so central differences are exact.
const DIFFERENCE: f64 = 0.1;

/// Values that a series lacks.
pub(super) struct Gaps {
    /// Names of the series.
    names: Vec<String>,
    missing: Vec<u64>,
    never: Vec<bool>,
    rows: u64,
    /// Rows in which the channels and the model's series have values: a gap of the telemetry as a whole is none of a
    /// candidate's own.
    measured: u64,
    /// Series of each candidate's coefficient.
    of: BTreeMap<String, Vec<usize>>,
}

impl Gaps {
    fn of(responses: &Responses<'_>) -> Self {
        let series = responses.series.len();
        let acts = |i: usize| {
            // What follows from two coefficients at once lacks nothing that one of them does not.
            let declared = responses.terms[..responses.declared].iter();
            let own = declared.filter(move |t| t.coefficients[0] == i && t.series >= responses.base);
            own.map(|t| t.series).collect()
        };
        let candidates = responses.coefficients.iter().enumerate().filter(|(_, c)| c.candidate);
        Self {
            names: responses.series.iter().map(|(_, name)| name.clone()).collect(),
            missing: vec![0; series],
            never: vec![true; series],
            rows: 0,
            measured: 0,
            of: candidates.map(|(i, c)| (c.name.clone(), acts(i))).collect(),
        }
    }

    /// Coefficients that act through a series with gaps, and why they are not tried.
    pub(super) fn refused(&self, settings: &Settings) -> BTreeMap<String, String> {
        let gappy = |s: &&usize| {
            self.never[**s] || self.missing[**s] as f64 > settings.max_missing * self.measured.max(1) as f64
        };
        let reason = |s: &usize| {
            format!(
                "{} has no value in {} of {} epochs: what it is made of has gaps",
                self.names[*s], self.missing[*s], self.measured
            )
        };
        self.of.iter().filter_map(|(name, own)| Some((name.clone(), reason(own.iter().find(gappy)?)))).collect()
    }
}

/// Where and how a pass is made.
#[derive(Clone, Copy)]
pub(super) struct At<'a> {
    pub(super) point: &'a Point,
    /// Slow forces beside the declared noise.
    pub(super) slow: &'a [NoiseProcess],
    /// Whether it fits constants of the channels, powers of time and the model alone: constants are many σ of the noise
    /// between test masses, and a filter without them would take them for noise.
    pub(super) opening: bool,
    /// Number of the product.
    pub(super) number: usize,
    /// Length of a block of sums, s; all in one where there is none.
    pub(super) block_s: Option<f64>,
    /// Whether the innovations are those of the rows; else they are zero.
    pub(super) data: bool,
    /// Whether transients are searched for near the ends of the data.
    pub(super) search: bool,
    /// Waveforms that are further parameters, the last ones.
    pub(super) waveforms: &'a [Placed],
}

/// A waveform at a time, and the channels on which it acts.
#[derive(Clone, Debug)]
pub(super) struct Placed {
    pub(super) waveform: Waveform,
    /// Channel, factor.
    pub(super) channels: Vec<(usize, f64)>,
}

/// A pass over one product.
pub(super) struct Filtered {
    pub(super) parameters: Vec<(String, Meaning)>,
    pub(super) surveys: Vec<(Vec<(String, f64)>, Prior)>,
    pub(super) channels: BTreeMap<String, BTreeSet<String>>,
    count: usize,
    /// Series of the model, whose gaps are gaps of the data.
    base: usize,
    held: Vec<f64>,
    /// What is taken off each series: its mean of an earlier pass.
    centres: Vec<f64>,
    sums: Vec<f64>,
    /// Rows in them.
    summed: u64,
    /// Table and name of each series.
    keys: Vec<(String, String)>,
    pub(super) constants: Vec<Constant>,
    pub(super) gaps: Gaps,
    patience: u64,
    /// First row at the earliest, and as it is, Unix ns.
    not_before_ns: i64,
    pub(super) first_ns: Option<i64>,
    /// Samples per second.
    pub(super) rate_hz: f64,
    /// Series that no plugin makes, the last ones.
    waveforms: Vec<Waveform>,
    /// Transients that are searched for.
    pub(super) templates: Vec<Template>,
    pub(super) innovations: Innovations,
}

fn name_of(channel: &Column) -> &str {
    match channel.attribute("channel") {
        "" => &channel.name,
        name => name,
    }
}

/// What the mean of a series adds to the constant of a channel, per unit of coefficients.
pub(super) struct Constant {
    /// Name of the constant.
    pub(super) power: String,
    coefficients: Vec<Factor>,
    amount: f64,
}

/// A coefficient: its name where a point may have another value than this one.
struct Factor {
    name: Option<String>,
    value: f64,
}

impl Factor {
    fn at(&self, values: &BTreeMap<String, f64>) -> f64 {
        self.name.as_ref().and_then(|name| values.get(name)).copied().unwrap_or(self.value)
    }
}

impl Constant {
    /// What it is at some values of coefficients.
    pub(super) fn at(&self, values: &BTreeMap<String, f64>) -> f64 {
        self.amount * self.coefficients.iter().map(|c| c.at(values)).product::<f64>()
    }
}

/// A response of a coefficient as the likelihood takes it.
struct Term {
    /// Its coefficient, and others that multiply it.
    coefficients: Vec<usize>,
    channel: usize,
    series: usize,
    factor: f64,
    /// What the series lacks of each channel's unknown acceleration, and of its slope.
    unpredicted: Option<Vec<f64>>,
    unpredicted_slope: Option<Vec<f64>>,
    /// Channels of whose next readout the series knows more than the past of all channels.
    ahead: Vec<usize>,
    /// Whether the channel alone differs, and not the motion that it reads.
    in_readout: bool,
}

/// The channels of a linked chain, and what coefficients add to them.
struct Responses<'a> {
    channels: Vec<&'a Column>,
    names: Vec<String>,
    coefficients: Vec<&'a Coefficient>,
    /// Table and name of each series, those of the model first.
    series: Vec<(String, String)>,
    /// Series of the model.
    base: usize,
    terms: Vec<Term>,
    /// Terms that effects have declared; the others follow from them.
    declared: usize,
}

impl<'a> Responses<'a> {
    fn of(available: &'a Available) -> Result<Self, WorkflowError> {
        let channels: Vec<&Column> = available.of_kind("channel").collect();
        let names: Vec<String> = channels.iter().map(|c| name_of(c).to_owned()).collect();
        let coefficients: Vec<&Coefficient> = available.coefficients.iter().filter(|c| c.noise.is_empty()).collect();
        let mut all =
            Self { channels, names, coefficients, series: Vec::new(), base: 0, terms: Vec::new(), declared: 0 };
        let mut responses = available.responses()?;
        // Stable: the model's series come first.
        responses.sort_by_key(|(c, _)| c.candidate);
        for (c, response) in responses {
            all.add(available, c, response);
        }
        all.declared = all.terms.len();
        all.couple();
        Ok(all)
    }

    /// Adds a response; one to a channel that does not exist, or scaled by a coefficient that the model lacks, is none.
    fn add(&mut self, available: &Available, c: &Coefficient, response: Declared) {
        let index = |name: &str| self.coefficients.iter().position(|c| c.name == name);
        // Forms of a coefficient have the same name.
        let Some(coefficient) = self.coefficients.iter().position(|own| std::ptr::eq(*own, c)) else { return };
        let Some(channel) = self.names.iter().position(|n| *n == response.channel) else { return };
        let times = response.times.as_deref().map(index);
        if times == Some(None) {
            return;
        }
        let column = available.column(&response.table, &response.series);
        let lacks = |key: &str| {
            let text = column.map_or("", |c| c.attribute(key));
            (!text.is_empty()).then(|| gains(text, &self.names))
        };
        let (unpredicted, unpredicted_slope) = (lacks(UNPREDICTED_ATTRIBUTE), lacks(UNPREDICTED_SLOPE_ATTRIBUTE));
        let ahead: Vec<String> =
            serde_json::from_str(column.map_or("", |c| c.attribute(AHEAD_ATTRIBUTE))).unwrap_or_default();
        let ahead = ahead.iter().filter_map(|name| self.names.iter().position(|own| own == name)).collect();
        let key = (response.table, response.series);
        let series = self.series.iter().position(|s| *s == key).unwrap_or_else(|| {
            self.series.push(key);
            self.series.len() - 1
        });
        if !c.candidate {
            self.base = self.series.len();
        }
        self.terms.push(Term {
            coefficients: std::iter::once(coefficient).chain(times.flatten()).collect(),
            channel,
            series,
            factor: response.factor,
            unpredicted,
            unpredicted_slope,
            ahead,
            in_readout: response.in_readout,
        });
    }

    /// Adds what follows from two coefficients at once. A series that lacks a part of the acceleration in a channel
    /// lacks that part of what other coefficients add to the channel too: an opening angle turns the whole
    /// acceleration, with what an error of the thrusters' gain makes of it. An error of a readout is no acceleration: a
    /// delay of the attitude's readout moves no test mass. Terms that an effect has declared itself are its own.
    fn couple(&mut self) {
        let lacking = self.terms.iter().filter(|t| t.coefficients.len() == 1);
        let gains = lacking.flat_map(|t| t.unpredicted.iter().flatten().enumerate().map(move |gain| (t, gain)));
        let declared: BTreeSet<_> = self.terms.iter().map(Term::place).collect();
        let mut products: Vec<Term> = Vec::new();
        for (t, (channel, gain)) in gains.filter(|(_, (_, gain))| **gain != 0.0) {
            let acting =
                |u: &&Term| u.channel == channel && !u.in_readout && !u.coefficients.contains(&t.coefficients[0]);
            for u in self.terms.iter().filter(acting) {
                let product = Term {
                    coefficients: t.coefficients.iter().chain(&u.coefficients).copied().collect(),
                    channel: t.channel,
                    series: u.series,
                    factor: t.factor * gain * u.factor,
                    unpredicted: u.unpredicted.clone(),
                    unpredicted_slope: u.unpredicted_slope.clone(),
                    ahead: t.ahead.iter().chain(&u.ahead).copied().collect(),
                    in_readout: t.in_readout,
                };
                if !declared.contains(&product.place()) {
                    products.push(product);
                }
            }
        }
        self.terms.extend(products);
    }

    /// A coefficient as a point has it. Of one that is there in several forms the first has its value, others none.
    fn factor(&self, i: usize) -> Factor {
        let c = self.coefficients[i];
        let is_another_form = self.coefficients[..i].iter().any(|other| other.name == c.name);
        Factor {
            name: ((c.estimate || c.candidate) && !is_another_form).then(|| c.name.clone()),
            value: if c.candidate { 0.0 } else { c.initial },
        }
    }

    /// Values of the coefficients at a point.
    fn values(&self, point: &Point) -> Vec<f64> {
        (0..self.coefficients.len()).map(|i| self.factor(i).at(&point.values)).collect()
    }

    /// What a little of a coefficient adds to the channels.
    fn to(&self, i: usize, values: &[f64]) -> Vec<Response> {
        let response = |t: &Term| {
            let scale = t.slope(i, values);
            (scale != 0.0).then_some((t.channel, t.series, t.factor * scale))
        };
        self.terms.iter().filter_map(response).collect()
    }

    /// Channels of whose innovations what a coefficient adds is not independent.
    fn not_weighed(&self, i: usize, values: &[f64]) -> Vec<usize> {
        let own = self.terms.iter().filter(|t| t.slope(i, values) != 0.0);
        let channels: BTreeSet<usize> = own.flat_map(|t| t.ahead.iter().copied()).collect();
        channels.into_iter().collect()
    }

    /// What the coefficients at these values add to the channels.
    fn known(&self, values: &[f64]) -> Vec<Response> {
        let response = |t: &Term| (t.channel, t.series, t.factor * t.scale(values));
        self.terms.iter().map(response).filter(|(.., factor)| *factor != 0.0).collect()
    }

    /// Columns of the channels and of the series among those of the chain.
    fn columns(&self, available: &Available) -> Result<Vec<usize>, WorkflowError> {
        let place = |(table, name): (String, String)| {
            let at = available.columns.iter().position(|c| c.table == table && c.name == name);
            at.ok_or(WorkflowError::NoColumn { table, name })
        };
        let channels = self.channels.iter().map(|c| (c.table.clone(), c.name.clone()));
        channels.chain(self.series.iter().cloned()).map(place).collect()
    }
}

impl Term {
    /// Product of the values of its coefficients.
    fn scale(&self, values: &[f64]) -> f64 {
        self.coefficients.iter().map(|i| values[*i]).product()
    }

    /// Derivative of that product by one of them; zero by any other.
    fn slope(&self, by: usize, values: &[f64]) -> f64 {
        let others = self.coefficients.iter().filter(|i| **i != by).map(|i| values[*i]);
        if self.coefficients.contains(&by) { others.product() } else { 0.0 }
    }

    /// Its channel, and the coefficients in proportion to which it acts.
    fn place(&self) -> (usize, BTreeSet<usize>) {
        (self.channel, self.coefficients.iter().copied().collect())
    }
}

/// The noise at a point, its predictor, and how it changes.
struct NoiseAt<'a> {
    responses: &'a Responses<'a>,
    system: NoiseStates,
    predictor: Predictor,
    /// Coefficients that filter a component.
    filters: Vec<usize>,
    values: Vec<f64>,
    levels: Vec<f64>,
}

impl<'a> NoiseAt<'a> {
    fn new(available: &Available, responses: &'a Responses<'a>, point: &Point) -> Result<Self, WorkflowError> {
        let refuse = |e: NoNoise| WorkflowError::NoLikelihood(e.0);
        let Some(rate_hz) = responses.channels.first().map(|c| c.rate_hz) else { return Err(WorkflowError::NoChannel) };
        let colours = responses.coefficients.iter().enumerate().filter_map(|(i, c)| Some((i, c.colours.clone()?)));
        let (filters, colours): (Vec<usize>, Vec<_>) = colours.unzip();
        let values = responses.values(point);
        let filtered: Vec<f64> = filters.iter().map(|i| values[*i]).collect();
        let system = NoiseStates::new(&available.noise, &responses.names, 1.0 / rate_hz, &colours, &filtered);
        let system = system.map_err(refuse)?;
        let level = |name: &String| point.levels.get(name).copied().unwrap_or(1.0);
        let levels: Vec<f64> = system.components.iter().map(level).collect();
        let driving = system.driving(&noise_point(responses, &filters, &values, &levels));
        let predictor = Predictor::new(&system, &driving).map_err(refuse)?;
        Ok(Self { responses, system, predictor, filters, values, levels })
    }

    fn driving(&self, values: &[f64], levels: &[f64]) -> DMatrix<f64> {
        self.system.driving(&noise_point(self.responses, &self.filters, values, levels))
    }

    /// How a coefficient changes the noise; none where it does not.
    fn by_coefficient(&self, i: usize) -> Option<Change> {
        let lacks = |t: &&Term| t.unpredicted.is_some() || t.unpredicted_slope.is_some();
        let mut acting = self.responses.terms.iter().filter(lacks);
        if !self.filters.contains(&i) && !acting.any(|t| t.coefficients.contains(&i)) {
            return None;
        }
        let half = DIFFERENCE * reach(self.responses.coefficients[i]);
        // A filter at zero has no states in the system, but its slope has.
        let filter = self.filters.iter().position(|own| *own == i).filter(|_| self.values[i] == 0.0);
        let extended = filter.map(|filter| self.system.extended(filter));
        let system = extended.as_ref().unwrap_or(&self.system);
        let at = |by: f64| {
            let mut moved = self.values.clone();
            moved[i] += by;
            system.driving(&noise_point(self.responses, &self.filters, &moved, &self.levels))
        };
        Some(self.predictor.change(system, &((at(half) - at(-half)) / (2.0 * half))))
    }

    /// How the logarithm of the level of a component changes it.
    fn by_level(&self, k: usize) -> Change {
        let at = |by: f64| {
            let mut moved = self.levels.clone();
            moved[k] *= 1.0 + by;
            self.driving(&self.values, &moved)
        };
        self.predictor.change(&self.system, &((at(DIFFERENCE) - at(-DIFFERENCE)) / (2.0 * DIFFERENCE)))
    }
}

/// On what the noise depends, at values of coefficients and levels.
fn noise_point(responses: &Responses<'_>, filters: &[usize], values: &[f64], levels: &[f64]) -> NoisePoint {
    let n = responses.names.len();
    let (mut unpredicted, mut unpredicted_slope) = (DMatrix::zeros(n, n), DMatrix::zeros(n, n));
    for t in &responses.terms {
        let value = t.factor * t.scale(values);
        for (gains, to) in [(&t.unpredicted, &mut unpredicted), (&t.unpredicted_slope, &mut unpredicted_slope)] {
            for (channel, gain) in gains.iter().flatten().enumerate() {
                to[(t.channel, channel)] += value * gain;
            }
        }
    }
    let filtered = filters.iter().map(|i| values[*i]).collect();
    NoisePoint { levels: levels.to_vec(), unpredicted, unpredicted_slope, filtered }
}

impl Filtered {
    /// The filter of one product's chain.
    ///
    /// # Errors
    /// [`WorkflowError::NoLikelihood`] where the declared noise cannot be filtered.
    pub(super) fn link(
        chain: &Chain,
        at: At<'_>,
        settings: &Settings,
        threads: usize,
    ) -> Result<Wanted<Self>, WorkflowError> {
        let At { point, slow, opening, number, block_s, data, search, waveforms } = at;
        let available = Available {
            columns: chain.columns.clone(),
            coefficients: chain.coefficients.clone(),
            constraints: chain.constraints.clone(),
            noise: chain.noise.iter().chain(slow).cloned().collect(),
        };
        let responses = Responses::of(&available)?;
        let noise = NoiseAt::new(&available, &responses, point)?;
        let mut unknowns: Vec<(String, Meaning, Parameter)> = Vec::new();
        let own = responses.series.len();
        let count = own + waveforms.len();
        // What is named stays as it is while constants are found: what it does to the noise is not asked for there.
        let asked = |c: &Coefficient| if c.candidate { !opening } else { c.estimate };
        for (i, c) in responses.coefficients.iter().enumerate().filter(|(_, c)| asked(c)) {
            let change = if opening { None } else { noise.by_coefficient(i) };
            let own = responses.to(i, &noise.values);
            if !own.is_empty() || change.is_some() {
                let meaning = Meaning::Coefficient(Box::new((*c).clone()));
                let not_weighed = responses.not_weighed(i, &noise.values);
                unknowns.push((c.name.clone(), meaning, Parameter { responses: own, change, not_weighed }));
            }
        }
        for (k, name) in noise.system.components.iter().enumerate().filter(|_| !opening) {
            let change = Some(noise.by_level(k));
            unknowns.push((name.clone(), Meaning::Level, Parameter { change, ..Parameter::default() }));
        }
        // Series without their means: a command may have one of 1e5 σ, which a constant of the channel takes exactly,
        // but for the digits that it would cost every sum.
        let means = point.means.get(number);
        let centre = |key: &(String, String)| means.and_then(|of| of.get(key)).copied().unwrap_or(0.0);
        let centres: Vec<f64> = responses.series.iter().map(centre).collect();
        let constant_of = |channel: usize| format!("{} day^0 of product {number}", responses.names[channel]);
        let constant = |t: &Term| Constant {
            power: constant_of(t.channel),
            coefficients: t.coefficients.iter().map(|i| responses.factor(*i)).collect(),
            amount: t.factor * centres[t.series] / noise.system.unit[t.channel],
        };
        let constants: Vec<Constant> = responses.terms.iter().map(constant).collect();
        let mut known = responses.known(&noise.values);
        for (channel, name) in responses.names.iter().enumerate() {
            for k in 0..POWERS {
                let power = format!("{name} day^{k} of product {number}");
                let (series, unit) = (count + k, noise.system.unit[channel]);
                let mean = constants.iter().filter(|c| c.power == power).map(|c| c.at(&point.values)).sum::<f64>();
                known.extend(point.powers.get(&power).map(|value| (channel, series, (value + mean) * unit)));
                let own = Parameter { responses: vec![(channel, series, unit)], ..Parameter::default() };
                unknowns.push((power, Meaning::Power, own));
            }
        }
        for (k, placed) in waveforms.iter().enumerate() {
            let to = placed.channels.iter().map(|(channel, factor)| (*channel, own + k, *factor)).collect();
            unknowns.push((
                format!("waveform {k}"),
                Meaning::Power,
                Parameter { responses: to, ..Parameter::default() },
            ));
        }
        let mut parameters = Vec::new();
        let mut filtered = Vec::new();
        for (name, meaning, parameter) in unknowns {
            parameters.push((name, meaning));
            filtered.push(parameter);
        }
        let rate_hz = responses.channels.first().map_or(0.0, |c| c.rate_hz);
        let innovations = Innovations::new(Setup {
            system: &noise.system,
            predictor: &noise.predictor,
            known,
            parameters: filtered,
            starts: point.starts.get(number).cloned().unwrap_or_default(),
            series: count,
            averaged: responses.channels.iter().any(|c| c.attribute("average") == "2"),
            step_ns: (1e9 / rate_hz).round() as i64,
            block: block_s.map(|length_s| (length_s * rate_hz).round() as u64),
            threads,
        });
        let innovations = if data { innovations } else { innovations.without_data() };
        let differenced: Vec<bool> = responses.channels.iter().map(|c| c.attribute("average") == "2").collect();
        let templates = if search { templates(&available, &responses.channels, &differenced) } else { Vec::new() };
        let innovations = if search { innovations.with_search(templates.clone()) } else { innovations };
        let acting = |i: usize| {
            let own = responses.terms.iter().filter(move |t| t.coefficients[0] == i);
            own.map(|t| responses.names[t.channel].clone()).collect()
        };
        let named = responses.coefficients.iter().enumerate();
        let all = Self {
            surveys: surveys(&available),
            channels: named.map(|(i, c)| (c.name.clone(), acting(i))).collect(),
            parameters,
            count: responses.names.len(),
            base: responses.base,
            held: vec![f64::NAN; own],
            sums: vec![0.0; own],
            summed: 0,
            waveforms: waveforms.iter().map(|placed| placed.waveform.clone()).collect(),
            templates,
            keys: responses.series.clone(),
            centres,
            constants,
            gaps: Gaps::of(&responses),
            rate_hz,
            patience: (settings.patience_s * rate_hz) as u64,
            not_before_ns: point.first_ns.get(number).copied().unwrap_or(i64::MIN),
            first_ns: None,
            innovations,
        };
        Ok((all, responses.columns(&available)?))
    }
}

impl Filtered {
    /// Means of the series.
    pub(super) fn means(&self) -> BTreeMap<(String, String), f64> {
        let rows = self.summed.max(1) as f64;
        self.keys.iter().cloned().zip(self.sums.iter().map(|sum| sum / rows)).collect()
    }
}

impl Sink for Filtered {
    fn tapped(&mut self, time_ns: &[i64], columns: &[&[f64]]) {
        let mut channels = vec![0.0; self.count];
        let own = columns.len() - self.count;
        let mut series = vec![0.0; own];
        let waveforms: Vec<Vec<f64>> = self.waveforms.iter().map(|w| w.over(time_ns)).collect();
        for (k, time_ns) in time_ns.iter().enumerate() {
            channels.iter_mut().zip(columns).for_each(|(x, column)| *x = column[k]);
            series.truncate(own);
            let waits = self.gaps.rows < self.patience;
            let mut begun = true;
            let measured = columns[..self.count + self.base].iter().all(|column| column[k].is_finite());
            for (s, x) in series.iter_mut().enumerate() {
                *x = columns[self.count + s][k];
                if s < self.base {
                    continue;
                }
                if x.is_finite() {
                    self.held[s] = *x;
                    self.gaps.never[s] = false;
                } else if self.held[s].is_finite() {
                    *x = self.held[s];
                    self.gaps.missing[s] += u64::from(measured);
                } else {
                    // Housekeeping may begin late; until it comes it is zero, and its effects are not tried if that is
                    // long.
                    begun &= !waits;
                    self.gaps.missing[s] += u64::from(measured && !waits);
                    *x = 0.0;
                }
            }
            self.gaps.never[..self.base].fill(false);
            self.gaps.rows += 1;
            self.gaps.measured += u64::from(measured);
            if !begun || *time_ns < self.not_before_ns {
                continue;
            }
            self.first_ns.get_or_insert(*time_ns);
            self.summed += u64::from(measured);
            for (s, x) in series.iter_mut().enumerate() {
                if measured {
                    self.sums[s] += *x;
                }
                *x -= self.centres[s];
            }
            series.extend(waveforms.iter().map(|w| w[k]));
            self.innovations.push(*time_ns, &channels, &series);
        }
    }
}

/// A scale of a coefficient: its σ before any data, its range, or one.
fn reach(c: &Coefficient) -> f64 {
    let widest = c.upper.abs().max(c.lower.abs());
    let known = [c.prior_sigma, widest].into_iter().find(|x| x.is_finite() && *x > 0.0);
    known.unwrap_or(1.0)
}

/// Surveys as Gaussians of the variance of an even distribution.
fn surveys(available: &Available) -> Vec<(Vec<(String, f64)>, Prior)> {
    let all = available.constraints.iter().filter(|c| c.kind == "survey");
    all.filter(|c| c.lower.is_finite() && c.upper.is_finite() && c.upper > c.lower)
        .map(|c| {
            let sigma = (c.upper - c.lower) / 12.0_f64.sqrt();
            (c.terms.clone(), Prior { mean: 0.5 * (c.lower + c.upper), sigma })
        })
        .collect()
}
