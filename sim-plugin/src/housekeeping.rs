//! Housekeeping scalars: readings of the spacecraft's interior, and decoy channels unrelated to any effect.

use dragfree_physics::noise::{NoiseShape, NoiseTerm};
use dragfree_physics::process::NoiseProcess;
use rand::RngExt;
use rand_xoshiro::Xoshiro256PlusPlus;
use std::f64::consts::TAU;

use crate::interior::{FIELD_T, GRADIENT_T_M, Interior, of_housing};
use crate::random::fill;

/// A housekeeping scalar.
pub struct Channel {
    /// Name behind `hk/`.
    pub name: String,
    /// Unit.
    pub unit: &'static str,
    /// Location on the spacecraft.
    pub place: String,
    /// Rate, Hz.
    pub rate_hz: f64,
    /// White noise of the sensor, unit/√Hz.
    noise: f64,
    /// Step of the converter, unit.
    pub step: f64,
    source: Source,
}

/// Source of a value.
enum Source {
    /// A state of the interior.
    State(Read),
    /// A decoy: level, cycle by amplitude and period (s), and drift by its ASD at 10 µHz.
    Decoy { level: f64, cycle: (f64, f64), drift: f64 },
}

type Read = Box<dyn Fn(&Interior) -> f64 + Send>;

fn state(
    (name, unit, place): (&str, &'static str, &str),
    rate_hz: f64,
    noise: f64,
    step: f64,
    read: impl Fn(&Interior) -> f64 + Send + 'static,
) -> Channel {
    let source = Source::State(Box::new(read));
    Channel { name: name.to_owned(), unit, place: place.to_owned(), rate_hz, noise, step, source }
}

fn decoy(
    (name, unit, place): (&str, &'static str, &str),
    (noise, step): (f64, f64),
    level: f64,
    cycle: (f64, f64),
    drift: f64,
) -> Channel {
    let source = Source::Decoy { level, cycle, drift };
    Channel { name: name.to_owned(), unit, place: place.to_owned(), rate_hz: 0.1, noise, step, source }
}

/// A thermometer of 10 µK/√Hz (LISA Pathfinder, 1905.09060).
fn fine_k(name: &str, place: &str, read: impl Fn(&Interior) -> f64 + Send + 'static) -> Channel {
    state((name, "K", place), 0.1, 1e-5, 1e-6, read)
}

/// An ordinary thermometer.
fn coarse_k(name: &str, place: &str, read: impl Fn(&Interior) -> f64 + Send + 'static) -> Channel {
    state((name, "K", place), 0.1, 5e-3, 1e-3, read)
}

/// Current of a valve: 40 mA and 3 mA for each µN.
fn valve_a(name: &str, place: &str, read: impl Fn(&Interior) -> f64 + Send + 'static) -> Channel {
    state((name, "A", place), 0.1, 2e-4, 5e-5, read)
}

/// A magnetometer of 1.5 nT steps.
fn field_t(name: &str, place: &str, read: impl Fn(&Interior) -> f64 + Send + 'static) -> Channel {
    state((name, "T", place), 0.1, 2e-9, 1.5e-9, read)
}

fn face(i: &Interior, tm: usize, axis: usize, side: f64) -> f64 {
    i.housing_k[tm] + 0.5 * side * i.across_k[tm][axis]
}

/// Field at a magnetometer beside a test mass, SRF: the external field, and that of the units with its axes permuted.
fn field(i: &Interior, tm: usize, axis: usize) -> f64 {
    i.interplanetary_t[axis] + i.units_field[tm] * of_housing(&FIELD_T, tm)[(axis + 1) % 3]
}

fn gradient(i: &Interior, tm: usize) -> f64 {
    i.units_field[tm] * of_housing(&GRADIENT_T_M, tm)[0]
}

fn valve(i: &Interior, thruster: usize) -> f64 {
    0.04 + 3e3 * i.thrust_n[thruster]
}

/// Housekeeping channels of a spacecraft with these test masses.
pub fn channels(test_masses: &[String]) -> Vec<Channel> {
    let housings = 0..test_masses.len();
    let mut out = vec![
        coarse_k("panel_temperature_k", "solar panel", |i| i.panel_k),
        fine_k("structure_temperature_k", "structure", |i| i.structure_k),
    ];
    for tm in housings.clone() {
        let n = tm + 1;
        out.push(fine_k(&format!("bench{n}_temperature_k"), &format!("optical bench {n}"), move |i| i.bench_k[tm]));
    }
    for tm in housings.clone() {
        let n = tm + 1;
        for (axis, letter) in ["x", "y", "z"].into_iter().enumerate() {
            for (side, sign, end) in [(1.0, "+", "p"), (-1.0, "-", "m")] {
                let (name, place) = (
                    format!("eh{n}_{letter}{end}_temperature_k"),
                    format!("electrode housing {n}, face {sign}{letter}"),
                );
                out.push(fine_k(&name, &place, move |i| face(i, tm, axis, side)));
            }
        }
    }
    out.extend([
        state(("battery_current_a", "A", "battery"), 1.0, 2e-3, 1e-3, |i| i.battery_a),
        coarse_k("battery_temperature_k", "battery", |i| i.heated_k[0]),
        state(("battery_heater_flag", "1", "battery"), 0.1, 0.0, 1.0, |i| f64::from(i.heater[0])),
        coarse_k("tank_temperature_k", "propellant tank", |i| i.heated_k[1]),
        state(("tank_heater_flag", "1", "propellant tank"), 0.1, 0.0, 1.0, |i| f64::from(i.heater[1])),
        state(("tank_mass_kg", "kg", "propellant tank"), 0.1, 1e-4, 1e-5, |i| i.tank_kg),
        // Nitrogen in 0.1 m³: p = m R T / (M V).
        state(("tank_pressure_pa", "Pa", "propellant tank"), 0.1, 100.0, 50.0, |i| i.tank_kg * i.heated_k[1] * 2968.0),
    ]);
    for k in 0..6 {
        let n = k + 1;
        out.push(valve_a(&format!("thruster{n}_valve_current_a"), &format!("thruster {n}"), move |i| valve(i, k)));
    }
    for k in 0..6 {
        let n = k + 1;
        out.push(coarse_k(&format!("thruster{n}_temperature_k"), &format!("thruster {n}"), move |i| i.valve_k[k]));
    }
    for tm in housings.clone() {
        let n = tm + 1;
        for (axis, letter) in ["x", "y", "z"].into_iter().enumerate() {
            let place = format!("magnetometer {n}, beside test mass {n}");
            out.push(field_t(&format!("magnetometer{n}_{letter}_t"), &place, move |i| field(i, tm, axis)));
        }
    }
    for tm in housings.clone() {
        let (name, place) = (format!("magnetic_gradient{}_t_m", tm + 1), format!("gradiometer {}", tm + 1));
        out.push(state((&name, "T m-1", &place), 0.1, 2e-8, 1e-8, move |i| gradient(i, tm)));
    }
    for (tm, name) in test_masses.iter().enumerate() {
        // By the electrodes' dither: 1e4 elementary charges in a minute.
        let (name, place) = (format!("{name}_charge_c"), format!("test mass {}", tm + 1));
        out.push(state((&name, "C", &place), 0.1, 1.2e-14, 1e-16, move |i| i.charge_c[tm]));
    }
    for tm in housings {
        let (name, place) = (format!("uv_lamp{}_flag", tm + 1), format!("UV lamp {}", tm + 1));
        out.push(state((&name, "1", &place), 0.1, 0.0, 1.0, move |i| f64::from(i.lamp[tm])));
    }
    out.extend([
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
    ]);
    out
}

/// The running sensors.
pub struct Housekeeping {
    channels: Vec<Channel>,
    every: Vec<i64>,
    processes: Vec<NoiseProcess>,
    /// Phases of the decoys' cycles, turns.
    phases: Vec<f64>,
    rng: Xoshiro256PlusPlus,
    dt_s: f64,
}

impl Housekeeping {
    /// Scalars of a spacecraft with these test masses, sampled next to a loop of sample interval `dt_s`.
    pub fn new(test_masses: &[String], dt_s: f64, mut rng: Xoshiro256PlusPlus) -> Self {
        let channels = channels(test_masses);
        let every: Vec<i64> = channels.iter().map(|c| (1.0 / (c.rate_hz * dt_s)).round().max(1.0) as i64).collect();
        let phases = channels.iter().map(|_| rng.random()).collect();
        let processes = channels.iter().zip(&every).map(|(channel, every)| {
            let mut shape = NoiseShape::white(channel.noise);
            if let Source::Decoy { drift, .. } = channel.source {
                shape.terms.push(NoiseTerm { asd: drift, corner_hz: 1e-5, exponent: 4 });
            }
            let mut process = NoiseProcess::new(&shape, *every as f64 * dt_s);
            process.start(&mut rng);
            process
        });
        let processes = processes.collect();
        Self { channels, every, processes, phases, rng, dt_s }
    }

    /// The channels.
    pub fn channels(&self) -> &[Channel] {
        &self.channels
    }

    /// Passes the values due at an epoch to `give`, with their index in [`Self::channels`].
    pub fn read(&mut self, index: i64, inside: &Interior, mut give: impl FnMut(usize, f64)) {
        for (i, channel) in self.channels.iter().enumerate() {
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
    pub fn state(&self) -> (Xoshiro256PlusPlus, Vec<f64>) {
        (self.rng.clone(), self.processes.iter().flat_map(NoiseProcess::states).collect())
    }

    /// Restores [`Self::state`]; false if the length differs.
    pub fn set_state(&mut self, (rng, states): (Xoshiro256PlusPlus, Vec<f64>)) -> bool {
        self.rng = rng;
        fill(self.processes.iter_mut().flat_map(NoiseProcess::states_mut), &states)
    }
}
