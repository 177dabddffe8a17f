//! The page of `dragfree compare`: one file of HTML with its pictures inside, for a reader who knows no filter.

use crate::failure::Failure;
use dragfree_chart::heat::{self, HeatMap};
use dragfree_chart::{Line, Panel, Scale, Stroke, svg};
use dragfree_identification::compare::{Cell, Channel, Comparison, Innovations, Kind};
use dragfree_identification::distributions::{chi2_per_dof_quantile, corrected, two_sided};
use std::fmt::Write as _;

/// Axes of one body stand side by side.
const COLUMNS: usize = 3;

/// Bars of housekeeping.
const BARS: usize = 20;

const STYLE: &str = "body{font:16px/1.5 sans-serif;max-width:1680px;margin:2em auto;padding:0 1em;color:#222}\
p{max-width:60em}svg{width:100%;height:auto}table{border-collapse:collapse;margin:1em 0}\
td,th{padding:.2em .8em;text-align:left;border-bottom:1px solid #ddd}\
.fails{color:#b2182b;font-weight:bold}.passes{color:#2166ac;font-weight:bold}\
.bar{background:#0072b2;height:.8em}.track{width:20em;background:#eee}";

/// The page. `names` are the products, `meaning` what the screen says of the null combinations.
pub(crate) fn page(c: &Comparison, names: &[String], meaning: Option<&str>) -> Result<String, Failure> {
    let names = escape(&names.join(", "));
    let word =
        |passes: bool| if passes { "<span class=passes>passes</span>" } else { "<span class=fails>fails</span>" };
    let mut out = format!(
        "<!DOCTYPE html>\n<html lang=\"en\"><head><meta charset=\"utf-8\"><title>{names}: where the model fails</title>\n\
         <style>{STYLE}</style></head><body>\n<h1>Where the model fails</h1>\n<p>{names}: the model {}. {}</p>\n",
        word(c.passes),
        meaning.map_or(String::new(), |m| escape(&format!("{m}.")))
    );
    let _ = writeln!(
        out,
        "<p>A model says how the spacecraft and its test masses move. What is left when its motion is taken from the measurements should \
         be nothing but the noise of the instruments, which the mission file states. This page holds the one against the other. Of a \
         hundred sound models {} would fail by chance.</p>",
        100.0 * c.false_alarm_rate
    );
    if let Some(nis) = &c.nis {
        let _ = writeln!(
            out,
            "<p>NIS, the recursive filter's own statistic: {:.4}, between {:.4} and {:.4} where all is well: it {}. The filter adapts its \
             noise to what it sees, so a pass of NIS is no pass of the model.</p>",
            nis.value,
            nis.bounds[0],
            nis.bounds[1],
            word(nis.passes)
        );
    }
    out += &table(c, word);
    if !c.innovations.is_empty() {
        let panels: Vec<Panel> = c.innovations.iter().map(innovations).collect();
        section(
            &mut out,
            "What the recursive filter did not foresee",
            "Innovations of the recursive filter, each readout less what was expected of it, octave by octave: power over what the noise of the \
             mission file lets expect for the gains in use. 95 of 100 points lie in the shaded area where filter and noise are right. Not a \
             part of the verdict: each filter follows one test mass and does not know what the other one's readouts would tell it.",
            &svg(&panels, COLUMNS)?,
        );
    }
    section(
        &mut out,
        "How strong, at which frequency",
        "Amplitude of what is left, over frequency: measured, and what the noise of the mission predicts; 95 of 100 points lie in the shaded \
         area where that is all.",
        &lines(c, amplitude)?,
    );
    section(
        &mut out,
        "Measured over predicted",
        "The same, power over predicted power. Where the model is right the line is 1, and 95 of 100 points lie in the shaded area. \
         Above it there is something that nobody predicted; below it the model takes away more than there was.",
        &lines(c, ratio)?,
    );
    let maps: Vec<HeatMap> = c.channels.iter().map(|channel| map(c, channel)).collect();
    section(
        &mut out,
        "When",
        "The same hour by hour. Red is louder than predicted, blue quieter. Single cells of low frequency scatter widely, as an hour holds \
         few of their waves: a frame marks the cells for which chance is no excuse.",
        &heat::svg(&maps, COLUMNS, "measured over predicted power; a frame where that is no chance")?,
    );
    section(
        &mut out,
        "Is it white?",
        "All power up to a frequency, less what it should be. For noise of the predicted shape, at whatever level, the line wanders \
         between the dashed limits.",
        &lines(c, cumulative)?,
    );
    out += "<h2>What goes with it</h2>\n<p>Housekeeping that is coherent with what is left over, below 50 mHz, by the part of the power that \
            it shares in its best band. A place to look and no cause: currents of thrusters follow the commands, and these the noise.</p>\n";
    out += &bars(c);
    if !c.together.is_empty() {
        out += "<p>Housekeeping goes with housekeeping, and one cause lights up all of its kin. Here each is named only if it goes with what is \
                left over beside those before it, and the last column is what all of them share with it, in their best band.</p>\n\
                <table><tr><th>channel<th>housekeeping<th>part of the power</tr>\n";
        for t in &c.together {
            let (channel, drivers) = (escape(&t.channel), escape(&t.drivers.join(", ")));
            let _ = writeln!(out, "<tr><td>{channel}<td>{drivers}<td>{:.0} %</tr>", 100.0 * t.explained);
        }
        out += "</table>\n";
    }
    Ok(out + "</body></html>\n")
}

fn section(out: &mut String, title: &str, caption: &str, picture: &str) {
    // The page is one document: what an SVG file begins with has no place inside.
    let picture = picture.find("<svg").map_or(picture, |at| &picture[at..]);
    let _ = writeln!(out, "<h2>{title}</h2>\n<p>{caption}</p>\n{picture}");
}

fn escape(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;")
}

fn table(c: &Comparison, word: impl Fn(bool) -> &'static str) -> String {
    let mut out =
        "<table><tr><th>channel<th>verdict<th>χ²/dof<th>with fitted noise levels<th>excess<th>fails in</tr>\n"
            .to_owned();
    for channel in &c.channels {
        let failed: Vec<&str> = channel.tests.iter().filter(|t| !t.passes).map(|t| t.name).collect();
        let kind = match channel.kind {
            Kind::Channel => "",
            Kind::Common => " (what both test masses see)",
            Kind::Null => " (no force on the spacecraft reaches it)",
        };
        let _ = writeln!(
            out,
            "<tr><td>{}{kind}<td>{}<td>{:.4} ± {:.4}<td>{:.4}<td>{:.0} %<td>{}</tr>",
            escape(&channel.name),
            if channel.tests.is_empty() { "not tested: its noise is not known" } else { word(channel.passes) },
            channel.chi2_per_dof,
            (2.0 / channel.dof).sqrt(),
            channel.chi2_per_dof_fitted_levels,
            100.0 * channel.unexplained,
            failed.join(", ")
        );
    }
    out + "</table>\n"
}

fn lines(c: &Comparison, of: fn(&Channel) -> Panel) -> Result<String, Failure> {
    Ok(svg(&c.channels.iter().map(of).collect::<Vec<_>>(), COLUMNS)?)
}

/// A panel over frequency.
fn over_frequency(channel: &Channel, y_label: &str, lines: Vec<Line>) -> Panel {
    let ends = [channel.frequency_hz.first(), channel.frequency_hz.last()].map(|f| f.copied().unwrap_or(1.0));
    Panel::over_frequency(&channel.name, y_label, 0.9 * ends[0]..1.1 * ends[1], lines)
}

/// The interval around one, times what `of` makes of each frequency, round and back.
fn area(channel: &Channel, of: impl Fn(usize, f64) -> f64) -> Line {
    let n = channel.frequency_hz.len();
    let end = |b: usize, k: usize| (channel.frequency_hz[b], of(b, channel.interval_95[b][k]));
    Line::new("95 of 100", 6, Stroke::Area, (0..n).map(|b| end(b, 0)).chain((0..n).rev().map(|b| end(b, 1))).collect())
}

fn amplitude(channel: &Channel) -> Panel {
    let root = |psd: &[f64]| channel.frequency_hz.iter().zip(psd).map(|(f, p)| (*f, p.max(0.0).sqrt())).collect();
    let unit = if channel.name.starts_with("sc.") { "rad s⁻² Hz^-1/2" } else { "m s⁻² Hz^-1/2" };
    let around = area(channel, |b, ratio| (ratio * channel.predicted_psd[b]).sqrt());
    let measured = Line::new("measured", 0, Stroke::Solid, root(&channel.measured_psd));
    let predicted = Line::new("predicted", 1, Stroke::Dashed, root(&channel.predicted_psd));
    over_frequency(channel, unit, vec![around, measured, predicted])
}

fn ratio(channel: &Channel) -> Panel {
    let f = &channel.frequency_hz;
    let measured = f.iter().zip(channel.measured_psd.iter().zip(&channel.predicted_psd)).map(|(f, (m, p))| (*f, m / p));
    let lines = vec![area(channel, |_, ratio| ratio), Line::new("measured", 0, Stroke::Solid, measured.collect())];
    Panel { y: Some(0.1..10.0), ..over_frequency(channel, "measured / predicted power", lines) }
}

fn innovations(readout: &Innovations) -> Panel {
    let middle = |octave: &Cell| (octave.band_hz[0] * octave.band_hz[1]).sqrt();
    // The lowest octave stands first, as frequencies grow to the right.
    let octaves: Vec<&Cell> = readout.octaves.iter().rev().filter(|o| o.chi2_per_dof.is_some()).collect();
    let end = |p: f64| octaves.iter().map(move |o| (middle(o), chi2_per_dof_quantile(p, o.dof).max(1e-3)));
    let around = end(0.025).chain(end(0.975).rev()).collect();
    let measured = octaves.iter().map(|o| (middle(o), o.chi2_per_dof.unwrap_or(1.0).max(1e-3))).collect();
    let ends = [octaves.first(), octaves.last()].map(|o| o.map_or(1.0, |o| middle(o)));
    let lines =
        vec![Line::new("95 of 100", 6, Stroke::Area, around), Line::new("measured", 0, Stroke::Solid, measured)];
    let panel =
        Panel::over_frequency(&readout.readout, "innovation / expected power", 0.7 * ends[0]..1.4 * ends[1], lines);
    Panel { y: Some(0.1..10.0), ..panel }
}

fn cumulative(channel: &Channel) -> Panel {
    let limit = channel.cumulative_limit;
    let apart = channel.cumulative.iter().map(|[expected, power]| (*expected, power - expected)).collect();
    let flat = |y: f64| vec![(0.0, y), (0.999_999, y)];
    let most = channel.cumulative.iter().map(|[e, p]| (p - e).abs()).fold(1.5 * limit, f64::max);
    Panel {
        title: channel.name.clone(),
        x_label: "part of all frequencies".to_owned(),
        y_label: "part of the power, less expected".to_owned(),
        x_scale: Scale::Linear,
        y_scale: Scale::Linear,
        x: 0.0..1.0,
        y: Some(-1.1 * most..1.1 * most),
        lines: vec![
            Line::new("measured", 0, Stroke::Solid, apart),
            Line::new("limits", 1, Stroke::Dashed, flat(limit)),
            Line::new("", 1, Stroke::Dashed, flat(-limit)),
        ],
    }
}

/// Hours to the right, bands upwards.
fn map(c: &Comparison, channel: &Channel) -> HeatMap {
    let first = c.hours_ns.first().copied().unwrap_or(0);
    let hour = |ns: i64| (ns - first) as f64 / 3600e9;
    let count = channel.map.iter().flatten().filter(|cell| cell.chi2_per_dof.is_some()).count();
    let mut cells = Vec::new();
    for (row, start) in channel.map.iter().zip(&c.hours_ns) {
        for (b, Cell { band_hz, chi2_per_dof, dof }) in row.iter().enumerate() {
            let Some(ratio) = *chi2_per_dof else { continue };
            cells.push(heat::Cell {
                x: [hour(*start), hour(*start) + 1.0],
                // Up to where the next band begins.
                y: [band_hz[0], row.get(b + 1).map_or(band_hz[1], |next| next.band_hz[0])],
                ratio,
                framed: !channel.tests.is_empty()
                    && corrected(two_sided(ratio, *dof), count as f64) < c.false_alarm_rate_per_test,
            });
        }
    }
    HeatMap { title: channel.name.clone(), x_label: "hour".to_owned(), y_label: "frequency / Hz".to_owned(), cells }
}

fn bars(c: &Comparison) -> String {
    if c.coherences.is_empty() {
        return "<p>None.</p>\n".to_owned();
    }
    let mut out = "<table><tr><th>housekeeping<th>channel<th>part of the power<th></tr>\n".to_owned();
    for w in c.coherences.iter().take(BARS) {
        let percent = 100.0 * w.coherence.explained;
        let _ = writeln!(
            out,
            "<tr><td>{}<td>{}<td><div class=track><div class=bar style=\"width:{percent:.1}%\"></div></div><td>{percent:.0} %</tr>",
            escape(&w.coherence.driver),
            escape(&w.coherence.channel)
        );
    }
    out + "</table>\n"
}
