//! `dragfree compare`: the data of products once more, against the model and the noise of the mission.

mod page;

use super::{Done, INCONSISTENT, products, replay};
use crate::args::{Compare, Global};
use crate::failure::Failure;
use crate::text::{self, Paint, columns, labelled};
use dragfree_archive::files::IoContext as _;
use dragfree_identification::coherence::{Coherence, StepwiseCoherence};
use dragfree_identification::compare::{Channel, Comparison, Innovations, Kind, Test};
use dragfree_workflow::compare::compare;
use std::path::Path;

/// Housekeeping channels that the screen names.
const NAMED: usize = 5;

pub(super) fn execute(command: &Compare, global: &Global, paint: Paint) -> Result<Done, Failure> {
    let names = &command.products;
    let products = products::open_all(names, &command.archive.folder()?)?;
    products::look_for(&products, &command.inputs.folders)?;
    let comparison = replay::with_meter(&products, global, compare)?;
    if let Some(path) = &command.page {
        let meaning = (!comparison.passes).then(|| meaning(&comparison));
        let page = page::page(&comparison, names, meaning)?;
        std::fs::write(path, page).at("write", path)?;
    }
    let done = if global.json {
        Done::json(&products::said_of(&products, &comparison)?)
    } else {
        let names = names.join(" ") + &super::repeated(Some(&command.archive.folder()?), global);
        Done::new(screen(&comparison, &names, command.page.as_deref(), paint))
    };
    Ok(Done { code: if comparison.passes { 0 } else { INCONSISTENT }, ..done })
}

fn screen(c: &Comparison, names: &str, page: Option<&Path>, paint: Paint) -> String {
    let (word, sentence) = if c.passes {
        (paint.good("passes"), "passes: what the model leaves is the noise of the mission")
    } else {
        (paint.bad("fails"), "fails: what the model leaves is not the noise of the mission alone")
    };
    let plain = sentence.split(':').next().unwrap_or_default();
    let mut out = labelled("verdict", sentence).replacen(plain, &word, 1);
    let tests: usize = c.channels.iter().map(|c| c.tests.len()).sum();
    out += &labelled(
        "tested",
        &format!("{tests} questions, so that {} of 100 sound models fail by chance", 100.0 * c.false_alarm_rate),
    );
    out.push('\n');
    out += &table(c);
    out += "\nfails in  L level, B a band, H a band of an hour, C cumulative periodogram,\n";
    out += "          A autocorrelation (Ljung–Box)\n\n";
    if !c.passes {
        out += &labelled("meaning", meaning(c));
    }
    if let Some(nis) = &c.nis {
        let within = format!("{:.4} ({:.4} to {:.4})", nis.value, nis.bounds[0], nis.bounds[1]);
        let words = match (nis.passes, c.passes) {
            (true, true) => format!("{within} passes"),
            (true, false) => format!(
                "{within} passes, and says nothing here: the filter adapts its noise to what it sees, so a pass of NIS is no pass \
                 of the model"
            ),
            (false, _) => format!("{within} fails: the filter's innovations are not what it expects"),
        };
        out += &labelled("NIS", &words);
    }
    if !c.innovations.is_empty() && c.innovations.iter().all(|i| i.passes) {
        out += &labelled("filter", "its innovations are white in every octave, at the level that it expects");
    }
    let coloured: Vec<String> = c.innovations.iter().filter(|i| !i.passes).map(innovation).collect();
    if !coloured.is_empty() {
        out += &labelled(
            "filter",
            &format!(
                "its innovations against what it expects at this noise, where farthest: {}; no part of the verdict",
                coloured.join(", ")
            ),
        );
    }
    let suspects = suspects(c);
    let together = c.together.iter().map(together).collect::<Vec<_>>();
    if !together.is_empty() {
        out += &labelled("coherent", &format!("{}; where to look, not a cause", together.join("; ")));
    } else if !suspects.is_empty() {
        out += &labelled("coherent", &format!("{}: where to look, not a cause", suspects.join(", ")));
    }
    let next = if c.passes {
        format!("`dragfree diagnose {names}` sees effects that are too small for a spectrum, by what they go with")
    } else {
        format!("`dragfree diagnose {names}` asks which effect is missing")
    };
    out += &labelled("next", &next);
    out + &match page {
        Some(path) => format!("page      {}\n", path.display()),
        None => labelled("page", "--page FILE.html draws spectra and maps"),
    }
}

/// `tm1.y ×1.80 at 0.3m–0.6mHz`.
fn innovation(i: &Innovations) -> String {
    let octave = &i.octaves[i.farthest];
    let ratio = octave.chi2_per_dof.map_or("?".to_owned(), |r| format!("{r:.2}"));
    format!("{} ×{ratio} at {}", i.readout, hertz(octave.band_hz))
}

/// One row a channel.
fn table(c: &Comparison) -> String {
    let heading = ["channel", "χ²/dof", "95 %", "levels", "excess", "fails in", "where most"];
    let row = |channel: &Channel| {
        let letters = channel.tests.iter().map(|t| if t.passes { '·' } else { letter(t) });
        let worst =
            channel.tests.iter().filter(|t| !t.passes && t.at.is_some()).min_by(|a, b| a.p_value.total_cmp(&b.p_value));
        let place = worst.and_then(|t| Some(format!("{} ×{}", hertz(t.at.as_ref()?.band_hz), figure(t.statistic))));
        vec![
            // The channel's middle word says only what kind it is.
            channel.name.replace(".accel", "").replace("alpha", "α"),
            figure(channel.chi2_per_dof),
            format!("±{}", figure(1.96 * (2.0 / channel.dof).sqrt())),
            figure(channel.chi2_per_dof_fitted_levels),
            format!("{:.0} %", 100.0 * channel.unexplained),
            if channel.tests.is_empty() { "no noise".to_owned() } else { letters.collect() },
            place.unwrap_or_default(),
        ]
    };
    columns(&text::table(&heading, c.channels.iter().map(row)))
}

fn letter(test: &Test) -> char {
    match test.name {
        "level" => 'L',
        "bands" => 'B',
        "hours" => 'H',
        "cumulative" => 'C',
        _ => 'A',
    }
}

fn figure(x: f64) -> String {
    match x.abs() {
        size if size < 10.0 => format!("{x:.3}"),
        size if size < 1e4 => format!("{x:.0}"),
        _ => format!("{x:.0e}"),
    }
}

fn hertz([first, last]: [f64; 2]) -> String {
    let one = |f: f64| if f < 0.1 { format!("{:.3}m", 1e3 * f) } else { format!("{f:.4}") };
    let short = |f: f64| {
        one(f).chars().take(4).collect::<String>().trim_end_matches('.').to_owned() + if f < 0.1 { "m" } else { "" }
    };
    if first == last { format!("{}Hz", short(first)) } else { format!("{}–{}Hz", short(first), short(last)) }
}

/// What the null combinations tell.
fn meaning(c: &Comparison) -> &'static str {
    let fails = |kind: Kind| c.channels.iter().any(|c| c.kind == kind && !c.passes);
    let attitude = c.channels.iter().any(|c| c.name.starts_with("sc.") && !c.passes);
    let known = c.channels.iter().any(|c| c.kind == Kind::Null);
    match (known, fails(Kind::Null), fails(Kind::Common) || fails(Kind::Channel)) {
        (false, ..) => "no two test masses see the same force: nothing tells the spacecraft's forces from theirs",
        (_, true, _) => {
            "the null combinations fail, which no force on the spacecraft reaches: something acts on a test mass or its readout"
        }
        (_, false, true) if attitude => {
            "the null combinations pass: torques, attitude sensing or forces on the spacecraft, not the test masses"
        }
        _ => {
            "the null combinations pass, which no force on the spacecraft reaches: it is such a force, or the noise of the thrusters"
        }
    }
}

fn fails(c: &Comparison, name: &str) -> bool {
    c.channels.iter().any(|c| c.name == name && !c.passes)
}

/// `tm1.y with hk/a and beside it hk/b, 64 % of 0.2m–0.5mHz`.
fn together(t: &StepwiseCoherence) -> String {
    let name = t.channel.replace(".accel", "").replace("alpha", "α");
    format!("{name} with {}, {:.0} % of {}", t.drivers.join(" and beside it "), 100.0 * t.explained, hertz(t.band_hz))
}

/// Housekeeping that goes with the channels that fail, the strongest form of each.
fn suspects(c: &Comparison) -> Vec<String> {
    let mut named: Vec<&Coherence> = Vec::new();
    for w in c.coherences.iter().map(|w| &w.coherence).filter(|w| fails(c, &w.channel)) {
        let told = |other: &&Coherence| other.of.iter().any(|name| w.of.contains(name));
        if !named.iter().any(told) && named.len() < NAMED {
            named.push(w);
        }
    }
    named.into_iter().map(|w| w.driver.clone()).collect()
}
