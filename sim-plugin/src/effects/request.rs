//! Syntax of an effect: `ID:INSTANCE=SIZE[,NAME=VALUE]...`.

use dragfree_physics::mission::{ANGLES, AXES, MissionError};
use std::fmt::{self, Display};

use super::{Basis, Cause, catalogue};

/// Why an effect was refused.
#[expect(missing_docs, reason = "the messages name the fields")]
#[derive(Debug, thiserror::Error)]
pub enum EffectError {
    /// The text does not have the form of an effect.
    #[error("effect {0}: not of the form ID:INSTANCE=SIZE[,NAME=VALUE]..., as mps-gain:sc.y=0.02; there are {list}", list = list())]
    Form(String),
    /// No effect of that name.
    #[error("effect {text}: there is no effect {id}; there are {list}", list = list())]
    Unknown { text: String, id: String },
    /// The effect has no such instance.
    #[error("effect {text}: {id} has no instance {instance}; it has {has}.\n{id}: {about}")]
    Instance { text: String, id: &'static str, instance: String, has: String, about: String },
    /// The effect has no such shape parameter.
    #[error("effect {text}: {id} has no parameter {name}; it has {has}")]
    Parameter { text: String, id: &'static str, name: String, has: String },
    /// A value is not a number or out of range.
    #[error("effect {text}: {what} = {value} must be a number from {minimum:e} to {maximum:e} {unit}")]
    Value { text: String, what: String, value: String, minimum: f64, maximum: f64, unit: &'static str },
    /// The mission lacks a section that the effect needs.
    #[error("effect {text}: {source}")]
    Mission { text: String, source: MissionError },
}

/// Instance of an effect. Test masses count from 0 in the order of their names, axes and angles too: x, y, z and φ, θ,
/// ψ.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Place {
    /// `sc`, the spacecraft as a whole.
    Spacecraft,
    /// `layout`, all thrusters.
    Layout,
    /// `NAME`, a test mass as a whole.
    Tm(usize),
    /// An instrument.
    Instrument(Instrument),
    /// `sc.phi`, about an axis of SRF.
    ScAngle(usize),
    /// `sc.x`, an axis of SRF.
    ScAxis(usize),
    /// `NAME.x`: test mass and axis of its ORF.
    TmAxis(usize, usize),
    /// `NAME.y-x` reads from y into x.
    TmPair {
        /// Test mass.
        tm: usize,
        /// Axis of the cause.
        from: usize,
        /// Axis of the response.
        to: usize,
    },
}

/// Instruments with a clock of their own.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Instrument {
    /// Capacitive readout.
    Is,
    /// Interferometers.
    Ifo,
    /// Wavefront sensing, local and of the long arm.
    Dws,
}

impl Place {
    /// Name of the instance in a mission with these test masses.
    pub fn name(self, test_masses: &[String]) -> String {
        match self {
            Self::Spacecraft => "sc".to_owned(),
            Self::Layout => "layout".to_owned(),
            Self::Tm(tm) => test_masses[tm].clone(),
            Self::Instrument(Instrument::Is) => "is".to_owned(),
            Self::Instrument(Instrument::Ifo) => "ifo".to_owned(),
            Self::Instrument(Instrument::Dws) => "dws".to_owned(),
            Self::ScAngle(axis) => format!("sc.{}", ANGLES[axis]),
            Self::ScAxis(axis) => format!("sc.{}", AXES[axis]),
            Self::TmAxis(tm, axis) => format!("{}.{}", test_masses[tm], AXES[axis]),
            Self::TmPair { tm, from, to } => format!("{}.{}-{}", test_masses[tm], AXES[from], AXES[to]),
        }
    }
}

/// The axes of SRF.
pub(super) fn sc_axes(_: usize) -> Vec<Place> {
    (0..3).map(Place::ScAxis).collect()
}

/// About the axes of SRF.
pub(super) fn sc_angles(_: usize) -> Vec<Place> {
    (0..3).map(Place::ScAngle).collect()
}

/// The test masses.
pub(super) fn test_masses(count: usize) -> Vec<Place> {
    (0..count).map(Place::Tm).collect()
}

/// Every axis of every test mass.
pub(super) fn tm_axes(count: usize) -> Vec<Place> {
    (0..count).flat_map(|tm| (0..3).map(move |axis| Place::TmAxis(tm, axis))).collect()
}

/// Every ordered pair of axes of a test mass whose first is among `from`, for every test mass.
pub(super) fn tm_pairs(count: usize, from: &[usize]) -> Vec<Place> {
    let pairs = |tm: usize| {
        let to = move |from: usize| (0..3).filter(move |to| *to != from).map(move |to| Place::TmPair { tm, from, to });
        from.iter().copied().flat_map(to)
    };
    (0..count).flat_map(pairs).collect()
}

/// Unit and physical range of a number.
#[derive(Clone, Copy, Debug)]
pub struct Number {
    /// SI unit; `1` for a ratio.
    pub unit: &'static str,
    /// Smallest value.
    pub minimum: f64,
    /// Largest.
    pub maximum: f64,
}

/// A shape parameter.
#[derive(Clone, Copy, Debug)]
pub struct Shape {
    /// Name, with its unit.
    pub name: &'static str,
    /// Unit and interval.
    pub number: Number,
    /// Default value.
    pub default: f64,
    /// Description.
    pub help: &'static str,
}

/// A new effect, or what the mission lacks for it.
pub type Built = Result<Box<dyn Cause>, MissionError>;

/// A kind of effect.
pub struct Kind {
    /// Id.
    pub id: &'static str,
    /// Instances for a number of test masses.
    pub places: fn(usize) -> Vec<Place>,
    /// Unit and interval of SIZE.
    pub size: Number,
    /// Meaning and sign of SIZE.
    pub help: &'static str,
    /// Shape parameters.
    pub shape: &'static [Shape],
    /// Builds the effect.
    pub build: fn(&EffectRequest, &Basis<'_>) -> Built,
}

impl fmt::Debug for Kind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.id)
    }
}

/// An effect with its place, size and shape.
#[derive(Clone, Debug)]
pub struct EffectRequest {
    /// Kind of effect.
    pub kind: &'static Kind,
    /// Instance.
    pub place: Place,
    /// Name of the instance.
    pub instance: String,
    /// SIZE, in the kind's unit.
    pub size: f64,
    /// Shape parameters in the order of the kind's.
    pub shape: Vec<f64>,
}

impl Display for EffectRequest {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}:{}={:e}", self.kind.id, self.instance, self.size)?;
        self.kind.shape.iter().zip(&self.shape).try_for_each(|(shape, value)| write!(f, ",{}={value:e}", shape.name))
    }
}

impl EffectRequest {
    /// Reads one effect on a spacecraft with these test masses, as in `es-crosstalk:NAME.y-x=0.03`: 3 % of what is
    /// commanded along y acts along x.
    ///
    /// # Errors
    /// [`EffectError`] names the error and the valid alternatives.
    pub fn parse(text: &str, test_masses: &[String]) -> Result<Self, EffectError> {
        let form = || EffectError::Form(text.to_owned());
        let mut parts = text.split(',').map(|part| part.split_once('='));
        let (name, size) = parts.next().flatten().ok_or_else(form)?;
        let (id, instance) = name.trim().split_once(':').ok_or_else(form)?;
        let kind = catalogue()
            .find(|kind| kind.id == id)
            .ok_or_else(|| EffectError::Unknown { text: text.to_owned(), id: id.to_owned() })?;
        let places = (kind.places)(test_masses.len());
        let names: Vec<String> = places.iter().map(|place| place.name(test_masses)).collect();
        let at = names.iter().position(|name| name == instance).ok_or_else(|| EffectError::Instance {
            text: text.to_owned(),
            id: kind.id,
            instance: instance.to_owned(),
            has: names.join(", "),
            about: format!("{} [{}]; parameters: {}", kind.help, kind.size.unit, kind.parameters()),
        })?;
        let size = kind.size.read(text, "SIZE", size)?;
        let mut shape: Vec<f64> = kind.shape.iter().map(|s| s.default).collect();
        for part in parts {
            let (name, value) = part.ok_or_else(form)?;
            let i = kind.shape.iter().position(|s| s.name == name.trim()).ok_or_else(|| EffectError::Parameter {
                text: text.to_owned(),
                id: kind.id,
                name: name.trim().to_owned(),
                has: kind.parameters(),
            })?;
            shape[i] = kind.shape[i].number.read(text, kind.shape[i].name, value)?;
        }
        Ok(Self { kind, place: places[at], instance: instance.to_owned(), size, shape })
    }

    /// Value of a shape parameter of the kind.
    pub(super) fn shape(&self, name: &str) -> f64 {
        let i = self.kind.shape.iter().position(|s| s.name == name);
        i.map_or(f64::NAN, |i| self.shape[i])
    }

    pub(crate) fn cause(&self, basis: &Basis<'_>) -> Result<Box<dyn Cause>, EffectError> {
        (self.kind.build)(self, basis).map_err(|source| EffectError::Mission { text: self.to_string(), source })
    }
}

impl Shape {
    pub(super) const fn new(name: &'static str, number: Number, default: f64, help: &'static str) -> Self {
        Self { name, number, default, help }
    }
}

impl Number {
    pub(super) const fn new(unit: &'static str, minimum: f64, maximum: f64) -> Self {
        Self { unit, minimum, maximum }
    }

    fn read(&self, text: &str, what: &str, value: &str) -> Result<f64, EffectError> {
        let number = value.trim().parse().ok().filter(|x| (self.minimum..=self.maximum).contains(x));
        number.ok_or_else(|| EffectError::Value {
            text: text.to_owned(),
            what: what.to_owned(),
            value: value.trim().to_owned(),
            minimum: self.minimum,
            maximum: self.maximum,
            unit: self.unit,
        })
    }
}

impl Kind {
    fn parameters(&self) -> String {
        let one = |s: &Shape| format!("{} ({}; {} unless given)", s.name, s.help, s.default);
        match self.shape {
            [] => "none".to_owned(),
            shape => shape.iter().map(one).collect::<Vec<_>>().join(", "),
        }
    }
}

/// Ids of all effects, for messages.
fn list() -> String {
    let ids: Vec<&str> = catalogue().map(|kind| kind.id).collect();
    format!("{}; ask one for what it is, as --effect {}:?=0", ids.join(", "), ids[0])
}
