//! The pieces of work: inputs as files for the peers, and what this project makes of them.

use std::path::{Path, PathBuf};
use std::rc::Rc;

use dragfree_engine::replay::Replay;
use dragfree_engine::table::Batch;
use dragfree_es_akf::filter::{Adaptation, Drive, Filter, Settings};
use dragfree_es_akf::model::{Coefficient, Model, Prior};
use dragfree_es_akf::shaping::Chain;
use dragfree_estimation::spectra::{Analyser, Layout, Plan, Sums as CrossSpectra};
use dragfree_identification::distributions::ln_chi2_above;
use dragfree_identification::innovations::decision::{Candidate, Evidence, Quadratic};
use dragfree_identification::innovations::filter::Sums;
use dragfree_physics::control_design::design;
use dragfree_physics::hinf::Synthesis;
use dragfree_physics::mission::Mission;
use dragfree_physics::noise::NoiseTerm;
use nalgebra::{DMatrix, DVector};
use rand::SeedableRng as _;
use rand_distr::{Distribution as _, StandardNormal};
use rand_xoshiro::Xoshiro256PlusPlus;
use serde_json::{Map, Value, json};

use crate::campaign::{ScratchFolder, parse, taiji};
use crate::error::{CampaignError, file};
use crate::program::Program;

/// Work that can be repeated, with a result to compare.
pub(super) struct Work {
    pub(super) name: String,
    pub(super) run: Box<dyn FnMut() -> Vec<f64>>,
}

impl Work {
    fn new(name: &str, run: impl FnMut() -> Vec<f64> + 'static) -> Self {
        Self { name: name.to_owned(), run: Box::new(run) }
    }
}

/// One comparison.
pub(super) struct Task {
    /// As `peers.py` knows it.
    pub(super) name: &'static str,
    /// In the report.
    pub(super) words: &'static str,
    /// Folder with the inputs.
    pub(super) folder: PathBuf,
    /// What this project does.
    pub(super) own: Vec<Work>,
    /// Peers that are no Python packages.
    pub(super) peers: Vec<Work>,
    /// By how much each number of the result may differ.
    pub(super) allowed: Vec<f64>,
}

impl Task {
    /// Largest difference of a peer's result, as far as it goes, in units of what is allowed.
    pub(super) fn difference(&self, own: &[f64], peer: &[f64]) -> Option<f64> {
        let apart = own.iter().zip(peer).zip(&self.allowed).map(|((a, b), allowed)| (a - b).abs() / allowed);
        // What is no number is infinitely far.
        apart.map(|d| if d.is_nan() { f64::INFINITY } else { d }).reduce(f64::max)
    }
}

/// Inputs of a task, as files.
struct Inputs {
    folder: PathBuf,
    numbers: Map<String, Value>,
}

impl Inputs {
    fn new(folder: &ScratchFolder, name: &str) -> Result<Self, CampaignError> {
        let folder = folder.path(name);
        std::fs::create_dir_all(&folder).map_err(|e| file(&folder, &e))?;
        Ok(Self { folder, numbers: Map::new() })
    }

    fn number(&mut self, name: &str, value: impl Into<Value>) {
        self.numbers.insert(name.to_owned(), value.into());
    }

    fn array(&self, name: &str, values: impl IntoIterator<Item = f64>) -> Result<(), CampaignError> {
        let path = self.folder.join(format!("{name}.f64"));
        let bytes: Vec<u8> = values.into_iter().flat_map(f64::to_le_bytes).collect();
        std::fs::write(&path, bytes).map_err(|e| file(&path, &e))
    }

    /// Row by row.
    fn matrix(&self, name: &str, m: &DMatrix<f64>) -> Result<(), CampaignError> {
        self.array(name, m.transpose().iter().copied())
    }

    /// The folder, with the numbers.
    fn finish(self) -> Result<PathBuf, CampaignError> {
        let path = self.folder.join("numbers.json");
        std::fs::write(&path, Value::Object(self.numbers).to_string()).map_err(|e| file(&path, &e))?;
        Ok(self.folder)
    }
}

/// All of them.
pub(super) fn tasks(program: &Program, folder: &ScratchFolder) -> Result<Vec<Task>, CampaignError> {
    Ok(vec![filter(folder)?, synthesis(folder)?, decoding(program, folder)?, spectra(folder)?, selection(folder)?])
}

/// Standard normal deviates.
fn normal(seed: u64) -> impl FnMut() -> f64 {
    let mut random = Xoshiro256PlusPlus::seed_from_u64(seed);
    move || StandardNormal.sample(&mut random)
}

const DT_S: f64 = 0.1;
const STEPS: usize = 20_000;
const FORGETTING: f64 = 0.999_999;

/// The model of `plugins/es-akf/benches/step.rs`: 22 states.
fn filter_model() -> Model {
    let exponents: [&[u32]; 3] = [&[4, 2, 2], &[4, 2], &[4, 2]];
    let asd = [1.42e-12, 1.8e-9, 1.8e-9];
    let chain = |asd, exponent| Chain::new(&NoiseTerm { asd, corner_hz: 1e-3, exponent }, 1e-4, DT_S);
    Model {
        dt_s: DT_S,
        acceleration_m2_s4: DMatrix::identity(3, 3) * (1e-7_f64 / 1500.0).powi(2) * 0.5 / DT_S,
        torque_noise: Vec::new(),
        bias_step_m2_s4: 1e-30,
        readout_m2: asd.map(|a: f64| a * a * 0.5 / DT_S).to_vec(),
        chains: (0..3).map(|i| exponents[i].iter().map(|&p| chain(asd[i], p)).collect()).collect(),
        coefficients: vec![Coefficient { initial: 0.0, prior_sigma: 0.1 }; 3],
        prior: Prior { displacement_m: 1e-7, velocity_m_s: 1e-8, bias_m_s2: 1e-9 },
    }
}

/// Transition without regressors, and observation.
fn matrices(model: &Model) -> (DMatrix<f64>, DMatrix<f64>) {
    let n = model.states();
    let (mut a, mut h) = (DMatrix::identity(n, n), DMatrix::zeros(3, n));
    for (axis, first, chain) in model.placed_chains() {
        h[(axis, first)] = 1.0;
        for i in 0..chain.states() {
            (i..chain.states()).for_each(|j| a[(first + i, first + j)] = chain.transition[j - i]);
        }
    }
    for i in 0..3 {
        h[(i, i)] = 1.0;
        a[(i, 3 + i)] = DT_S;
        a[(3 + i, 6 + i)] = DT_S;
        a[(i, 6 + i)] = 0.5 * DT_S * DT_S;
    }
    (a, h)
}

/// What acts until a readout, and the readout.
#[derive(Clone, Copy)]
struct Epoch {
    drive_m_s2: [f64; 3],
    regressors: [[f64; 3]; 3],
    readout_m: [f64; 3],
}

impl Epoch {
    fn drive(&self) -> Drive<'_> {
        Drive { acceleration_m_s2: self.drive_m_s2, regressors: &self.regressors }
    }
}

/// A simulated test mass whose offset is (5, −3, 2) mm.
fn epochs(model: &Model) -> Vec<Epoch> {
    let mut normal = normal(1);
    let (mut r_m, mut v_m_s) = ([0.0; 3], [0.0; 3]);
    let offset_m = [5e-3, -3e-3, 2e-3];
    let make = |_| {
        let alpha_rad_s2: [f64; 3] = std::array::from_fn(|_| 1e-9 * normal());
        // −α × e_j.
        let regressors = std::array::from_fn(|j| {
            let mut column = [0.0; 3];
            column[(j + 1) % 3] = -alpha_rad_s2[(j + 2) % 3];
            column[(j + 2) % 3] = alpha_rad_s2[(j + 1) % 3];
            column
        });
        let drive_m_s2 = std::array::from_fn(|_| 1e-10 * normal());
        for i in 0..3 {
            let lever: f64 = (0..3).map(|j| regressors[j][i] * offset_m[j]).sum();
            let a_m_s2 = drive_m_s2[i] + lever + model.acceleration_m2_s4[(i, i)].sqrt() * normal();
            r_m[i] += DT_S * v_m_s[i] + 0.5 * DT_S * DT_S * a_m_s2;
            v_m_s[i] += DT_S * a_m_s2;
        }
        let readout_m = std::array::from_fn(|i| r_m[i] + model.readout_m2[i].sqrt() * normal());
        Epoch { drive_m_s2, regressors, readout_m }
    };
    (0..STEPS).map(make).collect()
}

/// A filter that has seen the first of `epochs` that many.
fn filtered(adaptation: Adaptation, epochs: &[Epoch], seen: usize) -> Filter<24> {
    let settings = Settings {
        adaptation,
        forgetting: FORGETTING,
        warm_up_epochs: 0,
        gate_sigma: 0.0,
        gate_patience: u32::MAX,
        calibrated_sigma: false,
        // The peers test nothing either.
        check_epochs: 0,
    };
    let mut filter = Filter::<24>::new(filter_model(), settings);
    // The track begins.
    filter.step([0.0; 3], epochs[0].drive());
    for (epoch, next) in epochs.iter().zip(epochs.iter().skip(1).chain(epochs.last())).take(seen) {
        filter.step(epoch.readout_m, next.drive());
    }
    filter
}

fn filter(folder: &ScratchFolder) -> Result<Task, CampaignError> {
    let model = filter_model();
    let (epochs, n) = (Rc::new(epochs(&model)), model.states());
    let mut inputs = Inputs::new(folder, "filter")?;
    let (a, h) = matrices(&model);
    let mut q = DMatrix::zeros(n, n);
    model.process_noise(|i, j, value| q[(i, j)] = value);
    let begun = filtered(Adaptation::Off, &epochs, 0);
    let p = DMatrix::from_fn(n, n, |i, j| begun.covariance(i, j));
    for (name, matrix) in [("a", &a), ("h", &h), ("q", &q), ("p", &p)] {
        inputs.matrix(name, matrix)?;
    }
    inputs.array("x", begun.state()[..n].iter().copied())?;
    inputs.array("drive", epochs.iter().flat_map(|e| e.drive_m_s2))?;
    inputs.array("regressors", epochs.iter().flat_map(|e| e.regressors.into_iter().flatten()))?;
    inputs.array("readouts", epochs.iter().flat_map(|e| e.readout_m))?;
    for (name, value) in [("states", n), ("readouts", 3), ("steps", STEPS), ("theta", model.theta())] {
        inputs.number(name, value);
    }
    inputs.number("dt_s", DT_S);
    inputs.number("forgetting", FORGETTING);
    inputs.number("readout_m2", model.readout_m2.clone());
    let last = filtered(Adaptation::Off, &epochs, STEPS);
    let work = |name, adaptation| {
        let epochs = Rc::clone(&epochs);
        Work::new(name, move || filtered(adaptation, &epochs, STEPS).state()[..n].to_vec())
    };
    Ok(Task {
        name: "filter",
        words: "20,000 steps of a filter with 22 states",
        folder: inputs.finish()?,
        own: vec![work("adaptive", Adaptation::Monotone), work("plain", Adaptation::Off)],
        peers: Vec::new(),
        allowed: (0..n).map(|i| 1e-4 * last.covariance(i, i).sqrt()).collect(),
    })
}

/// Relative tolerance of the smallest γ.
const GAMMA_TOLERANCE: f64 = 1e-4;

fn synthesis(folder: &ScratchFolder) -> Result<Task, CampaignError> {
    let mission = json!(parse(&taiji())?).to_string();
    let mission = Mission::from_json(&mission).map_err(|e| file(&taiji(), &e))?;
    let channels = design(&mission).map_err(|e| file(&taiji(), &e))?.channels;
    let mut inputs = Inputs::new(folder, "synthesis")?;
    let mut plants = Vec::new();
    for (i, channel) in channels.iter().enumerate() {
        let system = &channel.plant.system;
        for (name, matrix) in [("a", &system.a), ("b", &system.b), ("c", &system.c), ("d", &system.d)] {
            inputs.matrix(&format!("plant-{i}-{name}"), matrix)?;
        }
        plants.push(json!({
            "states": system.order(),
            "outputs": system.d.nrows(),
            "inputs": system.d.ncols(),
            "measurements": channel.plant.measurements,
            "controls": channel.plant.controls,
            "gamma": channel.gamma,
            // Where a bisection begins that does not know the answer.
            "gamma_begin": 16.0 * channel.gamma,
        }));
    }
    inputs.number("plants", plants);
    inputs.number("relative_tolerance", GAMMA_TOLERANCE);
    let allowed = channels.iter().map(|c| 2.0 * GAMMA_TOLERANCE * c.gamma).collect();
    let plants: Vec<_> = channels.into_iter().map(|c| c.plant).collect();
    let controllers = move || {
        let gamma = |plant| {
            let synthesis = Synthesis::new(plant).ok()?;
            let gamma = synthesis.optimum(GAMMA_TOLERANCE).ok()?.gamma;
            synthesis.controller(gamma).ok().map(|_| gamma)
        };
        plants.iter().map(|plant| gamma(plant).unwrap_or(f64::NAN)).collect()
    };
    Ok(Task {
        name: "synthesis",
        words: "H∞ controllers of the mission's channels",
        folder: inputs.finish()?,
        own: vec![Work::new("γ-iteration", controllers)],
        peers: Vec::new(),
        allowed,
    })
}

const TOPIC: &str = "/ifo";
const FIELD: &str = "tm1.x_orf_m";

fn decoding(program: &Program, folder: &ScratchFolder) -> Result<Task, CampaignError> {
    let mut inputs = Inputs::new(folder, "decoding")?;
    let simulated = program.simulate(&taiji(), &folder.path("telemetry"), &["--hours", "1"])?;
    let path = simulated.files[0].clone();
    inputs.number("path", path.to_string_lossy().into_owned());
    inputs.number("topic", TOPIC);
    inputs.number("field", FIELD);
    let bytes = std::fs::read(&path).map_err(|e| file(&path, &e))?;
    let found = move || {
        let messages = mcap::MessageStream::new(&bytes);
        vec![messages.map_or(f64::NAN, |all| all.filter(Result::is_ok).count() as f64)]
    };
    Ok(Task {
        name: "decoding",
        words: "an hour of telemetry from MCAP to columns",
        folder: inputs.finish()?,
        own: vec![Work::new("replay", move || decoded(&path).unwrap_or_default())],
        peers: vec![Work::new("mcap (Rust), messages found but not decoded", found)],
        allowed: vec![0.5, 1e-15],
    })
}

/// Number of messages, and the sum of one column.
fn decoded(path: &Path) -> Option<Vec<f64>> {
    let mut replay = Replay::open(&[path.to_owned()], None, 1).ok()?;
    let at = replay.tables().iter().position(|t| format!("/{}", t.name) == TOPIC)?;
    let column = replay.tables()[at].columns.iter().position(|c| c.name == FIELD)?;
    let (mut count, mut sum) = (0, 0.0);
    while let Some(chunk) = replay.next().ok()? {
        count += chunk.batches.iter().map(Batch::rows).sum::<usize>();
        sum += chunk.batches[at].columns[column].iter().sum::<f64>();
    }
    Some(vec![count as f64, sum])
}

const COLUMNS: usize = 9;
const LENGTH: usize = 16_384;
/// Six hours.
const SAMPLES: usize = 216_000;
const RATE_HZ: f64 = 10.0;

fn spectra(folder: &ScratchFolder) -> Result<Task, CampaignError> {
    let mut normal = normal(2);
    let mut walk = 0.0;
    let mut sample = || {
        walk += 0.01 * normal();
        walk + normal()
    };
    let columns: Vec<Vec<f64>> = (0..COLUMNS).map(|_| (0..SAMPLES).map(|_| sample()).collect()).collect();
    let plan = Plan::new(LENGTH, RATE_HZ);
    let mut inputs = Inputs::new(folder, "spectra")?;
    inputs.array("columns", columns.iter().flatten().copied())?;
    for (name, value) in [("columns", COLUMNS), ("samples", SAMPLES), ("length", LENGTH)] {
        inputs.number(name, value);
    }
    inputs.number("rate_hz", RATE_HZ);
    inputs.number("bands", plan.bands.iter().map(|b| json!([b.first, b.end])).collect::<Vec<_>>());
    let layout = Layout {
        channels: (0..COLUMNS).map(|i| i.to_string()).collect(),
        series: Vec::new(),
        regressors: Vec::new(),
        coefficients: Vec::new(),
    };
    let cross_spectra = move || {
        let mut sums = CrossSpectra::new(&plan, &layout);
        let mut analyser = Analyser::new(plan.clone(), &layout);
        let starts: Vec<usize> = (0..=SAMPLES - LENGTH).step_by(LENGTH / 2).collect();
        for start in &starts {
            let segment: Vec<&[f64]> = columns.iter().map(|c| &c[*start..start + LENGTH]).collect();
            analyser.add(0, (*start as f64 * 1e9 / RATE_HZ) as i64, &segment, *start > 0, &mut sums);
        }
        sums.total.packed.iter().map(|x| x / starts.len() as f64).collect::<Vec<f64>>()
    };
    // Of each pair by the powers of both.
    let pairs: Vec<[usize; 2]> = (0..COLUMNS).flat_map(|i| (0..=i).map(move |j| [i, j])).collect();
    let power = |band: &[f64], i: usize| band[i * (i + 3) / 2];
    let of_band = |band: &[f64]| {
        pairs.iter().map(|p| p.map(|i| power(band, i))).map(|[a, b]| 1e-9 * (a * b).sqrt()).collect::<Vec<f64>>()
    };
    let allowed = cross_spectra().chunks_exact(pairs.len()).flat_map(of_band).collect();
    Ok(Task {
        name: "spectra",
        words: "cross-spectra of nine columns, six hours",
        folder: inputs.finish()?,
        own: vec![Work::new("segments", cross_spectra)],
        peers: Vec::new(),
        allowed,
    })
}

const REGRESSORS: usize = 100;
const ROWS: usize = 20_000;
/// What is in the data: 14, 11 and 8σ.
const TRUE: [(usize, f64); 3] = [(7, 0.1), (42, -0.08), (77, 0.06)];

fn selection(folder: &ScratchFolder) -> Result<Task, CampaignError> {
    let mut normal = normal(3);
    let x = DMatrix::from_fn(ROWS, REGRESSORS, |_, _| normal());
    let y = DVector::from_fn(ROWS, |row, _| TRUE.iter().map(|(j, b)| b * x[(row, *j)]).sum::<f64>() + normal());
    let mut inputs = Inputs::new(folder, "selection")?;
    inputs.array("x", x.iter().copied())?;
    inputs.array("y", y.iter().copied())?;
    for (name, value) in [("samples", ROWS), ("columns", REGRESSORS), ("most", 10)] {
        inputs.number(name, value);
    }
    // Half of the smallest true one, and what Schwarz's criterion asks of one more.
    inputs.number("threshold", 0.03);
    inputs.number("kappa", (ROWS as f64).ln() / ROWS as f64);
    let select = move || {
        let sums = Sums {
            information: x.tr_mul(&x),
            score: x.tr_mul(&y).as_slice().to_vec(),
            chi2: y.norm_squared(),
            numbers: ROWS as f64,
            samples: ROWS as u64,
            ..Sums::zeros(0, 0)
        };
        let candidates = (0..REGRESSORS).map(Candidate::free).collect();
        let quadratic = Quadratic::new(&sums, &[0.0; REGRESSORS], &[], candidates);
        let trials = (REGRESSORS as f64).ln();
        let log10_p = |_: usize, gain: f64| (ln_chi2_above(gain, 1.0) + trials) / std::f64::consts::LN_10;
        let evidence = Evidence { log10_p: &log10_p, bound: -2.0, most: 10, remainder: 0.0, range: f64::INFINITY };
        quadratic.select(&evidence).values.as_slice().to_vec()
    };
    Ok(Task {
        name: "selection",
        words: "three of 100 regressors found in 20,000 rows",
        folder: inputs.finish()?,
        own: vec![Work::new("normal equations and exchange", select)],
        peers: Vec::new(),
        allowed: vec![1e-9; REGRESSORS],
    })
}
