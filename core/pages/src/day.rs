//! A product as an operator reads it.

use chrono::NaiveDate;
use dragfree_archive::product::{Coefficient, Product};
use dragfree_archive::{Archive, EXTRACT, JOINT, Row};
use dragfree_workflow::provenance::lineage;
use maud::{Markup, html};

use crate::PagesError;
use crate::jobs::Job;
use crate::layout::{Links, command, error, millimetres, page as whole, picture, shell, value};
use crate::mission::running;
use crate::pictures;
use crate::site::Site;
use crate::starting::button;

pub(crate) fn page(site: &Site, id: &str, links: &Links) -> Result<Markup, PagesError> {
    let archive = site.archive()?;
    let row = archive.find(id)?.row;
    let product = archive.document(&row.id)?;
    let has_extract = archive.files_of(&row.id)?.iter().any(|(suffix, ..)| suffix == EXTRACT);
    let lineage = lineage(&archive, &row.id)?;
    // A diagnosis may name what both solutions are wrong by together.
    let diagnosed = if has_extract { Diagnosed::of(site, &row.id) } else { Diagnosed::No };
    let (class, word, sentence) = advice(&row, &product, &diagnosed);
    let attributes = &product.header.non_standard_attributes;
    let hours = (attributes.stop_time_epoch_ns - attributes.start_time_epoch_ns) as f64 / 3.6e12;
    let body = html! {
        p class={ "verdict " (class) } { strong { (word) } " " (sentence) }
        @for id in &lineage.superseded_by {
            p { "A newer revision took its place: "
                @match links.of("day", id) { Some(to) => a href=(to) { (id) }, None => (id) } }
        }
        p class="quiet" {
            (attributes.day) ", " (format!("{hours:.1}")) " h · model " (product.model.revision) ": "
            (product.model.effects.join(", ")) " · " (product.quality.epochs_used) " epochs used, "
            (product.quality.epochs_rejected) " not"
        }
        (coefficients(&product))
        (before(site, &archive, &row, &product, links)?)
        (quality(&product))
        (next(site, &row, &product, &diagnosed, links)?)
        h2 { "Where it comes from" }
        p { "Inputs on the left, the product, and what came of it on the right. Numbers are the starts of SHA-256 \
            digests." }
        (picture(&pictures::lineage(&lineage)?, "What the product was made of, and what was made of it"))
        (command(&format!("dragfree products lineage {}{}\ndragfree products rebuild {}{}", row.id, site.setup.flags,
            row.id, site.setup.flags)))
    };
    let lead = "Read the coloured sentence first: it says whether to use the values below.";
    Ok(whole(links, "Day", &row.id, lead, &body))
}

const NOT_DIAGNOSED: &str =
    "An effect that the model lacks may still move both alike: a diagnosis has not looked for one.";

/// What the diagnosis of a product has found.
enum Diagnosed {
    No,
    /// Its extract is damaged, or of another release.
    Unreadable(String),
    Yes {
        named: Vec<String>,
        unexplained: Vec<String>,
    },
}

impl Diagnosed {
    fn of(site: &Site, id: &str) -> Self {
        match site.basis(id) {
            Ok(basis) => Self::Yes { named: basis.named().to_vec(), unexplained: basis.unexplained().to_vec() },
            Err(error) => Self::Unreadable(error.to_string()),
        }
    }
}

/// Whether to use the values: class, word, sentence.
fn advice(row: &Row, product: &Product, diagnosed: &Diagnosed) -> (&'static str, &'static str, String) {
    let verdict = row.verdict.as_deref();
    if let Some(reason) = &row.withdrawn {
        return ("bad", "Do not use it.", format!("It was withdrawn: {reason}"));
    }
    if let Some(problem) = &row.problem {
        return ("bad", "Do not use it.", problem.clone());
    }
    if let Some(from) = &product.model.fixed_from {
        return (
            "weak",
            "A test.",
            format!("Its model was fixed at the values of {from}: it says how well these predict this day."),
        );
    }
    if !product.result.adopted().iter().any(|c| c.value.is_finite() && c.sigma.is_finite()) {
        let why = "It has no values: too few data came, or too many were lost. Losses and notes are below.";
        return ("bad", "Do not use it.", why.to_owned());
    }
    if verdict == Some("disagree") {
        let why = "Something speaks against the model: solutions differ by more than their errors, or a test of the data \
                   fails. The notes say which.";
        return ("bad", "Do not use it.", why.to_owned());
    }
    if product.quality.inconsistent {
        let why = "The model contradicts the data: something is missing from it, or the noise is another one.";
        return ("bad", "Do not use it.", why.to_owned());
    }
    if let Diagnosed::Yes { named, unexplained } = diagnosed {
        let not_yet = |why: String| ("bad", "Do not use it yet.", why);
        if !named.is_empty() {
            let what = named.join(", ");
            return not_yet(format!(
                "The diagnosis names an effect that the model lacks: {what}. It moves the offset; the page on missing \
                 physics shows by how much."
            ));
        }
        if !unexplained.is_empty() {
            let what = unexplained.join("; ");
            return not_yet(format!("The diagnosis finds that the model does not explain the data: {what}."));
        }
    }
    let many = product.header.non_standard_attributes.product == JOINT;
    let agreement = match () {
        () if verdict == Some("weak") => "The data do not determine everything.",
        () if verdict != Some("agree") => "No two solutions were compared.",
        () if many => "What fits all days fits each.",
        () if product.result.is_compared() => "The recursive and the batch solution agree within their errors.",
        () => "No test of the data speaks against the model; there is no recursive solution to compare with.",
    };
    if product.quality.data_loss {
        return ("lost", "Use it with care.", format!("{agreement} But data were lost; the losses are below."));
    }
    if verdict == Some("weak") {
        let what = product.quality.weak_directions.join("; ");
        return ("weak", "Use it with care.", format!("The data do not determine everything: {what}"));
    }
    let diagnosis = match diagnosed {
        Diagnosed::No => NOT_DIAGNOSED.to_owned(),
        Diagnosed::Unreadable(why) => format!("{NOT_DIAGNOSED} One was made, and cannot be read: {why}."),
        Diagnosed::Yes { .. } => "A diagnosis found no effect missing.".to_owned(),
    };
    let (class, word) = if verdict == Some("agree") { ("good", "Use it.") } else { ("weak", "Use it with care.") };
    (class, word, format!("{agreement} {diagnosis}"))
}

fn coefficients(product: &Product) -> Markup {
    let adopted = product.result.adopted();
    let mut solutions: Vec<&str> = product.result.coefficients.iter().map(|c| c.solution.as_str()).collect();
    solutions.dedup();
    let mut seen: Vec<&str> = Vec::new();
    solutions.retain(|s| {
        !seen.contains(s) && {
            seen.push(s);
            true
        }
    });
    let of = |name: &str, solution: &str| -> Option<&Coefficient> {
        product.result.coefficients.iter().find(|c| c.name == name && c.solution == solution)
    };
    let main = adopted.first().map(|c| c.solution.as_str()).unwrap_or_default();
    html! {
        h2 { "Values" }
        p { "Value ± one standard deviation. The column " strong { (main) } " is the one to use." }
        div class="scroll" tabindex="0" { table {
            thead { tr { th { "coefficient" } @for s in &solutions { th { (s) } } th { "frame" } } }
            tbody { @for c in &adopted { tr {
                th scope="row" { (c.name) }
                @for s in &solutions {
                    td class=(if *s == main { "figure main" } else { "figure" }) {
                        @if let Some(c) = of(&c.name, s) { (value(c.value, c.sigma, &c.unit)) }
                    }
                }
                td { (c.frame) }
            } } }
        } }
    }
}

/// The values beside those of the product of the same day before it: what another model has made of the same hours.
fn before(site: &Site, archive: &Archive, row: &Row, product: &Product, links: &Links) -> Result<Markup, PagesError> {
    let same = |other: &&Row| {
        (&other.day, &other.spacecraft, &other.name) == (&row.day, &row.spacecraft, &row.name)
            && other.number < row.number
            && other.fixed_from.is_none()
    };
    let rows = archive.rows()?;
    let Some(other) = rows.iter().filter(same).max_by_key(|other| other.number) else { return Ok(html! {}) };
    let earlier = archive.document(&other.id)?;
    let truth = |name: &str| site.setup.truth.as_ref().and_then(|truth| truth(name));
    let was = earlier.result.adopted();
    let now = product.result.adopted();
    let pairs: Vec<(&Coefficient, &Coefficient)> = now
        .iter()
        .filter(|c| c.unit == "m")
        .filter_map(|c| Some((*was.iter().find(|w| w.name == c.name)?, *c)))
        .collect();
    let known = pairs.iter().any(|(_, c)| truth(&c.name).is_some());
    let (q, e) = (&product.quality, &earlier.quality);
    Ok(html! {
        h2 { "Against the product before it" }
        p {
            @match links.of("day", &other.id) { Some(to) => a href=(to) { (other.id) }, None => (other.id) }
            ", model " (earlier.model.revision) ": χ²/dof " (format!("{:.4}", e.chi2_per_dof)) ", now "
            strong { (format!("{:.4}", q.chi2_per_dof)) } "; NIS " (format!("{:.4}", e.nis)) ", now "
            strong { (format!("{:.4}", q.nis)) } "."
        }
        div class="scroll" tabindex="0" { table id="before" {
            thead { tr { th { "coefficient" } th { "before" } th { "now" } th { "change" }
                @if known { th { "true error before" } th { "now" } } } }
            tbody { @for (was, c) in &pairs { tr {
                th scope="row" { (c.name) }
                td class="figure" { (value(was.value, was.sigma, &was.unit)) }
                td class="figure main" { (value(c.value, c.sigma, &c.unit)) }
                td class="figure" { (millimetres(c.value - was.value)) }
                @if let Some(true_m) = truth(&c.name) {
                    td class="figure" { (error(was.value - true_m, was.sigma)) }
                    td class="figure" { (error(c.value - true_m, c.sigma)) }
                }
            } } }
        } }
    })
}

fn quality(product: &Product) -> Markup {
    let q = &product.quality;
    html! {
        h2 { "Quality" }
        p { "χ² per degree of freedom and NIS are 1 where model and noise are right." }
        dl {
            dt { "χ²/dof" } dd { (format!("{:.4}", q.chi2_per_dof)) }
            dt { "NIS" } dd { (format!("{:.4}", q.nis)) }
            @if let Some(commands) = &q.commands { dt { "Commands" } dd { (commands) } }
            dt { "Time scale" } dd { (product.header.non_standard_attributes.time_scale) }
        }
        @if !q.weak_directions.is_empty() {
            h3 { "Not determined by the data" }
            ul { @for direction in &q.weak_directions { li { (direction) } } }
        }
        @if !product.losses.is_empty() {
            h3 { "Losses" }
            ul { @for loss in &product.losses { li { strong { (loss.count) } " " (loss.kind) ": " (loss.detail) } } }
        }
        @if !q.notes.is_empty() {
            h3 { "Notes" }
            ul { @for note in &q.notes { li { (note) } } }
        }
    }
}

fn next(site: &Site, row: &Row, product: &Product, diagnosed: &Diagnosed, links: &Links) -> Result<Markup, PagesError> {
    let (id, flags) = (shell(&row.id), &site.setup.flags);
    Ok(html! {
        h2 { "What next" }
        ul {
            @if let Some(to) = links.of("compare", &row.id) {
                li { a href=(to) { "See where the model fails" } ", channel by channel and band by band." }
            }
            @if matches!(diagnosed, Diagnosed::Yes { .. }) && let Some(to) = links.missing(&row.id) {
                li { a href=(to) { "See which effect is missing" } ": switch effects on and watch the offset move." }
            }
        }
        @if !matches!(diagnosed, Diagnosed::Yes { .. }) && product.model.fixed_from.is_none() {
            p { "There is no diagnosis of this product that can be read. The diagnosis reads the telemetry once; after it \
                effects can be switched on here:" }
            (button(site, links, &Job::Diagnose { product: row.id.clone() }, "Diagnose"))
            @if !links.is_file() { div id="running" aria-live="polite" data-reload="" { (running(site)?) } }
        }
        p { "It holds for a time once it is certified:" }
        (command(&format!("dragfree products certify {id} --into SET --from {} --until {}{flags}",
            product.header.non_standard_attributes.day, day_after(&product.header.non_standard_attributes.day))))
    })
}

/// The day after one; itself where it is none.
fn day_after(day: &str) -> String {
    let next = day.parse::<NaiveDate>().ok().and_then(|day| day.succ_opt());
    next.map_or_else(|| day.to_owned(), |day| day.to_string())
}
