//! The stage: columns in, filters, columns and a report out.

use dragfree_physics::mission::Mission;
use dragfree_sdk::prelude::*;
use serde_json::json;

use crate::design::{self, Choices, model};
use crate::filter::{Adaptation, Settings};
use crate::model::{Coefficient as Theta, Prior};
use crate::octaves::Octaves;
use crate::tracker::{Average, Factor, Follower, MAX_STATES, Readout, Regressor, Rows, Snapshot, follow};

const AXES: [&str; 3] = ["x", "y", "z"];
/// A column of this name after that of a test mass and a point says that the test mass can be followed.
const KNOWN_ACCELERATION: &str = "u_orf_m_s2";
/// Batches from here on are worth a second thread.
const THREAD_ROWS: usize = 512;

/// The stage `es-akf`.
#[derive(Debug)]
pub struct EsAkf {
    mission: Mission,
    settings: Settings,
    /// `None`: monotone in a filter of one test mass, off in one of several.
    adaptation: Option<Adaptation>,
    /// For a filter of one test mass.
    choices: Choices,
    /// In place of that of `choices` in a filter of several.
    bias_walk_together_m_s2_rts: f64,
    snapshot_s: f64,
    threads: usize,
    /// Whether all test masses are in one filter; `None`: where the model has regressors in the loop.
    together: Option<bool>,
    filters: Vec<LinkedFilter>,
    notes: Vec<String>,
    table: Option<Table>,
    last_ns: Option<i64>,
}

/// A test mass that the columns tell of.
#[derive(Clone, Debug, PartialEq)]
struct TestMass {
    name: String,
    frame: String,
}

/// A filter and its columns; three axes for each test mass.
#[derive(Debug)]
struct LinkedFilter {
    test_masses: Vec<TestMass>,
    follower: Box<dyn Follower>,
    readout_m: Vec<In>,
    u_m_s2: Vec<In>,
    regressors: Vec<Regressor<In>>,
    coefficients: Vec<Coefficient>,
    value: Vec<Out>,
    sigma: Vec<Out>,
    displacement_m: Vec<Out>,
    /// One for each test mass.
    nis: Vec<Out>,
    /// One for each readout.
    innovation: Vec<Out>,
}

/// What a filter reads.
struct Columns {
    readout_m: Vec<In>,
    u_m_s2: Vec<In>,
    regressors: Vec<Regressor<In>>,
    coefficients: Vec<Coefficient>,
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
                &["auto", "each", "together"],
                "a filter for each test mass, or one for all; auto: one for all where the model has regressors made of commands",
            ),
            Parameter::text(
                "adaptation",
                "auto",
                &["auto", "monotone", "innovation", "residual", "off"],
                "how Q and R follow the innovations; monotone is the paper's; auto: monotone for one test mass, off for several",
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
                "bias_walk_together_m_s2_rts",
                "m s-2 s-1/2",
                3e-16,
                0.0..=1e-3,
                "the same where it has several, whose differences thrust does not mask: a faster walk would cost precision",
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

    const STATE_VERSION: u32 = 3;

    fn new(setup: &Setup) -> Result<Self, PluginError> {
        let mission = Mission::from_json(setup.mission_json())?;
        let rate_hz = mission.mission.sample_rate_hz;
        let epochs = |name: &str| -> Result<u64, PluginError> { Ok((setup.f64(name)? * rate_hz).round() as u64) };
        let adaptation = match setup.text("adaptation")?.as_str() {
            "monotone" => Some(Adaptation::Monotone),
            "innovation" => Some(Adaptation::Innovation),
            "residual" => Some(Adaptation::Residual),
            "off" => Some(Adaptation::Off),
            _ => None,
        };
        Ok(Self {
            adaptation,
            settings: Settings {
                adaptation: Adaptation::Off,
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
                bias_walk_m_s2_rts: setup.f64("bias_walk_m_s2_rts")?,
                leak_hz: setup.f64("leak_hz")?,
                unknown_alpha: setup.f64("unknown_alpha")?,
            },
            bias_walk_together_m_s2_rts: setup.f64("bias_walk_together_m_s2_rts")?,
            snapshot_s: setup.f64("output_interval_s")?,
            threads: setup.threads(),
            together: match setup.text("follow")?.as_str() {
                "each" => Some(false),
                "together" => Some(true),
                _ => None,
            },
            mission,
            filters: Vec::new(),
            notes: Vec::new(),
            table: None,
            last_ns: None,
        })
    }

    fn link(&mut self, available: &Available, link: &mut Link<'_>) -> Result<(), PluginError> {
        let table = link.table("es-akf", 0.0);
        let there = test_masses(available);
        if there.is_empty() {
            return Err(PluginError::new(format!(
                "es-akf: no column NAME.{KNOWN_ACCELERATION}.x is made before this stage, so there is no test mass to \
                 follow; put hinf-dfacs before it, or leave es-akf out for an accelerometer mission"
            )));
        }
        // A command depends on the readouts of all test masses; the regression must condition on the same past data as
        // the controller, or a coefficient that multiplies a command is biased.
        let together = match self.together {
            Some(together) => together,
            None => available.has_regressors_in_loop()?,
        };
        let free = available.coefficients.iter().filter(|c| c.estimate && !c.noise.is_empty());
        self.notes.extend(free.map(|c| {
            format!(
                "es-akf: {} is {} here, its value in the model file: a filter estimates no level of noise; the batch \
                 solution does",
                c.name, c.initial
            )
        }));
        let left_out = design::without_their_colour(&self.mission.noise);
        if !left_out.is_empty() {
            self.notes.push(format!(
                "es-akf: {} counts as white here, by its level above its corner, so that the filter's σ may be too small; the \
                 batch solution measures the noise at low frequencies",
                left_out.join(", ")
            ));
        }
        let mut groups: Vec<Vec<TestMass>> = there.iter().map(|test_mass| vec![test_mass.clone()]).collect();
        if together && there.len() > 1 {
            match self.link_filter(&there, table, available, link)? {
                Ok(filter) => {
                    self.filters.push(filter);
                    groups.clear();
                }
                Err(TooMany(states)) => self.notes.push(format!(
                    "es-akf: all test masses in one filter would have {states} states, at most {MAX_STATES} are possible, \
                     so each has its own; coefficients of effects made of commands are biased there, as the commands \
                     depend on the readouts of all test masses: trust qp, or leave effects out of the model"
                )),
            }
        }
        for group in groups {
            let filter = self.link_filter(&group, table, available, link)?.map_err(|TooMany(states)| {
                PluginError::new(format!(
                    "es-akf: {} would have {states} states, at most {MAX_STATES} are possible; leave effects out of \
                     the model, or terms out of the readout noise",
                    group[0].name
                ))
            })?;
            self.filters.push(filter);
        }
        self.table = Some(table);
        Ok(())
    }

    fn process(&mut self, input: &Inputs<'_>, output: &mut Outputs) -> Result<(), PluginError> {
        let Some(table) = self.table else { return Ok(()) };
        let times = input.time_ns();
        let pieces = self.contiguous(times)?;
        let [first, rest @ ..] = self.filters.as_mut_slice() else { return Ok(()) };
        // Filters share nothing, so the result does not depend on the number of threads.
        let snapshots: Vec<Vec<Snapshot>> = if self.threads == 1 || times.len() < THREAD_ROWS {
            std::iter::once(first.run(input, &pieces)).chain(rest.iter_mut().map(|b| b.run(input, &pieces))).collect()
        } else {
            std::thread::scope(|scope| {
                let others: Vec<_> = rest.iter_mut().map(|b| scope.spawn(|| b.run(input, &pieces))).collect();
                let own = first.run(input, &pieces);
                let joined =
                    others.into_iter().map(|t| t.join().map_err(|_| PluginError::fatal("es-akf: a filter panicked")));
                std::iter::once(Ok(own)).chain(joined).collect::<Result<_, _>>()
            })?
        };
        self.last_ns = times.last().copied().or(self.last_ns);
        output.time(table).extend(snapshots[0].iter().map(|s| times[s.row]));
        for (filter, snapshots) in self.filters.iter().zip(&snapshots) {
            for s in snapshots {
                for j in 0..s.value.len() {
                    output.f64(filter.value[j]).push(s.value[j]);
                    output.f64(filter.sigma[j]).push(s.sigma[j]);
                }
                for (column, x) in filter.displacement_m.iter().zip(&s.displacement_m) {
                    output.f64(*column).push(*x);
                }
                for column in &filter.nis {
                    output.f64(*column).push(s.nis);
                }
                for (column, x) in filter.innovation.iter().zip(&s.innovation) {
                    output.f64(*column).push(*x);
                }
            }
        }
        Ok(())
    }

    fn report(&mut self, _earlier: &[Report]) -> Result<Report, PluginError> {
        let mut report = Report { notes: self.notes.clone(), ..Report::default() };
        let (mut nis_sum, mut dof) = (0.0, 0);
        let mut p_end = serde_json::Map::new();
        for filter in &self.filters {
            let (s, stretch) = (filter.follower.summary(), filter.follower.stretch());
            nis_sum += s.nis_sum;
            dof += s.readouts.iter().map(|r| r.used).sum::<u64>();
            for (key, n) in s.counts {
                *report.counts.entry(key.to_owned()).or_default() += n;
            }
            for (c, sigma) in filter.coefficients.iter().zip(&s.recursion_sigma) {
                let name = &filter.test_masses[0].name;
                let key = if p_end.contains_key(&c.name) { format!("{}@{name}", c.name) } else { c.name.clone() };
                p_end.insert(key, json!(sigma));
            }
            let names = filter.names();
            let averaged_s = filter.follower.result().map(|a| a.span_s);
            for (test_mass, readouts) in filter.test_masses.iter().zip(s.readouts.chunks(3)) {
                let innovations: Vec<Option<f64>> = readouts.iter().map(|r| r.design_nis).collect();
                report.quality.insert(
                    test_mass.name.clone(),
                    json!({
                        "followed": names,
                        "states": s.states,
                        "nis": s.nis,
                        "innovation_variance_over_mission_noise": innovations,
                        "innovation_octaves": innovation_octaves(readouts),
                        "sigma_stretch": stretch,
                        "averaged_s": averaged_s,
                    }),
                );
            }
            if stretch > 1.1 {
                report.notes.push(format!(
                    "es-akf: the innovations of {} are up to {:.2} times what the noise of the mission file \
                     predicts; its sigmas were stretched by that. Compare the readout and thrust noise with [noise]",
                    names.join(" and "),
                    stretch
                ));
            }
        }
        report.nis = (dof > 0).then(|| nis_sum / dof as f64);
        report.quality.insert("p_end_sigma".to_owned(), p_end.into());
        self.estimates(&mut report);
        Ok(report)
    }

    fn state(&mut self, state: &mut State<'_>) -> Result<(), PluginError> {
        state.same("mission or model", &self.layout())?;
        state.option(&mut self.last_ns, State::i64)?;
        Ok(self.filters.iter_mut().try_for_each(|filter| filter.follower.state(state))?)
    }
}

impl EsAkf {
    /// The columns and the filter of these test masses.
    fn link_filter(
        &self,
        test_masses: &[TestMass],
        table: Table,
        available: &Available,
        link: &mut Link<'_>,
    ) -> Result<Result<LinkedFilter, TooMany>, PluginError> {
        let responses = available.responses()?;
        let Columns { readout_m, u_m_s2, regressors, coefficients } =
            read_columns(test_masses, &responses, available, link)?;
        let follower = match self.follower(test_masses, &coefficients, available)? {
            Ok(follower) => follower,
            Err(too_many) => return Ok(Err(too_many)),
        };
        let (mut value, mut sigma) = (Vec::new(), Vec::new());
        // A coefficient that two filters estimate is told apart by its test mass.
        let all = self::test_masses(available);
        let label = |c: &Coefficient| match test_masses {
            [one] if acts_on_several(&all, &responses, &c.name) => format!("{}@{}", c.name, one.name),
            _ => c.name.clone(),
        };
        let archive = [("archive", "true")];
        for c in &coefficients {
            value.push(link.write_with(table, &format!("{}.value", label(c)), &c.unit, &c.frame, &archive)?);
            sigma.push(link.write_with(table, &format!("{}.sigma", label(c)), &c.unit, &c.frame, &archive)?);
        }
        let (mut displacement_m, mut nis, mut innovation) = (Vec::new(), Vec::new(), Vec::new());
        for TestMass { name, frame } in test_masses {
            for axis in AXES {
                let column = format!("{name}.displacement.{axis}");
                displacement_m.push(link.write_with(table, &column, "m", frame, &archive)?);
            }
            nis.push(link.write_with(table, &format!("{name}.nis"), "1", "", &archive)?);
            for axis in AXES {
                innovation.push(link.write_with(table, &format!("{name}.innovation.{axis}"), "1", frame, &archive)?);
            }
        }
        let test_masses = test_masses.to_vec();
        Ok(Ok(LinkedFilter {
            test_masses,
            follower,
            readout_m,
            u_m_s2,
            regressors,
            coefficients,
            value,
            sigma,
            displacement_m,
            nis,
            innovation,
        }))
    }

    /// The filter of these test masses before its first epoch.
    fn follower(
        &self,
        test_masses: &[TestMass],
        coefficients: &[Coefficient],
        available: &Available,
    ) -> Result<Result<Box<dyn Follower>, TooMany>, PluginError> {
        let thetas = coefficients.iter().map(prior_of).collect::<Result<Vec<_>, _>>()?;
        let usual = [if self.mission.noise.ifo_x.is_some() { "ifo_x" } else { "is_x" }, "is_y", "is_z"];
        let mut readouts = Vec::new();
        for (TestMass { name, .. }, (axis, usual)) in
            test_masses.iter().flat_map(|test_mass| AXES.iter().zip(usual).map(move |axis| (test_mass, axis)))
        {
            let column = available.find(&format!("{name}.r_orf_m.{axis}"));
            readouts.push(column.map(|c| c.attribute("noise")).filter(|n| !n.is_empty()).unwrap_or(usual));
        }
        let names: Vec<&str> = test_masses.iter().map(|t| t.name.as_str()).collect();
        let several = names.len() > 1;
        let mut choices = self.choices;
        if several {
            choices.bias_walk_m_s2_rts = self.bias_walk_together_m_s2_rts;
        }
        let levels = NoiseLevels::of(&available.coefficients);
        let model = model(&self.mission, &names, &readouts, thetas, &choices, &levels)?;
        // Fewer forces than axes leave Q a null space, the combinations of axes that no thrust moves. Adaptation
        // element by element does not preserve it, so it is off unless it is asked for.
        let usual = if several { Adaptation::Off } else { Adaptation::Monotone };
        let settings = Settings { adaptation: self.adaptation.unwrap_or(usual), ..self.settings };
        let states = model.states();
        Ok(follow(model, settings, self.snapshot_s).ok_or(TooMany(states)))
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

    /// Identifies the filters that a saved state belongs to.
    fn layout(&self) -> String {
        let filters = self.filters.iter().map(|f| {
            let names: Vec<&str> = f.coefficients.iter().map(|c| c.name.as_str()).collect();
            format!("{}: {} states, {}", f.names().join(" and "), f.follower.summary().states, names.join(" "))
        });
        format!("{} Hz; {}", self.mission.mission.sample_rate_hz, filters.collect::<Vec<_>>().join("; "))
    }

    /// Coefficients with value, σ and covariance. One that several filters estimate is taken from the one with the
    /// least σ: filters share the thrusters' noise, so that the σ of a mean would be too small.
    fn estimates(&self, report: &mut Report) {
        let results: Vec<(f64, Option<Average>)> =
            self.filters.iter().map(|f| (f.follower.stretch(), f.follower.result())).collect();
        let sigma = |b: usize, j: usize| -> Option<f64> {
            let (stretch, average) = &results[b];
            let m = self.filters[b].coefficients.len();
            average.as_ref().map(|a| stretch * a.covariance[j * m + j].sqrt())
        };
        let mut chosen: Vec<(usize, usize)> = Vec::new();
        for (b, filter) in self.filters.iter().enumerate() {
            for (j, c) in filter.coefficients.iter().enumerate() {
                let known = chosen.iter().position(|&(b, j)| self.filters[b].coefficients[j].name == c.name);
                match known {
                    None => chosen.push((b, j)),
                    Some(r) if sigma(b, j) < sigma(chosen[r].0, chosen[r].1) => chosen[r] = (b, j),
                    Some(_) => {}
                }
            }
        }
        for &(b, j) in &chosen {
            let c = &self.filters[b].coefficients[j];
            let value = results[b].1.as_ref().map(|a| a.value[j]);
            report.coefficients.push(Estimate {
                name: c.name.clone(),
                solution: "es-akf".to_owned(),
                role: Some(Role::Recursive),
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
            (stretch, Some(a)) if b == d => {
                stretch * stretch * a.covariance[i * self.filters[b].coefficients.len() + j]
            }
            _ => 0.0,
        };
        let matrix = chosen.iter().map(|row| chosen.iter().map(|column| entry(row, column)).collect()).collect();
        let names = chosen.iter().map(|&(b, j)| self.filters[b].coefficients[j].name.clone()).collect();
        report.covariance.insert("es-akf".to_owned(), Covariance { names, matrix });
    }
}

/// Number of states of a filter that is too large.
struct TooMany(usize);

/// The test masses that have a column of known acceleration, in the order of the columns.
fn test_masses(available: &Available) -> Vec<TestMass> {
    let mut all: Vec<TestMass> = Vec::new();
    for column in &available.columns {
        let name = column.name.strip_suffix(".x").and_then(|n| n.strip_suffix(KNOWN_ACCELERATION)?.strip_suffix('.'));
        if let Some(name) = name.filter(|name| all.iter().all(|t| t.name != *name)) {
            all.push(TestMass { name: name.to_owned(), frame: column.frame.clone() });
        }
    }
    all
}

/// What the filter of these test masses reads.
fn read_columns(
    test_masses: &[TestMass],
    responses: &[(&Coefficient, Response)],
    available: &Available,
    link: &mut Link<'_>,
) -> Result<Columns, PluginError> {
    let mut three = |group: &str, unit: &str| -> Result<Vec<In>, PluginError> {
        let wanted = test_masses
            .iter()
            .flat_map(|TestMass { name, frame }| AXES.map(|axis| (frame, format!("{name}.{group}.{axis}"))));
        wanted.map(|(frame, column)| link.read(&Want::new(column).unit(unit).frame(frame))).collect()
    };
    let (readout_m, u_m_s2) = (three("r_orf_m", "m")?, three(KNOWN_ACCELERATION, "m s-2")?);
    let channels: Vec<String> =
        test_masses.iter().flat_map(|t| AXES.map(|axis| format!("{}.accel.{axis}", t.name))).collect();
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

impl LinkedFilter {
    fn names(&self) -> Vec<&str> {
        self.test_masses.iter().map(|t| t.name.as_str()).collect()
    }

    fn run(&mut self, input: &Inputs<'_>, pieces: &[(u64, std::ops::Range<usize>)]) -> Vec<Snapshot> {
        let rows = Rows {
            readout_m: self.readout_m.iter().map(|c| input.f64(*c)).collect(),
            u_m_s2: self.u_m_s2.iter().map(|c| input.f64(*c)).collect(),
            regressors: self.regressors.iter().map(|r| r.map(|c| input.f64(c))).collect(),
        };
        let mut snapshots = Vec::new();
        for (missing, piece) in pieces {
            self.follower.skip(*missing);
            snapshots.extend(self.follower.process(&rows, piece.clone()));
        }
        snapshots
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

/// Of a test mass's readouts the innovations' mean square over what the mission's noise predicts, octave by octave from
/// the highest, and how many there are.
fn innovation_octaves(readouts: &[Readout]) -> serde_json::Map<String, serde_json::Value> {
    let of = |octaves: &Octaves| {
        let (power, count): (Vec<f64>, Vec<u64>) = octaves.powers().unzip();
        json!({"power": power, "count": count})
    };
    AXES.iter().zip(readouts).map(|(axis, readout)| ((*axis).to_owned(), of(&readout.octaves))).collect()
}

/// Whether a coefficient has regressors on more than one test mass.
fn acts_on_several(all: &[TestMass], responses: &[(&Coefficient, Response)], coefficient: &str) -> bool {
    let acted_on = |t: &&TestMass| {
        let prefix = format!("{}.accel.", t.name);
        responses.iter().any(|(c, r)| c.name == coefficient && r.channel.starts_with(&prefix))
    };
    all.iter().filter(acted_on).count() > 1
}

#[cfg(test)]
mod tests {
    use super::*;
    use dragfree_sdk::state;

    fn stage() -> EsAkf {
        let setup = serde_json::json!({
            "parameters": {
                "follow": "auto", "adaptation": "auto", "forgetting": 0.999_999, "warm_up_s": 600.0, "gate_sigma": 6.0,
                "gate_patience": 30, "calibrated_sigma": true, "check_s": 600.0, "output_interval_s": 60.0,
                "displacement_prior_m": 1e-6, "velocity_prior_m_s": 1e-7, "bias_prior_m_s2": 1e-7,
                "bias_walk_m_s2_rts": 3e-15, "bias_walk_together_m_s2_rts": 3e-16, "leak_hz": 1e-6, "unknown_alpha": 1.0,
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
        let saved = state::save("es-akf", 1, |state| stage.state(state)).expect("a state");
        let load = |stage: &mut EsAkf| state::load("es-akf", 1, &saved, |state| stage.state(state));
        load(&mut stage).expect("its own state");
        stage.mission.mission.sample_rate_hz = 1.0;
        let refusal = load(&mut stage).expect_err("another rate");
        assert!(refusal.message().contains("another mission or model"), "{}", refusal.message());
    }
}
