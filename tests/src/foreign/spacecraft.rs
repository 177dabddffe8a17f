//! A spacecraft with two test masses in a closed loop: small angles, forces constant over a step, exact integration.

/// Samples per second.
const RATE_HZ: f64 = 10.0;
const DT_S: f64 = 1.0 / RATE_HZ;
/// Settling time before the first recorded sample.
const SETTLE_S: f64 = 3_000.0;

/// A simulation: noise levels (one-sided amplitude densities), offsets, controllers.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Flight {
    /// Length, s.
    pub seconds: f64,
    /// Seed of everything random.
    pub seed: u64,
    /// Displacement of both housings against the drawings, SRF, m.
    pub shift_srf_m: [f64; 3],
    /// Thrust, N/√Hz per axis.
    pub thrust_n: f64,
    /// Torque, N m/√Hz per axis.
    pub torque_nm: f64,
    /// Interferometer, m/√Hz.
    pub ifo_m: f64,
    /// Capacitive readout of y and z, m/√Hz.
    pub is_m: f64,
    /// Long-arm wavefront sensing, rad/√Hz.
    pub dws_rad: f64,
    /// Force of the sunlight along x of SRF, N, with an arm of (0.1, 0, 0.6) m.
    pub sunlight_n: f64,
    /// Bandwidths.
    pub loops: Loops,
    /// Hidden effects.
    pub hidden: Hidden,
}

/// What a flight may have beyond its numbers.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Variation {
    /// Factor of the attitude's bandwidth about each axis.
    pub attitude: [f64; 3],
    /// Stray acceleration of each test mass along each axis, m s⁻²/√Hz.
    pub stray_m_s2: f64,
    /// Corners below which the amplitudes of the strays and of the electrodes' force noise rise as 1/f, Hz.
    pub corners_hz: [f64; 2],
    /// Errors at the start of the recording.
    pub start: Start,
}

impl Variation {
    /// Nothing.
    pub const NONE: Self = Self { attitude: [1.0; 3], stray_m_s2: 0.0, corners_hz: [0.0; 2], start: Start::SETTLED };
}

/// Errors with which a mode of the controllers begins, after fifty minutes in which the loops have settled.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Start {
    /// Time of the errors before the first recorded sample, s.
    pub before_s: f64,
    /// Displacements of the test masses, ORF, m.
    pub displacement_m: [[f64; 3]; 2],
    /// Attitude error, rad.
    pub attitude_rad: [f64; 3],
}

impl Start {
    /// No errors.
    pub const SETTLED: Self = Self { before_s: 0.0, displacement_m: [[0.0; 3]; 2], attitude_rad: [0.0; 3] };
}

/// Differences from the mission file. Axes are those of SRF for thrust and torque, of ORF for the test masses.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Hidden {
    /// Gain error of the thrusters' force along each axis.
    pub thrust_gain: [f64; 3],
    /// Its change per day from the first recorded sample on.
    pub thrust_gain_per_day: [f64; 3],
    /// Angle by which the thrusters are turned about each axis, rad, small.
    pub thrust_tilt_rad: [f64; 3],
    /// Gain error of the thrusters' torque about each axis.
    pub torque_gain: [f64; 3],
    /// Errors of the electrodes: `[i][to][from]` of the force commanded along `from` acts along `to` too.
    pub electrodes: [Matrix; 2],
    /// Errors of the capacitive readout: `[i][shown][acted]` of the displacement along `acted` is seen along `shown`
    /// too.
    pub shown: [Matrix; 2],
    /// Force by the temperatures.
    pub heat: Option<Heat>,
    /// Impulse.
    pub blow: Option<Blow>,
    /// Factor of the thrusters' force noise along each axis.
    pub thrust_noise: [f64; 3],
    /// Factor of the thrusters' torque noise about each axis.
    pub torque_noise: [f64; 3],
    /// Factor of the capacitive readout's noise along each axis.
    pub is_noise: [[f64; 3]; 2],
    /// Acceleration by the square of the bus current: test mass, axis, m s⁻² A⁻².
    pub current_squared: Option<(usize, usize, f64)>,
    /// Acceleration by the product of bus current and panel temperature, each about its mean: test mass, axis,
    /// m s⁻² A⁻¹ K⁻¹.
    pub current_by_panel: Option<(usize, usize, f64)>,
    /// Acceleration by the squares of the magnetic field's components: test mass, axis, m s⁻² T⁻² of each.
    pub field_squared: Option<(usize, usize, [f64; 3])>,
    /// Part of the commanded force that acts too little or too much, per kelvin of the panel above its mean, K⁻¹.
    pub gain_by_panel: Option<Gain>,
    /// Force on the spacecraft by the bus current: axis of SRF, N A⁻¹.
    pub current_on_spacecraft: Option<(usize, f64)>,
    /// Sinusoidal force on the spacecraft.
    pub line: Option<Line>,
}

/// Three by three numbers, by rows.
pub type Matrix = [[f64; 3]; 3];

impl Hidden {
    /// The spacecraft of the mission file.
    pub const NONE: Self = Self {
        thrust_gain: [0.0; 3],
        thrust_gain_per_day: [0.0; 3],
        thrust_tilt_rad: [0.0; 3],
        torque_gain: [0.0; 3],
        electrodes: [[[0.0; 3]; 3]; 2],
        shown: [[[0.0; 3]; 3]; 2],
        heat: None,
        blow: None,
        thrust_noise: [1.0; 3],
        torque_noise: [1.0; 3],
        is_noise: [[1.0; 3]; 2],
        current_squared: None,
        current_by_panel: None,
        field_squared: None,
        gain_by_panel: None,
        current_on_spacecraft: None,
        line: None,
    };
}

impl Default for Hidden {
    fn default() -> Self {
        Self::NONE
    }
}

/// A force on a test mass by the difference of the temperatures left and right of its housing.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Heat {
    /// Test mass.
    pub test_mass: usize,
    /// Axis of ORF.
    pub axis: usize,
    /// Acceleration per kelvin by which the left side is warmer, m s⁻² K⁻¹.
    pub per_k: f64,
    /// Lag between thermometer and force, s.
    pub lag_s: f64,
}

/// A momentum that is transferred once.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Blow {
    /// Test mass, along an axis of ORF; otherwise the spacecraft, along an axis of SRF through its centre of mass.
    pub test_mass: Option<usize>,
    /// Axis.
    pub axis: usize,
    /// Time after the first recorded sample, s.
    pub at_s: f64,
    /// Momentum, N s.
    pub momentum_n_s: f64,
    /// Time constant with which the force on a test mass decays, s; 0 for one sample.
    pub decay_s: f64,
}

/// A sinusoidal force on the spacecraft.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Line {
    /// Axis of SRF.
    pub axis: usize,
    /// Amplitude, N.
    pub force_n: f64,
    /// Frequency, Hz.
    pub hz: f64,
}

/// A gain that follows the temperature of the solar panel.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Gain {
    /// The electrodes of this test mass, along an axis of ORF; otherwise the thrusters, along an axis of SRF.
    pub test_mass: Option<usize>,
    /// Axis.
    pub axis: usize,
    /// Gain error per kelvin above the mean, K⁻¹.
    pub per_k: f64,
}

/// Usual lag between thermometer and force, s.
pub const HEAT_LAG_S: f64 = 700.0;
/// Mean of the bus current, A; relaxation time of its slow part, s, and its standard deviation, A; height, A, and mean
/// duration, s, of a switched load.
const BUS_A: f64 = 2.0;
const BUS_S: f64 = 900.0;
const BUS_SLOW_A: f64 = 0.2;
const LOAD_A: f64 = 0.6;
const LOAD_S: f64 = 1200.0;
/// Mean of the panel's temperature, K; relaxation time, s, and standard deviation, K.
const PANEL_K: f64 = 310.0;
const PANEL_S: f64 = 4000.0;
const PANEL_SLOW_K: f64 = 1.0;
/// Mean of the magnetic field, SRF, T; relaxation time, s, and standard deviation of each component, T.
const FIELD_T: [f64; 3] = [1e-7, -2e-7, 1.5e-7];
const FIELD_S: f64 = 1500.0;
const FIELD_SLOW_T: f64 = 2e-7;
/// Relaxation time of the temperatures, s, and their standard deviation, K.
const HEAT_S: f64 = 1500.0;
const HEAT_K: f64 = 0.03;

/// Bandwidths of the loops, rad/s.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Loops {
    /// Attitude.
    pub attitude: f64,
    /// Along the sensitive axes, by the thrusters.
    pub x: f64,
    /// Along y, by the electrodes.
    pub y: f64,
    /// Along z, by both.
    pub z: f64,
}

impl Loops {
    /// Digital controller of a loop of bandwidth `w`: one second-order section `[b0, b1, b2, a1, a2]` behind a gain,
    /// from filtered position, difference and sum.
    #[must_use]
    pub fn section(w: f64) -> (f64, [f64; 5]) {
        let a = smoothing(w);
        let (p, d, i) = pid(w);
        let b = [p + d / DT_S + i * DT_S, -p - 2.0 * d / DT_S, d / DT_S];
        (a, [b[0], b[1], b[2], -(2.0 - a), 1.0 - a])
    }
}

fn smoothing(w: f64) -> f64 {
    1.0 - (-5.0 * w * DT_S).exp()
}

fn pid(w: f64) -> (f64, f64, f64) {
    (w * w, 1.7 * w, 0.08 * w * w * w)
}

/// One sample: readouts at `t_k`, and commands from `t_k` on.
#[derive(Clone, Copy, Debug, Default)]
pub struct Record {
    /// Capacitive displacement, ORF, m.
    pub is_r_m: [[f64; 3]; 2],
    /// Capacitive angles, ORF, rad.
    pub is_angle_rad: [[f64; 3]; 2],
    /// Interferometer, ORF, m.
    pub ifo_x_m: [f64; 2],
    /// Local wavefront sensing, θ and ψ, ORF, rad.
    pub dws_tm_rad: [[f64; 2]; 2],
    /// Long-arm wavefront sensing, CRF, rad.
    pub dws_sc_rad: [f64; 3],
    /// Thrust, SRF, N.
    pub force_n: [f64; 3],
    /// Torque, SRF, N m.
    pub torque_nm: [f64; 3],
    /// Electrostatic force, ORF, N.
    pub electrostatic_n: [[f64; 3]; 2],
    /// Temperatures left and right of test mass 1, and of the battery, which has no effect, K.
    pub temperature_k: [f64; 3],
    /// Current of the power bus, A.
    pub bus_a: f64,
    /// Temperature of the solar panel, K.
    pub panel_k: f64,
    /// Magnetic field, SRF, T.
    pub field_t: [f64; 3],
}

/// xorshift64* and Box–Muller.
#[derive(Clone, Debug)]
pub(super) struct Dice {
    state: u64,
    kept: Option<f64>,
}

impl Dice {
    pub(super) fn new(seed: u64) -> Self {
        Self { state: seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1, kept: None }
    }

    /// Uniform between 0 and 1.
    pub(super) fn uniform(&mut self) -> f64 {
        self.state ^= self.state >> 12;
        self.state ^= self.state << 25;
        self.state ^= self.state >> 27;
        ((self.state.wrapping_mul(0x2545_f491_4f6c_dd1d) >> 11) as f64 + 0.5) / (1u64 << 53) as f64
    }

    /// White noise of a one-sided amplitude density, sampled at the loop's rate.
    fn white(&mut self, density: f64) -> f64 {
        let unit = self.kept.take().unwrap_or_else(|| {
            let (radius, turn) = ((-2.0 * self.uniform().ln()).sqrt(), std::f64::consts::TAU * self.uniform());
            self.kept = Some(radius * turn.sin());
            radius * turn.cos()
        });
        density * (RATE_HZ / 2.0).sqrt() * unit
    }

    /// Standard normal deviate.
    fn normal(&mut self) -> f64 {
        self.white((2.0 / RATE_HZ).sqrt())
    }

    /// Next sample of an Ornstein–Uhlenbeck process (Euler step).
    fn relax(&mut self, value: f64, relaxation_s: f64, sigma: f64) -> f64 {
        value - value * DT_S / relaxation_s + sigma * (2.0 * DT_S / relaxation_s).sqrt() * self.normal()
    }
}

#[derive(Clone, Copy, Debug, Default)]
struct Loop {
    filtered: f64,
    sum: f64,
}

impl Loop {
    fn acceleration(&mut self, w: f64, y: f64) -> f64 {
        let before = self.filtered;
        self.filtered += smoothing(w) * (y - before);
        self.sum += self.filtered * DT_S;
        let (p, d, i) = pid(w);
        -(p * self.filtered + d * (self.filtered - before) / DT_S + i * self.sum)
    }
}

const SC_KG: f64 = 1500.0;
const TM_KG: f64 = 1.96;
/// Noise of the electrodes' force along y and z, N/√Hz.
const ELECTRODES_N: f64 = 2e-14;
const INERTIA: [[f64; 3]; 3] = [[800.0, 13.0, 10.0], [13.0, 800.0, 12.0], [10.0, 12.0, 1000.0]];
/// Force per displacement and mass, s⁻².
const STIFFNESS: [f64; 3] = [-6e-7, -10e-7, -12e-7];
/// Self-gravity, m/s².
const PULL: [[f64; 3]; 2] = [[2e-10, -7e-10, 5e-10], [-1e-10, 8e-10, -6e-10]];

/// Components in `ORF_i` of a vector in SRF.
fn to_orf(i: usize, v: [f64; 3]) -> [f64; 3] {
    let (s, c) = (if i == 0 { std::f64::consts::FRAC_PI_6 } else { -std::f64::consts::FRAC_PI_6 }).sin_cos();
    [c * v[0] + s * v[1], -s * v[0] + c * v[1], v[2]]
}

/// Components in SRF of a vector in `ORF_i`.
fn to_srf(i: usize, v: [f64; 3]) -> [f64; 3] {
    let (s, c) = (if i == 0 { std::f64::consts::FRAC_PI_6 } else { -std::f64::consts::FRAC_PI_6 }).sin_cos();
    [c * v[0] - s * v[1], s * v[0] + c * v[1], v[2]]
}

fn cross(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

fn times(m: [[f64; 3]; 3], v: [f64; 3]) -> [f64; 3] {
    m.map(|row| row[0] * v[0] + row[1] * v[1] + row[2] * v[2])
}

/// `M⁻¹ v` by Cramer's rule.
fn solve(m: [[f64; 3]; 3], v: [f64; 3]) -> [f64; 3] {
    let columns = |k: usize| -> [f64; 3] { [m[0][k], m[1][k], m[2][k]] };
    let dot = |a: [f64; 3], b: [f64; 3]| a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
    let (a, b, c) = (columns(0), columns(1), columns(2));
    let det = dot(a, cross(b, c));
    [dot(v, cross(b, c)) / det, dot(a, cross(v, c)) / det, dot(a, cross(b, v)) / det]
}

impl Flight {
    /// `b_i`, `ORF_i`, m.
    #[must_use]
    pub fn offset_orf_m(&self, i: usize) -> [f64; 3] {
        let y = if i == 0 { 0.18 } else { -0.18 };
        to_orf(i, [self.shift_srf_m[0], y + self.shift_srf_m[1], self.shift_srf_m[2]])
    }
}

/// Runs the simulation and returns one record per sample.
#[must_use]
pub fn fly(flight: &Flight) -> Vec<Record> {
    Spacecraft::new(flight, &Variation::NONE).collect()
}

/// The simulation as an iterator over its recorded samples; days of data need no memory.
#[derive(Clone, Debug)]
pub struct Spacecraft {
    flight: Flight,
    variation: Variation,
    offset_m: [[f64; 3]; 2],
    angle_rad: [f64; 3],
    rate_rad_s: [f64; 3],
    r_m: [[f64; 3]; 2],
    v_m_s: [[f64; 3]; 2],
    /// Random walk of the acceleration of each test mass, m/s².
    slow_m_s2: [[f64; 3]; 2],
    loops: [Loop; 9],
    dice: Dice,
    /// Random streams of their own, so that temperatures, power and strays do not change the noise.
    weather: Dice,
    power: Dice,
    strays: Dice,
    magnet: Dice,
    temperature_k: [f64; 3],
    felt_k: f64,
    bus_slow_a: f64,
    load_on: bool,
    panel_slow_k: f64,
    field_slow_t: [f64; 3],
    /// Momentum that is still to be transferred to a test mass, N s.
    left_n_s: f64,
    /// Samples, those before the first recorded one included.
    k: usize,
    settle: usize,
    end: usize,
}

impl Spacecraft {
    /// A flight from its start, before the first recorded sample.
    #[must_use]
    pub fn new(flight: &Flight, variation: &Variation) -> Self {
        let [settle, keep] = [SETTLE_S, flight.seconds].map(|s| (s * RATE_HZ) as usize);
        let stream = |i: u64| Dice::new(flight.seed + i * 1_000_000);
        Self {
            flight: *flight,
            variation: *variation,
            offset_m: [flight.offset_orf_m(0), flight.offset_orf_m(1)],
            angle_rad: [0.0; 3],
            rate_rad_s: [0.0; 3],
            r_m: [[0.0; 3]; 2],
            v_m_s: [[0.0; 3]; 2],
            slow_m_s2: [[0.0; 3]; 2],
            loops: [Loop::default(); 9],
            dice: stream(0),
            weather: stream(1),
            power: stream(2),
            strays: stream(3),
            magnet: stream(4),
            temperature_k: [0.0; 3],
            felt_k: 0.0,
            bus_slow_a: 0.0,
            load_on: false,
            panel_slow_k: 0.0,
            field_slow_t: [0.0; 3],
            left_n_s: 0.0,
            k: 0,
            settle,
            end: settle + keep,
        }
    }

    /// Adds the errors of the start when their time has come.
    fn begin(&mut self) {
        let Start { before_s, displacement_m, attitude_rad } = self.variation.start;
        if self.k == self.settle - (before_s * RATE_HZ) as usize {
            for (r, error) in self.r_m.iter_mut().flatten().zip(displacement_m.iter().flatten()) {
                *r += error;
            }
            for (angle, error) in self.angle_rad.iter_mut().zip(attitude_rad) {
                *angle += error;
            }
        }
    }

    /// Readouts of the state.
    fn read(&mut self) -> Record {
        let (flight, hidden, dice) = (&self.flight, &self.flight.hidden, &mut self.dice);
        let mut record =
            Record { dws_sc_rad: self.angle_rad.map(|a| a + dice.white(flight.dws_rad)), ..Record::default() };
        for (i, r) in self.r_m.iter().enumerate() {
            record.ifo_x_m[i] = r[0] + dice.white(flight.ifo_m);
            let beside = times(hidden.shown[i], *r);
            record.is_r_m[i] =
                std::array::from_fn(|a| r[a] + beside[a] + hidden.is_noise[i][a] * dice.white(flight.is_m));
            record.is_angle_rad[i] = [0.0; 3].map(|x: f64| x + dice.white(1.5e-7));
            record.dws_tm_rad[i] = [0.0; 2].map(|x: f64| x + dice.white(1e-9));
        }
        record
    }

    /// Temperatures and power until this sample, and what housekeeping shows of them.
    fn keep_house(&mut self, record: &mut Record) {
        for t in &mut self.temperature_k {
            *t = self.weather.relax(*t, HEAT_S, HEAT_K);
        }
        let lag_s = self.flight.hidden.heat.map_or(HEAT_LAG_S, |heat| heat.lag_s);
        self.felt_k += (self.temperature_k[0] - self.temperature_k[1] - self.felt_k) * DT_S / lag_s;
        record.temperature_k =
            self.temperature_k.map(|t| 293.0 + t + self.weather.white(1e-5 * (2.0 / RATE_HZ).sqrt()));
        self.bus_slow_a = self.power.relax(self.bus_slow_a, BUS_S, BUS_SLOW_A);
        self.panel_slow_k = self.power.relax(self.panel_slow_k, PANEL_S, PANEL_SLOW_K);
        self.load_on ^= self.power.uniform() < DT_S / LOAD_S;
        record.bus_a = self.bus_a() + 1e-3 * self.power.normal();
        record.panel_k = PANEL_K + self.panel_slow_k + 1e-3 * self.power.normal();
        for b in &mut self.field_slow_t {
            *b = self.magnet.relax(*b, FIELD_S, FIELD_SLOW_T);
        }
        record.field_t = self.field_t().map(|b| b + 2e-9 * self.magnet.normal());
    }

    fn field_t(&self) -> [f64; 3] {
        std::array::from_fn(|a| FIELD_T[a] + self.field_slow_t[a])
    }

    /// Gain error of the electrodes of a test mass, or of the thrusters, along an axis now.
    fn gain_now(&self, test_mass: Option<usize>, axis: usize) -> f64 {
        let own = self.flight.hidden.gain_by_panel.filter(|g| (g.test_mass, g.axis) == (test_mass, axis));
        own.map_or(0.0, |gain| gain.per_k * self.panel_slow_k)
    }

    fn bus_a(&self) -> f64 {
        BUS_A + self.bus_slow_a + if self.load_on { LOAD_A } else { 0.0 }
    }

    /// Time since the first recorded sample, s; negative before it.
    fn time_s(&self) -> f64 {
        (self.k as f64 - self.settle as f64) * DT_S
    }

    /// Whether the impulse falls into this sample.
    fn is_hit(&self, blow: &Blow) -> bool {
        self.k == self.settle + (blow.at_s * RATE_HZ) as usize
    }

    /// Thrust and torque that act, SRF, with noise, sunlight and a hit.
    fn thrust(&mut self, record: &Record) -> ([f64; 3], [f64; 3]) {
        let (flight, hidden) = (self.flight, self.flight.hidden);
        let sunlight = [flight.sunlight_n, 0.0, 0.0];
        let sunlight_torque = cross([0.1, 0.0, 0.6], sunlight);
        let turned = cross(hidden.thrust_tilt_rad, record.force_n);
        let days = self.time_s() / 86_400.0;
        let mut force: [f64; 3] = std::array::from_fn(|a| {
            let noise = hidden.thrust_noise[a] * self.dice.white(flight.thrust_n);
            let gain = hidden.thrust_gain[a] + hidden.thrust_gain_per_day[a] * days + self.gain_now(None, a);
            record.force_n[a] + sunlight[a] + noise + gain * record.force_n[a] + turned[a]
        });
        if let Some((axis, per_a)) = hidden.current_on_spacecraft {
            force[axis] += per_a * (self.bus_a() - BUS_A);
        }
        if let Some(blow) = hidden.blow.filter(|blow| blow.test_mass.is_none() && self.is_hit(blow)) {
            force[blow.axis] += blow.momentum_n_s / DT_S;
        }
        if let Some(line) = hidden.line {
            force[line.axis] += line.force_n * (std::f64::consts::TAU * line.hz * self.time_s()).sin();
        }
        let torque = std::array::from_fn(|a| {
            let noise = hidden.torque_noise[a] * self.dice.white(flight.torque_nm);
            record.torque_nm[a] + sunlight_torque[a] + noise + hidden.torque_gain[a] * record.torque_nm[a]
        });
        (force, torque)
    }

    /// Acceleration of each test mass by hidden forces, ORF.
    fn hidden_acceleration(&mut self) -> [[f64; 3]; 2] {
        let mut all = [[0.0; 3]; 2];
        let hidden = self.flight.hidden;
        if let Some(heat) = hidden.heat {
            all[heat.test_mass][heat.axis] += heat.per_k * self.felt_k;
        }
        if let Some((i, axis, size)) = hidden.current_squared {
            all[i][axis] += size * self.bus_a().powi(2);
        }
        if let Some((i, axis, size)) = hidden.current_by_panel {
            all[i][axis] += size * (self.bus_a() - BUS_A) * self.panel_slow_k;
        }
        if let Some((i, axis, sizes)) = hidden.field_squared {
            all[i][axis] += sizes.iter().zip(self.field_t()).map(|(size, b)| size * b * b).sum::<f64>();
        }
        if let Some((blow, i)) = hidden.blow.and_then(|blow| Some((blow, blow.test_mass?))) {
            if self.is_hit(&blow) {
                self.left_n_s = blow.momentum_n_s;
            }
            let part = if blow.decay_s > 0.0 { 1.0 - (-DT_S / blow.decay_s).exp() } else { 1.0 };
            all[i][blow.axis] += self.left_n_s * part / DT_S / TM_KG;
            self.left_n_s -= self.left_n_s * part;
        }
        all
    }

    /// Stray acceleration of a test mass along an axis, and the slow part of the electrodes' noise. White noise of ASD
    /// `a` with a corner `c` is that and a random walk of ASD `a c/f`, whose steps have the variance `(2π a c)² dt/2`.
    fn stray(&mut self, i: usize, axis: usize) -> f64 {
        let Variation { stray_m_s2, corners_hz: [stray_hz, electrodes_hz], .. } = self.variation;
        let electrodes = if axis > 0 { electrodes_hz * ELECTRODES_N / TM_KG } else { 0.0 };
        let step = std::f64::consts::TAU * (stray_hz * stray_m_s2).hypot(electrodes) * (0.5 * DT_S).sqrt();
        self.slow_m_s2[i][axis] += step * self.strays.normal();
        self.slow_m_s2[i][axis] + self.strays.white(stray_m_s2)
    }

    /// Everything is constant until the next sample.
    fn step(&mut self, record: &Record) {
        let (force, torque) = self.thrust(record);
        let hidden = self.hidden_acceleration();
        let electrostatic: [[f64; 3]; 2] = std::array::from_fn(|i| {
            let (commanded, beside) =
                (record.electrostatic_n[i], times(self.flight.hidden.electrodes[i], record.electrostatic_n[i]));
            std::array::from_fn(|a| commanded[a] * (1.0 + self.gain_now(Some(i), a)) + beside[a])
        });
        let (mut on_spacecraft, mut torque_on_spacecraft) = (force, torque);
        for (i, acting) in electrostatic.iter().enumerate() {
            // Recoil of the electrodes.
            let (back, twist) = (to_srf(i, *acting), to_srf(i, cross(self.offset_m[i], *acting)));
            for a in 0..3 {
                on_spacecraft[a] -= back[a];
                torque_on_spacecraft[a] -= twist[a];
            }
        }
        let alpha = solve(INERTIA, torque_on_spacecraft);
        let spacecraft = on_spacecraft.map(|f| f / SC_KG);
        for i in 0..2 {
            let (carried, swing) = (to_orf(i, spacecraft), cross(to_orf(i, alpha), self.offset_m[i]));
            for a in 0..3 {
                let force_n = electrostatic[i][a] + if a > 0 { self.dice.white(ELECTRODES_N) } else { 0.0 };
                let stray = hidden[i][a] + self.stray(i, a);
                let (r, v) = (&mut self.r_m[i][a], &mut self.v_m_s[i][a]);
                let acceleration = stray + force_n / TM_KG - carried[a] - swing[a] + STIFFNESS[a] * *r + PULL[i][a];
                *r += *v * DT_S + 0.5 * acceleration * DT_S * DT_S;
                *v += acceleration * DT_S;
            }
        }
        for (a, alpha) in alpha.into_iter().enumerate() {
            self.angle_rad[a] += self.rate_rad_s[a] * DT_S + 0.5 * alpha * DT_S * DT_S;
            self.rate_rad_s[a] += alpha * DT_S;
        }
    }
}

impl Iterator for Spacecraft {
    type Item = Record;

    fn next(&mut self) -> Option<Record> {
        while self.k < self.end {
            self.begin();
            let mut record = self.read();
            self.keep_house(&mut record);
            control(&mut self.loops, &self.flight.loops, self.variation.attitude, &mut record);
            self.step(&record);
            self.k += 1;
            if self.k > self.settle {
                return Some(record);
            }
        }
        None
    }
}

/// Nine loops and their actuators.
fn control(loops: &mut [Loop; 9], bandwidths: &Loops, attitude: [f64; 3], record: &mut Record) {
    let mut wanted = |k: usize, w: f64, y: f64| loops[k].acceleration(w, y);
    let turn = [0, 1, 2].map(|k| wanted(k, attitude[k] * bandwidths.attitude, record.dws_sc_rad[k]));
    record.torque_nm = times(INERTIA, turn);
    let x = [0, 1].map(|i| wanted(3 + i, bandwidths.x, record.ifo_x_m[i]));
    let y = [0, 1].map(|i| wanted(5 + i, bandwidths.y, record.is_r_m[i][1]));
    let z = [0, 1].map(|i| wanted(7 + i, bandwidths.z, record.is_r_m[i][2]));
    let (s, c) = std::f64::consts::FRAC_PI_6.sin_cos();
    // ẍ_1 = −(c F_x + s F_y)/m, ẍ_2 = −(c F_x − s F_y)/m; along z the thrusters take the mean.
    record.force_n =
        [-SC_KG * (x[0] + x[1]) / (2.0 * c), -SC_KG * (x[0] - x[1]) / (2.0 * s), -SC_KG * (z[0] + z[1]) / 2.0];
    for i in 0..2 {
        let carried = to_orf(i, record.force_n.map(|f| f / SC_KG));
        record.electrostatic_n[i] = [0.0, TM_KG * (y[i] + carried[1]), TM_KG * (z[i] + carried[2])];
    }
}
