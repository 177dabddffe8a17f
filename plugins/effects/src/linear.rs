//! What most effects have in common: coefficients that act on channels through series with constant factors.
//!
//! An effect is a [`Recipe`]: from the mission it works out on which channels each of its coefficients acts, through which
//! [`Series`], with which factor. [`Linear`] asks for the columns, computes the series that are not columns, and declares the
//! responses. All of it describes what one unit of the coefficient adds to `measured − known`.

use std::collections::BTreeMap;
use std::collections::btree_map::Entry;

use dragfree_physics::mission::{Mission, TestMass};
use dragfree_sdk::prelude::*;
use nalgebra::{Matrix2, Vector3};

/// Axes as the columns name them.
pub(crate) const AXES: [&str; 3] = ["x", "y", "z"];
/// Angles about them.
pub(crate) const ANGLES: [&str; 3] = ["phi", "theta", "psi"];
const STATE: &[u8; 8] = b"linear/1";

/// A column that somebody before the effect makes.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Source {
    pub(crate) name: String,
    pub(crate) unit: &'static str,
    pub(crate) frame: String,
}

impl Source {
    fn new(name: String, unit: &'static str, frame: impl Into<String>) -> Self {
        Self { name, unit, frame: frame.into() }
    }

    /// Commanded force of the thrusters, mean over the sample, SRF, N.
    pub(crate) fn thrust(axis: usize) -> Self {
        Self::new(format!("used.mps_force_srf_n.{}", AXES[axis]), "N", "SRF")
    }

    /// Commanded torque of the thrusters, SRF, N m.
    pub(crate) fn torque(axis: usize) -> Self {
        Self::new(format!("used.mps_torque_srf_nm.{}", AXES[axis]), "N m", "SRF")
    }

    /// Commanded force of the electrodes on a test mass, ORF, N.
    pub(crate) fn electrodes_force(tm: usize, axis: usize) -> Self {
        Self::new(format!("used.{}.force_orf_n.{}", tm_name(tm), AXES[axis]), "N", orf(tm))
    }

    /// Their torque, ORF, N m.
    pub(crate) fn electrodes_torque(tm: usize, axis: usize) -> Self {
        Self::new(format!("used.{}.torque_orf_nm.{}", tm_name(tm), AXES[axis]), "N m", orf(tm))
    }

    /// Unit vector from the Sun, SRF.
    pub(crate) fn sun(axis: usize) -> Self {
        Self::new(format!("used.sun_srf.{}", AXES[axis]), "1", "SRF")
    }

    /// `û`, ORF, m s⁻².
    pub(crate) fn known(tm: usize, axis: usize) -> Self {
        Self::new(format!("{}.u_orf_m_s2.{}", tm_name(tm), AXES[axis]), "m s-2", orf(tm))
    }

    /// Channel of a test mass, m s⁻².
    pub(crate) fn channel(tm: usize, axis: usize) -> Self {
        Self::new(accel(tm, axis), "m s-2", orf(tm))
    }

    /// Best readout of a displacement, ORF, m.
    pub(crate) fn displacement(tm: usize, axis: usize) -> Self {
        Self::new(format!("{}.r_orf_m.{}", tm_name(tm), AXES[axis]), "m", orf(tm))
    }

    /// Estimate of the spacecraft's angular acceleration `α̂`, SRF, rad s⁻².
    pub(crate) fn alpha(axis: usize) -> Self {
        Self::new(format!("sc.alpha_srf_rad_s2.{}", AXES[axis]), "rad s-2", "SRF")
    }

    /// `∂α̂_j/∂g_i` for a torque about axis `i` that is `1 + g_i` times the commanded one, SRF, rad s⁻².
    pub(crate) fn alpha_by_torque_gain(i: usize, j: usize) -> Self {
        let name = format!("response.alpha_srf_rad_s2.by_torque_gain.{}.{}", AXES[i], AXES[j]);
        Self::new(name, "rad s-2", "SRF")
    }

    /// `∂û_row/∂g_i` of a test mass, ORF, m s⁻²; only where thrusters have a layout.
    pub(crate) fn known_by_torque_gain(i: usize, tm: usize, row: usize) -> Self {
        let name = format!("response.u_orf_m_s2.by_torque_gain.{}.{}.{}", AXES[i], tm_name(tm), AXES[row]);
        Self::new(name, "m s-2", orf(tm))
    }

    /// `∂α̂_j/∂τ` for an attitude that is read `τ` late, late minus on time, SRF, rad s⁻³.
    pub(crate) fn alpha_by_dws_delay(j: usize) -> Self {
        Self::new(format!("response.alpha_srf_rad_s2.by_dws_delay.{}", AXES[j]), "rad s-3", "SRF")
    }

    /// Local wavefront sensing of a test mass, ORF, rad.
    pub(crate) fn angle_by_dws(tm: usize, angle: &str) -> Self {
        Self::new(format!("dws.{}.{angle}_orf_rad", tm_name(tm)), "rad", orf(tm))
    }

    /// Capacitive readout of its attitude, ORF, rad.
    pub(crate) fn angle_by_is(tm: usize, angle: &str) -> Self {
        Self::new(format!("is.{}.att_orf_rad.{angle}", tm_name(tm)), "rad", orf(tm))
    }

    /// A column found among those that there are.
    pub(crate) fn of(column: &Column, unit: &'static str) -> Self {
        Self::new(column.name.clone(), unit, &column.frame)
    }
}

/// What varies with time by which a column is multiplied.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum Driver {
    /// Seconds from this Unix time, ns, to the middle of the sample; from the first epoch of the run with `None`.
    Time(Option<i64>),
    /// What a column has grown since its first value, or shrunk where `lost`.
    Growth { column: Source, lost: bool },
}

/// A series that channels answer to, mean over `[t_k, t_{k+1})`.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum Series {
    /// A column as it is.
    Column(Source),
    /// `(a_k − a_{k−1})/Δt` of a column, and its unit. No value where there is none before.
    Slope(Source, &'static str),
    /// A column, or its last value where it has none.
    Held(Source),
    /// `(3 z_k − z_{k−1})/2` of a channel, which is an acceleration averaged over two samples already: what of it belongs to the
    /// newer one, so that the estimators' average gives `z_k` again but for a second difference. No value where there is none before.
    Newer(Source),
    /// A column times something slow, and the unit of the product.
    Times(Source, Driver, &'static str),
}

impl Series {
    /// Says all that the values depend on.
    pub(crate) fn name(&self) -> String {
        match self {
            Self::Column(source) => source.name.clone(),
            Self::Slope(source, _) => format!("slope({})", source.name),
            Self::Held(source) => format!("held({})", source.name),
            Self::Newer(source) => format!("newer({})", source.name),
            Self::Times(source, Driver::Time(None), _) => format!("{}*elapsed_s", source.name),
            Self::Times(source, Driver::Time(Some(ns)), _) => format!("{}*seconds_since_{ns}_ns", source.name),
            Self::Times(source, Driver::Growth { column, lost }, _) => {
                format!("{}*{}({})", source.name, if *lost { "lost" } else { "gained" }, column.name)
            }
        }
    }

    fn source(&self) -> &Source {
        match self {
            Self::Column(source)
            | Self::Slope(source, _)
            | Self::Held(source)
            | Self::Newer(source)
            | Self::Times(source, _, _) => source,
        }
    }

    fn unit(&self) -> &'static str {
        match self {
            Self::Column(source) | Self::Held(source) | Self::Newer(source) => source.unit,
            Self::Slope(_, unit) | Self::Times(_, _, unit) => unit,
        }
    }
}

/// What one unit of a coefficient adds to a channel: `factor` times the series, times another coefficient's value.
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

/// One form of a coefficient: the shape parameters that give it, its unit, its range, and what it does.
#[derive(Clone, Debug)]
pub(crate) struct Form {
    pub(crate) shape: Shape,
    pub(crate) unit: String,
    pub(crate) range: [f64; 2],
    pub(crate) terms: Vec<Term>,
}

/// A coefficient: the last part of its name, empty where the effect has only one, and its forms: one, or for a candidate one
/// for each value of the shape parameters.
#[derive(Clone, Debug)]
pub(crate) struct Part {
    pub(crate) name: &'static str,
    pub(crate) forms: Vec<Form>,
}

impl Form {
    /// Without the terms that do nothing.
    pub(crate) fn new(shape: Shape, unit: &str, range: [f64; 2], mut terms: Vec<Term>) -> Self {
        terms.retain(|term| term.factor != 0.0);
        Self { shape, unit: unit.to_owned(), range, terms }
    }
}

impl Part {
    /// The only coefficient of an effect without shape parameters.
    pub(crate) fn only(unit: &str, range: [f64; 2], terms: Vec<Term>) -> Vec<Self> {
        vec![Self::named("", unit, range, terms)]
    }

    /// One of several.
    pub(crate) fn named(name: &'static str, unit: &str, range: [f64; 2], terms: Vec<Term>) -> Self {
        Self { name, forms: vec![Form::new(Shape::new(), unit, range, terms)] }
    }
}

/// The column of this name that was made last: what a stage made of telemetry, `tm1.r_orf_m.y` of the reconstruction, rather than
/// the raw topic's of the same name.
pub(crate) fn latest<'a>(available: &'a Available, name: &str) -> Option<&'a Column> {
    available.columns.iter().rev().find(|c| c.name == name)
}

/// `tm1.accel.x`, m s⁻².
pub(crate) fn accel(tm: usize, axis: usize) -> String {
    format!("{}.accel.{}", tm_name(tm), AXES[axis])
}

/// `sc.alpha.x`, rad s⁻².
pub(crate) fn turn(axis: usize) -> String {
    format!("sc.alpha.{}", AXES[axis])
}

/// `tm1` of 0.
pub(crate) fn tm_name(tm: usize) -> String {
    format!("tm{}", tm + 1)
}

fn orf(tm: usize) -> String {
    format!("ORF_{}", tm + 1)
}

/// Name of an offset's component.
pub(crate) fn offset(tm: usize, axis: usize) -> String {
    format!("com-offset.{}.{}", tm_name(tm), AXES[axis])
}

/// The accelerations of one test mass by its offset, `Φ_row b`, as the model's `com-offset` has them; empty where that stands
/// not before in the model, as then nobody says what `b` is. The diagonal of `Φ` is left out: it is `ω²`, a constant of 1e-13 s⁻².
pub(crate) fn offset_terms(available: &Available, tm: usize, row: usize) -> Vec<(Source, String)> {
    let channel = accel(tm, row);
    let known = |name: &str| available.coefficient(name).is_some_and(|c| !c.candidate);
    let column = |name: &str| {
        let mut all = available.of_kind("regressor");
        all.find(|c| c.attribute("coefficient") == name && c.attribute("channel") == channel).cloned()
    };
    let names = (0..3).filter(|j| *j != row).map(|j| offset(tm, j)).filter(|name| known(name));
    names.filter_map(|name| Some((Source::of(&column(&name)?, "s-2"), name))).collect()
}

/// The acceleration of a test mass along an axis, `û + Φ b + d`: of each part a piece, its factor, and the coefficient that it is
/// multiplied with.
pub(crate) struct Motion {
    /// `û + Φ b`.
    pub(crate) known: Vec<(Piece, f64, Option<String>)>,
    /// The push `d` that nobody commanded, as interferometers tell it.
    pub(crate) push: Vec<(Piece, f64, Option<String>)>,
}

/// How a test mass moves along an axis.
///
/// Above all `d` is the thrusters' noise, `−T_S^{O_i} n/m_S`, which the loop works against: what is left of `û + d` is much less than
/// either, so that `û` alone is no estimate of the motion. It is common to both test masses. In the plane of the two optical axes
/// the two channels `z_x − Φ_x b` are what it does along them, and two equations give it, finer than any capacitive readout; the
/// mission's nominal offsets are good enough there. Along s_3 no interferometer looks.
///
/// `None` along s_3 and without both interferometers: then nobody knows `d`.
pub(crate) fn motion(available: &Available, mission: &Mission, tm: usize, axis: usize) -> Option<Motion> {
    let reads = |tm: usize| latest(available, &Source::displacement(tm, 0).name).map_or("", |c| c.attribute("noise"));
    if axis == 2 || reads(0) != "ifo_x" || reads(1) != "ifo_x" {
        return None;
    }
    let weight = of_optical_axes(mission, tm, axis)?;
    let mut known = vec![(Piece::Column(Source::known(tm, axis)), 1.0, None)];
    for (column, times) in offset_terms(available, tm, axis) {
        known.push((Piece::Column(column), 1.0, Some(times)));
    }
    let mut push = Vec::new();
    for other in (0..2).filter(|other| weight[*other].abs() > 1e-12) {
        let body = mission.test_mass.get(&tm_name(other))?;
        let (t, b) = (body.dcm_orf_from_srf(), body.offset_nominal_orf_m());
        push.push((Piece::Channel(Source::channel(other, 0)), weight[other], None));
        for j in 0..3 {
            let explained = t[(2, j)] * b.y - t[(1, j)] * b.z;
            push.push((Piece::Column(Source::alpha(j)), -weight[other] * explained, None));
        }
    }
    Some(Motion { known, push })
}

/// An axis of a test mass in the plane of the two optical axes, as their combination; `None` where they are parallel.
pub(crate) fn of_optical_axes(mission: &Mission, tm: usize, axis: usize) -> Option<[f64; 2]> {
    let dcm = |tm: usize| mission.test_mass.get(&tm_name(tm)).map(TestMass::dcm_orf_from_srf);
    let both = [dcm(0)?, dcm(1)?];
    let weight = both[tm].fixed_view::<1, 2>(axis, 0) * Matrix2::from_fn(|i, j| both[i][(0, j)]).try_inverse()?;
    Some(weight.into())
}

/// What a [`motion`] is made of.
#[derive(Clone, Debug)]
pub(crate) enum Piece {
    /// A mean over `[t_k, t_{k+1})`.
    Column(Source),
    /// A channel, averaged over two.
    Channel(Source),
}

impl Piece {
    /// The motion itself.
    pub(crate) fn series(self) -> Series {
        match self {
            Self::Column(source) => Series::Column(source),
            Self::Channel(source) => Series::Newer(source),
        }
    }
}

/// Where the right angular acceleration is `α̂ + factor · δα`, with `δα` as series of SRF components, the test masses' channels
/// show `−factor [T δα ×] b` more than the `Φ(α̂) b` of the model. Without `com-offset` before it in the model nobody says what
/// `b` is, and there is no such term.
pub(crate) fn through_offset(
    available: &Available,
    mission: &Mission,
    by: &'static str,
    series: impl Fn(usize) -> Series,
    factor: f64,
) -> Result<Vec<Term>, PluginError> {
    let mut terms = Vec::new();
    for tm in 0..2 {
        let Some(test_mass) = mission.test_mass.get(&tm_name(tm)) else { continue };
        let t = test_mass.dcm_orf_from_srf();
        for (row, axis) in (0..3).flat_map(|row| (0..3).map(move |axis| (row, axis))).filter(|(r, a)| r != a) {
            let times = offset(tm, axis);
            if available.coefficient(&times).is_none_or(|c| c.candidate) {
                continue;
            }
            // (−a × b)_row = ε · a_other · b_axis with the third axis `other`.
            let other = 3 - row - axis;
            let sign = if (row + 1) % 3 == axis { 1.0 } else { -1.0 };
            for j in 0..3 {
                terms.push(Term {
                    channel: accel(tm, row),
                    series: series(j),
                    factor: sign * factor * t[(other, j)],
                    times: Some(times.clone()),
                });
            }
        }
    }
    if mission.test_mass.is_empty() {
        return Err(PluginError::error(format!("{by}: the mission file has no table [test_mass.tm1]; add it")));
    }
    Ok(terms)
}

/// A constant vector of accelerations of a test mass, ORF, per unit of a series.
pub(crate) fn push(tm: usize, series: &Series, per_unit: &Vector3<f64>) -> Vec<Term> {
    (0..3).map(|row| Term::new(accel(tm, row), series.clone(), per_unit[row])).collect()
}

/// `tm1.y` is `(0, 1)`; the manifest lists what there is.
pub(crate) fn tm_axis(instance: &str) -> (usize, usize) {
    let (tm, axis) = instance.split_once('.').unwrap_or((instance, "x"));
    (usize::from(tm == "tm2"), axis_of(axis))
}

/// `tm1.y-x` is `(0, 1, 0)`: test mass, from, to.
pub(crate) fn tm_pair(instance: &str) -> (usize, usize, usize) {
    let (first, to) = instance.split_once('-').unwrap_or((instance, "x"));
    let (tm, from) = tm_axis(first);
    (tm, from, axis_of(to))
}

/// `sc.x` is 0.
pub(crate) fn sc_axis(instance: &str) -> usize {
    axis_of(instance.rsplit('.').next().unwrap_or_default())
}

fn axis_of(letter: &str) -> usize {
    AXES.iter().position(|axis| *axis == letter).unwrap_or(0)
}

/// What is particular to an effect.
pub(crate) trait Recipe: Send + Sized + 'static {
    /// What it is.
    const MANIFEST: Manifest;
    /// Takes what it needs of the configuration.
    ///
    /// # Errors
    /// The configuration has no sense for this effect.
    fn new(setup: &Setup) -> Result<Self, PluginError>;
    /// Its coefficients.
    ///
    /// # Errors
    /// The mission or the telemetry lacks what the effect needs.
    fn parts(&self, mission: &Mission, available: &Available) -> Result<Vec<Part>, PluginError>;
}

/// An effect made from its recipe.
#[derive(Debug)]
pub(crate) struct Linear<R> {
    recipe: R,
    mission: Mission,
    instance: String,
    candidate: bool,
    made: Vec<Made>,
}

/// A series that this effect computes.
#[derive(Debug)]
struct Made {
    step: Step,
    input: In,
    driver: Option<In>,
    out: Out,
}

/// From one sample to the next.
#[derive(Debug)]
struct Step {
    rule: Rule,
    /// The value before, or the first of a driver.
    value: f64,
    /// Time of the row before, or from which time counts, Unix ns.
    time_ns: Option<i64>,
}

#[derive(Clone, Copy, Debug)]
enum Rule {
    Slope,
    Newer,
    Hold,
    /// Times the seconds since `time_ns`.
    Elapsed,
    /// Times `sign` of what a driver has grown since its first value.
    Growth {
        sign: f64,
    },
}

impl Step {
    /// The next sample, from the column's value `a` at `now` and the driver's, where there is one.
    fn next(&mut self, now: i64, a: f64, driver: f64, dt_s: f64) -> f64 {
        match self.rule {
            Rule::Slope | Rule::Newer => {
                // Across a gap there is no slope.
                let follows = self.time_ns.is_some_and(|t| ((now - t) as f64 * 1e-9 - dt_s).abs() < 0.5 * dt_s);
                let before = if follows { self.value } else { f64::NAN };
                (self.time_ns, self.value) = (Some(now), a);
                if matches!(self.rule, Rule::Newer) { 1.5 * a - 0.5 * before } else { (a - before) / dt_s }
            }
            Rule::Hold => {
                if a.is_finite() {
                    self.value = a;
                }
                self.value
            }
            Rule::Elapsed => {
                let since = *self.time_ns.get_or_insert(now);
                a * ((now - since) as f64 * 1e-9 + 0.5 * dt_s)
            }
            Rule::Growth { sign } => {
                if self.value.is_nan() {
                    self.value = driver;
                }
                // Before its first packet nothing is known to have changed.
                a * if driver.is_finite() { sign * (driver - self.value) } else { 0.0 }
            }
        }
    }
}

impl<R: Recipe> Linear<R> {
    fn name(&self) -> String {
        format!("effect {}:{}", R::MANIFEST.id, self.instance)
    }

    /// What a series is called and where it stands; made here where nobody makes it yet.
    fn place(
        &mut self,
        series: &Series,
        available: &Available,
        link: &mut EffectLink<'_, '_>,
    ) -> Result<(String, String), PluginError> {
        let read = |source: &Source, link: &mut EffectLink<'_, '_>| {
            let want = latest(available, &source.name).map_or_else(|| Want::new(&source.name), Want::of);
            link.read(&want.unit(source.unit).frame(&source.frame))
        };
        let name = series.name();
        let input = read(series.source(), link)?;
        if let Series::Column(source) = series {
            let table = latest(available, &source.name).map(|c| c.table.clone()).unwrap_or_default();
            return Ok((table, name));
        }
        let (table, out) = link.shared_series(available, &name, series.unit(), &series.source().frame)?;
        let Some(out) = out else { return Ok((table, name)) };
        let (rule, time_ns, driver) = match series {
            Series::Column(_) | Series::Held(_) => (Rule::Hold, None, None),
            Series::Slope(..) => (Rule::Slope, None, None),
            Series::Newer(_) => (Rule::Newer, None, None),
            Series::Times(_, Driver::Time(since), _) => (Rule::Elapsed, *since, None),
            Series::Times(_, Driver::Growth { column, lost }, _) => {
                (Rule::Growth { sign: if *lost { -1.0 } else { 1.0 } }, None, Some(read(column, link)?))
            }
        };
        self.made.push(Made { step: Step { rule, value: f64::NAN, time_ns }, input, driver, out });
        Ok((table, name))
    }

    fn check_channels(&self, available: &Available, acted_on: &[&Term]) -> Result<(), PluginError> {
        let all: Vec<&Column> = available.of_kind("channel").collect();
        let wanted = |c: &&Column| acted_on.iter().any(|term| term.channel == c.name);
        if let Some(c) = all.iter().copied().filter(wanted).find(|c| c.attribute("average") != "2") {
            return Err(PluginError::error(format!(
                "{}: channel {} is measured directly, and this effect acts on second differences of readouts; take it out of the \
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
            "{} acts on {}, and no stage before it makes any of them; put hinf-dfacs before the effects, or take it out of the model",
            self.name(),
            if names.is_empty() { "readouts of this instrument".to_owned() } else { names.join(", ") }
        )))
    }
}

impl<R: Recipe> Effect for Linear<R> {
    const MANIFEST: Manifest = R::MANIFEST;

    fn new(setup: &Setup) -> Result<Self, PluginError> {
        Ok(Self {
            recipe: R::new(setup)?,
            mission: Mission::from_json(setup.mission_json())?,
            instance: setup.instance().to_owned(),
            candidate: setup.candidate(),
            made: Vec::new(),
        })
    }

    fn link(&mut self, available: &Available, link: &mut EffectLink<'_, '_>) -> Result<(), PluginError> {
        let parts = self.recipe.parts(&self.mission, available)?;
        let terms: Vec<&Term> = parts.iter().flat_map(|p| &p.forms).flat_map(|f| &f.terms).collect();
        self.check_channels(available, &terms)?;
        let mut places: BTreeMap<String, (String, String)> = BTreeMap::new();
        for term in terms {
            if let Entry::Vacant(place) = places.entry(term.series.name()) {
                place.insert(self.place(&term.series, available, link)?);
            }
        }
        let channels: Vec<&str> = available.of_kind("channel").map(|c| c.name.as_str()).collect();
        let responses = |form: &Form| -> Vec<Response> {
            let terms = form.terms.iter().filter(|t| channels.contains(&t.channel.as_str()));
            terms
                .map(|t| {
                    let (table, series) = places.get(&t.series.name()).cloned().unwrap_or_default();
                    Response { channel: t.channel.clone(), table, series, factor: t.factor, times: t.times.clone() }
                })
                .collect()
        };
        for part in &parts {
            let Some(first) = part.forms.first() else { continue };
            let [lower, upper] = first.range;
            let stem = format!("{}.{}", R::MANIFEST.id, self.instance);
            let mut coefficient = Coefficient {
                name: if part.name.is_empty() { stem } else { format!("{stem}.{}", part.name) },
                unit: first.unit.clone(),
                lower,
                upper,
                // The physical range as three standard deviations.
                prior_sigma: upper.abs().max(lower.abs()) / 3.0,
                ..Coefficient::default()
            };
            if self.candidate && !first.shape.is_empty() {
                let variant = |form: &Form| Variant {
                    shape: form.shape.clone(),
                    responses: responses(form),
                    unit: Some(form.unit.clone()),
                    range: Some(form.range),
                    colours: None,
                };
                coefficient.variants = part.forms.iter().map(variant).collect();
            } else {
                (coefficient.shape, coefficient.responses) = (first.shape.clone(), responses(first));
            }
            link.coefficient(&coefficient)?;
        }
        Ok(())
    }

    fn process(&mut self, input: &Inputs<'_>, output: &mut Outputs) -> Result<(), PluginError> {
        let dt_s = self.mission.dt_s();
        for made in &mut self.made {
            let column = input.f64(made.input);
            let driver = input.f64(made.driver.unwrap_or(made.input));
            let out = output.f64(made.out);
            for ((now, a), driver) in input.time_ns().iter().zip(column).zip(driver) {
                out.push(made.step.next(*now, *a, *driver, dt_s));
            }
        }
        Ok(())
    }

    fn save(&self) -> Result<Vec<u8>, PluginError> {
        if self.made.is_empty() {
            return Ok(Vec::new());
        }
        let mut bytes = STATE.to_vec();
        for made in &self.made {
            bytes.extend_from_slice(&made.step.value.to_le_bytes());
            bytes.extend_from_slice(&made.step.time_ns.unwrap_or(i64::MIN).to_le_bytes());
        }
        Ok(bytes)
    }

    fn load(&mut self, state: &[u8]) -> Result<(), PluginError> {
        let body = if self.made.is_empty() { Some(state) } else { state.strip_prefix(STATE) };
        let (words, rest) = body.unwrap_or(&[0]).as_chunks::<8>();
        if !rest.is_empty() || words.len() != 2 * self.made.len() {
            return Err(PluginError::error(format!(
                "{}: {} bytes are not a state of its {} series; it was saved by another version or for another model, start from \
                 the telemetry",
                self.name(),
                state.len(),
                self.made.len()
            )));
        }
        for (made, word) in self.made.iter_mut().zip(words.chunks_exact(2)) {
            made.step.value = f64::from_le_bytes(word[0]);
            made.step.time_ns = Some(i64::from_le_bytes(word[1])).filter(|t| *t != i64::MIN);
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const NAN: f64 = f64::NAN;

    /// Values at samples of 0.1 s, counted from an arbitrary time, with the driver's.
    fn stepped(rule: Rule, since_ns: Option<i64>, rows: &[(i64, f64, f64)]) -> Vec<f64> {
        let mut step = Step { rule, value: NAN, time_ns: since_ns };
        rows.iter().map(|(k, a, driver)| step.next(1_000 + k * 100_000_000, *a, *driver, 0.1)).collect()
    }

    fn same(got: &[f64], want: &[f64]) {
        let close = |(a, b): (&f64, &f64)| (a - b).abs() < 1e-12 || (a.is_nan() && b.is_nan());
        assert!(got.len() == want.len() && got.iter().zip(want).all(close), "{got:?} against {want:?}");
    }

    #[test]
    fn a_slope_is_taken_from_the_sample_before_and_never_across_a_gap() {
        let rows =
            [(0, 1.0, NAN), (1, 3.0, NAN), (2, 2.0, NAN), (4, 5.0, NAN), (5, 5.5, NAN), (6, NAN, NAN), (7, 1.0, NAN)];
        same(&stepped(Rule::Slope, None, &rows), &[NAN, 20.0, -10.0, NAN, 5.0, NAN, NAN]);
    }

    /// A straight line comes back unchanged when two samples are averaged.
    #[test]
    fn the_newer_half_of_an_average_is_extrapolated() {
        let rows: Vec<(i64, f64, f64)> = (0..6).map(|k| (k + i64::from(k > 3), 2.0 * k as f64, NAN)).collect();
        let newer = stepped(Rule::Newer, None, &rows);
        same(&newer, &[NAN, 3.0, 5.0, 7.0, NAN, 11.0]);
        assert_eq!(0.5 * (newer[2] + newer[3]), rows[3].1);
    }

    #[test]
    fn a_held_value_stays_until_the_next_one() {
        let rows = [(0, NAN, NAN), (1, 3.0, NAN), (2, NAN, NAN), (9, NAN, NAN), (10, 4.0, NAN)];
        same(&stepped(Rule::Hold, None, &rows), &[NAN, 3.0, 3.0, 3.0, 4.0]);
    }

    #[test]
    fn time_counts_to_the_middle_of_the_sample() {
        let rows = [(0, 2.0, NAN), (1, 2.0, NAN), (20, 1.0, NAN)];
        same(&stepped(Rule::Elapsed, None, &rows), &[0.1, 0.3, 2.05]);
        same(&stepped(Rule::Elapsed, Some(1_000 - 1_000_000_000), &rows), &[2.1, 2.3, 3.05]);
    }

    #[test]
    fn growth_counts_from_the_first_value_and_is_nothing_before() {
        let rows = [(0, 2.0, NAN), (1, 2.0, 7.0), (2, 2.0, 7.5), (3, 3.0, 6.0)];
        same(&stepped(Rule::Growth { sign: 1.0 }, None, &rows), &[0.0, 0.0, 1.0, -3.0]);
        same(&stepped(Rule::Growth { sign: -1.0 }, None, &rows), &[0.0, 0.0, -1.0, 3.0]);
    }

    #[test]
    fn series_of_one_name_are_one_series() {
        let series = [
            Series::Column(Source::alpha(0)),
            Series::Slope(Source::alpha(0), "rad s-3"),
            Series::Held(Source::alpha(0)),
            Series::Times(Source::alpha(0), Driver::Time(None), "rad s-1"),
            Series::Times(Source::alpha(0), Driver::Time(Some(5)), "rad s-1"),
            Series::Times(Source::alpha(0), Driver::Growth { column: Source::sun(0), lost: true }, "rad s-2"),
            Series::Times(Source::alpha(0), Driver::Growth { column: Source::sun(0), lost: false }, "rad s-2"),
            Series::Times(Source::alpha(0), Driver::Growth { column: Source::sun(1), lost: false }, "rad s-2"),
            Series::Slope(Source::alpha(1), "rad s-3"),
        ];
        let names: std::collections::BTreeSet<String> = series.iter().map(Series::name).collect();
        assert_eq!(names.len(), series.len());
    }
}
