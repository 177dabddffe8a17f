//! Formulas that are proposed for a force that no effect of the library knows: accelerations of a test mass that follow
//! a function of housekeeping. They compete with the library in the likelihood as candidates do.

use dragfree_engine::border::Kind;
use dragfree_engine::config::EffectEntry;
use dragfree_identification::record::Record;

use crate::WorkflowError;
use crate::replay::Replay;

/// The effect that states them.
pub(crate) const FORMULA: &str = "formula";

/// Root mean square of the largest acceleration for which a formula may stand, m s⁻²: that of `thermal` at the end of
/// its range where a temperature difference varies by 10 mK.
const MOST_M_S2: f64 = 1e-11;

/// A formula, and its driver in words.
#[derive(Clone, Debug)]
pub(crate) struct Proposal {
    /// The model's entry.
    pub(crate) entry: EffectEntry,
    /// The driver as among those that are coherent with a residual, `hk/battery_current_a^2`.
    pub(crate) driver: String,
    /// What acts where, `lag(hk.battery_current_a - 1.912320e0, 50.0) on tm1.accel.y`.
    pub(crate) words: String,
}

/// Formulas for the residuals of the model, and how many were tried. A product comes with its two factors, since where
/// each is zero is not known.
///
/// # Errors
/// A declaration of noise contradicts itself.
pub(crate) fn proposals(replay: &Replay<'_>, record: &Record) -> Result<(Vec<Proposal>, usize), WorkflowError> {
    let (slow, housekeeping) = (&record.gathered.slow, &record.gathered.housekeeping);
    let channels = &record.candidate_set.channels;
    let own: Vec<usize> = (0..channels.len()).filter(|c| acts_on(&channels[*c])).collect();
    let mut all = Vec::new();
    if replay.registry.find(Kind::Effect, FORMULA).is_err() {
        return Ok((all, 0));
    }
    let mut with_factors = true;
    for driven in slow.driven(&own, &record.noise_model()?, housekeeping) {
        let channel = &channels[driven.channel];
        let factors = if with_factors { driven.driver.factors() } else { Vec::new() };
        with_factors &= factors.is_empty();
        for driver in [driven.driver].into_iter().chain(factors) {
            let expression = slow.expression(driver, driven.memory, housekeeping);
            let rms = slow.rms(driver, driven.memory, housekeeping);
            if !readable(&expression) || rms <= 0.0 {
                continue;
            }
            let taken = |name: &String| {
                let of_model = record.candidate_set.coefficients.iter();
                let mut taken = of_model.filter(|c| c.effect == FORMULA).map(|c| &c.instance);
                taken.any(|own| own == name) || all.iter().any(|p: &Proposal| p.entry.instance == *name)
            };
            let plain = channel.replace('.', "_");
            let mut numbered = (1..).map(|k| if k == 1 { plain.clone() } else { format!("{plain}_{k}") });
            let Some(instance) = numbered.find(|name| !taken(name)) else { continue };
            let mut entry = EffectEntry::new(FORMULA, &instance);
            let most = MOST_M_S2 / rms;
            let text = |text: &str| toml::Value::from(text);
            entry.parameters.extend([
                ("acts_on".to_owned(), text(channel)),
                ("expression".to_owned(), text(&expression)),
                ("unit".to_owned(), text(&slow.unit_of_amplitude(driver, driven.memory))),
                ("range".to_owned(), toml::Value::from(vec![-most, most])),
            ]);
            all.push(Proposal { entry, driver: slow.label(driver), words: format!("{expression} on {channel}") });
        }
    }
    Ok((all, slow.functions(housekeeping) * own.len()))
}

/// Whether a channel is the acceleration of a test mass along an axis, which a formula names as the channel is named.
fn acts_on(channel: &str) -> bool {
    matches!(channel.split('.').collect::<Vec<_>>()[..], [_, "accel", _])
}

/// Whether the names of housekeeping in an expression are names to its parser.
fn readable(expression: &str) -> bool {
    let plain = |c: char| c.is_ascii_alphanumeric() || "_.^*()-+, ".contains(c);
    expression.chars().all(plain)
}
