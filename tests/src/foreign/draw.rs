//! Flights drawn by a seed: controllers, noise, start, gaps, and hidden effects with the names of the bundled ones.
//!
//! `/command` is always telemetered, at 10 Hz, as `telemetry.proto` fixes its rate.

use std::fmt::Write as _;
use std::io;
use std::path::{Path, PathBuf};

use super::file::{Container, PERIOD_NS, Recorder};
use super::spacecraft::{Blow, Dice, Flight, Heat, Hidden, Line, Loops, Spacecraft, Start, Variation};

/// Levels of white noise, one-sided amplitude densities.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Levels {
    /// Thrust, N/√Hz per axis.
    pub thrust_n: f64,
    /// Torque, N m/√Hz per axis.
    pub torque_nm: f64,
    /// Interferometer, m/√Hz.
    pub ifo_m: f64,
    /// Capacitive readout, m/√Hz.
    pub is_m: f64,
    /// Long-arm wavefront sensing, rad/√Hz.
    pub dws_rad: f64,
}

impl Levels {
    fn scaled(self, [thrust, torque, ifo, is, dws]: [f64; 5]) -> Self {
        Self {
            thrust_n: thrust * self.thrust_n,
            torque_nm: torque * self.torque_nm,
            ifo_m: ifo * self.ifo_m,
            is_m: is * self.is_m,
            dws_rad: dws * self.dws_rad,
        }
    }
}

/// A hidden effect, by the name and in the sign convention of the bundled effect.
#[derive(Clone, Debug, PartialEq)]
pub struct Acted {
    /// Effect.
    pub effect: &'static str,
    /// Instance.
    pub instance: String,
    /// True value of the coefficient; a noise level counts from 1, relative to what the mission file declares.
    pub size: f64,
    /// SI unit of it.
    pub unit: &'static str,
    /// Expected σ, approximate.
    pub sigma: f64,
    /// Time of an impulse after the first sample, s.
    pub at_s: Option<f64>,
    /// Frequency of a line, Hz.
    pub frequency_hz: Option<f64>,
    /// Whether a bundled effect covers it.
    pub known: bool,
}

impl Acted {
    /// `EFFECT:INSTANCE`.
    #[must_use]
    pub fn name(&self) -> String {
        format!("{}:{}", self.effect, self.instance)
    }

    /// Expected significance.
    #[must_use]
    pub fn significance(&self) -> f64 {
        let origin = if self.effect.ends_with("-noise") { 1.0 } else { 0.0 };
        (self.size - origin).abs() / self.sigma
    }
}

/// A flight with what its mission file declares and what of it is recorded.
#[derive(Clone, Debug, PartialEq)]
pub struct Draw {
    /// The flight.
    pub flight: Flight,
    /// What it has beyond its numbers.
    pub variation: Variation,
    /// Noise that the mission file declares.
    pub declared: Levels,
    /// Flown over declared level of thrust, torque, interferometer, capacitive readout and long arm; hidden louder
    /// noise comes on top.
    pub deviation: [f64; 5],
    /// Time of the first sample, ns since 1970.
    pub start_ns: u64,
    /// Gaps of the recording: begin after the first sample and length, s.
    pub gaps_s: Vec<(f64, f64)>,
    /// Hidden effects.
    pub acted: Vec<Acted>,
}

/// Probabilities of nothing hidden, of a pair of effects, and of a kind that no bundled effect covers.
const NOTHING: f64 = 0.1;
const PAIR: f64 = 0.15;
const UNKNOWN: f64 = 0.15;
/// Smallest and largest expected significance.
const SIGNIFICANCE: (f64, f64) = (4.0, 20.0);
/// Excess of a louder noise over the declared one. It starts beyond the tolerance of a mission file, and its
/// significance is far above that of the other effects.
const LOUDER: (f64, f64) = (0.4, 1.5);
/// Largest deviation of the noise from the mission file.
const DEVIATION: f64 = 0.3;
/// Bandwidths about which those of a flight are drawn, rad/s, and the largest factor from them.
const REFERENCE: Loops = Loops { attitude: 0.4, x: 0.45, y: 0.2, z: 0.25 };
const BANDWIDTH_FACTOR: f64 = 1.75;
/// 2035-01-01T00:00:00Z, s since 1970.
const EPOCH_S: u64 = 2_051_222_400;
/// Distance of an impulse from a gap, from either end of the data and from the end of a day, s.
const CLEAR_S: f64 = 900.0;
const DAY_S: f64 = 86_400.0;

/// What a row of the table changes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Cause {
    ThrustGain,
    ThrustTilt,
    TorqueGain,
    Electrodes,
    Readout,
    Heat,
    Hit,
    Glitch,
    ThrustNoise,
    TorqueNoise,
    ReadoutNoise,
    CurrentSquared,
    CurrentByPanel,
    ThrustLine,
}

/// Where it acts.
#[derive(Clone, Copy, Debug)]
enum Place {
    /// Spacecraft, axis of SRF.
    Sc(usize),
    /// Test mass 1 alone, axis: the thermometers are at its housing.
    Tm1(usize),
    /// Either test mass, axis of ORF.
    Tm(usize),
    /// Either test mass, from one axis to another.
    Pair(usize, usize),
}

/// An effect with the σ of its size after six hours with [`REFERENCE`] bandwidths, and the largest size that the
/// bundled effect takes as physical.
struct Row {
    cause: Cause,
    effect: &'static str,
    unit: &'static str,
    place: Place,
    sigma_6h: f64,
    most: f64,
}

const fn row(cause: Cause, effect: &'static str, unit: &'static str, place: Place, sigma_6h: f64, most: f64) -> Row {
    Row { cause, effect, unit, place, sigma_6h, most }
}

/// Axes.
const X: usize = 0;
const Y: usize = 1;
const Z: usize = 2;

// The table is approximate: σ are of a few diagnoses of this producer's telemetry, or of the bundled simulator where
// there was none, rounded. They fall with the root of the time, those of an impulse not at all, and those of a gain
// with the root of the bandwidth. A report must therefore use the σ of the diagnosis itself.
const ROWS: [Row; 45] = [
    row(Cause::ThrustGain, "mps-gain", "1", Place::Sc(X), 8e-3, 0.27),
    row(Cause::ThrustGain, "mps-gain", "1", Place::Sc(Y), 6e-3, 0.27),
    row(Cause::ThrustGain, "mps-gain", "1", Place::Sc(Z), 1e-2, 0.27),
    row(Cause::ThrustTilt, "mps-tilt", "rad", Place::Sc(X), 4e-4, 0.09),
    row(Cause::ThrustTilt, "mps-tilt", "rad", Place::Sc(Y), 4e-4, 0.09),
    row(Cause::ThrustTilt, "mps-tilt", "rad", Place::Sc(Z), 6e-3, 0.09),
    row(Cause::TorqueGain, "torque-gain", "1", Place::Sc(X), 1e-2, 0.13),
    row(Cause::TorqueGain, "torque-gain", "1", Place::Sc(Y), 1e-2, 0.13),
    row(Cause::TorqueGain, "torque-gain", "1", Place::Sc(Z), 1e-2, 0.13),
    row(Cause::Electrodes, "es-gain", "1", Place::Tm(Y), 1.4e-2, 0.27),
    row(Cause::Electrodes, "es-gain", "1", Place::Tm(Z), 3e-2, 0.27),
    row(Cause::Electrodes, "es-crosstalk", "1", Place::Pair(Y, X), 2.5e-4, 0.09),
    row(Cause::Electrodes, "es-crosstalk", "1", Place::Pair(Z, X), 3e-4, 0.09),
    row(Cause::Electrodes, "es-crosstalk", "1", Place::Pair(Y, Z), 1.4e-2, 0.09),
    row(Cause::Electrodes, "es-crosstalk", "1", Place::Pair(Z, Y), 2e-2, 0.09),
    row(Cause::Readout, "is-scale", "1", Place::Tm(Y), 1.4e-2, 0.18),
    row(Cause::Readout, "is-scale", "1", Place::Tm(Z), 1.5e-2, 0.18),
    row(Cause::Readout, "is-crosstalk", "1", Place::Pair(Y, Z), 1.4e-2, 0.18),
    row(Cause::Readout, "is-crosstalk", "1", Place::Pair(Z, Y), 1.1e-2, 0.18),
    row(Cause::Heat, "thermal", "m s-2 K-1", Place::Tm1(X), 1.5e-14, 1e-9),
    row(Cause::Heat, "thermal", "m s-2 K-1", Place::Tm1(Y), 1.5e-14, 1e-9),
    row(Cause::Heat, "thermal", "m s-2 K-1", Place::Tm1(Z), 1.5e-14, 1e-9),
    row(Cause::Hit, "impulse", "N s", Place::Sc(X), 4e-8, 1e-3),
    row(Cause::Hit, "impulse", "N s", Place::Sc(Y), 5e-8, 1e-3),
    row(Cause::Hit, "impulse", "N s", Place::Sc(Z), 1.7e-7, 1e-3),
    row(Cause::Glitch, "impulse", "N s", Place::Tm(X), 5e-12, 1e-7),
    row(Cause::Glitch, "impulse", "N s", Place::Tm(Y), 5e-12, 1e-7),
    row(Cause::Glitch, "impulse", "N s", Place::Tm(Z), 1e-11, 1e-7),
    row(Cause::ThrustNoise, "mps-noise", "1", Place::Sc(X), 3.5e-3, 2.0),
    row(Cause::ThrustNoise, "mps-noise", "1", Place::Sc(Y), 5e-3, 2.0),
    row(Cause::ThrustNoise, "mps-noise", "1", Place::Sc(Z), 2e-2, 2.0),
    row(Cause::TorqueNoise, "torque-noise", "1", Place::Sc(X), 1.3e-2, 2.0),
    row(Cause::TorqueNoise, "torque-noise", "1", Place::Sc(Y), 1.3e-2, 2.0),
    row(Cause::TorqueNoise, "torque-noise", "1", Place::Sc(Z), 1.4e-2, 2.0),
    row(Cause::ReadoutNoise, "is-noise", "1", Place::Tm(Y), 1.5e-3, 2.0),
    row(Cause::ReadoutNoise, "is-noise", "1", Place::Tm(Z), 1.5e-3, 2.0),
    row(Cause::CurrentSquared, "current-squared", "m s-2 A-2", Place::Tm(X), 5e-16, 1e-9),
    row(Cause::CurrentSquared, "current-squared", "m s-2 A-2", Place::Tm(Y), 5e-16, 1e-9),
    row(Cause::CurrentSquared, "current-squared", "m s-2 A-2", Place::Tm(Z), 5e-16, 1e-9),
    row(Cause::CurrentByPanel, "current-by-panel", "m s-2 A-1 K-1", Place::Tm(X), 2e-15, 1e-9),
    row(Cause::CurrentByPanel, "current-by-panel", "m s-2 A-1 K-1", Place::Tm(Y), 2e-15, 1e-9),
    row(Cause::CurrentByPanel, "current-by-panel", "m s-2 A-1 K-1", Place::Tm(Z), 2e-15, 1e-9),
    row(Cause::ThrustLine, "line", "N", Place::Sc(X), 5e-10, 1e-4),
    row(Cause::ThrustLine, "line", "N", Place::Sc(Y), 5e-10, 1e-4),
    row(Cause::ThrustLine, "line", "N", Place::Sc(Z), 1e-9, 1e-4),
];

/// Kinds that bundled effects cover, and kinds that none covers.
pub const KINDS: [&[&str]; 2] = [
    &[
        "mps-gain",
        "mps-tilt",
        "torque-gain",
        "es-gain",
        "es-crosstalk",
        "is-scale",
        "is-crosstalk",
        "thermal",
        "impulse",
        "mps-noise",
        "torque-noise",
        "is-noise",
        "line",
    ],
    &["current-squared", "current-by-panel"],
];

impl Row {
    fn is_known(&self) -> bool {
        KINDS[0].contains(&self.effect)
    }

    /// Approximate σ after `hours` with these bandwidths.
    fn sigma(&self, hours: f64, loops: &Loops, attitude: [f64; 3]) -> f64 {
        let axis_of_thrusters = |axis: usize, l: &Loops| if axis == Z { l.z } else { l.x };
        let axis_of_electrodes = |axis: usize, l: &Loops| if axis == Z { l.z } else { l.y };
        let bandwidth = |l: &Loops, attitude: [f64; 3]| match (self.cause, self.place) {
            (Cause::ThrustGain | Cause::ThrustTilt, Place::Sc(axis)) => axis_of_thrusters(axis, l),
            (Cause::TorqueGain, Place::Sc(axis)) => l.attitude * attitude[axis],
            (Cause::Electrodes | Cause::Readout, Place::Tm(axis) | Place::Pair(axis, _)) => axis_of_electrodes(axis, l),
            _ => 1.0,
        };
        let time = if matches!(self.cause, Cause::Hit | Cause::Glitch) { 1.0 } else { (6.0 / hours).sqrt() };
        self.sigma_6h * time * (bandwidth(&REFERENCE, [1.0; 3]) / bandwidth(loops, attitude)).sqrt()
    }
}

impl Dice {
    /// Uniform in the logarithm.
    fn log_uniform(&mut self, low: f64, high: f64) -> f64 {
        low * (high / low).powf(self.uniform())
    }

    fn between(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * self.uniform()
    }

    fn sign(&mut self) -> f64 {
        if self.uniform() < 0.5 { -1.0 } else { 1.0 }
    }

    fn below(&mut self, n: usize) -> usize {
        // uniform() is below one.
        (self.uniform() * n as f64) as usize
    }
}

/// A stream of its own for each thing that is drawn, so that drawing one more does not change the others.
fn stream(seed: u64, which: u64) -> Dice {
    // SplitMix64's finalizer: seeds that follow each other begin far apart.
    let mut z = seed.wrapping_mul(0x9e37_79b9_7f4a_7c15).wrapping_add(which.wrapping_mul(0xbf58_476d_1ce4_e5b9));
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    Dice::new(z ^ (z >> 31))
}

fn loops(dice: &mut Dice) -> Loops {
    let mut about = |w: f64| dice.log_uniform(w / BANDWIDTH_FACTOR, w * BANDWIDTH_FACTOR);
    Loops { attitude: REFERENCE.attitude, x: about(REFERENCE.x), y: about(REFERENCE.y), z: about(REFERENCE.z) }
}

/// Settled in half of the flights; otherwise a mode begins with errors within a minute before the first sample.
fn start(dice: &mut Dice) -> Start {
    if dice.uniform() < 0.5 {
        return Start::SETTLED;
    }
    let [displacement_m, attitude_rad] = [0; 2].map(|_| dice.log_uniform(1e-9, 1e-7));
    Start {
        before_s: dice.between(0.0, 60.0),
        displacement_m: [[0.0; 3]; 2].map(|r: [f64; 3]| r.map(|_| displacement_m * dice.between(-1.0, 1.0))),
        attitude_rad: [0.0; 3].map(|_: f64| attitude_rad * dice.between(-1.0, 1.0)),
    }
}

/// Levels exact in half of the flights; otherwise one of them, or all, are off.
fn deviation(dice: &mut Dice) -> [f64; 5] {
    let luck = dice.uniform();
    let off = [0.0; 5].map(|_: f64| dice.between(1.0 - DEVIATION, 1.0 + DEVIATION));
    let one = dice.below(5);
    match luck {
        exact if exact < 0.5 => [1.0; 5],
        single if single < 0.75 => std::array::from_fn(|i| if i == one { off[i] } else { 1.0 }),
        _ => off,
    }
}

/// None in two thirds of the flights; otherwise up to four, 10 s to 20 min long, together at most a fifth of the time.
fn gaps(dice: &mut Dice, seconds: f64) -> Vec<(f64, f64)> {
    let mut all: Vec<(f64, f64)> = Vec::new();
    if dice.uniform() < 1.0 / 3.0 {
        for _ in 0..1 + dice.below(4) {
            let gap = (dice.between(0.02, 0.9) * seconds, dice.log_uniform(10.0, 1200.0));
            let lost: f64 = all.iter().map(|(_, length)| length).sum();
            let apart = |other: &(f64, f64)| gap.0 > other.0 + other.1 + 60.0 || other.0 > gap.0 + gap.1 + 60.0;
            if lost + gap.1 < 0.2 * seconds && gap.0 + gap.1 < 0.98 * seconds && all.iter().all(apart) {
                all.push(gap);
            }
        }
    }
    all.sort_by(|a, b| a.0.total_cmp(&b.0));
    all
}

/// A time away from gaps and ends of days.
fn clear_time(dice: &mut Dice, seconds: f64, gaps_s: &[(f64, f64)]) -> f64 {
    let is_clear = |t: f64| {
        let of_day = t % DAY_S;
        let within = (CLEAR_S..DAY_S - CLEAR_S).contains(&of_day) && t < seconds - CLEAR_S;
        within && gaps_s.iter().all(|(at, length)| t < at - CLEAR_S || t > at + length + CLEAR_S)
    };
    let mut t = 0.5 * seconds;
    for _ in 0..1000 {
        t = (dice.between(0.0, seconds) * 10.0).round() / 10.0;
        if is_clear(t) {
            break;
        }
    }
    t
}

const AXES: [&str; 3] = ["x", "y", "z"];

impl Draw {
    /// Draws a flight of `hours`; nothing is hidden if `clean`. The controllers of a seed do not depend on either.
    #[must_use]
    pub fn new(seed: u64, hours: f64, clean: bool) -> Self {
        let seconds = 3600.0 * hours;
        let mut bandwidths = stream(seed, 1);
        let loops = loops(&mut bandwidths);
        let attitude = [0.0; 3].map(|_: f64| bandwidths.log_uniform(BANDWIDTH_FACTOR.recip(), BANDWIDTH_FACTOR));
        let mut noise = stream(seed, 2);
        let base = Levels { thrust_n: 0.8e-7, torque_nm: 1.2e-7, ifo_m: 3e-12, is_m: 2.4e-9, dws_rad: 3e-10 };
        let declared = base.scaled([0.0; 5].map(|_: f64| noise.log_uniform(0.7, 1.4)));
        let deviation = deviation(&mut noise);
        let flown = declared.scaled(deviation);
        let mut other = stream(seed, 3);
        let start = start(&mut other);
        let shift_srf_m = [0.0; 3].map(|_: f64| other.between(-5e-3, 5e-3));
        let sunlight_n = 6.3513e-5 * other.between(0.8, 1.2);
        let start_ns = EPOCH_S * 1_000_000_000 + (other.between(0.0, 300.0 * DAY_S) * 1e9) as u64;
        let gaps_s = gaps(&mut stream(seed, 4), seconds);
        let flight = Flight {
            seconds,
            seed: seed.wrapping_mul(0x2545_f491_4f6c_dd1d) >> 2,
            shift_srf_m,
            thrust_n: flown.thrust_n,
            torque_nm: flown.torque_nm,
            ifo_m: flown.ifo_m,
            is_m: flown.is_m,
            dws_rad: flown.dws_rad,
            sunlight_n,
            loops,
            hidden: Hidden::NONE,
        };
        let variation = Variation { attitude, stray_m_s2: 3e-15, corners_hz: [4e-4, 1e-3], start };
        let mut draw = Self { flight, variation, declared, deviation, start_ns, gaps_s, acted: Vec::new() };
        let mut dice = stream(seed, 5);
        let luck = dice.uniform();
        if !clean && luck >= NOTHING {
            let known = luck < 1.0 - UNKNOWN;
            draw.hide(&mut dice, |row| row.is_known() == known);
            if luck < NOTHING + PAIR {
                let first = draw.acted[0].effect;
                draw.hide(&mut dice, |row| row.is_known() && row.effect != first);
            }
        }
        draw
    }

    /// Hides one effect among the rows that are wanted.
    fn hide(&mut self, dice: &mut Dice, wanted: impl Fn(&Row) -> bool) {
        let hours = self.flight.seconds / 3600.0;
        let is_possible = |row: &&Row| {
            let noise = row.effect.ends_with("-noise");
            wanted(row)
                && (noise || SIGNIFICANCE.0 * row.sigma(hours, &self.flight.loops, self.variation.attitude) < row.most)
        };
        let rows: Vec<&Row> = ROWS.iter().filter(is_possible).collect();
        let mut effects: Vec<&str> = rows.iter().map(|row| row.effect).collect();
        effects.dedup();
        let effect = effects[dice.below(effects.len())];
        let rows: Vec<&Row> = rows.into_iter().filter(|row| row.effect == effect).collect();
        let row = rows[dice.below(rows.len())];
        let sigma = row.sigma(hours, &self.flight.loops, self.variation.attitude);
        let most = SIGNIFICANCE.1.min(row.most / sigma);
        let size = sigma * dice.log_uniform(SIGNIFICANCE.0, most) * dice.sign();
        let test_mass = if matches!(row.place, Place::Tm1(_)) { 0 } else { dice.below(2) };
        let acted = self.act(dice, row, test_mass, size);
        let instance = match row.place {
            Place::Sc(axis) => format!("sc.{}", AXES[axis]),
            Place::Tm1(axis) | Place::Tm(axis) => format!("tm{}.{}", test_mass + 1, AXES[axis]),
            Place::Pair(from, to) => format!("tm{}.{}-{}", test_mass + 1, AXES[from], AXES[to]),
        };
        let known = row.is_known();
        self.acted.push(Acted { effect, instance, unit: row.unit, sigma, known, ..acted });
    }

    /// Sets the hidden effect of a row; gives its size and time.
    fn act(&mut self, dice: &mut Dice, row: &Row, i: usize, size: f64) -> Acted {
        let louder = 1.0 + dice.between(LOUDER.0, LOUDER.1);
        let [thrust, torque, _, is, _] = self.deviation;
        let (seconds, hidden) = (self.flight.seconds, &mut self.flight.hidden);
        let (from, to) = match row.place {
            Place::Sc(axis) | Place::Tm1(axis) | Place::Tm(axis) => (axis, axis),
            Place::Pair(from, to) => (from, to),
        };
        let mut told = Acted {
            effect: row.effect,
            instance: String::new(),
            size,
            unit: row.unit,
            sigma: 0.0,
            at_s: None,
            frequency_hz: None,
            known: true,
        };
        match row.cause {
            Cause::ThrustGain => hidden.thrust_gain[from] = size,
            Cause::ThrustTilt => hidden.thrust_tilt_rad[from] = size,
            Cause::TorqueGain => hidden.torque_gain[from] = size,
            Cause::Electrodes => hidden.electrodes[i][to][from] = size,
            Cause::Readout => hidden.shown[i][to][from] = size,
            Cause::Heat => {
                let lag_s = dice.log_uniform(100.0, 2000.0);
                hidden.heat = Some(Heat { test_mass: i, axis: from, per_k: size, lag_s });
            }
            Cause::Hit | Cause::Glitch => {
                let at_s = clear_time(dice, seconds, &self.gaps_s);
                let decay_s = if row.cause == Cause::Glitch { dice.log_uniform(5.0, 100.0) } else { 0.0 };
                let test_mass = (row.cause == Cause::Glitch).then_some(i);
                hidden.blow = Some(Blow { test_mass, axis: from, at_s, momentum_n_s: size, decay_s });
                told.at_s = Some(at_s);
            }
            // The coefficient is relative to the declared level.
            Cause::ThrustNoise => {
                hidden.thrust_noise[from] = louder;
                told.size = louder * thrust;
            }
            Cause::TorqueNoise => {
                hidden.torque_noise[from] = louder;
                told.size = louder * torque;
            }
            Cause::ReadoutNoise => {
                hidden.is_noise[i][from] = louder;
                told.size = louder * is;
            }
            Cause::CurrentSquared => hidden.current_squared = Some((i, from, size)),
            Cause::CurrentByPanel => hidden.current_by_panel = Some((i, from, size)),
            Cause::ThrustLine => {
                let hz = dice.log_uniform(7e-4, 0.1);
                hidden.line = Some(Line { axis: from, force_n: size.abs(), hz });
                (told.size, told.frequency_hz) = (size.abs(), Some(hz));
            }
        }
        told
    }

    /// Names of noise levels that differ from the declared ones by more than `part`, the hidden ones among them.
    #[must_use]
    pub fn true_levels(&self, part: f64) -> Vec<String> {
        let [thrust, torque, ifo, is, _] = self.deviation;
        let hidden = &self.flight.hidden;
        let mut all = Vec::new();
        for (a, axis) in AXES.into_iter().enumerate() {
            all.push((format!("mps-noise:sc.{axis}"), thrust * hidden.thrust_noise[a]));
            all.push((format!("torque-noise:sc.{axis}"), torque * hidden.torque_noise[a]));
            for i in 0..2 {
                // The interferometer reads x.
                let readout = if a == 0 { ifo } else { is * hidden.is_noise[i][a] };
                all.push((format!("is-noise:tm{}.{axis}", i + 1), readout));
            }
        }
        all.into_iter().filter(|(_, level)| (level - 1.0).abs() > part).map(|(name, _)| name).collect()
    }

    /// Writes the telemetry into a folder, one file for each day of 24 h from the first sample; gives the files.
    ///
    /// # Errors
    /// A file cannot be written.
    pub fn record(&self, folder: &Path) -> io::Result<Vec<PathBuf>> {
        const PER_DAY: usize = 864_000;
        let container = Container { chunks: true, zstd: true, summary: true, command: true, ephemeris: true };
        let lost = |t: f64| self.gaps_s.iter().any(|(at, length)| (*at..at + length).contains(&t));
        let (mut files, mut open) = (Vec::new(), None);
        for (k, r) in Spacecraft::new(&self.flight, &self.variation).enumerate() {
            if k.is_multiple_of(PER_DAY) {
                if let Some(day) = open.take() {
                    Recorder::finish(day)?;
                }
                let path = folder.join(format!("foreign-{}.mcap", k / PER_DAY + 1));
                open = Some(Recorder::create(&path, container, true)?);
                files.push(path);
            }
            if let Some(day) = open.as_mut().filter(|_| !lost(k as f64 * 0.1)) {
                day.sample(k, self.start_ns + k as u64 * PERIOD_NS, &r)?;
            }
        }
        open.map_or(Ok(()), Recorder::finish)?;
        Ok(files)
    }

    /// The mission file of the flight, from that of the bundled mission: declared levels of white noise, and the
    /// sunlight. The noise of forces on the test masses is flown as the bundled file declares it. `None` if the bundled
    /// file lacks a table or key.
    #[must_use]
    pub fn mission(&self, bundled: &str) -> Option<String> {
        let levels = &self.declared;
        let mut text = bundled.to_owned();
        for (table, key, value) in [
            ("noise.thruster_force", "asd_n_rthz", levels.thrust_n),
            ("noise.thruster_torque", "asd_nm_rthz", levels.torque_nm),
            ("noise.ifo_x", "asd_m_rthz", levels.ifo_m),
            ("noise.is_x", "asd_m_rthz", levels.is_m),
            ("noise.is_y", "asd_m_rthz", levels.is_m),
            ("noise.is_z", "asd_m_rthz", levels.is_m),
            ("noise.is_angle", "asd_rad_rthz", 1.5e-7),
            ("noise.dws_local", "asd_rad_rthz", 1e-9),
            ("noise.dws_long_arm", "asd_rad_rthz", levels.dws_rad),
            ("solar_pressure", "force_n", self.flight.sunlight_n),
        ] {
            text = with_value(&text, table, key, value)?;
        }
        Some(text)
    }
}

/// A mission file with another value in a table of its own; a noise there becomes white.
fn with_value(text: &str, table: &str, key: &str, value: f64) -> Option<String> {
    let (mut out, mut inside, mut done) = (String::with_capacity(text.len()), false, false);
    for line in text.lines() {
        if line.starts_with('[') {
            inside = line.starts_with(&format!("[{table}]"));
        }
        let name = line.split('=').next().unwrap_or_default().trim();
        if inside && name == key {
            writeln!(out, "{key} = {value:e}").ok()?;
            done = true;
        } else if !(inside && ["corner_hz", "exponent"].contains(&name)) {
            writeln!(out, "{line}").ok()?;
        }
    }
    done.then_some(out)
}
