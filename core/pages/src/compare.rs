//! Where the model fails: channels by bands.

use dragfree_archive::product::JOINT;
use dragfree_workflow::residuals::{Band, Residuals, residuals};
use maud::{Markup, html};
use serde_json::{Value, json};

use crate::PagesError;
use crate::layout::{Links, command, data, page as whole, shell};
use crate::site::Site;

const LEAD: &str = "Look for framed cells with ▲ or ▼: there the residual differs from the noise by more than chance; \
                    a click on a channel shows its spectrum.";

/// The comparison of the newest product.
pub(crate) fn newest(site: &Site, links: &Links) -> Result<Markup, PagesError> {
    let newest = site.archive()?.newest()?.into_iter().rfind(|entry| entry.row.name != JOINT);
    match newest {
        Some(entry) => page(site, &entry.row.id, links),
        None => Ok(whole(links, "Compare", "Compare", LEAD, &html! { p { "No day has a product yet." } })),
    }
}

pub(crate) fn page(site: &Site, id: &str, links: &Links) -> Result<Markup, PagesError> {
    let archive = site.archive()?;
    let row = archive.find(id)?.row;
    let found = residuals(&archive, &row.id)?;
    let failing: Vec<&str> =
        found.channels.iter().filter(|c| c.groups.iter().any(|b| b.fails)).map(|c| c.name.as_str()).collect();
    let telemetry = format!("dragfree compare {} --page compare.html{}", shell(&row.id), site.setup.flags);
    let body = html! {
        p {
            @match links.of("day", &row.id) { Some(to) => a href=(to) { (row.id) }, None => (row.id) } ": "
            @if failing.is_empty() {
                strong class="good-word" { "passes" } ": what the model leaves is the noise of the mission, in every \
                    band of every channel."
            } @else {
                strong class="bad-word" { "fails" } " in " (failing.join(", ")) "."
            }
            " A sound model fails in each channel with a probability of " (found.false_alarm) "."
        }
        h2 { "Power of the residual over that of the noise" }
        p class="quiet" { "1 where the model is right. Groups of bands, a sixth of a decade wide, from low to high \
            frequency; a group is framed with any of its bands." }
        (map(&found))
        h2 { "Spectrum" }
        p class="quiet" { "Solid: measured. Dashed: the declared noise; 95 of 100 measured values lie in the band \
            about it." }
        label class="pick" { "Channel " select id="channel" { @for c in &found.channels { option { (c.name) } } } }
        div class="plot tall" id="spectrum" {}
        (data("residuals", &for_script(&found)))
        h2 { "Hour by hour" }
        p { "The product keeps sums over its whole time. Hours, time series and housekeeping need the telemetry:" }
        (command(&telemetry))
    };
    Ok(whole(links, "Compare", "Where the model fails", LEAD, &body))
}

/// A class for the colour and a sign for those who see none.
fn look(band: &Band) -> (&'static str, &'static str) {
    match band.ratio {
        None => ("void", ""),
        Some(r) if band.fails && r > 1.0 => ("loud fails", "▲"),
        Some(_) if band.fails => ("low fails", "▼"),
        Some(r) if r > band.bounds[1] => ("rather-loud", ""),
        Some(r) if r < band.bounds[0] => ("rather-low", ""),
        Some(_) => ("as-noise", ""),
    }
}

fn map(found: &Residuals) -> Markup {
    html! {
        div class="scroll" tabindex="0" { table class="map" {
            thead { tr {
                th { "Hz from" }
                @for [first, _] in &found.groups_hz { th class="turned" { span { (frequency(*first)) } } }
            } }
            tbody { @for channel in &found.channels { tr {
                th scope="row" { button type="button" class="link" data-channel=(channel.name) { (channel.name) } }
                @for (band, [first, last]) in channel.groups.iter().zip(&found.groups_hz) {
                    @let (class, sign) = look(band);
                    td class=(class) title=(format!("{} to {}: {}", frequency(*first), frequency(*last), words(band))) {
                        @if let Some(ratio) = band.ratio { (short(ratio)) (sign) }
                    }
                }
            } } }
        } }
    }
}

fn frequency(hz: f64) -> String {
    match hz {
        hz if hz < 1e-3 => format!("{:.0} µHz", 1e6 * hz),
        hz if hz < 1e-2 => format!("{:.1} mHz", 1e3 * hz),
        hz if hz < 1.0 => format!("{:.0} mHz", 1e3 * hz),
        hz => format!("{hz:.1} Hz"),
    }
}

fn short(ratio: f64) -> String {
    if ratio < 9.95 { format!("{ratio:.2}") } else { format!("{ratio:.0}") }
}

fn words(band: &Band) -> String {
    match band.ratio {
        None => "no data".to_owned(),
        Some(r) => format!("{} of the noise, 95 % between {:.2} and {:.2}", short(r), band.bounds[0], band.bounds[1]),
    }
}

fn for_script(found: &Residuals) -> Value {
    let with_data = |bands: &[Band]| -> Vec<usize> { (0..bands.len()).filter(|i| bands[*i].ratio.is_some()).collect() };
    let channels = found.channels.iter().map(|c| {
        let at = with_data(&c.bands);
        let of = |f: &dyn Fn(&Band) -> f64| -> Vec<f64> { at.iter().map(|i| f(&c.bands[*i])).collect() };
        json!({
            "name": c.name,
            "hz": at.iter().map(|i| (found.bands_hz[*i][0] * found.bands_hz[*i][1]).sqrt()).collect::<Vec<_>>(),
            "measured": of(&|b| b.measured_asd),
            "modelled": of(&|b| b.modelled_asd),
            "low": of(&|b| b.modelled_asd * b.bounds[0].sqrt()),
            "high": of(&|b| b.modelled_asd * b.bounds[1].sqrt()),
        })
    });
    json!({ "channels": channels.collect::<Vec<_>>() })
}
