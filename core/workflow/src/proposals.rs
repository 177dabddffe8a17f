//! Formulas that are proposed for a force that no effect of the library knows: of a test mass, or a force or torque on
//! the spacecraft, that follows a function of housekeeping, or the product of housekeeping with a command or a
//! displacement. They compete with the library in the likelihood as candidates do.

use dragfree_engine::border::Kind;
use dragfree_engine::config::EffectEntry;
use dragfree_engine::registry::Registry;
use dragfree_identification::driven::Driven;
use dragfree_identification::record::Record;
use nalgebra::DVector;

use crate::WorkflowError;
use crate::replay::Replay;
use crate::sums::ACTS_ON;

/// The effect that states them.
pub(crate) const FORMULA: &str = "formula";

/// Root mean square of the largest acceleration of a test mass for which a formula may stand, m s⁻²: that of `thermal`
/// at the end of its range where a temperature difference varies by 10 mK.
const MOST_M_S2: f64 = 1e-11;

/// The same of a force on the spacecraft, N, and of a torque, N m: micronewtons, as of gas that leaks or a valve that
/// follows the temperature, at arms of a metre.
const MOST_N: f64 = 3e-6;

/// The same of the change of an actuator's gain: that of the gains in the library.
const MOST_GAIN: f64 = 0.3;

/// A formula, and its driver in words.
#[derive(Clone, Debug)]
pub(crate) struct Proposal {
    /// The model's entry.
    pub(crate) entry: EffectEntry,
    /// What it states.
    pub(crate) driven: Driven,
    /// Acceleration in each channel per unit of the force where it acts.
    pub(crate) response: DVector<f64>,
    /// The housekeeping in it as among drivers that are coherent with a residual, `hk/battery_current_a^2`.
    pub(crate) driver: String,
    /// Logarithm of its weight before any data, in that of formulas. Products with commands, whose constant part makes
    /// them resemble their housekeeping, have the false-alarm rate together: one is told only if it explains
    /// significantly more than housekeeping alone.
    pub(crate) ln_weight: f64,
    /// What acts where, `lag(hk.battery_current_a - 1.912320e0, 50.0) on tm1.accel.y`.
    pub(crate) words: String,
}

/// Formulas on the spacecraft that say how a force or torque there enters the channels.
pub(crate) fn probes(registry: &Registry) -> Vec<EffectEntry> {
    if registry.find(Kind::Effect, FORMULA).is_err() {
        return Vec::new();
    }
    let axes = ["force", "torque"].into_iter().flat_map(|what| ["x", "y", "z"].map(|axis| format!("sc.{what}.{axis}")));
    axes.map(|acts_on| {
        let instance = format!("probe_{}", acts_on.replace('.', "_"));
        entry(&instance, &acts_on, "1", "1", 1.0)
    })
    .collect()
}

/// The model's entry of a formula.
fn entry(instance: &str, acts_on: &str, expression: &str, unit: &str, most: f64) -> EffectEntry {
    let mut entry = EffectEntry::new(FORMULA, instance);
    let text = |text: &str| toml::Value::from(text);
    entry.parameters.extend([
        (ACTS_ON.to_owned(), text(acts_on)),
        ("expression".to_owned(), text(expression)),
        ("unit".to_owned(), text(unit)),
        ("range".to_owned(), toml::Value::from(vec![-most, most])),
    ]);
    entry
}

/// Formulas for the residuals of the model, and how many were tried. A product comes with its two factors, since where
/// each is zero is not known.
///
/// # Errors
/// A declaration of noise contradicts itself.
pub(crate) fn proposals(replay: &Replay<'_>, record: &Record) -> Result<(Vec<Proposal>, usize), WorkflowError> {
    let (slow, housekeeping) = (&record.gathered.slow, &record.gathered.housekeeping);
    let channels = &record.candidate_set.channels;
    let name = |place: usize| &housekeeping.places[place].name;
    let on_spacecraft = channels.len()..housekeeping.places.len();
    let on_test_masses = (0..channels.len()).filter(|channel| is_of_test_mass(name(*channel)));
    let places: [Vec<usize>; 2] = [on_test_masses.collect(), on_spacecraft.collect()];
    let mut all: Vec<Proposal> = Vec::new();
    if replay.registry.find(Kind::Effect, FORMULA).is_err() {
        return Ok((all, 0));
    }
    let mut with_factors = true;
    let noise = record.noise_model()?;
    // Apart: what follows the thrusters, as the current of a valve does, explains most on the spacecraft whatever acts
    // on a test mass.
    for driven in places.iter().flat_map(|places| slow.driven(places, &noise, housekeeping)) {
        let factors = if with_factors { driven.driver.factors() } else { Vec::new() };
        with_factors &= factors.is_empty();
        for driver in [driven.driver].into_iter().chain(factors) {
            let driven = Driven { driver, ..driven };
            let taken = |name: &String| {
                let of_model = record.candidate_set.coefficients.iter();
                let mut taken = of_model.filter(|c| c.effect == FORMULA).map(|c| &c.instance);
                taken.any(|own| own == name) || all.iter().any(|p| p.entry.instance == *name)
            };
            let plain = name(driven.place).replace('.', "_");
            let mut numbered = (1..).map(|k| if k == 1 { plain.clone() } else { format!("{plain}_{k}") });
            let Some(instance) = numbered.find(|name| !taken(name)) else { continue };
            let weight = replay.settings()?.false_alarm;
            let proposed = proposal(record, &driven, name(driven.place), &instance, weight);
            // A factor of a product may have been proposed by itself.
            all.extend(proposed.filter(|p| all.iter().all(|other| other.words != p.words)));
        }
    }
    let tried = places.iter().map(|places| slow.functions(places, housekeeping)).sum();
    Ok((all, tried))
}

/// The proposal of a function at a place; none where it does not change or cannot be written.
/// Products with known series have the weight `of_products` together.
fn proposal(record: &Record, driven: &Driven, place: &str, instance: &str, of_products: f64) -> Option<Proposal> {
    let (slow, housekeeping) = (&record.gathered.slow, &record.gathered.housekeeping);
    let &Driven { driver, memory, .. } = driven;
    let expression = slow.expression(driver, memory, housekeeping);
    let on_test_mass = is_of_test_mass(place);
    let products = housekeeping.known_at(driven.place).max(1) as f64;
    let ln_weight = slow.unit_of_known(driver).map_or(0.0, |_| (of_products / products).ln());
    let (rms, rms_of_factor) = (slow.rms(driver, memory, housekeeping), slow.rms_of_factor(driver, housekeeping));
    let (acts_on, of, most, rms) = match (slow.unit_of_known(driver), on_test_mass) {
        // A gain, of which the factor alone changes.
        (Some("N"), true) => (place.replace("accel", "force"), "N", MOST_GAIN, rms_of_factor),
        (Some("N" | "N m"), false) => (place.to_owned(), unit_at(place), MOST_GAIN, rms_of_factor),
        (_, true) => (place.to_owned(), "m s-2", MOST_M_S2, rms),
        (_, false) => (place.to_owned(), unit_at(place), MOST_N, rms),
    };
    (readable(&expression) && rms > 0.0).then(|| Proposal {
        entry: entry(instance, &acts_on, &expression, &slow.unit_of_amplitude(of, driver, memory), most / rms),
        driven: *driven,
        response: housekeeping.places[driven.place].response.clone(),
        ln_weight,
        driver: slow.label(driver.housekeeping()),
        words: format!("{expression} on {acts_on}"),
    })
}

/// Unit of what acts on the spacecraft.
fn unit_at(place: &str) -> &'static str {
    if place.contains(".torque.") { "N m" } else { "N" }
}

/// Whether a channel is the acceleration of a test mass along an axis, which a formula names as the channel is named.
fn is_of_test_mass(channel: &str) -> bool {
    matches!(channel.split('.').collect::<Vec<_>>()[..], [_, "accel", _])
}

/// Whether the names of housekeeping in an expression are names to its parser.
fn readable(expression: &str) -> bool {
    let plain = |c: char| c.is_ascii_alphanumeric() || "_.^*()-+, ".contains(c);
    expression.chars().all(plain)
}
