//! Effects that are on, added to the model.

use dragfree_engine::config::EffectEntry;
use dragfree_workflow::adding::{Added, Addition, add};
use dragfree_workflow::refit::{Effect, Refit};
use maud::{Markup, html};
use serde_json::Value;

use crate::PagesError;
use crate::jobs::Job;
use crate::layout::{Links, command, shell, value};
use crate::site::{Query, Site};
use crate::starting::button;

impl Site {
    /// Adds the effects that are on to the model, as one revision, and tells the commands that prove it.
    ///
    /// # Errors
    /// [`PagesError`]: no effect is on, there is no model file, or the model cannot be changed.
    pub fn keep(&self, query: &Query) -> Result<String, PagesError> {
        let Some(model) = &self.setup.model else {
            return Err(PagesError::Request("no model file was named when the server was started: --model".to_owned()));
        };
        let refit = self.refit(query)?;
        let additions: Vec<Addition> = refit.effects.iter().filter(|e| e.on).map(addition).collect();
        if additions.is_empty() {
            return Err(PagesError::Request("no effect is on, so there is nothing to keep".to_owned()));
        }
        let added = add(model, &self.setup.registry, &self.setup.mission, &additions)?;
        Ok(self.told(&added, &refit).into_string())
    }

    fn told(&self, added: &Added, refit: &Refit) -> Markup {
        let revision = added.committed.as_ref().map_or(added.before.as_str(), |c| c.revision.as_str());
        let model = self.setup.model.as_ref().map(|m| shell(&m.to_string_lossy())).unwrap_or_default();
        let flags = &self.setup.flags;
        let first = refit.products.first().map(String::as_str).unwrap_or_default();
        // What a test on other days leaves free: the offset.
        let offsets = refit.rungs.first().and_then(|rung| rung.offsets.first());
        let free = offsets.and_then(|o| o.name.split('.').next()).unwrap_or("EFFECT");
        let mut lines = vec![format!("dragfree run PIPELINE.toml FILES-OF-{first} --model {model}{flags}")];
        for id in &refit.held_out {
            lines.push(format!("dragfree model fix {model} --from NEW-PRODUCT --keep {free} --out fixed.toml{flags}"));
            lines.push(format!("dragfree run PIPELINE.toml FILES-OF-{id} --model fixed.toml{flags}"));
        }
        lines.push(format!("dragfree ladder {first} NEW-PRODUCT{flags}"));
        html! {
            p { "Kept: the model is revision " strong { (revision) } " now, before it " (added.before)
                ". These commands prove it on the data:" }
            (command(&lines.join("\n")))
            p { "Or every day is calibrated with the new model: the old products stay beside the new ones." }
            (button(self, &Links::Server { changes: true }, &Job::CatchUp, "Run what is due"))
        }
    }
}

fn addition(effect: &Effect) -> Addition {
    let mut entry = EffectEntry::new(&effect.effect, &effect.instance);
    entry.parameters = parameters(effect);
    let size = effect.coefficients.iter().map(|c| value(c.value, c.sigma, &c.unit)).collect::<Vec<_>>().join(", ");
    Addition {
        entry,
        comment: format!("diagnosed: {size}, Δχ² {:.0}", effect.delta_chi2),
        diagnosed: effect.coefficients.iter().map(|c| (c.name.clone(), c.value)).collect(),
    }
}

fn parameters(effect: &Effect) -> toml::Table {
    effect.shape.iter().filter_map(|(name, value)| Some((name.clone(), toml::Value::try_from(value).ok()?))).collect()
}

/// The commands that do the same.
pub(crate) fn commands(site: &Site, on: &[&Effect]) -> Vec<String> {
    let model = site.setup.model.as_ref().map_or_else(|| "MODEL.toml".to_owned(), |m| shell(&m.to_string_lossy()));
    let set = |(name, value): (&String, &Value)| {
        let value = value.as_str().map_or_else(|| value.to_string(), str::to_owned);
        format!(" --set {}", shell(&format!("{name}={value}")))
    };
    let level = |e: &Effect| {
        let size = e.coefficients.first().filter(|_| e.is_noise);
        size.map_or_else(String::new, |size| format!(" --value {:.4}", size.value))
    };
    let of = |e: &&Effect| {
        let shape: String = e.shape.iter().map(set).collect();
        let name = if e.instance.is_empty() { e.effect.clone() } else { format!("{}:{}", e.effect, e.instance) };
        format!("dragfree model add {model} {}{shape}{}{}", shell(&name), level(e), site.setup.model_flags)
    };
    on.iter().map(of).collect()
}
