//! A spacecraft with two test masses in a closed loop: small angles, forces constant over a step, exact integration.

/// Samples per second.
const RATE_HZ: f64 = 10.0;
const DT_S: f64 = 1.0 / RATE_HZ;
/// Settling time before the first recorded sample.
const SETTLE_S: f64 = 3_000.0;

/// A simulation: noise levels (one-sided amplitude densities), offsets, controllers.
#[derive(Clone, Copy, Debug)]
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

/// Differences from the mission file.
#[derive(Clone, Copy, Debug, Default)]
pub struct Hidden {
    /// Fraction of the electrodes' force along y of test mass 2 that acts along x.
    pub aside_tm2_y_x: f64,
    /// Gain error of the thrusters along y of SRF.
    pub thrust_y: f64,
    /// Scale error of the capacitive readout of y of test mass 1.
    pub shown_tm1_y: f64,
    /// Acceleration of test mass 1 along x per kelvin between the sides of its housing, lagged by [`HEAT_LAG_S`], m s⁻²
    /// K⁻¹.
    pub heat_tm1_x: f64,
    /// Impulse along x of SRF: time after the first sample, s, and momentum, N s.
    pub blow: Option<(f64, f64)>,
}

/// Lag between thermometer and force, s.
pub const HEAT_LAG_S: f64 = 700.0;
/// Relaxation time of the temperatures, s, and their standard deviation, K.
const HEAT_S: f64 = 1500.0;
const HEAT_K: f64 = 0.03;

/// Bandwidths of the loops, rad/s.
#[derive(Clone, Copy, Debug)]
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
}

/// xorshift64* and Box–Muller.
struct Dice {
    state: u64,
    kept: Option<f64>,
}

impl Dice {
    fn new(seed: u64) -> Self {
        Self { state: seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1, kept: None }
    }

    fn uniform(&mut self) -> f64 {
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
}

#[derive(Clone, Copy, Default)]
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

/// Offsets of a flight, `ORF_i`, m.
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
    let mut dice = Dice::new(flight.seed);
    let offset: [[f64; 3]; 2] = [flight.offset_orf_m(0), flight.offset_orf_m(1)];
    let (mut angle, mut rate) = ([0.0; 3], [0.0; 3]);
    let (mut r, mut v) = ([[0.0; 3]; 2], [[0.0; 3]; 2]);
    let mut loops = [Loop::default(); 9];
    let sunlight = [flight.sunlight_n, 0.0, 0.0];
    let sunlight_torque = cross([0.1, 0.0, 0.6], sunlight);
    let hidden = &flight.hidden;
    // A separate random stream, so that hidden effects do not change the noise.
    let mut weather = Dice::new(flight.seed + 1_000_000);
    let (mut temperature_k, mut felt_k) = ([0.0; 3], 0.0);
    let (settle, keep) = ((SETTLE_S * RATE_HZ) as usize, (flight.seconds * RATE_HZ) as usize);
    let mut records = Vec::with_capacity(keep);
    for k in 0..settle + keep {
        let mut record = Record { dws_sc_rad: angle.map(|a| a + dice.white(flight.dws_rad)), ..Record::default() };
        for i in 0..2 {
            record.ifo_x_m[i] = r[i][0] + dice.white(flight.ifo_m);
            let shown = if i == 0 { 1.0 + hidden.shown_tm1_y } else { 1.0 };
            record.is_r_m[i] = [r[i][0], shown * r[i][1], r[i][2]].map(|x| x + dice.white(flight.is_m));
            record.is_angle_rad[i] = [0.0; 3].map(|x: f64| x + dice.white(1.5e-7));
            record.dws_tm_rad[i] = [0.0; 2].map(|x: f64| x + dice.white(1e-9));
        }
        for t in &mut temperature_k {
            // Ornstein–Uhlenbeck step with relaxation time HEAT_S and standard deviation HEAT_K; unit deviates are
            // white of √(2/rate).
            *t += -*t * DT_S / HEAT_S + HEAT_K * (2.0 * DT_S / HEAT_S).sqrt() * weather.white((2.0 / RATE_HZ).sqrt());
        }
        felt_k += (temperature_k[0] - temperature_k[1] - felt_k) * DT_S / HEAT_LAG_S;
        record.temperature_k = temperature_k.map(|t| 293.0 + t + weather.white(1e-5 * (2.0 / RATE_HZ).sqrt()));
        control(&mut loops, &flight.loops, &mut record);
        if k >= settle {
            records.push(record);
        }
        // Everything is constant until the next sample.
        let mut force: [f64; 3] =
            std::array::from_fn(|a| record.force_n[a] + sunlight[a] + dice.white(flight.thrust_n));
        force[1] += hidden.thrust_y * record.force_n[1];
        if let Some((_, momentum)) = hidden.blow.filter(|(at_s, _)| k == settle + (at_s * RATE_HZ) as usize) {
            force[0] += momentum / DT_S;
        }
        let torque: [f64; 3] =
            std::array::from_fn(|a| record.torque_nm[a] + sunlight_torque[a] + dice.white(flight.torque_nm));
        let mut on_spacecraft = force;
        let mut torque_on_spacecraft = torque;
        for i in 0..2 {
            // Recoil of the electrodes.
            let back = to_srf(i, record.electrostatic_n[i]);
            let twist = to_srf(i, cross(offset[i], record.electrostatic_n[i]));
            for a in 0..3 {
                on_spacecraft[a] -= back[a];
                torque_on_spacecraft[a] -= twist[a];
            }
        }
        let alpha = solve(INERTIA, torque_on_spacecraft);
        let spacecraft = on_spacecraft.map(|f| f / SC_KG);
        for i in 0..2 {
            let (carried, swing) = (to_orf(i, spacecraft), cross(to_orf(i, alpha), offset[i]));
            for a in 0..3 {
                let electrostatic = record.electrostatic_n[i][a] + if a > 0 { dice.white(2e-14) } else { 0.0 };
                let stray = match (i, a) {
                    (0, 0) => hidden.heat_tm1_x * felt_k,
                    (1, 0) => hidden.aside_tm2_y_x * record.electrostatic_n[1][1] / TM_KG,
                    _ => 0.0,
                };
                let acceleration =
                    stray + electrostatic / TM_KG - carried[a] - swing[a] + STIFFNESS[a] * r[i][a] + PULL[i][a];
                r[i][a] += v[i][a] * DT_S + 0.5 * acceleration * DT_S * DT_S;
                v[i][a] += acceleration * DT_S;
            }
        }
        for a in 0..3 {
            angle[a] += rate[a] * DT_S + 0.5 * alpha[a] * DT_S * DT_S;
            rate[a] += alpha[a] * DT_S;
        }
    }
    records
}

/// Nine loops and their actuators.
fn control(loops: &mut [Loop; 9], bandwidths: &Loops, record: &mut Record) {
    let mut wanted = |k: usize, w: f64, y: f64| loops[k].acceleration(w, y);
    let turn = [0, 1, 2].map(|k| wanted(k, bandwidths.attitude, record.dws_sc_rad[k]));
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
