//! Housekeeping scalars: plausible company for the science channels. Nothing in the loop depends on them.

use dragfree_physics::control::Command;
use dragfree_physics::noise::{NoiseShape, NoiseTerm};
use dragfree_physics::process::NoiseProcess;
use rand_xoshiro::Xoshiro256PlusPlus;
use std::f64::consts::TAU;

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
    level: f64,
    /// Amplitude and period, s, of a regular load.
    cycle: (f64, f64),
    /// ASD at 10 µHz, falling as 1/f², and of the readout, unit/√Hz.
    drift: f64,
    readout: f64,
}

/// What is downlinked. Temperatures drift as on LISA Pathfinder (about 1 K/√Hz at 10 µHz on the panel, sensors of
/// 10 µK/√Hz).
pub const CHANNELS: [Channel; 6] = [
    Channel {
        name: "bench1_temperature_k",
        unit: "K",
        place: "optical bench 1",
        rate_hz: 0.1,
        level: 294.1,
        cycle: (0.0, 1.0),
        drift: 0.1,
        readout: 1e-5,
    },
    Channel {
        name: "bench2_temperature_k",
        unit: "K",
        place: "optical bench 2",
        rate_hz: 0.1,
        level: 294.3,
        cycle: (0.0, 1.0),
        drift: 0.1,
        readout: 1e-5,
    },
    Channel {
        name: "panel_temperature_k",
        unit: "K",
        place: "solar panel",
        rate_hz: 0.1,
        level: 338.0,
        cycle: (0.0, 1.0),
        drift: 1.0,
        readout: 1e-3,
    },
    Channel {
        name: "battery_current_a",
        unit: "A",
        place: "battery",
        rate_hz: 1.0,
        level: 2.1,
        cycle: (0.12, 5400.0),
        drift: 1e-2,
        readout: 2e-3,
    },
    Channel {
        name: "battery_temperature_k",
        unit: "K",
        place: "battery",
        rate_hz: 0.1,
        level: 288.5,
        cycle: (0.02, 5400.0),
        drift: 0.3,
        readout: 1e-4,
    },
    Channel {
        name: "tank_mass_kg",
        unit: "kg",
        place: "propellant tank",
        rate_hz: 0.1,
        level: 85.0,
        cycle: (0.0, 1.0),
        drift: 0.0,
        readout: 1e-4,
    },
];

/// Index of the tank in [`CHANNELS`].
const TANK: usize = 5;
/// Exhaust velocity of a cold-gas thruster, m/s.
const EXHAUST_M_S: f64 = 600.0;

/// The running scalars.
pub struct Housekeeping {
    every: [i64; CHANNELS.len()],
    processes: Vec<NoiseProcess>,
    rng: Xoshiro256PlusPlus,
    dt_s: f64,
    propellant_used_kg: f64,
}

impl Housekeeping {
    /// Scalars sampled next to a loop of sample interval `dt_s`.
    #[must_use]
    pub fn new(dt_s: f64, mut rng: Xoshiro256PlusPlus) -> Self {
        let every = CHANNELS.map(|c| (1.0 / (c.rate_hz * dt_s)).round().max(1.0) as i64);
        let processes = CHANNELS
            .iter()
            .zip(every)
            .map(|(c, every)| {
                let mut shape = NoiseShape::white(c.readout);
                shape.terms.push(NoiseTerm { asd: c.drift, corner_hz: 1e-5, exponent: 4 });
                let mut process = NoiseProcess::new(&shape, every as f64 * dt_s);
                process.start(&mut rng);
                process
            })
            .collect();
        Self { every, processes, rng, dt_s, propellant_used_kg: 0.0 }
    }

    /// The values due at an epoch, with their index in [`CHANNELS`].
    pub fn step(&mut self, index: i64, command: &Command) -> Vec<(usize, f64)> {
        self.propellant_used_kg += command.mps_force_srf_n.lp_norm(1) * self.dt_s / EXHAUST_M_S;
        let mut out = Vec::new();
        for (i, channel) in CHANNELS.iter().enumerate() {
            if index.rem_euclid(self.every[i]) != 0 {
                continue;
            }
            let (amplitude, period_s) = channel.cycle;
            let cycle = amplitude * (TAU * (index as f64 * self.dt_s / period_s).fract()).sin();
            let used = if i == TANK { self.propellant_used_kg } else { 0.0 };
            out.push((i, channel.level + cycle - used + self.processes[i].next(&mut self.rng)));
        }
        out
    }

    /// The state: random stream, processes, propellant.
    #[must_use]
    pub fn state(&self) -> (Xoshiro256PlusPlus, Vec<f64>, f64) {
        (self.rng.clone(), self.processes.iter().flat_map(NoiseProcess::states).collect(), self.propellant_used_kg)
    }

    /// Takes back what [`Self::state`] gave; false when it is another version's.
    #[must_use]
    pub fn set_state(&mut self, (rng, states, used): (Xoshiro256PlusPlus, Vec<f64>, f64)) -> bool {
        let slots: Vec<&mut f64> = self.processes.iter_mut().flat_map(NoiseProcess::states_mut).collect();
        if slots.len() != states.len() {
            return false;
        }
        for (slot, value) in slots.into_iter().zip(states) {
            *slot = value;
        }
        (self.rng, self.propellant_used_kg) = (rng, used);
        true
    }
}
