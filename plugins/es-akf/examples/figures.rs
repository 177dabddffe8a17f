//! The pictures `akf1_vs_akf2_x|y|z.svg` and `tm1|tm2_com_convergence.svg` of the guide, as the paper has them, from
//! telemetry of the simulator:
//!
//! ```sh
//! cargo build --release --workspace
//! ./target/release/dragfree simulate fixtures/missions/taiji.toml --days 25 --seed 1 --out DIR
//! cargo run --release -p dragfree-es-akf --example figures -- DIR ops-guide/src/pictures
//! ```
//!
//! A third argument, `adaptations` or `convergence`, makes one kind alone. Convergence is from all days; the three
//! adaptations are compared over the first three, without the repairs of `Q̂` that the stage makes and the paper does
//! not.

#![allow(clippy::print_stdout, reason = "it prints what the pictures show")]

use dragfree_chart::{Line, Panel, Scale, Stroke, svg};
use dragfree_engine::chain::{Carry, Sink, build};
use dragfree_engine::config::{Mission, Model, Pipeline};
use dragfree_engine::feed::{Feed, FileFeed};
use dragfree_engine::registry::Registry;
use dragfree_engine::table::{Batch, TableSpec};
use std::path::{Path, PathBuf};

type Failure = Box<dyn std::error::Error>;

const AXES: [&str; 3] = ["x", "y", "z"];
const STEP_NS: i64 = 100_000_000;
const HOUR: usize = 36_000;
const COMPARED_DAYS: usize = 3;
/// Epochs shown of each readout, at the end of what is compared.
const SHOWN: usize = 1500;
/// Points of a line in a picture.
const POINTS: usize = 500;
const ADAPTATIONS: [&str; 3] = ["innovation", "residual", "monotone"];

fn fixture(path: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../fixtures").join(path)
}

fn telemetry(folder: &Path) -> Result<Vec<PathBuf>, Failure> {
    let mut files: Vec<PathBuf> = std::fs::read_dir(folder)?.map(|e| e.map(|e| e.path())).collect::<Result<_, _>>()?;
    files.retain(|p| p.extension().is_some_and(|e| e == "mcap"));
    files.sort();
    Ok(files)
}

/// Sees the telemetry and the rows of `es-akf` as they pass.
trait Watch {
    fn telemetry(&mut self, _table: &TableSpec, _batch: &Batch) {}
    fn estimates(&mut self, table: &TableSpec, batch: &Batch);
}

struct Estimates<'a>(&'a mut dyn Watch);

impl Sink for Estimates<'_> {
    fn rows(&mut self, table: &TableSpec, batch: &Batch) -> Result<(), String> {
        self.0.estimates(table, batch);
        Ok(())
    }
}

/// The chain of the paper up to the filter, over the files.
fn run(files: &[PathBuf], parameters: &str, watch: &mut dyn Watch) -> Result<(), Failure> {
    let folder = tempfile::tempdir()?;
    let path = folder.path().join("pipeline.toml");
    let stages = ["preprocess", "hinf-dfacs"].map(|p| format!("[[stage]]\nplugin = \"{p}\"\n")).join("");
    let text = format!(
        "[pipeline]\nname = \"figures\"\nproduct = \"FIG\"\nrelease = 1\n{stages}[[stage]]\neffects = true\n\
         [[stage]]\nplugin = \"es-akf\"\nparameters = {{ {parameters} }}\n"
    );
    std::fs::write(&path, text)?;
    let program = std::env::current_exe()?;
    let plugins = program.parent().and_then(Path::parent).ok_or("no folder of plugins")?.to_owned();
    let registry = Registry::discover(&[plugins]);
    let mission = Mission::load(&fixture("missions/taiji.toml"))?;
    let model = Model::load(&fixture("models/com-offset.toml"))?;
    let mut feed = FileFeed::open(files, None, None, 2, &mission)?;
    let tables = feed.tables().to_vec();
    let carry = Carry { batch_rows: 65_536, threads: 2, run_in_until_ns: None };
    let mut chain = build(&registry, &Pipeline::load(&path)?, &mission, &model, &tables, carry)?;
    while let Some(chunk) = feed.next()? {
        for (table, batch) in tables.iter().zip(&chunk.batches) {
            watch.telemetry(table, batch);
        }
        chain.feed(chunk, &mut Estimates(watch))?;
    }
    chain.finish(&mut Estimates(watch))?;
    Ok(())
}

fn column<'a>(table: &TableSpec, batch: &'a Batch, name: &str) -> &'a [f64] {
    let at = table.columns.iter().position(|c| c.name == name);
    &batch.columns[at.unwrap_or_else(|| panic!("table {} has no column {name}", table.name))]
}

/// Field `number` of a protobuf message made of messages of three doubles.
fn vector(message: &[u8], number: u8) -> [f64; 3] {
    let mut at = 0;
    while at + 1 < message.len() {
        let (tag, length) = (message[at], message[at + 1] as usize);
        let inside = &message[at + 2..at + 2 + length];
        if tag == number << 3 | 2 {
            let mut value = [0.0; 3];
            for field in inside.chunks_exact(9) {
                let bytes: [u8; 8] = field[1..].try_into().expect("eight bytes");
                value[usize::from(field[0] >> 3) - 1] = f64::from_le_bytes(bytes);
            }
            return value;
        }
        at += 2 + length;
    }
    [0.0; 3]
}

/// The truth: offsets of both test masses, and the displacement of the first, from the first day's midnight on.
struct Truth {
    start_ns: i64,
    offset_m: [[f64; 3]; 2],
    r1_m: Vec<[f64; 3]>,
}

fn truth(folder: &Path) -> Result<Truth, Failure> {
    let mut truth = Truth { start_ns: 0, offset_m: [[0.0; 3]; 2], r1_m: Vec::new() };
    for path in telemetry(&folder.join("truth"))?.iter().take(COMPARED_DAYS) {
        for message in mcap::MessageStream::new(&std::fs::read(path)?)? {
            let message = message?;
            if truth.r1_m.is_empty() {
                truth.start_ns = message.log_time.cast_signed();
                truth.offset_m = [vector(&message.data, 6), vector(&message.data, 7)];
            }
            truth.r1_m.push(vector(&message.data, 1));
        }
    }
    Ok(truth)
}

/// Offsets over time.
#[derive(Default)]
struct Convergence {
    time_ns: Vec<i64>,
    /// Value and σ by test mass and axis.
    lines: [[(Vec<f64>, Vec<f64>); 3]; 2],
}

impl Watch for Convergence {
    fn estimates(&mut self, table: &TableSpec, batch: &Batch) {
        self.time_ns.extend(&batch.time_ns);
        for (tm, lines) in self.lines.iter_mut().enumerate() {
            for (axis, (value, sigma)) in AXES.iter().zip(lines) {
                let name = format!("com-offset.tm{}.{axis}", tm + 1);
                value.extend(column(table, batch, &name));
                sigma.extend(column(table, batch, &format!("{name}.sigma")));
            }
        }
    }
}

/// One adaptation's displacements of test mass 1 against the truth, and the readout's.
struct Tracking<'a> {
    truth: &'a Truth,
    /// Mean square error by hour: estimate and readout, x, y, z.
    square: Vec<[[f64; 2]; 3]>,
    /// Estimate and readout over what is shown.
    shown: [[Vec<f64>; 2]; 3],
}

impl<'a> Tracking<'a> {
    fn new(truth: &'a Truth) -> Self {
        let hours = truth.r1_m.len().div_ceil(HOUR);
        let empty = || std::array::from_fn(|_| [vec![f64::NAN; SHOWN], vec![f64::NAN; SHOWN]]);
        Self { truth, square: vec![[[0.0; 2]; 3]; hours], shown: empty() }
    }

    fn add(&mut self, what: usize, axis: usize, time_ns: &[i64], values: &[f64]) {
        let first_shown = self.truth.r1_m.len() - SHOWN;
        for (t, x) in time_ns.iter().zip(values) {
            let k = ((t - self.truth.start_ns + STEP_NS / 2) / STEP_NS).cast_unsigned() as usize;
            let Some(truth) = self.truth.r1_m.get(k) else { continue };
            let error = x - truth[axis];
            self.square[k / HOUR][axis][what] += error * error / HOUR as f64;
            if k >= first_shown {
                self.shown[axis][what][k - first_shown] = *x;
            }
        }
    }
}

impl Watch for Tracking<'_> {
    fn telemetry(&mut self, table: &TableSpec, batch: &Batch) {
        let readouts: &[(usize, &str)] = match table.name.as_str() {
            "ifo" => &[(0, "tm1.x_orf_m")],
            "is" => &[(1, "tm1.r_orf_m.y"), (2, "tm1.r_orf_m.z")],
            _ => &[],
        };
        for (axis, name) in readouts {
            self.add(1, *axis, &batch.time_ns, column(table, batch, name));
        }
    }

    fn estimates(&mut self, table: &TableSpec, batch: &Batch) {
        for (axis, name) in AXES.iter().enumerate() {
            self.add(0, axis, &batch.time_ns, column(table, batch, &format!("tm1.displacement.{name}")));
        }
    }
}

fn line(label: &str, colour: usize, stroke: Stroke, points: Vec<(f64, f64)>) -> Line {
    Line { label: label.to_owned(), colour, stroke, points }
}

/// A panel with a linear x axis.
fn panel(title: String, labels: [&str; 2], x: std::ops::Range<f64>, y_scale: Scale, lines: Vec<Line>) -> Panel {
    let [x_label, y_label] = labels.map(str::to_owned);
    Panel { title, x_label, y_label, x_scale: Scale::Linear, y_scale, x, y: None, lines }
}

/// Time from which a series stays within `reach` of its last value, s.
fn settles_at(seconds: &[f64], value: &[f64], reach: f64) -> f64 {
    let last = value.last().copied().unwrap_or(f64::NAN);
    let outside = value.iter().rposition(|x| (x - last).abs() > reach);
    outside.map_or(0.0, |i| seconds[(i + 1).min(seconds.len() - 1)])
}

fn draw_convergence(c: &Convergence, truth: &Truth, out: &Path) -> Result<(), Failure> {
    let seconds: Vec<f64> = c.time_ns.iter().map(|t| (t - truth.start_ns) as f64 * 1e-9).collect();
    let end = seconds.last().copied().unwrap_or(0.0);
    let every = (seconds.len() / POINTS).max(1);
    for (tm, lines) in c.lines.iter().enumerate() {
        let length_m = truth.offset_m[tm].iter().map(|x| x * x).sum::<f64>().sqrt();
        let mut panels = Vec::new();
        let mut errors = Vec::new();
        for (axis, (value, sigma)) in lines.iter().enumerate() {
            let true_m = truth.offset_m[tm][axis];
            let picked = |f: &dyn Fn(usize) -> f64| -> Vec<(f64, f64)> {
                let last = seconds.len() - 1;
                (0..seconds.len()).step_by(every).chain([last]).map(|i| (seconds[i] * 1e-6, f(i))).collect()
            };
            let mm = |f: &dyn Fn(usize) -> f64| picked(&|i| f(i) * 1e3);
            // After the first hours, when σ has come down to where a picture can show it.
            let from = sigma.iter().position(|s| *s < 5.0 * sigma[sigma.len() - 1]).unwrap_or(0);
            let half_height = 1.2e3
                * value[from..].iter().zip(&sigma[from..]).map(|(v, s)| (v - true_m).abs() + s).fold(0.0, f64::max);
            let mut p = panel(
                format!("tm{} {}", tm + 1, AXES[axis]),
                ["time / 1e6 s", "offset / mm"],
                0.0..end * 1.001e-6,
                Scale::Linear,
                vec![
                    line("", 5, Stroke::Solid, mm(&|i| value[i] + sigma[i])),
                    line("estimate ± σ", 5, Stroke::Solid, mm(&|i| value[i] - sigma[i])),
                    line("estimate", 0, Stroke::Solid, mm(&|i| value[i])),
                    line("truth", 1, Stroke::Dashed, mm(&|_| true_m)),
                ],
            );
            p.y = Some(1e3 * true_m - half_height..1e3 * true_m + half_height);
            panels.push(p);
            errors.push(line(
                &format!("|error| {}", AXES[axis]),
                axis,
                Stroke::Solid,
                mm(&|i| (value[i] - true_m).abs()),
            ));
            errors.push(line(&format!("σ {}", AXES[axis]), axis, Stroke::Dashed, mm(&|i| sigma[i])));
            let reach = 0.01 * length_m;
            let below = sigma.iter().position(|s| *s < reach);
            println!(
                "tm{} {}: ends at {:.4} ± {:.4} mm, truth {:.4}; within 1 % of the offset's length of its end from {:.1e} s; σ \
                 {} that",
                tm + 1,
                AXES[axis],
                1e3 * value[value.len() - 1],
                1e3 * sigma[sigma.len() - 1],
                1e3 * true_m,
                settles_at(&seconds, value, reach),
                below.map_or("never below".to_owned(), |i| format!("from {:.1e} s below", seconds[i])),
            );
        }
        let labels = ["time / 1e6 s", "mm"];
        panels.push(panel("error and σ".to_owned(), labels, 0.0..end * 1.001e-6, Scale::Logarithmic, errors));
        std::fs::write(out.join(format!("tm{}_com_convergence.svg", tm + 1)), svg(&panels, 2)?)?;
    }
    Ok(())
}

fn draw_adaptations(tracked: &[Tracking<'_>], truth: &Truth, out: &Path) -> Result<(), Failure> {
    let first = truth.r1_m.len() - SHOWN;
    let colours = [0, 2, 6];
    for (axis, name) in AXES.iter().enumerate() {
        // The slow noise of the readout sets all of them off by nanometres; the error beside it shows that.
        let nm = |values: &[f64]| -> Vec<(f64, f64)> {
            let present = values.iter().filter(|x| x.is_finite());
            let mean = present.clone().sum::<f64>() / present.count() as f64;
            values.iter().enumerate().map(|(i, x)| (i as f64 * 0.1, 1e9 * (x - mean))).collect()
        };
        let hourly = |t: &Tracking<'_>, what: usize| {
            let error = |(h, s): (usize, &[[f64; 2]; 3])| ((h as f64 + 0.5) / 24.0, 1e9 * s[axis][what].sqrt());
            t.square.iter().enumerate().map(error).collect::<Vec<_>>()
        };
        let true_nm: Vec<f64> = truth.r1_m[first..].iter().map(|r| r[axis]).collect();
        let mut over_time = vec![line("readout", 4, Stroke::Solid, nm(&tracked[2].shown[axis][1]))];
        let mut errors = vec![line("readout", 4, Stroke::Solid, hourly(&tracked[2], 1))];
        over_time.push(line("truth", 1, Stroke::Solid, nm(&true_nm)));
        for ((tracking, label), colour) in tracked.iter().zip(ADAPTATIONS).zip(colours) {
            over_time.push(line(label, colour, Stroke::Solid, nm(&tracking.shown[axis][0])));
            let of_it = hourly(tracking, 0);
            let (begin, end) = (of_it[2].1, of_it[of_it.len() - 1].1);
            println!("tm1 {name}, {label}: rms error {begin:.3e} nm in the third hour, {end:.3e} nm in the last");
            errors.push(line(label, colour, Stroke::Solid, of_it));
        }
        let mut shown = panel(
            format!("tm1 {name}, end of day {COMPARED_DAYS}"),
            ["time / s", "displacement less its mean / nm"],
            0.0..SHOWN as f64 * 0.1,
            Scale::Linear,
            over_time,
        );
        let largest = shown.lines[0].points.iter().map(|(_, x)| x.abs()).fold(0.0, f64::max);
        shown.y = Some(-1.5 * largest..1.5 * largest);
        let days = 0.0..COMPARED_DAYS as f64;
        let labels = ["time / days", "rms of an hour / nm"];
        let error = panel(format!("tm1 {name}, error"), labels, days, Scale::Logarithmic, errors);
        let picture = svg(&[shown, error], 2)?;
        std::fs::write(out.join(format!("akf1_vs_akf2_{name}.svg")), picture)?;
    }
    Ok(())
}

fn main() -> Result<(), Failure> {
    let arguments: Vec<PathBuf> = std::env::args().skip(1).map(PathBuf::from).collect();
    let (folder, out, only) = match &arguments[..] {
        [folder, out] => (folder, out, ""),
        [folder, out, only] => (folder, out, only.to_str().unwrap_or("")),
        _ => return Err("figures TELEMETRY_FOLDER PICTURE_FOLDER [adaptations|convergence]".into()),
    };
    std::fs::create_dir_all(out)?;
    let files = telemetry(folder)?;
    let truth = truth(folder)?;
    if only != "convergence" {
        let mut tracked = Vec::new();
        for adaptation in ADAPTATIONS {
            let parameters = format!("adaptation = \"{adaptation}\", check_s = 0.0, output_interval_s = 0.1");
            let mut tracking = Tracking::new(&truth);
            run(&files[..COMPARED_DAYS.min(files.len())], &parameters, &mut tracking)?;
            tracked.push(tracking);
        }
        draw_adaptations(&tracked, &truth, out)?;
    }
    if only != "adaptations" {
        let mut convergence = Convergence::default();
        run(&files, "output_interval_s = 600.0", &mut convergence)?;
        draw_convergence(&convergence, &truth, out)?;
    }
    Ok(())
}
