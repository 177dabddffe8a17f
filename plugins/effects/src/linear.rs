//! Base of effects whose coefficients act on channels through series with constant factors.
//!
//! A [`LinearEffect`] states, from the mission, on which channels each coefficient acts, through which [`Series`] and
//! with which factor. [`Linear`] adapts it to the SDK: it requests the columns, computes series that no stage writes,
//! and declares the responses. A response is what one unit of the coefficient adds to `measured − known`.

use std::collections::BTreeMap;
use std::collections::btree_map::Entry;
use std::marker::PhantomData;

use dragfree_physics::mission::Mission;
use dragfree_sdk::prelude::*;
use nalgebra::{Matrix2, Vector3};

pub(crate) use crate::columns::{Body, InputColumn, accel_channel, latest_column, unpredicted};
use crate::common::{AXES, SeriesRef, axis_of, mission};
use crate::prediction::{PredictedAcceleration, Predictor};
use crate::torque::{offset_name, through_offset};

/// A slowly varying factor of a column.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum Multiplier {
    /// Seconds from this Unix time, ns, to the middle of the sample; from the run's first epoch for `None`.
    Time(Option<i64>),
    /// Change of a column since its first value, with the sign turned if `lost`.
    Growth { column: InputColumn, lost: bool },
}

/// A series of a response: mean over `[t_k, t_{k+1})`.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum Series {
    /// The column itself.
    Column(InputColumn),
    /// Backward difference `(a_k − a_{k−1})/Δt`, with its unit; NaN at the first sample after a gap.
    Slope(InputColumn, &'static str),
    /// The column, with missing values replaced by the last valid one.
    Held(InputColumn),
    /// `(3 z_k − z_{k−1})/2` of a channel, NaN at the first sample after a gap. A channel is a mean over two samples
    /// already; this extrapolation undoes the estimators' second averaging up to a second difference.
    Newer(InputColumn),
    /// Backward difference of [`Self::Newer`] over Δt, with its unit; NaN at the first two samples after a gap.
    NewerSlope(InputColumn, &'static str),
    /// The column times a [`Multiplier`], with the unit of the product.
    Times(InputColumn, Multiplier, &'static str),
    /// Second difference of a predicted displacement.
    Predicted(Box<PredictedAcceleration>),
}

impl Series {
    /// Name of the series; series of one name have equal values.
    pub(crate) fn name(&self) -> String {
        match self {
            Self::Column(source) => source.name.clone(),
            Self::Slope(source, _) => format!("slope({})", source.name),
            Self::Held(source) => format!("held({})", source.name),
            Self::Newer(source) => format!("newer({})", source.name),
            Self::NewerSlope(source, _) => format!("slope(newer({}))", source.name),
            Self::Predicted(series) => series.name.clone(),
            Self::Times(source, Multiplier::Time(None), _) => format!("{}*elapsed_s", source.name),
            Self::Times(source, Multiplier::Time(Some(ns)), _) => format!("{}*seconds_since_{ns}_ns", source.name),
            Self::Times(source, Multiplier::Growth { column, lost }, _) => {
                format!("{}*{}({})", source.name, if *lost { "lost" } else { "gained" }, column.name)
            }
        }
    }

    fn source(&self) -> &InputColumn {
        match self {
            Self::Column(source)
            | Self::Slope(source, _)
            | Self::Held(source)
            | Self::Newer(source)
            | Self::NewerSlope(source, _)
            | Self::Times(source, _, _) => source,
            Self::Predicted(series) => &series.axes[0].readout,
        }
    }

    /// Attribute by which the series states what it lacks where its source has [`UNPREDICTED_ATTRIBUTE`]. The product
    /// with a multiplier has none, although it lacks something too: its gains vary with time.
    fn unpredicted_attribute(&self) -> Option<&'static str> {
        match self {
            Self::Held(_) => Some(UNPREDICTED_ATTRIBUTE),
            Self::Slope(..) => Some(UNPREDICTED_SLOPE_ATTRIBUTE),
            // A column states it itself; the others are made of channels, and not in prediction mode.
            Self::Column(_) | Self::Newer(_) | Self::NewerSlope(..) | Self::Times(..) | Self::Predicted(_) => None,
        }
    }

    fn unit(&self) -> &'static str {
        match self {
            Self::Column(source) | Self::Held(source) | Self::Newer(source) => source.unit,
            Self::Slope(_, unit) | Self::NewerSlope(_, unit) | Self::Times(_, _, unit) => unit,
            Self::Predicted(_) => "m s-2",
        }
    }
}

/// What one unit of a coefficient adds to a channel: `factor · series`, times the coefficient `times` if there is one.
#[derive(Clone, Debug)]
pub(crate) struct Term {
    pub(crate) channel: String,
    pub(crate) series: Series,
    pub(crate) factor: f64,
    pub(crate) times: Option<String>,
}

impl Term {
    pub(crate) fn new(channel: String, series: Series, factor: f64) -> Self {
        Self { channel, series, factor, times: None }
    }
}

/// One form of a coefficient: shape parameters, unit, range and responses.
#[derive(Clone, Debug)]
pub(crate) struct Form {
    pub(crate) shape: Shape,
    pub(crate) unit: String,
    pub(crate) range: [f64; 2],
    pub(crate) terms: Vec<Term>,
}

/// A coefficient: last part of its name (empty for the only one of an effect) and its forms. A candidate has one form
/// per value of the shape parameters; an effect in the model has one.
#[derive(Clone, Debug)]
pub(crate) struct CoefficientForms {
    pub(crate) name: &'static str,
    pub(crate) forms: Vec<Form>,
}

impl Form {
    /// Drops terms with a factor of zero.
    pub(crate) fn new(shape: Shape, unit: &str, range: [f64; 2], mut terms: Vec<Term>) -> Self {
        terms.retain(|term| term.factor != 0.0);
        Self { shape, unit: unit.to_owned(), range, terms }
    }
}

impl CoefficientForms {
    /// The single coefficient of an effect without shape parameters.
    pub(crate) fn only(unit: &str, range: [f64; 2], terms: Vec<Term>) -> Vec<Self> {
        vec![Self::named("", unit, range, terms)]
    }

    /// One of several coefficients of an effect without shape parameters.
    pub(crate) fn named(name: &'static str, unit: &str, range: [f64; 2], terms: Vec<Term>) -> Self {
        Self { name, forms: vec![Form::new(Shape::new(), unit, range, terms)] }
    }
}

/// Name of an attitude channel, `sc.alpha.x`, rad s⁻².
pub(crate) fn attitude_channel(axis: usize) -> String {
    format!("sc.alpha.{}", AXES[axis])
}

/// Terms of `Φ_row b`, the acceleration of a test mass by its offset: columns and coefficients of `com-offset`. Empty
/// if that effect is not earlier in the model. The diagonal of `Φ` is of order `ω²`, nearly constant and omitted.
pub(crate) fn offset_terms(available: &Available, tm: &Body, row: usize) -> Vec<(InputColumn, String)> {
    let channel = accel_channel(tm, row);
    let in_model = |name: &str| available.coefficient(name).is_some_and(|c| !c.candidate);
    let column = |name: &str| {
        let mut all = available.of_kind("regressor");
        all.find(|c| c.attribute("coefficient") == name && c.attribute("channel") == channel).cloned()
    };
    let names = (0..3).filter(|j| *j != row).map(|j| offset_name(&tm.name, j)).filter(|name| in_model(name));
    names.filter_map(|name| Some((InputColumn::of(&column(&name)?, "s-2"), name))).collect()
}

/// Acceleration of a test mass along an axis, `û + Φ b + d`: series, factor and multiplying coefficient per term.
pub(crate) struct TmAcceleration {
    /// `û + Φ b`.
    pub(crate) modelled: Vec<(Series, f64, Option<String>)>,
    /// Unmodelled acceleration `d`, estimated from the interferometers; empty in prediction mode.
    pub(crate) unmodelled: Vec<(Series, f64, Option<String>)>,
}

/// Acceleration of a test mass along an axis; Methods, "Acceleration of a test mass".
///
/// The control loop cancels most of `d`, chiefly thruster noise, by `û`, so `û` alone does not estimate the
/// acceleration.
///
/// `None` along s_3 and unless interferometers read x of exactly two test masses, where `d` is unobservable. In
/// prediction mode `d` is left to the host, which predicts it, so that every axis has an acceleration.
pub(crate) fn tm_acceleration(
    available: &Available,
    mission: &Mission,
    tm: &Body,
    axis: usize,
) -> Option<TmAcceleration> {
    let known = InputColumn::known_accel(tm, axis);
    let predicts = unpredicted(available, &known).is_some();
    let mut modelled = vec![(Series::Column(known), 1.0, None)];
    for (column, times) in offset_terms(available, tm, axis) {
        modelled.push((Series::Column(column), 1.0, Some(times)));
    }
    if predicts {
        return Some(TmAcceleration { modelled, unmodelled: Vec::new() });
    }
    let both = optical_pair(available, mission)?;
    if axis == 2 {
        return None;
    }
    let weights = optical_axis_weights(&both, tm, axis)?;
    let mut unmodelled = Vec::new();
    for (other, weight) in both.iter().zip(weights).filter(|(_, weight)| weight.abs() > 1e-12) {
        let (t, b) = (other.section.dcm_orf_from_srf(), other.section.offset_nominal_orf_m());
        unmodelled.push((Series::Newer(InputColumn::channel(other, 0)), weight, None));
        for j in 0..3 {
            let explained = t[(2, j)] * b.y - t[(1, j)] * b.z;
            unmodelled.push((Series::Column(InputColumn::alpha(j)), -weight * explained, None));
        }
    }
    Some(TmAcceleration { modelled, unmodelled })
}

/// The two test masses whose x is read by an interferometer; `None` if there are not exactly two.
pub(crate) fn optical_pair(available: &Available, mission: &Mission) -> Option<[Body; 2]> {
    let reads = |tm: &Body| {
        latest_column(available, &InputColumn::displacement(tm, 0).name).map_or("", |c| c.attribute("noise"))
    };
    let optical: Vec<Body> = Body::all(mission).into_iter().filter(|tm| reads(tm) == "ifo_x").collect();
    optical.try_into().ok()
}

/// Weights of two optical axes that give an axis in their plane; `None` if the optical axes are parallel.
pub(crate) fn optical_axis_weights(both: &[Body; 2], tm: &Body, axis: usize) -> Option<[f64; 2]> {
    let optical = both.each_ref().map(|tm| tm.section.dcm_orf_from_srf());
    let own = tm.section.dcm_orf_from_srf();
    let weight = own.fixed_view::<1, 2>(axis, 0) * Matrix2::from_fn(|i, j| optical[i][(0, j)]).try_inverse()?;
    Some(weight.into())
}

/// Terms of an error in `α̂`: if the angular acceleration is `α̂ + factor · δα`, the test masses show
/// `−factor [T δα ×] b` beyond `Φ(α̂) b`. `series(j)` is component j of `δα` in SRF. Empty without `com-offset` earlier
/// in the model.
///
/// # Errors
/// The mission has no test mass.
pub(crate) fn offset_coupling_terms(
    available: &Available,
    mission: &Mission,
    by: &'static str,
    series: impl Fn(usize) -> Series,
    factor: f64,
) -> Result<Vec<Term>, PluginError> {
    let mut terms = Vec::new();
    for tm in &Body::all(mission) {
        for j in 0..3 {
            let alpha = Vector3::ith(j, factor);
            let coupled = through_offset(available, &tm.name, &tm.section.dcm_orf_from_srf(), &alpha);
            terms.extend(coupled.map(|(row, times, factor)| Term {
                channel: accel_channel(tm, row),
                series: series(j),
                factor,
                times: Some(times),
            }));
        }
    }
    if mission.test_mass.is_empty() {
        return Err(PluginError::error(format!(
            "{by}: the mission file has no test mass; add a table [test_mass.NAME]"
        )));
    }
    Ok(terms)
}

/// Terms of an acceleration vector of a test mass, ORF, per unit of a series.
pub(crate) fn vector_terms(tm: &Body, series: &Series, per_unit: &Vector3<f64>) -> Vec<Term> {
    (0..3).map(|row| Term::new(accel_channel(tm, row), series.clone(), per_unit[row])).collect()
}

/// Axes of a pair instance, (from, to): `(1, 0)` for `NAME.y-x`.
pub(crate) fn axis_pair(instance: &str) -> (usize, usize) {
    let (first, to) = instance.split_once('-').unwrap_or((instance, "x"));
    (axis_of(first), axis_of(to))
}

/// An effect that acts linearly through series with constant factors.
pub(crate) trait LinearEffect: Send + 'static {
    /// Identity, parameters and instances.
    const MANIFEST: Manifest;
    /// Whether a readout differs, and not the motion that it reads.
    const IN_READOUT: bool = false;
    /// The coefficients of the instance that `setup` configures, and their terms.
    ///
    /// # Errors
    /// The mission or the telemetry lacks an input of the effect.
    fn coefficients(
        setup: &Setup,
        mission: &Mission,
        available: &Available,
    ) -> Result<Vec<CoefficientForms>, PluginError>;
}

/// SDK effect of a [`LinearEffect`].
pub(crate) struct Linear<E> {
    effect: PhantomData<E>,
    setup: Setup,
    mission: Mission,
    computed: Vec<ComputedSeries>,
    predicted: Vec<PredictedSeries>,
}

/// A predicted acceleration computed by this effect.
#[derive(Debug)]
struct PredictedSeries {
    predictor: Predictor,
    readouts: Vec<In>,
    known: Vec<Vec<(In, f64)>>,
    out: Out,
}

/// A series computed by this effect.
#[derive(Debug)]
struct ComputedSeries {
    state: SeriesState,
    input: In,
    multiplier: Option<In>,
    out: Out,
}

/// State of a computed series between samples.
#[derive(Debug)]
struct SeriesState {
    operation: Operation,
    /// Previous value, or the first value of a multiplier.
    value: f64,
    /// The value before that one.
    before: f64,
    /// Time of the previous row, or the origin of elapsed time, Unix ns.
    time_ns: Option<i64>,
}

#[derive(Clone, Copy, Debug)]
enum Operation {
    Slope,
    Newer,
    NewerSlope,
    Hold,
    /// Product with the seconds since `time_ns`.
    Elapsed,
    /// Product with `sign` times the change of the multiplier since its first value.
    Growth {
        sign: f64,
    },
}

impl SeriesState {
    /// Value of the next sample, from the column's value `a` at `now`, Unix ns, and the multiplier's.
    fn next(&mut self, now: i64, a: f64, multiplier: f64, dt_s: f64) -> f64 {
        match self.operation {
            Operation::Slope | Operation::Newer | Operation::NewerSlope => {
                // Undefined across a gap.
                let follows = self.time_ns.is_some_and(|t| ((now - t) as f64 * 1e-9 - dt_s).abs() < 0.5 * dt_s);
                let [before, second] = if follows { [self.value, self.before] } else { [f64::NAN; 2] };
                (self.time_ns, self.value, self.before) = (Some(now), a, before);
                match self.operation {
                    Operation::Newer => 1.5 * a - 0.5 * before,
                    Operation::NewerSlope => (1.5 * (a - before) - 0.5 * (before - second)) / dt_s,
                    _ => (a - before) / dt_s,
                }
            }
            Operation::Hold => {
                if a.is_finite() {
                    self.value = a;
                }
                self.value
            }
            Operation::Elapsed => {
                let since = *self.time_ns.get_or_insert(now);
                a * ((now - since) as f64 * 1e-9 + 0.5 * dt_s)
            }
            Operation::Growth { sign } => {
                if self.value.is_nan() {
                    self.value = multiplier;
                }
                // Before the first packet the change is taken as zero.
                a * if multiplier.is_finite() { sign * (multiplier - self.value) } else { 0.0 }
            }
        }
    }
}

impl<E: LinearEffect> Linear<E> {
    fn name(&self) -> String {
        format!("effect {}:{}", E::MANIFEST.id, self.setup.instance())
    }

    /// Table and name of a series; registers it for computation if no other effect writes it.
    fn series_ref(
        &mut self,
        series: &Series,
        available: &Available,
        link: &mut EffectLink<'_, '_>,
    ) -> Result<SeriesRef, PluginError> {
        let read = |source: &InputColumn, link: &mut EffectLink<'_, '_>| {
            let want = latest_column(available, &source.name).map_or_else(|| Want::new(&source.name), Want::of);
            link.read(&want.unit(source.unit).frame(&source.frame))
        };
        let name = series.name();
        if let Series::Predicted(wanted) = series {
            let (table, out) = link.shared_series(available, &name, series.unit(), &series.source().frame)?;
            let Some(out) = out else { return Ok((table, name)) };
            let (mut readouts, mut known) = (Vec::new(), Vec::new());
            for axis in &wanted.axes {
                readouts.push(read(&axis.readout, link)?);
                let column = |(source, factor): &(InputColumn, f64)| Ok((read(source, link)?, *factor));
                known.push(axis.known.iter().map(column).collect::<Result<_, PluginError>>()?);
            }
            self.predicted.push(PredictedSeries { predictor: Predictor::new(wanted), readouts, known, out });
            return Ok((table, name));
        }
        let input = read(series.source(), link)?;
        if let Series::Column(source) = series {
            let table = latest_column(available, &source.name).map(|c| c.table.clone()).unwrap_or_default();
            return Ok((table, name));
        }
        let lacks = unpredicted(available, series.source());
        let mut attributes: Vec<(&str, &str)> = Vec::new();
        attributes.extend(lacks.and_then(|gains| Some((series.unpredicted_attribute()?, gains))));
        let ahead = latest_column(available, &series.source().name).map_or("", |c| c.attribute(AHEAD_ATTRIBUTE));
        attributes.extend(Some((AHEAD_ATTRIBUTE, ahead)).filter(|(_, channels)| !channels.is_empty()));
        let (table, out) =
            link.shared_series_with(available, &name, series.unit(), &series.source().frame, &attributes)?;
        let Some(out) = out else { return Ok((table, name)) };
        let (operation, time_ns, multiplier) = match series {
            Series::Column(_) | Series::Held(_) | Series::Predicted(_) => (Operation::Hold, None, None),
            Series::Slope(..) => (Operation::Slope, None, None),
            Series::Newer(_) => (Operation::Newer, None, None),
            Series::NewerSlope(..) => (Operation::NewerSlope, None, None),
            Series::Times(_, Multiplier::Time(since), _) => (Operation::Elapsed, *since, None),
            Series::Times(_, Multiplier::Growth { column, lost }, _) => {
                (Operation::Growth { sign: if *lost { -1.0 } else { 1.0 } }, None, Some(read(column, link)?))
            }
        };
        self.computed.push(ComputedSeries {
            state: SeriesState { operation, value: f64::NAN, before: f64::NAN, time_ns },
            input,
            multiplier,
            out,
        });
        Ok((table, name))
    }

    fn check_channels(&self, available: &Available, acted_on: &[&Term]) -> Result<(), PluginError> {
        let all: Vec<&Column> = available.of_kind("channel").collect();
        let wanted = |c: &&Column| acted_on.iter().any(|term| term.channel == c.name);
        if let Some(c) = all.iter().copied().filter(wanted).find(|c| c.attribute("average") != "2") {
            return Err(PluginError::error(format!(
                "{}: channel {} is measured directly, but this effect acts on second differences of readouts; remove it from the \
                 model",
                self.name(),
                c.name
            )));
        }
        if all.iter().any(wanted) {
            return Ok(());
        }
        let mut names: Vec<&str> = acted_on.iter().map(|term| term.channel.as_str()).collect();
        names.sort_unstable();
        names.dedup();
        Err(PluginError::error(format!(
            "{} acts on {}, but no earlier stage writes any of them; put hinf-dfacs before the effects in the pipeline, or remove \
             the effect from the model",
            self.name(),
            if names.is_empty() {
                "the readouts of an instrument that is not there".to_owned()
            } else {
                names.join(", ")
            }
        )))
    }
}

impl<E: LinearEffect> Effect for Linear<E> {
    const MANIFEST: Manifest = E::MANIFEST;

    fn new(setup: &Setup) -> Result<Self, PluginError> {
        Ok(Self {
            effect: PhantomData,
            setup: setup.clone(),
            mission: mission(setup)?,
            computed: Vec::new(),
            predicted: Vec::new(),
        })
    }

    fn link(&mut self, available: &Available, link: &mut EffectLink<'_, '_>) -> Result<(), PluginError> {
        let coefficients = E::coefficients(&self.setup, &self.mission, available)?;
        let terms: Vec<&Term> = coefficients.iter().flat_map(|p| &p.forms).flat_map(|f| &f.terms).collect();
        self.check_channels(available, &terms)?;
        let mut series_refs: BTreeMap<String, SeriesRef> = BTreeMap::new();
        for term in terms {
            if let Entry::Vacant(entry) = series_refs.entry(term.series.name()) {
                entry.insert(self.series_ref(&term.series, available, link)?);
            }
        }
        let channels: Vec<&str> = available.of_kind("channel").map(|c| c.name.as_str()).collect();
        let responses = |form: &Form| -> Vec<Response> {
            let terms = form.terms.iter().filter(|t| channels.contains(&t.channel.as_str()));
            terms
                .map(|t| {
                    let (table, series) = series_refs.get(&t.series.name()).cloned().unwrap_or_default();
                    Response {
                        channel: t.channel.clone(),
                        table,
                        series,
                        factor: t.factor,
                        times: t.times.clone(),
                        in_readout: E::IN_READOUT,
                    }
                })
                .collect()
        };
        for declared in &coefficients {
            let Some(first) = declared.forms.first() else { continue };
            let [lower, upper] = first.range;
            let stem = format!("{}.{}", E::MANIFEST.id, self.setup.instance());
            let mut coefficient = Coefficient {
                name: if declared.name.is_empty() { stem } else { format!("{stem}.{}", declared.name) },
                unit: first.unit.clone(),
                lower,
                upper,
                // The physical range as three standard deviations.
                prior_sigma: upper.abs().max(lower.abs()) / 3.0,
                ..Coefficient::default()
            };
            if self.setup.candidate() && !first.shape.is_empty() {
                let variant = |form: &Form| Variant {
                    shape: form.shape.clone(),
                    responses: responses(form),
                    unit: Some(form.unit.clone()),
                    range: Some(form.range),
                    colours: None,
                };
                coefficient.variants = declared.forms.iter().map(variant).collect();
            } else {
                (coefficient.shape, coefficient.responses) = (first.shape.clone(), responses(first));
            }
            link.coefficient(&coefficient)?;
        }
        Ok(())
    }

    fn process(&mut self, input: &Inputs<'_>, output: &mut Outputs) -> Result<(), PluginError> {
        let dt_s = self.mission.dt_s();
        for series in &mut self.computed {
            let column = input.f64(series.input);
            let multiplier = input.f64(series.multiplier.unwrap_or(series.input));
            let out = output.f64(series.out);
            for ((now, a), multiplier) in input.time_ns().iter().zip(column).zip(multiplier) {
                out.push(series.state.next(*now, *a, *multiplier, dt_s));
            }
        }
        for series in &mut self.predicted {
            let axes = series.readouts.len();
            let (mut readout_m, mut known_m_s2) = (vec![0.0; axes], vec![0.0; axes]);
            let readouts: Vec<&[f64]> = series.readouts.iter().map(|column| input.f64(*column)).collect();
            let known: Vec<Vec<(&[f64], f64)>> = series
                .known
                .iter()
                .map(|columns| columns.iter().map(|(column, factor)| (input.f64(*column), *factor)).collect())
                .collect();
            let out = output.f64(series.out);
            for (row, now) in input.time_ns().iter().enumerate() {
                for axis in 0..axes {
                    readout_m[axis] = readouts[axis][row];
                    known_m_s2[axis] = known[axis].iter().map(|(column, factor)| column[row] * factor).sum();
                }
                out.push(series.predictor.next(*now, &readout_m, &known_m_s2));
            }
        }
        Ok(())
    }

    fn state(&mut self, state: &mut State<'_>) -> Result<(), PluginError> {
        for series in &mut self.computed {
            state.f64(&mut series.state.value)?;
            state.f64(&mut series.state.before)?;
            state.option(&mut series.state.time_ns, State::i64)?;
        }
        self.predicted.iter_mut().try_for_each(|series| series.predictor.save_or_load(state))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const NAN: f64 = f64::NAN;

    /// Values at samples of 0.1 s from rows (index, value, multiplier).
    fn computed_values(operation: Operation, since_ns: Option<i64>, rows: &[(i64, f64, f64)]) -> Vec<f64> {
        let mut state = SeriesState { operation, value: NAN, before: NAN, time_ns: since_ns };
        rows.iter().map(|(k, a, multiplier)| state.next(1_000 + k * 100_000_000, *a, *multiplier, 0.1)).collect()
    }

    fn same(got: &[f64], want: &[f64]) {
        let close = |(a, b): (&f64, &f64)| (a - b).abs() < 1e-12 || (a.is_nan() && b.is_nan());
        assert!(got.len() == want.len() && got.iter().zip(want).all(close), "{got:?} against {want:?}");
    }

    #[test]
    fn a_slope_is_taken_from_the_sample_before_and_never_across_a_gap() {
        let rows =
            [(0, 1.0, NAN), (1, 3.0, NAN), (2, 2.0, NAN), (4, 5.0, NAN), (5, 5.5, NAN), (6, NAN, NAN), (7, 1.0, NAN)];
        same(&computed_values(Operation::Slope, None, &rows), &[NAN, 20.0, -10.0, NAN, 5.0, NAN, NAN]);
    }

    /// For a straight line the mean of two samples returns the channel.
    #[test]
    fn the_newer_half_of_an_average_is_extrapolated() {
        let rows: Vec<(i64, f64, f64)> = (0..6).map(|k| (k + i64::from(k > 3), 2.0 * k as f64, NAN)).collect();
        let newer = computed_values(Operation::Newer, None, &rows);
        same(&newer, &[NAN, 3.0, 5.0, 7.0, NAN, 11.0]);
        assert_eq!(0.5 * (newer[2] + newer[3]), rows[3].1);
    }

    #[test]
    fn a_held_value_stays_until_the_next_one() {
        let rows = [(0, NAN, NAN), (1, 3.0, NAN), (2, NAN, NAN), (9, NAN, NAN), (10, 4.0, NAN)];
        same(&computed_values(Operation::Hold, None, &rows), &[NAN, 3.0, 3.0, 3.0, 4.0]);
    }

    #[test]
    fn time_counts_to_the_middle_of_the_sample() {
        let rows = [(0, 2.0, NAN), (1, 2.0, NAN), (20, 1.0, NAN)];
        same(&computed_values(Operation::Elapsed, None, &rows), &[0.1, 0.3, 2.05]);
        same(&computed_values(Operation::Elapsed, Some(1_000 - 1_000_000_000), &rows), &[2.1, 2.3, 3.05]);
    }

    #[test]
    fn growth_counts_from_the_first_value_and_is_nothing_before() {
        let rows = [(0, 2.0, NAN), (1, 2.0, 7.0), (2, 2.0, 7.5), (3, 3.0, 6.0)];
        same(&computed_values(Operation::Growth { sign: 1.0 }, None, &rows), &[0.0, 0.0, 1.0, -3.0]);
        same(&computed_values(Operation::Growth { sign: -1.0 }, None, &rows), &[0.0, 0.0, -1.0, 3.0]);
    }

    #[test]
    fn series_of_one_name_are_one_series() {
        let series = [
            Series::Column(InputColumn::alpha(0)),
            Series::Slope(InputColumn::alpha(0), "rad s-3"),
            Series::Held(InputColumn::alpha(0)),
            Series::Times(InputColumn::alpha(0), Multiplier::Time(None), "rad s-1"),
            Series::Times(InputColumn::alpha(0), Multiplier::Time(Some(5)), "rad s-1"),
            Series::Times(
                InputColumn::alpha(0),
                Multiplier::Growth { column: InputColumn::sun(0), lost: true },
                "rad s-2",
            ),
            Series::Times(
                InputColumn::alpha(0),
                Multiplier::Growth { column: InputColumn::sun(0), lost: false },
                "rad s-2",
            ),
            Series::Times(
                InputColumn::alpha(0),
                Multiplier::Growth { column: InputColumn::sun(1), lost: false },
                "rad s-2",
            ),
            Series::Slope(InputColumn::alpha(1), "rad s-3"),
        ];
        let names: std::collections::BTreeSet<String> = series.iter().map(Series::name).collect();
        assert_eq!(names.len(), series.len());
    }
}
