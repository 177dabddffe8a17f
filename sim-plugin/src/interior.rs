//! Interior of the spacecraft: temperatures, currents, propellant, magnetic field, charge. Effects depend on these
//! states and the housekeeping reads them; without effects the loop does not depend on them.
//!
//! One step a second. Heat goes panel → structure → bench → electrode housing, each behind a first-order lag; two
//! thermostats cycle their heaters; levels and fluctuations are those of LISA Pathfinder where it published them
//! (1905.09060 temperature, 2407.04427 magnetic field, PRL 118 171101 charge).

use dragfree_physics::noise::{NoiseShape, NoiseTerm};
use dragfree_physics::process::{NoiseProcess, normal};
use nalgebra::Vector3;
use rand::RngExt;
use rand_xoshiro::Xoshiro256PlusPlus;
use serde::{Deserialize, Serialize};

use crate::random::{fill, stream};

/// Seconds of a step.
const STEP_S: f64 = 1.0;
/// Sunlight at one astronomical unit, W/m².
const SOLAR_CONSTANT_W_M2: f64 = 1361.0;
const AU_M: f64 = 149_597_870_700.0;
/// Elementary charge, C.
const ELEMENTARY_C: f64 = 1.602_176_634e-19;
/// Exhaust velocity of a cold-gas thruster, m/s.
const EXHAUST_M_S: f64 = 600.0;
/// Thrust of an idle thruster, N, and the smallest thrust.
const BIAS_N: f64 = 15e-6;
const LEAST_N: f64 = 2e-6;
/// Charging by cosmic rays, elementary charges per second (23 e/s in flight), and where the UV lamp is switched on and
/// off.
const CHARGING_E_S: [f64; 2] = [23.0, 28.0];
const LAMP_ON_E: f64 = 6e5;
const LAMP_OFF_E: f64 = 2e4;
/// Time constant of a discharge, s.
const DISCHARGE_S: f64 = 400.0;
/// Field of the units at each test mass, T, and its gradient there, T/m (symmetric, no trace: no current, no charge).
pub const FIELD_T: [[f64; 3]; 2] = [[6e-7, -4e-7, 3e-7], [-5e-7, -5e-7, 4e-7]];
/// Gradient of the field of the units in ORF: xx, yy, xy, xz, yz.
pub const GRADIENT_T_M: [[f64; 5]; 2] = [[8e-6, -3e-6, 2e-6, -1e-6, 3e-6], [-7e-6, 4e-6, 1e-6, 2e-6, -2e-6]];
/// Relative increase of the units' field per ampere of the battery.
const FIELD_PER_A: f64 = 0.3;
/// Mean current of the battery, A, and what each heater takes.
const BUS_A: f64 = 1.9;
const HEATER_A: [f64; 2] = [0.24, 0.15];
/// Seconds between moves of the antenna: the shortest, and how much longer at most; length of a move.
const ANTENNA_S: (f64, f64) = (9000.0, 9000.0);
const ANTENNA_MOVE_S: f64 = 90.0;
/// Time constant of the outgassing, s.
const OUTGASSING_S: f64 = 2.6e6;
/// Least-norm distribution of a thrust along SRF over the six thrusters.
const DIRECTIONS: [[f64; 3]; 6] = [
    [0.577, 0.0, 0.408],
    [-0.289, 0.5, 0.408],
    [-0.289, -0.5, 0.408],
    [-0.577, 0.0, -0.408],
    [0.289, -0.5, -0.408],
    [0.289, 0.5, -0.408],
];

/// A node that cools towards its surroundings, with a heater controlled with hysteresis.
struct Thermostat {
    /// Below the structure, K.
    ambient_k: f64,
    lag_s: f64,
    set_k: f64,
    half_band_k: f64,
    heating_k_s: f64,
}

/// Battery, with cycles of about 5,400 s, and tank, about 3,300 s.
const THERMOSTATS: [Thermostat; 2] = [
    Thermostat { ambient_k: -8.0, lag_s: 20_000.0, set_k: 288.5, half_band_k: 0.135, heating_k_s: 2.25e-4 },
    Thermostat { ambient_k: -4.0, lag_s: 30_000.0, set_k: 291.0, half_band_k: 0.05, heating_k_s: 1.3e-4 },
];

/// Constants of a housing; they repeat after the second housing.
pub(crate) fn of_housing<T>(known: &[T; 2], housing: usize) -> &T {
    &known[housing % 2]
}

/// Steady-state temperature difference by each heater across each axis of each housing, K.
const HEATER_ACROSS_K: [[[f64; 2]; 3]; 2] =
    [[[1.2e-3, -4e-4], [-6e-4, 9e-4], [5e-4, 7e-4]], [[-9e-4, 6e-4], [8e-4, 5e-4], [-4e-4, -8e-4]]];
/// Standing difference across each axis, K.
const STANDING_ACROSS_K: [[f64; 3]; 2] = [[4e-3, -7e-3, 11e-3], [-5e-3, 6e-3, 9e-3]];

/// States of the interior.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Interior {
    /// Sunlight, W/m².
    pub irradiance_w_m2: f64,
    /// Angle between the direction to the Sun and `s_3`, rad.
    pub sun_angle_rad: f64,
    /// Solar panel, K.
    pub panel_k: f64,
    /// Structure, K.
    pub structure_k: f64,
    /// Optical benches, K.
    pub bench_k: Vec<f64>,
    /// Mean temperature of the electrode housings, K.
    pub housing_k: Vec<f64>,
    /// Temperature of the positive face minus that of the negative one, by housing and axis of ORF, K.
    pub across_k: Vec<[f64; 3]>,
    /// Battery and tank, K.
    pub heated_k: [f64; 2],
    /// Their heaters.
    pub heater: [bool; 2],
    /// The heaters' power behind the lag of the structure, 0 to 1.
    pub warmth: [f64; 2],
    /// Current of the battery, A.
    pub battery_a: f64,
    /// Propellant left, kg.
    pub tank_kg: f64,
    /// Propellant a step before, kg, for linear interpolation.
    pub tank_before_kg: f64,
    /// Temperature of the structure a step before, K.
    pub structure_before_k: f64,
    /// Propellant at the first sample, kg.
    pub tank_first_kg: f64,
    /// Temperature of the structure at the first sample, K.
    pub structure_first_k: f64,
    /// Thrust of each thruster, N, and the temperature of its valve, K.
    pub thrust_n: [f64; 6],
    /// Valves, K.
    pub valve_k: [f64; 6],
    /// Magnetic field from outside, SRF, T.
    pub interplanetary_t: [f64; 3],
    /// Factor of the field of the units and of its gradient, one per test mass.
    pub units_field: Vec<f64>,
    /// Charge of the test masses, C.
    pub charge_c: Vec<f64>,
    /// UV lamps.
    pub lamp: Vec<bool>,
    /// Pressure around the test masses, Pa.
    pub pressure_pa: f64,
    /// The antenna moves.
    pub antenna_moves: bool,
    /// Seconds until the antenna starts or stops.
    pub antenna_wait_s: f64,
    /// Opening angle of the constellation, which the telescopes follow, rad.
    pub opening_rad: f64,
    /// Opening angle at the first sample, rad.
    pub opening_first_rad: f64,
}

impl Interior {
    /// Propellant (kg) and temperature of the structure (K), interpolated linearly with a delay of one step.
    pub fn smooth(&self, elapsed_s: f64) -> (f64, f64) {
        // Epochs are rounded multiples of the interval.
        let part = (elapsed_s / STEP_S - (elapsed_s / STEP_S + 1e-6).floor()).max(0.0);
        let between = |before: f64, now: f64| before + (now - before) * part;
        (between(self.tank_before_kg, self.tank_kg), between(self.structure_before_k, self.structure_k))
    }
}

/// The random parts.
#[derive(Clone)]
struct Drifts {
    panel: NoiseProcess,
    structure: NoiseProcess,
    bench: Vec<NoiseProcess>,
    across: Vec<[NoiseProcess; 3]>,
    bus: NoiseProcess,
    interplanetary: [NoiseProcess; 3],
    units: Vec<NoiseProcess>,
}

/// The running model of the interior.
pub struct Running {
    /// The states at the coming epoch.
    pub now: Interior,
    drifts: Drifts,
    rng: Xoshiro256PlusPlus,
    /// Epochs of the loop per step.
    every: i64,
    /// Sum of the commanded thrust over the epochs since the last step, SRF, N.
    thrust_sum_srf_n: Vector3<f64>,
    epochs: u32,
}

/// State of [`Running`].
#[derive(Serialize, Deserialize)]
pub struct SavedInterior {
    now: Interior,
    drifts: Vec<f64>,
    rng: Xoshiro256PlusPlus,
    thrust_sum_srf_n: [f64; 3],
    epochs: u32,
}

/// External inputs of the interior.
#[derive(Clone, Copy, Debug)]
pub struct Influences {
    /// From the Sun, m.
    pub sun_distance_m: f64,
    /// Unit vector from the Sun to the spacecraft, SRF.
    pub sun_srf: Vector3<f64>,
    /// Opening angle of the constellation, rad.
    pub opening_rad: f64,
}

/// Noise of ASD `asd` at `at_hz`, falling as `1/f^(exponent/2)`.
fn drift(asd: f64, at_hz: f64, exponent: u32) -> NoiseProcess {
    NoiseProcess::new(&NoiseShape { terms: vec![NoiseTerm { asd, corner_hz: at_hz, exponent }] }, STEP_S)
}

/// First-order lag over one step.
fn follow(value: &mut f64, target: f64, lag_s: f64) {
    *value += (target - *value) * -(-STEP_S / lag_s).exp_m1();
}

impl Drifts {
    fn new(housings: usize) -> Self {
        let all = 0..housings;
        Self {
            panel: drift(1.0, 1e-5, 4),
            structure: drift(0.3, 1e-5, 4),
            bench: all.clone().map(|_| drift(0.1, 1e-5, 4)).collect(),
            across: all.clone().map(|_| std::array::from_fn(|_| drift(2e-5, 1e-3, 4))).collect(),
            bus: drift(1e-2, 1e-5, 4),
            interplanetary: std::array::from_fn(|_| drift(2e-8, 1e-3, 2)),
            units: all.map(|_| drift(0.3, 1e-5, 4)).collect(),
        }
    }

    fn all(&mut self) -> impl Iterator<Item = &mut NoiseProcess> {
        [&mut self.panel, &mut self.structure, &mut self.bus]
            .into_iter()
            .chain(&mut self.bench)
            .chain(self.across.iter_mut().flatten())
            .chain(&mut self.interplanetary)
            .chain(&mut self.units)
    }
}

impl Running {
    /// The interior at the start of a simulation, with random phases of its cycles.
    pub fn new(seed: u64, dt_s: f64, housings: usize, influences: &Influences) -> Self {
        let mut rng = stream(seed, "interior");
        let mut drifts = Drifts::new(housings);
        for process in drifts.all() {
            process.start(&mut rng);
        }
        let heated_k = std::array::from_fn(|i| {
            let t: &Thermostat = &THERMOSTATS[i];
            t.set_k + t.half_band_k * (2.0 * rng.random::<f64>() - 1.0)
        });
        let now = Interior {
            irradiance_w_m2: SOLAR_CONSTANT_W_M2,
            sun_angle_rad: 0.0,
            panel_k: 338.0,
            structure_k: 296.5,
            bench_k: (0..housings).map(|i| *of_housing(&[294.1, 294.3], i)).collect(),
            housing_k: (0..housings).map(|i| *of_housing(&[294.2, 294.4], i)).collect(),
            across_k: (0..housings).map(|i| *of_housing(&STANDING_ACROSS_K, i)).collect(),
            heated_k,
            heater: std::array::from_fn(|_| rng.random()),
            warmth: [0.6, 0.4],
            battery_a: BUS_A,
            tank_kg: 85.0,
            tank_before_kg: 85.0,
            structure_before_k: 296.5,
            tank_first_kg: 85.0,
            structure_first_k: 296.5,
            thrust_n: [BIAS_N; 6],
            valve_k: [301.0; 6],
            interplanetary_t: [0.0; 3],
            units_field: vec![1.0; housings],
            charge_c: (0..housings)
                .map(|i| of_housing(&CHARGING_E_S, i) * 2e4 * ELEMENTARY_C * rng.random::<f64>())
                .collect(),
            lamp: vec![false; housings],
            pressure_pa: 8e-6,
            antenna_moves: false,
            antenna_wait_s: ANTENNA_S.1 * rng.random::<f64>(),
            opening_rad: influences.opening_rad,
            opening_first_rad: influences.opening_rad,
        };
        let every = (STEP_S / dt_s).round().max(1.0) as i64;
        let mut out = Self { now, drifts, rng, every, thrust_sum_srf_n: Vector3::zeros(), epochs: 0 };
        // Start the lags settled.
        for _ in 0..3 {
            out.heat(influences, true);
        }
        out.electricity();
        out.now.structure_first_k = out.now.structure_k;
        out.now.structure_before_k = out.now.structure_k;
        out
    }

    /// Records the thrust of an epoch.
    pub fn thrust(&mut self, force_srf_n: &Vector3<f64>) {
        self.thrust_sum_srf_n += force_srf_n;
        self.epochs += 1;
    }

    /// Whether a step ends at an epoch.
    pub fn due(&self, index: i64) -> bool {
        index.rem_euclid(self.every) == 0
    }

    /// Advances by a step, to an epoch.
    pub fn step(&mut self, index: i64, influences: &Influences) {
        (self.now.tank_before_kg, self.now.structure_before_k) = (self.now.tank_kg, self.now.structure_k);
        self.propulsion();
        self.heat(influences, false);
        self.electricity();
        self.charging();
        self.antenna();
        self.now.opening_rad = influences.opening_rad;
        self.now.pressure_pa *= (-STEP_S / OUTGASSING_S).exp();
        if index == 0 {
            self.now.tank_first_kg = self.now.tank_before_kg;
            self.now.structure_first_k = self.now.structure_before_k;
            self.now.opening_first_rad = self.now.opening_rad;
        }
    }

    fn propulsion(&mut self) {
        let mean_srf_n =
            std::mem::take(&mut self.thrust_sum_srf_n) / f64::from(std::mem::take(&mut self.epochs).max(1));
        let now = &mut self.now;
        for i in 0..6 {
            now.thrust_n[i] = (BIAS_N + Vector3::from(DIRECTIONS[i]).dot(&mean_srf_n)).max(LEAST_N);
            now.tank_kg -= now.thrust_n[i] * STEP_S / EXHAUST_M_S;
            follow(&mut now.valve_k[i], 299.0 + 0.1 * (now.structure_k - 296.5) + 1.3e5 * now.thrust_n[i], 900.0);
        }
    }

    /// `at_once`: nodes take their steady state.
    fn heat(&mut self, influences: &Influences, at_once: bool) {
        let lag = |s: f64| if at_once { 1e-9 } else { s };
        let (now, drifts, rng) = (&mut self.now, &mut self.drifts, &mut self.rng);
        now.irradiance_w_m2 = SOLAR_CONSTANT_W_M2 * (AU_M / influences.sun_distance_m).powi(2);
        now.sun_angle_rad = (-influences.sun_srf.z).clamp(-1.0, 1.0).acos();
        let sunlit = now.irradiance_w_m2 * now.sun_angle_rad.cos() / (SOLAR_CONSTANT_W_M2 * 0.75_f64.sqrt());
        follow(&mut now.panel_k, 338.0 * sunlit.max(0.0).powf(0.25) + drifts.panel.next(rng), lag(600.0));
        let heaters = 0.4 * (now.warmth[0] - 0.6) + 0.2 * (now.warmth[1] - 0.4);
        let structure_k = 296.5 + 0.05 * (now.panel_k - 338.0) + heaters + drifts.structure.next(rng);
        follow(&mut now.structure_k, structure_k, lag(14_400.0));
        for (i, t) in THERMOSTATS.iter().enumerate() {
            let cooling = (now.structure_k + t.ambient_k - now.heated_k[i]) / t.lag_s;
            if !at_once {
                now.heated_k[i] += (cooling + f64::from(now.heater[i]) * t.heating_k_s) * STEP_S;
                now.heated_k[i] += 2e-5 * normal(rng);
            }
            let off = now.heated_k[i] - t.set_k;
            now.heater[i] = if now.heater[i] { off < t.half_band_k } else { off < -t.half_band_k };
            if !at_once {
                follow(&mut now.warmth[i], f64::from(now.heater[i]), 700.0);
            }
        }
        for i in 0..now.bench_k.len() {
            let bench_k = 294.1 + 0.2 * i as f64 + 0.3 * (now.structure_k - 296.5) + drifts.bench[i].next(rng);
            follow(&mut now.bench_k[i], bench_k, lag(7200.0));
            let bench_k = now.bench_k[i];
            follow(&mut now.housing_k[i], bench_k + 0.1, lag(1800.0));
            for axis in 0..3 {
                let [battery, tank] = of_housing(&HEATER_ACROSS_K, i)[axis];
                now.across_k[i][axis] = of_housing(&STANDING_ACROSS_K, i)[axis]
                    + battery * (now.warmth[0] - 0.6)
                    + tank * (now.warmth[1] - 0.4)
                    + drifts.across[i][axis].next(rng);
            }
        }
    }

    fn electricity(&mut self) {
        let (now, drifts, rng) = (&mut self.now, &mut self.drifts, &mut self.rng);
        let heaters: f64 = now.heater.iter().zip(HEATER_A).map(|(on, a)| f64::from(*on) * a).sum();
        now.battery_a = BUS_A + heaters + drifts.bus.next(rng) + 0.05 * f64::from(now.antenna_moves);
        for (axis, process) in drifts.interplanetary.iter_mut().enumerate() {
            now.interplanetary_t[axis] = process.next(rng);
        }
        for i in 0..now.units_field.len() {
            now.units_field[i] = 1.0 + FIELD_PER_A * (now.battery_a - 2.1) + 1e-2 * drifts.units[i].next(rng);
        }
    }

    fn charging(&mut self) {
        for i in 0..self.now.charge_c.len() {
            let (charge_c, lamp) = (&mut self.now.charge_c[i], &mut self.now.lamp[i]);
            // Each cosmic ray brings some tens of charges: 23 e/s with the scatter of 570 e/√Hz, one-sided.
            let arrived = of_housing(&CHARGING_E_S, i) * STEP_S + 400.0 * normal(&mut self.rng);
            *charge_c += arrived * ELEMENTARY_C;
            if *lamp {
                follow(charge_c, 0.0, DISCHARGE_S);
            }
            *lamp = *charge_c > if *lamp { LAMP_OFF_E } else { LAMP_ON_E } * ELEMENTARY_C;
        }
    }

    fn antenna(&mut self) {
        let now = &mut self.now;
        now.antenna_wait_s -= STEP_S;
        if now.antenna_wait_s <= 0.0 {
            now.antenna_moves = !now.antenna_moves;
            now.antenna_wait_s =
                if now.antenna_moves { ANTENNA_MOVE_S } else { ANTENNA_S.0 + ANTENNA_S.1 * self.rng.random::<f64>() };
        }
    }

    /// The state, for a checkpoint.
    pub fn save(&self) -> SavedInterior {
        let mut drifts = self.drifts.clone();
        SavedInterior {
            now: self.now.clone(),
            drifts: drifts.all().flat_map(|p| p.states().collect::<Vec<_>>()).collect(),
            rng: self.rng.clone(),
            thrust_sum_srf_n: self.thrust_sum_srf_n.into(),
            epochs: self.epochs,
        }
    }

    /// Restores [`Self::save`]; false if the length differs.
    pub fn load(&mut self, saved: &SavedInterior) -> bool {
        (self.now, self.rng) = (saved.now.clone(), saved.rng.clone());
        (self.thrust_sum_srf_n, self.epochs) = (saved.thrust_sum_srf_n.into(), saved.epochs);
        fill(self.drifts.all().flat_map(NoiseProcess::states_mut), &saved.drifts)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SUN: Influences = Influences {
        sun_distance_m: AU_M,
        sun_srf: Vector3::new(0.5, 0.0, -0.866_025_403_784_438_6),
        opening_rad: 1.0,
    };

    fn running() -> Running {
        Running::new(7, 0.1, 2, &SUN)
    }

    /// Two insides with the same random numbers, of which the second differs by `change`; their differences over time.
    fn difference<const N: usize>(
        change: impl Fn(&mut Running, &mut Influences),
        of: impl Fn(&Interior) -> [f64; N],
        steps: i64,
    ) -> Vec<[f64; N]> {
        let (mut plain, mut changed, mut sun) = (running(), running(), SUN);
        change(&mut changed, &mut sun);
        let mut one = |index| {
            plain.step(index, &SUN);
            changed.step(index, &sun);
            let (a, b) = (of(&plain.now), of(&changed.now));
            std::array::from_fn(|i| b[i] - a[i])
        };
        (1..=steps).map(&mut one).collect()
    }

    /// What is left after `t` of a unit step through two lags in a row.
    fn second_order(t: f64, first_s: f64, second_s: f64) -> f64 {
        1.0 - (second_s * (-t / second_s).exp() - first_s * (-t / first_s).exp()) / (second_s - first_s)
    }

    /// More sunlight from one step to the next: by Stefan's law the panel goes up by `338 K (s^{1/4} − 1)` as
    /// `1 − e^{−t/600 s}`, exactly; the structure follows by 5 % of it behind 14,400 s, to the change within one step,
    /// which is how much the panel may be ahead of it.
    #[test]
    fn a_step_of_sunlight_comes_behind_the_lags() {
        let distance = 0.99;
        let more =
            difference(|_, sun| sun.sun_distance_m = distance * AU_M, |now| [now.panel_k, now.structure_k], 3000);
        let up_k = 338.0 * (distance.powf(-0.5) - 1.0);
        assert!(up_k > 1.0);
        for (t, [panel_k, structure_k]) in (1..).map(f64::from).zip(more) {
            let want_k = up_k * -(-t / 600.0).exp_m1();
            assert!((panel_k - want_k).abs() < 1e-9, "{t} s: {panel_k} K, not {want_k} K");
            let want_k = 0.05 * up_k * second_order(t, 600.0, 14_400.0);
            assert!((structure_k - want_k).abs() < 0.05 * up_k * STEP_S / 14_400.0, "{t} s: {structure_k} K");
        }
    }

    /// A warmer bench cools as `e^{−t/7200 s}`, exactly, and its housing follows behind 1800 s, to a step of that lag.
    #[test]
    fn a_housing_follows_its_bench() {
        let warm = difference(|run, _| run.now.bench_k[1] += 1.0, |now| [now.bench_k[1], now.housing_k[1]], 5000);
        for (t, [bench_k, housing_k]) in (1..).map(f64::from).zip(warm) {
            assert!((bench_k - (-t / 7200.0).exp()).abs() < 1e-9, "{t} s: {bench_k} K");
            let want_k = 7200.0 / (7200.0 - 1800.0) * ((-t / 7200.0).exp() - (-t / 1800.0).exp());
            assert!((housing_k - want_k).abs() < STEP_S / 1800.0, "{t} s: {housing_k} K, not {want_k} K");
        }
    }

    /// By hand: six thrusters at 15 µN take 90 µN whatever balanced force they make; 100 µN along x is more than three
    /// of them can give way to: 72.7 + 2 × 43.9 µN, and three at their 2 µN. Forces that change within a step count by
    /// their mean. Each of six thrusters takes its own from 85 kg, rounded to half the float's step.
    #[test]
    fn the_tank_empties_by_what_is_thrust() {
        for (amplitude_n, swing_n, total_n) in [(0.0, 0.0, 90e-6), (5e-6, 4e-6, 90e-6), (100e-6, 30e-6, 166.5e-6)] {
            let mut inside = running();
            for index in 1..=1000 {
                for epoch in 0..10 {
                    let swing_n = if epoch % 2 == 0 { swing_n } else { -swing_n };
                    inside.thrust(&Vector3::new(amplitude_n + swing_n, 0.0, 0.0));
                }
                inside.step(index, &SUN);
            }
            let (used_kg, want_kg) = (85.0 - inside.now.tank_kg, total_n * 1000.0 / 600.0);
            let rounding_kg = 6.0 * 1000.0 * 0.5 * (85.0_f64.next_up() - 85.0);
            assert!((used_kg - want_kg).abs() < rounding_kg, "{used_kg} kg, not {want_kg} kg");
            let thrust_n: f64 = inside.now.thrust_n.iter().map(|t| t.abs()).sum();
            assert!((thrust_n - total_n).abs() < 1e-15, "{thrust_n} N");
        }
    }

    /// Of two charges under the lamp, met by the same cosmic rays, the difference falls as `e^{−t/400 s}`, exactly.
    #[test]
    fn the_lamp_discharges_behind_its_lag() {
        let [high_e, low_e] = [5e5, 3e5].map(|charge_e| {
            let mut inside = running();
            (inside.now.charge_c[1], inside.now.lamp[1]) = (charge_e * ELEMENTARY_C, true);
            (0..600).for_each(|_| inside.charging());
            assert!(inside.now.lamp[1], "still above where the lamp goes out");
            inside.now.charge_c[1] / ELEMENTARY_C
        });
        let left = (high_e - low_e) / 2e5;
        assert!((left / (-1.5_f64).exp() - 1.0).abs() < 1e-9, "{left}");
    }

    /// Cosmic rays charge the test mass at 23 e/s with the scatter of 400 e a second; above 6e5 e the lamp takes that
    /// off behind 400 s, below 2e4 e it goes out and the charge climbs again. Each within 4.5σ, false alarm 7e-6.
    #[test]
    fn a_discharge_resets_the_charge() {
        let mut inside = running();
        let charge_e = |inside: &Running| inside.now.charge_c[0] / ELEMENTARY_C;
        inside.now.charge_c[0] = 6.1e5 * ELEMENTARY_C;
        inside.now.lamp[0] = false;
        inside.charging();
        assert!(inside.now.lamp[0], "too much charge lights the lamp");

        let (start_e, n) = (charge_e(&inside), 800);
        (0..n).for_each(|_| inside.charging());
        // qₙ = a (qₙ₋₁ + 23 + 400 gauss): what is left of the start, of what came, and of its scatter.
        let left = (-1.0 / 400.0_f64).exp();
        let (whole, power) = (left.powi(n), left.powi(2 * n));
        let want_e = start_e * whole + 23.0 * left * (1.0 - whole) / (1.0 - left);
        let sigma_e = 400.0 * left * ((1.0 - power) / (1.0 - left * left)).sqrt();
        assert!((charge_e(&inside) - want_e).abs() < 4.5 * sigma_e, "{} e, not {want_e} e", charge_e(&inside));
        assert!(inside.now.lamp[0] && start_e - want_e > 40.0 * sigma_e, "a lamp without light would be seen");

        while inside.now.lamp[0] {
            inside.charging();
        }
        let reset_e = charge_e(&inside);
        assert!(reset_e <= 2e4, "{reset_e} e");
        let n = 20_000;
        (0..n).for_each(|_| inside.charging());
        let (grown_e, want_e) = (charge_e(&inside) - reset_e, 23.0 * f64::from(n));
        assert!((grown_e - want_e).abs() < 4.5 * 400.0 * f64::from(n).sqrt(), "{grown_e} e, not {want_e} e");
        assert!(!inside.now.lamp[0], "the lamp stays off below 6e5 e");
    }
}
