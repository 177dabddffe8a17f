//! A formula of the reader's: typed with the names that it may use, checked while it is typed, added to the model.

use dragfree_workflow::adding::{Addition, add};
use dragfree_workflow::formula::{Asked, FormulaError, entry, names, places};
use maud::{Markup, html};
use serde::Deserialize;

use crate::PagesError;
use crate::jobs::Job;
use crate::layout::{Links, command, data, shell};
use crate::site::Site;
use crate::starting::button;

/// Letters that a name may have.
const LONGEST_NAME: usize = 40;

/// What the form holds.
#[derive(Clone, Debug, Default, Deserialize)]
#[serde(default)]
pub struct Typed {
    /// Products whose housekeeping may be used, separated by commas.
    pub products: String,
    /// Name of the formula.
    pub name: String,
    /// Where it acts.
    pub acts_on: String,
    /// What acts per unit of the coefficient.
    pub expression: String,
    /// SI unit of the coefficient.
    pub unit: String,
    /// Least value of the coefficient.
    pub lower: String,
    /// Greatest value.
    pub upper: String,
}

impl Typed {
    fn asked(&self) -> Result<Asked, FormulaError> {
        if self.name.trim().len() > LONGEST_NAME {
            let what = format!("its name has more than {LONGEST_NAME} letters");
            return Err(FormulaError { what, letter: None });
        }
        let number = |text: &str| {
            let refuse =
                || FormulaError { what: format!("the range needs two numbers, and `{text}` is none"), letter: None };
            text.trim().parse::<f64>().ok().filter(|x| x.is_finite()).ok_or_else(refuse)
        };
        Ok(Asked {
            name: self.name.trim().to_owned(),
            acts_on: self.acts_on.clone(),
            expression: self.expression.clone(),
            unit: self.unit.trim().to_owned(),
            range: [number(&self.lower)?, number(&self.upper)?],
        })
    }
}

impl Site {
    fn checked(&self, typed: &Typed) -> Result<dragfree_engine::config::EffectEntry, FormulaError> {
        let housekeeping = self.basis(&typed.products).map(|basis| basis.housekeeping().clone()).unwrap_or_default();
        entry(&self.setup.registry, &self.setup.mission, &housekeeping, &typed.asked()?)
    }

    /// What is said of a formula while it is typed.
    pub fn formula(&self, typed: &Typed, links: &Links) -> String {
        let said = match self.checked(typed) {
            Ok(entry) => html! {
                p { strong class="good-word" { "It can be read." } " Its names are there. Whether it explains anything, a run says:" }
                (command(&self.command_of(typed)))
                @if links.allows_changes() && self.setup.model.is_some() {
                    label { "Token, printed where the server was started " input class="token" type="password"
                        autocomplete="off" size="34"; }
                    button type="submit" { "Add to the model" }
                }
                span hidden data-effect=(entry.to_string()) {}
            },
            Err(FormulaError { what, letter }) => html! {
                p { strong class="bad-word" { "Not yet: " } (what) }
                @if let Some(letter) = letter { (mark(&typed.expression, letter)) }
            },
        };
        said.into_string()
    }

    fn command_of(&self, typed: &Typed) -> String {
        let model = self.setup.model.as_ref().map_or_else(|| "MODEL.toml".to_owned(), |m| shell(&m.to_string_lossy()));
        let set = |key: &str, value: &str| format!(" --set {}", shell(&format!("{key}={value}")));
        format!(
            "dragfree model add {model} {}{}{}{}{}{}",
            shell(&format!("formula:{}", typed.name.trim())),
            set("acts_on", &typed.acts_on),
            set("expression", &typed.expression),
            set("unit", typed.unit.trim()),
            set("range", &format!("{},{}", typed.lower.trim(), typed.upper.trim())),
            self.setup.model_flags
        )
    }

    /// Adds a formula to the model.
    ///
    /// # Errors
    /// [`PagesError`]: it is refused, or the model cannot be changed.
    pub fn add_formula(&self, typed: &Typed) -> Result<String, PagesError> {
        let Some(model) = &self.setup.model else {
            return Err(PagesError::Request("no model file was named when the server was started: --model".to_owned()));
        };
        let entry = self.checked(typed).map_err(|e| PagesError::Request(e.what))?;
        let comment = "a formula of the workbench".to_owned();
        let addition = Addition { entry, comment, diagnosed: Vec::new() };
        let added = add(model, &self.setup.registry, &self.setup.mission, &[addition])?;
        let revision = added.committed.as_ref().map_or(added.before.as_str(), |c| c.revision.as_str());
        let said = html! {
            p { "Added: the model is revision " strong { (revision) } " now, before it " (added.before)
                ". A run with it gives the size of the formula with its σ:" }
            (button(self, &Links::Server { changes: true }, &Job::CatchUp, "Run what is due"))
        };
        Ok(said.into_string())
    }
}

/// The expression with the letter that is wrong marked, or its end.
fn mark(expression: &str, letter: usize) -> Markup {
    let letters: Vec<char> = expression.chars().map(|c| if c.is_control() { ' ' } else { c }).collect();
    let at = letter.saturating_sub(1).min(letters.len());
    let (before, rest) = letters.split_at(at);
    let text = |letters: &[char]| letters.iter().collect::<String>();
    html! {
        pre class="command" tabindex="0" { code {
            (text(before)) mark { (rest.first().copied().unwrap_or(' ')) } (text(rest.get(1..).unwrap_or_default()))
        } }
    }
}

/// The form, which the switches leave alone.
pub(crate) fn form(site: &Site, products: &str, links: &Links) -> Markup {
    if links.is_file() {
        return html! {};
    }
    let housekeeping = site.basis(products).map(|basis| basis.housekeeping().clone()).unwrap_or_default();
    let names = names(&site.setup.registry, &site.setup.mission, &housekeeping);
    html! {
        h2 id="a-formula" { "A formula of your own" }
        p class="quiet" { "An expression over telemetry that no installed effect has. It is checked while it is typed; names are offered \
            below the field, arrows and return take one. A run with it gives its size." }
        form id="formula" autocomplete="off" {
            input type="hidden" name="products" value=(products);
            label { "Name " input name="name" value="mine" size="12" maxlength="40"; }
            label { "acts on " select name="acts_on" { @for place in places(&site.setup.mission) { option { (place) } } } }
            label class="wide" { "expression "
                input name="expression" id="expression" size="52" maxlength="4096" spellcheck="false" role="combobox"
                    aria-autocomplete="list" aria-expanded="false" aria-controls="formula-names"
                    placeholder="lag(hk.NAME, 120) * alpha.z"; }
            ul id="formula-names" role="listbox" aria-label="Names" hidden {}
            label { "unit of the coefficient " input name="unit" size="12" maxlength="80" placeholder="m s-2 A-2"; }
            label { "from " input name="lower" size="8" maxlength="40" placeholder="-1e-11"; }
            label { "to " input name="upper" size="8" maxlength="40" placeholder="1e-11"; }
            div id="formula-said" role="status" {}
        }
        div id="formula-added" role="status" {}
        (data("names", &names))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_letter_that_is_wrong_is_marked_and_text_stays_text() {
        let text = |expression: &str, letter| mark(expression, letter).into_string();
        assert!(text("1 + <b>", 5).contains("1 + <mark>&lt;</mark>b&gt;"), "{}", text("1 + <b>", 5));
        assert!(text("ab", 3).contains("ab<mark> </mark>") && text("ab", 99).contains("ab<mark> </mark>"));
        assert!(text("", 0).contains("<mark> </mark>"));
    }
}
