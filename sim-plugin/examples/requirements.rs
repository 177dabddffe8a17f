//! Draws a day of the closed loop against the requirement table, and prints how much of it each channel uses:
//! `cargo run --release -p dragfree-sim --example requirements -- FOLDER`.

#[path = "../tests/record/mod.rs"]
mod record;

use dragfree_chart::{Line, Panel, Scale, Stroke, svg};
use dragfree_physics::control_design::{ChannelDesign, design};
use dragfree_physics::spectrum::Spectrum;
use record::{RESOLUTIONS, Record, bands, requirement_psd, serving, spectra, taiji};
use std::io::Write as _;
use std::path::PathBuf;

const DAY: usize = 864_000;
/// Points of a spectrum per decade.
const PER_DECADE: f64 = 24.0;

/// ASD of a series in narrow bands, each from the resolution that serves it.
fn asd(series: &[f64], rate_hz: f64) -> Vec<(f64, f64)> {
    let spectra = spectra(series, rate_hz);
    let edge = |i: u32| 10_f64.powf(-4.0 + f64::from(i) / PER_DECADE);
    let count = (4.0 * PER_DECADE) as u32;
    (0..count).filter_map(|i| mean(&spectra, edge(i), edge(i + 1))).collect()
}

fn mean(spectra: &[Spectrum; 3], lo: f64, hi: f64) -> Option<(f64, f64)> {
    let ratio = serving(spectra, (lo, hi)).ratio(lo..hi, |_| 1.0)?;
    Some(((lo * hi).sqrt(), ratio.value.sqrt()))
}

fn line(label: &str, colour: usize, stroke: Stroke, points: Vec<(f64, f64)>) -> Line {
    Line { label: label.to_owned(), colour, stroke, points }
}

fn panel(title: &str, unit: &str, lines: Vec<Line>) -> Panel {
    Panel {
        title: title.to_owned(),
        x_label: "frequency / Hz".to_owned(),
        y_label: format!("ASD / {unit}/√Hz"),
        x_scale: Scale::Logarithmic,
        y_scale: Scale::Logarithmic,
        x: 1e-4..1.0,
        y: None,
        lines,
    }
}

/// Channels of one kind in one panel: spectra, predictions, requirement.
fn group(title: &str, unit: &str, names: &[&str], record: &Record, channels: &[ChannelDesign]) -> Panel {
    let frequencies: Vec<f64> = (0..=160).map(|i| 10_f64.powf(-4.0 + f64::from(i) / 40.0)).collect();
    let of = |name: &str| channels.iter().position(|c| c.name == name).expect("a channel");
    let mut lines: Vec<Line> = names
        .iter()
        .enumerate()
        .map(|(colour, name)| line(name, colour, Stroke::Solid, asd(&record.states[of(name)], record.rate_hz)))
        .collect();
    let first = &channels[of(names[0])];
    lines.push(line(
        "predicted",
        4,
        Stroke::Dashed,
        frequencies.iter().map(|f| (*f, first.predicted_asd(*f))).collect(),
    ));
    lines.push(line(
        "requirement",
        6,
        Stroke::Dashed,
        frequencies.iter().map(|f| (*f, first.required_asd(*f))).collect(),
    ));
    panel(title, unit, lines)
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let folder = PathBuf::from(std::env::args().nth(1).ok_or("name the folder of the pictures")?);
    std::fs::create_dir_all(&folder)?;
    let mission = taiji();
    let design = design(&mission)?;
    let record = Record::new(&mission, 1, DAY);
    let groups: [(&str, &str, &[&str]); 6] = [
        ("sensitive axes", "m", &["tm1.x", "tm2.x"]),
        ("lateral axes", "m", &["tm1.y", "tm2.y", "tm1.z", "tm2.z"]),
        ("attitude of the spacecraft", "rad", &["sc.phi", "sc.theta", "sc.psi"]),
        ("roll of the test masses", "rad", &["tm1.phi", "tm2.phi"]),
        ("pitch of the test masses", "rad", &["tm1.theta", "tm2.theta"]),
        ("yaw of the test masses", "rad", &["tm1.psi", "tm2.psi"]),
    ];
    let panels: Vec<Panel> = groups.iter().map(|(t, u, names)| group(t, u, names, &record, &design.channels)).collect();
    std::fs::write(folder.join("requirements.svg"), svg(&panels, 2)?)?;

    let axes = ["x", "y", "z"].iter().enumerate().map(|(axis, name)| {
        let of = |series: &[Vec<f64>; 3]| asd(&series[axis], record.rate_hz);
        let lines = vec![
            line("acceleration", 0, Stroke::Solid, of(&record.acceleration_orf_m_s2)),
            line("−Ω(ω) b", 1, Stroke::Solid, of(&record.coupling_orf_m_s2)),
        ];
        panel(&format!("test mass 1, {name}"), "m s⁻²", lines)
    });
    std::fs::write(folder.join("acceleration.svg"), svg(&axes.collect::<Vec<_>>(), 3)?)?;

    let mut out = std::io::stdout().lock();
    writeln!(out, "| channel | largest of the requirement | in Hz | predicted there |")?;
    writeln!(out, "|---|---|---|---|")?;
    for (c, series) in design.channels.iter().zip(&record.states) {
        let spectra = spectra(series, record.rate_hz);
        let used = bands().map(|band| {
            let ratio = serving(&spectra, band).ratio(band.0..band.1, |f| requirement_psd(&mission, &c.name, f));
            let predicted = serving(&spectra, band).frequency_hz.iter().filter(|f| (band.0..band.1).contains(f));
            let predicted: Vec<f64> = predicted.map(|f| (c.predicted_asd(*f) / c.required_asd(*f)).powi(2)).collect();
            let mean = predicted.iter().sum::<f64>() / predicted.len() as f64;
            (band, ratio.map_or(f64::NAN, |r| r.value.sqrt()), mean.sqrt())
        });
        let attainable = used.filter(|(band, _, _)| c.unattainable.is_none_or(|u| band.0 > u.to_hz));
        let (band, measured, predicted) = attainable.max_by(|a, b| a.1.total_cmp(&b.1)).ok_or("no band")?;
        writeln!(out, "| {} | {measured:.3} | {:.1e} to {:.1e} | {predicted:.3} |", c.name, band.0, band.1)?;
    }
    writeln!(out, "\nSegments of {:?} s.", RESOLUTIONS.map(|(s, _, _)| s))?;
    Ok(())
}
