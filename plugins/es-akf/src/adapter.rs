//! The stage: columns in, filters, columns and a report out.

use dragfree_physics::mission::Mission;
use dragfree_sdk::prelude::*;
use serde_json::json;

use crate::akf::{Akf, MAX_STATES};
use crate::design::{Choices, model};
use crate::filter::{Adaptation, Settings};
use crate::model::{Coefficient as Theta, Model, Prior};
use crate::octaves::Octaves;
use crate::state::{Bytes, StateError, Words, seal, unseal};
use crate::tracker::{Average, Factor, Regressor, Rows, Snapshot, Tracker};

const AXES: [&str; 3] = ["x", "y", "z"];
const TEST_MASSES: [&str; 2] = ["tm1", "tm2"];
/// Batches from here on are worth a second thread.
const THREAD_ROWS: usize = 512;

/// The stage `es-akf`.
#[derive(Debug)]
pub struct EsAkf {
    mission: Mission,
    settings: Settings,
    choices: Choices,
    snapshot_s: f64,
    threads: usize,
    /// Whether both test masses are to be in one filter.
    both: bool,
    bodies: Vec<Body>,
    notes: Vec<String>,
    table: Option<Table>,
    last_ns: Option<i64>,
}

/// What one filter follows, a test mass or both, with its columns; three axes for each test mass.
#[derive(Debug)]
struct Body {
    names: Vec<&'static str>,
    tracker: Following,
    readout_m: Vec<In>,
    u_m_s2: Vec<In>,
    regressors: Vec<Regressor<In>>,
    coefficients: Vec<Coefficient>,
    value: Vec<Out>,
    sigma: Vec<Out>,
    displacement_m: Vec<Out>,
    /// One for each test mass.
    nis: Vec<Out>,
}

/// The columns of a body before its filter is made.
struct Columns {
    readout_m: Vec<In>,
    u_m_s2: Vec<In>,
    regressors: Vec<Regressor<In>>,
    coefficients: Vec<Coefficient>,
}

/// A filter of one test mass, or of two.
#[derive(Clone, Debug)]
enum Following {
    One(Box<Tracker<3>>),
    Both(Box<Tracker<6>>),
}

/// The same for a filter of one test mass and of two.
macro_rules! each {
    ($following:expr, $tracker:ident => $body:expr) => {
        match $following {
            Following::One($tracker) => $body,
            Following::Both($tracker) => $body,
        }
    };
}

impl Stage for EsAkf {
    const MANIFEST: Manifest = Manifest {
        id: "es-akf",
        version: env!("CARGO_PKG_VERSION"),
        licence: "MIT OR Apache-2.0",
        description: "Extended-state adaptive Kalman filter: one state per coefficient of the model's effects",
        parameters: &[
            Parameter::text(
                "follow",
                "auto",
                &["auto", "each", "both"],
                "a filter for each test mass, one for both, or one where an effect of the model is made of commands",
            ),
            Parameter::text(
                "adaptation",
                "monotone",
                &["monotone", "innovation", "residual", "off"],
                "how process and readout noise follow the innovations, where a filter has one test mass; monotone is the paper's",
            ),
            Parameter::f64("forgetting", "1", 0.999_999, 0.0..=1.0, "the paper's alpha: weight of the past per epoch"),
            Parameter::f64("warm_up_s", "s", 600.0, 0.0..=1e6, "time before gating, and at first before adapting"),
            Parameter::f64(
                "gate_sigma",
                "1",
                6.0,
                0.0..=1e6,
                "innovations beyond so many sigma are not used; 0 uses all",
            ),
            Parameter::i64("gate_patience", "1", 30, 1..=1_000_000, "rejections in a row after which to begin anew"),
            Parameter::bool(
                "calibrated_sigma",
                true,
                "follow the covariance of the gains in use; false halves the time and gives the recursion's own sigma",
            ),
            Parameter::f64("check_s", "s", 600.0, 0.0..=1e9, "time between tests of definiteness; 0 tests never"),
            Parameter::f64("output_interval_s", "s", 60.0, 1e-3..=1e9, "time between rows for the archive"),
            Parameter::f64("displacement_prior_m", "m", 1e-6, 1e-12..=1.0, "1 sigma of r about the first readout"),
            Parameter::f64("velocity_prior_m_s", "m s-1", 1e-7, 1e-15..=1.0, "1 sigma of v about zero"),
            Parameter::f64("bias_prior_m_s2", "m s-2", 1e-7, 1e-18..=1.0, "1 sigma of the bias acceleration"),
            Parameter::f64(
                "bias_walk_m_s2_rts",
                "m s-2 s-1/2",
                3e-15,
                0.0..=1e-3,
                "random walk of the bias acceleration, where a filter has one test mass",
            ),
            Parameter::f64(
                "bias_walk_both_m_s2_rts",
                "m s-2 s-1/2",
                3e-16,
                0.0..=1e-3,
                "the same where it has both: no thrust hides the bias there, and a walk too large takes the weight from what is slow",
            ),
            Parameter::f64("leak_hz", "Hz", 1e-6, 1e-9..=1.0, "below this, coloured readout noise is white"),
            Parameter::f64(
                "unknown_alpha",
                "1",
                1.0,
                0.0..=100.0,
                "part of the torque noise's variance that the reconstructed angular acceleration does not know",
            ),
        ],
        instances: &[],
        needs: &[],
    };

    fn new(setup: &Setup) -> Result<Self, PluginError> {
        let mission = Mission::from_json(setup.mission_json())?;
        let rate_hz = mission.mission.sample_rate_hz;
        let epochs = |name: &str| -> Result<u64, PluginError> { Ok((setup.f64(name)? * rate_hz).round() as u64) };
        let adaptation = match setup.text("adaptation")?.as_str() {
            "monotone" => Adaptation::Monotone,
            "innovation" => Adaptation::Innovation,
            "residual" => Adaptation::Residual,
            _ => Adaptation::Off,
        };
        Ok(Self {
            settings: Settings {
                adaptation,
                forgetting: setup.f64("forgetting")?,
                warm_up_epochs: epochs("warm_up_s")?,
                gate_sigma: setup.f64("gate_sigma")?,
                gate_patience: u32::try_from(setup.i64("gate_patience")?).unwrap_or(u32::MAX),
                check_epochs: epochs("check_s")?,
                calibrated_sigma: setup.bool("calibrated_sigma")?,
            },
            choices: Choices {
                prior: Prior {
                    displacement_m: setup.f64("displacement_prior_m")?,
                    velocity_m_s: setup.f64("velocity_prior_m_s")?,
                    bias_m_s2: setup.f64("bias_prior_m_s2")?,
                },
                bias_walk_m_s2_rts: [setup.f64("bias_walk_m_s2_rts")?, setup.f64("bias_walk_both_m_s2_rts")?],
                leak_hz: setup.f64("leak_hz")?,
                unknown_alpha: setup.f64("unknown_alpha")?,
            },
            snapshot_s: setup.f64("output_interval_s")?,
            threads: setup.threads(),
            both: match setup.text("follow")?.as_str() {
                "each" => false,
                "both" => true,
                // A command knows what all readouts told it.
                _ => setup.needs("commands"),
            },
            mission,
            bodies: Vec::new(),
            notes: Vec::new(),
            table: None,
            last_ns: None,
        })
    }

    fn link(&mut self, available: &Available, link: &mut Link<'_>) -> Result<(), PluginError> {
        let table = link.table("es-akf", 0.0);
        let there: Vec<&'static str> =
            TEST_MASSES.into_iter().filter(|name| available.find(&format!("{name}.u_orf_m_s2.x")).is_some()).collect();
        if there.is_empty() {
            return Err(PluginError::new(
                "es-akf: no column tm1.u_orf_m_s2.x or tm2.u_orf_m_s2.x is made before this stage, so there is no \
                 test mass to follow; put hinf-dfacs before it, or leave es-akf out for an accelerometer mission",
            ));
        }
        let mut apart: Vec<Vec<&'static str>> = there.iter().map(|name| vec![*name]).collect();
        if self.both && there.len() > 1 {
            match self.link_body(&there, table, available, link)? {
                Ok(body) => {
                    self.bodies.push(body);
                    apart.clear();
                }
                Err(TooMany(states)) => self.notes.push(format!(
                    "es-akf: both test masses in one filter would have {states} states, at most {MAX_STATES} are possible, so each has \
                     its own; their coefficients of effects made of commands are biased, as one does not know what the \
                     other's readouts told the thrusters: trust qp, or leave effects out of the model"
                )),
            }
        }
        for names in apart {
            let body = self.link_body(&names, table, available, link)?.map_err(|TooMany(states)| {
                PluginError::new(format!(
                    "es-akf: {} would have {states} states, at most {MAX_STATES} are possible; leave effects out of \
                     the model, or terms out of the readout noise",
                    names[0]
                ))
            })?;
            self.bodies.push(body);
        }
        self.table = Some(table);
        Ok(())
    }

    fn process(&mut self, input: &Inputs<'_>, output: &mut Outputs) -> Result<(), PluginError> {
        let Some(table) = self.table else { return Ok(()) };
        let times = input.time_ns();
        let pieces = self.contiguous(times)?;
        let [first, rest @ ..] = self.bodies.as_mut_slice() else { return Ok(()) };
        // The test masses share nothing, so the result is the same with one thread or two.
        let snapshots: Vec<Vec<Row>> = if self.threads == 1 || times.len() < THREAD_ROWS {
            std::iter::once(first.run(input, &pieces)).chain(rest.iter_mut().map(|b| b.run(input, &pieces))).collect()
        } else {
            std::thread::scope(|scope| {
                let others: Vec<_> = rest.iter_mut().map(|b| scope.spawn(|| b.run(input, &pieces))).collect();
                let mine = first.run(input, &pieces);
                let joined =
                    others.into_iter().map(|t| t.join().map_err(|_| PluginError::fatal("es-akf: a filter panicked")));
                std::iter::once(Ok(mine)).chain(joined).collect::<Result<_, _>>()
            })?
        };
        self.last_ns = times.last().copied().or(self.last_ns);
        output.time(table).extend(snapshots[0].iter().map(|s| times[s.row]));
        for (body, snapshots) in self.bodies.iter().zip(&snapshots) {
            for s in snapshots {
                for j in 0..s.value.len() {
                    output.f64(body.value[j]).push(s.value[j]);
                    output.f64(body.sigma[j]).push(s.sigma[j]);
                }
                for (column, x) in body.displacement_m.iter().zip(&s.displacement_m) {
                    output.f64(*column).push(*x);
                }
                for column in &body.nis {
                    output.f64(*column).push(s.nis);
                }
            }
        }
        Ok(())
    }

    fn report(&mut self, _earlier: &[Report]) -> Result<Report, PluginError> {
        let mut report = Report { notes: self.notes.clone(), ..Report::default() };
        let (mut nis_sum, mut dof) = (0.0, 0);
        let mut p_end = serde_json::Map::new();
        for body in &self.bodies {
            let s = body.tracker.summary();
            nis_sum += s.nis_sum;
            dof += s.readouts.iter().map(|r| r.used).sum::<u64>();
            for (key, n) in s.counts {
                *report.counts.entry(key.to_owned()).or_default() += n;
            }
            for (c, sigma) in body.coefficients.iter().zip(&s.recursion_sigma) {
                let name = body.names[0];
                let key = if p_end.contains_key(&c.name) { format!("{}@{name}", c.name) } else { c.name.clone() };
                p_end.insert(key, json!(sigma));
            }
            for (name, readouts) in body.names.iter().zip(s.readouts.chunks(3)) {
                let innovations: Vec<Option<f64>> = readouts.iter().map(|r| r.design_nis).collect();
                report.quality.insert(
                    (*name).to_owned(),
                    json!({
                        "followed": body.names,
                        "states": s.states,
                        "nis": s.nis,
                        "innovation_variance_over_mission_noise": innovations,
                        "innovation_octaves": innovation_octaves(readouts),
                        "sigma_stretch": s.stretch,
                        "averaged_s": s.averaged_s,
                    }),
                );
            }
            if s.stretch > 1.1 {
                report.notes.push(format!(
                    "es-akf: the innovations of {} are up to {:.2} times what the noise of the mission file \
                     predicts; its sigmas were stretched by that. Compare the readout and thrust noise with [noise]",
                    body.names.join(" and "),
                    s.stretch
                ));
            }
        }
        report.nis = (dof > 0).then(|| nis_sum / dof as f64);
        report.quality.insert("p_end_sigma".to_owned(), p_end.into());
        self.estimates(&mut report);
        Ok(report)
    }

    fn state(&mut self, state: &mut State<'_>) -> Result<(), PluginError> {
        let mut bytes = if state.is_loading() { Vec::new() } else { self.save()? };
        state.bytes(&mut bytes)?;
        if state.is_loading() { self.load(&bytes) } else { Ok(()) }
    }
}

impl EsAkf {
    fn save(&self) -> Result<Vec<u8>, PluginError> {
        let mut words = Vec::new();
        let mut out = Words::Write(&mut words);
        let (mut begun, mut last) = (self.last_ns.is_some(), self.last_ns.unwrap_or(0).cast_unsigned());
        out.flag(&mut begun)?;
        out.count(&mut last)?;
        for body in &self.bodies {
            body.tracker.save(&mut words);
        }
        Ok(seal(&self.layout(), &words))
    }

    fn load(&mut self, state: &[u8]) -> Result<(), PluginError> {
        let mut words = Words::Read(unseal(&self.layout(), state)?);
        let (mut begun, mut last) = (false, 0);
        words.flag(&mut begun)?;
        words.count(&mut last)?;
        let mut trackers: Vec<Following> = self.bodies.iter().map(|b| b.tracker.clone()).collect();
        for tracker in &mut trackers {
            tracker.load(&mut words)?;
        }
        words.end()?;
        for (body, tracker) in self.bodies.iter_mut().zip(trackers) {
            body.tracker = tracker;
        }
        self.last_ns = begun.then_some(last.cast_signed());
        Ok(())
    }

    /// The columns and the filter of these test masses.
    fn link_body(
        &self,
        names: &[&'static str],
        table: Table,
        available: &Available,
        link: &mut Link<'_>,
    ) -> Result<Result<Body, TooMany>, PluginError> {
        let responses = available.responses()?;
        let Columns { readout_m, u_m_s2, regressors, coefficients } = read_columns(names, &responses, available, link)?;
        let tracker = match self.following(names, &coefficients, available)? {
            Ok(tracker) => tracker,
            Err(too_many) => return Ok(Err(too_many)),
        };
        let (mut value, mut sigma) = (Vec::new(), Vec::new());
        // A coefficient that two filters estimate is told apart by its test mass.
        let several = |c: &Coefficient| names.len() == 1 && acts_on_several(&responses, &c.name);
        let label = |c: &Coefficient| if several(c) { format!("{}@{}", c.name, names[0]) } else { c.name.clone() };
        let archive = [("archive", "true")];
        for c in &coefficients {
            value.push(link.write_with(table, &label(c), &c.unit, &c.frame, &archive)?);
            sigma.push(link.write_with(table, &format!("{}.sigma", label(c)), &c.unit, &c.frame, &archive)?);
        }
        let (mut displacement_m, mut nis) = (Vec::new(), Vec::new());
        for name in names {
            for axis in AXES {
                let column = format!("{name}.displacement.{axis}");
                displacement_m.push(link.write_with(table, &column, "m", frame_of(name), &archive)?);
            }
            nis.push(link.write_with(table, &format!("{name}.nis"), "1", "", &archive)?);
        }
        let names = names.to_vec();
        Ok(Ok(Body { names, tracker, readout_m, u_m_s2, regressors, coefficients, value, sigma, displacement_m, nis }))
    }

    /// The filter of these test masses before its first epoch.
    fn following(
        &self,
        names: &[&'static str],
        coefficients: &[Coefficient],
        available: &Available,
    ) -> Result<Result<Following, TooMany>, PluginError> {
        let thetas = coefficients.iter().map(prior_of).collect::<Result<Vec<_>, _>>()?;
        let usual = [if self.mission.noise.ifo_x.is_some() { "ifo_x" } else { "is_x" }, "is_y", "is_z"];
        let noise = |i: usize| {
            let column = available.find(&format!("{}.r_orf_m.{}", names[i / 3], AXES[i % 3]));
            column.map(|c| c.attribute("noise")).filter(|n| !n.is_empty()).unwrap_or(usual[i % 3])
        };
        Ok(if names.len() > 1 {
            // Six axes shaken by three thrusts have combinations that hardly anything shakes, which is what makes this filter
            // worth its price; an adaptation element by element would drown them.
            let settings = Settings { adaptation: Adaptation::Off, ..self.settings };
            let model = model::<6>(&self.mission, names, std::array::from_fn(noise), thetas, &self.choices)?;
            tracker(model, settings, self.snapshot_s).map(Following::Both)
        } else {
            let model = model::<3>(&self.mission, names, std::array::from_fn(noise), thetas, &self.choices)?;
            tracker(model, self.settings, self.snapshot_s).map(Following::One)
        })
    }

    /// Runs of rows one step apart, each with the number of steps missing before it.
    fn contiguous(&self, times: &[i64]) -> Result<Vec<(u64, std::ops::Range<usize>)>, PluginError> {
        let rate_hz = self.mission.mission.sample_rate_hz;
        let mut pieces: Vec<(u64, std::ops::Range<usize>)> = Vec::new();
        let mut last = self.last_ns;
        for (row, &t) in times.iter().enumerate() {
            let steps = last.map_or(1.0, |last| ((t - last) as f64 * 1e-9 * rate_hz).round());
            if steps < 1.0 {
                return Err(PluginError::error(format!(
                    "es-akf: row {row} at {t} ns is not later than the one before it; the uniform tables must be in \
                     order, see the stage that made them"
                )));
            }
            match pieces.last_mut() {
                Some((_, piece)) if steps < 1.5 => piece.end = row + 1,
                _ => pieces.push((steps as u64 - 1, row..row + 1)),
            }
            last = Some(t);
        }
        Ok(pieces)
    }

    /// What a saved state belongs to.
    fn layout(&self) -> String {
        let bodies = self.bodies.iter().map(|b| {
            let names: Vec<&str> = b.coefficients.iter().map(|c| c.name.as_str()).collect();
            format!("{}: {} states, {}", b.names.join(" and "), b.tracker.summary().states, names.join(" "))
        });
        format!("{} Hz; {}", self.mission.mission.sample_rate_hz, bodies.collect::<Vec<_>>().join("; "))
    }

    /// Coefficients with value, σ and covariance. One that acts on both test masses is taken from the filter that knows
    /// it better: the two share the thrusters' noise, so their mean would promise too much.
    fn estimates(&self, report: &mut Report) {
        let results: Vec<(f64, Option<Average>)> =
            self.bodies.iter().map(|b| (b.tracker.stretch(), b.tracker.result())).collect();
        let sigma = |b: usize, j: usize| -> Option<f64> {
            let (stretch, average) = &results[b];
            let m = self.bodies[b].coefficients.len();
            average.as_ref().map(|a| stretch * a.covariance[j * m + j].sqrt())
        };
        let mut chosen: Vec<(usize, usize)> = Vec::new();
        for (b, body) in self.bodies.iter().enumerate() {
            for (j, c) in body.coefficients.iter().enumerate() {
                let rival = chosen.iter().position(|&(b, j)| self.bodies[b].coefficients[j].name == c.name);
                match rival {
                    None => chosen.push((b, j)),
                    Some(r) if sigma(b, j) < sigma(chosen[r].0, chosen[r].1) => chosen[r] = (b, j),
                    Some(_) => {}
                }
            }
        }
        for &(b, j) in &chosen {
            let c = &self.bodies[b].coefficients[j];
            let value = results[b].1.as_ref().map(|a| a.value[j]);
            report.coefficients.push(Estimate {
                name: c.name.clone(),
                solution: "es-akf".to_owned(),
                value,
                sigma: sigma(b, j),
                unit: c.unit.clone(),
                frame: c.frame.clone(),
            });
            if value.is_some_and(|v| !(c.lower..=c.upper).contains(&v)) {
                report.notes.push(format!(
                    "es-akf: {} = {:.4e} {} is outside its physical range {:.4e} to {:.4e}: too little data, or the \
                     model lacks an effect",
                    c.name,
                    value.unwrap_or(f64::NAN),
                    c.unit,
                    c.lower,
                    c.upper
                ));
            }
        }
        if chosen.is_empty() || results.iter().any(|(_, average)| average.is_none()) {
            return;
        }
        let entry = |&(b, i): &(usize, usize), &(d, j): &(usize, usize)| match &results[b] {
            (stretch, Some(a)) if b == d => stretch * stretch * a.covariance[i * self.bodies[b].coefficients.len() + j],
            _ => 0.0,
        };
        let matrix = chosen.iter().map(|row| chosen.iter().map(|column| entry(row, column)).collect()).collect();
        let names = chosen.iter().map(|&(b, j)| self.bodies[b].coefficients[j].name.clone()).collect();
        report.covariance.insert("es-akf".to_owned(), Covariance { names, matrix });
    }
}

/// So many states that no filter holds them.
struct TooMany(usize);

fn tracker<const D: usize>(model: Model<D>, settings: Settings, snapshot_s: f64) -> Result<Box<Tracker<D>>, TooMany> {
    let states = model.states();
    Akf::new(model, settings).map(|filter| Box::new(Tracker::new(filter, snapshot_s))).ok_or(TooMany(states))
}

/// Frame of a test mass's displacements.
fn frame_of(test_mass: &str) -> &'static str {
    if test_mass == TEST_MASSES[0] { "ORF_1" } else { "ORF_2" }
}

/// What the filter of these test masses reads.
fn read_columns(
    names: &[&'static str],
    responses: &[(&Coefficient, Response)],
    available: &Available,
    link: &mut Link<'_>,
) -> Result<Columns, PluginError> {
    let mut three = |group: &str, unit: &str| -> Result<Vec<In>, PluginError> {
        let wanted = names.iter().flat_map(|name| AXES.map(|axis| (frame_of(name), format!("{name}.{group}.{axis}"))));
        wanted.map(|(frame, column)| link.read(&Want::new(column).unit(unit).frame(frame))).collect()
    };
    let (readout_m, u_m_s2) = (three("r_orf_m", "m")?, three("u_orf_m_s2", "m s-2")?);
    let channels: Vec<String> = names.iter().flat_map(|name| AXES.map(|axis| format!("{name}.accel.{axis}"))).collect();
    let mut coefficients: Vec<Coefficient> = Vec::new();
    let mut regressors = Vec::new();
    for (coefficient, response) in responses {
        let Some(axis) = channels.iter().position(|channel| *channel == response.channel) else {
            continue;
        };
        let column = link.read(&Want::new(&response.series).table(&response.table))?;
        let mut value_of = |c: &Coefficient| {
            if !c.estimate {
                return Factor::Fixed(c.initial);
            }
            let known = coefficients.iter().position(|k| k.name == c.name);
            Factor::Estimated(known.unwrap_or_else(|| {
                coefficients.push(c.clone());
                coefficients.len() - 1
            }))
        };
        let coefficient = value_of(coefficient);
        let times = match &response.times {
            None => Factor::Fixed(1.0),
            Some(other) => value_of(available.coefficient(other).ok_or_else(|| {
                PluginError::error(format!(
                    "es-akf: the effect of {} acts through {other}, which is not in the model; add it",
                    response.channel
                ))
            })?),
        };
        regressors.push(Regressor { coefficient, times, factor: response.factor, axis, column });
    }
    Ok(Columns { readout_m, u_m_s2, regressors, coefficients })
}

/// What a filter has to say at the end, whatever it follows.
struct Summary {
    states: usize,
    counts: [(&'static str, u64); 7],
    nis_sum: f64,
    nis: Option<f64>,
    readouts: Vec<Readout>,
    /// σ of the coefficients as the recursion has it.
    recursion_sigma: Vec<f64>,
    stretch: f64,
    averaged_s: Option<f64>,
}

/// One readout's innovations.
struct Readout {
    used: u64,
    design_nis: Option<f64>,
    octaves: Octaves,
}

/// A row for the archive, whatever is followed.
struct Row {
    row: usize,
    displacement_m: Vec<f64>,
    value: Vec<f64>,
    sigma: Vec<f64>,
    nis: f64,
}

impl<const D: usize> From<Snapshot<D>> for Row {
    fn from(s: Snapshot<D>) -> Self {
        let Snapshot { row, displacement_m, value, sigma, nis } = s;
        Self { row, displacement_m: displacement_m.to_vec(), value, sigma, nis }
    }
}

impl Following {
    fn summary(&self) -> Summary {
        each!(self, t => {
            let (filter, s) = (t.filter(), t.filter().statistics());
            let readouts = s.readouts.iter().zip(s.design_nis()).zip(s.octaves);
            Summary {
                states: filter.model().states(),
                counts: [
                    ("updates", s.updates),
                    ("predictions_only", s.predictions),
                    ("rejected_readouts", s.rejected),
                    ("reacquisitions", s.reacquisitions),
                    ("repairs_of_q", s.repairs_q),
                    ("repairs_of_p", s.repairs_p),
                    ("resets", s.resets),
                ],
                nis_sum: s.nis_sum,
                nis: s.nis(),
                readouts: readouts
                    .map(|((used, design_nis), octaves)| Readout { used: *used, design_nis, octaves })
                    .collect(),
                recursion_sigma: (0..filter.coefficients().len())
                    .map(|j| filter.recursion_covariance(j, j).sqrt())
                    .collect(),
                stretch: t.stretch(),
                averaged_s: t.result().map(|a| a.span_s),
            }
        })
    }

    fn result(&self) -> Option<Average> {
        each!(self, t => t.result())
    }

    fn stretch(&self) -> f64 {
        each!(self, t => t.stretch())
    }

    fn save(&self, out: &mut Bytes) {
        each!(self, t => t.save(out));
    }

    fn load(&mut self, words: &mut Words<'_>) -> Result<(), StateError> {
        each!(self, t => t.load(words))
    }
}

impl Body {
    fn run(&mut self, input: &Inputs<'_>, pieces: &[(u64, std::ops::Range<usize>)]) -> Vec<Row> {
        each!(&mut self.tracker, tracker => {
            let rows = Rows {
                readout_m: std::array::from_fn(|i| input.f64(self.readout_m[i])),
                u_m_s2: std::array::from_fn(|i| input.f64(self.u_m_s2[i])),
                regressors: self.regressors.iter().map(|r| r.map(|c| input.f64(c))).collect(),
            };
            let mut snapshots = Vec::new();
            for (missing, piece) in pieces {
                tracker.skip(*missing);
                snapshots.extend(tracker.process(&rows, piece.clone()).into_iter().map(Row::from));
            }
            snapshots
        })
    }
}

/// Initial value and prior σ; without a prior, half of the physical range.
fn prior_of(c: &Coefficient) -> Result<Theta, PluginError> {
    let half_range = 0.5 * (c.upper - c.lower);
    let prior_sigma = if c.prior_sigma.is_finite() { c.prior_sigma } else { half_range };
    if c.initial.is_finite() && prior_sigma.is_finite() && prior_sigma > 0.0 {
        Ok(Theta { initial: c.initial, prior_sigma })
    } else {
        Err(PluginError::new(format!(
            "es-akf: coefficient {} has initial value {} and prior sigma {}, range {} to {}; a filter needs a finite \
             start: give it a prior_sigma or a finite range in the model file",
            c.name, c.initial, c.prior_sigma, c.lower, c.upper
        )))
    }
}

/// Of a test mass's readouts the innovations' mean square over what the mission's noise predicts, octave by octave from the highest, and
/// how many there are.
fn innovation_octaves(readouts: &[Readout]) -> serde_json::Map<String, serde_json::Value> {
    let of = |octaves: &Octaves| {
        let (power, count): (Vec<f64>, Vec<u64>) = octaves.powers().unzip();
        json!({"power": power, "count": count})
    };
    AXES.iter().zip(readouts).map(|(axis, readout)| ((*axis).to_owned(), of(&readout.octaves))).collect()
}

/// Whether a coefficient has regressors on both test masses.
fn acts_on_several(responses: &[(&Coefficient, Response)], coefficient: &str) -> bool {
    let of_it = |name: &str| {
        responses.iter().any(|(c, r)| c.name == coefficient && r.channel.starts_with(&format!("{name}.accel.")))
    };
    TEST_MASSES.into_iter().all(of_it)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn stage() -> EsAkf {
        let setup = serde_json::json!({
            "parameters": {
                "follow": "auto", "adaptation": "monotone", "forgetting": 0.999_999, "warm_up_s": 600.0, "gate_sigma": 6.0,
                "gate_patience": 30, "calibrated_sigma": true, "check_s": 600.0, "output_interval_s": 60.0,
                "displacement_prior_m": 1e-6, "velocity_prior_m_s": 1e-7, "bias_prior_m_s2": 1e-7,
                "bias_walk_m_s2_rts": 3e-15, "bias_walk_both_m_s2_rts": 3e-16, "leak_hz": 1e-6, "unknown_alpha": 1.0,
            },
            "mission": {
                "mission": { "name": "M", "spacecraft": "S", "sample_rate_hz": 10.0 },
                "spacecraft": { "mass_kg": 1.0, "inertia_srf_kg_m2": [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]] },
            },
        });
        EsAkf::new(&Setup::for_tests(&setup.to_string()).expect("a setup")).expect("a stage")
    }

    const STEP_NS: i64 = 100_000_000;

    #[test]
    fn rows_are_split_where_steps_are_missing_within_a_batch_and_between_two() {
        let mut stage = stage();
        let first = stage.contiguous(&[0, STEP_NS, 5 * STEP_NS]).expect("in order");
        assert_eq!(first, [(0, 0..2), (3, 2..3)]);
        stage.last_ns = Some(5 * STEP_NS);
        // A clock that is 10 µs off is on time.
        assert_eq!(stage.contiguous(&[6 * STEP_NS + 10_000, 7 * STEP_NS]).expect("in order"), [(0, 0..2)]);
        assert_eq!(stage.contiguous(&[8 * STEP_NS]).expect("in order"), [(2, 0..1)]);
    }

    #[test]
    fn time_that_goes_back_is_an_error() {
        let mut stage = stage();
        stage.last_ns = Some(STEP_NS);
        assert!(stage.contiguous(&[STEP_NS]).expect_err("the same epoch again").message().contains("not later"));
    }

    #[test]
    fn a_coefficient_without_a_finite_start_is_refused_by_name() {
        let endless = Coefficient { name: "formula.k".to_owned(), ..Coefficient::default() };
        assert!(prior_of(&endless).expect_err("no prior").message().contains("formula.k"));
        let ranged = Coefficient { lower: -1.0, upper: 3.0, ..Coefficient::default() };
        assert_eq!(prior_of(&ranged).expect("half of the range"), Theta { initial: 0.0, prior_sigma: 2.0 });
    }

    #[test]
    fn a_state_of_something_else_is_refused() {
        let mut stage = stage();
        let saved = stage.save().expect("a state");
        assert!(stage.load(&saved).is_ok());
        assert!(stage.load(b"garbage").is_err());
        assert!(stage.load(&saved[..saved.len() - 1]).is_err());
        stage.mission.mission.sample_rate_hz = 1.0;
        assert!(stage.load(&saved).expect_err("another rate").message().contains("start anew"));
    }
}
