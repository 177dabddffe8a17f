//! `dragfree design`.

use super::Done;
use crate::args::{Design as Arguments, Global};
use crate::failure::Failure;
use crate::text::{Paint, columns, labelled, table};
use dragfree_archive::files::IoContext as _;
use dragfree_chart::{Line, Panel, Stroke, svg};
use dragfree_engine::config::Mission as MissionFile;
use dragfree_physics::control_design::{ChannelDesign, Design, design};
use dragfree_physics::decoupling::Allocation;
use dragfree_physics::mission::{Control, Mission};
use serde_json::{Value, json};
use std::f64::consts::TAU;
use std::path::Path;

pub(super) fn execute(command: &Arguments, global: &Global, paint: Paint) -> Result<Done, Failure> {
    let file = MissionFile::load(&command.mission)?;
    let mission = Mission::from_json(&file.value.to_string())?;
    let design = design(&mission)?;
    let allocation = Allocation::new(&mission)?;
    let mut written = Vec::new();
    if let Some(folder) = &command.pictures {
        std::fs::create_dir_all(folder).at("make the folder", folder)?;
        let nyquist_hz = 0.5 * mission.mission.sample_rate_hz;
        let sensitivity = sensitivities(&design, nyquist_hz);
        for (name, panels) in [("sensitivity.svg", sensitivity), ("prediction.svg", predictions(&design, nyquist_hz))] {
            let picture = svg(&panels, 2)?;
            written.push(write(&folder.join(name), &picture)?);
        }
    }
    if let Some(path) = &command.freeze {
        written.push(write(path, &frozen(&mission, &design)?)?);
    }
    if global.json {
        return Ok(Done::json(&to_json(&design, &allocation)));
    }
    let mut text = to_text(&file, &mission, &design, &allocation, paint);
    for path in written {
        text += &format!("wrote {path}\n");
    }
    Ok(Done::new(text))
}

fn write(path: &Path, text: &str) -> Result<String, Failure> {
    std::fs::write(path, text).at("write", path)?;
    Ok(path.display().to_string())
}

/// The controllers as a mission file holds them.
fn frozen(mission: &Mission, design: &Design) -> Result<String, Failure> {
    let control = Control { channel: design.controllers(), ..mission.control.clone().unwrap_or_default() };
    let table = toml::Table::from_iter([("control".to_owned(), toml::Value::try_from(&control)?)]);
    let text = toml::to_string(&table)?;
    Ok(format!("# Controllers by `dragfree design`: in a mission file, in place of its [control].\n{text}"))
}

fn to_json(design: &Design, allocation: &Allocation) -> Value {
    let unattainable = |c: &ChannelDesign| {
        c.unattainable.map(|u| {
            json!({
                "requirement": u.requirement,
                "from_hz": u.from_hz,
                "to_hz": u.to_hz,
                "worst_hz": u.worst_hz,
                "predicted_ratio": u.predicted_ratio,
                "best_ratio": u.best_ratio,
            })
        })
    };
    let channels = design.channels.iter().map(|c| {
        json!({
            "name": c.name,
            "gamma": c.gamma,
            "gamma_flown": c.gamma_flown,
            "order": c.order,
            "max_S_W1": c.max_s_w1,
            "max_T_W3": c.max_t_w3,
            "max_asd_ratio": c.max_asd_ratio,
            "crossover_hz": c.crossover_rad_s / TAU,
            "gain_margin_db": c.gain_margin_db,
            "phase_margin_deg": c.phase_margin_deg,
            "delay_margin_s": c.delay_margin_s,
            "modulus_margin": c.modulus_margin,
            "lmi_max_eigenvalue": c.lmi_max_eigenvalue,
            "forget_time_s": c.forget_time_s,
            "static_stiffness_s2": c.static_stiffness_s2,
            "unattainable": unattainable(c),
        })
    });
    json!({
        "channels": channels.collect::<Vec<_>>(),
        "allocation_residual": allocation.residual,
        "thrust_rules_residual": allocation.thrust_rules,
    })
}

fn to_text(file: &MissionFile, mission: &Mission, design: &Design, allocation: &Allocation, paint: Paint) -> String {
    let delay = mission.control.as_ref().map_or(1, |c| c.delay_samples);
    let head = format!("{} {}: H-infinity design at {} Hz", file.name, file.spacecraft, mission.mission.sample_rate_hz);
    let mut text = format!("{}, {delay} sample(s) of delay\n\n", paint.bold(&head));
    let header = ["channel", "gamma", "order", "S/bound", "T/bound", "gain", "phase", "delay", "modulus", "memory"];
    let units = ["", "", "", "", "", "dB", "deg", "s", "", "s"];
    let mut rows = table(&header, [units.map(str::to_owned).to_vec()]);
    rows.extend(design.channels.iter().map(|c| {
        vec![
            c.name.clone(),
            format!("{:.3}", c.gamma),
            c.order.to_string(),
            format!("{:.3}", c.max_s_w1),
            format!("{:.3}", c.max_t_w3),
            format!("{:.1}", c.gain_margin_db),
            format!("{:.0}", c.phase_margin_deg),
            format!("{:.2}", c.delay_margin_s),
            format!("{:.2}", c.modulus_margin),
            format!("{:.0}", c.forget_time_s),
        ]
    }));
    text += &columns(&rows);
    text.push('\n');
    let worst = design.channels.iter().map(|c| c.lmi_max_eigenvalue).fold(f64::NEG_INFINITY, f64::max);
    text +=
        &labelled("proof", &format!("Bounded Real Lemma: largest eigenvalue {worst:.1e}, below zero on every channel"));
    text += &labelled(
        "thrust",
        &format!(
            "allocation: |B B† − 1| {:.0e}, thrust rules kept to {:.0e}",
            allocation.residual,
            allocation.thrust_rules.iter().copied().fold(0.0, f64::max)
        ),
    );
    let mut beyond: Vec<(String, Vec<&str>)> = Vec::new();
    for c in &design.channels {
        let Some(u) = &c.unattainable else { continue };
        let words = format!(
            "{} cannot be met from {:.1e} to {:.1e} Hz, where disturbance and readout noise together exceed it for every \
             controller: at {:.1e} Hz the best is {:.2} of it, this one {:.2}",
            u.requirement, u.from_hz, u.to_hz, u.worst_hz, u.best_ratio, u.predicted_ratio
        );
        match beyond.iter_mut().find(|(known, _)| *known == words) {
            Some((_, names)) => names.push(&c.name),
            None => beyond.push((words, vec![&c.name])),
        }
    }
    for (words, names) in beyond {
        text += &labelled("beyond", &format!("{}: {words}", names.join(", ")));
    }
    text
}

/// Frequencies of a picture, Hz: 40 a decade.
fn frequencies(low_hz: f64, high_hz: f64) -> impl Iterator<Item = f64> {
    let count = (40.0 * (high_hz / low_hz).log10()).ceil() as u32;
    (0..=count).map(move |i| low_hz * (high_hz / low_hz).powf(f64::from(i) / f64::from(count)))
}

/// Designs that differ visibly, with the channels that share each.
fn different(design: &Design) -> Vec<(String, &ChannelDesign)> {
    let near = |a: f64, b: f64| (a / b - 1.0).abs() < 0.02;
    let mut out: Vec<(String, &ChannelDesign)> = Vec::new();
    for c in &design.channels {
        let alike = |known: &ChannelDesign| {
            let m = (&known.model, &c.model);
            m.0.requirement == m.1.requirement
                && near(known.gamma, c.gamma)
                && near(known.crossover_rad_s, c.crossover_rad_s)
        };
        match out.iter_mut().find(|(_, known)| alike(known)) {
            Some((names, _)) => *names += &format!(", {}", c.name),
            None => out.push((c.name.clone(), c)),
        }
    }
    out
}

fn line(label: &str, colour: usize, stroke: Stroke, range: (f64, f64), value: impl Fn(f64) -> f64) -> Line {
    Line::new(label, colour, stroke, frequencies(range.0, range.1).map(|f| (f, value(f))).collect())
}

/// Lowest frequency of the pictures of the loop, Hz: the bounds hold from there.
const LOW_HZ: f64 = 1e-5;

/// `|S|` and `|T|` of the flown loops under their bounds (the paper's Figure H_infty_results).
fn sensitivities(design: &Design, nyquist_hz: f64) -> Vec<Panel> {
    let range = (LOW_HZ, nyquist_hz * 0.999);
    different(design)
        .into_iter()
        .map(|(title, c)| {
            let lines = vec![
                line("1/|W1|", 0, Stroke::Dashed, range, |f| 1.0 / c.weights.w1(f)),
                line("1/|W3|", 1, Stroke::Dashed, range, |f| 1.0 / c.weights.w3(f)),
                line("|S|", 0, Stroke::Solid, range, |f| c.sensitivity(f).norm()),
                line("|T|", 1, Stroke::Solid, range, |f| c.complementary(f).norm()),
            ];
            Panel { y: Some(1e-8..1e4), ..Panel::over_frequency(title, "gain", LOW_HZ..nyquist_hz, lines) }
        })
        .collect()
}

/// Spectra that the design predicts, against the requirement table.
fn predictions(design: &Design, nyquist_hz: f64) -> Vec<Panel> {
    let range = (1e-4, nyquist_hz.min(1.0));
    different(design)
        .into_iter()
        .map(|(title, c)| {
            let unit = if c.name.ends_with(['x', 'y', 'z']) { "m" } else { "rad" };
            let lines = vec![
                line("requirement", 6, Stroke::Dashed, range, |f| c.required_asd(f)),
                line("predicted", 0, Stroke::Solid, range, |f| c.predicted_asd(f)),
            ];
            Panel::over_frequency(title, format!("ASD / {unit}/√Hz"), range.0..range.1, lines)
        })
        .collect()
}
