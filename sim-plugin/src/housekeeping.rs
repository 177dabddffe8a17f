//! Housekeeping scalars: what sensors tell about the inside of the spacecraft, and channels that mean nothing.

use dragfree_physics::noise::{NoiseShape, NoiseTerm};
use dragfree_physics::process::NoiseProcess;
use rand::RngExt;
use rand_xoshiro::Xoshiro256PlusPlus;
use std::f64::consts::TAU;

use crate::interior::{FIELD_T, GRADIENT_T_M, Interior};

/// One scalar: where it is measured, what it is, how often.
pub struct Channel {
    /// Name behind `hk/`.
    pub name: &'static str,
    /// Unit.
    pub unit: &'static str,
    /// Place on the spacecraft.
    pub place: &'static str,
    /// Rate, Hz.
    pub rate_hz: f64,
    /// White noise of the sensor, unit/√Hz.
    noise: f64,
    /// Step of the converter, unit.
    pub step: f64,
    source: Source,
}

/// Where a value comes from.
enum Source {
    /// A state.
    State(fn(&Interior) -> f64),
    /// Nothing that matters: a level, a cycle by amplitude and period (s), and a drift by its ASD at 10 µHz.
    Decoy { level: f64, cycle: (f64, f64), drift: f64 },
}

type Read = fn(&Interior) -> f64;

const fn state(
    (name, unit, place): (&'static str, &'static str, &'static str),
    rate_hz: f64,
    noise: f64,
    step: f64,
    read: Read,
) -> Channel {
    Channel { name, unit, place, rate_hz, noise, step, source: Source::State(read) }
}

const fn decoy(
    (name, unit, place): (&'static str, &'static str, &'static str),
    (noise, step): (f64, f64),
    level: f64,
    cycle: (f64, f64),
    drift: f64,
) -> Channel {
    Channel { name, unit, place, rate_hz: 0.1, noise, step, source: Source::Decoy { level, cycle, drift } }
}

/// A thermometer of 10 µK/√Hz (LISA Pathfinder, 1905.09060).
const fn fine_k(name: &'static str, place: &'static str, read: Read) -> Channel {
    state((name, "K", place), 0.1, 1e-5, 1e-6, read)
}

/// An ordinary thermometer.
const fn coarse_k(name: &'static str, place: &'static str, read: Read) -> Channel {
    state((name, "K", place), 0.1, 5e-3, 1e-3, read)
}

/// Current of a valve: 40 mA and 3 mA for each µN.
const fn valve_a(name: &'static str, place: &'static str, read: Read) -> Channel {
    state((name, "A", place), 0.1, 2e-4, 5e-5, read)
}

/// A magnetometer of 1.5 nT steps.
const fn field_t(name: &'static str, place: &'static str, read: Read) -> Channel {
    state((name, "T", place), 0.1, 2e-9, 1.5e-9, read)
}

fn face(i: &Interior, tm: usize, axis: usize, side: f64) -> f64 {
    i.housing_k[tm] + 0.5 * side * i.across_k[tm][axis]
}

/// Field at a magnetometer beside a test mass, SRF as mounted: the field from outside and that of the units, which is as
/// strong there but turned.
fn field(i: &Interior, tm: usize, axis: usize) -> f64 {
    i.interplanetary_t[axis] + i.units_field[tm] * FIELD_T[tm][(axis + 1) % 3]
}

fn gradient(i: &Interior, tm: usize) -> f64 {
    i.units_field[tm] * GRADIENT_T_M[tm][0]
}

fn valve(i: &Interior, thruster: usize) -> f64 {
    0.04 + 3e3 * i.thrust_n[thruster]
}

/// What is downlinked.
pub const CHANNELS: [Channel; 63] = [
    coarse_k("panel_temperature_k", "solar panel", |i| i.panel_k),
    fine_k("structure_temperature_k", "structure", |i| i.structure_k),
    fine_k("bench1_temperature_k", "optical bench 1", |i| i.bench_k[0]),
    fine_k("bench2_temperature_k", "optical bench 2", |i| i.bench_k[1]),
    fine_k("eh1_xp_temperature_k", "electrode housing 1, face +x", |i| face(i, 0, 0, 1.0)),
    fine_k("eh1_xm_temperature_k", "electrode housing 1, face -x", |i| face(i, 0, 0, -1.0)),
    fine_k("eh1_yp_temperature_k", "electrode housing 1, face +y", |i| face(i, 0, 1, 1.0)),
    fine_k("eh1_ym_temperature_k", "electrode housing 1, face -y", |i| face(i, 0, 1, -1.0)),
    fine_k("eh1_zp_temperature_k", "electrode housing 1, face +z", |i| face(i, 0, 2, 1.0)),
    fine_k("eh1_zm_temperature_k", "electrode housing 1, face -z", |i| face(i, 0, 2, -1.0)),
    fine_k("eh2_xp_temperature_k", "electrode housing 2, face +x", |i| face(i, 1, 0, 1.0)),
    fine_k("eh2_xm_temperature_k", "electrode housing 2, face -x", |i| face(i, 1, 0, -1.0)),
    fine_k("eh2_yp_temperature_k", "electrode housing 2, face +y", |i| face(i, 1, 1, 1.0)),
    fine_k("eh2_ym_temperature_k", "electrode housing 2, face -y", |i| face(i, 1, 1, -1.0)),
    fine_k("eh2_zp_temperature_k", "electrode housing 2, face +z", |i| face(i, 1, 2, 1.0)),
    fine_k("eh2_zm_temperature_k", "electrode housing 2, face -z", |i| face(i, 1, 2, -1.0)),
    state(("battery_current_a", "A", "battery"), 1.0, 2e-3, 1e-3, |i| i.battery_a),
    coarse_k("battery_temperature_k", "battery", |i| i.heated_k[0]),
    state(("battery_heater_flag", "1", "battery"), 0.1, 0.0, 1.0, |i| f64::from(i.heater[0])),
    coarse_k("tank_temperature_k", "propellant tank", |i| i.heated_k[1]),
    state(("tank_heater_flag", "1", "propellant tank"), 0.1, 0.0, 1.0, |i| f64::from(i.heater[1])),
    state(("tank_mass_kg", "kg", "propellant tank"), 0.1, 1e-4, 1e-5, |i| i.tank_kg),
    // Nitrogen in 0.1 m³: p = m R T / (M V).
    state(("tank_pressure_pa", "Pa", "propellant tank"), 0.1, 100.0, 50.0, |i| i.tank_kg * i.heated_k[1] * 2968.0),
    valve_a("thruster1_valve_current_a", "thruster 1", |i| valve(i, 0)),
    valve_a("thruster2_valve_current_a", "thruster 2", |i| valve(i, 1)),
    valve_a("thruster3_valve_current_a", "thruster 3", |i| valve(i, 2)),
    valve_a("thruster4_valve_current_a", "thruster 4", |i| valve(i, 3)),
    valve_a("thruster5_valve_current_a", "thruster 5", |i| valve(i, 4)),
    valve_a("thruster6_valve_current_a", "thruster 6", |i| valve(i, 5)),
    coarse_k("thruster1_temperature_k", "thruster 1", |i| i.valve_k[0]),
    coarse_k("thruster2_temperature_k", "thruster 2", |i| i.valve_k[1]),
    coarse_k("thruster3_temperature_k", "thruster 3", |i| i.valve_k[2]),
    coarse_k("thruster4_temperature_k", "thruster 4", |i| i.valve_k[3]),
    coarse_k("thruster5_temperature_k", "thruster 5", |i| i.valve_k[4]),
    coarse_k("thruster6_temperature_k", "thruster 6", |i| i.valve_k[5]),
    field_t("magnetometer1_x_t", "magnetometer 1, beside test mass 1", |i| field(i, 0, 0)),
    field_t("magnetometer1_y_t", "magnetometer 1, beside test mass 1", |i| field(i, 0, 1)),
    field_t("magnetometer1_z_t", "magnetometer 1, beside test mass 1", |i| field(i, 0, 2)),
    field_t("magnetometer2_x_t", "magnetometer 2, beside test mass 2", |i| field(i, 1, 0)),
    field_t("magnetometer2_y_t", "magnetometer 2, beside test mass 2", |i| field(i, 1, 1)),
    field_t("magnetometer2_z_t", "magnetometer 2, beside test mass 2", |i| field(i, 1, 2)),
    state(("magnetic_gradient1_t_m", "T m-1", "gradiometer 1"), 0.1, 2e-8, 1e-8, |i| gradient(i, 0)),
    state(("magnetic_gradient2_t_m", "T m-1", "gradiometer 2"), 0.1, 2e-8, 1e-8, |i| gradient(i, 1)),
    // By the electrodes' dither: 1e4 elementary charges in a minute.
    state(("tm1_charge_c", "C", "test mass 1"), 0.1, 1.2e-14, 1e-16, |i| i.charge_c[0]),
    state(("tm2_charge_c", "C", "test mass 2"), 0.1, 1.2e-14, 1e-16, |i| i.charge_c[1]),
    state(("uv_lamp1_flag", "1", "UV lamp 1"), 0.1, 0.0, 1.0, |i| f64::from(i.lamp[0])),
    state(("uv_lamp2_flag", "1", "UV lamp 2"), 0.1, 0.0, 1.0, |i| f64::from(i.lamp[1])),
    state(("vacuum_pressure_pa", "Pa", "vacuum enclosure"), 0.1, 1e-7, 1e-8, |i| i.pressure_pa),
    state(("solar_irradiance_w_m2", "W m-2", "solar panel"), 0.1, 0.2, 0.05, |i| i.irradiance_w_m2),
    state(("sun_angle_rad", "rad", "sun sensor"), 0.1, 2e-4, 2e-5, |i| i.sun_angle_rad),
    state(("opening_angle_rad", "rad", "telescope drive"), 0.1, 2e-7, 5e-8, |i| i.opening_rad),
    state(("antenna_move_flag", "1", "antenna"), 1.0, 0.0, 1.0, |i| f64::from(i.antenna_moves)),
    state(("bus_voltage_v", "V", "power unit"), 0.1, 1e-2, 5e-3, |i| 28.4 - 0.06 * i.battery_a),
    decoy(("computer_load_1", "1", "computer"), (2e-2, 1e-3), 0.41, (0.11, 5100.0), 0.05),
    decoy(("transponder_temperature_k", "K", "transponder"), (5e-3, 1e-3), 302.7, (0.4, 5700.0), 0.4),
    decoy(("star_tracker_temperature_k", "K", "star tracker"), (5e-3, 1e-3), 285.2, (0.2, 3300.0), 0.3),
    decoy(("gyro_temperature_k", "K", "gyro unit"), (5e-3, 1e-3), 309.9, (0.0, 1.0), 0.5),
    decoy(("laser1_power_w", "W", "laser 1"), (1e-4, 1e-5), 2.01, (1e-4, 10_800.0), 2e-3),
    decoy(("laser2_power_w", "W", "laser 2"), (1e-4, 1e-5), 1.98, (1e-4, 9600.0), 2e-3),
    decoy(("laser1_temperature_k", "K", "laser 1"), (1e-4, 1e-4), 298.15, (3e-3, 5400.0), 2e-2),
    decoy(("laser2_temperature_k", "K", "laser 2"), (1e-4, 1e-4), 298.12, (3e-3, 4800.0), 2e-2),
    decoy(("radiation_rate_hz", "Hz", "radiation monitor"), (3.0, 0.1), 6.2, (0.0, 1.0), 0.4),
    decoy(("wheel_current_a", "A", "filter wheel"), (1e-3, 1e-4), 0.08, (4e-3, 6300.0), 2e-3),
];

/// The running sensors.
pub struct Housekeeping {
    every: Vec<i64>,
    processes: Vec<NoiseProcess>,
    /// Phases of the decoys' cycles, turns.
    phases: Vec<f64>,
    rng: Xoshiro256PlusPlus,
    dt_s: f64,
}

impl Housekeeping {
    /// Scalars sampled next to a loop of sample interval `dt_s`.
    #[must_use]
    pub fn new(dt_s: f64, mut rng: Xoshiro256PlusPlus) -> Self {
        let every: Vec<i64> = CHANNELS.iter().map(|c| (1.0 / (c.rate_hz * dt_s)).round().max(1.0) as i64).collect();
        let phases = CHANNELS.iter().map(|_| rng.random()).collect();
        let processes = CHANNELS.iter().zip(&every).map(|(channel, every)| {
            let mut shape = NoiseShape::white(channel.noise);
            if let Source::Decoy { drift, .. } = channel.source {
                shape.terms.push(NoiseTerm { asd: drift, corner_hz: 1e-5, exponent: 4 });
            }
            let mut process = NoiseProcess::new(&shape, *every as f64 * dt_s);
            process.start(&mut rng);
            process
        });
        let processes = processes.collect();
        Self { every, processes, phases, rng, dt_s }
    }

    /// Gives the values due at an epoch with their index in [`CHANNELS`].
    pub fn read(&mut self, index: i64, inside: &Interior, mut give: impl FnMut(usize, f64)) {
        for (i, channel) in CHANNELS.iter().enumerate() {
            if index.rem_euclid(self.every[i]) != 0 {
                continue;
            }
            let value = match &channel.source {
                Source::State(read) => read(inside),
                Source::Decoy { level, cycle: (amplitude, period_s), .. } => {
                    let turns = index as f64 * self.dt_s / period_s + self.phases[i];
                    level + amplitude * (TAU * turns.fract()).sin()
                }
            };
            let noisy = value + self.processes[i].next(&mut self.rng);
            give(i, (noisy / channel.step).round() * channel.step);
        }
    }

    /// The state: random stream and processes.
    #[must_use]
    pub fn state(&self) -> (Xoshiro256PlusPlus, Vec<f64>) {
        (self.rng.clone(), self.processes.iter().flat_map(NoiseProcess::states).collect())
    }

    /// Takes back what [`Self::state`] gave; false when it is another version's.
    #[must_use]
    pub fn set_state(&mut self, (rng, states): (Xoshiro256PlusPlus, Vec<f64>)) -> bool {
        let slots: Vec<&mut f64> = self.processes.iter_mut().flat_map(NoiseProcess::states_mut).collect();
        if slots.len() != states.len() {
            return false;
        }
        for (slot, value) in slots.into_iter().zip(states) {
            *slot = value;
        }
        self.rng = rng;
        true
    }
}
