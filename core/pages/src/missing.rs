//! Missing physics: switches beside effects, and what the model says with them.

use chrono::DateTime;
use dragfree_archive::{EXTRACT, Row};
use dragfree_workflow::refit::{Basis, Effect, Refit, STRETCH, Spectra, Stretch};
use dragfree_workflow::words::grouped;
use maud::{Markup, html};

use crate::PagesError;
use crate::compare::{map, spectrum};
use crate::formula::form;
use crate::keep::commands;
use crate::layout::{Links, command, error, millimetres, page as whole, value};
use crate::pictures::ladder;
use crate::site::{Query, Site, list};
use crate::sliders::sliders;
use crate::spacecraft::ellipses;

const LEAD: &str = "Switch on the effect at the top of the list and watch the offset move; what helps on days that are \
                    kept out of the fit is worth keeping.";

/// A shift of the offset is told from this part of its σ.
const TOLD_SIGMAS: f64 = 0.1;

pub(crate) fn page(site: &Site, query: &Query, links: &Links) -> Result<Markup, PagesError> {
    let mut query = query.clone();
    if query.products.is_empty() {
        let newest = diagnosed(site)?.pop();
        let Some(row) = newest else {
            return Ok(whole(links, "Missing physics", "Missing physics", LEAD, &nothing(site)?));
        };
        query.products = row.id;
    }
    let body = html! {
        div id="part" aria-live="polite" { (part(site, &query, links)?) }
        (form(site, &query.products, links))
    };
    Ok(whole(links, "Missing physics", "Missing physics", LEAD, &body))
}

/// Products with an extract, by day.
fn diagnosed(site: &Site) -> Result<Vec<Row>, PagesError> {
    let mut rows = site.archive()?.rows_with(EXTRACT)?;
    rows.sort_by(|a, b| (&a.day, a.number).cmp(&(&b.day, b.number)));
    Ok(rows)
}

fn nothing(site: &Site) -> Result<Markup, PagesError> {
    let newest = site.archive()?.newest()?.pop().map_or_else(|| "PRODUCT".to_owned(), |entry| entry.row.id);
    Ok(html! {
        p { "No product was diagnosed yet. A diagnosis reads the telemetry of a product once and keeps what the \
            switches need:" }
        (command(&format!("dragfree diagnose {newest} --keep-extract{}", site.setup.flags)))
    })
}

/// What the switches change; all of it is in the address.
pub(crate) fn part(site: &Site, query: &Query, links: &Links) -> Result<Markup, PagesError> {
    let basis = site.basis(&query.products)?;
    let refit = basis.refit(&query.asked())?;
    let truth = |name: &str| site.setup.truth.as_ref().and_then(|truth| truth(name));
    Ok(html! {
        (days(site, &basis, query, links)?)
        p class="said" { (said(&refit)) }
        div class="pictures" {
            section { h2 { "Ladder" } div class="scroll" tabindex="0" { (ladder(&refit, &truth)) } }
            section {
                h2 { "Where the centre of mass is" }
                p class="quiet" {
                    "Offset with 95 % ellipses: dashed for the model alone, filled with the effects that are on"
                    @if site.setup.truth.is_some() { ", and a cross for the truth" } "."
                }
                (ellipses(&refit, &truth))
            }
        }
        (offsets(&refit, &truth))
        (spectra(&refit))
        (switches(&basis, &refit, query, links))
        (keep(site, &refit, links)?)
        (limits(&basis, &refit))
    })
}

/// The days: in the fit, kept out of it, or not used; and the hours of each, any of which can be kept out.
fn days(site: &Site, basis: &Basis, query: &Query, links: &Links) -> Result<Markup, PagesError> {
    let (products, held) = (list(&query.products), list(&query.held));
    if links.is_file() {
        return Ok(
            html! { p class="quiet" { "Product " (products.join(", ")) ". Switches need a server: dragfree serve." } },
        );
    }
    let rows = diagnosed(site)?;
    let model = rows.iter().find(|r| products.first() == Some(&r.id)).and_then(|r| r.model.clone());
    let same = rows.iter().filter(|r| r.model == model && r.fixed_from.is_none());
    let same: Vec<&Row> = same.collect();
    let others: Vec<&Row> = rows.iter().filter(|r| r.model != model && r.fixed_from.is_none()).collect();
    let of = |own: &str, id: &str| own.split_once(STRETCH).map_or(own, |(product, _)| product) == id;
    let without = |from: &[String], id: &str| from.iter().filter(|own| !of(own, id)).cloned().collect::<Vec<_>>();
    let with = |to: &[String], id: &str| [without(to, id), vec![id.to_owned()]].concat();
    let fitted = |id: &str| products.iter().any(|own| own == id) && held.iter().all(|own| own != id);
    let states = |id: &str| {
        [
            (
                "fit",
                Query { products: with(&products, id).join(","), held: without(&held, id).join(","), ..query.clone() },
            ),
            (
                "kept out",
                Query { products: with(&products, id).join(","), held: with(&held, id).join(","), ..query.clone() },
            ),
            (
                "not used",
                Query {
                    products: without(&products, id).join(","),
                    held: without(&held, id).join(","),
                    ..query.clone()
                },
            ),
        ]
    };
    let now = |id: &str| match (products.iter().any(|own| own == id), fitted(id)) {
        (true, true) => "fit",
        (true, false) => "kept out",
        _ => "not used",
    };
    let in_fit = products.iter().filter(|id| fitted(id)).count();
    let whole = held.iter().filter(|own| !own.contains(STRETCH)).count();
    let mut summary = format!("Days: {in_fit} in the fit, {whole} kept out");
    if held.len() > whole {
        summary += &format!("; of days in the fit {} stretches of hours kept out", held.len() - whole);
    }
    Ok(html! {
        details class="choose" open[same.len() <= 4] {
            summary { (summary) }
            p class="quiet" { "Days of one model, " (model.unwrap_or_default())
                ". A day or hours that are kept out test what the others say: with an effect that is there, χ² falls in \
                    them too." }
            div class="scroll" tabindex="0" {             table {
                thead { tr { th { "product" } th { "in the fit" } th { "kept out" } th { "not used" }
                    th { "hours kept out" } } }
                tbody { @for row in &same { tr {
                    th scope="row" { a href={ "/day/" (row.id) } { (row.day) } " " span class="quiet" { (row.id) } }
                    @for (state, to) in states(&row.id) {
                        td {
                            @let on = now(&row.id) == state;
                            @let last = state != "fit" && in_fit == 1 && fitted(&row.id);
                            @if on { span class="chosen" aria-label={ (row.day) ": " (state) } { "●" } }
                            @else if last { span class="quiet" title="one day must stay in the fit" { "–" } }
                            @else {
                                a data-refit="" data-key={ (row.id) (state) } href={ "/missing?" (address(&to)) }
                                    aria-label={ (row.day) ": " (state) } { "○" }
                            }
                        }
                    }
                    td class="hours" { @if fitted(&row.id) { (hours(&basis.stretches(&row.id), query)) } }
                } } }
            } }
            @if !others.is_empty() {
                p { "Diagnosed with another model: "
                    @for row in &others { a href={ "/missing?products=" (row.id) } { (row.day) " "
                        (row.model.as_deref().unwrap_or_default()) } " " } }
            }
        }
    })
}

/// Stretches of the time of a product in the fit, each of which can be kept out as long as another is in the fit.
fn hours(stretches: &[Stretch], query: &Query) -> Markup {
    let held = list(&query.held);
    let is_out = |s: &Stretch| held.contains(&s.name);
    let clock = |ns: i64| DateTime::from_timestamp_nanos(ns).format("%H:%M").to_string();
    let left = stretches.iter().filter(|s| !is_out(s)).count();
    let toggled = |s: &Stretch| {
        let mut all: Vec<String> = held.iter().filter(|own| **own != s.name).cloned().collect();
        if !is_out(s) {
            all.push(s.name.clone());
        }
        Query { held: all.join(","), ..query.clone() }
    };
    html! {
        @for s in stretches {
            @let (out, time) = (is_out(s), format!("{}–{}", clock(s.from_ns), clock(s.until_ns)));
            @if !out && left == 1 { span class="quiet" title="some hours must stay in the fit" { (time) } }
            @else {
                a class="hour" role="switch" aria-checked=(out) aria-label={ (time) " kept out" } data-refit=""
                    data-key=(s.name) href={ "/missing?" (address(&toggled(s))) } { (if out { "● " } else { "○ " }) (time) }
            }
            " "
        }
    }
}

/// Where the model fails with the effects that are on.
fn spectra(refit: &Refit) -> Markup {
    let Some(Spectra { before, now, fall }) = &refit.spectra else {
        return html! {
            h2 { "Where the model fails" }
            p { "The extracts of these products do not tell: they are of an older program. A diagnosis with "
                code { "--keep-extract" } " makes them again." }
        };
    };
    let failing = |of: &dragfree_workflow::residuals::Residuals| {
        of.channels.iter().flat_map(|c| &c.groups).filter(|b| b.fails).count()
    };
    let (was, is) = (failing(before), failing(now));
    let on = refit.rungs.len() > 1;
    let first = fall.iter().enumerate().max_by(|a, b| a.1.total_cmp(b.1)).filter(|_| on);
    let first = first.map_or("", |(k, _)| now.channels[k].name.as_str());
    let cells = |n: usize| if n == 1 { "1 cell fails".to_owned() } else { format!("{n} cells fail") };
    html! {
        h2 { "Where the model fails" }
        p id="fails" {
            @if on { (cells(was)) " with the model alone, " strong { (is) } " with the effects that are on. " }
            @else { (cells(is)) " with the model alone. " }
            "A cell is the power of the residual over that of the noise, 1 where the model is right; ▲ or ▼ where \
                chance is no explanation. " @if on { "Underlined: changed by the effects that are on. " }
            "All hours of the days in the fit."
        }
        (map(now, on.then_some(before), on.then_some(fall)))
        p class="quiet" {
            @if on { "Power over that of the noise. Solid: with the effects that are on; dotted: with the model alone. 95 of \
                100 values lie in the band about 1." }
            @else { "Solid: measured. Dashed: the noise; 95 of 100 measured values lie in the band about it." }
        }
        (spectrum(now, on.then_some(before), first))
    }
}

/// What stands behind `?` in an address.
fn address(query: &Query) -> String {
    let escaped = |text: &str| {
        let plain = |b: u8| b.is_ascii_alphanumeric() || b"-_.:,@".contains(&b);
        text.bytes().map(|b| if plain(b) { char::from(b).to_string() } else { format!("%{b:02X}") }).collect::<String>()
    };
    let parts = [("products", &query.products), ("on", &query.on), ("held", &query.held)];
    let parts = parts.into_iter().filter(|(_, value)| !value.is_empty());
    parts.map(|(name, value)| format!("{name}={}", escaped(value))).collect::<Vec<_>>().join("&")
}

/// The result in a sentence.
fn said(refit: &Refit) -> Markup {
    let (Some(first), Some(last)) = (refit.rungs.first(), refit.rungs.last()) else { return html! {} };
    let on = refit.rungs.len() - 1;
    let moved =
        first.offsets.iter().zip(&last.offsets).map(|(before, after)| (before, after, after.value_m - before.value_m));
    let most = moved.max_by(|a, b| (a.2 / a.0.sigma_m).abs().total_cmp(&(b.2 / b.0.sigma_m).abs()));
    html! {
        @if on == 0 { "The model alone. " }
        @else {
            (on) (if on == 1 { " effect is" } else { " effects are" }) " on: χ² falls by "
            strong { (format!("{:.1}", last.fall)) } " in the fit"
            @if let Some(fall) = last.held_out_fall {
                " and by " strong { (format!("{fall:.1}")) } " on what is kept out"
                @if fall <= 0.0 { ", so that it does not help there" }
            }
            ". "
            @if let Some((before, after, by)) = most {
                (before.name) " moves from " (value(before.value_m, before.sigma_m, "m")) " to "
                strong { (value(after.value_m, after.sigma_m, "m")) } ", by " (format!("{:.1} σ", (by /
                    before.sigma_m).abs())) "."
            }
        }
    }
}

fn offsets(refit: &Refit, truth: &dyn Fn(&str) -> Option<f64>) -> Markup {
    let (Some(first), Some(last)) = (refit.rungs.first(), refit.rungs.last()) else { return html! {} };
    let known = last.offsets.iter().any(|o| truth(&o.name).is_some());
    html! {
        h2 { "Offset" }
        div class="scroll" tabindex="0" { table id="offsets" {
            thead { tr {
                th { "coefficient" } th { "the model alone" } th { "with the effects" } th { "change" }
                @if known { th { "truth" } th { "true error before" } th { "after" } }
                th { "frame" }
            } }
            tbody { @for (before, after) in first.offsets.iter().zip(&last.offsets) { tr {
                @let by = after.value_m - before.value_m;
                th scope="row" { (after.name) }
                td class="figure" { (value(before.value_m, before.sigma_m, "m")) }
                td class="figure main" { (value(after.value_m, after.sigma_m, "m")) }
                td class="figure" {
                    @if by.abs() > TOLD_SIGMAS * before.sigma_m { (if by > 0.0 { "↑ " } else { "↓ " })
                        (millimetres(by)) }
                    @else { "–" }
                }
                @if known {
                    @match truth(&after.name) {
                        Some(true_m) => {
                            td class="figure" { (format!("{:.2} mm", 1e3 * true_m)) }
                            td class="figure" { (error(before.value_m - true_m, before.sigma_m)) }
                            td class="figure" { (error(after.value_m - true_m, after.sigma_m)) }
                        }
                        None => { td {} td {} td {} }
                    }
                }
                td { (after.frame) }
            } } }
        } }
    }
}

fn switches(basis: &Basis, refit: &Refit, query: &Query, links: &Links) -> Markup {
    let on = list(&query.on);
    let toggled = |effect: &Effect| {
        let without: Vec<String> = on.iter().filter(|own| **own != effect.name).cloned().collect();
        let all = if effect.on { without } else { [without, vec![effect.name.clone()]].concat() };
        Query { on: all.join(","), ..query.clone() }
    };
    // A file has no server that could solve for another form.
    let forms_of = |effect: &'_ Effect| if links.is_file() { Vec::new() } else { effect.forms.clone() };
    // An effect that is off is switched on in the form that is chosen.
    let in_form = |effect: &Effect, form: &str| {
        let there = |name: &String| if *name == effect.name { form.to_owned() } else { name.clone() };
        let all: Vec<String> = on.iter().map(there).chain((!effect.on).then(|| form.to_owned())).collect();
        Query { on: all.join(","), ..query.clone() }
    };
    let sigma = |name: &str| {
        let offset = refit.rungs.first().and_then(|r| r.offsets.iter().find(|o| o.name == name));
        offset.map_or(f64::INFINITY, |o| o.sigma_m)
    };
    html! {
        h2 { "Effects" }
        p class="quiet" {
            "Ranked by how improbable it is that chance alone gives such a fall of χ², beside the effects that are on. "
            "Below " (basis.false_alarm()) " chance is no explanation."
        }
        div class="scroll" tabindex="0" { table id="effects" {
            thead { tr {
                th { "on" } th { "effect" } th { "size" } th { "χ² falls by" } th { "chance" } th {
                    "without it the offset is wrong by" }
            } }
            tbody { @for effect in &refit.effects {
                @let certain = effect.p_value < basis.false_alarm() && !effect.out_of_range;
                tr class=(if certain { "certain" } else { "unlikely" }) {
                    td {
                        @if links.is_file() { (if effect.on { "on" } else { "off" }) }
                        @else {
                            a class="switch" role="switch" aria-checked=(effect.on) aria-label=(effect.name)
                                data-refit="" data-key=(effect.name) href={ "/missing?" (address(&toggled(effect))) } {
                                span class="knob" {} span { (if effect.on { "on" } else { "off" }) }
                            }
                        }
                    }
                    td {
                        strong { (effect.name) }
                        @if effect.named { " " span class="mark" title="a diagnosis of one of these days names it" {
                            "named" } }
                        @if effect.is_noise { " " span class="mark" { "noise" } }
                        @for (key, shape) in effect.shape.iter().filter(|(_, v)| !v.is_number()) {
                            br; span class="quiet" { (key) " = " (shape) }
                        }
                        (sliders(&format!("{}:{}", effect.effect, effect.instance), &effect.shape, &forms_of(effect),
                            &|form| format!("/missing?{}", address(&in_form(effect, form)))))
                        @if !effect.channels.is_empty() {
                            details { summary { (effect.channels.len()) " channels" } (effect.channels.join(", ")) }
                        }
                        @if !effect.confounders.is_empty() {
                            details { summary { "these data cannot tell it from " (effect.confounders.len()) " others" }
                                ul { @for other in &effect.confounders { li {
                                    (other.name) ": χ² would be " (format!("{:.1}", other.chi2)) " higher; five σ need "
                                    (times(25.0 / other.chi2.max(1e-3)))
                                        " the data, or a manoeuvre (dragfree diagnose --next)"
                                } } }
                            }
                        }
                    }
                    td class="figure" { @for size in &effect.coefficients { (value(size.value, size.sigma,
                        &size.unit)) br; } }
                    td class="figure" { (format!("{:.1}", effect.delta_chi2)) }
                    td class="figure" {
                        (chance(effect.log10_p_value))
                        @if effect.out_of_range { br; span class="quiet" {
                            "its best size lies outside its physical range" } }
                    }
                    td class="figure" {
                        @if effect.is_noise { span class="quiet" { "nothing: the levels are fitted in these sums" } }
                        @for (name, shift) in effect.offset_shift_m.iter().filter(|(n, s)| s.abs() > TOLD_SIGMAS *
                            sigma(n)) {
                            (crate::pictures::tail(name)) " " (millimetres(*shift)) br;
                        }
                    }
                }
            } }
        } }
        @if refit.not_told > 0 { p class="quiet" { "and " (refit.not_told) " others, which explain less." } }
    }
}

/// A multiple in words.
fn times(x: f64) -> String {
    if x < 100.0 { format!("{x:.0} times") } else { "more than 100 times".to_owned() }
}

/// A probability by its decimal logarithm.
fn chance(log10: f64) -> String {
    if log10 > -2.5 {
        format!("{:.2}", 10_f64.powf(log10).min(1.0))
    } else {
        format!("10^{log10:.0}").replace('-', "−")
    }
}

fn keep(site: &Site, refit: &Refit, links: &Links) -> Result<Markup, PagesError> {
    let on: Vec<&Effect> = refit.effects.iter().filter(|e| e.on).collect();
    Ok(html! {
        h2 { "Keep" }
        @if on.is_empty() {
            p { "Switch on an effect first: then it can be added to the model as a new revision." }
        } @else {
            p { "Adds " (on.iter().map(|e| e.name.as_str()).collect::<Vec<_>>().join(", "))
                " to the model as a new revision. The same as:" }
            (command(&commands(site, &on).join("\n")))
            @if links.allows_changes() && site.setup.model.is_some() {
                form id="keep" {
                    label { "Token, printed where the server was started " input class="token" type="password"
                        autocomplete="off" size="34"; }
                    button type="submit" { "Keep" }
                }
                div id="kept" role="status" {}
                div id="running" aria-live="polite" { (site.job()?) }
            } @else if !links.is_file() {
                p class="quiet" { "This server only reads. With --model FILE --allow-changes it keeps effects at the \
                    press of a button." }
            }
        }
    })
}

fn limits(basis: &Basis, refit: &Refit) -> Markup {
    html! {
        h2 { "What these numbers are" }
        p {
            "Every number above was solved for just now from what the diagnoses of " (refit.products.len() +
                refit.held_out.len())
            " products have kept: " (grouped(refit.numbers as u64))
                " whitened innovations in the fit. The likelihood is a quadratic form about "
            "the model alone; levels of noise are fitted day by day. A run with the kept model has the last word."
        }
        p {
            "Spectra are those of the same residuals at these values, in groups of bands. An effect that filters a noise \
                does not change the noise here. A lag or a resonance can be moved where a diagnosis of these days names \
                the effect; its other forms, and new formulas, are not in these sums: they need the telemetry (" code { "dragfree diagnose" } ")."
        }
        @if !basis.not_tried().is_empty() {
            details { summary { (basis.not_tried().len()) " effects could not be tried" }
                ul { @for (name, why) in basis.not_tried() { li { strong { (name) } ": " (why) } } }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_address_holds_any_name() {
        let query = Query { on: "a:b c#2,\"<é>".to_owned(), products: "X_1".to_owned(), ..Query::default() };
        assert_eq!(address(&query), "products=X_1&on=a:b%20c%232,%22%3C%C3%A9%3E");
    }

    #[test]
    fn chance_is_told_with_its_power_of_ten() {
        assert_eq!(["1.00", "0.03", "10^−11"], [0.0, -1.5, -11.2].map(chance).each_ref().map(String::as_str));
    }
}
