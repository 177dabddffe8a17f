//! Where the model fails: channels by bands.

use chrono::DateTime;
use dragfree_archive::product::JOINT;
use dragfree_workflow::over_time::{OverTime, extremes, over_time};
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
        (map(&found, None, None))
        h2 { "Spectrum" }
        p class="quiet" { "Solid: measured. Dashed: the declared noise; 95 of 100 measured values lie in the band \
            about it." }
        (spectrum(&found, None, ""))
        @if let Some(residuals) = over_time(&archive, &row.id)? { (series(&residuals, found.false_alarm)) }
        h2 { "Hour by hour" }
        p { "Spectra of single hours, and housekeeping that goes with the residuals, need the telemetry:" }
        (command(&telemetry))
    };
    Ok(whole(links, "Compare", "Where the model fails", LEAD, &body))
}

/// Stretches of the time of a product that a picture tells apart.
const STRETCHES: usize = 720;

/// Residuals over time: a sentence and a picture for each channel.
fn series(residuals: &OverTime, false_alarm: f64) -> Markup {
    let seconds = residuals.time_ns.windows(2).map(|t| (t[1] - t[0]) as f64 * 1e-9).fold(f64::INFINITY, f64::min);
    let told: Vec<_> = residuals.channels.iter().map(|c| (c, residuals.told(c, false_alarm))).collect();
    let clock = |ns: i64| DateTime::from_timestamp_nanos(ns).format("%H:%M:%S").to_string();
    html! {
        h2 { "Over time" }
        p class="quiet" {
            "Means of what the model leaves of each channel over " (short_number(seconds)) " s, in σ of the declared noise: \
            of a sound model 95 of 100 lie between the dashed lines. A glitch is a spike, a slow force a wander, a gap a \
            hole. The numbers are in the topic " code { "/residuals" } " of the " code { ".mcap" } " beside the product."
        }
        @for (channel, told) in &told {
            @if let Some(told) = told {
                section class="chart" {
                    h3 { (channel.name)
                        @if told.stands_out { " " span class="bad-word" { "▲ stands out" } } }
                    p class="quiet" {
                        "Size " (format!("{:.2}", told.size)) ", 1 where the model is right; farthest "
                        (format!("{:+.1}", told.farthest).replace('-', "−")) " σ at " (clock(told.farthest_ns)) "."
                    }
                    div class="plot low-plot" data-over-time=(channel.name) role="img"
                        aria-label={ "Residual of " (channel.name) " over time" } {}
                }
            } @else {
                p { (channel.name) ": no noise is declared for it, so its residual has no σ." }
            }
        }
        (data("over-time", &over_time_for_script(residuals)))
    }
}

fn short_number(x: f64) -> String {
    format!("{x:.3}").trim_end_matches('0').trim_end_matches('.').to_owned()
}

fn over_time_for_script(residuals: &OverTime) -> Value {
    let rounded = |values: &[f64]| -> Vec<Option<f64>> {
        values.iter().map(|x| x.is_finite().then(|| (x * 100.0).round() / 100.0)).collect()
    };
    let all: Vec<_> = residuals.channels.iter().map(|c| extremes(&residuals.time_ns, &c.whitened, STRETCHES)).collect();
    let times = all.first().map_or(&[][..], |e| &e.time_ns);
    let channels = residuals.channels.iter().zip(&all);
    let of = channels.map(|(c, e)| json!({ "name": c.name, "low": rounded(&e.low), "high": rounded(&e.high) }));
    json!({
        "channels": of.collect::<Vec<_>>(),
        "time": times.iter().map(|t| t / 1_000_000_000).collect::<Vec<_>>(),
    })
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

/// A plot of the spectrum of the channel that a reader picks, `first` at the start; `before` is drawn beside it.
pub(crate) fn spectrum(found: &Residuals, before: Option<&Residuals>, first: &str) -> Markup {
    html! {
        label class="pick" { "Channel " select id="channel" autocomplete="off" {
            @for c in &found.channels { option selected[c.name == first] { (c.name) } }
        } }
        div class="plot tall" id="spectrum" {}
        (data("residuals", &for_script(found, before)))
    }
}

/// A cell has changed if it has by this part of the width in which 95 of 100 lie.
const CHANGED: f64 = 0.05;

/// Whether a cell is another than before, to a reader who looks for what the effects change.
fn changed(band: &Band, before: Option<&Band>) -> bool {
    let by = before.and_then(|before| Some((band.ratio? - before.ratio?).abs()));
    by.is_some_and(|by| by > CHANGED * (band.bounds[1] - band.bounds[0]))
}

/// Channels by groups of bands; cells that are others than `before` are underlined, and `fall` is by how much χ² of
/// each channel falls.
pub(crate) fn map(found: &Residuals, before: Option<&Residuals>, fall: Option<&[f64]>) -> Markup {
    html! {
        div class="scroll" tabindex="0" { table class="map" {
            thead { tr {
                th { "Hz from" }
                @for [first, _] in &found.groups_hz { th class="turned" { span { (frequency(*first)) } } }
                @if fall.is_some() { th class="turned" { span { "χ² falls by" } } }
            } }
            tbody { @for (k, channel) in found.channels.iter().enumerate() { tr {
                th scope="row" { button type="button" class="link" data-channel=(channel.name) { (channel.name) } }
                @for (g, (band, [first, last])) in channel.groups.iter().zip(&found.groups_hz).enumerate() {
                    @let was = before.and_then(|all| all.channels.get(k)?.groups.get(g));
                    @let (class, sign) = look(band);
                    td class=(class) title=(format!("{} to {}: {}{}", frequency(*first), frequency(*last), words(band),
                        was.and_then(|b| b.ratio).map_or_else(String::new, |r| format!(", {} with the model alone", short(r))))) {
                        @if let Some(ratio) = band.ratio {
                            @if changed(band, was) { u { (short(ratio)) (sign) } } @else { (short(ratio)) (sign) }
                        }
                    }
                }
                @if let Some(fall) = fall.and_then(|all| all.get(k)) {
                    td class="fall" { (format!("{fall:.1}").replace('-', "−")) }
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

fn for_script(found: &Residuals, before: Option<&Residuals>) -> Value {
    let with_data = |bands: &[Band]| -> Vec<usize> { (0..bands.len()).filter(|i| bands[*i].ratio.is_some()).collect() };
    let channels = found.channels.iter().enumerate().map(|(k, c)| {
        let at = with_data(&c.bands);
        let of = |f: &dyn Fn(&Band) -> f64| -> Vec<f64> { at.iter().map(|i| f(&c.bands[*i])).collect() };
        json!({
            "name": c.name,
            "hz": at.iter().map(|i| (found.bands_hz[*i][0] * found.bands_hz[*i][1]).sqrt()).collect::<Vec<_>>(),
            "measured": of(&|b| b.measured_asd),
            "before": before.map(|all| at.iter().map(|i| all.channels[k].bands[*i].measured_asd).collect::<Vec<_>>()),
            "modelled": of(&|b| b.modelled_asd),
            "low": of(&|b| b.modelled_asd * b.bounds[0].sqrt()),
            "high": of(&|b| b.modelled_asd * b.bounds[1].sqrt()),
        })
    });
    json!({ "channels": channels.collect::<Vec<_>>() })
}
