//! Response of the thrusters to a command: range, step, delay and lag, per axis or per unit of a layout. The noise of a
//! unit is a correlated force and torque.

use dragfree_physics::lag::Lag;
use dragfree_physics::mission::{self, MissionError};
use dragfree_physics::noise::NoiseShape;
use dragfree_physics::process::NoiseProcess;
use nalgebra::{DMatrix, DVector, Matrix6, Vector3, Vector6};
use rand::SeedableRng;
use rand_xoshiro::Xoshiro256PlusPlus;
use serde::{Deserialize, Serialize};
use std::collections::VecDeque;

/// Force and torque of the axes, or thrusts of the units, N and N m.
type Channels = DVector<f64>;

/// Force on the spacecraft, SRF, N, above its torque about the centre of mass, N m.
type Wrench = Vector6<f64>;

/// Positions and directions of the thrusters.
#[derive(Clone, Debug)]
pub struct Layout {
    /// Column `i`: wrench of a thrust of 1 N of unit `i`, `(d_i, r_i × d_i)`.
    wrenches: DMatrix<f64>,
    asd_n_rthz: Vec<f64>,
}

impl Layout {
    /// A layout of units; directions of any length but zero.
    ///
    /// # Errors
    /// [`MissionError::Value`]: fewer than six independent units.
    pub fn new(units: &[mission::ThrusterUnit]) -> Result<Self, MissionError> {
        let columns: Vec<Wrench> = units
            .iter()
            .map(|unit| {
                let direction = Vector3::from(unit.direction_srf).normalize();
                wrench(&direction, &Vector3::from(unit.position_srf_m).cross(&direction))
            })
            .collect();
        let wrenches = DMatrix::from_fn(6, columns.len(), |i, j| columns[j][i]);
        // Levers below a millimetre do not count.
        if wrenches.rank(1e-3) < 6 {
            return Err(MissionError::Value {
                key: "thrusters.unit".to_owned(),
                value: format!("{} units", units.len()),
                reason: "must push along and turn about all three axes: six independent units at least",
            });
        }
        Ok(Self { wrenches, asd_n_rthz: units.iter().map(|u| u.asd_n_rthz).collect() })
    }

    /// Six units in three pairs 1.5 m from the axis `s_3` and 0.35 m above the centre of mass, thrusting along the rim
    /// in both directions and 35° upwards, towards the Sun. Sunlight provides the opposite force along `s_3`.
    pub fn six(asd_n_rthz: f64) -> Self {
        let unit = |k: usize| {
            let (sine, cosine) = (60.0 + 120.0 * (k / 2) as f64).to_radians().sin_cos();
            let (up, along) = 35.0_f64.to_radians().sin_cos();
            let side = if k.is_multiple_of(2) { along } else { -along };
            let (direction, position) =
                (Vector3::new(-side * sine, side * cosine, up), Vector3::new(1.5 * cosine, 1.5 * sine, 0.35));
            wrench(&direction, &position.cross(&direction))
        };
        Self { wrenches: DMatrix::from_fn(6, 6, |i, j| unit(j)[i]), asd_n_rthz: vec![asd_n_rthz; 6] }
    }

    /// One-sided PSD of force and torque noise together, `Σ S_i (d_i, r_i×d_i)(d_i, r_i×d_i)ᵀ`, SRF, N²/Hz and so on.
    pub fn noise_psd(&self) -> Matrix6<f64> {
        let psd = DMatrix::from_diagonal(&DVector::from_iterator(
            self.asd_n_rthz.len(),
            self.asd_n_rthz.iter().map(|asd| asd * asd),
        ));
        let whole = &self.wrenches * psd * self.wrenches.transpose();
        Matrix6::from_fn(|i, j| whole[(i, j)])
    }
}

fn wrench(force: &Vector3<f64>, torque: &Vector3<f64>) -> Wrench {
    Wrench::from_fn(|i, _| if i < 3 { force[i] } else { torque[i - 3] })
}

fn force_and_torque(wrench: &Wrench) -> (Vector3<f64>, Vector3<f64>) {
    (wrench.fixed_rows::<3>(0).into_owned(), wrench.fixed_rows::<3>(3).into_owned())
}

/// Noise of the units of a layout, each on its own.
#[derive(Clone, Debug)]
pub struct ThrusterNoise {
    layout: Layout,
    units: Vec<NoiseProcess>,
}

impl ThrusterNoise {
    /// White noise of every unit, sampled every `dt_s`; the random stream is its only state.
    pub fn new(layout: Layout, dt_s: f64) -> Self {
        let units = layout.asd_n_rthz.iter().map(|asd| NoiseProcess::new(&NoiseShape::white(*asd), dt_s)).collect();
        Self { layout, units }
    }

    /// The next sample of force, N, and torque, N m, SRF.
    pub fn sample(&mut self, rng: &mut Xoshiro256PlusPlus) -> (Vector3<f64>, Vector3<f64>) {
        let mut sum = Wrench::zeros();
        for (unit, column) in self.units.iter_mut().zip(self.layout.wrenches.column_iter()) {
            sum += column.fixed_rows::<6>(0) * unit.next(rng);
        }
        force_and_torque(&sum)
    }
}

/// Thrusts that add up to a wanted wrench, as close to the middle of their range as possible.
#[derive(Clone, Debug)]
struct Distribution {
    wrenches: DMatrix<f64>,
    inverse: DMatrix<f64>,
    range_n: [f64; 2],
}

impl Distribution {
    fn new(wrenches: &DMatrix<f64>, range_n: [f64; 2]) -> Self {
        Self { inverse: least_norm(wrenches), wrenches: wrenches.clone(), range_n }
    }

    /// The thrusts, and whether they give the wanted wrench. Units whose least-norm thrust is out of range are held at
    /// their limit and the others compensate (cascaded generalised inverses, Bordignon 1996).
    fn thrusts(&self, wanted: &Wrench) -> (Channels, bool) {
        let [low, high] = self.range_n;
        let n = self.wrenches.ncols();
        let mut out = Channels::from_element(n, 0.5 * (low + high));
        let mut free: Vec<usize> = (0..n).collect();
        loop {
            let missing = wanted - &self.wrenches * &out;
            let change = if free.len() == n {
                &self.inverse * missing
            } else {
                least_norm(&self.wrenches.select_columns(&free)) * missing
            };
            for (k, unit) in free.iter().enumerate() {
                out[*unit] += change[k];
            }
            let beyond = |unit: &usize| out[*unit] < low || out[*unit] > high;
            if !free.iter().any(beyond) {
                return (out, true);
            }
            free.retain(|unit| !beyond(unit));
            out.apply(|x| *x = x.clamp(low, high));
            if free.len() < 6 {
                return (out, false);
            }
            for unit in &free {
                out[*unit] = 0.5 * (low + high);
            }
        }
    }
}

/// `Gᵀ(GGᵀ)⁺`.
fn least_norm(wrenches: &DMatrix<f64>) -> DMatrix<f64> {
    wrenches.clone().pseudo_inverse(1e-9).unwrap_or_else(|_| DMatrix::zeros(wrenches.ncols(), 6))
}

/// The running units of a layout.
#[derive(Clone, Debug)]
struct Units {
    distribution: Distribution,
    noise: ThrusterNoise,
    rng: Xoshiro256PlusPlus,
}

/// The thrusters of a mission.
#[derive(Clone, Debug)]
pub struct Thrusters {
    units: Option<Units>,
    limit_n: [f64; 2],
    step_n: f64,
    lag: Lag,
    /// Output of the lag, and the commands of the delay, oldest first; empty before the first one.
    y: Channels,
    waiting: VecDeque<Channels>,
    saturated: bool,
}

/// The state of [`Thrusters`].
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct SavedThrusters {
    y: Vec<f64>,
    waiting: Vec<Vec<f64>>,
    rng: Option<Xoshiro256PlusPlus>,
}

impl Thrusters {
    /// The thrusters of `[thrusters]`, sampled every `dt_s`.
    ///
    /// # Errors
    /// [`MissionError::Value`]: a layout that cannot push along and turn about every axis.
    pub fn new(section: &mission::Thrusters, dt_s: f64, seed: u64) -> Result<Self, MissionError> {
        let high = section.max_n.unwrap_or(f64::INFINITY);
        let limit_n = if section.unit.is_empty() { [-high, high] } else { [section.min_n, high] };
        let units = if section.unit.is_empty() {
            None
        } else {
            let layout = Layout::new(&section.unit)?;
            let distribution = Distribution::new(&layout.wrenches, limit_n);
            // The fourth stream of the seed; loop and housekeeping use the first three.
            let mut rng = Xoshiro256PlusPlus::seed_from_u64(seed);
            rng.long_jump();
            rng.jump();
            Some(Units { distribution, noise: ThrusterNoise::new(layout, dt_s), rng })
        };
        Ok(Self {
            y: Channels::zeros(if units.is_some() { section.unit.len() } else { 6 }),
            units,
            limit_n,
            step_n: section.step_n,
            lag: Lag::new(section.lag_s, section.delay_s, dt_s),
            waiting: VecDeque::new(),
            saturated: false,
        })
    }

    /// Mean force, N, and torque, N m, SRF, over the sample for which they are commanded; with a layout its noise too.
    pub fn act(&mut self, force_srf_n: &Vector3<f64>, torque_srf_nm: &Vector3<f64>) -> (Vector3<f64>, Vector3<f64>) {
        let command = self.command(&wrench(force_srf_n, torque_srf_nm));
        if self.waiting.is_empty() {
            // Start settled at the first command.
            self.y = command.clone();
            self.waiting.extend(std::iter::repeat_n(command.clone(), self.lag.samples() + 1));
        }
        self.waiting.push_back(command);
        let (older, newer) = (&self.waiting[0], &self.waiting[1]);
        let thrusts = Channels::from_fn(self.y.len(), |i, _| self.lag.step(&mut self.y[i], older[i], newer[i]));
        self.waiting.pop_front();
        match &mut self.units {
            None => force_and_torque(&Wrench::from_fn(|i, _| thrusts[i])),
            Some(Units { distribution, noise, rng }) => {
                let whole = &distribution.wrenches * thrusts;
                let (force, torque) = force_and_torque(&whole.fixed_rows::<6>(0).into_owned());
                let (more_force, more_torque) = noise.sample(rng);
                (force + more_force, torque + more_torque)
            }
        }
    }

    /// Whether the last command was out of range.
    pub fn saturated(&self) -> bool {
        self.saturated
    }

    /// The command limited to the range and rounded to steps; along axes, limit and step apply to forces only.
    fn command(&mut self, wanted: &Wrench) -> Channels {
        let [low, high] = self.limit_n;
        let step_n = self.step_n;
        let stepped = |x: f64| if step_n > 0.0 { ((x / step_n).round() * step_n).clamp(low, high) } else { x };
        match &self.units {
            Some(Units { distribution, .. }) => {
                let (thrusts, reached) = distribution.thrusts(wanted);
                self.saturated = !reached;
                thrusts.map(stepped)
            }
            None => {
                self.saturated = (0..3).any(|i| wanted[i].abs() > high);
                Channels::from_fn(6, |i, _| if i < 3 { stepped(wanted[i].clamp(low, high)) } else { wanted[i] })
            }
        }
    }

    /// The state, for a checkpoint.
    pub fn save(&self) -> SavedThrusters {
        SavedThrusters {
            y: self.y.as_slice().to_vec(),
            waiting: self.waiting.iter().map(|w| w.as_slice().to_vec()).collect(),
            rng: self.units.as_ref().map(|units| units.rng.clone()),
        }
    }

    /// Restores [`Self::save`]; false for a state of another mission.
    pub fn load(&mut self, saved: SavedThrusters) -> bool {
        let n = self.y.len();
        let queue = [0, self.lag.samples() + 1].contains(&saved.waiting.len());
        if saved.y.len() != n || !queue || saved.waiting.iter().any(|w| w.len() != n) {
            return false;
        }
        match (&mut self.units, saved.rng) {
            (Some(units), Some(rng)) => units.rng = rng,
            (None, None) => {}
            _ => return false,
        }
        self.y = Channels::from_vec(saved.y);
        self.waiting = saved.waiting.into_iter().map(Channels::from_vec).collect();
        true
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use dragfree_physics::mission::Mission;

    const DT_S: f64 = 0.1;

    fn nine() -> mission::Thrusters {
        let value: serde_json::Value =
            toml::from_str(include_str!("../../fixtures/missions/taiji-thrusters.toml")).unwrap();
        Mission::from_json(&value.to_string()).unwrap().thrusters.unwrap()
    }

    fn axes(lag_s: f64, delay_s: f64) -> mission::Thrusters {
        mission::Thrusters { lag_s, delay_s, min_n: 0.0, max_n: None, step_n: 0.0, unit: Vec::new() }
    }

    /// What has to be held against sunlight of 63.5 µN that comes 30° off `s_3`, at any time of the year.
    fn sunlight(azimuth_deg: f64) -> (Vector3<f64>, Vector3<f64>) {
        let (sine, cosine) = azimuth_deg.to_radians().sin_cos();
        let force = Vector3::new(-0.5 * cosine, -0.5 * sine, 3.0_f64.sqrt() / 2.0) * 63.5e-6;
        (force, Vector3::new(0.1, 0.0, 0.6).cross(&force))
    }

    /// Two units that push along x, 1 m above and 2 m below the centre: `corr(F_x, M_y) = (1 − 2)/√(2·5)` by hand; and
    /// the samples of both layouts have `Σ d_i (r_i×d_i)ᵀ`: 40,000 samples, 4.5σ of a covariance, false alarm 7e-6 a
    /// number.
    #[test]
    fn noise_pushes_and_turns_at_once() {
        let unit = |z| mission::ThrusterUnit {
            position_srf_m: [0.0, 0.0, z],
            direction_srf: [1.0, 0.0, 0.0],
            asd_n_rthz: 1e-7,
        };
        let spread = |k: usize| mission::ThrusterUnit {
            position_srf_m: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]][k % 3],
            direction_srf: [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, -2.0]][k / 3 % 3],
            asd_n_rthz: 0.0,
        };
        let mut units = vec![unit(1.0), unit(-2.0)];
        units.extend((0..9).map(spread));
        let psd = Layout::new(&units).unwrap().noise_psd();
        let correlation = psd[(0, 4)] / (psd[(0, 0)] * psd[(4, 4)]).sqrt();
        assert!((correlation + 1.0 / 10.0_f64.sqrt()).abs() < 1e-12, "{correlation}");

        for layout in [Layout::six(1e-7), Layout::new(&nine().unit).unwrap()] {
            let wanted = layout.noise_psd() * (0.5 / DT_S);
            let mut noise = ThrusterNoise::new(layout, DT_S);
            let mut rng = Xoshiro256PlusPlus::seed_from_u64(3);
            let n = 40_000;
            let mut sum = Matrix6::<f64>::zeros();
            for _ in 0..n {
                let (force, torque) = noise.sample(&mut rng);
                let w = wrench(&force, &torque);
                sum += w * w.transpose();
            }
            for (i, j) in (0..6).flat_map(|i| (0..=i).map(move |j| (i, j))) {
                let sigma = ((wanted[(i, i)] * wanted[(j, j)] + wanted[(i, j)].powi(2)) / f64::from(n)).sqrt();
                let z = (sum[(i, j)] / f64::from(n) - wanted[(i, j)]) / sigma;
                assert!(z.abs() < 4.5, "{i} {j}: off by {z} sigma");
            }
            let most = (0..3).flat_map(|i| (0..3).map(move |j| (i, j))).map(|(i, j)| wanted[(i, 3 + j)].abs());
            assert!(most.fold(0.0, f64::max) > 0.2 * 5e-14, "axes drawn apart would show no covariance");
        }
    }

    /// A step and a ramp through lag and delay, against the closed form of `τ ẏ = u(t − delay) − y` in thin steps.
    #[test]
    fn lag_and_delay_are_exact() {
        for (lag_s, delay_s) in [(0.2, 0.2), (0.2, 0.05), (0.03, 0.23), (0.0, 0.13), (0.5, 0.0), (0.0, 0.0)] {
            let mut thrusters = Thrusters::new(&axes(lag_s, delay_s), DT_S, 1).unwrap();
            let told = |k: i64| if k < 0 { 1.0 } else { (k as f64 * 0.7).sin() + 1.0 };
            let (mut y, thin) = (told(0), 1000);
            for k in 0..40 {
                let force = Vector3::new(told(k), 0.0, 0.0);
                let (found, _) = thrusters.act(&force, &Vector3::zeros());
                let mut mean = 0.0;
                for i in 0..thin {
                    // Midway through each thin step; the first command has been there for ever.
                    let at_s = (k as f64 + (f64::from(i) + 0.5) / f64::from(thin)) * DT_S - delay_s;
                    let u = told(((at_s / DT_S).floor() as i64).max(0));
                    let h = DT_S / f64::from(thin);
                    let next = if lag_s > 0.0 { u + (y - u) * (-h / lag_s).exp() } else { u };
                    let within = if lag_s > 0.0 { u - (next - y) * lag_s / h } else { u };
                    mean += within / f64::from(thin);
                    y = next;
                }
                assert!((found.x - mean).abs() < 1e-11, "lag {lag_s}, delay {delay_s}, sample {k}: {found} {mean}");
            }
        }
    }

    /// Both layouts hold sunlight; the thrusts stay in range and make exactly what is wanted.
    #[test]
    fn a_layout_makes_what_is_wanted_within_its_range() {
        let range = [2e-6, 3e-5];
        let lisa = Layout::new(&nine().unit).unwrap();
        for azimuth in (0..360).step_by(15) {
            let (force, torque) = sunlight(f64::from(azimuth));
            let wanted = wrench(&force, &torque);
            let (thrusts, reached) = Distribution::new(&lisa.wrenches, range).thrusts(&wanted);
            assert!(reached && thrusts.iter().all(|t| (range[0]..=range[1]).contains(t)), "{azimuth}: {thrusts}");
            assert!((&lisa.wrenches * thrusts - wanted).amax() < 1e-18);
        }
        // As on LISA Pathfinder, the Sun stands where the six can lean on it; from the other side they cannot pull.
        let range = [5e-7, 3.1e-5];
        let pathfinder = Distribution::new(&Layout::six(1e-7).wrenches, range);
        for azimuth in (0..360).step_by(15) {
            let (force, torque) = sunlight(f64::from(azimuth));
            assert!(pathfinder.thrusts(&wrench(&force, &torque)).1, "{azimuth}");
            let (thrusts, reached) = pathfinder.thrusts(&wrench(&-force, &torque));
            assert!(!reached && thrusts.iter().all(|t| (range[0]..=range[1]).contains(t)), "{azimuth}");
        }
    }

    #[test]
    fn limit_and_step_act_along_the_axes() {
        let section = mission::Thrusters { max_n: Some(5e-6), step_n: 1e-6, ..axes(0.0, 0.0) };
        let mut thrusters = Thrusters::new(&section, DT_S, 1).unwrap();
        let (force, torque) = thrusters.act(&Vector3::new(2.4e-6, -9e-6, 2.6e-6), &Vector3::new(1e-9, 0.0, 0.0));
        assert!((force - Vector3::new(2e-6, -5e-6, 3e-6)).amax() < 1e-18 && torque.x == 1e-9);
        assert!(thrusters.saturated());
        thrusters.act(&Vector3::zeros(), &Vector3::zeros());
        assert!(!thrusters.saturated());
    }

    #[test]
    fn thrusters_that_cannot_turn_are_refused() {
        let mut section = nine();
        section.unit.truncate(5);
        let error = Thrusters::new(&section, DT_S, 1).unwrap_err().to_string();
        assert!(error.contains("thrusters.unit") && error.contains("six independent"), "{error}");
    }
}
