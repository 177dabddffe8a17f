//! Σ(f): the modelled cross-spectral matrix of the channels, from the mission's noise.
//!
//! Every process is a constant matrix (how it enters the channels) times its one-sided PSD times the response of the channel's
//! way of measuring. From displacements (`average = 2`) a mean acceleration over `[t_k, t_k+1)` is seen through
//! `(φ_{k−1}+φ_k)/2`, power response cos²(π f dt), and readout noise through the second difference, power response
//! (4 sin²(π f dt)/dt²)². Both are even in time about `t_k`, so Σ is real and symmetric.
//!
//! The shapes are those of the continuous processes: what aliases from above Nyquist is a matter of a factor near Nyquist, which
//! the refinement from residuals takes up (see `refine`).

use nalgebra::{DMatrix, Matrix3, Vector3};

use dragfree_physics::frames::skew;
use dragfree_physics::mission::{Mission, MissionError};
use dragfree_physics::noise::NoiseShape;
use dragfree_physics::thrust_noise::ThrustNoise;

use crate::spectra::{Band, Plan};

/// How a channel's samples come about.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Measured {
    /// Second difference of a displacement minus the mean known acceleration, `average = 2`.
    Differenced,
    /// An accelerometer, `average = 1`.
    Directly,
}

/// What a channel's name says.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Place {
    /// Acceleration of a test mass along an axis of its ORF.
    TestMass { mass: usize, axis: usize },
    /// Angular acceleration of the spacecraft about an axis of SRF.
    Spacecraft { axis: usize },
    /// Anything else.
    Elsewhere,
}

const AXES: [&str; 3] = ["x", "y", "z"];

fn place(channel: &str) -> Place {
    let axis = |name: &str| AXES.iter().position(|a| *a == name);
    let mut parts = channel.split('.');
    let words = (parts.next(), parts.next(), parts.next().and_then(axis), parts.next());
    match words {
        (Some("tm1"), Some("accel"), Some(axis), None) => Place::TestMass { mass: 0, axis },
        (Some("tm2"), Some("accel"), Some(axis), None) => Place::TestMass { mass: 1, axis },
        (Some("sc"), Some("alpha"), Some(axis), None) => Place::Spacecraft { axis },
        _ => Place::Elsewhere,
    }
}

/// Power response of a channel to a process.
#[derive(Clone, Copy, Debug)]
enum Response {
    /// An acceleration held over a sample, seen through the mean of two: cos²(π f dt).
    Held,
    /// A readout, differenced twice: (4 sin²(π f dt)/dt²)².
    Readout,
    /// Measured as it is.
    Flat,
}

struct Process {
    shape: NoiseShape,
    response: Response,
    enters: DMatrix<f64>,
}

/// A process that an effect may name.
struct Named {
    name: String,
    process: Process,
    /// What it turns the spacecraft by, SRF, over its shape; nothing for what turns nothing. What α̂ does not know of it moves the test
    /// masses.
    turns: Option<Vector3<f64>>,
}

/// What remains unknown of the angular acceleration once everything measured has been used, and how it enters the channels.
struct AngularError {
    /// `B`, rows of channels, columns of α in SRF: `[b×] T_S^O` in the rows of a test mass, and `−T_S^O C J/m` where the torque
    /// tells of a force.
    lever: DMatrix<f64>,
    /// `J⁻¹ S_M J⁻ᵀ` over the PSD of the torque's shape.
    disturbance: Matrix3<f64>,
    torque: NoiseShape,
    attitude: Option<NoiseShape>,
}

/// The noise model of a set of channels.
pub struct NoiseModel {
    channels: usize,
    /// Channels that are residuals of a known motion, so that nothing but noise is left in them.
    residual: Vec<bool>,
    dt_s: f64,
    processes: Vec<Process>,
    /// Processes that an effect may name, `thruster_force:sc.x`, each alone.
    named: Vec<Named>,
    angular_error: Option<AngularError>,
    /// Channels of whose noise the mission says nothing; they start as white with unit PSD and are measured.
    pub unknown: Vec<usize>,
}

impl NoiseModel {
    /// Builds the model for channels `(name, how it is measured)` sampled every `dt_s`.
    ///
    /// The lever of the remaining error of α̂ is the mission's nominal offset: the noise model alone uses it, the estimate does
    /// not, and an error of a few millimetres in 0.18 m changes a small part of Σ by a few per cent.
    ///
    /// # Errors
    /// [`MissionError::Missing`] when a channel belongs to a test mass that the mission does not have.
    pub fn new(mission: &Mission, channels: &[(&str, Measured)], dt_s: f64) -> Result<Self, MissionError> {
        const NEEDED_BY: &str = "the noise model of qp-check";
        let n = channels.len();
        let places: Vec<Place> = channels.iter().map(|(name, _)| place(name)).collect();
        let measured = |i: usize| channels[i].1;
        let residual = channels.iter().map(|(_, m)| *m == Measured::Differenced).collect();
        let mut model = Self {
            channels: n,
            residual,
            dt_s,
            processes: Vec::new(),
            named: Vec::new(),
            angular_error: None,
            unknown: Vec::new(),
        };
        let noise = &mission.noise;
        let single = |i: usize, weight: f64| {
            let mut m = DMatrix::zeros(n, n);
            m[(i, i)] = weight;
            m
        };

        // A force on the spacecraft moves it under every test mass: the same vector, in each ORF.
        let mut thrust = DMatrix::zeros(n, 3);
        let mut lever = DMatrix::zeros(n, 3);
        for (i, place) in places.iter().enumerate() {
            let Place::TestMass { mass, axis } = *place else { continue };
            let name = ["tm1", "tm2"][mass];
            if measured(i) == Measured::Directly && !mission.test_mass.contains_key(name) {
                continue;
            }
            let tm = mission.test_mass(name, NEEDED_BY)?;
            let dcm = tm.dcm_orf_from_srf();
            if measured(i) == Measured::Differenced {
                thrust.row_mut(i).copy_from(&(dcm.row(axis) / -mission.spacecraft.mass_kg));
            }
            lever.row_mut(i).copy_from(&(skew(&tm.offset_nominal_orf_m()) * dcm).row(axis));
        }
        // The known acceleration holds what the torque tells of the thrusters' force; the rest is noise.
        let thrusters = ThrustNoise::of(mission);
        if let Some(thrusters) = &thrusters {
            for (axis, name) in AXES.iter().enumerate() {
                let (column, level) = (thrust.column(axis), thrusters.force_given_torque[(axis, axis)]);
                let enters = column * column.transpose() * level;
                model.name(format!("thruster_force:sc.{name}"), &thrusters.force_shape, Response::Held, enters);
            }
            let left = &thrust * dynamic(&thrusters.force_given_torque) * thrust.transpose();
            model.add(thrusters.force_shape.clone(), Response::Held, left);
            lever += &thrust * dynamic(&(thrusters.force_per_torque * mission.spacecraft.inertia()));
        }
        if let Some(shape) = &noise.solar_pressure {
            model.add(shape.shape(), Response::Held, &thrust * thrust.transpose());
        }

        for (i, place) in places.iter().enumerate() {
            match (*place, measured(i)) {
                (Place::TestMass { mass, axis }, Measured::Differenced) => {
                    let readout = match axis {
                        0 => noise.ifo_x.as_ref().or(noise.is_x.as_ref()),
                        1 => noise.is_y.as_ref(),
                        _ => noise.is_z.as_ref(),
                    };
                    if let Some(readout) = readout {
                        let name = format!("readout:{}.{}", ["tm1", "tm2"][mass], AXES[axis]);
                        model.name(name, &readout.shape(), Response::Readout, single(i, 1.0));
                        model.add(readout.shape(), Response::Readout, single(i, 1.0));
                    }
                    if let (Some(force), 1 | 2) = (&noise.electrostatic_force, axis) {
                        let mass_kg = mission.test_mass(["tm1", "tm2"][mass], NEEDED_BY)?.mass_kg;
                        model.add(force.shape(), Response::Held, single(i, mass_kg.powi(-2)));
                    }
                    if let Some(stray) = &noise.test_mass_acceleration {
                        model.add(stray.shape(), Response::Held, single(i, 1.0));
                    }
                }
                (Place::TestMass { .. }, Measured::Directly) => {
                    if let Some(shape) = &noise.accelerometer_linear {
                        model.add(shape.shape(), Response::Flat, single(i, 1.0));
                    }
                }
                (Place::Spacecraft { .. }, Measured::Directly) => {
                    if let Some(shape) = &noise.accelerometer_angular {
                        model.add(shape.shape(), Response::Flat, single(i, 1.0));
                    }
                }
                (Place::Spacecraft { .. }, Measured::Differenced) => {
                    if let Some(shape) = &noise.dws_long_arm {
                        model.add(shape.shape(), Response::Readout, single(i, 1.0));
                    }
                }
                (Place::Elsewhere, _) => {}
            }
        }

        // The attitude channels measure torque noise itself. The error of α̂ = E[α | everything measured] is orthogonal to
        // everything measured, these channels included: no cross term.
        let inverse_inertia = mission.spacecraft.inertia().try_inverse().unwrap_or_else(Matrix3::zeros);
        if let Some(thrusters) = thrusters.filter(|t| t.torque_shape.psd(0.1 / dt_s) > 0.0) {
            let mut enters = DMatrix::zeros(n, 3);
            for (i, place) in places.iter().enumerate() {
                if let (Place::Spacecraft { axis }, Measured::Differenced) = (*place, measured(i)) {
                    enters.row_mut(i).copy_from(&inverse_inertia.row(axis));
                }
            }
            for (axis, name) in AXES.iter().enumerate() {
                let (column, level) = (enters.column(axis), thrusters.torque[(axis, axis)]);
                let own = column * column.transpose() * level;
                model.name(format!("thruster_torque:sc.{name}"), &thrusters.torque_shape, Response::Held, own);
                if let Some(named) = model.named.last_mut() {
                    named.turns = Some(inverse_inertia.column(axis) * level.sqrt());
                }
            }
            let seen = &enters * dynamic(&thrusters.torque) * enters.transpose();
            model.add(thrusters.torque_shape.clone(), Response::Held, seen);
            let from_displacements = (0..n).any(|i| measured(i) == Measured::Differenced);
            if from_displacements && lever.iter().any(|x| *x != 0.0) {
                model.angular_error = Some(AngularError {
                    lever: lever.clone(),
                    disturbance: inverse_inertia * thrusters.torque * inverse_inertia.transpose(),
                    torque: thrusters.torque_shape,
                    attitude: noise.dws_long_arm.as_ref().map(|s| s.shape()),
                });
            }
        }
        // A measured α has its instrument's whole noise. Where the stage gives E[α | measured α], what remains is `W S_n`, less;
        // but W comes from the telemetry, which is not known here. The whole is the safe side, until the residuals refine it.
        if let (Some(shape), false) = (&noise.accelerometer_angular, model.angular_error.is_some()) {
            model.add(shape.shape(), Response::Flat, &lever * lever.transpose());
        }

        let probe = model.psd(0.1 / dt_s);
        model.unknown = (0..n).filter(|i| probe[(*i, *i)] <= 0.0).collect();
        for i in model.unknown.clone() {
            model.add(NoiseShape::white(1.0), Response::Flat, single(i, 1.0));
        }
        Ok(model)
    }

    fn add(&mut self, shape: NoiseShape, response: Response, enters: DMatrix<f64>) {
        if enters.iter().any(|x| *x != 0.0) {
            self.processes.push(Process { shape, response, enters });
        }
    }

    fn name(&mut self, name: String, shape: &NoiseShape, response: Response, enters: DMatrix<f64>) {
        if enters.iter().any(|x| *x != 0.0) {
            self.named.push(Named { name, process: Process { shape: shape.clone(), response, enters }, turns: None });
        }
    }

    /// One-sided cross-spectral matrix of one process alone, by its name: `thruster_force:sc.x`, `thruster_torque:sc.z`,
    /// `readout:tm1.y`; `None` where the mission or the channels have no such process.
    ///
    /// Of a torque it is what Σ gains by a little more of it: in the attitude's channels the torque itself, in the test masses' what α̂ does
    /// not know of it. α̂ follows the level (`hinf-dfacs` measures it), so that its error stays orthogonal to the attitude's residuals.
    #[must_use]
    pub fn process_psd(&self, name: &str, frequency_hz: f64) -> Option<DMatrix<f64>> {
        let Named { process: p, turns, .. } = self.named.iter().find(|n| n.name == name)?;
        let power = p.shape.psd(frequency_hz) * self.response(p.response, frequency_hz);
        let mut psd = &p.enters * power;
        if let (Some(turns), Some(error)) = (turns, &self.angular_error) {
            let [held, differenced] = [Response::Held, Response::Readout].map(|r| self.response(r, frequency_hz));
            let moves = &error.lever * dynamic(&error.unknown_part(held, differenced, frequency_hz)) * turns;
            psd += &moves * moves.transpose() * power;
        }
        Some(psd)
    }

    /// One-sided cross-spectral matrix at `frequency_hz`, channels × channels, units of the channels squared per Hz.
    #[must_use]
    pub fn psd(&self, frequency_hz: f64) -> DMatrix<f64> {
        let mut sigma = DMatrix::zeros(self.channels, self.channels);
        for p in &self.processes {
            let power = p.shape.psd(frequency_hz) * self.response(p.response, frequency_hz);
            sigma.iter_mut().zip(&p.enters).for_each(|(s, e)| *s += e * power);
        }
        if let Some(e) = &self.angular_error {
            let remaining = e.remaining(
                self.response(Response::Held, frequency_hz),
                self.response(Response::Readout, frequency_hz),
                frequency_hz,
            );
            let m = DMatrix::from_fn(3, 3, |i, j| remaining[(i, j)]);
            sigma += &e.lever * m * e.lever.transpose();
        }
        sigma
    }

    /// Names of the processes that [`Self::process_psd`] knows.
    pub fn process_names(&self) -> impl Iterator<Item = &str> {
        self.named.iter().map(|n| n.name.as_str())
    }

    /// Per channel, whether it is the residual of a known motion; one that is measured directly holds the motion itself.
    #[must_use]
    pub fn residual(&self) -> &[bool] {
        &self.residual
    }

    /// A label per channel, the same for channels that a chain of common noises connects.
    #[must_use]
    pub fn groups(&self) -> Vec<usize> {
        let mut label: Vec<usize> = (0..self.channels).collect();
        let entries = self.processes.iter().map(|p| p.enters.clone());
        let entries = entries.chain(self.angular_error.iter().map(|e| &e.lever * e.lever.transpose()));
        for m in entries {
            for i in 0..self.channels {
                for j in (0..i).filter(|j| m[(i, *j)] != 0.0) {
                    let (keep, drop) = (label[j], label[i]);
                    label.iter_mut().filter(|l| **l == drop).for_each(|l| *l = keep);
                }
            }
        }
        label
    }

    fn response(&self, response: Response, frequency_hz: f64) -> f64 {
        let (sin, cos) = (std::f64::consts::PI * frequency_hz * self.dt_s).sin_cos();
        match response {
            Response::Held => cos * cos,
            Response::Readout => (4.0 * sin * sin / (self.dt_s * self.dt_s)).powi(2),
            Response::Flat => 1.0,
        }
    }
}

/// The mission's noise in the bands of a plan: made once for as many estimates as there are, as a band has up to ten thousand bins.
pub struct BandNoise<'a> {
    /// At any frequency.
    pub model: &'a NoiseModel,
    /// Its mean over the bins of each band.
    pub(crate) mean: Vec<DMatrix<f64>>,
}

impl<'a> BandNoise<'a> {
    /// Of the bands of `plan`.
    #[must_use]
    pub fn new(model: &'a NoiseModel, plan: &Plan) -> Self {
        let zero = || DMatrix::zeros(model.channels, model.channels);
        let mean = |band: &Band| {
            let bins = (band.first..band.end).map(|k| model.psd(plan.bin_hz(k as f64)));
            bins.fold(zero(), |sum, psd| sum + psd) / band.bins() as f64
        };
        Self { model, mean: plan.bands.iter().map(mean).collect() }
    }
}

impl AngularError {
    /// The part of an angular acceleration that is not known, `S_n (S_w + S_n)⁻¹`: `remaining` is this times `S_w`, and changes by this
    /// times a change of `S_w` times its transpose.
    fn unknown_part(&self, held: f64, differenced: f64, frequency_hz: f64) -> Matrix3<f64> {
        let Some(attitude) = &self.attitude else { return Matrix3::identity() };
        let sw = self.disturbance * (held * self.torque.psd(frequency_hz));
        let sn = Matrix3::from_diagonal(&Vector3::repeat(differenced * attitude.psd(frequency_hz)));
        (sw + sn).try_inverse().map_or_else(Matrix3::identity, |inverse| sn * inverse)
    }

    /// `R_α = S_w − S_w (S_w + S_n)⁻¹ S_w`: torque noise S_w as the channels see it, given an attitude readout of noise S_n.
    fn remaining(&self, held: f64, differenced: f64, frequency_hz: f64) -> Matrix3<f64> {
        let sw = self.disturbance * (held * self.torque.psd(frequency_hz));
        // S_n (S_w+S_n)⁻¹ S_w, the same as above without the difference of near-equal matrices where the readout is good.
        let r = self.unknown_part(held, differenced, frequency_hz) * sw;
        0.5 * (r + r.transpose())
    }
}

fn dynamic(m: &Matrix3<f64>) -> DMatrix<f64> {
    DMatrix::from_column_slice(3, 3, m.as_slice())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn taiji() -> Mission {
        let text = include_str!("../../../fixtures/missions/taiji.toml");
        let value: serde_json::Value = toml::from_str(text).expect("the fixture is TOML");
        Mission::from_json(&value.to_string()).expect("the fixture is a mission")
    }

    const NINE: [&str; 9] = [
        "tm1.accel.x",
        "tm1.accel.y",
        "tm1.accel.z",
        "tm2.accel.x",
        "tm2.accel.y",
        "tm2.accel.z",
        "sc.alpha.x",
        "sc.alpha.y",
        "sc.alpha.z",
    ];

    fn nine() -> NoiseModel {
        NoiseModel::new(&taiji(), &NINE.map(|c| (c, Measured::Differenced)), 0.1).expect("a model")
    }

    /// At 10 mHz thrust noise is 6.7e-11 m s⁻²/√Hz on every axis; the two masses see it through the angle of 60° between them.
    #[test]
    fn thrust_is_common_to_both_test_masses() {
        let s = nine().psd(0.01);
        let thrust = (1e-7f64 / 1500.0).powi(2);
        assert!((s[(0, 0)] / thrust - 1.0).abs() < 0.03);
        assert!((s[(0, 3)] / thrust - 0.5).abs() < 0.03);
        assert!((s[(2, 5)] / thrust - 1.0).abs() < 0.03);
    }

    /// Independent of the code's matrices: the combination `x_1 − x_2 − y_1 tan 30° − y_2 tan 30°` … is found as the null
    /// space of the thrust's 3 columns; in it only readout, electrostatic force and stray acceleration are left.
    #[test]
    fn null_combinations_do_not_see_the_thrust() {
        let s = nine().psd(0.01).view((0, 0), (6, 6)).clone_owned();
        let eigen = s.symmetric_eigenvalues();
        let mut values: Vec<f64> = eigen.iter().copied().collect();
        values.sort_by(f64::total_cmp);
        let readout = 1.8e-9 * (std::f64::consts::TAU * 0.01).powi(2);
        assert!(values[2] < 3.0 * readout.powi(2), "{values:?}");
        assert!(values[3] > 1e2 * values[2]);
    }

    /// What a process adds to Σ is what Σ gains when the mission file says a little more of it: for a torque in the attitude's channels and,
    /// through what α̂ does not know, in the test masses'. By differences of two noise models, for every process.
    #[test]
    fn a_process_is_what_sigma_gains_by_a_little_more_of_it() {
        let more = 1e-6_f64;
        let louder = |table: &dyn Fn(&mut Mission)| {
            let mut mission = taiji();
            table(&mut mission);
            NoiseModel::new(&mission, &NINE.map(|c| (c, Measured::Differenced)), 0.1).expect("a model")
        };
        let factor = (1.0 + more).sqrt();
        let torque = louder(&|m| m.noise.thruster_torque.as_mut().expect("there").asd_nm_rthz *= factor);
        let force = louder(&|m| m.noise.thruster_force.as_mut().expect("there").asd_n_rthz *= factor);
        let base = nine();
        for f in [1e-3, 0.03, 0.08, 0.3, 2.0] {
            for (louder, process) in [(&torque, "thruster_torque"), (&force, "thruster_force")] {
                let gained = (louder.psd(f) - base.psd(f)) / more;
                let parts = ["x", "y", "z"].map(|a| base.process_psd(&format!("{process}:sc.{a}"), f).expect("there"));
                let sum = &parts[0] + &parts[1] + &parts[2];
                let scale = |i: usize, j: usize| (base.psd(f)[(i, i)] * base.psd(f)[(j, j)]).sqrt();
                for i in 0..9 {
                    for j in 0..9 {
                        let error = (gained[(i, j)] - sum[(i, j)]).abs();
                        assert!(error < 1e-5 * scale(i, j), "{process} at {f} Hz, {i} {j}: {error:e}");
                    }
                }
                // At 0.3 Hz α̂ does not know the torque, and Σ of x shows it.
                assert!(process == "thruster_force" || f != 0.3 || sum[(0, 0)] > 0.01 * base.psd(f)[(0, 0)], "{sum}");
            }
        }
    }

    /// A perfect readout leaves nothing unknown, a blind one the whole torque noise.
    #[test]
    fn the_remaining_error_of_alpha_has_both_limits() {
        let mut mission = taiji();
        let remaining = |m: &Mission, f: f64| {
            let model = NoiseModel::new(m, &[("tm1.accel.x", Measured::Differenced)], 0.1).expect("a model");
            model.angular_error.as_ref().expect("a lever").remaining(1.0, (std::f64::consts::TAU * f).powi(4), f)
                [(0, 0)]
        };
        let all = 1e-14 / (800.0f64 * 800.0);
        mission.noise.dws_long_arm.as_mut().expect("dws").asd_rad_rthz = 1e-20;
        assert!(remaining(&mission, 0.1) < 1e-12 * all);
        mission.noise.dws_long_arm.as_mut().expect("dws").asd_rad_rthz = 1.0;
        assert!((remaining(&mission, 0.1) / all - 1.0).abs() < 2e-3);
    }

    #[test]
    fn the_attitude_stands_apart_from_the_test_masses() {
        let s = nine().psd(0.05);
        for i in 0..6 {
            for j in 6..9 {
                assert_eq!(s[(i, j)], 0.0);
            }
        }
    }

    #[test]
    fn a_channel_without_noise_is_named_and_starts_white() {
        let mut mission = taiji();
        mission.noise.accelerometer_linear = None;
        let model = NoiseModel::new(&mission, &[("tm1.accel.x", Measured::Directly)], 1.0).expect("a model");
        assert_eq!(model.unknown, [0]);
        assert_eq!(model.psd(0.1)[(0, 0)], 1.0);
    }
}
