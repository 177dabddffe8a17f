//! Source `sim`: a day in the closed loop of a drag-free spacecraft, as telemetry and, apart from it, the truth.
//!
//! The true physics is computed from states and shares no code with the effects that a calibration fits.

pub mod effects;
pub mod hidden;
pub mod housekeeping;
pub mod interior;
pub mod orbit;
pub mod plant;
mod random;
pub mod sensors;
pub mod simulator;
#[cfg(test)]
mod testing;
pub mod thrusters;

use dragfree_physics::manoeuvre::Manoeuvre;
use dragfree_physics::mission::{ANGLES, AXES, Mission, TestMass};
use dragfree_sdk::prelude::*;
use nalgebra::Vector3;
use rand::SeedableRng;
use rand_xoshiro::Xoshiro256PlusPlus;
use serde::{Deserialize, Serialize};

use effects::EffectRequest;
use hidden::Hidden;
use housekeeping::{Channel, Housekeeping};
use simulator::{Epoch, Settings, SimulationError, Simulator};

/// 2035-01-01T00:00:00, where the paper's simulation starts, Unix ns.
const DEFAULT_START_NS: i64 = 2_051_222_400_000_000_000;

/// A table with its columns and the rows of the current batch, stored row by row.
struct Topic {
    table: Table,
    columns: Vec<Out>,
    times_ns: Vec<i64>,
    rows: Vec<f64>,
}

impl Topic {
    fn new(link: &mut Link<'_>, name: &str, groups: &[Group]) -> Result<Self, PluginError> {
        let table = link.table(name, 0.0);
        let mut columns = Vec::new();
        for (path, parts, unit, frame) in groups {
            if parts.is_empty() {
                columns.push(link.write(table, path, unit, frame)?);
            }
            for part in *parts {
                columns.push(link.write(table, &format!("{path}.{part}"), unit, frame)?);
            }
        }
        Ok(Self::of(table, columns))
    }

    fn of(table: Table, columns: Vec<Out>) -> Self {
        Self { table, columns, times_ns: Vec::new(), rows: Vec::new() }
    }

    /// Begins a row; one value for each column follows.
    fn row(&mut self, time_ns: i64) -> &mut Vec<f64> {
        debug_assert_eq!(self.rows.len(), self.times_ns.len() * self.columns.len());
        self.times_ns.push(time_ns);
        &mut self.rows
    }

    /// Passes the rows to the host.
    fn give(&mut self, output: &mut Outputs) {
        output.time(self.table).append(&mut self.times_ns);
        let width = self.columns.len();
        for (i, column) in self.columns.iter().enumerate() {
            output.f64(*column).extend(self.rows.chunks_exact(width).map(|row| row[i]));
        }
        self.rows.clear();
    }
}

struct Topics {
    is: Topic,
    /// `None` where no test mass has an interferometer.
    ifo: Option<Topic>,
    dws: Topic,
    command: Option<Topic>,
    ephemeris: Topic,
    housekeeping: Vec<Topic>,
    at_limit: Topic,
    truth: Topic,
}

/// Status of a valid sample.
const VALID: f64 = 0.0;
/// Status of a capacitive readout at the end of its range, bit 0.
const SATURATED: f64 = 1.0;
const XYZ: &[&str] = &AXES;
const PHI_THETA_PSI: &[&str] = &ANGLES;

/// A group of columns: field path, names below it, unit, frame.
type Group = (String, &'static [&'static str], &'static str, String);

fn group(path: impl Into<String>, parts: &'static [&'static str], unit: &'static str, frame: &str) -> Group {
    (path.into(), parts, unit, frame.to_owned())
}

impl Topics {
    fn new(
        link: &mut Link<'_>,
        mission: &Mission,
        housekeeping: &[Channel],
        command: bool,
    ) -> Result<Self, PluginError> {
        // Groups of each test mass one after the other, then those of the spacecraft.
        let each = |groups: &dyn Fn(&str, &TestMass, &str) -> Vec<Group>| -> Vec<Group> {
            let of = |(name, tm): (&String, &TestMass)| groups(name, tm, &mission.frame(name));
            mission.test_mass.iter().flat_map(of).collect()
        };
        let is = Topic::new(
            link,
            "is",
            &each(&|name, _, frame| {
                vec![
                    group(format!("{name}.r_orf_m"), XYZ, "m", frame),
                    group(format!("{name}.att_orf_rad"), PHI_THETA_PSI, "rad", frame),
                    group(format!("{name}.status"), &[], "", ""),
                ]
            }),
        )?;
        let of_ifo = each(&|name, tm, frame| {
            let axes = (0..3).filter(|axis| tm.has_interferometer(*axis));
            let mut groups: Vec<_> =
                axes.map(|axis| group(format!("{name}.{}_orf_m", AXES[axis]), &[], "m", frame)).collect();
            if !groups.is_empty() {
                groups.push(group(format!("{name}.status"), &[], "", ""));
            }
            groups
        });
        let ifo = if of_ifo.is_empty() { None } else { Some(Topic::new(link, "ifo", &of_ifo)?) };
        let mut of_dws = each(&|name, tm, frame| {
            let angles = ANGLES.into_iter().skip(1).filter(|_| tm.has_interferometer(0));
            angles.map(|angle| group(format!("{name}.{angle}_orf_rad"), &[], "rad", frame)).collect()
        });
        of_dws.extend([group("sc_crf_rad", PHI_THETA_PSI, "rad", "CRF"), group("status", &[], "", "")]);
        let dws = Topic::new(link, "dws", &of_dws)?;
        let mut of_command =
            vec![group("mps_force_srf_n", XYZ, "N", "SRF"), group("mps_torque_srf_nm", XYZ, "N m", "SRF")];
        of_command.extend(each(&|name, _, frame| {
            vec![
                group(format!("{name}.force_orf_n"), XYZ, "N", frame),
                group(format!("{name}.torque_orf_nm"), XYZ, "N m", frame),
            ]
        }));
        let command = command.then(|| Topic::new(link, "command", &of_command)).transpose()?;
        let ephemeris = Topic::new(
            link,
            "ephemeris",
            &[
                group("r_sc_irf_m", XYZ, "m", "IRF"),
                group("v_sc_irf_m_s", XYZ, "m s-1", "IRF"),
                group("omega_crf_rad_s", XYZ, "rad s-1", "CRF"),
                group("alpha_crf_rad_s2", XYZ, "rad s-2", "CRF"),
                group("sun_srf", XYZ, "1", "SRF"),
            ],
        )?;
        let mut scalar = |name: &str, unit: &str, place: &str, rate_hz: f64| -> Result<Topic, PluginError> {
            let table = link.table(format!("hk/{name}"), 0.0);
            let rate = rate_hz.to_string();
            let attributes = [("place", place), ("rate_hz", rate.as_str())];
            Ok(Topic::of(table, vec![link.write_with(table, "value", unit, "", &attributes)?]))
        };
        let housekeeping =
            housekeeping.iter().map(|c| scalar(&c.name, c.unit, &c.place, c.rate_hz)).collect::<Result<_, _>>()?;
        let at_limit = scalar("actuators_at_limit", "1", "control computer", 1.0)?;
        // The interface control document numbers the test masses of the truth.
        let numbered = |letter: &str| -> Vec<Group> {
            let of =
                |(i, name): (usize, &String)| group(format!("{letter}{}_orf_m", i + 1), XYZ, "m", &mission.frame(name));
            mission.test_mass.keys().enumerate().map(of).collect()
        };
        let mut of_truth = numbered("r");
        of_truth.extend([
            group("sc_crf_rad", PHI_THETA_PSI, "rad", "CRF"),
            group("omega_srf_rad_s", XYZ, "rad s-1", "SRF"),
            group("alpha_srf_rad_s2", XYZ, "rad s-2", "SRF"),
        ]);
        of_truth.extend(numbered("b"));
        of_truth.push(group("nongrav_accel_srf_m_s2", XYZ, "m s-2", "SRF"));
        let truth = Topic::new(link, "truth", &of_truth)?;
        Ok(Self { is, ifo, dws, command, ephemeris, housekeeping, at_limit, truth })
    }

    fn push(&mut self, e: &Epoch) {
        let (t, m) = (e.time_ns, &e.measured);
        let (is, dws) = (self.is.row(t), self.dws.row(t));
        for tm in &m.tm {
            is.extend(tm.is_r_orf_m.iter().chain(&tm.is_att_orf_rad));
            is.push(if tm.is_saturated { SATURATED } else { VALID });
            dws.extend(tm.dws_orf_rad.iter().filter(|x| !x.is_nan()));
        }
        dws.extend(&m.dws_sc_crf_rad);
        dws.push(VALID);
        if let Some(topic) = &mut self.ifo {
            let row = topic.row(t);
            for tm in &m.tm {
                let before = row.len();
                row.extend(tm.ifo_orf_m.iter().filter(|x| !x.is_nan()));
                if row.len() > before {
                    row.push(VALID);
                }
            }
        }
        if let Some(topic) = &mut self.command {
            topic.row(t).extend(e.command.numbers());
        }
        if let Some(p) = &e.ephemeris {
            let vectors = [&p.r_sc_irf_m, &p.v_sc_irf_m_s, &p.omega_crf_rad_s, &p.alpha_crf_rad_s2, &p.sun_srf];
            self.ephemeris.row(t).extend(vectors.into_iter().flatten());
        }
        let truth = &e.truth;
        let turning = [&truth.sc_crf_rad, &truth.omega_srf_rad_s, &truth.alpha_srf_rad_s2];
        let vectors = truth.r_orf_m.iter().chain(turning).chain(&truth.offset_orf_m).chain([&truth.nongrav_srf_m_s2]);
        self.truth.row(t).extend(vectors.flatten());
    }

    fn give(&mut self, output: &mut Outputs) {
        let Self { is, ifo, dws, command, ephemeris, housekeeping, at_limit, truth } = self;
        let slow =
            housekeeping.iter_mut().chain([is]).chain(ifo).chain([dws, ephemeris, at_limit, truth]).chain(command);
        slow.for_each(|topic| topic.give(output));
    }
}

/// The source.
pub struct Sim {
    mission: Mission,
    simulator: Simulator,
    housekeeping: Housekeeping,
    telemeter_command: bool,
    /// Samples in a second.
    every_second: i64,
    end_ns: i64,
    /// Hidden effects, for the host to seal.
    sealed: Option<String>,
    topics: Option<Topics>,
    identity: [(&'static str, String); 3],
    counts: Counts,
}

/// Numbers of epochs, for the report.
#[derive(Clone, Default, Serialize, Deserialize)]
struct Counts {
    all: u64,
    /// With a command at its limit or beyond the thrusters.
    at_limit: u64,
    /// Of those, the ones not yet in a packet of `/hk/actuators_at_limit`.
    untold: u64,
    /// With a capacitive readout at the end of its range.
    saturated: u64,
}

impl Counts {
    fn add(&mut self, epoch: &Epoch) {
        self.all += 1;
        self.at_limit += u64::from(epoch.at_limit);
        self.untold += u64::from(epoch.at_limit);
        self.saturated += u64::from(epoch.measured.tm.iter().any(|tm| tm.is_saturated));
    }
}

#[derive(Serialize, Deserialize)]
struct Saved {
    simulator: Vec<u8>,
    housekeeping: (Xoshiro256PlusPlus, Vec<f64>),
    counts: Counts,
}

fn refuse(error: SimulationError) -> PluginError {
    match error {
        // The loop does not recover.
        SimulationError::Diverged { .. } => PluginError::fatal(error.to_string()),
        other => PluginError::from(other),
    }
}

impl Source for Sim {
    const MANIFEST: Manifest = Manifest {
        id: "sim",
        version: env!("CARGO_PKG_VERSION"),
        licence: "MIT OR Apache-2.0",
        description: "Simulates the closed loop of a drag-free spacecraft and its test masses",
        parameters: &[
            Parameter::i64("seed", "", 1, 0..=i64::MAX, "seed of everything random"),
            Parameter::f64_list(
                "com_offset_srf_m",
                "m",
                &[0.001, 0.0, 0.0],
                "both housings against the drawings, seen from the centre of mass, SRF",
            ),
            Parameter::bool("command", true, "telemeter /command"),
            Parameter::f64("stiffness_error", "1", 0.2, 0.0..=0.9, "largest relative error of the mission's stiffness"),
            Parameter::f64("settle_s", "s", 600.0, 0.0..=86_400.0, "how long the loop runs before the first sample"),
            Parameter::i64("hidden", "", -1, -1..=i64::MAX, "seed of the effects to hide; -1 hides none"),
            Parameter::text_list(
                "effects",
                &[],
                "ID:INSTANCE=SIZE[,NAME=VALUE]..., as mps-gain:sc.y=0.02; what is not there is answered with the list",
            ),
            Parameter::text_list(
                "manoeuvres",
                &[],
                "INPUT=AMPLITUDE,frequency_hz=F,from_s=A,until_s=B: a sine commanded beside the control law, N or N m",
            ),
        ],
        instances: &[],
        needs: &[],
    };

    fn new(setup: &Setup) -> Result<Self, PluginError> {
        let mission = Mission::from_json(setup.mission_json())?;
        let rate_hz = mission.mission.sample_rate_hz;
        if rate_hz.fract() != 0.0 {
            return Err(PluginError::new(format!(
                "mission.sample_rate_hz = {rate_hz}: the simulator computes what is inside the spacecraft every second, so it \
                 needs a whole number of samples in a second"
            )));
        }
        let end_ns = setup.end_ns().ok_or_else(|| {
            PluginError::new("the simulator has no end; give the run a time window, as --hours 6 does")
        })?;
        let start_ns = setup.start_ns().unwrap_or(DEFAULT_START_NS);
        let offset: [f64; 3] = setup.f64_list("com_offset_srf_m")?.try_into().map_err(|given: Vec<f64>| {
            PluginError::new(format!(
                "parameter com_offset_srf_m = {given:?} must have three components, x, y, z of SRF"
            ))
        })?;
        let asked = setup.text_list("effects")?;
        let names: Vec<String> = mission.test_mass.keys().cloned().collect();
        let mut effects = asked.iter().map(|text| EffectRequest::parse(text, &names)).collect::<Result<Vec<_>, _>>()?;
        let flown = setup.text_list("manoeuvres")?;
        let manoeuvres = flown.iter().map(|text| Manoeuvre::parse(text, &mission)).collect::<Result<_, _>>();
        let manoeuvres = manoeuvres.map_err(|e| refuse(e.into()))?;
        let days = (end_ns - start_ns) as f64 / 86_400e9;
        let hidden = u64::try_from(setup.i64("hidden")?).ok().map(|seed| Hidden::draw(seed, days, &mission));
        // With every parameter: who scores a diagnosis does not know what stands for one that was left out.
        let given: Vec<String> = effects.iter().map(ToString::to_string).collect();
        effects.extend(hidden.iter().flat_map(|h| &h.drawn).map(|d| d.request.clone()));
        let seed = setup.i64("seed")?.cast_unsigned();
        let settings = Settings {
            seed,
            start_ns,
            settle_s: setup.f64("settle_s")?,
            com_offset_srf_m: Vector3::from(offset),
            stiffness_error: setup.f64("stiffness_error")?,
            effects,
            manoeuvres,
        };
        let simulator = Simulator::new(&mission, settings).map_err(refuse)?;
        let sealed = hidden.map(|hidden| {
            let offset_m: serde_json::Map<_, _> = names
                .iter()
                .zip(simulator.offset_orf_m())
                .flat_map(|(name, offset)| AXES.iter().zip(offset).map(move |(axis, value)| (name, axis, *value)))
                .map(|(name, axis, value)| (format!("com-offset.{name}.{axis}"), value.into()))
                .collect();
            let masses_kg: Vec<f64> = mission.test_mass.values().map(|tm| tm.mass_kg).collect();
            let about = serde_json::json!({
                "test_mass_kg": masses_kg, "test_masses": names,
                "mission": mission.mission.name, "spacecraft": mission.mission.spacecraft, "noise_seed": seed,
                "start_ns": start_ns, "end_ns": end_ns, "given": given, "offset_m": offset_m,
            });
            hidden.content(&about).to_string()
        });
        simulator.constellation().check("the end of the simulation,", end_ns).map_err(|e| refuse(e.into()))?;
        // The third stream of the seed; the loop uses the first two.
        let mut rng = Xoshiro256PlusPlus::seed_from_u64(seed);
        rng.long_jump();
        Ok(Self {
            housekeeping: Housekeeping::new(&names, mission.dt_s(), rng),
            simulator,
            telemeter_command: setup.bool("command")?,
            every_second: mission.mission.sample_rate_hz.round().max(1.0) as i64,
            end_ns,
            sealed,
            topics: None,
            identity: [
                ("time_scale", "UTC".to_owned()),
                ("mission", mission.mission.name.clone()),
                ("spacecraft", mission.mission.spacecraft.clone()),
            ],
            mission,
            counts: Counts::default(),
        })
    }

    fn link(&mut self, link: &mut Link<'_>) -> Result<(), PluginError> {
        self.topics = Some(Topics::new(link, &self.mission, self.housekeeping.channels(), self.telemeter_command)?);
        Ok(())
    }

    fn next(&mut self, rows: usize, output: &mut Outputs) -> Result<Progress, PluginError> {
        let Some(topics) = &mut self.topics else { return Err(PluginError::error("next before link")) };
        for _ in 0..rows {
            if self.simulator.time_ns() >= self.end_ns {
                break;
            }
            let (index, time_ns) = (self.simulator.index(), self.simulator.time_ns());
            self.housekeeping.read(index, self.simulator.inside(), |i, value| {
                topics.housekeeping[i].row(time_ns).push(value);
            });
            let epoch = self.simulator.step().map_err(refuse)?;
            topics.push(&epoch);
            self.counts.add(&epoch);
            if index.rem_euclid(self.every_second) == 0 {
                topics.at_limit.row(time_ns).push(std::mem::take(&mut self.counts.untold) as f64);
            }
        }
        topics.give(output);
        let next_ns = self.simulator.time_ns();
        Ok(Progress { complete_until_ns: next_ns, done: next_ns >= self.end_ns })
    }

    fn report(&mut self) -> Result<Report, PluginError> {
        let quality = self.identity.iter().map(|(k, v)| ((*k).to_owned(), v.clone().into())).collect();
        let Counts { all, at_limit, saturated, .. } = self.counts;
        let counts =
            [("epochs", all), ("epochs_at_actuator_limit", at_limit), ("epochs_with_saturated_readout", saturated)];
        let counts = counts.map(|(name, count)| (name.to_owned(), count));
        let sealed = self.sealed.iter().map(|text| Attachment { suffix: "sealed.json".to_owned(), text: text.clone() });
        Ok(Report { counts: counts.into(), quality, attachments: sealed.collect(), ..Report::default() })
    }

    fn state(&mut self, state: &mut State<'_>) -> Result<(), PluginError> {
        let mut saved = Saved {
            simulator: self.simulator.save().map_err(refuse)?,
            housekeeping: self.housekeeping.state(),
            counts: self.counts.clone(),
        };
        state.document(&mut saved)?;
        if state.is_loading() {
            self.simulator.load(&saved.simulator).map_err(refuse)?;
            if !self.housekeeping.set_state(saved.housekeeping) {
                return Err(PluginError::error("state of the simulator: its housekeeping is another version's"));
            }
            self.counts = saved.counts;
        }
        Ok(())
    }
}

export_plugin!(sources: [Sim]);
