//! Generated parts of VALIDATION.md and its pictures, from committed results alone.

use dragfree_chart::{ChartError, Line as Curve, Panel, Scale, Stroke, svg};
use dragfree_physics::frames::dcm_turned_about_z;
use nalgebra::{DMatrix, DVector};
use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use crate::bound::free_space;
use crate::campaign::{NOMINAL, TWINS, Twin, note, taiji};
use crate::diagnosis_report;
use crate::error::{CampaignError, file};
use crate::faults::{self, Mixture};
use crate::growth::Growth;
use crate::kills::{self, Kill};
use crate::limits::{self, Limits};
use crate::months::{self, Months};
use crate::peers::Peers;
use crate::program::root;
use crate::records::{Diagnosed, Line, Solution, read, read_document};
use crate::soak::{self, Soak};
use crate::speed::Speed;
use crate::stats::{self, Bounds};
use crate::table::{REGIMES, Row, configuration, mission};

/// False-alarm rate of all checks of a campaign together.
pub(crate) const FALSE_ALARM: f64 = 0.01;
/// σ of the paper's table, mm.
const PAPER_SIGMA_MM: [f64; 6] = [1.335, 0.17, 0.09, 3.76, 0.14, 0.08];
/// Errors of the paper's table, mm.
const PAPER_ERROR_MM: [f64; 6] = [0.06, 1.4, 0.51, 0.68, 0.1, 0.35];
/// Length of the long runs, days.
pub(crate) const TABLE_DAYS: u32 = 25;
/// Short names of the coefficients.
const SHORT: [&str; 6] = ["tm1.x", "tm1.y", "tm1.z", "tm2.x", "tm2.y", "tm2.z"];

/// All results.
#[derive(Clone, Debug, Default)]
pub(crate) struct Measured {
    /// Coverage campaign.
    pub(crate) coverage: Vec<Line>,
    /// The paper's table.
    pub(crate) table: Vec<Row>,
    /// Bars of speed.
    pub(crate) speed: Option<Speed>,
    /// Other packages beside this one.
    pub(crate) peers: Option<Peers>,
    /// How time and memory grow.
    pub(crate) growth: Option<Growth>,
    /// Diagnosis campaign.
    pub(crate) diagnosis: Vec<Diagnosed>,
    /// What data of each length can say.
    pub(crate) limits: Vec<Limits>,
    /// Days together.
    pub(crate) months: Vec<Months>,
    /// Programs that were killed.
    pub(crate) kills: Vec<Kill>,
    /// Telemetry with faults.
    pub(crate) faults: Vec<Mixture>,
    /// Days that were watched.
    pub(crate) soak: Vec<Soak>,
}

impl Measured {
    /// Reads a folder of results.
    pub(crate) fn read(folder: &Path) -> Result<Self, CampaignError> {
        Ok(Self {
            coverage: read(&folder.join("coverage.jsonl"))?,
            table: read(&folder.join("table.jsonl"))?,
            speed: read_document(&folder.join("speed.json"))?,
            peers: read_document(&folder.join("peers.json"))?,
            growth: read_document(&folder.join("growth.json"))?,
            diagnosis: read(&folder.join("diagnosis.jsonl"))?,
            limits: read(&folder.join("limits.jsonl"))?,
            months: read(&folder.join("months.jsonl"))?,
            kills: read(&folder.join("kills.jsonl"))?,
            faults: read(&folder.join("faults.jsonl"))?,
            soak: read(&folder.join("soak.jsonl"))?,
        })
    }
}

/// Solutions to check.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Kind {
    EsAkf,
    Qp,
    Adopted,
}

impl Kind {
    const ALL: [Self; 3] = [Self::EsAkf, Self::Qp, Self::Adopted];

    fn name(self) -> &'static str {
        match self {
            Self::EsAkf => "ES-AKF",
            Self::Qp => "QP",
            Self::Adopted => "adopted",
        }
    }

    fn of(self, line: &Line) -> &Solution {
        match self {
            Self::EsAkf => &line.es_akf,
            Self::Qp => &line.qp,
            Self::Adopted => line.adopted(),
        }
    }
}

/// Columns of the 6 × 6 identity that belong to one test mass.
fn test_mass(i: usize) -> DMatrix<f64> {
    DMatrix::from_fn(6, 3, |row, column| f64::from(u8::from(row == 3 * i + column)))
}

/// Mean NEES divided by its three degrees of freedom.
fn nees(solutions: &[&Solution], basis: &DMatrix<f64>) -> f64 {
    let each = solutions.iter().map(|s| {
        let error = DVector::from_row_slice(&s.error_m);
        stats::nees(&error, &s.covariance(), basis).unwrap_or(f64::NAN)
    });
    each.sum::<f64>() / (3 * solutions.len()) as f64
}

fn rms(values: &[f64]) -> f64 {
    (values.iter().map(|v| v * v).sum::<f64>() / values.len() as f64).sqrt()
}

fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len() as f64
}

fn range(values: impl Iterator<Item = f64>) -> (f64, f64) {
    values.fold((f64::INFINITY, f64::NEG_INFINITY), |(lo, hi), v| (lo.min(v), hi.max(v)))
}

/// A number in mm with three digits.
fn mm(metres: f64) -> String {
    let value = 1e3 * metres;
    let digits = if value.abs() < 9.995 { 2 } else { 1 };
    let digits = if value.abs() < 0.9995 { 3 } else { digits };
    format!("{value:.digits$}")
}

/// Seeds as `1–100`, or one by one.
fn seeds(lines: &[&Line]) -> String {
    let all: BTreeSet<u32> = lines.iter().map(|l| l.seed).collect();
    match (all.first(), all.last()) {
        (Some(first), Some(last)) if (last - first + 1) as usize == all.len() && all.len() > 1 => {
            format!("{first}–{last}")
        }
        _ => all.iter().map(u32::to_string).collect::<Vec<_>>().join(", "),
    }
}

/// What was run, when and with which build.
fn provenance(lines: &[&Line]) -> String {
    let join = |of: &dyn Fn(&Line) -> String| {
        lines.iter().map(|l| of(l)).collect::<BTreeSet<_>>().into_iter().collect::<Vec<_>>().join(", ")
    };
    format!("{}, build {}, {}", join(&|l| l.software.clone()), join(&|l| l.build.clone()), join(&|l| l.date.clone()))
}

/// Section on the campaign, and the statistics out of bounds.
fn coverage(all: &[Line], free: &DMatrix<f64>) -> (String, Vec<String>) {
    let lines: Vec<&Line> = all.iter().filter(|l| l.configuration == NOMINAL).collect();
    let n = lines.len();
    if n == 0 {
        return ("Not measured yet.\n".to_owned(), Vec::new());
    }
    // Number of checks: per solution and coefficient two coverages, a mean and an rms; per solution and set of
    // directions a NEES; verdicts.
    let checks = 4 * 6 * Kind::ALL.len() + 4 + 1;
    let alarm = FALSE_ALARM / checks as f64;
    let counts = [1.0, 2.0].map(|z| stats::accepted_counts(stats::within(z), n, alarm).unwrap_or((0, n)));
    let (mean_bounds, rms_bounds, nees_bounds) =
        (stats::mean(n, alarm), stats::rms(n, alarm), stats::chi2_per_dof(3.0 * n as f64, alarm));
    let count_bounds = counts.map(|(low, high)| Bounds { low: low as f64, high: high as f64 });
    let mut failed = Vec::new();
    // The text of a value, bold if it is out of bounds.
    let mut judge = |what: String, value: f64, bounds: Bounds, text: String| {
        if bounds.hold(value) {
            return text;
        }
        failed.push(format!("{what}: {text}, outside [{:.4}, {:.4}]", bounds.low, bounds.high));
        format!("**{text}**")
    };
    let adopted_apart = lines.iter().filter(|l| l.adopted.is_some()).count();
    let mut rows = String::new();
    for kind in Kind::ALL {
        for (i, name) in SHORT.iter().enumerate() {
            let pulls: Vec<f64> = lines.iter().map(|l| kind.of(l).pulls()[i]).collect();
            let errors: Vec<f64> = lines.iter().map(|l| kind.of(l).error_m[i]).collect();
            let what = |statistic: &str| format!("{} {name}, {statistic}", kind.name());
            let mut cells = Vec::new();
            for (z, bounds) in [1.0, 2.0].into_iter().zip(count_bounds) {
                let k = pulls.iter().filter(|p| p.abs() <= z).count();
                cells.push(judge(what(&format!("within {z}σ")), k as f64, bounds, k.to_string()));
            }
            let m = mean(&pulls);
            cells.push(judge(what("mean pull"), m, mean_bounds, format!("{m:+.2}")));
            let r = rms(&pulls);
            cells.push(judge(what("rms pull"), r, rms_bounds, format!("{r:.2}")));
            let sigma = stats::median(lines.iter().map(|l| kind.of(l).sigma_m()[i]).collect());
            let p_end = if kind == Kind::EsAkf {
                let end = stats::median(lines.iter().map(|l| l.p_end_sigma_m[i]).collect());
                let pulls: Vec<f64> = lines.iter().map(|l| l.es_akf.error_m[i] / l.p_end_sigma_m[i]).collect();
                format!("{}, {:.2}", mm(end), rms(&pulls))
            } else {
                String::new()
            };
            // The adopted solution is the QP's on nearly all days: checked, but not printed again.
            if kind != Kind::Adopted || adopted_apart > 0 {
                let _ = writeln!(
                    rows,
                    "| {} {name} | {} | {} | {} | {p_end} |",
                    kind.name(),
                    mm(sigma),
                    mm(rms(&errors)),
                    cells.join(" | ")
                );
            }
        }
    }
    let of = |kind: Kind| lines.iter().map(|l| kind.of(l)).collect::<Vec<_>>();
    let mut squares = Vec::new();
    for (what, value) in [
        ("ES-AKF, tm1", nees(&of(Kind::EsAkf), &test_mass(0))),
        ("ES-AKF, tm2", nees(&of(Kind::EsAkf), &test_mass(1))),
        ("QP", nees(&of(Kind::Qp), free)),
        ("adopted", nees(&of(Kind::Adopted), free)),
    ] {
        let text = judge(format!("NEES/dof of {what}"), value, nees_bounds, format!("{value:.3}"));
        squares.push(format!("{what} {text}"));
    }
    let verdicts = |name: &str| lines.iter().filter(|l| l.verdict == name).count();
    let disagree = verdicts("disagree");
    // Upper bound: the difference of two solutions of the same data varies less than the sum of their variances.
    let promised = 6.0 * (1.0 - stats::within(3.0));
    let most = (0..=n).rev().find(|k| stats::clopper_pearson(*k, n, 2.0 * alarm).low <= promised).unwrap_or(n);
    let most_bounds = Bounds { low: 0.0, high: most as f64 };
    let disagree = judge("verdicts `disagree`".to_owned(), disagree as f64, most_bounds, disagree.to_string());
    let (nis, chi2) = (range(lines.iter().map(|l| l.nis)), range(lines.iter().map(|l| l.chi2_per_dof)));

    let mut text = String::new();
    let _ = writeln!(
        text,
        "{n} days, seeds {} ({}). Each is simulated, calibrated in science mode and compared with a truth that no stage has seen. \
         Every number has bounds that honest σ leave once in {:.0}; all {checks} checks together fail by chance once in {:.0} \
         (Bonferroni, which holds whatever depends on what: the survey ties the test masses, so that the six rows of the QP are \
         only three independent numbers). **Bold** is outside.\n",
        seeds(&lines),
        provenance(&lines),
        1.0 / alarm,
        1.0 / FALSE_ALARM
    );
    let _ = writeln!(
        text,
        "| solution | σ (median), mm | rms error, mm | within σ | within 2σ | mean pull | rms pull | P_end: σ, rms pull |\n\
         |---|---|---|---|---|---|---|---|\n\
         | *accepted* | | | {}–{} of {n} | {}–{} | ±{:.2} | {:.2}–{:.2} | |\n{rows}",
        counts[0].0, counts[0].1, counts[1].0, counts[1].1, mean_bounds.high, rms_bounds.low, rms_bounds.high
    );
    if adopted_apart == 0 {
        text += "What the product adopts is the QP's solution in every one.\n";
    } else {
        let _ = writeln!(text, "What the product adopts is the QP's solution in {} of {n}.", n - adopted_apart);
    }
    let _ = writeln!(
        text,
        "NEES per degree of freedom, accepted {:.3}–{:.3}: {}; that of the QP in the three directions that the survey leaves open, \
         both housings together along s₁, s₂, s₃. Verdicts: {} `agree`, {disagree} `disagree` (the rule of 3σ promises at most {:.1}, \
         accepted up to {most}), {} `weak`. NIS from {:.4} to {:.4}, χ²/dof against the mission's noise from {:.4} to {:.4}.",
        nees_bounds.low,
        nees_bounds.high,
        squares.join(", "),
        verdicts("agree"),
        promised * n as f64,
        verdicts("weak"),
        nis.0,
        nis.1,
        chi2.0,
        chi2.1
    );
    text += "P_end is what the paper reports. The prior of tm1.x and tm2.x, 27 mm about the drawings, holds a sixth of the ES-AKF's \
             information on them in a day; the truth is 1 mm from the drawings, so that their pulls are a little small.\n";
    if failed.is_empty() {
        let _ = writeln!(text, "\nAll {checks} checks hold.\n");
    } else {
        let _ = writeln!(text, "\n{} of {checks} checks fail:\n", failed.len());
        for check in &failed {
            let _ = writeln!(text, "- {check}");
        }
        text.push('\n');
    }
    text += "![Claimed and found coverage](ops-guide/src/pictures/coverage.svg)\n";
    (text, failed)
}

/// Statistics of a twin that must fail if it is unprotected.
struct Twinned {
    cells: Vec<String>,
    failed: Vec<&'static str>,
    agree: usize,
}

fn twin(lines: &[&Line], unprotected: bool, free: &DMatrix<f64>, alarm: f64) -> Twinned {
    let n = lines.len();
    let solutions: Vec<(Solution, Solution)> =
        lines.iter().map(|l| if unprotected { l.bare() } else { (l.es_akf.clone(), l.qp.clone()) }).collect();
    let es_akf: Vec<&Solution> = solutions.iter().map(|s| &s.0).collect();
    let qp: Vec<&Solution> = solutions.iter().map(|s| &s.1).collect();
    let dof: f64 = lines.iter().map(|l| l.nis_dof).sum();
    let nis = lines.iter().map(|l| l.nis * l.nis_dof).sum::<f64>() / dof;
    // Both test masses share the thrust: count their degrees of freedom once.
    let bounds = stats::chi2_per_dof(3.0 * n as f64, alarm);
    let recursive = 0.5 * (nees(&es_akf, &test_mass(0)) + nees(&es_akf, &test_mass(1)));
    let batch = nees(&qp, free);
    let mut failed = Vec::new();
    let mut cell = |what: &'static str, value: f64, bounds: Bounds, judged: bool, digits: usize| {
        let text = format!("{value:.digits$}");
        if !judged || bounds.hold(value) {
            return text;
        }
        failed.push(what);
        format!("**{text}**")
    };
    let share = |all: &[&Solution]| {
        let inside: usize = all.iter().map(|s| s.pulls().iter().filter(|p| p.abs() <= 1.0).count()).sum();
        format!("{:.0} %", 100.0 * inside as f64 / (6 * all.len()) as f64)
    };
    // With adaptation NIS is not χ² distributed.
    let nis_bounds = stats::chi2_per_dof(dof, alarm);
    let verdicts = |name: &str| lines.iter().filter(|l| l.verdict == name).count();
    let worst = |all: &[&Solution]| mm(range(all.iter().flat_map(|s| s.error_m).map(f64::abs)).1);
    let cells = vec![
        cell("NIS", nis, nis_bounds, unprotected, 4),
        cell("NEES of the ES-AKF", recursive, bounds, true, 2),
        cell("NEES of the QP", batch, bounds, true, 2),
        share(&es_akf),
        share(&qp),
        worst(&qp),
        format!("{} / {}", verdicts("agree"), n - verdicts("agree")),
    ];
    Twinned { cells, failed, agree: verdicts("agree") }
}

/// Section on the twins, and those that do not behave as required.
fn twins(all: &[Line], free: &DMatrix<f64>) -> (String, Vec<String>) {
    let of = |name: &str| all.iter().filter(|l| l.configuration == name).collect::<Vec<&Line>>();
    let runs = TWINS.iter().map(|t| 1 + usize::from(t.with_product)).sum::<usize>();
    let alarm = FALSE_ALARM / (3 * runs) as f64;
    let mut rows = String::new();
    let (mut problems, mut told) = (Vec::new(), Vec::new());
    let mut every: Vec<&Line> = Vec::new();
    let mut put = |twin_of: &Twin, lines: Vec<&'_ Line>, unprotected: bool| {
        if lines.is_empty() {
            return;
        }
        let found = twin(&lines, unprotected, free, alarm);
        let is_control = twin_of.name == TWINS[0].name;
        match (is_control, unprotected, found.failed.is_empty()) {
            (false, true, true) => problems.push(format!("no statistic sees the twin: {}", twin_of.words)),
            (true, _, false) => problems.push(format!("the control fails: {}", found.failed.join(", "))),
            (false, false, false) if found.agree == 0 => {
                told.push(format!("{}: no verdict is `agree`", twin_of.words));
            }
            (false, false, false) => {
                let silent = format!("{} of {} verdicts are `agree`", found.agree, lines.len());
                problems.push(format!(
                    "the product is wrong: {}: {}; {silent}",
                    twin_of.words,
                    found.failed.join(", ")
                ));
            }
            _ => {}
        }
        let mode = if unprotected { "off" } else { "product" };
        let _ = writeln!(rows, "| {} | {mode} | {} | {} |", twin_of.words, lines.len(), found.cells.join(" | "));
    };
    for t in &TWINS {
        put(t, of(&t.unprotected()), true);
        put(t, of(&t.product()), false);
        every.extend(of(&t.unprotected()));
        every.extend(of(&t.product()));
    }
    if every.is_empty() {
        return ("Not measured yet.\n".to_owned(), Vec::new());
    }
    let full = stats::chi2_per_dof(3.0 * f64::from(TWINS[0].seeds), alarm);
    let mut text = format!(
        "Something is wrong on purpose: what the mission file says of the noise, or the noise itself ({}). Each six hours long, seeds \
         from 1, with a prior of 1 m, so that only the data speak. *Off*: no adaptation, no gate, no refinement of Σ, no widening of σ \
         (the weights of α̂ are measured in both); \
         there the statistics must fail, or they have no power. *Product*: as it is shipped. **Bold** is outside of bounds that honest \
         σ leave once in {:.0}: NEES/dof {:.2}–{:.2} for {} seeds. NIS is judged where nothing adapts.\n\n\
         | what is wrong | mode | seeds | NIS | NEES/dof ES-AKF | NEES/dof QP | within σ, ES-AKF | within σ, QP | largest error of the \
         QP, mm | agree / other verdicts |\n|---|---|---|---|---|---|---|---|---|---|\n{rows}",
        provenance(&every),
        1.0 / alarm,
        full.low,
        full.high,
        TWINS[0].seeds
    );
    if !told.is_empty() {
        text += "\nWrong, and every product says so:\n\n";
        for twin in &told {
            let _ = writeln!(text, "- {twin}");
        }
    }
    if problems.is_empty() {
        text +=
            "\nEvery twin is seen, the control passes, and the product stays honest or says that something is wrong.\n";
    } else {
        text += "\nNot as it should be:\n\n";
        for problem in &problems {
            let _ = writeln!(text, "- {problem}");
        }
    }
    (text, problems)
}

/// Section on the paper's table, and the missed bars.
fn table(all: &[Row]) -> (String, Vec<String>) {
    if all.is_empty() {
        return ("Not measured yet.\n".to_owned(), Vec::new());
    }
    let mut text = String::new();
    let mut missed = Vec::new();
    let row = |name: &str, cells: &dyn Fn(usize) -> String| {
        format!("| {name} | {} |\n", (0..6).map(cells).collect::<Vec<_>>().join(" | "))
    };
    let lines: Vec<&Line> = all.iter().map(|r| &r.run).collect();
    let _ = writeln!(
        text,
        "Value (error) ± σ in mm; below, σ over its information bound, which is computed from the mission's noise alone, without \
         data: for the ES-AKF that of one test mass, for the QP that of both with the survey ({}).",
        provenance(&lines)
    );
    let lengths: BTreeSet<u32> = all.iter().map(|r| (r.run.hours / 24.0).round() as u32).collect();
    for days in lengths.iter().rev() {
        let _ = writeln!(
            text,
            "\n| {days} day{} | {} |\n|---|---|---|---|---|---|---|",
            if *days == 1 { "" } else { "s" },
            SHORT.join(" | ")
        );
        text += &row("truth", &|i| format!("{:.3}", 1e3 * all[0].truth_m[i]));
        if *days == TABLE_DAYS {
            text += &row("paper, 25 days: error ± σ", &|i| format!("{} ± {}", PAPER_ERROR_MM[i], PAPER_SIGMA_MM[i]));
        }
        for regime in &REGIMES {
            for r in all.iter().filter(|r| r.run.configuration == configuration(regime.name, *days)) {
                let title = format!("**{}**, seed {}", regime.words, r.run.seed);
                let _ = writeln!(text, "| {title} | | | | | | |");
                let cell = |s: &Solution, i: usize| {
                    format!("{:.3} ({:+.3}) ± {}", 1e3 * s.value_m[i], 1e3 * s.error_m[i], mm(s.sigma_m()[i]))
                };
                let (es_akf, qp) = (&r.run.es_akf, &r.run.qp);
                text += &row("ES-AKF", &|i| cell(es_akf, i));
                text += &row("its σ over the bound", &|i| format!("{:.2}", es_akf.sigma_m()[i] / r.single_m[i]));
                text += &row("QP", &|i| cell(qp, i));
                text += &row("its σ over the bound", &|i| format!("{:.2}", qp.sigma_m()[i] / r.surveyed_m[i]));
                let mut bar = |what: &str, held: &dyn Fn(usize) -> bool| {
                    let bad: Vec<&str> = (0..6).filter(|i| !held(*i)).map(|i| SHORT[i]).collect();
                    if !bad.is_empty() {
                        missed.push(format!("{title}, {days} d: {what}: {}", bad.join(", ")));
                    }
                };
                bar("ES-AKF error above 3σ", &|i| es_akf.pulls()[i].abs() <= 3.0);
                bar("QP error above 3σ", &|i| qp.pulls()[i].abs() <= 3.0);
                bar("QP σ more than 10 % from its bound", &|i| (qp.sigma_m()[i] / r.surveyed_m[i] - 1.0).abs() <= 0.1);
                if *days == TABLE_DAYS {
                    bar("ES-AKF σ more than 20 % from its bound", &|i| {
                        (es_akf.sigma_m()[i] / r.single_m[i] - 1.0).abs() <= 0.2
                    });
                    bar("QP error above 0.3 mm", &|i| qp.error_m[i].abs() <= 3e-4);
                    bar("QP σ above 0.2 mm", &|i| qp.sigma_m()[i] <= 2e-4);
                } else {
                    bar("QP error above 1 mm", &|i| qp.error_m[i].abs() <= 1e-3);
                    bar("QP σ above 1 mm", &|i| qp.sigma_m()[i] <= 1e-3);
                }
            }
        }
    }
    if missed.is_empty() {
        text += "\nEvery bar is met: 25 days, |error| ≤ 3σ, QP |error| ≤ 0.3 mm and σ ≤ 0.2 mm, σ within 10 % (QP) and 20 % (ES-AKF) of \
                 the bounds; 1 day, QP |error| and σ ≤ 1 mm.\n";
    } else {
        text += "\nBars missed:\n\n";
        for bar in &missed {
            let _ = writeln!(text, "- {bar}");
        }
    }
    (text, missed)
}

/// Picture of observed over nominal coverage.
fn picture(all: &[Line], free: &DMatrix<f64>) -> Result<Option<String>, ChartError> {
    let lines: Vec<&Line> = all.iter().filter(|l| l.configuration == NOMINAL).collect();
    if lines.is_empty() {
        return Ok(None);
    }
    let recursive: Vec<f64> = lines.iter().flat_map(|l| l.es_akf.pulls()).collect();
    // The QP along its three free directions.
    let batch: Vec<f64> = lines
        .iter()
        .flat_map(|l| {
            let error = free.transpose() * DVector::from_row_slice(&l.qp.error_m);
            let covariance = free.transpose() * l.qp.covariance() * free;
            (0..3).map(move |i| error[i] / covariance[(i, i)].sqrt()).collect::<Vec<_>>()
        })
        .collect();
    let claimed = || (1..200).map(|k| f64::from(k) / 200.0);
    let found = |pulls: &[f64]| -> Vec<(f64, f64)> {
        claimed()
            .map(|p| {
                let z = stats::half_width(p);
                (p, pulls.iter().filter(|pull| pull.abs() <= z).count() as f64 / pulls.len() as f64)
            })
            .collect()
    };
    // Dvoretzky–Kiefer–Wolfowitz–Massart bound for the QP's number of independent pulls.
    let width = ((2.0 / FALSE_ALARM).ln() / (2.0 * batch.len() as f64)).sqrt();
    let bound = |shift: f64| claimed().map(|p| (p, (p + shift).clamp(0.0, 1.0))).collect::<Vec<_>>();
    let panel = Panel {
        title: format!("Truth within the interval, {} days", lines.len()),
        x_label: "claimed probability".to_owned(),
        y_label: "found".to_owned(),
        x_scale: Scale::Linear,
        y_scale: Scale::Linear,
        x: 0.0..1.0,
        y: Some(0.0..1.0),
        lines: vec![
            Curve::new("1 % bounds", 6, Stroke::Dashed, bound(width)),
            Curve::new("", 6, Stroke::Dashed, bound(-width)),
            Curve::new(format!("ES-AKF, {} pulls", recursive.len()), 1, Stroke::Solid, found(&recursive)),
            Curve::new(format!("QP, {} pulls", batch.len()), 0, Stroke::Solid, found(&batch)),
        ],
    };
    svg(&[panel], 1).map(Some)
}

/// A report.
pub(crate) struct Report {
    /// Generated parts by marker name.
    pub(crate) parts: BTreeMap<&'static str, String>,
    /// Pictures with their places; omitted without a campaign.
    pub(crate) pictures: Vec<(PathBuf, String)>,
    /// Statistics out of bounds and missed bars.
    pub(crate) failed: Vec<String>,
}

/// Creates the report.
pub(crate) fn report(measured: &Measured) -> Result<Report, CampaignError> {
    let mission = mission(&taiji())?;
    let dcm = ["tm1", "tm2"].map(|name| mission.test_mass.get(name).map_or(0.0, |tm| tm.orf_from_srf_angle_rad));
    let free = free_space(&dcm.map(dcm_turned_about_z));
    let (coverage, mut failed) = coverage(&measured.coverage, &free);
    let (twins, more) = twins(&measured.coverage, &free);
    failed.extend(more);
    let (table, more) = table(&measured.table);
    failed.extend(more);
    let missing = || "Not measured yet.\n".to_owned();
    let speed = measured.speed.as_ref().map_or_else(missing, Speed::table);
    let peers = measured.peers.as_ref().map_or_else(missing, Peers::table);
    let growth = measured.growth.as_ref().map_or_else(missing, Growth::table);
    let (diagnosis, more) = diagnosis_report::numbers(&measured.diagnosis, &free);
    failed.extend(more);
    let (months, more) = months::table(&measured.months);
    failed.extend(more);
    let (kills, more) = kills::table(&measured.kills);
    failed.extend(more);
    let (faults, more) = faults::table(&measured.faults);
    failed.extend(more);
    let (soak, more) = soak::table(&measured.soak);
    failed.extend(more);
    let drawn = [
        ("coverage", picture(&measured.coverage, &free)),
        ("confusion", diagnosis_report::picture(&measured.diagnosis)),
        ("growth", measured.growth.as_ref().map(Growth::picture).transpose()),
    ];
    let mut pictures = Vec::new();
    for (name, picture) in drawn {
        let path = picture_path(name);
        pictures.extend(picture.map_err(|e| file(&path, &e))?.map(|picture| (path, picture)));
    }
    let parts = BTreeMap::from([
        ("coverage", coverage),
        ("twins", twins),
        ("table", table),
        ("speed", speed),
        ("peers", peers),
        ("growth", growth),
        ("diagnosis", diagnosis),
        ("limits", limits::table(&measured.limits)),
        ("months", months),
        ("kills", kills),
        ("faults", faults),
        ("soak", soak),
    ]);
    Ok(Report { parts, pictures, failed })
}

/// VALIDATION.md.
pub(crate) fn document_path() -> PathBuf {
    root().join("VALIDATION.md")
}

/// A picture of the guide.
pub(crate) fn picture_path(name: &str) -> PathBuf {
    root().join("ops-guide/src/pictures").join(name).with_extension("svg")
}

/// A document with its generated parts replaced; `None` if a part has no markers.
pub(crate) fn rewritten(document: &str, parts: &BTreeMap<&'static str, String>) -> Option<String> {
    let mut text = document.to_owned();
    for (name, part) in parts {
        let (open, close) = (format!("<!-- generated: {name} -->\n"), format!("<!-- /generated: {name} -->"));
        let start = text.find(&open)? + open.len();
        let end = start + text[start..].find(&close)?;
        text.replace_range(start..end, part);
    }
    Some(text)
}

/// Writes the generated parts of VALIDATION.md and the pictures.
pub(crate) fn write(folder: &Path) -> Result<(), CampaignError> {
    let report = report(&Measured::read(folder)?)?;
    let path = document_path();
    let document = std::fs::read_to_string(&path).map_err(|e| file(&path, &e))?;
    let text =
        rewritten(&document, &report.parts).ok_or_else(|| file(&path, &"a marker of a generated part is missing"))?;
    std::fs::write(&path, text).map_err(|e| file(&path, &e))?;
    for (path, picture) in &report.pictures {
        std::fs::write(path, picture).map_err(|e| file(path, &e))?;
    }
    for failed in &report.failed {
        note(&format!("outside: {failed}"));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::records::tests::line;
    use rand::SeedableRng;
    use rand_distr::{Distribution, StandardNormal};
    use rand_xoshiro::Xoshiro256PlusPlus;

    /// VALIDATION.md and the pictures match the committed results.
    #[test]
    fn validation_is_what_the_results_say() {
        let found = report(&Measured::read(&root().join("validation/results")).unwrap()).unwrap();
        let document = std::fs::read_to_string(document_path()).unwrap();
        let wanted = rewritten(&document, &found.parts).expect("every part has its markers");
        assert!(document == wanted, "run `cargo run --release -p dragfree-validation -- report`");
        for (path, picture) in found.pictures {
            assert_eq!(std::fs::read_to_string(path).unwrap(), picture);
        }
    }

    fn free() -> DMatrix<f64> {
        free_space(&[30.0_f64, -30.0].map(|a| dcm_turned_about_z(a.to_radians())))
    }

    /// Solutions whose errors are normal with `scale` times the claimed σ; the QP's in its free space.
    fn campaign(n: u32, scale: f64, shift_m: f64) -> Vec<Line> {
        let mut rng = Xoshiro256PlusPlus::seed_from_u64(1);
        let free = free();
        (1..=n)
            .map(|seed| {
                let mut l = line(NOMINAL, seed);
                let mut deviate = || -> f64 { StandardNormal.sample(&mut rng) };
                l.es_akf.error_m = std::array::from_fn(|_| 1e-3 * scale * deviate() + shift_m);
                let c = &free * DVector::from_fn(3, |_, _| 2e-4 * scale * deviate());
                l.qp.error_m = std::array::from_fn(|i| c[i]);
                let covariance = &free * free.transpose() * 4e-8;
                l.qp.covariance_m2 =
                    (0..6).flat_map(|i| (i..6).map(move |j| (i, j))).map(|ij| covariance[ij]).collect();
                l
            })
            .collect()
    }

    /// 100 days with right σ pass all checks; errors of 1.3σ, a bias of 0.6σ or a dozen disagreements fail.
    #[test]
    fn the_campaign_has_power() {
        assert_eq!(coverage(&campaign(100, 1.0, 0.0), &free()).1, Vec::<String>::new());
        let small = coverage(&campaign(100, 1.3, 0.0), &free()).1;
        assert!(small.iter().any(|f| f.contains("NEES/dof of QP")), "{small:?}");
        let shifted = coverage(&campaign(100, 1.0, 6e-4), &free()).1;
        assert!(shifted.iter().any(|f| f.contains("ES-AKF") && f.contains("mean pull")), "{shifted:?}");
        let mut quarrel = campaign(100, 1.0, 0.0);
        quarrel.iter_mut().take(12).for_each(|l| l.verdict = "disagree".to_owned());
        let quarrel = coverage(&quarrel, &free()).1;
        assert_eq!(quarrel.len(), 1, "{quarrel:?}");
    }

    /// A twin that no statistic detects, and a control that fails, are reported.
    #[test]
    fn a_twin_without_power_is_told() {
        let mut lines = campaign(40, 1.0, 0.0);
        lines.iter_mut().for_each(|l| l.configuration = TWINS[0].unprotected());
        assert_eq!(twins(&lines, &free()).1, Vec::<String>::new());
        lines.iter_mut().for_each(|l| l.configuration = TWINS[1].unprotected());
        assert!(twins(&lines, &free()).1[0].contains("no statistic sees"));
        let mut loud = campaign(40, 3.0, 0.0);
        loud.iter_mut().for_each(|l| l.configuration = TWINS[1].unprotected());
        assert_eq!(twins(&loud, &free()).1, Vec::<String>::new());
        loud.iter_mut().for_each(|l| l.configuration = TWINS[1].product());
        assert!(twins(&loud, &free()).1[0].contains("the product is wrong"));
        loud.iter_mut().for_each(|l| l.verdict = "disagree".to_owned());
        assert_eq!(twins(&loud, &free()).1, Vec::<String>::new());
        loud.iter_mut().for_each(|l| l.configuration = TWINS[0].product());
        assert!(twins(&loud, &free()).1[0].contains("the control fails"));
    }

    #[test]
    fn the_table_names_the_bars_that_are_missed() {
        let mut run = line(&configuration(REGIMES[0].name, TABLE_DAYS), 1);
        run.hours = 600.0;
        let mut row = Row { run, truth_m: [0.09; 6], single_m: [1e-3; 6], surveyed_m: [2e-4; 6] };
        let (text, missed) = table(std::slice::from_ref(&row));
        assert!(missed.is_empty() && text.contains("Every bar is met"), "{missed:?}");
        row.surveyed_m[2] = 1.5e-4;
        row.run.qp.error_m[4] = 4e-4;
        let (text, missed) = table(&[row]);
        assert!(
            missed.len() == 2 && text.contains("tm1.z") && text.contains("QP error above 0.3 mm: tm2.y"),
            "{missed:?}"
        );
    }

    #[test]
    fn parts_go_between_their_markers_and_nowhere_else() {
        let document = "a\n<!-- generated: table -->\nold\n<!-- /generated: table -->\nb\n";
        let parts = BTreeMap::from([("table", "new\n".to_owned())]);
        let text = rewritten(document, &parts).unwrap();
        assert_eq!(text, document.replace("old", "new"));
        assert_eq!(rewritten(&text, &parts).as_deref(), Some(text.as_str()));
        assert!(rewritten("a", &parts).is_none());
    }
}
