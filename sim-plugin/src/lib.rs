//! Source `sim`: a day in the closed loop of a drag-free spacecraft, as telemetry and, apart from it, the truth.
//!
//! Truth-side physics stands here and is written from states; it shares no code with the effects that a calibration
//! fits.

pub mod effects;
pub mod hidden;
pub mod housekeeping;
pub mod interior;
pub mod orbit;
pub mod plant;
pub mod sensors;
pub mod simulator;
#[cfg(test)]
mod testing;
pub mod thrusters;

use dragfree_physics::mission::Mission;
use dragfree_sdk::prelude::*;
use nalgebra::Vector3;
use rand::SeedableRng;
use rand_xoshiro::Xoshiro256PlusPlus;
use serde::{Deserialize, Serialize};

use effects::Asked;
use hidden::Hidden;
use housekeeping::{CHANNELS, Housekeeping};
use simulator::{Epoch, Settings, SimulationError, Simulator};

/// 2035-01-01T00:00:00, where the paper's simulation starts, Unix ns.
const DEFAULT_START_NS: i64 = 2_051_222_400_000_000_000;

/// A table, its columns in the order of a row's values, and the rows of the batch at hand: a row is one copy, and a column is
/// taken out of all of them at once.
struct Topic {
    table: Table,
    columns: Vec<Out>,
    times_ns: Vec<i64>,
    rows: Vec<f64>,
}

impl Topic {
    /// Columns are given as groups: field path, names below it, unit, frame.
    fn new(link: &mut Link<'_>, name: &str, groups: &[(&str, &[&str], &str, &str)]) -> Result<Self, PluginError> {
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

    /// Takes a row: one value for each column.
    fn push<const N: usize>(&mut self, time_ns: i64, values: [f64; N]) {
        debug_assert_eq!(N, self.columns.len());
        self.times_ns.push(time_ns);
        self.rows.extend_from_slice(&values);
    }

    /// Hands the rows to the host.
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
    ifo: Topic,
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
const XYZ: &[&str] = &["x", "y", "z"];
const ANGLES: &[&str] = &["phi", "theta", "psi"];

impl Topics {
    fn new(link: &mut Link<'_>, command: bool) -> Result<Self, PluginError> {
        let is = Topic::new(
            link,
            "is",
            &[
                ("tm1.r_orf_m", XYZ, "m", "ORF_1"),
                ("tm1.att_orf_rad", ANGLES, "rad", "ORF_1"),
                ("tm1.status", &[], "", ""),
                ("tm2.r_orf_m", XYZ, "m", "ORF_2"),
                ("tm2.att_orf_rad", ANGLES, "rad", "ORF_2"),
                ("tm2.status", &[], "", ""),
            ],
        )?;
        let ifo = Topic::new(
            link,
            "ifo",
            &[
                ("tm1.x_orf_m", &[], "m", "ORF_1"),
                ("tm1.status", &[], "", ""),
                ("tm2.x_orf_m", &[], "m", "ORF_2"),
                ("tm2.status", &[], "", ""),
            ],
        )?;
        let dws = Topic::new(
            link,
            "dws",
            &[
                ("tm1.theta_orf_rad", &[], "rad", "ORF_1"),
                ("tm1.psi_orf_rad", &[], "rad", "ORF_1"),
                ("tm2.theta_orf_rad", &[], "rad", "ORF_2"),
                ("tm2.psi_orf_rad", &[], "rad", "ORF_2"),
                ("sc_crf_rad", ANGLES, "rad", "CRF"),
                ("status", &[], "", ""),
            ],
        )?;
        let command = command
            .then(|| {
                Topic::new(
                    link,
                    "command",
                    &[
                        ("mps_force_srf_n", XYZ, "N", "SRF"),
                        ("mps_torque_srf_nm", XYZ, "N m", "SRF"),
                        ("tm1.force_orf_n", XYZ, "N", "ORF_1"),
                        ("tm1.torque_orf_nm", XYZ, "N m", "ORF_1"),
                        ("tm2.force_orf_n", XYZ, "N", "ORF_2"),
                        ("tm2.torque_orf_nm", XYZ, "N m", "ORF_2"),
                    ],
                )
            })
            .transpose()?;
        let ephemeris = Topic::new(
            link,
            "ephemeris",
            &[
                ("r_sc_irf_m", XYZ, "m", "IRF"),
                ("v_sc_irf_m_s", XYZ, "m s-1", "IRF"),
                ("omega_crf_rad_s", XYZ, "rad s-1", "CRF"),
                ("alpha_crf_rad_s2", XYZ, "rad s-2", "CRF"),
                ("sun_srf", XYZ, "1", "SRF"),
            ],
        )?;
        let mut scalar = |name: &str, unit: &str, place: &str, rate_hz: f64| -> Result<Topic, PluginError> {
            let table = link.table(format!("hk/{name}"), 0.0);
            let rate = rate_hz.to_string();
            let attributes = [("place", place), ("rate_hz", rate.as_str())];
            Ok(Topic::of(table, vec![link.write_with(table, "value", unit, "", &attributes)?]))
        };
        let housekeeping =
            CHANNELS.iter().map(|c| scalar(c.name, c.unit, c.place, c.rate_hz)).collect::<Result<_, _>>()?;
        let at_limit = scalar("actuators_at_limit", "1", "control computer", 1.0)?;
        let truth = Topic::new(
            link,
            "truth",
            &[
                ("r1_orf_m", XYZ, "m", "ORF_1"),
                ("r2_orf_m", XYZ, "m", "ORF_2"),
                ("sc_crf_rad", ANGLES, "rad", "CRF"),
                ("omega_srf_rad_s", XYZ, "rad s-1", "SRF"),
                ("alpha_srf_rad_s2", XYZ, "rad s-2", "SRF"),
                ("b1_orf_m", XYZ, "m", "ORF_1"),
                ("b2_orf_m", XYZ, "m", "ORF_2"),
                ("nongrav_accel_srf_m_s2", XYZ, "m s-2", "SRF"),
            ],
        )?;
        Ok(Self { is, ifo, dws, command, ephemeris, housekeeping, at_limit, truth })
    }

    fn push(&mut self, e: &Epoch) {
        let (t, m, c) = (e.time_ns, &e.measured, &e.command);
        let [a, b] = &m.is_r_orf_m;
        let [p, q] = &m.is_att_orf_rad;
        let [s1, s2] = m.is_saturated.map(|saturated| if saturated { SATURATED } else { VALID });
        self.is.push(t, [a.x, a.y, a.z, p.x, p.y, p.z, s1, b.x, b.y, b.z, q.x, q.y, q.z, s2]);
        let [x1, x2] = m.ifo_x_orf_m;
        self.ifo.push(t, [x1, VALID, x2, VALID]);
        let ([[t1, p1], [t2, p2]], sc) = (m.dws_orf_rad, &m.dws_sc_crf_rad);
        self.dws.push(t, [t1, p1, t2, p2, sc.x, sc.y, sc.z, VALID]);
        if let Some(topic) = &mut self.command {
            let [a, b] = &c.tm;
            topic.push::<18>(
                t,
                flat([
                    &c.mps_force_srf_n,
                    &c.mps_torque_srf_nm,
                    &a.force_orf_n,
                    &a.torque_orf_nm,
                    &b.force_orf_n,
                    &b.torque_orf_nm,
                ]),
            );
        }
        if let Some(p) = &e.ephemeris {
            let vectors = [&p.r_sc_irf_m, &p.v_sc_irf_m_s, &p.omega_crf_rad_s, &p.alpha_crf_rad_s2, &p.sun_srf];
            self.ephemeris.push::<15>(t, flat(vectors));
        }
        let truth = &e.truth;
        let vectors = [
            &truth.r_orf_m[0],
            &truth.r_orf_m[1],
            &truth.sc_crf_rad,
            &truth.omega_srf_rad_s,
            &truth.alpha_srf_rad_s2,
            &truth.offset_orf_m[0],
            &truth.offset_orf_m[1],
            &truth.nongrav_srf_m_s2,
        ];
        self.truth.push::<24>(t, flat(vectors));
    }

    fn give(&mut self, output: &mut Outputs) {
        let Self { is, ifo, dws, command, ephemeris, housekeeping, at_limit, truth } = self;
        let slow = housekeeping.iter_mut().chain([is, ifo, dws, ephemeris, at_limit, truth]).chain(command);
        slow.for_each(|topic| topic.give(output));
    }
}

/// Vectors one after the other.
fn flat<const VECTORS: usize, const NUMBERS: usize>(vectors: [&Vector3<f64>; VECTORS]) -> [f64; NUMBERS] {
    const { assert!(NUMBERS == 3 * VECTORS) };
    std::array::from_fn(|i| vectors[i / 3][i % 3])
}

/// The source.
pub struct Sim {
    simulator: Simulator,
    housekeeping: Housekeeping,
    telemeter_command: bool,
    /// Samples in a second.
    every_second: i64,
    end_ns: i64,
    /// What is hidden, for the host to seal.
    sealed: Option<String>,
    topics: Option<Topics>,
    identity: [(&'static str, String); 3],
    counts: Counts,
}

/// What the report counts, epochs.
#[derive(Clone, Default, Serialize, Deserialize)]
struct Counts {
    all: u64,
    /// With a command at its limit or beyond the thrusters.
    at_limit: u64,
    /// Of those, how many no packet of `/hk/actuators_at_limit` has told yet.
    untold: u64,
    /// With a capacitive readout at the end of its range.
    saturated: u64,
}

impl Counts {
    fn add(&mut self, epoch: &Epoch) {
        self.all += 1;
        self.at_limit += u64::from(epoch.at_limit);
        self.untold += u64::from(epoch.at_limit);
        self.saturated += u64::from(epoch.measured.is_saturated.contains(&true));
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
        // A lost loop stays lost.
        SimulationError::Diverged { .. } => PluginError::fatal(error.to_string()),
        other => PluginError::from(other),
    }
}

impl Source for Sim {
    const MANIFEST: Manifest = Manifest {
        id: "sim",
        version: env!("CARGO_PKG_VERSION"),
        licence: "MIT OR Apache-2.0",
        description: "Simulates the closed loop of a drag-free spacecraft with two test masses",
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
                "ID:INSTANCE=SIZE[,NAME=VALUE]..., as es-gain:tm1.y=0.02; what is not there is answered with the list",
            ),
        ],
        instances: &[],
        needs: &[],
    };

    fn new(setup: &Setup) -> Result<Self, PluginError> {
        let mission = Mission::from_json(setup.mission_json())?;
        let end_ns = setup.end_ns().ok_or_else(|| {
            PluginError::new("the simulator has no end; give the run a time window, as --hours 6 does")
        })?;
        let start_ns = setup.start_ns().unwrap_or(DEFAULT_START_NS);
        let offset: [f64; 3] = setup.f64_list("com_offset_srf_m")?.try_into().map_err(|given: Vec<f64>| {
            PluginError::new(format!(
                "parameter com_offset_srf_m = {given:?} must have three components, x, y, z of SRF"
            ))
        })?;
        let given = setup.text_list("effects")?;
        let mut effects = given.iter().map(|text| Asked::parse(text)).collect::<Result<Vec<_>, _>>()?;
        let days = (end_ns - start_ns) as f64 / 86_400e9;
        let hidden = u64::try_from(setup.i64("hidden")?).ok().map(|seed| Hidden::draw(seed, days));
        effects.extend(hidden.iter().flat_map(|h| &h.drawn).map(|d| d.asked.clone()));
        let seed = setup.i64("seed")?.cast_unsigned();
        let settings = Settings {
            seed,
            start_ns,
            settle_s: setup.f64("settle_s")?,
            com_offset_srf_m: Vector3::from(offset),
            stiffness_error: setup.f64("stiffness_error")?,
            effects,
        };
        let simulator = Simulator::new(&mission, settings).map_err(refuse)?;
        let sealed = hidden.map(|hidden| {
            let offset_m: serde_json::Map<_, _> = (0..2)
                .flat_map(|i| (0..3).map(move |j| (i, j)))
                .map(|(i, j)| {
                    let name = format!("com-offset.tm{}.{}", i + 1, ["x", "y", "z"][j]);
                    (name, simulator.offset_orf_m()[i][j].into())
                })
                .collect();
            let mass_kg = |name: &str| mission.test_mass.get(name).map(|tm| tm.mass_kg);
            let about = serde_json::json!({
                "test_mass_kg": [mass_kg("tm1"), mass_kg("tm2")],
                "mission": mission.mission.name, "spacecraft": mission.mission.spacecraft, "noise_seed": seed,
                "start_ns": start_ns, "end_ns": end_ns, "given": given, "offset_m": offset_m,
            });
            hidden.content(&about).to_string()
        });
        simulator.constellation().check("the end of the simulation,", end_ns).map_err(|e| refuse(e.into()))?;
        // The third stream of the seed; the loop takes the first two.
        let mut rng = Xoshiro256PlusPlus::seed_from_u64(seed);
        rng.long_jump();
        Ok(Self {
            housekeeping: Housekeeping::new(mission.dt_s(), rng),
            simulator,
            telemeter_command: setup.bool("command")?,
            every_second: mission.mission.sample_rate_hz.round().max(1.0) as i64,
            end_ns,
            sealed,
            topics: None,
            identity: [
                ("time_scale", "UTC".to_owned()),
                ("mission", mission.mission.name),
                ("spacecraft", mission.mission.spacecraft),
            ],
            counts: Counts::default(),
        })
    }

    fn link(&mut self, link: &mut Link<'_>) -> Result<(), PluginError> {
        self.topics = Some(Topics::new(link, self.telemeter_command)?);
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
                topics.housekeeping[i].push(time_ns, [value]);
            });
            let epoch = self.simulator.step().map_err(refuse)?;
            topics.push(&epoch);
            self.counts.add(&epoch);
            if index.rem_euclid(self.every_second) == 0 {
                topics.at_limit.push(time_ns, [std::mem::take(&mut self.counts.untold) as f64]);
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
